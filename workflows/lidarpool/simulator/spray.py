"""Spray: clumps of drops that vehicles leave behind them on wet ground.

Each vehicle leaves a box of spray in every tenth of a second, as wide and high as itself, and as
long as its way. It stays where it is, and what is in it falls to the ground.
"""

from __future__ import annotations

import math

import numpy as np

from raybeam.moving import near_boxes

from ..base.arrays import Floats, Ints
from ..base.vectors import into_axes, length
from ..scene.actors import check_spray
from ..sensor.noise import Purpose, starts
from ..sensor.trajectory import presence_ns, velocities
from ..sensor.weather import FAINTEST, LARGE, reach, spray
from .air import exponential, in_the_air, reached, seen_by_range
from .returns import OF_RETURNS, SPRAY, PulseReturns, joined, made, unreal
from .scene_caster import SceneCaster
from .step import Memory, PulseBatch, PulseStep, Setup, Sizes
from .surfaces import Surfaces
from .ways import Ways

BOX_NS, BOXES = 1e8, 13  # time between boxes of a vehicle, and how many are there at a time
# For how long, and when exp(-1) of it is left: after so long, drops have fallen by 0.8 m.
LASTS_NS, DECAY_NS = BOXES * BOX_NS, 4e8
FULL_M_S, LEAST_M_S = 25.0, 3.0  # speeds: of the stated density, and below which there is none
BOXES_MOST = 128  # that rays are compared with at a time


class SprayStep(PulseStep):
    """Finds where spray behind vehicles returns light, and takes light from what is behind it.

    Raises
    ------
    LidarpoolError
        If an actor that raises spray has no size.
    """

    effects = ("Spray",)
    reads = "ray", "distance", "triangle", "energy", "cause", "velocity"
    writes = *OF_RETURNS, "velocity"
    purposes = Purpose.SPRAY, Purpose.SPRAY_SUBRAY, Purpose.SPRAY_DIAMETER

    def __init__(self, setup: Setup, caster: SceneCaster, surfaces: Surfaces) -> None:
        super().__init__(setup, caster, surfaces)
        survey, sensor, noise = setup.survey, setup.sensor, setup.noise
        check_spray(setup.scene.actors)
        air, span = survey.air(setup.number), reach(sensor.min_range_m, sensor.max_range_m)
        kind = spray(survey.spray_g_m3)
        self._extinction, self._step = kind.extinction / LARGE, 1 / kind.slope
        self._seen = seen_by_range(air, kind, FAINTEST * noise.threshold, *span)
        self._materials = surfaces.at(sensor.optics.wavelength_nm)
        self._begun = starts(noise.seed, *self.purposes)
        # Corners of the meshes, by the number of the actor.
        self._sizes = {
            number: (actor.mesh.vertices.min(axis=0), actor.mesh.vertices.max(axis=0))
            for number, actor in enumerate(setup.scene.actors)
            if actor.spray
        }

    @staticmethod
    def applies(setup: Setup) -> bool:
        """See `PulseStep.applies`."""
        actors = setup.scene.actors
        return setup.survey.spray_g_m3 > 0 and any(actor.spray for actor in actors)

    @staticmethod
    def added(setup: Setup) -> float:
        """See `PulseStep.added`: of most pulses that meet spray."""
        return 1.0

    @staticmethod
    def memory(setup: Setup, sizes: Sizes) -> Memory:
        """See `PulseStep.memory`: rays in the middles of beams, how far light gets, and clumps."""
        return Memory(casting=300 * sizes.beams + 30 * sizes.subrays)

    def apply(self, returns: PulseReturns, batch: PulseBatch) -> PulseReturns:
        """See `PulseStep.apply`."""
        if self._seen is None or not self._sizes:
            return returns
        from . import pulse_loops

        beam, crossed = self._crossings(batch)
        if not len(beam):
            return returns
        keys, each, parts, row = batch.keys, batch.each, list[PulseReturns](), 0
        count = (batch.stop - batch.start) * each
        far = reached(self._materials, self.surfaces, returns, count)
        energy, ray = made(returns.energy).copy(), returns.ray.astype(np.int64)
        pulse_loops.veil(beam, crossed, each, self._extinction, far, ray, returns.distance, energy)
        batch.hits = returns = returns._replace(energy=energy)
        given = self._begun, keys.scan, np.array(keys.begins, np.int64), batch.start, far
        tables = each, self._seen[0], self._step, self._seen[1], exponential()
        while row < len(beam):
            out = np.empty(1024 + len(beam), np.int64), *np.empty((2, 1024 + len(beam)))
            row, count = pulse_loops.spray(row, beam, crossed, *tables, *given, *out)
            parts.append(unreal(returns, out[0][:count], out[1][:count], out[2][:count], SPRAY))
        drawn = joined(parts)
        drawn = drawn.take(np.argsort(drawn.ray, kind="stable"))
        return in_the_air(self.setup, returns, batch, drawn)

    def _crossings(self, batch: PulseBatch) -> tuple[Ints, Floats]:
        """Where beams cross boxes of spray, in the order of beams, see `pulse_loops.crossings`."""
        from . import pulse_loops

        assert self._seen is not None
        times = batch.here.times(np.arange(batch.stop - batch.start) * batch.each)
        boxes, there, density = self._boxes(batch.here.ways, times.min(), times.max())
        beams, found = [np.zeros(0, np.int64)], [np.zeros((3, 0))]
        if len(boxes):
            rays = np.ascontiguousarray(np.concatenate([one.T for one in batch.middles]))
            end_m = float(self._seen[1][0, -1])
        for first in range(0, len(boxes), BOXES_MOST):
            some = slice(first, first + BOXES_MOST)
            own = boxes[some], there[some]
            cell, which, size = near_boxes(rays, times, *own, end_m)
            given = rays, times, size, cell, which, *own, density[some], LASTS_NS, DECAY_NS, end_m
            count = pulse_loops.crossings(*given, beams[0], found[0])
            beams.append(np.empty(count, np.int64))
            found.append(np.empty((3, count)))
            pulse_loops.crossings(*given, beams[-1], found[-1])
        beam = np.concatenate(beams)
        order = np.argsort(beam, kind="stable")
        return beam[order], np.ascontiguousarray(np.concatenate(found, axis=1)[:, order])

    def _boxes(self, ways: Ways, begin: float, end: float) -> tuple[Floats, Floats, Floats]:
        """Boxes of spray, and when they are there, as of `near_boxes`; their densities (b,)."""
        numbers = np.arange(math.floor(begin / BOX_NS) - BOXES, math.floor(end / BOX_NS) + 1)
        boxes, spans, speeds = [np.zeros((0, 12))], [np.zeros((0, 2))], [np.zeros(0)]
        for number, (low, high) in self._sizes.items():
            way = ways[number]
            since, last = presence_ns(way)
            since = max(since, 0.0)  # before, it came as it goes then
            born = BOX_NS * numbers[BOX_NS * numbers <= min(last, end)]
            at = np.maximum(born, since)
            if not (way.moves and len(at)):
                continue
            places, turns = way.poses(0, at)
            speed, _ = velocities(way, 0, at)
            metres = length(speed)
            half = np.tile((high - low) / 2, (len(at), 1))
            half[:, 0] = metres * (BOX_NS / 2e9)
            sides = np.broadcast_to(np.eye(3) if turns is None else turns, (len(at), 3, 3))
            sides = sides.transpose(0, 2, 1)
            middle = places + speed * ((born - at) / 1e9)[:, None] + into_axes(low + half, sides)
            some = np.flatnonzero(metres >= LEAST_M_S)
            sides = (sides * half[:, :, None]).reshape(-1, 9)
            boxes.append(np.concatenate([middle, sides], axis=1)[some])
            spans.append(np.stack([at, born + LASTS_NS], axis=1)[some])
            speeds.append(metres[some])
        density = self.setup.survey.wet * np.square(np.concatenate(speeds) / FULL_M_S)
        return np.concatenate(boxes), np.concatenate(spans), density

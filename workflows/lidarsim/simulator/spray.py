"""Spray: clumps of drops that vehicles leave behind them on wet ground.

Each vehicle leaves a box of spray in every tenth of a second, as wide and high as itself, and as
long as its way. It stays where it is, and what is in it falls to the ground.
"""

from __future__ import annotations

import math

import numpy as np

from raybeam.moving import near_boxes

from ..base.arrays import Floats, Ints, owned
from ..base.vectors import into_axes, length
from ..scene.actors import check_spray
from ..sensor.noise import Purpose, starts
from ..sensor.weather import FAINTEST, LARGE, reach, spray
from .air import exponential, in_the_air, reached, seen_by_range
from .motion import along_rings
from .returns import OF_RETURNS, SPRAY, PulseReturns, joined, made, unreal
from .scene_caster import SceneCaster
from .step import Memory, PulseBatch, PulseStep, Setup, Sizes
from .surfaces import Surfaces
from .ways import Ways

BOX_NS, BOXES = 1e8, 10  # time between boxes of a vehicle, and how many are there at a time
# For how long, and when exp(-1) of it is left, as drops of a few tenths of a millimetre fall.
LASTS_NS, DECAY_NS = BOXES * BOX_NS, 4e8
FULL_M_S, LEAST_M_S = 25.0, 3.0  # speeds: of the stated density, and below which there is none
STEP_NS = 5e5  # for velocities


class SprayStep(PulseStep):
    """Finds where spray behind vehicles returns light, and takes light from what is behind it.

    Raises
    ------
    LidarError
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
        # Of each actor the lowest corner of its mesh, and halves of its sides: (a, 2, 3).
        meshes = [actor.mesh.vertices for actor in setup.scene.actors]
        self._sizes = np.array([(one.min(axis=0), np.ptp(one, axis=0) / 2) for one in meshes])
        self._raising = [n for n, actor in enumerate(setup.scene.actors) if actor.spray]

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
        if self._seen is None:
            return returns
        from . import pulse_loops

        keys, each, parts, row = batch.keys, batch.each, list[PulseReturns](), 0
        count = (batch.stop - batch.start) * each
        far = reached(self._materials, self.surfaces, returns, count)
        beam, crossed = self._crossings(batch, far.reshape(-1, each).max(axis=1))
        if not len(beam):
            return returns
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

    def _crossings(self, batch: PulseBatch, far: Floats) -> tuple[Ints, Floats]:
        """Where beams, which get so far (n,), cross boxes: see `pulse_loops.crossings`.

        Those of a beam follow each other, in the order of vehicles and times.
        """
        from . import pulse_loops

        assert self._seen is not None
        place = along_rings(np.arange(batch.stop - batch.start), self.setup.sensor.channels)
        times = batch.here.times(place * batch.each)
        boxes, there, density = self._boxes(batch.here.ways, times.min(), times.max())
        rays = np.concatenate([one.T.take(place, axis=1) for one in batch.middles])
        far = np.minimum(far[place], self._seen[1][0, -1])
        cell, which, size = near_boxes(rays, times, boxes, there, float(far.max()))
        order = np.argsort(cell, kind="stable")
        pairs = cell[order], which[order], boxes, there, density, LASTS_NS, DECAY_NS
        room, count = 0, 1 + size * len(cell) // 4
        while room < count:  # mostly, some rays of a cell meet a box
            room, beam, found = count, np.empty(count, np.int64), np.empty((3, count))
            count = pulse_loops.crossings(rays, times, far, size, *pairs, beam, found)
        return place[beam[:count]], owned(found[:, :count])

    def _boxes(self, ways: Ways, begin: float, end: float) -> tuple[Floats, Floats, Floats]:
        """Boxes of spray, and when they are there, as of `near_boxes`; their densities (b,)."""
        numbers = np.arange(math.floor(begin / BOX_NS) - BOXES, math.floor(end / BOX_NS) + 1)
        some = np.array([number for number in self._raising if ways[number].moves], np.int64)
        actor, born = np.repeat(some, len(numbers)), np.tile(BOX_NS * numbers, len(some))
        since, last = ways.presence_ns[actor].T
        at = np.maximum(born, np.maximum(since, 0.0) + STEP_NS)  # it came as it goes then
        rows = np.flatnonzero((born <= end) & (at <= last))
        actor, born, at = actor[rows], born[rows], at[rows]
        places, turns = ways.poses(actor, at)
        speed = (places - ways.poses(actor, at - STEP_NS)[0]) / (STEP_NS / 1e9)
        metres, sides = length(speed), turns.transpose(0, 2, 1)
        low, half = self._sizes[actor].transpose(1, 0, 2).copy()
        half[:, 0] = metres * (BOX_NS / 2e9)
        middle = places + speed * ((born - at) / 1e9)[:, None] + into_axes(low + half, sides)
        boxes = np.concatenate([middle, (sides * half[:, :, None]).reshape(-1, 9)], axis=1)
        there = np.stack([np.maximum(born, since), born + LASTS_NS], axis=1)
        fast = np.flatnonzero(metres >= LEAST_M_S)
        density = self.setup.survey.wet * np.square(metres[fast] / FULL_M_S)
        return boxes[fast], there[fast], density

"""Spray: clumps of drops that vehicles leave behind them on wet ground.

Each vehicle leaves a box of spray in every tenth of a second, as wide and high as itself, and as
long as its way. It stays where it is, and what is in it falls to the ground.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from raybeam.moving import near_boxes

from ..base.arrays import Floats, owned
from ..base.vectors import into_axes, length
from ..columns.table import CAUSES
from ..scene.actors import check_spray
from ..sensor.random_numbers import Purpose
from ..sensor.weather import FAINTEST, LARGE, reach, spray
from .actor_trajectories import ActorTrajectories
from .air import exponential, in_the_air, random_keys, reached, room_for_hits, seen_by_range
from .motion import along_rings
from .returns import OF_RETURNS, PulseReturns, joined, made, unreal
from .scene_caster import SceneCaster
from .step import Memory, PulseBatch, PulseStep, Role, Setup, Sizes
from .surfaces import Surfaces

if TYPE_CHECKING:
    from .spray_loops import Crossings

SPRAY_DEPTH = Purpose(16, "depth of spray until the next clump")
SPRAY_SUBRAY = Purpose(17, "sub-ray that meets a clump")
SPRAY_DIAMETER = Purpose(18, "diameter of a drop of spray")
SPRAY = CAUSES.index("spray")
# time between boxes of a vehicle, and how many are there at a time
BOX_NS = 1e8
BOXES = 10
# For how long, and when exp(-1) of it is left, as drops of a few tenths of a millimetre fall.
LASTS_NS = BOXES * BOX_NS
DECAY_NS = 4e8
# speeds: of the stated density, and below which there is none
FULL_M_S = 25.0
LEAST_M_S = 3.0
STEP_NS = 5e5  # for velocities


class SprayStep(PulseStep):
    """Finds where spray behind vehicles returns light, and takes light from what is behind it.

    Raises
    ------
    LidarError
        If an actor that raises spray has no size.
    """

    role = Role.CHANGES
    effects = ("Spray",)
    reads = "ray", "distance", "triangle", "energy", "cause", "velocity"
    writes = *OF_RETURNS, "velocity"
    causes = (SPRAY,)
    purposes = SPRAY_DEPTH, SPRAY_SUBRAY, SPRAY_DIAMETER

    def __init__(self, setup: Setup, caster: SceneCaster, surfaces: Surfaces) -> None:
        super().__init__(setup, caster, surfaces)
        survey = setup.survey
        sensor = setup.sensor
        noise = setup.noise
        check_spray(setup.scene.actors)
        air = survey.air(setup.number)
        span = reach(sensor.min_range_m, sensor.max_range_m)
        kind = spray(survey.spray_g_m3)
        self._extinction = kind.extinction / LARGE
        self._step = 1 / kind.slope
        self._clumps = seen_by_range(air, kind, FAINTEST * noise.threshold, *span)
        self._materials = surfaces.at(sensor.optics.wavelength_nm)
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
        if self._clumps is None:
            return returns
        from . import pulse_loops, spray_loops  # not before: numba takes half a second to import

        each = batch.subrays_per_beam
        count = (batch.stop - batch.start) * each
        reach_m = reached(self._materials, self.surfaces, returns, count)
        crossings = self._crossings(batch, reach_m.reshape(-1, each).max(axis=1))
        if not len(crossings.beam):
            return returns
        energy = made(returns.energy).copy()
        ray = returns.ray.astype(np.int64)
        veiled = pulse_loops.SampledHits(ray, owned(returns.distance), energy)
        spray_loops.veil(crossings, each, self._extinction, reach_m, veiled)
        batch.hits = returns = returns._replace(energy=energy)
        mean, by_range = self._clumps
        tables = spray_loops.ClumpTables(mean, by_range, self._step, exponential())
        random = random_keys(self.setup.noise.seed, self.purposes, batch.keys, batch.start)
        parts: list[PulseReturns] = []
        row = 0
        while row < len(crossings.beam):
            hits = room_for_hits(1024 + len(crossings.beam))
            row, count = spray_loops.clumps(row, crossings, each, tables, random, reach_m, hits)
            parts.append(unreal(returns, *hits.first(count), cause=SPRAY))
        clumps = joined(parts)
        clumps = clumps.take(np.argsort(clumps.ray, kind="stable"))
        return in_the_air(self.setup, returns, batch, clumps)

    def _crossings(self, batch: PulseBatch, far: Floats) -> Crossings:
        """Return where beams, which get so far (n,), cross boxes.

        Those of a beam follow each other, in the order of vehicles and times.
        """
        from . import spray_loops

        assert self._clumps is not None
        place = along_rings(np.arange(batch.stop - batch.start), self.setup.sensor.channels)
        times = batch.subray_poses.times(place * batch.subrays_per_beam)
        boxes, there, density = self._boxes(
            batch.subray_poses.actor_trajectories, times.min(), times.max()
        )
        rays = np.concatenate([one.T.take(place, axis=1) for one in batch.central_rays])
        far = np.minimum(far[place], self._clumps[1][0, -1])
        cell, which, size = near_boxes(rays, times, boxes, there, float(far.max()))
        order = np.argsort(cell, kind="stable")
        pairs = spray_loops.CellPairs(cell[order], which[order], size)
        spray_boxes = spray_loops.SprayBoxes(boxes, there, density, LASTS_NS, DECAY_NS)
        room = 0
        count = 1 + size * len(cell) // 4
        while room < count:  # mostly, some rays of a cell meet a box
            room = count
            crossings = spray_loops.Crossings(np.empty(room, np.int64), np.empty((3, room)))
            count = spray_loops.cross(rays, times, far, pairs, spray_boxes, crossings)
        return spray_loops.Crossings(
            place[crossings.beam[:count]], owned(crossings.spans[:, :count])
        )

    def _boxes(
        self, ways: ActorTrajectories, begin: float, end: float
    ) -> tuple[Floats, Floats, Floats]:
        """Boxes of spray, and when they are there, as of `near_boxes`; their densities (b,)."""
        numbers = np.arange(math.floor(begin / BOX_NS) - BOXES, math.floor(end / BOX_NS) + 1)
        some = np.array([number for number in self._raising if ways[number].moves], np.int64)
        actor = np.repeat(some, len(numbers))
        born = np.tile(BOX_NS * numbers, len(some))
        since, last = ways.presence_ns[actor].T
        at = np.maximum(born, np.maximum(since, 0.0) + STEP_NS)  # it came as it goes then
        rows = np.flatnonzero((born <= end) & (at <= last))
        actor = actor[rows]
        born = born[rows]
        at = at[rows]
        places, turns = ways.poses(actor, at)
        speed = (places - ways.poses(actor, at - STEP_NS)[0]) / (STEP_NS / 1e9)
        metres = length(speed)
        sides = turns.transpose(0, 2, 1)
        low, half = self._sizes[actor].transpose(1, 0, 2).copy()
        half[:, 0] = metres * (BOX_NS / 2e9)
        middle = places + speed * ((born - at) / 1e9)[:, None] + into_axes(low + half, sides)
        boxes = np.concatenate([middle, (sides * half[:, :, None]).reshape(-1, 9)], axis=1)
        there = np.stack([np.maximum(born, since), born + LASTS_NS], axis=1)
        fast = np.flatnonzero(metres >= LEAST_M_S)
        density = self.setup.survey.wet * np.square(metres[fast] / FULL_M_S)
        return boxes[fast], there[fast], density

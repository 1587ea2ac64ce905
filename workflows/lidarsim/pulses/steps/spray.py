"""Spray: clumps of drops that vehicles leave behind on wet ground.

Every tenth of a second, each vehicle leaves a box of spray that is as wide and high as the vehicle,
and as long as the distance that it has driven. A box stays in place while its drops fall to the
ground.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from raybeam.moving import pair_cells_with_boxes

from ...casting.actor_trajectories import ActorTrajectories
from ...casting.motion import order_along_rings
from ...casting.scene_caster import SceneCaster
from ...casting.surfaces import SceneSurfaces
from ...columns.table import CAUSES
from ...media.weather import FAINTEST, LARGE, particle_range, spray_clumps
from ...numerics.arrays import Floats, Ints, to_writable
from ...numerics.random_numbers import Purpose
from ...numerics.vectors import norm, rotate_into_frames
from ...scene.actors import check_spray
from ..returns import (
    RETURN_COLUMNS,
    PulseReturns,
    concatenate_returns,
    require_column,
    returns_without_surface,
)
from .particles import (
    add_air_hits,
    empty_hits,
    exponential_quantiles,
    light_reach,
    random_keys,
    seen_by_range,
)
from .step import Memory, PulseBatch, PulseStep, Role, Setup, Sizes

if TYPE_CHECKING:
    from .spray_loops import BoxCrossings, SprayBoxes

SPRAY_DEPTH = Purpose(16, "depth of spray until the next clump")
SPRAY_SUBRAY = Purpose(17, "sub-ray that hits a clump")
SPRAY_DIAMETER = Purpose(18, "diameter of a drop of spray")
SPRAY = CAUSES.index("spray")
BOX_NS = 1e8  # time between the boxes of a vehicle
BOXES = 10  # number of boxes of a vehicle that exist at a time
LASTS_NS = BOXES * BOX_NS  # lifetime of a box
DECAY_NS = 4e8  # time until exp(-1) of the spray is left, as drops of a few 0.1 mm fall
FULL_SPEED_M_S = 25.0  # speed at which spray has the configured density
MIN_SPEED_M_S = 3.0  # lowest speed that raises spray
STEP_NS = 5e5  # time between the two poses from which a vehicle's velocity is computed


class SprayStep(PulseStep):
    """Simulation step that samples returns of spray, and attenuates light that passes through it.

    Raises
    ------
    LidarError
        If an actor that raises spray has a mesh without volume.
    """

    role = Role.CHANGES
    effects = ("Spray",)
    reads = "ray", "distance", "triangle", "energy", "cause", "velocity"
    writes = *RETURN_COLUMNS, "velocity"
    causes = (SPRAY,)
    purposes = SPRAY_DEPTH, SPRAY_SUBRAY, SPRAY_DIAMETER

    def __init__(self, setup: Setup, caster: SceneCaster, surfaces: SceneSurfaces) -> None:
        super().__init__(setup, caster, surfaces)
        survey = setup.survey
        sensor = setup.sensor
        noise = setup.noise
        check_spray(setup.scene.actors)
        air = survey.air(setup.number)
        range_limits_m = particle_range(sensor.min_range_m, sensor.max_range_m)
        clump_kind = spray_clumps(survey.spray_g_m3)
        # Cross-sections of clumps in 1/m, half of whose extinction is diffraction.
        self._extinction = clump_kind.extinction / LARGE
        self._step_mm = 1 / clump_kind.slope
        self._clump_distribution = seen_by_range(
            air, clump_kind, FAINTEST * noise.threshold, *range_limits_m
        )
        self._materials = surfaces.at_wavelength(sensor.optics.simulated_nm)
        # (actors, 2, 3), in meters in the actor frame: lowest corner of each mesh's bounding box,
        # and half of the box's side lengths.
        meshes = [actor.mesh.vertices for actor in setup.scene.actors]
        self._mesh_boxes = np.array(
            [(mesh.min(axis=0), np.ptp(mesh, axis=0) / 2) for mesh in meshes]
        )
        self._raising = [n for n, actor in enumerate(setup.scene.actors) if actor.spray]

    def with_moved_instances(self, setup: Setup, surfaces: SceneSurfaces) -> PulseStep:
        """Return a copy for a scene in which instances have moved."""
        return self.with_setup(setup, surfaces)

    @staticmethod
    def applies(setup: Setup) -> bool:
        """Return whether spray is enabled and an actor raises spray."""
        actors = setup.scene.actors
        return setup.survey.spray_g_m3 > 0 and any(actor.spray for actor in actors)

    @staticmethod
    def added_returns(setup: Setup) -> float:
        """Return the mean number of clumps per pulse that passes through spray."""
        return 1.0  # an estimate

    @staticmethod
    def memory(setup: Setup, sizes: Sizes) -> Memory:
        """Return the memory of central rays, light ranges and clumps, in bytes."""
        return Memory(casting=300 * sizes.beams + 30 * sizes.subrays)

    def apply(self, returns: PulseReturns, batch: PulseBatch) -> PulseReturns:
        """Add hits on spray to the hits of a batch, and attenuate light that crosses spray."""
        if self._clump_distribution is None:
            return returns
        from . import pulse_loops, spray_loops  # imported here: numba takes half a second to import

        subrays = batch.subrays_per_beam
        count = (batch.stop - batch.start) * subrays
        reach_m = light_reach(self._materials, self.surfaces, returns, count)
        crossings = self._crossings(batch, reach_m.reshape(-1, subrays).max(axis=1))
        if not len(crossings.beam):
            return returns
        energy = require_column(returns.energy).copy()
        ray = returns.ray.astype(np.int64)
        surface_hits = pulse_loops.SampledHits(ray, to_writable(returns.distance), energy)
        spray_loops.attenuate(crossings, subrays, self._extinction, reach_m, surface_hits)
        batch.hits = returns = returns._replace(energy=energy)
        clumps = self._sample_clumps(returns, batch, crossings, reach_m)
        return add_air_hits(self.setup, returns, batch, clumps)

    def _sample_clumps(
        self, returns: PulseReturns, batch: PulseBatch, crossings: BoxCrossings, reach_m: Floats
    ) -> PulseReturns:
        """Sample hits on clumps in the boxes that beams cross, sorted by sub-ray."""
        from . import spray_loops

        assert self._clump_distribution is not None
        mean, by_range = self._clump_distribution
        tables = spray_loops.ClumpTables(mean, by_range, self._step_mm, exponential_quantiles())
        keys = random_keys(self.setup.noise.seed, self.purposes, batch.keys, batch.start)
        clump_hits: list[PulseReturns] = []
        row = 0
        while row < len(crossings.beam):
            hits = empty_hits(1024 + len(crossings.beam))
            row, count = spray_loops.sample_clumps(
                row,
                crossings,
                subrays=batch.subrays_per_beam,
                tables=tables,
                keys=keys,
                reach=reach_m,
                hits=hits,
            )
            clump_hits.append(returns_without_surface(returns, *hits.first(count), cause=SPRAY))
        clumps = concatenate_returns(clump_hits)
        return clumps.take(np.argsort(clumps.ray, kind="stable"))

    def _crossings(self, batch: PulseBatch, reach_m: Floats) -> BoxCrossings:
        """Return where the central rays of beams cross boxes.

        `reach_m` (beams,) is the range in meters at which each beam ends. The crossings of a beam
        are consecutive, sorted by vehicle and then by the time at which the vehicle leaves the box.
        """
        from . import spray_loops

        assert self._clump_distribution is not None
        # Cells of consecutive rays are narrow if neighbors on a ring are consecutive.
        ring_order = order_along_rings(
            np.arange(batch.stop - batch.start), self.setup.sensor.channels
        )
        times = batch.subray_poses.times(ring_order * batch.subrays_per_beam)
        spray_boxes = self._boxes(batch.subray_poses.actor_trajectories, times.min(), times.max())
        rays = np.concatenate(
            [vectors.T.take(ring_order, axis=1) for vectors in batch.central_rays]
        )
        reach_m = np.minimum(reach_m[ring_order], self._clump_distribution[1][-1, 0])
        cell, box, cell_rays = pair_cells_with_boxes(
            rays, times, spray_boxes.boxes, spray_boxes.presence_ns, float(reach_m.max())
        )
        order = np.argsort(cell, kind="stable")
        pairs = spray_loops.BoxPairs(cell[order], box[order], cell_rays)
        room = 0
        count = 1 + cell_rays * len(cell) // 4
        while room < count:  # usually some rays of a cell meet a box
            room = count
            crossings = spray_loops.BoxCrossings(np.empty(room, np.int64), np.empty((3, room)))
            count = spray_loops.find_crossings(rays, times, reach_m, pairs, spray_boxes, crossings)
        return spray_loops.BoxCrossings(
            ring_order[crossings.beam[:count]], to_writable(crossings.spans[:, :count])
        )

    def _boxes(self, trajectories: ActorTrajectories, begin_ns: float, end_ns: float) -> SprayBoxes:
        """Return the boxes of spray that are in the scene between two times.

        A vehicle leaves a box at each multiple of `BOX_NS`, `created_ns`. Its pose is evaluated at
        `pose_ns`. This is `created_ns` or, if the vehicle is not yet in the scene then, the first
        time at which it has a velocity.
        """
        from . import spray_loops

        numbers = np.arange(math.floor(begin_ns / BOX_NS) - BOXES, math.floor(end_ns / BOX_NS) + 1)
        moving = np.array([k for k in self._raising if trajectories[k].moves], np.int64)
        actor = np.repeat(moving, len(numbers))
        created_ns = np.tile(BOX_NS * numbers, len(moving))
        first_ns, last_ns = trajectories.presence_ns[actor].T
        # Before a vehicle appears in the scene, its motion is assumed to be the same as then.
        pose_ns = np.maximum(created_ns, np.maximum(first_ns, 0.0) + STEP_NS)
        box_indices = np.flatnonzero((created_ns <= end_ns) & (pose_ns <= last_ns))
        created_ns = created_ns[box_indices]
        first_ns = first_ns[box_indices]
        boxes, speed_m_s = self._boxes_of(
            trajectories, actor[box_indices], created_ns, pose_ns[box_indices]
        )
        presence_ns = np.stack([np.maximum(created_ns, first_ns), created_ns + LASTS_NS], axis=1)
        fast = np.flatnonzero(speed_m_s >= MIN_SPEED_M_S)
        density = self.setup.survey.wet * np.square(speed_m_s[fast] / FULL_SPEED_M_S)
        return spray_loops.SprayBoxes(boxes[fast], presence_ns[fast], density, LASTS_NS, DECAY_NS)

    def _boxes_of(
        self, trajectories: ActorTrajectories, actor: Ints, created_ns: Floats, pose_ns: Floats
    ) -> tuple[Floats, Floats]:
        """Return the boxes that actors leave at the given times, and the actors' speeds in m/s.

        Each row of the boxes (b, 12) is a center and three vectors, half of the box's sides, in
        meters in the scene frame. A box starts at the rear of the actor. Along the actor's x axis,
        which points forward, it is as long as the distance driven in `BOX_NS`. The actor drives
        straight on from `pose_ns` to `created_ns`.
        """
        positions, rotations = trajectories.poses(actor, pose_ns)
        earlier, _ = trajectories.poses(actor, pose_ns - STEP_NS)
        velocity = (positions - earlier) / (STEP_NS / 1e9)
        speed_m_s = norm(velocity)
        axes = rotations.transpose(0, 2, 1)  # rows are the axes of the actor in the scene frame
        lowest_corner, half_sides = self._mesh_boxes[actor].transpose(1, 0, 2).copy()
        half_sides[:, 0] = speed_m_s * (BOX_NS / 2e9)
        driven_m = velocity * ((created_ns - pose_ns) / 1e9)[:, None]
        middle = positions + driven_m + rotate_into_frames(lowest_corner + half_sides, axes)
        boxes = np.concatenate([middle, (axes * half_sides[:, :, None]).reshape(-1, 9)], axis=1)
        return boxes, speed_m_s

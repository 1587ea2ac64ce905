"""Scene flow, which is the displacement of surface points until the next sweep of a sensor.

A point that is measured at time t in a sweep is compared with the same point of the surface at time
t + d, where d is the time from the start of this sweep to the start of the next sweep of the same
sensor. Argoverse 2 defines flow in the same way, except that it assumes rigid boxes and the same
time for all points of a sweep.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...casting.actor_surfaces import ActorSurfaces
from ...casting.actor_trajectories import ActorTrajectories
from ...motion.trajectory import mounted_poses
from ...numerics.arrays import Floats, Indices, Integers, Ints, Ints32
from ...numerics.vectors import rotate, rotate_into_frames
from ...survey.survey import ScanSpec, Survey

BLOCK_POINTS = 1 << 14  # number of points whose flow is computed at a time
_ROUNDING_NS = 1.0  # firing times are rounded to nanoseconds


class SurfacePoints(NamedTuple):
    """Points on surfaces that are measured in consecutive scans of a sensor."""

    triangle: Ints32  # (n,)
    positions: Floats  # (n, 3), scene frame, meters
    times_ns: Floats  # (n,), firing times since the start of the survey
    scan: Integers  # (n,), scan numbers

    def select(self, rows: Indices) -> SurfacePoints:
        """Return the points in the given rows."""
        return SurfacePoints(
            self.triangle[rows], self.positions[rows], self.times_ns[rows], self.scan[rows]
        )


class SceneFlow(NamedTuple):
    """Displacements of points in meters, in the frame of the survey's points.

    Both arrays have shape (n, 3). They are NaN for points without a next sweep, and for points on
    actors that are absent at the time of the next sweep.
    """

    relative: Floats  # displacements relative to the sensor
    world: Floats  # displacements in the world


def compute_flow(
    survey: Survey,
    spec: ScanSpec,
    points: SurfacePoints,
    surfaces: ActorSurfaces,
    trajectories: ActorTrajectories,
) -> SceneFlow:
    """Compute the scene flow of points.

    `spec` is any of the scans, which all belong to the same sensor and station.
    """
    flow = SceneFlow(*np.full((2, len(points.scan), 3), np.nan))
    sweep, later_ns = _later_times(survey, spec, points)
    row_indices = np.flatnonzero(np.isfinite(later_ns))
    for begin in range(0, len(row_indices), BLOCK_POINTS):
        rows = row_indices[begin : begin + BLOCK_POINTS]
        block = points.select(rows)
        ends = surfaces.moved_points(
            block.triangle, block.positions, block.times_ns, later_ns[rows], trajectories
        )
        block_flow = _block_flow(survey, spec, block, ends, sweep[rows], later_ns[rows])
        flow.relative[rows] = block_flow.relative
        flow.world[rows] = block_flow.world
    return flow


def _later_times(survey: Survey, spec: ScanSpec, points: SurfacePoints) -> tuple[Ints, Floats]:
    """Return the sweep of each point, and the time of the corresponding firing in the next sweep.

    Times are in nanoseconds since the start of the survey. They are NaN if no next sweep follows at
    the same station, or if it ends before the corresponding firing.
    """
    sweeps = survey.sweeps_each[spec.sensor]
    sensor = survey.mounted_sensors[spec.sensor].sensor
    sweep = np.searchsorted(sweeps.firsts, points.scan, "right") - 1
    per_station = len(sweeps.firsts) // survey.path.stations
    has_next = (sweep + 1) % per_station != 0
    following = np.minimum(sweep + 1, len(sweeps.firsts) - 1)
    later_ns = points.times_ns + (sweeps.starts_ns[following] - sweeps.starts_ns[sweep])
    # Of two complete sweeps, one can have one firing more than the other.
    interval_ns = sweeps.starts_ns[following] - sweeps.stops_ns[sweep]
    last_firing_ns = sensor.beams.time_ns.max() - sensor.lead_ns + _ROUNDING_NS
    has_next &= later_ns <= sweeps.stops_ns[following] + interval_ns + last_firing_ns
    return sweep, np.where(has_next, later_ns, np.nan)


def _block_flow(
    survey: Survey,
    spec: ScanSpec,
    points: SurfacePoints,
    ends: Floats,
    sweep: Ints,
    later_ns: Floats,
) -> SceneFlow:
    """Express the displacements from points to their later positions in the frame of the points.

    `ends` (n, 3) are the later positions in the scene frame.
    """
    in_world = ends - points.positions
    if survey.coordinates == "sensor":
        return _flow_as_fired(survey, spec, points, ends, later_ns)
    if not survey.path.moves:
        return SceneFlow(in_world, in_world)
    relative = np.empty_like(ends)
    starts_ns = survey.sweeps_each[spec.sensor].starts_ns
    for number in np.unique(sweep).tolist():
        rows = np.flatnonzero(sweep == number)
        positions, rotations = _sensor_poses(survey, spec, starts_ns[number : number + 2])
        start = rotate(points.positions[rows] - positions[0], rotations[0].T)
        end = rotate(ends[rows] - positions[1], rotations[1].T)
        relative[rows] = rotate(end - start, rotations[0])
    return SceneFlow(relative, in_world)


def _flow_as_fired(
    survey: Survey, spec: ScanSpec, points: SurfacePoints, ends: Floats, later_ns: Floats
) -> SceneFlow:
    """Return the displacements in the sensor frames at the firing times."""
    positions, rotations = _sensor_poses(survey, spec, points.times_ns)
    later_positions, later_rotations = _sensor_poses(survey, spec, later_ns)
    start = rotate_into_frames(points.positions - positions, rotations)
    end = rotate_into_frames(ends - later_positions, later_rotations)
    return SceneFlow(end - start, rotate_into_frames(ends - points.positions, rotations))


def _sensor_poses(survey: Survey, spec: ScanSpec, times_ns: Floats) -> tuple[Floats, Floats]:
    """Return the positions (k, 3) and rotations (k, 3, 3) of the sensor in the scene frame.

    `times_ns` (k,) are nanoseconds since the start of the survey.
    """
    mount = survey.mounted_sensors[spec.sensor].mount
    since_ns = np.clip(times_ns - spec.start_ns, 0, survey.path.duration_ns)
    return mounted_poses(survey.path, spec.station, mount, since_ns)

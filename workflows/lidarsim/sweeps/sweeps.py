"""Times and poses of the sweeps in a survey, for file formats that store individual sweeps."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import combinations, pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..columns.actor_rays import ACTOR_RAYS, NO_ACTOR_RAYS, merge_actor_rays
from ..columns.cloud import Cloud, CloudLike
from ..columns.table import FLOW, FLOW_EGO, NORMAL, ORIGIN, TABLE
from ..errors import LidarError
from ..io.archives import open_archive, pack_arrays
from ..motion.rotations import matrices, quaternions_of
from ..motion.trajectory import mounted_poses
from ..numerics.arrays import (
    AnyArray,
    AnyFloats,
    Bools,
    Bytes,
    Floats,
    Floats32,
    Ints,
    Ints32,
    Records,
)
from ..scene.scene import Scene
from ..scene.transform import affine
from ..sensor import Sensor
from ..sensor.optics import SINGLE_RETURN, TWO_RETURNS
from ..sensor.plain_data import from_plain_data, to_plain_data
from ..survey.faults import Fault
from ..survey.survey import Survey, nanoseconds
from .actor_sweeps import NO_ROWS, ActorSweeps
from .instruments import Instruments
from .lidar_traits import LidarTraits
from .sweep_motion import STILL, FiringPoses, FlowFrames, compute_knots, interpolate_poses

SWEEPS_FILE = "sweeps.npz"
MIXED_UP = (
    "The points are not in scan order, or come from a different survey than the "
    f"sweeps ({SWEEPS_FILE}). Use both from one run, and keep the order."
)
# Descriptions of the coordinate frame of points, which are written to files.
COMPENSATED = "points in the sensor frame at the start of the sweep (motion is compensated)"
AS_FIRED = "points in the sensor frame at the time of firing (motion is not compensated)"
UNKNOWN_MOTION = "points in the sensor frame (motion compensation is unknown)"
IN_WORLD = "points in world coordinates"
_ACTORS_AT_START = "; points of actors are moved to the start of the sweep"
_NO_KNOTS = np.empty((0, 7), np.float32)
_PIECE = 250_000  # points to read at a time; several threads or tasks may read concurrently
_FORMAT = 9
# Fields of `Sweeps` that are stored under their own names, either as arrays or as JSON.
_ARRAY_FIELDS = (
    "scans", "begins_ns", "ends_ns", "sensor", "actor_velocities", "actor_bounds", "actor_there",
    "actor_comes", "actor_leaves", "actor_rows", "actor_knots", "knots",
)  # fmt: skip
_JSON_FIELDS = (
    "sensors", "objects", "actors", "coordinates", "precision_m", "epsg", "start_ns", "stations",
    "station_ns",
)  # fmt: skip


def states_compensation(frame_text: str) -> bool | None:
    """Return whether a frame description states that motion is compensated.

    Returns None if the description does not mention motion compensation.

    Examples
    --------
    >>> states_compensation(COMPENSATED), states_compensation(AS_FIRED)
    (True, False)
    """
    match = re.search(r"motion is (not )?compensated", frame_text)
    return None if match is None else match[1] is None


def number_positions(positions: Floats) -> Ints:
    """Assign numbers to positions in order of first occurrence, starting at 1.

    Equal positions have the same number. The positions have shape (n, 3), and the result has dtype
    int64 and shape (n,).

    Examples
    --------
    >>> number_positions(np.array([[5.0, 0, 0], [1, 0, 0], [5, 0, 0]]))
    array([1, 2, 1])
    """
    _, first, group = np.unique(positions, axis=0, return_index=True, return_inverse=True)
    number = np.empty(len(first), np.int64)
    number[np.argsort(first)] = np.arange(1, len(first) + 1)
    return np.asarray(number[group.ravel()])


@dataclass(frozen=True, eq=False)
class SweepPoses:
    """Poses of a sensor, platform or actor at the start of each sweep."""

    positions: Floats  # (n, 3), world coordinates, meters
    quaternions: Floats  # (n, 4), x, y, z, w of the rotation from the body frame to the world frame

    @cached_property
    def rotations(self) -> Floats:
        """Rotation matrices from the body frame to the world frame.

        The shape is (n, 3, 3).
        """
        return matrices(self.quaternions)

    @cached_property
    def quaternion_matrices(self) -> Floats:
        """Matrices that convert quaternions to the body frame.

        The shape is (n, 4, 4). Multiplying quaternions by these matrices is much faster than
        composing rotation matrices.
        """
        x, y, z, w = self.quaternions.T
        rows = [[w, -z, y, x], [z, w, -x, y], [-y, x, w, z], [-x, -y, -z, w]]
        return np.moveaxis(np.array(rows), -1, 0)

    def matrix(self, sweep: int) -> Floats:
        """Return the transformation from the body frame to the world frame at the start of a sweep.

        The shape is (4, 4).
        """
        return affine(self.rotations[sweep], self.positions[sweep])

    def to_body_frame(self, sweep: int, points: Floats) -> Floats:
        """Transform points from the world frame to the body frame at the start of a sweep."""
        in_frame: Floats = (points - self.positions[sweep]) @ self.rotations[sweep]
        return in_frame


@dataclass(frozen=True, eq=False)
class FiredRays:
    """Description of all rays in each sweep, with and without returns."""

    sensors: tuple[Sensor, ...]
    # Maximum number of reported returns of a pulse for each sensor, or 1 if it is unknown.
    returns_per_pulse: tuple[int, ...]
    steps: Ints  # (n,), first time step of each sweep, counted from the start of its station
    seeds: tuple[int, ...]  # noise seed of each sensor, on which dropped packets depend


@dataclass(frozen=True, eq=False)
class Sweeps:
    """All sweeps in a survey.

    A sweep consists of the scans in one revolution or frame of a sensor.
    """

    scans: Ints  # (n + 1,), first scan of each sweep, followed by the total number of scans
    begins_ns: Floats  # (n,), start of each sweep, nanoseconds since the start of the survey
    ends_ns: Floats  # (n,), start of the last firing in each sweep
    sensor: Bytes  # (n,), sensor index
    pose: SweepPoses  # sensor poses
    mounts: SweepPoses  # mount of each sensor in the platform frame
    sensors: tuple[str, ...]  # names
    objects: tuple[str, ...]  # names
    actors: tuple[str, ...]  # names; in the `object` column, actors follow the objects
    actor_poses: SweepPoses  # actor poses with shape (a, n)
    actor_velocities: Floats  # (a, n, 3), velocities of the box centers, world frame, m/s
    # (a, 2, 3), corners of each actor's box in the actor frame, meters. If the mesh deforms, the
    # box contains all its shapes.
    actor_bounds: Floats
    actor_there: Bools  # (a, n), whether the actor is present at the start of the sweep
    actor_comes: Bools  # (a, n), whether the actor appears during the sweep
    actor_leaves: Bools  # (a, n), whether the actor leaves during the sweep
    coordinates: str  # frame of the points in the cloud, "world" or "sensor"
    precision_m: float  # positions are rounded to multiples of this value
    epsg: int | None = None  # EPSG code of the world coordinate system
    start_ns: int | None = None  # start of the survey, nanoseconds since 1970-01-01 UTC
    instruments: Instruments | None = None  # instruments on the platform
    fired: FiredRays | None = None  # None unless the survey stores every return with its ray
    classes: Mapping[int, str] = field(default_factory=dict, compare=False)  # {number: name}
    faults: tuple[Fault, ...] = ()  # faults of all sensors
    materials: tuple[str, ...] = ()  # names; the `material` column contains indices
    lidars: tuple[LidarTraits, ...] = ()  # traits of each sensor, or empty if unknown
    knots: Floats32 = field(default_factory=lambda: STILL)  # (n, m, 7); see `compute_knots`
    stations: int = 1  # number of stations, which all have the same number of sweeps per sensor
    station_ns: int = 0  # time between the starts of consecutive stations
    # (a, n), row in `actor_knots` for each actor and sweep, or -1 if the actor is static or absent.
    # The array is empty if no actor moves.
    actor_rows: Ints32 = field(default_factory=lambda: NO_ROWS)
    actor_knots: Floats32 = field(default_factory=lambda: STILL)  # (r, k, 7); see `ActorSweeps`
    # (a, n), visibility records of each actor in each sweep, of type `ACTOR_RAYS`. The array is
    # empty if the survey does not determine the visibility of actors.
    actor_rays: Records = field(default_factory=lambda: NO_ACTOR_RAYS[None])
    # Whether `points` moves points on actors to their positions at the start of the sweep.
    actors_at_start: bool = False
    # Description of the points' coordinate frame for files. If it is empty, it follows from the
    # points that a format stores.
    stated_frame: str = ""

    def __len__(self) -> int:
        return len(self.begins_ns)

    def with_actor_rays(self, parts: Iterable[Records]) -> Sweeps:
        """Return a copy with the visibility of actors, given the records of all scans."""
        table = merge_actor_rays(parts, len(self.actors), len(self))
        return replace(self, actor_rays=table)

    def in_sensor(self, sweep: int, points: AnyFloats) -> Floats:
        """Return the points of a sweep in the sensor frame at the start of the sweep.

        If the points are already stored in the sensor frame, they are returned unchanged.
        """
        exact = points.astype(np.float64)
        return exact if self.coordinates == "sensor" else self.pose.to_body_frame(sweep, exact)

    def columns_in_sensor(self, sweep: int, points: Cloud) -> dict[str, AnyArray]:
        """Return the columns of a sweep, with vectors in the sensor frame at its start.

        Vectors that are already stored in the sensor frame are returned unchanged.
        """
        if self.coordinates == "sensor":
            return dict(points.columns)
        return _with_vectors(
            points,
            lambda normals: normals @ self.pose.rotations[sweep],
            lambda origins: self.pose.to_body_frame(sweep, origins),
        )

    def columns_as_fired(self, sweep: int, points: Cloud) -> dict[str, AnyArray]:
        """Return the columns of a sweep, with vectors in the sensor frame at the firing times."""
        if self.coordinates == "sensor":
            return dict(points.columns)
        poses = self.firing_poses(sweep, points)
        return _with_vectors(
            points,
            poses.rotate_to_body_frame,
            poses.to_body_frame,
            partial(self._flow_as_fired, sweep, points),
        )

    def columns_compensated(self, sweep: int, points: Cloud) -> dict[str, AnyArray]:
        """Return the columns of a sweep, with vectors in the sensor frame at its start.

        Vectors that are stored in the sensor frame are compensated for motion.
        """
        if self.coordinates != "sensor":
            return self.columns_in_sensor(sweep, points)
        poses = self.firing_poses(sweep, points)
        return _with_vectors(
            points,
            lambda normals: poses.rotate_to_world(normals) @ self.pose.rotations[sweep],
            lambda origins: self.pose.to_body_frame(sweep, poses.to_world(origins)),
            partial(self._flow_compensated, sweep, points),
        )

    def _flow_as_fired(self, sweep: int, points: Cloud, flow: Floats) -> Floats:
        """Convert the flow of points in world coordinates to the frames at the firing times."""
        start = points.positions.astype(np.float64)
        ends = self._flow_frames(sweep, points).end_points(start, flow @ self.pose.rotations[sweep])
        return self._flow_frames(sweep, points, as_fired=True).flow(start, ends)

    def _flow_compensated(self, sweep: int, points: Cloud, flow: Floats) -> Floats:
        """Convert the flow of points in the sensor frame to the frames at the starts of sweeps."""
        fired = self._flow_frames(sweep, points, as_fired=True)
        start = fired.current.to_world(points.positions.astype(np.float64))
        return self._flow_frames(sweep, points).flow(start, fired.end_points(start, flow))

    def _flow_frames(self, sweep: int, points: Cloud, *, as_fired: bool = False) -> FlowFrames:
        """Return the sensor frames of a sweep and the next sweep.

        The frames are those at the firing time of each point, or those at the start of the sweeps.
        """
        following = self._following(sweep)
        if as_fired:
            return FlowFrames(
                self.firing_poses(sweep, points),
                self._sensor_firing_poses(following, self._shares(sweep, points, following)),
            )
        current, later = (
            FiringPoses(self.pose.positions[number], self.pose.rotations[number])
            for number in (sweep, following)
        )
        return FlowFrames(current, later)

    def _following(self, sweep: int) -> int:
        """Return the next sweep, or the last sweep if there is none, in which case flow is NaN."""
        return min(sweep + 1, len(self) - 1)

    def as_fired(self, sweep: int, points: Cloud, poses: FiringPoses | None = None) -> Floats:
        """Return the points of a sweep in the sensor frame at the firing time of each point.

        `poses` are the firing poses of the points, if they are already known.
        """
        exact = points.positions.astype(np.float64)
        if self.coordinates == "sensor":
            return exact
        return (poses or self.firing_poses(sweep, points)).to_body_frame(exact)

    def compensate_motion(self, sweep: int, points: Cloud) -> Floats:
        """Return the points of a sweep in the sensor frame at the start of the sweep.

        Points that are stored in the sensor frame are compensated for motion.
        """
        exact = points.positions.astype(np.float64)
        if self.coordinates == "sensor":
            exact = self.firing_poses(sweep, points).to_world(exact)
        return self.pose.to_body_frame(sweep, exact)

    def firing_poses(self, sweep: int, points: Cloud) -> FiringPoses:
        """Return the sensor poses at the firing times of the points in a sweep.

        If there is no `time` column, the points are assumed to be fired in the middle of their
        scans.
        """
        return self._sensor_firing_poses(sweep, self._shares(sweep, points))

    @property
    def has_single_returns(self) -> bool:
        """Whether no sensor reports more than one return per pulse. False if this is unknown."""
        return bool(self.lidars) and all(lidar.mode in SINGLE_RETURN for lidar in self.lidars)

    def span_ns(self, sweep: int) -> float:
        """Return the duration from the start of a sweep to its last beam, in nanoseconds."""
        firing_ns = self.lidars[self.sensor[sweep]].firing_ns if self.lidars else 0.0
        return float(self.ends_ns[sweep] - self.begins_ns[sweep]) + firing_ns

    def _shares(self, sweep: int, points: Cloud, span_of: int | None = None) -> Floats:
        """Return the fraction of the sweep that has elapsed when each point is fired.

        If `span_of` is set, the fractions are those of the corresponding firings in that sweep.
        """
        span_ns = self.span_ns(sweep if span_of is None else span_of)
        return np.clip(self.since_ns(sweep, points) / max(span_ns, 1.0), 0, 1)

    def _sensor_firing_poses(self, sweep: int, shares: Floats) -> FiringPoses:
        """Return the sensor poses at the given fractions of a sweep."""
        knots = self.knots[sweep] if len(self.knots) else _NO_KNOTS
        return interpolate_poses(
            knots, self.pose.positions[sweep], self.pose.rotations[sweep], shares
        )

    def _actor_firing_poses(self, actor: int, sweep: int, shares: Floats) -> FiringPoses:
        """Return the poses of an actor at the given fractions of a sweep."""
        row = self.actor_rows[actor, sweep] if len(self.actor_rows) else -1
        knots = self.actor_knots[row] if row >= 0 else _NO_KNOTS
        (rotation,) = matrices(self.actor_poses.quaternions[actor, [sweep]])
        return interpolate_poses(knots, self.actor_poses.positions[actor, sweep], rotation, shares)

    def platform_poses_at(self, sweep: int, shares: Floats) -> SweepPoses:
        """Return the platform poses at the given fractions of a sweep.

        `shares` has shape (k,). Values slightly greater than 1 are extrapolated.
        """
        positions, rotations = self._sensor_firing_poses(sweep, shares).frames(len(shares))
        number = self.sensor[sweep]
        (mount,) = matrices(self.mounts.quaternions[[number]])
        rotations = rotations @ mount.T
        return _poses_of(positions - rotations @ self.mounts.positions[number], rotations)

    def actor_poses_at(self, actor: int, sweep: int, shares: Floats) -> SweepPoses:
        """Return the poses of an actor at the given fractions of a sweep.

        `shares` has shape (k,). Values slightly greater than 1 are extrapolated.
        """
        return _poses_of(*self._actor_firing_poses(actor, sweep, shares).frames(len(shares)))

    def with_actors_at_start(self, sweep: int, points: Cloud) -> Cloud:
        """Move the points on actors to their positions at the start of the sweep.

        Each point is transformed by the inverse of the actor pose at the firing time, followed by
        the actor pose at the start of the sweep. All points on a rigid actor are then inside its
        box. Points that a frozen sensor repeats are not moved.
        """
        frozen = any(fault.kind == "frozen" for fault in self.faults_in(sweep))
        actor = points["object"].astype(np.int64) - len(self.objects)
        rows = np.flatnonzero(actor >= 0)
        if len(self.actor_rows) and not frozen:
            rows = rows[self.actor_rows[actor[rows], sweep] >= 0]
        if not len(self.actor_rows) or frozen or not len(rows):
            return points
        moved = points[rows]
        owners = actor[rows]
        fractions = self._shares(sweep, moved)
        sensor = (
            self._sensor_firing_poses(sweep, fractions) if self.coordinates == "sensor" else None
        )
        masks = {owner: owners == owner for owner in np.unique(owners).tolist()}
        bodies = {
            owner: self._actor_firing_poses(owner, sweep, fractions[mask])
            for owner, mask in masks.items()
        }

        def at_start(positions: Floats) -> Floats:
            in_world = positions if sensor is None else sensor.to_world(positions)
            for owner, mask in masks.items():
                in_world[mask] = bodies[owner].move_to_start(in_world[mask])
            return in_world if sensor is None else sensor.to_body_frame(in_world)

        def turned(normals: Floats) -> Floats:
            in_world = normals if sensor is None else sensor.rotate_to_world(normals)
            for owner, mask in masks.items():
                in_world[mask] = bodies[owner].rotate_to_start(in_world[mask])
            return in_world if sensor is None else sensor.rotate_to_body_frame(in_world)

        positions = points.positions.astype(np.float64)
        positions[rows] = at_start(positions[rows])
        columns = dict(points.columns)
        converted = _with_vectors(moved, turned, lambda origins: origins)
        converted |= self._flow_of_actors_at_start(sweep, moved, masks)
        for name, values in converted.items():
            if name in (*NORMAL, *FLOW, *FLOW_EGO):
                columns[name] = columns[name].copy()
                columns[name][rows] = values
        return replace(points, positions=positions, columns=columns)

    def _flow_of_actors_at_start(
        self, sweep: int, points: Cloud, masks: Mapping[int, Bools]
    ) -> dict[str, AnyArray]:
        """Return the flow of points on actors between the starts of a sweep and the next sweep.

        `masks` contains a mask of the points on each actor.
        """
        names = [name for name in (FLOW, FLOW_EGO) if points.columns.keys() >= {*name}]
        if not names:
            return {}
        in_sensor = self.coordinates == "sensor"
        frames = self._flow_frames(sweep, points, as_fired=in_sensor)
        start = points.positions.astype(np.float64)
        start = frames.current.to_world(start) if in_sensor else start
        vectors = _stacked(points.columns, names[0])
        if not in_sensor:
            vectors = frames.current.rotate_to_body_frame(vectors)
        ends = (
            frames.end_points(start, vectors)
            if names[0] == FLOW
            else start + frames.current.rotate_to_world(vectors)
        )
        following = self._following(sweep)
        shares = self._shares(sweep, points), self._shares(sweep, points, following)
        for actor, mask in masks.items():
            now = self._actor_firing_poses(actor, sweep, shares[0][mask])
            later = self._actor_firing_poses(actor, following, shares[1][mask])
            start[mask] = now.move_to_start(start[mask])
            ends[mask] = later.move_to_start(ends[mask])
        values = {FLOW: frames.flow(start, ends)}
        values[FLOW_EGO] = frames.current.rotate_to_body_frame(ends - start)
        if not in_sensor:
            values = {name: frames.current.rotate_to_world(v) for name, v in values.items()}
        return {
            component: axis.astype(TABLE[component].dtype)
            for name in names
            for component, axis in zip(name, values[name].T, strict=True)
        }

    def since_ns(self, sweep: int, points: Cloud) -> Floats:
        """Return the firing times of points in nanoseconds since the start of their sweep.

        Jumps in the sensor clock are removed.
        """
        begin_ns = self.begins_ns[sweep]
        end_ns = self.ends_ns[sweep]
        first, stop = self.scans[sweep : sweep + 2]
        by_scan = (points["scan"] + 0.5 - first) / (stop - first) * (end_ns - begin_ns)
        if "time" not in points.columns:
            return np.asarray(by_scan, np.float64)
        stamps = points["time"].astype(np.int64)
        sensors = None, self.sensors[self.sensor[sweep]] if self.sensors else None
        jumps = [
            jump for jump in self.faults if jump.kind == "time_jump" and jump.sensor in sensors
        ]
        since_begin = stamps - begin_ns
        if not jumps:
            return np.asarray(since_begin, np.float64)
        smallest_distance = np.full(len(stamps), np.inf)
        for count in range(1 + len(jumps)):
            for faults in combinations(jumps, count):
                candidate = stamps - sum(round((fault.by_s or 0) * 1e9) for fault in faults)
                stated_stamps = sum((fault.time_errors_ns(candidate) for fault in jumps), candidate)
                # If several times are consistent with a timestamp, use the one that is closest to
                # the scan of the point.
                distance = np.abs(candidate - begin_ns - by_scan)
                better = (stated_stamps == stamps) & (distance < smallest_distance)
                since_begin = np.where(better, candidate - begin_ns, since_begin)
                smallest_distance = np.where(better, distance, smallest_distance)
        return np.asarray(since_begin, np.float64)

    def frame_text(self, *, compensated: bool) -> str:
        """Return the description of the points' coordinate frame for files.

        `compensated` states whether the format stores motion-compensated points.
        """
        text = self.stated_frame or (COMPENSATED if compensated else AS_FIRED)
        return text + _ACTORS_AT_START if self.actors_at_start else text

    @cached_property
    def platform(self) -> SweepPoses:
        """Platform poses at the start of each sweep."""
        mounts = matrices(self.mounts.quaternions)[self.sensor]
        rotations = matrices(self.pose.quaternions) @ mounts.transpose(0, 2, 1)
        lever_arms = np.einsum("nij,nj->ni", rotations, self.mounts.positions[self.sensor])
        return _poses_of(self.pose.positions - lever_arms, rotations)

    @cached_property
    def object_names(self) -> tuple[str, ...]:
        """Names of the objects, followed by those of the actors.

        The `object` column contains indices into this tuple.
        """
        return (*self.objects, *self.actors)

    @cached_property
    def actor_types(self) -> list[str]:
        """Types of the actors."""
        return [actor_type(actor) for actor in self.actors]

    @cached_property
    def station_numbers(self) -> Ints:
        """Station number of each sweep, starting at 1, or 0 if the survey has only one station.

        If a sensor returns to a station, the station keeps its number. The shape is (n,).
        """
        numbers = np.zeros(len(self), np.int64)
        if self.stations > 1:
            for sensor in np.unique(self.sensor):
                of_sensor = self.sensor == sensor
                numbers[of_sensor] = number_positions(self.pose.positions[of_sensor])
        return numbers

    @cached_property
    def numbers(self) -> Ints:
        """Index of each sweep among the sweeps from its sensor, starting at 0.

        The shape is (n,).
        """
        return np.arange(len(self)) - np.searchsorted(self.sensor, self.sensor)

    @classmethod
    def unknown(cls) -> Sweeps:
        """Create placeholder sweeps for points from an unknown survey.

        The precision is 1 mm.
        """
        none = SweepPoses(np.empty((0, 3)), np.empty((0, 4)))
        return cls(
            scans=np.zeros(1, np.int64),
            begins_ns=np.empty(0),
            ends_ns=np.empty(0),
            sensor=np.empty(0, np.uint8),
            pose=none,
            mounts=none,
            sensors=(),
            objects=(),
            actors=(),
            actor_poses=none,
            actor_velocities=np.empty((0, 0, 3)),
            actor_bounds=np.empty((0, 2, 3)),
            actor_there=np.empty((0, 0), bool),
            actor_comes=np.empty((0, 0), bool),
            actor_leaves=np.empty((0, 0), bool),
            coordinates="world",
            precision_m=0.001,
        )

    @classmethod
    def from_survey(cls, survey: Survey, scene: Scene) -> Sweeps:
        """Compute the sweeps of a survey in a scene."""
        by_sensor = [
            _sensor_sweeps(survey, number) for number in range(len(survey.mounted_sensors))
        ]
        begins_ns = np.concatenate([starts for _, starts, _ in survey.sweeps_each])
        ends_ns = np.concatenate([stops for _, _, stops in survey.sweeps_each])
        firsts = [first_scans for first_scans, _, _ in survey.sweeps_each]
        positions = np.concatenate([sweeps.positions for sweeps in by_sensor])
        rotations = np.concatenate([sweeps.rotations for sweeps in by_sensor])
        mounts = survey.reported_mounts
        traits = tuple(
            LidarTraits.from_sensor(carried.sensor, returns.mode)
            for carried, returns in zip(survey.mounted_sensors, survey.returns_each, strict=True)
        )
        sensor = np.concatenate(
            [np.full(len(first), n, np.uint8) for n, first in enumerate(firsts)]
        )
        firing_ns = np.array([lidar.firing_ns for lidar in traits])[sensor]
        actors = ActorSweeps.from_scene(scene, begins_ns, ends_ns + firing_ns)
        actor_quaternions = _poses_of(
            actors.positions.reshape(-1, 3), actors.rotations.reshape(-1, 3, 3)
        ).quaternions
        return cls(
            scans=np.append(np.concatenate(firsts), survey.scan_count),
            begins_ns=begins_ns,
            ends_ns=ends_ns,
            sensor=sensor,
            pose=_poses_of(positions + scene.origin, rotations),
            mounts=_poses_of(
                np.array([mount.position for mount in mounts]),
                np.array([mount.rotation_matrix for mount in mounts]),
            ),
            sensors=tuple(carried.name for carried in survey.mounted_sensors),
            objects=tuple(scene.names),
            actors=tuple(actor.name for actor in scene.actors),
            actor_poses=SweepPoses(
                actors.positions, actor_quaternions.reshape(*actors.positions.shape[:2], 4)
            ),
            actor_velocities=actors.velocities,
            actor_bounds=actors.bounds,
            actor_there=actors.present,
            actor_comes=actors.comes,
            actor_leaves=actors.leaves,
            actor_rows=actors.rows,
            actor_knots=actors.knots,
            coordinates=survey.coordinates,
            precision_m=survey.precision_m,
            epsg=survey.epsg,
            start_ns=None if survey.start is None else nanoseconds(survey.start),
            instruments=Instruments.from_survey(survey),
            fired=_fired_rays(survey, [sweeps.first_steps for sweeps in by_sensor]),
            classes=survey.classes,
            faults=tuple(survey.faults),
            materials=scene.material_names,
            lidars=traits,
            knots=compute_knots(survey, traits, rotations),
            stations=survey.path.stations,
            station_ns=survey.station_ns,
        )

    def faults_in(self, sweep: int) -> tuple[Fault, ...]:
        """Return the faults that occur during a sweep.

        A sweep is frozen only if the fault is present at its start.
        """
        sensors = None, self.sensors[self.sensor[sweep]]
        begin = self.begins_ns[sweep]
        end = self.ends_ns[sweep]
        sensor_faults = (fault for fault in self.faults if fault.sensor in sensors)
        return tuple(
            fault
            for fault in sensor_faults
            if fault.is_active(begin, None if fault.kind == "frozen" else end)
        )

    def stamp_ns(self, sweep: int) -> int:
        """Return the start of a sweep according to the sensor clock.

        The time is in nanoseconds since the start of the survey.
        """
        begin = self.begins_ns[sweep]
        return round(begin) + sum(
            int(fault.time_errors_ns(begin)) for fault in self.faults_in(sweep)
        )

    def points(self, cloud: CloudLike, first: int = 0, stop: int | None = None) -> Iterator[Cloud]:
        """Yield the points of each sweep from `first` up to `stop`, including empty sweeps.

        If `actors_at_start` is set, points on actors are moved to their positions at the start of
        the sweep.

        Raises
        ------
        LidarError
            If the points are not in scan order, or if they belong to a different survey.
        """
        sweeps = self._points(cloud, first, len(self) if stop is None else stop)
        if not self.actors_at_start:
            yield from sweeps
            return
        for sweep, points in enumerate(sweeps, first):
            yield self.with_actors_at_start(sweep, points)

    def _points(self, cloud: CloudLike, first: int, stop: int) -> Iterator[Cloud]:
        """Yield the points of each sweep from `first` up to `stop` at their stored positions."""
        sweep_parts: list[Cloud] = []

        def joined() -> Cloud:
            if sweep_parts:
                return Cloud.concatenate(sweep_parts)
            return Cloud(np.empty((0, 3)), {c.name: np.empty(0, c.dtype) for c in cloud.table})

        current = first
        start_row, piece = 0, _PIECE
        if first or stop < len(self):  # read no more than these sweeps
            start_row, stop_row = map(cloud.row_of, self.scans[[first, stop]].tolist())
            piece = min(_PIECE, max(stop_row - start_row, 1))
        for chunk in cloud.chunks(piece, start_row):
            sweep = np.searchsorted(self.scans, chunk["scan"], "right") - 1
            if sweep[0] < current or sweep[-1] >= len(self) or (np.diff(sweep) < 0).any():
                raise LidarError(MIXED_UP)
            end = int(np.searchsorted(sweep, stop))
            starts = np.flatnonzero(np.diff(sweep[:end], prepend=-1))
            for start, stop_row in pairwise([*starts, end]):
                while current < sweep[start]:
                    yield joined()
                    sweep_parts = []
                    current = current + 1
                is_whole = stop_row - start == len(chunk)
                sweep_parts.append(chunk if is_whole else chunk[start:stop_row])
            if end < len(sweep):
                break
        while current < stop:
            yield joined()
            sweep_parts = []
            current = current + 1

    def save(self, path: Path) -> None:
        """Write the sweeps to an NPZ file.

        Raises
        ------
        OSError
            If the file cannot be written.
        """
        path.write_bytes(self.to_bytes())

    def to_bytes(self) -> bytes:
        """Serialize the sweeps as an NPZ archive.

        Equal sweeps result in equal bytes.
        """
        values = {"format": _FORMAT, **{name: getattr(self, name) for name in _JSON_FIELDS}}
        values["lidars"] = [lidar.to_json() for lidar in self.lidars]
        if self.instruments is not None:
            values["instruments"] = self.instruments.to_json()
        values |= {"classes": dict(self.classes)} if self.classes else {}
        values |= {"materials": self.materials} if self.materials else {}
        values |= {"faults": [fault.to_dict() for fault in self.faults]} if self.faults else {}
        arrays: dict[str, Any] = {"words": np.frombuffer(json.dumps(values).encode(), np.uint8)}
        arrays |= {name: getattr(self, name) for name in _ARRAY_FIELDS}
        poses_by_prefix = {"": self.pose, "mount_": self.mounts, "actor_": self.actor_poses}
        for prefix, poses in poses_by_prefix.items():
            arrays[f"{prefix}positions"] = poses.positions
            arrays[f"{prefix}quaternions"] = poses.quaternions
        if self.actor_rays.size:
            arrays["actor_rays"] = self.actor_rays.view(np.uint8)
        if self.fired is not None and (sensors := to_plain_data(self.fired.sensors, arrays)):
            rays = {
                "sensors": sensors,
                "returns": self.fired.returns_per_pulse,
                "seeds": self.fired.seeds,
            }
            arrays["rays"] = np.frombuffer(json.dumps(rays).encode(), np.uint8)
            arrays["steps"] = self.fired.steps
        return pack_arrays(arrays)

    @classmethod
    def load_coordinates(cls, path: Path | str, read: Callable[[], bytes] | None = None) -> str:
        """Load only the frame of the points in the cloud, "world" or "sensor".

        Parameters and errors are those of `load`.
        """
        with open_archive(path, read) as arrays:
            return str(_stored_words(arrays)["coordinates"])

    @classmethod
    def load(cls, path: Path | str, read: Callable[[], bytes] | None = None) -> Sweeps:
        """Read sweeps from a file written by `save`, without unpickling objects.

        `read` is a function that returns the content of the file (default: read `path`).

        Raises
        ------
        LidarError
            If the file cannot be read, is damaged, or was written by a different version.
        """
        with open_archive(path, read) as arrays:
            values = _stored_words(arrays)
            values |= {name: tuple(values[name]) for name in ("sensors", "objects", "actors")}
            pose, mounts, actor_poses = (
                SweepPoses(arrays[f"{prefix}positions"], arrays[f"{prefix}quaternions"])
                for prefix in ("", "mount_", "actor_")
            )
            instruments = values.get("instruments")
            fired = None
            if "rays" in arrays:
                rays = json.loads(arrays["rays"].tobytes())
                sensors = from_plain_data(rays["sensors"], arrays)
                returns, seeds = tuple(rays["returns"]), tuple(rays["seeds"])
                fired = FiredRays(sensors, returns, arrays["steps"], seeds)
            if "actor_rays" in arrays:
                values["actor_rays"] = arrays["actor_rays"].view(ACTOR_RAYS)
            return cls(
                fired=fired,
                pose=pose,
                mounts=mounts,
                actor_poses=actor_poses,
                instruments=instruments and Instruments.from_json(instruments, Path(path).parent),
                classes={int(number): name for number, name in values.get("classes", {}).items()},
                lidars=tuple(LidarTraits.from_json(lidar) for lidar in values["lidars"]),
                faults=tuple(Fault(**fault) for fault in values.get("faults", ())),
                materials=tuple(values.get("materials", ())),
                **{name: arrays[name] for name in _ARRAY_FIELDS},
                **{name: values[name] for name in _JSON_FIELDS},
                **{name: values[name] for name in ("actor_rays",) if name in values},
            )


def _stored_words(arrays: Mapping[str, AnyArray]) -> dict[str, Any]:
    """Return the values that an archive of sweeps stores as JSON.

    Raise ValueError if it has a different format.
    """
    values: dict[str, Any] = json.loads(arrays["words"].tobytes())
    if values["format"] != _FORMAT:
        raise ValueError(f"its format is {values['format']}, but {_FORMAT} is required")
    return values


def actor_type(name: str) -> str:
    """Return the type of an actor for labels, given its name.

    The type is the name without a trailing number and with underscores in place of spaces.

    Examples
    --------
    >>> [actor_type(name) for name in ("Car 1", "Car (b.2)", "Delivery van", "7")]
    ['Car', 'Car', 'Delivery_van', '7']
    """
    plain = re.sub(r"(\s*\([^()]*\)|[\s._-]*\d+)$", "", name.strip())
    return re.sub(r"\s+", "_", plain or name.strip())


def make_identifiers(names: Iterable[str]) -> list[str]:
    """Convert names to unique identifiers that are valid as ROS names and folder names.

    Examples
    --------
    >>> make_identifiers(["roof", "left/rear", "left rear", "2nd"])
    ['roof', 'left_rear', 'left_rear_2', '_2nd']
    """
    unique: list[str] = []
    for name in names:
        plain = allowed = re.sub(r"^(?=\d)|\W", "_", name, flags=re.ASCII)
        number = 1
        while plain in unique:
            number += 1
            plain = f"{allowed}_{number}"
        unique.append(plain)
    return unique


class _SensorSweeps(NamedTuple):
    """Sensor poses and first time steps of the sweeps from a single sensor."""

    positions: Floats  # (n, 3), sensor position at the start of each sweep, scene frame, meters
    rotations: Floats  # (n, 3, 3)
    first_steps: Ints  # (n,), first time step of each sweep, counted from the start of its station


def _sensor_sweeps(survey: Survey, number: int) -> _SensorSweeps:
    """Compute the sweeps of the sensor with index `number` in a survey."""
    path = survey.reported_path
    mount = survey.reported_mounts[number]
    firsts, starts, _ = survey.sweeps_each[number]
    times = starts[: len(starts) // path.stations]
    positions = []
    rotations = []
    for station in range(path.stations):
        station_positions, station_rotations = mounted_poses(path, station, mount, times)
        positions.append(station_positions)
        rotations.append(station_rotations)
    specs = [survey.sent_scan(scan) for scan in firsts.tolist()]
    # While a sensor is frozen, it repeats scans that were simulated earlier.
    cast_scans = np.array([spec.scan + spec.random_offset for spec in specs])
    first_steps = (cast_scans - firsts[0]) % survey.steps_each[number]
    return _SensorSweeps(np.concatenate(positions), np.concatenate(rotations), first_steps)


def _fired_rays(survey: Survey, first_steps: list[Ints]) -> FiredRays | None:
    """Describe all rays in a survey, or return None if any return is stored without its ray."""
    if survey.keep_every != 1 or all(c.name != "ray" for c in survey.stored_columns):
        return None
    max_returns = tuple(2 if returns.mode in TWO_RETURNS else 1 for returns in survey.returns_each)
    sensors = tuple(carried.sensor for carried in survey.mounted_sensors)
    seeds = tuple(noise.seed for noise in survey.noise_each)
    return FiredRays(sensors, max_returns, np.concatenate(first_steps), seeds)


def _poses_of(positions: Floats, rotations: Floats) -> SweepPoses:
    """Create poses from positions and rotation matrices.

    The w component of each quaternion is nonnegative.
    """
    quaternions = quaternions_of(rotations)
    quaternions[quaternions[:, 3] < 0] *= -1  # q and -q represent the same rotation
    return SweepPoses(np.array(positions), quaternions)


def _with_vectors(
    points: Cloud,
    turn: Callable[[Floats], Floats],
    move_origins: Callable[[Floats], Floats],
    convert_flow: Callable[[Floats], Floats] | None = None,
) -> dict[str, AnyArray]:
    """Return the columns of points, converting vectors and ray origins to another frame.

    `turn` rotates vectors. `convert_flow` converts the flow relative to the sensor (default:
    `turn`).
    """
    columns = dict(points.columns)
    conversions = {NORMAL: turn, ORIGIN: move_origins, FLOW: convert_flow or turn, FLOW_EGO: turn}
    for names, convert in conversions.items():
        if not columns.keys() >= {*names}:
            continue
        for name, axis in zip(names, convert(_stacked(columns, names)).T, strict=True):
            columns[name] = axis.astype(TABLE[name].dtype)
    return columns


def _stacked(columns: Mapping[str, AnyArray], names: Sequence[str]) -> Floats:
    """Return the vectors (n, 3) whose components are in the given columns."""
    return np.stack([columns[name] for name in names], axis=1).astype(np.float64)

"""Time and pose of each sweep, for formats of single sweeps."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from itertools import combinations, pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..base.archives import open_archive, packed
from ..base.arrays import AnyArray, AnyFloats, Bools, Bytes, Floats, Floats32, Ints
from ..base.errors import LidarError
from ..base.vectors import applied, cross
from ..columns.cloud import Cloud, CloudLike
from ..columns.table import NORMAL, ORIGIN, TABLE
from ..motion.rotations import matrices, quaternions_of
from ..motion.trajectory import CLOCK_S, full_poses, presence_ns, velocities
from ..scene.scene import Scene
from ..scene.transform import affine
from ..sensor import Sensor
from ..sensor.optics import TWO_RETURNS
from ..sensor.plain_data import from_plain_data, to_plain_data
from ..survey.faults import Fault
from ..survey.survey import Survey, nanoseconds
from .instruments import Instruments
from .lidar_traits import LidarTraits
from .sweep_motion import STILL, FiringPoses, knots_of, poses_at

SWEEPS_FILE = "sweeps.npz"
MIXED_UP = (
    "The points are not in scan order, or come from a different survey than the "
    f"sweeps ({SWEEPS_FILE}). Use both from one run, and keep the order."
)
# Descriptions of the frame of points in files.
COMPENSATED = "points in the sensor's axes at the start of the sweep: motion is compensated"
AS_FIRED = "points in the sensor's axes at the firing of each: motion is not compensated"
IN_WORLD = "points in the axes of the world"
_PIECE = 250_000  # points that a thread or task reads at a time; several may read
_FORMAT = 8
# Fields of `Sweeps` in a file, by their names: as arrays, and as JSON.
_ARRAY_FIELDS = (
    "scans", "begins_ns", "ends_ns", "sensor", "actor_velocities", "actor_bounds", "actor_there",
    "actor_comes", "knots",
)  # fmt: skip
_JSON_FIELDS = (
    "sensors", "objects", "actors", "coordinates", "precision_m", "epsg", "start_ns", "stations",
    "station_ns",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class SweepPoses:
    """Poses of a sensor, carrier or actor at the start of each sweep."""

    positions: Floats  # (n, 3): metres, world coordinates
    quaternions: Floats  # (n, 4): x, y, z, w of the rotation from the body's frame to the world's

    @cached_property
    def rotations(self) -> Floats:
        """Rotations from the body's frame to the world frame: float64 (n, 3, 3)."""
        return matrices(self.quaternions)

    @cached_property
    def quaternion_matrices(self) -> Floats:
        """Matrices that convert quaternions (k, 4) to the body's frame: float64 (n, 4, 4)."""
        x, y, z, w = self.quaternions.T  # rotation matrices would take far longer
        rows = [[w, -z, y, x], [z, w, -x, y], [-y, x, w, z], [-x, -y, -z, w]]
        return np.moveaxis(np.array(rows), -1, 0)

    def matrix(self, sweep: int) -> Floats:
        """Return the matrix (4, 4) from the body's frame at the start of a sweep to the world."""
        return affine(self.rotations[sweep], self.positions[sweep])

    def inward(self, sweep: int, points: Floats) -> Floats:
        """Convert points (k, 3) from the world to the body's frame at the start of a sweep."""
        in_frame: Floats = (points - self.positions[sweep]) @ self.rotations[sweep]
        return in_frame


@dataclass(frozen=True, eq=False)
class FiredRays:
    """All rays of each sweep, with and without returns."""

    sensors: tuple[Sensor, ...]
    returns_per_pulse: tuple[
        int, ...
    ]  # reported returns of a pulse of each sensor at most; 1 if unknown
    steps: Ints  # (n,): first time step of each sweep, counted from the start of its station
    seeds: tuple[int, ...]  # seeds of each sensor's noise, which dropped packets depend on


@dataclass(frozen=True, eq=False)
class Sweeps:
    """All sweeps of a survey. A sweep is the scans of a revolution, or of a frame, of a sensor."""

    scans: Ints  # (n + 1,): first scan of each sweep, and one past the last scan of the survey
    begins_ns: Floats  # (n,): start of each sweep, nanoseconds since the survey's start
    ends_ns: Floats  # (n,): start of the last firing of each sweep
    sensor: Bytes  # (n,): number of the sensor
    pose: SweepPoses  # poses of the sensors
    mounts: SweepPoses  # mounts of each sensor in the carrier frame
    sensors: tuple[str, ...]  # names
    objects: tuple[str, ...]  # names
    actors: tuple[str, ...]  # names; actors follow the objects in the column `object`
    actor_poses: SweepPoses  # poses of the actors (a, n)
    actor_velocities: Floats  # (a, n, 3): of the middles of the actors' boxes, m/s, world
    # (a, 2, 3): corners of each actor's box in the actor's frame, metres; of all poses if its mesh
    # deforms.
    actor_bounds: Floats
    actor_there: Bools  # (a, n): whether each actor is in the scene when each sweep begins
    actor_comes: Bools  # (a, n): whether each actor appears during each sweep
    coordinates: str  # frame of the cloud's points, "world" or "sensor"
    precision_m: float  # positions were rounded to multiples of this step
    epsg: int | None = None  # code of the coordinate system of the world
    start_ns: int | None = None  # nanoseconds from 1970-01-01 UTC to the survey's start
    instruments: Instruments | None = None  # instruments of the carrier
    fired: FiredRays | None = None  # all rays, if the survey keeps every return with its ray
    classes: Mapping[int, str] = field(default_factory=dict, compare=False)  # {number: name}
    faults: tuple[Fault, ...] = ()  # faults of all sensors
    materials: tuple[str, ...] = ()  # names that the column `material` counts
    lidars: tuple[LidarTraits, ...] = ()  # traits of each sensor; empty if unknown
    knots: Floats32 = field(default_factory=lambda: STILL)  # (n, m, 7), from `knots_of`
    stations: int = 1  # number in the survey, each with as many sweeps of a sensor
    station_ns: int = 0  # time between the starts of two stations

    def __len__(self) -> int:
        return len(self.begins_ns)

    def in_sensor(self, sweep: int, points: AnyFloats) -> Floats:
        """Return points (k, 3) of a sweep in the sensor frame: at its start, or as stored."""
        exact = points.astype(np.float64)
        return exact if self.coordinates == "sensor" else self.pose.inward(sweep, exact)

    def columns_in_sensor(self, sweep: int, points: Cloud) -> dict[str, AnyArray]:
        """Return the columns of points of a sweep, vectors in the frame of `in_sensor`."""
        if self.coordinates == "sensor":
            return dict(points.columns)
        return _with_vectors(
            points,
            lambda normals: normals @ self.pose.rotations[sweep],
            lambda origins: self.pose.inward(sweep, origins),
        )

    def columns_as_fired(self, sweep: int, points: Cloud) -> dict[str, AnyArray]:
        """Return the columns of points of a sweep, vectors in the frame of `as_fired`."""
        if self.coordinates == "sensor":
            return dict(points.columns)
        poses = self.firing_poses(sweep, points)
        return _with_vectors(points, poses.turned_inward, poses.inward)

    def columns_compensated(self, sweep: int, points: Cloud) -> dict[str, AnyArray]:
        """Return the columns of points of a sweep, vectors in the frame of `compensated`."""
        if self.coordinates != "sensor":
            return self.columns_in_sensor(sweep, points)
        poses = self.firing_poses(sweep, points)
        return _with_vectors(
            points,
            lambda normals: poses.turned_outward(normals) @ self.pose.rotations[sweep],
            lambda origins: self.pose.inward(sweep, poses.outward(origins)),
        )

    def as_fired(self, sweep: int, points: Cloud) -> Floats:
        """Return the points (k, 3) of a sweep in the sensor frame at the firing of each point."""
        exact = points.positions.astype(np.float64)
        if self.coordinates == "sensor":
            return exact
        return self.firing_poses(sweep, points).inward(exact)

    def compensated(self, sweep: int, points: Cloud) -> Floats:
        """Return the points (k, 3) of a sweep in the sensor frame at the start of the sweep."""
        exact = points.positions.astype(np.float64)
        if self.coordinates == "sensor":
            exact = self.firing_poses(sweep, points).outward(exact)
        return self.pose.inward(sweep, exact)

    def firing_poses(self, sweep: int, points: Cloud) -> FiringPoses:
        """Return the poses of the sensor at the firings of the points of a sweep.

        Points without the column `time` count as fired in the middle of their scans.
        """
        since_ns = self.since_ns(sweep, points)
        firing_ns = self.lidars[self.sensor[sweep]].firing_ns if self.lidars else 0.0
        span_ns = self.ends_ns[sweep] - self.begins_ns[sweep] + firing_ns
        knots = self.knots[sweep] if len(self.knots) else np.empty((0, 7), np.float32)
        position = self.pose.positions[sweep]
        rotation = self.pose.rotations[sweep]
        return poses_at(knots, position, rotation, since_ns / max(span_ns, 1.0))

    def since_ns(self, sweep: int, points: Cloud) -> Floats:
        """Return the firing times of points, nanoseconds since the start of their sweep: (k,).

        Jumps of the sensor's clock are removed.
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
                stated_stamps = sum((fault.jumps_ns(candidate) for fault in jumps), candidate)
                # If several times give a stamp, the time closest to the point's scan counts.
                distance = np.abs(candidate - begin_ns - by_scan)
                better = (stated_stamps == stamps) & (distance < smallest_distance)
                since_begin = np.where(better, candidate - begin_ns, since_begin)
                smallest_distance = np.where(better, distance, smallest_distance)
        return np.asarray(since_begin, np.float64)

    @cached_property
    def carrier(self) -> SweepPoses:
        """Poses of the carrier at the start of each sweep."""
        mounts = matrices(self.mounts.quaternions)[self.sensor]
        rotations = matrices(self.pose.quaternions) @ mounts.transpose(0, 2, 1)
        lever_arms = np.einsum("nij,nj->ni", rotations, self.mounts.positions[self.sensor])
        return _poses_of(self.pose.positions - lever_arms, rotations)

    @cached_property
    def all_names(self) -> tuple[str, ...]:
        """Names that the column `object` counts: of objects, then of actors."""
        return (*self.objects, *self.actors)

    @cached_property
    def actor_types(self) -> list[str]:
        """Types of the actors."""
        return [type_of(actor) for actor in self.actors]

    @cached_property
    def numbers(self) -> Ints:
        """Number of each sweep among the sweeps of its sensor, from 0: int64 (n,)."""
        return np.arange(len(self)) - np.searchsorted(self.sensor, self.sensor)

    @classmethod
    def unknown(cls) -> Sweeps:
        """Return no sweeps, for points of an unknown survey, in steps of a millimetre."""
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
            coordinates="world",
            precision_m=0.001,
        )

    @classmethod
    def from_survey(cls, survey: Survey, scene: Scene) -> Sweeps:
        """Return the sweeps of a survey of a scene."""
        by_sensor = [_sensor_sweeps(survey, number) for number in range(len(survey.carried))]
        begins_ns = np.concatenate([starts for _, starts, _ in survey.sweeps_each])
        ends_ns = np.concatenate([stops for _, _, stops in survey.sweeps_each])
        firsts = [first_scans for first_scans, _, _ in survey.sweeps_each]
        positions = np.concatenate([sweeps.positions for sweeps in by_sensor])
        rotations = np.concatenate([sweeps.rotations for sweeps in by_sensor])
        mounts = [carried.mount for carried in survey.carried]
        traits = tuple(
            LidarTraits.from_sensor(carried.sensor, returns.mode)
            for carried, returns in zip(survey.carried, survey.returns_each, strict=True)
        )
        sensor = np.concatenate(
            [np.full(len(first), n, np.uint8) for n, first in enumerate(firsts)]
        )
        firing_ns = np.array([lidar.firing_ns for lidar in traits])[sensor]
        actors = _actor_sweeps(scene, begins_ns, ends_ns + firing_ns)
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
            sensors=tuple(carried.name for carried in survey.carried),
            objects=tuple(scene.names),
            actors=tuple(actor.name for actor in scene.actors),
            actor_poses=actors.poses,
            actor_velocities=actors.velocities,
            actor_bounds=actors.bounds,
            actor_there=actors.present,
            actor_comes=actors.comes,
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
            knots=knots_of(survey, traits, rotations),
            stations=survey.path.stations,
            station_ns=survey.station_ns,
        )

    def faults_in(self, sweep: int) -> tuple[Fault, ...]:
        """Return the faults of a sweep: present at any time, or, if frozen, at its start."""
        sensors = None, self.sensors[self.sensor[sweep]]
        begin = self.begins_ns[sweep]
        end = self.ends_ns[sweep]
        sensor_faults = (fault for fault in self.faults if fault.sensor in sensors)
        return tuple(
            fault
            for fault in sensor_faults
            if fault.during(begin, None if fault.kind == "frozen" else end)
        )

    def stamp_ns(self, sweep: int) -> int:
        """Return the start of a sweep by the sensor's clock, ns since the survey's start."""
        begin = self.begins_ns[sweep]
        return round(begin) + sum(int(fault.jumps_ns(begin)) for fault in self.faults_in(sweep))

    def points(self, cloud: CloudLike, first: int = 0, stop: int | None = None) -> Iterator[Cloud]:
        """Yield the points of each sweep from `first` to `stop` in order, empty sweeps included.

        Raises
        ------
        LidarError
            If the points are not in the order of scans, or are of a different survey.
        """
        sweep_parts: list[Cloud] = []
        empty = Cloud(np.empty((0, 3)), {c.name: np.empty(0, c.dtype) for c in cloud.table})
        current = first
        stop = len(self) if stop is None else stop
        for chunk in cloud.chunks(_PIECE, cloud.row_of(int(self.scans[first])) if first else 0):
            sweep = np.searchsorted(self.scans, chunk["scan"], "right") - 1
            if sweep[0] < current or sweep[-1] >= len(self) or (np.diff(sweep) < 0).any():
                raise LidarError(MIXED_UP)
            end = int(np.searchsorted(sweep, stop))
            starts = np.flatnonzero(np.diff(sweep[:end], prepend=-1))
            for start, stop_row in pairwise([*starts, end]):
                while current < sweep[start]:
                    yield Cloud.joined(sweep_parts) if sweep_parts else empty
                    sweep_parts = []
                    current = current + 1
                sweep_parts.append(chunk[start:stop_row])
            if end < len(sweep):
                break
        while current < stop:
            yield Cloud.joined(sweep_parts) if sweep_parts else empty
            sweep_parts = []
            current = current + 1

    def save(self, path: Path) -> None:
        """Write the sweeps as a NumPy archive.

        Raises OSError if the file cannot be written.
        """
        path.write_bytes(self.packed())

    def packed(self) -> bytes:
        """Return the sweeps as a NumPy archive: equal sweeps have equal bytes."""
        values = {"format": _FORMAT, **{name: getattr(self, name) for name in _JSON_FIELDS}}
        values["lidars"] = [lidar.to_json() for lidar in self.lidars]
        if self.instruments is not None:
            values["instruments"] = self.instruments.to_json()
        values |= {"classes": dict(self.classes)} if self.classes else {}
        values |= {"materials": self.materials} if self.materials else {}
        values |= {"faults": [fault.words() for fault in self.faults]} if self.faults else {}
        arrays: dict[str, Any] = {"words": np.frombuffer(json.dumps(values).encode(), np.uint8)}
        arrays |= {name: getattr(self, name) for name in _ARRAY_FIELDS}
        poses_by_prefix = {"": self.pose, "mount_": self.mounts, "actor_": self.actor_poses}
        for prefix, poses in poses_by_prefix.items():
            arrays[f"{prefix}positions"] = poses.positions
            arrays[f"{prefix}quaternions"] = poses.quaternions
        if self.fired is not None and (sensors := to_plain_data(self.fired.sensors, arrays)):
            rays = {
                "sensors": sensors,
                "returns": self.fired.returns_per_pulse,
                "seeds": self.fired.seeds,
            }
            arrays["rays"] = np.frombuffer(json.dumps(rays).encode(), np.uint8)
            arrays["steps"] = self.fired.steps
        return packed(arrays)

    @classmethod
    def load(cls, path: Path | str, read: Callable[[], bytes] | None = None) -> Sweeps:
        """Read sweeps that `save` has written, without running any code in the file.

        `read` returns the bytes of the file, by default those at `path`.

        Raises
        ------
        LidarError
            If the file cannot be read, is damaged, or of a different version.
        """
        with open_archive(path, read) as arrays:
            values = json.loads(arrays["words"].tobytes())
            if values["format"] != _FORMAT:
                raise ValueError(f"its format is {values['format']}, but {_FORMAT} is required")
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
            )


def type_of(name: str) -> str:
    """Return the type of an actor for labels: its name without spaces and a number at the end.

    Examples
    --------
    >>> [type_of(name) for name in ("Car 1", "Car (b.2)", "Delivery van", "7")]
    ['Car', 'Car', 'Delivery_van', '7']
    """
    plain = re.sub(r"(\s*\([^()]*\)|[\s._-]*\d+)$", "", name.strip())
    return re.sub(r"\s+", "_", plain or name.strip())


def plain_names(names: Iterable[str]) -> list[str]:
    """Return unique names for ROS and folders.

    Examples
    --------
    >>> plain_names(["roof", "left/rear", "left rear", "2nd"])
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
    """Sweeps of a sensor: arrays (n, …)."""

    positions: Floats  # (n, 3): of the sensor at the start of each sweep, scene frame, metres
    rotations: Floats  # (n, 3, 3)
    first_steps: Ints  # (n,): first time step of each sweep, counted from the start of its station


class _ActorSweeps(NamedTuple):
    """Actors during n sweeps, in fields of `Sweeps`."""

    poses: SweepPoses  # (a, n)
    velocities: Floats  # (a, n, 3)
    bounds: Floats  # (a, 2, 3)
    present: Bools  # (a, n)
    comes: Bools  # (a, n)


def _sensor_sweeps(survey: Survey, number: int) -> _SensorSweeps:
    """Return the sweeps of the sensor `number` of a survey."""
    path = survey.path
    mount = survey.carried[number].mount
    firsts, starts, _ = survey.sweeps_each[number]
    times = starts[: len(starts) // path.stations]
    positions = []
    rotations = []
    for station in range(path.stations):
        carrier_positions, carrier_rotations = full_poses(path, station, times)
        positions.append(carrier_positions + carrier_rotations @ np.array(mount.position))
        rotations.append(carrier_rotations @ mount.rotation_matrix)
    specs = [survey.sent_scan(scan) for scan in firsts.tolist()]
    cast_scans = np.array([spec.scan + spec.ahead for spec in specs])  # repeated if frozen
    first_steps = (cast_scans - firsts[0]) % survey.steps_each[number]
    return _SensorSweeps(np.concatenate(positions), np.concatenate(rotations), first_steps)


def _actor_sweeps(scene: Scene, starts_ns: Floats, stops_ns: Floats) -> _ActorSweeps:
    """Return the actors of a scene at the starts of sweeps, and whether they are there.

    An actor that appears after the start of a sweep, or that has left, has the pose that it would
    have if it moved as fast as at that moment, with the same rotation: its boxes then move evenly
    from sweep to sweep.
    """
    poses = []
    linear = []
    present = []
    comes = []
    bounds = [actor.bounds for actor in scene.actors]
    for actor, (lower, upper) in zip(scene.actors, bounds, strict=True):
        appears_ns, leaves_ns = presence_ns(actor.trajectory)
        times_ns = _times_of_presence(starts_ns, appears_ns, leaves_ns)
        positions, rotations = full_poses(actor.trajectory, 0, times_ns)
        speeds, rates = velocities(actor.trajectory, 0, times_ns)
        beyond_s = (starts_ns - times_ns)[:, None] / 1e9
        poses.append(_poses_of(positions + speeds * beyond_s + scene.origin, rotations))
        lever_arms = applied(rotations, (lower + upper) / 2)
        linear.append(speeds + cross(rates.T, lever_arms.T).T)
        present.append((appears_ns <= starts_ns) & (starts_ns <= leaves_ns))
        comes.append((starts_ns < appears_ns) & (appears_ns <= stops_ns))
    count = len(starts_ns)
    return _ActorSweeps(
        SweepPoses(
            np.reshape([pose.positions for pose in poses], (-1, count, 3)),
            np.reshape([pose.quaternions for pose in poses], (-1, count, 4)),
        ),
        np.reshape(linear, (-1, count, 3)),
        np.reshape(bounds, (-1, 2, 3)),
        np.array(present, bool).reshape(-1, count),
        np.array(comes, bool).reshape(-1, count),
    )


def _times_of_presence(times_ns: Floats, appears_ns: float, leaves_ns: float) -> Floats:
    """Return the nearest times (n,) at which an actor is in the scene, within the rounding."""
    # A trajectory may be said to end by a clock of seconds since 1970, in steps of 2.4e-7 s.
    margin_ns = min(1e9 * CLOCK_S, (leaves_ns - appears_ns) / 2)
    present = (appears_ns <= times_ns) & (times_ns <= leaves_ns)
    return np.where(present, times_ns, times_ns.clip(appears_ns + margin_ns, leaves_ns - margin_ns))


def _fired_rays(survey: Survey, first_steps: list[Ints]) -> FiredRays | None:
    """Return all rays of a survey, or None unless it keeps every return with its ray."""
    if survey.keep_every != 1 or all(c.name != "ray" for c in survey.stored_columns):
        return None
    max_returns = tuple(2 if returns.mode in TWO_RETURNS else 1 for returns in survey.returns_each)
    sensors = tuple(carried.sensor for carried in survey.carried)
    seeds = tuple(noise.seed for noise in survey.noise_each)
    return FiredRays(sensors, max_returns, np.concatenate(first_steps), seeds)


def _poses_of(positions: Floats, rotations: Floats) -> SweepPoses:
    """Return poses of positions (n, 3) and rotations (n, 3, 3), with w at or above 0."""
    quaternions = quaternions_of(rotations)
    quaternions[quaternions[:, 3] < 0] *= -1  # q and -q are the same rotation
    return SweepPoses(np.array(positions), quaternions)


def _with_vectors(
    points: Cloud,
    turn_normals: Callable[[Floats], Floats],
    move_origins: Callable[[Floats], Floats],
) -> dict[str, AnyArray]:
    """Return the columns of points, with normals and origins of rays in a new frame."""
    columns = dict(points.columns)
    for names, convert in ((NORMAL, turn_normals), (ORIGIN, move_origins)):
        if not columns.keys() >= {*names}:
            continue
        vectors = np.stack([columns[name] for name in names], axis=1).astype(np.float64)
        for name, axis in zip(names, convert(vectors).T, strict=True):
            columns[name] = axis.astype(TABLE[name].dtype)
    return columns

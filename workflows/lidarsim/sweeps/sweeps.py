"""Time and pose of each sweep, for formats of single sweeps."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from itertools import combinations, pairwise
from pathlib import Path
from typing import Any

import numpy as np

from ..base.archives import open_archive, packed
from ..base.arrays import AnyArray, AnyFloats, Bools, Bytes, Floats, Floats32, Ints
from ..base.errors import LidarError
from ..columns.cloud import Cloud, CloudLike
from ..columns.table import NORMAL, ORIGIN, TABLE
from ..scene.scene import Scene
from ..scene.transform import affine
from ..sensor import Fault, Sensor, Survey
from ..sensor.plain_data import from_plain_data, to_plain_data
from ..sensor.survey import nanoseconds
from ..sensor.trajectory import full_poses, matrices, presence_ns, quaternions_of
from .instruments import Instruments
from .lidar_traits import LidarTraits
from .sweep_motion import STILL, FiringPoses, knots_of, poses_at

SWEEPS_FILE = "sweeps.npz"
MIXED_UP = (
    "The points are not in the order of their scans, or of another survey than the sweeps "
    f"({SWEEPS_FILE}): give both of one run, and keep the order."
)
# What files say of the frame of their points.
COMPENSATED = "points in the sensor's axes at the start of the sweep: motion is compensated"
AS_FIRED = "points in the sensor's axes at the firing of each: motion is not compensated"
IN_WORLD = "points in the axes of the world"
_PIECE = 250_000  # points that are read at a time: several threads or tasks have so many
_FORMAT = 6
# Fields of `Sweeps` that a file holds under their names: as an array each, and as JSON.
_ARRAYS = ("scans", "begins_ns", "ends_ns", "sensor", "actor_bounds", "actor_there", "knots")
_WORDS = (
    "sensors", "objects", "actors", "coordinates", "precision_m", "epsg", "start_ns", "stations",
    "station_ns",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Placed:
    """Poses of something at the start of each sweep."""

    positions: Floats  # (n, 3): metres, world coordinates
    quaternions: Floats  # (n, 4): x, y, z, w of the rotation from its own axes to the world's

    @cached_property
    def turns(self) -> Floats:
        """float64 (n, 3, 3): rotations from its own axes to the world's."""
        return matrices(self.quaternions)

    @cached_property
    def products(self) -> Floats:
        """float64 (n, 4, 4): matrices by which quaternions (k, 4) are brought to its own axes."""
        x, y, z, w = self.quaternions.T  # by rotation matrices it would take far longer
        rows = [[w, -z, y, x], [z, w, -x, y], [-y, x, w, z], [-x, -y, -z, w]]
        return np.moveaxis(np.array(rows), -1, 0)

    def matrix(self, sweep: int) -> Floats:
        """Matrix (4, 4) from its own axes at the start of a sweep to the world's."""
        return affine(self.turns[sweep], self.positions[sweep])

    def inward(self, sweep: int, points: Floats) -> Floats:
        """Convert points (k, 3) of the world to its axes at the start of a sweep."""
        turned: Floats = (points - self.positions[sweep]) @ self.turns[sweep]
        return turned


@dataclass(frozen=True, eq=False)
class Fired:
    """What finds the rays of each sweep, with and without returns."""

    sensors: tuple[Sensor, ...]
    returns: tuple[int, ...]  # that each sensor reports of a pulse at most; 1 if that is unknown
    steps: Ints  # (n,): first time step of each sweep, from that of its station


@dataclass(frozen=True, eq=False)
class Sweeps:
    """All sweeps of a survey. A sweep is the scans of one turn, or of one frame, of a sensor."""

    scans: Ints  # (n + 1,): the first of each sweep, and one past the last of all
    begins_ns: Floats  # (n,): nanoseconds since the survey's start
    ends_ns: Floats  # (n,): when the last firing of each begins
    sensor: Bytes  # (n,): its number
    pose: Placed  # of the sensors
    mounts: Placed  # of each sensor in the carrier's axes
    sensors: tuple[str, ...]  # names
    objects: tuple[str, ...]
    actors: tuple[str, ...]  # they follow the objects in the column `object`
    actor_poses: Placed  # of the actors (a, 2n): at starts of sweeps, then at their ends
    # (a, 2, 3): corners of each actor's box in its own axes, metres; (a, n, 2, 3) if any deforms.
    actor_bounds: Floats
    actor_there: Bools  # (a, n): whether each actor is in the scene
    coordinates: str  # of the cloud's points, "world" or "sensor"
    precision_m: float  # step to which positions were rounded
    epsg: int | None = None  # code of the coordinate system of the world
    start_ns: int | None = None  # from 1970-01-01 UTC to the survey's start
    instruments: Instruments | None = None  # of the carrier, with files beside it
    fired: Fired | None = None  # all rays, if the survey keeps every return with its ray
    classes: Mapping[int, str] = field(default_factory=dict, compare=False)  # their names
    faults: tuple[Fault, ...] = ()  # of all sensors
    materials: tuple[str, ...] = ()  # names that the column `material` counts
    lidars: tuple[LidarTraits, ...] = ()  # traits of each sensor; none if they are unknown
    knots: Floats32 = field(default_factory=lambda: STILL)  # (n, m, 7): see `knots_of`
    stations: int = 1  # of the survey, each with as many sweeps of a sensor
    station_ns: int = 0  # from the start of a station to that of the next

    def __len__(self) -> int:
        return len(self.begins_ns)

    def in_sensor(self, sweep: int, points: AnyFloats) -> Floats:
        """Points (k, 3) of a sweep in its sensor's axes: at its start, or as stored."""
        exact = points.astype(np.float64)
        return exact if self.coordinates == "sensor" else self.pose.inward(sweep, exact)

    def columns_in_sensor(self, sweep: int, points: Cloud) -> dict[str, AnyArray]:
        """Return the columns of points of a sweep, vectors in the axes of `in_sensor`."""
        if self.coordinates == "sensor":
            return dict(points.columns)
        return _with_vectors(
            points,
            lambda normals: normals @ self.pose.turns[sweep],
            lambda origins: self.pose.inward(sweep, origins),
        )

    def columns_as_fired(self, sweep: int, points: Cloud) -> dict[str, AnyArray]:
        """Return the columns of points of a sweep, vectors in the axes of `as_fired`."""
        if self.coordinates == "sensor":
            return dict(points.columns)
        poses = self.firing_poses(sweep, points)
        return _with_vectors(points, poses.turned_inward, poses.inward)

    def columns_compensated(self, sweep: int, points: Cloud) -> dict[str, AnyArray]:
        """Return the columns of points of a sweep, vectors in the axes of `compensated`."""
        if self.coordinates != "sensor":
            return self.columns_in_sensor(sweep, points)
        poses = self.firing_poses(sweep, points)
        return _with_vectors(
            points,
            lambda normals: poses.turned_outward(normals) @ self.pose.turns[sweep],
            lambda origins: self.pose.inward(sweep, poses.outward(origins)),
        )

    def as_fired(self, sweep: int, points: Cloud) -> Floats:
        """Return the points (k, 3) of a sweep in the sensor's axes at the firing of each."""
        exact = points.positions.astype(np.float64)
        if self.coordinates == "sensor":
            return exact
        return self.firing_poses(sweep, points).inward(exact)

    def compensated(self, sweep: int, points: Cloud) -> Floats:
        """Return the points (k, 3) of a sweep in the sensor's axes at the start of the sweep."""
        exact = points.positions.astype(np.float64)
        if self.coordinates == "sensor":
            exact = self.firing_poses(sweep, points).outward(exact)
        return self.pose.inward(sweep, exact)

    def firing_poses(self, sweep: int, points: Cloud) -> FiringPoses:
        """Return the poses of the sensor at the firings of the points of a sweep.

        Points without the column `time` are taken to be fired in the middle of their scans.
        """
        since_ns = self.since_ns(sweep, points)
        firing_ns = self.lidars[self.sensor[sweep]].firing_ns if self.lidars else 0.0
        span_ns = self.ends_ns[sweep] - self.begins_ns[sweep] + firing_ns
        knots = self.knots[sweep] if len(self.knots) else np.empty((0, 7), np.float32)
        place = self.pose.positions[sweep]
        turn = self.pose.turns[sweep]
        return poses_at(knots, place, turn, since_ns / max(span_ns, 1.0))

    def since_ns(self, sweep: int, points: Cloud) -> Floats:
        """Return when the points of a sweep were fired, nanoseconds since the sweep's start: (k,).

        Jumps of the sensor's clock are taken out again.
        """
        begin_ns = self.begins_ns[sweep]
        end_ns = self.ends_ns[sweep]
        first, stop = self.scans[sweep : sweep + 2]
        by_scan = (points["scan"] + 0.5 - first) / (stop - first) * (end_ns - begin_ns)
        if "time" not in points.columns:
            return np.asarray(by_scan, np.float64)
        stamps = points["time"].astype(np.int64)
        sensors = None, self.sensors[self.sensor[sweep]] if self.sensors else None
        jumps = [one for one in self.faults if one.kind == "time_jump" and one.sensor in sensors]
        since = stamps - begin_ns
        gap = np.full(len(stamps), np.inf)
        for count in range(1 + len(jumps)) if jumps else ():
            for faults in combinations(jumps, count):
                candidate = stamps - sum(round((fault.by_s or 0) * 1e9) for fault in faults)
                stated = sum((fault.jumps_ns(candidate) for fault in jumps), candidate)
                # Where several times give a stamp, that in the point's scan counts.
                distance = np.abs(candidate - begin_ns - by_scan)
                better = (stated == stamps) & (distance < gap)
                since, gap = (
                    np.where(better, new, old)
                    for new, old in ((candidate - begin_ns, since), (distance, gap))
                )
        return np.asarray(since, np.float64)

    def bounds(self, sweep: int) -> Floats:
        """Corners of each actor's box during a sweep, in its own axes: (a, 2, 3), metres."""
        return self.actor_bounds if self.actor_bounds.ndim == 3 else self.actor_bounds[:, sweep]

    @cached_property
    def carrier(self) -> Placed:
        """Poses of the carrier."""
        mounts = matrices(self.mounts.quaternions)[self.sensor]
        turns = matrices(self.pose.quaternions) @ mounts.transpose(0, 2, 1)
        levers = np.einsum("nij,nj->ni", turns, self.mounts.positions[self.sensor])
        return _placed(self.pose.positions - levers, turns)

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
        """int64 (n,): number of each sweep among those of its sensor, from 0."""
        return np.arange(len(self)) - np.searchsorted(self.sensor, self.sensor)

    @classmethod
    def unknown(cls) -> Sweeps:
        """Return no sweeps, for points of an unknown survey, in steps of a millimetre."""
        none = Placed(np.empty((0, 3)), np.empty((0, 4)))
        return cls(
            np.zeros(1, np.int64), np.empty(0), np.empty(0), np.empty(0, np.uint8), none, none,
            (), (), (), none, np.empty((0, 2, 3)), np.empty((0, 0), bool), "world", 0.001,
        )  # fmt: skip

    @classmethod
    def of(cls, survey: Survey, scene: Scene) -> Sweeps:
        """Return the sweeps of a survey of a scene."""
        path = survey.path
        sensors = []
        places = []
        turns = []
        mounts = []
        first_steps = []
        each = survey.sweeps_each
        for number, carried in enumerate(survey.carried):
            (firsts, begins, _), mount = each[number], carried.mount
            since = begins[: len(begins) // path.stations]
            turned = mount.rotation_matrix
            mounts.append((mount.position, turned))
            for station in range(path.stations):
                positions, rotations = full_poses(path, station, since)
                places.append(positions + rotations @ np.array(mount.position))
                turns.append(rotations @ turned)
            sensors.append(np.full(len(since) * path.stations, number, np.uint8))
            shown = [survey.sent_scan(scan) for scan in firsts.tolist()]
            older = np.array([one.scan + one.ahead for one in shown])
            first_steps.append((older - firsts[0]) % survey.steps_each[number])
        when, end = (np.concatenate([one[k] for one in each]) for k in (1, 2))
        actor_poses = []
        there = []
        for actor in scene.actors:
            at, turned_by = full_poses(actor.trajectory, 0, np.append(when, end))
            actor_poses.append(_placed(at + scene.origin, turned_by))
            appears, leaves = presence_ns(actor.trajectory)
            there.append((appears <= when) & (when <= leaves))
        deform = any(actor.mesh.animation for actor in scene.actors)
        bounds = [a.bounds_between(when, end) if deform else a.mesh.bounds for a in scene.actors]
        fired = None
        if survey.keep_every == 1 and any(c.name == "ray" for c in survey.stored_columns):
            most = tuple(2 if each.mode == "dual" else 1 for each in survey.returns_each)
            lidars = tuple(carried.sensor for carried in survey.carried)
            fired = Fired(lidars, most, np.concatenate(first_steps))
        traits = tuple(
            LidarTraits.of(carried.sensor, returns.mode)
            for carried, returns in zip(survey.carried, survey.returns_each, strict=True)
        )
        rotations = np.concatenate(turns)
        return cls(
            np.append(np.concatenate([firsts for firsts, _, _ in each]), survey.scan_count),
            when,
            end,
            np.concatenate(sensors),
            _placed(np.concatenate(places) + scene.origin, rotations),
            _placed(*(np.array(part) for part in zip(*mounts, strict=True))),
            tuple(carried.name for carried in survey.carried),
            tuple(scene.names),
            tuple(actor.name for actor in scene.actors),
            Placed(
                np.reshape([each.positions for each in actor_poses], (-1, 2 * len(when), 3)),
                np.reshape([each.quaternions for each in actor_poses], (-1, 2 * len(when), 4)),
            ),
            np.array(bounds) if bounds else np.empty((0, 2, 3)),
            np.array(there, bool).reshape(-1, len(when)),
            survey.coordinates,
            survey.precision_m,
            survey.epsg,
            None if survey.start is None else nanoseconds(survey.start),
            instruments=Instruments.of(survey),
            fired=fired,
            classes=survey.classes,
            faults=tuple(survey.faults),
            materials=scene.material_names,
            lidars=traits,
            knots=knots_of(survey, traits, rotations),
            stations=path.stations,
            station_ns=survey.station_ns,
        )

    def faults_in(self, sweep: int) -> tuple[Fault, ...]:
        """Return the faults that are in a sweep: at some time of it, or if frozen, as it begins."""
        sensors = None, self.sensors[self.sensor[sweep]]
        begin = self.begins_ns[sweep]
        end = self.ends_ns[sweep]
        own = (one for one in self.faults if one.sensor in sensors)
        return tuple(one for one in own if one.during(begin, None if one.kind == "frozen" else end))

    def stamp_ns(self, sweep: int) -> int:
        """Return when the sensor says that a sweep began, nanoseconds since the survey's start."""
        begin = self.begins_ns[sweep]
        return round(begin) + sum(int(one.jumps_ns(begin)) for one in self.faults_in(sweep))

    def points(self, cloud: CloudLike, first: int = 0, stop: int | None = None) -> Iterator[Cloud]:
        """Yield the points of each sweep from `first` to `stop` in order, also of empty ones.

        Raises
        ------
        LidarError
            If they are not in the order of scans, or of another survey.
        """
        held: list[Cloud] = []
        empty = Cloud(np.empty((0, 3)), {c.name: np.empty(0, c.dtype) for c in cloud.table})
        current = first
        stop = len(self) if stop is None else stop
        for chunk in cloud.chunks(_PIECE, cloud.row_of(int(self.scans[first])) if first else 0):
            sweep = np.searchsorted(self.scans, chunk["scan"], "right") - 1
            if sweep[0] < current or sweep[-1] >= len(self) or (np.diff(sweep) < 0).any():
                raise LidarError(MIXED_UP)
            end = int(np.searchsorted(sweep, stop))
            starts = np.flatnonzero(np.diff(sweep[:end], prepend=-1))
            for start, after in pairwise([*starts, end]):
                while current < sweep[start]:
                    yield Cloud.joined(held) if held else empty
                    held = []
                    current = current + 1
                held.append(chunk[start:after])
            if end < len(sweep):
                break
        while current < stop:
            yield Cloud.joined(held) if held else empty
            held = []
            current = current + 1

    def save(self, path: Path) -> None:
        """Write it as a NumPy archive; OSError if it cannot be written."""
        path.write_bytes(self.packed())

    def packed(self) -> bytes:
        """Return it as a NumPy archive: the same sweeps give the same bytes."""
        words = {"format": _FORMAT, **{name: getattr(self, name) for name in _WORDS}}
        words["lidars"] = [lidar.words() for lidar in self.lidars]
        if self.instruments is not None:
            words["instruments"] = self.instruments.words()
        words |= {"classes": dict(self.classes)} if self.classes else {}
        words |= {"materials": self.materials} if self.materials else {}
        words |= {"faults": [one.words() for one in self.faults]} if self.faults else {}
        arrays: dict[str, Any] = {"words": np.frombuffer(json.dumps(words).encode(), np.uint8)}
        arrays |= {name: getattr(self, name) for name in _ARRAYS}
        placed = {"": self.pose, "mount_": self.mounts, "actor_": self.actor_poses}
        for prefix, poses in placed.items():
            arrays[f"{prefix}positions"] = poses.positions
            arrays[f"{prefix}quaternions"] = poses.quaternions
        if self.fired is not None and (told := to_plain_data(self.fired.sensors, arrays)):
            rays = {"sensors": told, "returns": self.fired.returns}
            arrays["rays"] = np.frombuffer(json.dumps(rays).encode(), np.uint8)
            arrays["steps"] = self.fired.steps
        return packed(arrays)

    @classmethod
    def load(cls, path: Path | str, read: Callable[[], bytes] | None = None) -> Sweeps:
        """Read what `save` wrote; nothing in the file is run. `read` is as of `open_archive`.

        Raises
        ------
        LidarError
            If it cannot be read, is damaged, or of another version.
        """
        with open_archive(path, read) as arrays:
            words = json.loads(arrays["words"].tobytes())
            if words["format"] != _FORMAT:
                raise ValueError(f"it is of format {words['format']}, not {_FORMAT}")
            words |= {name: tuple(words[name]) for name in ("sensors", "objects", "actors")}
            pose, mounts, actor_poses = (
                Placed(arrays[f"{prefix}positions"], arrays[f"{prefix}quaternions"])
                for prefix in ("", "mount_", "actor_")
            )
            instruments = words.get("instruments")
            fired = None
            if "rays" in arrays:
                rays = json.loads(arrays["rays"].tobytes())
                sensors = from_plain_data(rays["sensors"], arrays)
                fired = Fired(sensors, tuple(rays["returns"]), arrays["steps"])
            return cls(
                fired=fired,
                pose=pose,
                mounts=mounts,
                actor_poses=actor_poses,
                instruments=instruments and Instruments.from_words(instruments, Path(path).parent),
                classes={int(number): name for number, name in words.get("classes", {}).items()},
                lidars=tuple(LidarTraits.from_words(lidar) for lidar in words["lidars"]),
                faults=tuple(Fault(**one) for one in words.get("faults", ())),
                materials=tuple(words.get("materials", ())),
                **{name: arrays[name] for name in _ARRAYS},
                **{name: words[name] for name in _WORDS},
            )


def type_of(name: str) -> str:
    """Type of an actor for labels: its name without spaces, and a number or identity at the end.

    Examples
    --------
    >>> [type_of(name) for name in ("Car 1", "Car (b.2)", "Delivery van", "7")]
    ['Car', 'Car', 'Delivery_van', '7']
    """
    plain = re.sub(r"(\s*\([^()]*\)|[\s._-]*\d+)$", "", name.strip())
    return re.sub(r"\s+", "_", plain or name.strip())


def plain_names(names: Iterable[str]) -> list[str]:
    """Make unique names for ROS and folders.

    Examples
    --------
    >>> plain_names(["roof", "left/rear", "left rear", "2nd"])
    ['roof', 'left_rear', 'left_rear_2', '_2nd']
    """
    out: list[str] = []
    for name in names:
        plain = allowed = re.sub(r"^(?=\d)|\W", "_", name, flags=re.ASCII)
        number = 1
        while plain in out:
            number += 1
            plain = f"{allowed}_{number}"
        out.append(plain)
    return out


def _placed(positions: Floats, rotations: Floats) -> Placed:
    quaternions = quaternions_of(rotations)
    quaternions[quaternions[:, 3] < 0] *= -1  # of the two that mean the same
    return Placed(np.array(positions), quaternions)


def _with_vectors(
    points: Cloud,
    turn_normals: Callable[[Floats], Floats],
    move_origins: Callable[[Floats], Floats],
) -> dict[str, AnyArray]:
    """Return the columns of points, with normals and origins of rays in other axes."""
    columns = dict(points.columns)
    for names, convert in ((NORMAL, turn_normals), (ORIGIN, move_origins)):
        if not columns.keys() >= {*names}:
            continue
        vectors = np.stack([columns[name] for name in names], axis=1).astype(np.float64)
        for name, axis in zip(names, convert(vectors).T, strict=True):
            columns[name] = axis.astype(TABLE[name].dtype)
    return columns

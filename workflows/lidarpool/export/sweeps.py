"""Time and pose of each sweep, for formats of single sweeps."""

from __future__ import annotations

import io
import json
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base.errors import LidarpoolError
from ..columns.cloud import Cloud, CloudLike
from ..scene.scene import Scene
from ..sensor import Sensor, Survey
from ..sensor.survey import nanoseconds
from ..sensor.trajectory import matrices, quaternions_of

Floats = NDArray[np.float64]
SWEEPS_FILE = "sweeps.npz"
MIXED_UP = (
    "The points are not in the order of their scans, or of another survey than the sweeps "
    f"({SWEEPS_FILE}): give both of one run, and keep the order."
)
_PIECE = 250_000  # points that are read at a time: several threads or tasks have so many
_FORMAT = 2


@dataclass(frozen=True, eq=False)
class Placed:
    """Poses of something at the start of each sweep.

    Parameters
    ----------
    positions
        float64 (n, 3): metres, world coordinates.
    quaternions
        float64 (n, 4): x, y, z, w of the rotation from its own axes to the world's.
    """

    positions: Floats
    quaternions: Floats

    def inward(self, sweep: int, points: Floats) -> Floats:
        """Convert points (k, 3) of the world to its axes at the start of a sweep."""
        turn = matrices(self.quaternions[sweep, None])[0]
        turned: Floats = (points - self.positions[sweep]) @ turn
        return turned


@dataclass(frozen=True, eq=False)
class Sweeps:
    """All sweeps of a survey. A sweep is the scans of one turn, or of one frame, of a sensor.

    Parameters
    ----------
    scans
        int64 (n + 1,): the first scan of each, and one past the last of all.
    begins_ns
        float64 (n,): start of each, nanoseconds since the survey's start.
    sensor
        uint8 (n,): number of its sensor.
    pose
        Poses of the sensors.
    mounts
        Pose of each sensor in the carrier's axes.
    sensors, objects, actors
        Names; those of actors follow those of objects in the column `object`.
    actor_poses
        Poses of each actor.
    actor_bounds
        float64 (a, 2, 3): corners of each actor's box in its own axes, metres.
    coordinates
        Of the cloud's points, "world" or "sensor".
    precision_m
        Step to which positions were rounded, metres.
    epsg
        Code of the coordinate system of the world; None if unknown.
    start_ns
        Nanoseconds from 1970-01-01 UTC to the survey's start; None if unknown.
    """

    scans: NDArray[np.int64]
    begins_ns: Floats
    sensor: NDArray[np.uint8]
    pose: Placed
    mounts: Placed
    sensors: tuple[str, ...]
    objects: tuple[str, ...]
    actors: tuple[str, ...]
    actor_poses: tuple[Placed, ...]
    actor_bounds: Floats
    coordinates: str
    precision_m: float
    epsg: int | None = None
    start_ns: int | None = None

    def __len__(self) -> int:
        return len(self.begins_ns)

    def in_sensor(self, sweep: int, points: NDArray[np.floating]) -> Floats:
        """Points (k, 3) of a sweep in its sensor's axes: at its start, or as stored."""
        exact = points.astype(np.float64)
        return exact if self.coordinates == "sensor" else self.pose.inward(sweep, exact)

    @cached_property
    def carrier(self) -> Placed:
        """Poses of the carrier."""
        mounts = matrices(self.mounts.quaternions)[self.sensor]
        turns = matrices(self.pose.quaternions) @ mounts.transpose(0, 2, 1)
        levers = np.einsum("nij,nj->ni", turns, self.mounts.positions[self.sensor])
        return _placed(self.pose.positions - levers, turns)

    @cached_property
    def numbers(self) -> NDArray[np.int64]:
        """int64 (n,): number of each sweep among those of its sensor, from 0."""
        return np.arange(len(self)) - np.searchsorted(self.sensor, self.sensor)

    @classmethod
    def unknown(cls) -> Sweeps:
        """Return no sweeps, for points of an unknown survey, in steps of a millimetre."""
        none = Placed(np.empty((0, 3)), np.empty((0, 4)))
        return cls(
            np.zeros(1, np.int64), np.empty(0), np.empty(0, np.uint8), none, none, (), (), (), (),
            np.empty((0, 2, 3)), "world", 0.001,
        )  # fmt: skip

    @classmethod
    def of(cls, survey: Survey, scene: Scene) -> Sweeps:
        """Return the sweeps of a survey of a scene."""
        path = survey.path
        scans, begins, sensors, places, turns, mounts, done = [], [], [], [], [], [], 0
        for number, (carried, steps) in enumerate(
            zip(survey.carried, survey.steps_each, strict=True)
        ):
            firsts, since = _of_head(carried.sensor, steps)
            mount = carried.mount
            turned = np.eye(3) if mount.rotation is None else mount.rotation
            mounts.append((mount.position, turned))
            for station in range(path.stations):
                positions, rotations = _poses(survey, station, since)
                places.append(positions + rotations @ np.array(mount.position))
                turns.append(rotations @ turned)
                begins.append(station * survey.station_ns + since)
                scans.append(done + firsts)
                done += steps
            sensors.append(np.full(len(since) * path.stations, number, np.uint8))
        when = np.concatenate(begins)
        actor_poses = []
        for actor in scene.actors:
            at, turned_by = actor.trajectory.poses(0, when)
            actor_poses.append(_placed(at + scene.origin, _full(turned_by, len(when))))
        bounds = [
            np.stack([a.mesh.vertices.min(axis=0), a.mesh.vertices.max(axis=0)])
            for a in scene.actors
        ]
        return cls(
            np.append(np.concatenate(scans), done),
            when,
            np.concatenate(sensors),
            _placed(np.concatenate(places) + scene.origin, np.concatenate(turns)),
            _placed(*(np.array(part) for part in zip(*mounts, strict=True))),
            tuple(carried.name for carried in survey.carried),
            tuple(scene.names),
            tuple(actor.name for actor in scene.actors),
            tuple(actor_poses),
            np.array(bounds).reshape(-1, 2, 3),
            survey.coordinates,
            survey.precision_m,
            survey.epsg,
            None if survey.start is None else nanoseconds(survey.start),
        )

    def points(self, cloud: CloudLike, first: int = 0, stop: int | None = None) -> Iterator[Cloud]:
        """Yield the points of each sweep from `first` to `stop` in order, also of empty ones.

        Raises
        ------
        LidarpoolError
            If they are not in the order of scans, or of another survey.
        """
        held: list[Cloud] = []
        empty = Cloud(np.empty((0, 3)), {c.name: np.empty(0, c.dtype) for c in cloud.table})
        current, stop = first, len(self) if stop is None else stop
        for chunk in cloud.chunks(_PIECE, cloud.row_of(int(self.scans[first])) if first else 0):
            sweep = np.searchsorted(self.scans, chunk["scan"], "right") - 1
            if sweep[0] < current or sweep[-1] >= len(self) or (np.diff(sweep) < 0).any():
                raise LidarpoolError(MIXED_UP)
            end = int(np.searchsorted(sweep, stop))
            starts = np.flatnonzero(np.diff(sweep[:end], prepend=-1))
            for start, after in pairwise([*starts, end]):
                while current < sweep[start]:
                    yield Cloud.joined(held) if held else empty
                    held, current = [], current + 1
                held.append(chunk.part(slice(start, after)))
            if end < len(sweep):
                break
        while current < stop:
            yield Cloud.joined(held) if held else empty
            held, current = [], current + 1

    def save(self, path: Path) -> None:
        """Write it as a NumPy archive; OSError if it cannot be written."""
        words = {
            "format": _FORMAT,
            "sensors": self.sensors,
            "objects": self.objects,
            "actors": self.actors,
            "coordinates": self.coordinates,
            "precision_m": self.precision_m,
            "epsg": self.epsg,
            "start_ns": self.start_ns,
        }
        arrays: dict[str, Any] = {
            "words": np.frombuffer(json.dumps(words).encode(), np.uint8),
            "scans": self.scans,
            "begins_ns": self.begins_ns,
            "sensor": self.sensor,
            "positions": self.pose.positions,
            "quaternions": self.pose.quaternions,
            "mount_positions": self.mounts.positions,
            "mount_quaternions": self.mounts.quaternions,
            "actor_bounds": self.actor_bounds,
        }
        for number, placed in enumerate(self.actor_poses):
            arrays[f"actor{number}_positions"] = placed.positions
            arrays[f"actor{number}_quaternions"] = placed.quaternions
        memory = io.BytesIO()  # NumPy leaves its own file open if it cannot write it
        np.savez_compressed(memory, **arrays)
        path.write_bytes(memory.getbuffer())

    def _check(self) -> None:
        """ValueError if arrays of a file do not fit together."""
        count = len(self)
        shapes = {
            (self.begins_ns.shape, (count,)),
            (self.scans.shape, (count + 1,)),
            (self.sensor.shape, (count,)),
            (self.actor_bounds.shape, (len(self.actors), 2, 3)),
        }
        each = [(placed, count) for placed in (self.pose, *self.actor_poses)]
        for placed, many in (*each, (self.mounts, len(self.sensors))):
            shapes |= {(placed.positions.shape, (many, 3)), (placed.quaternions.shape, (many, 4))}
        wrong = [f"{one} for {other}" for one, other in shapes if one != other]
        if wrong or (count and self.sensor.max() >= len(self.sensors)):
            raise ValueError(f"its arrays do not fit together {'; '.join(wrong[:1])}".strip())

    @classmethod
    def load(cls, path: Path) -> Sweeps:
        """Read what `save` wrote; nothing in the file is run.

        Raises
        ------
        LidarpoolError
            If it cannot be read, is damaged, or of another version.
        """
        try:
            with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
                words = json.loads(arrays["words"].tobytes())
                if words["format"] != _FORMAT:
                    raise ValueError(f"it is of format {words['format']}, not {_FORMAT}")
                poses = [
                    Placed(arrays[f"actor{k}_positions"], arrays[f"actor{k}_quaternions"])
                    for k in range(len(words["actors"]))
                ]
                found = cls(
                    arrays["scans"],
                    arrays["begins_ns"],
                    arrays["sensor"],
                    Placed(arrays["positions"], arrays["quaternions"]),
                    Placed(arrays["mount_positions"], arrays["mount_quaternions"]),
                    tuple(words["sensors"]),
                    tuple(words["objects"]),
                    tuple(words["actors"]),
                    tuple(poses),
                    arrays["actor_bounds"],
                    words["coordinates"],
                    words["precision_m"],
                    words["epsg"],
                    words["start_ns"],
                )
            found._check()
            return found
        except OSError as error:
            raise LidarpoolError(f"{path} cannot be read: {error.strerror or error}.") from error
        except Exception as error:  # zipfile, zlib and NumPy have many
            raise LidarpoolError(
                f"{path} is damaged or not of this version of lidarpool "
                f"({' '.join(str(error).split())}): run the survey again."
            ) from error


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


def _of_head(sensor: Sensor, steps: int) -> tuple[NDArray[np.int64], Floats]:
    """First time step of each of so many sweeps, and their starts since that of the station."""
    firsts = np.flatnonzero(np.diff(sensor.turns(np.arange(steps)), prepend=-1))
    begins = sensor.begins_ns(np.array([sensor.firings(step)[0] for step in firsts.tolist()]))
    return firsts, begins + sensor.lead_ns


def _poses(survey: Survey, station: int, since: Floats) -> tuple[Floats, Floats]:
    if survey.path.moves:
        positions, rotations = survey.path.poses(station, since)
        return positions, _full(rotations, len(since))
    pose = survey.path.pose(station)
    positions = np.broadcast_to(np.array(pose.position), (len(since), 3))
    rotation = None if pose.rotation is None else np.broadcast_to(pose.rotation, (len(since), 3, 3))
    return positions, _full(rotation, len(since))


def _full(rotations: Floats | None, count: int) -> Floats:
    return np.broadcast_to(np.eye(3), (count, 3, 3)) if rotations is None else rotations


def _placed(positions: Floats, rotations: Floats) -> Placed:
    quaternions = quaternions_of(rotations)
    quaternions[quaternions[:, 3] < 0] *= -1  # of the two that mean the same
    return Placed(np.array(positions), quaternions)

"""Traffic from traces in the Open Simulation Interface (ASAM OSI)."""

from __future__ import annotations

from array import array
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from lidarsim.environment.extras import reading, require_package
from lidarsim.errors import LidarError
from lidarsim.motion.rotations import quaternions_of, rotations_of
from lidarsim.motion.trajectory import Track
from lidarsim.numerics.arrays import Floats
from lidarsim.scene.scene_mesh import SceneMesh
from lidarsim.words import plural

from .osi_trace import iter_ground_truth
from .traffic import (
    HOST,
    TrafficClock,
    TrafficContent,
    TrafficSection,
    TravelerFilter,
    VehicleSection,
)

_MAX_SIZE_M = 1e4  # longer than any ship or train
# Number of values in a row: x, y and z of the box center in meters, and yaw, pitch and roll in
# radians.
_ROW = 6


@dataclass(frozen=True, eq=False)
class OsiPassage:
    """A moving object during a series of consecutive messages that contain it."""

    name: str  # ID of the object
    kind: str  # type of the object, such as "heavy_truck"
    size: tuple[float, float, float] | None  # length, width and height in meters, None if unknown
    times_s: array[float] = field(default_factory=lambda: array("d"))
    rows: array[float] = field(default_factory=lambda: array("d"))  # `_ROW` values at each time

    def entry(self, section: TrafficSection) -> VehicleSection | None:
        """Return the first entry that matches the type, or a box with the object's size.

        Return None if no entry matches and the size is unknown. In this case, the object is the
        platform, because other objects without a shape are skipped.
        """
        matching = section.find_entry(self.kind)
        if matching is not None or self.size is None:
            return matching
        return VehicleSection(box=self.size)

    def track(
        self, section: TrafficSection, mesh: SceneMesh | None, origin: Floats, start_s: float
    ) -> Track:
        """Return the trajectory of a mesh's origin in local coordinates.

        Positions in OSI refer to the center of the bounding box of the object. The mesh is placed
        on the bottom of this box and centered horizontally. If `mesh` is None, the trajectory is
        that of the box center. If `section.surfaces` is set, the heights are relative to these
        surfaces.
        """
        rows = np.array(self.rows).reshape(-1, _ROW)
        centers = rows[:, :3] + section.translation
        angles_deg = np.degrees(rows[:, 3:])
        offset = np.zeros(3)
        if mesh is not None:
            lower, upper = mesh.bounds
            height_m = upper[2] - lower[2] if self.size is None else self.size[2]
            offset = np.array([*(lower[:2] + upper[:2]) / 2, lower[2] + height_m / 2])
        if section.surfaces:
            centers[:, 2] = section.translation[2] + offset[2]
            angles_deg[:, 1:] = 0.0
        rotations = rotations_of(angles_deg)
        positions = centers - rotations @ offset - origin
        smooth = section.interpolation == "smooth"
        times = np.array(self.times_s) + section.offset_s
        return Track(times, positions, quaternions_of(rotations), smooth, start_s, beyond="absent")


class _PassageCollector:
    """Collector that combines messages into passages.

    Of the messages before the first time, only the last is kept.
    """

    def __init__(self, section: TrafficSection, first_s: float, travelers: TravelerFilter) -> None:
        self.passages: list[OsiPassage] = []
        self.travelers: dict[int, tuple[int, OsiPassage]] = {}  # {ID: (last message, passage)}
        self.shapeless: dict[int, str] = {}  # {ID: type} of objects without a size and an entry
        self.time_s = -np.inf
        self.message = -1
        self._section = section
        self._clock = TrafficClock(section.time_unit)
        self._first_s = first_s
        self._filter = travelers
        self.left_out: set[str] = set()  # IDs that the filter excludes

    def add_message(self, truth: Any) -> None:
        """Add the moving objects of a GroundTruth message.

        Raise ValueError if the message is invalid.
        """
        if truth.timestamp is None:
            raise ValueError("a message has no timestamp")
        time_s = self._clock.seconds(truth.timestamp.seconds + truth.timestamp.nanos / 1e9)
        if time_s < self.time_s:
            raise ValueError(f"the time {time_s:g} s is before the previous time {self.time_s:g} s")
        if time_s == self.time_s:  # the message comes from another topic or another sensor
            return
        self.time_s = time_s
        self.message += 1
        host = None if truth.host_vehicle_id is None else truth.host_vehicle_id.value
        for moving in truth.moving_object:
            identity = 0 if moving.id is None else int(moving.id.value)
            is_host = identity == host
            identities = (str(identity), HOST) if is_host else (str(identity),)
            if not self._filter.matches(*identities):
                self.left_out.update(identities)
            elif not is_host or self._section.host or self._filter.only is not None:
                self._add_object(identity, moving)

    def _add_object(self, identity: int, moving: Any) -> None:
        passage = self._passage(identity, moving)
        if passage is None:
            return
        if self.time_s <= self._first_s:
            del passage.times_s[:], passage.rows[:]
        row = _pose_row(moving)
        if not np.isfinite(row).all():
            raise ValueError(f"moving object {identity} has no finite pose at {self.time_s:g} s")
        passage.times_s.append(self.time_s)
        passage.rows.extend(row)

    def _passage(self, identity: int, moving: Any) -> OsiPassage | None:
        """Return the passage that an object continues, or start a new passage.

        Return None if the object has no shape, unless it is the only object to read.
        """
        last_message, passage = self.travelers.get(identity, (-2, None))
        if passage is None or last_message < self.message - 1:
            kind = _object_type(moving)
            size = _object_size(moving)
            is_shapeless = size is None and self._section.find_entry(kind) is None
            if is_shapeless and self._filter.only is None:
                self.shapeless[identity] = kind
                return None
            passage = OsiPassage(str(identity), kind, size)
            self.passages.append(passage)
        self.travelers[identity] = self.message, passage
        return passage


def read_osi(
    path: Path,
    section: TrafficSection,
    first_s: float,
    last_s: float,
    travelers: TravelerFilter = TravelerFilter(),  # noqa: B008 - immutable
) -> TrafficContent:
    """Read the moving objects between two times in an OSI trace.

    The data includes the last message before and the first message after this interval. Other
    messages are discarded while the file is read.

    Parameters
    ----------
    path, section, first_s, last_s, travelers
        As for `read_fcd`.

    Raises
    ------
    LidarError
        If betterosi is not installed, or if the file cannot be read or has no ground truth.
    """
    require_package("betterosi", "osi", f"Reading {path}")
    collector = _PassageCollector(section, first_s, travelers)
    stationary = 0
    for truth in iter_ground_truth(path):
        previous_s = collector.time_s
        with reading(str(path)):
            collector.add_message(truth)
        stationary = max(stationary, len(truth.stationary_object))
        if previous_s > last_s:  # the first message after the last time is needed as well
            break
    if collector.message < 0:
        raise LidarError(
            f"{path} contains no ground truth. It must contain GroundTruth messages, or SensorView "
            "messages with ground truth."
        )
    notes = []
    if collector.shapeless:
        kinds = ", ".join(sorted(set(collector.shapeless.values())))
        notes.append(
            f"{plural(len(collector.shapeless), 'moving object')} in {section.file} "
            f"{'was' if len(collector.shapeless) == 1 else 'were'} skipped because of missing "
            f"dimensions ({kinds}). Add entries for these types to `traffic.vehicles`"
        )
    if stationary:
        notes.append(
            f"{plural(stationary, 'stationary object')} in {section.file} "
            f"{'was' if stationary == 1 else 'were'} skipped, because only moving objects are "
            "actors"
        )
    present = [
        passage
        for passage in collector.passages
        if len(passage.times_s) > 1 and passage.times_s[-1] >= first_s
    ]
    counted = plural(len(collector.travelers), "moving object")
    return TrafficContent(present, counted, collector.left_out, notes)


def _pose_row(moving: Any) -> list[float]:
    """Return the pose of a moving object as a row of `OsiPassage.rows`.

    If the object has no position, all values are NaN.
    """
    base = moving.base
    if base is None or base.position is None:
        return _ROW * [np.nan]
    position = base.position
    angles = base.orientation
    rotation = [0.0, 0.0, 0.0] if angles is None else [angles.yaw, angles.pitch, angles.roll]
    return [position.x, position.y, position.z, *rotation]


def _object_size(moving: Any) -> tuple[float, float, float] | None:
    """Return the length, width and height of a moving object, or None if they are unknown.

    Raise ValueError if a dimension is implausible.
    """
    size = None if moving.base is None else moving.base.dimension
    if size is None:
        return None
    sides = (size.length, size.width, size.height)
    if sides == (0.0, 0.0, 0.0):
        return None
    if not all(0 < side <= _MAX_SIZE_M for side in sides):
        raise ValueError(f"a moving object has the invalid dimensions {sides} m")
    return sides


def _object_type(moving: Any) -> str:
    """Return the type of a moving object in lower case.

    The type of a vehicle is taken from its classification, if that is known.
    """
    kind = getattr(moving.type, "name", "").lower()
    if kind == "vehicle" and moving.vehicle_classification is not None:
        vehicle = getattr(moving.vehicle_classification.type, "name", "").lower()
        return kind if vehicle in ("", "unknown", "other") else vehicle
    return kind if kind not in ("", "unknown") else "object"

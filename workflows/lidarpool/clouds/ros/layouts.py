"""Layouts of the points of a PointCloud2, as drivers of ROS 2 publish them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from lidarsim.base.arrays import AnyArray, Floats, Ints, Records
from lidarsim.columns.cloud import Cloud
from lidarsim.columns.sweep import Sweep
from lidarsim.columns.table import COLORS, SURFACE_COLUMNS, VELOCITY
from lidarsim.scene.colors import as_float
from lidarsim.sensor.optics import TWO_RETURNS
from lidarsim.sensor.reflectivity import COUNTS
from lidarsim.sweeps.lidar_traits import LidarTraits
from lidarsim.sweeps.sweeps import Sweeps

from ..frame_names import survey_start_ns

# Types of returns of Autoware's sensor drivers.
UNKNOWN, LAST, FIRST, STRONGEST, FIRST_WEAK, LAST_WEAK = range(6)
IDENTICAL, SECOND, _, FIRST_STRONGEST, LAST_STRONGEST = range(6, 11)
_SINGLE_RETURN_TYPES = {"strongest": STRONGEST, "first": FIRST, "last": LAST}

_XYZ = [("x", "<f4"), ("y", "<f4"), ("z", "<f4")]
_XYZI = [*_XYZ, ("intensity", "<f4")]
# Additional fields after the layout: {name: (type, columns that the field needs)}.
EXTRA_FIELDS = {
    "rgb": ("<f4", {*COLORS}),
    VELOCITY: ("<f4", {VELOCITY}),
    "label": ("<u4", {"class"}),
    **{name: ("<f4", {name}) for name in SURFACE_COLUMNS},
    "material": ("<i4", {"material"}),
}


class PointLayout(ABC):
    """Layout of the points of a driver: fields of a point, and their values.

    Attributes
    ----------
    fields
        Type of a point.
    compensated_fields
        Type of a point that is compensated for motion, which has no time.
    time_field
        Name of the field of times, which compensated points lack.
    ring_field
        Name of the field of channels.
    full_intensity
        Value of the field `intensity` at an intensity of 1, or of a reflectivity at its maximum.
    columns
        Columns that the layout requires and stores, in addition to those of all bags.
    lines
        Lines of an organized cloud, "firings" or "channels"; empty if drivers publish none.
    """

    fields: ClassVar[np.dtype[np.void]]
    compensated_fields: ClassVar[np.dtype[np.void]]
    columns: ClassVar[tuple[str, ...]]
    time_field: ClassVar[str]
    ring_field: ClassVar[str] = "ring"
    full_intensity: ClassVar[float] = 1
    lines: ClassVar[str] = ""
    no_intensity: ClassVar[float] = 0  # value of rays without return, in organized clouds

    @abstractmethod
    def values(self, sweep: Sweep, traits: LidarTraits) -> dict[str, AnyArray]:
        """Return values of fields, {name: (n,)}, beside position, ring and time.

        `traits` are those of the sensor.
        """

    @abstractmethod
    def times(self, since_ns: Floats, stamp_ns: int) -> AnyArray:
        """Return the field of times of firings (n,), nanoseconds since the stamp of the message.

        `stamp_ns` is the stamp, nanoseconds since 1970.
        """

    @abstractmethod
    def since_ns(self, times: AnyArray, stamp_ns: int) -> Floats:
        """Return the firings (n,), nanoseconds since the stamp: the inverse of `times`."""

    def rings(self, channels: Ints, traits: LidarTraits) -> Ints:
        """Return the field of rings of channels (n,).

        Channel 0 is the lowest beam.
        """
        del traits
        return channels

    def channels(self, rings: Ints, traits: LidarTraits) -> Ints:
        """Return the channels (n,) of rings: the inverse of `rings`."""
        return self.rings(rings, traits)

    def row(self, extra: Sequence[str], *, compensated: bool) -> np.dtype[np.void]:
        """Return the type of a point, followed by additional fields."""
        row = self.compensated_fields if compensated else self.fields
        if not extra:
            return row
        kinds = {name: (kind, offset) for name, (kind, offset, *_) in (row.fields or {}).items()}
        end = max(offset + kind.itemsize for kind, offset in kinds.values())
        for name in extra:
            kinds[name] = kind, _ = np.dtype(EXTRA_FIELDS[name][0]), end
            end += kind.itemsize
        formats, offsets = map(list, zip(*kinds.values(), strict=True))
        size = max(row.itemsize, end)
        return np.dtype(
            {"names": [*kinds], "formats": formats, "offsets": offsets, "itemsize": size}
        )


class VelodyneLayout(PointLayout):
    """Layout of velodyne_pointcloud.

    Times are seconds since the stamp.
    """

    columns: ClassVar[tuple[str, ...]] = ("intensity", "time")
    fields = np.dtype([*_XYZI, ("ring", "<u2"), ("time", "<f4")])
    compensated_fields = np.dtype(fields.descr[:-1])
    time_field = "time"
    lines = "firings"
    no_intensity = np.nan

    def values(self, sweep: Sweep, traits: LidarTraits) -> dict[str, AnyArray]:
        """Return the energy."""
        del traits
        return {"intensity": sweep.columns["intensity"]}

    def times(self, since_ns: Floats, stamp_ns: int) -> AnyArray:
        """Return seconds since the stamp."""
        del stamp_ns
        return since_ns / 1e9

    def since_ns(self, times: AnyArray, stamp_ns: int) -> Floats:
        """Return nanoseconds since the stamp."""
        del stamp_ns
        return times.astype(np.float64) * 1e9


class ImagesLayout(VelodyneLayout):
    """Layout of velodyne_pointcloud with range images, which need all rays and every return."""

    columns = ("intensity", "time", "ray", "range")


class _CountedNanoseconds(PointLayout):
    """Layouts whose times are whole nanoseconds since the stamp, in 32 bits."""

    def times(self, since_ns: Floats, stamp_ns: int) -> AnyArray:
        """Return nanoseconds since the stamp, which a sensor without rotation may exceed."""
        del stamp_ns
        return np.clip(since_ns, 0, 2**32 - 1)

    def since_ns(self, times: AnyArray, stamp_ns: int) -> Floats:
        """Return nanoseconds since the stamp."""
        del stamp_ns
        return times.astype(np.float64)


class AutowareLayout(_CountedNanoseconds):
    """Layout of nebula, Autoware's driver: PointXYZIRCAEDT, or PointXYZIRC if compensated."""

    columns = ("intensity", "time", "return_number", "returns")
    fields = np.dtype([
        *_XYZ, ("intensity", "u1"), ("return_type", "u1"), ("channel", "<u2"), ("azimuth", "<f4"),
        ("elevation", "<f4"), ("distance", "<f4"), ("time_stamp", "<u4"),
    ])  # fmt: skip
    compensated_fields = np.dtype(fields.descr[:6])
    time_field = "time_stamp"
    ring_field = "channel"
    full_intensity = 255

    def values(self, sweep: Sweep, traits: LidarTraits) -> dict[str, AnyArray]:
        """Return energy, type of return, and polar coordinates of the positions."""
        x, y, z = sweep.points.astype(np.float64).T
        level = np.hypot(x, y)
        zero = np.radians(traits.zero_deg)
        return {
            "intensity": np.round(np.clip(sweep.columns["intensity"], 0, 1) * 255),
            "return_type": _return_types(sweep.columns, traits.mode),
            "azimuth": (zero - np.arctan2(y, x)) % (2 * np.pi),
            "elevation": np.arctan2(z, level),
            "distance": np.hypot(level, z),
        }


class OusterLayout(_CountedNanoseconds):
    """Layout of ouster-ros (`original`).

    Ring 0 is the highest beam.
    """

    columns = ("signal", "time", "reflectivity", "range")
    fields = np.dtype({
        "names": ["x", "y", "z", "intensity", "t", "reflectivity", "ring", "ambient", "range"],
        "formats": ["<f4", "<f4", "<f4", "<f4", "<u4", "<u2", "<u2", "<u2", "<u4"],
        "offsets": [0, 4, 8, 16, 20, 24, 26, 28, 32],
        "itemsize": 48,
    })  # fmt: skip
    compensated_fields = np.dtype({
        "names": ["x", "y", "z", "intensity", "reflectivity", "ring", "ambient", "range"],
        "formats": ["<f4", "<f4", "<f4", "<f4", "<u2", "<u2", "<u2", "<u4"],
        "offsets": [0, 4, 8, 16, 24, 26, 28, 32],
        "itemsize": 48,
    })  # fmt: skip
    time_field = "t"
    full_intensity = COUNTS
    lines = "channels"

    def values(self, sweep: Sweep, traits: LidarTraits) -> dict[str, AnyArray]:
        """Return the signal, the reflectivity, and the sensor's range in millimeters."""
        columns = sweep.columns
        range_m = columns["range"].astype(np.float64) + traits.range_offset_m
        return {
            "intensity": columns["signal"],
            "reflectivity": columns["reflectivity"],
            "range": np.round(range_m * 1000),
        }

    def rings(self, channels: Ints, traits: LidarTraits) -> Ints:
        """Return rows of the sensor's image."""
        return np.maximum(traits.channels - 1 - channels.astype(np.int64), 0)


class _Reflectivities(PointLayout):
    """Layouts whose intensity is the maker's reflectivity, and whose times are absolute."""

    columns = ("reflectivity", "time")
    full_intensity = 255
    unit_ns: ClassVar[float] = 1e9  # nanoseconds in a unit of the field of times

    def values(self, sweep: Sweep, traits: LidarTraits) -> dict[str, AnyArray]:
        """Return the reflectivity."""
        del traits
        return {"intensity": sweep.columns["reflectivity"]}

    def times(self, since_ns: Floats, stamp_ns: int) -> AnyArray:
        """Return times since 1970."""
        # Whole nanoseconds first: near 1e18, float64 counts steps of 128 ns.
        return (np.rint(since_ns).astype(np.int64) + stamp_ns) / self.unit_ns

    def since_ns(self, times: AnyArray, stamp_ns: int) -> Floats:
        """Return nanoseconds since the stamp."""
        return (times - stamp_ns / self.unit_ns) * self.unit_ns


class HesaiLayout(_Reflectivities):
    """Layout of HesaiLidar_ROS_2.0.

    Times are seconds since 1970, rings the maker's channels.
    """

    fields = np.dtype([*_XYZI, ("ring", "<u2"), ("timestamp", "<f8")])
    compensated_fields = np.dtype(fields.descr[:-1])
    time_field = "timestamp"

    def rings(self, channels: Ints, traits: LidarTraits) -> Ints:
        """Return the maker's numbers of the channels, from 0, by default from the highest."""
        return _maker_numbers(traits)[channels]

    def channels(self, rings: Ints, traits: LidarTraits) -> Ints:
        """Return the channels of the maker's numbers."""
        return np.argsort(_maker_numbers(traits))[rings]


class RoboSenseLayout(_Reflectivities):
    """Layout of rslidar_sdk (`XYZIRT`).

    Times are seconds since 1970, ring 0 is the lowest beam.
    """

    fields = HesaiLayout.fields
    compensated_fields = HesaiLayout.compensated_fields
    time_field = "timestamp"
    lines = "firings"


class LivoxLayout(_Reflectivities):
    """Layout of livox_ros_driver2 (PointXYZRTLT).

    Times are nanoseconds since 1970.

    All points have the tag 0, a normal point.
    """

    fields = np.dtype([*_XYZI, ("tag", "u1"), ("line", "u1"), ("timestamp", "<f8")])
    compensated_fields = np.dtype(fields.descr[:-1])
    time_field = "timestamp"
    ring_field = "line"
    unit_ns = 1


LAYOUTS: dict[str, PointLayout] = {
    "velodyne": VelodyneLayout(),
    "autoware": AutowareLayout(),
    "ouster": OusterLayout(),
    "images": ImagesLayout(),
    "livox": LivoxLayout(),
    "hesai": HesaiLayout(),
    "robosense": RoboSenseLayout(),
}


@dataclass(frozen=True)
class LaidOut:
    """How points of a survey are laid out in messages."""

    name: str  # name of the layout in `LAYOUTS`
    compensated: bool = False  # points in the sensor's axes at the start of the sweep, no times
    organized: bool = False  # a point for each ray, NaN without a return

    @property
    def layout(self) -> PointLayout:
        """The layout."""
        return LAYOUTS[self.name]

    def row(self, columns: set[str]) -> np.dtype[np.void]:
        """Return the type of a point.

        `columns` are the names of the columns of the cloud.
        """
        extra = [name for name, (_, needs) in EXTRA_FIELDS.items() if needs <= columns]
        return self.layout.row(extra, compensated=self.compensated)


def point_rows(
    laid_out: LaidOut, row: np.dtype[np.void], points: Cloud, sweeps: Sweeps, sweep: int
) -> Records:
    """Return the points of a sweep in a layout, of the type of its `row`."""
    layout = laid_out.layout
    traits = sensor_traits(sweeps, sweep)
    if laid_out.compensated:
        positions = sweeps.compensated(sweep, points).astype(np.float32)
        columns = sweeps.columns_compensated(sweep, points)
    else:
        positions = sweeps.as_fired(sweep, points).astype(np.float32)
        columns = sweeps.columns_as_fired(sweep, points)
    values: dict[str, AnyArray] = dict(zip("xyz", positions.T, strict=True))
    values |= layout.values(Sweep(positions, columns), traits)
    values[layout.ring_field] = layout.rings(columns["channel"], traits)
    if not laid_out.compensated:
        since_ns = since_stamp_ns(points, sweeps, sweep)
        values[layout.time_field] = layout.times(since_ns, message_stamp_ns(sweeps, sweep))
    if "rgb" in (row.names or ()):
        values["rgb"] = as_float(*(columns[name] for name in COLORS))
    same_names = ((name, name) for name in (VELOCITY, *SURFACE_COLUMNS, "material"))
    for name, column in (*same_names, ("label", "class")):
        if name in (row.names or ()):
            values[name] = columns[column]
    rows = np.zeros(len(points), row)
    for name in row.names or ():
        if name in values:
            rows[name] = values[name]
    return rows


def since_stamp_ns(points: Cloud, sweeps: Sweeps, sweep: int) -> AnyArray:
    """Return the firings of points of a sweep, nanoseconds since the stamp of the message: (n,)."""
    begin_ns = sweeps.begins_ns[sweep]
    return points["time"] - (begin_ns + sweeps.stamp_ns(sweep) - round(begin_ns))


def message_stamp_ns(sweeps: Sweeps, sweep: int) -> int:
    """Return the stamp of a sweep's message, nanoseconds since 1970."""
    return survey_start_ns(sweeps) + sweeps.stamp_ns(sweep)


def sensor_traits(sweeps: Sweeps, sweep: int) -> LidarTraits:
    """Return the traits of the sensor of a sweep."""
    return sweeps.lidars[sweeps.sensor[sweep]]


def _maker_numbers(traits: LidarTraits) -> Ints:
    """Return the maker's number of each channel (c,), from 0, by default from the highest."""
    if traits.lasers:
        return np.array(traits.lasers, np.int64)
    return np.arange(traits.channels)[::-1]


def _return_types(columns: Mapping[str, AnyArray], mode: str) -> AnyArray:
    """Return Autoware's types of the returns of a sweep, (n,).

    Returns follow their pulses.

    Of two returns of a pulse the nearer is first, and the brighter is strong; of two equally bright
    returns, the farther. A single return of a pulse is all of these.
    """
    number = columns["return_number"]
    returns = columns["returns"]
    count = len(number)
    if mode in _SINGLE_RETURN_TYPES:
        return np.full(count, _SINGLE_RETURN_TYPES[mode])
    types = np.full(count, UNKNOWN)
    types[number == 2] = SECOND
    types[number == 1] = FIRST
    types[number == returns] = LAST
    types[returns == 1] = IDENTICAL
    if mode not in TWO_RETURNS or count < 2:
        return types
    pairs = (number[:-1] == 1) & (returns[:-1] == 2) & (number[1:] == 2) & (returns[1:] == 2)
    first = np.flatnonzero(pairs)
    intensity = columns["intensity"]
    brighter = intensity[first] > intensity[first + 1]
    types[first] = np.where(brighter, FIRST_STRONGEST, FIRST_WEAK)
    types[first + 1] = np.where(brighter, LAST_WEAK, LAST_STRONGEST)
    return types

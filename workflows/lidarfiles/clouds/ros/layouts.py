"""Layouts of points in PointCloud2 messages, as published by ROS 2 drivers."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from lidarsim.columns.cloud import Cloud
from lidarsim.columns.sweep import Sweep
from lidarsim.columns.table import COLORS, SURFACE_COLUMNS, VELOCITY
from lidarsim.numerics.arrays import AnyArray, Floats, Ints, Records
from lidarsim.scene.colors import pack_as_float
from lidarsim.sensor.optics import SINGLE_RETURN, TWO_RETURNS
from lidarsim.sensor.reflectivity import COUNTS
from lidarsim.sweeps.lidar_traits import LidarTraits
from lidarsim.sweeps.sweeps import Sweeps

from ..frame_names import survey_start_ns
from ..point_field import NONE, PointField

# Return types in Autoware.
UNKNOWN, LAST, FIRST, STRONGEST, FIRST_WEAK, LAST_WEAK = range(6)
IDENTICAL, SECOND, _, FIRST_STRONGEST, LAST_STRONGEST = range(6, 11)
_SINGLE_RETURN_TYPES = dict(zip(SINGLE_RETURN, (STRONGEST, FIRST, LAST), strict=True))

_XYZ = [("x", "<f4"), ("y", "<f4"), ("z", "<f4")]
_XYZI = [*_XYZ, ("intensity", "<f4")]
# Additional fields after the layout: {name: (type, columns that the field requires)}.
EXTRA_FIELDS = {
    "rgb": ("<f4", COLORS),
    VELOCITY: ("<f4", (VELOCITY,)),
    "label": ("<u4", ("class",)),
    **{name: ("<f4", (name,)) for name in SURFACE_COLUMNS},
    "material": ("<i4", ("material",)),
}


class PointLayout(ABC):
    """Layout in which a driver publishes points.

    It defines the fields of a point and their values.

    Attributes
    ----------
    fields
        Type of a point.
    compensated_fields
        Type of a motion-compensated point, which has no time.
    time_field
        Name of the time field, which compensated points do not have.
    ring_field
        Name of the ring field.
    full_intensity
        Value of the field `intensity` for an intensity of 1, or for the maximum reflectivity.
    point_fields
        Fields except the position, with the columns from which they are filled.
    lines
        Rows of an organized cloud: "firings", "channels", or an empty string if the driver does not
        publish organized clouds.
    no_intensity
        Intensity of rays without a return in organized clouds.
    """

    fields: ClassVar[np.dtype[np.void]]
    compensated_fields: ClassVar[np.dtype[np.void]]
    point_fields: ClassVar[tuple[PointField, ...]]
    time_field: ClassVar[str]
    ring_field: ClassVar[str] = "ring"
    full_intensity: ClassVar[float] = 1
    lines: ClassVar[str] = ""
    no_intensity: ClassVar[float] = 0

    @classmethod
    def has_energies(cls) -> bool:
        """Return whether the field `intensity` contains energies, rather than reflectivities."""
        (field,) = (field for field in cls.point_fields if field.name == "intensity")
        return field.columns in (("intensity",), ("signal",))

    @abstractmethod
    def values(self, sweep: Sweep, traits: LidarTraits) -> dict[str, AnyArray]:
        """Return the values of all fields except position, ring and time, keyed by field name.

        `traits` describes the sensor of the sweep.
        """

    @abstractmethod
    def times(self, since_ns: Floats, stamp_ns: int) -> AnyArray:
        """Convert firing times to values of the time field.

        Parameters
        ----------
        since_ns
            Firing times in nanoseconds since the timestamp of the message.
        stamp_ns
            Timestamp of the message in nanoseconds since 1970.
        """

    @abstractmethod
    def since_ns(self, times: AnyArray, stamp_ns: int) -> Floats:
        """Convert time field values to nanoseconds since the timestamp (inverse of `times`)."""

    def rings(self, channels: Ints, traits: LidarTraits) -> Ints:
        """Convert channels, where 0 is the lowest beam, to values of the ring field."""
        del traits
        return channels

    def channels(self, rings: Ints, traits: LidarTraits) -> Ints:
        """Convert values of the ring field to channels (inverse of `rings`)."""
        return self.rings(rings, traits)

    def row(self, extra: Sequence[str], *, compensated: bool) -> np.dtype[np.void]:
        """Return the type of a point with additional fields at its end."""
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
    """Layout of velodyne_pointcloud, with times in seconds since the timestamp."""

    point_fields: ClassVar[tuple[PointField, ...]] = (
        PointField("intensity", ("intensity",)),
        PointField("ring", ("channel",)),
        PointField("time", ("time",)),
    )
    fields = np.dtype([*_XYZI, ("ring", "<u2"), ("time", "<f4")])
    compensated_fields = np.dtype(fields.descr[:-1])
    time_field = "time"
    lines = "firings"
    no_intensity = np.nan

    def values(self, sweep: Sweep, traits: LidarTraits) -> dict[str, AnyArray]:
        """Return the intensity, which is the energy of the return."""
        del traits
        return {"intensity": sweep.columns["intensity"]}

    def times(self, since_ns: Floats, stamp_ns: int) -> AnyArray:
        """Convert nanoseconds to seconds since the timestamp."""
        del stamp_ns
        return since_ns / 1e9

    def since_ns(self, times: AnyArray, stamp_ns: int) -> Floats:
        """Convert seconds to nanoseconds since the timestamp."""
        del stamp_ns
        return times.astype(np.float64) * 1e9


class ImagesLayout(VelodyneLayout):
    """Layout of velodyne_pointcloud with range images.

    Range images require all returns.
    """

    point_fields = (
        *VelodyneLayout.point_fields,
        PointField("pixel of the range image", ("ray", "range")),
    )


class _CountedNanoseconds(PointLayout):
    """Base class for layouts with times in nanoseconds since the timestamp, as 32-bit integers."""

    def times(self, since_ns: Floats, stamp_ns: int) -> AnyArray:
        """Clip times to 32 bits, because sweeps of non-rotating sensors can exceed this range."""
        del stamp_ns
        return np.clip(since_ns, 0, 2**32 - 1)

    def since_ns(self, times: AnyArray, stamp_ns: int) -> Floats:
        del stamp_ns
        return times.astype(np.float64)


class AutowareLayout(_CountedNanoseconds):
    """Layout of nebula, the driver of Autoware.

    Points are PointXYZIRCAEDT, or PointXYZIRC if they are motion-compensated.
    """

    point_fields = (
        PointField("intensity", ("intensity",)),
        PointField("return_type", ("return_number", "returns")),
        PointField("channel", ("channel",)),
        PointField("azimuth, elevation, distance", (), source="position"),
        PointField("time_stamp", ("time",)),
    )
    fields = np.dtype([
        *_XYZ, ("intensity", "u1"), ("return_type", "u1"), ("channel", "<u2"), ("azimuth", "<f4"),
        ("elevation", "<f4"), ("distance", "<f4"), ("time_stamp", "<u4"),
    ])  # fmt: skip
    compensated_fields = np.dtype(fields.descr[:6])
    time_field = "time_stamp"
    ring_field = "channel"
    full_intensity = 255

    def values(self, sweep: Sweep, traits: LidarTraits) -> dict[str, AnyArray]:
        """Return the intensity, the return type, and the spherical coordinates of the points."""
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
    """Layout `original` of ouster-ros, in which ring 0 is the highest beam."""

    point_fields = (
        PointField("intensity", ("signal",)),
        PointField("t", ("time",)),
        PointField("reflectivity", ("reflectivity",)),
        PointField("ring", ("channel",)),
        PointField("ambient", (), "0", NONE),
        PointField("range", ("range",)),
    )
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
        """Return the signal, the reflectivity, and the range in millimeters."""
        columns = sweep.columns
        range_m = columns["range"].astype(np.float64) + traits.range_offset_m
        return {
            "intensity": columns["signal"],
            "reflectivity": columns["reflectivity"],
            "range": np.round(range_m * 1000),
        }

    def rings(self, channels: Ints, traits: LidarTraits) -> Ints:
        """Convert channels to rows in the range image of the sensor."""
        return np.maximum(traits.channels - 1 - channels.astype(np.int64), 0)


class _Reflectivities(PointLayout):
    """Base class for layouts with absolute times, whose intensity is the reflectivity."""

    point_fields: ClassVar[tuple[PointField, ...]] = (
        PointField("intensity", ("reflectivity",)),
        PointField("ring", ("channel",)),
        PointField("timestamp", ("time",)),
    )
    full_intensity = 255
    unit_ns: ClassVar[float] = 1e9  # unit of the time field in nanoseconds

    def values(self, sweep: Sweep, traits: LidarTraits) -> dict[str, AnyArray]:
        del traits
        return {"intensity": sweep.columns["reflectivity"]}

    def times(self, since_ns: Floats, stamp_ns: int) -> AnyArray:
        """Convert times relative to the timestamp to times since 1970."""
        # Times are added as integers, because the resolution of float64 near 1e18 is 128 ns.
        return (np.rint(since_ns).astype(np.int64) + stamp_ns) / self.unit_ns

    def since_ns(self, times: AnyArray, stamp_ns: int) -> Floats:
        """Convert times since 1970 to nanoseconds since the timestamp."""
        return (times - stamp_ns / self.unit_ns) * self.unit_ns


class HesaiLayout(_Reflectivities):
    """Layout of HesaiLidar_ROS_2.0.

    Times are in seconds since 1970, and rings have the manufacturer's numbers.
    """

    fields = np.dtype([*_XYZI, ("ring", "<u2"), ("timestamp", "<f8")])
    compensated_fields = np.dtype(fields.descr[:-1])
    time_field = "timestamp"

    def rings(self, channels: Ints, traits: LidarTraits) -> Ints:
        """Convert channels to the channel numbers of the manufacturer."""
        return _maker_numbers(traits)[channels]

    def channels(self, rings: Ints, traits: LidarTraits) -> Ints:
        """Convert channel numbers of the manufacturer to channels."""
        return np.argsort(_maker_numbers(traits))[rings]


class RoboSenseLayout(_Reflectivities):
    """Layout `XYZIRT` of rslidar_sdk.

    Times are in seconds since 1970, and ring 0 is the lowest beam.
    """

    fields = HesaiLayout.fields
    compensated_fields = HesaiLayout.compensated_fields
    time_field = "timestamp"
    lines = "firings"


class LivoxLayout(_Reflectivities):
    """Layout PointXYZRTLT of livox_ros_driver2, with times in nanoseconds since 1970.

    The tag of all points is 0, which marks normal points.
    """

    point_fields = (
        PointField("intensity", ("reflectivity",)),
        PointField("tag", (), "0", NONE),
        PointField("line", ("channel",)),
        PointField("timestamp", ("time",)),
    )
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
class MessageLayout:
    """Layout of points in messages, with the frame and the order of the points."""

    name: str  # name of the layout in `LAYOUTS`
    compensated: bool = False  # whether points are motion-compensated and have no times
    organized: bool = False  # whether there is a point for each ray, with NaN if it has no return

    @property
    def layout(self) -> PointLayout:
        """Layout of a point."""
        return LAYOUTS[self.name]

    def row(self, columns: set[str]) -> np.dtype[np.void]:
        """Return the type of a point, given the names of the columns in the cloud."""
        extra = [name for name, (_, needs) in EXTRA_FIELDS.items() if {*needs} <= columns]
        return self.layout.row(extra, compensated=self.compensated)


def encode_points(
    message_layout: MessageLayout, row: np.dtype[np.void], points: Cloud, sweeps: Sweeps, sweep: int
) -> Records:
    """Convert the points of a sweep, in the frame of the survey, to records of the type `row`.

    The positions in the records are in the sensor frame. The order of the points is kept, also if
    the layout is organized.
    """
    layout = message_layout.layout
    traits = sensor_traits(sweeps, sweep)
    if message_layout.compensated:
        positions = sweeps.compensate_motion(sweep, points).astype(np.float32)
        columns = sweeps.columns_compensated(sweep, points)
    else:
        positions = sweeps.as_fired(sweep, points).astype(np.float32)
        columns = sweeps.columns_as_fired(sweep, points)
    values: dict[str, AnyArray] = dict(zip("xyz", positions.T, strict=True))
    values |= layout.values(Sweep(positions, columns), traits)
    values[layout.ring_field] = layout.rings(columns["channel"], traits)
    if not message_layout.compensated:
        since_ns = since_stamp_ns(points, sweeps, sweep)
        values[layout.time_field] = layout.times(since_ns, message_stamp_ns(sweeps, sweep))
    if "rgb" in (row.names or ()):
        values["rgb"] = pack_as_float(*(columns[name] for name in COLORS))
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
    """Return the firing times of points in nanoseconds since their message's timestamp."""
    begin_ns = sweeps.begins_ns[sweep]
    return points["time"] - (begin_ns + sweeps.stamp_ns(sweep) - round(begin_ns))


def message_stamp_ns(sweeps: Sweeps, sweep: int) -> int:
    """Return the timestamp of a sweep's message in nanoseconds since 1970."""
    return survey_start_ns(sweeps) + sweeps.stamp_ns(sweep)


def sensor_traits(sweeps: Sweeps, sweep: int) -> LidarTraits:
    """Return the traits of the sensor that recorded a sweep."""
    return sweeps.lidars[sweeps.sensor[sweep]]


def _maker_numbers(traits: LidarTraits) -> Ints:
    """Return the manufacturer's number of each channel, starting at 0.

    If the numbers are unknown, channels are numbered from the highest to the lowest beam.
    """
    if traits.lasers:
        return np.array(traits.lasers, np.int64)
    return np.arange(traits.channels)[::-1]


def _return_types(columns: Mapping[str, AnyArray], mode: str) -> AnyArray:
    """Return the Autoware return type of each point in a sweep.

    The points are sorted by pulse. The first of two returns is the nearer one, and the strongest is
    the brighter one. If both are equally bright, the farther return is the strongest. A single
    return has the type IDENTICAL.
    """
    number = columns["return_number"]
    returns = columns["returns"]
    count = len(number)
    if mode in _SINGLE_RETURN_TYPES:
        return np.full(count, _SINGLE_RETURN_TYPES[mode])
    types = np.full(count, UNKNOWN)  # also if the number of returns is 0, which means unknown
    types[number == 2] = SECOND
    types[number == 1] = FIRST
    types[(number == returns) & (returns > 0)] = LAST
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

"""Layouts of the points of a PointCloud2, as drivers of ROS 2 publish them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lidarsim.base.arrays import AnyArray, Floats32, Records
from lidarsim.columns.cloud import Cloud
from lidarsim.columns.table import COLOURS, SURFACE_COLUMNS, VELOCITY
from lidarsim.scene.colours import as_float
from lidarsim.sensor.optics import TWO_RETURNS
from lidarsim.sensor.reflectivity import COUNTS
from lidarsim.sweeps.lidar_traits import LidarTraits
from lidarsim.sweeps.sweeps import Sweeps

# Types of returns of Autoware's sensor drivers.
UNKNOWN, LAST, FIRST, STRONGEST, FIRST_WEAK, LAST_WEAK = range(6)
IDENTICAL, SECOND, _, FIRST_STRONGEST, LAST_STRONGEST = range(6, 11)
_SINGLE_RETURN_TYPES = {"strongest": STRONGEST, "first": FIRST, "last": LAST}

_XYZ = [("x", "<f4"), ("y", "<f4"), ("z", "<f4")]
_ROWS = {
    "velodyne": np.dtype([*_XYZ, ("intensity", "<f4"), ("ring", "<u2"), ("time", "<f4")]),
    "autoware": np.dtype([
        *_XYZ, ("intensity", "u1"), ("return_type", "u1"), ("channel", "<u2"), ("azimuth", "<f4"),
        ("elevation", "<f4"), ("distance", "<f4"), ("time_stamp", "<u4"),
    ]),
    "ouster": np.dtype({
        "names": ["x", "y", "z", "intensity", "t", "reflectivity", "ring", "ambient", "range"],
        "formats": ["<f4", "<f4", "<f4", "<f4", "<u4", "<u2", "<u2", "<u2", "<u4"],
        "offsets": [0, 4, 8, 16, 20, 24, 26, 28, 32],
        "itemsize": 48,
    }),
}  # fmt: skip
_ROWS["images"] = _ROWS["velodyne"]
# Points that are compensated for motion have no times; in Autoware's layout, PointXYZIRC.
TIME_FIELDS = ("time", "t", "time_stamp")
_COMPENSATED = {
    "velodyne": _ROWS["velodyne"].descr[:-1],
    "images": _ROWS["images"].descr[:-1],
    "autoware": _ROWS["autoware"].descr[:6],
}
# Additional fields after the layout: {name: (type, columns that the field needs)}.
EXTRA_FIELDS = {
    "rgb": ("<f4", {*COLOURS}),
    VELOCITY: ("<f4", {VELOCITY}),
    "label": ("<u4", {"class"}),
    **{name: ("<f4", {name}) for name in SURFACE_COLUMNS},
    "material": ("<i4", {"material"}),
}


@dataclass(frozen=True)
class PointLayout:
    """Layout of the points of a PointCloud2."""

    name: str
    compensated: bool  # points in the sensor's axes at the start of the sweep, without times

    @property
    def fields(self) -> np.dtype[np.void]:
        """Type of a point, without additional fields."""
        row = _ROWS[self.name]
        if not self.compensated:
            return row
        if self.name in _COMPENSATED:
            return np.dtype(_COMPENSATED[self.name])
        kinds = {name: kind for name, kind in (row.fields or {}).items() if name not in TIME_FIELDS}
        return np.dtype(
            {
                "names": [*kinds],
                "formats": [kind for kind, *_ in kinds.values()],
                "offsets": [offset for _, offset, *_ in kinds.values()],
                "itemsize": row.itemsize,
            }
        )

    def row(self, extra: Sequence[str]) -> np.dtype[np.void]:
        """Return the type of a point in the layout, followed by additional fields."""
        row = self.fields
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


FULL_INTENSITY = {"autoware": 255, "ouster": COUNTS}  # values of an intensity of 1


def point_rows(
    layout: PointLayout, row: np.dtype[np.void], points: Cloud, sweeps: Sweeps, sweep: int
) -> Records:
    """Return the points of a sweep in a layout, of the type of its `row`."""
    if layout.compensated:
        positions = sweeps.compensated(sweep, points).astype(np.float32)
        columns = sweeps.columns_compensated(sweep, points)
    else:
        positions = sweeps.as_fired(sweep, points).astype(np.float32)
        columns = sweeps.columns_as_fired(sweep, points)
    values: dict[str, AnyArray] = dict(zip("xyz", positions.T, strict=True))
    if layout.name in ("velodyne", "images"):
        values |= {"intensity": columns["intensity"], "ring": columns["channel"]}
    elif layout.name == "autoware":
        values |= {
            "intensity": np.round(np.clip(columns["intensity"], 0, 1) * 255),
            "return_type": _return_types(points, sensor_traits(sweeps, sweep).mode),
            "channel": columns["channel"],
        }
    else:
        traits = sensor_traits(sweeps, sweep)
        values |= {
            "intensity": columns["signal"],
            "reflectivity": columns["reflectivity"],
            "ring": np.maximum(traits.channels - 1 - columns["channel"].astype(np.int64), 0),
            "range": np.round((columns["range"].astype(np.float64) + traits.range_offset_m) * 1000),
        }
    if not layout.compensated:
        begin_ns = sweeps.begins_ns[sweep] + sweeps.stamp_ns(sweep) - round(sweeps.begins_ns[sweep])
        values |= _timed(layout.name, positions, columns["time"] - begin_ns, sweeps, sweep)
    if "rgb" in (row.names or ()):
        values["rgb"] = as_float(*(columns[name] for name in COLOURS))
    same_names = ((name, name) for name in (VELOCITY, *SURFACE_COLUMNS, "material"))
    for name, column in (*same_names, ("label", "class")):
        if name in (row.names or ()):
            values[name] = columns[column]
    rows = np.zeros(len(points), row)
    for name, values_of_field in values.items():
        rows[name] = values_of_field
    return rows


def _timed(
    layout: str, positions: Floats32, since_ns: AnyArray, sweeps: Sweeps, sweep: int
) -> dict[str, AnyArray]:
    """Return fields of points in the sensor frame at their firings, `since_ns` the stamp."""
    if layout in ("velodyne", "images"):
        return {"time": since_ns / 1e9}
    stamps = np.clip(since_ns, 0, 2**32 - 1)
    if layout == "ouster":
        return {"t": stamps}
    x, y, z = positions.astype(np.float64).T
    level = np.hypot(x, y)
    zero = np.radians(sensor_traits(sweeps, sweep).zero_deg)
    return {
        "azimuth": (zero - np.arctan2(y, x)) % (2 * np.pi),
        "elevation": np.arctan2(z, level),
        "distance": np.hypot(level, z),
        "time_stamp": stamps,
    }


def _return_types(points: Cloud, mode: str) -> AnyArray:
    """Return Autoware's types of the returns of a sweep, (n,); returns follow their pulses.

    Of two returns of a pulse the nearer is first, and the brighter is strong; of two equally bright
    returns, the farther. A single return of a pulse is all of these.
    """
    count = len(points)
    if mode in _SINGLE_RETURN_TYPES:
        return np.full(count, _SINGLE_RETURN_TYPES[mode])
    number = points["return_number"]
    returns = points["returns"]
    types = np.full(count, UNKNOWN)
    types[number == 2] = SECOND
    types[number == 1] = FIRST
    types[number == returns] = LAST
    types[returns == 1] = IDENTICAL
    if mode not in TWO_RETURNS or count < 2:
        return types
    pairs = (number[:-1] == 1) & (returns[:-1] == 2) & (number[1:] == 2) & (returns[1:] == 2)
    first = np.flatnonzero(pairs)
    intensity = points["intensity"]
    brighter = intensity[first] > intensity[first + 1]
    types[first] = np.where(brighter, FIRST_STRONGEST, FIRST_WEAK)
    types[first + 1] = np.where(brighter, LAST_WEAK, LAST_STRONGEST)
    return types


def sensor_traits(sweeps: Sweeps, sweep: int) -> LidarTraits:
    """Return the traits of the sensor of a sweep."""
    return sweeps.lidars[sweeps.sensor[sweep]]

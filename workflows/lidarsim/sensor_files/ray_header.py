"""Header of ray files, with the name, ranges, rate and conventions as plain values."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from math import inf, isfinite
from typing import Any

import numpy as np

from ..errors import reason_of
from ..numerics.arrays import Floats, Ints
from ..words import printable
from .fired_rays import AXES, AZIMUTH, ELEVATION, FRAME_HZ, TIME, RayList, directions_of

KIND = "rays of a sensor"
# Column names of a table. Directions take precedence over the angles, which repeat them in degrees.
TIME_COLUMN = "time_offset_ns"
DIRECTION = ("direction_x", "direction_y", "direction_z")
ORIGIN = ("origin_x_m", "origin_y_m", "origin_z_m")
COLUMNS = (TIME_COLUMN, "channel", "azimuth_deg", "elevation_deg", *DIRECTION, *ORIGIN)


def header_of(
    rays: RayList,
    left_out: Sequence[str],
    *,
    azimuth: str = "azimuth_deg",
    elevation: str = "elevation_deg",
) -> dict[str, Any]:
    """Return the header of a ray file as plain values. An infinite range becomes None.

    `left_out` are phrases for properties that the file does not store. `azimuth` and `elevation`
    are the names of the angle columns, which are in radians unless the names end in _deg.
    """
    min_range_m, max_range_m = rays.range_m
    return {
        "content": KIND,
        "sensor": rays.name,
        "axes": AXES,
        azimuth: f"{_unit(azimuth)} {AZIMUTH}",
        elevation: f"{_unit(elevation)} {ELEVATION}",
        TIME_COLUMN: TIME,
        "min_range_m": min_range_m,
        "max_range_m": max_range_m if isfinite(max_range_m) else None,
        "rate_hz": rays.rate_hz,
        "cycle_ns": rays.cycle_ns,
        "repeats": rays.repeats,
        "not_in_this_file": list(left_out),
        **({"notes": list(rays.notes)} if rays.notes else {}),
    }


def _unit(name: str) -> str:
    return "degrees" if name.endswith("_deg") else "radians"


def parsed_header(text: str | bytes) -> dict[str, Any]:
    """Parse the JSON header of a file.

    Raises ValueError if it is not a JSON object.
    """
    try:
        header = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"its header is not JSON ({reason_of(error)})") from error
    if not isinstance(header, dict):
        raise ValueError("its header is not a JSON object, as in files with the rays of a sensor")
    return header


def columns_of(rays: RayList) -> dict[str, Floats | Ints]:
    """Return the values of the columns in `COLUMNS` for a list of rays."""
    timed = rays.with_times()
    assert timed.times_ns is not None  # `with_times` sets the times
    angles = (rays.azimuths_deg, rays.elevations_deg)
    vectors = (*rays.directions.T, *rays.origins_or_center.T)
    values = (timed.times_ns, rays.channels, *angles, *vectors)
    return dict(zip(COLUMNS, values, strict=True))


def rays_of(columns: Mapping[str, Any], header: Mapping[str, Any]) -> RayList:
    """Create rays from columns and a header.

    The columns are those in `COLUMNS`, of which either the directions or both angles are required.

    Raises
    ------
    ValueError
        If columns are missing, have different lengths, or contain numbers that are not finite, or
        if a value in the header is invalid.
    """
    lengths = {name: np.shape(values) for name, values in columns.items()}
    if len(set(lengths.values())) != 1 or any(len(shape) != 1 for shape in lengths.values()):
        raise ValueError("its columns must have the same length, with one number for each ray")
    for name, values in columns.items():
        check_numbers(name, values.dtype)
        bad = np.flatnonzero(~np.isfinite(np.asarray(values, np.float64)))
        if len(bad):
            raise ValueError(f"{name} of ray {bad[0] + 1} is NaN or infinite")
    directions = _directions(columns)
    if not len(directions):
        raise ValueError("it has no rays")
    origins = None
    if any(name in columns for name in ORIGIN):
        zero = np.zeros(len(directions))
        origins = np.column_stack(
            [np.asarray(columns.get(name, zero), np.float64) for name in ORIGIN]
        )
        origins = origins if origins.any() else None
    times_ns = None
    if TIME_COLUMN in columns:
        times_ns = np.rint(np.asarray(columns[TIME_COLUMN], np.float64)).astype(np.int64)
    channels = np.asarray(columns.get("channel", np.zeros(len(directions))), np.int64)
    max_range_m = header.get("max_range_m")
    cycle_ns = header.get("cycle_ns")
    rays = RayList(
        directions=directions,
        times_ns=times_ns,
        channels=channels,
        origins=origins,
        cycle_ns=None if cycle_ns is None else _positive(header, "cycle_ns"),
        rate_hz=_positive(header, "rate_hz", FRAME_HZ),
        range_m=(
            _number(header, "min_range_m") if header.get("min_range_m") else 0.0,
            inf if max_range_m is None else _positive(header, "max_range_m"),
        ),
        name=str(header.get("sensor", "")),
        repeats=bool(header.get("repeats", True)),
    )
    check_times(rays)
    return rays


def check_names(kind: str, names: Iterable[str], known: Sequence[str]) -> None:
    """Raise ValueError if a file has unknown arrays or columns.

    `kind` is "arrays" or "columns", for the message.
    """
    if unknown := [name for name in names if name not in known]:
        shown = ", ".join(map(printable, unknown[:5]))
        raise ValueError(f"it has unknown {kind}: {shown}. The known names are {', '.join(known)}")


def check_numbers(name: str, dtype: np.dtype[Any]) -> None:
    """Raise ValueError unless a column contains real numbers."""
    if dtype.kind not in "biuf":
        raise not_numbers(name, dtype)


def not_numbers(name: str, kind: object) -> ValueError:
    """Return the error for a column that does not contain real numbers."""
    shown = printable(str(kind), 60)
    return ValueError(f"its column {name} must contain real numbers, but has the type {shown}")


def check_times(rays: RayList) -> None:
    """Raise ValueError if times decrease, or if the cycle ends before the last ray."""
    times_ns = rays.times_ns
    if times_ns is None:
        return
    backward_rays = np.flatnonzero(np.diff(times_ns) < 0)
    if len(backward_rays):
        raise ValueError(f"times decrease at ray {backward_rays[0] + 2}")
    if times_ns[0] < 0:
        raise ValueError(f"its first time must be 0 ns or later, but is {times_ns[0]} ns")
    if rays.cycle_ns is not None and rays.cycle_ns < times_ns[-1]:
        raise ValueError(
            f"cycle_ns must not be before the last ray ({times_ns[-1]}), but is "
            f"{rays.cycle_ns:.15g}"
        )


def _directions(columns: Mapping[str, Any]) -> Floats:
    """Return unit directions from vector columns, or from angle columns if there are no vectors.

    Vectors are normalized unless their length is 1 to twelve digits. Raises ValueError if there are
    neither vectors nor angles.
    """
    if all(name in columns for name in DIRECTION):
        vectors = np.column_stack([np.asarray(columns[name], np.float64) for name in DIRECTION])
        lengths = np.sqrt((vectors * vectors).sum(axis=1))
        if not (lengths > 0).all():
            raise ValueError(f"the direction of ray {int(lengths.argmin()) + 1} is zero")
        if np.abs(lengths - 1).max() < 1e-12:
            return vectors
        return np.asarray(vectors / lengths[:, None], np.float64)
    if "azimuth_deg" in columns and "elevation_deg" in columns:
        elevations = np.asarray(columns["elevation_deg"], np.float64)
        if len(elevations) and np.abs(elevations).max() > 90 + 1e-9:
            raise ValueError("elevation_deg must be between -90 and 90 degrees")
        return directions_of(np.asarray(columns["azimuth_deg"], np.float64), elevations)
    raise ValueError(
        "it requires azimuth_deg and elevation_deg, or direction_x, direction_y and direction_z"
    )


def _number(header: Mapping[str, Any], name: str) -> float:
    """Return a nonnegative number from a header.

    Raises ValueError if the value is invalid.
    """
    value = header[name]
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value < inf:
        raise ValueError(f"{name} of its header must be 0 or greater, but is {_shown(value)}")
    return float(value)


def _shown(value: Any) -> str:
    return printable(repr(value), 60)


def _positive(header: Mapping[str, Any], name: str, default: float | None = None) -> float:
    """Return a positive number from a header.

    Raises ValueError if the value is invalid.
    """
    value = header.get(name, default)
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < inf:
        raise ValueError(f"{name} of its header must be greater than 0, but is {_shown(value)}")
    return float(value)

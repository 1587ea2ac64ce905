"""Readers for the calibration files of individual sensors, which list beam angles or rays."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import convert_errors
from ..io.textfile import read_text
from ..io.yamlfile import load_yaml
from ..numerics.arrays import Floats
from ..numerics.elementary import sin_cos
from ..sensor_files.comma_rows import parse_rows
from ..sensor_files.fired_rays import RayList
from ..sensor_files.format_table import read_rays
from ..sensor_files.livox import is_livox
from ..sensor_files.livox import rays_of_text as rays_of_livox
from ..sensor_files.ray_csv import is_ray_table, rays_of_text
from ..words import did_you_mean_each, join_names, printable
from .beams import Beams


@dataclass(frozen=True)
class Calibration:
    """Calibration of an individual sensor. It consists of either beams or rays.

    Attributes
    ----------
    file
        Name of the calibration file.
    maker
        Manufacturer that defined the file format, or None for a generic table.
    beams
        Beams in the manufacturer's order, with their times if the file contains any.
    rays
        Unit directions in firing order. Shape (n, 3).
    shot_ns
        Times of the rays, if the file contains any. Shape (n,).
    starts
        Origins of the rays in meters, or None if all rays start at the sensor origin.
        Shape (n, 3).
    cycle_ns
        Duration of the ray list, if the file specifies one.
    range_m
        Minimum and maximum range, if the file specifies them.
    sensor
        Name of the sensor, if the file specifies one.
    head
        Fields of `SensorModel` that the file determines.
    window
        Part of each revolution in which the sensor fires, or None for the whole revolution. The
        start, measured from firing 0, and the length are fractions of a revolution.
    """

    file: str
    maker: str | None
    beams: Beams | None = None
    rays: Floats | None = None
    shot_ns: Floats | None = None
    starts: Floats | None = None
    cycle_ns: float | None = None
    range_m: tuple[float, float] | None = None
    sensor: str = ""
    head: dict[str, Any] = field(default_factory=dict)
    window: tuple[float, float] | None = None


def read_calibration(path: Path) -> Calibration:
    """Read the calibration file of an individual sensor.

    These formats are supported:

    - Velodyne YAML files with a list of lasers (`lasers:`).
    - Ouster metadata files (.json).
    - Hesai angle corrections (.csv) with the columns Channel, Elevation and Azimuth.
    - RoboSense angle.csv files, which contain vertical and horizontal angles without a header.
    - Livox ray lists (.csv) with the columns Time/s, Azimuth/deg and Zenith/deg.
    - Beam tables (.csv) with the column elevation_deg and any of the columns azimuth_deg
      (counterclockwise), time_us, x_m, y_m and z_m.
    - Ray files that were written by `export_sensor` (.npz, .parquet, or .csv with the column
      time_offset_ns).

    Parameters
    ----------
    path
        Path of the calibration file.

    Raises
    ------
    LidarError
        If the file format is unknown, or if values are missing, not finite or in the wrong order.
    """
    with convert_errors(f"{path} is not a valid calibration file"):
        if path.suffix.lower() not in (".yaml", ".yml", ".json", ".csv"):
            rays = read_rays(path)
            if rays is not None:
                return _calibration_from_rays(path.name, rays)
        text = read_text(path)
        if path.suffix.lower() in (".yaml", ".yml"):
            return _parse_velodyne(path.name, load_yaml(text))
        if path.suffix.lower() == ".json":
            return _parse_ouster(path.name, json.loads(text))
        return _parse_table(path.name, text)


def _parse_velodyne(name: str, data: Any) -> Calibration:
    """Create a calibration from the parsed content of a Velodyne YAML file.

    The geometry follows rawdata.cc in ros-drivers/velodyne.
    """
    if not isinstance(data, dict) or not isinstance(data.get("lasers"), list):
        raise ValueError("it has no list of lasers, which Velodyne calibration files contain")
    lasers = sorted(data["lasers"], key=lambda laser: laser["laser_id"])
    count = data.get("num_lasers", len(lasers))
    if len(lasers) != count or any(laser["laser_id"] != i for i, laser in enumerate(lasers)):
        raise ValueError(f"it must list each of the lasers 0 to {count - 1} exactly once")
    elevation, azimuth, upwards, leftwards = np.array(
        [
            [
                float(laser["vert_correction"]),
                float(laser["rot_correction"]),
                float(laser.get("vert_offset_correction", 0)),
                float(laser.get("horiz_offset_correction", 0)),
            ]
            for laser in lasers
        ]
    ).T
    # The offsets are perpendicular to the beam and point up and to the left.
    rise, level = sin_cos(elevation)
    sin, cos = sin_cos(azimuth)
    forward = -upwards * rise
    origin = [forward * cos - leftwards * sin, forward * sin + leftwards * cos, upwards * level]
    beams = Beams(elevation, azimuth, origin=np.column_stack(origin))
    return Calibration(name, "velodyne", beams)


# Distance of the beam origins from the rotation axis for each product line, and for the first
# generation. The values are those of default_lidar_origin_to_beam_origin in
# ouster_core/src/sensor_info.cpp of ouster-sdk 1.0.
_OUSTER_ORIGINS_MM = {"OS-0-": 27.67, "OS-1-": 15.806, "OS-2-": 13.762}
_OUSTER_FIRST_MM = 12.163


def _parse_ouster(name: str, data: Any) -> Calibration:
    """Create a calibration from Ouster metadata of any firmware version.

    The geometry follows the Ouster sensor manual. Ouster measures ranges from the rotation axis,
    whereas ranges in this package are always measured from the beam origin.
    """
    if not isinstance(data, dict):
        raise ValueError("it is not an Ouster metadata file")
    beam = _ouster_section(data, "beam_intrinsics", data)
    if "beam_altitude_angles" not in beam:
        raise ValueError("it has no beam_altitude_angles, which Ouster metadata files contain")
    elevation = np.array(beam["beam_altitude_angles"], np.float64)
    azimuth = np.array(beam["beam_azimuth_angles"], np.float64)
    layout = _ouster_section(data, "lidar_data_format") or _ouster_section(data, "data_format")
    rows = layout.get("pixels_per_column", len(elevation))
    if elevation.shape != azimuth.shape or len(elevation) != rows:
        raise ValueError(
            f"it has {elevation.size} altitude angles and {azimuth.size} azimuth angles for {rows} "
            "beams"
        )
    present = (elevation != 0) | (azimuth != 0)  # older firmware writes zeros for missing beams
    origin_mm = _ouster_origin_mm(data, beam)
    columns, rate = _ouster_mode(data)
    count = int(present.sum())
    return Calibration(
        name,
        "ouster",
        Beams(
            np.radians(elevation[present]),
            -np.radians(azimuth[present]),
            origin=np.tile(origin_mm / 1000, (count, 1)),
        ),
        head={
            "clockwise": True,
            "zero_deg": 180.0,
            "firings_per_turn": columns,
            "rate_hz": float(rate),
        },
        window=_ouster_window(data, layout, columns),
    )


def _ouster_mode(data: dict[str, Any]) -> tuple[int, int]:
    """Return the number of columns per revolution and the number of revolutions per second."""
    mode = str(_ouster_section(data, "config_params", data).get("lidar_mode", "1024x10"))
    numbers = re.fullmatch(r"([1-9]\d{2,4})x([1-9]\d{0,2})", mode)
    if numbers is None:
        raise ValueError(
            "its lidar_mode must be the columns and revolutions per second, such as 1024x10, but "
            f"is {printable(mode)!r}"
        )
    return int(numbers[1]), int(numbers[2])


def _ouster_window(
    data: dict[str, Any], layout: dict[str, Any], columns: int
) -> tuple[float, float] | None:
    """Return `Calibration.window` of an Ouster sensor, or None if all columns are fired.

    The column window takes precedence over the azimuth window. In the lidar frame, azimuths
    increase counterclockwise, whereas columns are numbered clockwise, starting at azimuth 0. A
    window whose end is less than its start contains column 0 or azimuth 0.
    """
    configuration = _ouster_section(data, "config_params", data)
    if (limits := layout.get("column_window")) is not None:
        first, last = _parse_limits("column_window", limits, columns - 1)
        count = (last - first) % columns + 1
        start = first
    elif (limits := configuration.get("azimuth_window")) is not None:
        right, left = _parse_limits("azimuth_window", limits, 360_000)
        if left - right in (0, 360_000):
            return None
        start = -(-columns * (360_000 - left) // 360_000) % columns
        count = max(columns * ((left - right) % 360_000) // 360_000, 1)
    else:
        return None
    return None if count == columns else (start / columns, count / columns)


def _parse_limits(name: str, limits: Any, maximum: int) -> tuple[int, int]:
    """Parse the two limits of a window.

    Raise ValueError if `limits` is not a pair of integers between 0 and `maximum`.
    """
    is_pair = isinstance(limits, list) and len(limits) == 2
    if not is_pair or not all(type(limit) is int and 0 <= limit <= maximum for limit in limits):
        raise ValueError(
            f"its {name} must be two whole numbers from 0 to {maximum:,}, but is "
            f"{printable(str(limits), 60)}"
        )
    return limits[0], limits[1]


def _ouster_section(data: dict[str, Any], name: str, default: Any = None) -> dict[str, Any]:
    """Return a section of Ouster metadata, or `default` if the file has no such section.

    Firmware before 1.14 may write an error message instead of a section. The section is then
    treated as empty.
    """
    content = data.get(name, default)
    return content if isinstance(content, dict) else {}


def _ouster_origin_mm(data: dict[str, Any], beam: dict[str, Any]) -> Floats:
    """Return the origin of the beams in the sensor frame at azimuth 0, in millimeters.

    The result has shape (3,).
    """
    beam_pose = np.reshape(beam.get("beam_to_lidar_transform", np.eye(4)), (4, 4))
    if not np.allclose(beam_pose[:3, :3], np.eye(3)):
        raise ValueError(
            "its beam_to_lidar_transform contains a rotation. Only a translation is supported"
        )
    origin_mm = beam_pose[:3, 3].copy()
    if "lidar_origin_to_beam_origin_mm" in beam:
        origin_mm[0] = beam["lidar_origin_to_beam_origin_mm"]
    elif "beam_to_lidar_transform" not in beam:  # firmware before 2.0
        product_line = str(_ouster_section(data, "sensor_info", data).get("prod_line", ""))
        origin_mm[0] = _OUSTER_ORIGINS_MM.get(product_line[:5], _OUSTER_FIRST_MM)
    lidar = _ouster_section(data, "lidar_intrinsics", data)
    half_turn = np.diag([-1.0, -1.0, 1.0, 1.0])
    half_turn[2, 3] = 36.18
    pose = np.reshape(lidar.get("lidar_to_sensor_transform", half_turn), (4, 4))
    if not np.allclose(pose[:3, :3], half_turn[:3, :3]) or pose[:2, 3].any():
        raise ValueError(
            "its lidar_to_sensor_transform must be a rotation by 180 degrees about z and a height"
        )
    origin_mm[2] += pose[2, 3]
    return np.asarray(origin_mm, np.float64)


def _calibration_from_rays(name: str, rays: RayList) -> Calibration:
    """Create a calibration from a ray list, adding times if it has none."""
    rays = rays.with_times()
    assert rays.times_ns is not None  # set by with_times
    shot_ns = rays.times_ns.astype(np.float64)
    interval_ns = float(shot_ns[-1]) / max(len(rays) - 1, 1) or 1e9 / rays.rate_hz / len(rays)
    cycle_ns = rays.cycle_ns or float(shot_ns[-1]) + interval_ns
    interval_us = Fraction(cycle_ns) / len(rays) / 1000
    return Calibration(
        name,
        None,
        rays=rays.directions,
        shot_ns=shot_ns,
        starts=rays.origins,
        cycle_ns=cycle_ns,
        range_m=rays.range_m,
        sensor=rays.name,
        head={"listed": True, "firing_us": interval_us, "rate_hz": rays.rate_hz},
    )


# Files from Hesai sensors may begin with a marker line and end with a SHA-256 checksum of the
# preceding lines.
_HESAI_MARK = "eeff"
_HESAI_COLUMNS = ["elevation", "azimuth"]  # columns after the first, which is Channel or LaserID
_HESAI_CHECKSUM = re.compile(r"^[0-9a-f]{64}[,\s]*\Z", re.IGNORECASE | re.MULTILINE)


def _split_cells(line: str) -> list[str]:
    return [word.strip().lower() for word in line.split(",")]


def _parse_table(name: str, text: str) -> Calibration:
    """Create a calibration from comma-separated text, whose header determines the format."""
    if is_ray_table(text):
        return _calibration_from_rays(name, rays_of_text(text))
    if is_livox(text):
        return _parse_livox(name, text)
    header = _split_cells(text.partition("\n")[0])
    if header[0] == _HESAI_MARK or header[1:] == _HESAI_COLUMNS:
        return _parse_hesai(name, text)
    if "elevation_deg" in header:
        names = ("elevation_deg", "azimuth_deg", "time_us", "x_m", "y_m", "z_m")
        unknown = [word for word in header if word not in names]
        if unknown:
            noun = "columns" if unknown[1:] else "column"
            raise ValueError(
                f"unknown {noun} {join_names([repr(printable(name)) for name in unknown])}."
                f"{did_you_mean_each(unknown, names)} The known columns are {', '.join(names)}"
            )
        if duplicate := next((word for word in header if header.count(word) > 1), None):
            raise ValueError(f"the column {duplicate!r} occurs twice")
        columns = dict(zip(header, parse_rows(text, 1, len(header)).T, strict=True))
        zero = np.zeros(len(columns["elevation_deg"]))
        beams = Beams(
            np.radians(columns["elevation_deg"]),
            np.radians(columns.get("azimuth_deg", zero)),
            columns.get("time_us", zero) * 1000,
            np.column_stack([columns.get(axis, zero) for axis in ("x_m", "y_m", "z_m")]),
        )
        return Calibration(name, None, beams)
    try:
        [float(word) for word in header]
    except ValueError:
        raise ValueError(
            f"the format of its first line, {','.join(header)[:60]!r}, is unknown"
        ) from None
    elevation, azimuth = np.radians(parse_rows(text, 0, 2)).T
    return Calibration(name, "robosense", Beams(elevation, -azimuth))


def _parse_hesai(name: str, text: str) -> Calibration:
    """Create a calibration from Hesai angle corrections of a sensor or a user manual."""
    lines = text.splitlines()
    skip = 2 if _split_cells(lines[0])[0] == _HESAI_MARK else 1
    header = lines[skip - 1] if len(lines) >= skip else ""
    if _split_cells(header)[1:] != _HESAI_COLUMNS:
        raise ValueError(
            f"the line after {_HESAI_MARK} must be Channel,Elevation,Azimuth, but is "
            f"{printable(header, 60)!r}"
        )
    rows = parse_rows(_HESAI_CHECKSUM.sub("", text), skip, 3)
    if (np.diff(rows[:, 0]) != 1).any() or rows[0, 0] != 1:
        raise ValueError(f"its channels must be 1 to {len(rows)}, each exactly once and in order")
    elevation, azimuth = np.radians(rows[:, 1:]).T
    return Calibration(name, "hesai", Beams(elevation, -azimuth))


def _parse_livox(name: str, text: str) -> Calibration:
    """Create a calibration from a Livox ray list."""
    rays = rays_of_livox(text)
    if rays.times_ns is None:
        return Calibration(name, "livox", rays=rays.directions)
    shot_ns = rays.times_ns.astype(np.float64)
    interval_us = Fraction(float(shot_ns[-1]) / (len(rays) - 1) / 1000).limit_denominator(1000)
    head = {"listed": True, "firing_us": interval_us}
    return Calibration(name, "livox", rays=rays.directions, shot_ns=shot_ns, head=head)

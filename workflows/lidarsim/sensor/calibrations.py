"""Calibration files of units: angles of beams, or lists of rays."""

from __future__ import annotations

import io
import json
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from ..base.arrays import Floats
from ..base.elementary import sin_cos
from ..base.errors import LidarError, message_of
from ..base.textfile import read_text
from ..base.yamlfile import load_yaml
from .beams import Beams

# Errors of files that users write.
UNUSABLE = (
    OSError, ValueError, TypeError, KeyError, ArithmeticError, MemoryError, RecursionError,
    yaml.YAMLError, LidarError,
)  # fmt: skip


@dataclass(frozen=True)
class Calibration:
    """Content of a calibration file."""

    file: str  # its name
    maker: str | None  # of the format; None for a plain table of beams
    beams: Beams | None = None  # in the maker's order, with the file's times, if any
    rays: Floats | None = None  # instead, unit directions (n, 3) as they are fired
    shot_ns: Floats | None = None  # their times (n,), if the file has them
    head: dict[str, Any] = field(default_factory=dict)  # fields of `SensorModel`


def read_calibration(path: Path) -> Calibration:
    """Read the calibration file of a unit.

    Parameters
    ----------
    path
        Velodyne's YAML (`lasers:`), Ouster's metadata (.json), or comma-separated: Hesai's
        angle corrections (Channel, Elevation, Azimuth), RoboSense's angle.csv (vertical and
        horizontal angle, no header), Livox's list of rays (Time/s, Azimuth/deg, Zenith/deg), or
        a table of beams with columns elevation_deg and any of azimuth_deg (counter-clockwise),
        time_us, x_m, y_m, z_m.

    Raises
    ------
    LidarError
        If it is none of these, or numbers are missing, not finite or in the wrong order.
    """
    try:
        text = read_text(path)
        if path.suffix.lower() in (".yaml", ".yml"):
            return _velodyne(path.name, load_yaml(text))
        if path.suffix.lower() == ".json":
            return _ouster(path.name, json.loads(text))
        return _table(path.name, text)
    except UNUSABLE as error:
        raise LidarError(f"{path} is not a usable calibration: {message_of(error)}") from error


def _velodyne(name: str, data: Any) -> Calibration:
    """Beams of Velodyne's YAML; geometry as in ros-drivers/velodyne, rawdata.cc."""
    if not isinstance(data, dict) or not isinstance(data.get("lasers"), list):
        raise ValueError("it has no list of lasers, as Velodyne's calibrations have")
    lasers = sorted(data["lasers"], key=lambda laser: laser["laser_id"])
    count = data.get("num_lasers", len(lasers))
    if len(lasers) != count or any(laser["laser_id"] != i for i, laser in enumerate(lasers)):
        raise ValueError(f"it must have lasers 0 to {count - 1}, each once")
    elevation, azimuth, up, left = np.array(
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
    # Offsets at right angles to the beam, upwards and to the left.
    (rise, level), (sin, cos) = sin_cos(elevation), sin_cos(azimuth)
    ahead = -up * rise
    origin = [ahead * cos - left * sin, ahead * sin + left * cos, up * level]
    beams = Beams(elevation, azimuth, origin=np.column_stack(origin))
    return Calibration(name, "velodyne", beams)


# From the axis to where the beams leave, by product line, and else that of the first generation:
# default_lidar_origin_to_beam_origin in ouster_core/src/sensor_info.cpp of ouster-sdk 1.0.
_OUSTER_ORIGINS_MM = {"OS-0-": 27.67, "OS-1-": 15.806, "OS-2-": 13.762}
_OUSTER_FIRST_MM = 12.163


def _ouster(name: str, data: Any) -> Calibration:
    """Beams of Ouster's metadata, old and new; geometry as in its sensor manual.

    Ranges begin at the beam's start, as everywhere here; Ouster's own begin at the axis.
    """
    if not isinstance(data, dict):
        raise ValueError("it is not Ouster metadata")

    def section(name: str, old: Any = data) -> Any:
        """Return a section of the new layout; firmware before 1.14 writes an error in its place."""
        found = data.get(name, old)
        return found if isinstance(found, dict) else {}

    beam = section("beam_intrinsics")
    if "beam_altitude_angles" not in beam:
        raise ValueError("it has no beam_altitude_angles, as Ouster's metadata have")
    elevation = np.array(beam["beam_altitude_angles"], np.float64)
    azimuth = np.array(beam["beam_azimuth_angles"], np.float64)
    layout = section("lidar_data_format", None) or section("data_format", None)
    rows = layout.get("pixels_per_column", len(elevation))
    if elevation.shape != azimuth.shape or len(elevation) != rows:
        raise ValueError(
            f"it has {elevation.size} altitude and {azimuth.size} azimuth angles of {rows} beams"
        )
    there = (elevation != 0) | (azimuth != 0)  # older firmware writes zeros for beams it lacks
    beam_pose = np.reshape(beam.get("beam_to_lidar_transform", np.eye(4)), (4, 4))
    if not np.allclose(beam_pose[:3, :3], np.eye(3)):
        raise ValueError("its beam_to_lidar_transform turns the beams; a translation is expected")
    beam_at = beam_pose[:3, 3].copy()
    if "lidar_origin_to_beam_origin_mm" in beam:
        beam_at[0] = beam["lidar_origin_to_beam_origin_mm"]
    elif "beam_to_lidar_transform" not in beam:  # firmware before 2.0
        line = str(section("sensor_info").get("prod_line", ""))
        beam_at[0] = _OUSTER_ORIGINS_MM.get(line[:5], _OUSTER_FIRST_MM)
    lidar = section("lidar_intrinsics")
    turned = np.diag([-1.0, -1.0, 1.0, 1.0])
    turned[2, 3] = 36.18
    pose = np.reshape(lidar.get("lidar_to_sensor_transform", turned), (4, 4))
    if not np.allclose(pose[:3, :3], turned[:3, :3]) or pose[:2, 3].any():
        raise ValueError("its lidar_to_sensor_transform is not half a turn and a height")
    beam_at[2] += pose[2, 3]
    mode = str(section("config_params").get("lidar_mode", "1024x10"))
    columns, rate = (int(number) for number in mode.split("x"))
    count = int(there.sum())
    return Calibration(
        name,
        "ouster",
        Beams(
            np.radians(elevation[there]),
            -np.radians(azimuth[there]),
            origin=np.tile(beam_at / 1000, (count, 1)),
        ),
        head={
            "clockwise": True,
            "zero_deg": 180.0,
            "firings_per_turn": columns,
            "rate_hz": float(rate),
        },
    )


def _table(name: str, text: str) -> Calibration:
    """One of the comma-separated formats, chosen by the header."""
    header = [word.strip().lower() for word in text.partition("\n")[0].split(",")]
    if header == ["time/s", "azimuth/deg", "zenith/deg"]:
        return _livox(name, _rows(text, 1, 3))
    if header[1:] == ["elevation", "azimuth"]:
        rows = _rows(text, 1, 3)
        if (np.diff(rows[:, 0]) != 1).any() or rows[0, 0] != 1:
            raise ValueError(f"channels must be 1 to {len(rows)}, each once and in order")
        elevation, azimuth = np.radians(rows[:, 1:]).T
        return Calibration(name, "hesai", Beams(elevation, -azimuth))
    if "elevation_deg" in header:
        known = ("elevation_deg", "azimuth_deg", "time_us", "x_m", "y_m", "z_m")
        other = [word for word in header if word not in known]
        if other:
            raise ValueError(f"column {other[0]!r} is not one of {', '.join(known)}")
        if twice := next((word for word in header if header.count(word) > 1), None):
            raise ValueError(f"it has the column {twice!r} twice")
        columns = dict(zip(header, _rows(text, 1, len(header)).T, strict=True))
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
            f"its first line, {','.join(header)[:60]!r}, has no known format"
        ) from None
    elevation, azimuth = np.radians(_rows(text, 0, 2)).T
    return Calibration(name, "robosense", Beams(elevation, -azimuth))


def _livox(name: str, rows: Floats) -> Calibration:
    """Rays of Livox's list. Zenith is counted from the z axis; Time may only number the rows."""
    times, azimuth, zenith = rows[:, 0], *np.radians(rows[:, 1:]).T
    back = np.flatnonzero(np.diff(times) < 0)
    if len(back):
        raise ValueError(f"times go back in line {back[0] + 3}")
    (level, up), (sin, cos) = sin_cos(zenith), sin_cos(azimuth)
    rays = np.column_stack([level * cos, level * sin, up])
    if times[-1] == times[0] or (np.diff(times) == 1).all():  # or it is filled with one number
        return Calibration(name, "livox", rays=rays)
    shot_ns = (times - times[0]) * 1e9
    every_us = Fraction(float(shot_ns[-1]) / (len(times) - 1) / 1000).limit_denominator(1000)
    head = {"listed": True, "firing_us": every_us}
    return Calibration(name, "livox", rays=rays, shot_ns=shot_ns, head=head)


def _rows(text: str, skip: int, columns: int) -> Floats:
    """Numbers of the lines after the header, (n, columns); ValueError naming a bad line."""
    rows = np.loadtxt(io.StringIO(text), delimiter=",", skiprows=skip, ndmin=2)
    if not len(rows) or rows.shape[1] != columns:
        raise ValueError(f"it needs lines of {columns} numbers")
    bad = np.flatnonzero(~np.isfinite(rows).all(axis=1))
    if len(bad):
        raise ValueError(f"line {bad[0] + skip + 1} has numbers that are not finite")
    return rows

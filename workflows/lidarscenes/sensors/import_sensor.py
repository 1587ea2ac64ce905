"""Convert files that describe a sensor's rays, such as ray lists and OmniLidar prims."""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite
from pathlib import Path

import yaml

from lidarsim.errors import LidarError, convert_errors
from lidarsim.sensor_files import ray_npz
from lidarsim.sensor_files.fired_rays import RayList
from lidarsim.sensor_files.format_table import read_rays

from ..writers.lidar_scenario import SCENARIO_FILE, round_value
from .omnilidar import ImportedSensor, read_omnilidar

USD_ENDINGS = (".usd", ".usda", ".usdc", ".usdz")
ENDINGS = (".csv", ".npz", ".parquet", *USD_ENDINGS)
_RAYS_FILE = "rays.npz"


def import_sensor(path: Path, folder: Path, assets: Sequence[Path]) -> list[str]:
    """Write a sensor file as a scenario, which is a `scenario.yaml` file and a file with the rays.

    The scenario has the scene of `lidarpool demo`, but with this sensor.

    Parameters
    ----------
    path
        A Livox ray list (.csv), a ray table (.csv, .parquet), ray arrays of MuJoCo-LiDAR or
        RobotecGPULidar (.npz), or an OmniLidar prim (.usd, .usda, .usdc, .usdz).
    folder
        Existing output folder.
    assets
        Must be empty, because sensor files do not refer to other files.

    Returns
    -------
    Differences from the file, one line each.

    Raises
    ------
    LidarError
        If the file cannot be read or does not describe a sensor.
    """
    if assets:
        raise LidarError("it is a sensor file, for which `--assets` is not allowed.")
    sensor = _read(path)
    lines = list(sensor.unsupported)
    rays = sensor.rays
    if rays.times_ns is None:
        lines.append(
            f"files without firing times ({len(rays):,} rays are fired in {1 / rays.rate_hz:g} s)"
        )
    ray_npz.write(folder / _RAYS_FILE, rays.with_times(), lines)
    head = [
        f"Created from {path.name} by lidarpool import.",
        *(f"Not supported: {line}." for line in lines),
    ]
    text = "".join(f"# {line}\n" for line in head)
    text += yaml.safe_dump({"scene": "seed", "sensor": _section(rays)}, sort_keys=False)
    (folder / SCENARIO_FILE).write_text(text, encoding="utf-8", newline="\n")
    return lines


def _section(rays: RayList) -> dict[str, float | str]:
    """Return a scenario's `sensor` section, in which users can change the ranges."""
    min_range_m, max_range_m = rays.range_m
    section: dict[str, float | str] = {"calibration": _RAYS_FILE}
    if min_range_m:
        section["min_range_m"] = round_value(min_range_m)
    if isfinite(max_range_m):
        section["max_range_m"] = round_value(max_range_m)
    return section


def _read(path: Path) -> ImportedSensor:
    """Read the sensor that a file describes.

    Raises LidarError if the file cannot be used.
    """
    if path.suffix.lower() in USD_ENDINGS:
        return read_omnilidar(path)
    with convert_errors("it cannot be read as a sensor file"):
        rays = read_rays(path)
    if rays is None:
        raise LidarError("it contains no rays with azimuths and elevations, or with directions.")
    channels = int(rays.channels.max()) + 1
    lost = [f"{channels} channels (a ray list has one channel)"] if channels > 1 else []
    return ImportedSensor(rays, lost)

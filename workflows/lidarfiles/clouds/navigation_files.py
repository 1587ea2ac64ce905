"""Measurement files for a vehicle's IMU (imu.csv), GNSS receiver (gnss.csv) and trajectory.

The files are stored next to the cloud and contain one row per sample, sorted by time. Bags are
created from these files, so that all formats contain the same values. trajectory.csv contains the
measured trajectory if it is used to georeference the points.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path

import numpy as np

from lidarsim.motion.navigation import BLOCK, gnss_fixes, imu_samples, to_geodetic
from lidarsim.motion.rotations import quaternions_of
from lidarsim.motion.trajectory import full_poses
from lidarsim.numerics.arrays import Floats
from lidarsim.survey.survey import Survey
from lidarsim.sweeps.instruments import GNSS_FILE, IMU_FILE, TRAJECTORY_FILE, Instruments

_IMU = (
    "time_ns",
    *(f"angular_velocity_{axis}_rad_s" for axis in "xyz"),
    *(f"specific_force_{axis}_m_s2" for axis in "xyz"),
)
_POSITION = ("time_ns", "x_m", "y_m", "z_m")
_GEODETIC = ("latitude_deg", "longitude_deg", "height_m")
# Columns that `trajectory.file` in a scenario can read.
_TRAJECTORY = ("time_s", "x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")
_TRAJECTORY_HZ = 200.0  # poses per second without an IMU

# Maximum sizes of a sample in bytes.
_ROW_BYTES = 120  # row in a CSV file
_MESSAGE_BYTES = 500  # message in a bag


def instrument_bytes(survey: Survey, bags: int) -> int:
    """Return the maximum size of a survey's instrument data in bytes.

    The data is stored in the instrument files and in each of the `bags` bags.
    """
    navigation = survey.navigation
    if navigation is None:
        return 0
    rates = [
        instrument.rate_hz
        for instrument in (navigation.imu, navigation.gnss)
        if instrument is not None
    ]
    if survey.measured is not None:
        rates.append(_trajectory_rate_hz(survey))
    samples = sum(rates) * survey.duration_ns / 1e9
    return int(samples * (_ROW_BYTES + bags * _MESSAGE_BYTES))


def write_instruments(folder: Path, survey: Survey, origin: Floats) -> None:
    """Write the files for a survey's instruments, in blocks to limit memory use.

    Parameters
    ----------
    folder
        Folder in which the files are created.
    survey
        Survey with the instruments.
    origin
        Scene origin in world coordinates, in meters. Shape (3,).

    Raises
    ------
    OSError
        If a file cannot be written.
    """
    instruments = Instruments.from_survey(survey)
    lines_of = {
        IMU_FILE: lambda: _imu_lines(survey),
        GNSS_FILE: lambda: _gnss_lines(survey, origin),
        TRAJECTORY_FILE: lambda: _trajectory_lines(survey, origin),
    }
    for name in () if instruments is None else instruments.files:
        with (folder / name).open("w", encoding="ascii", newline="\n") as file:
            for line in lines_of[name]():
                file.write(line)


def _imu_lines(survey: Survey) -> Iterator[str]:
    yield ",".join(_IMU) + "\n"
    form = "%d" + ",%.10g" * 6 + "\n"
    for times, rates, forces in imu_samples(survey):
        rows = zip(times.tolist(), *rates.T.tolist(), *forces.T.tolist(), strict=True)
        yield "".join(form % row for row in rows)


def _gnss_lines(survey: Survey, origin: Floats) -> Iterator[str]:
    to_geodetic = _to_geodetic(survey)
    yield ",".join(_POSITION if to_geodetic is None else (*_POSITION, *_GEODETIC)) + "\n"
    form = "%d" + ",%.4f" * 3
    form += ("" if to_geodetic is None else ",%.9f,%.9f,%.4f") + "\n"
    for times, positions in gnss_fixes(survey):
        world = positions + origin
        columns = [*world.T, *(() if to_geodetic is None else to_geodetic(world).T)]
        rows = zip(times.tolist(), *(column.tolist() for column in columns), strict=True)
        yield "".join(form % row for row in rows)


def _trajectory_rate_hz(survey: Survey) -> float:
    """Return the number of poses per second in the measured trajectory file."""
    imu = survey.navigation and survey.navigation.imu
    return imu.rate_hz if imu else _TRAJECTORY_HZ


def _trajectory_lines(survey: Survey, origin: Floats) -> Iterator[str]:
    yield ",".join(_TRAJECTORY) + "\n"
    form = "%.6f" + ",%.5f" * 3 + ",%.9f" * 4 + "\n"
    rate_hz = _trajectory_rate_hz(survey)
    duration_ns = min(survey.path.duration_ns, survey.duration_ns + 1e9 / rate_hz)
    count = math.floor(duration_ns * rate_hz / 1e9 + 1e-6) + 1
    for first in range(0, count, BLOCK):
        times_ns = np.arange(first, min(first + BLOCK, count)) * 1e9 / rate_hz
        positions, rotations = full_poses(
            survey.reported_path, 0, np.minimum(times_ns, survey.path.duration_ns)
        )
        columns = [times_ns / 1e9, *(positions + origin).T, *quaternions_of(rotations).T]
        rows = zip(*(column.tolist() for column in columns), strict=True)
        yield "".join(form % row for row in rows)


def _to_geodetic(survey: Survey) -> Callable[[Floats], Floats] | None:
    """Return a function that converts world coordinates to latitude, longitude and height.

    Returns None if the coordinate system of the world is unknown. Heights are assumed to be
    ellipsoidal.
    """
    gnss = survey.navigation and survey.navigation.gnss
    if gnss and gnss.origin is not None:
        origin = gnss.origin
        return lambda world: to_geodetic(world, origin)
    if survey.epsg is None:
        return None
    transform = import_module("rasterio.warp").transform
    system = f"EPSG:{survey.epsg}"

    def by_code(world: Floats) -> Floats:
        x, y, z = world.T
        longitude, latitude = transform(system, "EPSG:4326", x.tolist(), y.tolist())
        return np.column_stack([latitude, longitude, z])

    return by_code

"""Export the rays of a sensor, with their times and in firing order, for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
from pydantic import Field

from ..errors import LidarError, MissingFileError
from ..numerics.arrays import Ints
from ..schema.checks import check_fits, check_type
from ..sensor_files.fired_rays import FRAME_HZ, Light, RayList
from ..sensor_files.format_table import PROPERTIES, SensorFormat, format_of
from ..words import format_rounded
from .optics import Optics
from .ray_sensors import PrismSensor
from .sensor import Sensor

MAX_RAYS = 20_000_000  # limit per file; the arrays of this many rays take 4 GB
_SLACK_NS = 1e-3  # tolerance for rounding errors of firing times

Seconds = Annotated[float, Field(gt=0, le=1e6)]
Revolutions = Annotated[int, Field(gt=0, le=10_000_000)]


class SensorFile(NamedTuple):
    """A file that `export_sensor` wrote.

    Attributes
    ----------
    path
        Path of the file.
    format
        Name of the file format.
    rays
        Rays in the file. The list is empty if the file describes the sensor's optics instead.
    left_out
        Phrases for the properties of the sensor that the file does not store.
    """

    path: Path
    format: str
    rays: RayList
    left_out: tuple[str, ...]


def export_sensor(
    sensor: Any,
    path: str | Path,
    *,
    format: str | None = None,  # noqa: A002 - the name of the option
    seconds: float | None = None,
    revolutions: int | None = None,
) -> SensorFile:
    """Export the rays or the optics of a sensor to a file for another program.

    Parameters
    ----------
    sensor
        A `Sensor`, for example from `load_sensor` or `Sensor.grid`.
    path
        Path of the file. The file extension determines the format unless `format` is set. An
        existing file is replaced.
    format
        Name of the format, such as "livox". The formats are described in
        docs/how-to/other-simulators.md.
    seconds
        Duration of the pattern in seconds.
    revolutions
        Number of revolutions or frames, as an alternative to `seconds`. The default is one.

    Returns
    -------
    SensorFile
        The path and format of the file, the rays, and the properties of the sensor that the format
        cannot store.

    Raises
    ------
    LidarError
        If the format is unknown or cannot store the sensor, there are too many rays, a package is
        missing, or the file cannot be written.

    Examples
    --------
    >>> from lidarsim import export_sensor, load_sensor
    >>> file = export_sensor(load_sensor("velodyne/vlp16"), "vlp16.npz")  # doctest: +SKIP
    """
    path = Path(path)
    row = format_of(path, format)
    check_type("sensor", sensor, Sensor, advice=" Load one with load_sensor(MODEL).")
    check_fits("seconds", seconds, Seconds | None)
    check_fits("revolutions", revolutions, Revolutions | None)
    if not path.parent.is_dir():
        raise MissingFileError(f"The folder {path.parent} does not exist. Create it first.")
    write = row.function("write")
    if row.describes:
        rays = RayList(np.zeros((0, 3)))
        duration_s = _duration_ns(sensor, seconds, revolutions) / 1e9
        left_out = write(path, sensor, duration_s, _missing_properties(sensor, row))
    else:
        rays = fired_rays(sensor, seconds=seconds, revolutions=revolutions)
        lost = _missing_properties(sensor, row)
        if not rays.repeats:
            assert rays.cycle_ns is not None  # rays of a sensor have a cycle
            lost.append(
                f"rays after {format_rounded(rays.cycle_ns / 1e9, 4)} s, where the pattern does "
                "not repeat"
            )
        left_out = write(path, rays, lost)
    return SensorFile(path, row.name, rays, tuple(left_out))


def fired_rays(
    sensor: Sensor, *, seconds: float | None = None, revolutions: int | None = None
) -> RayList:
    """Return the rays of a sensor's first firings, sorted by time.

    The duration is set by either `seconds` or `revolutions`. By default, it is one revolution or
    frame. A firing that starts before the end of the duration is included with all its rays.

    Raises
    ------
    LidarError
        If both `seconds` and `revolutions` are set, or if there are more than `MAX_RAYS` rays.
    """
    duration_ns = _duration_ns(sensor, seconds, revolutions)
    count = _count_firings(sensor, duration_ns)
    firings = np.arange(count)
    times_ns = sensor.times_ns(firings).reshape(-1) - round(sensor.start_ns)
    order = np.argsort(times_ns, kind="stable")
    times_ns = times_ns[order] - min(0, times_ns.min())
    origins = sensor.origins(firings)
    channels = np.tile(np.arange(sensor.channels), count)
    return RayList(
        directions=sensor.directions(firings).reshape(-1, 3)[order],
        times_ns=times_ns,
        channels=channels[order],
        origins=None if origins is None else origins.reshape(-1, 3)[order],
        cycle_ns=_cycle_ns(sensor, duration_ns, count, times_ns),
        rate_hz=float(getattr(sensor.head, "rate_hz", FRAME_HZ)),
        range_m=(sensor.min_range_m, sensor.max_range_m),
        name=sensor.model,
        repeats=_repeats(sensor, count),
        light=_light(sensor.optics),
    )


def _duration_ns(sensor: Sensor, seconds: float | None, revolutions: int | None) -> float:
    """Return the duration of a pattern in nanoseconds.

    Raise LidarError if both `seconds` and `revolutions` are set.
    """
    if seconds is not None and revolutions is not None:
        raise LidarError("seconds and revolutions cannot be combined.")
    if seconds is not None:
        return 1e9 * seconds
    return sensor.revolution_start_ns(revolutions or 1)


def _light(optics: Optics) -> Light:
    divergence_mrad = optics.divergence_mrad
    if divergence_mrad is not None:
        across, up = np.broadcast_to(divergence_mrad, 2).tolist()
        return Light(optics.wavelength_nm, optics.pulse_ns, (across, up))
    return Light(optics.wavelength_nm, optics.pulse_ns, None)


def _count_firings(sensor: Sensor, duration_ns: float) -> int:
    """Return the number of firings that start in the first `duration_ns` nanoseconds.

    Raise LidarError if these firings have more than `MAX_RAYS` rays.
    """
    limit = MAX_RAYS // sensor.channels + 1

    def starts_before(firing: int) -> bool:
        start_ns = float(sensor.begins_ns(np.array([firing]))[0]) - sensor.start_ns
        return start_ns < duration_ns - _SLACK_NS

    if starts_before(limit):
        raise LidarError(
            f"{sensor.model} fires more than {MAX_RAYS:,} rays in "
            f"{format_rounded(duration_ns / 1e9, 4)} s. Reduce seconds or revolutions."
        )
    lower = 0
    while limit - lower > 1:
        middle = (lower + limit) // 2
        if starts_before(middle):
            lower = middle
        else:
            limit = middle
    return lower + 1


def _cycle_ns(sensor: Sensor, duration_ns: float, count: int, times_ns: Ints) -> float:
    """Return the time after which the list of rays may be repeated, in nanoseconds.

    The result is greater than `duration_ns` if some beams of the last firing are emitted later.
    """
    if times_ns[-1] < duration_ns:
        return duration_ns
    next_ns = float(sensor.begins_ns(np.array([count]))[0]) - sensor.start_ns
    return max(next_ns, float(times_ns[-1] + 1))


def _repeats(sensor: Sensor, count: int) -> bool:
    """Return whether a sensor repeats its first `count` firings.

    Without an exact period, a deviation of less than one firing is ignored.
    """
    if sensor.period is not None:
        return count % sensor.period == 0
    per_turn = getattr(sensor.head, "firings_per_turn", 0)
    if isinstance(sensor, PrismSensor) or not per_turn:
        return False
    return bool(abs(count - max(round(count / per_turn), 1) * per_turn) < 1)


def _missing_properties(sensor: Sensor, row: SensorFormat) -> list[str]:
    """List the properties of a sensor that a format cannot store, as phrases for a message."""
    has = {
        "times": True,
        "channels": sensor.channels > 1,
        "origins": sensor.origins(np.arange(1)) is not None,
        "min_range": sensor.min_range_m > 0,
        "max_range": sensor.max_range_m < float("inf"),
        "rate": True,
        "divergence": sensor.optics.divergence_mrad is not None,
        "returns": sensor.returns is not None,
        "noise": sensor.noise is not None,
        "blocked": sensor.has_blocked_directions,
    }
    return [words for name, words in PROPERTIES.items() if has[name] and name not in row.holds]

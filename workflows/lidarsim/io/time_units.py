"""Time units in files, and detection of times with an implausible unit."""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np

from ..errors import as_sentence
from ..numerics.arrays import Floats
from ..words import format_rounded

TimeUnit = Literal["s", "ms", "us", "ns"]
# {unit: number of units per second}
SECONDS = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}
_UNIT_NAMES = {"s": "seconds", "ms": "milliseconds", "us": "microseconds", "ns": "nanoseconds"}
# Unix time reaches this value in the year 5138 if it is in seconds, but reached it in 1973 if it is
# in milliseconds.
_MAX_TIME_S = 1e11
_YEAR_S = 366 * 86400.0
_EPOCH_S = (6.3e8, 4.1e9)  # range of plausible Unix times, from 1990 to 2100
_MAX_STEP_S = 3600.0  # maximum plausible interval between consecutive poses
_USUAL_STEP_S = 0.05  # geometric mean of the usual intervals for lidars, cameras and simulations


def seconds_of(
    times: Floats, time_unit: TimeUnit | None, stated: TimeUnit = "s", advice: str = ""
) -> Floats:
    """Convert the times in a file to seconds.

    Parameters
    ----------
    times
        Times in any order, with shape (k,).
    time_unit
        Unit that the user specified, or None.
    stated
        Unit according to the file format or header, which applies if `time_unit` is None.
    advice
        Advice at the end of the error message (default: set `time_unit`).

    Raises
    ------
    ValueError
        If `time_unit` is None and the times are implausible because a time is 1e11 s or more, or
        because the times span more than a year. The message states the probable unit.
    """
    if time_unit is not None:
        return times / SECONDS[time_unit] if time_unit != "s" else times
    seconds = times / SECONDS[stated] if stated != "s" else times
    finite = seconds[np.isfinite(seconds)]
    if not len(finite):
        return seconds
    first_s = float(finite.min())
    last_s = float(finite.max())
    if are_plausible(first_s, last_s):
        return seconds
    span_s = last_s - first_s
    fault = f"its times range from {first_s:.9g} to {last_s:.9g} s"
    if span_s > _YEAR_S:
        fault += f", a span of {format_rounded(span_s / _YEAR_S)} years"
    unit = _probable_unit(times[np.isfinite(times)], stated)
    if unit == stated:
        advice = advice or f"Correct the outliers, or set `time_unit: {unit}`"
        raise ValueError(f"{fault}. {as_sentence(advice)[:-1]}")
    advice = advice or f"Set `time_unit: {unit}`, or `time_unit: {stated}` if they are correct"
    raise ValueError(f"{fault}. They are probably {_UNIT_NAMES[unit]}. {as_sentence(advice)[:-1]}")


def are_plausible(first_s: float, last_s: float) -> bool:
    """Return whether the first and last time, in seconds, are plausible.

    If they are not, the times probably have a different unit.
    """
    return max(-first_s, last_s) < _MAX_TIME_S and last_s - first_s <= _YEAR_S


def _probable_unit(times: Floats, stated: TimeUnit) -> TimeUnit:
    """Return the most probable unit of finite times, or `stated` if none is more probable."""
    steps = np.diff(np.unique(times))
    step = float(np.median(steps)) if len(steps) else 0.0
    largest = float(np.abs(times).max())
    units: tuple[TimeUnit, ...] = get_args(TimeUnit)
    for unit in units:
        count = SECONDS[unit]
        if _EPOCH_S[0] <= largest / count <= _EPOCH_S[1] and step / count <= _MAX_STEP_S:
            return unit
    if not step:
        return stated
    ratios = {unit: step / SECONDS[unit] / _USUAL_STEP_S for unit in units}
    return min(units, key=lambda unit: max(ratios[unit], 1 / ratios[unit]))

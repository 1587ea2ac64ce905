"""Recognize recordings that already contain rain, snow, fog or dust."""

from __future__ import annotations

import numpy as np

from lidarfiles.clouds.recording import Recording
from lidarsim.numerics.even_samples import even_indices

from .scan_pattern import PulseGrid, ScanPattern
from .sensor_motion import SensorMotion

_SWEEPS = 3  # number of sweeps that are examined
_NEAR_M = 15.0  # maximum range of the returns that are examined
# Maximum difference between the ranges of returns from one surface, as a constant and per meter.
_STEP_M = 0.3
_STEP_PER_M = 0.05
# Share of isolated returns from which on there is a note. In recordings of three sensors in clear
# air, 0.3 to 0.7 % of the returns are isolated, and in recorded fog 1 to 5 %.
_MAX_ISOLATED = 0.015


def weather_note(recording: Recording, pattern: ScanPattern, motion: SensorMotion) -> str:
    """Return a note if a recording seems to contain returns from the air, otherwise "".

    A return from a surface usually has neighbors at about the same range, but returns from drops,
    flakes and fog are isolated.

    Raises
    ------
    LidarError
        If the recording cannot be read.
    """
    if pattern.channels is None:
        return ""
    numbers = even_indices(len(recording), _SWEEPS).tolist()
    grids = [pattern.grid(motion.as_fired(recording[number], number)) for number in numbers]
    share = float(np.median([_isolated_share(grid) for grid in grids]))
    if share < _MAX_ISOLATED:
        return ""
    return (
        f"{100 * share:.2g} % of the returns within {_NEAR_M:g} m in {recording.info.name} are "
        "isolated, as in rain, snow or fog. Effects are added to the weather of the recording."
    )


def _isolated_share(grid: PulseGrid) -> float:
    """Return the share of near returns whose neighbors have different ranges.

    Neighbors are the pulses of the same channel in the firings before and after, and those of the
    adjacent channels in the same firing.
    """
    image = np.full(grid.fired.shape, np.inf)
    image.reshape(-1)[grid.cell[::-1]] = grid.range_m[::-1]  # the nearest return of a pulse remains
    near = image < _NEAR_M
    if not near.any():
        return 0.0
    tolerance_m = _STEP_M + _STEP_PER_M * np.where(near, image, 0)
    padded = np.pad(image, ((0, 0), (1, 1)), constant_values=np.inf)
    neighbors = (
        np.roll(image, 1, axis=0),
        np.roll(image, -1, axis=0),
        padded[:, :-2],
        padded[:, 2:],
    )
    connected = np.zeros_like(near)
    with np.errstate(invalid="ignore"):  # between two pulses without a return
        for neighbor in neighbors:
            connected |= np.abs(neighbor - image) < tolerance_m
    return float((near & ~connected).sum() / near.sum())

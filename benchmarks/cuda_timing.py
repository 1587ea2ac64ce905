"""Times of work on a CUDA device, and of calls that use it."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import Any


def milliseconds(cupy: Any, launch: Callable[[], object], repeats: int) -> dict[str, float]:
    """Median, least and greatest time of a launch on the device, by events."""
    for _ in range(3):
        launch()
    times = []
    for _ in range(repeats):
        start, stop = cupy.cuda.Event(), cupy.cuda.Event()
        start.record()
        launch()
        stop.record()
        stop.synchronize()
        times.append(float(cupy.cuda.get_elapsed_time(start, stop)))
    return _summary(times)


def wall_milliseconds(cupy: Any, call: Callable[[], object], repeats: int) -> dict[str, float]:
    """Median, least and greatest time of a call, by the clock, until the device is done."""
    call()
    times = []
    for _ in range(repeats):
        cupy.cuda.Device().synchronize()
        start = time.perf_counter()
        call()
        cupy.cuda.Device().synchronize()
        times.append(1e3 * (time.perf_counter() - start))
    return _summary(times)


def _summary(times: list[float]) -> dict[str, float]:
    return {"median": statistics.median(times), "least": min(times), "greatest": max(times)}

"""Time measurements on a CUDA device, and a description of the device and its host."""

from __future__ import annotations

import math
import platform
import shutil
import statistics
import subprocess
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

# times that something is measured
_LEAST = 3
_MOST = 50
_BATCH_MS = 50  # of the device: short launches are repeated, until its clock has settled
_CLOCKS = ("clocks.sm", "clocks.mem", "temperature.gpu", "power.draw", "pcie.link.gen.current")


@dataclass(frozen=True)
class Sizes:
    """Sizes for all sections.

    The defaults are for a device, and `QUICK` is for tests.
    """

    cities: tuple[int, ...] = (100_000, 1_000_000)  # triangles
    smallest: int = 10_000
    large: int = 10_000_000
    rays: int = 128 * 2048  # of a revolution
    poses: int = 16  # revolutions of one launch
    rays_beyond_int: int = 1 << 31
    forest: tuple[int, int] = (1000, 50_000)  # trees, and leaves of each
    sample: int = 2000  # rays compared with NumPy
    leaks: int = 10_000_000
    batch: int = 1_000_000  # rays
    step_deg: float = 360  # of a scan
    survey: int = 100_000_000  # rays
    seconds: float = 0.7  # for one figure
    copied: int = 1 << 26  # bytes
    sweeps: int = 100_000_000  # rays of sweeps of a scanner
    tests: tuple[str, ...] = ("tests/raybeam", "tests/lidarfiles/test_device_columns.py")


QUICK = Sizes(
    cities=(1000,), smallest=500, large=2000, rays=128 * 16, poses=2, rays_beyond_int=5000,
    forest=(20, 100), sample=300, leaks=5000, batch=14_000, step_deg=18, survey=50_000,
    seconds=0.05, copied=1 << 16, sweeps=50_000, tests=("tests/raybeam/test_device.py",),
)  # fmt: skip


@dataclass(frozen=True)
class Session:
    """CuPy, the sizes and the output folder, as used by all sections."""

    cupy: Any
    sizes: Sizes
    folder: str  # on the disk that parts are written to


def milliseconds(session: Session, launch: Callable[[], object]) -> dict[str, float]:
    """Time a launch with CUDA events, and return the median, minimum and maximum.

    Each time is the mean over a batch of launches that takes at least 50 ms or `sizes.seconds`.
    """
    events = session.cupy.cuda.Event

    def batch(count: int) -> float:
        start = events()
        stop = events()
        start.record()
        for _ in range(count):
            launch()
        stop.record()
        stop.synchronize()
        return float(session.cupy.cuda.get_elapsed_time(start, stop)) / count

    launch()
    batch_ms = min(_BATCH_MS, 1e3 * session.sizes.seconds)
    count = math.ceil(batch_ms / batch(1))
    return {**_repeated(session, lambda: batch(count)), "launches": count}


def wall_milliseconds(session: Session, call: Callable[[], object]) -> dict[str, float]:
    """Return the median, minimum and maximum wall time of a call and its work on the device."""
    device = session.cupy.cuda.Device()
    call()

    def once() -> float:
        device.synchronize()
        start = time.perf_counter()
        call()
        device.synchronize()
        return 1e3 * (time.perf_counter() - start)

    return _repeated(session, once)


def _repeated(session: Session, once: Callable[[], float]) -> dict[str, float]:
    """Return the median, minimum and maximum of the times that `once` returns, in milliseconds."""
    end = time.monotonic() + session.sizes.seconds
    times = [once()]
    while len(times) < _LEAST or (len(times) < _MOST and time.monotonic() < end):
        times.append(once())
    return {"ms": statistics.median(times), "least_ms": min(times), "greatest_ms": max(times)}


class Split:
    """Total device time by name of the work, measured with CUDA events."""

    def __init__(self, cupy: Any) -> None:
        self._cupy = cupy
        self._pairs: list[tuple[str, Any, Any]] = []

    @contextmanager
    def timed(self, name: str, stream: Any = None) -> Iterator[None]:
        """Add the device time of the body's work, by default in the current stream."""
        stream = stream or self._cupy.cuda.get_current_stream()
        start = stream.record()
        yield
        self._pairs.append((name, start, stream.record()))

    def milliseconds(self) -> dict[str, float]:
        """Synchronize the device, and return the total time by name, in milliseconds."""
        self._cupy.cuda.Device().synchronize()
        sums: Counter[str] = Counter()
        for name, start, stop in self._pairs:
            sums[name] += self._cupy.cuda.get_elapsed_time(start, stop)
        return dict(sums)


def pinned(cupy: Any, count: int) -> Any:
    """Allocate `count` bytes of page-locked memory."""
    return np.frombuffer(cupy.cuda.alloc_pinned_memory(count), np.uint8, count)


def to_pinned(session: Session) -> float:
    """Measure the bus rate in GB/s, by copying from the device to page-locked memory."""
    cupy = session.cupy
    count = session.sizes.copied
    array = cupy.zeros(count, np.uint8)
    buffer = pinned(cupy, count)
    stream = cupy.cuda.get_current_stream()
    copy = milliseconds(session, lambda: array.get(stream=stream, out=buffer, blocking=False))
    return count / copy["ms"] / 1e6


def device(session: Session) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the properties and the copy rates of the device."""
    cupy = session.cupy
    count = session.sizes.copied
    runtime = cupy.cuda.runtime
    properties = runtime.getDeviceProperties(cupy.cuda.Device().id)
    major, minor = divmod(runtime.driverGetVersion(), 1000)
    yield (
        "device",
        {
            "name": properties["name"].decode(),
            "memory_gb": round(properties["totalGlobalMem"] / 1e9, 1),
            "multiprocessors": properties["multiProcessorCount"],
            "driver_cuda": f"{major}.{minor // 10}",
            "runtime": runtime.runtimeGetVersion(),
            "cupy": cupy.__version__,
            "numpy": np.__version__,
            "python": platform.python_version(),
            "date": time.strftime("%Y-%m-%d"),
        },
    )
    array = cupy.zeros(count, np.uint8)
    plain = np.zeros(count, np.uint8)
    source = pinned(cupy, count)
    target = cupy.empty_like(array)
    stream = cupy.cuda.get_current_stream()
    calls = {
        "from pinned": (milliseconds, lambda: array.set(source, stream=stream)),
        "to touched": (wall_milliseconds, lambda: array.get(out=plain)),
        "to fresh": (wall_milliseconds, array.get),
        "from plain": (wall_milliseconds, lambda: array.set(plain)),
    }
    rates = {
        name: count / clock(session, call)["ms"] / 1e6 for name, (clock, call) in calls.items()
    }
    copied = milliseconds(session, lambda: cupy.copyto(target, array))["ms"]
    yield (
        "copies, GB/s",
        {
            "to pinned": to_pinned(session),
            **rates,
            "device, read and write": 2 * count / copied / 1e6,
        },
    )


def clocks() -> dict[str, str]:
    """Return the clocks, temperature and power that nvidia-smi reports.

    The result is empty without nvidia-smi.
    """
    program = shutil.which("nvidia-smi")
    if program is None:
        return {}
    command = [program, f"--query-gpu={','.join(('driver_version', *_CLOCKS))}", "--format=csv"]
    try:
        lines = subprocess.run(
            command, capture_output=True, text=True, timeout=20
        ).stdout.splitlines()
    except (OSError, subprocess.TimeoutExpired) as error:
        return {"error": str(error)}
    rows = [[word.strip() for word in line.split(",")] for line in lines[:2]]
    return dict(zip(*rows, strict=True)) if len(rows) == 2 else {}

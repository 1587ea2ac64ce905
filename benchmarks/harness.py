"""Options, timing and output shared by the benchmarks."""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

Result = TypeVar("Result")

CLOCKS = {"wall": time.perf_counter, "cpu": time.process_time}
_PACKAGES = (
    "numpy",
    "numba",
    "dask",
    "open3d",
    "open3d-cpu",
    "trimesh",
    "mujoco",
    "newton",
    "warp-lang",
)


def argument_parser(
    doc: str | None, *, repeat: int = 0, quick: bool = False, clock: str = ""
) -> argparse.ArgumentParser:
    """Return a parser with the options that the benchmarks share.

    Parameters
    ----------
    doc
        Docstring of the benchmark, which `--help` shows.
    repeat
        Default of `--repeat`. By default, there is no such option.
    quick
        Whether there is an option `--quick`.
    clock
        Default of `--clock`. By default, there is no such option.
    """
    parser = argparse.ArgumentParser(
        description=doc, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    if repeat:
        words = f"number of rounds (default: {repeat})"
        parser.add_argument("--repeat", type=int, default=repeat, metavar="N", help=words)
    if quick:
        parser.add_argument("--quick", action="store_true", help="use toy sizes, for tests")
    if clock:
        words = f"time to measure (default: {clock})"
        parser.add_argument("--clock", choices=CLOCKS, default=clock, help=words)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the results to FILE")
    return parser


def write_results(path: Path | None, results: Any) -> None:
    """Write results and a description of the machine to a JSON file.

    Do nothing if there is no path. The file is replaced atomically.
    """
    if path is None:
        return
    report = {"command": sys.argv[1:], "machine": machine(), "results": results}
    unfinished = path.with_name(f"{path.name}.new")
    unfinished.write_text(json.dumps(report, indent=1, default=float) + "\n", "utf-8")
    unfinished.replace(path)


def read_results(path: Path) -> Any:
    """Read the results from a file written by `write_results`."""
    return json.loads(path.read_text("utf-8"))["results"]


def machine() -> dict[str, Any]:
    """Return the date, the processor and the software versions of a measurement."""
    versions = {"python": platform.python_version()}
    for name in _PACKAGES:
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            continue
    return {
        "date": datetime.now(UTC).date().isoformat(),
        "processor": _processor(),
        "cores": os.cpu_count(),
        "load": os.getloadavg(),
        "versions": versions,
    }


def _processor() -> str:
    file = Path("/proc/cpuinfo")
    lines = file.read_text().splitlines() if file.exists() else []
    names = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(names, platform.processor())


def time_call(call: Callable[[], Result], clock: str = "cpu") -> tuple[float, Result]:
    """Return the time of a call in seconds, and the call's result."""
    start = CLOCKS[clock]()
    result = call()
    return CLOCKS[clock]() - start, result


def run_rounds(
    calls: Mapping[str, Callable[[int], Result]], repeat: int, warm_up: int = 1
) -> dict[str, list[Result]]:
    """Call functions in rounds, and return their results by name, without the warm-up rounds.

    All functions run once in each round, so that other programs on the machine slow all of them
    down equally. Each random order is followed by its reverse, so that each of two functions runs
    first in half of the rounds.

    Parameters
    ----------
    calls
        Functions by name. Each receives the number of the round.
    repeat
        Number of rounds whose results are returned.
    warm_up
        Number of rounds before them.
    """
    results: dict[str, list[Result]] = {name: [] for name in calls}
    for number in range(warm_up + repeat):
        order = np.random.default_rng(number // 2).permutation(list(calls)).tolist()
        for name in order[:: -1 if number % 2 else 1]:
            result = calls[name](number)
            if number >= warm_up:
                results[name].append(result)
    return results


def median_ratio(first: Sequence[float], second: Sequence[float]) -> float:
    """Return the median over all rounds of the ratio between two measurements."""
    return float(np.median(np.maximum(first, 1e-9) / np.maximum(second, 1e-9)))


def cpu_seconds(process: Any) -> float:
    """Return the total CPU time of a process in seconds."""
    times = process.cpu_times()
    return float(times.user + times.system)


def has_modules(python: str, *modules: str) -> bool:
    """Return whether a Python interpreter can import the given modules."""
    command = [python, "-c", f"import {', '.join(modules)}"]
    return subprocess.run(command, capture_output=True, check=False).returncode == 0


def print_row(*cells: object) -> None:
    """Print a Markdown table row."""
    print("|", " | ".join(map(str, cells)), "|", flush=True)

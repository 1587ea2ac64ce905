"""Measure all operations on a CUDA device.

    python -m benchmarks.gpu [--quick] [--only SECTION ...] --json gpu.json

Run it in the root of the repository with `PYTHONPATH=kernels:scheduler:workflows`. Ray casting
requires NumPy and CuPy. Points also require lidarpool's dependencies, except Open3D, trimesh and
Matplotlib, and the comparison requires warp-lang. Sections whose packages are missing are skipped
and listed. Each section runs in its own process with a time limit, so that a failure does not
affect the other sections. The JSON file is written after each section. Finally, the table of
docs/performance.md is printed. Times are medians.

Use `--first-device` on a device on which nothing has run yet. It also runs the tests and NVIDIA's
tools, in order of increasing risk, and writes a Markdown page next to the JSON file.
"""

from __future__ import annotations

import argparse
import importlib
import os
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

from raybeam import available_backends
from raybeam.registry import choose_backend

from .gpu_clock import QUICK, Session, Sizes, clocks
from .harness import argument_parser, read_results, write_results

# {section: (its module, seconds at most)}, in an order of rising risk; its function has its name.
# A section has that long on a device with nothing compiled yet.
SECTIONS = {
    "device": ("gpu_clock", 10),
    "compiling": ("gpu_first", 15),
    "tests": ("gpu_first", 100),
    "bits": ("gpu_bits", 35),
    "leaks": ("gpu_bits", 10),
    "sanitizer": ("gpu_first", 80),
    "kernels": ("gpu_rays", 35),
    "scanner": ("gpu_points", 30),
    "columns": ("gpu_points", 50),
    "run": ("gpu_points", 45),
    "peers": ("gpu_warp", 25),
    "large": ("gpu_rays", 55),
    "counters": ("gpu_first", 40),
    "moving": ("gpu_rays", 20),
    "instances": ("gpu_rays", 25),
    "durable": ("gpu_points", 30),
    "sharing": ("gpu_points", 35),
}
_FIRST_ONLY = ("tests", "sanitizer", "scanner", "counters")
MEASURED = [name for name in SECTIONS if name not in _FIRST_ONLY]  # 400 s
# Seconds for all sections: of a device on which nothing has run yet, and of other devices.
FIRST_S = 540
MEASURED_S = 400

_CITIES = ("city 1e4", "city 1e5", "city 1e6")
_MOVING = ("still", "a pose for each firing", "with motion")


def _casts(kind: str) -> list[str]:
    """Return the result paths of casting rates in all cities, for one kind of rays."""
    paths = [f"kernels/{city}, {kind}/grays_s/cast" for city in _CITIES]
    return [*paths, f"large/city 1e7, {kind}/grays_s/cast"]


# Rows of the table: what it is, its unit and digits, and where in the results the figures are.
ROWS = (
    ("rays in sensor order, 16 revolutions of 128 × 2,048 rays, city of 10⁴, 10⁵, "
     "10⁶, 10⁷ triangles, Gray/s", 2,
     _casts("coherent")),
    ("one revolution in sensor order, same cities, Gray/s", 2, _casts("one revolution")),
    ("16 revolutions in random order, same cities, Gray/s", 2, _casts("shuffled")),
    ("random directions from random origins, same cities, Gray/s", 2, _casts("scattered")),
    ("hits copied to the host, 16 bytes each, city of 10⁴, 10⁵, 10⁶ triangles, Gray/s", 2,
     [f"kernels/{city}, coherent/grays_s/to_host" for city in _CITIES]),
    ("time to build a caster of 10⁴, 10⁵, 10⁶, 10⁷ triangles, s", 1,
     (*(f"kernels/{city}, build/seconds" for city in _CITIES), "large/city 1e7, build/seconds")),
    ("stationary sensor; one pose per firing; motion within each firing; city of 10⁶ "
     "triangles, Gray/s", 2,
     [f"moving/{name}/grays_s/cast" for name in _MOVING]),
    ("forest of 1,000 trees of 50,000 leaves; with opacity masks, Gray/s", 2,
     [f"instances/{name}/grays_s/cast" for name in ("forest", "forest, masked")]),
    ("sampled values that differ from NumPy; rays that escape", 0,
     ("different", "leaks/edges and corners/escaped")),
    ("NVIDIA Warp mesh query, fastest configuration, sensor order, city of 10⁵, 10⁶ "
     "triangles, Gray/s", 2,
     [f"peers/{city}/coherent" for city in _CITIES[1:]]),
    ("raybeam rate ÷ fastest Warp rate: city of 10⁵ triangles in sensor order, in "
     "random order; city of 10⁶ triangles in sensor order, in random order", 2,
     [f"to Warp/{city}/{order}" for city in _CITIES[1:] for order in ("coherent", "shuffled")]),
    ("points with columns in host memory: all points, every fifth point, ten actors, "
     "million points/s", 0,
     [f"columns/{name}/mpoints_s" for name in ("plain", "every fifth point", "ten actors")]),
    ("bytes per point over the bus; share of the bus bandwidth", 2,
     ("columns/plain/bytes_a_point", "columns/plain/bus_share")),
    ("points in parts in memory, on disk, million points/s", 0,
     ("durable/memory/mpoints_s", "durable/disk/mpoints_s")),
    ("survey on a local cluster: all points, every fifth point, million points/s", 0,
     [f"run/{name}/mpoints_s" for name in ("all points", "every fifth point")]),
    ("rate of two processes on one device ÷ rate of one process", 2, ("sharing/two to one/ratio",)),
    ("2³¹ rays, Gray/s", 2, ("large/many rays/grays_s",)),
    ("scanner in a loop, results copied to the host: range images, sweeps, Gray/s", 2,
     ("scanner/ranges of 16 poses/grays_s", "scanner/sweeps/grays_s")),
    ("tests that require a device: passed, failed", 0, ("tests/passed", "tests/failed")),
    ("compute-sanitizer on small scenes: memory errors, hazards", 0,
     ("sanitizer/memcheck/errors", "sanitizer/racecheck/errors")),
    ("casting kernel (ncu): registers, occupancy in %, active threads per warp", 0,
     [f"counters/cast_table/{figure}" for figure in (
         "Registers Per Thread, register per thread", "Achieved Occupancy, %",
         "Avg. Active Threads Per Warp")]),
)  # fmt: skip


def figure_at(results: dict[str, Any], path: str) -> float | None:
    """Return the value at a path in the results, or None if it was not measured."""
    if path == "different":
        checked = [results.get(name, {}) for name in ("bits", "columns")]
        rows = [row for section in checked for row in section.values() if isinstance(row, dict)]
        wrong = [n for row in rows for name, n in row.items() if name.startswith("different")]
        return sum(wrong) if wrong else None
    first, _, rest = path.partition("/")
    if first == "tests":
        rows = [row for row in results.get("tests", {}).values() if isinstance(row, dict)]
        return sum(row.get(rest, 0) for row in rows) if rows else None
    if first == "peers":
        scene, order = rest.split("/")
        rows = [row for name, row in results.get("peers", {}).items() if name.startswith(scene)]
        return max((row[order]["grays_s"] for row in rows), default=None)
    if first == "to Warp":
        peer = figure_at(results, f"peers/{rest}")
        scene, order = rest.split("/")
        rate = figure_at(results, f"kernels/{scene}, {order}/grays_s/cast")
        return rate / peer if rate and peer else None
    value: Any = results
    for key in path.split("/"):
        value = value.get(key) if isinstance(value, dict) else None
    return value


def table(results: dict[str, Any]) -> list[str]:
    """Return the Markdown table for docs/performance.md, line by line."""
    lines = ["| measurement | result |", "|---|---|"]
    for name, digits, paths in ROWS:
        values = [figure_at(results, path) for path in paths]
        words = ["not measured" if v is None else f"{v:,.{digits}f}" for v in values]
        none = all(v is None for v in values)
        lines.append(f"| {name} | {words[0] if none else ', '.join(words)} |")
    return lines


def headline(results: dict[str, Any]) -> str:
    """Format the device, its clock rates under load, the versions and the date as one line."""
    device = results.get("device", {}).get("device", {})
    clock = results.get("kernels", {}).get("clocks", {}).get("after", {})
    words = [device.get("name"), *(f"{name} {value}" for name, value in clock.items())]
    words += [f"{name} {device[name]}" for name in ("driver_cuda", "cupy", "numpy") if device]
    return ", ".join(word for word in (*words, device.get("date")) if word)


def problems(results: dict[str, Any]) -> list[str]:
    """List the sections that failed on the device or gave wrong results."""
    failures = [f"{name}: {row['error']}" for name, row in results.items() if "error" in row]
    failures += [
        f"{name}: {title} failed"
        for name, rows in results.items()
        for title, row in rows.items()
        if isinstance(row, dict) and row.get("failed")
    ]
    if figure_at(results, "different"):
        failures.append("values differ from those of numpy or tiles")
    if figure_at(results, "leaks/edges and corners/escaped"):
        failures.append("rays escape")
    if figure_at(results, "large/many rays/wrong hits"):
        failures.append("hits of many rays are wrong")
    return failures


def left_out(results: dict[str, Any]) -> list[str]:
    """List the skipped sections and rows, with the reasons."""
    notes = []
    for name, rows in results.items():
        if "left out" in rows:
            notes.append(f"skipped: {name}, because {rows['left out']}")
        notes += [
            f"skipped: {name}, {title}, because {row['left out']}"
            for title, row in rows.items()
            if isinstance(row, dict) and "left out" in row
        ]
    return notes


def page(results: dict[str, Any]) -> str:
    """Return the results as Markdown for docs/performance.md."""
    lines = [headline(results), "", *table(results), "", "| section | seconds | rows | |"]
    lines.append("|---|--:|--:|---|")
    for name, rows in results.items():
        count = sum(isinstance(row, dict) for title, row in rows.items() if title != "clocks")
        words = rows.get("error") or rows.get("left out") or ""
        lines.append(f"| {name} | {rows.get('seconds', 0):.1f} | {count} | {words} |")
    notes = [*left_out(results), *(f"wrong: {problem}" for problem in problems(results))]
    return "\n".join([*lines, "", *(f"- {note}" for note in notes), ""])


def measured(name: str, sizes: Sizes, folder: str) -> Iterator[dict[str, Any]]:
    """Run a section in this process.

    Yield all rows measured so far after each new row.
    """
    module, seconds = SECTIONS[name]
    rows: dict[str, Any] = {}
    clocks_before = clocks()
    end = time.monotonic() + 0.7 * seconds  # then a row has time to end
    try:
        section = getattr(importlib.import_module(f".{module}", __package__), name)
        cupy = choose_backend("cuda").load_cupy()  # type: ignore[attr-defined]
        for title, row in section(Session(cupy, sizes, folder)):
            rows[title] = row
            print(f"{name}: {title}: {shown(row)}", flush=True)
            yield rows
            if time.monotonic() > end:
                rows["left out"] = "the time limit was reached, so rows may be missing"
                break
    except ModuleNotFoundError as error:
        rows["left out"] = f"{error.name} is not installed"
    except Exception as error:
        traceback.print_exc()
        rows["error"] = f"{type(error).__name__}: {error}"
    rows["clocks"] = {"before": clocks_before, "after": clocks()}
    yield rows


def shown(row: Any) -> str:
    """Format a row as one line, omitting times if rates are present."""
    if not isinstance(row, dict):
        return f"{row:.4g}" if isinstance(row, float) else str(row)
    words = [
        f"{name} ({shown(value)})" if isinstance(value, dict) else f"{name} {shown(value)}"
        for name, value in row.items()
        if name not in ("ms", "least_ms", "greatest_ms", "tried") or len(row) == 1
    ]
    return ", ".join(words)


def apart(name: str, options: list[str], seconds: float) -> dict[str, Any]:
    """Run a section in a new process and return its rows.

    The process is killed after `seconds`.
    """
    start = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "rows.json")
        arguments = ["--in-process", "--only", name, "--json", str(path), *options]
        process = subprocess.Popen(
            [sys.executable, "-m", "benchmarks.gpu", *arguments], start_new_session=True
        )
        error = ""
        try:
            if process.wait(seconds) not in (0, 1):
                error = f"its process ended with {process.returncode}"
        except subprocess.TimeoutExpired:
            error = f"ended after {seconds:.0f} s"
        finally:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
        rows = read_results(path).get(name, {}) if path.exists() else {}
        rows["seconds"] = round(time.monotonic() - start, 1)
        return {**rows, "error": error} if error else rows


def main(arguments: list[str] | None = None) -> int:
    """Run the benchmark.

    Return 1 for failures or wrong results, and 2 if there is no device.
    """
    parser = argument_parser(__doc__, quick=True)
    parser.add_argument(
        "--first-device",
        action="store_true",
        help="also run tests and NVIDIA's tools, for a device on which nothing has run yet",
    )
    parser.add_argument("--only", nargs="+", choices=SECTIONS, help="run only these sections")
    parser.add_argument("--seconds", type=float, help="time limit of all sections")
    parser.add_argument("--folder", default=".", help="folder for parts, on a disk")
    parser.add_argument("--in-process", action="store_true", help="run sections in this process")
    chosen = parser.parse_args(arguments)
    if chosen.first_device and chosen.json is None:
        chosen.json = Path("first-device.json")
    if reason := available_backends()["cuda"]:
        print(f"Nothing was measured: {reason}.", file=sys.stderr)
        return 2
    names = chosen.only or (list(SECTIONS) if chosen.first_device else MEASURED)
    results = run_sections(names, chosen)
    wrong = problems(results)
    if len(names) > 1:
        print("", headline(results), "", *table(results), "", sep="\n")
        print(*left_out(results), *(f"wrong: {problem}" for problem in wrong), sep="\n")
    return int(bool(wrong))


def run_sections(names: list[str], chosen: argparse.Namespace) -> dict[str, Any]:
    """Run sections one after another, and write all results after each of them."""
    options = ["--folder", chosen.folder, *(["--quick"] if chosen.quick else [])]
    seconds = chosen.seconds or (FIRST_S if chosen.first_device else MEASURED_S)
    end = time.monotonic() + seconds
    results: dict[str, Any] = {}

    def store(name: str, rows: dict[str, Any]) -> None:
        results[name] = rows
        write_results(chosen.json, results)
        if chosen.first_device:
            chosen.json.with_suffix(".md").write_text(page(results), "utf-8")

    for name in names:
        remaining_s = end - time.monotonic()
        if remaining_s < 5:
            store(name, {"left out": "no time was left"})
        elif chosen.in_process:
            for rows in measured(name, QUICK if chosen.quick else Sizes(), chosen.folder):
                store(name, rows)
        else:
            store(name, apart(name, options, min(SECTIONS[name][1], remaining_s)))
    return results


if __name__ == "__main__":
    sys.exit(main())

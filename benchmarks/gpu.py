"""All that a CUDA device does for lidarpool, measured by one command: `python -m benchmarks.gpu`.

From the repository's root, with NumPy and CuPy, the parts of the project on the path:

    PYTHONPATH=kernels:scheduler:workflows python -m benchmarks.gpu --json gpu.json

Points need lidarpool's dependencies besides, but not Open3D, trimesh or Matplotlib; peers need
warp-lang and mujoco-lidar. What cannot be imported is left out and named. Each section is a process
of its own, with a limit of time: one that fails, even by ending the process, leaves the others. The
file is written after each. At the end comes the table of docs/performance.md. Times are medians.
"""

from __future__ import annotations

import argparse
import importlib
import json
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
from raybeam.registry import choose

from .gpu_clock import QUICK, Session, Sizes, clocks

# {section: (its module, seconds at most)}, the most important first; its function is of that name.
# A section has that long on a device with nothing compiled yet: 400 s for all of them.
SECTIONS = {
    "device": ("gpu_clock", 20),
    "kernels": ("gpu_rays", 60),
    "bits": ("gpu_rays", 30),
    "leaks": ("gpu_rays", 15),
    "moving": ("gpu_rays", 25),
    "columns": ("gpu_points", 40),
    "instances": ("gpu_rays", 30),
    "durable": ("gpu_points", 35),
    "sharing": ("gpu_points", 25),
    "run": ("gpu_points", 40),
    "peers": ("gpu_warp", 20),
    "mujoco": ("gpu_warp", 20),
    "large": ("gpu_rays", 40),
}

# Rows of the table: what it is, its unit and digits, and where in the results the figures are.
_CITIES = ("city 1e5", "city 1e6")
_KERNEL = [f"kernels/{city}, {{}}/grays_s/cast" for city in _CITIES]
_MOVING = ("still", "a pose for each firing", "with motion")
ROWS = (
    ("rays in order, 16 revolutions of 128 × 2,048, city of 10⁵, 10⁶, 10⁷ triangles, Gray/s", 2,
     (*(path.format("coherent") for path in _KERNEL), "large/city 1e7, coherent/grays_s/cast")),
    ("the same, one revolution, city of 10⁵, 10⁶", 2,
     [path.format("one revolution") for path in _KERNEL]),
    ("the same, shuffled", 2, [path.format("shuffled") for path in _KERNEL]),
    ("brute force, Mray/s", 2, [f"kernels/{city}, brute force/mrays_s" for city in _CITIES]),
    ("hits to the host, 20 bytes each, Gray/s", 2,
     [f"kernels/{city}, coherent/grays_s/to_host" for city in _CITIES]),
    ("caster of 10⁵, 10⁶, 10⁷ triangles, s", 1,
     (*(f"kernels/{city}, build/seconds" for city in _CITIES), "large/city 1e7, build/seconds")),
    ("a still sensor; a pose for each firing; with motion, city of 10⁶, Gray/s", 2,
     [f"moving/{name}/grays_s/cast" for name in _MOVING]),
    ("forest of 1,000 trees of 50,000 leaves; masked, Gray/s", 2,
     [f"instances/{name}/grays_s/cast" for name in ("forest", "forest, masked")]),
    ("values that differ from NumPy's in samples; rays that escape", 0,
     ("different", "leaks/edges and corners/escaped")),
    ("NVIDIA Warp's mesh query at best, city of 10⁵, 10⁶, in order, Gray/s", 2,
     [f"peers/{city}/coherent" for city in _CITIES]),
    ("MuJoCo-LiDAR's Warp backend; raybeam, poses to distances on the host, city of 10⁵, Gray/s", 2,
     ("mujoco/MuJoCo-LiDAR/grays_s", "mujoco/raybeam/grays_s")),
    ("points with columns in host memory: plain survey, every fifth, ten actors, million/s", 0,
     [f"columns/{name}/mpoints_s" for name in ("plain", "every fifth point", "ten actors")]),
    ("bytes of a point over the bus; share of the bus", 2,
     ("columns/plain/bytes_a_point", "columns/plain/bus_share")),
    ("points in parts in memory, on a disk, million/s", 0,
     ("durable/memory/mpoints_s", "durable/disk/mpoints_s")),
    ("a survey on a cluster of this machine, all points, every fifth, million points/s", 0,
     [f"run/{name}/mpoints_s" for name in ("all points", "every fifth point")]),
    ("two processes on a device, compared with one", 2, ("sharing/two to one/ratio",)),
    ("2³¹ rays, Gray/s", 2, ("large/many rays/grays_s",)),
)  # fmt: skip


def figure_at(results: dict[str, Any], path: str) -> float | None:
    """Return a figure of the results by its path, or None if it was not measured."""
    if path == "different":
        checked = [results.get(name, {}) for name in ("bits", "columns")]
        rows = [row for section in checked for row in section.values() if isinstance(row, dict)]
        wrong = [n for row in rows for name, n in row.items() if name.startswith("different")]
        return sum(wrong) if wrong else None
    if path.startswith("peers/"):
        _, scene, order = path.split("/")
        rows = [row for name, row in results.get("peers", {}).items() if name.startswith(scene)]
        return max((row[order]["grays_s"] for row in rows), default=None)
    value: Any = results
    for key in path.split("/"):
        value = value.get(key) if isinstance(value, dict) else None
    return value


def table(results: dict[str, Any]) -> list[str]:
    """Return the lines of the table of docs/performance.md."""
    lines = ["| | |", "|---|---|"]
    for name, digits, paths in ROWS:
        values = [figure_at(results, path) for path in paths]
        words = ["not measured" if v is None else f"{v:,.{digits}f}" for v in values]
        none = all(v is None for v in values)
        lines.append(f"| {name} | {words[0] if none else ', '.join(words)} |")
    return lines


def headline(results: dict[str, Any]) -> str:
    """Return a line with the device, its clock under load, versions and date."""
    device = results.get("device", {}).get("device", {})
    clock = results.get("kernels", {}).get("clocks", {}).get("after", {})
    words = [device.get("name"), *(f"{name} {value}" for name, value in clock.items())]
    words += [f"{name} {device[name]}" for name in ("driver_cuda", "cupy", "numpy") if device]
    return ", ".join(word for word in (*words, device.get("date")) if word)


def problems(results: dict[str, Any]) -> list[str]:
    """List failed sections and wrong results of the device."""
    failures = [f"{name}: {row['error']}" for name, row in results.items() if "error" in row]
    if figure_at(results, "different"):
        failures.append("values differ from NumPy's")
    if figure_at(results, "leaks/edges and corners/escaped"):
        failures.append("rays escape")
    if figure_at(results, "large/many rays/wrong hits"):
        failures.append("hits of many rays are wrong")
    return failures


def measured(name: str, sizes: Sizes, folder: str) -> Iterator[dict[str, Any]]:
    """Measure a section in this process; yield its rows after each new row."""
    module, seconds = SECTIONS[name]
    rows: dict[str, Any] = {}
    clocks_before = clocks()
    end = time.monotonic() + 0.7 * seconds  # then a row has time to end
    try:
        section = getattr(importlib.import_module(f".{module}", __package__), name)
        cupy = choose("cuda").load_cupy()  # type: ignore[attr-defined]
        for title, row in section(Session(cupy, sizes, folder)):
            rows[title] = row
            print(f"{name}: {title}: {shown(row)}", flush=True)
            yield rows
            if time.monotonic() > end:
                rows["left out"] = "the rest, for want of time"
                break
    except ModuleNotFoundError as error:
        rows["left out"] = f"{error.name} is not installed"
    except Exception as error:
        traceback.print_exc()
        rows["error"] = f"{type(error).__name__}: {error}"
    rows["clocks"] = {"before": clocks_before, "after": clocks()}
    yield rows


def shown(row: Any) -> str:
    """Format a row in a line, without times where rates are present."""
    if not isinstance(row, dict):
        return f"{row:.4g}" if isinstance(row, float) else str(row)
    words = [
        f"{name} ({shown(value)})" if isinstance(value, dict) else f"{name} {shown(value)}"
        for name, value in row.items()
        if name not in ("ms", "least_ms", "greatest_ms", "tried") or len(row) == 1
    ]
    return ", ".join(words)


def apart(name: str, options: list[str], seconds: float) -> dict[str, Any]:
    """Measure a section in a new process, which is killed after `seconds`; return its rows."""
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
        rows = json.loads(path.read_text())["sections"].get(name, {}) if path.exists() else {}
        return {**rows, "error": error} if error else rows


def main(arguments: list[str] | None = None) -> int:
    """Run from the command line; return 1 for failures or wrong results, 2 without a device."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--quick", action="store_true", help="toy sizes: whether it works")
    parser.add_argument("--only", nargs="+", choices=SECTIONS, default=list(SECTIONS))
    parser.add_argument("--seconds", type=float, default=400, help="for all sections")
    parser.add_argument("--folder", default=".", help="on the disk for parts")
    parser.add_argument("--json", type=Path, help="write the results here")
    parser.add_argument("--in-process", action="store_true", help="all sections in this process")
    chosen = parser.parse_args(arguments)
    if reason := available_backends()["cuda"]:
        print(f"Nothing was measured: {reason}.", file=sys.stderr)
        return 2
    options = ["--folder", chosen.folder, *(["--quick"] if chosen.quick else [])]
    end = time.monotonic() + chosen.seconds
    results = {}

    def store(name: str, rows: dict[str, Any]) -> None:
        results[name] = rows
        if chosen.json:
            report = {"command": sys.argv[1:], "sections": results}
            unfinished = chosen.json.with_name(f"{chosen.json.name}.new")
            unfinished.write_text(json.dumps(report, indent=1, default=float) + "\n")
            unfinished.replace(chosen.json)

    for name in chosen.only:
        remaining_s = end - time.monotonic()
        if remaining_s < 5:
            store(name, {"left out": "no time was left"})
        elif chosen.in_process:
            for rows in measured(name, QUICK if chosen.quick else Sizes(), chosen.folder):
                store(name, rows)
        else:
            store(name, apart(name, options, min(SECTIONS[name][1], remaining_s)))
    wrong = problems(results)
    if len(chosen.only) > 1:
        print("", headline(results), "", *table(results), "", sep="\n")
        left_out = {name: rows["left out"] for name, rows in results.items() if "left out" in rows}
        notes = [f"left out: {name}, because {reason}" for name, reason in left_out.items()]
        print(*notes, *(f"wrong: {problem}" for problem in wrong), sep="\n")
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())

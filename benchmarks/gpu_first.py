"""Sections for a new device, which run compilation, tests and NVIDIA's tools."""

from __future__ import annotations

import csv
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from raybeam import Pattern, RayCaster
from raybeam.cuda_backend import compiler_options, kernel_source
from raybeam.scan import check_scan

from .gpu_clock import Session
from .gpu_rays import MIDDLE, Rows
from .gpu_scenes import city, revolution

ROOT = Path(__file__).parents[1]
# Seconds for the tests of a file, and for a tool of NVIDIA.
_FILE_S = 45
_TOOL_S = 38
_STACK = 64  # nodes that wait in a traversal, of cities of 10⁵ triangles
# In CuPy's pool of memory, an access beyond an array is an access to another array.
_WITHOUT_POOL = (
    "import sys, cupy; cupy.cuda.set_allocator(None); "
    "from benchmarks.gpu import main; sys.exit(main(sys.argv[1:]))"
)
# Errors of kernels alone: calls of CUDA that CuPy tries are no faults, nor are other programs.
_SANITIZER = ("--target-processes", "application-only", "--report-api-errors", "no")
# Of ncu: names of groups of figures, and of the figures to report.
_NCU_SECTIONS = ("SpeedOfLight", "LaunchStats", "Occupancy", "WarpStateStats", "InstructionStats")
_FIGURES = (
    "Duration",
    "Registers Per Thread",
    "Achieved Occupancy",
    "Theoretical Occupancy",
    "Avg. Active Threads Per Warp",
    "Compute (SM) Throughput",
    "Memory Throughput",
    "L2 Cache Throughput",
    "DRAM Throughput",
    "Executed Instructions",
)
PROFILED = ("cast_table", "pack")


def compiling(session: Session) -> Rows:
    """Yield the compile time, registers and local bytes of each kernel for each kind of scene."""
    names = re.findall(r"^KERNEL (\w+)\(", kernel_source(), re.M)
    for words, nested, masked in (
        ("meshes", False, False),
        ("masked", False, True),
        ("instances", True, False),
        ("instances, masked", True, True),
    ):
        start = time.perf_counter()
        module = session.cupy.RawModule(
            code=kernel_source(), options=compiler_options(_STACK, nested, masked)
        )
        module.compile()
        row: dict[str, Any] = {"seconds": time.perf_counter() - start}
        for name in names:
            function = module.get_function(name)
            row[name] = {"registers": function.num_regs, "local_bytes": function.local_size_bytes}
        yield words, row


def tests(session: Session) -> Rows:
    """Run the tests that need a device, and yield their outcomes.

    Each test file runs in its own process.
    """
    if find_spec("pytest") is None:
        raise ModuleNotFoundError("pytest is not installed", name="pytest")
    files = _files_of_tests(session.sizes.tests)
    for path in files:
        yield path, _outcomes(path)
    for path in session.sizes.tests:
        if not any(file.startswith(path) for file in files):
            yield path, {"left out": "packages that it imports are not installed"}


def _pytest(*arguments: str) -> list[str]:
    options = ("-p", "no:cacheprovider", "-m", "gpu", "--tb=short")
    return [sys.executable, "-m", "pytest", *options, *arguments]


def _files_of_tests(paths: tuple[str, ...]) -> list[str]:
    """Return the test files from which pytest collects tests for a device."""
    listing, _ = _output_of(_pytest("--collect-only", "-q", *paths), _FILE_S)
    files = re.findall(r"^(tests/\S+?)::", listing, re.M)
    if not files:
        raise RuntimeError(f"pytest collects no tests for a device: {listing[-500:]}")
    return list(dict.fromkeys(files))


def _outcomes(path: str) -> dict[str, Any]:
    """Run the tests of a file.

    Return the number of tests by outcome, and the end of the output if tests failed.
    """
    text, code = _output_of(
        _pytest("-v", "--maxfail=9", "-o", "faulthandler_timeout=30", "--no-header", path), _FILE_S
    )
    lines = re.findall(r"^\S+::.* (PASSED|FAILED|SKIPPED|ERROR)", text, re.M)
    row: dict[str, Any] = dict(Counter(line.lower() for line in lines))
    if code != 0:
        print(text, flush=True)
        row["failed"] = max(1, row.get("failed", 0))
        row["output"] = text[-3000:]
    return row


def _output_of(command: list[str], seconds: float) -> tuple[str, int]:
    """Run a command in the checkout and return its output and exit code.

    The exit code is 124 if the time limit was reached.
    """
    with tempfile.TemporaryFile("w+") as output:  # what is written before a time-out is kept
        try:
            code = subprocess.run(
                command, cwd=ROOT, stdout=output, stderr=subprocess.STDOUT, timeout=seconds
            ).returncode
        except subprocess.TimeoutExpired:
            code = 124
            print(f"\nended after {seconds} s", file=output, flush=True)
        output.seek(0)
        return output.read(), code


def _program(name: str) -> str:
    """Return the path of a CUDA tool, or raise ModuleNotFoundError if it is not installed."""
    homes = [os.environ.get(variable) for variable in ("CUDA_PATH", "CUDA_HOME")]
    folders = [f"{home}/bin" for home in (*homes, "/usr/local/cuda") if home]
    folders.insert(0, os.environ.get("PATH", ""))
    path = shutil.which(name, path=os.pathsep.join(folders))
    if path is None:
        raise ModuleNotFoundError(f"{name} is not installed", name=name)
    return path


def sanitizer(_session: Session) -> Rows:
    """Yield the errors that compute-sanitizer reports while small scenes are cast."""
    program = _program("compute-sanitizer")
    cast = ("-c", _WITHOUT_POOL, "--quick", "--in-process", "--only", "bits")
    for tool in ("memcheck", "racecheck"):
        command = [program, "--tool", tool, *_SANITIZER, sys.executable, *cast]
        text, code = _output_of(command, _TOOL_S)
        # memcheck: ERROR SUMMARY: 0 errors; racecheck: RACECHECK SUMMARY: 0 hazards displayed (…)
        summary = re.search(r"SUMMARY: (\d+) (?:error|hazard)", text)
        scenes = len(re.findall(r"^bits: ", text, re.M))
        row: dict[str, Any] = {"scenes": scenes, "exit code": code}
        if summary and tool == "racecheck":
            row |= _hazards(text, int(summary[1]))
        elif summary:
            row["errors"] = int(summary[1])
        elif "not supported" in text:
            row["left out"] = text.strip().splitlines()[-1]
        if row.get("errors") or ("left out" not in row and (not scenes or code not in (0, 124))):
            row["failed"] = 1
            row["output"] = text[-3000:]
        yield tool, row


def _hazards(text: str, count: int) -> dict[str, int]:
    """Divide the hazards reported by racecheck into those in CuPy's kernels and all others."""
    reports = re.findall(r"Race reported between .*?access at (\w+)\+0x", text)
    in_cupy = sum(name.startswith("cupy_") for name in reports)
    return {"errors": count - in_cupy, "hazards in kernels of CuPy": in_cupy}


def counters(session: Session) -> Rows:
    """Yield what ncu measures for one launch of each of two kernels."""
    program = _program("ncu")
    triangles = session.sizes.cities[0]
    cast = (
        f"from benchmarks.gpu_first import cast_once; cast_once({triangles}, {session.sizes.rays})"
    )
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder, "ncu.csv")
        options = ["--csv", "--page", "details", "--log-file", str(log), "--clock-control", "none"]
        options += [word for name in _NCU_SECTIONS for word in ("--section", name)]
        kernels = f"regex:^({'|'.join(PROFILED)})$"
        options += ["--kernel-name", kernels, "--launch-count", str(len(PROFILED))]
        text, code = _output_of([program, *options, sys.executable, "-c", cast], _TOOL_S)
        report = log.read_text() if log.exists() else ""
    rows: dict[str, dict[str, Any]] = dict(_profiles(report))
    if not rows:
        lines = [line for line in (report + text).splitlines() if line.strip()]
        reason = next((line for line in lines if "ERR" in line.upper()), f"ncu ended with {code}")
        rows = {"ncu": {"left out": reason}}
    yield from rows.items()


def _profiles(report: str) -> dict[str, dict[str, float]]:
    """Parse the table printed by ncu.

    Values are keyed by kernel, then by name and unit.
    """
    table = [line for line in report.splitlines() if line.startswith('"')]
    profiles: dict[str, dict[str, float]] = {}
    for line in csv.DictReader(table):
        if line["Metric Name"] in _FIGURES:
            kernel = line["Kernel Name"].partition("(")[0]
            unit = line["Metric Unit"].replace("/", " per ")
            name = ", ".join(filter(None, (line["Metric Name"], unit)))
            with suppress(ValueError):  # n/a
                value = float(line["Metric Value"].replace(",", ""))
                profiles.setdefault(kernel, {})[name] = value
    return profiles


def cast_once(triangles: int, rays: int) -> None:
    """Cast four revolutions in a city, for use with a profiler."""
    caster = RayCaster(*city(triangles), backend="cuda")
    directions = revolution(rays)
    window = (0, 4 * len(directions))
    positions = [MIDDLE] * 4
    scan = check_scan(Pattern(directions), positions, window=window, rays_per_pose=len(directions))
    caster.engine.scan(scan)

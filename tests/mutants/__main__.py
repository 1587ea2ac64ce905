"""Plant faults, run the tests that execute them, and list the faults that no test detects."""

import argparse
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from queue import Queue

from tests.mutants.faults import ROOTS, Fault, choose
from tests.mutants.forks import PASSED, PYTEST, Forks
from tests.mutants.lines import Lines

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "build" / "mutants"
_FIRST_S = 10.0  # estimated time of the tests that are tried first
_EXTRA_S = 120.0  # a fault that makes tests this much slower counts as noticed


@dataclass
class Outcome:
    """Result of testing one fault.

    Attributes
    ----------
    fault
        The fault.
    noticed
        "by" and the first test that failed, "hangs", "crashes", or "" if all tests passed.
    tests
        Number of the tests that were run.
    seconds
        Elapsed time.
    """

    fault: Fault
    noticed: str
    tests: int
    seconds: float

    def __str__(self) -> str:
        verdict = "noticed" if self.noticed else "PASSED " if self.tests else "NOT RUN"
        return f"{verdict} {self.fault} [{self.tests} tests, {self.seconds:.0f} s] {self.noticed}"


def main() -> None:
    """Run the program, and exit with 1 if a fault was not detected."""
    options = _parser().parse_args()
    FOLDER.mkdir(parents=True, exist_ok=True)
    record = FOLDER / "lines.json"
    if options.record is not None or not record.is_file():
        pytest_options = ["-m", "not slow", "-n", str(options.jobs), "--dist", "loadfile"]
        lines = Lines.record(ROOT, FOLDER, options.record or [], pytest_options)
    else:
        lines = Lines.read(record)
    if options.again:
        faults = [
            Fault.read(row["fault"])
            for row in json.loads(options.again.read_text())
            if not row["noticed"]
        ]
    else:
        faults = choose(ROOT, options.packages or ROOTS, options.count, options.seed)
    outcomes = []
    out = options.out or FOLDER / f"{options.seed}.json"
    with _places(options.jobs) as places, ThreadPoolExecutor(options.jobs) as pool:
        tasks = [pool.submit(_try, places, lines, fault, options.budget) for fault in faults]
        for task in as_completed(tasks):
            outcomes.append(task.result())
            print(outcomes[-1], flush=True)
            out.write_text(json.dumps([asdict(outcome) for outcome in outcomes], indent=1))
    _print_summary(outcomes)
    sys.exit(any(not outcome.noticed for outcome in outcomes))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser("python -m tests.mutants", description=__doc__)
    add = parser.add_argument
    add(
        "packages",
        nargs="*",
        help="Folders or files to plant faults in (default: all, except SKIPPED_MODULES).",
    )
    add(
        "--seed", type=int, default=int(time.time()), help="Seed of the choice (default: the time)."
    )
    add("--count", type=int, default=20, help="Number of faults (default: 20).")
    add("--jobs", type=int, default=2, help="Faults that are tried at the same time (default: 2).")
    add(
        "--budget",
        type=float,
        default=60.0,
        help="Estimated seconds of tests for a fault (default: 60).",
    )
    add(
        "--record",
        nargs="*",
        metavar="FILE",
        help="Record which lines these test files execute, or all of the tests (20 minutes).",
    )
    add(
        "--again",
        type=Path,
        help="Try the faults again that passed in an earlier run, a JSON file.",
    )
    add("--out", type=Path, help="Output file (default: build/mutants/SEED.json).")
    return parser


@dataclass
class Place:
    """Process with all packages imported, and copy of the project, for testing one fault."""

    forks: Forks
    copy: Path


@contextmanager
def _places(count: int) -> Iterator["Queue[Place]"]:
    """Yield a queue of places, one for each fault that is tested concurrently."""
    places: Queue[Place] = Queue()
    with tempfile.TemporaryDirectory(prefix="mutants-") as folder:
        for number in range(count):
            copy = Path(folder) / str(number) / "project"
            ignored = shutil.ignore_patterns(".venv", ".git", "lidarpool-out", "build", "*_cache")
            shutil.copytree(ROOT, copy, ignore=ignored, symlinks=True)
            places.put(Place(Forks(), copy))
        yield places
        for _ in range(count):
            places.get().forks.close()


def _try(places: "Queue[Place]", lines: Lines, fault: Fault, budget_s: float) -> Outcome:
    """Plant a fault, and run groups of tests that execute it until one detects the fault."""
    start = time.monotonic()
    tests = lines.tests_of(ROOT, fault)
    place = places.get()
    try:
        noticed, tried = _noticed(place, lines, fault, list(_groups(lines, tests, budget_s)))
        while noticed.startswith("by ") and not _passes(place, lines, noticed[3:]):
            print(f"skipped, because it fails without a fault: {noticed[3:]}", flush=True)
            tests = [test for test in tests if not noticed[3:].startswith(test)]
            noticed, tried = _noticed(place, lines, fault, list(_groups(lines, tests, budget_s)))
    finally:
        places.put(place)
    return Outcome(fault, noticed, tried, time.monotonic() - start)


def _noticed(place: Place, lines: Lines, fault: Fault, groups: list[list[str]]) -> tuple[str, int]:
    """Return `Outcome.noticed`, and the number of tests that were run."""
    tried = 0
    for group in [] if fault.compiled else groups:
        tried += len(group)
        limit_s = _limit_s(lines, group)
        noticed = place.forks.failure(fault, group, limit_s)
        if noticed == "hangs" and place.forks.failure(None, group, limit_s) == noticed:
            print(f"skipped, because they hang without a fault: {' '.join(group)}", flush=True)
        elif noticed:
            return noticed, tried
    tests = [test for group in groups for test in group]
    if not tests:
        return "", 0
    # It is compiled, or only seen by processes that tests start.
    return _failure(place.copy, fault, lines, tests), len(tests)


def _passes(place: Place, lines: Lines, test: str) -> bool:
    """Return whether a test passes without a fault."""
    return not place.forks.failure(None, [test], _limit_s(lines, [test]))


def _limit_s(lines: Lines, tests: list[str]) -> float:
    """Return the time limit in seconds after which tests count as hanging."""
    return 3 * sum(map(lines.cost, tests)) + _EXTRA_S


def _groups(lines: Lines, tests: list[str], budget_s: float) -> Iterator[list[str]]:
    """Yield groups of tests to run together.

    The first group contains quick tests. The other tests follow up to the budget.
    """
    group: list[str] = []
    spent = total = 0.0
    limit = _FIRST_S
    for test in tests:
        cost = lines.cost(test)
        if total + cost > budget_s:
            continue
        if group and spent + cost > limit:
            yield group
            group, spent, limit = [], 0.0, budget_s
        group.append(test)
        spent += cost
        total += cost
    if group:
        yield group


def _failure(copy: Path, fault: Fault, lines: Lines, tests: list[str]) -> str:
    """Plant a fault in a copy of the project, run tests, and return `Outcome.noticed`."""
    path = copy / fault.path
    path.write_text(fault.plant((ROOT / fault.path).read_text()))
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join(str(copy / root) for root in (*ROOTS, ".")),
        "PYTEST_TIMEOUT": str(int(_EXTRA_S)),
    }
    command = [sys.executable, "-m", "pytest", *PYTEST, *tests]
    with tempfile.TemporaryFile("w+") as output:
        process = subprocess.Popen(
            command, cwd=copy, env=environment, stdout=output, stderr=output, start_new_session=True
        )
        try:
            status = process.wait(_limit_s(lines, tests))
        except subprocess.TimeoutExpired:
            return "hangs"
        finally:
            with suppress(ProcessLookupError):  # processes that the tests started
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            shutil.copy2(ROOT / fault.path, path)
            _restore_loops(copy)
        output.seek(0)
        printed = output.read()
    if status in PASSED:
        return ""
    failed = re.search(r"^(FAILED|ERROR) (?=\S+\.py)(?P<test>.+?)( - .*)?$", printed, re.MULTILINE)
    if failed:
        return f"by {failed['test']}"
    if status < 0:
        return "crashes"
    raise RuntimeError(f"pytest ended with status {status}: {printed[-2000:]}")


def _restore_loops(copy: Path) -> None:
    """Restore the compiled loops in a copy that tests with a fault have replaced."""
    for root in ROOTS:
        for cached in (copy / root).rglob("__pycache__/*.nb[ic]"):
            kept = ROOT / cached.relative_to(copy)
            if not kept.is_file():
                cached.unlink()
            elif kept.stat().st_mtime != cached.stat().st_mtime:
                shutil.copy2(kept, cached)


def _print_summary(outcomes: list[Outcome]) -> None:
    """Print the number of detected faults by folder."""
    total: Counter[str] = Counter()
    noticed: Counter[str] = Counter()
    for outcome in outcomes:
        folder = "/".join(outcome.fault.path.split("/")[1:3]).removesuffix(".py")
        total[folder] += 1
        noticed[folder] += bool(outcome.noticed)
    for folder in sorted(total):
        print(f"{folder:40} {noticed[folder]:4} of {total[folder]:4}")
    print(f"{sum(noticed.values())} of {total.total()} faults were noticed")


if __name__ == "__main__":
    main()

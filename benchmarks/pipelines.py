"""Run a pipeline of two stages in plain Dask, poolpart and Ray Data.

    python -m benchmarks.pipelines [--ray-python PYTHON] [--repeat N]

Frames are decoded on two CPU workers and processed by a detector on a single worker, which takes
the place of a GPU and loads its model in 3 s. Both stages sleep. The throughput can reach 20 frames
per second. Each library runs in a cluster of its own, with one process per worker:

1. A user processes 100 frames.
2. While a user processes 160 frames, a second user, in another process, requests 8 frames.
3. The second user requests 8 frames again, when nobody else uses the cluster.
4. A user processes 100 frames. The process of a decoding worker is killed, and later that of the
   detector.

Memory is the proportional set size of all processes, so that shared memory counts once. Ray Data
is installed in an environment of its own:

    python3 -m venv build/ray && build/ray/bin/pip install "ray[data]==2.60.0"

Pass another interpreter with `--ray-python`. If it does not exist, Ray Data is skipped.
"""

from __future__ import annotations

import json
import os
import queue
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import psutil

from .harness import argument_parser, cpu_seconds, print_row, write_results
from .pipelines_work import LOG

ROOT = Path(__file__).resolve().parents[1]
ANSWER_S = 120.0  # maximum time between two results
SAMPLE_S = 0.2  # time between two measurements of memory

TITLES = {
    "dask_map": "Dask, `Client.map`",
    "dask": "Dask, 16 frames at a time",
    "poolpart": "poolpart",
    "poolpart_own": "poolpart, a model per map",
    "ray": "Ray Data, `num_gpus=1`",
    "ray_half": "Ray Data, `num_gpus=0.5`",
}
SECOND_USER_ONLY = {"poolpart_own", "ray_half"}


class Sizes(NamedTuple):
    """Numbers of frames."""

    batch: int = 100
    long_batch: int = 160
    request: int = 8


QUICK = Sizes(12, 16, 2)


class Child:
    """A process of the benchmark that prints lines."""

    def __init__(self, python: str, log: Path, *words: str) -> None:
        environment = os.environ | {
            LOG: str(log),
            "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]),
            "RAY_USAGE_STATS_ENABLED": "0",
            "RAY_AUTH_MODE": "disabled",
        }
        command = [python, "-m", "benchmarks.pipelines_processes", *words]
        self.process = subprocess.Popen(
            command,
            cwd=ROOT,
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )
        self._lines: queue.Queue[str] = queue.Queue()
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self._lines.put(line)
        self._lines.put("")

    def read(self) -> str:
        """Return the next line, or "" at the end of the output."""
        return self._lines.get(timeout=ANSWER_S).strip()

    def close(self) -> None:
        """End the process, and all of its children."""
        assert self.process.stdin is not None
        self.process.stdin.close()
        children = psutil.Process(self.process.pid).children(recursive=True)
        with suppress(subprocess.TimeoutExpired):
            self.process.wait(20)
        for child in [self.process, *children]:
            with suppress(psutil.NoSuchProcess, ProcessLookupError):
                child.kill()
        self.process.wait()


class User(Child):
    """A process that runs the pipeline when it is asked to."""

    def __init__(self, python: str, log: Path, program: str, address: str, name: str) -> None:
        super().__init__(python, log, "user", program, address, name)
        assert json.loads(self.read())["event"] == "connected"

    def begin(self, first: int, count: int) -> None:
        """Start to process frames."""
        assert self.process.stdin is not None
        self.process.stdin.write(f"{first} {count}\n")
        self.process.stdin.flush()
        self.started = time.time()

    def rows(self) -> Iterator[dict[str, Any]]:
        """Iterate over the results. The last one has the key `event`."""
        while True:
            row = json.loads(self.read())
            yield row
            if "event" in row:
                return

    def run(self, first: int, count: int) -> tuple[float, list[dict[str, Any]]]:
        """Process frames, and return the time and the results."""
        self.begin(first, count)
        rows = list(self.rows())
        return rows[-1]["time"] - self.started, rows


class Memory(threading.Thread):
    """Thread that records the peak memory of processes and their children, in bytes."""

    def __init__(self, *pids: int) -> None:
        super().__init__(daemon=True)
        self._pids = pids
        self._done = threading.Event()
        self.first = self.peak = self._measure()
        self.start()

    def _measure(self) -> int:
        total = 0
        for pid in self._pids:
            with suppress(psutil.NoSuchProcess):
                process = psutil.Process(pid)
                for one in (process, *process.children(recursive=True)):
                    with suppress(OSError):
                        lines = Path(f"/proc/{one.pid}/smaps_rollup").read_text().splitlines()
                        total += sum(int(s.split()[1]) for s in lines if s.startswith("Pss:"))
        return total * 1024

    def run(self) -> None:
        """Measure until the end."""
        while not self._done.wait(SAMPLE_S):
            self.peak = max(self.peak, self._measure())

    def stop(self) -> int:
        """Return the maximum."""
        self._done.set()
        self.join()
        return self.peak


def cpu_seconds_of_all(*pids: int) -> float:
    """Return the total CPU time of processes and their children."""
    processes = [psutil.Process(pid) for pid in pids]
    children = [child for process in processes for child in process.children(recursive=True)]
    return sum(map(cpu_seconds, processes + children))


@contextmanager
def cluster(python: str, program: str, log: Path) -> Iterator[tuple[str, int]]:
    """Start a cluster, and yield its address and its process ID."""
    child = Child(python, log, "cluster", "ray" if program.startswith("ray") else "dask")
    try:
        address = child.read()
        assert address, f"the cluster of {program} did not start"
        yield address, child.process.pid
    finally:
        child.close()


def actions(log: Path) -> Counter[str]:
    """Return how often frames were decoded and models were loaded."""
    return Counter(log.read_text().split())


def alone(user: User, pid: int, count: int) -> dict[str, float]:
    """Measure a user who is alone on a new cluster."""
    memory = Memory(pid, user.process.pid)
    before = cpu_seconds_of_all(pid, user.process.pid)
    seconds, rows = user.run(0, count)
    cpu_s = cpu_seconds_of_all(pid, user.process.pid) - before
    peak = memory.stop()
    times = [row["time"] for row in rows[:-1]]
    check(rows, range(count))
    return {
        "throughput": (count - 1) / (times[-1] - times[0]),
        "seconds": seconds,
        "cpu_ms": 1000 * cpu_s / count,
        "idle_mib": memory.first / 2**20,
        "peak_mib": peak / 2**20,
    }


def beside_batch(user: User, second: User, sizes: Sizes) -> dict[str, float]:
    """Measure the wait of a second user beside a batch and alone."""
    user.begin(10_000, sizes.long_batch)
    rows = user.rows()
    first_rows = [next(rows) for _ in range(sizes.long_batch // 8)]
    wait_s, answer = second.run(20_000, sizes.request)
    check(answer, range(20_000, 20_000 + sizes.request))
    all_rows = first_rows + list(rows)
    check(all_rows, range(10_000, 10_000 + sizes.long_batch))
    alone_s, answer = second.run(30_000, sizes.request)
    check(answer, range(30_000, 30_000 + sizes.request))
    return {"wait_s": wait_s, "alone_s": alone_s, "batch_s": all_rows[-1]["time"] - user.started}


def with_kills(user: User, log: Path, count: int) -> dict[str, float]:
    """Measure a batch during which two worker processes are killed."""
    before = actions(log)
    user.begin(40_000, count)
    rows: list[dict[str, Any]] = []
    for row in user.rows():
        rows.append(row)
        if len(rows) in (count // 4, count // 2) and "event" not in row:
            process = row["decoder"] if len(rows) == count // 4 else row["detector"]
            with suppress(ProcessLookupError):  # it may have ended
                os.kill(process, signal.SIGKILL)
    numbers = Counter(row["number"] for row in rows[:-1])
    counts = actions(log) - before
    return {
        "kill_s": rows[-1]["time"] - user.started,
        "kill_wrong": count - 2 * len(numbers) + numbers.total(),
        "kill_decoded": counts["decode"] - count,
        "kill_loads": counts["load"],
        "kill_error": float("error" in rows[-1]),
    }


def check(rows: list[dict[str, Any]], numbers: range) -> None:
    """Assert that the results of a run are complete and right."""
    assert "error" not in rows[-1], rows[-1]
    assert sorted(row["number"] for row in rows[:-1]) == list(numbers)
    assert all(row["right"] for row in rows[:-1])


def measure(python: str, program: str, folder: Path, sizes: Sizes) -> dict[str, float]:
    """Run all parts of the benchmark with one program."""
    log = folder / f"{program}.log"
    with ExitStack() as stack:
        address, pid = stack.enter_context(cluster(python, program, log))
        arguments = python, log, program, address
        user = User(*arguments, "batch")
        stack.callback(user.close)
        time.sleep(1)  # imports of the workers
        results = alone(user, pid, sizes.batch)
        second = User(*arguments, "second")
        stack.callback(second.close)
        results |= beside_batch(user, second, sizes)
        if program not in SECOND_USER_ONLY:
            results |= with_kills(user, log, sizes.batch)
    return results


def lines_of_code(program: str) -> int:
    """Return the number of lines of a program, without docstrings and empty lines."""
    name = program.removesuffix("_own").removesuffix("_half")
    text = Path(__file__).with_name(f"pipelines_{name}.py").read_text("utf-8")
    return sum(bool(line) and not line.strip().startswith('"""') for line in text.splitlines())


def summarize(rounds: dict[str, list[dict[str, float]]]) -> dict[str, dict[str, float]]:
    """Return the medians of all programs, with ratios between values of the same round."""
    for program, results in rounds.items():
        references = rounds.get("poolpart", results)
        for result, reference in zip(results, references, strict=True):
            result["relative_throughput"] = result["throughput"] / reference["throughput"]
            result["relative_s"] = result["seconds"] / reference["seconds"]
            result["relative_alone_s"] = result["alone_s"] / reference["alone_s"]
            result["wait_share"] = result["wait_s"] / result["batch_s"]
            if "kill_s" in result:
                result["relative_kill_s"] = result["kill_s"] / reference["kill_s"]
            result["lines"] = lines_of_code(program)
    return {
        program: {key: float(np.median([one[key] for one in results])) for key in results[0]}
        for program, results in rounds.items()
    }


def print_table(medians: dict[str, dict[str, float]], sizes: Sizes) -> None:
    """Print the medians as a Markdown table, with one column per program."""
    rows = [
        ("frames per second", "throughput", ".1f"),
        ("frames per second, relative to poolpart", "relative_throughput", ".2f"),
        (f"time of the first {sizes.batch} frames, relative to poolpart", "relative_s", ".2f"),
        ("CPU time of all processes per frame, ms", "cpu_ms", ".0f"),
        ("memory before the first frame, MiB", "idle_mib", ".0f"),
        ("peak memory, MiB", "peak_mib", ".0f"),
        ("wait of the second user beside the batch, s", "wait_s", ".1f"),
        ("the same, relative to the time of the batch", "wait_share", ".2f"),
        ("wait of the second user alone, relative to poolpart", "relative_alone_s", ".2f"),
        (
            f"time of {sizes.batch} frames with two kills, relative to poolpart",
            "relative_kill_s",
            ".2f",
        ),
        ("results lost or doubled after kills", "kill_wrong", ".0f"),
        ("frames decoded again after kills", "kill_decoded", ".0f"),
        ("models loaded in the run with kills", "kill_loads", ".0f"),
        ("lines of code", "lines", ".0f"),
    ]
    print_row("", *(TITLES[program] for program in medians))
    print_row("---", *("--:" for _ in medians))
    for title, key, form in rows:
        values = (result.get(key) for result in medians.values())
        print_row(title, *("" if value is None else format(value, form) for value in values))


def main(arguments: list[str] | None = None) -> dict[str, dict[str, float]]:
    """Measure all programs, then print and return the medians."""
    parser = argument_parser(__doc__, repeat=1, quick=True)
    parser.add_argument(
        "--ray-python",
        default=str(ROOT / "build/ray/bin/python"),
        metavar="PYTHON",
        help="interpreter of an environment with Ray Data (default: build/ray/bin/python)",
    )
    parser.add_argument(
        "--only", choices=TITLES, nargs="+", default=[*TITLES], help="programs (default: all)"
    )
    options = parser.parse_args(arguments)
    sizes = QUICK if options.quick else Sizes()
    pythons = {
        program: options.ray_python if program.startswith("ray") else sys.executable
        for program in options.only
    }
    if not Path(options.ray_python).exists():
        print(f"Skipping Ray Data: {options.ray_python} does not exist. Pass `--ray-python`.")
        pythons = {name: python for name, python in pythons.items() if name[:3] != "ray"}
    rounds: dict[str, list[dict[str, float]]] = {program: [] for program in pythons}
    for number in range(options.repeat):
        for program, python in pythons.items():
            with tempfile.TemporaryDirectory() as folder:
                result = measure(python, program, Path(folder), sizes)
            rounds[program].append(result)
            print(f"round {number + 1}: {program}: {result}", file=sys.stderr, flush=True)
    medians = summarize(rounds)
    print_table(medians, sizes)
    write_results(options.json, rounds)
    return medians


if __name__ == "__main__":
    main()

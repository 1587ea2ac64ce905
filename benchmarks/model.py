"""Model the throughput of clusters that were not available for measurements.

    python -m benchmarks.model --driver MS MS --scheduler MS MS --collectors MS MS --casting MS MS

A fixed number of tasks is in flight. The driver offers a task, the scheduler sends it, the next
free GPU worker casts its batches, a collector stores them, and the scheduler and the driver receive
the receipts. Each process does one thing at a time. The CPU times per task and per receipt were
measured by `benchmarks.scale`. `--read` compares the model with other results of that benchmark,
whose processes share `--cores` cores. `--picture` plots how busy the GPUs of one scheduler are.
"""

from __future__ import annotations

import heapq
from collections import Counter
from dataclasses import dataclass
from itertools import count, product
from pathlib import Path
from random import Random
from typing import Any

from lidarpool.run.pipeline.policies import batches_per_task, max_weight_in_flight

from .harness import argument_parser, read_results, write_results
from .scale import GPUS_EACH

GPUS = (10, 20, 50, 100, 200, 500, 1_000, 2_000, 5_000, 10_000)
HEARTBEATS = 0.07  # share of the scheduler's core; Dask has 200 a second at most
VARY = 0.1  # share by which the times of tasks differ, so that they do not end together
ROUNDS = 6  # of all tasks that are under way; the first does not count
STEPS = ("driver", "scheduler", "casting", "collectors", "scheduler", "driver")  # of a task
RECEIPT = 3  # the first of the steps that take longer with each receipt
SECONDS = (0.05, 0.2, 1.0)  # of casting a batch


@dataclass(frozen=True)
class Costs:
    """CPU time of each process for one step of a task, in seconds.

    The times have the form {name: (per task, per receipt of the task)}. The scheduler also spends
    `member` per GPU worker on each task, because Dask examines all of these workers.
    """

    per_step: dict[str, tuple[float, float]]
    member: float

    def step(self, number: int, gpus: int, batches: int) -> float:
        """Return the duration of a step of a task with `batches` batches, in seconds."""
        name = STEPS[number]
        task, receipt = self.per_step[name]
        task += gpus * self.member if name == "scheduler" else 0
        seconds = task / STEPS.count(name) + (batches * receipt if number >= RECEIPT - 1 else 0)
        return seconds / (1 - HEARTBEATS) if name == "scheduler" else seconds


def collectors_of(gpus: int) -> int:
    """Return the number of collectors that `benchmarks.scale` starts for `gpus` GPU workers."""
    return max(2, gpus // GPUS_EACH)


def batches_a_second(
    gpus: int, seconds: float, costs: Costs, cores: int | None = None, shards: int = 1
) -> float:
    """Return the number of batches per second that `shards` clusters cast in total.

    Each batch takes `seconds` to cast. All processes share `cores` cores. If it is None, each
    process has its own core.
    """
    clusters = _Clusters(gpus, seconds, costs, cores, shards)
    tasks_under_way = shards * max_weight_in_flight(gpus, collectors_of(gpus))
    number = count()
    finished_tasks = 0
    start = 0.0
    events = [(0.0, next(number), n % shards, 0) for n in range(tasks_under_way)]
    while finished_tasks < ROUNDS * tasks_under_way:
        ready_s, _, shard, step = heapq.heappop(events)
        stop_s = clusters.run_step(ready_s, shard, step)
        following = (step + 1) % len(STEPS)
        finished_tasks += not following
        if finished_tasks == tasks_under_way and not following:  # the first tasks start together
            start = stop_s
        heapq.heappush(events, (stop_s, next(number), shard, following))
    return clusters.batches * (finished_tasks - tasks_under_way) / (stop_s - start)


class _Clusters:
    """Processes of all shards, with the time at which each process becomes free."""

    def __init__(
        self, gpus: int, seconds: float, costs: Costs, cores: int | None, shards: int
    ) -> None:
        self.batches = batches_per_task([(seconds, 1)], gpus)
        self._casting_s = self.batches * seconds
        self._step_s = [costs.step(number, gpus, self.batches) for number in range(len(STEPS))]
        self._collectors = collectors_of(gpus)
        self._free: Counter[Any] = Counter()  # {process: when the process is free}
        self._cores = [0.0] * (cores or 0)  # when each core is free: a heap
        self._slots = [[0.0] * gpus for _ in range(shards)]  # when each slot is free: heaps
        self._vary = Random(1).uniform

    def run_step(self, ready_s: float, shard: int, step: int) -> float:
        """Run a task's step that becomes ready at the given time, and return its end in seconds."""
        process: Any = STEPS[step], shard
        time_s = ready_s
        if process[0] == "casting":
            time_s = max(time_s, heapq.heappop(self._slots[shard]))
        else:
            if process[0] == "collectors":
                collectors = product([process], range(self._collectors))
                process = min(collectors, key=self._free.__getitem__)
            time_s = max(time_s, self._free[process])
        if self._cores:
            time_s = max(time_s, heapq.heappop(self._cores))
            heapq.heappush(self._cores, time_s + self._step_s[step])
        time_s += self._step_s[step]
        if process[0] == "casting":
            time_s += self._casting_s * self._vary(1 - VARY, 1 + VARY)
            heapq.heappush(self._slots[shard], time_s)
        else:
            self._free[process] = time_s
        return time_s


def busy(gpus: int, seconds: float, costs: Costs) -> float:
    """Return the fraction of time in which the GPU workers cast."""
    return min(1.0, batches_a_second(gpus, seconds, costs) * seconds / gpus)


def limit(gpus: int, seconds: float, costs: Costs) -> str:
    """Return the name of the busiest process, which limits the throughput of the cluster."""
    batches = batches_per_task([(seconds, 1)], gpus)
    load: Counter[str] = Counter()
    for number, name in enumerate(STEPS):
        load[name] += costs.step(number, gpus, batches)
    load["collectors"] /= collectors_of(gpus)
    load["casting"] = batches * seconds / gpus
    return load.most_common(1)[0][0]


def schedulers(gpus: int, seconds: float, costs: Costs, min_busy: float = 0.9) -> int:
    """Return the number of clusters required to keep all GPUs busy for a given fraction of time."""
    shards = 1
    while busy(-(-gpus // shards), seconds, costs) < min_busy:
        shards += max(1, shards // 8)
    return shards


def draw(costs: Costs, read: dict[str, dict[str, float]], path: Path) -> None:
    """Plot the modeled GPU utilization of one scheduler, with measured runs as dots."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 4), layout="constrained")
    axes = figure.subplots()
    for seconds, color in zip(SECONDS, ("#e4752e", "#2a6fb0", "#3b8f5a"), strict=True):
        shares = [100 * busy(gpus, seconds, costs) for gpus in GPUS]
        axes.plot(GPUS, shares, color=color, label=f"batches of {seconds:g} s")
        runs = [run for run in read.values() if run["seconds"] == seconds and run["shards"] == 1]
        points = [run["gpus"] for run in runs], [100 * run["busy"] for run in runs]
        axes.plot(*points, "o", color=color)
    axes.plot([], [], "o", color="0.4", label="read")
    axes.set(xscale="log", xlabel="GPU workers of one scheduler", ylim=(0, 105))
    axes.set_ylabel("time that they cast, %")
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:,.0f}")
    axes.grid(visible=True, color="0.9")
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, loc="lower left")
    figure.savefig(path, dpi=120)


def main(arguments: list[str] | None = None) -> dict[str, Any]:
    """Print and return the rates, limits and numbers of shards of all cases."""
    parser = argument_parser(__doc__)
    for name in dict.fromkeys(STEPS):
        words = "its CPU time per task, and per receipt in the task"
        parser.add_argument(
            f"--{name}", type=float, nargs=2, required=True, metavar="MS", help=words
        )
    parser.add_argument(
        "--member", type=float, default=3.5, help="scheduler time per GPU worker in µs"
    )
    parser.add_argument(
        "--read", type=Path, nargs="*", default=[], help="JSON files written by `scale`"
    )
    parser.add_argument("--cores", type=int, help="cores of the machine that wrote these files")
    parser.add_argument(
        "--picture", type=Path, help="save a plot of the GPU utilization to this file"
    )
    options = parser.parse_args(arguments)
    per_step = {name: tuple(ms / 1e3 for ms in getattr(options, name)) for name in STEPS}
    costs = Costs(per_step, options.member / 1e6)
    rows = [row for file in options.read for row in read_results(file).items()]
    read = {name: row for name, row in rows if "busy" in row}
    for name, row in read.items():
        gpus = int(row["gpus"])
        shards = int(row["shards"])
        rate = batches_a_second(gpus, row["seconds"], costs, options.cores, shards)
        print(f"{name}: {row['a_second']:.0f} batches/s measured, {rate:.0f} modeled")
    results = {}
    for gpus, seconds in product((200, 1_000, 10_000), SECONDS):
        rate = batches_a_second(gpus, seconds, costs)
        by = limit(gpus, seconds, costs)
        shards = schedulers(gpus, seconds, costs)
        results[f"{gpus} GPUs, batches of {seconds:g} s"] = rate, by, shards
        print(f"{gpus:6,} GPUs, {seconds:3g} s: {rate:7.1f} batches/s, {by}; {shards} schedulers")
    if options.picture:
        draw(costs, read, options.picture)
    write_results(options.json, results)
    return results


if __name__ == "__main__":
    main()

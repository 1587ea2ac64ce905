"""A small model of a run, for clusters that nobody here has: `python -m benchmarks.model`.

Batches go round, as many as the driver has under way: it offers one, the scheduler sends it, the
next free GPU worker casts it, a collector stores it, scheduler and driver take the receipt. Each of
them does one thing at a time. What driver, scheduler and collectors take is read with
`benchmarks.scale`; `--read` compares the model with other runs of it, and `--picture` draws how
busy the GPUs of one scheduler are.
"""

from __future__ import annotations

import argparse
import heapq
import json
from collections import Counter
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from random import Random
from typing import Any

from benchmarks.scale import GPUS_EACH
from lidarpool.pipeline.policies import most_under_way

GPUS = (10, 20, 50, 100, 200, 500, 1_000, 2_000, 5_000, 10_000)
HEARTBEATS = 0.07  # share of the scheduler's core; Dask has 200 a second at most
VARY = 0.1  # share by which the times of tasks differ, so that they do not end together
ROUNDS = 6  # of all tasks that are under way; the first does not count
STEPS = ("driver", "scheduler", "cast", "collect", "scheduler", "driver")  # of a task
SECONDS = (0.2, 1.0, 4.0)  # of a casting task


@dataclass(frozen=True)
class Costs:
    """Seconds of each process for a task with one batch.

    Of the scheduler's, `member` comes with each GPU worker, for Dask looks at all of them.
    """

    driver: float
    scheduler: float
    collector: float
    member: float

    def at_scheduler(self, gpus: int) -> float:
        """Seconds of the scheduler for a task, in a cluster of so many GPU workers."""
        return (self.scheduler + gpus * self.member) / (1 - HEARTBEATS)


def collectors_of(gpus: int) -> range:
    """Give the collectors of so many GPU workers, as `benchmarks.scale` starts them."""
    return range(max(2, gpus // GPUS_EACH))


def tasks_a_second(gpus: int, seconds: float, costs: Costs) -> float:
    """Casting tasks of so many seconds that one scheduler's cluster does in a second."""
    takes = {"driver": costs.driver / 2, "scheduler": costs.at_scheduler(gpus) / 2}
    free: Counter[Any] = Counter()  # {process: when it is free}
    slots, vary = [0.0] * gpus, Random(1).uniform  # when each slot is free: a heap
    collectors, number, done = collectors_of(gpus), count(), 0
    most, begin = most_under_way(gpus, len(collectors)), 0.0
    events = [(0.0, next(number), 0) for _ in range(most)]
    while done < ROUNDS * most:
        now, _, step = heapq.heappop(events)
        if STEPS[step] == "cast":
            now = max(now, heapq.heappop(slots)) + seconds * vary(1 - VARY, 1 + VARY)
            heapq.heappush(slots, now)
        else:
            stores = STEPS[step] == "collect"
            process = min(collectors, key=free.__getitem__) if stores else STEPS[step]
            now = free[process] = max(free[process], now) + takes.get(process, costs.collector)
        following = (step + 1) % len(STEPS)
        done += not following
        if done == most and not following:  # the first tasks all came at a time
            begin = now
        heapq.heappush(events, (now, next(number), following))
    return (done - most) / (now - begin)


def busy(gpus: int, seconds: float, costs: Costs) -> float:
    """Share of the time that the GPU workers cast."""
    return min(1.0, tasks_a_second(gpus, seconds, costs) * seconds / gpus)


def limit(gpus: int, seconds: float, costs: Costs) -> str:
    """Name what is busiest: the process that the others wait for."""
    load = {
        "GPUs": gpus / seconds,
        "driver": 1 / costs.driver,
        "scheduler": 1 / costs.at_scheduler(gpus),
        "collectors": len(collectors_of(gpus)) / costs.collector,
    }
    return min(load, key=load.__getitem__)


def schedulers(gpus: int, seconds: float, costs: Costs, least: float = 0.9) -> int:
    """How many clusters, each with a scheduler and driver, keep all GPUs so busy."""
    shards = 1
    while busy(-(-gpus // shards), seconds, costs) < least:
        shards += max(1, shards // 8)
    return shards


def draw(costs: Costs, read: dict[str, dict[str, float]], path: Path) -> None:
    """Draw how busy the GPUs of one scheduler are, and what was read."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 4), layout="constrained")
    axes = figure.subplots()
    for seconds, colour in zip(SECONDS, ("#e4752e", "#2a6fb0", "#3b8f5a"), strict=True):
        shares = [100 * busy(gpus, seconds, costs) for gpus in GPUS]
        axes.plot(GPUS, shares, color=colour, label=f"tasks of {seconds:g} s")
        there = [run for run in read.values() if run["seconds"] == seconds]
        places = [run["gpus"] for run in there], [100 * run["busy"] for run in there]
        axes.plot(*places, "o", color=colour)
    axes.plot([], [], "o", color="0.4", label="read")
    axes.set(xscale="log", xlabel="GPU workers of one scheduler", ylim=(0, 105))
    axes.set_ylabel("time that they cast, %")
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:,.0f}")
    axes.grid(visible=True, color="0.9")
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, loc="lower left")
    figure.savefig(path, dpi=120)


def main(arguments: list[str] | None = None) -> dict[str, Any]:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    for name in ("driver", "scheduler", "collector"):
        parser.add_argument(f"--{name}", type=float, required=True, help="ms of it for a task")
    parser.add_argument(
        "--member", type=float, default=3.5, help="µs of the scheduler for a worker"
    )
    parser.add_argument("--read", type=Path, nargs="*", default=[], help="--json of the scale")
    parser.add_argument("--picture", type=Path, help="draw the busy share here")
    chosen = parser.parse_args(arguments)
    three = (chosen.driver / 1e3, chosen.scheduler / 1e3, chosen.collector / 1e3)
    costs = Costs(*three, chosen.member / 1e6)
    rows = [row for file in chosen.read for row in json.loads(file.read_text()).items()]
    read = {name: row for name, row in rows if "busy" in row}
    for name, row in read.items():
        share = busy(int(row["gpus"]), row["seconds"], costs)
        print(f"{name}: busy {row['busy']:.1%}, by the model {share:.1%}")
    figures = {}
    for gpus in (200, 1_000, 10_000):
        for seconds in SECONDS:
            rate = tasks_a_second(gpus, seconds, costs)
            by, shards = limit(gpus, seconds, costs), schedulers(gpus, seconds, costs)
            figures[f"{gpus} GPUs, tasks of {seconds:g} s"] = rate, by, shards
            print(f"{gpus:6,} GPUs, {seconds:3g} s: {rate:7.1f} tasks/s, {by}; {shards} schedulers")
    if chosen.picture:
        draw(costs, read, chosen.picture)
    return figures


if __name__ == "__main__":
    main()

"""Cost of `Partition.submit` beside Dask's own `submit`: `python -m benchmarks.submitting`.

Two equal clusters of worker processes, each with its scheduler in a process of its own. The same
tasks go to one cluster by `client.submit(resources=)`, and to the other by `Partition.submit`, in
blocks that alternate. Processor time is that of driver plus scheduler. With `--delay 2`, the
scheduler answers requests 2 s late, as a busy scheduler does; messages that nobody waits for are
not delayed.
"""

from __future__ import annotations

import argparse
import asyncio
import gc
import json
import pathlib
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import psutil
from distributed import Client, Future, LocalCluster, wait

from poolpart import Partition, Pool, n_workers

NAME = "A"
BLOCKS = 10  # of each half of a pair
WORKERS = 2
SLOTS = 2


class Cost(NamedTuple):
    """Processor time of driver and scheduler, and the time until all tasks were sent; seconds."""

    driver: float
    scheduler: float
    sending: float


class Side:
    """One of the two clusters, and how its tasks are submitted."""

    def __init__(self, pid: int, submit: Callable[[str], Future]) -> None:
        self._processes = psutil.Process(), psutil.Process(pid)
        self._submit = submit

    def run(self, tasks: int) -> Cost:
        """Submit tasks, and wait for their ends."""
        gc.collect()
        before = [_seconds_of(process) for process in self._processes]
        started = time.perf_counter()
        futures = [self._submit(str(number)) for number in range(tasks)]
        sending = time.perf_counter() - started
        wait(futures)
        driver, scheduler = (
            _seconds_of(process) - seconds
            for process, seconds in zip(self._processes, before, strict=True)
        )
        return Cost(driver, scheduler, sending)


def _seconds_of(process: psutil.Process) -> float:
    times = process.cpu_times()
    return float(times.user + times.system)


def serve(declared: bool) -> None:
    """Start a cluster, print the address of its scheduler, and stay until the input ends."""
    options: dict[str, Any] = {"resources": {NAME: SLOTS}} if declared else {}
    with LocalCluster(
        n_workers=WORKERS, threads_per_worker=SLOTS, dashboard_address="127.0.0.1:0", **options
    ) as cluster:
        print(cluster.scheduler_address, flush=True)
        sys.stdin.read()


@contextmanager
def cluster_of(kind: str) -> Iterator[tuple[Client, int]]:
    """Yield a client of a cluster in a process of its own, and the process of its scheduler."""
    command = [sys.executable, "-m", "benchmarks.submitting", "--serve", kind]
    server = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert server.stdin is not None and server.stdout is not None
    try:
        with Client(server.stdout.readline().strip()) as client:
            client.wait_for_workers(WORKERS)
            yield client, server.pid
    finally:
        server.stdin.close()
        server.wait()
        server.stdout.close()


def answer_late(delay_s: float, dask_scheduler: Any = None) -> None:
    """Have the scheduler answer the requests of `run_on_scheduler` late."""
    answer = dask_scheduler.handlers["run_function"]

    async def late(comm: Any, *args: Any, **kwargs: Any) -> Any:
        await asyncio.sleep(delay_s)
        reply = answer(comm, *args, **kwargs)
        return await reply if asyncio.iscoroutine(reply) else reply

    dask_scheduler.handlers["run_function"] = late


def measure(kind: str, tasks: int, pairs: int, delay_s: float) -> list[dict[str, Cost]]:
    """Return the costs of each pair, by way of submitting."""
    with cluster_of("declared") as (plain, plain_pid), cluster_of(kind) as (client, pid):
        part = Partition(NAME, client)
        if kind == "divided":
            rules = {NAME: n_workers(WORKERS, slots=SLOTS)}
            part = Pool.from_client(client).divide(rules)[NAME]
        part.submit(int).result()
        if delay_s:
            client.run_on_scheduler(answer_late, delay_s=delay_s)
        resources = {NAME: 1}
        sides = {
            "Client.submit": Side(
                plain_pid, lambda text: plain.submit(int, text, resources=resources, pure=False)
            ),
            "Partition.submit": Side(pid, lambda text: part.submit(int, text)),
        }
        for side in sides.values():  # both have done everything once
            side.run(100)
        return [_pair(sides, tasks) for _ in range(pairs)]


def _pair(sides: dict[str, Side], tasks: int) -> dict[str, Cost]:
    blocks: dict[str, list[Cost]] = {way: [] for way in sides}
    size = max(1, tasks // BLOCKS)
    for number in range(BLOCKS):
        for way in list(sides)[:: 1 if number % 2 else -1]:
            blocks[way].append(sides[way].run(size))
    return {way: Cost(*map(sum, zip(*costs, strict=True))) for way, costs in blocks.items()}


def main(arguments: list[str] | None = None) -> dict[str, float]:
    """Measure, print and return the medians of all pairs."""
    parser = argparse.ArgumentParser(prog="benchmarks.submitting", description=__doc__)
    parser.add_argument("--tasks", type=int, default=10_000)
    parser.add_argument("--pairs", type=int, default=9)
    parser.add_argument("--delay", type=float, default=0.0, help="of the scheduler, seconds")
    parser.add_argument("--kind", choices=["declared", "divided"], default="divided")
    parser.add_argument("--json", help="file for the figures")
    parser.add_argument("--serve", choices=["declared", "divided"], help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.serve:
        serve(options.serve == "declared")
        return {}
    pairs = measure(options.kind, options.tasks, options.pairs, options.delay)
    figures: dict[str, float] = {}
    for way in pairs[0]:
        costs = [pair[way] for pair in pairs]
        for name in Cost._fields:
            seconds = statistics.median(getattr(cost, name) for cost in costs)
            figures[f"{way} {name}"] = 1e6 * seconds / options.tasks
    sums = [{way: cost.driver + cost.scheduler for way, cost in pair.items()} for pair in pairs]
    ratios = [total["Partition.submit"] / total["Client.submit"] for total in sums]
    figures["ratio"] = statistics.median(ratios)
    for name, figure in figures.items():
        print(f"{name}: {figure:.3f}" if name == "ratio" else f"{name}: {figure:.0f} µs a task")
    print("ratios of the pairs:", " ".join(f"{ratio:.3f}" for ratio in sorted(ratios)))
    if options.json:
        with pathlib.Path(options.json).open("w", encoding="utf-8") as file:
            json.dump(figures, file, indent=1)
    return figures


if __name__ == "__main__":
    main()

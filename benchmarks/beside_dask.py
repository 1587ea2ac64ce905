"""Compare the cost of poolpart with that of plain Dask.

    python -m benchmarks.beside_dask

Each row does the same work on two equal clusters in turn. One uses a Dask resource, and the other
is divided by poolpart. The schedulers are separate processes.

- `submit`: `Partition.submit` and `Client.submit(resources=)`;
- `map`: `Partition.map(chunk=1)`, and `Client.map(resources=)` with `gather`. `map_items` is the
  same without `chunk`, so that several items share a task;
- `busy_map`: 300 tasks that sleep 50 ms, on two slots, while other processes keep all cores busy.
  In `busy_map_slow`, the client sleeps 20 ms after each result. `quiet_map` and `quiet_map_slow`
  are the same without the other processes;
- `pipe`: round trips of an item through a task, with two `Pipe`s or two `Queue`s;
- `wide_submit` and `wide_map`: 20,000 tasks on 200 workers, which are threads of one process.

CPU time is the sum for driver and scheduler. Each row's ratio is our cost divided by Dask's, as the
median over all pairs of measurements. To compare with another version of poolpart, put its folder
first on `PYTHONPATH`.
"""

from __future__ import annotations

import gc
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np
import psutil
from distributed import Client, Queue, wait

from poolpart import Partition, Pipe, Pool, n_workers

from .harness import (
    argument_parser,
    cpu_seconds,
    median_ratio,
    run_rounds,
    time_call,
    write_results,
)
from .many_workers import process, run_scheduler, run_workers
from .submitting import NAME, SLOTS, WORKERS, cluster_of

RESOURCES = {NAME: 1}


class Cost(NamedTuple):
    """CPU time of the driver and the scheduler, and elapsed time, in seconds."""

    cpu: float
    wall: float


class Clusters(NamedTuple):
    """Two equal clusters: one with plain Dask, and one that is divided by poolpart."""

    plain: Client
    plain_scheduler: psutil.Process
    partition: Partition
    scheduler: psutil.Process


class Work(NamedTuple):
    """The same work for poolpart and for Dask.

    Each function takes the number of items.
    """

    ours: Callable[[int], object]
    theirs: Callable[[int], object]


@contextmanager
def small_clusters() -> Iterator[Clusters]:
    """Yield two clusters, each with two worker processes."""
    with cluster_of("declared") as (plain, plain_pid), cluster_of("divided") as (client, pid):
        rules = {NAME: n_workers(WORKERS, slots=SLOTS)}
        partition = Pool.from_client(client).divide(rules)[NAME]
        yield Clusters(plain, psutil.Process(plain_pid), partition, psutil.Process(pid))


@contextmanager
def wide_clusters(workers: int) -> Iterator[Clusters]:
    """Yield two clusters, each with many workers in a single process."""
    with (
        process(run_scheduler) as (plain_scheduler, plain_address),
        process(run_workers, plain_address, workers, (NAME, 1)),
        process(run_scheduler) as (scheduler, address),
        process(run_workers, address, workers),
        Client(plain_address) as plain,
        Client(address) as client,
    ):
        partition = Pool.from_client(client).divide({NAME: n_workers(workers)})[NAME]
        yield Clusters(plain, plain_scheduler, partition, scheduler)


def submit_work(clusters: Clusters) -> Work:
    def ours(count: int) -> None:
        wait([clusters.partition.submit(int, str(number)) for number in range(count)])

    def theirs(count: int) -> None:
        submit = clusters.plain.submit
        wait([submit(int, str(n), resources=RESOURCES, pure=False) for n in range(count)])

    return Work(ours, theirs)


def map_work(clusters: Clusters, chunk: int | None) -> Work:
    def ours(count: int) -> list[int]:
        return list(clusters.partition.map(int, map(str, range(count)), chunk=chunk))

    def theirs(count: int) -> list[int]:
        items = [str(number) for number in range(count)]
        futures = clusters.plain.map(int, items, resources=RESOURCES, pure=False)
        return list(clusters.plain.gather(futures))

    return Work(ours, theirs)


def sleep_briefly(_: int) -> None:
    """Run a short task that uses no CPU time."""
    time.sleep(0.05)


def short_map_work(clusters: Clusters, client_sleeps_s: float) -> Work:
    """Return work that maps short tasks.

    Each task uses both slots of a worker, so two tasks run at a time.
    """

    def read(results: Iterable[Any]) -> None:
        for _ in results:
            time.sleep(client_sleeps_s)

    def ours(count: int) -> None:
        read(clusters.partition.map(sleep_briefly, range(count), slots=SLOTS))

    def theirs(count: int) -> None:
        both = {NAME: SLOTS}
        futures = clusters.plain.map(sleep_briefly, range(count), resources=both, pure=False)
        read(future.result() for future in futures)

    return Work(ours, theirs)


@contextmanager
def busy_cores(count: int) -> Iterator[None]:
    """Keep `count` cores busy while the body runs."""
    command = [sys.executable, "-c", "while True: pass"]
    processes = [subprocess.Popen(command) for _ in range(count)]
    try:
        yield
    finally:
        for burning in processes:
            burning.kill()
            burning.wait()


def echo(incoming: Any, outgoing: Any, count: int) -> None:
    """Copy items from one pipe to another."""
    for _ in range(count):
        outgoing.put(incoming.get())


def pipe_work(clusters: Clusters) -> Work:
    def round_trips(count: int, there: Any, back: Any) -> None:
        for number in range(count):
            there.put(number)
            assert back.get() == number

    def ours(count: int) -> None:
        client = clusters.partition.client
        with Pipe("there", 1, client) as there, Pipe("back", 1, client) as back:
            task = clusters.partition.submit(echo, there, back, count)
            round_trips(count, there, back)
            task.result()

    def theirs(count: int) -> None:
        there, back = (Queue(name, clusters.plain, maxsize=1) for name in ("there", "back"))
        task = clusters.plain.submit(echo, there, back, count, resources=RESOURCES, pure=False)
        round_trips(count, there, back)
        task.result()
        there.close()
        back.close()

    return Work(ours, theirs)


def cost_of(work: Callable[[int], object], count: int, scheduler: psutil.Process) -> Cost:
    """Measure the CPU time and the elapsed time of the work."""
    gc.collect()
    processes = psutil.Process(), scheduler
    before = sum(map(cpu_seconds, processes))
    wall, _ = time_call(lambda: work(count), "wall")
    return Cost(sum(map(cpu_seconds, processes)) - before, wall)


def compare(work: Work, clusters: Clusters, count: int, pairs: int) -> dict[str, float]:
    """Return the median costs per item in microseconds, and their median ratios."""
    work.ours(min(count, 50))  # both have done everything once
    work.theirs(min(count, 50))
    calls = {
        "ours": lambda _: cost_of(work.ours, count, clusters.scheduler),
        "theirs": lambda _: cost_of(work.theirs, count, clusters.plain_scheduler),
    }
    costs = run_rounds(calls, pairs, warm_up=0)
    results: dict[str, float] = {}
    for index, field in enumerate(Cost._fields):
        ours_s, theirs_s = ([cost[index] for cost in costs[side]] for side in calls)
        results[f"{field}_us"] = 1e6 * float(np.median(ours_s)) / count
        results[f"{field}_us_dask"] = 1e6 * float(np.median(theirs_s)) / count
        results[f"{field}_ratio"] = median_ratio(ours_s, theirs_s)
    return results


def main(arguments: list[str] | None = None) -> dict[str, dict[str, float]]:
    """Measure all rows, print them, and return the results."""
    parser = argument_parser(__doc__, repeat=9, quick=True)
    parser.add_argument("--tasks", type=int, default=4_000, help="tasks of `submit` and `map`")
    parser.add_argument("--trips", type=int, default=1_000, help="round trips of an item")
    parser.add_argument("--short-tasks", type=int, default=300, help="tasks of 50 ms")
    parser.add_argument("--short-repeat", type=int, default=5, help="rounds of the short tasks")
    parser.add_argument(
        "--busy", type=int, default=os.cpu_count(), help="processes that keep cores busy"
    )
    parser.add_argument("--workers", type=int, default=200, help="workers of the wide clusters")
    parser.add_argument("--wide-tasks", type=int, default=20_000)
    parser.add_argument("--wide-repeat", type=int, default=3)
    options = parser.parse_args(arguments)
    if options.quick:
        options.repeat = options.wide_repeat = options.short_repeat = options.busy = 1
        options.tasks = options.wide_tasks = 100
        options.short_tasks = 10
        options.trips = 20
        options.workers = 4
    rows: dict[str, dict[str, float]] = {}

    def row(name: str, work: Work, clusters: Clusters, count: int, pairs: int) -> None:
        rows[name] = values = compare(work, clusters, count, pairs)
        print(
            f"{name:<14} CPU {values['cpu_us']:7.0f} µs, Dask "
            f"{values['cpu_us_dask']:7.0f} ({values['cpu_ratio']:.3f}); elapsed "
            f"{values['wall_us']:7.0f} µs, Dask {values['wall_us_dask']:7.0f} "
            f"({values['wall_ratio']:.3f})",
            flush=True,
        )

    with small_clusters() as clusters:
        row("submit", submit_work(clusters), clusters, options.tasks, options.repeat)
        row("map", map_work(clusters, 1), clusters, options.tasks, options.repeat)
        row("map_items", map_work(clusters, None), clusters, options.tasks, options.repeat)
        row("pipe", pipe_work(clusters), clusters, options.trips, options.repeat)
        for load, busy in ("quiet", 0), ("busy", options.busy):
            for name, client_sleeps_s in (f"{load}_map", 0.0), (f"{load}_map_slow", 0.02):
                work = short_map_work(clusters, client_sleeps_s)
                with busy_cores(busy):
                    row(name, work, clusters, options.short_tasks, options.short_repeat)
    with wide_clusters(options.workers) as clusters:
        row("wide_submit", submit_work(clusters), clusters, options.wide_tasks, options.wide_repeat)
        row("wide_map", map_work(clusters, 1), clusters, options.wide_tasks, options.wide_repeat)
    write_results(options.json, rows)
    return rows


if __name__ == "__main__":
    main()

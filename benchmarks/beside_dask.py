"""Cost of poolpart beside plain Dask, in pairs: `python -m benchmarks.beside_dask`.

Each row does the same work on two equal clusters, one with a resource of Dask and one divided by
poolpart, in turn. The schedulers are processes of their own.

- `submit`: `Partition.submit` beside `Client.submit(resources=)`;
- `map`: `Partition.map(chunk=1)` beside `Client.map(resources=)` and `gather`; `map_items` the
  same without `chunk`, so that several items share a task;
- `busy_map`: 300 tasks that sleep 50 ms, on two slots, while other processes keep all cores busy;
  `busy_map_slow` the same for a client that sleeps 20 ms after each result, and `quiet_map` and
  `quiet_map_slow` without the other processes;
- `pipe`: round trips of an item through a task, by two `Pipe`s beside two `Queue`s;
- `wide_submit` and `wide_map`: 20,000 tasks over 200 workers, which are threads of one process.

Processor time is that of driver and scheduler. The ratio of a row is the median of its pairs, ours
to Dask's. `--quick` takes small sizes: it shows that all runs, and its ratios mean nothing.

To compare with another version of poolpart, put its folder first on `PYTHONPATH`.
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import psutil
from distributed import Client, Queue, wait

from benchmarks.many_workers import process, run_scheduler, run_workers
from benchmarks.submitting import NAME, SLOTS, WORKERS, cluster_of
from poolpart import Partition, Pipe, Pool, n_workers

RESOURCES = {NAME: 1}


class Cost(NamedTuple):
    """Processor time of driver and scheduler, and elapsed time; seconds."""

    processor: float
    wall: float


class Clusters(NamedTuple):
    """Two equal clusters: of plain Dask, and divided."""

    plain: Client
    plain_scheduler: psutil.Process
    partition: Partition
    scheduler: psutil.Process


class Work(NamedTuple):
    """The same work done by poolpart and by Dask; each function takes the number of items."""

    ours: Callable[[int], object]
    theirs: Callable[[int], object]


@contextmanager
def small_clusters() -> Iterator[Clusters]:
    """Yield two clusters of two worker processes."""
    with cluster_of("declared") as (plain, plain_pid), cluster_of("divided") as (client, pid):
        rules = {NAME: n_workers(WORKERS, slots=SLOTS)}
        partition = Pool.from_client(client).divide(rules)[NAME]
        yield Clusters(plain, psutil.Process(plain_pid), partition, psutil.Process(pid))


@contextmanager
def wide_clusters(workers: int) -> Iterator[Clusters]:
    """Yield two clusters of many workers in one process each."""
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
    """Do a short task, which takes no processor time."""
    time.sleep(0.05)


def short_map_work(clusters: Clusters, client_sleeps_s: float) -> Work:
    """Return a map of short tasks, each on both slots of a worker, so that two run at a time."""

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
    """Keep a number of cores busy."""
    command = [sys.executable, "-c", "while True: pass"]
    processes = [subprocess.Popen(command) for _ in range(count)]
    try:
        yield
    finally:
        for burning in processes:
            burning.kill()
            burning.wait()


def echo(incoming: Any, outgoing: Any, count: int) -> None:
    """Pass items on, in a task."""
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
    """Return what some work costs."""
    gc.collect()
    processes = psutil.Process(), scheduler
    before = sum(map(_seconds_of, processes))
    started = time.perf_counter()
    work(count)
    wall = time.perf_counter() - started
    return Cost(sum(map(_seconds_of, processes)) - before, wall)


def _seconds_of(of_process: psutil.Process) -> float:
    times = of_process.cpu_times()
    return float(times.user + times.system)


def compare(work: Work, clusters: Clusters, count: int, pairs: int) -> dict[str, float]:
    """Return the median costs of each side in microseconds per item, and the median ratios."""
    work.ours(min(count, 50))  # both have done everything once
    work.theirs(min(count, 50))
    ours: list[Cost] = []
    theirs: list[Cost] = []
    for number in range(pairs):
        sides = [
            (ours, work.ours, clusters.scheduler),
            (theirs, work.theirs, clusters.plain_scheduler),
        ]
        for costs, function, scheduler in sides[:: 1 if number % 2 else -1]:
            costs.append(cost_of(function, count, scheduler))
    figures: dict[str, float] = {}
    for field in Cost._fields:
        ours_s, theirs_s = ([getattr(cost, field) for cost in costs] for costs in (ours, theirs))
        figures[f"{field}_us"] = 1e6 * statistics.median(ours_s) / count
        figures[f"{field}_us_dask"] = 1e6 * statistics.median(theirs_s) / count
        ratios = [mine / max(1e-9, dask) for mine, dask in zip(ours_s, theirs_s, strict=True)]
        figures[f"{field}_ratio"] = statistics.median(ratios)
    return figures


def main(arguments: list[str] | None = None) -> dict[str, dict[str, float]]:
    """Measure, print and return the figures of each row."""
    parser = argparse.ArgumentParser(prog="benchmarks.beside_dask", description=__doc__)
    parser.add_argument("--pairs", type=int, default=9)
    parser.add_argument("--tasks", type=int, default=4_000, help="of submit and map, in each half")
    parser.add_argument("--trips", type=int, default=1_000, help="round trips of an item")
    parser.add_argument("--short-tasks", type=int, default=300, help="of 50 ms, in each half")
    parser.add_argument("--short-pairs", type=int, default=5)
    parser.add_argument("--busy", type=int, default=os.cpu_count(), help="processes beside them")
    parser.add_argument("--workers", type=int, default=200, help="of the wide clusters")
    parser.add_argument("--wide-tasks", type=int, default=20_000)
    parser.add_argument("--wide-pairs", type=int, default=3)
    parser.add_argument("--quick", action="store_true", help="sizes that show that all runs")
    parser.add_argument("--json", type=Path, help="file for the figures")
    options = parser.parse_args(arguments)
    if options.quick:
        options.pairs = options.wide_pairs = 1
        options.tasks = options.wide_tasks = 100
        options.short_pairs = options.busy = 1
        options.short_tasks = 10
        options.trips = 20
        options.workers = 4
    rows: dict[str, dict[str, float]] = {}

    def row(name: str, work: Work, clusters: Clusters, count: int, pairs: int) -> None:
        rows[name] = figures = compare(work, clusters, count, pairs)
        print(
            f"{name:<14} processor {figures['processor_us']:7.0f} µs, beside Dask "
            f"{figures['processor_us_dask']:7.0f} ({figures['processor_ratio']:.3f}); elapsed "
            f"{figures['wall_us']:7.0f} µs, beside {figures['wall_us_dask']:7.0f} "
            f"({figures['wall_ratio']:.3f})",
            flush=True,
        )

    with small_clusters() as clusters:
        row("submit", submit_work(clusters), clusters, options.tasks, options.pairs)
        row("map", map_work(clusters, 1), clusters, options.tasks, options.pairs)
        row("map_items", map_work(clusters, None), clusters, options.tasks, options.pairs)
        row("pipe", pipe_work(clusters), clusters, options.trips, options.pairs)
        for load, busy in ("quiet", 0), ("busy", options.busy):
            for name, client_sleeps_s in (f"{load}_map", 0.0), (f"{load}_map_slow", 0.02):
                work = short_map_work(clusters, client_sleeps_s)
                with busy_cores(busy):
                    row(name, work, clusters, options.short_tasks, options.short_pairs)
    with wide_clusters(options.workers) as clusters:
        row("wide_submit", submit_work(clusters), clusters, options.wide_tasks, options.wide_pairs)
        row("wide_map", map_work(clusters, 1), clusters, options.wide_tasks, options.wide_pairs)
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    return rows


if __name__ == "__main__":
    main()

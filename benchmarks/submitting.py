"""Compare the CPU time of `Partition.submit` with that of `Client.submit`.

    python -m benchmarks.submitting [--tasks N] [--delay SECONDS] [--kind KIND]

Two equal clusters of worker processes have their schedulers in separate processes. The same tasks
are sent to one cluster by `client.submit(resources=)` and to the other by `Partition.submit`, in
alternating blocks. CPU time is the sum for driver and scheduler. With `--delay 2`, the scheduler
responds to requests 2 s late, like a busy scheduler. Messages that require no response are not
delayed.
"""

from __future__ import annotations

import argparse
import asyncio
import gc
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np
import psutil
from distributed import Client, Future, LocalCluster, wait

from lidarsim.numerics.arrays import Floats
from poolpart import Partition, Pool, n_workers

from .harness import argument_parser, cpu_seconds, run_rounds, write_results

NAME = "A"
BLOCKS = 10  # alternating blocks of a pair
WORKERS = 2
SLOTS = 2


class Cost(NamedTuple):
    """CPU time of the driver and the scheduler, and the time to send all tasks, in seconds."""

    driver: float
    scheduler: float
    sending: float


class Side:
    """One of the two clusters, with its function to submit a task."""

    def __init__(self, pid: int, submit: Callable[[str], Future]) -> None:
        self._processes = psutil.Process(), psutil.Process(pid)
        self._submit = submit

    def run(self, tasks: int) -> Cost:
        """Submit tasks and wait until they are done."""
        gc.collect()
        before = [cpu_seconds(process) for process in self._processes]
        started = time.perf_counter()
        futures = [self._submit(str(number)) for number in range(tasks)]
        sending = time.perf_counter() - started
        wait(futures)
        driver, scheduler = (
            cpu_seconds(process) - seconds
            for process, seconds in zip(self._processes, before, strict=True)
        )
        return Cost(driver, scheduler, sending)


def serve(declared: bool) -> None:
    """Start a cluster, print its scheduler address, and wait until standard input ends."""
    options: dict[str, Any] = {"resources": {NAME: SLOTS}} if declared else {}
    with LocalCluster(
        n_workers=WORKERS, threads_per_worker=SLOTS, dashboard_address="127.0.0.1:0", **options
    ) as cluster:
        print(cluster.scheduler_address, flush=True)
        sys.stdin.read()


@contextmanager
def cluster_of(kind: str) -> Iterator[tuple[Client, int]]:
    """Start a cluster in another process, and yield a client and the scheduler's process ID."""
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
    """Delay the scheduler's answers to requests of `run_on_scheduler`."""
    answer = dask_scheduler.handlers["run_function"]

    async def late(comm: Any, *args: Any, **kwargs: Any) -> Any:
        await asyncio.sleep(delay_s)
        reply = answer(comm, *args, **kwargs)
        return await reply if asyncio.iscoroutine(reply) else reply

    dask_scheduler.handlers["run_function"] = late


def measure(kind: str, tasks: int, pairs: int, delay_s: float) -> dict[str, Floats]:
    """Return the costs of both ways to submit tasks, as arrays (fields, pairs)."""
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
        calls = {way: lambda _, side=side: side.run(tasks // BLOCKS) for way, side in sides.items()}
        blocks = run_rounds(calls, pairs * BLOCKS, warm_up=0)
    return {
        way: np.reshape(costs, (pairs, BLOCKS, -1)).sum(axis=1).T for way, costs in blocks.items()
    }


def main(arguments: list[str] | None = None) -> dict[str, float]:
    """Measure all pairs, then print and return the medians."""
    parser = argument_parser(__doc__, repeat=9)
    parser.add_argument("--tasks", type=int, default=10_000)
    parser.add_argument(
        "--delay", type=float, default=0.0, help="response delay of the scheduler in seconds"
    )
    parser.add_argument("--kind", choices=["declared", "divided"], default="divided")
    parser.add_argument("--serve", choices=["declared", "divided"], help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.serve:
        serve(options.serve == "declared")
        return {}
    costs = measure(options.kind, options.tasks, options.repeat, options.delay)
    results = {
        f"{way} {name}": 1e6 * float(np.median(seconds)) / options.tasks
        for way, rows in costs.items()
        for name, seconds in zip(Cost._fields, rows, strict=True)
    }
    for name, value in results.items():
        print(f"{name}: {value:.0f} µs per task")
    totals = {way: rows[:2].sum(axis=0) for way, rows in costs.items()}  # driver and scheduler
    ratios = totals["Partition.submit"] / totals["Client.submit"]
    results["ratio"] = float(np.median(ratios))
    words = " ".join(f"{ratio:.3f}" for ratio in sorted(ratios))
    print(f"median ratio: {results['ratio']:.3f}; ratios of all pairs: {words}")
    write_results(options.json, results)
    return results


if __name__ == "__main__":
    main()

"""Measure the cost of fair shares for the scheduler, and the wait of a second client.

    python -m benchmarks.shares [--tasks N]

A cluster of worker processes has its scheduler in a separate process. The same tasks are submitted
to a partition with `Client.map`, alternately with shares and without them, in which case Dask
assigns the tasks to workers as soon as they arrive. The benchmark lists the CPU time of the
scheduler and the elapsed time per task. Then a client submits 10 tasks while 400 tasks of 50 ms of
another client are waiting.
"""

from __future__ import annotations

import time
from typing import Any, NamedTuple

import numpy as np
import psutil
from distributed import Client, wait

from lidarsim.numerics.arrays import Floats
from poolpart import Partition, Pool, n_workers
from poolpart.shares import NAME as SHARES

from .harness import argument_parser, cpu_seconds, run_rounds, write_results
from .submitting import NAME, SLOTS, WORKERS, cluster_of

BLOCKS = 10  # alternating blocks of a pair


class Cost(NamedTuple):
    """CPU time of the scheduler, and elapsed time, in seconds."""

    scheduler: float
    elapsed: float


def set_shares(enabled: bool, dask_scheduler: Any = None) -> None:
    """Enable or disable shares in the partition. Runs on the scheduler."""
    shares = dask_scheduler.plugins[SHARES]
    if enabled and NAME not in shares.queues:
        shares.add_partition(NAME)
    if not enabled and NAME in shares.queues:
        shares.set_weight("keeps the plugin", 2)
        shares.remove_partition(NAME)


def run_block(client: Client, pid: int, tasks: int, enabled: bool) -> Cost:
    """Run short tasks with or without shares."""
    client.run_on_scheduler(set_shares, enabled=enabled)
    process = psutil.Process(pid)
    before = cpu_seconds(process)
    started = time.perf_counter()
    futures = client.map(int, range(tasks), pure=False, resources={NAME: 1})
    wait(futures)
    elapsed = time.perf_counter() - started
    cost = Cost(cpu_seconds(process) - before, elapsed)
    del futures
    return cost


def second_client_s(client: Client, enabled: bool) -> float:
    """Return how long a second client waits for 10 tasks behind 400 tasks of the first one."""
    client.run_on_scheduler(set_shares, enabled=enabled)
    futures = client.map(time.sleep, [0.05] * 400, pure=False, resources={NAME: 1})
    time.sleep(0.5)  # Dask gives graphs that arrive within 0.1 s the same rank
    with Client(client.scheduler.address) as other:
        started = time.perf_counter()
        wait([Partition(NAME, other).submit(time.sleep, 0.05) for _ in range(10)])
        seconds = time.perf_counter() - started
    client.cancel(futures)
    return seconds


def measure(tasks: int, pairs: int) -> tuple[dict[str, Floats], dict[str, float]]:
    """Return the costs, as arrays (fields, pairs), and the waits of the second client."""
    with cluster_of("divided") as (client, pid):
        rules = {NAME: n_workers(WORKERS, slots=SLOTS)}
        part = Pool.from_client(client).divide(rules)[NAME]
        part.submit(int).result()
        ways = {"without": False, "with": True}
        calls = {
            way: lambda _, enabled=enabled: run_block(client, pid, tasks // BLOCKS, enabled)
            for way, enabled in ways.items()
        }
        blocks = run_rounds(calls, pairs * BLOCKS, warm_up=1)
        waits = {way: second_client_s(client, enabled) for way, enabled in ways.items()}
    costs = {
        way: np.reshape(costs, (pairs, BLOCKS, -1)).sum(axis=1).T for way, costs in blocks.items()
    }
    return costs, waits


def main(arguments: list[str] | None = None) -> dict[str, float]:
    """Measure all pairs, then print and return the medians."""
    parser = argument_parser(__doc__, repeat=5)
    parser.add_argument("--tasks", type=int, default=20_000)
    options = parser.parse_args(arguments)
    costs, waits = measure(options.tasks, options.repeat)
    results = {f"wait {way}": seconds for way, seconds in waits.items()}
    for number, field in enumerate(Cost._fields):
        for way, rows in costs.items():
            results[f"{field} {way}"] = 1e6 * float(np.median(rows[number])) / options.tasks
        ratios = costs["with"][number] / costs["without"][number]
        results[f"{field} ratio"] = float(np.median(ratios))
        least = costs["with"][number].min() / costs["without"][number].min()
        words = " ".join(f"{ratio:.3f}" for ratio in sorted(ratios)) + f"; of minima: {least:.3f}"
        print(
            f"{field}: {results[f'{field} without']:.0f} µs per task without shares, "
            f"{results[f'{field} with']:.0f} µs with; ratios of all pairs: {words}"
        )
    print(f"second client: {waits['without']:.2f} s without shares, {waits['with']:.2f} s with")
    write_results(options.json, results)
    return results


if __name__ == "__main__":
    main()

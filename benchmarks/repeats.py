"""Measure what it costs that a pipe recognizes repeated items.

    python -m benchmarks.repeats [--items N] [--repeat N] [--kind KIND …]

Tasks of a partition put items into a pipe, in turn with `drop_repeats=True` and with
`drop_repeats=False`. This process takes the items at the end, so that nobody waits. The items are
sent in three ways:

- `put`: a task sends one item at a time;
- `put_many`: a task sends 100 times as many items, 100 at a time;
- `for_each`: each task of a `for_each` sends one item, and there are a quarter as many items.

CPU time is the sum for driver, scheduler and worker. The ratio is the cost with `drop_repeats=True`
divided by the cost with `drop_repeats=False`. The table contains its median and its quartiles over
all pairs of measurements.
"""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial

import numpy as np
import psutil
from distributed import Client

from poolpart import Partition, Pipe

from .harness import argument_parser, cpu_seconds, print_row, run_rounds, write_results
from .many_workers import process, run_scheduler, run_workers

NAME = "A"
BATCH = 100
PUT, PUT_MANY, FOR_EACH = KINDS = "put", "put_many", "for_each"


class Cluster:
    """Cluster of a scheduler and a worker, each in its own process."""

    def __init__(self, client: Client, processes: list[psutil.Process]) -> None:
        self.partition = Partition(NAME, client)
        self._processes = processes

    def cpu_of(self, kind: str, count: int, drop_repeats: bool, _round: int) -> float:
        """Return the CPU time in seconds that all processes need to send and take the items."""
        gc.collect()
        client = self.partition.client
        with Pipe("items", count, client, drop_repeats=drop_repeats) as pipe:
            before = sum(map(cpu_seconds, self._processes))
            if kind == FOR_EACH:
                self.partition.for_each(range(count), put_one, pipe=pipe)
            else:
                self.partition.submit(put_all, pipe, count, kind).result()
            assert sorted(pipe.drain()) == list(range(count))
            return sum(map(cpu_seconds, self._processes)) - before


@contextmanager
def start_cluster() -> Iterator[Cluster]:
    """Start the processes, and stop them at the end of the block."""
    with (
        process(run_scheduler) as (scheduler, address),
        process(run_workers, address, 1, (NAME, 2)) as (worker, _),
        Client(address) as client,
    ):
        yield Cluster(client, [psutil.Process(), scheduler, worker])


def put_all(pipe: Pipe, count: int, kind: str) -> None:
    """Send items one at a time, or several at a time."""
    if kind == PUT:
        for item in range(count):
            pipe.put(item)
    else:
        for first in range(0, count, BATCH):
            pipe.put_many(range(first, first + BATCH))


def put_one(item: int, pipe: Pipe) -> None:
    """Send one item."""
    pipe.put(item)


def main() -> None:
    """Measure all kinds of producers, print a row for each of them, and write the results."""
    parser = argument_parser(__doc__, repeat=9, quick=True)
    parser.add_argument("--items", type=int, default=4_000, help="(default: 4000)")
    parser.add_argument("--kind", choices=KINDS, nargs="+", default=KINDS)
    options = parser.parse_args()
    if options.quick:
        options.items, options.repeat = BATCH, 1
    counts = {PUT: options.items, PUT_MANY: BATCH * options.items, FOR_EACH: options.items // 4}
    results: dict[str, dict[str, float]] = {}
    print_row("kind", "on, µs per item", "off, µs per item", "ratio", "quartiles")
    with start_cluster() as cluster:
        for kind in options.kind:
            count = counts[kind]
            ways = {"on": True, "off": False}
            calls = {way: partial(cluster.cpu_of, kind, count, drop) for way, drop in ways.items()}
            seconds = run_rounds(calls, options.repeat)
            on_us, off_us = (1e6 * float(np.median(seconds[way])) / count for way in ways)
            ratios = np.divide(seconds["on"], seconds["off"])
            lower, ratio, upper = map(float, np.quantile(ratios, (0.25, 0.5, 0.75)))
            results[kind] = {"on_us": on_us, "off_us": off_us, "ratio": ratio}
            quartiles = f"{lower:.2f}, {upper:.2f}"
            print_row(kind, f"{on_us:.1f}", f"{off_us:.1f}", f"{ratio:.2f}", quartiles)
    write_results(options.json, results)


if __name__ == "__main__":
    main()

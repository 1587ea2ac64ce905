"""Count the functions of poolpart that are called for each task and each item.

    python -m benchmarks.calls

The counts do not depend on the load of the machine, unlike the times of `benchmarks.beside_dask`.
Client, scheduler and workers are threads of one process, and the functions of all of them count. A
few calls depend on how the threads interleave. The cost of a fixed number of calls is excluded by
doing the same work with two numbers of items. To compare with another version of poolpart, put its
folder first on `PYTHONPATH`. The kinds of work are:

- `submit`: a task of `Partition.submit`;
- `map`: an item of `Partition.map(chunk=1)`;
- `put`: an item that a task puts into a pipe;
- `trip`: a round trip of an item through a task with two pipes.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

from distributed import Client, Scheduler, SpecCluster, Worker, wait

import poolpart
from poolpart import Partition, Pipe, Pool, n_workers

from .beside_dask import echo
from .harness import argument_parser, print_row, write_results

FOLDER = str(Path(poolpart.__file__).parent)


class CallCounter:
    """Profile function that counts calls of poolpart's functions in all threads."""

    def __init__(self) -> None:
        self.count = 0

    def __call__(self, frame: FrameType, event: str, _: Any) -> None:
        """Count a call."""
        if event == "call" and frame.f_code.co_filename.startswith(FOLDER):
            self.count += 1


def submit(partition: Partition, count: int) -> None:
    wait([partition.submit(int, str(number)) for number in range(count)])


def map_items(partition: Partition, count: int) -> None:
    list(partition.map(int, map(str, range(count)), chunk=1))


def put_all(pipe: Pipe, count: int) -> None:
    for item in range(count):
        pipe.put(item)


def put(partition: Partition, count: int) -> None:
    with Pipe("items", count, partition.client) as pipe:
        partition.submit(put_all, pipe, count).result()
        assert pipe.drain() == list(range(count))


def round_trips(partition: Partition, count: int) -> None:
    client = partition.client
    with Pipe("there", 1, client) as there, Pipe("back", 1, client) as back:
        task = partition.submit(echo, there, back, count)
        for item in range(count):
            there.put(item)
            assert back.get() == item
        task.result()


KINDS: dict[str, Callable[[Partition, int], None]] = {
    "submit": submit,
    "map": map_items,
    "put": put,
    "trip": round_trips,
}


def count_calls(
    partition: Partition, counter: CallCounter, kind: str, few: int, many: int
) -> float:
    """Return the number of calls per task or item."""
    calls = []
    for count in (few, few, many):  # everything has been done once before the second time
        before = counter.count
        KINDS[kind](partition, count)
        calls.append(counter.count - before)
    return (calls[2] - calls[1]) / (many - few)


def main() -> None:
    """Count the calls of all kinds of work, print a row for each of them, and write the results."""
    parser = argument_parser(__doc__, quick=True)
    options = parser.parse_args()
    few, many = (10, 20) if options.quick else (200, 600)
    counter = CallCounter()
    threading.setprofile(counter)  # before the threads start
    sys.setprofile(counter)
    own = {"protocol": "inproc://", "dashboard": False}
    workers = {name: {"cls": Worker, "options": {**own, "nthreads": 2}} for name in "ab"}
    scheduler = {"cls": Scheduler, "options": {**own, "port": 0, "dashboard_address": None}}
    results: dict[str, float] = {}
    print_row("kind", "calls")
    with SpecCluster(workers, scheduler) as cluster, Client(cluster) as client:
        partition = Pool.from_client(client).divide({"A": n_workers(2, slots=2)})["A"]
        for kind in KINDS:
            results[kind] = count_calls(partition, counter, kind, few, many)
            print_row(kind, f"{results[kind]:.1f}")
    write_results(options.json, results)


if __name__ == "__main__":
    main()

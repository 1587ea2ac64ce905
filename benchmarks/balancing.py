"""Measure the throughput of two services whose workers `Pool.balance` divides.

    python -m benchmarks.balancing [--workers N] [--scale FACTOR] [--processes] [--case NAME …]

Items pass through two services of 0.17 and 0.21 s, which share 126 workers. The best division is 56
to 70 workers, with 332 items/s. The tasks sleep, and the workers are threads of one process. With
`--processes`, each worker is a process. On a machine with few cores, `--scale 10` multiplies both
times by ten, so that the scheduler is not the bottleneck. The cases are:

- `balanced`: partitions that begin with half of the workers each, with `Pool.balance`;
- `halves`: the same without `Pool.balance`;
- `best`: a fixed division into 56 and 70 workers;
- `dask`: two Dask resources with half of the workers each. A client submits each item to both
  services, at most four items per worker at a time;
- `step`: like `balanced`, but the first service becomes three times slower;
- `step_halves`: the same without `Pool.balance`.

Throughput is measured after a transient of 20 mean service times, for 30 mean service times. The
results also contain the number of finished items and the workers of the first service every second.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, nullcontext
from threading import Event, Thread
from typing import Any, NamedTuple

from distributed import Client, as_completed

from poolpart import Partition, Pipe, Pool, n_workers, rest

from .harness import argument_parser, write_results
from .many_workers import process, run_scheduler, run_workers

DECODE_S = 0.17
DETECT_S = 0.21
SLOWER = 3.0  # factor of the first service in the case `step`
TRANSIENT = 20  # mean service times before a measurement
MEASURED = 30  # mean service times of a measurement
CASES = ("balanced", "halves", "best", "dask", "step", "step_halves")


class Sample(NamedTuple):
    """State at one time."""

    time: float  # seconds since the start
    done: int  # number of items that have passed through both services
    decode_workers: int


def decode(seconds: float, out: Pipe | None = None) -> float:
    """Run the first service for one item."""
    time.sleep(seconds)
    if out is not None:
        out.put(seconds)
    return seconds


def detect(_: float, seconds: float) -> None:
    """Run the second service for one item."""
    time.sleep(seconds)


class Load:
    """Endless items, whose value is the time that the first service takes."""

    def __init__(self, scale: float) -> None:
        self.decode_s = DECODE_S * scale
        self.detect_s = DETECT_S * scale
        self.ended = Event()

    def __iter__(self) -> Iterator[float]:
        while not self.ended.is_set():
            yield self.decode_s

    @property
    def mean_s(self) -> float:
        """Mean time of both services."""
        return (self.decode_s + self.detect_s) / 2


@contextmanager
def cluster_of(workers: int, resources: bool, processes: bool) -> Iterator[Client]:
    """Start a scheduler and workers, optionally with a resource for each half of the workers."""
    half = workers // 2
    kinds: list[tuple[int, tuple[str, int] | None]] = [(workers, None)]
    if resources:
        kinds = [(half, ("DECODE", 1)), (workers - half, ("DETECT", 1))]
    with ExitStack() as stack:
        _, address = stack.enter_context(process(run_scheduler))
        first = 0
        for count, slots in kinds:
            per_process = 1 if processes else count
            for _ in range(count // per_process):
                arguments = address, per_process, slots, first
                stack.enter_context(process(run_workers, *arguments))
                first += per_process
        yield stack.enter_context(Client(address))


def run_partitions(client: Client, load: Load, balanced: bool, decode_workers: int) -> Callable:
    """Start processing items with partitions. Return a function that stops it."""
    pool = Pool.from_client(client)
    parts = pool.divide({"DECODE": n_workers(decode_workers), "DETECT": rest(minimum=1)})
    workers = len(pool)
    frames = Pipe("frames", workers, client).create()
    group = pool.balance(parts.values(), min=1) if balanced else nullcontext()
    group.__enter__()
    options = {"window": 2 * workers, "wait": False}
    first = parts["DECODE"].for_each(load, decode, out=frames, **options)
    second = parts["DETECT"].for_each(frames, detect, seconds=load.detect_s, **options)

    def end() -> dict[str, Any]:
        load.ended.set()
        items = first.result()
        frames.close()
        moves = len(group.stats().moves) if balanced else 0
        return {"items": items, "detected": second.result(), "moves": moves}

    return end


def run_resources(client: Client, load: Load, workers: int) -> Callable:
    """Start processing items with Dask resources. Return a function that stops it."""
    counts = {"items": 0, "detected": 0}

    def submit(seconds: float) -> Any:
        counts["items"] += 1
        options = {"pure": False}
        decoded = client.submit(decode, seconds, resources={"DECODE": 1}, **options)
        return client.submit(detect, decoded, load.detect_s, resources={"DETECT": 1}, **options)

    def run() -> None:
        items = iter(load)
        ended = as_completed([submit(next(items)) for _ in range(4 * workers)])
        for _ in ended:
            counts["detected"] += 1
            for seconds in items:
                ended.add(submit(seconds))
                break

    thread = Thread(target=run)
    thread.start()

    def end() -> dict[str, Any]:
        load.ended.set()
        thread.join()
        return counts

    return end


def sample_for(client: Client, seconds: float, began_at: float) -> list[Sample]:
    """Take a sample every second."""
    parts = [Partition(name, client) for name in ("DECODE", "DETECT")]
    samples = []
    deadline = time.perf_counter() + seconds
    while True:
        decoding, detecting = (part.stats() for part in parts)
        elapsed = time.perf_counter() - began_at
        samples.append(Sample(elapsed, detecting.done, decoding.workers))
        if time.perf_counter() >= deadline:
            return samples
        time.sleep(1.0)


def throughput(samples: list[Sample]) -> float:
    """Return the number of items per second between the first and the last sample."""
    first, last = samples[0], samples[-1]
    return (last.done - first.done) / (last.time - first.time)


def measure(case: str, workers: int, scale: float, processes: bool) -> dict[str, Any]:
    """Run a case, and return its throughput relative to the best division."""
    load = Load(scale)
    half = workers // 2
    with cluster_of(workers, case == "dask", processes) as client:
        Partition("DETECT", client).stats()  # count from now on
        began_at = time.perf_counter()
        if case == "dask":
            end = run_resources(client, load, workers)
        else:
            share = load.decode_s / (load.decode_s + load.detect_s)
            decode_workers = round(workers * share) if case == "best" else half
            end = run_partitions(client, load, case in ("balanced", "step"), decode_workers)
        history = sample_for(client, TRANSIENT * load.mean_s, began_at)
        if case.startswith("step"):
            load.decode_s *= SLOWER
            history += sample_for(client, TRANSIENT * load.mean_s, began_at)
        measured = sample_for(client, MEASURED * load.mean_s, began_at)
        best = workers / (load.decode_s + load.detect_s)
        items_per_s = throughput(measured)
        return {
            "items_per_s": items_per_s,
            "of_best": items_per_s / best,
            "decode_workers": measured[-1].decode_workers,
            "best_decode_workers": workers * load.decode_s / (load.decode_s + load.detect_s),
            "history": history + measured,
            **end(),
        }


def main() -> None:
    """Run the cases, print a table, and write the results."""
    parser = argument_parser(__doc__, quick=True)
    parser.add_argument("--workers", type=int, default=126, metavar="N", help="(default: 126)")
    parser.add_argument("--scale", type=float, default=1.0, metavar="FACTOR", help="(default: 1)")
    parser.add_argument("--processes", action="store_true", help="start a process for each worker")
    parser.add_argument("--case", choices=CASES, nargs="+", default=CASES)
    options = parser.parse_args()
    workers = 6 if options.quick else options.workers
    scale = 0.5 if options.quick else options.scale
    results = {}
    for case in options.case:
        results[case] = measure(case, workers, scale, options.processes)
        row = results[case]
        print(
            f"{case:<12}{row['items_per_s']:8.2f} items/s, {row['of_best']:4.0%} of the best "
            f"division, {row['decode_workers']} of {row['best_decode_workers']:.1f} workers",
            flush=True,
        )
        write_results(options.json, results)


if __name__ == "__main__":
    main()

"""Measure the CPU time of driver, scheduler and collectors per task, receipt and job.

    python -m benchmarks.scale [--workers N ...]
    python -m benchmarks.scale --receipts SECONDS [--workers N ...] [--shards N]
    python -m benchmarks.scale --jobs N

Scheduler, driver and workers are separate processes. All workers are threads of one process, are
divided into four partitions, and run tasks that do nothing:

- `submit` sends one task in each message, `client_map` is Dask's own map, and `map` returns results
  one by one with a limited number of tasks in flight. `map_small` puts several items into a task,
  and its values are per item. At least two tasks for each slot are needed, so its cost grows with
  the cluster.
- The CPU time of the scheduler excludes heartbeats, which are measured separately.
- Growth is the growth of driver and scheduler together, from the smallest to the largest cluster.

With `--receipts SECONDS`, GPU workers cast surveys in batches of one scan with four rays. Each
batch takes the given time, because casting ends with a sleep. The rest of the pipeline is real. The
values are per receipt, with the fraction of a minute in which the workers are busy. `--shards N`
runs N of these clusters at a time. `--jobs N` runs the tiny jobs of `benchmarks.campaign`. Both
skip the first fifth of the work, to exclude the start of a run.
"""

from __future__ import annotations

import math
import multiprocessing
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack, contextmanager
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import psutil
from distributed import Client, get_worker

import lidarpool.run.pipeline.stage2_intersect
from lidarpool import Campaign, Scene, Sensor, Survey, simulate
from lidarpool.run.progress import Progress
from lidarsim.scene.actors import box
from poolpart import Partition, Pool

from .campaign import BASE, CAMPAIGN
from .control import single_scans
from .harness import argument_parser, cpu_seconds, write_results
from .many_workers import process, run_scheduler, run_workers

NAMES = ("A", "B", "C", "D")


async def _workers(
    connection: Connection,
    address: str,
    count: int,
    slots: tuple[str, int] | None = None,
    seconds: float = 0.0,
    first: int = 0,
) -> None:
    """Run workers like `run_workers`, with batches that take `seconds` to cast."""
    columns_of = lidarpool.run.pipeline.stage2_intersect.columns_of

    def slowly(points: Any) -> Any:
        time.sleep(seconds)
        return columns_of(points)

    lidarpool.run.pipeline.stage2_intersect.columns_of = slowly
    await run_workers(connection, address, count, slots, first)


def name_of_worker(_: object = None) -> str:
    return str(get_worker().name)


def divide(client: Client) -> tuple[list[Partition], float]:
    """Divide all workers into four partitions, and return these and the elapsed seconds."""
    start = time.perf_counter()
    remaining = Pool.from_client(client)
    workers_per_partition = len(remaining) // len(NAMES)
    parts = []
    for name in NAMES[:-1]:
        part, remaining = remaining.partition(name, n_workers=workers_per_partition)
        parts.append(part)
    parts.append(remaining.partition(NAMES[-1], n_workers=len(remaining))[0])
    return parts, time.perf_counter() - start


def by_submit(partition: Partition, tasks: int) -> list[str]:
    futures = [partition.submit(name_of_worker) for _ in range(tasks)]
    return list(partition.client.gather(futures))


def by_client_map(partition: Partition, tasks: int) -> list[str]:
    with partition:
        futures = partition.client.map(name_of_worker, [None] * tasks, pure=False)
    return list(partition.client.gather(futures))


def by_map(partition: Partition, tasks: int) -> list[str]:
    return list(partition.map(name_of_worker, [None] * tasks, chunk=1))


def by_map_small(partition: Partition, tasks: int) -> list[str]:
    return list(partition.map(name_of_worker, [None] * tasks))


# {name: function, how many tasks compared with `--tasks`}
WAYS = {
    "submit": (by_submit, 0.25),
    "client_map": (by_client_map, 1),
    "map": (by_map, 0.25),
    "map_small": (by_map_small, 5),
}


def measure(workers: int, tasks: int) -> dict[str, Any]:
    """Return the results for a cluster of `workers` workers."""
    with (
        process(run_scheduler) as (scheduler, address),
        process(_workers, address, workers),
        Client(address) as client,
    ):
        parts, seconds = divide(client)
        members = {part.name: {worker.name for worker in part.workers} for part in parts}
        cpu_before = cpu_seconds(scheduler)
        time.sleep(2)
        idle = (cpu_seconds(scheduler) - cpu_before) / 2
        figures: dict[str, Any] = {
            "seconds_to_partition": round(seconds, 3),
            "scheduler_idle_percent": round(100 * idle, 1),
            "tasks": 0,
            "misplaced": 0,
        }
        by_submit(parts[0], workers)  # the first tasks import things
        for method, (run, share) in WAYS.items():
            start = time.perf_counter()
            driver = time.process_time()
            cpu_before = cpu_seconds(scheduler)
            names = {part.name: run(part, math.ceil(share * tasks / len(parts))) for part in parts}
            wall = time.perf_counter() - start
            task_count = sum(map(len, names.values()))
            busy = cpu_seconds(scheduler) - cpu_before - idle * wall
            figures[method] = {
                "tasks_per_second": round(task_count / wall, 1),
                "driver_ms": round(1e3 * (time.process_time() - driver) / task_count, 4),
                "scheduler_ms": round(1e3 * max(0.0, busy) / task_count, 4),
            }
            figures["tasks"] += task_count
            figures["misplaced"] += sum(
                worker not in members[name] for name, ran in names.items() for worker in ran
            )
        return figures


MINUTE_S = 60.0
# GPU workers for a collector, and in a process
GPUS_EACH = 20
WORKERS_PER_PROCESS = 25
ROOM = Scene.from_meshes([box("Room", (8, 6, 3))])


def small_survey(scans: int) -> Survey:
    """Return a survey whose scans have four rays."""
    sensor = Sensor.grid(rays_per_revolution=4, layers=1, step_deg=360)
    return Survey(sensor, [(0.0, 0.0, 1.0)] * scans, steps=1)


class CostSamples:
    """CPU time of each kind of process per receipt or job, without the first fifth of the work."""

    def __init__(self, total: int, processes: dict[str, list[psutil.Process]]) -> None:
        self._all = total
        self._processes = {"driver": [psutil.Process()], **processes}
        cpu_before = self._cpu_s()
        time.sleep(2)
        self._idle = {name: (s - cpu_before[name]) / 2 for name, s in self._cpu_s().items()}
        self._samples: list[tuple[int, float, dict[str, float]]] = []

    def _cpu_s(self) -> dict[str, float]:
        return {
            name: sum(map(cpu_seconds, processes)) for name, processes in self._processes.items()
        }

    def __call__(self, progress: Progress) -> None:
        """Sample the progress and the CPU times."""
        finished = progress.jobs_done if progress.jobs else progress.collected
        if not self._samples or finished > self._samples[-1][0]:
            if finished <= self._all // 5:
                self._samples.clear()
            self._samples.append((finished, time.perf_counter(), self._cpu_s()))

    def figures(self) -> dict[str, float]:
        """Return items per second, and milliseconds per item excluding heartbeats."""
        (first_count, start, cpu_before), *_, (last_count, stop, cpu_after) = self._samples
        took = {
            name: cpu_after[name] - cpu_before[name] - self._idle[name] * (stop - start)
            for name in cpu_after
        }
        per_item_ms = {
            f"{name}_ms": round(1e3 * s / (last_count - first_count), 3) for name, s in took.items()
        }
        idle = round(100 * self._idle["scheduler"], 1)
        return {
            "a_second": round((last_count - first_count) / (stop - start), 1),
            **per_item_ms,
            "idle_percent": idle,
        }


@contextmanager
def casting_cluster(
    gpus: int, seconds: float
) -> Iterator[tuple[Client, dict[str, list[psutil.Process]]]]:
    """Start slow casting workers and a LIDAR worker; yield a client and the processes by kind."""
    with ExitStack() as stack:

        def start(main: Callable[..., Any], *arguments: Any) -> tuple[psutil.Process, str]:
            return stack.enter_context(process(main, *arguments))

        scheduler, address = start(run_scheduler)
        lidar, _ = start(_workers, address, 1, ("LIDAR", 8 + gpus // GPUS_EACH))
        casting = [
            start(_workers, address, min(WORKERS_PER_PROCESS, gpus - n), ("GPU", 1), seconds, n)[0]
            for n in range(0, gpus, WORKERS_PER_PROCESS)
        ]
        processes = {"scheduler": [scheduler], "collectors": [lidar], "casting": casting}
        yield stack.enter_context(Client(address)), processes


def measure_receipts(gpus: int, seconds: float, scans: int) -> dict[str, float]:
    """Run a survey with one scan per batch, and return its results."""
    with casting_cluster(gpus, seconds) as (client, processes), single_scans():
        simulate(ROOM, small_survey(gpus), client=client, backend="numpy")
        counts = CostSamples(scans, processes)
        with tempfile.TemporaryDirectory() as folder:
            result = simulate(
                ROOM,
                small_survey(scans),
                client=client,
                backend="numpy",
                folder=Path(folder) / "run",
                on_progress=counts,
                collectors=max(2, gpus // GPUS_EACH),
            )
    casting = next(stage for stage in result.stages if stage.stage == "intersect")
    casting_s = min(MINUTE_S, casting.stop - casting.start)
    until = casting.start + casting_s
    spans = [max(0.0, min(record.stop, until) - record.start) for record in casting.records]
    recorded_share = len(casting.records) / casting.tasks  # of thousands, every second one
    share = round(sum(spans) / recorded_share / (casting_s * gpus), 3)
    return {**counts.figures(), "busy": share, "gpus": gpus, "seconds": seconds}


def measure_shards(shards: int, *arguments: Any) -> dict[str, float]:
    """Run `measure_receipts` in several clusters at once.

    Rates are added up, and other values are averaged.
    """
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(shards, mp_context=spawn) as pool:
        rows = list(pool.map(measure_receipts, *([value] * shards for value in arguments)))
    mean = {name: round(sum(row[name] for row in rows) / shards, 3) for name in rows[0]}
    return mean | {"a_second": sum(row["a_second"] for row in rows), "shards": shards}


def measure_jobs(jobs: int) -> dict[str, float]:
    """Run a campaign of tiny jobs and return its results."""
    with casting_cluster(4, 0.0) as (client, processes), tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "campaign.yaml"
        data = Path(folder) / "data"
        file.with_name("base.yaml").write_text(BASE % (100, 10))
        file.write_text(CAMPAIGN % 20)
        Campaign.load(file).run(Path(folder) / "first", client=client)
        file.write_text(CAMPAIGN % jobs)
        counts = CostSamples(jobs, processes)
        Campaign.load(file).run(data, client=client, on_progress=counts)
    return counts.figures()


def growth(smallest: dict[str, float], largest: dict[str, float]) -> float | None:
    """Return how much the sum of driver and scheduler time grows, or None if it starts at zero."""
    smallest_ms, largest_ms = (
        figures["driver_ms"] + figures["scheduler_ms"] for figures in (smallest, largest)
    )
    return round(largest_ms / smallest_ms, 2) if smallest_ms else None


def main(arguments: list[str] | None = None) -> dict[str, Any]:
    parser = argument_parser(__doc__)
    parser.add_argument("--workers", type=int, nargs="+", default=[10, 50, 200])
    parser.add_argument(
        "--tasks", type=int, default=20_000, help="number of tasks for each way to submit"
    )
    parser.add_argument("--receipts", type=float, help="seconds to cast a batch of one scan")
    parser.add_argument(
        "--scans", type=int, default=3_000, help="scans per survey (with --receipts)"
    )
    parser.add_argument(
        "--shards", type=int, default=1, help="number of simultaneous clusters (with --receipts)"
    )
    parser.add_argument("--jobs", type=int, help="number of tiny jobs")
    options = parser.parse_args(arguments)
    rows: dict[str, Any] = {}
    if options.receipts is not None:
        for count in options.workers:
            title = f"{options.shards} x {count} workers, batches of {options.receipts:g} s"
            rows[title] = measure_shards(options.shards, count, options.receipts, options.scans)
    if options.jobs:
        rows[f"{options.jobs} tiny jobs"] = measure_jobs(options.jobs)
    for title, values in rows.items():
        print(f"{title}: {', '.join(f'{name} {value:g}' for name, value in values.items())}")
    results = rows or measure_tasks(options.workers, options.tasks)
    write_results(options.json, results)
    return results


def measure_tasks(worker_counts: list[int], tasks: int) -> dict[str, Any]:
    """Measure tasks that do nothing, on clusters of growing size."""
    clusters = {}
    for count in worker_counts:
        clusters[count] = values = measure(count, tasks)
        print(
            f"{count} workers: {values['seconds_to_partition']} s to partition, "
            f"{values['misplaced']} of {values['tasks']} misplaced, scheduler idle at "
            f"{values['scheduler_idle_percent']}% of a core"
        )
        for method in WAYS:
            a_second, driver, scheduler = values[method].values()
            print(
                f"  {method:<11} {a_second:9.1f} a second, driver {driver:.3f} ms, "
                f"scheduler {scheduler:.3f} ms"
            )
    extremes = clusters[min(clusters)], clusters[max(clusters)]
    grown = {method: growth(extremes[0][method], extremes[1][method]) for method in WAYS}
    print(f"growth from {min(clusters)} to {max(clusters)} workers: {grown}")
    return {"tasks": tasks, "workers": clusters, "growth": grown}


if __name__ == "__main__":
    main()

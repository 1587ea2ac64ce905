"""What a task, a receipt and a job cost as the cluster grows: `python -m benchmarks.scale`.

Scheduler, driver and workers are three processes, so that what each takes can be told apart:
all the workers are threads of one process, and the tasks do nothing. The workers are divided
into four partitions.

- `submit`: one task a message; `client_map`: Dask's own map, all in one; `map`: results one by
  one, a bounded number of tasks under way. `map_small` puts several items into a task, as
  `Partition.map` does by itself, and its figures are for an item: at least two tasks for each
  slot are needed, so that they grow with the cluster.
- The scheduler's time is CPU time, less what it takes in as long a time with nothing to do
  (heartbeats), which is given by itself; the driver's is CPU time of its process.
- Growth is that of driver and scheduler together, from the smallest cluster to the largest.

`--receipts SECONDS` has surveys cast by so many GPU workers whose batches, of one scan with four
rays, take so long: casting ends with a sleep, all else is the product's own. The figures are a
receipt's, and how busy the workers are in a minute; `--shards N` has so many of these clusters run
at a time. `--jobs N` runs the tiny jobs of `benchmarks.campaign`. Both count from a fifth of the
work on: what a run takes to start and to finish is no part of them.
"""

from __future__ import annotations

import argparse
import json
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

import lidarpool.run.pipeline.rigs
from benchmarks.campaign import BASE, CAMPAIGN
from benchmarks.control import single_scans
from benchmarks.many_workers import process, run_scheduler, run_workers
from lidarpool import Campaign, Scene, Sensor, Survey, simulate
from lidarpool.run.progress import Progress
from lidarsim.scene.actors import box
from poolpart import Partition, Pool

NAMES = ("A", "B", "C", "D")


async def _workers(
    connection: Connection,
    address: str,
    count: int,
    slots: tuple[str, int] | None = None,
    seconds: float = 0.0,
    first: int = 0,
) -> None:
    """Run workers as `run_workers` does; batches take `seconds` to cast."""
    columns_of = lidarpool.run.pipeline.rigs.columns_of

    def slowly(points: Any) -> Any:
        time.sleep(seconds)
        return columns_of(points)

    lidarpool.run.pipeline.rigs.columns_of = slowly
    await run_workers(connection, address, count, slots, first)


def name_of_worker(_: object = None) -> str:
    return str(get_worker().name)


def divide(client: Client) -> tuple[list[Partition], float]:
    """Divide all workers into four partitions; return the partitions and the elapsed seconds."""
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


def processor_s(process: psutil.Process) -> float:
    times = process.cpu_times()
    return float(times.user + times.system)


def measure(workers: int, tasks: int) -> dict[str, Any]:
    """Return the figures of a cluster of `workers` workers."""
    with (
        process(run_scheduler) as (scheduler, address),
        process(_workers, address, workers),
        Client(address) as client,
    ):
        parts, seconds = divide(client)
        members = {part.name: {worker.name for worker in part.workers} for part in parts}
        cpu_before = processor_s(scheduler)
        time.sleep(2)
        idle = (processor_s(scheduler) - cpu_before) / 2
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
            cpu_before = processor_s(scheduler)
            names = {part.name: run(part, math.ceil(share * tasks / len(parts))) for part in parts}
            wall = time.perf_counter() - start
            task_count = sum(map(len, names.values()))
            busy = processor_s(scheduler) - cpu_before - idle * wall
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
    """Return a survey of scans of four rays."""
    sensor = Sensor.grid(rays_per_revolution=4, layers=1, step_deg=360)
    return Survey(sensor, [(0.0, 0.0, 1.0)] * scans, steps=1)


class CostSamples:
    """Processor time per receipt or job of each kind of process, after a fifth of the work."""

    def __init__(self, total: int, processes: dict[str, list[psutil.Process]]) -> None:
        self._all = total
        self._processes = {"driver": [psutil.Process()], **processes}
        cpu_before = self._cpu_s()
        time.sleep(2)
        self._idle = {name: (s - cpu_before[name]) / 2 for name, s in self._cpu_s().items()}
        self._samples: list[tuple[int, float, dict[str, float]]] = []

    def _cpu_s(self) -> dict[str, float]:
        return {
            name: sum(map(processor_s, processes)) for name, processes in self._processes.items()
        }

    def __call__(self, progress: Progress) -> None:
        """Sample the progress and the processor times."""
        finished = progress.jobs_done if progress.jobs else progress.collected
        if not self._samples or finished > self._samples[-1][0]:
            if finished <= self._all // 5:
                self._samples.clear()
            self._samples.append((finished, time.perf_counter(), self._cpu_s()))

    def figures(self) -> dict[str, float]:
        """Return items per second, and milliseconds per item without heartbeats."""
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
    """Start slow casting workers and a worker of LIDAR; yield a client and processes by kind."""
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
    """Run a survey with batches of one scan; return its figures and the share of casting."""
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
    """Run `measure_receipts` in several clusters at a time; return summed rates, other means."""
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(shards, mp_context=spawn) as pool:
        rows = list(pool.map(measure_receipts, *([value] * shards for value in arguments)))
    mean = {name: round(sum(row[name] for row in rows) / shards, 3) for name in rows[0]}
    return mean | {"a_second": sum(row["a_second"] for row in rows), "shards": shards}


def measure_jobs(jobs: int) -> dict[str, float]:
    """Run a campaign of tiny jobs; return its figures."""
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
    """Return the growth of driver and scheduler time together, or None from zero."""
    smallest_ms, largest_ms = (
        figures["driver_ms"] + figures["scheduler_ms"] for figures in (smallest, largest)
    )
    return round(largest_ms / smallest_ms, 2) if smallest_ms else None


def main(arguments: list[str] | None = None) -> dict[str, Any]:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--workers", type=int, nargs="+", default=[10, 50, 200])
    parser.add_argument("--tasks", type=int, default=20_000, help="of each way to submit them")
    parser.add_argument("--receipts", type=float, help="seconds that a batch of one scan takes")
    parser.add_argument("--scans", type=int, default=3_000, help="of a survey for --receipts")
    parser.add_argument("--shards", type=int, default=1, help="clusters at a time, for --receipts")
    parser.add_argument("--jobs", type=int, help="number of tiny jobs")
    parser.add_argument("--json", type=Path, help="also write the figures to this file")
    options = parser.parse_args(arguments)

    rows: dict[str, Any] = {}
    if options.receipts is not None:
        for count in options.workers:
            title = f"{options.shards} x {count} workers, batches of {options.receipts:g} s"
            rows[title] = measure_shards(options.shards, count, options.receipts, options.scans)
    if options.jobs:
        rows[f"{options.jobs} tiny jobs"] = measure_jobs(options.jobs)
    for title, figures in rows.items():
        print(f"{title}: {', '.join(f'{name} {value:g}' for name, value in figures.items())}")
    if options.json and rows:
        options.json.write_text(json.dumps(rows, indent=1) + "\n")
    return rows or measure_tasks(options)


def measure_tasks(options: argparse.Namespace) -> dict[str, Any]:
    """Measure the cost of tasks that do nothing, in clusters of growing size."""
    clusters = {}
    for count in options.workers:
        clusters[count] = figures = measure(count, options.tasks)
        print(
            f"{count} workers: {figures['seconds_to_partition']} s to partition, "
            f"{figures['misplaced']} of {figures['tasks']} misplaced, scheduler idle at "
            f"{figures['scheduler_idle_percent']}% of a core"
        )
        for method in WAYS:
            a_second, driver, scheduler = figures[method].values()
            print(
                f"  {method:<11} {a_second:9.1f} a second, driver {driver:.3f} ms, "
                f"scheduler {scheduler:.3f} ms"
            )
    extremes = clusters[min(clusters)], clusters[max(clusters)]
    grown = {method: growth(extremes[0][method], extremes[1][method]) for method in WAYS}
    print(f"growth from {min(clusters)} to {max(clusters)} workers: {grown}")
    results = {"tasks": options.tasks, "workers": clusters, "growth": grown}
    if options.json:
        options.json.write_text(json.dumps(results, indent=1) + "\n")
    return results


if __name__ == "__main__":
    main()

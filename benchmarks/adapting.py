"""Where tasks run while partitions grow and shrink: `python -m benchmarks.adapting`.

Three partitions of 0 to 3 worker processes each, as jobs of dask-jobqueue that this machine starts
itself. Each gets its tasks in waves, by a thread of its own, with pauses that are longer than an
idle worker stays: it grows from nothing and shrinks again with each wave. Each task tells on which
worker it ran and what that worker declares; the scheduler counts tasks that it took back from a
worker that was gone. The seed chooses waves and pauses.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import random
import shlex
import signal
import subprocess
import time
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import dask_jobqueue.local
from distributed import Client
from distributed.deploy.spec import ProcessInterface
from distributed.diagnostics.plugin import SchedulerPlugin

from lidarpool.run.pipeline.task_records import TaskRecord, call_recorded, placement_violations
from poolpart import Partition
from poolpart.deploy import start_partitions

NAMES = ("A", "B", "C")
MAX_WORKERS = 3  # workers of a partition
IDLE_S = 1.0
SCHEDULER = {"host": "127.0.0.1", "dashboard": False, "dashboard_address": "127.0.0.1:0"}


class ProcessJob(dask_jobqueue.local.LocalJob):
    """Dask-jobqueue job that is a process of this machine, in any state of its life."""

    async def _submit_job(self, script: str) -> str:
        command = shlex.split(Path(script).read_text())
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        self.process = subprocess.Popen(command, start_new_session=True, **quiet)
        return str(self.process.pid)

    async def close(self) -> None:
        """End the process, which may be ending by itself already."""
        await asyncio.sleep(0.5)
        with suppress(ProcessLookupError):
            os.killpg(self.process.pid, signal.SIGTERM)
        await asyncio.to_thread(self.process.wait)
        await ProcessInterface.close(self)


class ProcessCluster(dask_jobqueue.local.LocalCluster):
    """Cluster of `ProcessJob` jobs."""

    job_cls = ProcessJob


class Watched(SchedulerPlugin):
    """Scheduler plugin that counts workers, and tasks lost or taken back when workers leave."""

    name = "watched"

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self.max_workers: Counter[str] = Counter()  # workers at a time, by partition

    def start(self, scheduler: Any) -> None:
        """Store the scheduler."""
        self.scheduler = scheduler

    def add_worker(self, scheduler: Any, worker: str) -> None:
        """Count a worker that joins, and the workers of each partition."""
        self.counts["joined"] += 1
        workers_of_partition = Counter(
            str(w.name).partition("-")[0] for w in scheduler.workers.values()
        )
        self.max_workers |= workers_of_partition

    def remove_worker(self, scheduler: Any, worker: str, **kwargs: Any) -> None:
        """Count a worker that leaves."""
        self.counts["left"] += 1

    def transition(
        self, key: Any, start: str, finish: str, *args: Any, stimulus_id: str, **kwargs: Any
    ) -> None:
        """Count a task that has to run again; this benchmark cancels no tasks."""
        if start == "processing" and finish not in ("memory", "erred"):
            self.counts["taken back"] += 1
        if start == "memory" and finish == "released" and "remove-worker" in stimulus_id:
            self.counts["lost"] += 1


def read_counts(dask_scheduler: Any = None) -> tuple[Counter[str], Counter[str]]:
    """Return the counts of events and the largest partition sizes; runs on the scheduler."""
    watched = dask_scheduler.plugins[Watched.name]
    return watched.counts, watched.max_workers


def run_task(partition: str, number: int) -> tuple[int, TaskRecord]:
    """Run a small task; return its number and the record of its execution."""
    return call_recorded("run", partition, int, number)


def waves(partition: Partition, sizes: Sequence[int], seed: int) -> list[tuple[int, TaskRecord]]:
    """Run tasks in waves; return their numbers and records."""
    rng = random.Random(f"{seed} {partition.name}")
    ran: list[tuple[int, TaskRecord]] = []
    for size in sizes:
        numbers = range(len(ran), len(ran) + size)
        ran += partition.map(partial(run_task, partition.name), numbers, chunk=1, ordered=False)
        time.sleep(rng.uniform(0.0, 4 * IDLE_S))
    return ran


def measure(tasks: int, rounds: int, seed: int) -> dict[str, Any]:
    """Run `tasks` tasks in `rounds` waves per partition; return figures about their placement."""
    rng = random.Random(seed)
    task_counts = {
        name: tasks // len(NAMES) + (n < tasks % len(NAMES)) for n, name in enumerate(NAMES)
    }
    sizes = {}
    for name, count in task_counts.items():
        cuts = sorted(rng.sample(range(1, count), rounds - 1))
        sizes[name] = [b - a for a, b in zip([0, *cuts], [*cuts, count], strict=True)]
    options = {"cores": 1, "processes": 1, "memory": "1GB", "log_directory": None}
    worker_arguments = ["--host", "127.0.0.1", "--no-dashboard", "--no-nanny"]
    with ProcessCluster(
        **options, worker_extra_args=worker_arguments, scheduler_options=SCHEDULER
    ) as cluster:
        adaptive = {"adapt": [0, MAX_WORKERS], "idle_s": IDLE_S}
        start_partitions(cluster, dict.fromkeys(NAMES, adaptive))
        with Client(cluster) as client, ThreadPoolExecutor(len(NAMES)) as threads:
            client.register_plugin(Watched())
            partitions = [Partition(name, client) for name in NAMES]
            began = time.monotonic()
            records_of_partitions = [
                *threads.map(lambda p: waves(p, sizes[p.name], seed), partitions)
            ]
            seconds = time.monotonic() - began
            while any(map(len, partitions)):  # all of them shrink to nothing
                time.sleep(0.2)
            counts, max_workers = client.run_on_scheduler(read_counts)
    for part, answers in zip(partitions, records_of_partitions, strict=True):
        assert sorted(number for number, _ in answers) == list(range(task_counts[part.name]))
    records = [record for answers in records_of_partitions for _, record in answers]
    elsewhere = [r for r in records if r.worker.partition("-")[0] != r.partition]
    return {
        "tasks": len(records),
        "misplaced": len(placement_violations(records)) + len(elsewhere),
        "taken_back": counts["taken back"] + counts["lost"],
        "workers_joined": counts["joined"],
        "workers_left": counts["left"],
        "most_workers": dict(max_workers),
        "workers_with_tasks": len({record.worker for record in records}),
        "seconds": round(seconds, 1),
    }


def main(arguments: list[str] | None = None) -> dict[str, Any]:
    """Run the benchmark; return its figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tasks", type=int, default=100_000)
    parser.add_argument("--waves", type=int, default=10, help="of each partition")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", type=Path, help="also write the figures to this file")
    options = parser.parse_args(arguments)
    figures = measure(options.tasks, options.waves, options.seed)
    print(
        f"{figures['misplaced']} of {figures['tasks']:,} tasks misplaced and "
        f"{figures['taken_back']} run again in {figures['seconds']} s, while "
        f"{figures['workers_joined']} workers joined and {figures['workers_left']} left; at most "
        f"{', '.join(f'{n} of {name}' for name, n in sorted(figures['most_workers'].items()))}"
    )
    if options.json:
        options.json.write_text(json.dumps(figures, indent=1) + "\n")
    return figures


if __name__ == "__main__":
    main()

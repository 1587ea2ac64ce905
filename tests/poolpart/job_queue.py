"""A stand-in for a queue: jobs of Slurm whose workers are in this process.

`tests/system/test_queues.py` has a real one.
"""

from __future__ import annotations

import asyncio
import itertools
import re
from pathlib import Path
from typing import Any

from distributed import Worker

SCHEDULER = {"host": "127.0.0.1", "port": 0, "dashboard": False, "dashboard_address": "127.0.0.1:0"}


class Queue:
    """A queue whose jobs begin at once, unless `held` is set."""

    def __init__(self) -> None:
        self.held = self.full = False
        self.refuses = ""  # name of a job
        self.refused = 0
        self.submitted: list[str] = []  # names of the jobs
        self.waiting: dict[str, str] = {}  # {number: name of a job that has not begun}
        self.workers: dict[str, list[Worker]] = {}  # {number: of a job that has begun}
        self.cancelled: list[str] = []  # names of jobs that had not begun
        self.scripts: dict[str, str] = {}  # {number: of a job}
        self._numbers = map(str, itertools.count())

    async def submit(self, job: Any, path: str) -> str:
        text = Path(path).read_text()
        name = re.search(r"--name (\S+)", text)[1]
        if self.full or name == self.refuses:
            self.refused += 1
            raise RuntimeError("the queue is full")
        number = next(self._numbers)
        self.submitted.append(name)
        self.waiting[number] = name
        self.scripts[number] = text
        self._scheduler = job._command_template.split("dask_worker ")[1].split()[0]
        if not self.held:
            await self.begin(number)
        return f"Submitted batch job {number}"

    async def begin(self, number: str) -> None:
        """Start the workers of a job."""
        name = self.waiting.pop(number)
        text = self.scripts[number]
        partition, slots = re.search(r"--resources (\w+)=(\d+)", text).groups()
        count = re.search(r"--nworkers (\d+)", text)
        names = [f"{name}-{n}" for n in range(int(count[1]))] if count else [name]
        options = {"nthreads": 2, "resources": {partition: int(slots)}, "dashboard": False}
        self.workers[number] = [
            await Worker(self._scheduler, name=worker_name, host="127.0.0.1", **options)
            for worker_name in names
        ]

    async def release(self) -> None:
        """Start the jobs that wait, and from now on each job at once."""
        self.held = False
        for number in list(self.waiting):
            await self.begin(number)

    async def close(self, job: Any, number: str, command: str) -> None:
        if number in self.waiting:
            self.cancelled.append(self.waiting.pop(number))
        for worker in self.workers.get(number, []):
            await asyncio.sleep(0.05)  # for its own end, or it logs an error
            await worker.close(timeout=1)  # a second call waits for the first
        self.workers.pop(number, None)

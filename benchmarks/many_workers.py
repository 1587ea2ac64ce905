"""Clusters with one process for the scheduler and one for all workers, used by benchmarks."""

from __future__ import annotations

import asyncio
import logging
import multiprocessing
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection
from typing import Any

import dask
import psutil
from distributed import Scheduler, Worker


async def run_scheduler(connection: Connection) -> None:
    """Run a scheduler until the connection closes."""
    options = {"host": "127.0.0.1", "port": 0, "dashboard_address": "127.0.0.1:0"}
    async with Scheduler(**options, dashboard=False) as scheduler:
        connection.send(scheduler.address)
        await asyncio.to_thread(connection.recv)


async def run_workers(
    connection: Connection,
    address: str,
    count: int,
    slots: tuple[str, int] | None = None,
    first: int = 0,
) -> None:
    """Run workers in this process, optionally with slots of a partition.

    Their names count from `first` on.
    """
    options = {"nthreads": 1, "dashboard": False, "memory_limit": 0, "host": "127.0.0.1"}
    kind = ""
    if slots is not None:
        kind, threads = slots
        options |= {"resources": {kind: threads}, "nthreads": threads}
    workers = [
        Worker(address, name=f"{kind}{number}", **options) for number in range(first, first + count)
    ]
    await asyncio.gather(*workers)
    connection.send(address)
    await asyncio.to_thread(connection.recv)
    await asyncio.gather(*(worker.close(nanny=False) for worker in workers))


def _serve(main: Callable[..., Any], connection: Connection, *arguments: Any) -> None:
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    # What 200 workers measure of themselves takes more than a core, where they share a process.
    rarely = {"admin.tick.interval": "10s", "admin.system-monitor.interval": "10s"}
    rarely |= {"worker.profile.enabled": False}
    dask.config.set({f"distributed.{name}": value for name, value in rarely.items()})
    asyncio.run(main(connection, *arguments))


@contextmanager
def process(main: Callable[..., Any], *arguments: Any) -> Iterator[tuple[psutil.Process, str]]:
    """Run `main` in a new process, and yield the process and the address that it reports."""
    context = multiprocessing.get_context("spawn")
    parent_end, child_end = context.Pipe()
    child = context.Process(target=_serve, args=(main, child_end, *arguments), daemon=True)
    child.start()
    child_end.close()  # so that the end of the process is the end of the pipe
    try:
        yield psutil.Process(child.pid), parent_end.recv()
        parent_end.send(None)
        child.join(30)
    finally:
        child.kill()
        child.join()

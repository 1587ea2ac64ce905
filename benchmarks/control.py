"""Measure the bytes that the scheduler and the driver exchange with other processes.

    python -m benchmarks.control [--scans N]

A survey runs on a local cluster whose scheduler is in the driver's process, so that this process
can count all of their messages by kind. The survey runs with every fifth point and with all points,
to show what grows with the number of points. It also runs with one scan per batch, to show the cost
of a batch.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any
from unittest.mock import patch

import distributed.comm.tcp as tcp
import numpy as np

import lidarpool.run.pipeline.policies
from lidarpool import Scene, Sensor, Survey, simulate

from .harness import argument_parser, write_results

# Messages that come with time and with workers, not with work.
UPKEEP = {"heartbeat", "setup", "transfers"}


class TrafficCounts:
    """Bytes of messages by message kind and local address."""

    def __init__(self) -> None:
        self._bytes: dict[str, Counter[str]] = {}  # {address here: {kind: bytes}}

    def add(self, message: Any, frames: list[Any]) -> None:
        """Add the bytes of a message."""
        counts_of_address = self._bytes.setdefault(_local_address.get(), Counter())
        counts_of_address[_kind(message)] += sum(memoryview(frame).nbytes for frame in frames)

    @property
    def scheduler(self) -> Counter[str]:
        """Bytes at the scheduler by message kind.

        All connections of the scheduler share a local address.
        """
        return max(self._bytes.values(), key=lambda counts: sum(counts.values()))

    def work(self, *, driver: bool = False) -> int:
        """Return the bytes of task messages at the scheduler, or at the driver if `driver`."""
        counts_by_address = self._bytes.values()
        counted = [
            counts for counts in counts_by_address if (counts is not self.scheduler) == driver
        ]
        return sum(n for counts in counted for kind, n in counts.items() if kind not in UPKEEP)


def _kind(message: Any) -> str:
    first = message[0] if isinstance(message, (list, tuple)) and message else message
    op = str(first.get("op", "answer")) if isinstance(first, dict) else "answer"
    if "heartbeat" in op:
        return "heartbeat"
    if op in ("register-worker", "register-client", "identity", "register_worker_plugin"):
        return "setup"
    return op


# Address at this end of a connection.
_local_address: ContextVar[str] = ContextVar("_local_address", default="")


@contextmanager
def count_traffic() -> Iterator[TrafficCounts]:
    """Count the bytes that this process sends and receives while the body runs."""
    counted = TrafficCounts()
    to_frames = tcp.to_frames
    from_frames = tcp.from_frames
    read = tcp.TCP.read
    write = tcp.TCP.write

    async def sent(message: Any, *args: Any, **kwargs: Any) -> Any:
        frames = await to_frames(message, *args, **kwargs)
        counted.add(message, frames)
        return frames

    async def received(frames: Any, *args: Any, **kwargs: Any) -> Any:
        message = await from_frames(frames, *args, **kwargs)
        counted.add(message, frames)
        return message

    async def reads(self: Any, *args: Any, **kwargs: Any) -> Any:
        _local_address.set(self.local_address)
        return await read(self, *args, **kwargs)

    async def writes(self: Any, *args: Any, **kwargs: Any) -> Any:
        _local_address.set(self.local_address)
        return await write(self, *args, **kwargs)

    with (
        patch.object(tcp, "to_frames", sent),
        patch.object(tcp, "from_frames", received),
        patch.object(tcp.TCP, "read", reads),
        patch.object(tcp.TCP, "write", writes),
    ):
        yield counted


def small_survey(scans: int, keep_every: int) -> Survey:
    sensor = Sensor.grid(rays_per_revolution=360, layers=32, step_deg=4)
    poses = [(0.01 * index, 0.0, 1.0) for index in range(-(-scans // 90))]
    return Survey(sensor, poses, steps=90, keep_every=keep_every)


def count_bytes(scans: int) -> dict[str, float]:
    """Print and return the scheduler's bytes per additional scan, and per scan with all points."""
    sides = {
        "every 5th point": (scans, 5),
        "all points": (scans, 1),
        "twice the scans": (2 * scans, 5),
    }
    work: dict[str, Counter[str]] = {}
    for side, (count, keep_every) in sides.items():
        survey = small_survey(count, keep_every)
        with count_traffic() as counted:
            result = simulate(Scene.seed(), survey)
        upkeep = sum(counted.scheduler[kind] for kind in UPKEEP)
        work[side] = Counter({k: n for k, n in counted.scheduler.items() if k not in UPKEEP})
        print(
            f"{side:16} {survey.scan_count:,} scans, {len(result.points):,} points: "
            f"{sum(work[side].values()) / 1e6:.2f} MB to and from the scheduler, including the "
            f"scene, plus {upkeep / 1e6:.2f} MB for heartbeats and setup"
        )
    base = work["every 5th point"]
    doubled = work["twice the scans"]
    points = work["all points"]
    for kind, count in (doubled - base).most_common(5):
        print(f"    {kind:24} {count / scans:6.1f} bytes per additional scan")
    scan_bytes, point_bytes = (
        (sum(counts.values()) - sum(base.values())) / scans for counts in (doubled, points)
    )
    print(
        f"each additional scan adds {scan_bytes:.0f} bytes; five times as many points add "
        f"{point_bytes:.0f} bytes per scan"
    )
    return {"bytes_a_scan": scan_bytes, "bytes_a_scan_of_points": point_bytes}


def single_scans() -> Any:
    """Return a patch that limits each batch to one scan.

    Tasks still contain several batches.
    """
    return patch.object(lidarpool.run.pipeline.policies, "scans_per_batch", lambda *_: 1)


def count_batches(batches: int) -> dict[str, float]:
    """Print and return the bytes per additional batch for the scheduler and the driver."""
    bytes_by_batches = {}
    for count in (batches, 3 * batches):
        with count_traffic() as counted, single_scans():
            simulate(Scene.seed(), small_survey(count, 5))
        bytes_by_batches[count] = counted.work(), counted.work(driver=True)
    scheduler, driver = (np.array(bytes_by_batches[3 * batches]) - bytes_by_batches[batches]) / (
        2 * batches
    )
    print(
        f"each additional batch of one scan adds {scheduler:,.0f} bytes at the scheduler and "
        f"{driver:,.0f} at the driver"
    )
    return {"scheduler_bytes": scheduler, "driver_bytes": driver}


def main(arguments: list[str] | None = None) -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("--scans", type=int, default=20_000)
    options = parser.parse_args(arguments)
    results = {
        "scans": count_bytes(options.scans),
        "batches": count_batches(min(360, options.scans)),
    }
    write_results(options.json, results)


if __name__ == "__main__":
    main()

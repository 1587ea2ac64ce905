"""Sections of the GPU benchmark that measure points with lidarpool, from rays to files."""

from __future__ import annotations

import multiprocessing
import os
import shutil
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from importlib.util import find_spec
from itertools import cycle
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

import lidarsim.simulator.points.device_columns
from lidarfiles.parts.parts import pack
from lidarpool import Pose, Scanner, Scene, Sensor, Survey, Track
from lidarscenes.procedural.city import city
from lidarsim.columns.part_columns import PartColumns
from lidarsim.io.storage import Storage
from lidarsim.scene.actors import Actor, box
from lidarsim.simulator.points.batch_columns import columns_of
from lidarsim.simulator.rig import Rig
from raybeam.device import CopyQueue

from .gpu_clock import Session, Sizes, Split, to_pinned

Rows = Iterator[tuple[str, dict[str, Any]]]
START = "spawn"  # how processes start; the tests fork
_PARTS = 8  # names of parts, which are written again and again
_ROOM = 4e9  # bytes


def survey(sizes: Sizes, seconds: float = 10.0) -> Survey:
    """Return a survey of an OS1-128 that moves along the street at 10 m/s."""
    positions = np.array([[-5.0, -1.8, 2.0], [5.0, -1.8, 2.0]]) * (seconds, 1, 1)
    sensor = Sensor.grid(sizes.rays // 128, 128, step_deg=360)
    drive = Track([0, seconds], positions)
    return Survey(sensor, trajectory=drive, keep_every=1, columns=["time", "range"])


def traffic(scene: Scene) -> Scene:
    """Add ten cars on the street to the scene."""
    trajectories = [Track([0, 10], [[k * 8 - 40, 3.6, 0], [k * 8 + 40, 3.6, 0]]) for k in range(10)]
    cars = (
        Actor(box(f"car {k}", (4.5, 1.8, 1.5)), trajectory)
        for k, trajectory in enumerate(trajectories)
    )
    return replace(scene, actors=tuple(cars))


def batches(rig: Rig, rays: int) -> Iterator[Callable[[], PartColumns]]:
    """Yield functions without end, each of which casts a batch and makes its columns."""
    spec = rig.survey.scan(0)
    size = max(1, rays // ((spec.firings[1] - spec.firings[0]) * spec.channels))
    count = rig.survey.scan_count
    for first in cycle(range(0, max(1, count - size + 1), size)):
        yield lambda first=first: columns_of(list(rig.cast(first, min(first + size, count))))


def time_batches(rig: Rig, rays: int, seconds: float) -> dict[str, Any]:
    """Make batches for `seconds`, and return points per second and times per batch."""
    casts = batches(rig, rays)
    part = next(casts)()
    times = []
    points = 0
    start = time.perf_counter()
    while len(times) < 3 or time.perf_counter() - start < seconds:
        began = time.perf_counter()
        points += len(next(casts)())
        times.append(time.perf_counter() - began)
    took = sum(times)
    stored_columns = [column for name, column in part.columns.items() if name != "sensor"]
    return {
        "mpoints_s": points / took / 1e6,
        "batch_points": points / len(times),
        "batch_ms": 1e3 * float(np.median(times)),
        "bytes_a_point": sum(column.itemsize for column in stored_columns),
    }


@contextmanager
def split_times(cupy: Any, rig: Rig) -> Iterator[Split]:
    """Measure the device times of kernels and column copies while the body runs."""
    split = Split(cupy)
    engine = rig.scene_casters[0].caster.engine
    run = engine._run  # type: ignore[attr-defined]
    kernel = lidarsim.simulator.points.device_columns._kernel
    send = CopyQueue.send

    def running(name: str, *arguments: Any) -> None:
        with split.timed(name):
            run(name, *arguments)

    def columns(*kernel_arguments: Any) -> Callable[..., None]:
        def launch(*arguments: Any) -> None:
            with split.timed("columns"):
                kernel(*kernel_arguments)(*arguments)

        return launch

    def sending(outbox: CopyQueue, pairs: Any) -> None:
        outbox._stream.wait_event(cupy.cuda.get_current_stream().record())
        with split.timed("copy", outbox._stream):
            send(outbox, pairs)

    with (
        patch.object(engine, "_run", running),
        patch.object(lidarsim.simulator.points.device_columns, "_kernel", columns),
        patch.object(CopyQueue, "send", sending),
    ):
        yield split


def columns(session: Session) -> Rows:
    """Yield the rates at which points arrive in host memory in several cases."""
    sizes = session.sizes
    bus = to_pinned(session)
    scene = city(sizes.cities[-1])
    plain = survey(sizes)
    rig = Rig(scene, plain, "cuda")
    for name, rays in {"plain": sizes.batch, "larger batches": 8 * sizes.batch}.items():
        row = time_batches(rig, rays, 3 * sizes.seconds)
        row["bus_share"] = row["mpoints_s"] * row["bytes_a_point"] / 1e3 / bus
        yield name, row
    engine: Any = rig.scene_casters[0].caster.engine
    for chunk in (1 << 16, 1 << 18):  # copies of a chunk run while the next is cast
        with patch.object(engine, "chunk", chunk):
            yield f"chunks of {chunk:,} rays", time_batches(rig, sizes.batch, sizes.seconds)
    yield "a batch, ms", split_batch(session, rig)
    fifth = replace(plain, keep_every=5)
    yield "every fifth point", time_batches(Rig(scene, fifth, "cuda"), sizes.batch, sizes.seconds)
    yield "bits", compare_columns(city(min(sizes.cities)), plain)
    if find_spec("numba") is None:  # finds hits on actors
        yield "ten actors", {"left out": "numba is not installed"}
        return
    row = time_batches(Rig(traffic(scene), plain, "cuda"), sizes.batch, 3 * sizes.seconds)
    yield "ten actors", row


def scanner(session: Session) -> Rows:
    """Yield the rates of a scanner in a loop that copies sweeps or range images to the host."""
    sizes = session.sizes
    sensor = Sensor.grid(sizes.rays // 128, 128, step_deg=360)
    device_scanner = Scanner(city(sizes.cities[-1]), sensor, columns=["range"], backend="cuda")
    poses = np.array([[-5.0, -1.8, 2.0], [5.0, -1.8, 2.0]])
    image = device_scanner.ranges(poses[:1])
    rays = image.size
    hits = int(np.isfinite(image).sum())
    calls: dict[str, tuple[int, Callable[[], object]]] = {
        "ranges of 16 poses": (16, lambda: device_scanner.ranges(np.repeat(poses, 8, axis=0))),
        "sweeps": (1, lambda: device_scanner.sweep(Pose(tuple(poses[0])))),
    }
    for name, (sweeps, call) in calls.items():
        count = max(3, sizes.sweeps // (2 * rays * sweeps))
        call()
        start = time.perf_counter()
        for _ in range(count):
            call()
        took = time.perf_counter() - start
        cast = count * sweeps * rays
        yield name, {"rays": cast, "hits": hits / rays, "grays_s": cast / took / 1e9}


def split_batch(session: Session, rig: Rig) -> dict[str, float]:
    """Return the time per batch of each kernel and in total, in milliseconds."""
    with split_times(session.cupy, rig) as split:
        count = 10
        casts = batches(rig, session.sizes.batch)
        start = time.perf_counter()
        for _ in range(count):
            next(casts)()
        wall = 1e3 * (time.perf_counter() - start) / count
        spent = {name: took / count for name, took in split.milliseconds().items()}
    return {**spent, "all": wall}


def compare_columns(scene: Scene, drive: Survey) -> dict[str, int]:
    """Count column values of a scan that differ between the device and NumPy."""
    scan = drive.scan_count // 2
    rigs = (Rig(scene, drive, backend) for backend in ("cuda", "numpy"))
    device_part, host_part = (columns_of(list(rig.cast(scan, scan + 1))) for rig in rigs)
    wrong = sum(
        int((device_part.columns[n] != host_part.columns[n]).sum()) for n in host_part.columns
    )
    return {"points": len(host_part), "different values": wrong}


def durable(session: Session) -> Rows:
    """Yield the rate of parts written to disk and to memory, with the best number of threads."""
    rig = Rig(city(session.sizes.cities[-1]), survey(session.sizes), "cuda")
    memory = "/dev/shm" if Path("/dev/shm").is_dir() else tempfile.gettempdir()
    for name, parent in {"memory": memory, "disk": session.folder}.items():
        if shutil.disk_usage(parent).free < _ROOM and session.sizes == Sizes():
            yield name, {"left out": f"less than {_ROOM / 1e9:.0f} GB are free in {parent}"}
            continue
        rows: list[dict[str, float]] = []
        threads = 1
        while threads <= 2 * (os.cpu_count() or 1):
            with tempfile.TemporaryDirectory(dir=parent) as folder:
                rows.append(_written(session, rig, Storage.at(folder), threads))
            threads *= 2
            if len(rows) > 1 and rows[-1]["mpoints_s"] < 1.1 * rows[-2]["mpoints_s"]:
                break
        yield name, {**max(rows, key=lambda row: row["mpoints_s"]), "tried": rows}


def _written(session: Session, rig: Rig, storage: Storage, threads: int) -> dict[str, float]:
    """Cast in this thread, and write parts in worker threads, as collectors do."""
    room = threading.Semaphore(2 * threads)
    sizes = []

    def write(part: PartColumns, name: str) -> None:
        try:
            pieces = pack(part)
            storage.write(name, pieces)
            sizes.append(sum(map(len, pieces)))
        finally:
            room.release()

    casts = batches(rig, session.sizes.batch)
    points = 0
    written = []
    next(casts)()
    start = time.perf_counter()
    with ThreadPoolExecutor(threads) as pool:
        while len(written) < 2 * threads or time.perf_counter() - start < 2 * session.sizes.seconds:
            room.acquire()
            part = next(casts)()
            points += len(part)
            written.append(pool.submit(write, part, f"{len(written) % _PARTS}.npz"))
        for future in written:
            future.result()
    took = time.perf_counter() - start
    return {"threads": threads, "mpoints_s": points / took / 1e6, "gb_s": sum(sizes) / took / 1e9}


def sharing(session: Session) -> Rows:
    """Yield the rate of points into host memory with two threads, one process and two processes."""
    rig = Rig(city(session.sizes.cities[-1]), survey(session.sizes), "cuda")
    with ThreadPoolExecutor(2) as pool:
        futures = [
            pool.submit(time_batches, rig, session.sizes.batch, session.sizes.seconds)
            for _ in range(2)
        ]
        yield "2 threads", {"mpoints_s": sum(future.result()["mpoints_s"] for future in futures)}
    del rig
    context = multiprocessing.get_context(START)
    totals = []
    for count in (1, 2):
        barrier = context.Barrier(count)
        rates_queue = context.Queue()
        started = [
            context.Process(target=_share, args=(session.sizes, barrier, rates_queue))
            for _ in range(count)
        ]
        for process in started:
            process.start()
        try:
            rates = [rates_queue.get(timeout=60) for _ in started]
        finally:
            for process in started:
                process.terminate()
                process.join()
        totals.append(sum(rates))
        yield f"{count} processes", {"mpoints_s": sum(rates)}
    yield "two to one", {"ratio": totals[1] / totals[0]}


def _share(sizes: Sizes, barrier: Any, rates_queue: Any) -> None:
    rig = Rig(city(sizes.cities[-1]), survey(sizes), "cuda")
    next(batches(rig, sizes.batch))()
    barrier.wait(60)
    rates_queue.put(time_batches(rig, sizes.batch, 3 * sizes.seconds)["mpoints_s"])


def run(session: Session) -> Rows:
    """Yield the rates of surveys on a local cluster, from rays to parts on disk."""
    from lidarpool import simulate

    # It turns ten times a second, once at least.
    drive = survey(session.sizes, max(0.1, session.sizes.survey / (10 * 1024 * 128)))
    for name, every in {"all points": 1, "every fifth point": 5}.items():
        kept_survey = replace(drive, keep_every=every)
        with tempfile.TemporaryDirectory(dir=session.folder) as folder:
            start = time.perf_counter()
            result = simulate(
                city(session.sizes.cities[-1]),
                kept_survey,
                backend="cuda",
                folder=Path(folder) / "run",
            )
            wall = time.perf_counter() - start
            points = len(result.points)
            row = {"rays": result.rays, "points": points, "wall_s": wall}
            row["mpoints_s"] = points / result.survey_seconds / 1e6
            row["grays_s"] = result.rays / result.survey_seconds / 1e9
            del result
        yield name, row

"""Sections of the device's benchmark that need lidarpool: points, from rays to files."""

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
from itertools import cycle
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

import lidarsim.simulator.device
from lidarpool import Scene, Survey, Track, load_sensor
from lidarpool.columns.parts import pack
from lidarscenes.procedural.city import city
from lidarsim.base.storage import Storage
from lidarsim.columns.part_columns import PartColumns
from lidarsim.scene.actors import Actor, box
from lidarsim.simulator.batch import columns_of
from lidarsim.simulator.rig import Rig
from raybeam import Outbox

from .gpu_clock import Here, Sizes, Split, to_pinned

Rows = Iterator[tuple[str, dict[str, Any]]]
START = "spawn"  # how processes start; the tests fork
_PARTS = 8  # names of parts, which are written again and again
_ROOM = 4e9  # bytes


def survey(sizes: Sizes, seconds: float = 10.0) -> Survey:
    """Make a drive of an OS1-128 at 10 m/s along the street."""
    way = np.array([[-5.0, -1.8, 2.0], [5.0, -1.8, 2.0]]) * (seconds, 1, 1)
    sensor = load_sensor("ouster/os1-128", step_deg=sizes.step_deg)
    drive = Track([0, seconds], way)
    return Survey(sensor, trajectory=drive, keep_every=1, columns=["time", "range"])


def traffic(scene: Scene) -> Scene:
    """Put ten cars on the street."""
    ways = [Track([0, 10], [[k * 8 - 40, 3.6, 0], [k * 8 + 40, 3.6, 0]]) for k in range(10)]
    cars = (Actor(box(f"car {k}", (4.5, 1.8, 1.5)), way) for k, way in enumerate(ways))
    return replace(scene, actors=tuple(cars))


def batches(rig: Rig, rays: int) -> Iterator[Callable[[], PartColumns]]:
    """Give functions that cast a batch, and make its columns as a GPU worker does; for ever."""
    spec = rig.survey.scan(0)
    size = max(1, rays // ((spec.firings[1] - spec.firings[0]) * spec.channels))
    count = rig.survey.scan_count
    for first in cycle(range(0, max(1, count - size + 1), size)):
        yield lambda first=first: columns_of(list(rig.cast(first, min(first + size, count))))


def timed(rig: Rig, rays: int, seconds: float) -> dict[str, Any]:
    """Make batches for so many seconds."""
    made = batches(rig, rays)
    part = next(made)()
    times = []
    points = 0
    start = time.perf_counter()
    while len(times) < 3 or time.perf_counter() - start < seconds:
        began = time.perf_counter()
        points += len(next(made)())
        times.append(time.perf_counter() - began)
    took = sum(times)
    kept = [column for name, column in part.columns.items() if name != "sensor"]
    return {
        "mpoints_s": points / took / 1e6,
        "batch_points": points / len(times),
        "batch_ms": 1e3 * float(np.median(times)),
        "bytes_a_point": sum(column.itemsize for column in kept),
    }


@contextmanager
def watched(cupy: Any, rig: Rig) -> Iterator[Split]:
    """Take the times of kernels and of copies of columns."""
    split = Split(cupy)
    engine = rig.scene_caster.caster.engine
    run = engine._run  # type: ignore[attr-defined]
    kernel = lidarsim.simulator.device._kernel
    send = Outbox.send

    def running(name: str, *given: Any) -> None:
        with split.timed(name):
            run(name, *given)

    def columns(*given: Any) -> Callable[..., None]:
        def launch(*arguments: Any) -> None:
            with split.timed("columns"):
                kernel(*given)(*arguments)

        return launch

    def sending(outbox: Outbox, pairs: Any) -> None:
        outbox._stream.wait_event(cupy.cuda.get_current_stream().record())
        with split.timed("copy", outbox._stream):
            send(outbox, pairs)

    with (
        patch.object(engine, "_run", running),
        patch.object(lidarsim.simulator.device, "_kernel", columns),
        patch.object(Outbox, "send", sending),
    ):
        yield split


def columns(here: Here) -> Rows:
    """Points a second into host memory: a plain survey, larger batches, and ten actors."""
    sizes = here.sizes
    bus = to_pinned(here)
    scene = city(sizes.cities[-1])
    plain = survey(sizes)
    rig = Rig(scene, plain, "cuda")
    for name, rays in {"plain": sizes.batch, "larger batches": 8 * sizes.batch}.items():
        row = timed(rig, rays, 3 * sizes.seconds)
        row["bus_share"] = row["mpoints_s"] * row["bytes_a_point"] / 1e3 / bus
        yield name, row
    engine: Any = rig.scene_caster.caster.engine
    for chunk in (1 << 16, 1 << 18):  # copies of a chunk run while the next is cast
        with patch.object(engine, "chunk", chunk):
            yield f"chunks of {chunk:,} rays", timed(rig, sizes.batch, sizes.seconds)
    with watched(here.cupy, rig) as split:
        count = 10
        made = batches(rig, sizes.batch)
        start = time.perf_counter()
        for _ in range(count):
            next(made)()
        wall = 1e3 * (time.perf_counter() - start) / count
        spent = {name: took / count for name, took in split.milliseconds().items()}
    yield "a batch, ms", {**spent, "all": wall}
    fifth = replace(plain, keep_every=5)
    yield "every fifth point", timed(Rig(scene, fifth, "cuda"), sizes.batch, sizes.seconds)
    row = timed(Rig(traffic(scene), plain, "cuda"), sizes.batch, 3 * sizes.seconds)
    yield "ten actors", row
    few = city(min(sizes.cities))
    turn = plain.scan_count // 2
    rigs = (Rig(few, plain, backend) for backend in ("cuda", "numpy"))
    mine, other = (columns_of(list(rig.cast(turn, turn + 1))) for rig in rigs)
    wrong = sum(int((mine.columns[n] != other.columns[n]).sum()) for n in other.columns)
    yield "bits", {"points": len(other), "different values": wrong}


def durable(here: Here) -> Rows:
    """Points a second in parts on a disk and in memory, by as many threads as make it faster."""
    rig = Rig(city(here.sizes.cities[-1]), survey(here.sizes), "cuda")
    memory = "/dev/shm" if Path("/dev/shm").is_dir() else tempfile.gettempdir()
    for name, place in {"memory": memory, "disk": here.folder}.items():
        if shutil.disk_usage(place).free < _ROOM and here.sizes == Sizes():
            yield name, {"left out": f"less than {_ROOM / 1e9:.0f} GB are free in {place}"}
            continue
        rows: list[dict[str, float]] = []
        threads = 1
        while threads <= 2 * (os.cpu_count() or 1):
            with tempfile.TemporaryDirectory(dir=place) as folder:
                rows.append(_written(here, rig, Storage.at(folder), threads))
            threads *= 2
            if len(rows) > 1 and rows[-1]["mpoints_s"] < 1.1 * rows[-2]["mpoints_s"]:
                break
        yield name, {**max(rows, key=lambda row: row["mpoints_s"]), "tried": rows}


def _written(here: Here, rig: Rig, storage: Storage, threads: int) -> dict[str, float]:
    """Cast in this thread, and make and write parts in others, as collectors do."""
    room = threading.Semaphore(2 * threads)
    sizes = []

    def write(part: PartColumns, name: str) -> None:
        try:
            data = pack(part)
            storage.write(name, data)
            sizes.append(len(data))
        finally:
            room.release()

    made = batches(rig, here.sizes.batch)
    points = 0
    written = []
    next(made)()
    start = time.perf_counter()
    with ThreadPoolExecutor(threads) as pool:
        while len(written) < 2 * threads or time.perf_counter() - start < 2 * here.sizes.seconds:
            room.acquire()
            part = next(made)()
            points += len(part)
            written.append(pool.submit(write, part, f"{len(written) % _PARTS}.npz"))
        for future in written:
            future.result()
    took = time.perf_counter() - start
    return {"threads": threads, "mpoints_s": points / took / 1e6, "gb_s": sum(sizes) / took / 1e9}


def sharing(here: Here) -> Rows:
    """Points a second into host memory: two threads, one process, two that share the device."""
    rig = Rig(city(here.sizes.cities[-1]), survey(here.sizes), "cuda")
    with ThreadPoolExecutor(2) as pool:
        both = [pool.submit(timed, rig, here.sizes.batch, here.sizes.seconds) for _ in range(2)]
        yield "2 threads", {"mpoints_s": sum(found.result()["mpoints_s"] for found in both)}
    del rig
    context = multiprocessing.get_context(START)
    totals = []
    for count in (1, 2):
        barrier = context.Barrier(count)
        out = context.Queue()
        started = [
            context.Process(target=_share, args=(here.sizes, barrier, out)) for _ in range(count)
        ]
        for process in started:
            process.start()
        try:
            rates = [out.get(timeout=60) for _ in started]
        finally:
            for process in started:
                process.terminate()
                process.join()
        totals.append(sum(rates))
        yield f"{count} processes", {"mpoints_s": sum(rates)}
    yield "two to one", {"ratio": totals[1] / totals[0]}


def _share(sizes: Sizes, barrier: Any, out: Any) -> None:
    rig = Rig(city(sizes.cities[-1]), survey(sizes), "cuda")
    next(batches(rig, sizes.batch))()
    barrier.wait(60)
    out.put(timed(rig, sizes.batch, 3 * sizes.seconds)["mpoints_s"])


def run(here: Here) -> Rows:
    """Run a survey with its cluster, from rays to parts on the disk."""
    from lidarpool import simulate

    drive = survey(here.sizes, here.sizes.survey / (10 * 1024 * 128))  # it turns ten times a second
    for name, every in {"all points": 1, "every fifth point": 5}.items():
        given = replace(drive, keep_every=every)
        with tempfile.TemporaryDirectory(dir=here.folder) as folder:
            start = time.perf_counter()
            result = simulate(
                city(here.sizes.cities[-1]), given, backend="cuda", folder=Path(folder) / "run"
            )
            wall = time.perf_counter() - start
            points = len(result.points)
            row = {"rays": result.rays, "points": points, "wall_s": wall}
            row["mpoints_s"] = points / result.survey_seconds / 1e6
            row["grays_s"] = result.rays / result.survey_seconds / 1e9
            del result
        yield name, row

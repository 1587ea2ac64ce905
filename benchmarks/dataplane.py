"""Compare the rate at which points reach the cloud file with plain writing of the same bytes.

    python -m benchmarks.dataplane [--points 16e6] [--folder FOLDER]

A local cluster runs the real pipeline up to cloud.ply and report.json, but the casting workers
return columns that are already in their memory. After each run, files of the same sizes as the
parts and the cloud are written plainly twice, and flushed as often. One thread also packs parts,
and packs and writes parts, as a collector does.

A small run that is not measured imports what the processes need. CPU times are those of whole
processes, and the driver's process contains the scheduler. Bytes are counted when system calls read
or write files, and when casting workers send results to collectors. `--folder /dev/shm` keeps all
files in memory.
"""

from __future__ import annotations

import os
import shutil
import statistics
import tempfile
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import psutil
from distributed import Client

from lidarfiles.parts.parts import pack
from lidarpool import Scene, Sensor, Survey
from lidarpool.report.output import CLOUD, SurveyOutput, run_survey
from lidarpool.run.cluster.cluster import local_client
from lidarpool.run.cluster.requirements import slots_needed
from lidarpool.run.job_source import SingleJob
from lidarpool.run.options import RunOptions
from lidarpool.run.pipeline import stage2_intersect as stage
from lidarpool.run.pipeline.stage_messages import Receipt
from lidarpool.run.pipeline.stage_names import GPU, INTERSECT, LIDAR
from lidarpool.run.pipeline.task_records import Recorder
from lidarpool.run.progress import Screen
from lidarpool.run.run_page import RunPage
from lidarpool.run.store.run_store import RUN_FOLDER
from lidarscenario.job import Job
from lidarscenario.sections import TaskOptions
from lidarsim.columns.part_columns import PartColumns
from lidarsim.io.storage import Storage
from lidarsim.scene.actors import box
from lidarsim.simulator.points.batch_columns import columns_of
from lidarsim.simulator.rig import Rig
from poolpart.workers import worker_identities

from .harness import argument_parser, cpu_seconds, write_results

HALL = Scene.from_meshes([box("Hall", (160, 120, 30))])  # all rays hit
_PIECE_BYTES = 1 << 25  # written at a time to the cloud
_BESIDE = {
    "plain": "plain writing of the same bytes",
    "pack": "packing parts in one thread",
    "pack_and_write": "packing and writing parts in one thread",
}
_PROCESSES = {GPU: "casting", LIDAR: "collectors"}


@dataclass(frozen=True)
class Sizes:
    """Sizes of the measured survey and its cluster."""

    points: int = 16_000_000
    rays_per_scan: int = 131_072
    collectors: int = 2
    casting: int = 1

    @property
    def scans(self) -> int:
        """Number of scans, at least 2."""
        return max(2, round(self.points / self.rays_per_scan))


QUICK = Sizes(points=16_000, rays_per_scan=1_024)


def still_survey(sizes: Sizes, scans: int) -> Survey:
    """Return a survey whose scans are whole revolutions in the hall, with range and intensity."""
    layers = 64 if sizes.rays_per_scan >= 1 << 16 else 8
    sensor = Sensor.grid(
        rays_per_revolution=sizes.rays_per_scan // layers, layers=layers, step_deg=360
    )
    poses = [(0.0, 0.0, 1.0)] * scans
    return Survey(sensor, poses, steps=1, columns=["range", "intensity"])


# -- the casting stage that replays columns ------------------------------------------------------


def replay_casting(dask_worker: Any) -> None:
    """Let a casting worker return columns that are already in memory.

    Only the first scan of a run is cast. The columns of several scans repeat its columns, and
    batches are views of these.
    """
    dask_worker.transfer_outgoing_log = deque()  # of all transfers, not only of the last
    cast_batch = stage.cast_batch
    prepared: dict[str, list[PartColumns]] = {}  # {handle of a rig: one scan, and more scans}

    def replay(rig: Rig, work: stage.CastWork, first: int, stop: int) -> stage.CastBatch:
        recorder = Recorder(INTERSECT, GPU)
        scans = stop - first
        if work.handle not in prepared:
            prepared.clear()
            prepared[work.handle] = [cast_batch(rig, work, 0, 1).part]
        parts = prepared[work.handle]
        if len(parts[-1].counts) < scans:
            parts[1:] = [repeated(parts[0], scans)]
        part = first_scans(parts[-1], first, scans)
        return stage.CastBatch(work.job, part, recorder.finish(scans))

    stage.cast_batch = replay


def repeated(part: PartColumns, scans: int) -> PartColumns:
    """Return a part that repeats a part of one scan `scans` times."""
    return replace(
        part,
        counts=np.tile(part.counts, scans),
        columns={name: np.tile(values, scans) for name, values in part.columns.items()},
        scan_hits=np.tile(part.scan_hits, scans),
        samples=np.tile(part.samples, (scans, 1, 1)),
    )


def first_scans(part: PartColumns, first: int, scans: int) -> PartColumns:
    """Return the first `scans` scans of a part, numbered from `first`.

    The columns of the result are views.
    """
    rows = int(part.counts[:scans].sum())
    return replace(
        part,
        first=first,
        counts=part.counts[:scans],
        columns={name: values[:rows] for name, values in part.columns.items()},
        scan_hits=part.scan_hits[:scans],
        samples=part.samples[:scans],
    )


# -- the run --------------------------------------------------------------------------------------


class CountingPage(RunPage):
    """Run page that records the sizes of the parts."""

    def __init__(self) -> None:
        self.part_sizes: list[int] = []  # bytes of each committed part

    def on_parts(self, receipts: Sequence[Receipt]) -> None:
        """Record the sizes of committed parts."""
        self.part_sizes += [part.size for part in receipts]


@dataclass(frozen=True)
class Usage:
    """CPU time, file bytes and memory of all processes of a kind."""

    cpu_s: float  # processor time
    read: int  # bytes that were read from files
    written: int  # bytes that were written to files
    peak_mb: float  # most memory so far

    @classmethod
    def of(cls, processes: Sequence[psutil.Process]) -> Usage:
        """Return the total usage of the given processes."""
        counters = [process.io_counters() for process in processes]
        return cls(
            sum(map(cpu_seconds, processes)),
            sum(c.read_chars for c in counters),
            sum(c.write_chars for c in counters),
            sum(_peak_bytes(process.pid) for process in processes) / 1e6,
        )


def _peak_bytes(pid: int) -> int:
    lines = Path(f"/proc/{pid}/status").read_text(encoding="ascii").splitlines()
    return next(int(line.split()[1]) << 10 for line in lines if line.startswith("VmHWM"))


def sent_bytes(dask_worker: Any) -> int:
    """Return the number of bytes that a worker has sent with results."""
    return sum(transfer["compressed"] for transfer in dask_worker.transfer_outgoing_log)


class Cluster:
    """Local cluster whose casting workers replay columns."""

    def __init__(self, client: Client, sizes: Sizes) -> None:
        self._client = client
        self._sizes = sizes
        pids = client.run(os.getpid)
        self._casting: list[str] = []  # addresses
        self._processes = {"driver": [psutil.Process()]}
        for address, worker in worker_identities(client).items():
            (partition,) = worker["resources"]
            process = psutil.Process(pids[address])
            self._processes.setdefault(_PROCESSES[partition], []).append(process)
            if partition == GPU:
                self._casting.append(address)
        client.run(replay_casting, workers=self._casting)

    def usage(self) -> dict[str, Usage]:
        """Return the usage by process kind."""
        return {name: Usage.of(processes) for name, processes in self._processes.items()}

    def sent(self) -> int:
        """Return the number of bytes that casting workers have sent so far."""
        return sum(self._client.run(sent_bytes, workers=self._casting).values())

    def run(self, folder: Path, scans: int) -> tuple[int, float, CountingPage]:
        """Run a survey in a folder.

        Return its number of points, the seconds until stage 4 ended, and its page.
        """
        survey = still_survey(self._sizes, scans)
        output = SurveyOutput(folder, survey, (), "cloud")
        options = RunOptions(
            client=self._client,
            folder=folder / RUN_FOLDER,
            collectors=self._sizes.collectors,
        )
        jobs = SingleJob(Job(HALL, survey, None))
        screen = Screen(lambda _: None)
        page = CountingPage()
        result, _ = run_survey(jobs, options, output, screen, page)
        return len(result.points), result.survey_seconds, page


@contextmanager
def replaying_cluster(sizes: Sizes) -> Iterator[Cluster]:
    """Start a cluster and yield it.

    A small survey runs first, so that all processes have imported what they need.
    """
    slots = slots_needed(TaskOptions(collectors=sizes.collectors), planning=False)
    with (
        local_client(slots, gpu_workers=sizes.casting) as client,
        tempfile.TemporaryDirectory() as folder,
    ):
        cluster = Cluster(client, sizes)
        cluster.run(Path(folder) / "first", min(sizes.scans, 20))
        yield cluster


def measure_run(cluster: Cluster, sizes: Sizes, folder: Path) -> tuple[dict[str, Any], list[int]]:
    """Run a survey and return its results and file sizes.

    The file sizes are those of the parts, followed by that of the cloud.
    """
    before = cluster.usage()
    sent = cluster.sent()
    start = time.perf_counter()
    points, survey_s, page = cluster.run(folder, sizes.scans)
    wall_s = time.perf_counter() - start
    after = cluster.usage()
    processes = {
        name: {
            "ns": 1e9 * (usage.cpu_s - before[name].cpu_s) / points,
            "read": (usage.read - before[name].read) / points,
            "written": (usage.written - before[name].written) / points,
            "peak_mb": usage.peak_mb,
        }
        for name, usage in after.items()
    }
    figures = {
        "points": points,
        "wall_s": wall_s,
        "mpoints_s": points / wall_s / 1e6,
        "survey_mpoints_s": points / survey_s / 1e6,
        "sent": (cluster.sent() - sent) / points,
        "ns": sum(process["ns"] for process in processes.values()),
        "processes": processes,
    }
    return figures, [*page.part_sizes, (folder / CLOUD).stat().st_size]


# -- beside it ------------------------------------------------------------------------------------


class Spent(NamedTuple):
    """Elapsed time and CPU time of function calls."""

    wall_s: float
    cpu_s: float  # processor time of the thread


def spent_in(call: Callable[[], object], count: int = 1) -> Spent:
    """Call a function `count` times in this thread and return the time spent."""
    start_s = time.perf_counter()
    start_cpu_s = time.thread_time()
    for _ in range(count):
        call()
    return Spent(time.perf_counter() - start_s, time.thread_time() - start_cpu_s)


def write_plainly(folder: Path, sizes: Sequence[int]) -> Spent:
    """Write and flush files of the given sizes, and return the time spent.

    The last file is written in pieces.
    """
    folder.mkdir()
    content = memoryview(np.random.default_rng(0).bytes(max(_PIECE_BYTES, *sizes[:-1])))
    *parts, cloud = sizes
    pieces = [min(_PIECE_BYTES, cloud - start) for start in range(0, cloud, _PIECE_BYTES)]

    def write() -> None:
        for number, file_pieces in enumerate([*([size] for size in parts), pieces]):
            with (folder / str(number)).open("xb", buffering=0) as file:
                for size in file_pieces:
                    written = 0
                    while written < size:
                        written += file.write(content[written:size]) or 0
                os.fsync(file.fileno())

    spent = spent_in(write)
    shutil.rmtree(folder)
    return spent


def pack_alone(part: PartColumns, folder: Path, points: int) -> dict[str, float]:
    """Pack parts in this thread, with and without writing them; return rates and CPU times."""
    storage = Storage.at(folder)
    storage.prepare()
    count = max(1, points // len(part))
    calls: dict[str, Callable[[], object]] = {
        "pack": lambda: pack(part),
        "pack_and_write": lambda: storage.write("part.npz", pack(part)),
    }
    figures = {}
    for name, call in calls.items():
        call()
        spent = spent_in(call, count)
        figures[f"{name}_mpoints_s"] = count * len(part) / spent.wall_s / 1e6
        figures[f"{name}_ns"] = 1e9 * spent.cpu_s / (count * len(part))
    storage.remove(["part.npz"], folder=True)
    return figures


def measure_round(
    cluster: Cluster, sizes: Sizes, part: PartColumns, folder: Path
) -> dict[str, Any]:
    """Measure one run, and plain writing of the same bytes after the run."""
    figures, file_sizes = measure_run(cluster, sizes, folder / "result")
    points = figures["points"]
    after = write_plainly(folder / "after", file_sizes)
    (folder / "result" / CLOUD).unlink()
    again = write_plainly(folder / "again", file_sizes)
    plain_s = (after.wall_s + again.wall_s) / 2
    figures["plain_mpoints_s"] = points / plain_s / 1e6
    figures["plain_ns"] = 1e9 * (after.cpu_s + again.cpu_s) / 2 / points
    figures["to_plain"] = plain_s / figures["wall_s"]
    figures["file_bytes"] = sum(file_sizes) / points
    return {**figures, **pack_alone(part, folder / "alone", points)}


def medians(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return the median of each value over the rounds."""
    return {
        name: medians([row[name] for row in rows])
        if isinstance(value, dict)
        else statistics.median(row[name] for row in rows)
        for name, value in rows[0].items()
    }


def report(figures: dict[str, Any], sizes: Sizes, repeat: int) -> None:
    print(
        f"{figures['points']:,.0f} points, casting workers: {sizes.casting}, collectors: "
        f"{sizes.collectors}, medians of {repeat} rounds"
    )
    print(
        f"survey: {figures['mpoints_s']:.2f} million points/s from start to end, "
        f"{figures['survey_mpoints_s']:.2f} until the last part; {figures['to_plain']:.2f} x the "
        f"rate of plain writing of the same {figures['file_bytes']:.1f} bytes per point"
    )
    for name, words in _BESIDE.items():
        print(
            f"  {words}: {figures[f'{name}_mpoints_s']:.1f} million points/s, "
            f"{figures[f'{name}_ns']:.1f} ns of CPU time per point"
        )
    print(f"CPU time per point: {figures['ns']:.0f} ns")
    for name, process in figures["processes"].items():
        print(
            f"  {name:11} {process['ns']:6.1f} ns, {process['read']:6.1f} bytes read and "
            f"{process['written']:6.1f} bytes written, peak memory {process['peak_mb']:,.0f} MB"
        )
    print(f"  casting workers sent {figures['sent']:.1f} bytes per point")


def main(arguments: list[str] | None = None) -> dict[str, Any]:
    """Measure all rounds, then print and return the medians."""
    parser = argument_parser(__doc__, repeat=3, quick=True)
    parser.add_argument("--points", type=lambda text: int(float(text)), default=Sizes.points)
    parser.add_argument("--collectors", type=int, default=Sizes.collectors)
    parser.add_argument("--casting", type=int, default=Sizes.casting, help="casting workers")
    parser.add_argument("--folder", type=Path, help="folder for files, on a disk or in /dev/shm")
    options = parser.parse_args(arguments)
    sizes = Sizes(options.points, collectors=options.collectors, casting=options.casting)
    repeat = options.repeat
    if options.quick:
        sizes = QUICK
        repeat = 1
    rig = Rig(HALL, still_survey(sizes, 1), "auto")
    part = repeated(replace(columns_of(list(rig.cast(0, 1))), **_of_scans()), 7)
    with replaying_cluster(sizes) as cluster:
        rows = []
        for _ in range(repeat):
            with tempfile.TemporaryDirectory(dir=options.folder) as folder:
                rows.append(measure_round(cluster, sizes, part, Path(folder)))
    results = medians(rows)
    report(results, sizes, repeat)
    write_results(options.json, rows)
    return results


def _of_scans() -> dict[str, Any]:
    """Return the arrays that casting tasks add to the columns of one scan."""
    return {"scan_hits": np.zeros(1, np.uint32), "samples": np.zeros((1, 4, 3), np.float32)}


if __name__ == "__main__":
    main()

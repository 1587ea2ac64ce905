"""What a run would do and need, estimated without starting anything."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from dask.system import CPU_COUNT
from dask.utils import format_bytes
from distributed import Client
from distributed.system import MEMORY_LIMIT

from lidarsim.base.errors import LidarError, Mistakes
from lidarsim.base.storage import Storage
from lidarsim.base.words import plural
from lidarsim.columns.cloud import CHUNK_POINTS
from lidarsim.scene.scene import Scene
from lidarsim.scene.simplified import DRAWN_TRIANGLES
from lidarsim.sensor import Survey
from lidarsim.simulator.memory import (
    INSTANCE,
    MB,
    SCENE_TRIANGLE,
    cast_bytes,
    rig_bytes,
    scans_that_fit,
)
from lidarsim.simulator.sampling import sample_survey
from lidarsim.simulator.scene_caster import check_backend_here
from poolpart import Pool
from poolpart.probe import visible_gpus
from raybeam import available_backends

from ..export.navigation_files import instrument_bytes
from ..scenario.build import Job
from ..scenario.empty_cloud import EMPTY, empty_cloud_reason
from .cluster.checks import check_memory, check_workers, find_workers, gpu_note, slots_needed
from .cluster.connection import default_workers
from .options import RunOptions
from .pipeline.names import GPU, LIDAR, OTHER
from .pipeline.policies import max_scans_per_batch
from .store.database import FILE
from .store.run_store import RUN_FOLDER

# Measured on Linux: a process of ours with Dask loaded.
PROCESS_BYTES = 300 << 20  # 110 MiB of these for numba, which compiles what calls Embree
PARTICLE_BYTES = 140  # of a swarm, for each corner of its path
PART_BYTES = 2500  # of a part's head, and of its row in the database
FIRST_PARTS = 60  # parts of a scan or a few, written before batches become large
SCAN_BYTES = 64  # of a scan in the driver
SUMMARY_BYTES = 28  # of a scan in the database
FORMAT_BYTES = 30  # of a point in an exported file, beside its columns, at most: LAS
ROOM_BYTES = 32 << 20  # for pictures and report
TRAJECTORY_POSES = 1000  # by which the length of a trajectory is measured
_FINE = 1e-6  # edges below this share of a mesh's size are beyond float32


def forecast(
    job: Job,
    options: RunOptions,
    client: Client | None = None,
    *,
    refuse: Callable[[], object] | None = None,
) -> dict[str, Any]:
    """Estimate the scans, rays, points, memory and disk of a run, and whether the run is possible.

    The run is on the cluster of `client`, on the cluster that `options` describe, or on a cluster
    of this machine. No cluster is started, and nothing is written into the folder of the result.
    `refuse` raises a LidarError if that folder holds another result.

    Returns
    -------
    dict
        Plain data for JSON, sizes in bytes. `reasons` say why it cannot run, each with what to
        do. `memory` is of all processes on this machine, or, on another cluster, of a GPU worker.
    """
    out = options.out
    formats = job.outputs
    assert out is not None, "commands write"
    mistakes = Mistakes()
    notes: list[str] = []
    warnings: list[str] = []
    with mistakes.noted():
        notes += _folder_notes(out)
    occupied = bool(notes)  # an unfinished run
    if refuse is not None:
        try:
            refuse()
        except LidarError as error:
            notes.append(str(error).rstrip("."))
            occupied = True
    for file_format in formats:
        with mistakes.noted():
            file_format.check_installed()
    cluster = _cluster_of(job, options, client, mistakes, notes)
    backend = cluster.backend
    estimate = None
    # Casting here needs as much memory as on a worker: it would fail or be killed.
    if _worker_bytes(job) + cast_bytes(job.scene, job.survey) <= MEMORY_LIMIT:
        estimate = sample_survey(job.scene, job.survey)
        if not estimate["hits"]:
            warnings.append(f"{EMPTY}: {empty_cloud_reason(job.scene, job.survey)}")
    if backend == "embree":
        notes += _fine_triangle_notes(job.scene)
    # Without an estimate every ray may hit.
    points = estimate["points"] if estimate else job.survey.ray_count // job.survey.keep_every
    # Scans of the largest batches; small ones take less.
    fit = scans_that_fit(job.scene, job.survey, options.batch_mb * MB, on_device=backend == "cuda")
    batch = max_scans_per_batch(fit, job.survey.scan_count, max(1, cluster.slots[GPU]["there"]))
    disk = _disk(job, points, batch, len(formats), out)
    stored = isinstance(out, Storage)
    disk_needed = disk["result"] + (0 if stored else disk["parts"])
    if disk["free"] < disk_needed:
        mistakes.lines.append(
            f"The disk of {disk['folder']} has {format_bytes(disk['free'])} free, and the run "
            f"needs about {format_bytes(disk_needed)}: make room, name another folder with "
            f"{'TMPDIR' if stored else '--out'}, or take a larger keep_every."
        )
    needed = _bytes_needed(job, points, batch, cluster, local=options.own and client is None)
    if cluster.memory and cluster.memory < needed:
        mistakes.lines.append(
            f"There are {format_bytes(cluster.memory)} of memory, and the run needs about "
            f"{format_bytes(needed)}: take a smaller scene, fewer casting workers (pool.gpu), a "
            "smaller batch_mb, rays_per_revolution or planning.particles, or a machine with more."
        )
    return {
        "can_run": not mistakes.lines,
        "reasons": mistakes.lines,
        "occupied": occupied,  # whether the place of the result holds another one
        "notes": notes,
        "warnings": warnings,
        "objects": len(job.scene.all_names),
        "triangles": job.scene.triangles,
        "masked": list(job.scene.masked),
        "bounds": (job.scene.bounds + job.scene.origin).tolist(),
        "poses": job.survey.path.stations,
        "drive": _drive(job.survey),
        "scans": job.survey.scan_count,
        "rays": job.survey.ray_count,
        "estimate": estimate,
        "precision_m": job.survey.precision_m,
        "trials": job.trials,
        "backend": backend,
        "casters": cluster.casters,
        "slots": cluster.slots,
        "memory": {"needed": needed, "there": cluster.memory or None},
        "disk": disk,
    }


class _Cluster(NamedTuple):
    """The cluster of a run, as far as the cluster is known."""

    slots: dict[str, dict[str, int]]  # {partition: {"needed": …, "there": …}}
    casters: int  # casting workers
    backend: str | None  # None if not known yet
    memory: int  # bytes; 0 for machines that are not started yet


def _cluster_of(
    job: Job, options: RunOptions, client: Client | None, mistakes: Mistakes, notes: list[str]
) -> _Cluster:
    """Return the cluster of `client`, or the cluster that `options` describe."""
    required = slots_needed(options, planning=job.planning is not None)
    casting = None
    backend = None
    memory = 0
    if (file := options.cluster) is not None:
        present = file.slots
        with mistakes.noted():
            file.require(required)
    elif client is not None:
        held = [worker.resources for worker in Pool.from_client(client)]
        present = {name: int(sum(slots.get(name, 0) for slots in held)) for name in required}
        with mistakes.noted():
            everybody, casting, backend, _ = find_workers(client, required, options.backend)
            check_workers(job, options, backend, casting)
            memory = min((worker.memory for worker in casting if worker.memory), default=0)
            notes += filter(None, [gpu_note(everybody, casting, backend)])
    else:
        workers = default_workers(CPU_COUNT, len(visible_gpus()))
        present = {
            GPU: options.gpu_workers or workers[GPU],
            OTHER: options.other_workers or workers[OTHER],
            LIDAR: required[LIDAR],  # one worker with as many threads
        }
        memory = MEMORY_LIMIT
        with mistakes.noted():
            check_backend_here(options.backend)
            usable = [name for name, reason in available_backends().items() if not reason]
            backend = usable[0] if options.backend == "auto" else options.backend
            # Dask gives each worker of a local cluster its share of the memory.
            worker_memory = MEMORY_LIMIT / CPU_COUNT
            check_memory(job, options, backend, worker_memory, "a casting worker of this machine")
    slots = {
        name: {"needed": needed, "there": present.get(name, 0)} for name, needed in required.items()
    }
    casters = slots[GPU]["there"] if casting is None else len(casting)
    return _Cluster(slots, casters, backend, memory)


def _bytes_needed(job: Job, points: int, batch: int, cluster: _Cluster, *, local: bool) -> int:
    """Return the memory of a casting worker, or of all processes of a local cluster, in bytes."""
    on_device = cluster.backend == "cuda"
    worker = _worker_bytes(job) + cast_bytes(job.scene, job.survey, batch, on_device=on_device)
    if not local:
        return worker
    return worker * cluster.casters + _rest_bytes(job, points, cluster.slots)


def _disk(job: Job, points: int, batch: int, exports: int, out: Path | Storage) -> dict[str, Any]:
    """Return the disk that a run and its result need, and the free disk, in bytes.

    A run needs disk for parts and database. Large parts are of `batch` scans.
    """
    survey = job.survey
    faces = job.scene.kept_triangles
    point = _point_bytes(job)
    full = -(-survey.scan_count // batch)
    parts = min(survey.scan_count, full + FIRST_PARTS)
    # Each part names the triangles that its rays hit.
    tally = 12 * min(faces, survey.ray_count // full // 10) * full
    run = point * points + PART_BYTES * parts + tally + SUMMARY_BYTES * survey.scan_count
    # A row of the PLY has doubles for coordinates at most; one piece exists twice.
    cloud = (point + 16) * (points + min(points, CHUNK_POINTS))
    result = cloud + (point + FORMAT_BYTES) * points * exports + ROOM_BYTES + 36 * faces
    result += instrument_bytes(survey, exports)
    # What goes into storage is made in a folder for temporary files, but for the parts.
    folder = Path(tempfile.gettempdir()) if isinstance(out, Storage) else out
    free = shutil.disk_usage(_existing(folder)).free
    return {"parts": run, "result": result, "free": free, "folder": str(folder)}


def _drive(survey: Survey) -> dict[str, Any] | None:
    """Describe the length of a moving carrier's trajectory, and the revolutions of each sensor."""
    if not survey.path.moves:
        return None
    seconds = survey.duration_ns / 1e9
    positions, _ = survey.path.poses(0, np.linspace(0, survey.duration_ns, TRAJECTORY_POSES))
    metres = float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum())
    sensors = []
    for carried, steps in zip(survey.carried, survey.steps_each, strict=True):
        sensor = carried.sensor
        firings = sensor.firings(steps - 1)[1]
        rate_hz = getattr(sensor.head, "rate_hz", None)
        on_ns = sensor.begins_ns(np.array([firings])).item() - sensor.start_ns
        sensors.append({
            "name": carried.name, "model": sensor.model, "cycle": sensor.cycle,
            "scans": steps * survey.path.stations, "firings": firings * survey.path.stations,
            "turns": rate_hz and on_ns / 1e9 * rate_hz,
            "metres_a_turn": rate_hz and metres / seconds / rate_hz,
        })  # fmt: skip
    return {"seconds": seconds, "metres": metres, "sensors": sensors}


def _existing(out: Path) -> Path:
    """Return a folder, or its innermost existing parent."""
    return next(path for path in (out, *out.absolute().parents) if path.exists())


def _fine_triangle_notes(scene: Scene) -> list[str]:
    """Return a note on triangles too small for Embree, which tests in float32; perhaps none."""
    count = 0
    shortest = _FINE * np.ptp(scene.bounds, axis=0).max()
    parts = scene.instances.parts if scene.instances else ()
    for points, faces in ((scene.vertices, scene.faces), *((p.vertices, p.faces) for p in parts)):
        corners = points[faces.T]
        edges = np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=2).min(axis=0)
        # Without an area no backend hits them.
        count += int(((edges > 0) & (edges < shortest)).sum())
    note = "with an edge below a millionth of the scene may be missed by embree, not by numpy"
    return [f"{plural(count, 'triangle')} {note}"] if count else []


def _folder_notes(out: Path | Storage) -> list[str]:
    """Return notes on the folder of a result; LidarError if the folder cannot be written."""
    if isinstance(out, Storage):
        out.claim()  # leaves nothing
    elif not (folder := _existing(out)).is_dir():
        raise LidarError(f"{folder} is a file: give a folder for the results with --out.")
    elif not os.access(folder, os.W_OK | os.X_OK):
        raise LidarError(f"Cannot write to the folder {folder}: give another with --out.")
    unfinished = FILE in Storage.at(out).below(RUN_FOLDER).sizes()
    note = f"{out} holds an unfinished run: --resume continues it, --fresh deletes it"
    return [note] if unfinished else []


def _worker_bytes(job: Job) -> int:
    """Return the memory of a casting worker, without the scans under way, in bytes."""
    return PROCESS_BYTES + rig_bytes(job.scene, job.survey)


def _rest_bytes(job: Job, points: int, slots: dict[str, dict[str, int]]) -> int:
    """Return the memory of all processes of a machine but casting workers, in bytes."""
    scene = job.scene
    swarm = job.planning.particles * job.planning.waypoints if job.planning else 0
    planning = PROCESS_BYTES + PARTICLE_BYTES * swarm
    piece = 6 * (_point_bytes(job) + 24) * min(points, CHUNK_POINTS)  # merged, written, read back
    shown = scene.kept_triangles + DRAWN_TRIANGLES
    if not scene.masked:  # which is cut into more
        shown = min(scene.triangles, shown)
    driver = 2 * SCENE_TRIANGLE * shown + INSTANCE * len(scene.instances or ()) + piece
    driver += SCAN_BYTES * job.survey.scan_count
    return planning * slots.get(OTHER, {"there": 0})["there"] + driver + 2 * PROCESS_BYTES


def _point_bytes(job: Job) -> int:
    """Return the bytes of a point in a part."""
    return sum(np.dtype(column.dtype).itemsize for column in job.survey.stored_columns)

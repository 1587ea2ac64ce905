"""Estimate the scans, points, memory and disk space of a run without starting workers."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from dask.system import CPU_COUNT
from distributed.system import MEMORY_LIMIT

from lidarfiles.clouds.flight_lines import firing_span_s, flight_lines, summarize_flight_lines
from lidarfiles.clouds.navigation_files import instrument_bytes
from lidarscenario.empty_cloud import EMPTY, empty_cloud_reason
from lidarscenario.job import Job
from lidarsim.casting.scene_caster import check_backend_here
from lidarsim.casting.visibility import unseen_objects
from lidarsim.columns.cloud import CHUNK_POINTS
from lidarsim.errors import LidarError, Mistakes
from lidarsim.io.allowance import bytes_of
from lidarsim.io.storage import Storage
from lidarsim.scene.simplified import DRAWN_TRIANGLES
from lidarsim.sensor.noise import Noise
from lidarsim.sensor.optics import Returns
from lidarsim.simulator.memory import (
    INSTANCE,
    MB,
    SCENE_TRIANGLE,
    cast_bytes,
    rig_bytes,
    scans_that_fit,
)
from lidarsim.simulator.sampling import sample_survey
from lidarsim.survey.survey import Survey
from lidarsim.words import join_names
from poolpart.probe import visible_gpus
from raybeam import available_backends

from .cluster.requirements import check_memory, default_workers, slots_needed
from .options import RunOptions
from .pipeline.policies import max_scans_per_batch
from .pipeline.stage_names import GPU, LIDAR, OTHER
from .store.database import FILE
from .store.run_store import RUN_FOLDER

if TYPE_CHECKING:
    from distributed import Client

# Memory of a worker process in which Dask is loaded, measured on Linux. It includes 110 MiB for
# numba, which compiles loops.
PROCESS_BYTES = 300 << 20
PARTICLE_BYTES = 140  # memory per waypoint of a particle in path planning
PART_BYTES = 2500  # disk space of a part's header and its row in the database
FIRST_PARTS = 60  # number of small parts that are written before batches become large
SCAN_BYTES = 64  # memory of a scan in the driver
SUMMARY_BYTES = 28  # disk space of a scan in the database
FORMAT_BYTES = 30  # maximum size of a point in exported files (LAS) without its columns
REPORT_BYTES = 32 << 20  # disk space of the pictures and the report
TRAJECTORY_POSES = 1000  # number of samples for the length of a trajectory


def forecast(
    job: Job,
    folder: Path | Storage,
    options: RunOptions,
    client: Client | None = None,
    *,
    refuse: Callable[[], object] | None = None,
) -> dict[str, Any]:
    """Estimate the scans, points, memory and disk space of a run, and whether it can run.

    No cluster is started, and nothing is written to the output folder.

    Parameters
    ----------
    job
        Survey to estimate.
    folder
        Output folder.
    options
        Options of the run, which may describe a cluster.
    client
        Client of an existing cluster. By default, the run is on the cluster in `options`, or on a
        cluster on this machine.
    refuse
        Function that raises a LidarError if the output folder contains a different result.

    Returns
    -------
    dict
        Values that can be serialized as JSON, with sizes in bytes. If the run is not possible,
        `reasons` explains why and suggests remedies. `memory` is that of all processes on this
        machine or, on a different cluster, that of one casting worker.
    """
    scene = job.scene
    survey = job.survey
    mistakes = Mistakes()
    notes: list[str] = []
    warnings: list[str] = []
    with mistakes.collect():
        notes += _folder_notes(folder)
    occupied = bool(notes)  # an unfinished run
    if refuse is not None:
        try:
            refuse()
        except LidarError as error:
            notes.append(str(error).rstrip("."))
            occupied = True
    for file_format in job.outputs:
        with mistakes.collect():
            file_format.check_installed()
    cluster = _cluster_of(job, options, client, mistakes, notes)
    backend = cluster.backend
    estimate = None
    # Casting sample rays in this process requires as much memory as casting on a worker.
    if _worker_bytes(job) + cast_bytes(scene, survey) <= MEMORY_LIMIT:
        estimate = sample_survey(scene, survey)
        if not estimate["hits"]:
            warnings.append(f"{EMPTY}: {empty_cloud_reason(scene, survey)}")
    # Without an estimate, assume that every ray hits a surface.
    points = estimate["points"] if estimate else survey.ray_count // survey.keep_every
    # Size of the largest batches, which determine the peak memory.
    scans_per_batch = max_scans_per_batch(
        scans_that_fit(scene, survey, options.batch_mb * MB, on_device=backend == "cuda"),
        survey.scan_count,
        max(1, cluster.slots[GPU]["there"]),
    )
    disk = _disk(job, points, scans_per_batch, len(job.outputs), folder)
    required_bytes = _worker_bytes(job) + cast_bytes(
        scene, survey, scans_per_batch, on_device=backend == "cuda"
    )
    if options.starts_workers and client is None:
        required_bytes *= cluster.casters
        required_bytes += _rest_bytes(
            job, points, cluster.slots[OTHER]["there"] if job.planning else 0
        )
    mistakes.lines += _shortages(
        disk, cluster.memory, required_bytes, stored=isinstance(folder, Storage)
    )
    return {
        "can_run": not mistakes.lines,
        "reasons": mistakes.lines,
        "occupied": occupied,  # whether the output folder contains a run or a different result
        "notes": notes,
        "warnings": warnings,
        "objects": len(scene.object_names),
        "triangles": scene.triangles,
        "masked": list(scene.masked_objects),
        "performance": _performance(survey),  # {sensor name: "ideal" or "datasheet"}
        "unseen": _unseen(job),  # {sensor name: names of objects that are hidden from the sensor}
        # In scenario coordinates. Adding `world.origin` results in world coordinates.
        "bounds": (scene.bounds + (scene.origin - scene.world_origin)).tolist(),
        "epsg": survey.epsg,
        "world_origin": scene.world_origin.tolist(),
        "poses": survey.path.stations,
        "drive": _drive(survey),
        "scans": survey.scan_count,
        "sweeps": survey.sweep_count,
        "rays": survey.ray_count,
        "estimate": estimate,
        "precision_m": survey.precision_m,
        "trials": job.trials,
        "backend": backend,
        "casters": cluster.casters,
        "slots": cluster.slots,
        "memory": {"needed": required_bytes, "there": cluster.memory or None},
        "disk": disk,
    }


class _Cluster(NamedTuple):
    """Properties of the run's cluster that are known before the run starts."""

    slots: dict[str, dict[str, int]]  # {partition: {"needed": …, "there": …}}
    casters: int  # number of casting workers
    backend: str | None  # None if not known yet
    memory: int  # bytes, or 0 for machines that have not been started yet


def _cluster_of(
    job: Job, options: RunOptions, client: Client | None, mistakes: Mistakes, notes: list[str]
) -> _Cluster:
    required = slots_needed(options, planning=job.planning is not None)
    casting = None
    backend = None
    memory = 0
    if (file := options.cluster) is not None:
        present = file.slots
        with mistakes.collect():
            file.require(required)
    elif client is not None:
        # Imported late, because estimates for a cluster on this machine do not need Dask.
        from poolpart import Pool

        from .cluster.checks import check_workers, find_workers, gpu_note

        held = [worker.resources for worker in Pool.from_client(client)]
        present = {name: int(sum(slots.get(name, 0) for slots in held)) for name in required}
        with mistakes.collect():
            pool, casting, backend, _ = find_workers(client, required, options.backend)
            check_workers(job, options, backend, casting)
            memory = min((worker.memory for worker in casting if worker.memory), default=0)
            notes += filter(None, [gpu_note(pool, casting, backend)])
    else:
        workers = default_workers(CPU_COUNT, len(visible_gpus()))
        present = {
            GPU: options.gpu_workers or workers[GPU],
            OTHER: options.other_workers or workers[OTHER],
            LIDAR: required[LIDAR],  # one worker with as many threads
        }
        memory = MEMORY_LIMIT
        with mistakes.collect():
            check_backend_here(options.backend)
            usable = [name for name, reason in available_backends().items() if not reason]
            backend = usable[0] if options.backend == "auto" else options.backend
            # In a local cluster, Dask divides the memory among the workers.
            worker_memory = MEMORY_LIMIT / CPU_COUNT
            check_memory(job, options, backend, worker_memory, "a casting worker on this machine")
    slots = {
        name: {"needed": required_slots, "there": present.get(name, 0)}
        for name, required_slots in required.items()
    }
    casters = slots[GPU]["there"] if casting is None else len(casting)
    return _Cluster(slots, casters, backend, memory)


def _disk(
    job: Job, points: int, scans_per_batch: int, exports: int, result: Path | Storage
) -> dict[str, Any]:
    """Estimate the disk space that a run and its result require, and the available space.

    The run requires space for its parts and its database. Large parts contain `scans_per_batch`
    scans.
    """
    survey = job.survey
    faces = job.scene.kept_triangles
    point_bytes = _point_bytes(job)
    large_parts = -(-survey.scan_count // scans_per_batch)
    part_count = min(survey.scan_count, large_parts + FIRST_PARTS)
    # Each part stores the number of hits of each triangle that its rays hit.
    tally_bytes = 12 * min(faces, survey.ray_count // large_parts // 10) * large_parts
    run_bytes = point_bytes * points + PART_BYTES * part_count + tally_bytes
    run_bytes += SUMMARY_BYTES * survey.scan_count
    # PLY files store coordinates with up to 8 bytes, and one chunk exists twice.
    cloud_bytes = (point_bytes + 16) * (points + min(points, CHUNK_POINTS))
    export_bytes = (point_bytes + FORMAT_BYTES) * points * exports
    result_bytes = cloud_bytes + export_bytes + REPORT_BYTES + 36 * faces
    result_bytes += instrument_bytes(survey, exports)
    # Files for remote storage, except for parts, are first written to a temporary folder.
    folder = Path(tempfile.gettempdir()) if isinstance(result, Storage) else result
    free = shutil.disk_usage(_closest_existing(folder)).free
    return {"parts": run_bytes, "result": result_bytes, "free": free, "folder": str(folder)}


def _shortages(
    disk: dict[str, Any], available_bytes: int, required_bytes: int, *, stored: bool
) -> list[str]:
    """Return messages about insufficient disk space or memory.

    Parameters
    ----------
    available_bytes
        Available memory, or 0 if it is unknown.
    stored
        Whether the result is written to a remote storage rather than a folder.
    """
    messages = []
    disk_bytes = disk["result"] + (0 if stored else disk["parts"])
    if disk["free"] < disk_bytes:
        messages.append(
            f"The disk of {disk['folder']} has {bytes_of(disk['free'])} free, but the run "
            f"needs about {bytes_of(disk_bytes)}. Free disk space, choose a different folder "
            f"with {'`TMPDIR`' if stored else '`--out`'}, or increase `keep_every`."
        )
    if 0 < available_bytes < required_bytes:
        messages.append(
            f"{bytes_of(available_bytes)} of memory are available, but the run needs about "
            f"{bytes_of(required_bytes)}. Use a smaller scene, reduce the number of casting "
            "workers (`pool.gpu`), `batch_mb`, `rays_per_revolution` or `planning.particles`, or "
            "use a machine with more memory."
        )
    return messages


def _performance(survey: Survey) -> dict[str, str]:
    """Describe whether each sensor is ideal or corresponds to its data sheet, keyed by name."""
    performance = {}
    pairs = zip(survey.mounted_sensors, survey.noise_each, survey.returns_each, strict=True)
    for carried, noise, returns in pairs:
        sensor = carried.sensor
        words = "ideal" if sensor.noise is None else "datasheet"
        unchanged_noise = replace(sensor.noise or Noise(), seed=noise.seed)
        changed = ["noise"] * (noise != unchanged_noise)
        changed += ["returns"] * (returns != (sensor.returns or Returns()))
        performance[carried.name] = words + f" except for {join_names(changed)}" * bool(changed)
    return performance


def _unseen(job: Job) -> dict[str, list[str]]:
    """Return the names of the objects that each sensor cannot see.

    Sensors that see all objects are omitted.
    """
    scene = job.scene
    pairs = zip(job.survey.mounted_sensors, unseen_objects(scene, job.survey), strict=True)
    names = scene.object_names
    return {
        carried.name: [names[row] for row in np.flatnonzero(mask)]
        for carried, mask in pairs
        if mask is not None
    }


def _drive(survey: Survey) -> dict[str, Any] | None:
    """Describe the trajectory of a moving platform, and the revolutions of each sensor.

    For airborne scanners, the distance per revolution is computed from the speed on flight lines
    while the sensor fires.
    """
    if not survey.path.moves:
        return None
    seconds = survey.duration_ns / 1e9
    times_s = np.linspace(0, seconds, TRAJECTORY_POSES)
    positions, _ = survey.path.poses(0, 1e9 * times_s)
    traveled_m = np.append(0.0, np.linalg.norm(np.diff(positions, axis=0), axis=1).cumsum())
    lines = flight_lines(survey)
    sensors = []
    for carried, steps in zip(survey.mounted_sensors, survey.steps_each, strict=True):
        sensor = carried.sensor
        firings = sensor.firings(steps - 1)[1]
        rate_hz = getattr(sensor.head, "rate_hz", None)
        start_s, stop_s = firing_span_s(sensor, steps)
        speed_m_s = float(np.diff(np.interp([start_s, stop_s], times_s, traveled_m))[0])
        speed_m_s /= stop_s - start_s
        if lines is not None:
            speed_m_s = lines.mean_speed(start_s, stop_s) or speed_m_s
        sensors.append(
            {
                "name": carried.name,
                "model": sensor.model,
                "cycle": sensor.cycle,
                "scans": steps * survey.path.stations,
                "firings": firings * survey.path.stations,
                "turns": rate_hz and (stop_s - start_s) * rate_hz,
                "meters_a_turn": rate_hz and speed_m_s / rate_hz,
            }
        )
    return {
        "seconds": seconds,
        "meters": float(traveled_m[-1]),
        "lines": summarize_flight_lines(survey),
        "sensors": sensors,
    }


def _closest_existing(folder: Path) -> Path:
    return next(path for path in (folder, *folder.absolute().parents) if path.exists())


def _folder_notes(location: Path | Storage) -> list[str]:
    """Return notes on the output folder, or raise LidarError if it is not writable."""
    if isinstance(location, Storage):
        location.claim()  # leaves no files behind
    elif not (folder := _closest_existing(location)).is_dir():
        raise LidarError(f"{folder} is a file. Pass a folder for the results with `--out`.")
    elif not os.access(folder, os.W_OK | os.X_OK):
        raise LidarError(
            f"The folder {folder} is not writable. Choose a different folder with `--out`."
        )
    unfinished = FILE in Storage.at(location).below(RUN_FOLDER).sizes()
    note = (
        f"{location} contains an unfinished run. Continue it with `--resume`, or delete it with "
        "`--restart`"
    )
    return [note] if unfinished else []


def _worker_bytes(job: Job) -> int:
    """Estimate the memory of a casting worker in bytes, excluding scans in flight."""
    return PROCESS_BYTES + rig_bytes(job.scene, job.survey)


def _rest_bytes(job: Job, points: int, planners: int) -> int:
    """Estimate the memory, in bytes, of all processes on this machine except casting workers."""
    scene = job.scene
    swarm = job.planning.particles * job.planning.waypoints if job.planning else 0
    planning = PROCESS_BYTES + PARTICLE_BYTES * swarm
    # Chunks of points are merged, written and read again.
    chunk_bytes = 6 * (_point_bytes(job) + 24) * min(points, CHUNK_POINTS)
    shown_triangles = scene.kept_triangles + DRAWN_TRIANGLES
    if not scene.masked_objects:  # masked triangles are divided into more triangles
        shown_triangles = min(scene.triangles, shown_triangles)
    driver = 2 * SCENE_TRIANGLE * shown_triangles + INSTANCE * len(scene.instances or ())
    driver += chunk_bytes + SCAN_BYTES * job.survey.scan_count
    return planning * planners + driver + 2 * PROCESS_BYTES


def _point_bytes(job: Job) -> int:
    return sum(np.dtype(column.dtype).itemsize for column in job.survey.stored_columns)

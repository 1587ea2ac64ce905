"""What a run would do and take, found out without starting anything."""

from __future__ import annotations

import os
import shutil
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from dask.utils import format_bytes
from distributed import Client
from distributed.system import MEMORY_LIMIT

from poolpart import Pool, PoolError
from poolpart.local import usable_cores
from poolpart.probe import visible_gpus
from raybeam import available_backends

from ..base.choice import one_of_each_part
from ..base.errors import LidarpoolError
from ..columns.cloud import CHUNK_POINTS
from ..report.output import ROOM_BYTES, folder_in_the_way
from ..run.checks import check_backend_here, find_workers, slots_needed
from ..run.database import FILE
from ..run.job import Job
from ..run.local import default_workers
from ..run.store import RUN_FOLDER
from ..scan import GPU, LIDAR, OTHER
from ..scan.driver import BATCH_RAYS
from ..scan.rig import PATTERN_RAYS, Rig, RigPlan
from ..scenario.sections import PoolSection
from ..scene.scene import Scene
from ..sensor import Survey
from .run_command import NO_HITS

# Measured on Linux: a process of ours with Dask and Open3D loaded, and what a triangle takes at
# most while a caster is built (Embree 300, NumPy 320, CUDA up to 400, there on the device).
PROCESS_BYTES = 200 << 20
TRIANGLE_BYTES = 360
SCENE_BYTES = 80  # of a triangle, in every process that knows the scene
RAY_BYTES = 48  # of a turn, and of the pattern made of it
PARTICLE_BYTES = 140  # of a swarm, for each corner of its path
PART_BYTES = 2500  # its head, and its row in the database
SCAN_BYTES = 64  # in the driver
SUMMARY_BYTES = 28  # of a scan, in the database

# Rays that are cast at most, whole scans of them, and the least and most scans.
SAMPLE_RAYS, SAMPLE_SCANS = 500_000, (16, 500)


@dataclass(frozen=True)
class Sample:
    """What some scans of a survey, cast here, say of all.

    Parameters
    ----------
    rays
        Rays that were cast.
    hits, points
        Of the whole survey, estimated; counted if all of its rays were cast.
    """

    rays: int
    hits: int
    points: int


@dataclass
class Forecast:
    """What a run would do and take; filled in by `forecast`.

    Parameters
    ----------
    job, out
        What is to be run, and the folder of the result.
    backend
        Ray-casting backend that stage 2 would use; empty where it is not to be had.
    slots
        Slots of each partition: those needed, and those there.
    sample
        Estimate of hits and points; None where no ray could be cast.
    memory, memory_needed
        Bytes that there are and that are needed: of this machine and by all processes, or, on
        another cluster, those of a GPU worker. 0 where there is no limit.
    parts, result, free
        Bytes on the disk of `out`: of the run, about, of its result, and those that are free.
    reasons
        Why it cannot run, each with what to do.
    notes
        What should be known besides.
    """

    job: Job
    out: Path
    backend: str = ""
    slots: dict[str, tuple[int, int]] = field(default_factory=dict)
    sample: Sample | None = None
    memory: int = 0
    memory_needed: int = 0
    parts: int = 0
    result: int = 0
    free: int = 0
    reasons: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def as_data(self) -> dict[str, Any]:
        """Return it as plain data for JSON; sizes in bytes."""
        scene, survey = self.job.scene, self.job.survey
        return {
            "can_run": not self.reasons,
            "reasons": self.reasons,
            "notes": self.notes,
            "objects": len(scene.names),
            "triangles": len(scene.faces),
            "bounds": (scene.bounds + scene.origin).tolist(),
            "poses": survey.path.stations,
            "scans": survey.scan_count,
            "rays": survey.ray_count,
            "estimate": asdict(self.sample) if self.sample else None,
            "trials": self.job.trials,
            "backend": self.backend or None,
            "slots": {n: {"needed": needed, "there": t} for n, (needed, t) in self.slots.items()},
            "memory": {"needed": self.memory_needed, "there": self.memory or None},
            "disk": {
                "parts": self.parts,
                "result": self.result,
                "free": self.free,
                "folder": str(self.out),
            },
        }


def forecast(job: Job, pool: PoolSection, out: Path, client: Client | None = None) -> Forecast:
    """Find out what a run would do and take, and whether it can.

    Parameters
    ----------
    job, out
        What is to be run, and the folder of the result; the folder is only looked at.
    pool
        Sizes of a cluster on this machine, which is not started.
    client
        Client of the cluster to run on instead.
    """
    made = Forecast(job, out)
    try:
        if client is None:
            _look_here(made, pool)
        else:
            _look_there(made, client)
    except (LidarpoolError, PoolError) as error:
        made.reasons.append(str(error))
    _look_at_folder(made)
    # Casting here takes what it takes on a worker: it would be refused, or killed.
    if _worker_bytes(job) <= MEMORY_LIMIT:
        made.sample = sample_survey(job.scene, job.survey)
        if not made.sample.hits:
            made.notes.append(NO_HITS)
    _reckon(made, alone=client is None)
    return made


def sample_survey(scene: Scene, survey: Survey, backend: str = "auto") -> Sample:
    """Estimate hits and points of a survey by casting some of its scans, all if they are few."""
    rig = Rig(RigPlan(scene, survey, backend))
    count = np.clip(SAMPLE_RAYS * survey.scan_count // survey.ray_count, *SAMPLE_SCANS)
    rays = hits = points = 0
    for scan in one_of_each_part(survey.scan_count, int(count)).tolist():
        rays += survey.scan(scan).ray_count(survey.sensor)
        for found in rig.cast(scan, scan + 1):
            hits += int(found.found.hits.sum())
            points += len(found)
    share = survey.ray_count / rays
    return Sample(rays, round(hits * share), round(points * share))


def _look_here(made: Forecast, pool: PoolSection) -> None:
    """Find out what a cluster of this machine would have."""
    needed = slots_needed(made.job.collectors, made.job.planning is not None)
    workers = default_workers(usable_cores(), len(visible_gpus()))
    there = {GPU: pool.gpu or workers[GPU], OTHER: pool.other or workers[OTHER]}
    there[LIDAR] = needed[LIDAR]  # one worker with as many threads
    made.slots = {name: (needed[name], there[name]) for name in needed}
    made.memory = MEMORY_LIMIT
    wanted = made.job.backend
    check_backend_here(wanted)
    usable = (name for name, reason in available_backends().items() if not reason)
    made.backend = next(usable) if wanted == "auto" else wanted


def _look_there(made: Forecast, client: Client) -> None:
    """Find out what a cluster has that is running already."""
    job, planning = made.job, made.job.planning is not None
    everybody = Pool.from_client(client)
    for name, needed in slots_needed(job.collectors, planning).items():
        made.slots[name] = needed, int(sum(w.resources.get(name, 0) for w in everybody))
    _, casting, made.backend = find_workers(client, job.collectors, planning, job.backend)
    made.memory = min((worker.memory for worker in casting if worker.memory), default=0)
    if not any(worker.gpus for worker in casting):
        made.notes.append(f"no GPU in partition GPU: CPU workers cast the rays with {made.backend}")


def _look_at_folder(made: Forecast) -> None:
    """See whether the result can go there; nothing is made or changed."""
    there = next(path for path in (made.out, *made.out.absolute().parents) if path.exists())
    made.free = shutil.disk_usage(there).free
    if not there.is_dir():
        made.reasons.append(f"{there} is a file: give a folder for the results with --out.")
    elif not os.access(there, os.W_OK | os.X_OK):
        made.reasons.append(f"Cannot write to the folder {there}: give another with --out.")
    elif obstacle := folder_in_the_way(made.out):
        made.reasons.append(obstacle)
    for part in made.out.absolute().relative_to(there.absolute()).parts:
        with suppress(FileNotFoundError, NotADirectoryError):
            os.lstat(there / part)  # OSError for a name that no folder of that disk can have
    if (made.out / RUN_FOLDER / FILE).exists():
        made.notes.append(
            f"{made.out} holds an unfinished run: --resume goes on with it, --fresh drops it"
        )


def _worker_bytes(job: Job) -> int:
    """Memory of a GPU worker."""
    rays = min((job.survey.sensor.period or 0) * job.survey.sensor.channels, PATTERN_RAYS)
    triangles = (SCENE_BYTES + TRIANGLE_BYTES) * len(job.scene.faces)
    return PROCESS_BYTES + triangles + RAY_BYTES * rays


def _reckon(made: Forecast, alone: bool) -> None:
    """Compare what a run takes of memory and disk, about, with what there is.

    `alone` says that workers and driver share this machine.
    """
    job, survey, faces = made.job, made.job.survey, len(made.job.scene.faces)
    # Without a sample every ray may hit.
    points = made.sample.points if made.sample else survey.ray_count // survey.keep_every
    point = sum(np.dtype(column.dtype).itemsize for column in survey.stored_columns)
    parts = min(survey.scan_count, max(16, survey.ray_count // BATCH_RAYS + 1))
    tally = 12 * min(faces, BATCH_RAYS // 10)  # names each triangle that the rays of a part hit
    made.parts = point * points + (PART_BYTES + tally) * parts + SUMMARY_BYTES * survey.scan_count
    # A row of the PLY has doubles for the coordinates at most; a piece of it is there twice.
    made.result = (point + 16) * (points + min(points, CHUNK_POINTS)) + ROOM_BYTES + 36 * faces
    made.memory_needed = _worker_bytes(job)
    if alone:
        swarm = job.planning.particles * job.planning.waypoints if job.planning else 0
        other = PROCESS_BYTES + PARTICLE_BYTES * swarm
        piece = 6 * (point + 24) * min(points, CHUNK_POINTS)  # merged, written and read back
        driver = 2 * SCENE_BYTES * faces + SCAN_BYTES * survey.scan_count + piece
        made.memory_needed *= made.slots[GPU][1]
        made.memory_needed += other * made.slots.get(OTHER, (0, 0))[1] + driver
        made.memory_needed += 2 * PROCESS_BYTES  # of LIDAR and the driver
    if made.free < made.parts + made.result:
        made.reasons.append(
            f"The disk of {made.out} has {format_bytes(made.free)} free and the run needs about "
            f"{format_bytes(made.parts + made.result)}: make room, name another folder with "
            "--out, or take a larger keep_every."
        )
    if made.memory and made.memory < made.memory_needed:
        made.reasons.append(
            f"There are {format_bytes(made.memory)} of memory and the run needs about "
            f"{format_bytes(made.memory_needed)}: take a smaller scene, fewer workers (pool.gpu), "
            "rays_per_revolution or planning.particles, or a machine with more."
        )

"""What a run takes of memory and disk, about."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .cloud import CHUNK_POINTS
from .job import Job
from .output import ROOM_BYTES
from .picture_file import TRIANGLE_BYTES as PICTURED_BYTES
from .plan import Planning
from .ply import real_type
from .ply_format import row_type
from .records import HEAD_BYTES
from .scan.messages import POINT

# Measured on Linux: a process of ours with Dask and Open3D loaded, and what a triangle takes at
# most while a caster is built (Embree 300, NumPy 320, CUDA up to 400, there on the device).
PROCESS_BYTES = 200 << 20
TRIANGLE_BYTES = 360
# Mesh, its objects, what is sent of it; in every process that knows the scene.
SCENE_BYTES = 80
# Directions of a revolution, and the pattern made of them.
RAY_BYTES = 48
# What a particle of a swarm has for each corner of its path, and what is left of a trial; the
# history of a trial is a number for each iteration.
PARTICLE_BYTES = 140
TRIAL_BYTES = 1000
# Places and counts, and entries of the ledgers, in the driver.
SCAN_BYTES = 32


@dataclass(frozen=True)
class Needs:
    """What a run takes, in bytes; estimates.

    Parameters
    ----------
    gpu_worker, lidar_worker, other_worker, driver
        Memory of one process of each kind.
    journal
        Points, totals and trials until the result is there, in the output folder.
    cloud
        cloud.ply, and the part of it that is being written.
    pictures
        All other files of the result.
    """

    gpu_worker: int
    lidar_worker: int
    other_worker: int
    driver: int
    journal: int
    cloud: int
    pictures: int

    @property
    def disk(self) -> int:
        """Most that is on the disk at a time."""
        return self.journal + self.cloud + self.pictures

    def on_one_machine(self, gpu_workers: int, other_workers: int) -> int:
        """Memory of a cluster of this machine: LIDAR is one worker, the driver has the rest."""
        workers = gpu_workers * self.gpu_worker + other_workers * self.other_worker
        return workers + self.lidar_worker + self.driver


def needs_of(job: Job, points: int) -> Needs:
    """Work out what a run takes that is to give so many points."""
    survey, faces = job.survey, len(job.scene.faces)
    sensor = RAY_BYTES * survey.sensor.rays_per_revolution * survey.sensor.layers
    scene = SCENE_BYTES * faces
    bounds = (job.scene.bounds + job.scene.origin).astype(np.float64)
    row = row_type(real_type(bounds, survey.precision_m)).itemsize
    # Totals are replaced as a whole: for a moment there are two.
    totals = 2 * 8 * faces
    # A scan is a record of its own where they come one by one.
    records = (HEAD_BYTES + 12) * survey.scan_count + POINT.itemsize * points
    swarm, trials, written = _planning_bytes(job.planning)
    return Needs(
        gpu_worker=PROCESS_BYTES + scene + TRIANGLE_BYTES * faces + sensor,
        lidar_worker=PROCESS_BYTES + sensor,
        other_worker=PROCESS_BYTES + swarm,
        driver=PROCESS_BYTES
        + 2 * scene
        + SCAN_BYTES * survey.scan_count
        + trials
        # A piece of the cloud as it is merged, written and read back.
        + 4 * POINT.itemsize * min(points, CHUNK_POINTS),
        journal=records + totals + written,
        cloud=row * (points + min(points, CHUNK_POINTS)),
        pictures=ROOM_BYTES + PICTURED_BYTES * faces,
    )


def _planning_bytes(planning: Planning | None) -> tuple[int, int, int]:
    """Bytes of the swarm of a trial, and of all trials in memory and in the journal."""
    if planning is None:
        return 0, 0, 0
    swarm = PARTICLE_BYTES * planning.particles * planning.waypoints
    held = TRIAL_BYTES + 4 * planning.iterations + 16 * planning.waypoints
    # As text.
    written = HEAD_BYTES + 200 + 20 * planning.iterations + 40 * planning.waypoints
    return swarm, planning.trials * held, planning.trials * written

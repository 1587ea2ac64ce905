"""What a run takes of memory and disk, about."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..columns.cloud import CHUNK_POINTS
from ..columns.table import SCAN
from ..export.ply import real_type
from ..export.ply_format import row_type
from ..plan import Planning
from ..report.output import ROOM_BYTES
from ..run.job import Job
from ..run.picture_file import TRIANGLE_BYTES as PICTURED_BYTES
from ..scan.driver import BATCH_RAYS
from ..scan.messages import samples_of_scan, summary_type
from ..scan.rig import PATTERN_RAYS

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
# Of a part: its head, and its row in the database.
PART_BYTES = 2500
# Of a scan in the driver: whether it is committed, and its share of the receipt of its part.
SCAN_BYTES = 64


@dataclass(frozen=True)
class Needs:
    """What a run takes, in bytes; estimates.

    Parameters
    ----------
    gpu_worker, lidar_worker, other_worker, driver
        Memory of one process of each kind.
    parts
        Parts and database until the result is there.
    cloud
        cloud.ply, and the part of it that is being written.
    pictures
        All other files of the result.
    """

    gpu_worker: int
    lidar_worker: int
    other_worker: int
    driver: int
    parts: int
    cloud: int
    pictures: int

    @property
    def disk(self) -> int:
        """Most that is on the disk at a time."""
        return self.parts + self.cloud + self.pictures

    def on_one_machine(self, gpu_workers: int, other_workers: int) -> int:
        """Memory of a cluster of this machine: LIDAR is one worker, the driver has the rest."""
        workers = gpu_workers * self.gpu_worker + other_workers * self.other_worker
        return workers + self.lidar_worker + self.driver


def needs_of(job: Job, points: int) -> Needs:
    """Work out what a run takes that is to give so many points."""
    survey, faces = job.survey, len(job.scene.faces)
    rays = (survey.sensor.period or 0) * survey.sensor.channels
    sensor = RAY_BYTES * min(rays, PATTERN_RAYS)
    scene = SCENE_BYTES * faces
    bounds = (job.scene.bounds + job.scene.origin).astype(np.float64)
    columns = survey.stored_columns
    table = (SCAN, *columns[3:])
    row = row_type(real_type(bounds, survey.precision_m), table).itemsize
    point = sum(np.dtype(column.dtype).itemsize for column in columns)
    # A part has up to a million rays; its tally names each triangle that they hit.
    count = min(survey.scan_count, max(16, survey.ray_count // BATCH_RAYS + 1))
    tally = 12 * min(faces, BATCH_RAYS // 10)
    summaries = (8 + summary_type(samples_of_scan(survey.scan_count)).itemsize) * survey.scan_count
    parts = point * points + (PART_BYTES + tally) * count + summaries
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
        + 6 * (point + 24) * min(points, CHUNK_POINTS),
        parts=parts + written,
        cloud=row * (points + min(points, CHUNK_POINTS)),
        pictures=ROOM_BYTES + PICTURED_BYTES * faces,
    )


def _planning_bytes(planning: Planning | None) -> tuple[int, int, int]:
    """Bytes of the swarm of a trial, and of all trials in memory and in the database."""
    if planning is None:
        return 0, 0, 0
    swarm = PARTICLE_BYTES * planning.particles * planning.waypoints
    held = TRIAL_BYTES + 4 * planning.iterations + 16 * planning.waypoints
    # As text.
    written = 300 + 20 * planning.iterations + 40 * planning.waypoints
    return swarm, planning.trials * held, planning.trials * written

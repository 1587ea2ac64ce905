"""Create sweeps from the points of a job. The points come from a file or a stream."""

from __future__ import annotations

from functools import partial
from types import EllipsisType

from lidarsim.columns.sweep import Sweep
from lidarsim.sweeps.sweeps import Sweeps

from ..clouds.boxes import Boxes, SweepBoxes
from ..clouds.job_reader import PointColumns
from ..clouds.writing import ExportSpec
from .job_table import JobRow


def is_compensated(spec: ExportSpec, coordinates: str) -> bool:
    """Return whether sweeps in a data set are compensated for the motion of the sensor.

    Otherwise, each point is in the sensor frame at its firing. `coordinates` is the frame of the
    points that the job simulates, "world" or "sensor".
    """
    return coordinates == "world" or spec.compensated or spec.cloud_format.frame == "sweep"


def sweep_of_job(
    job: JobRow,
    sweeps: Sweeps,
    number: int,
    points: PointColumns,
    boxes: Boxes | None,
    index: int | EllipsisType = ...,
    *,
    compensated: bool,
) -> Sweep:
    """Create one sweep of a job from its points in sensor coordinates.

    `number` is the index of the sweep in `sweeps`. `boxes` contains either the boxes of this sweep
    only, or the boxes of several sweeps. In the latter case, `index` is the index of this sweep in
    `boxes`. `compensated` states whether the points are in the sensor frame at the start of the
    sweep, instead of that at their firing.
    """
    positions, columns = points
    return Sweep(
        positions,
        columns,
        pose=sweeps.pose.matrix(number),
        time_ns=round(sweeps.begins_ns[number]),
        compensated=compensated,
        boxes=partial(SweepBoxes.select, sweeps, boxes, index),
        sensor=sweeps.sensors[sweeps.sensor[number]],
        number=int(sweeps.numbers[number]),
        job=job.name,
        job_number=job.number,
        split=job.split or None,
        values=job.values,
        object_names=sweeps.object_names,
        faults=sweeps.faults_in(number),
    )

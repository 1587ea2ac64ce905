"""Create sweeps from the points of a job. The points come from a file or a stream."""

from __future__ import annotations

from functools import partial
from types import EllipsisType

from lidarsim.columns.sweep import Sweep
from lidarsim.sweeps.sweeps import Sweeps

from ..clouds.boxes import Boxes, SweepBoxes
from ..clouds.cloud_format import PointColumns
from .job_table import JobRow


def sweep_of_job(
    job: JobRow,
    sweeps: Sweeps,
    number: int,
    points: PointColumns,
    boxes: Boxes | None,
    index: int | EllipsisType = ...,
) -> Sweep:
    """Create one sweep of a job from its points, in sensor coordinates at the start of the sweep.

    `number` is the index of the sweep in `sweeps`. `boxes` contains either the boxes of this sweep
    only, or the boxes of several sweeps. In the latter case, `index` is the index of this sweep in
    `boxes`.
    """
    positions, columns = points
    return Sweep(
        positions,
        columns,
        pose=sweeps.pose.matrix(number),
        time_ns=round(sweeps.begins_ns[number]),
        compensated=True,
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

"""A sweep of a job, read from a data set or a stream."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from types import EllipsisType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarsim.base.arrays import AnyArray, Floats, Floats32, Ints32
from lidarsim.base.signatures import ReadableSignature
from lidarsim.survey.faults import Fault
from lidarsim.sweeps.sweeps import Sweeps

from ..clouds.boxes import Boxes, SweepBoxes
from ..clouds.cloud_format import PointColumns
from .job_table import JobRow, Value


@dataclass(frozen=True, eq=False, repr=False)
class Sweep:
    """Single sweep of a sensor, with its points, the sensor pose and the boxes of actors.

    Coordinates are in the sensor frame at the start of the sweep. x is forward, y is left and z is
    up, unless the mount is rotated. The points are compensated for the motion during the sweep.
    """

    __signature__ = ReadableSignature()

    job: str  # name
    job_number: int
    split: str | None  # None without splits
    values: Mapping[str, Value | None]  # {path: varied value}; None if the job has no value
    sensor: str  # name; "" for a single sensor without a name
    number: int  # index among the sweeps of its sensor in the job, from 0
    time_ns: int  # start of the sweep, nanoseconds since the start of the survey
    points: Floats32  # (n, 3): meters, sensor frame
    columns: Mapping[str, AnyArray]  # {name: (n,)}: columns that the format holds
    pose: Floats  # (4, 4): from the sensor frame to the world frame
    object_names: tuple[str, ...]  # names of the numbers in the column `object`
    faults: tuple[Fault, ...]  # faults of the sensor at any time of the sweep
    # Boxes, or arguments of `SweepBoxes.select`.
    _boxes: SweepBoxes | tuple[Sweeps, Boxes | None, int | EllipsisType]

    @classmethod
    def from_points(
        cls,
        job: JobRow,
        sweeps: Sweeps,
        number: int,
        points: PointColumns,
        boxes: Boxes | None,
        index: int | EllipsisType = ...,
    ) -> Sweep:
        """Create the sweep with the given number from its points."""
        positions, columns = points
        return cls(
            job=job.name,
            job_number=job.number,
            split=job.split or None,
            values=job.values,
            sensor=sweeps.sensors[sweeps.sensor[number]],
            number=int(sweeps.numbers[number]),
            time_ns=round(sweeps.begins_ns[number]),
            points=positions,
            columns=columns,
            pose=sweeps.pose.matrix(number),
            object_names=sweeps.object_names,
            faults=sweeps.faults_in(number),
            _boxes=(sweeps, boxes, index),
        )

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_boxes": self.boxes}  # without the boxes of further sweeps

    def __len__(self) -> int:
        return len(self.points)

    def __repr__(self) -> str:
        sensor = f" of {self.sensor}" if self.sensor else ""
        return f"<Sweep {self.number}{sensor} in job {self.job}: {len(self):,} points>"

    @cached_property
    def boxes(self) -> SweepBoxes:
        """Bounding boxes of the actors that are in the scene, in the sensor frame."""
        return SweepBoxes.select(*self._boxes) if isinstance(self._boxes, tuple) else self._boxes

    @property
    def intensity(self) -> Floats32 | None:
        """Received energy, float32 of shape (n,), or None if the data set lacks the column."""
        return self.columns.get("intensity")

    @property
    def classes(self) -> NDArray[np.uint16] | None:
        """Semantic classes, uint16 of shape (n,), or None if the data set lacks the column.

        Points without a class have the value 0.
        """
        return self.columns.get("class")

    @property
    def objects(self) -> Ints32 | None:
        """Indices into `object_names`, int32 of shape (n,), or None if the data set lacks them."""
        return self.columns.get("object")

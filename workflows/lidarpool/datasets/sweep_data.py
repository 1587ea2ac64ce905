"""A sweep of a job, as data sets and streams give it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from types import EllipsisType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarsim.base.arrays import AnyArray, Floats, Floats32, Ints32
from lidarsim.sensor import Fault
from lidarsim.sweeps.sweeps import Sweeps

from ..export.boxes import Boxes, SweepBoxes
from ..export.reading import PointColumns
from .job_table import JobRow, Value


@dataclass(frozen=True, eq=False, repr=False)
class Sweep:
    """A sweep of a sensor: its points, where the sensor was, and what was there.

    Axes are those of the sensor when the sweep began: x ahead, y to the left, z up, unless its
    mount is turned. The motion during the sweep is taken out of the points.
    """

    job: str  # name
    job_number: int
    split: str  # "" without splits
    values: Mapping[str, Value]  # what was varied, by its path
    sensor: str  # name; "" where there is only one
    number: int  # among the sweeps of its sensor in the job, from 0
    time_ns: int  # its start, nanoseconds since the start of the survey
    points: Floats32  # (n, 3): metres, in the sensor's axes
    columns: Mapping[str, AnyArray]  # {name: (n,)}: what the format holds beside
    pose: Floats  # (4, 4): from the sensor's axes to the world's
    object_names: tuple[str, ...]  # what the column `object` counts
    faults: tuple[Fault, ...]  # that the sensor has at some time of the sweep
    _boxes: SweepBoxes | tuple[Sweeps, Boxes | None, int | EllipsisType]  # or what they are made of

    @classmethod
    def of(
        cls, job: JobRow, sweeps: Sweeps, number: int, points: PointColumns,
        boxes: Boxes | None, which: int | EllipsisType = ...,
    ) -> Sweep:  # fmt: skip
        """Make the sweep of a number among all of a job; boxes are as of `SweepBoxes.of`."""
        return cls(
            job.name, job.number, job.split, job.values,
            sweeps.sensors[sweeps.sensor[number]], int(sweeps.numbers[number]),
            round(sweeps.begins_ns[number]), *points, sweeps.pose.matrix(number),
            sweeps.all_names, sweeps.faults_in(number), (sweeps, boxes, which),
        )  # fmt: skip

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_boxes": self.boxes}  # without those of all other sweeps

    def __len__(self) -> int:
        return len(self.points)

    def __repr__(self) -> str:
        sensor = f" of {self.sensor}" if self.sensor else ""
        return f"<Sweep {self.number}{sensor} in job {self.job}: {len(self):,} points>"

    @cached_property
    def boxes(self) -> SweepBoxes:
        """Boxes of the actors that are in the scene, in the sensor's axes."""
        return SweepBoxes.of(*self._boxes) if isinstance(self._boxes, tuple) else self._boxes

    @property
    def intensity(self) -> Floats32 | None:
        """float32 (n,): energy received, see the column; None if the data set lacks it."""
        return self.columns.get("intensity")

    @property
    def classes(self) -> NDArray[np.uint16] | None:
        """uint16 (n,): semantic classes, 0 for none; None if the data set lacks them."""
        return self.columns.get("class")

    @property
    def objects(self) -> Ints32 | None:
        """int32 (n,): instances, indices into `object_names`; None if the data set lacks them."""
        return self.columns.get("object")

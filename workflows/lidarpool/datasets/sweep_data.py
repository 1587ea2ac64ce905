"""A sweep of a data set, and the boxes of actors in it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..base.arrays import AnyArray, Floats, Floats32, Ints, Ints32
from ..sensor.trajectory import matrices
from .job_table import Value


@dataclass(frozen=True, eq=False)
class SweepBoxes:
    """Boxes of the actors that are in the scene during a sweep, (k) of them.

    Each is at its pose at the mean time of its points, or at the start of the sweep if it has none.
    """

    names: tuple[str, ...]
    types: tuple[str, ...]  # "Car" of "Car 1"
    objects: Ints32  # (k,): their numbers in the column `object`
    centres: Floats  # (k, 3): metres, in the sensor's axes
    quaternions: Floats  # (k, 4): x, y, z, w of the rotation from the box's axes to the sensor's
    sizes: Floats  # (k, 3): length, width and height, metres
    points: Ints  # (k,): how many points of the sweep are the actor's

    def __len__(self) -> int:
        return len(self.names)

    @property
    def yaw(self) -> Floats:
        """float64 (k,): angles in radians about the sensor's z axis, from x to y."""
        turns = matrices(self.quaternions)
        angles: Floats = np.arctan2(turns[:, 1, 0], turns[:, 0, 0])
        return angles


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
    boxes: SweepBoxes
    object_names: tuple[str, ...]  # what the column `object` counts

    def __len__(self) -> int:
        return len(self.points)

    def __repr__(self) -> str:
        sensor = f" of {self.sensor}" if self.sensor else ""
        return f"<Sweep {self.number}{sensor} in job {self.job}: {len(self):,} points>"

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

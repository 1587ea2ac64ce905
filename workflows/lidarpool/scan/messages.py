"""What travels between the four stages and the driver."""

from __future__ import annotations

import pickle
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from poolpart import TaskRecord

from ..survey import Pose, ScanSpec

# A hit as it leaves stage 2, 16 bytes: the position follows from these and the scan's
# description, so it is worked out where it is wanted, and only for the points that are kept.
HIT = np.dtype([("distance", "<f8"), ("ray", "<u4"), ("object", "<i4")])

# A point of the cloud as it leaves stage 4. `cell` is the position in multiples of the
# cloud's precision from the scene's local origin: whole numbers, so that rounding once is
# rounding for good.
POINT = np.dtype(
    [("cell", "<i4", (3,)), ("scan", "<u4"), ("ray", "<u4"), ("object", "<i4"), ("ring", "<u2")]
)


@dataclass(frozen=True)
class Frame:
    """One scan as stage 3 hands it out, in scan order.

    Parameters
    ----------
    scan
        Its number.
    pose
        Where the sensor stood, in the scene's local coordinates.
    rays, hits
        Rays fired, and those that hit something.
    triangles, counts
        int32 (k,): the triangles that were hit, and how many rays hit each.
    samples
        float32 (m, 3): where a few of the rays ended, metres, local coordinates.
    """

    scan: int
    pose: Pose
    rays: int
    hits: int
    triangles: NDArray[np.int32]
    counts: NDArray[np.int32]
    samples: NDArray[np.float32]


@dataclass(frozen=True)
class Batch:
    """What stage 2 made of one item: some scans, their hits and their frames.

    `hits` holds the hits of all `scans`, one scan after the other, `hit_counts` of each.
    """

    scans: tuple[ScanSpec, ...]
    hits: NDArray[Any]  # HIT
    hit_counts: tuple[int, ...]
    frames: tuple[Frame, ...]
    record: TaskRecord


@dataclass(frozen=True)
class Part:
    """Points that a collector gathered: whole scans, not necessarily neighbours.

    `points` holds those of all `scans`, one scan after the other, `counts` of each.
    """

    scans: tuple[int, ...]
    counts: tuple[int, ...]
    points: NDArray[Any]  # POINT


@dataclass(frozen=True)
class Attempt:
    """One start of a long-running stage.

    Parameters
    ----------
    run
        Id of the survey.
    name
        Name of the stage's task; of several that share a stage, "stage-number".
    number
        Tasks of long stages that the run had started before.
    """

    run: str
    name: str
    number: int

    @property
    def stage(self) -> str:
        """Name of the stage."""
        return self.name.partition("-")[0]

    @property
    def fields(self) -> dict[str, Any]:
        """What a trace tells of it."""
        return {"run": self.run, "stage": self.stage, "attempt": self.number}


@dataclass(frozen=True)
class Hello:
    """A consumer stage has started, perhaps again on another worker with nothing in memory."""


@dataclass(frozen=True)
class FrameRun:
    """Frames in order, and the records of the tasks that made them."""

    frames: tuple[Frame, ...]
    records: tuple[TaskRecord, ...]


@dataclass(frozen=True)
class Delivery:
    """What stages 3 and 4 send to the driver."""

    attempt: Attempt
    content: Hello | FrameRun | Part

    def wire(self) -> bytes:
        """Bytes to put into a pipe."""
        return pickle.dumps(self, protocol=5)

    @staticmethod
    def from_wire(data: bytes) -> Delivery:
        """Inverse of `wire`; for data from this run's own workers only."""
        delivery = pickle.loads(data)
        assert isinstance(delivery, Delivery)
        return delivery

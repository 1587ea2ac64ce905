"""Messages between the four stages and the driver: descriptions, summaries and receipts.

Their size does not depend on the number of points. They are plain data.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from poolpart import TaskRecord

from ..columns.cloud import Cloud
from ..sensor import Pose

SAMPLES_MOST = 4  # sample rays of a scan
SAMPLES_WANTED = 400  # of a survey


def samples_of_scan(scan_count: int) -> int:
    """Sample rays of each scan: fewer if there are many scans, because all are sent."""
    return max(1, min(SAMPLES_MOST, -(-SAMPLES_WANTED // scan_count)))


def summary_type(samples: int) -> np.dtype[np.void]:
    """Summary of a scan: hits, points kept, and ends of sample rays, metres, local coordinates.

    Missing samples are NaN.
    """
    return np.dtype([("hits", "<u4"), ("points", "<u4"), ("samples", "<f4", (samples, 3))])


@dataclass(frozen=True)
class Receipt:
    """A part is whole in storage.

    Parameters
    ----------
    first, stop
        Its scans.
    name
        Of the part.
    rows, size
        Its points and its bytes.
    hits
        Hits of its scans, before thinning out.
    cells
        Lowest and highest cell as six numbers; empty where there are no points.
    summaries
        Of its scans, as bytes of `summary_type`.
    records
        The tasks of stage 2 and 4 that made it.
    held_at
        Address of the worker that holds the part in memory because it does not see the storage;
        "" if the part is in storage.
    """

    first: int
    stop: int
    name: str
    rows: int
    size: int
    hits: int
    cells: tuple[int, ...]
    summaries: bytes
    records: tuple[TaskRecord, ...] = ()
    held_at: str = ""

    def wire(self) -> dict[str, Any]:
        """Plain data, for a pipe."""
        data = dict(self.__dict__)
        data["records"] = [pack_record(record) for record in self.records]
        return data

    @classmethod
    def from_wire(cls, data: Mapping[str, Any]) -> Receipt:
        """Inverse of `wire`."""
        records = tuple(unpack_record(record) for record in data["records"])
        return cls(**{**data, "records": records, "cells": tuple(data["cells"])})


def pack_record(record: TaskRecord) -> list[Any]:
    """Plain data of the record of a task."""
    return list(record.__dict__.values())


def unpack_record(data: Sequence[Any]) -> TaskRecord:
    """Inverse of `pack_record`."""
    stage, partition, worker, resources, *rest = data
    return TaskRecord(stage, partition, worker, tuple(resources), *rest)


@dataclass(frozen=True)
class Frame:
    """One scan from stage 3, in scan order, whose points are in storage.

    Parameters
    ----------
    scan
        Its number.
    sensor
        Name of its sensor; "" for a single one without a name.
    pose
        Pose of the sensor at its beginning, in the scene's local coordinates.
    rays, hits, count
        Rays fired, those that hit something, and points of the cloud.
    samples
        float32 (m, 3): ends of a few rays, metres, local coordinates.
    """

    scan: int
    sensor: str
    pose: Pose
    rays: int
    hits: int
    count: int
    samples: NDArray[np.float32]
    _read: Callable[[int], Cloud] = field(repr=False, compare=False)

    def points(self) -> Cloud:
        """Points of this scan, read from its part.

        Raises
        ------
        LidarpoolError
            If the part cannot be read, such as after a run that was not kept.
        """
        return self._read(self.scan)

"""The cloud: what a survey is for."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .errors import LidarpoolError

CHUNK_POINTS = 1_000_000  # in memory at a time where a cloud is read in order


class CloudLike(Protocol):
    """A cloud in memory or on disk, to be read in order, a part at a time."""

    def __len__(self) -> int: ...

    @property
    def bounds(self) -> NDArray[np.floating]:
        """Lowest and highest coordinates, (2, 3), metres, in the positions' type."""

    def chunks(self, points: int = CHUNK_POINTS) -> Iterator[Cloud]:
        """Give the points in order, at most so many at a time."""


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points of a survey, ordered by scan and ray.

    Parameters
    ----------
    positions
        float32 or float64 (n, 3), metres, world coordinates.
    scan
        int32 (n,), scan that a point comes from.
    ring
        uint16 (n,), layer of the sensor.
    object
        int32 (n,), id of the object hit.

    Raises
    ------
    LidarpoolError
        If the lengths differ, a position is not finite, or a number does not fit its type.
    """

    positions: NDArray[np.floating]
    scan: NDArray[np.int32]
    ring: NDArray[np.uint16]
    object: NDArray[np.int32]

    def __post_init__(self) -> None:
        positions = np.asarray(self.positions)
        if positions.dtype not in (np.float32, np.float64):
            positions = positions.astype(np.float64)
        scan = _whole("scan", self.scan, np.int32)
        ring = _whole("ring", self.ring, np.uint16)
        owner = _whole("object", self.object, np.int32)
        count = len(positions)
        shapes = (positions.shape, scan.shape, ring.shape, owner.shape)
        if shapes != ((count, 3), (count,), (count,), (count,)):
            raise LidarpoolError(
                "A cloud needs positions of (n, 3) and scan, ring and object of (n,); "
                f"given: {', '.join(map(str, shapes))}."
            )
        if not np.isfinite(positions).all():
            raise LidarpoolError("A point of the cloud is NaN or infinite; it cannot be kept.")
        for name, array in zip(
            ("positions", "scan", "ring", "object"), (positions, scan, ring, owner), strict=True
        ):
            object.__setattr__(self, name, array)

    def __len__(self) -> int:
        return len(self.positions)

    @property
    def bounds(self) -> NDArray[np.floating]:
        """Lowest and highest coordinates, (2, 3), metres; zeros where there are no points."""
        if not len(self):
            return np.zeros((2, 3), self.positions.dtype)
        return np.stack([self.positions.min(axis=0), self.positions.max(axis=0)])

    def chunks(self, points: int = CHUNK_POINTS) -> Iterator[Cloud]:
        """Give the points in order, at most so many at a time, as views."""
        for first in range(0, len(self), points):
            part = slice(first, first + points)
            yield Cloud(self.positions[part], self.scan[part], self.ring[part], self.object[part])


def counts_by_object(cloud: CloudLike, objects: int) -> NDArray[np.int64]:
    """Count the points of each object: (objects,)."""
    counts = np.zeros(objects, np.int64)
    for chunk in cloud.chunks():
        counts += np.bincount(chunk.object, minlength=objects)
    return counts


def _whole(name: str, values: ArrayLike, kind: type[np.integer[Any]]) -> NDArray[Any]:
    """`values` as integers of type `kind`, where a plain cast would wrap around."""
    given = np.asarray(values)
    cast = given.astype(kind, copy=False)
    if not np.array_equal(cast, given):
        limits = np.iinfo(kind)
        raise LidarpoolError(
            f"{name} holds {given.min()} to {given.max()}; it must be whole numbers of "
            f"{limits.min} to {limits.max}."
        )
    return cast

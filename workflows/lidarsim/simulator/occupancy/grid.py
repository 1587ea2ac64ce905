"""Extent of a voxel grid, and its content for a sweep."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from ...errors import LidarError
from ...numerics.arrays import Bools, Floats, Ints32

GridFrame = Literal["platform", "sensor"]
MAX_VOXELS = 100_000_000
FREE = -1  # instance of voxels without an object


@dataclass(frozen=True)
class VoxelGrid:
    """Extent and voxel size of a grid.

    Parameters
    ----------
    lower, upper
        Opposite corners of the grid in meters, as (x, y, z) in the frame of the grid.
    voxel_m
        Edge length of a voxel in meters.

    Raises
    ------
    LidarError
        If the extent is not a positive multiple of the voxel size, or if there are too many voxels.

    Examples
    --------
    >>> VoxelGrid((-40, -40, -1), (40, 40, 5.4), 0.4).shape
    (200, 200, 16)
    """

    lower: tuple[float, float, float]
    upper: tuple[float, float, float]
    voxel_m: float

    def __post_init__(self) -> None:
        values = (*self.lower, *self.upper, self.voxel_m)
        if not (np.isfinite(values).all() and self.voxel_m > 0):
            raise LidarError(
                "The corners of a voxel grid must be finite and the voxel size must be positive, "
                f"but they are {self.lower}, {self.upper} and {self.voxel_m}."
            )
        cells = (np.array(self.upper) - self.lower) / self.voxel_m
        if (cells < 0.5).any() or (np.abs(cells - np.rint(cells)) > 1e-6 * cells).any():
            raise LidarError(
                f"The extent of a voxel grid must be a multiple of the voxel size, {self.voxel_m:g}"
                f" m, but it is {' x '.join(f'{cell * self.voxel_m:g}' for cell in cells)} m."
            )
        if np.prod(cells) > MAX_VOXELS:
            raise LidarError(
                f"A voxel grid can have at most {MAX_VOXELS:,} voxels, but this one has "
                f"{np.prod(np.rint(cells)):,.0f}. Use larger voxels or a smaller extent."
            )

    @property
    def shape(self) -> tuple[int, int, int]:
        """Number of voxels along x, y and z."""
        x, y, z = np.rint((np.array(self.upper) - self.lower) / self.voxel_m).astype(int).tolist()
        return x, y, z

    def to_voxels(self, points: Floats) -> Floats:
        """Convert points (n, 3) from meters to voxels, counted from the lower corner."""
        return np.asarray((points - np.array(self.lower, np.float64)) / self.voxel_m)


class Occupancy(NamedTuple):
    """Content of a voxel grid at the start of a sweep.

    All arrays have the shape of the grid.
    """

    classes: Ints32  # class of the surface or solid; 0 if the voxel is free or has no class
    instances: Ints32  # number of the object in `Scene.object_names`, or `FREE`
    observed: Bools  # whether a ray of the sweep passes through the voxel or ends in it
    hit: Bools  # whether a ray of the sweep hits a surface in the voxel
    observed_later: Bools  # as `observed`, or by a ray of one of the following sweeps

    @property
    def occupied(self) -> Bools:
        """Whether each voxel intersects a surface, or has its center inside a closed surface."""
        return np.asarray(self.instances != FREE)

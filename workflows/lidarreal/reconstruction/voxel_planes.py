"""Planes of a map, which are derived from the mean points of neighboring voxels."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lidarscenario.points.point_scene import PointVoxels
from lidarsim.numerics.arrays import Bools, Floats, Ints

_NEIGHBORS = 12
_MAX_FLAT = 0.1  # maximum variance along the normal relative to the smaller variance in the plane
_CELL_BITS = 21  # bits per cell coordinate
_CELL_MASK = (1 << _CELL_BITS) - 1
_MIN_WIDTH = 0.05  # minimum ratio of the variances within a plane, below which it is a line


def cell_keys(points: Floats, cell_m: float) -> Ints:
    """Return an integer for each point that is the same for points in the same cubic cell.

    The points have shape (n, 3), in meters. The keys repeat after 2 million cells.
    """
    cells = np.floor(points / cell_m).astype(np.int64) & _CELL_MASK
    return np.asarray((cells[:, 0] << 2 * _CELL_BITS) | (cells[:, 1] << _CELL_BITS) | cells[:, 2])


def smallest_by_cell(keys: Ints, values: Floats) -> tuple[Ints, Floats]:
    """Return the distinct cells in ascending order, and the smallest value in each of them."""
    cells, row = np.unique(keys, return_inverse=True)
    smallest = np.full(len(cells), np.inf)
    np.minimum.at(smallest, row, values)
    return cells, smallest


@dataclass(frozen=True, eq=False)
class VoxelPlanes:
    """Mean points of voxels whose neighborhoods are planar."""

    centers: Floats  # (p, 3), meters
    normals: Floats  # (p, 3), unit vectors with arbitrary sign
    tree: Any  # scipy.spatial.cKDTree of the centers
    thickness_m: float  # median standard deviation of the neighbors along the normals

    @classmethod
    def from_points(cls, name: str, points: Floats, voxel_m: float) -> VoxelPlanes | None:
        """Find the planes in a point cloud, or return None if there are none.

        The points have shape (n, 3).

        Raises
        ------
        LidarError
            If the points are too far apart to be sorted into voxels.
        """
        from scipy.spatial import cKDTree

        means = PointVoxels.from_points(Path(name), points, voxel_m).means(points)
        if len(means) < _NEIGHBORS:
            return None
        _, neighbors = cKDTree(means).query(means, _NEIGHBORS)
        around = means[neighbors]
        centers = around.mean(axis=1)
        around -= centers[:, None]
        covariances = np.einsum("nki,nkj->nij", around, around) / _NEIGHBORS
        variances, axes = np.linalg.eigh(covariances)
        flat = _is_plane(variances)
        if not flat.any():
            return None
        normals = axes[flat, :, 0]
        centers = centers[flat]
        thickness_m = float(np.sqrt(np.median(np.maximum(variances[flat, 0], 0))))
        return cls(centers, normals, cKDTree(centers), thickness_m)

    def distances(self, points: Floats, max_m: float) -> tuple[Floats, Ints, Bools]:
        """Return the signed distance between each point and its nearest plane.

        Parameters
        ----------
        points
            Points of shape (n, 3).
        max_m
            Maximum distance between a point and the center of its plane.

        Returns
        -------
        tuple of arrays
            Distances of shape (k,), indices of the planes of shape (k,), and a mask of shape (n,)
            of the k points that are close enough to a plane.
        """
        distance, plane = self.tree.query(points, distance_upper_bound=max_m)
        near = np.isfinite(distance)
        plane = plane[near]
        offsets = points[near] - self.centers[plane]
        return np.einsum("ij,ij->i", offsets, self.normals[plane]), plane, near


def _is_plane(variances: Floats) -> Bools:
    smallest, middle, largest = variances.T
    return np.asarray((smallest < _MAX_FLAT * middle) & (middle > _MIN_WIDTH * largest))

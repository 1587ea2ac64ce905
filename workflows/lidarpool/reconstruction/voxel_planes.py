"""Planes of a map, from the means of points in voxels and the normals of their neighborhoods."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lidarsim.numerics.arrays import Bools, Floats, Ints

from ..scenario.point_scene import PointVoxels

_NEIGHBORS = 12
_MAX_FLAT = 0.1  # maximum variance along the normal relative to the smaller variance in the plane
_MIN_WIDTH = 0.05  # minimum ratio of the variances within a plane, below which it is a line


@dataclass(frozen=True, eq=False)
class VoxelPlanes:
    """Means of the points in voxels whose neighbors lie in a plane."""

    centers: Floats  # (p, 3), meters
    normals: Floats  # (p, 3), unit vectors with arbitrary sign
    tree: Any  # scipy.spatial.cKDTree of the centers
    thickness_m: float  # median standard deviation of the neighbors along the normals

    @classmethod
    def from_points(cls, name: str, points: Floats, voxel_m: float) -> VoxelPlanes | None:
        """Find planes in points of shape (n, 3), or return None if there are none.

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
        """Return signed distances between points and their nearest planes.

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
    """Return which neighborhoods are planes, given their ascending variances of shape (n, 3)."""
    smallest, middle, largest = variances.T
    return np.asarray((smallest < _MAX_FLAT * middle) & (middle > _MIN_WIDTH * largest))

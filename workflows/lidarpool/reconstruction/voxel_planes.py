"""Planes of a place: means of points in voxels, and the normals of their neighborhoods."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lidarsim.numerics.arrays import Bools, Floats, Ints

from ..scenario.point_scene import PointVoxels

_NEIGHBORS = 12
_MAX_FLAT = 0.1  # variance along the normal of a plane, over the smaller variance within it
_MIN_WIDTH = 0.05  # smaller over larger variance within a plane: less is a line


@dataclass(frozen=True, eq=False)
class VoxelPlanes:
    """Means of the points in voxels whose neighbors lie in a plane."""

    centers: Floats  # (p, 3): meters
    normals: Floats  # (p, 3): unit vectors, of either side
    tree: Any  # scipy.spatial.cKDTree of the centers
    thickness_m: float  # median standard deviation of the neighbors along the normals

    @classmethod
    def of_points(cls, name: str, points: Floats, voxel_m: float) -> VoxelPlanes | None:
        """Find planes among points (n, 3) of a recording, or return None without planes.

        LidarError if the points are too far apart to be sorted into voxels.
        """
        from scipy.spatial import cKDTree

        means = PointVoxels.from_points(Path(name), points, voxel_m).means(points)
        if len(means) < _NEIGHBORS:
            return None
        _, neighbors = cKDTree(means).query(means, _NEIGHBORS)
        around = means[neighbors]
        middles = around.mean(axis=1)
        around -= middles[:, None]
        covariances = np.einsum("nki,nkj->nij", around, around) / _NEIGHBORS
        variances, axes = np.linalg.eigh(covariances)
        flat = _is_plane(variances)
        if not flat.any():
            return None
        normals = axes[flat, :, 0]
        middles = middles[flat]
        thickness_m = float(np.sqrt(np.median(np.maximum(variances[flat, 0], 0))))
        return cls(middles, normals, cKDTree(middles), thickness_m)

    def distances(self, points: Floats, max_m: float) -> tuple[Floats, Ints, Bools]:
        """Return signed distances (k,) of points (n, 3) to their planes, the planes, and a mask.

        The mask (n,) marks the points that are within `max_m` of the center of a plane.
        """
        distance, plane = self.tree.query(points, distance_upper_bound=max_m)
        near = np.isfinite(distance)
        plane = plane[near]
        offsets = points[near] - self.centers[plane]
        return np.einsum("ij,ij->i", offsets, self.normals[plane]), plane, near


def _is_plane(variances: Floats) -> Bools:
    """Mark neighborhoods that are planes by their variances (n, 3), ascending."""
    smallest, middle, largest = variances.T
    return np.asarray((smallest < _MAX_FLAT * middle) & (middle > _MIN_WIDTH * largest))

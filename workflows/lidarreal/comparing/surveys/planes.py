"""Signed distances from points to planes that are fitted to the nearest points of a cloud."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lidarfiles.open3d_access.neighbors import NeighborSearch
from lidarsim.errors import LidarError
from lidarsim.io.writing_progress import WritingProgress
from lidarsim.numerics.arrays import Bools, Floats, Indices
from lidarsim.numerics.even_samples import even_indices

from .deviations import Deviations, normal_columns
from .orientation import OrientedPoints, nearby_scanners, thin_out
from .survey_clouds import SurveyPoints

_BATCH = 100_000  # points per batch, which limits the memory for their neighbors
_NEIGHBORS = 24  # maximum number of points that determine a plane
_MIN_NEIGHBORS = 6
_MIN_WIDTH = 0.2  # minimum width of a neighborhood relative to its length, to exclude lines
_SAMPLES = 2000
_MAX_ORIENTED = 200_000  # points at which the orientation of surfaces is determined


class _Planes(NamedTuple):
    centers: Floats  # (n, 3)
    normals: Floats  # (n, 3)
    rms_m: Floats  # (n,): root mean square distance of the neighbors from the plane
    are_valid: Bools  # (n,)

    def select(self, rows: Bools) -> _Planes:
        return _Planes(
            self.centers[rows], self.normals[rows], self.rms_m[rows], self.are_valid[rows]
        )


def neighborhood_radius(points: Floats) -> float:
    """Return the radius in meters within which half of the points have at least 20 neighbors.

    It is rounded to two significant digits.
    """
    count = min(20, len(points) - 1)
    if count < _MIN_NEIGHBORS:
        raise LidarError(
            f"Planes require at least {_MIN_NEIGHBORS + 1} points, but a cloud has {len(points)}."
        )
    rows = even_indices(len(points), _SAMPLES)
    distance, _ = NeighborSearch(points).nearest(points[rows], count + 1)
    return float(f"{max(np.median(distance[:, -1]), 1e-4):.2g}")


def plane_deviations(
    points: SurveyPoints,
    reference: SurveyPoints,
    radius_m: float,
    max_distance_m: float,
    show: WritingProgress = lambda *_: None,
) -> Deviations:
    """Return the signed distances from points to planes through the reference.

    The plane for a point is fitted to the neighbors of the nearest reference point within
    `radius_m`, at most 24. Distances are positive on the side of the scanner or, if its position is
    unknown, on the side that `OrientedPoints` selects for the whole surface.

    Parameters
    ----------
    points, reference
        Points of A and B.
    radius_m
        Maximum radius of the neighborhoods.
    max_distance_m
        Points farther than this from the reference have no counterpart.
    show
        Called after the planes of each batch of points have been fitted.
    """
    origin = reference.positions.mean(axis=0)
    points = points.relative_to(origin)
    planes = _ReferencePlanes(reference.relative_to(origin), points, radius_m, show)
    distances, roughness = np.full((2, len(points)), np.nan)
    normals = np.zeros((len(points), 3), np.float32)
    too_far = 0
    for start in range(0, len(points), _BATCH):
        rows = np.arange(start, min(start + _BATCH, len(points)))
        separation, nearest = planes.search.nearest(points.positions[rows])
        is_near = separation[:, 0] <= max_distance_m
        too_far += int(np.count_nonzero(~is_near))
        rows = rows[is_near]
        distances[rows], roughness[rows], normals[rows] = planes.distances(
            rows, nearest[is_near, 0]
        )
        show("fitting planes", min(start + _BATCH, len(points)), len(points), "points")
    found = np.isfinite(distances)
    if not found.any():
        raise LidarError(
            f"None of the points of A has a plane in B within {max_distance_m:g} m. Increase "
            "`--max-distance`, or `--radius` if the points of B are sparse."
        )
    figures = {
        "radius_m": radius_m,
        "max_distance_m": max_distance_m,
        "plane_rms_m": float(np.median(roughness[found])),
        "without_counterpart": too_far,
        "without_plane": int(len(points) - found.sum() - too_far),
    }
    columns = normal_columns(normals[found]) | {"plane_rms": roughness[found]}
    return Deviations(
        points.positions[found] + origin, {"distance": distances[found]}, figures, columns=columns
    )


class _ReferencePlanes:
    """Oriented planes through the neighborhoods of reference points."""

    def __init__(
        self,
        reference: SurveyPoints,
        points: SurveyPoints,
        radius_m: float,
        show: WritingProgress,
    ) -> None:
        self.search = NeighborSearch(reference.positions, radius_m)
        self._reference = reference
        self._points = points
        self._show = show
        self._surfaces = self._orient_surfaces(radius_m)

    def _orient_surfaces(self, spacing_m: float) -> OrientedPoints:
        """Orient the normals at evenly distributed reference points."""
        rows = thin_out(self._reference.positions, spacing_m)
        while len(rows) > _MAX_ORIENTED:
            spacing_m *= 1.1 * np.sqrt(len(rows) / _MAX_ORIENTED)
            rows = thin_out(self._reference.positions, spacing_m)
        parts = []
        for start in range(0, len(rows), _BATCH):
            parts.append(self._fit(rows[start : start + _BATCH]))
            fitted = min(start + _BATCH, len(rows))
            self._show("finding surfaces", fitted, len(rows), "planes")
        planes = _Planes(*map(np.concatenate, zip(*parts, strict=True)))
        if planes.are_valid.any():
            rows, planes = rows[planes.are_valid], planes.select(planes.are_valid)
        scanners = nearby_scanners(self._reference, rows, self._points)
        return OrientedPoints.from_normals(planes.centers, planes.normals, scanners, spacing_m)

    def _fit(self, rows: Indices) -> _Planes:
        return _fit_planes(self.search, self._reference.positions, rows)

    def distances(self, rows: Indices, nearest: Indices) -> tuple[Floats, Floats, Floats]:
        """Return distances of points of A, RMS distances of the planes' own points, and normals.

        The distances are NaN if the nearest reference point has no plane.

        Parameters
        ----------
        rows
            Rows of the points of A.
        nearest
            Rows of the reference points that are nearest to them.
        """
        distances, rms_m = np.full((2, len(rows)), np.nan)
        all_normals = np.zeros((len(rows), 3))
        planes = self._fit(nearest)
        valid = planes.are_valid
        if valid.any():
            planes = planes.select(valid)
            scanners = self._points.scanner_positions(rows[valid])
            if self._reference.has_scanners:
                scanners = self._reference.scanner_positions(nearest[valid])
            normals = self._surfaces.orient(planes.centers, planes.normals, scanners)
            offsets = self._points.positions[rows[valid]] - planes.centers
            distances[valid] = np.einsum("ni,ni->n", offsets, normals)
            rms_m[valid] = planes.rms_m
            all_normals[valid] = normals
        return distances, rms_m, all_normals


def _fit_planes(search: NeighborSearch, reference: Floats, rows: Indices) -> _Planes:
    """Fit planes to the neighborhoods of reference points. Their normals are not oriented."""
    index, counts = search.within(reference[rows], _NEIGHBORS)
    is_neighbor = np.arange(_NEIGHBORS) < counts[:, None]
    neighbors = reference[np.where(is_neighbor, index, 0)]
    weights = is_neighbor[..., None]
    centers = (neighbors * weights).sum(axis=1) / np.maximum(counts, 1)[:, None]
    offsets = (neighbors - centers[:, None]) * weights
    squares, axes = np.linalg.eigh(offsets.swapaxes(1, 2) @ offsets)
    are_valid = (counts >= _MIN_NEIGHBORS) & (squares[:, 1] >= _MIN_WIDTH**2 * squares[:, 2])
    rms_m = np.sqrt(np.maximum(squares[:, 0], 0) / np.maximum(counts, 1))
    return _Planes(centers, axes[:, :, 0], rms_m, are_valid)

"""Distances by M3C2 (Lague et al. 2013), computed by py4dgeo."""

from __future__ import annotations

import logging
from functools import partial
from typing import Any

import numpy as np

from lidarfiles.open3d_access.neighbors import NeighborSearch
from lidarsim.environment.extras import require_package
from lidarsim.errors import LidarError
from lidarsim.numerics.arrays import Bools, Floats, Indices

from .deviations import Deviations, normal_columns
from .orientation import OrientedPoints, nearby_scanners, thin_out
from .survey_clouds import SurveyPoints

_MAX_CORE_POINTS = 500_000
_UNIT_ERROR = 1e-6  # maximum deviation of the length of a normal


def m3c2_deviations(
    points: SurveyPoints, reference: SurveyPoints, radius_m: float, max_distance_m: float
) -> Deviations:
    """Return M3C2 distances of A from B at core points, with their level of detection.

    There is one core point in each cubic cell of `radius_m` that contains points of B. Normals are
    computed from the points of B within `radius_m`. They point to the scanner or, if its position
    is unknown, to the side that `OrientedPoints` selects for the whole surface. Points of A and B
    within a cylinder of this radius, up to `max_distance_m` along the normal in both directions,
    are averaged.

    Parameters
    ----------
    points, reference
        Points of A and B.
    radius_m
        Radius of the neighborhoods and of the cylinders.
    max_distance_m
        Half the length of the cylinders.
    """
    require_package("py4dgeo", "m3c2", "`--survey m3c2`")
    import py4dgeo

    logging.getLogger("py4dgeo").setLevel(logging.WARNING)
    origin = np.floor(reference.positions.mean(axis=0))
    points, reference = points.relative_to(origin), reference.relative_to(origin)
    rows = thin_out(reference.positions, radius_m)
    if len(rows) > _MAX_CORE_POINTS:
        raise LidarError(
            f"A radius of {radius_m:g} m results in {len(rows):,} core points; the limit is "
            f"{_MAX_CORE_POINTS:,}. Increase `--radius`."
        )
    algorithm = partial(
        py4dgeo.M3C2,
        epochs=tuple(
            py4dgeo.Epoch(np.ascontiguousarray(cloud.positions)) for cloud in (reference, points)
        ),
        normal_radii=[radius_m],
        cyl_radius=radius_m,
        max_distance=max_distance_m,
    )
    normals = np.asarray(algorithm(corepoints=reference.positions[rows]).directions())
    have_plane = _have_plane(reference.positions, rows, normals, radius_m)
    without_plane = int(np.count_nonzero(~have_plane))
    rows = rows[have_plane]
    normals = OrientedPoints.from_normals(
        reference.positions[rows],
        normals[have_plane],
        nearby_scanners(reference, rows, points),
        radius_m,
    ).normals
    core_points = reference.positions[rows]
    distances, uncertainties = algorithm(corepoints=core_points, corepoint_normals=normals).run()
    found = np.isfinite(distances)
    detection = np.asarray(uncertainties["lodetection"], np.float64)
    if not found.any():
        raise LidarError(
            f"No core point has points of both clouds within a radius of {radius_m:g} m and a "
            f"distance of {max_distance_m:g} m. Increase `--radius` or `--max-distance`."
        )
    figures = {
        "radius_m": radius_m,
        "max_distance_m": max_distance_m,
        "without_counterpart": int(np.count_nonzero(~found)),
        "without_plane": without_plane,
        "level_of_detection": _level_figures(distances[found], detection[found]),
    }
    columns = normal_columns(normals[found]) | {"level_of_detection": detection[found]}
    return Deviations(
        core_points[found] + origin, {"distance": distances[found]}, figures, columns=columns
    )


def _level_figures(distances: Floats, detection: Floats) -> dict[str, Any]:
    """Return the median level of detection, and the number of distances that exceed it."""
    has_level = np.isfinite(detection)
    return {
        "core_points": int(np.count_nonzero(has_level)),
        "median_m": float(np.median(detection[has_level])) if has_level.any() else None,
        "significant": int(np.count_nonzero(has_level & (np.abs(distances) > detection))),
    }


def _have_plane(points: Floats, rows: Indices, normals: Floats, radius_m: float) -> Bools:
    """Mark points whose normals are determined by their neighbors within a radius.

    py4dgeo leaves the normals of other points uninitialized.

    Raises
    ------
    LidarError
        If there are none.
    """
    distances, _ = NeighborSearch(points).nearest(points[rows], min(3, len(points)))
    with np.errstate(over="ignore", invalid="ignore"):
        are_unit = np.abs(np.linalg.norm(normals, axis=1) - 1) < _UNIT_ERROR
    have_plane = are_unit & (distances[:, -1] <= radius_m)
    if len(points) < 3 or not have_plane.any():
        raise LidarError(
            f"No point of B has two neighbors within a radius of {radius_m:g} m. Increase "
            "`--radius`."
        )
    return np.asarray(have_plane)

"""Color the surfaces of a scene by the number of hits per square meter."""

from __future__ import annotations

import itertools
import math

import numpy as np

from lidarfiles.color_table import TURBO
from lidarsim.numerics.arrays import AnyArray, Bools, Floats, Floats32, Indices, Ints, Ints32
from lidarsim.scene.scene import Scene
from lidarsim.scene.scene_mesh import triangle_areas

from .theme import UNSEEN, rgb

_GRID_LEVELS = 24  # number of times that the width of the grid cells is halved
_MIN_HITS = 12  # minimum number of hits, or points in a grid cell, for estimating a density
_MAX_ROUNDS = 12
_MAX_RATIO = 300.0  # maximum ratio between the ends of the scale


def hit_colors(
    scene: Scene, corners: Floats32, hit_counts: Floats, points: Floats32, max_pieces: int
) -> tuple[Floats32, Ints, Floats, tuple[float, float]]:
    """Color triangles by hits per square meter, dividing large triangles with many hits.

    On a large triangle, the density is counted in the finest grid that has enough points in each
    cell. Small triangles share their hits with neighbors, as in `hit_density`.

    Parameters
    ----------
    scene
        Scene with the drawn triangles.
    corners
        (f, 3, 3) corners of the triangles, in meters.
    hit_counts
        (f,) hits on each triangle.
    points
        (n, 3) evenly spaced sample of the hit points, which may have gaps.
    max_pieces
        Maximum number of pieces.

    Returns
    -------
    pieces
        (k, 3, 3) corners of the pieces. The first piece of each triangle has the number of the
        triangle.
    owner
        (k,) triangle of each piece.
    colors
        (k, 3, 3) colors at the corners.
    limits
        Limits of the logarithmic scale in hits per square meter. The colors of the scale are
        `TURBO`.
    """
    triangle_density = hit_density(scene, hit_counts)
    pieces, owner, areas, point_density = _divide(corners, hit_counts > 0, points, max_pieces)
    is_counted = np.isfinite(point_density)
    piece_density = triangle_density[owner]
    if point_density[is_counted].any():
        hit_count = (piece_density * areas)[is_counted].sum()
        point_count = (point_density * areas)[is_counted].sum()
        piece_density[is_counted] = hit_count / point_count * point_density[is_counted]
    limits = _density_range(piece_density, areas)
    corner_density = np.repeat(piece_density[:, None], 3, axis=1)
    if is_counted.any():
        corner_density[is_counted] = _corner_means(
            pieces[is_counted], areas[is_counted], corner_density[is_counted]
        )
    # Gray depends on the point density where points were counted, otherwise on the known hits.
    colors = _density_colors(
        corner_density, (~is_counted & (hit_counts[owner] > 0))[:, None], limits
    )
    return pieces, owner, colors, limits


def hits_title(limits: tuple[float, float]) -> str:
    """Return the title of a hit density scale between two limits.

    Examples
    --------
    >>> hits_title((34.6, 9000.0))
    'hits per square meter (gray: fewer than 35)'
    """
    return f"hits per square meter (gray: fewer than {density_label(limits[0])})"


def density_label(density: float) -> str:
    """Format a hit density as a label."""
    return f"{density:.2g}" if density < 10 else f"{density:,.0f}"


def _corner_means(pieces: Floats32, areas: Floats, density: Floats) -> Floats:
    """Return the mean density of all pieces around each corner.

    This makes transitions smooth. `pieces` (k, 3, 3) contains the corners, and `areas` (k,) is in
    square meters. `density` and the result (k, 3) are given at the corners.
    """
    corner_keys = np.ascontiguousarray(pieces).view("V12").ravel()
    _, corner = np.unique(corner_keys, return_inverse=True)
    corner_areas = np.repeat(areas, 3)
    corner_hits = np.bincount(corner, corner_areas * density.ravel())
    means = corner_hits / np.bincount(corner, corner_areas)
    return means[corner].reshape(-1, 3)


def hit_density(scene: Scene, hit_counts: AnyArray) -> Floats:
    """Return the number of hits per square meter on each triangle.

    If most triangles are so small that they have at most one hit, neighbors share their hits. Each
    triangle passes a third of its hits to each corner, and each corner distributes them by area.
    This is repeated until a density is estimated from a dozen hits. The total number of hits is
    preserved.
    """
    hits = hit_counts.astype(np.float64)
    area = triangle_areas(scene.vertices[scene.faces])
    for _ in range(_rounds(hits)):
        hits = _share(scene.faces, hits, area, len(scene.vertices))
    return np.divide(hits, area, out=np.zeros_like(hits), where=area > 0)


def _rounds(hit_counts: Floats) -> int:
    """Choose how many times hits are distributed among neighboring triangles."""
    hit = hit_counts[hit_counts > 0]
    if not len(hit):
        return 0
    # Counts of one do not reveal how many triangles were missed. Assume three times as many as were
    # hit, so that the rings of a sparse scan merge.
    typical = hit.mean() if hit.mean() > 3 else hit.mean() / 3
    return min(_MAX_ROUNDS, math.floor(_MIN_HITS / typical / 2))


def _share(faces: Ints32, hit_counts: Floats, area: Floats, vertices: int) -> Floats:
    """Distribute hits by area over the triangles that share a corner."""
    corner_hits = np.zeros(vertices)
    corner_areas = np.zeros(vertices)
    for corner in faces.T:
        corner_hits += np.bincount(corner, weights=hit_counts / 3, minlength=vertices)
        corner_areas += np.bincount(corner, weights=area, minlength=vertices)
    density = np.divide(
        corner_hits, corner_areas, out=np.zeros_like(corner_hits), where=corner_areas > 0
    )
    shared = area * density[faces].sum(axis=1)
    # Triangles without area have no density and keep their hits.
    return np.where(area > 0, shared, hit_counts)


def _density_range(density: Floats, areas: Floats) -> tuple[float, float]:
    """Choose the limits of a logarithmic density scale.

    Few hits are on surfaces below the lower limit, and little area is above the upper limit.
    """
    lower = 1.0
    upper = 10.0
    if (density * areas).any():
        lower, upper = (
            np.percentile(density, end, weights=weights, method="inverted_cdf")
            for end, weights in ((2, density * areas), (99.5, areas * (density > 0)))
        )
    lower = max(lower, upper / _MAX_RATIO)
    return float(lower), float(max(upper, 2 * lower))


def _density_colors(density: Floats, hit: Bools, limits: tuple[float, float]) -> Floats:
    """Return colors for densities.

    Surfaces that only share the hits of their neighbors fade to gray at low densities. Surfaces
    with hits, marked by the mask `hit` (...,), never do.
    """
    lower, upper = limits
    fraction = np.log(np.maximum(density, lower) / lower) / np.log(upper / lower)
    colors = TURBO[np.clip(fraction * 255, 0, 255).astype(np.int64)]
    opacity = np.where(hit, 1.0, np.clip(density / lower / 0.6 - 0.3, 0, 1))[..., None]
    return np.asarray(rgb(UNSEEN) * (1 - opacity) + colors * opacity)


def _divide(
    pieces: Floats32, hit: Bools, points: Floats32, max_pieces: int
) -> tuple[Floats32, Ints, Floats, Floats]:
    """Divide triangles with hits repeatedly, as long as their grid cells have enough points.

    Returns the pieces with their owners, areas, and points per square meter. The points per square
    meter are NaN for undivided triangles.
    """
    owner = np.arange(len(pieces))
    areas = triangle_areas(pieces)
    point_density = np.full(len(pieces), np.nan)
    active = hit & bool(len(points))
    if not active.any():
        return pieces, owner, areas, point_density
    lower = np.minimum(points.min(axis=0), pieces.min(axis=(0, 1)))
    width = float(_longest(pieces)[1].max())
    unit_weights = np.ones(len(points))
    for _ in range(_GRID_LEVELS):
        is_hit = hit[owner]
        centers = pieces.mean(axis=1)
        point_count = _WeightGrid(points, unit_weights, width, lower).interpolate(centers[active])
        area = _WeightGrid(centers[is_hit], areas[is_hit], width, lower).interpolate(
            centers[active]
        )
        # Cells with few points are not divided again, so this density is final.
        parts = np.bincount(owner)[owner[active]]
        point_density[active] = np.where(parts > 1, point_count / np.maximum(area, 1e-30), np.nan)
        active[active] = point_count >= _MIN_HITS
        width /= 2
        while True:
            indices = np.flatnonzero(active)
            indices = indices[_longest(pieces[indices])[1] > width]
            if not len(indices):
                break
            if len(pieces) + len(indices) > max_pieces:
                return pieces, owner, areas, point_density
            halves = _halved(pieces[indices])
            pieces = np.concatenate([pieces, halves[1]])
            pieces[indices] = halves[0]
            areas[indices] /= 2
            owner, areas, point_density, active = (
                np.append(values, values[indices])
                for values in (owner, areas, point_density, active)
            )
        if not active.any():
            break
    return pieces, owner, areas, point_density


class _WeightGrid:
    """Sum of the weights of all positions in each cell of a grid."""

    def __init__(self, positions: Floats32, weights: Floats, width: float, lower: Floats32) -> None:
        self._width = width
        self._lower = lower
        cells = np.floor((positions - lower) / width).astype(np.int64)
        self._keys, cells = np.unique(_keys(cells), return_inverse=True)
        self._sums = np.bincount(cells, weights)

    def interpolate(self, positions: Floats32) -> Floats:
        """Return the sums at positions, interpolated between the eight nearest cells."""
        offsets = (positions - self._lower) / self._width - 0.5
        total = np.zeros(len(positions))
        cells = np.floor(offsets).astype(np.int64)
        fraction = offsets - cells
        for step in itertools.product((0, 1), repeat=3):
            keys = _keys(cells + step)
            index = np.minimum(np.searchsorted(self._keys, keys), len(self._keys) - 1)
            weight = np.where(step, fraction, 1 - fraction).prod(axis=1)
            total += np.where(self._keys[index] == keys, weight * self._sums[index], 0.0)
        return total


def _keys(cells: Ints) -> Ints:
    """Return a unique number for each cell."""
    cells = cells + 1  # so that neighbors of the lowest cell are not negative
    return (cells[:, 0] << 42) | (cells[:, 1] << 21) | cells[:, 2]


def _longest(pieces: Floats32) -> tuple[Indices, Floats32]:
    """Return the index and the length of each piece's longest edge.

    Both arrays have shape (k,).
    """
    lengths = np.linalg.norm(pieces - np.roll(pieces, -1, axis=1), axis=2)
    return lengths.argmax(axis=1), lengths.max(axis=1)


def _halved(pieces: Floats32) -> tuple[Floats32, Floats32]:
    rows = np.arange(len(pieces))
    edge = _longest(pieces)[0]
    a, b, c = (pieces[rows, (edge + k) % 3] for k in range(3))
    middle = (a + b) / 2
    return np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)

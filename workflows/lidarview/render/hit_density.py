"""Colours of a scene's surfaces by hits per square metre."""

from __future__ import annotations

import itertools
import math

import numpy as np

from lidarsim.base.arrays import AnyArray, Bools, Floats, Floats32, Indices, Ints, Ints32
from lidarsim.scene.scene import Scene
from lidarsim.scene.scene_mesh import triangle_areas

from .colouring import TURBO
from .theme import UNSEEN, rgb

HITS_TITLE = "hits per square metre; grey: none"  # of the scale
_LEVELS = 24  # of a grid whose cells are half as wide each time
_ENOUGH = 12  # hits from which a density is estimated; points in a cell of the grid
_MOST_ROUNDS = 12
_WIDEST_RANGE = 300.0  # densest to sparsest colour


def hit_colours(
    scene: Scene, corners: Floats32, hits: Floats, points: Floats32, most: int
) -> tuple[Floats32, Ints, Floats, tuple[float, float]]:
    """Colour triangles by hits per square metre, large ones with many hits in pieces.

    Large triangles have the density of a grid of points, the finest with enough of them around;
    small ones share their hits, see `hit_density`.

    Parameters
    ----------
    corners, hits
        (f, 3, 3), metres, and (f,): the drawn triangles of the scene, and the hits of each.
    points
        (n, 3): an evenly spaced sample of hit points; it may lack those of some places.
    most
        Most pieces.

    Returns
    -------
    pieces
        (k, 3, 3): their corners; the first of each triangle has its number.
    owner
        (k,): the triangle of each.
    colours
        (k, 3, 3) at the corners.
    limits
        Ends of the logarithmic scale, hits per square metre; its colours are `TURBO`.
    """
    whole = hit_density(scene, hits)
    pieces, owner, areas, found = _divided(corners, hits > 0, points, most)
    read = np.isfinite(found)
    density = whole[owner]
    if found[read].any():
        each = (density * areas)[read].sum() / (found * areas)[read].sum()
        density[read] = each * found[read]
    limits = _density_range(density, areas)
    density = np.repeat(density[:, None], 3, axis=1)
    if read.any():
        # The mean of all pieces around a corner, for smooth transitions.
        places = np.ascontiguousarray(pieces[read]).view("V12").ravel()
        _, corner = np.unique(places, return_inverse=True)
        room = np.repeat(areas[read], 3)
        means = np.bincount(corner, room * density[read].ravel()) / np.bincount(corner, room)
        density[read] = means[corner].reshape(-1, 3)
    # Where points were counted, none are grey; elsewhere the hits are known.
    colours = _density_colours(density, (~read & (hits[owner] > 0))[:, None], limits)
    return pieces, owner, colours, limits


def hit_density(scene: Scene, hit_counts: AnyArray) -> Floats:
    """Hits per square metre at each triangle, (f,), from the hits of each, (f,).

    If triangles are so small that most have one hit or none, hits are shared with neighbours:
    each triangle gives a third to each of its corners, each corner returns them by area, until a
    density is estimated from a dozen hits. The total stays the same.
    """
    hits = hit_counts.astype(np.float64)
    area = triangle_areas(scene.vertices[scene.faces])
    for _ in range(_rounds(hits)):
        hits = _share(scene.faces, hits, area, len(scene.vertices))
    return np.divide(hits, area, out=np.zeros_like(hits), where=area > 0)


def _rounds(hits: Floats) -> int:
    """Choose how many times to share hits with the neighbours."""
    hit = hits[hits > 0]
    if not len(hit):
        return 0
    # Counts of one do not show how many triangles were missed: assume three times as many as
    # were hit, so that the rings of a sparse scan merge.
    typical = hit.mean() if hit.mean() > 3 else hit.mean() / 3
    return min(_MOST_ROUNDS, math.floor(_ENOUGH / typical / 2))


def _share(faces: Ints32, hits: Floats, area: Floats, vertices: int) -> Floats:
    """Spread hits (f,) over the triangles that share a corner, in proportion to area (f,)."""
    given = np.zeros(vertices)
    room = np.zeros(vertices)
    for corner in faces.T:
        given += np.bincount(corner, weights=hits / 3, minlength=vertices)
        room += np.bincount(corner, weights=area, minlength=vertices)
    density = np.divide(given, room, out=np.zeros_like(given), where=room > 0)
    shared = area * density[faces].sum(axis=1)
    # Triangles without area have no density; they keep their hits.
    return np.where(area > 0, shared, hits)


def _density_range(density: Floats, areas: Floats) -> tuple[float, float]:
    """Choose the ends of a logarithmic scale over densities on areas (f,).

    Few hits are on surfaces with less, and little area has more.
    """
    low = 1.0
    high = 10.0
    if (density * areas).any():
        low, high = (
            np.percentile(density, end, weights=weights, method="inverted_cdf")
            for end, weights in ((2, density * areas), (99.5, areas * (density > 0)))
        )
    low = max(low, high / _WIDEST_RANGE)
    return float(low), float(max(high, 2 * low))


def _density_colours(density: Floats, hit: Bools, limits: tuple[float, float]) -> Floats:
    """Colours (..., 3) by density and whether there were hits, both (...,).

    Shared hits fade out to grey; triangles that were hit themselves are never grey.
    """
    low, high = limits
    share = np.log(np.maximum(density, low) / low) / np.log(high / low)
    colours = TURBO[np.clip(share * 255, 0, 255).astype(np.int64)]
    seen = np.where(hit, 1.0, np.clip(density / low / 0.6 - 0.3, 0, 1))[..., None]
    return np.asarray(rgb(UNSEEN) * (1 - seen) + colours * seen)


def _divided(
    pieces: Floats32, hit: Bools, points: Floats32, most: int
) -> tuple[Floats32, Ints, Floats, Floats]:
    """Divide triangles that were hit (f,), for as long as there are points enough around.

    Returns pieces, owners and areas, and points per square metre, NaN for whole triangles.
    """
    owner = np.arange(len(pieces))
    areas = triangle_areas(pieces)
    found = np.full(len(pieces), np.nan)
    busy = hit & bool(len(points))
    if not busy.any():
        return pieces, owner, areas, found
    low = np.minimum(points.min(axis=0), pieces.min(axis=(0, 1)))
    width = float(_longest(pieces)[1].max())
    one = np.ones(len(points))
    for _ in range(_LEVELS):
        there = hit[owner]
        middles = pieces.mean(axis=1)
        near = _WeightGrid(points, one, width, low).around(middles[busy])
        room = _WeightGrid(middles[there], areas[there], width, low).around(middles[busy])
        # Where there are few points, this is the last time that they are counted.
        parts = np.bincount(owner)[owner[busy]]
        found[busy] = np.where(parts > 1, near / np.maximum(room, 1e-30), np.nan)
        busy[busy] = near >= _ENOUGH
        width /= 2
        while True:
            wide = np.flatnonzero(busy)
            wide = wide[_longest(pieces[wide])[1] > width]
            if not len(wide):
                break
            if len(pieces) + len(wide) > most:
                return pieces, owner, areas, found
            halves = _halved(pieces[wide])
            pieces = np.concatenate([pieces, halves[1]])
            pieces[wide] = halves[0]
            areas[wide] /= 2
            owner, areas, found, busy = (
                np.append(values, values[wide]) for values in (owner, areas, found, busy)
            )
        if not busy.any():
            break
    return pieces, owner, areas, found


class _WeightGrid:
    """Sums of weights (n,) of places (n, 3) in the cells of a grid."""

    def __init__(self, places: Floats32, weights: Floats, width: float, low: Floats32) -> None:
        self._width = width
        self._low = low
        cells = np.floor((places - low) / width).astype(np.int64)
        self._keys, cells = np.unique(_keys(cells), return_inverse=True)
        self._sums = np.bincount(cells, weights)

    def around(self, places: Floats32) -> Floats:
        """Sum (n,) at each place, interpolated between the eight cells that are nearest to it."""
        at = (places - self._low) / self._width - 0.5
        total = np.zeros(len(places))
        cells = np.floor(at).astype(np.int64)
        part = at - cells
        for step in itertools.product((0, 1), repeat=3):
            keys = _keys(cells + step)
            found = np.minimum(np.searchsorted(self._keys, keys), len(self._keys) - 1)
            weight = np.where(step, part, 1 - part).prod(axis=1)
            total += np.where(self._keys[found] == keys, weight * self._sums[found], 0.0)
        return total


def _keys(cells: Ints) -> Ints:
    cells = cells + 1  # the neighbours of the lowest are not negative
    return (cells[:, 0] << 42) | (cells[:, 1] << 21) | cells[:, 2]


def _longest(pieces: Floats32) -> tuple[Indices, Floats32]:
    """Return the longest edge of each piece, (k,), and its length."""
    lengths = np.linalg.norm(pieces - np.roll(pieces, -1, axis=1), axis=2)
    return lengths.argmax(axis=1), lengths.max(axis=1)


def _halved(pieces: Floats32) -> tuple[Floats32, Floats32]:
    """Cut each piece through the middle of its longest edge."""
    rows = np.arange(len(pieces))
    edge = _longest(pieces)[0]
    a, b, c = (pieces[rows, (edge + k) % 3] for k in range(3))
    middle = (a + b) / 2
    return np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)

"""Hits per square metre on a grid, which divides large triangles with many hits."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from ..render.intensity import ENOUGH_HITS, hit_density
from ..scene.scene import Scene

Floats = NDArray[np.float64]

_LEVELS = 24  # of a grid whose cells are half as wide each time


def hit_grid(
    scene: Scene, corners: NDArray[np.float32], hits: Floats, points: NDArray[np.float32], most: int
) -> tuple[NDArray[np.float32], NDArray[np.bool_], Floats]:
    """Divide triangles that were hit, and return the density of hits on each piece.

    The density is from the finest grid with enough points around a piece, or `hit_density` of its
    whole triangle if there is none.

    Parameters
    ----------
    scene
        Scene of the triangles.
    corners
        (f, 3, 3): the drawn triangles, metres.
    hits
        (f,): hits of each.
    points
        (n, 3): an evenly spaced sample of hit points.
    most
        Most pieces.

    Returns
    -------
    corners
        (k, 3, 3): the pieces.
    hit
        (k,): whether they were hit themselves.
    density
        (k,): hits per square metre.
    """
    whole, hit = hit_density(scene, hits), hits > 0
    pieces, density = corners[hit], whole[hit]
    missed = len(corners) - len(pieces)
    if len(points) and len(pieces):
        each = float(hits.sum()) / len(points)
        pieces, density = _divided(pieces, density, points, each, most - missed)
    return (
        np.concatenate([corners[~hit], pieces]),
        np.append(np.zeros(missed, np.bool_), density > 0),
        np.append(whole[~hit], density),
    )


def _divided(
    pieces: NDArray[np.float32],
    density: Floats,
    points: NDArray[np.float32],
    each: float,
    most: int,
) -> tuple[NDArray[np.float32], Floats]:
    """Divide pieces that were hit; each point stands for so many hits."""
    low = np.minimum(points.min(axis=0), pieces.min(axis=(0, 1)))
    width = float(_longest(pieces)[1].max())
    busy = np.ones(len(pieces), np.bool_)  # has enough points around it
    one = np.ones(len(points))
    for level in range(_LEVELS):
        counted = _Grid(points, one, width, low)
        if level:  # where there are few, this is the last that is read off
            middles = pieces[busy].mean(axis=1)
            area = _Grid(pieces.mean(axis=1), _areas(pieces), width, low).around(middles)
            near = counted.around(middles)
            density[busy] = each * near / area
            busy[busy] = near >= ENOUGH_HITS
        else:
            busy = counted.around(pieces.mean(axis=1)) >= ENOUGH_HITS
        width /= 2
        while busy.any():
            longest, length = _longest(pieces)
            wide = np.flatnonzero(busy & (length > width))
            if not len(wide):
                break
            if len(pieces) + len(wide) > most:
                return pieces, density
            halves = _halved(pieces[wide], longest[wide])
            pieces[wide] = halves[0]
            pieces = np.concatenate([pieces, halves[1]])
            density, busy = np.append(density, density[wide]), np.append(busy, busy[wide])
        if not busy.any():
            break
    return pieces, density


class _Grid:
    """Sums of weights (n,) of places (n, 3) in the cells of a grid."""

    def __init__(
        self,
        places: NDArray[np.float32],
        weights: Floats,
        width: float,
        low: NDArray[np.float32],
    ) -> None:
        self._width, self._low = width, low
        self._keys, cells = np.unique(_keys(self._cells(places, 0.0)), return_inverse=True)
        self._sums = np.bincount(cells, weights)

    def _cells(self, places: NDArray[np.float32], back: float) -> NDArray[np.int64]:
        # 1 keeps the neighbours of the lowest from being negative.
        at = np.floor((places - self._low) / self._width - back).astype(np.int64)
        return np.asarray(at + 1)

    def around(self, places: NDArray[np.float32]) -> Floats:
        """Sum (n,) of the eight cells that are nearest to each place."""
        cells, total = self._cells(places, 0.5), np.zeros(len(places))
        for step in itertools.product((0, 1), repeat=3):
            keys = _keys(cells + step)
            at = np.minimum(np.searchsorted(self._keys, keys), len(self._keys) - 1)
            total += np.where(self._keys[at] == keys, self._sums[at], 0.0)
        return total


def _keys(cells: NDArray[np.int64]) -> NDArray[np.int64]:
    return (cells[:, 0] << 42) | (cells[:, 1] << 21) | cells[:, 2]


def _longest(pieces: NDArray[np.float32]) -> tuple[NDArray[np.intp], NDArray[np.float32]]:
    """Return the longest edge of each piece, (k,), and its length."""
    lengths = np.linalg.norm(pieces - np.roll(pieces, -1, axis=1), axis=2)
    return lengths.argmax(axis=1), lengths.max(axis=1)


def _halved(
    pieces: NDArray[np.float32], edge: NDArray[np.intp]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Cut each piece through the middle of one of its edges."""
    rows = np.arange(len(pieces))
    a, b, c = (pieces[rows, (edge + k) % 3] for k in range(3))
    middle = (a + b) / 2
    return np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)


def _areas(pieces: NDArray[np.float32]) -> Floats:
    sides = pieces[:, 1:] - pieces[:, :1]
    return np.asarray(np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1) / 2, np.float64)

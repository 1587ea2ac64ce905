"""Points on walls and roofs, which a page shows from the sensors' side alone, as the walls are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

CELLS = 80  # of a grid along the longest side of the walls
SAMPLES = 400_000  # places that the walls are entered into the grid by: many in each cell
SIZE = 0.7  # from the middle of a triangle to its corners, as a share of a point's size
APART = 0.3  # from a wall, as a share of a point's size: else the wall would show through

Reals = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Walls:
    """Where walls are, in cells of a grid, and which way they face.

    Parameters
    ----------
    low
        (3,) lowest corner of the grid, metres.
    cell
        Size of a cell, metres.
    facing
        float32 (i, j, k, 3): unit vectors from the wall to the sensors; 0 where there is none.
    """

    low: Reals
    cell: float
    facing: Reals

    @classmethod
    def of(cls, corners: Reals) -> Walls | None:
        """Enter triangles (f, 3, 3) whose corners run anticlockwise, seen from the sensors.

        None if they have no area.
        """
        a, b, c = corners.transpose(1, 0, 2).astype(np.float64)
        doubled = np.cross(b - a, c - a)
        area = np.linalg.norm(doubled, axis=1)
        if not area.any():
            return None
        low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
        cell = float((high - low).max()) / CELLS
        random = np.random.default_rng(0)
        which = random.choice(len(area), SAMPLES, p=area / area.sum())
        u, v = np.sort(random.random((2, SAMPLES)), axis=0)  # even over each triangle
        places = a[which] * u[:, None] + b[which] * (v - u)[:, None] + c[which] * (1 - v)[:, None]
        # A point lies a little before or behind its wall, which may be in the next cell.
        places += cell * random.uniform(-0.5, 0.5, places.shape)
        shape = np.ceil((high - low) / cell).astype(int) + 3
        facing = np.zeros((*shape, 3), np.float32)
        out = cls((low - cell).astype(np.float32), cell, facing)
        i, j, k = out._cells(places).T
        facing[i, j, k] = doubled[which] / area[which, None]
        return out

    def facing_at(self, positions: Reals) -> Reals:
        """Give for positions (n, 3) which way the wall there faces, (n, 3); 0 where there is none.

        What stands within a cell of a wall counts as part of it.
        """
        cells = self._cells(positions)
        within = ((cells >= 0) & (cells < self.facing.shape[:3])).all(axis=1, keepdims=True)
        i, j, k = np.where(within, cells, 0).T
        return np.asarray(self.facing[i, j, k] * within)

    def _cells(self, places: NDArray[np.floating]) -> NDArray[np.int64]:
        return np.asarray(np.floor((places - self.low) / self.cell).astype(np.int64))


def facing_triangles(positions: Reals, facing: Reals, size_m: float) -> Reals:
    """Small triangles (n, 3, 3) in place of points, to be seen from where they face.

    Parameters
    ----------
    positions
        (n, 3) metres.
    facing
        (n, 3) unit vectors.
    size_m
        Size of a point in metres.
    """
    aside = np.zeros_like(facing)
    aside[np.arange(len(facing)), np.abs(facing).argmin(axis=1)] = 1
    right = np.cross(aside, facing)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    up = np.cross(facing, right)
    angles = 2 * np.pi * np.arange(3) / 3
    corners = (
        np.cos(angles)[:, None] * right[:, None] + np.sin(angles)[:, None] * up[:, None]
    )  # anticlockwise, as right, up and facing are right-handed
    middles = positions + APART * size_m * facing
    return np.asarray(middles[:, None] + SIZE * size_m * corners, np.float32)

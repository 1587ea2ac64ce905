"""Compiled loops that find the cells around a vehicle through which beams pass."""

# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lidarsim.numerics.arrays import Floats
from raybeam.compiled import compiled


class CellGrid(NamedTuple):
    """Square cells of a horizontal map."""

    x: float  # lower corner of the first cell, meters
    y: float
    cell_m: float
    columns: int
    rows: int


class BeamSegments(NamedTuple):
    """Parts of beams within which an object can be detected. All arrays have n rows."""

    origins: Floats  # (n, 3), meters
    directions: Floats  # (n, 3), unit vectors
    start_m: Floats  # (n,), distances from the origin
    stop_m: Floats  # (n,)


@compiled()
def lower_to_beams(grid, beams, max_height_m, lowest):  # noqa: C901, PLR0914, PLR0915 - a compiled loop
    """Lower the height of each cell to that of the lowest beam above the cell.

    `lowest` (rows, columns) is the minimum height above z = 0 of an object in the cell that a beam
    hits. It is reduced where a beam passes lower, but not below z = 0. Beams above `max_height_m`
    are ignored.
    """
    width = grid.columns * grid.cell_m
    depth = grid.rows * grid.cell_m
    for n in range(len(beams.start_m)):
        dx = beams.directions[n, 0]
        dy = beams.directions[n, 1]
        dz = beams.directions[n, 2]
        x = beams.origins[n, 0] - grid.x
        y = beams.origins[n, 1] - grid.y
        z = beams.origins[n, 2]
        start = beams.start_m[n]
        stop = beams.stop_m[n]
        # Clip the beam to the map, and to heights from 0 to the maximum.
        for axis in range(3):
            if axis == 0:
                position, way, upper = x, dx, width
            elif axis == 1:
                position, way, upper = y, dy, depth
            else:
                position, way, upper = z, dz, max_height_m
            if abs(way) < 1e-12:
                if position < 0 or position > upper:
                    stop = -1.0
                continue
            first = -position / way
            last = (upper - position) / way
            if first > last:
                first, last = last, first
            start = max(start, first)
            stop = min(stop, last)
        if not start < stop:
            continue
        # Traverse the cells (Amanatides and Woo 1987).
        column = min(max(int((x + start * dx) / grid.cell_m), 0), grid.columns - 1)
        row = min(max(int((y + start * dy) / grid.cell_m), 0), grid.rows - 1)
        step_x = 1 if dx > 0 else -1
        step_y = 1 if dy > 0 else -1
        next_x = np.inf
        next_y = np.inf
        per_x = np.inf
        per_y = np.inf
        if abs(dx) > 1e-12:
            next_x = ((column + (dx > 0)) * grid.cell_m - x) / dx
            per_x = grid.cell_m / abs(dx)
        if abs(dy) > 1e-12:
            next_y = ((row + (dy > 0)) * grid.cell_m - y) / dy
            per_y = grid.cell_m / abs(dy)
        entry = start
        while True:
            leave = min(next_x, next_y, stop)
            height = max(z + (leave if dz < 0 else entry) * dz, 0.0)
            lowest[row, column] = min(lowest[row, column], height)
            if leave >= stop:
                break
            entry = leave
            if next_x <= next_y:
                column += step_x
                next_x += per_x
            else:
                row += step_y
                next_y += per_y
            if column < 0 or column >= grid.columns or row < 0 or row >= grid.rows:
                break

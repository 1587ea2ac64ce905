"""Light through grids of leaf area density: where its optical depth is used up."""

from __future__ import annotations

from copy import copy
from typing import Any

import numpy as np

from ..base.arrays import Bools, Floats, Indices
from ..base.vectors import applied, inverse, matmul
from ..scene.scene_instances import Instances

BLOCK_RAYS = 1 << 13  # that go through grids at a time, to fit a cache
_LEVEL = 1e-30  # along an axis, light this slow meets no other voxel


class Grids:
    """The grids of the instances of a scene, densities once for each part."""

    def __init__(self, shared: Instances) -> None:
        found = [part.voxels for part in shared.parts]
        sizes = [(0, 0, 0) if one is None else one.density.shape for one in found]
        self._sizes = np.array(sizes, np.float64)
        self._begins = np.cumsum([0, *(int(np.prod(size)) for size in sizes[:-1])])
        kept = [one.density.reshape(-1) for one in found if one is not None]
        self._values = kept[0] if len(kept) == 1 else np.concatenate(kept)
        self._matrices = np.array(
            [np.eye(3, 4) if one is None else one.matrix for one in found], np.float64
        )
        self._place(shared)

    @classmethod
    def of(cls, shared: Instances | None) -> Grids | None:
        """Return those of instances; None if there are none."""
        if shared is None or all(part.voxels is None for part in shared.parts):
            return None
        return cls(shared)

    def moved(self, shared: Instances) -> Grids:
        """Return the same with the instances in other places."""
        made = copy(self)
        made._place(shared)
        return made

    def _place(self, shared: Instances) -> None:
        """Find what takes places in the scene to those in the grid of each instance."""
        self._part = shared.part
        to = shared.transforms
        matrices = self._matrices[self._part]
        self._origins = applied(to[:, :, :3], matrices[:, :, 3]) + to[:, :, 3]
        self._back = inverse(matmul(to[:, :, :3], matrices[:, :, :3]))

    def through(
        self,
        which: Indices,
        starts: Floats,
        ways: Floats,
        crossing: Floats,
        even: Floats,
        length: Floats,
        left: Floats,
    ) -> tuple[Floats, Floats, Floats]:
        """Follow light (n,) through the grids around it, by voxels (Amanatides and Woo 1987).

        Parameters
        ----------
        which
            (n, k): instances with grids around it; -1 for none.
        starts, ways
            (n, 3): where it is, and where it goes.
        crossing
            (n, k): mean projection of the leaves in each.
        even
            (n,): optical depth for each metre in what else is around it.
        length
            (n,): how far it goes, metres.
        left
            (n,): optical depth after which it meets a leaf.

        Returns
        -------
        Metres to that leaf (n,), inf if there is none; what is left of `left` (n,), -inf if there
        is a leaf; and optical depths for each metre of the grids there (n, k).
        """
        if len(left) > BLOCK_RAYS:
            given: tuple[Any, ...] = which, starts, ways, crossing, even, length, left
            blocks = (slice(k, k + BLOCK_RAYS) for k in range(0, len(left), BLOCK_RAYS))
            found = [self.through(*(values[block] for values in given)) for block in blocks]
            metres, rest, there = map(np.concatenate, zip(*found, strict=True))
            return metres, rest, there
        metres = np.full(len(left), np.inf)
        rest = np.full(len(left), -np.inf)
        there = np.zeros(which.shape)
        back = self._back[which].transpose(2, 3, 1, 0)  # (axis, axis, k, n)
        x, y, z = (starts[:, None] - self._origins[which]).transpose(2, 1, 0)
        u, v, w = ways.T[:, None]
        # Product by product, for the same bits in every block.
        place = np.stack([(row[0] * x + row[1] * y) + row[2] * z for row in back])
        way = np.stack([(row[0] * u + row[1] * v) + row[2] * w for row in back])
        level = np.abs(way) < _LEVEL
        step = np.where(level, 0, np.sign(way))
        pace = 1 / np.where(level, 1, way)
        cell = np.floor(place)
        size = np.moveaxis(self._sizes[self._part[which]], 2, 0).swapaxes(1, 2)
        first = self._begins[self._part[which]].T
        # The border ahead of `cell` is at `cell * pace + shift` metres.
        shift = np.where(level | (which.T < 0), np.inf, ((step > 0) - place) * pace)
        pace[level] = 0
        crossing = np.where(which < 0, 0, crossing).T
        rows = np.arange(len(left))
        at = np.zeros(len(left))
        left = left.copy()
        while len(rows):
            density, inside = self._density(cell, size, first)
            density *= crossing
            total = even.copy()
            for one in density:
                total += one
            beyond = ~inside & np.isfinite(shift).any(axis=0)
            if beyond.any():  # nothing is there any more, where it goes away
                away = ((cell < 0) & (step <= 0)) | ((cell >= size) & (step >= 0))
                shift[:, beyond & away.any(axis=0)] = np.inf
            border = cell * pace + shift
            ahead = np.minimum.reduce(border.reshape(-1, len(rows)))
            stop = np.minimum(ahead, length)
            lost = total * np.maximum(stop - at, 0)
            met = lost > left
            metres[rows[met]] = at[met] + left[met] / total[met]
            there[rows[met]] = density[:, met].T
            done = met | (ahead >= length)
            left = left - lost
            if done.any():
                ends = rows[done & ~met]
                rest[ends] = left[done & ~met]
                on = np.flatnonzero(~done)
                cell, step, pace, shift, size, border = (
                    array[:, :, on] for array in (cell, step, pace, shift, size, border)
                )
                first = first[:, on]
                crossing = crossing[:, on]
                rows = rows[on]
                ahead, even, left, length = (a[on] for a in (ahead, even, left, length))
            cell = np.where(border <= ahead, cell + step, cell)
            at = np.maximum(ahead, 0)  # the first may be before the start, by rounding
        return metres, rest, there

    def _density(self, cell: Floats, size: Floats, first: Any) -> tuple[Floats, Bools]:
        """Densities of voxels (3, k, n), and whether they are in their grids: (k, n)."""
        i, j, k = cell
        inside = np.asarray(((cell >= 0) & (cell < size)).all(axis=0))
        index = ((i * size[1] + j) * size[2] + k) + first
        values = self._values[np.where(inside, index, 0).astype(np.intp)]
        return np.where(inside, values, 0.0), inside

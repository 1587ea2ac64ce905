"""Bodies that move while rays are cast: which rays come near one, and where they hit it.

No tree is ever built again. Rays that follow each other are fired nearly together: the cone around
each `CELL` of them, and the plane of a fan, is compared with the ball around each body, on its way
while rays are fired; where they meet, each ray is compared with the body's box, as it is when the
cell is fired. The few rays that pass are taken to the body's axes at their own time, and cast
there. The comparisons are loops of moving_loops.py, and decide no hit.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from .arrays import Floats, Indices, Ints, Ints32
from .bending import Bending
from .caster import RayCaster
from .rays import Rays
from .scan import Scan

_CHUNK = 1 << 15  # rays at a time
_PAIRS = 1 << 11  # of cells and bodies at a time


@dataclass(frozen=True, eq=False)
class Moving:
    """Bodies that move: shapes, each with a pose at every time.

    Attributes
    ----------
    shapes
        Casters of the shapes, each in its own axes, and meshes whose vertices move.
    boxes
        float64 (s, 2, 3): low and high corners of the shapes.
    shape
        intp (b,): which one each body has.
    there
        float64 (b, 2): first and last time when each is there.
    poses
        Called with numbers of bodies (m,) and times (m,); gives positions (m, 3), metres, and
        rotations (m, 3, 3) from the body's axes.
    """

    shapes: tuple[RayCaster | Bending, ...]
    boxes: Floats
    shape: Indices
    there: Floats
    poses: Callable[[Ints, Floats], tuple[Floats, Floats]]

    @cached_property
    def middle(self) -> Floats:
        """Middles of the boxes (s, 3)."""
        return np.asarray(self.boxes.mean(axis=1))

    @cached_property
    def half(self) -> Floats:
        """Halves of their sides (s, 3)."""
        return (self.boxes[:, 1] - self.boxes[:, 0]) / 2

    @cached_property
    def radius(self) -> Floats:
        """Radii of the balls around them (s,)."""
        return np.asarray(np.sqrt((self.half**2).sum(axis=1)))


class MovingHits(NamedTuple):
    """Hits on bodies that move, nearest first for each ray, of equal distances the first body.

    ray int64 (k,), distance float64 (k,) metres, instance and triangle of its shape int32 (k,),
    body int64 (k,).
    """

    ray: Ints
    distance: Floats
    instance: Ints32
    triangle: Ints32
    body: Ints

    def of(self, rows: Indices) -> MovingHits:
        """Select some."""
        columns: list[Any] = [column[rows] for column in self]
        return MovingHits(*columns)

    @classmethod
    def joined(cls, parts: list[MovingHits]) -> MovingHits:
        """Join hits."""
        columns: list[Any] = [*zip(*parts, strict=True)]
        return cls(*map(np.concatenate, columns))


_NONE = MovingHits(
    np.zeros(0, np.int64),
    np.zeros(0),
    np.zeros(0, np.int32),
    np.zeros(0, np.int32),
    np.zeros(0, np.int64),
)


def hits_on(
    moving: Moving, scan: Scan, times: Callable[[Ints], Floats], before: Floats | None = None
) -> MovingHits:
    """Find the nearest hit of each ray on a body.

    Parameters
    ----------
    moving, scan
        Bodies and rays.
    times
        Gives the times of rays (m,).
    before
        float64 (n,): distances at which rays end; None if none does. Hits behind are left out, as
        far as that saves time.
    """
    from . import moving_loops as loops  # not before: numba takes half a second to import

    found = [_NONE]
    for start, stop in scan.chunks(_CHUNK):
        ends = np.full(stop - start, scan.t_max) if before is None else before[start:stop]
        at = times(np.arange(start, stop, dtype=np.int64))
        hits = _Chunk(loops, moving, scan, start, at, np.minimum(ends, scan.t_max)).hits()
        hits = hits.of(loops.nearest(hits.ray, hits.distance, hits.body, len(at)))
        found.append(hits._replace(ray=hits.ray + start))
    return MovingHits.joined(found)


class _Chunk:
    """Some rays of a scan, their times, and the distances at which they end."""

    def __init__(
        self, loops: Any, moving: Moving, scan: Scan, start: int, times: Floats, ends: Floats
    ) -> None:
        self._loops, self._moving, self._scan = loops, moving, scan
        self._times, self._ends = times, ends
        ray = np.arange(start, start + len(times), dtype=np.int64)
        origins, directions = scan.pattern.made(scan.first, ray, scan.poses)
        starts = np.broadcast_to(origins, directions.shape).T
        self._rays = np.ascontiguousarray(starts), np.ascontiguousarray(directions.T)

    def hits(self) -> MovingHits:
        """Hits on all bodies, of which a ray may have several."""
        loops, moving, times, found = self._loops, self._moving, self._times, [_NONE]
        there = (moving.there[:, 0] <= times.max()) & (moving.there[:, 1] >= times.min())
        bodies = np.flatnonzero(there)
        if len(bodies):
            cells = loops.cells_of(*self._rays, times)
            number, looks, sizes = self._looks(bodies, cells)
            # Near bodies come first, and rays end at them.
            way = looks[:, 0, :3] - cells[0, loops.MIDDLE : loops.MIDDLE + 3]
            order = np.argsort((way**2).sum(axis=1), kind="stable")
            reach = float(self._ends.max())
            cell, which = loops.meet(cells, number, looks[order], sizes[order], reach)
            body = bodies[order][which]
            for start in range(0, len(cell), _PAIRS):
                some = slice(start, start + _PAIRS)
                hits = self._cast(cell[some], cells[cell[some]], body[some])
                best = loops.nearest(hits.ray, hits.distance, hits.body, len(times))
                found.append(hits := hits.of(best))
                self._ends[hits.ray] = np.minimum(self._ends[hits.ray], hits.distance)
        return MovingHits.joined(found)

    def _looks(self, bodies: Ints, cells: Floats) -> tuple[Ints, Floats, Floats]:
        """Bodies, looked at a few times, see `meet`."""
        loops, moving, shape = self._loops, self._moving, self._moving.shape[bodies]
        first, last = cells[:, loops.BEGIN].min(), cells[:, loops.END].max()
        steps = max(1, len(cells) // loops.CELL)
        step = (last - first) / steps
        number = ((cells[:, loops.BEGIN] - first) / (step or 1)).astype(np.int64).clip(0, steps)
        at = np.clip(np.linspace(first, last, steps + 1), *moving.there[bodies].T[:, :, None])
        many = np.repeat(bodies, steps + 1)
        positions, rotations = moving.poses(many, at.ravel())
        middles = positions + _turned(rotations, moving.middle[moving.shape[many]])
        halves = rotations.transpose(0, 2, 1) * moving.half[moving.shape[many]][..., None]
        looks = np.empty((len(bodies), steps + 1, 12))
        looks[..., :3] = middles.reshape(len(bodies), -1, 3)
        looks[..., 3:] = halves.reshape(len(bodies), -1, 9)
        change = np.abs(np.diff(looks, axis=1))
        slack = 2 * change.sum(axis=2).max(axis=1) + loops.PADS_M
        sizes = np.column_stack([moving.radius[shape], slack, moving.there[bodies]])
        return number, looks, sizes

    def _cast(self, cell: Indices, cells: Floats, body: Ints) -> MovingHits:
        """Hits of the rays of cells on bodies, one each."""
        loops, moving, times = self._loops, self._moving, self._times
        shape = moving.shape[body]
        begins, ends = np.clip(cells[:, [loops.BEGIN, loops.END]].T, *moving.there[body].T)
        poses = _table(*moving.poses(body, begins))
        pads, late = np.full(len(cell), loops.PADS_M), np.flatnonzero(ends > begins)
        if len(late):  # the box is larger by what happens until the cell's end
            change = np.abs(_table(*moving.poses(body[late], ends[late])) - poses[late])
            size = np.abs(moving.boxes).max(axis=(1, 2))[shape[late]]
            pads[late] += 2 * (change[:, :3].sum(axis=1) + size * change[:, 3:].sum(axis=1))
        boxes = moving.boxes[shape].reshape(-1, 6)
        row, pair = loops.through(*self._rays, self._ends, cell, poses, boxes, pads)
        body, number = body[pair], pair
        if len(late):  # each ray at its own time
            first, last = moving.there[body].T
            there = np.flatnonzero((first <= times[row]) & (times[row] <= last))
            row, body, pair = row[there], body[there], pair[there]
            poses, number = _table(*moving.poses(body, times[row])), np.arange(len(row))
        if not len(row):
            return _NONE
        given = (*self._rays, self._ends, row, poses, number, boxes, pair)
        kept, starts, ways = loops.local(*given)
        row, body, found = row[kept], body[kept], [_NONE]
        shape = moving.shape[body]
        for one in np.unique(shape).tolist():
            own = np.flatnonzero(shape == one) if len(moving.shapes) > 1 else slice(None)
            rays = Rays(starts[own], ways[own], self._scan.t_min, self._scan.t_max)
            met = moving.shapes[one].nearest(rays, times[row[own]])
            on, distance, triangle, instance = met
            at = on if isinstance(own, slice) else own[on]
            # Directions of a sensor that turns during a pose are not quite of unit length.
            x, y, z = ways[at].T
            distance = distance / np.sqrt((x * x + y * y) + z * z)
            found.append(MovingHits(row[at], distance, instance, triangle, body[at]))
        return MovingHits.joined(found)


def _turned(rotations: Floats, vectors: Floats) -> Floats:
    return (rotations * vectors[:, None, :]).sum(axis=2)


def _table(positions: Floats, rotations: Floats) -> Floats:
    table = np.empty((len(positions), 12))
    table[:, :3], table[:, 3:] = positions, rotations.reshape(-1, 9)
    return table

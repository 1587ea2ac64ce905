"""Bodies that move while rays are cast: which rays come near one, and where they hit it.

No tree is ever built again. Rays that follow each other are fired nearly together: the cone around
each cell of them, and the plane of a fan, is compared with the ball around each body, on its way
while rays are fired; where they meet, each ray is compared with the body's box, as it is when the
cell is fired. The rays that pass are taken to the body's axes at their own time, and cast there, at
near bodies first. The comparisons are loops of moving_loops.py, and decide no hit.

A CUDA device compares each ray with a box around each body's way, and has the body's poses at all
times of the rays.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from .arrays import Floats, Indices, Ints
from .caster import RayCaster
from .crossing import SPAN, Crossing, Nearest, Swept
from .deforming import Deforming
from .scan import Scan

_CHUNK = 1 << 17  # rays at a time
_PAIRS = 1 << 14  # of cells and bodies at a time
_POSES = 1 << 18  # on a device: 25 MB
_BOXES = 128  # that stand, at a time
_LOOKS = 256  # cells for each look at the bodies
_NONE = np.zeros(0)


@dataclass(frozen=True, eq=False)
class Moving:
    """Bodies that move: shapes, each with a pose at every time.

    Attributes
    ----------
    shapes
        Casters of the shapes, each in its own axes, and meshes that deform.
    boxes
        float64 (s, 2, 3): low and high corners of the shapes, in all frames.
    shape
        intp (b,): which one each body has.
    there
        float64 (b, 2): first and last time when each is there.
    poses
        Called with numbers of bodies (m,) and times (m,); gives (12, m): positions, metres, and
        rotations from the body's axes, by rows.
    frames
        Of bodies that deform, called as `poses`: gives their frames (m,), see `Deforming`.
    """

    shapes: tuple[RayCaster | Deforming, ...]
    boxes: Floats
    shape: Indices
    there: Floats
    poses: Callable[[Ints, Floats], Floats]
    frames: Callable[[Ints, Floats], Floats] | None = None

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


def hits_on(
    moving: Moving, scan: Scan, times: Callable[[Ints], Floats], before: Floats | None = None
) -> Nearest:
    """Find the nearest hit of each ray of a scan on a body.

    Parameters
    ----------
    moving, scan
        Bodies and rays.
    times
        Gives the times of rays (m,).
    before
        float64 (n,): distances before which hits count; None for all within the scan's.
    """
    from . import moving_loops as loops  # not before: numba takes half a second to import

    end = float(np.nextafter(scan.t_max, np.inf))  # t_max counts
    found = Nearest.of(np.full(len(scan), end) if before is None else np.minimum(before, end))
    for start, stop in scan.chunks(_CHUNK):
        ray = np.arange(start, stop, dtype=np.int64)
        if scan.room is None:
            made = scan.rays(start, stop)
            rays = np.empty((6, len(ray)))
            rays[:3] = made.origins.T
            rays[3:] = made.directions.T
        else:  # where the caster has written them
            rays = np.ascontiguousarray(scan.room[:, start:stop])
        _Chunk(loops, moving, scan, rays, times(ray), found.part(start, stop)).cast()
    return found


def near_boxes(
    rays: Floats, times: Floats, boxes: Floats, there: Floats, reach: float
) -> tuple[Indices, Indices, int]:
    """Find cells of rays (6, n) at times (n,) that may meet boxes that stand, before `reach`.

    Boxes (b, 12) are middles, and halves of their sides as vectors; each is there from a time to
    another, (b, 2). Returns numbers of cells and boxes, (k,) each, by box, then cell, and how many
    rays a cell has.
    """
    from . import moving_loops as loops

    cells = loops.cells_of(rays, times, loops.CELL)
    wide = loops.cells_of(rays, times, loops.CELL * loops.WIDE)
    radius = np.sqrt((boxes[:, 3:] ** 2).sum(axis=1))
    sizes = np.column_stack([radius, np.full(len(boxes), loops.PADS_M), there])
    number = np.zeros((len(cells), 2), np.int64)
    looks = boxes[:, None].copy()
    parts = [np.zeros((2, 0), np.int64)]
    for first in range(0, len(boxes), _BOXES):
        some = slice(first, first + _BOXES)
        cell, box = loops.meet(wide, cells, number, looks[some], sizes[some], reach)
        parts.append(np.stack([cell, box + first]))
    cell, box = np.concatenate(parts, axis=1)
    return cell, box, loops.CELL


class _Chunk:
    """Some rays of a scan, their times, and what they hit."""

    def __init__(
        self, loops: Any, moving: Moving, scan: Scan, rays: Floats, times: Floats, nearest: Nearest
    ) -> None:
        self._loops = loops
        self._moving = moving
        self._scan = scan
        self._rays = rays
        self._times = times
        self._nearest = nearest

    def cast(self) -> None:
        """Note the nearest hits on all bodies."""
        loops = self._loops
        moving = self._moving
        times = self._times
        first, last = moving.there.T
        bodies = np.flatnonzero((first <= times.max()) & (last >= times.min()))
        swept = np.array([shape.on_device for shape in moving.shapes])[moving.shape[bodies]]
        if swept.any():
            self._sweep(bodies[swept])
            bodies = bodies[~swept]
        if not len(bodies):
            return
        cells = loops.cells_of(self._rays, times, loops.CELL)
        wide = loops.cells_of(self._rays, times, loops.CELL * loops.WIDE)
        number, looks, sizes = self._looks(bodies, cells)
        # Near bodies come first, and rays end at them.
        way = looks[:, 0, :3] - cells[0, loops.MIDDLE : loops.MIDDLE + 3]
        order = np.argsort((way**2).sum(axis=1), kind="stable")
        reach = float(self._nearest.distance.max())
        cell, which = loops.meet(wide, cells, number, looks[order], sizes[order], reach)
        body = bodies[order][which]
        spans = cells[:, loops.BEGIN : loops.END + 1]
        for start in range(0, len(cell), _PAIRS):
            some = slice(start, start + _PAIRS)
            self._cast_at(cell[some], spans[cell[some]].T, body[some])

    def _sweep(self, bodies: Ints) -> None:
        """Note the nearest hits on bodies whose shapes are on a device."""
        moving = self._moving
        scan = self._scan
        at, when = np.unique(self._times, return_inverse=True)
        step = max(1, _POSES // (SPAN * len(bodies))) * SPAN
        for one in np.unique(moving.shape[bodies]).tolist():
            shape = moving.shapes[one]
            own = bodies[moving.shape[bodies] == one]
            assert isinstance(shape, RayCaster)
            for start in range(0, len(at), step):
                rows = np.flatnonzero((when >= start) & (when < start + step))
                first = int(rows[0])
                last = int(rows[-1]) + 1
                poses, boxes = self._swept(one, own, at[start : start + step])
                rays = np.ascontiguousarray(self._rays[:, first:last])
                number = (when[first:last] - start).astype(np.int32)
                given = Swept(rays, number, own, poses, boxes, (scan.t_min, scan.t_max))
                shape.sweep(given, self._nearest.part(first, last))

    def _swept(self, shape: int, bodies: Ints, times: Floats) -> tuple[Floats, Floats]:
        """Poses and boxes of bodies of one shape at times, see `Swept`."""
        from .moving_loops import PADS_M

        moving = self._moving
        many = len(bodies)
        body = np.tile(bodies, len(times))
        time = np.repeat(times, many)
        first, last = moving.there[body].T
        there = (first <= time) & (time <= last)
        poses = np.full((len(body), 12), np.nan)
        corners = np.full((2, len(body), 3), np.nan)
        if there.any():
            table = moving.poses(body[there], time[there])
            poses[there] = table.T
            turns = _rotations(table)
            middle = table[:3].T + _turned(turns, moving.middle[[shape]])
            half = _turned(np.abs(turns), moving.half[[shape]]) + PADS_M
            corners[:, there] = middle - half, middle + half
        low, high = corners.reshape(2, -1, many, 3)
        spans = np.arange(0, len(times), SPAN)
        boxes = np.fmin.reduceat(low, spans), np.fmax.reduceat(high, spans)
        return poses.reshape(-1, many, 12), np.concatenate(boxes, axis=2)

    def _looks(self, bodies: Ints, cells: Floats) -> tuple[Ints, Floats, Floats]:
        """Bodies, looked at a few times, see `meet`."""
        loops = self._loops
        moving = self._moving
        shape = self._moving.shape[bodies]
        first = cells[:, loops.BEGIN].min()
        last = cells[:, loops.END].max()
        steps = max(1, len(cells) // _LOOKS)
        step = (last - first) / steps
        spans = (cells[:, loops.BEGIN : loops.END + 1] - first) / (step or 1)
        number = spans.astype(np.int64).clip(0, steps)
        at = np.clip(np.linspace(first, last, steps + 1), *moving.there[bodies].T[:, :, None])
        many = np.repeat(bodies, steps + 1)
        table = moving.poses(many, at.ravel())
        rotations = _rotations(table)
        middles = table[:3].T + _turned(rotations, moving.middle[moving.shape[many]])
        halves = rotations.transpose(0, 2, 1) * moving.half[moving.shape[many]][..., None]
        looks = np.empty((len(bodies), steps + 1, 12))
        looks[..., :3] = middles.reshape(len(bodies), -1, 3)
        looks[..., 3:] = halves.reshape(len(bodies), -1, 9)
        change = np.abs(np.diff(looks, axis=1))
        slack = 2 * change.sum(axis=2).max(axis=1) + loops.PADS_M
        sizes = np.column_stack([moving.radius[shape], slack, moving.there[bodies]])
        return number, looks, sizes

    def _cast_at(self, cell: Indices, spans: Floats, body: Ints) -> None:
        """Cast the rays of cells, of some spans of time, on bodies, one each."""
        loops = self._loops
        moving = self._moving
        times = self._times
        rays = self._rays
        shape = moving.shape[body]
        boxes = moving.boxes.reshape(-1, 6)
        begins, ends = np.clip(spans, *moving.there[body].T)
        new = (np.diff(body, prepend=-1) != 0) | (np.diff(begins, prepend=np.nan) != 0)
        number = np.cumsum(new) - 1  # several cells of a body may begin at one time
        poses = moving.poses(body[new], begins[new])
        pads = np.full(len(cell), loops.PADS_M)
        straddles = spans[1] > spans[0]
        late = np.flatnonzero(straddles)
        if len(late):  # the box is larger by what happens until the cell's end
            change = np.abs(moving.poses(body[late], ends[late]) - poses[:, number[late]])
            size = np.abs(moving.boxes).max(axis=(1, 2))[shape[late]]
            pads[late] += 2 * (change[:3].sum(axis=0) + size * change[3:].sum(axis=0))
        given = cell, number, poses, boxes, shape, pads
        row, pair = loops.through(rays, self._nearest.distance, *given)
        body = body[pair]
        number = number[pair]
        if len(late):  # each of their rays at its own time, when the body may not be there
            first, last = moving.there[body].T
            there = np.flatnonzero((first <= times[row]) & (times[row] <= last))
            row = row[there]
            body = body[there]
            number = number[there]
            pair = pair[there]
            some = np.flatnonzero(straddles[pair])
            number[some] = poses.shape[1] + np.arange(len(some))
            poses = np.concatenate([poses, moving.poses(body[some], times[row[some]])], axis=1)
        limits = (self._scan.t_min, self._scan.t_max)
        shape = moving.shape[body]
        several = len(moving.shapes) > 1
        for one in np.unique(shape).tolist() if several else [0]:
            own = shape == one if several else slice(None)
            which = row[own], body[own], number[own]
            cast = moving.shapes[one]
            frame = _NONE
            if isinstance(cast, Deforming):
                assert moving.frames is not None, "of bodies that deform"
                frame = moving.frames(which[1], times[which[0]])
            crossing = Crossing(rays, *which, poses, boxes[one], limits, frame)
            cast.strike(crossing, self._nearest)


def _rotations(poses: Floats) -> Floats:
    return poses[3:].reshape(3, 3, -1).transpose(2, 0, 1)


def _turned(rotations: Floats, vectors: Floats) -> Floats:
    return (rotations * vectors[:, None, :]).sum(axis=2)

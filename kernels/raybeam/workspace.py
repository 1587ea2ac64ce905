"""Where the rays of a chunk are made for an engine that reads them in float32."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .mesh import LocalMesh
from .poses import Poses
from .scan import Scan

Float = NDArray[np.float64]

# Rays that are turned together: what that takes stays in a core's level 2 cache.
_BLOCK = 1 << 14


class Starts:
    """Where the rays of a chunk start, in local units.

    Parameters
    ----------
    points
        (m, 3): one for all rays, or one for so many rays each.
    rays
        Rays of each point.
    skip
        Rays of the first point that are not in the chunk.
    """

    def __init__(self, points: Float, rays: int = 1, skip: int = 0) -> None:
        self.points, self.rays, self.skip = points, rays, skip

    def of(self, ray: NDArray[np.intp]) -> Float:
        """Look up where some rays start: (len(ray), 3), or (1, 3) when one is that of all."""
        if len(self.points) == 1:
            return self.points
        return self.points.take((ray + self.skip) // self.rays, axis=0)


class Workspace:
    """Arrays for a chunk of rays, made once and used for chunk after chunk.

    Fresh pages of memory for every chunk would cost a quarter of what casting it does. A part
    that is never used takes no memory: the system hands out pages when they are written to.

    Parameters
    ----------
    size
        Most rays of a chunk.
    """

    def __init__(self, size: int) -> None:
        self.size = size
        self._rows = np.empty((size, 6), np.float32)
        # One row an axis: of a pattern's directions and origins that are not in one piece, and
        # both turned.
        self._given, self._turned = np.empty((2, 2, 3, size))
        self._product = np.empty(min(size, _BLOCK))
        self._origin: Float | None = None  # where all rows start, if at one point

    def start(self, n: int, starts: Starts) -> NDArray[np.float32]:
        """Write where n rays start, and return their rows as an engine reads them.

        Nothing is written when all start where the last ones did.

        Returns
        -------
        (n, 6): origins, and the directions that were written last.
        """
        points = starts.points
        if len(points) > 1:
            self._origin = None
            for at, length, point, count in _blocks(starts.skip, starts.skip + n, starts.rays):
                rows = self._rows[at : at + length].reshape(count, -1, 6)
                for axis in range(3):
                    rows[:, :, axis] = points[point : point + count, axis, None]
        elif self._origin is None or not np.array_equal(points, self._origin):
            self._origin = points.copy()
            self._rows[:, :3] = points
        return self._rows[:n]

    def aim(self, unit: Float) -> None:
        """Write directions (3, n) to the rows."""
        for axis in range(3):
            self._rows[: unit.shape[1], 3 + axis] = unit[axis]

    def make(self, scan: Scan, start: int, stop: int, mesh: LocalMesh) -> tuple[Float, Starts]:
        """Make the rays `start` to `stop` of a scan, and write their directions to the rows.

        They are turned in float64, with the operations of `Pattern.rays` and so to the same
        bits, and rounded when they are written.

        Parameters
        ----------
        mesh
            In whose local units the rays start.

        Returns
        -------
        unit
            (3, n) float64, valid until the next call: directions, one row an axis.
        starts
            Where they start; as `unit`, valid until the next call.
        """
        n, poses = stop - start, scan.poses
        pose, skip = divmod(start, poses.rays)
        positions = poses.positions[pose : -(-stop // poses.rays)]
        given = _columns(scan.pattern.directions.T, scan.first + start, self._given[0, :, :n])
        unit = self._turn(given, poses, start, self._turned[0, :, :n], written=True)
        if scan.pattern.origins is None:
            return unit, Starts(mesh.to_local(positions), poses.rays, skip)
        given = _columns(scan.pattern.origins.T, scan.first + start, self._given[1, :, :n])
        moved = self._turned[1, :, :n]
        turned = self._turn(given, poses, start, moved, written=False)
        for at, length, number, count in _blocks(start, stop, poses.rays):
            block = slice(at, at + length)
            for axis in range(3):
                vectors, out = (a[axis, block].reshape(count, -1) for a in (turned, moved))
                np.add(vectors, poses.positions[number : number + count, axis, None], out=out)
                out -= mesh.centre[axis]  # as `to_local`
                out *= mesh.scale
        return unit, Starts(moved.T)

    def _turn(self, given: Float, poses: Poses, start: int, out: Float, *, written: bool) -> Float:
        """Turn vectors (3, n) of the rays from `start` on; `written` to the rows as directions.

        Returns them as (3, n): `out`, or `given` where there is nothing to turn.
        """
        n = given.shape[1]
        if poses.rotations is None:
            if written:
                self.aim(given)
            return given
        for at, length, pose, count in _blocks(start, start + n, poses.rays):
            block = slice(at, at + length)
            # All rays of a pose are beside each other: one row of the block a pose.
            shape = (count, -1) if count > 1 else (-1,)
            x, y, z = (row.reshape(shape) for row in given[:, block])
            product = self._product[:length].reshape(shape)
            for axis in range(3):
                a, b, c = _factors(poses.rotations[pose : pose + count, axis])
                total = out[axis, block].reshape(shape)
                np.multiply(x, a, out=total)
                total += np.multiply(y, b, out=product)
                total += np.multiply(z, c, out=product)
                if written:
                    self._rows[block, 3 + axis] = out[axis, block]
        return out


def _factors(rows: Float) -> Any:
    """Three columns of (count, 3), as numbers where there is one row."""
    return rows[0].tolist() if len(rows) == 1 else rows.T[:, :, None]


def _columns(table: Float, first: int, room: Float) -> Float:
    """Columns of a table (3, m) from `first` on, as many as `room` (3, n) has.

    After its last column the table starts over. Returns a part of the table if it is in one
    piece, else `room` with the columns in it.
    """
    (_, n), length = room.shape, table.shape[1]
    first %= length
    if first + n <= length:
        return table[:, first : first + n]
    done = length - first
    room[:, :done] = table[:, first:]
    turn = done  # from here on the table as a whole, over and over
    more = min(length, n - done)
    room[:, done : done + more] = table[:, :more]
    done += more
    while done < n:
        more = min(done - turn, n - done)
        room[:, done : done + more] = room[:, turn : turn + more]
        done += more
    return room


def _blocks(start: int, stop: int, each: int) -> Iterator[tuple[int, int, int, int]]:
    """Cut a range of rays so that each block has rays of one pose, or all rays of some poses.

    Yields the block's first ray, counted from `start`, how many it has, its first pose and how
    many poses.

    Examples
    --------
    >>> list(_blocks(3, 18, 4))
    [(0, 1, 0, 1), (1, 12, 1, 3), (13, 2, 4, 1)]
    """
    at = start
    while at < stop:
        pose, skip = divmod(at, each)
        whole = min(stop - at, _BLOCK) // each if not skip else 0
        length = whole * each or min(each - skip, stop - at, _BLOCK)
        yield at - start, length, pose, max(whole, 1)
        at += length

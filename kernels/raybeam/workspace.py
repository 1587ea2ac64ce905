"""Where the rays of a chunk are made for an engine that reads them in float32."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .mesh import LocalMesh
from .poses import Motion, Poses
from .scan import Scan

Float = NDArray[np.float64]

# Rays that are turned together: what that takes stays in a core's level 2 cache.
_BLOCK = 1 << 14
_FEW = 32  # rays of a pose


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
        row = ray if self.rays == 1 else (ray + self.skip) // self.rays
        # One axis at a time: `take` along an axis copies all points first where they are
        # transposed, which took as long as half of Embree's cast.
        out = np.empty((3, len(row)))
        for axis in range(3):
            self.points[:, axis].take(row, out=out[axis], mode="clip")
        return out.T


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
        self._crosses = np.empty((3, min(size, _BLOCK)))  # of a lidar that moves within a pose
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
        given = self._rays(scan, scan.pattern.directions.T, start, self._given[0, :, :n])
        unit = self._turn(given, poses, start, self._turned[0, :, :n], written=True)
        shifted, motion = scan.pattern.origins is not None, poses.motion
        if not shifted and motion is None:
            return unit, Starts(mesh.to_local(positions), poses.rays, skip)
        moved = turned = self._turned[1, :, :n]
        if scan.pattern.origins is not None:
            given = self._rays(scan, scan.pattern.origins.T, start, self._given[1, :, :n])
            turned = self._turn(given, poses, start, moved, written=False)
        for at, length, number, count in _blocks(start, stop, poses.rays):
            block = slice(at, at + length)
            product = self._product[:length].reshape(count, -1)
            for axis in range(3):
                vectors, out = (a[axis, block].reshape(count, -1) for a in (turned, moved))
                place = poses.positions[number : number + count, axis, None]
                np.add(vectors if shifted else 0.0, place, out=out)
                if motion is not None:
                    delay = _delays(motion, poses.rays, start + at, product.shape[1])
                    speed = motion.velocities[number : number + count, axis, None]
                    out += np.multiply(delay, speed, out=product)
                out -= mesh.centre[axis]  # as `to_local`
                out *= mesh.scale
        return unit, Starts(moved.T)

    @staticmethod
    def _rays(scan: Scan, table: Float, start: int, room: Float) -> Float:
        """Rows of a pattern (3, n) that are cast; where each pose casts all of it, (3, rays).

        Those of one pose stay in a core's cache, however many poses there are; but loops over few
        rays at a time cost more than that gains.
        """
        alike = table.shape[1] == scan.poses.rays >= _FEW and not scan.first
        if alike and scan.poses.rotations is not None and room.shape[1] > table.shape[1]:
            return table
        return _columns(table, scan.first + start, room)

    def _turn(self, given: Float, poses: Poses, start: int, out: Float, *, written: bool) -> Float:
        """Turn vectors (3, n) of the rays from `start` on; `written` to the rows as directions.

        Returns them as (3, n): `out`, or `given` where there is nothing to turn.
        """
        n = out.shape[1]
        if poses.rotations is None and poses.motion is None:
            if written:
                self.aim(given)
            return given
        for at, length, pose, count in _blocks(start, start + n, poses.rays):
            block = slice(at, at + length)
            # All rays of a pose are beside each other: one row of the block a pose.
            shape = (count, -1) if count > 1 else (-1,)
            product = self._product[:length].reshape(shape)
            if given.shape[1] == n:
                x, y, z = (row.reshape(shape) for row in given[:, block])
            else:  # those of one pose
                skip = (start + at) % poses.rays
                x, y, z = given[:, skip : skip + product.shape[-1]]
            for axis in range(3):
                total = out[axis, block].reshape(shape)
                if poses.rotations is None:
                    total[:] = (x, y, z)[axis]
                    continue
                a, b, c = _factors(poses.rotations[pose : pose + count, axis])
                np.multiply(x, a, out=total)
                total += np.multiply(y, b, out=product)
                total += np.multiply(z, c, out=product)
            if poses.motion is not None:
                rates = poses.motion.rates[pose : pose + count]
                delays = _delays(poses.motion, poses.rays, start + at, product.shape[-1])
                self._drift(out[:, block].reshape(3, *shape), rates, delays)
            if written:
                for axis in range(3):
                    self._rows[block, 3 + axis] = out[axis, block]
        return out

    def _drift(self, vectors: Float, rates: Float, delays: Float) -> None:
        """Turn vectors of a block on, in place; with the operations of `Poses.drifted`."""
        x, y, z = vectors
        crosses, product = self._crosses[:, : x.size].reshape(3, *x.shape), self._product[: x.size]
        product = product.reshape(x.shape)
        a, b, c = _factors(rates)
        for cross, (p, one, q, other) in zip(
            crosses, ((b, z, c, y), (c, x, a, z), (a, y, b, x)), strict=True
        ):
            np.multiply(p, one, out=cross)
            cross -= np.multiply(q, other, out=product)
            cross *= delays
        vectors += crosses


def _delays(motion: Motion, each: int, ray: int, count: int) -> Float:
    """Delays of the rays from `ray` on that are of its pose, at most `count`."""
    first = ray % each
    return motion.delays[first : first + count]


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

"""Makes the rays of a chunk for an engine that reads them in float32."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .mesh import LocalMesh
from .poses import Motion, Poses
from .scan import Scan

Float = NDArray[np.float64]

# Rays that are rotated together: their arrays stay in a core's level 2 cache.
_BLOCK = 1 << 14
_ORDERS = 8  # that are kept; 1 MiB each
# Numbers in a buffer of NumPy's. Since 2.3 it copies broadcast operands to buffers if they hold
# several rows, which makes a product of a row and a column three times as slow.
_BUFFER = 16


class Order:
    """Blocks of a chunk's rays, and the order of rays in them.

    Each block has rays of one pose, or all rays of some poses. Its rays are in order of number,
    pose by pose; but if it has more poses than a pose has rays, they are beam by beam: first ray 0
    of all poses, then ray 1. So NumPy's loops run along many poses, not along a few rays of each.

    Parameters
    ----------
    skip
        Rays of the first pose that are not in the chunk.
    rays
        Of the chunk.
    each
        Rays of a pose.
    plain
        Whether rays are in order of number in all blocks.

    Attributes
    ----------
    blocks
        For each block the first ray, the number of rays, the first pose, the number of poses.

    Examples
    --------
    >>> Order(3, 15, 4).blocks
    [(0, 1, 0, 1), (1, 12, 1, 3), (13, 2, 4, 1)]
    >>> Order(0, 6, 2).slots.tolist()
    [0, 3, 1, 4, 2, 5]
    """

    def __init__(self, skip: int, rays: int, each: int, *, plain: bool = False) -> None:
        self._skip, self._rays, self._each, self._plain = skip, rays, each, plain
        self.blocks = list(_blocks(skip, skip + rays, each))

    def by_beam(self, length: int, poses: int) -> bool:
        """Whether a block of so many rays and poses is in order of number."""
        return not self._plain and 1 < poses >= length // poses

    def view(self, slots: NDArray[Any], poses: int) -> NDArray[Any]:
        """View the slots of a block (..., length) as (..., poses, rays of a pose)."""
        if self.by_beam(slots.shape[-1], poses):
            return slots.reshape(*slots.shape[:-1], -1, poses).swapaxes(-1, -2)
        return slots.reshape(*slots.shape[:-1], poses, -1)

    @cached_property
    def slots(self) -> NDArray[np.intp] | None:
        """Slot of each ray, (rays,); None if in order of number."""
        if not any(self.by_beam(length, poses) for _, length, _, poses in self.blocks):
            return None
        table = np.arange(self._rays)
        parts = [self.view(table[a : a + n], k).reshape(-1) for a, n, _, k in self.blocks]
        return np.concatenate(parts)

    def of(self, ray: NDArray[np.intp]) -> NDArray[np.intp]:
        """Slots of some rays."""
        return ray if self.slots is None else self.slots.take(ray)

    def by_ray(self, values: NDArray[Any]) -> NDArray[Any]:
        """Reorder values (rays,) from slots to ray numbers."""
        return values if self.slots is None else values.take(self.slots)


class Starts:
    """Starts of the rays of a chunk, in local units.

    Parameters
    ----------
    points
        (n, 3): one for each slot; or (1, 3) for all.
    reach
        Largest absolute coordinate; by default computed.
    """

    def __init__(self, points: Float, reach: float | None = None) -> None:
        self.points = points
        if reach is None:
            reach = max(points.max(initial=0), -points.min(initial=0))
        self.reach = reach

    def of(self, slot: NDArray[np.intp]) -> Float:
        """Select starts of some rays: (len(slot), 3), or (1, 3) if all rays share one."""
        if len(self.points) == 1:
            return self.points
        # One axis at a time: `take` along an axis first copies all transposed points, which took
        # half as long as Embree's cast.
        out = np.empty((3, len(slot)))
        for axis in range(3):
            self.points[:, axis].take(slot, out=out[axis], mode="clip")
        return out.T


class Workspace:
    """Arrays for a chunk of rays, made once and used for chunk after chunk.

    Fresh pages for every chunk would take a quarter of the casting time. Unused parts take no
    memory, because the system assigns pages when they are written.

    Parameters
    ----------
    size
        Most rays of a chunk.
    """

    def __init__(self, size: int) -> None:
        self.size = size
        self._rows = np.empty((size, 6), np.float32)
        # One row for each axis: wrapped directions and origins of a pattern, and both rotated.
        self._given, self._turned = np.empty((2, 2, 3, size))
        self._product = np.empty(min(size, _BLOCK))
        self._crosses = np.empty((3, min(size, _BLOCK)))  # of a lidar that moves within a pose
        self._started: Starts | None = None  # starts of rows, if they differ
        self._origin: Float | None = None  # common start of the first rows
        self._alike = 0  # their number
        self._orders: dict[tuple[int, ...], Order] = {}  # of the last few shapes of chunks

    def start(self, n: int, starts: Starts) -> NDArray[np.float32]:
        """Write the starts of n rays, and return their rows for an engine.

        Nothing is written if they equal the last ones.

        Returns
        -------
        (n, 6): origins, and the directions that were written last.
        """
        points = starts.points
        if len(points) > 1:
            self._origin = None
            if starts is not self._started:
                for axis in range(3):
                    self._rows[:n, axis] = points[:, axis]
        elif self._origin is None or self._alike < n or not np.array_equal(points, self._origin):
            self._origin, self._alike = points.copy(), n
            for axis in range(3):
                self._rows[:n, axis] = points[0, axis]
        self._started = starts
        return self._rows[:n]

    def aim(self, unit: Float) -> None:
        """Write directions (3, n) to the rows."""
        for axis in range(3):
            self._rows[: unit.shape[1], 3 + axis] = unit[axis]

    def make(
        self, scan: Scan, start: int, stop: int, mesh: LocalMesh
    ) -> tuple[Order, Float, Starts]:
        """Make the rays `start` to `stop` of a scan, and write their directions to the rows.

        They are rotated in float64, with the operations of `Pattern.rays` and so the same bits,
        and rounded when written.

        Parameters
        ----------
        mesh
            The mesh of the local units.

        Returns
        -------
        order
            Order of the rays: the following arrays are by slot.
        unit
            (3, n) float64, valid until the next call: directions, one row for each axis.
        starts
            Starts of the rays; also valid until the next call.
        """
        before = np.setbufsize(_BUFFER)
        try:
            return self._make(scan, start, stop, mesh)
        finally:
            np.setbufsize(before)

    def _make(
        self, scan: Scan, start: int, stop: int, mesh: LocalMesh
    ) -> tuple[Order, Float, Starts]:
        n, poses, pattern = stop - start, scan.poses, scan.pattern
        order = self._order(start, n, poses)
        given = self._rays(scan, pattern.directions.T, start, self._given[0, :, :n])
        unit = self._turn(given, poses, start, order, self._turned[0, :, :n], written=True)
        first, motion = start // poses.rays, poses.motion
        if len(poses) == 1 and pattern.origins is None and motion is None:
            return order, unit, Starts(mesh.to_local(poses.positions))
        # The scale is a power of two: scaled before or after, the bits are the same.
        moved, centre = self._turned[1, :, :n], mesh.centre * mesh.scale
        if pattern.origins is not None:
            room = self._given[1, :, :n]
            given = self._rays(scan, pattern.origins.T, start, room)
            given = np.multiply(given, mesh.scale, out=room[:, : given.shape[1]])
            turned = self._turn(given, poses, start, order, moved, written=False)
        reach = np.abs(poses.positions[first : -(-stop // poses.rays)] * mesh.scale - centre).max()
        if pattern.origins is not None:
            reach += 2 * np.abs(given).max()
        if motion is not None:
            reach += np.abs(motion.delays).max() * np.abs(motion.velocities).max() * mesh.scale
        for at, length, pose, count in order.blocks:
            block, some = slice(at, at + length), slice(first + pose, first + pose + count)
            out, product = (order.view(a, count) for a in (moved[:, block], self._product[:length]))
            rows = order.view(self._rows[block].T, count)
            places = (poses.positions[some] * mesh.scale).T[:, :, None]
            if pattern.origins is None and motion is None:
                places = places - centre[:, None, None]
            if motion is not None:
                speeds = (motion.velocities[some] * mesh.scale).T[:, :, None]
                delays = _delays(motion, poses.rays, start + at, length // count)
            vectors = None if pattern.origins is None else order.view(turned[:, block], count)
            for axis, points in enumerate(out):
                if vectors is not None:
                    np.add(vectors[axis], places[axis], out=points)
                    if motion is not None:
                        points += np.multiply(delays, speeds[axis], out=product)
                elif motion is not None:
                    np.multiply(delays, speeds[axis], out=points)
                    points += places[axis]
                else:
                    points[:] = places[axis]
                if vectors is not None or motion is not None:
                    points -= centre[axis]
                rows[axis] = points
        self._started, self._origin = Starts(moved.T, float(reach)), None
        return order, unit, self._started

    def _order(self, start: int, rays: int, poses: Poses) -> Order:
        """Order of a chunk, made once for those of one shape."""
        plain = poses.rotations is None and poses.motion is None  # nothing is computed
        key = (start % poses.rays, rays, poses.rays, plain)
        if key not in self._orders:
            if len(self._orders) >= _ORDERS:
                self._orders.clear()
            self._orders[key] = Order(*key[:3], plain=plain)
        return self._orders[key]

    @staticmethod
    def _rays(scan: Scan, table: Float, start: int, room: Float) -> Float:
        """Rows of a pattern (3, n) that are cast; (3, rays) if each pose casts all of it.

        The rows of one pose stay in a core's cache, however many poses there are.
        """
        alike = table.shape[1] == scan.poses.rays and not scan.first
        turned = scan.poses.rotations is not None or scan.poses.motion is not None
        if alike and turned and room.shape[1] > table.shape[1]:
            return table
        return _columns(table, scan.first + start, room)

    def _turn(
        self, given: Float, poses: Poses, start: int, order: Order, out: Float, *, written: bool
    ) -> Float:
        """Rotate vectors of the rays from `start` on, see `_rays`; also `written` to the rows.

        Returns them by slot, (3, n): `out`, or `given` if there is no rotation.
        """
        n = out.shape[1]
        if poses.rotations is None and poses.motion is None:
            if written:
                self.aim(given)
            return given
        first = start // poses.rays
        for at, length, pose, count in order.blocks:
            block, some = slice(at, at + length), slice(first + pose, first + pose + count)
            product, turned = (
                order.view(a, count) for a in (self._product[:length], out[:, block])
            )
            if given.shape[1] == n:
                vectors = given[:, block].reshape(3, count, -1)
                if order.by_beam(length, count):
                    room = order.view(self._crosses[:, :length], count)
                    room[:] = vectors
                    vectors = room
            else:  # those of one pose
                skip = (start + at) % poses.rays
                vectors = given[:, None, skip : skip + length // count]
            x, y, z = vectors
            for axis, total in enumerate(turned):
                if poses.rotations is None:
                    total[:] = vectors[axis]
                    continue
                a, b, c = _factors(poses.rotations[some, axis])
                np.multiply(x, a, out=total)
                total += np.multiply(y, b, out=product)
                total += np.multiply(z, c, out=product)
            if poses.motion is not None and poses.motion.rates[some].any():
                delays = _delays(poses.motion, poses.rays, start + at, length // count)
                crosses = order.view(self._crosses[:, :length], count)
                _drift(turned, poses.motion.rates[some], delays, crosses, product)
            if written:
                rows = order.view(self._rows[block].T, count)
                for axis in range(3):
                    rows[3 + axis] = turned[axis]
        return out


def _drift(vectors: Float, rates: Float, delays: Float, crosses: Float, product: Float) -> None:
    """Rotate vectors of a block by their delays, in place, as `RayPoses.turned` does."""
    x, y, z = vectors
    a, b, c = _factors(rates)
    pairs = ((b, z, c, y), (c, x, a, z), (a, y, b, x))
    for cross, (p, one, q, other) in zip(crosses, pairs, strict=True):
        np.multiply(p, one, out=cross)
        cross -= np.multiply(q, other, out=product)
        cross *= delays
    vectors += crosses


def _delays(motion: Motion, each: int, ray: int, count: int) -> Float:
    """Delays of the rays from `ray` on in its pose, at most `count`."""
    first = ray % each
    return motion.delays[first : first + count]


def _factors(rows: Float) -> Any:
    """Three columns of (count, 3), as numbers if there is one row."""
    return rows[0].tolist() if len(rows) == 1 else rows.T[:, :, None]


def _columns(table: Float, first: int, room: Float) -> Float:
    """Columns of a table (3, m) from `first` on, as many as `room` (3, n) has.

    After its last column the table repeats. Returns a view of the table if it does not wrap,
    else `room` with the columns in it.
    """
    (_, n), length = room.shape, table.shape[1]
    first %= length
    if first + n <= length:
        return table[:, first : first + n]
    done = length - first
    room[:, :done] = table[:, first:]
    turn = done  # from here on, repeat the whole table
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

    Yields the block's first ray, counted from `start`, its number of rays, its first pose and its
    number of poses.

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

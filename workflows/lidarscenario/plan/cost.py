"""Cost of a path, which is the path length plus a penalty for entering discs.

The penalty outweighs any shortcut through a disc.

One thread evaluates the cost hundreds of thousands of times per second. Therefore values are in
single precision, particles are along the last (contiguous) axis, and results are written to
preallocated buffers. To obtain the same numbers on all machines, only additions, subtractions,
multiplications, divisions and square roots are used, and sums run over leading axes only, which
fixes the order of additions.
"""

from __future__ import annotations

import itertools

import numpy as np

from lidarsim.numerics.arrays import Floats, Floats32

# Discs are enlarged by this fraction of their distance and size, which is about 30 rounding errors
# in single precision. A path that is collision-free here also passes the exact check.
_MARGIN = 4e-6
_SLOPE = 8.0  # penalty of a depth of 1; a waypoint 1 inside a disc shortens the path by < 2
_TOUCH = np.float32(1e-5)  # penalty below which an entry is a rounding error, well under _MARGIN
_TINY = np.float32(1e-15)  # added to segments, so that a segment of length 0 has a direction
# Maximum number of elements in a buffer, to limit memory. Smaller blocks, which fit in the L2
# cache, were slower, because NumPy takes 0.7 µs to start each of about 35 operations.
_BLOCK_ELEMENTS = 160_000
_BLOCK_DISCS = 16  # minimum number of discs in a block; more particles make longer loops


class PathCost:
    """Cost of many paths with the same end points, in the coordinates of `PathAxes`.

    The cost of a path that enters no disc is its length. Otherwise a penalty is added. Its fixed
    part exceeds the length of the longest detour around all discs, so a path that enters a disc
    never beats a collision-free path. Its variable part is between `_SLOPE` and 2 `_SLOPE` times
    the depth in each disc, so the cost decreases toward the edge of a disc.

    `centers` has shape (m, 2) and `radii` has shape (m,), both in the coordinates of `PathAxes`.
    Each of the `particles` paths has `waypoints` corners between its end points.
    """

    def __init__(self, centers: Floats, radii: Floats, waypoints: int, particles: int) -> None:
        self._points = np.zeros((waypoints + 2, 2, particles), np.float32)
        self._points[0, 0] = -0.5
        self._points[-1, 0] = 0.5
        # Shape (waypoints, 2, particles), contiguous. Write positions here, then call `evaluate`.
        self.waypoints: Floats32 = self._points[1:-1]
        # Fixed part of the penalty for entering discs. The total circumference of all discs is an
        # upper bound for the length of a detour along their boundaries.
        self.entry_price = 2.0 + 2 * np.pi * float(radii.sum())
        self._cost = np.empty(particles, np.float32)
        pairs = min(len(radii), _BLOCK_DISCS) * (waypoints + 1) * particles
        blocks = min(particles, max(1, -(-pairs // _BLOCK_ELEMENTS)))  # rounded up
        starts = [particles * block // blocks for block in range(blocks + 1)]
        self._blocks = [slice(*span) for span in itertools.pairwise(starts)]
        # Blocks have at most two different widths, and each width has its own workspace. Loops over
        # whole, contiguous buffers are twice as fast as loops over slices of wider buffers.
        self._workspaces = {
            width: _Workspace(centers, _enlarged_radii(centers, radii), waypoints + 1, width)
            for width in {block.stop - block.start for block in self._blocks}
        }

    def evaluate(self) -> Floats32:
        """Return the cost of each path in `waypoints`.

        The result has shape (particles,). Every call returns the same buffer.
        """
        for block in self._blocks:
            workspace = self._workspaces[block.stop - block.start]
            workspace.evaluate(self._points[..., block], self._cost[block], self.entry_price)
        return self._cost


def _enlarged_radii(centers: Floats, radii: Floats) -> Floats:
    """Enlarge the radii of discs by a margin for rounding errors.

    The enlarged discs do not contain the end points of the path.
    """
    distance = np.sqrt(centers[:, 0] ** 2 + centers[:, 1] ** 2)
    end_distances = [np.sqrt((centers[:, 0] - x) ** 2 + centers[:, 1] ** 2) for x in (-0.5, 0.5)]
    nearest = np.maximum(np.minimum(*end_distances), radii)
    return np.asarray(np.minimum(radii + _MARGIN * (1 + distance + radii), nearest))


class _Workspace:
    """Buffers and computations for a block of paths and a block of discs.

    For a segment with unit direction e, midpoint M and half length h, and a disc with center C, let
    u = (C - M) · e and c = (C - M) x e. The distance from C to the closest point of the segment is
    √(c² + max(|u| - h, 0)²). All lengths are doubled here to avoid halving: 2C is used for C, the
    sum of both end points for 2M, and the segment length for 2h. The term max(|u| - h, 0) is
    computed as |u| - min(|u|, h), because NumPy vectorizes the minimum of two arrays, but not the
    minimum of an array and a scalar.

    Axes are (disc, segment, particle). The last two axes of each operand are contiguous, so that a
    product with a disc's coordinate runs as one long loop.
    """

    def __init__(self, centers: Floats, radii: Floats, segments: int, width: int) -> None:
        def singles(*shape: int) -> Floats32:
            return np.empty(shape, np.float32)

        discs = min(len(radii), max(1, _BLOCK_ELEMENTS // (segments * width)))  # discs in a block
        self._disc_blocks = [slice(i, i + discs) for i in range(0, len(radii), discs or 1)]
        doubled = (2 * centers).astype(np.float32)
        self._x = doubled[:, 0, None, None]
        self._y = doubled[:, 1, None, None]
        self._squared_radii = (4 * radii**2).astype(np.float32)[:, None]
        self._weights = (_SLOPE / (4 * radii)).astype(np.float32)[:, None]
        # Axes: x and y, segment, particle.
        self._direction, self._middle, self._products = (
            singles(2, segments, width) for _ in range(3)
        )
        self._length, self._parallel_middle, self._perpendicular_middle = (
            singles(segments, width) for _ in range(3)
        )
        # Axes: disc, segment, particle.
        self._parallel, self._perpendicular, self._scratch = (
            singles(discs, segments, width) for _ in range(3)
        )
        self._prices = singles(1 + discs, width)  # sum of all earlier blocks, then each disc
        self._price = singles(width)
        self._entered = np.empty(width, np.bool_)
        self._zeros = np.zeros(width, np.float32)  # an array, for speed (see the class docstring)

    def evaluate(self, points: Floats32, cost: Floats32, entry_price: float) -> None:
        """Write the cost of each path to `cost`.

        `cost` has shape (width,).

        `points` contains the points of the paths, including their ends. Shape (k + 2, 2, width).
        """
        direction = self._direction
        products = self._products
        length = self._length
        first = points[:-1].transpose(1, 0, 2)
        last = points[1:].transpose(1, 0, 2)
        np.subtract(last, first, out=direction)
        np.add(direction[0], _TINY, out=direction[0])
        np.square(direction, out=products)
        np.add(products[0], products[1], out=length)
        np.sqrt(length, out=length)
        np.add.reduce(length, axis=0, out=cost)
        if not self._disc_blocks:
            return
        middle = self._middle
        price = self._price
        np.divide(direction, length, out=direction)
        np.add(last, first, out=middle)
        np.multiply(middle, direction, out=products)
        np.add(products[0], products[1], out=self._parallel_middle)
        np.multiply(middle, direction[::-1], out=products)
        np.subtract(products[0], products[1], out=self._perpendicular_middle)
        price.fill(0)
        for discs in self._disc_blocks:
            self._add_price(discs)
        np.greater(price, _TOUCH, out=self._entered)
        np.add(cost, price, out=cost)
        np.multiply(self._entered, np.float32(entry_price), out=price)
        np.add(cost, price, out=cost)

    def _add_price(self, discs: slice) -> None:
        """Add the penalty for entering a block of discs to `_price`."""
        x = self._x[discs]
        y = self._y[discs]
        squared_radii = self._squared_radii[discs]
        count = len(x)
        parallel = self._parallel[:count]
        perpendicular = self._perpendicular[:count]
        scratch = self._scratch[:count]
        east, north = self._direction
        prices = self._prices[: 1 + count]

        np.multiply(x, east, out=parallel)
        np.multiply(y, north, out=scratch)
        np.add(parallel, scratch, out=parallel)
        np.subtract(parallel, self._parallel_middle, out=parallel)

        np.multiply(x, north, out=perpendicular)
        np.multiply(y, east, out=scratch)
        np.subtract(perpendicular, scratch, out=perpendicular)
        np.subtract(perpendicular, self._perpendicular_middle, out=perpendicular)

        np.abs(parallel, out=parallel)
        np.minimum(parallel, self._length, out=scratch)
        np.subtract(parallel, scratch, out=parallel)
        np.square(parallel, out=parallel)
        np.square(perpendicular, out=perpendicular)
        np.add(parallel, perpendicular, out=parallel)
        nearest = np.minimum.reduce(parallel, axis=1, out=prices[1:])  # squared distances, times 4

        # (r² - d²) / r lies between the depth and twice the depth
        np.subtract(squared_radii, nearest, out=nearest)
        np.multiply(nearest, self._weights[discs], out=nearest)
        np.maximum(nearest, self._zeros, out=nearest)
        # The order of additions is the order of the discs, regardless of the block size.
        prices[0] = self._price
        np.add.reduce(prices, axis=0, out=self._price)

"""Compiled loops that compute the distances between rays and boxes."""

# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import numpy as np

from raybeam.compiled import compiled, inlined


@inlined
def _slope(start, step, half, t):
    """Return half the derivative of the squared distance from a box to a point on a ray.

    The point is `start` + t * `step` in the frame of the box, whose half sizes are `half`.
    """
    slope = 0.0
    for axis in range(3):
        value = start[axis] + t * step[axis]
        outside = max(value - half[axis], 0.0) + min(value + half[axis], 0.0)
        slope += outside * step[axis]
    return slope


@inlined
def _square(start, step, half, t):
    """Return the squared distance from a box to a point on a ray."""
    square = 0.0
    for axis in range(3):
        value = start[axis] + t * step[axis]
        outside = max(value - half[axis], 0.0) + min(value + half[axis], 0.0)
        square += outside * outside
    return square


@inlined
def _nearest_square(start, step, half, t_min, t_max, cuts):
    """Return the squared distance between a box and the part of a ray from `t_min` to `t_max`.

    The squared distance to a point of the ray is a convex function of t, which is quadratic between
    the values of t at which the ray crosses a plane of the box. `cuts` (8,) is overwritten.
    """
    count = 0
    cuts[count] = t_min
    count += 1
    for axis in range(3):
        if step[axis] != 0:
            for side in (-half[axis], half[axis]):
                t = (side - start[axis]) / step[axis]
                if t_min < t < t_max:
                    cuts[count] = t
                    count += 1
    cuts[count] = t_max
    count += 1
    for k in range(2, count - 1):  # insertion sort of the cuts between the ends
        value = cuts[k]
        place = k
        while place > 1 and cuts[place - 1] > value:
            cuts[place] = cuts[place - 1]
            place -= 1
        cuts[place] = value
    before = _slope(start, step, half, cuts[0])
    if before >= 0:
        return _square(start, step, half, cuts[0])
    for k in range(1, count):
        after = _slope(start, step, half, cuts[k])
        if after >= 0:
            width = cuts[k] - cuts[k - 1]
            t = cuts[k - 1] - width * before / (after - before)
            return _square(start, step, half, t)
        before = after
    return _square(start, step, half, cuts[count - 1])


@compiled()
def nearest_boxes(rays, centers, rotations, halves, t_min, t_max, squares):  # noqa: PLR0914 - a compiled loop
    """Compute the squared distance between each box and the nearest ray.

    Parameters
    ----------
    rays
        float64 (6, n): origins in meters and unit directions.
    centers, rotations, halves
        Boxes (b, 3), (b, 3, 3) and (b, 3): centers, rotations from the box to the scene frame, and
        half sizes.
    t_min, t_max
        Start and end of the considered part of each ray, in meters.
    squares
        float64 (b,): squared distances, which the loop reduces.
    """
    start = np.empty(3)
    step = np.empty(3)
    cuts = np.empty(8)
    for box in range(len(centers)):
        half = halves[box]
        radius = np.sqrt(half[0] * half[0] + half[1] * half[1] + half[2] * half[2])
        for ray in range(rays.shape[1]):
            x = rays[0, ray] - centers[box, 0]
            y = rays[1, ray] - centers[box, 1]
            z = rays[2, ray] - centers[box, 2]
            dx = rays[3, ray]
            dy = rays[4, ray]
            dz = rays[5, ray]
            t = -(x * dx + y * dy + z * dz)
            t = min(max(t, t_min), t_max)
            reach = np.sqrt(squares[box]) + radius
            mx = x + t * dx
            my = y + t * dy
            mz = z + t * dz
            if mx * mx + my * my + mz * mz > reach * reach:
                continue  # the sphere around the box is farther away
            for axis in range(3):
                a = rotations[box, 0, axis]
                b = rotations[box, 1, axis]
                c = rotations[box, 2, axis]
                start[axis] = (x * a + y * b) + z * c
                step[axis] = (dx * a + dy * b) + dz * c
            square = _nearest_square(start, step, half, t_min, t_max, cuts)
            squares[box] = min(square, squares[box])

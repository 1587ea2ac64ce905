"""The ground that a scene stands on: its rectangle, grid lines and axis ticks."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

# Numbers of more digits than this are not read: far coordinates are labelled from an offset.
MOST_DIGITS = 5


@dataclass(frozen=True, eq=False)
class Axis:
    """Ticks of one axis.

    Parameters
    ----------
    name
        x, y or z.
    low, high
        Ends of the axis, local metres.
    step
        Distance of ticks in metres: 1, 2 or 5 times a power of ten.
    ticks
        (n,) local metres; round numbers in world coordinates.
    labels
        One a tick: the world coordinate less `offset`.
    offset
        Whole metres that the labels leave out, zero where world coordinates are short.
    """

    name: str
    low: float
    high: float
    step: float
    ticks: Floats
    labels: tuple[str, ...]
    offset: float

    @property
    def title(self) -> str:
        """Name, what the labels leave out, and unit."""
        if not self.offset:
            return f"{self.name} (m)"
        sign = "−" if self.offset > 0 else "+"
        return f"{self.name} {sign} {abs(self.offset):,.0f} (m)".replace(",", "\u2009")


@dataclass(frozen=True, eq=False)
class Stage:
    """A box with round ticks on its axes, and the ground rectangle under it.

    Parameters
    ----------
    bounds
        (2, 3) lowest and highest corner of what is shown, local metres.
    ground
        (2, 2) lowest and highest corner of the ground rectangle, local metres.
    level
        Height of the ground, local metres, a little under the lowest point.
    axes
        x, y and z.
    origin
        (3,) world coordinates of the local origin.
    """

    bounds: Floats
    ground: Floats
    level: float
    axes: tuple[Axis, Axis, Axis]
    origin: Floats

    @property
    def size(self) -> float:
        """Diagonal of the box in metres."""
        return float(np.linalg.norm(self.bounds[1] - self.bounds[0]))

    @property
    def corners(self) -> Floats:
        """Corners of the ground, anticlockwise from the lowest: (4, 3)."""
        (x0, y0), (x1, y1) = self.ground
        return np.array([[x, y, self.level] for x, y in ((x0, y0), (x1, y0), (x1, y1), (x0, y1))])

    @classmethod
    def around(cls, bounds: Floats, origin: Floats) -> Stage:
        """Build the stage of a box.

        Parameters
        ----------
        bounds
            (2, 3) finite, local metres; it may be flat or a single point.
        origin
            (3,) what local coordinates are added to.
        """
        low, high = bounds
        widest = float((high - low).max())
        if widest <= 1e-6 * max(float(np.abs(bounds).max()), 1.0):
            widest = 1.0
        # A flat or pointlike box gets some width, so that there is something to look at.
        pad = np.maximum(np.array([0.15, 0.15, 0.02]) * widest - (high - low), 0) / 2
        pad[2] = 0.0
        low, high = low - pad, high + pad
        high[2] = max(high[2], low[2] + 0.02 * widest)
        margin = 0.05 * widest
        ground = np.stack([low[:2] - margin, high[:2] + margin])
        level = float(low[2]) - 1e-3 * widest
        step = nice_step(float((ground[1] - ground[0]).max()) / 6)
        x, y = (
            axis(
                "xy"[k],
                float(ground[0, k]),
                float(ground[1, k]),
                min(step, nice_step(float(np.ptp(ground[:, k])) / 2)),
                float(origin[k]),
            )
            for k in range(2)
        )
        z = axis(
            "z", level, float(high[2]), nice_step(float(high[2] - low[2]) / 3), float(origin[2])
        )
        return cls(np.stack([low, high]), ground, level, (x, y, z), origin)


def axis(name: str, low: float, high: float, step: float, origin: float) -> Axis:
    """Place round ticks between `low` and `high`, which are local; world = local + origin."""
    slack = 1e-6 * step
    first = math.ceil((low + origin - slack) / step - 2e-3)
    last = math.floor((high + origin + slack) / step)
    world: Floats = np.arange(first, last + 1, dtype=np.float64) * step
    offset = 0.0
    far = 10.0**MOST_DIGITS
    if high - low < far and np.abs(world).max(initial=0.0) >= min(far, far * step):
        unit = 10.0 ** math.floor(math.log10(max(high - low, 1.0)))
        offset = math.floor(world[0] / unit) * unit
    decimals = max(0, -math.floor(math.log10(step) + 1e-9))
    labels = tuple(f"{value + 0.0:.{decimals}f}".replace("-", "−") for value in world - offset)
    return Axis(name, low, high, step, world - origin, labels, offset)


def nice_step(length: float) -> float:
    """Return the smallest of 1, 2, 5 times a power of ten that is at least `length`.

    Examples
    --------
    >>> nice_step(0.03), nice_step(7), nice_step(11)
    (0.05, 10.0, 20.0)
    """
    power = 10.0 ** math.floor(math.log10(length))
    for factor in (1, 2, 5):
        if length <= factor * power * (1 + 1e-9):
            return float(f"{factor * power:.12g}")
    return float(f"{10 * power:.12g}")


def robust_bounds(points: Floats) -> Floats | None:
    """Box of points (n, 3), (2, 3), that a few stray points do not blow up; None for none.

    Points that are not finite are left out. Where the box is over five times as wide as that
    of the middle 98%, the latter and half its width on each side is taken.
    """
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        return None
    full = np.stack([points.min(axis=0), points.max(axis=0)])
    if len(points) < 100:
        return full
    thinned = points[:: max(1, len(points) // 100_000)]
    middle = np.percentile(thinned, [1, 99], axis=0)
    width = np.maximum(np.ptp(middle, axis=0), 1e-9 * np.abs(full).max())
    stray = np.ptp(full, axis=0) > 5 * width + 0.2 * width.max()
    tight = np.stack([middle[0] - width / 2, middle[1] + width / 2])
    tight = np.stack([np.maximum(tight[0], full[0]), np.minimum(tight[1], full[1])])
    return np.where(stray, tight, full)

"""Define the plot box around a scene.

The ground is at the bottom of the box, and there are ticks along its axes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from lidarsim.numerics.arrays import Floats

# Coordinates with more digits are hard to read, so they are labeled relative to an offset.
MAX_DIGITS = 5


@dataclass(frozen=True, eq=False)
class Axis:
    """An axis with its ticks."""

    title: str  # name, offset of the labels, and unit
    ticks: Floats  # (n,) local, in meters, at round world coordinates
    labels: tuple[str, ...]  # world coordinates minus the offset in the title


@dataclass(frozen=True, eq=False)
class PlotBox:
    """A box above a rectangular ground, with ticks on its axes, in local coordinates."""

    bounds: Floats  # (2, 3) lowest and highest corner of the shown part
    ground: Floats  # (2, 2) lowest and highest corner of the ground
    level: float  # height of the ground, slightly below the lowest point
    axes: tuple[Axis, Axis, Axis]

    @property
    def size(self) -> float:
        """Diagonal of the box in meters."""
        return float(np.linalg.norm(self.bounds[1] - self.bounds[0]))

    @property
    def corners(self) -> Floats:
        """Corners of the ground, counterclockwise from the lowest x and y.

        The shape is (4, 3).
        """
        (x0, y0), (x1, y1) = self.ground
        return np.array([[x, y, self.level] for x, y in ((x0, y0), (x1, y0), (x1, y1), (x0, y1))])

    @classmethod
    def from_bounds(cls, bounds: Floats, origin: Floats) -> PlotBox:
        """Build the plot box for local bounds, which may be flat or a single point.

        `bounds` has shape (2, 3), and `origin` (3,) is the world position of the local origin.
        """
        lower, upper = bounds
        widest = float((upper - lower).max()) or 1.0
        # Give a flat box or a single point some width, so that there is something to see.
        pad = np.maximum(np.array([0.15, 0.15, 0.0]) * widest - (upper - lower), 0) / 2
        lower = lower - pad
        upper = upper + pad
        upper[2] = max(upper[2], lower[2] + 0.02 * widest)
        margin = 0.05 * widest
        ground = np.stack([lower[:2] - margin, upper[:2] + margin])
        level = float(lower[2]) - 1e-3 * widest
        step = nice_step(float(np.ptp(ground, axis=0).max()) / 6)
        x, y = (
            make_axis(name, g0, g1, min(step, nice_step((g1 - g0) / 2)), float(o))
            for name, (g0, g1), o in zip("xy", ground.T.tolist(), origin, strict=False)
        )
        up = nice_step(float(upper[2] - lower[2]) / 3)
        z = make_axis("z", level, float(upper[2]), up, float(origin[2]))
        return cls(np.stack([lower, upper]), ground, level, (x, y, z))


def make_axis(name: str, lower: float, upper: float, step: float, origin: float) -> Axis:
    """Place ticks at round world coordinates between two local coordinates.

    World coordinates are local coordinates plus `origin`.
    """
    first = math.ceil((lower + origin) / step - 2e-3)
    last = math.floor((upper + origin) / step + 1e-6)
    world: Floats = np.arange(first, last + 1, dtype=np.float64) * step
    offset = 0.0
    max_number = 10.0**MAX_DIGITS
    if upper - lower < max_number and np.abs(world).max(initial=0.0) >= min(
        max_number, max_number * step
    ):
        unit = 10.0 ** math.floor(math.log10(max(upper - lower, 1.0)))
        offset = math.floor(world[0] / unit) * unit
        sign = "−" if offset > 0 else "+"
        name = f"{name} {sign} {abs(offset):,.0f}".replace(",", "\u2009")
    decimals = max(0, -math.floor(math.log10(step) + 1e-9))
    labels = tuple(f"{value + 0.0:.{decimals}f}".replace("-", "−") for value in world - offset)
    return Axis(f"{name} (m)", world - origin, labels)


def nice_step(length: float) -> float:
    """Round a length up to 1, 2, or 5 times a power of ten.

    Examples
    --------
    >>> nice_step(0.03), nice_step(7), nice_step(11)
    (0.05, 10.0, 20.0)
    """
    power = 10.0 ** math.floor(math.log10(length))
    factor = next(f for f in (1, 2, 5, 10) if length <= f * power * (1 + 1e-9))
    return float(f"{factor * power:.12g}")

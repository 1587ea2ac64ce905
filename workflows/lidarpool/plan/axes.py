"""Normalised coordinates for planning."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from .geometry import Floats


@dataclass(frozen=True)
class PathAxes:
    """Axes in which the path starts at (-½, 0) and ends at (½, 0).

    The swarm computes in single precision and with fixed distances; in these axes neither
    georeferenced coordinates nor the size of the scene matter. Only + - x / and square roots are
    used, whose rounding IEEE 754 defines: the same numbers on every machine.

    Parameters
    ----------
    start, target
        Two different points of the plane, in metres.
    """

    start: tuple[float, float]
    target: tuple[float, float]

    @cached_property
    def unit_m(self) -> float:
        """Metres in one unit of these axes: the distance from start to target."""
        run, rise = self.target[0] - self.start[0], self.target[1] - self.start[1]
        return math.sqrt(run * run + rise * rise)

    @cached_property
    def _axis(self) -> tuple[float, float]:
        """The direction from start to target: the x axis, in the plane."""
        return (
            (self.target[0] - self.start[0]) / self.unit_m,
            (self.target[1] - self.start[1]) / self.unit_m,
        )

    @cached_property
    def _middle(self) -> Floats:
        return (np.array(self.start) + np.array(self.target)) / 2

    def to_local(self, points: Floats) -> Floats:
        """Convert points of the plane, (p, 2), to these axes."""
        (cos, sin), (x, y) = self._axis, (points - self._middle).T / self.unit_m
        return np.stack([cos * x + sin * y, cos * y - sin * x], axis=1)

    def to_plane(self, points: Floats) -> Floats:
        """Convert points on these axes, (p, 2), to the plane."""
        (cos, sin), (x, y) = self._axis, points.T * self.unit_m
        return np.stack([cos * x - sin * y, sin * x + cos * y], axis=1) + self._middle

"""Sub-rays of a beam, made from its direction when they are cast."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .arrays import Floats, Indices


@dataclass(frozen=True, eq=False)
class SubRays:
    """Sub-rays of each beam of a pattern.

    Attributes
    ----------
    angles
        float64 (k, 2): tangents of the angles off the beam's direction, across and up.
    starts
        float64 (k, 2): where sub-rays start, across and up, metres off the beam's start; None if
        all start there.
    axis
        float64 (3,): the axis about which "across" points counter-clockwise, and towards which "up"
        points, in the sensor's axes; None if any two axes across the beam will do.
    """

    angles: Floats
    starts: Floats | None = None
    axis: Floats | None = None

    def __len__(self) -> int:
        return len(self.angles)

    def shares(
        self, subray: Indices | slice = slice(None), offsets: Floats | None = None
    ) -> tuple[Floats, Floats, Floats]:
        """Shares of a unit vector ahead, across and up: (m,) each; `offsets` (2, m) add angles."""
        across, up = self.angles[subray].T
        if offsets is not None:
            across = across + offsets[0]
            up = up + offsets[1]
        straight = 1 / np.sqrt((1 + across * across) + up * up)
        return straight, across * straight, up * straight

    def table(self, offsets: Floats | None) -> Floats:
        """Shares, or the angles if there are offsets, and starts: (5, k), as loops read them."""
        out = np.zeros((5, len(self)))
        out[:3] = self.shares()
        if offsets is not None:  # shares differ by beam
            out[1:3] = self.angles.T
        if self.starts is not None:
            out[3:] = self.starts.T
        return out


def spread(
    sub_rays: SubRays, ahead: Floats, subray: Indices, offsets: Floats | None
) -> tuple[Floats, Floats | None]:
    """Directions (3, m) of sub-rays of beams (3, m), and where they start off the beams' starts.

    `offsets` (2, m) are added to the angles of each.
    """
    straight, one, other = sub_rays.shares(subray, offsets)
    axis = sub_rays.axis
    first, second = any_axes(ahead) if axis is None else axes_about(ahead, axis)
    out = (straight * ahead + one * first) + other * second
    if sub_rays.starts is None:
        return out, None
    aside, above = sub_rays.starts[subray].T
    return out, aside * first + above * second


def any_axes(directions: Floats) -> tuple[Floats, Floats]:
    """Two axes across unit directions (3, n): those of Duff et al. 2017, which always exist."""
    x, y, z = directions
    sign = np.where(z < 0, -1.0, 1.0)
    a = -1.0 / (sign + z)
    b = x * y * a
    one = np.stack([1 + sign * x * x * a, sign * b, -sign * x])
    return one, np.stack([b, sign + y * y * a, -y])


def axes_about(directions: Floats, axis: Floats) -> tuple[Floats, Floats]:
    """Axes across unit directions (3, n): counter-clockwise about an axis (3,), and towards it.

    Straight along the axis, they are those of `any_axes`.
    """
    x, y, z = directions
    a, b, c = axis
    across = np.stack([b * z - c * y, c * x - a * z, a * y - b * x])
    p, q, r = across
    length = np.sqrt((p * p + q * q) + r * r)
    p, q, r = one = across / np.maximum(length, 1e-300)
    other = np.stack([y * r - z * q, z * p - x * r, x * q - y * p])
    along = length < 1e-6
    if along.any():
        one[:, along], other[:, along] = any_axes(directions[:, along])
    return one, other

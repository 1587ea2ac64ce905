"""Sub-rays, which are computed from the direction of their beam during a cast."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .arrays import Floats, Indices
from .tile_sizes import VECTOR_RAYS


@dataclass(frozen=True, eq=False)
class SubRays:
    """Sub-rays into which each beam of a pattern is divided.

    Attributes
    ----------
    angles
        float64 (k, 2): tangents of the angles from the beam direction, across and up.
    starts
        float64 (k, 2): origin of each sub-ray relative to the beam origin, across and up, in
        meters. None if the sub-rays start at the beam origin.
    axis
        float64 (3,): axis in the sensor frame about which "across" points counterclockwise and
        toward which "up" points. None if any two perpendicular axes across the beam can be used.
    """

    angles: Floats
    starts: Floats | None = None
    axis: Floats | None = None

    def __len__(self) -> int:
        return len(self.angles)

    def components(
        self, subray: Indices | slice = slice(None), offsets: Floats | None = None
    ) -> tuple[Floats, Floats, Floats]:
        """Return the forward, lateral, and vertical components of the sub-ray directions.

        Each component of the unit vectors has shape (m,). `offsets` (2, m) contains the angles
        across and up, in radians, that are added to the angles of each sub-ray.
        """
        across, up = self.angles[subray].T
        if offsets is not None:
            across = across + offsets[0]
            up = up + offsets[1]
        forward = 1 / np.sqrt((1 + across * across) + up * up)
        return forward, across * forward, up * forward

    def loop_table(self, offsets: Floats | None) -> Floats:
        """Return the sub-rays as a table for compiled loops.

        The table has 5 rows. Each row is padded to whole vectors of 8 sub-rays by repeating the
        last sub-ray.

        The rows contain the forward, lateral and vertical components, and the starts across and up.
        With `offsets`, the components differ between beams, so rows 1 and 2 contain the angles
        instead.
        """
        rows = np.zeros((5, len(self)))
        rows[:3] = self.components()
        if offsets is not None:  # The components differ between beams.
            rows[1:3] = self.angles.T
        if self.starts is not None:
            rows[3:] = self.starts.T
        padded = np.minimum(np.arange(-(-len(self) // VECTOR_RAYS) * VECTOR_RAYS), len(self) - 1)
        return rows[:, padded]


def sub_ray_directions(
    sub_rays: SubRays, beam_directions: Floats, subray: Indices, offsets: Floats | None
) -> tuple[Floats, Floats | None]:
    """Return sub-ray directions, and sub-ray origins relative to the beam origins.

    Parameters
    ----------
    sub_rays
        Sub-rays of each beam.
    beam_directions
        (3, m): direction of each sub-ray's beam.
    subray
        (m,): index of each sub-ray within its beam.
    offsets
        (2, m): angles across and up, in radians, that are added to the angles of each sub-ray. None
        for no offsets.

    Returns
    -------
    directions
        (3, m), unit vectors.
    starts
        (3, m), in meters. None if sub-rays start at the beam origin.
    """
    forward, across, up = sub_rays.components(subray, offsets)
    axis = sub_rays.axis
    first, second = (
        perpendicular_axes(beam_directions)
        if axis is None
        else oriented_axes(beam_directions, axis)
    )
    directions = (forward * beam_directions + across * first) + up * second
    if sub_rays.starts is None:
        return directions, None
    lateral, vertical = sub_rays.starts[subray].T
    return directions, lateral * first + vertical * second


def perpendicular_axes(directions: Floats) -> tuple[Floats, Floats]:
    """Return two axes that are perpendicular to each other and to the given directions.

    The method of Duff et al. (2017) works for all directions.
    """
    x, y, z = directions
    sign = np.where(z < 0, -1.0, 1.0)
    a = -1.0 / (sign + z)
    b = x * y * a
    first = np.stack([1 + sign * x * x * a, sign * b, -sign * x])
    return first, np.stack([b, sign + y * y * a, -y])


def oriented_axes(directions: Floats, axis: Floats) -> tuple[Floats, Floats]:
    """Return two axes that are perpendicular to the given directions and aligned with an axis.

    The first one points counterclockwise about the axis and the second one upward along it. For
    directions parallel to the axis, the result is the same as that of `perpendicular_axes`.
    """
    x, y, z = directions
    a, b, c = axis
    across = np.stack([b * z - c * y, c * x - a * z, a * y - b * x])
    p, q, r = across
    length = np.sqrt((p * p + q * q) + r * r)
    p, q, r = unit_across = across / np.maximum(length, 1e-300)
    upward = np.stack([y * r - z * q, z * p - x * r, x * q - y * p])
    parallel = length < 1e-6
    if parallel.any():
        unit_across[:, parallel], upward[:, parallel] = perpendicular_axes(directions[:, parallel])
    return unit_across, upward

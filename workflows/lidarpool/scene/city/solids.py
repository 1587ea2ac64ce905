"""Closed shapes that houses, trees and cars are put together from."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray


@dataclass(frozen=True, eq=False)
class Solid:
    """Triangles in coordinates of their own, metres, standing on z = 0.

    Parameters
    ----------
    vertices
        float64 (v, 3).
    faces
        int64 (f, 3), counter-clockwise seen from outside.
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]

    def moved(self, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Solid:
        """Return it somewhere else."""
        return Solid(self.vertices + np.array([x, y, z]), self.faces)


def joined(parts: Iterable[Solid]) -> Solid:
    """Several solids as one; where they touch or overlap, each keeps its own surface."""
    solids = list(parts)
    starts = np.cumsum([0] + [len(solid.vertices) for solid in solids[:-1]])
    return Solid(
        np.concatenate([solid.vertices for solid in solids]),
        np.concatenate([s.faces + start for s, start in zip(solids, starts, strict=True)]),
    )


def loft(outline: ArrayLike, profile: Sequence[tuple[float, float]]) -> Solid:
    """Raise an outline along z, drawn in or out on the way, and close it at both ends.

    Parameters
    ----------
    outline
        (n, 2): a polygon, counter-clockwise, all of which can be seen from its first point.
    profile
        Pairs of a height and an inset: how far the outline's sides move inwards there, metres.

    Returns
    -------
    `2 * n * len(profile) - 4` triangles.
    """
    points = np.asarray(outline, dtype=np.float64)
    n = len(points)
    height, inset = np.asarray(profile, dtype=np.float64).T
    along = np.roll(points, -1, axis=0) - points
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    inward = np.stack([-along[:, 1], along[:, 0]], axis=1)
    before = np.roll(inward, 1, axis=0)
    # A corner moves so that both its sides move by the inset.
    mitre = (inward + before) / (1 + (inward * before).sum(axis=1, keepdims=True))
    rings = np.empty((len(height), n, 3))
    rings[..., :2] = points + inset[:, None, None] * mitre
    rings[..., 2] = height[:, None]
    here = np.arange(len(height) * n).reshape(-1, n)
    beside = np.roll(here, -1, axis=1)
    fan = np.arange(1, n - 1)
    lid = np.stack([np.zeros_like(fan), fan, fan + 1], axis=1)
    faces = [
        np.stack([here[:-1], beside[:-1], beside[1:]], axis=-1).reshape(-1, 3),
        np.stack([here[:-1], beside[1:], here[1:]], axis=-1).reshape(-1, 3),
        lid[:, ::-1],
        lid + here[-1, 0],
    ]
    return Solid(rings.reshape(-1, 3), np.concatenate(faces))


def rectangle(width: float, depth: float) -> NDArray[np.float64]:
    """Outline around zero: (4, 2)."""
    return np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * [width / 2, depth / 2]


def regular(sides: int, radius: float) -> NDArray[np.float64]:
    """Outline of a regular polygon around zero: (sides, 2)."""
    angle = 2 * np.pi * (np.arange(sides) + 0.5) / sides
    return radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def box(width: float, depth: float, height: float) -> Solid:
    """Box on z = 0, twelve triangles."""
    return loft(rectangle(width, depth), [(0, 0), (height, 0)])


def gable(width: float, depth: float, eaves: float, rise: float, hip: float = 0.0) -> Solid:
    """Pitched roof whose ridge runs along x, eight triangles.

    Parameters
    ----------
    width, depth
        Of the eaves, along x and y.
    eaves
        Height of the eaves.
    rise
        Of the ridge above them.
    hip
        How far the ridge's ends stay behind those of the eaves: 0 for a gabled roof.
    """
    x, y = width / 2, depth / 2
    ridge = [[hip - x, 0, rise], [x - hip, 0, rise]]
    corners = [[-x, -y, 0], [x, -y, 0], [x, y, 0], [-x, y, 0], *ridge]
    faces = [[0, 1, 5], [0, 5, 4], [2, 3, 4], [2, 4, 5], [1, 2, 5], [3, 0, 4], [0, 2, 1], [0, 3, 2]]
    return Solid(np.array(corners, dtype=np.float64), np.array(faces)).moved(z=eaves)


def lying(solid: Solid) -> Solid:
    """Lay it down: what was up points along y, what was along y points up."""
    return Solid(solid.vertices[:, [0, 2, 1]], solid.faces[:, ::-1])

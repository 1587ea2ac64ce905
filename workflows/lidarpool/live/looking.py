"""Views: a camera, a filter of points, and the point under the mouse."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray
from viser.transforms import SO3

from ..columns.cloud import Cloud
from ..export.ply_format import AXES

Floats = NDArray[np.floating]
Limits = tuple[float, float] | None  # lowest and highest, both included; None for all

_ACROSS, _DOWN = 48, 27
TILES = _ACROSS * _DOWN  # parts of a picture
_NEAR = 1e-6  # metres ahead of a camera; nearer points are not visible
_UNDER = 6.0  # pixels around the mouse in which a point is picked
_BEHIND = 1.03  # times the distance of the nearest: on another surface


def values_of(cloud: Cloud, name: str) -> NDArray[Any]:
    """Values (n,) of a column; x, y and z are the positions, world coordinates."""
    return np.asarray(cloud.positions[:, "xyz".index(name)]) if name in AXES else cloud[name]


def within(values: Any, limits: Limits) -> Any:
    """Whether values (n,) are within limits; NaN is not."""
    if limits is None:
        return np.ones(np.shape(values), np.bool_)
    return (values >= limits[0]) & (values <= limits[1])


@dataclass(frozen=True)
class Filter:
    """Filter: points whose columns are within limits, (column, lowest, highest) each."""

    limits: tuple[tuple[str, float, float], ...] = ()

    def of(self, column: str) -> Limits:
        """Limits of a column, if any."""
        return next(((low, high) for name, low, high in self.limits if name == column), None)

    def with_limits(self, column: str, limits: Limits) -> Filter:
        """Return a filter with these limits of a column, or without."""
        rest = tuple(entry for entry in self.limits if entry[0] != column)
        return Filter(rest if limits is None else (*rest, (column, *limits)))

    def keeps(self, cloud: Cloud) -> NDArray[np.bool_]:
        """Whether points (n,) are within all limits."""
        kept = np.ones(len(cloud), np.bool_)
        for name, low, high in self.limits:
            kept &= within(values_of(cloud, name), (low, high))
        return kept


@dataclass(frozen=True)
class Eye:
    """Pose and field of view of a browser's camera."""

    position: tuple[float, float, float]  # metres, local
    wxyz: tuple[float, float, float, float]  # from (right, down, ahead) to the scene's axes
    fov: float  # from the upper to the lower edge, radians
    aspect: float  # width of the picture by its height

    @classmethod
    def of(cls, camera: viser.CameraHandle) -> Eye:
        """Return the camera of a browser."""
        position, turn = camera.position.tolist(), camera.wxyz.tolist()
        aspect = camera.image_width / max(camera.image_height, 1)  # a window may have no height
        return cls(tuple(position), tuple(turn), camera.fov, aspect or 1.0)

    def seen(self, places: Floats) -> tuple[Floats, NDArray[np.bool_]]:
        """Project points (n, 3) to the picture, (n, 2) in -1 to 1, and whether they are in it."""
        x, y, z = self._before(places).astype(np.float32)
        depth = np.maximum(z, _NEAR)
        tangent = np.tan(self.fov / 2)
        at = np.stack([x / depth / (tangent * self.aspect), y / depth / tangent], axis=1)
        return at, (np.abs(at) < 1).all(axis=1) & (z > _NEAR)

    def _before(self, places: Floats) -> Floats:
        """Points (n, 3) in the camera's axes, (3, n)."""
        axes = SO3(np.array(self.wxyz)).as_matrix()
        return np.asarray(((places - np.array(self.position)) @ axes).T)

    def tiles(self, places: Floats) -> NDArray[np.int64]:
        """Part of the picture of each point (n, 3): (n,); -1 outside."""
        at, inside = self.seen(places)
        across, down = (np.clip(at, -1, 0.9999).T + 1) / 2
        column, row = (across * _ACROSS).astype(np.int64), (down * _DOWN).astype(np.int64)
        return np.where(inside, row * _ACROSS + column, -1)

    def may_see(self, box: Floats) -> bool:
        """Whether a box (2, 3) may be partly in the picture."""
        x, y, z = self._before(np.array(list(itertools.product(*box.T))))
        tall = z * np.tan(self.fov / 2)
        wide = tall * self.aspect
        outside = (z < 0, x > wide, x < -wide, y > tall, y < -tall)
        return not any(bool(beyond.all()) for beyond in outside)


def even_shares(counts: NDArray[Any], most: int) -> NDArray[np.float64]:
    """Shares (t,) of the points (t,) of each part of a picture, so that each part shows as many.

    A part with fewer points shows all of them; they are `most` in all.
    """
    each, few = np.inf, np.zeros(len(counts), np.bool_)
    for _ in range(len(counts)):
        rest = int((~few & (counts > 0)).sum())
        each = max(most - float(counts[few].sum()), 0.0) / rest if rest else np.inf
        fewer = counts <= each
        if (fewer == few).all():
            break
        few = fewer
    return np.minimum(each / np.maximum(counts, 1e-9), 1.0)


def picked(
    places: Floats, origin: Sequence[float], direction: Sequence[float], pixel: float
) -> int | None:
    """Pick one of the points (n, 3) by a ray from the camera through the mouse, or none.

    It is the nearest to the ray among those on the first surface. `pixel` is the angle between two
    rows of the picture, radians.
    """
    ahead = np.array(direction) / np.linalg.norm(direction)
    away = places - np.array(origin)
    depth = away @ ahead
    aside = np.linalg.norm(away - depth[:, None] * ahead, axis=1)
    angle = np.where(depth > 0, aside / np.maximum(depth, 1e-12), np.inf)
    near = np.flatnonzero(angle <= _UNDER * pixel)
    if not len(near):
        return None
    first = near[depth[near] <= _BEHIND * depth[near].min()]
    return int(first[angle[first].argmin()])

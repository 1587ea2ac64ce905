"""Samples: the points that a camera sees, one or several a pixel."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .camera import Camera
from .light import LightMap, plane_tolerance
from .stage import Axis, Stage
from .surface import Surface

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

SKY, GROUND = -1, -2  # in place of a triangle
LINE_PX = 1.3  # width of grid lines at 1600 pixels


@dataclass(frozen=True, eq=False)
class Samples:
    """What rays of the camera met; every array has one row a sample.

    Parameters
    ----------
    pixel
        int64 (n,) number of the pixel, row by row.
    at
        (n, 2) pixel coordinates.
    triangle
        int64 (n,) or SKY, GROUND.
    distance
        (n,) metres, infinite for the sky.
    position, normal
        (n, 3), NaN for the sky.
    line
        (n,) in 0 to 1, how much of a grid line is seen.
    light
        (n,) brightness, 1 in the open.
    """

    pixel: Ints
    at: Floats
    triangle: Ints
    distance: Floats
    position: Floats
    normal: Floats
    line: Floats
    light: Floats

    def select(self, which: NDArray[np.bool_]) -> Samples:
        """Return some of the samples."""
        return Samples(**{name: array[which] for name, array in vars(self).items()})

    def join(self, other: Samples) -> Samples:
        """Return these samples and then the others."""
        return Samples(
            **{n: np.concatenate([array, vars(other)[n]]) for n, array in vars(self).items()}
        )

    def average(self, values: Floats, pixels: int) -> Floats:
        """Mean of values (n, k) over the samples of each pixel: (pixels, k)."""
        count = np.bincount(self.pixel, minlength=pixels)
        sums = [np.bincount(self.pixel, weights=v, minlength=pixels) for v in values.T]
        return np.stack(sums, axis=1) / np.maximum(count, 1)[:, None]

    def lit(self, light: LightMap, camera: Camera, sun: Floats) -> Samples:
        """Return the samples with their brightness.

        Lambert's law for the sun, and the open part of the sky, brighter from above. Open
        ground, whose colour is the theme's as it is, has brightness 1.
        """
        brightness = np.ones(len(self.pixel))
        there = np.flatnonzero(self.triangle != SKY)
        normal = self.normal[there]
        tolerance = plane_tolerance(light.stride, camera, self.distance[there])
        sky, direct = light.at(self.at[there], self.position[there], normal, tolerance)
        facing = np.clip(normal @ sun, 0, None)
        on_surface = 0.78 * sky * (0.88 + 0.12 * normal[:, 2]) + 0.36 * facing * direct
        on_ground = 0.62 + 0.3 * sky + 0.08 * direct
        on_ground *= 1 - 0.1 * (1 - direct)
        brightness[there] = np.where(self.triangle[there] == GROUND, on_ground, on_surface)
        return replace(self, light=np.clip(brightness, 0, 1.12))


def look(
    stage: Stage,
    camera: Camera,
    surface: Surface | None,
    pixels: Floats,
    directions: Floats,
    hits: tuple[Floats, Ints, Floats, Floats] | None,
) -> Samples:
    """Make samples of hits, and of the ground where nothing stands before it.

    Parameters
    ----------
    pixels
        (n, 2) pixel coordinates.
    directions
        (n, 3) unit vectors through them.
    hits
        Distance, triangle, u, v of the closest hits; None where there is no surface.
    """
    count = len(pixels)
    distance, triangle = np.full(count, np.inf), np.full(count, SKY, dtype=np.int64)
    normal = np.full((count, 3), np.nan)
    if surface is not None and hits is not None:
        distance, triangle = hits[0], hits[1].copy()
        hit = triangle >= 0
        normal[hit] = surface.normals(triangle[hit], hits[2][hit], hits[3][hit], directions[hit])
    ground = ground_distance(stage, camera.eye, directions)
    nearer = ground < distance
    distance = np.where(nearer, ground, distance)
    triangle[nearer] = GROUND
    normal[nearer] = (0.0, 0.0, 1.0)
    there = triangle != SKY
    position = np.full((count, 3), np.nan)
    position[there] = camera.eye + distance[there, None] * directions[there]
    cell = np.floor(pixels).astype(np.int64)
    return Samples(
        pixel=cell[:, 1] * camera.size[0] + cell[:, 0],
        at=pixels,
        triangle=triangle,
        distance=distance,
        position=position,
        normal=normal,
        line=grid_lines(stage, camera, position, normal, directions),
        light=np.ones(count),
    )


def ground_distance(stage: Stage, eye: Floats, directions: Floats) -> Floats:
    """Metres (n,) from the eye to the ground's rectangle along directions (n, 3)."""
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = (stage.level - eye[2]) / directions[:, 2]
        place = eye[:2] + distance[:, None] * directions[:, :2]
    inside = ((place >= stage.ground[0]) & (place <= stage.ground[1])).all(axis=1)
    return np.where(inside & (distance > 0), distance, np.inf)


def grid_lines(
    stage: Stage, camera: Camera, position: Floats, normal: Floats, directions: Floats
) -> Floats:
    """How much of each sample is covered by a grid line, (n,) in 0 to 1.

    Lines lie on the ground and on level floors near it. Their edges are softened over the
    pixel's own footprint, which is longer the flatter the ray meets the ground.
    """
    out = np.zeros(len(position))
    with np.errstate(invalid="ignore"):
        low = np.abs(position[:, 2] - stage.level) < 0.008 * stage.size
        on = np.flatnonzero(low & (normal[:, 2] > 0.97))
    if not len(on):
        return out
    ray = directions[on]
    across = camera.footprint(np.linalg.norm(position[on] - camera.eye, axis=1))
    along = across / np.maximum(np.abs(ray[:, 2]), 1e-3)
    level = ray[:, :2] / np.maximum(np.linalg.norm(ray[:, :2], axis=1, keepdims=True), 1e-9)
    half = LINE_PX * camera.size[0] / 1600 / 2
    for k, axis in enumerate(stage.axes[:2]):
        pixel = np.hypot(along * level[:, k], across * level[:, 1 - k])
        gap = _gap(axis, position[on, k])
        out[on] = np.maximum(out[on], np.clip(0.5 + half - gap / pixel, 0, min(1.0, 2 * half)))
    return out


def _gap(axis: Axis, place: Floats) -> Floats:
    """Distance of coordinates (n,) from the nearest tick of an axis."""
    if not len(axis.ticks):
        return np.full(len(place), np.inf)
    nearest = np.clip(np.round((place - axis.ticks[0]) / axis.step), 0, len(axis.ticks) - 1)
    return np.asarray(np.abs(place - axis.ticks[0] - nearest * axis.step))

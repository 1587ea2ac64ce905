"""Compute the light on surfaces from the visible fractions of sky and sun."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np

from lidarsim.numerics.arrays import Bools, Floats, Floats32, Ints

from .camera import Camera
from .cutaway import Cutaway, is_blocked
from .surface import RenderMesh, dot, golden_spiral

STRIDE = 2  # shadows are computed at every second pixel in every second row
SKY_LIGHTS = 24
SUN_LIGHTS = 4
ROTATIONS = (
    0.12,
    0.02,
)  # rotation of the sky and sun lights between neighboring grid points, in radians
SUN_RADIUS_RAD = 0.045  # ten times the real radius, for soft shadows
SUN_SHARE = 0.4  # fraction of the light on open horizontal ground that comes from the sun
THIN_OPENNESS = 0.5  # openness of surfaces that are too thin to contain a grid point
# Brightness of a surface that faces the light.
AMBIENT = 0.24
SKY = 0.54
SUN = 0.36


@dataclass(frozen=True, eq=False)
class LightMap:
    """The light at a grid of pixels, with the surfaces that these pixels show."""

    camera: Camera
    sun: Floats  # (3,) unit vector toward the sun
    openness: Floats32  # (rows, columns) unblocked fraction of the light, from 0 to 1
    position: Floats32  # (rows, columns, 3) meters; NaN without a surface
    normal: Floats32  # (rows, columns, 3)

    def brightness(
        self, pixels: Floats, position: Floats32, normal: Floats32, ground: Bools
    ) -> Floats32:
        """Return the brightness of points by Lambert's law and the visible fraction of the sky.

        `pixels` (n, 2) are the pixel coordinates of the points, and `position` and `normal` (n, 3)
        their positions and normals. `ground` (n,) marks points on the ground, which keep their
        color where they are not shaded.
        """
        openness = self._openness_at(pixels, position, normal)
        facing = np.clip(normal @ self.sun.astype(np.float32), 0, None)
        lit = AMBIENT + openness * (SKY * (0.6 + 0.4 * normal[:, 2]) + SUN * facing)
        return np.asarray(np.where(ground, 0.6 + 0.4 * openness, lit))

    def _openness_at(self, pixels: Floats, position: Floats32, normal: Floats32) -> Floats32:
        """Interpolate the openness between nearby grid points on the same surface."""
        rows, columns = self.openness.shape
        tolerance = plane_tolerance(self.camera, position, STRIDE)
        start = ((pixels - 0.5) / STRIDE - 0.5).astype(np.float32) - (STRIDE // 2) / STRIDE
        cell = np.floor(start).astype(np.int64)
        part = start - cell
        # Interpolate the mean of two by two grid points, which rotate the lights differently.
        fractions = 1 - part, np.ones_like(part), part
        total = np.full(len(pixels), 1e-3, np.float32)
        summed = np.full(len(pixels), 1e-3 * THIN_OPENNESS, np.float32)
        for down, right in product(range(3), repeat=2):
            row = np.clip(cell[:, 1] + down, 0, rows - 1)
            column = np.clip(cell[:, 0] + right, 0, columns - 1)
            weight = surface_similarity(
                position, normal, self.position[row, column], self.normal[row, column], tolerance
            )
            weight *= fractions[down][:, 1] * fractions[right][:, 0]
            total += weight
            summed += weight * self.openness[row, column]
        return summed / total


def surface_similarity(
    position: Floats32, normal: Floats32, spot: Floats32, facing: Floats32, tolerance: Floats32
) -> Floats32:
    """Return how similar the surfaces at pairs of points are, from 0 to 0.4.

    `spot` and `facing` (n, 3) are the positions and normals of the other points. Points on the same
    surface lie within `tolerance` (n,) meters of each other's plane.
    """
    with np.errstate(invalid="ignore"):
        in_plane = np.abs(dot(spot - position, normal)) < tolerance
        return np.where(in_plane, np.clip(dot(facing, normal) - 0.6, 0, None), 0)


def plane_tolerance(camera: Camera, position: Floats32, stride: int) -> Floats32:
    """Return the distance from a plane, in meters, at which points still count as on it.

    The points are `stride` pixels apart.
    """
    offset = position - camera.eye.astype(np.float32)
    distance = np.sqrt(dot(offset, offset))
    return (3 * stride * camera.footprint(distance)).astype(np.float32)


def _sun_direction(camera: Camera) -> Floats:
    """Return the direction of the sun.

    The sun is behind the camera on the left, so shadows fall to the right.
    """
    back = -camera.axes[2] * np.array([1.0, 1.0, 0.0])
    sun = 0.4 * back / np.linalg.norm(back) - 0.55 * camera.axes[0] + np.array([0.0, 0.0, 0.95])
    return sun / np.linalg.norm(sun)


def make_light_map(
    surface: RenderMesh,
    cutaway: Cutaway | None,
    camera: Camera,
    position: Floats32,
    normal: Floats32,
    reach: float,
) -> LightMap:
    """Cast rays from a grid of surface points to lights in the sky and the sun.

    All points use the same lights, because small steps in brightness are invisible, while random
    directions would cause noise. Surfaces that the cutaway removes cast no shadow, and neither do
    surfaces farther away than `reach` meters. `position` and `normal` have shape (rows, columns,
    3), and are NaN for pixels without a surface.
    """
    sun = _sun_direction(camera)
    has_surface = np.isfinite(position[..., 0])
    origins = position[has_surface].astype(np.float64)
    facing = normal[has_surface].astype(np.float64)
    # Rays start half a pixel off the surface, so that it does not shade itself.
    origins += (
        0.5
        * camera.footprint(np.sqrt(dot(origins - camera.eye, origins - camera.eye)))[:, None]
        * facing
    )
    # Neighbors rotate the lights differently and are averaged, which has the effect of four times
    # as many lights.
    quarter = _quarters(has_surface)
    total_light = np.full(len(origins), 1e-9)
    open_light = np.full(len(origins), 1e-9)
    for direction, strength, rotation in zip(*_lights(sun), strict=True):
        toward = _rotated(direction, rotation)[quarter]
        light = strength * np.clip(dot(facing, toward), 0, None)
        lit = np.flatnonzero(light)
        free = lit[~is_blocked(surface, cutaway, origins[lit], toward[lit], reach)]
        total_light += light
        open_light[free] += light[free]
    openness = np.ones(has_surface.shape, np.float32)
    openness[has_surface] = open_light / total_light
    return LightMap(camera, sun, openness, position, normal)


def _quarters(has_surface: Bools) -> Ints:
    """Return the quarter of a two-by-two block in which each grid point lies, from 0 to 3.

    Only grid points with a surface are included. `has_surface` has shape (rows, columns).
    """
    row, column = np.nonzero(has_surface)
    return np.asarray(row % 2 + 2 * (column % 2))


def _rotated(direction: Floats, rotation: float) -> Floats:
    """Rotate a direction about z by 0, 1, 2, and 3 times `rotation`, in radians."""
    x, y, z = direction
    angles = rotation * np.arange(4)
    cos = np.cos(angles)
    sin = np.sin(angles)
    return np.stack([cos * x - sin * y, sin * x + cos * y, np.full_like(cos, z)], axis=1)


def _lights(sun: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the directions, strengths, and rotations of lights.

    The lights represent the sky and the sun. The directions (k, 3) are evenly spread. The strengths
    (k,) add up to 1 on level ground. The rotations (k,) are in radians.
    """
    n = np.arange(SUN_LIGHTS)
    azimuth = 2 * np.pi * 0.6180339887 * n
    radius = SUN_RADIUS_RAD * np.sqrt((n + 0.5) / SUN_LIGHTS)
    side = np.cross(sun, [0.0, 0.0, 1.0])
    side /= np.linalg.norm(side)
    disc = np.cos(azimuth)[:, None] * side + np.sin(azimuth)[:, None] * np.cross(side, sun)
    counts = [SKY_LIGHTS, SUN_LIGHTS]
    strengths = [2 * (1 - SUN_SHARE) / SKY_LIGHTS, SUN_SHARE / sun[2] / SUN_LIGHTS]
    lights = np.concatenate([golden_spiral(SKY_LIGHTS), sun + radius[:, None] * disc])
    return lights, np.repeat(strengths, counts), np.repeat(ROTATIONS, counts)

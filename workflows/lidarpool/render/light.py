"""Light on a picture's surfaces: how much sky and sun each point sees."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from .camera import Camera
from .cutaway import Cutaway, blocked
from .surface import Surface, unit

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

Bools = NDArray[np.bool_]
Blocked = Callable[[Floats, Floats], Bools]  # (origins, directions) -> (n,)

PATTERN = 4  # rays are spread over blocks of 4 x 4 pixels, and averaged over as many
BOUNCED = 0.22  # light from a direction where other surfaces are
GROUND_GLOW = 0.6  # light from below, off the ground


@dataclass(frozen=True)
class Rig:
    """How finely light is sampled.

    Parameters
    ----------
    stride
        Light is worked out at every `stride`-th pixel of every `stride`-th row.
    sky_rays, sun_rays
        Rays from each such pixel.
    reach
        Surfaces farther than this, in metres, cast no shadow.
    """

    stride: int = 2
    sky_rays: int = 16
    sun_rays: int = 4
    reach: float = np.inf


@dataclass(frozen=True, eq=False)
class LightMap:
    """Light at a grid of pixels, and on which surface each of them lies.

    Parameters
    ----------
    stride
        Distance of grid points in pixels.
    sky, sun
        (rows, columns) in 0 to 1: share of the sky that is seen, and of the sun's disc.
    position, normal
        (rows, columns, 3); NaN where there is no surface.
    """

    stride: int
    sky: Floats
    sun: Floats
    position: Floats
    normal: Floats

    def smoothed(self, tolerance: Floats) -> LightMap:
        """Return the map with each point averaged over a block around it, on its own surface.

        A block holds each of the pattern's directions once, so this takes the grain out.

        Parameters
        ----------
        tolerance
            (rows, columns) metres; points farther than this from the plane of the middle one
            are another surface.
        """
        reach = PATTERN // 2
        rows, columns = self.sky.shape
        light = np.stack([self.sky, self.sun], axis=-1)
        total = np.full((rows, columns), 1e-9)
        summed = 1e-9 * light
        for down, right in product(range(-reach, reach + 1), repeat=2):
            # Half of each outermost row and column: the block is PATTERN points wide.
            share = (0.5 if abs(down) == reach else 1.0) * (0.5 if abs(right) == reach else 1.0)
            here = _overlap(rows, down), _overlap(columns, right)
            there = _overlap(rows, -down), _overlap(columns, -right)
            weight = share * _alike(
                self.position[here],
                self.normal[here],
                self.position[there],
                self.normal[there],
                tolerance[here],
            )
            total[here] += weight
            summed[here] += weight[..., None] * light[there]
        sky, sun = np.moveaxis(summed / total[..., None], -1, 0)
        return replace(self, sky=sky, sun=sun)

    def at(self, pixels: Floats, position: Floats, normal: Floats, tolerance: Floats) -> Floats:
        """Sky and sun at points, (2, n), between the four grid points around each.

        Grid points on another surface than the point count for little.

        Parameters
        ----------
        pixels
            (n, 2) where the points are in the picture.
        position, normal
            (n, 3).
        tolerance
            (n,) metres, see `smoothed`.
        """
        rows, columns = self.sky.shape
        start = (pixels - self.stride // 2 - 0.5) / self.stride
        cell = np.floor(start).astype(np.int64)
        part = start - cell
        total = np.full(len(pixels), 1e-9)
        summed = np.full((2, len(pixels)), 1e-9)
        for down, right in product(range(2), repeat=2):
            row = np.clip(cell[:, 1] + down, 0, rows - 1)
            column = np.clip(cell[:, 0] + right, 0, columns - 1)
            spot = self.position[row, column]
            weight = _alike(position, normal, spot, self.normal[row, column], tolerance)
            weight = np.where(np.isfinite(spot[:, 0]), weight + 1e-3, 0.0)
            weight *= np.abs(1 - down - part[:, 1]) * np.abs(1 - right - part[:, 0])
            total += weight
            summed += weight * np.stack([self.sky[row, column], self.sun[row, column]])
        return np.asarray(summed / total)


def _alike(
    position: Floats, normal: Floats, spot: Floats, facing: Floats, tolerance: Floats
) -> Floats:
    """How much points (..., 3) are on one surface with spots (..., 3): 0 for not, to 0.4."""
    with np.errstate(invalid="ignore"):
        near = np.abs(((spot - position) * normal).sum(axis=-1)) < tolerance
        return np.where(near, np.clip((facing * normal).sum(axis=-1) - 0.6, 0, None), 0.0)


def _overlap(length: int, shift: int) -> slice:
    """Return the indices `n` of a row for which `n + shift` is in the row too."""
    return slice(max(0, -shift), min(length, length - shift))


def sun_direction(camera: Camera) -> Floats:
    """Towards the sun, (3,): over the camera's left shoulder, so that shadows fall right."""
    back = -camera.axes[2] * np.array([1.0, 1.0, 0.0])
    back /= np.linalg.norm(back)
    sun = 0.4 * back - 0.55 * camera.axes[0] + np.array([0.0, 0.0, 0.95])
    return sun / np.linalg.norm(sun)


def measure_light(
    surface: Surface | None,
    cutaway: Cutaway | None,
    rig: Rig,
    camera: Camera,
    position: Floats,
    normal: Floats,
) -> LightMap:
    """Cast rays to sky and sun from a grid of surface points.

    Parameters
    ----------
    surface
        What casts shadows; None for nothing.
    cutaway
        What is taken away and casts none.
    position, normal
        (rows, columns, 3); NaN where there is no surface.
    """
    shape = position.shape[:2]
    sky, sun = np.ones(shape), np.ones(shape)
    there = np.isfinite(position[..., 0])
    if surface is not None and there.any():
        row, column = np.nonzero(there)
        turn = _turns(row, column)
        at, facing = position[there], normal[there]
        # Rays start half a pixel off the surface, so that it does not shade itself.
        away = 0.5 * camera.footprint(np.linalg.norm(at - camera.eye, axis=1))
        at = at + away[:, None] * facing

        def dark(where: Floats, rays: Floats) -> Bools:
            return blocked(surface, cutaway, where, rays, rig.reach)

        sky[there] = _sky(dark, rig.sky_rays, at, facing, turn)
        sun[there] = _sun(dark, rig.sun_rays, at, facing, turn, sun_direction(camera))
    distance = np.linalg.norm(position - camera.eye, axis=-1)
    light = LightMap(rig.stride, sky, sun, position, normal)
    return light.smoothed(plane_tolerance(rig.stride, camera, distance))


def plane_tolerance(stride: int, camera: Camera, distance: Floats) -> Floats:
    """How far apart in metres points of one surface may be from each other's planes."""
    return 3 * stride * camera.footprint(distance)


def _sky(dark: Blocked, rays: int, at: Floats, facing: Floats, turn: Floats) -> Floats:
    """Share of the cosine-weighted hemisphere over points (n, 3) that is sky."""
    side, other = _frame(facing)
    total = np.zeros(len(at))
    for n in range(rays):
        angle = 2 * np.pi * (turn + 0.6180339887 * n)
        squared = (n + 0.5 + 0.9 * (turn * 7 % 1 - 0.5)) / rays
        across = np.sqrt(squared)[:, None]
        ray = (
            across * np.cos(angle)[:, None] * side
            + across * np.sin(angle)[:, None] * other
            + np.sqrt(1 - squared)[:, None] * facing
        )
        glow = np.where(ray[:, 2] >= 0, 1.0, GROUND_GLOW)
        total += np.where(dark(at, ray), BOUNCED, glow)
    return total / rays


def _sun(dark: Blocked, rays: int, at: Floats, facing: Floats, turn: Floats, sun: Floats) -> Floats:
    """Share of the sun's disc that points (n, 3) see; 1 on sides turned away, which is dark."""
    lit = np.flatnonzero(facing @ sun > 0)
    side, other = (axis[0] for axis in _frame(sun[None]))
    total = np.zeros(len(lit))
    for n in range(rays):
        angle = 2 * np.pi * (turn[lit] + n / rays)
        radius = 0.045 * np.sqrt((n + 0.5) / rays)
        ray = unit(
            sun + radius * np.cos(angle)[:, None] * side + radius * np.sin(angle)[:, None] * other
        )
        total += ~dark(at[lit], ray)
    out = np.ones(len(at))
    out[lit] = total / rays
    return out


def _turns(row: Ints, column: Ints) -> Floats:
    """Return one of 16 angles, as fractions of a turn, for each pixel of a 4 x 4 block."""
    order = np.array([0, 8, 2, 10, 12, 4, 14, 6, 3, 11, 1, 9, 15, 7, 13, 5])  # Bayer's matrix
    return np.asarray((order[(row % 4) * 4 + column % 4] + 0.5) / 16)


def _frame(normal: Floats) -> tuple[Floats, Floats]:
    """Two unit vectors (n, 3) at right angles to normals (n, 3) and each other."""
    helper = np.where(np.abs(normal[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    side = unit(np.cross(helper, normal))
    return side, np.cross(normal, side)

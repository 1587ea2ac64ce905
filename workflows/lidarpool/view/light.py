"""Light on a picture's surfaces: how much sky and sun each point sees."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .camera import Camera
from .cutaway import Cutaway, blocked
from .surface import Surface, unit

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

Blocked = Callable[[Floats, Floats], NDArray[np.bool_]]  # (origins, directions) -> (n,)

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

    def at(self, pixels: Floats, position: Floats, normal: Floats, tolerance: Floats) -> Floats:
        """Sky and sun at points, averaged over the grid points near them on the same surface.

        Parameters
        ----------
        pixels
            (n, 2) where the points are in the picture.
        position, normal
            (n, 3).
        tolerance
            (n,) metres; grid points farther than this from the plane are another surface.

        Returns
        -------
        (2, n)
        """
        rows, columns = self.sky.shape
        cell = np.floor(pixels / self.stride - PATTERN / 2 + 0.5).astype(np.int64)
        out = np.full((2, len(pixels)), 1.0)
        busy = self._shaded()[
            np.clip(cell[:, 1], 0, rows - 1), np.clip(cell[:, 0], 0, columns - 1)
        ].nonzero()[0]
        total = np.full(len(busy), 1e-9)
        summed = np.full((2, len(busy)), 1e-9)
        for shift in range(PATTERN * PATTERN):
            row = np.clip(cell[busy, 1] + shift // PATTERN, 0, rows - 1)
            column = np.clip(cell[busy, 0] + shift % PATTERN, 0, columns - 1)
            off_plane = ((self.position[row, column] - position[busy]) * normal[busy]).sum(axis=1)
            alike = (self.normal[row, column] * normal[busy]).sum(axis=1)
            with np.errstate(invalid="ignore"):
                weight = (np.abs(off_plane) < tolerance[busy]) * np.clip(alike - 0.6, 0, None)
            weight = np.nan_to_num(weight)
            total += weight
            summed[0] += weight * self.sky[row, column]
            summed[1] += weight * self.sun[row, column]
        out[:, busy] = summed / total
        return out

    def _shaded(self) -> NDArray[np.bool_]:
        """Whether the block that starts at a grid point holds any point not fully lit."""
        dim = (self.sky < 0.999) | (self.sun < 0.999)
        padded = np.pad(dim, ((0, PATTERN - 1), (0, PATTERN - 1)), mode="edge")
        windows = np.lib.stride_tricks.sliding_window_view(padded, (PATTERN, PATTERN))
        return windows.any(axis=(2, 3))


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

        def dark(where: Floats, rays: Floats) -> NDArray[np.bool_]:
            return blocked(surface, cutaway, where, rays, rig.reach)

        sky[there] = _sky(dark, rig.sky_rays, at, facing, turn)
        sun[there] = _sun(dark, rig.sun_rays, at, facing, turn, sun_direction(camera))
    return LightMap(rig.stride, sky, sun, position, normal)


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

"""A perspective camera: from pixels to rays, from points to pixels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from lidarsim.base.arrays import AnyArray, Floats


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera.

    Pixel coordinates are continuous: x to the right, y down, the centre of the first pixel at
    (0.5, 0.5).
    """

    eye: Floats  # (3,) metres
    axes: Floats  # (3, 3), rows: unit vectors to the right, up and forward
    focal: float  # length in pixels
    centre: Floats  # (2,) pixel that looks straight ahead; it may lie outside the image
    size: tuple[int, int]  # width and height in pixels

    def rays(self, pixels: ArrayLike) -> Floats:
        """Return unit directions (n, 3) through pixel coordinates (n, 2)."""
        plane = (np.asarray(pixels, dtype=np.float64) - self.centre) / self.focal
        rays = plane[:, :1] * self.axes[0] - plane[:, 1:] * self.axes[1] + self.axes[2]
        return rays / np.sqrt(np.einsum("ij,ij->i", rays, rays))[:, None]

    def project(self, points: ArrayLike) -> tuple[Floats, Floats]:
        """Pixel coordinates (n, 2) and distances from the eye (n,) of points (n, 3).

        Points beside or behind the eye have NaN coordinates.
        """
        offset = np.asarray(points, dtype=np.float64) - self.eye
        side, up, ahead = (offset @ self.axes.T).T
        ahead = np.where(ahead > 1e-9 * np.abs(offset).max(initial=0.0), ahead, np.nan)
        pixels = np.stack([side / ahead, -up / ahead], axis=1) * self.focal + self.centre
        return pixels, np.sqrt(np.einsum("ij,ij->i", offset, offset))

    def look_up(self, image: AnyArray, pixels: ArrayLike, outside: float) -> AnyArray:
        """Values (n,) of an image at pixel coordinates (n, 2); `outside` beside it, or for NaN."""
        place = np.asarray(pixels)
        inside = np.all((place >= 0) & (place < np.array(self.size)), axis=1)
        column, row = np.where(inside[:, None], place, 0).astype(np.int64).T
        return np.where(inside, image[row, column], outside)

    def footprint(self, distance: ArrayLike) -> Floats:
        """Width in metres that one pixel covers at a distance, seen face on."""
        return np.asarray(distance, dtype=np.float64) / self.focal


def fit_camera(
    points: ArrayLike,
    size: tuple[int, int],
    frame: tuple[float, float, float, float],
    azimuth_deg: float,
    elevation_deg: float,
) -> Camera:
    """Place a camera so that points (n, 3), not all in one place, fill a frame within its image.

    Seen from the points, the eye is in the given direction, at 7 times their radius, which keeps
    uprights upright; focal length and image centre are then chosen so that the projected points
    touch the frame: left, top, right and bottom as fractions of the image.
    """
    corners = np.asarray(points, dtype=np.float64)
    low = corners.min(axis=0)
    high = corners.max(axis=0)
    azimuth, elevation = np.radians([azimuth_deg, elevation_deg])
    ahead = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    back = ahead * np.cos(elevation) + np.array([0.0, 0.0, np.sin(elevation)])
    right = np.array([-ahead[1], ahead[0], 0.0])
    axes = np.stack([right, np.cross(back, right), -back])
    eye = (low + high) / 2 + back * 7.0 * np.linalg.norm(high - low) / 2
    flat, _ = Camera(eye, axes, 1.0, np.zeros(2), size).project(corners)
    least = flat.min(axis=0)
    most = flat.max(axis=0)
    start, end = np.array(frame).reshape(2, 2)
    middle = (start + end) * size / 2
    focal = float(((end - start) * size / (most - least)).min())
    return Camera(eye, axes, focal, middle - focal * (least + most) / 2, size)

"""Define a perspective camera that converts pixels to rays and points to pixels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from lidarsim.numerics.arrays import AnyArray, Floats


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera.

    Pixel coordinates are continuous: x points right, y points down, and the center of the first
    pixel is at (0.5, 0.5).
    """

    eye: Floats  # (3,) meters
    axes: Floats  # (3, 3) unit vectors to the right, up, and forward as rows
    focal: float  # focal length in pixels
    center: Floats  # (2,) principal point in pixels, which may lie outside the image
    size: tuple[int, int]  # width and height in pixels

    def rays(self, pixels: ArrayLike) -> Floats:
        """Return the unit direction vectors of rays through pixel coordinates."""
        plane = (np.asarray(pixels, dtype=np.float64) - self.center) / self.focal
        rays = plane[:, :1] * self.axes[0] - plane[:, 1:] * self.axes[1] + self.axes[2]
        return rays / np.sqrt(np.einsum("ij,ij->i", rays, rays))[:, None]

    def project(self, points: ArrayLike) -> tuple[Floats, Floats]:
        """Return the pixel coordinates of points and their distances from the eye.

        Points beside or behind the eye have NaN as coordinates.
        """
        offset = np.asarray(points, dtype=np.float64) - self.eye
        side, up, ahead = (offset @ self.axes.T).T
        ahead = np.where(ahead > 1e-9 * np.abs(offset).max(initial=0.0), ahead, np.nan)
        pixels = np.stack([side / ahead, -up / ahead], axis=1) * self.focal + self.center
        return pixels, np.sqrt(np.einsum("ij,ij->i", offset, offset))

    def sample_image(self, image: AnyArray, pixels: ArrayLike, outside: float) -> AnyArray:
        """Return the values of an image at pixel coordinates.

        Pixels outside the image have the value `outside`.
        """
        position = np.asarray(pixels)
        inside = np.all((position >= 0) & (position < np.array(self.size)), axis=1)
        column, row = np.where(inside[:, None], position, 0).astype(np.int64).T
        return np.where(inside, image[row, column], outside)

    def footprint(self, distance: ArrayLike) -> Floats:
        """Return the width in meters that a pixel covers on a surface facing the camera.

        `distance` is the distance to the surface in meters.
        """
        return np.asarray(distance, dtype=np.float64) / self.focal


def fit_camera(
    points: ArrayLike,
    size: tuple[int, int],
    frame: tuple[float, float, float, float],
    azimuth_deg: float,
    elevation_deg: float,
) -> Camera:
    """Place a camera so that points fill a frame within the image.

    The camera is at 7 times the radius of the points, so that vertical lines stay almost vertical.

    Parameters
    ----------
    points
        (n, 3) positions, at least two of them different.
    size
        Width and height of the image in pixels.
    frame
        Left, top, right, and bottom edge of the frame, as fractions of the image.
    azimuth_deg, elevation_deg
        Direction from the points to the camera.
    """
    corners = np.asarray(points, dtype=np.float64)
    lower = corners.min(axis=0)
    upper = corners.max(axis=0)
    axes = _camera_axes(*np.radians([azimuth_deg, elevation_deg]))
    back = -axes[2]
    eye = (lower + upper) / 2 + back * 7.0 * np.linalg.norm(upper - lower) / 2
    flat, _ = Camera(eye, axes, 1.0, np.zeros(2), size).project(corners)
    flat_lower = flat.min(axis=0)
    flat_upper = flat.max(axis=0)
    start, end = np.array(frame).reshape(2, 2)
    middle = (start + end) * size / 2
    focal = float(((end - start) * size / (flat_upper - flat_lower)).min())
    return Camera(eye, axes, focal, middle - focal * (flat_lower + flat_upper) / 2, size)


def _camera_axes(azimuth: float, elevation: float) -> Floats:
    """Return `Camera.axes` for a camera at an azimuth and elevation from the scene.

    Both angles are in radians.
    """
    horizontal = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    back = horizontal * np.cos(elevation) + np.array([0.0, 0.0, np.sin(elevation)])
    right = np.array([-horizontal[1], horizontal[0], 0.0])
    return np.stack([right, np.cross(back, right), -back])

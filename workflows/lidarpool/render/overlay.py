"""Lines, markers and points over a shot, hidden where the scene stands before them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .camera import Camera
from .shot import Shot

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

STEPS = 700  # places along a line where its depth is tested


def visible(shot: Shot, points: Floats, slack: float = 2.0) -> tuple[Floats, Bools]:
    """Where points are in the picture, and whether nothing hides them.

    Parameters
    ----------
    points
        (n, 3) local metres.
    slack
        How many pixels' widths a point may lie behind what its pixel shows.

    Returns
    -------
    pixels : (n, 2)
    seen : bool (n,), False outside the picture
    """
    pixels, distance = shot.camera.project(points)
    inside, column, row = shot.camera.cells(pixels)
    return pixels, inside & (
        distance <= shot.depth[row, column] + slack * shot.camera.footprint(distance)
    )


def visible_runs(shot: Shot, segments: Floats, slack: float = 2.0) -> list[Floats]:
    """Split line segments (n, 2, 3) into the pieces that can be seen; see `visible`.

    Returns
    -------
    list of (2, 2)
        Pixel coordinates of the ends of each piece.
    """
    if not len(segments):
        return []
    ends, _ = shot.camera.project(segments.reshape(-1, 3))
    ahead = np.isfinite(ends).all(axis=1).reshape(-1, 2).all(axis=1)
    segments = segments[ahead]
    # Steps of equal length in the picture: interpolate 1 / depth, which is linear there.
    near, far = ((segments[:, end] - shot.camera.eye) @ shot.camera.axes[2] for end in (0, 1))
    s = np.linspace(0, 1, STEPS)[None]
    share = s * near[:, None] / (far[:, None] * (1 - s) + s * near[:, None])
    path = segments[:, :1] + share[..., None] * (segments[:, 1:] - segments[:, :1])
    pixels, seen = visible(shot, path.reshape(-1, 3), slack)
    pixels, seen = pixels.reshape(-1, STEPS, 2), seen.reshape(-1, STEPS)
    runs = []
    for line, shown in zip(pixels, seen, strict=True):
        turns = np.flatnonzero(np.diff(np.concatenate([[0], shown.astype(np.int8), [0]])))
        runs += [
            line[[first, last - 1]]
            for first, last in zip(turns[::2], turns[1::2], strict=True)
            if last - first > 1
        ]
    return runs


def splat(
    image: Floats, camera: Camera, points: Floats, colours: Floats, radius: float, rim: Floats
) -> Floats:
    """Draw points as discs, nearer ones over farther ones.

    Each disc is drawn at twice the resolution and averaged down, so its edge is smooth. Where
    a farther disc meets a nearer one it is darkened (eye-dome lighting, Boucheny 2009), which
    makes shapes of points alone readable.

    Parameters
    ----------
    image
        (height, width, 3) in 0 to 1, drawn over.
    points
        (n, 3) those that are to be seen, local metres.
    colours
        (n, 3) in 0 to 1.
    radius
        Of the discs, in pixels.
    rim
        (3,) colour that darkening goes to.

    Returns
    -------
    (height, width, 3)
    """
    height, width = image.shape[:2]
    pixels, distance = camera.project(points)
    inside = ((pixels > 1) & (pixels < (width - 1, height - 1))).all(axis=1)
    pixels, distance, colours = pixels[inside], distance[inside], colours[inside]
    if not len(pixels):
        return image
    column, row = np.floor(2 * pixels).astype(np.int64).T
    nearest = np.full(4 * width * height, np.inf)
    cells = [
        (np.clip(row + dy, 0, 2 * height - 1) * 2 * width + np.clip(column + dx, 0, 2 * width - 1))
        for dx, dy in _disc(2 * radius)
    ]
    for cell in cells:
        np.minimum.at(nearest, cell, distance)
    fine = np.repeat(np.repeat(image, 2, axis=0), 2, axis=1).reshape(-1, 3)
    for cell in cells:
        shown = nearest[cell] == distance
        fine[cell[shown]] = colours[shown]
    drawn = np.flatnonzero(np.isfinite(nearest))
    dim = _eye_dome(nearest.reshape(2 * height, 2 * width), drawn, max(1, round(radius)))
    fine[drawn] = rim + (fine[drawn] - rim) * dim[:, None]
    return np.asarray(fine.reshape(height, 2, width, 2, 3).mean(axis=(1, 3)))


def _disc(radius: float) -> list[tuple[int, int]]:
    """Offsets of the cells within a radius of the middle one."""
    reach = int(radius)
    span = range(-reach, reach + 1)
    return [(dx, dy) for dy in span for dx in span if dx * dx + dy * dy <= radius * radius]


def _eye_dome(nearest: Floats, drawn: NDArray[np.int64], reach: int) -> Floats:
    """Brightness (n,) of drawn cells: less where cells around are nearer."""
    rows, columns = nearest.shape
    row, column = np.divmod(drawn, columns)
    here = np.log2(nearest[row, column])
    behind = np.zeros(len(drawn))
    for dy, dx in ((0, reach), (0, -reach), (reach, 0), (-reach, 0)):
        beside = nearest[np.clip(row + dy, 0, rows - 1), np.clip(column + dx, 0, columns - 1)]
        behind += np.where(np.isfinite(beside), np.clip(here - np.log2(beside), 0, None), 0)
    return np.asarray(np.exp(-12 * np.clip(behind, 0, 0.1)))

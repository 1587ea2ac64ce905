"""The picture of a point cloud, over its scene drawn pale."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from matplotlib.colors import Normalize
from numpy.typing import ArrayLike, NDArray

from ..base.choice import one_of_each_part
from ..base.errors import LidarpoolError
from ..scene.scene import Scene
from .captions import facts, without_common_prefix
from .overlay import splat
from .page import Page
from .scene_picture import scene_colours, surrounding
from .shot import SIZE, Shot, finite_points, take_shot
from .theme import Theme, mapped, object_colours, theme_for

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

MOST_POINTS = 2_000_000
HEIGHT_COLOURS = mapped("turbo", np.linspace(0.06, 0.94, 256))  # the ends are nearly black


def draw_cloud(
    path: str | os.PathLike[str],
    positions: ArrayLike,
    poses: ArrayLike = (),
    *,
    objects: ArrayLike | None = None,
    count: int | None = None,
    scene: Scene | None = None,
    shot: Shot | None = None,
    size: tuple[int, int] = SIZE,
    dark: bool = False,
    backend: str = "auto",
) -> Path:
    """Draw a point cloud, coloured by height, or by object where `objects` says which.

    Parameters
    ----------
    path, poses, shot, size, dark, backend
        See `draw_scene`.
    positions
        (n, 3) world coordinates; points that are not finite are left out, and of more than two
        million an even choice is drawn.
    objects
        (n,) the object of each point, an index into `scene.names`.
    count
        Points of the whole cloud, for the title, where `positions` are a choice of them.
    scene
        Drawn pale under the points and hides those behind it. Without it: the points alone.

    Raises
    ------
    LidarpoolError
        If `objects` does not fit the positions, or the file cannot be written.
    """
    sensors = finite_points(poses)
    points, owners, given = _thinned(positions, objects)
    shot = shot or take_shot(scene, sensors, points=points, size=size, backend=backend)
    points = points - shot.stage.origin
    theme = theme_for(dark)
    scene = scene or shot.scene
    page = Page(size, theme)
    if owners is None:
        low, high = _heights(points, shot)
        share = np.clip((points[:, 2] - low) / (high - low), 0, 1)
        colours = HEIGHT_COLOURS[(share * 255).astype(np.int64)]
    else:
        colours, entries = _object_colours(owners, scene, theme)
    axes = page.show(shot, _paint(shot, points, colours, theme))
    page.sensors(axes, shot, sensors - shot.stage.origin)
    if owners is not None:
        page.legend(entries, len(sensors) > 0)
    elif len(points):
        height = float(shot.stage.origin[2])
        world = Normalize(low + height, high + height)
        page.colour_bar(HEIGHT_COLOURS, world, "height z (m)")
    if not len(points):
        page.note(axes, "no points")
    page.title(
        "Point cloud",
        facts((given if count is None else count, "point"), (len(sensors), "sensor position")),
    )
    return page.save(path)


def _paint(shot: Shot, points: Floats, colours: Floats, theme: Theme) -> Floats:
    """Paint the scene pale and the points (n, 3) that lie on what it shows."""
    faces = 0 if shot.scene is None else len(shot.scene.faces)
    image = shot.paint(np.tile(theme.rgb["clay"], (faces, 1)), theme, 0.55)
    if shot.scene is not None:
        seen = on_shown_surfaces(shot, points)
        points, colours = points[seen], colours[seen]
    scale = shot.camera.size[0] / 1600
    radius = float(np.clip(160 / np.sqrt(max(len(points), 1)), 0.75, 2.6)) * scale
    return splat(image, shot.camera, points, colours, max(radius, 0.5), theme.rgb["ink"])


def on_shown_surfaces(shot: Shot, points: Floats) -> NDArray[np.bool_]:
    """Whether points (n, 3) lie on the surface that the shot shows in their pixel.

    Points behind it are hidden; those far before it lie on a wall that was taken away.
    Range noise up to one per cent of the scene's size is let pass.
    """
    pixels, distance = shot.camera.project(points)
    width, height = shot.camera.size
    inside, column, row = shot.camera.cells(pixels)
    slack = 0.01 * shot.stage.size + 2 * shot.camera.footprint(distance)
    # A point at a silhouette may fall into the pixel beside the one that shows its surface.
    near = np.zeros(len(points), dtype=np.bool_)
    for dy, dx in ((0, 0), (0, 1), (0, -1), (1, 0), (-1, 0)):
        beside = shot.depth[np.clip(row + dy, 0, height - 1), np.clip(column + dx, 0, width - 1)]
        near |= np.abs(distance - beside) <= slack
    return np.asarray(inside & near)


def _thinned(positions: ArrayLike, objects: ArrayLike | None) -> tuple[Floats, Ints | None, int]:
    """Finite points to draw, their objects, and how many points there were."""
    points = np.asarray(positions, dtype=np.float64)
    if not points.size:
        points = np.empty((0, 3))
    if points.ndim != 2 or points.shape[1] != 3:
        raise LidarpoolError(f"Points to draw have shape {points.shape}; expected (n, 3).")
    owners = None if objects is None else np.asarray(objects)
    if owners is not None and (owners.shape != points.shape[:1] or owners.dtype.kind not in "iu"):
        raise LidarpoolError(
            f"objects has shape {owners.shape} and type {owners.dtype}; expected one whole "
            f"number for each of the {len(points)} points."
        )
    keep = np.flatnonzero(np.isfinite(points).all(axis=1))
    keep = keep[one_of_each_part(len(keep), MOST_POINTS)]
    return points[keep], None if owners is None else owners[keep].astype(np.int64), len(points)


def _heights(points: Floats, shot: Shot) -> tuple[float, float]:
    """Lowest and highest of the points (n, 3), strays left out, and some way apart."""
    if not len(points):
        return 0.0, 1.0
    low, high = (float(z) for z in np.percentile(points[:, 2], [0.5, 99.5]))
    least = 1e-3 * shot.stage.size
    return (low, high) if high - low > least else (low - least, high + least)


def _object_colours(
    owners: Ints, scene: Scene | None, theme: Theme
) -> tuple[Floats, list[tuple[str, object]]]:
    """Colours (n, 3) of points by their object, and the legend of the objects that have some."""
    shown = np.unique(owners)
    count = len(scene.names) if scene else int(shown.max(initial=0)) + 1
    if len(shown) and (shown[0] < 0 or shown[-1] >= count):
        raise LidarpoolError(
            f"Points belong to objects {shown[0]} to {shown[-1]}; there are {count}, from 0 up."
        )
    names = without_common_prefix(scene.names) if scene else [f"Object {k}" for k in range(count)]
    palette = scene_colours(scene, theme) if scene else object_colours(count)
    if scene:
        palette[surrounding(scene)] = theme.rgb["muted"]  # their own grey is that of the clay
    return palette[owners], [(names[k], palette[k]) for k in shown]

"""The picture of a scene: each object in its own colour."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..scene.scene import Scene
from .captions import facts, without_common_prefix
from .page import Page
from .shot import SIZE, Shot, finite_points, take_shot
from .theme import Theme, object_colours, theme_for

Floats = NDArray[np.float64]

# An object that covers this much of the ground, and has the scene in it, is a floor or a hall.
SURROUNDING = 0.6


def draw_scene(
    path: str | os.PathLike[str],
    scene: Scene,
    poses: ArrayLike = (),
    *,
    shot: Shot | None = None,
    size: tuple[int, int] = SIZE,
    dark: bool = False,
    backend: str = "auto",
) -> Path:
    """Draw a scene, each object in its own colour, and the sensors.

    Parameters
    ----------
    path
        The file to write, .png or .pdf.
    scene
        What to draw.
    poses
        (p, 3) sensor positions, world coordinates.
    shot
        From `take_shot` of the same scene, where several pictures share it.
    size
        Width and height in pixels.
    dark
        A dark page.
    backend
        Ray caster, see `raybeam.RayCaster`.

    Raises
    ------
    LidarpoolError
        If the file cannot be written.
    """
    sensors = finite_points(poses)
    shot = shot or take_shot(scene, sensors, size=size, backend=backend)
    theme = theme_for(dark)
    colours = scene_colours(scene, theme)
    page = Page(size, theme)
    axes = page.show(shot, shot.paint(colours[scene.face_object], theme))
    page.sensors(axes, shot, sensors - scene.origin)
    shown = np.unique(scene.face_object)
    names = without_common_prefix(scene.names)
    page.legend([(names[k], colours[k]) for k in shown], sensors=len(sensors) > 0)
    page.title("Scene", facts((len(shown), "object"), (len(scene.faces), "triangle")))
    return page.save(path)


def scene_colours(scene: Scene, theme: Theme) -> Floats:
    """Colours of a scene's objects, (objects, 3) in 0 to 1.

    Floors and halls are grey, so that what stands in them is what one sees.
    """
    grey = surrounding(scene)
    colours = np.empty((len(scene.names), 3))
    colours[~grey] = object_colours(int((~grey).sum()))
    steps = np.linspace(0, 0.22, max(int(grey.sum()), 1))[: int(grey.sum()), None]
    colours[grey] = theme.rgb["clay"] * (1 - steps) + theme.rgb["muted"] * steps
    return colours


def surrounding(scene: Scene) -> NDArray[np.bool_]:
    """Whether each object is a floor or a hall that the others stand in: (objects,)."""
    width = scene.object_bounds[:, 1] - scene.object_bounds[:, 0]
    whole = np.maximum(scene.bounds[1] - scene.bounds[0], 1e-9)
    share = np.where(np.isfinite(width), width, 0.0)[:, :2].prod(axis=1) / whole[:2].prod()
    return np.asarray((share >= SURROUNDING) & (len(scene.names) > 1))

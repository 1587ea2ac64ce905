"""The four pictures of a result, each by name."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..render.cloud_picture import draw_cloud
from ..render.intensity_picture import draw_intensity
from ..render.scene_picture import draw_scene
from ..render.shot import SIZE, Shot, take_shot
from ..run.picture_file import PICTURES, Pictured
from .path_picture import draw_path

Points = tuple[NDArray[np.floating], int]  # positions to draw, (n, 3), and how many there are


def picture_makers(
    shown: Pictured,
    points: Callable[[], Points],
    names: Iterable[str] = PICTURES,
    *,
    size: tuple[int, int] = SIZE,
    dark: bool = False,
) -> dict[str, Callable[[Path], Path]]:
    """Functions that draw pictures to a file, which all see the scene from the same place.

    Parameters
    ----------
    shown
        What to draw.
    points
        Gives points of the cloud, world coordinates, and how many the whole cloud has; called
        when they are drawn.
    names
        Of PICTURES. There is no path where none was planned.
    size
        Width and height in pixels.
    dark
        Whether the pages are dark.
    """
    scene, poses = shown.scene, shown.poses

    @cache
    def shot() -> Shot:
        return take_shot(scene, poses, size=size)

    def cloud(path: Path) -> Path:
        positions, count = points()
        return draw_cloud(
            path, positions, poses, count=count, scene=scene, shot=shot(), size=size, dark=dark
        )

    makers: dict[str, Callable[[Path], Path]] = {
        "scene": lambda path: draw_scene(path, scene, poses, shot=shot(), size=size, dark=dark),
        "intensity": lambda path: draw_intensity(
            path,
            scene,
            shown.hit_counts,
            poses,
            shown.sample_rays + scene.origin,
            shot=shot(),
            size=size,
            dark=dark,
        ),
        "cloud": cloud,
    }
    planning, plan = shown.planning, shown.plan
    if planning is not None and plan is not None:
        makers["path"] = lambda path: draw_path(
            path, planning, plan, shown.trials, origin=scene.origin[:2], size=size, dark=dark
        )
    return {name: makers[name] for name in names if name in makers}

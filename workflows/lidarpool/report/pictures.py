"""The pictures of a result, each by name."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np

from ..base.errors import LidarpoolError
from ..base.words import did_you_mean
from ..columns.table import Z
from ..export.cloud_file import CloudFile
from ..render.pictures import MOST_POINTS, draw_cloud, draw_intensity, draw_scene
from ..render.shot import SIZE, Shot, take_shot
from ..run.picture_file import Pictured
from .path_picture import draw_path


def picture_makers(
    shown: Pictured, cloud: Path, size: tuple[int, int] = SIZE, colour: str = Z.name
) -> dict[str, Callable[[Path], object]]:
    """Functions that draw pictures to a file, which all see the scene from the same place.

    There is no path where none was planned.

    Parameters
    ----------
    shown
        What to draw.
    cloud
        File of the cloud, read when it is drawn.
    size
        Width and height in pixels.
    colour
        Column that the cloud is coloured by.
    """

    @cache
    def shot() -> Shot:
        middle, scene = shown.duration_ns / 2, shown.scene
        moving = [way for way in shown.sensors if way.moves]
        # Of sensors that move a marker is where they are halfway, and a line the rest.
        places = [w.at(middle)[None] if w.moves else w.positions for w in shown.sensors]
        return take_shot(
            scene.solid(middle),
            np.concatenate([np.empty((0, 3)), *places]) + scene.origin,
            paths=[way.positions for way in moving],
            actors=len(scene.actors),
            when=shown.when,
            size=size,
        )

    def draw_points(path: Path) -> None:
        file = CloudFile(cloud, shown.own)
        columns = {name: c for c in (Z, *file.table) for name in (c.name, c.in_files)}
        if colour not in columns:
            there = list(dict.fromkeys(c.name for c in columns.values()))
            raise LidarpoolError(
                f"{cloud} has no column {colour!r}."
                + (did_you_mean(colour, columns) or f" There are {', '.join(there)}.")
            )
        column = columns[colour]
        draw_cloud(path, shot(), *file.choose(MOST_POINTS), column, shown.names_of(column))

    makers: dict[str, Callable[[Path], object]] = {
        "scene": lambda path: draw_scene(path, shot()),
        "intensity": lambda path: draw_intensity(path, shot(), shown.hit_counts, shown.sample_rays),
        "cloud": draw_points,
    }
    planning, plan = shown.planning, shown.plan
    if planning is not None and plan is not None:
        makers["path"] = lambda path: draw_path(
            path, planning, plan, shown.trials, shown.scene.origin[:2], size
        )
    return makers

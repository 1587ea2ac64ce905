"""The pictures of a result, each by name."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from functools import cache
from pathlib import Path

import numpy as np

from ..base.errors import LidarpoolError, explained
from ..base.vocabulary import PICTURES
from ..base.words import did_you_mean
from ..columns.cloud import Cloud
from ..columns.cloud_file import CloudFile
from ..columns.table import TABLE, Z
from ..render.colouring import with_rgb
from ..render.page import Page
from ..render.pictures import MOST_POINTS, draw_cloud, draw_hits, draw_scene
from ..render.shot import SIZE, Shot, take_shot
from ..run.picture_file import Pictured, ways_of
from .path_picture import draw_path

SIDE_LEAST, SIDE_MOST = 480, 4096  # letters need some pixels; a pixel takes 0.4 kB of memory
_LIGHT = ("reflectivity", "intensity")  # columns for the picture of intensity, the better first
SIDES_RATIO = 2  # longer side to shorter, at most, or legends do not fit


def check_size(size: tuple[int, int]) -> None:
    """Check the size of a picture in pixels; LidarpoolError gives the limits."""
    least, most = min(size), max(size)
    if least < SIDE_LEAST or most > SIDE_MOST or most > SIDES_RATIO * least:
        raise LidarpoolError(
            f"A picture cannot be {size[0]} x {size[1]} pixels: give width and height of "
            f"{SIDE_LEAST} to {SIDE_MOST} each, one at most twice the other, such as 1600 x 1000."
        )


def draw_pictures(
    shown: Pictured,
    cloud: Path,
    folder: str | Path,
    only: Sequence[str] = (),
    size: tuple[int, int] = SIZE,
    colour: str = Z.name,
) -> Iterator[Path]:
    """Draw pictures, those in `only`, into a folder, which is made; see `picture_makers`."""
    check_size(size)
    columns = [column.name for column in CloudFile(cloud).table] if cloud.exists() else []
    makers = picture_makers(shown, cloud, columns, size, colour)
    for name in only:
        if name not in PICTURES:
            there = did_you_mean(name, PICTURES) or f" There are {', '.join(PICTURES)}."
            raise LidarpoolError(f"There is no picture {name!r}.{there}")
        if name not in makers:
            why = "its run planned no path"
            if name != "path":
                why = "points are in the axes of their sensors"
                if shown.coordinates != "sensor":
                    why = f"the cloud has no column {' or '.join(_LIGHT)}"
            raise LidarpoolError(f"There is no picture {name!r}: {why}.")
    with explained(f"The folder {folder} cannot be made", "give another"):
        Path(folder).mkdir(parents=True, exist_ok=True)
    for name in only or makers:
        path = Path(folder) / f"{name}.png"
        makers[name]().save(path)
        yield path


def picture_makers(
    shown: Pictured,
    cloud: Path,
    columns: Collection[str],
    size: tuple[int, int] = SIZE,
    colour: str = Z.name,
) -> dict[str, Callable[[], Page]]:
    """Return functions that draw pictures, all from the same viewpoint.

    Without planning there is no picture of the path; and none of points in the axes of their
    sensors, which do not fit the scene. The file `cloud` is read when it is drawn, and coloured by
    the column `colour`; its `columns` tell whether there is a picture of intensity.
    """
    alone = shown.coordinates == "sensor"
    middle = shown.duration_ns / 2

    @cache
    def shot() -> Shot:
        # A moving sensor has a marker at half time, and a line for its trajectory.
        places = [w.at(middle)[None] if w.moves else w.positions for w in shown.sensors]
        scene = shown.scene
        return take_shot(
            scene.solid(middle),
            np.concatenate([np.empty((0, 3)), *places]) + scene.origin,
            paths=[way.positions for way in shown.sensors if way.moves],
            around=ways_of(shown.sensors, scene.actors, shown.duration_ns),
            actors=len(scene.actors),
            when=shown.when,
            models=shown.models,
            size=size,
        )

    @cache
    def points() -> Cloud:
        return CloudFile(cloud, shown.own).choose(MOST_POINTS)

    def draw_counts() -> Page:
        places = np.empty((0, 3)) if alone else points().positions - shown.scene.origin
        return draw_hits(shot(), shown.hit_counts, places, shown.sample_rays)

    def draw_points() -> Page:
        file = CloudFile(cloud, shown.own)
        known = with_rgb({name: c for c in (Z, *file.table) for name in (c.name, c.in_files)})
        if colour not in known:
            there = list(dict.fromkeys(c.name for c in known.values()))
            raise LidarpoolError(
                f"{cloud} has no column {colour!r}."
                + (did_you_mean(colour, known) or f" There are {', '.join(there)}.")
            )
        column = known[colour]
        return draw_cloud(shot(), points(), len(file), column, shown.names_of(column))

    makers: dict[str, Callable[[], Page]] = {
        "scene": lambda: draw_scene(shot(), shown.triangles),
        "hits": draw_counts,
    }
    if not alone:
        light = next((TABLE[name] for name in _LIGHT if name in columns), None)
        if light is not None:
            makers["intensity"] = lambda: draw_cloud(
                shot(), points(), len(CloudFile(cloud)), light, solid=True
            )
        makers["cloud"] = draw_points
    planning, plan = shown.planning, shown.plan
    if planning is not None and plan is not None:
        makers["path"] = lambda: draw_path(
            planning, plan, shown.trials, shown.scene.origin[:2], size
        )
    return makers

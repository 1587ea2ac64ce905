"""Views of results: opened, joined, and served until an interrupt."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from threading import Event

import click
import numpy as np

from lidarsim.base.errors import LidarError, MissingFileError
from lidarsim.base.notebook import cell_display
from lidarsim.base.words import plural
from lidarsim.columns.cloud_file import CloudFile
from lidarsim.sweeps.sweeps import SWEEPS_FILE, Sweeps

from ..picture_file import (
    PICTURE_FILE,
    PictureContent,
)
from .point_selection import (
    JoinedPoints,
)
from .server import PORT, PageServer, announced, page_server
from .view import CLOUD, IN_SENSOR_AXES, Downloads, GrowingView, View


@contextmanager
def result_page(
    view: View | GrowingView, *, port: int = PORT, browser: bool = True
) -> Iterator[PageServer]:
    """Serve the page of a result while the body runs, and announce its address."""
    count = view.total if isinstance(view, GrowingView) else len(view.points)
    shows = f"shows {plural(count, 'point')}"
    shows += "" if cell_display() else ". Press Ctrl-C to stop."
    with (
        page_server(view.answer, port) as page,
        announced(page, f"{page.url} {shows}", browser, on_stdout=True),
    ):
        yield page


def wait_for_interrupt(stopped: Event | None = None) -> None:
    """Keep a page open until Ctrl-C, or until its user stops the page."""
    stopped = stopped or Event()
    with suppress(KeyboardInterrupt):
        while not stopped.wait(0.2):  # Ctrl-C does not end an unlimited wait everywhere
            pass


def show_view(view: View | GrowingView, *, port: int, browser: bool = True) -> None:
    """Show a view in the browser until Ctrl-C."""
    if view.note:
        click.echo(f"note: {view.note}", err=True)
    with result_page(view, port=port, browser=browser):
        wait_for_interrupt()


def open_results(paths: Sequence[Path], downloads: Downloads | None = None) -> View:
    """Open results of surveys of the same scene as a view of all their points.

    The scene, sensors and actors come from the first result.

    The view can be played if the sweeps of all results start at the same times. LidarError if a
    result has no cloud, a damaged cloud, or points in the frames of the sensors.
    """
    return join_views(paths, [open_result(path, downloads) for path in paths], downloads)


def join_views(
    paths: Sequence[Path], views: Sequence[View], downloads: Downloads | None = None
) -> View:
    """Return a view of all points of the views of results (`open_results`)."""
    first, *other_views = views
    if not other_views:
        return first
    notes = [view.note for view in views]
    in_sensor_axes = [
        path for path, note in zip(paths, notes, strict=True) if IN_SENSOR_AXES in note
    ]
    if in_sensor_axes:
        raise LidarError(
            f"{in_sensor_axes[0]} contains points in sensor coordinates, which cannot be combined "
            "with other results. View it alone, or run it again with `cloud.coordinates: world`."
        )
    names = [path.resolve().name for path in paths]
    names = names if len({*names}) == len(names) else [str(path) for path in paths]
    starts = [() if view.sweeps is None else view.sweeps.begins_ns for view in views]
    sweeps = first.sweeps if all(np.array_equal(starts[0], times) for times in starts) else None
    points = JoinedPoints([view.points for view in views])
    codes = {view.epsg for view in views}
    title = f"{' and '.join(names)} - lidarpool"
    return View(
        points,
        first.pictured,
        sweeps,
        " ".join(notes).strip(),
        title,
        results=names,
        downloads=downloads,
        stated_epsg=codes.pop() if len(codes) == 1 else None,
    )


def open_result(path: Path, downloads: Downloads | None = None) -> View:
    """Open a cloud or the folder of a result, with its scene and sweeps if they are in the folder.

    A scene or sweeps that cannot be read are noted only. LidarError for a missing or damaged cloud.
    """
    if not path.exists():
        raise MissingFileError(
            f"{path} does not exist. Pass a result folder or a point cloud file."
        )
    title = f"{path.resolve().name} - lidarpool"
    if not path.is_dir():
        return View(CloudFile(path), title=title, downloads=downloads)
    cloud = path / CLOUD
    if not cloud.exists():
        raise LidarError(
            f"{path} does not contain {CLOUD}. Pass a result folder (the `--out` folder of a run) "
            "or a point cloud file."
        )
    scene_file = path / PICTURE_FILE
    sweeps_file = path / SWEEPS_FILE
    pictured = None
    sweeps = None
    note = ""
    try:
        sweeps = Sweeps.load(sweeps_file) if sweeps_file.exists() else None
        pictured = PictureContent.load(scene_file) if scene_file.exists() else None
    except LidarError as error:
        note = f"Some parts of the result are not shown. {error}"
    file = CloudFile(cloud, pictured.extra_columns if pictured else ())
    return View(file, pictured, sweeps, note, title, downloads=downloads)

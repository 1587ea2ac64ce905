"""Open results, combine them into a view, and serve the view until an interrupt."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from threading import Event

import click
import numpy as np

from lidarfiles.picture_file import PICTURE_FILE, PictureContent
from lidarsim.columns.cloud_file import CloudFile
from lidarsim.environment.notebook import cell_display
from lidarsim.errors import LidarError, MissingFileError
from lidarsim.sweeps.sweeps import SWEEPS_FILE, Sweeps
from lidarsim.words import plural

from .point_selection import JoinedPoints
from .server import PORT, PageServer, announce_page, page_server
from .view import CLOUD, IN_SENSOR_AXES, DownloadFormats, ProgressiveView, View


@contextmanager
def result_page(
    view: View | ProgressiveView, *, port: int = PORT, browser: bool = True
) -> Iterator[PageServer]:
    """Serve a view while the context is active, and announce its address."""
    count = view.total if isinstance(view, ProgressiveView) else len(view.points)
    shows = f"shows {plural(count, 'point')}"
    shows += "" if cell_display() else ". Press Ctrl-C to stop."
    with (
        page_server(view.answer, port) as page,
        announce_page(page, f"{page.url} {shows}", browser, on_stdout=True),
    ):
        yield page


def wait_for_interrupt(stopped: Event | None = None) -> None:
    """Wait until the user presses Ctrl-C or until `stopped` is set."""
    stopped = stopped or Event()
    with suppress(KeyboardInterrupt):
        # On some platforms, Ctrl-C does not interrupt a wait without a timeout.
        while not stopped.wait(0.2):
            pass


def show_view(view: View | ProgressiveView, *, port: int, browser: bool = True) -> None:
    """Serve a view until the user presses Ctrl-C."""
    if view.note:
        click.echo(f"note: {view.note}", err=True)
    with result_page(view, port=port, browser=browser):
        wait_for_interrupt()


def open_results(paths: Sequence[Path], downloads: DownloadFormats | None = None) -> View:
    """Open the results of several surveys of the same scene as a single view.

    The scene, the sensors, and the actors come from the first result. The view can be played over
    time if the sweeps of all results start at the same times.

    Raises
    ------
    LidarError
        If a result has no cloud, its cloud is damaged, or, with several results, its points are in
        sensor coordinates.
    """
    return join_views(paths, [open_result(path, downloads) for path in paths], downloads)


def join_views(
    paths: Sequence[Path], views: Sequence[View], downloads: DownloadFormats | None = None
) -> View:
    """Combine the views of several results for `open_results`.

    `paths` are the results of the views. Messages and labels use their names.
    """
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
        labeled_objects=() if sweeps is None else first.labeled_objects,
    )


def open_result(path: Path, downloads: DownloadFormats | None = None) -> View:
    """Open a point cloud file, or a result folder with its scene and sweeps.

    If the scene or the sweeps of a folder cannot be read, the view gets a note and omits them.

    Raises
    ------
    LidarError
        If the cloud is missing or damaged.
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

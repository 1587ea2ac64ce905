"""The page of a result: the command `view`."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from threading import Event

import click

from ..base.errors import LidarpoolError
from ..base.notebook import cell_display
from ..base.words import counted
from ..columns.cloud_file import CloudFile
from ..export.sweeps import SWEEPS_FILE, Sweeps
from ..pipeline.database import FILE
from ..run.picture_file import PICTURE_FILE, Pictured
from ..run.store import RUN_FOLDER
from .server import PORT, PageServer, announced, page_server
from .view import View

CLOUD = "cloud.ply"


@contextmanager
def result_page(view: View, *, port: int = PORT, browser: bool = True) -> Iterator[PageServer]:
    """Serve the page of a result while the body runs; see `announced`."""
    count = counted(len(view.points), "point")
    with page_server(view.answer, port) as page:
        ends = "" if cell_display() else "; Ctrl-C ends it"
        with announced(page, f"{page.url} shows {count}{ends}", browser):
            yield page


def wait_for_interrupt(stopped: Event | None = None) -> None:
    """Keep a page open until Ctrl-C, or until its user has stopped it."""
    stopped = stopped or Event()
    with suppress(KeyboardInterrupt):
        while not stopped.wait(0.2):  # one without limit is not left on Ctrl-C everywhere
            pass


def view_result(path: Path, *, port: int, browser: bool = True) -> None:
    """Show a folder of a result, or a cloud, until Ctrl-C; see `result_page`."""
    view = open_result(path)
    if view.note:
        click.echo(f"note: {view.note}", err=True)
    with result_page(view, port=port, browser=browser):
        wait_for_interrupt()


def open_result(path: Path) -> View:
    """Open a cloud or the folder of a result; with its scene and sweeps if there are any.

    That these cannot be read is only noted. LidarpoolError if there is no cloud, or a damaged one.
    """
    title = f"{path.resolve().name} - lidarpool"
    if not path.is_dir():
        return View(CloudFile(path), title=title)
    cloud, scene, beside = path / CLOUD, path / PICTURE_FILE, path / SWEEPS_FILE
    if not cloud.exists() and (path / RUN_FOLDER / FILE).exists():
        raise LidarpoolError(
            f"{path} holds an unfinished run: continue it with lidarpool run --resume, where "
            "--live shows its points."
        )
    if not cloud.exists():
        raise LidarpoolError(
            f"{path} holds no {CLOUD}: give the folder of a result (its --out), or a cloud."
        )
    pictured, sweeps, note = None, None, ""
    try:
        sweeps = Sweeps.load(beside) if beside.exists() else None
        pictured = Pictured.load(scene) if scene.exists() else None
    except LidarpoolError as error:
        note = f"The cloud is shown without all that belongs to it. {error}"
    file = CloudFile(cloud, pictured.own if pictured else ())
    return View(file, pictured, sweeps, note, title)

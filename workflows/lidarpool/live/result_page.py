"""The live page of a result: the command `view`."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import click
import numpy as np
from numpy.typing import NDArray

from ..base.errors import LidarpoolError
from ..base.notebook import cell_display
from ..columns.cloud import Cloud
from ..export.cloud_file import CloudFile
from ..pipeline.database import FILE
from ..run.picture_file import PICTURE_FILE, Pictured
from ..run.store import RUN_FOLDER
from .blocks import VIEW_POINTS, Blocks
from .colouring import boxed
from .page import PORT, LivePage, announced, live_page, redrawn
from .view import View

CLOUD = "cloud.ply"
DRAW_EVERY_S, BUSY_SHARE = 0.1, 0.7  # of a core: there is no other work


class ResultView:
    """A result on a page: its points, what else is pictured of it if that is known, and a note.

    `most` points are shown at a time.
    """

    def __init__(
        self,
        page: LivePage,
        file: CloudFile,
        pictured: Pictured | None = None,
        note: str = "",
        most: int = VIEW_POINTS,
    ) -> None:
        self._file, self._pictured, self._note, self._most = file, pictured, note, most
        self._facts = page.gui.add_html("")
        self._view = View(page, file.table, pictured, None if pictured else _around(file))
        self._view.cloud.blocks = Blocks(file, self._view.origin, most)
        self._even: Cloud | None = None

    def draw(self) -> float:
        """Draw what has changed; returns the share of a core that this may take."""
        if self._even is None:
            self._facts.content = self._told()
            self._even = self._file.choose(self._most)[0]
        if (pictured := self._pictured) is None:
            self._view.draw(self._even, 0)
        else:
            counts = pictured.hit_counts[: len(pictured.scene.faces)]
            path = None if pictured.plan is None else pictured.plan.path
            self._view.draw(self._even, 0, lambda: counts, 0, pictured.sample_rays, 0, path)
        self._facts.content = self._told()
        return BUSY_SHARE

    def _told(self) -> str:
        lines = self._view.cloud.facts
        if self._view.origin.any():
            away = ", ".join(f"{metres:.0f}" for metres in self._view.origin)
            lines.append(f"relative to {away} m")
        lines += [self._pictured.models] if self._pictured is not None else []
        lines += [self._note] if self._note else []
        return boxed(lines)


def _around(file: CloudFile) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Origin in whole metres near the points of a file, (3,), and their box (2, 3) from it."""
    positions = file.choose(100_000)[0].positions
    if not len(positions):
        return np.zeros(3), np.array([[-1.0, -1.0, 0.0], [1.0, 1.0, 1.0]])
    # Without a few outliers.
    box = np.percentile(positions, [0.5, 99.5], axis=0)
    origin = np.where(np.abs(box[0]) > 10_000, np.round(box[0]), 0.0)
    return origin, box - origin


@contextmanager
def result_page(
    file: CloudFile,
    pictured: Pictured | None = None,
    note: str = "",
    *,
    title: str = "lidarpool",
    port: int = PORT,
    browser: bool = True,
) -> Iterator[None]:
    """Serve the page of a result while the body runs; see `live_page` and `announced`."""
    with live_page(title, port) as page:
        view = ResultView(page, file, pictured, note)
        ends = "" if cell_display() else "; Ctrl-C ends it"
        with (
            announced(page, f"{page.url} shows {len(file):,} points{ends}", browser),
            redrawn(view.draw, DRAW_EVERY_S),
        ):
            yield


def wait_for_interrupt() -> None:
    """Keep a page open until Ctrl-C."""
    with suppress(KeyboardInterrupt):
        while True:
            time.sleep(1.0)


def view_result(path: Path, *, port: int, browser: bool = True) -> None:
    """Show a folder of a result, or a cloud, until Ctrl-C; see `result_page`."""
    file, pictured, note = open_result(path)
    if note:
        click.echo(f"note: {note}", err=True)
    title = f"lidarpool: {path.resolve().name}"
    with result_page(file, pictured, note, title=title, port=port, browser=browser):
        wait_for_interrupt()


def open_result(path: Path) -> tuple[CloudFile, Pictured | None, str]:
    """Open a cloud or the folder of a result; with the scene if there is one, and a note.

    That the scene cannot be read is only noted, because the cloud is complete.

    Raises
    ------
    LidarpoolError
        If there is no cloud, or it is damaged.
    """
    cloud, scene = path / CLOUD, path / PICTURE_FILE
    if not path.is_dir():
        return CloudFile(path), None, ""
    if not cloud.exists() and (path / RUN_FOLDER / FILE).exists():
        raise LidarpoolError(
            f"{path} holds an unfinished run: continue it with lidarpool run --resume, where "
            "--live shows its points."
        )
    if not cloud.exists():
        raise LidarpoolError(
            f"{path} holds no {CLOUD}: give the folder of a result (its --out), or a cloud."
        )
    pictured, note = None, ""
    try:
        pictured = Pictured.load(scene) if scene.exists() else None
    except LidarpoolError as error:
        note = f"The cloud is shown without the scene. {error}"
    return CloudFile(cloud, pictured.own if pictured else ()), pictured, note

"""The command `view`: a finished result in the browser."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click
import numpy as np

from .cloud_layer import CloudLayer
from .colouring import QUANTITIES
from .page import LivePage, grid_step, live_page, open_browser
from .painter import Painter
from .result_file import ResultFile
from .route import add_route

VIEW_POINTS = 500_000  # in the browser at a time
DRAW_EVERY_S = 0.1


class ResultView:
    """A result on a page.

    Parameters
    ----------
    page
        Where it is shown.
    file
        The result.
    most
        Points that are shown at a time.
    """

    def __init__(self, page: LivePage, file: ResultFile, most: int = VIEW_POINTS) -> None:
        self._file, self._most = file, most
        self.painter = Painter(self._draw, DRAW_EVERY_S)
        whole, _ = file.choose(*file.scans, 100_000)
        bounds = _bounds(whole["position"])
        size = float(np.linalg.norm(bounds[1] - bounds[0])) or 1.0
        page.frame_scene(bounds)
        self._facts = page.gui.add_html("")
        self._scans = self._add_slider(page)
        known = [q for q in QUANTITIES if q != "range" or file.has_ranges]
        self._layer = CloudLayer(page, file.names, known, size, self.painter.ask)
        if len(file.route):
            add_route(page, file.route - file.origin[:2], float(bounds[0, 2]), size)
        page.add_page_controls(grid_step(size))
        self.painter.ask()

    def _add_slider(self, page: LivePage) -> Any:
        first, last = self._file.scans
        if first >= last or not self._file.in_order:
            return None
        slider = page.gui.add_multi_slider("scans", first, last, 1, (first, last))
        slider.on_update(self.painter.ask)
        return slider

    def _draw(self) -> None:
        first, last = self._scans.value if self._scans else self._file.scans
        rows, count = self._file.choose(first, last, self._most)
        self._layer.draw(rows)
        shown = "all shown" if len(rows) == count else f"{len(rows):,} shown"
        away = self._file.origin
        moved = f"<br>relative to {away[0]:.0f}, {away[1]:.0f}, {away[2]:.0f}" if away.any() else ""
        self._facts.content = (
            '<div style="padding:0 0.8em">'
            f"{count:,} of {len(self._file):,} points, {shown}{moved}</div>"
        )


def view_result(path: Path, *, port: int, browser: bool = True) -> None:
    """Show a result until Ctrl-C.

    Parameters
    ----------
    path
        Folder of a result, or a cloud.
    port
        Port to listen on, or the next that is free.
    browser
        Whether to open a browser where there is a desktop.

    Raises
    ------
    LidarpoolError
        If there is no cloud, or it is damaged.
    """
    file = ResultFile(path)
    with live_page(f"lidarpool: {file.path.parent.name or file.path.name}", port) as page:
        view = ResultView(page, file)
        click.echo(f"{page.url} shows {len(file):,} points; Ctrl-C ends it", err=True)
        if browser:
            open_browser(page.url)
        try:
            view.painter.run()
        except KeyboardInterrupt:
            return


def _bounds(positions: np.ndarray) -> np.ndarray:
    """Box (2, 3) that holds nearly all positions (n, 3): few strays do not count."""
    if not len(positions):
        return np.array([[-1.0, -1.0, 0.0], [1.0, 1.0, 1.0]])
    return np.percentile(positions, [0.5, 99.5], axis=0).astype(np.float64)

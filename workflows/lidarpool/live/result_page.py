"""The live page of a finished result: the command `view`."""

from __future__ import annotations

from html import escape
from pathlib import Path
from typing import Any

import click
import numpy as np
from numpy.typing import NDArray

from ..run.picture_file import Pictured
from .cloud_layer import CloudLayer
from .display import POSITION
from .height_cut import HeightCut
from .markers import SensorLayer, add_discs, add_route
from .page import LivePage, grid_step, live_page, open_browser
from .painter import Drawing, Painter, Throttle
from .result_file import ResultFile
from .run_scene import scene_bounds
from .scene_layer import SceneLayer

VIEW_POINTS = 500_000  # in the browser at a time
DRAW_EVERY_S, BUSY_SHARE = 0.1, 0.7  # nothing else is to be done


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
        self._page, self._file, self._most = page, file, most
        self.painter = Painter(self._draw, DRAW_EVERY_S, BUSY_SHARE)
        self._throttle = Throttle()
        bounds = _bounds(file)
        self._level = float(bounds[0, 2])
        self._size_m = float(np.linalg.norm(bounds[1] - bounds[0])) or 1.0
        page.frame_scene(bounds)
        self._facts = page.gui.add_html("")
        self._scans = self._add_slider(page)
        ask = self.painter.ask
        self._cut = HeightCut(page, bounds, float(file.origin[2]), ask)
        self._cloud = CloudLayer(page, file.quantities, {"object": file.names}, self._size_m, ask)
        self._scene: SceneLayer | None = None
        self._sensor: SensorLayer | None = None
        if file.pictured is not None:
            self._add_pictured(file.pictured)
        if len(file.route):
            add_route(page, file.route - file.origin[:2], self._level, self._size_m)
        page.add_page_controls(grid_step(self._size_m))
        ask()

    def _add_slider(self, page: LivePage) -> Any:
        first, last = self._file.scans
        if first >= last or not self._file.in_order:
            return None
        slider = page.gui.add_multi_slider("scans", first, last, 1, (first, last))
        slider.on_update(self.painter.ask)
        return slider

    def _add_pictured(self, pictured: Pictured) -> None:
        poses = pictured.poses - pictured.scene.origin
        self._scene = SceneLayer(self._page, pictured.scene, poses, self._cut, self.painter.ask)
        self._sensor = SensorLayer(self._page, self._size_m)
        self._sensor.draw_poses(poses)
        if (planning := pictured.planning) is not None:
            add_discs(self._page, planning.centres, planning.radii, self._level, self._size_m)

    def _draw(self) -> bool:
        """Draw what has changed; returns whether something was left for later."""
        scans = self._scans.value if self._scans else self._file.scans
        scene, sensor, pictured = self._scene, self._sensor, self._file.pictured
        cut = self._cut.height
        shown = (scans, cut, self._cloud.state, scene.state if scene else None)
        drawings = [Drawing("cloud", shown, 0.0, lambda: self._draw_cloud(*scans))]
        if scene is not None and sensor is not None and pictured is not None:
            rays, hits = pictured.sample_rays, pictured.hit_counts
            drawings += [
                Drawing("sensor", scans[1], 0.0, lambda: self._place(sensor, scans[1])),
                Drawing("rays", cut, 0.0, lambda: sensor.draw_earlier(rays, cut)),
                Drawing("scene", scene.state, 0.0, lambda: scene.draw(hits)),
            ]
        self._throttle.draw(drawings)
        settling = self._cloud.settle(), scene is not None and scene.settle()
        return any(settling)

    def _draw_cloud(self, first: int, last: int) -> None:
        rows, count = self._file.choose(first, last, self._most)
        seen = self._cut.below(rows)
        facing = None if self._scene is None else self._scene.facing(seen[POSITION])
        self._cloud.draw(seen, facing, (first, last, self._cut.height))
        shown = "all shown" if len(rows) == count else f"{len(rows):,} shown"
        lines = [f"{count:,} of {len(self._file):,} points, {shown}"]
        if (away := self._file.origin).any():
            lines.append("relative to " + ", ".join(f"{metres:.0f}" for metres in away) + " m")
        if self._file.note:
            lines.append(escape(self._file.note))
        self._facts.content = f'<div style="padding:0 0.8em">{"<br>".join(lines)}</div>'

    def _place(self, sensor: SensorLayer, scan: int) -> None:
        if (position := self._file.sensor_at(scan)) is not None:
            sensor.place(position)


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
    if file.note:
        click.echo(f"note: {file.note}", err=True)
    with live_page(f"lidarpool: {file.path.parent.name or file.path.name}", port) as page:
        view = ResultView(page, file)
        click.echo(f"{page.url} shows {len(file):,} points; Ctrl-C ends it", err=True)
        if browser:
            open_browser(page.url)
        try:
            view.painter.run()
        except KeyboardInterrupt:
            return


def _bounds(file: ResultFile) -> NDArray[np.float64]:
    """Box (2, 3) of what there is to see, displayed positions."""
    if (pictured := file.pictured) is not None:
        poses = pictured.poses - pictured.scene.origin
        return scene_bounds(pictured.scene, poses, pictured.planning)
    positions = file.choose(*file.scans, 100_000)[0][POSITION]
    if not len(positions):
        return np.array([[-1.0, -1.0, 0.0], [1.0, 1.0, 1.0]])
    # Nearly all positions: few strays do not count.
    return np.percentile(positions, [0.5, 99.5], axis=0).astype(np.float64)

"""What a page shows of a run in space: the scene, the sensor, the growing cloud, the path."""

from __future__ import annotations

import time
from collections.abc import Callable, Hashable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..deliveries import Deliveries
from ..job import Job
from ..plan import best
from ..scan import Frame
from .cloud_layer import CloudLayer
from .colouring import QUANTITIES
from .latest import Latest
from .live_points import LivePoints
from .page import LivePage, grid_step
from .route import add_discs, add_route
from .scene_layer import SceneLayer
from .sensor_layer import SensorLayer

# Seconds from one time that something is drawn to the next, at least; see also `BUSY_SHARE`.
CLOUD_EVERY_S, SCENE_EVERY_S, RAYS_EVERY_S = 1.0, 2.0, 1.0


class RunScene:
    """Draws what has been delivered, each part of it when it has changed and is due.

    Parameters
    ----------
    page
        Where it is shown.
    job
        What the run does.
    on_change
        Called when something else is to be shown.
    """

    def __init__(self, page: LivePage, job: Job, on_change: Callable[[Any], None]) -> None:
        self._page, self._job = page, job
        self.frames: Latest[Frame] = Latest()
        self.points = LivePoints(job.survey)
        self.displayed = 0  # points
        bounds = _bounds(job)
        self._level = float(bounds[0, 2])
        self.size_m = float(np.linalg.norm(bounds[1] - bounds[0]))
        page.frame_scene(bounds)
        self._cloud = CloudLayer(page, job.scene.names, QUANTITIES, self.size_m, on_change)
        self._scene = SceneLayer(page, job.scene)
        self._sensor = SensorLayer(page, self.size_m)
        page.add_page_controls(grid_step(self.size_m))
        self._drawn: dict[str, Hashable] = {}  # {part: what it was like when it was drawn}
        self._due_at: dict[str, float] = {}

    def draw(self, kept: Deliveries, final: bool) -> bool:
        """Draw what is due, or all that has changed; returns whether something is left.

        Parameters
        ----------
        kept
            What has been delivered; another thread adds to it meanwhile.
        """
        if (frame := self.frames.take()) is not None:
            self._sensor.draw(frame)
        totals = kept.totals
        parts: tuple[tuple[str, Hashable, float, Callable[[], None]], ...] = (
            ("cloud", (self.points.seen, self._cloud.quantity), CLOUD_EVERY_S, self._draw_cloud),
            ("scene", (totals.hits,), SCENE_EVERY_S, lambda: self._scene.draw(totals.hit_counts)),
            (
                "rays",
                (totals.frames,),
                RAYS_EVERY_S,
                lambda: self._sensor.draw_earlier(totals.sample_rays),
            ),
            ("path", (self._planned(kept),), 0.0, lambda: self._draw_path(kept)),
        )
        left = False
        for name, state, every_s, draw in parts:
            if self._drawn.get(name) == state:
                continue
            now = time.monotonic()
            if now < self._due_at.get(name, now) and not final:
                left = True
                continue
            draw()
            self._drawn[name] = state
            self._due_at[name] = time.monotonic() + every_s
        return left

    def _draw_cloud(self) -> None:
        rows = self.points.rows
        self.displayed = len(rows)
        self._cloud.draw(rows)

    def _planned(self, kept: Deliveries) -> bool:
        return self._job.trials > 0 and len(kept.trials) == self._job.trials

    def _draw_path(self, kept: Deliveries) -> None:
        planning = self._job.planning
        if planning is None or not self._planned(kept):
            return
        plan = best(kept.trials, planning)
        add_discs(self._page, planning.centres, planning.radii, self._level, self.size_m)
        add_route(self._page, plan.path, self._level, self.size_m)


def _bounds(job: Job) -> NDArray[np.float64]:
    """Box (2, 3) that holds the scene, the sensor and both ends of the path, local."""
    places = [
        job.scene.vertices.min(axis=0),
        job.scene.vertices.max(axis=0),
        *(np.array(pose.position) for pose in job.survey.poses),
    ]
    low, high = np.min(places, axis=0), np.max(places, axis=0)
    if job.planning is not None:
        ends = np.array([job.planning.start, job.planning.target])
        low[:2] = np.minimum(low[:2], ends.min(axis=0))
        high[:2] = np.maximum(high[:2], ends.max(axis=0))
    return np.stack([low, high])

"""What a page shows of a run in space: the scene, the sensor, the growing cloud, the path."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..deliveries import Deliveries
from ..job import Job
from ..plan import Planning, best
from ..scan import Frame
from ..scene import Scene
from .cloud_layer import CloudLayer
from .colouring import QUANTITIES
from .due_parts import DueParts, Part
from .height_cut import HeightCut
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
        poses = np.array([pose.position for pose in job.survey.poses])
        bounds = scene_bounds(job.scene, poses, job.planning)
        self._level = float(bounds[0, 2])
        self.size_m = float(np.linalg.norm(bounds[1] - bounds[0]))
        page.frame_scene(bounds)
        self._parts = DueParts()

        def change(event: Any) -> None:
            self._parts.hurry()
            on_change(event)

        self._cut = HeightCut(page, bounds, float(job.scene.origin[2]), change)
        self._cloud = CloudLayer(page, job.scene.names, QUANTITIES, self.size_m, change)
        self._scene = SceneLayer(page, job.scene, poses, self._cut, change)
        self._sensor = SensorLayer(page, self.size_m)
        page.add_page_controls(grid_step(self.size_m))

    def draw(self, kept: Deliveries, final: bool) -> bool:
        """Draw what is due, or all that has changed; returns whether something is left.

        Parameters
        ----------
        kept
            What has been delivered; another thread adds to it meanwhile.
        """
        cut = self._cut.height
        if (frame := self.frames.take()) is not None:
            self._sensor.place(frame.pose.position)
            self._sensor.draw_latest(frame.pose.position, frame.samples, cut)
        totals = kept.totals
        parts = (
            Part(
                "cloud",
                (self.points.seen, self._cloud.state, self._scene.state),
                CLOUD_EVERY_S,
                self._draw_cloud,
            ),
            Part(
                "scene",
                (totals.hits, self._scene.state),
                SCENE_EVERY_S,
                lambda: self._scene.draw(totals.hit_counts),
            ),
            Part(
                "rays",
                (totals.frames, cut),
                RAYS_EVERY_S,
                lambda: self._sensor.draw_earlier(totals.sample_rays, cut),
            ),
            Part("path", self._planned(kept), 0.0, lambda: self._draw_path(kept)),
        )
        left = self._parts.draw(parts, final)
        settling = self._scene.settle(), self._cloud.settle()
        return left or any(settling)

    def _draw_cloud(self) -> None:
        rows = self._cut.below(self.points.rows)
        self.displayed = len(rows)
        self._cloud.draw(rows, self._scene.facing(rows["position"]))

    def _planned(self, kept: Deliveries) -> bool:
        return self._job.trials > 0 and len(kept.trials) == self._job.trials

    def _draw_path(self, kept: Deliveries) -> None:
        planning = self._job.planning
        if planning is None or not self._planned(kept):
            return
        plan = best(kept.trials, planning)
        add_discs(self._page, planning.centres, planning.radii, self._level, self.size_m)
        add_route(self._page, plan.path, self._level, self.size_m)


def scene_bounds(
    scene: Scene, poses: NDArray[np.float64], planning: Planning | None
) -> NDArray[np.float64]:
    """Box (2, 3) that holds the scene, the sensors at (p, 3) and both ends of the path, local."""
    places = [scene.vertices.min(axis=0), scene.vertices.max(axis=0), *poses]
    low, high = np.min(places, axis=0), np.max(places, axis=0)
    if planning is not None:
        ends = np.array([planning.start, planning.target])
        low[:2] = np.minimum(low[:2], ends.min(axis=0))
        high[:2] = np.maximum(high[:2], ends.max(axis=0))
    return np.stack([low, high])

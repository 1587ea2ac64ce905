"""What a page shows of a run in space: the scene, the sensor, the growing cloud, the path."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..plan import Planning, best
from ..run.job import Job
from ..run.store import SAMPLE_RAYS, RunStore
from ..scan import Frame
from ..scene.scene import Scene
from ..sensor import Survey
from .cloud_layer import CloudLayer
from .display import POSITION
from .height_cut import HeightCut
from .live_points import PARTS_NOTED, LivePoints
from .markers import MOST_POSES, SensorLayer, add_discs, add_route
from .page import LivePage, grid_step
from .painter import Drawing, Throttle
from .scene_layer import SceneLayer

# Seconds from one time that something is drawn to the next, at least; see also `BUSY_SHARE`.
CLOUD_EVERY_S, SCENE_EVERY_S, RAYS_EVERY_S = 1.0, 2.0, 1.0

T = TypeVar("T")


class RunScene:
    """Draws what has been committed, each part of it when it has changed and is due.

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
        self.points = LivePoints(job)
        self.rays = SampleRays()
        self.displayed = 0  # points
        poses = sensor_places(job.survey)
        bounds = scene_bounds(job.scene, poses, job.planning)
        self._level = float(bounds[0, 2])
        self.size_m = float(np.linalg.norm(bounds[1] - bounds[0]))
        page.frame_scene(bounds)
        self._throttle = Throttle()

        def change(event: Any) -> None:
            self._throttle.hurry()
            on_change(event)

        self._cut = HeightCut(page, bounds, float(job.scene.origin[2]), change)
        self._cloud = CloudLayer(
            page, self.points.quantities, {"object": job.scene.names}, self.size_m, change
        )
        self._scene = SceneLayer(page, job.scene, poses, self._cut, change)
        self._sensor = SensorLayer(page, self.size_m)
        page.add_page_controls(grid_step(self.size_m))

    def note(self, frame: Frame) -> None:
        """Note a frame: it is displayed unless another comes at once."""
        self.frames.put(frame)
        self.rays.add(frame)

    def complete(self, store: RunStore) -> None:
        """Read what is still to be read for the last picture, while it is there to be read."""
        self.points.gather(store, PARTS_NOTED)
        if store.db.complete:
            self.rays.replace(store.sample_rays())

    def draw(self, store: RunStore, final: bool) -> bool:
        """Draw what is due, or all that has changed; returns whether something is left.

        Parameters
        ----------
        store
            What has been committed; another thread adds to it meanwhile.
        """
        waiting = self.points.gather(store)
        cut = self._cut.height
        if (frame := self.frames.take()) is not None:
            self._sensor.place(frame.pose.position)
            self._sensor.draw_latest(frame.pose.position, frame.samples, cut)
        drawings = (
            Drawing(
                "cloud",
                (self.points.seen, self._cloud.state, self._scene.state),
                CLOUD_EVERY_S,
                self._draw_cloud,
            ),
            Drawing(
                "scene",
                (self.points.hits, self._scene.state),
                SCENE_EVERY_S,
                lambda: self._scene.draw(self.points.hit_counts),
            ),
            Drawing(
                "rays",
                (self.rays.seen, cut),
                RAYS_EVERY_S,
                lambda: self._sensor.draw_earlier(self.rays.all, cut),
            ),
            Drawing("path", self._planned(store), 0.0, lambda: self._draw_path(store)),
        )
        left = self._throttle.draw(drawings, final)
        settling = self._scene.settle(), self._cloud.settle()
        return waiting or left or any(settling)

    def _draw_cloud(self) -> None:
        rows = self._cut.below(self.points.rows)
        self.displayed = len(rows)
        self._cloud.draw(rows, self._scene.facing(rows[POSITION]))

    def _planned(self, store: RunStore) -> bool:
        return self._job.trials > 0 and len(store.db.trials) == self._job.trials

    def _draw_path(self, store: RunStore) -> None:
        planning = self._job.planning
        if planning is None or not self._planned(store):
            return
        plan = best(store.db.trials, planning)
        add_discs(self._page, planning.centres, planning.radii, self._level, self.size_m)
        add_route(self._page, plan.path, self._level, self.size_m)


class SampleRays:
    """An even choice of the sample rays of frames as they come, of at most so many frames.

    Parameters
    ----------
    most
        Frames that are kept at a time.
    """

    def __init__(self, most: int = SAMPLE_RAYS) -> None:
        self._most, self._every = most, 1
        self._kept: tuple[NDArray[np.float32], ...] = ()  # each (m, 2, 3)
        self.seen = 0  # frames with rays, and 1 for what was put in their place

    def add(self, frame: Frame) -> None:
        """Note a frame's rays."""
        ends = frame.samples
        if not len(ends):
            return
        if self.seen % self._every == 0:
            starts = np.broadcast_to(np.asarray(frame.pose.position, np.float32), ends.shape)
            self._kept = (*self._kept, np.stack([starts, ends], axis=1))
            if len(self._kept) > self._most:
                self._kept, self._every = self._kept[::2], 2 * self._every
        self.seen += 1

    def replace(self, rays: NDArray[np.float32]) -> None:
        """Keep these rays, (n, 2, 3), in place of all others."""
        self._kept = (rays,)
        self.seen += 1

    @property
    def all(self) -> NDArray[np.float32]:
        """First and last point of each ray, (n, 2, 3), metres, local coordinates."""
        return np.concatenate([np.empty((0, 2, 3), np.float32), *self._kept])


def sensor_places(survey: Survey) -> NDArray[np.float64]:
    """Where the sensor is, (p, 3), metres, local: at its stations, or on its way if it moves.

    Of many places an even choice, with the first and the last.
    """
    path = survey.path
    count = survey.scan_count if path.moves else path.stations
    chosen = np.linspace(0, count - 1, min(count, MOST_POSES)).astype(np.int64).tolist()
    return np.array([(survey.pose(i) if path.moves else path.pose(i)).position for i in chosen])


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


class Latest(Generic[T]):
    """Hands the newest of many things from one thread to another, which need not keep up.

    Examples
    --------
    >>> frames = Latest()
    >>> for frame in range(3):
    ...     frames.put(frame)
    >>> frames.take(), frames.take(), frames.dropped
    (2, None, 2)
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._newest: T | None = None
        self.taken = 0  # things that were taken
        self.dropped = 0  # things that made way for a newer one

    def put(self, thing: T) -> None:
        """Leave something; never waits for whoever takes it."""
        with self._lock:
            self.dropped += self._newest is not None
            self._newest = thing

    def take(self) -> T | None:
        """Take what was left last; None if that was taken already."""
        with self._lock:
            newest, self._newest = self._newest, None
            self.taken += newest is not None
            return newest

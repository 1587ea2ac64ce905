"""Live page that shows the sweeps of scanners in the browser while a program runs.

The program hands over a sweep and continues. The page keeps only the newest sweep of each scanner,
and prepares it when a browser requests an update, within a small share of a CPU core. Sweeps in
between are skipped.
"""

from __future__ import annotations

import threading
import time
import weakref
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from typing import Any

import click
import numpy as np

from lidarfiles.picture_file import PictureContent, SensorPositions
from lidarlive.viewers.scanner_view import ScannerView, is_present, pose_at
from lidarlive.viewers.viewer import Address
from lidarsim.columns.cloud import Cloud
from lidarsim.columns.waveforms import WAVEFORM
from lidarsim.environment.notebook import cell_display
from lidarsim.errors import LidarError
from lidarsim.motion.rotations import quaternions_of
from lidarsim.motion.trajectory import Pose
from lidarsim.numerics.arrays import AnyArray, AnyFloats, Floats
from lidarsim.scene.scene import Scene
from lidarsim.schema.checks import check_items
from lidarsim.simulator import Scanner
from lidarsim.words import format_rounded
from lidarview.viewer.point_selection import InMemoryPoints
from lidarview.viewer.server import (
    PORT,
    Answer,
    Arguments,
    notebook_html,
    open_browser,
    page_server,
)
from lidarview.viewer.view import View

from .cpu_share import CpuShare

SHARE = 0.02  # maximum share of a CPU core for preparing points; sending them takes as much again
NEWS_MS = 60  # minimum time between two requests for updates
SCALES_S = 5.0  # time for which color scales are kept, so that colors do not flicker
MAX_TRAIL = 500  # maximum number of positions in the trajectory of a sensor
_RATE_SWEEPS = 20  # number of sweeps over which the rate is averaged


def show(
    scanner: Scanner | Sequence[Scanner], *, to: str | None = None, browser: bool = False
) -> ScannerPage:
    """Show the sweeps of a scanner in the browser in real time.

    Scripts print the address of the page. In a notebook, the page is shown in the cell if the
    returned object is the value of the cell or is passed to `display`.

    Parameters
    ----------
    scanner
        Scanner to show, or several named scanners in the same scene.
    to
        Address and port to listen on, as ADDRESS:PORT. By default, the port is 8080 on 127.0.0.1,
        or another port if it is in use.
    browser
        Whether to open a browser if the machine has a desktop.

    Returns
    -------
    ScannerPage
        A context manager. Its `show` method displays a sweep at a pose, and its `close` method
        closes the page.

    Raises
    ------
    LidarError
        If the address cannot be used, or if several scanners have the same name.

    Examples
    --------
    >>> from lidarpool import Pose, Scanner, Scene, load_sensor, show
    >>> scanner = Scanner(Scene.seed(), load_sensor("velodyne/vlp16"))
    >>> with show(scanner, to=":0") as view:
    ...     for number in range(3):
    ...         pose = Pose((0.1 * number, 0, 1))
    ...         view.show(scanner.sweep(pose), pose)
    """
    scanners = [scanner] if isinstance(scanner, Scanner) else scanner
    check_items("scanner", scanners, Scanner)
    return ScannerPage([*scanners], to, browser)


class ScannerPage(ScannerView):
    """Live page created by `show`, which displays sweeps in real time."""

    def __init__(self, scanners: Sequence[Scanner], to: str | None, browser: bool) -> None:
        names = [_name(scanner) for scanner in scanners]
        if not names or len({*names}) < len(names):
            raise LidarError(
                "The scanners on a page must have different names, such as Scanner(…, "
                "name='front'), but their names are "
                f"{', '.join(map(repr, names)) or 'missing'}."
            )
        super().__init__(scanners[0])
        address = Address.choose(to, PORT)
        self._feed = SweepFeed(scanners)
        stack = ExitStack()
        self._page = stack.enter_context(
            page_server(self._feed.answer, address.port, host=address.host)
        )
        # Also close the server when the process ends or a notebook deletes the object.
        self._server = weakref.finalize(self, stack.close)
        if cell_display() is None:
            click.echo(self.description, err=True)
            if browser:
                open_browser(self._page.single_use_url())

    @property
    def description(self) -> str:
        """Message for users, which contains the address of the page."""
        return f"The page is available at {self.url}"

    @property
    def url(self) -> str:
        """Address of the page, including its token."""
        return self._page.url

    def _repr_html_(self) -> str:
        if self._is_closed:
            return "<p>This page has been closed.</p>"
        return notebook_html(self._page, f"sweeps of {self._scanner.survey.sensor.model}")

    def _send(self, scanner: Scanner, cloud: Cloud, pose: Any, time_ns: float) -> None:
        self._feed.put(scanner, cloud, pose, time_ns)

    def _end(self) -> None:
        self._server()


def _name(scanner: Scanner) -> str:
    return scanner.survey.mounted_sensors[0].name


@dataclass(eq=False)
class _Sensor:
    """Newest sweep of a scanner, and recent positions of its sensor."""

    scanner: Scanner
    cloud: Cloud | None = None  # None before the first sweep
    pose: Pose = field(default_factory=lambda: Pose((0.0, 0.0, 0.0)))  # pose of the sensor
    # Rows of (seconds since the page was opened, x, y, z) in local coordinates, in meters.
    trail: deque[tuple[float, ...]] = field(default_factory=lambda: deque(maxlen=MAX_TRAIL))

    @property
    def positions(self) -> SensorPositions:
        """Positions of the sensor during its recent sweeps."""
        rows = np.array(self.trail or [(0.0, *self.pose.position)])
        (mounted,) = self.scanner.survey.mounted_sensors
        return SensorPositions(
            rows[:, 0] * 1e9, rows[:, 1:], True, mounted.name, mounted.sensor.model
        )

    def points(self, columns: Sequence[str], origin: Floats) -> tuple[AnyFloats, list[AnyArray]]:
        """Return the points of the sweep in world coordinates, with values of the given columns."""
        if self.cloud is None:
            kinds = {column.name: column.dtype for column in self.scanner.survey.stored_columns}
            return np.zeros((0, 3)), [np.zeros(0, kinds[name]) for name in columns]
        positions = self.cloud.positions
        if self.scanner.survey.coordinates != "world":
            local = positions @ self.pose.rotation_matrix.T + self.pose.position
            positions = local + origin
        return positions, [self.cloud[name] for name in columns]


class SweepFeed:
    """Newest sweeps of several scanners, and the request handler of their page."""

    def __init__(self, scanners: Sequence[Scanner]) -> None:
        self._sensors = [_Sensor(scanner) for scanner in scanners]
        self._started = time.monotonic()
        self._lock = threading.Lock()  # guards the newest sweeps, and is held for microseconds
        self._scene = scanners[0].scene  # scene with the current positions of actors
        self._time_ns = 0.0  # time of the newest sweep on the clock of trajectories
        self._count = 0  # number of sweeps so far
        self._moments: deque[float] = deque(maxlen=_RATE_SWEEPS)  # arrival times of sweeps
        self._share = CpuShare(SHARE)
        self._shown = 0  # value of `_count` when the displayed points were updated
        self._scales_until = 0.0
        self._view: View | None = None  # None before the first request
        self._making = threading.Lock()

    # -- called by the program ----------------------------------------------------------

    def put(self, scanner: Scanner, cloud: Cloud, pose: Any, time_ns: float) -> None:
        """Replace the newest sweep of the given scanner."""
        name = _name(scanner)
        names = [_name(sensor.scanner) for sensor in self._sensors]
        if name not in names:
            raise LidarError(
                f"The page does not show the scanner {name!r}. Pass all scanners to show() as "
                "a list."
            )
        sensor = self._sensors[names.index(name)]
        placed = pose_at(pose, time_ns).compose(scanner.survey.mounted_sensors[0].mount)
        now_s = time.monotonic() - self._started
        with self._lock:
            sensor.cloud = cloud
            sensor.pose = placed
            sensor.trail.append((now_s, *placed.position))
            self._scene = scanner.scene
            self._time_ns = time_ns
            self._count += 1
            self._moments.append(now_s)

    # -- called by the page -------------------------------------------------------------

    def answer(self, question: str, arguments: Arguments, abandoned: Callable[[], bool]) -> Answer:
        """Answer a request from the page."""
        if not self._count:  # Before the first sweep, there is nothing to show.
            return self._news(), {}
        if question == "state":
            header, arrays = self.view.answer(question, arguments, abandoned)
            return header | {"live": True, "scanner": True}, arrays
        if question not in ("news", "points"):  # requested once, or by a user
            return self.view.answer(question, arguments, abandoned)
        with self._share.use():
            if question == "news":
                return self._news(), self._moving_objects()
            return self.view.answer(question, arguments, abandoned)

    @property
    def view(self) -> View:
        """View of the newest sweeps, which is created for the first request."""
        with self._making:
            if self._view is None:
                scanner = self._sensors[0].scanner
                content, _ = PictureContent.before_casting(self._scene, scanner.survey)
                pictured = replace(
                    content,
                    sensors=[sensor.positions for sensor in self._sensors],
                    coordinates="world",
                )
                title = f"{scanner.survey.sensor.model} - lidarpool"
                self._view = View(InMemoryPoints(self._cloud()), pictured, title=title)
                self._shown = self._count
            return self._view

    def _news(self) -> dict[str, Any]:
        """Return the number of sweeps and their rate as JSON-compatible objects.

        The displayed points are updated if necessary.
        """
        rate = ""
        with self._lock:
            moments = [*self._moments]
            now_s = self._sensors[0].trail[-1][0] if self._sensors[0].trail else 0.0
        if len(moments) > 1:
            rate_hz = (len(moments) - 1) / max(moments[-1] - moments[0], 1e-9)
            rate = f"{format_rounded(rate_hz)} sweeps/s"
        return {
            "state": f"sweep {self._count:,}" if self._count else "waiting for the first sweep",
            "over": False,
            "stops": False,
            "seconds": None,
            "rate": rate,
            "left": "",
            "stages": [],
            "slots": [],
            "failures": [],
            "time": now_s,
            "version": self._version(),
            "rays_version": None,
            "hits_version": None,
            "path": None,
            "ends": 0,
            # time until newer points can be requested
            "wait_ms": max(NEWS_MS, 1e3 * self._share.wait_s),
            "points": 0 if self._view is None else len(self._view.points),
        }

    def _version(self) -> int:
        """Update the displayed points if newer ones are available, and return their version."""
        if not self._count:
            return 0
        view = self.view
        if self._shown < self._count and self._share.is_due:
            self._shown = self._count
            now = time.monotonic()
            keep_scales = now < self._scales_until
            if not keep_scales:
                self._scales_until = now + SCALES_S
            view.replace_points(InMemoryPoints(self._cloud()), keep_scales=keep_scales)
        return view.version

    def _cloud(self) -> Cloud:
        """Merge the newest sweeps of all sensors, using the columns that all sensors have."""
        with self._lock:
            sensors = [replace(sensor) for sensor in self._sensors]
        tables = [[column.name for column in s.scanner.survey.stored_columns] for s in sensors]
        shared = [name for name in tables[0] if all(name in table for table in tables)]
        names = [name for name in shared if name not in ("x", "y", "z", WAVEFORM)]
        parts = [sensor.points(names, self._scene.origin) for sensor in sensors]
        columns = {
            name: np.concatenate([values[k] for _, values in parts]) for k, name in enumerate(names)
        }
        if len(sensors) > 1:
            sizes = [len(positions) for positions, _ in parts]
            columns["sensor"] = np.repeat(np.arange(len(sensors), dtype=np.uint8), sizes)
        custom = next((s.cloud.custom_columns for s in sensors if s.cloud is not None), ())
        return Cloud(np.concatenate([positions for positions, _ in parts]), columns, custom)

    def _moving_objects(self) -> dict[str, AnyArray]:
        """Return the sensor positions in local coordinates and the actor poses, as named arrays."""
        with self._lock:
            scene = self._scene
            time_ns = self._time_ns
            positions = [sensor.positions for sensor in self._sensors]
        arrays: dict[str, AnyArray] = {}
        for number, sensor in enumerate(positions):
            arrays[f"sensor{number}_times"] = sensor.times_ns / 1e9
            arrays[f"sensor{number}_places"] = sensor.positions
        return arrays | _actor_poses(scene, time_ns)


def _actor_poses(scene: Scene, time_ns: float) -> dict[str, AnyArray]:
    """Return each actor's pose, animation frame, and presence at a given time."""
    poses = [pose_at(actor.trajectory, time_ns) for actor in scene.actors]
    rotations = np.array([pose.rotation_matrix for pose in poses]).reshape(-1, 3, 3)
    frames = np.zeros(len(poses))
    for number, actor in enumerate(scene.actors):
        if (animation := actor.mesh.animation) is not None:
            frames[number] = actor.seconds(np.array([time_ns]))[0][0] / animation.step_s
    return {
        "actor_places": np.array([pose.position for pose in poses]).reshape(-1, 3),
        "actor_turns": quaternions_of(rotations) if poses else np.zeros((0, 4)),
        "actor_frames": frames,
        "actor_there": np.array([is_present(a, time_ns) for a in scene.actors], np.uint8),
    }

"""Show the sweeps of a `Scanner` in Foxglove or Rerun while a program runs."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, Self

import click
import numpy as np

from lidarfiles.clouds.frame_names import VEHICLE, WORLD, frame_names, points_topic
from lidarfiles.clouds.shown_sweeps import (
    ActorBoxes,
    FramePose,
    ShownSweep,
    Surface,
    Surroundings,
    viewer_columns,
)
from lidarsim.columns.cloud import Cloud
from lidarsim.errors import LidarError
from lidarsim.motion.rotations import quaternions_of
from lidarsim.motion.trajectory import Pose, Trajectory, as_pose, presence_ns
from lidarsim.numerics.arrays import Floats
from lidarsim.scene.actors import Actor
from lidarsim.schema.checks import check_type
from lidarsim.simulator import Scanner
from lidarsim.sweeps.sweeps import actor_type

from .viewer import Viewer, open_viewer


class ScannerView(ABC):
    """Context manager that shows the sweeps of scanners while a program runs."""

    def __init__(self, scanner: Scanner) -> None:
        self._scanner = scanner
        self._is_closed = False

    def __repr__(self) -> str:
        return f"<{type(self).__name__} of {self._scanner!r}>"

    @property
    @abstractmethod
    def description(self) -> str:
        """Message for users, which contains the addresses to open."""

    @abstractmethod
    def _send(self, scanner: Scanner, cloud: Cloud, pose: Any, time_ns: float) -> None:
        """Send a sweep that started at `time_ns` on the trajectories' clock."""

    @abstractmethod
    def _end(self) -> None:
        """Disconnect all clients."""

    def show(
        self,
        cloud: Cloud,
        pose: Pose | Trajectory | Sequence[float],
        *,
        start_s: float = 0.0,
        scanner: Scanner | None = None,
    ) -> None:
        """Show a sweep with its frames and actor boxes.

        The method does not wait for clients. The time of the sweep is the time of the call.

        Parameters
        ----------
        cloud
            Sweep that was returned by `Scanner.sweep`.
        pose
            Pose or trajectory that was passed to `Scanner.sweep`.
        start_s
            Start of the sweep in seconds on the clock of trajectories.
        scanner
            Scanner of the sweep if there are several named scanners. By default, the first scanner.

        Raises
        ------
        LidarError
            If the view is closed.
        """
        if self._is_closed:
            raise LidarError("This view is closed and cannot show further sweeps. Open a new view.")
        self._send(scanner or self._scanner, cloud, pose, start_s * 1e9)

    def close(self) -> None:
        """Disconnect all clients."""
        if not self._is_closed:
            self._is_closed = True
            self._end()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


class _ExternalScannerView(ScannerView):
    """Scanner view in a third-party viewer."""

    def __init__(self, viewer: Viewer, scanner: Scanner) -> None:
        super().__init__(scanner)
        self._viewer = viewer
        name = scanner.survey.mounted_sensors[0].name
        surroundings = Surroundings(
            Surface.from_scene(scanner.scene),
            start_ns=time.time_ns(),
            topics=[points_topic(name, frame_names([name], [])[0])],
            has_actors=bool(scanner.scene.actors),
        )
        viewer.show_surroundings(surroundings)
        click.echo(viewer.description, err=True)

    @property
    def description(self) -> str:
        return self._viewer.description

    def _send(self, scanner: Scanner, cloud: Cloud, pose: Any, time_ns: float) -> None:
        self._viewer.show_sweep(_sweep_for_viewers(scanner, cloud, pose, time_ns))

    def _end(self) -> None:
        self._viewer.close()


class Foxglove(_ExternalScannerView):
    """Show the sweeps of a scanner in Foxglove in real time.

    The object is a context manager. It prints the link that opens Foxglove.

    Parameters
    ----------
    scanner
        Scanner to show, or the first of several scanners in the same scene.
    to
        Address and port to listen on, as ADDRESS:PORT. The address must be local to this machine.
        By default, the port is 8765 on 127.0.0.1, or another port if it is in use.

    Raises
    ------
    LidarError
        If foxglove-sdk is not installed (`live` extra), if the address cannot be used, or if the
        address can be reached from other machines.
    """

    def __init__(self, scanner: Scanner, to: str | None = None) -> None:
        check_type("scanner", scanner, Scanner)
        super().__init__(open_viewer("foxglove", to), scanner)


class Rerun(_ExternalScannerView):
    """Show the sweeps of a scanner in Rerun in real time.

    The object is used like `Foxglove`. It prints the link of the viewer in the browser. By default,
    it listens on 127.0.0.1:9876, and the page is served on the next port. It requires rerun-sdk
    (`rerun` extra).
    """

    def __init__(self, scanner: Scanner, to: str | None = None) -> None:
        check_type("scanner", scanner, Scanner)
        super().__init__(open_viewer("rerun", to), scanner)


def _sweep_for_viewers(scanner: Scanner, cloud: Cloud, pose: Any, time_ns: float) -> ShownSweep:
    """Convert a scanner's sweep to a form that viewers can show, with frames and boxes."""
    scene = scanner.scene
    (mounted,) = scanner.survey.mounted_sensors
    vehicle = pose_at(pose, time_ns)
    sensor = vehicle.compose(mounted.mount)
    positions = cloud.positions.astype(np.float64)
    if scanner.survey.coordinates == "world":
        positions = (positions - (scene.origin + sensor.position)) @ sensor.rotation_matrix
    frame, *actor_frames = frame_names([mounted.name], [actor.name for actor in scene.actors])
    transforms = [
        FramePose(WORLD, VEHICLE, *_position_and_quaternion(vehicle, scene.origin)),
        FramePose(VEHICLE, frame, *_position_and_quaternion(mounted.mount, np.zeros(3))),
    ]
    poses = [pose_at(actor.trajectory, time_ns) for actor in scene.actors]
    for name, actor_pose in zip(actor_frames, poses, strict=False):
        actor_in_world = _position_and_quaternion(actor_pose, scene.origin)
        transforms.append(FramePose(WORLD, name, *actor_in_world))
    now_ns = time.time_ns()
    return ShownSweep(
        start_ns=now_ns,
        stamp_ns=now_ns,
        topic=points_topic(mounted.name, frame),
        frame=frame,
        positions=positions.astype(np.float32),
        columns=viewer_columns(cloud.columns),
        transforms=transforms,
        boxes=_boxes(scanner, cloud, poses, time_ns) if scene.actors else None,
    )


def _boxes(scanner: Scanner, cloud: Cloud, poses: list[Pose], time_ns: float) -> ActorBoxes:
    """Return the boxes of the actors in a scanner's scene, given their poses."""
    scene = scanner.scene
    actors = scene.actors
    bounds = np.array([actor.bounds for actor in actors])
    rotations = np.array([pose.rotation_matrix for pose in poses])
    local_centers = (rotations @ bounds.mean(axis=1)[..., None])[..., 0]
    positions = np.array([pose.position for pose in poses]) + scene.origin
    hit_actors = cloud["object"].astype(np.int64) - len(scene.names)
    counts = np.bincount(hit_actors[hit_actors >= 0], minlength=len(actors))
    names = [actor.name for actor in actors]
    return ActorBoxes(
        names=names,
        types=[actor_type(name) for name in names],
        centers=positions + local_centers,
        quaternions=quaternions_of(rotations),
        sizes=np.ptp(bounds, axis=1),
        points=counts.tolist(),
        present=[is_present(actor, time_ns) for actor in actors],
    )


def is_present(actor: Actor, time_ns: float) -> bool:
    """Return whether an actor is in the scene at a given time in nanoseconds."""
    appears_ns, leaves_ns = presence_ns(actor.trajectory)
    return appears_ns <= time_ns <= leaves_ns


def pose_at(pose: Any, time_ns: float) -> Pose:
    """Return a trajectory's pose at a given time, or return a single pose unchanged."""
    is_trajectory = hasattr(pose, "poses")
    return pose.pose(0, time_ns) if is_trajectory else as_pose("pose", pose)


def _position_and_quaternion(pose: Pose, origin: Floats) -> tuple[Floats, Floats]:
    return np.array(pose.position) + origin, quaternions_of(pose.rotation_matrix[None])[0]

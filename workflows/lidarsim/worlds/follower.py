"""A lidar in a world that another program controls.

The program passes the meshes of the bodies once, and their transformation matrices at each step.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ..columns.cloud import Cloud
from ..errors import LidarError
from ..motion.trajectory import StaticPose, Track
from ..numerics.arrays import Floats, Floats32
from ..scene.actors import Actor, distinct_meshes
from ..scene.object_names import unique_names
from ..scene.scene import Scene
from ..scene.scene_instances import SceneInstance
from ..scene.scene_mesh import SceneMesh
from ..schema.checks import check_items
from ..sensor import Sensor
from ..simulator.scanner import Scanner
from ..survey.survey import Mounted
from .world import World
from .world_follower import WorldFollower

_SLACK_S = 1e-9  # tolerance for the time of the last beam of a sweep


class _Step(NamedTuple):
    """State of the world at a single time step."""

    time_s: float  # seconds since the first step
    pose: Floats  # (4, 4), from the platform frame to the world
    matrices: Floats  # (k, 4, 4), from the body frames to the world


class _StepLog:
    """Recorded time steps of a world, and the number of the current sweep."""

    def __init__(self, start_s: float) -> None:
        self.start_s = start_s  # time of the first step
        self.number = 0
        self.steps: deque[_Step] = deque()
        # Times of the first and last beam of the current sweep, in seconds since the first step.
        self.span_s: tuple[float, float] | None = None

    def precedes(self, time_s: float) -> bool:
        """Return whether the last step, if there is one, is not later than a time."""
        return not self.steps or self.start_s + self.steps[-1].time_s <= time_s

    def add(self, step: _Step) -> None:
        """Add a step. It replaces the last step if both have the same time."""
        if self.steps and step.time_s == self.steps[-1].time_s:
            self.steps.pop()
        self.steps.append(step)

    def drop_before(self, start_s: float) -> None:
        """Discard the steps that are no longer needed for times after `start_s`."""
        while len(self.steps) > 2 and self.steps[1].time_s <= start_s:
            self.steps.popleft()


class Follower:
    """A lidar in a world that another program controls.

    `sweep` and `ranges` scan the world as if it were stationary, which is the fastest method.
    `step` records the time steps of a moving world, and simulates each sweep once its last beam has
    been fired. Each beam then uses the poses of the sensor and of the bodies at its firing time.

    If several worlds have the same bodies at different poses, such as the environments of a
    vectorized simulation, a single follower is sufficient. Pass the index of the world to its
    methods.

    Parameters
    ----------
    bodies
        Meshes of the k moving bodies, in their own frames. Bodies with the same arrays share an
        acceleration structure.
    sensor
        The lidar, or a `Mounted` lidar on a platform.
    static
        Stationary meshes and instances in world coordinates. `step` requires at least one.
    **options
        Options of `Scanner`, such as columns, noise, threads, and the names of `unseen` bodies.

    Raises
    ------
    LidarError
        If there are no meshes, or if an option of `Scanner` is invalid.

    Examples
    --------
    >>> import numpy as np
    >>> from lidarpool import Follower, box, load_sensor
    >>> ground = box("Ground", (80, 80, 0.1))
    >>> sensor = load_sensor("velodyne/vlp16")
    >>> follower = Follower([box("Car", (4, 2, 1.5))], sensor, static=[ground])
    >>> car = np.eye(4)
    >>> car[0, 3] = 9
    >>> lidar = np.eye(4)
    >>> lidar[2, 3] = 1.7
    >>> cloud = follower.sweep(lidar, [car])
    >>> follower.names
    ('Ground', 'Car')
    >>> clouds = []
    >>> for k in range(60):  # the car drives at 10 m/s
    ...     car[0, 3] = 9 + 0.02 * k
    ...     clouds += follower.step(0.002 * k, lidar, [car])
    >>> len(clouds)
    1
    """

    def __init__(
        self,
        bodies: Sequence[SceneMesh],
        sensor: Sensor | Mounted,
        *,
        static: Sequence[SceneMesh | SceneInstance] = (),
        **options: Any,
    ) -> None:
        check_items("bodies", bodies, SceneMesh)
        check_items("static", static, SceneMesh, SceneInstance)
        self._static = list(static)
        self.names = unique_names([item.name for item in (*static, *bodies)])
        self._body_names = self.names[len(static) :]
        self._bodies = list(bodies)
        self._sensor = sensor
        self._options = options
        distinct, indices = distinct_meshes(bodies)
        instances = [
            SceneInstance(distinct[index], np.eye(4), mesh.name)
            for index, mesh in zip(indices, bodies, strict=True)
        ]
        # Scanner of a world that is stationary during each sweep.
        self._frozen = Scanner(Scene.from_meshes([*static, *instances]), sensor, **options)
        self._matrices = np.tile(np.eye(4), (len(bodies), 1, 1))
        self._logs: dict[int, _StepLog] = {}  # {index of the world: its steps}

    @classmethod
    def from_world(
        cls,
        path: str | Path,
        sensor: Sensor | Mounted,
        *,
        frame: str | None = None,
        reading: Mapping[str, Any] = MappingProxyType({}),
        **options: Any,
    ) -> WorldFollower:
        """Create a follower for a world file, whose bodies are moved by name.

        Parameters
        ----------
        path
            World or scene file that `Scene.load` reads, such as a Gazebo world (.sdf), a MuJoCo
            model (.xml), or a .glb or .usd file.
        sensor
            The lidar, or a `Mounted` lidar on a frame.
        frame
            Name of the frame that carries the sensor, such as ``robot/lidar_link``. The sensor does
            not see the body of this frame. By default, the sensor does not move.
        reading
            Options of `Scene.load`, such as ``{"assets": "models"}``.
        **options
            Options of `Scanner`, such as columns, noise, threads, and the names of `unseen` bodies.

        Raises
        ------
        LidarError
            If the file cannot be read, if the frame does not exist, or if an option of `Scanner` is
            invalid.

        Examples
        --------
        >>> from lidarpool import Follower, load_sensor
        >>> sensor = load_sensor("velodyne/vlp16")
        >>> follower = Follower.from_world(
        ...     "house.sdf", sensor, frame="robot/lidar_link"
        ... )  # doctest: +SKIP
        >>> for time_s, poses in simulation:  # doctest: +SKIP
        ...     clouds = follower.update(time_s, {"robot": poses["robot"]})
        """
        return WorldFollower(World.load(path, **reading), sensor, frame, **options)

    def __repr__(self) -> str:
        return f"<Follower of {len(self._bodies)} bodies: {self._frozen!r}>"

    @cached_property
    def _moving(self) -> Scanner:
        """Scanner of a world that moves during a sweep. The bodies of the world are actors."""
        if not self._static:
            raise LidarError(
                "The world contains nothing stationary. `step` requires at least one static mesh, "
                "such as a ground."
            )
        actors = [Actor(mesh) for mesh in self._bodies]
        scene = Scene.from_meshes(self._static).with_actors(actors)
        return Scanner(scene, self._sensor, **self._options)

    @property
    def backend(self) -> str:
        """Name of the ray-casting backend in use."""
        return self._frozen.backend

    def sweep(
        self,
        pose: ArrayLike,
        matrices: ArrayLike = (),
        *,
        number: int | None = None,
        world: int = 0,
    ) -> Cloud:
        """Simulate a sweep of the world in its current state.

        Parameters
        ----------
        pose
            Matrix from the frame of the sensor, or of its platform, to the world. Shape (4, 4).
        matrices
            Matrices from the frames of the bodies to the world, in meters. Shape (k, 4, 4).
        number
            Number of the sweep, as in `Scanner.sweep`. By default, each call has new noise.
        world
            Index of the world. The noise in different worlds is independent.

        Returns
        -------
        Cloud
            The returns. The column `object` contains indices into `names`.

        Raises
        ------
        LidarError
            If the number of matrices differs from the number of bodies, or if a matrix is not a
            rigid transform.
        """
        sensor_pose = _matrices(pose, 1)
        self._move_bodies(_matrices(matrices, len(self._bodies)))
        origin = self._frozen.origin
        path = StaticPose(sensor_pose[0, :3, 3] - origin, sensor_pose[0, :3, :3])
        return self._frozen.sweep(path, number=number, stream=world)

    def ranges(
        self,
        poses: ArrayLike,
        matrices: ArrayLike = (),
        *,
        number: int | None = None,
        world: int = 0,
    ) -> Floats32:
        """Simulate the range images that a sensor measures in the current state of the world.

        Parameters
        ----------
        poses
            Matrices from the frame of the sensor, or of its platform, to the world, for s poses.
            Shape (s, 4, 4).
        matrices, number, world
            As in `sweep`.

        Returns
        -------
        float32 array of shape (s, firings, channels)
            Ranges in meters, or inf if there is no return (see `Scanner.ranges`).

        Raises
        ------
        LidarError
            If the number of matrices differs from the number of bodies, or if a matrix is not a
            rigid transform.
        """
        sensor_poses = _matrices(poses, None)
        self._move_bodies(_matrices(matrices, len(self._bodies)))
        local_poses = _to_local(sensor_poses, self._frozen.origin)
        return self._frozen.ranges(local_poses, number=number, stream=world)

    def step(
        self, time_s: float, pose: ArrayLike, matrices: ArrayLike = (), *, world: int = 0
    ) -> list[Cloud]:
        """Record a time step of the world. Return the sweeps completed since the last step.

        The first sweep starts at the first step, and each further sweep starts where the previous
        one ends. If the time is before the last step, for example because the world was reset, all
        earlier steps are discarded and a new first sweep starts.

        Parameters
        ----------
        time_s
            Time in the world in seconds.
        pose
            Matrix from the frame of the sensor, or of its platform, to the world. Shape (4, 4).
        matrices
            Matrices from the frames of the bodies to the world, in meters. Shape (k, 4, 4). Between
            two steps, bodies move at constant velocity and angular velocity.
        world
            Index of the world. Each world has its own steps and sweeps.

        Returns
        -------
        list of Cloud
            The completed sweeps; usually none or one.

        Raises
        ------
        LidarError
            If the number of matrices differs from the number of bodies, a matrix is not a rigid
            transform, or the world contains nothing stationary.
        """
        log = self._logs.get(world)
        if log is None or not log.precedes(time_s):
            log = self._logs[world] = _StepLog(time_s)
        log.add(
            _Step(
                time_s - log.start_s,
                _matrices(pose, 1)[0].copy(),
                _matrices(matrices, len(self._bodies)).copy(),
            )
        )
        return list(self._completed_sweeps(log, world))

    def reset(self, world: int | None = None) -> None:
        """Discard all recorded steps, so that the next step starts the first sweep again.

        Parameters
        ----------
        world
            Index of the world (default: all worlds).
        """
        if world is None:
            self._logs.clear()
        else:
            self._logs.pop(world, None)

    def _completed_sweeps(self, log: _StepLog, world: int) -> Iterator[Cloud]:
        """Yield the sweeps of a world whose last beam was fired no later than the last step."""
        while True:
            if log.span_s is None:
                log.span_s = self._moving.span_s(log.number)
            start_s, stop_s = log.span_s
            if stop_s > log.steps[-1].time_s + _SLACK_S or len(log.steps) < 2:
                return
            log.drop_before(start_s)
            times_s, poses, matrices = map(np.array, zip(*log.steps, strict=True))
            origin = self._moving.origin
            if self._bodies:
                by_body = _to_local(matrices.transpose(1, 0, 2, 3), origin)
                self._moving.move(self._body_names, by_body, times_s=times_s)
            # The first pose is held, because the scanner also requires the pose at time 0.
            (path,) = Track.from_matrices(times_s, _to_local(poses, origin)[None], "hold")
            yield self._moving.sweep(path, number=log.number, stream=world)
            log.number += 1
            log.span_s = None

    def _move_bodies(self, matrices: Floats) -> None:
        """Move the instances whose matrices have changed."""
        changed = np.flatnonzero((matrices != self._matrices).any(axis=(1, 2)))
        if len(changed):
            names = [self._body_names[row] for row in changed]
            self._frozen.move(names, _to_local(matrices[changed], self._frozen.origin))
            self._matrices = matrices.copy()


def _to_local(matrices: Floats, origin: Floats) -> Floats:
    """Convert matrices from world coordinates to local coordinates."""
    if not origin.any():
        return matrices
    local = matrices.copy()
    local[..., :3, 3] -= origin
    return local


def _matrices(values: ArrayLike, count: int | None) -> Floats:
    """Convert matrices to an array of shape (k, 4, 4).

    Raise LidarError if the shape is different, or if `count` is set and differs from k. The scanner
    checks that the matrices are rigid.
    """
    try:
        matrices = np.asarray(values, np.float64).reshape(-1, 4, 4)
    except (TypeError, ValueError) as error:
        raise LidarError(f"Matrices must be numbers of the shape (k, 4, 4): {error}.") from error
    if count is not None and len(matrices) != count:
        raise LidarError(
            f"There are {len(matrices)} matrices, but {count} bodies. Pass one matrix for each "
            "body."
        )
    return matrices

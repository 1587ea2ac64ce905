"""The `Scanner` class, which simulates a sensor in a scene sweep by sweep."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from itertools import compress
from typing import Annotated, Any, NoReturn

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from raybeam.poses import check_poses

from ..casting.motion import check_trajectory
from ..casting.scene_caster import check_backend_here
from ..casting.static_bodies import warn_of_reach
from ..casting.surfaces import warn_of_gray
from ..columns.cloud import Cloud
from ..columns.table import AXES, FLOW, FLOW_EGO, SCAN, Column
from ..errors import LidarError
from ..media.materials import Material
from ..media.weather import FOG_LIDAR_RATIO_SR
from ..motion.trajectory import CENTER, Pose, Stations, Trajectory, as_pose
from ..numerics.arrays import Floats, Floats32, Indices
from ..scene.actors import Actor
from ..scene.scene import Scene
from ..schema.checks import check_fits, check_type
from ..schema.declared import Names
from ..schema.value_texts import format_value
from ..sensor import Noise, Returns, Sensor
from ..survey.survey import Mounted, ScanSpec, Survey
from ..words import name_hint
from .body_poses import ROW_SLACK, poses_of_bodies, poses_of_body
from .points.batch_columns import columns_of
from .rig import Rig

MAX_SCANS = 1 << 31  # limit of the type of the column `scan`
_MAX_REVOLUTIONS = 4  # number of revolutions whose scans are stored
MAX_START_S = 9e9  # times are int64 nanoseconds
SweepNumber = Annotated[int, Field(ge=0, lt=MAX_SCANS)]
StartSeconds = Annotated[float | None, Field(ge=0, lt=MAX_START_S)]
StreamNumber = Annotated[int, Field(ge=0, lt=MAX_SCANS)]


class Scanner:
    """A simulated sensor that scans a scene in the current process, without a cluster or files.

    The results are bit-identical to those of a survey along the same trajectory. Sweep `number` is
    the revolution (or frame) of the survey with this number. The random numbers are also the same
    if the sensor is the first sensor of the survey. Scanners with the same name and the same noise
    seed use the same random numbers.

    Several threads can share a scanner. A pickled copy, for example in a Dask task, returns the
    same results. The copy builds its own acceleration structures and continues with the sweep
    numbers of the original scanner.

    Parameters
    ----------
    scene
        The scene to scan.
    sensor
        The lidar, or a `Mounted` lidar on a platform. For a `Mounted` lidar, all poses are poses of
        the platform.
    name
        Name of the sensor, on which all of its random numbers depend. Use different names for the
        sensors of a robot. A `Mounted` lidar already has a name.
    unseen
        Names of objects that are invisible to the sensor, as in `Mounted`. * and ? are wildcards.
    columns, precision_m, coordinates, materials, returns, noise, visibility_km, \
    fog_lidar_ratio_sr, rain_mm_h, snow_mm_h, dust_mg_m3, wet, \
    spray_g_m3
        As in `Survey`.
    backend
        Ray-casting backend: "cuda", "tiles", "numpy", or "auto" for the first of the three that is
        available.
    threads
        Number of CPU threads for ray casting. If None, all cores are used.
    device
        Index of the CUDA device. If None, the current device is used.

    Raises
    ------
    LidarError
        If an argument is invalid, or if the backend cannot be used on this machine.

    Examples
    --------
    >>> from lidarpool import Pose, Scanner, Scene, load_sensor
    >>> scanner = Scanner(Scene.seed(), load_sensor("velodyne/vlp16"), columns=["range"])
    >>> scanner.sweep(Pose((0, 0, 1)))
    <Cloud of 2,278 points: x, y, z, scan, channel, object, range>
    >>> scanner.ranges([(0, 0, 1), (1, 0, 1)]).shape
    (2, 1809, 16)
    """

    def __init__(
        self,
        scene: Scene,
        sensor: Sensor | Mounted,
        *,
        name: str = "",
        unseen: Names = (),
        columns: Sequence[str | Column] = (),
        precision_m: float | None = None,
        coordinates: str = "world",
        materials: Sequence[Material] = (),
        returns: Returns | None = None,
        noise: Noise | None = None,
        visibility_km: float | None = None,
        fog_lidar_ratio_sr: float | None = FOG_LIDAR_RATIO_SR,
        rain_mm_h: float = 0.0,
        snow_mm_h: float = 0.0,
        dust_mg_m3: float = 0.0,
        wet: float = 0.0,
        spray_g_m3: float = 0.0,
        backend: str = "auto",
        threads: int | None = None,
        device: int | None = None,
    ) -> None:
        check_type("scene", scene, Scene, advice=" To read a file, use Scene.load('hall.glb').")
        if name and isinstance(sensor, Mounted):
            raise LidarError(
                f"The name of a Mounted sensor is set in Mounted, but name is {name!r}. Use "
                f"Mounted(sensor, name={name!r})."
            )
        mounted = sensor if isinstance(sensor, Mounted) else Mounted(sensor, name=name)
        if unseen:
            names = (unseen,) if isinstance(unseen, str) else unseen
            mounted = replace(mounted, unseen=(*mounted.unseen, *names))
        survey = Survey(
            sensors=[mounted],
            poses=[CENTER],
            steps=1,
            precision_m=precision_m,  # type: ignore[arg-type]  # None: set by the sensor below
            columns=columns,
            coordinates=coordinates,
            materials=materials,
            returns=returns,  # type: ignore[arg-type]
            noise=noise,  # type: ignore[arg-type]
            visibility_km=visibility_km,
            fog_lidar_ratio_sr=fog_lidar_ratio_sr,
            rain_mm_h=rain_mm_h,
            snow_mm_h=snow_mm_h,
            dust_mg_m3=dust_mg_m3,
            wet=wet,
            spray_g_m3=spray_g_m3,
        )
        _check_columns(survey)
        warn_of_gray(scene, survey)
        warn_of_reach(scene, survey)
        self._assemble(scene, survey, {"backend": backend, "threads": threads, "device": device})

    def _assemble(self, scene: Scene, survey: Survey, options: dict[str, Any]) -> None:
        """Check the backend, build the rig with the options of `Rig`, and set all attributes."""
        check_backend_here(options["backend"])
        try:
            self._rig = Rig(scene, survey, **options)
        except ValueError as error:  # invalid `threads` or `device`
            raise LidarError(str(error)) from error
        self._actors = list(scene.actors)
        self._numbers = {name: number for number, name in enumerate(scene.object_names)}
        # True for objects whose triangles all belong to instances.
        self._movable = np.zeros(len(scene.names), np.bool_)
        if scene.instances is not None:
            self._movable[scene.instances.owner] = True
            self._movable[scene.face_object] = False
        # Sweeps share the caster, in which instances are moved.
        self._lock = threading.Condition()
        self._casts = 0  # sweeps in progress
        self._moves = 0  # moves of instances in progress or waiting
        self._unnumbered = 0  # number of sweeps and images scanned without a `number` so far
        self._revolutions: dict[int, list[ScanSpec]] = {}  # {revolution: its scans}

    def __getstate__(self) -> dict[str, Any]:
        with self._lock:
            rig = self._rig
            arguments = {"scene": rig.scene, "survey": rig.survey, "options": rig.options}
            return {"arguments": arguments, "unnumbered": self._unnumbered}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self._assemble(**state["arguments"])
        self._unnumbered = state["unnumbered"]

    def __repr__(self) -> str:
        rig = self._rig
        return f"<Scanner: {rig.survey.sensor.model} in {rig.scene!r}, by {rig.backend}>"

    @property
    def backend(self) -> str:
        """Name of the ray-casting backend in use."""
        return self._rig.backend

    @property
    def survey(self) -> Survey:
        """Survey of a single time step with the scanner's sensor and options."""
        return self._rig.survey

    @property
    def origin(self) -> Floats:
        """Local origin of the scene in world coordinates, in meters.

        The shape is (3,).
        """
        return self._rig.scene.origin

    @property
    def scene(self) -> Scene:
        """The scene, with actors and instances at their current poses."""
        return self._rig.scene

    def span_s(self, number: int = 0, *, start_s: float | None = None) -> tuple[float, float]:
        """Return the firing times, in seconds, of the first and the last beam of a sweep.

        `number` and `start_s` are the same as in `sweep`, but `number` is 0 by default.
        """
        rig = self._rig
        specs, _ = self._scans_of(rig, number, start_s)
        begin_ns, end_ns = _span_ns(rig, specs)
        last_delay_ns = float(rig.survey.sensor.beams.time_ns.max())
        return begin_ns / 1e9, (end_ns + last_delay_ns) / 1e9

    def sweep(
        self,
        pose: Pose | Trajectory | Sequence[float],
        *,
        number: int | None = None,
        start_s: float | None = None,
        stream: int = 0,
    ) -> Cloud:
        """Simulate a sweep, which is one revolution of the head or one frame.

        Parameters
        ----------
        pose
            Pose of a stationary sensor, or trajectory of a moving sensor, in local scene
            coordinates. Along a trajectory, each beam is fired from the pose at its firing time.
        number
            Number of the revolution or frame, starting at 0. It determines the random numbers and
            the firings, because a revolution starts at the azimuth where the previous one ended. By
            default, each call uses the firings and times of revolution 0 with new random numbers.
        start_s
            Start of the revolution in seconds since the start of the trajectories of the sensor and
            the actors. The default is `number` times the duration of a revolution, as in a survey.
        stream
            Index of the random number stream. The random numbers of different streams are
            independent. Use a different stream for each of several lidars of the same model that
            share the scanner.

        Returns
        -------
        Cloud
            The returns in the order of their rays, with all columns.

        Raises
        ------
        LidarError
            If the trajectory of the sensor or of an actor does not cover the sweep.
        """
        path = _trajectory_of(pose)
        with self._casting() as rig:
            specs, late_ns = self._specs(rig, number, start_s, stream=stream)
            begin_ns, end_ns = _span_ns(rig, specs)
            if end_ns > path.duration_ns:
                raise LidarError(
                    f"The sweep would last from {begin_ns / 1e9:.6g} to {end_ns / 1e9:.6g} s, but "
                    f"the trajectory lasts {path.duration_ns / 1e9:.6g} s. Reduce start_s, or use "
                    "a longer trajectory."
                )
            try:
                check_trajectory(path)
            except ValueError as error:
                raise LidarError(str(error)) from error
            returns = rig.returns(specs, path, late_ns, tally=False)
        survey = rig.survey
        origin = rig.scene.origin if survey.coordinates == "world" else np.zeros(3)
        table = (SCAN, *(column for column in survey.stored_columns if column not in AXES))
        part = columns_of([returns])
        # A device writes to page-locked memory for all rays, which the next sweep reuses.
        columns = {column.name: part.columns[column.name] for column in table[1:]}
        owned_columns = {
            name: values if values.flags.owndata else values.copy()
            for name, values in columns.items()
        }
        part = replace(part, columns={**part.columns, **owned_columns})
        return part.cloud(table, survey.precision_m, origin)

    def ranges(
        self,
        poses: Pose | ArrayLike,
        *,
        number: int | None = None,
        start_s: float | None = None,
        stream: int = 0,
    ) -> Floats32:
        """Simulate the range images that the sensor measures from several poses.

        This is the fastest method, because it does not compute points.

        Parameters
        ----------
        poses
            A pose or a list of poses; positions (k, 3) in meters; or matrices (k, 4, 4) from the
            frame of the sensor, or of its platform, to the scene frame. The sensor is stationary at
            each pose.
        number
            Number of the revolution, as in `sweep`. The image at pose i uses the random numbers of
            revolution ``number + i``.
        start_s
            Start of the revolution in seconds, which determines the poses of actors, as in `sweep`.
        stream
            Number of the stream of random numbers, as in `sweep`.

        Returns
        -------
        float32 array of shape (k, firings, channels)
            Range of the nearest reported return of each ray in meters, or inf if there is no
            return.

        Raises
        ------
        LidarError
            If `poses` has an unsupported form, a number is not finite, or a matrix is not a rigid
            transform.
        """
        positions, rotations = _poses_of(poses)
        with self._casting() as rig:
            specs, _ = self._specs(rig, number, start_s, len(positions), stream)
            if not len(positions):
                firings = specs[-1].firings[1] - specs[0].firings[0]
                return np.empty((0, firings, specs[0].channels), np.float32)
            rays = (specs[-1].firings[1] - specs[0].firings[0]) * specs[0].channels
            try:
                checked_poses = check_poses(positions, rotations, rays, rays * len(positions), None)
            except ValueError as error:
                raise LidarError(str(error)) from error
            return rig.ranges(specs, checked_poses.positions, checked_poses.rotations)

    def move(
        self,
        name: str | Sequence[str],
        pose: Pose | Trajectory | ArrayLike | Sequence[Any],
        *,
        times_s: ArrayLike | None = None,
    ) -> None:
        """Move actors and instances for all subsequent sweeps.

        Sweeps in progress use the earlier poses.

        Moving several bodies in a single call is faster than moving them one by one, with the same
        result. If a body cannot be moved, none of the bodies is moved.

        Parameters
        ----------
        name
            Name of an actor, or of an object that is a `SceneInstance` in the scene, such as a copy
            in a scenario. To move several bodies, pass a list of k names.
        pose
            New pose of the mesh frame in local scene coordinates: a `Pose`, a position, or a matrix
            (4, 4). Instances keep their scale. For an actor, it can also be a trajectory, which the
            actor follows from time 0. For k names, pass a list of k poses, an array of positions
            (k, 3), or an array of matrices (k, 4, 4). Arrays are faster than lists.
        times_s
            Times of poses within a sweep in seconds, in ascending order, on the time scale of
            `start_s`. Shape (samples,). If `times_s` is set, `pose` must be an array of matrices of
            shape (samples, 4, 4), or (k, samples, 4, 4) for k names. Each beam then uses the poses
            of the actors at its firing time. Between two poses, actors move at constant velocity
            and angular velocity.

        Raises
        ------
        LidarError
            If the actor or instance does not exist, a name occurs twice, an instance would move
            during a sweep, or a matrix is not a rigid transform.

        Examples
        --------
        >>> from lidarpool import Actor, Scanner, Scene, box, load_sensor
        >>> cars = [Actor(box(f"Car {number}", (4.5, 1.8, 1.5))) for number in range(3)]
        >>> scene = Scene.seed().with_actors(cars)
        >>> scanner = Scanner(scene, load_sensor("velodyne/vlp16"))
        >>> names = [car.name for car in cars]
        >>> scanner.move(names, [(4, 0, 0), (8, 4, 0), (8, -4, 0)])
        >>> matrices = np.tile(np.eye(4), (3, 2, 1, 1))
        >>> matrices[:, 1, 0, 3] = 1.5  # 1.5 m in 0.1 s
        >>> scanner.move(names, matrices, times_s=[0, 0.1])
        """
        names = [name] if isinstance(name, str) else list(name)
        poses = (
            poses_of_body(pose, times_s)
            if isinstance(name, str)
            else poses_of_bodies(pose, len(names), times_s)
        )
        numbers = self._numbers_of(names)
        object_count = len(self._rig.scene.names)
        is_instance = numbers < object_count
        moving = np.flatnonzero(is_instance & poses.moves)
        if len(moving):
            raise LidarError(
                f"{names[moving[0]]!r} is a SceneInstance, which is stationary during a sweep. "
                "Pass a single pose, or make it an Actor."
            )
        actors = [
            (number - object_count, poses.trajectory(row))
            for row, number in enumerate(numbers.tolist())
            if number >= object_count
        ]
        if is_instance.any():
            self._move_instances(
                numbers[is_instance],
                poses.positions[is_instance],
                poses.rotations[is_instance],
                actors,
            )
        else:
            with self._lock:
                self._follow(self._with_moved(actors))

    def _numbers_of(self, names: list[str]) -> Indices:
        """Return the numbers of the actors and instances with the given names.

        Raises LidarError if a name is unknown or occurs twice.
        """
        numbers = np.array([self._numbers.get(name, -1) for name in names], np.intp)
        object_count = len(self._movable)
        movable = numbers >= object_count
        movable[~movable] = (numbers[~movable] >= 0) & self._movable[numbers[~movable]]
        if not movable.all():
            row = int(movable.argmin())
            self._refuse_name(names[row], int(numbers[row]))
        if len(set(names)) < len(names):
            double = next(name for row, name in enumerate(names) if name in names[:row])
            raise LidarError(f"names contains {double!r} twice. Pass one pose for each body.")
        return numbers

    def _refuse_name(self, name: str, number: int) -> NoReturn:
        """Raise LidarError because a name refers to no actor or instance.

        `number` is the number of the static object with this name, or -1 if there is none.
        """
        object_count = len(self._movable)
        names = [
            *list(self._numbers)[object_count:],
            *compress(self._rig.scene.names, self._movable),
        ]
        hint = name_hint(name, names)
        if number >= 0:
            hint = " It is part of the static scene. Make it an Actor or a SceneInstance."
        raise LidarError(f"Unknown actor or instance {name!r}.{hint}")

    def _with_moved(self, moves: list[tuple[int, Trajectory]]) -> list[Actor]:
        """Return all actors, with new trajectories for those in `moves`.

        The caller must hold the lock.
        """
        actors = self._actors.copy()
        for index, trajectory in moves:
            actors[index] = actors[index].with_trajectory(trajectory)
        return actors

    def _follow(self, actors: list[Actor]) -> None:
        """Replace the actors of the rig, and with them all trajectories.

        The caller must hold the lock.
        """
        self._rig = self._rig.with_actors(tuple(actors))
        self._actors = actors

    def _move_instances(
        self,
        numbers: Indices,
        positions: Floats,
        rotations: Floats,
        actors: list[tuple[int, Trajectory]],
    ) -> None:
        """Wait for sweeps in progress, then move the instances of the given objects.

        New sweeps wait until the instances have moved. Actors given by index get new trajectories.
        """
        with self._lock:
            self._moves += 1  # makes new sweeps wait
            try:
                self._lock.wait_for(lambda: not self._casts)
                moved_actors = self._with_moved(actors)
                self._rig = self._rig.with_moved_instances(numbers, positions, rotations)
                if actors:
                    self._follow(moved_actors)
            finally:
                self._moves -= 1
                self._lock.notify_all()

    def _specs(
        self,
        rig: Rig,
        number: int | None,
        start_s: float | None,
        count: int = 1,
        stream: int = 0,
    ) -> tuple[list[ScanSpec], float]:
        """Return the scans of a revolution, and the delay of its start, in nanoseconds.

        The delay is the difference between `start_s` and the start of revolution `number` in a
        survey, or 0 if `start_s` is None. If `number` is None, the scans belong to revolution 0 but
        use the random numbers of later revolutions, and `count` revolutions of random numbers are
        used up.
        """
        revolutions_ahead = 0  # how far the random numbers are ahead of the revolution
        if number is None:
            with self._lock:
                revolutions_ahead = self._unnumbered
                self._unnumbered += count
        specs, late_ns = self._scans_of(rig, number or 0, start_s, revolutions_ahead, stream)
        if rig.scene.actors:
            begin_ns, end_ns = _span_ns(rig, specs)
            rig.check_actors(begin_ns, end_ns)
        return specs, late_ns

    def _scans_of(
        self,
        rig: Rig,
        number: int,
        start_s: float | None,
        revolutions_ahead: int = 0,
        stream: int = 0,
    ) -> tuple[list[ScanSpec], float]:
        """Return the scans of revolution `number`, and the delay of its start, in nanoseconds.

        The random numbers are those of the revolution that follows `revolutions_ahead` later in a
        stream (`ScanSpec.random_offset`).
        """
        check_fits("number", number, SweepNumber)
        check_fits("start_s", start_s, StartSeconds)
        check_fits("stream", stream, StreamNumber)
        sensor = rig.survey.sensor
        specs = self._revolution(sensor, number)
        if specs[-1].scan >= MAX_SCANS:
            raise LidarError(f"number must be at most {MAX_SCANS:,}, but is {number}.")
        late_ns = (
            0 if start_s is None else round(start_s * 1e9 - sensor.revolution_start_ns(number))
        )
        ahead = revolutions_ahead * len(specs) + stream * MAX_SCANS
        return [spec.with_offsets(late_ns, ahead) for spec in specs], late_ns

    def _revolution(self, sensor: Sensor, number: int) -> list[ScanSpec]:
        """Return the scans of revolution `number`, and cache them."""
        specs = self._revolutions.get(number)
        if specs is None:
            specs = [
                ScanSpec(step, 0, sensor.firings(step), channels=sensor.channels)
                for step in sensor.steps_of_revolution(number)
            ]
            if len(self._revolutions) >= _MAX_REVOLUTIONS:
                self._revolutions.clear()
            self._revolutions[number] = specs
        return specs

    @contextmanager
    def _casting(self) -> Iterator[Rig]:
        """Yield the current rig, and keep its instances in place until the context exits."""
        with self._lock:
            self._lock.wait_for(lambda: not self._moves)
            self._casts += 1
            rig = self._rig
        try:
            yield rig
        finally:
            with self._lock:
                self._casts -= 1
                self._lock.notify_all()


def _check_columns(survey: Survey) -> None:
    """Raise LidarError if a column depends on the next sweep, which a scanner does not know."""
    names = [column.name for column in survey.stored_columns if column.name in (*FLOW, *FLOW_EGO)]
    if names:
        raise LidarError(
            f"The column {names[0]!r} depends on the next sweep, which a Scanner does not know. "
            "Use `simulate` to obtain scene flow, or omit the column."
        )


def _span_ns(rig: Rig, specs: list[ScanSpec]) -> tuple[float, float]:
    """Return the start times of the first and the last firing, in nanoseconds since time 0."""
    sensor = rig.survey.sensor
    first_and_last = np.array([specs[0].firings[0], specs[-1].firings[1] - 1], np.int64)
    begin, end = (sensor.begins_ns(first_and_last) + (sensor.lead_ns + specs[0].start_ns)).tolist()
    return begin, end


def _trajectory_of(pose: Any) -> Trajectory:
    """Return a trajectory unchanged, or convert a pose to a stationary trajectory."""
    path: Trajectory = pose if hasattr(pose, "poses") else Stations((as_pose("pose", pose),))
    return path


def _poses_of(poses: Any) -> tuple[Floats, Floats | None]:
    """Return positions and rotations, or None for the rotations if only positions are given."""
    if isinstance(poses, Pose):
        poses = [poses]
    if isinstance(poses, Sequence) and any(isinstance(pose, Pose) for pose in poses):
        valid_poses = [as_pose("a pose", pose) for pose in poses]
        positions = np.array([pose.position for pose in valid_poses])
        return positions, np.array([pose.rotation_matrix for pose in valid_poses])
    try:
        table = np.asarray(poses, np.float64)
    except (TypeError, ValueError):
        table = np.zeros(0)
    if table.shape == (3,) or (table.ndim == 2 and table.shape[1] == 3):
        return table.reshape(-1, 3), None
    if table.ndim == 3 and table.shape[1:] == (4, 4):
        # `numpy.allclose` would take as long as casting 1,000 rays.
        if not (np.abs(table[:, 3] - [0, 0, 0, 1]) <= ROW_SLACK).all():
            raise LidarError("The last row of each matrix of poses must be 0, 0, 0, 1.")
        return table[:, :3, 3], table[:, :3, :3]
    raise LidarError(
        "poses must be a list of Pose, positions (k, 3) or matrices (k, 4, 4), but is "
        f"{format_value(poses)} of the shape {table.shape}."
    )

"""A scene in which sweeps are simulated at requested poses."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lidarreal.reconstruction.recorded_actors import FOLDER as ACTORS_FOLDER
from lidarreal.reconstruction.twin import FIGURES_FILE, SCENARIO_FILE
from lidarscenario.prepare import prepare
from lidarscenario.scenario import Scenario
from lidarscenario.sections import OutputSection, SensorSection
from lidarscenario.sensors_file import SensorOnFrame, SensorsFile
from lidarsim.environment.extras import reading
from lidarsim.errors import LidarError, MissingFileError
from lidarsim.io.input_files import read_input
from lidarsim.motion.rotations import matrices, quaternions_of
from lidarsim.motion.trajectory import StaticPose, Track, Trajectory, full_poses
from lidarsim.numerics.arrays import Floats, Floats32
from lidarsim.numerics.vectors import matvec, norm, rotate
from lidarsim.scene.actors import Actor
from lidarsim.scene.scene import Scene
from lidarsim.simulator.scanner import Scanner
from lidarsim.words import format_rounded, name_hint, printable

# Maximum relative difference between the durations of a frame and of a sweep. The rotation rate of
# a real sensor also varies.
_MAX_STRETCH = 0.1
_MAX_NUMBER = 1_000_000  # sweeps after which the random numbers repeat
# Coordinates are stored as 32-bit integers, in units of the precision.
_MAX_STEPS = 1e9
_FULL_SCALE = 255  # of the column `reflectivity`
# Trajectory of an actor that is not in the scene.
_ABSENT = Track(np.array([-2.0, -1.0]), np.eye(2, 3), start_s=0.0, beyond="absent")


class FramePoses(NamedTuple):
    """Poses at the start and the end of a frame in world coordinates."""

    positions: Floats  # (2, 3), meters
    quaternions: Floats  # (2, 4), as x, y, z, w, with a norm of 1 within 1e-3

    @property
    def rotations(self) -> Floats:
        """Rotation matrices to the world, of shape (2, 3, 3)."""
        return matrices(self.quaternions / norm(self.quaternions)[:, None])


@dataclass(frozen=True, eq=False)
class SweepRequest:
    """Poses for a sweep.

    Attributes
    ----------
    start_us, end_us
        Times of the start and the end of the frame in microseconds.
    sensor
        Poses of the sensor.
    objects
        Poses of the box of each moving object, by the name of its actor. The origin of a box is its
        center.
    """

    start_us: int
    end_us: int
    sensor: FramePoses
    objects: Mapping[str, FramePoses]


class SensorPoints(NamedTuple):
    """Points of a sweep in the sensor frame at the end of the sweep."""

    positions: Floats32  # (n, 3), meters
    intensities: Floats32  # (n,), from 0 to 1


class Drive(NamedTuple):
    """Trajectory of a scenario in world coordinates."""

    times_ns: Floats  # (k,), nanoseconds since the start of the survey
    positions: Floats  # (k, 3), meters
    quaternions: Floats  # (k, 4), as x, y, z, w


class ServedSensor:
    """A sensor in a scene, whose sweeps are simulated one after another.

    Parameters
    ----------
    scene
        The scene.
    sensor
        The sensor, and the options of its scanner.
    centers
        Box center of each actor in its own frame, by name. The default is the center of the mesh.
    backend
        Ray-casting backend, as in `Scanner`.
    """

    def __init__(
        self, scene: Scene, sensor: SensorOnFrame, centers: Mapping[str, Floats], backend: str
    ) -> None:
        options = {**sensor.options, "columns": ["reflectivity"]}
        self._scanner = Scanner(scene, sensor.mounted, **options, backend=backend)
        self._lock = threading.Lock()  # a sweep uses the poses that were set before it
        lidar = sensor.mounted.sensor
        self.name = lidar.name
        self.period_s = (lidar.revolution_start_ns(1) - lidar.revolution_start_ns(0)) / 1e9
        self._idle = {actor.name: _idle_trajectory(actor) for actor in scene.actors}
        self._centers = {
            actor.name: centers.get(actor.name, actor.bounds.mean(axis=0)) for actor in scene.actors
        }

    def simulate(
        self, request: SweepRequest, is_wanted: Callable[[], bool] = lambda: True
    ) -> SensorPoints | None:
        """Simulate a sweep.

        The result depends only on the request. The sweep begins at the start of the frame, and the
        poses in between are interpolated. Actors that move in the scenario are only in the scene if
        the request contains them.

        Parameters
        ----------
        request
            The poses.
        is_wanted
            Function that is called after earlier sweeps have been simulated. If it returns False,
            the sweep is not simulated, and the result is None.

        Raises
        ------
        LidarError
            If the duration of the frame does not match the sensor, if a pose is too far away, or if
            an object is unknown.
        """
        frame_s = (request.end_us - request.start_us) / 1e6
        if not abs(frame_s / self.period_s - 1) <= _MAX_STRETCH:
            raise LidarError(
                f"The frame lasts {format_rounded(frame_s * 1e3)} ms, but a sweep of {self.name} "
                f"lasts {format_rounded(self.period_s * 1e3)} ms. Set frame_end_us "
                "accordingly, or serve the sensor with another --rate-hz."
            )
        times_s = np.array([0.0, self.period_s])
        poses = request.sensor
        path = _trajectory(times_s, self._in_scene("The sensor", poses))
        moves = {**self._idle, **self._object_tracks(times_s, request.objects)}
        number = round(request.start_us / 1e6 / self.period_s) % _MAX_NUMBER
        with self._lock:
            if not is_wanted():
                return None
            if moves:
                self._scanner.move([*moves], [*moves.values()])
            cloud = self._scanner.sweep(path, number=number, start_s=0.0)
        offsets = np.asarray(cloud.positions, np.float64) - poses.positions[1]
        positions = rotate(offsets, poses.rotations[1].T)
        intensities = cloud.columns["reflectivity"].astype(np.float32) / np.float32(_FULL_SCALE)
        return SensorPoints(positions.astype(np.float32), intensities)

    def prepare(self) -> None:
        """Compile the loops by simulating sweeps, so that no request waits for the compilation."""
        duration_us = round(self.period_s * 1e6)
        for distance_m in (0.0, 0.1):
            positions = np.array([[0.0, 0, 1], [distance_m, 0, 1]]) + self._scanner.origin
            poses = FramePoses(positions, np.tile([0.0, 0, 0, 1], (2, 1)))
            objects = dict.fromkeys([*self._idle][:1], poses)
            self.simulate(SweepRequest(0, duration_us, poses, objects))

    def _object_tracks(
        self, times_s: Floats, objects: Mapping[str, FramePoses]
    ) -> dict[str, Trajectory]:
        """Return the trajectories of the actors that a request contains, by name."""
        table = np.tile(np.eye(4), (len(objects), 2, 1, 1))
        for rows, (name, poses) in zip(table, objects.items(), strict=True):
            if name not in self._idle:
                raise LidarError(
                    f"The scene has no actor {printable(name)!r}.{name_hint(name, [*self._idle])}"
                )
            rotations = poses.rotations
            rows[:, :3, :3] = rotations
            # The frame of an actor is that of its mesh.
            offsets = [matvec(rotation, self._centers[name]) for rotation in rotations]
            rows[:, :3, 3] = self._in_scene(f"The object {name!r}", poses).positions - offsets
        return dict(zip(objects, Track.from_matrices(times_s, table, "hold"), strict=True))

    def _in_scene(self, subject: str, poses: FramePoses) -> FramePoses:
        """Convert poses to local coordinates.

        Raise LidarError if a pose is so far away that its points cannot be stored.
        """
        scanner = self._scanner
        positions = poses.positions - scanner.origin
        limit_m = _MAX_STEPS * scanner.survey.precision_m
        if not (np.abs(positions) <= limit_m).all():
            raise LidarError(
                f"{subject} is more than {limit_m / 1e3:,.0f} km from the origin of the scene. "
                "Poses must be in the world coordinates of the scenario, in meters."
            )
        return poses._replace(positions=positions)


@dataclass(frozen=True, eq=False)
class ServedScene:
    """A scene that is served, and its sensors.

    Attributes
    ----------
    name
        Name of the scene in requests.
    sensors
        Sensors by the number of the device in requests.
    actors
        Names of the actors.
    drive
        Trajectory of the sensor or its platform in the scenario, or None if it has only poses.
    """

    name: str
    sensors: Mapping[int, ServedSensor]
    actors: Collection[str]
    drive: Drive | None


def load_served_scene(
    path: Path,
    models: Mapping[int, str],
    report: Callable[[str], None],
    *,
    name: str | None = None,
    rate_hz: float | None = None,
    backend: str | None = None,
) -> ServedScene:
    """Read the scenario of a scene, and build its sensors.

    Parameters
    ----------
    path
        Scenario, mesh file, or folder that `lidarpool twin` has written.
    models
        Model or file of each sensor, by the number of the device in requests.
    report
        Function that is called with notes about the scene.
    name
        Name of the scene in requests. The default is that of the file or folder.
    rate_hz
        Sweeps per second of all sensors. The default is that of each model.
    backend
        Ray-casting backend, as in `Scanner`. The default is that of the scenario.

    Raises
    ------
    LidarError
        If a file cannot be read.
    """
    file = path
    if path.is_dir():
        file = path / SCENARIO_FILE
        if not file.is_file():
            raise MissingFileError(
                f"{path} contains no {SCENARIO_FILE}. Specify a scenario, or a folder that "
                "lidarpool twin has written."
            )
    scenario = Scenario.load(file).model_copy(update={"output": OutputSection(write=())})
    prepared = prepare(scenario, plans=False)
    for note in (*prepared.findings.notes, *_unused_fields(scenario)):
        report(note)
    scene = prepared.scene
    centers = _box_centers(scenario)
    chosen = backend or scenario.pool.backend
    built: dict[str, ServedSensor] = {}  # by model
    for model in dict.fromkeys(models.values()):
        sensor = _with_model(scenario, model, rate_hz)
        options = {**sensor.options, "materials": prepared.survey.materials}
        built[model] = ServedSensor(scene, sensor._replace(options=options), centers, chosen)
    for served in built.values():
        served.prepare()
    trajectory = prepared.survey.trajectory
    return ServedScene(
        name or path.resolve().name.removesuffix(file.suffix),
        {device: built[model] for device, model in models.items()},
        tuple(actor.name for actor in scene.actors),
        _drive(trajectory, scene.origin) if isinstance(trajectory, Track) else None,
    )


def _unused_fields(scenario: Scenario) -> Iterator[str]:
    """Yield a note about the fields of a scenario that would change points, but are not used."""
    unused = SensorsFile.from_scenario(scenario).unused
    # Requests contain the poses and times of the sensor.
    names = [name for name in unused if name not in ("poses", "trajectory", "steps")]
    if names:
        yield f"{scenario.source}: These fields are not used: {', '.join(names)}."


def _with_model(scenario: Scenario, model: str, rate_hz: float | None) -> SensorOnFrame:
    """Return a sensor with the given model, and with the noise and weather of a scenario."""
    is_file = model.endswith((".yaml", ".yml"))
    section = SensorSection(
        model=str(Path(model).absolute()) if is_file else model, rate_hz=rate_hz
    )
    update = {"sensor": section, "sensors": {}, "mount": None}
    (sensor,) = SensorsFile.from_scenario(scenario).model_copy(update=update).sensors_on_frames()
    return sensor


def _box_centers(scenario: Scenario) -> dict[str, Floats]:
    """Return the box centers of the actors that `lidarpool twin` has reconstructed.

    The meshes of these actors contain only the observed sides, so the sizes of the boxes are read
    from the report of the twin. The bottom face of a box is centered at the origin of the actor.
    """
    figures = scenario.path(FIGURES_FILE)
    recorded = {
        entry.name
        for entry in scenario.actors
        if entry.file is not None and str(entry.file.file).startswith(f"{ACTORS_FOLDER}/")
    }
    if not recorded or not figures.is_file():
        return {}
    with reading(str(figures)):
        return {
            actor["name"]: np.array([0.0, 0.0, actor["size_m"][2] / 2])
            for actor in json.loads(read_input(figures))["actors"]
            if actor["name"] in recorded
        }


def _idle_trajectory(actor: Actor) -> Trajectory:
    """Return the trajectory of an actor that is not in a request."""
    path = actor.trajectory
    if not path.moves:
        return path
    if isinstance(path, Track):
        positions, rotations = full_poses(path, 0, _knots_ns(path))
        if (positions == positions[0]).all() and (rotations == rotations[0]).all():
            return StaticPose(positions[0], rotations[0])
    return _ABSENT


def _trajectory(times_s: Floats, poses: FramePoses) -> StaticPose | Track:
    """Return the trajectory of the sensor in local coordinates, which is static if possible."""
    if all((start == end).all() for start, end in poses):
        return StaticPose(poses.positions[0], poses.rotations[0])
    return Track(times_s, *poses)


def _drive(track: Track, origin: Floats) -> Drive:
    """Return the poses of a track during the survey."""
    times_ns = _knots_ns(track)
    times_ns = times_ns[(times_ns >= 0) & (times_ns <= track.duration_ns)]
    positions, rotations = full_poses(track, 0, times_ns)
    return Drive(times_ns, positions + origin, quaternions_of(rotations))


def _knots_ns(track: Track) -> Floats:
    """Return the times of the poses of a track in nanoseconds since its start."""
    return (track.times_s - (track.start_s or 0.0)) * 1e9

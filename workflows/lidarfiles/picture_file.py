"""Store the data for a result's plots in a separate file.

The cloud is not included.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarsim.columns.table import CAUSES, TABLE, Column, names_by_value
from lidarsim.io.archives import open_archive, pack_arrays
from lidarsim.media.materials import MaterialTable
from lidarsim.motion.trajectory import ALWAYS, Beyond, Track, mounted_poses, presence_ns
from lidarsim.numerics.arrays import AnyArray, Floats, Floats32, Ints32
from lidarsim.scene.actors import Actor, distinct_meshes, samples_per_actor
from lidarsim.scene.animation import Animation
from lidarsim.scene.colors import Colors
from lidarsim.scene.scene import Scene
from lidarsim.scene.scene_mesh import SceneMesh
from lidarsim.scene.simplified import SimplifiedScene, cut_masks
from lidarsim.survey.survey import Survey
from lidarsim.sweeps.sweeps import number_positions
from lidarsim.words import format_rounded, plural

PICTURE_FILE = "pictures.npz"

MAX_MODELS = 4  # maximum number of sensor models in a caption
MAX_POSITIONS = 1000  # maximum number of positions of a moving sensor or actor
_FORMAT = 6
# {name in the file: field of an actor's track}
_TRACK = {"times": "times_s", "positions": "positions", "quaternions": "quaternions"}
# {name in the file: field of a planned path}
_PATH_LENGTHS = {
    "length": "length_m",
    "shortest_possible": "shortest_m",
    "clearance": "clearance_m",
}


@dataclass(frozen=True, eq=False)
class SensorPositions:
    """Positions of a sensor over time."""

    times_ns: Floats  # (k,) ascending, relative to the start of the survey
    positions: Floats  # (k, 3) local, in meters
    moves: bool = False  # if False, the sensor stays at each position until the next time
    name: str = ""  # empty for a single sensor
    model: str = ""

    @property
    def labels(self) -> list[str]:
        """Label of each position, with the same numbers as in the plot of stations.

        A position that the sensor returns to keeps its first number. If the sensor stays at one
        position, the label is the name of the sensor. A moving sensor has no labels.
        """
        if self.moves or not len(self.positions):
            return []
        numbers = number_positions(self.positions)
        if numbers.max() == 1:
            return [self.name] * len(self.positions)
        return [f"{self.name} {number}".strip() for number in numbers.tolist()]

    def position_at(self, time_ns: float) -> Floats:
        """Return the position at a given time."""
        if self.moves:
            return np.array([np.interp(time_ns, self.times_ns, x) for x in self.positions.T])
        last = int(np.searchsorted(self.times_ns, time_ns, "right")) - 1
        return np.asarray(self.positions[max(last, 0)])


@dataclass(frozen=True, eq=False)
class PlannedPath:
    """The best path of a path search in the plane."""

    corners: Floats  # (w, 2) from start to target, local, in meters
    length_m: float
    shortest_m: float  # length of the shortest path, infinite if discs block the target
    # Distance to the nearest disc, which is negative inside a disc and infinite without discs.
    clearance_m: float
    trials: Sequence[Floats] = ()  # (w, 2) corners of each trial's path, without its ends

    @property
    def excess(self) -> float:
        """Relative excess over the shortest length.

        For example, 0.01 means that the path is 1 % longer.
        """
        return self.length_m / self.shortest_m - 1


@dataclass(frozen=True, eq=False)
class PlanningPicture:
    """A path search in the plane.

    Coordinates are local and in meters.
    """

    start: tuple[float, float]
    target: tuple[float, float]
    centers: Floats  # (m, 2) centers of the discs to avoid
    radii: Floats  # (m,) radii of the discs
    best: PlannedPath | None = None  # None until all trials have finished


@dataclass(frozen=True, eq=False)
class PictureContent:
    """The data for a result's plots, except the points."""

    scene: Scene  # its actors have trajectories of at most `MAX_POSITIONS` positions
    sensors: Sequence[SensorPositions]
    hit_counts: AnyArray  # (f,) hits on each triangle, with the actors' triangles last
    sample_rays: Floats32  # (k, 2, 3) start and end points of some rays, local, in meters
    planning: PlanningPicture | None = None
    duration_ns: float = 0.0  # duration of the survey
    extra_columns: Sequence[Column] = ()  # columns of the cloud that are not in `TABLE`
    # (objects,) fraction of light that each object reflects, with actors last; None if unknown.
    reflectance: Floats | None = None
    coordinates: str = "world"  # frame of the points; the scene is not shown if it is "sensor"
    triangles: int = 0  # number of triangles in the scene; drawn instances may be simplified
    classes: Sequence[str] | None = None  # names of the classes 0, 1, 2, …
    materials: Sequence[str] | None = None  # names of the materials 0, 1, 2, …
    face_materials: Ints32 | None = None  # (f,) material of each static triangle, -1 for none
    # (objects,) class of each object, with actors last; None if unknown. The first class counts.
    object_classes: NDArray[np.uint16] | None = None
    keep_every: int = 1  # the cloud contains one of this many hits of a scan

    @classmethod
    def before_casting(
        cls, scene: Scene, survey: Survey, planning: PlanningPicture | None = None
    ) -> tuple[PictureContent, SimplifiedScene]:
        """Return the data that is known before rays are cast, and the scene to draw.

        The scene to draw converts hits on the triangles of the original scene to `hit_counts`.
        """
        samples = samples_per_actor(scene.actors, MAX_POSITIONS)
        actors = tuple(_sampled(actor, survey.duration_ns, samples) for actor in scene.actors)
        sensors = sensor_positions(survey)
        positions = [sensor.positions for sensor in sensors]
        drawn = SimplifiedScene.from_scene(cut_masks(scene), near_positions=positions)
        wavelength_nm = survey.mounted_sensors[0].sensor.optics.simulated_nm  # the first sensor
        kinds = scene.surface_kinds
        materials = MaterialTable.build(survey.materials, kinds, wavelength_nm, scene.has_voxels)
        content = cls(
            scene=replace(drawn.scene, actors=actors),
            sensors=sensors,
            hit_counts=np.zeros(0, np.int64),
            sample_rays=np.zeros((0, 2, 3), np.float32),
            planning=planning,
            duration_ns=survey.duration_ns,
            extra_columns=[
                replace(c, source="") for c in survey.stored_columns if c.name not in TABLE
            ],
            reflectance=materials.reflectance[kinds.first[:-1]],
            coordinates=survey.coordinates,
            triangles=scene.triangles,
            classes=names_by_value(survey.classes),
            materials=scene.material_names,
            face_materials=drawn.scene.face_materials,
            object_classes=materials.semantic_class[kinds.first[:-1]],
            keep_every=survey.keep_every,
        )
        return content, drawn

    @property
    def caption(self) -> str:
        """Caption with the number of sensors and, if anything moves, the displayed time.

        Plots show the middle of the survey.
        """
        sensors = len(self.sensors)
        actors = len(self.scene.actors)
        if any(sensor.moves for sensor in self.sensors):
            words = plural(sensors, "moving sensor")
        else:
            positions = sum(len(sensor.positions) for sensor in self.sensors)
            words = plural(positions, "sensor position")
            if not actors:
                return words
        words += f" and {plural(actors, 'actor')}" if actors else ""
        duration_s = self.duration_ns / 1e9
        return f"{words}, at {format_rounded(duration_s / 2)} s of {format_rounded(duration_s)} s"

    @property
    def models(self) -> str:
        """Models of all sensors as text. Each is preceded by the sensor's name if it has one."""
        models = [
            f"{sensor.name}: {sensor.model}" if sensor.name else sensor.model
            for sensor in self.sensors
        ]
        hidden = len(models) - MAX_MODELS
        if hidden > 0:
            models[MAX_MODELS:] = [f"and {hidden:,} more"]
        return " · ".join(models)

    def names_of(self, column: Column) -> Sequence[str]:
        """Return the names of the values 0, 1, 2, … in a column.

        The sequence is empty if the values have no names.
        """
        if column.name == "sensor":
            return [sensor.name for sensor in self.sensors]
        if column == TABLE["cause"]:
            return CAUSES
        names = {
            "object": self.scene.object_names,
            "class": self.classes,
            "material": self.materials,
        }
        return names.get(column.name) or ()

    def save(self, path: Path) -> None:
        """Write the data to a NumPy archive.

        The same data always results in the same bytes.
        """
        names = {
            "objects": self.scene.names,
            "actors": [actor.name for actor in self.scene.actors],
            "sensors": [[sensor.name, sensor.model, sensor.moves] for sensor in self.sensors],
            "own": [asdict(column) for column in self.extra_columns],
            "coordinates": self.coordinates,
            "triangles": self.triangles,
            **({"classes": self.classes} if self.classes else {}),
            **({"materials": self.materials} if self.materials else {}),
            **({"keep_every": self.keep_every} if self.keep_every > 1 else {}),
        }
        arrays: dict[str, Any] = {
            "format": _FORMAT,
            "vertices": self.scene.vertices,
            "faces": self.scene.faces,
            "face_object": self.scene.face_object,
            # NumPy would pad strings to the longest and strip trailing null characters.
            "names": np.frombuffer(json.dumps(names).encode(), np.uint8),
            "origin": self.scene.origin,
            "duration_ns": self.duration_ns,
            "hit_counts": self.hit_counts,
            "sample_rays": self.sample_rays,
        }
        if self.reflectance is not None:
            arrays["reflectance"] = self.reflectance
        if self.face_materials is not None:
            arrays["face_materials"] = self.face_materials
        if self.object_classes is not None:
            arrays["object_classes"] = self.object_classes
        if self.scene.colors is not None:
            arrays["colors"] = self.scene.colors.mean_colors()
        arrays |= self._track_arrays() | self._mesh_arrays() | self._planning_arrays()
        path.write_bytes(pack_arrays(arrays))

    def _track_arrays(self) -> dict[str, Any]:
        """Return sensor positions and actor trajectories as named arrays."""
        arrays: dict[str, Any] = {}
        for number, sensor in enumerate(self.sensors):
            arrays[f"sensor{number}_times"] = sensor.times_ns
            arrays[f"sensor{number}"] = sensor.positions
        for number, actor in enumerate(self.scene.actors):
            if not isinstance(actor.trajectory, Track) or actor.trajectory.smooth:
                raise TypeError(f"the trajectory of actor {actor.name!r} is not sampled")
            track = actor.trajectory.with_turns
            arrays |= {f"actor{number}_{n}": getattr(track, field) for n, field in _TRACK.items()}
            arrays[f"actor{number}_absent"] = track.beyond == "absent"
            if actor.mesh.animation is not None:
                arrays[f"actor{number}_offset"] = actor.offset_s
        return arrays

    def _mesh_arrays(self) -> dict[str, Any]:
        """Return the meshes of actors and their animations as named arrays."""
        arrays: dict[str, Any] = {}
        meshes, arrays["actor_mesh"] = distinct_meshes(actor.mesh for actor in self.scene.actors)
        for number, mesh in enumerate(meshes):
            arrays |= {f"mesh{number}_vertices": mesh.vertices, f"mesh{number}_faces": mesh.faces}
            if mesh.colors is not None:
                arrays[f"mesh{number}_colors"] = mesh.colors.mean_colors()
            if (animation := mesh.animation) is not None:
                # Differences compress to a third of the size.
                steps = np.diff(animation.vertices, axis=0, prepend=0)
                arrays[f"mesh{number}_steps"] = steps.astype(np.float32)
                arrays[f"mesh{number}_played"] = [
                    animation.step_s,
                    animation.speed_m_s or 0,
                    animation.repeat,
                ]
        return arrays

    def _planning_arrays(self) -> dict[str, Any]:
        """Return the path search and its best path as named arrays.

        The mapping is empty if there is no best path.
        """
        planning = self.planning
        if planning is None or planning.best is None:
            return {}
        best = planning.best
        return {
            "ends": [planning.start, planning.target],
            "centers": planning.centers,
            "radii": planning.radii,
            "path": best.corners,
            "waypoints": np.array(best.trials),
            **{name: getattr(best, field) for name, field in _PATH_LENGTHS.items()},
        }

    @classmethod
    def load(cls, path: Path) -> PictureContent:
        """Read a file that `save` has written.

        The file cannot contain executable code. Raises LidarError if the file is damaged.
        """
        with open_archive(path) as archive:
            return cls._from_arrays(archive)

    @classmethod
    def load_from(cls, folder: Path) -> PictureContent | None:
        """Read the plot data in a result folder, or return None if there is none."""
        path = folder / PICTURE_FILE
        return cls.load(path) if path.exists() else None

    @classmethod
    def _from_arrays(cls, arrays: Mapping[str, Any]) -> PictureContent:
        """Build the plot data from the arrays in a file.

        Raises ValueError if the file has another format version.
        """
        if (version := int(arrays["format"])) != _FORMAT:
            raise ValueError(f"its format version is {version}; expected {_FORMAT}")
        names = json.loads(arrays["names"].tobytes())
        mesh_of_actor = arrays["actor_mesh"].tolist()
        meshes = [
            SceneMesh(
                "",
                arrays[f"{mesh}_vertices"],
                arrays[f"{mesh}_faces"],
                colors=_colors(arrays, f"{mesh}_colors"),
                animation=_animation(arrays, mesh),
            )
            for mesh in (f"mesh{number}" for number in range(max(mesh_of_actor, default=-1) + 1))
        ]
        actors = []
        for number, name in enumerate(names["actors"]):
            times, positions, rotations = (arrays[f"actor{number}_{part}"] for part in _TRACK)
            beyond: Beyond = "absent" if arrays[f"actor{number}_absent"] else "hold"
            track = Track(times, positions, rotations, start_s=0.0, beyond=beyond)
            offset_s = float(arrays.get(f"actor{number}_offset", 0))  # animated actors have one
            mesh = replace(meshes[mesh_of_actor[number]], name=name)
            actors.append(Actor(mesh, track, offset_s))
        scene = Scene(
            arrays["vertices"],
            arrays["faces"],
            arrays["face_object"],
            tuple(map(str, names["objects"])),
            arrays["origin"],
            tuple(actors),
            colors=_colors(arrays, "colors"),
        )
        sensors = [
            SensorPositions(arrays[f"sensor{k}_times"], arrays[f"sensor{k}"], moves, name, model)
            for k, (name, model, moves) in enumerate(names["sensors"])
        ]
        counts = arrays["hit_counts"]
        if counts.shape != (scene.triangles,):
            raise ValueError(f"hit_counts has shape {counts.shape}; expected ({scene.triangles},)")
        return cls(
            scene=scene,
            sensors=sensors,
            hit_counts=counts,
            sample_rays=arrays["sample_rays"],
            planning=_planning(arrays) if "path" in arrays else None,
            duration_ns=float(arrays["duration_ns"]),
            extra_columns=[Column(**column) for column in names["own"]],
            reflectance=arrays.get("reflectance"),
            coordinates=names["coordinates"],
            triangles=names["triangles"],
            classes=names.get("classes"),
            materials=names.get("materials"),
            face_materials=arrays.get("face_materials"),
            object_classes=arrays.get("object_classes"),
            keep_every=names.get("keep_every", 1),
        )


def _planning(arrays: Mapping[str, Any]) -> PlanningPicture:
    """Return the path search and its best path from the arrays in a file."""
    lengths = {field: arrays[name].item() for name, field in _PATH_LENGTHS.items()}
    best = PlannedPath(arrays["path"], **lengths, trials=tuple(arrays["waypoints"]))
    (x0, y0), (x1, y1) = arrays["ends"].tolist()
    return PlanningPicture((x0, y0), (x1, y1), arrays["centers"], arrays["radii"], best)


def _colors(arrays: Mapping[str, Any], name: str) -> Colors | None:
    """Return the face colors in a file, or None if it has none."""
    return Colors.from_face_colors(arrays[name]) if name in arrays else None


def _animation(arrays: Mapping[str, Any], mesh: str) -> Animation | None:
    """Return the animation of a mesh in a file, or None if it has none."""
    if (steps := arrays.get(f"{mesh}_steps")) is None:
        return None
    step_s, speed, repeat = arrays[f"{mesh}_played"].tolist()
    return Animation(steps.cumsum(0, np.float64), step_s, speed or None, bool(repeat))


def sensor_positions(survey: Survey) -> list[SensorPositions]:
    """Return the positions of each sensor.

    These are its stations, or samples of its trajectory.
    """
    path = survey.path
    sensors: list[SensorPositions] = []
    first = 0
    for carried, steps in zip(survey.mounted_sensors, survey.steps_each, strict=True):
        stop = first + steps * path.stations
        scans: Iterable[int] = range(first, stop, steps)  # the first scan at each station
        if path.moves:
            scans = np.unique(np.linspace(first, stop - 1, MAX_POSITIONS).astype(int)).tolist()
        times = np.array([survey.begins_ns(scan) for scan in scans])
        if path.moves:
            positions, _ = mounted_poses(path, 0, carried.mount, times)
        else:
            at_start = np.zeros(1)
            found = [mounted_poses(path, k, carried.mount, at_start) for k in range(path.stations)]
            positions = np.concatenate([position for position, _ in found])
        sensors.append(
            SensorPositions(times, positions, path.moves, carried.name, carried.sensor.model)
        )
        first = stop
    return sensors


def moving_positions(
    sensors: Sequence[SensorPositions], actors: Sequence[Actor], duration_ns: float
) -> list[Floats]:
    """Return the positions that a plot of a survey with motion must show.

    These are the positions of the moving sensors or, if only actors move, of all sensors and
    actors. The result is empty without motion.
    """
    moving = [sensor.positions for sensor in sensors if sensor.moves]
    if moving or not actors:
        return moving
    times = np.linspace(0, duration_ns, MAX_POSITIONS)
    actor_positions = [actor.trajectory.poses(0, times)[0] for actor in actors]
    return [*(sensor.positions for sensor in sensors), *actor_positions]


def _sampled(actor: Actor, duration_ns: float, count: int) -> Actor:
    """Return an actor whose trajectory is sampled at `count` times during a survey."""
    times, positions, rotations = actor.samples(duration_ns, count)
    beyond: Beyond = "hold" if presence_ns(actor.trajectory) == ALWAYS else "absent"
    track = Track(times / 1e9, positions, rotations, start_s=0.0, beyond=beyond)
    sampled = replace(actor, trajectory=track)
    if (animation := actor.mesh.animation) is None:
        return sampled
    # The animation may depend on the distance along the trajectory. The sampled trajectory lacks
    # the part before the survey.
    missing_s = actor.seconds(times[:1])[0] - sampled.seconds(times[:1])[0]
    mesh = replace(actor.mesh, animation=animation.for_pictures)
    return replace(sampled, mesh=mesh, offset_s=actor.offset_s + float(missing_s[0]))

"""Scenario files: all of a survey as data, checked before anything runs."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from functools import partial
from glob import escape
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
from pydantic import PrivateAttr, ValidationError

from ..base.arrays import Floats
from ..base.declared import Several, Text, declared, told
from ..base.errors import LidarpoolError, Mistakes, prefixed
from ..base.validation import validation_errors
from ..base.words import counted, did_you_mean
from ..base.yamlfile import read_yaml
from ..columns.table import COLOURS, VELOCITY
from ..export.table import check_whole
from ..plan import Planning
from ..plan.planning import Search
from ..scene.actors import Actor, box, one_mesh
from ..scene.cityjson import CLASSES as CITY_CLASSES
from ..scene.instances import Instance
from ..scene.mesh import Mesh
from ..scene.meshfile import CITYJSON, SUFFIXES, UNITLESS, Objects, load_objects, wrote_it
from ..scene.nodes import Raster
from ..scene.robot import Robot
from ..scene.scene import Scene
from ..scene.shapes import seed_objects
from ..scene.urdf import load_robot
from ..sensor import Material, Mounted, Navigation, Noise, Pose, Returns, Survey, Track
from ..sensor.materials import MaterialTable, rows_named, with_class, with_classes
from ..sensor.survey import SENSORS_MOST, CloudOptions, Steps
from ..sensor.trajectory import CENTRE
from ..sensor.weather import Weather
from .copies import copies_of
from .moving import ActorSection, CarriedSection, MountSection, TrajectoryEntry
from .placing import Placing, inside_note, place
from .sections import (
    CopiesSection,
    MeshFile,
    NoiseSection,
    OutputSection,
    PlanningSection,
    PoolSection,
    PoseEntry,
    ReturnsSection,
    SceneSection,
    Section,
    SensorSection,
    may_be_empty,
    scene_in_short,
)
from .standing import Standing
from .traffic import TrafficSection, VehicleSection, actors_of, read_fcd

# Objects lower than this are floors and markings, which a path may cross.
FLAT_M = 0.2

# Sizes of scenes in metres are between these. An .stl is mostly a part, in millimetres; an object
# to look at from outside is rarely longer than a bus. glTF is in metres, and some exporters write
# millimetres.
LARGE_M, LARGE_STL_M, LARGE_OBJECT_M, LARGE_STATED_M, SMALL_M = 500.0, 20.0, 10.0, 100.0, 0.2

SEED_START = (25.0, 25.0)
SEED_TARGET = (-30.0, -20.0)
SEED_POSES = tuple(Pose((0.0, 0.0, height)) for height in (1.0, 2.0, 3.0))
_LOOKED_FROM = 8  # positions, if poses or a trajectory are given

# Of the hits in a scene with the default objects, every so many are kept.
SEED_KEPT = 5

# The cloud of a mesh file without a scenario.
MESH_CLOUD = {"precision_m": 0.001}


@dataclass
class Findings:
    """What was noted when a scene was built."""

    notes: list[str] = field(default_factory=list)  # about objects left out of the scene
    remarks: list[str] = field(default_factory=list)  # about axes of files
    sources: dict[str, str] = field(default_factory=dict)  # {file: what it gave}
    rasters: list[tuple[MeshFile, Raster]] = field(default_factory=list)

    def copy(self) -> Findings:
        """Return the same, to be added to."""
        return Findings(*(found.copy() for found in vars(self).values()))


class Still(NamedTuple):
    """The still part of a scenario's scene, and what was noted when it was built."""

    scene: Scene
    standing: Standing
    found: Findings


class KeptScenes:
    """Still parts of the scenes that scenarios had last, for others that have the same."""

    def __init__(self, most: int = 4) -> None:
        self._most, self._kept = most, dict[object, Still]()

    def find(self, key: object, make: Callable[[], Still]) -> Still:
        """Return what is kept under a key, or what `make` makes."""
        found = self._kept.pop(key, None) or make()
        self._kept[key] = found  # the last used
        while len(self._kept) > self._most:
            del self._kept[next(iter(self._kept))]
        return found


class Scenario(Section):
    """A survey and its path planning, as described by a scenario file.

    Without arguments it is the default survey: six objects, 108 scans from three poses.

    Parameters
    ----------
    scene, sensor, materials, returns, noise, weather, navigation, cloud, output, planning, pool
        See `lidarpool.scenario.sections`.
    poses
        Poses of the sensor, in world coordinates. By default it stands at the origin (default
        objects), 1, 2 and 3 metres above the ground; in mesh files where `place` puts it: in the
        middle of a room or landscape, or around an object.
    steps
        Time steps from each pose.

    Raises
    ------
    pydantic.ValidationError
        If a value is out of range; `load` and `from_data` raise LidarpoolError.
    """

    scene: Annotated[SceneSection, scene_in_short] = SceneSection()
    sensor: Annotated[SensorSection, may_be_empty(SensorSection)] = SensorSection()
    poses: Annotated[
        Several[PoseEntry] | None,
        told(
            "poses of the sensor, world metres, Z-up; by default 1, 2 and 3 m "
            "above the origin (default objects) or the middle of the floor (files), below the "
            "ceiling, or around an object that is no place to stand in",
            [[0, 0, 1], [0, 0, 2], {"position": [0, 0, 3], "yaw_deg": 90}],
            min_length=1,
            max_length=1_000_000,
        ),
    ] = None
    trajectory: Annotated[
        TrajectoryEntry | None,
        told(
            "instead of poses: the trajectory of a carrier, from a TUM, KITTI or "
            ".csv file, or points",
            "drive.tum",
        ),
    ] = None
    sensors: Annotated[
        dict[Text, CarriedSection],
        told(
            "instead of sensor: several on one carrier, by name, each with its mount",
            {"front": {"model": "velodyne/vlp16", "mount": {"position": [2, 0, 0.5]}}},
            max_length=SENSORS_MOST,
        ),
    ] = {}  # noqa: RUF012 - of a frozen model
    actors: Annotated[
        Several[ActorSection],
        told(
            "moving objects: meshes, boxes or robots; one without a trajectory is the carrier",
            [{"name": "Van", "box": [5, 2, 2.2], "trajectory": "van.tum", "class": 3}],
            max_length=10_000,
        ),
    ] = ()
    traffic: Annotated[
        TrafficSection | None,
        told(
            "vehicles and persons of a SUMO simulation, as actors",
            {"file": "fcd.xml", "vehicles": [{"box": [4.5, 1.8, 1.5], "class": 10}]},
        ),
    ] = None
    mount: Annotated[
        MountSection | None,
        told(
            "pose of the sensor on its carrier, in the carrier's axes",
            {"position": [1, 0, 2], "pitch_deg": 10},
        ),
    ] = None
    steps: Annotated[
        Steps | None,
        told(
            "time steps (scans) at each pose; by default along a trajectory as many as fit into it",
            36,
        ),
    ] = None
    materials: Annotated[
        Several[Material],
        told(
            "materials of objects, by name; the last entry for an object counts",
            [{"objects": "*", "reflectance": 0.3}, {"objects": "Window*", "transparent": "pass"}],
            max_length=100_000,
        ),
    ] = ()
    returns: Annotated[ReturnsSection, may_be_empty(ReturnsSection)] = ReturnsSection()
    noise: Annotated[NoiseSection, may_be_empty(NoiseSection)] = NoiseSection()
    weather: Annotated[Weather, may_be_empty(Weather)] = Weather()
    navigation: Annotated[
        Navigation | None,
        told(
            "IMU and GNSS receiver of the carrier, with errors that drift",
            {"imu": {"rate_hz": 200}, "gnss": {"rate_hz": 10}},
        ),
    ] = None
    cloud: Annotated[CloudOptions, may_be_empty(CloudOptions)] = CloudOptions()
    output: Annotated[OutputSection, may_be_empty(OutputSection)] = OutputSection()
    planning: Annotated[PlanningSection, may_be_empty(PlanningSection)] = PlanningSection()
    pool: Annotated[PoolSection, may_be_empty(PoolSection)] = PoolSection()

    _folder: Path = PrivateAttr(default=Path())  # that relative file names start from
    _source: str = PrivateAttr(default="the default survey")  # for messages
    _found: Findings = PrivateAttr(default_factory=Findings)
    _robots: dict[MeshFile, Robot] = PrivateAttr(default_factory=dict)  # {their file: robot}
    _vehicles: list[int | None] = PrivateAttr(default_factory=list)  # classes of the last actors
    # Triangles of a scene, and the trajectory there.
    _way: tuple[Any, Track] | None = PrivateAttr(default=None)
    _epsg: int | None = PrivateAttr(default=None)  # of the rasters, where they are in their place
    _placing: Placing | None = PrivateAttr(default=None)  # if no poses are given

    @classmethod
    def load(cls, path: str | Path) -> Scenario:
        """Read a scenario file (YAML), or make a scenario of a mesh file.

        Raises
        ------
        LidarpoolError
            With the file, the field, what was given and what is allowed.
        """
        path = Path(path)
        mesh = path.suffix.lower() in SUFFIXES
        data = {"scene": {"files": [path.name]}, "cloud": MESH_CLOUD} if mesh else read_yaml(path)
        return cls.from_data(data, source=str(path), folder=path.parent)

    @classmethod
    def from_data(
        cls, data: dict[str, Any], *, source: str = "scenario", folder: str | Path = "."
    ) -> Scenario:
        """Check the content of a scenario file.

        Parameters
        ----------
        data
            Sections as YAML gives them.
        source
            Name for messages.
        folder
            Where relative file names start from.

        Raises
        ------
        LidarpoolError
            As `load`.
        """
        mistakes, scenario = Mistakes(), None
        while scenario is None:
            try:
                scenario = cls.model_validate(data)
            except ValidationError as error:
                told = validation_errors(error, cls)
                mistakes.lines += [f"{source}: {line}" for line in told]
                # Validate again without the wrong sections, to find further errors.
                wrong = {str(detail["loc"][0]) for detail in error.errors() if detail["loc"]}
                if not wrong:
                    mistakes.tell()
                data = {name: value for name, value in data.items() if str(name) not in wrong}
        scenario._folder, scenario._source = Path(folder), source
        scenario._check(mistakes)
        mistakes.tell()
        return scenario

    def _check(self, mistakes: Mistakes) -> None:
        """Note fields that do not fit together, and missing files if there are other errors.

        If nothing else is wrong, reading them reports it.
        """
        wrong, planning = [], self.planning
        # The default objects have a start and a target.
        missing = 0 if self.scene.has_seed else [planning.start, planning.target].count(None)
        if planning.enabled and missing:
            wrong.append("planning is enabled: give planning.start and planning.target.")
        if planning.enabled is None and missing == 1:
            wrong.append("give both planning.start and planning.target, or neither.")
        if self.trajectory is not None and self.trajectory.beyond != "refuse":
            wrong.append("trajectory.beyond is for actors; the carrier's has to cover the survey.")
        if self.trajectory is not None and self.poses is not None:
            wrong.append("give either poses or a trajectory, not both.")
        carried = [entry for entry in self.actors if entry.trajectory is None]
        if carried and self.trajectory is None:
            wrong.append(
                f"actor {carried[0].name!r} has no trajectory: give it one, or give the survey a "
                "trajectory in place of poses, to be its carrier."
            )
        if self._links and not any(entry.is_robot for entry in carried):
            wrong.append(
                "mount names a link, and no robot is the carrier: give an actor with a .urdf as "
                "its file, and without a trajectory."
            )
        copies = [entry.name for entry in self.scene.copies]
        named = Counter([*copies, *(entry.name for entry in self.actors)])
        if twice := next((name for name in copies if named[name] > 1), None):
            wrong.append(
                f"{twice!r} is the name of two entries of scene.copies and actors: give each its "
                "own."
            )
        if self.sensors and (self.sensor != SensorSection() or self.mount):
            wrong.append("give either sensor and mount, or sensors, each with a mount.")
        mistakes.lines += [f"{self._source}: {words}" for words in wrong]
        for section in self.sensors.values() or (self.sensor,):
            if section.calibration is None:
                with mistakes.noted(), prefixed(self._source):
                    one = section.mounted(self._folder, CENTRE, self.noise, self.returns)
                    (one.returns or self.returns).of(one.sensor.optics)
        for path in self.files if mistakes.lines else ():
            if not os.path.exists(path):  # noqa: PTH110 - also of names that no file can have
                mistakes.lines.append(f"{self._source}: {str(path)!r} does not exist.")

    @property
    def files(self) -> tuple[Path, ...]:
        """Files that it names, each once: meshes, tables, trajectories, data of sensors."""
        placed: tuple[CopiesSection | ActorSection, ...] = (*self.scene.copies, *self.actors)
        shaped = (*placed, *(self.traffic.vehicles if self.traffic else ()))
        entries = [*self.scene.files, *(entry.file for entry in shaped if entry.file)]
        files: list[str | None] = [entry.file for entry in entries]
        files += [self.traffic.file] if self.traffic else []
        files += [entry.table.file for entry in self.scene.copies if entry.table]
        files += [entry.joints for entry in self.actors]
        for way in (self.trajectory, *(entry.trajectory for entry in self.actors)):
            files += [way.file, way.times] if way else []
        for section in (self.sensor, *self.sensors.values()):
            files += [section.calibration]
            files += [section.model] if section.has_own_model else []
        out = []
        for file in dict.fromkeys(file for file in files if file):
            with suppress(LidarpoolError):  # of a user who is not known
                out.append(self._path(file))
        return tuple(out)

    def advice(self, scene: Scene) -> list[str]:
        """Return notes on likely mistakes, such as a size that suggests another unit.

        Also on objects that `build_scene` left out, on files whose axes it guessed, on where the
        sensor is, and on settings without effect.
        """
        notes = [*self._found.notes, *self._found.remarks[:1]]
        if self._found.remarks[1:]:
            notes[-1] += f"; {counted(len(self._found.remarks) - 1, 'more file')}, too"
        poses = self._of_poses(scene)  # first, because that finds out whether it is an object
        some = filter(None, (self._of_size(scene), poses, self._of_colours(scene)))
        return [*notes, *some, *self._idle()]

    @property
    def sources(self) -> dict[str, str]:
        """What `build_scene` read: {file: a line on what it gave}."""
        return dict(self._found.sources)

    def _idle(self) -> Iterator[str]:
        """Tell of settings that another one keeps from having an effect."""
        written = {entry.format for entry in self.output.write}
        if self.cloud.waveform_samples and not {"las", "laz"} & written:
            yield (
                "cloud.waveform_samples: only LAS and LAZ files hold waveforms, and none is "
                "written: add output: {write: [las]}"
            )
        if self.weather.fog_lidar_ratio_sr is not None and self.weather.visibility_km is None:
            yield "weather.fog_lidar_ratio_sr without weather.visibility_km is no fog"
        if self.noise.stray_light and not any(entry.retro for entry in self.materials):
            yield "noise.stray_light needs materials with retro: true, and there are none"
        way, imu = self.trajectory, self.navigation and self.navigation.imu
        if imu and way and way.interpolation == "linear" and len(way.points) != 2:
            yield "navigation.imu has jumps at linear poses: give trajectory.interpolation: smooth"
        if self.noise.velocity_m_s and VELOCITY not in self.cloud.columns:
            yield f"noise.velocity_m_s is that of the column {VELOCITY}: add it to cloud.columns"

    def _of_colours(self, scene: Scene) -> str:
        if not self.coloured:
            return ""
        if not scene.coloured:
            return (
                "a column or reflectance: texture needs colours, but nothing in the scene has any, "
                "so that all is grey"
            )
        names = scene.all_names
        table = MaterialTable.of(self._materials(scene), names, voxels=scene.has_voxels)
        textured = table.scale > 0
        if not len(grey := np.flatnonzero(textured & ~scene.has_colours)):
            return ""
        shown = ", ".join(names[i] for i in grey[:3]) + ", …" * (len(grey) > 3)
        return (
            f"{len(grey):,} of {counted(int(textured.sum()), 'object')} with reflectance: texture "
            f"have no colours and are grey: {shown}"
        )

    def _of_size(self, scene: Scene) -> str:
        files = [entry.file for entry in self.scene.files if entry.unit is None]
        files = [file for file in files if not file.lower().endswith(CITYJSON)]  # towns are large
        unitless = [
            f for f in files if f.lower().endswith(UNITLESS) and not wrote_it(self._path(f))
        ]
        side = float(np.ptp(scene.bounds, axis=0).max())
        parts = any(file.lower().endswith(".stl") for file in unitless)
        least, large = SMALL_M, LARGE_STL_M if parts else LARGE_M
        if around := self._placing is not None and self._placing.around:
            least, large = 0.0, LARGE_OBJECT_M if unitless else LARGE_STATED_M
        if not (unitless or (around and files)) or least <= side <= large:
            return ""
        unit = "mm" if side > large else "km"
        said = "states no unit" if unitless else "is in metres by its format"
        return (
            f"{(unitless or files)[0]} {said}, and in metres the scene is {side:,.5g} m long. If "
            f"that is wrong, give the file's unit ({unit}?) in scene.files (lidarpool init DIR "
            f"--mesh FILE --unit {unit} writes such a scenario)"
        )

    def _of_poses(self, scene: Scene) -> str:
        if self.poses is None and self.trajectory is None:
            return "" if self.scene.has_seed else self.placing(scene).note
        if self.scene.has_seed:
            return ""
        if self.trajectory is not None:
            track = self._track(scene)
            at, _ = track.poses(0, np.linspace(0, track.duration_ns, _LOOKED_FROM))
        else:
            positions = [pose.position for pose in self._world_poses(scene)]
            at = np.array(positions[:: -(-len(positions) // _LOOKED_FROM)]) - scene.origin
        return inside_note(scene, at, self._carried()[0])

    def build_scene(self, kept: KeptScenes | None = None) -> Scene:
        """Read the mesh files and build the scene; its still part may be `kept` from another.

        Raises
        ------
        LidarpoolError
            If a mesh file cannot be read.
        """
        self._robots.clear()
        self._vehicles.clear()
        self._placing = None
        still = self._still() if kept is None else kept.find(self._of_scene, self._still)
        scene, standing = still.scene, still.standing
        self._found = still.found.copy()
        self._epsg = self._system()
        if not (self.actors or self.traffic):
            return scene
        with prefixed(self._source):
            carrier = None if self.trajectory is None else self._track(scene, standing)
        start = 0.0 if carrier is None else carrier.start_s
        assert start is not None  # of every track
        own, others = self._actors(standing, carrier), self._traffic(scene, standing, start)
        return scene.with_actors([*scene.actors, *own, *others])

    @property
    def _of_scene(self) -> object:
        """What the still part of the scene is made of: equal for scenarios that may share it."""
        names = [entry.file for entry in self.scene.files]
        for copies in self.scene.copies:
            names += [one.file for one in (copies.file, copies.table) if one is not None]
        states = []
        for name in names:
            with suppress(OSError, LidarpoolError):  # is told when it is read
                found = self._path(name).stat()
                states.append((name, found.st_mtime_ns, found.st_size))
        section = self.scene.model_dump_json()
        return section, str(self._folder), self.coloured, self.cloud.epsg, tuple(states)

    def _still(self) -> Still:
        """Build the scene without the actors and traffic of the scenario."""
        self._found = Findings()
        meshes: list[Mesh | Instance] = list(seed_objects()) if self.scene.has_seed else []
        moving: list[Actor] = []
        mistakes = Mistakes()
        for entry in self.scene.files:
            with mistakes.noted():
                found = self._read(entry)
                meshes += found.standing
                moving += found.moving
        mistakes.tell()
        if self.scene.copies:
            meshes += self._copies(meshes)
        objects = Objects(tuple(meshes), tuple(moving))
        if self.scene.ground is not None:
            below = Scene.from_meshes(meshes or objects.still(lambda _: None))
            objects = objects._replace(standing=(*meshes, self._ground(below)))
        scene = Scene.of_objects(objects, self._found.notes.append)
        return Still(scene, Standing(scene), self._found)

    def _track(self, scene: Scene, standing: Standing | None = None) -> Track:
        """Return the trajectory in the coordinates of a scene; it is made once."""
        assert self.trajectory is not None
        if self._way is None or self._way[0] is not scene.faces:
            way = self.trajectory.track(self._folder, standing or Standing(scene))
            self._way = (scene.faces, way)
        return self._way[1]

    def _system(self) -> int | None:
        """EPSG code of the rasters that stay where they are; they must be of one system."""
        stay = [(e.file, raster) for e, raster in self._found.rasters if e.transform().keeps_xy]
        systems = {raster.crs: file for file, raster in stay if raster.crs}
        if len(systems) > 1:
            listed = ", ".join(f"{file} in {crs[:60]}" for crs, file in systems.items())
            raise LidarpoolError(
                f"{self._source}: rasters of one scene have several coordinate systems: {listed}. "
                "Give cloud.epsg, the code of the one that all of them are brought to."
            )
        return next((raster.epsg for _, raster in stay if raster.crs), None)

    def _copies(self, base: list[Mesh | Instance]) -> list[Instance]:
        """Place the copies; they stand on other objects and on the ground, not on one another."""
        scene = Scene.from_meshes(base) if base else None
        if self.scene.ground is not None and (base or self._scattered_in()):
            scene = Scene.from_meshes([*base, self._ground(scene)])
        standing = Standing(scene)
        shapes: dict[Any, Mesh] = {}
        out: list[Instance] = []
        mistakes = Mistakes()
        for number, entry in enumerate(self.scene.copies):
            with mistakes.noted():
                mesh = self._shape(entry, shapes)
                with prefixed(f"{self._source}: scene.copies[{number}]"):
                    table = self._path(entry.table.file) if entry.table else None
                    made = copies_of(entry, mesh, standing, table)
                if entry.file is not None:
                    words = f", {counted(len(made), 'copy', 'copies')}"
                    self._found.sources[entry.file.file] += words
                out += made
        mistakes.tell()
        return out

    def _scattered_in(self) -> list[Floats]:
        """Corners of where copies are scattered, and places of lists, each (n, 2)."""
        scattered = [entry.scatter for entry in self.scene.copies if entry.scatter is not None]
        listed = [[one.position[:2] for one in entry.at] for entry in self.scene.copies]
        return [
            *(np.reshape(one.within, (2, 2)) for one in scattered if one.within is not None),
            *(np.array(places, np.float64) for places in listed if places),
        ]

    def _ground(self, scene: Scene | None) -> Mesh:
        """Two triangles under a scene, and under where copies are scattered or listed."""
        section = self.scene.ground
        assert section is not None
        ends = [] if scene is None else [(scene.bounds + scene.origin)[:, :2]]
        points = np.concatenate([*ends, *self._scattered_in()])
        (x0, y0), (x1, y1) = points.min(axis=0), points.max(axis=0)
        x0, y0, x1, y1 = np.array([x0, y0, x1, y1]) + section.margin_m * np.array([-1, -1, 1, 1])
        z = section.height_m
        corners = np.array([[x0, y0, z], [x1, y0, z], [x1, y1, z], [x0, y1, z]])
        return Mesh("Ground", corners, np.array([[0, 1, 2], [0, 2, 3]]))

    def _actors(self, standing: Standing, carrier: Track | None) -> tuple[Actor, ...]:
        """Build the actors; their trajectories begin with that of the survey."""
        shapes: dict[Any, Mesh] = {}
        with prefixed(self._source):
            ways = [entry.way(self._folder, standing, carrier) for entry in self.actors]
        out: list[Actor] = []
        for entry, way in zip(self.actors, ways, strict=True):
            if entry.is_robot:
                out += self._links_of(entry, way)
            else:
                out.append(Actor(replace(self._shape(entry, shapes), name=entry.name), way))
        return tuple(out)

    def _links_of(self, entry: ActorSection, way: Track) -> tuple[Actor, ...]:
        """Actors of a robot, without the links that sensors are mounted on."""
        robot = self._robot(entry)
        without = self._links.intersection(robot.meshes) if entry.trajectory is None else ()
        for link in sorted(without):
            self._found.notes.append(
                f"{entry.name}: link {link} is left out: a sensor is mounted on it"
            )
        with prefixed(f"{self._source}: actor {entry.name!r}"):
            return robot.actors(
                way,
                self._joints(entry),
                name=entry.name,
                without=without,
                tell=self._found.notes.append,
            )

    def _robot(self, entry: ActorSection) -> Robot:
        """Robot of an actor; those of one file are the same."""
        file = entry.file
        assert file is not None, "it is a robot"
        if file not in self._robots:
            with prefixed(self._source):
                path = self._path(file.file)
            self._robots[file] = load_robot(
                path, opacity=file.opacity, colours=self.coloured, tell=self._found.notes.append
            )
            self._found.sources[file.file] = self._robots[file].summary
        return self._robots[file]

    def _joints(self, entry: ActorSection) -> Path | None:
        return None if entry.joints is None else self._path(entry.joints)

    @property
    def _links(self) -> set[str]:
        """Links of the carrier that sensors are mounted on."""
        mounts = [self.mount, *(section.mount for section in self.sensors.values())]
        return {mount.link for mount in mounts if mount is not None and mount.link is not None}

    def _mount(self, mount: MountSection) -> Pose:
        """Pose of a sensor in the carrier's axes."""
        if mount.link is None:
            return mount.pose()
        carriers = [one for one in self.actors if one.trajectory is None and one.is_robot]
        on = [entry for entry in carriers if mount.link in self._robot(entry).links]
        if len(on) != 1:
            links = [link for entry in carriers for link in self._robot(entry).links]
            raise LidarpoolError(
                f"mount.link is {mount.link!r}, which {len(on) or 'no'} robots on the carrier "
                f"have; one must.{did_you_mean(mount.link, links)}"
            )
        (entry,) = on
        with prefixed(f"actor {entry.name!r}"):
            path = self._robot(entry).path(mount.link, joints=self._joints(entry))
        if path.moves:
            raise LidarpoolError(
                f"mount.link is {mount.link!r}, which {entry.joints} moves, and a mount is rigid: "
                "mount the sensor on a link that does not move, or leave out those joints' columns."
            )
        return path.pose(0).then(mount.pose())

    def _shape(
        self, entry: ActorSection | CopiesSection | VehicleSection, made: dict[Any, Mesh]
    ) -> Mesh:
        """Return the mesh of an entry, of those in `made` if it is there: {file or size: mesh}."""
        shape = entry.file or entry.box or (1.0, 1.0, 1.0)
        if shape not in made:
            name = entry.name or "vehicle"
            if isinstance(shape, MeshFile):
                lost = f"{self._path(shape.file)} moves "
                read = self._read(shape).still(lambda line: self._found.notes.append(lost + line))
                made[shape] = one_mesh(name, read)
            else:
                made[shape] = box(name, shape)
        return made[shape]

    def _traffic(self, scene: Scene, standing: Standing, start_s: float) -> list[Actor]:
        """Vehicles and persons that are there during the survey."""
        section = self.traffic
        if section is None:
            return []
        duration = self.survey(scene).duration_ns / 1e9
        with prefixed(self._source):
            path = self._path(section.file)
            begin = start_s - section.offset_s
            passages, count = read_fcd(path, begin, begin + duration)
            shapes: dict[Any, Mesh] = {}
            found = actors_of(
                section, passages, lambda entry: self._shape(entry, shapes), standing, start_s
            )
        self._vehicles = [entry.semantic_class for _, entry in found]
        actors = [actor for actor, _ in found]
        if not actors:
            self._found.notes.append(
                f"{section.file}: no vehicle or person is in the scene from {begin:g} to "
                f"{begin + duration:g} s of the file: check offset_s, translation and surfaces"
            )
        self._found.sources[section.file] = (
            f"{counted(len(actors), 'actor')} during the survey, of {counted(count, 'vehicle')} "
            "and persons until its end"
        )
        return actors

    def _materials(self, scene: Scene) -> list[Material]:
        """Materials by name, with the classes of actors and copies, and of city objects."""
        made = [*self.materials]
        placed: tuple[CopiesSection | ActorSection, ...] = (*self.scene.copies, *self.actors)
        own: list[tuple[str, list[str], int]] = []  # an object, names of all, their class
        for entry in placed:
            if entry.semantic_class is None:
                continue
            names, numbered = [escape(entry.name)], f"{escape(entry.name)}.[0-9]*"
            if isinstance(entry, CopiesSection) and len(rows_named(numbered, scene.names)):
                names.append(numbered)
            if isinstance(entry, ActorSection) and entry.is_robot:
                links = [a.name for a in scene.actors if a.name.startswith(f"{entry.name}/")]
                own += [(link, [escape(link)], entry.semantic_class) for link in links]
            else:
                own.append((entry.name, names, entry.semantic_class))
        if own and not made:
            made = [Material("*")]
        for name, names, semantic_class in own:
            # After the last that is for it: a later one, for a single copy, counts there.
            after = max((k for k, m in enumerate(made) if m.named(name)), default=-1)
            of = made[after] if after >= 0 else Material("*")
            made.insert(after + 1, replace(of, objects=names, semantic_class=semantic_class))
        vehicles = len(self._vehicles) if scene.actors else 0
        for semantic_class in sorted({one for one in self._vehicles[:vehicles] if one is not None}):
            own_rows = [row for row, one in enumerate(self._vehicles) if one == semantic_class]
            rows = np.array(own_rows) + len(scene.all_names) - vehicles
            made = with_class(made or [Material("*")], semantic_class, rows, scene.all_names)
        if any(entry.file.lower().endswith(CITYJSON) for entry in self.scene.files):
            made = with_classes(made or [Material("*")], CITY_CLASSES, scene.all_names)
        return made

    def survey(self, scene: Scene) -> Survey:
        """Return the survey, its poses in the local coordinates of `scene`.

        Raises
        ------
        LidarpoolError
            If fields are valid by themselves and do not fit together.
        """
        with prefixed(self._source):
            track, poses, carried = None, [], self._carried()
            if self.trajectory is not None:
                track = self._track(scene)
            else:
                poses = [
                    replace(pose, position=tuple(np.subtract(pose.position, scene.origin)))
                    for pose in self._world_poses(scene)
                ]
            cloud = declared(self.cloud, CloudOptions) | {
                "columns": (*self.cloud.columns, *self.output.needs)
            }
            cloud["epsg"] = self.cloud.epsg or self._epsg
            if self.scene.has_seed and cloud["keep_every"] is None:
                cloud["keep_every"] = 1 if "ray" in self.output.needs else SEED_KEPT
            check_whole(self.output.needs, cloud["keep_every"] or 1)
            own_noise = all(one.noise is not None for one in carried)
            alone = not self.sensors and self.mount is None and carried[0].noise is None
            return Survey(
                poses=poses,
                trajectory=track,
                **({"sensor": carried[0].sensor} if alone else {"sensors": carried}),
                steps=self.steps,
                materials=self._materials(scene),
                returns=Returns(**dict(self.returns)),
                noise=Noise() if own_noise else Noise(**dict(self.noise)),
                navigation=self.navigation,
                **declared(self.weather, Weather),
                **cloud,
            )

    def plan(self, scene: Scene) -> Planning | None:
        """Return the planning, in the local coordinates of `scene`; None for none.

        Raises
        ------
        LidarpoolError
            If an obstacle names no object, or an end of the path lies within an obstacle.
        """
        section = self.planning
        start, target = section.start, section.target
        if self.scene.has_seed:
            start, target = start or SEED_START, target or SEED_TARGET
        if section.enabled is False or start is None or target is None:
            return None
        x0, y0, _ = scene.origin
        with prefixed(self._source):
            discs, labels = self._discs(scene)
            discs[:, 2] += section.clearance_m
            wide = np.flatnonzero(discs[:, 2])  # upright lines have no area
            discs, labels = discs[wide], [labels[i] for i in wide]
            local = [(x - x0, y - y0) for x, y in (start, target)]
            _check_free({"start": local[0], "target": local[1]}, discs, labels)
            return Planning(
                start=local[0],
                target=local[1],
                centres=discs[:, :2],
                radii=discs[:, 2],
                **declared(section, Search),
            )

    def _carried(self) -> list[Mounted]:
        """Return the sensors on their carrier."""
        common = self.noise, self.returns
        if self.sensors:
            return [
                replace(
                    section.mounted(self._folder, self._mount(section.mount), *common, name),
                    steps=section.steps,
                )
                for name, section in self.sensors.items()
            ]
        mount = MountSection() if self.mount is None else self.mount
        return [self.sensor.mounted(self._folder, self._mount(mount), *common)]

    def _read(self, entry: MeshFile) -> Objects:
        with prefixed(self._source):
            path, transform = self._path(entry.file), entry.transform()
            assets = None if entry.assets is None else self._path(entry.assets)
        return load_objects(
            path,
            unit=entry.unit,
            up_axis=entry.up_axis,
            transform=transform,
            opacity=entry.opacity,
            colours=self.coloured,
            step_m=entry.step_m,
            window=entry.window,
            epsg=self.cloud.epsg,
            assets=assets,
            tell=self._found.notes.append,
            axes=self._found.remarks.append,
            tell_raster=lambda raster: self._found.rasters.append((entry, raster)),
            taken=partial(self._found.sources.setdefault, entry.file),
        )

    @property
    def coloured(self) -> bool:
        """Whether colours of meshes are read: a column or a material needs them."""
        columns = {*self.cloud.columns, *self.output.needs}
        return bool(columns & {*COLOURS}) or any(m.reflectance == "texture" for m in self.materials)

    def _path(self, file: str) -> Path:
        try:
            return self._folder / Path(file).expanduser()
        except RuntimeError as error:  # ~name of an unknown user
            raise LidarpoolError(f"the file {file!r} cannot be found: {error}") from error

    def _world_poses(self, scene: Scene) -> tuple[Pose, ...]:
        if self.poses is not None:
            return self.poses
        return SEED_POSES if self.scene.has_seed else self.placing(scene).poses

    def placing(self, scene: Scene) -> Placing:
        """Where the sensor is put in a scene from mesh files, if no poses are given."""
        if self._placing is None:
            self._placing = place(scene, self._carried()[0], landscape=bool(self._found.rasters))
        return self._placing

    def _discs(self, scene: Scene) -> tuple[Floats, list[str]]:
        """Obstacles as local x, y, radius (m, 3), and a label for each."""
        if self.planning.obstacles is None:
            tall = np.flatnonzero(np.ptp(scene.object_bounds[..., 2], axis=1) >= FLAT_M)
            return scene.footprints[tall], [scene.names[i] for i in tall]
        rows: dict[str, list[float]] = {}  # {label: x, y, radius}
        for number, entry in enumerate(self.planning.obstacles):
            if entry.object is None:
                assert entry.centre and entry.radius_m, "either of the two kinds is given"
                place = np.subtract(entry.centre, scene.origin[:2])
                rows[f"planning.obstacles[{number}]"] = [*place, entry.radius_m]
                continue
            # An exact name comes first, even with brackets; else it is a pattern.
            found = [i for i, name in enumerate(scene.names) if name == entry.object] or [
                i for i, name in enumerate(scene.names) if fnmatchcase(name, entry.object)
            ]
            if not found:
                hint = did_you_mean(entry.object, scene.names)
                raise LidarpoolError(
                    f"planning.obstacles names {entry.object!r}, but no object has that name."
                    + (hint or f" The scene has {', '.join(scene.names[:5])}, …")
                )
            rows |= {scene.names[i]: list(scene.footprints[i]) for i in found}
        return np.array(list(rows.values()), dtype=np.float64).reshape(-1, 3), list(rows)


def _check_free(ends: dict[str, tuple[float, float]], discs: Floats, labels: list[str]) -> None:
    """Refuse a path that begins or ends in an obstacle, and name the obstacle."""
    for end, point in ends.items():
        inside = np.hypot(*(discs[:, :2] - point).T) < discs[:, 2]
        if inside.any():
            first = int(inside.argmax())
            raise LidarpoolError(
                f"planning.{end} lies {discs[first, 2]:.2f} m or less from the middle of "
                f"{labels[first]}, within its circle: move it, or list other planning.obstacles."
            )

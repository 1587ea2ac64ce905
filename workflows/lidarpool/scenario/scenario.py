"""Scenario files: surveys as data, checked before a run."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any

from pydantic import PrivateAttr, ValidationError

from lidarsim.columns.table import COLORS
from lidarsim.errors import LidarError, Mistakes, prefixed
from lidarsim.io.input_files import not_found
from lidarsim.io.yamlfile import read_yaml
from lidarsim.media.materials import ClassNames, Material
from lidarsim.media.weather import Weather
from lidarsim.motion.navigation import Navigation
from lidarsim.motion.trajectory import CENTER
from lidarsim.motion.trajectory_files import files_of_trajectory
from lidarsim.scene.files.mesh_formats import endings, format_of
from lidarsim.schema.declared import Several, Text, about, accept_text
from lidarsim.schema.error_sentences import convert_validation_errors
from lidarsim.schema.section_fields import FieldPath, dotted, fields_of, is_section
from lidarsim.sensor.models import plugin_model_file
from lidarsim.survey.faults import Fault
from lidarsim.survey.survey import MAX_SENSORS, CloudOptions, StepCount

from .actor_motion import ActorSection, CarriedEntry, MountEntry, TrajectoryEntry
from .sections import (
    CopiesSection,
    NoiseSection,
    OutputSection,
    PlanningSection,
    PoolSection,
    PoseEntry,
    ReturnsSection,
    SceneSection,
    Section,
    SensorSection,
    WorldSection,
    may_be_empty,
    scene_in_short,
)
from .traffic import TrafficSection

_NAMING_FILES = {"file", "calibration", "model", "times"}  # fields whose texts name files

# Options of a mesh file without a scenario, and the fields of a scenario for them.
MESH_OPTIONS = {
    "sensor": "sensor",
    "unit": "scene.files.unit",
    "up_axis": "scene.files.up_axis",
    "pose": "poses",
    "columns": "cloud.columns",
    "format": "output.write",
}


def mesh_data(files: Sequence[Path], folder: Path, options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the data that a scenario file of mesh files would have.

    Names of files start from `folder`, the scenario's. `options` are {name in `MESH_OPTIONS`:
    value}. Sections without an option are left out, and the scene without files.
    """

    def relative(file: str | Path) -> str:
        return Path(os.path.relpath(file, folder)).as_posix()

    settings = {name: options[name] for name in ("unit", "up_axis") if name in options}
    names = [relative(file) for file in files]
    entries = [{"file": name} | settings if settings else name for name in names]
    model = options.get("sensor")
    data = {
        "scene": {"files": entries} if files else None,
        "sensor": relative(model) if model and model.endswith((".yaml", ".yml")) else model,
        "poses": options.get("pose"),
        "cloud": {"columns": options["columns"]} if "columns" in options else None,
        "output": {"write": options["format"]} if "format" in options else None,
    }
    return {name: value for name, value in data.items() if value is not None}


def _with_sensor(path: Path, data: Any, options: Mapping[str, Any]) -> Any:
    """Return the data of a scenario file with another sensor.

    LidarError for other options.
    """
    is_campaign = isinstance(data, dict) and "base" in data
    if is_campaign or {*options} != {"sensor"}:
        name = next((name for name in options if name != "sensor"), "sensor")
        raise LidarError(
            f"`--{name.replace('_', '-')}` requires a mesh file. Set `{MESH_OPTIONS[name]}` in "
            f"{'the base of ' * is_campaign}{path} instead."
        )
    if not isinstance(data, dict):
        return data  # `from_data` says what is wrong
    if "sensors" in data:
        raise LidarError(
            f"`--sensor` requires a scenario with a single sensor. Change `sensors` in {path} "
            "instead."
        )
    return data | {"sensor": mesh_data([], path.parent, options)["sensor"]}


def survey_of(mesh_file: Path) -> str:
    """Return the name of the survey of a mesh file without a scenario, for messages."""
    return f"survey of {mesh_file}"


class Scenario(Section):
    """A survey and its path planning, as described by a scenario file.

    Without arguments it has no scene, which a survey needs. `lidarpool.scenario.demo` has the
    scenario of the demo.

    Parameters
    ----------
    scene, world, sensor, materials, returns, noise, weather, navigation, faults, cloud, output, \
    planning, pool
        See `lidarpool.scenario.sections`.
    poses
        Poses of the sensor, in the coordinates of the scene. By default the sensor is at the origin
        (objects of the demo), 1, 2 and 3 meters above the ground; in other scenes chosen by
        `place_sensor`: in the middle of a room or landscape, or around an object.
    steps, classes
        Time steps from each pose, and names of semantic classes, {number: name}.

    Raises
    ------
    pydantic.ValidationError
        If a value is out of range; `load` and `from_data` raise LidarError.
    """

    scene: Annotated[SceneSection, scene_in_short] = SceneSection()
    world: Annotated[WorldSection, may_be_empty(WorldSection)] = WorldSection()
    sensor: Annotated[
        SensorSection, may_be_empty(SensorSection), accept_text("model", SensorSection | None)
    ] = SensorSection()
    poses: Annotated[
        Several[PoseEntry] | None,
        about(
            "poses of the sensor in the scene, in meters with z up (default: 1, 2 and 3 m above "
            "the origin for the objects of the demo; for files, above the center of the floor and "
            "below the ceiling, or around the scene if it is a single object)",
            [[0, 0, 1], [0, 0, 2], {"position": [0, 0, 3], "yaw_deg": 90}],
            min_length=1,
            max_length=1_000_000,
        ),
    ] = None
    trajectory: Annotated[
        TrajectoryEntry | None,
        about(
            "trajectory of the platform, from a TUM, KITTI or .csv file, from points or from a "
            "vehicle in the traffic; replaces poses",
            "drive.tum",
        ),
    ] = None
    sensors: Annotated[
        dict[Text, CarriedEntry],
        about(
            "sensors on one platform, by name, each with its mount; replaces sensor",
            {"roof": {"model": "ouster/os1-64", "mount": [0, 0, 2]}, "front": "velodyne/vlp16"},
            max_length=MAX_SENSORS,
        ),
    ] = {}  # noqa: RUF012 - of a frozen model
    actors: Annotated[
        Several[ActorSection],
        about(
            "moving or stationary meshes, boxes or robots; an actor with neither trajectory nor at "
            "is the platform",
            [{"name": "Van", "box": [5, 2, 2.2], "trajectory": "van.tum", "class": 3}],
            [{"name": "Crane", "file": "crane.urdf", "at": [4, 5, 0]}],
            max_length=10_000,
        ),
    ] = ()
    traffic: Annotated[
        TrafficSection | None,
        about(
            "vehicles and persons from a SUMO simulation or an OSI trace, as actors",
            {"file": "fcd.xml", "vehicles": [{"box": [4.5, 1.8, 1.5], "class": 10}]},
        ),
    ] = None
    mount: Annotated[
        MountEntry | None,
        about(
            "pose of the sensor in the platform frame",
            [1, 0, 2],
            {"position": [1, 0, 2], "pitch_deg": 10},
        ),
    ] = None
    steps: Annotated[
        StepCount | None,
        about(
            "number of time steps (scans) at each pose (default along a trajectory: as many as fit "
            "into its duration)",
            36,
        ),
    ] = None
    materials: Annotated[
        Several[Material],
        about(
            "materials, assigned by the names of objects and of the materials in scene files; the "
            "first matching entry applies",
            [{"objects": "Window*", "transparent": "pass"}, {"objects": "*", "reflectance": 0.3}],
            max_length=100_000,
        ),
    ] = ()
    classes: Annotated[
        ClassNames,
        about(
            "names of semantic classes for reports and files; if set, the cloud contains the "
            "column class",
            {40: "road"},
        ),
    ] = {}  # noqa: RUF012 - of a frozen model
    returns: Annotated[ReturnsSection, may_be_empty(ReturnsSection)] = ReturnsSection()
    noise: Annotated[NoiseSection, may_be_empty(NoiseSection)] = NoiseSection()
    weather: Annotated[Weather, may_be_empty(Weather)] = Weather()
    navigation: Annotated[
        Navigation | None,
        about(
            "IMU and GNSS receiver of the platform, with drifting errors",
            {"imu": {"rate_hz": 200}, "gnss": {"rate_hz": 10}},
        ),
    ] = None
    faults: Annotated[
        Several[Fault],
        about("faults of the sensors", [{"kind": "dirt", "transmission": 0.3}], max_length=256),
    ] = ()
    cloud: Annotated[CloudOptions, may_be_empty(CloudOptions)] = CloudOptions()
    output: Annotated[OutputSection, may_be_empty(OutputSection)] = OutputSection()
    planning: Annotated[PlanningSection, may_be_empty(PlanningSection)] = PlanningSection()
    pool: Annotated[PoolSection, may_be_empty(PoolSection)] = PoolSection()

    _folder: Path = PrivateAttr(default=Path())  # folder that relative file names start from
    _source: str = PrivateAttr(default="the scenario")  # source for messages

    @property
    def title(self) -> str:
        """Name of the survey, for titles: the name of the file without its ending."""
        path = Path(self._source)
        return path.stem if path.suffix in (".yaml", ".yml") else self._source

    @classmethod
    def load(cls, path: str | Path, options: Mapping[str, Any] = MappingProxyType({})) -> Scenario:
        """Read a scenario file (YAML), or make the scenario of a mesh file by `mesh_data`.

        Of the options, a scenario file with one sensor takes another `sensor`.

        Raises
        ------
        LidarError
            With the file, the field, what was given and what is allowed.
        """
        path = Path(path)
        mesh = path.suffix.lower() not in ("", ".yaml", ".yml")
        data = mesh_data([path], path.parent, options) if mesh else read_yaml(path)
        if options and not mesh:
            data = _with_sensor(path, data, options)
        return cls.from_data(
            data, source=survey_of(path) if mesh else str(path), folder=path.parent
        )

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
        LidarError
            As `load`.
        """
        return cls().with_sections(data, source=source, folder=Path(folder))

    def with_sections(
        self, data: dict[str, Any], *, source: str, folder: Path | None = None
    ) -> Scenario:
        """Return the scenario with sections replaced.

        Unchanged sections are not validated again.

        LidarError as `load`.
        """
        with convert_validation_errors(Scenario, source, data, _is_contradictory):
            sections = Scenario.model_validate(data)
        changes = {name: getattr(sections, name) for name in sections.model_fields_set}
        scenario = self.model_copy(update=changes)
        scenario._folder = self._folder if folder is None else folder
        scenario._source = source
        scenario._check()
        return scenario

    def _check(self) -> None:
        """Raise LidarError if fields do not fit together."""
        mistakes = Mistakes()
        for reason in self._contradictions():
            mistakes.lines.append(f"{self._source}: {reason}")
        for section in self.sensors.values() or (self.sensor,):
            if section.calibration is None:
                with mistakes.noted(), self.naming_lost_files(), prefixed(self._source):
                    mounted = section.mounted(self.path, CENTER, self.noise, self.returns)
                    (mounted.returns or self.returns).divergence(mounted.sensor.optics)
        mistakes.tell()

    def _contradictions(self) -> Iterator[str]:
        """Yield the reasons why fields do not fit together, each a sentence."""
        yield from self._planning_contradictions()
        yield from self._carrier_contradictions()
        copies = [entry.name for entry in self.scene.copies]
        name_counts = Counter([*copies, *(entry.name for entry in self.actors)])
        if twice := next((name for name in copies if name_counts[name] > 1), None):
            yield (
                f"The names in `scene.copies` and `actors` must be unique, but {twice!r} is used "
                "more than once."
            )
        if self.sensors and (self.sensor != SensorSection() or self.mount):
            yield (
                "`sensors` cannot be combined with `sensor` or `mount`. Set the mount of each "
                "entry of `sensors`."
            )
        gnss = self.navigation and self.navigation.gnss
        if gnss and gnss.origin is not None and any(self.world.origin):
            yield (
                "`navigation.gnss.origin` and `world.origin` cannot be combined. Set `world.epsg` "
                "instead of `navigation.gnss.origin`."
            )

    def _planning_contradictions(self) -> Iterator[str]:
        """Yield the reasons why the planning lacks a start or target."""
        planning = self.planning
        if planning.enabled is False or (planning.start and planning.target):
            return
        if planning != PlanningSection():
            yield (
                "`planning` requires a start and a target. Set `planning.start` and "
                "`planning.target`."
            )

    def _carrier_contradictions(self) -> Iterator[str]:
        """Yield the reasons why trajectory, poses, carrier and mounts do not fit together."""
        if self.trajectory is not None and self.trajectory.beyond != "refuse":
            yield (
                "`trajectory.beyond` is only allowed for actors, because the trajectory of the "
                "platform must cover the survey."
            )
        if self.trajectory is not None and self.poses is not None:
            yield "`poses` and `trajectory` cannot be combined."
        if self.trajectory is not None and self.trajectory.vehicle is not None:
            if self.traffic is None:
                yield "`trajectory.vehicle` requires traffic. Set `traffic.file`."
            others = self.trajectory.model_fields_set - {"vehicle", "start_s", "duration_s"}
            if others:
                yield (
                    "`trajectory.vehicle` can only be combined with `start_s` and `duration_s`, "
                    f"not with `trajectory.{min(others)}`. Set other options in `traffic`."
                )
        carriers = [entry for entry in self.actors if entry.is_carrier]
        if carriers and self.trajectory is None:
            yield (
                f"Actor {carriers[0].name!r} has no trajectory. Set its `trajectory`, or "
                "`at: [x, y, z]` if it is stationary. If it is the platform, replace `poses` with "
                "a `trajectory` of the survey."
            )
        if self.links and not any(entry.robot for entry in carriers):
            yield (
                "`mount.link` requires a robot as the platform. Add an actor with a .urdf file "
                "and without a trajectory."
            )

    @property
    def files(self) -> tuple[Path, ...]:
        """Files of the scenario, each once: meshes, tables, trajectories, data of sensors."""
        shaped = (*self.placed, *(self.traffic.vehicles if self.traffic else ()))
        entries = [*self.scene.files, *(entry.file for entry in shaped if entry.file)]
        files: list[str | None] = [entry.file for entry in entries]
        files += [self.traffic.file] if self.traffic else []
        files += [entry.table.file for entry in self.scene.copies if entry.table]
        files += [entry.joints.file for entry in self.actors if entry.joints]
        trajectories = [self.trajectory, *(entry.trajectory for entry in self.actors)]
        files += [trajectory.times for trajectory in trajectories if trajectory]
        for section in (self.sensor, *self.sensors.values()):
            files += [section.calibration]
            files += [section.model] if section.has_own_model else []
        paths = [self.path(file) for file in files if file]
        models = (section.model for section in (self.sensor, *self.sensors.values()))
        paths += filter(None, map(plugin_model_file, models))
        for trajectory in trajectories:
            if trajectory and trajectory.file:
                paths += files_of_trajectory(self.path(trajectory.file))
        return tuple(dict.fromkeys(paths))

    def named_in(self, file: Path) -> str:
        """Return the scenario and the field that name a file, to start a message.

        Empty for the mesh file of a survey without a scenario, and if no field names the file.
        """
        field = _field_that_names(self, lambda text: self.path(text) == file)
        return f"{self._source}: {field}: " if field and self._source != survey_of(file) else ""

    @contextmanager
    def naming_lost_files(self) -> Iterator[None]:
        """Name the files that do not exist, with their fields, in a LidarError of the body."""
        try:
            yield
        except LidarError as error:
            # `Path.exists` fails at names that no file can have.
            lost = [path for path in self.files if not os.path.exists(path)]  # noqa: PTH110
            if not any(str(path) in str(error) for path in lost):  # there is another fault
                raise
            mistakes = Mistakes()
            for path in lost:
                likely = endings() if format_of(path) else ()
                mistakes.lines.append(f"{self.named_in(path)}{not_found(path, likely)}")
            mistakes.lines += [
                line
                for line in str(error).splitlines()
                if not any(str(path) in line for path in lost)
            ]
            mistakes.tell()

    @property
    def placed(self) -> tuple[CopiesSection | ActorSection, ...]:
        """Entries of copies and actors."""
        return *self.scene.copies, *self.actors

    @property
    def source(self) -> str:
        """Name of the scenario in messages."""
        return self._source

    def path(self, file: str) -> Path:
        """Return the path of a file, which starts from the scenario's folder."""
        # `Path.expanduser` fails at users who are not known.
        return self._folder / os.path.expanduser(file)  # noqa: PTH111

    @property
    def links(self) -> set[str]:
        """Links of the carrier that sensors are mounted on."""
        mounts = [self.mount, *(section.mount for section in self.sensors.values())]
        return {mount.link for mount in mounts if mount is not None and mount.link is not None}

    @property
    def colored(self) -> bool:
        """Whether colors of meshes are read: for a column, or a reflectance of the texture."""
        columns = {*self.cloud.columns, *self.output.needs}
        return bool(columns & {*COLORS}) or any(m.reflectance == "texture" for m in self.materials)

    @property
    def names_materials(self) -> bool:
        """Whether faces keep the names of their materials: for a column or for materials."""
        columns = {*self.cloud.columns, *self.output.needs}
        return "material" in columns or any(m.material is not None for m in self.materials)


def _is_contradictory(content: Any) -> bool:
    """Return True if the sections of a scenario contradict each other."""
    try:
        return any(Scenario.model_validate(content)._contradictions())
    except ValidationError:  # another fault
        return False


def _field_that_names(section: Any, is_file: Callable[[str], bool]) -> str:
    """Return the path of the first field whose text is the name of a file, or an empty string.

    Parameters
    ----------
    section
        The section that is searched for fields, with sections within it.
    is_file
        Returns True for a text that names the file.

    Returns
    -------
    Such as ``scene.files[0].file``.
    """
    for path, text in _texts(section):
        if path[-1] in _NAMING_FILES and is_file(text):
            return dotted(path)
    return ""


def _texts(node: Any, path: FieldPath = ()) -> Iterator[tuple[FieldPath, str]]:
    """Yield the texts in a section, a list or a mapping, each with its path."""
    entries: Any = ()
    if isinstance(node, str):
        yield path, node
    elif is_section(type(node)):
        fields = fields_of(type(node)).items()
        entries = ((field.alias or name, getattr(node, name, None)) for name, field in fields)
    elif isinstance(node, Mapping):
        entries = node.items()
    elif isinstance(node, (tuple, list)):
        entries = enumerate(node)
    for key, value in entries:
        yield from _texts(value, (*path, key))

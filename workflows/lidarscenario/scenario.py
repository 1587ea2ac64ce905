"""Scenario files, which describe surveys and are validated before a run."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any

from pydantic import PrivateAttr, ValidationError

from lidarsim.columns.table import COLORS
from lidarsim.errors import LidarError, Mistakes, prefix_errors
from lidarsim.io.input_files import not_found
from lidarsim.io.yamlfile import read_yaml
from lidarsim.media.materials import ClassNames, Material
from lidarsim.media.weather import Weather
from lidarsim.motion.navigation import Navigation
from lidarsim.motion.trajectory import CENTER
from lidarsim.motion.trajectory_files import list_trajectory_files
from lidarsim.scene.files.mesh_formats import endings, format_of
from lidarsim.schema.declared import Several, Text, about, accept_text
from lidarsim.schema.error_sentences import convert_validation_errors
from lidarsim.schema.section_fields import FieldPath, fields_of, format_path, is_section
from lidarsim.sensor.models import MODEL_FILES, plugin_model_file
from lidarsim.survey.faults import Fault
from lidarsim.survey.survey import MAX_SENSORS, CloudOptions, StepCount

from .sections import (
    CopiesSection,
    FlightSection,
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
    allow_empty,
    allow_scene_short_form,
)
from .traffic.actor_motion import ActorSection, MountedSensorEntry, MountEntry, TrajectoryEntry
from .traffic.traffic import TrafficSection

_FILE_FIELDS = {"file", "calibration", "model", "times"}  # fields that contain file names
_PATH_FIELDS = _FILE_FIELDS | {"assets"}  # fields that contain names of files or folders

# Options for simulating a mesh file without a scenario, and the corresponding scenario fields.
MESH_OPTIONS = {
    "sensor": "sensor",
    "unit": "scene.files.unit",
    "up_axis": "scene.files.up_axis",
    "pose": "poses",
    "columns": "cloud.columns",
    "format": "output.write",
}


def relative_file(file: Path, folder: Path) -> str:
    """Return the path of a file relative to the folder of a scenario."""
    return Path(os.path.relpath(file.resolve(), folder.resolve())).as_posix()


def mesh_data(files: Sequence[Path], folder: Path, options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the content of a scenario file that uses mesh files.

    Sections without an option are omitted, and the scene is omitted if there are no files.

    Parameters
    ----------
    files
        Paths of the mesh files.
    folder
        Folder of the scenario, to which file names are relative.
    options
        Mapping from names in `MESH_OPTIONS` to values.
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
    """Return the content of a scenario file in which the sensor is replaced.

    Raise LidarError if there are options other than `sensor`.
    """
    is_campaign = isinstance(data, dict) and "base" in data
    if is_campaign or {*options} != {"sensor"}:
        name = next((name for name in options if name != "sensor"), "sensor")
        raise LidarError(
            f"`--{name.replace('_', '-')}` requires a mesh file. Set `{MESH_OPTIONS[name]}` in "
            f"{'the base of ' * is_campaign}{path} instead."
        )
    if not isinstance(data, dict):
        return data  # `from_data` reports the error
    if "sensors" in data:
        raise LidarError(
            f"`--sensor` requires a scenario with a single sensor. Change `sensors` in {path} "
            "instead."
        )
    return data | {"sensor": mesh_data([], path.parent, options)["sensor"]}


def mesh_survey_name(mesh_file: Path) -> str:
    """Return the name used in messages for a survey of a mesh file without a scenario."""
    return f"survey of {mesh_file}"


class Scenario(Section):
    """A survey with optional path planning, as described by a scenario file.

    A scenario that is created without arguments has no scene and cannot be simulated. See
    `lidarscenario.demo` for the scenario of the demo.

    Parameters
    ----------
    scene, world, sensor, materials, returns, noise, weather, navigation, flight, faults, cloud, \
    output, planning, pool
        See `lidarscenario.sections`.
    poses
        Poses of the sensor, in the coordinates of the scene. In the scene of the demo, the default
        is 1, 2 and 3 m above the origin. In other scenes, `place_sensor` chooses poses at the
        center of a room or landscape, or around an object.
    steps
        Number of time steps at each pose.
    classes
        Mapping from the numbers of semantic classes to their names.

    Raises
    ------
    pydantic.ValidationError
        If a value is invalid. `load` and `from_data` raise LidarError instead.
    """

    scene: Annotated[SceneSection, allow_scene_short_form] = SceneSection()
    world: Annotated[WorldSection, allow_empty(WorldSection)] = WorldSection()
    sensor: Annotated[
        SensorSection, allow_empty(SensorSection), accept_text("model", SensorSection | None)
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
        dict[Text, MountedSensorEntry],
        about(
            "sensors on one platform, by name, each with its mount; replaces sensor",
            {"roof": {"model": "ouster/os1-64", "mount": [0, 0, 2]}, "front": "velodyne/vlp16"},
            max_length=MAX_SENSORS,
        ),
    ] = {}  # noqa: RUF012 - the model is frozen
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
    ] = {}  # noqa: RUF012 - the model is frozen
    returns: Annotated[ReturnsSection, allow_empty(ReturnsSection)] = ReturnsSection()
    noise: Annotated[NoiseSection, allow_empty(NoiseSection)] = NoiseSection()
    weather: Annotated[Weather, allow_empty(Weather)] = Weather()
    navigation: Annotated[
        Navigation | None,
        about(
            "IMU and GNSS receiver of the platform, with drifting errors",
            {"imu": {"rate_hz": 200}, "gnss": {"rate_hz": 10}},
        ),
    ] = None
    flight: Annotated[
        FlightSection | None,
        about(
            "plan of an airborne survey, as written by `lidarpool flight`; `lidarpool check` and "
            "the report compare the density with it"
        ),
    ] = None
    faults: Annotated[
        Several[Fault],
        about("faults of the sensors", [{"kind": "dirt", "transmission": 0.3}], max_length=256),
    ] = ()
    cloud: Annotated[CloudOptions, allow_empty(CloudOptions)] = CloudOptions()
    output: Annotated[OutputSection, allow_empty(OutputSection)] = OutputSection()
    planning: Annotated[PlanningSection, allow_empty(PlanningSection)] = PlanningSection()
    pool: Annotated[PoolSection, allow_empty(PoolSection)] = PoolSection()

    _folder: Path = PrivateAttr(default=Path())  # folder of relative file names
    _source: str = PrivateAttr(default="the scenario")  # name of the scenario in messages

    @property
    def title(self) -> str:
        """Title of the survey, which is the scenario's file name without the extension."""
        path = Path(self._source)
        return path.stem if path.suffix in (".yaml", ".yml") else self._source

    @classmethod
    def load(cls, path: str | Path, options: Mapping[str, Any] = MappingProxyType({})) -> Scenario:
        """Read a scenario file, or create a scenario from a mesh file with `mesh_data`.

        Parameters
        ----------
        path
            Scenario file (YAML) or mesh file.
        options
            Mapping from names in `MESH_OPTIONS` to values. For a scenario file, only `sensor` is
            allowed, which replaces the sensor of the scenario.

        Raises
        ------
        LidarError
            If the scenario is invalid. The message names the file, the field, the value and the
            allowed values.
        """
        path = Path(path)
        mesh = path.suffix.lower() not in ("", ".yaml", ".yml")
        data = mesh_data([path], path.parent, options) if mesh else read_yaml(path)
        if options and not mesh:
            data = _with_sensor(path, data, options)
        return cls.from_data(
            data, source=mesh_survey_name(path) if mesh else str(path), folder=path.parent
        )

    @classmethod
    def from_data(
        cls, data: dict[str, Any], *, source: str = "scenario", folder: str | Path = "."
    ) -> Scenario:
        """Create a scenario from the content of a scenario file.

        Parameters
        ----------
        data
            Sections of the scenario, as read from YAML.
        source
            Name of the scenario in messages.
        folder
            Folder to which relative file names refer.

        Raises
        ------
        LidarError
            If the scenario is invalid, as for `load`.
        """
        return cls().with_sections(data, source=source, folder=Path(folder))

    def with_sections(
        self, data: dict[str, Any], *, source: str, folder: Path | None = None
    ) -> Scenario:
        """Return a copy in which some sections are replaced.

        Unchanged sections are not validated again. Raise LidarError if the scenario is invalid.
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
        """Raise LidarError if fields cannot be combined or a sensor model is invalid."""
        mistakes = Mistakes()
        for reason in self._contradictions():
            mistakes.lines.append(f"{self._source}: {reason}")
        for section in self.sensors.values() or (self.sensor,):
            if section.calibration is None:
                with mistakes.collect(), self.explain_missing_files(), prefix_errors(self._source):
                    mounted = section.mounted_sensor(self.path, CENTER, self.noise, self.returns)
                    (mounted.returns or self.returns).divergence(mounted.sensor.optics)
        mistakes.raise_if_any()

    def _contradictions(self) -> Iterator[str]:
        """Yield a sentence for each contradiction between fields."""
        yield from self._planning_contradictions()
        yield from self._platform_contradictions()
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
        """Yield a sentence if the planning lacks a start or target."""
        planning = self.planning
        if planning.enabled is False or (planning.start and planning.target):
            return
        if planning != PlanningSection():
            yield (
                "`planning` requires a start and a target. Set `planning.start` and "
                "`planning.target`."
            )

    def _platform_contradictions(self) -> Iterator[str]:
        """Yield a sentence for each contradiction of trajectory, poses, platform and mounts."""
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
        platforms = [entry for entry in self.actors if entry.is_platform]
        if platforms and self.trajectory is None:
            yield (
                f"Actor {platforms[0].name!r} has no trajectory. Set its `trajectory`, or "
                "`at: [x, y, z]` if it is stationary. If it is the platform, replace `poses` with "
                "a `trajectory` of the survey."
            )
        if self.mount_links and not any(entry.robot for entry in platforms):
            yield (
                "`mount.link` requires a robot as the platform. Add an actor with a .urdf file "
                "and without a trajectory."
            )

    @property
    def files(self) -> tuple[Path, ...]:
        """Paths of all files that the scenario uses, without duplicates.

        They include meshes, tables, trajectories, traffic, and sensor models and calibrations.
        """
        shaped = (*self.object_entries, *(self.traffic.vehicles if self.traffic else ()))
        entries = [*self.scene.files, *(entry.file for entry in shaped if entry.file)]
        files: list[str | None] = [entry.file for entry in entries]
        files += [self.traffic.file] if self.traffic else []
        files += [entry.table.file for entry in self.scene.copies if entry.table]
        files += [entry.joints.file for entry in self.actors if entry.joints]
        trajectories = [self.trajectory, *(entry.trajectory for entry in self.actors)]
        files += [trajectory.times for trajectory in trajectories if trajectory]
        for section in (self.sensor, *self.sensors.values()):
            files += [section.calibration]
            files += [section.model] if section.has_custom_model else []
        paths = [self.path(file) for file in files if file]
        models = (section.model for section in (self.sensor, *self.sensors.values()))
        paths += filter(None, map(plugin_model_file, models))
        for trajectory in trajectories:
            if trajectory and trajectory.file:
                paths += list_trajectory_files(self.path(trajectory.file))
        return tuple(dict.fromkeys(paths))

    def content(self, folder: Path) -> dict[str, Any]:
        """Return the sections that the scenario states, for a scenario file in another folder.

        Names of files are relative to the folder. The result can be written as YAML.
        """
        return {
            name: _plain_data(value, lambda text: relative_file(self.path(text), folder))
            for name, value in _stated_fields(self)
        }

    def message_prefix(self, file: Path) -> str:
        """Return a message prefix with the scenario and the field in which a file is named.

        The prefix is empty if no field names the file, or for the mesh file of a survey without a
        scenario.
        """
        field = _find_file_field(self, lambda text: self.path(text) == file)
        return (
            f"{self._source}: {field}: " if field and self._source != mesh_survey_name(file) else ""
        )

    @contextmanager
    def explain_missing_files(self) -> Iterator[None]:
        """Add missing files and their fields to a LidarError that the body raises.

        Errors that do not concern missing files are raised unchanged.
        """
        try:
            yield
        except LidarError as error:
            # `Path.exists` raises an error for names that are not valid file names.
            missing = [path for path in self.files if not os.path.exists(path)]  # noqa: PTH110
            if not any(str(path) in str(error) for path in missing):  # the error has another cause
                raise
            mistakes = Mistakes()
            for path in missing:
                likely = endings() if format_of(path) else ()
                mistakes.lines.append(f"{self.message_prefix(path)}{not_found(path, likely)}")
            mistakes.lines += [
                line
                for line in str(error).splitlines()
                if not any(str(path) in line for path in missing)
            ]
            mistakes.raise_if_any()

    @property
    def object_entries(self) -> tuple[CopiesSection | ActorSection, ...]:
        """Entries of `scene.copies` and `actors`."""
        return *self.scene.copies, *self.actors

    @property
    def source(self) -> str:
        """Name of the scenario in messages."""
        return self._source

    def path(self, file: str) -> Path:
        """Return the path of a file, given its name relative to the folder of the scenario."""
        # `Path.expanduser` raises an error for unknown users.
        return self._folder / os.path.expanduser(file)  # noqa: PTH111

    @property
    def mount_links(self) -> set[str]:
        """Names of the robot links on which sensors are mounted."""
        mounts = [self.mount, *(section.mount for section in self.sensors.values())]
        return {mount.link for mount in mounts if mount is not None and mount.link is not None}

    @property
    def needs_colors(self) -> bool:
        """Whether a column or `reflectance: texture` requires the meshes' colors."""
        columns = {*self.cloud.columns, *self.output.needs}
        return bool(columns & {*COLORS}) or any(m.reflectance == "texture" for m in self.materials)

    @property
    def needs_material_names(self) -> bool:
        """Whether a column or an entry of `materials` requires the meshes' material names."""
        columns = {*self.cloud.columns, *self.output.needs}
        return "material" in columns or any(m.material is not None for m in self.materials)


def _is_contradictory(content: Any) -> bool:
    try:
        return any(Scenario.model_validate(content)._contradictions())
    except ValidationError:  # the content has another error
        return False


def _stated_fields(section: Any) -> Iterator[tuple[str, Any]]:
    """Yield the fields that a section states, with their names in files.

    Models record which fields are set. A field of a dataclass is stated if its value is not the
    default.
    """
    stated = getattr(section, "model_fields_set", None)
    for name, field in fields_of(type(section)).items():
        value = getattr(section, name)
        default = field.get_default(call_default_factory=True)
        if value != default if stated is None else name in stated:
            yield field.alias or name, value


def _plain_data(value: Any, relative: Callable[[str], str]) -> Any:
    """Convert the value of a field to the types of YAML.

    `relative` converts file names.
    """
    if is_section(type(value)):
        return {
            name: relative(field) if _names_file(name, field) else _plain_data(field, relative)
            for name, field in _stated_fields(value)
        }
    if isinstance(value, Mapping):
        return {name: _plain_data(entry, relative) for name, entry in value.items()}
    if isinstance(value, (tuple, list)):
        return [_plain_data(entry, relative) for entry in value]
    return value.isoformat() if isinstance(value, datetime) else value


def _names_file(name: str, value: Any) -> bool:
    """Return whether the value of a field is the name of a file or folder."""
    is_path = name in _PATH_FIELDS and isinstance(value, str)
    return is_path and (name != "model" or value.endswith(MODEL_FILES))


def _find_file_field(section: Any, is_file: Callable[[str], bool]) -> str:
    """Return the path of the first field that contains a file name, or an empty string.

    The path is, for example, ``scene.files[0].file``.

    Parameters
    ----------
    section
        Section to search, including nested sections.
    is_file
        Function that returns whether a string is the name of the file.
    """
    for path, text in _iter_strings(section):
        if path[-1] in _FILE_FIELDS and is_file(text):
            # `file: a.glb` is a short form of `file: {file: a.glb}`.
            return format_path(path[:-1] if path[-2:] == ("file", "file") else path)
    return ""


def _iter_strings(node: Any, path: FieldPath = ()) -> Iterator[tuple[FieldPath, str]]:
    """Yield the strings in a section, list or mapping, with their paths."""
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
        yield from _iter_strings(value, (*path, key))

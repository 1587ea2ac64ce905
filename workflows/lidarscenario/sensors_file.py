"""Sensor files, which describe the sensors of a program that follows another simulator."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, NamedTuple

from pydantic import PrivateAttr, model_validator

from lidarsim.errors import LidarError, Mistakes, prefix_errors
from lidarsim.io.yamlfile import read_yaml
from lidarsim.media.materials import Material
from lidarsim.media.weather import Weather
from lidarsim.motion.trajectory import CENTER
from lidarsim.schema.declared import Several, Text, about, accept_text, declared_values
from lidarsim.schema.error_sentences import convert_validation_errors
from lidarsim.sensor import Noise, Returns
from lidarsim.survey.survey import MAX_SENSORS, CloudOptions, Mounted

from .prepare import MESH_PRECISION_M
from .scenario import Scenario
from .sections import NoiseSection, ReturnsSection, Section, SensorSection, allow_empty
from .traffic.actor_motion import MountedSensorEntry, MountEntry

# Fields that describe a survey, which a program that follows another simulator does not have.
_SURVEY_FIELDS = {"steps"}
# Fields of a scenario that move the sensors or change their measurements, but are not used.
_SCENARIO_FIELDS = ("poses", "trajectory", "steps", "navigation", "faults")
_CLOUD_FIELDS = {"columns", "precision_m"}


class SensorOnFrame(NamedTuple):
    """A sensor, the frame on which it is mounted, and options of its `Scanner`."""

    mounted: Mounted
    frame: str  # name of the frame, or an empty string for the world
    options: Mapping[str, Any]


class SensorsFile(Section):
    """Sensors on frames of a world that another program simulates.

    The sections are those of a scenario. The `link` of a mount is the name of a frame.
    """

    sensor: Annotated[
        SensorSection, allow_empty(SensorSection), accept_text("model", SensorSection | None)
    ] = SensorSection()
    mount: Annotated[MountEntry | None, about("pose of the sensor on a frame", [1, 0, 2])] = None
    sensors: Annotated[
        dict[Text, MountedSensorEntry],
        about("sensors by name, each with its mount; replaces sensor", max_length=MAX_SENSORS),
    ] = {}  # noqa: RUF012 - the model is frozen
    materials: Annotated[Several[Material], about("materials", max_length=100_000)] = ()
    returns: Annotated[ReturnsSection, allow_empty(ReturnsSection)] = ReturnsSection()
    noise: Annotated[NoiseSection, allow_empty(NoiseSection)] = NoiseSection()
    weather: Annotated[Weather, allow_empty(Weather)] = Weather()
    cloud: Annotated[CloudOptions, allow_empty(CloudOptions)] = CloudOptions()

    _folder: Path = PrivateAttr(default=Path())  # folder of relative file names
    _source: str = PrivateAttr(default="the sensor file")  # name of the file in messages
    _unused: tuple[str, ...] = PrivateAttr(default=())

    @model_validator(mode="after")
    def _check_fields(self) -> SensorsFile:
        """Raise ValueError if a field describes a survey, or if sensors contradict each other."""
        if self.sensors and (self.sensor != SensorSection() or self.mount):
            raise ValueError(
                "`sensors` cannot be combined with `sensor` or `mount`. Set the mount of each "
                "entry of `sensors`."
            )
        for name, section in self.sensors.items():
            if used := section.model_fields_set & _SURVEY_FIELDS:
                raise ValueError(
                    f"`sensors.{name}.{min(used)}` cannot be used, because the sensor scans as "
                    "long as the other program runs. Remove it."
                )
        return self

    @classmethod
    def load(cls, path: Path) -> SensorsFile:
        """Read a sensor file.

        Raises
        ------
        LidarError
            If the file is invalid. The message names the file, the field and the value.
        """
        data = read_yaml(path)
        with convert_validation_errors(SensorsFile, path, data):
            file = cls.model_validate(data)
        if unsupported := _unsupported_options(file.cloud):
            raise LidarError(
                f"{path}: `cloud.{unsupported[0]}` cannot be used here. Only `columns` and "
                "`precision_m` are supported."
            )
        file._folder = path.parent
        file._source = str(path)
        return file

    @classmethod
    def from_scenario(cls, scenario: Scenario) -> SensorsFile:
        """Return the sensors of a scenario. Its fields that do not apply are listed in `unused`."""
        names = cls.model_fields.keys() & scenario.model_fields_set
        file = cls().model_copy(update={name: getattr(scenario, name) for name in names})
        file._folder = scenario.path("")
        file._source = scenario.source
        fields = [name for name in _SCENARIO_FIELDS if name in scenario.model_fields_set]
        cloud = [f"cloud.{name}" for name in _unsupported_options(file.cloud)]
        file._unused = (*fields, *cloud)
        return file

    @property
    def unused(self) -> tuple[str, ...]:
        """Names of the scenario's fields that do not apply to sensors on frames."""
        return self._unused

    def sensors_on_frames(self) -> list[SensorOnFrame]:
        """Return the sensors, with the options of `Scanner` that the file states.

        Raises
        ------
        LidarError
            If a file of a sensor cannot be read.
        """
        mistakes = Mistakes()
        sensors = []
        for name, section in self._sections():
            with mistakes.collect(), prefix_errors(self._source):
                mount = self.mount if section is self.sensor else getattr(section, "mount", None)
                pose = CENTER if mount is None else mount.pose()
                mounted = section.mounted_sensor(self._path, pose, self.noise, self.returns, name)
                frame = mount.link if mount is not None and mount.link is not None else ""
                sensors.append(
                    SensorOnFrame(
                        mounted, frame.replace("::", "/").strip("/"), self._options(mounted)
                    )
                )
        mistakes.raise_if_any()
        return sensors

    def _sections(self) -> Iterator[tuple[str, SensorSection]]:
        yield from self.sensors.items() if self.sensors else [("", self.sensor)]

    def _path(self, file: str) -> Path:
        return self._folder / Path(file).expanduser()

    def _options(self, mounted: Mounted) -> dict[str, Any]:
        """Return the options of the scanner of a sensor."""
        precision_m = declared_values(self.cloud, CloudOptions)["precision_m"]
        if not mounted.sensor.optics.resolution_m:
            precision_m = precision_m or MESH_PRECISION_M
        return {
            "columns": tuple(self.cloud.columns),
            "precision_m": precision_m,
            "materials": tuple(self.materials),
            "noise": Noise() if mounted.noise is not None else Noise(**dict(self.noise)),
            "returns": Returns(**dict(self.returns)),
            **declared_values(self.weather, Weather),
        }


def _unsupported_options(cloud: CloudOptions) -> list[str]:
    """Return the names of the options that are set, but not supported here."""
    values = declared_values(cloud, CloudOptions)
    default = declared_values(CloudOptions(), CloudOptions)
    changed = {name for name, value in values.items() if value != default[name]}
    return sorted(changed - _CLOUD_FIELDS)

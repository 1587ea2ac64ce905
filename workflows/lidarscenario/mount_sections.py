"""Vehicle files, which describe the mounting positions that `lidarpool mount` evaluates."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import BeforeValidator, Field, PrivateAttr, model_validator

from lidarsim.errors import Mistakes, prefix_errors
from lidarsim.io.yamlfile import read_yaml
from lidarsim.media.weather import Weather
from lidarsim.motion.trajectory import CENTER, Pose
from lidarsim.schema.declared import (
    AngleDeg,
    Coordinate,
    MinMax,
    Seed,
    Several,
    Text,
    TextOrTexts,
    Three,
    Triple,
    UnitShare,
    about,
    accept_short_form,
    accept_text,
    not_allowed_error,
    require_one_of,
)
from lidarsim.schema.error_sentences import convert_validation_errors
from lidarsim.schema.vocabulary import BODIES, TARGETS
from lidarsim.survey.survey import MAX_SENSORS, Mounted
from lidarsim.words import join_names, list_names

from .scenario import Scenario
from .sections import (
    Length,
    MeshEntry,
    NoiseSection,
    PoseEntry,
    ReturnsSection,
    Section,
    SensorSection,
    allow_empty,
)

MAX_CANDIDATES = 10_000  # combinations of mounts
MAX_POSITIONS = 100_000  # positions and headings of all targets
MAX_CELLS = 4_000_000  # cells of the blind-area map
DEFAULT_HEIGHT_M = 0.3  # default height for the blind area in the score, if it is in the map
_FORM = "A vehicle file contains body:, sensors: and optionally targets:, region: and map:"


class BodyPart(Section):
    """A part of the vehicle body, which is a built-in car, a mesh file or a box.

    In YAML, the name of a built-in car or of a file is sufficient. In the frame of the vehicle, x
    is forward, y is left, and z is up. Its origin is on the ground.
    """

    model: Annotated[
        Literal[BODIES] | None,  # type: ignore[valid-type]
        about("built-in car, centered above the origin", "saloon"),
    ] = None
    file: Annotated[
        MeshEntry | None,
        about("mesh file in the axes of the vehicle, with options as in scene.files", "truck.glb"),
    ] = None
    box: Annotated[
        Three[Length] | None,
        about("length, width and height of a box, whose bottom face is centered at `at`"),
    ] = None
    at: Annotated[PoseEntry, about("pose of the part in the frame of the vehicle")] = CENTER

    _one_shape = require_one_of("model", "file", "box")


def _as_parts(value: Any) -> Any:
    """Convert the short forms of a body to a list of parts."""
    parts = value if isinstance(value, list) else [value]
    if any(isinstance(part, str) and part not in BODIES and "." not in part for part in parts):
        raise not_allowed_error(f"{', '.join(BODIES)}, a mesh file, or a list of parts")
    return [
        {"model" if part in BODIES else "file": part} if isinstance(part, str) else part
        for part in parts
    ]


BodyParts = Several[BodyPart]
BodyEntry = Annotated[
    BodyParts, BeforeValidator(_as_parts, json_schema_input_type=Text | BodyPart | BodyParts)
]


def _accept_number(allowed: Any) -> Any:
    """Accept a number as a short form of a range that contains only this number."""
    return accept_short_form(lambda v: type(v) in (int, float), lambda v: [v, v], allowed)


CoordinateRange = Annotated[MinMax[Coordinate], _accept_number(Coordinate | MinMax[Coordinate])]
AngleRange = Annotated[MinMax[AngleDeg], _accept_number(AngleDeg | MinMax[AngleDeg])]


class MountRanges(Section):
    """Ranges of positions and angles in which a mount is searched.

    A single number fixes the value. The angles are those of a pose.
    """

    x: Annotated[CoordinateRange, about("minimum and maximum of x, in meters", [0.5, 1.5])]
    y: Annotated[CoordinateRange, about("minimum and maximum of y, in meters", 0.0)]
    z: Annotated[CoordinateRange, about("minimum and maximum of z, in meters", [1.5, 2.0])]
    yaw_deg: Annotated[AngleRange, about("minimum and maximum of the yaw, in degrees")] = (0, 0)
    pitch_deg: Annotated[
        AngleRange, about("minimum and maximum of the pitch, in degrees; positive looks down")
    ] = (0, 0)
    roll_deg: Annotated[AngleRange, about("minimum and maximum of the roll, in degrees")] = (0, 0)

    @property
    def limits(self) -> tuple[tuple[float, float], ...]:
        """Minimum and maximum of x, y, z, yaw, pitch and roll."""
        return tuple(tuple(getattr(self, name)) for name in MountRanges.model_fields)


def _as_mounts(value: Any) -> Any:
    """Convert the short forms of mounts to a mapping from names to poses."""
    if isinstance(value, Pose):
        return {"mount": value}
    if isinstance(value, dict) and "position" in value:
        return {"mount": value}
    if not isinstance(value, (list, dict)):
        raise not_allowed_error(
            "a pose, a list of poses, or a mapping from names to poses, such as {roof: [0.8, 0, "
            "1.6]}"
        )
    if isinstance(value, list):
        if value and all(type(number) in (int, float) for number in value):
            value = {"mount": value}
        else:
            value = {str(number): pose for number, pose in enumerate(value, 1)}
    return {
        name: {"position": pose} if isinstance(pose, list) else pose for name, pose in value.items()
    }


MountsEntry = Annotated[
    dict[Text, Pose],
    BeforeValidator(
        _as_mounts,
        json_schema_input_type=Triple | Pose | Several[Triple | Pose] | dict[Text, Triple | Pose],
    ),
]


class CandidateSensor(SensorSection):
    """A sensor of the vehicle with its candidate mounts."""

    mounts: Annotated[
        MountsEntry,
        about(
            "candidate poses of the sensor in the frame of the vehicle, as one pose, as a list, "
            "or by name",
            {"roof": [0.8, 0, 1.6], "grille": {"position": [2.3, 0, 0.7], "pitch_deg": 2}},
            max_length=1000,
        ),
    ] = {}  # noqa: RUF012 - the model is frozen
    ranges: Annotated[
        MountRanges | None,
        about(
            "ranges in which the mount is searched; replaces mounts",
            {"x": [0.5, 1.5], "y": 0, "z": [1.5, 2.0], "pitch_deg": [0, 10]},
        ),
    ] = None

    _one_kind = require_one_of("mounts", "ranges")


class TargetSection(Section):
    """A class of targets, which is a built-in shape, a mesh file or a box."""

    file: Annotated[
        MeshEntry | None,
        about(
            "mesh file in the axes of the target, which stands on z = 0 and faces x, with options "
            "as in scene.files (default: the built-in shape of the class)",
            "truck.glb",
        ),
    ] = None
    box: Annotated[
        Three[Length] | None,
        about("length, width and height of a box, in meters; replaces file"),
    ] = None
    points: Annotated[
        int,
        about("minimum number of points on a detected target", ge=1, le=1_000_000),
    ] = 5
    reflectance: Annotated[UnitShare, about("reflectance of the target")] = 0.1
    weight: Annotated[
        float, about("weight of the class in the detection rate of a candidate", ge=0, le=1e6)
    ] = 1.0

    @model_validator(mode="after")
    def _check_shape(self) -> TargetSection:
        """Raise ValueError if there are two shapes."""
        if self.file is not None and self.box is not None:
            raise ValueError("`file` and `box` cannot be combined.")
        return self


def _as_targets(value: Any) -> Any:
    """Convert a list of class names to a mapping of sections."""
    if isinstance(value, list):
        return {name: {} if isinstance(name, str) else name for name in value}
    if isinstance(value, dict):
        return {name: {} if section is None else section for name, section in value.items()}
    return value


class RegionSection(Section):
    """Positions and headings of the targets around the vehicle."""

    distances_m: Annotated[
        Several[Annotated[float, Field(gt=0, le=1000)]],
        about("horizontal distances from the origin of the vehicle, in meters", min_length=1),
    ] = (3, 5, 8, 12, 18, 27, 40)
    bearings: Annotated[
        int, about("number of evenly spaced bearings, starting straight ahead", ge=1, le=720)
    ] = 24
    headings_deg: Annotated[
        Several[AngleDeg],
        about("headings of the targets relative to the vehicle, in degrees", min_length=1),
    ] = (0, 90)


class TrafficTargets(Section):
    """Targets at the positions of the actors in a scenario, relative to its platform.

    In YAML, the file name of the scenario is sufficient.
    """

    scenario: Annotated[
        Text, about("scenario with a trajectory and actors or traffic", "drive.yaml")
    ]
    interval_s: Annotated[
        float, about("time between two samples of the positions, in seconds", gt=0, le=1e6)
    ] = 1.0
    max_distance_m: Annotated[
        float, about("maximum horizontal distance of a target, in meters", gt=0, le=1000)
    ] = 60.0
    classes: Annotated[
        dict[Text, TextOrTexts],
        about(
            "names of the actors of each class; may contain * and ? (default: all actors are one "
            "class)",
            {"pedestrian": ["Walker*"], "car": "Car*"},
        ),
    ] = {}  # noqa: RUF012 - the model is frozen


class MapSection(Section):
    """The map of the blind area around the vehicle."""

    margin_m: Annotated[
        float, about("distance in meters by which the map extends beyond the vehicle", gt=0, le=200)
    ] = 10.0
    cell_m: Annotated[float, about("side length of a cell, in meters", ge=0.02, le=10)] = 0.25
    heights_m: Annotated[
        Several[Annotated[float, Field(ge=0, le=10)]],
        about(
            "heights of the objects for which the blind area is computed, in meters; 0 is the "
            "ground itself",
            min_length=1,
            max_length=8,
        ),
    ] = (0, 0.3, 1, 1.7)
    reflectance: Annotated[
        UnitShare, about("reflectance of the ground and of the objects on the map")
    ] = 0.1


class RankSection(Section):
    """Weights of the score, which is the detection rate minus the weighted blind share."""

    height_m: Annotated[
        float | None,
        about(
            "height in map.heights_m for which the blind area is part of the score (default: "
            f"{DEFAULT_HEIGHT_M:g}, or the lowest height above 0 if map.heights_m does not contain "
            "it)",
            0.3,
            ge=0,
            le=10,
        ),
    ] = None
    blind_weight: Annotated[
        float, about("weight of the blind share of the map in the score", ge=0, le=1000)
    ] = 1.0


class MountSearch(Section):
    """The search for mounts in ranges."""

    samples: Annotated[
        int, about("number of random mounts of each sensor from which the best is chosen", ge=1,
                   le=100_000)
    ] = 12  # fmt: skip
    refinements: Annotated[
        int,
        about("number of local refinements, each with half the step of the previous one", ge=0,
              le=20),
    ] = 2  # fmt: skip
    seed: Annotated[Seed, about("seed of the random mounts")] = 0


class VehicleFile(Section):
    """A vehicle with candidate mounts of its sensors, and the targets that they must detect.

    Parameters
    ----------
    body, sensors, targets, region, traffic, map, rank, search
        See the sections in this module.
    combine
        How the mounts of several sensors are combined into candidates.
    weather, noise, returns
        As in a scenario.
    """

    body: Annotated[
        BodyEntry,
        about(
            "parts of the vehicle body, which occlude the view: saloon, estate, van, mesh files or "
            "boxes",
            "saloon",
            [{"box": [6, 2.4, 2.8]}, {"file": "cab.glb", "at": [4, 0, 0]}],
            min_length=1,
            max_length=100,
        ),
    ]
    sensors: Annotated[
        dict[Text, CandidateSensor],
        about(
            "sensors by name, each with its candidate mounts",
            {"front": {"model": "ouster/os1-64", "mounts": [[0.8, 0, 1.6], [2.3, 0, 0.7]]}},
            min_length=1,
            max_length=MAX_SENSORS,
        ),
    ]
    combine: Annotated[
        Literal["all", "names"],
        about(
            "candidates: all combinations of the sensors' mounts, or mounts with the same name; a "
            "sensor with a single mount is part of all candidates"
        ),
    ] = "all"
    targets: Annotated[
        dict[Text, TargetSection],
        BeforeValidator(
            _as_targets,
            json_schema_input_type=Several[Text] | dict[Text, TargetSection | None],
        ),
        about(
            f"classes of targets, as a list or with settings; built-in are {join_names(TARGETS)}",
            ["pedestrian", "child"],
            {"pedestrian": {"points": 10}, "truck": {"box": [8, 2.5, 3.5], "weight": 2}},
            min_length=1,
            max_length=100,
        ),
    ] = {name: TargetSection() for name in TARGETS}  # noqa: RUF012 - the model is frozen
    region: RegionSection = RegionSection()
    traffic: Annotated[
        Annotated[TrafficTargets, accept_text("scenario", TrafficTargets)] | None,
        about("targets along the drive of a scenario; replaces targets and region", "drive.yaml"),
    ] = None
    map: MapSection = MapSection()
    rank: RankSection = RankSection()
    search: MountSearch = MountSearch()
    returns: Annotated[ReturnsSection, allow_empty(ReturnsSection)] = ReturnsSection()
    noise: Annotated[NoiseSection, allow_empty(NoiseSection)] = NoiseSection()
    weather: Annotated[Weather, allow_empty(Weather)] = Weather()

    _source: str = PrivateAttr(default="the vehicle file")
    _files: Scenario = PrivateAttr(default_factory=Scenario)  # resolves file names

    @property
    def source(self) -> str:
        """Name of the file in messages."""
        return self._source

    @property
    def files(self) -> Scenario:
        """Empty scenario whose folder is the base of relative file names."""
        return self._files

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a vehicle file.

        Raises
        ------
        LidarError
            If the file is invalid. The message names the file, the field, the value and the
            allowed values.
        """
        path = Path(path)
        return cls.from_data(read_yaml(path, _FORM), source=str(path), folder=path.parent)

    @classmethod
    def from_data(
        cls, data: dict[str, Any], *, source: str = "vehicle file", folder: str | Path = "."
    ) -> Self:
        """Create a vehicle file from its content.

        Parameters
        ----------
        data
            Sections of the file, as read from YAML.
        source
            Name of the file in messages.
        folder
            Folder to which relative file names refer.

        Raises
        ------
        LidarError
            If the content is invalid, as for `load`.

        Examples
        --------
        >>> vehicle = VehicleFile.from_data(
        ...     {"body": "saloon", "sensors": {"top": {"model": "vlp16", "mounts": [0, 0, 1.8]}}}
        ... )
        >>> vehicle.sensors["top"].mounts["mount"].position
        (0.0, 0.0, 1.8)
        """
        with convert_validation_errors(cls, source, data):
            vehicle = cls.model_validate(data)
        vehicle._source = source
        vehicle._files = Scenario.from_data({}, source=source, folder=folder)
        vehicle._check()
        return vehicle

    def mounted_sensor(self, name: str, mount: Pose) -> Mounted:
        """Return a sensor at one of its mounts.

        Raises
        ------
        LidarError
            If a file of the sensor cannot be used.
        """
        with prefix_errors(f"{self._source}: sensors: {name}"):
            return self.sensors[name].mounted_sensor(
                self._files.path, mount, self.noise, self.returns, name
            )

    @property
    def is_search(self) -> bool:
        """Whether the mount of a sensor is searched in ranges."""
        return any(sensor.ranges is not None for sensor in self.sensors.values())

    @property
    def ranked_height_m(self) -> float:
        """Height for which the blind area is part of the score, in meters."""
        if self.rank.height_m is not None:
            return self.rank.height_m
        heights = sorted(self.map.heights_m)
        if DEFAULT_HEIGHT_M in heights:
            return DEFAULT_HEIGHT_M
        above = [height for height in heights if height > 0]
        return (above or heights)[0]

    def _check(self) -> None:
        """Raise LidarError if fields cannot be combined or a sensor model is invalid."""
        mistakes = Mistakes()
        mistakes.lines += [f"{self._source}: {reason}" for reason in self._contradictions()]
        for name in self.sensors:
            with mistakes.collect():
                mounted = self.mounted_sensor(name, CENTER)
                (mounted.returns or self.returns).divergence(mounted.sensor.optics)
        mistakes.raise_if_any()

    def _contradictions(self) -> Iterator[str]:
        """Yield a sentence for each contradiction between fields."""
        for name, target in self.targets.items():
            if target.file is None and target.box is None and name not in TARGETS:
                yield (
                    f"targets: {name} is not a built-in target. Use {list_names([*TARGETS])}, or "
                    "set `file` or `box`."
                )
        if not any(target.weight for target in self.targets.values()):
            yield "targets: At least one target must have a `weight` above 0."
        if self.traffic is not None and self.model_fields_set & {"targets", "region"}:
            yield "`traffic` cannot be combined with `targets` and `region`."
        if self.rank.height_m is not None and self.rank.height_m not in self.map.heights_m:
            heights = list_names([f"{height:g}" for height in self.map.heights_m])
            yield (
                f"rank.height_m is {self.rank.height_m:g}, but must be one of the heights in "
                f"map.heights_m ({heights})."
            )
        yield from self._positions_below_ground()
        yield from self._combination_contradictions()
        positions = len(self.targets) * self.region.bearings
        positions *= len(self.region.distances_m) * len(self.region.headings_deg)
        if positions > MAX_POSITIONS:
            yield (
                f"The targets have {positions:,} positions and headings, but the limit is "
                f"{MAX_POSITIONS:,}. Reduce `bearings`, `distances_m` or `headings_deg`."
            )

    def _positions_below_ground(self) -> Iterator[str]:
        """Yield a sentence for each mount or range that is not above the ground."""
        for name, sensor in self.sensors.items():
            lowest = {f"mounts: {key}": pose.position[2] for key, pose in sensor.mounts.items()}
            if sensor.ranges is not None:
                lowest = {"ranges": sensor.ranges.z[0]}
            for field, z in lowest.items():
                if z <= 0:
                    yield (
                        f"sensors: {name}: {field}: z is {z:g} m, but a sensor must be above the "
                        "ground, which is z = 0 in the frame of the vehicle."
                    )

    def _combination_contradictions(self) -> Iterator[str]:
        """Yield a sentence for each mistake in the combination of mounts."""
        several = {name: s.mounts for name, s in self.sensors.items() if len(s.mounts) > 1}
        if self.combine == "all" and not self.is_search:
            count = math.prod(len(mounts) for mounts in several.values())
            if count > MAX_CANDIDATES:
                yield (
                    f"The mounts have {count:,} combinations, but the limit is "
                    f"{MAX_CANDIDATES:,}. Use fewer mounts, or `combine: names`."
                )
        if self.combine == "names" and self.is_search:
            yield "`combine: names` requires `mounts`, but a sensor has `ranges`."
        elif (
            self.combine == "names" and len({frozenset(mounts) for mounts in several.values()}) > 1
        ):
            described = [
                f"the mounts of {name} are {join_names([*mounts])}"
                for name, mounts in several.items()
            ]
            yield (
                "`combine: names` requires the same mount names for all sensors with several "
                f"mounts, but {', and '.join(described)}."
            )

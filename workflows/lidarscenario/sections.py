"""Sections of scenario files, with limits, defaults and descriptions of their fields."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from functools import cache, lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    SerializeAsAny,
    create_model,
    model_validator,
)

from lidarfiles.clouds.writing import ExportSpec
from lidarsim.errors import LidarError
from lidarsim.media.materials import SemanticClass
from lidarsim.motion.trajectory import Pose
from lidarsim.scene.files.mesh_formats import (
    endings,
    format_of,
    formats_with_plugins,
    unsupported_options,
)
from lidarsim.scene.files.mesh_options import LengthUnit, MeshOptions, Opacity, UpAxis
from lidarsim.scene.transform import Transform
from lidarsim.schema.declared import (
    STRICT,
    AngleDeg,
    Coordinate,
    Four,
    MinMax,
    Rectangle,
    Seed,
    Several,
    Text,
    TextOrTexts,
    Three,
    Triple,
    Two,
    about,
    accept_short_form,
    accept_text,
    not_allowed_error,
    require_one_of,
)
from lidarsim.schema.section_fields import fields_of
from lidarsim.schema.vocabulary import BACKENDS
from lidarsim.sensor import Noise, Returns, Sensor
from lidarsim.sensor.beams import Rate, Step
from lidarsim.sensor.models import MODEL_FILES, Sheet, load_sensor
from lidarsim.sensor.packet_settings import Identifier
from lidarsim.sensor.sensor import Fov, Layers, MaxRange, MinRange, RaysPerRevolution, Sector
from lidarsim.survey.survey import EpsgCode, Mounted

from .plan.planning import Search

MAX_COPIES = 1_000_000  # maximum number of copies of an entry
ResolvePath = Callable[[str], Path]  # returns the path of a file that is named in a scenario

IgnoredColumns = Annotated[
    TextOrTexts, about("names of columns to ignore; may contain * and ?", "remarks")
]
Factor = Annotated[float, Field(ge=-1e9, le=1e9)]
Pair = Two[Coordinate]


Factors = Three[Factor]
Scale = Annotated[
    Factors,
    accept_short_form(lambda v: type(v) in (int, float), lambda v: [v] * 3, Factor | Factors),
]
Length = Annotated[float, Field(gt=0, le=1e4)]


class Section(BaseModel):
    """Base class of scenario sections.

    Validation rejects unknown fields, infinite numbers, and numbers that are given as text.
    """

    model_config = STRICT | ConfigDict(frozen=True)


class MeshFile(Section):
    """A mesh file or raster and its placement.

    In YAML, the file name alone is sufficient.

    The mesh is scaled first, then rotated about the x, y and z axes of the world, and then
    translated. `matrix` replaces these three steps. Relative file names refer to the folder of the
    scenario.
    """

    file: Annotated[
        str,
        about(
            f"mesh file or height raster ({' '.join(endings())}) or stationary robot (.urdf), "
            "relative to the folder of the scenario",
            min_length=1,
            max_length=4096,
        ),
    ]
    unit: LengthUnit = None
    up_axis: UpAxis = None
    translation: Annotated[Triple, about("translation in meters, applied last")] = (0, 0, 0)
    rotation_deg: Annotated[
        Three[AngleDeg],
        about("angles of the rotations about the x, y and z axes of the world, in degrees"),
    ] = (0, 0, 0)
    scale: Annotated[Scale, about("scale factor, or one factor for each axis; applied first")] = (
        1,
        1,
        1,
    )
    matrix: Annotated[
        Four[Four[Factor]] | None,
        about(
            "4 x 4 transformation matrix as four rows, in meters; cannot be combined with "
            "translation, rotation_deg and scale"
        ),
    ] = None
    opacity: Opacity = "mask"
    assets: Annotated[
        Text | None,
        about(
            "additional folder from which the file may load other files, relative to the folder "
            "of the scenario",
            "..",
        ),
    ] = None

    @model_validator(mode="wrap")
    @classmethod
    def _with_options(cls, value: Any, handler: Callable[[Any], MeshFile]) -> MeshFile:
        """Validate a file and the options of its format.

        Raise ValueError if an option belongs to a different format.
        """
        if cls is not MeshFile or not isinstance(value, dict):
            return handler(value)
        file = value.get("file")
        try:
            row = format_of(file) if isinstance(file, str) else None
            kind = MeshFile if row is None else _kind_of_file(row.own_options)
            further = value.keys() - kind.model_fields.keys()
            if further:  # this imports the options of all formats, so do it only if necessary
                further &= {name for other in MeshFile.kinds() for name in other.model_fields}
            if further and not isinstance(file, str):  # report only that the file name is missing
                return handler({name: v for name, v in value.items() if name not in further})
            if further:
                problem = unsupported_options(row, [name for name in value if name in further])
                raise ValueError(f"{file} {problem}")
        except LidarError as error:  # raised by a plug-in
            raise ValueError(str(error)) from error
        return handler(value) if kind is MeshFile else kind.model_validate(value)

    def __reduce__(self) -> Any:
        """Return the content for pickling.

        The subclasses for file formats are created at run time, so they cannot be pickled by
        reference.
        """
        return MeshFile.model_validate, (self.model_dump(exclude_unset=True),)

    @staticmethod
    def kinds() -> list[type[MeshFile]]:
        """Return the subclasses for all file formats with options, including those of plug-ins."""
        options = dict.fromkeys(row.own_options for row in formats_with_plugins())
        return [kind for kind in map(_kind_of_file, options) if kind is not MeshFile]

    @property
    def reading_options(self) -> dict[str, Any]:
        """Keyword arguments for `load_objects`, excluding folders."""
        own = type(self).model_fields.keys() - MeshFile.model_fields.keys()
        shared = {field.name for field in fields(MeshOptions)} & MeshFile.model_fields.keys()
        return self.model_dump(include={*own, *shared} - {"assets"}, exclude_unset=True)

    @model_validator(mode="after")
    def _check_placement(self) -> MeshFile:
        """Raise ValueError if the mesh is placed twice or has a scale of 0."""
        placed = self.model_fields_set & {"translation", "rotation_deg", "scale"}
        if self.matrix is not None and placed:
            raise ValueError(f"`matrix` and `{min(placed)}` cannot be combined.")
        if 0 in self.scale:
            raise ValueError("`scale` must not be 0.")
        return self

    def transform(self) -> Transform:
        """Return the transformation from file coordinates to world coordinates."""
        if self.matrix is not None:
            return Transform.from_matrix(self.matrix)
        return Transform.from_parts(self.translation, self.rotation_deg, self.scale)


@cache
def _kind_of_file(options: type | None) -> type[MeshFile]:
    """Return the `MeshFile` subclass for a file format with the given options.

    Its fields include those options of the format that are declared with `about`.
    """
    declared = {} if options is None else fields_of(options)
    described = {name: field for name, field in declared.items() if field.description}
    if options is None or not described:
        return MeshFile
    further: Any = {name: (field.annotation, field) for name, field in described.items()}
    return create_model(options.__name__, __base__=MeshFile, __module__=__name__, **further)


MeshEntry = Annotated[MeshFile, SerializeAsAny(), accept_text("file", MeshFile)]
MeshEntries = Several[MeshEntry]


def _as_pose_mapping(value: Any) -> Any:
    """Convert a position, which is the short form of a pose, to a mapping."""
    if isinstance(value, list):
        return {"position": value}
    if not isinstance(value, (dict, Pose)):
        raise not_allowed_error(
            "x, y and z in meters, such as [0, 0, 1], or a position and angles, such as "
            "{position: [0, 0, 1], yaw_deg: 90}"
        )
    return value


def by_position(kind: Any, position: Any = Triple) -> BeforeValidator:
    """Return a validator that accepts a position such as [0, 0, 1] in place of a pose."""
    return BeforeValidator(_as_pose_mapping, json_schema_input_type=position | kind)


PoseEntry = Annotated[Pose, by_position(Pose)]
PointXYZ = Annotated[Several[Coordinate], Field(min_length=2, max_length=3)]  # [x, y] or [x, y, z]


class CopySection(Section, Pose):
    """Position, angles and scale of a copy.

    In YAML, [x, y] or [x, y, z] alone is sufficient.
    """

    position: Annotated[  # type: ignore[assignment]  # z may be omitted
        PointXYZ,
        about("x, y and z of the mesh origin, in meters; without z, the copy is on the surface"),
    ]
    scale: Annotated[Scale, about("scale factor, or one factor for each axis of the mesh")] = (
        1,
        1,
        1,
    )


class CopyTable(Section):
    """Poses of copies from a table.

    In YAML, the file name alone is sufficient.
    """

    file: Annotated[Text, about("table with a header, relative to the folder of the scenario")]
    columns: Annotated[
        dict[str, str],
        about(
            "column names in the file for x, y, z, yaw_deg, pitch_deg, roll_deg, scale, scale_x, "
            "scale_y and scale_z, such as {x: easting}"
        ),
    ] = {}
    ignore: IgnoredColumns = ()


class Scatter(Section):
    """Copies at random positions, which are placed upright on surfaces.

    The same settings always result in the same copies.
    """

    count: Annotated[int, about("number of copies", ge=1, le=MAX_COPIES)]
    surfaces: Annotated[  # not named "on", which YAML reads as true
        TextOrTexts,
        about(
            "names of the objects to place copies on; may contain * and ? (default: all objects)",
            min_length=1,
        ),
    ] = ("*",)
    within: Annotated[
        Rectangle | None,
        about("rectangle [x0, y0, x1, y1] with the minimum and maximum x and y, in meters"),
    ] = None
    spacing_m: Annotated[
        float, about("minimum horizontal distance between two copies, in meters", ge=0, le=1e6)
    ] = 0.0
    scale: Annotated[
        MinMax[Annotated[float, Field(gt=0, le=1e9)]],
        about("minimum and maximum of the random scale factor"),
    ] = (1, 1)
    yaw_deg: Annotated[
        AngleDeg | None, about("yaw of all copies (default: a random yaw for each copy)")
    ] = None
    seed: Annotated[Seed, about("seed of the random positions, scales and yaws")] = 0


class ShapeSection(Section):
    """Shape of an object, which is a mesh file or a box, and the class of its points."""

    name: Annotated[Text | None, about("name of the object")] = None
    file: Annotated[
        MeshEntry | None,
        about("mesh file in the axes of the object, with options as in scene.files", "car.glb"),
    ] = None
    box: Annotated[
        Three[Length] | None,
        about("length, width and height of a box, in meters; replaces file"),
    ] = None
    semantic_class: Annotated[
        SemanticClass | None,
        about("semantic class of the points (default: the class of the material)", alias="class"),
    ] = None

    _one_shape = require_one_of("file", "box")


class AnimationSection(Section):
    """An animation in the .glb, .gltf or .usd file of an actor.

    In YAML, the name of the animation alone is sufficient.
    """

    name: Annotated[
        Text | None, about("name of the animation in the file (default: the first)", "Walk")
    ] = None
    speed_m_s: Annotated[
        float | None,
        about(
            "speed of the actor at which the animation plays at its original rate; the rate is "
            "proportional to the speed (default: the rate does not depend on the speed)",
            1.4,
            gt=0,
            le=1000,
        ),
    ] = None
    repeat: Annotated[
        bool, about("whether the animation repeats; otherwise, its last pose is kept")
    ] = True
    offset_s: Annotated[
        float,
        about("time in the animation at the start of the survey, in seconds", ge=-1e9, le=1e9),
    ] = 0.0


class DeformingSection(ShapeSection):
    """A shape that may be animated or have wheels."""

    animation: Annotated[
        Annotated[AnimationSection, accept_text("name", AnimationSection)] | None,
        about("animation in the file that deforms the object", {"name": "Walk"}),
    ] = None
    wheels: Annotated[
        TextOrTexts | None,
        about(
            "names of objects in the file that rotate like wheels as the actor moves; may contain "
            "* and ?",
            "wheel*",
            min_length=1,
        ),
    ] = None

    @model_validator(mode="after")
    def _check_deformation(self) -> DeformingSection:
        """Raise ValueError if a deformation has no file or there are two deformations."""
        deformations = [name for name in ("animation", "wheels") if getattr(self, name) is not None]
        if deformations and self.file is None:
            raise ValueError(f"`{deformations[0]}` requires a mesh file. Set `file`.")
        if len(deformations) > 1:
            raise ValueError("`animation` and `wheels` cannot be combined.")
        return self


class CopiesSection(ShapeSection):
    """Copies of an object at many positions.

    Each copy is a separate object, but all copies share a single mesh.
    """

    name: Annotated[
        Text, about("name of the first copy; further copies are numbered, as in Tree, Tree.2")
    ]
    at: Annotated[
        Several[Annotated[CopySection, by_position(CopySection, PointXYZ)]],
        about(
            "positions [x, y] or [x, y, z] in meters, or poses with angles and a scale",
            max_length=MAX_COPIES,
        ),
    ] = ()
    table: Annotated[
        Annotated[CopyTable, accept_text("file", CopyTable)] | None,
        about("table with poses; replaces at", "trees.csv"),
    ] = None
    scatter: Annotated[
        Scatter | None,
        about("copies at random positions on surfaces; replaces at", {"count": 100}),
    ] = None

    _one_list = require_one_of("at", "table", "scatter")


class Ground(Section):
    """A horizontal rectangle under the objects, poses, trajectories and actors of a scenario."""

    height_m: Annotated[Coordinate, about("z coordinate of the rectangle, in meters")] = 0.0
    margin_m: Annotated[
        float,
        about(
            "distance in meters by which the ground extends beyond the objects, poses, "
            "trajectories and actors on each side",
            ge=0,
            le=1e6,
        ),
    ] = 5.0


class SceneSection(Section):
    """The scene, which consists of mesh files, copies of objects, a ground and a preset.

    In YAML, a file name, a list of files or the name of a preset alone is sufficient.
    """

    preset: Annotated[
        Literal["seed"] | None,
        about("predefined scene; seed contains the six objects of `lidarpool demo`", "seed"),
    ] = None
    files: Annotated[
        MeshEntries,
        accept_short_form(
            lambda v: isinstance(v, (str, dict)), lambda v: [v], MeshEntry | MeshEntries
        ),
        about(
            "mesh files and height rasters, as file names or with options such as unit, up_axis, "
            "scale, rotation_deg and translation",
            ["hall.glb", {"file": "part.stl", "unit": "mm", "translation": [1, 0, 0]}],
            max_length=10_000,
        ),
    ] = ()
    copies: Annotated[
        Several[CopiesSection],
        about(
            "copies of objects at many positions, from a list or table, or at random",
            [{"name": "Crate", "box": [1, 1, 1], "at": [[4, 5, 0], [6, 5, 0]], "class": 4}],
            [{"name": "Tree", "file": "tree.glb", "scatter": {"count": 100, "surfaces": "Ground"}}],
            max_length=10_000,
        ),
    ] = ()
    same_names: Annotated[
        Literal["number", "join"],
        about(
            "treatment of objects with the same name in files: number renames them, as in Wall "
            "and Wall.2, and join combines them into one object"
        ),
    ] = "number"
    ground: Annotated[
        Ground | None,
        about(
            "horizontal rectangle under the objects, poses, trajectories and actors",
            {"height_m": 0, "margin_m": 5},
        ),
    ] = None

    @property
    def has_seed(self) -> bool:
        """Whether the scene contains the six objects of the demo."""
        return self.preset == "seed"


class WorldSection(Section):
    """Coordinate system of the output, and the origin of the scenario in it.

    The scene, poses, trajectories and plans use the coordinates of the scenario. `origin` is added
    to points and poses when they are written.
    """

    epsg: Annotated[
        EpsgCode | None,
        about(
            "EPSG code of the coordinate system, which is stored in point cloud files and to which "
            "rasters are converted (default: from the files of the scene)",
            25832,
        ),
    ] = None
    origin: Annotated[
        Triple,
        accept_short_form(
            lambda v: isinstance(v, (list, tuple)) and len(v) == 2,
            lambda v: [*v, 0.0],
            Pair | Triple,
        ),
        about(
            "coordinates of the scenario's origin in this system, as [x, y] or [x, y, z] in "
            "meters, where x is easting and y is northing"
        ),
    ] = (0, 0, 0)


class PacketSection(Section):
    """Settings of the manufacturer's packets, which override those of the sensor file."""

    ports: Annotated[
        dict[str, Annotated[int, Field(ge=1, le=65_535)]],
        about("UDP port of each packet type", {"lidar": 7502}),
    ] = {}
    identifiers: Annotated[
        dict[str, Identifier],
        about("identifiers that the packet format defines", {"profile": "LEGACY"}),
    ] = {}


class SensorSection(Section):
    """The lidar, which is a model, a calibrated unit, or a rotating head with evenly spaced beams.

    In YAML, the model alone is sufficient. `load_sensor` reads models and calibrations, and
    `Sensor` describes the rotating head.
    """

    model: Annotated[
        str | None,
        about(
            "sensor model from `lidarpool sensors`, or a .yaml file relative to the folder of the "
            "scenario",
            "velodyne/vlp16",
        ),
    ] = None
    calibration: Annotated[
        str | None,
        about(
            "calibration file of a Velodyne, Ouster, Hesai, RoboSense or Livox sensor, or a beam "
            "table",
            "unit.json",
        ),
    ] = None
    columns: Annotated[
        int | None,
        about(
            "number of azimuth steps per revolution, or of pulses per cycle of a mirror (Ouster "
            "sensors, sensors with a mirror, and beam tables only)",
            512,
            ge=1,
            le=100_000,
        ),
    ] = None
    rays_per_revolution: RaysPerRevolution = 1000
    layers: Layers = 40
    vertical_fov_deg: Fov = 60.0
    horizontal_fov_deg: Sector = 360.0
    step_deg: Step = 10.0
    rate_hz: Annotated[
        Rate | None,
        about(
            "revolutions, lines or frames per second (default: from the model, otherwise 10)", 20.0
        ),
    ] = None
    min_range_m: Annotated[
        MinRange | None,
        about("minimum range in meters (default: from the model, otherwise 0)", 0.5),
    ] = None
    max_range_m: Annotated[
        MaxRange | None,
        about("maximum range in meters (default: from the model, otherwise .inf)", 100.0),
    ] = None

    performance: Annotated[
        Sheet | None,
        about(
            "noise, detection range and beam of the model: with datasheet, they are those of the "
            "data sheet unless noise and returns override them; with ideal, data sheet values are "
            "ignored (default: datasheet for a .yaml file with these values, otherwise ideal)",
            "ideal",
        ),
    ] = None

    unseen: Annotated[
        TextOrTexts,
        about(
            "names of objects that the rays of the sensor pass through; may contain * and ?",
            ["housing*"],
        ),
    ] = ()

    packets: Annotated[
        PacketSection | None,
        about(
            "settings of the manufacturer's packets in pcap files (default: from the model)",
            {"ports": {}, "identifiers": {}},
        ),
    ] = None

    @model_validator(mode="after")
    def _check_source(self) -> SensorSection:
        """Raise ValueError if fields of the sensor cannot be combined."""
        sources = [name for name in ("model", "calibration") if getattr(self, name) is not None]
        # Defaults are allowed, because `lidarpool init --all` writes them.
        fields = SensorSection.model_fields
        names = ("rays_per_revolution", "layers", "vertical_fov_deg", "horizontal_fov_deg")
        grid = [name for name in names if getattr(self, name) != fields[name].default]
        if sources and grid:
            raise ValueError(
                f"`{sources[0]}` and `{grid[0]}` cannot be combined, because the {sources[0]} "
                "defines the beams."
            )
        if self.performance == "datasheet" and self.model is None:
            raise ValueError(
                "`performance: datasheet` requires a sensor model. Set `model`, for example "
                "`model: ouster/os1-64`."
            )
        if self.columns is not None and "rays_per_revolution" in grid:
            raise ValueError(
                "`columns` and `rays_per_revolution` have the same meaning and cannot be combined."
            )
        return self

    @property
    def has_custom_model(self) -> bool:
        """Whether the model is a file provided by the user."""
        return self.model is not None and self.model.endswith(MODEL_FILES)

    def mounted_sensor(
        self,
        path: ResolvePath,
        mount: Pose,
        noise: NoiseSection,
        returns: ReturnsSection,
        name: str = "",
    ) -> Mounted:
        """Return the sensor on its platform.

        Equal sections share a sensor, unless their files have changed. If the sensor has data sheet
        values, its noise and returns are those of the data sheet, except for the fields that are
        set in `noise` and `returns`.

        Parameters
        ----------
        path
            Function that returns the path of a file in the scenario.
        mount
            Pose of the sensor in the platform frame.
        noise, returns
            Sections `noise` and `returns` of the scenario.
        name
            Name of the sensor.

        Raises
        ------
        LidarError
            If a file cannot be used.
        """
        limit_names = {"rate_hz", "min_range_m", "max_range_m"}
        limits = self.model_dump(include=limit_names, exclude_none=True)
        model = path(self.model) if self.model and self.has_custom_model else self.model
        calibration = None if self.calibration is None else path(self.calibration)
        if model is None and calibration is None:
            grid = {"layers", "vertical_fov_deg", "horizontal_fov_deg", "step_deg"}
            azimuths = self.columns or self.rays_per_revolution
            sensor = _grid_sensor(azimuths, **self.model_dump(include=grid), **limits)
        else:
            states = file_states(file for file in (model, calibration) if isinstance(file, Path))
            options = self.model_dump(include={"columns", "step_deg", "performance"})
            sensor = _load_sensor(states, model=model, calibration=calibration, **options, **limits)
        if self.packets is not None and (self.packets.ports or self.packets.identifiers):
            sensor = _with_packets(sensor, self.packets.model_dump_json())
        if sensor.noise is None or sensor.returns is None:
            return Mounted(sensor, mount, name, unseen=self.unseen)
        sheet_returns = replace(sensor.returns, **returns.model_dump(exclude_unset=True))
        sheet_noise = replace(sensor.noise, **noise.model_dump(exclude_unset=True))
        return Mounted(
            sensor, mount, name, returns=sheet_returns, noise=sheet_noise, unseen=self.unseen
        )


def file_states(files: Iterable[Path]) -> tuple[tuple[Path, int, int], ...]:
    """Return the path, modification time and size of each existing file.

    The result is used to detect whether files have changed.
    """
    states = []
    for path in files:
        with suppress(OSError, ValueError):  # errors are reported when the file is read
            status = path.stat()
            states.append((path, status.st_mtime_ns, status.st_size))
    return tuple(states)


_grid_sensor = lru_cache(Sensor.grid)


@lru_cache
def _load_sensor(_: object, **options: Any) -> Sensor:
    """Load a sensor.

    The first argument contains the states of its files and serves as a cache key.
    """
    return load_sensor(**options)


@lru_cache
def _with_packets(sensor: Sensor, section: str) -> Sensor:
    """Return a sensor with the ports and identifiers that a `PacketSection` specifies.

    `section` is the section as JSON, so that it can be a cache key.
    """
    values = PacketSection.model_validate_json(section)
    return sensor.with_packets(values.ports, values.identifiers)


class OutputSection(Section):
    """Additional output files.

    Columns that the formats require are added to the cloud.
    """

    write: Annotated[
        Several[Annotated[ExportSpec, accept_text("format", ExportSpec)]],
        about("additional formats of the cloud", ["laz", {"format": "mcap", "layout": "autoware"}]),
    ] = ()

    @model_validator(mode="after")
    def _check_formats(self) -> OutputSection:
        """Raise ValueError if a format is listed twice."""
        names = [entry.format for entry in self.write]
        if twice := next((name for name in names if names.count(name) > 1), None):
            raise ValueError(
                f"`write` contains {twice} twice, but both entries would write the same file. To "
                "write a second file of this format, use `lidarpool export --out`."
            )
        return self

    @property
    def needs(self) -> tuple[str, ...]:
        """Names of the columns that the formats require."""
        return tuple(dict.fromkeys(name for entry in self.write for name in entry.needs))


Ring = Annotated[Several[Pair], Field(min_length=3)]


class FlightSection(Section):
    """Plan of an airborne survey, with which the point density is compared."""

    density_m2: Annotated[
        float, about("planned number of points per square meter", 20, gt=0, le=1e6)
    ]
    area: Annotated[
        Several[Ring],
        about(
            "corners [x, y] of the planned area, in meters, as a list of rings; a ring within "
            "another ring is a hole",
            [[[0, 0], [400, 0], [400, 200], [0, 200]]],
            min_length=1,
        ),
    ]


class ReturnsSection(Section, Returns):
    """Sub-rays of the beams, and the returns that are reported."""


class NoiseSection(Section, Noise):
    """Noise of ranges and angles, lost returns, and false returns."""


class Obstacle(Section):
    """An obstacle, which is a disc or the bounding circle of an object.

    `object` may contain * and ?. In YAML, this name alone is sufficient, as in `- Shelf*`.
    """

    object: Annotated[Text | None, about("name of an object in the scene; may contain * and ?")] = (
        None
    )
    center: Annotated[Pair | None, about("x and y of the center of a disc, in meters")] = None
    radius_m: Annotated[float | None, about("radius of the disc, in meters", gt=0, le=1e6)] = None

    @model_validator(mode="after")
    def _check_kind(self) -> Obstacle:
        """Raise ValueError unless the obstacle is either an object or a disc."""
        disc = self.center is not None and self.radius_m is not None
        if (self.object is None) != disc or (
            self.object is not None and self.model_fields_set > {"object"}
        ):
            raise ValueError("Set either `object`, or both `center` and `radius_m`.")
        return self


Obstacles = Several[Annotated[Obstacle, accept_text("object", Obstacle)]]


class _Route:
    """First fields of `PlanningSection`, which are followed by those of `Search`.

    Positions are in world coordinates, and obstacles may be selected by name.
    """

    enabled: Annotated[
        bool | None,
        about("whether to plan a path (default: true if start and target are set)", True),
    ] = None
    start: Annotated[Pair | None, about("x and y of the start, in meters", [25, 25])] = None
    target: Annotated[Pair | None, about("x and y of the target, in meters", [-30, -20])] = None
    obstacles: Annotated[
        Obstacles | None,
        accept_short_form(
            lambda v: v == "auto", lambda v: None, Literal["auto"] | Obstacles | None
        ),
        about(
            "list of obstacles, or auto for the bounding circles of all objects that are not flat",
            "auto",
            ["Shelf*", {"center": [-6, -1], "radius_m": 1}],
        ),
    ] = None
    clearance_m: Annotated[
        float, about("minimum distance to obstacles, in meters", ge=0, le=1000)
    ] = 0.0


class PlanningSection(Section, Search, _Route):
    """Path planning in the plane, in world coordinates.

    A path is planned if `start` and `target` are set, unless `enabled` is false. `obstacles` is a
    list, or `auto` for the bounding circle of each object that is not flat. `clearance_m` is added
    to the radius of each obstacle.
    """


@dataclass(frozen=True, eq=False, kw_only=True)
class TaskOptions:
    """Options for the tasks of a run, which apply to any cluster."""

    collectors: Annotated[int, about("number of tasks that write the parts", ge=1, le=64)] = 2
    queue_capacity: Annotated[
        int,
        about("maximum number of items by which stage 1 is ahead of stage 2", ge=1, le=100_000),
    ] = 10
    batch_mb: Annotated[
        int,
        about(
            "maximum memory in megabytes of a batch of scans, which a GPU worker casts at once",
            ge=1,
            le=1_000_000,
        ),
    ] = 256
    backend: Annotated[
        Literal[BACKENDS],  # type: ignore[valid-type]
        about(
            "ray-casting backend: cuda, tiles (compiled code for CPUs) or numpy; auto selects the "
            "fastest available backend"
        ),
    ] = "auto"


class _WorkerCounts:
    """First fields of `PoolSection`, which are followed by those of `TaskOptions`."""

    gpu: Annotated[
        int | None,
        about("number of workers that cast rays (default: one for each GPU)", 1, ge=1, le=10_000),
    ] = None
    other: Annotated[
        int | None,
        about(
            "number of workers that plan paths (default: depends on the number of cores)",
            1,
            ge=1,
            le=10_000,
        ),
    ] = None


class PoolSection(Section, TaskOptions, _WorkerCounts):
    """The worker partitions and their tasks.

    `gpu` and `other` set the number of workers in a local cluster, which depends on the machine by
    default. They have no effect on a cluster that is already running. The other fields apply to
    every cluster.
    """


def allow_empty(kind: Any) -> Any:
    """Return a validator that also accepts an empty section or mapping.

    In YAML, the value of a section is null if all of its lines are commented out.
    """
    return accept_short_form(lambda v: v is None, lambda v: {}, kind | None)


# Short forms of a scene: the name of a mesh file or preset, or a list of files.
allow_scene_short_form = accept_short_form(
    lambda v: v is None or isinstance(v, (str, list)),
    lambda v: {"preset" if v == "seed" else "files": v} if v else {},
    Text | MeshEntries | SceneSection | None,
)

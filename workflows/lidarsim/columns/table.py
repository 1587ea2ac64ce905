"""The column table, which lists all point quantities and their sources.

This is the only list of columns. Sensors, simulation steps, parts, exporters, the viewer, the
report and the documentation all use it. To define a custom column, add a `Column` to
`Survey.columns`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from ..errors import LidarError
from ..numerics.arrays import AnyArray
from ..schema.checks import check_fields
from ..schema.value_texts import one_line
from ..words import did_you_mean
from .waveforms import WAVEFORM, column_type

Kind = Literal["number", "label"]  # displayed with a color scale, or with one color per value
Scale = Literal["linear", "logarithmic"]

NO_SURFACE = "no surface"  # shown in place of an object name
# Causes of a return. The column `cause` contains indices into this tuple.
CAUSES = ("surface", "air", "false alarm", "crosstalk", "blooming", "ghost", "spray")
VELOCITY = "radial_velocity"
COORDINATES = ("world", "sensor")  # coordinate systems in which points can be stored
NORMAL = ("normal_x", "normal_y", "normal_z")
ORIGIN = ("origin_x", "origin_y", "origin_z")
FLOW = ("flow_x", "flow_y", "flow_z")
FLOW_EGO = ("flow_ego_x", "flow_ego_y", "flow_ego_z")
VECTORS = (NORMAL, ORIGIN, FLOW, FLOW_EGO)  # columns that must be selected together
SURFACE_COLUMNS = (*NORMAL, "incidence_deg", *ORIGIN, *FLOW, *FLOW_EGO)
_OPEN3D = ("positions", "normals", "colors")  # names to which Open3D assigns three numbers


@dataclass(frozen=True)
class Column:
    """Description of a point cloud column, which has one value per point.

    Parameters
    ----------
    name
        Name of the column, which must be a Python identifier. Files use this name as well, unless
        `file_name` is set.
    dtype
        NumPy dtype of the values, for example "float32".
    unit
        Unit of the values, or "" if they have no unit.
    meaning
        Description in a few words, without a period.
    source
        Source of the values. It is either the name of an attribute of
        `lidarsim.simulator.points.batch_points.BatchPoints`, which contains the returns in a batch,
        or a function that receives this object and returns an array of shape (n,). The function
        runs on the worker that casts the rays. By default, the attribute with the same name as the
        column is used.
    coordinates
        Coordinate system of the values: "world", "sensor", or "" if the values are not coordinates.
    kind
        How the values are displayed: "number" uses a color scale, and "label" uses one color per
        value.
    file_name
        Name of the column in files, if it differs from `name`.
    scale
        Color scale for numbers: "linear" for positions, angles, times and counts, or "logarithmic"
        for quantities that vary by large factors, such as energies.

    Raises
    ------
    LidarError
        If the name is not an identifier, or if the dtype is neither an integer nor a floating-point
        type.
    """

    name: str
    dtype: str
    unit: str
    meaning: str
    source: str | Callable[[Any], AnyArray] = ""
    coordinates: str = ""
    kind: Kind = "number"
    file_name: str = ""
    scale: Scale = "linear"

    __repr__ = one_line

    def __post_init__(self) -> None:
        check_fields(self)
        if not self.name.isidentifier():
            raise LidarError(f"The name of a column must be an identifier, but is {self.name!r}.")
        try:
            kind = np.dtype(self.dtype).kind
            supported = kind in "iuf" or (kind == "V" and self.name == WAVEFORM)
        except TypeError:
            supported = False
        if not supported:
            raise LidarError(
                f"The type of column {self.name!r} must be integer or floating point, such as "
                f"uint8 or float32, but is {self.dtype!r}."
            )

    @property
    def in_files(self) -> str:
        """Name of the column in files."""
        return self.file_name or self.name

    def make(self, returns: Any) -> AnyArray:
        """Compute the values of this column for the returns in a batch.

        The result has shape (n,) and the dtype of the column.

        Raises
        ------
        LidarError
            If the source does not provide one value per return, or if a value does not fit the
            dtype.
        """
        source = self.source or self.name
        values = np.asarray(source(returns) if callable(source) else getattr(returns, source))
        if values.shape != (len(returns),):
            raise LidarError(
                f"Column {self.name!r} must have one value for each of the {len(returns)} points, "
                f"but has the shape {values.shape}."
            )
        dtype = np.dtype(self.dtype)
        if dtype.kind in "iu" and len(values) and values.dtype != dtype:
            limits = np.iinfo(dtype)
            if values.dtype.kind == "f" and not np.isfinite(values).all():
                raise LidarError(
                    f"Column {self.name!r} contains NaN or infinity, which {dtype} cannot "
                    "represent."
                )
            if values.min() < limits.min or values.max() > limits.max:
                raise LidarError(
                    f"Column {self.name!r} contains {values.min()} to {values.max()}, but {dtype} "
                    f"is limited to {limits.min} to {limits.max}. Use a wider type."
                )
        return values.astype(dtype, copy=False)


SCAN = Column(
    "scan", "int32", "", "scan that the point belongs to: one time step at one pose", kind="label"
)
X = Column("x", "int32", "m", "x coordinate, east in map coordinates", "cell_x", "world")
Y = Column("y", "int32", "m", "y coordinate, north in map coordinates", "cell_y", "world")
Z = Column("z", "int32", "m", "z coordinate, up", "cell_z", "world")
CHANNEL = Column(
    "channel", "uint16", "", "beam of the sensor; 0 is the lowest", kind="label", file_name="ring"
)
OBJECT = Column(
    "object",
    "int32",
    "",
    "object that was hit; -1 if the return is not from a surface",
    kind="label",
)

AXES = (X, Y, Z)  # parts store integer multiples of the precision, from the local scene origin
ALWAYS = (*AXES, CHANNEL, OBJECT)  # columns in every part; `scan` follows from the row
OPTIONAL = (
    Column("ray", "uint32", "", "index of the ray in its scan"),
    Column("time", "int64", "ns", "time of the ray since the start of the survey"),
    Column(
        "azimuth", "float32", "deg", "azimuth about the z axis of the sensor", coordinates="sensor"
    ),
    Column(
        "elevation",
        "float32",
        "deg",
        "elevation above the xy plane of the sensor",
        coordinates="sensor",
    ),
    Column("range", "float32", "m", "distance from the beam origin", coordinates="sensor"),
    Column(
        "intensity",
        "float32",
        "",
        "received energy; 1 for a white surface at normal incidence, 10 m away in clear air",
        scale="logarithmic",
    ),
    Column(
        "reflectance",
        "float32",
        "",
        "intensity corrected for range and attenuation: surface reflectance times the cosine of "
        "the angle of incidence",
    ),
    Column("reflectivity", "uint8", "", "reflectance on the scale of the sensor manufacturer"),
    Column(
        "signal",
        "uint16",
        "",
        "intensity in counts: 10,000 for an intensity of 1, at most 65,535",
        scale="logarithmic",
    ),
    Column(
        VELOCITY,
        "float32",
        "m/s",
        "radial velocity: positive if the range increases, negative if it decreases; NaN for "
        "false alarms",
    ),
    Column(
        "amplitude",
        "float32",
        "",
        "peak of the echo in the waveform, clipped at the receiver saturation; equal to the "
        "intensity if the echo is as narrow as the pulse",
        scale="logarithmic",
    ),
    Column(
        "pulse_width",
        "float32",
        "ns",
        "full width at half maximum of the echo, or of the pulse if no waveform is simulated; 0 "
        "if there is no echo",
    ),
    Column(
        "return_number",
        "uint8",
        "",
        "number of the return among the reported returns of its pulse, starting at 1",
        kind="label",
    ),
    Column("returns", "uint8", "", "number of reported returns of its pulse", kind="label"),
    Column(
        "class",
        "uint16",
        "",
        "semantic class of the material; 0 if none",
        "semantic_class",
        kind="label",
    ),
    Column(
        "material",
        "int32",
        "",
        "material of the face in the scene file; -1 if none",
        "material_number",
        kind="label",
    ),
    Column(
        "cause",
        "uint8",
        "",
        "cause of the return: " + "; ".join(f"{n} {cause}" for n, cause in enumerate(CAUSES)),
        kind="label",
    ),
    Column(
        "sensor",
        "uint8",
        "",
        "index of the sensor on the platform, starting at 0",
        "sensor_number",
        kind="label",
    ),
    Column("triangle", "int32", "", "triangle of the scene that was hit"),
    *(
        Column(
            f"normal_{axis}",
            "float32",
            "",
            f"{axis} component of the unit surface normal on the side that was hit; NaN if there "
            "is no surface",
            coordinates="world",
            file_name=f"n{axis}",
        )
        for axis in "xyz"
    ),
    Column(
        "incidence_deg",
        "float32",
        "deg",
        "angle between the ray and the surface normal, 0 to 90; NaN if there is no surface",
    ),
    *(
        Column(
            f"origin_{axis}",
            "float64",
            "m",
            f"{axis} coordinate of the ray origin",
            coordinates="world",
        )
        for axis in "xyz"
    ),
    *(
        Column(
            f"flow_{axis}",
            "float32",
            "m",
            f"{axis} component of the scene flow, the displacement of the surface point relative "
            "to the sensor until the next sweep; NaN if there is no surface or no next sweep",
            coordinates="world",
        )
        for axis in "xyz"
    ),
    *(
        Column(
            f"flow_ego_{axis}",
            "float32",
            "m",
            f"{axis} component of the scene flow without the motion of the platform; 0 for static "
            "surfaces, NaN as in flow_x",
            coordinates="world",
        )
        for axis in "xyz"
    ),
    *(
        Column(
            f"true_{axis}",
            "float64",
            "m",
            f"{axis} coordinate of the point according to the true trajectory, in world "
            "coordinates",
            coordinates="world",
        )
        for axis in "xyz"
    ),
    Column(
        "red",
        "uint8",
        "",
        "red component of the surface color, sRGB; surfaces without a color are gray (188)",
    ),
    Column("green", "uint8", "", "green component of the surface color, sRGB"),
    Column("blue", "uint8", "", "blue component of the surface color, sRGB"),
)
COLORS = ("red", "green", "blue")

TABLE = {column.name: column for column in (SCAN, *ALWAYS, *OPTIONAL)}


def optional_columns(columns: Iterable[str | Column]) -> tuple[Column, ...]:
    """Return the optional columns in a selection of columns.

    Columns can be selected by their names in `TABLE` or in files. Duplicates are removed, and so
    are columns that every part has.

    Raises
    ------
    LidarError
        If a name is unknown, two columns have the same name, a vector is incomplete, or a name
        cannot be written to files.
    """
    by_name: dict[str, Column] = {}
    names = {column.in_files: column for column in TABLE.values()} | TABLE
    for entry in columns:
        column = entry
        if isinstance(column, str):
            if column not in names:
                raise LidarError(
                    f"Unknown column {column!r}."
                    + (did_you_mean(column, names) or f" Available columns: {', '.join(names)}.")
                )
            column = names[column]
        if by_name.get(column.name, column) != column or (
            column.name in TABLE and TABLE[column.name] != column
        ):
            raise LidarError(f"Two columns have the name {column.name!r}. Rename one of them.")
        by_name[column.name] = column
    for vector in VECTORS:
        if 0 < len(by_name.keys() & {*vector}) < len(vector):
            raise LidarError(
                f"The columns {', '.join(vector)} form a vector, which some formats rotate. "
                "Select all three."
            )
    optional = tuple(column for column in by_name.values() if column not in (SCAN, *ALWAYS))
    check_names((SCAN, *ALWAYS, *optional))
    return optional


def check_names(columns: Iterable[Column]) -> None:
    """Raise LidarError unless the columns have distinct and valid names in files."""
    used_names: set[str] = set()
    for name in (column.in_files for column in columns):
        if not name.isascii() or not name.isprintable() or " " in name:
            raise LidarError(
                "The name of a column in files must consist of ASCII letters and digits, but is "
                f"{name!r}."
            )
        if name in _OPEN3D:
            raise LidarError(
                f"A column in files cannot have the name {name!r}, because Open3D expects three "
                "numbers per point in it. Use a different name."
            )
        if name in used_names:
            raise LidarError(f"Two columns have the name {name!r} in files. Rename one of them.")
        used_names.add(name)


def names_by_value(names: Mapping[int, str]) -> list[str]:
    """Convert a mapping from column values to names into a list indexed by value.

    The list contains an empty string for each value without a name.
    """
    return [names.get(value, "") for value in range(max(names, default=-1) + 1)]


def waveform_column(samples: int) -> Column:
    """Return the column for recorded waveforms with the given number of samples.

    Only parts and in-memory clouds have this column.
    """
    return Column(WAVEFORM, column_type(samples), "", "waveform of the pulse", "waveform")


def columns_in_parts(optional: Sequence[Column]) -> tuple[Column, ...]:
    """Return all columns stored in a part, in file order."""
    return (*ALWAYS, *optional)

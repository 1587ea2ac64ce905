"""Read and write E57 files with pye57, with one E57 scan per sweep."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from threading import Lock
from typing import Any, NamedTuple

import numpy as np

from lidarsim.columns.cloud import Cloud, CloudLike
from lidarsim.columns.sweep import Sweep
from lidarsim.columns.table import COLORS, NORMAL
from lidarsim.environment.extras import reading
from lidarsim.io.allowance import Allowance
from lidarsim.io.input_files import input_size
from lidarsim.motion.rotations import matrices
from lidarsim.numerics.arrays import AnyArray, Floats
from lidarsim.scene.files.intensity_scales import Limits, common_limits
from lidarsim.scene.files.stated_system import StatedSystem, check_metric_format
from lidarsim.scene.transform import affine
from lidarsim.sweeps.ray_image import RayImage
from lidarsim.sweeps.sweeps import Sweeps
from lidarsim.words import printable

from ..identity.fingerprint import fingerprint
from ..processes.per_process import PerProcess
from .cloud_format import CloudFormat
from .format_options import FormatOptions
from .gps_time import gps_start_s
from .point_field import OMITTED, PointField
from .recording import Recording
from .recording_ref import RecordingRef
from .return_numbers import return_numbers
from .well_known_text import wkt

_THIN = "downsample it first"
_COORDINATES = {
    "cartesian": ("cartesianX", "cartesianY", "cartesianZ"),
    "spherical": ("sphericalRange", "sphericalAzimuth", "sphericalElevation"),
}
_COLORS = ("Red", "Green", "Blue")
# Fields that are read, and the columns in which they are stored.
_COLUMNS = {
    "intensity": "intensity",
    **{f"color{color}": name for color, name in zip(_COLORS, COLORS, strict=True)},
    "rowIndex": "row",
    "columnIndex": "column",
    "returnIndex": "return_number",
    "returnCount": "returns",
    "timeStamp": "time",
}
# Flags that mark points as invalid, and the columns to which they apply.
_FLAGS = {
    "isIntensityInvalid": ("intensity",),
    "isColorInvalid": COLORS,
    "isTimeStampInvalid": ("time",),
}
_MOVING = ", motion compensated"  # suffix of the scan name if the sensor moves
_MIN_QUATERNION = 1e-6  # norm below which a quaternion is considered zero


class E57(CloudFormat):
    """An E57 file with one scan per sweep, except for sweeps without points.

    A scan contains its pose and its points, which have the fields in `E57.fields`:

    - Points are in the sensor frame. Poses are in world coordinates, whose coordinate system is
      stored as WKT.
    - Normals use the extension for surface normals. They are (0, 0, 0) if a point does not lie on a
      surface.
    - Return indices start at 0. Time stamps are in seconds since the acquisition start. The row is
      the channel, and the column is the firing in the sweep.
    - The intensity limits of all scans are 0 and the highest intensity in the cloud.
    - The acquisition start and end are the GPS times of the first and the last firing. The creation
      time is the start of the survey.
    """

    title = "E57"
    by_sweep = True
    frame = "sweep"
    fields = (
        PointField("intensity", ("intensity",), OMITTED),
        PointField("returnIndex", ("return_number",), OMITTED),
        PointField("returnCount", ("returns",), OMITTED),
        PointField("timeStamp", ("time",), OMITTED),
        PointField("rowIndex", ("channel", "ray"), OMITTED),
        PointField("columnIndex", ("ray",), OMITTED),
        PointField("colorRed, colorGreen, colorBlue", COLORS, OMITTED, on_request=True),
        PointField("nor:normalX, nor:normalY, nor:normalZ", NORMAL, OMITTED, on_request=True),
    )
    other_columns = False
    for_scenes = True

    def write(self, path: Path, spec: FormatOptions) -> None:
        """Write the file."""
        from pye57 import libe57

        from .e57_writer import NORMALS_URI, DateTime, E57Writer

        sweeps = self.sweeps
        content = fingerprint(sweeps, len(self.cloud), np.asarray(self.cloud.bounds))
        system = "" if sweeps.epsg is None else wkt(sweeps.epsg)
        created = DateTime(gps_start_s(sweeps), sweeps.start_ns is not None)
        highest = _highest_intensity(self.cloud)
        with E57Writer(path, system, created, content) as file:
            if {*NORMAL} <= {column.name for column in self.cloud.table}:
                file.image_file.extensionsAdd("nor", NORMALS_URI)
            try:
                for sweep, points in enumerate(sweeps.points(self.cloud)):
                    if len(points):
                        _write_scan(file, sweeps, sweep, points, highest)
                file.close()
            except libe57.E57Exception as error:
                del file.image_file  # closing it would fail again
                raise OSError(f"{str(error).splitlines()[0]}. The disk may be full") from error

    @classmethod
    def open(cls, ref: RecordingRef) -> Recording:
        """Open the scans of an E57 file.

        Points are in the scanner frame, and each scan has a pose.
        """
        with reading(ref.name):
            return _E57Recording(ref)


def _highest_intensity(cloud: CloudLike) -> float:
    """Return the highest intensity in a cloud, or 0 if the cloud has no intensities."""
    if all(column.name != "intensity" for column in cloud.table):
        return 0.0
    chunks = cloud.chunks()
    return max((float(chunk["intensity"].max(initial=0)) for chunk in chunks), default=0.0)


def _write_scan(
    file: Any, sweeps: Sweeps, sweep: int, points: Cloud, highest_intensity: float
) -> None:
    from .e57_writer import DateTime, ScanHeader

    start_s = gps_start_s(sweeps)
    is_dated = sweeps.start_ns is not None
    header = ScanHeader(
        _scan_name(sweeps, sweep),
        sweeps.pose.positions[sweep],
        np.roll(sweeps.pose.quaternions[sweep], 1),  # w first
        DateTime(start_s + float(sweeps.begins_ns[sweep]) / 1e9, is_dated),
        DateTime(start_s + float(sweeps.ends_ns[sweep]) / 1e9, is_dated),
        highest_intensity,
    )
    file.write_scan(header, _point_fields(sweeps, sweep, points))


def _point_fields(sweeps: Sweeps, sweep: int, points: Cloud) -> dict[str, AnyArray]:
    """Return the values of a sweep's points by field of the format, as far as they are known."""
    positions = sweeps.compensate_motion(sweep, points)
    fields: dict[str, AnyArray] = dict(zip(_COORDINATES["cartesian"], positions.T, strict=True))
    columns = points.columns
    if "intensity" in columns:
        fields["intensity"] = points["intensity"]
    if {*COLORS} <= columns.keys():
        names = zip(_COLORS, COLORS, strict=True)
        fields |= {f"color{color}": points[name] for color, name in names}
    if "ray" in columns and sweeps.fired is not None:
        image = RayImage.from_points(sweeps, sweep, points)
        fields |= {"rowIndex": image.row, "columnIndex": image.column}
    if (numbers := return_numbers(points, sweeps)) is not None:
        number, returns = numbers
        fields |= {"returnIndex": number.astype(np.int64) - 1, "returnCount": returns}
    if "time" in columns:
        # Times are rounded to 1 ns, and the format does not allow negative values.
        fields["timeStamp"] = np.maximum(points["time"] - sweeps.begins_ns[sweep], 0) / 1e9
    if {*NORMAL} <= columns.keys():
        compensated = sweeps.columns_compensated(sweep, points)
        fields |= {
            f"nor:normal{name[-1].upper()}": np.nan_to_num(compensated[name]) for name in NORMAL
        }
    return fields


def _scan_name(sweeps: Sweeps, sweep: int) -> str:
    """Return the name of a scan, such as "station 3" or "roof, sweep 1, motion compensated"."""
    sensor = sweeps.sensor[sweep]
    number = int(sweeps.numbers[sweep])
    per_station = int(np.count_nonzero(sweeps.sensor == sensor)) // sweeps.stations
    parts = [sweeps.sensors[sensor]] if len(sweeps.sensors) > 1 else []
    is_standing = not len(sweeps.knots)
    if is_standing:
        parts.append(f"station {max(int(sweeps.station_numbers[sweep]), 1)}")
    if not is_standing or per_station > 1:
        parts.append(f"sweep {number % per_station + 1}")
    return ", ".join(parts) + ("" if is_standing else _MOVING)


# -- reading ---------------------------------------------------------------------------------


class _Scale(NamedTuple):
    """Intensity limits that convert the intensities of all scans to the same scale."""

    limits: Sequence[Limits | None]  # None for scans whose intensities are used as stored
    notes: tuple[str, ...] = ()  # notes for the user, which continue the name of the file


class _E57Recording(Recording):
    """The scans of an E57 file."""

    def __init__(self, ref: RecordingRef) -> None:
        super().__init__(ref.info(is_metric=True))
        self._size = input_size(ref.path)
        self._files = PerProcess(partial(_open_file, ref.path))
        file, _ = self._files()
        self._headers = [file.get_header(number) for number in range(file.scan_count)]
        # A column of equal values takes no space in the file, regardless of the number of points.
        total = Allowance(self._size, _THIN, in_parts=True)
        for header in self._headers:
            total.reserve(_bytes_of_scan(header))
        self._scale = _scale(self._headers)
        system = _system(file)
        notes = list(self._scale.notes)
        for number, header in enumerate(self._headers):
            _, pose_notes = _pose(header, _name(header, number))
            notes += pose_notes
        epsg = None
        if system is not None and self._headers and not ref.as_stored:
            notes += check_metric_format(system, self.load(0).in_world())
            # E57 coordinates are in meters. They cannot be in a system that uses another unit.
            epsg = system.epsg if system.horizontal_m == 1.0 else None
        names = tuple(_stated_name(header) for header in self._headers)
        is_compensated = any(name.endswith(_MOVING) for name in names)
        self.info = ref.info(
            point_count=sum(h.point_count for h in self._headers) if ref.as_stored else None,
            compensated=True if is_compensated else None,
            system=system,
            epsg=epsg,
            is_metric=True,
            stations=() if is_compensated else names,
            notes=ref.prefix_notes(notes),
        )

    def __len__(self) -> int:
        return len(self._headers)

    def load(self, number: int) -> Sweep:
        Allowance(self._size, _THIN).reserve(_bytes_of_scan(self._headers[number]))
        file, lock = self._files()
        with lock:  # a file cannot have two readers
            return _read_scan(file, file.get_header(number), number, self._scale)


def _open_file(path: Path) -> tuple[Any, Lock]:
    import pye57

    return pye57.E57(str(path)), Lock()


def _read_scan(file: Any, header: Any, number: int, scale: _Scale) -> Sweep:
    """Read the valid points of a scan, in the scanner frame, from an open `pye57.E57`.

    Colors and intensities that are marked as invalid are NaN, and a column is omitted if all its
    values are invalid. Other colors range from 0 to 255.
    """
    scan_name = _name(header, number)
    pose, _ = _pose(header, scan_name)
    fields = header.point_fields
    kind = next((kind for kind, axes in _COORDINATES.items() if {*axes} <= {*fields}), None)
    if kind is None:
        raise ValueError(f"{scan_name} has neither Cartesian nor spherical coordinates")
    read = _read_fields(file, header)
    columns = {name: read[field] for field, name in _COLUMNS.items() if field in read}
    if "return_number" in columns:  # numbers start at 0 in files
        columns["return_number"] = columns["return_number"] + 1
    if {*COLORS} <= columns.keys():
        columns |= _color_columns(header, columns)
    if (limits := scale.limits[number]) is not None:
        columns["intensity"] = limits.apply(columns["intensity"])
    for flag, names in _FLAGS.items():
        invalid = flag in read and read[flag] != 0
        for column in {*names} & columns.keys() if np.any(invalid) else ():
            columns[column] = np.where(invalid, np.nan, columns[column]).astype(np.float32)
            if np.all(invalid):
                del columns[column]
    positions = _positions(read, kind)
    states = [read[state] for state in _states(kind) if state in read]
    if states and states[0].any():
        rows = np.flatnonzero(states[0] == 0)
        positions = positions[rows]
        columns = {column: values[rows] for column, values in columns.items()}
    unread = tuple(field for field in fields if field not in read)
    scanner = None if pose is None else pose[:3, 3]
    pose = np.eye(4) if pose is None else pose
    return Sweep(positions, columns, pose=pose, scanner=scanner, skipped=unread)


def _read_fields(file: Any, header: Any) -> dict[str, AnyArray]:
    """Read the supported fields of a scan, keyed by name.

    This does not use the reading function of pye57, because its types are too small for some
    values: 8 bits for colors and 16 bits for row numbers.
    """
    from pye57 import libe57

    points = header.points
    prototype = libe57.StructureNode(points.prototype())
    known = {*_COLUMNS, *_FLAGS, *sum(_COORDINATES.values(), ()), *_states("")}
    columns: dict[str, AnyArray] = {}
    buffers = libe57.VectorSourceDestBuffer()
    for field in header.point_fields:
        node = prototype[field]
        if field not in known or isinstance(node, libe57.StringNode):
            continue
        letter = "d"
        if isinstance(node, libe57.IntegerNode):
            letter = "q"  # pye57 interprets "l", the letter of np.int64, as 32 bits
        elif isinstance(node, libe57.FloatNode) and node.precision() == libe57.E57_SINGLE:
            letter = "f"
        columns[field] = np.zeros(header.point_count, letter)
        buffer = (file.image_file, field, columns[field], header.point_count, True, True)
        buffers.append(libe57.SourceDestBuffer(*buffer))
    if header.point_count:
        points.reader(buffers).read()
    return columns


def _states(kind: str) -> list[str]:
    """Return the names of the fields that mark invalid points.

    The first field is the one for coordinates of the type `kind`.
    """
    return [f"{of}InvalidState" for of in sorted(_COORDINATES, key=lambda of: of != kind)]


def _positions(read: Mapping[str, AnyArray], kind: str) -> Floats:
    first, second, third = (read[axis].astype(np.float64) for axis in _COORDINATES[kind])
    if kind == "cartesian":
        return np.stack([first, second, third], axis=1)
    across = first * np.cos(third)
    return np.stack(
        [across * np.cos(second), across * np.sin(second), first * np.sin(third)], axis=1
    )


def _color_columns(header: Any, columns: Mapping[str, AnyArray]) -> dict[str, AnyArray]:
    """Scale the colors of a scan to the range 0 to 255.

    The columns are uint8, or float32 with NaN.
    """
    values = [columns[name] for name in COLORS]
    full = _full_color(header, max(float(np.nanmax(color, initial=0)) for color in values))
    scaled = [np.rint(np.clip(color * (255 / full), 0, 255)) for color in values]
    has_nan = any(np.isnan(color).any() for color in scaled)
    dtype = np.float32 if has_nan else np.uint8
    return {name: color.astype(dtype) for name, color in zip(COLORS, scaled, strict=True)}


def _full_color(header: Any, highest: float) -> float:
    """Return the color value that represents full intensity in a scan.

    This is the limit that the scan declares, provided that it is plausible for 8 to 32 bits and not
    below the highest color in the scan. Otherwise, it is derived from the highest color.
    """
    from pye57 import libe57

    prototype = libe57.StructureNode(header.points.prototype())
    nodes = [prototype[f"color{color}"] for color in _COLORS]
    are_real = not all(isinstance(node, libe57.IntegerNode) for node in nodes)
    names = [f"color{color}Maximum" for color in _COLORS]
    limits = [_limit(header, "colorLimits", name) for name in names]
    stated = [limit for limit in limits if limit is not None]
    if not stated and not are_real:
        stated = [float(node.maximum()) for node in nodes]
    full = max(stated, default=0.0)
    if full >= max(highest, 255) and full + 1 in {2.0**bits for bits in range(8, 33)}:
        return full
    scales = (1.0, 255.0, 65_535.0) if are_real else (255.0, 65_535.0)
    return next((scale for scale in scales if highest <= scale), highest)


def _scale(headers: Sequence[Any]) -> _Scale:
    """Determine the common scale for the intensities of all scans.

    Intensities are used as stored unless all scans that have them declare limits.
    """
    limits: list[Limits | None] = []
    for header in headers:
        low, high = (
            _limit(header, "intensityLimits", f"intensity{end}") for end in ("Minimum", "Maximum")
        )
        if "intensity" not in header.point_fields or low is None or high is None or low >= high:
            limits.append(None)
        else:
            limits.append(Limits(low, high))
    scales = common_limits([limit for limit in limits if limit is not None])
    if scales is None:
        return _Scale([None] * len(headers))
    pairs = zip(headers, limits, strict=True)
    if any("intensity" in header.point_fields and limit is None for header, limit in pairs):
        note = "has scans with and without intensityLimits, so their intensities are used as stored"
        return _Scale([None] * len(headers), (note,))
    following = iter(scales)
    applied = [None if limit is None else next(following) for limit in limits]
    note = "specifies intensityLimits, so its intensities were scaled to the range 0 to 1"
    return _Scale(applied, (note,))


def _limit(header: Any, group: str, name: str) -> float | None:
    """Return a limit that a scan declares, or None if there is no finite limit."""
    if not header.node.isDefined(f"{group}/{name}"):
        return None
    value = _number(header.node[group][name])
    return value if np.isfinite(value) else None


def _number(node: Any) -> float:
    from pye57 import libe57

    is_scaled = isinstance(node, libe57.ScaledIntegerNode)
    return float(node.scaledValue() if is_scaled else node.value())


def _name(header: Any, number: int) -> str:
    """Return the name of a scan for messages."""
    name = _stated_name(header)
    return f"scan {number + 1}" + (f" ({name!r})" if name else "")


def _stated_name(header: Any) -> str:
    """Return the name that is stored in a scan, or an empty string."""
    return printable(str(header.node["name"].value())) if header.node.isDefined("name") else ""


def _pose(header: Any, name: str) -> tuple[Floats | None, tuple[str, ...]]:
    """Return the pose matrix of a scan and notes about the pose.

    The matrix is None if the scan has no pose. Raises ValueError if the pose is not finite.
    """
    node = header.node
    if not node.isDefined("pose"):
        return None, ()
    quaternion, position = (
        np.array(
            [
                _number(node["pose"][part][axis])
                if node.isDefined(f"pose/{part}/{axis}")
                else default
                for axis, default in zip(axes, defaults, strict=True)
            ]
        )
        for part, axes, defaults in (
            ("rotation", "xyzw", (0.0, 0.0, 0.0, float(not node.isDefined("pose/rotation")))),
            ("translation", "xyz", (0.0, 0.0, 0.0)),
        )
    )
    if not (np.isfinite(quaternion).all() and np.isfinite(position).all()):
        raise ValueError(
            f"the pose of {name} is not finite: its quaternion is {_listed(quaternion)} (x, "
            f"y, z, w) and its position is {_listed(position)}"
        )
    length = np.sqrt((quaternion**2).sum())
    if length < _MIN_QUATERNION:
        note = f"has a zero quaternion in the pose of {name}, so the scan is not rotated"
        return affine(np.eye(3), position), (note,)
    (rotation,) = matrices(quaternion[None] / length)
    return affine(rotation, position), ()


def _listed(numbers: Floats) -> str:
    return ", ".join(f"{number:g}" for number in numbers)


def _bytes_of_scan(header: Any) -> int:
    """Return the memory that the columns of a scan require, with 8 bytes per value."""
    return 8 * int(header.point_count) * len(header.point_fields)


def _system(file: Any) -> StatedSystem | None:
    """Return the coordinate system that an open `pye57.E57` declares (ASTM E2807, 8.4.2)."""
    root = file.root
    if not root.isDefined("coordinateMetadata"):
        return None
    text = str(root["coordinateMetadata"].value()).strip()
    return StatedSystem(text) if text else None

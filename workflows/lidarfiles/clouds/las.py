"""Read and write LAS and LAZ files with laspy.

Written files have version 1.4 and point formats 6 to 10.
"""

from __future__ import annotations

import json
from datetime import UTC, date, datetime
from os import SEEK_END
from pathlib import Path
from shutil import copyfileobj
from struct import Struct
from tempfile import TemporaryFile
from textwrap import shorten
from typing import IO, TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from lidarsim.columns.cloud import CHUNK_POINTS, Cloud, CloudLike
from lidarsim.columns.sweep import Sweep
from lidarsim.columns.table import COLORS, NORMAL, TABLE, Column
from lidarsim.columns.waveforms import WAVEFORM, ZERO, records
from lidarsim.environment.extras import reading
from lidarsim.environment.interrupts import defer_interrupts
from lidarsim.errors import CutShortError, LidarError
from lidarsim.numerics.arrays import Floats, Floats32
from lidarsim.survey.survey import Survey
from lidarsim.sweeps.sweeps import AS_FIRED, IN_WORLD, Sweeps
from lidarsim.words import join_names

from .cloud_format import CloudFormat
from .flight_lines import FlightLines
from .format_options import FormatOptions
from .gps_time import gps_start_s
from .intensity_full_scale import compute_full_scale
from .las_header import las_system, noise_classes, open_las
from .point_field import NONE, OMITTED, PointField
from .recording import PointCloud
from .recording_ref import RecordingRef
from .return_numbers import return_numbers
from .well_known_text import wkt

if TYPE_CHECKING:
    import laspy

# A sample consists of several runs of points, which start at chunks of the .laz file. Most programs
# write chunks of 50,000 points.
_SAMPLE_RUNS = 40
_LAZ_CHUNK = 50_000
_SYSTEM_POINTS = 5  # points at which the lengths in a coordinate system are checked
ANGLE_DEG = 0.006  # step of the format's scan angle
_MAX_INTENSITY = 65_535
_MAX_CLASS = 255
_FULL_SCALE = 2  # ID of lidarpool's record with the intensity that is stored as the maximum
_MAX_RETURNS = 15  # largest return number in point formats 6 to 10
_FORMAT_FIELDS = ("return_number", "returns")  # columns that are not stored in extra bytes
# Names of columns in the extra bytes. The format already has a field `intensity`, and normals are
# named like dimensions of PDAL.
_NAMES = {
    "intensity": "energy",
    **{TABLE[name].in_files: f"Normal{name[-1].upper()}" for name in NORMAL},
}
_ADJUSTED_S = 1e9  # GPS time minus adjusted standard GPS time
_EVLR = Struct("<H16sHQ32s")  # head of an extended variable length record
# Header fields: offset of the waveform packets, and offset and number of extended records.
_WAVES_OFFSET = 227
_WAVES = Struct("<QQI")
_MAX_VLR_BYTES = 65_535  # limit for a variable length record
_TEXT_AREA = 3  # ID of the record with a description
_FRAMES = {"world": IN_WORLD, "sensor": AS_FIRED}
_ON_GRID = 0.1  # tolerated distance from the grid as a fraction of the precision
_STEPS = ("X", "Y", "Z")  # dimensions that contain coordinates as integers
_MAX_STEPS = 2**31 - 1  # maximum distance from the offset in steps of the precision


def _extra_bytes(column: Column) -> laspy.ExtraBytesParams:
    """Describe a column so that it can be stored in the extra bytes of a LAS file.

    The unit and meaning are limited to 32 characters.
    """
    import laspy

    description = shorten(f"{column.unit} {column.meaning}", 32, placeholder="")
    return laspy.ExtraBytesParams(_name(column.in_files), column.dtype, description)


class LAS(CloudFormat):
    """A .las file that stores columns in fields of the format and in extra bytes.

    The point format is 6, 7 with colors, 9 with waveforms (`_Packets`), or 10 with both. Its fields
    contain:

    - GPS time: `time` as adjusted standard GPS time, or in seconds since the start of the survey if
      the date of the survey is unknown.
    - Return number and number of returns: `return_number` and `returns`, at most 15, or 1 if the
      sensors report one return per pulse.
    - Scan angle (in steps of 0.006 degrees), scan direction, edge of flight line, point source and
      scanner channel: see `FlightLines`.
    - Red, green and blue: the columns of these names, multiplied by 257.
    - Intensity: `intensity`, scaled so that `intensity_full_scale` is stored as 65,535. Greater
      intensities are clipped. A record of lidarpool contains the scale as JSON.
    - Classification: `class` if it is below 256, otherwise 0, and `survey_notes` mentions it. The
      class lookup contains the names of these classes, which are truncated to 15 ASCII characters.

    All columns except return numbers, numbers of returns and colors are also stored in the extra
    bytes, without these limits. Fields whose values are unknown are 0. The coordinate system is
    stored as WKT, the names of materials as JSON in a record of lidarpool, and the frame of the
    points in a text area record.
    """

    title = "LAS"
    frame = "world"
    fields = (
        PointField("intensity", ("intensity",), "0"),
        PointField("return number", ("return_number",), "0"),
        PointField("number of returns", ("returns",), "0"),
        PointField("synthetic, key-point, withheld and overlap flags", (), "0", NONE),
        PointField("scanner channel", (), "0", "mounts of the sensors"),
        PointField("scan direction flag", (), "0", "motion of the mirror"),
        PointField("edge of flight line", (), "0", "motion of the mirror"),
        PointField("classification", ("class",), "0"),
        PointField("user data", (), "0", NONE),
        PointField("scan angle", (), "0", "poses of the sensors"),
        PointField("point source ID", (), "0", "flight lines and stations"),
        PointField("GPS time", ("time",), "0"),
        PointField("red, green, blue", COLORS, OMITTED, on_request=True),
        PointField("near infrared", (), OMITTED, NONE),
        PointField("wave packets", (), OMITTED, "`cloud.waveform_samples`"),
    )
    options = ("intensity_full_scale",)
    is_compressed: ClassVar[bool] = False
    for_scenes = True

    @classmethod
    def survey_notes(cls, survey: Survey) -> list[str]:
        """Return a note about classes that do not fit into the classification."""
        numbers = {material.semantic_class for material in survey.materials}
        too_large = sorted(number for number in numbers if number > _MAX_CLASS)
        if not too_large or not any(c.name == "class" for c in survey.stored_columns):
            return []
        return [
            f"the classification in LAS files is at most {_MAX_CLASS}, so it is 0 for points of "
            f"{'classes' if too_large[1:] else 'class'} {join_names([*map(str, too_large)])}. The "
            "extra bytes `class` contain the true numbers"
        ]

    def write(self, path: Path, spec: FormatOptions) -> float | None:
        """Write the file and return the intensity that is stored as 65,535."""
        import laspy
        import lazrs

        full_scale = compute_full_scale(self.cloud)
        if full_scale is not None:
            full_scale = spec.intensity_full_scale or full_scale
        packets = _Packets.from_cloud(self.cloud)
        columns = {column.name for column in self.cloud.table}
        header = _header(columns, self.sweeps, packets, full_scale)
        _set_grid(header, self.cloud, self.sweeps.precision_m, self.title)
        format_fields = (*_FORMAT_FIELDS, *COLORS) if {*COLORS} <= columns else _FORMAT_FIELDS
        extra = [column for column in self.cloud.table if column.name not in format_fields]
        header.add_extra_dims([_extra_bytes(column) for column in extra])
        names = [column.name for column in extra]
        options = {"header": header, "do_compress": self.is_compressed, "closefd": False}
        try:
            with (
                path.open("wb+") as file,  # laspy would not close the file after an error
                TemporaryFile(dir=path.parent) as packet_file,
            ):
                with laspy.open(file, "w", **options) as writer:
                    for chunk, lines in FlightLines(self.sweeps).with_fields(self.cloud.chunks()):
                        points = _points(chunk, header, names, self.sweeps)
                        if full_scale is not None:
                            points.intensity = _as_integers(chunk["intensity"], full_scale)
                        points.scan_angle = np.round(lines.scan_angle_deg / ANGLE_DEG).astype("i2")
                        points.scan_direction_flag = lines.direction
                        points.edge_of_flight_line = lines.edge
                        points.point_source_id = lines.source
                        points.scanner_channel = lines.scanner
                        if packets is not None:
                            packets.put(points, chunk, packet_file)
                        with defer_interrupts():  # lazrs replaces errors raised within it
                            writer.write_points(points)
                    with defer_interrupts():
                        writer.close()
                if packets is not None:
                    packets.append(file, packet_file)
        except lazrs.LazrsError as error:
            raise OSError(f"{error}. The disk may be full") from error
        return full_scale

    @classmethod
    def open(cls, ref: RecordingRef) -> PointCloud:
        """Open a .las or .laz file, whose points are read in parts."""
        return _LasCloud(ref)


class LAZ(LAS):
    """A .laz file, which is a compressed .las file."""

    title = "LAZ"
    is_compressed = True


def _start_s(sweeps: Sweeps) -> float:
    """Return the start of a survey as adjusted standard GPS time in seconds, or 0 if unknown."""
    if sweeps.start_ns is None:
        return 0.0
    return gps_start_s(sweeps) - _ADJUSTED_S


def _as_integers(intensities: Floats32, full_scale: float) -> NDArray[np.uint16]:
    """Convert intensities to the integers that are stored in the format."""
    fractions = np.clip(intensities.astype(np.float64) / full_scale, 0, 1)
    return np.round(fractions * _MAX_INTENSITY).astype(np.uint16)


def _header(
    columns: set[str], sweeps: Sweeps, packets: _Packets | None, intensity_full_scale: float | None
) -> laspy.LasHeader:
    """Return a new header with its records.

    Scales, offsets and extra bytes are set later.
    """
    import laspy
    from laspy.vlrs.known import WktCoordinateSystemVlr

    point_format = (6 if packets is None else 9) + int({*COLORS} <= columns)
    header = laspy.LasHeader(version="1.4", point_format=point_format)
    header.generating_software = "lidarpool"
    header.creation_date = date(1980, 1, 6)  # GPS time 0, the start of surveys without a date
    if sweeps.start_ns is not None:
        header.creation_date = datetime.fromtimestamp(sweeps.start_ns // 10**9, UTC).date()
        header.global_encoding.gps_time_type = laspy.header.GpsTimeType.STANDARD
    if sweeps.epsg is not None:
        header.vlrs.append(WktCoordinateSystemVlr(wkt(sweeps.epsg)))
    # LAS 1.4 requires this flag in formats 6 and above, even without a coordinate system. PDAL
    # before 2.7.2 rejects files without it (PDAL issue 4412).
    header.global_encoding.wkt = True
    if sweeps.classes:
        header.vlrs.append(lookup := laspy.vlrs.known.ClassificationLookupVlr())
        for number in range(256):  # the record contains all classes
            lookup[number] = sweeps.classes.get(number, "").encode("ascii", "replace")[:15].decode()
    if "material" in columns:
        names_json = json.dumps(sweeps.materials).encode()[:_MAX_VLR_BYTES]
        header.vlrs.append(laspy.VLR("lidarpool", 1, "names of materials, JSON", names_json))
    header.vlrs.append(
        laspy.VLR("LASF_Spec", _TEXT_AREA, "frame", _FRAMES[sweeps.coordinates].encode() + b"\0")
    )
    if intensity_full_scale is not None:
        scale_json = json.dumps({"intensity_full_scale": intensity_full_scale}).encode()
        header.vlrs.append(
            laspy.VLR("lidarpool", _FULL_SCALE, "intensity of 65535, JSON", scale_json)
        )
    if packets is not None:
        header.vlrs.extend(packets.descriptors)
        header.global_encoding.waveform_data_packets_internal = True
    return header


def _set_grid(header: laspy.LasHeader, cloud: CloudLike, precision_m: float, name: str) -> None:
    """Set the scales and offsets that a header specifies for positions.

    Raises LidarError if the extent of the cloud is too large.
    """
    lower, upper = np.asarray(cloud.bounds, np.float64)
    header.scales = np.full(3, precision_m)
    header.offsets = np.floor((lower + upper) / 2)
    # Points may lie between the steps from an integer offset, for example if the world origin is
    # given in millimeters. The offset is then shifted.
    steps = (lower - header.offsets) / precision_m
    shift = (steps - np.round(steps)) * precision_m
    header.offsets += np.where(np.abs(shift) > _ON_GRID * precision_m, shift, 0.0)
    if np.abs(np.stack([lower, upper]) - header.offsets).max() / precision_m > _MAX_STEPS:
        raise LidarError(
            f"{name} stores positions in at most 2^32 steps of {precision_m} m per axis, but "
            f"the cloud extends over {(upper - lower).max():.6g} m. Use a larger "
            "`precision_m`."
        )


class _Packets:
    """Waveform packets of a LAS file, which follow its points in the same file.

    Samples have 16 bits. There is one descriptor for each combination of sampling interval and
    digitizer gain. All samples are multiples of the gain, which is a power of two. Returns of a
    pulse that have the same window share a packet. The vector of a point is the path towards the
    sensor per picosecond. The sample at time t is therefore located at the point plus (L - t) times
    the vector, where L is the location of the return in the waveform.
    """

    def __init__(self, samples: int, kinds: list[tuple[int, int]]) -> None:
        from laspy.vlrs.known import WaveformPacketStruct, WaveformPacketVlr

        self._bytes = 2 * samples
        self._index = {kind: number for number, kind in enumerate(kinds, 1)}
        self._end = _EVLR.size  # end of the packets, which follow the head of their record
        self.descriptors = []
        for number, (step_ps, exponent) in enumerate(kinds, 1):
            gain = 2.0**exponent
            descriptor = WaveformPacketVlr(99 + number, "lidarpool")
            descriptor.parsed_record = WaveformPacketStruct(
                16, 0, samples, step_ps, gain, -ZERO * gain
            )
            self.descriptors.append(descriptor)

    @classmethod
    def from_cloud(cls, cloud: CloudLike) -> _Packets | None:
        """Create the packets of a cloud, or return None if it has no waveforms.

        The cloud is read once.
        """
        if not getattr(cloud, "has_waveforms", False):  # clouds in files never have any
            return None
        kinds: set[tuple[int, int]] = set()
        samples = 0
        for chunk in cloud.chunks():
            rows = records(chunk.columns[WAVEFORM])
            samples = rows["samples"].shape[1]
            pairs = np.stack([rows["sample_ps"].astype(np.int64), rows["exponent"]], axis=1)
            kinds |= {(step, power) for step, power in np.unique(pairs, axis=0).tolist()}
        return cls(samples, sorted(kinds)) if kinds else None

    def put(self, points: Any, chunk: Cloud, file: IO[bytes]) -> None:
        """Write the packets of points to a file, storing the packets' offsets in the points."""
        rows = records(chunk.columns[WAVEFORM])
        starts_packet = np.ones(len(rows), np.bool_)
        starts_packet[1:] = (rows["samples"][1:] != rows["samples"][:-1]).any(axis=1)
        for name in ("begin", "sample_ps", "exponent"):
            starts_packet[1:] |= rows[name][1:] != rows[name][:-1]
        file.write(rows["samples"][starts_packet].tobytes())
        points.wavepacket_offset = self._end + (np.cumsum(starts_packet) - 1) * self._bytes
        self._end += int(starts_packet.sum()) * self._bytes
        points.wavepacket_size = np.full(len(rows), self._bytes, np.uint32)
        kinds = zip(rows["sample_ps"].tolist(), rows["exponent"].tolist(), strict=True)
        points.wavepacket_index = np.array([self._index[kind] for kind in kinds], np.uint8)
        points.return_point_wave_location = rows["location_ps"]
        points.x_t, points.y_t, points.z_t = rows["toward"].T

    def append(self, file: IO[bytes], packets: IO[bytes]) -> None:
        """Append the packets to a complete point file, storing their offset in the header."""
        begin = file.seek(0, SEEK_END)
        size = self._end - _EVLR.size
        file.write(_EVLR.pack(0, b"LASF_Spec", 65_535, size, b"lidarpool"))
        packets.seek(0)
        copyfileobj(packets, file, 1 << 20)
        file.seek(_WAVES_OFFSET)
        file.write(_WAVES.pack(begin, begin, 1))


def _points(chunk: Cloud, header: laspy.LasHeader, extra: list[str], sweeps: Sweeps) -> Any:
    import laspy

    record = laspy.ScaleAwarePointRecord.zeros(len(chunk), header=header)
    record.x, record.y, record.z = chunk.positions.T.astype(np.float64)
    columns = chunk.columns
    if (numbers := return_numbers(chunk, sweeps)) is not None:
        record.return_number, record.number_of_returns = (
            np.minimum(values, _MAX_RETURNS) for values in numbers
        )
    if "time" in columns:
        record.gps_time = columns["time"] / 1e9 + _start_s(sweeps)
    if "class" in columns:
        classes = columns["class"]
        record.classification = np.where(classes <= _MAX_CLASS, classes, 0).astype(np.uint8)
    if {*COLORS} <= {*columns}:
        for name in COLORS:
            record[name] = columns[name].astype(np.uint16) * 257
    for name in extra:
        column = TABLE.get(name)
        record[_name(column.in_files if column else name)] = columns[name]
    return record


def _name(name: str) -> str:
    """Return the name under which a column is stored in the extra bytes of a LAS file."""
    return _NAMES.get(name, name[:32])


# -- reading ---------------------------------------------------------------------------------


class _LasCloud(PointCloud):
    """A .las or .laz file, which is read in parts, or as an evenly spread sample."""

    def __init__(self, ref: RecordingRef) -> None:
        with reading(ref.name):
            system = las_system(ref.path)
            with open_las(ref.path) as reader:
                count = reader.header.point_count
                classes = noise_classes(reader.header)
                positions = np.zeros((0, 3)) if system is None else _some_positions(reader, count)
            meters, notes = ref.stated_meters(system, positions)
        super().__init__(
            ref.info(
                point_count=count,
                meters=meters,
                system=system,
                epsg=ref.epsg_in_meters(system, meters),
                noise_classes=classes,
                notes=notes,
            )
        )
        self._path = ref.path
        self._count = count

    def __len__(self) -> int:
        return -(-self._count // CHUNK_POINTS)

    def load(self, number: int) -> Sweep:
        start = number * CHUNK_POINTS
        with open_las(self._path) as reader:
            return self._read_run(reader, start, min(CHUNK_POINTS, self._count - start))

    def load_sample(self, max_points: int) -> Sweep:
        length = min(max_points // _SAMPLE_RUNS, self._count // _SAMPLE_RUNS)
        starts = np.linspace(0, self._count - length, _SAMPLE_RUNS) // _LAZ_CHUNK * _LAZ_CHUNK
        with open_las(self._path) as reader:
            return Sweep.concatenate(
                [self._read_run(reader, int(start), length) for start in starts]
            )

    def _read_run(self, reader: laspy.LasReader, start: int, length: int) -> Sweep:
        reader.seek(start)
        points = reader.read_points(length)
        if len(points) != length:
            raise CutShortError(
                f"its header declares {self._count:,} points, but it contains fewer"
            )
        names = [name for name in points.point_format.dimension_names if name not in _STEPS]
        columns = {name: np.asarray(points[name]) for name in names}
        return Sweep(np.stack([points.x, points.y, points.z], axis=1), columns)


def _some_positions(reader: laspy.LasReader, count: int) -> Floats:
    """Return the positions of a few points that are evenly distributed in a file."""
    positions = []
    for number in np.unique(np.linspace(0, count - 1, _SYSTEM_POINTS).astype(int)).tolist():
        if 0 <= number < count:
            reader.seek(number)
            point = reader.read_points(1)
            positions.append([point.x[0], point.y[0], point.z[0]])
    return np.reshape(np.array(positions, np.float64), (-1, 3))

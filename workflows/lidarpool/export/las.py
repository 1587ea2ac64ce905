"""LAS and LAZ 1.4, point formats 6 and 7, with waveforms 9 and 10, through laspy."""

from __future__ import annotations

import json
from datetime import UTC, date, datetime
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from os import SEEK_END
from pathlib import Path
from shutil import copyfileobj
from struct import Struct
from tempfile import TemporaryFile
from textwrap import shorten
from typing import IO, Any

import laspy
import lazrs
import numpy as np
from laspy.vlrs.known import WaveformPacketStruct, WaveformPacketVlr, WktCoordinateSystemVlr

from lidarsim.base.errors import LidarError
from lidarsim.base.interrupts import deferred_interrupts
from lidarsim.columns.cloud import Cloud, CloudLike
from lidarsim.columns.table import COLOURS, NORMAL, TABLE
from lidarsim.columns.waveforms import WAVEFORM, ZERO, records
from lidarsim.sweeps.sweeps import AS_FIRED, IN_WORLD, Sweeps

from .flight_lines import FlightLines

ANGLE_DEG = 0.006  # of one step of the format's scan angle
FULL = 65_535  # the format's intensity for 1 and above
_OF_FORMAT = ("return_number", "returns")  # stored only in fields of the format
# Names of columns in the extra bytes: a field of the format is called intensity, and normals have
# the names of PDAL's dimensions.
_NAMES = {
    "intensity": "energy",
    **{TABLE[name].in_files: f"Normal{name[-1].upper()}" for name in NORMAL},
}
_GPS_NS = 315_964_800 * 10**9  # from 1970-01-01 to 1980-01-06, the start of GPS time
_LEAP_S = 18  # that GPS time is ahead of UTC since 2017, the earliest start
_ADJUSTED_S = 1e9  # that adjusted standard GPS time is behind GPS time
_EVLR = Struct("<H16sHQ32s")  # head of an extended variable length record
# Of the header: where the waveform packets and the first such record begin, and their number.
_WAVES_AT = 227
_WAVES = Struct("<QQI")
_VLR_MOST = 65_535  # bytes of a variable length record
_TEXT_AREA = 3  # number of the record with a description in words
_FRAMES = {"world": IN_WORLD, "sensor": AS_FIRED}
_FAR = 2**31 - 1  # steps from the offset to the farthest point
# Coordinate systems with UTM zones: name, datum, ellipsoid, 1 / flattening, and their EPSG codes.
_WGS84 = ("WGS 84", "WGS_1984", "WGS 84", 298.257223563, (4326, 6326, 7030))
_ETRS89 = (
    "ETRS89", "European_Terrestrial_Reference_System_1989", "GRS 1980", 298.257222101,
    (4258, 6258, 7019),
)  # fmt: skip


def _write(path: Path, cloud: CloudLike, sweeps: Sweeps, *, compress: bool) -> None:
    """Write a cloud: columns with a field of the format there, the others in extra bytes.

    `time` is adjusted standard GPS time of a survey with a start, else seconds since the survey's
    start. A coordinate system is stored as WKT. `return_number` and `returns` are as they are. Scan
    angle (steps of 0.006 degrees), scan direction, edge of flight line and point source are those
    of `FlightLines`. With `red`, `green` and `blue` the point format is 7, and colours are 257
    times these, 16 bits. Intensity is the column `intensity` times 65,535, at most that, and
    classification `class` if it is below 256; because of these limits, both columns are in the
    extra bytes as well. Of these classes, the lookup has 15 letters of the names, ASCII. Names of
    materials are a record of lidarpool, a list as JSON. Return numbers are 15 at most. A text area
    record names the frame of the points. Recorded waveforms make the point format 9, or 10 with
    colours; see `_Packets`.
    """
    coloured = {*COLOURS} <= {column.name for column in cloud.table}
    packets = _Packets.of(cloud)
    point_format = (6 if packets is None else 9) + int(coloured)
    header = laspy.LasHeader(version="1.4", point_format=point_format)
    header.generating_software = "lidarpool"
    header.creation_date = date(1980, 1, 6)  # of GPS time 0, at which surveys without a date begin
    begins_s = 0.0
    if sweeps.start_ns is not None:
        header.creation_date = datetime.fromtimestamp(sweeps.start_ns // 10**9, UTC).date()
        header.global_encoding.gps_time_type = laspy.header.GpsTimeType.STANDARD
        begins_s = (sweeps.start_ns - _GPS_NS) / 1e9 + _LEAP_S - _ADJUSTED_S
    if sweeps.epsg is not None:
        header.vlrs.append(WktCoordinateSystemVlr(wkt(sweeps.epsg)))
    # LAS 1.4 wants it of formats 6 and above, with a coordinate system or without; PDAL before
    # 2.7.2, and what reads through it, opens no others (PDAL's issue 4412).
    header.global_encoding.wkt = True
    if sweeps.classes:
        header.vlrs.append(lookup := laspy.vlrs.known.ClassificationLookupVlr())
        for number in range(256):  # the record has them all
            lookup[number] = sweeps.classes.get(number, "").encode("ascii", "replace")[:15].decode()
    if any(column.name == "material" for column in cloud.table):
        listed = json.dumps(sweeps.materials).encode()[:_VLR_MOST]
        header.vlrs.append(laspy.VLR("lidarpool", 1, "names of materials, JSON", listed))
    header.vlrs.append(
        laspy.VLR("LASF_Spec", _TEXT_AREA, "frame", _FRAMES[sweeps.coordinates].encode() + b"\0")
    )
    if packets is not None:
        header.vlrs.extend(packets.descriptors)
        header.global_encoding.waveform_data_packets_internal = True
    low, high = np.asarray(cloud.bounds, np.float64)
    header.scales = np.full(3, sweeps.precision_m)
    header.offsets = np.floor((low + high) / 2)
    if np.abs(np.stack([low, high]) - header.offsets).max() / sweeps.precision_m > _FAR:
        raise LidarError(
            f"{path.suffix[1:].upper()} holds 2^32 steps of {sweeps.precision_m} m along an axis, "
            f"and the cloud is {(high - low).max():.6g} m wide: use a coarser precision_m."
        )
    own = (*_OF_FORMAT, *COLOURS) if coloured else _OF_FORMAT
    extra = [column for column in cloud.table if column.name not in own]
    header.add_extra_dims(
        [
            laspy.ExtraBytesParams(
                _name(c.in_files), c.dtype, shorten(f"{c.unit} {c.meaning}", 32, placeholder="")
            )
            for c in extra
        ]
    )
    names = [column.name for column in extra]
    try:
        with (
            path.open("wb+") as file,  # laspy leaves a file open that it cannot finish
            TemporaryFile(dir=path.parent) as beside,
        ):
            with laspy.open(
                file, "w", header=header, do_compress=compress, closefd=False
            ) as writer:
                for chunk, lines in FlightLines(sweeps).of(cloud.chunks()):
                    points = _points(chunk, header, names, begins_s)
                    points.scan_angle = np.round(lines.scan_angle_deg / ANGLE_DEG).astype(np.int16)
                    points.scan_direction_flag = lines.direction
                    points.edge_of_flight_line = lines.edge
                    points.point_source_id = lines.source
                    if packets is not None:
                        packets.put(points, chunk, beside)
                    with deferred_interrupts():  # lazrs replaces errors raised within it
                        writer.write_points(points)
                with deferred_interrupts():
                    writer.close()
            if packets is not None:
                packets.append(file, beside)
    except lazrs.LazrsError as error:
        raise OSError(f"{error}; the disk may be full") from error


write_las = partial(_write, compress=False)
write_laz = partial(_write, compress=True)


class _Packets:
    """Waveform packets of a LAS file, which stand behind its points in the same file.

    Samples have 16 bits. There is a descriptor for each distance of samples and each power of two
    that samples are multiples of; the digitizer's gain is that power. Returns of a pulse whose
    windows are the same share a packet. The vector of a point is the way towards the sensor in a
    picosecond, so that the sample at time t is at the point plus (L - t) times the vector, where L
    is the return point's location.
    """

    def __init__(self, samples: int, kinds: list[tuple[int, int]]) -> None:
        self._bytes = 2 * samples
        self._index = {kind: number for number, kind in enumerate(kinds, 1)}
        self._end = _EVLR.size  # of the packets, from the head of their record
        self.descriptors = []
        for number, (step_ps, exponent) in enumerate(kinds, 1):
            gain = 2.0**exponent
            told = WaveformPacketVlr(99 + number, "lidarpool")
            told.parsed_record = WaveformPacketStruct(16, 0, samples, step_ps, gain, -ZERO * gain)
            self.descriptors.append(told)

    @classmethod
    def of(cls, cloud: CloudLike) -> _Packets | None:
        """Look for all kinds of waveforms of a cloud; None if it has no waveforms."""
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
        """Write the packets of some points, and where they are into the points."""
        rows = records(chunk.columns[WAVEFORM])
        new = np.ones(len(rows), np.bool_)
        new[1:] = (rows["samples"][1:] != rows["samples"][:-1]).any(axis=1)
        for name in ("begin", "sample_ps", "exponent"):
            new[1:] |= rows[name][1:] != rows[name][:-1]
        file.write(rows["samples"][new].tobytes())
        points.wavepacket_offset = self._end + (np.cumsum(new) - 1) * self._bytes
        self._end += int(new.sum()) * self._bytes
        points.wavepacket_size = np.full(len(rows), self._bytes, np.uint32)
        kinds = zip(rows["sample_ps"].tolist(), rows["exponent"].tolist(), strict=True)
        points.wavepacket_index = np.array([self._index[kind] for kind in kinds], np.uint8)
        points.return_point_wave_location = rows["location_ps"]
        points.x_t, points.y_t, points.z_t = rows["toward"].T

    def append(self, file: IO[bytes], packets: IO[bytes]) -> None:
        """Append the packets to a finished file of points, and say in its header where they are."""
        begin = file.seek(0, SEEK_END)
        size = self._end - _EVLR.size
        file.write(_EVLR.pack(0, b"LASF_Spec", 65_535, size, b"lidarpool"))
        packets.seek(0)
        copyfileobj(packets, file, 1 << 20)
        file.seek(_WAVES_AT)
        file.write(_WAVES.pack(begin, begin, 1))


def _points(chunk: Cloud, header: laspy.LasHeader, extra: list[str], begins_s: float) -> Any:
    record = laspy.ScaleAwarePointRecord.zeros(len(chunk), header=header)
    record.x, record.y, record.z = chunk.positions.T.astype(np.float64)
    there = chunk.columns
    one = np.ones(len(chunk), np.uint8)
    record.return_number = np.minimum(there.get("return_number", one), 15)
    record.number_of_returns = np.minimum(there.get("returns", one), 15)
    if "time" in there:
        record.gps_time = there["time"] / 1e9 + begins_s
    if "intensity" in there:
        record.intensity = np.round(np.clip(there["intensity"], 0, 1) * FULL).astype(np.uint16)
    if "class" in there:
        record.classification = np.where(there["class"] < 256, there["class"], 0).astype(np.uint8)
    if {*COLOURS} <= {*there}:
        for name in COLOURS:
            record[name] = there[name].astype(np.uint16) * 257
    for name in extra:
        column = TABLE.get(name)
        record[_name(column.in_files if column else name)] = there[name]
    return record


def _name(name: str) -> str:
    """Name in the extra bytes of a column that has a name in files."""
    return _NAMES.get(name, name[:32])


def wkt(epsg: int) -> str:
    """Return the WKT 1 of an EPSG code: of UTM zones of WGS 84 and ETRS89, or through rasterio.

    Raises
    ------
    LidarError
        If rasterio is missing, or knows no such system.
    """
    zone = epsg % 100
    if epsg // 100 in (326, 327) and 1 <= zone <= 60:
        return _utm(epsg, zone, epsg // 100 == 327, *_WGS84)
    if 25828 <= epsg <= 25838:
        return _utm(epsg, zone, False, *_ETRS89)
    if find_spec("rasterio") is None:
        raise LidarError(
            f"EPSG:{epsg} is not a UTM zone of WGS 84 or ETRS89, and others need rasterio: "
            'pip install "lidarpool[geo]".'
        )
    crs = import_module("rasterio.crs")
    try:
        return str(crs.CRS.from_epsg(epsg).to_wkt(version="WKT1_GDAL"))
    except crs.CRSError as error:
        raise LidarError(f"rasterio cannot write EPSG:{epsg} as WKT 1: {error}.") from error


def _utm(
    epsg: int, zone: int, south: bool, name: str, datum: str, ellipsoid: str, flattening: float,
    codes: tuple[int, int, int],
) -> str:  # fmt: skip
    def code(number: int) -> str:
        return f'AUTHORITY["EPSG","{number}"]'

    geographic, of_datum, of_ellipsoid = map(code, codes)
    spheroid = f'SPHEROID["{ellipsoid}",6378137,{flattening},{of_ellipsoid}]'
    values = {
        "latitude_of_origin": 0,
        "central_meridian": zone * 6 - 183,
        "scale_factor": 0.9996,
        "false_easting": 500_000,
        "false_northing": 10_000_000 if south else 0,
    }
    parameters = ",".join(f'PARAMETER["{key}",{value}]' for key, value in values.items())
    return (
        f'PROJCS["{name} / UTM zone {zone}{"S" if south else "N"}",'
        f'GEOGCS["{name}",DATUM["{datum}",{spheroid},{of_datum}],'
        f'PRIMEM["Greenwich",0,{code(8901)}],UNIT["degree",0.0174532925199433,{code(9122)}],'
        f'{geographic}],PROJECTION["Transverse_Mercator"],{parameters},'
        f'UNIT["metre",1,{code(9001)}],AXIS["Easting",EAST],AXIS["Northing",NORTH],{code(epsg)}]'
    )

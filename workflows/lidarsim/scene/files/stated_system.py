"""Coordinate systems stated in point cloud files, and conversion of positions to true meters.

Coordinates are used without a transformation if their unit is true to scale. Otherwise, they are
rejected, or transformed to a system that the user specifies.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from ...environment.extras import install_command
from ...errors import LidarError
from ...numerics.arrays import Floats
from ...schema.vocabulary import UNITS_M, WORLD_EPSG
from ...words import printable
from .coordinate_systems import (
    MAX_SCALE_ERROR,
    UNNAMED,
    crs_from_code,
    crs_from_text,
    crs_key,
    crs_name,
    ground_scale,
    has_registry,
    horizontal_part,
    is_geocentric,
    is_true_in_utm,
    is_utm,
    missed_area,
    outside_system,
    projection_kind,
    projjson,
    require_registry,
    suggested_epsg,
    target_problem,
    transform_coordinates,
    vertical_datum,
)
from .las_units import (
    GEO_DOUBLES,
    GEO_KEYS,
    GEO_TEXTS,
    PROJECTED_CRS,
    USER_DEFINED,
    WKT_KEYWORDS,
    CoordinateUnits,
    geo_keys,
    height_unit_of_keys,
    method_of_keys,
    reprojection_advice,
    units_of_epsg,
    units_of_keys,
    vertical_datum_of_keys,
    wkt_code,
    wkt_method,
    wkt_units,
    wkt_vertical_datum,
)

WKT_RECORD = 2112  # record number of LASF_Projection in ASPRS LAS 1.4
_CODE = re.compile(r"(?i)(?:urn:ogc:def:crs:)?epsg:(?:[\d.]*:)?(\d{4,6})")
_COMMENT = re.compile(
    r"(?i)(?:(?:crs|srs|projection|coordinate system|spatial reference)(?: wkt)?\s*[:=]?\s*)?"
    r"(?:epsg\s*[:=]?\s*(?P<code>\d{4,6})|"
    rf"(?P<wkt>(?:{'|'.join(sorted(WKT_KEYWORDS))})\s*\[.*))"
)
Meters = tuple[float, float, float]  # units of x, y and z in meters


class _TiffTag(NamedTuple):
    number: int
    type: int  # 3 for 16 bits, 4 for 32 bits, 12 for doubles, 2 for text
    value_count: int
    values: bytes


@dataclass(frozen=True)
class StatedSystem:
    """The coordinate system that a file states as text or GeoTIFF keys.

    Attributes
    ----------
    text
        WKT 1 or 2, or a code such as EPSG:25832, or an empty string for GeoTIFF keys.
    records
        Contents of the records with GeoTIFF keys, by record number.
    """

    text: str = ""
    records: Mapping[int, bytes] = field(default_factory=dict)

    @classmethod
    def from_records(cls, records: Mapping[int, bytes], prefer_wkt: bool) -> StatedSystem | None:
        """Create a system from the LASF_Projection records of a LAS file.

        The result is None if the records do not state a system. `prefer_wkt` specifies whether WKT
        has precedence if a file also has GeoTIFF keys.

        Raises
        ------
        ValueError
            If a record is invalid.
        """
        text = records.get(WKT_RECORD, b"").partition(b"\0")[0].decode("utf-8", "replace").strip()
        keys = geo_keys(records)
        if text and (prefer_wkt or not keys):
            return cls(text)
        return cls(records=records) if keys else None

    @classmethod
    def from_comments(cls, comments: Iterable[str]) -> StatedSystem | None:
        """Create a system from the first comment that states a system and nothing else.

        For example, "crs: EPSG:3857" is such a comment. The result is None if there is none.
        """
        matches = (_COMMENT.fullmatch(comment.strip()) for comment in comments)
        texts = (match["wkt"] or f"EPSG:{match['code']}" for match in matches if match)
        return next((cls(text) for text in texts), None)

    @cached_property
    def _keys(self) -> dict[int, float]:
        return geo_keys(self.records)

    @cached_property
    def _is_code(self) -> bool:
        """Whether the text is only a code."""
        return _CODE.fullmatch(self.text) is not None

    @cached_property
    def _code(self) -> int | None:
        """EPSG code of the projected system in the text or in the GeoTIFF keys, or None."""
        if match := _CODE.fullmatch(self.text):
            return int(match[1])
        if self.text:
            try:
                return wkt_code(self.text)
            except ValueError:  # text that is not WKT is ignored if the user specifies the unit
                return None
        code = int(self._keys.get(PROJECTED_CRS, 0))
        return None if code in (0, USER_DEFINED) else code

    @property
    def epsg(self) -> int | None:
        """EPSG code of the system, or None if the file does not state one."""
        return self._code

    @property
    def epsg_in_meters(self) -> int | None:
        """EPSG code of the system if it is projected and in meters, or None."""
        if self.crs is None:
            return self._code if self._stated_m == 1.0 else None
        code = self._code or crs_key(self.crs)[1]
        return code if self.horizontal_m == 1.0 else None

    def units(self) -> CoordinateUnits | None:
        """Return the units of the coordinates, or None if the file does not describe a projection.

        Raises
        ------
        LidarError
            If coordinates are angles or geocentric, or if their unit cannot be determined.
        ValueError
            If the text is not valid WKT.
        """
        if not self.text:
            return units_of_keys(self._keys)
        if self._is_code and self._code is not None:
            return units_of_epsg(self._code)
        return wkt_units(self.text)

    @cached_property
    def crs(self) -> Any:
        """The `rasterio.crs.CRS`, or None if it is unknown.

        The system is unknown if rasterio is not installed, or if PROJ knows no such system on
        Earth.
        """
        if not has_registry():
            return None
        crs = crs_from_text(self.text) if self.text else _crs_from_keys(self.records)
        on_earth = crs is not None and (crs.is_projected or crs.is_geographic or is_geocentric(crs))
        if not on_earth and self._code:  # GeoTIFF keys contain Esri codes as well as EPSG codes
            return crs_from_code(self._code) or crs_from_text(f"ESRI:{self._code}")
        return crs if on_earth else None

    @property
    def horizontal_m(self) -> float | None:
        """Unit of x and y in meters, or None if they are angles or the unit is unknown."""
        if self.crs is not None:
            return float(self.crs.linear_units_factor[1]) if self.crs.is_projected else None
        return self._stated_m

    @property
    def _stated_m(self) -> float | None:
        """Unit of x and y in meters as stated by the file itself, or None."""
        try:
            units = self.units()
        except (LidarError, ValueError):  # angles, or text that is not WKT
            return None
        return None if units is None else units.horizontal.meters

    @property
    def angles(self) -> str:
        """Message clause about angular or geocentric coordinates, or an empty string.

        The clause follows the file name.
        """
        if self.crs is None or self.crs.is_projected:
            return ""
        if is_geocentric(self.crs):
            return f"has geocentric coordinates ({self.name})"
        return f"has angular coordinates ({self.name})" if self.crs.is_geographic else ""

    @property
    def is_true_by_name(self) -> bool | None:
        """Whether the projection preserves lengths, or None if this is unknown.

        This is inferred from the code of the system or the name of the projection.
        """
        if self._code in WORLD_EPSG:
            return False
        if self._code is not None and is_utm(self._code):
            return True
        if not self.text:
            method = method_of_keys(self._keys)
            has_projection = PROJECTED_CRS in self._keys
        elif self._is_code:
            return None
        else:
            try:
                method = wkt_method(self.text)
            except ValueError:  # text that is not WKT is ignored if the user specifies the unit
                return None
            has_projection = bool(method)
        return projection_kind(method) if has_projection else True  # local systems are true

    def is_in_utm_zone(self, positions: Floats) -> bool:
        """Return whether the system is a UTM zone in meters that is true to scale at all positions.

        Positions have shape (n, 3).
        """
        if self._code is None or not is_utm(self._code) or self._stated_m != 1:
            return False
        return not len(positions) or is_true_in_utm(positions[:, 0])

    def height_m(self) -> tuple[float, str]:
        """Return the height unit in meters, and a note if the file does not state it."""
        stated = height_unit_of_keys(self._keys) if not self.text else None
        if stated is not None:
            return stated.meters, ""
        horizontal, up_m = horizontal_part(self.crs)
        if up_m is not None:
            return up_m, ""
        if horizontal.is_projected:
            name, meters = horizontal.linear_units_factor
            note = (
                "does not state a unit for heights, which are assumed to be in the unit of x and "
                f"y ({name})"
            )
            return float(meters), note if meters != 1 else ""
        return 1.0, "does not state a unit for heights, which are assumed to be in meters"

    @cached_property
    def vertical_datum(self) -> str:
        """Name of the vertical datum, as returned by the function `vertical_datum`."""
        if not self.text:
            return vertical_datum_of_keys(self._keys)
        if self.crs is not None:
            return vertical_datum(self.crs)
        try:
            return "" if self._is_code else wkt_vertical_datum(self.text)
        except ValueError:  # text that is not WKT is ignored if the user specifies the unit
            return ""

    @property
    def name(self) -> str:
        """Code and name of the system, as shown in messages."""
        if self.crs is not None and self._has_name:
            return crs_name(self.crs if is_geocentric(self.crs) else horizontal_part(self.crs)[0])
        if self._code is not None:
            return f"EPSG:{self._code}"
        projected = r'(?i)PROJ(?:CS|CRS|ECTEDCRS)\s*[\[(]\s*"([^"]*)"'
        quoted = re.search(projected, self.text) or re.search(r'"([^"]*)"', self.text)
        return printable(quoted[1] if quoted else self.text)[:80] or "a custom coordinate system"

    @property
    def _has_name(self) -> bool:
        """Whether PROJ knows a code or a name for the system."""
        _, code = crs_key(self.crs)
        return code is not None or projjson(self.crs)["name"] not in UNNAMED


@dataclass(frozen=True)
class _Scale:
    """Scale of a coordinate system at the location of the positions, if known."""

    problem: str = ""  # why lengths are not true to scale, as a clause after the file name
    epsg: int | None = None  # code of a suggested system that is true to scale
    note: str = ""  # note on lengths at the edges, or on an unknown scale


def stated_meters(
    system: StatedSystem | None, positions: Floats, unit: str | None
) -> tuple[Meters, list[str]]:
    """Return the units of x, y and z in meters, and notes about the coordinate system.

    Each note is a clause that follows the file name.

    Parameters
    ----------
    system
        The system that the file states, or None for meters.
    positions
        Positions in the file, or a sample of them, in the units of the file. Shape (n, 3).
    unit
        Unit specified by the user, which replaces the units of the system.

    Raises
    ------
    LidarError
        If coordinates are angles or geocentric, if their unit cannot be determined, or if the map
        projection is not true to scale.
    """
    if unit is not None or system is None:
        meter = UNITS_M[unit or "m"]
        problem = "" if system is None else system.angles or _scale_of(system, positions).problem
        note = f"{problem}. As specified, its coordinates are read in {unit} without a correction"
        return (meter, meter, meter), [note] if problem else []
    scale = _scale_of(system, positions)
    if scale.problem:
        raise LidarError(f"it {scale.problem}. {reprojection_advice(scale.epsg)}.")
    units = system.units()
    if units is None:
        return (1.0, 1.0, 1.0), []
    return units.factors, [note for note in (units.conversion_note(), scale.note) if note]


def check_metric_format(system: StatedSystem | None, positions: Floats) -> list[str]:
    """Check the coordinate system of a file whose format requires meters, such as E57.

    `positions` contains all positions in the file, or a sample, in meters. Its shape is (n, 3).

    Raises
    ------
    LidarError
        If coordinates are geocentric, or if the map projection is not true to scale.
    """
    if system is None:
        return []
    if system.crs is not None and is_geocentric(system.crs):
        raise LidarError(
            f"its coordinates are geocentric ({system.name}). {reprojection_advice(None)}."
        )
    meter = system.horizontal_m
    if meter is None:
        return [
            f"states the coordinate system {system.name!r}, but its coordinates are read in meters"
        ]
    scale = _scale_of(system, positions / meter)
    if scale.problem:
        raise LidarError(f"it {scale.problem}. {reprojection_advice(scale.epsg)}.")
    notes = [scale.note] if scale.note else []
    if meter != 1.0:
        notes.append(
            f"is in {system.name}, but its coordinates are read in meters, as its format requires"
        )
    return notes


def _scale_of(system: StatedSystem, positions: Floats) -> _Scale:
    """Determine the scale of a coordinate system at the median of the positions.

    If rasterio is not installed, or if PROJ cannot compute the scale, the scale is inferred from
    the name of the projection.
    """
    middle = np.median(positions[:, :2], axis=0) if len(positions) else np.zeros(2)
    if system.is_in_utm_zone(positions):  # the registry takes half a second to load
        return _Scale(note=_location_note(system, middle) if len(positions) else "")
    horizontal = None
    if system.crs is not None and not is_geocentric(system.crs):
        horizontal, _ = horizontal_part(system.crs)
    if horizontal is None or not len(positions):
        return _scale_by_name(system)
    scale = ground_scale(horizontal, *middle.tolist())
    if scale is None:
        return _Scale() if horizontal.is_geographic else _scale_by_name(system)
    if not scale.is_true:
        problem = f"is in {system.name}, whose meter is {scale} long on the ground here"
        if (area := missed_area(horizontal, *middle.tolist())) is not None:
            x, y = middle.tolist()
            problem = (
                f"states {system.name}, but its coordinates (x {x:.9g}, y {y:.9g}) are outside "
                f"the area of use ({area}), so the stated system may be wrong"
            )
        return _Scale(problem, suggested_epsg(horizontal, *middle.tolist()))
    corners = np.array([positions[:, :2].min(axis=0), positions[:, :2].max(axis=0)])
    scales = [ground_scale(horizontal, x, y) for x in corners[:, 0] for y in corners[:, 1]]
    error = max((scale.error for scale in scales if scale is not None), default=0.0)
    if error <= MAX_SCALE_ERROR:
        return _Scale(note=_location_note(system, middle))
    return _Scale(
        note=f"is so large that lengths in {system.name} are wrong by {error:.1%} at its edges"
    )


def _location_note(system: StatedSystem, middle: Floats) -> str:
    """Return a note if coordinates are far outside the area of use, or an empty string.

    `middle` contains x and y in the unit of the system.
    """
    x, y = middle.tolist()
    area = outside_system(system.epsg, x, y) if system.epsg is not None else ""
    return f"has coordinates (x {x:,.9g}, y {y:,.9g}) outside {area}" if area else ""


def _scale_by_name(system: StatedSystem) -> _Scale:
    """Infer the scale of a system from the name of its projection."""
    is_true = system.is_true_by_name
    if is_true:
        return _Scale()
    if is_true is None:
        why = (
            ""
            if has_registry()
            else (f". To check the scale, run {install_command('lidarpool[geo]')}")
        )
        return _Scale(note=f"is in {system.name}, whose scale is assumed to be true{why}")
    return _Scale(f"is in {system.name}, whose meters are not true to scale")


class Reprojection:
    """Transformation from the coordinate system of a file to one that is true to scale.

    The target system is in meters. Heights are converted to meters, but keep their vertical datum.
    Heights of geocentric coordinates are above the ellipsoid.

    Parameters
    ----------
    system
        The system that the file states.
    epsg
        Code of a projected system in meters.

    Attributes
    ----------
    notes
        Clauses that follow the name of the file.

    Raises
    ------
    LidarError
        If the file states no system, if PROJ does not know one of the systems, or if rasterio is
        not installed.
    """

    def __init__(self, system: StatedSystem | None, epsg: int) -> None:
        require_registry("Transforming a cloud to another coordinate system")
        if system is None:
            raise LidarError(
                "it does not specify a coordinate system, so it cannot be transformed to "
                f"EPSG:{epsg}. Remove --epsg (epsg= in Python), or assign a system first "
                "(pdal translate IN OUT --readers.las.override_srs=EPSG:CODE)."
            )
        source = system.crs
        if source is None:
            raise LidarError(f"its coordinate system {system.name!r} is unknown to PROJ.")
        target = crs_from_code(epsg)
        if target is None:
            raise LidarError(f"EPSG:{epsg} is unknown to PROJ. Use the code of a different system.")
        self._epsg = epsg
        self._target, _ = horizontal_part(target)
        self._is_geocentric = is_geocentric(source)
        self._source = source if self._is_geocentric else horizontal_part(source)[0]
        self.notes = [f"was transformed from {system.name} to EPSG:{epsg}"]
        self._height_m = 1.0
        if not self._is_geocentric:
            self._height_m, note = system.height_m()
            self.notes += [note] if note else []

    def check(self, positions: Floats) -> None:
        """Check that the target system is true to scale at the median of the positions.

        Raises
        ------
        LidarError
            If it is not true to scale.
        """
        moved = self.apply(positions)
        if len(moved):
            x, y = np.median(moved[:, :2], axis=0).tolist()
            if problem := target_problem(self._epsg, x, y):
                raise LidarError(f"it cannot be transformed to {problem}.")

    def apply(self, positions: Floats) -> Floats:
        """Transform positions to the target system in meters.

        Positions that are not finite become NaN. The shape is (n, 3).

        Raises
        ------
        LidarError
            If a position is outside the domain of one of the systems.
        """
        finite = np.asarray(np.isfinite(positions).all(axis=1))
        moved = np.where(finite[:, None], positions, np.nan).astype(np.float64)
        axes = slice(3) if self._is_geocentric else slice(2)
        try:
            moved[finite, axes] = transform_coordinates(
                self._source, self._target, moved[finite, axes]
            )
        except Exception as error:  # rasterio does not export the classes of GDAL errors
            raise self._location_error() from error
        if not np.isfinite(moved[finite]).all():
            raise self._location_error()
        moved[:, 2] *= self._height_m
        return moved

    def _location_error(self) -> LidarError:
        return LidarError(
            f"it contains points that cannot be transformed to EPSG:{self._epsg}. Use the code of "
            "a different system."
        )


def _crs_from_keys(records: Mapping[int, bytes]) -> Any:
    """Return the `rasterio.crs.CRS` for GeoTIFF keys, or None.

    GDAL reads the keys from a TIFF with a single pixel, so that user-defined projections are
    supported.
    """
    from rasterio.errors import RasterioError
    from rasterio.io import MemoryFile

    try:
        with MemoryFile(_tiff(records)) as memory, memory.open(driver="GTiff") as file:
            return file.crs
    except RasterioError:
        return None


def _tiff(records: Mapping[int, bytes]) -> bytes:
    """Return a little-endian TIFF 6.0 file that consists of a single pixel and GeoTIFF keys."""
    tags = [
        _TiffTag(256, 4, 1, struct.pack("<I", 1)),  # width
        _TiffTag(257, 4, 1, struct.pack("<I", 1)),  # length
        _TiffTag(258, 3, 1, struct.pack("<H", 8)),  # bits per sample
        _TiffTag(259, 3, 1, struct.pack("<H", 1)),  # no compression
        _TiffTag(262, 3, 1, struct.pack("<H", 1)),  # black is zero
        _TiffTag(273, 4, 1, struct.pack("<I", 8)),  # offset of the pixel
        _TiffTag(277, 3, 1, struct.pack("<H", 1)),  # samples per pixel
        _TiffTag(278, 4, 1, struct.pack("<I", 1)),  # rows
        _TiffTag(279, 4, 1, struct.pack("<I", 1)),  # bytes in the strip
        _TiffTag(33550, 12, 3, struct.pack("<3d", 1, 1, 0)),  # size of the pixel
        _TiffTag(33922, 12, 6, bytes(6 * 8)),  # its position, six zeros
        *(
            _TiffTag(number, kind, len(records[number]) // size, records[number])
            for number, kind, size in ((GEO_KEYS, 3, 2), (GEO_DOUBLES, 12, 8), (GEO_TEXTS, 2, 1))
            if records.get(number)
        ),
    ]
    directory = 12  # its offset, after the header and four bytes, the first of which is the pixel
    body_start = directory + 2 + 12 * len(tags) + 4
    rows = b""
    body = b""
    for tag in tags:
        rows += struct.pack("<HHI", tag.number, tag.type, tag.value_count)
        if len(tag.values) <= 4:
            rows += tag.values.ljust(4, b"\0")
        else:
            rows += struct.pack("<I", body_start + len(body))
            body += tag.values + b"\0" * (len(tag.values) % 2)
    head = b"II*\0" + struct.pack("<I", directory) + bytes(4)
    return head + struct.pack("<H", len(tags)) + rows + bytes(4) + body

"""Units of coordinates, derived from the coordinate system that a file states.

The system is stated as WKT or as GeoTIFF keys. OGC WKT 1 and 2 state the length of each unit.
GeoTIFF keys refer to units or coordinate systems by EPSG codes. The units of a coordinate system
are looked up in the PROJ database, which is part of rasterio.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

from ...environment.extras import install_command
from ...errors import CutShortError, LidarError
from ...schema.vocabulary import UNITS_M
from .coordinate_systems import (
    ELLIPSOID,
    UNNAMED,
    UTM_EPSG,
    crs_from_code,
    has_registry,
    vertical_datum,
)

# Record numbers of LASF_Projection in ASPRS LAS 1.4, which are also TIFF tags
GEO_KEYS = 34735
GEO_DOUBLES = 34736
GEO_TEXTS = 34737

# Keys defined by OGC GeoTIFF 1.1
_MODEL_TYPE = 1024
_GEODETIC_CRS = 2048
PROJECTED_CRS = 3072
_PROJECTION = 3075  # method of a user-defined projection
_LINEAR_UNIT = 3076
_LINEAR_UNIT_SIZE = 3077
_VERTICAL_CRS = 4096
_VERTICAL_UNIT = 4099
# Model types
_GEOGRAPHIC = 2
_GEOCENTRIC = 3
USER_DEFINED = 32767

_EPSG_UNITS = {  # {EPSG code: (name, meters)}
    1025: ("millimetre", 0.001),
    1033: ("centimetre", 0.01),
    9001: ("metre", 1.0),
    9002: ("foot", 0.3048),
    9003: ("US survey foot", 12 / 39.37),
    9005: ("Clarke's foot", 0.3047972654),
    9036: ("kilometre", 1000.0),
    9041: ("British foot (Sears 1922)", 0.3047994715386762),
    9080: ("Indian foot", 0.304799510248147),
    9093: ("mile", 1609.344),
    9094: ("Gold Coast foot", 0.3047997101815088),
    9096: ("yard", 0.9144),
}
# Names of projection methods by their numbers in GeoTIFF 1.0, limited to those that
# `projection_kind` recognizes.
_METHODS = {
    1: "Transverse Mercator",
    3: "Oblique Mercator",
    5: "Swiss Oblique Mercator",
    7: "Mercator",
    8: "Lambert Conformal Conic 2SP",
    9: "Lambert Conformal Conic 1SP",
    16: "Oblique Stereographic",
    18: "Cassini",
}
_UNIT_NAMES = {  # as spelled in files, but in lower case and with spaces instead of "_" and "-"
    **UNITS_M,
    **dict.fromkeys(("metre", "meter", "metres", "meters"), 1.0),
    **dict.fromkeys(("millimetre", "millimeter", "millimetres", "millimeters"), 1e-3),
    **dict.fromkeys(("centimetre", "centimeter", "centimetres", "centimeters"), 1e-2),
    **dict.fromkeys(("decimetre", "decimeter", "decimetres", "decimeters"), 1e-1),
    **dict.fromkeys(("kilometre", "kilometer", "kilometres", "kilometers"), 1e3),
    **dict.fromkeys(("inch", "inches"), 0.0254),
    **dict.fromkeys(("foot", "feet", "international foot", "international feet"), 0.3048),
    **dict.fromkeys(
        ("us survey foot", "us survey feet", "us foot", "us ft", "ftus", "survey foot", "usft"),
        12 / 39.37,
    ),
    **dict.fromkeys(("yard", "yards"), 0.9144),
    **dict.fromkeys(("mile", "miles"), 1609.344),
}
_DATUMS = range(5001, 5300)  # GeoTIFF 1.0 uses datums, which have no unit, as vertical systems
_ELLIPSOIDS = range(5001, 5100)  # the part of `_DATUMS` that denotes ellipsoidal heights
_DATUM_SYSTEMS = range(5101, 5107)  # datums whose vertical systems have codes that differ by 600
# All commands and functions that read clouds have a unit option, but compare reads two clouds.
_OVERRIDE = (
    "Specify the unit with --unit, or with --unit-a and --unit-b for compare (unit=, unit_a= and "
    "unit_b= in Python)"
)


def reprojection_advice(epsg: int | None) -> str:
    """Suggest how to transform a cloud to a coordinate system in meters.

    The result is a sentence. `epsg` is the code of the suggested system, or None.
    """
    code = epsg or "CODE"
    return (
        f"Use lidarpool scene points --epsg {code} (epsg= in Python), or project it first (pdal "
        f"translate IN OUT reprojection --filters.reprojection.out_srs=EPSG:{code})"
    )


class CoordinateUnit(NamedTuple):
    """A length unit."""

    name: str
    meters: float


METRE = CoordinateUnit("metre", 1.0)


def unit_by_name(name: str) -> float | None:
    """Return the length of a named unit in meters, or None if the unit is unknown.

    The case of the name is ignored.
    """
    words = re.sub(r"[\s_-]+", " ", name.replace(".", "")).strip().lower()
    return _UNIT_NAMES.get(words)


@dataclass(frozen=True)
class CoordinateUnits:
    """Horizontal and vertical length units of coordinates."""

    horizontal: CoordinateUnit
    vertical: CoordinateUnit
    vertical_stated: bool = True  # False if the unit of z is assumed to be the unit of x and y

    @property
    def factors(self) -> tuple[float, float, float]:
        """Factors that convert x, y and z to meters."""
        return self.horizontal.meters, self.horizontal.meters, self.vertical.meters

    @property
    def is_metric(self) -> bool:
        """Whether all coordinates are in meters."""
        return self.factors == (1.0, 1.0, 1.0)

    def conversion_note(self) -> str:
        """Return a note about the conversion to meters, or an empty string if none is needed."""
        if self.is_metric:
            return ""
        if not self.vertical_stated:
            return (
                f"was converted from {self.horizontal.name} to meters. It does not state a unit "
                "for heights, which are assumed to have the same unit. If they do not, "
                f"s{_OVERRIDE[1:]}"
            )
        if self.horizontal == self.vertical:
            return f"was converted from {self.horizontal.name} to meters"
        return (
            f"was converted to meters from {self.horizontal.name}, with heights in "
            f"{self.vertical.name}"
        )


# -- WKT -----------------------------------------------------------------------------------------

_TOKENS = re.compile(
    r'"((?:[^"]|"")*)"|([A-Za-z_][A-Za-z_0-9]*)|([-+]?[\d.]+(?:[eE][-+]?\d+)?)|([][(),])'
)
_MAX_DEPTH = 50
_HORIZONTAL = {
    "PROJCS",
    "PROJCRS",
    "PROJECTEDCRS",
    "LOCAL_CS",
    "ENGCRS",
    "ENGINEERINGCRS",
    "DERIVEDPROJCRS",
}
_LOCAL = {"LOCAL_CS", "ENGCRS", "ENGINEERINGCRS"}
_VERTICAL = {"VERT_CS", "VERTCRS", "VERTICALCRS"}
_VERTICAL_DATUMS = {"VERT_DATUM", "VDATUM", "VRF", "VERTICALDATUM", "ENSEMBLE"}
_ELLIPSOIDAL = "2002"  # type of a vertical datum in OGC WKT 1
_ANGULAR = {"GEOGCS", "GEOGCRS", "GEOGRAPHICCRS", "GEODCRS", "GEODETICCRS", "GEOCCS"}
_COMPOUND = {"COMPD_CS", "COMPOUNDCRS"}
_BOUND = {"BOUNDCRS"}
WKT_KEYWORDS = _HORIZONTAL | _ANGULAR | _COMPOUND | _BOUND  # possible keywords of the root node
_LENGTH_UNITS = ("UNIT", "LENGTHUNIT")


@dataclass
class _Node:
    """A WKT node, which consists of a keyword, values and child nodes."""

    keyword: str
    values: list[str] = field(default_factory=list)
    nodes: list[_Node] = field(default_factory=list)

    def child(self, keywords: set[str]) -> _Node | None:
        """Return the first child node with one of the keywords, or None."""
        return next((node for node in self.nodes if node.keyword in keywords), None)


def wkt_units(text: str) -> CoordinateUnits:
    """Return the units of a coordinate system in WKT 1 or 2.

    Raises
    ------
    LidarError
        If coordinates are angles or geocentric, or if their unit cannot be determined.
    ValueError
        If the text is not valid WKT.
    """
    node, parts = _parse_systems(text)
    horizontal = next((part for part in parts if part.keyword in _HORIZONTAL), None)
    vertical = next((part for part in parts if part.keyword in _VERTICAL), None)
    name = node.values[0] if node.values else node.keyword
    if horizontal is None:
        if angular := next((part for part in parts if part.keyword in _ANGULAR), None):
            kind = "geocentric" if _is_geocentric(angular) else "angles"
            raise LidarError(
                f"its coordinates are {kind} ({name[:80]}). {reprojection_advice(None)}."
            )
        raise ValueError(
            f"its coordinate system begins with {node.keyword[:20]!r}, but the WKT of a projected "
            "system was expected"
        )
    unit = _length_unit(horizontal)
    if unit is None:
        raise LidarError(f"its coordinate system {name[:80]!r} has no unit. {_OVERRIDE}.")
    heights = _length_unit(vertical) if vertical is not None else _third_unit(horizontal)
    if heights is None:
        return CoordinateUnits(unit, unit, vertical_stated=False)
    return CoordinateUnits(unit, heights)


def wkt_method(text: str) -> str:
    """Return the name of the projection method in WKT, or an empty string without a projection."""
    _, parts = _parse_systems(text)
    for part in parts:
        if part.keyword in _HORIZONTAL:
            conversion = part.child({"CONVERSION"}) or part
            method = conversion.child({"METHOD", "PROJECTION"})
            return method.values[0] if method and method.values else ""
    return ""


def wkt_code(text: str) -> int | None:
    """Return the EPSG code of the projected system in WKT, or None."""
    _, parts = _parse_systems(text)
    for part in parts:
        code = part.child({"AUTHORITY", "ID"}) if part.keyword in _HORIZONTAL else None
        if code and len(code.values) > 1 and code.values[0].upper() == "EPSG":
            return int(code.values[1]) if code.values[1].isdecimal() else None
    return None


def wkt_vertical_datum(text: str) -> str:
    """Return the name of the vertical datum in WKT, as `vertical_datum` does for a known system.

    Raises
    ------
    ValueError
        If the text is not valid WKT.
    """
    _, parts = _parse_systems(text)
    if vertical := next((part for part in parts if part.keyword in _VERTICAL), None):
        datum = vertical.child(_VERTICAL_DATUMS) or _Node("")
        name, kind = [*datum.values, "", ""][:2]
        if kind == _ELLIPSOIDAL or name.lower() == ELLIPSOID:
            return ELLIPSOID
        return "" if name.lower() in UNNAMED else name[:80]
    projected = (part for part in parts if part.keyword in _HORIZONTAL - _LOCAL)
    return ELLIPSOID if any(map(_third_unit, projected)) else ""


def _parse_systems(text: str) -> tuple[_Node, list[_Node]]:
    """Return the coordinate system in WKT and its components.

    A system that is not compound is its only component.
    """
    node = _without_transformation(_parse_wkt(text))
    if node.keyword not in _COMPOUND:
        return node, [node]
    return node, [_without_transformation(part) for part in node.nodes]


def _without_transformation(node: _Node) -> _Node:
    """Return a bound system's source system, or any other system unchanged."""
    source = node.child({"SOURCECRS"}) if node.keyword in _BOUND else None
    return source.nodes[0] if source and source.nodes else node


def _is_geocentric(system: _Node) -> bool:
    axes = system.child({"CS"})
    return system.keyword == "GEOCCS" or (
        axes is not None and any(node.keyword == "CARTESIAN" for node in axes.nodes)
    )


def _parse_wkt(text: str) -> _Node:
    root = _Node("")
    open_nodes = [root]
    for match in _TOKENS.finditer(text):
        quoted, keyword, number, mark = match.groups()
        node = open_nodes[-1]
        if keyword is not None:
            node.nodes.append(_Node(keyword.upper()))
        elif quoted is not None or number is not None:
            node.values.append(number if quoted is None else quoted.replace('""', '"'))
        elif mark in "[(":
            if not node.nodes or len(open_nodes) > _MAX_DEPTH:
                raise ValueError("its coordinate system is not valid WKT")
            open_nodes.append(node.nodes[-1])
        elif mark in "])":
            if len(open_nodes) == 1:
                raise ValueError("its coordinate system is not valid WKT")
            open_nodes.pop()
    if not root.nodes:
        raise ValueError("its coordinate system is not valid WKT")
    if len(open_nodes) > 1:
        raise CutShortError(f"its coordinate system ends within {root.nodes[0].keyword[:20]}")
    return root.nodes[0]


def _length_unit(system: _Node) -> CoordinateUnit | None:
    """Return the unit of a system's first axis.

    WKT 2 can state the unit of each axis.
    """
    for node in (system, *system.nodes):
        if node is system or node.keyword == "AXIS":
            unit = node.child({*_LENGTH_UNITS})
            if unit is not None:
                return _parse_unit(unit)
    return None


def _third_unit(system: _Node) -> CoordinateUnit | None:
    """Return the unit of a three-dimensional projected system's third axis, or None."""
    axes = [node for node in system.nodes if node.keyword == "AXIS"]
    if len(axes) < 3:
        return None
    unit = axes[2].child({*_LENGTH_UNITS})
    return _length_unit(system) if unit is None else _parse_unit(unit)


def _parse_unit(node: _Node) -> CoordinateUnit:
    name, *factors = node.values
    meters = float(factors[0]) if factors else 0.0
    if not 1e-6 <= meters <= 1e6:
        raise LidarError(f"its unit {name[:40]!r} is not a length. {_OVERRIDE}.")
    return CoordinateUnit(name[:40], meters)


# -- GeoTIFF keys --------------------------------------------------------------------------------


def geo_keys(records: Mapping[int, bytes]) -> dict[int, float]:
    """Return the numeric GeoTIFF keys of a file.

    Keys with text values are omitted.
    """
    data = records.get(GEO_KEYS, b"")
    if len(data) < 8:
        return {}
    doubles = records.get(GEO_DOUBLES, b"")
    (count,) = struct.unpack_from("<H", data, 6)
    if 8 + 8 * count > len(data):
        raise CutShortError(f"{count} GeoTIFF keys were expected, but there are fewer")
    return dict(_key_values(data, count, doubles))


def _key_values(data: bytes, count: int, doubles: bytes) -> Iterator[tuple[int, float]]:
    for number in range(count):
        key, location, _, value = struct.unpack_from("<4H", data, 8 + 8 * number)
        if location == 0:
            yield key, value
        elif location == GEO_DOUBLES:
            yield key, struct.unpack_from("<d", doubles, 8 * value)[0]


def units_of_keys(keys: Mapping[int, float]) -> CoordinateUnits | None:
    """Return the units that GeoTIFF keys specify, or None if there is no projection.

    Raises
    ------
    LidarError
        If coordinates are angles or geocentric, or if their unit cannot be determined.
    """
    model = keys.get(_MODEL_TYPE)
    projected = int(keys.get(PROJECTED_CRS, 0))
    if model in (_GEOGRAPHIC, _GEOCENTRIC) or (
        _GEODETIC_CRS in keys and not projected and not model
    ):
        code = int(keys.get(_GEODETIC_CRS, 0))
        kind = "geocentric" if model == _GEOCENTRIC else "angles"
        raise LidarError(f"its coordinates are {kind} (EPSG:{code}). {reprojection_advice(None)}.")
    unit = _unit_of_code(keys.get(_LINEAR_UNIT))
    heights = None
    if keys.get(_LINEAR_UNIT) == USER_DEFINED and _LINEAR_UNIT_SIZE in keys:
        unit = CoordinateUnit("custom units", keys[_LINEAR_UNIT_SIZE])
    if projected not in (0, USER_DEFINED) and unit is None:
        system = units_of_epsg(projected)
        unit = system.horizontal
        heights = system.vertical if system.vertical_stated else None
    if unit is None:
        if not projected:
            return None  # the keys do not describe a projection
        raise LidarError(f"it uses a custom coordinate system without a unit. {_OVERRIDE}.")
    heights = height_unit_of_keys(keys) or heights
    if heights is None:
        return CoordinateUnits(unit, unit, vertical_stated=False)
    return CoordinateUnits(unit, heights)


def vertical_datum_of_keys(keys: Mapping[int, float]) -> str:
    """Return the name of the vertical datum in GeoTIFF keys, as `vertical_datum` does.

    Without rasterio, the result contains the EPSG code of the vertical system instead of a name.
    """
    code = int(keys.get(_VERTICAL_CRS, 0))
    if code in _ELLIPSOIDS:
        return ELLIPSOID
    code += 600 if code in _DATUM_SYSTEMS else 0
    if code in (0, USER_DEFINED):
        return ""
    crs = crs_from_code(code) if has_registry() else None
    return f"EPSG:{code}" if crs is None else vertical_datum(crs)


def height_unit_of_keys(keys: Mapping[int, float]) -> CoordinateUnit | None:
    """Return the height unit that GeoTIFF keys specify, or None."""
    vertical = int(keys.get(_VERTICAL_CRS, 0))
    if _VERTICAL_UNIT in keys:
        return _unit_of_code(keys[_VERTICAL_UNIT])
    return None if vertical in (0, USER_DEFINED) else _vertical_unit_of_epsg(vertical)


def method_of_keys(keys: Mapping[int, float]) -> str:
    """Return the name of the projection method in GeoTIFF keys.

    The name is an empty string if the method is unknown.
    """
    return _METHODS.get(int(keys.get(_PROJECTION, 0)), "")


def _unit_of_code(code: float | None) -> CoordinateUnit | None:
    """Return the unit for an EPSG code, or None if the code is missing or user-defined."""
    if code is None or code in (0, USER_DEFINED):
        return None
    if int(code) not in _EPSG_UNITS:
        raise LidarError(f"its unit EPSG:{int(code)} is unknown. {_OVERRIDE}.")
    return CoordinateUnit(*_EPSG_UNITS[int(code)])


def units_of_epsg(code: int) -> CoordinateUnits:
    """Return the units of a projected or compound system in the EPSG registry."""
    if any(code in codes for codes in UTM_EPSG):
        return CoordinateUnits(METRE, METRE, vertical_stated=False)
    return wkt_units(_wkt_of_epsg(code))


def _vertical_unit_of_epsg(code: int) -> CoordinateUnit | None:
    if code in _DATUMS:
        return None
    node = _parse_wkt(_wkt_of_epsg(code))
    return _length_unit(node) if node.keyword in _VERTICAL else None


def _wkt_of_epsg(code: int) -> str:
    if not has_registry():
        raise LidarError(
            f"its coordinate system EPSG:{code} has an unknown unit. {_OVERRIDE}. To look up the "
            f"unit instead, run {install_command('lidarpool[geo]')}."
        )
    crs = crs_from_code(code)
    if crs is None:
        raise LidarError(f"its coordinate system EPSG:{code} is unknown. {_OVERRIDE}.")
    return str(crs.to_wkt(version="WKT2_2019"))

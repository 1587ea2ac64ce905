"""Coordinate systems on Earth: where their meters are meters on the ground, by rasterio's PROJ.

A map projection stretches lengths. National grids and UTM zones do so by less than 1 % where they
are meant to be used; Web Mercator (EPSG:3857) by 47 % in Zurich, with heights as they are.
"""

from __future__ import annotations

import json
import re
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from importlib.util import find_spec
from typing import Any

import numpy as np

from ...environment.extras import install_command
from ...errors import LidarError
from ...numerics.arrays import Floats
from ...numerics.elementary import sin_cos
from ...numerics.vectors import rotate
from ...schema.vocabulary import OF_THE_WORLD, WORLD_EPSG
from ..scene_instances import SceneInstance
from ..scene_mesh import SceneMesh

MAX_SCALE_ERROR = 0.01  # error of lengths that count as true
UTM_EPSG = (range(32601, 32661), range(32701, 32761), range(25828, 25839), range(26901, 26924))
_UTM_MIDDLE_M = 500_000.0  # easting of the meridian in the middle of a zone
_UTM_HALF_WIDTH_M = 900_000.0  # at this distance from the middle lengths are wrong by 0.96 %
_GROUND_STEP_M = 10.0  # step of the differences that a scale is computed by
_BLOCK_POINTS = 100_000  # reprojected at a time, through lists of Python
UNNAMED = ("unnamed", "unknown", "")  # names by GDAL and PROJ of systems without a name
POLAR_EPSG = (5041, 5042)  # universal polar stereographic, of the north and of the south
_POLAR_DEG = 84.0  # from this latitude on, the polar stereographic projection replaces UTM
# Systems are used beyond the area that the registry states, but not this far, degrees of arc: UTM
# zone 33 serves all of Norway, 30 degrees wide, and zone 32 all of Bavaria.
_AREA_MARGIN_DEG = 5.0
_ELSEWHERE_DEG = 20.0  # coordinates this far from the area are likely those of another system
_AREA_LETTERS = 90  # of the name of an area in messages
# Northings within the zones of each family of UTM codes, in meters, for places that need no
# registry to be recognized.
_UTM_NORTHINGS_M = {
    range(32601, 32661): (0.0, 9.4e6),
    range(32701, 32761): (1.1e6, 10e6),
    range(25828, 25839): (4e6, 9.4e6),
    range(26901, 26924): (1.6e6, 9.4e6),
}
_UTM_ZONE_HALF_WIDTH_M = 400_000.0  # a zone at the equator reaches to 333 km from its middle
_WGS84_ELLIPSOID = (6378137.0, 298.257223563)  # semi-major axis in meters, inverse flattening

# Projections that are made for lengths of countries, by letters of their names.
_OF_COUNTRIES = re.compile(
    "transversemercator|gausskruger|conformalconic|conicconformal|obliquestereographic|"
    "doublestereographic|hotine|obliquemercator|swissoblique|rectifiedskew|krovak|cassini|"
    "newzealandmapgrid|laborde"
)


@dataclass(frozen=True)
class GroundScale:
    """True lengths of a meter of a coordinate system at a place, by its direction."""

    shortest: float  # meters
    longest: float  # meters

    @property
    def error(self) -> float:
        """Largest relative error of a length, in any direction."""
        return max(abs(self.shortest - 1), abs(self.longest - 1))

    @property
    def is_true(self) -> bool:
        """Whether lengths in all directions are true within `MAX_SCALE_ERROR`."""
        return self.error <= MAX_SCALE_ERROR

    @property
    def is_even(self) -> bool:
        """Whether lengths in all directions are stretched alike, within `MAX_SCALE_ERROR`."""
        return self.longest - self.shortest <= MAX_SCALE_ERROR * self.longest

    def __str__(self) -> str:
        if self.is_even:
            return f"{(self.shortest + self.longest) / 2:.3g} m"
        return f"{self.shortest:.3g} to {self.longest:.3g} m"


@dataclass(frozen=True)
class AreaOfUse:
    """The area on Earth where a coordinate system is meant to be used.

    Attributes
    ----------
    name
        The area in words, by the registry.
    west, south, east, north
        Bounds in degrees; `west` is greater than `east` if the area crosses the date line.
    """

    name: str
    west: float
    south: float
    east: float
    north: float

    def __str__(self) -> str:
        name = self.name.partition(". ")[0].rstrip(".")
        return textwrap.shorten(name, _AREA_LETTERS, placeholder=" …")

    @property
    def width(self) -> float:
        """Width in degrees of longitude."""
        return (self.east - self.west) % 360 or 360.0

    def reaches(self, longitude: float, latitude: float, margin_deg: float = 0.0) -> bool:
        """Return True for a place within `margin_deg` of the area, in degrees of arc."""
        if not self.south - margin_deg <= latitude <= self.north + margin_deg:
            return False
        cosine = float(sin_cos(np.radians(np.array([latitude])))[1][0])
        margin = margin_deg / max(cosine, 1e-6)
        if self.width + 2 * margin >= 360:
            return True
        return (longitude - self.west + margin) % 360 <= self.width + 2 * margin


def has_registry() -> bool:
    """Return True if rasterio is installed, which has PROJ and the registry of EPSG."""
    return find_spec("rasterio") is not None


def need_registry(purpose: str) -> None:
    """Check that rasterio is installed.

    Raises LidarError if not. `purpose` starts the error.
    """
    if not has_registry():
        raise LidarError(
            f"{purpose} requires rasterio, which is not installed. Run "
            f"{install_command('lidarpool[geo]')}."
        )


def crs_of_text(text: str) -> Any:
    """Return the `rasterio.crs.CRS` of WKT, a code such as EPSG:3857, or a definition of PROJ.

    None for a text that PROJ does not understand.
    """
    from rasterio.crs import CRS
    from rasterio.errors import CRSError

    try:
        return CRS.from_user_input(text)
    except CRSError:
        return None


@lru_cache(maxsize=32)
def _crs_of_json(text: str) -> Any:
    """Return the `rasterio.crs.CRS` of PROJJSON, which takes 20 ms to read."""
    return crs_of_text(text)


def crs_of_code(epsg: int) -> Any:
    """Return the `rasterio.crs.CRS` of an EPSG code, or None if the code is unknown."""
    return crs_of_text(f"EPSG:{epsg}")


def projjson(crs: Any) -> dict[str, Any]:
    """Return the PROJJSON of a coordinate system, without a datum bound to the system."""
    return _unbound(crs.to_dict(projjson=True))


def _unbound(described: dict[str, Any]) -> dict[str, Any]:
    """Return the PROJJSON of a system that may be bound to a datum."""
    source: dict[str, Any] = described.get("source_crs", described)
    return source


def horizontal_part(crs: Any) -> tuple[Any, float | None]:
    """Return the horizontal system of a system on Earth, and meters in its unit of heights.

    The unit is None for a system without heights.
    """
    described = projjson(crs)
    parts = [_unbound(part) for part in described.get("components", [described])]
    axes = [axis for part in parts for axis in part["coordinate_system"]["axis"]]
    units = [axis["unit"] for axis in axes if axis["direction"] == "up"]
    horizontal = _crs_of_json(json.dumps(parts[0])) if len(parts) > 1 else crs
    if not units:
        return horizontal, None
    return horizontal, 1.0 if units[0] == "metre" else float(units[0]["conversion_factor"])


def is_local(crs: Any) -> bool:
    """Return True for a system with axes of length that has no place on Earth, such as a site grid.

    The types LOCAL_CS of WKT 1 and ENGCRS of WKT 2. `crs` must not be compound.
    """
    return bool(projjson(crs)["type"] == "EngineeringCRS" and linear_unit(crs) is not None)


def linear_unit(crs: Any) -> tuple[str, float] | None:
    """Return the name of the unit of x and y and its length in meters, or None for angles.

    `crs` must not be compound. GDAL knows the unit of projected systems only.
    """
    axes = projjson(crs).get("coordinate_system", {}).get("axis", ())
    unit = axes[0].get("unit") if axes else None
    if unit == "metre":
        return unit, 1.0
    if not isinstance(unit, dict) or unit.get("type") != "LinearUnit":
        return None
    meters = float(unit["conversion_factor"])
    name = str(unit["name"])[:40]
    return f"{meters:g} m" if name in UNNAMED else name, meters


def is_geocentric(crs: Any) -> bool:
    """Return True for a system with its origin in the middle of the Earth."""
    described = projjson(crs)
    axes = described.get("coordinate_system", {})
    return described["type"] == "GeodeticCRS" and axes.get("subtype") == "Cartesian"


def crs_key(crs: Any) -> tuple[str, int | None]:
    """Return a text that identifies a coordinate system, and its EPSG code if that is certain."""
    if crs is None:
        return "", None
    code = crs.to_epsg(confidence_threshold=90)  # 70 would guess an unknown datum
    return f"EPSG:{code}" if code else crs.to_wkt(), code


def crs_name(crs: Any) -> str:
    """Return the code and the name of a coordinate system for messages."""
    _, code = crs_key(crs)
    name = str(projjson(crs)["name"])[:80]
    if not code:
        return name
    return f"EPSG:{code}" if name in UNNAMED else f"EPSG:{code} ({name})"


def named_system(epsg: int) -> str:
    """Return an EPSG code and, if rasterio is installed and knows the code, the system's name."""
    crs = crs_of_code(epsg) if has_registry() else None
    return f"EPSG:{epsg}" if crs is None else crs_name(crs)


def transformed(source: Any, target: Any, points: Floats) -> Floats:
    """Return points (n, 2) or (n, 3) in another coordinate system.

    Infinite where a coordinate is not finite; any exception where a point is outside of what one of
    the systems can represent.
    """
    from rasterio.warp import transform

    moved = np.empty((len(points), points.shape[1]))
    for start in range(0, len(points), _BLOCK_POINTS):
        block = slice(start, start + _BLOCK_POINTS)
        moved[block] = np.transpose(transform(source, target, *points[block].T))
    return moved


def longitude_latitude(crs: Any, x: float, y: float) -> tuple[float, float] | None:
    """Return longitude and latitude (WGS 84) of a place, degrees, or None outside of the system."""
    places = _transformed_places(crs, crs_of_code(4326), np.array([[x, y]]))
    return None if places is None else (float(places[0, 0]), float(places[0, 1]))


def _transformed_places(source: Any, target: Any, places: Floats) -> Floats | None:
    """Return places (n, 2) in another system, or None if one of them has no coordinates there."""
    try:
        moved = transformed(source, target, places)
    except Exception:  # errors of GDAL have classes that rasterio keeps private
        return None
    return moved if np.isfinite(moved).all() else None


def area_of_use(crs: Any) -> AreaOfUse | None:
    """Return the area of use of a coordinate system, or None if the registry states none.

    `crs` must not be compound.
    """
    code = crs.to_epsg(confidence_threshold=90)
    described = projjson(crs_of_code(code) if code else crs)
    stated = [part for part in (described, *described.get("usages", ())) if part.get("bbox")]
    if not stated:
        return None
    usage = min(stated, key=lambda part: len(part.get("area", "")))
    sides = ("west_longitude", "south_latitude", "east_longitude", "north_latitude")
    return AreaOfUse(str(usage.get("area", "")), *(float(usage["bbox"][side]) for side in sides))


def missed_area(
    crs: Any, x: float, y: float, margin_deg: float = _ELSEWHERE_DEG
) -> AreaOfUse | None:
    """Return the area of use of a system if a place is not within `margin_deg` of it, else None.

    None also for a system whose area is not known.

    Parameters
    ----------
    crs
        A `rasterio.crs.CRS`, not compound.
    x, y
        Coordinates of the place, in the unit of the system.
    """
    area = area_of_use(crs)
    if area is None:
        return None
    place = longitude_latitude(crs, x, y)
    is_near = place is not None and area.reaches(*place, margin_deg)
    return None if is_near else area


def outside_system(epsg: int, x: float, y: float) -> str:
    """Return a clause that names a system and its area of use if a place is far outside, else "".

    Far is 5 degrees of arc. The clause is such as «the area of use of EPSG:2056 (CH1903+ / LV95),
    which is Liechtenstein; Switzerland». Empty for a code that is not known, for a system that is
    not projected, and without rasterio.
    """
    if _is_in_zone(epsg, x, y) or not has_registry():
        return ""
    crs = crs_of_code(epsg)
    horizontal = None if crs is None else horizontal_part(crs)[0]
    if horizontal is None or not horizontal.is_projected:
        return ""
    area = missed_area(horizontal, x, y, _AREA_MARGIN_DEG)
    if area is None:
        return ""
    named = f", which is {area}" if area.name else ""
    return f"the area of use of {crs_name(crs)}{named}"


def _is_in_zone(epsg: int, x: float, y: float) -> bool:
    """Return True for a place in a UTM zone without the registry, which takes half a second."""
    for codes, (south_m, north_m) in _UTM_NORTHINGS_M.items():
        if epsg in codes:
            return abs(x - _UTM_MIDDLE_M) <= _UTM_ZONE_HALF_WIDTH_M and south_m <= y <= north_m
    return False


def zone_in_area(epsg: int, x: float, y: float) -> int | None:
    """Return the only UTM zone by which a place is in the area of use of a system, an EPSG code.

    For coordinates of a UTM zone that were taken for coordinates of the system. None if no zone
    fits, or several, and without rasterio.
    """
    crs = crs_of_code(epsg) if has_registry() else None
    area = None if crs is None else area_of_use(horizontal_part(crs)[0])
    if area is None:
        return None
    longitudes = np.arange(area.west, area.west + area.width, 1.0).tolist()
    latitude = (area.south + area.north) / 2
    codes = {zone_in_meters((at + 180) % 360 - 180, latitude) for at in longitudes}
    places = {code: longitude_latitude(crs_of_code(code), x, y) for code in codes - {epsg}}
    fitting = [code for code, at in places.items() if at is not None and area.reaches(*at)]
    return fitting[0] if len(fitting) == 1 else None


def ground_scale(crs: Any, x: float, y: float) -> GroundScale | None:
    """Return the scale of a projected system at a place in its own unit.

    The lengths on the ellipsoid of steps along x and y, as PROJ's factors have them; rasterio has
    no function for these. None outside of the system, and for a system that is not projected.

    Parameters
    ----------
    crs
        A `rasterio.crs.CRS`, not compound.
    x, y
        Coordinates of the place, in the unit of the system.
    """
    if not crs.is_projected:
        return None
    base = projjson(crs).get("base_crs")
    geographic = _crs_of_json(json.dumps(base)) if base else None
    step = _GROUND_STEP_M / crs.linear_units_factor[1]
    places = np.array([x, y]) + step / 2 * np.array([[-1, 0], [1, 0], [0, -1], [0, 1]])
    degrees = _transformed_places(crs, geographic or crs_of_code(4326), places)
    if degrees is None:
        return None
    degrees = degrees * _degrees_per_unit(base or {})
    east_m, north_m = _ground_meters_of_degrees(base or {}, degrees[:, 1].mean())
    longitude = (np.diff(degrees[:, 0])[::2] + 180) % 360 - 180  # steps may cross the date line
    latitude = np.diff(degrees[:, 1])[::2]
    steps = np.stack([longitude * east_m, latitude * north_m]) / _GROUND_STEP_M
    return _ellipse(steps)


def _ellipse(steps: Floats) -> GroundScale:
    """Return the half axes of Tissot's ellipse: the singular values of steps (2, 2)."""
    squares = float((steps * steps).sum())
    east, north = steps
    difference = float((east * east).sum() - (north * north).sum())
    product = 2 * float((east * north).sum())
    spread = float(np.sqrt(difference * difference + product * product))
    shortest = float(np.sqrt(max(squares - spread, 0.0) / 2))
    longest = float(np.sqrt((squares + spread) / 2))
    return GroundScale(shortest, longest)


def _degrees_per_unit(base: dict[str, Any]) -> float:
    """Return the degrees in the unit of a geographic system: France's old grids are in grads."""
    axes = base.get("coordinate_system", {}).get("axis", ({},))
    unit = axes[0].get("unit", "degree")
    return 1.0 if isinstance(unit, str) else float(np.degrees(unit["conversion_factor"]))


def _ground_meters_of_degrees(base: dict[str, Any], latitude_deg: float) -> tuple[float, float]:
    """Return the lengths of a degree of longitude and of latitude on an ellipsoid, meters."""
    datum = base.get("datum") or base.get("datum_ensemble") or {}
    ellipsoid = datum.get("ellipsoid", {})
    axis, inverse = _WGS84_ELLIPSOID
    radius = ellipsoid.get("radius", ellipsoid.get("semi_major_axis"))
    if isinstance(radius, float | int):
        axis = float(radius)
        inverse = float(ellipsoid.get("inverse_flattening", np.inf))
    flattening = 1 / inverse
    square = flattening * (2 - flattening)  # square of the eccentricity
    sine, cosine = sin_cos(np.radians(np.array([latitude_deg])))
    level = 1 - square * float(sine[0]) ** 2
    meridian = axis * (1 - square) / (level * np.sqrt(level))
    return (
        float(np.radians(axis / np.sqrt(level)) * cosine[0]),
        float(np.radians(meridian)),
    )


def zone_in_meters(longitude: float, latitude: float) -> int:
    """Return the EPSG code of the UTM zone (WGS 84) of a place, beyond 84 degrees of a polar one.

    Universal polar stereographic has a scale of 0.994 to 0.997 there.
    """
    if abs(latitude) >= _POLAR_DEG:
        return POLAR_EPSG[0] if latitude > 0 else POLAR_EPSG[1]
    zone = int(np.floor((longitude + 180) / 6)) % 60 + 1
    return (32600 if latitude >= 0 else 32700) + zone


def suggested_epsg(crs: Any, x: float, y: float) -> int | None:
    """Return the EPSG code of a system in true meters at a place, or None if it is not on Earth.

    None also for a place far outside the system's area of use, whose coordinates are likely those
    of another system.
    """
    horizontal = horizontal_part(crs)[0]
    if missed_area(horizontal, x, y) is not None:
        return None
    place = longitude_latitude(horizontal, x, y)
    return None if place is None else zone_in_meters(*place)


def projection_kind(name: str) -> bool | None:
    """Return whether a projection is made for true lengths, by its name, or None if unknown.

    For where PROJ cannot tell the scale: False for Mercator's.
    """
    letters = re.sub("[^a-z]", "", name.lower())
    if _OF_COUNTRIES.search(letters):
        return True
    return False if "mercator" in letters else None


def middle_of(objects: Sequence[SceneMesh | SceneInstance]) -> Floats:
    """Return x and y in the middle of the middles of objects, (2,), zero without any."""
    if not objects:
        return np.zeros(2)
    middles = np.array([_middle(item)[:2] for item in objects])
    middle: Floats = (middles.min(axis=0) + middles.max(axis=0)) / 2
    return middle


def _middle(item: SceneMesh | SceneInstance) -> Floats:
    """Return the middle of an object's bounds in the world, (3,)."""
    if isinstance(item, SceneMesh):
        return np.asarray(item.bounds.mean(axis=0))
    middle = item.mesh.bounds.mean(axis=0)
    return np.asarray(rotate(middle[None], item.matrix[:3, :3])[0] + item.matrix[:3, 3])


def scale_problem(system: str, x: float, y: float, *, in_system: bool = True) -> str:
    """Return why lengths are not true at a place of a system, as a clause, empty if they are.

    For systems of meshes, in meters. The clause follows the name of the system, such as «whose
    meter is 0.68 m long on the ground here».

    Parameters
    ----------
    system
        A code such as EPSG:3857, WKT, or a definition of PROJ. Of a system that is not understood,
        and without rasterio, only `WORLD_EPSG` are known.
    x, y
        Coordinates of the place, in the unit of the system.
    in_system
        Whether the mesh has coordinates of the system, so that the clause says what placement makes
        its lengths true.
    """
    if not has_registry():
        is_known = system.removeprefix("EPSG:") in map(str, WORLD_EPSG)
        return "whose meters are not true to scale" if is_known else ""
    crs = crs_of_text(system)
    horizontal = None if crs is None else horizontal_part(crs)[0]
    scale = None if crs is None else ground_scale(horizontal, x, y)
    if scale is None or scale.is_true:
        return ""
    if (area := missed_area(horizontal, x, y)) is not None:
        return f"whose area of use ({area}) does not include the coordinates"
    clause = f"whose meter is {scale} long on the ground here"
    if scale.is_even and in_system:
        factor = f"{(scale.shortest + scale.longest) / 2:.6g}"
        clause += f" (scale [{factor}, {factor}, 1] corrects the lengths)"
    return clause


def world_advice(x: float, y: float, z: float) -> str:
    """Return advice, a sentence without a period, on a file that states a map offset."""
    return (
        f"Alternatively, set world.origin to [{x:.12g}, {y:.12g}, {z:.9g}], which leaves the "
        "scene and the poses of a scenario unchanged and writes output files in this system"
    )


def target_problem(epsg: int, x: float, y: float, *, why_there: str = "") -> str:
    """Return why lengths in a chosen system are not true meters at a place of that system.

    A clause that begins with the code, such as «EPSG:3857 (WGS 84 / Pseudo-Mercator), whose …»;
    empty if lengths are true within `MAX_SCALE_ERROR`. Systems of the whole Earth (`WORLD_EPSG`)
    are refused everywhere. Without rasterio, only these systems are known. `why_there` follows the
    coordinates in the message.
    """
    if is_utm(epsg) and is_true_in_utm(np.array([x])):
        return ""  # reading the registry takes half a second
    if not has_registry():
        return f"EPSG:{epsg}, {OF_THE_WORLD}" if epsg in WORLD_EPSG else ""
    crs = crs_of_code(epsg)
    if crs is None:
        return f"EPSG:{epsg}, which is unknown to rasterio"
    name = f"EPSG:{epsg} ({projjson(crs)['name']})"
    horizontal, _ = horizontal_part(crs)
    if not horizontal.is_projected or horizontal.linear_units_factor[1] != 1:
        return f"{name}, which is not in meters"
    if epsg in WORLD_EPSG:
        return f"{name}, {OF_THE_WORLD}"
    scale = ground_scale(horizontal, x, y)
    if scale is None:
        return f"{name}, which is not defined at x {x:.9g}, y {y:.9g}"
    if scale.is_true:
        return ""
    advice = "Use a system for this location"
    if place := longitude_latitude(horizontal, x, y):
        advice = f"Use EPSG:{zone_in_meters(*place)}, which is true to scale there"
    return f"{name}, whose meter is {scale} long at x {x:.9g}, y {y:.9g}{why_there}. {advice}"


def is_utm(epsg: int) -> bool:
    """Return True for UTM zones of WGS 84, ETRS89 and NAD83."""
    return any(epsg in codes for codes in UTM_EPSG)


def is_true_in_utm(eastings: Floats) -> bool:
    """Return True if lengths at all eastings (n,) of a UTM zone, meters, are true."""
    return bool((np.abs(eastings - _UTM_MIDDLE_M) <= _UTM_HALF_WIDTH_M).all())

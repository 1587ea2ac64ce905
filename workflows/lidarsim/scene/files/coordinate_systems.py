"""Coordinate reference systems and their distortion of lengths on the ground.

All map projections distort lengths. National grids and UTM zones do so by less than 1 % within
their area of use. Web Mercator (EPSG:3857) stretches horizontal lengths by 47 % in Zurich, but not
heights. Distortions are computed with PROJ, which is part of rasterio.
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
from ...numerics.vectors import hypot, rotate
from ...schema.vocabulary import OF_THE_WORLD, WORLD_EPSG
from ..scene_instances import SceneInstance
from ..scene_mesh import SceneMesh

MAX_SCALE_ERROR = 0.01  # maximum relative error of lengths that count as true to scale
UTM_EPSG = (range(32601, 32661), range(32701, 32761), range(25828, 25839), range(26901, 26924))
_UTM_MIDDLE_M = 500_000.0  # easting of the central meridian
_UTM_HALF_WIDTH_M = 900_000.0  # at this distance from it, the length error is 0.96 %
_GROUND_STEP_M = 10.0  # step of the finite differences from which scales are computed
_BLOCK_POINTS = 100_000  # points transformed at a time, since rasterio uses Python lists
ELLIPSOID = "ellipsoid"  # vertical datum of ellipsoidal heights
# Coordinates probably include an offset if the offset is at least `_FAR_M` long, and if its
# distance from the coordinates is less than `_SAME_SHARE` of that.
_FAR_M = 50_000.0
_SAME_SHARE = 0.2
UNNAMED = ("unnamed", "unknown", "")  # names that GDAL and PROJ use for systems without a name
POLAR_EPSG = (5041, 5042)  # universal polar stereographic, north and south
_POLAR_DEG = 84.0  # from this latitude on, universal polar stereographic replaces UTM
# Systems are also used outside their area of use, but not this far outside, in degrees. For
# example, UTM zone 33 is used in all of Norway, which is 30 degrees wide, and zone 32 in all of
# Bavaria.
_AREA_MARGIN_DEG = 5.0
_ELSEWHERE_DEG = 20.0  # coordinates this far outside probably belong to another system
_AREA_LETTERS = 90  # maximum length of the name of an area in messages
# Range of northings in meters for each family of UTM codes, for recognizing locations without
# loading the registry.
_UTM_NORTHINGS_M = {
    range(32601, 32661): (0.0, 9.4e6),
    range(32701, 32761): (1.1e6, 10e6),
    range(25828, 25839): (4e6, 9.4e6),
    range(26901, 26924): (1.6e6, 9.4e6),
}
_UTM_ZONE_HALF_WIDTH_M = 400_000.0  # a zone at the equator has a half width of 333 km
_WGS84_ELLIPSOID = (6378137.0, 298.257223563)  # semi-major axis in meters, inverse flattening

# Patterns in the names of projections that are used by national grids
_OF_COUNTRIES = re.compile(
    "transversemercator|gausskruger|conformalconic|conicconformal|obliquestereographic|"
    "doublestereographic|hotine|obliquemercator|swissoblique|rectifiedskew|krovak|cassini|"
    "newzealandmapgrid|laborde"
)


@dataclass(frozen=True)
class GroundScale:
    """Range of ground lengths that correspond to one meter in a projected coordinate system.

    The ground length depends on the direction.
    """

    shortest: float  # meters
    longest: float  # meters

    @property
    def error(self) -> float:
        """Maximum relative length error in any direction."""
        return max(abs(self.shortest - 1), abs(self.longest - 1))

    @property
    def is_true(self) -> bool:
        """Whether lengths in all directions are correct within `MAX_SCALE_ERROR`."""
        return self.error <= MAX_SCALE_ERROR

    @property
    def is_even(self) -> bool:
        """Whether lengths in all directions have the same scale within `MAX_SCALE_ERROR`."""
        return self.longest - self.shortest <= MAX_SCALE_ERROR * self.longest

    def __str__(self) -> str:
        if self.is_even:
            return f"{(self.shortest + self.longest) / 2:.3g} m"
        return f"{self.shortest:.3g} to {self.longest:.3g} m"


@dataclass(frozen=True)
class AreaOfUse:
    """The area of use of a coordinate system.

    Attributes
    ----------
    name
        Description of the area in the EPSG registry.
    west, south, east, north
        Bounds in degrees. `west` is greater than `east` if the area crosses the antimeridian.
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

    def contains(self, longitude: float, latitude: float, margin_deg: float = 0.0) -> bool:
        """Return whether a location is inside the area or within `margin_deg` of it.

        The margin is an angular distance in degrees.
        """
        if not self.south - margin_deg <= latitude <= self.north + margin_deg:
            return False
        cosine = float(sin_cos(np.radians(np.array([latitude])))[1][0])
        margin = margin_deg / max(cosine, 1e-6)
        if self.width + 2 * margin >= 360:
            return True
        return (longitude - self.west + margin) % 360 <= self.width + 2 * margin


def has_registry() -> bool:
    """Return whether rasterio is installed.

    rasterio includes PROJ and the EPSG registry.
    """
    return find_spec("rasterio") is not None


def require_registry(purpose: str) -> None:
    """Raise an error if rasterio is not installed.

    `purpose` is the subject of the error message.

    Raises
    ------
    LidarError
        If rasterio is not installed.
    """
    if not has_registry():
        raise LidarError(
            f"{purpose} requires rasterio, which is not installed. Run "
            f"{install_command('lidarpool[geo]')}."
        )


def crs_from_text(text: str) -> Any:
    """Return the `rasterio.crs.CRS` for WKT, a code such as EPSG:3857, or a PROJ string.

    The result is None if PROJ does not understand the text.
    """
    from rasterio.crs import CRS
    from rasterio.errors import CRSError

    try:
        return CRS.from_user_input(text)
    except CRSError:
        return None


@lru_cache(maxsize=32)
def _crs_from_json(text: str) -> Any:
    """Return the `rasterio.crs.CRS` for PROJJSON, cached because parsing takes 20 ms."""
    return crs_from_text(text)


def crs_from_code(epsg: int) -> Any:
    """Return the `rasterio.crs.CRS` for an EPSG code, or None if the code is unknown."""
    return crs_from_text(f"EPSG:{epsg}")


def projjson(crs: Any) -> dict[str, Any]:
    """Return the PROJJSON of a coordinate system.

    For a bound system, this is the PROJJSON of its source system.
    """
    return _unbound(crs.to_dict(projjson=True))


def _unbound(described: dict[str, Any]) -> dict[str, Any]:
    """Return a bound coordinate system's source system, or any other system unchanged."""
    source: dict[str, Any] = described.get("source_crs", described)
    return source


def horizontal_part(crs: Any) -> tuple[Any, float | None]:
    """Return the horizontal part of a coordinate system and its height unit in meters.

    The height unit is None if the system has no heights.
    """
    described = projjson(crs)
    parts = [_unbound(part) for part in described.get("components", [described])]
    axes = [axis for part in parts for axis in part["coordinate_system"]["axis"]]
    units = [axis["unit"] for axis in axes if axis["direction"] == "up"]
    horizontal = _crs_from_json(json.dumps(parts[0])) if len(parts) > 1 else crs
    if not units:
        return horizontal, None
    return horizontal, 1.0 if units[0] == "metre" else float(units[0]["conversion_factor"])


def vertical_datum(crs: Any) -> str:
    """Return the name of the vertical datum of a coordinate system.

    The result is `ELLIPSOID` for heights above the ellipsoid, and an empty string if the system
    states no datum. Systems with different units can have the same datum.
    """
    described = projjson(crs)
    parts = [_unbound(part) for part in described.get("components", [described])]
    for part in parts:
        if part["type"] == "VerticalCRS":
            name = str((part.get("datum") or part.get("datum_ensemble") or {}).get("name", ""))
            return "" if name.lower() in UNNAMED else name[:80]
    directions = [axis["direction"] for axis in parts[0]["coordinate_system"]["axis"]]
    has_heights = parts[0]["type"] != "EngineeringCRS" and "up" in directions
    return ELLIPSOID if has_heights or is_geocentric(crs) else ""


def describe_heights(datum: str) -> str:
    """Return words for heights in a vertical datum, as returned by `vertical_datum`."""
    return "ellipsoidal heights" if datum == ELLIPSOID else f"heights in the datum {datum}"


def same_vertical_datum(a: str, b: str) -> bool:
    """Return whether two names denote the same vertical datum."""
    first, second = (re.sub("[^a-z0-9]", "", name.lower()) for name in (a, b))
    return first == second


def is_local(crs: Any) -> bool:
    """Return whether a system has length units but no georeference, such as a site grid.

    Such systems have the type LOCAL_CS in WKT 1 and ENGCRS in WKT 2. `crs` must not be compound.
    """
    return bool(projjson(crs)["type"] == "EngineeringCRS" and linear_unit(crs) is not None)


def linear_unit(crs: Any) -> tuple[str, float] | None:
    """Return the name and the length in meters of the horizontal unit.

    The result is None if the unit is an angle. `crs` must not be compound. PROJJSON is used because
    GDAL reports the unit only for projected systems.
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
    """Return whether a system is Cartesian with its origin at the center of the Earth."""
    described = projjson(crs)
    axes = described.get("coordinate_system", {})
    return described["type"] == "GeodeticCRS" and axes.get("subtype") == "Cartesian"


def crs_key(crs: Any) -> tuple[str, int | None]:
    """Return a string that identifies a coordinate system, and its EPSG code.

    The code is None if it is uncertain.
    """
    if crs is None:
        return "", None
    code = crs.to_epsg(confidence_threshold=90)  # 70 would guess an unknown datum
    return f"EPSG:{code}" if code else crs.to_wkt(), code


def crs_name(crs: Any) -> str:
    """Return the code and name of a coordinate system, as shown in messages."""
    _, code = crs_key(crs)
    name = str(projjson(crs)["name"])[:80]
    if not code:
        return name
    return f"EPSG:{code}" if name in UNNAMED else f"EPSG:{code} ({name})"


def describe_system(epsg: int) -> str:
    """Format an EPSG code, with the name of the coordinate system if rasterio knows it."""
    crs = crs_from_code(epsg) if has_registry() else None
    return f"EPSG:{epsg}" if crs is None else crs_name(crs)


def transform_coordinates(source: Any, target: Any, points: Floats) -> Floats:
    """Transform points to another coordinate system.

    The shape of the points is (n, 2) or (n, 3). Points with coordinates that are not finite become
    infinite. If a point is outside the domain of a system, any exception can be raised.
    """
    from rasterio.warp import transform

    moved = np.empty((len(points), points.shape[1]))
    for start in range(0, len(points), _BLOCK_POINTS):
        block = slice(start, start + _BLOCK_POINTS)
        moved[block] = np.transpose(transform(source, target, *points[block].T))
    return moved


def longitude_latitude(crs: Any, x: float, y: float) -> tuple[float, float] | None:
    """Return the WGS 84 longitude and latitude of a location, in degrees.

    The result is None if the location is outside the domain of the system.
    """
    places = _transform_locations(crs, crs_from_code(4326), np.array([[x, y]]))
    return None if places is None else (float(places[0, 0]), float(places[0, 1]))


def _transform_locations(source: Any, target: Any, places: Floats) -> Floats | None:
    """Transform locations, or return None if any of them cannot be transformed."""
    try:
        moved = transform_coordinates(source, target, places)
    except Exception:  # rasterio does not export the classes of GDAL errors
        return None
    return moved if np.isfinite(moved).all() else None


def area_of_use(crs: Any) -> AreaOfUse | None:
    """Return the area of use of a coordinate system, or None if it is not registered.

    `crs` must not be compound.
    """
    code = crs.to_epsg(confidence_threshold=90)
    described = projjson(crs_from_code(code) if code else crs)
    stated = [part for part in (described, *described.get("usages", ())) if part.get("bbox")]
    if not stated:
        return None
    usage = min(stated, key=lambda part: len(part.get("area", "")))
    sides = ("west_longitude", "south_latitude", "east_longitude", "north_latitude")
    return AreaOfUse(str(usage.get("area", "")), *(float(usage["bbox"][side]) for side in sides))


def missed_area(
    crs: Any, x: float, y: float, margin_deg: float = _ELSEWHERE_DEG
) -> AreaOfUse | None:
    """Return a coordinate system's area of use if a location is outside the area.

    Locations within `margin_deg` of the area are not considered outside. The result is None if the
    location is not outside, or if the area is unknown.

    Parameters
    ----------
    crs
        A `rasterio.crs.CRS`, which must not be compound.
    x, y
        Coordinates of the location in the unit of the system.
    margin_deg
        Angular distance in degrees.
    """
    area = area_of_use(crs)
    if area is None:
        return None
    place = longitude_latitude(crs, x, y)
    is_near = place is not None and area.contains(*place, margin_deg)
    return None if is_near else area


def outside_system(epsg: int, x: float, y: float) -> str:
    """Describe the area of use of a system if a location is far outside it.

    Far means more than 5 degrees. The result is a phrase such as "the area of use of EPSG:2056
    (CH1903+ / LV95), which is Liechtenstein; Switzerland". It is an empty string if the location is
    not far outside, if the code is unknown, if the system is not projected, or if rasterio is not
    installed.
    """
    if _is_in_zone(epsg, x, y) or not has_registry():
        return ""
    crs = crs_from_code(epsg)
    horizontal = None if crs is None else horizontal_part(crs)[0]
    if horizontal is None or not horizontal.is_projected:
        return ""
    area = missed_area(horizontal, x, y, _AREA_MARGIN_DEG)
    if area is None:
        return ""
    named = f", which is {area}" if area.name else ""
    return f"the area of use of {crs_name(crs)}{named}"


def _is_in_zone(epsg: int, x: float, y: float) -> bool:
    """Return whether a location is in a UTM zone, without loading the registry.

    Loading the registry takes half a second.
    """
    for codes, (south_m, north_m) in _UTM_NORTHINGS_M.items():
        if epsg in codes:
            return abs(x - _UTM_MIDDLE_M) <= _UTM_ZONE_HALF_WIDTH_M and south_m <= y <= north_m
    return False


def zone_in_area(epsg: int, x: float, y: float) -> int | None:
    """Find a UTM zone whose coordinates may have been mistaken for those of another system.

    Returns the EPSG code of the zone in which the location would be within the area of use of the
    system. The result is None if no zone or several zones fit, or if rasterio is not installed.
    """
    crs = crs_from_code(epsg) if has_registry() else None
    area = None if crs is None else area_of_use(horizontal_part(crs)[0])
    if area is None:
        return None
    longitudes = np.arange(area.west, area.west + area.width, 1.0).tolist()
    latitude = (area.south + area.north) / 2
    codes = {utm_code((at + 180) % 360 - 180, latitude) for at in longitudes}
    places = {code: longitude_latitude(crs_from_code(code), x, y) for code in codes - {epsg}}
    fitting = [code for code, at in places.items() if at is not None and area.contains(*at)]
    return fitting[0] if len(fitting) == 1 else None


def ground_scale(crs: Any, x: float, y: float) -> GroundScale | None:
    """Return the ground scale of a projected coordinate system at a location.

    The scale is computed from the ellipsoidal lengths of steps along x and y. This is equivalent to
    the scale factors of PROJ, which rasterio does not expose. The result is None if the location is
    outside the domain of the system, or if the system is not projected.

    Parameters
    ----------
    crs
        A `rasterio.crs.CRS`, which must not be compound.
    x, y
        Coordinates of the location in the unit of the system.
    """
    if not crs.is_projected:
        return None
    base = projjson(crs).get("base_crs")
    geographic = _crs_from_json(json.dumps(base)) if base else None
    step = _GROUND_STEP_M / crs.linear_units_factor[1]
    places = np.array([x, y]) + step / 2 * np.array([[-1, 0], [1, 0], [0, -1], [0, 1]])
    degrees = _transform_locations(crs, geographic or crs_from_code(4326), places)
    if degrees is None:
        return None
    degrees = degrees * _degrees_per_unit(base or {})
    east_m, north_m = _degree_lengths_m(base or {}, degrees[:, 1].mean())
    longitude = (np.diff(degrees[:, 0])[::2] + 180) % 360 - 180  # steps can cross 180 degrees
    latitude = np.diff(degrees[:, 1])[::2]
    steps = np.stack([longitude * east_m, latitude * north_m]) / _GROUND_STEP_M
    return _tissot_axes(steps)


def _tissot_axes(steps: Floats) -> GroundScale:
    """Compute the semi-axes of Tissot's indicatrix as the singular values of the steps.

    The shape of the steps is (2, 2).
    """
    squares = float((steps * steps).sum())
    east, north = steps
    difference = float((east * east).sum() - (north * north).sum())
    product = 2 * float((east * north).sum())
    spread = float(np.sqrt(difference * difference + product * product))
    shortest = float(np.sqrt(max(squares - spread, 0.0) / 2))
    longest = float(np.sqrt((squares + spread) / 2))
    return GroundScale(shortest, longest)


def _degrees_per_unit(base: dict[str, Any]) -> float:
    """Return the angular unit of a geographic coordinate system, in degrees.

    Old French grids use gradians.
    """
    axes = base.get("coordinate_system", {}).get("axis", ({},))
    unit = axes[0].get("unit", "degree")
    return 1.0 if isinstance(unit, str) else float(np.degrees(unit["conversion_factor"]))


def _degree_lengths_m(base: dict[str, Any], latitude_deg: float) -> tuple[float, float]:
    """Return the ellipsoidal lengths of one degree of longitude and latitude in meters."""
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


def utm_code(longitude: float, latitude: float) -> int:
    """Return the EPSG code of the WGS 84 UTM zone that contains a location.

    At latitudes of 84 degrees and more, the result is the code of the universal polar stereographic
    system. Its scale is 0.994 to 0.997 there.
    """
    if abs(latitude) >= _POLAR_DEG:
        return POLAR_EPSG[0] if latitude > 0 else POLAR_EPSG[1]
    zone = int(np.floor((longitude + 180) / 6)) % 60 + 1
    return (32600 if latitude >= 0 else 32700) + zone


def suggested_epsg(crs: Any, x: float, y: float) -> int | None:
    """Suggest the EPSG code of a coordinate system that is true to scale at a location.

    The result is None if the location cannot be transformed. It is also None if the location is far
    outside the area of use of its system, because its coordinates then probably belong to another
    system.
    """
    horizontal = horizontal_part(crs)[0]
    if missed_area(horizontal, x, y) is not None:
        return None
    place = longitude_latitude(horizontal, x, y)
    return None if place is None else utm_code(*place)


def projection_kind(name: str) -> bool | None:
    """Return whether the named projection preserves lengths, or None if this is unknown.

    The name is used where PROJ cannot compute the scale. The result is False for Mercator
    projections.
    """
    letters = re.sub("[^a-z]", "", name.lower())
    if _OF_COUNTRIES.search(letters):
        return True
    return False if "mercator" in letters else None


def center_of(objects: Sequence[SceneMesh | SceneInstance]) -> Floats:
    """Return the center of the rectangle that encloses all object centers.

    The result contains x and y, which are zero if there are no objects.
    """
    if not objects:
        return np.zeros(2)
    centers = np.array([_center(item)[:2] for item in objects])
    middle: Floats = (centers.min(axis=0) + centers.max(axis=0)) / 2
    return middle


def _center(item: SceneMesh | SceneInstance) -> Floats:
    """Return the center of an object's bounding box in world coordinates."""
    if isinstance(item, SceneMesh):
        return np.asarray(item.bounds.mean(axis=0))
    middle = item.mesh.bounds.mean(axis=0)
    return np.asarray(rotate(middle[None], item.matrix[:3, :3])[0] + item.matrix[:3, 3])


def scale_problem(system: str, x: float, y: float, *, in_system: bool = True) -> str:
    """Explain why lengths in a coordinate system are not true to scale at a location.

    The result is a clause that follows the name of the system, such as "whose meter is 0.68 m long
    on the ground here". It is an empty string if lengths are true to scale. The system must have
    meters as its unit.

    Parameters
    ----------
    system
        An EPSG code such as EPSG:3857, WKT, or a PROJ string. If the system is not understood, the
        result is an empty string. Without rasterio, only the systems in `WORLD_EPSG` are known.
    x, y
        Coordinates of the location in the unit of the system.
    in_system
        Whether the mesh has coordinates in this system. In this case, the clause suggests a scale
        factor that corrects the lengths.
    """
    if not has_registry():
        is_known = system.removeprefix("EPSG:") in map(str, WORLD_EPSG)
        return "whose meters are not true to scale" if is_known else ""
    crs = crs_from_text(system)
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


def includes_offset(place: Floats, offset: Floats) -> bool:
    """Return whether horizontal coordinates probably include a map offset already.

    `place` (2,) and `offset` (2,) are in meters. Local coordinates are close to zero.
    """
    distance_m = float(hypot(*offset))
    return distance_m > _FAR_M and float(hypot(*(place - offset))) < _SAME_SHARE * distance_m


def world_advice(x: float, y: float, z: float) -> str:
    """Return a suggestion to use the map offset in a file as the world origin.

    The result is a sentence without a period.
    """
    return (
        f"Alternatively, set world.origin to [{x:.12g}, {y:.12g}, {z:.9g}], which leaves the "
        "scene and the poses of a scenario unchanged and writes output files in this system"
    )


def target_problem(epsg: int, x: float, y: float, *, why_there: str = "") -> str:
    """Explain why lengths in a target coordinate system are not true to scale at a location.

    The result is a clause that starts with the system, such as "EPSG:3857 (WGS 84 /
    Pseudo-Mercator), whose …". It is an empty string if lengths are correct within
    `MAX_SCALE_ERROR`. Systems of the whole Earth (`WORLD_EPSG`) are rejected everywhere. Without
    rasterio, only these systems are known. `why_there` follows the coordinates in the message.
    """
    if is_utm(epsg) and is_true_in_utm(np.array([x])):
        return ""  # avoids loading the registry, which takes half a second
    if not has_registry():
        return f"EPSG:{epsg}, {OF_THE_WORLD}" if epsg in WORLD_EPSG else ""
    crs = crs_from_code(epsg)
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
        advice = f"Use EPSG:{utm_code(*place)}, which is true to scale there"
    return f"{name}, whose meter is {scale} long at x {x:.9g}, y {y:.9g}{why_there}. {advice}"


def is_utm(epsg: int) -> bool:
    """Return whether an EPSG code denotes a UTM zone of WGS 84, ETRS89 or NAD83."""
    return any(epsg in codes for codes in UTM_EPSG)


def is_true_in_utm(eastings: Floats) -> bool:
    """Return whether lengths at all given eastings of a UTM zone are true to scale.

    Eastings have shape (n,) and are in meters.
    """
    return bool((np.abs(eastings - _UTM_MIDDLE_M) <= _UTM_HALF_WIDTH_M).all())

"""Areas of airborne surveys, which are read from GeoJSON, WKT or bounds."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

from lidarsim.environment.extras import install_command
from lidarsim.errors import LidarError, convert_errors
from lidarsim.io.input_files import read_input_text

GEOGRAPHIC = 4326  # EPSG code of longitudes and latitudes
_GEOJSON = (".geojson", ".json")
_WKT = (".wkt", ".txt")
_MAX_WIDTH_DEG = 180.0  # a wider area crosses the antimeridian
_MIN_EXTENT_M = 1.0  # a smaller area is in degrees
_CRS_CODE = re.compile(r"(?:EPSG:{1,2}|EPSG/0/)(\d+)$", re.IGNORECASE)
_CRS84 = re.compile(r"CRS84$", re.IGNORECASE)


class Area(NamedTuple):
    """Area of a survey, as Shapely polygons."""

    shape: Any  # Polygon or MultiPolygon
    epsg: int | None  # EPSG code of the coordinates, 4326 for longitudes and latitudes


def read_area(text: str) -> Area | None:
    """Read an area from a GeoJSON or WKT file, from a WKT string, or from bounds.

    Parameters
    ----------
    text
        Path of a file (.geojson, .json, .wkt or .txt), a polygon as WKT, or the bounds
        ``XMIN,YMIN,XMAX,YMAX``.

    Returns
    -------
    The area, or None if the text is none of these, for example the path of a mesh.

    Raises
    ------
    LidarError
        If the area is invalid or is not a polygon, or if shapely is not installed.

    Examples
    --------
    >>> read_area("0,0,100,50").shape.area
    5000.0
    """
    suffix = Path(text).suffix.lower()
    is_wkt = text.lstrip().upper().startswith(("POLYGON", "MULTIPOLYGON"))
    bounds = re.fullmatch(r"\s*(?:[-+.\deE]+\s*,\s*){3}[-+.\deE]+\s*", text)
    if not (is_wkt or bounds or suffix in (*_GEOJSON, *_WKT)):
        return None
    shapely = import_shapely()
    epsg = None
    with convert_errors(f"The area {_shorten(text)} cannot be read"):
        if bounds:
            x0, y0, x1, y1 = map(float, text.split(","))
            if not (x0 < x1 and y0 < y1):
                raise ValueError("bounds must be XMIN,YMIN,XMAX,YMAX in ascending order")
            shape = shapely.box(x0, y0, x1, y1)
        elif is_wkt:
            shape = _shape_from_wkt(text)
        elif suffix in _WKT:
            shape = _shape_from_wkt(read_input_text(Path(text)).strip())
        else:
            content = json.loads(read_input_text(Path(text)))
            epsg = _geojson_epsg(content)
            geometries = [shapely.geometry.shape(geometry) for geometry in _geometries(content)]
            shape = shapely.union_all([g for g in geometries if "Polygon" in g.geom_type])
    _check_shape(shape, text)
    _check_extent(shape, text, is_geographic=epsg == GEOGRAPHIC)
    return Area(shape, epsg)


def _shape_from_wkt(text: str) -> Any:
    """Return the shape of a WKT string. Raise ValueError if it is invalid."""
    shapely = import_shapely()
    try:
        return shapely.from_wkt(text)
    except shapely.errors.GEOSException as error:
        if "closed linestring" in str(error):
            raise ValueError("the ring is not closed. Repeat the first point at its end") from None
        raise ValueError(
            "it is not a valid polygon in WKT. Expected, for example, `POLYGON ((0 0, 400 0, "
            "400 200, 0 0))`, with two pairs of parentheses"
        ) from None


def _check_shape(shape: Any, text: str) -> None:
    """Raise LidarError unless a geometry is a valid polygon with a positive area."""
    if not shape.is_valid:
        reason = import_module("shapely").is_valid_reason(shape)
        raise LidarError(f"The area {_shorten(text)} is not a valid polygon: {reason}.")
    if shape.geom_type not in ("Polygon", "MultiPolygon") or not shape.area > 0:
        raise LidarError(
            f"The area {_shorten(text)} must be a polygon, but its type is {shape.geom_type} and "
            f"its area is {shape.area:g}. Draw the outline of the survey as a polygon."
        )


def _check_extent(shape: Any, text: str, *, is_geographic: bool) -> None:
    """Raise LidarError if an area is probably in degrees, or crosses the antimeridian."""
    x0, y0, x1, y1 = shape.bounds
    if is_geographic and x1 - x0 > _MAX_WIDTH_DEG:
        raise LidarError(
            f"The area {_shorten(text)} extends from {x0:g}° to {x1:g}° of longitude. If it "
            "crosses the antimeridian, plan the parts on both sides separately."
        )
    if not is_geographic and max(x1 - x0, y1 - y0) < _MIN_EXTENT_M:
        raise LidarError(
            f"The area {_shorten(text)} has an extent of {x1 - x0:.3g} x {y1 - y0:.3g} m. WKT and "
            "bounds are in meters. Use a GeoJSON file for longitudes and latitudes."
        )


def _geometries(content: Any) -> Iterator[Any]:
    """Yield the geometries of a GeoJSON object.

    Raise ValueError if the object is invalid. A feature may have no geometry.
    """
    if content is None:
        return
    if not isinstance(content, dict) or "type" not in content:
        raise ValueError("it contains no GeoJSON object, which has the member `type`")
    kind = content["type"]
    if kind == "FeatureCollection":
        for feature in content["features"]:
            yield from _geometries(feature)
    elif kind == "Feature":
        yield from _geometries(content["geometry"])
    elif kind == "GeometryCollection":
        for geometry in content["geometries"]:
            yield from _geometries(geometry)
    else:
        yield content


def _geojson_epsg(content: Any) -> int:
    """Return the EPSG code of a GeoJSON object, which is 4326 unless it has the member `crs`."""
    crs = content.get("crs") if isinstance(content, dict) else None
    if crs is None:
        return GEOGRAPHIC
    name = crs["properties"]["name"]
    if _CRS84.search(name):
        return GEOGRAPHIC
    match = _CRS_CODE.search(name)
    if match is None:
        raise ValueError(f"the coordinate system {name!r} is unknown. Use an EPSG code")
    return int(match[1])


def utm_epsg(shape: Any) -> int:
    """Return the EPSG code of the UTM zone (WGS 84) that contains the center of an area.

    The coordinates of the area are longitudes and latitudes.

    Examples
    --------
    >>> import shapely
    >>> utm_epsg(shapely.box(9.1, 48.7, 9.2, 48.8))
    32632
    """
    longitude, latitude = shape.centroid.x, shape.centroid.y
    zone = int((longitude + 180) // 6) % 60 + 1
    return (32600 if latitude >= 0 else 32700) + zone


def transform_shape(shape: Any, source: int, target: int) -> Any:
    """Transform a Shapely geometry between two coordinate systems.

    `source` and `target` are EPSG codes.

    Raises
    ------
    LidarError
        If rasterio is not installed or does not know a code.
    """
    if source == target:
        return shape
    if find_spec("rasterio") is None:
        raise LidarError(
            f"A conversion from EPSG:{source} to EPSG:{target} requires rasterio. Run "
            f"{install_command('lidarpool[geo]')}."
        )
    shapely = import_shapely()
    with convert_errors(f"A conversion from EPSG:{source} to EPSG:{target} is not possible"):
        transformed = import_module("rasterio.warp").transform_geom(
            f"EPSG:{source}", f"EPSG:{target}", shapely.geometry.mapping(shape)
        )
    return shapely.geometry.shape(transformed)


def import_shapely() -> Any:
    """Import shapely. Raise LidarError if it is not installed."""
    if find_spec("shapely") is None:
        raise LidarError(
            f"A flight plan requires shapely. Run {install_command('lidarpool[geo]')}."
        )
    import_module("shapely.geometry")
    return import_module("shapely")


def _shorten(text: str) -> str:
    return text if len(text) <= 60 else text[:57] + "..."

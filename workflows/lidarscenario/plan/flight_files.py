"""Flight plans as GeoJSON and KML, for maps and geographic information systems."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np

from lidarsim.numerics.arrays import Floats

from .flight import FlightPlan
from .flight_area import GEOGRAPHIC, transform_shape

_KML = "http://www.opengis.net/kml/2.2"
_COLORS = {"area": "ff9a6a35", "line": "ff2d18e0", "cross": "ff3377ee", "path": "ff76685d"}  # ABGR
_PATH_POINTS = 2000  # approximate limit of the points of the path in a file


class _Feature(NamedTuple):
    """A feature on a map, with a Shapely geometry."""

    name: str
    kind: str
    geometry: Any
    properties: dict[str, Any]


def _features(plan: FlightPlan, epsg: int | None, origin: Floats) -> Iterator[_Feature]:
    """Yield the area, the lines and the path of a plan.

    If `epsg` is not None, it is the EPSG code of the plan coordinates plus `origin`, and the
    features have longitudes and latitudes. Otherwise, they have the coordinates of the plan.
    """
    from shapely import LineString
    from shapely.affinity import translate

    def placed(geometry: Any) -> Any:
        if epsg is None:
            return geometry
        return transform_shape(translate(geometry, *origin.tolist()), epsg, GEOGRAPHIC)

    properties: dict[str, Any] = {"agl_m": plan.layout.agl_m, "overlap": plan.layout.overlap}
    yield _Feature("area", "area", placed(plan.area), properties)
    for line, start_s in zip(plan.lines, plan.path.starts_s.tolist(), strict=True):
        leg = line.leg
        share = np.linspace(0, 1, len(leg.heights))[:, None]
        points = np.column_stack([leg.start + share * (leg.stop - leg.start), leg.heights])
        if np.ptp(leg.heights) < 0.01:
            points = points[[0, -1]]
        low_m2, high_m2 = plan.line_density_m2(line)
        properties = {
            "start_s": round(start_s, 3),
            "length_m": round(leg.length_m, 2),
            "speed_m_s": plan.rates.speed_m_s,
            "min_clearance_m": round(line.clearance_m[0], 2),
            "max_clearance_m": round(line.clearance_m[2], 2),
            "min_swath_m": round(line.swath_m[0], 2),
            "max_swath_m": round(line.swath_m[1], 2),
            "min_density_m2": round(low_m2, 3),
            "max_density_m2": round(high_m2, 3),
        }
        yield _Feature(line.name, line.kind, placed(LineString(points)), properties)
    every = max(1, len(plan.path.positions) // _PATH_POINTS)
    path = LineString(plan.path.positions[::every])
    yield _Feature("path", "path", placed(path), {"duration_s": round(plan.duration_s, 1)})


def to_geojson(plan: FlightPlan, epsg: int | None, origin: Floats) -> str:
    """Return a plan as GeoJSON.

    Parameters
    ----------
    plan
        The flight plan.
    epsg
        EPSG code of the world coordinates, from which longitudes and latitudes are computed. If it
        is None, the file contains the coordinates of the plan.
    origin
        World coordinates of the origin of the plan, in meters. Shape (3,).
    """
    from shapely.geometry import mapping

    features = [
        {
            "type": "Feature",
            "properties": {"name": feature.name, "kind": feature.kind, **feature.properties},
            "geometry": _rounded(mapping(feature.geometry), 9 if epsg else 4),
        }
        for feature in _features(plan, epsg, origin)
    ]
    return json.dumps({"type": "FeatureCollection", "features": features}, indent=1) + "\n"


def to_kml(plan: FlightPlan, epsg: int, origin: Floats) -> str:
    """Return a plan as KML. The parameters are those of `to_geojson`."""
    ElementTree.register_namespace("", _KML)
    root = ElementTree.Element(f"{{{_KML}}}kml")
    document = _add(root, "Document")
    _add(document, "name", "Flight plan")
    for kind, color in _COLORS.items():
        style = _add(document, "Style")
        style.set("id", kind)
        line_style = _add(style, "LineStyle")
        _add(line_style, "color", color)
        _add(line_style, "width", "1" if kind == "path" else "3")
        _add(_add(style, "PolyStyle"), "fill", "0")
    for feature in _features(plan, epsg, origin):
        placemark = _add(document, "Placemark")
        _add(placemark, "name", feature.name)
        rows = (f"{name}: {value}" for name, value in feature.properties.items())
        _add(placemark, "description", "\n".join(rows))
        _add(placemark, "styleUrl", f"#{feature.kind}")
        parent = placemark
        parts = getattr(feature.geometry, "geoms", [feature.geometry])
        if len(parts) > 1:
            parent = _add(placemark, "MultiGeometry")
        for part in parts:
            _add_geometry(parent, part)
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode", xml_declaration=True) + "\n"


def _add(parent: ElementTree.Element, tag: str, text: str = "") -> ElementTree.Element:
    """Add an element to a KML document."""
    element = ElementTree.SubElement(parent, f"{{{_KML}}}{tag}")
    element.text = text or None
    return element


def _add_geometry(parent: ElementTree.Element, part: Any) -> None:
    """Add a line, with its heights above sea level, or a polygon on the ground."""
    if part.geom_type != "Polygon":
        line = _add(parent, "LineString")
        _add(line, "altitudeMode", "absolute")
        _add(line, "coordinates", _coordinates(part.coords))
        return
    polygon = _add(parent, "Polygon")
    for ring, tag in [(part.exterior, "outer"), *((hole, "inner") for hole in part.interiors)]:
        linear = _add(_add(polygon, f"{tag}BoundaryIs"), "LinearRing")
        _add(linear, "coordinates", _coordinates(ring.coords))


def _coordinates(points: Any) -> str:
    """Format points, with longitudes and latitudes in steps of 0.1 mm and heights in cm."""
    forms = "{:.9f}", "{:.9f}", "{:.2f}"
    return " ".join(
        ",".join(form.format(value) for form, value in zip(forms, point, strict=False))
        for point in points
    )


def _rounded(value: Any, digits: int) -> Any:
    """Return a GeoJSON geometry with rounded coordinates."""
    if isinstance(value, float):
        return round(value, digits)
    if isinstance(value, (list, tuple)):
        return [_rounded(part, digits) for part in value]
    if isinstance(value, dict):
        return {name: _rounded(part, digits) for name, part in value.items()}
    return value

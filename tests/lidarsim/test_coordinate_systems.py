"""The scale of map projections: by closed forms, and where a choice of a system is refused."""

import re
from importlib.util import find_spec

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lidarsim import LidarError, Survey
from lidarsim.scene.files import coordinate_systems
from lidarsim.scene.files.coordinate_systems import (
    area_of_use,
    crs_from_code,
    crs_from_text,
    ground_scale,
    outside_system,
    scale_problem,
    suggested_epsg,
    target_problem,
    transform_coordinates,
    utm_code,
    zone_in_area,
)

needs_registry = pytest.mark.skipif(find_spec("rasterio") is None, reason="rasterio is an extra")
AXIS_M = 6378137.0
ECCENTRICITY_2 = 0.0066943799901413165  # of WGS 84, squared


def place(epsg, longitude, latitude):
    return transform_coordinates(
        crs_from_code(4326), crs_from_code(epsg), np.array([[longitude, latitude]])
    )[0]


def radii_m(latitude):
    """Return the radii of curvature across and along the meridian of WGS 84."""
    level = 1 - ECCENTRICITY_2 * np.sin(np.radians(latitude)) ** 2
    return AXIS_M / np.sqrt(level), AXIS_M * (1 - ECCENTRICITY_2) / level**1.5


@needs_registry
@settings(max_examples=25, deadline=None)
@given(longitude=st.floats(-179, 179), latitude=st.floats(-80, 80))
def test_scales_of_mercator_projections_are_their_closed_forms(longitude, latitude):
    across_m, along_m = radii_m(latitude)
    cosine = np.cos(np.radians(latitude))
    true_m = {
        # A sphere of the equator's radius, with latitudes of the ellipsoid.
        3857: sorted([across_m * cosine / AXIS_M, along_m * cosine / AXIS_M]),
        3395: [across_m * cosine / AXIS_M] * 2,
    }
    for epsg, expected in true_m.items():
        scale = ground_scale(crs_from_code(epsg), *place(epsg, longitude, latitude))
        np.testing.assert_allclose((scale.shortest, scale.longest), expected, rtol=2e-5)


@needs_registry
@pytest.mark.parametrize(("latitude", "longitude"), [(0.1, 3), (47, 6), (-33, 11), (78, 12)])
def test_the_scale_of_a_utm_zone_is_its_series(latitude, longitude):
    east_m = place(32632, longitude, latitude)[0] - 500_000
    across_m, along_m = radii_m(latitude)
    scale_factor = 0.9996 * (1 + east_m**2 / (2 * 0.9996**2 * across_m * along_m))
    scale = ground_scale(crs_from_code(32632), *place(32632, longitude, latitude))
    assert scale.is_true and scale.is_even
    assert 1 / scale.shortest == pytest.approx(scale_factor, rel=1e-5)


@needs_registry
@pytest.mark.parametrize(
    ("epsg", "longitude", "latitude", "is_true"),
    [
        (25832, 9, 50, True),
        (2056, 8, 47, True),
        (27572, 2.3, 48.8, True),  # in grads from Paris
        (2263, -74, 40.7, True),  # in feet
        (3035, 10, 52, True),
        (5070, -90, 38, True),
        (5070, -80, 25, False),
        (3031, 0, -75, False),
        (3832, 170, -40, False),
        (6933, 8, 47, False),
    ],
)
def test_national_grids_are_true_where_they_are_meant_to_be(epsg, longitude, latitude, is_true):
    x, y = place(epsg, longitude, latitude)
    scale = ground_scale(crs_from_code(epsg), x, y)
    assert scale.is_true == is_true
    code = suggested_epsg(crs_from_code(epsg), x, y)
    assert code == utm_code(longitude, latitude)
    assert ground_scale(crs_from_code(code), *place(code, longitude, latitude)).is_true


@needs_registry
def test_zones_cover_the_earth_with_true_meters():
    for latitude in (-89.9, -84, -83.9, -45, 0, 60, 83.9, 84, 89.9):
        for longitude in (-180, -177.1, -0.1, 0, 5.9, 179.9):
            code = utm_code(longitude, latitude)
            assert ground_scale(crs_from_code(code), *place(code, longitude, latitude)).is_true


@needs_registry
def test_scales_are_those_of_the_system_s_own_body():
    moon = crs_from_text("+proj=merc +R=1737400 +units=m")
    scale = ground_scale(moon, 0, 2_288_082.65)  # 60 degrees north
    assert scale.shortest == pytest.approx(0.5, rel=1e-5)
    assert scale.longest == pytest.approx(0.5, rel=1e-5)


@needs_registry
@pytest.mark.parametrize(
    ("epsg", "x", "y", "message"),
    [
        (32632, 0, 0, ""),
        (25832, 5e5, 5e6, ""),
        (25832, 5e6, 0, r"whose meter is 0\.793 m long at x 5000000, y 0.*EPSG:32638"),
        (2056, 2.6e6, 1.2e6, ""),
        (7415, 84600, 447000, ""),
        (3857, 0, 0, r"EPSG:3857 \(WGS 84 / Pseudo-Mercator\), a world map projection"),
        (3395, 1e6, 6e6, "a world map projection"),
        (3994, 0, 0, r"\(WGS 84 / Mercator 41\), whose meter is"),
        (2263, 0, 0, "which is not in meters"),
        (4326, 8, 47, "which is not in meters"),
        (1024, 0, 0, "which is unknown to rasterio"),
    ],
)
def test_chosen_systems_have_true_meters(epsg, x, y, message):
    problem = target_problem(epsg, x, y)
    assert re.search(message, problem) if message else problem == ""


def test_without_the_registry_systems_of_the_world_are_known(monkeypatch):
    monkeypatch.setattr(coordinate_systems, "find_spec", lambda name: None)
    assert "a world map projection" in target_problem(3857, 0, 0)
    assert target_problem(25832, 5e6, 0) == target_problem(2056, 0, 0) == ""
    assert scale_problem("EPSG:3395", 0, 0) and not scale_problem("EPSG:25832", 0, 0)
    with pytest.raises(LidarError, match="epsg is 3857, a world map projection"):
        Survey(poses=[(0, 0, 1)], epsg=3857)


@needs_registry
def test_meshes_in_a_stretched_system_are_told_the_factor():
    assert scale_problem("EPSG:25832", 5e5, 5e6) == scale_problem("no system", 0, 0) == ""
    problem = scale_problem("+proj=merc +datum=WGS84", 1e6, 6e6)
    assert problem.startswith("whose meter is 0.676 m") and "(scale [0.676" in problem


@needs_registry
@pytest.mark.parametrize(
    ("epsg", "x", "y", "area"),
    [
        (25832, 5e5, 5.4e6, ""),
        (25832, 8.5e5, 5.4e6, ""),  # Bavaria reaches beyond the zone
        (25833, 1.05e6, 7.9e6, ""),  # all of Norway is in zone 33
        (25832, 1e6, 10.8e6, "EPSG:25832 (ETRS89 / UTM zone 32N), which is Europe between 6°E and"),
        (25832, 0, 0, "EPSG:25832"),  # local coordinates
        (31467, 3.5e6, 5.4e6, ""),
        (31467, 5e5, 5.4e6, "EPSG:31467 (DHDN / 3-degree Gauss-Kruger zone 3), which is Germany"),
        (2056, 2.6e6, 1.2e6, ""),
        (2056, 6e5, 2e5, "EPSG:2056 (CH1903+ / LV95), which is Liechtenstein; Switzerland"),
        (7415, 155_000, 463_000, ""),  # compound
        (3460, 2e6, 4e6, ""),  # Fiji, on both sides of the date line
        (3460, 2e6, 8e6, "EPSG:3460"),
        (3857, 1e6, 6e6, ""),
        (1024, 0, 0, ""),  # no system
    ],
)
def test_places_far_outside_the_area_of_use_are_told(epsg, x, y, area):
    clause = outside_system(epsg, x, y)
    assert clause.startswith(f"the area of use of {area}") if area else clause == ""


@needs_registry
def test_zones_of_coordinates_that_are_taken_for_another_system():
    assert zone_in_area(31467, 5e5, 5.4e6) == 32632
    assert zone_in_area(28992, 650_000, 5.77e6) == 32631
    assert zone_in_area(27700, 5e5, 5.7e6) is None  # three zones fit
    assert zone_in_area(31467, 5e5, 0) is None
    assert suggested_epsg(crs_from_code(31467), 5e5, 5.4e6) is None  # not a zone in the Atlantic
    problem = scale_problem("EPSG:31467", 5e5, 5.4e6)
    assert problem.startswith("whose area of use (Germany") and "scale" not in problem


@needs_registry
@pytest.mark.parametrize("epsg", [3035, 6933, 3577])
@pytest.mark.parametrize("turns", [(0.1, 0.9), (0.5, 0.2), (0.8, 0.8)])
def test_equal_area_projections_keep_areas_where_they_distort_shapes(epsg, turns):
    area = area_of_use(crs_from_code(epsg))
    longitude = area.west + turns[0] * area.width
    latitude = area.south + turns[1] * (area.north - area.south)
    scale = ground_scale(crs_from_code(epsg), *place(epsg, longitude, latitude)[:2])
    assert scale.longest > 1.002 > 0.998 > scale.shortest
    assert scale.shortest * scale.longest == pytest.approx(1, abs=1e-5)


@needs_registry
def test_areas_may_cross_the_date_line():
    area = area_of_use(crs_from_code(3460))  # Fiji
    assert area.west > 170 and area.east < -170
    assert area.width == pytest.approx(area.east + 360 - area.west)
    middle = (area.south + area.north) / 2
    for longitude, inside in [
        (area.west - 0.1, False),
        (area.west + 0.1, True),
        (180.0, True),
        (-180.0, True),
        (area.east - 0.1, True),
        (area.east + 0.1, False),
        (0.0, False),
    ]:
        assert area.contains(longitude, middle) is inside, longitude
        assert area.contains(longitude, middle, 0.2) is (inside or longitude != 0.0)
    assert not area.contains(180.0, area.north + 0.1)
    # A degree of arc is two degrees of longitude at a latitude of 60.
    north = area_of_use(crs_from_code(25833))
    assert north.contains(north.west - 1.9, 60.0, 1.0)
    assert not north.contains(north.west - 2.1, 60.0, 1.0)

"""Ghosts off panes, paint and wet roads: where they lie, and how much light they have."""

import math
from dataclasses import replace

import numpy as np
import pytest
from tests.shapes import CPU, beam_along_x, cast, level, made, quad, wall

from lidarsim import Beams, LidarError, Material, Noise, Returns, Scene, Sensor, Spin, Survey
from lidarsim.columns.table import CAUSES
from lidarsim.media.materials import WATER_INDEX, fresnel, wet_surface_factor
from lidarsim.scene.colors import Colors

COLUMNS = ("range", "reflectance", "class", "cause", "return_number")
GHOST = CAUSES.index("ghost")
ALL = {"returns": Returns("all"), "columns": COLUMNS}
WATER = {"transparent": "pass", "refractive_index": 1.33}
# It turns a beam along x up, to a ceiling 3 m above.
SLANTED = quad("Slanted", (2, -9, -2), (2, 9, -2), (6, 9, 2), (6, -9, 2))
CEILING = level("Ceiling", 3, 9)


def turned(name, angle, middle=4.0):
    """A square wall that a beam along x meets at an angle, turned about z."""
    x = 2 * math.sin(angle)
    y = 2 * math.cos(angle)
    a = (middle + x, y)
    b = (middle - x, -y)
    return quad(name, (*a, -2), (*b, -2), (*b, 2), (*a, 2))


def across(name, angle, by=7.0, middle=4.0):
    """A wall that the light off such a square meets at right angles."""
    ahead = np.array([-math.cos(2 * angle), math.sin(2 * angle), 0])
    aside = np.array([-ahead[1], ahead[0], 0])
    up = np.array([0, 0, 1.0])
    place = np.array([middle, 0, 0]) + by * ahead
    return quad(
        name, *(place + 0.3 * (a * aside + b * up) for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1)))
    )


def fan(low, high, channels=2, firings=1):
    """Beams between two elevations, degrees."""
    beams = Beams(np.radians(np.linspace(low, high, channels)))
    return Sensor(beams, Spin(firings, 360), 0, math.inf)


def schlick(first, angle):
    return first + (1 - first) * (1 - math.cos(angle)) ** 5


@pytest.mark.parametrize("backend", CPU)
@pytest.mark.parametrize("subrays", [1, 19])
def test_paint_returns_itself_and_what_it_mirrors(backend, subrays):
    materials = [
        Material("Slanted", 0.3, specular_reflectance=0.2, semantic_class=1),
        Material("Ceiling", 0.8, semantic_class=7),
    ]
    beam = Returns("all", subrays, 1.0)
    options = {"columns": COLUMNS, "materials": materials, "backend": backend, "returns": beam}
    found = cast([SLANTED, CEILING], **options)
    assert found["object"].tolist() == [0, 1] and found["class"].tolist() == [1, 7]
    assert found["cause"].tolist() == [0, GHOST]
    assert found["range"] == pytest.approx([4, 7], abs=1e-4)
    assert np.allclose(found["batch"].positions, [[4, 0, 0], [7, 0, 0]], atol=1e-4), "straight on"
    mirrored = 0.7 * schlick(0.2, math.pi / 4)
    steep = math.sqrt(0.5)
    assert found["reflectance"] == pytest.approx([0.3 * steep, 0.8 * mirrored**2], rel=1e-3)
    alone = cast([SLANTED, CEILING], **{**options, "returns": Returns("strongest", subrays, 1.0)})
    assert alone["cause"].tolist() == [0], "the paint is brighter"


@pytest.mark.slow(every=5)
@pytest.mark.parametrize("degrees", [0, 30, 45, 60, 80, 87])
@pytest.mark.parametrize("dirt", [0.0, 0.2])
def test_no_light_is_lost_or_made_at_glass(degrees, dirt):
    """White walls behind it and beside it return the squares of what passes and is mirrored."""
    angle = math.radians(degrees)
    glass = Material("Pane", dirt, transparent="pass", specular_reflectance="fresnel")
    meshes = [turned("Pane", angle), across("Beside", angle), wall("Behind", 20)]
    found = cast(meshes, materials=[glass, Material("*", 1.0)], **ALL)
    light = dict(zip(found["object"].tolist(), found["reflectance"].tolist(), strict=True))
    shares = dirt, math.sqrt(light[1]), math.sqrt(light[2])
    assert sum(shares) == pytest.approx(1, abs=1e-6)
    assert shares[1] == pytest.approx((1 - dirt) * fresnel(np.array([math.cos(angle)]))[0])
    assert light.get(0, 0.0) == pytest.approx(dirt * math.cos(angle))
    causes = dict(zip(found["object"].tolist(), found["cause"].tolist(), strict=True))
    assert causes[1] == GHOST and causes[2] == 0


def test_water_is_passed_and_mirrors():
    """A closed surface that refracts; from within, beyond the critical angle, it mirrors all."""
    angle = math.radians(45)
    pool = [turned("Pool", angle), across("Beside", angle), wall("Behind", 40)]
    for more, count in (({}, 1), ({"specular_reflectance": "fresnel"}, 2)):
        found = cast(pool, materials=[Material("Pool", **WATER, **more), Material("*", 1.0)], **ALL)
        assert len(found["range"]) == count
    share = fresnel(np.array([math.cos(angle)]), 1.33)[0]
    assert found["reflectance"][0] == pytest.approx(share**2, rel=1e-6)
    floor = [level("Pool", 1.0), level("Floor", -2.0)]
    water = Material("Pool", **WATER, specular_reflectance="fresnel")
    found = cast(floor, fan(30, 31), materials=[water, Material("*", 1.0)], at=(0, 0, 0), **ALL)
    assert found["object"].tolist() == [1, 1] and (found["cause"] == GHOST).all()
    assert found["range"] == pytest.approx(4 * 1.33 / np.sin(np.radians([30, 31])), rel=1e-5)


def test_light_is_mirrored_twice_and_not_three_times():
    materials = [Material("*", 0.5, specular_reflectance=0.5)]
    found = cast([wall("A", 4), wall("B", -6)], materials=materials, **ALL)
    assert found["range"].tolist() == [4, 14, 24], "A, B in A, and A in B in A"
    assert found["object"].tolist() == [0, 1, 0]
    assert found["cause"].tolist() == [0, GHOST, GHOST]
    assert found["reflectance"] == pytest.approx([0.5, 0.5 / 4**2, 0.5 / 4**4])


def test_ghosts_of_textures_take_what_the_colors_leave():
    """A black wall absorbs what it does not mirror, and a white one has nothing to mirror."""
    for bright, share in ((0, 1 - 1e-3), (255, 0.0)):
        colors = Colors.from_face_colors(np.full((2, 3), bright, np.uint8))
        slanted = replace(SLANTED, colors=colors)
        paint = Material("Slanted", "texture", specular_reflectance=0.2)
        found = cast([slanted, CEILING], materials=[paint, Material("*", 1.0)], **ALL)
        ghosts = found["reflectance"][found["cause"] == GHOST]
        expected = [(share * schlick(0.2, math.pi / 4)) ** 2] if share else []
        assert ghosts == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"specular_reflectance": 1.5}, "0 to 1, 'fresnel' or None"),
        (
            {"specular_reflectance": "fresnel"},
            ("must be fresnel with transparent: pass, and a number otherwise"),
        ),
        ({"specular_reflectance": 0.1, "transparent": "pass"}, "must be fresnel with"),
        (
            {"specular_reflectance": 0.1, "roughness": 0.5},
            ("cannot be combined with retro or specular_reflectance"),
        ),
        (
            {"specular_reflectance": 0.1, "leaf_area_density": 1.0},
            ("cannot be combined with transparent"),
        ),
        ({"transparent": "mirror"}, "transparent"),
    ],
)
def test_bad_mirrors(values, message):
    with pytest.raises(LidarError, match=message):
        Material("*", **values)


# -- wet ground ------------------------------------------------------------------------------------


@pytest.mark.slow(every=5)
@pytest.mark.parametrize("degrees", [0, 40, 70, 85])
@pytest.mark.parametrize("dry", [0.05, 0.3, 0.9])
def test_light_on_wet_ground_is_mirrored_returned_or_absorbed(degrees, dry):
    """Over a half space; of what is between ground and film, by its albedo (Lekner and Dorf)."""
    steps = (np.arange(20_000) + 0.5) / 20_000 * math.pi / 2
    there = wet_surface_factor(np.cos(np.radians([degrees])), np.full(1, dry))
    back = wet_surface_factor(np.cos(steps), np.full(len(steps), dry))
    out = np.sqrt(there * back) * dry * 2 * np.sin(steps) * np.cos(steps)
    mirrored = fresnel(np.cos(np.radians([degrees])), WATER_INDEX)[0]
    inwards = 1 - 0.9344 / WATER_INDEX**2  # a mean reflection of 6.56 % outside
    absorbed = (1 - mirrored) * (1 - dry) / (1 - inwards * dry)
    assert mirrored + out.sum() * math.pi / 40_000 + absorbed == pytest.approx(1, abs=2e-4)
    assert back[-1] < 1e-5, "nothing returns at grazing angles"


def road(wet, down_deg, backend="numpy", **options):
    """A road below the sensor and a wall behind it, which it mirrors."""
    sensor = fan(-down_deg, -down_deg + 1e-3)
    meshes = [level("Road", -2.0, 90), wall("Wall", 40, z=(-2, 50))]
    options = {"materials": [Material("*", 0.2)], **ALL, **options}
    return cast(meshes, sensor, wet=wet, backend=backend, **options)


@pytest.mark.slow(every=13)
@pytest.mark.parametrize("backend", CPU)
@pytest.mark.parametrize("wet", [0.5, 1.0])
@pytest.mark.parametrize("down_deg", [5, 20, 50])
def test_a_wet_road_is_darker_and_mirrors(backend, wet, down_deg):
    found = road(wet, down_deg, backend)
    dry = road(0.0, down_deg, backend)
    assert (dry["object"] == 0).all() and (dry["cause"] == 0).all()
    steep = np.array([math.sin(math.radians(down_deg))])
    darker = 1 - wet + wet * wet_surface_factor(steep, np.full(1, 0.2))[0]
    own = found["cause"] == 0
    assert found["reflectance"][own] == pytest.approx(darker * dry["reflectance"], rel=1e-3)
    ghosts = np.flatnonzero(~own)
    assert len(ghosts) == 2 and (found["object"][ghosts] == 1).all()
    aside = math.cos(math.radians(down_deg))
    assert found["range"][ghosts] == pytest.approx([40 / aside] * 2, rel=1e-3)
    assert (found["batch"].positions[ghosts, 2] < -2).all(), "below the road"
    share = (wet * fresnel(steep, WATER_INDEX)[0]) ** 2
    assert found["reflectance"][ghosts] == pytest.approx(0.2 * aside * share, rel=1e-3)


def test_wet_roads_vanish_at_grazing_angles_before_dry_ones():
    noise = Noise(detection_range_m=60)
    counts = []
    sensor = fan(-10, -1, 400)
    for wet in (0.0, 1.0):
        one = Survey(sensor, poses=[(0, 0, 2)], steps=1, wet=wet, noise=noise, columns=COLUMNS)
        counts.append(made(one, Scene.from_meshes([level("Road", 0, 400)]))["range"].max())
    assert counts[1] < 0.8 * counts[0]


@pytest.mark.parametrize(
    ("mesh", "ratio"),
    [
        (quad("Roof", (3, -9, -2), (3, 9, -2), (9, 9, 1), (9, -9, 1)), True),  # 26.6 degrees
        (quad("Steep", (3, -9, -2), (3, 9, -2), (7, 9, 1), (7, -9, 1)), False),
        (quad("Below", (3, -9, 2), (3, 9, 2), (9, 9, -1), (9, -9, -1)), False),
        (quad("Over", (3, 9, -2), (3, -9, -2), (9, -9, 1), (9, 9, 1)), True),  # its back looks up
    ],
)
def test_a_film_stays_on_what_faces_up(mesh, ratio):
    dry, wet = (cast([mesh], beam_along_x(), wet=wet, **ALL)["reflectance"][0] for wet in (0, 1))
    steep = np.array([3 / math.hypot(3, 6)])
    share = wet_surface_factor(steep, np.full(1, 0.5))[0] if ratio else 1
    assert wet / dry == pytest.approx(share)


@pytest.mark.extended
@pytest.mark.parametrize(
    "options",
    [
        {"wet": 1.0},
        {"materials": [Material("Road", specular_reflectance=1), Material("*", 0.2)]},
    ],
)
def test_drops_are_before_surfaces_and_not_in_mirrors(options):
    noise = Noise(detection_range_m=100, overlap_m=2.0)
    options = {"noise": noise, "rain_mm_h": 50, **options}
    beam = Returns("all", divergence_mrad=3.0)
    sensor = fan(-30, -10, 8, 2000)
    one = Survey(sensor, poses=[(0, 0, 0)], steps=1, returns=beam, columns=("cause",), **options)
    found = made(one, Scene.from_meshes([level("Road", -1.0, 90), level("Sky", 30.0, 90)]))
    drops = found["cause"] == CAUSES.index("air")
    assert drops.sum() > 20 and (found["z"][drops] >= -1 / one.precision_m).all()
    if "wet" not in options:  # which mirrors too little here
        assert (found["cause"] == GHOST).sum() > 100

"""Light through water and glass: ranges by Snell's law, energies by Fresnel, Beer and geometry."""

from __future__ import annotations

import math

import numpy as np
import pytest
import trimesh
from tests.shapes import CPU, box, cast, level, solid

from lidarpool import Beams, LidarError, Material, Optics, Pose, Returns, Scene, Sensor, Spin
from lidarsim.media.materials import extinction, fresnel

WATER = {"transparent": "pass", "refractive_index": 1.33}
SURFACE = level("Water", 0, 90)


def ray(nadir_deg=90.0, **options):
    """A sensor that fires one ray in the xz plane."""
    return Sensor(Beams(np.radians([nadir_deg - 90])), Spin(1, 360), optics=Optics(), **options)


# -- a pool --------------------------------------------------------------------------------------

HEIGHT = 4.0
DEPTH = 2.0
INDEX = 1.33
LOSS = 0.1


def pool(nadir_deg):
    """Angle, path in air, angle and path in water, by Snell's law."""
    angle = math.radians(nadir_deg)
    below = math.asin(math.sin(angle) / INDEX)
    return angle, HEIGHT / math.cos(angle), below, DEPTH / math.cos(below)


@pytest.mark.slow(every=3)
@pytest.mark.parametrize("backend", CPU)
@pytest.mark.parametrize("surface", [SURFACE, box("Water", (-80, -80, -3), (80, 80, 0))])
@pytest.mark.parametrize("nadir_deg", [0.0, 25.0, 60.0, 80.0])
def test_the_floor_of_a_pool(nadir_deg, surface, backend):
    """Range and energy in closed form; at right angles, the latter is Guenther's (n H + D)²."""
    floor = box("Floor", (-90, -90, -4), (90, 90, -DEPTH))
    materials = [Material("Water", attenuation_per_m=LOSS, **WATER), Material("*", 0.4)]
    found = cast(
        [surface, floor], ray(nadir_deg), (0, 0, HEIGHT), backend,
        materials=materials, visibility_km=0.5,
    )  # fmt: skip
    angle, air, below, water = pool(nadir_deg)
    assert found["object"].tolist() == [1]
    assert found["range"] == pytest.approx([air + INDEX * water], abs=4e-4)
    ahead = found["batch"].directions[0]
    assert found["batch"].positions[0] == pytest.approx(
        (0, 0, HEIGHT) + (air + INDEX * water) * ahead, abs=2e-4
    ), "straight ahead, below the true floor"
    passes = 1 - fresnel(np.array([math.cos(angle)]), INDEX)[0]
    lost = math.exp(-2 * (LOSS * water + extinction(0.5, 905) * air))
    tilt = math.cos(angle) / math.cos(below)
    area = (water + INDEX * air) * (tilt * water + INDEX * air / tilt)
    expected = 0.4 * math.cos(below) * passes**2 * lost * 100 / area
    assert found["intensity"] == pytest.approx([expected], rel=1e-4)
    if not nadir_deg:
        assert area == pytest.approx((INDEX * HEIGHT + DEPTH) ** 2)


def test_light_that_meets_no_water_has_the_same_range_and_energy():
    meshes = [box("Pool", (-3, -3, -3), (-1, 3, -1)), box("Wall", (5, -9, -9), (6, 9, 9))]
    plain = cast(meshes, ray(70), visibility_km=0.3)
    wet = cast(
        meshes, ray(70), visibility_km=0.3, materials=[Material("Pool", **WATER), Material("*")]
    )
    assert wet["range"] == pytest.approx(plain["range"], rel=1e-12)
    assert wet["intensity"] == pytest.approx(plain["intensity"], rel=1e-6)


def test_water_of_the_index_of_air_is_not_there():
    meshes = [SURFACE, box("Floor", (-90, -90, -4), (90, 90, -2))]
    air = Material("Water", transparent="pass", refractive_index=1.0)
    plain = cast(meshes[1:], ray(50), (0, 0, 3))
    found = cast(meshes, ray(50), (0, 0, 3), materials=[air, Material("*")])
    assert found["range"] == pytest.approx(plain["range"], rel=1e-6)
    assert found["intensity"] == pytest.approx(plain["intensity"], rel=1e-5)


def test_the_surface_of_water_may_scatter_light_too():
    meshes = [SURFACE, box("Floor", (-90, -90, -4), (90, 90, -2))]
    dull = [Material("Water", 0.05, **WATER), Material("*", 0.4)]
    found = cast(meshes, ray(0), (0, 0, 4), materials=dull, returns=Returns("all"))
    assert found["range"] == pytest.approx([4, 4 + 1.33 * 2])
    assert found["intensity"][0] == pytest.approx(0.05 * 100 / 16)
    passes = 0.95 * (1 - fresnel(np.ones(1), 1.33)[0])
    assert found["intensity"][1] == pytest.approx(0.4 * passes**2 * 100 / (1.33 * 4 + 2) ** 2)


@pytest.mark.parametrize("surface", [SURFACE, box("Water", (-80, -80, -9), (80, 80, 0))])
def test_a_sensor_under_water(surface):
    """It sees what is in the water n times as far, and above 48.8 degrees the floor mirrored."""
    floor = box("Floor", (-90, -90, -9), (90, 90, -4))
    wall = box("Wall", (30, -90, 5), (31, 90, 90))
    materials = [Material("Water", **WATER), Material("*", 0.5)]
    found = cast([surface, floor], ray(0), (0, 0, -1), materials=materials)
    assert found["range"] == pytest.approx([1.33 * 3], abs=4e-4)
    assert found["intensity"] == pytest.approx([0.5 * 100 / 9], rel=1e-4), "as 3 m in the air"
    steep = cast([surface, floor, wall], ray(180 - 60), (0, 0, -1), materials=materials)
    path = (1 + 4) / math.cos(math.radians(60))
    assert steep["object"].tolist() == [1]
    assert steep["range"] == pytest.approx([1.33 * path], abs=4e-4)
    assert steep["intensity"] == pytest.approx([0.5 * 0.5 * 100 / path**2], rel=1e-4), (
        "nothing lost"
    )
    out = cast([surface, floor, wall], ray(180 - 45), (0, 0, -1), materials=materials)
    above = math.asin(1.33 * math.sin(math.radians(45)))
    air = (30 - 1) / math.sin(above)
    assert out["object"].tolist() == [2]
    assert out["range"] == pytest.approx([1.33 * math.sqrt(2) + air], abs=4e-4)


# -- glass ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("backend", CPU)
@pytest.mark.parametrize("turn_deg", [0.0, 40.0])
def test_a_thick_pane_shifts_light_and_makes_the_way_longer(turn_deg, backend):
    """A pane of 0.2 m in front of a wall that is 60 m away."""
    thick = 0.2
    angle = math.radians(turn_deg)
    within = math.asin(math.sin(angle) / 1.5)
    pane = trimesh.creation.box((thick, 18, 18))
    pane.apply_transform(trimesh.transformations.rotation_matrix(angle, (0, 0, 1)))
    pane = solid("Pane", pane, (20, 0, 0))
    # Half of the wall is a step nearer, beyond where light would get to without the pane.
    shift = thick * math.sin(angle - within) / math.cos(within)
    side = [box("Wall", (60, -90, -90), (61, 90, 90))]
    if shift:
        side.append(box("Step", (59, -90, -90), (61, -0.9 * shift, 90)))
        side.append(box("Other", (59, 0.9 * shift, -90), (61, 90, 90)))
    materials = [Material("Pane", transparent="pass", refractive_index=1.5), Material("*", 0.5)]
    found = cast([pane, *side], ray(), backend=backend, materials=materials)
    path = thick / math.cos(within)
    air = 60 - path * math.cos(angle - within)
    wall = Scene.from_meshes([pane, *side]).all_names.index("Wall")
    expected = air + 1.5 * path - bool(shift)
    assert (found["object"][0] == wall) == (not shift)
    assert found["range"] == pytest.approx([expected], abs=4e-4)
    if not turn_deg:
        passes = (1 - fresnel(np.ones(1), 1.5)[0]) ** 4
        reduced = 60 - thick + thick / 1.5
        assert found["intensity"] == pytest.approx([0.5 * passes * 100 / reduced**2], rel=1e-4)


def test_water_in_a_tank_of_glass():
    """Glass within which there is water, from air to air: three indices."""
    tank = box("Tank", (5, -3, -3), (9, 3, 3))
    water = box("Filling", (5.1, -2.9, -2.9), (8.9, 2.9, 2.9))
    wall = box("Wall", (20, -9, -9), (21, 9, 9))
    glass = Material("Tank", transparent="pass", refractive_index=1.5)
    materials = [Material("Filling", **WATER), glass, Material("*", 0.5)]
    found = cast([tank, water, wall], ray(), materials=materials)
    assert found["range"] == pytest.approx([16 + 1.5 * 0.2 + 1.33 * 3.8], abs=4e-4)
    one = np.ones(1)
    passes = ((1 - fresnel(one, 1.5)) * (1 - fresnel(one, 1.33 / 1.5)))[0] ** 4
    reduced = 16 + 0.2 / 1.5 + 3.8 / 1.33
    assert found["intensity"] == pytest.approx([0.5 * passes * 100 / reduced**2], rel=1e-4)


def test_what_is_refused():
    with pytest.raises(LidarError, match="add transparent: pass"):
        Material("*", refractive_index=1.33)
    with pytest.raises(LidarError, match="needs a refractive_index"):
        Material("*", transparent="pass", attenuation_per_m=0.1)
    with pytest.raises(LidarError, match=r"refractive_index is 0\.9; it must be 1 to 4"):
        Material("*", transparent="pass", refractive_index=0.9)


@pytest.mark.parametrize("backend", CPU)
@pytest.mark.parametrize("nadir_deg", [0.0, 20.0, 35.0, 42.0])
def test_water_may_touch_its_basin(nadir_deg, backend):
    """Floor and walls are where the water ends, and none of them is missed."""
    meshes = [
        box("Water", (-3, -3, -2), (3, 3, 0)),
        box("Floor", (-9, -9, -4), (9, 9, -2)),
        box("Left", (-9, -9, -2), (-3, 9, 0.1)),
        box("Right", (3, -9, -2), (9, 9, 0.1)),
    ]
    materials = [Material("Water", **WATER), Material("*")]
    found = cast(meshes, ray(nadir_deg), (0, 0, 3), backend, materials=materials)
    angle = math.radians(abs(nadir_deg))
    below = math.asin(math.sin(angle) / 1.33)
    side = 3 - 3 * math.tan(angle)
    path = min(2 / math.cos(below), side / max(math.sin(below), 1e-9))
    assert found["range"] == pytest.approx([3 / math.cos(angle) + 1.33 * path], abs=4e-4)


@pytest.mark.parametrize(("max_range_m", "count"), [(2.6, 0), (2.7, 1)])
def test_greatest_ranges_are_optical(max_range_m, count):
    """Two metres of water take as long as 2.66 m of air."""
    sensor = ray(max_range_m=max_range_m)
    water = box("Water", (-9, -9, -9), (9, 9, 9))
    floor = box("Floor", (-5, -5, -3), (5, 5, -2))
    materials = [Material("Water", **WATER), Material("*")]
    down = Pose((0, 0, 0), pitch_deg=90.0)
    found = cast([water, floor], sensor, down, materials=materials)
    assert len(found["range"]) == count


def test_water_in_the_thickest_fog_has_no_energy_that_is_no_number():
    water = box("Water", (-900, -90, -90), (-5, 90, 90))
    floor = box("Floor", (-902, -90, -90), (-899, 90, 90))
    materials = [Material("Water", **WATER), Material("*")]
    behind = Pose((0, 0, 0), yaw_deg=180.0)
    with np.errstate(over="raise", invalid="raise"):
        found = cast([water, floor], ray(), behind, materials=materials, visibility_km=0.001)
    assert np.isfinite(found["intensity"]).all()

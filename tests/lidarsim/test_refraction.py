"""Light through water and glass: ranges by Snell's law, energies by Fresnel, Beer and geometry."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from tests.shapes import CPU, box, cast, level, made, solid

from lidarsim import (
    Actor,
    Beams,
    LidarError,
    Material,
    Optics,
    Pose,
    Returns,
    Scene,
    SceneInstance,
    SceneMesh,
    Sensor,
    Spin,
    Survey,
    Track,
)
from lidarsim.media.materials import extinction, fresnel
from lidarsim.pulses.steps.cast import MAX_PASSES, MAX_REFLECTIONS

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
    wall = Scene.from_meshes([pane, *side]).object_names.index("Wall")
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
    with pytest.raises(LidarError, match="requires transparent: pass"):
        Material("*", refractive_index=1.33)
    with pytest.raises(LidarError, match="requires refractive_index"):
        Material("*", transparent="pass", attenuation_per_m=0.1)
    with pytest.raises(
        LidarError, match=r"refractive_index must be a number from 1 to 4 or None, but is 0\.9"
    ):
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
    """Two meters of water take as long as 2.66 m of air."""
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


# -- bodies within bodies ------------------------------------------------------------------------


@dataclass(eq=False)
class Body:
    """A convex body, by the planes of its faces: independent of meshes and of casting."""

    mesh: SceneMesh
    material: Material
    touches: bool = True  # whether it is made larger, so that light meets what it touches

    @cached_property
    def planes(self):
        """Normals (f, 3) that point out of the body, and their distances from the origin (f,)."""
        corners = self.mesh.vertices[self.mesh.faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals /= np.linalg.norm(normals, axis=1)[:, None]
        grown = 1.5e-5 if self.touches and self.material.refractive_index else 0.0
        return normals, (normals * corners[:, 0]).sum(axis=1) + grown

    def holds(self, point):
        normals, offsets = self.planes
        return (normals @ point < offsets).all()

    def crossing(self, origin, ahead):
        """Distance of the next face on a ray, and the face's normal and offset."""
        normals, offsets = self.planes
        slopes = normals @ ahead
        distances = (offsets - normals @ origin) / slopes
        enter = np.where(slopes < 0, distances, -np.inf).argmax()
        leave = np.where(slopes > 0, distances, np.inf).argmin()
        if distances[enter] > distances[leave]:
            return math.inf, None, None
        face = enter if distances[enter] > 1e-9 else leave
        far = distances[face] if distances[face] > 1e-9 else math.inf
        return far, normals[face], offsets[face]


@dataclass(frozen=True)
class Path:
    """Light on its way: where it is, and what has become of it."""

    origin: np.ndarray
    ahead: np.ndarray
    first: tuple  # where it started, and into which direction
    # Of each surface crossed: normal, offset, and index before over behind; None for mirrors.
    turns: tuple = ()
    optical: float = 0.0
    depth: float = 0.0
    share: float = 1.0
    ghosts: int = 0

    def area(self, normal, offset):
        """Area at a plane, across the light, of a cone of light of one steradian: differences."""
        start, ahead = self.first
        across = np.linalg.svd(ahead[None])[2][1:]
        step = 1e-5
        places = []
        for sign in (1, -1):
            ways = ahead + sign * step * across
            ways /= np.linalg.norm(ways, axis=1)[:, None]
            at = np.tile(start, (2, 1))
            for face, far, ratio in (*self.turns, (normal, offset, 1.0)):
                at = at + ((far - at @ face) / (ways @ face))[:, None] * ways
                ways = turned_by(ways, face, ratio)
            places.append(at)
        one, other = (places[0] - places[1]) / (2 * step)
        return abs(np.cross(one, other) @ self.ahead)


def turned_by(ways, normal, ratio):
    """Directions behind a plane: mirrored, or by Snell's law along and across the plane."""
    upright = (ways @ normal)[:, None] * normal
    if ratio is None:
        return ways - 2 * upright
    along = ratio * (ways - upright)
    rest = np.sqrt(1 - (along**2).sum(axis=1))
    return along + (np.sign(ways @ normal) * rest)[:, None] * normal


def reflected_share(angle, ratio):
    """Fresnel's sine and tangent laws; 1 beyond the critical angle."""
    sine = ratio * math.sin(angle)
    if sine >= 1:
        return 1.0
    behind = math.asin(sine)
    minus, plus = angle - behind, angle + behind
    s_wave, p_wave = math.sin(minus) / math.sin(plus), math.tan(minus) / math.tan(plus)
    return (s_wave**2 + p_wave**2) / 2


def medium(bodies, point):
    """Index and attenuation of the last body that holds a point."""
    within = [b.material for b in bodies if b.material.refractive_index and b.holds(point)]
    return (within[-1].refractive_index, within[-1].attenuation_per_m) if within else AIR


AIR = (1.0, extinction(0.2, 905))


def traced(bodies, path, passes=MAX_PASSES):
    """Yield what returns from a path: object, optical range, energy, and whether it is a ghost."""
    crossings = [body.crossing(path.origin, path.ahead) for body in bodies]
    number = min(range(len(bodies)), key=lambda k: crossings[k][0])
    step, normal, offset = crossings[number]
    material = bodies[number].material
    end = path.origin + step * path.ahead
    before, attenuation = medium(bodies, end - 1e-7 * path.ahead)
    behind, _ = medium(bodies, end + 1e-7 * path.ahead)
    optical = path.optical + before * step
    depth = path.depth + attenuation * step
    cosine = abs(normal @ path.ahead)
    if material.reflectance:
        start, _ = medium(bodies, path.first[0])
        area = path.area(normal, offset) * (before / start) ** 2
        energy = material.reflectance * cosine * path.share * math.exp(-2 * depth) * 100 / area
        yield number, optical, energy, path.ghosts > 0
    if material.transparent != "pass" or passes == 1:
        return
    mirrors = material.specular_reflectance == "fresnel"
    share = reflected_share(math.acos(cosine), before / behind)
    ways = [] if share == 1 else [(before / behind, 1 - share, 0)]
    if mirrors and path.ghosts < MAX_REFLECTIONS:
        ways.append((None, share, 1))
    elif share == 1 and not mirrors:
        ways.append((None, 1.0, 0))
    for ratio, light, ghost in ways:
        onward = Path(
            end,
            turned_by(path.ahead[None], normal, ratio)[0],
            path.first,
            (*path.turns, (normal, offset, ratio)),
            optical,
            depth,
            path.share * (light * (1 - material.reflectance)) ** 2,
            path.ghosts + ghost,
        )
        yield from traced(bodies, onward, passes - 1)


def turned_body(name, mesh, material, at, angles):
    mesh.apply_transform(trimesh.transformations.euler_matrix(*angles))
    return Body(solid(name, mesh, at), replace(material, objects=name))


def bodies_in_a_room():
    """A room with a prism of glass, water around a bead of glass, and a pane that mirrors."""
    shape = trimesh.creation
    glass = Material("*", 0.0, transparent="pass", refractive_index=1.5, attenuation_per_m=0.05)
    water = Material("*", 0.04, attenuation_per_m=0.1, **WATER)
    mirror = replace(glass, specular_reflectance="fresnel", reflectance=0.1)
    return [
        turned_body("Room", shape.box((40, 30, 20)), Material("*", 0.5), (5, 1, 2), (0.1, 0.2, 0)),
        turned_body("Prism", shape.cylinder(2, 3, sections=3), glass, (5, 2, 0.5), (0.3, 0.8, 0.1)),
        turned_body("Pane", shape.box((0.3, 6, 6)), mirror, (12, 1, 0), (0.2, 0.3, 0.5)),
        turned_body("Pond", shape.icosphere(0, 3), water, (5, -3, -0.5), (0.4, 0, 0.2)),
        turned_body("Bead", shape.icosphere(1, 1.2), mirror, (5.5, -3, -0.2), (0, 0.5, 0.2)),
    ]


def scene_of(bodies, kind):
    """A scene in which the last two bodies are meshes, placed copies of meshes, or actors."""
    meshes = [body.mesh for body in bodies]
    if kind == "mesh":
        return Scene.from_meshes(meshes)
    pose = Pose((5, -3, 0.5), 40, 20, 10)
    shapes = [
        replace(mesh, vertices=(mesh.vertices - pose.position) @ pose.rotation)
        for mesh in meshes[3:]
    ]
    if kind == "instance":
        return Scene.from_meshes(meshes[:3] + [SceneInstance(one, pose) for one in shapes])
    quaternion = Rotation.from_matrix(pose.rotation).as_quat()
    track = Track([0.0, 1.0], [pose.position] * 2, [quaternion] * 2)
    return Scene.from_meshes(meshes[:3]).with_actors([Actor(one, track) for one in shapes])


@pytest.mark.parametrize("kind", ["mesh", "instance", "actor"])
def test_light_through_bodies_is_as_traced_face_by_face(kind):
    """Objects, ranges, energies and ghosts, from the air, from water, and from glass in water."""
    bodies = bodies_in_a_room()
    for body in bodies[3:] if kind != "mesh" else ():
        body.touches = False
    rng = np.random.default_rng(5)
    starts = np.repeat([(0, 0, 0), (4.1, -2.8, -1.3), (5.4, -2.9, -0.3)], 15, axis=0)
    starts = rng.permutation(starts + rng.uniform(-0.2, 0.2, (45, 3)))
    angles = np.radians(rng.uniform((-25, -40), (15, 40), (45, 2)))
    sensor = Sensor(Beams(*angles.T, origin=starts), Spin(1, 360), optics=Optics())
    survey = Survey(
        sensor, poses=[(0, 0, 0)], steps=1, visibility_km=0.2, keep_every=1,
        materials=[body.material for body in bodies],
        returns=Returns("all", pulse_ns=1e-6), precision_m=1e-6,
        columns=("ray", "range", "intensity", "object", "cause"),
    )  # fmt: skip
    scene = scene_of(bodies, kind)
    found = made(survey, scene)
    expected = []
    for ray, ahead in enumerate(sensor.directions(np.arange(1))[0]):
        path = Path(starts[ray], ahead, (starts[ray], ahead))
        expected += [(ray, *one) for one in sorted(traced(bodies, path), key=lambda one: one[1])]
    ray, number, optical, energy, ghost = map(np.array, zip(*expected, strict=True))
    assert [*scene.object_names] == [body.mesh.name for body in bodies]
    assert found["ray"].tolist() == ray.tolist()
    assert found["object"].tolist() == number.tolist()
    assert (found["cause"] != 0).tolist() == ghost.tolist()
    assert found["range"] == pytest.approx(optical, abs=3e-5)
    assert found["intensity"] == pytest.approx(energy, rel=3e-5)
    assert ghost.any() and len({*number.tolist()}) == 4

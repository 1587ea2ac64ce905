"""Beams of several rays: their cross-section, planes at any angle, edges."""

from __future__ import annotations

import math

import numpy as np
import pytest
import trimesh
from tests.shapes import Cart, cast, quad, solid, wall

from lidarsim import (
    Beams,
    LidarError,
    Material,
    Mounted,
    Optics,
    Pose,
    Returns,
    Scene,
    SceneMesh,
    Sensor,
    Spin,
    Survey,
    load_sensor,
)
from lidarsim.sensor.disc import SUBRAYS, Beam
from lidarsim.sensor.ray_sensors import PrismSensor
from lidarsim.sensor.sensor import LineSensor
from lidarsim.simulator.rig import Rig
from raybeam import pattern_rays


def plane(point, normal, size=4000.0):
    """A large rectangle through a point."""
    normal = np.asarray(normal, float) / np.linalg.norm(normal)
    one = np.cross(normal, [0.0, 0.0, 1.0] if abs(normal[2]) < 0.9 else [0.0, 1.0, 0.0])
    one /= np.linalg.norm(one)
    other = np.cross(normal, one)
    corners = [
        point + size * (a * one + b * other) for a, b in [(-1, -1), (1, -1), (1, 1), (-1, 1)]
    ]
    return quad("Plane", *corners)


def ground(rough_m=0.0, cell_m=2.0, reach_m=200.0):
    """Level ground of many triangles, below the origin by 1.8 m."""
    steps = np.arange(-reach_m, reach_m + 1, cell_m)
    x, y = np.meshgrid(steps, steps)
    z = np.random.default_rng(0).normal(-1.8, rough_m, x.shape)
    n = len(steps)
    corner = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    low = np.stack([corner, corner + 1, corner + n], axis=1)
    high = np.stack([corner + 1, corner + n + 1, corner + n], axis=1)
    return SceneMesh(
        "Ground", np.stack([x, y, z], axis=-1).reshape(-1, 3), np.concatenate([low, high])
    )


def fan(elevations_deg, optics, max_range_m=math.inf):
    return Sensor(Beams(np.radians(elevations_deg)), Spin(1, 360), 0, max_range_m, optics=optics)


# -- the cross-section ---------------------------------------------------------------------------


def beyond(offset):
    """Share of the unit disc beyond a straight edge at an offset from the middle."""
    return (math.acos(offset) - offset * math.sqrt(1 - offset**2)) / math.pi


@pytest.mark.extended
@pytest.mark.slow(every=3)
@pytest.mark.parametrize("angle_deg", [0, 17, 45, 90, 133])
@pytest.mark.parametrize("offset", [-0.8, -0.3, 0.0, 0.5])
def test_surfaces_on_both_sides_of_an_edge_get_their_shares(angle_deg, offset):
    """The light of a beam, on a near wall that ends at an edge and on a far one."""
    at = offset * 1e-3 * 5  # the beam has a radius of 1 mrad
    near = wall("Near", 5, y=(at, 60), z=(-60, 60))
    cosine = math.cos(math.radians(angle_deg))
    sine = math.sin(math.radians(angle_deg))
    turned = near.vertices @ [[1, 0, 0], [0, cosine, sine], [0, -sine, cosine]]
    materials = [Material("Near", 0.2), Material("Far", 0.8)]  # as bright both, at 5 and 10 m
    meshes = [SceneMesh("Near", turned, near.faces), wall("Far", 10)]
    beam = Returns("all", subrays=217, divergence_mrad=2, pulse_ns=5)
    found = cast(meshes, materials=materials, returns=beam)
    assert found["range"] == pytest.approx([5, 10], abs=1e-3)
    share = found["intensity"][0] / found["intensity"].sum()
    assert share == pytest.approx(beyond(offset), abs=0.015)


# -- planes --------------------------------------------------------------------------------------


def footprint(distance_m, grazing, radius):
    """Range, and energy relative to the middle's, of a cone on a plane: integrals over the disc.

    With s the sine of the angle to the plane, ranges are as 1 / s, energies as s**3.
    """
    slope = math.cos(grazing) / math.sin(grazing) * radius
    variance = slope**2 / 4
    return distance_m * (1 + variance) / (1 + 3 * variance), 1 + 3 * variance


@pytest.mark.extended
@pytest.mark.parametrize("subrays", [7, 61])
@pytest.mark.parametrize(
    "model",
    ["velodyne/vlp32c", "ouster/os1-64", "terrestrial/riegl-vz400", "airborne/riegl-vq780i"],
)
def test_a_beam_on_a_road_is_one_return(model, subrays):
    """However shallow it meets the road: with the converged range and energy."""
    optics = load_sensor(model).optics
    down = np.array([-0.67, -0.8, -1.0, -1.33, -2.0, -3.0, -5.0, -10.0, -25.0])
    for mode in ("all", "strongest"):
        beam = Returns(mode, subrays=subrays)
        found = cast([plane((0, 0, -1.8), (0, 0, 1))], fan(down, optics), returns=beam)
        assert found["ray"].tolist() == list(range(len(down)))
        middle = cast([plane((0, 0, -1.8), (0, 0, 1))], fan(down, optics))
        for ray, elevation in enumerate(np.radians(down)):
            straight = 1.8 / math.sin(-elevation)
            distance, energy = footprint(straight, -elevation, optics.divergence_mrad / 2000)
            assert found["range"][ray] == pytest.approx(distance, abs=optics.resolution_m)
            exact = float(middle["intensity"][ray]) * energy
            assert found["intensity"][ray] == pytest.approx(exact, rel=0.05, abs=1e-6)


@pytest.mark.extended
@pytest.mark.parametrize("model", ["velodyne/vlp32c", "ouster/os1-64"])
@pytest.mark.parametrize("subrays", [7, 61])
def test_a_whole_sensor_reports_the_ground_once(model, subrays):
    """Also where the ground is a mesh, and where the sensor's range ends within a beam."""
    sensor = load_sensor(model)
    for mesh in (plane((0, 0, -1.8), (0, 0, 1)), ground()):
        found = cast([mesh], sensor, returns=Returns("all", subrays=subrays))
        assert len(found["ray"]) > 40
        assert (found["returns"] == 1).all()


def test_a_road_is_one_return_behind_glass_and_in_a_mirror():
    beam = Returns("all", subrays=19, divergence_mrad=3)
    down = fan([-1.33], load_sensor("velodyne/vlp32c").optics)
    road = plane((0, 0, -1.8), (0, 0, 1))
    plain = cast([road], down, returns=beam)
    pane = [wall("Pane", 3), road]
    materials = [Material("Pane", transparent="pass"), Material("*")]
    behind = cast(pane, down, returns=beam, materials=materials)
    assert behind["range"] == pytest.approx(plain["range"], abs=1e-3)
    mirror = [SceneMesh("Pane", wall("Pane", 3).vertices @ _turn(45), wall("Pane", 3).faces), road]
    materials = [Material("Pane", specular_reflectance=1), Material("*")]
    seen = cast(mirror, down, returns=beam, materials=materials)
    assert seen["range"] == pytest.approx(plain["range"], abs=1e-3)


def _turn(degrees):
    """A rotation about the vertical, for rows."""
    c = math.cos(math.radians(degrees))
    s = math.sin(math.radians(degrees))
    return np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])


# -- what stays apart ----------------------------------------------------------------------------


@pytest.mark.parametrize("subrays", [7, 19, 61])
def test_a_shelf_that_is_grazed_and_the_wall_behind_it_are_two_returns(subrays):
    """The plane of the shelf goes on to the wall, the shelf does not."""
    z = -8e-3
    shelf = quad("Shelf", (3, -1, z), (6, -1, z), (6, 1, z), (3, 1, z))
    meshes = [shelf, wall("Wall", 40)]
    beam = Returns("all", subrays=subrays, divergence_mrad=4)
    found = cast(meshes, returns=beam)
    assert found["object"].tolist() == [0, 1]
    assert found["range"][0] < 6
    assert found["range"][1] == pytest.approx(40, abs=1e-3)


@pytest.mark.parametrize("subrays", [7, 61])
def test_slanted_surfaces_one_behind_the_other_are_two_returns(subrays):
    """The near one covers half of the beam."""
    near = plane((20, 0, 0), (1, 0, -3))
    far = plane((24, 0, 0), (1, 0, -3))
    near.vertices[:, 1] = np.maximum(near.vertices[:, 1], 0)
    beam = Returns("all", subrays=subrays, divergence_mrad=3)
    assert cast([near, far], returns=beam)["returns"].tolist() == [2, 2]


PROFILES = ("even", "gaussian")
# Of the light of a beam, on a straight edge; see `sensor/disc.py`.
WRONG = {"even": [0.214, 0.089, 0.055], "gaussian": [0.212, 0.108, 0.073]}
WIDE = Returns("all", 217, (12.0, 4.0), beam_profile="gaussian", pulse_ns=0.1)


def normal_share(x):
    return (1 + math.erf(x / math.sqrt(2))) / 2


def disc_share(x):
    x = min(max(x, -1), 1)
    return 0.5 + (x * math.sqrt(1 - x * x) + math.asin(x)) / math.pi


def rig_of(meshes, survey):
    return Rig(Scene.from_meshes(meshes), survey, "numpy")


def nearer(meshes, sensor=None, at=(0, 0, 0), **options):
    """Share of the light of one pulse that the nearer of two returns has, as on one surface."""
    sensor = sensor or Sensor(Beams(np.zeros(1)), Spin(1, 360))
    options = {"returns": WIDE, "columns": ["range", "reflectance"], **options}
    if "trajectory" not in options and "sensors" not in options:
        options["poses"] = [at]
    survey = Survey(sensor, steps=1, **options)
    (batch,) = rig_of(meshes, survey).cast(0, 1)
    share = batch.reflectance / 0.5
    return float(share[batch.object == 0].sum() / share.sum())


# -- places --------------------------------------------------------------------------------------


@pytest.mark.parametrize("profile", PROFILES)
@pytest.mark.parametrize("which", range(3))
def test_shares_on_an_edge_are_as_wrong_as_stated(profile, which):
    beam = Beam.from_divergences(SUBRAYS[1 + which], (2.0, 2.0), profile)
    share = disc_share if profile == "even" else (lambda x: normal_share(2 * x))
    worst = 0.0
    for turn in np.linspace(0, math.pi, 120, endpoint=False):
        along = np.sort(beam.angles @ [math.cos(turn), math.sin(turn)])
        exact = np.array([share(x) for x in along])
        steps = np.arange(len(along) + 1) / len(along)
        worst = max(worst, np.abs(exact - steps[1:]).max(), np.abs(exact - steps[:-1]).max())
    assert 0.8 * WRONG[profile][which] < worst <= WRONG[profile][which]


# -- what comes back -----------------------------------------------------------------------------


@pytest.mark.parametrize("offset", [-0.8, -0.3, 0.0, 0.4, 1.0])
@pytest.mark.parametrize(("profile", "share"), [("even", disc_share), ("gaussian", normal_share)])
def test_light_on_an_edge(profile, share, offset):
    """A wall up to an offset from the middle of the beam, in radii at 1/e²."""
    beam = Returns("all", 217, 4.0, beam_profile=profile, pulse_ns=1.0)
    meshes = [wall("Near", 10, y=(-50, 0.02 * offset)), wall("Far", 20)]
    exact = share(offset if profile == "even" else 2 * offset)
    assert nearer(meshes, returns=beam) == pytest.approx(exact, abs=0.025)


@pytest.mark.parametrize("wide", [0, 0.01, 0.03, 0.1])
def test_light_of_an_oval_beam_on_an_edge_in_its_middle(wide):
    beam = Returns("all", 217, (4.0, 2.0), exit_diameter_m=wide, pulse_ns=1.0)
    meshes = [wall("Near", 10, y=(-50, 0)), wall("Far", 20)]
    assert nearer(meshes, returns=beam) == pytest.approx(0.5, abs=0.03)


@pytest.mark.parametrize("distance", [0.5, 2.0, 5.0, 50.0])
def test_a_beam_that_is_wide_at_its_start(distance):
    """A strip as wide as the beam's radius there, in front of a wall: 2 Φ(1) - 1 of the light."""
    beam = Returns("all", 217, 3.0, beam_profile="gaussian", exit_diameter_m=0.01, pulse_ns=1.0)
    half = math.hypot(0.005, 1.5e-3 * distance) / 2
    meshes = [wall("Near", distance, z=(-half, half)), wall("Far", distance + 10)]
    assert nearer(meshes, returns=beam) == pytest.approx(2 * normal_share(1) - 1, abs=0.046)


@pytest.mark.parametrize("profile", PROFILES)
@pytest.mark.parametrize("lean_deg", [30.0, 60.0])
def test_ranges_on_a_slanted_plane_scatter_by_the_second_moment(profile, lean_deg):
    """Their variance is (R tan θ)² times that of the angles, of which θ/4 is the deviation."""
    lean = math.radians(lean_deg)
    plane = trimesh.creation.box((1, 200, 200))
    plane.apply_translation((0.5, 0, 0))
    plane.apply_transform(trimesh.transformations.rotation_matrix(lean, (0, 1, 0)))
    mesh = solid("Plane", plane, (50, 0, 0))
    returns = Returns("all", 61, (1.0, 2.0), beam_profile=profile)
    survey = Survey(Sensor(Beams(np.zeros(1)), Spin(1, 360)), poses=[(0, 0, 0)], returns=returns)
    (pulses,) = (rig := rig_of([mesh], survey)).pulse_casters
    beams = pulses.emitter.subrays_of(rig.pattern(0, 0, 1))
    _, directions = pattern_rays(beams, np.arange(61), (0, 0, 0))
    spread = rig.scene_casters[0].caster.cast(np.zeros((61, 3)), directions).distance
    assert spread.std() == pytest.approx(50 * math.tan(lean) * 2e-3 / 4, rel=0.01)


# -- the sensor's axes ---------------------------------------------------------------------------


def edge(offset_rad):
    """Two walls: the nearer ends at an angle above the x axis."""
    return [wall("Near", 10, z=(-50, 10 * offset_rad)), wall("Far", 20)]


HEAD = Spin(4, 360)
PLAIN = Beams(np.zeros(1))
SENSORS = {
    "spinning": Sensor(PLAIN, HEAD),
    "beside its axis": Sensor(Beams(np.zeros(1), origin=[[0, 0, 1e-6]]), HEAD),
    "prisms": PrismSensor(prisms=()),
}


@pytest.mark.slow(every=5)
@pytest.mark.parametrize("name", SENSORS)
@pytest.mark.parametrize(("roll_deg", "width"), [(0, 4e-3), (90, 12e-3), (-90, 12e-3), (180, 4e-3)])
@pytest.mark.parametrize("mounted", [False, True])
def test_the_oval_lies_in_the_axes_of_the_sensor(name, roll_deg, width, mounted):
    """4 mrad up and 12 mrad across; a sensor that is rolled takes its beam with it."""
    sensor = SENSORS[name]
    roll = Pose((0, 0, 0), 0, 0, roll_deg)
    where = {"sensors": [Mounted(sensor, roll)], "poses": [(0, 0, 0)]} if mounted else {"at": roll}
    share = nearer(edge(0.25 * width), None if mounted else sensor, **where)
    assert share == pytest.approx(normal_share(1), abs=0.03)


def test_the_oval_turns_with_the_head_and_with_a_carrier_that_moves():
    """All around, the edge of a wall above is met by the narrow side."""
    survey = Survey(
        Sensor(Beams(np.zeros(1)), Spin(16, 360)),
        trajectory=Cart(speed=0.01, height=0.0, stations=1),
        steps=1,
        returns=WIDE,
        columns=["range", "reflectance"],
    )
    tubes = []
    for name, radius, low in (("Near", 10.0, 10e-3), ("Far", 20.0, -20.0)):
        angle = np.linspace(0, 2 * math.pi, 129)[:-1]
        ring = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
        low_ring = np.column_stack([ring, np.full(128, low)])
        points = np.concatenate([low_ring, np.add(low_ring, (0, 0, 40))])
        one = np.arange(128)
        other = np.roll(np.arange(128), -1)
        faces = [[one, other, other + 128], [one, other + 128, one + 128]]
        tubes.append(SceneMesh(name, points, np.concatenate([np.stack(f, axis=1) for f in faces])))
    (batch,) = rig_of(tubes, survey).cast(0, 1)
    near = batch.object == 0
    assert near.sum() == (~near).sum() == 16
    # 1 mrad above the axis, half of the deviation up, which is 4 / 4 mrad.
    share = batch.reflectance[near] / (batch.reflectance[near] + batch.reflectance[~near])
    assert share == pytest.approx(1 - normal_share(1), abs=0.03)


def test_the_oval_of_a_line_scanner_lies_across_its_line():
    """Azimuths are about x: across the flight is across, along it is up."""
    sensor = LineSensor(Beams(np.zeros(1)), Spin(1, 360))
    for axis, width in ((0, 4e-3), (1, 12e-3)):
        low = np.full(2, -50.0)
        high = np.full(2, 50.0)
        high[axis] = 10 * width / 4
        corners = [[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]]]
        step = quad("Near", *np.column_stack([corners, np.full(4, -10.0)]))
        ground = SceneMesh("Far", step.vertices * (10, 10, 2), step.faces)
        assert nearer([step, ground], sensor) == pytest.approx(normal_share(1), abs=0.03)


# -- fields --------------------------------------------------------------------------------------


def test_returns_go_before_what_the_sensor_states():
    optics = Optics(divergence_mrad=[3.0, 1.5], beam_profile="gaussian", exit_diameter_m=0.01)
    own = Returns(subrays=7).beam(optics)
    assert own.oval
    assert own.starts is not None
    other = Returns(subrays=7, divergence_mrad=2, beam_profile="even", exit_diameter_m=0)
    plain = other.beam(optics)
    assert not plain.oval
    assert plain.starts is None
    assert np.array_equal(plain.angles, Beam.from_divergences(7, (2e-3, 2e-3)).angles)
    assert Returns(subrays=7).divergence(optics) == pytest.approx(math.sqrt(4.5) / 1000)


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: Returns(divergence_mrad=[1, 2, 3]), "or a list of 2 numbers from 0 to 1000"),
        (lambda: Returns(divergence_mrad=[1, -2]), "must be a number from 0 to 1000"),
        (lambda: Optics(divergence_mrad="wide"), "divergence_mrad must .* but is 'wide'"),
        (lambda: Returns(beam_profile="round"), "must be 'even', 'gaussian' or None"),
        (
            lambda: Optics(exit_diameter_m=-0.1),
            "exit_diameter_m must be a number from 0 to 10.* but is -0.1",
        ),
    ],
)
def test_beams_that_mean_nothing_are_refused(make, says):
    with pytest.raises(LidarError, match=says):
        make()

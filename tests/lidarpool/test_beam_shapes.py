"""Gaussian and oval beams, and beams that are wide at their start."""

from __future__ import annotations

import math

import numpy as np
import pytest
import trimesh
from tests.lidarpool.casting import Cart

from lidarpool import (
    Beams,
    LidarpoolError,
    Mounted,
    Optics,
    Pose,
    Returns,
    Scene,
    Sensor,
    Spin,
    Survey,
)
from lidarpool.scene.mesh import Mesh
from lidarpool.sensor.disc import SUBRAYS, Beam
from lidarpool.sensor.rays import PrismSensor
from lidarpool.sensor.sensor import LineSensor
from lidarpool.simulator.rig import Rig

PROFILES = ("even", "gaussian")
# Of the light of a beam, on a straight edge; see `sensor/disc.py`.
WRONG = {"even": [0.214, 0.089, 0.055], "gaussian": [0.212, 0.108, 0.073]}
WIDE = Returns("all", 217, (12.0, 4.0), beam_profile="gaussian", pulse_ns=0.1)


def normal_share(x):
    return (1 + math.erf(x / math.sqrt(2))) / 2


def disc_share(x):
    x = min(max(x, -1), 1)
    return 0.5 + (x * math.sqrt(1 - x * x) + math.asin(x)) / math.pi


def wall(name, x, y=(-50.0, 50.0), z=(-50.0, 50.0)):
    """A rectangle across the x axis."""
    corners = [[x, y[0], z[0]], [x, y[1], z[0]], [x, y[1], z[1]], [x, y[0], z[1]]]
    return Mesh(name, np.array(corners), np.array([[0, 1, 2], [0, 2, 3]]))


def rig_of(meshes, survey):
    return Rig(Scene.from_meshes(meshes), survey, "numpy")


def nearer(meshes, sensor=None, at=(0, 0, 0), **options):
    """Share of the light of one pulse that the nearer of two returns has, as on one surface."""
    sensor = sensor or Sensor(Beams(np.zeros(1)), Spin(1, 360))
    options = {"returns": WIDE, "columns": ["range", "reflectivity"], **options}
    if "trajectory" not in options and "sensors" not in options:
        options["poses"] = [at]
    survey = Survey(sensor, steps=1, **options)
    (batch,) = rig_of(meshes, survey).cast(0, 1)
    share = batch.reflectivity / 0.5
    return float(share[batch.object == 0].sum() / share.sum())


# -- places --------------------------------------------------------------------------------------


@pytest.mark.parametrize("profile", PROFILES)
@pytest.mark.parametrize("count", SUBRAYS[1:])
def test_beams_follow_the_hyperbola_of_a_gaussian_beam(profile, count):
    """Second moments are those of w² = w0² + (θ R / 2)² everywhere, and the axes independent."""
    beam = Beam.of(count, (3e-3, 1.5e-3), profile, 0.012)
    assert np.allclose(beam.angles[0], 0)
    assert np.allclose(beam.starts[0], 0)
    for distance in (0.0, 1.0, 4.0, 30.0, 200.0):
        places = beam.starts + distance * beam.angles
        radius2 = 0.006**2 + (np.array([1.5e-3, 0.75e-3]) * distance) ** 2
        assert (places**2).mean(axis=0) == pytest.approx(radius2 / 4, rel=1e-9)
        assert np.prod(places, axis=1).mean() == pytest.approx(0, abs=1e-9 * radius2.max())


@pytest.mark.parametrize("profile", PROFILES)
@pytest.mark.parametrize("which", range(3))
def test_shares_on_an_edge_are_as_wrong_as_stated(profile, which):
    beam = Beam.of(SUBRAYS[1 + which], (2.0, 2.0), profile)
    share = disc_share if profile == "even" else (lambda x: normal_share(2 * x))
    worst = 0.0
    for turn in np.linspace(0, math.pi, 120, endpoint=False):
        along = np.sort(beam.angles @ [math.cos(turn), math.sin(turn)])
        exact = np.array([share(x) for x in along])
        steps = np.arange(len(along) + 1) / len(along)
        worst = max(worst, np.abs(exact - steps[1:]).max(), np.abs(exact - steps[:-1]).max())
    assert 0.8 * WRONG[profile][which] < worst <= WRONG[profile][which]


def test_gaussian_places_have_equal_shares_of_the_light():
    """As many places within each radius as there is light: 1 - exp(-2 r²)."""
    radius = np.sort(np.hypot(*Beam.of(217, (2.0, 2.0), "gaussian").angles.T))
    exact = 1 - np.exp(-2 * radius**2)
    assert np.abs(exact - np.arange(217) / 217).max() < 0.07


# -- what comes back -----------------------------------------------------------------------------


@pytest.mark.parametrize("offset", [-0.8, -0.3, 0.0, 0.4, 1.0])
@pytest.mark.parametrize(("profile", "share"), [("even", disc_share), ("gaussian", normal_share)])
def test_light_on_an_edge(profile, share, offset):
    """A wall up to an offset from the middle of the beam, in radii at 1/e²."""
    beam = Returns("all", 217, 4.0, beam_profile=profile, pulse_ns=1.0)
    meshes = [wall("Near", 10, y=(-50, 0.02 * offset)), wall("Far", 20)]
    exact = share(offset if profile == "even" else 2 * offset)
    assert nearer(meshes, returns=beam) == pytest.approx(exact, abs=0.025)


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
    mesh = Mesh("Plane", np.add(plane.vertices, (50, 0, 0)), plane.faces)
    returns = Returns("all", 61, (1.0, 2.0), beam_profile=profile)
    survey = Survey(Sensor(Beams(np.zeros(1)), Spin(1, 360)), poses=[(0, 0, 0)], returns=returns)
    (echoes,) = (rig := rig_of([mesh], survey))._echoes
    beams = echoes.divided(rig.pattern(0, 0, 1))
    spread = rig._world.caster.cast(np.zeros((61, 3)), beams.directions).distance
    assert spread.std() == pytest.approx(50 * math.tan(lean) * 2e-3 / 4, rel=0.01)


# -- the sensor's axes ---------------------------------------------------------------------------


def edge(offset_rad):
    """Two walls: the nearer ends at an angle above the x axis."""
    return [wall("Near", 10, z=(-50, 10 * offset_rad)), wall("Far", 20)]


HEAD, PLAIN = Spin(4, 360), Beams(np.zeros(1))
SENSORS = {
    "spinning": Sensor(PLAIN, HEAD),
    "beside its axis": Sensor(Beams(np.zeros(1), origin=[[0, 0, 1e-6]]), HEAD),
    "prisms": PrismSensor(prisms=()),
}


@pytest.mark.parametrize("name", SENSORS)
@pytest.mark.parametrize(("roll_deg", "width"), [(0, 4e-3), (90, 12e-3), (-90, 12e-3), (180, 4e-3)])
@pytest.mark.parametrize("mounted", [False, True])
def test_the_oval_lies_in_the_axes_of_the_sensor(name, roll_deg, width, mounted):
    """4 mrad up and 12 mrad across; a sensor that is rolled takes its beam with it."""
    sensor, roll = SENSORS[name], Pose((0, 0, 0), 0, 0, roll_deg)
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
        columns=["range", "reflectivity"],
    )
    tubes = []
    for name, radius, low in (("Near", 10.0, 10e-3), ("Far", 20.0, -20.0)):
        angle = np.linspace(0, 2 * math.pi, 129)[:-1]
        ring = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
        low_ring = np.column_stack([ring, np.full(128, low)])
        points = np.concatenate([low_ring, np.add(low_ring, (0, 0, 40))])
        one, other = np.arange(128), np.roll(np.arange(128), -1)
        faces = [[one, other, other + 128], [one, other + 128, one + 128]]
        tubes.append(Mesh(name, points, np.concatenate([np.stack(f, axis=1) for f in faces])))
    (batch,) = rig_of(tubes, survey).cast(0, 1)
    near = batch.object == 0
    assert near.sum() == (~near).sum() == 16
    # 1 mrad above the axis, half of the deviation up, which is 4 / 4 mrad.
    share = batch.reflectivity[near] / (batch.reflectivity[near] + batch.reflectivity[~near])
    assert share == pytest.approx(1 - normal_share(1), abs=0.03)


def test_the_oval_of_a_line_scanner_lies_across_its_line():
    """Azimuths are about x: across the flight is across, along it is up."""
    sensor = LineSensor(Beams(np.zeros(1)), Spin(1, 360))
    for axis, width in ((0, 4e-3), (1, 12e-3)):
        low, high = np.full(2, -50.0), np.full(2, 50.0)
        high[axis] = 10 * width / 4
        corners = [[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]]]
        step = Mesh(
            "Near", np.column_stack([corners, np.full(4, -10.0)]), np.array([[0, 1, 2], [0, 2, 3]])
        )
        ground = Mesh("Far", step.vertices * (10, 10, 2), step.faces)
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
    assert np.array_equal(plain.angles, Beam.of(7, (2e-3, 2e-3)).angles)
    assert Returns(subrays=7).of(optics)[0] == pytest.approx(math.sqrt(4.5) / 1000)


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: Returns(divergence_mrad=[1, 2, 3]), "or two such"),
        (lambda: Returns(divergence_mrad=[1, -2]), "it must be 0 to 1000"),
        (lambda: Optics(divergence_mrad="wide"), "divergence_mrad is 'wide'"),
        (lambda: Returns(beam_profile="round"), "it must be 'even' or 'gaussian'"),
        (lambda: Optics(exit_diameter_m=-0.1), "exit_diameter_m is -0.1"),
    ],
)
def test_beams_that_mean_nothing_are_refused(make, says):
    with pytest.raises(LidarpoolError, match=says):
        make()

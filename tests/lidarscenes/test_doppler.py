"""Radial velocities: closed forms, derivatives of trajectories, and batches."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.shapes import Cart, block, cast_between, wall

from lidarscenes.robots.robot import Hinge, LinkPath
from lidarsim import (
    Actor,
    Material,
    Mounted,
    Noise,
    Pose,
    Returns,
    Scene,
    Sensor,
    Survey,
    Track,
    box,
    load_sensor,
)
from lidarsim.motion.rotations import quaternions_of, rotations_of
from lidarsim.motion.trajectory import Stations, velocities
from lidarsim.pulses.returns import PulseReturns
from lidarsim.pulses.steps.false_alarms import FALSE_ALARM
from lidarsim.pulses.steps.particles import AIR
from lidarsim.pulses.steps.separation import separate_hits
from lidarsim.simulator.rig import Rig

# of the train
SPEED = 25.0
RADIUS = 50.0
RATE = SPEED / RADIUS


def circle(radius, seconds, count=40_000, before=0.0):
    """A train's way: counter-clockwise, its axes along the track."""
    times = np.linspace(-before, seconds, count)
    angle = RATE * times
    places = np.stack([radius * np.cos(angle), radius * np.sin(angle), 0 * angle], axis=1)
    yaw = np.degrees(angle) + 90
    turns = quaternions_of(rotations_of(np.stack([yaw, 0 * yaw, 0 * yaw], axis=1)))
    return Track(times, places, turns, smooth=True, start_s=0.0)


def wall_around():
    """A box to look at from inside, far from round."""
    return block("Room", (260, 240, 30), (0, 0, 11))


def found_of(rig):
    """All returns of a survey of one sensor."""
    (returns,) = rig.cast(0, rig.survey.scan_count)
    return returns


def true_ends(returns):
    """Where rays end without noise, (n, 3)."""
    return returns.origins + returns.pulse_returns.distance[:, None] * returns.directions


def differences(path, times_ns, step_ns=2e5):
    """Velocities and rates from poses around times, to the fourth order of the step."""

    def at(offset):
        places, turns = path.poses(0, times_ns + offset * step_ns)
        return places, np.broadcast_to(np.eye(3), (len(places), 3, 3)) if turns is None else turns

    weights = {-2: 1 / 12, -1: -2 / 3, 1: 2 / 3, 2: -1 / 12}
    linear = sum(w * at(k)[0] for k, w in weights.items()) / (step_ns / 1e9)
    slope = sum(w * at(k)[1] for k, w in weights.items()) / (step_ns / 1e9)
    spin = np.einsum("nij,nkj->nik", slope, at(0)[1])  # skew-symmetric
    return linear, np.stack([spin[:, 2, 1], spin[:, 0, 2], spin[:, 1, 0]], axis=1)


def test_a_train_on_a_circle_passes_a_still_sensor():
    # Every point of the train moves with the rate of the circle, around its middle.
    train = Actor(box("Train", (20.0, 3.0, 3.5)), circle(RADIUS, 1.1, before=0.1))
    sensor = Sensor.grid(720, 16, 40.0, step_deg=360)
    survey = Survey(sensor, poses=[(40, 12, 1)], steps=10, columns=["radial_velocity"])
    scene = Scene.from_meshes([wall_around()]).with_actors([train])
    returns = found_of(Rig(scene, survey, "numpy"))
    ends = true_ends(returns)
    ahead = returns.directions
    on_train = returns.object == 1
    assert on_train.sum() > 500
    about = np.cross([0, 0, RATE], ends)
    expected = np.where(on_train, (about * ahead).sum(axis=1), 0.0)
    assert np.abs(returns.radial_velocity - expected).max() < 1e-6
    assert returns.radial_velocity[on_train].min() < -5
    assert returns.radial_velocity[on_train].max() > 5
    (column,) = (c for c in survey.stored_columns if c.name == "radial_velocity")
    stored = returns.column(column)
    assert stored.dtype == np.float32
    assert (np.abs(stored - expected) <= 1e-6 + np.spacing(np.abs(stored))).all()


def test_a_sensor_on_the_train_sees_the_world_turn():
    # The sensor leans out of the train; the train itself keeps its distance.
    way = circle(RADIUS, 1.0, before=0.1)
    sensor = load_sensor("velodyne/hdl64e-s2")  # its beams start beside the axis
    mount = Pose((3.0, 2.5, 3.0), yaw_deg=30, pitch_deg=10)
    train = Actor(box("Train", (20.0, 3.0, 3.5)), way)
    scene = Scene.from_meshes([wall_around()]).with_actors([train])
    survey = Survey(
        sensors=[Mounted(sensor, mount)], trajectory=way, steps=36, columns=["radial_velocity"]
    )
    returns = found_of(Rig(scene, survey, "numpy"))
    about = np.cross([0, 0, RATE], returns.origins)
    expected = np.where(returns.object == 1, 0.0, -(about * returns.directions).sum(axis=1))
    assert {*returns.object.tolist()} == {0, 1}
    assert np.abs(returns.radial_velocity - expected).max() < 2e-6
    assert np.ptp(returns.radial_velocity) > 1.5 * SPEED


def hinges():
    before = np.eye(4)
    before[:3, 3] = 0.5, -0.2, 1.0
    before[:3, :3] = rotations_of(np.array([20.0, 30.0, -10.0]))
    values = np.array([0.0, 0.4, -0.3, 1.0])
    one = Hinge(before, np.array([0, 0.6, 0.8]), False, values)
    other = Hinge(before, np.array([1.0, 0, 0]), True, values[::-1] * 2)
    return one, other, one


@pytest.mark.parametrize(
    "path",
    [
        replace(circle(30.0, 3.0, 31), smooth=False),
        circle(30.0, 3.0, 31),
        LinkPath(circle(30.0, 3.0, 31), hinges(), hinges()[0].before, np.arange(4.0), 0.0),
        LinkPath(Stations((Pose((1, 2, 3), 40),)), hinges(), np.eye(4), np.arange(4.0), 0.0),
    ],
    ids=["linear", "smooth", "links", "links of a robot that stands"],
)
def test_velocities_are_the_derivatives_of_poses(path):
    # Off the given poses, at which a linear path has corners.
    times = (np.arange(29)[:, None] * 0.1 + [0.013, 0.05, 0.087]).ravel() * 1e9
    for found, expected in zip(velocities(path, 0, times), differences(path, times), strict=True):
        assert np.abs(found).max() > 0.3
        np.testing.assert_allclose(found, expected, atol=2e-8)


def test_actors_that_wait_do_not_move():
    way = Track([1, 2], [[0, 0, 0], [5, 0, 0]], start_s=0.0, duration_s=4, beyond="hold")
    linear, angular = velocities(way, 0, np.array([0.5, 1.0, 1.5, 2.0, 3.0]) * 1e9)
    assert linear[:, 0].tolist() == [0, 5, 5, 5, 0]
    assert not angular.any()
    linear, _ = velocities(Stations((Pose((1, 2, 3)),)), 0, np.zeros(4))
    assert linear.shape == (4, 3)
    assert not linear.any()


def test_a_mirror_that_moves_counts_twice():
    # The virtual image of a wall, in a mirror that comes nearer.
    way = Track([0, 2], [[10, 0, 0], [4, 0, 0]], np.tile([0, 0, 0, 1.0], (2, 1)))
    mirror = Actor(wall("Mirror", 0, (-9, 9), (-9, 9)), way)
    behind = wall("Wall", -20)
    sensor = Sensor.grid(180, 3, 20.0, step_deg=360)
    survey = Survey(
        sensor, poses=[(0, 0, 0)], steps=1, columns=["radial_velocity"],
        materials=[Material("Mirror", specular_reflectance=1), Material("*")],
    )  # fmt: skip
    scene = Scene.from_meshes([behind]).with_actors([mirror])
    returns = found_of(Rig(scene, survey, "numpy"))
    seen = returns.directions[:, 0] > 0.5
    assert seen.sum() > 20
    cosine = returns.directions[seen, 0]
    times = returns.time[seen] / 1e9
    np.testing.assert_allclose(returns.range[seen], (20 + 2 * (10 - 3 * times)) / cosine, rtol=1e-6)
    np.testing.assert_allclose(returns.radial_velocity[seen], -6 * cosine, rtol=1e-9)


def test_an_actor_that_a_mirror_shows_has_its_velocity():
    # Light that goes ahead to the mirror at 10 m meets the actor behind the sensor.
    way = Track([0, 2], [[-20, 0, 0], [-14, 0, 0]], np.tile([0, 0, 0, 1.0], (2, 1)))
    actor = Actor(wall("Actor", 0, (-9, 9), (-9, 9)), way)
    survey = Survey(
        Sensor.grid(180, 3, 20.0, step_deg=360), poses=[(0, 0, 0)], steps=1,
        columns=["radial_velocity"],
        materials=[Material("Mirror", specular_reflectance=1), Material("*")],
    )  # fmt: skip
    scene = Scene.from_meshes([wall("Mirror", 10, (-9, 9), (-9, 9))]).with_actors([actor])
    returns = found_of(Rig(scene, survey, "numpy"))
    seen = returns.directions[:, 0] > 0.8
    assert seen.sum() > 20
    cosine = returns.directions[seen, 0]
    times = returns.time[seen] / 1e9
    np.testing.assert_allclose(returns.range[seen], (20 + 20 - 3 * times) / cosine, rtol=1e-6)
    np.testing.assert_allclose(returns.radial_velocity[seen], -3 * cosine, rtol=1e-9)


@pytest.mark.extended
def test_sub_rays_of_a_plain_beam_see_what_one_ray_sees():
    sensor = Sensor.grid(90, 8, 40.0, step_deg=90)
    cart = Cart(stations=1)
    survey = Survey(sensor, trajectory=cart, steps=4, columns=["radial_velocity"])
    one = found_of(Rig(Scene.seed(), survey, "numpy"))
    # The same rays, by the road of those whose returns may be lost.
    lossy = replace(survey, noise=Noise(dropout=1e-12))
    other = found_of(Rig(Scene.seed(), lossy, "numpy"))
    assert other.pulse_returns.velocity is not None
    assert one.pulse_returns.velocity is None
    np.testing.assert_allclose(one.radial_velocity, other.radial_velocity, atol=1e-9)


@pytest.mark.extended
def test_noise_of_velocities():
    sensor = Sensor.grid(1000, 40, 30.0, step_deg=360)
    survey = Survey(
        sensor, poses=[(0, 0, 1)], steps=2, columns=["radial_velocity"],
        noise=Noise(velocity_m_s=0.2, seed=5),
    )  # fmt: skip
    found = found_of(Rig(Scene.seed(), survey, "numpy")).radial_velocity
    # Of n normal values the standard deviation is known to 1 / sqrt(2 n): five of these.
    assert abs(found.std() / 0.2 - 1) < 5 / np.sqrt(2 * len(found))
    assert abs(found.mean()) < 5 * 0.2 / np.sqrt(len(found))
    other = replace(survey, noise=Noise(velocity_m_s=0.2, seed=6))
    assert (found_of(Rig(Scene.seed(), other, "numpy")).radial_velocity != found).mean() > 0.99


@pytest.mark.extended
@pytest.mark.parametrize("subrays", [1, 7])
def test_drops_are_at_rest(subrays):
    # A moving carrier in rain, before a wall and among cars.
    sensor = Sensor.grid(720, 16, 30.0, step_deg=360)
    way = Track([0, 2], [[0, 0, 1], [12, 4, 1]])
    survey = Survey(
        sensors=[Mounted(sensor, Pose((0.5, 0, 1), 20))], trajectory=way, steps=3, rain_mm_h=60,
        columns=["radial_velocity", "cause"], noise=Noise(detection_range_m=100),
        returns=Returns("all", subrays=subrays, divergence_mrad=3),
    )  # fmt: skip
    car = Actor(box("Car", (4.0, 2.0, 2.0)), circle(8.0, 1.5, 40))
    returns = found_of(Rig(Scene.seed().with_actors([car]), survey, "numpy"))
    air = returns.cause == AIR
    assert 100 < air.sum() < 0.9 * len(returns)
    assert not np.isnan(returns.radial_velocity).any()
    expected = -(np.array([6.0, 2.0, 0.0]) * returns.directions).sum(axis=1)
    # Sub-rays leave the middle by 1.5 mrad; a drop and what is behind it may be one return.
    room = 1e-9 if subrays == 1 else 0.012
    still = air if subrays == 1 else air & (np.abs(returns.radial_velocity - expected) < 0.5)
    assert still.sum() > 0.95 * air.sum()
    assert np.abs(returns.radial_velocity - expected)[still].max() < room
    cuts = cast_between(Rig(Scene.seed().with_actors([car]), survey, "tiles"), survey, [0, 1, 3])
    assert cuts == cast_between(
        Rig(Scene.seed().with_actors([car]), survey, "tiles"), survey, [0, 3]
    )


def test_drops_in_an_open_sky_have_a_velocity():
    """Where no ray of all that are cast together hits a surface."""
    drops = np.full(5, -1, np.int32)
    air = PulseReturns(np.arange(5), np.full(5, 3.0), drops, np.ones(5), velocity=np.full(5, -2.0))
    air = air._replace(cause=np.full(5, AIR, np.uint8))
    none = np.zeros(0)
    hits = PulseReturns(np.zeros(0, int), none, np.zeros(0, np.int32), none, velocity=none)
    assert separate_hits(hits, 0.5, air=air).velocity.tolist() == [-2.0] * 5


def test_false_alarms_have_no_velocity():
    sensor = Sensor.grid(360, 16, 30.0, step_deg=360, max_range_m=200)
    survey = Survey(
        sensor, trajectory=Track([0, 1], [[0, 0, 1], [6, 0, 1]]), steps=1,
        columns=["radial_velocity", "cause"], returns=Returns("all"),
        noise=Noise(detection_range_m=100, false_alarm_hz=3e5, velocity_m_s=0.1),
    )  # fmt: skip
    returns = found_of(Rig(Scene.seed(), survey, "numpy"))
    alarms = returns.cause == FALSE_ALARM
    assert alarms.sum() > 100
    assert np.isnan(returns.radial_velocity[alarms]).all()
    rest = returns.radial_velocity[~alarms]
    assert np.abs(rest + 6 * returns.directions[~alarms, 0]).max() < 0.5

"""Surveys and trajectories: scans, poses and times of a sensor that stands or moves."""

from __future__ import annotations

import itertools
from dataclasses import replace
from datetime import UTC, datetime
from fractions import Fraction
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.shapes import Cart

from lidarfiles.identity.fingerprint import fingerprint
from lidarsim import (
    Beams,
    LidarError,
    Mounted,
    Pose,
    Sensor,
    Spin,
    Survey,
    Track,
    load_sensor,
    load_trajectory,
)
from lidarsim.motion.rotations import matrices, quaternions_of, rotations_of
from lidarsim.motion.trajectory import velocities
from lidarsim.survey.survey import MAX_STEPS

RNG = np.random.default_rng(5)
TIMES = np.cumsum(RNG.uniform(0.05, 0.4, 12)) + 1.4e9
PLACES = np.cumsum(RNG.normal(size=(12, 3)), axis=0)
TURNS = RNG.normal(size=(12, 4))
TURNS /= np.linalg.norm(TURNS, axis=1, keepdims=True)
TURNS[1:] += 3 * TURNS[:-1]
TURNS /= np.linalg.norm(TURNS, axis=1, keepdims=True)


def angle(one, other):
    """Between two rotations, radians."""
    return np.arccos(np.clip((np.trace(one.T @ other) - 1) / 2, -1, 1))


@pytest.mark.parametrize("smooth", [False, True])
def test_a_track_is_at_its_poses_and_evenly_turned_between(smooth):
    track = Track(TIMES, PLACES, TURNS, smooth)
    since = (TIMES - TIMES[0]) * 1e9
    places, turns = track.poses(0, since)
    assert np.allclose(places, PLACES, atol=1e-5)  # times since 1970 are no finer
    assert np.allclose(turns, matrices(TURNS), atol=1e-5)
    for part in (0.25, 0.5):
        at = since[:-1] + part * np.diff(since)
        places, turns = track.poses(0, at)
        if smooth:
            continue
        assert np.allclose(places, PLACES[:-1] + part * np.diff(PLACES, axis=0), atol=1e-5)
        for k, turn in enumerate(turns):
            a, b = matrices(TURNS[k : k + 2])
            assert np.isclose(angle(a, turn), part * angle(a, b), atol=1e-5)
            assert np.isclose(angle(turn, b), (1 - part) * angle(a, b), atol=1e-5)
            assert np.allclose(turn @ turn.T, np.eye(3), atol=1e-14)


def stopping():
    """A smooth way of uneven steps with two stops, one of which it turns at."""
    times = TIMES - TIMES[0]
    places = PLACES.copy()
    turns = TURNS.copy()
    places[4:6], turns[5], places[8:11] = places[4], turns[4], places[8]
    return Track(times, places, turns, smooth=True)


def test_a_smooth_way_has_no_jumps_of_velocity_and_acceleration():
    track = stopping()
    step = 1e-6
    at = track.times_s[1:-1, None] + step * np.array([-2, -1, 0, 1, 2])
    found = np.concatenate(velocities(track, 0, at.ravel() * 1e9), axis=1).reshape(*at.shape, 6)
    before = (found[:, 2] - found[:, 0]) / 2
    after = (found[:, 4] - found[:, 2]) / 2
    for part in (slice(3), slice(3, 6)):
        most = np.abs(before[..., part]).max()
        assert most > 30 * step
        assert np.abs(before - after)[..., part].max() < 0.01 * most


def test_between_equal_poses_a_smooth_carrier_stands_still():
    track = stopping()
    poses = track.poses
    speeds = track.velocities
    for first, last, turns in ((4, 5, False), (8, 10, True)):
        at = np.linspace(*track.times_s[[first, last]], 99) * 1e9
        places, rotations = poses(0, at)
        assert (places == track.positions[first]).all()
        assert not speeds(0, at[:-1])[0].any()
        assert (rotations == rotations[0]).all() != turns
        assert speeds(0, at[:-1])[1].any() == turns
    # It comes and goes without ringing: never past the place, and never back.
    way = np.column_stack([[0, 6, 11, 15, 18, 19, 19, 19, 20, 23, 28.0], np.zeros((11, 2))])
    track = Track(np.arange(11.0), way, np.tile([0, 0, 0, 1.0], (11, 1)), smooth=True)
    speed, _ = track.velocities(0, np.linspace(0, 10e9, 2000))
    assert speed[:, 0].min() == 0
    assert speed[:, 0].max() < 6.7


def test_few_poses_make_straight_ways_and_parabolas():
    at = np.linspace(0, 4, 33)
    for count in (2, 3, 5):
        times = np.array([0, 1, 4, 1.5, 3])[:count]
        times.sort()
        degree = min(count - 1, 3)
        places = np.stack([times, times**degree, 0 * times], axis=1)
        found, _ = Track(times, places, smooth=True).poses(0, at[at <= times[-1]] * 1e9)
        np.testing.assert_allclose(found[:, 1], found[:, 0] ** degree, atol=1e-12)


@pytest.mark.extended
def test_pieces_and_the_signs_of_quaternions_do_not_matter():
    flips = np.where(RNG.random(len(TURNS)) < 0.5, -1.0, 1.0)
    one, other = (Track(TIMES, PLACES, q, smooth=True) for q in (TURNS, TURNS * flips[:, None]))
    at = RNG.permutation(np.linspace(0, one.duration_ns, 333))
    for method in ("poses", "velocities"):
        whole = getattr(one, method)(0, at)
        pieces = [getattr(other, method)(0, at[k : k + 1]) for k in range(len(at))]
        for values, parts in zip(whole, zip(*pieces, strict=True), strict=True):
            assert values.tobytes() == np.concatenate(parts).tobytes()


@pytest.mark.parametrize("degrees", [72, 90, 170])
def test_a_smooth_carrier_spins_and_turns_by_large_angles(degrees):
    angles = np.zeros((30, 3))
    angles[:, 0] = degrees * np.arange(30)
    turns = quaternions_of(rotations_of(angles))
    spin = Track(np.arange(30) * 0.1, PLACES[[0] * 30], turns, True)
    _, rates = spin.velocities(0, np.linspace(1e9, 2e9, 500))
    assert np.abs(rates[:, 2] / np.radians(10 * degrees) - 1).max() < 0.04
    turn = Track([0, 1, 2, 3], PLACES[[0] * 4], turns[[0, 0, 1, 1]], True)
    _, rates = turn.velocities(0, np.linspace(0, 3e9, 500))
    assert rates[:, 2].min() == 0
    assert np.isclose(rates[:, 2].mean() * 3, np.radians(degrees), rtol=0.01)


def test_a_smooth_carrier_stays_where_a_log_pauses():
    # At 200 Hz, 1 cm of noise is 2 m/s: a minute of that would be meters.
    times = np.append(np.arange(100) * 0.005, 60 + np.arange(100) * 0.005)
    noise = np.random.default_rng(1).normal(0, 0.01, (200, 3))
    track = Track(times, noise, np.tile([0, 0, 0, 1.0], (200, 1)), smooth=True)
    places, _ = track.poses(0, np.linspace(0, track.duration_ns, 100_000))
    assert np.abs(places).max() < 1.5 * np.abs(noise).max()


def test_without_angles_a_carrier_faces_its_way():
    track = Track([0, 1, 2, 3], [[0, 0, 0], [0, 0, 1], [0, 2, 1], [0, 2, 2]])
    assert [round(track.pose(0, t * 1e9).yaw_deg, 6) for t in (0, 1, 2, 3)] == [90] * 4
    assert Track([0, 1], [[0, 0, 0], [0, 0, 1]]).pose(0, 5e8).yaw_deg == 0
    times = np.linspace(0, 2, 21)
    circle = np.stack([20 * np.sin(times / 2), -20 * np.cos(times / 2), 0 * times], axis=1)
    ends = [Track(times, circle, smooth=True).pose(0, t * 1e9).yaw_deg for t in (0, 2)]
    assert np.allclose(ends, [0, np.degrees(1)], atol=0.01), "of the curve, not of its chords"


def yaws_of(rotations):
    """Yaws of level rotations (k, 3, 3), degrees."""
    assert np.allclose(rotations[:, 2], [0, 0, 1]), "not level"
    return np.degrees(np.arctan2(rotations[:, 1, 0], rotations[:, 0, 0]))


# Legs to the east, north and back to the west, at 10 m/s, 5 m/s and 10 m/s.
LEGS = Track([0, 6, 18, 24], [[0, 0, 1], [60, 0, 1], [60, 60, 1], [0, 60, 1]])


def test_on_straight_legs_yaw_is_the_direction_of_the_leg():
    seconds = np.linspace(0, 24, 2401)
    positions, rotations = LEGS.poses(0, seconds * 1e9)
    yaws = yaws_of(rotations)
    x, y, _ = positions.T
    east, north, west = y < 1e-9, (x > 60 - 1e-9), y > 60 - 1e-9
    for leg, yaw, away in (
        (east, 0, 60 - x),
        (north, 90, np.minimum(y, 60 - y)),
        (west, 180, 60 - x),
    ):
        on = leg & (away > 1)
        assert on.sum() > 500
        off = (yaws[on] - yaw + 180) % 360 - 180
        assert np.abs(off).max() < 1e-6
    # It turns evenly from 1 m before a corner, 0.1 s, until 1 m behind it, 0.2 s.
    moments = np.array([5.9, 6.0, 6.1, 6.2])
    assert np.allclose(yaws_of(LEGS.poses(0, moments * 1e9)[1]), [0, 30, 60, 90])
    linear, angular = LEGS.velocities(0, np.array([3, 6.05]) * 1e9)
    assert np.allclose(linear, [[10, 0, 0], [0, 5, 0]])
    assert np.allclose(angular, [[0, 0, 0], [0, 0, np.radians(300)]])


def test_short_legs_are_turned_from_middle_to_middle():
    """So that a curve of many poses has nearly its tangents."""
    angles = np.linspace(0, 3, 61)
    circle = np.stack([20 * np.sin(angles), -20 * np.cos(angles), 0 * angles], axis=1)
    track = Track(1.4e9 + 2 * angles, circle)
    seconds = np.linspace(0.06, 5.94, 500)
    yaws = yaws_of(track.poses(0, seconds * 1e9)[1])
    assert np.abs(yaws - np.degrees(seconds / 2)).max() < 0.01
    rates = track.velocities(0, seconds * 1e9)[1]
    assert np.allclose(rates, [0, 0, 0.5], atol=1e-3)


def smooth_drive():
    """An uneven smooth drive without angles, with a stop of 3 s at a corner."""
    times = np.array([0, 1, 2.5, 3, 4, 7, 8, 9, 9.5, 11])
    x = [0, 3, 9, 10, 12, 12, 12, 11, 9, 4.0]
    y = [0, 0, 1, 1, 0, 0, 2, 6, 8, 9.0]
    z = [1, 1, 2, 3, 3, 3, 3, 2, 2, 2.0]
    return Track(times, np.column_stack([x, y, z]), smooth=True)


def test_on_a_smooth_path_yaw_is_the_tangent():
    track = smooth_drive()
    assert track.quaternions is None, "the poses are as given"
    step_s = 1e-6
    seconds = np.linspace(0.01, 10.99, 5000)
    seconds = seconds[(seconds < 3.98) | (seconds > 7.02)]
    linear, angular = track.velocities(0, seconds * 1e9)
    yaws = yaws_of(track.poses(0, seconds * 1e9)[1])
    off = yaws - np.degrees(np.arctan2(linear[:, 1], linear[:, 0]))
    assert np.abs(off).max() < 1e-6
    later, sooner = (
        yaws_of(track.poses(0, (seconds + sign * step_s) * 1e9)[1]) for sign in (1, -1)
    )
    rates = np.radians((later - sooner + 180) % 360 - 180) / (2 * step_s)
    assert np.ptp(rates) > 1
    assert np.allclose(angular[:, 2], rates, atol=1e-4) and not angular[:, :2].any()


@pytest.mark.parametrize("smooth", [False, True])
def test_a_carrier_that_stands_turns_in_the_last_second(smooth):
    track = replace(smooth_drive(), smooth=smooth)
    before, first, early, middle, end = yaws_of(
        track.poses(0, np.array([3.9, 4.0, 5.9, 6.5, 7.0]) * 1e9)[1]
    )
    assert first == early == pytest.approx(before, abs=2 if smooth else 1e-9)
    assert end == pytest.approx(90, abs=1)
    assert middle == pytest.approx((first + end) / 2)
    at = np.linspace(6.01, 6.99, 99)
    turned = yaws_of(track.poses(0, at * 1e9)[1])
    rates = np.degrees(track.velocities(0, at * 1e9)[1][:, 2])
    assert (np.diff(turned) > 0).all()
    assert np.allclose(np.gradient(turned, at)[1:-1], rates[1:-1], atol=0.5)


def test_a_platform_turns_during_the_whole_of_a_short_stop():
    places = [[0, 0, 0], [3, 0, 0], [3, 0, 0], [3, 3, 0], [3, 3, 0], [6, 3, 0]]
    track = Track([0, 1, 1.6, 2.6, 3.0, 4.0], places)
    times_s = np.array([0.99, 1.0, 1.3, 1.6, 2.5, 2.6, 2.8, 3.0, 3.5])
    yaws = yaws_of(track.poses(0, times_s * 1e9)[1])
    assert yaws == pytest.approx([0, 0, 45, 90, 90, 90, 45, 0, 0], abs=1e-6)
    # A smooth curve reaches a stop with a slope, and leaves it along the axis of the next leg.
    smooth = replace(track, smooth=True)
    arrival, middle, departure, north = yaws_of(
        smooth.poses(0, np.array([1.0, 1.3, 1.6, 2.1]) * 1e9)[1]
    )
    assert departure == north == pytest.approx(90, abs=1e-6), "from one stop to the next"
    assert middle == pytest.approx((arrival + departure) / 2, abs=1e-6)
    arrival, early, middle, departure = yaws_of(
        smooth.poses(0, np.array([2.6, 2.65, 2.8, 3.0]) * 1e9)[1]
    )
    assert arrival == pytest.approx(90, abs=1e-6) and arrival > early > 80
    assert middle == pytest.approx((arrival + departure) / 2, abs=1e-6)


def test_a_carrier_that_rises_keeps_its_heading():
    for smooth in (False, True):
        rise = [[0, 0, 0], [0, 3, 0], [0, 3, 0], [0, 3, 5], [0, 3, 5]]
        track = Track(range(5), rise, smooth=smooth)
        moments = np.array([0.5, 2.7, 4]) * 1e9
        assert yaws_of(track.poses(0, moments)[1]) == pytest.approx([90] * 3)
        still = Track([0, 1, 2], [[0, 0, 0]] * 3, smooth=smooth)
        assert yaws_of(still.poses(0, np.array([0, 0.7, 2]) * 1e9)[1]).tolist() == [0, 0, 0]
        assert not still.velocities(0, np.array([0, 0.7]) * 1e9)[1].any()


@pytest.fixture
def files(tmp_path):
    """The same drive in all formats: along x, turning to the left, from second 100 on."""
    times = np.linspace(100, 102, 21)
    yaw = np.radians(30 * (times - 100))
    places = np.stack([5 * (times - 100), 0 * times, 2 + 0 * times], axis=1)
    turns = np.stack([0 * yaw, 0 * yaw, np.sin(yaw / 2), np.cos(yaw / 2)], axis=1)
    track = Track(times, places, turns)
    np.savetxt(tmp_path / "drive.tum", np.column_stack([times, places, turns]), header="t x y z q")
    camera = np.array([[0, -1, 0], [0, 0, -1], [1, 0, 0.0]])
    poses = camera @ np.concatenate([matrices(turns) @ camera.T, places[..., None]], axis=2)
    np.savetxt(tmp_path / "poses.txt", poses.reshape(-1, 12), fmt="%.6e")
    np.savetxt(tmp_path / "times.txt", times)
    rows = np.column_stack([times * 1e9, places, np.degrees(yaw)])
    head = "time_ns,x,y,z,heading"
    np.savetxt(tmp_path / "drive.csv", rows, delimiter=",", header=head, comments="", fmt="%.9f")
    return SimpleNamespace(folder=tmp_path, track=track)


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("drive.tum", {}),
        ("poses.txt", {"times": "times.txt"}),
        ("drive.csv", {"columns": {"yaw_deg": "heading"}}),
    ],
)
def test_files(files, name, options):
    if "times" in options:
        options = {"times": files.folder / options["times"]}
    track = load_trajectory(files.folder / name, **options, start_s=100.5, duration_s=1.2)
    assert np.isclose(track.duration_ns, 1.2e9)
    at = np.linspace(0, 1.2e9, 50)
    for one, other in zip(track.poses(0, at), files.track.poses(0, at + 0.5e9), strict=True):
        assert np.allclose(one, other, atol=1e-5)
    moved = load_trajectory(files.folder / name, **options, offset_s=-100)
    assert np.allclose(moved.times_s, files.track.times_s - 100)
    assert fingerprint(track) == fingerprint(
        load_trajectory(files.folder / name, **options, start_s=100.5, duration_s=1.2)
    )
    assert fingerprint(track) != fingerprint(moved)


@pytest.mark.parametrize(
    "text",
    [
        "time_s,x,y,z\n0,1,2,3\n1,4,5,6\n",
        "# made by hand\n\ntime_s;x;y;z\r\n0;1;2;3\r\n1;4;5;6\r\n",
        '"z"\t"y"\t"x"\t"time_s"\n3\t2\t1\t0\n# a remark\n6\t5\t4\t1\n',
        "time_s,x,y,z,\n0,1,2,3,\n1,4,5,6,\n",
        ",time_s,x,y,z\n0,0,1,2,3\n1,1,4,5,6\n",
        "time [s], Position X (m), p_y, pos.z[cm]\n0,1,2,300\n1,4,5,600\n",
        "#time_ns,x,y,z\n0,1,2,3\n1000000000,4,5,6\n",
    ],
)
def test_tables_as_programs_write_them(tmp_path, text):
    (tmp_path / "way.csv").write_text(text, newline="")
    track = load_trajectory(tmp_path / "way.csv")
    assert track.times_s.tolist() == [0, 1]
    assert track.positions.tolist() == [[1, 2, 3], [4, 5, 6]]


class TestSurveys:
    track = Track([0, 1.05], [[0, 0, 1], [21, 0, 1]])

    def test_as_many_scans_as_the_trajectory_lasts(self):
        survey = Survey(Sensor.grid(rate_hz=10), trajectory=self.track)
        assert survey.scan_count == 36 * 10 + 18
        assert np.isclose(survey.pose(36).position[0], 2.0)
        assert Survey(Sensor.grid(), steps=5, trajectory=self.track).scan_count == 5

    def test_a_trajectory_is_never_cut(self):
        def drive(seconds, rate_hz):
            track = Track([0, seconds], [[0, 0, 1], [seconds, 0, 1]])
            return Survey(Sensor.grid(rate_hz=rate_hz), trajectory=track)

        # A time step takes 1/36 of a revolution, and the last firing starts within the last one.
        survey = drive(MAX_STEPS / 36, 1)
        assert survey.scan_count == MAX_STEPS
        assert survey.duration_ns / 1e9 == pytest.approx(MAX_STEPS / 36, abs=0.1)
        words = (
            r"lasts 277778 s, but .*limit.* 10,000,000 time steps, which take 27777\.8 s. "
            r"Set duration_s or steps"
        )
        with pytest.raises(LidarError, match=words):
            drive(MAX_STEPS / 36, 10)

    def test_no_more_than_it_lasts(self):
        with pytest.raises(
            LidarError, match=r"400 steps end at 1.111.* s, which is 0.061.* s after"
        ):
            Survey(Sensor.grid(rate_hz=10), steps=400, trajectory=self.track)
        with pytest.raises(LidarError, match="the first time step"):
            Survey(Sensor.grid(rate_hz=0.01), trajectory=self.track)
        with pytest.raises(LidarError, match=r"0 to 1.05 s.* the last 0.95 s are not covered"):
            self.track.poses(0, np.array([2e9]))

    def test_sensors_come_one_after_the_other_each_with_its_rate(self):
        slow = Sensor.grid(rate_hz=5)
        fast = Sensor.grid(layers=16, rate_hz=20, step_deg=90)
        mount = Pose((1, 2, 0.5), yaw_deg=90)
        mounted = [Mounted(slow, name="slow"), Mounted(fast, mount, "fast")]
        survey = Survey(sensors=mounted, trajectory=self.track)
        assert survey.steps_each == (5 * 36 + 9, 84)
        assert survey.scan_count == 189 + 84
        specs = list(survey.scans())
        assert [spec.scan for spec in specs] == list(range(273))
        assert [spec.sensor for spec in specs] == [0] * 189 + [1] * 84
        assert sum(spec.ray_count for spec in specs) == survey.ray_count
        assert survey.pose(189).position == (1, 2, 1.5)
        assert np.isclose(survey.pose(189 + 4).position[0], 2.0)
        assert survey.pose(189).yaw_deg == 90
        assert "sensor" in [column.name for column in survey.stored_columns]

    def test_stations_wait_for_the_slowest(self):
        slow = Sensor.grid(rate_hz=5)
        fast = Sensor.grid(rate_hz=20)
        mounted = [Mounted(slow, name="slow"), Mounted(fast, name="fast")]
        survey = Survey(sensors=mounted, poses=[(0, 0, 1), (9, 0, 1)])
        starts = [survey.scan(k).start_ns for k in (0, 36, 72, 108)]
        assert starts == [0, 200_000_000, 0, 200_000_000]


def test_the_default_survey_fires_every_ray_of_every_turn_once():
    survey = Survey(Sensor.grid(), poses=[(0, 0, 1), (0, 0, 2), (0, 0, 3)])
    specs = list(survey.scans())
    assert len(specs) == 108
    assert sum(spec.ray_count for spec in specs) == 120_000 == survey.ray_count
    assert [spec.scan for spec in specs] == list(range(108))
    for pose in range(3):
        mine = specs[36 * pose : 36 * pose + 36]
        assert [a for spec in mine for a in range(*spec.firings)] == list(range(1000))
        assert {spec.station for spec in mine} == {pose}
        assert {survey.pose(spec.scan).position[2] for spec in mine} == {pose + 1}


def test_rotation_is_yaw_then_pitch_then_roll():
    assert Pose((0, 0, 0)).rotation is None
    x, y, z = np.eye(3)
    assert np.allclose(Pose((0, 0, 0), yaw_deg=90).rotation @ x, y)
    assert np.allclose(Pose((0, 0, 0), pitch_deg=90).rotation @ x, -z)
    assert np.allclose(Pose((0, 0, 0), roll_deg=90).rotation @ y, z)
    both = Pose((0, 0, 0), 30, 40, 50).rotation
    assert np.allclose(both @ both.T, np.eye(3))
    yaw, pitch, roll = (
        Pose((0, 0, 0), **{name: angle}).rotation
        for name, angle in (("yaw_deg", 30), ("pitch_deg", 40), ("roll_deg", 50))
    )
    assert np.allclose(both, yaw @ pitch @ roll)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"poses": []}, "at least one pose"),
        ({"poses": [(0, 0)]}, r"position must be a list of 3 finite numbers"),
        ({"poses": [5]}, "poses must .* but is 5"),
        ({"poses": [(0, 0, float("nan"))]}, r"but is \(0.0, 0.0, nan\)"),
        (
            {"sensor": Sensor.grid(10_000_000, 65_535, 60.0)},
            "18,204,181,230 rays, but the limit is",
        ),
        ({"sensor": Sensor.grid(rate_hz=1e-10)}, "would last .* limited to 292 years"),
        (
            {"poses": [(0, 0, 0)] * 99, "sensor": Sensor.grid(rate_hz=1e-8)},
            "would last 9,900,000,000 s",
        ),
        ({"keep_every": 0}, "keep_every"),
        ({"precision_m": 0}, "precision_m"),
        ({"trajectory": Cart()}, "poses and a trajectory cannot be combined"),
        ({"columns": ["tiem"]}, "Unknown column 'tiem'.*'time'"),
    ],
)
def test_values_out_of_range_say_which(arguments, message):
    with pytest.raises(LidarError, match=message):
        Survey(**({"poses": [(0, 0, 0)]} | arguments))


def test_each_sensor_may_start_later_and_take_steps_of_its_own():
    way = Track([0, 10], [[0, 0, 1], [20, 0, 1]])
    head = Spin(100, step_deg=36, rate_hz=10)
    late = Mounted(Sensor(head=head, start_ns=2e9), name="late", steps=20)
    survey = Survey(trajectory=way, sensors=[Mounted(Sensor(head=head), name="all"), late])
    assert survey.steps_each == (1000, 20)
    first = survey.scan(1000)
    last = survey.scan(1019)
    assert (first.sensor, first.firings, last.firings) == (1, (0, 10), (190, 200))
    assert survey.begins_ns(1000) == 2e9 and survey.begins_ns(1019) == pytest.approx(2.19e9)
    assert survey.pose(1000).position == pytest.approx((4, 0, 1))
    until = Survey(trajectory=way, sensors=[replace(late, steps=None)])
    assert until.steps_each == (800,)
    with pytest.raises(LidarError, match=r"900 steps end at 10[.]99.* end of the trajectory .10 s"):
        Survey(trajectory=way, sensors=[replace(late, steps=900)])


@pytest.mark.parametrize("pitch", [90, -90])
@pytest.mark.parametrize("yaw", [0, 30, 200])
def test_a_pose_that_looks_straight_up_or_down_is_found_again(yaw, pitch):
    turned = Pose((0, 0, 0), yaw, pitch, 20).rotation
    assert np.allclose(Pose.from_rotation((1, 2, 3), turned).rotation, turned, atol=1e-12)


@pytest.mark.parametrize(
    ("matrix", "fault"),
    [
        (np.diag([1.0, -1.0, 1.0]), "mirrors"),
        (-np.eye(3), "mirrors"),
        (2 * np.eye(3), "deforms"),
        (np.array([[1, 0.1, 0], [0, 1, 0], [0, 0, 1.0]]), "deforms"),
        (np.full((3, 3), np.nan), "deforms"),
    ],
)
def test_matrices_that_are_no_rotations_are_no_poses(matrix, fault, tmp_path):
    with pytest.raises(LidarError, match=f"pose {fault}: .* the determinant 1"):
        Pose.from_rotation((1, 2, 3), matrix)
    rows = np.concatenate([np.eye(3), np.ones((3, 1))], axis=1)
    other = np.concatenate([matrix, np.ones((3, 1))], axis=1)
    np.savetxt(tmp_path / "poses.txt", [rows.ravel(), other.ravel()])
    np.savetxt(tmp_path / "times.txt", [0, 1])
    with pytest.raises(LidarError, match=f"Matrix 1 of a pose {fault}"):
        load_trajectory(tmp_path / "poses.txt", times=tmp_path / "times.txt")


def test_a_start_needs_a_time_zone_and_a_year_of_known_leap_seconds():
    for start in (datetime(2026, 11, 21), datetime(2016, 12, 31, tzinfo=UTC)):
        with pytest.raises(LidarError, match="a time from 2017 on with its time zone"):
            Survey(poses=[(0, 0, 1)], start=start)
    with pytest.raises(
        LidarError, match="epsg must be a whole number from 1024 to 32767 or None, but is 5"
    ):
        Survey(poses=[(0, 0, 1)], epsg=5)


@given(rays=st.integers(1, 5000), steps=st.integers(1, 720))
def test_the_steps_of_a_turn_hold_each_firing_once(rays, steps):
    """360 / steps is rarely exact, in decimal or in binary; the steps must meet all the same."""
    if steps > rays:
        return
    sensor = Sensor.grid(rays_per_revolution=rays, layers=1, step_deg=360 / steps)
    sectors = [sensor.firings(step) for step in range(steps)]
    assert sectors[0][0] == 0
    assert all(a[1] == b[0] for a, b in itertools.pairwise(sectors))
    assert all(first < stop for first, stop in sectors)
    assert sectors[-1][1] == rays


def test_a_grid_fires_from_plus_x_counter_clockwise_lowest_channel_first():
    sensor = Sensor.grid(rays_per_revolution=4, layers=3, vertical_fov_deg=90, step_deg=90)
    found = sensor.directions(np.arange(8))
    assert found.shape == (8, 3, 3)
    assert np.allclose(np.linalg.norm(found, axis=-1), 1, atol=1e-15)
    assert np.allclose(found[:4, 1], [[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]])
    assert np.allclose(np.degrees(np.arcsin(found[0, :, 2])), [-45, 0, 45])
    assert np.array_equal(found[:4], found[4:]), "after a turn it stands as before"
    assert sensor.origins(np.arange(4)) is None
    assert Sensor.grid(layers=1).beams.elevation.tolist() == [0.0]


def test_a_turn_that_is_no_whole_number_of_firings():
    """Firing rate and turning rate of real sensors do not fit: each turn begins elsewhere."""
    head = Spin(firings_per_turn=1808.449, step_deg=360, rate_hz=10)
    assert head.period is None
    turns = [head.firings(turn) for turn in range(1000)]
    assert all(a[1] == b[0] for a, b in itertools.pairwise(turns))
    assert {stop - first for first, stop in turns} == {1808, 1809}
    assert turns[-1][1] == 1_808_449
    firings = np.array([0, 1808, 1809, 1_808_448])
    expected = [float(Fraction(int(f)) % Fraction("1808.449")) for f in firings]
    assert np.allclose(head.azimuths(firings), 2 * np.pi * np.array(expected) / 1808.449, atol=1e-9)
    assert np.allclose(head.times_ns(np.array([1_808_449])), 1000 * 1e9 / 10)


def test_beams_have_offsets_in_azimuth_time_and_origin():
    beams = Beams(
        np.radians([-10, 0, 20]),
        azimuth=np.radians([1, 0, -2]),
        time_ns=[0, 1152, 2304.4],
        origin=[[0, 0, 0], [0.1, 0, 0], [0, 0.2, 0.3]],
    )
    sensor = Sensor(beams, Spin(firings_per_turn=8, step_deg=90, rate_hz=5))
    firings = np.array([0, 2, 9])
    x, y, z = sensor.directions(firings).transpose(2, 0, 1)
    azimuth = np.array([[1, 0, -2], [91, 90, 88], [46, 45, 43]])
    assert np.allclose(np.degrees(np.arctan2(y, x)), azimuth)
    assert np.allclose(np.degrees(np.arcsin(z)), [-10, 0, 20])
    origins = sensor.origins(firings)
    assert np.allclose(origins[0], beams.origin), "as given where the head is at azimuth 0"
    assert np.allclose(origins[1], [[0, 0, 0], [0, 0.1, 0], [-0.2, 0, 0.3]]), "turned with it"
    times = sensor.times_ns(firings)
    assert times.dtype == np.int64
    assert times.tolist() == [[f * 25_000_000 + t for t in (0, 1152, 2304)] for f in firings]


def test_beams_cannot_be_changed_in_place():
    """The fingerprint of a run is taken once."""
    given = np.array([0.0, 0.1])
    beams = Beams(given)
    given[0] = 5
    assert beams.elevation.tolist() == [0, 0.1]
    with pytest.raises(ValueError, match="read-only"):
        beams.elevation[0] = 5


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Beams([]), "1 to 65535 beams, but has 0"),
        (lambda: Beams(np.zeros(65_536)), "but has 65536"),
        (lambda: Beams([0, 1], azimuth=[0]), r"Beams\.azimuth must be \(2,\)"),
        (lambda: Beams([0, np.nan]), r"Beams\.elevation"),
        (lambda: Beams([0], time_ns=[np.inf]), r"Beams\.time_ns"),
        (lambda: Beams([0, 1], origin=[0, 0, 0]), r"Beams\.origin must be \(2, 3\)"),
        (lambda: Spin(step_deg=0.1), r"less than the angle between two firings \(0.36 degrees\)"),
        (lambda: replace(Sensor(), min_range_m=-1), "min_range_m"),
        (lambda: replace(Sensor(), min_range_m=5, max_range_m=5), "max_range_m"),
        (lambda: Sensor.grid(step_deg=float("nan")), "step_deg"),
    ],
)
def test_values_out_of_range_name_the_field(make, message):
    with pytest.raises(LidarError, match=message):
        make()


def test_a_turn_of_a_narrow_grid_sweeps_its_field_of_view():
    sensor = Sensor.grid(400, 3, 20, horizontal_fov_deg=30)
    survey = Survey(sensor, poses=[(0, 0, 0)])
    assert (survey.scan_count, survey.ray_count, sensor.firings(36)[0]) == (36, 1200, 400)
    x, y, z = sensor.directions(np.arange(400)).reshape(-1, 3).T
    azimuth = np.degrees(np.arctan2(y, x))[::3]
    assert azimuth == pytest.approx(np.linspace(-15, 15, 400, endpoint=False))
    assert np.degrees(np.arcsin(z))[:3] == pytest.approx([-10, 0, 10])
    with pytest.raises(
        LidarError, match="horizontal_fov_deg must be a number above 0 and at most 360, but is 361"
    ):
        Sensor.grid(horizontal_fov_deg=361)


def test_sweeps_are_counted_beside_scans():
    """A sweep is a revolution, also one that is not completed, or a frame."""
    grid = Sensor.grid(layers=2)
    survey = Survey(grid, poses=[(0, 0, 1), (0, 0, 2)], steps=60)
    assert (survey.scan_count, survey.sweep_count) == (120, 4)
    assert survey.sweep_stops.tolist() == [36, 60, 96, 120]
    assert [survey.sweeps_within(*span) for span in ((0, 35), (0, 36), (36, 97), (0, 120))] == [
        0, 1, 2, 4,
    ]  # fmt: skip
    track = Track([0, 1.05], [[0, 0, 1], [1, 0, 1]])
    sensors = [Mounted(grid, name="a"), Mounted(load_sensor("livox/avia"), name="b")]
    drive = Survey(sensors=sensors, trajectory=track)
    assert [len(sweeps.firsts) for sweeps in drive.sweeps_each] == [11, 11]
    assert drive.sweep_count == 22

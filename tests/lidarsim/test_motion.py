"""Poses, tracks and rotations against independent formulas."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lidarsim import LidarError, Pose, Track
from lidarsim.motion.rotations import check_rotations, matrices, quaternions_of, rotations_of
from lidarsim.motion.trajectory import find_batch, presence_ns, velocities


def product(p, q):
    """Products of quaternions x, y, z, w (n, 4)."""
    vector = p[:, 3:] * q[:, :3] + q[:, 3:] * p[:, :3] + np.cross(p[:, :3], q[:, :3])
    return np.column_stack([vector, p[:, 3] * q[:, 3] - (p[:, :3] * q[:, :3]).sum(axis=1)])


def matrix_of(quaternion):
    """Rotation matrix of a quaternion of any length: the rotated unit vectors as columns."""
    q = np.tile(quaternion / np.linalg.norm(quaternion), (3, 1))
    vectors = np.column_stack([np.eye(3), np.zeros(3)])
    return product(product(q, vectors), q * [-1, -1, -1, 1])[:, :3].T


def expected_knots(times, values, still):
    """Slopes and second derivatives of a cubic spline that stands at some knots, by a solver."""
    count = len(times)
    steps = np.diff(times)
    mean = np.diff(values, axis=0) / steps[:, None]
    system = np.eye(count)
    right = np.zeros_like(values)
    for k in range(1, count - 1):
        system[k, k - 1 : k + 2] = 1 / steps[k - 1], 2 / steps[k - 1] + 2 / steps[k], 1 / steps[k]
        right[k] = 3 * (mean[k - 1] / steps[k - 1] + mean[k] / steps[k])
    for end, near in ((0, slice(4)), (-1, slice(-4, None))):  # polynomials through four values
        since = times[near] - times[end]
        powers = since[:, None] ** np.arange(len(since))
        right[end] = np.linalg.solve(powers, values[near])[1]
    system[still] = np.eye(count)[still]
    right[still] = 0
    slopes = np.linalg.solve(system, right)
    second = np.empty_like(values)
    second[:-1] = (6 * mean - 4 * slopes[:-1] - 2 * slopes[1:]) / steps[:, None]
    second[-1] = (4 * slopes[-1] + 2 * slopes[-2] - 6 * mean[-1]) / steps[-1]
    second[still] = 0
    return slopes, second


def expected_curve(times, values, still, at):
    """Values and slopes of polynomials of fifth degree with derivatives at both ends."""
    slopes, second = expected_knots(times, values, still)
    found = np.empty((2, len(at), values.shape[1]))
    exponents = np.arange(6)
    for row, moment in enumerate(at):
        k = min(np.searchsorted(times, moment, "right"), len(times) - 1) - 1
        step = times[k + 1] - times[k]
        system = []
        for since in (0.0, step):
            system += [
                since**exponents,
                exponents * since ** np.maximum(exponents - 1, 0),
                exponents * (exponents - 1) * since ** np.maximum(exponents - 2, 0),
            ]
        ends = [d[end] for end in (k, k + 1) for d in (values, slopes, second)]
        coefficients = np.linalg.solve(system, ends)
        since = moment - times[k]
        found[0, row] = since**exponents @ coefficients
        found[1, row] = (exponents[1:] * since ** exponents[:-1]) @ coefficients[1:]
    return found


# Steps in seconds and places of a pause: steps are ten times as long as their neighbor, and ten
# times as slow, or not quite.
PAUSES = {
    "too short": (9.5, 0.01, False),
    "too fast": (10.5, 0.105, False),
    "before": (10.5, 0.095, True),
}


@pytest.mark.parametrize("count", [2, 3, 4, 5, 90])
def test_a_smooth_track_is_a_cubic_spline(count):
    rng = np.random.default_rng(count)
    times = np.cumsum(rng.uniform(0.5, 1.5, count))
    places = np.cumsum(rng.normal(size=(count, 3)), axis=0)
    angles = np.cumsum(rng.normal(0, 20, (count, 3)), axis=0) % 360
    turns = quaternions_of(rotations_of(angles))
    for k in range(1, count):
        turns[k] *= np.sign(turns[k] @ turns[k - 1])
    at = np.concatenate([times, rng.uniform(times[0], times[-1], 60)])
    assert_curve(Track(times, places, turns, smooth=True), places, turns, [], [], at)


@pytest.mark.parametrize("reverse", [False, True])
@pytest.mark.parametrize("pause", PAUSES)
def test_a_smooth_track_stands_in_pauses_and_between_equal_poses(pause, reverse):
    factor, speed, stands = PAUSES[pause]
    steps = np.array([1, 1, 1, factor, 1, 1, 1, 1])
    speeds = np.array([1, 1.2, 1, speed, 1, 1, 0, 1])
    stops = [*([3, 4] if stands else []), 6, 7]
    if reverse:
        steps, speeds, stops = steps[::-1], speeds[::-1], [8 - k for k in stops]
    times = np.append(0, np.cumsum(steps))
    places = np.outer(np.append(0, np.cumsum(steps * speeds)), [0.6, 0.0, -0.8])
    turns = np.tile([0.0, 0, 0, 1], (9, 1))
    at = np.linspace(0, times[-1], 70)
    assert_curve(Track(times, places, turns, smooth=True), places, turns, stops, range(9), at)


def assert_curve(track, places, turns, stops, turn_stops, at):
    """Assert that poses and velocities are those of the curve through poses."""
    place, speed = expected_curve(track.times_s, places, list(stops), at)
    turn, slope = expected_curve(track.times_s, turns, list(turn_stops), at)
    times_ns = (at - track.times_s[0]) * 1e9
    found = track.poses(0, times_ns)
    np.testing.assert_allclose(found[0], place, atol=1e-9)
    np.testing.assert_allclose(found[1], [matrix_of(q) for q in turn], atol=1e-9)
    rates = 2 * product(slope, turn * [-1, -1, -1, 1])[:, :3] / (turn**2).sum(axis=1)[:, None]
    found = track.velocities(0, times_ns)
    np.testing.assert_allclose(found[0], speed, atol=1e-9)
    np.testing.assert_allclose(found[1], rates, atol=1e-9)


def slerped(first, last, part):
    """Rotations between quaternions, the shorter way, and the vector of the whole rotation."""
    if first @ last < 0:
        last = -last
    angle = np.arccos(min(first @ last, 1.0))
    both = (np.sin((1 - part) * angle) * first + np.sin(part * angle) * last) / np.sin(angle)
    change = product(last[None], first[None] * [-1, -1, -1, 1])[0]
    return matrix_of(both), 2 * angle * change[:3] / np.linalg.norm(change[:3])


@pytest.mark.parametrize("form", ["track", "matrices"])
def test_a_straight_track_turns_evenly_about_one_axis(form):
    rng = np.random.default_rng(5)
    times = np.array([0, 0.5, 2, 3])
    places = rng.normal(size=(4, 3))
    turns = rng.normal(size=(4, 4))
    turns /= np.linalg.norm(turns, axis=1)[:, None]
    if form == "track":
        track = Track(times, places, turns)
        assert find_batch(track) is None
    else:
        poses = np.tile(np.eye(4), (2, 4, 1, 1))
        poses[1, :, :3, :3] = [matrix_of(q) for q in turns]
        poses[1, :, :3, 3] = places
        other, track = Track.from_matrices(times, poses)
        assert find_batch(track) is find_batch(other) is not None
        assert np.array_equal(other.poses(0, np.zeros(1))[1], [np.eye(3)])
    assert track.duration_ns == 3e9 and presence_ns(track) == (-np.inf, np.inf)
    for k, part in ((0, 0.0), (0, 0.3), (1, 0.0), (1, 0.9), (2, 0.5), (2, 1.0)):
        step = times[k + 1] - times[k]
        at = np.array([times[k] + part * step]) * 1e9
        (place,), (rotation,) = track.poses(0, at)
        (speed,), (rate,) = track.velocities(0, at)
        matrix, vector = slerped(turns[k], turns[k + 1], part)
        np.testing.assert_allclose(place, places[k] + part * (places[k + 1] - places[k]))
        np.testing.assert_allclose(speed, (places[k + 1] - places[k]) / step)
        np.testing.assert_allclose(rotation, matrix, atol=1e-12)
        np.testing.assert_allclose(rate, vector / step, atol=1e-12)


@pytest.mark.parametrize("smooth", [False, True])
def test_before_and_after_its_times_a_track_holds_its_poses(smooth):
    times = np.array([5.0, 6, 7])
    places = np.outer(times, [2.0, -1, 0])
    turns = quaternions_of(rotations_of(np.outer(times, [9.0, 0, 0])))
    held, absent = (
        Track(times, places, turns, smooth, start_s=4.0, beyond=beyond)
        for beyond in ("hold", "absent")
    )
    at = np.array([-1e9, 0, 1e9, 2e9, 3e9, 3.5e9])
    for track in (held, absent):
        assert track.duration_ns == 3e9
        found, rotations = track.poses(0, at)
        np.testing.assert_allclose(found, np.outer([5, 5, 5, 6, 7, 7], [2.0, -1, 0]), atol=1e-9)
        yaws = np.degrees(np.arctan2(rotations[:, 1, 0], rotations[:, 0, 0]))
        np.testing.assert_allclose(yaws, [45, 45, 45, 54, 63, 63])
        speeds, rates = track.velocities(0, at)
        moving = np.array([0, 0, 1, 1, 1, 0])
        np.testing.assert_allclose(speeds, np.outer(moving, [2.0, -1, 0]), atol=1e-12)
        np.testing.assert_allclose(rates[:, 2], np.radians(9) * moving, rtol=0.01)
    assert presence_ns(held) == (-np.inf, np.inf)
    assert presence_ns(absent) == (1e9, 3e9)
    assert Track(times, places, start_s=9.0, beyond="hold").duration_ns == 0


def test_a_station_may_end_a_rounding_beyond_the_last_pose():
    times = [0.0, 1.0]
    places = [[0, 0, 0], [1, 0, 0.0]]
    for options, gap in (
        ({"start_s": -0.9e-6}, None),
        ({"duration_s": 1 + 0.9e-6}, None),
        ({"start_s": -1.1e-6}, "start_s is -1.1e-06 s, which is 1.1e-06 s outside"),
        ({"duration_s": 1 + 1.1e-6}, r"duration_s is 1\.0000011 s, which is 1.1e-06 s outside"),
        ({"start_s": 1.0}, "must be greater than 0, but it covers 1 to 1 s"),
        ({"start_s": np.nan}, "start_s must be a finite number"),
    ):
        if gap is None:
            assert Track(times, places, **options).duration_ns == pytest.approx(1e9, abs=1e3)
        else:
            with pytest.raises(LidarError, match=gap):
                Track(times, places, **options)
    track = Track(times, places)
    assert track.poses(0, np.array([1e9 + 0.9e6]))[0][0, 0] == pytest.approx(1.0009)
    assert track.poses(0, np.array([-0.9e6]))[0][0, 0] == pytest.approx(-0.0009)
    for beyond_ns in (1e9 + 1.1e6, -1.1e6):
        with pytest.raises(LidarError, match=r"the (first|last) 0\.0011 s are not covered"):
            track.poses(0, np.array([0.0, beyond_ns, 5e8]))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([0.0], [[0, 0, 0]]), "at least two poses"),
        (([0.0, 1], [[0, 0], [1, 0]]), r"positions of the shape \(2, 2\)"),
        (([0.0, 1, 1], np.zeros((3, 3))), "the time of pose 2 is not after"),
        (([0.0, np.inf], np.zeros((2, 3))), "The time of pose 1 is not finite"),
        (([0.0, 1], [[0, 0, 0], [0, np.nan, 0]]), "The position of pose 1 is not finite"),
        (([0.0, 1], np.zeros((2, 3)), np.ones((2, 3))), r"has the shape \(2, 3\)"),
        (([0.0, 1], np.zeros((2, 3)), [[0, 0, 0, 1], [0, 0, 0, 1.0011]]), "quaternion of pose 1"),
        (([0.0, 1], np.zeros((2, 3)), [[0, 0, 0, 1], [0, 0, 0, np.nan]]), "quaternion of pose 1"),
    ],
)
def test_poses_that_make_no_track(arguments, message):
    with pytest.raises(LidarError, match=message):
        Track(*arguments)


@pytest.mark.parametrize("smooth", [False, True])
def test_angles_of_a_track_are_those_of_poses(smooth):
    times = np.array([0.0, 2, 5])
    places = np.arange(9.0).reshape(3, 3)
    angles = np.array([[10, 0, -5], [100, 3, 0], [170, -4, 8.0]])
    yaw, pitch, roll = angles.T
    track = Track(times, places, yaw_deg=yaw, pitch_deg=pitch, roll_deg=roll, smooth=smooth)
    for time, (y, p, r) in zip(times, angles, strict=True):
        pose = track.pose(0, time * 1e9)
        assert (pose.yaw_deg, pose.pitch_deg, pose.roll_deg) == pytest.approx((y, p, r), abs=1e-9)
    straight = Track(times[:2], places[:2], yaw_deg=[350, 370])
    assert straight.pose(0, 1e9).yaw_deg == pytest.approx(0, abs=1e-9)
    level = Track(times[:2], places[:2], yaw_deg=30)
    assert level.pose(0, 1e9).yaw_deg == pytest.approx(30)
    copied = replace(level, beyond="hold")
    np.testing.assert_array_equal(copied.quaternions, level.quaternions)


@pytest.mark.parametrize(
    ("angles", "message"),
    [
        ({"roll_deg": 3}, "roll_deg cannot be used without yaw_deg. Pass"),
        ({"yaw_deg": [1, 2, 3]}, "yaw_deg must be a finite angle, or one finite angle for each"),
        ({"yaw_deg": np.nan}, "one finite angle"),
        ({"yaw_deg": "north"}, "array of numbers"),
        ({"yaw_deg": 3, "quaternions": [[0, 0, 0, 1]] * 2}, "quaternions and yaw_deg both define"),
    ],
)
def test_angles_that_make_no_track(angles, message):
    with pytest.raises(LidarError, match=message):
        Track([0, 1], [[0, 0, 0], [1, 0, 0]], **angles)


def test_rounded_quaternions_are_scaled():
    track = Track([0, 1], np.zeros((2, 3)), [[0, 0, 0.6009, 0.8], [0.6, 0, 0, 0.8]])
    np.testing.assert_allclose(np.linalg.norm(track.quaternions, axis=1), 1, atol=1e-15)
    with pytest.raises(LidarError, match="at least two poses, but has 1"):
        Track.from_matrices(np.zeros(1), np.eye(4)[None, None])
    with pytest.raises(LidarError, match="the time of pose 1 is not after"):
        Track.from_matrices(np.zeros(2), np.tile(np.eye(4), (1, 2, 1, 1)))


class Helix:
    """A trajectory of a user's class, without velocities of its own."""

    stations = 1
    moves = True
    duration_ns = 2e9

    def __init__(self, turns):
        self.turns = turns

    def poses(self, station, times_ns):
        assert (times_ns >= 0).all() and (times_ns <= self.duration_ns).all()
        angle = times_ns / 1e9
        places = np.stack([3 * np.cos(angle), 3 * np.sin(angle), angle], axis=1)
        angles = np.degrees(angle)[:, None] * [0.5, 0, 0] + [0, 0, 30.0]
        return places, rotations_of(angles) if self.turns else None


@pytest.mark.parametrize("turns", [False, True])
def test_velocities_of_other_trajectories_are_quotients(turns):
    at = np.array([0, 0.7, 1.3, 2])
    speeds, rates = velocities(Helix(turns), 0, at * 1e9)
    expected = np.stack([-3 * np.sin(at), 3 * np.cos(at), 0 * at + 1], axis=1)
    np.testing.assert_allclose(speeds[1:3], expected[1:3], atol=1e-6)
    np.testing.assert_allclose(speeds, expected, atol=1e-3)  # on one side at the ends
    np.testing.assert_allclose(rates, np.outer([1] * 4, [0, 0, 0.5 * turns]), atol=1e-6)


def test_poses_and_matrices_are_the_same_rotations():
    rng = np.random.default_rng(6)
    for _ in range(20):
        angles = rng.uniform([-180, -90, -180], [180, 90, 180])
        pose = Pose(rng.normal(size=3), *angles)
        again = Pose.from_rotation(pose.position, pose.rotation)
        np.testing.assert_allclose(
            [*again.position, again.yaw_deg, again.pitch_deg, again.roll_deg],
            [*pose.position, *angles],
        )
        mount = Pose(rng.normal(size=3), *rng.uniform(-80, 80, 3))
        composed = pose.compose(mount)
        np.testing.assert_allclose(composed.rotation, pose.rotation @ mount.rotation, atol=1e-12)
        np.testing.assert_allclose(
            composed.position, pose.position + pose.rotation @ mount.position, atol=1e-12
        )
        assert pose.compose(Pose((0, 0, 0))) is pose
        np.testing.assert_allclose(
            Pose((0, 0, 0)).compose(mount).rotation_matrix, mount.rotation, atol=1e-12
        )


def test_quaternions_are_those_of_the_nearest_rotations():
    """As a singular value decomposition finds them (Kabsch 1976), of rounded matrices."""
    rng = np.random.default_rng(7)
    quaternions = np.concatenate([rng.normal(size=(200, 4)), np.eye(4), -np.eye(4)])
    quaternions /= np.linalg.norm(quaternions, axis=1)[:, None]
    exact = np.array([matrix_of(q) for q in quaternions])
    np.testing.assert_allclose(matrices(quaternions), exact, atol=1e-15)
    rounded = exact + rng.uniform(-5e-4, 5e-4, exact.shape)
    left, _, right = np.linalg.svd(rounded)
    nearest = left @ right
    for given, expected in ((exact, exact), (rounded, nearest)):
        found = quaternions_of(given)
        np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, atol=1e-15)
        np.testing.assert_allclose([matrix_of(q) for q in found], expected, atol=1e-12)


def test_matrices_may_be_rounded_by_a_slack():
    check_rotations(np.eye(3)[None])
    stretched = np.diag([1, 1, np.sqrt(1 + 0.9e-6)])
    check_rotations(stretched[None])
    sheared = np.eye(3)
    sheared[0, 1] = 1.1e-6
    with pytest.raises(LidarError, match="Matrix 1 of a pose deforms"):
        check_rotations(np.array([stretched, sheared]))
    check_rotations(sheared[None], slack=2e-6)

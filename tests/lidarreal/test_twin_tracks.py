"""Tracks of moving objects that turn, brake, meet and are labeled."""

from __future__ import annotations

import numpy as np
import pytest

from lidarfiles.clouds.recorded_boxes import RecordedBoxes
from lidarreal.reconstruction.alignment import Alignment
from lidarreal.reconstruction.motion import Motion
from lidarreal.reconstruction.moving_objects import LabeledTracks, find_tracks
from lidarreal.reconstruction.moving_rays import MovingRays
from lidarreal.reconstruction.object_poses import (
    Shape,
    Sighting,
    adjust_poses,
    register,
    velocities_of,
)
from lidarreal.reconstruction.object_tracks import ObjectTrack, rotate_z

pytest.importorskip("scipy")

SIZE = np.array([4.2, 1.8, 1.5])
PERIOD_S = 0.1
SENSOR = np.array([0.0, 0.0, 1.9])
GROUND_M = -0.1  # below the wheels
COUNT = 360


def surface(rng, count=COUNT):
    """Return points on two sides, the rear and a mirror of a car, in its axes."""
    local = rng.uniform(-0.5, 0.5, (count, 3)) * SIZE + (0, 0, 0.75)
    part = rng.integers(0, 3, count)
    local[part == 0, 1] = -0.9
    local[part == 1, 1] = 0.9
    local[part == 2, 0] = -2.1
    local[:20] = rng.uniform(0.9, 1.1, (20, 3))
    return local


def rays_of(paths, sweeps, seed=2, still_below=0.3):
    """Return rays that end on cars with given paths, and on the ground around them.

    A path returns x, y and the yaw at given times. The points of a sweep are fired one after the
    other. Points that move slower than `still_below`, in m/s, do not count as moved.
    """
    rng = np.random.default_rng(seed)
    parts = []
    for number in range(sweeps):
        columns = []
        for cluster, path in enumerate(paths):
            times_s = PERIOD_S * number + 0.02 * np.sort(rng.random(COUNT))
            x, y, yaw = path(times_s)
            later = path(times_s + 0.01)
            speed = np.hypot(later[0] - x, later[1] - y) / 0.01
            at = np.stack([x, y, 0 * x], axis=1)
            ends = at + rotate_z(surface(rng), yaw)
            moved = speed > still_below
            columns.append((times_s, ends, moved, np.where(moved, cluster, -1)))
            level = at[:80] + np.column_stack(
                [rng.uniform(-4, 4, 80), rng.uniform(-4, 4, 80), np.full(80, GROUND_M)]
            )
            columns.append((times_s[:80], level, np.zeros(80, bool), np.full(80, -1)))
        times_s, ends, moved, cluster = map(np.concatenate, zip(*columns, strict=True))
        ends = ends + rng.normal(0, 0.004, ends.shape)
        count = len(ends)
        parts.append(
            MovingRays(
                np.full(count, number),
                times_s,
                np.tile(SENSOR, (count, 1)),
                ends,
                np.ones(count, bool),
                moved,
                np.zeros(count, np.int64),
                np.full(count, np.nan),
                np.zeros(count, np.int64),
                cluster,
            )
        )
    return MovingRays.concatenate(parts)


def check_track(track, path, times_s, size=SIZE, position_m=0.03, yaw_rad=0.012):
    """Assert that a track follows a path: the middle of the underside, and the direction."""
    positions, yaw = track.poses(times_s)
    x, y, true_yaw = path(times_s)
    np.testing.assert_allclose(np.angle(np.exp(1j * (yaw - true_yaw))), 0, atol=yaw_rad)
    local = rotate_z(positions - np.stack([x, y, 0 * x], axis=1), -true_yaw)
    # The box encloses the mirror on the left.
    expected = np.array([0, 0.1, GROUND_M])
    np.testing.assert_allclose(local[:, :2], np.broadcast_to(expected[:2], (len(x), 2)), atol=0.06)
    np.testing.assert_allclose(local[:, 2], GROUND_M, atol=0.02)
    apart = local - local.mean(axis=0)
    assert np.abs(apart).max() < position_m
    np.testing.assert_allclose(track.size, size + np.array([0, 0.2, -GROUND_M]), atol=0.06)


def turn(sign):
    """Return the path of a car in a curve with a radius of 14 m, at 7 m/s."""

    def path(times_s):
        yaw = 2.4 + sign * 0.5 * np.asarray(times_s)
        return (9 + sign * 14 * (np.sin(yaw) - np.sin(2.4)),
                -8 - sign * 14 * (np.cos(yaw) - np.cos(2.4)), yaw)  # fmt: skip

    return path


@pytest.mark.extended(every=2)
@pytest.mark.parametrize("sign", [1, -1])
def test_a_car_in_a_curve_faces_its_direction_of_travel(sign):
    (track,) = find_tracks(rays_of([turn(sign)], 18), None, PERIOD_S)
    check_track(track, turn(sign), np.arange(0.1, 1.7, 0.1))
    assert not track.stands_before and not track.stands_after
    assert (track.number, track.kind) == (1, "")
    assert (np.diff(track.yaw) * sign > 0).all()


def braking(times_s):
    """Return the path of a car that brakes by 5 m/s² from 6 m/s along -y, and then stands."""
    moving_s = np.minimum(np.asarray(times_s), 1.2)
    return (
        4 + 0 * moving_s,
        12 - 6 * moving_s + 2.5 * np.square(moving_s),
        0 * moving_s - np.pi / 2,
    )


@pytest.mark.extended
def test_a_car_that_stops_stays_where_it_stops():
    (track,) = find_tracks(rays_of([braking], 24), None, PERIOD_S)
    check_track(track, braking, np.arange(0.15, 2.2, 0.1), position_m=0.06, yaw_rad=0.02)
    assert track.stands_after and not track.stands_before
    assert track.times_s[-1] > 2.0
    late = track.poses(np.array([99.0]))[0][0]
    np.testing.assert_allclose(late[:2], (4.1, 12 - 3.6), atol=0.1)
    backward = rays_of([lambda t: braking(2.4 - t)], 24)
    (reverse,) = find_tracks(backward, None, PERIOD_S)
    assert reverse.stands_before and not reverse.stands_after


@pytest.mark.parametrize("is_reversed", [False, True])
def test_a_car_that_stops_behind_another_is_followed(is_reversed):
    """A third of its points is visible from shortly before it stops, or until it has started."""

    def path(times_s):
        return braking(2.0 - times_s) if is_reversed else braking(times_s - 1.0)

    rays = rays_of([path], 30)
    hidden = (rays.sweep < 13) if is_reversed else (rays.sweep >= 17)
    kept = ~hidden | (np.random.default_rng(3).random(len(rays.sweep)) < 0.33)
    (track,) = find_tracks(rays.select(kept), None, PERIOD_S)
    assert track.stands_before == is_reversed and track.stands_after != is_reversed
    assert track.times_s[0] < 0.2 and track.times_s[-1] > 2.8


@pytest.mark.extended
def test_cars_that_meet_are_two_objects_of_their_own_shape():
    def near(times_s):
        return (6 * np.asarray(times_s) - 5, 0 * times_s + 6.0, 0 * times_s)

    def far(times_s):
        return (6 - 8 * np.asarray(times_s), 0 * times_s + 11.5, 0 * times_s + np.pi)

    rays = rays_of([near, far], 16)
    # Some clusters of the second car are recorded in part only.
    kept = (rays.cluster != 1) | (np.random.default_rng(3).random(len(rays.cluster)) < 0.7)
    tracks = find_tracks(rays.select(kept), None, PERIOD_S)
    assert [track.number for track in tracks] == [1, 2]
    check_track(tracks[0], near, np.arange(0.1, 1.4, 0.1))
    check_track(tracks[1], far, np.arange(0.1, 1.4, 0.1))
    assert len(find_tracks(rays.select(rays.cluster != 1), None, PERIOD_S)) == 1


def test_labels_keep_their_place_and_lose_their_noise():
    """Boxes may be larger than the points, and remain in sweeps without points."""
    path = turn(1)
    times_s = PERIOD_S * np.arange(22)
    x, y, yaw = path(times_s)
    random = np.random.default_rng(4)
    noise = random.normal(0, 0.06, (22, 3)) * (1, 1, 0)
    positions = np.stack([x, y, 0 * x + GROUND_M], axis=1) + noise
    label = ObjectTrack(
        9,
        "Van",
        SIZE + np.array([0.3, 0.2, 0.2]),
        times_s,
        positions,
        yaw + random.normal(0, 0.02, 22),
    )
    (found,) = find_tracks(rays_of([path], 14), [label], PERIOD_S)
    assert (found.number, found.kind) == (9, "Van")
    np.testing.assert_array_equal(found.size, label.size)
    inner_s = np.arange(0.1, 1.3, 0.1)
    found_positions, found_yaw = found.poses(inner_s)
    true_x, true_y, true_yaw = path(inner_s)
    apart = found_positions[:, :2] - np.stack([true_x, true_y], axis=1)
    assert np.abs(rotate_z(np.column_stack([apart, 0 * true_x]), -true_yaw)).max() < 0.07
    assert np.abs(found_yaw - true_yaw).max() < 0.03
    # The last sweep with points is at 1.3 s.
    np.testing.assert_allclose(found.times_s[-5:], times_s[-5:])
    np.testing.assert_allclose(found.positions[-5:], label.positions[-5:])
    assert (np.diff(found.times_s) > 0).all()


def pose_of(position, yaw):
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    pose[:3, 3] = position
    return pose


def test_labeled_boxes_are_placed_by_the_poses_of_their_sweeps():
    """Poses are those of the centers in the sensor frame; tracks are those of the undersides."""
    sensor = np.array([pose_of((2.0 * k, -1.0 * k, 0.5), 0.3 * k) for k in range(8)])
    alignment = Alignment(
        sensor, 0.1 * np.arange(8), 0.1, 0.1, Motion.COMPENSATED, np.zeros((1, 3))
    )
    centers = {k: np.array([10 + 0.8 * k, 5 - 0.6 * k, 1.25]) for k in range(10)}
    rows = []
    for k in range(10):
        inverse = np.linalg.inv(sensor[min(k, 7)])
        size = (4.0 + 0.1 * (k == 2), 1.8, 1.5)
        rows.append((k, 7, "Car", inverse @ pose_of(centers[k], 3.0 + 0.1 * k), size))
        parked = pose_of((0, 8 + 0.1 * (k % 2), 1), 0.2)
        rows.append((k, 5, "Truck", inverse @ parked, (8, 2.5, 3)))
    rows.append((3, 2, "Once", np.eye(4), (1, 1, 1)))
    rows.append((3, 7, "Car", np.eye(4), (4, 1.8, 1.5)))  # a second box of the same object
    found = LabeledTracks.from_boxes(RecordedBoxes.from_rows(rows), alignment, np.array([0, 2, 6]))
    (track,) = found.all  # the truck is parked
    assert (track.number, track.kind) == (7, "Car")
    np.testing.assert_allclose(track.size, (4, 1.8, 1.5))
    np.testing.assert_allclose(track.times_s, 0.1 * np.arange(8))
    expected = np.array([centers[k] - (0, 0, 0.75) for k in range(8)])
    np.testing.assert_allclose(track.positions, expected, atol=1e-9)
    np.testing.assert_allclose(track.yaw, 3.0 + 0.1 * np.arange(8), atol=1e-9)
    (mapped,) = found.in_mapped
    np.testing.assert_allclose(mapped.times_s, [0, 0.2, 0.6])
    assert LabeledTracks.from_boxes(None, alignment, np.array([0])) is None


def sighting(pose, velocity, seed, time_s=0.0):
    """Return the points of a car at a pose, fired within 0.04 s."""
    rng = np.random.default_rng(seed)
    times_s = time_s + rng.uniform(-0.02, 0.02, COUNT)
    since_s = (times_s - times_s.mean())[:, None]
    at = pose[:3] + since_s * velocity[:3]
    points = at + rotate_z(surface(rng), pose[3] + since_s[:, 0] * velocity[3])
    return Sighting(float(times_s.mean()), points, times_s, 1.0)


def test_points_in_the_frame_of_an_object_do_not_depend_on_its_motion():
    pose, velocity = np.array([4.0, -3.0, 0.2, 2.0]), np.array([8.0, -5.0, 0.0, 0.9])
    one = sighting(pose, velocity, 1)
    local = one.local(pose, velocity)
    np.testing.assert_allclose(local, sighting(0 * pose, 0 * velocity, 1).points, atol=1e-9)


@pytest.mark.parametrize("change", [(0.12, -0.2, 0.03, 0.02), (-0.1, 0.15, -0.03, -0.03)])
def test_a_sighting_is_registered_to_a_shape(change):
    rng = np.random.default_rng(8)
    shape = Shape.from_points(surface(rng, 4_000))
    pose, velocity = np.array([7.0, 5.0, 0.1, -2.2]), np.array([-6.0, 4.0, 0.0, 0.3])
    one = sighting(pose, velocity, 2)
    found, equations = register(shape, one, pose + change, velocity, np.full(4, 0.5))
    assert (np.abs(found - pose) < (0.005, 0.005, 0.04, 0.001)).all()
    assert equations.matched > 0.95 and equations.residual_m < 0.01
    # A prior that is certain outweighs the points.
    kept, _ = register(shape, one, pose + change, velocity, np.full(4, 1e-5))
    np.testing.assert_allclose(kept, pose + change, atol=1e-3)


def test_velocities_are_derivatives_of_poses():
    times_s = np.array([0.0, 0.1, 0.25, 0.3])
    poses = np.stack([2 * times_s, -times_s, 0 * times_s, 1 + 0.5 * times_s], axis=1)
    np.testing.assert_allclose(velocities_of(times_s, poses), [[2, -1, 0, 0.5]] * 4, atol=1e-12)
    assert not velocities_of(times_s[:1], poses[:1]).any()


@pytest.mark.parametrize("is_labeled", [False, True])
def test_poses_of_all_sweeps_are_adjusted_together(is_labeled):
    """Noisy poses become those of a smooth path. Labels also state the place and the direction."""
    times_s = PERIOD_S * np.arange(12)
    path = turn(-1)
    x, y, yaw = path(times_s)
    truth = np.stack([x, y, 0 * x, yaw], axis=1)
    velocities = velocities_of(times_s, truth)
    sightings = [
        sighting(pose, velocity, k, time_s)
        for k, (pose, velocity, time_s) in enumerate(zip(truth, velocities, times_s, strict=True))
    ]
    truth = np.stack([*path(np.array([one.time_s for one in sightings]))], axis=1)
    truth = np.insert(truth, 2, 0.0, axis=1)
    noise = np.random.default_rng(6).normal(0, (0.1, 0.1, 0.02, 0.02), (12, 4))
    labels = truth + noise if is_labeled else None
    found = adjust_poses(sightings, truth + noise, labels)
    apart = found - truth
    apart[:, :3] = rotate_z(apart[:, :3], -truth[:, 3])
    assert (apart.std(axis=0) < (0.06, 0.02, 0.015, 0.005)).all()
    assert np.abs(apart.mean(axis=0)).max() < 0.1
    if is_labeled:
        assert np.abs(apart.mean(axis=0)[:2]).max() < 0.06


def test_a_sighting_that_stands_is_kept_in_place():
    pose = np.array([3.0, 6.0, 0.0, 0.4])
    sightings = [sighting(pose, 0 * pose, k, 0.1 * k)._replace(moved=0.0) for k in range(8)]
    noise = np.random.default_rng(5).normal(0, (0.015, 0.015, 0.01, 0.003), (8, 4))
    found = adjust_poses(sightings, pose + noise)
    assert np.ptp(found, axis=0).max() < 0.004

"""Parts of a twin's moving objects, each with known values: boxes, rays, clusters, surfels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lidarreal.reconstruction.moving_objects import _on_ground, find_tracks
from lidarreal.reconstruction.moving_rays import MovingRays, box_distances
from lidarreal.reconstruction.object_clusters import (
    ClusterTrack,
    PointCluster,
    bounding_boxes,
    find_clusters,
    track_clusters,
)
from lidarreal.reconstruction.object_surfels import (
    RecordedObject,
    cast_to_objects,
    reconstruct_objects,
)
from lidarreal.reconstruction.object_tracks import ObjectTrack, in_any_box, rotate_z
from lidarreal.reconstruction.recorded_actors import actors_of, class_names
from lidarreal.reconstruction.submap_objects import ObjectMap, ObjectTask
from lidarreal.reconstruction.surface_map import Observations
from lidarreal.reconstruction.surfels import Surfels, surfel_mesh

pytest.importorskip("scipy")

SIZE = np.array([4.0, 2.0, 1.5])


def turning(times_s, **fields):
    """Return a box that drives a left turn, 3 m/s along x at first."""
    yaw = 0.4 * times_s
    positions = np.stack([3 * times_s, 0.5 * times_s**2, 0.1 * times_s], axis=1) + np.array(
        [20, -7, 1]
    )
    return ObjectTrack(3, "Car", SIZE, times_s, positions, yaw, **fields)


def test_a_box_is_where_its_poses_are_and_moves_on_beyond_them():
    times_s = np.arange(0, 2.01, 0.1)
    track = turning(times_s)
    positions, yaw = track.poses(times_s)
    np.testing.assert_allclose(positions, track.positions, atol=1e-9)
    np.testing.assert_allclose(yaw, track.yaw, atol=1e-9)
    between_s = np.array([0.55, 1.25])
    np.testing.assert_allclose(
        track.poses(between_s)[0][:, :2] - (20, -7),
        np.stack([3 * between_s, 0.5 * between_s**2], axis=1),
        atol=2e-3,
    )
    before, after = track.poses(np.array([-0.1, 2.1]))[0]
    np.testing.assert_allclose(before, 2 * track.positions[0] - track.positions[1], atol=1e-9)
    np.testing.assert_allclose(after, 2 * track.positions[-1] - track.positions[-2], atol=1e-9)
    still = turning(times_s, stands_before=True, stands_after=True)
    np.testing.assert_allclose(still.poses(np.array([-9.0, 9.0]))[0], track.positions[[0, -1]])
    assert track.speed_m_s(1.0) == pytest.approx(np.hypot(3, 1), rel=1e-3)
    assert track.distance_m == pytest.approx(np.hypot(6, 2))
    part = track.select(slice(2, 5))
    np.testing.assert_array_equal(part.times_s, times_s[2:5])
    np.testing.assert_array_equal(part.yaw, track.yaw[2:5])
    first_two = track.select(slice(0, 2)).poses(np.array([0.025]))
    np.testing.assert_allclose(
        first_two[0][0], 0.75 * track.positions[0] + 0.25 * track.positions[1]
    )


@pytest.mark.parametrize(("before", "after"), [(True, False), (False, True)])
def test_a_box_is_present_where_it_stands(before, after):
    track = turning(np.array([1.0, 1.1, 1.2]), stands_before=before, stands_after=after)
    times_s = np.array([-50.0, 0.84, 0.86, 1.1, 1.34, 1.36, 50.0])
    expected = [before, before, True, True, True, after, after]
    assert track.is_present(times_s).tolist() == expected


@settings(deadline=None)
@given(
    st.floats(-3, 3),
    st.tuples(st.floats(-2.3, 2.3), st.floats(-1.3, 1.3), st.floats(-0.2, 1.8)),
    st.floats(0.02, 1.9),
)
def test_points_are_in_a_box_wherever_it_is(yaw, local, time_s):
    track = turning(np.arange(0, 2.01, 0.1))
    track = replace(track, yaw=track.yaw + yaw)
    times_s = np.array([time_s])
    positions, angles = track.poses(times_s)
    world = positions + rotate_z(np.array([local]), angles)
    np.testing.assert_allclose(track.to_object(world, times_s), [local], atol=1e-9)
    x, y, z = np.abs(local[0]), np.abs(local[1]), local[2]
    margin_m = min(abs(x - 2.1), abs(y - 1.1), abs(z - 0.05), abs(z - 1.6))
    if margin_m > 1e-6:
        inside = x < 2.1 and y < 1.1 and 0.05 < z < 1.6
        assert in_any_box([track], world, times_s).tolist() == [inside]
        apart = replace(track, positions=track.positions + 99)
        assert in_any_box([apart, track], world, times_s).tolist() == [inside]
    origin = world + np.array([30, -40, 2])
    assert 0 in track.rows_toward(origin, world, times_s, 3.0)
    assert 0 in track.rows_near(world, times_s, 3.0)
    beside = world + np.array([9, 0, 0])
    assert not len(track.rows_near(beside, times_s, 2.0))
    assert not len(track.rows_toward(beside + np.array([0, 50, 0]), beside, times_s, 2.0))
    away = world + np.array([9, 0, 0])
    assert not len(track.rows_toward(away, away + np.array([1, 0, 0]), times_s, 2.0))
    assert not len(track.rows_near(world, times_s + 60, 3.0))


def test_rotations_are_counterclockwise():
    turned = rotate_z(np.array([[2.0, 0, 5], [0, 3, -1]]), np.array([np.pi / 2, -np.pi / 2]))
    np.testing.assert_allclose(turned, [[0, 2, 5], [3, 0, -1]], atol=1e-12)


corners = st.tuples(*[st.floats(-5, 5)] * 3)


@given(corners, st.tuples(*[st.floats(0.1, 4)] * 3), corners, corners)
def test_rays_enter_and_leave_boxes(low, size, origin, direction):
    low, origin, direction = np.array(low), np.array([origin]), np.array([direction])
    direction = np.where(np.abs(direction) < 1e-3, 1e-3, direction)
    high = low + size
    (enter,), (leave,) = box_distances(low, high, origin, direction)
    if enter < leave:
        middle = origin + (enter + leave) / 2 * direction
        assert ((middle > low - 1e-6) & (middle < high + 1e-6)).all()
        for end, step in ((enter, -1e-3), (leave, 1e-3)):
            outside = origin + (end + step) * direction
            assert not ((outside > low + 1e-2) & (outside < high - 1e-2)).all()
    elif enter > leave:
        along = origin + np.linspace(-60, 60, 241)[:, None] * direction
        assert not ((along > low + 1e-9) & (along < high - 1e-9)).all(axis=1).any()


def cluster(low, high, points=9):
    return PointCluster(np.array(low, float), np.array(high, float), points)


def test_clusters_move_as_the_part_that_stays_visible():
    before = cluster((0, 0, 0), (4, 2, 1.5))
    np.testing.assert_allclose(before.center, (2, 1, 0.75))
    more_ahead = cluster((0.5, 0, 0), (5.5, 2, 1.5))
    np.testing.assert_allclose(more_ahead.offset_from(before), (0.5, 0, 0))
    less_behind = cluster((3, 0.1, 0), (4.5, 2.1, 1.5))
    np.testing.assert_allclose(less_behind.offset_from(before), (0.5, 0.1, 0))
    whole = cluster((-0.2, 1, 0), (5.4, 1.5, 1.5))
    np.testing.assert_allclose(whole.offset_from(before), (0.6, 0.25, 0))
    assert more_ahead.distance_m(before) == pytest.approx(1.0)
    assert cluster((3, 4, 100), (7, 6, 101)).distance_m(before) == pytest.approx(5)


def test_bounding_boxes_are_those_of_the_points_of_each_cluster():
    points = np.array([[0.0, 5, 1], [9, 9, 9], [2, 3, 4], [-1, -2, -3], [1, 1, 1]])
    boxes = bounding_boxes(points, np.array([2, -1, 2, 0, 0]))
    assert {number: box.points for number, box in boxes.items()} == {0: 2, 2: 2}
    np.testing.assert_array_equal(boxes[0].low, (-1, -2, -3))
    np.testing.assert_array_equal(boxes[0].high, (1, 1, 1))
    np.testing.assert_array_equal(boxes[2].low, (0, 3, 1))
    np.testing.assert_array_equal(boxes[2].high, (2, 5, 4))
    assert bounding_boxes(points, np.full(5, -1)) == {}


def observations(paths, sweeps=8, period_s=0.1):
    """Return clusters on given paths, each of which is a function of the time."""
    observed = []
    for number in range(sweeps):
        time_s = period_s * number
        boxes = {}
        for index, path in enumerate(paths):
            place = path(time_s)
            if place is not None:
                at = np.array([*place, 0.0])
                boxes[10 * number + index] = PointCluster(at, at + np.array([4, 2, 1.5]), 20)
        observed.append((number, time_s, boxes))
    return observed


def test_clusters_that_pass_each_other_are_two_objects():
    paths = [lambda t: (10 * t, 0.0), lambda t: (8 - 12 * t, 3.5)]
    found = track_clusters(observations(paths), 0.1)
    assert len(found) == 2
    for track, speed in zip(sorted(found, key=lambda one: one.path[0, 0]), (10, -12), strict=True):
        assert track.sweeps == [*range(8)]
        np.testing.assert_allclose(np.diff(track.path[:, 0]), 0.1 * speed, atol=1e-9)
        assert track.points == 160
    assert sorted(found[0].indices + found[1].indices) == [
        10 * number + index for number in range(8) for index in (0, 1)
    ]


@pytest.mark.parametrize(("missing", "count"), [(4, 1), (5, 2)])
def test_objects_are_lost_after_five_sweeps_without_them(missing, count):
    def path(time_s):
        is_hidden = 0.35 < time_s < 0.35 + 0.1 * missing
        return None if is_hidden else (10 * time_s, -2.0)

    found = track_clusters(observations([path], 4 + missing + 4), 0.1)
    assert [len(track.clusters) for track in found] == ([8] if count == 1 else [4, 4])


def test_clusters_that_sway_or_stand_do_not_move():
    swaying = observations([lambda t: (0.0, 1.2 * np.sin(31 * t))], 12)
    assert not track_clusters(swaying, 0.1)
    assert not track_clusters(observations([lambda t: (1.2 * t, 0.0)], 8), 0.1)  # 0.84 m
    assert track_clusters(observations([lambda t: (0.0, -1.5 * t)], 8), 0.1)  # 1.05 m
    assert not track_clusters(observations([lambda t: (20 * t, 0.0)], 3), 0.1)


def test_an_object_that_jumps_is_another_one():
    """The second observation may be 40 m/s away, and the next ones are where they are expected."""
    track = ClusterTrack()
    track.append(0, 0.0, cluster((0, 0, 0), (4, 2, 1.5)), 0)
    near = cluster((3.0, 0, 0), (7.0, 2, 1.5))
    assert track.cost(0.1, near) == pytest.approx(0.25 * 3)
    grown = cluster((3.0, 0, 0), (8.0, 2, 1.5))
    assert track.cost(0.1, grown) == pytest.approx(0.25 * 3 + 0.1 * 1)
    assert track.cost(0.1, cluster((6.6, 0, 0), (10.6, 2, 1.5))) > 100
    track.append(1, 0.1, near, 0)
    assert track.cost(0.2, cluster((6.0, 0.4, 0), (10.0, 2.4, 1.5))) == pytest.approx(0.4)
    assert track.cost(0.2, cluster((6.0, 2.0, 0), (10.0, 4.0, 1.5))) > 100
    assert track.cost(0.2, near) > 100


def side(along, across, height, spacing=0.1):
    """Return a grid of points on an upright, rectangular face along x."""
    x, z = np.meshgrid(np.arange(*along, spacing), np.arange(*height, spacing))
    return np.column_stack([x.ravel(), np.full(x.size, across), z.ravel()])


def test_clusters_of_two_objects_stay_apart_from_each_other_and_from_walls():
    first, second = side((0, 3), -4.0, (0.4, 1.6)), side((0, 3), -6.0, (0.4, 1.6))
    wall = side((-8, 12), -9.0, (0.4, 3.0))
    few = side((6, 6.15), 3.0, (1.0, 1.15))  # 4 points
    x, y = np.meshgrid(np.arange(-9, 13, 0.5), np.arange(-11, 5, 0.5))
    ground = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    parts = [first, second, few, wall, ground]
    points = np.concatenate(parts)
    moved = np.concatenate([np.full(len(part), index < 3) for index, part in enumerate(parts)])
    moved[-len(ground) - len(wall) : -len(ground)] = wall[:, 0] < -7.65
    number = find_clusters(points, moved)
    one, other = number[: len(first)], number[len(first) :][: len(second)]
    assert len(set(one.tolist())) == len(set(other.tolist())) == 1
    assert one[0] != other[0] and min(one[0], other[0]) >= 0
    walled = number[-len(ground) - len(wall) : -len(ground)]
    # Only a part of the wall seems to move, which does not make all of it an object.
    assert (walled[wall[:, 0] > -7] == -1).all()
    assert (number[-len(ground) :] == -1).all()
    assert (number[len(first) + len(second) :][: len(few)] == -1).all()
    long = side((0, 25), 2.0, (0.4, 1.6))
    assert (find_clusters(long, np.ones(len(long), bool)) == -1).all()


SENSOR = np.array([0.0, 0.0, 2.0])


def box_sides(sweeps=8, hole=True):
    """Return a box that drives by, and rays to its side. Rays through a hole end on a wall."""
    random = np.random.default_rng(3)
    parts = []
    path = np.array([[-3.0, 7.0, 0], [0.2 * sweeps - 3.0, 7.0, 0]])
    track = ObjectTrack(5, "Van", SIZE, np.array([0.0, 0.1 * sweeps]), path, np.zeros(2))
    for number in range(sweeps):
        count = 2_500
        local = random.uniform(-0.5, 0.5, (count, 3)) * SIZE + (0, 0, 0.75)
        local[:, 1] = -1.0  # the side toward the sensor
        times_s = np.full(count, 0.1 * number)
        position = track.poses(times_s)[0]
        on_side = position + local
        in_hole = (np.abs(local[:, 0] - 0.9) < 0.5) & (np.abs(local[:, 2] - 0.9) < 0.35) & hole
        through = SENSOR + (on_side - SENSOR) * (16 / on_side[:, 1])[:, None]
        parts.append(
            MovingRays(
                np.full(count, number),
                times_s,
                np.tile(SENSOR, (count, 1)),
                np.where(in_hole[:, None], through, on_side),
                np.ones(count, bool),
                ~in_hole,
                np.full(count, 7),
                np.where(in_hole, np.nan, 0.5),
                np.where(in_hole, 0, 9),
                np.where(in_hole, -1, 0),
            )
        )
    return track, MovingRays.concatenate(parts)


def test_holes_in_the_side_of_an_object_remain_and_the_rest_is_closed():
    track, rays = box_sides()
    (found,) = reconstruct_objects([track], rays, 0.2, np.radians(0.5))
    assert (found.label, found.sweeps) == (9, 8)
    assert set(found.observations.ring.tolist()) == {7}
    np.testing.assert_allclose(found.observations.intensity, 0.5)
    grid = side((-1.9, 1.95), -1.0, (0.15, 1.4), 0.05)
    in_hole = (np.abs(grid[:, 0] - 0.9) < 0.4) & (np.abs(grid[:, 2] - 0.9) < 0.25)
    around = (np.abs(grid[:, 0] - 0.9) < 0.65) & (np.abs(grid[:, 2] - 0.9) < 0.5)
    time_s = 0.45
    position = track.poses(np.array([time_s]))[0][0]
    ends = grid + position
    hits = cast_to_objects(
        [found], np.tile(SENSOR, (len(grid), 1)), ends, np.full(len(grid), time_s)
    )
    hit = np.isfinite(hits.distance_m)
    assert hit[~around].mean() > 0.99
    assert hit[in_hole].mean() < 0.1
    # Hits are on the side, at its incidence.
    vectors = ends - SENSOR
    length_m = np.linalg.norm(vectors, axis=1)
    np.testing.assert_allclose(hits.distance_m[hit], length_m[hit], atol=0.02)
    expected = np.abs(vectors[:, 1]) / length_m
    assert np.median(np.abs(hits.cosine[hit] - expected[hit])) < 0.02
    assert (hits.object[hit] == 0).all() and (hits.object[~hit] == -1).all()
    normals = found.surfels.normals[hits.surfel[hit]]
    assert np.median(normals[:, 1]) < -0.99, "the front is toward the sensor"
    centers = found.surfels.centers[hits.surfel[hit]]
    assert np.abs(centers - grid[hit]).max() < 0.4
    whole, rays = box_sides(hole=False)
    (closed,) = reconstruct_objects([whole], rays, 0.2, np.radians(0.5))
    again = cast_to_objects(
        [closed], np.tile(SENSOR, (len(grid), 1)), ends, np.full(len(grid), time_s)
    )
    assert np.isfinite(again.distance_m).mean() > 0.99


@pytest.mark.parametrize("is_labeled", [True, False])
def test_labeled_objects_keep_their_tracks_without_points(is_labeled):
    """A labeled box without points has no object. Points inside it are left out of the scene."""
    track, rays = box_sides()
    apart = replace(track, number=6, positions=track.positions + np.array([40.0, 0, 0]))
    found = ObjectMap.from_task(
        ObjectTask(rays, [apart, track] if is_labeled else None, 0.1, 0.2, np.radians(0.5))
    )
    if is_labeled:
        assert [one.number for one in found.tracks] == [6, 5]
        assert [one.track.number for one in found.objects] == [5]
    else:
        assert len(found.tracks) == len(found.objects)
    inside = found.between(np.array([0.35]))
    assert len(inside.tracks) == len(found.tracks)


def ground_around(track, heights, count=400):
    """Return stationary returns around a box, in the frame of the box, and at its first time."""
    random = np.random.default_rng(5)
    x, y = random.uniform(-2.9, 2.9, (2, count))
    beside = (np.abs(x) > 2) | (np.abs(y) > 1)
    local = np.column_stack([x, np.clip(y, -1.9, 1.9), random.choice(heights, count)])[beside]
    positions, yaw = track.poses(np.zeros(len(local)))
    nothing = np.zeros(len(local), int)
    return MovingRays(
        nothing,
        np.zeros(len(local)),
        np.tile(SENSOR, (len(local), 1)),
        positions + rotate_z(local, yaw),
        np.ones(len(local), bool),
        np.zeros(len(local), bool),
        nothing,
        np.full(len(local), np.nan),
        nothing,
        nothing - 1,
    )


@pytest.mark.parametrize(
    ("heights", "expected_m"),
    [
        ([-0.3], 0.3),  # the ground is below the lowest points
        ([0.2], 0.0),  # a box is never raised
        ([-0.3, 0.8], 0.3),  # a wall beside the object is not the ground
        ([-0.3, -0.8], 0.3),  # neither is a ditch
        ([-0.3, -0.3, -0.3, 0.3], 0.3),  # the ground is a low quantile
    ],
)
def test_boxes_reach_the_ground_around_them(heights, expected_m):
    at = np.array([4.0, -7.0, 1.5])
    track = ObjectTrack(1, "", SIZE, np.array([0.0, 1]), at + np.zeros((2, 3)), np.full(2, 0.7))
    found = _on_ground(track, ground_around(track, heights))
    np.testing.assert_allclose(
        (track.positions - found.positions)[1], [0, 0, expected_m], atol=1e-9
    )
    np.testing.assert_allclose(found.size - SIZE, [0, 0, expected_m], atol=1e-9)
    rays = ground_around(track, heights)
    # Too few returns do not determine it.
    assert _on_ground(track, rays.select(slice(0, 19))) is track
    same = ground_around(track, heights[:1])
    assert _on_ground(track, same.select(slice(0, 20))).size[2] - SIZE[2] == pytest.approx(
        max(-heights[0], 0)
    )
    # Neither do lost pulses, moving points, the object itself, and what is farther away.
    lower = same._replace(ends=same.ends - [0, 0, 0.1])
    local = rotate_z(same.ends - at, np.full(len(same.sweep), -0.7))
    on_object = at + rotate_z(local * [0.55, 0.5, 1.4], np.full(len(local), 0.7))
    beyond = at + rotate_z(local * [1, 3, 1.4], np.full(len(local), 0.7))
    beyond = np.where(np.abs(local[:, 1:2] * 3) > 2.1, beyond, on_object)
    for others in (
        lower._replace(returned=np.zeros(len(local), bool)),
        lower._replace(moved=np.ones(len(local), bool)),
        lower._replace(ends=on_object),
        lower._replace(ends=beyond),
    ):
        found = _on_ground(track, MovingRays.concatenate([same, others]))
        assert found.size[2] - SIZE[2] == pytest.approx(max(-heights[0], 0))


def plate(x, size=1.0, dark=False):
    """Return an upright square surfel at x that faces -x."""
    half = size / 2
    square = [(x, half, -half), (x, -half, -half), (x, -half, half), (x, half, half)]
    return Surfels(surfel_mesh("plate", np.array([square], float)), np.array([dark]))


def standing(x, kind, label=0, number=1):
    """Return an object that stands at x, and is a plate of 1 m 0.5 m behind its origin."""
    track = ObjectTrack(number, kind, np.array([2.0, 2.0, 2.0]), np.array([1.0, 2.0]),
                        np.array([[x, 0, -1.0]] * 2, float), np.zeros(2), True, True)  # fmt: skip
    nothing = np.empty(0)
    observed = Observations(nothing, nothing, nothing, nothing, nothing)
    surfels = plate(0.5)
    raised = replace(surfels.mesh, vertices=surfels.mesh.vertices + np.array([0, 0, 1.0]))
    return RecordedObject(track, Surfels(raised, surfels.dark), observed, label, 2)


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_the_nearest_of_several_objects_is_hit(order):
    objects = [standing((8.0, 14.0)[index], "") for index in order]
    origins = np.array([[0.0, 0, 0], [0, 0, 0], [0, 0, 0], [11, 0.2, 0.1]])
    ends = origins + np.array([[2.0, 0.01, 0.01], [0, 3, 0], [-5, 0, 0], [1, 0, 0]])
    hits = cast_to_objects(objects, origins, ends, np.zeros(4))
    near = order.index(0)
    assert hits.object.tolist() == [near, -1, -1, 1 - near]
    assert hits.surfel.tolist() == [0, -1, -1, 0]
    distances_m = [8.5 * np.hypot(1, 0.005 * np.sqrt(2)), np.inf, np.inf, 3.5]
    np.testing.assert_allclose(hits.distance_m, distances_m, rtol=1e-6)
    np.testing.assert_allclose(hits.cosine, [1, 0, 0, 1], atol=1e-4)


def test_surfels_are_moved_along_their_normals_and_cut_along_their_sides():
    surfels = plate(5.0, 2.0)
    np.testing.assert_allclose(surfels.normals, [[-1, 0, 0]], atol=1e-12)
    moved = surfels.shift_along_normals(np.array([0.25]))
    np.testing.assert_allclose(moved.centers, [[4.75, 0, 0]])
    along, across = surfels.half_sides[:, 0]
    np.testing.assert_allclose([along, across], [(0, -1, 0), (0, 0, 1)])
    cut = surfels.resize(np.array([[-0.5, 0.0]]), np.array([[1.0, 0.5]]))
    np.testing.assert_allclose(cut.mesh.vertices.min(axis=0), (5, -1, 0))
    np.testing.assert_allclose(cut.mesh.vertices.max(axis=0), (5, 0.5, 0.5))
    np.testing.assert_allclose(cut.normals, surfels.normals)
    both = surfels.with_dark(plate(7.0))
    assert both.dark.tolist() == [False, True]
    np.testing.assert_allclose(both.centers, [[5, 0, 0], [7, 0, 0]])
    (kept,) = both.select(np.array([False, True])).centers
    np.testing.assert_allclose(kept, (7, 0, 0))
    assert both.select(np.array([False, True])).dark.tolist() == [True]


def test_actors_are_named_and_numbered_by_kind_and_class():
    """Labels hold the class, and classes of boxes without one follow all known numbers."""
    objects = [
        standing(1, "Car"), standing(2, "", label=4), standing(3, ""), standing(4, "car"),
        standing(5, "Tram_car"), standing(6, "Car"), standing(7, "Tram car"),
    ]  # fmt: skip
    names = {4: "person", 6: "Car"}
    meshes = [one.surfels.mesh for one in objects]
    actors = actors_of(objects, meshes, names, (0.0, 9.0), 0.1)
    assert [actor.name for actor in actors] == [
        "Car 1", "person 1", "Moving object 1", "car 1", "Tram car 1", "Car 2", "Tram car 2",
    ]  # fmt: skip
    assert [actor.class_number for actor in actors] == [6, 4, None, 6, 7, 6, 7]
    assert class_names(actors)[7] == "Tram car"
    np.testing.assert_allclose(actors[4].positions[:, 0], 5)


@pytest.mark.parametrize(
    ("stands", "span_s", "expected"),
    [
        ((False, False), (0.0, 9.0), (0.95, 2.05)),
        ((True, False), (0.0, 9.0), (0.0, 2.05)),
        ((False, True), (0.0, 9.0), (0.95, 9.0)),
        ((True, True), (1.0, 2.0), (0.999, 2.001)),
    ],
)
def test_actors_are_present_from_their_first_to_their_last_time(stands, span_s, expected):
    one = standing(1, "Car")
    track = replace(
        one.track,
        times_s=np.array([1.0, 1.25, 2.0]),
        positions=np.array([[1.0, 0, -1], [1.5, 0.5, -1], [3.0, 2, -1]]),
        yaw=np.zeros(3),
        stands_before=stands[0],
        stands_after=stands[1],
    )
    (actor,) = actors_of([replace(one, track=track)], [one.surfels.mesh], {}, span_s, 0.1)
    np.testing.assert_allclose(actor.times_s, [expected[0], 1.0, 1.25, 2.0, expected[1]])
    # The object moves by (2, 2) m/s. If it is not stationary, it continues for half a period.
    first = actor.positions[0] - track.positions[0]
    last = actor.positions[-1] - track.positions[-1]
    np.testing.assert_allclose(first, [0, 0, 0] if stands[0] else [-0.1, -0.1, 0], atol=1e-9)
    np.testing.assert_allclose(last, [0, 0, 0] if stands[1] else [0.1, 0.1, 0], atol=1e-9)


def test_labels_of_objects_without_returns_are_kept():
    """A box that no ray enters stays where its label is."""
    track, rays = box_sides(4)
    elsewhere = replace(track, positions=track.positions + np.array([0, 60, 0]))
    (found,) = find_tracks(rays, [elsewhere], 0.1)
    np.testing.assert_array_equal(found.positions, elsewhere.positions)

"""Visibility of actors: every ray by brute force, fields of view, and batches."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from tests.lidarscenes.test_scene_flow import straight, turning
from tests.shapes import block, level, wall

from lidarsim import Actor, Mounted, Pose, Scene, Sensor, Survey, box, load_sensor
from lidarsim.casting.actor_visibility import FieldOfView
from lidarsim.columns.actor_rays import merge_actor_rays
from lidarsim.motion.trajectory import full_poses
from lidarsim.simulator.points.batch_columns import columns_of
from lidarsim.simulator.rig import Rig
from lidarsim.survey.faults import Fault
from lidarsim.sweeps.sweeps import Sweeps

SENSOR = Sensor.grid(180, 10, 30.0, step_deg=90, min_range_m=1.0, max_range_m=60.0)
MOUNT = Pose((0.5, 0.2, 0.3), 30.0, 8.0)


def records_of(scene, survey, cuts=None, backend="numpy"):
    """The table of all actors and sweeps, from batches between the cuts."""
    rig = Rig(scene, survey, backend)
    cuts = cuts or [0, survey.scan_count]
    parts = [columns_of(list(rig.cast(*span))).actor_rays for span in pairwise(cuts)]
    return merge_actor_rays(parts, len(scene.actors), survey.sweep_count)


def distances(origins, directions, corners):
    """Distances (n,) at which rays meet triangles (n, f, 3, 3); inf for none."""
    a, b, c = corners.transpose(2, 0, 1, 3)
    edge_1, edge_2 = b - a, c - a
    across = np.cross(directions[:, None], edge_2)
    size = (edge_1 * across).sum(axis=2)
    away = origins[:, None] - a
    u = (away * across).sum(axis=2) / size
    other = np.cross(away, edge_1)
    v = (directions[:, None] * other).sum(axis=2) / size
    t = (edge_2 * other).sum(axis=2) / size
    inside = (u >= 0) & (v >= 0) & (u + v <= 1) & (t >= 1.0) & (t <= 60.0)
    return np.where(inside, t, np.inf).min(axis=1)


def nearest_to_box(origins, directions, half):
    """Smallest distance between a box around the origin and segments of rays, by ternary search."""
    lower, upper = np.full(len(origins), 1.0), np.full(len(origins), 60.0)

    def away(t):
        points = origins + t[:, None] * directions
        return np.linalg.norm(np.maximum(np.abs(points) - half, 0), axis=1)

    for _ in range(120):
        first, second = lower + (upper - lower) / 3, upper - (upper - lower) / 3
        left = away(first) <= away(second)
        lower, upper = np.where(left, lower, first), np.where(left, second, upper)
    return away(lower).min()


def street():
    """Cars behind a fence and in view, one that leaves, and small ones between the rays."""
    actors = [
        Actor(box("Car 1", (4.5, 2.0, 1.5)), straight((3, 8, -1), (-6, 0, 0))),
        Actor(box("Car 2", (4.5, 2.0, 1.5)), straight((12, 6, -1), (0, -9, 0))),
        Actor(block("Turning", (5, 1, 2), (6, 0, 0)), turning(0.0, 1.0)),
        Actor(box("Leaving", (2, 2, 2)), straight((-9, 0, -1), (0, 3, 0), 0.16, beyond="absent")),
        Actor(box("Far", (1, 1, 1)), straight((59, 0, 30), (0, 1, 0))),
        Actor(box("Ball", (0.1, 0.2, 0.1)), straight((14, -8, 1), (0, 1, 0))),
        Actor(box("Bird", (0.2, 0.1, 0.1)), turning(16.0, -0.2)),
    ]
    fence = wall("Fence", 9, (3, 7), (-1, 1))
    return Scene.from_meshes([level("Ground", -1), fence]).with_actors(actors)


@pytest.mark.extended
def test_counts_and_distances_by_brute_force():
    scene = street()
    path = turning(2.0, 1.5)
    survey = Survey(
        sensors=[Mounted(SENSOR, MOUNT)], trajectory=path, steps=10, actor_visibility=True
    )
    table = records_of(scene, survey)
    firings = np.arange(survey.scan(9).firings[1])
    times_ns = SENSOR.times_ns(firings).astype(float).ravel()
    places, turns = full_poses(path, 0, times_ns)
    turns = turns @ MOUNT.rotation_matrix
    directions = np.einsum("nij,nj->ni", turns, SENSOR.directions(firings).reshape(-1, 3))
    origins = places + np.einsum("nij,j->ni", full_poses(path, 0, times_ns)[1], MOUNT.position)
    starts = survey.sweeps_each[0].starts_ns
    sweep = np.searchsorted(starts, times_ns, "right") - 1
    static = np.broadcast_to(scene.vertices[scene.faces], (len(origins), len(scene.faces), 3, 3))
    first = distances(origins, directions, static)
    alone = np.full((len(scene.actors), len(origins)), np.inf)
    for number, actor in enumerate(scene.actors):
        last_ns = 1.6e8 if actor.name == "Leaving" else np.inf
        there = np.flatnonzero(times_ns <= last_ns)
        place, turn = full_poses(actor.trajectory, 0, times_ns[there])
        inside = np.einsum("nji,nj->ni", turn, origins[there] - place)
        toward = np.einsum("nji,nj->ni", turn, directions[there])
        corners = actor.mesh.vertices[actor.mesh.faces]
        corners = np.broadcast_to(corners, (len(there), *corners.shape))
        alone[number, there] = distances(inside, toward, corners)
    order = np.argmin(alone, axis=0)
    seen = (alone.min(axis=0) < first) & np.isfinite(alone.min(axis=0))
    for number, actor in enumerate(scene.actors):
        for k in range(3):
            of_sweep = sweep == k
            record = table[number, k]
            assert record["rays"] == np.isfinite(alone[number, of_sweep]).sum(), actor.name
            assert record["visible"] == (seen & (order == number) & of_sweep).sum(), actor.name
            present = actor.name != "Leaving" or starts[k] <= 1.6e8
            assert np.isfinite(record["truncated"]) == present
            if record["rays"] or not present:
                continue
            place, turn = full_poses(actor.trajectory, 0, starts[[k]])
            center = place[0] + turn[0] @ actor.bounds.mean(axis=0)
            half = np.ptp(actor.bounds, axis=0) / 2
            expected = nearest_to_box(
                (origins[of_sweep] - center) @ turn[0], directions[of_sweep] @ turn[0], half
            )
            assert record["nearest_m"] == pytest.approx(expected, abs=2e-5)
    between = table[5:][table["rays"][5:] == 0]
    assert ((between["nearest_m"] > 0) & (between["nearest_m"] < 1)).sum() >= 3
    rays, visible = table["rays"], table["visible"]
    assert (0 < visible[1, 0] < rays[1, 0]) and visible[0].sum() > 20  # behind the fence, or seen
    assert not rays[4].any() and (table["nearest_m"][4] > 1).all()
    assert rays[3, 1] > 0 and np.isnan(table["nearest_m"][3, 2])


def test_records_do_not_depend_on_batches_or_backends():
    scene = street()
    survey = Survey(
        sensors=[Mounted(SENSOR, MOUNT, "one"), Mounted(SENSOR, Pose((1, 0, 1)), "two")],
        trajectory=turning(2.0, 1.5), steps=10, actor_visibility=True,
    )  # fmt: skip
    whole = records_of(scene, survey)
    assert whole.shape == (7, 6)
    cut = records_of(scene, survey, [0, 1, 3, 9, 13, 14, 20], "tiles")
    assert cut.tobytes() == whole.tobytes()


def test_truncation_is_the_part_of_a_box_outside_the_field_of_view():
    sensor = Sensor.grid(181, 21, 40.0, step_deg=360, max_range_m=30.0, horizontal_fov_deg=180.0)
    boxes = {
        "inside": (10, 0, -0.5), "half to the right": (0, -10, -0.5), "behind": (-10, 0, -0.5),
        "half out of range": (30, 0, -0.5), "above": (2, 0, 10),
    }  # fmt: skip
    actors = [Actor(box(name, (1, 1, 1)), straight(at, (0, 0, 1e-9))) for name, at in boxes.items()]
    scene = Scene.from_meshes([level("Ground", -5)]).with_actors(actors)
    survey = Survey(sensor, poses=[(0, 0, 0)], steps=1, actor_visibility=True)
    truncated = records_of(scene, survey)["truncated"][:, 0]
    np.testing.assert_allclose(truncated, [0, 0.5, 1, 0.5, 1], atol=0.01)


def test_fields_of_view():
    around = FieldOfView.from_sensor(SENSOR)
    assert around.azimuth == (0, 2 * np.pi) and around.range_m == (1.0, 60.0)
    np.testing.assert_allclose(np.degrees(around.elevation), [-15, 15])
    ahead = FieldOfView.from_sensor(Sensor.grid(100, 5, 20.0, horizontal_fov_deg=90.0))
    start, width = np.degrees(ahead.azimuth)
    assert start == pytest.approx(315, abs=1) and width == pytest.approx(90, abs=1)
    points = np.array([[10.0, 9, 0], [10, 11, 0], [10, -9, 0], [-10, 0, 0], [10, 0, 2]])
    assert ahead.contains(points).tolist() == [True, False, True, False, False]


def test_objects_that_a_sensor_cannot_see_and_surveys_without_the_option(tmp_path):
    scene = street()
    hood = Mounted(SENSOR, MOUNT, unseen=["Car 1"])
    survey = Survey(sensors=[hood], poses=[(0, 0, 0)], steps=4, actor_visibility=True)
    table = records_of(scene, survey)
    assert not table["rays"][0].any() and np.isnan(table["truncated"][0]).all()
    plain = replace(survey, actor_visibility=False)
    assert not len(columns_of(list(Rig(scene, plain, "numpy").cast(0, 4))).actor_rays)
    sweeps = Sweeps.from_survey(survey, scene)
    sweeps.save(tmp_path / "without.npz")
    assert Sweeps.load(tmp_path / "without.npz").actor_rays.size == 0
    seen = replace(sweeps, actor_rays=table)
    seen.save(tmp_path / "with.npz")
    assert Sweeps.load(tmp_path / "with.npz").actor_rays.tobytes() == table.tobytes()


def test_a_frozen_sensor_repeats_its_records():
    scene = street()
    survey = Survey(
        SENSOR, poses=[(0, 0, 0)], steps=12, actor_visibility=True,
        faults=[Fault("frozen", from_s=0.05, to_s=0.15)],
    )  # fmt: skip
    table = records_of(scene, survey)
    np.testing.assert_array_equal(table["rays"][:, 0], table["rays"][:, 1])
    assert (table["rays"][:, 2] != table["rays"][:, 0]).any()


@pytest.mark.extended
def test_many_rays_are_cast_in_chunks_with_the_same_result():
    scene = street()
    sensor = load_sensor("ouster/os1-64")
    survey = Survey(sensor, trajectory=turning(2.0, 1.5), steps=108, actor_visibility=True)
    assert survey.ray_count > 1 << 17  # more than a chunk
    whole = records_of(scene, survey, backend="tiles")
    by_sweep = records_of(scene, survey, [0, 36, 72, 108], backend="tiles")
    assert by_sweep.tobytes() == whole.tobytes()
    assert (whole["rays"].sum(axis=0) > 1000).all()

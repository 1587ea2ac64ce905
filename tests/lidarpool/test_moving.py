"""What a carrier on the move gives: points that are skewed, and what puts them right."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.shapes import level, made, quad

from lidarpool.run.job_source import input_fingerprints
from lidarscenario import Job
from lidarsim import (
    Actor,
    LidarError,
    Material,
    Mounted,
    Noise,
    Pose,
    Returns,
    Scene,
    Survey,
    Track,
    box,
    load_sensor,
)
from lidarsim.numerics.vectors import rotate_into_frames
from lidarsim.simulator.rig import Rig
from lidarsim.sweeps.sweep_motion import interpolate_poses
from raybeam import moving_loops

WALL_M = 8.0
PRECISION_M = 0.001
SECONDS = np.linspace(0, 0.5, 6)
# 20 m/s, and 30 degrees a second to the left.
DRIVE = Track(
    SECONDS,
    np.stack([20 * SECONDS, 0 * SECONDS, 2 + 0 * SECONDS], axis=1),
    np.stack(
        [0 * SECONDS, 0 * SECONDS, *(f(np.radians(15) * SECONDS) for f in (np.sin, np.cos))], 1
    ),
)
MOUNT = Pose((1.2, 0.1, 0.4), 20, 5, -3)


def stored_positions(columns, precision_m=PRECISION_M):
    return np.stack([columns[axis] for axis in "xyz"], axis=1) * precision_m


@pytest.fixture(scope="module")
def wall():
    y = WALL_M
    corners = (-500, y, -50), (500, y, -50), (500, y, 90), (-500, y, 90)
    return Scene.from_meshes([quad("Wall", *corners)])


def test_poses_between_knots_are_on_straight_lines():
    angles = np.array([0, 0.4, 1.0])
    axis = np.array([2, -1, 2]) / 3
    quaternions = [[*np.sin(angle / 2) * axis, np.cos(angle / 2)] for angle in angles]
    path = np.array([[0, 0, 0], [1, 2, 0.5], [2, 2.5, -1]])
    knots = np.concatenate([path, quaternions], axis=1).astype(np.float32)
    mount = Rotation.from_euler("zyx", [30, -20, 10], degrees=True)
    start = np.array([10.0, -5.0, 2.0])
    shares = np.array([-0.1, 0, 0.2, 0.5, 0.7, 1, 1.3])
    poses = interpolate_poses(knots, start, mount.as_matrix(), shares)
    points = np.random.default_rng(1).normal(size=(len(shares), 3)) * 9
    for number, share in enumerate(shares):  # before the first and after the last, extrapolated
        first = 0 if share < 0.5 else 1
        part = 2 * share - first
        mean = knots[first] + part * (knots[first + 1].astype(float) - knots[first])
        turn = Rotation.from_quat(mean[3:])  # normalized
        position = start + mean[:3]
        np.testing.assert_allclose(poses.positions[number], position)
        np.testing.assert_allclose(poses.quaternions[:, number], turn.as_quat())
        np.testing.assert_allclose(poses.steps[:, number], path[first + 1] - path[first])
        in_world = (mount * turn).apply(points[number]) + position
        np.testing.assert_allclose(poses.to_world(points)[number], in_world)
        in_sensor = (mount * turn).inv().apply(points[number] - position)
        np.testing.assert_allclose(poses.to_body_frame(points)[number], in_sensor)
    still = interpolate_poses(knots[:1], start, mount.as_matrix(), shares)
    np.testing.assert_allclose(still.to_world(points), mount.apply(points) + start)
    np.testing.assert_allclose(still.to_body_frame(points), mount.inv().apply(points - start))


@pytest.mark.extended(every=3)
@pytest.mark.parametrize("model", ["velodyne/vlp16", "velodyne/hdl64e-s2", "ouster/os0-32"])
def test_raw_points_are_off_by_meters_and_deskewed_ones_on_the_wall(wall, model):
    sensor = load_sensor(model, max_range_m=30)
    common = {"trajectory": DRIVE, "keep_every": 1, "precision_m": PRECISION_M, "columns": ["time"]}
    common["sensors"] = [Mounted(sensor, MOUNT)]
    raw = made(Survey(coordinates="sensor", **common), wall)
    world = made(Survey(**common), wall)
    assert len(raw["time"]) > 10_000
    assert np.abs(stored_positions(world)[:, 1] - WALL_M).max() <= PRECISION_M / 2

    def placed(times_ns):
        """The raw points as if each had been seen at a time: (n, 3), world coordinates."""
        positions, rotations = DRIVE.poses(0, times_ns.astype(np.float64))
        seen = stored_positions(raw) @ MOUNT.rotation.T + MOUNT.position
        return np.einsum("kij,kj->ki", rotations, seen) + positions

    assert np.abs(placed(raw["time"])[:, 1] - WALL_M).max() <= PRECISION_M, "as stored, in 3 axes"
    turn = (raw["time"] // 100_000_000) * 100_000_000  # deskewed turn by turn only
    off = placed(turn) - placed(raw["time"])
    assert np.linalg.norm(off, axis=1).max() > 1.2
    assert np.abs(placed(turn)[:, 1] - WALL_M).max() > 0.3


def way(*steps, **options):
    """A trajectory of (seconds, x, y, z, yaw in degrees)."""
    seconds, x, y, z, yaw = np.array(steps, np.float64).T
    half = np.radians(yaw) / 2
    zero = np.zeros(len(yaw))
    turns = np.stack([zero, zero, np.sin(half), np.cos(half)], axis=1)
    return Track(seconds, np.stack([x, y, z], axis=1), turns, **options)


SIZE = np.array([4.5, 1.8, 1.5])
# 10 m/s, and 40 degrees a second to and fro.
CAR = Actor(
    box("Car", tuple(SIZE)), way((0, -3, 4, 0, 0), (0.25, -0.5, 4, 0, 10), (0.5, 2, 4, 0, 0))
)


@pytest.fixture(scope="module")
def street(wall):
    return Scene.from_meshes([*wall.meshes(), level("Ground", 0, 99)])


COLUMNS = ["ray", "time", "range", "triangle", "intensity", "class"]
SURVEYS = {
    "standing": {"poses": [(0, 0, 1.5), (1, 0, 1.5)], "steps": 54},
    "driving": {"trajectory": DRIVE},
    "beams of several rays": {"trajectory": DRIVE, "returns": Returns("all", 7, 3.0)},
}


@pytest.mark.slow
@pytest.mark.slow(keep=("standing-*", "driving-*"))
@pytest.mark.parametrize("backend", ["numpy", "tiles"])
@pytest.mark.parametrize("name", SURVEYS)
def test_an_actor_is_where_it_is_at_the_time_of_each_ray(street, name, backend):
    sensor = load_sensor("velodyne/vlp16")
    options = {"keep_every": 1, "columns": COLUMNS, "precision_m": 1e-3, **SURVEYS[name]}
    survey = Survey(sensor, **options)
    rig = Rig(replace(street, actors=(CAR,)), survey, backend)
    batches = list(rig.cast(0, survey.scan_count))
    seen = 0
    for batch in batches:
        on = batch.object == 2
        positions, rotations = CAR.trajectory.poses(0, batch.time[on].astype(np.float64))
        own = rotate_into_frames(batch.positions[on] - positions, rotations) - [0, 0, SIZE[2] / 2]
        off = np.abs(np.abs(own) - SIZE / 2)
        if "several" not in name:  # whose range is the mean of several rays
            assert off.min(axis=1).max(initial=0) < 1e-6
            face = off.argmin(axis=1)
            cosines = np.abs(rotate_into_frames(batch.directions[on], rotations))[
                np.arange(on.sum()), face
            ]
            assert np.allclose(batch.cosine[on], cosines, atol=1e-6)
            assert (np.abs(own) <= SIZE / 2 + 1e-6).all()
        assert (batch.triangle[on] >= 4).all()
        seen += on.sum()
    assert seen > 500
    plain = Rig(street, survey, backend).cast(0, survey.scan_count)
    for batch, without in zip(batches, plain, strict=True):
        both = {}
        for found in (batch, without):
            rays = np.flatnonzero(found.object != 2)
            made = [column.make(found)[rays] for column in survey.stored_columns]
            both[found is batch] = {
                key[:2]: key
                for key in zip(
                    found.pulse_returns.ray[rays].tolist(), *map(list, made), strict=True
                )
            }
        hidden = {int(ray) for ray in batch.pulse_returns.ray[batch.object == 2]}
        assert {ray for ray, _ in both[False]} - {ray for ray, _ in both[True]} <= hidden
        untouched = {k: v for k, v in both[False].items() if k[0] not in hidden}
        if "several" not in name:
            assert untouched == {k: v for k, v in both[True].items() if k[0] not in hidden}


@pytest.mark.extended
@pytest.mark.parametrize("backend", ["numpy", "tiles"])
def test_an_actor_behind_glass_is_where_it_is_without(street, backend):
    pane = quad("Pane", (-90, 2, -9), (90, 2, -9), (90, 2, 9), (-90, 2, 9))
    found = []
    for meshes in ([], [pane]):
        scene = replace(Scene.from_meshes([*street.meshes(), *meshes]), actors=(CAR,))
        materials = [Material("Pane", transparent="pass") for _ in meshes] + [Material("*", 0.5)]
        survey = Survey(
            load_sensor("velodyne/vlp16"), materials=materials, columns=COLUMNS, keep_every=1,
            **SURVEYS["standing"],
        )  # fmt: skip
        columns = made(survey, scene, backend)
        on = columns["object"] == len(scene.names)
        found.append({name: columns[name][on] for name in ("time", "ray", "range", "intensity")})
    plain, seen = found
    assert len(plain["ray"]) > 500
    assert np.array_equal(plain["time"], seen["time"])
    assert np.allclose(plain["range"], seen["range"], atol=1e-4)
    assert (seen["intensity"] < 0.93 * plain["intensity"]).all()


TURNED = {"poses": [Pose((0, 0, 1.5), 40, 8, -5), Pose((1, 0, 1.5), -17, 2, 9)], "steps": 54}
MIRROR = quad("Mirror", (-9, -3, 0), (9, -3, 0), (9, -3, 9), (-9, -3, 9))


@pytest.mark.extended
@pytest.mark.slow(keep=("driving-*", "turned-*", "mirror-*"))
@pytest.mark.parametrize("model", ["velodyne/vlp16", "livox/mid40"])
@pytest.mark.parametrize("name", [*SURVEYS, "turned", "noise", "mirror"])
def test_no_ray_meets_an_actor_that_is_not_asked_about_it(street, monkeypatch, name, model):
    options = SURVEYS | {
        "turned": TURNED,
        "noise": {"trajectory": DRIVE, "noise": Noise(angle_deg=1)},
        "mirror": {
            **TURNED,
            "materials": [Material("Mirror", specular_reflectance=1), Material("*", 0.5)],
        },
    }
    scene = replace(Scene.from_meshes([*street.meshes(), MIRROR]), actors=(CAR,))
    sensors = [Mounted(load_sensor(model), Pose((0, 0.1, 0.2), 90 if "livox" in model else 20))]
    survey = Survey(sensors=sensors, keep_every=1, columns=COLUMNS, **options[name])
    found = made(survey, scene)
    asked = []

    def every_ray(rays, reaches, pairs, *_):
        asked.append(1)
        cell = pairs.cell
        row = (cell[:, None] * moving_loops.CELL_RAYS + np.arange(moving_loops.CELL_RAYS)).ravel()
        pair = np.repeat(np.arange(len(cell)), moving_loops.CELL_RAYS)
        return row[row < len(reaches)], pair[row < len(reaches)]

    def every_cell(wide_cells, cells, samples, reach):
        bodies = len(samples.boxes)
        return np.tile(np.arange(len(cells)), bodies), np.repeat(np.arange(bodies), len(cells))

    monkeypatch.setattr(moving_loops, "rays_through_boxes", every_ray)
    monkeypatch.setattr(moving_loops, "pair_cells_with_bodies", every_cell)
    every = made(survey, scene)
    assert asked
    assert (every["object"] == len(scene.names)).sum() > (0 if name == "turned" else 100)
    for column, values in every.items():
        assert np.array_equal(found[column], values), column


def test_an_actor_must_be_there_as_long_as_the_survey_lasts(street):
    scene = replace(street, actors=(CAR,))
    uncovered = r"Actor 'Car': .* the last 0\.2 s are not covered.*`beyond: hold`.*`beyond: absent`"
    with pytest.raises(LidarError, match=uncovered):
        Job(scene, Survey(poses=[(0, 0, 1)] * 7))
    assert (
        input_fingerprints(Job(scene, Survey(poses=[(0, 0, 1)])))["scene"]
        != (input_fingerprints(Job(street, Survey(poses=[(0, 0, 1)])))["scene"])
    )

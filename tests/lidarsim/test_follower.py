"""A lidar that follows bodies of another program, frozen and moving."""

from __future__ import annotations

import numpy as np
import pytest
from tests.shapes import level

from lidarsim import (
    Actor,
    Follower,
    LidarError,
    Mounted,
    Pose,
    Scanner,
    Scene,
    SceneInstance,
    Sensor,
    Track,
    box,
    load_sensor,
)

VLP16 = load_sensor("velodyne/vlp16")
GRID = Sensor.grid(rays_per_revolution=120, layers=8, step_deg=30, max_range_m=40)
COLUMNS = ["range", "time", "intensity"]
BODIES = [box("Crate", (2, 1, 1)), box("Wall", (0.1, 60, 40)), box("Crate", (1, 1, 2))]
STATIC = [level("Ground"), SceneInstance(box("Post", (1, 1, 3)), Pose((-4, 3, 0)))]


def at(*poses):
    matrices = np.tile(np.eye(4), (len(poses), 1, 1))
    for matrix, pose in zip(matrices, poses, strict=True):
        matrix[:3, :3] = pose.rotation_matrix
        matrix[:3, 3] = pose.position
    return matrices


LIDAR = at(Pose((0, 0, 1.5), 30, 2))[0]
WORLDS = [
    at(Pose((5, 2, 0), 10), Pose((9, 0, -20)), Pose((3, -4, 0))),
    at(Pose((5, 1, 0), 20), Pose((8, 0, -20)), Pose((3, -4, 0))),
]


def same(cloud, other):
    assert cloud.positions.tobytes() == other.positions.tobytes()
    for name, values in other.columns.items():
        assert cloud[name].tobytes() == values.tobytes(), name
    return len(cloud) > 100


@pytest.mark.parametrize("shift", [0.0, 500_000.0])
def test_sweeps_and_ranges_are_those_of_a_scene_with_the_bodies_in_place(shift):
    """Also far from zero, where the scene has a local origin."""
    away = np.array([shift, -shift, 0])
    static = [item.affine_transform(item.name, np.eye(3), away) for item in STATIC]
    follower = Follower(BODIES, GRID, static=static, columns=COLUMNS, backend="numpy")
    assert follower.names == ("Ground", "Post", "Crate", "Wall", "Crate.2")
    lidar = LIDAR.copy()
    lidar[:3, 3] += away
    for number, matrices in enumerate(WORLDS):
        moved = matrices.copy()
        moved[:, :3, 3] += away
        cloud = follower.sweep(lidar, moved, number=number)
        placed = [SceneInstance(mesh, m) for mesh, m in zip(BODIES, moved, strict=True)]
        scene = Scene.from_meshes([*static, *placed])
        scanner = Scanner(scene, GRID, columns=COLUMNS, backend="numpy")
        local = lidar[:3, 3] - scene.origin
        expected = scanner.sweep(Pose(tuple(local), 30, 2), number=number)
        assert {2, 3, 4} <= {*cloud.object.tolist()}
        if shift:  # the two scenes have other origins
            assert np.abs(cloud.positions - expected.positions).max() < 1e-5
            continue
        assert same(cloud, expected)
        images = follower.ranges([lidar, lidar], moved, number=number)
        matrix = lidar.copy()
        matrix[:3, 3] = local
        assert np.array_equal(images, scanner.ranges([matrix, matrix], number=number))


@pytest.mark.extended
def test_each_beam_of_a_step_meets_the_world_of_its_time():
    """A wall that flees at 20 m/s while the sensor drives at 10 m/s; steps beside the sweeps."""
    follower = Follower(BODIES, VLP16, static=STATIC, columns=["range", "time"], precision_m=1e-5)
    lidar = np.eye(4)
    clouds = []
    for time_s in np.arange(0, 0.33, 0.003).tolist():
        matrices = WORLDS[0].copy()
        matrices[1, 0, 3] = 4 + 20 * time_s
        lidar[:3, 3] = 10 * time_s, 0, 1.5
        clouds += follower.step(100 + time_s, lidar, matrices)
    assert len(clouds) == 3
    for number, cloud in enumerate(clouds):
        seconds = cloud.time / 1e9
        assert number * 0.1 - 0.01 <= seconds.min() and seconds.max() <= number * 0.1 + 0.11
        on_wall = (cloud.object == 3) & (np.abs(cloud.positions[:, 1]) < 25)
        assert on_wall.sum() > 300
        wall_x = 4 - 0.05 + 20 * seconds
        assert np.abs(cloud.positions[:, 0] - wall_x)[on_wall].max() < 3e-5
    track = Track([0, 0.4], [[0, 0, 1.5], [4, 0, 1.5]], np.tile([0, 0, 0, 1.0], (2, 1)))
    wall = Track([0, 0.4], [[4, 0, -20], [12, 0, -20]], np.tile([0, 0, 0, 1.0], (2, 1)))
    actors = [Actor(mesh) for mesh in BODIES]
    scanner = Scanner(
        Scene.from_meshes(STATIC).with_actors(actors), VLP16, columns=["range", "time"],
        precision_m=1e-5,
    )  # fmt: skip
    scanner.move(["Crate", "Crate.2"], WORLDS[0][[0, 2]])
    scanner.move("Wall", wall)
    expected = scanner.sweep(track, number=1)
    assert len(expected) == len(clouds[1])
    assert np.abs(expected.positions - clouds[1].positions).max() <= 2e-5


def test_a_world_that_is_reset_begins_anew():
    follower = Follower(BODIES, GRID, static=STATIC, backend="numpy")
    times = [0.0, 0.05, 0.1]
    first = [follower.step(time, LIDAR, WORLDS[0]) for time in times]
    assert [len(clouds) for clouds in first] == [0, 0, 1]
    again = [follower.step(time, LIDAR, WORLDS[0]) for time in times]
    assert [len(clouds) for clouds in again] == [0, 0, 1]
    assert same(first[2][0], again[2][0])
    assert len(follower.step(0.35, LIDAR, WORLDS[1])) == 2  # a long step ends two sweeps


def test_wrong_matrices():
    follower = Follower(BODIES, Mounted(GRID, Pose((0, 0, 1))), static=STATIC, backend="numpy")
    with pytest.raises(LidarError, match="There are 2 matrices, but 3 bodies"):
        follower.sweep(LIDAR, WORLDS[0][:2])
    with pytest.raises(LidarError, match="Matrix 0 of a pose deforms"):
        follower.sweep(LIDAR, WORLDS[0] * np.diag([2, 2, 2, 1]))
    with pytest.raises(LidarError, match="must be numbers of the shape"):
        follower.ranges(LIDAR[:3], WORLDS[0])
    follower = Follower(BODIES, GRID, backend="numpy")
    assert len(follower.sweep(LIDAR, WORLDS[0]))
    with pytest.raises(LidarError, match="contains nothing stationary"):
        follower.step(0, LIDAR, WORLDS[0])

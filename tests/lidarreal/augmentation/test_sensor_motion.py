"""Motion of the sensor during recorded sweeps, and the ground below it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.made_recordings import made_recording

from lidarreal.augmentation.effects import Effects, Insertion
from lidarreal.augmentation.ground_plane import GroundPlane
from lidarreal.augmentation.inserted_objects import InsertedObjects
from lidarreal.augmentation.sensor_motion import SensorMotion
from lidarsim import LidarError, box
from lidarsim.columns.sweep import Sweep
from lidarsim.motion.rotations import rotations_of

STAMPS_S = 1000 + np.array([0.0, 0.1, 0.22, 0.35, 0.46])
POINTS = 200
TILTED = rotations_of(np.array([70.0, 5.0, -8.0]))
AT_HOME, FAR_AWAY = [3.0, -5.0, 2.0], [500_003.5, 5_400_004.25, 310.0]


def pose_at(seconds, origin, yaw_rad_s, velocity):
    """Return the pose of a sensor that moves and turns about its axis at constant rates."""
    pose = np.eye(4)
    angle = yaw_rad_s * (seconds - STAMPS_S[0])
    cos, sin = np.cos(angle), np.sin(angle)
    pose[:3, :3] = TILTED @ np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
    pose[:3, 3] = origin + TILTED @ (np.array(velocity) * (seconds - STAMPS_S[0]))
    return pose


def fired(number):
    """Return points in the sensor frames at their firing times, and these times."""
    rng = np.random.default_rng(number)
    return rng.uniform(-30, 30, (POINTS, 3)), np.linspace(0, 0.0999, POINTS)


def drive(compensated, origin, *motion):
    """Return a recording of the motion, and a function that returns the pose at a time."""

    def pose(seconds):
        return pose_at(seconds, np.array(origin), *motion)

    def read(number):
        points, times_s = fired(number)
        if compensated:
            back = np.linalg.inv(pose(STAMPS_S[number]))
            moved = [back @ pose(STAMPS_S[number] + time) for time in times_s]
            points = np.array(
                [m[:3, :3] @ p + m[:3, 3] for m, p in zip(moved, points, strict=True)]
            )
        ring = np.arange(POINTS, dtype=np.uint16) % 4
        return Sweep(points, {"time": times_s, "channel": ring, "intensity": ring + 1.0})

    recording = made_recording(
        "drive",
        len(STAMPS_S),
        read,
        read_stamps=lambda: 1e9 * STAMPS_S,
        read_poses=lambda: np.array([pose(seconds) for seconds in STAMPS_S]),
        compensated=compensated,
    )
    return recording, pose


# Without a rotation, or along the axis of the rotation, both ends can be extrapolated exactly.
MOTIONS = [(0.0, [9.0, -4.0, 0.5]), (1.5, [0.0, 0.0, 3.0]), (-0.8, [0.0, 0.0, -2.0])]


@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize("origin", [AT_HOME, FAR_AWAY])
def test_compensated_points_are_moved_back_to_their_firings(motion, origin):
    recording, pose = drive(True, origin, *motion)
    found = SensorMotion.from_recording(recording, has_objects=False)
    expected = [pose(seconds) for seconds in STAMPS_S]
    assert found.poses is not None
    np.testing.assert_allclose(found.poses[:, :3, 3] + found.shift, np.array(expected)[:, :3, 3])
    assert found.shift.any() == (origin is FAR_AWAY)
    assert np.abs(found.poses[:, :3, 3]).max() < 10
    for number in range(len(recording)):  # the first and the last have one neighbor
        points, times_s = fired(number)
        sweep = recording[number]
        np.testing.assert_allclose(sweep.times_s, times_s, atol=1e-9)
        np.testing.assert_allclose(found.as_fired(sweep, number).points, points, atol=1e-6)
        during = found.of_sweep(sweep, number, times_s)
        back = np.linalg.inv(expected[number])
        relative = np.array([back @ pose(STAMPS_S[number] + time) for time in times_s])
        np.testing.assert_allclose(during.origins, relative[:, :3, 3], atol=1e-6)
        np.testing.assert_allclose(during.rotations, relative[:, :3, :3], atol=1e-6)
        np.testing.assert_allclose(during.stamp_pose, found.poses[number])


@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize("compensated", [False, None])
def test_objects_are_seen_from_the_pose_of_each_firing(motion, compensated):
    recording, pose = drive(compensated, FAR_AWAY, *motion)
    assert SensorMotion.from_recording(recording, has_objects=False).poses is None
    found = SensorMotion.from_recording(recording, has_objects=True)
    for number in (0, 2, 4):
        times_s = np.array([0.0, 0.02, 0.09])
        sweep = recording[number]
        assert found.as_fired(sweep, number) is sweep
        during = found.of_sweep(sweep, number, times_s)
        assert during.origins is None and during.rotations is None
        positions, rotations = during.poses
        seconds = STAMPS_S[number] + times_s
        if compensated is None:  # then the pose of the sweep applies to all of them
            seconds = STAMPS_S[[number]]
            positions, rotations = positions[None], rotations[None]
        expected = np.array([pose(second) for second in seconds])
        np.testing.assert_allclose(positions + found.shift, expected[:, :3, 3], atol=1e-6)
        np.testing.assert_allclose(rotations, expected[:, :3, :3], atol=1e-6)


def ground(slope_x, slope_y, height_m=-1.7):
    """Return points on a slope, and on a wall and a car that stand on it."""
    rng = np.random.default_rng(3)
    x, y = rng.uniform(-20, 20, (2, 6000))
    z = height_m + slope_x * x + slope_y * y
    is_above = (np.abs(x - 9) < 1) & (np.abs(y - 4) < 2)
    z[is_above] += rng.uniform(0, 1.5, is_above.sum())
    return Sweep(np.column_stack([x, y, z]))


@pytest.mark.parametrize(("slope_x", "slope_y"), [(0, 0), (0.06, -0.03), (-0.02, 0.05)])
@pytest.mark.parametrize(("x_m", "y_m"), [(6, -3), (-5, 7), (8, 2)])
def test_the_ground_is_a_plane_around_the_object(slope_x, slope_y, x_m, y_m):
    z_m, up = GroundPlane.from_sweep(ground(slope_x, slope_y)).at(x_m, y_m, "car", "drive")
    assert z_m == pytest.approx(-1.7 + slope_x * x_m + slope_y * y_m, abs=0.01)
    expected = np.array([-slope_x, -slope_y, 1.0])
    np.testing.assert_allclose(up, expected / np.linalg.norm(expected), atol=0.01)


@pytest.mark.parametrize("heading_deg", [0, 40, -130])
def test_objects_are_inclined_like_the_ground(heading_deg):
    """The second object has a height, so it is level."""
    slope_x, slope_y = 0.06, -0.03
    recording = made_recording("drive", 1, lambda _: ground(slope_x, slope_y))
    car = box("Car", (4.5, 1.8, 1.5))
    raised = replace(
        car, vertices=np.add(car.vertices, [0, 0, 0.3])
    )  # its lowest point is not at 0
    effects = Effects(
        insertions=(Insertion(raised, 6, -3, heading_deg=heading_deg), Insertion(car, -5, 7, -1.2))
    )
    objects = InsertedObjects.from_effects(recording, effects, SensorMotion(recording))
    pose, level = objects.placed[0], objects.placed[1]
    up = np.array([-slope_x, -slope_y, 1]) / np.linalg.norm([-slope_x, -slope_y, 1])
    heading = np.radians(heading_deg)
    forward = np.array([np.cos(heading), np.sin(heading), 0])
    forward -= up * (up @ forward)
    forward /= np.linalg.norm(forward)
    expected = np.column_stack([forward, np.cross(up, forward), up])
    np.testing.assert_allclose(pose[:3, :3], expected, atol=0.01)
    vertices = raised.vertices @ pose[:3, :3].T + pose[:3, 3]
    above = vertices[:, 2] - (-1.7 + slope_x * vertices[:, 0] + slope_y * vertices[:, 1])
    np.testing.assert_allclose(np.sort(above)[:4], 0, atol=0.02)
    np.testing.assert_allclose(np.sort(above)[4:], 1.5, atol=0.02)
    np.testing.assert_allclose(level, [[1, 0, 0, -5], [0, 1, 0, 7], [0, 0, 1, -1.2], [0, 0, 0, 1]])
    assert objects.names == ("Car", "Car_2")
    assert objects.notes[0].endswith("unknown, so inserted objects move with the sensor.")


def test_unknown_ground_is_refused():
    surface = GroundPlane.from_sweep(ground(0, 0))
    with pytest.raises(LidarError, match="drive contains too few ground points around 60,-3 to pl"):
        surface.at(60, -3, "car", "drive")

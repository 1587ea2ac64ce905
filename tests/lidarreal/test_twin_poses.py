"""Poses of a twin: where the sweeps are in the world, and how points move within a sweep."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from tests.made_recordings import made_recording

from lidarreal.reconstruction.alignment import AlignedSweeps, Alignment
from lidarreal.reconstruction.blocked_directions import BlockedDirections
from lidarreal.reconstruction.lost_pulses import SensorCoverage
from lidarreal.reconstruction.motion import Motion, MotionStep
from lidarreal.reconstruction.odometry import RecordedPoses, find_poses
from lidarreal.reconstruction.recorded_sweeps import RecordedSweeps
from lidarreal.reconstruction.voxel_planes import VoxelPlanes, cell_keys, smallest_by_cell
from lidarreal.scan_patterns.lasers import RingLasers
from lidarsim import LidarError
from lidarsim.columns.sweep import Sweep

pytest.importorskip("small_gicp")

COUNT = 6


def pose_of(position, rotvec=(0.0, 0.0, 0.0)):
    """Return a pose matrix."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec(rotvec).as_matrix()
    pose[:3, 3] = position
    return pose


def path(first=(0.0, 0.0, 0.0), count=COUNT):
    """Return poses that move and turn about all axes."""
    steps = np.arange(count)[:, None]
    positions = np.array(first) + steps * (0.7, -0.4, 0.1)
    turns = steps * (0.01, -0.02, 0.05)
    return np.array([pose_of(*row) for row in zip(positions, turns, strict=True)])


def ring_points(rings=16, columns=180, radius_m=9.0):
    """Return points in columns around the sensor, ring by ring within a column, and their rings."""
    azimuth = np.repeat(np.linspace(-3.1, 3.1, columns), rings)
    ring = np.tile(np.arange(rings), columns)
    elevation = np.radians(8.0 - 1.0 * ring)
    points = np.stack([np.cos(azimuth), np.sin(azimuth), np.tan(elevation)], axis=1)
    return radius_m * points, ring


def recorded(stamps_s=None, poses=None, count=COUNT, **fields):
    """Return the sweeps of a sensor that always sees the same points around it."""
    points, ring = ring_points()
    recording = made_recording(
        "drive",
        count,
        lambda _: Sweep(points, {"ring": ring}),
        read_stamps=None if stamps_s is None else lambda: (1e9 * stamps_s).astype(np.int64),
        read_poses=None if poses is None else lambda: poses,
        **fields,
    )
    return RecordedSweeps.from_recording(recording)


coordinates = st.floats(-6e6, 6e6, width=32)


@settings(deadline=None)
@given(st.tuples(coordinates, coordinates, st.floats(-500, 9000, width=32)))
def test_poses_are_where_they_were_recorded(first):
    """The scene keeps the place in the world, and its own coordinates stay small."""
    world = path(first)
    poses = RecordedPoses.in_world(world, np.arange(COUNT) + 7.0, "from a test")
    np.testing.assert_allclose(poses.matrices[:, :3, 3] + poses.origin, world[:, :3, 3], atol=1e-8)
    np.testing.assert_array_equal(poses.matrices[:, :3, :3], world[:, :3, :3])
    np.testing.assert_array_equal(poses.origin, np.rint(poses.origin))
    is_far = np.abs(first).max() > 10_000
    assert np.abs(poses.matrices[0, :3, 3]).max() <= (0.5 if is_far else 10_000)
    assert is_far or not poses.origin.any()
    np.testing.assert_array_equal(poses.times_s, np.arange(COUNT))


def test_poses_of_a_recording_have_the_times_of_its_sweeps():
    world = path((691_000.25, -5_336_000.5, 520.0))
    stamps_s = 100 + 0.25 * np.arange(COUNT)
    poses = find_poses(recorded(stamps_s, world), None)
    np.testing.assert_allclose(poses.matrices[:, :3, 3] + poses.origin, world[:, :3, 3], atol=1e-8)
    np.testing.assert_allclose(poses.times_s, 0.25 * np.arange(COUNT), atol=1e-9)
    assert (poses.source, poses.are_given) == ("from the recording", True)
    part = poses.select(slice(1, 3))
    np.testing.assert_array_equal(part.matrices, poses.matrices[1:3])
    np.testing.assert_array_equal(part.times_s, poses.times_s[1:3])
    without = find_poses(recorded(None, world), None)
    np.testing.assert_allclose(without.times_s, 0.1 * np.arange(COUNT), atol=1e-12)


def test_a_trajectory_is_interpolated_at_the_times_of_the_sweeps(tmp_path):
    start = np.array([500_000.0, -4_000_000.0, 40.0])
    rows = ["time_s,x,y,z,qx,qy,qz,qw"]
    for time_s in (10, 14):
        x, y, z = start + (time_s - 10) * np.array([2.0, -1.0, 0.5])
        rows.append(f"{time_s},{x},{y},{z},0,0,0,1")
    file = tmp_path / "poses.csv"
    file.write_text("\n".join(rows))
    stamps_s = np.array([10.0, 10.5, 11.0, 12.5, 13.0, 14.0])
    poses = find_poses(recorded(stamps_s), file)
    expected = start + (stamps_s[:, None] - 10) * (2.0, -1.0, 0.5)
    np.testing.assert_allclose(poses.matrices[:, :3, 3] + poses.origin, expected, atol=1e-6)
    np.testing.assert_allclose(poses.times_s, stamps_s - 10, atol=1e-9)
    assert poses.source == "from poses.csv"
    rounded_s = stamps_s + np.array([-0.0005, 0, 0, 0, 0, 0.0005])
    at_ends = find_poses(recorded(rounded_s), file)
    np.testing.assert_allclose(
        at_ends.matrices[[0, -1], :3, 3] + at_ends.origin, expected[[0, -1]], atol=1e-6
    )
    for beyond in ([-0.002, 0, 0, 0, 0, 0], [0, 0, 0, 0, 0, 0.002]):
        with pytest.raises(LidarError, match=r"covers 10\.000 to 14\.000 s, but the sweeps of"):
            find_poses(recorded(stamps_s + beyond), file)


def write_rows(file, poses):
    """Write poses as KITTI rows."""
    np.savetxt(file, np.asarray(poses)[:, :3].reshape(len(poses), 12))
    return file


CAMERA = np.array([[0, -1, 0, 0.3], [0, 0, -1, -0.1], [1, 0, 0, -0.2], [0, 0, 0, 1.0]])


def test_kitti_rows_are_camera_poses_beside_a_calibration(tmp_path):
    world = path()
    camera = CAMERA @ world @ np.linalg.inv(CAMERA)
    file = write_rows(tmp_path / "poses.txt", camera)
    (tmp_path / "calib.txt").write_text("Tr: " + " ".join(map(str, CAMERA[:3].ravel())))
    poses = find_poses(recorded(), file)
    np.testing.assert_allclose(poses.matrices, world, atol=1e-9)
    (tmp_path / "calib.txt").unlink()
    # The calibration of the recording comes before that beside the file.
    calibration = tmp_path / "recorded.txt"
    calibration.write_text("Tr: " + " ".join(map(str, CAMERA[:3].ravel())))
    (tmp_path / "calib.txt").write_text("Tr: 1 0 0 0 0 1 0 0 0 0 1 0")
    with_own = find_poses(recorded(calibration=calibration), file)
    np.testing.assert_allclose(with_own.matrices, world, atol=1e-9)
    with pytest.raises(LidarError, match="contains 6 rows without times, but drive has 7 sweeps"):
        find_poses(recorded(count=7), file)


@pytest.mark.parametrize("sign", [1, -1])
def test_kitti_rows_along_z_are_refused_as_camera_poses(sign, tmp_path):
    steps = sign * np.arange(COUNT)[:, None]
    along_z = [pose_of(position) for position in steps * (0.1, 0.0, 0.5)]
    with pytest.raises(LidarError, match="moves the sensor along its z axis"):
        find_poses(recorded(), write_rows(tmp_path / "poses.txt", along_z))
    upward = [pose_of(position) for position in steps * (0.4, 0.0, 0.5)]
    found = find_poses(recorded(), write_rows(tmp_path / "poses.txt", upward))
    np.testing.assert_allclose(found.matrices, upward, atol=1e-9)
    short = [pose_of(position) for position in steps * (0.0, 0.0, 0.19)]
    find_poses(recorded(), write_rows(tmp_path / "poses.txt", short))


def room_points(pose, seed):
    """Return points on the walls, the floor and two pillars of a room, in the sensor frame."""
    rng = np.random.default_rng(seed)
    sides = []
    for count, size, center in (
        (15_000, (60.0, 45.0, 12.0), (4.1, -5.3, 3.2)),
        (3_000, (6.0, 8.0, 12.0), (16.1, 12.3, 3.2)),
        (3_000, (8.0, 4.0, 12.0), (-14.2, -13.1, 3.2)),
    ):
        inside = rng.uniform(-0.5, 0.5, (count, 3))
        axis = rng.integers(0, 3, len(inside))
        inside[np.arange(len(inside)), axis] = rng.choice([-0.5, 0.5], len(inside))
        sides.append(inside * size + center)
    world = np.concatenate(sides)
    return (world - pose[:3, 3]) @ pose[:3, :3]


def test_registration_continues_where_sweeps_are_missing():
    """The sensor moves by 0.5 m between sweeps. Eleven sweeps are missing, or 6 m."""
    pytest.importorskip("small_gicp")
    numbers = np.array([0, 1, 2, 3, 4, 16, 17, 18])
    truth = np.stack([pose_of((0.5 * number, 0.1 * number, 0.0)) for number in numbers])
    stamps_s = 0.1 * numbers
    recording = made_recording(
        "room",
        len(numbers),
        lambda number: Sweep(room_points(truth[number], number)),
        read_stamps=lambda: 1e9 * stamps_s,
    )
    found = find_poses(RecordedSweeps.from_recording(recording), None)
    assert found.source == "from registration"
    np.testing.assert_allclose(found.matrices, truth, atol=0.01)


def test_registration_finds_poses_from_the_first_sweep():
    truth = path(count=8)
    truth[:, :3, 3] *= 0.5

    def read(number):
        points = room_points(truth[number], number)
        return Sweep(points[:60] if number == 5 else points)  # too few are not registered

    sweeps = RecordedSweeps.from_recording(made_recording("room", 8, read))
    found = find_poses(sweeps, None)
    registered = np.arange(8) != 5
    apart = np.abs(found.matrices - truth)
    assert apart[registered].max() < 1e-3
    assert apart[5].max() < 0.03, "it continues the motion before it"
    assert (found.source, found.are_given, found.share) == ("from registration", False, 0.5)
    # Equal poses of all sweeps are a default, unless they come from a simulation.
    still = np.tile(pose_of((5.0, 6.0, 7.0)), (8, 1, 1))
    recording = made_recording("room", 8, read, read_poses=lambda: still)
    assert find_poses(RecordedSweeps.from_recording(recording), None).source == found.source


rotations = st.tuples(*[st.floats(-1, 1)] * 3)
offsets = st.tuples(*[st.floats(-30, 30)] * 3)


@settings(deadline=None)
@given(offsets, rotations, offsets, rotations, st.floats(-1.5, 1.5))
def test_motion_within_a_step_is_a_part_of_it(position, rotvec, moved, turned, share):
    first, second = pose_of(position, rotvec), pose_of(moved, turned)
    step = MotionStep.between(first, second)
    np.testing.assert_allclose(first @ step.fraction(1.0), second, atol=1e-9)
    np.testing.assert_allclose(step.fraction(0.0), np.eye(4), atol=1e-12)
    points = np.array([[3.0, -2.0, 0.5], [0.0, 4.0, -1.0]])
    (one, other) = step.compensate(np.array([share, -0.3]), points, 2 * points)
    for row, part in enumerate((share, -0.3)):
        matrix = step.fraction(part)
        np.testing.assert_allclose(
            one[row], matrix[:3, :3] @ points[row] + matrix[:3, 3], atol=1e-8
        )
        np.testing.assert_allclose(
            other[row], matrix[:3, :3] @ (2 * points[row]) + matrix[:3, 3], atol=1e-8
        )


def steady_poses(shares):
    """Return poses of a sensor that moves steadily, and turns about its direction of travel."""
    velocity = np.array([1.5, -0.5, 0.25])
    return np.array([pose_of(share * velocity, 0.1 * share * velocity) for share in shares])


@pytest.mark.parametrize(
    ("motion", "first_s", "stamp_share"),
    [
        (Motion.TIMED, 0.02, 0.2),  # the first point is 0.02 s after the timestamp
        (Motion.TIMED, -0.1, -1.0),  # timestamps of the last points
        (Motion.COUNTERCLOCKWISE, 0.0, 0.0),
        (Motion.CENTERED_CLOCKWISE, 0.0, -0.5),
    ],
)
def test_registered_poses_are_moved_to_the_timestamps(motion, first_s, stamp_share):
    """Registration yields poses in the middle of sweeps of 0.1 s."""
    numbers = np.arange(5.0)
    middle = steady_poses(numbers + stamp_share + 0.5)
    poses = RecordedPoses(middle, 0.1 * numbers, "", np.zeros(3), 0.5, first_s)
    found = Alignment.from_poses(poses, 0.1, motion, 4)
    expected = steady_poses(numbers)
    np.testing.assert_allclose(found.poses, expected, atol=1e-9)
    assert found.sweep_s == pytest.approx(0.1)
    given = Alignment.from_poses(poses._replace(share=0.0), 0.1, motion, 4)
    np.testing.assert_array_equal(given.poses, middle)


def test_points_before_the_timestamp_move_with_the_previous_step():
    poses = np.array([pose_of((0, 0, 0)), pose_of((2, 0, 0)), pose_of((2, 6, 0))])
    alignment = Alignment(poses, np.array([0, 0.1, 0.3]), 0.1, 0.1, Motion.TIMED, np.zeros((1, 3)))
    time_s = np.array([-0.05, 0.0, 0.05, 0.1])
    points = np.tile([5.0, 1.0, 0.0], (4, 1))
    sweep = Sweep(points, {"row": np.zeros(4, int), "time_s": time_s})
    moved, origins = alignment.compensate(sweep, 1)
    expected = [[-1, 0, 0], [0, 0, 0], [0, 1.5, 0], [0, 3, 0]]
    np.testing.assert_allclose(origins, expected, atol=1e-12)
    np.testing.assert_allclose(moved, points + expected, atol=1e-12)
    # The first sweep has no previous one, and the last one no next one.
    np.testing.assert_allclose(alignment.compensate(sweep, 0)[1][:, 0], 20 * time_s, atol=1e-12)
    np.testing.assert_allclose(alignment.compensate(sweep, 2)[1][:, 1], 30 * time_s, atol=1e-12)


def test_calibrated_points_are_the_same_as_fired():
    """Both descriptions of a sweep place its points and lasers at the same world coordinates."""
    rng = np.random.default_rng(4)
    ring = rng.integers(0, 3, 50)
    points = rng.normal((0, 0, 1), 8, (50, 3))
    lasers = RingLasers(
        np.radians([4.0, 0.0, -6.0]), np.array([0.2, 0.15, -0.1]), np.array([0.03, -0.05, 0.02])
    )
    offsets = np.array([[0.05, 0.002, -0.001], [-0.04, -0.003, 0.002], [0.02, 0.001, 0.004]])
    poses = path((30.0, -20.0, 2.0), 3)
    alignment = Alignment(poses, 0.1 * np.arange(3), 0.1, 0.1, Motion.TIMED, offsets, lasers=lasers)
    sweep = Sweep(points, {"row": ring, "time_s": rng.uniform(-0.1, 0.1, 50)})
    coverage = SensorCoverage(np.ones((3, 720), bool), 50.0, BlockedDirections.none())
    placed = AlignedSweeps(None, alignment, coverage).align(sweep, 1)
    fired, firing = alignment.points_as_fired(sweep, 1)
    np.testing.assert_allclose(firing.positions, placed.origins, atol=1e-9)
    np.testing.assert_allclose(firing.to_world(fired), placed.world, atol=1e-9)
    # Offsets change the recorded angles and ranges as seen from the lasers.
    azimuth, elevation = lasers.angles(points, ring)
    origins = lasers.positions(azimuth, elevation, ring)
    range_m = np.linalg.norm(points - origins, axis=1)
    np.testing.assert_allclose(np.linalg.norm(fired, axis=1), range_m + offsets[ring, 0])
    raised = np.arcsin(fired[:, 2] / np.linalg.norm(fired, axis=1)) - elevation
    turned = np.arctan2(fired[:, 1], fired[:, 0]) - azimuth
    np.testing.assert_allclose(raised, offsets[ring, 1], atol=1e-9)
    np.testing.assert_allclose(np.angle(np.exp(1j * turned)), offsets[ring, 2], atol=1e-9)
    np.testing.assert_allclose(placed.range_m, np.linalg.norm(fired, axis=1))


def test_voxel_planes_are_those_of_the_points():
    rng = np.random.default_rng(2)
    floor = rng.uniform((96, -53, 2), (104, -47, 2), (40_000, 3))
    tilted = floor @ Rotation.from_rotvec((0.3, -0.2, 0)).as_matrix().T
    planes = VoxelPlanes.from_points("test", tilted, 0.3)
    normal = Rotation.from_rotvec((0.3, -0.2, 0)).as_matrix()[:, 2]
    np.testing.assert_allclose(np.abs(planes.normals @ normal), 1, atol=1e-6)
    assert planes.thickness_m < 1e-6
    above = tilted[:100] + 0.07 * normal
    above[0] += 5 * normal
    distances, plane, near = planes.distances(above, 0.45)
    assert near.tolist() == [False, *[True] * 99]
    facing = planes.normals[plane] @ normal
    np.testing.assert_allclose(distances * np.sign(facing), 0.07, atol=1e-6)
    rough = tilted + rng.normal(0, 0.05, (len(tilted), 1)) * normal
    # A voxel of the tilted plane has about 30 points, whose mean is known accordingly better.
    assert 0.002 < VoxelPlanes.from_points("test", rough, 0.3).thickness_m < 0.06
    line = np.column_stack([np.arange(0, 40, 0.01), np.zeros((4000, 2))])
    assert VoxelPlanes.from_points("test", line, 0.3) is None
    assert VoxelPlanes.from_points("test", line[:300], 0.3) is None


cells = st.tuples(*[st.integers(-(2**20), 2**20 - 1)] * 3)


@given(st.lists(cells, min_size=2, max_size=8, unique=True))
def test_cells_have_different_keys(chosen):
    points = 0.25 * np.array(chosen) + 0.125
    assert len(set(cell_keys(points, 0.25).tolist())) == len(chosen)
    np.testing.assert_array_equal(cell_keys(points + 0.12, 0.25), cell_keys(points - 0.12, 0.25))


def test_the_smallest_value_of_each_cell():
    found = smallest_by_cell(np.array([7, 3, 7, 3, 5]), np.array([2.0, -1.0, 1.5, 4.0, 9.0]))
    np.testing.assert_array_equal(found[0], [3, 5, 7])
    np.testing.assert_array_equal(found[1], [-1.0, 9.0, 1.5])

"""Moving objects of a recording become actors of its twin."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.city_drives import CARS, car_drive, car_position
from tests.drives import points_of, the_scene, the_survey
from tests.made_recordings import changed_recording, made_recording

from lidarfiles import save_cloud
from lidarfiles.clouds.recorded_boxes import RecordedBoxes
from lidarfiles.clouds.recording import RecordingSection
from lidarfiles.recordings.opening import open_recording
from lidarreal import twin
from lidarreal.reconstruction.moving_objects import find_tracks
from lidarreal.reconstruction.moving_rays import MovingRays, SweepMasks
from lidarreal.reconstruction.object_clusters import find_clusters
from lidarreal.reconstruction.object_surfels import cast_to_objects, reconstruct_objects
from lidarreal.reconstruction.object_tracks import ObjectTrack
from lidarsim import LidarError
from lidarsim.motion.rotations import recorded_rotation
from lidarsim.sweeps.sweeps import Sweeps

pytest.importorskip("scipy")

SIZE = np.array([4.2, 1.8, 1.5])
PERIOD_S = 0.1
SENSOR = np.array([0.0, 0.0, 1.9])


def true_pose(times_s):
    """A car that is stationary for a second, and then accelerates at 2 m/s²."""
    ahead = np.square(np.maximum(times_s - 1.0, 0))
    return np.stack([-4 + ahead, np.full_like(ahead, 6.0), np.zeros_like(ahead)], axis=1)


def car_rays(sweeps=30):
    """Return rays that end on two sides of the car, whose wheels are 0.1 m above the ground.

    The rays of a sweep are fired one after the other. Points count as moved if the car moved at
    least 0.3 m since it started.
    """
    random = np.random.default_rng(5)
    parts = []
    for number in range(sweeps):
        sides = random.uniform(-0.5, 0.5, (700, 3))
        sides[:500, 1] = -0.5
        sides[500:, 0] = -0.5
        local = sides * (SIZE - (0, 0, 0.1)) + (0, 0, SIZE[2] / 2 + 0.05)
        ground = np.column_stack([random.uniform(-4, 4, 200), np.full(200, -1.5), np.zeros(200)])
        local = np.concatenate([local, ground])
        times_s = PERIOD_S * number + 0.01 * np.arange(len(local)) / len(local)
        place = true_pose(times_s)
        place[700:] = place[0]
        ends = place + local + random.normal(0, 0.005, local.shape)
        moved = (place[:, 0] > -3.7) & (np.arange(len(local)) < 700)
        cluster = np.where(moved, 0, -1)
        parts.append(
            MovingRays(
                np.full(len(ends), number),
                times_s,
                np.tile(SENSOR, (len(ends), 1)),
                ends,
                np.ones(len(ends), bool),
                moved,
                np.zeros(len(ends), np.int64),
                np.full(len(ends), np.nan),
                np.zeros(len(ends), np.int64),
                cluster,
            )
        )
    return MovingRays.concatenate(parts)


@pytest.fixture(scope="module")
def rays():
    return car_rays()


@pytest.fixture(scope="module")
def track(rays):
    (found,) = find_tracks(rays, None, PERIOD_S)
    return found


def test_a_track_has_the_motion_and_the_size_of_the_object(track):
    np.testing.assert_allclose(track.size, SIZE, atol=0.1)
    times_s = np.arange(0.05, 2.9, 0.1)
    positions, yaw = track.poses(times_s)
    offsets = positions - true_pose(times_s)
    np.testing.assert_allclose(offsets, np.zeros_like(offsets), atol=0.1)
    np.testing.assert_allclose(
        offsets[15:], offsets[15:].mean(axis=0) + 0 * offsets[15:], atol=0.04
    )
    np.testing.assert_allclose(yaw, 0, atol=0.01)


def test_an_object_that_was_parked_is_present_before_it_starts(track):
    assert track.stands_before
    assert not track.stands_after
    assert track.times_s[0] < 0.2
    assert track.is_present(np.array([-60.0, 1.0, 60.0])).tolist() == [True, True, False]
    np.testing.assert_array_equal(
        track.poses(np.array([-60.0]))[0][0], track.poses(track.times_s[:1])[0][0]
    )


def test_the_visible_part_of_a_stationary_hedge_is_no_object():
    leaves = np.random.default_rng(6).uniform((0, 6, 0), (12, 7, 1.5), (700, 3))
    parts = []
    for number in range(20):  # a part of 3 m that shifts by 0.4 m per sweep
        ahead_m = leaves[:, 0] - 0.4 * number
        parts.append(moved_rays(number, leaves[(ahead_m > 0) & (ahead_m < 3)]))
    assert not find_tracks(MovingRays.concatenate(parts), None, PERIOD_S)


def test_leaves_that_move_together_are_an_object():
    leaves = np.random.default_rng(6).uniform((0, 6, 0), (3, 7, 1.5), (175, 3))
    parts = [moved_rays(number, leaves + np.array([0.4 * number, 0, 0])) for number in range(20)]
    (track,) = find_tracks(MovingRays.concatenate(parts), None, PERIOD_S)
    assert track.distance_m > 3


def moved_rays(number, ends):
    """Return rays of a sweep that end on a cluster of points that moved."""
    count = len(ends)
    return MovingRays(
        np.full(count, number),
        np.full(count, PERIOD_S * number),
        np.tile(SENSOR, (count, 1)),
        ends,
        np.ones(count, bool),
        np.ones(count, bool),
        np.zeros(count, np.int64),
        np.full(count, np.nan),
        np.zeros(count, np.int64),
        np.zeros(count, np.int64),
    )


@pytest.mark.extended(every=2)
@pytest.mark.parametrize("number", [22, 29])
def test_a_sighting_before_the_previous_one_is_omitted(rays, number):
    """If an object is where sweeps begin and end, its times can be those of another revolution."""
    early = rays.time_s - 1.2 * PERIOD_S * (rays.sweep == number)
    (found,) = find_tracks(rays._replace(time_s=early), None, PERIOD_S)
    assert (np.diff(found.times_s) > 0).all()
    times_s = np.arange(0.5, 2.6, 0.1)
    np.testing.assert_allclose(found.poses(times_s)[0], true_pose(times_s), atol=0.15)


def test_labeled_boxes_are_adjusted_to_the_points(rays):
    random = np.random.default_rng(1)
    times_s = np.arange(0, 3, 0.1)
    noise = random.normal(0, 0.05, (len(times_s), 3)) * (1, 1, 0)
    label = ObjectTrack(7, "Car", SIZE, times_s, true_pose(times_s) + noise, np.zeros(30))
    (found,) = find_tracks(rays, [label], PERIOD_S)
    assert (found.number, found.kind) == (7, "Car")
    sought_s = np.arange(0.3, 2.7, 0.1)
    offsets = found.poses(sought_s)[0] - true_pose(sought_s)
    np.testing.assert_allclose(offsets, 0 * offsets + offsets.mean(axis=0), atol=0.03)
    np.testing.assert_allclose(offsets.mean(axis=0), 0, atol=0.03)


def test_rays_hit_an_object_where_it_is_at_their_time(rays, track):
    (found,) = reconstruct_objects([track], rays, 0.1, np.radians(0.5))
    times_s = np.array([0.5, 2.0, 2.9, 2.9])
    middle = true_pose(times_s) + np.array([0, 0, 0.8])
    middle[3] = true_pose(np.array([0.5]))[0] + (0, 0, 0.8)  # where the car was before
    origins = np.tile(SENSOR, (4, 1))
    hits = cast_to_objects([found], origins, middle, times_s)
    directions = middle - origins
    expected_m = np.linalg.norm(directions, axis=1)
    expected_m *= (middle[:, 1] - SIZE[1] / 2) / middle[:, 1]
    np.testing.assert_allclose(hits.distance_m[:3], expected_m[:3], atol=0.03)
    assert np.isinf(hits.distance_m[3])
    assert hits.object.tolist() == [0, 0, 0, -1]


def test_uneven_ground_below_an_object_is_no_part_of_it(rays, track):
    random = np.random.default_rng(7)
    times_s = np.sort(random.uniform(0, 3, 6_000))
    ends = random.uniform((-6, 5, 0.08), (2, 7, 0.15), (6_000, 3))
    ground = MovingRays(
        (times_s / PERIOD_S).astype(int),
        times_s,
        np.tile(SENSOR, (len(ends), 1)),
        ends,
        np.ones(len(ends), bool),
        np.zeros(len(ends), bool),
        np.zeros(len(ends), np.int64),
        np.full(len(ends), np.nan),
        np.zeros(len(ends), np.int64),
        np.full(len(ends), -1),
    )
    both = MovingRays.concatenate([rays, ground])
    both = both.select(np.argsort(both.sweep, kind="stable"))
    assert track.contains(track.to_object(ground.ends, ground.time_s)).sum() > 1_000
    (found,) = reconstruct_objects([track], both, 0.1, np.radians(0.5))
    level = np.abs(found.surfels.normals[:, 2]) > 0.8
    assert not level[found.surfels.centers[:, 2] < 0.2].any()


def test_the_middle_of_a_long_vehicle_belongs_to_its_cluster():
    along, height = np.meshgrid(np.arange(0, 6, 0.1), np.arange(0.5, 2, 0.1))
    bus = np.column_stack([along.ravel(), np.full(along.size, 4.0), height.ravel()])
    moved = (bus[:, 0] < 1) | (bus[:, 0] > 5)
    other = bus + np.array([0, 3, 0])
    points = np.concatenate([bus, other, level_ground()])
    cluster = find_clusters(points, np.append(moved, np.zeros(len(points) - len(bus), bool)))
    above = bus[:, 2] > 0.65  # the lowest points may be on the ground
    assert set(cluster[: len(bus)][above].tolist()) == {0}
    assert set(cluster[len(bus) :].tolist()) == {-1}


def test_ground_that_seems_to_move_does_not_belong_to_a_cluster():
    along, height = np.meshgrid(np.arange(0, 4, 0.1), np.arange(0.05, 1.5, 0.05))
    car = np.column_stack([along.ravel(), np.full(along.size, 4.0), height.ravel()])
    ground = np.append(level_ground(), [[1e5, 1e5, 0.0]], axis=0)  # and a point far away
    moved = (ground[:, 0] < 6) & (np.random.default_rng(1).random(len(ground)) < 0.5)
    cluster = find_clusters(
        np.concatenate([car, ground]), np.concatenate([np.ones(len(car), bool), moved])
    )
    assert set(cluster[: len(car)][car[:, 2] > 0.3].tolist()) == {0}
    assert set(cluster[len(car) :].tolist()) == {-1}


def level_ground():
    """Return points on level ground at z = 0."""
    x, y = np.meshgrid(np.arange(-2, 12, 0.2), np.arange(0, 10, 0.2))
    return np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])


def test_masks_are_stored_as_bits():
    masks = {3: np.array([True, False, True]), 5: np.ones(9, bool), 8: np.zeros(0, bool)}
    packed = SweepMasks.from_masks(masks)
    assert packed.bits.nbytes == 2
    for number, mask in packed.masks().items():
        np.testing.assert_array_equal(mask, masks[number])


def the_cloud():
    """Return a cloud with sweeps of two sensors and two actors."""
    scene = the_scene()
    sweeps = Sweeps.from_survey(the_survey(), scene)
    return replace(points_of(scene, 0), sweeps=lambda: sweeps)


@pytest.fixture(scope="module")
def boxes():
    found = open_recording(the_cloud(), "front", name="cloud").boxes
    assert found is not None
    return found


@pytest.mark.parametrize("side", [-4.5, np.nan, np.inf])
def test_boxes_without_a_size_are_refused(side):
    with pytest.raises(ValueError, match=rf"size of box 7 \(Car\) must be positive.*{side:g} x"):
        RecordedBoxes.from_rows([(0, 7, "Car", np.eye(4), (side, 1.8, 1.5))])


def test_rotations_of_boxes_have_the_length_1():
    half = np.sqrt(0.5)
    turned = recorded_rotation((0, 0, 1.001 * half, half), "box 7")
    np.testing.assert_allclose(turned, [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=2e-3)
    np.testing.assert_allclose(turned @ turned.T, np.eye(3), atol=1e-12)
    for scale in (0, 1.1):
        with pytest.raises(ValueError, match="the quaternion of box 7 has the length"):
            recorded_rotation((0, 0, 0, scale), "box 7")
    with pytest.raises(ValueError, match="the quaternion of box 7 is not finite"):
        recorded_rotation((0, 0, 0, np.nan), "box 7")
    with pytest.raises(ValueError, match=r"the pose of box 7 \(Car\) in sweep 2 is not finite"):
        RecordedBoxes.from_rows([(2, 7, "Car", np.full((4, 4), np.nan), (4.5, 1.8, 1.5))])


def test_results_have_the_boxes_of_their_actors(boxes):
    assert set(boxes.kinds) == {"Car", "Van"}
    cars = boxes.object == boxes.object[0]
    np.testing.assert_array_equal(boxes.sweep[cars], [0, 1, 2])
    np.testing.assert_allclose(boxes.sizes[cars], [[4, 2, 1.5]] * 3)
    scene = the_scene()
    opened = open_recording(the_cloud(), "front", name="cloud")
    poses = opened.poses(range(3))
    centers = (poses @ boxes.poses[cars])[:, :3, 3] - scene.origin
    expected = [[5 + 0.2 * number, 5, 0.75] for number in range(3)]
    np.testing.assert_allclose(centers, expected, atol=1e-6)


@pytest.mark.parametrize(("format", "name"), [("kitti", "00"), ("nuscenes", "LIDAR_TOP")])
def test_exported_boxes_are_read(boxes, tmp_path, format, name):  # noqa: A002
    save_cloud(the_cloud(), tmp_path / format, format=format)
    read = open_recording(tmp_path / format, name, name=format).boxes
    for sweep, kind, pose, size in zip(read.sweep, read.kinds, read.poses, read.sizes, strict=True):
        rows = np.flatnonzero(boxes.sweep == sweep)
        (row,) = [row for row in rows.tolist() if boxes.kinds[row] == kind]
        np.testing.assert_allclose(pose[:3, 3], boxes.poses[row, :3, 3], atol=1e-3)
        np.testing.assert_allclose(size, boxes.sizes[row], atol=1e-3)
    assert "Car" in read.kinds


def test_boxes_on_the_topic_actors_are_read(boxes, tmp_path):
    pytest.importorskip("rosbags")
    save_cloud(the_cloud(), tmp_path / "drive.mcap")
    read = open_recording(tmp_path / "drive.mcap", "/front/points", name="bag").boxes
    np.testing.assert_array_equal(read.sweep, boxes.sweep)
    assert read.kinds == boxes.kinds
    np.testing.assert_allclose(read.poses, boxes.poses, atol=1e-3)


def write_sweeps(folder, count=3):
    """Write KITTI point files with a single point."""
    folder.mkdir(parents=True)
    for number in range(count):
        (folder / f"{number:010}.bin").write_bytes(np.ones(4, "<f4").tobytes())


TRACKLETS = """<?xml version="1.0"?><boost_serialization><tracklets><count>1</count><item>
<objectType>Van</objectType><h>2</h><w>1.8</w><l>4</l><first_frame>1</first_frame>
<poses><count>2</count><item><tx>10</tx><ty>2</ty><tz>-1.5</tz><rx>0</rx><ry>0</ry><rz>1.5</rz></item>
<item><tx>12</tx><ty>2</ty><tz>-1.5</tz><rx>0</rx><ry>0</ry><rz>1.5</rz></item></poses>
</item></tracklets></boost_serialization>"""


def test_tracklets_of_raw_drives_are_read(tmp_path):
    write_sweeps(tmp_path / "velodyne_points" / "data")
    (tmp_path / "tracklet_labels.xml").write_text(TRACKLETS)
    read = open_recording(tmp_path, name="drive").boxes
    assert read.sweep.tolist() == [1, 2]
    assert read.kinds == ("Van", "Van")
    np.testing.assert_allclose(read.poses[:, :3, 3], [[10, 2, -0.5], [12, 2, -0.5]])
    np.testing.assert_allclose(read.poses[0, :3, 0], [np.cos(1.5), np.sin(1.5), 0], atol=1e-12)
    np.testing.assert_allclose(read.sizes[0], [4, 1.8, 2])
    (tmp_path / "tracklet_labels.xml").write_text(TRACKLETS.replace("<tx>10</tx>", ""))
    with pytest.raises(LidarError, match="an element has no <tx>"):
        _ = open_recording(tmp_path, name="drive").boxes


def test_labels_of_kitti_tracking_are_read(tmp_path):
    write_sweeps(tmp_path / "velodyne" / "0003")
    labels = tmp_path / "label_02" / "0003.txt"
    labels.parent.mkdir()
    line = "1 5 Car 0 0 -1.5 0 0 9 9 1.5 1.8 4.0 -2.0 1.7 10.0 -1.5707963\n"
    labels.write_text(line + "1 -1 DontCare -1 -1 -10 0 0 9 9 -1 -1 -1 -1000 -1000 -1000 -10\n")
    calibration = tmp_path / "calib" / "0003.txt"
    calibration.parent.mkdir()
    calibration.write_text(
        "P2: 1 0 0 0 0 1 0 0 0 0 1 0\nR_rect 1 0 0 0 1 0 0 0 1\n"
        "Tr_velo_cam 0 -1 0 0.5 0 0 -1 0 1 0 0 -0.25\n"
    )
    read = open_recording(tmp_path / "velodyne" / "0003", name="drive").boxes
    assert (read.sweep.tolist(), read.object.tolist(), read.kinds) == ([1], [5], ("Car",))
    np.testing.assert_allclose(read.poses[0, :3, 3], [10.25, 2.5, -0.95], atol=1e-6)
    np.testing.assert_allclose(read.poses[0, :3, 0], [1, 0, 0], atol=1e-6)
    labels.write_text("1 5 Car 0\n")
    with pytest.raises(LidarError, match=r"0003\.txt, line 1: a label of KITTI tracking"):
        _ = open_recording(tmp_path / "velodyne" / "0003", name="drive").boxes


def test_boxes_of_a_section_are_numbered_from_its_start(boxes):
    recording = made_recording("drive", 3, lambda _: None, read_boxes=lambda: boxes)
    found = RecordingSection(recording, 1, 2).boxes
    assert isinstance(found, RecordedBoxes)
    assert sorted(set(found.sweep.tolist())) == [0, 1]
    np.testing.assert_array_equal(found.poses, boxes.poses[boxes.sweep >= 1])


def test_boxes_are_required_if_they_were_chosen():
    opened = open_recording(the_cloud(), "front", name="cloud")
    recording = changed_recording(
        opened,
        read=lambda number: opened.load(number % 3),
        read_boxes=None,
        read_poses=None,
        fired=None,
        read_stamps=None,
        count=4,
    )
    with pytest.raises(
        LidarError, match=r"no labeled boxes of .* sweeps\. Set `actors` to `clusters`"
    ):
        twin(recording, actors="boxes")
    with pytest.raises(LidarError, match="actors"):
        twin(recording, actors="labels")


@pytest.fixture(scope="module")
def city():
    """Return the recorded sweeps of a drive among cars, one of which starts to drive."""
    return car_drive("ouster/os1-32", {"columns": 512}, 24)


@pytest.mark.slow
@pytest.mark.parametrize("source", ["boxes", "clusters"])
def test_moving_cars_are_simulated_as_they_were_recorded(city, source):
    found = twin(city, actors=source)
    moving = found.figures["held_out"]["moving"]
    assert found.figures["vehicle_share"] == 0
    assert moving["rays"] > 2_000
    assert moving["median_abs_difference_m"] < 0.03
    assert moving["no_surface"] < 0.02
    assert moving["ghosts"] < 0.002
    assert found.figures["held_out"]["stationary"]["median_abs_difference_m"] < 0.02
    middles = found.scene.vertices[found.scene.faces].mean(axis=1)
    remains = 0  # of the cars in the static scene
    for car in range(len(CARS)):
        for time_s in np.arange(0, 2.4, 0.1):
            offsets = np.abs(middles - car_position(car, time_s) - (0, 0, 0.75))
            remains += int((offsets < (1.8, 0.6, 0.55)).all(axis=1).sum())
    assert remains <= (0 if source == "boxes" else 100)
    parked = np.abs(middles - car_position(2, 0.0) - (0, 0, 0.75))
    assert not (parked < (1.8, 0.6, 0.55)).all(axis=1).any()
    assert len(found.actors) == len(CARS)

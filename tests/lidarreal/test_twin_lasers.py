"""Lasers that are not at the origin of the points: found, written, and used for held-out rays."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import yaml
from benchmarks.odometry import left_turn
from tests.made_recordings import made_recording
from tests.simulated_drives import simulated_drive

from lidarfiles.recordings.opening import open_recording
from lidarreal import twin
from lidarreal.reconstruction.alignment import AlignedSweeps, Alignment
from lidarreal.reconstruction.free_space import RangeImage
from lidarreal.reconstruction.lost_pulses import SensorCoverage, lost_pulses
from lidarreal.reconstruction.motion import Motion
from lidarreal.reconstruction.odometry import RecordedPoses
from lidarreal.reconstruction.recorded_sweeps import RecordedSweeps
from lidarreal.scan_patterns.lasers import RingLasers, unit_vectors
from lidarscenes.procedural.city import city
from lidarsim import Beams, Mounted, Pose, Sensor, Survey, load_sensor
from lidarsim.columns.sweep import Sweep

pytest.importorskip("scipy")

PULSES = 500
PLANES = np.array(  # normals and distances of the sloping ground and four walls
    [[0.06, 0.03, -1, 1.8], [1, 0, 0, 14], [-1, 0, 0, 9], [0, 1, 0, 6], [0, -1, 0, 25]], float
)


def true_lasers(model="velodyne/hdl64e-s2"):
    """Return the lasers of a model from the highest to the lowest, and the azimuths of its beams.

    Only the parts of the offsets that are perpendicular to the beams are visible.
    """
    beams = load_sensor(model).beams
    order = np.argsort(-beams.elevation)
    elevation, azimuth, origin = (
        values[order] for values in (beams.elevation, beams.azimuth, beams.origin)
    )
    upward = unit_vectors(azimuth, elevation + np.pi / 2)
    leftward = unit_vectors(azimuth + np.pi / 2, 0 * elevation)
    lasers = RingLasers(
        elevation,
        np.einsum("ij,ij->i", origin, upward),
        np.einsum("ij,ij->i", origin, leftward),
        0.0,
    )
    return lasers, azimuth


def room_sweep(lasers, azimuth, turned=0.0, moved=0.0, noise_deg=0.0, position=(0.0, 0.0)):
    """Return the points and rings of a sweep in a room, in the sensor frame.

    The sensor moves by `moved` meters along x while it turns, and the points are compensated for
    this motion.
    """
    count = len(lasers)
    column, ring = (index.ravel() for index in np.indices((PULSES, count)))
    head = turned + 2 * np.pi * column / PULSES
    angles = head + azimuth[ring], lasers.elevation_rad[ring]
    shift = np.stack([moved * column / PULSES, 0 * head, 0 * head], axis=1)
    starts = lasers.positions(*angles, ring) + shift + [*position, 0.0]
    directions = unit_vectors(*angles)
    facing = directions @ PLANES[:, :3].T
    with np.errstate(divide="ignore"):
        to_planes = (PLANES[:, 3] - starts @ PLANES[:, :3].T) / facing
    range_m = np.where(facing > 1e-9, to_planes, np.inf).min(axis=1)
    points = starts + range_m[:, None] * directions - [*position, 0.0]
    random = np.random.default_rng(5)
    for axis in (0, 1):
        angle = random.normal(0, np.radians(noise_deg), len(points))
        sin, cos = np.sin(angle), np.cos(angle)
        first, last = points[:, axis].copy(), points[:, 2].copy()
        points[:, axis], points[:, 2] = cos * first - sin * last, sin * first + cos * last
    near = range_m < 60
    return points[near], ring[near]


def found_lasers(lasers, azimuth, **options):
    """Return the lasers found in three sweeps."""
    sweeps = [
        room_sweep(lasers, azimuth, turned=0.003 * number, position=(0.7 * number, 0.0), **options)
        for number in range(3)
    ]
    elevation = np.arctan2(sweeps[0][0][:, 2], np.hypot(*sweeps[0][0][:, :2].T))
    medians = [np.median(elevation[sweeps[0][1] == ring]) for ring in range(len(lasers))]
    return RingLasers.from_sweeps(sweeps, np.array(medians)), np.array(medians)


def test_the_lasers_of_an_hdl_64e_are_above_and_beside_the_origin():
    truth, azimuth = true_lasers()
    assert np.abs(truth.vertical_m).min() > 0.1 and np.abs(truth.horizontal_m).min() > 0.02
    found, medians = found_lasers(truth, azimuth)
    assert np.degrees(np.abs(medians - truth.elevation_rad)).max() > 0.5
    np.testing.assert_allclose(found.vertical_m, truth.vertical_m, atol=1e-3)
    np.testing.assert_allclose(found.horizontal_m, truth.horizontal_m, atol=1e-3)
    error_deg = np.degrees(found.elevation_rad - truth.elevation_rad)
    np.testing.assert_allclose(error_deg, 0, atol=0.005)
    assert found.have_constant_elevations and not found.is_at_origin


def test_noisy_directions_still_show_the_offsets():
    truth, azimuth = true_lasers()
    found, _ = found_lasers(truth, azimuth, noise_deg=0.02)
    np.testing.assert_allclose(found.vertical_m, truth.vertical_m, atol=0.012)
    assert np.median(np.abs(found.vertical_m - truth.vertical_m)) < 2e-3


@pytest.mark.extended(every=3)
@pytest.mark.parametrize("noise_deg", [0.0, 0.02, 0.1])
def test_lasers_at_the_origin_stay_there(noise_deg):
    truth, azimuth = true_lasers()
    found, medians = found_lasers(
        RingLasers.at_origin(truth.elevation_rad), azimuth, noise_deg=noise_deg
    )
    assert found.is_at_origin
    np.testing.assert_array_equal(found.elevation_rad, medians)


def test_points_that_are_compensated_for_motion_have_no_constant_elevations():
    truth, azimuth = true_lasers()
    found, _ = found_lasers(truth, azimuth, moved=1.0)
    assert not found.have_constant_elevations


def test_positions_and_angles_agree():
    truth, azimuth = true_lasers()
    points, ring = room_sweep(truth, azimuth)
    angles = truth.angles(points, ring)
    np.testing.assert_allclose(angles[1], truth.elevation_rad[ring], atol=1e-9)
    origins = truth.origins(points, ring)
    vectors = points - origins
    np.testing.assert_allclose(np.cross(vectors, unit_vectors(*angles)), 0, atol=1e-6)
    range_m = np.linalg.norm(vectors, axis=1)
    np.testing.assert_allclose(truth.ends(*angles, ring, range_m), points, atol=1e-6)


def test_lost_pulses_start_at_their_lasers():
    truth, azimuth = true_lasers()
    points, ring = room_sweep(truth, azimuth)
    kept = np.random.default_rng(1).random(len(ring)) < 0.8
    coverage = SensorCoverage(np.ones((len(truth), 720), bool), 60.0)
    lost, _ = lost_pulses(Sweep(points[kept], {"row": ring[kept]}), truth, coverage, 0.0)
    assert len(lost) == pytest.approx((~kept).sum(), rel=0.01)
    found = truth.angles(lost.points, lost.columns["row"])
    np.testing.assert_allclose(found[1], truth.elevation_rad[lost.columns["row"]], atol=1e-9)
    directions = unit_vectors(*truth.angles(points[~kept], ring[~kept]))
    for number in (3, 40):
        cosines = unit_vectors(*found)[lost.columns["row"] == number] @ (
            directions[ring[~kept] == number].T
        )
        assert np.mean(cosines.max(axis=1) > np.cos(np.radians(0.05))) > 0.98


def test_held_out_rays_do_not_depend_on_the_recorded_ranges():
    """If all surfaces were at another distance, the same rays would be simulated."""
    truth, azimuth = true_lasers()
    sweeps = [room_sweep(truth, azimuth, position=(0.5 * number, 0.0)) for number in range(4)]

    def recording(factor):
        def read(number):
            points, ring = sweeps[number]
            origins = truth.origins(points, ring)
            far = origins + factor * (points - origins) if number == 2 else points
            return Sweep(far, {"ring": ring, "time": np.zeros(len(ring))})

        return RecordedSweeps.from_recording(made_recording("drive", 4, read))

    poses = np.tile(np.eye(4), (4, 1, 1))
    rays = []
    for factor in (1.0, 1.7):
        recorded = replace(recording(factor), lasers=truth)
        times_s = 0.1 * np.arange(4)
        alignment = Alignment(
            poses, times_s, 0.1, 0.1, Motion.COMPENSATED, np.zeros((64, 3)), lasers=truth
        )
        coverage = SensorCoverage(np.ones((64, 720), bool), 60.0)
        pulses, _ = AlignedSweeps(recorded, alignment, coverage).read_pulses(2)
        vectors = pulses.world - pulses.origins
        rays.append((pulses.origins, vectors / pulses.range_m[:, None]))
    for name, one, other in zip(("origins", "directions"), *rays, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-7, err_msg=name)


def test_range_images_are_as_seen_from_the_lasers():
    """Half-way between a laser and a point of its ring, its own rays passed, not other surfaces."""
    truth, azimuth = true_lasers()
    points, ring = room_sweep(truth, azimuth)
    origins = truth.origins(points, ring)
    halfway = origins + 0.5 * (points - origins)
    image = RangeImage.from_points(points, truth)
    passed, confirmed = image.classify(points)
    assert not passed.any() and confirmed.mean() > 0.99
    shares = [
        RangeImage.from_points(points, lasers).classify(halfway)[0].mean()
        for lasers in (truth, RingLasers.at_origin(truth.elevation_rad))
    ]
    assert shares[0] > 0.97
    assert shares[1] < shares[0] - 0.02


@pytest.mark.parametrize(
    ("motion", "expected"),
    [
        (Motion.CENTERED_COUNTERCLOCKWISE, [0, 0.25, -0.5, -0.25]),
        (Motion.CENTERED_CLOCKWISE, [0, -0.25, -0.5, 0.25]),
    ],
)
def test_timestamps_may_be_those_of_the_middle_of_a_sweep(motion, expected):
    points = np.array([[1.0, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]])
    sweep = Sweep(points, {"row": np.zeros(4, int), "start_rad": np.zeros(4)})
    np.testing.assert_allclose(motion.times_s(sweep, 0.1), 0.1 * np.array(expected))
    matrices = np.tile(np.eye(4), (4, 1, 1))
    matrices[:, 0, 3] = np.arange(4)
    poses = RecordedPoses(matrices, 0.1 * np.arange(4), "from registration", np.zeros(3), 0.5, 0.0)
    found = Alignment.from_poses(poses, 0.1, motion, 1)
    np.testing.assert_allclose(found.poses[:, 0, 3], np.arange(4))


SWEEPS = 8
HEIGHT_M = 1.7
TILT_DEG = (0.0, 1.5, 2.0)  # Rings on a level floor would have a constant range.


@pytest.fixture(scope="module")
def street():
    """A street in a small city."""
    return city(5_000)


def recorded_drive(street, sensor):
    """Return the sweeps of a drive through the city: a cloud in memory."""
    survey = Survey(
        sensors=[Mounted(sensor, Pose((0, 0, HEIGHT_M), *TILT_DEG), "lidar")],
        trajectory=left_turn((SWEEPS + 1) / sensor.head.rate_hz),
        steps=36 * SWEEPS,
        columns=["time", "intensity"],
        precision_m=1e-5,
    )
    return simulated_drive(street, survey)


def as_fired(drive):
    """Return the sweeps as fired, with rings and times of the points, and without poses."""
    opened = open_recording(drive, name="drive")

    def read(number):
        sweep = opened.fired(number)
        time_s = 1e-9 * sweep.columns["time"]
        return Sweep(sweep.points, {"ring": sweep.rings, "timestamp": time_s})

    return made_recording("drive", len(opened), read)


@pytest.fixture(scope="module")
def hdl64(street):
    """The twin of an HDL-64E, of which every second laser is used, to save time."""
    sensor = load_sensor("velodyne/hdl64e-s2", rate_hz=20)
    order = np.argsort(-sensor.beams.elevation)[::2]
    beams = sensor.beams
    used = Beams(
        beams.elevation[order], beams.azimuth[order], beams.time_ns[order], beams.origin[order]
    )
    return twin(as_fired(recorded_drive(street, replace(sensor, beams=used))))


@pytest.mark.extended
def test_a_twin_states_where_the_lasers_of_an_hdl_64e_are(hdl64, tmp_path):
    hdl64.save(tmp_path / "twin")
    stated = yaml.safe_load((tmp_path / "twin" / "sensor.yaml").read_text())
    truth, _ = true_lasers()
    number = np.arange(0, 64, 2)
    elevation_rad = truth.elevation_rad[number]
    expected_m = truth.positions(np.zeros(32), elevation_rad, number)[::-1]
    # The rings are sorted by the median elevations of their points, which are those of the beams
    # only at long range.
    order = np.argsort(stated["beams"]["elevation_deg"])
    origins_m = np.array(stated["beams"]["origin_m"])
    np.testing.assert_allclose(origins_m[order], expected_m, atol=3e-3)
    elevation_deg = np.array(stated["beams"]["elevation_deg"])[order]
    np.testing.assert_allclose(elevation_deg, np.degrees(elevation_rad[::-1]), atol=0.01)
    assert "function of the range" in stated["sources"]["origins"]
    loaded = load_sensor(tmp_path / "twin" / "sensor.yaml")
    np.testing.assert_allclose(loaded.beams.origin, origins_m[order])


@pytest.mark.extended
def test_a_twin_of_an_hdl_64e_has_the_ranges_of_held_out_sweeps(hdl64):
    held = hdl64.figures["held_out"]["stationary"]
    assert held["median_abs_difference_m"] < 0.01
    assert held["p90_abs_difference_m"] < 0.15
    assert held["no_surface"] < 0.02


def test_a_sensor_without_offsets_has_none(street):
    drive = recorded_drive(street, Sensor.grid(480, 24, vertical_fov_deg=40))
    sweeps = RecordedSweeps.from_recording(as_fired(drive))
    assert sweeps.lasers.is_at_origin and sweeps.lasers.have_constant_elevations

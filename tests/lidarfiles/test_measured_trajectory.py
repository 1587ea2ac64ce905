"""Points that are georeferenced by the measured trajectory, against closed forms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.shapes import cast_between, level
from tests.simulated_drives import simulated_points

from lidarfiles.clouds.navigation_files import write_instruments
from lidarsim import (
    Gnss,
    Imu,
    LidarError,
    Mounted,
    Navigation,
    Pose,
    Scene,
    Survey,
    Track,
    load_sensor,
)
from lidarsim.motion.navigation import gnss_fixes
from lidarsim.motion.trajectory_files import load_trajectory
from lidarsim.simulator.rig import Rig
from lidarsim.sweeps.instruments import TRAJECTORY_FILE
from lidarsim.sweeps.sweeps import Sweeps

HEIGHT = 500.0
SPEED = 60.0
COLUMNS = ("time", "true_x", "true_y", "true_z", "origin_x", "origin_y", "origin_z")
# A heading of 30° from x, so that errors in the platform frame differ from those in the world.
HEADING = np.radians(30)
AHEAD = np.array([np.cos(HEADING), np.sin(HEADING), 0])
LEFT = np.array([-np.sin(HEADING), np.cos(HEADING), 0])
ORIGIN = np.array([500_000.0, 5_400_000.0, 0.0])


@pytest.fixture(scope="module")
def scene():
    return Scene.from_meshes([level("Ground", half=700)]).with_world_origin(tuple(ORIGIN))


def flight(navigation, *, steps=40, **options):
    """A scanner that fires 40 lines of a flight of two seconds."""
    sensor = load_sensor("airborne/leica-als50-ii", columns=50, step_deg=360, max_range_m=2000)
    times = np.array([0.0, 2.0])
    positions = np.array([0, 0, HEIGHT]) + (times * SPEED)[:, None] * AHEAD
    track = Track(times, positions, yaw_deg=30)
    mounted = Mounted(sensor, Pose((0.5, 0, -1), pitch_deg=2), steps=steps)
    columns = options.pop("columns", COLUMNS)
    return Survey(
        trajectory=track,
        sensors=[mounted],
        navigation=navigation,
        columns=columns,
        precision_m=1e-4,
        **options,
    )


def cloud(scene, survey):
    """Positions without the world origin, and the other columns."""
    found = simulated_points(scene, survey)
    return found.positions - ORIGIN, found.columns


def shifts(scene, navigation, **options):
    """By how much the measured trajectory moves each point; true positions, and all columns."""
    survey = flight(navigation, georeferencing="measured", **options)
    points, columns = cloud(scene, survey)
    truth = np.stack([columns[f"true_{axis}"] for axis in "xyz"], axis=1) - ORIGIN
    return points - truth, truth, columns


def test_a_boresight_roll_moves_a_nadir_point_by_87_mm(scene):
    navigation = Navigation(mount_error=Pose((0, 0, 0), roll_deg=0.01))
    moved, truth, columns = shifts(scene, navigation)
    track = np.stack([columns["origin_x"], columns["origin_y"]], axis=1) - ORIGIN[:2]
    across = (truth[:, :2] - track) @ LEFT[:2]
    nadir = moved[np.abs(across).argmin()]
    assert nadir @ LEFT == pytest.approx((HEIGHT - 1) * np.radians(0.01), abs=2e-4)  # 87 mm
    assert abs(nadir @ AHEAD) < 2e-4 and abs(nadir[2]) < 2e-3
    # At an angle a from the nadir, the point rises by y * error.
    assert moved[:, 2] == pytest.approx(across * np.radians(0.01), abs=3e-4)
    assert np.abs(across).max() > 150


def test_a_lever_arm_error_moves_all_points_along_the_heading(scene):
    moved, _, columns = shifts(scene, Navigation(mount_error=Pose((0.1, 0, 0))))
    assert moved == pytest.approx(np.tile(0.1 * AHEAD, (len(moved), 1)), abs=1e-4)
    exact = cloud(scene, flight(None))[1]
    origins = [np.stack([c[f"origin_{a}"] for a in "xyz"], axis=1) for c in (columns, exact)]
    assert origins[0] - origins[1] == pytest.approx(moved, abs=1e-4)


def test_a_boresight_error_rotates_about_the_sensor_and_not_the_platform(scene):
    # A yaw of 0.1° about the sensor, which is 0.5 m ahead of the platform's origin.
    moved, _, columns = shifts(scene, Navigation(mount_error=Pose((0, 0, 0), yaw_deg=0.1)))
    exact = cloud(scene, flight(None))[1]
    for axis in "xyz":
        assert columns[f"origin_{axis}"] == pytest.approx(exact[f"origin_{axis}"], abs=1e-6)
    assert np.linalg.norm(moved, axis=1).max() > 0.2


def test_a_gnss_offset_moves_all_points_equally(scene):
    moved, _, _ = shifts(scene, Navigation(gnss=Gnss(offset_m=(0.3, -0.2, 0.1))))
    assert moved == pytest.approx(np.tile([0.3, -0.2, 0.1], (len(moved), 1)), abs=1e-4)


def test_points_follow_the_gnss_positions(scene):
    gnss = Gnss(rate_hz=5, horizontal_m=0.05, vertical_m=0.1, drift_horizontal_m=0.3)
    navigation = Navigation(gnss=gnss, seed=4)
    moved, _, columns = shifts(scene, navigation)
    survey = flight(navigation)
    (fixes,) = gnss_fixes(survey)
    errors = fixes.positions - survey.path.poses(0, fixes.times_ns.astype(float))[0]
    within = columns["time"] <= fixes.times_ns[-1]
    expected = [np.interp(columns["time"], fixes.times_ns, error) for error in errors.T]
    assert moved[within] == pytest.approx(np.array(expected).T[within], abs=1e-4)
    assert np.abs(errors).max() > 0.05


@pytest.mark.extended
def test_the_spread_of_attitude_errors(scene):
    # Over many seeds, the roll error at the nadir has the standard deviation of the model.
    imu = Imu(roll_pitch_deg=0.02, heading_deg=0.05, attitude_time_s=60)
    angles = []
    for seed in range(300):
        survey = flight(Navigation(imu=imu, seed=seed), georeferencing="measured")
        _, measured = survey.reported_path.poses(0, np.array([1e9]))
        _, true = survey.path.poses(0, np.array([1e9]))
        error = true[0].T @ measured[0]
        angles.append(np.degrees([error[2, 1], error[0, 2], error[1, 0]]))
    assert np.std(angles, axis=0) == pytest.approx([0.02, 0.02, 0.05], rel=0.15)
    # Five standard errors of the mean of 300 values.
    assert (np.abs(np.mean(angles, axis=0)) < 0.3 * np.array([0.02, 0.02, 0.05])).all()


def test_a_trajectory_without_errors_changes_no_byte(scene):
    exact, _ = cloud(scene, flight(None))
    for navigation in (Navigation(), Navigation(gnss=Gnss(), imu=Imu())):
        measured, _ = cloud(scene, flight(navigation, georeferencing="measured"))
        assert np.array_equal(measured, exact)


def test_batches_do_not_change_the_points(scene):
    gnss = Gnss(drift_horizontal_m=0.3, outages=[(0.2, 0.7)])
    imu = Imu(roll_pitch_deg=0.01, accelerometer_bias=0.01)
    survey = flight(Navigation(gnss=gnss, imu=imu), georeferencing="measured")
    whole, _ = cast_between(Rig(scene, survey, "numpy"), survey, [0, 40])
    parts, _ = cast_between(Rig(scene, replace(survey), "numpy"), survey, [0, 7, 8, 40])
    assert parts == whole


def test_sensor_coordinates_are_those_of_the_sensor(scene):
    # What a format stores in the frame of the sensor has no errors of the trajectory.
    navigation = Navigation(
        gnss=Gnss(drift_horizontal_m=2.0, rate_hz=5),
        imu=Imu(roll_pitch_deg=0.5, heading_deg=1.0),
        mount_error=Pose((0.3, 0, 0), roll_deg=1),
    )
    exact = flight(None, coordinates="sensor")
    inside, _ = cloud(scene, exact)
    survey = flight(navigation, georeferencing="measured")
    points = simulated_points(scene, survey)
    sweeps = Sweeps.from_survey(survey, scene)
    found = [sweeps.as_fired(sweep, part) for sweep, part in enumerate(sweeps.points(points))]
    assert np.concatenate(found) == pytest.approx(inside, abs=2e-3)
    assert (
        np.linalg.norm(points.positions - ORIGIN - cloud(scene, flight(None))[0], axis=1).max() > 1
    )


def test_the_trajectory_file_is_the_measured_trajectory(scene, tmp_path):
    navigation = Navigation(
        gnss=Gnss(drift_horizontal_m=0.5), imu=Imu(rate_hz=50, heading_deg=0.1), seed=2
    )
    survey = flight(navigation, georeferencing="measured")
    write_instruments(tmp_path, survey, ORIGIN)
    read = load_trajectory(tmp_path / TRAJECTORY_FILE)
    times = np.array([0.0, 0.34e9, 0.88e9])
    positions, rotations = read.poses(0, times)
    expected = survey.reported_path.poses(0, times)
    assert positions - ORIGIN == pytest.approx(expected[0], abs=1e-4)
    assert rotations == pytest.approx(expected[1], abs=1e-6)
    other = tmp_path / "exact"
    other.mkdir()
    write_instruments(other, flight(navigation), ORIGIN)
    assert {path.name for path in other.iterdir()} == {"imu.csv", "gnss.csv"}


@pytest.mark.parametrize(
    ("navigation", "words"),
    [
        (None, "requires the errors of the trajectory"),
        (Navigation(gnss=Gnss(outages=[(1, 2)])), "requires an IMU to bridge"),
    ],
)
def test_what_cannot_be_measured(navigation, words):
    with pytest.raises(LidarError, match=words):
        flight(navigation, georeferencing="measured")

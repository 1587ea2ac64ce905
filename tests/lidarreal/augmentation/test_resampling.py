"""Resampling of recorded sweeps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.made_recordings import changed_recording, made_recording

from lidarreal.augmentation.resampling import SensorResampler
from lidarreal.augmentation.ring_directions import RingDirections
from lidarsim import LidarError, Sensor, load_sensor
from lidarsim.columns.sweep import Sweep

# Distances of the walls, the floor and the ceiling from the sensor, which is not in the center.
BEHIND_M = np.array([15.0, 12.0, 4.0])
AHEAD_M = np.array([20.0, 9.0, 5.0])
DENSE = Sensor.grid(720, 31, vertical_fov_deg=30)  # 0.5 by 1 degrees
SPARSE = Sensor.grid(240, 16, vertical_fov_deg=30)  # 1.5 by 2 degrees
PITCH = np.radians(4)
TILT = np.array([[np.cos(PITCH), 0, np.sin(PITCH)], [0, 1, 0], [-np.sin(PITCH), 0, np.cos(PITCH)]])


def rays(sensor):
    steps = sensor.steps_of_revolution(0)
    firings = np.arange(sensor.firings(steps[0])[0], sensor.firings(steps[-1])[1])
    return sensor.directions(firings).reshape(-1, 3)


def scan_room(sensor):
    """Return a sweep in a room, in which each pulse has a return."""
    directions = rays(sensor)
    walls_m = np.where(directions > 0, AHEAD_M, BEHIND_M)
    range_m = (walls_m / np.abs(directions).clip(min=1e-12)).min(axis=1)
    columns = {
        "channel": (np.arange(len(directions)) % sensor.channels).astype(np.uint16),
        "intensity": np.arange(len(directions), dtype=np.float32),
        "time": np.arange(len(directions)),
    }
    return Sweep(directions * range_m[:, None], columns)


def recording(sweep, name="drive"):
    return made_recording(name, 1, lambda _: sweep)


@pytest.fixture(scope="module")
def dense():
    return scan_room(DENSE)


def angles_deg(points, channel, sensor):
    """Return the smallest elevation and azimuth difference of points to rays of their channels."""
    wanted = np.degrees(np.sort(sensor.beams.elevation))[channel]
    elevation = np.degrees(np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1])))
    step = 360 / sensor.head.firings_per_turn
    azimuth = np.degrees(np.arctan2(points[:, 1], points[:, 0])) / step
    return np.abs(elevation - wanted), np.abs(azimuth - np.rint(azimuth)) * step


def test_rays_that_were_recorded_return_the_simulated_sweep(dense):
    resampler = SensorResampler(recording(dense), SPARSE)
    augmented = resampler.sweep(0)
    expected = scan_room(SPARSE)
    assert np.allclose(augmented.sweep.points, expected.points, atol=1e-9)
    assert (augmented.sweep.columns["channel"] == expected.columns["channel"]).all()
    assert (augmented.sweep.points == dense.points[augmented.template]).all()
    assert (augmented.sweep.columns["time"] == dense.columns["time"][augmented.template]).all()
    assert (np.diff(augmented.template) > 0).all() and augmented.is_recorded.all()
    assert not augmented.sweep.columns["cause"].any()
    assert augmented.sweep.columns["channel"].dtype == np.uint16


def test_rays_on_recorded_rings_find_their_pulses(dense):
    """The elevations of the returns are rounded differently."""
    for elevation_deg in (-14.0, -3.0, 4.0):
        sensor = Sensor.grid(240, 1, vertical_fov_deg=0)
        beams = replace(sensor.beams, elevation=np.radians([elevation_deg]))
        augmented = SensorResampler(recording(dense), replace(sensor, beams=beams)).sweep(0)
        assert len(augmented.sweep) == 240


def test_closest_pulses_are_at_most_half_of_the_recorded_spacing_away(dense):
    other = load_sensor("velodyne/vlp16", rate_hz=20)  # 0.4 degrees
    dense = scan_room(Sensor.grid(1440, 47, vertical_fov_deg=32))
    augmented = SensorResampler(recording(dense), other).sweep(0)
    counts = np.bincount(augmented.sweep.columns["channel"])
    # The first and the last of the 905 firings are 0.1 degrees apart, and may share a return.
    assert np.isin(counts, [904, 905]).all() and len(counts) == 16
    up_deg, _ = angles_deg(augmented.sweep.points, augmented.sweep.columns["channel"], other)
    assert up_deg.max() < 32 / 46 / 2 + 1e-6
    # The walls are planes, so each point lies exactly on one of them.
    points = augmented.sweep.points
    walls_m = np.where(points > 0, AHEAD_M, BEHIND_M)
    assert np.allclose((np.abs(points) / walls_m).max(axis=1), 1)


def test_pulses_without_a_return_stay_without_one(dense):
    ring, column = dense.columns["channel"], np.arange(len(dense)) // DENSE.channels
    is_lost = (ring == 10) & (column >= 90) & (column < 120)  # 10 rays of channel 5
    sweep = dense.select(~is_lost)
    augmented = SensorResampler(recording(sweep), SPARSE).sweep(0)
    counts = np.bincount(augmented.sweep.columns["channel"])
    assert counts.tolist() == [240] * 5 + [230] + [240] * 10
    # Zeros and NaN are pulses without a return, and rows are those of the recording.
    points = dense.points.copy()
    points[is_lost] = 0
    points[np.flatnonzero(is_lost)[:9]] = np.nan
    organized = SensorResampler(recording(dense.replace(points=points)), SPARSE).sweep(0)
    assert (organized.sweep.points == augmented.sweep.points).all()
    assert (organized.template == np.flatnonzero(~is_lost)[augmented.template]).all()


def shifted(sweep, azimuth_deg, elevation_deg):
    """Return a sweep whose points have other directions at the same ranges."""
    x, y, z = sweep.points.T
    range_m = np.linalg.norm(sweep.points, axis=1)
    azimuth = np.arctan2(y, x) + np.radians(azimuth_deg)
    elevation = np.arcsin(z / range_m) + np.radians(elevation_deg)
    level = np.cos(elevation)
    directions = [level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)]
    return sweep.replace(points=(range_m * directions).T)


@pytest.mark.parametrize("share", [0.2, 0.7])
@pytest.mark.parametrize("azimuth_deg", [-0.2, 0, 0.2])  # of 0.5 degrees between the pulses
def test_random_losses_remove_the_same_pulses(dense, share, azimuth_deg):
    dense = shifted(dense, azimuth_deg, 0)
    complete = SensorResampler(recording(dense), SPARSE).sweep(0).template
    remaining = np.flatnonzero(np.random.default_rng(3).random(len(dense)) >= share)
    augmented = SensorResampler(recording(dense.select(remaining)), SPARSE).sweep(0)
    assert (remaining[augmented.template] == np.intersect1d(complete, remaining)).all()


@pytest.mark.parametrize("elevation_deg", [-0.4, 0.4])
def test_rings_without_a_return_are_not_replaced_by_their_neighbors(dense, elevation_deg):
    """Other sweeps return from the ring, and from elevations at which its neighbors match, too."""
    dense = shifted(dense, 0, elevation_deg)
    sign = np.where(np.arange(len(dense)) % 2, 1, -1)
    blurred = shifted(dense, 0, 0.3 * sign)
    ring = dense.columns["channel"]
    is_lost = np.isin(ring, [6, 7, 20])
    sweeps = [blurred, dense, dense.select(~is_lost)]
    resampler = SensorResampler(made_recording("drive", 3, lambda number: sweeps[number]), SPARSE)
    complete = resampler.sweep(1).template
    assert len(complete) == 240 * 16 and is_lost[complete].sum() == 240 * 2
    remaining = np.flatnonzero(~is_lost)[resampler.sweep(2).template]
    assert (remaining == complete[~is_lost[complete]]).all()


def test_noisy_directions_have_the_same_resolution(dense):
    random = np.random.default_rng(4)
    noisy = dense.replace(points=dense.points * random.normal(1, 0.0015, dense.points.shape))
    augmented = SensorResampler(recording(noisy), SPARSE).sweep(0)
    assert len(augmented.sweep) > 0.99 * 240 * 16


def test_times_are_those_of_the_recorded_points(dense):
    seconds = np.arange(len(dense)) / len(dense) / 10
    timed = dense.replace(columns={**dense.columns, "time": seconds})
    drive = recording(timed)
    sweep = drive[0]
    augmented = SensorResampler(drive, SPARSE).sweep(sweep)
    assert np.allclose(augmented.sweep.times_s, seconds[augmented.template])


def test_all_returns_of_a_pulse_are_copied(dense):
    twice = Sweep.concatenate([dense, dense.replace(points=0.5 * dense.points)])
    augmented = SensorResampler(recording(twice), SPARSE).sweep(0)
    assert len(augmented.sweep) == 2 * 240 * 16
    assert len(np.unique(augmented.template)) == len(augmented.template)


def test_equal_resolution_uses_each_return_once(dense):
    jitter = np.random.default_rng(1).normal(0, np.radians(0.1), len(dense))
    cos, sin = np.cos(jitter), np.sin(jitter)
    x, y, z = dense.points.T
    shaken = dense.replace(points=np.column_stack([cos * x - sin * y, sin * x + cos * y, z]))
    augmented = SensorResampler(recording(shaken), DENSE).sweep(0)
    assert len(np.unique(augmented.template)) == len(augmented.template)
    assert len(augmented.sweep) > 0.95 * len(dense)


@pytest.mark.parametrize("is_swapped", [False, True])
def test_the_ray_with_the_smaller_angle_receives_a_shared_pulse(dense, is_swapped):
    """Two channels are above and below a ring. Both differences add up to the angle."""
    sensor = Sensor.grid(240, 32, vertical_fov_deg=31)
    azimuth_deg = np.zeros(32)
    azimuth_deg[[7, 8]] = 0.05, 0.1
    elevation_deg = np.concatenate([np.arange(-15, -8), [-8.25, -7.77], np.arange(-7, 16)])
    order = np.arange(32)
    if is_swapped:
        order[[7, 8]] = 8, 7
    azimuth, elevation = np.radians(azimuth_deg)[order], np.radians(elevation_deg)[order]
    beams = replace(sensor.beams, azimuth=azimuth, elevation=elevation)
    augmented = SensorResampler(recording(dense), replace(sensor, beams=beams)).sweep(0)
    counts = np.bincount(augmented.sweep.columns["channel"], minlength=32)
    assert counts[order].tolist() == [240] * 7 + [0] + [240] * 24


def test_tilted_rings_are_measured(dense):
    tilted = dense.replace(points=dense.points @ TILT.T)
    narrow = Sensor.grid(240, 8, vertical_fov_deg=20)
    augmented = SensorResampler(recording(tilted), narrow).sweep(0)
    channel = augmented.sweep.columns["channel"]
    assert len(augmented.sweep) > 0.98 * 240 * 8
    up_deg, across_deg = angles_deg(augmented.sweep.points, channel, narrow)
    assert up_deg.max() < 0.6 and across_deg.max() < 0.3
    assert len(np.unique(tilted.columns["channel"][augmented.template[channel == 4]])) > 7


def test_elevations_of_tilted_rings_depend_on_the_azimuth(dense):
    tilted = dense.replace(points=dense.points @ TILT.T)
    pulses = RingDirections(recording(tilted))
    x, y, z = tilted.points[::97].T
    azimuth = np.arctan2(y, x)
    elevation = np.degrees(np.arctan2(z, np.hypot(x, y)))
    found = np.degrees(pulses.elevations_at(azimuth))
    ring = DENSE.channels - 1 - dense.columns["channel"][::97].astype(int)
    assert np.ptp(found[:, 15]) > 7  # a tilt by 4 degrees
    np.testing.assert_allclose(found[np.arange(len(ring)), ring], elevation, atol=0.2)
    assert np.degrees(pulses.spread_rad) < 0.2


def test_compensated_results_use_the_directions_as_fired(dense):
    moved = dense.points + np.linspace(0, 0.5, len(dense))[:, None] * [1, 0, 0]
    compensated = made_recording(
        "drive", 1, lambda _: dense.replace(points=moved), compensated=True, fired=lambda _: dense
    )
    augmented = SensorResampler(compensated, SPARSE).sweep(0)
    assert (augmented.template == SensorResampler(recording(dense), SPARSE).sweep(0).template).all()
    assert (augmented.sweep.points == moved[augmented.template]).all()
    # Without these directions, the measured directions are used.
    measured = SensorResampler(recording(dense.replace(points=moved)), SPARSE).sweep(0)
    channel = measured.sweep.columns["channel"]
    up_deg, across_deg = angles_deg(measured.sweep.points, channel, SPARSE)
    assert len(channel) > 0.95 * 240 * 16 and up_deg.max() < 1.05
    assert np.quantile(up_deg, 0.9) < 0.6 and np.quantile(across_deg, 0.9) < 0.3


def test_returns_outside_the_range_are_removed(dense):
    near = replace(SPARSE, min_range_m=13.0, max_range_m=16.0)
    augmented = SensorResampler(recording(dense), near).sweep(0)
    expected = np.linalg.norm(scan_room(SPARSE).points, axis=1)
    assert len(augmented.sweep) == ((expected >= 13) & (expected <= 16)).sum() > 100


def test_rings_from_the_order_of_points(dense):
    order = np.lexsort((np.arange(len(dense)), dense.columns["channel"]))[::-1]
    kitti = Sweep(dense.points[order], {"intensity": dense.columns["intensity"][order]})
    augmented = SensorResampler(recording(kitti), SPARSE).sweep(0)
    channel = augmented.sweep.columns["channel"]
    assert np.bincount(channel).tolist() == [240] * 16
    assert angles_deg(augmented.sweep.points, channel, SPARSE)[0].max() < 1e-6


def test_a_sector_of_the_field_of_view(dense):
    sector = Sensor.grid(80, 16, vertical_fov_deg=30, horizontal_fov_deg=120)
    augmented = SensorResampler(recording(dense), sector).sweep(0)
    assert len(augmented.sweep) == 80 * 16
    assert (augmented.sweep.points[:, 0] > 0).all()


@pytest.mark.parametrize("clockwise", [False, True])
def test_blocked_directions_of_the_other_sensor_have_no_points(dense, clockwise):
    """Each channel has its own sectors, one of which contains the direction behind the sensor."""
    head = replace(SPARSE.head, clockwise=clockwise)
    sectors_deg = np.array([[20.2, 80.2], [170.2, -175.3], [10.2, 30.2], [-90.3, -60.3]])
    blocked = np.column_stack([[0, 2, 2, 15], np.radians(sectors_deg)])
    free = replace(SPARSE, head=head)
    platform = replace(free, beams=replace(free.beams, blocked=blocked))
    resampled = [SensorResampler(recording(dense), sensor).sweep(0) for sensor in (free, platform)]
    expected, found = (
        {*zip(one.template.tolist(), one.sweep.columns["channel"].tolist(), strict=True)}
        for one in resampled
    )
    points, channel = resampled[0].sweep.points, resampled[0].sweep.columns["channel"]
    azimuth = np.degrees(np.arctan2(points[:, 1], points[:, 0]))
    hidden = np.zeros(len(azimuth), bool)
    for beam, (first, last) in zip((0, 2, 2, 15), sectors_deg.tolist(), strict=True):
        hidden |= (channel == beam) & ((azimuth - first) % 360 < (last - first) % 360)
    kept = {*zip(resampled[0].template[~hidden], channel[~hidden].tolist(), strict=True)}
    assert found == kept and len(expected) - len(found) == hidden.sum() > 50


def test_partial_omits_what_was_not_recorded(dense):
    tall = Sensor.grid(240, 16, vertical_fov_deg=60)  # 4 degrees, 8 channels in the view
    resampler = SensorResampler(recording(dense), tall, partial=True)
    assert np.unique(resampler.sweep(0).sweep.columns["channel"]).tolist() == [*range(4, 12)]
    assert resampler.notes[0] == (
        "50 % of the pulses of Sensor with 16 channels are outside the field of view or between "
        "the rings of drive and are omitted. 8 of 16 channels remain."
    )
    front = dense.select(dense.points[:, 0] > 0)
    half = SensorResampler(recording(front), SPARSE, partial=True).sweep(0)
    assert (half.sweep.points[:, 0] > 0).all() and len(half.sweep) == 120 * 16


def test_rings_that_never_return_are_known_from_the_model(dense):
    ground = dense.select(dense.points[:, 2] < 0.1)
    with pytest.raises(LidarError, match=r"channels at 1.0°, 3.0°, 5.0° and 5 more, which are out"):
        SensorResampler(recording(ground), SPARSE)
    augmented = SensorResampler(recording(ground), SPARSE, recorded_sensor=DENSE).sweep(0)
    assert np.bincount(augmented.sweep.columns["channel"]).tolist() == [240] * 8


FAR = replace(SPARSE, max_range_m=100.0)
COARSE = replace(DENSE, max_range_m=60.0)


@pytest.mark.parametrize(
    ("sensor", "options", "message"),
    [
        (
            Sensor.grid(240, 8, vertical_fov_deg=60),
            {},
            "Sensor with 8 channels has channels at -30.0°, -21.4°, 21.4° and 1 more, which are "
            "outside the vertical field of view of drive (-15.0° to 15.0°). Use `--partial` to "
            "omit such pulses.",
        ),
        (
            Sensor.grid(240, 40, vertical_fov_deg=30),
            {},
            "Sensor with 40 channels has a channel at -13.5°, but the closest ring of drive is "
            "0.5° away.",
        ),
        (
            Sensor.grid(1440, 16, vertical_fov_deg=30),
            {},
            "The azimuth resolution of Sensor with 16 channels is 0.25°, but that of drive is only "
            "0.5°. Use a sensor with fewer firings per revolution.",
        ),
        (
            FAR,
            {"recorded_sensor": COARSE},
            "The maximum range of Sensor with 16 channels is 100 m, but that of Sensor with 31 "
            "channels in drive is only 60 m. Use a sensor file with a lower `max_range_m`.",
        ),
    ],
)
def test_finer_sensors_are_refused(dense, sensor, options, message):
    with pytest.raises(LidarError) as error:
        SensorResampler(recording(dense), sensor, **options)
    assert str(error.value).startswith(message)
    assert str(error.value).endswith("use `lidarpool twin`.")


def test_pulses_of_prism_sensors_are_not_described_as_channels(dense):
    with pytest.raises(LidarError) as error:
        SensorResampler(recording(dense), load_sensor("livox/mid70"))
    assert str(error.value).startswith(
        "The pulses of Livox Mid-70 have elevations from -34.9° to 35.1°, but 37 % of them are "
        "outside the vertical field of view of drive (-15.0° to 15.0°). Use `--partial` to omit "
        "such pulses. To simulate"
    )


def test_other_kinds_of_sensors_are_refused_unless_their_rays_are_apart(dense):
    with pytest.raises(LidarError, match="of the rays of Livox Mid-70 are closer to each other"):
        SensorResampler(recording(dense), load_sensor("livox/mid70"), partial=True)
    with pytest.raises(LidarError, match="horizontal field of view of drive is 179°, and does not"):
        SensorResampler(recording(dense.select(dense.points[:, 0] > 0)), SPARSE)


def test_recordings_without_rings_or_sweeps_are_refused(dense):
    shuffled = np.random.default_rng(2).permutation(len(dense))
    tilted = Sweep((dense.points @ TILT.T)[shuffled])
    with pytest.raises(LidarError, match=r"drive has no ring column, .* Without rings, its sweeps"):
        SensorResampler(recording(tilted), SPARSE)
    with pytest.raises(LidarError, match="drive contains no sweeps"):
        SensorResampler(changed_recording(recording(dense), count=0), SPARSE)


def test_notes_state_the_accuracy_and_the_range(dense):
    resampler = SensorResampler(recording(dense), FAR)
    assert resampler.notes[0] == (
        "The maximum range of Sensor with 16 channels is 100 m, but the returns in drive only "
        "reach 24 m. Surfaces beyond the maximum range of the recorded sensor are missing."
    )
    assert resampler.notes[1].endswith("vertically and 0.25° horizontally.")


def test_an_empty_sweep_stays_empty(dense):
    sweeps = [dense, dense.select(slice(0))]
    two = made_recording("drive", 2, lambda number: sweeps[number])
    assert not len(SensorResampler(two, SPARSE).sweep(1).sweep)

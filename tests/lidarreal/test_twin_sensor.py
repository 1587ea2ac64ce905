"""The sensor of a twin: rotation, beams and errors of rings, and the pulses that it lost."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.made_recordings import made_recording

from lidarreal.reconstruction import recorded_sensor
from lidarreal.reconstruction.air_returns import AirStatistics, find_air_returns
from lidarreal.reconstruction.alignment import AlignedSweeps, Alignment
from lidarreal.reconstruction.blocked_directions import BlockedDirections
from lidarreal.reconstruction.lost_pulses import SensorCoverage, firings_per_turn, lost_pulses
from lidarreal.reconstruction.motion import Motion
from lidarreal.reconstruction.moving_rays import TimedPulses, collect_moving_rays
from lidarreal.reconstruction.object_tracks import ObjectTrack
from lidarreal.reconstruction.recorded_sensor import SweepTiming, fit_sensor
from lidarreal.reconstruction.recorded_sweeps import RecordedSweeps, ring_starts
from lidarreal.reconstruction.reflectances import IntensityModel, Response
from lidarreal.scan_patterns.lasers import RingLasers
from lidarsim import LidarError
from lidarsim.columns.sweep import Sweep
from lidarsim.sensor.models import Detection, Performance

pytest.importorskip("scipy")

RINGS = 16
COLUMNS = 720
ELEVATION_DEG = np.linspace(11, -19, RINGS)
START_DEG = 100.0
PERIOD_S = 0.05


def directions(clockwise, staggered=0.0):
    """Return unit vectors firing by firing, with the ring and the share of the revolution."""
    column, ring = (index.ravel() for index in np.indices((COLUMNS, RINGS)))
    share = column / COLUMNS
    azimuth = np.radians(START_DEG) + (-1 if clockwise else 1) * 2 * np.pi * share
    azimuth = azimuth + np.radians(np.where(ring % 2, staggered, -staggered))
    elevation = np.radians(ELEVATION_DEG)[ring]
    level = np.cos(elevation)
    vectors = np.stack(
        [level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=1
    )
    return vectors, ring, share


def recorded(clockwise=False, timed=True, count=5, stamps_s=None, kept=None):
    """Return sweeps of a sensor that turns, in a round hall with a radius of 12 m."""
    vectors, ring, share = directions(clockwise)
    range_m = 12 / np.hypot(vectors[:, 0], vectors[:, 1])
    columns = {"ring": RINGS - 1 - ring}
    if timed:
        columns["time"] = (1e9 * PERIOD_S * share).astype(np.int64)
    points = range_m[:, None] * vectors
    rows = np.arange(len(ring)) if kept is None else np.flatnonzero(kept(ring, share))
    sweep = Sweep(points, columns).select(rows)
    stamps = None if stamps_s is None else (lambda: (1e9 * stamps_s).astype(np.int64))
    return RecordedSweeps.from_recording(
        made_recording("hall", count, lambda _: sweep, read_stamps=stamps)
    )


def aligned(sweeps, times_s, motion, offsets=None, blocked=None):
    """Return aligned sweeps of a sensor that moves by 1.5 m per second and turns."""
    poses = np.tile(np.eye(4), (len(times_s), 1, 1))
    poses[:, :3, 3] = np.outer(times_s, [1.5, -0.5, 0.1])
    offsets = np.zeros((RINGS, 3)) if offsets is None else offsets
    sweep_s = float(np.median(np.diff(times_s)))
    alignment = Alignment(poses, times_s, sweep_s, 0.1, motion, offsets, lasers=sweeps.lasers)
    cells = BlockedDirections.none() if blocked is None else BlockedDirections(blocked)
    coverage = SensorCoverage(np.ones((RINGS, 720), bool), 40.2, cells)
    return AlignedSweeps(sweeps, alignment, coverage)


@pytest.mark.parametrize("clockwise", [False, True])
@pytest.mark.parametrize("timed", [False, True])
def test_a_rotation_has_a_direction_and_a_start(clockwise, timed):
    sweeps = recorded(clockwise, timed)
    motion = Motion.CLOCKWISE if clockwise else Motion.COUNTERCLOCKWISE
    times_s = PERIOD_S * np.arange(5)
    timing = SweepTiming.from_sweeps(aligned(sweeps, times_s, Motion.TIMED if timed else motion))
    assert (timing.rate_hz, timing.revolutions, timing.first_s) == (20, 5, 0)
    assert timing.rotation.is_clockwise == clockwise
    assert timing.rotation.start_deg == pytest.approx(START_DEG, abs=0.02)
    np.testing.assert_allclose(ring_starts(sweeps.read(1), RINGS), np.radians(START_DEG), atol=1e-6)
    centered = Motion.CENTERED_CLOCKWISE if clockwise else Motion.CENTERED_COUNTERCLOCKWISE
    if not timed:  # the points are sorted from the azimuth in the middle of the sweep on
        middle = SweepTiming.from_sweeps(aligned(sweeps, times_s, centered))
        assert middle.first_s == pytest.approx(-0.5 * PERIOD_S)
        assert middle.rotation.start_deg == pytest.approx(START_DEG + 180, abs=0.02)


def test_dropped_sweeps_are_revolutions_and_the_drive_ends_after_the_last():
    times_s = PERIOD_S * np.array([0.0, 1, 2, 5, 6])  # two sweeps are missing
    sweeps = aligned(recorded(), times_s, Motion.TIMED)
    timing = SweepTiming.from_sweeps(sweeps)
    assert (timing.rate_hz, timing.revolutions) == (20, 7)
    start, stop = timing.start(sweeps.alignment), timing.stop(sweeps.alignment)
    assert (start.time_s, stop.time_s) == (0, pytest.approx(7 * PERIOD_S))
    np.testing.assert_allclose(start.pose[:3, 3], 0, atol=1e-12)
    np.testing.assert_allclose(stop.pose[:3, 3], 7 * PERIOD_S * np.array([1.5, -0.5, 0.1]))
    velocity = np.array([1.5, -0.5, 0.1])
    early = timing._replace(first_s=-0.02)
    start, stop = early.start(sweeps.alignment), early.stop(sweeps.alignment)
    assert (start.time_s, stop.time_s) == pytest.approx((-0.02, 7 * PERIOD_S - 0.02))
    np.testing.assert_allclose(start.pose[:3, 3], start.time_s * velocity)
    np.testing.assert_allclose(stop.pose[:3, 3], stop.time_s * velocity)


def test_a_sensor_has_the_beams_of_the_rings_from_the_lowest_to_the_highest():
    """Offsets of the alignment correct the angles, and are opposite to the errors of the ranges."""
    rng = np.random.default_rng(6)
    angles_deg = rng.uniform((0.1, -0.3), (0.2, -0.1), (RINGS, 2))
    offsets = np.column_stack([rng.uniform(0.02, 0.05, RINGS), np.radians(angles_deg)])
    blocked = np.zeros((RINGS, 36), bool)
    blocked[2, 19] = blocked[15, 3] = True
    by_ring = np.outer(np.linspace(0.5, 1.5, RINGS), np.ones(11))
    response = Response(IntensityModel.ENERGIES, by_ring, 1.3, 40.0, 80.0, 0.3, 1.0)
    sweeps = aligned(recorded(), PERIOD_S * np.arange(5), Motion.TIMED, offsets, blocked)
    model = SweepTiming.from_sweeps(sweeps).sensor(sweeps, 2, response)
    assert (model.firings_per_turn, model.rate_hz, model.clockwise) == (COLUMNS, 20, False)
    assert model.zero_deg == pytest.approx(START_DEG, abs=0.02)
    assert model.range_m == (0, 45)
    elevation_deg = ELEVATION_DEG + np.degrees(offsets[:, 1])
    np.testing.assert_allclose(model.beams.elevation_deg, elevation_deg[::-1], atol=2e-3)
    np.testing.assert_allclose(model.beams.azimuth_deg, np.degrees(offsets[::-1, 2]), atol=1e-3)
    np.testing.assert_allclose(model.performance.channel_bias_m, -offsets[::-1, 0], atol=1e-4)
    sectors = [tuple(sector) for sector in model.beams.blocked_deg]
    assert sectors == [(0, -150, -140), (13, 10, 20)]
    np.testing.assert_allclose(model.beams.intensity_factor, by_ring[::-1])
    assert model.optics.incidence_exponent == 1.3
    small = replace(sweeps.alignment, ring_offsets=0.05 * offsets)
    plain = SweepTiming.from_sweeps(sweeps).sensor(replace(sweeps, alignment=small), 2, None)
    np.testing.assert_allclose(plain.beams.elevation_deg, ELEVATION_DEG[::-1], atol=2e-3)
    assert plain.performance is None


def test_lost_pulses_are_between_the_returns_of_their_ring():
    """Of a wall at x = 8, a window returns nothing. Its pulses have the ranges of the wall."""
    vectors, ring, share = directions(clockwise=True)
    vectors = vectors @ Rotation.from_euler("z", -100, degrees=True).as_matrix().T
    azimuth = np.arctan2(vectors[:, 1], vectors[:, 0])
    range_m = np.where(np.abs(azimuth) < 1.2, 8 / vectors[:, 0].clip(1e-3), 20.0)
    is_lost = (np.abs(azimuth - 0.3) < np.radians(3.1)) & (ring > 3)
    # In another direction, the gap lies between a surface at 20 m and one at 4 m.
    range_m = np.where((azimuth > 2.0) & (azimuth < 2.5), 4.0, range_m)
    is_edge = np.abs(azimuth - 2.0) < np.radians(2.1)
    wide = np.abs(azimuth + 2.0) < np.radians(11)
    gone = is_lost | is_edge | wide
    points = range_m[:, None] * vectors
    sweep = Sweep(
        points[~gone],
        {
            "row": ring[~gone],
            "time_s": (PERIOD_S * share)[~gone],
            "start_rad": np.zeros((~gone).sum()),
        },
    )
    lasers = RingLasers.at_origin(np.radians(ELEVATION_DEG), 1e-6)
    coverage = SensorCoverage(np.ones((RINGS, 720), bool), 50.0)
    lost, found_m = lost_pulses(sweep, lasers, coverage, 0.0)
    # All rings lost the pulses of the other gaps, so that these may be lost packets.
    inside = np.abs(np.arctan2(lost.points[:, 1], lost.points[:, 0]) - 0.3) < 0.1
    assert inside.sum() == is_lost.sum()
    order = np.lexsort((lost.columns["azimuth_rad"][inside], lost.columns["row"][inside]))
    truth = np.lexsort((azimuth[is_lost], ring[is_lost]))
    np.testing.assert_allclose(lost.points[inside][order], vectors[is_lost][truth], atol=1e-6)
    np.testing.assert_array_equal(lost.columns["row"][inside][order], ring[is_lost][truth])
    np.testing.assert_allclose(found_m[inside][order], range_m[is_lost][truth], rtol=3e-3)
    apart_s = np.abs(lost.columns["time_s"][inside][order] - (PERIOD_S * share)[is_lost][truth])
    assert apart_s.max() < 8 * PERIOD_S / COLUMNS, "the time of the nearest return"
    rest = np.abs(np.arctan2(lost.points[:, 1], lost.points[:, 0]) - 2.0) < 0.1
    assert np.isnan(found_m[rest]).all()
    assert firings_per_turn(sweep, lasers) == COLUMNS
    covered = np.ones((RINGS, 720), bool)
    covered[:, 360:380] = False  # from 0 to 10 degrees
    less, _ = lost_pulses(sweep, lasers, coverage._replace(cells=covered), 0.0)
    at = np.degrees(np.arctan2(less.points[:, 1], less.points[:, 0]))
    assert not ((at > 0.1) & (at < 9.9)).any() and len(less) == len(lost)
    # If the sensor moves while points are compensated, parallax opens gaps at edges.
    moved, _ = lost_pulses(sweep, lasers, coverage, 1.0)
    assert len(moved) <= len(lost)


def test_pulses_have_the_times_and_places_of_their_firings():
    """A sweep with a gap, recorded by a moving sensor: returns first, then the lost pulses."""
    sweeps = recorded(kept=lambda ring, share: ~((np.abs(share - 0.4) < 0.004) & (ring % 2 == 0)))
    placed = aligned(sweeps, 3.0 + PERIOD_S * np.arange(5), Motion.TIMED)
    pulses = TimedPulses.read(placed, 2)
    count = len(sweeps.read(2))
    assert len(pulses.times_s) == len(pulses.origins) == len(pulses.ends) == RINGS * COLUMNS
    since_s = pulses.times_s - (3.0 + 2 * PERIOD_S)
    np.testing.assert_allclose(since_s[:count], sweeps.read(2).columns["time_s"], atol=1e-9)
    np.testing.assert_allclose(since_s[count:], 0.4 * PERIOD_S, atol=0.005 * PERIOD_S)
    origin = placed.alignment.poses[2][:3, 3]
    velocity = np.array([1.5, -0.5, 0.1])
    np.testing.assert_allclose(pulses.origins, origin + since_s[:, None] * velocity, atol=1e-3)
    length_m = np.linalg.norm(pulses.ends - pulses.origins, axis=1)
    np.testing.assert_allclose(length_m[count:], 1, atol=1e-6)
    assert length_m[:count].min() > 11.99
    blocked = np.zeros((RINGS, 72), bool)
    blocked[0, :] = True
    hidden = aligned(sweeps, PERIOD_S * np.arange(5), Motion.TIMED, blocked=blocked)
    _, lost = hidden.read_with_lost(1)
    assert 0 not in lost.ring and len(lost.ring) == len(pulses.lost.ring) * 7 // 8
    returns, both = hidden.read_pulses(1)
    np.testing.assert_array_equal(returns.is_blocked, returns.ring == 0)
    np.testing.assert_array_equal(both.is_blocked, both.ring == 0)


def test_rays_are_collected_near_what_moves_before_it_starts_and_after_it_stops():
    sweeps = aligned(recorded(count=7), PERIOD_S * np.arange(7), Motion.TIMED)
    azimuth_deg, elevation_deg = [], []
    stationary = {}
    for number in range(7):
        points = sweeps.read(number).points
        azimuth_deg = np.degrees(np.arctan2(points[:, 1], points[:, 0]))
        elevation_deg = np.degrees(np.arctan2(points[:, 2], np.hypot(*points[:, :2].T)))
        moves = (np.abs(azimuth_deg + 30) < 3) & (np.abs(elevation_deg) < 5) & (2 <= number <= 4)
        stationary[number] = ~moves
    rays = collect_moving_rays(sweeps, stationary, [0, 3, 6], [])
    assert set(rays.sweep.tolist()) == {0, 3, 6}
    for number in (0, 3, 6):
        part = rays.select(rays.sweep == number)
        toward = part.ends - part.origins
        at_deg = np.degrees(np.arctan2(toward[:, 1], toward[:, 0]))
        # Half a meter at 12 m is 2.4 degrees.
        assert np.abs(at_deg + 30).max() < 8
        near = (np.abs(azimuth_deg + 30) < 4) & (np.abs(elevation_deg) < 5)
        assert len(part.sweep) > near.sum()
        assert part.returned.all()
        moved = (np.abs(at_deg + 30) < 2.9) & (
            np.abs(np.degrees(np.arcsin(toward[:, 2] / np.linalg.norm(toward, axis=1)))) < 4.9
        )
        assert part.moved[moved].all() == (number == 3)
        assert part.moved.sum() == (number == 3) * (~stationary[number]).sum()
        np.testing.assert_array_equal(part.cluster >= 0, part.moved)
        assert (np.abs(part.time_s - number * PERIOD_S) <= PERIOD_S).all()
    times_s = np.array([0.0, 1.0])
    label = ObjectTrack(
        1, "Car", np.array([4.0, 2, 2]), times_s, np.array([[0, 8.0, -1]] * 2), np.zeros(2)
    )
    still = {number: np.ones(len(mask), bool) for number, mask in stationary.items()}
    labeled = collect_moving_rays(sweeps, still, [1], [label])
    toward = labeled.ends - labeled.origins
    assert np.abs(np.degrees(np.arctan2(toward[:, 1], toward[:, 0])) - 90).max() < 30
    assert len(labeled.sweep) > 500 and not labeled.moved.any()
    assert not len(collect_moving_rays(sweeps, still, [1], []).sweep)
    gone = replace(label, times_s=times_s + 50)
    assert not len(collect_moving_rays(sweeps, still, [1], [gone]).sweep)


def test_snow_is_in_the_air_and_thin_poles_are_not():
    """Flakes are elsewhere in each sweep. Poles also return single pulses, always the same.

    A pulse that hits the first pole also returns from a pole behind it.
    """
    vectors, ring, share = directions(clockwise=False)
    is_behind = np.arange(len(ring) + RINGS) >= len(ring)
    rows = np.append(np.arange(len(ring)), np.flatnonzero(np.abs(share - 0.3) < 0.4 / COLUMNS))
    vectors, ring, share = vectors[rows], ring[rows], share[rows]
    hall_m = 12 / np.hypot(vectors[:, 0], vectors[:, 1])
    is_pole = np.abs(share - 0.3) < 0.4 / COLUMNS
    flakes = []
    for number in range(11):
        rng = np.random.default_rng(number)
        chosen = rng.choice(np.flatnonzero(~is_pole), 400, replace=False)
        range_m = hall_m.copy()
        range_m[is_pole] = 3.0
        range_m[is_behind] = 3.7
        range_m[chosen] = rng.uniform(0.6, 4.0, 400)
        mask = np.zeros(len(ring), bool)
        mask[chosen] = True
        flakes.append((range_m, mask))
    sweeps = RecordedSweeps.from_recording(
        made_recording(
            "snow", 11, lambda k: Sweep(flakes[k][0][:, None] * vectors, {"ring": RINGS - 1 - ring})
        )
    ).with_isolated_ranges()
    assert (sweeps.isolated.start_m, sweeps.isolated.stop_m) == (0.5, 4.0)
    placed = aligned(sweeps, PERIOD_S * np.arange(11), Motion.COMPENSATED)
    at = np.eye(4)  # in projected coordinates, and heading northeast
    at[:3, :3] = Rotation.from_euler("z", 55, degrees=True).as_matrix()
    at[:3, 3] = (480_000.0, 5_400_000.0, 300.0)
    placed = replace(placed, alignment=replace(placed.alignment, poses=np.tile(at, (11, 1, 1))))
    masks = find_air_returns(placed, range(11))
    assert [*masks] == [*range(11)]
    for number, mask in masks.items():
        truth = flakes[number][1]
        assert mask[truth].mean() > 0.95
        assert not mask[~truth & ~is_pole].any()
        # Whether the outermost rings are in the view of other sweeps depends on rounding.
        assert not mask[~truth & (ring > 0) & (ring < RINGS - 1)].any()
    found = AirStatistics.from_sweeps(placed, masks, np.array([2, 5]))
    assert found.returns == masks[2].sum() + masks[5].sum()
    assert 0.6 <= found.ranges_m.min() < 0.8 and 3.8 < found.ranges_m.max() <= 4.0
    assert len(sweeps.read_surfaces(3)) < len(ring) - 380
    clear = recorded()
    assert (
        find_air_returns(aligned(clear, PERIOD_S * np.arange(5), Motion.COMPENSATED), range(5))
        == {}
    )


@pytest.mark.parametrize("motion", [Motion.COMPENSATED, Motion.TIMED])
def test_a_sensor_is_fitted_to_channels_from_the_lowest_ring_to_the_highest(monkeypatch, motion):
    """Rows count from the highest ring. Energies of white surfaces at 10 m become 1."""
    sweep = Sweep(np.eye(3), {"row": np.array([0, 2, 1]), "intensity": np.array([30.0, 60, 15])})
    poses = np.arange(4)[:, None, None] + np.eye(4)
    alignment = SimpleNamespace(
        motion=motion, poses=poses, points_as_fired=lambda one, k: (one.points + k, one.points - k)
    )
    recorded = SimpleNamespace(
        ring_count=16, read=lambda _: sweep, lasers=SimpleNamespace(is_at_origin=True)
    )
    sweeps = SimpleNamespace(
        name="drive",
        recorded=recorded,
        alignment=alignment,
        align=lambda one, number: SimpleNamespace(points=one.points * number),
    )
    monkeypatch.setattr(recorded_sensor, "fit", lambda *given, **options: (*given, options))
    is_compensated = motion is Motion.COMPENSATED
    for model in IntensityModel:
        response = Response(model, np.ones((16, 11)), 1.0, 30.0, 60.0, 0.4, 1.0)
        chosen = np.array([1, 3])
        found, options = recorded_sensor._fit_to_sweeps(sweeps, chosen, None, response)
        energies = model is IntensityModel.ENERGIES
        assert (found.info.energy_unit, options["white"]) == (
            (1.0, None) if energies else (None, 30)
        )
        assert len(found) == 2
        one = found[1]
        assert one.columns["channel"].tolist() == [15, 13, 14]
        assert one.intensity.tolist() == ([1, 2, 0.5] if energies else [30, 60, 15])
        np.testing.assert_array_equal(
            one.points, 3 * np.eye(3) if is_compensated else 3 + np.eye(3)
        )
        if is_compensated:
            np.testing.assert_array_equal(options["pose"], poses[[1, 3]])
        else:
            assert options["pose"] is None
            np.testing.assert_array_equal(one.firing_poses, np.eye(3) - 3)
    unknown, options = recorded_sensor._fit_to_sweeps(sweeps, np.array([2]), None, None)
    assert options["white"] is None and unknown[0].intensity.tolist() == [30, 60, 15]


@pytest.mark.parametrize("range_m", [None, 0.0123456])
@pytest.mark.parametrize("is_fitted", [True, False])
def test_the_noise_of_a_sensor_is_fitted_but_not_its_detection(monkeypatch, range_m, is_fitted):
    """The map already lacks what the sensor did not detect. Ring errors are those of the map."""
    sweeps = aligned(recorded(), PERIOD_S * np.arange(5), Motion.TIMED)
    sensor = SweepTiming.from_sweeps(sweeps).sensor(sweeps, 2, None)
    biases_m = [0.01 * k for k in range(RINGS)]
    sensor = sensor.model_copy(
        update={"performance": Performance(channel_bias_m=biases_m, angle_deg=0.07)}
    )
    fitted = Performance(
        range_m=0.05,
        range_per_m=1e-3,
        angle_deg=0.02,
        detection=Detection(range_m=50, probability=0.5),
        false_alarms=1e-3,
        dropout=0.1,
        mode="last",
    )

    def fit(*_, **__):
        if not is_fitted:
            raise LidarError("There are too few rays.")
        return SimpleNamespace(model=SimpleNamespace(performance=fitted))

    noise = None if range_m is None else SimpleNamespace(range_m=range_m)
    monkeypatch.setattr(recorded_sensor, "fit", fit)
    monkeypatch.setattr(recorded_sensor, "estimate_range_noise", lambda *_: noise)
    sizes = dict.fromkeys(range(5), RINGS * COLUMNS)
    found = fit_sensor(sweeps, sizes, None, None, sensor)
    kept = {"angle_deg": 0.02, "mode": "last"} if is_fitted else {"angle_deg": 0.07}
    if range_m is not None:
        kept["range_m"] = 0.01235
    elif is_fitted:
        kept |= {"range_m": 0.05, "range_per_m": 1e-3}
    expected = {"channel_bias_m": tuple(biases_m), **kept}
    assert found.model.performance.model_dump(exclude_defaults=True) == expected
    assert found.model.beams == sensor.beams and found.range_noise is noise
    assert found.model.sources["performance"].endswith(" to hall, 5 sweeps")
    assert bool(found.notes) != is_fitted

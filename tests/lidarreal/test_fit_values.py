"""Values that a fit computes from recorded sweeps, each against a closed form."""

from __future__ import annotations

import numpy as np
import pytest
from tests.made_recordings import made_recording

from lidarreal.comparing.fit.performance import fit_threshold
from lidarreal.comparing.fit.planes import RangeChanges, range_scatter
from lidarreal.comparing.fit.smooth_surfaces import MAX_KINK_PER_M, SmoothRays
from lidarreal.comparing.fit.stack import SweepStack
from lidarsim.columns.sweep import Sweep

pytest.importorskip("scipy")

RINGS = 16
COLUMNS = 360
# Distances of the walls, the floor and the ceiling from the sensor, which is not in the center.
BEHIND_M = np.array([15.0, 12.0, 2.0])
AHEAD_M = np.array([20.0, 9.0, 3.5])


def directions(azimuth_deg=0.0):
    azimuth = np.radians(np.arange(COLUMNS) * 360 / COLUMNS + 0.1 + azimuth_deg)[None, :]
    elevation = np.radians(np.linspace(-15, 15, RINGS))[:, None]
    level = np.cos(elevation)
    x, y = level * np.cos(azimuth), level * np.sin(azimuth)
    return np.stack([x, y, np.broadcast_to(np.sin(elevation), x.shape)], axis=-1).reshape(-1, 3)


def room(position=(0, 0, 0), yaw_rad=0.0, longer_m=0.0, azimuth_deg=0.0):
    """Return a sweep in a room, at a position and with a yaw in the frame of the first sweep."""
    turn = np.array([[np.cos(yaw_rad), -np.sin(yaw_rad), 0],
                     [np.sin(yaw_rad), np.cos(yaw_rad), 0], [0, 0, 1]])  # fmt: skip
    fired = directions(azimuth_deg)
    rays = fired @ turn.T
    walls_m = np.where(rays > 0, AHEAD_M - position, BEHIND_M + position)
    range_m = (walls_m / np.abs(rays).clip(min=1e-12)).min(axis=1) + longer_m
    return Sweep(fired * range_m[:, None], {"channel": np.arange(RINGS).repeat(COLUMNS)})


def stack_of(*sweeps):
    return SweepStack.read(made_recording("room", len(sweeps), sweeps.__getitem__))


@pytest.mark.parametrize(
    ("shift", "yaw_rad"),
    [((0.2, 0), 0), ((-0.1, 0.15), 0), ((0, -0.1), -0.02), ((0, 0), 0.03)],
)
def test_range_changes_show_the_motion_of_the_sensor(shift, yaw_rad):
    moved = room(np.array([*shift, 0]), yaw_rad)
    motion = RangeChanges.between(stack_of(room(), moved), 0, 1).motion()
    np.testing.assert_allclose(motion.shift[:2], shift, atol=0.01)
    assert motion.yaw_rad == pytest.approx(yaw_rad, abs=0.001)
    still = RangeChanges.between(stack_of(room(), room()), 0, 1)
    assert still.motion() is None


@pytest.mark.parametrize("azimuth_deg", [0.3, -0.2])
def test_range_changes_do_not_depend_on_the_azimuths_of_the_pulses(azimuth_deg):
    stack = stack_of(room(), room(azimuth_deg=azimuth_deg))
    changes = RangeChanges.between(stack, 0, 1)
    raw_m = np.abs(stack.ranges[1] - stack.ranges[0])[changes.chosen]
    assert np.quantile(raw_m, 0.9) > 0.03
    assert np.quantile(np.abs(changes.change[changes.chosen]), 0.9) < 0.003
    assert changes.motion() is None


def test_bends_of_surfaces_and_errors_of_normals_are_noise_of_range_changes():
    changes = RangeChanges.between(stack_of(room(), room()), 0, 1)
    expected = np.hypot(0.02 + MAX_KINK_PER_M * changes.distance, 0.5 * changes.normal_error)
    assert np.ptp(changes.distance) > 10
    np.testing.assert_allclose(changes.noise, expected)


@pytest.mark.parametrize(("lag", "scatter_m"), [(1, 0.03), (2, 0.06), (5, 0.15)])
def test_ranges_scatter_between_sweeps_that_are_a_lag_apart(lag, scatter_m):
    """The ranges grow faster and faster, by 1 to 5 cm from sweep to sweep."""
    stack = stack_of(*(room(longer_m=0.01 * k * (k + 1) / 2) for k in range(6)))
    assert range_scatter(stack, lag) == pytest.approx(scatter_m, abs=1e-5)


def weak_rays(energy, threshold, dropout, trials=20):
    """Return rays whose pulses return with the probability that `Noise.detected` states."""
    from scipy.special import ndtr

    share = (1 - dropout) * ndtr(5 * (energy / threshold - 1))
    counts = np.random.default_rng(3).binomial(trials, share)
    nothing = np.zeros(len(energy))
    rows = nothing.astype(int)
    return SmoothRays(rows, rows, nothing, nothing, nothing, counts, rows + trials, nothing, rows)


@pytest.mark.parametrize("all_known", [False, True])
@pytest.mark.parametrize("dropout", [0.0, 0.2])
def test_the_threshold_is_the_energy_at_which_half_of_the_pulses_return(all_known, dropout):
    energy = np.random.default_rng(1).lognormal(np.log(3e-4), 0.6, 3000)
    rays = weak_rays(energy, 2e-4, dropout)
    if not all_known:
        energy, rays = energy[rays.return_counts > 0], rays.select(rays.return_counts > 0)
    found = fit_threshold(energy, rays, dropout, all_known=all_known)
    assert found.value == pytest.approx(2e-4, rel=0.02)
    assert found.low < found.value < found.high < 1.1 * found.low
    assert abs(found.value - 2e-4) < found.high - found.low


@pytest.mark.parametrize("weak_count", [0, 20, 60])
def test_a_threshold_requires_rays_that_lose_many_pulses(weak_count):
    """Most rays return at least 94 % of their pulses."""
    random = np.random.default_rng(2)
    energy = 2e-4 * np.concatenate(
        [random.uniform(1.32, 1.45, 2000), random.uniform(0.9, 1.1, weak_count)]
    )
    found = fit_threshold(energy, weak_rays(energy, 2e-4, 0.0), 0.0, all_known=True)
    if weak_count < 30:
        assert found is None
    else:
        assert found.value == pytest.approx(2e-4, rel=0.03)

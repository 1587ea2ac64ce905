"""Flight lines are told from the turns between them."""

from __future__ import annotations

import numpy as np
import pytest

from lidarsim.motion.straight_lines import StraightLines

SPEED_M_S = 60.0


def flown(pieces, step_s=0.05, jitter_m=0.0):
    """Return times and positions of a flight at 60 m/s by pieces of (seconds, degrees a second)."""
    rates = np.concatenate([np.full(round(s / step_s), rate) for s, rate in pieces])
    headings = np.radians(np.append(0.0, np.cumsum(rates) * step_s))
    moves = (
        SPEED_M_S * step_s * np.stack([np.cos(headings), np.sin(headings), 0 * headings], axis=1)
    )
    positions = np.cumsum(moves, axis=0)
    positions += np.random.default_rng(1).normal(0, jitter_m, positions.shape)
    return np.arange(len(headings)) * step_s, positions


THREE = [(8, 0), (12, 15), (8, 0), (12, -15), (8, 0)]


@pytest.mark.parametrize("jitter_m", [0.0, 0.01])
def test_turns_are_no_part_of_the_lines(jitter_m):
    lines = StraightLines.from_trajectory(*flown(THREE, jitter_m=jitter_m))
    assert lines.starts_s == pytest.approx([0, 20, 40], abs=0.3)
    assert lines.stops_s == pytest.approx([8, 28, 48], abs=0.3)
    assert lines.seconds == pytest.approx(24, abs=0.9)
    assert lines.length_m == pytest.approx(24 * SPEED_M_S, rel=0.04)
    assert lines.length_m / lines.seconds == pytest.approx(SPEED_M_S, rel=0.002)


def test_slow_turns_of_aircraft_are_turns():
    """Three degrees a second is the standard rate."""
    lines = StraightLines.from_trajectory(*flown([(60, 0), (60, 3), (60, 0)]))
    assert lines.starts_s == pytest.approx([0, 120], abs=1)
    assert lines.stops_s == pytest.approx([60, 180], abs=1)
    assert not len(StraightLines.from_trajectory(*flown([(100, 3)])).starts_s)


def test_a_line_with_a_gust_is_one_line():
    gust = [(10, 0), (1, 6), (2, -6), (1, 6), (10, 0)]
    lines = StraightLines.from_trajectory(*flown(gust))
    assert (lines.starts_s.tolist(), lines.seconds) == ([0], pytest.approx(24))


def test_corners_without_turns_are_found_and_short_flights_have_no_lines():
    times = np.array([0.0, 6, 12])
    lines = StraightLines.from_trajectory(times, np.array([[0.0, 0, 9], [90, 0, 9], [90, 60, 9]]))
    assert lines.stops_s == pytest.approx([6, 12], abs=0.25)
    assert lines.lengths_m == pytest.approx([90, 60], abs=4)
    assert not len(StraightLines.from_trajectory(times / 20, np.eye(3)).starts_s)
    assert not len(StraightLines.from_trajectory(times, np.ones((3, 3))).starts_s), "it hovers"

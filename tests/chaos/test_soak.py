"""A thousand scans with workers killed all the while."""

from __future__ import annotations

import pytest
from tests.chaos.soak import draw, soak


@pytest.mark.slow
def test_a_thousand_scans_in_kills_leave_nothing_and_lose_nothing(tmp_path):
    soaked = soak(1000, seed=1, pace_s=0.02)
    assert soaked.delivered.error == ""
    assert soaked.verdict.sound, soaked.verdict
    assert soaked.identical
    assert soaked.faults.total() >= 5
    assert soaked.delivered.misplaced == 0
    assert soaked.left_on_scheduler == []
    assert soaked.left_behind == []
    # Ten times the cloud would not be as much; what piles up by the scan or by the kill is.
    assert soaked.growth("driver") < 10
    assert soaked.growth("scheduler") < 10
    draw(soaked, tmp_path / "soak.png")
    assert (tmp_path / "soak.png").stat().st_size > 0

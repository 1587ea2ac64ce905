"""The short version of `python -m tests.chaos.soak`, so that it cannot rot."""

from __future__ import annotations

import pytest
from tests.chaos.soak import draw, soak

SCANS, SEED = 360, 1


@pytest.mark.slow
def test_scans_in_kills_leave_nothing_and_lose_nothing(tmp_path):
    # Its memory is judged in a long one; what is left, as descriptors or files, here as well.
    soaked = soak(SCANS, SEED)
    assert soaked.sound, soaked
    assert soaked.verdict.recovered
    assert soaked.faults.total() >= 3
    draw(soaked, tmp_path / "soak.png")
    assert (tmp_path / "soak.png").stat().st_size > 0

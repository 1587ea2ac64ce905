"""The short version of `python -m tests.chaos.soak`, so that it cannot rot."""

from __future__ import annotations

import pytest
from tests.chaos.soak import draw, soak
from tests.chaos.survey import reference


@pytest.mark.slow
def test_scans_in_kills_leave_nothing_and_lose_nothing(arena, what, tmp_path):
    # Memory is judged in a long one.
    soaked = soak(arena, what, reference(arena, what, None), seed=1)
    assert soaked.sound, soaked
    assert soaked.outcome.verdict.recovered
    assert soaked.outcome.done.total() >= 3
    draw(soaked, tmp_path / "soak.png")
    assert (tmp_path / "soak.png").stat().st_size > 0

"""benchmarks/raycast_moving.py at toy size: the times mean nothing, that it runs does."""

from __future__ import annotations

import pytest
from benchmarks import raycast_moving

from raybeam import available_backends


@pytest.mark.slow
def test_all_numbers_of_beams(capsys):
    if reason := available_backends()["embree"]:
        pytest.skip(f"embree: {reason}")
    assert raycast_moving.main(["--quick"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [int(line.split()[0]) for line in lines] == [16, 16, 64, 64, 128, 128]
    assert all("x bare; moving" in line and "hits 0 %" not in line for line in lines)

"""benchmarks/raycast_moving.py at toy size: the times mean nothing, that it runs does."""

from __future__ import annotations

import numpy as np
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


def test_track_is_made_of_rotations():
    positions, rotations = raycast_moving.track(30)
    assert positions.shape == (30, 3)
    products = rotations @ rotations.transpose(0, 2, 1)
    np.testing.assert_allclose(products, np.broadcast_to(np.eye(3), (30, 3, 3)), atol=1e-15)

"""benchmarks/raycast_moving.py at toy size: the times mean nothing, that it runs does."""

from __future__ import annotations

import json

import numpy as np
import pytest
from benchmarks import raycast_moving

from raybeam import available_backends


def test_all_numbers_of_beams(tmp_path, capsys):
    if reason := available_backends()["embree"]:
        pytest.skip(f"embree: {reason}")
    out = tmp_path / "out.json"
    assert raycast_moving.main(["--quick", "--json", str(out)]) == 0
    rows = json.loads(out.read_text())["moving"]
    assert [row["beams"] for row in rows] == [40, 40, 64, 64, 128, 128]
    for row in rows:
        assert row["hit_share"] > 0.1
        assert all(len(seconds) == 2 for seconds in row["seconds"].values())
        assert row["still_to_bare"] > 0
    assert capsys.readouterr().out.count("x bare; moving") == 6


def test_track_is_made_of_rotations():
    positions, rotations = raycast_moving.track(30)
    assert positions.shape == (30, 3)
    products = rotations @ rotations.transpose(0, 2, 1)
    np.testing.assert_allclose(products, np.broadcast_to(np.eye(3), (30, 3, 3)), atol=1e-15)

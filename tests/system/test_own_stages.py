"""The example of a pipeline of a user's own functions beside other work."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import open3d as o3d
import pytest

EXAMPLE = Path(__file__).parents[2] / "examples" / "own_stages.py"


@pytest.mark.extended
def test_frames_come_in_order_and_no_point_is_lost(tmp_path):
    run = subprocess.run(
        [sys.executable, EXAMPLE], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert run.returncode == 0, run.stderr
    *frames, last = run.stdout.splitlines()
    assert [line.partition(":")[0] for line in frames] == [f"scan {n}" for n in range(36)]
    assert last == "18,000 points in own-stages.ply; the best of 100 ways is 8.26 m"
    cloud = o3d.t.io.read_point_cloud(str(tmp_path / "own-stages.ply"))
    shares = np.abs(cloud.point.positions.numpy()) / [4, 3, 1.5]  # of the way to each wall
    assert np.allclose(shares.max(axis=1), 1)

"""Only the writing of PLY needs Open3D: all else works where it does not load."""

import subprocess
import sys

import pytest

SCENARIO = "scene: seed\nposes: [[0, 0, 1]]\ncloud: {keep_every: 5}\n"
EVERYTHING_ELSE = """
import sys
from pathlib import Path
from distributed import Client
from lidarpool import LidarError, Scene, Survey, read_cloud, simulate, save_cloud
from lidarpool.cli.commands import main
from lidarview.viewer.result_views import open_result, result_page

def command(*arguments):
    try:
        main(arguments)
    except SystemExit as ended:
        assert not ended.code, arguments

if __name__ == "__main__":
    command("check", "s.yaml")
    command("export", "out", "-f", "pcd", "-f", "laz")
    command("plot", "out", "--only", "cloud", "--color", "object", "--size", "480x480")
    with result_page(open_result(Path("out")), port=0, browser=False):
        print("shown")
    client = Client(sys.argv[1])
    survey = Survey(poses=[(0, 0, 1)], keep_every=5)
    points = simulate(Scene.seed(), survey, client=client).points
    assert len(points) == len(read_cloud("out/cloud.ply"))
    save_cloud(points, "again.laz")
    try:
        save_cloud(points, "again.ply")
    except LidarError as error:
        print(error)
"""


@pytest.mark.slow
def test_what_writes_no_ply_does_without_it(cluster, lidarpool, tmp_path):
    (tmp_path / "s.yaml").write_text(SCENARIO)
    made = lidarpool("run", "s.yaml", "--out", "out", "--scheduler", cluster)
    assert made.code == 0, made.err
    (tmp_path / "open3d").mkdir()
    (tmp_path / "open3d" / "__init__.py").write_text("raise ImportError('there is no Open3D')")
    (tmp_path / "script.py").write_text(EVERYTHING_ELSE)
    done = subprocess.run(  # a script's folder is searched first
        [sys.executable, "script.py", cluster], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    *_, shown, refused = done.stdout.splitlines()
    assert shown == "shown"
    assert refused.startswith("Writing clouds requires Open3D, which cannot be loaded")
    assert (tmp_path / "out" / "cloud.laz").exists() and (tmp_path / "again.laz").exists()
    assert not (tmp_path / "again.ply").exists()

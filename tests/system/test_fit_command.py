"""The command `lidarpool fit`, and a small campaign with the sensor that it writes."""

import json

import numpy as np
import pytest
from benchmarks.fit_coverage import recorded, street
from pypcd4 import PointCloud
from tests.clusters import thread_cluster

from lidarpool import Noise
from lidarscenes.writers.scene_file import write_scene
from lidarsim.scene.files.polygon_files import read_ply_columns

pytest.importorskip("scipy", reason="the extra fit is not installed")

SWEEPS = 4


@pytest.fixture(scope="module")
def sweeps(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sweeps")
    recording = recorded(Noise(range_m=0.02, dropout=0.05, seed=1), sweeps=SWEEPS)
    for number in range(SWEEPS):
        sweep = recording[number]
        arrays = [*sweep.points.T.astype("f4"), sweep.columns["channel"].astype("u2")]
        made = PointCloud.from_points(arrays, ("x", "y", "z", "ring"), [a.dtype for a in arrays])
        made.save(folder / f"{number}.pcd")
    return folder


@pytest.mark.slow
def test_the_sensor_that_is_written_has_the_noise_of_the_recording(
    sweeps, tmp_path, lidarpool, cluster
):
    done = lidarpool("fit", sweeps, "--out", tmp_path / "mine.yaml", "--json")
    assert done.code == 0
    figures = json.loads(done.out)
    assert figures["figures"]["range_m"]["value"] == pytest.approx(0.02, rel=0.1)
    assert (tmp_path / "mine.html").exists()
    write_scene(tmp_path / "street.glb", street())
    options = ["--sensor", tmp_path / "mine.yaml", "--columns", "range,ray"]
    options += ["--pose", "0,0,0"] * SWEEPS
    arguments = [tmp_path / "street.glb", *options, "--out", tmp_path / "out", "-q"]
    done = lidarpool("run", *arguments, "--scheduler", cluster)
    assert done.code == 0, done.err
    cloud = read_ply_columns((tmp_path / "out/cloud.ply").read_bytes())
    sweep, step = np.divmod(cloud["scan"].astype(int), 36)
    _, ray = np.unique(np.stack([step, cloud["ray"]]), axis=1, return_inverse=True)
    ranges = np.full((SWEEPS, ray.max() + 1), np.nan)
    ranges[sweep, ray] = cloud["range"]
    whole = ranges[:, np.isfinite(ranges).all(axis=0)]
    assert np.sqrt(whole.var(axis=0, ddof=1).mean()) == pytest.approx(0.02, rel=0.1)
    assert np.isnan(ranges).mean() == pytest.approx(0.05, abs=0.01)
    (tmp_path / "survey.yaml").write_text(
        "{scene: street.glb, sensor: mine.yaml, cloud: {columns: [intensity]}, poses: [[0, 0, 0]]}"
    )
    (tmp_path / "campaign.yaml").write_text(
        "base: survey.yaml\nkeep: kitti\nvary: {sensor.performance: {each: [null, ideal]}}\n"
    )
    with thread_cluster({"GPU": 1}, {"LIDAR": 5}) as slots:
        where = ["--out", tmp_path / "set", "--scheduler", slots.scheduler_address]
        done = lidarpool("run", tmp_path / "campaign.yaml", *where, "-q")
    assert done.code == 0, done.err
    files = sorted((tmp_path / "set/sequences").glob("*/velodyne/*.bin"))
    fitted, ideal = (file.stat().st_size // 16 for file in files)
    assert fitted / ideal == pytest.approx(0.95, abs=0.01)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["nowhere"], "nowhere does not exist"),
        ([".", "--model", "no-such"], "Unknown sensor model 'no-such'"),
        ([".", "--scene", "none.glb"], "none.glb"),
        ([".", "--out", "mine.txt"], "not a sensor file. Use a file name with"),
        (
            [".", "--pose", "0,0,0", "--pose", "1,0,0"],
            "`pose` contains 2 poses, but . has 4 sweeps. Pass",
        ),
        ([".", "--white-intensity", "0"], "white must be a number above 0"),
    ],
)
def test_what_cannot_be_done_is_told_in_a_line(sweeps, lidarpool, monkeypatch, arguments, says):
    monkeypatch.chdir(sweeps)
    done = lidarpool("fit", "--out", "mine.yaml", *arguments)
    assert done.code == 2 and says in done.err and len(done.err.splitlines()) <= 2

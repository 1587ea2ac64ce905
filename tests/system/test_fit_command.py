"""The command `lidarpool fit`, and a small campaign with the sensor that it writes."""

import json

import pytest
from benchmarks.fit_coverage import recorded
from pypcd4 import PointCloud

from lidarpool import Noise

pytest.importorskip("scipy", reason="the extra fit is not installed")


@pytest.fixture(scope="module")
def sweeps(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sweeps")
    recording = recorded(Noise(range_m=0.02, dropout=0.02, seed=1), sweeps=4)
    for number in range(4):
        points, columns, _ = recording.read(number)
        arrays = [*points.T.astype("f4"), columns["channel"].astype("u2")]
        made = PointCloud.from_points(arrays, ("x", "y", "z", "ring"), [a.dtype for a in arrays])
        made.save(folder / f"{number}.pcd")
    return folder


def test_the_sensor_that_is_written_runs(sweeps, tmp_path, lidarpool, cluster):
    done = lidarpool("fit", sweeps, "--out", tmp_path / "mine.yaml", "--json")
    assert done.code == 0
    figures = json.loads(done.out)
    assert figures["figures"]["range_m"]["value"] == pytest.approx(0.02, rel=0.1)
    assert (tmp_path / "mine.html").exists()
    (tmp_path / "survey.yaml").write_text(
        "sensor: {model: mine.yaml, performance: datasheet}\n"
        "cloud: {keep_every: 1, columns: [range]}\nplanning: {enabled: false}\n"
    )
    arguments = ["--scheduler", cluster, "--only", "cloud", "-q"]
    done = lidarpool("run", tmp_path / "survey.yaml", "--out", tmp_path / "out", *arguments)
    assert done.code == 0, done.err
    report = json.loads((tmp_path / "out/report.json").read_text())
    noise = report["parameters"]["sensor"]["noise"]
    assert noise["range_m"] == pytest.approx(figures["figures"]["range_m"]["value"], rel=1e-3)
    (tmp_path / "campaign.yaml").write_text(
        "base: survey.yaml\nvary: {noise.dropout: {each: [0, 0.1]}}\n"
    )
    done = lidarpool("run", tmp_path / "campaign.yaml", "--out", tmp_path / "set", "-q")
    assert done.code == 0, done.err


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["nowhere"], "nowhere does not exist: give the folder of a result"),
        ([".", "--model", "no-such"], "There is no sensor model 'no-such'"),
        ([".", "--scene", "none.glb"], "none.glb"),
        ([".", "--out", "mine.txt"], "no sensor file: give a name such as mine.yaml"),
        ([".", "--white", "0"], "white is 0.0; it must be above 0"),
    ],
)
def test_what_cannot_be_done_is_told_in_a_line(sweeps, lidarpool, monkeypatch, arguments, says):
    monkeypatch.chdir(sweeps)
    done = lidarpool("fit", "--out", "mine.yaml", *arguments)
    assert done.code == 2 and says in done.err and len(done.err.splitlines()) <= 2

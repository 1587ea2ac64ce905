"""The benchmarks at toy size, so that they cannot rot; no figure is judged here."""

import re
from contextlib import contextmanager

import pytest
from benchmarks import (
    beside_dask,
    control,
    dataplane,
    decoders,
    effects,
    formats,
    gpu,
    model,
    pipelines,
    scale,
    submitting,
)
from benchmarks.harness import read_results
from distributed import Client
from docs.pictures import sensors as sensor_pictures
from docs.pictures.effects import __main__ as pictures
from tests.clusters import thread_cluster
from tests.cuda_on_host import played_cuda, source_backend  # noqa: F401 - fixtures

import lidarpool.run.cluster.cluster

pytestmark = pytest.mark.slow


def test_scale(tmp_path, capsys):
    path = tmp_path / "figures.json"
    figures = scale.main(["--workers", "4", "--tasks", "80", "--json", str(path)])
    assert read_results(path)["growth"] == figures["growth"]
    assert set(figures["growth"]) == set(scale.WAYS)
    for cluster in figures["workers"].values():
        assert cluster["misplaced"] == 0
        assert all(cluster[way]["tasks_per_second"] > 0 for way in scale.WAYS)
    assert "growth from 4 to 4 workers" in capsys.readouterr().out


def test_scale_of_receipts_and_jobs(tmp_path, capsys):
    path = tmp_path / "figures.json"
    sizes = ["--workers", "3", "--scans", "40", "--jobs", "10", "--shards", "2"]
    rows = scale.main([*sizes, "--receipts", "0.05", "--json", str(path)])
    assert read_results(path) == rows
    assert all(row["driver_ms"] > 0 and row["a_second"] > 0 for row in rows.values())
    assert 0 < rows["2 x 3 workers, batches of 0.05 s"]["busy"] <= 1
    names = ("driver", "scheduler", "collectors", "casting")
    costs = [word for name in names for word in (f"--{name}", "1.5", "0.5")]
    picture = tmp_path / "model.png"
    read = ["--read", str(path), "--cores", "2"]
    rates = model.main([*costs, *read, "--picture", str(picture)])
    rate, by, shards = rates["200 GPUs, batches of 1 s"]
    assert rate == pytest.approx(200, rel=0.05) and by == "casting" and shards == 1
    assert picture.stat().st_size > 10_000
    assert "batches/s measured" in capsys.readouterr().out


@pytest.mark.parametrize("kind", ["declared", "divided"])
def test_submitting(tmp_path, capsys, kind):
    path = tmp_path / "figures.json"
    options = ["--tasks", "40", "--repeat", "1", "--delay", "0.01", "--kind", kind]
    figures = submitting.main([*options, "--json", str(path)])
    assert read_results(path) == figures
    assert figures["Partition.submit sending"] > 0
    assert "ratio: " in capsys.readouterr().out


def test_beside_dask(tmp_path, capsys):
    path = tmp_path / "figures.json"
    rows = beside_dask.main(["--quick", "--json", str(path)])
    assert read_results(path) == rows
    small, wide = {"submit", "map", "map_items", "pipe"}, {"wide_submit", "wide_map"}
    short = {"quiet_map", "quiet_map_slow", "busy_map", "busy_map_slow"}
    assert rows.keys() == small | wide | short
    assert all(row["wall_us"] > 0 and row["wall_ratio"] > 0 for row in rows.values())
    assert capsys.readouterr().out.count("µs, Dask") == 20


def test_pipelines(tmp_path, capsys):
    path = tmp_path / "rounds.json"
    options = ["--quick", "--only", "dask", "poolpart", "poolpart_own", "--json", str(path)]
    medians = pipelines.main(options)
    assert {program: [medians[program]] for program in medians} == read_results(path)
    assert all(result["throughput"] > 0 and result["wait_s"] > 0 for result in medians.values())
    for program in ("dask", "poolpart"):
        assert not medians[program]["kill_wrong"] and not medians[program]["kill_error"]
    assert "| lines of code | 20 | 14 | 14 |" in capsys.readouterr().out


def test_bytes_of_batches(capsys):
    control.count_batches(5)
    assert "each additional batch of one scan adds" in capsys.readouterr().out


def test_dataplane(tmp_path, capsys):
    path = tmp_path / "rounds.json"
    figures = dataplane.main(["--quick", "--folder", str(tmp_path), "--json", str(path)])
    (measured_round,) = read_results(path)
    assert measured_round == figures
    points = dataplane.QUICK.scans * dataplane.QUICK.rays_per_scan
    assert figures["points"] == points, "of replayed columns"
    assert 26 < figures["sent"] < 60, "x, y, z, channel, object, range, intensity"
    assert figures["processes"].keys() == {"driver", "casting", "collectors"}
    assert figures["processes"]["collectors"]["written"] > 26, "parts"
    assert figures["processes"]["driver"]["written"] > 26, "the cloud"
    assert {path.name for path in tmp_path.iterdir()} == {"rounds.json"}
    assert "CPU time per point" in capsys.readouterr().out


def test_effects(capsys):
    toy = ["--repeat", "1", "--triangles", "2000"]
    assert effects.main(["--only", "rain", "spray", *toy]).keys() == {"rain", "spray"}
    assert capsys.readouterr().out.startswith("rain ")


def test_a_picture_of_an_effect(tmp_path):
    pictures.main([str(tmp_path), "--only", "range_noise"])
    assert (tmp_path / "effect-range-noise.png").stat().st_size > 10_000
    sensor_pictures.main([str(tmp_path), "--only", "livox/mid40"])
    assert 10_000 < (tmp_path / "livox-mid40.webp").stat().st_size < 50_000


def test_formats(capsys):
    formats.main(["--points", "2000"])
    assert len(capsys.readouterr().out.splitlines()) == 1 + len(formats.SCRIPTS)


def test_a_survey_on_a_device(played_cuda, tmp_path, monkeypatch):  # noqa: F811
    @contextmanager
    def threads(*_needed, **_options):
        with (
            thread_cluster({"GPU": 1}, {"LIDAR": 4}, {"OTHER": 1}) as cluster,
            Client(cluster, set_as_default=False) as c,
        ):
            yield c

    monkeypatch.setattr(lidarpool.run.cluster.cluster, "local_client", threads)
    path = tmp_path / "gpu.json"
    options = ["--quick", "--in-process", "--only", "run", "--json", str(path)]
    assert gpu.main([*options, "--folder", str(tmp_path)]) == 0
    rows = read_results(path)["run"]
    points = {name: rows[name]["points"] for name in ("all points", "every fifth point")}
    assert points["every fifth point"] == pytest.approx(points["all points"] / 5, rel=0.01)
    assert all(rows[name]["grays_s"] > 0 for name in points)


def test_mujoco(capsys):
    pytest.importorskip("mujoco", reason="MuJoCo is not installed: pip install mujoco")
    from benchmarks import mujoco

    assert mujoco.main(["--quick"]) == 0
    assert "| 4 quadrupeds | 23,040 |" in capsys.readouterr().out


def test_decoders(capsys, monkeypatch):
    """Those that extras install; the others demand older packages, and are named."""
    for module in ("velodyne_decoder", "pye57", "laspy", "mcap_ros2"):
        pytest.importorskip(module)
    programs = ["velodyne-decoder", "pye57", "laspy", "mcap"]
    assert decoders.main(["--quick", "--only", *programs]) == 0
    table = capsys.readouterr().out
    assert all(f"| {program} " in table for program in programs)
    assert "ring, reflectivity equal" in table and not re.search(r"\d differ|in the cloud", table)
    monkeypatch.setattr(decoders, "python_of", lambda program, pythons: None)
    assert decoders.main(["--quick", "--only", "pykitti"]) == 1
    told = capsys.readouterr().err
    assert (
        "pykitti was skipped. Install it with `pip install pykitti opencv-python-headless`" in told
    )

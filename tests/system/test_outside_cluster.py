"""The command on a cluster that somebody else started: same bytes, right places."""

import json
from dataclasses import replace
from hashlib import sha256
from pathlib import Path

import pytest
from distributed import Client
from tests.system.default_survey import DEFAULT_CLOUD_SHA256

from lidarpool import LidarError, Planning, ScanFrame, Scene, Sensor, Survey, simulate

SURVEY = Survey(Sensor.grid(rays_per_revolution=360, layers=4, step_deg=5), [(0, 0, 1)], steps=72)
EXAMPLE = Path(__file__).parents[2] / "examples" / "seed.yaml"


@pytest.mark.extended
def test_an_outside_cluster_gives_the_same_bytes(lidarpool, outside, tmp_path, all_records):
    cluster = outside()
    cluster.add(("GPU", 1))
    cluster.add(*[("LIDAR", 1)] * 4, ("OTHER", 1))
    cluster.wait()
    fewer = EXAMPLE.read_text().replace("trials: 100 ", "trials: 10 ")
    (tmp_path / "seed.yaml").write_text(fewer)
    out = tmp_path / "out"
    place = ["--out", out, "--quiet", "--scheduler", cluster.address]
    outcome = lidarpool("run", tmp_path / "seed.yaml", *place, "--backend", "numpy")
    assert (outcome.code, outcome.err) == (0, "")
    assert sha256((out / "cloud.ply").read_bytes()).hexdigest() == DEFAULT_CLOUD_SHA256
    report = json.loads((out / "report.json").read_text())
    assert report["backend"] == "numpy"  # the demo's is tiles
    assert report["placement_violations"] == 0
    assert report["tasks"]["GPU"].keys() == {"intersect"}
    assert report["tasks"]["LIDAR"] == {"generate": 1, "sort": 1, "collect": 2}
    assert report["tasks"]["OTHER"] == {"trial": 10}
    stages = ("generate", "sort", "collect")
    lidar = {worker for stage in stages for worker in report["stages"][stage]["workers"]}
    assert len(lidar) == 4  # a long task each, since each has one slot

    figures = lidarpool("doctor", "--scheduler", cluster.address, "--json").out
    workers = json.loads(figures)["workers"]
    assert [worker["resources"] for worker in workers].count({"LIDAR": 1}) == 4
    told = lidarpool("doctor", "--scheduler", cluster.address)
    assert told.code == 0
    counts = [told.out.count(f"{name}=1") for name in ("GPU", "LIDAR", "OTHER")]
    assert counts == [1, 4, 1]
    assert "6 workers" in told.out and "GPU-0" in told.out.split()


@pytest.mark.slow
def test_a_worker_whose_backend_gives_other_bits_casts_nothing(outside, cluster_client, same_cloud):
    """Another version, for example: workers like most others cast."""
    expected = simulate(Scene.seed(), SURVEY, client=cluster_client, backend="numpy")
    cluster = outside()
    ours = [cluster.add(("GPU", 1)), cluster.add(("GPU", 1))]
    preload = (
        "import lidarfiles.identity.versions as s; s.backend_versions = lambda name: 'by hand'"
    )
    other = cluster.add(("GPU", 1), preload=preload)
    cluster.add(("LIDAR", 4))
    cluster.wait()
    with Client(cluster.address, set_as_default=False) as client:
        result = simulate(Scene.seed(), SURVEY, client=client, backend="numpy")
    assert same_cloud(result.cloud, expected.cloud)
    [note] = [note for note in result.notes if note.startswith(f"worker {other} ")]
    assert note.endswith("has the backend numpy by hand, but the run requires the backend numpy")
    assert {r.worker for r in result.records if r.stage == "intersect"} <= {*ours}


@pytest.mark.slow
@pytest.mark.parametrize("partition", ["LIDAR", "OTHER"])
def test_other_workers_with_other_sources_end_the_run_before_they_change_a_byte(outside, partition):
    """Those that are there when it begins are refused; this one joins late."""
    planning = Planning((25, 25), (-30, -20), trials=200, particles=60, iterations=60)
    cluster = outside()
    cluster.add(("GPU", 1))
    lidar = cluster.add(("LIDAR", 4))
    cluster.add(("OTHER", 1))
    cluster.wait()
    preload = "import lidarfiles.identity.versions as s; s.source_hash = lambda: '12345678'"

    def on_frame(frame: ScanFrame) -> None:
        if frame.scan == 10:
            cluster.add((partition, 4), preload=preload)
            cluster.wait()
            if partition == "LIDAR":
                cluster.kill(lidar)  # its stages go to the other one

    with (
        Client(cluster.address, set_as_default=False) as client,
        pytest.raises(
            LidarError, match=r"sources 12345678\), but the run requires .*\. Install the same"
        ),
    ):
        long = replace(SURVEY, steps=72 * 1000)  # so that it lasts until the other worker is there
        simulate(Scene.seed(), long, planning, client=client, backend="numpy", on_frame=on_frame)

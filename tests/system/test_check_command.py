"""`lidarpool check`: what it says beforehand is what a run then does."""

from __future__ import annotations

import json
import re
import shutil
from collections import namedtuple
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import trimesh
from distributed import Client, Scheduler, SpecCluster, Worker

import lidarpool.cli.forecast
import lidarpool.run.connection
import lidarpool.scenario.sampling
from lidarpool import simulate
from lidarpool.cli.needs import needs_of
from lidarpool.cli.run_command import make_job
from lidarpool.scenario.sampling import sample_survey
from lidarpool.scenario.scenario import Scenario

SHORT = {"sensor": {"layers": 8}, "planning": {"trials": 4}, "pool": {"backend": "numpy"}}
Usage = namedtuple("Usage", "total used free")


@pytest.fixture(scope="module")
def cluster() -> Iterator[str]:
    """A cluster without OTHER whose workers are threads of this process; its address."""
    quiet = {"host": "127.0.0.1", "dashboard": False}
    workers = {
        name: {"cls": Worker, "options": {"resources": {name: n}, "nthreads": n, **quiet}}
        for name, n in {"GPU": 1, "LIDAR": 4}.items()
    }
    scheduler = {"cls": Scheduler, "options": {"port": 0, "dashboard_address": ":0", **quiet}}
    with SpecCluster(workers=workers, scheduler=scheduler, silence_logs=50) as cluster:
        yield cluster.scheduler_address


@pytest.fixture
def check(tmp_path, lidarpool) -> Callable[..., Any]:
    """Check a scenario whose result would go to the folder `out`."""

    def check(*options: object, text: str = json.dumps(SHORT)) -> Any:
        (tmp_path / "s.yaml").write_text(text)
        return lidarpool("check", tmp_path / "s.yaml", "--out", tmp_path / "out", *options)

    return check


def test_what_is_counted_and_needed_is_what_a_run_gives(cluster, tmp_path):
    job = make_job(Scenario.from_data(SHORT), no_plan=True)
    sample = sample_survey(job.scene, job.survey, "numpy")
    needs = needs_of(job, sample.points)
    with Client(cluster, set_as_default=False) as client:
        result = simulate(
            job.scene, job.survey, client=client, backend="numpy", folder=tmp_path / "run"
        )
    assert job.survey.ray_count > sample.rays == 108 * (20_000 // 108)
    assert sample.hits == pytest.approx(result.hits, rel=0.1)
    assert sample.points == pytest.approx(len(result.points), rel=0.1)
    kept = sum(path.stat().st_size for path in (tmp_path / "run" / "parts").iterdir())
    assert 0.5 * kept < needs_of(job, len(result.points)).parts
    assert needs.cloud > len(result.points) * 22


def test_where_all_rays_are_cast_they_are_counted(cluster):
    job = make_job(Scenario.from_data({"sensor": {"layers": 4}}), no_plan=True)
    sample = sample_survey(job.scene, job.survey, "numpy")
    with Client(cluster, set_as_default=False) as client:
        result = simulate(job.scene, job.survey, client=client, backend="numpy")
    assert sample.rays == result.rays
    assert (sample.hits, sample.points) == (result.hits, len(result.points))


@pytest.mark.parametrize(("rays", "scans"), [(20_000, 500), (20_000, 50), (3_000, 36)])
def test_an_estimate_from_few_rays_is_near(rays, scans, monkeypatch):
    job = make_job(Scenario(), no_plan=True)
    monkeypatch.setitem(lidarpool.scenario.sampling.RAYS_MOST, "numpy", 120_000)
    whole = sample_survey(job.scene, job.survey, "numpy")
    monkeypatch.setitem(lidarpool.scenario.sampling.RAYS_MOST, "numpy", rays)
    monkeypatch.setattr(lidarpool.scenario.sampling, "SCANS_MOST", scans)
    part = sample_survey(job.scene, job.survey, "numpy")
    assert part.rays <= rays and whole.rays == 120_000
    assert part.hits == pytest.approx(whole.hits, rel=0.3)
    assert part.points == pytest.approx(whole.points, rel=0.3)


def test_it_tells_what_a_run_would_do_and_starts_nothing(check, tmp_path):
    outcome = check()
    assert outcome.code == 0
    for said in ("6 objects, 76,800 triangles", "108 scans from 3 poses, 24,000 rays", "4 trials"):
        assert said in outcome.out
    last = outcome.out.splitlines()[-1]
    assert last == f"it can run: lidarpool run {tmp_path / 's.yaml'} --out {tmp_path / 'out'}"
    assert [path.name for path in tmp_path.iterdir()] == ["s.yaml"]


def test_json_is_all_that_is_printed(check):
    outcome = check("--json", "--no-plan")
    assert (outcome.code, outcome.err) == (0, "")
    said = json.loads(outcome.out, parse_constant=pytest.fail)
    assert said["can_run"] is True and said["reasons"] == []
    assert (said["scans"], said["rays"], said["trials"]) == (108, 24_000, 0)
    assert said["backend"] == "numpy"
    assert said["estimate"]["points"] > 0
    assert list(said["slots"]) == ["GPU", "LIDAR"]
    assert said["disk"]["free"] > said["disk"]["result"] > 0
    assert said["memory"]["needed"] > said["memory"]["gpu_worker"] > 0


@pytest.mark.parametrize("as_json", [True, False])
def test_a_disk_without_room(check, as_json, monkeypatch):
    monkeypatch.setattr(shutil, "disk_usage", lambda path: Usage(10**9, 10**9, 1_000_000))
    outcome = check(*["--json"] * as_json)
    assert outcome.code == 2
    assert "it cannot run. The disk of" in outcome.err and "has 1.00 MB free" in outcome.err
    if as_json:
        said = json.loads(outcome.out)
        assert said["can_run"] is False and len(said["reasons"]) == 1
    else:
        assert "it can run" not in outcome.out


def test_too_little_memory(check, monkeypatch):
    monkeypatch.setattr(lidarpool.cli.forecast, "MEMORY_LIMIT", 300_000_000)
    outcome = check()
    assert outcome.code == 2
    assert "There are 300 MB of memory and the run needs about" in outcome.err


def test_all_reasons_are_given_at_once(check, tmp_path, monkeypatch):
    monkeypatch.setattr(lidarpool.cli.forecast, "MEMORY_LIMIT", 1_000_000)
    (tmp_path / "out").write_text("")
    said = json.loads(check("--json").out)
    assert len(said["reasons"]) == 2 and said["estimate"] is None
    assert "is a file" in said["reasons"][0]


def test_a_backend_that_is_not_here(check, monkeypatch):
    outcome = check("--backend", "cuad")
    assert outcome.code == 2 and "Did you mean 'cuda'?" in outcome.err
    assert "backend     none yet" in outcome.out


def test_a_mistake_in_the_scenario(check):
    outcome = check(text="sensor: {layer: 4}")
    assert (outcome.code, outcome.out) == (2, "")
    assert "Did you mean 'layers'?" in outcome.err


def test_a_survey_that_hits_nothing_is_told_of(check):
    outcome = check("--json", text=json.dumps(SHORT | {"poses": [[0, 0, 1000]]}))
    assert outcome.code == 0
    assert "no ray cast here hit anything" in json.loads(outcome.out)["notes"][0]


def test_an_unfinished_run_is_told_of(check, tmp_path):
    (tmp_path / "out" / "run").mkdir(parents=True)
    (tmp_path / "out" / "run" / "run.db").write_bytes(b"")
    outcome = check()
    assert outcome.code == 0
    assert "holds an unfinished run: --resume goes on with it" in outcome.out


def test_a_cluster_that_can_do_it(check, cluster):
    outcome = check("--scheduler", cluster, "--no-plan")
    assert re.search(r"^memory .* in a GPU worker; the driver [\d.]+ MB$", outcome.out, re.M)
    assert outcome.code == 0, outcome.err
    assert "LIDAR       4 slots, at least 4 needed" in outcome.out
    assert "no GPU in partition GPU" in outcome.out
    assert f"--scheduler {cluster} --no-plan" in outcome.out.splitlines()[-1]


def test_a_cluster_that_lacks_a_partition(check, cluster):
    outcome = check("--scheduler", cluster, "--json")
    assert outcome.code == 2
    said = json.loads(outcome.out)
    assert said["slots"]["OTHER"] == {"needed": 1, "there": 0}
    assert "Partition 'OTHER' has 0 of the 1 slot needed" in said["reasons"][0]
    assert said["reasons"][0] in outcome.err


def test_certificates_without_a_cluster(check, tmp_path):
    outcome = check("--tls-ca", tmp_path / "ca.pem")
    assert outcome.code == 2 and "are for the cluster of --scheduler" in outcome.err


def test_no_scheduler_answers(check, monkeypatch):
    monkeypatch.setattr(lidarpool.run.connection, "CONNECT_TIMEOUT_S", 1)
    outcome = check("--scheduler", "tcp://127.0.0.1:1")
    assert outcome.code == 2 and "No Dask scheduler answers" in outcome.err


def test_a_folder_that_is_not_there_yet(lidarpool, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("s.yaml").write_text(json.dumps(SHORT))
    outcome = lidarpool("check", "s.yaml", "--out", "made/here", "--json")
    assert outcome.code == 0
    assert json.loads(outcome.out)["disk"]["folder"] == "made/here"


def test_a_folder_that_cannot_take_a_result(check, tmp_path, lidarpool):
    (tmp_path / "out" / "cloud.ply").mkdir(parents=True)
    outcome = check("--no-plan")
    assert outcome.code == 2
    assert "cloud.ply is a folder, and a result has a file of that name" in outcome.err
    outcome = lidarpool("check", tmp_path / "s.yaml", "--out", tmp_path / "new" / ("n" * 300))
    assert outcome.code == 2
    assert "name too long: give another name or folder" in outcome.err


def box(tmp_path: Path, size: tuple[float, float, float]) -> Path:
    mesh = trimesh.creation.box(size)
    (tmp_path / "my box.stl").write_bytes(mesh.export(file_type="stl"))
    return tmp_path / "my box.stl"


@pytest.mark.parametrize(
    ("size", "unit"), [((8000, 6000, 3000), "mm"), ((0.008, 0.006, 0.003), "km"), ((8, 6, 3), None)]
)
def test_sizes_that_speak_of_another_unit(size, unit, tmp_path, lidarpool):
    outcome = lidarpool("check", box(tmp_path, size))
    assert outcome.code == 0
    assert ("states no unit" in outcome.out) == (unit is not None)
    if unit:
        assert f"lidarpool init DIR --mesh 'my box.stl' --unit {unit}" in outcome.out


def test_a_unit_that_was_given_is_not_doubted(check, tmp_path):
    box(tmp_path, (8, 6, 3))
    outcome = check(text="scene: {files: [{file: my box.stl, unit: km}]}")
    assert "size        8,000 x 6,000 x 3,000 m; x -4,000 to 4,000, y" in outcome.out
    assert "states no unit" not in outcome.out


@pytest.mark.parametrize(
    ("pose", "hidden"), [("0, 0, 1", True), ("0, 0, 3", False), ("9, 0, 1", False)]
)
def test_a_sensor_within_an_object(pose, hidden, check, tmp_path):
    box(tmp_path, (8, 6, 3))
    outcome = check(text=f"scene: [my box.stl]\nposes: [[{pose}]]\n")
    assert outcome.code == 0
    assert (f"from ({pose}) nearly all that is seen are backs" in outcome.out) == hidden


@pytest.mark.parametrize(("heights", "above"), [((1, 2), True), ((-1, 1), False), ((2, 3), False)])
def test_a_sensor_above_the_ceiling_of_the_room(heights, above, check, tmp_path):
    box(tmp_path, (8, 6, 3))  # from -1.5 to 1.5 m
    low, high = heights
    outcome = check(text=f"scene: [my box.stl]\nposes: [[1, 0, {low}], [1, 0, {high}]]\n")
    said = f"something is between (1, 0, {low}) and (1, 0, {high}): if it is a ceiling"
    assert outcome.code == 0 and (said in outcome.out) == above


@pytest.mark.parametrize(("moved", "coarse"), [("stored", True), ("by the scenario", False)])
def test_map_coordinates_in_single_precision(moved, coarse, check, tmp_path):
    mesh = trimesh.creation.icosphere(2, 10)
    place = [500_000, 4_000_000, 100]
    if moved == "stored":
        mesh.apply_translation(place)
    (tmp_path / "ball.stl").write_bytes(mesh.export(file_type="stl"))
    entry = {"file": "ball.stl"} | ({} if coarse else {"translation": place})
    outcome = check(text=json.dumps({"scene": {"files": [entry]}}))
    assert ("in steps of 0.25 m: export the mesh nearer to zero" in outcome.out) == coarse


def test_a_scene_that_is_not_hit_says_where_it_is(check, tmp_path):
    box(tmp_path, (8, 6, 3))
    outcome = check(text="scene: [my box.stl]\nposes: [[900, 0, 90]]\nsensor: {layers: 1}\n")
    assert "the scene reaches from (-4, -3, -1.5) to (4, 3, 1.5)" in outcome.out


def test_the_memory_of_swarms_is_counted(check):
    outcome = check(text="planning: {particles: 10000000, waypoints: 100}")
    assert outcome.code == 2
    assert "of memory and the run needs about" in outcome.err
    assert "particles" in outcome.err

"""Runs whose driver is killed: the next goes on, and its result has the same bytes."""

import json
import re
import shutil
import signal
import sqlite3
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from distributed import Client
from tests import killed_drivers

from lidarpool import LidarError, ScanFrame, Scene, Sensor, Survey, remove_run, save_cloud, simulate
from lidarscenario.prepare import prepare
from lidarscenario.scenario import Scenario

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="forks")

SCENARIO = """
scene: seed
sensor: {rays_per_revolution: 900, layers: 8, step_deg: 2}
poses: [[0, 0, 1], [3, 0, 1]]
steps: 180
cloud: {keep_every: 2}
planning: {start: [25, 25], target: [-30, -20], trials: 4, iterations: 20}
pool: {backend: numpy, gpu: 1, other: 1}
"""
SCANS = 2 * 180
KEPT = r"contains an unfinished run with [\d,]+ of \d+ scans\. Continue it with"


@pytest.fixture(scope="module")
def undisturbed(cluster: str, tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """Cloud of the scenario in one go."""
    built = prepare(Scenario.from_data(yaml.safe_load(SCENARIO)))
    with Client(cluster, set_as_default=False) as client:
        result = simulate(built.scene, built.survey, client=client, backend="numpy")
    path = tmp_path_factory.mktemp("undisturbed") / "cloud.ply"
    save_cloud(result.points, path)
    return path.read_bytes()


@pytest.fixture
def drive(tmp_path: Path, cluster: str) -> Callable[[list[tuple[str, int]]], list[int]]:
    """Run the scenario again and again, each killed at a point; how they ended."""
    (tmp_path / "s.yaml").write_text(SCENARIO)
    arguments = ["s.yaml", "--out", "out", "--resume", "--scheduler", cluster]
    return lambda kills: killed_drivers.drive(tmp_path, kills, *arguments)


def committed(folder: Path) -> list[tuple[int, int]]:
    """Scans of the parts in a run's database."""
    with sqlite3.connect(f"file:{folder / 'run.db'}?mode=ro", uri=True) as sql:
        return sql.execute("SELECT first, stop FROM parts").fetchall()


def report_of(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "report.json").read_text())


MOMENTS = [
    ("COMMIT", 1),  # parts are in storage, and nothing is in the database
    ("COMMIT", 2),  # a run's first is of less than half: few batches are under way until then
    ("driver.frame", 100),
    ("GROW", 1),  # by a thread, of parts of earlier runs
    ("OPEN", 1),
    ("GROW", 5),
    ("SAVE", 1),
    ("REMOVE", 1),
]


@pytest.mark.slow
def test_a_driver_is_killed_at_several_moments(drive, undisturbed, tmp_path):
    out = tmp_path / "out"
    assert drive([*MOMENTS, ("", 1)]) == [-signal.SIGKILL] * len(MOMENTS) + [0]
    assert (out / "cloud.ply").read_bytes() == undisturbed
    assert not (out / "run").exists()
    report = report_of(out)
    assert report["resumed_scans"] == report["scans"] == SCANS
    assert report["placement_violations"] == 0
    assert {path.name for path in out.iterdir()} >= {"cloud.ply", "report.json", "report.html"}
    assert not [path.name for path in out.iterdir() if path.name.startswith(".")]


@pytest.mark.extended
def test_an_unfinished_run_is_refused_resumed_or_dropped(
    cluster, drive, lidarpool, undisturbed, tmp_path
):
    out = tmp_path / "out"
    assert drive([("driver.points", 12)]) == [-signal.SIGKILL]
    before = committed(out / "run")
    arguments = ["run", tmp_path / "s.yaml", "--out", out, "--scheduler", cluster, "-q"]
    refused = lidarpool(*arguments)
    assert (refused.code, refused.out) == (2, "")
    assert re.fullmatch(
        rf"lidarpool: \S+/out/run {KEPT} `--resume` \(.*\), "
        r"or remove it with `--restart` \(.*\)\.\n",
        refused.err,
    )
    path, *rest = arguments[1:]
    path.with_name("t.yaml").write_text(SCENARIO.replace("trials: 4", "enabled: false"))
    other = lidarpool("run", path.with_name("t.yaml"), *rest, "--resume")
    assert other.code == 2 and "the planning has changed: " in other.err
    wrong = lidarpool(*arguments, "--resume", "--backend", "tiles")
    assert wrong.code == 2 and "were cast with the backend 'numpy', so" in wrong.err
    both = lidarpool(*arguments, "--resume", "--restart")
    assert both.code == 2 and "cannot be combined" in both.err
    assert committed(out / "run") == before

    shutil.copytree(out, tmp_path / "restart")
    dropped = lidarpool(*arguments, "--restart", "--out", tmp_path / "restart")
    assert (dropped.code, dropped.err) == (0, "")
    assert (tmp_path / "restart" / "cloud.ply").read_bytes() == undisturbed
    assert report_of(tmp_path / "restart")["resumed_scans"] == 0

    # Parts that are gone are made again; and the backend of the others is taken.
    (part,) = (out / "run" / "parts").glob("*-{:08d}-{:08d}.npz".format(*before[0]))
    part.unlink()
    resumed = lidarpool(*arguments, "--resume", "--backend", "auto")
    assert (resumed.code, resumed.err) == (0, "")
    assert (out / "cloud.ply").read_bytes() == undisturbed
    report = report_of(out)
    assert sum(stop - first for first, stop in before[1:]) <= report["resumed_scans"] < SCANS
    (note,) = (note for note in report["notes"] if note.startswith("repeated scan"))
    assert f"{part.name} was missing" in note


@pytest.mark.extended
def test_nothing_to_resume_is_no_error(cluster, lidarpool, tmp_path):
    (tmp_path / "s.yaml").write_text("scene: seed\nsensor: {layers: 4}\n")
    arguments = ["run", tmp_path / "s.yaml", "--out", tmp_path / "out", "--scheduler", cluster]
    done = lidarpool(*arguments, "--cloud-only", "-q", "--resume")
    assert (done.code, done.err) == (0, "")
    assert f"note: {tmp_path / 'out'} contained no unfinished run to resume" in done.out


SURVEY = Survey(
    Sensor.grid(rays_per_revolution=360, layers=8, step_deg=5), [(0, 0, 1), (0, 0, 2)], 72
)


def test_frames_go_on_where_they_were(cluster_client, tmp_path, monkeypatch, same_cloud):
    folder = tmp_path / "kept"
    first: list[int] = []
    second: list[int] = []

    def run(**options: Any):
        return simulate(Scene.seed(), SURVEY, client=cluster_client, folder=folder, **options)

    def on_frame(frame: ScanFrame) -> None:
        if not first:
            with pytest.raises(LidarError, match=f"Another run is using {folder}"):
                run()
        first.append(frame.scan)
        if frame.scan == 50:  # its points are committed
            raise ZeroDivisionError("enough")

    whole = simulate(Scene.seed(), SURVEY, client=cluster_client, backend="tiles")
    with pytest.raises(ZeroDivisionError) as caught:
        run(on_frame=on_frame, backend="tiles")
    assert re.fullmatch(
        rf"\d+ of 144 scans are stored in {folder}. Continue with `--resume` \(.*\)\.",
        *caught.value.__notes__,
    )
    with pytest.raises(LidarError, match=rf"{KEPT} `--resume` .*resume=True.*remove_run"):
        run()
    result = run(resume=True, on_frame=lambda frame: second.append(frame.scan))
    assert first == list(range(51))
    assert second == list(range(50, 144))  # the one that it failed on is handed out again
    assert result.resumed > 50
    assert result.backend == "tiles"
    assert (result.hit_counts == whole.hit_counts).all() and result.hit_count == whole.hit_count
    assert (result.sample_rays == whole.sample_rays).all()
    assert same_cloud(result.cloud, whole.cloud)

    # A complete run needs no cluster.
    monkeypatch.setattr("lidarpool.run.cluster.cluster.local_client", None)
    again = simulate(Scene.seed(), SURVEY, folder=folder, resume=True)
    assert again.resumed == SURVEY.scan_count and again.records == ()
    assert again.backend == "tiles"
    assert same_cloud(again.cloud, whole.cloud)
    remove_run(folder)
    assert not folder.exists()

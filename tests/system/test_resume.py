"""Runs whose driver is killed: the next goes on, and its result has the same bytes."""

from __future__ import annotations

import json
import random
import re
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from distributed import Client

from lidarpool import LidarpoolError, Scene, Sensor, Survey, remove_journal, save_cloud, simulate
from lidarpool.report import make_report
from lidarpool.scenario import Scenario

pytestmark = pytest.mark.skipif(
    not Path("/proc/self/environ").exists(), reason="finds the processes of a run through /proc"
)

# Some seconds of work, in many small batches.
SCENARIO = """
sensor: {rays_per_revolution: 1800, layers: 16, step_deg: 2}
poses: [[0, 0, 1], [0, 0, 2], [3, 0, 1], [0, 3, 1]]
steps: 180
cloud: {keep_every: 2}
planning: {trials: 30, iterations: 40}
pool: {backend: numpy, gpu: 1, other: 1}
"""
SCANS = 4 * 180
SMALL = "sensor: {layers: 4}\nplanning: {trials: 2}\n"

# Drawing takes longer than the survey, and is not what is asked after.
NO_PICTURES = """
import lidarpool.pictures as pictures
pictures.take_shot = lambda *_, **__: None
def draw(path, *_, **__): path.write_bytes(b"x")
pictures.draw_scene = pictures.draw_intensity = draw
pictures.draw_cloud = pictures.draw_path = draw
"""


@pytest.fixture(scope="module")
def undisturbed(cluster: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Result of the scenario in one go."""
    scenario = Scenario.from_data(yaml.safe_load(SCENARIO))
    scene = scenario.build_scene()
    survey, planning = scenario.survey(scene), scenario.plan(scene)
    with Client(cluster, set_as_default=False) as client:
        result = simulate(scene, survey, planning, client=client, backend="numpy")
    out = tmp_path_factory.mktemp("undisturbed")
    save_cloud(out / "cloud.ply", result.points)
    report = make_report(result, scene, survey, planning, [])
    (out / "report.json").write_text(json.dumps(report))
    return out


def same_result(out: Path, expected: Path) -> bool:
    """Whether two results agree in all that does not depend on time and place."""
    reports = [json.loads((folder / "report.json").read_text()) for folder in (out, expected)]
    names = ("hits", "points", "points_by_object", "planning", "backend", "scans")
    return (out / "cloud.ply").read_bytes() == (expected / "cloud.ply").read_bytes() and all(
        reports[0][name] == reports[1][name] for name in names
    )


def kept_in(journal: Path) -> int:
    try:
        return (journal / "records").stat().st_size
    except FileNotFoundError:  # not yet, or no longer
        return 0


def kill_and_resume(
    start: Callable[..., Any], folder: Path, times: int, seed: int, *options: str
) -> list[int]:
    """Kill the driver so many times, each going on from the one before; sizes of the journal."""
    dice = random.Random(seed)
    sizes = []
    for _ in range(times):
        # Once it has delivered something more, or at any time from its start on.
        enough = kept_in(folder / "out" / "journal") + dice.randrange(16_000)
        run = start(SCENARIO, "--resume", *options, prelude=NO_PICTURES + dying(enough))
        if dice.random() < 0.2:
            time.sleep(dice.uniform(0, 3))
            run.process.kill()
        assert run.process.wait(300) == -signal.SIGKILL, run.said
        run.wait_until_alone()
        sizes.append(kept_in(folder / "out" / "journal"))
    last = start(SCENARIO, "--resume", *options, prelude=NO_PICTURES)
    assert last.process.wait(300) == 0, last.said
    assert "Traceback" not in last.said
    return sizes


def dying(size: int) -> str:
    """Code that kills its own process when the journal has grown over so many bytes.

    From outside it may come too late: the survey can end before the one that waits for its
    journal has its turn.
    """
    return f"""
import os, signal
from lidarpool.records import RecordFile
append = RecordFile.append
def append_or_die(self, *record):
    if self.end > {size}:
        os.kill(os.getpid(), signal.SIGKILL)
    return append(self, *record)
RecordFile.append = append_or_die
"""


def test_a_driver_is_killed_three_times(cluster, start_command, undisturbed, tmp_path):
    options = (SCENARIO, "--resume", "--scheduler", cluster)
    for size in (5_000, 30_000, 60_000):
        run = start_command(*options, prelude=NO_PICTURES + dying(size))
        assert run.process.wait(300) == -signal.SIGKILL, run.said
        assert size < kept_in(tmp_path / "out" / "journal") < 100_000
    run = start_command(*options, prelude=NO_PICTURES)
    assert run.process.wait(300) == 0, run.said
    assert same_result(tmp_path / "out", undisturbed)
    assert not (tmp_path / "out" / "journal").exists()
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert 0 < report["resumed_scans"] < SCANS


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_a_driver_is_killed_twenty_times(seed, start_command, undisturbed, tmp_path):
    """Five times in each of four runs, with clusters of their own that end by themselves."""
    sizes = kill_and_resume(start_command, tmp_path, 5, seed)
    assert sizes[-1] > 0
    assert same_result(tmp_path / "out", undisturbed)


def test_an_unfinished_run_is_refused_resumed_or_dropped(
    cluster, start_command, lidarpool, undisturbed, tmp_path, no_pictures
):
    run = start_command(SCENARIO, "--scheduler", cluster, prelude=NO_PICTURES + dying(60_000))
    journal = tmp_path / "out" / "journal"
    assert run.process.wait(300) == -signal.SIGKILL, run.said
    before = (journal / "records").read_bytes()
    arguments = ["run", tmp_path / "s.yaml", "--out", tmp_path / "out", "--scheduler", cluster]

    refused = lidarpool(*arguments, "-q")
    assert (refused.code, refused.out) == (2, "")
    assert re.fullmatch(
        r"lidarpool: \S+/out/journal holds an unfinished run, \d+ of 720 scans: continue it with "
        r"--resume, or drop it with --fresh\.\n",
        refused.err,
    )
    other = lidarpool(*arguments, "-q", "--resume", "--no-plan")
    assert other.code == 2 and "is of another planning. Drop it with --fresh" in other.err
    wrong = lidarpool(*arguments, "-q", "--resume", "--backend", "embree")
    assert wrong.code == 2 and "were cast with 'numpy': continue with that" in wrong.err
    both = lidarpool(*arguments, "-q", "--resume", "--fresh")
    assert both.code == 2 and "give one of them" in both.err
    assert (journal / "records").read_bytes() == before

    # Nothing is said of backends; those of the scans there are taken.
    resumed = lidarpool(*arguments, "-q", "--resume", "--backend", "auto")
    assert (resumed.code, resumed.err) == (0, "")
    assert same_result(tmp_path / "out", undisturbed)


def test_a_dropped_run_starts_anew(cluster, lidarpool, tmp_path, no_pictures):
    (tmp_path / "s.yaml").write_text(SMALL)
    arguments = ["run", tmp_path / "s.yaml", "--out", tmp_path / "out", "--scheduler", cluster]
    scenario = Scenario.from_data(yaml.safe_load(SMALL))
    scene = scenario.build_scene()
    (tmp_path / "out").mkdir()

    def enough(frame: Any) -> None:
        # Frames may be ahead of the points, without which there is nothing to keep.
        if frame.scan >= 30 and kept_in(tmp_path / "out" / "journal"):
            raise ZeroDivisionError

    with Client(cluster, set_as_default=False) as client, pytest.raises(ZeroDivisionError):
        simulate(
            scene, scenario.survey(scene), client=client, journal=tmp_path / "out" / "journal",
            on_frame=enough,
        )  # fmt: skip
    refused = lidarpool(*arguments, "-q", "--resume")
    assert refused.code == 2 and "is of another planning" in refused.err
    done = lidarpool(*arguments, "-q", "--fresh")
    assert (done.code, done.err) == (0, "")
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["resumed_scans"] == 0 and report["scans"] == 108
    assert not (tmp_path / "out" / "journal").exists()


def test_nothing_to_resume_is_no_error(cluster, lidarpool, tmp_path, no_pictures):
    (tmp_path / "s.yaml").write_text(SMALL)
    arguments = ["run", tmp_path / "s.yaml", "--out", tmp_path / "out", "--scheduler", cluster]
    done = lidarpool(*arguments, "-q", "--resume")
    assert (done.code, done.err) == (0, "")
    assert f"note: there was nothing to resume in {tmp_path / 'out'}" in done.out
    again = lidarpool(*arguments, "-q")
    assert again.code == 0 and "nothing to resume" not in again.out


# -- from Python ---------------------------------------------------------------------------------

SURVEY = Survey(Sensor(rays_per_revolution=360, layers=8, step_deg=5), [(0, 0, 1), (0, 0, 2)], 72)


def test_frames_go_on_where_they_were(cluster, tmp_path):
    journal = tmp_path / "kept"
    first: list[int] = []
    second: list[int] = []

    def fail(frame: Any) -> None:
        first.append(frame.scan)
        if frame.scan >= 50 and kept_in(journal):  # frames may be ahead of the points
            raise ZeroDivisionError("enough")

    with Client(cluster, set_as_default=False) as client:
        whole = simulate(Scene.seed(), SURVEY, client=client)
        with pytest.raises(ZeroDivisionError) as caught:
            simulate(Scene.seed(), SURVEY, client=client, journal=journal, on_frame=fail)
        assert re.fullmatch(
            rf"\d+ of 144 scans are kept in {journal}: continue with resume=True\.",
            *caught.value.__notes__,
        )
        with pytest.raises(LidarpoolError, match=r"continue it with resume=True, or drop it with"):
            simulate(Scene.seed(), SURVEY, client=client, journal=journal)
        result = simulate(
            Scene.seed(), SURVEY, client=client, journal=journal, resume=True,
            on_frame=lambda frame: second.append(frame.scan),
        )  # fmt: skip
    assert first == list(range(first[-1] + 1))
    assert second == list(range(first[-1], 144))  # the one that it failed on is handed out again
    assert result.resumed > 0
    assert (result.hit_counts == whole.hit_counts).all() and result.hits == whole.hits
    assert (result.sample_rays == whole.sample_rays).all()
    assert result.cloud.positions.tobytes() == whole.cloud.positions.tobytes()
    assert result.cloud.object.tobytes() == whole.cloud.object.tobytes()


def test_a_complete_journal_needs_no_cluster(cluster, tmp_path, monkeypatch):
    journal = tmp_path / "kept"
    with Client(cluster, set_as_default=False) as client:
        first = simulate(Scene.seed(), SURVEY, client=client, journal=journal)
    monkeypatch.setattr("lidarpool.simulation.local_client", None)
    again = simulate(Scene.seed(), SURVEY, journal=journal, resume=True)
    assert again.resumed == SURVEY.scan_count and again.records == ()
    assert again.backend == first.backend
    assert again.cloud.positions.tobytes() == first.cloud.positions.tobytes()
    remove_journal(journal)
    assert not journal.exists()
    assert len(again.points.load()) == len(first.points)  # as long as the result is in use


def test_a_backend_that_is_not_to_be_had_any_more(cluster, tmp_path, monkeypatch):
    journal = tmp_path / "kept"

    def fail(frame: Any) -> None:
        if frame.scan >= 50 and kept_in(journal):
            raise ZeroDivisionError

    with Client(cluster, set_as_default=False) as client:
        with pytest.raises(ZeroDivisionError):
            simulate(Scene.seed(), SURVEY, client=client, journal=journal, on_frame=fail,
                     backend="numpy")  # fmt: skip
        lost = {"cuda": "no GPU", "embree": "", "numpy": "it was forgotten"}
        monkeypatch.setattr("lidarpool.checks.available_backends", lambda: lost)
        with pytest.raises(
            LidarpoolError,
            match=r"'numpy' cannot be used on .*: it was forgotten\. The scans in the journal .* "
            r"were cast with it: continue where it is to be had, or drop them",
        ):
            simulate(Scene.seed(), SURVEY, client=client, journal=journal, resume=True)


def test_a_journal_that_others_write_to_makes_no_result(cluster, tmp_path):
    cut: list[int] = []  # at which frame

    def meddle(frame):
        if not cut and kept_in(tmp_path / "journal") > 40:
            cut.append(frame.scan)
            with (tmp_path / "journal" / "records").open("r+b") as file:
                file.truncate(40)  # what comes behind it leaves a gap of zeros

    survey = Survey(Sensor(rays_per_revolution=360, layers=8, step_deg=10), [(0, 0, 1)], steps=36)
    refused = pytest.raises(LidarpoolError, match="was changed while this run wrote to it")
    with Client(cluster, set_as_default=False) as client, refused:
        simulate(
            Scene.seed(),
            survey,
            client=client,
            backend="numpy",
            on_frame=meddle,
            journal=tmp_path / "journal",
        )

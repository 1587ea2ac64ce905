"""The command as a user sees it when all goes well: files, report, what is printed."""

import json
import logging
import os
import re
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from hashlib import sha256
from ipaddress import ip_address
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
from tests.system.default_survey import DEFAULT_CLOUD_SHA256

from lidarpool import read_cloud
from lidarpool.cli.terminal import Terminal
from lidarpool.report.result_files import FILES

COMMAND = [sys.executable, "-c", "from lidarpool.cli.commands import main; main()"]
PLAIN = "scene: seed\nsensor: {layers: 8}\n"
ENDS = "start: [25, 25], target: [-30, -20]"
SHORT = f"{PLAIN}planning: {{{ENDS}, trials: 4, iterations: 20}}\n"


# A run does without the records of stages that end too late on a busy machine.
PATIENT = """
from functools import partial
import lidarpool.run.pipeline.long_stages as stages
stages.LAST_WORDS_S = 120
stages.fetch_available = partial(stages.fetch_available, patience_s=120)
"""
DRAWN = {f"{name}.png" for name in ("scene", "hits", "cloud", "path")}
MADE = [name for name in FILES if name != "intensity.png"]  # the cloud has no such column


def names_in(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


@dataclass
class Demo:
    """The demo, run as a newcomer does, with a home that Matplotlib cannot write to."""

    out: Path
    ended: subprocess.CompletedProcess[str]
    sockets: list[list[str]]  # addresses that its processes listened on, at several moments


@pytest.fixture(scope="module")
def demo(tmp_path_factory) -> Demo:
    out = tmp_path_factory.mktemp("demo") / "made" / "here"
    sockets = []
    python, option, code = COMMAND
    with subprocess.Popen(
        [python, option, PATIENT + code, "demo", "--out", out],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env={**os.environ, "MPLCONFIGDIR": "/dev/null/config"},
    ) as process:  # fmt: skip
        while True:
            try:
                said = process.communicate(timeout=2.0)
                break
            except subprocess.TimeoutExpired:
                sockets.append(listened_on(process.pid))
    ended = subprocess.CompletedProcess(process.args, process.returncode, *said)
    return Demo(out, ended, sockets)


def listened_on(pid: int) -> list[str]:
    """Addresses on which a process and its children listen now, one a socket."""
    driver = psutil.Process(pid)
    found = []
    for process in (driver, *driver.children(recursive=True)):
        with suppress(psutil.Error):  # it has ended meanwhile
            found += [c.laddr.ip for c in process.net_connections() if c.status == "LISTEN"]
    return found


@pytest.mark.slow
def test_the_demo_makes_all_files_and_says_so(demo):
    out = demo.out
    ended = demo.ended
    assert ended.returncode == 0, ended.stderr
    assert names_in(out) == {*MADE}
    for name in MADE[1:5]:
        assert (out / name).read_bytes().startswith(b"\x89PNG")
    shown = (Path(__file__).parents[2] / "docs/overview.md").read_text("utf-8")
    told = re.search(r"108 scans .* points in the cloud", ended.stdout)
    assert told and told[0] in shown
    assert f"{len(read_cloud(out / 'cloud.ply')):,} points in the cloud" in ended.stdout
    assert re.search(r"collision-free path of 71\.\d\d m; the shortest possible", ended.stdout)
    assert ended.stdout.splitlines()[-1] == f"results in {out}: {', '.join(MADE)}"


@pytest.mark.slow
def test_progress_that_is_not_for_a_terminal_comes_as_short_lines(demo):
    ended = demo.ended
    lines = ended.stderr.splitlines()
    for line in lines:
        assert re.fullmatch(r"\d\d:\d\d:\d\d  [a-z].*", line), line  # and no log of a library
        assert len(line) <= 120
        assert not re.search(r"\bnan\b|\binf\b|\x1b", line)
    assert "survey  done: 108 scans" in ended.stderr
    assert "planning  done: 100 trials" in ended.stderr
    assert any("writing the cloud" in line for line in lines)


@pytest.mark.extended
def test_the_report_has_all_that_is_promised(demo):
    out = demo.out
    text = (out / "report.json").read_text()
    report = json.loads(text, parse_constant=pytest.fail)  # NaN and Infinity are valid JSON
    assert report["files"] == MADE
    assert report["scans"] == 108 and report["rays"] == 120_000
    assert (report["hits"], report["points"]) == (4926, 995)
    assert sha256((out / "cloud.ply").read_bytes()).hexdigest() == DEFAULT_CLOUD_SHA256
    assert sum(report["points_by_object"].values()) == report["points"]
    assert report["backend"] in ("cuda", "tiles", "numpy")
    assert {"lidarpool", "python", "numpy", "dask", "distributed"} <= report["versions"].keys()
    assert report["parameters"]["sensor"]["channels"] == 40
    assert report["parameters"]["sensor"]["max_range_m"] is None  # infinite
    assert list(report["stages"]) == ["generate", "intersect", "sort", "collect", "trial"]
    for stage in ("generate", "intersect", "sort", "collect"):
        assert report["stages"][stage]["items"] == 108
    assert report["placement_violations"] == 0
    assert report["seconds"]["survey_and_planning_overlap"] > 0
    planning = report["planning"]
    assert planning["trials"] == 100 and planning["collision_free"]
    assert planning["shortest_possible"] <= planning["best_length"] * (1 + 1e-9)
    assert planning["best_length"] <= 1.01 * planning["shortest_possible"]


@pytest.mark.extended
def test_the_demo_listens_on_loopback_only(demo):
    # Scheduler and dashboard, and of each of three partitions at least a nanny and a worker.
    assert max(map(len, demo.sockets)) >= 2 + 3 * 2
    assert all(ip_address(one).is_loopback for addresses in demo.sockets for one in addresses)


@pytest.fixture
def run(tmp_path, lidarpool, cluster) -> Callable[..., Any]:
    """Run a scenario on the threads' cluster, into the folder `out`."""

    def run(*options: str, text: str = SHORT) -> Any:
        (tmp_path / "s.yaml").write_text(text)
        arguments = ["--out", tmp_path / "out", "--scheduler", cluster, *options]
        return lidarpool("run", tmp_path / "s.yaml", *arguments)

    return run


@pytest.mark.slow
def test_without_planning_an_earlier_path_is_removed(run, tmp_path):
    (tmp_path / "out").mkdir()
    for name in ("path.png", "mine.txt"):
        (tmp_path / "out" / name).write_text("earlier")
    outcome = run("--quiet", "--overwrite", text=PLAIN)
    assert (outcome.code, outcome.err) == (0, "")
    assert names_in(tmp_path / "out") == {*MADE, "mine.txt"} - DRAWN
    assert "path of" not in outcome.out and "path.png" not in outcome.out
    assert json.loads((tmp_path / "out" / "report.json").read_text())["planning"] is None


@pytest.mark.extended
def test_a_path_that_there_is_not(run):
    ring = [f"{{center: [{25 + 6 * np.cos(a):.3f}, {25 + 6 * np.sin(a):.3f}], radius_m: 3}}"
            for a in np.arange(0, 6.28, 0.5)]  # fmt: skip
    planning = f"planning: {{{ENDS}, trials: 2, iterations: 5, obstacles: [{', '.join(ring)}]}}\n"
    outcome = run(text="scene: seed\nsensor: {layers: 2}\n" + planning)
    assert outcome.code == 0, outcome.err
    assert "no collision-free path was found; no path is possible" in outcome.out


@pytest.mark.extended
def test_a_run_that_hits_nothing_says_so(run):
    outcome = run(text="scene: seed\nsteps: 1\nposes: [[0, 0, 1000]]\n")
    assert outcome.code == 0
    assert "warning: the cloud has no points: no ray hits a surface" in outcome.err


def test_json_is_one_document_and_all_of_stdout(run, tmp_path):
    outcome = run("--json")
    assert outcome.code == 0
    assert "survey  done: 108 scans" in outcome.err  # progress for people beside it
    said = json.loads(outcome.out, parse_constant=pytest.fail)
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert said["folder"] == str(tmp_path / "out")
    assert list(said["files"]) == report["files"]
    assert all(Path(path).is_file() for path in said["files"].values())
    assert said["points"] == len(read_cloud(said["files"]["cloud.ply"])) > 0
    for name in ("scans", "rays", "hits", "backend", "notes", "seconds", "placement_violations"):
        assert said[name] == report[name]
    assert said["planning"]["best_length"] == report["planning"]["best_length"]


@pytest.mark.extended
def test_warnings_of_libraries_are_not_on_the_terminal(run, monkeypatch):
    progress = Terminal.progress

    def warn(terminal: Terminal) -> Any:
        logging.getLogger("distributed.worker").warning("memory is nearly full")
        return progress(terminal)

    monkeypatch.setattr(Terminal, "progress", warn)
    outcome = run(text=PLAIN)
    assert outcome.code == 0
    assert "memory is nearly full" not in outcome.err + outcome.out


@pytest.mark.slow
def test_verbose_shows_what_driver_and_workers_log(tmp_path):
    (tmp_path / "s.yaml").write_text(SHORT)
    # In a process of its own: the workers of the tests' cluster log elsewhere.
    ended = subprocess.run(
        [*COMMAND, "run", "s.yaml", "-v", "-q", "--cloud-only"],
        cwd=tmp_path, check=True, capture_output=True, text=True,
    )  # fmt: skip
    assert {"scheduler", "worker"} <= set(re.findall(r"distributed\.(\w+) - INFO", ended.stderr))


def test_doctor_tells_what_is_here(lidarpool):
    outcome = lidarpool("doctor")
    assert (outcome.code, outcome.err) == (0, "")
    first_words = [line.split()[0] for line in outcome.out.splitlines()]
    assert {"lidarpool", "python", "dask", "GPUs", "backends", "cuda", "tiles"} <= {*first_words}
    assert {"cores", "memory", "disk", "extras", "las", "ports", "8786"} <= {*first_words}
    assert re.search(r"^  numpy +ready$", outcome.out, re.MULTILINE)
    told = json.loads(lidarpool("doctor", "--json").out)
    assert told["backends"]["numpy"] == "ready" and told["workers"] == []
    assert told["machine"]["cores"] >= 1 and told["ports"].keys() >= {"80", "8786"}
    assert lidarpool("-h").out == lidarpool().out == lidarpool("--help").out
    assert lidarpool("--version").out.startswith("lidarpool, version ")


@pytest.mark.slow
@pytest.mark.usefixtures("pictures")
def test_the_pictures_of_a_run_are_drawn_again_to_the_bit(demo, lidarpool, tmp_path):
    out = demo.out
    again = lidarpool("plot", out, "--only", "scene", "--only", "path", "--out", tmp_path)
    assert (again.code, again.err) == (0, "")
    for name in ("scene.png", "path.png"):
        assert (tmp_path / name).read_bytes() == (out / name).read_bytes()


def hidden(page: Path) -> list[str]:
    """Pictures that a page has room for and does not show."""
    return re.findall(r'data-picture="(\w+)" hidden', page.read_text("utf-8"))


@pytest.mark.slow
def test_pictures_are_drawn_if_they_are_asked_for_or_later(run, lidarpool, tmp_path):
    out = tmp_path / "out"
    assert run("--quiet", text=PLAIN).code == 0
    assert names_in(out) == {*MADE} - DRAWN
    assert hidden(out / "report.html") == ["scene", "hits", "intensity", "cloud", "path"]
    outcome = lidarpool("plot", out, "--only", "hits", "--only", "cloud")
    assert outcome.out.split() == [str(out / "hits.png"), str(out / "cloud.png")]
    assert hidden(out / "report.html") == ["scene", "intensity", "path"]
    # What was drawn of an earlier run is of the same result, and goes with it.
    assert run("--quiet", text=PLAIN).code == 0
    assert names_in(out) == {*MADE} - DRAWN
    assert run("--quiet", "--pictures").code == 0
    assert json.loads((out / "report.json").read_text())["files"] == MADE
    assert names_in(out) == {*MADE} and hidden(out / "report.html") == ["intensity"]
    outcome = run("--pictures", "--cloud-only")
    assert outcome.code == 2 and "`--cloud-only` and `--pictures` cannot be combined" in outcome.err


@pytest.mark.parametrize("words", [["--version"], ["--help"], ["run", "--help"], [None]])
def test_help_and_completion_load_nothing_of_a_run(words):
    """What a run needs takes a second to import."""
    environment = {**os.environ}
    python = [sys.executable, "-X", "importtime", *COMMAND[1:]]
    if words == [None]:  # the Tab key
        words = []
        environment["_LIDARPOOL_COMPLETE"] = "bash_complete"
        environment |= {"COMP_WORDS": "lidarpool run --re", "COMP_CWORD": "2"}
    done = subprocess.run([*python, *words], capture_output=True, text=True, env=environment)
    assert done.returncode == 0 and done.stdout
    loaded = {line.split("|")[-1].strip().split(".")[0] for line in done.stderr.splitlines()}
    assert "click" in loaded
    assert not {"numpy", "dask", "distributed", "pydantic", "rich", "trimesh"} & loaded


@pytest.mark.extended
def test_checking_a_scenario_loads_neither_reports_nor_loops_for_moving_bodies(tmp_path):
    (tmp_path / "s.yaml").write_text(PLAIN)
    done = subprocess.run(
        [sys.executable, "-X", "importtime", *COMMAND[1:], "check", "s.yaml"],
        capture_output=True, text=True, cwd=tmp_path,
    )  # fmt: skip
    assert done.returncode == 0 and done.stdout
    loaded = {line.split("|")[-1].strip() for line in done.stderr.splitlines()}
    assert "lidarsim.simulator.sampling" in loaded
    absent = {"lidarpool.report.output", "raybeam.moving_loops", "raybeam.pair_casts"}
    assert not absent & loaded


@pytest.mark.extended
@pytest.mark.parametrize(
    "arguments",
    [["sensors"], pytest.param(["run", "s.yaml", "--cloud-only", "-q"], marks=pytest.mark.slow)],
)
def test_a_reader_that_leaves_ends_the_printing_only(tmp_path, arguments):
    (tmp_path / "s.yaml").write_text(PLAIN)
    with subprocess.Popen(
        [sys.executable, "-m", "lidarpool", *arguments],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=tmp_path,
    ) as command:  # fmt: skip
        assert command.stdout and command.stderr
        command.stdout.close()  # as `head` does after its last line
        assert command.stderr.read() == ""
    assert command.returncode == 0
    assert (tmp_path / "lidarpool-out" / "cloud.ply").exists() == (arguments[0] == "run")


def processes_with(variable: str) -> list[str]:
    """Command lines of the processes that have inherited a variable of the environment."""
    commands = []
    for process in psutil.process_iter():
        with suppress(psutil.Error):
            if variable in process.environ() and process.status() != psutil.STATUS_ZOMBIE:
                commands.append(" ".join(process.cmdline()))
    return commands


@pytest.mark.slow
def test_a_timeline_says_when_each_step_ended_and_no_process_is_left(tmp_path):
    mark = f"LIDARPOOL_TEST_{os.getpid()}"
    (tmp_path / "scenario.yaml").write_text(SHORT)
    page = tmp_path / "timeline.html"
    arguments = ["run", "scenario.yaml", "-q", "--cloud-only", "--timeline", page]
    environment = {**os.environ, mark: "1"}
    began_s = time.monotonic()
    ended = subprocess.run(
        [*COMMAND, *arguments],
        cwd=tmp_path, capture_output=True, text=True, check=True, env=environment,
    )  # fmt: skip
    wall_s = time.monotonic() - began_s
    time.sleep(1)
    assert processes_with(mark) == []
    table = re.search(r"^step +duration +end\n(.*)", ended.stderr, re.DOTALL | re.MULTILINE)
    lines = table[1].splitlines()
    rows = [re.fullmatch(r"(\D+?) +([\d.]+) s +([\d.]+) s", line).groups() for line in lines]
    steps = [name for name, _, _ in rows]
    assert steps[:3] == ["command imported", "scene read", "workers started"]
    assert steps[-4:] == ["report written", "result in place", "summary printed", "exit"]
    assert {"first receipt", "last receipt", "paths planned", "cloud written"} < {*steps}
    ends = [float(end) for _, _, end in rows]
    assert ends == sorted(ends) and ends[-1] <= wall_s + 0.1
    assert sum(float(takes) for _, takes, _ in rows) == pytest.approx(ends[-1], abs=0.1)
    text = page.read_text("utf-8")
    assert all(f"<td>{step}</td>" in text for step in steps)
    assert text.count("<rect") == len(steps)


def test_a_timeline_that_cannot_be_written_is_refused_at_once(tmp_path, lidarpool):
    outcome = lidarpool("run", "x.yaml", "--timeline", tmp_path / "missing" / "timeline.html")
    assert outcome.code == 2 and "Use another file or folder" in outcome.err

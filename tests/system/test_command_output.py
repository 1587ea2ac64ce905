"""What a run prints for machines, and where messages of libraries go."""

from __future__ import annotations

import json
import logging
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import lidarpool.cli.run_command
from lidarpool import read_cloud

SHORT = "sensor: {layers: 8}\nplanning: {trials: 4, iterations: 20}\n"


@pytest.fixture
def run(tmp_path, lidarpool, cluster, no_pictures) -> Callable[..., Any]:
    """Run a short scenario on the threads' cluster, into the folder `out`."""

    def run(*options: str) -> Any:
        (tmp_path / "s.yaml").write_text(SHORT)
        arguments = ["--out", tmp_path / "out", "--scheduler", cluster, *options]
        return lidarpool("run", tmp_path / "s.yaml", *arguments)

    return run


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


def test_a_run_that_hits_nothing_says_so(tmp_path, lidarpool, cluster, no_pictures):
    (tmp_path / "s.yaml").write_text(f"{SHORT}steps: 1\nposes: [[0, 0, 1000]]\n")
    place = ["--out", tmp_path / "out", "--scheduler", cluster, "--no-plan"]
    outcome = lidarpool("run", tmp_path / "s.yaml", *place)
    assert outcome.code == 0
    assert "no ray that was cast hit anything: look at poses" in outcome.out


def test_json_of_a_run_that_fails_is_nothing(run):
    outcome = run("--json", "--backend", "cuda")
    assert (outcome.code, outcome.out) == (2, "")
    assert outcome.err.splitlines()[-1].startswith("lidarpool: Backend 'cuda' cannot be used")


def test_warnings_of_libraries_are_not_on_the_terminal(run, monkeypatch):
    shown_progress = lidarpool.cli.run_command.shown_progress

    def warn(quiet: bool) -> Any:
        logging.getLogger("distributed.worker").warning("memory is nearly full")
        return shown_progress(quiet)

    monkeypatch.setattr(lidarpool.cli.run_command, "shown_progress", warn)
    outcome = run("--no-plan")
    assert outcome.code == 0
    assert "memory is nearly full" not in outcome.err + outcome.out


@pytest.mark.slow
def test_verbose_shows_what_driver_and_workers_log(tmp_path, lidarpool, no_pictures):
    (tmp_path / "s.yaml").write_text(SHORT)
    outcome = lidarpool("run", tmp_path / "s.yaml", "--out", tmp_path / "out", "-v", "-q")
    assert outcome.code == 0
    assert {"scheduler", "worker"} <= set(re.findall(r"distributed\.(\w+) - INFO", outcome.err))

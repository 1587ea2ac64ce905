"""`lidarpool run --live` as a script calls it: nobody looks, and nobody is waited for."""

import json
import re
import subprocess
import sys

import pytest

pytestmark = pytest.mark.slow

SCENARIO = "sensor: {rays_per_revolution: 100, layers: 8}\n"


def test_a_run_with_a_page_ends_by_itself_where_it_is_not_to_stay(tmp_path):
    (tmp_path / "small.yaml").write_text(SCENARIO)
    ended = subprocess.run(
        [
            sys.executable,
            "-m",
            "lidarpool",
            "run",
            "small.yaml",
            "--no-plan",
            "--live",
            "--no-stay",
        ],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=180,
    )
    assert ended.returncode == 0, ended.stderr
    assert re.search(r"live page: http://127\.0\.0\.1:\d+\n", ended.stderr)
    assert "stays" not in ended.stderr
    assert "viser" not in ended.stdout + ended.stderr
    assert (tmp_path / "lidarpool-out" / "cloud.ply").exists()


def test_two_runs_at_once_have_a_page_each_and_say_so_whoever_listens(tmp_path):
    (tmp_path / "small.yaml").write_text(SCENARIO)
    command = [sys.executable, "-m", "lidarpool", "run", "small.yaml", "--no-plan", "--live"]
    runs = [
        subprocess.Popen(
            [*command, "--no-stay", "--out", name, *options],
            cwd=tmp_path,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for name, options in (("one", ["--quiet", "--json"]), ("two", []))
    ]
    said = [run.communicate(timeout=240) for run in runs]
    assert [run.returncode for run in runs] == [0, 0], said
    ports = [re.search(r"^live page: http://127\.0\.0\.1:(\d+)$", err, re.M)[1] for _, err in said]
    assert ports[0] != ports[1]
    assert json.loads(said[0][0])["folder"] == "one"
    assert "results in two" in said[1][0]

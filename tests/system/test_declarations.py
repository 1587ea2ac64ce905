"""A quantity that is declared in one line is all there is to do for it."""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

import lidarpool

ROOT = Path(__file__).parents[2]
LINE = '    gain_db: Annotated[float, about("of the receiver", ge=0, le=9)] = 0.5\n'
SMALL = """
sensor: {{rays_per_revolution: 36, layers: 2}}
poses: [[0, 0, 1]]
steps: 6
noise: {{gain_db: {gain}}}
planning: {{enabled: false}}
pool: {{backend: numpy, gpu: 1, other: 1, collectors: 1}}
"""

Run = Callable[..., "subprocess.CompletedProcess[str]"]


@pytest.fixture(scope="module")
def python(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Run Python with a copy of the package in which `Noise` has one line more."""
    copy = tmp_path_factory.mktemp("declared") / "lidarpool"
    assert lidarpool.__file__
    shutil.copytree(
        Path(lidarpool.__file__).parent, copy, ignore=shutil.ignore_patterns("__pycache__")
    )
    noise = copy / "sensor" / "noise.py"
    before, seed, after = noise.read_text().partition("    seed: Annotated")
    noise.write_text(before + LINE + seed + after)
    roots = (copy.parent, ROOT / "kernels", ROOT / "scheduler", ROOT)
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(map(str, roots))}

    def run(*arguments: object) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, *map(str, arguments)],
            env=environment,
            cwd=copy.parent,
            capture_output=True,
            text=True,
            timeout=300,
        )

    return run


def test_it_is_in_the_template_and_in_the_schema(python, tmp_path):
    python("-m", "lidarpool", "init", tmp_path)
    (line,) = [
        one for one in (tmp_path / "scenario.yaml").read_text().splitlines() if "gain" in one
    ]
    assert line.split() == ["gain_db:", "0.5", "#", "of", "the", "receiver"]
    schema = json.loads((tmp_path / "scenario.schema.json").read_text())
    field = schema["$defs"]["NoiseSection"]["properties"]["gain_db"]
    assert (field["default"], field["minimum"], field["maximum"]) == (0.5, 0, 9)


def test_a_scenario_with_it_is_checked_run_and_reported(python, tmp_path):
    for gain in (2, 10):
        (tmp_path / f"{gain}.yaml").write_text(SMALL.format(gain=gain))
    wrong = python("-m", "lidarpool", "check", tmp_path / "10.yaml")
    assert wrong.returncode == 2 and "noise.gain_db is 10; " in wrong.stderr

    done = python("-m", "lidarpool", "run", tmp_path / "2.yaml", "--out", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["parameters"]["sensor"]["noise"]["gain_db"] == 2

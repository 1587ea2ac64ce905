"""What is compared between processes, so that the same run gives the same bytes."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from importlib.util import find_spec
from pathlib import Path

import pytest

from lidarpool.base.software import PACKAGES, difference, software, sources
from raybeam import available_backends

ASK = "from lidarpool.base.software import sources; print(sources())"


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    """The packages, copied to another place."""
    for package in PACKAGES:
        spec = find_spec(package)
        assert spec is not None and spec.submodule_search_locations
        shutil.copytree(spec.submodule_search_locations[0], tmp_path / package)
    return tmp_path


def asked(folder: Path) -> str:
    env = {**os.environ, "PYTHONPATH": os.pathsep.join([str(folder), *sys.path])}
    return subprocess.run(
        [sys.executable, "-c", ASK], env=env, check=True, capture_output=True, text=True
    ).stdout.strip()


def test_the_same_sources_in_another_place_are_the_same_and_one_letter_more_is_not(copy):
    ours = sources()
    assert asked(copy) == ours
    changed = copy / "raybeam" / "intersect.cu"
    changed.write_text(changed.read_text() + "\n")
    os.utime(changed, (0, 0))
    assert asked(copy) not in ("", ours)


def test_a_process_older_than_its_files_does_not_speak_for_them(copy):
    late = time.time() + 3600
    os.utime(copy / "lidarpool" / "simulator" / "returns.py", (late, late))
    assert asked(copy) == "changed since the process started"


def test_where_it_casts_the_instruction_sets_count():
    assert software().keys() == {"lidarpool"}
    for name, missing in available_backends().items():
        if not missing:
            here = software(name)
            assert here["backend"].startswith(name)
            assert " with " in here["numpy"]
    if not available_backends()["embree"]:
        assert "vectors of" in software("embree")["backend"]


def test_the_first_difference_is_named():
    here = software("numpy")
    assert difference(here, here) == ""
    there = here | {"numpy": "1.0 with nothing"}
    assert difference(there, here) == f"numpy 1.0 with nothing, the run numpy {here['numpy']}"
    assert difference({}, here).startswith("lidarpool not installed, the run lidarpool 0.")

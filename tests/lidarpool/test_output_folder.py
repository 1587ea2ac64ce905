"""The output folder of runs that begin and end in the same moment."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from lidarpool import LidarpoolError
from lidarpool.report.output import result_folder

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="has no locks on folders")


def assert_in_use(folder: Path) -> None:
    with pytest.raises(LidarpoolError, match="Another run is using"), result_folder(folder):
        pass


def test_a_run_that_is_refused_leaves_the_folder_that_another_has_just_made(tmp_path, monkeypatch):
    out, exists = tmp_path / "out", Path.exists
    with result_folder(out):
        looks = iter([False])  # it looked a moment before
        monkeypatch.setattr(
            Path, "exists", lambda path: next(looks, True) if path == out else exists(path)
        )
        assert_in_use(out)
        assert out.is_dir()


def test_a_folder_is_not_removed_when_another_run_may_use_it_already(tmp_path, monkeypatch):
    out, rmdir, removed = tmp_path / "out", Path.rmdir, []

    def claim_first(path: Path) -> None:
        assert_in_use(path)
        rmdir(path)
        removed.append(path)

    monkeypatch.setattr(Path, "rmdir", claim_first)
    with result_folder(out):
        pass
    assert removed == [out]


def test_a_folder_that_was_removed_before_it_could_be_locked_is_not_used(tmp_path, monkeypatch):
    out = tmp_path / "out"
    monkeypatch.setattr("lidarpool.report.output.fcntl.flock", lambda *_: out.rmdir())
    assert_in_use(out)
    assert not out.exists()

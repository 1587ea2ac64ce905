"""Targets of augmented copies, which are replaced when they are complete."""

from __future__ import annotations

import pytest

from lidarpool.augmentation.rewriting.data_set_copy import MARK_FILE, new_target


def write(target, text, *, is_folder):
    with new_target(target) as staged:
        assert staged.name == target.name and staged != target
        if is_folder:
            staged.mkdir()
            (staged / text).write_text(text)
        else:
            staged.write_text(text)


def content(target):
    if target.is_file():
        return target.read_text()
    return sorted(path.name for path in target.iterdir())


@pytest.mark.parametrize("was_folder", [True, False, None])
@pytest.mark.parametrize("is_folder", [True, False])
def test_files_and_folders_replace_each_other(tmp_path, was_folder, is_folder):
    target = tmp_path / "copy"
    if was_folder is not None:
        write(target, "old", is_folder=was_folder)
    write(target, "new", is_folder=is_folder)
    assert content(target) == (sorted([MARK_FILE, "new"]) if is_folder else "new")
    assert [path.name for path in tmp_path.iterdir()] == ["copy"]


@pytest.mark.parametrize("was_folder", [True, False])
def test_after_an_error_the_old_copy_remains(tmp_path, was_folder):
    target = tmp_path / "copy"
    write(target, "old", is_folder=was_folder)
    with pytest.raises(RuntimeError), new_target(target) as staged:
        staged.mkdir()
        raise RuntimeError
    assert content(target) == (sorted([MARK_FILE, "old"]) if was_folder else "old")
    assert [path.name for path in tmp_path.iterdir()] == ["copy"]

"""Results in remote storage, and files with several writers."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from functools import partial
from typing import NamedTuple

import pytest
from fsspec.implementations.memory import MemoryFileSystem
from tests.kills import KilledError

from lidarfiles.clouds.folder import output_destination
from lidarfiles.work import publishing
from lidarfiles.work.publishing import move_into_place
from lidarpool.report.result_files import REPORT, obsolete_files
from lidarsim.io.storage import Storage, replace_file, replacing_file, staging


class RemoteKills:
    """Raise KilledError instead of any change in memory storage after a number of changes."""

    def __init__(self, monkeypatch):
        self.left = None
        for name in ("put_file", "cp_file", "pipe_file", "rm", "rm_file"):
            monkeypatch.setattr(MemoryFileSystem, name, self.wrap(getattr(MemoryFileSystem, name)))

    def wrap(self, method):
        def change(*args, **kwargs):
            if self.left is not None:
                if self.left == 0:
                    raise KilledError
                self.left -= 1
            return method(*args, **kwargs)

        return change

    def is_killed(self, changes, call):
        self.left = changes
        try:
            call()
        except KilledError:
            return True
        finally:
            self.left = None
        return False


class Result(NamedTuple):
    """Files of an earlier and of a new result, and what marks a complete one."""

    files: dict[str, list[str]]
    last: str
    mark: str
    obsolete: Sequence[str] = ()


RUN = Result(
    {
        "earlier": ["cloud.ply", "path.png", "pcd/0.pcd", "pcd/1.pcd", "report.html", REPORT],
        "new": ["cloud.ply", "pcd/0.pcd", "report.html", REPORT],
    },
    REPORT,
    REPORT,
    obsolete_files(["cloud.ply", "pcd", "report.html", REPORT], ["cloud.ply", "path.png"]),
)
BAG = Result({"earlier": ["bag/0", "bag/1", "bag/2"], "new": ["bag/0", "bag/2"]}, "bag", "bag/0")
PLOT = Result(
    {"earlier": ["map.png", "path.png"], "new": ["map.png", "path.png"]}, *["map.png"] * 2
)


def publish(result, folder, storage, version):
    """Stage the files of a result in a local folder, and publish them."""
    with staging(folder) as staged:
        for name in result.files[version]:
            (staged / name).parent.mkdir(exist_ok=True)
            (staged / name).write_text(version)
        move_into_place(staged, storage, last=result.last, remove=result.obsolete)


def remote_contents(storage):
    return {name: storage.read(name).decode() for name in storage.tree()}


@pytest.mark.parametrize("result", [RUN, BAG, PLOT], ids=["run", "bag", "plot"])
def test_a_kill_while_a_result_goes_to_a_remote_storage(result, tmp_path, monkeypatch):
    kills = RemoteKills(monkeypatch)
    results = {version: dict.fromkeys(names, version) for version, names in result.files.items()}
    seen = []
    changes = 0
    killed = True
    while killed:
        storage = output_destination(f"memory://{tmp_path.name}-{changes}/out")
        storage.write("notes.txt", b"of the user")
        publish(result, tmp_path, storage, "earlier")
        killed = kills.is_killed(changes, partial(publish, result, tmp_path, storage, "new"))
        left = remote_contents(storage)
        assert left.pop("notes.txt") == "of the user"
        left = {name: text for name, text in left.items() if not name.startswith(".")}
        if result.mark in left:
            (version,) = [version for version, files in results.items() if files == left]
            seen.append(version)
        else:
            seen.append("incomplete")
        if left.get("report.html") == "new":
            assert {*left.values()} == {"new"}
        publish(result, tmp_path, storage, "new")
        assert remote_contents(storage) == results["new"] | {"notes.txt": "of the user"}
        changes += 1
    assert seen == sorted(seen, key=["earlier", "incomplete", "new"].index)
    assert len({*seen}) == 3


def test_an_upload_that_fails_leaves_the_earlier_result(tmp_path, monkeypatch):
    storage = output_destination(f"memory://{tmp_path.name}/out")
    publish(RUN, tmp_path, storage, "earlier")
    earlier = remote_contents(storage)

    def put_file(*_, **__):
        raise OSError("the quota is exceeded")

    with monkeypatch.context() as patch:
        patch.setattr(MemoryFileSystem, "put_file", put_file)
        with pytest.raises(OSError, match="quota"):
            publish(RUN, tmp_path, storage, "new")
    assert remote_contents(storage) == earlier


def test_a_storage_that_cannot_copy_gets_the_files_again(tmp_path, monkeypatch):
    def cp_file(*_, **__):
        raise NotImplementedError

    monkeypatch.setattr(MemoryFileSystem, "cp_file", cp_file)
    storage = output_destination(f"memory://{tmp_path.name}/out")
    publish(RUN, tmp_path, storage, "new")
    assert remote_contents(storage) == dict.fromkeys(RUN.files["new"], "new")


def test_writers_of_the_same_file_do_not_remove_the_files_of_each_other(tmp_path):
    path = tmp_path / "a.txt"
    target = tmp_path / "result"
    with ExitStack() as stack:
        first = stack.enter_context(replacing_file(path))
        first.write(b"first")
        staged = stack.enter_context(staging(tmp_path, final=target.name))
        replace_file(path, b"second")
        with publishing.publishing(target) as other:
            (other / target.name).write_text("second")
        Storage.at(tmp_path).remove_unfinished()
        assert path.read_bytes() == b"second" and target.read_text() == "second"
        assert staged.is_dir()
    assert path.read_bytes() == b"first"
    assert {entry.name for entry in tmp_path.iterdir()} == {"a.txt", "result"}


def test_what_killed_writers_of_other_files_have_left_stays(tmp_path):
    left = [".lidarpool-tmp-a.txt-01234567", ".lidarpool-writing-a.txt-01234567"]
    others = [
        ".lidarpool-tmp-b.txt-01234567", ".lidarpool-writing-b.txt-01234567",
        ".lidarpool-writing-01234567", ".lidarpool-tmp-a.txt", "a.txt-01234567",
    ]  # fmt: skip
    for name in (*left, *others):
        (tmp_path / name).write_text("half")
    replace_file(tmp_path / "a.txt", b"whole")
    assert {path.name for path in tmp_path.iterdir()} == {"a.txt", *others}


def publish_alone(target, text, *, is_folder):
    with publishing.publishing(target) as staged:
        new = staged / target.name
        if is_folder:
            new.mkdir()
            (new / text).write_text(text)
        else:
            new.write_text(text)


def content(target):
    if target.is_file():
        return target.read_text()
    return [path.name for path in target.iterdir()]


@pytest.mark.parametrize("was_folder", [True, False, None])
@pytest.mark.parametrize("is_folder", [True, False])
def test_files_and_folders_replace_each_other(tmp_path, was_folder, is_folder):
    target = tmp_path / "result"
    if was_folder is not None:
        publish_alone(target, "old", is_folder=was_folder)
    publish_alone(target, "new", is_folder=is_folder)
    assert content(target) == (["new"] if is_folder else "new")
    assert [path.name for path in tmp_path.iterdir()] == ["result"]


@pytest.mark.parametrize("was_folder", [True, False])
def test_after_an_error_the_earlier_result_remains(tmp_path, was_folder):
    target = tmp_path / "result"
    publish_alone(target, "old", is_folder=was_folder)
    with pytest.raises(RuntimeError), publishing.publishing(target) as staged:
        (staged / "result").mkdir()
        raise RuntimeError
    assert content(target) == (["old"] if was_folder else "old")
    assert [path.name for path in tmp_path.iterdir()] == ["result"]

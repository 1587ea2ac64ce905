"""Results that replace earlier ones: killed at each change on disk or in a remote storage."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import pytest
from fsspec.implementations.memory import MemoryFileSystem
from tests.kills import KilledError, is_killed

from lidarpool import Cloud, LidarError, save_cloud
from lidarpool.clouds.folder import output_destination
from lidarpool.comparing.comparison_files import write_comparison
from lidarpool.comparing.fit import charts, fitting
from lidarpool.report import result_pictures
from lidarpool.report.result_files import REPORT, obsolete_files
from lidarpool.work import publishing
from lidarpool.work.publishing import move_into_place
from lidarsim.errors import explain_os_errors
from lidarsim.io.storage import Storage, replace_file, replacing_file, staging


def compare(folder, version):
    picture = SimpleNamespace(png=lambda: version.encode())
    pages = {"map": picture} | ({"above": picture} if version == "earlier" else {})
    table = version if version == "earlier" else None
    write_comparison(folder, {"version": version}, version, pages, table)


def fit(folder, version):
    model = SimpleNamespace(model_dump=lambda **_: {"name": version})
    fitting.Fit({"version": version}, model).save(folder / "sensor.yaml")


def export(folder, version):
    x = {"earlier": 1.0, "new": 2.0}[version]
    cloud = Cloud(np.full((3, 3), x), {})
    save_cloud(cloud, folder / "cloud.ply")


def draw(folder, version):
    (folder / "report.html").exists() or (folder / "report.html").write_text("page")
    shown = SimpleNamespace(version=version)
    result_pictures.publish_pictures(shown, folder, folder, folder / "report.html")


def write(folder, version):
    with explain_os_errors("The file cannot be written"):
        replace_file(folder / "file", version.encode())


class Publisher(NamedTuple):
    """A function that writes a result to a folder, and the file that marks it as complete."""

    publish: Callable
    last: str
    others: tuple[str, ...] = ()


PUBLISHERS = {
    "compare": Publisher(compare, "compare.json", ("compare.html", "compare-map.png")),
    "fit": Publisher(fit, "sensor.yaml", ("sensor.html",)),
    "export": Publisher(export, "cloud.ply"),
    "plot": Publisher(draw, "map.png", ("path.png", "report.html")),
    "one file": Publisher(write, "file"),
}


@pytest.fixture
def _drawings(monkeypatch):
    """Pictures and pages that state their version."""

    def draw_pictures(shown, result, folder, *_):
        (folder / "report.html").write_text(f"page {shown.version}")
        paths = [folder / "path.png", folder / "map.png"]
        for path in paths:
            path.write_text(shown.version)
        return paths

    picture = SimpleNamespace(svg=lambda: "<svg/>")
    monkeypatch.setattr(result_pictures, "draw_pictures", draw_pictures)
    monkeypatch.setattr(charts, "draw_charts", lambda figures: picture)
    monkeypatch.setattr(
        fitting, "render_template", lambda *_, report, **__: f"page {report['version']}"
    )
    monkeypatch.setattr(fitting.Fit, "__repr__", lambda self: self.figures["version"])


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.usefixtures("_drawings")
@pytest.mark.parametrize("name", PUBLISHERS)
def test_a_killed_command_leaves_the_earlier_result_the_new_one_or_visibly_none(
    name, tmp_path, monkeypatch
):
    monkeypatch.setattr(os, "fsync", lambda _: None)  # a kill does not lose what was written
    publisher = PUBLISHERS[name]
    results = {}
    for version in ("earlier", "new"):
        folder = tmp_path / version
        folder.mkdir()
        publisher.publish(folder, version)
        results[version] = contents(folder)
        assert {*results[version]} >= {publisher.last, *publisher.others}
    assert {*results["new"]} == {publisher.last, *publisher.others}
    seen = set()
    changes = 0
    killed = True
    while killed:
        folder = tmp_path / str(changes)
        folder.mkdir()
        (folder / "notes.txt").write_text("of the user")
        publisher.publish(folder, "earlier")
        killed = is_killed(changes, folder, lambda: publisher.publish(folder, "new"))  # noqa: B023
        left = {p.name: p.read_bytes() for p in folder.iterdir() if not p.name.startswith(".")}
        assert left.pop("notes.txt") == b"of the user"
        if publisher.last in left:
            (version,) = [version for version, files in results.items() if files == left]
            seen.add(version)
        publisher.publish(folder, "new")  # removes what the killed command has left behind
        assert contents(folder) == results["new"] | {"notes.txt": b"of the user"}
        assert {path.name for path in folder.iterdir()} == {*results["new"], "notes.txt"}
        changes += 1
    assert seen == {"earlier", "new"} and changes > 2


@pytest.mark.usefixtures("_drawings")
@pytest.mark.parametrize("name", PUBLISHERS)
def test_a_full_disk_leaves_the_earlier_result(name, tmp_path, monkeypatch):
    publisher = PUBLISHERS[name]
    publisher.publish(tmp_path, "earlier")
    earlier = contents(tmp_path)

    def fsync(_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", fsync)
    with pytest.raises(LidarError, match="No space left") as info:
        publisher.publish(tmp_path, "new")
    assert ".lidarpool" not in str(info.value)
    assert contents(tmp_path) == earlier


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


RUNS = {
    "earlier": ["cloud.ply", "path.png", "pcd/0.pcd", "pcd/1.pcd", "report.html", REPORT],
    "new": ["cloud.ply", "pcd/0.pcd", "report.html", REPORT],
}
OBSOLETE = obsolete_files(["cloud.ply", "pcd", "report.html", REPORT], ["cloud.ply", "path.png"])


def publish_run(folder, storage, version):
    """Stage the files of a run in a local folder, and publish them."""
    with staging(folder) as staged:
        for name in RUNS[version]:
            (staged / name).parent.mkdir(exist_ok=True)
            (staged / name).write_text(version)
        move_into_place(staged, storage, last=REPORT, remove=OBSOLETE)


def remote_contents(storage):
    return {name: storage.read(name).decode() for name in storage.tree()}


def test_a_run_that_is_killed_while_its_result_goes_to_a_remote_storage(tmp_path, monkeypatch):
    kills = RemoteKills(monkeypatch)
    results = {version: dict.fromkeys(names, version) for version, names in RUNS.items()}
    seen = set()
    changes = 0
    killed = True
    while killed:
        storage = output_destination(f"memory://{tmp_path.name}-{changes}/out")
        storage.write("notes.txt", b"of the user")
        publish_run(tmp_path, storage, "earlier")
        killed = kills.is_killed(changes, partial(publish_run, tmp_path, storage, "new"))
        left = remote_contents(storage)
        assert left.pop("notes.txt") == "of the user"
        left = {name: text for name, text in left.items() if not name.startswith(".")}
        if REPORT in left:
            (version,) = [version for version, files in results.items() if files == left]
            seen.add(version)
        if left.get("report.html") == "new":
            assert {*left.values()} == {"new"}
        publish_run(tmp_path, storage, "new")
        assert remote_contents(storage) == results["new"] | {"notes.txt": "of the user"}
        changes += 1
    assert seen == {"earlier", "new"} and changes > 10


def test_an_upload_that_fails_leaves_the_earlier_result(tmp_path, monkeypatch):
    storage = output_destination(f"memory://{tmp_path.name}/out")
    publish_run(tmp_path, storage, "earlier")
    earlier = remote_contents(storage)

    def put_file(*_, **__):
        raise OSError("the quota is exceeded")

    with monkeypatch.context() as patch:
        patch.setattr(MemoryFileSystem, "put_file", put_file)
        with pytest.raises(OSError, match="quota"):
            publish_run(tmp_path, storage, "new")
    assert remote_contents(storage) == earlier


def test_a_storage_that_cannot_copy_gets_the_files_again(tmp_path, monkeypatch):
    def cp_file(*_, **__):
        raise NotImplementedError

    monkeypatch.setattr(MemoryFileSystem, "cp_file", cp_file)
    storage = output_destination(f"memory://{tmp_path.name}/out")
    publish_run(tmp_path, storage, "new")
    assert remote_contents(storage) == dict.fromkeys(RUNS["new"], "new")


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

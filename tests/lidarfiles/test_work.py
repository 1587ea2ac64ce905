"""Work that is continued after a kill, and results that are moved into place."""

from __future__ import annotations

import json
import os
import shutil
from dataclasses import dataclass

import numpy as np
import pytest
from tests.kills import is_killed

from lidarfiles.work import publishing
from lidarfiles.work.publishing import move_into_place
from lidarfiles.work.work import FOLDER, FileStep, Inputs, Step, Work, link_files
from lidarsim.errors import LidarError
from lidarsim.io.storage import Storage


@dataclass(frozen=True, eq=False)
class Squares:
    values: np.ndarray
    roots: np.ndarray | None = None


SQUARE = Step("square", (Squares, Squares))
TOTAL = Step("total", (Squares,))


def square(number):
    return Squares(np.array([number**2])), Squares(np.array([-number])) if number % 2 else None


class Sums:
    """Command that writes the squares of three numbers, times a factor, and their sum."""

    def __init__(self, target, source, calls=None):
        self.target = target
        self.source = source
        self.calls = [] if calls is None else calls

    def run(self, factor=1, *, resume=False, restart=False):
        def compute(number):
            self.calls.append(number)
            return square(number)

        inputs = Inputs({"numbers": self.source}, {"options": factor})
        with Work.open(self.target, inputs, noun="sum", resume=resume, restart=restart) as work:
            numbers = json.loads(self.source.read_text())
            parts = [int(part.values[0]) for part, _ in work.each(SQUARE, map, compute, numbers)]
            ((total,),) = [work.once(TOTAL, lambda: self.total(parts))]
            with work.publishing("index.json", remove=["old"]) as staged:
                (staged / "parts").mkdir()
                for number, part in enumerate(parts):
                    (staged / "parts" / f"{number}.txt").write_text(f"{factor * part}\n")
                (staged / "index.json").write_text(f"{factor * int(total.values[0])}\n")

    def total(self, parts):
        self.calls.append("total")
        return (Squares(np.array([sum(parts)])),)


@pytest.fixture
def sums(tmp_path):
    target = tmp_path / "out"
    target.mkdir()
    source = tmp_path / "numbers.json"
    source.write_text("[2, 3, 4]")
    return Sums(target, source)


def files(folder):
    return {
        path.relative_to(folder).as_posix(): path.read_text(errors="replace")
        for path in folder.rglob("*")
        if path.is_file()
    }


RESULT = {
    "parts/0.txt": "4\n", "parts/1.txt": "9\n", "parts/2.txt": "16\n", "index.json": "29\n",
}  # fmt: skip
TWICE = {
    "parts/0.txt": "8\n", "parts/1.txt": "18\n", "parts/2.txt": "32\n", "index.json": "58\n",
}  # fmt: skip


def test_a_result_is_written_without_what_was_kept_for_it(sums):
    sums.run()
    assert files(sums.target) == RESULT
    assert [path.name for path in sums.target.iterdir() if path.name.startswith(".")] == []


def test_wherever_it_is_killed_the_result_is_the_earlier_one_or_the_new_one_or_incomplete(
    sums, monkeypatch
):
    monkeypatch.setattr(publishing, "flush", lambda path: None)  # takes most of the time
    sums.run()
    (sums.target / "old").mkdir()
    (sums.target / "old" / "page.html").write_text("of the earlier result")
    (sums.target / "notes.txt").write_text("of the user")
    earlier = sums.target.parent / "earlier"
    shutil.copytree(sums.target, earlier)
    users = {"notes.txt": "of the user"}
    seen = set()
    for position in range(1000):
        shutil.rmtree(sums.target)
        shutil.copytree(earlier, sums.target)
        killed = is_killed(position, sums.target, lambda: sums.run(2))
        found = files(sums.target)
        shown = {name: text for name, text in found.items() if not name.startswith(FOLDER)}
        assert shown.items() >= users.items()
        if "index.json" not in shown:
            seen.add("incomplete")
        elif shown["index.json"] == "29\n":
            assert shown == files(earlier)
            seen.add("earlier")
        else:
            assert shown == TWICE | users
            seen.add("new")
        if not killed:
            break
        # A second kill while the work is continued.
        is_killed(position % 7, sums.target, lambda: sums.run(2, resume=True))
        sums.run(2, resume=True)
        assert files(sums.target) == TWICE | users
    assert seen == {"earlier", "incomplete", "new"} and position > 30


def test_finished_items_are_not_computed_again(sums):
    for position in range(1000):
        del sums.calls[:]
        killed = is_killed(position, sums.target, lambda: sums.run(restart=True))
        if killed and sums.calls == [2, 3]:
            break
    sums.run(resume=True)
    assert sums.calls.count(2) == 1 and sums.calls[-2:] == [4, "total"]
    assert files(sums.target) == RESULT


DAMAGES = {
    "empty": lambda content: b"",
    "cut off": lambda content: content[: len(content) // 2],
    "changed": lambda content: content.replace(np.int64(9).tobytes(), np.int64(8).tobytes()),
    "no archive": lambda content: b"no archive",
}


@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES)
@pytest.mark.parametrize("file", ["square/000001/0.npz", "square/000001/item.json"])
def test_damaged_items_are_computed_again(damage, file, sums, monkeypatch):
    interrupt(sums, monkeypatch)
    path = sums.target / FOLDER / file
    content = path.read_bytes()
    path.write_bytes(damage(content))
    del sums.calls[:]
    sums.run(resume=True)
    assert sums.calls == ([3, "total"] if damage(content) != content else ["total"])
    assert files(sums.target) == RESULT


def interrupt(sums, monkeypatch, error=KeyboardInterrupt, **options):
    """Run until the sum is computed, and return the exception."""
    with monkeypatch.context() as patches:

        def fail(self, parts):
            raise error

        patches.setattr(Sums, "total", fail)
        with pytest.raises(error if isinstance(error, type) else type(error)) as raised:
            sums.run(**options)
    return raised.value


def test_every_failure_states_how_to_continue(sums, monkeypatch):
    for error in (KeyboardInterrupt(), OSError(28, "No space left"), ValueError("odd")):
        raised = interrupt(sums, monkeypatch, error, restart=True)
        assert raised.__notes__ == [
            f"The finished steps are stored in {sums.target}. Continue with `--resume`."
        ]


def test_nothing_is_kept_if_no_item_is_finished(sums):
    sums.source.write_text("[")
    with pytest.raises(json.JSONDecodeError) as raised:
        sums.run()
    assert not hasattr(raised.value, "__notes__")
    assert files(sums.target) == {}


def test_unfinished_work_is_continued_or_removed_only_if_asked(sums, monkeypatch):
    interrupt(sums, monkeypatch)
    with pytest.raises(LidarError, match=r"contains an unfinished sum\. Continue it with"):
        sums.run()
    with pytest.raises(LidarError, match=r"an unfinished sum with different inputs \(options\)"):
        sums.run(2, resume=True)
    del sums.calls[:]
    sums.run(2, restart=True)
    assert sums.calls == [2, 3, 4, "total"]
    assert files(sums.target) == TWICE


def test_changed_inputs_are_named(sums, monkeypatch):
    interrupt(sums, monkeypatch)
    sums.source.write_text("[2, 3, 5]")
    with pytest.raises(LidarError, match=r"different inputs \(numbers\)\. Repeat the original"):
        sums.run(resume=True)


def test_files_in_linked_folders_are_inputs(tmp_path):
    data = tmp_path / "data" / "sweeps"
    data.mkdir(parents=True)
    (data / "1.pcd").write_text("points")
    recording = tmp_path / "recording"
    recording.mkdir()
    (recording / "sweeps").symlink_to(data)
    (recording / "round").symlink_to(recording)
    first = Inputs({"recording": recording}, {}).identity()
    assert Inputs({"recording": recording}, {}).identity() == first
    (data / "1.pcd").write_text("more points")
    assert Inputs({"recording": recording}, {}).identity() != first


@pytest.mark.parametrize("is_accessible", [True, False])
@pytest.mark.parametrize(("chunk", "sizes"), [(1, [1] * 5), (2, [2, 2, 1]), (9, [5])])
def test_processes_store_results_if_they_can(chunk, sizes, is_accessible, tmp_path, monkeypatch):
    returned = []

    def run(function, tasks):
        for task in tasks:
            returned.append(function(task))
            yield returned[-1]

    if not is_accessible:
        monkeypatch.setattr(Storage, "has_content", lambda *arguments: False)
    with Work.open(tmp_path, Inputs({}, {"options": 1}), noun="sum") as work:
        parts = work.each(SQUARE, run, square, range(5), chunk=chunk)
        assert [int(part.values[0]) for part, _ in parts] == [0, 1, 4, 9, 16]
    assert [len(results) for results in returned] == sizes
    are_returned = [result is not None for results in returned for result in results]
    assert are_returned == [not is_accessible] * 5


def test_files_are_stored_under_their_keys(tmp_path):
    step = FileStep("encode")
    calls = []

    def encode(name):
        calls.append(name)
        return {f"sweeps/{name}.bin": name.encode(), "details": b"{}"}

    with Work.open(tmp_path, Inputs({}, {"options": 1}), noun="sum") as work:
        keys = ["0/a", "0/b", "1/a"]
        stored = [*work.each(step, map, encode, ["x", "y", "z"], keys)]
        folder = tmp_path / FOLDER / "encode"
        assert work.folder(step) == folder
        assert [*stored[1]] == ["sweeps/y.bin", "details"]
        assert stored[1]["sweeps/y.bin"] == folder / "0" / "b" / "sweeps" / "y.bin"
        assert (work.count(step, keys), work.count(step, keys[1:])) == (3, 2)
        stored[0]["details"].write_bytes(b"[]")  # damaged
        assert work.find(step, "0/a") is None
        assert [*work.each(step, map, encode, ["x", "y", "z"], keys)] == stored
        assert calls == ["x", "y", "z", "x"]
        assert stored[0]["details"].read_bytes() == b"{}"
        work.forget(step, "0")
        assert work.count(step, keys) == 1
        assert [path.name for path in folder.iterdir()] == ["1"]


def test_inputs_that_change_during_the_work_are_refused_before_anything_is_published(
    sums, monkeypatch
):
    def change(self, parts):
        self.source.write_text("[2, 3, 4, 5]")
        return (Squares(np.array([0])),)

    monkeypatch.setattr(Sums, "total", change)
    with pytest.raises(LidarError, match=r"numbers\.json has changed since the sum began"):
        sums.run()
    assert not (sums.target / "index.json").exists()


@pytest.mark.parametrize("content", [b"", b"{", b"\xff", b"[3]"])
def test_a_damaged_manifest_is_refused(content, sums, monkeypatch):
    interrupt(sums, monkeypatch)
    (sums.target / FOLDER / "manifest.json").write_bytes(content)
    with pytest.raises(LidarError, match=r"manifest\.json is damaged\. Remove the unfinished sum"):
        sums.run(resume=True)
    sums.run(restart=True)
    assert files(sums.target) == RESULT


def test_a_link_instead_of_the_folder_of_the_work_is_not_followed(sums, tmp_path):
    other = tmp_path / "other"
    other.mkdir()
    (other / "manifest.json").write_text("of another program")
    (sums.target / FOLDER).symlink_to(other)
    with pytest.raises(LidarError, match="is a symbolic link"):
        sums.run(restart=True)
    assert files(other) == {"manifest.json": "of another program"}


def test_a_record_is_loaded_alone(sums, monkeypatch, tmp_path):
    inputs = Inputs({}, {"options": 1})
    with Work.open(tmp_path, inputs, noun="sum") as work:
        assert len(list(work.each(SQUARE, map, square, [5, 6]))) == 2
        assert work.load(SQUARE, 0, 1).values.tolist() == [-5]
        assert work.load(SQUARE, 1, 1) is None and work.load(SQUARE, 1, 0).roots is None
        (tmp_path / FOLDER / "square" / "000001" / "0.npz").write_bytes(b"PK")
        with pytest.raises(LidarError, match="square/000001 is damaged"):
            work.load(SQUARE, 1, 0)


def test_numbers_and_strings_of_records_keep_their_types(tmp_path):
    @dataclass(frozen=True)
    class Statistics:
        count: int
        share: float
        source: str

    stated = Statistics(3, 0.1, "a cloud")
    with Work.open(tmp_path, Inputs({}, {}), noun="sum") as work:
        (loaded,) = work.once(Step("statistics", (Statistics,)), lambda: (stated,))
    assert loaded == stated
    assert [type(value) for value in vars(loaded).values()] == [int, float, str]


def test_files_of_items_are_stored_under_their_keys_and_linked(tmp_path):
    def contents(number):
        computed.append(number)
        return {f"sub/{number}.bin": bytes([number]), "all.txt": b"all"}

    step = FileStep("files")
    computed = []
    target, staged = tmp_path / "out", tmp_path / "staged"
    with Work.open(target, Inputs({}, {}), noun="sum") as work:
        keys = ["three", "four"]
        for found in work.each(step, map, contents, [3, 4], keys):
            link_files(found, staged)
        assert (staged / "sub/4.bin").read_bytes() == b"\4"
        assert sorted(files(staged)) == ["all.txt", "sub/3.bin", "sub/4.bin"]
        (target / FOLDER / "files/four/sub/4.bin").write_bytes(b"\5")
        four, three = work.each(step, map, contents, [4, 3], keys[::-1])
        assert [*four] == ["sub/4.bin", "all.txt"] and three["sub/3.bin"].read_bytes() == b"\3"
        assert four["sub/4.bin"].read_bytes() == b"\4"
    assert computed == [3, 4, 4]


def test_merged_folders_keep_the_files_of_others(tmp_path):
    target, staged = tmp_path / "out", tmp_path / "staged"
    for folder in (target / "a" / "theirs", target / "a" / "old", staged / "a" / "new"):
        folder.mkdir(parents=True)
        (folder / "1").write_text(folder.name)
    (target / "a" / "2").write_text("earlier")
    (staged / "a" / "2").write_text("new")
    (staged / "last").write_text("new")
    move_into_place(staged, target, last="last", remove=["a/old/1", "a/none/1"], merge=True)
    assert files(target) == {"a/theirs/1": "theirs", "a/new/1": "new", "a/2": "new", "last": "new"}
    assert not (target / "a/old").exists()


def test_links_in_merged_folders_are_not_followed(tmp_path):
    target, staged, other = (tmp_path / name for name in ("out", "staged", "other"))
    for folder in (target, other, staged / "a"):
        folder.mkdir(parents=True)
    (target / "a").symlink_to(other)
    (staged / "a" / "1").write_text("new")
    (staged / "last").write_text("new")
    with pytest.raises(LidarError, match="is a symbolic link"):
        move_into_place(staged, target, last="last", merge=True)
    assert files(other) == {}


def test_files_and_folders_replace_those_with_the_same_names(tmp_path):
    target, staged = tmp_path / "out", tmp_path / "staged"
    for folder in (target / "cloud", staged / "page"):
        folder.mkdir(parents=True)
    (target / "cloud" / "1.pcd").write_text("earlier")
    (target / "page").write_text("earlier")
    (target / "last").write_text("earlier")
    (staged / "cloud").write_text("new")
    (staged / "page" / "1.html").write_text("new")
    (staged / "last").write_text("new")
    move_into_place(staged, target, last="last")
    assert files(target) == {"cloud": "new", "page/1.html": "new", "last": "new"}


def test_items_are_not_flushed_to_the_disk_because_their_checksums_are_compared(
    tmp_path, monkeypatch
):
    flushed = []
    monkeypatch.setattr(os, "fsync", flushed.append)
    with Work.open(tmp_path, Inputs({}, {"options": 1}), noun="sum") as work:
        assert len(list(work.each(SQUARE, map, square, [5, 6]))) == 2
        assert not flushed
        with work.publishing("last") as staged:
            (staged / "last").write_text("new")
        assert flushed

"""Where parts are: a folder, or what fsspec opens; a file is there whole or not at all."""

from __future__ import annotations

import errno
import io
import os
import pickle
import re
import sys
import threading
import zipfile
from dataclasses import replace

import numpy as np
import pytest

from lidarsim import LidarError
from lidarsim.io import allowance
from lidarsim.io.archives import open_archive
from lidarsim.io.storage import Storage
from lidarsim.sweeps.sweeps import Sweeps


@pytest.fixture(params=["folder", "memory"])
def storage(request, tmp_path):
    if request.param == "folder":
        place = Storage.at(tmp_path / "a" / "b")
    else:
        place = Storage.at(f"memory://{request.node.name}-{tmp_path.name}/b/")
    yield place
    place.remove(list(place.sizes()))


def test_files_come_and_go(storage):
    assert storage.sizes() == {}
    storage.prepare()
    storage.prepare()
    assert storage.sizes() == {}
    storage.write("one", b"12345")
    storage.write("two", [b"ab", memoryview(b"c"), bytearray(b"d"), b""])
    storage.write("none", b"")
    assert storage.sizes() == {"one": 5, "two": 4, "none": 0}
    assert storage.read("two") == b"abcd"
    storage.write("one", b"another")
    assert storage.read("one") == b"another"
    storage.remove(["one", "none", "never there"])
    assert storage.sizes() == {"two": 4}
    assert storage.path("two").endswith("/b/two")


def test_another_process_may_see_the_same_place(storage):
    storage.prepare()
    storage.write("here", b"token")
    there = pickle.loads(pickle.dumps(storage))
    assert there == storage and len(pickle.dumps(storage)) < 500
    assert there.has_content("here", b"token")
    assert not there.has_content("here", b"another")
    assert not there.has_content("gone", b"token")
    assert not Storage("nonsense://a/b").has_content("here", b"token")


def test_a_file_is_whole_or_not_there(storage):
    """As long as it is written, nothing of it is seen under its name."""
    storage.prepare()
    seen = set()
    done = threading.Event()

    def look():
        while not done.is_set():
            seen.update((n, s) for n, s in storage.sizes().items() if n.endswith(".npz"))

    watcher = threading.Thread(target=look)
    watcher.start()
    try:
        for number in range(30):
            storage.write(f"{number}.npz", [b"x" * 10_000] * 10)
    finally:
        done.set()
        watcher.join()
    assert {size for _, size in seen} <= {100_000}
    assert storage.sizes() == {f"{number}.npz": 100_000 for number in range(30)}


def test_a_write_that_fails_leaves_nothing(tmp_path):
    storage = Storage.at(tmp_path)
    storage.write("a", b"before")
    with pytest.raises(TypeError):
        storage.write("a", [b"half", "no bytes"])
    assert storage.read("a") == b"before"
    assert [path.name for path in tmp_path.iterdir()] == ["a"]


def test_only_files_of_killed_writers_are_tidied_away(tmp_path):
    outside = tmp_path / "outside"
    folder = tmp_path / "folder"
    left = ".lidarpool-tmp-a.bin-0a1b2c3d"
    theirs = [".tmp-a.bin", ".lidarpool-tmp-notes", f"{left}.bak", "a.bin"]
    for place in (outside, folder / "in"):
        place.mkdir(parents=True)
        for name in (left, *theirs):
            (place / name).write_text("x")
    (folder / "link").symlink_to(outside)
    Storage.at(folder).remove_unfinished()
    assert {path.name for path in (folder / "in").iterdir()} == {*theirs}
    assert {path.name for path in outside.iterdir()} == {left, *theirs}


def test_links_and_folders_are_no_files(tmp_path):
    (tmp_path / "file").write_text("12")
    (tmp_path / "folder").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "file")
    storage = Storage.at(tmp_path)
    assert storage.sizes() == {"file": 2}
    assert storage.entries() == {"file": 2, "folder": None, "link": None}


USES = {
    "below": lambda s: s.below("link"),
    "prepare": lambda s: s.prepare("link/in"),
    "write": lambda s: s.write("link/file", b"x"),
    "writing": lambda s: s.writing("link/file").__enter__(),
    "read": lambda s: s.read("link/file"),
    "entries": lambda s: replace(s, url=f"{s.url}/link").entries(),
    "remove": lambda s: s.remove(["link/file"]),
    "discard": lambda s: s.discard("link/in"),
    "prune": lambda s: s.prune(["link/file"]),
    "tree": lambda s: s.tree("link"),
}


@pytest.mark.parametrize("use", [*USES])
def test_nothing_goes_through_a_link_below_the_named_folder(use, tmp_path):
    named = tmp_path / "named"
    theirs = tmp_path / "theirs"
    (theirs / "in").mkdir(parents=True)
    (theirs / "file").write_text("12")
    (tmp_path / "out").mkdir()
    named.symlink_to(tmp_path / "out")
    (named / "link").symlink_to(theirs)
    for storage in (Storage.at(named), pickle.loads(pickle.dumps(Storage.at(named)))):
        with pytest.raises(LidarError, match=f"{named}/link is a symbolic link, but links in"):
            USES[use](storage)
    assert {path.name for path in theirs.iterdir()} == {"in", "file"}
    Storage.at(named).discard("link")
    assert [*named.iterdir()] == [] and (theirs / "file").read_text() == "12"


@pytest.mark.parametrize("url", ["nonsense://a/b", "gs://bucket/folder"])
def test_a_storage_whose_library_is_missing_says_so(url, monkeypatch):
    monkeypatch.setitem(sys.modules, "gcsfs", None)
    for use in (Storage.prepare, Storage.sizes, lambda s: s.read("a"), lambda s: s.write("a", b"")):
        with pytest.raises(LidarError, match=f"{url} cannot be opened: .*[^.][.]$"):
            use(Storage.at(url))


@pytest.mark.parametrize("url", ["s3://", "file:///"])
def test_a_scheme_alone_is_no_folder(url):
    with pytest.raises(LidarError, match=r"does not name a folder. Add one"):
        Storage.at(url)


ARRAYS = {
    "number": np.float64(3.5),
    "yes": np.bool_(True),
    "none": np.zeros((0, 3), np.float32),
    "turned": np.arange(24, dtype=">i2").reshape(2, 3, 4).T,
    "rows": np.arange(6, dtype=np.uint8).reshape(3, 2),
    "bytes": np.array([b"ab\0", b"cde"]).view("V3"),
}


def packed(arrays, method=zipfile.ZIP_DEFLATED):
    memory = io.BytesIO()
    with zipfile.ZipFile(memory, "w", method) as archive:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w") as file:
                np.save(file, array) if isinstance(array, np.ndarray) else file.write(array)
    return memory.getvalue()


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_arrays_are_those_that_numpy_reads(tmp_path, monkeypatch, save):
    save(tmp_path / "a.npz", **ARRAYS)
    (tmp_path / "b.npz").write_bytes((tmp_path / "a.npz").read_bytes())
    with np.load(tmp_path / "a.npz") as archive:
        plain = dict(archive)

    def fail(*_):
        raise SystemError("AST constructor recursion depth mismatch (before=45, after=42)")

    monkeypatch.setattr("ast.literal_eval", fail)
    with pytest.raises(SystemError):
        np.load(tmp_path / "b.npz")["rows"]
    with open_archive(tmp_path / "b.npz") as arrays:
        assert [*arrays] == [*ARRAYS]
        for name, array in arrays.items():
            assert (array.dtype, array.shape) == (plain[name].dtype, plain[name].shape)
            assert array.tobytes() == plain[name].tobytes() and array.flags.writeable
            assert array.flags.f_contiguous == plain[name].flags.f_contiguous


SIZE = (2**24).to_bytes(4, "little")


def header(shape):
    head = io.BytesIO()
    told = {"descr": "<f8", "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(head, told)
    return head.getvalue()


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (
            packed({"x": header((400_000_000,)) + bytes(9)}),
            "the size of x.npy does not match its header",
        ),
        (packed({f"x{k}": np.zeros(2**16 - 16) for k in range(4)}), "unpack to at least 2.00 MiB"),
        (packed({"x": header((1,)) + bytes(2**24)}), "would unpack to at least 16.00 MiB"),
        (packed({"x": bytes(2**24)}).replace(SIZE, bytes(4)), "x.npy is damaged"),
        (packed({"x": np.zeros(9)}, zipfile.ZIP_LZMA), "a compression method other than Deflate"),
        (packed({"x": np.array([{}])}), "x.npy is not an array of numbers"),
        (packed({"x": b"none"}), "x.npy is not an array of numbers"),
        (packed(ARRAYS)[:-9], "damaged or was written by a different version"),
        (b"", "damaged or was written by a different version"),
    ],
    ids=range(9),
)
def test_others_are_refused_in_a_line(tmp_path, monkeypatch, data, words):
    monkeypatch.setattr(allowance, "MIN_LIMIT_BYTES", 2**20)
    path = tmp_path / "0000.npz"
    path.write_bytes(data)
    for read in (None, path.read_bytes):
        with pytest.raises(LidarError, match=words) as told:
            Sweeps.load(path, read)
        assert re.match(rf"{path}\b[^\n]*\.$", str(told.value))


def test_a_range_of_a_file_is_read(tmp_path):
    for storage in (Storage.at(tmp_path), Storage.at(tmp_path.as_uri())):
        storage.write("x", b"0123456789")
        assert (storage.read("x"), storage.read("x", 3, 6)) == (b"0123456789", b"345")
        assert (storage.read("x", 8, 20), storage.read("x", 0, 2)) == (b"89", b"01")


@pytest.mark.parametrize("places", [("here", "there"), ("memory", "memory"), ("memory", "here")])
def test_a_file_of_another_storage_is_taken_or_copied(places, tmp_path, monkeypatch):
    urls = [f"memory://{n}-{tmp_path.name}" if one == "memory" else tmp_path / one
            for n, one in enumerate(places)]  # fmt: skip
    source, target = map(Storage.at, urls)
    for place in (source, target):
        place.prepare()
    source.write("a", b"new")
    target.write("b", b"of before")
    if places[0] != "memory" or places[1] == "memory":  # by a link, and by the store itself
        monkeypatch.setattr(Storage, "writing", None)
    for _ in range(2):
        target.copy_from(source, "a", "b")
        assert target.read("b") == b"new" and source.read("a") == b"new"
    with pytest.raises(FileNotFoundError):
        target.copy_from(source, "c", "c")


def test_a_file_is_copied_where_there_are_no_links(tmp_path, monkeypatch):
    source = Storage.at(tmp_path)
    target = Storage.at(tmp_path / "there")
    source.write("a", b"new")
    target.prepare()

    def link(*_):
        raise OSError(errno.EXDEV, "another disk")

    monkeypatch.setattr(os, "link", link)
    target.copy_from(source, "a", "a")
    assert target.read("a") == b"new" and target.local("a").stat().st_nlink == 1
    (tmp_path / "link").symlink_to(tmp_path / "a")
    with pytest.raises(LidarError, match="link is a symbolic link"):
        target.copy_from(source, "link", "link")

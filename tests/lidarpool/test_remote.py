"""A run in storage: it goes on from the last copy of its database, by one driver at a time."""

from __future__ import annotations

import pytest
from tests.lidarpool.test_store import OTHERS, add, left, opened

import lidarpool.run.remote
from lidarpool import LidarpoolError, remove_run
from lidarpool.base.storage import Storage
from lidarpool.columns.parts import mark_name


@pytest.fixture
def url(tmp_path, monkeypatch):
    """URL of a run whose driver has no folder that stays."""
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    return f"memory://{tmp_path.name}/run"


@pytest.fixture
def unfinished(url):
    """URL of a run whose driver died when two of six scans were in the copy of its database."""
    store = opened(url)
    store.cast_with("numpy", {})
    add(store, 0, 2)
    store.save(now=True)
    add(store, 3, 5)
    store.db.close()
    return url


def test_it_goes_on_from_the_last_copy(unfinished):
    store = opened(unfinished, resume=True)
    assert (store.only.resumed, store.backend, store.notes) == (4, "numpy", [])
    assert store.only.parts.missing(0, 6) == [(2, 3), (5, 6)], "parts say what is not in the copy"
    assert add(store, 2, 3) and add(store, 5, 6)
    store.only.parts.frames = 6
    store.save(now=True)
    store.tidy()
    mark = mark_name(store.db.meta["mark"])
    assert left(unfinished) == {"run.db", "run.owner", mark, *store.only.points().names}
    again = opened(unfinished, resume=True)
    assert again.notes == [] and again.only.complete and len(again.only.points().load()) == 18
    again.remove()
    assert left(unfinished) == set()


def test_it_is_refused_or_dropped(unfinished):
    kept = f"{unfinished} holds an unfinished run, 2 of 6 scans: continue it with --resume"
    with pytest.raises(LidarpoolError, match=kept):
        opened(unfinished)
    with pytest.raises(LidarpoolError, match=f"{unfinished} cannot be continued, .* another scene"):
        opened(unfinished, resume=True, job=OTHERS["scene"])
    remove_run(unfinished)
    remove_run(unfinished)
    assert left(unfinished) == set()
    assert opened(unfinished, job=OTHERS["scene"]).only.resumed == 0


def test_foreign_objects_stay(unfinished):
    parts = Storage.at(f"{unfinished}/parts")
    foreign = {"a.npz", "arch.npz.bak", ".tmp-5.npz-1a2b"}
    for name in foreign:
        parts.write(name, b"mine")
    Storage.at(f"{parts}/deeper").write("a.npz", b"mine")
    remove_run(unfinished)
    assert left(unfinished) == foreign
    assert Storage.at(f"{parts}/deeper").sizes() == {"a.npz": 4}


def test_one_of_another_format(unfinished, monkeypatch):
    monkeypatch.setattr("lidarpool.pipeline.database.FORMAT", 99)
    with pytest.raises(LidarpoolError, match=rf"^{unfinished}/run.db is damaged \(it is of format"):
        opened(unfinished)


def test_copies_are_made_now_and_then(url, monkeypatch):
    store = opened(url)
    first = Storage.at(url).read("run.db")
    add(store, 0, 2)
    store.save()
    assert Storage.at(url).read("run.db") == first
    monkeypatch.setattr(store._remote, "_due", 0.0)
    store.save()
    assert Storage.at(url).read("run.db") != first


@pytest.mark.parametrize("how", ["resumed", "dropped"])
def test_a_run_that_is_taken_over_ends_and_leaves_all_to_the_other(how, url):
    early = opened(url)
    add(early, 0, 2)
    early.save(now=True)
    if how == "dropped":
        remove_run(url)
    late = opened(url, resume=True)
    add(late, 2, 6)
    late.save(now=True)
    before = left(url)
    with (
        pytest.raises(LidarpoolError, match=f"taken over or deleted {url}") as caught,
        early.kept_on_error(),
    ):
        early.save(now=True)
    assert not hasattr(caught.value, "__notes__")
    assert left(url) == before
    late.save(now=True)
    again = opened(url, resume=True)
    assert again.only.resumed == (6 if how == "resumed" else 4)
    with pytest.raises(LidarpoolError, match="this one has ended"), late.kept_on_error():
        late.remove()
    assert left(url) == before


def test_storage_that_fails(url, monkeypatch):
    store = opened(url)

    def fail(*_):
        raise OSError("it is full")

    monkeypatch.setattr(lidarpool.run.remote.Storage, "write", fail)
    with pytest.raises(LidarpoolError, match=f"cannot be kept in {url}: it is full"):
        store.save(now=True)
    with pytest.raises(LidarpoolError, match=rf"Cannot write to {url} \(it is full\)"):
        opened(url, resume=True)

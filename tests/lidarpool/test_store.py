"""What a run keeps in its folder, and under which terms a later run goes on from it."""

from __future__ import annotations

import gc
from dataclasses import replace

import numpy as np
import pytest
from tests.lidarpool.committing import commit

import lidarpool.run.store
from lidarpool import LidarpoolError, Planning, Scene, Sensor, Survey, remove_run
from lidarpool.plan import run_trial
from lidarpool.run.identity import identity_of
from lidarpool.run.job import Job
from lidarpool.run.store import RunStore
from lidarpool.scene.shapes import seed_objects

SCENE = Scene.from_meshes(seed_objects(rings=4, segments=6))
SURVEY = Survey(Sensor.grid(layers=2), poses=[(0, 0, 1)], steps=6, columns=["time"])
PLANNING = Planning((0, 0), (9, 1), [(5, 0)], 1.0, trials=2, particles=10, iterations=5)
JOB = Job(SCENE, SURVEY)


def add(store, first, stop, number=0):
    """Commit a part of scans with three points of each."""
    return commit(store, first, [3] * (stop - first), [first, stop], [1, 2], number)


def names(folder):
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


@pytest.fixture
def folder(tmp_path):
    return tmp_path / "run"


@pytest.fixture
def unfinished(folder):
    """A folder in which a run has left four of six scans."""
    store = RunStore(JOB, folder)
    store.backend = "numpy"
    add(store, 0, 2)
    add(store, 3, 5)
    store.db.close()
    return folder


def test_a_run_from_its_beginning_to_its_end(folder):
    store = RunStore(JOB, folder)
    assert (store.kept, store.complete, store.resumed) == ("", False, 0)
    add(store, 2, 6)
    assert store.kept == "4 of 6 scans" and store.progress().points == 12
    add(store, 0, 2)
    store.db.frames = 6
    assert store.complete
    cloud = store.points().load()
    assert cloud.scan.tolist() == np.repeat(np.arange(6), 3).tolist()
    assert len(store.points()) == 18 == store.db.point_count
    for scan in range(6):
        points = store.points_of_scan(scan)
        assert set(points.scan) == {scan} and "time" in points.columns
        assert np.array_equal(points.positions, cloud.positions[3 * scan : 3 * scan + 3])
    hits = store.hit_counts()
    assert hits.shape == (len(SCENE.faces),)
    assert hits[[0, 2, 6]].tolist() == [1, 3, 2] and hits.sum() == 6
    rays = store.sample_rays()
    assert rays.shape[1:] == (2, 3) and set(rays[:, 1, 0]) == {0, 2}
    assert set(map(tuple, rays[:, 0].tolist())) == {(0, 0, 1)}
    store.storage.write("stray.npz", b"of a collector that died")
    store.tidy()
    assert store.storage.sizes().keys() == {"0-0.npz", "2-0.npz"}
    store.remove()
    assert not folder.exists()


def test_without_a_folder_all_goes_with_the_last_user_of_the_points():
    store = RunStore(JOB)
    add(store, 0, 6)
    points, folder = store.points(), store.place
    del store
    gc.collect()
    assert len(points.load()) == 18
    del points
    gc.collect()
    assert not folder.exists()


def test_it_is_gone_on_with(unfinished):
    again = replace(JOB, backend="auto", collectors=5, queue_capacity=3, patience_s=1.0)
    store = RunStore(again, unfinished, resume=True)
    assert (store.resumed, store.backend, store.notes) == (4, "numpy", [])
    assert store.db.missing(0, 6) == [(2, 3), (5, 6)]
    assert "were cast with it" in store.advice
    store.db.close()
    with pytest.raises(LidarpoolError, match=r"'embree' is asked for, .* cast with 'numpy'"):
        RunStore(replace(JOB, backend="embree"), unfinished, resume=True)


OTHERS = {
    "survey": replace(JOB, survey=replace(SURVEY, keep_every=2)),
    "scene": replace(JOB, scene=Scene.from_meshes(seed_objects(rings=4, segments=7))),
    "planning": replace(JOB, planning=PLANNING),
}


@pytest.mark.parametrize("other", OTHERS)
def test_another_run_cannot_go_on(other, unfinished):
    for resume in (True, False):
        with pytest.raises(LidarpoolError, match=f"cannot be continued, it is of another {other}"):
            RunStore(OTHERS[other], unfinished, resume=resume)
    remove_run(unfinished)
    RunStore(OTHERS[other], unfinished).db.close()


def test_another_version_cannot_go_on(unfinished, monkeypatch):
    later = identity_of(JOB) | {"numpy": "99.0"}
    monkeypatch.setattr(lidarpool.run.store, "identity_of", lambda job: later)
    with pytest.raises(LidarpoolError, match=r"it was written with numpy 2\S+, here it is 99\.0"):
        RunStore(JOB, unfinished, resume=True)


def test_a_run_that_has_kept_nothing_is_in_nobodys_way(folder):
    RunStore(JOB, folder).db.close()
    store = RunStore(OTHERS["scene"], folder)
    assert store.resumed == 0
    store.db.close()
    RunStore(OTHERS["scene"], folder).db.close()


def test_trials_are_gone_on_with_too(folder):
    job = replace(JOB, planning=PLANNING)
    store = RunStore(job, folder)
    store.db.add_trial(run_trial(PLANNING, 1))
    assert store.kept == "1 of 2 planning trials"
    store.db.close()
    again = RunStore(job, folder, resume=True)
    assert [trial.trial for trial in again.db.trials] == [1] and not again.complete


@pytest.mark.parametrize("damage", ["missing", "cut", "all"])
def test_parts_that_are_not_whole_are_made_again(damage, unfinished):
    part = unfinished / "parts" / "3-0.npz"
    if damage == "cut":
        part.write_bytes(part.read_bytes()[:-1])
    else:
        part.unlink()
    if damage == "all":
        (unfinished / "parts" / "0-0.npz").unlink()
        (unfinished / "parts").rmdir()
    store = RunStore(JOB, unfinished, resume=True)
    lost = 4 if damage == "all" else 2
    assert store.resumed == 4 - lost
    (note,) = store.notes
    assert note.startswith(f"{lost} scans were made again: their parts were missing or cut short")
    if lost == 2:
        assert store.db.missing(0, 6) == [(2, 6)]
    assert add(store, 3, 5, number=1)
    store.tidy()
    assert set(store.points().names) == store.storage.sizes().keys()


@pytest.fixture(params=["folder", "memory"])
def place(request, tmp_path):
    if request.param == "folder":
        return str(tmp_path / "elsewhere")
    return f"memory://{request.node.name}-{tmp_path.name}"


def test_parts_elsewhere_have_a_folder_of_their_own_and_go_with_the_run(folder, place, tmp_path):
    theirs = RunStore(JOB, tmp_path / "theirs", place)
    add(theirs, 0, 6)
    store = RunStore(JOB, folder, place)
    add(store, 0, 6)
    assert names(folder) <= {"run.db", "run.db-journal"}
    store.tidy()
    assert len(store.points().load()) == 18
    store.remove()
    assert not folder.exists() and store.storage.sizes() == {}
    assert len(theirs.points().load()) == 18


def test_a_run_is_gone_on_with_where_its_parts_are(folder, place, tmp_path):
    store = RunStore(JOB, folder, place)
    add(store, 0, 4)
    store.db.close()
    again = RunStore(JOB, folder, tmp_path / "other", resume=True)
    assert again.resumed == 4 and again.storage.url == store.storage.url
    again.db.close()
    remove_run(folder)
    assert store.storage.sizes() == {}


def test_places_that_cannot_be(tmp_path):
    with pytest.raises(LidarpoolError, match="make the one that it lies in first"):
        RunStore(JOB, tmp_path / "none" / "run")
    with pytest.raises(LidarpoolError, match="give a folder for the run as well"):
        RunStore(JOB, None, tmp_path / "parts")


def test_an_error_tells_how_to_go_on(folder):
    store = RunStore(JOB, folder)
    add(store, 0, 2)
    store.db.frames = 1
    with pytest.raises(KeyboardInterrupt) as caught, store.kept_on_error():
        raise KeyboardInterrupt
    kept = f"2 of 6 scans are kept in {folder}: continue with --resume (in Python resume=True)."
    assert caught.value.__notes__ == [kept]
    again = RunStore(JOB, folder, resume=True)
    assert (again.resumed, again.db.frames) == (2, 1)


def test_an_error_before_anything_was_kept_leaves_nothing(folder):
    store = RunStore(JOB, folder)
    store.storage.prepare()
    store.storage.write("stray.npz", b"")
    with pytest.raises(ValueError, match="bad") as caught, store.kept_on_error():
        raise ValueError("bad")
    assert not hasattr(caught.value, "__notes__") and not folder.exists()


def test_removing_a_run_leaves_what_is_not_its_own(unfinished):
    (unfinished / "report.json").write_text("{}")
    (unfinished / "parts" / "notes.txt").write_text("mine")
    (unfinished / "parts" / ".tmp-5.npz-1a2b").write_text("half")
    remove_run(unfinished)
    remove_run(unfinished)
    assert names(unfinished) == {"report.json", "parts/notes.txt"}

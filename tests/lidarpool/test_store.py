"""What a run keeps in its folder, and under which terms a later run goes on from it."""

from __future__ import annotations

import errno
import gc
import shutil
import sqlite3
from contextlib import closing
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from tests.committing import commit

import lidarpool.run.store.remote
import lidarpool.run.store.run_store
from lidarfiles.datasets.job_table import JobRow
from lidarfiles.parts.parts import mark_name, part_name, probe_name
from lidarpool import Campaign, remove_run
from lidarpool.run.job_source import SingleJob
from lidarpool.run.store.run_store import RunStore
from lidarscenario import Job, Planning
from lidarscenario.plan import run_trial
from lidarsim import LidarError, Scene, Sensor, Survey
from lidarsim.io.storage import Storage
from lidarsim.scene.shapes import seed_objects

SCENE = Scene.from_meshes(seed_objects(rings=4, segments=6))
SURVEY = Survey(Sensor.grid(layers=2), poses=[(0, 0, 1)], steps=6, columns=["time"])
PLANNING = Planning((0, 0), (9, 1), [(5, 0)], 1.0, trials=2, particles=10, iterations=5)
JOB = Job(SCENE, SURVEY)


def add(store, first, stop, job=None):
    """Commit a part of scans with three points of each."""
    return commit(store, first, [3] * (stop - first), [first, stop], [1, 2], job)


def opened(place=None, parts=None, *, job=JOB, backend="auto", resume=False):
    """Store of a survey."""
    return RunStore(SingleJob(job), backend, place, parts, resume=resume)


def names(folder):
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


@pytest.fixture
def folder(tmp_path):
    return tmp_path / "run"


@pytest.fixture(params=["folder", "memory"])
def anywhere(request, folder):
    """A run's folder, or its URL."""
    return folder if request.param == "folder" else f"memory://{folder.parent.name}/run"


def left(place):
    """What is there of a run, by path or URL."""
    return {*Storage.at(place).sizes(), *Storage.at(f"{place}/parts").sizes()}


@pytest.fixture
def unfinished(folder):
    """A folder in which a run has left four of six scans."""
    store = opened(folder)
    store.cast_with("numpy", {})
    add(store, 0, 2)
    add(store, 3, 5)
    store.db.close()
    return folder


def test_a_run_from_its_beginning_to_its_end(folder):
    store = opened(folder)
    assert (store.committed_text, store.only_job.is_complete, store.only_job.resumed) == (
        "",
        False,
        0,
    )
    add(store, 2, 6)
    assert store.committed_text == "4 of 6 scans" and store.only_job.progress().points == 12
    add(store, 0, 2)
    store.only_job.committed.advance_frames(6)
    assert store.only_job.is_complete
    cloud = store.only_job.points().load()
    assert cloud.scan.tolist() == np.repeat(np.arange(6), 3).tolist()
    assert len(store.only_job.points()) == 18 == store.only_job.parts.point_count
    for scan in range(6):
        points = store.only_job.read_scan(scan)
        assert set(points.scan) == {scan} and "time" in points.columns
        assert np.array_equal(points.positions, cloud.positions[3 * scan : 3 * scan + 3])
    hits = store.only_job.hit_counts()
    assert hits.shape == (len(SCENE.faces),)
    assert hits[[0, 2, 6]].tolist() == [1, 3, 2] and hits.sum() == 6
    rays = store.only_job.sample_rays()
    assert rays.shape[1:] == (2, 3) and set(rays[:, 1, 0]) == {0, 2}
    assert set(map(tuple, rays[:, 0].tolist())) == {(0, 0, 1)}
    mark = store.db.meta["mark"]
    store.storage.write(part_name(mark, 0, 0, 2), b"of a collector that died")
    store.storage.write(probe_name(mark, "0a1b2c3d"), b"of a driver that died")
    store.remove_orphaned_parts()
    assert store.storage.sizes().keys() == {*store.only_job.points().names, mark_name(mark)}
    store.remove()
    assert not folder.exists()


@pytest.mark.extended
def test_without_a_folder_all_goes_with_the_last_user_of_the_points():
    store = opened()
    add(store, 0, 6)
    points = store.only_job.points()
    folder = store.location.local()
    del store
    gc.collect()
    assert len(points.load()) == 18
    del points
    gc.collect()
    assert not folder.exists()


def test_it_is_gone_on_with(unfinished):
    store = opened(unfinished, resume=True)
    assert (store.only_job.resumed, store.backend, store.notes) == (4, "numpy", [])
    assert store.only_job.parts.missing(0, 6) == [(2, 3), (5, 6)]
    assert "were cast with this backend" in store.advice
    store.db.close()
    with pytest.raises(
        LidarError, match=r"cast with the backend 'numpy', .* cannot continue with 'tiles'"
    ):
        opened(unfinished, backend="tiles", resume=True)


FIELDS_OF_OTHERS = {
    "survey": "cloud.keep_every changed from 1 to 2",
    "scene": "scene.triangles changed from ",
    "planning": "planning.",
}
OTHERS = {
    "survey": replace(JOB, survey=replace(SURVEY, keep_every=2)),
    "scene": replace(JOB, scene=Scene.from_meshes(seed_objects(rings=4, segments=7))),
    "planning": replace(JOB, planning=PLANNING),
}


@pytest.mark.parametrize("other", OTHERS)
def test_another_run_cannot_go_on(other, unfinished):
    for resume in (True, False):
        with pytest.raises(LidarError) as raised:
            opened(unfinished, resume=resume, job=OTHERS[other])
        differs = f"cannot be continued because the {other} has changed: {FIELDS_OF_OTHERS[other]}"
        assert differs in str(raised.value)
        assert "Only `pool` and output formats without additional columns may change" in str(
            raised.value
        )
    remove_run(unfinished)
    opened(unfinished, job=OTHERS[other]).db.close()


def test_another_version_cannot_go_on(unfinished, monkeypatch):
    later = {"lidarpool": "0.2 (sources 12345678)"}
    monkeypatch.setattr(lidarpool.run.store.run_store, "software", lambda: later)
    with pytest.raises(
        LidarError, match=r"lidarpool \S+ \(sources \w+\), but this is lidarpool 0\.2"
    ):
        opened(unfinished, resume=True)


def test_a_run_that_has_kept_nothing_is_in_nobodys_way(folder):
    opened(folder).db.close()
    store = opened(folder, job=OTHERS["scene"])
    assert store.only_job.resumed == 0
    store.db.close()
    opened(folder, job=OTHERS["scene"]).db.close()


def test_trials_are_gone_on_with_too(folder):
    job = replace(JOB, planning=PLANNING)
    store = opened(folder, job=job)
    store.db.add_trials(store.only_job.committed, [run_trial(PLANNING, 1)])
    assert store.committed_text == "1 of 2 planning trials"
    store.db.close()
    again = opened(folder, resume=True, job=job)
    assert [trial.trial for trial in again.only_job.trials] == [
        1
    ] and not again.only_job.is_complete


def part_of(folder, first):
    """File of the part that begins with a scan."""
    (found,) = (folder / "parts").glob(f"{'?' * 16}-000000-{first:08d}-*.npz")
    return found


def flip(data, place):
    """Flip a bit at a place."""
    return data[:place] + bytes([data[place] ^ 1]) + data[place + 1 :]


DAMAGES = {  # more of them in test_parts.py
    "data": lambda data, other: flip(data, data.index(b"x.npy") + 160),
    "cut": lambda data, other: data[:-1],
    "longer": lambda data, other: data + b"x",
    "another": lambda data, other: other,
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_part_is_made_again(damage, unfinished):
    part = part_of(unfinished, 3)
    before = part.read_bytes()
    part.write_bytes(DAMAGES[damage](before, part_of(unfinished, 0).read_bytes()))
    assert part.read_bytes() != before
    store = opened(unfinished, resume=True)
    assert (store.only_job.resumed, store.only_job.parts.missing(0, 6)) == (2, [(2, 6)])
    (note,) = store.notes
    assert "scans 3 to 4, because " in note and f"{part.name} was damaged" in note
    assert add(store, 3, 5)
    store.remove_orphaned_parts()
    assert {*store.only_job.points().names, mark_of(store)} == store.storage.sizes().keys()
    assert len(store.only_job.points().load()) == 12
    store.db.close()
    assert opened(unfinished, resume=True).notes == []


def test_a_part_that_is_damaged_meanwhile_is_made_again_by_the_next_run(folder):
    store = opened(folder)
    add(store, 0, 2)
    part = part_of(folder, 0)
    part.write_bytes(part.read_bytes()[:-1])
    for read in (lambda: store.only_job.points().load(), store.only_job.hit_counts):
        with pytest.raises(LidarError, match="cannot be used") as caught:
            read()
        assert "Resume the run with `--resume` (`resume=True` in Python) to cast its" in str(
            caught.value
        )
        assert "anew" not in str(caught.value)
    with pytest.raises(LidarError) as caught, store.kept_on_error():
        store.only_job.points().load()
    (note,) = caught.value.__notes__
    assert "Continue with `--resume`" in note
    again = opened(folder, resume=True)
    assert again.only_job.parts.missing(0, 6) == [(0, 6)] and part.name in again.notes[0]


def test_parts_that_are_gone_are_made_again(unfinished):
    shutil.rmtree(unfinished / "parts")
    store = opened(unfinished, resume=True)
    assert store.only_job.resumed == 0
    (note,) = store.notes
    assert note.startswith("repeated scans 0 to 1, scans 3 to 4, because ")
    assert note.endswith(f".npz were missing in {unfinished / 'parts'}")
    assert add(store, 0, 6)
    store.remove()
    assert not unfinished.exists()


def test_storage_that_cannot_be_read_is_not_taken_for_damage(unfinished, monkeypatch):
    def refuse(*_):
        raise PermissionError(errno.EACCES, "Permission denied")

    with monkeypatch.context() as patch:
        patch.setattr(Storage, "read", refuse)
        with pytest.raises(LidarError, match=r"\.npz cannot be read: Permission denied"):
            opened(unfinished, resume=True)
    assert opened(unfinished, resume=True).only_job.resumed == 4


@pytest.fixture(params=["folder", "memory"])
def place(request, tmp_path):
    if request.param == "folder":
        return str(tmp_path / "elsewhere")
    return f"memory://{request.node.name}-{tmp_path.name}"


def test_parts_elsewhere_have_a_folder_of_their_own_and_go_with_the_run(folder, place, tmp_path):
    theirs = opened(tmp_path / "theirs", place)
    add(theirs, 0, 6)
    store = opened(folder, place)
    add(store, 0, 6)
    assert names(folder) <= {"run.db", "run.db-journal"}
    store.remove_orphaned_parts()
    assert len(store.only_job.points().load()) == 18
    store.remove()
    assert not folder.exists() and store.storage.sizes() == {}
    assert len(theirs.only_job.points().load()) == 18


def test_a_run_is_gone_on_with_where_its_parts_are(anywhere, place, tmp_path):
    store = opened(anywhere, place)
    add(store, 0, 4)
    store.save(force=True)
    store.db.close()
    again = opened(anywhere, tmp_path / "other", resume=True)
    assert again.only_job.resumed == 4 and again.storage.url == store.storage.url
    again.db.close()
    remove_run(anywhere)
    assert left(anywhere) == set() == store.storage.sizes().keys()


def test_places_that_cannot_be(tmp_path):
    with pytest.raises(LidarError, match="Create its parent folder first"):
        opened(tmp_path / "none" / "run")
    with pytest.raises(LidarError, match="`scratch_dir` requires `folder`"):
        opened(None, tmp_path / "parts")


def test_an_error_tells_how_to_go_on(anywhere):
    store = opened(anywhere)
    add(store, 0, 2)
    store.only_job.committed.advance_frames(1)
    with pytest.raises(KeyboardInterrupt) as caught, store.kept_on_error():
        raise KeyboardInterrupt
    (note,) = caught.value.__notes__
    assert note.startswith(f"2 of 6 scans are stored in {anywhere}. Continue with `--resume`")
    again = opened(anywhere, resume=True)
    assert (again.only_job.resumed, again.only_job.committed.frames) == (2, 1)


def test_an_error_before_anything_was_kept_leaves_nothing(anywhere):
    store = opened(anywhere)
    store.storage.write(part_name(store.db.meta["mark"], 0, 0, 2), b"")
    with pytest.raises(ValueError, match="bad") as caught, store.kept_on_error():
        raise ValueError("bad")
    assert not hasattr(caught.value, "__notes__") and left(anywhere) == set()


# -- what is not of the run stays ------------------------------------------------------------------


def mark_of(store):
    return mark_name(store.db.meta["mark"])


def new_run(folder):
    opened(folder, job=OTHERS["scene"]).db.close()


FOREIGN = {"a.npz", "arch.npz.bak", ".tmp-5.npz-1a2b", "notes.txt"}


@pytest.fixture
def kept_nothing(folder):
    """A folder with a run that ended before anything was committed."""
    store = opened(folder)
    store.storage.write(part_name(store.db.meta["mark"], 0, 0, 2), b"of a collector that died")
    store.db.close()
    return folder


def put(folder, names=FOREIGN):
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        (folder / name).write_text("mine")


def content(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.mark.parametrize("how", ["dropped", "new", "of no run", "finished"])
def test_foreign_files_among_the_parts_stay(how, request, folder):
    if how in ("dropped", "new"):
        request.getfixturevalue("unfinished" if how == "dropped" else "kept_nothing")
    put(folder / "parts")
    (folder / "parts" / "own").mkdir()
    if how == "finished":
        store = opened(folder)
        add(store, 0, 6)
        store.remove_orphaned_parts()
        store.remove()
    elif how == "dropped":
        remove_run(folder)
    else:
        new_run(folder)
        remove_run(folder)
    assert names(folder) == {f"parts/{name}" for name in FOREIGN}


def test_files_beside_the_database_stay_without_a_word(unfinished):
    (unfinished / "report.json").write_text("{}")
    part = part_of(unfinished, 0)
    part.with_name(f".lidarpool-tmp-{part.name}-0a1b2c3d").write_text("half")
    remove_run(unfinished)
    remove_run(unfinished)
    assert names(unfinished) == {"report.json"}


@pytest.mark.parametrize("where", ["parts", "run.db", "run.db-journal"])
@pytest.mark.parametrize("use", [remove_run, "resume", "new"])
def test_another_run_behind_a_link_stays(where, use, folder, tmp_path):
    """Wherever the link is, and whatever it leads to."""
    theirs = tmp_path / "theirs"
    other = opened(theirs)
    add(other, 0, 6)
    other.db.close()
    store = opened(folder)
    if use == "resume":
        add(store, 0, 2)
    store.db.close()
    link = folder / where
    link.parent.mkdir(parents=True, exist_ok=True)
    if link.exists():
        link.rename(tmp_path / "kept")
    target = theirs / link.name
    link.symlink_to(target if target.exists() else theirs / "run.db")
    before = {name: (theirs / name).read_bytes() for name in names(theirs)}
    assert len(before) == 3
    with pytest.raises(LidarError, match=f"{link} is a symbolic link"):
        use(folder) if callable(use) else opened(folder, resume=use == "resume").remove()
    assert before == {name: (theirs / name).read_bytes() for name in names(theirs)}
    link.unlink()
    remove_run(folder)
    named = tmp_path / "named"
    named.symlink_to(theirs)
    assert opened(named, resume=True).only_job.resumed == 6, "a link that was named is one's own"


def campaign(folder, *, height=1.0, resume=False):
    """Store of a campaign of two jobs, which are made of a file, and the first of them."""
    file = folder.with_name("height")
    file.write_text(str(height))

    def make(number, rng):
        poses = [(number, 0, float(file.read_text()))]
        return Job(SCENE, Survey(Sensor.grid(layers=2), poses, steps=6))

    jobs = Campaign(make, 2)
    return RunStore(jobs, location=folder, resume=resume), jobs.job(0)


@pytest.mark.parametrize("left", ["a job that is done", "a job under way"])
def test_a_survey_and_a_campaign_do_not_take_each_others_folder(left, folder, unfinished):
    with pytest.raises(LidarError, match="cannot be continued because "):
        campaign(folder)
    assert len(names(folder)) > 2
    remove_run(folder)
    store, job = campaign(folder)
    if left == "a job under way":
        store.open_job(job)
        add(store, 0, 2, job)
    else:
        store.commit_jobs([JobRow(0, "0000")])
    store.db.close()
    before = names(folder)
    for resume in (False, True):
        with pytest.raises(LidarError, match="cannot be continued because "):
            opened(folder, resume=resume)
    assert names(folder) == before


@pytest.mark.parametrize("change", ["none", "another height", "of unknown content"])
def test_a_job_under_way_is_gone_on_with_if_its_content_is_the_same(change, folder):
    store, job = campaign(folder)
    store.open_job(job)
    add(store, 0, 2, job)
    if change != "of unknown content":
        store.save()
    store.db.close()
    again, job = campaign(folder, height=2.0 if change == "another height" else 1.0, resume=True)
    same = change == "none"
    assert again.open_job(job).resumed == (2 if same else 0)
    assert any(name.endswith(".npz") for name in again.storage.sizes()) == same


def test_a_lost_database_is_made_again_though_drivers_end_meanwhile(folder):
    store, _ = campaign(folder)
    store.commit_jobs([JobRow(0, "0000")])
    store.db.close()
    (folder / "run.db").unlink()
    for end in ("killed", "interrupted", "alive"):
        store, job = campaign(folder, resume=True)
        assert store.begun and not store.committed_text  # nothing is taken over yet
        if end != "alive":
            store.close() if end == "interrupted" else store.db.close()
    store.open_job(job)
    add(store, 0, 2, job)
    store.close()
    store, _ = campaign(folder, resume=True)
    assert store.committed_text == "0 of 2 jobs"
    store.db.close()
    remove_run(folder)
    campaign(folder)[0].db.close()
    assert not opened(folder, resume=True).begun, "the other campaign has kept nothing"


def test_a_link_with_the_name_of_a_part_is_no_part(unfinished, tmp_path):
    part = part_of(unfinished, 0)
    victim = tmp_path / "victim"
    part.rename(victim)
    part.symlink_to(victim)
    store = opened(unfinished, resume=True)
    assert store.only_job.resumed == 2 and "was missing" in store.notes[0]
    store.db.close()
    remove_run(unfinished)
    assert victim.exists() and part.is_symlink()


def change(folder, *statements):
    with closing(sqlite3.connect(folder / "run.db")) as sql, sql:
        for statement in statements:
            sql.execute(statement)


@pytest.mark.parametrize("where", ["victim", "another run", "another run in a shared place"])
@pytest.mark.parametrize("kept", ["unfinished", "kept_nothing"])
def test_a_database_that_points_elsewhere(where, kept, request, tmp_path):
    folder = request.getfixturevalue(kept)
    shared = tmp_path / "shared" if where.endswith("place") else None
    other = opened(tmp_path / "other", shared)
    add(other, 0, 6)
    put(tmp_path / "victim")
    place = tmp_path / "victim" if where == "victim" else other.storage.url
    change(folder, f"UPDATE meta SET value = '{place}' WHERE name = 'parts'")
    with pytest.raises(LidarError, match=r"run\.db is damaged .* is not the location of this"):
        opened(folder)
    remove_run(folder)
    assert not folder.exists()
    assert content(tmp_path / "victim").keys() == FOREIGN
    assert len(other.only_job.points().load()) == 18


def test_parts_of_another_mark_stay(unfinished, tmp_path):
    """The folder of the parts was replaced by that of another run."""
    other = opened(tmp_path / "other")
    add(other, 0, 6)
    other.db.close()
    shutil.rmtree(unfinished / "parts")
    (tmp_path / "other" / "parts").rename(unfinished / "parts")
    remove_run(unfinished)
    assert len(names(unfinished / "parts")) == 2
    remove_run(unfinished)  # now that there is no database, the folder tells whose they are
    assert not unfinished.exists()


def test_a_damaged_database_is_dropped_with_the_parts_of_its_folder(unfinished):
    (unfinished / "run.db").write_bytes(bytes(8192))
    put(unfinished / "parts", ["a.npz"])
    with pytest.raises(LidarError, match="Remove the run with `--restart`"):
        opened(unfinished)
    assert len(names(unfinished)) == 5
    remove_run(unfinished)
    assert names(unfinished) == {"parts/a.npz"}


@pytest.mark.parametrize("harm", ["missing", "cut"])
def test_a_lost_database_is_made_again_from_the_parts(harm, folder, place):
    store = opened(folder, place)
    store.cast_with("numpy", {})
    add(store, 0, 2), add(store, 3, 5)
    store.db.close()
    path = folder / "run.db"
    path.unlink() if harm == "missing" else path.write_bytes(path.read_bytes()[:6000])
    before = names(folder)
    with pytest.raises(LidarError, match="cannot be continued because the scene"):
        opened(folder, place, resume=True, job=OTHERS["scene"])
    assert names(folder) == before
    again = opened(folder, place, resume=True)
    assert (again.only_job.resumed, again.backend) == (
        4,
        "numpy",
    ) and "was rebuilt from" in again.notes[0]
    add(again, 2, 3), add(again, 5, 6)
    assert set(again.only_job.sample_rays()[:, 1, 0]) == {0, 2, 3, 5}
    assert again.only_job.parts.hit_count == 12 == again.only_job.hit_counts().sum()


def test_a_database_of_another_program_stays(folder):
    store = opened(folder)
    add(store, 0, 2)
    store.db.close()
    (folder / "run.db").unlink()
    change(folder, "CREATE TABLE mine (a)")
    for use in (remove_run, new_run, partial(opened, resume=True)):
        with pytest.raises(LidarError, match=r"run\.db (is not a run database|is damaged)"):
            use(folder)
    assert len(names(folder)) == 3


def test_a_run_that_is_going_on_is_not_dropped(folder):
    store = opened(folder)
    add(store, 0, 6)
    with pytest.raises(LidarError, match=f"Another run is using {folder}"):
        remove_run(folder)
    assert len(store.only_job.points().load()) == 18


@pytest.fixture
def url(tmp_path, monkeypatch):
    """URL of a run whose driver has no folder that stays."""
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    return f"memory://{tmp_path.name}/run"


@pytest.fixture
def remote_run(url):
    """URL of a run whose driver died when two of six scans were in the copy of its database."""
    store = opened(url)
    store.cast_with("numpy", {})
    add(store, 0, 2)
    store.save(force=True)
    add(store, 3, 5)
    store.db.close()
    return url


def test_it_goes_on_from_the_last_copy(remote_run):
    store = opened(remote_run, resume=True)
    assert (store.only_job.resumed, store.backend, store.notes) == (4, "numpy", [])
    assert store.only_job.parts.missing(0, 6) == [(2, 3), (5, 6)], (
        "parts say what is not in the copy"
    )
    assert add(store, 2, 3) and add(store, 5, 6)
    store.only_job.committed.advance_frames(6)
    store.save(force=True)
    store.remove_orphaned_parts()
    mark = mark_name(store.db.meta["mark"])
    assert left(remote_run) == {"run.db", "run.owner", mark, *store.only_job.points().names}
    again = opened(remote_run, resume=True)
    assert (
        again.notes == []
        and again.only_job.is_complete
        and len(again.only_job.points().load()) == 18
    )
    again.remove()
    assert left(remote_run) == set()


def test_copies_are_made_now_and_then(url, monkeypatch):
    store = opened(url)
    first = Storage.at(url).read("run.db")
    add(store, 0, 2)
    store.save()
    assert Storage.at(url).read("run.db") == first
    # Private: the pause after a copy takes 5 s and more, which a test should not wait for.
    monkeypatch.setattr(store._remote, "_due", 0.0)
    store.save()
    assert Storage.at(url).read("run.db") != first


@pytest.mark.parametrize("how", ["resumed", "dropped"])
def test_a_run_that_is_taken_over_ends_and_leaves_all_to_the_other(how, url):
    early = opened(url)
    add(early, 0, 2)
    early.save(force=True)
    if how == "dropped":
        remove_run(url)
    late = opened(url, resume=True)
    add(late, 2, 6)
    late.save(force=True)
    before = left(url)
    with (
        pytest.raises(LidarError, match=f"taken over or deleted {url}") as caught,
        early.kept_on_error(),
    ):
        early.save(force=True)
    assert not hasattr(caught.value, "__notes__")
    assert left(url) == before
    late.save(force=True)
    again = opened(url, resume=True)
    assert again.only_job.resumed == (6 if how == "resumed" else 4)
    with pytest.raises(LidarError, match="so this run was stopped"), late.kept_on_error():
        late.remove()
    assert left(url) == before


def test_storage_that_fails(url, monkeypatch):
    store = opened(url)

    def fail(*_):
        raise OSError("it is full")

    monkeypatch.setattr(lidarpool.run.store.remote.Storage, "write", fail)
    with pytest.raises(LidarError, match=f"cannot be stored in {url}: it is full"):
        store.save(force=True)
    with pytest.raises(LidarError, match=rf"Cannot write to {url}: it is full"):
        opened(url, resume=True)

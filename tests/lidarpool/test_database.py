"""The database of a run: what is committed is there once, and the rest is missing."""

from __future__ import annotations

import signal
import sqlite3
import subprocess
import sys
from contextlib import closing

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lidarfiles.parts.parts import part_name
from lidarpool.run.pipeline.committed_results import CommittedResults
from lidarpool.run.pipeline.stage_messages import Receipt
from lidarpool.run.store.database import RunDatabase
from lidarscenario import Planning
from lidarscenario.plan import run_trial
from lidarsim import LidarError

SCANS = 20


MARK = "0123456789abcdef"


JOB = 7


def receipt(first, stop, rows=7, cells=(0, 0, 0, 1, 1, 1), job=JOB):
    name = part_name(MARK, job, first, stop)
    return Receipt(job, first, stop, name, rows, 100 + rows, 3 * rows, cells, b"summary")


@pytest.fixture(autouse=True)
def mark(monkeypatch):
    """Give all runs the same mark."""
    monkeypatch.setattr(
        "lidarpool.run.store.database.secrets.token_hex", lambda size: MARK[: 2 * size]
    )


@pytest.fixture
def db(tmp_path):
    database = RunDatabase(tmp_path / "run.db")
    yield database
    database.close()


@pytest.fixture
def job(db):
    """A job of which nothing is committed yet."""
    return read(db)


def read(db, number=JOB):
    """Read what is committed of a job."""
    job = CommittedResults(number, range(SCANS))
    db.read(job)
    return job


def commit(db, job, *receipts):
    """Commit receipts of a job; returns those that were new."""
    return db.commit((job, receipt) for receipt in receipts)


def reopened(db):
    db.close()
    return RunDatabase(db.path)


def test_what_is_committed_is_there_once(db, job):
    one = receipt(0, 5)
    two = receipt(10, 12, rows=2)
    assert commit(db, job, two, one) == [two, one]
    assert commit(db, job, one) == []
    assert commit(db, job, receipt(0, 5), receipt(0, 4)) == []
    again = reopened(db)
    for found in (job, read(again)):
        parts = found.parts
        assert [p.name for p in parts.ordered] == [one.name, two.name]
        assert (parts.scans_done, parts.point_count, parts.hit_count) == (7, 9, 27)
        assert parts.missing(0, SCANS) == [(5, 10), (12, SCANS)]
        assert found.missing_count == SCANS - 7 and not found.scans_complete
    again.close()


@pytest.mark.extended
@settings(max_examples=40, deadline=None)
@given(
    st.lists(
        st.lists(
            st.tuples(st.integers(0, 1), st.integers(0, SCANS - 1), st.integers(1, 6)).map(
                lambda span: (span[0], span[1], min(span[1] + span[2], SCANS))
            ),
            max_size=4,
        ),
        max_size=6,
    )
)
def test_whatever_comes_each_scan_is_of_one_part_or_missing(tmp_path_factory, commits):
    path = tmp_path_factory.mktemp("db") / "run.db"
    db = RunDatabase(path)
    owners = [{}, {}]
    jobs = [read(db, number) for number in range(2)]
    for spans in commits:
        receipts = [(jobs[job], receipt(first, stop, job=job)) for job, first, stop in spans]
        for part in db.commit(receipts):
            for scan in range(part.first, part.stop):
                assert scan not in owners[part.job]
                owners[part.job][scan] = part.name
    again = reopened(db)
    for job in (*jobs, *(read(again, number) for number in range(2))):
        mine = owners[job.number]
        found = job.parts
        assert found.missing(0, SCANS) == runs(set(range(SCANS)) - set(mine))
        assert found.missing(5, 9) == runs(set(range(5, 9)) - set(mine))
        for scan in range(SCANS):
            if scan in mine:
                assert found.part_of(scan).name == mine[scan]
            else:
                with pytest.raises(KeyError):
                    found.part_of(scan)
        assert found.scans_done == len(mine)
        assert [p.first for p in found.ordered] == sorted(p.first for p in found.ordered)
    again.close()


def runs(scans):
    """Half-open ranges of some numbers."""
    starts = sorted(s for s in scans if s - 1 not in scans)
    ends = sorted(s + 1 for s in scans if s + 1 not in scans)
    return list(zip(starts, ends, strict=True))


def test_parts_that_are_dropped_are_missing_again(db, job):
    parts = [receipt(0, 4), receipt(4, 8), receipt(8, 20)]
    commit(db, job, *parts)
    db.drop(job, [parts[1]])
    again = reopened(db)
    for found in (job, read(again)):
        assert found.parts.missing(0, SCANS) == [(4, 8)]
        counts = found.parts.scans_done, found.parts.point_count, found.parts.hit_count
        assert counts == (16, 14, 42)
    two = receipt(4, 6), receipt(6, 8)
    assert commit(again, found, *two) == [*two]
    assert found.parts.missing(0, SCANS) == [] and found.scans_complete
    found.has_frames = True
    assert not found.scans_complete
    found.advance_frames(SCANS)
    assert found.scans_complete
    again.close()


def test_frames_that_were_handed_out_are_kept_with_the_next_commit(db, job):
    commit(db, job, receipt(0, 4), receipt(4, 8), receipt(12, 16))
    for scan, firsts in ((4, [4, 12]), (3, [4, 12]), (7, [12])):
        job.advance_frames(scan + 1)
        assert [p.first for p in job.parts.reaching_past(job.frames)] == firsts
    commit(db, job, receipt(8, 12))
    job.advance_frames(10)
    again = reopened(db)
    job = read(again)
    assert job.frames == 8, "those since are handed out once more"
    job.advance_frames(10)
    again.save_frames([job])
    last = reopened(again)
    job = read(last)
    assert job.frames == 10
    assert [part.first for part in job.parts.reaching_past(job.frames)] == [8, 12]
    assert job.parts.part_of(12).summaries == b"", "nobody needs them in memory"
    assert [last.summaries(part) for part in job.parts.ordered] == [b"summary"] * 4
    last.close()


def test_the_cells_of_all_parts(db, job):
    assert job.parts.cell_box is None
    commit(db, job, receipt(0, 1, cells=()), receipt(1, 2, cells=(-5, 0, 3, 0, 9, 4)))
    assert job.parts.cell_box.tolist() == [[-5, 0, 3], [0, 9, 4]]
    commit(db, job, receipt(2, 3, cells=(0, -7, 3, 1, 1, 2**40)))
    assert read(reopened(db)).parts.cell_box.tolist() == [[-5, -7, 3], [1, 9, 2**40]]


def test_values_and_trials_come_back(db, job):
    planning = Planning((0, 0), (9, 1), [(5, 0)], 1.0, trials=2, particles=10, iterations=5)
    trials = [run_trial(planning, number) for number in (1, 0)]
    db.add_trials(job, trials[:1])
    db.add_trials(job, trials[1:])
    assert job.trials == trials
    db.set(backend="numpy", note="π")
    again = reopened(db)
    assert again.meta["backend"] == "numpy" and again.meta["note"] == "π"
    assert again.begun == {JOB} and again.has_results
    found = read(again).trials
    assert [t.trial for t in found] == [0, 1]
    for one, two in zip(found, reversed(trials), strict=True):
        assert np.array_equal(one.waypoints, two.waypoints) and one.length == two.length
    again.close()


# -- jobs ------------------------------------------------------------------------------------------


def test_of_a_job_that_has_ended_a_row_is_left(db, job):
    db.commit([(job, receipt(0, 5)), (read(db, 9), receipt(0, 5, job=9))])
    assert db.begun == {JOB, 9}
    db.end_jobs([(JOB, False, {"points": 3}), (2, True, {"error": "too large"})])
    assert db.begun == {9} and db.failed_jobs() == [2]
    again = reopened(db)
    for found in (db, again):
        assert [found.has_ended(number) for number in (0, 2, JOB, 8, 10**6)] == [
            False, True, True, False, False,
        ]  # fmt: skip
        assert found.ended_count == 2
    assert (
        again.failed_jobs() == [2] and again.begun == {9} and read(again, 9).parts.scans_done == 5
    )
    assert [*again.job_rows()] == [{"error": "too large"}, {"points": 3}]
    again.close()


def test_jobs_that_are_forgotten_are_done_again(db):
    assert not db.has_results
    db.end_jobs([(number, number == 2, {}) for number in (1, 2)])
    db.end_jobs([(2, False, {"points": 1})])
    assert db.failed_jobs() == []
    db.forget_jobs([1, 2])
    assert db.ended_count == 0 and not db.has_ended(1) and db.has_results
    again = reopened(db)
    assert again.has_results and not again.begun and again.ended_count == 0
    again.close()


def test_a_job_that_is_restarted_has_nothing(db, job):
    commit(db, job, receipt(0, 5))
    job.advance_frames(5)
    db.save_frames([job])
    db.restart(job)
    assert (job.missing_count, job.frames, job.parts.ordered) == (
        SCANS,
        0,
        [],
    ) and db.begun == set()
    assert commit(db, job, receipt(0, 6))
    db.restart(read(db, 8))
    again = reopened(db)
    job = read(again)
    assert job.frames == 0 and job.parts.scans_done == 6
    again.close()


@pytest.mark.extended
def test_thousands_of_jobs_take_little_memory_and_time(db):
    db.end_jobs((number, number % 1000 == 0, {"points": number}) for number in range(50_000))
    again = reopened(db)
    assert again.ended_count == 50_000 and len(again.failed_jobs()) == 50
    # Private, since memory is what is tested: a byte for each job.
    assert not again.begun and len(again._ended) < 100_000
    again.close()


# -- files that are something else -----------------------------------------------------------------


def sql(path, *statements):
    connection = sqlite3.connect(path)
    with connection:
        for statement in statements:
            connection.execute(statement)
    connection.close()


DAMAGE = {
    "cut": lambda path: path.write_bytes(path.read_bytes()[:5000]),
    "text": lambda path: path.write_text("no database " * 500),
    "zeros": lambda path: path.write_bytes(bytes(8192)),
    "of something else": lambda path: sql(path, "DROP TABLE parts"),
    "cells": lambda path: sql(path, "UPDATE parts SET cells = '{'"),
    "trial of nothing": lambda path: sql(path, "INSERT INTO trials VALUES (7, 0, '{}', 0)"),
    "jobs without numbers": lambda path: sql(path, "INSERT INTO jobs VALUES (-1, 0, '{}', 0)"),
    "place of another run": lambda path: sql(
        path, "INSERT INTO meta VALUES ('parts', '/data/run-fedcba9876543210', 0)"
    ),
    "a bit of the summaries": lambda path: sql(
        path, "UPDATE parts SET summaries = x'00' || substr(summaries, 2) WHERE first = 0"
    ),
    "rows": lambda path: sql(path, "UPDATE parts SET rows = rows + 1"),
    "no mark": lambda path: sql(path, "UPDATE meta SET value = '' WHERE name = 'mark'"),
    "path for a scan": lambda path: sql(path, "UPDATE parts SET stop = '../../x'"),
    "of another format": lambda path: sql(path, "UPDATE meta SET value = '1' WHERE name='format'"),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_a_damaged_file_is_refused_and_left_alone(db, job, damage):
    commit(db, job, receipt(0, 5), receipt(10, 12))
    db.close()
    DAMAGE[damage](db.path)
    before = db.path.read_bytes()
    with (
        pytest.raises(LidarError, match=r"run\.db (is damaged|cannot be written) \("),
        closing(RunDatabase(db.path)) as opened,
    ):
        read(opened)
    assert db.path.read_bytes() == before


@pytest.mark.skipif(sys.platform == "win32", reason="has no interval timers")
def test_an_interrupt_during_a_commit_does_not_look_like_damage(db, job):
    def interrupt(number, frame):
        raise KeyboardInterrupt

    handler = signal.signal(signal.SIGALRM, interrupt)
    interrupts = 0
    try:
        for delay_s in np.linspace(0.0002, 0.005, 60):
            with pytest.raises(KeyboardInterrupt):
                signal.setitimer(signal.ITIMER_REAL, float(delay_s))
                while True:
                    db.end_jobs((number, False, {"name": "x"}) for number in range(200))
            interrupts += 1
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, handler)
    assert interrupts == 60
    assert commit(db, job, receipt(0, 4)) == [receipt(0, 4)]  # no transaction is left open


def test_a_file_that_cannot_be_made(tmp_path):
    with pytest.raises(LidarError, match=r"run\.db cannot be written .*different folder"):
        RunDatabase(tmp_path / "none" / "run.db")
    (tmp_path / "run.db").mkdir()
    with pytest.raises(LidarError, match="cannot be written"):
        RunDatabase(tmp_path / "run.db")


@pytest.mark.extended
def test_one_run_at_a_time(db, job, tmp_path):
    commit(db, job, receipt(0, 5))
    code = (
        "import sys; from pathlib import Path\n"
        "from lidarpool.run.store.database import RunDatabase\n"
        "try: RunDatabase(Path(sys.argv[1]))\n"
        "except Exception as error: print(type(error).__name__, error)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, db.path],
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.strip() == f"LidarError Another run is using {tmp_path}."
    with pytest.raises(LidarError, match="Another run is using"):  # nor in this process
        RunDatabase(db.path)
    assert commit(db, job, receipt(5, 6))
    reopened(db).close()

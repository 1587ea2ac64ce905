"""The database of a run: what is committed is there once, and the rest is missing."""

from __future__ import annotations

import os
import sqlite3
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lidarpool import LidarpoolError
from lidarpool.columns.parts import part_name
from lidarpool.pipeline.database import RunDatabase
from lidarpool.pipeline.messages import Receipt
from lidarpool.plan import Planning, run_trial

SCANS = 20


MARK = "0123456789abcdef"


def receipt(first, stop, rows=7, cells=(0, 0, 0, 1, 1, 1)):
    name = part_name(MARK, first, stop)
    return Receipt(first, stop, name, rows, 100 + rows, 3 * rows, cells, b"summary")


@pytest.fixture(autouse=True)
def mark(monkeypatch):
    """Give all runs the same mark."""
    monkeypatch.setattr(
        "lidarpool.pipeline.database.secrets.token_hex", lambda size: MARK[: 2 * size]
    )


@pytest.fixture
def db(tmp_path):
    made = RunDatabase(tmp_path / "run.db", SCANS)
    yield made
    made.close()


def reopened(db):
    db.close()
    return RunDatabase(db.path, SCANS)


def test_what_is_committed_is_there_once(db):
    one, two = receipt(0, 5), receipt(10, 12, rows=2)
    assert db.commit([two, one]) == [two, one]
    assert db.commit([one]) == []
    assert db.commit([receipt(0, 5), receipt(0, 4)]) == []
    again = reopened(db)
    for found in (db, again):
        assert [p.name for p in found.ordered] == [one.name, two.name]
        assert (found.scans_done, found.point_count, found.hits) == (7, 9, 27)
        assert found.committed.nonzero()[0].tolist() == [0, 1, 2, 3, 4, 10, 11]
        assert len(found.parts) == 2 and not found.complete
    again.close()


@settings(max_examples=40, deadline=None)
@given(
    st.lists(
        st.lists(
            st.tuples(st.integers(0, SCANS - 1), st.integers(1, 6)).map(
                lambda span: (span[0], min(span[0] + span[1], SCANS))
            ),
            max_size=4,
        ),
        max_size=6,
    )
)
def test_whatever_comes_each_scan_is_of_one_part_or_missing(tmp_path_factory, commits):
    path = tmp_path_factory.mktemp("db") / "run.db"
    db, owners = RunDatabase(path, SCANS), {}
    for spans in commits:
        for part in db.commit([receipt(first, stop) for first, stop in spans]):
            for scan in range(part.first, part.stop):
                assert scan not in owners
                owners[scan] = part.name
    again = reopened(db)
    for found in (db, again):
        assert found.missing(0, SCANS) == runs(set(range(SCANS)) - set(owners))
        assert found.missing(5, 9) == runs(set(range(5, 9)) - set(owners))
        for scan in range(SCANS):
            if scan in owners:
                assert found.part_of(scan).name == owners[scan]
            else:
                with pytest.raises(KeyError):
                    found.part_of(scan)
        assert found.scans_done == len(owners)
        assert [p.first for p in found.ordered] == sorted(p.first for p in found.ordered)
    again.close()


def runs(scans):
    """Half-open ranges of some numbers."""
    starts = sorted(s for s in scans if s - 1 not in scans)
    ends = sorted(s + 1 for s in scans if s + 1 not in scans)
    return list(zip(starts, ends, strict=True))


def test_parts_that_are_dropped_are_missing_again(db):
    parts = [receipt(0, 4), receipt(4, 8), receipt(8, 20)]
    db.commit(parts)
    db.drop([parts[1]])
    again = reopened(db)
    for found in (db, again):
        assert found.missing(0, SCANS) == [(4, 8)]
        assert (found.scans_done, found.point_count, found.hits) == (16, 14, 42)
    assert again.commit([receipt(4, 6), receipt(6, 8)]) == [receipt(4, 6), receipt(6, 8)]
    assert again.missing(0, SCANS) == [] and not again.complete
    again.frames = SCANS
    assert again.complete
    again.close()


def test_frames_that_were_handed_out_are_kept_with_the_next_commit(db):
    db.commit([receipt(0, 4), receipt(4, 8), receipt(12, 16)])
    db.frames = 5
    assert [p.first for p in db.unframed()] == [4, 12]
    db.frames = 4
    assert [p.first for p in db.unframed()] == [4, 12]
    db.frames = 8
    assert [p.first for p in db.unframed()] == [12]
    db.commit([receipt(8, 12)])
    db.frames = 10
    again = reopened(db)
    assert again.frames == 8, "those since are handed out once more"
    again.frames = 10
    again.save_frames()
    last = reopened(again)
    assert last.frames == 10
    assert [(p.first, p.summaries) for p in last.unframed()] == [(8, b"summary"), (12, b"summary")]
    assert last.part_of(0).summaries == b"", "of those that are out nobody needs them in memory"
    assert last.summaries_of([13, 0, 1, 9]) == [(0, b"summary"), (8, b"summary"), (12, b"summary")]
    last.close()


def test_the_cells_of_all_parts(db):
    assert db.cells is None
    db.commit([receipt(0, 1, cells=()), receipt(1, 2, cells=(-5, 0, 3, 0, 9, 4))])
    assert db.cells.tolist() == [[-5, 0, 3], [0, 9, 4]]
    db.commit([receipt(2, 3, cells=(0, -7, 3, 1, 1, 2**40))])
    assert reopened(db).cells.tolist() == [[-5, -7, 3], [1, 9, 2**40]]


def test_values_and_trials_come_back(db):
    planning = Planning((0, 0), (9, 1), [(5, 0)], 1.0, trials=2, particles=10, iterations=5)
    trials = [run_trial(planning, number) for number in (1, 0)]
    for trial in trials:
        db.add_trial(trial)
    db.set(backend="numpy", note="π")
    again = reopened(db)
    assert again.meta["backend"] == "numpy" and again.meta["note"] == "π"
    assert [t.trial for t in again.trials] == [0, 1]
    for one, two in zip(again.trials, reversed(trials), strict=True):
        assert np.array_equal(one.waypoints, two.waypoints) and one.length == two.length
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
    "trial of nothing": lambda path: sql(path, "INSERT INTO trials VALUES (0, '{}')"),
    "place of another run": lambda path: sql(
        path, "INSERT INTO meta VALUES ('parts', '/data/run-fedcba9876543210')"
    ),
    "no mark": lambda path: sql(path, "UPDATE meta SET value = '' WHERE name = 'mark'"),
    "path for a scan": lambda path: sql(path, "UPDATE parts SET stop = '../../x'"),
    "of another format": lambda path: sql(path, "UPDATE meta SET value = '1' WHERE name='format'"),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_a_damaged_file_is_refused_and_left_alone(db, damage):
    db.commit([receipt(0, 5), receipt(10, 12)])
    db.close()
    DAMAGE[damage](db.path)
    before = db.path.read_bytes()
    with pytest.raises(LidarpoolError, match=r"run\.db (is damaged|cannot be written) \(.*\): "):
        RunDatabase(db.path, SCANS)
    assert db.path.read_bytes() == before


def test_a_file_that_cannot_be_made(tmp_path):
    with pytest.raises(LidarpoolError, match=r"run\.db cannot be written .*give another folder"):
        RunDatabase(tmp_path / "none" / "run.db", SCANS)
    (tmp_path / "run.db").mkdir()
    with pytest.raises(LidarpoolError, match="cannot be written"):
        RunDatabase(tmp_path / "run.db", SCANS)


def test_one_run_at_a_time(db, tmp_path):
    db.commit([receipt(0, 5)])
    code = (
        "import sys; from pathlib import Path\n"
        "from lidarpool.pipeline.database import RunDatabase\n"
        f"try: RunDatabase(Path(sys.argv[1]), {SCANS})\n"
        "except Exception as error: print(type(error).__name__, error)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, db.path],
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.strip() == f"LidarpoolError Another run is using {tmp_path}."
    with pytest.raises(LidarpoolError, match="Another run is using"):  # nor in this process
        RunDatabase(db.path, SCANS)
    assert db.commit([receipt(5, 6)])
    reopened(db).close()

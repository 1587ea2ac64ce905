"""Test that damaged files of results and runs are read correctly or cause a short error."""

from __future__ import annotations

import random
from contextlib import closing
from pathlib import Path

import pytest
from tests.chaos.damage import (
    Outcome,
    Reader,
    attack,
    damaged,
    files_of,
    fuzz,
    read_sweeps,
    read_verified,
    shown,
)
from tests.chaos.inputs import helios_target, loops_target
from tests.drives import the_scene, the_sweeps, write_set

from lidarfiles.parts.parts import part_name
from lidarpool import LidarError
from lidarpool.run.pipeline.committed_results import CommittedResults
from lidarpool.run.pipeline.stage_messages import Receipt
from lidarpool.run.store.database import RunDatabase

DAMAGES = 3  # of each file, for each reader


@pytest.fixture(scope="module")
def dataset(tmp_path_factory) -> Path:
    """Create a data set of six jobs, one of which has failed."""
    place = tmp_path_factory.mktemp("set") / "whole"
    scene = the_scene()
    write_set(place, "folder", scene, the_sweeps(scene))
    return place


def read_all(place: Path) -> str:
    return read_verified(place) + read_sweeps(place)


READERS = {"sweeps": read_sweeps, "verify": read_all, "view": shown}


@pytest.mark.extended
@pytest.mark.parametrize("name", READERS)
def test_files_of_a_data_set_are_read_right_or_refused(dataset, name):
    reader: Reader = READERS[name]
    whole = dataset / "jobs/00" if name == "view" else dataset
    outcome = Outcome()
    chance = random.Random(7)
    for file in files_of(whole):
        if name == "sweeps" and file.suffix == ".ply":  # compared by --verify alone
            continue
        if file.suffix != ".parquet":
            attack(whole, reader, file, DAMAGES, chance, outcome, name)
    assert not outcome.faults, "\n".join(outcome.faults)
    assert outcome.ends["refused"]
    assert outcome.ends["right"] or name == "verify"  # which compares every byte


def test_a_damaged_database_is_refused_or_the_same(tmp_path):
    """Flip each bit of the database.

    SQLite itself does not detect flipped bits in values.
    """
    path = tmp_path / "run.db"
    copy = tmp_path / "copy.db"

    def content(database: RunDatabase) -> object:
        job = CommittedResults(0, range(100))
        database.read(job)
        summaries = [*map(database.summaries, job.parts.ordered)]
        rows = [*database.job_rows()]
        return job.parts.ordered, summaries, job.trials, rows, database.meta

    with closing(RunDatabase(path)) as db:
        job = CommittedResults(0, range(100))
        mark = db.meta["mark"]
        for first in range(0, 100, 5):
            name = part_name(mark, 0, first, first + 5)
            box = (0, 0, 0, 9, 9, first)
            part = Receipt(0, first, first + 5, name, 7, 900, 21, box, b"summary" * 9)
            db.commit([(job, part)])
        db.end_jobs((number, False, {"name": f"{number:04}"}) for number in range(1, 20))
    with closing(RunDatabase(path)) as db:
        expected = content(db)
    data = path.read_bytes()
    chance = random.Random(7)
    refused = 0
    for _ in range(100):
        copy.write_bytes(damaged(data, chance))
        try:
            with closing(RunDatabase(copy, durable=False)) as db:
                found = content(db)
        except LidarError as error:
            assert "\n" not in str(error)
            refused += 1
            continue
        lost = set(map(str, found[3])) ^ set(map(str, expected[3]))
        assert found == expected or not copy.stat().st_size, lost
    assert refused > 15


@pytest.mark.parametrize("make", [helios_target, loops_target])
def test_inputs_are_read_right_or_refused(tmp_path, make):
    target = make(tmp_path)
    (reader,) = target.readers.values()
    outcome = Outcome()
    chance = random.Random(7)
    files = [file for file in files_of(target.whole) if target.chosen(file)]
    for file in files:
        attack(target.whole, reader, file, DAMAGES, chance, outcome, str(make))
    assert not outcome.faults, "\n".join(outcome.faults)
    assert outcome.ends["right"]
    assert len(files) == (5 if make is helios_target else 2)


@pytest.mark.slow
def test_files_of_results_and_runs_are_read_right_or_refused():
    outcome = fuzz(3, seed=5, seconds=120)
    assert not outcome.faults, "\n".join(outcome.faults)
    assert outcome.ends["right"] and outcome.ends["refused"]

"""A journal gives back what was delivered, whatever became of it, or says why it cannot."""

import weakref
from pathlib import Path

import numpy as np
import pytest
from tests.lidarpool.journal_run import (
    DELIVERIES,
    SCANS,
    VERTICES,
    content,
    deliver,
    expected_content,
    files,
    frame,
    interrupted,
    make_job,
    make_planning,
    make_survey,
    reopen,
    trial,
)

from lidarpool import LidarpoolError, Scene, Sensor, Survey, identity, remove_journal
from lidarpool.journal import COMMAND_TERMS, Journal, open_journal
from lidarpool.journal_folder import FRAMES, RECORDS
from lidarpool.journal_format import TRIAL
from lidarpool.mesh import Mesh
from lidarpool.run import make_result
from lidarpool.scan.messages import Frame, Part


@pytest.fixture(scope="module")
def expected():
    return expected_content()


@pytest.fixture
def path(tmp_path):
    return tmp_path / "journal"


def test_a_run_without_a_journal_and_one_with_it_agree(path, expected):
    journal = Journal(path, make_job())
    deliver(journal)
    journal.save()
    assert content(journal) == expected
    assert journal.complete


@pytest.mark.parametrize("orderly", [True, False])
@pytest.mark.parametrize("after", range(1, len(DELIVERIES) + 1, 2))
def test_a_run_goes_on_from_wherever_it_ended(after, orderly, path, expected):
    interrupted(path, after, orderly=orderly)
    journal = reopen(path)
    scans = {s for item in DELIVERIES[:after] if isinstance(item, Part) for s in item.scans}
    assert [scan for scan in range(SCANS) if scan in journal.cloud.ledger] == sorted(scans)
    assert journal.resumed == journal.cloud.ledger.delivered == len(scans)
    assert journal.cloud.ledger.duplicates == 0
    frames = sum(isinstance(item, Frame) for item in DELIVERIES[:after])
    assert journal.totals.frames == (frames if orderly else 0)
    assert journal.complete == (orderly and after == len(DELIVERIES))
    deliver(journal)
    assert content(journal) == expected


def test_a_run_may_end_many_times(path, expected):
    for after in range(1, len(DELIVERIES)):
        journal = reopen(path)
        deliver(journal, DELIVERIES[:after])
        journal.save()
        journal.close()
    journal = reopen(path)
    deliver(journal)
    assert content(journal) == expected


def test_nothing_is_made_before_something_is_delivered(path):
    journal = reopen(path)
    journal.look()
    journal.totals.take(frame(0))
    journal.save()
    assert not path.exists()
    with pytest.raises(ZeroDivisionError) as caught, journal.kept_on_error():
        raise ZeroDivisionError
    assert not path.exists() and not hasattr(caught.value, "__notes__")


def test_an_error_is_told_how_to_go_on(path):
    journal = Journal(path, make_job(), COMMAND_TERMS)
    with pytest.raises(ZeroDivisionError) as caught, journal.kept_on_error():
        deliver(journal, DELIVERIES[:9])
        raise ZeroDivisionError
    assert caught.value.__notes__ == [f"6 of 12 scans are kept in {path}: continue with --resume."]
    assert reopen(path).totals.frames == 4


class InterruptedFrame:
    """A frame at whose n-th look somebody presses Ctrl-C."""

    def __init__(self, whole, looks):
        self.whole, self.looks = whole, looks

    def __getattr__(self, name):
        self.looks -= 1
        if self.looks < 0:
            raise KeyboardInterrupt
        return getattr(self.whole, name)


@pytest.mark.parametrize("looks", range(8))
def test_a_frame_is_not_counted_twice_after_an_interrupt(looks, path, expected):
    journal = reopen(path)
    with pytest.raises(KeyboardInterrupt), journal.kept_on_error():
        deliver(journal, DELIVERIES[:6])
        journal.totals.take(InterruptedFrame(frame(3), looks))
    again = reopen(path)
    deliver(again)
    assert content(again) == expected


def test_an_interrupt_while_the_journal_is_made_leaves_nothing(path, monkeypatch):
    def interrupt(folder):
        raise KeyboardInterrupt

    monkeypatch.setattr("lidarpool.journal_store.flush_folder", interrupt)
    journal = reopen(path)
    with pytest.raises(KeyboardInterrupt) as caught, journal.kept_on_error():
        deliver(journal)
    assert not path.exists()
    assert not getattr(caught.value, "__notes__", [])


def test_an_interrupt_before_the_first_delivery_is_kept_leaves_nothing(path, monkeypatch):
    def interrupt(self, *delivery):
        raise KeyboardInterrupt

    monkeypatch.setattr("lidarpool.records.RecordFile.sync_if_due", interrupt)
    journal = reopen(path)
    with pytest.raises(KeyboardInterrupt) as caught, journal.kept_on_error():
        journal.backend = "numpy"
        journal._store.append_record(TRIAL, b"")  # not entered: the interrupt came before that
        assert path.exists()
        journal.look()
    assert not path.exists()
    assert not getattr(caught.value, "__notes__", [])


def test_an_interrupt_after_the_journal_was_removed_says_nothing_of_it(path):
    journal = reopen(path)
    with pytest.raises(KeyboardInterrupt) as caught, journal.kept_on_error():
        deliver(journal)
        journal.remove()
        raise KeyboardInterrupt
    assert not path.exists()
    assert not getattr(caught.value, "__notes__", [])


def test_an_unfinished_run_is_not_written_over(path):
    interrupted(path, 9)
    before = files(path)
    with pytest.raises(
        LidarpoolError,
        match=r"journal holds an unfinished run, 6 of 12 scans: continue it with --resume, "
        r"or drop it with --fresh\.",
    ):
        open_journal(path, make_job(), resume=False, terms=COMMAND_TERMS)
    assert files(path) == before
    remove_journal(path)
    assert not path.exists()
    assert open_journal(path, make_job(), resume=False).resumed == 0


def test_trials_alone_are_worth_keeping(path):
    journal = Journal(path, make_job())
    deliver(journal, [trial(1)])
    journal.close()
    with pytest.raises(LidarpoolError, match="1 of 3 planning trials"):
        open_journal(path, make_job(), resume=False)


@pytest.mark.parametrize(
    ("changes", "what"),
    [
        ({"survey": make_survey(keep_every=4)}, "another survey"),
        ({"survey": make_survey(precision_m=0.02)}, "another survey"),
        ({"survey": make_survey(poses=[(0, 0, 1), (0, 0, 3)])}, "another survey"),
        ({"survey": Survey(Sensor(layers=3), [(0, 0, 1), (0, 0, 2)], 6)}, "another survey"),
        ({"planning": make_planning(seed=1)}, "another planning"),
        ({"planning": None}, "another planning"),
        ({"scene": Scene.from_meshes([Mesh("x", np.eye(3), np.array([[0, 1, 2]]))])}, "scene"),
        ({"scene": Scene.from_meshes([Mesh("w", np.array(VERTICES, float),
                                           np.array([[0, 1, 2]]))])}, "another scene"),
        ({"backend": "cuda"}, "cast with 'numpy'"),
    ],
)  # fmt: skip
def test_the_journal_of_another_run_is_refused(changes, what, path):
    interrupted(path, 9)
    before = files(path)
    with pytest.raises(LidarpoolError, match=what):
        reopen(path, **changes)
    assert files(path) == before
    assert reopen(path, queue_capacity=3, collectors=5).resumed == 6  # leave no trace in bytes


def test_another_version_is_refused(path, monkeypatch):
    interrupted(path, 9)
    monkeypatch.setattr(identity, "version", lambda name: "9.9.9")
    with pytest.raises(LidarpoolError, match=r"written with numpy \S+, here it is 9\.9\.9"):
        reopen(path)


def test_another_format_is_refused(path, monkeypatch):
    interrupted(path, 9)
    for module in ("journal", "journal_format"):
        monkeypatch.setattr(f"lidarpool.{module}.FORMAT", 2)
    with pytest.raises(LidarpoolError, match="is of format 1, and this version reads 2"):
        reopen(path)


@pytest.mark.parametrize("kind", ["a file", "others' folder", "others' records"])
def test_what_is_no_journal_is_left_alone(kind, path):
    if kind == "a file":
        path.write_text("precious")
    else:
        path.mkdir()
        (path / (RECORDS if "records" in kind else "diary.txt")).write_text("precious")
    for attempt in (lambda: reopen(path), lambda: remove_journal(path)):
        with pytest.raises(LidarpoolError, match="is in the place of the journal and is none"):
            attempt()
    kept = path.read_text() if path.is_file() else "".join(p.read_text() for p in path.iterdir())
    assert kept == "precious"


@pytest.mark.parametrize("left", [None, b"", bytes(100), b"\x93LP", b"\x93LPR" + bytes(20)])
def test_a_run_that_died_while_it_made_its_journal_left_nothing(left, path, expected):
    path.mkdir()
    (path / FRAMES).write_bytes(b"of a run before")
    if left is not None:
        (path / RECORDS).write_bytes(left)
    journal = open_journal(path, make_job(), resume=False)
    assert journal.kept == ""
    deliver(journal)
    journal.save()
    journal.close()
    journal = reopen(path)
    assert journal.complete
    assert content(journal) == expected


def test_a_journal_in_use_is_refused(path):
    journal = Journal(path, make_job())
    deliver(journal, DELIVERIES[:9])
    with pytest.raises(LidarpoolError, match="Another run is using the journal"):
        reopen(path)
    journal.close()
    reopen(path)


def test_of_two_runs_that_begin_with_one_journal_the_first_to_deliver_has_it(path, expected):
    one, other = reopen(path), reopen(path)
    deliver(one, DELIVERIES[:9])
    with (
        pytest.raises(LidarpoolError, match="Another run is using the journal") as caught,
        other.kept_on_error(),
    ):
        deliver(other)
    assert not getattr(caught.value, "__notes__", [])
    deliver(one, DELIVERIES[9:])
    assert content(one) == expected
    one.save()
    one.close()
    assert reopen(path).complete


def test_a_run_that_has_kept_nothing_leaves_the_journal_in_its_place(path):
    journal = reopen(path)
    with pytest.raises(ZeroDivisionError), journal.kept_on_error():
        deliver(journal, DELIVERIES[:1])
        journal.trials.clear()
        (path / RECORDS).unlink()
        (path / RECORDS).write_bytes(b"another's")
        raise ZeroDivisionError
    assert (path / RECORDS).read_bytes() == b"another's"


def test_a_missing_folder_is_named(path):
    with pytest.raises(LidarpoolError, match=r"The folder \S+nowhere of the journal does not"):
        reopen(path.parent / "nowhere" / "journal")


def test_a_journal_that_cannot_be_looked_at_says_so(path, monkeypatch):
    interrupted(path, 9)

    def refuse(*_, **__):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "iterdir", refuse)
    message = "journal cannot be read: Permission denied"
    for action in (lambda: reopen(path), lambda: remove_journal(path)):
        with pytest.raises(LidarpoolError, match=message):
            action()


def test_a_journal_that_is_removed_while_it_is_written_is_not_promised(path):
    journal = reopen(path)
    with (
        pytest.raises(LidarpoolError, match=r"journal is gone: it was removed") as caught,
        journal.kept_on_error(),
    ):
        deliver(journal, DELIVERIES[:9])
        path.rename(path.with_name("elsewhere"))
        journal.save()
    assert not getattr(caught.value, "__notes__", [])


def test_a_journal_in_another_ones_place_is_not_promised(path):
    journal = reopen(path)
    with pytest.raises(ZeroDivisionError) as caught, journal.kept_on_error():
        deliver(journal, DELIVERIES[:9])
        (path / RECORDS).unlink()
        (path / RECORDS).write_bytes(b"another's")
        raise ZeroDivisionError
    assert not getattr(caught.value, "__notes__", [])


def test_a_journal_that_cannot_be_made_says_so(path, monkeypatch):
    journal = Journal(path, make_job())

    def fail(handle):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr("lidarpool.records.os.fsync", fail)
        with pytest.raises(LidarpoolError, match=r"cannot be written \(No space left on device\)"):
            deliver(journal, DELIVERIES[:1])
    assert not path.exists() and journal.kept == ""


def test_the_file_is_open_as_long_as_somebody_reads_from_it(path, expected):
    journal = Journal(path, make_job())
    deliver(journal)
    file = weakref.ref(journal._store.file)
    result = make_result(journal)
    del journal
    assert len(result.cloud) == len(result.points)
    assert file() is not None
    del result
    assert file() is None  # at once: nothing holds it in a circle

"""A journal gives back what was delivered, whatever became of it, or says why it cannot."""

import json
import os
import random
import re
import struct
import subprocess
import sys
import weakref
from pathlib import Path

import numpy as np
import pytest

from lidarpool import LidarpoolError, Planning, Scene, Sensor, Survey, identity, remove_journal
from lidarpool.deliveries import Deliveries
from lidarpool.job import Job
from lidarpool.journal import COMMAND_TERMS, Journal, open_journal
from lidarpool.journal_folder import FRAMES, RECORDS
from lidarpool.journal_format import TRIAL
from lidarpool.mesh import Mesh
from lidarpool.plan import Trial
from lidarpool.records import HEAD_BYTES
from lidarpool.run import make_result
from lidarpool.scan.messages import POINT, Frame, Part
from lidarpool.survey import Pose

SCANS, TRIALS = 12, 3
VERTICES = [[0, 0, 0], [1, 0, 0], [0, 1, 0]]


def make_job(**changes):
    scene = Scene.from_meshes([Mesh("wall", np.array(VERTICES, float), np.array([[0, 1, 2]]))])
    settings = {"scene": scene, "survey": make_survey(), "planning": make_planning()} | changes
    return Job(**settings)


def make_survey(**changes):
    settings = {"poses": [(0, 0, 1), (0, 0, 2)], "steps": SCANS // 2} | changes
    return Survey(Sensor(layers=2), **settings)


def make_planning(**changes):
    return Planning((0, 0), (9, 0), trials=TRIALS, **changes)


def part(*scans):
    """Points of some scans, 0 to 4 of each."""
    tables = []
    for scan in scans:
        table = np.zeros(scan % 5, POINT)
        table["cell"] = np.arange(3 * len(table)).reshape(-1, 3) * (scan - 7)
        table["scan"], table["ray"] = scan, np.arange(len(table))
        table["ring"] = table["ray"] % 2
        tables.append(table)
    return Part(scans, tuple(map(len, tables)), np.concatenate(tables))


def frame(scan):
    triangle, count = np.zeros(1, np.int32), np.full(1, scan + 1, np.int32)
    samples = np.full((2, 3), scan, np.float32)
    return Frame(scan, Pose((0, 0, scan)), 56, scan + 1, triangle, count, samples)


def trial(number):
    rng = np.random.default_rng(number)
    history = rng.normal(size=20).astype(np.float32)
    return Trial(number, 2**63 + number, rng.normal(), rng.normal(size=(5, 2)), True, history, 0.1)


# The order in which a run's deliveries come; a scan may come twice.
DELIVERIES = [
    part(3, 4), frame(0), part(0), trial(2), frame(1), frame(2), part(1, 2, 0), frame(3), part(8),
    trial(0), frame(4), frame(5), part(5, 6, 7), frame(6), frame(7), part(10, 9), frame(8),
    trial(1), frame(9), frame(10), part(11), frame(11),
]  # fmt: skip


def deliver(kept, deliveries=DELIVERIES):
    """Deliver what is not there yet, as the pumps would."""
    kept.backend = kept.backend or "numpy"
    done = {trial.trial for trial in kept.trials}
    for item in deliveries:
        if isinstance(item, Part):
            kept.cloud.add(item)
        elif isinstance(item, Trial):
            if item.trial not in done:
                kept.add_trial(item)
        elif item.scan >= kept.totals.frames:
            kept.totals.take(item)


def content(kept):
    """All that a result says of what was delivered, as bytes."""
    result = make_result(kept)
    cloud = result.cloud
    arrays = [cloud.positions, cloud.scan, cloud.ring, cloud.object]
    arrays += [result.hit_counts, result.sample_rays]
    for one in result.trials:
        arrays += [np.array([one.trial, one.length, one.seconds]), one.waypoints, one.history]
    return [a.tobytes() for a in arrays], result.hits, result.backend, result.plan.length


@pytest.fixture(scope="module")
def expected():
    kept = Deliveries(make_job())
    deliver(kept)
    return content(kept)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "journal"


def reopen(path, **changes):
    return open_journal(path, make_job(**changes), resume=True)


def files(path):
    return {entry.name: entry.read_bytes() for entry in path.iterdir()}


def interrupted(path, after, *, orderly=True):
    """Leave the journal of a run that ended after so many deliveries."""
    journal = Journal(path, make_job())
    deliver(journal, DELIVERIES[:after])
    if orderly:
        journal.save()
    journal.close()


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


# -- damage --------------------------------------------------------------------------------------


def outcome(path, expected):
    """What becomes of a run that is to go on from a journal, which may be damaged."""
    before = files(path)
    try:
        journal = reopen(path)
    except LidarpoolError as error:
        assert files(path) == before, "it was refused and changed all the same"
        assert len(str(error).splitlines()) <= 2
        return "refused"
    deliver(journal)
    journal.save()
    assert content(journal) == expected
    journal.close()
    return "resumed"


@pytest.mark.parametrize(
    ("harm", "what"),
    [
        (lambda file: (file.seek(900), file.write(b"\xff" * 40)), "the record at byte .* damaged"),
        (lambda file: file.truncate(700), "the file ends at byte 700, before its records do"),
        (lambda file: (file.truncate(0), file.truncate(9000)), "the record at byte 0 is damaged"),
    ],
    ids=["written over", "cut", "zeros"],
)
def test_a_journal_that_others_write_to_makes_no_result(harm, what, path):
    journal = Journal(path, make_job(), COMMAND_TERMS)
    with pytest.raises(LidarpoolError) as ended, journal.kept_on_error():
        deliver(journal)
        journal.check()  # it is whole
        with (path / RECORDS).open("r+b") as file:
            harm(file)
        before = files(path)
        journal.check()
    assert re.search(
        rf"was changed while this run wrote to it \(.*{what}.*--fresh", str(ended.value)
    )
    assert not hasattr(ended.value, "__notes__")  # there is nothing to go on from
    assert files(path) == before


@pytest.mark.parametrize("orderly", [True, False])
def test_no_flipped_byte_makes_another_cloud(orderly, path, expected):
    interrupted(path, 14, orderly=orderly)
    whole = files(path)
    dice = random.Random(7)
    seen = []
    for _ in range(150):
        name = dice.choice(sorted(whole))
        data = bytearray(whole[name])
        for _ in range(dice.choice([1, 1, 1, 5])):
            data[dice.randrange(len(data))] ^= 1 << dice.randrange(8)
        for entry, kept in whole.items():
            (path / entry).write_bytes(data if entry == name else kept)
        seen.append(outcome(path, expected))
    if orderly:  # the mark at the end vouches for every byte before it
        assert seen.count("refused") >= 140
    else:
        assert "resumed" in seen and "refused" in seen


@pytest.mark.parametrize("name", [RECORDS, FRAMES])
def test_no_cut_makes_another_cloud(name, path, expected):
    interrupted(path, 14)
    whole = files(path)
    seen = set()
    for length in range(0, len(whole[name]), 13):
        for entry, kept in whole.items():
            (path / entry).write_bytes(kept[:length] if entry == name else kept)
        seen.add(outcome(path, expected))
    # The totals are replaced as a whole: nothing but damage cuts them.
    assert seen == ({"resumed"} if name == RECORDS else {"refused"})


def test_totals_that_were_never_written_are_made_again(path, expected):
    interrupted(path, 14)
    (path / FRAMES).unlink()
    assert outcome(path, expected) == "resumed"


@pytest.mark.parametrize("junk", [b"", b"[" * 100_000, b'{"format": 1}', b"\x80\x04N.", b"1e999"])
def test_a_header_that_says_nothing_is_refused(junk, path, expected):
    """Records whose checksum is right, and their content not."""
    from lidarpool.records import RecordFile

    path.mkdir()
    file = RecordFile(path / RECORDS)
    file.append(1, junk)
    file.append(2, struct.pack("<I", 3))
    file.close()
    assert outcome(path, expected) == "refused"


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        struct.pack("<I", 10**9),
        struct.pack("<III", 1, SCANS, 0),  # there is no such scan
        struct.pack("<III", 1, 0, 7),  # seven points announced, none there
        struct.pack("<III", 1, 0, 1) + b"half a point",
    ],
)
def test_points_that_cannot_be_are_refused(payload, path, expected):
    from lidarpool.records import RecordFile

    interrupted(path, 9)
    file = RecordFile(path / RECORDS)
    list(file.records())
    file.append(2, payload)
    file.close()
    assert outcome(path, expected) == "refused"


def test_the_header_is_plain_json(path):
    interrupted(path, 3)
    data = (path / RECORDS).read_bytes()
    header, _ = json.JSONDecoder().raw_decode(data[HEAD_BYTES:].decode("latin-1"))
    assert header["backend"] == "numpy"
    assert {"lidarpool", "numpy", "open3d"} == set(header["identity"]["versions"])
    assert str(path.parent) not in data.decode("latin-1")


FILL = """
import resource, sys
sys.path.insert(0, sys.argv[2])
import test_journal as t
from lidarpool import LidarpoolError
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[3]),) * 2)
from pathlib import Path
journal = t.reopen(Path(sys.argv[1]))
try:
    with journal.kept_on_error():
        t.deliver(journal)
        journal.save()
except LidarpoolError as error:
    print(error, *getattr(error, "__notes__", []))
"""


@pytest.mark.skipif(sys.platform == "win32", reason="has no limit on the size of files")
@pytest.mark.parametrize("limit", [300, 1000, 2000, 3000])
def test_a_full_disk_loses_nothing(limit, path, expected):
    """With a limit on the size of files, which is as real as a full disk and needs no root."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(
        [sys.executable, "-c", FILL, path, Path(__file__).parent, str(limit)],
        capture_output=True, text=True, env=environment, check=False,
    )  # fmt: skip
    assert "cannot be written (File too large): make room" in done.stdout, done.stderr
    assert path.exists() == ("scans are kept" in done.stdout)
    journal = reopen(path)
    deliver(journal)
    assert content(journal) == expected

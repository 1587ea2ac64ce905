"""Journals that are damaged, cut, or written to by others: refused or resumed, never misread."""

import json
import os
import random
import re
import struct
import subprocess
import sys

import pytest
from tests.lidarpool.journal_run import (
    SCANS,
    content,
    deliver,
    expected_content,
    files,
    interrupted,
    make_job,
    reopen,
)

from lidarpool import LidarpoolError
from lidarpool.journal import COMMAND_TERMS, Journal
from lidarpool.journal_folder import FRAMES, RECORDS
from lidarpool.records import HEAD_BYTES, RecordFile


@pytest.fixture(scope="module")
def expected():
    return expected_content()


@pytest.fixture
def path(tmp_path):
    return tmp_path / "journal"


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
import tests.lidarpool.journal_run as t
from lidarpool import LidarpoolError
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[2]),) * 2)
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
        [sys.executable, "-c", FILL, path, str(limit)],
        capture_output=True, text=True, env=environment, check=False,
    )  # fmt: skip
    assert "cannot be written (File too large): make room" in done.stdout, done.stderr
    assert path.exists() == ("scans are kept" in done.stdout)
    journal = reopen(path)
    deliver(journal)
    assert content(journal) == expected

"""Files of records come back as they were written, or say what is wrong with them."""

import errno
import os
import subprocess
import sys
import tracemalloc
import zlib

import pytest

from lidarpool import records
from lidarpool.records import HEAD_BYTES, MAGIC, MARK, DamagedFileError, RecordFile

PAYLOADS = [b"one", b"", b"three" * 1000, MAGIC * 50, b"five"]


@pytest.fixture
def path(tmp_path):
    return tmp_path / "records"


def write(path, payloads, *, sync_after=()):
    file = RecordFile(path)
    for number, payload in enumerate(payloads):
        file.append(1, payload)
        if number in sync_after:
            file.sync()
    file.close()


def read(path):
    """Payloads of all records but marks, and where the last whole one ends."""
    file = RecordFile(path)
    try:
        found = [bytes(record.payload) for record in file.records() if record.kind != MARK]
        return found, file.end
    finally:
        file.close()


def test_records_come_back(path):
    write(path, PAYLOADS)
    assert read(path) == (PAYLOADS, path.stat().st_size)


def test_a_payload_in_pieces_is_one_and_is_found_again(path):
    file = RecordFile(path)
    file.append(1, b"before")
    begin = file.append(2, b"ab", memoryview(b"cd"), b"")
    buffer = bytearray(2)
    file.read_into(begin + 1, memoryview(buffer))
    assert buffer == b"bc"
    with pytest.raises(OSError, match="ends at byte"):
        file.read_into(begin + 3, memoryview(buffer))
    assert [(record.kind, record.offset) for record in file.records()] == [
        (1, HEAD_BYTES), (2, begin),
    ]  # fmt: skip


def test_a_file_cut_anywhere_gives_the_whole_records_before(path):
    write(path, PAYLOADS[:2] + PAYLOADS[3:])
    whole = path.read_bytes()
    ends = [0]
    for payload in PAYLOADS[:2] + PAYLOADS[3:]:
        ends.append(ends[-1] + HEAD_BYTES + len(payload))
    for length in range(len(whole) + 1):
        path.write_bytes(whole[:length])
        found, end = read(path)
        assert end == max(e for e in ends if e <= length)
        assert len(found) == ends.index(end)


@pytest.mark.parametrize("tail", [bytes(5000), os.urandom(300), MAGIC * 100])
def test_what_a_crash_left_is_cut_off_and_written_over(path, tail):
    write(path, PAYLOADS)
    size = path.stat().st_size
    with path.open("ab") as file:
        file.write(tail)
    file = RecordFile(path)
    assert len(list(file.records())) == len(PAYLOADS)
    assert path.stat().st_size > size  # reading changes nothing
    file.append(1, b"after")
    file.close()
    assert read(path)[0] == [*PAYLOADS, b"after"]


def flip(path, at):
    data = bytearray(path.read_bytes())
    data[at] ^= 16
    path.write_bytes(data)


def test_bad_bytes_that_had_been_synced_are_damage(path):
    write(path, PAYLOADS, sync_after=[2])
    for at in range(0, HEAD_BYTES * 3 + 5000, 97):
        flip(path, at)
        with pytest.raises(DamagedFileError, match=r"at byte [\d,]+ is damaged"):
            read(path)
        flip(path, at)
    assert read(path)[0] == PAYLOADS


def test_bad_bytes_that_had_not_been_synced_are_a_torn_end(path):
    """A disk may write the later of two pages and lose the earlier."""
    write(path, PAYLOADS, sync_after=[0])
    flip(path, HEAD_BYTES + 3 + 10)  # in the second record
    assert read(path) == ([b"one"], HEAD_BYTES + 3)


def test_a_mark_vouches_for_all_before_it(path):
    file = RecordFile(path)
    for payload in PAYLOADS:
        file.append(1, payload)
    file.mark()
    size = file.end
    file.mark()
    assert file.end == size  # nothing new to vouch for
    file.close()
    assert read(path) == (PAYLOADS, size)
    flip(path, HEAD_BYTES)
    with pytest.raises(DamagedFileError):
        read(path)


def test_a_length_that_was_changed_does_not_lead_astray(path):
    write(path, [b"a" * 100, b"b" * 100])
    data = bytearray(path.read_bytes())
    data[8:16] = (2**63).to_bytes(8, "little")
    path.write_bytes(data)
    assert read(path) == ([], 0)


def test_a_length_that_was_changed_takes_no_memory(path):
    write(path, [b"one", b"two"])
    second = HEAD_BYTES + 3
    size = 200 << 20
    with path.open("r+b") as file:
        file.truncate(size)  # with a hole, that takes no room on the disk
        file.seek(second + 8)
        file.write((size - second - HEAD_BYTES).to_bytes(8, "little"))
    tracemalloc.start()
    try:
        assert read(path) == ([b"one"], second)
        assert tracemalloc.get_traced_memory()[1] < 30 << 20
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("large", [0, 2000, 1 << 30])
def test_large_payloads_come_back(path, monkeypatch, large):
    monkeypatch.setattr(records, "_LARGE", large)
    monkeypatch.setattr(records, "_WINDOW", 700)
    write(path, PAYLOADS)
    assert read(path) == (PAYLOADS, path.stat().st_size)


def test_a_head_is_part_of_the_checksum(path):
    write(path, [b"payload"])
    data = bytearray(path.read_bytes())
    head = data[: HEAD_BYTES - 4]
    assert int.from_bytes(data[HEAD_BYTES - 4 : HEAD_BYTES], "little") == zlib.crc32(
        b"payload", zlib.crc32(head)
    )
    flip(path, 4)  # the kind
    assert read(path) == ([], 0)


def test_two_cannot_have_it_open(path):
    file = RecordFile(path)
    with pytest.raises(BlockingIOError):
        RecordFile(path)
    file.unlock()
    RecordFile(path).close()
    file.close()


@pytest.mark.skipif(sys.platform == "win32", reason="which has no such locks")
@pytest.mark.parametrize("code", [errno.ENOLCK, errno.EOPNOTSUPP])
def test_a_disk_without_locks_will_do(path, monkeypatch, code):
    def no_locks(handle, operation):
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(records.fcntl, "flock", no_locks)
    file = RecordFile(path)
    file.append(1, b"one")
    file.unlock()
    file.close()
    assert read(path)[0] == [b"one"]


def test_syncs_come_once_a_second_or_less_often_where_they_take_long(path, monkeypatch):
    now = [100.0]
    synced = []

    def fsync(handle):
        synced.append(now[0])
        now[0] += cost[0]

    monkeypatch.setattr(records.time, "monotonic", lambda: now[0])
    monkeypatch.setattr(records.os, "fsync", fsync)
    file = RecordFile(path)
    cost = [0.0]
    for _ in range(40):
        now[0] += 0.125
        file.append(1, b"x")
        file.sync_if_due()
    assert len(synced) == 5
    cost[0] = 0.5
    synced.clear()
    for _ in range(400):
        now[0] += 0.125
        file.append(1, b"x")
        file.sync_if_due()
    assert sum(cost[0] for _ in synced) <= 0.06 * 50
    file.close()


FILL = """
import resource, sys
from pathlib import Path
from lidarpool.records import RecordFile
resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, 10_000))
file = RecordFile(Path(sys.argv[1]))
kept = 0
try:
    while True:
        file.append(1, bytes([kept]) * 700)
        kept += 1
except OSError as error:
    assert Path(sys.argv[1]).stat().st_size == file.end, "a part of a record was left"
    print(kept, error.strerror)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="has no limit on the size of files")
def test_what_does_not_fit_leaves_nothing_behind(path):
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(
        [sys.executable, "-c", FILL, path], capture_output=True, text=True, env=environment,
        check=False,
    )  # fmt: skip
    kept = 10_000 // (700 + HEAD_BYTES)
    assert done.stdout == f"{kept} File too large\n", done.stderr
    assert read(path)[0] == [bytes([number]) * 700 for number in range(kept)]

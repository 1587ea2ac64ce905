"""Parts are read block by block: the values of `read_part`, or an error that names the part."""

from __future__ import annotations

import numpy as np
import pytest

from lidarfiles.parts.part_blocks import BlockMemory, read_blocks
from lidarfiles.parts.parts import pack, read_part
from lidarsim import LidarError
from lidarsim.columns.part_columns import PartColumns
from lidarsim.columns.table import ALWAYS, SCAN, TABLE
from lidarsim.io.storage import Storage

COLUMNS = (*ALWAYS, TABLE["time"], TABLE["range"], TABLE["returns"])
COUNTS = [0, 3, 0, 0, 5, 1, 0, 4, 0]  # rows of scans
ROWS = 13
NAME = "part.npz"


def part_of(counts: list[int]) -> PartColumns:
    """A part with any values."""
    chance = np.random.default_rng(1)
    scans = len(counts)
    return PartColumns(
        5,
        np.array(counts),
        {c.name: chance.integers(0, 200, sum(counts)).astype(c.dtype) for c in COLUMNS},
        np.zeros(0, np.int32),
        np.zeros(0, np.int64),
        np.zeros(scans, np.uint32),
        np.zeros((scans, 1, 3), np.float32),
    )


@pytest.fixture(params=["folder", "memory"])
def storage(request, tmp_path):
    """Storage with a part: a folder, or a storage that is none."""
    location = tmp_path if request.param == "folder" else f"memory://{tmp_path.name}"
    storage = Storage.at(location)
    storage.prepare()
    storage.write(NAME, pack(part_of(COUNTS)))
    return storage


def columns_of(storage, max_rows, columns=(SCAN, *COLUMNS), count=ROWS):
    """All columns, joined from blocks."""
    memory = BlockMemory(columns, max_rows)
    blocks = [
        {name: values.copy() for name, values in block.items()}
        for block in read_blocks(storage, NAME, count, memory)
    ]
    assert [len(block["x"]) for block in blocks[:-1]] == [max_rows] * (len(blocks) - 1)
    return {name: np.concatenate([block[name] for block in blocks]) for name in memory.starts}


@pytest.mark.parametrize("max_rows", [1, 2, 3, 5, 12, 13, 14, 100])
def test_the_blocks_are_the_part(storage, max_rows):
    part = read_part(storage, NAME)
    columns = columns_of(storage, max_rows)
    assert columns.pop("scan").tolist() == part.scan_column().tolist()
    assert columns.keys() == part.columns.keys()
    for name, values in columns.items():
        assert values.dtype == part.columns[name].dtype
        assert values.tobytes() == part.columns[name].tobytes()


def test_only_the_columns_that_are_asked_for_are_read(storage):
    data = bytearray(storage.read(NAME))
    data[data.index(b"range.npy") + 200] ^= 1
    storage.write(NAME, bytes(data))
    assert columns_of(storage, 5, ALWAYS).keys() == {column.name for column in ALWAYS}
    with pytest.raises(LidarError, match=f"The part .*{NAME} cannot be used: .*range"):
        columns_of(storage, 5)


@pytest.mark.extended
def test_a_part_with_any_damage_is_refused_or_gives_the_same_values(storage):
    """Of every byte: only bytes that nothing relies on may change."""
    data = storage.read(NAME)
    expected = {name: values.tobytes() for name, values in columns_of(storage, 5).items()}
    refused = 0
    for position in range(0, len(data), 3):
        damaged = bytearray(data)
        damaged[position] ^= 0x41
        storage.write(NAME, bytes(damaged))
        try:
            columns = columns_of(storage, 5)
        except LidarError as error:
            assert str(error).startswith(f"The part {storage.path(NAME)} cannot be")
            refused += 1
        else:
            assert {name: values.tobytes() for name, values in columns.items()} == expected
    assert refused > len(data) / 10


@pytest.mark.parametrize("size", [0, 10, 1000, -1])
def test_a_cut_part_is_refused(storage, size):
    storage.write(NAME, storage.read(NAME)[:size])
    with pytest.raises(LidarError, match="cannot be used: it is damaged"):
        columns_of(storage, 5)


@pytest.mark.parametrize("columns", [(SCAN, *COLUMNS), (TABLE["x"],)])
def test_another_number_of_rows_is_refused(storage, columns):
    with pytest.raises(LidarError, match="do not have"):
        columns_of(storage, 5, columns, ROWS + 1)


def test_a_missing_column_or_part_is_refused(storage):
    with pytest.raises(LidarError, match=r"cannot be used: it is damaged \('cause'\)"):
        columns_of(storage, 5, (*COLUMNS, TABLE["cause"]))
    storage.remove([NAME])
    with pytest.raises(LidarError, match=f"The part .*{NAME} cannot be read: .*--resume"):
        columns_of(storage, 5)

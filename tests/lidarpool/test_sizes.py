"""Files whose sizes are absurd: fields, names, counts, depths, and what a few bytes unpack to.

Each is read, or refused in a line before it takes memory or time.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from tests.drives import the_scene, the_sweeps, write_set

import lidarpool
from lidarfiles.recordings.opening import open_recording
from lidarsim import LidarError, load_trajectory
from lidarsim.columns.bags import livox_columns
from lidarsim.io import allowance


@pytest.fixture
def strict(monkeypatch):
    """Let files unpack to a hundred times their size, however small they are."""
    monkeypatch.setattr(allowance, "MIN_LIMIT_BYTES", 0)


def refused(read, path) -> str:
    """Return the error of reading a file, which names the file and is a line."""
    with pytest.raises(LidarError) as caught:
        read(path)
    message = str(caught.value)
    assert Path(path).name in message and "\n" not in message and len(message) < 2200
    return message


def points_in(path):
    """Read all points of a recording."""
    recording = open_recording(path)
    return [sweep.returns().points for sweep in recording]


# -- tables --------------------------------------------------------------------------------------


@pytest.mark.parametrize("cell", ["1" * 140_000, '"' + "1" * 140_000 + '"', '"1\n' * 140_000])
def test_cells_of_any_length_are_refused_in_a_line(tmp_path, cell):
    path = tmp_path / "long.csv"
    for header, row in (
        ("time_s,x,y,z", f"0,0,0,{cell}\n1,1,1,1\n"),
        (f"time_s,x,y,{cell}", "0,0,0,0\n1,1,1,1\n"),
    ):
        path.write_text(f"{header}\n{row}")
        refused(load_trajectory, path)
    path.write_text(f"time_s,x,y,z\n0,0,0,{'1' * 140_000}\n1,1,1,1\n")
    assert "a cell has more than 131,072 characters" in refused(load_trajectory, path)


@pytest.mark.extended
@pytest.mark.parametrize(
    "name", ["z" * 300_000, "z(" * 150_000, "z [" + " " * 300_000, "_z" * 99_999]
)
def test_names_of_any_length_are_quoted_in_part(tmp_path, name):
    path = tmp_path / "a.csv"
    for separator in ", ":
        header = separator.join(["time_s", "x", "y", "z", name])
        row = separator.join("01110")
        path.write_text(f"{header}\n{row}\n{row.replace('0', '2')}\n")
        refused(load_trajectory, path)


# -- what a few bytes unpack to --------------------------------------------------------------------


def parquet(path, columns, rows_per_group=1 << 20):
    pa = pytest.importorskip("pyarrow", reason="pyarrow is an extra")
    pq = pytest.importorskip("pyarrow.parquet", reason="pyarrow is an extra")
    pq.write_table(pa.table(columns), path, row_group_size=rows_per_group)


@pytest.mark.parametrize("rows_per_group", [1 << 20, 100_000])
def test_equal_rows_of_parquet_unpack_to_no_more_than_the_file_allows(
    tmp_path, strict, rows_per_group
):
    path = tmp_path / "zeros.parquet"
    parquet(path, dict.fromkeys("xyz", np.zeros(1_000_000)), rows_per_group)
    assert "would unpack to at least 22.89 MiB, and the limit is" in refused(open_recording, path)
    rng = np.random.default_rng(0)
    parquet(path, {axis: rng.random(10_000) for axis in "xyz"}, rows_per_group)
    assert sum(map(len, points_in(path))) == 10_000


def test_columns_of_parquet_that_are_no_numbers_are_not_read(tmp_path):
    """Their size in memory is not known before they are read."""
    path = tmp_path / "a.parquet"
    ones = np.ones(3)
    parquet(path, {"x": ones, "y": ones, "z": ones, "words": ["a" * 99] * 3, "list": [[1]] * 3})
    recording = open_recording(path)
    assert recording.notes == (f"{path} has non-numeric columns, which were skipped: list, words",)
    assert set(recording[0].columns) == set()
    parquet(path, {"x": ones, "y": ["1"] * 3, "z": ones})
    assert "its coordinate columns are not numeric: y" in refused(open_recording, path)


@pytest.mark.extended
def test_a_data_set_of_parquet_is_limited_by_its_files(tmp_path, strict):
    pytest.importorskip("pyarrow", reason="pyarrow is an extra")
    scene = the_scene()
    write_set(tmp_path / "set", "parquet", scene, the_sweeps(scene))
    sweeps = lidarpool.sweeps(tmp_path / "set", jobs=[0])
    assert len(sweeps[0].points)
    (file,) = (tmp_path / "set/points/job=0").iterdir()
    pq = pytest.importorskip("pyarrow.parquet", reason="pyarrow is an extra")
    table = pq.read_table(file, partitioning=None)
    pq.write_table(table.take(np.zeros(1_000_000, int)), file, row_group_size=1 << 20)
    with pytest.raises(LidarError, match="would unpack to") as caught:
        _ = lidarpool.sweeps(tmp_path / "set", jobs=[0])[0].points
    assert "\n" not in str(caught.value)


def mcap(chunk, stated_bytes, compression=b"zstd", is_indexed=False, index_bytes=None):
    """A bag of a chunk, which an attachment hides if only the index names it.

    `index_bytes` is the length of the chunk that the index states, if it is not the right one.
    """

    def record(kind, content):
        return bytes([kind]) + struct.pack("<Q", len(content)) + content

    name = struct.pack("<I", len(compression)) + compression
    head = struct.pack("<QQQI", 0, 0, stated_bytes, 0) + name + struct.pack("<Q", len(chunk))
    start = b"\x89MCAP0\r\n" + record(1, struct.pack("<I", 4) + b"ros2" + bytes(4))
    index = struct.pack("<QQQQIQ", 0, 0, len(start), 9 + len(head) + len(chunk), 0, 0)
    index += name + struct.pack("<QQ", index_bytes or len(chunk), stated_bytes)
    content = start + record(9 if is_indexed else 6, head + chunk)
    summary = len(content)
    content += record(8, index) + record(2, struct.pack("<QQI", summary, 0, 0))
    return content + b"\x89MCAP0\r\n"


@pytest.mark.parametrize("is_indexed", [False, True])
@pytest.mark.parametrize("stated_bytes", [10_000_000, 100])
def test_chunks_of_mcap_unpack_to_no_more_than_the_file_allows(
    tmp_path, strict, stated_bytes, is_indexed
):
    zstandard = pytest.importorskip("zstandard", reason="zstandard is an extra")
    pytest.importorskip("rosbags", reason="rosbags is an extra")
    for is_sized in (True, False):
        compressor = zstandard.ZstdCompressor(write_content_size=is_sized)
        packed = compressor.compress(bytes(10_000_000))
        path = tmp_path / "zeros.mcap"
        path.write_bytes(mcap(packed, stated_bytes, is_indexed=is_indexed))
        assert "would unpack to at least 9.54 MiB, and the limit is" in refused(
            open_recording, path
        )


def test_a_chunk_that_ends_after_the_file_is_searched_in_the_file_alone(tmp_path):
    zstandard = pytest.importorskip("zstandard", reason="zstandard is an extra")
    pytest.importorskip("rosbags", reason="rosbags is an extra")
    packed = zstandard.compress(bytes(100))
    path = tmp_path / "cut.mcap"
    path.write_bytes(mcap(packed[:-3], 100, is_indexed=True, index_bytes=1 << 60))
    refused(open_recording, path)


def test_bags_that_are_packed_as_a_whole_are_limited(tmp_path, strict):
    zstandard = pytest.importorskip("zstandard", reason="zstandard is an extra")
    pytest.importorskip("rosbags", reason="rosbags is an extra")
    bag = tmp_path / "bag"
    bag.mkdir()
    (bag / "metadata.yaml").write_text("rosbag2_bagfile_information: {}\n")
    (bag / "a.db3.zstd").write_bytes(zstandard.compress(bytes(10_000_000)))
    assert "would unpack to at least 9.54 MiB, and the limit is" in refused(open_recording, bag)


def test_points_of_a_message_of_livox_are_not_more_than_its_bytes():
    """The number of points alone would take 80 GB."""
    header = b"\0\1\0\0" + bytes(8) + struct.pack("<I", 1) + bytes(4)
    message = header + bytes(8) + struct.pack("<III", 1, 0, 2**32 - 1) + bytes(100)
    with pytest.raises(ValueError, match="points were expected, but there are fewer"):
        livox_columns(message)


def test_points_of_an_e57_are_limited_by_the_file(tmp_path, monkeypatch):
    pye57 = pytest.importorskip("pye57", reason="pye57 is an extra")
    path = tmp_path / "a.e57"
    zeros = np.zeros(1000)
    with pye57.E57(str(path), mode="w") as file:
        file.write_scan_raw({f"cartesian{axis}": zeros for axis in "XYZ"})
    assert len(open_recording(path)) == 1
    monkeypatch.setattr(allowance, "MIN_LIMIT_BYTES", 0)
    monkeypatch.setattr(allowance, "UNPACKED_TIMES", 0.5)
    assert "would unpack to at least 23.44 kiB" in refused(open_recording, path)

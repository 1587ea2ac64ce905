"""Parts: files of columns, whole or refused, and clouds that are read from them in order."""

from __future__ import annotations

import io

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lidarfiles.parts.parts import (
    StoredCloud,
    deletable_files,
    mark_name,
    pack,
    parse_part_name,
    part_name,
    probe_name,
    read_hit_counts,
    read_part,
    unpack,
)
from lidarsim import Cloud, LidarError
from lidarsim.columns.part_columns import PartColumns, cell_positions
from lidarsim.columns.table import OPTIONAL, columns_in_parts
from lidarsim.io.storage import Storage

COLUMNS = columns_in_parts(OPTIONAL)
ORIGIN = np.array([500_000.0, 5_400_000.0, 300.0])
PRECISION_M = 0.01


def part_of(first, counts, seed=0, columns=COLUMNS):
    """A part with any values in its columns."""
    rng = np.random.default_rng((seed, first))
    counts = np.array(counts, np.int64)
    made = {c.name: rng.integers(0, 200, counts.sum()).astype(c.dtype) for c in columns}
    triangles = np.unique(rng.integers(0, 50, 5)).astype(np.int32)
    hits = counts.astype(np.uint32) * 5
    samples = rng.random((len(counts), 4, 3), np.float32)
    tally = np.arange(1, len(triangles) + 1)
    return PartColumns(first, counts, made, triangles, tally, hits, samples)


@pytest.mark.extended
@settings(max_examples=50)
@given(st.integers(0, 10**6), st.lists(st.integers(0, 7), min_size=1, max_size=6))
def test_what_is_packed_comes_back(first, counts):
    part = part_of(first, counts)
    data = b"".join(pack(part))
    again = unpack(data)
    assert b"".join(pack(again)) == data
    assert (again.first, again.stop) == (first, first + len(counts))
    scans = again.scan_column()
    assert scans.dtype == np.int32
    assert scans.tolist() == [s for s, n in enumerate(counts, first) for _ in range(n)]
    if len(part):
        axes = np.stack([part.columns[axis] for axis in "xyz"], axis=1)
        assert again.cell_box.tolist() == [axes.min(axis=0).tolist(), axes.max(axis=0).tolist()]
    else:
        assert again.cell_box is None


SMALL = part_of(3, [1, 2], columns=COLUMNS[:4])


@pytest.mark.extended
def test_damage_at_any_place_is_noticed_or_changes_nothing():
    data = b"".join(pack(SMALL))
    noticed = 0
    for place in range(len(data)):
        # Each bit somewhere, and digits of the headers of arrays become others.
        flip = (1 << place % 8, 6, 0xFF)[place % 3]
        damaged = bytearray(data)
        damaged[place] ^= flip
        try:
            assert b"".join(pack(unpack(bytes(damaged)))) == data, (place, flip)
        except LidarError as error:
            noticed += 1
            assert str(error).startswith("it is damaged (")
    assert noticed > len(data) / 3


def test_a_cut_part_is_noticed_wherever_it_was_cut():
    data = b"".join(pack(SMALL))
    for length in range(len(data)):
        with pytest.raises(LidarError, match="it is damaged"):
            unpack(data[:length])


@pytest.mark.parametrize(
    "arrays",
    [
        {"x": np.zeros(2)},
        {".scans": np.array([3, 9])},
        {".scans": np.array(3)},
        {".scans": np.array([3, 4, 5])},
        {".counts": np.array([1, 2, 1])},
        {".counts": np.array([4, -1])},
        {".counts": np.array([[1, 2]])},
        {".hits": np.zeros(1)},
        {"x": np.array([{}, {}, {}])},
        {".hits": None},
        {".scan_hits": np.zeros(1)},
        {".samples": np.zeros((2, 4))},
        {".samples": np.zeros((3, 4, 3))},
    ],
    ids=str,
)
def test_arrays_that_do_not_fit_together(arrays):
    with np.load(io.BytesIO(b"".join(pack(SMALL)))) as archive:
        content = {name: archive[name] for name in archive.files} | arrays
    memory = io.BytesIO()
    np.savez(memory, **{name: array for name, array in content.items() if array is not None})
    with pytest.raises(LidarError, match="it is damaged"):
        unpack(memory.getvalue())


@pytest.fixture(params=["folder", "memory"])
def storage(request, tmp_path):
    if request.param == "folder":
        place = Storage.at(tmp_path / "parts")
    else:
        place = Storage.at(f"memory://{request.node.name}-{tmp_path.name}/parts")
    place.prepare()
    yield place
    place.remove(list(place.sizes()))


@pytest.mark.parametrize("read", [read_part, read_hit_counts])
def test_a_part_that_cannot_be_read_is_named(storage, read):
    with pytest.raises(LidarError, match=r"The part .*none\.npz cannot be"):
        read(storage, "none.npz")
    storage.write("cut.npz", b"".join(pack(SMALL))[:-30])
    with pytest.raises(LidarError, match=r"The part .*cut\.npz cannot be used.*Resume.*to cast"):
        read(storage, "cut.npz")


def test_a_run_owns_what_has_its_mark_where_the_folder_has_it_too(storage):
    mark = "0123456789abcdef"
    other = "fedcba9876543210"
    part = part_name(mark, 3, 5, 120)
    temporary = f".lidarpool-tmp-{part}-0a1b2c3d"
    own = {part, temporary, probe_name(mark, "0a1b2c3d")}
    foreign = {
        "points.npz", f"{part}.bak", f"copy-{part}", f"{mark}.npz", f"{mark}-notes", f".tmp-{part}",
        f"{temporary}.npz", part_name(other, 0, 0, 5), part.upper(), f"{part}\n",
    }  # fmt: skip
    for name in own | foreign:
        storage.write(name, b"x")
    for which in (mark, None):
        assert deletable_files(storage, which) == []
    storage.write(mark_name(mark), b"")
    for which in (mark, None):
        found = deletable_files(storage, which)
        assert {*found} == {*own, mark_name(mark)} and found[-1] == mark_name(mark)
    assert deletable_files(storage, other) == []
    assert parse_part_name(part, mark) == (3, 5, 120)
    assert {parse_part_name(name, mark) for name in (own | foreign) - {part}} == {None}
    assert parse_part_name(part, other) is None


def stored_cloud(storage, counts):
    """Write a part for each list of counts; the cloud, and its parts."""
    parts = []
    first = 0
    for number, of_scans in enumerate(counts):
        parts.append(part_of(first, of_scans))
        storage.write(f"{number}.npz", pack(parts[-1]))
        first = parts[-1].stop
    found = [part.cell_box for part in parts if part.cell_box is not None]
    cells = None
    if found:
        table = np.array(found)
        cells = np.stack([table[:, 0].min(axis=0), table[:, 1].max(axis=0)])
    names = [f"{number}.npz" for number in range(len(parts))]
    rows = [len(part) for part in parts]
    firsts = [part.first for part in parts]
    cloud = StoredCloud(storage, names, firsts, rows, COLUMNS, cells, PRECISION_M, ORIGIN)
    return cloud, parts


def same(one, other):
    return (
        np.array_equal(one.positions, other.positions)
        and list(one.columns) == list(other.columns)
        and all(
            one[name].dtype == other[name].dtype and np.array_equal(one[name], other[name])
            for name in one.columns
        )
    )


counts_of_parts = st.lists(
    st.lists(st.integers(0, 5), min_size=1, max_size=3), min_size=0, max_size=5
)


@pytest.mark.extended
def test_a_notebook_shows_stored_points_as_it_shows_points_in_memory(tmp_path):
    cloud, _ = stored_cloud(Storage.at(tmp_path), [[3, 2], [40]])
    shown = cloud._repr_html_()
    assert "45 points" in shown and "data:image/png" in shown
    assert shown.replace("StoredCloud", "Cloud") == cloud.load()._repr_html_()


@pytest.mark.extended
@settings(max_examples=40)
@given(counts_of_parts, st.integers(1, 30))
def test_a_cloud_is_the_same_however_it_is_divided(tmp_path_factory, counts, points):
    storage = Storage.at(tmp_path_factory.mktemp("parts"))
    cloud, parts = stored_cloud(storage, counts)
    whole = cloud.load()
    assert len(whole) == len(cloud) == sum(map(len, parts))
    assert whole.scan.tolist() == [s for part in parts for s in part.scan_column().tolist()]
    assert [c.name for c in whole.table] == [c.name for c in cloud.table]
    assert cloud.table[0].name == "scan" and "x" not in whole.columns
    for name in ("channel", "time", "triangle"):
        values = [v for part in parts for v in part.columns[name].tolist()]
        assert whole[name].tolist() == values
    assert np.array_equal(whole.bounds, cloud.bounds)
    assert np.array_equal(np.asarray(cloud), np.asarray(whole))
    assert f"{len(whole)} points" in repr(cloud)
    chunks = list(cloud.chunks(points))
    assert all(len(chunk) == points for chunk in chunks[:-1])
    assert len(chunks) == -(-len(cloud) // points)
    assert not chunks or same(Cloud.concatenate(chunks), whole)


def test_a_sample_is_of_the_cloud_and_in_its_order(storage):
    cloud, _ = stored_cloud(storage, [[40], [0, 0], [7, 90], [1], [0], [62]])
    whole = cloud.load()
    rows = {tuple(p): i for i, p in enumerate(np.c_[whole.positions, whole.time])}

    def picked(most, parts=256):
        some = cloud.sample(most, parts)
        found = [rows[tuple(p)] for p in np.c_[some.positions, some.time]]
        assert found == sorted(found)
        return some, found

    assert same(picked(1000)[0], whole)
    _, found = picked(50)
    assert len(found) == 50 and max(np.diff(found)) < 9, "from all of it"
    _, found = picked(50, parts=2)
    opened = np.searchsorted([40, 137, 138, 200], found, "right")
    assert 0 < len(found) <= 50 and len(set(opened)) <= 2
    none = stored_cloud(storage, [[0], [0, 0]])[0].sample(10, 256)
    assert len(none) == 0 and none.table[0].name == "scan"


@pytest.mark.parametrize("precision", [1e-6, 1e-3, 0.01, 0.05, 0.07, 0.25, 1.0, 1000.0])
def test_positions_are_the_short_decimals_that_are_meant(precision):
    cells = np.arange(-1000, 1000)[:, None] * np.ones(3, int)
    found = cell_positions(cells, precision, np.zeros(3))[:, 0]
    assert [repr(abs(float(x))) for x in found] == [
        repr(abs(float(f"{c * precision:.9g}"))) for c in range(-1000, 1000)
    ]

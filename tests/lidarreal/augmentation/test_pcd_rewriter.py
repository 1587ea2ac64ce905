"""Augmented copies of .pcd files."""

from __future__ import annotations

import numpy as np
import pypcd4
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from tests.drives import points_of, the_scene, the_sweeps
from tests.fake_augmenters import changed, content, identity, rewrite, two_boxes

from lidarfiles.clouds.recording_ref import RecordingRef
from lidarfiles.clouds.writing import ExportSpec
from lidarfiles.recordings.opening import open_ref
from lidarreal.augmentation.rewriting.opening import open_rewriter
from lidarreal.augmentation.rewriting.stored_records import StoredRecords, convert_values
from lidarsim.columns.sweep import Sweep
from lidarsim.scene.files.lzf_loops import pack_lzf, packed_limit, unpack_lzf
from lidarsim.scene.files.pcd import PCDRecords, read_pcd

ROW = [
    ("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("_", "<u4"), ("intensity", "<f4"), ("ring", "<u2"),
    ("range", "<u4"), ("near_ir", "<u2"), ("h", "<f8", (2,)), ("t", "<u8"),
]  # fmt: skip
BIG = 1_700_000_000_123_456_789  # not representable in double precision


def header(kind, count, height=1):
    return (
        "# a comment\nVERSION 0.7\nFIELDS x y z _ intensity ring range near_ir h t\n"
        "SIZE 4 4 4 4 4 2 4 2 8 8\nTYPE F F F U F U U U F U\nCOUNT 1 1 1 1 1 1 1 1 2 1\n"
        f"WIDTH {count // height}\nHEIGHT {height}\nVIEWPOINT 1 2 3 1 0 0 0\nPOINTS {count}\n"
        f"DATA {kind}\n"
    ).encode()


def rows_of(count=40, seed=0):
    rng = np.random.default_rng(seed)
    rows = np.zeros(count, ROW)
    points = rng.uniform(-20, 20, (count, 3)).astype("<f4")
    for axis, values in zip("xyz", points.T, strict=True):
        rows[axis] = values
    rows["_"] = 7
    rows["intensity"] = rng.uniform(0, 200, count)
    rows["ring"] = rng.integers(0, 64, count)
    rows["range"] = np.rint(1000 * np.linalg.norm(points.astype(float), axis=1)) + 12
    rows["near_ir"] = rng.integers(1, 900, count)
    rows["h"] = rng.uniform(0, 1, (count, 2))
    rows["t"] = BIG + np.arange(count)
    return rows


def write(path, kind, rows, height=1):
    if kind == "ascii":
        lines = [
            " ".join(str(v) for f in row for v in np.atleast_1d(f).tolist())
            for row in rows.tolist()
        ]
        body = "".join(f"{line}\n" for line in lines).encode()
    elif kind == "binary":
        body = rows.tobytes()
    else:
        plain = b"".join(np.ascontiguousarray(rows[name]).tobytes() for name, *_ in ROW)
        packed = np.zeros(packed_limit(len(plain)), np.uint8)
        size = pack_lzf(np.frombuffer(plain, np.uint8), packed)
        body = np.array([size, len(plain)], "<u4").tobytes() + packed[:size].tobytes()
    path.write_bytes(header(kind, len(rows), height) + body)
    return path


def opened(path, **options):
    ref = RecordingRef(path, keep_noise=True, **options)
    return open_rewriter(ref, open_ref(ref))


KINDS = ("ascii", "binary", "binary_compressed")


@pytest.mark.parametrize("kind", KINDS)
def test_values_in_each_encoding(tmp_path, kind):
    rows = rows_of()
    path = write(tmp_path / "a.pcd", kind, rows)
    rewriter = opened(path)
    rewrite(rewriter, tmp_path / "same.pcd", tmp_path / "work", identity)
    assert (tmp_path / "same.pcd").read_bytes() == path.read_bytes()
    notes = rewrite(rewriter, tmp_path / "new.pcd", tmp_path / "work2", changed)
    assert notes == []
    augmented = changed(rewriter.recording, 0)
    data = (tmp_path / "new.pcd").read_bytes()
    count = len(augmented.sweep)
    assert data.startswith(header(kind, count))
    new = PCDRecords.read(tmp_path / "new.pcd").records
    old = PCDRecords.read(path).records[augmented.template]
    points = augmented.sweep.points
    for axis in range(3):
        np.testing.assert_allclose(new["xyz"[axis]], points[:, axis], rtol=1e-6)
    np.testing.assert_allclose(new["intensity"], augmented.sweep.columns["intensity"], rtol=1e-6)
    for name in ("_", "ring", "h_0", "h_1", "t"):
        np.testing.assert_array_equal(new[name], old[name])
    added = ~augmented.is_recorded
    assert not new["near_ir"][added].any()
    np.testing.assert_array_equal(new["near_ir"][~added], old["near_ir"][~added])
    # Ranges are in mm, and 12 mm longer than the distance from the sensor origin.
    np.testing.assert_array_equal(new["range"][~added], old["range"][~added])
    expected = 1000 * np.linalg.norm(points[added], axis=1) + 12
    np.testing.assert_allclose(new["range"][added], expected, atol=1.5)
    (read,) = read_pcd(tmp_path / "new.pcd")
    assert len(read) == count and read.pose[:3, 3].tolist() == [1, 2, 3]


@pytest.mark.parametrize("kind", KINDS)
def test_pypcd4_reads_the_new_files(tmp_path, kind):
    scene = the_scene()
    folder = tmp_path / "drive"
    ExportSpec("pcd").write(folder, points_of(scene, 0), the_sweeps(scene))
    for file in folder.glob("*.pcd"):
        cloud = pypcd4.PointCloud.from_path(file)
        encoding = {"binary_compressed": pypcd4.Encoding.BINARY_COMPRESSED}.get(
            kind, pypcd4.Encoding(kind)
        )
        if cloud.points:  # pypcd4 writes no sizes for an empty cloud
            cloud.save(file, encoding=encoding)
    (folder / "readme.md").write_text("hello")
    before = content(folder)
    rewriter = opened(folder)
    notes = rewrite(rewriter, tmp_path / "same", tmp_path / "w", identity)
    assert content(tmp_path / "same") == before and notes == []
    boxed = lambda recording, number: changed(recording, number, two_boxes())  # noqa: E731
    notes = rewrite(rewriter, tmp_path / "new", tmp_path / "w2", boxed)
    assert notes == ["PCD files cannot store the boxes of inserted objects."]
    files = sorted(folder.glob("*.pcd"))
    for number, file in enumerate(files):
        expected = changed(rewriter.recording, number).sweep
        cloud = pypcd4.PointCloud.from_path(tmp_path / "new" / file.name)
        assert cloud.fields == pypcd4.PointCloud.from_path(file).fields
        np.testing.assert_allclose(cloud.numpy(("x", "y", "z")), expected.points, rtol=1e-6)
        strength = expected.columns["intensity"]
        np.testing.assert_allclose(cloud.pc_data["intensity"], strength, rtol=1e-6)


def test_units_and_the_chosen_intensity(tmp_path):
    rows = rows_of()
    for axis in "xyz":
        rows[axis] *= 1000
    path = write(tmp_path / "a.pcd", "binary", rows)
    rewriter = opened(path, unit="mm", intensity="near_ir")
    rewrite(rewriter, tmp_path / "same.pcd", tmp_path / "w", identity)
    assert (tmp_path / "same.pcd").read_bytes() == path.read_bytes()
    rewrite(rewriter, tmp_path / "new.pcd", tmp_path / "w2", changed)
    augmented = changed(rewriter.recording, 0)
    new = PCDRecords.read(tmp_path / "new.pcd").records
    np.testing.assert_allclose(new["x"], 1000 * augmented.sweep.points[:, 0], rtol=1e-6)
    # The augmented intensity is stored in the chosen column, rounded to its type.
    kept = augmented.is_recorded
    old = rows[augmented.template]
    np.testing.assert_array_equal(new["near_ir"][kept], np.rint(old["near_ir"][kept] / 2))
    np.testing.assert_array_equal(new["intensity"][kept], old["intensity"][kept])
    assert not new["intensity"][~kept].any()


def lost_and_moved(recording, number):
    """Lose every third return, and move every fifth point, without points in the same cell."""
    augmented = identity(recording, number)
    rows = np.flatnonzero(recording[number].has_return)
    keep = rows[rows % 3 > 0]
    sweep = augmented.sweep.select(keep)
    points = np.array(sweep.points)
    points[::5] *= 0.5
    sweep = sweep.replace(points=points)
    return type(augmented)(sweep, keep, np.ones(len(keep), bool))


@pytest.mark.parametrize(("marker", "kind"), [(np.nan, "binary"), (0, "binary_compressed")])
def test_organized_clouds(tmp_path, marker, kind):
    rows = rows_of()
    for name in ("x", "y", "z", "intensity", "range", "near_ir"):
        rows[name][::4] = marker if name in "xyz" else 0
    path = write(tmp_path / "a.pcd", kind, rows, height=4)
    rewriter = opened(path)
    for augment in (identity, lost_and_moved):
        assert (
            rewrite(rewriter, tmp_path / "new.pcd", tmp_path / "w", augment, overwrite=True) == []
        )
        data = (tmp_path / "new.pcd").read_bytes()
        assert data.startswith(header(kind, len(rows), 4))
        assert (data == path.read_bytes()) == (augment is identity)
    new = PCDRecords.read(tmp_path / "new.pcd").records
    expected = lost_and_moved(rewriter.recording, 0)
    np.testing.assert_allclose(new["x"][expected.template], expected.sweep.points[:, 0], rtol=1e-6)
    empty = np.setdiff1d(np.arange(len(rows)), expected.template)
    for axis in "xyz":
        np.testing.assert_array_equal(new[axis][empty], np.full(len(empty), marker, np.float32))
    assert not new["range"][empty].any() and not new["intensity"][empty].any()
    np.testing.assert_array_equal(new["t"], rows["t"])
    several = lambda recording, number: changed(recording, number, returns_only=True)  # noqa: E731
    (note,) = rewrite(rewriter, tmp_path / "new.pcd", tmp_path / "w2", several, overwrite=True)
    assert note.startswith("1 sweep cannot stay organized, because not every added return has")
    count = len(several(rewriter.recording, 0).sweep)
    assert (tmp_path / "new.pcd").read_bytes().startswith(header(kind, count))


@pytest.mark.parametrize("unknown", [0, 30])  # of 40 ranges, most of which are 0 then
def test_ranges_keep_the_unit_of_the_file(unknown):
    rows = rows_of()
    points = np.stack([rows[axis] for axis in "xyz"], axis=1).astype(float)
    rows["range"] = np.rint(1000 * np.linalg.norm(points, axis=1))
    rows["range"][:unknown] = 0
    sweep = Sweep(points, {"range": rows["range"]})
    moved = identity([sweep], 0)
    ranges_m = np.linalg.norm(points, axis=1) / 2  # of the simulation
    moved = type(moved)(
        moved.sweep.replace(points=points / 2, columns={"range": ranges_m}),
        moved.template,
        moved.is_recorded,
    )
    stored = StoredRecords(rows, sweep).augment(moved)["range"]
    np.testing.assert_allclose(stored, 1000 * ranges_m, atol=1.5)


def test_intensities_without_a_column_of_that_name():
    records = np.array([(1.0, 2, 3, 100), (4, 5, 6, 90)], "f4,f4,f4,u1")
    records.dtype.names = ("x", "y", "z", "reflectivity")
    sweep = Sweep(np.array([[1.0, 2, 3], [4, 5, 6]]), {"reflectivity": records["reflectivity"]})
    augmented = identity([sweep], 0)
    stored = StoredRecords(records, sweep)
    assert stored.augment(augmented).tobytes() == records.tobytes()
    columns = {**augmented.sweep.columns, "intensity": np.array([300.0, 4.6])}
    changed_strength = type(augmented)(
        augmented.sweep.replace(columns=columns), augmented.template, augmented.is_recorded
    )
    assert stored.augment(changed_strength)["reflectivity"].tolist() == [255, 5]


@given(st.sampled_from(["i1", "u2", "i4", "u8", "i8"]), st.floats(-1e30, 1e30))
def test_integers_are_clipped(kind, value):
    limits = np.iinfo(kind)
    (stored,) = convert_values(np.array([value]), np.dtype(kind)).tolist()
    expected = min(max(round(value), limits.min), limits.max)
    assert abs(stored - expected) <= 1e-15 * abs(expected)
    (kept,) = convert_values(np.array([limits.max], kind), np.dtype(kind)).tolist()
    assert kept == limits.max


@given(arrays(np.uint8, st.integers(0, 3000), elements=st.integers(0, 3)))
def test_lzf_is_the_inverse_of_its_inverse(plain):
    packed = np.zeros(packed_limit(len(plain)), np.uint8)
    size = pack_lzf(plain, packed)
    unpacked = np.zeros(len(plain), np.uint8)
    assert unpack_lzf(packed[:size], unpacked) == len(plain)
    np.testing.assert_array_equal(unpacked, plain)
    assert len(plain) < 100 or size < len(plain)

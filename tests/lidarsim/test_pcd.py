"""PCD: all encodings and layouts, as PCL and other programs write them, and what is refused."""

import io
import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lidarsim import LidarError
from lidarsim.errors import CutShortError
from lidarsim.scene.files.pcd import pcd_bytes, read_pcd

RNG = np.random.default_rng(3)
COUNT = 50
X, Y, Z = (RNG.normal(size=(3, COUNT)) * 100).astype("f4")
LETTERS = {"f": "F", "i": "I", "u": "U"}


def header(names, kinds, count, data, counts=None, viewpoint="0 0 0 1 0 0 0", fields="FIELDS"):
    kinds = [np.dtype(kind) for kind in kinds]
    counts = counts or [1] * len(names)
    return "\n".join([
        "# .PCD v0.7 - Point Cloud Data file format", "VERSION 0.7",
        f"{fields} {' '.join(names)}",
        f"SIZE {' '.join(str(kind.itemsize) for kind in kinds)}",
        f"TYPE {' '.join(LETTERS[kind.kind] for kind in kinds)}",
        f"COUNT {' '.join(map(str, counts))}",
        f"WIDTH {count}", "HEIGHT 1", f"VIEWPOINT {viewpoint}", f"POINTS {count}", f"DATA {data}\n",
    ]).encode()  # fmt: skip


def rows_of(columns, kinds, counts):
    """Return the bytes of rows whose fields have the numbers of (n, count) arrays."""
    layout = [(str(k), kinds[k], (counts[k],)) for k in range(len(kinds))]
    rows = np.zeros(len(columns[0]), np.dtype(layout))
    for k, column in enumerate(columns):
        rows[str(k)] = np.asarray(column).reshape(len(rows), counts[k])
    return rows


def lzf_literals(content):
    """Pack bytes as LZF that holds them as they are."""
    pieces = [content[start : start + 32] for start in range(0, len(content), 32)]
    return b"".join(bytes([len(piece) - 1]) + piece for piece in pieces)


def encoded(encoding, names, kinds, columns, counts=None, without_padding=False, **options):
    """Return a file in an encoding, as PCL writes it."""
    counts = counts or [1] * len(names)
    rows = rows_of(columns, kinds, counts)
    head = header(names, kinds, len(rows), encoding, counts, **options)
    if encoding == "binary":
        return head + rows.tobytes()
    if encoding == "binary_compressed":
        fields = [k for k, name in enumerate(names) if not (without_padding and name == "_")]
        content = b"".join(np.ascontiguousarray(rows[str(k)]).tobytes() for k in fields)
        packed = lzf_literals(content)
        return head + struct.pack("<II", len(packed), len(content)) + packed
    lines = (" ".join(repr(v.item()) for cell in row for v in np.atleast_1d(cell)) for row in rows)
    return head + "\n".join(lines).encode() + b"\n"


def read(tmp_path, content):
    path = tmp_path / "a.pcd"
    path.write_bytes(content)
    (scan,) = read_pcd(path)
    return scan


ENCODINGS = ("ascii", "binary", "binary_compressed")


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_padding_and_fields_of_several_numbers(tmp_path, encoding):
    # Fields with a COUNT of 0 occupy no bytes.
    names = ["x", "y", "z", "_", "intensity", "_", "ring", "_", "normal", "none", "stamp"]
    kinds = ["f4", "f4", "f4", "u1", "f4", "u1", "u2", "u1", "f4", "f4", "u8"]
    counts = [1, 1, 1, 4, 1, 0, 1, 10, 3, 0, 1]
    nothing = np.empty((COUNT, 0))
    ring = np.arange(COUNT, dtype="u2")
    stamp = np.arange(COUNT, dtype="u8") + 2**63 + 1
    normal = RNG.normal(size=(COUNT, 3)).astype("f4")
    columns = [
        X, Y, Z, np.full((COUNT, 4), 7, "u1"), X / 2, nothing, ring, np.full((COUNT, 10), 9, "u1"),
        normal, nothing, stamp,
    ]  # fmt: skip
    for without_padding in (False, True):
        content = encoded(encoding, names, kinds, columns, counts, without_padding)
        scan = read(tmp_path, content)
        np.testing.assert_array_equal(scan.points, np.stack([X, Y, Z], axis=1))
        assert [*scan.columns] == ["intensity", "ring", "normal_0", "normal_1", "normal_2", "stamp"]
        np.testing.assert_array_equal(scan.columns["intensity"].astype("f4"), X / 2)
        np.testing.assert_array_equal(scan.columns["ring"], ring)
        np.testing.assert_array_equal(scan.columns["normal_2"].astype("f4"), normal[:, 2])
        np.testing.assert_array_equal(scan.columns["stamp"], stamp)
        assert scan.columns["stamp"].dtype == np.uint64


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("kind", ["i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "f8"])
def test_numbers_of_all_types(tmp_path, encoding, kind):
    limits = np.finfo(kind) if kind == "f8" else np.iinfo(kind)
    values = np.resize(np.array([limits.min, 0, 1, limits.max], kind), COUNT)
    content = encoded(encoding, ["x", "y", "z", "value"], ["f4"] * 3 + [kind], [X, Y, Z, values])
    scan = read(tmp_path, content)
    np.testing.assert_array_equal(scan.columns["value"], values)
    assert scan.columns["value"].dtype == kind


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_names_in_upper_case_and_twice(tmp_path, encoding):
    names = ["X", "Y", "Z", "Intensity", "ring", "ring"]
    content = encoded(encoding, names, ["f4"] * 6, [X, Y, Z, X, Y, Z])
    scan = read(tmp_path, content)
    np.testing.assert_array_equal(scan.points.astype("f4"), np.stack([X, Y, Z], axis=1))
    assert [*scan.columns] == ["Intensity", "ring", "ring_2"]
    np.testing.assert_array_equal(scan.columns["ring_2"].astype("f4"), Z)


def test_files_before_version_5_have_columns_alone(tmp_path):
    text = "# .PCD v.5\nCOLUMNS x y z\nPOINTS 2\nDATA ascii\n1 2 3\n4 5.5 6\n"
    assert read(tmp_path, text.encode()).points.tolist() == [[1, 2, 3], [4, 5.5, 6]]
    text = "FIELDS x y z\r\nWIDTH 1\r\nHEIGHT 2\r\nDATA ascii\r\n1 2 3\r\nnan nan nan\r\n"
    positions = read(tmp_path, text.encode()).points
    assert positions[0].tolist() == [1, 2, 3] and np.isnan(positions[1]).all()


def test_coordinates_of_text_keep_their_digits(tmp_path):
    text = header(["x", "y", "z"], ["f4"] * 3, 1, "ascii") + b"500000.123 5400000.456 100\n"
    assert read(tmp_path, text).points.tolist() == [[500000.123, 5400000.456, 100]]


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("kind", ["u4", "f4"])
def test_colors_are_the_bits_of_rgb(tmp_path, encoding, kind):
    colors = RNG.integers(0, 256, (COUNT, 3))
    packed = (colors @ [1 << 16, 1 << 8, 1]).astype("u4")
    values = packed if kind == "u4" else packed.view("f4")
    scan = read(
        tmp_path, encoded(encoding, [*"xyz", "rgb"], ["f4"] * 3 + [kind], [X, Y, Z, values])
    )
    found = np.stack([scan.columns[name] for name in ("red", "green", "blue")], axis=1)
    np.testing.assert_array_equal(found, colors)
    assert "rgb" not in scan.columns and "alpha" not in scan.columns


def test_alpha_is_kept_where_it_differs(tmp_path):
    packed = np.array([0x80FF0000, 0xFF00FF00], "u4")
    names, kinds = [*"xyz", "rgba"], ["f4"] * 3 + ["u4"]
    scan = read(tmp_path, encoded("binary", names, kinds, [X[:2], Y[:2], Z[:2], packed]))
    assert scan.columns["alpha"].tolist() == [128, 255] and scan.columns["red"].tolist() == [255, 0]


def test_the_first_files_of_pcl_have_colors_as_rounded_numbers(tmp_path):
    text = header([*"xyz", "rgb"], ["f4"] * 4, 2, "ascii")
    scan = read(tmp_path, text + b"0.93 0.34 0 4.2108e+06\n0.91 0.35 0 4.2108e+06\n")
    assert scan.columns["red"].tolist() == [0x40, 0x40]  # a gray, 0x404040, in five digits


def test_the_viewpoint_is_the_pose_and_the_scanner(tmp_path):
    names, kinds = [*"xyz"], ["f4"] * 3
    half = np.sqrt(0.5)
    viewpoint = f"10 20 5 {half} 0 0 {half}"  # a quarter about z
    scan = read(tmp_path, encoded("binary", names, kinds, [X, Y, Z], viewpoint=viewpoint))
    np.testing.assert_allclose(scan.pose[:3, :3], [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-12)
    assert scan.pose[:3, 3].tolist() == [10, 20, 5] == scan.scanner.tolist()
    rounded = read(
        tmp_path, encoded("binary", names, kinds, [X, Y, Z], viewpoint="0 0 1 .999 0 0 0")
    )
    np.testing.assert_allclose(rounded.pose[:3, :3], np.eye(3), atol=1e-12)
    for unstated in ("0 0 0 1 0 0 0", "0 0 0 0 0 0 0"):
        scan = read(tmp_path, encoded("binary", names, kinds, [X, Y, Z], viewpoint=unstated))
        assert np.array_equal(scan.pose, np.eye(4)) and scan.scanner is None


@pytest.mark.parametrize("encoding", ["ASCII", "BINARY", "BINARY_COMPRESSED"])
def test_files_of_another_program(tmp_path, encoding):
    pypcd4 = pytest.importorskip("pypcd4", reason="pypcd4 is of the tests")
    names, kinds = ("x", "y", "z", "ring", "label"), ("f4", "f4", "f4", "u2", "i4")
    ring = (np.arange(COUNT) // 7).astype("u2")  # which LZF packs by copies
    arrays = [X, Y, np.zeros(COUNT, "f4"), ring, ring.astype("i4") - 3]
    cloud = pypcd4.PointCloud.from_points(arrays, names, kinds)
    memory = io.BytesIO()
    cloud.save(memory, pypcd4.Encoding[encoding])
    scan = read(tmp_path, memory.getvalue())
    np.testing.assert_allclose(scan.points, np.stack(arrays[:3], axis=1), rtol=1e-6)
    np.testing.assert_array_equal(scan.columns["ring"], ring)
    np.testing.assert_array_equal(scan.columns["label"], arrays[4])


def test_what_is_written_is_what_another_program_writes(tmp_path):
    pypcd4 = pytest.importorskip("pypcd4", reason="pypcd4 is of the tests")
    fields = [("x", X), ("y", Y), ("z", Z), ("id", np.arange(COUNT, dtype="i4"))]
    cloud = pypcd4.PointCloud.from_points(
        [array for _, array in fields], [name for name, _ in fields], ["f4", "f4", "f4", "i4"]
    )
    cloud.metadata.viewpoint = (1.0, 2.5, 3.0, 1.0, 0.0, 0.0, 0.0)
    memory = io.BytesIO()
    cloud.save(memory, pypcd4.Encoding.BINARY)
    content = pcd_bytes(fields, (1.0, 2.5, 3.0), (1.0, 0.0, 0.0, 0.0), "a comment")
    assert content == b"# a comment\n" + memory.getvalue()
    scan = read(tmp_path, content)
    np.testing.assert_array_equal(scan.points.astype("f4"), np.stack([X, Y, Z], axis=1))
    assert scan.scanner.tolist() == [1, 2.5, 3]


GOOD = header([*"xyz"], ["f4"] * 3, 2, "ascii") + b"1 2 3\n4 5 6\n"


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b"FIELDS x y z", b"FIELDS x y w", "its FIELDS are x, y, w.*has no z"),
        (b"FIELDS x y z\n", b"", "its header has no FIELDS"),
        (b"SIZE 4 4 4", b"SIZE 4 4", "its header has 3 entries in FIELDS, but 2 in SIZE"),
        (b"SIZE 4 4 4", b"SIZE 4 3 4", "its field 'y' has TYPE F and SIZE 3. Expected F with 4"),
        (b"TYPE F F F", b"TYPE F F X", "its field 'z' has TYPE X"),
        (b"COUNT 1 1 1", b"COUNT 1 -1 1", "is 'COUNT 1 -1 1'. Expected whole numbers"),
        (b"COUNT 1 1 1", b"COUNT 1 0 1", r"line 12 has 3 cells, but 2 were expected \(x, z\)"),
        (b"COUNT 1 1 1", b"COUNT 0 0 0", "its header has a COUNT of 0 for all fields"),
        (b"COUNT 1 1 1", b"COUNT 2 1 1", r"line 12 has 3 cells, but 4 were expected \(x_0, x_1, y"),
        (b"WIDTH 2", b"WIDTH 3", "2 POINTS, but a WIDTH of 3 by a HEIGHT of 1"),
        (b"WIDTH 2", b"WIDTH two", "line 7 of its header is 'WIDTH two'. Expected a whole number"),
        (b"POINTS 2", b"POINTS 2\nPOINTS 2", "its header repeats POINTS in lines 10 and 11"),
        (b"HEIGHT 1", b"DEPTH 1", "line 8 of its header begins with 'DEPTH', but VERSION, FIELDS"),
        (b"0 0 0 1 0 0 0", b"0 0 0 2 0 0 0", "line 9 of its header is 'VIEWPOINT .*of length 1"),
        (b"0 0 0 1 0 0 0", b"0 0 1 0 0 0 0", "a quaternion w x y z of length 1"),
        (b"0 0 0 1 0 0 0", b"0 0 0 1 0 0", "a position x y z and a quaternion"),
        (b"0 0 0 1 0 0 0", b"nan 0 0 1 0 0 0", "a position x y z and a quaternion"),
        (
            b"DATA ascii",
            b"DATA zip",
            "its DATA is 'zip', but must be ascii, binary or binary_compressed",
        ),
        (b"4 5 6", b"4 5 a", "line 13 has 'a' as z, but a number was expected"),
        (b"4 5 6", b"4 5", r"line 13 has 2 cells, but 3 were expected \(x, y, z\)"),
        (b"4 5 6\n", b"4 5 6\n7 8 9\n", "2 points are declared, but 3 lines follow"),
        (b"TYPE F F F", b"TYPE F F U", None),
        (b"TYPE F F F\n", b"TYPE F F U\n#", None),
    ],
)
def test_what_is_wrong_is_named(tmp_path, old, new, message):
    assert old in GOOD
    content = GOOD.replace(old, new)
    if message is None:  # another type that fits
        assert read(tmp_path, content).points.tolist()[0] == [1, 2, 3]
        return
    with pytest.raises(ValueError, match=message) as caught:
        read(tmp_path, content)
    assert not isinstance(caught.value, CutShortError)


def test_whole_numbers_that_are_none_are_named(tmp_path):
    text = header([*"xyz", "label"], ["f4"] * 3 + ["u1"], 2, "ascii")
    for cell in ("2.5", "256", "-1"):
        with pytest.raises(ValueError, match="its field 'label' must contain whole numbers"):
            read(tmp_path, text + f"1 2 3 4\n1 2 3 {cell}\n".encode())


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_what_ends_too_early_is_cut_short(tmp_path, encoding):
    content = encoded(encoding, [*"xyz"], ["f4"] * 3, [X, Y, Z])
    for length in (40, 150, content.index(b"DATA"), len(content) - 100, len(content) - 400):
        with pytest.raises(CutShortError):
            read(tmp_path, content[:length])


def test_bytes_after_the_points_are_refused_and_zeros_are_padding(tmp_path):
    content = encoded("binary", [*"xyz"], ["f4"] * 3, [X, Y, Z])
    assert len(read(tmp_path, content + bytes(4000)).points) == COUNT
    with pytest.raises(ValueError, match="50 points are declared, but 12 bytes follow them"):
        read(tmp_path, content + 12 * b"\x01")


def test_a_small_file_does_not_take_much_memory(tmp_path):
    count = 100_000_000
    head = header([*"xyz"], ["f4"] * 3, count, "binary_compressed")
    with pytest.raises(LidarError, match="Write it uncompressed"):
        read(tmp_path, head + struct.pack("<II", 10, 12 * count) + bytes(10))


@settings(max_examples=60, deadline=None)
@given(st.binary(max_size=200), st.integers(0, 5))
def test_no_packed_bytes_leave_the_array(tmp_path_factory, packed, count):
    """Damaged bytes give an error, or numbers, and never a crash."""
    path = tmp_path_factory.mktemp("lzf") / "a.pcd"
    head = header([*"xyz"], ["f4"] * 3, count, "binary_compressed")
    path.write_bytes(head + struct.pack("<II", len(packed), 12 * count) + packed)
    try:
        (scan,) = read_pcd(path)
    except ValueError:
        return
    assert scan.points.shape == (count, 3)

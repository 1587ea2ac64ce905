"""Clouds as text (.xyz, .txt, .asc, .csv), of Leica (.pts, .ptx), of NumPy, in rows of floats."""

import io

import numpy as np
import pytest

from lidarsim import LidarError
from lidarsim.columns.column_names import standard_names
from lidarsim.errors import CutShortError
from lidarsim.scene.files.cloud_formats import SCAN_READERS

TEXT_ENDINGS = (".xyz", ".txt", ".asc", ".csv")


def read_all(tmp_path, name, content):
    path = tmp_path / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return SCAN_READERS[path.suffix](path)


def read(tmp_path, name, content):
    (scan,) = read_all(tmp_path, name, content)
    return scan


def columns_of(scan):
    return {name: values.tolist() for name, values in scan.columns.items()}


# -- text ----------------------------------------------------------------------------------------

TWO = [[1.5, 2, 3], [4, 5.25, 6]]


@pytest.mark.parametrize("ending", TEXT_ENDINGS)
@pytest.mark.parametrize(
    "text",
    [
        "1.5 2 3\n4 5.25 6\n",
        "1.5\t2\t3\r\n4\t5.25\t6\r\n",
        "1.5,2,3\n4,5.25,6",
        "1.5, 2, 3\n\n4, 5.25, 6\n",
        "1.5;2;3;\n4;5.25;6;\n",
        "x y z\n1.5 2 3\n4 5.25 6\n",
        "\ufeffx,y,z\n1.5,2,3\n4,5.25,6\n",
        '"X";"Y";"Z"\n"1.5";"2";"3"\n"4";"5.25";"6"\n',
        "# z y x\n3 2 1.5\n6 5.25 4\n",
        "//X Y Z\n2\n1.5 2 3\n4 5.25 6\n",
        "# made by a program\n#x,y,z\n1.5,2,3\n4,5.25,6\n# the end\n",
        "# x y z in meters, from the east\n1.5 2 3\n4 5.25 6\n",
        "2\n1.5 2 3\n4 5.25 6\n",
        "Easting;Northing;Height\n1.5;2;3\n4;5.25;6\n",
        # Decimal commas, beside another separator.
        "1,5;2;3\n4;5,25;6\n",
        "1;2;3\n4;5,25;6\n".replace("1;", "1,5;"),
        "1,5 2 3\n4 5,25 6\n",
        "x\ty\tz\n1,5\t2\t3\n4\t5,25\t6\n",
    ],
)
def test_headers_and_separators(tmp_path, ending, text):
    scan = read(tmp_path, f"a{ending}", text)
    assert scan.points.tolist() == TWO
    assert not scan.columns and scan.pose is None and scan.units_m is None


def test_columns_are_named_by_the_header(tmp_path):
    scan = read(
        tmp_path,
        "a.txt",
        "//X Y Z R G B Intensity Classification Nx Ny Nz Scalar_field\n"
        "1.5 2 3 255 0 10 0.5 2 0 0 1 7.5\n4 5.25 6 0 255 20 0.25 6 0 1 0 8\n",
    )
    assert scan.points.tolist() == TWO
    assert columns_of(scan) == {
        "R": [255, 0], "G": [0, 255], "B": [10, 20], "Intensity": [0.5, 0.25],
        "Classification": [2, 6], "Nx": [0, 0], "Ny": [0, 1], "Nz": [1, 0],
        "Scalar_field": [7.5, 8],
    }  # fmt: skip
    assert standard_names(scan.columns) == [
        "red", "green", "blue", "intensity", "class", "normal_x", "normal_y", "normal_z",
        "Scalar_field",
    ]  # fmt: skip
    kinds = {name: values.dtype.kind for name, values in scan.columns.items()}
    assert kinds["Classification"] == "i" and kinds["Intensity"] == "f"


@pytest.mark.parametrize("name", ["Points:{}", "Points_m_XYZ:{}"])
@pytest.mark.parametrize("quote", ["", '"'])
def test_veloview_names_points_in_two_ways(tmp_path, name, quote):
    axes = [f"{quote}{name.format(index)}{quote}" for index in range(3)]
    header = ",".join([f"{quote}intensity{quote}", *axes, f"{quote}laser_id{quote}"])
    scan = read(tmp_path, "a.csv", f"{header}\n9,1.5,2,-3,7\n8,4,5,6,6\n")
    assert scan.points.tolist() == [[1.5, 2, -3], [4, 5, 6]]
    assert columns_of(scan) == {"intensity": [9, 8], "laser_id": [7, 6]}


def test_columns_of_words_are_left_out_and_empty_cells_are_nan(tmp_path):
    text = 'name,x,y,z,i,label\n"a, b",1.5,2,3,,Ground\nc,4,5.25,6,7,\n'
    scan = read(tmp_path, "a.csv", text)
    assert scan.points.tolist() == TWO and scan.skipped == ("name", "label")
    np.testing.assert_array_equal(scan.columns["i"], [np.nan, 7])
    without_header = read(tmp_path, "b.xyz", "1.5 2 3 9 8\n4 5.25 6 9 7\n")
    assert columns_of(without_header) == {"column_4": [9, 9], "column_5": [8, 7]}


def test_a_cloud_may_have_angles_beside_its_coordinates(tmp_path):
    scan = read(tmp_path, "a.csv", "lat,lon,x,y,z,roll,pitch,yaw\n1,2,3,4,5,6,7,8\n")
    assert scan.points.tolist() == [[3, 4, 5]]
    assert [*scan.columns] == ["lat", "lon", "roll", "pitch", "yaw"]


def test_units_in_names_are_units_of_the_axes(tmp_path):
    scan = read(tmp_path, "a.csv", "x [mm],y [mm],z [m]\n1500,2000,3\n")
    assert scan.points.tolist() == [[1500, 2000, 3]] and scan.units_m == (1e-3, 1e-3, 1.0)
    assert read(tmp_path, "a.txt", "# X [ft] Y [ft] Z\n1 2 3\n").units_m == (0.3048, 0.3048, 1.0)


@pytest.mark.extended
def test_many_lines_are_read_in_blocks_and_the_line_is_exact(tmp_path):
    count = 70_000
    values = np.random.default_rng(1).uniform(-100, 100, (count, 4)).round(3)
    memory = io.StringIO()
    np.savetxt(memory, values, "%.3f", header="x y z i")
    lines = memory.getvalue().splitlines()
    scan = read(tmp_path, "a.xyz", "\n".join(lines))
    np.testing.assert_array_equal(np.column_stack([scan.points, scan.columns["i"]]), values)
    lines[69_000] = "1 2 3"
    with pytest.raises(ValueError, match=r"line 69001 has 3 cells, but 4 were expected \(x, y, z"):
        read(tmp_path, "a.xyz", "\n".join(lines))
    lines[69_000] = "1 2 3 4,5"
    with pytest.raises(ValueError, match="line 2 has decimal points and line 69001 decimal commas"):
        read(tmp_path, "a.xyz", "\n".join(lines))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "it is empty"),
        ("x,y,z\n", "it has no points after line 1"),
        ("none\n", "line 1 is 'none', but x, y and z or a header"),
        ("2\ncomment\nC 0 0 0\nH 1 1 1\n", "line 2 is 'comment', but x, y and z"),
        ("a,b,c\n1,2,3\n", "line 1 is 'a,b,c', but x, y and z or a header"),
        ("x,y,z\n1,2,3\n1,2,a\n", "line 3 has 'a' as z, but a number was expected"),
        ("x,y,z\n1,2,3\n1,2,\n", "line 3 has '' as z, but a number was expected"),
        ("x y z\n1 2 3\n1 2 1_0\n", "line 3 has '1_0' as z"),
        ("1 2 3\n4 5\n", "line 2 has 2 cells, but 3 were expected"),
        ("x,y,z,i\n1,2,3\n", r"line 1 names 4 columns \(x, y, z, i\), but line 2 has 3 cells"),
        ("x,y,z\n1,5,2,5,3,5\n", "line 2 has 6 cells. To use decimal commas, separate"),
        ("1,5,2,5,3,5\n1,5,2,5,3,5\n", "its commas may separate decimals as well as columns"),
        ("1.5;2;3\n1,5;2;3\n", "line 1 has decimal points and line 2 decimal commas"),
        ("1,234.5;2;3\n", "line 1 is '1,234.5;2;3'"),
        ("lat,lon,height\n1,2,3\n", "line 1 names latitude and longitude, .*Project the cloud"),
        ("x_deg,y_deg,z\n1,2,3\n", "line 1 names 'x_deg', but x in a unit of length was expected"),
        (
            "t,x,y,z,qx,qy,qz,qw\n0,1,2,3,0,0,0,1\n",
            "line 1 names a quaternion .*file is a trajectory",
        ),
        ("0 1 2 3 0 0 0 1\n1 1 2 3 0 0 0.6 0.8\n", "appear to be the poses of a trajectory"),
        ("1 0 0 5 0 1 0 6 0 0 1 7\n", "appear to be the poses of a trajectory"),
        ("1 5 6 7\n2 5 6 7\n3 5 6 7\n", "its first column appears to number the points"),
        ("ncols 3\nnrows 2\n1 2 3\n4 5 6\n", "it is an elevation raster, not a point cloud"),
        ("//X Y Z\n1\n1 2 3\n4 5 6\n", "declares 1 point, but the number of lines is 2"),
        ("x y z\n1 2 3\n".encode("utf-16"), "it is encoded in UTF-16. Save it as UTF-8"),
        (b"1 2 3\n\0\0", "it is a binary file, but a text file was expected"),
    ],
)
def test_what_is_wrong_names_the_line_and_what_was_expected(tmp_path, text, message):
    with pytest.raises(ValueError, match=message) as caught:
        read(tmp_path, "a.txt", text)
    assert not isinstance(caught.value, CutShortError)


def test_fewer_lines_than_announced_are_cut_short(tmp_path):
    with pytest.raises(CutShortError, match="declares 3 points, but the number of lines is 2"):
        read(tmp_path, "a.xyz", "//X Y Z\n3\n1 2 3\n4 5 6\n")


def test_whole_numbers_between_commas_are_understood_where_they_are_certain(tmp_path):
    assert read(tmp_path, "a.csv", "1,2,3\n4,5,6\n").points.tolist() == [[1, 2, 3], [4, 5, 6]]
    scan = read(tmp_path, "b.csv", "x,y,z,r,g,b\n1,2,3,4,5,6\n")
    assert columns_of(scan) == {"r": [4], "g": [5], "b": [6]}


def test_names_stay_distinct():
    names = ["X", "y", "z", "R", "intensity", "Intensity", "intensity"]
    assert standard_names(names) == ["x", "y", "z", "red", "intensity", "Intensity", "intensity_2"]


# -- Leica's .pts and .ptx -----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("line", "columns"),
    [
        ("", {}),
        (" -2000", {"intensity": [48, 48]}),
        (" 200", {"intensity": [200, 200]}),
        (" 255 0 7", {"red": [255, 255], "green": [0, 0], "blue": [7, 7]}),
        (" -5 1 2 3", {"intensity": [2043, 2043], "red": [1, 1], "green": [2, 2], "blue": [3, 3]}),
    ],
)
def test_pts(tmp_path, line, columns):
    rows = [" ".join(map(str, row)) + line for row in TWO]
    for content in ("2\n" + "\n".join(rows), "\n".join(rows) + "\n"):
        scan = read(tmp_path, "a.pts", content)
        assert scan.points.tolist() == TWO and columns_of(scan) == columns
    both = read_all(tmp_path, "a.pts", f"1\n{rows[0]}\n1\n{rows[1]}\n")
    assert [scan.points.tolist() for scan in both] == [[TWO[0]], [TWO[1]]]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "it is empty, but the number of points was expected"),
        ("2\n1 2\n", r"line 2 is '1 2', which has 2 cells, but x y z or x y z intensity or x"),
        ("2\n1 2 3\n1 2 a\n", "line 3 has 'a' as z, but a number was expected"),
        ("2\n1 2 3 4\n1 2 3\n", "line 3 has 3 cells, but 4 were expected"),
    ],
)
def test_what_is_wrong_in_pts(tmp_path, content, message):
    with pytest.raises(ValueError, match=message):
        read_all(tmp_path, "a.pts", content)


def test_pts_with_fewer_points_is_cut_short(tmp_path):
    for content in ("3\n1 2 3\n4 5 6\n", "1\n1 2 3\n4\n"):
        with pytest.raises(
            CutShortError, match=r"line . declares . points, (and|but) (2|none) follow"
        ):
            read_all(tmp_path, "a.pts", content)


# A quarter about z: x of the scanner is y of the world.
PTX = """2
2
10 20 5
0 1 0
-1 0 0
0 0 1
0 1 0 0
-1 0 0 0
0 0 1 0
10 20 5 1
1 0 0 0.5
0 0 0 0.5
2 0 0 0.25
0 3 1 1
"""


def test_ptx_has_poses_and_intensities(tmp_path):
    first, second = read_all(tmp_path, "a.ptx", PTX + PTX.replace("10 20 5", "0 0 1"))
    assert first.points.tolist() == [[1, 0, 0], [2, 0, 0], [0, 3, 1]], "zeros are no returns"
    world = first.points @ first.pose[:3, :3].T + first.pose[:3, 3]
    assert world.tolist() == [[10, 21, 5], [10, 22, 5], [7, 20, 6]]
    assert columns_of(first) == {"intensity": [0.5, 0.25, 1]}
    assert first.scanner.tolist() == [10, 20, 5] and second.scanner.tolist() == [0, 0, 1]
    colors = "\n".join(line + " 1 2 3" * (k >= 10) for k, line in enumerate(PTX.splitlines()))
    (scan,) = read_all(tmp_path, "b.ptx", colors)
    assert scan.columns["blue"].tolist() == [3, 3, 3] and scan.columns["blue"].dtype == np.uint8


def test_ptx_without_a_transformation_has_the_position_of_its_scanner(tmp_path):
    unit = "1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"
    lines = PTX.splitlines()
    content = "\n".join([*lines[:6], unit.rstrip(), *lines[10:]])
    (scan,) = read_all(tmp_path, "a.ptx", content)
    assert np.array_equal(scan.pose, np.eye(4)) and scan.scanner.tolist() == [10, 20, 5]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("2\n2\n", "2\ntwo\n", "line 2 is 'two', but the number of rows .1 number. was expected"),
        (
            "10 20 5\n0 1 0\n",
            "10 20\n0 1 0\n",
            "line 3 is '10 20', but the position of the scanner",
        ),
        ("10 20 5 1", "10 20 5", "line 10 is '10 20 5', but the last row of the transformation"),
        ("0 1 0 0\n", "0 2 0 0\n", "the transformation in the header that starts in line 1 must"),
        ("2 0 0 0.25", "2 0 0", r"line 13 has 3 cells, but 4 were expected \(x, y, z, intensity\)"),
        ("2 0 0 0.25", "2 0 b 1", "line 13 has 'b' as z, but a number was expected"),
        (
            "1 0 0 0.5",
            "1 0 0 0.5 9",
            r"line 11 is '1 0 0 0\.5 9', which has 5 cells, but x y z intensity",
        ),
    ],
)
def test_what_is_wrong_in_ptx(tmp_path, old, new, message):
    assert old in PTX
    with pytest.raises(ValueError, match=message) as caught:
        read_all(tmp_path, "a.ptx", PTX.replace(old, new))
    assert not isinstance(caught.value, CutShortError)


def test_ptx_that_ends_too_early_is_cut_short(tmp_path):
    lines = PTX.splitlines()
    for count in (1, 5, 9, 10, 13):
        with pytest.raises(CutShortError):
            read_all(tmp_path, "a.ptx", "\n".join(lines[:count]))
    many = PTX.replace("2\n2\n", "100000\n100000\n", 1)
    with pytest.raises(CutShortError, match="line 1 and the next line declare 100,000 x 100,000"):
        read_all(tmp_path, "a.ptx", many)


# -- arrays and floats ---------------------------------------------------------------------------


def npy(array, **options):
    memory = io.BytesIO()
    np.save(memory, array, **options)
    return memory.getvalue()


@pytest.mark.parametrize("kind", ["f4", ">f8", "i2", "u1"])
@pytest.mark.parametrize("order", ["C", "F"])
def test_npy(tmp_path, kind, order):
    array = np.arange(20).reshape(5, 4).astype(kind, order=order)
    scan = read(tmp_path, "a.npy", npy(array))
    np.testing.assert_array_equal(scan.points, array[:, :3])
    np.testing.assert_array_equal(scan.columns["column_4"], array[:, 3])
    image = read(tmp_path, "b.npy", npy(array.reshape(1, 5, 4)))
    np.testing.assert_array_equal(image.points, array[:, :3])


def test_npy_with_fields(tmp_path):
    records = np.zeros(3, [("X", "f4"), ("Y", "f4"), ("Z", "f4"), ("ring", "u2"), ("n", "f4", 2)])
    records["Z"] = [1, 2, 3]
    records["n"][:, 1] = 7
    scan = read(tmp_path, "a.npy", npy(records))
    assert scan.points[:, 2].tolist() == [1, 2, 3]
    assert columns_of(scan) == {"ring": [0, 0, 0], "n_0": [0, 0, 0], "n_1": [7, 7, 7]}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (
            npy(np.zeros((3, 2))),
            r"its array has the shape \(3, 2\). Expected an array \(n, k\)",
        ),
        (npy(np.zeros(12)), r"its array has the shape \(12,\)"),
        (npy(np.zeros((9, 3), "c8")), "its array has the type 'complex64'"),
        (npy(np.array([[{}, 1, 2]], object), allow_pickle=True), "its array has the type 'object'"),
        (npy(np.zeros(3, [("a", "f4")])), "Expected an array"),
        (npy(np.zeros((9, 3))) + b"1", "its array .*requires 216 bytes, but 217 are present"),
        (b"PK\x03\x04", "its first bytes are not"),
        (
            npy(np.zeros((9, 3))).replace(b"shape", b"shale"),
            "its header does not describe an array",
        ),
    ],
)
def test_what_is_wrong_in_npy(tmp_path, content, message):
    with pytest.raises(ValueError, match=message):
        read(tmp_path, "a.npy", content)


def test_npy_that_ends_too_early_is_cut_short(tmp_path):
    content = npy(np.zeros((9, 3)))
    for length in (30, len(content) - 1):
        with pytest.raises(CutShortError):
            read(tmp_path, "a.npy", content[:length])
    huge = content.replace(b"(9, 3), }" + 10 * b" ", b"(9999999999, 3), }" + b" ")
    assert huge != content
    with pytest.raises(CutShortError, match="239,999,999,976 bytes, but 216 are present"):
        read(tmp_path, "a.npy", huge)


def test_bin_has_four_floats_and_of_nuscenes_five(tmp_path):
    rows = np.array([[1, 2, 3, 0.5, 4], [5, 6, 7, 0.25, 31]], "f4")
    scan = read(tmp_path, "000000.bin", rows[:, :4].tobytes())
    assert scan.points.tolist() == [[1, 2, 3], [5, 6, 7]]
    assert columns_of(scan) == {"intensity": [0.5, 0.25]}
    scan = read(tmp_path, "a.pcd.bin", rows.tobytes())
    assert columns_of(scan) == {"intensity": [0.5, 0.25], "channel": [4, 31]}
    with pytest.raises(ValueError, match=r"a\.bin has 40 bytes, but a multiple of 16 .*intensity"):
        read(tmp_path, "a.bin", rows.tobytes())
    with pytest.raises(ValueError, match=r"a\.pcd\.bin has 32 bytes, but a multiple of 20"):
        read(tmp_path, "a.pcd.bin", rows[:, :4].tobytes())
    with pytest.raises(ValueError, match="must be a ring number"):
        read(tmp_path, "a.pcd.bin", np.resize(rows[:, :4], (4, 5)).tobytes())


@pytest.mark.parametrize("ending", SCAN_READERS)
def test_a_file_that_is_larger_than_the_memory_is_refused(tmp_path, monkeypatch, ending):
    monkeypatch.setattr("lidarsim.io.input_files.memory", lambda: 10)
    with pytest.raises(LidarError, match="exceeds the memory of this machine"):
        read(tmp_path, f"a{ending}", "1 2 3\n" * 20)

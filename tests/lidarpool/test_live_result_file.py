"""Clouds on disk, chosen by scan and thinned."""

import json

import numpy as np
import pytest

from lidarpool import Cloud, Column, LidarpoolError, Scene, save_cloud
from lidarpool.columns.table import CHANNEL, OBJECT, SCAN, TABLE
from lidarpool.export.ply_format import header, row_type
from lidarpool.live.display import POSITION
from lidarpool.live.result_file import ResultFile
from lidarpool.run.picture_file import Pictured


@pytest.fixture
def write(tmp_path):
    """Return a function that writes a cloud, and a report, into a folder."""

    def write(count, scans=100, offset=0.0, report=None, real=np.float64):
        row = row_type(np.dtype(real), (SCAN, CHANNEL, OBJECT))
        rows = np.zeros(count, row)
        rows["scan"] = np.arange(count) * scans // max(1, count)
        rows["ring"] = np.arange(count) % 40
        rows["object"] = np.arange(count) % 2
        rows["x"] = offset + rows["scan"]
        rows["z"] = 1.0
        (tmp_path / "cloud.ply").write_bytes(header(row, count) + rows.tobytes())
        if report is not None:
            (tmp_path / "report.json").write_text(json.dumps(report))
        return tmp_path

    return write


def menu(file):
    """Names of what points can be coloured by."""
    return [column.name for column in file.quantities]


def test_scans_are_chosen_and_thinned(write):
    file = ResultFile(write(50_000, scans=100))
    assert len(file) == 50_000
    assert file.scans == (0, 99)
    rows, count = file.choose(20, 29, 10_000)
    assert count == len(rows) == 5_000
    assert (rows["scan"].min(), rows["scan"].max()) == (20, 29)
    rows, count = file.choose(0, 99, 4_000)
    assert (count, len(rows)) == (50_000, 4_000)
    assert np.bincount(rows["scan"]).min() >= 35
    assert np.bincount(rows["channel"]).min() > 50
    assert np.array_equal(rows[POSITION][:, 0], rows["scan"])


def test_no_points_are_no_reason_to_fail(write):
    file = ResultFile(write(0))
    assert (len(file), file.scans) == (0, (0, 0))
    assert file.choose(0, 0, 10)[1] == 0


def test_far_coordinates_are_shown_to_the_millimetre(write):
    file = ResultFile(write(1000, offset=4_500_000.25))
    rows, _ = file.choose(0, 99, 1000)
    assert np.array_equal(rows[POSITION][:, 0] + file.origin[0] - 4_500_000.25, rows["scan"])


def test_points_that_are_nowhere_are_left_out(write):
    folder = write(1000, offset=np.nan)
    assert len(ResultFile(folder).choose(0, 99, 1000)[0]) == 0


REPORT = {
    "points_by_object": {"Ball": 1, "Box": 1},
    "parameters": {
        "origin": [0, 0, 0],
        "poses": 2,
        "first_poses": [{"position": [0, 0, 1]}, {"position": [100, 0, 1]}],
        "steps": 50,
    },
    "planning": {"path": [[0, 0], [1, 1]]},
}


def test_the_report_tells_names_ranges_and_the_path(write):
    file = ResultFile(write(1000, report=REPORT))
    assert file.names == ("Ball", "Box")
    assert file.route.tolist() == [[0, 0], [1, 1]]
    rows, _ = file.choose(0, 99, 1000)
    expected = np.where(rows["scan"] < 50, rows["scan"], 100 - rows["scan"])
    assert np.allclose(rows["range"], expected)


def test_ranges_are_unknown_where_not_all_poses_are_told(write):
    report = REPORT | {"parameters": REPORT["parameters"] | {"poses": 11}}
    assert "range" not in menu(ResultFile(write(1000, report=report)))


def test_columns_of_a_run_are_in_the_menu_as_the_table_describes_them(tmp_path):
    count = 50
    mine = Column("wetness", "float32", "%", "how wet it is", source="wetness")
    columns = {
        "scan": np.arange(count) // 10,
        "channel": np.arange(count) % 5,
        "object": np.zeros(count, np.int32),
        "time": np.arange(count) * 10**9,
        "class": np.arange(count) % 3,
        "wetness": np.linspace(0, 100, count),
    }
    cloud = Cloud(np.random.default_rng(0).random((count, 3)), columns, (mine,))
    save_cloud(tmp_path / "cloud.ply", cloud)
    entry = {"name": "wetness", "file_name": "wetness", "unit": "%", "meaning": "how wet it is"}
    (tmp_path / "report.json").write_text(json.dumps({"columns": [entry]}))
    file = ResultFile(tmp_path)
    assert menu(file) == ["height", "scan", "channel", "object", "time", "class", "wetness"]
    described = {column.name: column for column in file.quantities}
    assert described["channel"].meaning == CHANNEL.meaning
    assert described["class"].kind == "label"
    assert described["time"].unit == TABLE["time"].unit
    assert (described["wetness"].unit, described["wetness"].meaning) == ("%", "how wet it is")
    rows, _ = file.choose(0, 4, 1000)
    for name, values in columns.items():
        assert np.allclose(rows[name], values), name


def test_properties_that_nobody_knows_are_in_the_menu(tmp_path):
    """A cloud of another program, without scans."""
    row = np.dtype(
        [(a, "<f4") for a in "xyz"] + [("nx", "<f4"), ("2-temp", "|u1"), ("ring", "<u2")]
    )
    lines = ["property float x", "property float y", "property float z", "property float nx"]
    lines += ["property uchar 2-temp", "property ushort ring"]
    rows = np.zeros(20, row)
    rows["x"] = rows["2-temp"] = np.arange(20)
    head = "\n".join(
        ["ply", "format binary_little_endian 1.0", "element vertex 20", *lines, "end_header", ""]
    )
    (tmp_path / "theirs.ply").write_bytes(head.encode() + rows.tobytes())
    file = ResultFile(tmp_path / "theirs.ply")
    assert menu(file) == ["height", "channel", "nx", "_2_temp"]
    assert (file.in_order, file.scans) == (False, (0, 0))
    found, count = file.choose(*file.scans, 100)
    assert count == 20
    assert found["_2_temp"].tolist() == list(range(20))


def test_the_place_of_a_sensor_that_moves_is_told_but_no_ranges(write, tmp_path):
    places = np.column_stack([np.arange(11.0) * 10, np.zeros(11), np.ones(11)])
    parameters = {"origin": [0, 0, 0], "poses": 1, "steps": 101, "triangles": 1}
    scene = Scene(np.array([[0, -9, 0], [100, -9, 0], [50, 9, 1.0]]), np.int32([[0, 1, 2]]),
                  np.zeros(1, np.int32), ("field",), np.zeros(3))  # fmt: skip
    rays = np.zeros((0, 2, 3), np.float32)
    Pictured(scene, places, np.zeros(1, np.int64), rays, None, None, ()).save(
        tmp_path / "pictures.npz"
    )
    file = ResultFile(write(1010, scans=101, report={"parameters": parameters}))
    assert file.pictured is not None
    assert "range" not in menu(file)
    assert [file.sensor_at(scan)[0] for scan in (0, 50, 100)] == [0, 50, 100]


@pytest.mark.parametrize("text", ["{", '{"parameters": 3}', '{"points_by_object": 3}'])
def test_damaged_reports_are_refused_with_advice(write, text):
    folder = write(10)
    (folder / "report.json").write_text(text)
    with pytest.raises(LidarpoolError, match="remove it, and the cloud is shown without it"):
        ResultFile(folder)


def test_what_is_no_result_is_refused(tmp_path):
    with pytest.raises(LidarpoolError, match=r"holds no cloud\.ply: give the folder"):
        ResultFile(tmp_path)
    with pytest.raises(LidarpoolError, match="cannot be read"):
        ResultFile(tmp_path / "none.ply")
    (tmp_path / "cut.ply").write_bytes(b"ply\n")
    with pytest.raises(LidarpoolError, match="is not a point cloud of lidarpool"):
        ResultFile(tmp_path / "cut.ply")

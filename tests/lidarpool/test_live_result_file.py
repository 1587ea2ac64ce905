"""Clouds on disk, chosen by scan and thinned."""

import json

import numpy as np
import pytest

from lidarpool import LidarpoolError
from lidarpool.live.result_file import ResultFile
from lidarpool.ply_format import header, row_type


@pytest.fixture
def write(tmp_path):
    """Return a function that writes a cloud, and a report, into a folder."""

    def write(count, scans=100, offset=0.0, report=None, real=np.float64):
        rows = np.zeros(count, row_type(np.dtype(real)))
        rows["scan"] = np.arange(count) * scans // max(1, count)
        rows["ring"] = np.arange(count) % 40
        rows["object"] = np.arange(count) % 2
        rows["x"] = offset + rows["scan"]
        rows["z"] = 1.0
        (tmp_path / "cloud.ply").write_bytes(header(np.dtype(real), count) + rows.tobytes())
        if report is not None:
            (tmp_path / "report.json").write_text(json.dumps(report))
        return tmp_path

    return write


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
    assert np.bincount(rows["ring"]).min() > 50
    assert np.array_equal(rows["position"][:, 0], rows["scan"])


def test_no_points_are_no_reason_to_fail(write):
    file = ResultFile(write(0))
    assert (len(file), file.scans, file.has_ranges) == (0, (0, 0), False)
    assert file.choose(0, 0, 10)[1] == 0


def test_far_coordinates_are_shown_to_the_millimetre(write):
    file = ResultFile(write(1000, offset=4_500_000.25))
    rows, _ = file.choose(0, 99, 1000)
    assert np.array_equal(rows["position"][:, 0] + file.origin[0] - 4_500_000.25, rows["scan"])


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
    assert not ResultFile(write(1000, report=report)).has_ranges


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

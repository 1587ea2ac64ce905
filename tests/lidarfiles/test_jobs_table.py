"""The table of a data set's jobs: what was varied and what came of it, with types kept."""

import csv
import dataclasses
import hashlib
from itertools import pairwise

import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lidarfiles.datasets.job_table import JobRow, Tally, read_table, write_table
from lidarsim import Cloud, LidarError
from lidarsim.io.storage import Storage

DONE = JobRow(
    7, "0007", "train", {"weather.rain": 2, "sensors.roof.model": "vlp16", "night": True},
    "", 10, 2, 1000, 800, 640, 1.25, "ab" * 32, {0: 40, 6: 600},
)  # fmt: skip
FAILED = JobRow(8, "0008", "", {"weather.rain": 0.5}, 'No "mesh",\r\nor none here.')
NAMES = ("weather.rain", "sensors.roof.model", "night")


@pytest.fixture(params=["folder", "memory"])
def place(request, tmp_path):
    url = tmp_path if request.param == "folder" else f"memory://{request.node.name}/set"
    place = Storage.at(url, durable=False)
    yield place
    place.remove(list(place.sizes()))


def test_rows_are_read_as_they_were_written(place):
    write_table(place, NAMES, lambda: iter([DONE, FAILED]))
    assert set(place.sizes()) == {"jobs.csv", "jobs.parquet"}
    done, failed = read_table(place)
    assert done == dataclasses.replace(DONE, seconds=None) and done.done
    unset = dict.fromkeys(NAMES) | FAILED.values
    assert failed == dataclasses.replace(FAILED, values=unset, error='No "mesh",\nor none here.')
    assert not failed.done
    head = place.read("jobs.csv").decode().splitlines()[0]
    assert head == (
        "number,name,split,weather.rain,sensors.roof.model,night,error,scans,sweeps,rays,hits,"
        "points,sha256,class_0,class_6"
    )


def test_parquet_has_the_same_table(tmp_path):
    write_table(Storage.at(tmp_path), NAMES, lambda: [DONE, FAILED])
    table = pq.read_table(tmp_path / "jobs.parquet")
    head = (tmp_path / "jobs.csv").read_text().splitlines()[0]
    assert table.column_names == head.split(",")
    rain, model, night = (table[name].to_pylist() for name in NAMES)
    assert (rain, model, night) == ([2.0, 0.5], ["vlp16", None], [True, None])
    assert table["class_6"].to_pylist() == [600, 0]
    assert str(table.schema.field("points").type) == "int64"


SCALARS = st.one_of(
    st.none(), st.booleans(), st.integers(), st.floats(allow_nan=False), st.text(st.characters()),
    st.sampled_from(["", "12", "true", "null", "NaN", '"', "[[", " 1", "1e5", "0417", "a\r\nb"]),
)  # fmt: skip


@pytest.mark.extended
@given(st.lists(st.dictionaries(st.sampled_from(["points", "class_3", "a.b"]), SCALARS)))
def test_values_keep_their_types(tmp_path_factory, rows):
    """Also text that looks like a number, and names that are those of other columns."""
    place = Storage.at(tmp_path_factory.mktemp("set"), durable=False)
    write_table(
        place,
        ["points", "class_3", "a.b"],
        lambda: (JobRow(k, "", "", v) for k, v in enumerate(rows)),
    )
    read = [row.values for row in read_table(place)]
    rows = [dict.fromkeys(["points", "class_3", "a.b"]) | row for row in rows]
    assert read == rows
    assert [[type(v) for v in row.values()] for row in map(_sorted, read)] == [
        [type(v) for v in row.values()] for row in map(_sorted, rows)
    ]


def _sorted(values):
    return dict(sorted(values.items()))


FORMULAS = ["=1+1", "+1+1", "-1+1", "@SUM(A1)", "\tx", "'=1", "''@x", "'quoted'", "-5", "-", "="]


@pytest.mark.parametrize("text", FORMULAS)
def test_no_cell_of_text_is_a_formula_for_spreadsheets(tmp_path, text):
    row = JobRow(0, text, text, {"=varied": text, "+": -0.5}, text)
    place = Storage.at(tmp_path)
    write_table(place, ["=varied", "+"], lambda: [row])
    assert list(read_table(place)) == [row]
    with (tmp_path / "jobs.csv").open(newline="") as file:
        header, cells = csv.reader(file)
    assert (header[3:5], cells[4]) == (["'=varied", "'+"], "-0.5")  # a number is no formula
    for cell in header + cells[:4] + cells[5:]:
        assert not cell.startswith(("=", "+", "-", "@", "\t", "\r"))


def test_a_table_is_whole_or_not_there(tmp_path):
    def broken():
        yield DONE
        raise LidarError("the database cannot be read")

    with pytest.raises(LidarError, match="database"):
        write_table(Storage.at(tmp_path), NAMES, broken)
    assert list(tmp_path.iterdir()) == []


def test_what_does_not_fit_is_refused(tmp_path):
    place = Storage.at(tmp_path)
    with pytest.raises(LidarError, match=r"0007 has a value for 'night'.*weather.rain"):
        write_table(place, NAMES[:2], lambda: [DONE])
    with pytest.raises(LidarError, match=r"\[1\] \(list\)"):
        write_table(place, ["a"], lambda: [JobRow(0, "0", values={"a": [1]})])
    with pytest.raises(LidarError, match="cannot be written"):
        write_table(Storage.at("/proc/none"), [], list)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "a,b\n1,2\n",
        "HEAD7,x\n",
        "HEADx,,,,0,0,0,0,0,\n",
        'HEAD"7',
        "\ud800",
        *(f"HEAD4,,,,0,0,0,0,0,\n{n},,,,0,0,0,0,0,\n" for n in (4, 3, -1, 10**18)),
    ],
)
def test_damaged_tables_are_refused(tmp_path, text):
    head = "number,name,split,error,scans,sweeps,rays,hits,points,sha256\n"
    data = text.replace("HEAD", head).encode("utf-8", "surrogatepass")
    (tmp_path / "jobs.csv").write_bytes(data)
    with pytest.raises(LidarError, match=r"jobs\.csv is damaged near line \d"):
        list(read_table(Storage.at(tmp_path)))


@pytest.mark.parametrize("column", ["points", "weight", "class"])
def test_a_table_with_other_columns_is_refused(tmp_path, column):
    head = "number,name,split,error,scans,sweeps,rays,hits,points,sha256"
    row = "0,a,,,1,1,1,1,1,,3"
    (tmp_path / "jobs.csv").write_text(f"{head},{column}\n{row}\n")
    with pytest.raises(LidarError, match=r"damaged near line 1.*unknown"):
        list(read_table(Storage.at(tmp_path)))


def test_a_missing_table_is_named(place):
    with pytest.raises(LidarError, match=r"jobs\.csv cannot be read.*--resume"):
        list(read_table(place))


def cloud_of(count, dtype=np.float64):
    rng = np.random.default_rng(3)
    columns = {
        "channel": rng.integers(0, 16, count).astype(np.uint16),
        "class": rng.integers(0, 9, count).astype(np.uint16),
        "intensity": rng.random(count).astype(np.float32),
    }
    return Cloud(rng.random((count, 3)).astype(np.float32).astype(dtype), columns)


@pytest.mark.extended
@given(st.lists(st.integers(0, 500), max_size=8))
def test_hash_and_classes_do_not_depend_on_the_division(cuts):
    cloud = cloud_of(500)
    tally = Tally()
    edges = [0, *sorted(cuts), 500]
    for first, stop in pairwise(edges):
        tally.add_points(cloud[first:stop])
    whole = Tally.from_cloud(cloud)
    assert (tally.points, tally.sha256, tally.classes) == (500, whole.sha256, whole.classes)
    assert sum(tally.classes.values()) == 500
    assert tally.classes[6] == np.count_nonzero(cloud["class"] == 6)


def test_hash_can_be_computed_from_its_description():
    cloud = Cloud(np.arange(6.0).reshape(2, 3), {"class": np.array([3, 4])})
    places = hashlib.sha256(np.arange(6, dtype="<f8").tobytes()).hexdigest()
    classes = hashlib.sha256(np.array([3, 4], "<u2").tobytes()).hexdigest()
    lines = f"positions <f8 {places}\nclass <u2 {classes}\n"
    assert Tally.from_cloud(cloud).sha256 == hashlib.sha256(lines.encode()).hexdigest()
    assert Tally().sha256 == Tally.from_cloud(cloud[:0]).sha256
    assert Tally().classes == {}


@pytest.mark.parametrize("fields", [
    {"name": "../../secret"}, {"name": "/etc/hostname"}, {"name": ".."}, {"split": "../train"},
])  # fmt: skip
def test_names_of_jobs_that_lead_elsewhere_are_refused(tmp_path, fields):
    row = JobRow(**({"number": 0, "name": "0"} | fields))
    storage = Storage.at(tmp_path)
    write_table(storage, [], lambda: [row])
    with pytest.raises(LidarError, match=r"the (name|split) .* of job 0 is not a plain file name"):
        list(read_table(storage))
    with pytest.raises(ValueError, match="is not a plain file name"):
        JobRow.from_json(dataclasses.asdict(row))

"""Data sets of many jobs, read by other libraries or by the published formats."""

from __future__ import annotations

import io
import json
import multiprocessing
import pickle
import tarfile
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pyarrow.dataset
import pytest
from tests.drives import SCANS, TURNS, points_of, the_scene, the_sweeps

from lidarfiles.clouds.boxes import Boxes
from lidarfiles.clouds.built_in_formats import DATA_SETS
from lidarfiles.clouds.writing import ExportSpec
from lidarfiles.datasets.dataset import INDEX_FILE, DataSet, Listing
from lidarfiles.datasets.job_table import JobRow
from lidarsim import Cloud, LidarError, Scene, Sensor, Survey
from lidarsim.io.storage import Storage
from lidarsim.sweeps.sweeps import Sweeps


@pytest.fixture(scope="module")
def scene() -> Scene:
    return the_scene()


@pytest.fixture(scope="module")
def sweeps(scene) -> Sweeps:
    return the_sweeps(scene)


@pytest.fixture(scope="module")
def job(scene) -> Callable[[int], Cloud]:
    return partial(points_of, scene)


@pytest.fixture
def written(tmp_path, job, sweeps):
    def write(format: str, jobs=(0, 1, 7), layout: str = "velodyne") -> tuple[DataSet, Path]:  # noqa: A002
        place = tmp_path / format
        data = DataSet(Storage.at(place), format, layout)
        for number in jobs:
            data.write_job(JobRow(number, f"{number:03}"), job(number), sweeps)
        data.finish(JobRow(number, f"{number:03}") for number in jobs)
        return data, place

    return write


def files_of(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def test_kitti_has_a_sequence_for_each_sensor_of_each_job(written, job, sweeps, tmp_path):
    _, place = written("kitti")
    names = {path.name for path in (place / "sequences").iterdir()}
    assert names == {f"{n:02}{s}" for n in (0, 1, 7) for s in ("", "_rear_left")}
    assert {path.stem for path in (place / "poses").iterdir()} == names
    # Its files are those of a job by itself.
    ExportSpec("kitti").write(tmp_path / "alone", job(7), sweeps)
    for sensor, name in enumerate(("07", "07_rear_left")):
        own = files_of(place / "sequences" / name)
        assert own == files_of(tmp_path / f"alone/sequences/{sensor:02}")
        assert len(own) == 3 * TURNS + 3
        assert own["poses.txt"] == (place / f"poses/{name}.txt").read_bytes()


def test_parquet_is_one_table_of_partitions(written, job):
    _, place = written("parquet")
    table = pyarrow.dataset.dataset(place / "points", partitioning="hive").to_table()
    frame = table.to_pandas()
    for number in (0, 1, 7):
        cloud = job(number)
        rows = frame[frame.job == number]
        np.testing.assert_allclose(rows[["x", "y", "z"]], cloud.positions)
        np.testing.assert_array_equal(rows["class"], cloud["class"])
    assert len(frame) == sum(len(job(number)) for number in (0, 1, 7))


def test_nuscenes_has_a_scene_for_each_job(written, job, sweeps):
    _, place = written("nuscenes")
    tables = {
        path.stem: json.loads(path.read_text()) for path in (place / "v1.0-lidarpool").iterdir()
    }
    assert len(tables) == 13
    for rows in tables.values():
        assert len({row["token"] for row in rows}) == len(rows)
    assert [row["name"] for row in tables["scene"]] == ["000", "001", "007"]
    assert {row["channel"] for row in tables["sensor"]} == {"LIDAR_TOP", "rear_left"}
    assert {row["name"] for row in tables["category"]} == {"Car", "Van"}
    assert len(tables["map"]) == 1 and len(tables["log"]) == 1
    assert len(tables["sample"]) == 3 * TURNS and len(tables["sample_data"]) == 6 * TURNS
    # Each token that a row names is that of a row.
    keys = {name: {row["token"] for row in rows} for name, rows in tables.items()}
    named = 0
    for rows in tables.values():
        for row in rows:
            for field, token in row.items():
                table = field.removesuffix("_token")
                if field != table and table in keys and token:
                    assert token in keys[table], field
                    named += 1
    assert named > 100
    for row in tables["sample_data"]:
        assert (place / row["filename"]).stat().st_size % 20 == 0
    # Chains stay within their scene.
    samples = {row["token"]: row for row in tables["sample"]}
    for scene in tables["scene"]:
        token = scene["first_sample_token"]
        count = 0
        while token:
            assert samples[token]["scene_token"] == scene["token"]
            token = samples[token]["next"]
            count = count + 1
        assert count == scene["nbr_samples"] == TURNS
    cloud = job(7)
    rows = np.fromfile(place / "samples/rear_left/007/000002.pcd.bin", "<f4").reshape(-1, 5)
    points = cloud[cloud.scan // SCANS == TURNS + 2]
    inside = sweeps.in_sensor(TURNS + 2, points.positions)
    np.testing.assert_allclose(rows[:, :3], inside, atol=1e-5)
    np.testing.assert_allclose(rows[:, 3], points.intensity * 255, rtol=1e-6)
    np.testing.assert_array_equal(rows[:, 4], points.channel)
    total = sum(row["num_lidar_pts"] for row in tables["sample_annotation"])
    objects = len(sweeps.objects)
    assert total == sum((job(number).object >= objects).sum() for number in (0, 1, 7))


@pytest.mark.extended
@pytest.mark.parametrize("format", DATA_SETS)
def test_the_same_job_has_the_same_bytes_and_can_be_undone(written, job, sweeps, tmp_path, format):  # noqa: A002
    data, place = written(format)
    before = files_of(place)
    assert before and not [name for name in before if "lidarpool-" in Path(name).name]
    moved = pickle.loads(pickle.dumps(data))
    assert len(pickle.dumps(data)) < 500
    moved.write_job(JobRow(1, "001"), job(1), sweeps)
    assert files_of(place) == before
    only = tmp_path / "only"
    other = DataSet(Storage.at(only), format)
    listing = Listing(str(only))
    for number in (7, 0):
        other.write_job(JobRow(number, f"{number:03}"), job(number), sweeps)
    before = files_of(only)
    other.write_job(JobRow(1, "001"), job(1), sweeps, listing=listing)
    listing.prune(listing.files)
    assert files_of(only) == before and not [*only.rglob("001")]
    other.finish([JobRow(0, "000"), JobRow(1, "001", error="failed"), JobRow(7, "007")])
    assert len(files_of(only)) > len(before)


def _write(data: DataSet, cloud: Cloud, sweeps: Sweeps) -> None:
    for _ in range(5):
        data.write_job(JobRow(3, "003"), cloud, sweeps)


@pytest.mark.extended
@pytest.mark.parametrize("format", ["kitti", "mcap"])
def test_two_processes_write_a_job_at_once(job, sweeps, tmp_path, format):  # noqa: A002
    data = DataSet(Storage.at(tmp_path / "both"), format)
    context = multiprocessing.get_context("fork")
    two = [context.Process(target=_write, args=(data, job(3), sweeps)) for _ in range(2)]
    for process in two:
        process.start()
    for process in two:
        process.join(60)
        assert process.exitcode == 0
    DataSet(Storage.at(tmp_path / "one"), format).write_job(JobRow(3, "003"), job(3), sweeps)
    assert files_of(tmp_path / "both") == files_of(tmp_path / "one")


@pytest.mark.extended
@pytest.mark.parametrize("format", ["kitti", "mcap", "folder"])
def test_what_killed_writers_left_is_removed_at_the_end(written, tmp_path, format):  # noqa: A002
    data, place = written(format)
    before = files_of(place)
    below = {"kitti": "sequences/00/velodyne", "mcap": "bags", "folder": "jobs/000"}[format]
    (place / below / ".lidarpool-tmp-000000.bin-0123abcd").write_bytes(b"half")
    if format != "kitti":
        half = place / below / ".lidarpool-writing-0123abcd"
        half.mkdir()
        (half / "half").write_bytes(b"half")
    data.finish(JobRow(number, f"{number:03}") for number in (0, 1, 7))
    assert files_of(place) == before


def test_a_large_job_is_written_a_sweep_at_a_time(sweeps, job, tmp_path, monkeypatch):
    held = []
    write = Storage.write

    def look(storage, name, data):
        if not name.startswith("sweeps/"):  # poses of all
            held.append(len(data))
        write(storage, name, data)

    monkeypatch.setattr(Storage, "write", look)
    DataSet(Storage.at(tmp_path), "kitti").write_job(JobRow(0, "0"), job(0), sweeps)
    assert max(held) < 16 * len(job(0)) / 3


@pytest.mark.extended
@pytest.mark.parametrize("format", DATA_SETS)
def test_a_manifest_lists_the_files_of_a_job(written, format):  # noqa: A002
    data, place = written(format, (4,))
    manifest = json.loads((place / ".jobs/004.json").read_bytes())
    of_all = {"dataset.json", ".jobs/004.json"}
    listed = {*manifest["files"]}
    assert listed == {
        n for n in files_of(place) if n not in of_all and n[:4] not in ("v1.0", "maps")
    }
    rows = [JobRow(4, "004")]
    assert [wrong for _, (_, wrong) in data.check_jobs(rows, contents=True)] == [""]
    harmed = place / max(listed)
    harmed.write_bytes(bytes(harmed.stat().st_size))
    assert [wrong for _, (_, wrong) in data.check_jobs(rows)] == [""]
    assert [wrong for _, (_, wrong) in data.check_jobs(rows, contents=True)] == [
        f"{max(listed)} is missing or damaged"
    ]


def test_a_manifest_says_what_became_of_a_job_and_what_made_it(job, sweeps, tmp_path):
    data = DataSet(Storage.at(tmp_path), "kitti", made_with={"backend": "numpy"})
    row = JobRow(4, "004", "train", {"rain": 0.5}, scans=9, seconds=1.5)
    made = data.write_job(row, job(4), sweeps)
    assert (made.points, made.seconds, len(made.sha256)) == (len(job(4)), 1.5, 64)
    found = replace(made, seconds=None)  # the rest is the same in each run
    assert [*data.rows({"005"})] == [(found, {"backend": "numpy"})] and [*data.rows({"004"})] == []


def test_parquet_with_as_many_files_as_sweeps(scene, sweeps, job, tmp_path):
    """One of each: a file of Parquet is not a sweep, and has no boxes of actors."""
    one = Survey(Sensor.grid(360, 4), [(0, 0, 1)], steps=SCANS)
    only = Sweeps.from_survey(one, scene)
    cloud = job(0)
    cloud = cloud[cloud.scan < SCANS]
    assert len(only) == 1 and only.actors
    DataSet(Storage.at(tmp_path), "parquet").write_job(JobRow(0, "0"), cloud, only)
    with np.load(tmp_path / "boxes/0.npz") as kept:
        np.testing.assert_allclose(kept["centers"][0], Boxes.from_points(only, 0, cloud).centers)


def test_what_cannot_be_written_is_told_in_a_line(job, sweeps, tmp_path, monkeypatch):
    place = Storage.at(tmp_path / "d")
    bare = Cloud(job(0).positions, {"scan": job(0).scan})
    with pytest.raises(
        LidarError, match="kitti requires the columns object, reflectivity and class"
    ):
        DataSet(place, "kitti").write_job(JobRow(0, "0"), bare, sweeps)
    assert DataSet(place, "kitti").columns == ("scan", "object", "reflectivity", "class")
    assert DataSet(place, "folder").columns == ()
    assert "range" in DataSet(place, "mcap", "ouster").columns
    half = replace(sweeps, scans=sweeps.scans[:4], begins_ns=sweeps.begins_ns[:3])
    with pytest.raises(LidarError, match="not in scan order, or come from a different"):
        DataSet(place, "kitti").write_job(JobRow(0, "0"), job(0), half)
    with pytest.raises(LidarError, match=r"Job 5 of .* is incomplete, because \.jobs/5\.json"):
        DataSet(place, "kitti").finish([JobRow(5, "5")])
    assert not (tmp_path / "d" / INDEX_FILE).exists()
    (tmp_path / "file").write_text("")
    with pytest.raises(LidarError, match=r"Job 0 cannot be written to .*file") as told:
        DataSet(Storage.at(tmp_path / "file"), "kitti").write_job(JobRow(0, "0"), job(0), sweeps)
    assert "\n" not in str(told.value)
    monkeypatch.setattr("lidarfiles.clouds.format_row.find_spec", lambda name: None)
    with pytest.raises(LidarError, match=r'pip install -e "\.\[parquet\]"'):
        DataSet(place, "parquet").write_job(JobRow(0, "0"), job(0), sweeps)


def test_webdataset_has_a_sample_for_each_sweep(scene, job, sweeps, tmp_path, monkeypatch):
    monkeypatch.setattr("lidarfiles.clouds.webdataset.MAX_SHARD_BYTES", 60_000)
    row = JobRow(7, "hall.b", "train", {"rain": 0.5})
    places = [Storage.at(tmp_path / "here"), Storage.at((tmp_path / "there").as_uri())]
    for place in places:  # as at a URL: several ranges are written at a time
        data = DataSet(place, "webdataset")
        data.write_job(row, job(7), sweeps)
        data.finish([row])
    written = files_of(tmp_path / "here")
    assert written == files_of(tmp_path / "there")
    tars = sorted((tmp_path / "here/shards/train").iterdir())
    assert len(tars) > 1 and tars[0].name == "hall.b-000000.tar"
    samples: dict[str, dict[str, bytes]] = {}
    for path in tars:
        assert path.stat().st_size <= 60_000 + tarfile.RECORDSIZE
        with tarfile.open(path) as tar:
            for member in tar:
                assert (member.mtime, member.uid, member.uname) == (0, 0, "")
                folder, _, name = member.name.rpartition("/")
                key, _, ending = name.partition(".")
                assert ending not in samples.setdefault(f"{folder}/{key}", {})
                samples[f"{folder}/{key}"][ending] = tar.extractfile(member).read()
    names = [f"hall.b/{sensor}-{n:06}" for sensor in ("front", "rear_left") for n in range(TURNS)]
    assert [*samples] == names
    cloud = job(7)
    for number, sample in enumerate(samples.values()):
        arrays = {k: np.load(io.BytesIO(v)) for k, v in sample.items() if k.endswith(".npy")}
        points = cloud[cloud.scan // SCANS == number]
        back = arrays["points.npy"] @ arrays["pose.npy"][:3, :3].T + arrays["pose.npy"][:3, 3]
        np.testing.assert_allclose(back, points.positions, atol=2e-5)
        for column in cloud.table:
            np.testing.assert_array_equal(arrays[f"{column.name}.npy"], points[column.name])
        about = json.loads(sample["json"])
        assert (about["values"], about["split"]) == ({"rain": 0.5}, "train")
        assert len(arrays["boxes.npy"]) == len(about["box_names"]) == len(about["box_points"])


def test_webdataset_is_read_by_its_own_library(written, sweeps, job):
    wds = pytest.importorskip("webdataset")
    _, place = written("webdataset")
    shards = sorted(map(str, (place / "shards").glob("*.tar")))
    samples = list(wds.WebDataset(shards, shardshuffle=False).decode())
    assert [sample["json"]["name"] for sample in samples] == [
        name for name in ("000", "001", "007") for _ in range(len(sweeps))
    ]
    points = [len(sample["points.npy"]) for sample in samples[: len(sweeps)]]
    assert points == np.bincount(job(0).scan // SCANS, minlength=len(sweeps)).tolist()

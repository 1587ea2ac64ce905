"""Data sets read sweep by sweep: each format gives back what was written."""

from __future__ import annotations

import gc
import multiprocessing
import os
import pickle
import shutil
import threading
import types
import warnings
from collections.abc import Callable
from itertools import chain, pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fsspec.implementations.memory import MemoryFileSystem
from tests.daemons import wait_until
from tests.drives import SCANS, SPLITS, TURNS, points_of, the_scene, the_sweeps, write_set

import lidarpool
from lidarfiles.clouds.boxes import Boxes
from lidarfiles.clouds.built_in_formats import DATA_SETS, LAYOUTS
from lidarfiles.clouds.format_table import load_format
from lidarfiles.datasets.dataset import INDEX_FILE, DataSet
from lidarfiles.datasets.job_table import JobRow, write_table
from lidarfiles.recordings.opening import open_recording
from lidarsim import LidarError, Scene
from lidarsim.columns.sweep import Sweep
from lidarsim.io.storage import Storage
from lidarsim.sweeps.sweeps import Sweeps

JOBS = len(SPLITS)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return the_scene()


@pytest.fixture(scope="module")
def all_sweeps(scene) -> Sweeps:
    return the_sweeps(scene)


@pytest.fixture(scope="module")
def written(tmp_path_factory, scene, all_sweeps) -> Callable[[str], Path]:
    """Return data sets by format and layout."""
    made: dict[str, Path] = {}

    def write(name: str) -> Path:
        if name not in made:
            kind, _, layout = name.partition("-")
            place = tmp_path_factory.mktemp(name)
            write_set(place, kind, scene, all_sweeps, layout or "velodyne")
            made[name] = place
        return made[name]

    return write


def identity(sweep: Sweep) -> tuple[int, str, int]:
    return sweep.job_number, sweep.sensor, sweep.number


@pytest.mark.extended(every=3)
@pytest.mark.parametrize(
    "name", [*DATA_SETS, *(f"mcap-{layout}" for layout in LAYOUTS if layout != "velodyne")]
)
def test_a_sweep_is_what_was_written(written, all_sweeps, name, scene):
    data = lidarpool.sweeps(written(name))
    assert len(data) == (JOBS - 1) * 2 * TURNS
    for number in (0, 1, 2, 3, 5, len(data) - 1):
        sweep = data[number]
        inside = number % (2 * TURNS)
        cloud = points_of(scene, sweep.job_number)
        points = cloud[cloud.scan // SCANS == inside]
        assert sweep.sensor == ("front", "rear/left")[inside // TURNS]
        assert sweep.number == inside % TURNS and len(sweep) == len(points)
        assert sweep.time_ns == sweep.number * 100_000_000
        assert (sweep.job, sweep.values) == (
            f"{sweep.job_number:02}",
            {"rain": sweep.job_number / 2},
        )
        assert sweep.points.dtype == np.float32 and sweep.points.shape == (len(points), 3)
        # The pose brings points back to where they are in the world.
        back = sweep.points.astype(float) @ sweep.pose[:3, :3].T + sweep.pose[:3, 3]
        np.testing.assert_allclose(back, points.positions, atol=2e-5 if name != "folder" else 1e-3)
        counted = ("kitti", "mcap-autoware", "mcap-hesai", "mcap-livox", "mcap-robosense")
        steps = {**dict.fromkeys(counted, 255), "mcap-ouster": 10_000}.get(name, 1e9)
        np.testing.assert_allclose(sweep.intensity, points.intensity, rtol=1e-6, atol=0.51 / steps)
        if name in ("kitti", "webdataset", "parquet", "images", "folder"):
            np.testing.assert_array_equal(sweep.classes, points["class"])
            np.testing.assert_array_equal(sweep.objects, points.object)
            assert sweep.classes.dtype == np.uint16 and sweep.objects.dtype == np.int32
        else:
            assert sweep.classes is None and sweep.objects is None
        if name != "kitti":
            np.testing.assert_array_equal(sweep.columns["channel"], points.channel)
        assert sweep.object_names == (*scene.names, "Car 1", "Van 1")
        boxes = Boxes.from_points(all_sweeps, inside, points)
        there = np.flatnonzero(boxes.present)
        assert sweep.boxes.names == tuple(("Car 1", "Van 1")[k] for k in there)
        assert sweep.boxes.types == tuple(("Car", "Van")[k] for k in there)
        np.testing.assert_array_equal(sweep.boxes.points, boxes.points[there])
        np.testing.assert_allclose(sweep.boxes.sizes, boxes.sizes[there])
        centers = sweep.boxes.centers @ sweep.pose[:3, :3].T + sweep.pose[:3, 3]
        np.testing.assert_allclose(centers, boxes.centers[there], atol=1e-6)
        # Cars look along x of the world; their yaw is the sensor's, turned back.
        heading = np.arctan2(sweep.pose[1, 0], sweep.pose[0, 0])
        if 0 in there:
            np.testing.assert_allclose(sweep.boxes.yaw[0], -heading, atol=1e-9)
    first = data[0]
    assert repr(first) == f"<Sweep 0 of front in job 00: {len(first)} points>"
    assert repr(data).startswith(f"<{len(data)} sweeps of")
    assert identity(data[-1]) == identity(data[len(data) - 1])
    with pytest.raises(IndexError):
        data[len(data)]


@pytest.mark.extended(every=7)
@pytest.mark.parametrize("name", DATA_SETS)
def test_the_order_follows_from_the_seed(written, name):
    place = written(name)
    plain = [identity(sweep) for sweep in lidarpool.sweeps(place)]
    data = lidarpool.sweeps(place, shuffle=4)
    once, again = ([identity(sweep) for sweep in data] for _ in range(2))
    assert once == again == [identity(sweep) for sweep in lidarpool.sweeps(place, shuffle=4)]
    assert once != plain and sorted(once) == sorted(plain)
    # Sweeps of a job are not beside each other.
    assert sum(a[0] == b[0] for a, b in pairwise(once)) < len(once) / 2
    assert once != [identity(sweep) for sweep in lidarpool.sweeps(place, shuffle=5)]
    copy = pickle.loads(pickle.dumps(data))
    assert [identity(sweep) for sweep in copy] == once


def test_sweeps_are_chosen_by_split_job_and_sensor(written):
    place = written("kitti")
    chosen = lidarpool.sweeps(place, split="train")
    assert {sweep.job_number for sweep in chosen} == {0, 1, 2}  # 3 failed
    assert {sweep.split for sweep in chosen} == {"train"}
    two = lidarpool.sweeps(place, split=["val", "test"])
    assert {sweep.job for sweep in two} == {"04", "05"}
    some = lidarpool.sweeps(place, jobs=[1, "04"], sensors=["rear/left"], shuffle=1)
    assert sorted(map(identity, some)) == [
        (n, "rear/left", k) for n in (1, 4) for k in range(TURNS)
    ]
    assert len(lidarpool.sweeps(place, jobs=[])) == 0
    for options, words in (
        ({"split": "trian"}, r"no split 'trian'\. Did you mean 'train'"),
        ({"split": "x"}, r"no split 'x'\. The splits are train, val and test"),
        ({"sensors": ["roof"]}, r"no sensor 'roof'\. The sensors are front and rear/left"),
        ({"jobs": [3]}, r"no completed job 3 \(5 jobs: 0 to 5\)\. All jobs are listed in jobs.csv"),
        (
            {"jobs": [4], "split": "train"},
            r"no completed job 4 in split 'train' \(3 jobs: 0 to 2\)",
        ),
        ({"jobs": ["4"]}, r"no completed job '4' \(5 jobs: 00 to 05\)"),
        ({"jobs": "04"}, "jobs must be a list, but is '04'"),
        ({"shuffle": True}, "shuffle must be a whole number at least 0, but is True"),
        ({"shuffle": -1}, "shuffle must be a whole number at least 0, but is -1"),
        ({"sensors": "front"}, "sensors must be a list, but is 'front'"),
    ):
        with pytest.raises(LidarError, match=words) as told:
            lidarpool.sweeps(place, **options)
        assert "\n" not in str(told.value)


def test_data_that_a_job_lacks_is_none(tmp_path, scene, all_sweeps):
    data = DataSet(Storage.at(tmp_path), "webdataset")
    row = JobRow(0, "00", values={"fog": None, "rain": 2.0})
    row = data.write_job(row, points_of(scene, 0), all_sweeps)
    write_table(data.storage, ["fog", "rain"], lambda: [row])
    data.finish([row])
    sweep = lidarpool.sweeps(tmp_path)[0]
    assert (sweep.split, sweep.values) == (None, {"fog": None, "rain": 2.0})


def test_a_store_that_does_not_answer_is_not_taken_for_a_damaged_file(
    written, tmp_path, monkeypatch
):
    url = f"memory://{tmp_path.name}/set"
    for path in written("kitti").rglob("*"):
        if path.is_file():
            name = path.relative_to(written("kitti")).as_posix()
            Storage.at(url).write(name, path.read_bytes())
    data = lidarpool.sweeps(url)
    assert len(data[0])

    def unreachable(*_: object, **__: object) -> None:
        raise RuntimeError("Could not connect")  # libraries have errors of their own

    monkeypatch.setattr(MemoryFileSystem, "cat_file", unreachable)
    with pytest.raises(LidarError, match=r"01\.bin cannot be read: RuntimeError: Could not"):
        data[1]


def test_what_is_no_data_set_is_told_in_a_line(written, tmp_path, monkeypatch):
    place = tmp_path / "copy"
    shutil.copytree(written("kitti"), place)

    def told(what: Callable[[], Any], words: str) -> None:
        with pytest.raises(LidarError, match=words) as raised:
            what()
        assert len(str(raised.value).splitlines()) == 1

    told(
        lambda: lidarpool.sweeps(tmp_path / "nowhere"),
        "nowhere does not exist. Specify the output folder of a campaign",
    )
    first = lidarpool.sweeps(place)
    points = place / "sequences/00/velodyne/000000.bin"
    whole = points.read_bytes()
    points.write_bytes(whole[:-3])
    told(lambda: first[0], r"sequences/00/velodyne/000000\.bin is missing or damaged")
    points.write_bytes(whole[:-16])
    told(lambda: first[0], r"labels/000000\.label is .* has \d+ points, but .*000000\.bin has \d+")
    points.unlink()
    told(lambda: first[0], r"sequences/00/velodyne/000000\.bin cannot be read: No such file")
    points.write_bytes(whole)
    assert len(first[0]) == len(whole) // 16
    kept = place / "sweeps/01.npz"
    kept.write_bytes(kept.read_bytes()[:200])
    told(lambda: lidarpool.sweeps(place, jobs=[1])[0], r"sweeps/01\.npz is damaged")
    kept.unlink()
    told(lambda: lidarpool.sweeps(place, jobs=[1])[0], r"sweeps/01\.npz cannot be read")
    index = place / INDEX_FILE
    text = index.read_text()
    for bad in (text[:50], "[]", text.replace('"version": 2', '"version": 1')):
        index.write_text(bad)
        told(
            lambda: lidarpool.sweeps(place),
            r"dataset\.json is damaged or was written by another version",
        )
    index.write_text(text)
    assert len(lidarpool.sweeps(place)) == len(first)
    table = place / "jobs.csv"
    table.write_text("".join(table.read_text().splitlines(keepends=True)[:2]))
    told(lambda: lidarpool.sweeps(place), r"jobs\.csv is damaged or has been edited, .*--resume")
    index.unlink()
    told(lambda: lidarpool.sweeps(place), "contains an unfinished data set.*--resume")
    written("parquet"), written("mcap")
    monkeypatch.setattr("lidarfiles.clouds.format_row.find_spec", lambda name: None)
    told(lambda: lidarpool.sweeps(written("parquet")), r'pip install -e "\.\[parquet\]"')
    told(lambda: lidarpool.sweeps(written("mcap")), r'pip install -e "\.\[ros\]"')


@pytest.mark.parametrize(
    ("name", "file"),
    [
        ("nuscenes", "samples/LIDAR_TOP/00/000000.pcd.bin"),
        ("webdataset", "shards/train/00-000000.tar"),
        ("parquet", "points/job=0/part-00000.parquet"),
        ("mcap", "bags/00.mcap"),
        ("folder", "jobs/00/cloud.ply"),
    ],
)
def test_a_damaged_file_is_named(written, tmp_path, name, file):
    place = tmp_path / "copy"
    shutil.copytree(written(name), place)
    data = (place / file).read_bytes()
    for there in (data[: len(data) // 2 - 3], b"", None):
        (place / file).write_bytes(there) if there is not None else (place / file).unlink()
        if name == "nuscenes" and there == b"":
            continue  # a sweep without points
        with pytest.raises(LidarError, match=r"damaged|cannot be read|not a point cloud") as told:
            list(lidarpool.sweeps(place, jobs=[0]))
        assert len(str(told.value).splitlines()) == 1 and file.split("/part")[0] in str(told.value)


def _read(data: Any, queue: Any) -> None:
    queue.put([(identity(sweep), float(sweep.points.sum())) for sweep in data])


@pytest.mark.extended
@pytest.mark.slow(keep=("kitti", "mcap"))
@pytest.mark.parametrize("name", DATA_SETS)
def test_threads_and_forks_read_beside_each_other(written, name):
    data = lidarpool.sweeps(written(name), shuffle=2)
    alone = [(identity(sweep), float(sweep.points.sum())) for sweep in data]
    context = multiprocessing.get_context("fork")
    queue = context.Queue()
    forks = [context.Process(target=_read, args=(data, queue)) for _ in range(2)]
    threads = [threading.Thread(target=_read, args=(data, queue)) for _ in range(2)]
    for one in (*forks, *threads):
        one.start()
    found = [queue.get(timeout=60) for _ in range(4)]
    for one in (*forks, *threads):
        one.join()
    assert found == [alone] * 4


@pytest.mark.parametrize("url", [False, True])
def test_a_loop_reads_a_few_sweeps_ahead(written, monkeypatch, url):
    name = "kitti" if url else "webdataset"
    cloud_format = load_format(name)
    read = cloud_format.read_sweep
    threads: list[str] = []

    def noted(job: Any, sweep: int) -> Any:
        if threading.current_thread() is not threading.main_thread():
            threads.append(threading.current_thread().name)
        return read(job, sweep)

    monkeypatch.setattr(cloud_format, "read_sweep", noted)
    place = written(name)
    data = lidarpool.sweeps(place.as_uri() if url else place, shuffle=1)
    loop = iter(data)
    assert identity(next(loop)) == identity(data[0])
    for number in range(1, 6):
        wait_until(lambda number=number: len(threads) > number + 1)
        assert len(threads) <= number + (17 if url else 10)
        assert identity(next(loop)) == identity(data[number])
    loop.close()
    assert not any(one.name.startswith("sweeps") for one in threading.enumerate())
    assert [*map(identity, data.ahead([3, 1]))] == [identity(data[3]), identity(data[1])]


@pytest.mark.parametrize("name", ["kitti", "nuscenes"])
def test_the_system_reads_files_that_are_not_in_memory_ahead(written, monkeypatch, name):
    expected: list[int] = []  # bytes of files
    monkeypatch.setattr(
        "os.posix_fadvise", lambda file, *_: expected.append(os.fstat(file).st_size)
    )
    data = lidarpool.sweeps(written(name), shuffle=1)
    plain = list(data)
    assert not expected  # they have just been written

    def fail(*_: Any) -> None:
        raise BlockingIOError

    monkeypatch.setattr("os.preadv", fail)
    loop = iter(data)
    row, files = (16, 2) if name == "kitti" else (20, 1)  # with labels
    for number in range(3):
        assert identity(next(loop)) == identity(plain[number])
        assert expected[::files] == [row * len(sweep) for sweep in plain[: 9 + number]]
        assert len(expected) == files * (9 + number)
    assert len(list(loop)) == len(plain) - 3


def test_a_sweep_is_sent_without_the_others_of_its_job(written):
    sweep = lidarpool.sweeps(written("kitti"))[0]
    sent = pickle.dumps(sweep)
    assert len(sent) < sum(array.nbytes for array in (sweep.points, *sweep.columns.values())) + 3000
    again = pickle.loads(sent)
    for one in (again, again.replace(split="x")):
        np.testing.assert_array_equal(one.boxes.rows, sweep.boxes.rows)
        np.testing.assert_array_equal(one.points, sweep.points)


# -- PyTorch ---------------------------------------------------------------------------------------


def test_torch_gets_tensors(written, torch):
    data = lidarpool.sweeps(written("kitti"), shuffle=3)
    items = list(data.torch())
    assert [item["job"] for item in items] == [sweep.job for sweep in data]
    # In builds without distributed training the module has little more than `is_available`.
    torch.distributed.is_available = lambda: False
    del torch.distributed.is_initialized
    assert [item["job"] for item in data.torch()] == [sweep.job for sweep in data]
    item = items[0]
    sweep = data[0]
    np.testing.assert_array_equal(item["points"], sweep.points)
    np.testing.assert_array_equal(item["class"], sweep.classes)
    assert item["class"].dtype == np.int64 and item["points"].dtype == np.float32
    assert item["boxes"].shape == (len(sweep.boxes), 7) and item["pose"].shape == (4, 4)
    assert item["points"].flags.writeable
    np.testing.assert_array_equal(item["pose"], sweep.pose)
    np.testing.assert_array_equal(item["boxes"], sweep.boxes.rows)
    np.testing.assert_array_equal(item["box_objects"], sweep.boxes.objects)
    assert item["box_types"] == [*sweep.boxes.types] and item["box_objects"].dtype == np.int64
    assert (item["sensor"], item["number"]) == (sweep.sensor, sweep.number)
    assert item["time_ns"] == sweep.time_ns
    assert list(data.torch(transform=identity)) == [identity(sweep) for sweep in data]


@pytest.mark.extended
@pytest.mark.parametrize(("ranks", "workers"), [(1, 1), (1, 4), (4, 1), (4, 3), (7, 2)])
@pytest.mark.parametrize("even", [True, False])
def test_torch_divides_sweeps_between_ranks_and_workers(written, torch, ranks, workers, even):
    data = lidarpool.sweeps(written("kitti"), shuffle=3)
    torch.distributed.is_available = torch.distributed.is_initialized = lambda: True
    torch.distributed.get_world_size = lambda: ranks
    of_ranks = []
    for rank in range(ranks):
        torch.distributed.get_rank = lambda rank=rank: rank
        whole = data.torch(transform=identity, even=even)
        sent = pickle.dumps(whole)  # as to workers that are spawned, which have no ranks
        of_workers = []
        torch.distributed.is_initialized = lambda: False
        for worker in range(workers):
            info = types.SimpleNamespace(id=worker, num_workers=workers)
            torch.utils.data.get_worker_info = lambda info=info: info
            of_workers.append(list(pickle.loads(sent)))
        torch.distributed.is_initialized = lambda: True
        of_ranks.append(list(chain.from_iterable(of_workers)))
    found = list(chain.from_iterable(of_ranks))
    everything = [identity(sweep) for sweep in data]
    assert len(set(found)) == len(found)
    if even:
        assert len({len(one) for one in of_ranks}) == 1
        assert set(found) == set(everything[: len(everything) - len(everything) % ranks])
    else:
        assert sorted(found) == sorted(everything)


def test_without_torch(written, monkeypatch):
    monkeypatch.setattr("lidarfiles.datasets.loader.find_spec", lambda name: None)
    with pytest.raises(LidarError, match=r"requires PyTorch\. Run pip install torch"):
        lidarpool.sweeps(written("kitti")).torch()


def test_bags_are_closed_with_the_data_set_or_recording_that_reads_them(written):
    """Python warns of files that it has to close."""
    data_set = written("mcap")
    gc.collect()  # pipes that other tests have left, of which Python would warn below
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        saved = lidarpool.sweeps(data_set)
        sweep = saved[0]
        recording = open_recording(data_set / "bags/00.mcap", f"/{sweep.sensor}/points")
        assert len(recording[0]) == len(sweep.points) > 0
        del saved, recording
        gc.collect()
    assert [str(warning.message) for warning in caught] == []

"""The cloud of a run grows by committed parts: the bytes are those of a cloud written at once."""

from __future__ import annotations

import random
import shutil
import threading

import numpy as np
import pytest
from tests.cloud_counting import counts_of
from tests.committing import commit
from tests.daemons import wait_until

from lidarfiles import read_cloud, save_cloud
from lidarfiles.clouds import ply
from lidarpool.report import growing_cloud
from lidarpool.report.growing_cloud import GrowingCloud, write_cloud
from lidarpool.run.job_source import SingleJob
from lidarpool.run.store.run_store import RunStore
from lidarscenario import Job
from lidarsim import LidarError, Scene, Sensor, Survey
from lidarsim.scene.shapes import seed_objects
from lidarsim.sweeps.sweeps import Sweeps

SCENE = Scene.from_meshes(seed_objects(rings=4, segments=6))
COLUMNS = ["time", "class", "range"]
SURVEY = Survey(Sensor.grid(layers=2), poses=[(0, 0, 1)], steps=12, columns=COLUMNS)
PARTS = {0: [3, 4], 2: [5], 3: [0, 0], 5: [2, 0, 6], 8: [1, 1], 10: [7, 2]}  # {first: points}
MANY = PARTS | {10: [50, 40]}
FEW = {0: [40, 50], **{scan: [scan % 2] for scan in range(2, 12)}}


@pytest.fixture
def store(tmp_path):
    """Store of an empty run."""
    return RunStore(SingleJob(Job(SCENE, SURVEY)), location=tmp_path / "run")


def add(store, growing, first, counts, offset=0):
    """Commit a part, and let the cloud grow by it."""
    assert commit(store, first, counts, [1], [sum(counts)], offset=offset)
    part = store.only_job.parts.part_of(first)
    if growing is not None:
        growing.append_committed([part])


def grown_at(path):
    """Path of the growing file, in a folder of its own beside the run's."""
    path.mkdir()
    return path / "cloud.ply"


def counted(counts):
    """All figures of counts, to compare them."""
    view = counts.top_view().counts
    arrays = (counts.by_object, counts.by_class, counts.by_material, view, counts.bounds)
    return [counts.limits, counts.density, counts.no_surface, *(a.tolist() for a in arrays)]


@pytest.mark.extended(every=5)
@pytest.mark.parametrize("first_points", [3, 65_536])
@pytest.mark.parametrize("parts", [PARTS, MANY, FEW])
@pytest.mark.parametrize("order", ["sorted", "reversed", "shuffled"])
def test_bytes_and_counts_are_those_of_a_cloud_written_at_once(
    store, tmp_path, monkeypatch, order, parts, first_points
):
    """Also where the number has more or fewer digits than the first parts let expect."""
    monkeypatch.setattr(ply, "FIRST_POINTS", first_points)
    firsts = sorted(parts, reverse=order == "reversed")
    if order == "shuffled":
        random.Random(3).shuffle(firsts)
    with GrowingCloud(grown_at(tmp_path / "new"), store.only_job) as growing:
        for first in firsts:
            add(store, growing, first, parts[first])
        points = store.only_job.points()
        counts = growing.finish(tmp_path / "grown.ply", points)
    save_cloud(points, tmp_path / "whole.ply")
    assert (tmp_path / "grown.ply").read_bytes() == (tmp_path / "whole.ply").read_bytes()
    expected = counts_of(points, len(SCENE.object_names), len(SCENE.material_names))
    assert counted(counts) == counted(expected)
    sweeps = Sweeps.from_survey(SURVEY, SCENE)
    again = write_cloud(tmp_path / "again.ply", points, sweeps, SCENE)
    assert (tmp_path / "again.ply").read_bytes() == (tmp_path / "whole.ply").read_bytes()
    assert counted(again) == counted(expected)


@pytest.mark.parametrize("block_rows", [1, 3, 65_536])
@pytest.mark.parametrize("count", [1, 2, 16])
def test_bytes_and_counts_do_not_depend_on_threads_and_blocks(
    store, tmp_path, monkeypatch, count, block_rows
):
    monkeypatch.setattr(growing_cloud, "processor_count", lambda: count)
    monkeypatch.setattr(growing_cloud, "_BLOCK_ROWS", block_rows)
    with GrowingCloud(grown_at(tmp_path / "new"), store.only_job) as growing:
        for first, counts in FEW.items():
            add(store, growing, first, counts)
        points = store.only_job.points()
        grown = growing.finish(tmp_path / "grown.ply", points)
    save_cloud(points, tmp_path / "whole.ply")
    assert (tmp_path / "grown.ply").read_bytes() == (tmp_path / "whole.ply").read_bytes()
    expected = counts_of(points, len(SCENE.object_names), len(SCENE.material_names))
    assert counted(grown) == counted(expected)


def test_a_disk_that_is_full_for_one_thread_is_told_in_the_end(store, tmp_path, monkeypatch):
    monkeypatch.setattr(growing_cloud, "processor_count", lambda: 4)
    write = ply.PlyAppender.write_rows
    offsets = []

    def faulty(self, rows, offset):
        offsets.append(offset)
        if len(offsets) % 5 == 3:
            raise OSError(28, "No space left on device")
        write(self, rows, offset)

    monkeypatch.setattr(ply.PlyAppender, "write_rows", faulty)
    path = grown_at(tmp_path / "new")
    with GrowingCloud(path, store.only_job) as growing:
        for first, counts in FEW.items():
            add(store, growing, first, counts)
        points = store.only_job.points()
        assert growing.finish(tmp_path / "grown.ply", points) is None
    assert not any(path.parent.iterdir())
    offsets.clear()
    sweeps = Sweeps.from_survey(SURVEY, SCENE)
    with pytest.raises(OSError, match="No space left"):
        write_cloud(tmp_path / "cloud.ply", points, sweeps, SCENE)
    assert not {thread.name for thread in threading.enumerate() if "cloud" in thread.name}


@pytest.mark.extended
@pytest.mark.parametrize("far_first", [0, 5, 10])
def test_a_late_part_far_away_makes_all_positions_double(store, tmp_path, far_first):
    with GrowingCloud(grown_at(tmp_path / "new"), store.only_job) as growing:
        for first, counts in PARTS.items():
            add(store, growing, first, counts, offset=10**9 * (first == far_first))
        points = store.only_job.points()
        counts = growing.finish(tmp_path / "grown.ply", points)
    assert read_cloud(tmp_path / "grown.ply").positions.dtype == np.float64
    save_cloud(points, tmp_path / "whole.ply")
    assert (tmp_path / "grown.ply").read_bytes() == (tmp_path / "whole.ply").read_bytes()
    expected = counts_of(points, len(SCENE.object_names), len(SCENE.material_names))
    assert counted(counts) == counted(expected)


def test_it_grows_by_parts_whose_predecessors_are_committed(store, tmp_path):
    path = grown_at(tmp_path / "new")
    with GrowingCloud(path, store.only_job) as growing:
        for first in (0, 5, 2):
            add(store, growing, first, PARTS[first])
        row_bytes = 3 * 4 + 4 + 2 + 4 + 8 + 2 + 4  # position, scan, channel, object, and COLUMNS
        expected_bytes = sum(PARTS[0] + PARTS[2]) * row_bytes  # that of 5 waits for that of 3

        def rows() -> bytes:
            return path.read_bytes().partition(b"end_header\n")[2] if path.exists() else b""

        wait_until(lambda: len(rows()) >= expected_bytes)
        assert len(rows()) == expected_bytes


def test_a_resumed_run_begins_with_the_parts_that_are_there(store, tmp_path):
    for first in (0, 2, 5):
        add(store, None, first, PARTS[first])
    with GrowingCloud(grown_at(tmp_path / "killed"), store.only_job) as growing:
        add(store, growing, 3, PARTS[3])
    with GrowingCloud(grown_at(tmp_path / "new"), store.only_job) as growing:
        for first in (10, 8):
            add(store, growing, first, PARTS[first])
        points = store.only_job.points()
        assert growing.finish(tmp_path / "grown.ply", points) is not None
    save_cloud(points, tmp_path / "whole.ply")
    assert (tmp_path / "grown.ply").read_bytes() == (tmp_path / "whole.ply").read_bytes()


def test_a_survey_without_points(store, tmp_path):
    with GrowingCloud(grown_at(tmp_path / "new"), store.only_job) as growing:
        add(store, growing, 0, [0] * 12)
        points = store.only_job.points()
        assert growing.finish(tmp_path / "grown.ply", points) is None
    sweeps = Sweeps.from_survey(SURVEY, SCENE)
    counts = write_cloud(tmp_path / "cloud.ply", points, sweeps, SCENE)
    assert len(read_cloud(tmp_path / "cloud.ply")) == 0
    assert counts.density is None


def test_a_run_that_ends_early_leaves_no_file_and_no_thread(store, tmp_path):
    path = grown_at(tmp_path / "new")
    with (
        pytest.raises(KeyboardInterrupt),
        GrowingCloud(path, store.only_job) as growing,
    ):
        add(store, growing, 0, PARTS[0])
        raise KeyboardInterrupt
    assert not any(path.parent.iterdir())
    assert "grow cloud" not in {thread.name for thread in threading.enumerate()}


@pytest.mark.parametrize("fault", ["full disk", "no room for parts", "read-only", "damaged part"])
def test_a_file_that_fails_is_removed_and_the_end_says_the_error(
    store, tmp_path, monkeypatch, fault
):
    path = grown_at(tmp_path / "new")
    usage = shutil.disk_usage(tmp_path)
    free_bytes = 1000 if fault == "no room for parts" else 10**9
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=free_bytes))
    write = ply.write_with_open3d

    def faulty(target, cloud, real):
        if fault == "full disk":
            raise OSError(28, "No space left on device")
        write(target, cloud, real)

    monkeypatch.setattr(ply, "write_with_open3d", faulty)
    with GrowingCloud(path, store.only_job) as growing:
        if fault == "read-only":
            path.parent.rmdir()
        for first, counts in PARTS.items():
            add(store, None, first, counts)
            part = store.only_job.parts.part_of(first)
            if fault == "damaged part" and first == 5:
                store.storage.write(part.name, b"damaged")
            growing.append_committed([part])
        points = store.only_job.points()
        assert growing.finish(tmp_path / "grown.ply", points) is None
    assert not path.exists() and not (tmp_path / "grown.ply").exists()
    if fault in ("no room for parts", "read-only"):
        return
    sweeps = Sweeps.from_survey(SURVEY, SCENE)
    message = "No space left" if fault == "full disk" else "The part .* cannot be used"
    with pytest.raises((LidarError, OSError), match=message):
        write_cloud(tmp_path / "cloud.ply", points, sweeps, SCENE)

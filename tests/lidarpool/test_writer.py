"""What the driver asks LIDAR workers to write, and whose memory it checks."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from lidarfiles.datasets.dataset import DataSet
from lidarpool.run import writer
from lidarpool.run.cluster.checks import check_workers
from lidarpool.run.pipeline.failures import JobError
from lidarpool.run.writer import MAX_JOBS_PER_TASK, DataSetWriter
from lidarsim import Scene, Sensor, Survey
from lidarsim.io.storage import Storage


@pytest.fixture
def jobs(tmp_path, monkeypatch):
    """A writer whose tasks never end, and the numbers of jobs in each of them."""
    written = []
    clock = SimpleNamespace(now=0.0)
    monkeypatch.setattr(writer, "time", SimpleNamespace(monotonic=lambda: clock.now))
    tasks = SimpleNamespace(
        running={}, pop_finished=list, pop_failed=list, cancel=list,
        submit=lambda jobs, *_, **__: written.append(len(jobs)),
    )  # fmt: skip
    db = SimpleNamespace(meta={"mark": "0" * 16})
    store = SimpleNamespace(db=db, storage=Storage.at(tmp_path / "parts"), made_with={})
    dataset = DataSet(Storage.at(tmp_path / "data"), "kitti")
    yield DataSetWriter(tasks, dataset, store, ("probe", b"")), written, clock


def add(to, count):
    for _ in range(count):
        to.queue_job(SimpleNamespace(cloud=[]))


def test_jobs_wait_a_moment_to_be_written_with_others(jobs):
    to, written, clock = jobs
    add(to, 2)
    to.step(4, more_to_come=True)
    assert written == []
    clock.now += writer.GATHER_S
    to.step(4, more_to_come=True)
    add(to, MAX_JOBS_PER_TASK)
    to.step(4, more_to_come=True)
    assert written == [2, MAX_JOBS_PER_TASK]  # those are enough
    add(to, 1)
    to.step(4, more_to_come=False)  # and nothing comes after the last
    assert written == [2, MAX_JOBS_PER_TASK, 1]
    to.close()


def test_the_worker_with_the_least_memory_for_a_slot_is_named():
    scene = Scene.seed()
    sensor = Sensor.grid(rays_per_revolution=3600, layers=64, step_deg=360)
    job = SimpleNamespace(scene=scene, survey=Survey(sensor, [(0, 0, 1)], steps=1))
    tasks = SimpleNamespace(batch_mb=1)
    workers = [
        SimpleNamespace(address=name, memory=memory, resources={"GPU": slots})
        for name, memory, slots in (("large", 10**12, 1), ("small", 10**6, 2), ("fair", 10**6, 1))
    ]
    with pytest.raises(JobError, match="the casting worker at small has"):
        check_workers(job, tasks, "numpy", workers)
    check_workers(job, tasks, "numpy", workers[:1])

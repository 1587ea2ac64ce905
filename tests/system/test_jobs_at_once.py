"""Several jobs of one driver at once: each gives what it gives alone, whatever the others do."""

from __future__ import annotations

import os
import signal
import uuid
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from distributed import Client, Worker, WorkerPlugin

import lidarpool.simulator.world
from lidarpool import Cloud, Column, Frame, LidarpoolError, Scene, Sensor, Survey
from lidarpool.base.software import software
from lidarpool.base.storage import Storage
from lidarpool.columns.parts import StoredCloud, scans_of, unpack
from lidarpool.pipeline import (
    GPU,
    LIDAR,
    CastingWorkers,
    LongStages,
    Receipt,
    RunDriver,
)
from lidarpool.pipeline.database import RunDatabase
from lidarpool.scene.actors import box
from poolpart import Partition, worker_identities

SEED, ROOM = Scene.seed(), Scene.from_meshes([box("Room", (8, 6, 3))])
SENSOR = Sensor.grid(rays_per_revolution=3600, layers=8, step_deg=2)
SURVEYS = {
    "seed": (SEED, Survey(SENSOR, [(0, 0, 1)], steps=90, keep_every=1)),
    "room": (ROOM, Survey(SENSOR, [(0, 0, 1)], steps=60)),
    "seed again": (SEED, Survey(SENSOR, [(1, 0, 2), (2, 0, 2)], steps=60, keep_every=2)),
    "seed once more": (SEED, Survey(SENSOR, [(0, 3, 1)], steps=40)),
}

pytestmark = pytest.mark.usefixtures("small_batches")


@pytest.fixture(scope="module")
def alone(cluster_client, tmp_path_factory):
    """Clouds of the surveys by themselves."""
    clouds = {}
    for name, survey in SURVEYS.items():
        together = Together(cluster_client, tmp_path_factory.mktemp("alone"), {name: survey})
        together.run()
        clouds[name] = together.cloud(name)
        together.db.close()
    return clouds


class Together:
    """Jobs of one driver, and what became of each."""

    def __init__(self, client: Client, folder: Path, surveys: dict[str, tuple[Scene, Survey]]):
        self.surveys, self.numbers = surveys, {name: n for n, name in enumerate(surveys)}
        self.storage = Storage.at(folder / "parts", durable=False)
        self.db = RunDatabase(folder / "run.db", durable=False)
        alike, mark = software("numpy"), self.db.meta["mark"]
        run = uuid.uuid4().hex[:8]
        self.driver = RunDriver(
            CastingWorkers(Partition(GPU, client), run, "numpy", alike),
            LongStages(
                Partition(LIDAR, client), run, alike["lidarpool"], self.storage, mark,
                queue_capacity=10, collectors=2, patience_s=120.0,
            ),
            self.db,
            self.storage,
        )  # fmt: skip
        self.frames: dict[str, list[int]] = {name: [] for name in surveys}
        self.failed: dict[str, str] = {}

    def run(self, on_frame: Callable[[str, Frame], None] | None = lambda name, frame: None) -> None:
        """Do all of them at once; on any error, everything has been stopped."""
        driver, names = self.driver, [*self.surveys]
        try:
            driver.open()
            for name, (scene, survey) in self.surveys.items():

                def take(frame: Frame, name: str = name) -> None:
                    self.frames[name].append(frame.scan)
                    on_frame(name, frame)

                driver.begin(
                    self.numbers[name], scene, survey, fit=1000, in_all=10**6,
                    on_frame=take if on_frame else None, read=str,
                )  # fmt: skip
            while not driver.stages.ended:
                moved = driver.stages.closed or driver.step()
                for job, error in driver.take_ended():
                    if error is not None:
                        self.failed[names[job.number]] = str(error)
                if not driver.jobs and not driver.stages.closed:
                    driver.close()
                driver.wait(0.0 if moved else 0.02)
        except BaseException as error:
            driver.stop(str(error))
            raise
        finally:
            driver.finish()

    def cloud(self, name: str) -> Cloud:
        """Points of a job."""
        survey = self.surveys[name][1]
        job = self.db.job(self.numbers[name], survey.scan_count)
        parts = job.ordered
        return StoredCloud(
            self.storage, [p.name for p in parts], [p.first for p in parts],
            [p.rows for p in parts], survey.stored_columns, job.cells, survey.precision_m,
            np.zeros(3),
        ).load()  # fmt: skip

    def check(self, alone, same_cloud, *, failed: int = 0, frames: bool = True) -> None:
        """Check that the jobs have given what they give alone."""
        assert len(self.failed) == failed
        for name, cloud in alone.items():
            scans = list(range(self.surveys[name][1].scan_count))
            assert self.frames[name] == (scans if frames else []), name
            assert same_cloud(self.cloud(name), cloud), name
        for name in self.storage.sizes():
            receipt = self.rebuilt(name)
            job = self.db.under_way[receipt.job]
            if not job.missing(receipt.first, receipt.stop) and not receipt.job >= len(alone):
                assert job.part_of(receipt.first) == replace(receipt, summaries=b"")
                assert job.summaries_of([receipt.first]) == [(receipt.first, receipt.summaries)]

    def rebuilt(self, name: str) -> Receipt:
        """Receipt of a part, made of the part alone."""
        data = self.storage.read(name)
        job, _, _ = scans_of(name, self.db.meta["mark"])
        return Receipt.of_part(unpack(data), job, name, len(data))


class CountTrees(WorkerPlugin):
    """Counts trees that workers build in the size of a file."""

    name = "count-trees"

    def __init__(self, file: Path) -> None:
        self.file = file

    def setup(self, worker: Worker) -> None:
        file, build = self.file, lidarpool.simulator.world.RayCaster

        def count(*arguments, **options):
            with file.open("ab") as opened:
                opened.write(b"x")
            return build(*arguments, **options)

        self.build, lidarpool.simulator.world.RayCaster = build, count

    def teardown(self, worker: Worker) -> None:
        lidarpool.simulator.world.RayCaster = self.build


def test_jobs_of_a_scene_share_its_trees_and_give_the_points_of_each_alone(
    client, tmp_path, alone, same_cloud, left_over
):
    trees = tmp_path / "trees"
    client.register_plugin(CountTrees(trees))
    try:
        together = Together(client, tmp_path, SURVEYS)
        together.run()
    finally:
        client.unregister_worker_plugin("count-trees")
    together.check(alone, same_cloud)
    assert 2 <= trees.stat().st_size <= 4, "two scenes on two workers"
    assert left_over(client) == ([], [], [])
    assert client.run(_kept) == dict.fromkeys(worker_identities(client), 0)


def _kept() -> int:
    from lidarpool.pipeline import rigs

    return len(rigs._kept)


@pytest.mark.slow
@pytest.mark.parametrize("partition", ["GPU", "LIDAR"])
def test_a_worker_that_dies_is_replaced_for_all_surveys(
    client, tmp_path, alone, same_cloud, left_over, partition
):
    killed: list[str] = []

    def kill(name: str, frame: Frame) -> None:
        if frame.scan == 10 and name not in killed:
            workers = worker_identities(client).items()
            address = next(a for a, w in workers if partition in w["resources"])
            killed.append(name)
            os.kill(client.run(os.getpid, workers=[address])[address], signal.SIGKILL)

    together = Together(client, tmp_path, SURVEYS)
    together.run(kill)
    assert len(killed) == len(SURVEYS)
    together.check(alone, same_cloud)
    assert left_over(client) == ([], [], [])


@dataclass(frozen=True, eq=False)
class Loose(Sensor):
    """A sensor that comes loose while it is described."""

    def firings(self, step):
        if 15 <= step < 29:
            raise FloatingPointError("the mirror is loose")
        return super().firings(step)


def faulty(returns):
    """A column that cannot be made of some scans."""
    if any(spec.scan == 12 for spec in returns.specs):
        raise FloatingPointError("the mirror is loose")
    return returns.range


def deadly(returns):
    """A column that ends its worker."""
    if any(spec.scan == 12 for spec in returns.specs):
        os.kill(os.getpid(), signal.SIGKILL)
    return returns.range


def with_column(function: Callable) -> Survey:
    column = Column("own", "float32", "m", "of one's own", function)
    return Survey(SENSOR, [(0, 0, 1)], steps=30, columns=[column])


def test_a_survey_that_fails_leaves_the_others_unharmed(
    client, tmp_path, alone, same_cloud, left_over
):
    loose = Survey(Loose(SENSOR.beams, SENSOR.head), [(0, 0, 1)], steps=30)
    bad = {"describe": (SEED, loose), "cast": (SEED, with_column(faulty))}
    together = Together(client, tmp_path, SURVEYS | bad)
    together.run()
    assert together.failed["describe"].startswith("stage generate failed: scan")
    assert together.failed["cast"].startswith("stage intersect failed: scan")
    assert all("the mirror is loose" in words for words in together.failed.values())
    together.check(alone, same_cloud, failed=2)
    assert left_over(client) == ([], [], [])


@pytest.mark.slow
def test_a_scan_that_kills_its_workers_is_found_and_the_other_surveys_go_on(
    client, tmp_path, alone, same_cloud, left_over
):
    together = Together(client, tmp_path, {**SURVEYS, "bad": (SEED, with_column(deadly))})
    together.run()
    assert together.failed["bad"].startswith("scan 12 kills the worker that runs stage intersect")
    together.check(alone, same_cloud, failed=1)
    assert left_over(client) == ([], [], [])


def test_an_error_that_all_share_ends_all(client, tmp_path, monkeypatch, left_over):
    together = Together(client, tmp_path, SURVEYS)

    def fail(name: str, frame: Frame) -> None:
        if frame.scan == 10:
            raise LidarpoolError("the disk is full")

    with pytest.raises(LidarpoolError, match="the disk is full"):
        together.run(fail)
    assert left_over(client) == ([], [], [])


def test_tiny_jobs_share_casting_tasks_and_give_the_points_of_each_alone(
    client, tmp_path, same_cloud, left_over
):
    sensor = Sensor.grid(rays_per_revolution=50, layers=2, step_deg=18)
    tiny = {
        str(n): ((ROOM, SEED)[n % 3 == 0], Survey(sensor, [(0.01 * n, 0, 1)], steps=20))
        for n in range(120)
    }
    tiny["77"] = (SEED, with_column(faulty))
    together = Together(client, tmp_path, tiny)
    together.run(on_frame=None)
    assert [*together.failed] == ["77"] and "the mirror is loose" in together.failed["77"]
    alone = {}
    for name in ("0", "3", "55", "119"):
        (tmp_path / name).mkdir()
        one = Together(client, tmp_path / name, {name: tiny[name]})
        one.run(on_frame=None)
        alone[name] = one.cloud(name)
    for name, cloud in alone.items():
        assert same_cloud(together.cloud(name), cloud)
    assert left_over(client) == ([], [], [])

"""Several surveys at once on one crew: each gives what it gives alone, whatever the others do."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest
from distributed import Client, Worker, WorkerPlugin

import lidarpool.simulator.world
from lidarpool import Column, Frame, LidarpoolError, Scene, Sensor, Survey, simulate
from lidarpool.base.storage import Storage
from lidarpool.pipeline import Crew, JobError, SurveyDriver
from lidarpool.pipeline.database import parts_folder
from lidarpool.run.job import Job
from lidarpool.run.run import Cluster
from lidarpool.run.store import RunStore
from lidarpool.run.watch import Waiting
from lidarpool.scene.actors import box
from poolpart import worker_identities

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
def alone(cluster_client):
    """Clouds of the surveys by themselves."""
    return {
        name: simulate(scene, survey, client=cluster_client, backend="numpy").cloud
        for name, (scene, survey) in SURVEYS.items()
    }


class Together:
    """Surveys that share a crew, and what became of each."""

    def __init__(self, client: Client, folder: Path, surveys: dict[str, tuple[Scene, Survey]]):
        jobs = {name: Job(*of, backend="numpy") for name, of in surveys.items()}
        self.stores = {
            name: RunStore(job, folder / name, folder / "parts") for name, job in jobs.items()
        }
        self.frames: dict[str, list[int]] = {name: [] for name in jobs}
        self.failed: dict[str, str] = {}
        self.drivers: dict[str, SurveyDriver] = {}
        first = next(iter(self.stores.values()))
        self.cluster = Cluster(client, first.job, first, print, Waiting())
        self.crew: Crew = self.cluster.crew(Storage.at(folder / "parts"), first.db.meta["mark"])

    def run(self, on_frame: Callable[[str, Frame], None] = lambda name, frame: None) -> None:
        """Do all of them at once."""

        def begun() -> Together:
            for name, store in self.stores.items():

                def take(frame: Frame, name: str = name) -> None:
                    self.frames[name].append(frame.scan)
                    on_frame(name, frame)

                folder = f"{parts_folder(store.db.meta['mark'])}/"
                self.drivers[name] = self.cluster.driver(self.crew, store, take, name, folder)
            return self

        self.cluster.run(self.crew, begun, None, lambda: None, lambda *_: None)

    # what the run steps

    @property
    def finished(self) -> bool:
        return not self.drivers

    @property
    def progress(self) -> int:
        return sum(store.db.scans_done + store.db.frames for store in self.stores.values())

    def step(self) -> bool:
        moved = False
        for name, driver in list(self.drivers.items()):
            try:
                moved |= driver.step()
            except JobError as error:
                self.failed[name] = str(error)
            if driver.finished or name in self.failed:
                self.crew.leave(self.drivers.pop(name).seat)
            if name in self.failed:  # its orders may still be under way
                self.stores[name].remove()
        return moved

    def check(self, alone, same_cloud, *, failed: int = 0) -> None:
        """Check that the surveys have given what they give alone."""
        assert len(self.failed) == failed
        for name, cloud in alone.items():
            survey = SURVEYS[name][1]
            assert self.frames[name] == list(range(survey.scan_count)), name
            assert same_cloud(self.stores[name].points().load(), cloud), name


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


def test_surveys_of_a_scene_share_its_trees_and_give_the_points_of_each_alone(
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

    return len(rigs._rigs) + len(rigs._scenes)


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
    together = Together(client, tmp_path, bad | SURVEYS)
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
    together = Together(client, tmp_path, {"bad": (SEED, with_column(deadly)), **SURVEYS})
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


def test_a_survey_whose_parts_have_no_folder_fails_alone(
    client, tmp_path, alone, same_cloud, left_over
):
    gone = {"gone": (SEED, Survey(SENSOR, [(0, 0, 1)], steps=900))}
    together = Together(client, tmp_path, gone | SURVEYS)

    def remove(name: str, frame: Frame) -> None:
        if name == "gone" and frame.scan == 1:
            Path(together.stores[name].storage.url).rename(tmp_path / "elsewhere")

    together.run(remove)
    assert "cannot be kept in" in together.failed["gone"]
    together.check(alone, same_cloud, failed=1)
    assert left_over(client) == ([], [], [])

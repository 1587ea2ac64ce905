"""Jobs of a campaign that are cast at once: each gives what it gives alone, whatever others do."""

import gc
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from distributed import Client
from tests.clusters import thread_cluster
from tests.daemons import wait_until

import lidarsim.casting.static_bodies
from lidarpool import Campaign, Column, Job, Scene, Sensor, Survey, box, save_cloud, simulate
from lidarpool.run.pipeline import rigs

SEED = Scene.seed()
ROOM = Scene.from_meshes([box("Room", (8, 6, 3))])
SENSOR = Sensor.grid(rays_per_revolution=900, layers=8, step_deg=2)

pytestmark = pytest.mark.usefixtures("small_batches")


def plain(returns: Any) -> Any:
    return returns.range


def faulty(returns: Any) -> Any:
    """A column that cannot be made of some scans."""
    if any(spec.scan == 12 for spec in returns.specs):
        raise FloatingPointError("the mirror is loose")
    return returns.range


@dataclass(frozen=True, eq=False)
class Loose(Sensor):
    """A sensor that comes loose while a worker describes it."""

    def firings(self, step: int) -> tuple[int, int]:
        if 15 <= step < 29 and "Dask-Default-Threads" in threading.current_thread().name:
            raise FloatingPointError("the mirror is loose")
        return super().firings(step)


def survey(column: Callable[[Any], Any] = plain, sensor: Sensor = SENSOR, **more: Any) -> Survey:
    own = Column("own", "float32", "m", "of one's own", column)
    return Survey(sensor, **{"poses": [(0, 0, 1)], "columns": [own]} | more)


JOBS = [
    (SEED, survey(steps=90, keep_every=1)),
    (ROOM, survey(steps=60)),
    (SEED, survey(poses=[(1, 0, 2), (2, 0, 2)], steps=60, keep_every=2)),
    (SEED, survey(poses=[(0, 3, 1)], steps=40)),
]


@pytest.fixture
def client() -> Iterator[Client]:
    """Client of threads: two casting workers, and slots for the stages of a campaign."""
    slots = ({"GPU": 1}, {"GPU": 1, "second": 1}, {"LIDAR": 5})
    with thread_cluster(*slots) as cluster, Client(cluster, set_as_default=False) as client:
        yield client


def run(client: Client, folder: Path, jobs: list[tuple[Scene, Survey]]) -> Any:
    def make(number: int, rng: np.random.Generator) -> Job:
        return Job(*jobs[number], values={"number": number})

    return Campaign(make, len(jobs), keep="folder").run(folder, client=client, backend="numpy")


def check(folder: Path, numbers: range, jobs: list[tuple[Scene, Survey]], client: Client) -> None:
    """Check that jobs have given what they give alone."""
    for number in numbers:
        scene, what = jobs[number]
        alone = simulate(scene, what, client=client, backend="numpy").points
        save_cloud(alone, folder / "alone.ply")
        (made,) = (folder / "jobs").glob(f"*{number:02}/cloud.ply")
        assert made.read_bytes() == (folder / "alone.ply").read_bytes(), number


@pytest.mark.slow
def test_jobs_of_a_scene_share_its_trees_and_others_that_fail_do_no_harm(
    client, tmp_path, left_over, monkeypatch
):
    before = {*rigs.cached_rigs}  # of other tests of this process
    trees = []
    build = lidarsim.casting.static_bodies.RayCaster
    monkeypatch.setattr(
        lidarsim.casting.static_bodies,
        "RayCaster",
        lambda *a, **o: trees.append(1) or build(*a, **o),
    )
    loose = survey(sensor=Loose(SENSOR.beams, SENSOR.head), steps=30)
    made = run(client, tmp_path, [*JOBS, (SEED, loose), (SEED, survey(faulty, steps=30))])
    assert [row.number for row in made.failed] == [4, 5] and made.done == 4
    assert all("the mirror is loose" in row.error for row in made.failed)
    assert 2 <= len(trees) <= 4, "two scenes on two workers"
    assert left_over(client) == ([], [], [])
    wait_until(lambda: rigs.cached_rigs.keys() <= before)  # workers are told, and not waited for
    check(tmp_path, range(4), JOBS, client)


@pytest.mark.slow
def test_tiny_jobs_share_casting_tasks_and_give_the_points_of_each_alone(
    client, tmp_path, left_over
):
    sensor = Sensor.grid(rays_per_revolution=50, layers=2, step_deg=18)
    tiny = [
        ((ROOM, SEED)[n % 3 == 0], survey(sensor=sensor, poses=[(0.01 * n, 0, 1)], steps=20))
        for n in range(60)
    ]
    tiny[37] = (SEED, survey(faulty, sensor, steps=20))
    gc.disable()  # what a job's error keeps alive must not decide when its scene leaves the cluster
    try:
        made = run(client, tmp_path, tiny)
        assert left_over(client) == ([], [], [])
    finally:
        gc.enable()
    assert [row.number for row in made.failed] == [37]
    assert "the mirror is loose" in made.failed[0].error
    check(tmp_path, range(0, 60, 19), tiny, client)

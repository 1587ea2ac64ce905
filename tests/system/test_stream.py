"""Campaigns that are streamed: sweeps from the workers to the reader, without files."""

from __future__ import annotations

import os
import pickle
import types
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import cloudpickle
import numpy as np
import psutil
import pytest
from distributed import Client
from tests.clusters import thread_cluster
from tests.daemons import wait_until
from tests.drives import SCANS, TURNS, the_scene

import lidarpool as lp
from lidarpool import Campaign, Job, LidarError, Mounted, Noise, Pose, Sensor, Survey, Sweep
from lidarpool.processes.tracing import trace_to
from lidarsim.motion.rotations import matrices

SCENE = the_scene()
SWEEPS = 2 * TURNS  # of a job


def make(number: int, rng: np.random.Generator) -> Job:
    """A job of two sensors that pass two cars."""
    track = lp.Track([0, 1], [[0, number, 1], [10, 5, 1]])
    lidar = Sensor.grid(360, 4)
    sensors = [Mounted(lidar, Pose((1, 0, 0.5), 30.0), "front"), Mounted(lidar, name="rear/left")]
    survey = Survey(
        sensors=sensors, trajectory=track, steps=TURNS * SCANS, noise=Noise(range_m=0.02),
        keep_every=1, columns=["intensity", "class", "time"],
    )  # fmt: skip
    return Job(SCENE, survey, values={"x": number + 0.5})


def campaign(count: int = 3, **options: Any) -> Campaign:
    return Campaign(make, count, seed=4, **options)


def same(one: Sweep, two: Sweep, columns: set[str]) -> bool:
    """Whether two sweeps are equal to the bit, in these columns."""
    plain = ("job", "job_number", "split", "values", "sensor", "number", "time_ns", "object_names")
    boxes = ("names", "types", "objects", "centers", "quaternions", "sizes", "points")
    return (
        all(getattr(one, name) == getattr(two, name) for name in plain)
        and one.points.tobytes() == two.points.tobytes()
        and one.pose.tobytes() == two.pose.tobytes()
        and all(one.columns[name].tobytes() == two.columns[name].tobytes() for name in columns)
        and all(np.array_equal(getattr(one.boxes, n), getattr(two.boxes, n)) for n in boxes)
    )


@pytest.fixture(scope="module")
def expected(local_client: Client) -> list[Sweep]:
    """All sweeps of a campaign that nobody disturbs."""
    return list(campaign().stream(client=local_client))


@pytest.mark.slow
@pytest.mark.slow(keep=("kitti",))
@pytest.mark.parametrize("keep", ["parquet", "kitti", "webdataset"])
def test_the_sweeps_are_those_of_the_data_set(cluster_client, client, tmp_path, torch, keep):
    splits = {"train": 0.5, "test": 0.5}
    varied = campaign(keep=keep, splits=splits)
    with (
        thread_cluster({"GPU": 1}, {"LIDAR": 5}) as cluster,
        Client(cluster, set_as_default=False) as writers,
    ):
        varied.run(tmp_path / "ds", client=writers)
    saved = list(lp.sweeps(tmp_path / "ds"))
    fresh = list(varied.stream(client=client))
    assert len(fresh) == len(saved) == 3 * SWEEPS and sum(map(len, fresh)) > 1000
    assert any(sweep.boxes.points.any() for sweep in fresh)
    for one, two in zip(saved, fresh, strict=True):
        assert same(one, two, {*one.columns}) and {*one.columns} <= {*two.columns}
    chosen = list(varied.stream(client=cluster_client, split="test", ahead=1))
    saved = list(lp.sweeps(tmp_path / "ds", split="test"))
    assert [one.job for one in chosen] == [one.job for one in saved] != []
    assert all(same(one, two, {*one.columns}) for one, two in zip(saved, chosen, strict=True))
    for _ in range(2):  # epochs of a network
        items = lp.sweeps(tmp_path / "ds").torch(), varied.stream(client=client).torch()
        for one, two in zip(*items, strict=True):
            assert {"points", "intensity", "class", "boxes", "pose"} <= one.keys() <= two.keys()
            assert all(np.array_equal(one[name], two[name]) for name in one)


@pytest.mark.extended
def test_normals_and_origins_are_in_the_axes_of_the_points(client):
    normal_names = ["normal_x", "normal_y", "normal_z"]
    origin_names = ["origin_x", "origin_y", "origin_z"]

    def with_vectors(number: int, rng: np.random.Generator) -> Job:
        job = make(number, rng)
        columns = ["range", "incidence_deg", *normal_names, *origin_names]
        return replace(
            job, survey=replace(job.survey, noise=Noise(), columns=columns, precision_m=1e-4)
        )

    for sweep in Campaign(with_vectors, 2, seed=4).stream(client=client):
        normal = np.stack([sweep.columns[name] for name in normal_names], axis=1)
        origin = np.stack([sweep.columns[name] for name in origin_names], axis=1)
        ray = sweep.points - origin
        np.testing.assert_allclose(np.linalg.norm(ray, axis=1), sweep.columns["range"], atol=2e-3)
        cosine = -(ray * normal).sum(axis=1) / sweep.columns["range"]
        expected = np.cos(np.radians(sweep.columns["incidence_deg"]))
        np.testing.assert_allclose(cosine, expected, atol=2e-3)


@pytest.mark.parametrize("keep", ["kitti", "webdataset"])
def test_points_in_sensor_coordinates_are_those_of_the_format(cluster_client, keep):
    """KITTI stores compensated points, whatever the coordinates of the job."""

    def in_sensor(number: int, rng: np.random.Generator) -> Job:
        job = make(number, rng)
        return replace(
            job, survey=replace(job.survey, noise=Noise(), precision_m=1e-4, coordinates="sensor")
        )

    def in_world(number: int, rng: np.random.Generator) -> Job:
        job = make(number, rng)
        return replace(job, survey=replace(job.survey, noise=Noise(), precision_m=1e-4))

    streams = [
        Campaign(job, 1, keep=keep).stream(client=cluster_client) for job in (in_sensor, in_world)
    ]
    for sweep, compensated in zip(*streams, strict=True):
        assert compensated.compensated is True
        assert sweep.compensated is (keep == "kitti")
        difference_m = np.abs(sweep.points - compensated.points).max(initial=0)
        assert (difference_m < 0.002) == (keep == "kitti")


@pytest.mark.parametrize(("compensated", "outside_m"), [(False, 0.3), (True, 0.003)])
def test_points_of_actors_are_moved_into_their_boxes(cluster_client, compensated, outside_m):
    """A car passes at 5 m/s, so that it moves by 0.5 m in a sweep."""

    def past(number: int, rng: np.random.Generator) -> Job:
        car = replace(SCENE.actors[0], trajectory=lp.Track([0, 1], [[2, 5, 0], [7, 5, 0]]))
        job = make(number, rng)
        survey = replace(job.survey, noise=Noise(), precision_m=1e-3)
        return replace(job, scene=replace(SCENE, actors=(car,)), survey=survey)

    keep = {"format": "kitti", "compensated_actors": compensated}
    farthest_m = []
    for sweep in Campaign(past, 1, keep=keep).stream(client=cluster_client):
        (actor,) = sweep.boxes.objects
        points = sweep.points[sweep.objects == actor]
        assert len(points) == sweep.boxes.points[0]
        inside = (points - sweep.boxes.centers[0]) @ matrices(sweep.boxes.quaternions)[0]
        outside = np.abs(inside) - sweep.boxes.sizes[0] / 2
        farthest_m.append(outside.max(initial=0))
    if compensated:
        assert max(farthest_m) < outside_m
    else:
        assert max(farthest_m) > outside_m


@pytest.mark.slow
def test_sweeps_of_a_killed_worker_are_cast_again(client, sabotage, expected):
    armed = sabotage("intersect.cast", SCANS)
    pids = set(client.run(os.getpid).values())

    def disarm() -> None:
        wait_until(lambda: pids - {*client.run(os.getpid, on_error="ignore").values()})
        armed.unlink()

    with ThreadPoolExecutor(1) as pool:
        disarmed = pool.submit(disarm)
        again = list(campaign().stream(client=client))
        disarmed.result()
    columns = {*expected[0].columns}
    assert all(same(one, two, columns) for one, two in zip(expected, again, strict=True))


@pytest.mark.extended
def test_a_pickled_stream_gives_the_same_sweeps(cluster_client, expected):
    """Here, and in a task of its cluster."""
    data = cloudpickle.dumps(campaign(1).stream(client=cluster_client))
    columns = {*expected[0].columns}

    def read() -> list[Sweep]:
        return list(cloudpickle.loads(data))

    in_task = cluster_client.submit(read, resources={"OTHER": 1}, pure=False).result(timeout=300)
    for again in (read(), in_task):
        pairs = zip(expected[:SWEEPS], again, strict=True)
        assert all(same(one, two, columns) for one, two in pairs)
    assert pickle.loads(pickle.dumps(campaign(1).stream(client=cluster_client, ahead=3))).ahead == 3


def test_no_workers_are_started_in_a_task(cluster_client):
    def run() -> None:
        lp.simulate(lp.Scene.seed(), Survey(poses=[(0, 0, 1)]))

    task = cluster_client.submit(run, resources={"OTHER": 1}, pure=False)
    with pytest.raises(LidarError, match=r"which is not possible in a Dask task\. Pass `client"):
        task.result(timeout=300)
    task.release()  # the error has frames that hold it


@pytest.mark.extended
def test_one_that_is_left_early_leaves_nothing(client, left_over):
    before = {child.pid for child in psutil.Process().children(recursive=True)}
    for sweep in campaign().stream(gpu_workers=1):
        assert (sweep.job, sweep.number) == ("0000", 0)
        break
    del sweep

    def others() -> set[int]:
        return {child.pid for child in psutil.Process().children(recursive=True)} - before

    wait_until(lambda: not others())
    for _ in campaign().stream(client=client):
        break
    assert left_over(client) == ([], [], [])


@pytest.fixture
def cast() -> Iterator[list[tuple[int, int]]]:
    """Sweeps that workers in threads have cast: (job, number)."""
    found: list[tuple[int, int]] = []

    def note(point: str, fields: Any) -> None:
        if point == "intersect.start":
            found.extend({(fields["job"], scan // SCANS) for scan in fields["scans"]})

    trace_to(note)
    yield found
    trace_to(None)


def test_casting_waits_for_the_reader(cluster_client, cast):
    stream = iter(campaign(4).stream(client=cluster_client, ahead=3))
    for read in range(1, 4 * SWEEPS - 3):
        next(stream)
        wait_until(lambda read=read: len(cast) > read)  # without the reader
        assert len(cast) == len({*cast}) < read + 3
    stream.close()


def test_jobs_that_fail_are_left_out(cluster_client, caplog):
    def some(number: int, rng: np.random.Generator) -> Job:
        if number == 1:
            raise RuntimeError("no such street")
        return make(number, rng)

    sweeps = list(Campaign(some, 3).stream(client=cluster_client))
    assert [sweep.job_number for sweep in sweeps] == [0] * SWEEPS + [2] * SWEEPS
    (told,) = [record.getMessage() for record in caplog.records if "was skipped" in record.message]
    assert told.startswith("Job 0001 of the stream was skipped") and "no such street" in told


def test_the_first_job_without_points_is_named(cluster_client, caplog):
    far = Survey(Sensor.grid(90, 2, step_deg=30), poses=[(0, 0, 10_000)], steps=12)
    sweeps = list(Campaign(lambda number, rng: Job(SCENE, far), 3).stream(client=cluster_client))
    assert [len(sweep.points) for sweep in sweeps] == [0] * 3
    (told,) = [record.getMessage() for record in caplog.records if "no points" in record.message]
    assert told.startswith("Job 0000 of the stream has no points: no ray hits a surface")
    assert told.endswith("Further jobs without points are not reported.")


def test_errors_are_told_in_a_line(cluster_client):
    for options, words in (
        ({"ahead": 0}, "ahead must be a whole number at least 1, but is 0"),
        ({"split": "tran"}, r"Unknown split 'tran'\. Did you mean 'train'"),
        ({"split": "x"}, r"Unknown split 'x'\. Available splits: train, test"),
    ):
        with pytest.raises(LidarError, match=words) as told:
            campaign(splits={"train": 0.5, "test": 0.5}).stream(client=cluster_client, **options)
        assert "\n" not in str(told.value)
    with (
        thread_cluster({"LIDAR": 1}) as cluster,
        Client(cluster, set_as_default=False) as client,
        pytest.raises(LidarError, match="GPU"),
    ):
        next(iter(campaign().stream(client=client, startup_timeout_s=0)))


def test_a_cluster_that_is_lost_ends_it():
    with thread_cluster({"GPU": 1}) as cluster:
        client = Client(cluster, set_as_default=False)
        stream = iter(campaign(9).stream(client=client, ahead=1))
        next(stream)
        client.close()
        with pytest.raises(LidarError, match="lost its cluster"):
            list(stream)


# -- PyTorch ---------------------------------------------------------------------------------------


@pytest.mark.extended
def test_torch_divides_jobs_between_ranks(cluster_client, torch):
    stream = campaign(5).stream(client=cluster_client, ahead=4)
    torch.distributed.is_available = torch.distributed.is_initialized = lambda: True
    torch.distributed.get_world_size = lambda: 2
    for rank, jobs in ((0, (0, 2)), (1, (1, 3))):
        torch.distributed.get_rank = lambda rank=rank: rank
        items = list(stream.torch())
        assert [item["job"] for item in items] == [f"{n:04}" for n in jobs for _ in range(SWEEPS)]
        assert items[0]["points"].dtype == np.float32 and items[0]["boxes"].shape[1] == 7
    assert next(iter(stream.torch(transform=lambda sweep: sweep.job))) == "0001"
    torch.utils.data.get_worker_info = lambda: types.SimpleNamespace(id=0, num_workers=2)
    with pytest.raises(LidarError, match="num_workers=0"):
        next(iter(stream.torch()))

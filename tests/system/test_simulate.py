"""What a survey gives, against what it must give by geometry."""

import logging
import re
import time
import urllib.error
import urllib.request
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from distributed import Client, Queue, Variable
from tests.clusters import thread_cluster
from tests.shapes import room

from lidarpool import LidarError, Planning, ScanSpec, Scene, Sensor, Survey, simulate
from lidarpool.processes.shared_memory import SharedHandle
from lidarpool.run.pipeline.casting_workers import INLINE_BYTES
from lidarpool.run.pipeline.stage_messages import ScanRange
from lidarscenario.demo import demo_scenario
from lidarscenario.prepare import prepare
from poolpart import Pool

LONG_S = 60.0  # for what happens at once, or the test fails


@pytest.fixture
def client(cluster_client):
    return cluster_client


SENSOR = Sensor.grid(rays_per_revolution=90, layers=8, vertical_fov_deg=80, step_deg=7)


def test_every_ray_from_within_a_closed_room_hits_its_sides(client):
    survey = Survey(SENSOR, poses=[(1, 1, 0), (-2, 0.5, 1)], steps=60, keep_every=1)
    result = simulate(room(), survey, client=client)
    cloud = result.cloud
    assert result.hit_count == result.rays == survey.ray_count == len(cloud)
    inside = np.abs(cloud.positions) <= [5.005, 4.005, 3.005]
    assert inside.all()
    axis = {0: (0, -5), 1: (0, 5), 2: (1, -4), 3: (1, 4), 4: (2, -3), 5: (2, 3)}
    side = cloud.object
    for number, (k, value) in axis.items():
        assert np.abs(cloud.positions[side == number, k] - value).max() <= 0.005 + 1e-9
    # 60 steps of 7 degrees are more than one revolution, so sectors wrap around.
    rays = np.concatenate([np.arange(spec.ray_count) % SENSOR.channels for spec in survey.scans()])
    assert np.array_equal(cloud.channel, rays)


@pytest.mark.extended
def test_a_scene_comes_to_workers_that_see_the_drivers_memory_and_to_others(monkeypatch):
    load = SharedHandle.load
    seen: list[object] = []

    def load_or_fail(handle):
        if not seen:
            raise FileNotFoundError(handle.path)
        seen.append(handle)
        return load(handle)

    monkeypatch.setattr(SharedHandle, "load", load_or_fail)
    scene = Scene.seed()
    assert scene.vertices.nbytes > INLINE_BYTES
    clouds = []
    survey = Survey(SENSOR, [(0, 0, 1)], 9)
    with (
        thread_cluster({"GPU": 1}, {"LIDAR": 4}) as cluster,
        Client(cluster, set_as_default=False) as client,
    ):
        for _ in range(2):
            clouds.append(simulate(scene, survey, client=client).cloud)
            seen.append("from now on")
    assert sum(isinstance(handle, SharedHandle) for handle in seen) == 1  # the worker loaded it
    assert len(clouds[0]) and np.array_equal(clouds[0].positions, clouds[1].positions)


def test_planning_runs_beside_the_survey(client):
    planning = Planning((25, 25), (-30, -20), [(0, 0)], 2.0, trials=5, particles=50, iterations=20)
    progress = []
    result = simulate(
        room(), Survey(SENSOR, [(0, 0, 0)], 5), planning, client=client, on_progress=progress.append
    )
    assert [trial.trial for trial in result.trials] == list(range(5))
    assert result.plan.collision_free
    assert progress[-1].trials_done == 5
    assert progress[-1].collected == progress[-1].framed == progress[-1].generated == 5
    again = simulate(room(), Survey(SENSOR, [(0, 0, 0)], 5), planning, client=client)
    assert np.array_equal(again.plan.path, result.plan.path)


def test_a_run_has_a_page_of_partitions_as_long_as_it_lasts(client, caplog):
    pages = []

    def look(_):
        said = next(text for text in caplog.messages if text.startswith("partitions page: http://"))
        pages.append(said.removeprefix("partitions page: "))
        with urllib.request.urlopen(pages[0], timeout=120) as page:
            pages.append(page.read().decode())

    with caplog.at_level(logging.INFO, "lidarpool"):
        simulate(room(), Survey(SENSOR, [(0, 0, 0)]), client=client, on_progress=look)
    assert all(f">{name}</td>" in pages[-1] for name in ("GPU", "LIDAR", "OTHER", "intersect"))
    with pytest.raises(urllib.error.HTTPError, match="404"):
        urllib.request.urlopen(pages[0], timeout=120)


@pytest.fixture
def plain(client):
    """Another client of the cluster, which uses Dask's own classes only."""
    with Client(client.scheduler.address, set_as_default=False) as plain:
        yield plain


def queue_sizes(plain, names):
    return {name: Queue(name, plain).qsize() for name in names}


@pytest.mark.slow
def test_another_client_watches_the_queues_and_variables_of_the_default_survey(client, plain):
    """Stage 1 is ahead of the driver at the start; stages 3 and 4 are while it handles a frame."""
    job = prepare(demo_scenario())
    sizes = Counter()
    states = {}

    def look():
        names = Pool.from_client(plain).pipes()
        until = time.monotonic() + 5
        while time.monotonic() < until:
            for name, size in queue_sizes(plain, names).items():
                kind = re.sub(r"^lidarpool-[0-9a-f]+-", "", name)
                sizes[kind] = max(sizes[kind], size)
                states[kind] = Variable(name, plain).get(timeout=LONG_S)
            if sizes["scans"] and (sizes["news"] or not looked_at_frames):
                break

    looked_at_frames = []

    def look_at_frame(frame):
        if not looked_at_frames or not sizes["news"]:
            looked_at_frames.append(frame)
            look()

    def look_at_progress(_):
        if not sizes["scans"]:
            look()

    result = simulate(
        job.scene,
        job.survey,
        client=client,
        on_frame=look_at_frame,
        on_progress=look_at_progress,
    )
    assert result.rays == job.survey.ray_count
    assert {"scans", "news", "generate-0", "sort-1", "collect-0-2"} <= states.keys()
    assert sizes["scans"] >= 1
    assert sizes["news"] >= 1
    for state in states.values():
        assert state["owner"] == client.id
        assert not state["closed"]
        assert not state["failure"]
    assert not Pool.from_client(plain).pipes()


def test_frames_have_their_hits_on_each_triangle(cluster_client):
    """The sums are those of the run, which counts hits when they are cast."""
    scene = room()
    survey = Survey(SENSOR, [(0, 0, 1)], steps=4, columns=["triangle"])
    counts = []

    def count(frame):
        counts.append(frame.hit_counts())
        assert counts[-1].sum() == frame.hit_count
        triangle, hits = np.unique(frame.points()["triangle"], return_counts=True)
        assert np.array_equal(counts[-1][triangle], hits)

    result = simulate(scene, survey, client=cluster_client, on_frame=count, pace=1e6)
    assert len(counts) == 4
    assert np.array_equal(sum(counts), result.hit_counts) and result.hit_count == 56
    for change, message in (
        ({"keep_every": 3}, "keeps only one of every 3 hits. Set `keep_every` to 1"),
        ({"columns": []}, "without the column `triangle`. Add it to the `columns`"),
    ):
        other = replace(survey, **change)
        with pytest.raises(LidarError, match=message):
            simulate(scene, other, client=cluster_client, on_frame=lambda f: f.hit_counts())


@pytest.mark.extended(every=2)
@pytest.mark.slow(every=3)
@pytest.mark.parametrize("kind", ["scans", "news", "generate-0", "sort-1", "collect-0-2"])
def test_a_pipe_that_another_client_closes_ends_the_run_with_its_name(client, plain, kind):
    closed = []
    items = []

    def close(_):
        names = [name for name in Pool.from_client(plain).pipes() if name.endswith(f"-{kind}")]
        if closed or not names or (kind == "scans" and not Queue(names[0], plain).qsize()):
            return
        if kind == "scans":
            items.append(Queue(names[0], plain).get(timeout=LONG_S))
        variable = Variable(names[0], plain)
        variable.set({**variable.get(timeout=LONG_S), "closed": True})
        closed.append(names[0])

    survey = Survey(SENSOR, [(0, 0, 0)], steps=4000)  # the pipe of scans fills often enough
    with pytest.raises(LidarError, match=f"a different client closed.*-{kind}'"):
        simulate(room(), survey, client=client, on_progress=close, on_frame=close)
    assert closed
    assert all(isinstance(item, ScanRange) for item in items)
    assert len(items) == (kind == "scans")


def test_a_client_that_has_given_its_scheduler_up_is_told_of_in_one_sentence(client):
    """It closes itself some seconds after the scheduler was lost."""
    address = client.scheduler.address
    survey = Survey(SENSOR, [(0, 0, 0)])
    with (
        Client(address, set_as_default=False) as lost,
        pytest.raises(LidarError, match=f"The cluster at {address} is no longer reachable"),
    ):
        simulate(room(), survey, client=lost, on_frame=lambda _: lost.close())


def raise_at(scan: int | str | None, scan_of=None):
    """A stand-in that fails, at one scan or stage if it can tell which it is about."""

    def fail(*arguments, **_):
        if scan is None or scan_of(arguments) == scan:
            raise FloatingPointError("the mirror is loose")
        return ScanSpec(0, 0, (0, 1))

    return fail


@pytest.mark.extended(every=3)
@pytest.mark.parametrize(
    ("target", "stand_in", "message"),
    [
        (
            "lidarsim.survey.survey.Survey.scan",
            raise_at(0, lambda arguments: arguments[1]),
            "Stage generate failed: scan 0: FloatingPointError",
        ),
        (
            "lidarsim.simulator.rig.Rig.cast",
            raise_at(None),
            r"Stage intersect failed: scan \d+: FloatingPointError",
        ),
        (
            "lidarsim.casting.static_bodies.RayCaster",
            raise_at(None),
            "Preparing the scene on the casting workers failed: .*the mirror is loose",
        ),
        (
            "lidarpool.run.pipeline.stage4_collect.pack",
            raise_at(None),
            r"Stage collect failed: scan \d+: FloatingPointError",
        ),
        (
            "lidarpool.run.pipeline.stage_messages.StageStart.trace",
            raise_at("sort", lambda arguments: arguments[0].stage),
            "Stage sort failed: the mirror is loose",
        ),
        (
            "lidarpool.run.planning_trials.run_trial",
            raise_at(None),
            "Planning trial 0 failed: .*the mirror",
        ),
    ],
)
def test_a_failure_anywhere_ends_the_run_and_says_where(
    client, monkeypatch, left_over, target, stand_in, message
):
    monkeypatch.setattr(target, stand_in)
    planning = Planning((25, 25), (-30, -20), [(0, 0)], 2.0, trials=1, particles=50, iterations=20)
    survey = Survey(SENSOR, [(0, 0, 0)], 20)
    with pytest.raises(LidarError, match=message):
        simulate(room(), survey, planning, client=client)
    assert left_over(client) == ([], [], [])

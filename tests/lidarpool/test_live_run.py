"""A run on its live page: the parts that it commits, those of an earlier run, and its end."""

import re
import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import version

import msgspec
import numpy as np
import pytest
from tests.lidarpool.test_live_visitors import CAMERA
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from lidarpool import Column, Frame, Planning, Pose, Scene, Sensor, Survey
from lidarpool.columns.parts import PartColumns, pack
from lidarpool.live import LiveRun, live_points, live_run
from lidarpool.live.display import POSITION
from lidarpool.live.live_points import PARTS_AT_ONCE, PARTS_NOTED, LivePoints, PartChoice
from lidarpool.live.run_scene import SampleRays, sensor_places
from lidarpool.run.connection import local_client
from lidarpool.run.job import Job
from lidarpool.run.run import Run
from lidarpool.run.store import RunStore
from lidarpool.scan import Receipt
from lidarpool.scan.messages import samples_of_scan, summary_type

LONG_S = 120.0
SCENE = Scene.seed()
FACES = len(SCENE.faces)
ORIGIN = SCENE.origin
WETNESS = Column("wetness", "float32", "%", "how wet it is", source="intensity")


def make_job(scans: int, columns=()) -> Job:
    """Make a survey from two poses, 1 m and 5 m up, in cells of half a metre."""
    survey = Survey(
        Sensor.grid(),
        [(0, 0, 1), (0, 0, 5)],
        steps=scans // 2,
        precision_m=0.5,
        columns=columns,
    )
    return Job(SCENE, survey)


def commit(store: RunStore, first: int, count: int, hits: int | None = None, triangle=7, **more):
    """Commit a part of one scan, as a run does: so many points 3 m up, and hits on a triangle."""
    hits = count * 5 if hits is None else hits
    cells = {axis: np.full(count, 6 if axis == "z" else 0, np.int32) for axis in "xyz"}
    columns = {
        **cells,
        "channel": np.full(count, 3, np.uint16),
        "object": np.zeros(count, np.int32),
        **more,
    }
    one = int(hits > 0)
    part = PartColumns(
        first,
        np.array([count]),
        columns,
        np.full(one, triangle, np.int32),
        np.full(one, hits, np.int64),
    )
    name, data = f"p{first}.npz", bytes(pack(part))
    store.storage.prepare()
    store.storage.write(name, data)
    samples = samples_of_scan(store.job.survey.scan_count)
    summaries = np.zeros(1, summary_type(samples)).tobytes()
    box = tuple(part.cells.ravel().tolist()) if count else ()
    receipt = Receipt(-1, first, first + 1, name, count, len(data), hits, box, summaries)
    new = store.db.commit([receipt])
    if store.on_parts:
        store.on_parts(new)


@contextmanager
def looked_at(live: LiveRun):
    """Have somebody look at a page: whatever is drawn is drawn for them."""
    url = live.url.replace("http", "ws", 1)
    with connect(
        url, subprotocols=[f"viser-v{version('viser')}"], max_size=None, compression=None
    ) as socket:
        socket.send(msgspec.msgpack.encode(CAMERA))

        def take():
            try:
                for _ in socket:
                    pass
            except ConnectionClosed:
                return

        thread = threading.Thread(target=take)
        thread.start()
        yield
    thread.join(LONG_S)


def panel(live: LiveRun) -> str:
    return re.sub(r"<[^>]*>", " ", live._text.content)


def wait_for(condition):
    """Wait for what is drawn by itself."""
    stop = time.monotonic() + LONG_S
    while not condition():
        assert time.monotonic() < stop, "it was not drawn"
        time.sleep(0.02)


# -- the choice of parts ------------------------------------------------------------------


def receipt(number, rows=10):
    return Receipt(-1, number, number + 1, str(number), rows, 0, 5 * rows, (), b"")


def test_few_parts_are_all_chosen_in_their_order():
    choice = PartChoice(4)
    choice.add([receipt(i) for i in range(4)])
    taken = choice.take(3)
    assert [group.name for group in taken + choice.take(3)] == ["0", "1", "2", "3"]
    assert len(choice) == 0


def test_of_many_parts_each_that_is_read_stands_for_about_as_many():
    choice = PartChoice(PARTS_NOTED)
    for i in range(5000):
        choice.add([receipt(i)])
    assert len(choice) == PARTS_NOTED
    groups = choice.take(PARTS_NOTED)
    assert sum(group.parts for group in groups) == 5000
    assert sum(group.rows for group in groups) == 50_000
    assert sum(group.hits for group in groups) == 250_000
    counts = [group.parts for group in groups]
    assert max(counts) <= 4 * min(counts)
    numbers = [int(group.name) for group in groups]
    assert numbers == sorted(numbers)


def test_a_part_with_nothing_in_it_stands_for_none_that_has_something():
    choice = PartChoice(1)
    choice.add([receipt(0, 0), receipt(1, 9), receipt(2, 0)])
    [group] = choice.take(5)
    assert (group.name, group.parts, group.rows) == ("1", 3, 9)


# -- points and hits ----------------------------------------------------------------------


def test_points_are_in_metres_and_know_how_far_the_sensor_was():
    store = RunStore(make_job(4, [WETNESS]))
    live = LivePoints(store.job)
    assert [q.name for q in live.quantities] == [
        "height", "range", "scan", "channel", "object", "wetness",
    ]  # fmt: skip
    commit(store, 1, 2, wetness=np.float32([1, 2]))
    commit(store, 2, 1, wetness=np.float32([3]))
    live.parts.add(store.db.ordered)
    assert live.gather(store) is False
    rows = live.rows
    assert live.seen == 3
    assert rows[POSITION].tolist() == [[0, 0, 3]] * 3
    assert rows["height"].tolist() == [3 + ORIGIN[2]] * 3
    assert rows["range"].tolist() == [2, 2, 2]
    assert rows["scan"].tolist() == [1, 1, 2]
    assert rows["wetness"].tolist() == [1, 2, 3]
    assert set(rows["channel"]) == {3}
    assert live.hit_counts[7] == live.hits == 15


def test_a_range_that_was_measured_is_shown_as_it_is():
    store = RunStore(make_job(2, ["range"]))
    live = LivePoints(store.job)
    commit(store, 0, 1, range=np.float32([42]))
    live.parts.add(store.db.ordered)
    live.gather(store)
    assert [q.name for q in live.quantities].count("range") == 1
    assert live.rows["range"].tolist() == [42]


def test_of_many_parts_few_are_read_and_all_of_them_count(monkeypatch):
    read, opened = live_points.read_part, []

    def counting(storage, name):
        opened.append(name)
        return read(storage, name)

    monkeypatch.setattr(live_points, "read_part", counting)
    store = RunStore(make_job(600))
    live = LivePoints(store.job, most=500)
    for scan in range(600):
        commit(store, scan, 40 + scan % 3, triangle=scan % 10)
    live.parts.add(store.db.ordered)
    assert live.gather(store) is True
    assert len(opened) == PARTS_AT_ONCE
    while live.gather(store):
        pass
    assert len(opened) == PARTS_NOTED
    assert live.seen == store.db.point_count
    assert live.hits == store.db.hits
    assert live.hit_counts.sum() == pytest.approx(store.db.hits)
    assert 200 < len(live.rows) <= 500
    by_tenth = np.histogram(live.rows["scan"], bins=10, range=(0, 600))[0]
    assert by_tenth.min() > 0.5 * by_tenth.mean()


def test_points_are_bounded_and_hits_exact_where_all_parts_are_read():
    store = RunStore(make_job(100))
    live = LivePoints(store.job, most=100)
    for scan in range(100):
        commit(store, scan, 33, hits=100 + scan, triangle=scan % 10)
        live.parts.add([store.db.part_of(scan)])
        live.gather(store)
    assert live.seen == 3300
    assert 40 < len(live.rows) <= 100
    assert np.array_equal(live.hit_counts, store.hit_counts())


def test_hits_of_which_no_point_is_kept_count_too():
    store = RunStore(make_job(2))
    live = LivePoints(store.job)
    commit(store, 0, 0, hits=4)
    commit(store, 1, 0, hits=0)
    live.parts.add(store.db.ordered)
    live.gather(store)
    assert (live.seen, live.hits, live.hit_counts[7]) == (0, 4, 4)


def test_a_part_that_cannot_be_read_is_told_of_and_the_others_are_shown():
    store = RunStore(make_job(4))
    live = LivePoints(store.job)
    for scan in range(3):
        commit(store, scan, 5)
    store.storage.remove(["p1.npz"])
    live.parts.add(store.db.ordered)
    live.gather(store)
    assert live.seen == 10
    assert "p1.npz cannot be read" in live.error


# -- the sensor ---------------------------------------------------------------------------


@dataclass(frozen=True)
class Line:
    """A sensor that goes along x, a metre a second."""

    stations: int = 1
    moves: bool = True

    def pose(self, station, time_ns=0.0):
        return Pose((time_ns / 1e9, 0, 1))

    def poses(self, station, times_ns):
        places = np.column_stack([times_ns / 1e9, 0 * times_ns, 1 + 0 * times_ns])
        return places, None


def test_a_sensor_that_moves_is_where_its_scans_begin():
    survey = Survey(Sensor.grid(), steps=2500, trajectory=Line())
    places = sensor_places(survey)
    assert 100 <= len(places) <= 1000
    assert places[0].tolist() == list(survey.pose(0).position)
    assert places[-1].tolist() == list(survey.pose(2499).position)
    assert (np.diff(places[:, 0]) > 0).all()
    still = sensor_places(make_job(4).survey)
    assert still.tolist() == [[0, 0, 1], [0, 0, 5]]


def frame(scan, samples=1):
    ends = np.full((samples, 3), scan, np.float32)
    return Frame(scan, Pose((0, 0, 1)), 10, 5, 1, ends, lambda scan: None)


def test_sample_rays_are_an_even_choice_of_the_frames():
    rays = SampleRays(most=50)
    assert rays.all.shape == (0, 2, 3)
    for scan in range(1000):
        rays.add(frame(scan, samples=2 * (scan % 2)))
    chosen = rays.all[::2, 1, 0]
    assert rays.all[0, 0].tolist() == [0, 0, 1]
    assert 25 <= len(chosen) <= 50
    assert len(set(np.diff(chosen).tolist())) == 1
    assert chosen[-1] > 900
    rays.replace(np.zeros((3, 2, 3), np.float32))
    assert rays.all.shape == (3, 2, 3)


# -- the page -----------------------------------------------------------------------------


def test_what_comes_while_somebody_looks_is_drawn():
    store = RunStore(make_job(200))
    with live_run(store.job, port=0, browser=False) as live, looked_at(live):
        live.follow(store)
        for scan in range(200):
            commit(store, scan, 10)
        wait_for(lambda: live._scene.displayed == 2000 or live._scene.points.seen == 2000)
        live.on_progress(store.progress())
        wait_for(lambda: "2,000 points" in panel(live) and "running" in panel(live))
        assert live._page.scene.get_handle_by_name("/cloud") is not None
        live.finish()
        wait_for(lambda: "done" in panel(live))


def test_the_last_picture_is_whole_though_nobody_looked_and_the_parts_are_gone(tmp_path):
    store = RunStore(make_job(300), tmp_path / "run")
    with live_run(store.job, port=0, browser=False) as live:
        live.follow(store)
        for scan in range(300):
            commit(store, scan, 10)
        assert live._scene.points.seen == 0  # for whom?
        store.db.frames = 300
        live.on_progress(store.progress())
        live.finish()
        points = live._scene.points
        assert (points.seen, points.hits) == (3000, store.db.hits)
        assert points.hit_counts.sum() == pytest.approx(store.db.hits)
        store.remove()
        with looked_at(live):
            wait_for(lambda: "done" in panel(live) and "3,000 points" in panel(live))
            wait_for(lambda: live._scene.displayed == len(points.rows) > 500)
            assert points.error == ""


def test_a_resumed_run_shows_what_the_earlier_one_has_left(tmp_path):
    job = make_job(300)
    first = RunStore(job, tmp_path / "run")
    for scan in range(200):
        commit(first, scan, 10)
    first.db.close()
    store = RunStore(job, tmp_path / "run", resume=True)
    with live_run(job, port=0, browser=False) as live, looked_at(live):
        live.follow(store)
        # Before there is a cluster, what is left of the first is there to see.
        wait_for(lambda: "2,000 points" in panel(live) and "200 / 300" in panel(live))
        assert "starting" in panel(live)
        wait_for(lambda: live._scene.points.seen == 2000)
        wait_for(lambda: live._scene.displayed == len(live._scene.points.rows))


def test_a_run_is_watched_from_its_first_part_to_its_path():
    planning = Planning((25, 25), (-30, -20), [(0, 0)], 2.0, trials=2, iterations=20)
    survey = Survey(poses=[(0, 0, 1), (0, 0, 3)], columns=["intensity", WETNESS])
    job = Job(SCENE, survey, planning, "numpy")
    shown = []
    with (
        local_client(gpu_workers=1, collectors=2, other_workers=1) as client,
        live_run(job, port=0, browser=False) as live,
        looked_at(live),
    ):
        store = RunStore(job)
        live.follow(store)
        run = Run(client, store, live.wants_pause)
        result = run.drive(live.on_frame, live.with_progress(shown.append, run.partitions))
        live.finish()
        points = live._scene.points
        total = f"{len(result.points):,} points"
        wait_for(lambda: "done" in panel(live) and total in panel(live) and "2 / 2" in panel(live))
        wait_for(lambda: live._scene.displayed == len(points.rows))
        for name in ("/sensor", "/rays/earlier", "/path", "/discs/0"):
            wait_for(lambda name=name: live._page.scene.get_handle_by_name(name) is not None)
    assert shown[-1].collected == survey.scan_count
    assert points.error == ""
    assert points.seen == len(result.points) > 300
    assert points.hits == result.hits
    assert points.hit_counts.sum() == pytest.approx(result.hits)
    assert np.array_equal(points.rows["wetness"], points.rows["intensity"])
    assert 0 < points.rows["intensity"].mean() < 1
    assert np.array_equal(live._scene.rays.all, result.sample_rays)
    frames = live._scene.frames
    assert frames.taken + frames.dropped == survey.scan_count


def test_the_command_brings_no_page_before_one_is_wanted():
    """It takes a second, which --help and a run without a page can do without."""
    code = "import sys, lidarpool.cli.commands, lidarpool.live; print(*sys.modules, sep='\\n')"
    loaded = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=LONG_S
    ).stdout.split()
    assert "lidarpool.live" in loaded
    assert {"viser", "matplotlib", "lidarpool.live.run_page"}.isdisjoint(loaded)

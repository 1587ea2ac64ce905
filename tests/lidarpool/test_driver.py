"""The driver's rules of recovery, with workers and stages that are played in this process."""

from __future__ import annotations

import time
from collections import Counter, deque
from dataclasses import replace
from itertools import chain
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lidarpool import LidarpoolError, Scene, Sensor, Survey
from lidarpool.base.storage import Storage
from lidarpool.pipeline import Crew, JobError, RigPlan, driver, policies
from lidarpool.pipeline.batches import PIECES, Place
from lidarpool.pipeline.database import RunDatabase
from lidarpool.pipeline.driver import STALL_S, SurveyDriver
from lidarpool.pipeline.long_stages import StageChanges
from lidarpool.pipeline.messages import (
    ColumnsLost,
    Failed,
    Receipt,
    ScanRange,
    Summaries,
    samples_of_scan,
    summary_type,
)
from lidarpool.pipeline.policies import LATE_S, SPAN, TASK_SECONDS, most_under_way
from lidarpool.pipeline.workers import Outcome
from poolpart import TaskRecord, Whereabouts

SCANS = 60
SURVEY = Survey(Sensor.grid(rays_per_revolution=SCANS, layers=1, step_deg=6), [(0, 0, 1)], SCANS)
PLAN = RigPlan(Scene.seed(), SURVEY, "numpy")
SUMMARY = summary_type(samples_of_scan(SCANS))
GONE = "tcp://gone:1"


class Workers:
    """Workers that cast a batch when they are told to."""

    notes = futures = pending = ()

    def __init__(self):
        self.jobs = {}  # {job: plan}
        self.slots = {"tcp://a:1": 1, "tcp://b:1": 1}
        self.silent = set()
        self.casts = {}  # {key: (spans, worker, outcome)}
        self.tried = Counter()  # {(first, stop): casting tasks}
        self.most = 0  # batches of a task
        self.released = False
        self.wanted = []
        self._joined = 0

    @property
    def slot_count(self):
        return max(1, sum(self.slots.values()))

    @property
    def seen(self):
        free = {a: n for a, n in self.slots.items() if a not in self.silent}
        return Whereabouts(frozenset(self.slots), frozenset(self.silent), free)

    def look(self):
        return self.seen

    def add(self, job, plan):
        self.jobs[job] = plan

    def remove(self, job):
        del self.jobs[job]

    def want(self, slots):
        self.wanted.append(slots)

    def cast(self, job, spans, worker):
        assert worker in self.slots and job in self.jobs
        self.tried.update(spans)
        self.most = max(self.most, len(spans))
        key = f"{job}.{spans[0][0]}.{sum(self.tried.values())}"
        self.casts[key] = (spans, worker, Outcome.PENDING)
        return key

    def outcome(self, job, key, worker):
        return self.casts[key][-1]

    def forget(self, key):
        self.casts.pop(key, None)

    def words_on_memory(self, worker):
        return ""

    def release(self):
        self.released = True

    def end(self, key, outcome=Outcome.DONE):
        self.casts[key] = (*self.casts[key][:-1], outcome)

    @property
    def open(self):
        """Keys of the casting tasks that can still end."""
        alive = [key for key, cast in self.casts.items() if cast[1] in self.slots]
        return [key for key in alive if self.casts[key][-1] is Outcome.PENDING]

    def die(self, worker):
        """Kill a worker; another one joins."""
        del self.slots[worker]
        self._joined += 1
        self.slots[f"tcp://later:{self._joined}"] = 1


class Stages:
    """Long stages that do something when they are told to."""

    run, collector_count, waiting, notes = "0a1b2c3d", 2, False, ()
    closed = False

    def __init__(self, storage, workers):
        self.described = deque()  # what stage 1 has to do
        self.collectors = {"collect-0": "tcp://a:2", "collect-1": "tcp://c:2"}
        self.orders = {name: deque() for name in self.collectors}  # what collectors have to do
        self.unsorted = []
        self.inbox = []
        self.advice = 5  # scans in a batch
        self.seconds = 0.1  # that a batch takes to cast
        self.held = {}  # {name: part that is not in storage}
        self.ended = False
        self.failure = ""
        self.wanted = True  # whether scans are taken
        self.changes = StageChanges(started=["generate", "sort", *self.collectors])
        self._storage, self._workers = storage, workers
        self._following = Counter()  # {job: the scan that the sorter waits for}

    # what the crew asks for

    def open(self):
        pass

    def look(self, progress):
        changes, self.changes = self.changes, StageChanges()
        if "generate" in changes.started:
            self.described.clear()
        if "sort" in changes.started:
            self.unsorted, self._following = [], Counter()
        return changes

    def wait(self, seconds, keys, *, scans):
        self.wanted = scans

    def receive(self):
        messages, self.inbox = self.inbox, []
        return messages

    def send(self, name, messages):
        known = {"generate": self.described, "sort": self.unsorted}
        (known[name] if name in known else self.orders[name]).extend(messages)

    def advise(self, scans):
        pass

    def take_held(self, receipt):
        return self.held.pop(receipt.name, None)

    def close(self):
        self.closed = self.ended = True

    def stop(self, reason):
        self.failure = reason

    def finish(self, others):
        return []

    # what they do

    def generate(self):
        """Describe some scans of the first survey that is left."""
        if self.wanted and self.described:
            one = self.described.popleft()
            stop = min(one.scan_count, one.first + self.advice)
            self.inbox.append(ScanRange(one.first, stop, one.job))
            if stop < one.scan_count:
                self.described.appendleft(replace(one, first=stop))

    def collect(self, order, held_at=""):
        """Write the parts of an order, or hold them; a task that is not there is reported."""
        there = order.worker in self._workers.slots and order.key in self._workers.casts
        return (
            [self._part(order.job, *span, name, held_at) for span, name in order.parts]
            if there
            else [ColumnsLost(order.key, order.job)]
        )

    def _part(self, job, first, stop, name, held_at):
        data = f"scans {first} to {stop}".encode()
        if held_at:
            self.held[name] = data
        else:
            self._storage.write(name, data)
        summaries = np.zeros(stop - first, SUMMARY)
        summaries["hits"] = range(first, stop)
        record = TaskRecord("intersect", "GPU", "a", ("GPU",), 0.0, self.seconds, stop - first)
        return Receipt(
            first, stop, name, 1, len(data), 1, (), summaries.tobytes(), record, held_at, job,
        )  # fmt: skip

    def sort(self):
        """Send on what follows, each part for itself."""
        for one in self.unsorted:
            self._following[one.job] = max(self._following[one.job], one.framed)
        while found := [s for s in self.unsorted if self._following[s.job] in s.scans]:
            self.inbox.append(found[0])
            self._following[found[0].job] = found[0].stop

    def die(self, name):
        """Kill the worker of a stage, which is started again; returns what it had to do."""
        left = list(self.orders.get(name, ()))
        if name in self.orders:
            self.orders[name].clear()
        died = {**self.changes.died, name: GONE}
        self.changes = StageChanges(died, [*self.changes.started, name])
        return left


class Run:
    """A driver with what it talks to."""

    def __init__(self, folder, beside=None, job="0"):
        place = beside.folder / "parts" / job if beside else folder / "parts"
        self.folder, self.storage = folder, Storage.at(place, durable=False)
        self.db = RunDatabase(folder / "run.db", SCANS, durable=False)
        self.workers = beside.workers if beside else Workers()
        self.stages = beside.stages if beside else Stages(self.storage, self.workers)
        self.crew = beside.crew if beside else Crew(self.workers, self.stages)
        self.frames = []
        self.committed = []
        self.driver = self.drive(job)
        self.all = [*beside.all, self] if beside else [self]
        if not beside:
            self.crew.open()

    def drive(self, job="0"):
        seat = self.crew.seat(job, PLAN, f"{job}/" if job != "0" else "")
        return SurveyDriver(
            seat, SURVEY, self.db, self.storage, None,
            self.frames.append, self.committed.extend, SCANS,
        )  # fmt: skip

    def step(self):
        self.crew.look(self.driver.progress)
        for run in self.all:
            run.driver.step()
        self.crew.wait(0.0)

    def until(self, condition, *, idle=""):
        """Let everybody work, but for those who are idle, until something is so."""
        for _ in range(1000):
            self.step()
            if condition():
                return
            self.stages.generate()
            for key in self.workers.open if idle != "cast" else ():
                self.workers.end(key)
            for orders in self.stages.orders.values() if idle != "collect" else ():
                while orders:
                    self.stages.inbox += self.stages.collect(orders.popleft())
            if idle != "sort":
                self.stages.sort()
        raise AssertionError("it does not come to that")

    def end(self):
        """Let everybody work to the end, and check that each scan has come once, in order."""
        self.until(lambda: self.driver.finished)
        self.crew.leave(self.driver.seat)
        self.crew.close()
        assert self.crew.ended
        self.crew.finish()
        assert [frame.scan for frame in self.frames] == list(range(SCANS))
        assert [frame.hits for frame in self.frames] == list(range(SCANS))
        spans = sorted((part.first, part.stop) for part in self.committed)
        assert [scan for span in spans for scan in range(*span)] == list(range(SCANS))
        for part in self.committed:
            assert self.storage.read(part.name) == f"scans {part.first} to {part.stop}".encode()
        assert not self.driver.batches and not self.workers.casts and self.workers.released
        assert not self.workers.jobs and not self.crew.seats

    def at(self, place):
        return self.driver.batches.at(place)


@pytest.fixture
def run(tmp_path):
    run = Run(tmp_path)
    yield run
    run.db.close()


@pytest.fixture
def clock(monkeypatch):
    """A clock for the driver that only goes when it is told to."""
    clock = SimpleNamespace(now=time.monotonic())
    monkeypatch.setattr(driver, "time", SimpleNamespace(monotonic=lambda: clock.now))
    return clock


def test_undisturbed_each_batch_is_cast_once(run):
    run.end()
    assert set(run.workers.tried.values()) == {1} and run.driver.offered_again == 0
    assert run.driver.cast == run.driver.generated == SCANS
    assert run.driver.book.stages["intersect"].items == SCANS


def test_slots_are_wanted_as_long_as_there_is_work(run):
    run.stages.seconds = 100.0
    run.end()
    wanted = run.workers.wanted
    assert wanted[0] == SCANS and wanted[-1] == 0
    assert wanted == sorted(wanted, reverse=True)


def test_what_an_earlier_run_has_committed_is_not_cast_again(run):
    run.until(lambda: len(run.committed) >= 4)
    done = [(part.first, part.stop) for part in run.committed]
    framed = len(run.frames)
    run.crew.leave(run.driver.seat)
    run.workers.tried.clear()
    run.stages.__init__(run.storage, run.workers)
    run.crew = Crew(run.workers, run.stages)
    run.crew.open()
    run.driver = run.drive()
    run.end()
    assert framed > 0 and run.workers.tried.keys().isdisjoint(done)


def test_the_batches_of_a_worker_that_dies_are_offered_to_others(run):
    run.until(lambda: len(run.at(Place.CASTING)) == 4, idle="cast")
    lost = [batch for batch in run.at(Place.CASTING) if batch.worker == "tcp://a:1"]
    assert len(lost) == 2
    run.workers.die("tcp://a:1")
    run.step()
    assert not {batch.worker for batch in lost} & {"tcp://a:1"}
    run.end()
    assert [n for n in run.workers.tried.values() if n > 1] == [2, 2]


def test_a_batch_whose_worker_has_no_scene_is_offered_again(run):
    run.until(lambda: run.at(Place.CASTING), idle="cast")
    batch = run.at(Place.CASTING)[0]
    run.workers.end(batch.key, Outcome.NO_RIG)
    run.end()
    assert run.workers.tried[batch.first, batch.stop] == 2
    assert not batch.deaths


def test_the_batches_of_a_collector_that_dies_are_collected_by_another_without_a_cast(run):
    run.until(lambda: run.stages.orders["collect-0"], idle="collect")
    lost = {order.key for order in run.stages.die("collect-0")}
    run.step()
    assert lost and lost <= {order.key for orders in run.stages.orders.values() for order in orders}
    run.end()
    assert set(run.workers.tried.values()) == {1}


def test_a_late_batch_is_offered_again_and_whatever_arrives_second_does_no_harm(run, clock):
    run.until(lambda: run.committed)
    run.until(lambda: any(run.stages.orders.values()), idle="collect")
    order = next(order for orders in run.stages.orders.values() for order in orders)
    ((span, name),) = order.parts
    first = run.stages.collect(order)  # ready, and stopped before it is sent
    for orders in run.stages.orders.values():
        orders.clear()
    clock.now += LATE_S + 1
    run.step()
    run.until(lambda: span[0] in run.db.parts)
    assert run.workers.tried[span] == 2
    before = len(run.committed)
    written = run.storage.read(name)
    run.storage.write(name, written)  # as its collector does when it wakes up
    run.stages.inbox += [*first, *first, ColumnsLost(order.key, order.job)]
    run.step()
    assert len(run.committed) == before and run.db.part_of(span[0]).name == name
    run.end()
    assert len(run.storage.sizes()) == len(run.committed)


@pytest.mark.parametrize("how", ["held", "columns"])
def test_what_is_lost_on_its_way_is_cast_again(run, how):
    run.until(lambda: any(run.stages.orders.values()), idle="collect")
    order = next(orders for orders in run.stages.orders.values() if orders).popleft()
    ((span, _),) = order.parts
    answers = run.stages.collect(order, held_at=GONE)
    run.stages.held.clear()  # the worker has died
    run.stages.inbox += answers if how == "held" else [ColumnsLost(order.key, order.job)]
    run.step()
    assert span[0] not in run.db.parts
    run.end()
    assert run.workers.tried[span] == 2


def test_parts_of_a_worker_that_does_not_see_the_storage_are_written_by_the_driver(run):
    run.until(lambda: any(run.stages.orders.values()), idle="collect")
    order = next(orders for orders in run.stages.orders.values() if orders).popleft()
    run.stages.inbox += run.stages.collect(order, held_at="tcp://far:1")
    run.step()
    assert order.parts[0][1] in run.storage.sizes() and not run.stages.held
    run.end()
    (note,) = run.driver.notes
    assert note.startswith(f"tcp://far:1 of partition LIDAR cannot see {run.storage.url}")


def test_a_sorter_that_dies_gets_again_what_was_not_handed_out(run):
    run.until(lambda: len(run.frames) >= 10)
    run.until(lambda: run.db.scans_done >= len(run.frames) + 20, idle="sort")
    run.stages.die("sort")
    run.step()
    handed_out = len(run.frames)
    assert min(s.first for s in run.stages.unsorted) == handed_out
    assert max(s.stop for s in run.stages.unsorted) >= handed_out + 20
    one = bytes(SUMMARY.itemsize)
    run.stages.inbox += [Summaries(at, at + 1, one, 0, SCANS, "0") for at in (0, handed_out + 1)]
    run.step()
    assert len(run.frames) == handed_out, "only the next frame is handed out"
    run.end()


def test_a_sorter_that_says_nothing_gets_all_again(run, clock):
    run.until(lambda: len(run.committed) > 6, idle="sort")
    run.stages.unsorted.clear()
    clock.now += STALL_S + 1
    run.step()
    assert [s.first for s in run.stages.unsorted] == [p.first for p in run.db.ordered]
    run.end()


def test_a_generator_that_is_started_again_repeats_nothing(run):
    run.until(lambda: run.driver.generated > 20)
    run.stages.inbox.append(ScanRange(10, 22, "0"))
    run.stages.die("generate")
    run.end()
    assert set(run.workers.tried.values()) == {1}


def test_small_batches_are_cast_and_collected_several_at_a_time(run):
    run.stages.advice, run.stages.seconds = 1, TASK_SECONDS / 3.5
    run.until(lambda: run.committed)
    run.until(lambda: len(run.at(Place.WAITING)) >= 10, idle="cast")
    run.end()
    assert run.workers.most == 3 and len(run.committed) == SCANS
    assert set(run.workers.tried.values()) == {1}


@pytest.mark.parametrize("stage", ["intersect", "collect"])
def test_a_scan_that_kills_its_workers_is_found_among_small_batches(run, stage):
    run.stages.advice, run.stages.seconds = 1, 0.001
    run.until(lambda: len(run.committed) > 5)
    with pytest.raises(LidarpoolError, match=rf"^scan 40 kills the worker that runs stage {stage}"):
        run.until(striking(run, stage, 40))
    assert run.db.missing(0, SCANS)[0] == (40, 41)


def striking(run, stage, poison, deaths=None, job=""):
    """Let a scan kill whoever has it, of a job if one is given."""

    def has(spans):
        return any(first <= poison < stop for first, stop in spans)

    def strike():
        killed = 0
        for key in run.workers.open if stage == "intersect" else ():
            spans, worker, _ = run.workers.casts[key]
            if has(spans) and worker in run.workers.slots and key.startswith(job):
                run.workers.die(worker)
                killed += 1
        for name, orders in run.stages.orders.items() if stage == "collect" else ():
            mine = [order for order in orders if order.job.startswith(job)]
            if any(has([span for span, _ in order.parts]) for order in mine):
                run.stages.die(name)
                killed += 1
        if deaths is not None:
            deaths.append(killed)
        return False

    return strike


@pytest.mark.parametrize("stage", ["intersect", "collect"])
def test_a_scan_that_kills_its_workers_is_isolated_and_named(run, stage):
    poison, deaths = 23, []
    run.stages.advice = 20

    message = rf"^scan {poison} kills the worker that runs stage {stage}: 3 workers died, one after"
    with pytest.raises(LidarpoolError, match=message):
        run.until(striking(run, stage, poison, deaths))
    # Twice with the whole batch, once alone, once with its piece, and three times by itself.
    pieces = 20 // -(-20 // PIECES)
    assert pieces == 10 and sum(deaths) == 2 + 1 + 1 + 3
    assert run.db.missing(0, SCANS) == [(poison, poison + 1)]
    assert [frame.scan for frame in run.frames] == list(range(poison))


def test_a_suspect_that_is_innocent_is_not_divided(run):
    run.until(lambda: run.at(Place.CASTING), idle="cast")
    batch = run.at(Place.CASTING)[0]
    for _ in range(2):
        run.workers.die(batch.worker)
        run.until(lambda: batch.place is Place.CASTING, idle="cast")
    alone = [b for b in run.at(Place.CASTING) if b.worker == batch.worker]
    assert batch.deaths["intersect"] == 2 and alone == [batch]
    run.end()
    assert (batch.first, batch.stop) in {(part.first, part.stop) for part in run.committed}


def test_batches_under_way_are_bounded_whoever_is_slow(run):
    most = most_under_way(2, 2)
    run.stages.advice = 1
    for _ in range(5 * most):
        run.step()
        run.stages.generate()
    assert len(run.driver.batches) == most and not run.stages.wanted
    oldest = min(run.driver.batches, key=lambda batch: batch.first)
    for _ in range(5 * SPAN * most):  # all the others go on
        run.step()
        run.stages.generate()
        for key in run.workers.open:
            if key != oldest.key:
                run.workers.end(key)
        for order in chain.from_iterable(run.stages.orders.values()):
            run.stages.inbox += run.stages.collect(order)
        for orders in run.stages.orders.values():
            orders.clear()
    assert run.driver.batches.span <= max(SPAN * most, SCANS) and run.frames == []


def test_a_run_that_is_stopped_leaves_nothing(run):
    run.until(lambda: run.at(Place.CASTING) and run.committed)
    run.crew.stop("enough")
    assert run.stages.failure == "enough" and not run.workers.casts
    run.crew.finish()
    assert run.workers.released


@settings(max_examples=100, deadline=None)
@given(chance=st.randoms(use_true_random=False))
def test_whatever_dies_each_scan_arrives_once_in_order(tmp_path_factory, chance):
    run = Run(tmp_path_factory.mktemp("run"))
    run.stages.advice = chance.choice((1, 4, 7))
    run.stages.seconds = chance.choice((0.1, 0.01))
    late = []  # what collectors have to say that were only stopped

    def collect():
        orders = chance.choice(list(run.stages.orders.values()))
        if orders:
            answers = run.stages.collect(orders.popleft())
            where = chance.choice((run.stages.inbox, run.stages.inbox, late))
            where.extend(answers * chance.choice((1, 1, 2)))

    def cast():
        if run.workers.open:
            outcomes = (Outcome.DONE, Outcome.DONE, Outcome.DONE, Outcome.NO_RIG, Outcome.KILLED)
            run.workers.end(chance.choice(run.workers.open), chance.choice(outcomes))

    def lose_stage():
        name = chance.choice(["generate", "sort", *run.stages.orders])
        late.extend(chain.from_iterable(map(run.stages.collect, run.stages.die(name))))

    def lose_worker():
        run.workers.die(chance.choice(list(run.workers.slots)))

    def wake():
        run.stages.inbox += late
        late.clear()

    work = [run.stages.generate, collect, cast, run.stages.sort]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(policies, "KILLS_MOST", 10**6)  # here nobody is to blame
        for _ in range(100):
            chance.choice([*work, *work, *work, lose_stage, lose_worker, wake])()
            if chance.random() < 0.7:
                run.step()
        run.stages.die("collect-0")  # what it had taken is not answered
        run.stages.die("collect-1")
        run.step()
        wake()
        run.end()
    run.db.close()


# -- several surveys on one crew -------------------------------------------------------------------


@pytest.fixture
def two(run, tmp_path):
    """Return two surveys on one crew."""
    (tmp_path / "other").mkdir()
    other = Run(tmp_path / "other", beside=run, job="other")
    run.all = other.all
    yield run, other
    other.db.close()


def test_two_surveys_share_workers_stages_and_storage(two):
    for run in two:
        run.until(lambda run=run: run.driver.finished)
    for run in two:
        assert [frame.scan for frame in run.frames] == list(range(SCANS))
        assert {part.name for part in run.committed} == run.storage.sizes().keys()
        assert run.driver.offered_again == 0 and run.driver.generated == SCANS


def test_a_survey_takes_no_more_than_it_has_room_for_while_another_wants_scans(two):
    run, other = two
    run.stages.advice = 1
    most = most_under_way(2, 2)
    for _ in range(5 * most):
        run.step()
        run.stages.generate()
    assert len(run.driver.batches) == most and not run.stages.wanted
    assert other.driver.seat.wants_scans and other.driver.generated == 0
    other.until(lambda: other.driver.finished and run.driver.finished)


@pytest.mark.parametrize("how", ["failed", "intersect", "collect"])
def test_a_survey_that_fails_leaves_and_the_other_goes_on(two, how):
    bad, good = two
    bad.stages.advice = 1
    if how != "failed":
        strike = striking(bad, how, 23, job="0")
        with pytest.raises(JobError, match=r"^scan 23 kills"):
            bad.until(strike)
    else:
        bad.until(lambda: bad.at(Place.CASTING) and bad.committed)
        bad.stages.inbox.append(Failed("stage generate failed: scan 59: out of order", "0"))
        with pytest.raises(JobError, match=r"^stage generate failed: scan 59"):
            bad.step()
    bad.crew.leave(bad.driver.seat)
    assert list(bad.workers.jobs) == ["other"]
    good.all.remove(bad)
    good.end()  # nothing is left of the first either


def test_of_a_survey_that_has_left_messages_are_dropped_and_its_scans_pass(two):
    bad, good = two
    bad.until(lambda: any(bad.stages.orders.values()), idle="collect")
    late = [bad.stages.collect(o) for orders in bad.stages.orders.values() for o in orders]
    bad.crew.leave(bad.driver.seat)
    good.all.remove(bad)
    good.stages.inbox += chain.from_iterable(late)
    committed = len(bad.committed)
    good.end()
    assert len(bad.committed) == committed and not bad.driver.seat.inbox


def test_a_generator_that_is_started_again_is_told_of_all_surveys(two):
    run, other = two
    run.until(lambda: run.driver.generated > 20)
    run.stages.die("generate")
    run.step()
    assert [(d.job, d.first) for d in run.stages.described] == [
        ("0", run.driver.generated), ("other", 0),
    ]  # fmt: skip
    run.until(lambda: run.driver.finished and other.driver.finished)
    assert set(run.workers.tried.values()) == {2}  # scans of each survey


def test_a_sorter_that_dies_is_told_of_all_surveys_again(two):
    run, other = two
    run.until(lambda: other.db.scans_done > 20, idle="sort")
    run.stages.die("sort")
    run.step()
    assert {s.job for s in run.stages.unsorted} == {"0", "other"}
    run.until(lambda: run.driver.finished and other.driver.finished)
    assert len(run.frames) == len(other.frames) == SCANS


def test_a_suspect_of_one_survey_is_alone_on_its_worker(two):
    run, other = two
    run.stages.advice = 20
    run.until(lambda: other.at(Place.CASTING), idle="cast")
    suspect = run.at(Place.CASTING)[0]
    for _ in range(2):
        run.workers.die(suspect.worker)
        run.until(lambda: suspect.place is Place.CASTING)
    assert suspect.deaths["intersect"] == 2
    there = [b for one in two for b in one.at(Place.CASTING) if b.worker == suspect.worker]
    assert there == [suspect]
    run.until(lambda: run.driver.finished and other.driver.finished)


@pytest.mark.parametrize("advice", [1, 7, SCANS])
def test_a_scene_that_kills_whoever_casts_it_is_told_after_a_few_deaths(run, advice):
    run.stages.advice, deaths = advice, []

    def strike():
        for worker in {run.workers.casts[key][1] for key in run.workers.open}:
            run.workers.die(worker)
            deaths.append(worker)

    with pytest.raises(JobError, match=r"^GPU workers die whatever they cast first: 3 died, one a"):
        run.until(strike)
    assert len(deaths) <= 10

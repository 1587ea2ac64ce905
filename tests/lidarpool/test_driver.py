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

from lidarpool.run.pipeline import batches as job_state
from lidarpool.run.pipeline import dispatch, pipeline_job, policies
from lidarpool.run.pipeline import pipeline as driver
from lidarpool.run.pipeline.batches import BatchState, Outcome
from lidarpool.run.pipeline.committed_results import CommittedResults
from lidarpool.run.pipeline.dispatch import PIECES
from lidarpool.run.pipeline.failures import JobError
from lidarpool.run.pipeline.pipeline import ANNOUNCED, STALL_S, Pipeline
from lidarpool.run.pipeline.policies import LATE_S, MAX_SPAN, TASK_SECONDS, max_weight_in_flight
from lidarpool.run.pipeline.stage_messages import (
    ColumnsLost,
    Failed,
    Receipt,
    ScanRange,
    Summaries,
    samples_of_scan,
    summary_type,
)
from lidarpool.run.pipeline.task_records import TaskRecord
from lidarpool.run.store.database import RunDatabase
from lidarsim import Scene, Sensor, Survey
from lidarsim.io.storage import Storage
from poolpart.task_locations import PartitionSnapshot

SCANS = 60
SURVEY = Survey(Sensor.grid(rays_per_revolution=SCANS, layers=1, step_deg=6), [(0, 0, 1)], SCANS)
TINY = Survey(Sensor.grid(rays_per_revolution=5, layers=1, step_deg=72), [(0, 0, 1)], 5)
SCENE = Scene.seed()
GONE = "tcp://gone:1"


class Workers:
    """Workers that cast a batch when they are told to."""

    notes = futures = pending = ()

    def __init__(self):
        self.jobs = {}  # {job: plan}
        self.slots = {"tcp://a:1": 1, "tcp://b:1": 1}
        self.silent = set()
        self.casts = {}  # {key: (batches, worker, outcome)}
        self.tried = Counter()  # {(job, first, stop): casting tasks}
        self.most = 0  # batches of a task
        self.tasks = 0  # so far
        self.released = False
        self.wanted = []
        self._joined = 0

    @property
    def slot_count(self):
        return max(1, sum(self.slots.values()))

    @property
    def seen(self):
        free = {a: n for a, n in self.slots.items() if a not in self.silent}
        return PartitionSnapshot(frozenset(self.slots), frozenset(self.silent), free)

    def refresh(self):
        return self.seen

    def register_job(self, job, scene, survey):
        self.jobs[job] = scene
        return b"", str(id(scene))

    def remove(self, job):
        del self.jobs[job]

    def request_slots(self, slots):
        self.wanted.append(slots)

    def submit(self, batches, worker):
        assert worker in self.slots
        assert len({id(self.jobs[job]) for job, _ in batches}) == 1
        self.tried.update((job, *span) for job, span in batches)
        self.most = max(self.most, len(batches))
        self.tasks += 1
        self.casts[f"cast-{self.tasks}"] = (batches, worker, Outcome.PENDING)
        return f"cast-{self.tasks}"

    def outcome(self, key, worker):
        batches, _, outcome = self.casts[key]
        if isinstance(outcome, JobError) and len({job for job, _ in batches}) > 1:
            return Outcome.SEPARATE_JOBS
        if isinstance(outcome, JobError):
            raise outcome
        return outcome

    def release_task(self, key):
        self.casts.pop(key, None)

    def memory_clause(self, worker):
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

    run = "0a1b2c3d"
    collector_count = 2
    waiting = False
    notes = ()
    is_closing = False

    def __init__(self, storage, workers):
        self.described = deque()  # what stage 1 has to do
        self.collectors = {"collect-0": "tcp://a:2", "collect-1": "tcp://c:2"}
        self.orders = {name: deque() for name in self.collectors}  # what collectors have to do
        self.unsorted = []
        self.inbox = []  # messages for the driver
        self.ranges = []  # of stage 1, which the driver takes when it has room
        self.advice = 5  # scans in a batch
        self.seconds = 0.1  # that a batch takes to cast
        self.held = {}  # {name: part that is not in storage}
        self.has_ended = False
        self.failure = ""
        self.wanted = True  # whether scans are taken
        self.changes = ({}, ["generate", "sort", *self.collectors])
        self._storage = storage
        self._workers = workers
        self._following = Counter()  # {job: the scan that the sorter waits for}

    # what the driver asks for

    def open(self):
        self._storage.prepare()

    def refresh(self, progress):
        changes = self.changes
        self.changes = ({}, [])
        if "generate" in changes[1]:
            self.described.clear()
        if "sort" in changes[1]:
            self.unsorted = []
            self._following = Counter()
        return changes

    def wait(self, seconds, keys, *, scans, linger_s=0.0):
        self.wanted = scans
        self.linger_s = linger_s
        messages = [*self.inbox, *(self.ranges if scans else ())]
        self.inbox = []
        self.ranges = [] if scans else self.ranges
        return messages

    def send(self, name, messages):
        known = {"generate": self.described, "sort": self.unsorted}
        (known[name] if name in known else self.orders[name]).extend(messages)

    def set_message_scans(self, scans):
        pass

    def store_held(self, receipt):
        data = self.held.pop(receipt.name, None)
        if data is not None:
            self._storage.write(receipt.name, data)
        return data is not None

    def close(self):
        self.is_closing = self.has_ended = True

    def stop(self, reason):
        self.failure = reason

    def finish(self, others):
        return []

    # what they do

    def generate(self):
        """Describe some scans of the first survey that is left."""
        if self.described and len(self.ranges) < 20:
            one = self.described.popleft()
            stop = min(one.stop, one.first + self.advice)
            self.ranges.append(ScanRange(one.job, one.first, stop))
            if stop < one.stop:
                self.described.appendleft(replace(one, first=stop))

    def collect(self, order, held_at=""):
        """Write the parts of an order, or hold them; a task that is not there is reported."""
        there = order.worker in self._workers.slots and order.key in self._workers.casts
        return (
            [self._part(job, *span, name, held_at) for job, span, name in order.parts]
            if there
            else [ColumnsLost(order.key)]
        )

    def _part(self, job, first, stop, name, held_at):
        data = f"job {job}, scans {first} to {stop}".encode()
        if held_at:
            self.held[name] = data
        else:
            self._storage.write(name, data)
        summaries = np.zeros(stop - first, SUMMARY)
        summaries["hits"] = range(first, stop)
        record = TaskRecord("intersect", "GPU", "a", ("GPU",), 0.0, self.seconds, stop - first)
        return Receipt(
            job, first, stop, name, 1, len(data), 1, (), summaries.tobytes(), record, held_at
        )

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
        died, started = self.changes
        self.changes = {**died, name: GONE}, [*started, name]
        return left


SUMMARY = summary_type(samples_of_scan(SCANS))


class Run:
    """A driver with what it talks to."""

    def __init__(self, folder):
        self.storage = Storage.at(folder / "parts", durable=False)
        self.db = RunDatabase(folder / "run.db", durable=False)
        self.frames = {}  # {job: scan and hits of each of its frames}
        self.committed = {}  # {job: its parts}
        self.begun = {}  # {number: job}
        self.ended = {}  # {job: why it has failed, None if it has not}
        self.restart()

    def restart(self):
        """Begin with new workers and stages."""
        self.workers = Workers()
        self.stages = Stages(self.storage, self.workers)
        self.driver = Pipeline(self.workers, self.stages, self.db, self.db.meta["mark"])
        self.driver.open()

    def begin(self, number=0, survey=SURVEY, scene=SCENE, *, frames=True, fit=SCANS):
        self.committed.setdefault(number, [])
        self.frames.setdefault(number, [])
        committed = CommittedResults(number, range(survey.scan_count), has_frames=frames)
        self.db.read(committed)
        self.begun[number] = self.driver.add_job(committed, scene, survey, scans_per_task=fit)
        return self.begun[number]

    def step(self):
        self.driver.wait()
        news = self.driver.step()
        for part in news.parts:
            self.committed[part.job].append(part)
        for job, summaries in news.frames:
            hits = np.frombuffer(summaries.data, SUMMARY)["hits"].tolist()
            for scan, count in zip(summaries.scans, hits, strict=True):
                if scan >= job.committed.frames:
                    self.frames[job.number].append((scan, count))
                    job.committed.advance_frames(scan + 1)
        self.ended |= {job.number: error for job, error in news.ended}

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

    def fails(self, number=0):
        """Let everybody work until a job fails; returns why."""
        self.until(lambda: number in self.ended)
        return str(self.ended[number])

    def end(self):
        """Let everybody work to the end, and check that each scan has come once, in order."""
        self.until(lambda: not self.driver.jobs)
        self.driver.close()
        assert self.stages.has_ended
        self.driver.finish()
        done = [number for number, error in self.ended.items() if error is None]
        for number in done:
            job = self.begun[number]
            scans = list(job.scans)
            if job.committed.has_frames:
                assert self.frames[number] == [(scan, scan) for scan in scans]
            spans = sorted((part.first, part.stop) for part in self.committed[number])
            assert [scan for span in spans for scan in range(*span)] == scans
            for part in self.committed[number]:
                data = self.storage.read(part.name).decode()
                assert data == f"job {number}, scans {part.first} to {part.stop}"
        assert (
            not self.driver.dispatcher.batches and not self.workers.casts and self.workers.released
        )
        # Announced jobs show nowhere else: one left behind takes the room of a later one.
        assert not self.workers.jobs and not self.driver._announced

    def at(self, place, number=None):
        there = self.driver.dispatcher.in_states(place)
        return there if number is None else [b for b in there if b.job.number == number]


@pytest.fixture
def empty(tmp_path):
    """A driver without jobs."""
    run = Run(tmp_path)
    yield run
    run.db.close()


@pytest.fixture
def run(empty):
    """A driver with one job."""
    empty.job = empty.begin()
    return empty


@pytest.fixture
def clock(monkeypatch):
    """A clock for the driver that only goes when it is told to."""
    clock = SimpleNamespace(now=time.monotonic())
    for module in (driver, dispatch, job_state, pipeline_job):
        monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=lambda: clock.now))
    return clock


def test_the_driver_waits_for_more_news_only_while_much_is_under_way(empty):
    for number in range(10):
        empty.begin(number, TINY)
    empty.driver.wait()
    alone = empty.stages.linger_s
    dispatcher = empty.driver.dispatcher
    empty.until(lambda: 2 * len(dispatcher.batches) > dispatcher.max_weight, idle="cast")
    empty.driver.wait()
    assert alone == driver.LINGER_S < empty.stages.linger_s <= 10 * driver.LINGER_S
    empty.end()


def test_undisturbed_each_batch_is_cast_once(run):
    run.end()
    assert set(run.workers.tried.values()) == {1}
    assert run.job.cast == run.job.generated == SCANS
    assert run.driver.book.stages["intersect"].items == SCANS
    assert run.job.seconds == pytest.approx(0.1 * len(run.committed[0]))
    assert (run.driver.dispatcher.replayed, run.driver.dispatcher.lost_workers) == (0, set())


def test_what_an_earlier_run_has_committed_is_not_cast_again(run):
    run.until(lambda: len(run.committed[0]) >= 4)
    done = [(0, part.first, part.stop) for part in run.committed[0]]
    framed = len(run.frames[0])
    run.db.save_frames([run.job.committed])
    run.db.close()
    run.db = RunDatabase(run.db.path, durable=False)
    run.restart()
    run.begin()
    run.end()
    assert framed > 0 and run.workers.tried.keys().isdisjoint(done)


def test_the_batches_of_a_worker_that_dies_are_offered_to_others(run):
    run.until(lambda: len(run.at(BatchState.CASTING)) == 4, idle="cast")
    lost = [batch for batch in run.at(BatchState.CASTING) if batch.worker == "tcp://a:1"]
    assert len(lost) == 2
    run.workers.die("tcp://a:1")
    run.step()
    assert not {batch.worker for batch in lost} & {"tcp://a:1"}
    run.end()
    assert [n for n in run.workers.tried.values() if n > 1] == [2, 2]
    assert (run.driver.dispatcher.replayed, run.driver.dispatcher.lost_workers) == (
        2,
        {"tcp://a:1"},
    )


def test_the_batches_of_a_collector_that_dies_are_collected_by_another_without_a_cast(run):
    run.until(lambda: run.stages.orders["collect-0"], idle="collect")
    lost = {order.key for order in run.stages.die("collect-0")}
    run.step()
    assert lost and lost <= {order.key for orders in run.stages.orders.values() for order in orders}
    run.end()
    assert set(run.workers.tried.values()) == {1}
    assert run.driver.dispatcher.replayed >= len(lost)
    assert len(run.driver.dispatcher.lost_workers) == 1


def test_a_late_batch_is_offered_again_and_whatever_arrives_second_does_no_harm(run, clock):
    run.until(lambda: run.committed[0])
    run.until(lambda: any(run.stages.orders.values()), idle="collect")
    order = next(order for orders in run.stages.orders.values() for order in orders)
    ((_, span, name),) = order.parts
    first = run.stages.collect(order)  # ready, and stopped before it is sent
    for orders in run.stages.orders.values():
        orders.clear()
    clock.now += LATE_S + 1
    run.step()
    run.until(lambda: not run.job.committed.parts.missing(*span))
    assert run.workers.tried[0, *span] == 2
    before = len(run.committed[0])
    written = run.storage.read(name)
    run.storage.write(name, written)  # as its collector does when it wakes up
    run.stages.inbox += [*first, *first, ColumnsLost(order.key)]
    run.step()
    assert len(run.committed[0]) == before and run.job.committed.parts.part_of(span[0]).name == name
    run.end()
    assert len(run.storage.sizes()) == len(run.committed[0])


@pytest.mark.parametrize("how", ["held", "columns"])
def test_what_is_lost_on_its_way_is_cast_again(run, how):
    run.until(lambda: any(run.stages.orders.values()), idle="collect")
    order = next(orders for orders in run.stages.orders.values() if orders).popleft()
    ((_, span, _),) = order.parts
    answers = run.stages.collect(order, held_at=GONE)
    run.stages.held.clear()  # the worker has died
    run.stages.inbox += answers if how == "held" else [ColumnsLost(order.key)]
    run.step()
    assert run.job.committed.parts.missing(*span) == [span]
    run.end()
    assert run.workers.tried[0, *span] == 2


def test_parts_of_a_worker_that_does_not_see_the_storage_are_written_by_the_driver(run):
    run.until(lambda: any(run.stages.orders.values()), idle="collect")
    order = next(orders for orders in run.stages.orders.values() if orders).popleft()
    run.stages.inbox += run.stages.collect(order, held_at="tcp://far:1")
    run.step()
    assert order.parts[0][2] in run.storage.sizes() and not run.stages.held
    run.end()


def test_a_sorter_that_dies_gets_again_what_was_not_handed_out(run):
    frames = run.frames[0]
    run.until(lambda: len(frames) >= 10)
    run.until(lambda: run.job.committed.parts.scans_done >= len(frames) + 20, idle="sort")
    run.stages.die("sort")
    run.step()
    handed_out = len(frames)
    assert min(s.first for s in run.stages.unsorted) == handed_out
    assert max(s.stop for s in run.stages.unsorted) >= handed_out + 20
    one = bytes(SUMMARY.itemsize)
    run.stages.inbox += [Summaries(0, at, at + 1, one, 0, SCANS) for at in (0, handed_out + 1)]
    run.step()
    assert len(frames) == handed_out, "only the next frame is handed out"
    run.end()


def test_a_sorter_that_says_nothing_gets_all_again(run, clock):
    run.until(lambda: len(run.committed[0]) > 6, idle="sort")
    run.stages.unsorted.clear()
    clock.now += STALL_S + 1
    run.step()
    assert [s.first for s in run.stages.unsorted] == [
        p.first for p in run.job.committed.parts.ordered
    ]
    run.end()


def test_small_batches_are_cast_and_collected_several_at_a_time(run):
    run.stages.advice = 1
    run.stages.seconds = TASK_SECONDS / 3.5
    run.until(lambda: run.committed[0])
    run.until(lambda: len(run.at(BatchState.WAITING)) >= 10, idle="cast")
    run.end()
    assert run.workers.most == 3 and len(run.committed[0]) == SCANS
    assert set(run.workers.tried.values()) == {1}


def striking(run, stage, poison, deaths=None, job=0):
    """Let a scan kill whoever has it; true once its job has failed."""

    def has(batches):
        return any(number == job and span[0] <= poison < span[1] for number, span in batches)

    def strike():
        killed = 0
        for key in run.workers.open if stage == "intersect" else ():
            batches, worker, _ = run.workers.casts[key]
            if has(batches) and worker in run.workers.slots:
                run.workers.die(worker)
                killed += 1
        for name, orders in run.stages.orders.items() if stage == "collect" else ():
            if any(has([part[:2] for part in order.parts]) for order in orders):
                run.stages.die(name)
                killed += 1
        if deaths is not None:
            deaths.append(killed)
        return job in run.ended

    return strike


@pytest.mark.parametrize("stage", ["intersect", "collect"])
def test_a_scan_that_kills_its_workers_is_isolated_and_named(run, stage):
    poison = 23
    deaths = []
    run.stages.advice = 20
    run.until(striking(run, stage, poison, deaths))
    message = f"3 workers in a row died in stage {stage} while they processed only scan {poison}"
    assert run.fails().startswith(message)
    # Twice with the whole batch, once alone, once with its piece, and three times by itself.
    pieces = 20 // -(-20 // PIECES)
    assert pieces == 10 and sum(deaths) == 2 + 1 + 1 + 3
    assert run.job.committed.parts.missing(0, SCANS) == [(poison, poison + 1)]
    assert run.frames[0] == [(scan, scan) for scan in range(poison)]
    run.end()  # nothing is left of it


def test_a_suspect_that_is_innocent_is_not_divided(run):
    run.until(lambda: run.at(BatchState.CASTING), idle="cast")
    batch = run.at(BatchState.CASTING)[0]
    for _ in range(2):
        run.workers.die(batch.worker)
        run.until(lambda: batch.state is BatchState.CASTING, idle="cast")
    alone = [b for b in run.at(BatchState.CASTING) if b.worker == batch.worker]
    assert batch.deaths["intersect"] == 2 and alone == [batch]
    run.end()
    assert (batch.first, batch.stop) in {(part.first, part.stop) for part in run.committed[0]}


def test_batches_under_way_are_bounded_whoever_is_slow(run):
    most = max_weight_in_flight(2, 2)
    run.stages.advice = 1
    for _ in range(5 * most):
        run.step()
        run.stages.generate()
    assert len(run.driver.dispatcher.batches) == most and not run.stages.wanted
    oldest = min(run.driver.dispatcher.batches.values(), key=lambda batch: batch.first)
    for _ in range(5 * MAX_SPAN * most):  # all the others go on
        run.step()
        run.stages.generate()
        for key in run.workers.open:
            if key != oldest.key:
                run.workers.end(key)
        for order in chain.from_iterable(run.stages.orders.values()):
            run.stages.inbox += run.stages.collect(order)
        for orders in run.stages.orders.values():
            orders.clear()
    assert run.job.generated - oldest.first <= max(MAX_SPAN * most, SCANS) and run.frames[0] == []


def test_a_run_that_is_stopped_leaves_nothing(run):
    run.until(lambda: run.at(BatchState.CASTING) and run.committed[0])
    run.driver.stop("enough")
    assert run.stages.failure == "enough" and not run.workers.casts
    run.driver.finish()
    assert run.workers.released


class Mishaps:
    """What may happen in a run, at a moment that chance chooses."""

    def __init__(self, run, chance):
        self.run = run
        self.chance = chance
        self.late = []  # what collectors have to say that were only stopped

    def collect(self):
        stages = self.run.stages
        orders = self.chance.choice(list(stages.orders.values()))
        if orders:
            answers = stages.collect(orders.popleft())
            where = self.chance.choice((stages.inbox, stages.inbox, self.late))
            where.extend(answers * self.chance.choice((1, 1, 2)))

    def cast(self):
        workers = self.run.workers
        if workers.open:
            outcomes = (Outcome.DONE, Outcome.DONE, Outcome.DONE, Outcome.NO_RIG, Outcome.DIED)
            workers.end(self.chance.choice(workers.open), self.chance.choice(outcomes))

    def lose_stage(self):
        stages = self.run.stages
        name = self.chance.choice(["generate", "sort", *stages.orders])
        self.late.extend(chain.from_iterable(map(stages.collect, stages.die(name))))

    def lose_worker(self):
        self.run.workers.die(self.chance.choice(list(self.run.workers.slots)))

    def wake(self):
        self.run.stages.inbox += self.late
        self.late.clear()

    def one_of_all(self):
        work = [self.run.stages.generate, self.collect, self.cast, self.run.stages.sort]
        rare = [self.lose_stage, self.lose_worker, self.wake]
        self.chance.choice([*work, *work, *work, *rare])()


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(chance=st.randoms(use_true_random=False))
def test_whatever_dies_each_scan_arrives_once_in_order(tmp_path_factory, chance):
    run = Run(tmp_path_factory.mktemp("run"))
    for number in range(chance.choice((1, 3))):
        run.begin(number, frames=chance.random() < 0.7)
    run.stages.advice = chance.choice((1, 4, 7))
    run.stages.seconds = chance.choice((0.1, 0.01))
    mishaps = Mishaps(run, chance)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(policies, "MAX_KILLS", 10**6)  # here nobody is to blame
        for _ in range(100):
            mishaps.one_of_all()
            if chance.random() < 0.7:
                run.step()
        run.stages.die("collect-0")  # what it had taken is not answered
        run.stages.die("collect-1")
        run.step()
        mishaps.wake()
        run.end()
    assert set(run.ended.values()) == {None}
    run.db.close()


@pytest.mark.parametrize("advice", [1, 7, SCANS])
def test_a_scene_that_kills_whoever_casts_it_is_told_after_a_few_deaths(run, advice):
    run.stages.advice = advice
    deaths = []

    def strike():
        for worker in {run.workers.casts[key][1] for key in run.workers.open}:
            run.workers.die(worker)
            deaths.append(worker)
        return run.ended

    run.until(strike)
    assert run.fails().startswith("3 casting workers in a row died while casting their first batch")
    assert len(deaths) <= 10


# -- several jobs ----------------------------------------------------------------------------------


@pytest.fixture
def two(run):
    """A driver with two jobs."""
    run.other = run.begin(1)
    return run


@pytest.mark.extended
@pytest.mark.parametrize("how", ["failed", "intersect", "collect", "cast"])
def test_a_job_that_fails_leaves_and_the_other_goes_on(two, how):
    two.stages.advice = 1
    if how == "failed":
        two.until(lambda: two.at(BatchState.CASTING) and two.committed[0])
        two.stages.inbox.append(Failed(0, "generate", "scan 59: out of order"))
        two.step()
        assert two.fails() == "Stage generate failed: scan 59: out of order"
    elif how == "cast":
        two.until(lambda: two.at(BatchState.CASTING, 0), idle="cast")
        two.workers.end(two.at(BatchState.CASTING, 0)[0].key, JobError("Stage intersect failed: 3"))
        two.step()
        assert two.fails() == "Stage intersect failed: 3"
    else:
        two.until(striking(two, how, 23))
        assert two.fails().startswith("3 workers in a row died")
    two.end()  # nothing is left of the first either
    assert two.ended[1] is None


def test_messages_of_a_job_that_has_failed_are_dropped_and_its_scans_pass(two):
    two.until(lambda: any(two.stages.orders.values()), idle="collect")
    late = [two.stages.collect(o) for orders in two.stages.orders.values() for o in orders]
    two.stages.inbox.append(Failed(0, "collect", "its disk is full"))
    two.step()
    two.stages.inbox += chain.from_iterable(late)
    committed = len(two.committed[0])
    two.end()
    assert len(two.committed[0]) == committed and two.ended.keys() == {0, 1}


def test_jobs_end_without_a_sorter_if_nobody_wants_frames(empty):
    for number in range(3):
        empty.begin(number, frames=False)
    empty.until(lambda: len(empty.ended) == 3, idle="sort")
    assert not empty.stages.unsorted
    empty.end()


def test_a_job_that_is_committed_ends_at_once(empty):
    empty.begin(frames=False)
    empty.until(lambda: empty.ended)
    empty.begin(frames=False)
    assert [error for _, error in empty.driver.step().ended] == [None]
    assert not empty.stages.described


def begin_tiny(run, count, scenes=(SCENE,), fit=1000):
    """Begin jobs of one batch each, once it is known that these are quickly cast."""
    run.stages.advice = 5
    run.stages.seconds = TASK_SECONDS / 16.5
    run.begin(count, TINY, frames=False)
    run.until(lambda: run.ended)
    for number in range(count):
        run.begin(number, TINY, scenes[number % len(scenes)], frames=False, fit=fit)


def test_tiny_jobs_of_a_scene_share_casting_tasks(empty):
    begin_tiny(empty, 64)
    tasks = empty.workers.tasks
    empty.until(lambda: len(empty.driver.dispatcher.batches) == 64, idle="cast")
    empty.end()
    assert empty.workers.most == 16 and empty.workers.tasks - tasks <= 8
    assert set(empty.workers.tried.values()) == {1} and len(empty.ended) == 65


def test_jobs_in_a_task_fit_into_the_memory_of_a_worker(empty):
    begin_tiny(empty, 64, fit=20)
    empty.until(lambda: len(empty.at(BatchState.WAITING)) > 20, idle="cast")
    empty.end()
    assert empty.workers.most == 4


def test_jobs_of_different_scenes_share_no_tasks(empty):
    begin_tiny(empty, 40, [SCENE, Scene.seed(), Scene.seed()])
    empty.until(lambda: len(empty.at(BatchState.WAITING)) > 20, idle="cast")
    empty.end()
    assert empty.workers.most > 1


def test_of_jobs_in_a_task_that_fails_only_the_cause_does(empty):
    begin_tiny(empty, 30)
    empty.until(lambda: len(empty.driver.dispatcher.batches) == 30, idle="cast")

    def fail():
        for key in empty.workers.open:
            if 17 in {number for number, _ in empty.workers.casts[key][0]}:
                empty.workers.end(key, JobError("scan 3: the mirror is loose"))
        return 17 in empty.ended

    empty.until(fail)
    assert str(empty.ended[17]) == "scan 3: the mirror is loose"
    empty.end()
    assert [number for number, error in empty.ended.items() if error] == [17]
    assert empty.workers.tried[17, 0, 5] == 2


@pytest.mark.parametrize("stage", ["intersect", "collect"])
def test_a_scan_that_kills_its_workers_is_found_among_tiny_jobs(empty, stage):
    begin_tiny(empty, 30)
    empty.until(lambda: len(empty.driver.dispatcher.batches) == 30, idle="cast")
    empty.until(striking(empty, stage, 3, job=17))
    assert empty.fails(17).startswith(
        f"3 workers in a row died in stage {stage} while they processed only scan 3"
    )
    empty.end()
    assert [number for number, error in empty.ended.items() if error] == [17]


@pytest.mark.extended
def test_stage_1_always_has_jobs_before_it_and_few_of_them(empty):
    begun = 0
    most = 0
    empty.stages.advice = 5
    empty.stages.seconds = 0.001
    empty.stages.set_message_scans = lambda scans: None

    def begin():
        nonlocal begun, most
        while begun < 2000 and empty.driver.has_room:
            empty.begin(begun, TINY, frames=False)
            begun += 1
        most = max(most, len(empty.driver.jobs))
        for _ in range(20):
            empty.stages.generate()
        return len(empty.ended) == 2000

    begin()
    assert begun >= ANNOUNCED
    empty.until(begin)
    assert 32 <= most <= 2 * max_weight_in_flight(2, 2, 32)


def test_slots_are_wanted_as_long_as_there_is_work(run):
    run.stages.seconds = 100.0
    run.end()
    wanted = run.workers.wanted
    assert wanted[1] == SCANS and wanted[-1] == 0
    assert wanted[1:] == sorted(wanted[1:], reverse=True)

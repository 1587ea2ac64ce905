"""Tasks take slots of their partition at any depth, and lend their own while they wait."""

import asyncio
import concurrent.futures
import logging
import os
import pickle
import signal
import subprocess
import sys
import threading
import time
from collections import defaultdict
from itertools import product
from types import SimpleNamespace

import dask
import pytest
from distributed import (
    Client,
    Event,
    Lock,
    Queue,
    Variable,
    as_completed,
    get_client,
    rejoin,
    secede,
    wait,
    worker_client,
)
from tests.poolpart.helpers import LONG_S, addresses, declared, join, kill, wait_for, worker_name

from poolpart import Partition, Pipe, Pool, PoolError, rest
from poolpart.extras import inherit, lending
from poolpart.extras.lending import lending_plugin
from poolpart.pipe import delete_pipes


class Gauge:
    """How many are in its block at a time; tasks of a cluster of threads share it."""

    def __init__(self):
        self.now = self.most = 0
        self._lock = threading.Lock()

    def __enter__(self):
        with self._lock:
            self.now += 1
            self.most = max(self.most, self.now)

    def __exit__(self, *_):
        with self._lock:
            self.now -= 1


gauge = Gauge()
meeting = threading.Barrier(2)  # of two tasks that have to run at a time


@pytest.fixture(autouse=True)
def _new_gauge():
    gauge.most = 0


def work(number):
    with gauge:
        time.sleep(0.02)
    return number


def parent(way, number=8):
    """Sum of what nested tasks return, for which it waits in one of several ways."""
    with gauge:
        client = get_client()
        items = range(number)
    if way == "collection":
        found = dask.compute(*(dask.delayed(work, pure=False)(i) for i in items))
    elif isinstance(way, Partition):
        found = list(way.map(work, items, chunk=1))
    else:
        futures = client.map(work, items, pure=False)
        if way == "gather":
            found = client.gather(futures)
        elif way == "result":
            found = [future.result() for future in futures]
        elif way == "as_completed":
            found = []
            for future in as_completed(futures):
                with gauge:
                    found.append(future.result())
        elif way == "wait":
            wait(futures)
            found = [future.result() for future in futures]
        else:
            with worker_client() as client:
                found = client.gather(futures)
    with gauge:
        return sum(found)


def one_worker(start, slots, nthreads=4):
    """Partition of one worker."""
    client = start({"a": {"nthreads": nthreads}})
    return Pool.from_client(client).partition("A", n_workers=1, slots=slots)[0]


def slots_there(part):
    """Slots that the workers of a partition have available."""
    addresses = [worker.address for worker in part.workers]
    return list(part.client.run(_available, part.name, workers=addresses).values())


def _available(name, dask_worker):
    return dask_worker.state.available_resources[name]


WAYS = ("gather", "result", "as_completed", "wait", "worker_client", "collection", "map")


@pytest.mark.extended(every=3)
@pytest.mark.parametrize("way", WAYS)
def test_on_one_slot_nested_tasks_and_their_parent_run_one_at_a_time(start, way):
    part = one_worker(start, slots=1)
    given = part if way == "map" else way
    assert part.submit(parent, given).result(LONG_S) == 28
    assert gauge.most == 1
    assert slots_there(part) == [1]


def meet(_):
    meeting.wait(LONG_S)
    return 1


def test_on_two_slots_two_at_a_time(start):
    part = one_worker(start, slots=2)
    assert part.submit(parent_of_pairs).result(LONG_S) == 8
    parents = [part.submit(parent, "result") for _ in range(3)]
    assert part.client.gather(parents) == [28] * 3
    assert gauge.most == 2
    assert slots_there(part) == [2]


def parent_of_pairs():
    client = get_client()
    return sum(client.gather(client.map(meet, range(8), pure=False)))


def descend(depth):
    """Three deep, with a wait at each level before another."""
    if not depth:
        return 1
    client = get_client()
    first = client.submit(descend, depth - 1, pure=False).result()
    return first + sum(client.gather(client.map(descend, [depth - 1] * 2, pure=False)))


@pytest.mark.extended
@pytest.mark.parametrize("workers", [1, 2])
def test_one_thread_and_one_slot_each_are_enough_at_any_depth(start, workers):
    client = start({str(number): {} for number in range(workers)})
    part, _ = Pool.from_client(client).partition("A", n_workers=workers)
    assert client.gather([part.submit(descend, 3) for _ in range(3)]) == [27] * 3
    assert slots_there(part) == [1] * workers


def submit_into(part, number):
    return part.submit(work, number).result()


def fail_below():
    try:
        get_client().submit(int, "x").result()
    except ValueError:
        return get_client().submit(int, "3").result()


def not_wait_long(gate):
    client = get_client()
    child = client.submit(wait_for, gate)
    with pytest.raises(TimeoutError):
        child.result(timeout=0.01)
    Event(gate, client).set()
    return child.result()


@pytest.mark.extended
def test_errors_and_timeouts_give_the_slots_back(start):
    part = one_worker(start, slots=2, nthreads=2)
    assert part.submit(fail_below).result(LONG_S) == 3
    assert part.submit(not_wait_long, "lending-timeout").result(LONG_S)
    with pytest.raises(ValueError, match="invalid literal"):
        part.submit(_raise_from_below).result(LONG_S)
    assert slots_there(part) == [2]


def _raise_from_below():
    return get_client().submit(int, "x").result()


def wait_below(gate, begun):
    client = get_client()
    child = client.submit(wait_for, gate, workers="b")  # which is not in the partition
    Event(begun, client).set()
    return child.result()


def test_a_parent_that_is_cancelled_keeps_its_worker_until_it_ends(start, wait_until):
    client = start({"a": {}, "b": {}})
    part, _ = Pool.from_client(client).partition("A", workers=["a"], minimum=0)
    future = part.submit(wait_below, "lending-cancelled", "lending-begun")
    assert Event("lending-begun", client).wait(LONG_S)
    wait_until(lambda: slots_there(part) == [1])  # lent
    with pytest.raises(PoolError, match=r"could not be moved within 0\.2 s"):
        part.shrink(timeout_s=0.2)
    future.cancel()
    wait_until(lambda: future.key not in client.cluster.scheduler.tasks)
    with pytest.raises(PoolError, match=r"could not be moved within 0\.2 s"):
        part.shrink(timeout_s=0.2)
    Event("lending-cancelled", client).set()
    assert part.shrink(timeout_s=LONG_S) == ["a"]
    assert part.grow(timeout_s=LONG_S)
    assert part.submit(descend, 2).result(LONG_S) == 9


def hold(gate):
    client = get_client()
    return client.submit(wait_for, gate, resources={"R": 1}).result(timeout=0.5)


def test_what_holds_a_resource_that_is_no_partition_lends_nothing(start):
    client = start({"a": {"nthreads": 2, "resources": {"R": 1}}, "b": {}})
    Pool.from_client(client).partition("A", workers=["b"])
    Event("lending-r", client).set()
    with pytest.raises(TimeoutError):
        client.submit(hold, "lending-r", resources={"R": 1}).result(LONG_S)


def secede_and_gather(depth, gate=None):
    """Wait for nested tasks like joblib: away from the threads, submitting in the event loop."""
    client = get_client()
    if not depth:
        time.sleep(0.01)
        return [worker_name()]
    found = []
    for _ in range(2):  # a task that has rejoined secedes again
        answer = concurrent.futures.Future()

        async def submit(answer=answer):
            futures = [client.submit(secede_and_gather, depth - 1, pure=False) for _ in range(3)]
            answer.set_result(await client.gather(futures, asynchronous=True))

        client.loop.add_callback(submit)
        secede()
        found += [name for names in answer.result(LONG_S) for name in names]
        rejoin()
    if gate:
        assert Event(gate, client).wait(LONG_S)
    return found


@pytest.mark.parametrize(("slots", "by_client"), [(1, True), (2, False)])
def test_nested_tasks_of_tasks_that_secede(start, wait_until, slots, by_client):
    client = start({"a": {"nthreads": slots}, "other": {"nthreads": 4}})
    part, _ = Pool.from_client(client).partition("A", workers=["a"], slots=slots)
    submit = part.as_client().submit if by_client else part.submit
    options = {"pure": False} if by_client else {}
    gate = f"seceded-{slots}-{by_client}"
    together = [submit(secede_and_gather, depth, **options) for depth in (2, 1)]
    assert client.gather(together) == [["a"] * 36, ["a"] * 6]
    wait_until(lambda: slots_there(part) == [slots])
    future = submit(secede_and_gather, 1, gate, **options)
    wait_until(lambda: part.stats().stages["secede_and_gather"].done == 56)
    wait_until(lambda: slots_there(part) == [slots - 1])  # holds its slot again
    Event(gate, client).set()
    assert future.result(LONG_S) == ["a"] * 6
    wait_until(lambda: slots_there(part) == [slots])


# -- workers that were started with a partition ------------------------------------------


@pytest.mark.extended
def test_a_partition_that_workers_were_started_with(start, wait_until):
    client = start({"a": {"resources": {"A": 1}}})
    scheduler = client.cluster.scheduler
    before = set(scheduler.plugins)
    with Client(client.cluster) as other:
        part = Partition("A", other)
        assert part.submit(submit_into, part, 5).result(LONG_S) == 5
        assert part.submit(descend, 3).result(LONG_S) == 27
        join(client, "b", resources={"A": 1})  # is told before it gets tasks
        assert part.submit(descend, 3, workers="b").result(LONG_S) == 27
    # What a client that is still there has begun ends with it.
    wait_until(lambda: set(scheduler.plugins) == before and not _lends(client))


def test_what_another_library_has_wrapped_meanwhile_stays(start, monkeypatch):
    part = one_worker(start, slots=1)
    called = []
    wrapped = {Client: "sync", as_completed: "__next__"}

    def wrap(inner):
        def theirs(*args, **kwargs):
            called.append(inner)
            return inner(*args, **kwargs)

        return theirs

    for owner, name in wrapped.items():
        monkeypatch.setattr(owner, name, wrap(getattr(owner, name)))
    before = [vars(owner)[name] for owner, name in wrapped.items()]
    Pool(part.client, []).dissolve()
    assert [vars(owner)[name] for owner, name in wrapped.items()] == before
    part, _ = Pool.from_client(part.client).partition("A", n_workers=1, slots=1)
    assert [vars(owner)[name] for owner, name in wrapped.items()] == before
    assert part.submit(parent, "as_completed").result(LONG_S) == 28
    assert len({*called}) == 2 and slots_there(part) == [1]


def _lends(client):
    plugins = client.run(lambda dask_worker: list(dask_worker.plugins)).values()
    return [name for names in plugins for name in names if "lending" in name]


@pytest.mark.extended
def test_a_worker_without_this_package_ignores_the_plugin():
    code = (
        "import sys; sys.modules['poolpart'] = None\n"
        "from distributed.protocol.pickle import loads\n"
        "plugin = loads(sys.stdin.buffer.read())\n"
        "plugin.setup(worker=None); plugin.transition('x', 'ready', 'executing')\n"
        "plugin.teardown(worker=None)"
    )
    subprocess.run([sys.executable, "-c", code], input=lending_plugin("A"), check=True)


# -- deaths --------------------------------------------------------------------------------


def wait_and_say(gate):
    wait_for(gate)
    return worker_name()


@pytest.mark.extended
@pytest.mark.parametrize("who", ["parent", "child"])
def test_whoever_dies_while_the_parent_waits(nannies, wait_until, who):
    part = Pool.from_client(nannies).divide({"A": rest()})["A"]
    gate = f"lending-dies-{who}"
    parent = part.submit(across, part, gate)
    assert Event(f"{gate}-begun", nannies).wait(LONG_S)
    scheduler = nannies.cluster.scheduler
    wait_until(lambda: any(t.key.startswith("wait_and_say") for t in scheduler.tasks.values()))
    wait_until(lambda: scheduler.tasks[parent.key].processing_on is not None)
    lender = str(scheduler.tasks[parent.key].processing_on.name)
    name = lender if who == "parent" else str(1 - int(lender))
    killed = kill(nannies, name)
    wait_until(lambda: addresses(nannies).get(name, killed) != killed)
    nannies.wait_for_workers(2, timeout=LONG_S)
    Event(gate, nannies).set()
    assert parent.result(LONG_S) == 1
    wait_until(lambda: declared(nannies) == {"0": {"A": 1}, "1": {"A": 1}})
    wait_until(lambda: slots_there(part) == [1, 1])


def test_workers_that_end_before_they_keep_their_slots_again_print_nothing(
    own_nannies, caplog, wait_until
):
    """As when a cluster is closed right after its last client."""
    caplog.set_level(logging.ERROR)
    with Client(own_nannies.cluster) as client:
        Partition("A", client).submit(worker_name)
        pids = client.run(os.getpid).values()
        for pid in pids:
            os.kill(pid, signal.SIGSTOP)  # before they answer
    wait_until(lambda: inherit.NAME not in own_nannies.cluster.scheduler.plugins)
    # Requests under way show nowhere else: that is what the test is about.
    assert inherit._requests
    for pid in pids:
        os.kill(pid, signal.SIGKILL)
    wait_until(lambda: not inherit._requests)
    assert caplog.text == ""


def across(part, gate):
    child = part.submit(wait_and_say, gate)
    Event(f"{gate}-begun", part.client).set()
    child.result()
    return descend(0)


# -- waits for what nested tasks send, rather than for their futures ---------------------------


def send(channel, name):
    if channel == "queue":
        Queue(name).put(1)
    elif channel == "variable":
        Variable(name).set(1)
    else:
        Event(name).set()


def receive(channel, name):
    """Wait for what a nested task sends."""
    future = get_client().submit(send, channel, name, pure=False)
    if channel == "queue":
        Queue(name).get(LONG_S)
    elif channel == "variable":
        Variable(name).get(LONG_S)
    else:
        assert Event(name).wait(LONG_S)
    return future.result()


@pytest.mark.parametrize("channel", ["queue", "variable", "event"])
def test_a_task_on_the_only_slot_receives_what_its_nested_task_sends(client, b, channel):
    assert b.submit(receive, channel, f"{channel}-{client.id}").result(LONG_S) is None


def answer(name):
    """Answer each number that a parent sends, until 0."""
    while number := Queue(f"{name}-down").get(LONG_S):
        Queue(f"{name}-up").put(number * 10)


def converse(name):
    future = get_client().submit(answer, name, pure=False)
    answers = []
    for number in (1, 2, 3):
        Queue(f"{name}-down").put(number)
        answers.append(Queue(f"{name}-up").get(LONG_S))
    Queue(f"{name}-down").put(0)
    future.result()
    return answers


def test_parent_and_nested_task_lend_the_only_slot_to_each_other(client, b):
    assert b.submit(converse, f"converse-{client.id}").result(LONG_S) == [10, 20, 30]
    assert slots_there(b) == [1]


def release(name):
    Event(f"{name}-locked").wait(LONG_S)
    Lock(name).acquire(timeout=LONG_S)
    return 1


def hold_lock(name):
    lock = Lock(name)
    assert lock.acquire()
    future = get_client().submit(release, name, pure=False)
    Event(f"{name}-locked").set()
    Queue(name).get(LONG_S)
    lock.release()
    return future.result()


def test_a_nested_task_that_waits_for_a_lock_lends_its_slot(client, b, wait_until):
    name = f"lock-{client.id}"
    future = b.submit(hold_lock, name)
    time.sleep(0.3)
    Queue(name, client).put(1)
    assert future.result(LONG_S) == 1


def poll(stop):
    """Poll for a nested task without any request to the scheduler, which may lend the slot."""
    future = get_client().submit(worker_name, pure=False)
    while not future.done() and not stops[stop].is_set():
        time.sleep(0.01)
    return future.done()


stops = {}  # {name: threading.Event}; tasks of a cluster of threads share it


@pytest.fixture
def stop():
    """Name of an event that ends polling."""
    name = f"stop-{time.monotonic_ns()}"
    stops[name] = threading.Event()
    yield name
    stops.pop(name).set()


@pytest.fixture
def warned(monkeypatch):
    """Return the texts of warnings to a cluster's clients; nested tasks wait for a moment first."""
    monkeypatch.setattr("poolpart.extras.lending.WARN_AFTER_S", 0.2)
    return lambda client: [pickle.loads(event["message"]) for _, event in client.get_events("warn")]


def test_polling_for_a_nested_task_is_reported_to_the_client(client, b, warned, wait_until, stop):
    future = b.submit(poll, stop)
    wait_until(lambda: any(future.key in message for message in warned(client)))
    [message] = [message for message in warned(client) if future.key in message]
    assert "partition 'B'" in message and "Use `Future.result`, `distributed.wait`" in message
    stops[stop].set()
    assert future.result(LONG_S) is False


def poll_together(stop, number, count):
    """Poll when all parents hold their slots, so that each nested task waits on some worker."""
    Event(f"{stop}-{number}").set()
    for parent_number in range(count):
        assert Event(f"{stop}-{parent_number}").wait(LONG_S)
    return poll(stop)


def test_polling_on_several_workers_is_reported(start, warned, wait_until, stop):
    client = start({name: {"resources": {"A": 1}} for name in "ab"})
    part = Partition("A", client)
    futures = [part.submit(poll_together, stop, n, 2, workers="ab"[n]) for n in range(2)]
    keys = [future.key for future in futures]
    wait_until(lambda: any(key in message for message in warned(client) for key in keys))
    stops[stop].set()
    # Once a parent ends, its slot is free, and the nested task of the other may end before that.
    assert False in client.gather(futures)


def wait_alone(name):
    Event(f"{name}-started").set()
    return Queue(name).get(LONG_S)


def test_a_waiting_task_without_nested_tasks_keeps_its_slot(client, b):
    name = f"alone-{client.id}"
    waiting = b.submit(wait_alone, name)
    assert Event(f"{name}-started", client).wait(LONG_S)
    later = b.submit(worker_name)
    time.sleep(0.3)
    assert not later.done()
    Queue(name, client).put(1)
    assert waiting.result(LONG_S) == 1
    assert later.result(LONG_S) == "B-0"


def grow_tree(channel, name, level):
    """Run a tree of tasks, each of which waits for a message of each task below it."""
    below = [f"{name}{branch}" for branch in range(2 if level else 0)]
    client = get_client()
    futures = [client.submit(grow_tree, channel, child, level - 1, pure=False) for child in below]
    total = 1 + sum(channel(child).get(LONG_S) for child in below)
    channel(name).put(total)
    return len(futures)


LEVELS = 6


@pytest.fixture(params=[Queue, Pipe])
def tree(request):
    """Grow a tree of 127 tasks in a partition, whose messages go through queues or pipes."""

    def grow(client):
        channel = request.param
        root = f"tree-{client.id}-"
        branches = ["".join(path) for n in range(LEVELS + 1) for path in product("01", repeat=n)]
        pipes = [Pipe(root + branch, client=client).create() for branch in branches]
        if channel is Queue:
            delete_pipes(client, [pipe.name for pipe in pipes])
        part = Partition("A", client)
        assert part.submit(grow_tree, channel, root, LEVELS).result(LONG_S) == 2
        return channel(root, client=client).get(LONG_S)

    return grow


@pytest.mark.extended
def test_a_tree_of_waiting_tasks_on_two_slots_ends(start, tree):
    client = start({"a": {"resources": {"A": 2}, "nthreads": 2}})
    assert tree(client) == 2 ** (LEVELS + 1) - 1


@pytest.mark.extended
def test_a_tree_of_waiting_tasks_on_two_workers_ends(start, tree):
    client = start({name: {"resources": {"A": 1}} for name in "ab"})
    assert tree(client) == 2 ** (LEVELS + 1) - 1


@pytest.mark.extended
def test_with_more_slots_than_threads_tasks_lend_their_thread_again(start):
    """Dask then starts a nested task that has no thread: it waits for that of its parent."""
    client = start({"a": {"resources": {"A": 3}, "nthreads": 1}})
    part = Partition("A", client)
    assert part.submit(converse, f"three-{client.id}").result(LONG_S) == [10, 20, 30]
    assert part.submit(converse_anew, f"anew-{client.id}", 3).result(LONG_S) == [10, 20, 30]


def converse_anew(name, times):
    return [converse(f"{name}-{number}")[number] for number in range(times)]


def wait_and_hand_over(name):
    """Wait, so that another task gets the only thread, and then give it what it waits for."""
    Queue(f"{name}-first").get(LONG_S)
    Queue(f"{name}-second").put(1)
    return 1


def start_the_other(name):
    Queue(f"{name}-first").put(1)
    return Queue(f"{name}-second").get(LONG_S)


def test_a_task_that_wants_its_thread_back_gets_it_from_one_that_waits(start):
    client = start({"a": {"resources": {"A": 2}, "nthreads": 1}})
    part = Partition("A", client)
    name = f"thread-{client.id}"
    futures = [part.submit(parent_of_both, name)]
    assert client.gather(futures) == [[1, 1]]


def parent_of_both(name):
    client = get_client()
    futures = [client.submit(f, name, pure=False) for f in (wait_and_hand_over, start_the_other)]
    return client.gather(futures)


def test_only_tasks_that_have_waited_long_are_checked_and_once():
    warned = []

    def call_later(_warn, key, task):
        warned.append((key, task.key))

    now = time.monotonic()
    submitter = {name: lending.SubmittingTask(name, "tcp://a:1") for name in ("old", "new", "told")}
    ages_s = {"old": lending.WARN_AFTER_S + 1, "new": 1, "told": lending.WARN_AFTER_S + 1}
    lender = SimpleNamespace(
        worker=SimpleNamespace(loop=SimpleNamespace(add_callback=call_later)),
        update_seceded=lambda: None,
        _nested={
            f"nested-{name}": lending._NestedTask(submitter[name], now - age_s)
            for name, age_s in ages_s.items()
        },
        _seceded=set(),
        _warned={"told"},
        _warn=None,
        _next_check=object(),
        _schedule_check=lambda: warned.append("again"),
    )
    lending.Lender._check_nested(lender)
    assert warned == [("nested-old", "old"), "again"]
    assert lender._warned == {"old", "told"} and lender._next_check is None
    lending.Lender._check_nested(lender)
    assert warned == [("nested-old", "old"), "again", "again"]
    lender._nested = {}
    lending.Lender._check_nested(lender)
    assert len(warned) == 3 and not lender._warned, "all may be warned of again"
    lender._seceded = {"some"}
    lending.Lender._check_nested(lender)
    assert warned[3:] == ["again"]


@pytest.mark.parametrize("runs", [True, False])
@pytest.mark.parametrize("state", ["", "lent", "seceded", "returning"])
def test_a_running_task_holds_its_slots_unless_it_has_lent_them(monkeypatch, runs, state):
    monkeypatch.setattr(lending, "is_running", lambda worker, key: runs and worker == "worker")
    lender = SimpleNamespace(
        worker="worker",
        _loans=defaultdict(int, task=1 if state == "lent" else 0, other=1),
        _seceded={"task"} if state == "seceded" else {"another"},
        _returning=[SimpleNamespace(key="task" if state == "returning" else "third")],
    )
    assert lending.Lender.holds_slots(lender, "task") == (runs and not state)


@pytest.mark.parametrize(
    ("answer", "waits"), [(True, True), (True, False), (False, True), (OSError(), True)]
)
def test_a_warning_needs_a_submitter_with_slots_and_a_task_that_still_waits(
    monkeypatch, answer, waits
):
    async def ask(worker, address, function, key):
        assert (address, key) == ("tcp://a:1", "parent")
        if isinstance(answer, Exception):
            raise answer
        return answer

    events = []
    monkeypatch.setattr(lending, "call_worker", ask)
    monkeypatch.setattr(lending, "resources_of", lambda _: {"lidar": 1, "camera": 2})
    lender = SimpleNamespace(
        worker=SimpleNamespace(
            state=SimpleNamespace(tasks={"nested": None}),
            log_event=lambda topic, event: events.append((topic, pickle.loads(event["message"]))),
        ),
        _nested={"nested": None} if waits else {},
        _warned={"parent", "other"},
    )
    task = lending.SubmittingTask("parent", "tcp://a:1")
    asyncio.run(lending.Lender._warn(lender, "nested", task))
    if answer is True and waits:
        ((topic, message),) = events
        assert topic == "warn" and lender._warned == {"parent", "other"}
        assert "Task 'parent' of partition 'lidar' and 'camera' holds a slot" in message
        assert "while task 'nested', which it has submitted, waits" in message
    else:
        assert not events and lender._warned == {"other"}

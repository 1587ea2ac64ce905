"""Balanced groups on clusters: the division follows the work, and no item is lost or doubled."""

import itertools
import logging
import os
import queue
import signal
import threading
import time
from contextlib import contextmanager

import pytest
from distributed import Client, Nanny, Scheduler
from tests.clusters import QUIET
from tests.poolpart.helpers import LONG_S, addresses, leave, metrics_of, worker_name

from poolpart import Partition, Pool, PoolError, n_workers
from poolpart.adapting import JobSpec, add_partitions
from poolpart.balancing import NAME as BALANCER
from poolpart.deploy.local_processes import FixedCluster

# The workers are threads of this process, so their tasks share these objects.
arrived = queue.SimpleQueue()
detect_s = 0.0
released = threading.Event()


def decode(item, out):
    time.sleep(0.02)
    out.put(item)


def detect(item):
    time.sleep(detect_s)
    arrived.put(item)


def items_until(enough):
    """Yield numbers until an event is set."""
    yield from itertools.takewhile(lambda _: not enough.is_set(), itertools.count())


def pause(_=None):
    time.sleep(0.05)


def hold(_=None):
    return released.wait(LONG_S)


def sizes(parts):
    return [len(part) for part in parts]


def all_arrived():
    return [arrived.get() for _ in range(arrived.qsize())]


def divide(client, **counts):
    rules = {name: n_workers(count) for name, count in counts.items()}
    return list(Pool.from_client(client).divide(rules).values())


def balance(client, parts, **options):
    return Pool(client, ()).balance(parts, **options)


@contextmanager
def keep_busy(*parts):
    """Keep partitions busy within the block, however slow this machine is."""
    tasks = [part.submit(pause) for part in parts for _ in range(1000)]
    yield
    parts[0].client.cancel(tasks)


@pytest.fixture
def quickly(monkeypatch):
    """Decide often, and forget soon."""
    monkeypatch.setattr("poolpart.balancing.INTERVAL_S", 0.05)
    monkeypatch.setattr("poolpart.balance_policy.MIN_MEMORY_S", 0.2)


@pytest.fixture
def eight(start):
    """Client of eight workers."""
    return start({name: {} for name in "abcdefgh"})


@pytest.mark.extended
def test_the_division_follows_the_running_times_and_each_item_arrives_once(
    eight, quickly, make_pipe, monkeypatch, wait_until
):
    decoding, detecting = parts = divide(eight, DECODE=4, DETECT=4)
    frames = make_pipe(eight, capacity=8)
    monkeypatch.setattr("tests.poolpart.test_balancing.detect_s", 0.06)
    with balance(eight, parts) as group:
        enough = threading.Event()
        first = decoding.for_each(items_until(enough), decode, out=frames, wait=False)
        second = detecting.for_each(frames, detect, wait=False)
        wait_until(lambda: sizes(parts) in ([2, 6], [3, 5]))
        monkeypatch.setattr("tests.poolpart.test_balancing.detect_s", 0.002)
        wait_until(lambda: sizes(parts) in ([6, 2], [7, 1]))
        enough.set()
        count = first.result(LONG_S)
        frames.close()
        assert second.result(LONG_S) == count
        stats = group.stats()
    assert sorted(all_arrived()) == list(range(count))
    assert sum(sizes(parts)) == 8
    assert {(move.source, move.destination) for move in stats.moves} == {
        ("DECODE", "DETECT"),
        ("DETECT", "DECODE"),
    }
    assert "DETECT needs " in stats.moves[0].reason
    assert parts[0].stats().target == len(parts[0])


def put_two(out):
    time.sleep(0.1)
    out.put_many([1, 2])


def get_two(pipe):
    return [pipe.get(), pipe.get()]


def test_a_task_that_waits_for_a_pipe_does_not_make_its_partition_appear_slow(
    start, quickly, make_pipe, wait_until
):
    client = start({name: {} for name in "abc"})
    a, b = parts = divide(client, A=1, B=2)
    with balance(client, parts, max={"A": 1}) as group:
        full = make_pipe(client, capacity=1)
        task = a.submit(put_two, full)
        time.sleep(1.0)  # the pipe is full
        assert full.get() == 1
        task.result(LONG_S)
        wait_until(lambda: group.stats().partitions["A"].task_s)
        empty = make_pipe(client)
        other = b.submit(get_two, empty)
        time.sleep(1.0)  # the pipe is empty
        empty.put_many([1, 2])
        assert other.result(LONG_S) == [1, 2]
        wait_until(lambda: b.stats().done == 1)
        for part in parts:
            assert 0.5 < part.stats().pipe_seconds < part.stats().seconds
            assert part.stats().seconds - part.stats().pipe_seconds < 0.5
        assert group.stats().partitions["A"].task_s < 0.5


@pytest.mark.extended
def test_submitted_tasks_attract_workers_in_bursts(eight, quickly, wait_until):
    parts = divide(eight, A=4, B=4)
    with balance(eight, parts, min=2):
        for part, expected in (0, [6, 2]), (1, [2, 6]), (0, [6, 2]):
            tasks = [parts[part].submit(pause) for _ in range(300)]
            wait_until(lambda expected=expected: sizes(parts) == expected)
            assert eight.gather(tasks) == [None] * 300


@pytest.mark.extended
def test_bounds_of_each_partition_and_of_its_rule(eight, quickly, wait_until):
    rules = {"A": n_workers(3), "B": n_workers(4, minimum=3), "C": n_workers(1)}
    a, b, c = parts = list(Pool.from_client(eight).divide(rules).values())
    with balance(eight, parts, max={"A": 4}, min={"C": 0}):
        with keep_busy(a):
            wait_until(lambda: len(a) == 4)
            assert len(b) >= 3
        with keep_busy(c):
            wait_until(lambda: sizes(parts) == [1, 3, 4])


@pytest.mark.extended
def test_other_partitions_give_and_receive_nothing(start, quickly, wait_until):
    client = start({name: {} for name in "abcdef"} | {"gpu": {"resources": {"GPU": 1}}})
    a, b = divide(client, A=3, B=3)
    gpu = Partition("GPU", client)
    with balance(client, [a, b]), keep_busy(gpu, a):
        wait_until(lambda: sizes([a, b]) == [5, 1])
    assert [worker.name for worker in gpu.workers] == ["gpu"]


def gpus_of_worker(dask_worker=None):
    return ("GPU-1",) if str(dask_worker.name) in "gh" else ()


def test_workers_with_gpus_are_not_interchangeable_with_others(
    eight, quickly, monkeypatch, wait_until
):
    monkeypatch.setattr("poolpart.balancing.worker_gpus", gpus_of_worker)
    pool = Pool.from_client(eight)
    a, _ = pool.partition("A", workers=["a", "b", "c"])
    b, _ = pool.partition("B", workers=["d", "e", "f"])
    gpu, _ = pool.partition("GPU", workers=["g", "h"])
    with pytest.raises(PoolError, match=r"'GPU' have GPUs and workers of partition '[AB]' do not"):
        pool.balance([a, b, gpu])
    with pool.balance([a, b]):
        assert a.grow(1, source="GPU") in (["g"], ["h"])
        with keep_busy(b):
            wait_until(lambda: sizes([a, b, gpu]) == [1, 6, 1])
    assert {worker.name for part in (a, gpu) for worker in part.workers} == {"g", "h"}


@pytest.mark.extended
def test_only_the_named_workers_are_moved(eight, quickly, wait_until):
    pool = Pool.from_client(eight)
    a, _ = pool.partition("A", workers=list("abcd"))
    b, _ = pool.partition("B", workers=list("efgh"))
    with pool.balance(["A", "B"], workers=["e", "f"]) as group:
        with keep_busy(a):
            wait_until(lambda: len(a) == 6)
        assert {move.worker for move in group.stats().moves} == {"e", "f"}
    assert sorted(worker.name for worker in b.workers) == ["g", "h"]


def test_a_worker_that_does_not_finish_stays_and_is_left_alone(
    start, quickly, monkeypatch, wait_until
):
    monkeypatch.setattr("poolpart.balancing.DRAIN_S", 0.2)
    released.clear()
    client = start({name: {} for name in "abcd"})
    a, b = divide(client, A=2, B=2)
    balancer = client.cluster.scheduler.plugins
    with balance(client, [a, b]) as group:
        held = [b.submit(hold) for _ in range(2)]
        wait_until(lambda: b.stats().running == 2)
        with keep_busy(a):
            wait_until(lambda: len(balancer[BALANCER].groups[0].paused_until) == 2)
        released.set()
        assert client.gather(held) == [True, True]
        assert group.stats().moves == []
    assert sizes([a, b]) == [2, 2]


def test_workers_that_leave_for_good_are_replaced_from_the_group(eight, quickly, wait_until):
    a, _ = parts = divide(eight, A=2, B=6)
    with balance(eight, parts, min=2):
        tasks = [part.submit(pause) for part in parts for _ in range(60)]
        leave(eight, a.workers[0].name)
        wait_until(lambda: len(a) >= 2 and sum(sizes(parts)) == 7)
        assert eight.gather(tasks) == [None] * 120


def move_a_waiting_task(attempt, dask_scheduler=None):
    """Move a task of worker a to worker b, like work stealing.

    A worker refuses to hand over the task that it runs, so each attempt takes another task.
    """
    by_name = {worker.name: worker for worker in dask_scheduler.workers.values()}
    a, b = by_name["a"], by_name["b"]
    task = list(a.processing)[attempt % len(a.processing)]
    dask_scheduler.extensions["stealing"].move_task_request(task, a, b)


def test_slots_are_counted_right_after_the_first_worker_of_a_stolen_task_has_left(
    start, quickly, wait_until
):
    released.clear()
    client = start({name: {} for name in "abcd"})
    pool = Pool.from_client(client)
    a, _ = pool.partition("A", workers=["a", "b"])
    b, _ = pool.partition("B", workers=["c", "d"])
    workers = {w.name: w for w in client.cluster.scheduler.workers.values()}
    released.set()
    client.gather([a.submit(hold) for _ in range(2)])  # workers only receive short tasks in advance
    released.clear()
    with balance(client, [a, b], min=2) as group:
        tasks = [a.submit(hold) for _ in range(8)]
        wait_until(lambda: len(workers["a"].processing) == len(workers["b"].processing) == 4)
        attempts = itertools.count()

        def another_has_been_moved():
            if len(workers["b"].processing) == 4:
                client.run_on_scheduler(move_a_waiting_task, next(attempts))
            return len(workers["b"].processing) > 4

        wait_until(another_has_been_moved)
        released.set()
        assert client.gather(tasks) == [True] * 8
        leave(client, "a")
        # The statistics are empty before the first interval.
        wait_until(lambda: group.stats().partitions and group.stats().partitions["A"].workers == 1)
        # Tasks whose results have left with the worker run again.
        wait_until(lambda: group.stats().partitions["A"].backlog == 0)


def test_the_group_outlives_its_client_and_ends_with_its_partitions(start, quickly, wait_until):
    client = start({name: {} for name in "abcd"})
    scheduler = client.cluster.scheduler
    with Client(client.cluster) as other:
        group = balance(other, divide(client, A=2, B=2))
        assert repr(group) == "<BalancedGroup: A, B>"
    a, b = (Partition(name, client) for name in "AB")
    with keep_busy(a):
        wait_until(lambda: sizes([a, b]) == [3, 1])
    b.dissolve()
    wait_until(lambda: BALANCER not in scheduler.plugins)
    group.client = client
    assert group.stats().partitions == {}
    group.stop()


def test_a_group_in_a_block_ends_with_its_client_and_others_are_listed(start, wait_until):
    client = start({name: {} for name in "abcd"})
    parts = divide(client, A=2, B=2)
    pool = Pool.from_client(client)
    with Client(client.cluster, set_as_default=False) as other:
        balance(other, parts)  # outside of a block
    [group] = pool.balanced_groups()
    assert group.names == ("A", "B") and group.stats().partitions.keys() <= {"A", "B"}
    other = Client(client.cluster, set_as_default=False)
    balance(other, parts).__enter__()
    assert len(pool.balanced_groups()) == 1
    other.close()  # as if it were killed
    wait_until(lambda: not pool.balanced_groups())
    balance(client, parts)
    pool.balanced_groups()[0].stop()
    assert BALANCER not in client.cluster.scheduler.plugins


def test_a_group_that_was_stopped_moves_no_workers(eight, quickly):
    a, b = parts = divide(eight, A=4, B=4)
    group = balance(eight, parts)
    group.stop()
    group.stop()
    eight.gather([a.submit(pause) for _ in range(60)])
    assert sizes(parts) == [4, 4]
    assert BALANCER not in eight.cluster.scheduler.plugins
    assert len(b) == 4


@pytest.mark.extended
def test_balancing_again_replaces_the_bounds(eight, quickly, wait_until):
    a, b = parts = divide(eight, A=4, B=4)
    balance(eight, parts, max=4)
    with balance(eight, [b, a], max=6), keep_busy(a):
        wait_until(lambda: sizes(parts) == [6, 2])
    assert BALANCER not in eight.cluster.scheduler.plugins


@pytest.mark.extended(every=5)
@pytest.mark.parametrize(
    ("names", "options", "message"),
    [
        (["A"], {}, "at least two different partitions"),
        (["A", "A"], {}, "at least two different partitions"),
        (["A", "X"], {}, "no partition 'X'"),
        (["A", ""], {}, "Invalid partition name"),
        (["A", "B"], {"min": -1}, "value -1 for `min` of partition 'A'"),
        (["A", "B"], {"min": 3, "max": {"B": 2}}, "minimum of partition 'B' is 3, but its max"),
        (["A", "B"], {"max": {"X": 2}}, "`max` names 'X'"),
        ("AB", {}, "value 'AB' for `partitions`. Expected a list"),
        (None, {}, "value None for `partitions`"),
        (["A", None], {}, "Invalid partition name None"),
        (["A", "B"], {"min": True}, "value True for `min` of partition 'A'"),
        (["A", "B"], {"min": float("nan")}, "value nan for `min` of partition 'A'"),
        (["A", "B"], {"max": {"B": 0}}, "value 0 for `max` of partition 'B'"),
        (["A", "B"], {"workers": "a"}, "value 'a' for `workers`"),
        (["A", "B"], {"workers": []}, r"value \[\] for `workers`"),
        (["A", "B"], {"workers": 1}, "value 1 for `workers`"),
        (["A", "B"], {"workers": [None]}, r"value \[None\] for `workers`"),
        (["A", "C"], {}, "'C' already belongs to another balanced group"),
        (["A", "B"], {"workers": ["x"]}, "`workers` names 'x', but the partitions have no such"),
        (["A", "B"], {"min": 2}, "require 4 workers in total, but they have 2. Reduce `min`"),
    ],
)
def test_impossible_groups_are_refused(start, names, options, message):
    client = start({name: {} for name in "abcd"})
    parts = divide(client, A=1, B=1, C=1, D=1)
    with balance(client, parts[2:]), pytest.raises(PoolError, match=message):
        balance(client, names, **options)


def test_a_maximum_must_leave_room_for_all_workers(start):
    client = start({name: {} for name in "abcd"})
    parts = divide(client, A=3, B=1)
    with pytest.raises(PoolError, match="may have 2 workers in total, but they have 4"):
        balance(client, parts, max=1)
    balance(client, parts, max=2).stop()


def test_a_maximum_below_the_minimum_of_the_rule_is_refused(start):
    client = start({name: {} for name in "abcd"})
    pool = Pool.from_client(client)
    pool.divide({"A": n_workers(2, minimum=2), "B": n_workers(2)})
    with pytest.raises(PoolError, match="'A' has the minimum 2, so its `max` cannot be 1"):
        pool.balance(["A", "B"], max={"A": 1})


def test_a_refused_group_changes_no_partition(start):
    client = start({"a": {"resources": {"A": 1}}, "b": {"resources": {"B": 1}}, "c": {}})
    pool = Pool.from_client(client)
    with pytest.raises(PoolError, match="no partition 'X'"):
        pool.balance(["A", "B", "X"])
    leave(client, "a")
    assert list(pool.partitions()) == ["B"]  # A has not become a partition with a rule


@pytest.mark.extended
def test_a_partition_that_is_created_again_is_not_balanced(eight, quickly, wait_until):
    a, b, c = parts = divide(eight, A=2, B=2, C=4)
    with balance(eight, parts) as group:
        wait_until(lambda: group.stats().partitions.keys() == {"A", "B", "C"})
        c.dissolve()
        [again] = divide(eight, C=4)
        wait_until(lambda: group.stats().partitions.keys() == {"A", "B"})
        with keep_busy(a):
            wait_until(lambda: len(a) == 3)
            assert sizes([b, again]) == [1, 4]
        with pytest.raises(PoolError, match="'B' already belongs to another balanced group"):
            balance(eight, [b, again])
    balance(eight, [b, again]).stop()
    pool = Pool.from_client(eight)
    with balance(eight, [a, b]) as group:
        pool.dissolve()
        divide(eight, A=4, B=4)
        wait_until(lambda: group.stats().partitions == {})


def test_a_partition_of_a_group_cannot_become_adaptive(start):
    client = start({name: {"resources": {name.upper(): 1}} for name in "abcd"})
    add = {"specs": {"A": JobSpec(1), "B": JobSpec(1)}}
    client.run_on_scheduler(add_partitions, **add)
    a = Partition("A", client)
    message = "'A' belongs to a balanced group, so its workers"
    with balance(client, ["A", "B"]), pytest.raises(PoolError, match=message):
        a.adapt(0, 2)
    a.adapt(0, 2)
    with pytest.raises(PoolError, match="'A' is adaptive, so its workers cannot be moved"):
        balance(client, ["A", "B"])


def test_an_error_in_the_block_is_not_replaced_by_that_of_a_closed_client(start):
    client = start({name: {} for name in "ab"})
    divide(client, A=1, B=1)
    other = Client(client.cluster)
    group = balance(other, ["A", "B"])

    def fail_in_block():
        with group:
            other.close()
            raise ValueError("of the block")

    with pytest.raises(ValueError, match="of the block") as caught:
        fail_in_block()
    assert "The balanced group was not stopped. The client is closed." in caught.value.__notes__[0]
    with pytest.raises(PoolError, match="The client is closed"):
        group.stop()


@contextmanager
def moving(client, parts, wait_until):
    """Keep a worker of the second partition moving, since it has to finish a task, in the block.

    The first value is the name of the worker.
    """
    released.clear()
    a, b = parts
    held = [b.submit(hold) for _ in range(2)]
    wait_until(lambda: b.stats().running == 2)
    names = {worker.name for worker in b.workers}
    with keep_busy(a):
        wait_until(lambda: len(b) == 1 and len(a) == 2)
    yield (names - {worker.name for worker in b.workers}).pop()
    released.set()
    client.gather(held)


@pytest.mark.extended
def test_partitions_are_dissolved_while_a_worker_is_moved(start, quickly, wait_until):
    client = start({name: {} for name in "abcd"})
    pool = Pool.from_client(client)
    parts = divide(client, A=2, B=2)
    group = balance(client, parts)
    with (
        moving(client, parts, wait_until),
        pytest.raises(PoolError, match="tasks of partitions 'A' and 'B' have not finished"),
    ):
        pool.dissolve(timeout_s=0.2)
    assert pool.dissolve() == ["A", "B"]
    scheduler = client.cluster.scheduler
    wait_until(lambda: BALANCER not in scheduler.plugins)
    assert [worker.resources for worker in scheduler.workers.values()] == [{}] * 4
    assert group.stats().partitions == {}


def test_a_worker_leaves_while_it_is_moved(start, quickly, wait_until):
    client = start({name: {} for name in "abcd"})
    parts = divide(client, A=2, B=2)
    with balance(client, parts) as group:
        with moving(client, parts, wait_until) as name:
            threading.Timer(0.2, released.set).start()  # a worker that closes waits for its task
            leave(client, name)
            wait_until(lambda: sum(s.workers for s in group.stats().partitions.values()) == 3)
        wait_until(lambda: sum(sizes(parts)) == 3)
        assert all(part.submit(worker_name).result(LONG_S) != name for part in parts)


@pytest.mark.extended
def test_the_group_goes_on_after_the_workers_were_restarted(patient, quickly, wait_until):
    with process_cluster(4) as cluster, Client(cluster) as client:
        client.wait_for_workers(4, timeout=LONG_S)
        a, b = parts = divide(client, A=2, B=2)
        with balance(client, parts) as group:
            with keep_busy(a):
                wait_until(lambda: sizes(parts) == [3, 1])
            client.restart()
            wait_until(lambda: sizes(parts) == [3, 1])
            with keep_busy(b):
                wait_until(lambda: sizes(parts) == [1, 3])
            assert group.stats().partitions.keys() == {"A", "B"}


def test_workers_that_do_not_report_their_gpus_are_asked_again(
    start, quickly, monkeypatch, wait_until, caplog
):
    answers = {"b": iter([OSError("busy"), ()])}

    async def call(scheduler, address, function, **arguments):
        answer = next(answers.get(str(scheduler.workers[address].name), iter([()])))
        if isinstance(answer, OSError):
            raise answer
        return answer

    monkeypatch.setattr("poolpart.balancing.PAUSE_S", 0.2)
    monkeypatch.setattr("poolpart.balancing.call_worker", call)
    client = start({name: {} for name in "abc"})
    caplog.set_level(logging.WARNING, "poolpart.balancing")  # the cluster has silenced it
    parts = divide(client, A=1, B=2)
    with balance(client, parts), keep_busy(parts[0]):
        wait_until(lambda: sizes(parts) == [2, 1])
    assert caplog.text.count("is not moved for now, because it does not report its GPUs. busy") == 1


def test_moves_are_shown_on_the_page_and_logged(eight, quickly, wait_until, caplog):
    caplog.set_level(logging.INFO, "poolpart.balancing")
    a, b = parts = divide(eight, A=4, B=4)
    from poolpart.extras.dashboard_page import render_page

    with balance(eight, parts) as group:
        with keep_busy(a):
            wait_until(lambda: group.stats().moves)
        page = eight.run_on_scheduler(lambda dask_scheduler: render_page(dask_scheduler)).decode()
        text = repr(group.stats())
        html = group.stats()._repr_html_()
    for shown in (page, text, html, caplog.text):
        assert "workers and has 4, B needs " in shown
    assert len(b) < 4


@pytest.mark.extended
def test_prometheus_reads_the_shares_and_the_moves(eight, quickly, wait_until):
    a, _ = parts = divide(eight, A=4, B=4)
    with balance(eight, parts, min=2) as group:
        with keep_busy(a):
            wait_until(lambda: metrics_of(eight).get(("balance_moves_total", "A", "B")) == 2)
            wait_until(lambda: metrics_of(eight)["balance_share", "A"] == 0.75)
            metrics = metrics_of(eight)
            assert metrics["balance_share", "B"] == 0.25
            assert metrics["balance_demand", "A"] > metrics["balance_demand", "B"] == 0
            assert metrics["balance_backlog", "A"] > metrics["balance_backlog", "B"] == 0
            assert metrics["balance_wait_seconds", "B"] == 0
            wait_until(lambda: metrics_of(eight)["balance_wait_seconds", "A"] > 0)
        assert len(group.stats().moves) == 2
    assert not any(name.startswith("balance") for name, *_ in metrics_of(eight))


def process_cluster(count):
    options = {"nthreads": 1, "host": "127.0.0.1", "dashboard": False, "silence_logs": QUIET}
    scheduler = {"host": "127.0.0.1", "dashboard_address": "127.0.0.1:0", "dashboard": False}
    return FixedCluster(
        workers={name: {"cls": Nanny, "options": options} for name in range(count)},
        scheduler={"cls": Scheduler, "options": scheduler},
        silence_logs=QUIET,
    )


def slow_twice(item):
    time.sleep(0.1)
    return 2 * item


def add_one(item):
    time.sleep(0.02)
    return item + 1


@pytest.mark.extended
def test_workers_that_may_still_return_are_replaced_meanwhile(patient, quickly, wait_until):
    with process_cluster(3) as cluster, Client(cluster) as client:
        client.wait_for_workers(3, timeout=LONG_S)
        a, b = parts = divide(client, A=2, B=1)
        with balance(client, parts) as group:
            leave(client, int(b.workers[0].name))  # its nanny could start it again
            assert b.submit(worker_name).result(LONG_S)
            wait_until(lambda: sizes(parts) == [1, 1])
            assert [move.source for move in group.stats().moves] == ["A"]
        assert a.submit(worker_name).result(LONG_S)


@pytest.mark.extended
def test_killed_workers_return_and_each_result_is_there_once(patient, quickly, wait_until):
    with process_cluster(4) as cluster, Client(cluster) as client:
        client.wait_for_workers(4, timeout=LONG_S)
        first, second = parts = divide(client, FIRST=2, SECOND=2)
        with balance(client, parts) as group:
            results = second.map(add_one, first.map(slow_twice, range(200), chunk=1), chunk=1)
            outcome = []
            reader = threading.Thread(target=lambda: outcome.extend(results))
            reader.start()
            wait_until(lambda: sizes(parts) == [3, 1])
            for name in "02":
                pids = client.run(os.getpid, workers=[addresses(client)[name]])
                os.kill(next(iter(pids.values())), signal.SIGKILL)
                client.wait_for_workers(4, timeout=LONG_S)
            reader.join(LONG_S)
            assert group.stats().moves
        assert outcome == [2 * item + 1 for item in range(200)]
        wait_until(lambda: sum(sizes(parts)) == 4)
        assert first.submit(worker_name).result() in {w.name for w in first.workers}

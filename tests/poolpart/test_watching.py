"""Tasks do not wait behind others while a slot is free, and end if they take too long."""

import ctypes
import os
import signal
import time

import pytest
from distributed import Client, Event, get_worker
from distributed.core import Status
from tests.poolpart.helpers import LONG_S, set_status, wait_for, worker_name

from poolpart import Partition, Pool, TaskTimeoutError, cancelled
from poolpart.extras import watching


@pytest.fixture
def event(request):
    """Return a function that makes an event with a new name."""
    return lambda client: Event(f"watching-{os.urandom(4).hex()}", client)


def set_and_wait(started, release):
    Event(started).set()
    wait_for(release)
    return worker_name()


@pytest.mark.parametrize("why", ["long", "paused", "canceled"])
def test_tasks_do_not_wait_while_another_slot_is_free(start, event, wait_until, why):
    """In plain Dask, they wait for a canceled task, and the scheduler miscounts moved tasks."""
    client = start({"x": {"resources": {"A": 1}}, "y": {"resources": {"A": 1}}})
    scheduler = client.cluster.scheduler
    part = Partition("A", client)
    started, release, gate = event(client), event(client), event(client)
    release.set()  # so that tasks are expected to be short, and are assigned in advance
    client.gather([part.submit(set_and_wait, started.name, release.name) for _ in range(20)])
    release.clear()
    started.clear()
    long = part.submit(set_and_wait, started.name, release.name, workers="x")
    other = part.submit(wait_for, gate.name, workers="y")
    assert started.wait(LONG_S)
    waiting = [part.submit(worker_name) for _ in range(6)]
    x = scheduler.workers[client.cluster.workers["x"].address]
    wait_until(lambda: any(task.key in {f.key for f in waiting} for task in x.processing))
    if why == "paused":
        set_status(client, "x", Status.paused)
    if why == "canceled":
        long.cancel()
    gate.set()
    assert client.gather(waiting) == ["y"] * 6
    if why == "canceled":  # the scheduler assumes that both workers are free
        assert client.gather([part.submit(worker_name) for _ in range(4)]) == ["y"] * 4
    set_status(client, "x", Status.running)
    release.set()
    assert other.result(LONG_S)
    assert why == "canceled" or long.result(LONG_S) == "x"
    wait_until(lambda: all(w.used_resources["A"] == 0 for w in scheduler.workers.values()))


@pytest.mark.parametrize("why", ["early", "bound"])
def test_a_task_stays_on_its_worker_while_another_slot_is_free(
    start, event, wait_until, monkeypatch, why
):
    monkeypatch.setattr(watching, "WATCH_S", 0.05)
    monkeypatch.setattr(watching, "LATE_S", 3600.0 if why == "early" else 0.0)
    client = start({"x": {"resources": {"A": 1}}, "y": {"resources": {"A": 1}}})
    scheduler = client.cluster.scheduler
    client.sync(scheduler.extensions["stealing"].stop)
    part = Partition("A", client)
    gates = {name: event(client) for name in "xy"}
    running = [part.submit(wait_for, gate.name, workers=name) for name, gate in gates.items()]
    names = {client.cluster.workers[name].address: name for name in "xy"}
    wait_until(lambda: all(scheduler.workers[address].executing for address in names))
    # A worker with a bound task has room for another task.
    options = {"workers": "x"} if why == "bound" else {}
    waiting = part.submit(worker_name, key="waiting", **options)
    wait_until(lambda: "waiting" in scheduler.tasks and scheduler.tasks["waiting"].processing_on)
    home = names[scheduler.tasks["waiting"].processing_on.address]
    gates["y" if home == "x" else "x"].set()
    time.sleep(0.3)  # several checks
    assert not waiting.done()
    gates[home].set()
    assert waiting.result(LONG_S) == home
    assert all(client.gather(running))


def until_cancelled(name):
    while not cancelled():
        time.sleep(0.01)
    Event(name).set()


def sleep_if_odd(number):
    time.sleep(number % 2 * 3600)
    return number


def stop_worker(path):
    """Make the worker unresponsive, as if the function held the interpreter lock."""
    with path.open("a") as file:
        file.write("stopped\n")
    os.kill(os.getpid(), signal.SIGSTOP)


def test_a_task_that_takes_too_long_fails(client, b, event):
    ended = event(client)
    future = b.submit(until_cancelled, ended.name, timeout_s=0.3)
    waits = b.submit(abs, -1, timeout_s=0.3)  # the time before it starts does not count
    with pytest.raises(TaskTimeoutError) as caught:
        future.result(LONG_S)
    message = str(caught.value)
    assert message.startswith(f"Task '{future.key}' ran for ")
    assert message.endswith("s on worker B-0. Its limit is 0.3 s (`timeout_s`).")
    assert ended.wait(LONG_S)
    assert waits.result(LONG_S) == 1
    with pytest.raises(TaskTimeoutError) as caught:
        b.for_each([ended.name], until_cancelled, timeout_s=0.3)
    assert caught.value.__notes__[0].startswith("poolpart: The error occurred for item 0 of the it")
    with pytest.raises(TaskTimeoutError) as caught:
        list(b.map(until_cancelled, [ended.name], timeout_s=0.3))
    assert caught.value.__notes__[0].startswith("poolpart: The error occurred for item 0 of a map")


def test_a_question_to_a_worker_ends_only_late_tasks(client, a, event, wait_until):
    """The scheduler asks a worker if a task may be late according to its last heartbeat."""
    ended, gate = event(client), event(client)
    late = a.submit(until_cancelled, ended.name, timeout_s=1.0, workers="A-0")
    other = a.submit(wait_for, gate.name, timeout_s=3600, workers="A-0")
    worker = client.cluster.workers["A-0"]
    state = client.cluster.scheduler.workers[worker.address]
    wait_until(lambda: len(state.executing) == 2)
    heartbeat = worker.periodic_callbacks["heartbeat"]
    client.sync(_call, heartbeat.stop)
    with pytest.raises(TaskTimeoutError):
        late.result(LONG_S)
    client.sync(_call, heartbeat.start)
    gate.set()
    assert other.result(LONG_S)


async def _call(function):
    function()


@pytest.mark.parametrize("limit", [0, -1, True, "3", float("nan")])
def test_limits_that_mean_nothing_are_refused(b, limit):
    for method, arguments in (("submit", ()), ("map", ([],)), ("for_each", ([],))):
        function_and_items = (*arguments, abs) if method == "for_each" else (abs, *arguments)
        with pytest.raises(ValueError, match="Expected a positive number of seconds"):
            getattr(b, method)(*function_and_items, timeout_s=limit)


def test_a_limit_per_item_and_chunks_are_refused(b):
    with pytest.raises(ValueError, match="`chunk=2` cannot be combined with `timeout_s`"):
        b.map(abs, [], chunk=2, timeout_s=1)


def test_a_worker_that_does_not_return_is_restarted(nannies, monkeypatch):
    monkeypatch.setattr("poolpart.extras.watching.ANSWER_S", 0.3)
    both, _ = Pool.from_client(nannies).partition("P", n_workers=2, slots=1)
    results = [*both.map(sleep_if_odd, range(4), timeout_s=0.5, return_exceptions=True)]
    assert [type(result) for result in results] == [int, TaskTimeoutError, int, TaskTimeoutError]
    assert results[1].__notes__ == ["poolpart: The error occurred for item 1 of a map: 1"]
    assert both.submit(abs, -2).result(LONG_S) == 2


@pytest.mark.extended
def test_a_task_that_blocks_its_worker_fails_as_well(nannies, monkeypatch, tmp_path):
    monkeypatch.setattr("poolpart.extras.watching.ANSWER_S", 0.3)
    monkeypatch.setattr("poolpart.extras.watching.SILENT_S", 3.0)
    monkeypatch.setattr("poolpart.extras.cancelling.ANSWER_S", 1.0)
    both, _ = Pool.from_client(nannies).partition("P", n_workers=2, slots=1)
    with pytest.raises(TaskTimeoutError):
        both.submit(stop_worker, tmp_path / "stopped", timeout_s=0.5).result(LONG_S)
    # It runs again if no heartbeat has reported it, and then it is known to be the cause. A busy
    # machine may need one more attempt.
    assert len((tmp_path / "stopped").read_text().split()) <= watching.MOST_BLOCKED
    assert nannies.gather([both.submit(abs, -number) for number in range(9)]) == [*range(9)]


def start_and_hang(path):
    path.touch()
    time.sleep(3600)


@pytest.mark.parametrize(
    "block", [start_and_hang, pytest.param(stop_worker, marks=pytest.mark.extended)]
)
def test_a_worker_is_freed_if_the_client_of_a_hung_task_leaves(
    nannies, wait_until, monkeypatch, tmp_path, block
):
    monkeypatch.setattr("poolpart.extras.cancelling.ANSWER_S", 1.0)
    one, _ = Pool.from_client(nannies).partition("P", n_workers=1, slots=1)
    path = tmp_path / "started"
    with Client(nannies.scheduler.address) as other:
        task = Partition("P", other).submit(block, path, timeout_s=1.0)
        wait_until(path.exists)
        assert not task.done()
    assert one.submit(abs, -1).result(LONG_S) == 1


def hang_on(name):
    if str(get_worker().name) == name:
        time.sleep(3600)
    return str(get_worker().name)


def test_with_retries_it_runs_on_another_worker(nannies, monkeypatch):
    monkeypatch.setattr("poolpart.extras.watching.ANSWER_S", 0.3)
    both, _ = Pool.from_client(nannies).partition("P", n_workers=2, slots=1)
    futures = [both.submit(hang_on, "1", timeout_s=0.5, retries=1) for _ in range(4)]
    assert nannies.gather(futures) == ["0"] * 4


def hold_interpreter(path):
    """Hold the interpreter lock until the process is killed."""
    with path.open("a") as file:
        file.write("held\n")
    ctypes.PyDLL(None).sleep(3600)


def sleep_for(seconds):
    time.sleep(seconds)
    return seconds


@pytest.mark.extended
def test_only_the_task_that_blocks_its_worker_fails(nannies, monkeypatch, tmp_path):
    """The scheduler cannot know which task holds the interpreter lock, so all of them run again."""
    monkeypatch.setattr("poolpart.extras.watching.ANSWER_S", 1.0)
    monkeypatch.setattr("poolpart.extras.watching.SILENT_S", 3.0)
    monkeypatch.setattr("poolpart.extras.cancelling.ANSWER_S", 1.0)
    both, _ = Pool.from_client(nannies).partition("P", n_workers=2, slots=2)
    limit = {"timeout_s": 1.0}
    others = [both.submit(sleep_for, 0.8, **limit) for _ in range(3)]
    blocker = both.submit(hold_interpreter, tmp_path / "held", **limit)
    others += [both.submit(sleep_for, 0.8, **limit) for _ in range(3)]
    with pytest.raises(TaskTimeoutError):
        blocker.result(LONG_S)
    assert nannies.gather(others) == [0.8] * 6
    assert len((tmp_path / "held").read_text().split()) <= 4


def delay_report_once(path):
    """Keep this worker from reporting that the task has finished, unless it runs again."""
    if not path.exists():
        path.touch()
        get_worker().batched_stream.next_deadline = time.time() + 3600


@pytest.mark.extended
def test_a_task_behind_others_fails_if_it_blocks_its_worker(nannies, monkeypatch, tmp_path):
    """The worker cannot report that the tasks before it have finished, which have no limit."""
    monkeypatch.setattr("poolpart.extras.watching.ANSWER_S", 1.0)
    monkeypatch.setattr("poolpart.extras.watching.SILENT_S", 3.0)
    monkeypatch.setattr("poolpart.extras.cancelling.ANSWER_S", 1.0)
    both, _ = Pool.from_client(nannies).partition("P", n_workers=1, slots=1)
    finished = tmp_path / "finished"
    finished.touch()  # so that tasks are expected to be short, and are assigned in advance
    nannies.gather([both.submit(delay_report_once, finished) for _ in range(5)])
    first = both.submit(delay_report_once, tmp_path / "first")
    blocker = both.submit(hold_interpreter, tmp_path / "held", timeout_s=1.0)
    with pytest.raises(TaskTimeoutError):
        blocker.result(LONG_S)
    first.result(LONG_S)
    assert len((tmp_path / "held").read_text().split()) == 2


@pytest.mark.extended
def test_results_of_a_blocked_worker_are_computed_again(nannies, monkeypatch, tmp_path):
    monkeypatch.setattr("poolpart.extras.watching.ANSWER_S", 1.0)
    monkeypatch.setattr("poolpart.extras.watching.SILENT_S", 3.0)
    monkeypatch.setattr("poolpart.extras.cancelling.ANSWER_S", 1.0)
    one, _ = Pool.from_client(nannies).partition("P", n_workers=1, slots=1)
    held = one.submit(os.getpid)
    pid = held.result(LONG_S)
    with pytest.raises(TaskTimeoutError):
        one.submit(hold_interpreter, tmp_path / "held", timeout_s=1.0).result(LONG_S)
    assert one.submit(abs, held).result(LONG_S) != pid


def process():
    return os.getpid(), get_worker().address


def set_own_status(status, dask_worker):
    dask_worker.status = status


@pytest.mark.extended
@pytest.mark.parametrize("resumes", [True, False])
def test_a_paused_worker_whose_task_does_not_return_is_restarted(nannies, monkeypatch, resumes):
    monkeypatch.setattr("poolpart.extras.watching.ANSWER_S", 0.3)
    monkeypatch.setattr("poolpart.extras.watching.RETRY_S", 0.5)
    one, _ = Pool.from_client(nannies).partition("P", n_workers=1, slots=1)
    pid, address = one.submit(process).result(LONG_S)
    hung = one.submit(sleep_for, 3600, timeout_s=1.0)
    while one.stats().running < 1:
        time.sleep(0.01)
    nannies.run(set_own_status, Status.paused, workers=[address])
    with pytest.raises(TaskTimeoutError):
        hung.result(LONG_S)
    if resumes:
        nannies.run(set_own_status, Status.running, workers=[address])
    assert one.submit(process).result(LONG_S)[0] != pid


@pytest.mark.extended
def test_a_worker_with_two_tasks_that_do_not_return_is_restarted(nannies, monkeypatch):
    monkeypatch.setattr("poolpart.extras.watching.ANSWER_S", 0.3)
    one, _ = Pool.from_client(nannies).partition("P", n_workers=1, slots=2)
    pid = one.submit(os.getpid).result(LONG_S)
    hung = [one.submit(sleep_for, 3600, timeout_s=limit_s) for limit_s in (0.5, 1.5)]
    for task in hung:
        with pytest.raises(TaskTimeoutError):
            task.result(LONG_S)
    assert one.submit(os.getpid).result(LONG_S) != pid

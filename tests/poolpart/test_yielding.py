"""Adaptive partitions that make room for jobs of other users.

The queue is a stand-in, and its jobs are workers of this process. `test_slurm.py` has a real one.
"""

import itertools
import json
import logging
import math
import re
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from random import Random
from typing import Any

import pytest
from distributed import Client, Event, secede, wait
from tests.clusters import import_jobqueue
from tests.poolpart.helpers import LONG_S, wait_for, worker_name
from tests.poolpart.job_queue import SCHEDULER

from poolpart import Partition, PoolError
from poolpart.deploy import start_partitions
from poolpart.deploy.waiting_jobs import (
    QueueReport,
    QueueWatch,
    SlurmCounter,
    count_slurm_jobs,
    watch_queues,
)
from poolpart.extras.dashboard_page import render_page
from poolpart.partition_stats import SharedQueue

NEVER_S = 3600.0  # longer than a test


@pytest.fixture(autouse=True)
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    """List the queue often, and end idle jobs soon while others wait."""
    monkeypatch.setattr("poolpart.deploy.waiting_jobs.LIST_EVERY_S", 0.05)
    monkeypatch.setattr("poolpart.adapting.YIELD_IDLE_S", 0.1)


@contextmanager
def cluster_of(
    others: Callable[[], int], minimum: int, maximum: int, **options: Any
) -> Iterator[Client]:
    """Client of a cluster with a partition that yields to other users."""
    report = {"report": options.pop("report")} if "report" in options else {}
    partition = {
        "adapt": [minimum, maximum], "idle_s": NEVER_S, "yield_to_others": others, **options
    }  # fmt: skip
    with import_jobqueue().SLURMCluster(
        cores=2, processes=1, memory="2GB", scheduler_options=SCHEDULER
    ) as cluster:
        start_partitions(cluster, {"GPU": partition}, **report)
        with Client(cluster) as client:
            yield client


def begin_and_wait(event):
    Event(f"{event}-{worker_name()}").set()
    return wait_for(event)


@pytest.mark.extended
def test_a_job_ends_after_its_task_and_is_replaced_when_no_other_waits(queue, wait_until):
    waiting = [0]

    def others() -> int:
        return waiting[0] if len(queue.workers) == 3 else 0

    with cluster_of(others, 0, 3) as client:
        gpu = Partition("GPU", client)
        tasks = [gpu.submit(begin_and_wait, f"go-{n}") for n in range(9)]
        wait_until(lambda: len(gpu) == 3)
        workers = client.cluster.scheduler.workers
        wait_until(lambda: all(worker.processing for worker in workers.values()))
        waiting[0] = 1
        wait_until(lambda: {w.status.name for w in workers.values()} > {"running"})
        [leaving] = [w for w in workers.values() if w.status.name != "running"]
        wait_until(lambda: len(leaving.processing) == 1)  # those that wait have been handed over
        [running] = leaving.processing
        assert len(queue.submitted) == 3  # none beside those that run
        number = [task.key for task in tasks].index(running.key)
        Event(f"go-{number}", client).set()
        # The job that ends makes room. Nobody waits then, and there still is work.
        wait_until(lambda: len(queue.submitted) == 4 and len(gpu) == 3)
        assert leaving.name not in {w.name for w in gpu.workers}
        for n in range(9):
            Event(f"go-{n}", client).set()
        assert client.gather(tasks) == [True] * 9


def test_one_job_is_left_while_there_is_work_and_none_after_it(queue, wait_until):
    with cluster_of(lambda: 5 * bool(queue.submitted), 0, 3) as client:
        gpu = Partition("GPU", client)
        queue.held = True
        tasks = [gpu.submit(worker_name) for _ in range(20)]
        wait_until(lambda: len(queue.cancelled) == 2)
        time.sleep(0.3)
        assert sorted(queue.submitted) == ["GPU-0", "GPU-1", "GPU-2"]
        client.sync(queue.release)
        assert client.gather(tasks) == ["GPU-0"] * 20
        del tasks
        wait_until(lambda: not queue.workers)  # long before `idle_s`
        assert len(gpu) == 0


@pytest.mark.extended
def test_the_minimum_is_kept(queue, wait_until):
    with cluster_of(lambda: 9, 2, 4) as client:
        gpu = Partition("GPU", client)
        wait_until(lambda: len(gpu) == 2)
        tasks = [gpu.submit(wait_for, "go") for _ in range(8)]
        time.sleep(0.5)
        assert sorted(queue.submitted) == ["GPU-0", "GPU-1"]
        Event("go", client).set()
        assert client.gather(tasks) == [True] * 8
        del tasks
        time.sleep(0.5)
        assert len(gpu) == 2


ran: list[int] = []


def add(x, y):
    return x + y


def note(number):
    time.sleep(0.01)
    ran.append(number)
    return number


@pytest.mark.extended
def test_no_task_of_a_map_is_lost_or_run_twice(queue):
    """Jobs come and go all the time, because others wait whenever there are two jobs."""
    ran.clear()
    with cluster_of(lambda: int(len(queue.workers) > 1), 0, 3) as client:
        results = Partition("GPU", client).map(note, range(150), chunk=1)
        assert list(results) == [*range(150)]
    assert sorted(ran) == [*range(150)]
    assert len(queue.submitted) > 4


@pytest.mark.slow
def test_no_task_or_result_is_lost_while_other_users_come_and_go(queue):
    """The client keeps all results on the workers, some of which are inputs of later tasks."""
    ran.clear()
    random = Random(7)
    with cluster_of(lambda: random.randint(0, 3), 1, 4) as client:
        gpu = Partition("GPU", client)
        first: list[Any] = []
        for number in range(600):
            first.append(gpu.submit(note, number))
            if number % 50 == 0:
                time.sleep(0.2)
        second = [gpu.submit(add, *pair) for pair in itertools.pairwise(first)]
        assert client.gather(second) == [2 * number + 1 for number in range(599)]
        assert client.gather(first) == [*range(600)]
    assert sorted(ran) == [*range(600)]
    assert len(queue.submitted) > 10


def secedes(event):
    secede()
    return wait_for(event)


class Unpicklable:
    """A result that cannot be copied to another worker."""

    def __reduce__(self):
        raise TypeError("cannot be pickled")


@pytest.mark.extended
def test_results_are_copied_and_seceded_tasks_are_not_interrupted(queue, wait_until):
    waiting = [0]
    with cluster_of(lambda: waiting[0], 0, 3) as client:
        gpu = Partition("GPU", client)
        gpu.adapt(3, 3, idle_s=NEVER_S)
        wait_until(lambda: len(gpu) == 3)
        long = gpu.submit(secedes, "go", workers="GPU-0")
        kept = gpu.submit(worker_name, workers="GPU-1")
        wait([kept])
        gpu.adapt(0, 3, idle_s=NEVER_S)
        waiting[0] = 3
        wait_until(lambda: [worker.name for worker in gpu.workers] == ["GPU-0"])
        assert kept.result(LONG_S) == "GPU-1"
        time.sleep(0.3)
        assert len(gpu) == 1
        Event("go", client).set()
        assert long.result(LONG_S)
        assert sorted(queue.submitted) == ["GPU-0", "GPU-1", "GPU-2"]


def test_canceling_a_queued_job_releases_no_node(queue, wait_until, monkeypatch):
    waiting = [0]

    def others() -> int:
        if waiting[0]:  # the queue is not listed again
            monkeypatch.setattr("poolpart.deploy.waiting_jobs.LIST_EVERY_S", NEVER_S)
        return waiting[0]

    with cluster_of(others, 0, 2) as client:
        gpu = Partition("GPU", client)
        tasks = [gpu.submit(wait_for, "go") for _ in range(8)]
        workers = client.cluster.scheduler.workers
        wait_until(lambda: [bool(w.processing) for w in workers.values()] == [True, True])
        queue.held = True
        gpu.adapt(0, 3, idle_s=NEVER_S)
        wait_until(lambda: len(queue.submitted) == 3)
        waiting[0] = 1
        wait_until(lambda: queue.cancelled == ["GPU-2"])
        time.sleep(0.3)
        assert {w.status.name for w in workers.values()} == {"running", "closing_gracefully"}
        Event("go", client).set()
        assert client.gather(tasks) == [True] * 8


def secedes_after(event, end):
    wait_for(event)
    secede()
    return wait_for(end)


@pytest.mark.extended
def test_a_job_whose_task_secedes_is_not_drained_any_longer(queue, wait_until):
    waiting = [0]
    with cluster_of(lambda: waiting[0], 0, 2) as client:
        gpu = Partition("GPU", client)
        gpu.adapt(2, 2, idle_s=NEVER_S)
        wait_until(lambda: len(gpu) == 2)
        tasks = [
            gpu.submit(secedes_after, "secede", "go", workers=f"GPU-{number}")
            for number in range(2)
        ]
        workers = client.cluster.scheduler.workers
        wait_until(lambda: all(worker.processing for worker in workers.values()))
        gpu.adapt(0, 2, idle_s=NEVER_S)
        waiting[0] = 1
        wait_until(lambda: "closing_gracefully" in {w.status.name for w in workers.values()})
        Event("secede", client).set()
        wait_until(lambda: {w.status.name for w in workers.values()} == {"running"})
        Event("go", client).set()
        assert client.gather(tasks) == [True] * 2


@pytest.mark.extended
def test_a_job_stays_whose_results_cannot_be_copied(queue, wait_until, monkeypatch):
    monkeypatch.setattr("poolpart.draining.COPY_TIMEOUT_S", 0.1)
    waiting = [0]
    with cluster_of(lambda: waiting[0], 0, 2) as client:
        gpu = Partition("GPU", client)
        gpu.adapt(2, 2, idle_s=NEVER_S)
        wait_until(lambda: len(gpu) == 2)
        kept = [gpu.submit(Unpicklable, workers=f"GPU-{n}") for n in range(2)]
        wait(kept)
        gpu.adapt(0, 2, idle_s=NEVER_S)
        waiting[0] = 1
        time.sleep(1)
        # Neither has ended, and both receive tasks again.
        for name in ("GPU-0", "GPU-1"):
            assert gpu.submit(worker_name, workers=name).result(LONG_S) == name
        assert sorted(queue.submitted) == ["GPU-0", "GPU-1"]


def test_a_queue_that_cannot_be_listed_is_reported_and_jobs_stay(queue, wait_until, caplog):
    caplog.set_level(logging.INFO, "poolpart.deploy.waiting_jobs")
    said: list[str] = []
    broken = threading.Event()
    broken.set()

    def fails() -> int:
        if broken.is_set():
            raise OSError("qstat: no server")
        return 1

    with cluster_of(fails, 0, 2, report=said.append) as client:
        caplog.handler.setLevel(logging.INFO)  # the cluster has silenced it
        gpu = Partition("GPU", client)
        tasks = [gpu.submit(wait_for, "go") for _ in range(4)]
        wait_until(lambda: len(gpu) == 2 and said)
        time.sleep(0.3)
        assert said == [
            "No jobs of partition 'GPU' are released for other users, because the queue cannot be "
            "listed. OSError: qstat: no server"
        ]
        assert len(gpu) == 2
        stats = gpu.stats()
        assert stats.queue == SharedQueue(None, 0, "OSError: qstat: no server")
        page = client.run_on_scheduler(lambda dask_scheduler: render_page(dask_scheduler)).decode()
        for shown in (repr(stats), stats._repr_html_(), page):
            assert "cannot be listed: OSError: qstat: no server" in shown
        broken.clear()
        wait_until(lambda: gpu.stats().queue == SharedQueue(1, 1))
        assert "1 waiting job of other users" in repr(gpu.stats())
        assert "The queue of partition 'GPU' can be listed again." in caplog.text
        assert len(said) == 1
        Event("go", client).set()
        assert client.gather(tasks) == [True] * 4


@pytest.mark.extended
def test_after_a_failed_listing_no_jobs_end_and_for_some_time_none_start(
    queue, wait_until, monkeypatch
):
    results: list[Any] = [2]

    def others() -> int:
        if isinstance(results[0], Exception):
            raise results[0]
        return results[0]

    with cluster_of(others, 2, 4) as client:
        gpu = Partition("GPU", client)
        wait_until(lambda: gpu.stats().queue == SharedQueue(2))
        results[0] = TimeoutError()
        wait_until(lambda: gpu.stats().queue == SharedQueue(None, 0, "TimeoutError: "))
        tasks = [gpu.submit(wait_for, "go") for _ in range(16)]
        time.sleep(0.3)
        assert sorted(queue.submitted) == ["GPU-0", "GPU-1"]
        monkeypatch.setattr("poolpart.deploy.waiting_jobs.HOLD_S", 0.0)
        wait_until(lambda: len(gpu) == 4)
        Event("go", client).set()
        assert client.gather(tasks) == [True] * 16


@pytest.mark.extended
def test_a_function_that_hangs_stalls_nothing(queue, wait_until, monkeypatch):
    monkeypatch.setattr("poolpart.deploy.waiting_jobs.LISTING_S", 0.3)
    said: list[str] = []
    calls: list[float] = []
    released = threading.Event()

    def hangs() -> int:
        calls.append(time.monotonic())
        released.wait(LONG_S)
        return 0

    with cluster_of(hangs, 0, 2, report=said.append) as client:
        gpu = Partition("GPU", client)
        assert gpu.submit(worker_name).result(LONG_S) == "GPU-0"
        wait_until(lambda: said)
        assert said[0].endswith("cannot be listed. The listing has not ended after 0.3 s.")
        tasks = [gpu.submit(wait_for, "go") for _ in range(4)]
        wait_until(lambda: len(gpu) == 2)  # the partition still follows its work
        assert len(calls) == 1
        assert gpu.stats().queue.waiting is None
        released.set()
        wait_until(lambda: gpu.stats().queue == SharedQueue(0))
        assert len(said) == 1
        Event("go", client).set()
        assert client.gather(tasks) == [True] * 4
        released.clear()
        known = len(calls)
        wait_until(lambda: len(calls) > known)
    # The cluster has been closed although the function has not returned.
    assert not released.is_set()
    released.set()


@pytest.mark.parametrize("result", [-1, 1.0, math.nan, True, None, "3", [1, 2]])
def test_results_that_are_not_a_number_of_jobs_are_refused(result, wait_until):
    watch = QueueWatch(lambda: result, ["GPU"])
    watch.refresh(has_jobs=True)
    wait_until(lambda: watch.refresh(has_jobs=True) or watch.problem)
    assert watch.problem == (
        "The function for `yield_to_others` must return a number of jobs, but it returned "
        f"{result!r}."
    )
    assert watch.report() == QueueReport(("GPU",), None, None, watch.problem)


@pytest.mark.parametrize("error", [SystemExit(1), KeyboardInterrupt(), ValueError("bad")])
def test_errors_of_any_kind_are_problems(error, wait_until):
    def fails() -> int:
        raise error

    watch = QueueWatch(fails, ["GPU", "IO"])
    watch.refresh(has_jobs=True)
    wait_until(lambda: watch.refresh(has_jobs=True) or watch.problem)
    assert watch.problem == f"{type(error).__name__}: {error}"
    assert watch.names == "partitions 'GPU' and 'IO'"


def test_numbers_of_numpy_are_numbers_of_jobs(wait_until):
    np = pytest.importorskip("numpy")
    watch = QueueWatch(lambda: np.int64(3), ["GPU"])
    assert watch.report() == QueueReport(("GPU",), None, 0)
    watch.refresh(has_jobs=True)
    wait_until(lambda: watch.refresh(has_jobs=True) or watch.report().waiting)
    assert watch.report() == QueueReport(("GPU",), 3, 3)
    watch.count_released(1)
    assert watch.report() == QueueReport(("GPU",), 2, 3)


def test_a_released_node_counts_until_the_listing_after_the_next(wait_until, monkeypatch):
    """The queue needs some time to assign the node to the waiting job."""
    listed = itertools.count()
    waiting = iter([1, 1, 1])

    def others() -> int:
        next(listed)
        return next(waiting)

    def list_again() -> QueueReport:
        before = watch.report()
        monkeypatch.setattr("poolpart.deploy.waiting_jobs.LIST_EVERY_S", 0.0)
        watch.refresh(has_jobs=True)
        monkeypatch.setattr("poolpart.deploy.waiting_jobs.LIST_EVERY_S", NEVER_S)
        wait_until(lambda: watch.refresh(has_jobs=True) or watch._listing is None)
        assert watch.report() != before or before.waiting == 1
        return watch.report()

    watch = QueueWatch(others, ["GPU"])
    assert list_again().to_release == 1
    watch.count_released(1)
    assert watch.report().to_release == 0
    assert list_again().to_release == 0
    assert list_again().to_release == 1


@contextmanager
def two_partitions(gpu_others: Any, io_others: Any) -> Iterator[tuple[Client, list[Partition]]]:
    """Client and partitions GPU and IO, each with two busy jobs, on a cluster of jobs."""
    options = {"adapt": [0, 2], "idle_s": NEVER_S}
    with import_jobqueue().SLURMCluster(
        cores=2, processes=1, memory="2GB", scheduler_options=SCHEDULER
    ) as cluster:
        start_partitions(
            cluster,
            {
                "GPU": options | {"yield_to_others": gpu_others},
                "IO": options | {"yield_to_others": io_others},
            },
        )
        with Client(cluster) as client:
            yield client, [Partition("GPU", client), Partition("IO", client)]


@pytest.mark.extended
def test_one_waiting_job_costs_one_worker_of_all_partitions_in_the_queue(queue, wait_until):
    waiting = [0]

    def others() -> int:
        return waiting[0]

    with two_partitions(others, others) as (client, parts):
        tasks = [part.submit(wait_for, "go") for part in parts for _ in range(8)]
        workers = client.cluster.scheduler.workers

        def releasing() -> list[int]:
            return [part.stats().queue.releasing for part in parts]

        wait_until(lambda: [len(part) for part in parts] == [2, 2])
        wait_until(lambda: all(worker.processing for worker in workers.values()))
        waiting[0] = 1
        wait_until(lambda: sum(releasing()) == 1)
        first = releasing()
        time.sleep(0.5)
        assert releasing() == first  # the same job, at each listing
        waiting[0] = 2
        wait_until(lambda: releasing() == [1, 1])  # they take turns
        waiting[0] = 7
        time.sleep(0.3)
        assert releasing() == [1, 1]  # one job of each partition remains
        waiting[0] = 0
        wait_until(lambda: releasing() == [0, 0])
        Event("go", client).set()
        assert client.gather(tasks) == [True] * 16


@pytest.mark.extended
def test_partitions_in_different_queues_release_jobs_for_each(queue, wait_until):
    with two_partitions(lambda: 1, lambda: 1) as (client, parts):
        tasks = [part.submit(wait_for, "go") for part in parts for _ in range(8)]
        for part in parts:
            part.adapt(2, 2, idle_s=NEVER_S)
        wait_until(lambda: [len(part) for part in parts] == [2, 2])
        workers = client.cluster.scheduler.workers
        wait_until(lambda: all(worker.processing for worker in workers.values()))
        for part in parts:
            part.adapt(0, 2, idle_s=NEVER_S)
        wait_until(lambda: [part.stats().queue.releasing for part in parts] == [1, 1])
        Event("go", client).set()
        assert client.gather(tasks) == [True] * 16


@pytest.mark.extended
def test_an_idle_job_is_released_before_a_busy_one(queue, wait_until, monkeypatch):
    monkeypatch.setattr("poolpart.adapting.YIELD_IDLE_S", NEVER_S)
    waiting = [0]

    def others() -> int:
        return waiting[0]

    with two_partitions(others, others) as (client, (gpu, io)):
        for part in (gpu, io):
            part.adapt(2, 2, idle_s=NEVER_S)
        wait_until(lambda: len(gpu) == len(io) == 2)
        tasks = [gpu.submit(wait_for, "go", workers=worker.name) for worker in gpu.workers]
        wait_until(lambda: gpu.stats().running == 2)
        for part in (gpu, io):
            part.adapt(0, 2, idle_s=NEVER_S)
        waiting[0] = 1
        wait_until(lambda: len(io) == 1)
        assert len(gpu) == 2
        assert gpu.stats().queue.releasing == 0
        Event("go", client).set()
        assert client.gather(tasks) == [True] * 2


async def counts_later() -> int:
    return 0


class Counts:
    async def __call__(self) -> int:
        return 0


WRONG = {
    "fixed": ({"yield_to_others": True}, "`yield_to_others`, which requires `adapt`"),
    "text": ({"adapt": [0, 1], "yield_to_others": "yes"}, "Invalid value 'yes'"),
    "number": ({"adapt": [0, 1], "yield_to_others": 1}, "Invalid value 1 for"),
    "coroutine": ({"adapt": [0, 1], "yield_to_others": counts_later}, "is a coroutine function"),
    "coroutine method": ({"adapt": [0, 1], "yield_to_others": Counts()}, "is a coroutine function"),
    "arguments": (
        {"adapt": [0, 1], "yield_to_others": lambda user: 0},
        "without required arguments, .* missing a required argument: 'user'",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_options_are_refused(queue, case):
    options, says = WRONG[case]
    with (
        import_jobqueue().SLURMCluster(
            cores=1, memory="1GB", scheduler_options=SCHEDULER
        ) as cluster,
        pytest.raises(PoolError, match=says),
    ):
        start_partitions(cluster, {"GPU": options})


def test_other_systems_need_a_function():
    with import_jobqueue().PBSCluster(
        cores=1, memory="1GB", scheduler_options=SCHEDULER
    ) as cluster:
        with pytest.raises(PoolError, match="cannot list the queue of a PBSCluster"):
            start_partitions(cluster, {"GPU": {"adapt": [0, 1], "yield_to_others": True}})
        start_partitions(cluster, {"GPU": {"adapt": [0, 1], "yield_to_others": lambda: 0}})


@pytest.fixture
def slurm_commands(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Stand-ins for the commands of Slurm; returns the file with the arguments of squeue."""
    asked = tmp_path / "asked"
    listing = "alice Resources\\nbob Priority\\nbob Dependency\\nme Resources\\ncarol None\\n"
    scripts = {
        "squeue": f"echo \"$@\" SQUEUE_USERS=$SQUEUE_USERS > {asked}; printf '{listing}'",
        "sinfo": "printf 'gpu\\nmain*\\nmain*\\n'",
    }
    for name, body in scripts.items():
        script = tmp_path / name
        script.write_text(f"#!/bin/sh\n{body}\n")
        script.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=":")
    monkeypatch.setenv("SQUEUE_USERS", "me")
    monkeypatch.setattr("getpass.getuser", lambda: "me")
    return asked


@pytest.mark.parametrize(("queue_name", "listed"), [("gpu,big", "gpu,big"), (None, "main")])
def test_slurm_jobs_that_wait_for_resources_count(slurm_commands, queue_name, listed):
    assert count_slurm_jobs(queue_name) == 2
    asked = slurm_commands.read_text().split()
    assert f"--partition={listed}" in asked
    assert "SQUEUE_USERS=" in asked  # it would hide the jobs of others


def test_a_failing_squeue_is_reported(slurm_commands):
    script = slurm_commands.with_name("squeue")
    script.write_text("#!/bin/sh\necho 'squeue: error: Invalid partition' >&2; exit 1\n")
    with pytest.raises(PoolError, match="squeue failed: squeue: error: Invalid partition"):
        count_slurm_jobs("nowhere")


def test_a_squeue_that_hangs_is_ended(slurm_commands, monkeypatch):
    monkeypatch.setattr("poolpart.deploy.waiting_jobs._COMMAND_S", 0.2)
    slurm_commands.with_name("squeue").write_text("#!/bin/sh\nexec sleep 60\n")
    with pytest.raises(PoolError, match=r"squeue failed: .* timed out after 0\.2 seconds"):
        count_slurm_jobs("gpu")


def test_partitions_in_the_same_slurm_queue_share_a_listing():
    counters = {"A": SlurmCounter("gpu"), "B": SlurmCounter(None), "C": SlurmCounter("gpu")}
    assert [watch.partitions for watch in watch_queues(counters)] == [("A", "C"), ("B",)]


def test_the_function_for_pbs_in_the_manual(tmp_path, monkeypatch):
    page = Path(__file__).parents[2] / "docs/pool-partitions/adapt.md"
    [code] = re.findall(r"```python\n(import getpass\n.*?)```", page.read_text("utf-8"), re.S)
    jobs = {
        "1.pbs": {"job_state": "Q", "Job_Owner": "alice@login"},
        "2.pbs": {"job_state": "R", "Job_Owner": "alice@login"},
        "3.pbs": {"job_state": "Q", "Job_Owner": "me@login"},
        "4.pbs": {"job_state": "H", "Job_Owner": "bob@login"},
        "5.pbs": {"job_state": "Q", "Job_Owner": "me2@login"},
    }
    (tmp_path / "jobs.json").write_text(json.dumps({"pbs_version": "2022", "Jobs": jobs}))
    qstat = tmp_path / "qstat"
    qstat.write_text(f"#!/bin/sh\ncat {tmp_path}/jobs.json\n")
    qstat.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=":")
    monkeypatch.setattr("getpass.getuser", lambda: "me")
    names: dict[str, Any] = {}
    exec(code, names)
    assert names["count_waiting_jobs"]() == 2


@pytest.mark.parametrize(
    ("options", "listed"),
    [
        ({"queue": "gpu"}, "gpu"),
        ({"job_extra_directives": ["--partition=big"]}, "big"),
        ({"queue": "gpu", "job_extra_directives": ["-p big"]}, "big"),
        ({}, "main"),
    ],
)
def test_the_queue_of_the_jobs_is_listed(queue, slurm_commands, wait_until, options, listed):
    with cluster_of(True, 0, 1, **options) as client:
        task = Partition("GPU", client).submit(worker_name)
        assert task.result(LONG_S) == "GPU-0"
        wait_until(slurm_commands.exists)
        wait_until(lambda: f"--partition={listed} " in slurm_commands.read_text())

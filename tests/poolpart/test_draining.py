"""Jobs that end when their running tasks have finished, on workers of this process."""

import pytest
from distributed import Event, Worker
from tests.poolpart.helpers import LONG_S, wait_for, worker_name

from poolpart import Partition
from poolpart.draining import DrainingJobs


class Jobs:
    """Jobs of a cluster, by the names of their workers, that are drained in its event loop."""

    def __init__(self, client, jobs):
        self.client = client
        self.scheduler = client.cluster.scheduler
        self.draining = DrainingJobs(self.scheduler, "A")
        self._jobs = jobs

    def states(self):
        states = {str(worker.name): worker for worker in self.scheduler.workers.values()}
        running = {
            job: [states[n] for n in names if n in states] for job, names in self._jobs.items()
        }
        return {job: workers for job, workers in running.items() if workers}

    def update(self, count):
        """Drain jobs; returns those that have finished."""

        async def call():
            return self.draining.update(self.states(), count)

        return list(self.client.sync(call))

    def closed(self):
        """Names of workers that receive no tasks."""
        return {w.name for w in self.scheduler.workers.values() if w.status.name != "running"}


@pytest.fixture
def client(start):
    names = ("a", "b", "c", "d")
    return start({name: {"resources": {"A": 1}} for name in names})


def test_the_job_with_the_fewest_tasks_is_drained_first(client, wait_until):
    part = Partition("A", client)
    jobs = Jobs(client, {"ab": ["a", "b"], "c": ["c"], "d": ["d"]})
    tasks = [part.submit(wait_for, "go", workers=name) for name in ("a", "c", "c")]
    wait_until(lambda: sum(len(w.processing) for w in jobs.scheduler.workers.values()) == 3)
    assert jobs.update(1) == ["d"]
    assert jobs.update(2) == ["d"]
    assert jobs.closed() == {"a", "b", "d"}
    assert {part.submit(worker_name).key for _ in range(3)}
    assert jobs.update(0) == []
    assert jobs.closed() == set()
    Event("go", client).set()
    client.gather(tasks)


def test_a_job_whose_worker_is_lost_is_no_longer_drained(client, wait_until):
    jobs = Jobs(client, {"ab": ["a", "b"], "c": ["c"]})
    task = Partition("A", client).submit(wait_for, "go", workers="a")
    busy = Partition("A", client).submit(wait_for, "go", workers="c")
    busier = Partition("A", client).submit(wait_for, "go", workers="c")
    wait_until(lambda: sum(len(w.processing) for w in jobs.scheduler.workers.values()) == 3)
    jobs.update(1)
    assert jobs.closed() == {"a", "b"}
    [lost] = [w for w in client.cluster.workers.values() if w.name == "b"]
    client.sync(lost.close)
    wait_until(lambda: len(jobs.states()["ab"]) == 1)
    jobs.update(0)
    assert jobs.closed() == set()
    Event("go", client).set()
    client.gather([task, busy, busier])


def test_a_worker_that_has_started_again_is_drained_again(client, wait_until):
    jobs = Jobs(client, {"a": ["a"], "b": ["b"]})
    part = Partition("A", client)
    tasks = [part.submit(wait_for, "go", workers="b") for _ in range(2)]
    wait_until(lambda: sum(len(w.processing) for w in jobs.scheduler.workers.values()) == 2)
    assert jobs.update(1) == ["a"]
    assert jobs.closed() == {"a"}
    [lost] = [w for w in client.cluster.workers.values() if w.name == "a"]
    client.sync(lost.close)
    wait_until(lambda: "a" not in jobs.states())

    async def join():
        options = {"resources": {"A": 1}, "nthreads": 1, "dashboard": False}
        return await Worker(jobs.scheduler.address, name="a", **options)

    worker = client.sync(join)
    assert jobs.update(1) == ["a"]
    assert jobs.closed() == {"a"}
    assert jobs.update(0) == []
    assert part.submit(worker_name, workers="a").result(LONG_S) == "a"
    client.sync(worker.close)
    Event("go", client).set()
    client.gather(tasks)

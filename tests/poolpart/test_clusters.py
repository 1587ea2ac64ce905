"""Partitions as jobs: what is submitted, and again when it is lost. The queue is made up.

`tests/system/test_queues.py` has a real one.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from distributed import Status
from tests.clusters import import_jobqueue, thread_cluster
from tests.daemons import wait_until

import poolpart.clusters
from poolpart import PoolError, start_partitions

SCHEDULER = {"host": "127.0.0.1", "port": 0, "dashboard": False, "dashboard_address": "127.0.0.1:0"}


class Queue:
    """What was submitted and cancelled: {name of the worker: scripts}, numbers."""

    def __init__(self) -> None:
        self.scripts: dict[str, list[str]] = {}
        self.cancelled: set[str] = set()
        self.refuses = ""
        self.refused = 0


@pytest.fixture
def queue(monkeypatch: pytest.MonkeyPatch) -> Queue:
    jobqueue = import_jobqueue()
    queue, numbers = Queue(), itertools.count()

    async def submit(job: object, path: str) -> str:
        text = Path(path).read_text()
        name = re.search(r"--name (\S+)", text)[1]
        if queue.refuses == name:
            queue.refused += 1
            raise RuntimeError("no such partition")
        queue.scripts.setdefault(name, []).append(text)
        return f"Submitted batch job {next(numbers)}"

    async def close(job: object, number: str, command: str) -> None:
        queue.cancelled.add(number)

    monkeypatch.setattr(jobqueue.slurm.SLURMJob, "_submit_job", submit)
    monkeypatch.setattr(jobqueue.slurm.SLURMJob, "_close_job", close)
    return queue


@pytest.fixture
def cluster(queue: Queue) -> Iterator[object]:
    with import_jobqueue().SLURMCluster(
        cores=2, processes=1, memory="2GB", worker_extra_args=["-x"], scheduler_options=SCHEDULER
    ) as cluster:
        yield cluster


def test_each_partition_has_jobs_of_its_own_which_go_with_the_cluster(cluster, queue):
    start_partitions(
        cluster,
        {
            "GPU": {"workers": 2, "job_extra_directives": ["--gres=gpu:1"], "queue": "gpus"},
            "IO": {"slots": 8, "cores": 4},
            "NODE": {"processes": 2},
            "NONE": {"workers": 0},
        },
    )
    assert queue.scripts.keys() == {"GPU-0", "GPU-1", "IO-0", "NODE-0"}
    (gpu,), (io,), (node,) = (queue.scripts[name] for name in ("GPU-0", "IO-0", "NODE-0"))
    assert "#SBATCH --gres=gpu:1" in gpu
    assert "#SBATCH -p gpus" in gpu
    assert "#SBATCH --cpus-per-task=2" in gpu
    assert gpu.rstrip().endswith("-x --resources GPU=1")
    assert "--gres" not in io
    assert "#SBATCH --cpus-per-task=4" in io
    assert io.rstrip().endswith("-x --resources IO=8")
    assert "--nworkers 2" in node
    assert cluster.plan == {"GPU-0", "GPU-1", "IO-0", "NODE-0-0", "NODE-0-1"}
    cluster.close()
    assert queue.cancelled == set("0123")


def test_a_job_that_was_lost_is_submitted_again(cluster, queue, monkeypatch):
    monkeypatch.setattr(poolpart.clusters, "_LOOK_EVERY_S", 0.01)
    start_partitions(cluster, {"GPU": {}, "IO": {}})
    queue.refuses = "GPU-0"  # for a while
    cluster.loop.add_callback(lambda: cluster.workers.pop("GPU-0"))  # as a SpecCluster does
    wait_until(lambda: queue.refused > 1)
    queue.refuses = ""
    wait_until(lambda: len(queue.scripts["GPU-0"]) == 2)
    cluster.close()
    assert len(queue.scripts["IO-0"]) == 1
    assert "2" in queue.cancelled
    assert cluster.status == Status.closed


def test_logs_tell_why_workers_are_missing(queue, tmp_path, monkeypatch):
    monkeypatch.setattr(poolpart.clusters, "_LOOK_EVERY_S", 0.01)
    said: list[str] = []
    (tmp_path / "old.err").write_text("an older job failed\n")
    logs = {"log_directory": str(tmp_path), "scheduler_options": SCHEDULER}
    with import_jobqueue().SLURMCluster(cores=2, memory="2GB", **logs) as cluster:
        start_partitions(cluster, {"GPU": {"workers": 2}}, said.append)
        (tmp_path / "up.err").write_text("2026-01-01 - distributed.nanny - INFO - Start Nanny\n")
        (tmp_path / "gpu-1.err").write_text("Traceback:\nno such file: job 1\n\n")
        wait_until(lambda: len(said) == 1)
        (tmp_path / "gpu-2.err").write_text("no such file: job 2\n")  # the same again
        (tmp_path / "gpu-3.err").write_text("out of memory\n")
        wait_until(lambda: len(said) == 2)
    first, second = said
    assert first == f"The log {tmp_path}/gpu-1.err ends: no such file: job 1"
    assert second.endswith("gpu-3.err ends: out of memory")


def test_a_job_that_is_refused(cluster, queue):
    queue.refuses = "IO-0"
    with pytest.raises(RuntimeError, match="no such partition"):
        start_partitions(cluster, {"GPU": {}, "IO": {}})
    cluster.close()
    assert queue.cancelled == {"0"}


WRONG = {
    "an option": ({"GPU": {"mem": "1GB"}}, "'GPU' cannot be started.*'mem'"),
    "slots": ({"GPU": {"slots": 0}}, "slots of partition 'GPU' is 0"),
    "workers": ({"GPU": {"workers": "2"}}, "workers of partition 'GPU' is '2'"),
    "a name": ({"": {}}, "name of a partition"),
}


@pytest.mark.parametrize("case", WRONG)
def test_what_cannot_be_started_submits_nothing(cluster, queue, case):
    partitions, says = WRONG[case]
    with pytest.raises(PoolError, match=says):
        start_partitions(cluster, {"IO": {}, **partitions})
    assert queue.scripts == {}


def test_clusters_that_are_not_taken(cluster, queue):
    with (
        thread_cluster({"GPU": 1}) as other,
        pytest.raises(PoolError, match=r"SpecCluster has workers of one kind.*divide"),
    ):
        start_partitions(other, {"GPU": {}})
    start_partitions(cluster, {"GPU": {}})
    with pytest.raises(PoolError, match="has 1 worker"):
        start_partitions(cluster, {"IO": {}})

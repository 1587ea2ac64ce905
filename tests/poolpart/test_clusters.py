"""Partitions as jobs: what is submitted, and again when it is lost. The queue is made up.

`tests/system/test_queues.py` has a real one.
"""

import os
from collections.abc import Iterator

import pytest
from distributed import Status
from tests.clusters import import_jobqueue, thread_cluster
from tests.poolpart.job_queue import SCHEDULER, Queue

from poolpart import PoolError
from poolpart.deploy import start_partitions
from poolpart.deploy.clusters import JobLogs


@pytest.fixture
def cluster(queue: Queue) -> Iterator[object]:
    queue.held = True
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
    jobs = ["GPU-0", "GPU-1", "IO-0", "NODE-0"]
    scripts = {queue.waiting[number]: text for number, text in queue.scripts.items()}
    assert sorted(queue.submitted) == sorted(scripts) == jobs
    gpu, _, io, node = (scripts[name] for name in jobs)
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
    assert sorted(queue.cancelled) == jobs


def test_a_job_that_was_lost_is_submitted_again(cluster, queue, wait_until):
    start_partitions(cluster, {"GPU": {}, "IO": {}})
    queue.refuses = "GPU-0"  # for a while
    cluster.loop.add_callback(lambda: cluster.workers.pop("GPU-0"))  # as a SpecCluster does
    wait_until(lambda: queue.refused > 1)
    queue.refuses = ""
    wait_until(lambda: queue.submitted.count("GPU-0") == 2)
    cluster.close()
    assert queue.submitted.count("IO-0") == 1
    assert "GPU-0" in queue.cancelled
    assert cluster.status == Status.closed


def test_logs_tell_why_workers_are_missing(queue, tmp_path, wait_until):
    queue.held = True
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
    assert first == f"The last line of the log {tmp_path}/gpu-1.err is: no such file: job 1"
    assert second.endswith("gpu-3.err is: out of memory")


def test_the_end_of_a_log_is_reported_once_and_after_the_log_is_complete(tmp_path):
    logs = JobLogs([{"log_directory": str(tmp_path)}, {}])
    log = tmp_path / "gpu-1.err"
    log.write_text("loading modules\n")
    (tmp_path / "deleted.err").write_text("no space left\n")
    assert list(logs.new_last_lines()) == [], "the files may be incomplete"
    (tmp_path / "deleted.err").unlink()
    log.write_text("loading modules\nno such file\n")
    os.utime(log, (1, 1))
    assert list(logs.new_last_lines()) == [], "the log has changed"
    assert list(logs.new_last_lines()) == [f"The last line of the log {log} is: no such file"]
    assert list(logs.new_last_lines()) == []


def test_a_job_that_is_refused(cluster, queue):
    queue.refuses = "IO-0"
    with pytest.raises(RuntimeError, match="the queue is full"):
        start_partitions(cluster, {"GPU": {}, "IO": {}})
    cluster.close()
    assert queue.cancelled == ["GPU-0"]


def test_a_partition_needs_a_name(cluster, queue):
    with pytest.raises(PoolError, match="Invalid partition name"):
        start_partitions(cluster, {"IO": {}, "": {}})
    assert queue.submitted == []


def test_clusters_that_are_not_taken(cluster, queue):
    with (
        thread_cluster({"GPU": 1}) as other,
        pytest.raises(PoolError, match=r"SpecCluster has only one kind of worker.*divide"),
    ):
        start_partitions(other, {"GPU": {}})
    start_partitions(cluster, {"GPU": {}})
    with pytest.raises(PoolError, match="has 1 worker"):
        start_partitions(cluster, {"IO": {}})

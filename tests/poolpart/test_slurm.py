"""Adaptive partitions in a real Slurm queue, as Debian packages it."""

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from distributed import Client
from tests.clusters import import_jobqueue
from tests.daemons import LOOPBACK, Slurm, needs_slurm, slurm

from poolpart import Partition
from poolpart.deploy import start_partitions

pytestmark = [pytest.mark.slow, needs_slurm]


@pytest.fixture(scope="module")
def _slurm(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Slurm]:
    with slurm(tmp_path_factory.mktemp("slurm")) as queue:
        yield queue


@pytest.fixture
def slurm_queue(_slurm: Slurm, monkeypatch: pytest.MonkeyPatch, wait_until) -> Iterator[Slurm]:
    """A queue of 16 CPUs and two GPUs, also for this process, which is empty before and after."""
    for name, value in _slurm.environment.items():
        monkeypatch.setenv(name, value)
    yield _slurm
    for job in _slurm.ask("squeue", "--noheader", "--format=%i").split():
        _slurm.ask("scancel", job)
    wait_until(lambda: not _slurm.jobs())


@contextmanager
def cluster_of(folder: Path, partitions: dict[str, dict[str, Any]]) -> Iterator[Client]:
    """Client of a cluster whose workers are jobs."""
    with import_jobqueue().SLURMCluster(
        cores=1,
        memory="1GB",
        local_directory=str(folder),
        log_directory=str(folder),
        worker_extra_args=["--host", LOOPBACK, "--no-dashboard"],
        scheduler_options={"host": LOOPBACK, "port": 0, "dashboard_address": f"{LOOPBACK}:0"},
    ) as cluster:
        start_partitions(cluster, partitions)
        with Client(cluster) as client:
            yield client


def sleep(seconds):
    time.sleep(seconds)
    return os.environ["SLURM_JOB_ID"]


GPU = {"job_name": "gpu", "job_extra_directives": ["--gres=gpu:1"]}


def test_no_gpu_is_held_while_there_is_no_work_for_it(slurm_queue, tmp_path, wait_until):
    partitions = {"GPU": GPU | {"adapt": [0, 1], "idle_s": 1}, "CPU": {"job_name": "cpu"}}
    with cluster_of(tmp_path, partitions) as client:
        cpu, gpu = Partition("CPU", client), Partition("GPU", client)
        assert cpu.submit(sleep, 0).result(120)
        assert slurm_queue.jobs().keys() == {"cpu"}  # no GPU before its first task
        run = cpu.submit(sleep, 40)
        assert gpu.submit(sleep, 0.1).result(120)
        assert slurm_queue.jobs().keys() == {"cpu", "gpu"}
        wait_until(lambda: slurm_queue.jobs().keys() == {"cpu"})
        assert not run.done()  # no GPU while other partitions still work


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can submit jobs of other users")
def test_a_gpu_is_released_to_another_user_and_used_again(
    slurm_queue, tmp_path, wait_until, monkeypatch
):
    monkeypatch.setattr("poolpart.deploy.waiting_jobs.LIST_EVERY_S", 2.0)
    partitions = {"GPU": GPU | {"adapt": [0, 2], "yield_to_others": True}}
    other = tmp_path / "other.sh"
    other.write_text("#!/bin/sh\nsleep 600\n")

    def state_of_other() -> str | None:
        return slurm_queue.jobs().get("other", (None, None))[1]

    with cluster_of(tmp_path, partitions) as client:
        gpu = Partition("GPU", client)
        tasks = [gpu.submit(sleep, 0.2) for _ in range(1500)]  # work for minutes
        wait_until(lambda: len(gpu) == 2)
        slurm_queue.ask(
            *("sbatch", "--uid=nobody", "--job-name=other", "--gres=gpu:1", "--chdir=/tmp"),
            *("--output=/dev/null", str(other)),
        )
        wait_until(lambda: state_of_other() == "PENDING")  # both GPUs are taken
        wait_until(lambda: state_of_other() == "RUNNING")
        assert len(gpu) == 1
        done = gpu.stats().done
        wait_until(lambda: gpu.stats().done > done)  # the other worker has not stopped
        slurm_queue.ask("scancel", "--name=other")
        wait_until(lambda: len(gpu) == 2)
        client.cancel(tasks)

"""Runs whose workers are jobs of a real Slurm, or processes that a real SSH server starts."""

import json
import os
import re
import signal
from collections.abc import Iterator
from hashlib import sha256
from pathlib import Path
from typing import Any

import pytest
import yaml
from tests.commands import RunningCommand
from tests.daemons import LOOPBACK, Slurm, needs_slurm, needs_sshd, slurm, ssh_server, wait_until
from tests.system.default_survey import DEFAULT_CLOUD_SHA256
from tests.system.test_tls import new_files

pytestmark = pytest.mark.slow

SCHEDULER = {"host": LOOPBACK, "port": 0, "dashboard_address": f"{LOOPBACK}:0"}
ENDS = {"start": [25, 25], "target": [-30, -20]}
THINNED = {"keep_every": 5, "precision_m": 0.01}
# The survey of the demo, with fewer trials
FEWER = {"scene": "seed", "cloud": THINNED, "planning": ENDS | {"trials": 10}}
# A minute of casting, by NumPy on two cores.
MINUTE = {
    "scene": "seed",
    "sensor": {"rays_per_revolution": 3600, "layers": 32, "step_deg": 1},
    "steps": 1440,
}
LONG = {"scene": "seed", "steps": 100_000, "planning": ENDS | {"trials": 100_000}}  # hours of work


@pytest.fixture(scope="module")
def queue(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Slurm]:
    with slurm(tmp_path_factory.mktemp("slurm")) as queue:
        yield queue


@pytest.fixture(scope="module")
def ssh(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, object]]:
    with ssh_server(tmp_path_factory.mktemp("ssh")) as connect_options:
        yield connect_options


@pytest.fixture
def empty_queue(queue: Slurm, monkeypatch: pytest.MonkeyPatch) -> Iterator[Slurm]:
    """Give a queue, for this process too, that has no jobs before the test and after it."""
    for name, value in queue.environment.items():
        monkeypatch.setenv(name, value)
    yield queue
    queue.ask("scancel", "--state=PENDING", "--me")
    queue.ask("scancel", "--me")
    wait_until(lambda: not queue.jobs())


def job_arguments(folder: Path) -> dict[str, Any]:
    return {
        "cores": 1,
        "memory": "1GB",
        "local_directory": str(folder),
        "log_directory": str(folder),
        "scheduler_options": SCHEDULER,
        "worker_extra_args": ["--host", LOOPBACK, "--no-dashboard"],
    }


JOBS: dict[str, dict[str, Any]] = {
    "GPU": {"workers": 2, "job_name": "gpu", "job_extra_directives": ["--gres=gpu:1"]},
    "LIDAR": {"slots": 4, "job_name": "lidar"},
    "OTHER": {"job_name": "other"},
}
HOSTS: dict[str, dict[str, Any]] = {
    "GPU": {"hosts": [LOOPBACK, LOOPBACK]},
    "LIDAR": {"hosts": [LOOPBACK], "slots": 4},
    "OTHER": {"hosts": [LOOPBACK]},
}


class Command(RunningCommand):
    """The command with a cluster file."""

    def __init__(
        self, folder: Path, cluster: dict[str, Any] | None, scenario: dict[str, Any] = FEWER
    ) -> None:
        (folder / "cluster.yaml").write_text(yaml.safe_dump(cluster))
        self.out = folder / ("out" if cluster else "local")
        options = ["--out", str(self.out), "--backend", "numpy", "--cloud-only"]
        options += ["--cluster", "cluster.yaml"] if cluster else []
        super().__init__(folder, yaml.safe_dump(scenario), *options)

    def result(self) -> tuple[str, dict[str, Any]]:
        """Wait for the end; returns the cloud's checksum and the report."""
        assert self.process.wait(600) == 0, self.said
        report = json.loads((self.out / "report.json").read_text())
        assert report["placement_violations"] == 0
        return sha256((self.out / "cloud.ply").read_bytes()).hexdigest(), report

    def assert_default_result(self) -> None:
        """Wait for the end, and check that the result is that of the default survey."""
        checksum, report = self.result()
        assert checksum == DEFAULT_CLOUD_SHA256
        assert report["tasks"]["GPU"].keys() == {"intersect"}
        assert report["tasks"]["LIDAR"].keys() == {"generate", "sort", "collect"}
        assert report["tasks"]["OTHER"] == {"trial": 10}
        (where,) = report["stages"]["generate"]["workers"]
        assert where == "LIDAR-0"


def slurm_file(folder: Path, **gpu: Any) -> dict[str, Any]:
    return {
        "cluster": "dask_jobqueue.SLURMCluster",
        "arguments": job_arguments(folder),
        "partitions": JOBS | {"GPU": JOBS["GPU"] | gpu},
    }


@needs_slurm
def test_a_run_waits_for_its_jobs_and_takes_them_with_it(empty_queue, tmp_path):
    held = [*JOBS["GPU"]["job_extra_directives"], "--hold"]
    run = Command(tmp_path, slurm_file(tmp_path, job_extra_directives=held))
    run.wait_for(
        r"waiting for workers for up to 35\d\d s more: Partition 'GPU' has 0 of the 1 required slot"
    )
    states = {state for _, state in empty_queue.jobs().values()}
    assert states == {"PENDING", "RUNNING"}
    assert empty_queue.jobs()["gpu"][1] == "PENDING"
    empty_queue.ask("scontrol", "release", "jobname=gpu")
    run.assert_default_result()
    assert empty_queue.jobs() == {}


@needs_slurm
def test_jobs_that_are_cancelled_during_a_run_of_the_command(empty_queue, tmp_path):
    expected, _ = Command(tmp_path, None, MINUTE).result()
    run = Command(tmp_path, slurm_file(tmp_path), MINUTE)
    run.wait_for(r"survey +[1-9]")
    lost = {name: number for name, (number, _) in empty_queue.jobs().items()}
    empty_queue.ask("scancel", lost["gpu"], lost["lidar"])
    run.wait_for("waiting for workers of partition LIDAR")  # another job is on its way
    checksum, report = run.result()
    assert checksum == expected
    assert report["tasks"]["LIDAR"].keys() == {"generate", "sort", "collect"}
    assert empty_queue.jobs() == {}


@needs_slurm
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_jobs_of_a_run_that_is_stopped_go_away(empty_queue, tmp_path, number):
    run = Command(tmp_path, slurm_file(tmp_path), LONG)
    run.wait_for(r"survey +[1-9]")
    ended = run.signal(number, group=True)
    assert ended == (130 if number != signal.SIGKILL else -signal.SIGKILL)
    if number == signal.SIGKILL:  # workers notice that their scheduler is gone
        wait_until(lambda: not empty_queue.jobs())
    assert empty_queue.jobs() == {}


@needs_slurm
def test_a_job_that_the_queue_refuses_takes_the_others_with_it(empty_queue, tmp_path):
    run = Command(tmp_path, slurm_file(tmp_path, queue="nowhere"))
    assert run.process.wait(300) == 2
    assert "cluster.yaml: dask_jobqueue.SLURMCluster could not be started" in run.said
    assert "invalid partition specified: nowhere" in run.said
    assert "Traceback" not in run.said
    assert empty_queue.jobs() == {}


@needs_slurm
@pytest.mark.parametrize("certificates", ["of its own", "configured"])
def test_an_encrypted_cluster_of_jobs(empty_queue, tmp_path, monkeypatch, certificates):
    file = slurm_file(tmp_path)
    if certificates == "configured":
        configure_certificates(tmp_path, monkeypatch)
        file["arguments"]["protocol"] = "tls://"
    else:
        file["arguments"] |= {"security": True, "shared_temp_directory": str(tmp_path)}
    run = Command(tmp_path, file)
    run.assert_default_result()
    logs = [log.read_text() for log in tmp_path.glob("gpu-*.err")]
    assert logs and all("tls://" in log and "tcp://" not in log for log in logs)
    assert empty_queue.jobs() == {}


ADAPTIVE = {"adapt": [0, 2], "idle_s": 1}


@needs_slurm
def test_partitions_without_jobs_get_some_when_a_run_needs_them(empty_queue, tmp_path):
    file = slurm_file(tmp_path)
    gpu = {option: value for option, value in JOBS["GPU"].items() if option != "workers"}
    held = [*gpu["job_extra_directives"], "--hold"]
    gpu |= {"job_extra_directives": held, "job_name": "waiting"}
    file["partitions"]["GPU"] = gpu | ADAPTIVE
    file["partitions"]["OTHER"] = JOBS["OTHER"] | ADAPTIVE
    run = Command(tmp_path, file)
    run.wait_for(r"started SLURMCluster: up to 5 workers, GPU 0 to 2, LIDAR 1, OTHER 0 to 2")
    run.wait_for(
        r"waiting for workers for up to \d+ s more: Partition 'GPU' has 0 of the 1 required slot"
        r".*; \d jobs? (is|are) in the queue or starting"
    )
    assert empty_queue.jobs()["waiting"][1] == "PENDING"
    empty_queue.ask("scontrol", "release", "jobname=waiting")
    run.assert_default_result()
    assert empty_queue.jobs() == {}


@needs_slurm
def test_a_run_waits_for_jobs_that_replace_lost_ones(empty_queue, tmp_path):
    expected, _ = Command(tmp_path, None, MINUTE).result()
    file = slurm_file(tmp_path)
    gpu = {option: value for option, value in JOBS["GPU"].items() if option != "workers"}
    file["partitions"]["GPU"] = gpu | ADAPTIVE | {"adapt": [0, 1]}
    run = Command(tmp_path, file, MINUTE)
    run.wait_for(r"survey +[1-9]")
    empty_queue.ask("scancel", empty_queue.jobs()["gpu"][0])
    run.wait_for(
        r"waiting for workers of partition GPU for up to \d+ s more: 1 job is in the queue"
    )
    checksum, _ = run.result()
    assert checksum == expected
    assert empty_queue.jobs() == {}


@needs_slurm
@pytest.mark.skipif(os.geteuid() != 0, reason="only root can submit jobs of other users")
def test_a_run_releases_a_gpu_to_another_user(empty_queue, tmp_path):
    expected, _ = Command(tmp_path, None, MINUTE).result()
    file = slurm_file(tmp_path)
    gpu = {option: value for option, value in JOBS["GPU"].items() if option != "workers"}
    file["partitions"]["GPU"] = gpu | ADAPTIVE | {"yield_to_others": True}
    run = Command(tmp_path, file, MINUTE)
    run.wait_for(r"survey +[1-9]")

    def gpu_jobs() -> int:
        return empty_queue.ask("squeue", "--noheader", "--name=gpu").count("\n")

    wait_until(lambda: gpu_jobs() == 2)
    script = tmp_path / "other.sh"
    script.write_text("#!/bin/sh\nsleep 600\n")
    empty_queue.ask(
        *("sbatch", "--uid=nobody", "--job-name=other", "--gres=gpu:2", "--chdir=/tmp"),
        *("--output=/dev/null", str(script)),
    )
    try:
        wait_until(lambda: gpu_jobs() == 1)
        assert run.process.poll() is None
        checksum, report = run.result()
    finally:
        empty_queue.ask("scancel", "--name=other")
    assert checksum == expected
    assert report["tasks"]["GPU"].keys() == {"intersect"}


def configure_certificates(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Put certificates into Dask's configuration, for this process and those that it starts."""
    _, files = new_files(folder)
    pair = {"cert": str(files.cert), "key": str(files.key)}
    tls = {"ca-file": str(files.ca), "scheduler": pair, "worker": pair, "client": pair}
    comm = {"require-encryption": True, "tls": tls}
    (folder / "dask.yaml").write_text(yaml.safe_dump({"distributed": {"comm": comm}}))
    monkeypatch.setenv("DASK_CONFIG", str(folder / "dask.yaml"))


def ssh_file(folder: Path, ssh: dict[str, object], **scheduler: Any) -> dict[str, Any]:
    return {
        "cluster": "distributed.SSHCluster",
        "arguments": {
            "hosts": [LOOPBACK],
            "connect_options": ssh,
            "scheduler_options": SCHEDULER | scheduler,
            "worker_options": {"host": LOOPBACK, "local_directory": str(folder)},
        },
        "partitions": HOSTS,
    }


@needs_sshd
@pytest.mark.parametrize("protocol", ["tcp://", "tls://"])
def test_a_run_on_hosts_that_ssh_reaches(ssh, tmp_path, monkeypatch, protocol):
    if protocol == "tls://":
        configure_certificates(tmp_path, monkeypatch)
    run = Command(tmp_path, ssh_file(tmp_path, ssh, protocol=protocol))
    run.assert_default_result()
    wait_until(lambda: not processes_in(tmp_path))


@needs_sshd
def test_processes_that_ssh_starts_when_a_run_needs_them(ssh, tmp_path):
    file = ssh_file(tmp_path, ssh)
    file["partitions"] = HOSTS | {name: HOSTS[name] | ADAPTIVE for name in ("GPU", "OTHER")}
    long = FEWER | {"steps": 600}  # idle workers of OTHER end before the run
    run = Command(tmp_path, file, long)
    run.wait_for("started SSHCluster: up to 5 workers, GPU 0 to 2, LIDAR 1, OTHER 0 to 2")
    expected, _ = Command(tmp_path, None, long).result()
    checksum, report = run.result()
    assert checksum == expected
    assert report["tasks"]["OTHER"] == {"trial": 10}
    assert "could not be started" not in run.said
    wait_until(lambda: not processes_in(tmp_path))


@needs_sshd
@pytest.mark.parametrize("where", ["arguments", "GPU"])
def test_what_a_host_says_that_cannot_start_its_process(ssh, tmp_path, where):
    file = ssh_file(tmp_path, ssh)
    if where == "GPU":
        file["partitions"] = HOSTS | {"GPU": HOSTS["GPU"] | {"remote_python": "/nowhere/python"}}
    else:
        file["arguments"]["remote_python"] = "/nowhere/python"
    run = Command(tmp_path, file)
    assert run.process.wait(300) == 2
    assert re.search(r"could not be started \(.*/nowhere/python.*No such file", run.said), run.said
    wait_until(lambda: not processes_in(tmp_path))


def processes_in(folder: Path) -> list[str]:
    """List the processes whose command line names a folder."""
    found = []
    for entry in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            words = entry.read_bytes().decode(errors="replace")
        except OSError:
            continue  # it has ended
        if str(folder) in words:
            found.append(words)
    return found

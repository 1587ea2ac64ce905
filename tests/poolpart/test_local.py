"""The local cluster: what it listens on, and that it never leaves a process behind."""

import os
import signal
import subprocess
import sys

import psutil
import pytest
from distributed import Client
from hypothesis import given
from hypothesis import strategies as st

from poolpart import Pool, PoolError, local_cluster
from poolpart.local import default_workers, usable_cores

SCRIPT = """
import sys, time
from distributed import Client
from poolpart import Pool, local_cluster

def main():
    with local_cluster(gpu_workers=1, other_workers=1) as cluster, Client(cluster) as client:
        pids = client.run(__import__("os").getpid)
        print(*pids.values(), flush=True)
        {body}

{call}
"""


def script(tmp_path, body="pass", call='if __name__ == "__main__": main()'):
    """Start a script that starts a cluster; returns its process."""
    path = tmp_path / "script.py"
    path.write_text(SCRIPT.format(body=body, call=call))
    return subprocess.Popen(
        [sys.executable, path], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def gone(pids):
    return not any(psutil.pid_exists(pid) and is_alive(pid) for pid in pids)


def is_alive(pid):
    try:
        return psutil.Process(pid).status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


def listening(processes):
    """Addresses that the processes listen on, one a socket, by process."""
    return {
        process.pid: [
            connection.laddr.ip
            for connection in process.net_connections("inet")
            if connection.status == psutil.CONN_LISTEN
        ]
        for process in processes
    }


def children():
    return {process.pid for process in psutil.Process().children(recursive=True)}


@given(cores=st.integers(1, 256), gpus=st.integers(0, 16))
def test_every_machine_gets_workers_and_no_more_than_cores_and_gpus(cores, gpus):
    workers = default_workers(cores, gpus)
    assert workers["GPU"] == gpus or gpus == 0
    assert all(count >= 1 for count in workers.values())
    assert sum(workers.values()) <= max(2, cores, gpus + 1)


def test_usable_cores_counts_those_of_this_process():
    assert usable_cores() == len(os.sched_getaffinity(0))


def test_three_partitions(processes):
    parts = Pool.from_client(processes).partitions()
    assert {name: (len(part), part.slots) for name, part in parts.items()} == {
        "GPU": (1, 1),
        "LIDAR": (1, 4),
        "OTHER": (1, 1),
    }


def test_a_number_of_workers_says_nothing_of_their_kinds(processes):
    with pytest.raises(PoolError, match=r"fixed number of workers: .* Partition\.grow"):
        processes.cluster.scale(2)
    assert len(Pool.from_client(processes)) == 3


def test_no_dashboard_environment_and_nothing_left_after_an_error(wait_until):
    before = children()
    with (
        pytest.raises(ZeroDivisionError),
        local_cluster(
            gpu_workers=2, other_workers=1, dashboard_port=None, environment={"SEEN": "yes"}
        ) as cluster,
        Client(cluster) as client,
    ):
        assert {name.split("-")[0] for name in cluster.workers} == {"GPU", "LIDAR", "OTHER"}
        assert set(client.run(lambda: os.environ["SEEN"]).values()) == {"yes"}
        assert set(client.run(lambda: os.environ["OMP_NUM_THREADS"]).values()) == {"1"}
        assert cluster.scheduler.http_server.address == "127.0.0.1"
        started = children() - before
        assert len(started) >= 4
        raise ZeroDivisionError
    # Those that had to be killed may take a moment to die.
    wait_until(lambda: gone(started - {resource_tracker_pid()}))


def resource_tracker_pid():
    """Process that multiprocessing starts once and keeps."""
    from multiprocessing import resource_tracker

    return resource_tracker._resource_tracker._pid


@pytest.mark.parametrize("name", ["gpu_workers", "lidar_slots", "other_workers"])
@pytest.mark.parametrize("count", [0, -1, float("nan"), 1.5])
def test_counts_that_cannot_be(name, count):
    before = children()
    with pytest.raises(PoolError, match=f"{name} is {count}; give a whole number"):
        local_cluster(**{name: count})
    assert children() <= before  # those of earlier tests may end meanwhile


@pytest.fixture(scope="module")
def driver(tmp_path_factory):
    """Process of a script whose local cluster is up, and its workers' process ids."""
    process = script(tmp_path_factory.mktemp("driver"), body="time.sleep(600)")
    yield process, [int(pid) for pid in process.stdout.readline().split()]
    process.kill()
    process.communicate()


def test_scheduler_nannies_workers_and_dashboard_listen_on_loopback_only(driver):
    process, pids = driver
    # Scheduler, nannies and dashboard are in the driver.
    everything = [psutil.Process(process.pid), *psutil.Process(process.pid).children(True)]
    found = listening(everything)
    assert len(found[process.pid]) >= 5  # scheduler, dashboard, three nannies
    assert all(found[pid] for pid in pids)
    assert {address for listed in found.values() for address in listed} == {"127.0.0.1"}


def test_no_worker_outlives_a_driver_that_is_killed(driver, wait_until):
    process, pids = driver
    assert len(pids) == 3
    assert not gone(pids)
    process.send_signal(signal.SIGKILL)
    process.wait()
    wait_until(lambda: gone(pids), timeout_s=120)


def test_ctrl_c_ends_driver_and_workers(tmp_path, wait_until):
    driver = script(tmp_path, body="time.sleep(600)")
    pids = [int(pid) for pid in driver.stdout.readline().split()]
    driver.send_signal(signal.SIGINT)
    _, errors = driver.communicate(timeout=120)
    assert errors.rstrip().endswith("KeyboardInterrupt")
    wait_until(lambda: gone(pids), timeout_s=120)


def test_a_script_without_a_main_guard_is_told_so(tmp_path):
    driver = script(tmp_path, call="main()")
    output, errors = driver.communicate(timeout=120)
    assert (driver.returncode, output) == (1, "")
    last = errors.rstrip().splitlines()[-1]
    assert last.startswith("poolpart.errors.PoolError: The workers did not start (")
    assert "under `if __name__ == '__main__':`" in last
    assert "freeze_support" not in errors


def test_advice_where_there_is_no_home(monkeypatch):
    def no_home():
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr("poolpart.local._NannyCluster", lambda **_: no_home())
    with pytest.raises(PoolError, match=r"under `if __name__.* killed while it started: .*memory"):
        local_cluster()
    monkeypatch.setattr("poolpart.local.Path.home", no_home)
    with pytest.raises(PoolError, match=r"home directory\.\)\. .* let HOME name one"):
        local_cluster()

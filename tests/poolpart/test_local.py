"""The local cluster: what it listens on, and that it never leaves a process behind."""

import os
import signal
import subprocess
import sys
from multiprocessing import spawn

import dask
import psutil
import pytest
from distributed import Client, Scheduler, Worker
from tests.clusters import QUIET

from poolpart import Pool, PoolError
from poolpart.deploy import local, local_cluster
from poolpart.deploy.local_processes import FixedCluster

SCRIPT = """
import sys, time
from distributed import Client
from poolpart import Pool
from poolpart.deploy import local_cluster

def main():
    partitions = {{"GPU": (1, 1), "IO": (1, 4), "OTHER": (1, 1)}}
    with local_cluster(partitions) as cluster, Client(cluster) as client:
        pids = client.run(__import__("os").getpid)
        print(*pids.values(), flush=True)
        {body}

{call}
"""


def script(tmp_path, body="pass", call='if __name__ == "__main__": main()'):
    """Start a script that starts a cluster; returns its process."""
    path = tmp_path / "script.py"
    path.write_text(SCRIPT.format(body=body, call=call))
    # Nannies of this process leave what they set for their workers in its environment.
    inherited = {name: value for name, value in os.environ.items() if "MALLOC" not in name}
    return subprocess.Popen(
        [sys.executable, path],
        env=inherited,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def gone(pids):
    ended = (psutil.STATUS_ZOMBIE, psutil.STATUS_DEAD)
    alive = {p.pid for p in psutil.process_iter(["status"]) if p.info["status"] not in ended}
    return alive.isdisjoint(pids)


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


def test_a_number_of_workers_says_nothing_of_their_kinds(processes):
    with pytest.raises(PoolError, match=r"fixed number of workers\. .* `Partition\.grow"):
        processes.cluster.scale(2)
    assert len(Pool.from_client(processes)) == 3


def test_no_dashboard_and_nothing_left_after_an_error(wait_until):
    before = children()
    with (
        pytest.raises(ZeroDivisionError),
        local_cluster(
            {"GPU": (2, 1), "IO": (1, 3), "OTHER": (0, 1)}, dashboard_port=None
        ) as cluster,
        Client(cluster) as client,
    ):
        assert set(cluster.workers) == {"GPU-0", "GPU-1", "IO-0"}  # none of OTHER
        assert set(client.nthreads().values()) == {1, 3}
        assert set(client.run(lambda: os.environ["OMP_NUM_THREADS"]).values()) == {"1"}
        assert cluster.scheduler.http_server.address == "127.0.0.1"
        started = children() - before
        assert len(started) >= 3
        raise ZeroDivisionError
    # Those that had to be killed may take a moment to die.
    wait_until(lambda: gone(started - {resource_tracker_pid()}))


def resource_tracker_pid():
    """Process that multiprocessing starts once and keeps."""
    from multiprocessing import resource_tracker

    return resource_tracker._resource_tracker._pid


@pytest.mark.parametrize(
    ("partitions", "message"),
    [
        ({"A": (-1, 1)}, "value -1 for the number of workers of partition 'A'"),
        ({"A": (1, 0)}, "value 0 for the number of slots of partition 'A'"),
        ({"A": (1, 1), "": (1, 1)}, "Invalid partition name ''"),
        ({"A": (0, 1)}, "would have no workers"),
    ],
)
def test_partitions_that_cannot_be(partitions, message):
    before = children()
    with pytest.raises(PoolError, match=message):
        local_cluster(partitions)
    assert children() <= before  # those of earlier tests may end meanwhile


@pytest.fixture(scope="module")
def driver(tmp_path_factory):
    """Process of a script whose local cluster is up, and its workers' process ids."""
    process = script(tmp_path_factory.mktemp("driver"), body="time.sleep(600)")
    yield process, [int(pid) for pid in process.stdout.readline().split()]
    process.kill()
    process.communicate()


@pytest.mark.slow
def test_scheduler_nannies_workers_and_dashboard_listen_on_loopback_only(driver):
    process, pids = driver
    # Scheduler, nannies and dashboard are in the driver.
    everything = [psutil.Process(process.pid), *psutil.Process(process.pid).children(True)]
    found = listening(everything)
    assert len(found[process.pid]) >= 5  # scheduler, dashboard, three nannies
    assert all(found[pid] for pid in pids)
    assert {address for listed in found.values() for address in listed} == {"127.0.0.1"}
    for pid in pids:  # an allocator that keeps large arrays, where the C library reads it
        assert psutil.Process(pid).environ()["MALLOC_TRIM_THRESHOLD_"] == "268435456"


def test_no_worker_outlives_a_driver_that_is_killed(driver, wait_until):
    process, pids = driver
    assert len(pids) == 3
    assert not gone(pids)
    process.send_signal(signal.SIGKILL)
    process.wait()
    wait_until(lambda: gone(pids))


@pytest.mark.slow
def test_a_script_needs_no_main_guard_and_what_it_defines_reaches_the_workers(tmp_path):
    body = "print(client.submit(defined_here, 20).result(), file=sys.stderr)"
    driver = script(tmp_path, body, call="def defined_here(x): return 2 * x + 2\n\nmain()")
    output, errors = driver.communicate(timeout=120)
    assert driver.returncode == 0
    assert "42" in errors.splitlines()  # Dask may log the end of a busy machine's workers beside it
    assert len(output.splitlines()) == 1  # that of the driver: no worker has run the script


def test_processes_of_the_user_are_started_as_ever(processes, monkeypatch):
    """Also one of the name that Dask gives to its workers; once they have started."""
    monkeypatch.setattr(sys.modules["__main__"], "__file__", __file__, raising=False)  # a script
    for name in ("Process-1", "Dask Worker process (from Nanny)"):
        data = spawn.get_preparation_data(name)
        assert data["name"] == name and data.keys() & {"init_main_from_name", "init_main_from_path"}


@pytest.mark.extended
@pytest.mark.parametrize("restart", [False, True])
def test_a_worker_that_is_slow_to_come_back_is_not_given_up(restart):
    """Dask's SpecCluster closes the nanny of a worker that is not back after this time."""
    with (
        dask.config.set({"distributed.deploy.lost-worker-timeout": "10ms"}),
        local_cluster({"A": (1, 1)}) as cluster,
        Client(cluster) as client,
    ):
        partition = Pool.from_client(client).partitions()["A"]
        address = partition.workers[0].address
        pid = client.run(os.getpid, workers=[address])[address]
        if restart:
            client.restart()
        else:
            os.kill(pid, signal.SIGKILL)
        assert partition.submit(os.getpid).result(timeout=120) != pid
        assert "A-0" in cluster.workers


LATE = """
        import asyncio
        waiting = set()
        async def late(*_, address, **__):
            waiting.add(address)
            await asyncio.sleep(600)
        cluster.scheduler.handlers["heartbeat_worker"] = late
        while len(waiting) < 3:
            time.sleep(0.05)
"""


def test_a_worker_that_leaves_while_a_client_counts_workers_is_no_error(wait_until):
    """The count may precede the message that the worker has left, which then removes nothing."""
    options = {"host": "127.0.0.1", "dashboard": False}
    scheduler = {"cls": Scheduler, "options": {**options, "dashboard_address": "127.0.0.1:0"}}
    workers = {name: {"cls": Worker, "options": {"nthreads": 1, **options}} for name in range(2)}
    with (
        FixedCluster(workers=workers, scheduler=scheduler, silence_logs=QUIET) as cluster,
        Client(cluster) as client,
    ):
        client.wait_for_workers(2, timeout=60)
        left, stays = cluster.scheduler_info["workers"]
        del cluster.scheduler_info["workers"][left]
        client.retire_workers([left])
        wait_until(lambda: [*cluster.scheduler.workers] == [stays])
        client.retire_workers([stays])
        wait_until(lambda: not cluster.scheduler_info["workers"])


@pytest.mark.slow
def test_workers_that_close_while_the_scheduler_owes_an_answer_say_nothing(tmp_path):
    """As the schedulers of busy machines do at the end of a run."""
    running = script(tmp_path, LATE)
    _, told = running.communicate(timeout=300)
    assert (running.returncode, told) == (0, "")


def test_encryption_needs_a_package_that_is_optional(monkeypatch):
    monkeypatch.setattr(local, "find_spec", lambda name: None)
    with pytest.raises(PoolError, match=r"requires cryptography.* Run pip install cryptography"):
        local_cluster({"A": (1, 1)}, security=True)

"""Helpers that several files of these tests share: tasks, and changes of clusters."""

import os
import signal
import threading
import time
import urllib.request

from distributed import Event, get_client, get_worker
from distributed.core import Status
from prometheus_client import parser

from poolpart.workers import worker_identities

LONG_S = 120.0  # longest wait for an immediate event before a test fails
_connecting = threading.Lock()


def worker_name(*_):
    """Return the name of the worker that runs this task."""
    return str(get_worker().name)


def twice(x):
    return 2 * x


def wait_for(event):
    with _connecting:  # Dask may return a client that another task is still connecting
        client = get_client()
    return Event(event, client).wait(LONG_S)


def declared(client):
    """Return the resources of each worker, by name, as the scheduler knows the workers."""
    workers = worker_identities(client).values()
    return {str(worker["name"]): worker["resources"] for worker in workers}


def declared_by_themselves(client):
    """Return the resources of each worker, by name, as the workers state."""
    names = {address: str(w["name"]) for address, w in worker_identities(client).items()}
    return {names[address]: slots for address, slots in client.run(_slots).items()}


def _slots(dask_worker):
    return {name: slots for name, slots in dask_worker.state.total_resources.items() if slots}


def addresses(client):
    """Return the addresses of the workers, by name."""
    workers = worker_identities(client).items()
    return {str(worker["name"]): address for address, worker in workers}


def kill(client, name):
    """Kill a worker's process as soon as its nanny can start a new process; return its address.

    A nanny ends if its first worker dies before the nanny has noticed that the worker is up. The
    nanny looks 20 times a second, on a busy machine less often.
    """
    address = addresses(client)[name]
    pid = client.run(os.getpid, workers=[address])[address]
    while client.run(_hears_of_worker, workers=[address], nanny=True) != {address: True}:
        time.sleep(0.01)
    os.kill(pid, signal.SIGKILL)
    return address


def _hears_of_worker(dask_worker):
    return dask_worker.process.status == Status.running


def set_status(client, name, status):
    """Pause or resume a worker of this process, in its event loop.

    A message that is sent from another thread may wait until the loop is woken by something else.
    """

    async def change():
        client.cluster.workers[name].status = status

    client.sync(change)


def join(client, name, **options):
    """Start a further worker, like the first worker but for the given options."""
    spec = next(iter(client.cluster.worker_spec.values()))
    client.cluster.worker_spec[name] = {**spec, "options": {**spec["options"], **options}}
    client.sync(client.cluster._correct_state)


def leave(client, name):
    """Stop a worker for good."""
    del client.cluster.worker_spec[name]
    client.sync(client.cluster._correct_state)


def metrics_of(client):
    """Return the metrics of partitions at the scheduler's /metrics: {(name, *labels): value}.

    The labels of a sample are sorted by their names.
    """
    port = client.cluster.scheduler.http_server.port
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=LONG_S) as answer:
        families = parser.text_string_to_metric_families(answer.read().decode())
    return {
        (sample.name.removeprefix("dask_partition_"), *sample.labels.values()): sample.value
        for family in families
        for sample in family.samples
        if sample.name.startswith("dask_partition_")
    }

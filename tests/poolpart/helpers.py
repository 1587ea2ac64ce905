"""What several files of these tests do to clusters, and look at."""

import os
import signal
import time

from distributed import Event, get_worker
from distributed.core import Status

from poolpart.workers import worker_identities

LONG_S = 120.0  # for what happens at once, or the test fails


def here(*_):
    """Name of the worker that runs this."""
    return str(get_worker().name)


def twice(x):
    return 2 * x


def wait_for(event):
    return Event(event).wait(LONG_S)


def declared(client):
    """Resources by worker, as the scheduler knows them."""
    workers = worker_identities(client).values()
    return {str(worker["name"]): worker["resources"] for worker in workers}


def declared_by_themselves(client):
    """Resources by worker, as the workers know them."""
    names = {address: str(w["name"]) for address, w in worker_identities(client).items()}
    return {names[address]: slots for address, slots in client.run(_slots).items()}


def _slots(dask_worker):
    return {name: slots for name, slots in dask_worker.state.total_resources.items() if slots}


def addresses(client):
    """Addresses of the workers by name."""
    workers = worker_identities(client).items()
    return {str(worker["name"]): address for address, worker in workers}


def kill(client, name):
    """Kill a worker's process as soon as its nanny would start it again; returns its address.

    A nanny ends when its first worker dies before it has heard that this one is up. It looks 20
    times a second, on a busy machine less often.
    """
    address = addresses(client)[name]
    pid = client.run(os.getpid, workers=[address])[address]
    while client.run(_hears_of_worker, workers=[address], nanny=True) != {address: True}:
        time.sleep(0.01)
    os.kill(pid, signal.SIGKILL)
    return address


def _hears_of_worker(dask_worker):
    return dask_worker.process.status == Status.running


def join(client, name, **options):
    """Start one more worker, like the first but for these options."""
    spec = next(iter(client.cluster.worker_spec.values()))
    client.cluster.worker_spec[name] = {**spec, "options": {**spec["options"], **options}}
    client.sync(client.cluster._correct_state)


def leave(client, name):
    """Stop a worker for good."""
    del client.cluster.worker_spec[name]
    client.sync(client.cluster._correct_state)

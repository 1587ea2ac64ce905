"""Making workers of a running cluster declare a resource, for as long as they live."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from distributed import Client

from .errors import PoolError
from .restarts import KeepResources


def declare(client: Client, resource: str, slots: Mapping[str, int], addresses: list[str]) -> None:
    """Give workers their slots of a resource.

    Parameters
    ----------
    client
        Client of their cluster.
    resource
        Name of the resource.
    slots
        How many, by worker name.
    addresses
        The workers' addresses.

    Raises
    ------
    PoolError
        If one of them left meanwhile.
    """
    # First the nannies: a worker that dies right after would come back without.
    client.register_plugin(KeepResources(resource, dict(slots)))
    answers = client.run(
        _declare_on_worker, dict(slots), resource, workers=addresses, on_error="return"
    )
    for address in addresses:
        answer = answers.get(address)
        if answer is None or isinstance(answer, BaseException):
            raise PoolError(
                f"The worker at {address} could not be put into partition {resource!r} "
                f"({answer!r}); make the pool anew and divide that."
            )
    client.run_on_scheduler(_wake_on_scheduler, addresses=addresses)


async def _declare_on_worker(
    slots: dict[str, int], resource: str, dask_worker: Any = None
) -> dict[str, float]:
    await dask_worker.set_resources(**{resource: slots[str(dask_worker.name)]})
    return dict(dask_worker.state.total_resources)


async def _wake_on_scheduler(addresses: list[str], dask_scheduler: Any = None) -> None:
    """Send tasks that wait for such workers to them, as the scheduler does when a worker joins.

    It does not when a running worker gets a resource: those tasks would wait for ever.
    """
    for address in addresses:
        if worker := dask_scheduler.workers.get(address):
            dask_scheduler.transitions(
                dask_scheduler.bulk_schedule_unrunnable_after_adding_worker(worker),
                f"poolpart-declare-{address}",
            )

"""What a worker declares, and what its nanny starts it with; this runs on them."""

from __future__ import annotations

import asyncio
from typing import Any

from .book import Resources

_PATIENCE_S = 1.0


async def declare_on_worker(resources: Resources, dask_worker: Any = None) -> bool:
    """Declare these resources and no others; runs on a worker.

    Returns
    -------
    done
        False if tasks still hold a resource that is to go: they give it back when they end,
        and must find it then. Such a task may be one that was cancelled, of which the
        scheduler knows nothing any more.
    """
    state = dask_worker.state
    total, available = state.total_resources, state.available_resources
    leaving = total.keys() - resources.keys()
    for _ in range(int(_PATIENCE_S / 0.01)):
        if all(available[name] >= total[name] for name in leaving):
            break
        await asyncio.sleep(0.01)
    else:
        return False
    for name in leaving:
        del total[name], available[name]
    for name, quantity in resources.items():
        available[name] = available.get(name, 0) + quantity - total.get(name, 0)
        total[name] = quantity
    return True


def keep_on_nanny(resources: Resources, dask_worker: Any = None) -> list[Resources | None]:
    """Start the worker with these resources from now on; runs on a nanny.

    Resources set on a running worker are lost when its nanny restarts it. Setting them once
    more from inside the new worker comes too late for tasks that found no worker meanwhile:
    nothing wakes those. A resource in what the nanny starts the worker with is there when the
    worker registers, and that does wake them.

    Returns
    -------
    before
        What it was before, for `restore_on_nanny`.
    """
    nanny = dask_worker  # the server that this runs on
    return _exchange(nanny, dict(resources), dict(resources))


def restore_on_nanny(before: list[Resources | None], dask_worker: Any = None) -> None:
    """Have the nanny as `keep_on_nanny` found it; runs on a nanny."""
    _exchange(dask_worker, *before)


def _exchange(
    nanny: Any, resources: Resources | None, started_with: Resources | None
) -> list[Resources | None]:
    before = [nanny.resources, None]
    nanny.resources = resources
    # A nanny that has started a worker keeps what it started it with, and uses that.
    if nanny.process is not None:
        before[1] = nanny.process.worker_kwargs["resources"]
        nanny.process.worker_kwargs["resources"] = started_with
    return before

"""What a worker declares, and what its nanny starts it with; this runs on them."""

from __future__ import annotations

import asyncio
from typing import Any

from distributed import Status

from .book import Resources
from .marks import is_awaited

_PATIENCE_S = 1.0
_FOUND = "poolpart_found"  # on a nanny: what it started its worker with before


async def declare_on_worker(
    resources: Resources, after_mark: bool = False, dask_worker: Any = None
) -> bool:
    """Declare these resources and no others; runs on a worker.

    Parameters
    ----------
    resources
        What to declare.
    after_mark
        Whether to wait for what the scheduler has sent before, see `marks.py`.

    Returns
    -------
    done
        False if tasks still hold a resource that is to go: they give it back when they end,
        and must find it then. Such a task may be one that was cancelled, of which the
        scheduler knows nothing any more; it may even be on its way.
    """
    state = dask_worker.state
    total, available = state.total_resources, state.available_resources
    leaving = total.keys() - resources.keys()
    for _ in range(int(_PATIENCE_S / 0.01)):
        held = any(available[name] < total[name] for name in leaving)
        if not held and not (after_mark and is_awaited(dask_worker)):
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


def keep_on_nanny(resources: Resources, dask_worker: Any = None) -> None:
    """Start the worker with these resources from now on; runs on a nanny.

    Resources set on a running worker are lost when its nanny restarts it. Setting them once
    more from inside the new worker comes too late for tasks that found no worker meanwhile:
    nothing wakes those. A resource in what the nanny starts the worker with is there when the
    worker registers, and that does wake them.

    The nanny itself keeps what it had before: the answer to this may be lost, when its worker
    dies at the same moment, and then nobody else would know.
    """
    nanny = dask_worker  # the server that this runs on
    if not hasattr(nanny, _FOUND):
        setattr(nanny, _FOUND, (nanny.resources, _started_with(nanny)))
    _start_with(nanny, dict(resources), dict(resources))


def restore_on_nanny(dask_worker: Any = None) -> bool:
    """Have the nanny as `keep_on_nanny` found it; runs on a nanny, any number of times.

    Returns
    -------
    starting
        Whether it is starting its worker just now: that one comes as it was begun.
    """
    nanny = dask_worker
    if hasattr(nanny, _FOUND):
        _start_with(nanny, *getattr(nanny, _FOUND))
        delattr(nanny, _FOUND)
    return nanny.process is not None and nanny.process.status is Status.starting


def _started_with(nanny: Any) -> Resources | None:
    """Look up what a nanny has started its worker with, and would again."""
    started: Resources | None = nanny.resources
    if nanny.process is not None:
        started = nanny.process.worker_kwargs["resources"]
    return started


def _start_with(nanny: Any, resources: Resources | None, again: Resources | None) -> None:
    nanny.resources = resources
    if nanny.process is not None:
        nanny.process.worker_kwargs["resources"] = again

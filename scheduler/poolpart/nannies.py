"""Telling nannies which resources to start their workers with."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Collection
from typing import Any

from distributed import Status
from distributed.comm.addressing import parse_address, parse_host_port

from .book import Resources, Seat
from .remote import call

logger = logging.getLogger(__name__)

_CONNECT_S = 5.0


class Nannies:
    """Tells nannies; part of the steward.

    Parameters
    ----------
    scheduler
        The scheduler.
    """

    def __init__(self, scheduler: Any) -> None:
        self.scheduler = scheduler
        # {address: what it was told; None where its answer has not come, or never will}
        self._told: dict[str, Resources | None] = {}

    def agrees(self, seat: Seat, wanted: Resources) -> bool:
        """Whether a worker's nanny, if it has one and was told anything, was told this."""
        return self._told.get(seat.nanny or "", wanted) == wanted

    def was_told(self, seat: Seat) -> bool:
        """Whether a worker's nanny starts it with something else than it was found to."""
        return seat.nanny in self._told

    def forget(self, address: str) -> None:
        """Forget a nanny that has gone."""
        self._told.pop(address, None)

    def forget_others(self, known: Collection[str | None]) -> None:
        """Forget all nannies but these."""
        for nanny in self._told.keys() - known:
            del self._told[nanny]

    async def tell(self, seat: Seat, wanted: Resources) -> None:
        """Have a worker started with these resources from now on.

        Raises
        ------
        OSError
            If its nanny does not answer.
        """
        nanny = seat.nanny
        if nanny is None:
            return
        if wanted == seat.found:
            if nanny in self._told:
                await call(self.scheduler, nanny, restore_on_nanny)
                self._told.pop(nanny, None)
        elif self._told.get(nanny) != wanted:
            self._told[nanny] = None  # its worker may die before it answers, which ends this
            await call(self.scheduler, nanny, keep_on_nanny, resources=wanted)
            self._told[nanny] = wanted

    async def restore(self, seat: Seat) -> None:
        """Have a worker that is not there started as it was found to be, if it comes back.

        One that is being started just now comes as before, and its nanny counts as told.
        """
        nanny = seat.nanny
        if nanny is None or nanny not in self._told:
            return
        try:
            starting = await call(self.scheduler, nanny, restore_on_nanny)
        except OSError as error:
            logger.info("The nanny at %s is gone: %s", nanny, error)
            starting = False
        if not starting:
            self._told.pop(nanny, None)


async def has_gone(nanny: str) -> bool:
    """Whether nobody listens at a nanny's address: then its worker does not come back.

    Dask itself would try to connect for half a minute. One that cannot be reached for another
    reason counts as there; so does one that talks TLS, which would complain of each caller that
    hangs up.
    """
    scheme, place = parse_address(nanny)
    if scheme != "tcp":
        return False
    try:
        async with asyncio.timeout(_CONNECT_S):
            _, writer = await asyncio.open_connection(*parse_host_port(place))
    except ConnectionRefusedError:
        return True
    except OSError:  # TimeoutError is one
        return False
    writer.close()
    return False


_FOUND = "poolpart_found"  # on a nanny: what it started its worker with before


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

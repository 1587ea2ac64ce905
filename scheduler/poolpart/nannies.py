"""What nannies were told to start their workers with, and whether they are there."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Collection
from typing import Any

from distributed.comm.addressing import parse_address, parse_host_port

from .book import Resources, Seat
from .calls import call
from .restarts import keep_on_nanny, restore_on_nanny

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

"""Having workers declare what the scheduler's book says.

What each worker declares is compared with the book, and changed in small steps that can be cut
off anywhere: a worker or its nanny may die between any two of them.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Awaitable, Callable, Collection, Iterable
from typing import Any

from distributed.comm.addressing import parse_address, parse_host_port

from .book import Book, Seat, seat_key
from .internals import (
    Resources,
    call,
    declare_on_worker,
    hand_off,
    held_by,
    keep_on_nanny,
    recount,
    restore_on_nanny,
    send_barrier,
    show,
    wake,
)
from .tracing import trace

logger = logging.getLogger(__name__)

LOOK_EVERY_S = 0.01
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
        """Have a worker that is not there started as it was found to be, if it comes back."""
        nanny = seat.nanny
        if nanny is not None and nanny in self._told:
            del self._told[nanny]
            try:
                await call(self.scheduler, nanny, restore_on_nanny)
            except OSError as error:
                logger.info("The nanny at %s is gone: %s", nanny, error)


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


class Reconciler:
    """Makes the book come true; part of the steward.

    Parameters
    ----------
    scheduler
        The scheduler.
    book
        Who is to be where.
    nannies
        What nannies were told.
    find_place
        Enters a worker into the book that joined and has no place there yet.
    """

    def __init__(
        self,
        scheduler: Any,
        book: Book,
        nannies: Nannies,
        find_place: Callable[[Seat], Awaitable[None]],
    ) -> None:
        self.scheduler, self.book, self.nannies = scheduler, book, nannies
        self._find_place = find_place
        self._declared: dict[str, Resources] = {}  # {address: what the worker itself declares}
        self._tasks: dict[str, asyncio.Task[None]] = {}  # {address: work on that worker}

    def seat_at(self, address: str) -> Seat | None:
        """Seat of the worker at an address; None if there is no such worker."""
        worker = self.scheduler.workers.get(address)
        if worker is None:
            return None
        return self.book.seats[seat_key(worker.name, worker.address, worker.nanny)]

    def meet(self, worker: Any) -> None:
        """Note what a worker declares that has come."""
        self._declared[worker.address] = dict(worker.resources)

    def miss(self, address: str) -> None:
        """Do nothing more for a worker that has gone."""
        self._declared.pop(address, None)
        if task := self._tasks.pop(address, None):
            task.cancel()

    def is_under_way(self, seat: Seat) -> bool:
        """Whether something is being done for a worker."""
        return self._at_work(seat.info.address)

    def stop(self) -> None:
        """Do nothing more."""
        for task in self._tasks.values():
            task.cancel()
        self._tasks.clear()

    def settle(self, seats: Iterable[Seat]) -> None:
        """Have workers declare what the book says; `settled` tells when they do."""
        for seat in seats:
            if seat.absent_since is None:
                self._spawn(seat.info.address)

    def settled(self, seat: Seat) -> bool:
        """Whether a worker declares what the book says, also after a restart."""
        worker = self.scheduler.workers.get(seat.info.address)
        if worker is None:
            return False
        wanted = self.book.wanted(seat)
        return bool(
            worker.resources == wanted == self._declared[worker.address]
            and self.nannies.agrees(seat, wanted)
        )

    def _at_work(self, address: str) -> bool:
        # One that has ended is in the table until the event loop comes to its callback.
        task = self._tasks.get(address)
        return task is not None and not task.done()

    def _spawn(self, address: str) -> None:
        if self._at_work(address):  # it looks at the book again before it ends
            return
        task = asyncio.ensure_future(self._settle(address))
        self._tasks[address] = task
        task.add_done_callback(lambda task: self._settled(address, task))

    def _settled(self, address: str, task: asyncio.Task[None]) -> None:
        if self._tasks.get(address) is task:
            del self._tasks[address]
        if not task.cancelled() and (error := task.exception()):
            logger.error("The worker at %s is not in its partition", address, exc_info=error)

    async def _settle(self, address: str) -> None:
        seat, asked = self.seat_at(address), set[Any]()
        if seat and seat.unplaced:
            await self._find_place(seat)
        while (seat := self.seat_at(address)) and not self.settled(seat):
            try:
                await self._step(self.scheduler.workers[address], seat, asked)
            except OSError as error:  # it or its nanny is going, or the connection was bad
                logger.info("The worker at %s does not answer: %s", address, error)
                await asyncio.sleep(10 * LOOK_EVERY_S)
        # Somebody may have set the resource by hand before, which wakes nobody.
        if worker := self.scheduler.workers.get(address):
            wake(self.scheduler, worker)

    async def _step(self, worker: Any, seat: Seat, asked: set[Any]) -> None:
        """Bring a worker nearer to what the book says."""
        wanted, declared = self.book.wanted(seat), self._declared[worker.address]
        leaving = {name for name, slots in declared.items() if slots and name not in wanted}
        if leaving:
            # No new tasks; those that it has end here or move. It declares the resource as
            # long: a worker that gets a task for a resource it lacks breaks down.
            show(self.scheduler, worker, {**declared, **dict.fromkeys(leaving, 0)})
            hand_off(self.scheduler, worker, leaving, asked)
            if held_by(self.scheduler, worker, leaving):
                await asyncio.sleep(LOOK_EVERY_S)
                return
            trace("partition.drained", worker=worker.address, leaves=sorted(leaving))
        # First the nanny: a worker that dies right after would come back as it was.
        await self.nannies.tell(seat, wanted)
        trace("partition.nanny_told", worker=worker.address, declares=dict(wanted))
        if leaving:
            await send_barrier(self.scheduler, worker.address)
        done = await call(
            self.scheduler,
            worker.address,
            declare_on_worker,
            resources=wanted,
            after_barrier=bool(leaving),
        )
        if not done:
            return
        if self.scheduler.workers.get(worker.address) is not worker:
            return
        self._declared[worker.address] = dict(wanted)
        trace("partition.worker_told", worker=worker.address, declares=dict(wanted))
        if self.book.wanted(seat) == wanted:
            show(self.scheduler, worker, wanted)
            self._recount(leaving)

    def _recount(self, names: Collection[str]) -> None:
        """Count what is in use on those that took over tasks."""
        for name in names:
            for address in self.scheduler.resources.get(name, ()):
                recount(self.scheduler.workers[address])

    async def arrive(self, seats: Collection[Seat], timeout_s: float) -> list[Seat]:
        """Wait until workers declare what the book says; returns those that do not in time.

        Those whose nanny is starting them again are waited for; those that have left are not.
        """
        self.settle(seats)
        deadline = time.monotonic() + timeout_s
        while late := [seat for seat in seats if seat.holds and not self.settled(seat)]:
            if time.monotonic() >= deadline:
                break
            await asyncio.sleep(LOOK_EVERY_S)
        return late

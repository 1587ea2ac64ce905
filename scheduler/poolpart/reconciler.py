"""Having workers declare what the scheduler's book says.

What each worker declares is compared with the book, and changed in small steps that can be cut
off anywhere: a worker or its nanny may die between any two of them.

The scheduler's request to declare other resources goes by another connection than the tasks
that it sends, and may arrive first. A task that was sent and cancelled at once is forgotten by
the scheduler while it is on its way; a worker that gets a task for a resource which it does not
declare breaks down. So a barrier is sent behind the tasks, and the worker waits for it.
"""

from __future__ import annotations

import asyncio
import logging
import time
import uuid
from collections.abc import Awaitable, Callable, Collection, Iterable
from typing import Any

from .book import Book, Resources, Seat, seat_key
from .nannies import Nannies
from .placing import hand_off, held_by, recount, show, wake
from .remote import call
from .tracing import trace

logger = logging.getLogger(__name__)

LOOK_EVERY_S = 0.01

_HELD_S = 1.0  # how long a worker waits for tasks to give a resource back
_BARRIER = "poolpart-barrier"


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


# -- on the worker, but for the first --------------------------------------------------


async def send_barrier(scheduler: Any, address: str) -> None:
    """Send a barrier behind all messages to a worker; runs on the scheduler.

    Raises
    ------
    OSError
        If the worker does not answer.
    """
    number = uuid.uuid4().hex
    await call(scheduler, address, _await_barrier, number=number)
    if address in scheduler.stream_comms:
        scheduler.worker_send(address, {"op": _BARRIER, "number": number})


def _is_awaited(worker: Any) -> bool:
    """Whether a barrier is still on its way; runs on the worker."""
    return _BARRIER in worker.stream_handlers


def _await_barrier(number: str, dask_worker: Any = None) -> None:
    awaited = number

    def arrive(number: str) -> None:
        # Barriers arrive in the order in which they were sent: behind this one there is none.
        if number == awaited:
            del dask_worker.stream_handlers[_BARRIER]

    dask_worker.stream_handlers[_BARRIER] = arrive


async def declare_on_worker(
    resources: Resources, after_barrier: bool = False, dask_worker: Any = None
) -> bool:
    """Declare these resources and no others; runs on a worker.

    Parameters
    ----------
    resources
        What to declare.
    after_barrier
        Whether to wait for what the scheduler has sent before.

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
    for _ in range(int(_HELD_S / 0.01)):
        held = any(available[name] < total[name] for name in leaving)
        if not held and not (after_barrier and _is_awaited(dask_worker)):
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

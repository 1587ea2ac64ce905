"""Keeps workers in their partitions; a plugin of the scheduler.

It lives on the scheduler, so what was divided stays divided when the client has gone. It
compares what each worker declares with what the book says, and makes it so, in small steps
that can be cut off anywhere: a worker or its nanny may die between any two of them.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager
from typing import Any

from distributed.diagnostics.plugin import SchedulerPlugin
from tornado.ioloop import PeriodicCallback

from .adapting import Adapting
from .book import Book, Resources, Seat, seat_key
from .calls import call
from .nannies import Nannies, has_gone
from .placing import hand_off, held_by, recount, show, wake
from .probe import probe_worker
from .rebalancing import Rebalancing
from .restarts import declare_on_worker
from .rules import PerGpu, partition_for
from .tracing import trace
from .vacancies import successor, vacated
from .worker_info import WorkerInfo

logger = logging.getLogger(__name__)

NAME = "poolpart-steward"
LOOK_EVERY_S = 0.01
TICK_S = 0.1


class Steward(SchedulerPlugin):
    """Makes the book come true.

    Parameters
    ----------
    scheduler
        The scheduler that it is a plugin of.
    """

    name = NAME

    def __init__(self, scheduler: Any) -> None:
        self.scheduler = scheduler
        self.book = Book()
        self.asked = 0  # questions of clients that are being answered
        self.rebalancing = Rebalancing(scheduler, self.book, self.settle, self.settled)
        self.adapting = Adapting(scheduler, self.book)
        self.adapting.install()
        self._looked_at: Any = None  # rules and members when nobody wanted those without a place
        self._resources_before = set(scheduler.resources)
        self._declared: dict[str, Resources] = {}  # {address: what the worker itself declares}
        self.nannies = Nannies(scheduler)
        self._tasks: dict[str, asyncio.Task[None]] = {}  # {address: settling of that worker}
        self._missed: set[asyncio.Task[None]] = set()  # looks whether workers come back
        for worker in scheduler.workers.values():
            self._seat(worker)
        self._ticker = PeriodicCallback(self._tick, 1000 * TICK_S)
        self._ticker.start()

    # -- who is there ------------------------------------------------------------------

    def seat_at(self, address: str) -> Seat | None:
        """Seat of the worker at an address; None if there is no such worker."""
        worker = self.scheduler.workers.get(address)
        if worker is None:
            return None
        return self.book.seats[seat_key(worker.name, worker.address, worker.nanny)]

    def _seat(self, worker: Any) -> Seat:
        """Seat of a worker that has come, or come back."""
        self._declared[worker.address] = dict(worker.resources)
        key = seat_key(worker.name, worker.address, worker.nanny)
        seat = self.book.seats.get(key)
        gpus = seat.info.gpus if seat else ()
        info = WorkerInfo.from_identity(worker.address, worker.identity(), gpus)
        if seat is None:
            seat = self.book.seats[key] = Seat(key, info, dict(worker.resources))
        elif worker.nanny is None or worker.nanny != seat.nanny:
            # Somebody has started another worker under this name.
            seat.found = dict(worker.resources)
            if seat.nanny is not None:
                self.nannies.forget(seat.nanny)
        seat.info, seat.nanny = info, worker.nanny
        seat.absent_since, seat.given_up = None, False
        return seat

    def add_worker(self, scheduler: Any, worker: str) -> None:
        """Give a worker that joins its partition: its own, the one it declares, or by rule."""
        known = {s.key for s in self.book.seats.values() if s.holds}
        seat = self._seat(scheduler.workers[worker])
        if seat.key not in known:
            seat.joined = time.monotonic()
            declared = [name for name in self.book.rules if seat.found.get(name)]
            if declared:
                self.book.put(seat, declared[0], seat.found[declared[0]])
            elif not any(seat.found.values()):
                seat.partition, seat.unplaced = None, True
        self._spawn(worker)

    def remove_worker(self, scheduler: Any, worker: str, **kwargs: Any) -> None:
        """Note that a worker has left; its place is held for a while if it has a nanny."""
        self._declared.pop(worker, None)
        if task := self._tasks.pop(worker, None):
            task.cancel()
        for seat in self.book.seats.values():
            if seat.info.address == worker and seat.absent_since is None:
                seat.absent_since = time.monotonic()
                missed = asyncio.ensure_future(self._miss(seat))
                self._missed.add(missed)
                missed.add_done_callback(self._missed.discard)

    async def _miss(self, seat: Seat) -> None:
        """Give up the place of a worker whose nanny is gone as well, so that another has it."""
        absent_since = seat.absent_since
        while seat.absent_since == absent_since and seat.holds and seat.nanny is not None:
            await asyncio.sleep(10 * TICK_S)
            if await has_gone(nanny := seat.nanny) and seat.absent_since == absent_since:
                self.nannies.forget(nanny)
                seat.nanny = None

    def valid_workers_downscaling(self, scheduler: Any, workers: list[Any]) -> list[Any]:
        """Choose those that an adaptive cluster may stop."""
        return self.adapting.spare(workers)

    async def close(self) -> None:
        """Stop with the scheduler."""
        self.stop()

    def stop(self) -> None:
        """Do nothing more."""
        self._ticker.stop()
        self.adapting.uninstall()
        for task in (*self._tasks.values(), *self._missed):
            task.cancel()
        self._tasks.clear()

    def _tick(self) -> None:
        if not self.book.rules:
            self.remove_if_done()
            return
        self.rebalancing.look(time.monotonic())
        if any(seat.absent_since is not None for seat in self.book.seats.values()):
            for gone in vacated(self.book):
                self._pass_on(gone)
            self.book.forget(time.monotonic())
            self.nannies.forget_others({seat.nanny for seat in self.book.seats.values()})
        waiting = [s for s in self.book.seats.values() if s.unplaced and s.absent_since is None]
        if waiting:
            self._look_for_places(waiting)

    def _pass_on(self, gone: Seat) -> None:
        """Give the place of a worker to one that joined while it was kept."""
        if seat := successor(self.book, gone):
            self.book.put(seat, gone.partition)
            self.settle([seat])

    def _look_for_places(self, waiting: list[Seat]) -> None:
        """Place workers that nobody wanted: another may have gone for good since.

        Only when something has changed. To ask all rules for a thousand workers takes as long
        as from one tick to the next.
        """
        book = self.book
        now = dict(book.rules), {n: [s.key for s in book.members(n)] for n in book.rules}
        if now == self._looked_at:
            return
        seats = [seat for seat in waiting if seat.info.address not in self._tasks]
        self.settle([seat for seat in seats if self._place(seat)])
        # Those that are on their way look for themselves, perhaps before what has changed.
        self._looked_at = now if len(seats) == len(waiting) else None

    # -- making it so ------------------------------------------------------------------

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

    def _spawn(self, address: str) -> None:
        if address in self._tasks:  # it looks at the book again before it ends
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
            await self._ask_for_gpus(seat)
            if seat.unplaced:
                self._place(seat)
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
        if not await call(self.scheduler, worker.address, declare_on_worker, resources=wanted):
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

    # -- by rule -----------------------------------------------------------------------

    async def _ask_for_gpus(self, seat: Seat) -> None:
        if not any(isinstance(rule, PerGpu) for rule in self.book.rules.values()):
            return
        try:
            facts = await call(self.scheduler, seat.info.address, probe_worker)
        except OSError as error:
            logger.warning("Worker %s cannot tell about its GPUs: %s", seat.info.name, error)
            return
        seat.info = seat.info.with_gpus(facts["gpus"])

    def _place(self, seat: Seat) -> bool:
        """Find a partition for a worker that has none; whether there is one."""
        name = partition_for(seat.info, self.book.rules, self.book.groups())
        if name is not None:
            self.book.put(seat, name)
        return name is not None

    # -- the end -----------------------------------------------------------------------

    def _at_rest(self, seat: Seat) -> bool:
        """Whether nothing is left to do for a worker, or its nanny, which may start it again."""
        if seat.absent_since is None:
            return self.settled(seat)
        return not seat.holds or not self.nannies.was_told(seat)

    def remove_if_done(self) -> None:
        """Leave the scheduler, once there are no partitions and all workers are as they were."""
        if self.book.rules or self.asked or not all(map(self._at_rest, self.book.seats.values())):
            return
        self.stop()
        for name in self.book.names - self._resources_before:
            if not self.scheduler.resources.get(name, True):
                del self.scheduler.resources[name]
        if self.scheduler.plugins.get(NAME) is self:
            self.scheduler.remove_plugin(NAME)


@contextmanager
def steward_of(scheduler: Any) -> Iterator[Steward]:
    """Give the scheduler's steward, a new one if need be; one without partitions goes at once."""
    steward: Steward | None = scheduler.plugins.get(NAME)
    if steward is None:
        steward = Steward(scheduler)
        scheduler.add_plugin(steward)
    steward.asked += 1
    try:
        yield steward
    finally:
        steward.asked -= 1
        steward.remove_if_done()

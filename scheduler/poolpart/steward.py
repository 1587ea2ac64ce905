"""Keeps workers in their partitions; a plugin of the scheduler.

It lives on the scheduler, so what was divided stays divided when the client has gone. It enters
into the book who comes and goes, and `reconciler.py` makes the book come true.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Coroutine, Iterator
from contextlib import contextmanager
from typing import Any

from distributed.diagnostics.plugin import SchedulerPlugin
from tornado.ioloop import PeriodicCallback

from .book import Book, Seat, seat_key
from .internals import call, forget_resources
from .probe import probe_worker
from .reconciler import Nannies, Reconciler, has_gone
from .rules import PerGpu, partition_for
from .worker_info import WorkerInfo

logger = logging.getLogger(__name__)

NAME = "poolpart-steward"
TICK_S = 0.1


class Steward(SchedulerPlugin):
    """Keeps the book.

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
        self.nannies = Nannies(scheduler)
        self.reconciler = Reconciler(scheduler, self.book, self.nannies, self._find_place)
        self._looked_at: Any = None  # rules and members when nobody wanted those without a place
        self._resources_before = set(scheduler.resources)
        self._work: set[asyncio.Task[None]] = set()  # else it might be collected
        for worker in scheduler.workers.values():
            self._seat(worker)
        self._ticker = PeriodicCallback(self._tick, 1000 * TICK_S)
        self._ticker.start()

    # -- who is there ------------------------------------------------------------------

    def _seat(self, worker: Any) -> Seat:
        """Seat of a worker that has come, or come back."""
        self.reconciler.meet(worker)
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
        seat.absent_since = None
        return seat

    def add_worker(self, scheduler: Any, worker: str) -> None:
        """Give a worker that joins its partition: its own, the one it declares, or by rule."""
        known = {s.key for s in self.book.seats.values() if s.holds}
        seat = self._seat(scheduler.workers[worker])
        if seat.key not in known:
            declared = [name for name in self.book.rules if seat.found.get(name)]
            if declared:
                self.book.put(seat, declared[0], seat.found[declared[0]])
            elif not any(seat.found.values()):
                seat.partition, seat.unplaced = None, True
        self.reconciler.settle([seat])

    def remove_worker(self, scheduler: Any, worker: str, **kwargs: Any) -> None:
        """Note that a worker has left; its place is held for a while if it has a nanny."""
        self.reconciler.miss(worker)
        for seat in self.book.seats.values():
            if seat.info.address == worker and seat.absent_since is None:
                seat.absent_since = time.monotonic()
                self._begin(self._miss(seat))

    def _begin(self, work: Coroutine[Any, Any, None]) -> None:
        task = asyncio.ensure_future(work)
        self._work.add(task)
        task.add_done_callback(self._work.discard)

    async def _miss(self, seat: Seat) -> None:
        """Give up the place of a worker whose nanny is gone as well, so that another has it."""
        nanny, absent_since = seat.nanny, seat.absent_since
        while nanny is not None and seat.holds:
            await asyncio.sleep(10 * TICK_S)
            gone = await has_gone(nanny)
            if seat.absent_since != absent_since:  # it has come back
                return
            if gone:
                self.nannies.forget(nanny)
                seat.nanny = None

    def valid_workers_downscaling(self, scheduler: Any, workers: list[Any]) -> list[Any]:
        """Choose those that an adaptive cluster may stop: each partition keeps its minimum."""
        may_stop = {worker.address: worker for worker in workers}
        for name, rule in self.book.rules.items():
            members = self.book.members(name, present=True)
            offered = [m.info.address for m in members if m.info.address in may_stop]
            # The busiest stay.
            offered.sort(key=lambda address: -len(may_stop[address].processing))
            for address in offered[: max(0, rule.minimum - (len(members) - len(offered)))]:
                del may_stop[address]
        return list(may_stop.values())

    async def close(self) -> None:
        """Stop with the scheduler."""
        self.stop()

    def stop(self) -> None:
        """Do nothing more."""
        self._ticker.stop()
        self.reconciler.stop()
        for task in self._work:
            task.cancel()

    def _tick(self) -> None:
        if not self.book.rules:
            self.remove_if_done()
            return
        if any(seat.absent_since is not None for seat in self.book.seats.values()):
            self.book.forget(time.monotonic())
            self.nannies.forget_others({seat.nanny for seat in self.book.seats.values()})
        waiting = [s for s in self.book.seats.values() if s.unplaced and s.absent_since is None]
        if waiting:
            self._look_for_places(waiting)

    def _look_for_places(self, waiting: list[Seat]) -> None:
        """Place workers that nobody wanted: another may have gone for good since.

        Only when something has changed. To ask all rules for a thousand workers takes as long
        as from one tick to the next.
        """
        book = self.book
        now = dict(book.rules), {n: [s.key for s in book.members(n)] for n in book.rules}
        if now == self._looked_at:
            return
        seats = [seat for seat in waiting if not self.reconciler.is_under_way(seat)]
        self.reconciler.settle([seat for seat in seats if self._place(seat)])
        # Those that are on their way look for themselves, perhaps before what has changed.
        self._looked_at = now if len(seats) == len(waiting) else None

    # -- by rule -----------------------------------------------------------------------

    async def _find_place(self, seat: Seat) -> None:
        """Place a worker that has joined."""
        await self._ask_for_gpus(seat)
        if seat.unplaced:
            self._place(seat)

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
            return self.reconciler.settled(seat)
        # One that takes longer comes as it was: its nanny is asked once more before.
        return not (seat.holds and self.nannies.was_told(seat))

    def remove_if_done(self) -> None:
        """Leave the scheduler, once there are no partitions and all workers are as they were."""
        if self.book.rules or self.asked or not all(map(self._at_rest, self.book.seats.values())):
            return
        self.stop()
        for seat in self.book.seats.values():
            if self.nannies.was_told(seat):
                self._begin(self.nannies.restore(seat))
        forget_resources(self.scheduler, self.book.names - self._resources_before)
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

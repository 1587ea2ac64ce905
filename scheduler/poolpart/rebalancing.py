"""Lending idle workers of one partition to another that has more than it can do."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import islice
from typing import Any

from .book import Book, Seat
from .placing import asks_for
from .reconciler import Reconciler

# Longer than an idle worker waits to be lent: whoever submits may need a moment to notice it,
# and a worker that goes back and forth is of no use to anybody.
SETTLE_IN_S = 2.0


@dataclass(frozen=True)
class Help:
    """Idle workers of one partition help another, and go back when they are needed.

    Parameters
    ----------
    lender, borrower
        The partitions.
    idle_s
        Seconds after which a worker without tasks counts as idle.
    """

    lender: str
    borrower: str
    idle_s: float


class Rebalancing:
    """Applies rules of help over and over; part of the steward.

    Parameters
    ----------
    scheduler
        The scheduler.
    book
        Who is where; changed here.
    reconciler
        Has workers follow the book.
    """

    def __init__(self, scheduler: Any, book: Book, reconciler: Reconciler) -> None:
        self.scheduler, self.book, self.reconciler = scheduler, book, reconciler
        self.helps: dict[tuple[str, str], Help] = {}
        self._idle_since: dict[str, float] = {}  # {address: when it was first seen idle}

    def add(self, rule: Help) -> None:
        """Follow a rule from now on; it replaces one for the same partitions."""
        self.helps[rule.lender, rule.borrower] = rule

    def drop(self, lender: str, borrower: str) -> list[Seat]:
        """Follow a rule no more; returns the workers that go back."""
        self.helps.pop((lender, borrower), None)
        # Also those whose nanny is starting them again: they would stay for good.
        lent = [seat for seat in self.book.members(borrower) if seat.home == lender]
        self._give_back(lent)
        return lent

    def drop_all(self, name: str) -> None:
        """Follow no rule any more that has to do with a partition."""
        for lender, borrower in list(self.helps):
            if name in (lender, borrower):
                self.drop(lender, borrower)

    def look(self, now: float) -> None:
        """Lend and give back what should be by now."""
        if not self.helps:
            return
        self._watch(now)
        for rule in list(self.helps.values()):
            lent = self._lent(rule.lender, rule.borrower)
            if needed := self.backlog(rule.lender):
                self._give_back(sorted(lent, key=self._load)[:needed])
            elif more := self.backlog(rule.borrower):
                self._lend(rule, more, now)
            else:
                patience = rule.idle_s + SETTLE_IN_S
                self._give_back([seat for seat in lent if self._idle(seat, patience, now)])

    def backlog(self, name: str) -> int:
        """Tasks of a partition that wait for a slot of it.

        Where it has none at all, no more are counted than there are workers that might help.
        """
        waiting = 0
        members = [
            self.scheduler.workers[seat.info.address]
            for seat in self.book.members(name, present=True)
        ]
        for worker in members:
            busy = len(worker.processing) - len(worker.long_running)
            waiting += max(0, busy - int(worker.resources.get(name, 0)))
        if not any(worker.resources.get(name) for worker in members):
            # Ten times a second; there may be a hundred thousand.
            mine = (task for task in self.scheduler.unrunnable if asks_for(task, [name]))
            waiting += sum(1 for _ in islice(mine, len(self.scheduler.workers)))
        return waiting

    def _watch(self, now: float) -> None:
        workers = self.scheduler.workers
        busy = {address for address, worker in workers.items() if worker.processing}
        self._idle_since = {
            address: self._idle_since.get(address, now) for address in workers.keys() - busy
        }

    def _idle(self, seat: Seat, seconds: float, now: float) -> bool:
        return now - self._idle_since.get(seat.info.address, now) >= seconds

    def _load(self, seat: Seat) -> int:
        return len(self.scheduler.workers[seat.info.address].processing)

    def _lent(self, lender: str, borrower: str) -> list[Seat]:
        return [s for s in self.book.members(borrower, present=True) if s.home == lender]

    def _lend(self, rule: Help, most: int, now: float) -> None:
        # Not those on their way: they may turn back.
        members = [
            s for s in self.book.members(rule.lender, present=True) if self.reconciler.settled(s)
        ]
        spare = max(0, len(members) - self.book.rules[rule.lender].minimum)
        # A worker that is itself lent goes home first.
        idle = [s for s in members if s.home is None and self._idle(s, rule.idle_s, now)]
        chosen = idle[: min(spare, most)]
        for seat in chosen:
            self.book.put(seat, rule.borrower)
            seat.home = rule.lender
            # The new member starts with a clean record, else it would be idle at once.
            self._idle_since.pop(seat.info.address, None)
        self.reconciler.settle(chosen)

    def _give_back(self, seats: list[Seat]) -> None:
        for seat in seats:
            self.book.put(seat, seat.home)
        self.reconciler.settle(seats)

"""Membership of workers in partitions: the only record of it, a plugin of the scheduler.

The steward has the rules by partition, and a seat for each worker with the worker's partition.
Requests of clients (`division.py`) and workers that join and leave change it. After any change,
one loop for each worker (`Steward._settle`) synchronizes three things with the seat:

1. the resources that the worker declares, which its tasks must find there;
2. the resources that the scheduler places tasks by: removed before a worker leaves a partition,
   so that it gets no more of its tasks, and added only when the worker has declared them;
3. the workers behind a fence, from the moment of the change. A fence keeps all tasks that do not
   ask for an exclusive partition off the partition's workers (`fence.py`).

Nannies are not modified: a restarted worker declares its original resources, joins, and is settled
again. So the loop may be interrupted anywhere, and dissolving leaves nothing behind.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Collection, Hashable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

from distributed.diagnostics.plugin import SchedulerPlugin

from .choosing import note_change
from .errors import PoolError
from .fence import expect
from .internals.names import DIVIDING, require
from .internals.scheduler import Resources, call, hand_off, held_by, recount, show, wake
from .internals.worker import declare_on_worker
from .probe import worker_gpus
from .rules import Rule, n_workers, partition_for, per_gpu, rest
from .workers import WorkerInfo

logger = logging.getLogger(__name__)

NAME = "poolpart-steward"
HOLD_S = 30.0  # time in seconds for which the seat of a worker that its nanny restarts is kept
LOOK_EVERY_S = 0.01
_ASSIGN_EVERY_S = 0.1  # applying all rules to a thousand workers takes as long


@dataclass(eq=False)
class Seat:
    """Partition and state of a worker, also while the worker's nanny restarts the process."""

    key: Hashable  # identifies the worker (`seat_key`)
    info: WorkerInfo
    nanny: str | None = None  # its address
    original: Resources = field(default_factory=dict)  # resources that the worker was started with
    declared: Resources = field(default_factory=dict)  # resources at the worker's last reply
    is_declaring: bool = False  # a request to declare resources is under way
    partition: str | None = None
    # Partition that the worker was started in or that a rule chose for it. Moving a worker does not
    # change its home: another partition has only borrowed it.
    home: str | None = None
    slots: float = 0  # slots for the partition
    # It joined after the division, and the rules are to choose its partition: for the first time,
    # or again if it is in the remainder.
    unplaced: bool = False
    by_rule: bool = False  # it joined after the division, and the rules chose its partition
    away: bool = False  # it has left, and its nanny may be restarting it
    removed: bool = False  # it is no longer expected
    reconciler: asyncio.Task[None] | None = None  # loop `Steward._settle` of this worker
    giving_up: asyncio.TimerHandle | None = None  # removes the seat, while the worker is away


class Steward(SchedulerPlugin):
    """Keeps workers in their partitions, also when the client has gone."""

    name = NAME

    def __init__(self, scheduler: Any) -> None:
        self.scheduler = scheduler
        self.rules: dict[str, Rule] = {}  # {partition: its rule}, in the order of choosing
        self.seats: dict[Hashable, Seat] = {}  # {key: its seat}
        self.open_requests = 0  # requests of clients that are under way
        self._names: set[str] = set()  # all partitions so far, dissolved ones included
        self._assigning: asyncio.TimerHandle | None = None
        for worker in scheduler.workers.values():
            self._seat(worker)

    # -- membership --------------------------------------------------------------------

    def members(self, name: str, present: bool = False) -> list[Seat]:
        """Return the seats of a partition, or only the seats of present workers if `present`."""
        members = (seat for seat in self.seats.values() if seat.partition == name)
        return [seat for seat in members if not (present and seat.away)]

    def free(self) -> list[Seat]:
        """Return the seats of present workers without a partition or another resource."""
        return [
            seat
            for seat in self.seats.values()
            if not seat.away
            and not seat.partition
            and not any(self.target_resources(seat).values())
        ]

    def remainder(self) -> str | None:
        """Return the partition with the rule `rest`, or None."""
        return next((name for name, rule in self.rules.items() if isinstance(rule, rest)), None)

    def target_resources(self, seat: Seat) -> Resources:
        """Return the resources that a worker should declare.

        A worker without a partition declares what it was started with, except the resources of the
        present partitions: it is in none of these. A member of a partition declares the slots of
        this partition, and what it was started with, except the resource of any partition that
        there is or was: it is in a single partition.
        """
        if seat.partition is None:
            return {r: slots for r, slots in seat.original.items() if r not in self.rules}
        original = {r: slots for r, slots in seat.original.items() if r not in self._names}
        return {**original, seat.partition: seat.slots}

    def home(self, seat: Seat) -> str | None:
        """Return the existing partition that a worker goes back to, or None."""
        started_in = (name for name, slots in seat.original.items() if slots)
        return next((name for name in (seat.home, *started_in) if name in self.rules), None)

    def assign(self, seat: Seat, name: str | None, slots: float | None = None) -> None:
        """Put a worker into the partition that is its home from now on."""
        seat.home = name
        self.put(seat, name, slots)

    def put(self, seat: Seat, name: str | None, slots: float | None = None) -> None:
        """Record the partition of a worker or, with None, that the worker is in no partition.

        The worker is behind the fence of the partition, if any, from now on; `settle` does the
        rest. The number of slots is the first of these: `slots`, the slots of the rule, the slots
        of the partition that the worker was started with, the worker's threads.
        """
        seat.partition = name
        seat.slots = 0
        seat.unplaced = False
        seat.by_rule = False
        if name is not None:
            rule = self.rules[name]
            seat.slots = slots or rule.slots or seat.original.get(name) or rule.slots_of(seat.info)
        if worker := self.scheduler.workers.get(seat.info.address):
            expect(self.scheduler, worker, name)
        self._assign_soon()

    def enter(self, name: str, rule: Rule) -> None:
        """Add a partition or change its rule, and keep the partition with the rule `rest` last."""
        self._names.add(name)
        rules = {**self.rules, name: rule}.items()
        self.rules = dict(sorted(rules, key=lambda item: isinstance(item[1], rest)))

    def adopt(self, name: str) -> None:
        """Add a partition whose workers declared its resource before this division.

        Raises
        ------
        PoolError
            If the partition does not exist.
        """
        if name in self.rules:
            return
        members = [s for s in self.seats.values() if s.partition is None and s.original.get(name)]
        if not members:
            raise PoolError(
                f"There is no partition {name!r}. No worker declares this resource, and the "
                "partition was not created with `Pool.partition` or `Pool.divide`."
            )
        self.enter(name, Rule(minimum=0))
        for seat in members:
            self.assign(seat, name, seat.original[name])

    def resize(self, name: str | None, change: int) -> None:
        """Change the number of workers that the rule `n_workers` of a partition asks for.

        Partitions with another rule have no such number, and nothing is done.
        """
        if name in self.rules and isinstance(rule := self.rules[name], n_workers):
            workers = rule.workers + change
            self.rules[name] = replace(rule, workers=workers, minimum=min(rule.minimum, workers))

    # -- joining and leaving -----------------------------------------------------------

    def _seat(self, worker: Any) -> Seat:
        """Return the seat of a worker that has joined or returned, with the worker's new address.

        A new worker gets a new seat, without a partition.
        """
        key = seat_key(worker.name, worker.address, worker.nanny)
        info = WorkerInfo.from_identity(worker.address, worker.identity())
        seat = self.seats.setdefault(key, Seat(key, info))
        seat.info = info.with_gpus(seat.info.gpus)
        seat.nanny = worker.nanny
        seat.original = dict(worker.resources)
        seat.declared = dict(worker.resources)
        seat.away = False
        if seat.giving_up:
            seat.giving_up.cancel()
        return seat

    def add_worker(self, scheduler: Any, worker: str) -> None:
        """Assign a joining worker: to its former partition, a declared partition, or by rule."""
        former_keys = set(self.seats)
        seat = self._seat(scheduler.workers[worker])
        declared = [name for name in self.rules if seat.original.get(name)]
        if seat.key in former_keys:
            expect(scheduler, scheduler.workers[worker], seat.partition)
        elif declared:
            self.assign(seat, declared[0], seat.original[declared[0]])
        else:
            seat.unplaced = not any(seat.original.values())
        self.settle([seat])

    def remove_worker(self, scheduler: Any, worker: str, **kwargs: Any) -> None:
        """Record that a worker has left, and keep the seat of a worker with a nanny for a while."""
        for seat in list(self.seats.values()):
            if seat.info.address == worker and not seat.away:
                seat.away = True
                if seat.reconciler:
                    seat.reconciler.cancel()
                    seat.reconciler = None
                loop = asyncio.get_running_loop()
                seat.giving_up = loop.call_later(HOLD_S if seat.nanny else 0, self._give_up, seat)

    def _give_up(self, seat: Seat) -> None:
        """Remove the seat of a worker that has not returned in time, and fill its place by rule.

        Also of a present worker that cannot declare resources. Members of the remainder that joined
        by rule are assigned again.
        """
        seat.removed = True
        del self.seats[seat.key]
        # A worker that was started as a replacement has joined before, and went to the rest.
        if remainder := self.remainder():
            for member in self.members(remainder):
                member.unplaced = member.by_rule
        self._assign_soon()
        self.remove_if_done()

    def valid_workers_downscaling(self, scheduler: Any, workers: list[Any]) -> list[Any]:
        """Choose workers that an adaptive cluster may stop: each partition keeps its minimum."""
        may_stop = {worker.address: worker for worker in workers}
        for name, rule in self.rules.items():
            members = self.members(name, present=True)
            offered = [m.info.address for m in members if m.info.address in may_stop]
            # The busiest stay.
            offered.sort(key=lambda address: -len(may_stop[address].processing))
            for address in offered[: max(0, rule.minimum - (len(members) - len(offered)))]:
                del may_stop[address]
        return list(may_stop.values())

    # -- assigning workers that join ---------------------------------------------------

    def _assign_soon(self) -> None:
        """Assign unplaced workers in `_ASSIGN_EVERY_S`: rules or members have changed."""
        if self._assigning is None:
            loop = asyncio.get_running_loop()
            self._assigning = loop.call_later(_ASSIGN_EVERY_S, self._assign_waiting)

    def _assign_waiting(self) -> None:
        """Assign all present unplaced workers that have listed their GPUs."""
        self._assigning = None
        waiting = [s for s in self.seats.values() if s.unplaced and not s.away]
        # Other workers are still asked for their GPUs, and are assigned after their answer.
        ready = [s for s in waiting if s.reconciler and s.reconciler.done()]
        self.settle([seat for seat in ready if self._assign(seat)])

    def _assign(self, seat: Seat) -> bool:
        """Assign an unplaced worker by the rules, and return whether its partition changes."""
        groups = {name: [member.info for member in self.members(name)] for name in self.rules}
        name = partition_for(seat.info, self.rules, groups)
        if moves := name not in (None, seat.partition):
            self.assign(seat, name)
            seat.by_rule = True
        seat.unplaced = name is None
        return moves

    async def _ask_for_gpus(self, seat: Seat) -> None:
        """Record the GPUs of a worker, if a rule depends on GPUs."""
        if not any(isinstance(rule, per_gpu) for rule in self.rules.values()):
            return
        try:
            gpus = await call(self.scheduler, seat.info.address, worker_gpus)
        except OSError as error:
            logger.warning("Worker %s cannot list its GPUs: %s", seat.info.name, error)
            return
        seat.info = seat.info.with_gpus(gpus)

    # -- reconciling workers --------------------------------------------------------------

    def settled(self, seat: Seat) -> bool:
        """Return whether a worker declares its target resources and the scheduler knows."""
        worker = self.scheduler.workers.get(seat.info.address)
        if worker is None or seat.is_declaring:
            return False
        return bool(worker.resources == seat.declared == self.target_resources(seat))

    def settle(self, seats: Iterable[Seat]) -> None:
        """Have workers declare their target resources, until `settled` is True for them."""
        for seat in seats:
            # A running loop checks the seat again before it ends.
            if not seat.away and (seat.reconciler is None or seat.reconciler.done()):
                seat.reconciler = asyncio.ensure_future(self._settle(seat, seat.info.address))
                seat.reconciler.add_done_callback(partial(self._ended, seat))

    def _ended(self, seat: Seat, task: asyncio.Task[None]) -> None:
        """Remove the seat of a worker that cannot declare resources, and leave if all is done."""
        if not (task.cancelled() or seat.away) and (error := task.exception()):
            logger.error("Worker %s cannot be assigned to a partition: %r", seat.info.name, error)
            self.put(seat, None)
            self._give_up(seat)  # the worker may lack this package; absent workers keep their seat
        self.remove_if_done()

    async def _settle(self, seat: Seat, address: str) -> None:
        """Have a worker declare its target resources, in as many steps as its tasks require."""
        if seat.unplaced:
            await self._ask_for_gpus(seat)
            if seat.unplaced:
                self._assign(seat)
        requested_moves: set[Any] = set()  # tasks that the worker was asked to give up
        while (worker := self.scheduler.workers.get(address)) and not self.settled(seat):
            try:
                if not await self._step(seat, worker, requested_moves):
                    await asyncio.sleep(LOOK_EVERY_S)
            except OSError as error:  # the worker is leaving, or the connection was bad
                logger.info("The worker at %s does not respond: %s", address, error)
                await asyncio.sleep(10 * LOOK_EVERY_S)
        # `show` does not start the tasks that have waited for a worker with these resources.
        if worker:
            wake(self.scheduler, worker)

    async def _step(self, seat: Seat, worker: Any, requested_moves: set[Any]) -> bool:
        """Let a worker declare its target resources, or return False if its tasks must end first.

        The worker refuses while it runs a task that holds a resource to be removed, also a task
        that the scheduler has forgotten.
        """
        target = self.target_resources(seat)
        leaving = {name for name, slots in seat.declared.items() if slots and name not in target}
        if leaving and not self._has_released(seat, worker, leaving, requested_moves):
            return False
        seat.is_declaring = True
        try:
            accepted = await call(
                self.scheduler, worker.address, declare_on_worker, resources=target
            )
        finally:
            seat.is_declaring = False
        if not accepted:
            return False
        if self.scheduler.workers.get(worker.address) is worker:
            seat.declared = target
            if self.target_resources(seat) == target:
                self._show(seat, worker, target)
                # Other members may have taken over tasks, whose slots Dask counts wrongly.
                for name in leaving:
                    for address in self.scheduler.resources.get(name, ()):
                        recount(self.scheduler.workers[address])
        return True

    def _has_released(
        self, seat: Seat, worker: Any, leaving: Collection[str], requested_moves: set[Any]
    ) -> bool:
        """Move the tasks of partitions that a worker leaves, and return whether none is left.

        The worker gets no new tasks of these partitions. Tasks that run end on the worker, which
        keeps the resource until then.
        """
        remaining = {name: slots for name, slots in seat.declared.items() if name not in leaving}
        self._show(seat, worker, remaining)
        hand_off(self.scheduler, worker, leaving, requested_moves)
        return not held_by(self.scheduler, worker, leaving)

    def _show(self, seat: Seat, worker: Any, resources: Resources) -> None:
        """Let the scheduler place tasks by the given resources of a worker only.

        Also renew the group of workers that `choosing.py` compares, and the worker's fence.
        """
        show(self.scheduler, worker, resources)
        note_change(self.scheduler)
        expect(self.scheduler, worker, seat.partition)

    async def arrive(self, seats: Collection[Seat], timeout_s: float) -> list[Seat]:
        """Wait until workers declare their target resources, and return the late workers.

        Restarting workers are waited for; workers that have left for good are not.
        """
        self.settle(seats)
        deadline = time.monotonic() + timeout_s
        while late := [seat for seat in seats if not seat.removed and not self.settled(seat)]:
            if time.monotonic() >= deadline:
                break
            await asyncio.sleep(LOOK_EVERY_S)
        return late

    # -- the end -----------------------------------------------------------------------

    async def close(self) -> None:
        """Stop with the scheduler."""
        self._stop()

    def _stop(self) -> None:
        """Cancel all timers and loops."""
        scheduled: list[asyncio.TimerHandle | asyncio.Task[None] | None] = [self._assigning]
        for seat in self.seats.values():
            scheduled += [seat.reconciler, seat.giving_up]
        for task in scheduled:
            if task is not None:
                task.cancel()

    def remove_if_done(self) -> None:
        """Leave the scheduler after the last partition, once all workers are restored."""
        present = [seat for seat in self.seats.values() if not seat.away]
        if not self.rules and not self.open_requests and all(map(self.settled, present)):
            self._stop()
            if self.scheduler.plugins.get(NAME) is self:
                self.scheduler.remove_plugin(NAME)


def seat_key(name: Hashable, address: str, nanny: str | None) -> Hashable:
    """Return a key of a worker that outlives restarts: its name or else its nanny's address.

    The default name is the address, which changes with a restart. Names are not converted: to
    Dask 0, from `LocalCluster`, and "0", from a command line, are two workers.
    """
    return name if name != address else nanny or address


def names_of(seats: Iterable[Seat]) -> str:
    """Return the names of workers, for messages."""
    return ", ".join(sorted(seat.info.name for seat in seats))


def names_with_rule(scheduler: Any) -> frozenset[str]:
    """Return the names of the partitions that a division has made."""
    steward: Steward | None = scheduler.plugins.get(NAME)
    return frozenset() if steward is None else frozenset(steward.rules)


def target_of(scheduler: Any, name: str) -> int | None:
    """Return the number of workers that the rule of a partition asks for.

    None if it has no rule, or its rule has no such number.
    """
    steward: Steward | None = scheduler.plugins.get(NAME)
    rule = steward.rules.get(name) if steward is not None else None
    return rule.target if rule is not None else None


@contextmanager
def steward_of(scheduler: Any) -> Iterator[Steward]:
    """Yield the scheduler's steward, which leaves after the block if it has no partitions."""
    require(DIVIDING)
    steward: Steward | None = scheduler.plugins.get(NAME)
    if steward is None:
        steward = Steward(scheduler)
        scheduler.add_plugin(steward)
    steward.open_requests += 1
    try:
        yield steward
    finally:
        steward.open_requests -= 1
        steward.remove_if_done()

"""Membership of workers in partitions: the only record of it, a plugin of the scheduler.

The steward has the rules by partition, and a record for each worker with the worker's partition.
Requests of clients (`division.py`) and workers that join and leave change it. After any change,
one loop for each worker (`Steward._settle`) synchronizes three things with the record:

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

from .choosing import invalidate_groups
from .errors import PoolError
from .fence import set_expected_partition
from .internals.names import DIVIDING, require
from .internals.scheduler import (
    Resources,
    call_worker,
    hand_off_tasks,
    keys_held_by,
    recount_used_resources,
    send_waiting_tasks,
    set_visible_resources,
)
from .internals.worker import declare_on_worker
from .probe import worker_gpus
from .rules import Rule, n_workers, partition_for, per_gpu, rest
from .workers import WorkerInfo

logger = logging.getLogger(__name__)

NAME = "poolpart-steward"
HOLD_S = 30.0  # time in seconds for which the record of a worker that its nanny restarts is kept
LOOK_EVERY_S = 0.01
_ASSIGN_EVERY_S = 0.1  # applying all rules to a thousand workers takes as long


@dataclass(eq=False)
class WorkerRecord:
    """Partition and state of a worker, also while the worker's nanny restarts the process."""

    key: Hashable  # identifies the worker (`worker_key`)
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
    is_unassigned: bool = False
    assigned_by_rule: bool = (
        False  # it joined after the division, and the rules chose its partition
    )
    is_absent: bool = False  # it has left, and its nanny may be restarting it
    is_removed: bool = False  # it is no longer expected
    reconciliation: asyncio.Task[None] | None = None  # loop `Steward._settle` of this worker
    removal_timer: asyncio.TimerHandle | None = None  # removes the record, while the worker is away


class Steward(SchedulerPlugin):
    """Keeps workers in their partitions, also when the client has gone."""

    name = NAME

    def __init__(self, scheduler: Any) -> None:
        self.scheduler = scheduler
        self.rules: dict[str, Rule] = {}  # {partition: its rule}, in the order of choosing
        self.records: dict[Hashable, WorkerRecord] = {}  # {key: its record}
        self.open_requests = 0  # requests of clients that are under way
        self._names: set[str] = set()  # all partitions so far, dissolved ones included
        self._assigning: asyncio.TimerHandle | None = None
        for worker in scheduler.workers.values():
            self._add_record(worker)

    # -- membership --------------------------------------------------------------------

    def members(self, name: str, present: bool = False) -> list[WorkerRecord]:
        """Return the records of a partition, or only the records of present workers if `present`."""
        members = (record for record in self.records.values() if record.partition == name)
        return [record for record in members if not (present and record.is_absent)]

    def free_records(self) -> list[WorkerRecord]:
        """Return the records of present workers without a partition or another resource."""
        return [
            record
            for record in self.records.values()
            if not record.is_absent
            and not record.partition
            and not any(self.target_resources(record).values())
        ]

    def remainder_name(self) -> str | None:
        """Return the partition with the rule `rest`, or None."""
        return next((name for name, rule in self.rules.items() if isinstance(rule, rest)), None)

    def target_resources(self, record: WorkerRecord) -> Resources:
        """Return the resources that a worker should declare.

        A worker without a partition declares what it was started with, except the resources of the
        present partitions: it is in none of these. A member of a partition declares the slots of
        this partition, and what it was started with, except the resource of any partition that
        there is or was: it is in a single partition.
        """
        if record.partition is None:
            return {r: slots for r, slots in record.original.items() if r not in self.rules}
        original = {r: slots for r, slots in record.original.items() if r not in self._names}
        return {**original, record.partition: record.slots}

    def home_of(self, record: WorkerRecord) -> str | None:
        """Return the existing partition that a worker goes back to, or None."""
        started_in = (name for name, slots in record.original.items() if slots)
        return next((name for name in (record.home, *started_in) if name in self.rules), None)

    def set_home(self, record: WorkerRecord, name: str | None, slots: float | None = None) -> None:
        """Put a worker into the partition that is its home from now on."""
        record.home = name
        self.set_partition(record, name, slots)

    def set_partition(
        self, record: WorkerRecord, name: str | None, slots: float | None = None
    ) -> None:
        """Record the partition of a worker or, with None, that the worker is in no partition.

        The worker is behind the fence of the partition, if any, from now on; `settle` does the
        rest. The number of slots is the first of these: `slots`, the slots of the rule, the slots
        of the partition that the worker was started with, the worker's threads.
        """
        record.partition = name
        record.slots = 0
        record.is_unassigned = False
        record.assigned_by_rule = False
        if name is not None:
            rule = self.rules[name]
            record.slots = (
                slots or rule.slots or record.original.get(name) or rule.slots_of(record.info)
            )
        if worker := self.scheduler.workers.get(record.info.address):
            set_expected_partition(self.scheduler, worker, name)
        self._assign_soon()

    def set_rule(self, name: str, rule: Rule) -> None:
        """Add a partition or change its rule, and keep the partition with the rule `rest` last."""
        self._names.add(name)
        rules = {**self.rules, name: rule}.items()
        self.rules = dict(sorted(rules, key=lambda item: isinstance(item[1], rest)))

    def adopt_partition(self, name: str) -> None:
        """Add a partition whose workers declared its resource before this division.

        Raises
        ------
        PoolError
            If the partition does not exist.
        """
        if name in self.rules:
            return
        members = [s for s in self.records.values() if s.partition is None and s.original.get(name)]
        if not members:
            raise PoolError(
                f"There is no partition {name!r}. No worker declares this resource, and the "
                "partition was not created with `Pool.partition` or `Pool.divide`."
            )
        self.set_rule(name, Rule(minimum=0))
        for record in members:
            self.set_home(record, name, record.original[name])

    def change_target(self, name: str | None, change: int) -> None:
        """Change the number of workers that the rule `n_workers` of a partition asks for.

        Partitions with another rule have no such number, and nothing is done.
        """
        if name in self.rules and isinstance(rule := self.rules[name], n_workers):
            workers = rule.workers + change
            self.rules[name] = replace(rule, workers=workers, minimum=min(rule.minimum, workers))

    # -- joining and leaving -----------------------------------------------------------

    def _add_record(self, worker: Any) -> WorkerRecord:
        """Return the record of a worker that has joined or returned, with the worker's new address.

        A new worker gets a new record, without a partition.
        """
        key = worker_key(worker.name, worker.address, worker.nanny)
        info = WorkerInfo.from_identity(worker.address, worker.identity())
        record = self.records.setdefault(key, WorkerRecord(key, info))
        record.info = info.with_gpus(record.info.gpus)
        record.nanny = worker.nanny
        record.original = dict(worker.resources)
        record.declared = dict(worker.resources)
        record.is_absent = False
        if record.removal_timer:
            record.removal_timer.cancel()
        return record

    def add_worker(self, scheduler: Any, worker: str) -> None:
        """Assign a joining worker: to its former partition, a declared partition, or by rule."""
        former_keys = set(self.records)
        record = self._add_record(scheduler.workers[worker])
        declared = [name for name in self.rules if record.original.get(name)]
        if record.key in former_keys:
            set_expected_partition(scheduler, scheduler.workers[worker], record.partition)
        elif declared:
            self.set_home(record, declared[0], record.original[declared[0]])
        else:
            record.is_unassigned = not any(record.original.values())
        self.reconcile([record])

    def remove_worker(self, scheduler: Any, worker: str, **kwargs: Any) -> None:
        """Record that a worker has left, and keep the record of a worker with a nanny for a while."""
        for record in list(self.records.values()):
            if record.info.address == worker and not record.is_absent:
                record.is_absent = True
                if record.reconciliation:
                    record.reconciliation.cancel()
                    record.reconciliation = None
                loop = asyncio.get_running_loop()
                record.removal_timer = loop.call_later(
                    HOLD_S if record.nanny else 0, self._remove_record, record
                )

    def _remove_record(self, record: WorkerRecord) -> None:
        """Remove the record of a worker that has not returned in time, and fill its place by rule.

        Also of a present worker that cannot declare resources. Members of the remainder that joined
        by rule are assigned again.
        """
        record.is_removed = True
        del self.records[record.key]
        # A worker that was started as a replacement has joined before, and went to the rest.
        if remainder := self.remainder_name():
            for member in self.members(remainder):
                member.is_unassigned = member.assigned_by_rule
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
        waiting = [s for s in self.records.values() if s.is_unassigned and not s.is_absent]
        # Other workers are still asked for their GPUs, and are assigned after their answer.
        ready = [s for s in waiting if s.reconciliation and s.reconciliation.done()]
        self.reconcile([record for record in ready if self._assign(record)])

    def _assign(self, record: WorkerRecord) -> bool:
        """Assign an unplaced worker by the rules, and return whether its partition changes."""
        groups = {name: [member.info for member in self.members(name)] for name in self.rules}
        name = partition_for(record.info, self.rules, groups)
        if moves := name not in (None, record.partition):
            self.set_home(record, name)
            record.assigned_by_rule = True
        record.is_unassigned = name is None
        return moves

    async def _ask_for_gpus(self, record: WorkerRecord) -> None:
        """Record the GPUs of a worker, if a rule depends on GPUs."""
        if not any(isinstance(rule, per_gpu) for rule in self.rules.values()):
            return
        try:
            gpus = await call_worker(self.scheduler, record.info.address, worker_gpus)
        except OSError as error:
            logger.warning("Worker %s cannot list its GPUs: %s", record.info.name, error)
            return
        record.info = record.info.with_gpus(gpus)

    # -- reconciling workers --------------------------------------------------------------

    def is_settled(self, record: WorkerRecord) -> bool:
        """Return whether a worker declares its target resources and the scheduler knows."""
        worker = self.scheduler.workers.get(record.info.address)
        if worker is None or record.is_declaring:
            return False
        return bool(worker.resources == record.declared == self.target_resources(record))

    def reconcile(self, records: Iterable[WorkerRecord]) -> None:
        """Have workers declare their target resources, until `settled` is True for them."""
        for record in records:
            # A running loop checks the record again before it ends.
            if not record.is_absent and (
                record.reconciliation is None or record.reconciliation.done()
            ):
                record.reconciliation = asyncio.ensure_future(
                    self._reconcile(record, record.info.address)
                )
                record.reconciliation.add_done_callback(partial(self._ended, record))

    def _ended(self, record: WorkerRecord, task: asyncio.Task[None]) -> None:
        """Remove the record of a worker that cannot declare resources, and leave if all is done."""
        if not (task.cancelled() or record.is_absent) and (error := task.exception()):
            logger.error("Worker %s cannot be assigned to a partition: %r", record.info.name, error)
            self.set_partition(record, None)
            self._remove_record(
                record
            )  # the worker may lack this package; absent workers keep their record
        self.remove_if_done()

    async def _reconcile(self, record: WorkerRecord, address: str) -> None:
        """Have a worker declare its target resources, in as many steps as its tasks require."""
        if record.is_unassigned:
            await self._ask_for_gpus(record)
            if record.is_unassigned:
                self._assign(record)
        requested_moves: set[Any] = set()  # tasks that the worker was asked to give up
        while (worker := self.scheduler.workers.get(address)) and not self.is_settled(record):
            try:
                if not await self._step(record, worker, requested_moves):
                    await asyncio.sleep(LOOK_EVERY_S)
            except OSError as error:  # the worker is leaving, or the connection was bad
                logger.info("The worker at %s does not respond: %s", address, error)
                await asyncio.sleep(10 * LOOK_EVERY_S)
        # `set_visible_resources` does not start the tasks that have waited for a worker with these resources.
        if worker:
            send_waiting_tasks(self.scheduler, worker)

    async def _step(self, record: WorkerRecord, worker: Any, requested_moves: set[Any]) -> bool:
        """Let a worker declare its target resources, or return False if its tasks must end first.

        The worker refuses while it runs a task that holds a resource to be removed, also a task
        that the scheduler has forgotten.
        """
        target = self.target_resources(record)
        leaving = {name for name, slots in record.declared.items() if slots and name not in target}
        if leaving and not self._has_released(record, worker, leaving, requested_moves):
            return False
        record.is_declaring = True
        try:
            accepted = await call_worker(
                self.scheduler, worker.address, declare_on_worker, resources=target
            )
        finally:
            record.is_declaring = False
        if not accepted:
            return False
        if self.scheduler.workers.get(worker.address) is worker:
            record.declared = target
            if self.target_resources(record) == target:
                self._show(record, worker, target)
                # Other members may have taken over tasks, whose slots Dask counts wrongly.
                for name in leaving:
                    for address in self.scheduler.resources.get(name, ()):
                        recount_used_resources(self.scheduler.workers[address])
        return True

    def _has_released(
        self, record: WorkerRecord, worker: Any, leaving: Collection[str], requested_moves: set[Any]
    ) -> bool:
        """Move the tasks of partitions that a worker leaves, and return whether none is left.

        The worker gets no new tasks of these partitions. Tasks that run end on the worker, which
        keeps the resource until then.
        """
        remaining = {name: slots for name, slots in record.declared.items() if name not in leaving}
        self._show(record, worker, remaining)
        hand_off_tasks(self.scheduler, worker, leaving, requested_moves)
        return not keys_held_by(self.scheduler, worker, leaving)

    def _show(self, record: WorkerRecord, worker: Any, resources: Resources) -> None:
        """Let the scheduler place tasks by the given resources of a worker only.

        Also renew the group of workers that `choosing.py` compares, and the worker's fence.
        """
        set_visible_resources(self.scheduler, worker, resources)
        invalidate_groups(self.scheduler)
        set_expected_partition(self.scheduler, worker, record.partition)

    async def wait_until_settled(
        self, records: Collection[WorkerRecord], timeout_s: float
    ) -> list[WorkerRecord]:
        """Wait until workers declare their target resources, and return the late workers.

        Restarting workers are waited for; workers that have left for good are not.
        """
        self.reconcile(records)
        deadline = time.monotonic() + timeout_s
        while late := [
            record for record in records if not record.is_removed and not self.is_settled(record)
        ]:
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
        for record in self.records.values():
            scheduled += [record.reconciliation, record.removal_timer]
        for task in scheduled:
            if task is not None:
                task.cancel()

    def remove_if_done(self) -> None:
        """Leave the scheduler after the last partition, once all workers are restored."""
        present = [record for record in self.records.values() if not record.is_absent]
        if not self.rules and not self.open_requests and all(map(self.is_settled, present)):
            self._stop()
            if self.scheduler.plugins.get(NAME) is self:
                self.scheduler.remove_plugin(NAME)


def worker_key(name: Hashable, address: str, nanny: str | None) -> Hashable:
    """Return a key of a worker that outlives restarts: its name or else its nanny's address.

    The default name is the address, which changes with a restart. Names are not converted: to
    Dask 0, from `LocalCluster`, and "0", from a command line, are two workers.
    """
    return name if name != address else nanny or address


def names_of(records: Iterable[WorkerRecord]) -> str:
    """Return the names of workers, for messages."""
    return ", ".join(sorted(record.info.name for record in records))


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

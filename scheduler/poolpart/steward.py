"""Assign workers to partitions, and record the assignment in a scheduler plugin.

The steward stores the rule of each partition and a record of each worker with its partition.
Requests of clients (see `division.py`) and workers that join or leave change the records. After any
change, a reconciliation loop for each affected worker (`Steward._reconcile`) brings the following
in line with its record:

1. The resources that the worker declares, which its tasks must find there.
2. The resources that the scheduler uses to place tasks. They are removed before a worker leaves a
   partition, so that it receives no more tasks of it, and added once the worker has declared them.
3. The workers behind a fence, immediately after the change. A fence keeps all tasks that do not
   request an exclusive partition off its workers (see `fence.py`).

Nannies are not modified. A restarted worker declares its original resources, joins, and is
reconciled again. Therefore, the loop can be interrupted at any point, and dissolving a partition
leaves nothing behind.
"""

from __future__ import annotations

import asyncio
import itertools
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
from .internals.names import DIVIDING, require_feature
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
HOLD_S = 30.0  # time for which the record of a worker is kept while its nanny restarts it
CHECK_EVERY_S = 0.01  # interval between attempts to reconcile a worker
_numbers = itertools.count()  # numbers of partitions, of all stewards in this process
_ASSIGN_EVERY_S = 0.1  # about the time that applying all rules to a thousand workers takes


@dataclass(eq=False)
class WorkerRecord:
    """Partition and state of a worker, which are kept while a nanny restarts its process."""

    key: Hashable  # identifies the worker (`worker_key`)
    info: WorkerInfo
    nanny: str | None = None  # address of the nanny
    original: Resources = field(default_factory=dict)  # resources that the worker was started with
    declared: Resources = field(default_factory=dict)  # resources at the worker's last reply
    is_declaring: bool = False  # whether a request to declare resources is in flight
    partition: str | None = None
    # Partition that the worker was started in, or that a rule has selected for it. The home does
    # not change when the worker is moved, because the other partition only borrows the worker.
    home: str | None = None
    slots: float = 0  # number of slots in the partition
    # Whether the rules still have to select a partition for the worker, which has joined after the
    # division. Members of the remainder can be selected again by another rule.
    is_unassigned: bool = False
    # Whether the worker has joined after the division and was assigned to its partition by a rule.
    assigned_by_rule: bool = False
    is_absent: bool = False  # whether the worker has left, possibly because its nanny restarts it
    is_removed: bool = False  # whether the worker is no longer expected to return
    reconciliation: asyncio.Task[None] | None = None  # running `Steward._reconcile` loop
    removal_timer: asyncio.TimerHandle | None = None  # removes the record of an absent worker


class Steward(SchedulerPlugin):
    """Scheduler plugin that assigns workers to partitions, even after the client has closed."""

    name = NAME

    def __init__(self, scheduler: Any) -> None:
        self.scheduler = scheduler
        self.rules: dict[str, Rule] = {}  # {partition: rule}, in the order in which they apply
        self.records: dict[Hashable, WorkerRecord] = {}  # {worker key: record}
        self.open_requests = 0  # number of client requests in progress
        self._numbers: dict[str, int] = {}  # {partition, even if it was dissolved: its number}
        self._assignment_timer: asyncio.TimerHandle | None = None
        for worker in scheduler.workers.values():
            self._add_record(worker)

    # -- membership --------------------------------------------------------------------

    def members(self, name: str, present: bool = False) -> list[WorkerRecord]:
        """Return a record for each member of a partition.

        If `present` is true, members that are absent are omitted.
        """
        members = (record for record in self.records.values() if record.partition == name)
        return [record for record in members if not (present and record.is_absent)]

    def free_records(self) -> list[WorkerRecord]:
        """Return the records of present workers without a partition or any other resource."""
        return [
            record
            for record in self.records.values()
            if not record.is_absent
            and not record.partition
            and not any(self.target_resources(record).values())
        ]

    def remainder_name(self) -> str | None:
        """Return the name of the partition that has the rule `rest`, or None."""
        return next((name for name, rule in self.rules.items() if isinstance(rule, rest)), None)

    def target_resources(self, record: WorkerRecord) -> Resources:
        """Return the resources that a worker should declare.

        A worker without a partition declares the resources that it was started with, except those
        of existing partitions, because it does not belong to them. A member of a partition declares
        its slots in this partition and the resources that it was started with, except those of any
        other existing or dissolved partition, because a worker belongs to only one partition.
        """
        if record.partition is None:
            return {r: slots for r, slots in record.original.items() if r not in self.rules}
        original = {r: slots for r, slots in record.original.items() if r not in self._numbers}
        return {**original, record.partition: record.slots}

    def home_of(self, record: WorkerRecord) -> str | None:
        """Return the existing partition to which a worker returns, or None."""
        started_in = (name for name, slots in record.original.items() if slots)
        return next((name for name in (record.home, *started_in) if name in self.rules), None)

    def set_home(self, record: WorkerRecord, name: str | None, slots: float | None = None) -> None:
        """Assign a worker to a partition and make this partition its home."""
        record.home = name
        self.set_partition(record, name, slots)

    def set_partition(
        self, record: WorkerRecord, name: str | None, slots: float | None = None
    ) -> None:
        """Record the partition of a worker. The name None stands for no partition.

        The worker is behind the fence of the partition immediately. `reconcile` makes all other
        changes. If `slots` is not given, the number of slots comes from the rule, from the resource
        with which the worker was started, or from the number of threads, in this order.
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
        """Add a partition, or change its rule. The partition with the rule `rest` remains last."""
        if name not in self.rules:
            self._numbers[name] = next(_numbers)
        rules = {**self.rules, name: rule}.items()
        self.rules = dict(sorted(rules, key=lambda item: isinstance(item[1], rest)))

    def number_of(self, name: str) -> int:
        """Return a number that identifies a partition, or -1 if it does not exist.

        A partition that was dissolved and created again has another number.
        """
        return self._numbers[name] if name in self.rules else -1

    def check_exists(self, name: str) -> None:
        """Raise PoolError if a partition neither has a rule nor workers that started in it."""
        records = self.records.values()
        if name not in self.rules and not any(self._started_in(name, r) for r in records):
            raise PoolError(
                f"There is no partition {name!r}. No worker declares this resource, and the "
                "partition was not created with `Pool.partition` or `Pool.divide`."
            )

    @staticmethod
    def _started_in(name: str, record: WorkerRecord) -> bool:
        """Return whether a worker belongs to a partition because it was started in it."""
        return record.partition is None and bool(record.original.get(name))

    def adopt_partition(self, name: str) -> None:
        """Add a partition whose workers were started with its resource, unless it is already known.

        Raises
        ------
        PoolError
            If the partition does not exist.
        """
        if name in self.rules:
            return
        self.check_exists(name)
        members = [record for record in self.records.values() if self._started_in(name, record)]
        self.set_rule(name, Rule(minimum=0))
        for record in members:
            self.set_home(record, name, record.original[name])

    def change_target(self, name: str | None, change: int) -> None:
        """Change the number of workers requested by an `n_workers` rule.

        Other rules are not changed.
        """
        if name in self.rules and isinstance(rule := self.rules[name], n_workers):
            workers = rule.workers + change
            self.rules[name] = replace(rule, workers=workers, minimum=min(rule.minimum, workers))

    # -- joining and leaving -----------------------------------------------------------

    def _add_record(self, worker: Any) -> WorkerRecord:
        """Create or update the record of a worker that has joined or returned."""
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
        """Assign a joining worker to its former partition, to a declared one, or by rule."""
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
        """Mark a worker as absent, and schedule the removal of its record.

        The record of a worker with a nanny is kept for a while, because the nanny may restart the
        worker.
        """
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
        """Remove a worker's record, and fill its place according to the rules.

        The worker has not returned in time, or cannot declare resources. Members of the remainder
        that have joined after the division can be assigned again to fill the place.
        """
        record.is_removed = True
        del self.records[record.key]
        # A worker that was started as a replacement may already have joined the remainder.
        if remainder := self.remainder_name():
            for member in self.members(remainder):
                member.is_unassigned = member.assigned_by_rule
        self._assign_soon()
        self.remove_if_done()

    def valid_workers_downscaling(self, scheduler: Any, workers: list[Any]) -> list[Any]:
        """Select workers that an adaptive cluster may stop without falling below a minimum."""
        may_stop = {worker.address: worker for worker in workers}
        for name, rule in self.rules.items():
            members = self.members(name, present=True)
            offered = [m.info.address for m in members if m.info.address in may_stop]
            # The busiest workers are kept.
            offered.sort(key=lambda address: -len(may_stop[address].processing))
            for address in offered[: max(0, rule.minimum - (len(members) - len(offered)))]:
                del may_stop[address]
        return list(may_stop.values())

    # -- assigning workers that join ---------------------------------------------------

    def _assign_soon(self) -> None:
        """Schedule the assignment of unassigned workers, after rules or members have changed."""
        if self._assignment_timer is None:
            loop = asyncio.get_running_loop()
            self._assignment_timer = loop.call_later(_ASSIGN_EVERY_S, self._assign_waiting)

    def _assign_waiting(self) -> None:
        """Assign all present workers that are unassigned and have reported their GPUs."""
        self._assignment_timer = None
        waiting = [s for s in self.records.values() if s.is_unassigned and not s.is_absent]
        # Workers that have not reported their GPUs yet are assigned by their reconciliation loop.
        ready = [s for s in waiting if s.reconciliation and s.reconciliation.done()]
        self.reconcile([record for record in ready if self._assign(record)])

    def _assign(self, record: WorkerRecord) -> bool:
        """Apply the rules to an unassigned worker, and return whether its partition has changed."""
        groups = {name: [member.info for member in self.members(name)] for name in self.rules}
        name = partition_for(record.info, self.rules, groups)
        if moves := name not in (None, record.partition):
            self.set_home(record, name)
            record.assigned_by_rule = True
        record.is_unassigned = name is None
        return moves

    async def _ask_for_gpus(self, record: WorkerRecord) -> None:
        """Request a worker's GPUs if any rule depends on them."""
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
        """Return whether a worker and the scheduler both use the worker's target resources."""
        worker = self.scheduler.workers.get(record.info.address)
        if worker is None or record.is_declaring:
            return False
        return bool(worker.resources == record.declared == self.target_resources(record))

    def reconcile(self, records: Iterable[WorkerRecord]) -> None:
        """Start the loops in which workers declare their target resources."""
        for record in records:
            # A running loop checks the record again before it ends.
            if not record.is_absent and (
                record.reconciliation is None or record.reconciliation.done()
            ):
                record.reconciliation = asyncio.ensure_future(
                    self._reconcile(record, record.info.address)
                )
                record.reconciliation.add_done_callback(partial(self._on_reconciled, record))

    def _on_reconciled(self, record: WorkerRecord, task: asyncio.Task[None]) -> None:
        """Remove the record of a worker if it cannot declare resources.

        This is the callback at the end of a reconciliation loop. The steward is removed if nothing
        is left to do.
        """
        if not (task.cancelled() or record.is_absent) and (error := task.exception()):
            logger.error("Worker %s cannot be assigned to a partition: %r", record.info.name, error)
            self.set_partition(record, None)
            self._remove_record(record)  # for example, poolpart is not installed on the worker
        self.remove_if_done()

    async def _reconcile(self, record: WorkerRecord, address: str) -> None:
        """Make a worker declare its target resources, in several steps if its tasks require it."""
        if record.is_unassigned:
            await self._ask_for_gpus(record)
            if record.is_unassigned:
                self._assign(record)
        requested_moves: set[Any] = set()  # tasks that the worker was asked to give up
        while (worker := self.scheduler.workers.get(address)) and not self.is_settled(record):
            try:
                if not await self._step(record, worker, requested_moves):
                    await asyncio.sleep(CHECK_EVERY_S)
            except OSError as error:  # the worker is leaving, or the connection failed
                logger.info("The worker at %s does not respond: %s", address, error)
                await asyncio.sleep(10 * CHECK_EVERY_S)
        # `set_visible_resources` does not start the tasks that wait for these resources.
        if worker:
            send_waiting_tasks(self.scheduler, worker)

    async def _step(self, record: WorkerRecord, worker: Any, requested_moves: set[Any]) -> bool:
        """Ask a worker to declare its target resources, and return whether it has done so.

        The worker refuses while it runs a task that holds a resource to be removed, even if the
        scheduler has already forgotten the task.
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
                self._set_visible_resources(record, worker, target)
                self.recount_slots(leaving)
        return True

    def recount_slots(self, names: Iterable[str]) -> None:
        """Recount the slots in use after a worker has left the named partitions.

        Dask attributes a task that was moved to another member to its first worker, so the counts
        of all members are only correct together.
        """
        for name in names:
            for address in self.scheduler.resources.get(name, ()):
                recount_used_resources(self.scheduler.workers[address])

    def _has_released(
        self, record: WorkerRecord, worker: Any, leaving: Collection[str], requested_moves: set[Any]
    ) -> bool:
        """Move tasks of former partitions off a worker, and return whether none are left.

        The worker receives no new tasks of these partitions. Tasks that are already running finish
        on the worker, which keeps the resource until then.
        """
        remaining = {name: slots for name, slots in record.declared.items() if name not in leaving}
        self._set_visible_resources(record, worker, remaining)
        hand_off_tasks(self.scheduler, worker, leaving, requested_moves)
        return not keys_held_by(self.scheduler, worker, leaving)

    def _set_visible_resources(
        self, record: WorkerRecord, worker: Any, resources: Resources
    ) -> None:
        """Set the resources that the scheduler considers when it places tasks on a worker.

        This also invalidates the worker groups of `choosing.py` and updates the fence of the
        worker.
        """
        set_visible_resources(self.scheduler, worker, resources)
        invalidate_groups(self.scheduler)
        set_expected_partition(self.scheduler, worker, record.partition)

    async def wait_until_settled(
        self, records: Collection[WorkerRecord], timeout_s: float
    ) -> list[WorkerRecord]:
        """Wait until workers have declared their target resources, and return those that are late.

        This includes workers that are being restarted, but not workers that were removed.
        """
        self.reconcile(records)
        deadline = time.monotonic() + timeout_s
        while late := [
            record for record in records if not record.is_removed and not self.is_settled(record)
        ]:
            if time.monotonic() >= deadline:
                break
            await asyncio.sleep(CHECK_EVERY_S)
        return late

    # -- stopping ----------------------------------------------------------------------

    async def close(self) -> None:
        """Stop all activity when the scheduler closes."""
        self._stop()

    def _stop(self) -> None:
        """Cancel all timers and reconciliation loops."""
        scheduled: list[asyncio.TimerHandle | asyncio.Task[None] | None] = [self._assignment_timer]
        for record in self.records.values():
            scheduled += [record.reconciliation, record.removal_timer]
        for task in scheduled:
            if task is not None:
                task.cancel()

    def remove_if_done(self) -> None:
        """Remove the plugin if there are no partitions and each worker has its own resources."""
        present = [record for record in self.records.values() if not record.is_absent]
        if not self.rules and not self.open_requests and all(map(self.is_settled, present)):
            self._stop()
            if self.scheduler.plugins.get(NAME) is self:
                self.scheduler.remove_plugin(NAME)


def worker_key(name: Hashable, address: str, nanny: str | None) -> Hashable:
    """Return a key that identifies a worker across restarts.

    The key is the worker's name, or its nanny's address.

    The nanny's address is used for default names, which are derived from the worker's address and
    change with a restart. Names are not converted to strings, because for Dask, the name 0 from
    `LocalCluster` and the name "0" from a command line belong to different workers.
    """
    return name if name != address else nanny or address


def join_names(records: Iterable[WorkerRecord]) -> str:
    """Format workers' names for a message."""
    return ", ".join(sorted(record.info.name for record in records))


def names_with_rule(scheduler: Any) -> frozenset[str]:
    """Return the names of the partitions that were created by dividing the pool."""
    steward: Steward | None = scheduler.plugins.get(NAME)
    return frozenset() if steward is None else frozenset(steward.rules)


def target_of(scheduler: Any, name: str) -> int | None:
    """Return how many workers the rule of a partition requests.

    The result is None if the partition has no rule, or if its rule does not request a number.
    """
    steward: Steward | None = scheduler.plugins.get(NAME)
    rule = steward.rules.get(name) if steward is not None else None
    return rule.target if rule is not None else None


@contextmanager
def steward_of(scheduler: Any) -> Iterator[Steward]:
    """Provide the scheduler's steward within the block, and create it if necessary.

    After the block, the steward is removed if it has no partitions.
    """
    require_feature(DIVIDING)
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

"""Balanced groups, whose partitions exchange workers according to their work.

A scheduler plugin observes the partitions of each group twice a second: the slots that unfinished
tasks request, the items in the pipes that feed the partition, and the running times of finished
tasks. All of these values are counted anyway, so a group does not increase the cost of a task.
`balance_policy.py` decides how many workers to move, and `division.py` moves them: a worker first
finishes its running tasks.
"""

from __future__ import annotations

import asyncio
import logging
import math
import time
from collections import Counter, deque
from collections.abc import Collection, Coroutine, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from itertools import chain, islice
from typing import Any, Self

from distributed import Client
from distributed.diagnostics.plugin import SchedulerPlugin

from .adapting import JobBounds, adaptive_names, set_bounds
from .balance_policy import BalancePolicy, LoadSample, WorkerShift
from .balance_stats import BalanceStats, DemandStats, WorkerMove
from .division import call_steward, in_moving_order, move_workers, settled_members
from .errors import PoolError
from .internals.names import BALANCING, require_feature
from .internals.scheduler import call_worker, unrunnable_tasks, used_slots
from .pipe_states import feeding_pipes
from .probe import worker_gpus
from .rules import check_count, check_name
from .stats import statistics_of
from .steward import NAME as STEWARD
from .steward import Steward, WorkerRecord, join_names
from .workers import run_on_scheduler

logger = logging.getLogger(__name__)

NAME = "poolpart-balancing"
INTERVAL_S = 0.5  # interval between decisions
DRAIN_S = 60.0  # maximum time that a worker has to finish its running tasks
PAUSE_S = 300.0  # time for which a worker that has not finished them in time is not moved
_ANSWER_S = 10.0  # maximum time that a worker has to report its GPUs
MAX_MOVES = 1000  # number of moves in the history of a group
_MAX_WAITING = 10_000  # number of tasks without a worker that are examined
_MIN_PARTITIONS = 2

Bounds = int | Mapping[str, int] | None


class BalancedGroup:
    """Partitions that exchange workers according to their work. `Pool.balance` returns it.

    The scheduler balances the partitions until `stop` is called, or until fewer than two of them
    remain, even if this client closes. At the end of a ``with`` block, `stop` is called. If the
    client closes or dies in the block, the scheduler ends the group. `Pool.balanced_groups` lists
    the groups of all clients.

    Examples
    --------
    >>> group = pool.balance([decode, detect])                       # doctest: +SKIP
    >>> group.stats().moves[-1].worker                               # doctest: +SKIP
    '17'
    >>> group.stop()                                                 # doctest: +SKIP
    """

    def __init__(self, client: Client, names: Sequence[str]) -> None:
        self.client = client
        self.names = tuple(names)

    def __repr__(self) -> str:
        return f"<BalancedGroup: {', '.join(self.names)}>"

    def __enter__(self) -> Self:
        run_on_scheduler(self.client, _bind_group, names=self.names, client_id=self.client.id)
        return self

    def __exit__(self, kind: object, error: BaseException | None, traceback: object) -> None:
        try:
            self.stop()
        except OSError:  # the scheduler has ended, and the group with it
            pass
        except PoolError as failure:
            if error is None:
                raise
            # The first error is more important than the failure that follows it.
            error.add_note(f"poolpart: The balanced group was not stopped. {failure}")

    def stats(self) -> BalanceStats:
        """Return the load of each partition, and the workers that were moved and why."""
        stats: BalanceStats = run_on_scheduler(self.client, _stats_of_group, names=self.names)
        return stats

    def stop(self) -> None:
        """Stop moving workers. Each worker stays in the partition to which it was moved last."""
        run_on_scheduler(self.client, _stop_group, names=self.names)


def balance_partitions(
    client: Client,
    names: Sequence[str],
    minimum: Bounds,
    maximum: Bounds,
    workers: Iterable[str | int] | None,
) -> BalancedGroup:
    """Create a balanced group. See `Pool.balance`."""
    for name in names:
        check_name(name)
    if len(set(names)) < _MIN_PARTITIONS or len(set(names)) < len(names):
        raise PoolError(
            f"`balance` requires at least two different partitions, but got {list(names)!r}."
        )
    spec = GroupSpec(
        tuple(names),
        _bounds("min", names, minimum, 1, 0),
        _bounds("max", names, maximum, math.inf, 1),
        None if workers is None else _worker_names(workers),
    )
    for name in names:
        if spec.minimum[name] > spec.maximum[name]:
            raise PoolError(
                f"The minimum of partition {name!r} is {spec.minimum[name]}, but its maximum is "
                f"{spec.maximum[name]:g}."
            )
    call_steward(client, _create_group, spec=spec)
    return BalancedGroup(client, names)


def _bounds(
    option: str, names: Sequence[str], bounds: Bounds, default: float, lowest: int
) -> dict[str, Any]:
    """Validate the bounds that a user has passed, and return the bound of each partition."""
    if bounds is None:
        return dict.fromkeys(names, default)
    if not isinstance(bounds, Mapping):
        bounds = dict.fromkeys(names, bounds)
    for name, bound in bounds.items():
        check_count(f"`{option}` of partition {name!r}", bound, lowest)
        if name not in names:
            raise PoolError(f"`{option}` names {name!r}, which is not one of {list(names)!r}.")
    return {name: bounds.get(name, default) for name in names}


def _worker_names(workers: Iterable[str | int]) -> frozenset[str]:
    """Validate the names of workers that a user has passed."""
    names = [*workers] if isinstance(workers, Iterable) and not isinstance(workers, str) else []
    if not names or not all(type(name) in (str, int) for name in names):
        raise PoolError(
            f"Invalid value {workers!r:.100} for `workers`. Expected a list with the names of the "
            "workers that may be moved, or None for all workers."
        )
    return frozenset(map(str, names))


@dataclass(frozen=True)
class GroupSpec:
    """Partitions of a balanced group, their bounds, and the workers that may be moved."""

    names: tuple[str, ...]
    minimum: Mapping[str, int]
    maximum: Mapping[str, float]
    # Names of the workers that may be moved. If None, these are all workers of the same kind.
    workers: frozenset[str] | None = None


# -- on the scheduler --------------------------------------------------------------------


@dataclass(eq=False)
class _Group:
    """State of a balanced group. All times are values of `time.monotonic`."""

    spec: GroupSpec
    # {partition that has not been dissolved: number that identifies it}
    partitions: dict[str, int]
    has_gpus: bool  # whether workers of the group have GPUs
    client: str = ""  # ID of the client whose `with` block the group belongs to
    policy: BalancePolicy = field(default_factory=BalancePolicy)
    moves: deque[WorkerMove] = field(default_factory=lambda: deque(maxlen=MAX_MOVES))
    tasks: set[asyncio.Task[None]] = field(default_factory=set)  # moves in progress
    samples: dict[str, LoadSample] = field(default_factory=dict)
    sampled_at: float = field(default_factory=time.monotonic)
    paused_until: dict[Hashable, float] = field(default_factory=dict)  # {worker key: time}
    # {worker key: whether it has GPUs, or None if it has not responded}
    gpus: dict[Hashable, bool | None] = field(default_factory=dict)

    def may_move(self, record: WorkerRecord) -> bool:
        """Return whether a worker may be moved to another partition of the group."""
        if self.paused_until.get(record.key, 0.0) > time.monotonic():
            return False
        if self.spec.workers is not None:
            return record.info.name in self.spec.workers
        return self.gpus.get(record.key) is self.has_gpus


class GroupBalancer(SchedulerPlugin):
    """Scheduler plugin that moves workers within balanced groups. It is removed with the last."""

    name = NAME

    def __init__(self, scheduler: Any) -> None:
        self.scheduler = scheduler
        self.groups: list[_Group] = []
        self.move_counts: Counter[tuple[str, str]] = Counter()  # by source and destination
        self._loop: asyncio.Task[None] | None = None
        self._has_lost_workers = False  # since the last samples

    def find(self, names: Collection[str]) -> _Group | None:
        """Return the group with exactly these partitions, or None."""
        return next((g for g in self.groups if set(g.spec.names) == set(names)), None)

    def add(self, group: _Group) -> None:
        """Balance a group from now on."""
        self.groups.append(group)
        if self._loop is None or self._loop.done():
            self._loop = _start(self._run())

    def remove(self, group: _Group) -> None:
        """Stop balancing a group. Moves that are in progress are completed."""
        if group in self.groups:
            self.groups.remove(group)
        if not self.groups and self.scheduler.plugins.get(NAME) is self:
            self._stop()
            self.scheduler.remove_plugin(NAME)

    def remove_client(self, scheduler: Any, client: str) -> None:
        """End the groups of a client that has left within its `with` blocks."""
        for group in [group for group in self.groups if group.client == client]:
            self.remove(group)

    def remove_worker(self, scheduler: Any, worker: str, **kwargs: Any) -> None:
        """Recount the slots in use before the next samples are taken."""
        self._has_lost_workers = True

    async def close(self) -> None:
        """Stop when the scheduler closes."""
        for group in self.groups:
            for task in group.tasks:
                task.cancel()
        self._stop()

    def _stop(self) -> None:
        if self._loop is not None and self._loop is not asyncio.current_task():
            self._loop.cancel()

    async def _run(self) -> None:
        """Balance all groups at regular intervals, until there are none."""
        while self.groups:
            await asyncio.sleep(INTERVAL_S)
            has_lost_workers = self._has_lost_workers
            self._has_lost_workers = False
            for group in list(self.groups):
                try:
                    self._balance(group, has_lost_workers)
                except Exception:  # other groups are not affected
                    logger.exception("%s is no longer balanced.", group.spec)
                    self.remove(group)

    # -- decisions ---------------------------------------------------------------------

    def _balance(self, group: _Group, has_lost_workers: bool) -> None:
        """Take samples of a group's partitions, and start to move workers if necessary."""
        steward: Steward | None = self.scheduler.plugins.get(STEWARD)
        # A partition that was dissolved leaves the group, even if it was created again.
        group.partitions = {
            name: number
            for name, number in group.partitions.items()
            if steward is not None and steward.number_of(name) == number
        }
        names = [*group.partitions]
        if steward is None or len(names) < _MIN_PARTITIONS:
            self.remove(group)
            return
        sampled_at = time.monotonic()
        if has_lost_workers:
            steward.recount_slots(names)
        # Absent workers do no work, and may never return.
        members = {name: steward.members(name, present=True) for name in names}
        records = list(chain.from_iterable(members.values()))
        self._ask_for_gpus(group, records)
        group.samples = self._take_samples(steward, group, members)
        moving = sum(not steward.is_settled(record) for record in records)
        elapsed_s = sampled_at - group.sampled_at
        group.sampled_at = sampled_at
        for shift in group.policy.update(group.samples, elapsed_s, moving):
            self._begin_moves(steward, group, shift)

    def _take_samples(
        self, steward: Steward, group: _Group, members: Mapping[str, Sequence[WorkerRecord]]
    ) -> dict[str, LoadSample]:
        """Return the current load of each partition."""
        unfinished = dict.fromkeys(members, 0.0)
        for record in steward.records.values():
            # A worker that is leaving a partition still runs tasks of it.
            if (worker := self.scheduler.workers.get(record.info.address)) is not None:
                for name in record.declared.keys() & unfinished.keys():
                    unfinished[name] += used_slots(worker, name)
        for task in islice(unrunnable_tasks(self.scheduler), _MAX_WAITING):
            for name, slots in (task.resource_restrictions or {}).items():
                if name in unfinished:
                    unfinished[name] += slots
        samples = {}
        for name, records in members.items():
            rule = steward.rules[name]
            pipes = feeding_pipes(self.scheduler, name)
            depths = [(pipe.queue.qsize(), pipe.queue.capacity) for pipe in pipes]
            finished, seconds = self._finished_tasks(name)
            slots = [record.slots for record in records] or [rule.slots or 1]
            samples[name] = LoadSample(
                workers=len(records),
                minimum=max(group.spec.minimum[name], rule.minimum),
                maximum=group.spec.maximum[name],
                slots=sum(slots) / len(slots),
                movable=len(self._movable(steward, group, name)),
                finished=finished,
                seconds=seconds,
                backlog=unfinished[name] + sum(depth for depth, _ in depths),
                fullness=max((depth / capacity for depth, capacity in depths), default=0.0),
            )
        return samples

    def _finished_tasks(self, name: str) -> tuple[int, float]:
        """Return the number of a partition's finished tasks, and their running time.

        The time that tasks have waited for pipes is excluded. Otherwise, a partition whose tasks
        wait for a slower one would appear to need more workers.
        """
        finished = 0
        seconds = 0.0
        for (partition, _), counts in statistics_of(self.scheduler, keep=False).ended.items():
            if partition == name:
                finished += counts["done"] + counts["failed"]
                seconds += counts["seconds"] - counts["pipe_seconds"]
        return finished, seconds

    def _movable(self, steward: Steward, group: _Group, name: str) -> list[WorkerRecord]:
        """Return the members of a partition that may be moved to another one now."""
        return [record for record in settled_members(steward, name) if group.may_move(record)]

    def _ask_for_gpus(self, group: _Group, records: Sequence[WorkerRecord]) -> None:
        """Ask workers that have joined later whether they have GPUs."""
        now = time.monotonic()
        unknown = [
            record
            for record in records
            if record.key not in group.gpus and group.paused_until.get(record.key, 0.0) <= now
        ]
        if unknown and group.spec.workers is None:
            group.gpus.update(dict.fromkeys((record.key for record in unknown), None))
            _start(self._find_gpus(group, unknown), group.tasks)

    async def _find_gpus(self, group: _Group, records: Sequence[WorkerRecord]) -> None:
        """Store whether workers have GPUs. Workers that do not respond are asked again later."""
        group.gpus.update(await find_gpus(self.scheduler, records))
        for record in records:
            if group.gpus[record.key] is None:
                del group.gpus[record.key]
                group.paused_until[record.key] = time.monotonic() + PAUSE_S

    # -- moves -------------------------------------------------------------------------

    def _begin_moves(self, steward: Steward, group: _Group, shift: WorkerShift) -> None:
        """Start to move workers, which first finish their running tasks."""
        movable = self._movable(steward, group, shift.source)
        records = in_moving_order(steward, movable, shift.destination)[: shift.workers]
        if not records:
            return
        reason = _explain(group, shift)
        logger.info(
            "Moving %s from %r to %r: %s",
            join_names(records),
            shift.source,
            shift.destination,
            reason,
        )
        _start(self._move(steward, group, records, shift, reason), group.tasks)

    async def _move(
        self,
        steward: Steward,
        group: _Group,
        records: Sequence[WorkerRecord],
        shift: WorkerShift,
        reason: str,
    ) -> None:
        try:
            await move_workers(steward, dict.fromkeys(records, shift.destination), DRAIN_S)
        except PoolError as error:
            logger.info("%s", error)
        for record in records:
            if record.is_removed:
                continue
            if record.partition == shift.source:
                group.paused_until[record.key] = time.monotonic() + PAUSE_S
            elif record.partition == shift.destination:
                self.move_counts[shift.source, shift.destination] += 1
                group.moves.append(
                    WorkerMove(
                        datetime.now(UTC),
                        record.info.name,
                        shift.source,
                        shift.destination,
                        reason,
                    )
                )


def _explain(group: _Group, shift: WorkerShift) -> str:
    """Return the demands of two partitions as the reason of a move."""
    parts = []
    for name in (shift.destination, shift.source):
        sample = group.samples[name]
        demand = group.policy.demands[name].slots / sample.slots
        parts.append(f"{name} needs {demand:.1f} workers and has {sample.workers}")
    return ", ".join(parts)


def _start(
    coroutine: Coroutine[Any, Any, None], tasks: set[asyncio.Task[None]] | None = None
) -> asyncio.Task[None]:
    """Run a coroutine in the background, and log its error."""
    task = asyncio.ensure_future(coroutine)
    task.add_done_callback(_log_error)
    if tasks is not None:
        tasks.add(task)
        task.add_done_callback(tasks.discard)
    return task


def _log_error(task: asyncio.Task[None]) -> None:
    if not task.cancelled() and (error := task.exception()):
        logger.error("Workers could not be moved: %r", error, exc_info=error)


async def find_gpus(scheduler: Any, records: Iterable[WorkerRecord]) -> dict[Hashable, bool | None]:
    """Ask workers whether they have GPUs, and return the answers by worker key.

    The answer of a worker that does not respond is None.
    """

    async def ask(record: WorkerRecord) -> tuple[Hashable, bool | None]:
        request = call_worker(scheduler, record.info.address, worker_gpus)
        try:
            return record.key, bool(await asyncio.wait_for(request, _ANSWER_S))
        except (OSError, TimeoutError) as error:
            logger.warning(
                "Worker %s is not moved for now, because it does not report its GPUs. %s",
                record.info.name,
                error,
            )
            return record.key, None

    return dict(await asyncio.gather(*map(ask, records)))


async def _create_group(steward: Steward, spec: GroupSpec) -> None:
    """Create a balanced group, or replace the group of the same partitions.

    Raises
    ------
    PoolError
        If a partition does not exist, is adaptive, or belongs to another group, if the bounds do
        not fit the number of workers, or if the workers are not interchangeable.
    """
    require_feature(BALANCING)
    scheduler = steward.scheduler
    for name in spec.names:  # all checks that are possible before a partition is changed
        if name in adaptive_names(scheduler):
            raise PoolError(
                f"Partition {name!r} is adaptive, so its workers cannot be moved to other "
                "partitions. Balance only partitions with a fixed number of jobs."
            )
        steward.check_exists(name)
    _check_groups(scheduler, spec)
    for name in spec.names:
        steward.adopt_partition(name)
    _check_workers(steward, spec)
    gpus: dict[Hashable, bool | None] = {}
    if spec.workers is None:
        members = [record for name in spec.names for record in steward.members(name)]
        gpus = await find_gpus(scheduler, [r for r in members if not r.is_absent])
        # In the meantime, other clients may have made requests.
        for name in spec.names:
            steward.check_exists(name)
        _check_groups(scheduler, spec)
        _check_same_kind(steward, spec, gpus)
    statistics_of(scheduler, keep=False)
    balancer: GroupBalancer | None = scheduler.plugins.get(NAME)
    if balancer is None:
        balancer = GroupBalancer(scheduler)
        scheduler.add_plugin(balancer)
    known = {key: answer for key, answer in gpus.items() if answer is not None}
    numbers = {name: steward.number_of(name) for name in spec.names}
    group = _Group(spec, numbers, any(known.values()), gpus=dict(known))
    if (former := balancer.find(spec.names)) is not None:
        balancer.groups.remove(former)
        group.moves.extend(former.moves)
    balancer.add(group)


def _check_groups(scheduler: Any, spec: GroupSpec) -> None:
    """Raise PoolError if a partition belongs to a group of other partitions."""
    for group in _groups(scheduler):
        if set(group.spec.names) == set(spec.names):
            continue  # this group is replaced
        for name in spec.names:
            if name in group.partitions:
                raise PoolError(
                    f"Partition {name!r} already belongs to another balanced group. Stop that "
                    "group first, or balance all of the partitions together."
                )


def _check_workers(steward: Steward, spec: GroupSpec) -> None:
    """Raise PoolError if a named worker does not exist, or if the bounds cannot be met."""
    members = [record for name in spec.names for record in steward.members(name)]
    if unknown := sorted((spec.workers or set()) - {record.info.name for record in members}):
        raise PoolError(
            f"`workers` names {', '.join(map(repr, unknown))}, but the partitions have no such "
            f"workers. Their workers are {join_names(members)}."
        )
    for name, most in spec.maximum.items():
        if (least := steward.rules[name].minimum) > most:
            raise PoolError(
                f"The rule of partition {name!r} has the minimum {least}, so its `max` cannot be "
                f"{most:g}."
            )
    total = len(members)
    # The default minimum of 1 is accepted for partitions that have lost their workers.
    if (least := sum(spec.minimum.values())) > max(total, len(spec.names)):
        raise PoolError(
            f"The partitions require {least} workers in total, but they have {total}. Reduce `min`."
        )
    if (most := sum(spec.maximum.values())) < total:
        raise PoolError(
            f"The partitions may have {most:g} workers in total, but they have {total}. "
            "Increase `max`, or remove workers with `shrink` first."
        )


def _check_same_kind(
    steward: Steward, spec: GroupSpec, gpus: Mapping[Hashable, bool | None]
) -> None:
    """Raise PoolError if some workers have GPUs and others do not."""
    kinds = {
        has_gpus: name
        for name in spec.names
        for record in steward.members(name)
        if (has_gpus := gpus.get(record.key)) is not None
    }
    if len(kinds) > 1:
        raise PoolError(
            f"Workers of partition {kinds[True]!r} have GPUs and workers of partition "
            f"{kinds[False]!r} do not, so they are not interchangeable. Balance only partitions "
            "with the same kind of workers, or pass the names of the workers that may be moved as "
            "`workers`."
        )


def _stats_of_group(names: Sequence[str], dask_scheduler: Any = None) -> BalanceStats:
    """Return the statistics of a group, which are empty if it does not exist."""
    balancer: GroupBalancer | None = dask_scheduler.plugins.get(NAME)
    group = balancer.find(names) if balancer is not None else None
    return BalanceStats({}) if group is None else BalanceStats(_loads(group), list(group.moves))


def _loads(group: _Group) -> dict[str, DemandStats]:
    """Return the load of each partition of a group at the last sample."""
    loads = {}
    for name, sample in group.samples.items():
        demand = group.policy.demands[name]
        loads[name] = DemandStats(
            workers=sample.workers,
            demand=demand.slots / sample.slots,
            backlog=sample.backlog,
            rate=demand.rate,
            task_s=demand.task_s,
            wait_s=demand.wait_s,
        )
    return loads


def _bind_group(names: Sequence[str], client_id: str, dask_scheduler: Any = None) -> None:
    """Let a group, if it exists, end with a client."""
    balancer: GroupBalancer | None = dask_scheduler.plugins.get(NAME)
    if balancer is not None and (group := balancer.find(names)) is not None:
        group.client = client_id


def names_of_groups(dask_scheduler: Any = None) -> list[tuple[str, ...]]:
    """Return the names of the partitions of each group. Runs on the scheduler."""
    return [group.spec.names for group in _groups(dask_scheduler)]


def _stop_group(names: Sequence[str], dask_scheduler: Any = None) -> None:
    """Stop balancing a group, if it exists."""
    balancer: GroupBalancer | None = dask_scheduler.plugins.get(NAME)
    if balancer is not None and (group := balancer.find(names)) is not None:
        balancer.remove(group)


def set_job_bounds(name: str, bounds: JobBounds, dask_scheduler: Any = None) -> str:
    """Change the allowed number of a partition's jobs, and return why this is impossible or ""."""
    if any(name in group.partitions for group in _groups(dask_scheduler)):
        return (
            f"Partition {name!r} belongs to a balanced group, so its workers cannot be started and "
            "stopped according to its work. Stop the group first."
        )
    if set_bounds(name, bounds, dask_scheduler):
        return ""
    return (
        f"Partition {name!r} has no jobs that can be started. Only partitions that "
        "`start_partitions` or `scale_groups` created are adaptive. To change the size of a "
        "partition of a divided pool, use `Partition.resize`."
    )


def recent_moves(scheduler: Any, count: int) -> list[WorkerMove]:
    """Return the last moves within all balanced groups, newest first."""
    groups = _groups(scheduler)
    moves = sorted((move for group in groups for move in group.moves), key=lambda move: move.time)
    return moves[: -count - 1 : -1]


def current_loads(scheduler: Any) -> list[dict[str, DemandStats]]:
    """Return the load of each partition of each balanced group."""
    return [_loads(group) for group in _groups(scheduler)]


def move_counts(scheduler: Any) -> Counter[tuple[str, str]]:
    """Return how many workers were moved so far, by source and destination."""
    balancer: GroupBalancer | None = scheduler.plugins.get(NAME)
    return Counter() if balancer is None else balancer.move_counts


def _groups(scheduler: Any) -> list[_Group]:
    balancer: GroupBalancer | None = scheduler.plugins.get(NAME)
    return [] if balancer is None else balancer.groups

"""Rules that choose the workers of a partition, at its division and when workers join later."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from numbers import Integral
from typing import Any

from .errors import PoolError
from .workers import WorkerInfo

NO_GPU = "no GPU in the pool: CPU workers instead"


@dataclass(frozen=True, kw_only=True)
class Rule:
    """Rule of a partition; every rule takes these parameters by name.

    Parameters
    ----------
    slots
        Tasks that each worker takes at a time; its number of threads by default.
    minimum
        Least number of workers: making the partition with fewer is an error, and moving workers
        never leaves it with fewer.
    exclusive
        Whether to keep other tasks off its workers: un-annotated tasks, collections, tasks of other
        users. Tasks that a worker already has end there.
    """

    slots: int | None = None
    minimum: int = 1
    exclusive: bool = False

    def __post_init__(self) -> None:
        for name, lower_bound in (("slots", 1), ("minimum", 0), ("max_workers", 1), ("workers", 0)):
            value = getattr(self, name, None)
            if value is not None:
                check_count(f"{name} of the rule {type(self).__name__}", value, lower_bound)

    def choose(self, free: Sequence[WorkerInfo]) -> list[WorkerInfo]:
        """Choose from available workers; the first workers are preferred.

        This base class chooses none: the members of a partition without a rule were started with
        its resource.
        """
        return []

    def wants(
        self, worker: WorkerInfo, members: Sequence[WorkerInfo], everyone: Sequence[WorkerInfo]
    ) -> bool:
        """Whether to add a worker to the members; `everyone` is the list of all workers."""
        return len(self.choose([*members, worker])) > len(self.choose(members))

    def slots_of(self, worker: WorkerInfo) -> int:
        """Return the slots of a worker as a member."""
        return self.slots or worker.nthreads


@dataclass(frozen=True)
class per_gpu(Rule):  # noqa: N801 - reads as a function, like the rules below
    """At most `max_workers` for each GPU; in a pool without GPUs, CPU workers of each host.

    Examples
    --------
    >>> per_gpu(1)
    per_gpu(slots=None, minimum=1, exclusive=False, max_workers=1)
    """

    max_workers: int

    def choose(self, free: Sequence[WorkerInfo]) -> list[WorkerInfo]:
        """Choose workers that share the GPUs evenly."""
        if not any(worker.gpus for worker in free):
            return per_host(self.max_workers).choose(free)
        workers_of_gpu: Counter[str] = Counter()
        chosen = []
        # Workers that see the fewest GPUs come first: the others have more choice.
        for worker in sorted(free, key=lambda worker: len(worker.gpus)):
            if worker.gpus:
                gpu = min(worker.gpus, key=lambda gpu: workers_of_gpu[gpu])
                if workers_of_gpu[gpu] < self.max_workers:
                    workers_of_gpu[gpu] += 1
                    chosen.append(worker)
        return chosen

    def wants(
        self, worker: WorkerInfo, members: Sequence[WorkerInfo], everyone: Sequence[WorkerInfo]
    ) -> bool:
        """Whether the worker has a spare GPU, or no worker has any."""
        if not worker.gpus and any(candidate.gpus for candidate in everyone):
            return False
        same_kind = [member for member in members if bool(member.gpus) == bool(worker.gpus)]
        return super().wants(worker, same_kind, everyone)


@dataclass(frozen=True)
class per_host(Rule):  # noqa: N801
    """At most `max_workers` of each host."""

    max_workers: int

    def choose(self, free: Sequence[WorkerInfo]) -> list[WorkerInfo]:
        """Choose the first workers of each host."""
        workers_of_host: Counter[str] = Counter()
        chosen = []
        for worker in free:
            if workers_of_host[worker.host] < self.max_workers:
                workers_of_host[worker.host] += 1
                chosen.append(worker)
        return chosen


@dataclass(frozen=True)
class n_workers(Rule):  # noqa: N801
    """A number of workers on any host."""

    workers: int

    def choose(self, free: Sequence[WorkerInfo]) -> list[WorkerInfo]:
        """Choose the first workers."""
        return list(free[: self.workers])


@dataclass(frozen=True)
class Named(Rule):
    """The workers of a list of names or addresses, see `named`."""

    names: tuple[str, ...]

    def choose(self, free: Sequence[WorkerInfo]) -> list[WorkerInfo]:
        """Choose the named workers that are available."""
        return [worker for worker in free if {worker.name, worker.address} & set(self.names)]


@dataclass(frozen=True)
class rest(Rule):  # noqa: N801
    """Every worker that no earlier rule takes, perhaps none."""

    minimum: int = field(default=0, kw_only=True)

    def choose(self, free: Sequence[WorkerInfo]) -> list[WorkerInfo]:
        """Choose all available workers."""
        return list(free)


def named(*names: str, **common: Any) -> Named:
    """Return a rule that takes the workers of these names or addresses, also if they join later."""
    return Named(tuple(map(str, names)), **common)


def divide(
    rules: Mapping[str, Rule], pool: Sequence[WorkerInfo]
) -> tuple[dict[str, list[WorkerInfo]], dict[str, str]]:
    """Divide workers by rules, in order: each rule takes workers that earlier rules have left.

    Workers that a rule names are kept for that rule. Present members of a partition come first, so
    that repeating the rules gives the same partitions. Workers that declare another resource are
    not taken.

    Returns
    -------
    chosen
        {partition: workers}.
    notes
        {partition: what a user should know of the choice}.

    Raises
    ------
    PoolError
        If a partition would have fewer workers than its minimum.
    """
    chosen: dict[str, list[WorkerInfo]] = {}
    notes: dict[str, str] = {}
    chosen_addresses: set[str] = set()  # not names, which may repeat
    named_by_rules = {n for rule in rules.values() if isinstance(rule, Named) for n in rule.names}
    for name, rule in rules.items():
        declaring = [worker for worker in pool if worker.partitions == {name}]
        free = [w for w in pool if not w.partitions and w.address not in chosen_addresses]
        if not isinstance(rule, Named):
            free = [w for w in free if not named_by_rules & {w.name, w.address}]
        free = [*declaring, *free]
        chosen[name] = rule.choose(free)
        chosen_addresses |= {worker.address for worker in chosen[name]}
        if len(chosen[name]) < rule.minimum:
            advice = _advice(rule, free, pool)
            raise PoolError(
                f"Partition {name!r} would have {len(chosen[name])} of the {rule.minimum} workers "
                f"that it needs: {advice} Workers that declare another resource are not taken."
            )
        if isinstance(rule, per_gpu) and free and not any(worker.gpus for worker in free):
            notes[name] = NO_GPU
        if isinstance(rule, n_workers) and len(chosen[name]) < rule.workers:
            notes[name] = (
                f"has {len(chosen[name])} of the {rule.workers} workers that it asks for; later "
                "workers join it"
            )
    return chosen, notes


def _advice(rule: Rule, free: Sequence[WorkerInfo], pool: Sequence[WorkerInfo]) -> str:
    """Return advice about a rule that has too few workers."""
    if not isinstance(rule, Named):
        return f"{len(free)} of {len(pool)} are left for it. Start more, or list it first."
    present = ", ".join(repr(worker.name) for worker in pool[:9])
    ending = ", …." if len(pool) > 9 else "."
    return f"it asks for {', '.join(map(repr, rule.names))}, and there are {present}{ending}"


def partition_for(
    worker: WorkerInfo,
    rules: Mapping[str, Rule],
    members: Mapping[str, Sequence[WorkerInfo]],
) -> str | None:
    """Return the partition of a worker that joins, or None.

    A rule that names the worker comes first, then partitions with fewer workers than their
    minimum or with none, then the order of the rules.
    """
    everyone = [worker, *(member for group in members.values() for member in group)]
    willing = [name for name, rule in rules.items() if rule.wants(worker, members[name], everyone)]
    short = [
        name
        for name in willing
        if len(members[name]) < max(rules[name].minimum, not isinstance(rules[name], rest))
    ]
    by_name = [name for name in willing if isinstance(rules[name], Named)]
    return next(iter([*by_name, *short, *willing]), None)


def check_name(partition: object) -> None:
    """Raise a PoolError unless a value can be the name of a partition."""
    if not isinstance(partition, str) or not partition:
        raise PoolError(f"The name of a partition is {partition!r}; give one such as 'GPU'.")


def check_count(name: str, count: object, minimum: int = 1) -> None:
    """Raise a PoolError unless a count is a whole number of at least `least`."""
    if not isinstance(count, Integral) or count < minimum:
        raise PoolError(f"{name} is {count!r}; give a whole number, {minimum} or more.")

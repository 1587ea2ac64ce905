"""Rules that say which workers a partition is made of, now and when more join."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from .errors import PoolError
from .selection import NO_GPU, by_gpu, by_host, check_name, check_slots, left_alone
from .wording import counted
from .worker_info import WorkerInfo


@dataclass(frozen=True, kw_only=True)
class Rule:
    """What a partition wants.

    Parameters
    ----------
    slots
        Tasks that each worker takes at a time; its number of threads by default.
    minimum
        Workers without which the partition is of no use: there is an error when it is made
        with fewer, and moving workers never leaves it with fewer.
    exclusive
        Whether tasks of others are kept off its workers.
    """

    slots: int | None = None
    minimum: int = 1
    exclusive: bool = False

    def choose(self, free: Sequence[WorkerInfo]) -> list[WorkerInfo]:
        """Take what it wants of workers that may be had; the first ones are preferred."""
        raise NotImplementedError

    def wants(
        self, worker: WorkerInfo, members: Sequence[WorkerInfo], everyone: Sequence[WorkerInfo]
    ) -> bool:
        """Whether one more worker is wanted, beside the members that there are.

        Parameters
        ----------
        worker
            The one that may join.
        members
            The partition's workers.
        everyone
            All workers of the cluster.
        """
        return len(self.choose([*members, worker])) > len(self.choose(members))

    def slots_of(self, worker: WorkerInfo) -> int:
        """Slots that a worker gets as a member."""
        return self.slots or worker.nthreads


@dataclass(frozen=True, kw_only=True)
class PerGpu(Rule):
    """At most so many workers for each GPU, or where there is none for each host."""

    most: int

    def choose(self, free: Sequence[WorkerInfo]) -> list[WorkerInfo]:
        """Workers that share the GPUs evenly."""
        return by_gpu(free, self.most)[0]

    def wants(
        self, worker: WorkerInfo, members: Sequence[WorkerInfo], everyone: Sequence[WorkerInfo]
    ) -> bool:
        """Want a worker with a GPU to spare; one without only where nobody has a GPU."""
        if not worker.gpus and any(other.gpus for other in everyone):
            return False
        alike = [member for member in members if bool(member.gpus) == bool(worker.gpus)]
        return super().wants(worker, alike, everyone)


@dataclass(frozen=True, kw_only=True)
class PerHost(Rule):
    """At most so many workers of each host."""

    most: int

    def choose(self, free: Sequence[WorkerInfo]) -> list[WorkerInfo]:
        """Take the first of each host."""
        return by_host(free, self.most)


@dataclass(frozen=True, kw_only=True)
class Count(Rule):
    """So many workers, wherever they are."""

    workers: int

    def choose(self, free: Sequence[WorkerInfo]) -> list[WorkerInfo]:
        """Take the first ones."""
        return list(free[: self.workers])


@dataclass(frozen=True, kw_only=True)
class Named(Rule):
    """Workers of these names or addresses."""

    names: tuple[str, ...]

    def choose(self, free: Sequence[WorkerInfo]) -> list[WorkerInfo]:
        """Those of them that are there."""
        return [worker for worker in free if {worker.name, worker.address} & set(self.names)]


@dataclass(frozen=True, kw_only=True)
class Rest(Rule):
    """Every worker that no rule before it wants."""

    def choose(self, free: Sequence[WorkerInfo]) -> list[WorkerInfo]:
        """All of them."""
        return list(free)


@dataclass(frozen=True, kw_only=True)
class Declared(Rule):
    """Workers that were started with the resource; nobody else joins by itself."""

    def choose(self, free: Sequence[WorkerInfo]) -> list[WorkerInfo]:
        """None: who declares the resource belongs without being chosen."""
        return []


def per_gpu(
    most: int, *, slots: int | None = None, minimum: int = 1, exclusive: bool = False
) -> PerGpu:
    """At most so many workers for each GPU; CPU workers, so many a host, where there is none.

    `slots`, `minimum` and `exclusive` are those of every `Rule`.

    Examples
    --------
    >>> per_gpu(1)
    PerGpu(slots=None, minimum=1, exclusive=False, most=1)
    """
    return PerGpu(most=most, slots=slots, minimum=minimum, exclusive=exclusive)


def per_host(
    most: int, *, slots: int | None = None, minimum: int = 1, exclusive: bool = False
) -> PerHost:
    """At most so many workers of each host; `slots` and the rest as in every `Rule`."""
    return PerHost(most=most, slots=slots, minimum=minimum, exclusive=exclusive)


def n_workers(
    workers: int, *, slots: int | None = None, minimum: int = 1, exclusive: bool = False
) -> Count:
    """So many workers, wherever they are; `slots` and the rest as in every `Rule`."""
    return Count(workers=workers, slots=slots, minimum=minimum, exclusive=exclusive)


def named(
    *names: str, slots: int | None = None, minimum: int = 1, exclusive: bool = False
) -> Named:
    """Workers of these names or addresses; one that is not there yet belongs when it joins.

    `slots`, `minimum` and `exclusive` are those of every `Rule`.
    """
    names = tuple(str(name) for name in names)
    return Named(names=names, slots=slots, minimum=minimum, exclusive=exclusive)


def rest(*, slots: int | None = None, minimum: int = 0, exclusive: bool = False) -> Rest:
    """Every worker that no rule before it wants; also where others find more workers.

    `slots`, `minimum` and `exclusive` are those of every `Rule`; there may be none by default.
    """
    return Rest(slots=slots, minimum=minimum, exclusive=exclusive)


def rule_of(given: Mapping[str, Any], names: Sequence[str], common: Mapping[str, Any]) -> Rule:
    """Make the rule that goes on choosing as a selector of `Pool.partition` does."""
    if given["max_workers_per_gpu"] is not None:
        return PerGpu(most=given["max_workers_per_gpu"], **common)
    if given["max_workers_per_host"] is not None:
        return PerHost(most=given["max_workers_per_host"], **common)
    if given["n_workers"] is not None:
        return Count(workers=given["n_workers"], **common)
    return Named(names=tuple(names), **common)


def divide(
    rules: Mapping[str, Rule], pool: Sequence[WorkerInfo]
) -> tuple[dict[str, list[WorkerInfo]], dict[str, str]]:
    """Divide workers by rules, each of which takes of what those before it have left.

    Workers that a rule names are kept for it. Members of a partition come first, so that the
    same rules, again, make the same partitions. Workers that declare something else are left
    alone.

    Returns
    -------
    chosen, notes
        Workers by partition, and what a user should know of a choice, where there is anything.

    Raises
    ------
    PoolError
        If a partition would have fewer workers than its minimum.
    """
    chosen: dict[str, list[WorkerInfo]] = {}
    notes: dict[str, str] = {}
    taken: set[str] = set()  # addresses: names need not differ
    named_by = {n for rule in rules.values() if isinstance(rule, Named) for n in rule.names}
    for name, rule in rules.items():
        free = [worker for worker in pool if worker.partitions == {name}]
        free += [w for w in pool if not w.partitions and w.address not in taken]
        if not isinstance(rule, Named):
            free = [worker for worker in free if not named_by & {worker.name, worker.address}]
        chosen[name] = rule.choose(free)
        taken |= {worker.address for worker in chosen[name]}
        if len(chosen[name]) < rule.minimum:
            raise PoolError(
                f"Partition {name!r} would have {counted(len(chosen[name]), 'worker')} of the "
                f"{rule.minimum} that it needs: {len(free)} of {len(pool)} are left for it. "
                f"Start more workers, or put it before others.{left_alone(name, pool)}"
            )
        if isinstance(rule, PerGpu) and free and not any(worker.gpus for worker in free):
            notes[name] = NO_GPU
    return chosen, notes


def partition_for(
    worker: WorkerInfo,
    rules: Mapping[str, Rule],
    members: Mapping[str, Sequence[WorkerInfo]],
) -> str | None:
    """Which partition a worker that joins belongs to; None for none.

    A rule that names it comes first, then partitions with fewer workers than their minimum or
    with none, then those whose rule comes first.
    """
    everyone = [worker, *(member for group in members.values() for member in group)]
    willing = [n for n, rule in rules.items() if rule.wants(worker, members[n], everyone)]
    short = [
        name
        for name in willing
        if len(members[name]) < max(rules[name].minimum, not isinstance(rules[name], Rest))
    ]
    by_name = [name for name in willing if isinstance(rules[name], Named)]
    return next(iter([*by_name, *short, *willing]), None)


def check_rules(rules: Mapping[str, Rule]) -> None:
    """Check rules as they were given; PoolError unless they make sense."""
    if not isinstance(rules, Mapping):
        raise PoolError(f'The rules are {rules!r}; give a dict, such as {{"NAME": rest()}}.')
    if not rules:
        raise PoolError('There are no rules to divide by; give {"NAME": rest()}, for example.')
    for name, rule in rules.items():
        check_name(name)
        if not isinstance(rule, Rule):
            raise PoolError(
                f"The rule of partition {name!r} is {rule!r}; give one, such as per_host(2)."
            )
        check_rule(name, rule)


def check_rule(name: str, rule: Rule) -> None:
    """Check one rule; PoolError unless it makes sense."""
    check_slots(rule.slots)
    if not isinstance(rule.minimum, int) or rule.minimum < 0:
        raise PoolError(f"minimum of {name!r} is {rule.minimum!r}; give a whole number, 0 or more.")
    number = getattr(rule, "most", getattr(rule, "workers", 1))
    if not isinstance(number, int) or number < 1:
        raise PoolError(f"The rule of {name!r} is {rule}: give a whole number, 1 or more.")
    if isinstance(rule, Count) and rule.minimum > rule.workers:
        raise PoolError(f"Partition {name!r} has a minimum above its {rule.workers} workers.")

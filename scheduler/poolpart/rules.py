"""Rules that choose the workers of a partition, now and when more join."""

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
    """Rule of a partition; every rule takes these by name.

    Parameters
    ----------
    slots
        Tasks that each worker takes at a time; its number of threads by default.
    minimum
        Least number of workers: making it with fewer is an error, and moving workers never
        leaves it with fewer.
    exclusive
        Whether to keep other tasks off its workers: un-annotated ones, collections, those of other
        users. Tasks that a worker already has end there.
    """

    slots: int | None = None
    minimum: int = 1
    exclusive: bool = False

    def __post_init__(self) -> None:
        for name, least in (("slots", 1), ("minimum", 0), ("most", 1), ("workers", 0)):
            if (value := getattr(self, name, None)) is not None:
                check_count(f"{name} of the rule {type(self).__name__}", value, least)

    def choose(self, free: Sequence[WorkerInfo]) -> list[WorkerInfo]:
        """Choose from available workers; the first ones are preferred.

        Here none: of a partition without a rule, the members were started with its resource.
        """
        return []

    def wants(
        self, worker: WorkerInfo, members: Sequence[WorkerInfo], everyone: Sequence[WorkerInfo]
    ) -> bool:
        """Whether to add a worker to the members; `everyone` is all workers."""
        return len(self.choose([*members, worker])) > len(self.choose(members))

    def slots_of(self, worker: WorkerInfo) -> int:
        """Slots of a worker as a member."""
        return self.slots or worker.nthreads


@dataclass(frozen=True)
class per_gpu(Rule):  # noqa: N801 - the name of a rule, not of a kind of rules, as of all below
    """At most so many workers for each GPU; without GPUs so many CPU workers a host.

    Examples
    --------
    >>> per_gpu(1)
    per_gpu(slots=None, minimum=1, exclusive=False, most=1)
    """

    most: int

    def choose(self, free: Sequence[WorkerInfo]) -> list[WorkerInfo]:
        """Workers that share the GPUs evenly."""
        if not any(worker.gpus for worker in free):
            return per_host(self.most).choose(free)
        taken: Counter[str] = Counter()  # {GPU: workers chosen for it}
        chosen = []
        # Those that see the fewest GPUs first: the others have more choice.
        for worker in sorted(free, key=lambda worker: len(worker.gpus)):
            if worker.gpus:
                gpu = min(worker.gpus, key=lambda gpu: taken[gpu])
                if taken[gpu] < self.most:
                    taken[gpu] += 1
                    chosen.append(worker)
        return chosen

    def wants(
        self, worker: WorkerInfo, members: Sequence[WorkerInfo], everyone: Sequence[WorkerInfo]
    ) -> bool:
        """Whether the worker has a spare GPU, or no worker has any."""
        if not worker.gpus and any(other.gpus for other in everyone):
            return False
        alike = [member for member in members if bool(member.gpus) == bool(worker.gpus)]
        return super().wants(worker, alike, everyone)


@dataclass(frozen=True)
class per_host(Rule):  # noqa: N801
    """At most so many workers of each host."""

    most: int

    def choose(self, free: Sequence[WorkerInfo]) -> list[WorkerInfo]:
        """Take the first of each host."""
        taken: Counter[str] = Counter()
        chosen = []
        for worker in free:
            if taken[worker.host] < self.most:
                taken[worker.host] += 1
                chosen.append(worker)
        return chosen


@dataclass(frozen=True)
class n_workers(Rule):  # noqa: N801
    """So many workers, wherever they are."""

    workers: int

    def choose(self, free: Sequence[WorkerInfo]) -> list[WorkerInfo]:
        """Take the first ones."""
        return list(free[: self.workers])


@dataclass(frozen=True)
class Named(Rule):
    """The rule that `named` makes."""

    names: tuple[str, ...]

    def choose(self, free: Sequence[WorkerInfo]) -> list[WorkerInfo]:
        """Choose those of them that are present."""
        return [worker for worker in free if {worker.name, worker.address} & set(self.names)]


@dataclass(frozen=True)
class rest(Rule):  # noqa: N801
    """Every worker that no earlier rule takes, perhaps none."""

    minimum: int = field(default=0, kw_only=True)

    def choose(self, free: Sequence[WorkerInfo]) -> list[WorkerInfo]:
        """All of them."""
        return list(free)


def named(*names: str, **common: Any) -> Named:
    """Workers of these names or addresses, also those that join later."""
    return Named(tuple(map(str, names)), **common)


def divide(
    rules: Mapping[str, Rule], pool: Sequence[WorkerInfo]
) -> tuple[dict[str, list[WorkerInfo]], dict[str, str]]:
    """Divide workers by rules, each of which takes from the workers that the others have left.

    Workers that a rule names are kept for it. Members of a partition come first, so that
    repeating the rules gives the same partitions. Workers that declare another resource are not
    taken. Returns the workers by partition, and notes on the choices. PoolError if a partition
    would have fewer workers than its minimum.
    """
    chosen: dict[str, list[WorkerInfo]] = {}
    notes: dict[str, str] = {}
    taken: set[str] = set()  # addresses, because names may repeat
    named_by = {n for rule in rules.values() if isinstance(rule, Named) for n in rule.names}
    for name, rule in rules.items():
        declaring = [worker for worker in pool if worker.partitions == {name}]
        free = [w for w in pool if not w.partitions and w.address not in taken]
        if not isinstance(rule, Named):
            free = [worker for worker in free if not named_by & {worker.name, worker.address}]
        free = [*declaring, *free]
        chosen[name] = rule.choose(free)
        taken |= {worker.address for worker in chosen[name]}
        if len(chosen[name]) < rule.minimum:
            advice = f"{len(free)} of {len(pool)} are left for it. Start more, or list it first."
            if isinstance(rule, Named):
                names = ", ".join(repr(worker.name) for worker in pool[:9])
                advice = f"it asks for {', '.join(map(repr, rule.names))}, and there are {names}"
                advice += ", …." if len(pool) > 9 else "."
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


def partition_for(
    worker: WorkerInfo,
    rules: Mapping[str, Rule],
    members: Mapping[str, Sequence[WorkerInfo]],
) -> str | None:
    """Partition of a worker that joins; None for none.

    A rule that names the worker comes first, then partitions with fewer workers than their
    minimum or with none, then the order of the rules.
    """
    everyone = [worker, *(member for group in members.values() for member in group)]
    willing = [n for n, rule in rules.items() if rule.wants(worker, members[n], everyone)]
    short = [
        name
        for name in willing
        if len(members[name]) < max(rules[name].minimum, not isinstance(rules[name], rest))
    ]
    by_name = [name for name in willing if isinstance(rules[name], Named)]
    return next(iter([*by_name, *short, *willing]), None)


def check_name(partition: object) -> None:
    """Check the name of a partition; PoolError unless it is one."""
    if not isinstance(partition, str) or not partition:
        raise PoolError(f"The name of a partition is {partition!r}; give one such as 'GPU'.")


def check_count(name: str, count: object, least: int = 1) -> None:
    """Check a number; PoolError unless it is whole and large enough."""
    if not isinstance(count, Integral) or count < least:
        raise PoolError(f"{name} is {count!r}; give a whole number, {least} or more.")

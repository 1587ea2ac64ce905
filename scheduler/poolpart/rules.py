"""Rules that choose the workers of a partition, at its division and when workers join later."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from numbers import Integral
from typing import Any, NamedTuple

from .errors import PoolError
from .workers import WorkerInfo

NO_GPU = "no GPU in the pool: CPU workers instead"


@dataclass(frozen=True, kw_only=True)
class Rule:
    """Rule of a partition, with parameters by name that every rule takes.

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
        """Choose from available workers, and prefer the first workers.

        This base class chooses none: the members of a partition without a rule were started with
        its resource.
        """
        return []

    def wants(
        self, worker: WorkerInfo, members: Sequence[WorkerInfo], everyone: Sequence[WorkerInfo]
    ) -> bool:
        """Whether to add a worker to the members, where `everyone` lists all workers."""
        return len(self.choose([*members, worker])) > len(self.choose(members))

    @property
    def target(self) -> int | None:
        """Number of workers that the rule asks for, or None if that depends on the cluster."""
        return None

    def slots_of(self, worker: WorkerInfo) -> int:
        """Return the slots of a worker as a member."""
        return self.slots or worker.nthreads


@dataclass(frozen=True)
class per_gpu(Rule):  # noqa: N801 - reads as a function, like the rules below
    """At most `max_workers` for each GPU or, in a pool without GPUs, CPU workers of each host.

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

    @property
    def target(self) -> int:
        """The given number."""
        return self.workers


@dataclass(frozen=True)
class Named(Rule):
    """The workers of a list of names or addresses, as `named` makes it."""

    names: tuple[str, ...]

    def choose(self, free: Sequence[WorkerInfo]) -> list[WorkerInfo]:
        """Choose the named workers that are available."""
        return [worker for worker in free if {worker.name, worker.address} & set(self.names)]

    @property
    def target(self) -> int:
        """Number of names."""
        return len(self.names)

    def missing(self, members: Sequence[WorkerInfo]) -> list[str]:
        """Return the names that none of the members has."""
        present = {name for worker in members for name in (worker.name, worker.address)}
        return [name for name in self.names if name not in present]


@dataclass(frozen=True)
class rest(Rule):  # noqa: N801
    """Every worker that no earlier rule takes, perhaps none."""

    minimum: int = field(default=0, kw_only=True)

    def choose(self, free: Sequence[WorkerInfo]) -> list[WorkerInfo]:
        """Choose all available workers."""
        return list(free)


def named(*names: str | int, **common: Any) -> Named:
    """Return a rule that takes the workers of these names or addresses, now or when they join.

    Raises
    ------
    PoolError
        If no name is given, or a name is a list or the like.
    """
    wrong = [name for name in names if isinstance(name, bool) or not isinstance(name, str | int)]
    if wrong or not names:
        value = repr(wrong[0]) if wrong else "nothing"
        raise PoolError(
            f"The rule named() got {value}; give names or addresses of workers, each as an "
            'argument, such as named("0", "1").'
        )
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
        If a partition would have fewer workers than its minimum, or two rules take the rest.
    """
    takers_of_rest = [name for name, rule in rules.items() if isinstance(rule, rest)]
    if len(takers_of_rest) > 1:
        first, second, *_ = takers_of_rest
        raise PoolError(
            f"Partitions {first!r} and {second!r} both have the rule rest(), and {first!r} takes "
            f"all workers: give {second!r} another rule, such as n_workers(2), before {first!r}."
        )
    chosen: dict[str, list[WorkerInfo]] = {}
    notes: dict[str, str] = {}
    for name, (rule, free, workers) in _choices(rules, pool).items():
        chosen[name] = workers
        if len(workers) < rule.minimum:
            advice = _advice(rule, free, pool)
            raise PoolError(
                f"Partition {name!r} would have {len(workers)} of the "
                f"{workers_in_words(rule.minimum)} that it needs: {advice}"
            )
        if isinstance(rule, per_gpu) and free and not any(worker.gpus for worker in free):
            notes[name] = NO_GPU
        if isinstance(rule, n_workers) and len(workers) < rule.workers:
            notes[name] = (
                f"has {len(workers)} of the {workers_in_words(rule.workers)} that it asks for; "
                "later workers join it"
            )
        if isinstance(rule, Named) and (missing := rule.missing(workers)):
            notes[name] = f"lacks {', '.join(map(repr, missing))}, for which its rule asks"
    return chosen, notes


class _Choice(NamedTuple):
    """What a rule chooses."""

    rule: Rule
    free: list[WorkerInfo]  # workers that the rule may take
    workers: list[WorkerInfo]  # those that it takes


def _choices(rules: Mapping[str, Rule], pool: Sequence[WorkerInfo]) -> dict[str, _Choice]:
    """Return the choice of each rule, by partition, even of fewer workers than its minimum."""
    choices: dict[str, _Choice] = {}
    chosen_addresses: set[str] = set()  # not names, which may repeat
    named_by_rules = {n for rule in rules.values() if isinstance(rule, Named) for n in rule.names}
    for name, rule in rules.items():
        declaring = [worker for worker in pool if worker.partitions == {name}]
        free = [w for w in pool if not w.partitions and w.address not in chosen_addresses]
        if not isinstance(rule, Named):
            free = [w for w in free if not named_by_rules & {w.name, w.address}]
        free = [*declaring, *free]
        choices[name] = _Choice(rule, free, rule.choose(free))
        chosen_addresses |= {worker.address for worker in choices[name].workers}
    return choices


def shortfalls(
    rules: Mapping[str, Rule], pool: Sequence[WorkerInfo], pool_as_seen: Sequence[WorkerInfo]
) -> dict[str, str]:
    """Return a note for each partition that gets fewer workers than the client could expect.

    Parameters
    ----------
    rules
        Rules that choose the workers, by partition.
    pool, pool_as_seen
        The workers with the resources that they declare now, and with those that the client saw.
    """
    now = _choices(rules, pool)
    expected = _choices(rules, pool_as_seen)
    return {
        name: f"has {len(now[name].workers)} of the {workers_in_words(len(choice.workers))} that "
        "its rule would have taken when this pool was made: other partitions have taken workers "
        "since"
        for name, choice in expected.items()
        if len(now[name].workers) < len(choice.workers)
    }


def _advice(rule: Rule, free: Sequence[WorkerInfo], pool: Sequence[WorkerInfo]) -> str:
    """Return advice about a rule that has too few workers."""
    elsewhere = [worker for worker in pool if worker.partitions and worker not in free]
    advice = ""
    if elsewhere:
        resources = sorted({resource for worker in elsewhere for resource in worker.partitions})
        verb = "declares" if len(elsewhere) == 1 else "declare"
        advice = (
            f" {len(elsewhere)} {verb} the resource{'s' if len(resources) > 1 else ''} "
            f"{', '.join(resources[:9])} already, and a worker belongs to one partition. To divide "
            "the workers anew, dissolve their partitions. To move workers of a partition, even if "
            "they were started with its resource, give a rule with minimum=0, and call resize with "
            "source."
        )
    if not isinstance(rule, Named):
        return f"{len(free)} of {len(pool)} are left for it. Start more, or list it first.{advice}"
    present = ", ".join(repr(worker.name) for worker in pool[:9])
    ending = ", …." if len(pool) > 9 else "."
    names = ", ".join(map(repr, rule.names))
    return f"it asks for {names}, and there are {present}{ending}{advice}"


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


def workers_in_words(count: int, kind: str = "") -> str:
    """Return a number of workers for a message, such as "1 spare worker"."""
    return " ".join(filter(None, (str(count), kind, "worker" if count == 1 else "workers")))


def check_name(partition: object) -> None:
    """Raise a PoolError unless a value can be the name of a partition."""
    if not isinstance(partition, str) or not partition:
        raise PoolError(f"The name of a partition is {partition!r}; give one such as 'GPU'.")


def check_count(name: str, count: object, minimum: int = 1) -> None:
    """Raise a PoolError unless a count is a whole number of at least `minimum`."""
    if not isinstance(count, Integral) or count < minimum:
        raise PoolError(f"{name} is {count!r}; give a whole number, {minimum} or more.")

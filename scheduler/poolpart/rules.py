"""Rules that select a partition's workers, both initially and when workers join later."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from numbers import Integral
from typing import Any, NamedTuple

from .errors import PoolError
from .workers import WorkerInfo

NO_GPU = "The pool has no GPU. The partition uses CPU workers instead."


@dataclass(frozen=True, kw_only=True)
class Rule:
    """Base class for rules that select the workers of a partition.

    Parameters
    ----------
    slots
        Number of tasks that each worker runs at the same time. By default, its number of threads.
    minimum
        Minimum number of workers. A partition cannot be created with fewer workers, and moving
        workers to other partitions never leaves it with fewer. Partitions in which workers were
        started have no rule, and a minimum of 0.
    exclusive
        Whether to keep other tasks off the workers, which are tasks without a partition,
        collections, and tasks of other users. Other tasks that are already assigned to a worker
        still finish there.
    """

    slots: int | None = None
    minimum: int = 1
    exclusive: bool = False

    def __post_init__(self) -> None:
        for name, lower_bound in (("slots", 1), ("minimum", 0), ("max_workers", 1), ("workers", 0)):
            value = getattr(self, name, None)
            if value is not None:
                check_count(f"`{name}` of the rule `{type(self).__name__}`", value, lower_bound)

    def choose(self, free: Sequence[WorkerInfo]) -> list[WorkerInfo]:
        """Select workers from those available, preferring the first ones.

        The base class selects no workers. It is the rule of partitions whose members were started
        with the resource.
        """
        return []

    def accepts(
        self, worker: WorkerInfo, members: Sequence[WorkerInfo], everyone: Sequence[WorkerInfo]
    ) -> bool:
        """Return whether a worker should be added to the members, given all workers."""
        return len(self.choose([*members, worker])) > len(self.choose(members))

    @property
    def target(self) -> int | None:
        """Number of workers that the rule requests, or None if it depends on the cluster."""
        return None

    def slots_of(self, worker: WorkerInfo) -> int:
        """Return the number of slots that a worker has in this partition."""
        return self.slots or worker.nthreads


@dataclass(frozen=True)
class per_gpu(Rule):  # noqa: N801 - reads as a function, like the rules below
    """Select up to `max_workers` workers for each GPU.

    If the pool has no GPU, select up to `max_workers` CPU workers on each host instead. The
    partition then has a note, which is logged as a warning.

    Examples
    --------
    >>> per_gpu(1)
    per_gpu(slots=None, minimum=1, exclusive=False, max_workers=1)
    """

    max_workers: int

    def choose(self, free: Sequence[WorkerInfo]) -> list[WorkerInfo]:
        """Select workers so that they are distributed evenly over the GPUs."""
        if not any(worker.gpus for worker in free):
            return per_host(self.max_workers).choose(free)
        workers_of_gpu: Counter[str] = Counter()
        chosen = []
        # Workers that see the fewest GPUs come first, because they have the fewest alternatives.
        for worker in sorted(free, key=lambda worker: len(worker.gpus)):
            if worker.gpus:
                gpu = min(worker.gpus, key=lambda gpu: workers_of_gpu[gpu])
                if workers_of_gpu[gpu] < self.max_workers:
                    workers_of_gpu[gpu] += 1
                    chosen.append(worker)
        return chosen

    def accepts(
        self, worker: WorkerInfo, members: Sequence[WorkerInfo], everyone: Sequence[WorkerInfo]
    ) -> bool:
        """Return whether a worker should be added. It must have a GPU if any worker has one."""
        if not worker.gpus and any(candidate.gpus for candidate in everyone):
            return False
        same_kind = [member for member in members if bool(member.gpus) == bool(worker.gpus)]
        return super().accepts(worker, same_kind, everyone)


@dataclass(frozen=True)
class per_host(Rule):  # noqa: N801
    """Select up to `max_workers` workers on each host.

    Examples
    --------
    >>> per_host(2, slots=4)
    per_host(slots=4, minimum=1, exclusive=False, max_workers=2)
    """

    max_workers: int

    def choose(self, free: Sequence[WorkerInfo]) -> list[WorkerInfo]:
        """Select the first available workers on each host."""
        workers_of_host: Counter[str] = Counter()
        chosen = []
        for worker in free:
            if workers_of_host[worker.host] < self.max_workers:
                workers_of_host[worker.host] += 1
                chosen.append(worker)
        return chosen


@dataclass(frozen=True)
class n_workers(Rule):  # noqa: N801
    """Select the given number of workers, regardless of their hosts.

    If the cluster has fewer workers, but at least `minimum`, workers that join later are added.

    Examples
    --------
    >>> n_workers(2, minimum=0)
    n_workers(slots=None, minimum=0, exclusive=False, workers=2)
    """

    workers: int

    def choose(self, free: Sequence[WorkerInfo]) -> list[WorkerInfo]:
        """Select the first available workers."""
        return list(free[: self.workers])

    @property
    def target(self) -> int:
        """Number of workers that the rule requests."""
        return self.workers


@dataclass(frozen=True)
class NamedWorkers(Rule):
    """Rule that selects workers by name or address, created by `named`."""

    names: tuple[str, ...]

    def choose(self, free: Sequence[WorkerInfo]) -> list[WorkerInfo]:
        """Select those named workers that are available."""
        return [worker for worker in free if {worker.name, worker.address} & set(self.names)]

    @property
    def target(self) -> int:
        """Number of names in the rule."""
        return len(self.names)

    def missing_names(self, members: Sequence[WorkerInfo]) -> list[str]:
        """Return the names that match none of the members."""
        present = {name for worker in members for name in (worker.name, worker.address)}
        return [name for name in self.names if name not in present]


@dataclass(frozen=True)
class rest(Rule):  # noqa: N801
    """Select all workers that no other rule has selected. There may be none.

    Only one rule of a division can be `rest`.

    Examples
    --------
    >>> rest(exclusive=True)
    rest(slots=None, minimum=0, exclusive=True)
    """

    minimum: int = field(default=0, kw_only=True)

    def choose(self, free: Sequence[WorkerInfo]) -> list[WorkerInfo]:
        """Select all available workers."""
        return list(free)


def named(*names: str | int, **common: Any) -> NamedWorkers:
    """Return a rule that selects workers by name or address, including workers that join later.

    Raises
    ------
    PoolError
        If no name is passed, or if a name is not a string or an integer.

    Examples
    --------
    >>> named("gpu-0", "gpu-1").names
    ('gpu-0', 'gpu-1')
    """
    wrong = [name for name in names if isinstance(name, bool) or not isinstance(name, str | int)]
    if wrong or not names:
        problem = f"an invalid argument {wrong[0]!r}" if wrong else "no arguments"
        raise PoolError(
            f"The rule `named` was called with {problem}. Pass the name or address of each worker "
            'as a separate argument, for example `named("0", "1")`.'
        )
    return NamedWorkers(tuple(map(str, names)), **common)


def divide_workers(
    rules: Mapping[str, Rule], pool: Sequence[WorkerInfo]
) -> tuple[dict[str, list[WorkerInfo]], dict[str, str]]:
    """Divide workers by rules. Each rule selects from the workers left by earlier rules.

    Workers that a rule names are reserved for that rule. Current members of a partition are
    preferred, so repeating the same rules results in the same partitions. Workers that declare
    another resource are never selected.

    Returns
    -------
    chosen
        Selected workers by partition.
    notes
        Notes for users about the selection, by partition.

    Raises
    ------
    PoolError
        If a partition would have fewer workers than its minimum, or if two rules are `rest`.
    """
    takers_of_rest = [name for name, rule in rules.items() if isinstance(rule, rest)]
    if len(takers_of_rest) > 1:
        first, second, *_ = takers_of_rest
        raise PoolError(
            f"Partitions {first!r} and {second!r} both have the rule `rest()`, but only one "
            f"partition can have it. Choose another rule for {second!r}, for example "
            f"`n_workers(2)`, and place it before {first!r}."
        )
    chosen: dict[str, list[WorkerInfo]] = {}
    notes: dict[str, str] = {}
    for name, (rule, free, workers) in _choices(rules, pool).items():
        chosen[name] = workers
        earlier_rules = len(chosen) - 1
        if len(workers) < rule.minimum:
            raise PoolError(
                f"Partition {name!r} requires at least {format_workers(rule.minimum)}, but its "
                f"rule selects {len(workers)}. {_advice(rule, free, pool, earlier_rules)}"
            )
        if isinstance(rule, per_gpu) and free and not any(worker.gpus for worker in free):
            notes[name] = NO_GPU
        if isinstance(rule, n_workers) and len(workers) < rule.workers:
            source = _largest_partition(worker for worker in pool if worker not in free)
            move = f", and `resize(…, source={source!r})` moves existing workers into it"
            notes[name] = (
                f"The partition has {len(workers)} of the {format_workers(rule.workers)} that "
                f"its rule requests. Workers that join the cluster later are added to it"
                f"{move if source else ''}."
            )
        if isinstance(rule, NamedWorkers) and (missing := rule.missing_names(workers)):
            notes[name] = (
                "The partition does not have all workers that its rule names. "
                f"{_explain_missing(missing, pool)}"
            )
    return chosen, notes


class _Choice(NamedTuple):
    """Workers from which a rule can select, and those that it selects."""

    rule: Rule
    free: list[WorkerInfo]  # workers that the rule can select from
    workers: list[WorkerInfo]  # workers that the rule selects


def _choices(rules: Mapping[str, Rule], pool: Sequence[WorkerInfo]) -> dict[str, _Choice]:
    """Apply all rules in order, and return their selections without checking minimums."""
    choices: dict[str, _Choice] = {}
    chosen_addresses: set[str] = set()  # addresses are unique, unlike names
    named_by_rules = {
        n for rule in rules.values() if isinstance(rule, NamedWorkers) for n in rule.names
    }
    for name, rule in rules.items():
        declaring = [worker for worker in pool if worker.partitions == {name}]
        free = [w for w in pool if not w.partitions and w.address not in chosen_addresses]
        if not isinstance(rule, NamedWorkers):
            free = [w for w in free if not named_by_rules & {w.name, w.address}]
        free = [*declaring, *free]
        choices[name] = _Choice(rule, free, rule.choose(free))
        chosen_addresses |= {worker.address for worker in choices[name].workers}
    return choices


def find_shortfalls(
    rules: Mapping[str, Rule], pool: Sequence[WorkerInfo], pool_as_seen: Sequence[WorkerInfo]
) -> dict[str, str]:
    """Return a note for each partition that gets fewer workers than the client could expect.

    Parameters
    ----------
    rules
        Rules that select the workers, by partition.
    pool, pool_as_seen
        Workers with the resources that they declare now, and with the resources that the client
        saw.
    """
    now = _choices(rules, pool)
    expected = _choices(rules, pool_as_seen)
    return {
        name: f"The partition has {len(now[name].workers)} of the "
        f"{format_workers(len(choice.workers))} that its rule would have selected when the pool "
        "was created. The other workers have been assigned to other partitions since then."
        for name, choice in expected.items()
        if len(now[name].workers) < len(choice.workers)
    }


def _explain_missing(missing: Sequence[str], pool: Sequence[WorkerInfo]) -> str:
    """Explain in full sentences why the named workers cannot be selected."""
    by_name = {name: worker for worker in pool for name in (worker.name, worker.address)}
    absent = [name for name in missing if name not in by_name]
    # {partition names of a worker, or "" if an earlier rule has selected it: names of workers}
    elsewhere: dict[str, list[str]] = {}
    for name in missing:
        if name in by_name:
            partitions = " and ".join(map(repr, sorted(by_name[name].partitions)))
            elsewhere.setdefault(partitions, []).append(name)
    sentences = []
    for partitions, names in elsewhere.items():
        is_one = len(names) == 1
        verb = "belongs" if is_one else "belong"
        place = f"already {verb} to partition {partitions}"
        if not partitions:
            place = f"{'is' if is_one else 'are'} selected by another rule"
        sentences.append(f"{'Worker' if is_one else 'Workers'} {_format_names(names)} {place}.")
    if absent:
        present = sorted((worker.name for worker in pool), key=lambda name: (len(name), name))
        sentences.append(
            f"The pool has no worker named {_format_names(absent)}. Existing workers: "
            f"{_format_names(present) or 'none'}."
        )
    return " ".join(sentences)


def _largest_partition(workers: Iterable[WorkerInfo]) -> str:
    """Return the partition that has the most of the given workers, or "" if none has any."""
    sizes = Counter(name for worker in workers for name in sorted(worker.partitions))
    return max(sizes, key=sizes.__getitem__, default="")


def _format_names(names: Sequence[str]) -> str:
    """Format the first nine names for a message."""
    return ", ".join(map(repr, names[:9])) + (", …" if len(names) > 9 else "")


def _advice(
    rule: Rule, free: Sequence[WorkerInfo], pool: Sequence[WorkerInfo], earlier_rules: int
) -> str:
    """Return advice for a rule that selects too few workers.

    `free` contains the workers that the rule can select from, and `earlier_rules` is the number of
    rules before it.
    """
    if isinstance(rule, n_workers) and rule.workers < rule.minimum:
        return (
            f"The rule allows at most {format_workers(rule.workers)}. Increase this number, or "
            f"pass `minimum={rule.workers}`."
        )
    elsewhere = [worker for worker in pool if worker.partitions and worker not in free]
    sentences = []
    if isinstance(rule, NamedWorkers):
        elsewhere = [w for w in elsewhere if {w.name, w.address} & {*rule.names}]
        sentences.append(_explain_missing(rule.missing_names(rule.choose(free)), pool))
    else:
        verb = "is" if len(free) == 1 else "are"
        reorder = ", or place this partition before the others" if earlier_rules else ""
        sentences.append(
            f"{len(free)} of {len(pool)} workers {verb} available to this partition. "
            f"Start more workers{reorder}."
        )
    if elsewhere:
        source = _largest_partition(elsewhere)
        if not isinstance(rule, NamedWorkers):
            names = sorted({name for worker in elsewhere for name in worker.partitions})
            verb = "declares" if len(elsewhere) == 1 else "declare"
            sentences.append(
                f"{format_workers(len(elsewhere))} already {verb} the "
                f"resource{'s' if len(names) > 1 else ''} {_format_names(names)}."
            )
        sentences.append(
            "A worker can belong to only one partition. To divide these workers again, dissolve "
            "their partitions. To move workers of another partition, including workers that were "
            "started with `--resources`, create this partition with `n_workers(1, minimum=0)` and "
            f"call `resize`, for example `partition.resize(1, source={source!r})`."
        )
    return " ".join(sentences)


def partition_for(
    worker: WorkerInfo,
    rules: Mapping[str, Rule],
    members: Mapping[str, Sequence[WorkerInfo]],
) -> str | None:
    """Return the partition to which a joining worker is assigned, or None.

    Rules that name the worker have priority, followed by partitions without workers or with fewer
    workers than their minimum, and then by the order of the rules.
    """
    everyone = [worker, *(member for group in members.values() for member in group)]
    willing = [
        name for name, rule in rules.items() if rule.accepts(worker, members[name], everyone)
    ]
    short = [
        name
        for name in willing
        if len(members[name]) < max(rules[name].minimum, not isinstance(rules[name], rest))
    ]
    by_name = [name for name in willing if isinstance(rules[name], NamedWorkers)]
    return next(iter([*by_name, *short, *willing]), None)


def format_workers(count: int) -> str:
    """Format a number of workers for a message, such as "1 worker"."""
    return f"{count} {'worker' if count == 1 else 'workers'}"


def check_name(partition: object) -> None:
    """Raise PoolError if the value is not a valid partition name."""
    if not isinstance(partition, str) or not partition:
        raise PoolError(f"Invalid partition name {partition!r}. Expected a string such as 'GPU'.")


def check_count(name: str, count: object, minimum: int = 1) -> None:
    """Raise PoolError if the value is not an integer of at least `minimum`."""
    if isinstance(count, bool) or not isinstance(count, Integral) or count < minimum:
        raise PoolError(
            f"Invalid value {count!r} for {name}. Expected an integer of at least {minimum}."
        )

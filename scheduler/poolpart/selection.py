"""Which workers a partition takes; pure functions of what is known of them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

from .errors import PoolError
from .wording import counted
from .worker_info import WorkerInfo

NO_GPU = "no GPU in the pool: CPU workers instead"


Selectors = Mapping[str, int | Sequence[str] | None]


def check_request(partition: str, selectors: Selectors, slots: int | None) -> None:
    """Check what is asked of `Pool.partition`; PoolError unless it makes sense."""
    check_name(partition)
    check_slots(slots)
    given = {key: value for key, value in selectors.items() if value is not None}
    if len(given) != 1:
        raise PoolError(
            f"Give exactly one of {', '.join(selectors)} to partition {partition!r}, "
            f"not {' and '.join(given) or 'none'}."
        )
    for key, value in given.items():
        if key == "workers":
            if isinstance(value, str) or not value:
                raise PoolError(
                    f"workers is {value!r}; give a list of names or addresses, 1 or more."
                )
        elif not isinstance(value, int) or value < 1:
            raise PoolError(f"{key} is {value!r}; give a whole number, 1 or more.")


def check_name(partition: object) -> None:
    """Check the name of a partition; PoolError unless it is one."""
    if not isinstance(partition, str) or not partition:
        raise PoolError(f"The name of a partition is {partition!r}; give one such as 'GPU'.")


def check_slots(slots: object) -> None:
    """Check how many slots each worker is to have; PoolError unless it can have so many."""
    if slots is not None and (not isinstance(slots, int) or slots < 1):
        raise PoolError(f"slots is {slots!r}; give a whole number, 1 or more: tasks take one each.")


def choose(
    partition: str,
    pool: Sequence[WorkerInfo],
    *,
    max_workers_per_gpu: int | None = None,
    max_workers_per_host: int | None = None,
    n_workers: int | None = None,
    workers: Sequence[str] | None = None,
) -> tuple[list[WorkerInfo], str]:
    """Choose workers of a pool by the one selector that is given.

    Returns
    -------
    chosen, note
        The workers, and what a user should know of the choice; empty for nothing.

    Raises
    ------
    PoolError
        If there are too few, or one that was named cannot be had.
    """
    if workers is not None:
        return by_name(partition, pool, workers), ""
    # Members come first, so that the same call, again, makes the same partition.
    free = [worker for worker in pool if worker.partitions == {partition}]
    free += [worker for worker in pool if not worker.partitions]
    if n_workers is not None:
        return by_count(partition, pool, free, n_workers), ""
    if not free:
        raise PoolError(
            f"No worker is left for partition {partition!r}: all {len(pool)} of this pool "
            f"belong to others. Start more workers.{left_alone(partition, pool)}"
        )
    if max_workers_per_host is not None:
        return by_host(free, max_workers_per_host), ""
    if max_workers_per_gpu is not None:
        return by_gpu(free, max_workers_per_gpu)
    raise PoolError(f"Partition {partition!r} was given no selector.")


def by_name(partition: str, pool: Sequence[WorkerInfo], wanted: Sequence[str]) -> list[WorkerInfo]:
    """Take these workers, by name or address."""
    known: dict[str, list[WorkerInfo]] = {}  # {name or address: workers}
    for worker in pool:
        for key in {worker.name, worker.address}:
            known.setdefault(key, []).append(worker)
    times = Counter(map(str, wanted))
    if unknown := [name for name in times if name not in known]:
        raise PoolError(
            f"Partition {partition!r}: {', '.join(unknown)} not in this pool, which has "
            f"{', '.join(worker.name for worker in pool) or 'no workers'}."
        )
    for name, count in times.items():
        if len(known[name]) > count:  # all of them are meant if it is listed for each
            raise PoolError(
                f"Partition {partition!r}: {len(known[name])} workers are named {name}; give "
                f"addresses: {', '.join(worker.address for worker in known[name])}."
            )
    asked = {worker.address for name in times for worker in known[name]}
    chosen = [worker for worker in pool if worker.address in asked]
    for worker in chosen:
        if others := sorted(worker.partitions - {partition}):
            raise PoolError(
                f"Worker {worker.name} already declares {', '.join(others)}; a worker belongs "
                "to one partition."
            )
    return chosen


def left_alone(partition: str, pool: Sequence[WorkerInfo]) -> str:
    """Say, for a message, which workers cannot be had because of what they declare."""
    others = Counter(name for worker in pool for name in worker.partitions - {partition})
    if not others:
        return ""
    declare = ", ".join(f"{name} by {count}" for name, count in sorted(others.items()))
    return f" A worker that declares another resource is not taken: {declare}."


def by_count(
    partition: str, pool: Sequence[WorkerInfo], free: Sequence[WorkerInfo], n_workers: int
) -> list[WorkerInfo]:
    """Take so many workers of those that are free."""
    if len(free) < n_workers:
        raise PoolError(
            f"Partition {partition!r} asks for {counted(n_workers, 'worker')}; the pool has "
            f"{counted(len(free), 'worker')} in no other partition.{left_alone(partition, pool)}"
        )
    return list(free[:n_workers])


def by_host(free: Sequence[WorkerInfo], most: int) -> list[WorkerInfo]:
    """Take at most so many workers of each host."""
    taken: Counter[str] = Counter()
    chosen = []
    for worker in free:
        if taken[worker.host] < most:
            taken[worker.host] += 1
            chosen.append(worker)
    return chosen


def by_gpu(free: Sequence[WorkerInfo], most: int) -> tuple[list[WorkerInfo], str]:
    """Take at most so many workers for each GPU; a note says if there was none to go by."""
    if not any(worker.gpus for worker in free):
        return by_host(free, most), NO_GPU
    taken: Counter[str] = Counter()  # {GPU: workers chosen for it}
    chosen = []
    # Those that see the fewest GPUs first: the others have a choice.
    for worker in sorted(free, key=lambda worker: len(worker.gpus)):
        if worker.gpus:
            gpu = min(worker.gpus, key=lambda gpu: taken[gpu])
            if taken[gpu] < most:
                taken[gpu] += 1
                chosen.append(worker)
    return chosen, ""

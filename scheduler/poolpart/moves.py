"""Moving workers from one partition to another while the cluster runs.

A worker that is to leave gets no new tasks of its partition; those that it has not started
go to other members, those that run end there; then it declares what it is to be. What is
moved is written into the scheduler's book first: a worker that dies in between comes back
where it was to go.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from distributed import Client

from .book import Seat, names_of
from .declare import ask
from .errors import PoolError
from .internals import held_by
from .steward import Steward
from .wording import counted


def grow(
    client: Client, name: str, workers: int, source: str | None, timeout_s: float
) -> list[str]:
    """Move workers into a partition; see `Partition.grow`. Returns their names."""
    _check(workers)
    arguments = {"name": name, "count": workers, "source": source, "timeout_s": timeout_s}
    names: list[str] = ask(client, _grow, **arguments)
    return names


def shrink(client: Client, name: str, workers: int, timeout_s: float) -> list[str]:
    """Move workers out of a partition; see `Partition.shrink`. Returns their names."""
    _check(workers)
    names: list[str] = ask(client, _shrink, name=name, count=workers, timeout_s=timeout_s)
    return names


def _check(workers: int) -> None:
    if not isinstance(workers, int) or workers < 1:
        raise PoolError(f"The number of workers to move is {workers!r}; give 1 or more.")


# -- on the scheduler ------------------------------------------------------------------


async def _grow(
    steward: Steward, name: str, count: int, source: str | None, timeout_s: float
) -> list[str]:
    book = steward.book
    book.adopt(name)
    if source == name:
        raise PoolError(f"Partition {name!r} cannot grow by its own workers.")
    if source is not None:
        book.adopt(source)
    lender = source or book.remainder()
    there = [] if source else [seat for seat in book.free() if steward.reconciler.settled(seat)]
    if lender is not None and lender != name:
        members = _arrived(steward, lender)
        spare = max(0, len(members) - book.rules[lender].minimum)
        there += _by_load(steward, members)[:spare]
    if len(there) < count:
        place = f"partition {lender!r}, beyond its minimum," if source else "the remainder"
        raise PoolError(
            f"Partition {name!r} cannot grow by {count}: {place} has "
            f"{counted(len(there), 'worker')} to spare. Start more, or "
            "shrink another partition first."
        )
    return await _move(steward, _by_load(steward, there)[:count], name, timeout_s)


async def _shrink(steward: Steward, name: str, count: int, timeout_s: float) -> list[str]:
    book = steward.book
    book.adopt(name)
    members, least = _arrived(steward, name), book.rules[name].minimum
    if len(members) - count < least:
        raise PoolError(
            f"Partition {name!r} cannot shrink by {count}: it has "
            f"{counted(len(members), 'worker')} and needs at least {least}."
        )
    target = book.remainder()
    chosen = _by_load(steward, members)[:count]
    return await _move(steward, chosen, None if target == name else target, timeout_s)


async def _move(
    steward: Steward, seats: Sequence[Seat], target: str | None, timeout_s: float
) -> list[str]:
    """Move workers; PoolError if some do not come free in time, which then stay."""
    before = {seat: (seat.partition, seat.slots) for seat in seats}
    for seat in seats:
        _resize(steward, seat.partition, -1)
        _resize(steward, target, 1)
        steward.book.put(seat, target)
    late = await steward.reconciler.arrive(seats, timeout_s)
    for seat in late:
        origin, slots = before[seat]
        if seat.partition != target or (origin and origin not in steward.book.rules):
            continue  # meanwhile somebody else has moved it, or dissolved where it was
        _resize(steward, target, -1)
        _resize(steward, origin, 1)
        steward.book.put(seat, origin, slots)
    if late:
        leaving = [name for name, *_ in (before[seat] for seat in late) if name]
        steward.reconciler.settle(late)
        raise PoolError(
            f"{len(late)} of {counted(len(seats), 'worker')} could not be moved within "
            f"{timeout_s:g} s; left in place: {names_of(late)}{_held(steward, late, leaving)}."
        )
    # Whoever else moves workers waits until they have arrived; dissolving does not.
    if target is not None and target not in steward.book.rules:
        raise PoolError(
            f"{names_of(seats)} did not arrive in partition {target!r}: somebody has dissolved it."
        )
    return [seat.info.name for seat in seats if seat.holds]


def _arrived(steward: Steward, name: str) -> list[Seat]:
    """Members that may be moved: not those under way, which may turn back."""
    members = steward.book.members(name, present=True)
    return [seat for seat in members if steward.reconciler.settled(seat)]


def _resize(steward: Steward, name: str | None, change: int) -> None:
    if name in steward.book.rules:
        steward.book.resize(name, change)


def _by_load(steward: Steward, seats: Sequence[Seat]) -> list[Seat]:
    """Those first that have the least to do, and long-running tasks last."""

    def load(seat: Seat) -> tuple[int, int]:
        worker = steward.scheduler.workers[seat.info.address]
        return len(worker.long_running), len(worker.processing)

    return sorted(seats, key=load)


def _held(steward: Steward, seats: Sequence[Seat], names: Sequence[str]) -> str:
    """Say what keeps workers from leaving, for messages."""
    workers: list[Any] = [steward.scheduler.workers.get(seat.info.address) for seat in seats]
    keys = [k for w in workers if w for k in held_by(steward.scheduler, w, names)]
    if not keys:
        return ""
    more = f" and {len(keys) - 3} more" if len(keys) > 3 else ""
    return f", because of {', '.join(map(str, keys[:3]))}{more}"

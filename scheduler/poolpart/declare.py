"""Putting workers of a running cluster into partitions: what a client asks of the scheduler."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from distributed import Client

from .book import Seat, names_of
from .errors import PoolError
from .fence_plugin import lower
from .remote import on_scheduler
from .rules import Rule
from .steward import Steward, steward_of
from .worker_info import WorkerInfo

PATIENCE_S = 60.0  # for a worker to answer


def ask(client: Client, function: Callable[..., Any], **arguments: Any) -> Any:
    """Call `function(steward, **arguments)` on the scheduler.

    Raises
    ------
    PoolError
        If it raises one there.
    """
    result, complaint = on_scheduler(client, _answer, question=function, arguments=arguments)
    if complaint:
        raise PoolError(complaint)
    return result


async def _answer(
    question: Callable[..., Any], arguments: Mapping[str, Any], dask_scheduler: Any = None
) -> tuple[Any, str]:
    # An error that is raised here would be in the scheduler's log with a traceback.
    with steward_of(dask_scheduler) as steward:
        try:
            return await question(steward, **arguments), ""
        except PoolError as error:
            return None, str(error)


def declare(
    client: Client,
    rules: Mapping[str, Rule],
    chosen: Mapping[str, Sequence[WorkerInfo]],
    pool: Sequence[WorkerInfo],
) -> None:
    """Put workers into partitions, and have the scheduler follow the rules from now on.

    Parameters
    ----------
    client
        Client of their cluster.
    rules
        Rules by partition.
    chosen
        Workers to begin with, by partition.
    pool
        All workers of which something is known.

    Raises
    ------
    PoolError
        If one of them left meanwhile, or somebody else has put it into a partition.
    """
    ask(
        client,
        _declare,
        rules=dict(rules),
        chosen={name: [worker.address for worker in chosen[name]] for name in rules},
        gpus={worker.address: worker.gpus for worker in pool},
    )


async def _declare(
    steward: Steward,
    rules: Mapping[str, Rule],
    chosen: Mapping[str, Sequence[str]],
    gpus: Mapping[str, Sequence[str]],
) -> None:
    for address, devices in gpus.items():
        if seat := steward.seat_at(address):
            seat.info = seat.info.with_gpus(devices)
    seats = {name: [_seat(steward, name, a) for a in chosen[name]] for name in rules}
    for name, rule in rules.items():
        before = steward.book.rules.get(name)
        if before and before.exclusive and not rule.exclusive:
            lower(steward.scheduler, name)
        steward.book.enter(name, rule)
        for seat in seats[name]:
            steward.book.put(seat, name, rule.slots_of(seat.info))
    everyone = [seat for group in seats.values() for seat in group]
    late = await steward.arrive(everyone, PATIENCE_S)
    if late or not all(seat.holds for seat in everyone):
        away = [seat for seat in everyone if seat in late or not seat.holds]
        raise PoolError(
            f"{names_of(away)} left, or did not answer, while being put into partition "
            f"{' and '.join(sorted({str(seat.partition) for seat in away}))}; the other workers "
            "are in theirs. Make the pool anew to divide it again."
        )


def _seat(steward: Steward, name: str, address: str) -> Seat:
    seat = steward.seat_at(address)
    if seat is None:
        raise PoolError(
            f"The worker at {address} could not be put into partition {name!r}: it has left. "
            "Make the pool anew and divide that."
        )
    if seat.partition not in (None, name):
        raise PoolError(
            f"Worker {seat.info.name} already declares {seat.partition}; a worker belongs to "
            "one partition."
        )
    return seat

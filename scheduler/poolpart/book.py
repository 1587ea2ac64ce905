"""Which worker is to be in which partition: the scheduler's table, without the scheduler.

The book says what should be; `reconciler.py` makes it so. Whatever happens to a worker in
between, what it should declare can be read here.
"""

from __future__ import annotations

import time
from collections.abc import Hashable, Iterable, Mapping
from dataclasses import dataclass, field, replace

from .errors import PoolError
from .internals import Resources
from .rules import Count, Declared, Rest, Rule
from .worker_info import WorkerInfo

HOLD_S = 30.0  # how long a worker's place is kept while its nanny starts it again
FORGET_S = 3600.0  # after which a worker that comes back is a new one


@dataclass(eq=False)
class Seat:
    """One worker, over all its lives.

    Parameters
    ----------
    key
        What identifies it, see `seat_key`.
    info
        What is known of it.
    found
        Resources that it declared before anybody changed them.
    partition
        Where it belongs; None for nowhere.
    slots
        How many of the partition's slots it has.
    nanny
        Address of its nanny, None for none.
    absent_since
        When it left, by `time.monotonic`; None while it is there.
    unplaced
        It joined after the cluster was divided, and no rule has wanted it yet.
    """

    key: Hashable
    info: WorkerInfo
    found: Resources
    partition: str | None = None
    slots: float = 0
    nanny: str | None = None
    absent_since: float | None = None
    unplaced: bool = False

    @property
    def holds(self) -> bool:
        """Whether its place is taken: it is there, or its nanny is expected to start it again."""
        if self.absent_since is None:
            return True
        return self.nanny is not None and time.monotonic() - self.absent_since < HOLD_S


@dataclass
class Book:
    """Rules of the partitions, and the seats of all workers."""

    rules: dict[str, Rule] = field(default_factory=dict)  # in the order in which they choose
    seats: dict[Hashable, Seat] = field(default_factory=dict)  # by key
    names: set[str] = field(default_factory=set)  # of all partitions that there ever were

    def members(self, name: str, present: bool = False) -> list[Seat]:
        """Seats of a partition, those only whose workers are there if `present`."""
        return [
            seat
            for seat in self.seats.values()
            if seat.partition == name and (seat.absent_since is None if present else seat.holds)
        ]

    def free(self) -> list[Seat]:
        """Workers that are there and belong to no partition, nor declare anything else."""
        return [
            seat
            for seat in self.seats.values()
            if seat.absent_since is None
            and seat.partition is None
            and not any(self.wanted(seat).values())
        ]

    def remainder(self) -> str | None:
        """Partition that has what the others leave, if there is one."""
        return next((name for name, rule in self.rules.items() if isinstance(rule, Rest)), None)

    def wanted(self, seat: Seat) -> Resources:
        """Resources that a worker should declare: those of its own, and its partition's."""
        if seat.partition is None:
            return {r: q for r, q in seat.found.items() if r not in self.rules}
        own = {r: q for r, q in seat.found.items() if r not in self.names}
        return {**own, seat.partition: seat.slots}

    def put(self, seat: Seat, name: str | None, slots: float | None = None) -> None:
        """Put a worker into a partition, or None; if not given, slots are as it was started."""
        seat.partition, seat.unplaced = name, False
        if name is None:
            seat.slots = 0
        elif slots is not None:
            seat.slots = slots
        else:
            rule = self.rules[name]
            seat.slots = rule.slots or seat.found.get(name) or rule.slots_of(seat.info)

    def enter(self, name: str, rule: Rule) -> None:
        """Enter a partition, or change its rule. What takes the rest stays the last to choose."""
        self.rules[name] = rule
        self.names.add(name)
        ordered = sorted(self.rules.items(), key=lambda item: isinstance(item[1], Rest))
        self.rules = dict(ordered)

    def adopt(self, name: str) -> None:
        """Enter a partition whose workers declare it by themselves.

        Raises
        ------
        PoolError
            If there is no such partition.
        """
        if name in self.rules:
            return
        members = [s for s in self.seats.values() if s.partition is None and s.found.get(name)]
        if not members:
            raise PoolError(
                f"There is no partition {name!r}: no worker declares it, and it has not been "
                "made with Pool.partition or Pool.divide."
            )
        self.enter(name, Declared(minimum=0))
        for seat in members:
            self.put(seat, name, seat.found[name])

    def resize(self, name: str, change: int) -> None:
        """Have the rule want more or fewer workers, where it is one that counts."""
        rule = self.rules[name]
        if isinstance(rule, Count):
            workers = rule.workers + change
            self.rules[name] = replace(rule, workers=workers, minimum=min(rule.minimum, workers))

    def groups(self) -> Mapping[str, list[WorkerInfo]]:
        """Tell what is known of the members, by partition."""
        return {name: [seat.info for seat in self.members(name)] for name in self.rules}

    def forget(self, now: float) -> None:
        """Forget workers that have been away for so long that they will not come back."""
        for key, seat in list(self.seats.items()):
            if seat.absent_since is not None and not seat.holds:
                lasting = seat.nanny is not None or seat.info.name != seat.info.address
                if not lasting or now - seat.absent_since > FORGET_S:
                    del self.seats[key]


def seat_key(name: Hashable, address: str, nanny: str | None) -> Hashable:
    """Name a worker for all its lives: by its name or, if it has none, by its nanny.

    A worker that was given no name goes by its address, which is another after a restart. The
    name is left as it is: to Dask 0, as `LocalCluster` has it, and "0", as from a command line,
    are two workers.
    """
    return name if name != address else nanny or address


def names_of(seats: Iterable[Seat]) -> str:
    """Names of workers, for messages."""
    return ", ".join(sorted(seat.info.name for seat in seats))

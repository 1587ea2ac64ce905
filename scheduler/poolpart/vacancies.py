"""Places of workers that do not come back: who joined meanwhile and should have them.

While a nanny may be starting its worker again, the worker's place is kept, and one that joins
goes where the rules want it otherwise, mostly to what has the rest. Once the place is given up,
it is as if that one joined now.
"""

from __future__ import annotations

from .book import Book, Seat
from .rules import partition_for


def vacated(book: Book) -> list[Seat]:
    """Workers whose place is given up now; each is told of once."""
    seats = [
        seat
        for seat in book.seats.values()
        if seat.absent_since is not None and not seat.holds and not seat.given_up
    ]
    for seat in seats:
        seat.given_up = True
    return seats


def successor(book: Book, gone: Seat) -> Seat | None:
    """Worker that has joined since another left, and would have its place if it joined now."""
    rest = book.remainder()
    if rest is None or gone.partition in (None, rest) or gone.absent_since is None:
        return None
    members = book.members(rest, present=True)
    if len(members) <= book.rules[rest].minimum:
        return None
    for seat in members:
        others = [member.info for member in book.members(rest) if member is not seat]
        groups = {**book.groups(), rest: others}
        late = seat.joined > gone.absent_since and seat.home is None
        if late and partition_for(seat.info, book.rules, groups) == gone.partition:
            return seat
    return None

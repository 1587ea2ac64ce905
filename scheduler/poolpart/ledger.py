"""Which numbered items were delivered: the record that makes delivery exactly-once."""

from __future__ import annotations

from collections.abc import Iterable, Iterator


class Ledger:
    """Remembers which of the items 0 … total-1 have been delivered.

    A producer or consumer that is run again delivers again; the ledger tells a first
    delivery from a repeated one, and what is still missing. One byte an item.

    Examples
    --------
    >>> ledger = Ledger(3)
    >>> ledger.accept(1), ledger.accept(1), ledger.accept(0)
    (True, False, True)
    >>> list(ledger.missing()), ledger.duplicates, ledger.complete
    ([2], 1, False)
    >>> ledger
    <Ledger 2 of 3 delivered, 1 duplicate dropped>
    """

    def __init__(self, total: int) -> None:
        if total < 0:
            raise ValueError(f"A ledger of {total} items cannot be; give 0 or more.")
        self.total = total
        self.delivered = 0
        self.duplicates = 0
        self._seen = bytearray(total)
        self._first_missing = 0

    def __repr__(self) -> str:
        plural = "" if self.duplicates == 1 else "s"
        return (
            f"<Ledger {self.delivered} of {self.total} delivered, "
            f"{self.duplicates} duplicate{plural} dropped>"
        )

    def __contains__(self, item: int) -> bool:
        return 0 <= item < self.total and bool(self._seen[item])

    def accept(self, item: int) -> bool:
        """Enter a delivery; False if the item was there already.

        Raises
        ------
        IndexError
            If there is no such item: something that was never sent has arrived.
        """
        if not 0 <= item < self.total:
            raise IndexError(f"Item {item} was delivered; there are {self.total}, from 0.")
        if self._seen[item]:
            self.duplicates += 1
            return False
        self._seen[item] = 1
        self.delivered += 1
        return True

    def restore(self, items: Iterable[int]) -> None:
        """Enter items that an earlier run had delivered; what is there already is no duplicate.

        Raises
        ------
        IndexError
            If there is no such item.
        """
        for item in items:
            if item not in self:
                self.accept(item)

    @property
    def complete(self) -> bool:
        """Whether every item was delivered."""
        return self.delivered == self.total

    @property
    def first_missing(self) -> int:
        """The lowest item that was not delivered; `total` when all were."""
        found = self._seen.find(0, self._first_missing)
        self._first_missing = self.total if found < 0 else found
        return self._first_missing

    def missing(self) -> Iterator[int]:
        """Items not delivered, in order."""
        item = self._seen.find(0)
        while item >= 0:
            yield item
            item = self._seen.find(0, item + 1)

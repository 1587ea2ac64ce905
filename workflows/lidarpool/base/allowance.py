"""How much memory the content of a file may take: a few lines can unpack to any amount."""

from __future__ import annotations

from functools import cache
from pathlib import Path

from .errors import LidarpoolError

TIMES, LEAST = 100, 256 * 2**20  # of the file's bytes, and bytes of a small one
_SHARE = 4  # of the memory: a scene is copied while its objects are placed and joined


class Allowance:
    """Memory that the content of a file may take, and what it has taken of it.

    The limit is 100 times the file's size or 256 MiB, whichever is larger, and at most a quarter of
    the memory.

    Parameters
    ----------
    size
        Of the file, bytes.
    advice
        What the user can do if the content is larger; ends the error.

    Examples
    --------
    >>> Allowance(1_500_000, "export it again").take(2_900_000_000)
    Traceback (most recent call last):
    lidarpool.base.errors.LidarpoolError: it has 1.43 MiB and would unpack to \
2.70 GiB or more, of at most 256.00 MiB: export it again.
    """

    def __init__(self, size: int, advice: str) -> None:
        self.taken = 0
        self._size, self._advice = size, advice
        self._files: set[Path] = set()

    @property
    def limit(self) -> int:
        """Bytes."""
        return min(max(TIMES * self._size, LEAST), memory_share())

    def grow(self, size: int) -> None:
        """Count data of another file with it."""
        self._size += size

    def add_file(self, file: Path) -> None:
        """Count another file with it, which it names, once however often it names it."""
        if file not in self._files:
            self._files.add(file)
            self.grow(file.stat().st_size)

    def fits(self, count: int) -> bool:
        """Whether so many bytes more may be taken."""
        return self.taken + count <= self.limit

    def take(self, count: int) -> None:
        """Take so many bytes, before they are made.

        LidarpoolError if that is more than the limit.
        """
        self.taken += count
        if self.taken > self.limit:
            raise LidarpoolError(
                f"it has {bytes_of(self._size)} and would unpack to {bytes_of(self.taken)} or "
                f"more, of at most {bytes_of(self.limit)}: {self._advice}."
            )


@cache
def memory() -> int:
    """Memory of this machine, or of the container that we run in, bytes."""
    from distributed.system import MEMORY_LIMIT  # here, because it takes half a second

    return int(MEMORY_LIMIT)


def memory_share() -> int:
    """Most bytes that the objects of a file may take."""
    return memory() // _SHARE


def bytes_of(count: int) -> str:
    """Return bytes as text: «1.43 MiB»."""
    from dask.utils import format_bytes  # here, because Dask takes long to import

    return str(format_bytes(count))

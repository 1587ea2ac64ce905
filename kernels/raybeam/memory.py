"""How much memory there is, asked before much of it is needed.

An operating system that promises more memory than it has kills the process that uses it, with no
word about why. So what takes a great deal asks first.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

ASK = 1 << 28  # bytes: less than this is not asked for, it takes longer than it is worth

_PROC = Path("/proc")
_GROUPS = Path("/sys/fs/cgroup")
# Of control groups, version 1 and 2: the limit, what is used, what could be had back from files.
_FILES = {
    1: ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),
    2: ("memory.max", "memory.current", "inactive_file"),
}


def available() -> int | None:
    """Bytes that this process can still get; None where the system does not tell (not Linux)."""
    return min((*_of_machine(), *_of_groups()), default=None)


def require(need: int, what: str, instead: str) -> None:
    """Raise MemoryError when there is less memory than needed.

    Parameters
    ----------
    need
        Bytes.
    what
        Who needs them: the start of the message.
    instead
        What to do: its end.
    """
    if need < ASK:
        return
    free = available()
    if free is not None and need > free:
        raise MemoryError(lacking(need, free, what, instead))


def lacking(need: int, free: int, what: str, instead: str) -> str:
    """Return a message that names both numbers, in MiB; see `require`."""
    return f"{what} needs {need / 2**20:,.0f} MiB and {free / 2**20:,.0f} MiB are free: {instead}."


class Meter:
    """Watches over something that grows, and asks for what is needed to double it.

    Parameters
    ----------
    what, instead
        See `require`.

    Examples
    --------
    >>> meter = Meter("The hits", "cast fewer rays at a time")
    >>> for part in (b"some", b"more"):
    ...     meter.add(len(part))
    >>> meter.bytes
    8
    """

    def __init__(self, what: str, instead: str) -> None:
        self.bytes = 0
        self._what, self._instead = what, instead
        self._next = ASK

    def __repr__(self) -> str:
        return f"Meter({self._what!r}, {self.bytes} bytes)"

    def add(self, more: int) -> None:
        """Count bytes; raises MemoryError when what there is could not be copied once more.

        Parts are joined at the end, which takes as much again as they have.
        """
        self.bytes += more
        if self.bytes >= self._next:
            require(self.bytes, self._what, self._instead)
            self._next = self.bytes + ASK


def _of_machine() -> Iterator[int]:
    try:
        lines = (_PROC / "meminfo").read_text("ascii").splitlines()
    except OSError:
        return
    for line in lines:
        if line.startswith("MemAvailable:"):
            yield int(line.split()[1]) * 1024


def _of_groups() -> Iterator[int]:
    """Look up what is left of each control group that this process is in, and of those above."""
    try:
        lines = (_PROC / "self" / "cgroup").read_text("ascii").splitlines()
    except (OSError, UnicodeDecodeError):
        return
    for line in lines:
        _, controllers, name = line.split(":", 2)
        if controllers and "memory" not in controllers.split(","):
            continue
        version, root = (1, _GROUPS / "memory") if controllers else (2, _GROUPS)
        folder = root / name.strip("/")
        # Within a container the name may be one that only the machine outside knows.
        for place in (folder, *folder.parents):
            yield from _left(place, *_FILES[version])
            if place == root:
                break


def _left(folder: Path, limit: str, used: str, reclaimable: str) -> Iterator[int]:
    try:
        most, now = ((folder / name).read_text("ascii").strip() for name in (limit, used))
        parts = (folder / "memory.stat").read_text("ascii").split()
    except OSError:
        return
    if most == "max":
        return
    cached = int(parts[parts.index(reclaimable) + 1]) if reclaimable in parts else 0
    yield int(most) - int(now) + cached

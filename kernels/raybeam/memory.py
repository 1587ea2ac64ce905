"""How much memory there is, asked before much of it is needed.

An operating system that promises more memory than it has kills the process that uses it, with no
word about why. So what takes many times the size of its input asks first.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

ASK = 1 << 28  # bytes: less than this is not asked for, it takes longer than it is worth

_PROC, _GROUPS = Path("/proc"), Path("/sys/fs/cgroup")


def available() -> int | None:
    """Bytes that this process can still get; None where the system does not tell (not Linux).

    The least of what the machine and the process's control groups (of version 2) have left.
    """
    try:
        return min(_left())
    except (OSError, KeyError):
        return None


def require(need: int, what: str) -> None:
    """Raise MemoryError when there are less than `need` bytes for a mesh; `what` needs them."""
    if need >= ASK:
        free = available()
        if free is not None and need > free:
            raise MemoryError(
                f"{what} needs {need / 2**20:,.0f} MiB and {free / 2**20:,.0f} MiB are free: "
                "use a smaller mesh."
            )


def _left() -> Iterator[int]:
    yield _numbers(_PROC / "meminfo")["MemAvailable:"] * 1024
    lines = (_PROC / "self" / "cgroup").read_text("utf-8").splitlines()
    group = next((line[4:] for line in lines if line.startswith("0::/")), "")
    folder = _GROUPS / group
    # Within a container the name may be one that only the machine outside knows.
    for place in (folder, *folder.parents):
        try:
            most = (place / "memory.max").read_text("ascii").strip()
            used = int((place / "memory.current").read_text("ascii"))
        except OSError:
            continue
        if most != "max":
            # What files have cached could be had back.
            yield int(most) - used + _numbers(place / "memory.stat")["inactive_file"]


def _numbers(path: Path) -> dict[str, int]:
    """Lines of a name and a number."""
    rows = (line.split() for line in path.read_text("ascii").splitlines())
    return {row[0]: int(row[1]) for row in rows}

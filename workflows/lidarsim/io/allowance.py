"""Limits on the memory that the content of a file may take: a few lines can unpack to any size."""

from __future__ import annotations

from contextlib import suppress
from functools import cache
from pathlib import Path

import psutil

from ..errors import LidarError, as_sentence

UNPACKED_TIMES = 100  # multiple of the file's bytes
MIN_LIMIT_BYTES = 256 * 2**20  # limit for small files
CONTROL_GROUPS = Path("/sys/fs/cgroup")  # Linux states limits of memory in this folder
_PREFIXES = {"Pi": 2**50, "Ti": 2**40, "Gi": 2**30, "Mi": 2**20, "ki": 2**10}
_SHARE = 4  # a fraction of the memory: a scene is copied while its objects are placed and joined


class Allowance:
    """Memory that the content of a file may take, and the bytes taken so far.

    The limit is 100 times the file's size or 256 MiB, whichever is larger, and at most a quarter of
    the memory.

    Parameters
    ----------
    size
        Size of the file, bytes.
    advice
        Advice to the user if the content is larger, at the end of the error.
    in_parts
        Whether the content is never in memory as a whole: the memory does not limit it.

    Examples
    --------
    >>> Allowance(1_500_000, "export it again").take(2_900_000_000)
    Traceback (most recent call last):
    lidarsim.errors.LidarError: it has 1.43 MiB but would unpack to at \
least 2.70 GiB, and the limit is 256.00 MiB. Export it again.
    """

    def __init__(self, size: int, advice: str, *, in_parts: bool = False) -> None:
        self.used_bytes = 0
        self._in_parts = in_parts
        self._size = size
        self._advice = advice
        self._files: set[Path] = set()

    @property
    def limit(self) -> int:
        """Limit, bytes."""
        limit = max(UNPACKED_TIMES * self._size, MIN_LIMIT_BYTES)
        return limit if self._in_parts else min(limit, memory_share())

    def grow(self, size: int) -> None:
        """Add the size of further data of the file, bytes."""
        self._size += size

    def add_file(self, file: Path) -> None:
        """Add the size of a file that the file names, once for each file."""
        if file not in self._files:
            self._files.add(file)
            self.grow(file.stat().st_size)

    def fits(self, count: int) -> bool:
        """Return True if a number of further bytes may be taken."""
        return self.used_bytes + count <= self.limit

    def take(self, count: int) -> None:
        """Take a number of bytes, before they are allocated.

        Raises LidarError above the limit.
        """
        self.check(count)
        self.used_bytes += count

    def check(self, count: int) -> None:
        """Check that a number of bytes fits that is freed again.

        Raises LidarError above the limit.
        """
        if not self.fits(count):
            raise LidarError(
                f"it has {bytes_of(self._size)} but would unpack to at least "
                f"{bytes_of(self.used_bytes + count)}, and the limit is {bytes_of(self.limit)}. "
                f"{as_sentence(self._advice)}"
            )


@cache
def memory() -> int:
    """Return the memory that this process may use, bytes.

    The minimum of the machine's memory and the limits of control groups and of `ulimit -m`.
    """
    return min([psutil.virtual_memory().total, *_control_group_limits(), *_resident_limit()])


def _control_group_limits() -> list[int]:
    """Return the limits of the control groups, version 1 and 2, that contain this process, bytes.

    Batch systems and containers limit a group that contains the process, at any depth.
    """
    try:
        memberships = Path("/proc/self/cgroup").read_text("utf-8").splitlines()
    except OSError:  # only Linux has control groups
        return []
    limits = []
    for line in memberships:
        _, controllers, group = line.split(":", 2)
        if not controllers:
            top = CONTROL_GROUPS
            file_name = "memory.max"
        elif "memory" in controllers.split(","):
            top = CONTROL_GROUPS / "memory"
            file_name = "memory.limit_in_bytes"
        else:
            continue
        folder = top / group.lstrip("/")
        for ancestor in (folder, *folder.parents):
            if not ancestor.is_relative_to(top):
                break
            # A file says «max» without a limit; a container may not see the folders of its group.
            with suppress(OSError, ValueError):
                limits.append(int((ancestor / file_name).read_text("utf-8")))
    return limits


def _resident_limit() -> list[int]:
    """Return the limit of resident memory (`ulimit -m`), bytes, or [] without a limit."""
    try:
        import resource
    except ImportError:  # Windows has no such limits
        return []
    limit = resource.getrlimit(resource.RLIMIT_RSS)[1]
    return [limit] if limit > 0 else []


def memory_share() -> int:
    """Return the maximum memory of the objects of a file, bytes."""
    return memory() // _SHARE


def bytes_of(count: int) -> str:
    """Return bytes as text: «1.43 MiB»."""
    for prefix, size in _PREFIXES.items():
        if count >= 0.9 * size:
            return f"{count / size:.2f} {prefix}B"
    return f"{count} B"

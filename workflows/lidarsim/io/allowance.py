"""Memory limits for the content of input files.

Without a limit, a small file could expand to any size.
"""

from __future__ import annotations

from contextlib import suppress
from functools import cache
from pathlib import Path

import psutil

from ..errors import LidarError, as_sentence

UNPACKED_TIMES = 100  # limit as a multiple of the file size
MIN_LIMIT_BYTES = 256 * 2**20  # limit for small files
CONTROL_GROUPS = Path("/sys/fs/cgroup")  # folder in which Linux publishes memory limits
_PREFIXES = {"Pi": 2**50, "Ti": 2**40, "Gi": 2**30, "Mi": 2**20, "ki": 2**10}
# A file may use one quarter of the memory, because a scene is copied while its objects are placed
# and merged.
_SHARE = 4


class Allowance:
    """Memory budget for the content of a file.

    The limit is 100 times the file size or 256 MiB, whichever is larger, but at most a quarter of
    the memory.

    Parameters
    ----------
    size
        File size in bytes.
    advice
        Advice to the user at the end of the error message.
    in_parts
        Whether the content is processed in parts. If it is never entirely in memory, the size of
        the memory does not limit it.

    Examples
    --------
    >>> Allowance(1_500_000, "export it again").reserve(2_900_000_000)
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
        """Limit in bytes."""
        limit = max(UNPACKED_TIMES * self._size, MIN_LIMIT_BYTES)
        return limit if self._in_parts else min(limit, memory_share())

    def grow(self, size: int) -> None:
        """Raise the limit for `size` additional bytes of file data."""
        self._size += size

    def add_file(self, file: Path) -> None:
        """Raise the limit by the size of another file that the input file refers to.

        Each file is counted only once.
        """
        if file not in self._files:
            self._files.add(file)
            self.grow(file.stat().st_size)

    def fits(self, count: int) -> bool:
        """Return whether `count` more bytes are within the limit."""
        return self.used_bytes + count <= self.limit

    def reserve(self, count: int) -> None:
        """Count bytes toward the limit before they are allocated.

        Raises
        ------
        LidarError
            If the limit is exceeded.
        """
        self.check(count)
        self.used_bytes += count

    def check(self, count: int) -> None:
        """Check that a temporary allocation is within the limit, without counting it.

        Raises
        ------
        LidarError
            If the limit would be exceeded.
        """
        if not self.fits(count):
            raise LidarError(
                f"it has {bytes_of(self._size)} but would unpack to at least "
                f"{bytes_of(self.used_bytes + count)}, and the limit is {bytes_of(self.limit)}. "
                f"{as_sentence(self._advice)}"
            )


@cache
def memory() -> int:
    """Return the memory in bytes that this process may use.

    This is the smallest of the physical memory, the limits of the control groups, and `ulimit -m`.
    """
    return min([psutil.virtual_memory().total, *_control_group_limits(), *_resident_limit()])


def _control_group_limits() -> list[int]:
    """Return the memory limits in bytes of all control groups that contain this process.

    Batch systems and containers may set the limit on any ancestor of the group. Versions 1 and 2 of
    control groups are supported.
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
            # The file contains "max" if there is no limit. In a container, the folder of the group
            # may be missing.
            with suppress(OSError, ValueError):
                limits.append(int((ancestor / file_name).read_text("utf-8")))
    return limits


def _resident_limit() -> list[int]:
    """Return the limit on resident memory (`ulimit -m`) in bytes.

    The list is empty if there is no limit.
    """
    try:
        import resource
    except ImportError:  # not available on Windows
        return []
    limit = resource.getrlimit(resource.RLIMIT_RSS)[1]
    return [limit] if limit > 0 else []


def memory_share() -> int:
    """Return the maximum memory in bytes that the content of a single file may use."""
    return memory() // _SHARE


def bytes_of(count: int) -> str:
    """Format a number of bytes, for example "1.43 MiB"."""
    for prefix, size in _PREFIXES.items():
        if count >= 0.9 * size:
            return f"{count / size:.2f} {prefix}B"
    return f"{count} B"

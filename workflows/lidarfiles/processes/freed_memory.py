"""Reuse of freed memory within a process."""

from __future__ import annotations

import ctypes

# Values of M_TRIM_THRESHOLD (-1) and M_MMAP_THRESHOLD (-3), the options of glibc's mallopt.
_THRESHOLDS = {-1: 256 << 20, -3: 256 << 20}


def keep_freed_memory() -> None:
    """Make this process and its forks reuse the memory of large arrays after they are freed.

    By default, glibc returns this memory to the system, and the next large array causes page
    faults. Rendering pictures spent an eighth of its time on such page faults.
    """
    if mallopt := getattr(ctypes.CDLL(None), "mallopt", None):  # only in glibc
        for option, size in _THRESHOLDS.items():
            mallopt(option, size)

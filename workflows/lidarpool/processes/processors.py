"""Number of processors available to this process."""

from __future__ import annotations

import os


def processor_count() -> int:
    """Return the number of processors that this process may use."""
    known = hasattr(os, "sched_getaffinity")  # macOS does not have it
    return len(os.sched_getaffinity(0)) if known else os.cpu_count() or 1

"""Limits of a task, which are annotations: its running time and the memory that it holds.

The scheduler enforces the running time (see `extras/watching.py`), and holds tasks back until a
worker has enough memory for them (see `shares.py`).
"""

from __future__ import annotations

import math
from contextlib import suppress
from typing import Any

from dask.utils import parse_bytes

from .internals.names import SHARES, WATCHING, require_feature

TIMEOUT = "poolpart-timeout"  # annotation of a task: its maximum running time in seconds
MEMORY = "poolpart-memory"  # annotation of a task: the memory that it holds on its worker, in bytes


def limit_annotations(timeout_s: float | None, memory: str | float | None) -> dict[str, Any]:
    """Return the annotations of a task with limits, without those that are None.

    Raises
    ------
    ValueError
        If a limit is not positive, or if the memory cannot be interpreted.
    PoolError
        If this version of Dask lacks the private API that a limit requires.
    """
    annotations: dict[str, Any] = {}
    if timeout_s is not None:
        if not _is_number(timeout_s) or not timeout_s > 0:
            raise ValueError(
                f"Invalid value {timeout_s!r} for `timeout_s`. Expected a positive number of "
                "seconds."
            )
        require_feature(WATCHING)
        annotations[TIMEOUT] = float(timeout_s)
    if memory is not None:
        annotations[MEMORY] = _to_bytes(memory)
        require_feature(SHARES)
    return annotations


def _to_bytes(memory: object) -> int:
    """Return an amount of memory that a user has passed in bytes."""
    number: float = 0.0
    if isinstance(memory, str) and memory.strip()[-1:].isalpha() and any(map(str.isdigit, memory)):
        with suppress(ValueError, OverflowError):
            number = parse_bytes(memory)
    elif _is_number(memory):
        number = memory  # type: ignore[assignment]
    if not 1 <= number < math.inf:
        raise ValueError(
            f"Invalid value {memory!r} for `memory`. Expected an amount with a unit, for example "
            '"2 GiB", or a positive number of bytes.'
        )
    return int(number)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def memory_of(task: Any) -> int:
    """Return the memory in bytes that a task holds on its worker, given the scheduler's state."""
    annotations = task.annotations
    return annotations.get(MEMORY, 0) if annotations else 0

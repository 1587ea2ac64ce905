"""Time limits of tasks, which the scheduler enforces (see `extras/watching.py`)."""

from __future__ import annotations

from typing import Any

from .internals.names import WATCHING, require_feature

TIMEOUT = "poolpart-timeout"  # annotation of a task: its maximum running time in seconds


def timeout_annotation(timeout_s: float | None) -> dict[str, Any]:
    """Return the annotation of a task with a time limit, which is empty for None.

    Raises
    ------
    ValueError
        If the limit is not a positive number.
    PoolError
        If this version of Dask lacks the private API that limits require.
    """
    if timeout_s is None:
        return {}
    if isinstance(timeout_s, bool) or not isinstance(timeout_s, int | float) or not timeout_s > 0:
        raise ValueError(
            f"Invalid value {timeout_s!r} for `timeout_s`. Expected a positive number of seconds."
        )
    require_feature(WATCHING)
    return {TIMEOUT: float(timeout_s)}

"""Trace points that allow tests to observe and interrupt a run."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

Sink = Callable[[str, Mapping[str, Any]], None]

_sink: Sink | None = None  # sink of this process


def trace(point: str, /, **fields: Any) -> None:
    """Report that the run has reached a trace point, if a sink is set.

    Parameters
    ----------
    point
        Name of the trace point in the form ``stage.event``.
    fields
        Values to report.
    """
    if _sink is not None:
        _sink(point, fields)


def trace_to(sink: Sink | None) -> None:
    """Set or remove the function that is called at each trace point in this process.

    The function is called as ``sink(point, fields)`` in the thread that reaches the trace point,
    before the thread continues. It can log the trace point, block the thread, or end the process.
    """
    global _sink
    _sink = sink

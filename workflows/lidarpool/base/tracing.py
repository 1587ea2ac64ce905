"""Trace points of a run, for tests."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

Sink = Callable[[str, Mapping[str, Any]], None]

_sink: Sink | None = None  # sink of this process


def trace(point: str, /, **fields: Any) -> None:
    """Report that a run has reached a point, ``stage.event``, with values for its trace.

    Does nothing without a listener.
    """
    if _sink is not None:
        _sink(point, fields)


def trace_to(sink: Sink | None) -> None:
    """Call `sink(point, fields)` at each point of this process, until `sink` is None.

    It is called in the thread that reaches the point, before that thread continues: it can log the
    point, hold the thread, or end the process.
    """
    global _sink
    _sink = sink

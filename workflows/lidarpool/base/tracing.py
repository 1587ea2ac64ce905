"""Points that a run passes, told to whoever watches."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

Sink = Callable[[str, Mapping[str, Any]], None]

_sink: Sink | None = None  # of this process


def trace(point: str, /, **fields: Any) -> None:
    """Say that a run has come to a named point; does nothing unless somebody listens.

    Parameters
    ----------
    point
        Name of the point, ``stage.event``.
    fields
        What there is to tell; plain values.
    """
    if _sink is not None:
        _sink(point, fields)


def trace_to(sink: Sink | None) -> None:
    """Call `sink(point, fields)` at each point that this process passes; None for nobody.

    It is called in the thread that passes the point, and before that goes on: it can log the
    point as well as hold the thread there, or end the process.
    """
    global _sink
    _sink = sink

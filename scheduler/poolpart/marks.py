"""Knowing that a worker has got all messages that the scheduler sent it: a mark behind them.

What the scheduler asks a worker, as to declare other resources, goes by another connection than
the tasks that it sends, and may come first. A task that was sent and cancelled at once is
forgotten by the scheduler while it is on its way; a worker that gets one for a resource which it
does not declare breaks down.
"""

from __future__ import annotations

import uuid
from typing import Any

from .calls import call

_OP = "poolpart-mark"


async def send_mark(scheduler: Any, address: str) -> None:
    """Send a mark behind all messages to a worker; runs on the scheduler.

    Raises
    ------
    OSError
        If the worker does not answer.
    """
    mark = uuid.uuid4().hex
    await call(scheduler, address, _await_mark, mark=mark)
    if address in scheduler.stream_comms:
        scheduler.worker_send(address, {"op": _OP, "mark": mark})


def is_awaited(worker: Any) -> bool:
    """Whether a mark is still on its way; runs on the worker."""
    return _OP in worker.stream_handlers


def _await_mark(mark: str, dask_worker: Any = None) -> None:
    awaited = mark

    def arrive(mark: str) -> None:
        # One that was sent before comes before: when this one has come, there are none.
        if mark == awaited:
            del dask_worker.stream_handlers[_OP]

    dask_worker.stream_handlers[_OP] = arrive

"""Main function of a process that applies functions to items."""

from __future__ import annotations

import os
import select
import threading
import traceback
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any

import cloudpickle

from ..processes.freed_memory import keep_freed_memory


def serve(descriptor: int) -> None:
    """Apply functions to items from a socket until the other end is closed.

    The process ends immediately if the process that has started it dies.
    """
    threading.Thread(target=_exit_on_hangup, args=(descriptor,), daemon=True).start()
    keep_freed_memory()
    connection = Connection(descriptor)
    function: Callable[[Any], Any] | None = None
    while True:
        try:
            kind = connection.recv_bytes()
            content = connection.recv_bytes()
        except EOFError:
            return
        if kind == b"function":
            function = None  # before the next one is created, to save memory
            packed = content
            continue
        try:
            if function is None:
                function = cloudpickle.loads(packed)
            kind, content = b"result", cloudpickle.dumps(function(cloudpickle.loads(content)))
        except Exception as error:
            kind, content = b"error", _pack_error(error)
        connection.send_bytes(kind)
        connection.send_bytes(content)


def _exit_on_hangup(descriptor: int) -> None:
    poll = select.poll()
    poll.register(descriptor, select.POLLHUP)
    poll.poll()
    os._exit(1)


def _pack_error(error: Exception) -> bytes:
    text = traceback.format_exc()
    try:
        packed = cloudpickle.dumps((error, text))
        cloudpickle.loads(packed)
    except Exception:
        return cloudpickle.dumps((RuntimeError(f"{type(error).__name__}: {error}"), text))
    return packed

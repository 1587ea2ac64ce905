"""Values that each process creates for itself, such as open files."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any, Generic, TypeVar

Value = TypeVar("Value")


class PerProcess(Generic[Value]):
    """Value that is created separately by each process when it is first used.

    Use it for open files and locks that a forked process must not share with its parent. If two
    processes share an open file, each read moves the file position of both.

    The value is not pickled, so that another process creates its own value.

    Parameters
    ----------
    create
        Function that creates the value.
    """

    def __init__(self, create: Callable[[], Value]) -> None:
        self._create = create
        # A fork keeps its parent's value, because closing it could affect the parent.
        self._values: dict[int, Value] = {}  # {process: value}

    def __getstate__(self) -> dict[str, Any]:
        return {"_create": self._create, "_values": {}}

    def __call__(self) -> Value:
        """Return the value that belongs to the current process."""
        process = os.getpid()
        if process not in self._values:
            # Another thread may have created the value in the meantime.
            self._values.setdefault(process, self._create())
        return self._values[process]

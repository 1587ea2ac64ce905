"""Values that each process creates for itself, such as open files."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Generic, TypeVar

Value = TypeVar("Value")


class PerProcess(Generic[Value]):
    """A value that each process creates when it first calls this object.

    Use it for open files and locks that a forked process must not share with its parent: both
    processes would move the position of the same file.

    Parameters
    ----------
    create
        Function that creates the value.
    """

    def __init__(self, create: Callable[[], Value]) -> None:
        self._create = create
        # The value of the parent is kept, because closing it could affect the parent.
        self._values: dict[int, Value] = {}  # {process: value}

    def __call__(self) -> Value:
        """Return the value of this process."""
        process = os.getpid()
        if process not in self._values:
            self._values.setdefault(process, self._create())  # another thread may be faster
        return self._values[process]

"""Formats of many files: writes the files in a few threads."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

from ..columns.cloud import Cloud

Made = TypeVar("Made")
# NumPy, pyarrow and system calls for the disk hold Python's lock at most 6 % of the time;
# each thread has a piece of the cloud in memory.
THREADS = min(4, os.cpu_count() or 1)


def write_each(write: Callable[[int, Cloud], Made], pieces: Iterable[Cloud]) -> list[Made]:
    """Call a function with the number of each piece of a cloud and the piece.

    Returns
    -------
    Results in the order of the pieces. After an error or interrupt no call continues.
    """
    made: list[Made] = []
    under_way: deque[Future[Made]] = deque()
    with ThreadPoolExecutor(THREADS, "write") as pool:
        for number, piece in enumerate(pieces):
            if len(under_way) == THREADS:
                made.append(under_way.popleft().result())
            under_way.append(pool.submit(write, number, piece))
        made += [future.result() for future in under_way]
    return made

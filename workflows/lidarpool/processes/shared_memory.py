"""Pickled values in memory that is shared by all processes on a machine.

A large value that is sent through Dask is copied several times, and each process keeps its own
copy. Shared memory avoids these copies. It is an anonymous file (`memfd_create`, Linux only), which
processes of the same user can open at ``/proc/PID/fd/NUMBER``. The system frees the memory when the
last process that uses it exits, even if that process crashes.
"""

from __future__ import annotations

import mmap
import os
import pickle
import secrets
from pathlib import Path
from typing import Any, NamedTuple

import cloudpickle

_ALIGNMENT = 64  # alignment of each array, bytes


class Pickled(NamedTuple):
    """Pickled value whose arrays are stored separately, as in pickle protocol 5."""

    head: bytes  # pickle stream without the contents of arrays
    buffers: tuple[memoryview | bytearray, ...]  # contents of the arrays

    @classmethod
    def from_value(cls, value: object) -> Pickled:
        """Pickle a value, with buffers that are views of its arrays instead of copies."""
        buffers: list[pickle.PickleBuffer] = []
        head = cloudpickle.dumps(value, protocol=5, buffer_callback=buffers.append)
        return cls(head, tuple(buffer.raw() for buffer in buffers))

    @property
    def nbytes(self) -> int:
        """Size of the pickled value in bytes, including its arrays."""
        return len(self.head) + sum(len(buffer) for buffer in self.buffers)

    def copy(self) -> Pickled:
        """Return a copy with writable arrays, which can be sent to other processes."""
        return Pickled(self.head, tuple(bytearray(buffer) for buffer in self.buffers))

    def load(self) -> Any:
        """Unpickle the value."""
        return pickle.loads(self.head, buffers=self.buffers)  # noqa: S301 - from the run's driver


class SharedHandle(NamedTuple):
    """Location of a `SharedValue`, which other processes need to load the value."""

    path: str
    name: str  # unique name of the memory
    spans: tuple[tuple[int, int], ...]  # start and end of the head and of each buffer, in bytes

    def load(self) -> Any:
        """Load the value.

        The arrays of the value are views of the shared memory. The system copies a page when the
        process writes to it.

        Raises
        ------
        OSError
            If this process cannot access the memory, for example on another machine.
        """
        target = str(Path(self.path).readlink())
        if target.partition(" ")[0] != f"/memfd:{self.name}":
            raise FileNotFoundError(f"{self.path} refers to a different file")
        with Path(self.path).open("rb") as file:
            memory = memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_COPY))
        head, *buffers = [memory[start:stop] for start, stop in self.spans]
        return Pickled(bytes(head), tuple(buffers)).load()


class SharedValue:
    """Pickled value in shared memory.

    The memory is freed when neither this object nor any loaded copy exists anymore.

    Raises
    ------
    OSError
        If the system does not support shared memory, or does not have enough of it.
    """

    def __init__(self, pickled: Pickled) -> None:
        if not hasattr(os, "memfd_create"):
            raise OSError("this system does not support memfd_create")
        name = f"lidarpool-{secrets.token_hex(8)}"
        self._file = os.fdopen(os.memfd_create(name), "wb", buffering=0)
        spans = []
        for content in (pickled.head, *pickled.buffers):
            start = -(-self._file.tell() // _ALIGNMENT) * _ALIGNMENT
            self._file.seek(start)
            remaining = memoryview(content)
            while remaining:  # Linux writes at most 2 GiB in one call
                remaining = remaining[self._file.write(remaining) :]
            spans.append((start, start + len(content)))
        path = f"/proc/{os.getpid()}/fd/{self._file.fileno()}"
        self.handle = SharedHandle(path, name, tuple(spans))

    def close(self) -> None:
        """Release the memory, except in processes that have already loaded the value."""
        self._file.close()

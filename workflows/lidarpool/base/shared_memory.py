"""Pickled values, and memory of this process that other processes of this machine map.

A large value that is sent through Dask is copied several times, and each process has a separate
copy. Shared memory is a file without a name in any folder (`memfd_create`, Linux), which processes
of the same user open at ``/proc/PID/fd/NUMBER``. The system frees the memory with the last process
that uses it, however that process ends.
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
    """A pickled value: its bytes, and the contents of its arrays beside them."""

    head: bytes
    buffers: tuple[memoryview | bytearray, ...]

    @classmethod
    def from_value(cls, value: object) -> Pickled:
        """Pickle a value, with `buffers` for views of its arrays."""
        buffers: list[pickle.PickleBuffer] = []
        head = cloudpickle.dumps(value, protocol=5, buffer_callback=buffers.append)
        return cls(head, tuple(buffer.raw() for buffer in buffers))

    @property
    def nbytes(self) -> int:
        """Size of the value, bytes."""
        return len(self.head) + sum(len(buffer) for buffer in self.buffers)

    def copy(self) -> Pickled:
        """Return a copy that can be sent, and whose arrays can be written to."""
        return Pickled(self.head, tuple(bytearray(buffer) for buffer in self.buffers))

    def load(self) -> Any:
        """Return the value."""
        return pickle.loads(self.head, buffers=self.buffers)  # noqa: S301 - of the run's own driver


class SharedHandle(NamedTuple):
    """Location of a `SharedValue`, for loading the value in another process."""

    path: str
    name: str  # unique name of the memory
    spans: tuple[tuple[int, int], ...]  # start and end of the head and of each buffer

    def load(self) -> Any:
        """Return the value.

        Its arrays lie in the shared memory, and are copied when written to.

        OSError if this process does not see the memory, as on another machine.
        """
        target = str(Path(self.path).readlink())
        if target.partition(" ")[0] != f"/memfd:{self.name}":
            raise FileNotFoundError(f"{self.path} refers to a different file")
        with Path(self.path).open("rb") as file:
            memory = memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_COPY))
        head, *buffers = [memory[start:stop] for start, stop in self.spans]
        return Pickled(bytes(head), tuple(buffers)).load()


class SharedValue:
    """A pickled value in shared memory, as long as this object or a loaded copy exists.

    OSError if the system has no such memory, or not enough.
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
            while remaining:  # the system writes 2 GiB at a time
                remaining = remaining[self._file.write(remaining) :]
            spans.append((start, start + len(content)))
        path = f"/proc/{os.getpid()}/fd/{self._file.fileno()}"
        self.handle = SharedHandle(path, name, tuple(spans))

    def close(self) -> None:
        """Release the memory, except for processes that have loaded the value."""
        self._file.close()

"""Libraries in a process of their own: on broken files they may crash, hang or take any memory.

A script, not a module of this package, reads the file and writes frames to its standard output,
each a line of JSON and the bytes of arrays. The script sets its limits of memory and time itself.
"""

from __future__ import annotations

import json
import math
import os
import signal
import subprocess
import sys
from collections.abc import Generator, Mapping
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np

from lidarsim.base.allowance import Allowance, bytes_of
from lidarsim.base.arrays import AnyArray

Frame = tuple[dict[str, Any], list[AnyArray]]


class ChildReader(NamedTuple):
    """A script that reads files with a library."""

    script: str  # file beside this module
    library: str  # name for users
    max_bytes: int  # memory that the process may allocate
    environment: Mapping[str, str]  # all variables of the process


def child_frames(
    reader: ChildReader, path: Path, request: dict[str, Any], allowance: Allowance
) -> Generator[Frame]:
    """Read a file in a process of its own, and yield frames with their arrays.

    The script gets the path, and `request` with the memory that it may allocate. Images add to the
    size of the file, and all arrays take of the allowance.

    Raises
    ------
    ValueError
        If the script reports an error, or ends while further frames are read.
    """
    command = json.dumps(request | {"memory": reader.max_bytes}, default=str)
    with subprocess.Popen(
        # -P: our modules must not take the place of the library's.
        [
            sys.executable,
            "-P",
            Path(__file__).with_name(reader.script),
            path.absolute(),
            command,
        ],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        cwd=path.parent,
        env=reader.environment,
    ) as child:
        assert child.stdout
        try:
            while content := _next_frame(child.stdout, allowance):
                frame, arrays = content
                if frame["what"] == "error":
                    raise ValueError(frame["reason"])
                yield frame, arrays
            code = child.wait()
        finally:
            child.kill()
    if code == -signal.SIGALRM:
        raise ValueError(f"{reader.library} takes too long for it")
    status = signal.Signals(-code).name if code < 0 else f"status {code}"
    raise ValueError(
        f"{reader.library} ended with {status}, or needs more than {bytes_of(reader.max_bytes)} of "
        "memory"
    )


def _next_frame(stream: IO[bytes], allowance: Allowance) -> Frame | None:
    """Read a frame; None at the end, also of a process that ended within a frame."""
    line = stream.readline()
    if not line.endswith(b"\n"):
        return None
    frame = json.loads(line)
    arrays = []
    for kind, shape in frame["arrays"]:
        size = np.dtype(kind).itemsize * math.prod(shape)
        if frame["what"] == "image":
            allowance.grow(size)
        allowance.take(size)
        data = stream.read(size)
        if len(data) < size:
            return None
        arrays.append(np.frombuffer(data, kind).reshape(shape))
    return frame, arrays


def environment_without(prefix: str) -> dict[str, str]:
    """Return the variables of this process without a library's, and with one thread for OpenBLAS.

    A thread that is refused for the memory limit would be waited for until the alarm.
    """
    variables = {name: text for name, text in os.environ.items() if not name.startswith(prefix)}
    return variables | {"OPENBLAS_NUM_THREADS": "1"}

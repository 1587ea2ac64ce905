"""Read files with libraries that may crash, in a separate process.

The process runs a script of this package. The script writes frames to standard output: a line of
JSON, followed by the bytes of the arrays whose data types and shapes are listed in the field
`arrays`. If the field `what` is "error", the frame has a `reason` and is the last one.
"""

from __future__ import annotations

import json
import math
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Generator, Mapping
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np

from lidarsim.io.allowance import bytes_of
from lidarsim.numerics.arrays import AnyArray

Frame = tuple[dict[str, Any], list[AnyArray]]


class ReaderProcess(NamedTuple):
    """A process that reads one file.

    Attributes
    ----------
    script
        Script that receives the path of the file and the request as JSON. It must not import
        anything from lidarpool.
    library
        Name of the library for error messages.
    max_bytes
        Memory limit of the process, which the script receives as the field `memory` of the request.
    folder
        Working directory.
    hidden
        Prefixes of environment variables that the process does not receive.
    environment
        Additional environment variables.
    """

    script: Path
    library: str
    max_bytes: int
    folder: Path
    hidden: tuple[str, ...] = ()
    environment: Mapping[str, str] = {}

    def frames(
        self, path: Path, request: dict[str, Any], take: Callable[[dict[str, Any], int], None]
    ) -> Generator[Frame]:
        """Read a file in the process, and yield its frames.

        `take` is called with the frame and the size of each array before the array is read.

        Raises
        ------
        ValueError
            If the library refuses the file or crashes, or needs too much time or memory.
        """
        message = json.dumps(request | {"memory": self.max_bytes}, default=str)
        with subprocess.Popen(
            # With -P, modules of this package cannot shadow those of the library.
            [sys.executable, "-P", self.script, path.absolute(), message],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            cwd=self.folder,
            env=self._environment(),
        ) as process:
            assert process.stdout
            try:
                while content := _next_frame(process.stdout, take):
                    frame, arrays = content
                    if frame["what"] == "error":
                        raise ValueError(frame["reason"])
                    yield frame, arrays
                code = process.wait()
            finally:
                process.kill()
        raise ValueError(self._end(code))

    def _environment(self) -> dict[str, str]:
        variables = {
            name: text for name, text in os.environ.items() if not name.startswith(self.hidden)
        }
        # Threads need memory, and the library would wait for threads that cannot start.
        return variables | {"OPENBLAS_NUM_THREADS": "1"} | {**self.environment}

    def _end(self, code: int) -> str:
        """Describe why the process ended before it had sent its last frame."""
        if code == -signal.SIGALRM:
            return f"{self.library} exceeded its time limit"
        status = signal.Signals(-code).name if code < 0 else f"status {code}"
        limit = bytes_of(self.max_bytes)
        return (
            f"{self.library} exited with {status}, possibly because it needs more than {limit} "
            "of memory"
        )


def _next_frame(stream: IO[bytes], take: Callable[[dict[str, Any], int], None]) -> Frame | None:
    """Read a frame, or return None at the end of the stream.

    None is also returned if the process has ended within a frame.
    """
    line = stream.readline()
    if not line.endswith(b"\n"):
        return None
    frame = json.loads(line)
    arrays = []
    for kind, shape in frame["arrays"]:
        size = np.dtype(kind).itemsize * math.prod(shape)
        take(frame, size)
        content = stream.read(size)
        if len(content) < size:
            return None
        arrays.append(np.frombuffer(content, kind).reshape(shape))
    return frame, arrays

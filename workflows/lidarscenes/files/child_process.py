"""Files read by libraries that may end their process, in a separate process.

A script of this package is that process. Its standard output has frames, each a line of JSON and
the bytes of the arrays of its field `arrays`, a list of data types and shapes. A frame whose field
`what` is "error" has a `reason`, and is the last.
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

from lidarsim.base.allowance import bytes_of
from lidarsim.base.arrays import AnyArray

Frame = tuple[dict[str, Any], list[AnyArray]]


class ReaderProcess(NamedTuple):
    """A process that reads a file.

    Attributes
    ----------
    script
        The script, which takes the file and the request as JSON, and imports nothing of ours.
    library
        Name of the library, for errors.
    max_bytes
        Memory that the process may take, bytes: the field `memory` of the request.
    folder
        Working directory.
    hidden
        Beginnings of the names of environment variables that the process does not get.
    environment
        Further environment variables.
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
        """Read a file, and yield the frames.

        `take` is called with a frame and the bytes of each of its arrays, before they are read.

        Raises
        ------
        ValueError
            If the library refuses the file, ends the process, or takes too long or too much memory.
        """
        message = json.dumps(request | {"memory": self.max_bytes}, default=str)
        with subprocess.Popen(
            # -P: our modules must not take the place of the library's.
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
        """Return the environment variables of the process."""
        variables = {
            name: text for name, text in os.environ.items() if not name.startswith(self.hidden)
        }
        # Threads take memory, and would be waited for if it is refused.
        return variables | {"OPENBLAS_NUM_THREADS": "1"} | {**self.environment}

    def _end(self, code: int) -> str:
        """Return why the process ended before its last frame was read."""
        if code == -signal.SIGALRM:
            return f"{self.library} exceeded its time limit"
        status = signal.Signals(-code).name if code < 0 else f"status {code}"
        limit = bytes_of(self.max_bytes)
        return (
            f"{self.library} exited with {status}, possibly because it needs more than {limit} "
            "of memory"
        )


def _next_frame(stream: IO[bytes], take: Callable[[dict[str, Any], int], None]) -> Frame | None:
    """Read a frame, or None at the end.

    A process that has ended within a frame gives None too.
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

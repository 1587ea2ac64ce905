"""The command in a process of its own, and the processes that it starts."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
import uuid
from pathlib import Path

ENDS_WITHIN_S = 300  # on a busy machine; a second or two on an idle one


class RunningCommand:
    """The command in a process group of its own, as a shell starts it."""

    def __init__(self, folder: Path, scenario: str, *options: str, prelude: str = "") -> None:
        (folder / "s.yaml").write_text(scenario)
        code = prelude + "from lidarpool.__main__ import main; main()"
        arguments = ["run", "s.yaml", "--out", "out", "--overwrite", *options]
        self.tag = uuid.uuid4().hex
        self.log = folder / f"{self.tag}.log"
        with self.log.open("wb") as log:
            self.process = subprocess.Popen(
                [sys.executable, "-c", code, *arguments],
                cwd=folder,
                stdout=log,
                stderr=log,
                start_new_session=True,
                env={**os.environ, "TEST_RUN_TAG": self.tag},
            )

    def wait_for(self, pattern: str) -> RunningCommand:
        """Wait until the run says something."""
        stop = time.monotonic() + ENDS_WITHIN_S
        while not re.search(pattern, self.said):
            assert self.process.poll() is None, self.said
            assert time.monotonic() < stop, self.said
            time.sleep(0.02)
        return self

    @property
    def said(self) -> str:
        """What it has written so far, its workers included."""
        return self.log.read_text()

    def signal(self, number: int, *, group: bool = False) -> int:
        """Send a signal, wait for the end, return the exit code."""
        (os.killpg if group else os.kill)(self.process.pid, number)
        return self.process.wait(ENDS_WITHIN_S)

    @property
    def processes(self) -> set[int]:
        """Processes of this run that are alive, workers included."""
        found = set()
        for entry in Path("/proc").iterdir():
            if entry.name.isdigit():
                try:
                    if self.tag.encode() in (entry / "environ").read_bytes():
                        found.add(int(entry.name))
                except (OSError, ProcessLookupError):
                    continue  # it has ended, or is another user's
        return found

    def wait_until_alone(self, seconds: float = ENDS_WITHIN_S) -> None:
        """Wait until no process is left."""
        stop = time.monotonic() + seconds
        while self.processes:
            assert time.monotonic() < stop, self.processes
            time.sleep(0.1)

    def close(self) -> None:
        for process in self.processes:
            os.kill(process, signal.SIGKILL)
        self.process.wait(300)

"""Runs a command as long as stdin is open: `python attached_child.py COMMAND …`.

The process that started it holds the other end of stdin, which the system closes when that process
ends, even if it is killed. Then the command and its children, a separate process group, end.
"""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys

_CHECK_S = 0.2  # whether the command has ended by itself


def main(command: list[str]) -> int:
    """Run a command until it ends, or stdin does, and return its exit status."""
    child = subprocess.Popen(command, stdin=subprocess.DEVNULL)
    while child.poll() is None:
        readable, _, _ = select.select([0], [], [], _CHECK_S)
        if readable and not os.read(0, 1):
            os.killpg(os.getpgid(0), signal.SIGTERM)  # this process as well
    return child.returncode


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

"""Run a command until stdin is closed: `python attached_child.py COMMAND …`.

The parent process holds the other end of stdin. The operating system closes it when the parent
exits, even if the parent is killed. The command and its children, which form a process group, are
then terminated.
"""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys

_CHECK_S = 0.2  # interval for checking whether the command has exited


def main(command: list[str]) -> int:
    """Run a command until it exits or stdin is closed, and return its exit status."""
    child = subprocess.Popen(command, stdin=subprocess.DEVNULL)
    while child.poll() is None:
        readable, _, _ = select.select([0], [], [], _CHECK_S)
        if readable and not os.read(0, 1):
            os.killpg(os.getpgid(0), signal.SIGTERM)  # includes this process
    return child.returncode


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

"""Pause and stop, from the page to the run."""

from __future__ import annotations

import threading


class RunControl:
    """What somebody at the page wants of the run; the run asks for it in its own thread."""

    def __init__(self) -> None:
        self._pause, self._stop = threading.Event(), threading.Event()

    @property
    def paused(self) -> bool:
        """Whether the run is to stand still."""
        return self._pause.is_set() and not self._stop.is_set()

    @property
    def stopped(self) -> bool:
        """Whether the run is to end."""
        return self._stop.is_set()

    def pause(self) -> None:
        """Have the run stand still; nothing is lost."""
        self._pause.set()

    def go_on(self) -> None:
        """Have it go on."""
        self._pause.clear()

    def stop(self) -> None:
        """Have it end as by Ctrl-C, also when it stands still."""
        self._stop.set()

    def check(self) -> None:
        """Do nothing, unless the run is to stop.

        Raises
        ------
        KeyboardInterrupt
            If it is.
        """
        if self._stop.is_set():
            raise KeyboardInterrupt

    def wait_for_stop(self) -> None:
        """Wait until somebody presses stop, or Ctrl-C."""
        while not self._stop.wait(0.2):
            pass

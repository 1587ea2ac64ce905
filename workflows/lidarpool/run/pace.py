"""Pace of frames: each is handed out at its own time."""

from __future__ import annotations

import time


class Pacer:
    """Waits until frames are due, at a speed relative to the scanner.

    The first frame is due at once. A frame that comes late is due at once, and later frames do not
    catch up: the display is never faster than the scanner.
    """

    def __init__(self, speed: float) -> None:
        self._ns_per_s = speed * 1e9
        self._last: tuple[float, float] | None = None  # time of the survey, ns; when it was due, s

    def wait(self, time_ns: float) -> None:
        """Wait until a frame is due, whose scan began at `time_ns` since the survey's start."""
        now_s = time.monotonic()
        if self._last is not None:
            last_ns, last_s = self._last
            # Scans of a second sensor follow all scans of the first, and begin anew.
            due_s = last_s + max(time_ns - last_ns, 0.0) / self._ns_per_s
            if due_s > now_s:
                time.sleep(due_s - now_s)
                now_s = due_s
        self._last = time_ns, now_s

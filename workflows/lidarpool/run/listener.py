"""Live output of a run, which forwards committed parts and frames at the speed of the scanner."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

from .pipeline.stage_messages import Receipt, ScanFrame
from .run_page import RunPage


class Listener:
    """Listener that forwards a survey's committed parts and frames to the live page and the caller.

    The methods are called in the thread of the run.

    Parameters
    ----------
    page
        Live page of the run.
    on_frame
        Function that is called with each frame, in scan order.
    on_parts
        Function that is called with committed parts. It must return immediately.
    pace
        Speed of the frames relative to the scanner, or None to pass on frames immediately. With a
        pace, the page receives the points of a frame when the frame is due.
    """

    def __init__(
        self,
        page: RunPage,
        on_frame: Callable[[ScanFrame], object] | None = None,
        on_parts: Callable[[Sequence[Receipt]], object] | None = None,
        pace: float | None = None,
    ) -> None:
        self.page = page
        self._on_frame = on_frame
        self._on_parts = on_parts
        self._pacer = None if pace is None else Pacer(pace)
        self._unshown: list[Receipt] = []  # parts whose frames are not due yet

    def on_frame(self, frame: ScanFrame) -> None:
        """Wait until a frame is due, and forward it."""
        if self._pacer is not None:
            self._pacer.wait(frame.time_ns)
            self._show_parts(frame.scan + 1)
        self.page.on_frame(frame)
        if self._on_frame is not None:
            self._on_frame(frame)

    def on_parts(self, receipts: Sequence[Receipt]) -> None:
        """Forward committed parts."""
        if self._pacer is None:
            self.page.on_parts(receipts)
        else:
            self._unshown += receipts
        if self._on_parts is not None:
            self._on_parts(receipts)

    def _show_parts(self, stop: int) -> None:
        """Show the pending parts that contain scans before `stop`.

        The frames of these scans are due.
        """
        due = sorted((part for part in self._unshown if part.first < stop), key=lambda p: p.first)
        if due:
            self._unshown = [part for part in self._unshown if part.first >= stop]
            self.page.on_parts(due)


class Pacer:
    """Timer that delays frames to simulate a multiple of the scanner's speed.

    The first frame and frames that arrive late are due immediately. Later frames do not catch up,
    so that the display is never faster than the scanner.
    """

    def __init__(self, speed: float) -> None:
        self._ns_per_s = speed * 1e9
        # Time in the survey in nanoseconds, and monotonic time at which it was due in seconds.
        self._last: tuple[float, float] | None = None

    def wait(self, time_ns: float) -> None:
        """Wait until a frame is due.

        `time_ns` is the start of its scan in nanoseconds since the start of the survey.
        """
        now_s = time.monotonic()
        if self._last is not None:
            last_ns, last_s = self._last
            # The scans of each sensor follow those of the previous sensor, and their time restarts.
            due_s = last_s + max(time_ns - last_ns, 0.0) / self._ns_per_s
            if due_s > now_s:
                time.sleep(due_s - now_s)
                now_s = due_s
        self._last = time_ns, now_s

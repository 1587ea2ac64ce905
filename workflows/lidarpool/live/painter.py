"""Drawing when there is something new, and never so often that it takes over the machine."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Hashable, Iterable
from dataclasses import dataclass

BUSY_SHARE = 0.1  # of the time may go into drawing while a run needs the machine


class Painter:
    """Calls a function after it was asked to, in one thread, with a rest after each call.

    However often it is asked, what it draws is the latest state, once.

    Parameters
    ----------
    draw
        What to call; if it returns True, it is called again after its rest.
    every_s
        Seconds from one call to the next, at least.
    busy_share
        Share of the time that may go into drawing.
    """

    def __init__(
        self, draw: Callable[[], object], every_s: float, busy_share: float = BUSY_SHARE
    ) -> None:
        self._draw, self._every_s, self._busy_share = draw, every_s, busy_share
        self._asked = threading.Event()
        self._ended = threading.Event()
        self.error: BaseException | None = None  # that ended it

    def ask(self, _: object = None) -> None:
        """Have it draw soon; from any thread, and as a callback of whatever."""
        self._asked.set()

    def end(self) -> None:
        """Have `run` return, after a last drawing if one was asked for."""
        self._ended.set()
        self._asked.set()

    def run(self) -> None:
        """Draw until `end` is called.

        Raises
        ------
        Exception
            Whatever `draw` raises.
        """
        while True:
            # A wait without limit would not be left on Ctrl-C everywhere.
            while not self._asked.wait(0.2):
                pass
            last = self._ended.is_set()
            self._asked.clear()
            started = time.monotonic()
            if self._draw() is True:
                self._asked.set()
            if last:
                return
            took = time.monotonic() - started
            self._ended.wait(max(self._every_s - took, took * (1 / self._busy_share - 1)))
            if self._ended.is_set():
                self._asked.set()

    def start(self) -> threading.Thread:
        """Run in a thread of its own; what it raises is kept in `error`."""
        thread = threading.Thread(target=self._run_kept, name="lidarpool-live", daemon=True)
        thread.start()
        return thread

    def _run_kept(self) -> None:
        try:
            self.run()
        except Exception as error:
            self.error = error


@dataclass(frozen=True)
class Drawing:
    """A part of a page, and how it is drawn.

    Parameters
    ----------
    name
        Its name, each one once.
    state
        What it looks like: it is drawn when this has changed.
    every_s
        Seconds from one drawing to the next, at least.
    draw
        Draws it.
    """

    name: str
    state: Hashable
    every_s: float
    draw: Callable[[], None]


class Throttle:
    """Draws the parts of a page that have changed, each not oftener than it may be."""

    def __init__(self) -> None:
        self._drawn: dict[str, Hashable] = {}  # {name: its state when it was drawn}
        self._due_at: dict[str, float] = {}

    def hurry(self) -> None:
        """Let everything be due, since somebody waits for it."""
        self._due_at = {}

    def draw(self, drawings: Iterable[Drawing], final: bool = False) -> bool:
        """Draw what has changed and is due, or all that has changed if this is final.

        Returns
        -------
        left
            Whether something has changed that was not due.
        """
        left = False
        for drawing in drawings:
            if drawing.name in self._drawn and self._drawn[drawing.name] == drawing.state:
                continue
            now = time.monotonic()
            if now < self._due_at.get(drawing.name, now) and not final:
                left = True
                continue
            drawing.draw()
            self._drawn[drawing.name] = drawing.state
            self._due_at[drawing.name] = time.monotonic() + drawing.every_s
        return left

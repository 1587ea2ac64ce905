"""Parts of a page that are drawn when they have changed, each not oftener than it may be."""

from __future__ import annotations

import time
from collections.abc import Callable, Hashable, Iterable
from dataclasses import dataclass


@dataclass(frozen=True)
class Part:
    """Something to draw.

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


class DueParts:
    """Knows what was drawn when."""

    def __init__(self) -> None:
        self._drawn: dict[str, Hashable] = {}  # {part: its state when it was drawn}
        self._due_at: dict[str, float] = {}

    def hurry(self) -> None:
        """Let everything be due, since somebody waits for it."""
        self._due_at = {}

    def draw(self, parts: Iterable[Part], final: bool = False) -> bool:
        """Draw what has changed and is due, or all that has changed if this is final.

        Returns
        -------
        left
            Whether something has changed that was not due.
        """
        left = False
        for part in parts:
            if part.name in self._drawn and self._drawn[part.name] == part.state:
                continue
            now = time.monotonic()
            if now < self._due_at.get(part.name, now) and not final:
                left = True
                continue
            part.draw()
            self._drawn[part.name] = part.state
            self._due_at[part.name] = time.monotonic() + part.every_s
        return left

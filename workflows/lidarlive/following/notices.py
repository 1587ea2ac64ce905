"""Notices for the user, each of which is shown once until its cause is gone."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Hashable

from lidarsim.words import list_names

MAX_NAMES = 12  # names that are listed in a notice
_PERIOD_S = 10.0  # minimum time between notices about repeated events


class Notices:
    """Shows each notice once.

    Parameters
    ----------
    show
        Function that shows a line.
    """

    def __init__(self, show: Callable[[str], None]) -> None:
        self._show = show
        self._shown: set[Hashable] = set()
        self._events: dict[Hashable, tuple[float, int]] = {}  # {key: time of notice, events since}

    def show(self, key: Hashable, text: str) -> None:
        """Show a notice, unless a notice with the same key was shown before."""
        if key not in self._shown:
            self._shown.add(key)
            self._show(text)

    def show_event(self, key: Hashable, text: str) -> None:
        """Show a notice about an event. Events that are repeated often are only counted."""
        now_s = time.monotonic()
        shown_s, count = self._events.get(key, (-_PERIOD_S, 0))
        if now_s - shown_s < _PERIOD_S:
            self._events[key] = (shown_s, count + 1)
            return
        self._events[key] = (now_s, 0)
        if count:
            noun, verb = ("event", "was") if count == 1 else ("events", "were")
            text += f" ({count:,} more such {noun} {verb} not shown.)"
        self._show(text)

    def show_names(self, key: str, names: Collection[str], text: str) -> None:
        """Show a notice about those names for which it was not shown before.

        `text` contains the field {names}.
        """
        new = [name for name in names if (key, name) not in self._shown]
        if new:
            self._shown.update((key, name) for name in new)
            self._show(text.format(names=list_names(new, MAX_NAMES)))

    def clear(self, key: Hashable) -> bool:
        """Allow a notice to be shown again, because its cause is gone.

        Returns whether it was shown.
        """
        was_shown = key in self._shown
        self._shown.discard(key)
        return was_shown

"""The panel of a run: how far it is, and what somebody at the page wants of it."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from html import escape

from ..run.progress import STAGES, Progress, in_words, is_sure, time_in_words

WINDOW_S = 10.0  # that rates are taken over

_BOX = '<div style="padding:0 0.8em;font-size:0.85em;font-variant-numeric:tabular-nums">'


@dataclass(frozen=True)
class Occupancy:
    """Slots of a partition, and how many of them are held by a task."""

    busy: int
    slots: int


@dataclass(frozen=True)
class RunState:
    """What the panel tells beside the progress.

    Parameters
    ----------
    words
        What the run is doing.
    partitions
        How busy each partition is, by name.
    displayed
        Points that are displayed.
    frames, skipped
        Frames that were displayed, and those that were not because others came at once.
    error
        What cannot be displayed and why, a sentence; empty if nothing is wrong.
    """

    words: str
    partitions: Mapping[str, Occupancy] = field(default_factory=dict)
    displayed: int = 0
    frames: int = 0
    skipped: int = 0
    error: str = ""


class RunPanel:
    """Writes the panel and keeps what the rates are taken from."""

    def __init__(self) -> None:
        self._seen: deque[Progress] = deque()

    def html(self, progress: Progress | None, state: RunState) -> str:
        """Write all of it."""
        if progress is None:
            return f"{_BOX}<b>{escape(state.words)}</b></div>"
        self._note(progress)
        lines = [f"<b>{escape(state.words)}</b>, {progress.seconds:,.0f} s"]
        lines += [self._stage(progress, *stage) for stage in STAGES]
        shown = (
            "" if state.displayed >= progress.points else f", {state.displayed:,} of them displayed"
        )
        lines.append(f"<b>{progress.points:,} points</b>{shown}")
        lines.append(f"{state.frames:,} frames displayed, {state.skipped:,} skipped")
        lines.append(escape(state.error))
        if state.partitions:
            busy = ", ".join(
                f"{escape(name)} {held.busy} of {held.slots}"
                for name, held in state.partitions.items()
            )
            lines.append(f"slots busy: {busy}")
        return _BOX + "".join(f"<div>{line}</div>" for line in lines if line) + "</div>"

    def _note(self, progress: Progress) -> None:
        if not self._seen or progress.seconds > self._seen[-1].seconds:
            self._seen.append(progress)
        while len(self._seen) > 2 and self._seen[1].seconds <= progress.seconds - WINDOW_S:
            self._seen.popleft()

    def _stage(self, progress: Progress, label: str, count: str, total: str) -> str:
        done, whole = getattr(progress, count), getattr(progress, total)
        if not whole:
            return ""
        share = 100 * done / whole
        pace = ""
        first, last = self._seen[0], self._seen[-1]
        span = last.seconds - first.seconds
        came = getattr(last, count) - getattr(first, count)
        if done < whole and came and span > 0:
            rate = came / span
            left = f", {time_in_words((whole - done) / rate)} left"
            pace = f"{in_words(rate)}/s{left if is_sure(done, whole, last.seconds) else ''}"
        return (
            '<div style="display:flex;gap:0.6em;margin-top:0.35em">'
            f'<span style="flex:1">{label}</span><span style="opacity:0.65">{pace}</span>'
            f"<span>{done:,} / {whole:,}</span></div>"
            '<div style="height:0.3em;border-radius:2px;background:rgba(128,134,142,0.3)">'
            f'<div style="height:100%;border-radius:2px;width:{share:.1f}%;background:#2f7fd6">'
            "</div></div>"
        )


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

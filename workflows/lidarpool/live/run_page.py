"""The live page of a run: while it runs, and until somebody has seen enough of it.

The run calls in its own thread, and is never kept waiting by a browser: what it brings is
noted, and a `Painter` reads and draws the latest of it in another.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from typing import Any

import click

from poolpart import Partition

from ..run.job import Job
from ..run.progress import Progress, Show
from ..run.store import RunStore
from ..scan import Frame, Receipt
from .page import PORT, LivePage, live_page, open_browser
from .painter import Painter
from .run_panel import Occupancy, RunControl, RunPanel, RunState
from .run_scene import RunScene

DRAW_EVERY_S = 0.25
ASK_EVERY_S = 2.0  # how busy the partitions are
LAST_DRAWING_S = 60.0  # that the end of a run waits for


class LiveRun:
    """What a run tells a page, and what it is told from there.

    Parameters
    ----------
    page
        The page.
    job
        What the run does.
    """

    def __init__(self, page: LivePage, job: Job) -> None:
        self._page = page
        self.control = RunControl()
        self.painter = Painter(self._draw, DRAW_EVERY_S)
        self._panel, self._text = RunPanel(), page.gui.add_html("")
        self._add_buttons()
        self._scene = RunScene(page, job, self.painter.ask)
        self._words = "starting"
        self._store: RunStore | None = None
        self._progress: Progress | None = None
        self._partitions: Mapping[str, Partition] = {}
        self._busy: dict[str, Occupancy] = {}
        self._ask_at = 0.0
        self._over = False
        page.on_client_connect(self.painter.ask)
        self.painter.ask()

    @property
    def url(self) -> str:
        """Where the page is."""
        return self._page.url

    # -- the run's side, in its thread ---------------------------------------------------

    def follow(self, store: RunStore) -> None:
        """Show what is committed from now on, and what an earlier run has left."""
        self._scene.points.parts.add(store.db.ordered)
        if store.kept:
            self._progress = store.progress()
        store.on_parts = self._on_parts
        self._store = store
        self.painter.ask()

    def _on_parts(self, receipts: Sequence[Receipt]) -> None:
        """Note parts that were committed; the painter reads them, or some of them."""
        self._scene.points.parts.add(receipts)
        self.painter.ask()

    def with_progress(self, show: Show, partitions: Mapping[str, Partition]) -> Show:
        """Return a function to call with the progress: it calls `show` and tells the page.

        Parameters
        ----------
        partitions
            Those whose slots are shown.
        """
        self._partitions = partitions

        def tell(progress: Progress) -> None:
            show(progress)
            self.on_progress(progress)

        return tell

    def on_frame(self, frame: Frame) -> None:
        """Note a frame; it is displayed unless another comes at once."""
        self._scene.note(frame)
        self.painter.ask()

    def on_progress(self, progress: Progress) -> None:
        """Note how far the run is.

        Raises
        ------
        KeyboardInterrupt
            If it was stopped.
        """
        self._progress, self._words = progress, "running"
        now = time.monotonic()
        if now >= self._ask_at:
            self._ask_at = now + ASK_EVERY_S
            with suppress(OSError, RuntimeError):  # a lost cluster is for the run to tell of
                for name, partition in self._partitions.items():
                    stats = partition.stats()
                    self._busy[name] = Occupancy(stats.busy, stats.slots)
        self.painter.ask()
        self.control.check()

    def wants_pause(self) -> bool:
        """Whether the run is to stand still."""
        return self.control.paused

    def finish(self) -> None:
        """Say that the run is over, and show all of it; its parts may be removed after that."""
        if self._store is not None:
            self._scene.complete(self._store)
        self._over, self._words, self._busy = True, "done", {}
        self._pause.disabled = True
        self._stop.label = "Close"
        self.painter.ask()

    def stay(self) -> None:
        """Keep the page until Ctrl-C, or until it is closed from the page itself."""
        click.echo(f"the live page stays at {self._page.url}; Ctrl-C ends it", err=True)
        with suppress(KeyboardInterrupt):
            self.control.wait_for_stop()

    # -- the page's side -----------------------------------------------------------------

    def _add_buttons(self) -> None:
        self._pause = self._page.gui.add_button("Pause")
        self._stop = self._page.gui.add_button("Stop", color="red")

        @self._pause.on_click
        def _pause(_: Any) -> None:
            if self.control.paused:
                self.control.go_on()
            else:
                self.control.pause()
            self._pause.label = "Go on" if self.control.paused else "Pause"
            self.painter.ask()

        @self._stop.on_click
        def _stop(_: Any) -> None:
            self.control.stop()
            self.painter.ask()

    def _draw(self) -> bool:
        """Draw what is new; returns whether something was left for later."""
        if not self._page.get_clients():  # whoever comes later has it drawn then
            return False
        left = self._store is not None and self._scene.draw(self._store, self._over)
        words = self._words
        if not self._over:
            if self._progress is not None and self._progress.waits_for:
                words = f"waiting for slots of {self._progress.waits_for}"
            words = "stopping" if self.control.stopped else words
            if self.control.paused and self._progress is not None:
                words = "paused" if self._progress.paused else "pausing"
        frames = self._scene.frames
        state = RunState(
            words,
            dict(self._busy),
            self._scene.displayed,
            frames.taken,
            frames.dropped,
            self._scene.points.error,
        )
        self._text.content = self._panel.html(self._progress, state)
        return left


@contextmanager
def live_run(job: Job, *, port: int = PORT, browser: bool = True) -> Iterator[LiveRun]:
    """Serve the live page of a run while the body runs, and say where.

    Parameters
    ----------
    job
        What the run does.
    port
        Port to listen on, or the next that is free; 0 for any.
    browser
        Whether to open a browser where there is a desktop.

    Raises
    ------
    Exception
        After the body, if the page could not be drawn.
    """
    with live_page("lidarpool", port) as page:
        live = LiveRun(page, job)
        thread = live.painter.start()
        click.echo(f"live page: {page.url}", err=True)
        if browser:
            open_browser(page.url)
        try:
            yield live
        finally:
            live.painter.end()
            thread.join(LAST_DRAWING_S)
        if live.painter.error is not None:
            raise live.painter.error

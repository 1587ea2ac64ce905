"""What a run tells whoever has started it."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext

from distributed import Client

from .progress import Progress, Show, bars_here

logger = logging.getLogger(__name__)


class Screen:
    """Tells a caller of Python: notes go to the log, and bars are where they can be seen.

    `on_progress` is called in place of bars.
    """

    def __init__(self, on_progress: Callable[[Progress], None] | None = None) -> None:
        self._on_progress = on_progress

    def tell(self, words: str) -> None:
        """Tell something that the user should know."""
        logger.info(words)

    def status(self, words: str) -> AbstractContextManager[None]:
        """Show what is going on while the body runs."""
        return nullcontext()

    def progress(self) -> AbstractContextManager[Show]:
        """Show the progress while the body runs; gives the function that does."""
        return bars_here() if self._on_progress is None else nullcontext(self._on_progress)

    @contextmanager
    def starting(
        self, cluster: AbstractContextManager[Client], words: str, *, own: bool = False
    ) -> Iterator[Client]:
        """Show that a cluster is being started; `own` if its workers share the terminal."""
        with cluster as client:
            yield client

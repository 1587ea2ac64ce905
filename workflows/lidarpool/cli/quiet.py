"""No logs: what a user of the command has to know, it says itself, in its own words."""

from __future__ import annotations

import logging
import warnings
from pathlib import Path
from typing import Any

from distributed.diagnostics.plugin import WorkerPlugin

from .log_file import log_to


def silence_logs() -> None:
    """Drop all log messages of this process, whatever levels Dask gave its many loggers."""
    logging.disable(logging.CRITICAL)
    # An interrupt may come between the making of one of Dask's coroutines and its first step.
    warnings.filterwarnings("ignore", "coroutine .* was never awaited", RuntimeWarning)


class QuietWorkers(WorkerPlugin):
    """Silences the logs of workers that share a terminal with the command.

    A task that fails is told of once, by the driver; Dask's worker would log it as well, with
    a traceback.

    Parameters
    ----------
    log
        A file for what they log; None for none.
    """

    name = "lidarpool-quiet"

    def __init__(self, log: Path | None = None) -> None:
        self.log = log

    def setup(self, worker: Any) -> None:
        """Silence a worker, also one that is started again."""
        if self.log is None:
            silence_logs()
        else:
            log_to(self.log)

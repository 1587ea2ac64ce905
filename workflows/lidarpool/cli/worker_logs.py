"""Messages of workers on the terminal, see `logs.py`."""

from __future__ import annotations

from typing import Any

from distributed.diagnostics.plugin import WorkerPlugin

from .logs import set_logs


class WorkerLogs(WorkerPlugin):
    """Shows or drops messages of workers that share the command's terminal.

    The driver reports a failed task once; Dask's worker would log it as well, with a traceback.
    """

    name = "lidarpool-logs"

    def __init__(self, shown: bool) -> None:
        self.shown = shown

    def setup(self, worker: Any) -> None:
        """Take effect, also in a restarted worker."""
        set_logs(self.shown)

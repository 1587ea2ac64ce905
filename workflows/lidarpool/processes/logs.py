"""Visibility of log messages and warnings from libraries, in the driver and in its workers."""

from __future__ import annotations

import logging
import sys
import warnings


def set_logs(shown: bool) -> None:
    """Show or suppress log messages and warnings from libraries in this process.

    They are suppressed by default, because the command reports everything that matters to users.
    To get a log file, redirect the output of a command with `-v`. The function is also called in
    workers that share the terminal, because a Dask worker would otherwise log a traceback for each
    failed task, which the driver already reports.
    """
    logging.disable(logging.NOTSET if shown else logging.CRITICAL)
    if shown:
        for handler in logging.getLogger("distributed").handlers:
            handler.setLevel(logging.INFO)  # starting a local cluster raises the level
    elif not sys.warnoptions:
        warnings.simplefilter("ignore")

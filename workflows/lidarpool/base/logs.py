"""Logs and warnings of libraries, of a command and of its workers."""

from __future__ import annotations

import logging
import sys
import warnings


def set_logs(shown: bool) -> None:
    """Show or drop log messages and warnings of libraries in this process.

    The command itself tells users what matters. For a log file, redirect the output of `-v`. This
    is also called in workers that share the terminal: the driver reports a failed task once, and
    Dask's worker would log the task as well, with a traceback.
    """
    logging.disable(logging.NOTSET if shown else logging.CRITICAL)
    if shown:
        for handler in logging.getLogger("distributed").handlers:
            handler.setLevel(logging.INFO)  # a local cluster has raised the level
    elif not sys.warnoptions:
        warnings.simplefilter("ignore")

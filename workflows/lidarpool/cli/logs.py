"""Messages of Dask and other libraries: dropped, or with --verbose on the terminal."""

from __future__ import annotations

import logging
import sys
import warnings


def set_logs(shown: bool) -> None:
    """Show log messages and warnings of libraries in this process, or drop them.

    The command itself tells users what matters. For a log file, redirect the output of `-v`. In
    workers that share the terminal, too: the driver reports a failed task once, and Dask's worker
    would log it as well, with a traceback.
    """
    logging.disable(logging.NOTSET if shown else logging.CRITICAL)
    if shown:
        for handler in logging.getLogger("distributed").handlers:
            handler.setLevel(logging.INFO)  # a local cluster has raised it
    elif not sys.warnoptions:
        warnings.simplefilter("ignore")

"""Messages of Dask and other libraries: dropped, or with --verbose on the terminal."""

from __future__ import annotations

import logging
import sys
import warnings


def set_logs(shown: bool) -> None:
    """Show what libraries log and warn of in this process, or drop it.

    What its user has to know, the command says. There is no log file: `-v` and the shell make one.
    """
    logging.disable(logging.NOTSET if shown else logging.CRITICAL)
    if shown:
        for handler in logging.getLogger("distributed").handlers:
            handler.setLevel(logging.INFO)  # which a cluster of this machine has raised
    elif not sys.warnoptions:
        warnings.simplefilter("ignore")

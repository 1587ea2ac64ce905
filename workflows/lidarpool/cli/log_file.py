"""What libraries log and warn of goes to a file in the output folder, not to the terminal."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from logging.handlers import MemoryHandler
from pathlib import Path
from typing import Any

from distributed.diagnostics.plugin import WorkerPlugin

LOG = "lidarpool.log"

_FORMAT = "%(asctime)s %(levelname)-7s %(process)d %(name)s: %(message)s"
_HELD = 200  # messages held back; a run that has more of them has the file before its end


def silence_logs() -> None:
    """Drop all log messages of this process: what its user has to know, the command says."""
    logging.disable(logging.CRITICAL)
    # Nor one of a log on a full disk: the run tells of it where its own files cannot be written.
    logging.raiseExceptions = False
    # An interrupt may come between the making of one of Dask's coroutines and its first step.
    warnings.filterwarnings("ignore", "coroutine .* was never awaited", RuntimeWarning)


class QuietWorkers(WorkerPlugin):
    """Silences workers that share a terminal with the command, or has them log to a file.

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
        silence_logs()
        if self.log is not None:
            _handle_all(LogFile(self.log), logging.INFO)


class LogFile(logging.FileHandler):
    """Appends to a file that is made with the first message; `written` is whether one came."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, delay=True, encoding="utf-8", errors="backslashreplace")
        self.setFormatter(logging.Formatter(_FORMAT))
        self.written = False

    def emit(self, record: logging.LogRecord) -> None:
        """Append one message, unless the disk is full: the run has more to say of that."""
        with suppress(OSError):
            super().emit(record)
            self.written = True


@contextmanager
def logged_to(path: Path, verbose: bool = False) -> Iterator[LogFile]:
    """Keep messages of all loggers, and Python's warnings, in a file while the body runs.

    There is no file where there was nothing to say. Without `verbose` only warnings and errors
    are kept, and written in the end, so that an interrupt leaves the folder as it was.

    Parameters
    ----------
    path
        The file; it is appended to.
    verbose
        Also keep what is merely of interest, and the traceback of an error.
    """
    file = LogFile(path)
    held = MemoryHandler(1 if verbose else _HELD, logging.CRITICAL + 1, file)
    loggers = [*_with_handlers(), logging.root]
    before = [(logger, logger.handlers, logger.propagate) for logger in loggers]
    level, disabled = logging.root.level, logging.root.manager.disable
    _handle_all(held, logging.INFO if verbose else logging.WARNING)
    try:
        yield file
    except KeyboardInterrupt:
        held.buffer.clear()
        raise
    except Exception:
        logging.getLogger(__name__).info("the run has ended with an error", exc_info=True)
        raise
    finally:
        for logger, handlers, propagate in before:
            logger.handlers, logger.propagate = handlers, propagate
        logging.root.setLevel(level)
        logging.disable(disabled)
        logging.captureWarnings(False)
        held.close()  # which writes what was held back
        file.close()


def _handle_all(handler: logging.Handler, level: int) -> None:
    """Let one handler have all messages; Dask changes levels of loggers' own handlers."""
    for logger in _with_handlers():
        logger.handlers, logger.propagate = [], True
    logging.root.handlers = [handler]
    logging.root.setLevel(level)
    handler.setLevel(level)
    logging.captureWarnings(True)
    logging.disable(logging.NOTSET)


def _with_handlers() -> list[logging.Logger]:
    """Loggers, but for the root, that have handlers of their own."""
    known = list(logging.root.manager.loggerDict.values())
    return [logger for logger in known if isinstance(logger, logging.Logger) and logger.handlers]

"""What libraries log and warn of goes to a file in the output folder, not to the terminal."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager
from logging.handlers import MemoryHandler
from pathlib import Path

LOG = "lidarpool.log"

_FORMAT = "%(asctime)s %(levelname)-7s %(process)d %(name)s: %(message)s"
_HELD = 200  # messages held back; a run that has more of them has the file before its end


class LogFile(logging.Handler):
    """Appends messages to a file that is made with the first of them; for several processes.

    It is no StreamHandler, whose levels Dask changes as it starts a cluster.

    Parameters
    ----------
    path
        The file.

    Attributes
    ----------
    written
        Whether anything was written, by this process.
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.path, self.written = path, False
        self.setFormatter(logging.Formatter(_FORMAT))

    def emit(self, record: logging.LogRecord) -> None:
        """Append one message, whole: several workers write to the file."""
        text = f"{self.format(record)}\n".encode(errors="backslashreplace")
        try:
            handle = os.open(self.path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o666)
            try:
                os.write(handle, text)
                self.written = True
            finally:
                os.close(handle)
        except OSError:
            # On a full disk, say. The run has more important things to write there, and tells
            # of it where those fail; a message about a message would only break the display.
            return


@contextmanager
def logged_to(path: Path, verbose: bool = False) -> Iterator[LogFile]:
    """Keep messages of all loggers, and Python's warnings, in a file while the body runs.

    Warnings and errors are held back and written in the end, so that a run that is interrupted
    leaves the folder as it was; there is no file where there was nothing to say. With `verbose`
    there is more, at once, with the traceback of an error.

    Parameters
    ----------
    path
        The file; it is appended to.
    verbose
        Also keep what is merely of interest.
    """
    file = LogFile(path)
    handler: logging.Handler = file
    if not verbose:
        handler = MemoryHandler(_HELD, flushLevel=logging.CRITICAL + 1, target=file)
    handler.setLevel(logging.INFO if verbose else logging.WARNING)
    interrupted = False
    try:
        with _handling_all(handler, logging.INFO if verbose else logging.WARNING):
            try:
                yield file
            except Exception:
                logging.getLogger(__name__).info("the run has ended with an error", exc_info=True)
                raise
    except KeyboardInterrupt:
        interrupted = True
        raise
    finally:
        if isinstance(handler, MemoryHandler) and interrupted:
            handler.buffer.clear()
        handler.close()  # which writes what was held back


def log_to(path: Path) -> None:
    """Keep messages of all loggers in a file, from now on; for the workers of a cluster."""
    handler = LogFile(path)
    handler.setLevel(logging.INFO)
    for logger in _with_handlers():
        logger.handlers[:] = [] if logger.propagate else [handler]
    logging.root.handlers[:] = [handler]
    logging.captureWarnings(True)


@contextmanager
def _handling_all(handler: logging.Handler, level: int) -> Iterator[None]:
    """Let one handler have all messages, whatever other handlers and levels there are."""
    root, disabled = logging.root, logging.root.manager.disable
    before = {logger: list(logger.handlers) for logger in (*_with_handlers(), root)}
    root_level = root.level
    try:
        for logger in before:
            logger.handlers[:] = [] if logger.propagate and logger is not root else [handler]
        root.setLevel(level)
        logging.captureWarnings(True)
        logging.disable(logging.NOTSET)
        yield
    finally:
        logging.disable(disabled)
        logging.captureWarnings(False)
        root.setLevel(root_level)
        for logger, handlers in before.items():
            logger.handlers[:] = handlers


def _with_handlers() -> list[logging.Logger]:
    """Loggers, but for the root, that have handlers of their own."""
    known = list(logging.root.manager.loggerDict.values())
    return [logger for logger in known if isinstance(logger, logging.Logger) and logger.handlers]

"""Saying which scans an error is about."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def naming_scans(first: int, last: int | None = None) -> Iterator[None]:
    """Put the scans that were being worked on before the message of whatever is raised.

    Raises
    ------
    RuntimeError
        In place of any error of the body; it travels through Dask whatever the error was.
    """
    try:
        yield
    except Exception as error:
        span = f"scan {first}" if last in (None, first) else f"scans {first} to {last}"
        raise RuntimeError(f"{span}: {type(error).__name__}: {error}") from error

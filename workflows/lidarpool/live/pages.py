"""The live page, if it is wanted: only then are its modules imported, with Matplotlib."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext

from ..run.page import Page


def page_of(
    wanted: bool, jobs: int = 1, names: Sequence[str] = (), title: str = "lidarpool"
) -> AbstractContextManager[Page]:
    """Show so many jobs in the browser, in which values of these names vary; or nothing."""
    if not wanted:
        return nullcontext(Page())
    from .live_page import live_page

    return live_page(jobs, names, title)

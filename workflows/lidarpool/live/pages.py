"""The live page, if it is wanted: only then are its modules imported, with Matplotlib."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext

from ..run.jobs import Jobs
from ..run.page import Page


def page_of(jobs: Jobs, wanted: bool) -> AbstractContextManager[Page]:
    """Show jobs in the browser, or nothing."""
    if not wanted:
        return nullcontext(Page())
    from .live_page import live_page

    return live_page(jobs.count, jobs.names, jobs.title or "lidarpool")

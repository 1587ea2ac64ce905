"""Runs and results in the browser, only on this machine and without the internet."""

from contextlib import AbstractContextManager, nullcontext

from ..run.job_source import Jobs
from ..run.run_page import RunPage


def page_of(jobs: Jobs, enabled: bool) -> AbstractContextManager[RunPage]:
    """Show jobs in the browser if enabled; Matplotlib is imported only then."""
    if not enabled:
        return nullcontext(RunPage())
    from .live_page import live_page

    return live_page(len(jobs.numbers), jobs.names, jobs.title or "lidarpool")

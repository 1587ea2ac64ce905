"""Runs and results in the browser and in viewers, only on this machine, without the internet."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # a result is viewed without the modules of runs, which take seconds to import
    from ..run.job_source import Jobs
    from ..run.options import Live
    from ..run.run_page import RunPage


def page_of(jobs: Jobs, live: Live) -> AbstractContextManager[RunPage]:
    """Show jobs in the browser, or a viewer, and import only then what either needs.

    LidarError if the package of a viewer is missing.
    """
    if not live:
        from ..run.run_page import RunPage

        return nullcontext(RunPage())
    title = jobs.title or "lidarpool"
    if isinstance(live, str) and live != "page":
        from .viewer_page import viewer_page

        return viewer_page(live, title)
    from .live_page import live_page

    return live_page(len(jobs.numbers), jobs.names, title)

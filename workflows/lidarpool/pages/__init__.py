"""Pages that show runs and results in the browser or in viewers, without internet access."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # Importing the modules of runs takes seconds, and results do not need them.
    from ..run.job_source import Jobs
    from ..run.options import Live
    from ..run.run_page import RunPage


def page_of(jobs: Jobs, live: Live) -> AbstractContextManager[RunPage]:
    """Open the live page of a run, or show the run in a viewer.

    Only the modules that the page or viewer needs are imported.

    Raises
    ------
    LidarError
        If the package of a viewer is not installed.
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

"""Live pages, if they are wanted: only then are their modules imported, with Matplotlib."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext

from ..run.campaign import CampaignPage
from ..run.conductor import Page
from ..run.job import Job
from ..scenario.campaign import Campaign


def page_of_run(job: Job, wanted: bool) -> AbstractContextManager[Page]:
    """Show a run in the browser, or nothing."""
    if not wanted:
        return nullcontext(Page())
    from .run_page import live_run

    return live_run(job)


def page_of_campaign(campaign: Campaign, wanted: bool) -> AbstractContextManager[CampaignPage]:
    """Show a campaign in the browser, or nothing."""
    if not wanted:
        return nullcontext(CampaignPage())
    from .campaign_page import live_campaign

    return live_campaign(campaign)

"""Writes the page of a data set."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from markupsafe import Markup

from ...base.words import counted
from ...export.jobs import Value
from ..campaign_figures import CampaignInfo, Figures
from .page import Bar, bars_of, environment, of_tasks
from .words import bound, duration, large

FAILED_SHOWN, FAILED_FEW = 100, 8  # all of them, and those that are open at first
VALUES_SHOWN = 12  # of a quantity with labels


def campaign_page(
    info: CampaignInfo,
    figures: Figures,
    report: Mapping[str, Any],
    pictures: Sequence[tuple[str, str]],
) -> str:
    """Return the page as HTML that needs no other files and no network.

    `pictures` are elements of HTML with captions.
    """
    pages = environment()
    pages.filters["told"] = told
    bars, rest = class_bars(info, figures)
    splits = figures.splits if any(figures.splits) else {}
    return pages.get_template("campaign.html").render(
        report=report,
        info=info,
        title=info.title,
        summary=summary(info, figures),
        facts=list(_facts(info, figures)),
        pictures=[(Markup(image), caption) for image, caption in pictures],
        missing=max(0, info.count - figures.jobs),
        failed=figures.failed[:FAILED_SHOWN],
        few=FAILED_FEW,
        slowest=figures.slowest,
        bars=bars,
        rest=rest,
        splits={name or "none": counts for name, counts in splits.items()},
        sensors=[(name or "model", words) for name, words in info.sensors.items()],
        command=info.file,
        most=VALUES_SHOWN,
        **of_tasks(info.stages, info.records),
    )


def summary(info: CampaignInfo, figures: Figures) -> str:
    """Return a sentence on the data set."""
    totals = figures.totals
    text = (
        f"{counted(figures.done, 'simulated survey')} of one description, with "
        f"{counted(totals['sweeps'], 'sweep')} and {counted(totals['points'], 'point')}"
    )
    if figures.varied:
        text += f"; {counted(len(figures.varied), 'quantity', 'quantities')} "
        text += f"{'differs' if len(figures.varied) == 1 else 'differ'} between them"
    if failed := figures.jobs - figures.done:
        text += f". {counted(failed, 'job')} failed"
    return f"{text}."


def _facts(info: CampaignInfo, figures: Figures) -> Iterator[tuple[str, str]]:
    """Return the numbers for the head of the page, and what each is."""
    yield large(figures.totals["points"]), "points"
    yield f"{figures.done:,}", f"of {counted(info.count, 'job')} done"
    yield large(figures.totals["sweeps"]), "sweeps"
    if spread := figures.spread("points"):
        yield large(spread["median"]), "points of a job, the median"
    yield large(figures.totals["rays"]), "rays cast"
    if info.seconds:
        yield duration(info.seconds), "for the run"


def class_bars(info: CampaignInfo, figures: Figures) -> tuple[list[Bar], str]:
    """Bars of the classes with the most points, and a sentence about the others."""
    named = [(class_name(info, k), n) for k, n in figures.classes.most_common()]
    return bars_of([(name, name, n) for name, n in named], "more class", "more classes")


def class_name(info: CampaignInfo, number: int) -> str:
    """Name and number of a class."""
    name = info.classes.get(number, "" if number else "none")
    return f"{number} {name}".rstrip()


def told(value: Value) -> str:
    """Write a varied value for readers."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    return value if isinstance(value, str) else bound(value)

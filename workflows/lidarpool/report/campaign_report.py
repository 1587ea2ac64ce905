"""Write the dataset card (README.md), HTML report and report.json of a data set."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack
from typing import Any

import numpy as np

from lidarfiles.clouds.folder import LAST_FILE
from lidarfiles.clouds.format_table import data_set_title
from lidarfiles.datasets.figures import DataSetStatistics
from lidarfiles.datasets.job_seconds import writing_seconds
from lidarfiles.datasets.job_table import JobRow
from lidarsim.errors import LidarError, explain_os_errors
from lidarsim.io.storage import Storage
from lidarview.page_templates import render_template
from lidarview.render.picture_page import Page

from ..run.run_result import CampaignRun
from .charts import draw_results, draw_times, draw_varied
from .page import rendering
from .report import stage_statistics

CARD = "README.md"
PAGE = "report.html"
PICTURES = "pictures"
SPLITS = "splits"
VALUES_SHOWN = 12  # maximum number of labels shown per quantity
_CAPTIONS = {
    "job": "A sweep from one of the jobs.",
    "varied": (
        "Varied quantities: the number of jobs by value, and the number of points per job as a "
        "function of the value."
    ),
    "results": "Results: histograms of jobs by number of points and by share of rays that hit.",
}
# Casting times appear only on the page, because the card and the picture files must be identical in
# every run.
_PAGE_CAPTIONS = {
    **_CAPTIONS,
    "times": "Histogram of jobs by casting time, summed over all tasks of a job.",
}


def write_card(
    storage: Storage,
    campaign: Mapping[str, Any],
    run: CampaignRun,
    jobs: Iterable[JobRow],
    versions: Mapping[str, str],
    picture: Page | None = None,
) -> dict[str, Any]:
    """Write a data set's dataset card, reports, plots and split files.

    report.json is written last. Only report.html, report.csv and report.json contain casting times,
    so the other files are the same in every run. The job rows are iterated once, and only a few
    numbers per job are held in memory.

    Parameters
    ----------
    storage
        Folder of the data set, which must exist.
    campaign, run
        The campaign in the form of `CampaignSpec.card_content`, and the totals of its run.
    jobs
        Job rows in order, for example from `lidarfiles.datasets.job_table.read_table`.
    versions
        {name: version} of the software that determines the bytes of the points.
    picture
        Picture of one job, shown in README.md.

    Returns
    -------
    The content of report.json.

    Raises
    ------
    LidarError
        If a file cannot be written, or if the name of a split is not a valid file name.
    """
    with explain_os_errors(
        f"The card of the data set cannot be written to {storage}", "free some disk space"
    ):
        storage.remove([LAST_FILE])
        rows = writing_seconds(storage, _with_splits(storage, jobs))
        figures = DataSetStatistics(campaign["names"], rows)
        pages = {"job": picture, "varied": draw_varied(figures), "results": draw_results(figures)}
        drawn = {name: page for name, page in pages.items() if page is not None}
        for name, drawing in drawn.items():
            with storage.writing(f"{PICTURES}/{name}.png") as file:
                file.write(drawing.png())
        storage.remove([f"{PICTURES}/{name}.png" for name in pages if name not in drawn])
        report = campaign_report(campaign, run, versions, figures)
        values: dict[str, Any] = {
            "report": report,
            "command": campaign["command"],
            "VALUES_SHOWN": VALUES_SHOWN,
            "format_title": data_set_title(report["format"]),
        }
        on_page = {name: pages[name] for name in ("varied", "results")}
        on_page["times"] = draw_times(figures)
        page = render_template(
            "campaign.html",
            rendering.__name__,
            captions=_PAGE_CAPTIONS,  # also read by screen readers
            pictures={name: drawing.svg() for name, drawing in on_page.items() if drawing},
            slowest=figures.slowest,
            description=campaign["description"],
            **values,
            timeline=rendering.make_timeline(run.stages),
        )
        storage.write(PAGE, page.encode())
        card = render_template(
            "card.md", rendering.__name__, captions=_CAPTIONS, drawn=[*drawn], **values
        )
        storage.write(CARD, card.encode("utf-8", "backslashreplace"))
        text = json.dumps(report, indent=1, allow_nan=False) + "\n"
        storage.write(LAST_FILE, text.encode())
    return report


def _with_splits(storage: Storage, jobs: Iterable[JobRow]) -> Iterator[JobRow]:
    """Yield the rows unchanged, and list the names of finished jobs in the file of their split.

    Raise LidarError if the name of a split is not a valid file name.
    """
    with ExitStack() as stack:
        files: dict[str, Any] = {}
        for row in jobs:
            if row.split and row.done:
                if row.split not in files:
                    if not re.fullmatch(r"\w[\w.-]*", row.split):
                        raise LidarError(
                            f"{row.split!r} is not a valid split name. Use only letters, digits, "
                            "underscores, hyphens and periods."
                        )
                    name = f"{SPLITS}/{row.split}.txt"
                    files[row.split] = stack.enter_context(storage.writing(name))
                files[row.split].write(f"{row.name}\n".encode())
            yield row


def campaign_report(
    campaign: Mapping[str, Any],
    run: CampaignRun,
    versions: Mapping[str, str],
    figures: DataSetStatistics,
) -> dict[str, Any]:
    """Return the statistics of a data set as they are stored in report.json."""
    return {
        "title": campaign["title"],
        "format": campaign["keep"]["format"],
        "license": campaign["license"],
        "seed": campaign["seed"],
        "versions": dict(versions),
        "sensors": dict(run.sensors),
        "notes": list(run.notes),
        "jobs": {
            "described": campaign["count"],
            "done": figures.done,
            "failed": figures.jobs - figures.done,
            "resumed": run.resumed,
        },
        "replayed": run.replayed,
        "totals": figures.totals,
        "seconds": {
            "run": round(run.seconds, 3),
            "casting": round(float(np.nansum(figures.per_job("seconds"))), 3),
        },
        "of_a_job": {
            name: figures.percentiles(name) for name in ("points", "rays", "hits", "seconds")
        },
        "splits": {
            name: {key: counts[key] for key in ("jobs", "sweeps", "points")}
            for name, counts in figures.splits.items()
        },
        "classes": {str(number): {**counts} for number, counts in sorted(figures.classes.items())},
        **({"class_names": dict(run.classes)} if run.classes else {}),
        "varied": list(figures.summaries()),
        "failed": [_job_entry(row, "error") for row in figures.failed],
        "slowest": [_job_entry(row, "seconds") for row in figures.slowest],
        "stages": stage_statistics(run.stages),
        "sha256": figures.sha256,
    }


def _job_entry(row: JobRow, field: str) -> dict[str, Any]:
    """Return a JSON object with a job's number, name, values and one field of its row."""
    values = {
        name: str(value) if isinstance(value, float) and not math.isfinite(value) else value
        for name, value in row.values.items()
    }
    return {"number": row.number, "name": row.name, "values": values, field: getattr(row, field)}

"""The card of a data set, README.md, its page and its figures."""

from __future__ import annotations

import json
import re
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from ..base.errors import LidarpoolError, explained
from ..base.storage import Storage
from ..export.folder import LAST_FILE
from ..export.jobs import PARQUET_FILE, TABLE_FILE, JobRow
from ..render.page import Page
from .campaign_figures import CampaignInfo, Figures
from .campaign_pictures import draw_results, draw_varied
from .page.campaign_page import VALUES_SHOWN, campaign_page, class_name, summary
from .page.words import bound, share
from .report import stage_figures

CARD, PAGE, PICTURES, SPLITS = "README.md", "report.html", "pictures", "splits"

_CAPTIONS = {
    "job": "One of the jobs.",
    "varied": "What was varied: jobs by value, and the points of each job against it.",
    "results": "What came of it: jobs by points, share of rays that hit, and time of casting.",
}
# {format: what there is for programs other than lidarpool}
_FORMATS = {
    "kitti": "`sequences/` is laid out as SemanticKITTI: a sequence for each job.",
    "nuscenes": "The tables of nuScenes hold a scene for each job.",
    "mcap": "`bags/` has a recording of ROS 2 for each job.",
    "parquet": "`points/` is one table, partitioned by job: "
    '`pyarrow.dataset.dataset("points", partitioning="hive")`.',
    "images": "`images/` has range images of each job as NumPy archives, also of rays without a "
    "return.",
    "folder": "`jobs/` has a cloud in PLY for each job, which `lidarpool.read_cloud` reads.",
}


def write_card(place: Storage, info: CampaignInfo, jobs: Iterable[JobRow]) -> dict[str, Any]:
    """Write README.md, report.html, pictures and splits of a data set, and report.json last.

    The rows of the table are read once; a few numbers of each job are held in memory.

    Parameters
    ----------
    place
        Folder of the data set, which must exist.
    info
        What the table does not say.
    jobs
        Rows in order, such as `lidarpool.export.jobs.read_table` gives.

    Returns
    -------
    The content of report.json.

    Raises
    ------
    LidarpoolError
        If a file cannot be written, or a split cannot be the name of a file.
    """
    with explained(f"The data set's card cannot be written to {place}", "make room"):
        place.remove([LAST_FILE])
        figures = Figures(info.names, _with_splits(place, jobs))
        drawn = _write_pictures(place, info, figures)
        report = campaign_report(info, figures)
        page = campaign_page(
            info, figures, report, [(drawn[name], _CAPTIONS[name]) for name in drawn if drawn[name]]
        )
        place.write(PAGE, page.encode())
        card = "\n".join(_card(info, figures, report, list(drawn)))
        place.write(CARD, card.encode("utf-8", "backslashreplace"))
        text = json.dumps(report, indent=1, allow_nan=False) + "\n"
        place.write(LAST_FILE, text.encode())
    return report


def _with_splits(place: Storage, jobs: Iterable[JobRow]) -> Iterator[JobRow]:
    """Yield rows, and write the names of done jobs into the files of their splits."""
    with ExitStack() as stack:
        files: dict[str, Any] = {}
        for row in jobs:
            if row.split and row.done:
                if row.split not in files:
                    if not re.fullmatch(r"\w[\w.-]*", row.split):
                        raise LidarpoolError(
                            f"A split cannot be called {row.split!r}: use letters and digits."
                        )
                    name = f"{SPLITS}/{row.split}.txt"
                    files[row.split] = stack.enter_context(place.writing(name))
                files[row.split].write(f"{row.name}\n".encode())
            yield row


def _write_pictures(place: Storage, info: CampaignInfo, figures: Figures) -> dict[str, str]:
    """Write pictures; return {name: element of HTML}, empty for the one that is not on the page."""
    pages: dict[str, Page | None] = {
        "varied": draw_varied(figures),
        "results": draw_results(figures),
    }
    drawn = {}
    with tempfile.TemporaryDirectory(prefix="lidarpool-") as folder:
        if info.picture is not None:
            _put(place, "job", info.picture)
            drawn["job"] = ""  # each job's own report has it
        for name, page in pages.items():
            if page is not None:
                path = Path(folder, f"{name}.png")
                page.save(path)
                _put(place, name, path)
                drawn[name] = page.svg()
    place.remove([f"{PICTURES}/{name}.png" for name in _CAPTIONS if name not in drawn])
    return drawn


def _put(place: Storage, name: str, path: Path) -> None:
    with place.writing(f"{PICTURES}/{name}.png") as file:
        file.write(path.read_bytes())


def campaign_report(info: CampaignInfo, figures: Figures) -> dict[str, Any]:
    """Return the figures of a data set, as in report.json."""
    return {
        "title": info.title,
        "format": info.format,
        "license": info.license,
        "seed": info.seed,
        "versions": dict(info.versions),
        "sensors": dict(info.sensors),
        "notes": list(info.notes),
        "jobs": {
            "described": info.count,
            "done": figures.done,
            "failed": figures.jobs - figures.done,
            "resumed": info.resumed,
        },
        "totals": dict(figures.totals),
        "seconds": {"run": round(info.seconds, 3), "casting": round(figures.seconds, 3)},
        "of_a_job": {name: figures.spread(name) for name in ("points", "rays", "hits", "seconds")},
        "splits": {
            name: {key: counts[key] for key in ("jobs", "sweeps", "points")}
            for name, counts in figures.splits.items()
        },
        "classes": {
            str(number): {
                "name": info.classes.get(number, ""),
                "points": points,
                "jobs": figures.classed[number],
            }
            for number, points in sorted(figures.classes.items())
        },
        "varied": list(figures.described()),
        "failed": [_told(row, "error") for row in figures.failed],
        "slowest": [_told(row, "seconds") for row in figures.slowest],
        "stages": stage_figures(info.stages),
        "sha256": figures.sha256,
    }


def _told(row: JobRow, what: str) -> dict[str, Any]:
    values = {name: value if _finite(value) else str(value) for name, value in row.values.items()}
    return {"number": row.number, "name": row.name, "values": values, what: getattr(row, what)}


def _finite(value: Any) -> bool:
    return not isinstance(value, float) or abs(value) < float("inf")


def _card(
    info: CampaignInfo, figures: Figures, report: Mapping[str, Any], pictures: Sequence[str]
) -> Iterator[str]:
    """Yield the lines of README.md."""
    yield f"# {_md(info.title)}"
    yield ""
    yield _md(summary(info, figures)) + " Made by lidarpool."
    for name in pictures:
        yield from ("", f"![{_CAPTIONS[name]}]({PICTURES}/{name}.png)")
    yield from ("", "## Figures", "")
    yield from _table(("", "total", "of a job: median", "10% to 90%"), _figure_rows(figures))
    if any(figures.splits):
        rows = (
            (_md(name or "none"), *(f"{counts[key]:,}" for key in ("jobs", "sweeps", "points")))
            for name, counts in figures.splits.items()
        )
        yield ""
        yield from _table(("split", "jobs", "sweeps", "points"), rows)
        yield from ("", f"The names of a split's jobs are in `{SPLITS}/`.")
    if info.sensors:
        yield from ("", "## Sensors", "")
        rows = ((_md(name) or "–", _md(words)) for name, words in info.sensors.items())
        yield from _table(("sensor", "model"), rows)
    if report["varied"]:
        yield from ("", "## What was varied", "")
        rows = ((_code(one["name"]), _limits(one)) for one in report["varied"])
        yield from _table(("quantity", "values"), rows)
    if figures.classes:
        total = sum(figures.classes.values())
        rows = (
            (_md(class_name(info, k)), f"{n:,}", share(n, total), f"{figures.classed[k]:,}")
            for k, n in sorted(figures.classes.items())
        )
        yield from ("", "## Classes", "")
        yield from _table(("class", "points", "share", "in jobs"), rows)
    yield from _reading(info, figures)
    yield from ("", "## Licence", "", _md(info.license) or "None was given.", "")


def _figure_rows(figures: Figures) -> Iterator[tuple[str, ...]]:
    failed = figures.jobs - figures.done
    yield "jobs", f"{figures.done:,}" + (f" ({failed:,} failed)" if failed else ""), "", ""
    for name in ("scans", "sweeps"):
        yield name, f"{figures.totals[name]:,}", "", ""
    for name in ("rays", "hits", "points"):
        each = ("", "")
        if of := figures.spread(name):
            each = (f"{of['median']:,.0f}", f"{of['tenth']:,.0f} to {of['ninetieth']:,.0f}")
        yield name, f"{figures.totals[name]:,}", *each


def _limits(one: Mapping[str, Any]) -> str:
    """Values of a quantity in words."""
    if "values" in one:
        values = [*one["values"]]
        more = len(values) - VALUES_SHOWN
        text = ", ".join(_md(value) for value in values[:VALUES_SHOWN])
        return f"{text} and {more:,} more" if more > 0 else text
    if "median" not in one:
        return ""
    return f"{bound(one['lowest'])} to {bound(one['highest'])}, median {bound(one['median'])}"


def _reading(info: CampaignInfo, figures: Figures) -> Iterator[str]:
    """How to read the data set, and how to make a job of it again."""
    split = next((f', split="{name}"' for name in figures.splits if name), "")
    yield from (
        "",
        "## Reading",
        "",
        "```python",
        "import lidarpool",
        "",
        f'for sweep in lidarpool.sweeps("."{split}):',
        "    sweep.points  # float32 (n, 3), metres, in the sensor's axes",
        "    sweep.classes  # (n,)",
        "    sweep.boxes  # of moving objects",
        "    sweep.values  # what was varied",
        "```",
        "",
        f"`{TABLE_FILE}`, and `{PARQUET_FILE}` if there is one, has a row for each job: what was "
        "varied, figures, points of each class, SHA-256 of the points. "
        + _FORMATS.get(info.format, ""),
        "",
        "## Making a job again",
        "",
    )
    if info.file:
        yield from ("```sh", f"lidarpool run {info.file} --job 0 --out job-0", "```", "")
    else:
        yield from (
            "The campaign is a program of Python, which makes each job from its number.",
            "",
        )
    yield from (
        f"Job 0 has the same points again, with the SHA-256 in `{TABLE_FILE}`, on any cluster "
        f"with this software. The seed is {info.seed}; the SHA-256 of all jobs together is "
        f"`{figures.sha256}`.",
        "",
    )
    rows = ((_md(name), _md(version)) for name, version in info.versions.items())
    yield from _table(("software", "version"), rows)


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> Iterator[str]:
    yield f"| {' | '.join(head)} |"
    yield f"|{'---|' * len(head)}"
    for row in rows:
        yield f"| {' | '.join(row)} |"


def _md(text: str) -> str:
    """Text of a user as one line of Markdown that shows it as it is."""
    line = " ".join("".join(c if c.isprintable() else " " for c in text).split())
    return re.sub(r"([\\`*{}\[\]<>|#&~]|(?<!\w)_|_(?!\w))", r"\\\1", line)


def _code(text: str) -> str:
    """Name as code of Markdown; with letters that end code or a cell, as text."""
    return _md(text) if re.search(r"[`|\\]", text) or not text.isprintable() else f"`{text}`"

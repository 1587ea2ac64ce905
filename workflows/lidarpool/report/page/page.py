"""Writes the page: puts what is to be told into the template."""

from __future__ import annotations

import base64
import math
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from poolpart.wording import counted

from ...plan import Planning
from ...run.result import Result
from ...run.trials import TRIAL
from ...scan import COLLECT, GENERATE, INTERSECT, SORT
from ..cloud_numbers import CloudNumbers
from . import words
from .charts import convergence, object_bars, range_histogram, ring_histogram
from .recipe import Recipe
from .sentences import facts, pictures, summary
from .timeline import make_timeline

# {stage: what it is called on the page}, in the order of the pipeline
STAGES = {
    GENERATE: "generate",
    INTERSECT: "intersect",
    SORT: "sort frames",
    COLLECT: "collect points",
    TRIAL: "plan path",
}


@dataclass(frozen=True)
class Picture:
    """A picture within the page."""

    name: str
    alt: str
    caption: str
    uri: str


def write_page(
    path: Path,
    report: Mapping[str, Any],
    result: Result,
    numbers: CloudNumbers,
    planning: Planning | None,
    recipe: Recipe | None = None,
) -> None:
    """Write a report as one HTML file that needs nothing else, and asks nobody for anything.

    Parameters
    ----------
    path
        Where to; pictures and cloud of the result are in the same folder.
    report
        What `make_report` says: all numbers of the page that it has are taken from it.
    result, numbers, planning
        What it is about, and counts of its cloud.
    recipe
        How to have it once more, if that is known.

    Raises
    ------
    OSError
        If it cannot be written.
    """
    ordered = sorted(result.stages, key=lambda stage: list(STAGES).index(stage.stage))
    page = (
        _environment()
        .get_template("page.html")
        .stream(
            report=report,
            title="Lidar survey" + (f": {recipe.name}" if recipe else ""),
            begun=_day(min((stage.start for stage in ordered), default=math.inf)),
            summary=summary(report),
            facts=facts(report),
            pictures=[
                _picture(path.parent / name, *said) for name, said in pictures(report).items()
            ],
            stages=ordered,
            names=STAGES,
            timeline=make_timeline(ordered, result.records, STAGES),
            objects=object_bars(report["points_by_object"]),
            cloud=numbers,
            ranges=range_histogram(numbers.by_range, numbers.edges) if len(numbers.edges) else None,
            rings=ring_histogram(numbers.by_channel) if len(result.points) else None,
            curves=convergence(result.trials, result.plan) if planning and result.plan else None,
            files=[(name, _size(path.parent / name, path)) for name in report["files"]],
            recipe=recipe,
            recipe_uri=_data_uri("text/yaml", recipe.scenario.encode(errors="backslashreplace"))
            if recipe
            else "",
        )
    )
    page.dump(str(path), encoding="utf-8")


def _environment() -> Environment:
    """Jinja as it is used here: all values are escaped, and one that is missing is an error."""
    environment = Environment(
        loader=PackageLoader(__package__ or ""),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        finalize=_presentable,
    )
    for filter_ in (
        words.duration, words.rate, words.large, words.share, words.excess, words.metres,
        words.numbers, words.shortened, counted,
    ):  # fmt: skip
        environment.filters[filter_.__name__] = filter_
    return environment


def _presentable(value: object) -> object:
    """Replace what HTML cannot hold, in every value that goes into the page."""
    if isinstance(value, str) and not isinstance(value, Markup):
        return words.printable(value)
    return value


def _day(seconds: float) -> str:
    if not math.isfinite(seconds):
        return ""
    return datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%d %H:%M UTC")


def _picture(path: Path, alt: str, caption: str) -> Picture:
    return Picture(path.name, alt, caption, _data_uri("image/png", path.read_bytes()))


def _data_uri(kind: str, data: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"


def _size(file: Path, page: Path) -> str:
    """Size of a file, if it is there already: the report comes last."""
    if file == page:
        return "this page"
    return words.size(file.stat().st_size) if file.exists() else ""

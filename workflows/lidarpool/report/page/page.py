"""Fills the templates of pages, and writes the page of a result."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from ...base.declared import declared
from ...base.words import counted
from ...pipeline.task_book import StageTotals
from ...render.page import shortened, without_common_prefix
from ...run.result import RunResult
from ...scenario.scenario import Scenario
from ...sensor import Noise, Returns
from ...sensor.weather import Weather
from ..cloud_numbers import CountedCloud
from . import words
from .timeline import make_timeline

SCENARIO_MOST = 50_000  # letters of the scenario; a survey may have a million poses


def write_page(
    path: Path,
    report: Mapping[str, Any],
    result: RunResult,
    cloud: CountedCloud,
    pictures: Mapping[str, str],
    scenario: Scenario | None = None,
) -> None:
    """Write a report as one HTML file that needs no other files and no network.

    Most numbers are those of `report`, from `make_report`; `pictures` are SVG elements by name.

    Raises
    ------
    OSError
        If it cannot be written.
    """
    text = rendered(
        "page.html",
        report=report,
        cloud=cloud,
        pictures=pictures,
        changed=_changed,
        kinds={"returns": Returns, "noise": Noise, "weather": Weather},
        scenario=_written(scenario) if scenario else "",
        stages=result.stages,
    )
    path.write_text(text, encoding="utf-8")


def rendered(
    template: str,
    *,
    pictures: Mapping[str, str] | None = None,
    stages: Sequence[StageTotals] = (),
    **values: Any,
) -> str:
    """Fill a template for HTML, Markdown or a terminal.

    `pictures` are elements of HTML, and `stages` are for a timeline. All other values are escaped
    as the format needs; a missing one is an error.
    """
    escaped = words.markdown if template.endswith(".md") else words.printable
    environment = Environment(
        loader=PackageLoader(__package__ or ""),
        autoescape=template.endswith(".html"),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        finalize=lambda value: escaped(value) if type(value) is str else value,  # not of Markup
    )
    for filter_ in (
        words.duration, words.rate, words.large, words.share, words.excess,
        words.numbers, words.grouped, words.told, words.code, words.markdown, words.millimetres,
        words.ratio, counted,
    ):  # fmt: skip
        environment.filters[filter_.__name__] = filter_
    environment.filters["shortened"] = lambda name, most=60: shortened(name, most)
    environment.filters["one_line"] = lambda text: type(text)(re.sub("[ \n]+", " ", text).strip())
    environment.filters["labels"] = lambda names: dict(
        zip(names, without_common_prefix([*names]), strict=True)
    )
    return environment.get_template(template).render(
        pictures={name: Markup(image) for name, image in (pictures or {}).items()},
        timeline=make_timeline(stages),
        **values,
    )


def _written(scenario: Scenario) -> str:
    """Return a scenario as YAML that can be loaded, unless it is so long that it is cut."""
    data = scenario.model_dump(mode="json", exclude_defaults=True, by_alias=True)
    text = yaml.safe_dump(
        data, sort_keys=False, allow_unicode=True, default_flow_style=None, width=96
    )
    text = text if len(text) <= SCENARIO_MOST else f"{text[:SCENARIO_MOST]}…"
    return text if data else ""


def _changed(values: Mapping[str, Any], kind: type) -> list[tuple[str, str]]:
    """Name and value of each field of a dataclass that differs from its default."""
    usual = declared(kind(), kind)
    return [(name, words.told(values[name])) for name in usual if values[name] != usual[name]]

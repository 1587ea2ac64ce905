"""Writes the page: fills the template."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from poolpart import TaskRecord

from ...base.declared import declared
from ...base.words import counted
from ...pipeline import COLLECT, EXPORT, GENERATE, INTERSECT, SORT
from ...pipeline.task_book import StageTotals
from ...render.page import shortened, without_common_prefix
from ...run.result import RunResult
from ...run.trials import TRIAL
from ...scenario.scenario import Scenario
from ...sensor import Noise, Returns
from ...sensor.weather import Weather
from ..cloud_numbers import CountedCloud
from . import words
from .timeline import make_timeline
from .words import duration, excess, large, metres, share

Report = Mapping[str, Any]
SENSORS_NAMED = 3  # in the title
OBJECTS_MOST = 25  # objects that have a bar
SCENARIO_MOST = 50_000  # letters of the scenario; a survey may have a million poses

# {stage: its name on the page}, in the order of the pipeline
STAGES = {
    GENERATE: "generate",
    INTERSECT: "intersect",
    SORT: "sort frames",
    COLLECT: "collect points",
    EXPORT: "export cloud",
    TRIAL: "plan path",
}


class Bar(NamedTuple):
    """A row of a bar chart: full and short name, number, share, length in per cent."""

    name: str
    label: str
    points: int
    share: str
    percent: float


def write_page(
    path: Path,
    report: Report,
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
    bars, rest = _object_bars(report["points_by_object"])
    page = environment().get_template("page.html")
    text = page.render(
        report=report,
        title=_title(report["parameters"]),
        summary=_summary(report),
        facts=list(_facts(report, cloud)),
        pictures=list(_pictures(report, pictures)),
        changed=_changed,
        kinds={"returns": Returns, "noise": Noise, "weather": Weather},
        **of_tasks(result.stages, result.records),
        bars=bars,
        rest=rest,
        bounds=cloud.bounds.tolist(),
        scenario=_written(scenario) if scenario else "",
    )
    path.write_text(text, encoding="utf-8")


def of_tasks(stages: Sequence[StageTotals], records: Sequence[TaskRecord]) -> dict[str, Any]:
    """Return what templates show of the tasks of a run: when it began, stages, timeline."""
    ordered = sorted(stages, key=lambda stage: list(STAGES).index(stage.stage))
    begun = ""
    if ordered:
        first = datetime.fromtimestamp(min(stage.start for stage in ordered), UTC)
        begun = f"{first:%Y-%m-%d %H:%M UTC}"
    timeline = make_timeline(ordered, records, STAGES)
    return {"begun": begun, "stages": ordered, "names": STAGES, "timeline": timeline}


def _written(scenario: Scenario) -> str:
    """Return a scenario as YAML that can be loaded, unless it is so long that it is cut."""
    data = scenario.model_dump(mode="json", exclude_defaults=True, by_alias=True)
    text = yaml.safe_dump(
        data, sort_keys=False, allow_unicode=True, default_flow_style=None, width=96
    )
    text = text if len(text) <= SCENARIO_MOST else f"{text[:SCENARIO_MOST]}…"
    return text if data else ""


def _object_bars(counts: Mapping[str, int]) -> tuple[list[Bar], str]:
    """Bars of the objects with the most points, and a sentence about the others."""
    labels = dict(zip(counts, without_common_prefix(list(counts)), strict=True))
    ranked = sorted(counts.items(), key=lambda item: -item[1])
    bars, rest = bars_of([(name, labels[name], n) for name, n in ranked if n], "more object")
    if missed := sum(not n for n in counts.values()):
        rest += "; " if rest else ""
        rest += f"{counted(missed, 'object')} without points"
    return bars, rest


def bars_of(
    ranked: Sequence[tuple[str, str, int]], more: str, several: str = ""
) -> tuple[list[Bar], str]:
    """Bars of the first of (name, label, points), and a sentence about `more` of them."""
    total = sum(points for *_, points in ranked)
    bars = [
        Bar(name, label, points, share(points, total), 100 * points / ranked[0][2])
        for name, label, points in ranked[:OBJECTS_MOST]
    ]
    if not (others := [points for *_, points in ranked[OBJECTS_MOST:]]):
        return bars, ""
    told = f"{counted(len(others), more, several)} with {counted(sum(others), 'point')}"
    return bars, f"{told} ({share(sum(others), total)})"


def environment() -> Environment:
    """Jinja's environment: all values are escaped, and a missing value is an error."""
    environment = Environment(
        loader=PackageLoader(__package__ or ""),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        # In every value on the page: characters that HTML cannot hold.
        finalize=lambda value: (
            words.printable(value) if type(value) is str else value  # not of Markup
        ),
    )
    for filter_ in (
        words.duration, words.rate, words.large, words.share, words.excess, words.metres,
        words.numbers, words.grouped, words.bound, counted,
    ):  # fmt: skip
        environment.filters[filter_.__name__] = filter_
    environment.filters["shortened"] = partial(shortened, most=60)
    return environment


def _summary(report: Report) -> str:
    """Return a sentence on the run and its result."""
    parameters, planning = report["parameters"], report["planning"]
    where = f"from {counted(parameters['poses'], 'position')}"
    if seconds := parameters["trajectory_s"]:
        where = f"along a trajectory of {seconds:,.3g} s"
    text = (
        f"{counted(report['scans'], 'scan')} {where} sent "
        f"{counted(report['rays'], 'ray')} at {counted(parameters['objects'], 'object')}; "
        f"{report['hits']:,} hit{_on_none(report)}, and "
        f"{counted(report['points'], 'point')} of them "
        f"{'is' if report['points'] == 1 else 'are'} in the cloud"
    )
    if planning is None:
        return f"{text}."
    text += f"; {counted(planning['trials'], 'particle swarm')} searched for a path"
    if not planning["collision_free"]:
        return f"{text}, and found none without collisions."
    text += f": the best is {metres(planning['best_length'])} long"
    if planning["excess"] is None:
        return f"{text}."
    return f"{text}, {excess(planning['excess']).removeprefix('+')} above the shortest possible."


def _on_none(report: Report) -> str:
    """Say how many returns are from no surface, such as rain."""
    none = report["hits"] - report["hits_on_surfaces"]
    return f" ({none:,} of them no surface)" if none > 0 else ""


def _changed(values: Mapping[str, Any], kind: type) -> list[tuple[str, str]]:
    """Name and value of each field of a dataclass that differs from its default."""
    usual = declared(kind(), kind)
    return [(name, _told(values[name])) for name in usual if values[name] != usual[name]]


def _told(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, (list, tuple)):
        return " × ".join(map(_told, value))
    return f"{value:,.6g}" if isinstance(value, (int, float)) else str(value)


def _title(parameters: Mapping[str, Any]) -> str:
    """Name the sensors, and where they were."""
    sensors = (parameters["sensors"] or {"": parameters["sensor"]}).values()
    names = list(dict.fromkeys(sensor["kind"] for sensor in sensors))
    if len(names) > SENSORS_NAMED:
        names[SENSORS_NAMED:] = [f"{len(names) - SENSORS_NAMED} more"]
    where = f"from {counted(parameters['poses'], 'position')}"
    if seconds := parameters["trajectory_s"]:
        where = f"along {duration(seconds)} of a trajectory"
    return f"{' and '.join(', '.join(names).rsplit(', ', 1))} {where}"


def _facts(report: Report, cloud: CountedCloud) -> Iterator[tuple[str, str]]:
    """Return the numbers for the head of the page, and what each is."""
    yield large(report["points"]), "points in the cloud"
    if report["points_per_m2"] is not None:
        yield large(report["points_per_m2"]), "points per m² of surface, the median"
    if "range" in cloud.limits:
        low, high = cloud.limits["range"]
        yield f"{low:.3g} to {high:.3g} m", "ranges of the points"
    elif report["points"]:
        sides = " × ".join(f"{side:.3g}" for side in np.ptp(cloud.bounds, axis=0))
        yield f"{sides} m", "size of the cloud"
    yield duration(report["parameters"]["duration_s"]), "of scanning"
    yield large(report["rays"]), f"rays, cast by {report['backend']}"
    if report["stages"]:
        yield duration(report["seconds"]["total"]), "for the run"


def _pictures(report: Report, images: Mapping[str, str]) -> Iterator[tuple[Markup, str]]:
    """Return the pictures of the result, each an element of HTML, with captions."""
    parameters = report["parameters"]
    objects = counted(parameters["objects"], "object")
    poses, halfway = counted(parameters["poses"], "sensor position"), ""
    if parameters["trajectory_s"]:
        poses = "the trajectories of the sensors"
    if parameters["actors"] or parameters["trajectory_s"]:
        halfway = ", and moving objects at half time"
    every = parameters["keep_every"]
    kept = "one for each hit" if every == 1 else f"one for every {every:,} hits of a scan"
    captions = {
        "scene": f"The scene: {objects} of {counted(parameters['triangles'], 'triangle')}, "
        f"{poses} in red{halfway}.",
        "hits": f"The {counted(report['hits_on_surfaces'], 'hit')} on surfaces per square metre, "
        "and some rays.",
        "intensity": "The light that came back, of each point; gaps between points are closed.",
        "cloud": f"The cloud: {counted(report['points'], 'point')}, {kept}, rounded to "
        f"{parameters['precision_m']:g} m.",
        "path": "The planned path and those of the other trials, from above.",
    }
    for name, caption in captions.items():
        if name in images:
            yield Markup(images[name]), caption

"""Render reports from Jinja templates, using filters that format numbers and escape names.

The HTML report of a survey includes a top view of the point cloud and a timeline of the tasks.
"""

from __future__ import annotations

import io
import math
import re
from base64 import b64encode
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from heapq import nlargest
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml
from PIL import Image

from lidarscenario.plan.flight_density import Squares
from lidarscenario.scenario import Scenario
from lidarsim.errors import explain_os_errors
from lidarsim.media.weather import Weather
from lidarsim.numerics.arrays import Floats, Ints
from lidarsim.numerics.even_samples import even_indices
from lidarsim.schema.declared import declared_values
from lidarsim.sensor import Noise, Returns
from lidarsim.words import natural_sort_key, plural
from lidarview.page_templates import duration, format_value, render_template
from lidarview.render.stage import nice_step

from ...run.pipeline.task_book import StageTotals, union
from ...run.pipeline.task_records import TaskRecord
from ...run.run_result import RunResult
from ..cloud_counts import CloudCounts
from ..report import STAGES, sort_stages

SCENARIO_MOST = 50_000  # maximum number of characters; a scenario may contain a million poses
WIDTH = 1000  # width of the timeline in SVG units, which the page scales
ROW = 18  # height of a row in SVG units
MAX_MARKS = 200  # maximum number of stations in the top view
MAX_NUMBERED = 30  # maximum number of stations for which numbers are drawn
_WEAKEST = 40  # opacity of a pixel with a single point, from 0 to 255
MAX_ROWS = 24  # maximum number of rows per partition; the busiest rows are drawn
_THIN = 1.2  # minimum width of a bar in SVG units
_GAP = 0.6  # bars are merged if the gap between them is smaller, in SVG units
TimeSpan = tuple[float, float]
WorkerTasks = dict[tuple[str, str], list[TaskRecord]]  # {(worker, stage): tasks}


def write_page(
    path: Path,
    report: Mapping[str, Any],
    result: RunResult,
    cloud: CloudCounts,
    scenario: Scenario | None = None,
) -> None:
    """Write the report of a survey as a self-contained HTML file.

    The title contains the sensor models, or the name of the scenario if no sensor has a model.
    Pictures can be inserted later with `insert_picture`.

    Parameters
    ----------
    path
        Output file.
    report
        Content of the report, as returned by `make_report`.
    result, cloud
        Result of the run, and statistics of its cloud.
    scenario
        Scenario of the survey, which is included as YAML.

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    has_model = any(mounted.sensor.name for mounted in result.survey.mounted_sensors)
    top_view = cloud.top_view()
    marks = _station_marks(result, top_view)
    text = render_template(
        "page.html",
        __name__,
        report=report,
        cloud=cloud,
        name="" if scenario is None or has_model else scenario.title,
        pictures={"above": draw_top_view(top_view.counts, top_view.side_m, marks, _north(result))},
        marks=len(marks),
        densities=_density_range(top_view),
        changed=_changed_fields,
        kinds={"returns": Returns, "noise": Noise, "weather": Weather},
        scenario=_scenario_yaml(scenario) if scenario else "",
        timeline=make_timeline(result.stages),
    )
    path.write_text(text, encoding="utf-8")


def insert_picture(page: Path, name: str, picture: str) -> None:
    """Insert a picture, as HTML elements, into a page that `write_page` has written.

    The page does not change if it has no placeholder for the picture.

    Raises
    ------
    LidarError
        If the page cannot be written.
    """
    pattern = re.compile(rf'(<figure data-picture="{name}").*?(?=<figcaption>)', re.DOTALL)
    with explain_os_errors(f"{page} cannot be written"):
        text = pattern.sub(lambda match: f"{match[1]}>{picture}", page.read_text(encoding="utf-8"))
        page.write_text(text, encoding="utf-8")


# A station in the top view: x and y in pixels from the northwest corner, and its number.
_Mark = tuple[float, float, int]
# Distance, in units of the font size, below which stations share a mark with all their numbers.
_SAME_MARK = 0.8


def _station_marks(result: RunResult, top_view: Squares) -> list[_Mark]:
    """Return markers for the stations of a stationary sensor that lie within the top view."""
    survey = result.survey
    if survey.coordinates != "world" or survey.path.moves or not len(result.points):
        return []
    indices = even_indices(survey.path.stations, MAX_MARKS)
    positions = np.array([survey.path.pose(int(k)).position for k in indices])
    rows, columns = top_view.counts.shape
    pixels = (positions[:, :2] + result.scene.origin[:2] - top_view.corner) / top_view.side_m
    is_within = ((pixels >= 0) & (pixels <= (columns, rows))).all(axis=1)
    return [
        (float(x), float(rows - y), int(index) + 1)
        for (x, y), index in zip(pixels[is_within], indices[is_within], strict=True)
    ]


def _north(result: RunResult) -> str:
    """Return the label of the arrow that points up in the top view.

    Only projected coordinate systems define north. In all others, the arrow is the y axis.
    """
    return "N" if result.survey.epsg and result.survey.coordinates == "world" else "y"


def draw_top_view(
    counts: Floats | Ints, pixel_m: float = 1.0, marks: Sequence[_Mark] = (), up: str = "N"
) -> str:
    """Draw point counts as a top view in SVG, with a scale bar and an arrow that points up.

    In dark mode, the page inverts the lightness of the points.

    Parameters
    ----------
    counts
        Number of points per pixel, southernmost row first. Shape (rows, columns).
    pixel_m
        Side length of a pixel in meters.
    marks
        Stations to mark. They are numbered unless there are too many.
    up
        Label of the arrow.
    """
    rows, columns = counts.shape
    letter = max(rows / 30, columns / 55)  # font size in pixels of the image
    size = f'width="{columns}" height="{rows}" style="image-rendering: pixelated"'
    return (
        f'<svg viewBox="0 0 {columns} {rows + 2.2 * letter:.1f}" font-size="{letter:.2f}">'
        f'<image {size} href="{_shade_counts(counts[::-1])}"/>'
        f'<g class="stations">{_draw_marks(marks, letter)}</g>'
        f"{_scale_bar(columns * pixel_m, pixel_m, rows + 1.9 * letter, letter)}"
        f"{_arrow(columns, rows + 1.9 * letter, letter, up)}</svg>"
    )


def _shade_counts(counts: Floats | Ints) -> str:
    """Return an image of point counts as a data URL.

    `counts` has shape (rows, columns).
    """
    shade = np.log1p(counts)
    weakest = np.where(counts > 0, _WEAKEST, 0)  # makes single points visible
    pixels = np.full((*counts.shape, 4), (53, 105, 176, 0), np.uint8)
    pixels[..., 3] = np.maximum(255 * shade / max(shade.max(), 1), weakest)
    data = io.BytesIO()
    Image.fromarray(pixels).save(data, "PNG")
    return f"data:image/png;base64,{b64encode(data.getvalue()).decode()}"


def _draw_marks(marks: Sequence[_Mark], letter: float) -> str:
    """Draw stations as numbered marks, or as dots if there are many stations or only one.

    Stations at the same position, such as those at several heights, share a mark.
    """
    if not 1 < len(marks) <= MAX_NUMBERED:
        radius = 0.25 * letter
        return "".join(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{radius:.2f}"/>' for x, y, _ in marks)
    shared: dict[tuple[float, float], list[int]] = {}
    for x, y, number in marks:
        near = (at for at in shared if math.dist(at, (x, y)) < _SAME_MARK * letter)
        shared.setdefault(next(near, (x, y)), []).append(number)
    drawn = []
    height = 1.6 * letter
    for (x, y), numbers in shared.items():
        label = ", ".join(map(str, numbers))
        if len(numbers) > 1 and numbers[-1] - numbers[0] == len(numbers) - 1:
            label = f"{numbers[0]}–{numbers[-1]}"
        width = height + 0.62 * letter * max(len(label) - 2, 0)
        drawn.append(
            f'<rect x="{x - width / 2:.1f}" y="{y - height / 2:.1f}" width="{width:.2f}" '
            f'height="{height:.2f}" rx="{height / 2:.2f}"/>'
            f'<text x="{x:.1f}" y="{y + 0.34 * letter:.1f}">{label}</text>'
        )
    return "".join(drawn)


def _scale_bar(width_m: float, pixel_m: float, bottom: float, letter: float) -> str:
    """Draw a labeled scale bar that spans about an eighth of the width of the view."""
    length_m = nice_step(width_m / 8)
    length = length_m / pixel_m
    words = f"{length_m / 1000:g} km" if length_m >= 1000 else f"{length_m:g} m"
    end = 0.4 * letter
    return (
        f'<path class="scale" d="M0 {bottom - end:.1f}V{bottom:.1f}H{length:.1f}v{-end:.1f}"/>'
        f'<text class="scale" x="{length + 0.5 * letter:.1f}" y="{bottom:.1f}">{words}</text>'
    )


def _arrow(right: float, bottom: float, letter: float, up: str) -> str:
    """Draw an arrow that points up, with its label on the left, at the right end of the view."""
    x = right - 0.5 * letter
    tip = bottom - 1.5 * letter
    head = f"M{x - 0.35 * letter:.1f} {tip + 0.5 * letter:.1f}L{x:.1f} {tip:.1f}"
    return (
        f'<path class="up" d="M{x:.1f} {bottom:.1f}V{tip:.1f}{head}l{0.35 * letter:.1f} '
        f'{0.5 * letter:.1f}"/>'
        f'<text class="up" text-anchor="end" x="{x - 0.6 * letter:.1f}" y="{bottom:.1f}">'
        f"{up}</text>"
    )


def _density_range(top_view: Squares) -> tuple[float, float] | None:
    """Return the minimum and maximum density in the top view, in points per square meter.

    Only pixels with points count. Return None if there are no points.
    """
    counts = top_view.counts[top_view.counts > 0]
    if not len(counts):
        return None
    return float(counts.min()) / top_view.side_m**2, float(counts.max()) / top_view.side_m**2


def _scenario_yaml(scenario: Scenario) -> str:
    """Format a scenario as YAML, truncating it if it is too long."""
    data = scenario.model_dump(mode="json", exclude_defaults=True, by_alias=True)
    data |= {"classes": dict(scenario.classes)} if scenario.classes else {}  # JSON has no numbers
    text = yaml.safe_dump(
        data, sort_keys=False, allow_unicode=True, default_flow_style=None, width=96
    )
    text = text if len(text) <= SCENARIO_MOST else f"{text[:SCENARIO_MOST]}…"
    return text if data else ""


def _changed_fields(values: Mapping[str, Any], kind: type) -> list[tuple[str, str]]:
    usual = declared_values(kind(), kind)
    return [(name, format_value(values[name])) for name in usual if values[name] != usual[name]]


def make_timeline(stages: Sequence[StageTotals]) -> dict[str, Any] | None:
    """Create the layout of a timeline of a run's recorded tasks.

    All rows share a time axis that starts with the first task. The first group has one row per
    stage. It is followed by one group per partition, with one row for each stage on each worker.

    Returns
    -------
    Values for the template, or None if no task ran. The bars of a row are an SVG path, and its
    detail is the text of a tooltip. Each tick is a pair of a position, in percent of the width, and
    a label.
    """
    if not stages:
        return None
    stages = sort_stages(stages)
    start = min(stage.start for stage in stages)
    seconds = max(1e-6, max(stage.stop for stage in stages) - start)
    axis = _TimeAxis(start, seconds)
    overview = []
    for stage in stages:
        work = f"{duration(stage.seconds)} of work within {duration(stage.stop - stage.start)}"
        detail = f"{plural(stage.tasks, 'task')}, {work}"
        overview.append(axis.row(STAGES[stage.stage], stage.stage, detail, stage.busy))
    groups: list[dict[str, Any]] = [
        {"title": "Stages", "detail": "periods in which at least one task ran", "rows": overview},
        *_partition_groups(stages, axis),
    ]
    marks = np.arange(0, seconds, nice_step(seconds / 6))
    ticks = [(100 * t / seconds, f"{t:.6g} s") for t in marks]
    begun = f"{datetime.fromtimestamp(start, UTC):%Y-%m-%d %H:%M UTC}"
    drawing = {"ticks": ticks, "groups": groups, "row": ROW}
    return {"begun": begun, "seconds": seconds, "stages": stages, "names": STAGES} | drawing


class _TimeAxis(NamedTuple):
    """Time axis of a timeline, in seconds."""

    start: float
    length: float

    def bars(self, times: Iterable[TimeSpan]) -> str:
        """Draw time spans as an SVG path, widening short spans and merging adjacent ones."""
        spans = []
        for start, stop in times:
            x_start = min((start - self.start) * WIDTH / self.length, WIDTH - _THIN)
            x_stop = max((stop - self.start) * WIDTH / self.length, x_start + _THIN)
            spans.append((x_start, x_stop))
        joined = union(spans, _GAP)
        return "".join(f"M{x_start:.1f} {ROW / 2:g}H{x_stop:.1f}" for x_start, x_stop in joined)

    def row(self, label: str, stage: str, detail: str, times: Iterable[TimeSpan]) -> dict[str, str]:
        text = f"{label}: {detail}"
        return {"label": label, "detail": text, "stage": stage, "bars": self.bars(times)}


def _partition_groups(stages: Sequence[StageTotals], axis: _TimeAxis) -> list[dict[str, Any]]:
    """Return a group of rows for each partition."""
    task_counts = sum((stage.resources for stage in stages), Counter())  # {partition: tasks}
    # {partition: recorded tasks}
    drawn: dict[str, WorkerTasks] = defaultdict(lambda: defaultdict(list))
    for record in (record for stage in stages for record in stage.records):
        name = record.partition if not record.is_misplaced else " + ".join(record.resources)
        drawn[name or "no partition"][record.worker, record.stage].append(record)
    groups = []
    for partition, tasks in sorted(drawn.items()):
        workers = {worker for worker, _ in tasks}  # workers with recorded tasks
        workers = workers.union(*(s.workers for s in stages if s.partition == partition))
        count = sum(map(len, tasks.values()))
        total = max(task_counts[partition], count)
        detail = f"{plural(len(workers), 'worker')}, {plural(total, 'task')}"
        if total > count:  # otherwise, gaps would look like idle time
            detail += f", of which {count:,} are drawn, so gaps are not always idle time"
        if len(tasks) > MAX_ROWS:
            detail += f"; only the {MAX_ROWS} busiest of {len(tasks):,} rows are shown"
        groups.append({"title": partition, "detail": detail, "rows": _worker_rows(tasks, axis)})
    return groups


def _worker_rows(tasks: WorkerTasks, axis: _TimeAxis) -> list[dict[str, str]]:
    """Return a row for each of the busiest pairs of worker and stage in a partition."""
    busy_s = {key: sum(task.seconds for task in records) for key, records in tasks.items()}
    rows = []
    for worker, stage in sorted(
        nlargest(MAX_ROWS, tasks, key=lambda key: busy_s[key]),
        key=lambda key: (natural_sort_key(key[0]), [*STAGES].index(key[1])),
    ):
        records = tasks[worker, stage]
        work = duration(busy_s[worker, stage])
        detail = f"{STAGES[stage]}, {plural(len(records), 'task')}, {work}"
        rows.append(axis.row(worker, stage, detail, ((task.start, task.stop) for task in records)))
    return rows

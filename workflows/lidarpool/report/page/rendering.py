"""Fills the templates of pages, with a timeline of tasks and with numbers and names as text."""

from __future__ import annotations

import io
import math
import re
from base64 import b64encode
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from functools import cache
from heapq import nlargest
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml
from jinja2 import Environment, PackageLoader, StrictUndefined, Template
from markupsafe import Markup, escape
from PIL import Image

from lidarsim.errors import explained
from lidarsim.io.storage import Storage
from lidarsim.media.weather import Weather
from lidarsim.numerics.arrays import Ints
from lidarsim.numerics.even_samples import even_indices
from lidarsim.schema.declared import declared_values
from lidarsim.sensor import Noise, Returns
from lidarsim.words import natural_sort_key, plural, remove_common_prefix, shorten_name
from lidarview.render.stage import nice_step

from ...clouds.format_table import data_set_title
from ...run.pipeline.task_book import StageTotals, union
from ...run.pipeline.task_records import TaskRecord
from ...run.run_result import RunResult
from ...scenario.scenario import Scenario
from ..cloud_counts import CloudCounts
from ..report import STAGES, in_order

SCENARIO_MOST = 50_000  # letters of the scenario; a survey may have a million poses
WIDTH = 1000  # units of the drawing, which the page scales
ROW = 18  # height of a row
MAX_MARKS = 200  # stations in the picture from above
MAX_NUMBERED = 30  # stations that have their numbers there
_WEAKEST = 40  # opacity of a pixel with a single point, of 255
MAX_ROWS = 24  # rows of a partition; the busiest are drawn
_THIN = 1.2  # smallest width of a bar, in units
_GAP = 0.6  # bars closer than this are drawn as one
TimeSpan = tuple[float, float]
WorkerTasks = dict[tuple[str, str], list[TaskRecord]]  # {(worker, stage): their tasks}
MINUS = "\N{MINUS SIGN}"
NARROW = "\N{NARROW NO-BREAK SPACE}"
_SPACES = f"\n\t\N{NO-BREAK SPACE}{NARROW}"  # not printable to Python, and harmless


def write_page(
    path: Path,
    report: Mapping[str, Any],
    result: RunResult,
    cloud: CloudCounts,
    scenario: Scenario | None = None,
) -> None:
    """Write a report as a single HTML file, which needs no further files and no network.

    Most numbers come from `report`, made by `make_report`. `put_picture` adds pictures. The title
    has the models of the sensors, or the scenario's name if no sensor has a model.

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    has_model = any(mounted.sensor.name for mounted in result.survey.carried)
    marks = _station_marks(result, cloud)
    text = rendered(
        "page.html",
        report=report,
        cloud=cloud,
        name="" if scenario is None or has_model else scenario.title,
        pictures={"above": from_above(cloud.above, cloud.pixel_m, marks)},
        marks=len(marks),
        densities=_density_ends(cloud),
        changed=_changed,
        kinds={"returns": Returns, "noise": Noise, "weather": Weather},
        scenario=_written(scenario) if scenario else "",
        stages=result.stages,
    )
    path.write_text(text, encoding="utf-8")


def put_picture(page: Path, name: str, svg: str) -> None:
    """Insert a picture into a page of `write_page`.

    A page without room for the picture stays.

    LidarError if the page cannot be written.
    """
    pattern = re.compile(rf'(<figure data-picture="{name}").*?(?=<figcaption>)', re.DOTALL)
    with explained(f"{page} cannot be written"):
        text = pattern.sub(lambda match: f"{match[1]}>{svg}", page.read_text(encoding="utf-8"))
        Storage.at(page.parent, durable=False).write(page.name, text.encode())


# A station seen from above: pixels from the west and from the north, and its number.
_Mark = tuple[float, float, int]


def _station_marks(result: RunResult, cloud: CloudCounts) -> list[_Mark]:
    """Return the stations of sensors that stand within the bounds of the points."""
    survey = result.survey
    if survey.coordinates != "world" or survey.path.moves or not len(result.points):
        return []
    indices = even_indices(survey.path.stations, MAX_MARKS)
    positions = np.array([survey.path.pose(int(k)).position for k in indices])
    rows, columns = cloud.above.shape
    pixels = (positions[:, :2] + result.scene.origin[:2] - cloud.corner) / cloud.pixel_m
    is_within = ((pixels >= 0) & (pixels <= (columns, rows))).all(axis=1)
    return [
        (float(x), float(rows - y), int(index) + 1)
        for (x, y), index in zip(pixels[is_within], indices[is_within], strict=True)
    ]


def from_above(counts: Ints, pixel_m: float = 1.0, marks: Sequence[_Mark] = ()) -> str:
    """Draw numbers of points (rows, columns), the first row in the south, as SVG with a scale.

    The page inverts the lightness of the points where the page is dark. Few `marks` have their
    numbers; many are red dots.
    """
    rows, columns = counts.shape
    letter = max(rows / 30, columns / 55)  # height of letters
    size = f'width="{columns}" height="{rows}" style="image-rendering: pixelated"'
    return (
        f'<svg viewBox="0 0 {columns} {rows + 2.2 * letter:.1f}" font-size="{letter:.2f}">'
        f'<image {size} href="{_shaded(counts[::-1])}"/>'
        f'<g class="stations">{_drawn_marks(marks, letter)}</g>'
        f"{_scale_bar(columns * pixel_m, pixel_m, rows + 1.9 * letter, letter)}</svg>"
    )


def _shaded(counts: Ints) -> str:
    """Return the address of a picture of numbers of points (rows, columns)."""
    shade = np.log1p(counts)
    weakest = np.where(counts > 0, _WEAKEST, 0)  # single points are visible, too
    pixels = np.full((*counts.shape, 4), (53, 105, 176, 0), np.uint8)
    pixels[..., 3] = np.maximum(255 * shade / max(shade.max(), 1), weakest)
    data = io.BytesIO()
    Image.fromarray(pixels).save(data, "PNG")
    return f"data:image/png;base64,{b64encode(data.getvalue()).decode()}"


def _drawn_marks(marks: Sequence[_Mark], letter: float) -> str:
    """Draw stations as discs with their numbers, or as dots if there are many or only one."""
    if not 1 < len(marks) <= MAX_NUMBERED:
        radius = 0.25 * letter
        return "".join(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{radius:.2f}"/>' for x, y, _ in marks)
    return "".join(
        f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{0.8 * letter:.2f}"/>'
        f'<text x="{x:.1f}" y="{y + 0.34 * letter:.1f}">{number}</text>'
        for x, y, number in marks
    )


def _scale_bar(width_m: float, pixel_m: float, bottom: float, letter: float) -> str:
    """Draw a scale bar of about an eighth of a width, with its length."""
    length_m = nice_step(width_m / 8)
    length = length_m / pixel_m
    words = f"{length_m / 1000:g} km" if length_m >= 1000 else f"{length_m:g} m"
    end = 0.4 * letter
    return (
        f'<path class="scale" d="M0 {bottom - end:.1f}V{bottom:.1f}H{length:.1f}v{-end:.1f}"/>'
        f'<text class="scale" x="{length + 0.5 * letter:.1f}" y="{bottom:.1f}">{words}</text>'
    )


def _density_ends(cloud: CloudCounts) -> tuple[float, float] | None:
    """Return the lowest and highest points per square meter in `above`, or None without points."""
    counts = cloud.above[cloud.above > 0]
    if not len(counts):
        return None
    return float(counts.min()) / cloud.pixel_m**2, float(counts.max()) / cloud.pixel_m**2


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
    return _template(template).render(
        pictures={name: Markup(image) for name, image in (pictures or {}).items()},
        timeline=make_timeline(stages),
        **values,
    )


@cache  # compiling a template takes longer than filling
def _template(name: str) -> Template:
    escaped = markdown if name.endswith(".md") else printable
    environment = Environment(
        loader=PackageLoader(__package__ or ""),
        autoescape=name.endswith(".html"),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        finalize=lambda value: escaped(value) if type(value) is str else value,  # not of Markup
    )
    for filter_ in (
        duration,
        rate,
        large,
        share,
        excess,
        numbers,
        formatted,
        code,
        markdown,
        millimeters,
        ratio,
        sentence,
        data_set_title,
        plural,
    ):
        environment.filters[filter_.__name__] = filter_
    environment.filters["with_names"] = _with_names
    environment.filters["shortened"] = lambda name, length=60: shorten_name(name, length)
    environment.filters["one_line"] = lambda text: type(text)(re.sub("[ \n]+", " ", text).strip())
    environment.filters["labels"] = lambda names: dict(
        zip(names, remove_common_prefix([*names]), strict=True)
    )
    return environment.get_template(name)


def _with_names(row: str, head: Sequence[str]) -> Markup:
    """Give the cells (td) of a row of a table the names of their columns, as the style shows.

    The first column has the name of the row (th).
    """
    names = iter(head[1:])
    return Markup(re.sub("<td", lambda _: f'<td data-name="{escape(next(names, ""))}"', row))


def _written(scenario: Scenario) -> str:
    """Return a scenario as YAML, cut if too long to be shown."""
    data = scenario.model_dump(mode="json", exclude_defaults=True, by_alias=True)
    data |= {"classes": dict(scenario.classes)} if scenario.classes else {}  # JSON has no numbers
    text = yaml.safe_dump(
        data, sort_keys=False, allow_unicode=True, default_flow_style=None, width=96
    )
    text = text if len(text) <= SCENARIO_MOST else f"{text[:SCENARIO_MOST]}…"
    return text if data else ""


def _changed(values: Mapping[str, Any], kind: type) -> list[tuple[str, str]]:
    """Return the names and values of fields of a dataclass that differ from their defaults."""
    usual = declared_values(kind(), kind)
    return [(name, formatted(values[name])) for name in usual if values[name] != usual[name]]


def make_timeline(stages: Sequence[StageTotals]) -> dict[str, Any] | None:
    """Lay out the tasks of a run, as far as there are records, and return None if no task ran.

    The template gets groups of rows on a common axis, which starts with the first task: the stages,
    then each partition's workers. A row is of one stage, on one worker or on all; its bars are a
    path of thick lines for SVG, and its detail is a tooltip. Ticks are per cent of the width, and
    labels.
    """
    if not stages:
        return None
    stages = in_order(stages)
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
    """Axis of a timeline, seconds."""

    start: float
    length: float

    def bars(self, times: Iterable[TimeSpan]) -> str:
        """Draw spans of time as a path, wide enough to be visible, with close spans joined."""
        spans = []
        for start, stop in times:
            x_start = min((start - self.start) * WIDTH / self.length, WIDTH - _THIN)
            x_stop = max((stop - self.start) * WIDTH / self.length, x_start + _THIN)
            spans.append((x_start, x_stop))
        joined = union(spans, _GAP)
        return "".join(f"M{x_start:.1f} {ROW / 2:g}H{x_stop:.1f}" for x_start, x_stop in joined)

    def row(self, label: str, stage: str, detail: str, times: Iterable[TimeSpan]) -> dict[str, str]:
        """Return a row of the template."""
        text = f"{label}: {detail}"
        return {"label": label, "detail": text, "stage": stage, "bars": self.bars(times)}


def _partition_groups(stages: Sequence[StageTotals], axis: _TimeAxis) -> list[dict[str, Any]]:
    """Return a group of rows for each partition."""
    task_counts = sum((stage.resources for stage in stages), Counter())  # {partition: tasks}
    # {partition: its tasks}
    drawn: dict[str, WorkerTasks] = defaultdict(lambda: defaultdict(list))
    for record in (record for stage in stages for record in stage.records):
        name = record.partition if not record.misplaced else " + ".join(record.resources)
        drawn[name or "no partition"][record.worker, record.stage].append(record)
    groups = []
    for partition, tasks in sorted(drawn.items()):
        workers = {worker for worker, _ in tasks}  # workers of tasks that have a record
        workers = workers.union(*(s.workers for s in stages if s.partition == partition))
        count = sum(map(len, tasks.values()))
        total = max(task_counts[partition], count)
        detail = f"{plural(len(workers), 'worker')}, {plural(total, 'task')}"
        if total > count:  # else gaps would look like idle time
            detail += f", of which {count:,} are drawn, so gaps are not always idle time"
        if len(tasks) > MAX_ROWS:
            detail += f"; only the {MAX_ROWS} busiest of {len(tasks):,} rows are shown"
        groups.append({"title": partition, "detail": detail, "rows": _worker_rows(tasks, axis)})
    return groups


def _worker_rows(tasks: WorkerTasks, axis: _TimeAxis) -> list[dict[str, str]]:
    """Return rows for the busiest pairs of a worker and a stage of a partition."""
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


def sentence(note: str, names: Iterable[str] = ()) -> str:
    """Return a note that begins with a capital, unless it begins with a name: wall.obj, rosbag2.

    `names` are names that look like words.

    Examples
    --------
    >>> sentence("all points are in rain"), sentence("wall.obj has no faces")
    ('All points are in rain', 'wall.obj has no faces')
    """
    first = note.partition(" ")[0].rstrip(",:;")
    is_name = not (first.isalpha() and first.islower()) or note.startswith((*filter(None, names),))
    return note if is_name else f"{note[:1].upper()}{note[1:]}"


def printable(text: str) -> str:
    """Replace unprintable characters, such as those that reverse a line."""
    return "".join(
        c if c.isprintable() or c in _SPACES else "\N{REPLACEMENT CHARACTER}" for c in text
    )


def markdown(text: str) -> str:
    """Return text of a user as a line of Markdown, escaped."""
    line = " ".join("".join(c if c.isprintable() else " " for c in text).split())
    return re.sub(r"([\\`*{}\[\]<>|#&~]|(?<!\w)_|_(?!\w))", r"\\\1", line)


def code(text: str) -> Markup:
    """Return a name as code of Markdown, or as text if letters would end code or a cell."""
    is_plain = text.isprintable() and not re.search(r"[`|\\]", text)
    return Markup(f"`{text}`" if is_plain else markdown(text))


def duration(seconds: float) -> str:
    """Return a time in a unit that gives few digits."""
    if 0 < seconds < 0.001:
        return f"{1e6 * seconds:.0f} µs"
    if 0 < seconds < 0.9995:
        return f"{1e3 * seconds:.3g} ms"
    if seconds < 99.95:
        return f"{seconds:.3g} s"
    total_s = round(seconds)
    if total_s < 3600:
        return f"{total_s // 60} min {total_s % 60:02d} s"
    return f"{total_s // 3600:,} h {total_s % 3600 // 60:02d} min"


def rate(number: float, seconds: float) -> str:
    """Return a rate per second, or a dash if the time is unknown."""
    return f"{large(number / seconds)}/s" if seconds > 0 else "–"


def large(number: float) -> str:
    """Return a number with three digits, and k, M or G for large numbers."""
    for size, letter in ((1e9, "G"), (1e6, "M"), (1e4, "k")):
        if number >= size:
            scaled = number / (1e3 if letter == "k" else size)
            return f"{scaled:.{max(0, 2 - int(math.log10(scaled)))}f}{NARROW}{letter}"
    return f"{number:,.0f}" if number >= 100 else f"{number:.3g}"


def share(part: float, total: float) -> str:
    """Return a part in per cent."""
    return f"{100 * part / total:.1f}%" if total else "–"


def excess(fraction: float) -> str:
    """Return an excess in per cent: «+0.12%»."""
    if 0 < fraction < 1e-4:
        return "< 0.01%"
    return f"{fraction:+.2%}".replace("-", MINUS)


def formatted(value: Any) -> str:
    """Return numbers with four digits or a decimal, integers with all digits, text unchanged."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, list | tuple):
        return " × ".join(map(formatted, value))
    if isinstance(value, float):
        digits = ".1f" if 1000 <= abs(value) < 1e9 else ".4g"
        return f"{value:,{digits}}".removesuffix(".0")
    return f"{value:,}" if isinstance(value, int) else str(value)


def numbers(values: Sequence[float]) -> str:
    """Return coordinates in meters, to the millimeter."""
    return ", ".join(f"{round(value, 3) + 0.0:,.10g}" for value in values).replace("-", MINUS)


def millimeters(value: float | None) -> str:
    """Return a length in meters or millimeters, or "unknown" for None."""
    if value is None:
        return "unknown"
    text = f"{value:.3f} m" if abs(value) >= 0.9995 else f"{1000 * value:.3g} mm"
    return text.replace("-", MINUS)


def ratio(value: float | None) -> str:
    """Return a share from 0 to 1, or "undefined" for None."""
    return "undefined" if value is None else f"{value:.3f}"

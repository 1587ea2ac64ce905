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
from typing import Any

import numpy as np
import yaml
from jinja2 import Environment, PackageLoader, StrictUndefined, Template
from markupsafe import Markup
from PIL import Image

from lidarsim.base.arrays import Ints
from lidarsim.base.declared import declared
from lidarsim.base.errors import explained
from lidarsim.base.storage import Storage
from lidarsim.base.words import natural, plural, shortened, without_common_prefix
from lidarsim.sensor import Noise, Returns
from lidarsim.sensor.weather import Weather
from lidarview.render.stage import nice_step

from ...run.pipeline.placement import TaskRecord
from ...run.pipeline.task_book import StageTotals, union
from ...run.run_result import RunResult
from ...scenario.scenario import Scenario
from ..report import STAGES, CountedCloud, in_order

SCENARIO_MOST = 50_000  # letters of the scenario; a survey may have a million poses
WIDTH = 1000  # units of the drawing, which the page scales
ROW = 18  # height of a row
ROWS_MOST = 24  # rows of a partition; the busiest are drawn
_THIN = 1.2  # least width of a bar, in units
_GAP = 0.6  # bars nearer than this are drawn as one
TimeSpan = tuple[float, float]
WorkerTasks = dict[tuple[str, str], list[TaskRecord]]  # {(worker, stage): their tasks}
MINUS = "\N{MINUS SIGN}"
NARROW = "\N{NARROW NO-BREAK SPACE}"
_SPACES = f"\n\t\N{NO-BREAK SPACE}{NARROW}"  # not printable to Python, and harmless


def write_page(
    path: Path,
    report: Mapping[str, Any],
    result: RunResult,
    cloud: CountedCloud,
    scenario: Scenario | None = None,
) -> None:
    """Write a report as one HTML file that needs no other files and no network.

    Most numbers are those of `report`, from `make_report`. `put_picture` adds pictures.

    Raises
    ------
    OSError
        If it cannot be written.
    """
    text = rendered(
        "page.html",
        report=report,
        cloud=cloud,
        pictures={"above": from_above(cloud.above)},
        changed=_changed,
        kinds={"returns": Returns, "noise": Noise, "weather": Weather},
        scenario=_written(scenario) if scenario else "",
        stages=result.stages,
    )
    path.write_text(text, encoding="utf-8")


def put_picture(page: Path, name: str, svg: str) -> None:
    """Put a picture in its place in a page that `write_page` wrote; other pages stay as they are.

    LidarError if it cannot be written.
    """
    place = re.compile(rf'(<figure data-picture="{name}").*?(?=<figcaption>)', re.DOTALL)
    with explained(f"{page} cannot be written"):
        text = place.sub(lambda found: f"{found[1]}>{svg}", page.read_text(encoding="utf-8"))
        Storage.at(page.parent, durable=False).write(page.name, text.encode())


def from_above(counts: Ints) -> str:
    """Draw numbers of points (rows, columns), the first row in the south, as SVG."""
    rows, columns = counts.shape
    pixels = np.full((rows, columns, 4), (53, 105, 176, 0), np.uint8)
    shade = np.log1p(counts[::-1])
    pixels[..., 3] = 255 * shade / max(shade.max(), 1)
    data = io.BytesIO()
    Image.fromarray(pixels).save(data, "PNG")
    source = f"data:image/png;base64,{b64encode(data.getvalue()).decode()}"
    size = f'width="{columns}" height="{rows}" style="image-rendering: pixelated"'
    return f'<svg viewBox="0 0 {columns} {rows}"><image {size} href="{source}"/></svg>'


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


@cache  # compiling one takes longer than filling it
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
        duration, rate, large, share, excess,
        numbers, formatted, code, markdown, millimetres,
        ratio, plural,
    ):  # fmt: skip
        environment.filters[filter_.__name__] = filter_
    environment.filters["shortened"] = lambda name, most=60: shortened(name, most)
    environment.filters["one_line"] = lambda text: type(text)(re.sub("[ \n]+", " ", text).strip())
    environment.filters["labels"] = lambda names: dict(
        zip(names, without_common_prefix([*names]), strict=True)
    )
    return environment.get_template(name)


def _written(scenario: Scenario) -> str:
    """Return a scenario as YAML that can be loaded, unless it is so long that it is cut."""
    data = scenario.model_dump(mode="json", exclude_defaults=True, by_alias=True)
    data |= {"classes": dict(scenario.classes)} if scenario.classes else {}  # JSON has no numbers
    text = yaml.safe_dump(
        data, sort_keys=False, allow_unicode=True, default_flow_style=None, width=96
    )
    text = text if len(text) <= SCENARIO_MOST else f"{text[:SCENARIO_MOST]}…"
    return text if data else ""


def _changed(values: Mapping[str, Any], kind: type) -> list[tuple[str, str]]:
    """Name and value of each field of a dataclass that differs from its default."""
    usual = declared(kind(), kind)
    return [(name, formatted(values[name])) for name in usual if values[name] != usual[name]]


def make_timeline(stages: Sequence[StageTotals]) -> dict[str, Any] | None:
    """Lay out the tasks of a run, of which some have records; None if nothing ran.

    The template gets groups of rows on one axis, which begins with the first task: the stages, then
    each partition's workers. A row is of one stage, on one worker or on all; its bars are a path of
    thick lines for SVG, and its detail is a tooltip. Ticks are per cent of the width, and labels.
    """
    if not stages:
        return None
    stages = in_order(stages)
    begin = min(stage.start for stage in stages)
    seconds = max(1e-6, max(stage.stop for stage in stages) - begin)

    def bars(times: Iterable[TimeSpan]) -> str:
        """Draw spans of time, each wide enough to see, near ones joined."""
        wide = []
        for start, stop in times:
            low = min((start - begin) * WIDTH / seconds, WIDTH - _THIN)
            wide.append((low, max((stop - begin) * WIDTH / seconds, low + _THIN)))
        return "".join(f"M{low:.1f} {ROW / 2:g}H{high:.1f}" for low, high in union(wide, _GAP))

    def row(label: str, stage: str, detail: str, times: Iterable[TimeSpan]) -> dict[str, str]:
        text = f"{label}: {detail}"
        return {"label": label, "detail": text, "stage": stage, "bars": bars(times)}

    overview = []
    for one in stages:
        work = f"{duration(one.seconds)} of work within {duration(one.stop - one.start)}"
        detail = f"{plural(one.tasks, 'task')}, {work}"
        overview.append(row(STAGES[one.stage], one.stage, detail, one.busy))
    groups: list[dict[str, Any]] = [
        {"title": "Stages", "detail": "while at least one task ran", "rows": overview}
    ]
    ran = sum((stage.resources for stage in stages), Counter())  # {partition: tasks}
    # {partition: its tasks}
    drawn: dict[str, WorkerTasks] = defaultdict(lambda: defaultdict(list))
    for record in (record for stage in stages for record in stage.records):
        where = record.partition if not record.misplaced else " + ".join(record.resources)
        drawn[where or "no partition"][record.worker, record.stage].append(record)
    for partition, tasks in sorted(drawn.items()):
        workers = {worker for worker, _ in tasks}  # of tasks that have a record
        workers = workers.union(*(s.workers for s in stages if s.partition == partition))
        count = sum(map(len, tasks.values()))
        detail = f"{plural(len(workers), 'worker')}, {plural(max(ran[partition], count), 'task')}"
        if ran[partition] > count:  # else gaps would look like idle time
            detail += f", of which {count:,} are drawn: gaps are not all idle time"
        if len(tasks) > ROWS_MOST:
            detail += f"; the busiest {ROWS_MOST} of {len(tasks):,} rows"
        busy = {key: sum(task.seconds for task in some) for key, some in tasks.items()}
        rows = []
        for worker, stage in sorted(
            nlargest(ROWS_MOST, tasks, key=lambda key: busy[key]),
            key=lambda key: (natural(key[0]), [*STAGES].index(key[1])),
        ):
            some = tasks[worker, stage]
            work = duration(busy[worker, stage])
            words = f"{STAGES[stage]}, {plural(len(some), 'task')}, {work}"
            rows.append(row(worker, stage, words, ((task.start, task.stop) for task in some)))
        groups.append({"title": partition, "detail": detail, "rows": rows})
    marks = np.arange(0, seconds, nice_step(seconds / 6))
    ticks = [(100 * t / seconds, f"{t:.6g} s") for t in marks]
    begun = f"{datetime.fromtimestamp(begin, UTC):%Y-%m-%d %H:%M UTC}"
    drawing = {"ticks": ticks, "groups": groups, "row": ROW}
    return {"begun": begun, "seconds": seconds, "stages": stages, "names": STAGES} | drawing


def printable(text: str) -> str:
    """Replace unprintable characters; names in files may contain ones that reverse a line."""
    return "".join(
        c if c.isprintable() or c in _SPACES else "\N{REPLACEMENT CHARACTER}" for c in text
    )


def markdown(text: str) -> str:
    """Text of a user as one line of Markdown that shows it as it is."""
    line = " ".join("".join(c if c.isprintable() else " " for c in text).split())
    return re.sub(r"([\\`*{}\[\]<>|#&~]|(?<!\w)_|_(?!\w))", r"\\\1", line)


def code(text: str) -> Markup:
    """Name as code of Markdown; with letters that end code or a cell, as text."""
    is_plain = text.isprintable() and not re.search(r"[`|\\]", text)
    return Markup(f"`{text}`" if is_plain else markdown(text))


def duration(seconds: float) -> str:
    """Return a time in the unit that suits it."""
    if 0 < seconds < 0.001:
        return f"{1e6 * seconds:.0f} µs"
    if 0 < seconds < 0.9995:
        return f"{1e3 * seconds:.3g} ms"
    if seconds < 99.95:
        return f"{seconds:.3g} s"
    whole = round(seconds)
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600:,} h {whole % 3600 // 60:02d} min"


def rate(number: float, seconds: float) -> str:
    """Return a rate per second; a dash if the time is unknown."""
    return f"{large(number / seconds)}/s" if seconds > 0 else "–"


def large(number: float) -> str:
    """Return a number with three digits, and k, M or G if it is large."""
    for size, letter in ((1e9, "G"), (1e6, "M"), (1e4, "k")):
        if number >= size:
            scaled = number / (1e3 if letter == "k" else size)
            return f"{scaled:.{max(0, 2 - int(math.log10(scaled)))}f}{NARROW}{letter}"
    return f"{number:,.0f}" if number >= 100 else f"{number:.3g}"


def share(part: float, whole: float) -> str:
    """Return a part in per cent."""
    return f"{100 * part / whole:.1f}%" if whole else "–"


def excess(fraction: float) -> str:
    """Return an excess in per cent: «+0.12%»."""
    if 0 < fraction < 1e-4:
        return "< 0.01%"
    return f"{fraction:+.2%}".replace("-", MINUS)


def formatted(value: Any) -> str:
    """Return a number of four digits, or to a tenth, whole ones with all; text, or several."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, list | tuple):
        return " × ".join(map(formatted, value))
    if isinstance(value, float):
        digits = ".1f" if 1000 <= abs(value) < 1e9 else ".4g"
        return f"{value:,{digits}}".removesuffix(".0")
    return f"{value:,}" if isinstance(value, int) else str(value)


def numbers(values: Sequence[float]) -> str:
    """Coordinates in metres, to the millimetre."""
    return ", ".join(f"{round(value, 3) + 0.0:,.10g}" for value in values).replace("-", MINUS)


def millimetres(value: float | None) -> str:
    """Length in the unit that suits it, or words for none."""
    if value is None:
        return "unknown"
    text = f"{value:.3f} m" if abs(value) >= 0.9995 else f"{1000 * value:.3g} mm"
    return text.replace("-", MINUS)


def ratio(value: float | None) -> str:
    """Return a share from 0 to 1, or words for none."""
    return "undefined" if value is None else f"{value:.3f}"

"""The tasks of a run over time, as rows of bars by partition and worker."""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from poolpart import TaskRecord

from ...base.task_book import StageTotals, union
from ...base.words import counted
from ...render.stage import nice_step
from .words import duration

WIDTH = 1000  # units of the drawing, which the page scales
ROW = 18  # height of a row
ROWS_MOST = 24  # rows of a partition; the busiest are drawn
_THIN = 1.2  # least width of a bar, in units
_GAP = 0.6  # bars nearer than this are drawn as one

Span = tuple[float, float]


class Row(NamedTuple):
    """The bars of one stage, on one worker or on all: a path of thick lines for SVG."""

    label: str
    detail: str  # the tooltip
    stage: str  # gives the colour
    bars: str


class Group(NamedTuple):
    """Rows under one heading."""

    title: str
    detail: str
    rows: Sequence[Row]


class Timeline(NamedTuple):
    """All groups on one axis: the stages, then each partition's workers."""

    seconds: float  # from the first start to the last stop
    ticks: Sequence[tuple[float, str]]  # per cent of the width, label
    groups: Sequence[Group]
    tasks: int
    row: int = ROW  # height of a row


class _Axis:
    """Convert a time to units."""

    def __init__(self, stages: Sequence[StageTotals]) -> None:
        self.begin = min(stage.start for stage in stages)
        self.seconds = max(1e-6, max(stage.stop for stage in stages) - self.begin)

    def spans(self, times: Iterable[Span]) -> list[Span]:
        """Spans in units, each wide enough to see, near ones joined."""
        scale = WIDTH / self.seconds
        wide = []
        for start, stop in times:
            low = min((start - self.begin) * scale, WIDTH - _THIN)
            wide.append((low, max((stop - self.begin) * scale, low + _THIN)))
        return union(wide, _GAP)

    def bars(self, times: Iterable[Span]) -> str:
        return "".join(f"M{low:.1f} {ROW / 2:g}H{high:.1f}" for low, high in self.spans(times))


def make_timeline(
    stages: Sequence[StageTotals], records: Sequence[TaskRecord], names: dict[str, str]
) -> Timeline | None:
    """Lay out the tasks of a run; None if nothing ran.

    `stages` count all tasks, `records` are some of them, and `names` is {stage: its name on the
    page}.
    """
    if not stages:
        return None
    axis = _Axis(stages)
    step = nice_step(axis.seconds / 6)
    overview = [
        Row(
            names[stage.stage],
            f"{names[stage.stage]}: {counted(stage.tasks, 'task')}, {duration(stage.seconds)} of "
            f"work within {duration(stage.stop - stage.start)}",
            stage.stage,
            axis.bars(stage.busy),
        )
        for stage in stages
    ]
    groups = [Group("Stages", "while at least one task ran", overview)]
    ran = sum((stage.resources for stage in stages), Counter())  # {partition: tasks}
    for partition, tasks in sorted(_by_partition(records).items()):
        workers = {task.worker for task in tasks}  # tasks that have a record
        workers = workers.union(*(s.workers for s in stages if s.partition == partition))
        groups.append(_group(axis, partition, len(workers), ran[partition], tasks, names))
    ticks = [(100 * t / axis.seconds, f"{t:.6g} s") for t in np.arange(0, axis.seconds, step)]
    return Timeline(axis.seconds, ticks, groups, sum(stage.tasks for stage in stages))


def _by_partition(records: Iterable[TaskRecord]) -> dict[str, list[TaskRecord]]:
    """Tasks by the partition of their worker."""
    found: dict[str, list[TaskRecord]] = defaultdict(list)
    for record in records:
        where = record.partition if not record.misplaced else " + ".join(record.resources)
        found[where or "no partition"].append(record)
    return found


def _group(
    axis: _Axis,
    partition: str,
    workers: int,
    ran: int,
    tasks: Sequence[TaskRecord],
    names: dict[str, str],
) -> Group:
    """Rows of a partition: one for each worker and stage, the busiest of them."""
    rows: dict[tuple[str, str], list[TaskRecord]] = defaultdict(list)
    for task in tasks:
        rows[task.worker, task.stage].append(task)
    busiest = sorted(rows.items(), key=lambda row: -sum(task.seconds for task in row[1]))
    detail = f"{counted(workers, 'worker')}, {counted(max(ran, len(tasks)), 'task')}"
    if ran > len(tasks):  # else gaps would look like idle time
        detail += f", of which {len(tasks):,} are drawn: gaps are not all idle time"
    if len(rows) > ROWS_MOST:
        detail += f"; the busiest {ROWS_MOST} of {len(rows):,} rows"
    drawn = []
    order = list(names)
    shown = sorted(
        busiest[:ROWS_MOST], key=lambda row: (_natural(row[0][0]), order.index(row[0][1]))
    )
    for (worker, stage), those in shown:
        busy = duration(sum(task.seconds for task in those))
        said = f"{worker}: {names[stage]}, {counted(len(those), 'task')}, {busy}"
        bars = axis.bars((task.start, task.stop) for task in those)
        drawn.append(Row(worker, said, stage, bars))
    return Group(partition, detail, drawn)


def _natural(worker: str) -> list[tuple[int, str]]:
    """Sort key: GPU-2 before GPU-10."""
    pieces = re.split(r"(\d+)", worker)
    return [(int(p), "") if p.isdecimal() else (-1, p) for p in pieces]

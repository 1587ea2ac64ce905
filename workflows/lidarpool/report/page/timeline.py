"""The tasks of a run over time, as rows of bars by partition and worker."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from poolpart import TaskRecord

from ...base.words import counted, natural
from ...pipeline.task_book import StageTotals, union
from ...render.stage import nice_step
from ..report import STAGES
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


def make_timeline(stages: Sequence[StageTotals], records: Sequence[TaskRecord]) -> Timeline | None:
    """Lay out the tasks of a run: `stages` count all, `records` are some. None if nothing ran."""
    if not stages:
        return None
    begin = min(stage.start for stage in stages)
    seconds = max(1e-6, max(stage.stop for stage in stages) - begin)

    def bars(times: Iterable[Span]) -> str:
        """Draw spans of time, each wide enough to see, near ones joined."""
        wide = []
        for start, stop in times:
            low = min((start - begin) * WIDTH / seconds, WIDTH - _THIN)
            wide.append((low, max((stop - begin) * WIDTH / seconds, low + _THIN)))
        return "".join(f"M{low:.1f} {ROW / 2:g}H{high:.1f}" for low, high in union(wide, _GAP))

    overview = [
        Row(
            STAGES[stage.stage],
            f"{STAGES[stage.stage]}: {counted(stage.tasks, 'task')}, {duration(stage.seconds)} of "
            f"work within {duration(stage.stop - stage.start)}",
            stage.stage,
            bars(stage.busy),
        )
        for stage in stages
    ]
    groups = [Group("Stages", "while at least one task ran", overview)]
    ran = sum((stage.resources for stage in stages), Counter())  # {partition: tasks}
    by_partition: dict[str, list[TaskRecord]] = defaultdict(list)
    for record in records:
        where = record.partition if not record.misplaced else " + ".join(record.resources)
        by_partition[where or "no partition"].append(record)
    for partition, tasks in sorted(by_partition.items()):
        workers = {task.worker for task in tasks}  # tasks that have a record
        workers = workers.union(*(s.workers for s in stages if s.partition == partition))
        detail = f"{counted(len(workers), 'worker')}, "
        detail += counted(max(ran[partition], len(tasks)), "task")
        if ran[partition] > len(tasks):  # else gaps would look like idle time
            detail += f", of which {len(tasks):,} are drawn: gaps are not all idle time"
        rows: dict[tuple[str, str], list[TaskRecord]] = defaultdict(list)
        for task in tasks:
            rows[task.worker, task.stage].append(task)
        busiest = sorted(rows, key=lambda row: -sum(task.seconds for task in rows[row]))
        if len(rows) > ROWS_MOST:
            detail += f"; the busiest {ROWS_MOST} of {len(rows):,} rows"
        drawn = []
        for worker, stage in sorted(
            busiest[:ROWS_MOST], key=lambda row: (natural(row[0]), [*STAGES].index(row[1]))
        ):
            those = rows[worker, stage]
            busy = duration(sum(task.seconds for task in those))
            told = f"{worker}: {STAGES[stage]}, {counted(len(those), 'task')}, {busy}"
            drawn.append(Row(worker, told, stage, bars((t.start, t.stop) for t in those)))
        groups.append(Group(partition, detail, drawn))
    marks = np.arange(0, seconds, nice_step(seconds / 6))
    ticks = [(100 * t / seconds, f"{t:.6g} s") for t in marks]
    return Timeline(seconds, ticks, groups, sum(stage.tasks for stage in stages))

"""The tasks of a run over time, as rows of bars by partition and worker."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from typing import NamedTuple

import numpy as np

from poolpart import TaskRecord

from ...base.words import counted, natural
from ...pipeline.task_book import StageTotals, union
from ...render.stage import nice_step
from ..report import STAGES, in_order
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

    begun: str  # when the first task was, UTC
    seconds: float  # from the first start to the last stop
    ticks: Sequence[tuple[float, str]]  # per cent of the width, label
    groups: Sequence[Group]
    stages: Sequence[StageTotals]  # in the order of the pipeline
    names: Mapping[str, str] = STAGES
    row: int = ROW  # height of a row


def make_timeline(stages: Sequence[StageTotals]) -> Timeline | None:
    """Lay out the tasks of a run, of which some have records; None if nothing ran."""
    if not stages:
        return None
    stages = in_order(stages)
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
    # {partition: {(worker, stage): tasks}}
    drawn: dict[str, dict[tuple[str, str], list[TaskRecord]]] = defaultdict(
        lambda: defaultdict(list)
    )
    for record in (record for stage in stages for record in stage.records):
        where = record.partition if not record.misplaced else " + ".join(record.resources)
        drawn[where or "no partition"][record.worker, record.stage].append(record)
    for partition, tasks in sorted(drawn.items()):
        workers = {worker for worker, _ in tasks}  # of tasks that have a record
        workers = workers.union(*(s.workers for s in stages if s.partition == partition))
        count = sum(map(len, tasks.values()))
        detail = f"{counted(len(workers), 'worker')}, {counted(max(ran[partition], count), 'task')}"
        if ran[partition] > count:  # else gaps would look like idle time
            detail += f", of which {count:,} are drawn: gaps are not all idle time"
        if len(tasks) > ROWS_MOST:
            detail += f"; the busiest {ROWS_MOST} of {len(tasks):,} rows"
        work = {row: sum(task.seconds for task in tasks[row]) for row in tasks}
        busiest = sorted(work, key=lambda row: -work[row])[:ROWS_MOST]
        rows = [
            Row(
                worker,
                f"{worker}: {STAGES[stage]}, {counted(len(tasks[worker, stage]), 'task')}, "
                + duration(work[worker, stage]),
                stage,
                bars((task.start, task.stop) for task in tasks[worker, stage]),
            )
            for worker, stage in sorted(
                busiest, key=lambda row: (natural(row[0]), [*STAGES].index(row[1]))
            )
        ]
        groups.append(Group(partition, detail, rows))
    marks = np.arange(0, seconds, nice_step(seconds / 6))
    ticks = [(100 * t / seconds, f"{t:.6g} s") for t in marks]
    begun = f"{datetime.fromtimestamp(begin, UTC):%Y-%m-%d %H:%M UTC}"
    return Timeline(begun, seconds, ticks, groups, stages)

"""The tasks of a run over time: rows of bars by partition and worker, however many there were."""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from poolpart import TaskRecord
from poolpart.wording import counted

from ...base.task_book import StageTotals, union
from ...render.stage import nice_step
from ...run.trials import TRIAL
from ...scan import INTERSECT
from .words import duration

WIDTH = 1000  # units of the drawing, whatever its width on the page
ROW = 18  # height of a row
LANES_MOST = 48  # of all partitions; what is beyond is drawn together
SLICES = 250  # of the time, in what is drawn together
_THIN = 1.2  # units that a bar is wide at least
_GAP = 0.6  # units between bars that are drawn as one

Span = tuple[float, float]


@dataclass(frozen=True)
class Row:
    """One row: bars of one stage on one worker, or a curve of what was folded.

    Parameters
    ----------
    label, detail
        What stands before it, and what is said on a closer look.
    stage
        Whose colour it has; empty for what is of several.
    bars
        A path for SVG: lines along the middle of the row to be drawn thick, or a filled area
        where `folded`.
    folded
        Whether several workers are in it.
    """

    label: str
    detail: str
    stage: str
    bars: str
    folded: bool = False


@dataclass(frozen=True)
class Group:
    """Rows under one heading."""

    title: str
    detail: str
    rows: tuple[Row, ...]


@dataclass(frozen=True)
class Timeline:
    """All groups on one axis.

    Parameters
    ----------
    seconds
        From the first start to the last stop.
    ticks
        (per cent of the width, label).
    groups
        The stages, then each partition's workers.
    both
        Where stage 2 and planning ran at the same time: (from, to) in units.
    drawn, tasks
        Tasks with a record of their own, and all.
    row
        Height of a row.
    """

    seconds: float
    ticks: tuple[tuple[float, str], ...]
    groups: tuple[Group, ...]
    both: tuple[Span, ...]
    drawn: int
    tasks: int
    row: int = ROW


class _Axis:
    """Time to units."""

    def __init__(self, stages: Sequence[StageTotals]) -> None:
        self.begin = min(stage.start for stage in stages)
        self.seconds = max(1e-6, max(stage.stop for stage in stages) - self.begin)

    def spans(self, times: Iterable[Span]) -> list[Span]:
        """Spans in units, none thinner than can be seen, near ones as one."""
        scale = WIDTH / self.seconds
        wide = []
        for start, stop in times:
            low = min((start - self.begin) * scale, WIDTH - _THIN)
            wide.append((low, max((stop - self.begin) * scale, low + _THIN)))
        return union(wide, _GAP)


def make_timeline(
    stages: Sequence[StageTotals], records: Sequence[TaskRecord], names: dict[str, str]
) -> Timeline | None:
    """Lay the tasks of a run out; None where nothing ran.

    Parameters
    ----------
    stages
        All tasks of each stage, in the order in which they are listed.
    records
        Tasks by themselves.
    names
        {stage: what it is called on the page}.
    """
    if not stages:
        return None
    axis = _Axis(stages)
    step = nice_step(axis.seconds / 6)
    ticks = [(100 * t / axis.seconds, f"{t:.6g} s") for t in np.arange(0, axis.seconds, step)]
    groups = [_overview(axis, stages, names)]
    lanes = {name: _lanes(members) for name, members in sorted(_by_partition(records).items())}
    ran = sum((stage.resources for stage in stages), Counter())  # {partition: tasks}
    room = _shared(LANES_MOST, [len(found) for found in lanes.values()])
    for (partition, found), most in zip(lanes.items(), room, strict=True):
        drawn = sum(len(tasks) for _, _, tasks in found)
        tasks = max(ran[partition], drawn)
        rows = _workers(axis, found, most, names, tasks / drawn)
        workers = {worker for worker, _, _ in found}  # of the tasks that have a record
        workers = workers.union(*(s.workers for s in stages if s.partition == partition))
        detail = f"{counted(len(workers), 'worker')}, {counted(tasks, 'task')}"
        if tasks > drawn:  # else the gaps would pass for idleness
            detail += f", of which {drawn:,} are drawn: the gaps are not all idle time"
        groups.append(Group(partition, detail, rows))
    return Timeline(
        seconds=axis.seconds,
        ticks=tuple(ticks),
        groups=tuple(groups),
        both=tuple(_together(axis, stages)),
        drawn=len(records),
        tasks=sum(stage.tasks for stage in stages),
    )


def _overview(axis: _Axis, stages: Sequence[StageTotals], names: dict[str, str]) -> Group:
    rows = []
    for stage in stages:
        detail = (
            f"{names[stage.stage]}: {counted(stage.tasks, 'task')}, {duration(stage.seconds)} of "
            f"work within {duration(stage.stop - stage.start)}"
        )
        bars = _lines(axis.spans(stage.busy))
        rows.append(Row(names[stage.stage], detail, stage.stage, bars))
    return Group("Stages", "while at least one task ran", tuple(rows))


def _together(axis: _Axis, stages: Sequence[StageTotals]) -> list[Span]:
    """Where stage 2 and planning were both under way, in units."""
    spans = {stage.stage: axis.spans(stage.busy) for stage in stages}
    return [
        (max(a[0], b[0]), min(a[1], b[1]))
        for a in spans.get(INTERSECT, [])
        for b in spans.get(TRIAL, [])
        if min(a[1], b[1]) > max(a[0], b[0])
    ]


def _by_partition(records: Iterable[TaskRecord]) -> dict[str, list[TaskRecord]]:
    """Tasks by the partition that their worker really belonged to."""
    found: dict[str, list[TaskRecord]] = defaultdict(list)
    for record in records:
        where = record.partition if not record.misplaced else " + ".join(record.resources)
        found[where or "no partition"].append(record)
    return found


Lane = tuple[str, str, list[TaskRecord]]  # worker, stage, tasks one after the other


def _lanes(records: Iterable[TaskRecord]) -> list[Lane]:
    """Divide tasks so that those of a lane are of one worker and stage and do not overlap."""
    by_place: dict[tuple[str, str], list[list[TaskRecord]]] = defaultdict(list)
    for record in sorted(records, key=lambda record: (record.start, record.stop)):
        lanes = by_place[record.worker, record.stage]
        for lane in lanes:
            if lane[-1].stop <= record.start:
                lane.append(record)
                break
        else:
            lanes.append([record])
    return [(*place, lane) for place, lanes in by_place.items() for lane in lanes]


def _workers(
    axis: _Axis, lanes: list[Lane], most: int, names: dict[str, str], each: float
) -> tuple[Row, ...]:
    """Rows of a partition: the busiest lanes by themselves, the others together.

    `each` is the number of tasks that one with a record stands for.
    """
    lanes = sorted(lanes, key=lambda lane: -sum(task.seconds for task in lane[2]))
    shown, rest = lanes[:most], lanes[most:]
    rows = []
    for worker, stage, tasks in sorted(shown, key=lambda lane: _natural(lane[0], lane[2])):
        busy = duration(sum(task.seconds for task in tasks))
        detail = f"{worker}: {names[stage]}, {counted(len(tasks), 'task')}, {busy}"
        spans = axis.spans((task.start, task.stop) for task in tasks)
        rows.append(Row(worker, detail, stage, _lines(spans)))
    if rest:
        rows.append(_folded(axis, rest, each))
    return tuple(rows)


def _folded(axis: _Axis, lanes: list[Lane], each: float) -> Row:
    """Draw many lanes as one area: how large a share of them was busy when."""
    busy = np.zeros(SLICES)  # lanes that were busy in each slice
    for _, _, tasks in lanes:
        at_work = np.zeros(SLICES, bool)
        for start, stop in axis.spans((task.start, task.stop) for task in tasks):
            at_work[int(start * SLICES / WIDTH) : int(np.ceil(stop * SLICES / WIDTH))] = True
        busy += at_work
    high = (ROW - 4) * np.minimum(each * busy / len(lanes), 1.0)
    width = WIDTH / SLICES
    steps = "".join(f"V{ROW - 2 - level:.1f}H{(k + 1) * width:.0f}" for k, level in enumerate(high))
    label = f"and {counted(len(lanes), 'more lane')}"
    return Row(
        label, f"{label}: the share that was busy", "", f"M0 {ROW - 2}{steps}V{ROW - 2}Z", True
    )


def _lines(spans: Iterable[Span]) -> str:
    return "".join(f"M{low:.1f} {ROW / 2:g}H{high:.1f}" for low, high in spans)


def _natural(worker: str, tasks: Sequence[TaskRecord]) -> tuple[list[tuple[int, str]], float]:
    """Sort key: GPU-2 before GPU-10, lanes of a worker as they began."""
    pieces = re.split(r"(\d+)", worker)
    return [(int(p), "") if p.isdecimal() else (-1, p) for p in pieces], tasks[0].start


def _shared(room: int, wanted: Sequence[int]) -> list[int]:
    """Divide `room` so that nobody gets more than wanted and the small ones all they want."""
    given = [0] * len(wanted)
    left = room
    for position, k in enumerate(sorted(range(len(wanted)), key=lambda k: wanted[k])):
        given[k] = min(wanted[k], max(1, left // (len(wanted) - position)))
        left -= given[k]
    return given

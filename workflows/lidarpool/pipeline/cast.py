"""Stage 2: casts the rays of batches on a GPU worker, and makes their columns."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from poolpart import Recorder, TaskRecord

from ..base.arrays import Floats32
from ..base.tracing import trace
from ..columns.parts import PartColumns
from ..simulator.batch import columns_of
from ..simulator.device import DeviceReturns
from ..simulator.returns import BatchReturns
from ..simulator.rig import Rig
from .failures import naming_scans
from .messages import Span, samples_of_scan
from .names import GPU, INTERSECT
from .rigs import drop, rig_of


@dataclass(frozen=True, slots=True)
class CastWork:
    """What a casting task does for one job: cast some batches with the job's rig."""

    job: int
    handle: str  # of the rig
    spans: Sequence[Span]  # the first scan and the end of each batch


@dataclass(frozen=True)
class CastBatch:
    """Result of stage 2 for a batch."""

    job: int
    part: PartColumns
    record: TaskRecord


def intersect(
    works: Sequence[CastWork],
    unneeded: Collection[str] = (),
    scene: bytes | None = None,
    *plans: bytes | None,
) -> list[CastBatch]:
    """Cast the rays of batches and make their columns; runs on a GPU worker.

    The jobs share the still part of a scene. It is made of `scene`, and the rig of each job of its
    plan, if the worker has none; rigs and scenes that are `unneeded` are dropped before.

    Raises
    ------
    RigMissing
        If the worker has no such rig, and nothing to make it of.
    RigFailed
        If a rig cannot be made.
    ScanError
        If casting or a column fails, naming the scans.
    """
    drop(unneeded)
    done = []
    for work, plan in zip(works, plans, strict=True):
        rig = rig_of(work.handle, plan, scene)
        done += [_cast(rig, work, first, stop) for first, stop in work.spans]
    return done


def _cast(rig: Rig, work: CastWork, first: int, stop: int) -> CastBatch:
    recorder = Recorder(INTERSECT, GPU)
    about = {"run": work.handle.partition(".")[0], "stage": INTERSECT, "job": work.job}
    scans = list(range(first, stop))
    trace("intersect.start", **about, scans=scans)
    with naming_scans(first, stop):
        found = list(rig.cast(first, stop))
        trace("intersect.cast", **about, scans=scans)
        part = replace(
            columns_of(found),
            scan_hits=np.concatenate([returns.hits for returns in found]).astype(np.uint32),
            samples=np.concatenate([_samples(returns) for returns in found]),
        )
    batch = CastBatch(work.job, part, recorder.done(stop - first))
    trace("intersect.end", **about, scans=scans)
    return batch


def _samples(returns: BatchReturns | DeviceReturns) -> Floats32:
    """Sample rays: spread over the points of each scan, (scans, samples, 3); NaN if missing."""
    samples = samples_of_scan(returns.survey.scan_count)
    begins = np.cumsum(returns.counts) - returns.counts
    steps = np.arange(samples) / max(samples - 1, 1)
    last = np.maximum(returns.counts - 1, 0)
    rows = begins[:, None] + np.floor(steps * last[:, None]).astype(np.int64)
    there = (np.arange(samples) < returns.counts[:, None]) & (returns.counts[:, None] > 0)
    out = np.full((len(returns.specs), samples, 3), np.nan, np.float32)
    if len(returns):
        out[there] = returns.ends(rows[there])
    return out

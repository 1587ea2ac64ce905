"""Stage 2: casts the rays of a batch on a GPU worker, and makes its columns."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from poolpart import Recorder, TaskRecord

from ..base.tracing import trace
from ..columns.parts import PartColumns
from ..simulator.batch import columns_of
from ..simulator.device import DeviceReturns
from ..simulator.returns import BatchReturns
from ..simulator.rig import Rig
from .failures import naming_scans
from .messages import Span, samples_of_scan, summary_type
from .names import GPU, INTERSECT
from .rigs import drop, rig_of


@dataclass(frozen=True)
class CastBatch:
    """Result of stage 2 for a batch."""

    part: PartColumns
    summaries: NDArray[np.void]  # (scans,) of `messages.summary_type`
    record: TaskRecord


def intersect(
    handle: str,
    spans: Sequence[Span],
    unneeded: Collection[str] = (),
    plan: bytes | None = None,
    scene: bytes | None = None,
) -> list[CastBatch]:
    """Cast the rays of batches and make their columns; runs on a GPU worker.

    `spans` are the first scan and the end of each. `handle` is that of the survey's rig, which is
    made of `plan` and `scene` if the worker has none; `unneeded` ones are dropped before.

    Raises
    ------
    RigMissing
        If the worker has no such rig, and nothing to make it of.
    RigFailed
        If the rig cannot be made.
    ScanError
        If casting or a column fails, naming the scans.
    """
    drop(unneeded)
    rig = rig_of(handle, plan, scene)
    return [_cast(rig, handle, first, stop) for first, stop in spans]


def _cast(rig: Rig, handle: str, first: int, stop: int) -> CastBatch:
    recorder = Recorder(INTERSECT, GPU)
    scans = list(range(first, stop))
    trace("intersect.start", run=handle, stage=INTERSECT, scans=scans)
    with naming_scans(first, stop - 1):
        found = list(rig.cast(first, stop))
        trace("intersect.cast", run=handle, stage=INTERSECT, scans=scans)
        part = columns_of(found)
        summaries = np.concatenate([_summaries(returns) for returns in found])
    batch = CastBatch(part, summaries, recorder.done(stop - first))
    trace("intersect.end", run=handle, stage=INTERSECT, scans=scans)
    return batch


def _summaries(returns: BatchReturns | DeviceReturns) -> NDArray[np.void]:
    kind = summary_type(samples_of_scan(returns.survey.scan_count))
    out = np.zeros(len(returns.specs), kind)
    out["hits"], out["points"] = returns.hits, returns.counts
    # Sample rays: spread over the points of each scan, their ends in float32.
    samples = kind["samples"].shape[0]
    begins = np.cumsum(returns.counts) - returns.counts
    steps = np.arange(samples) / max(samples - 1, 1)
    last = np.maximum(returns.counts - 1, 0)
    rows = begins[:, None] + np.floor(steps * last[:, None]).astype(np.int64)
    there = (np.arange(samples) < returns.counts[:, None]) & (returns.counts[:, None] > 0)
    out["samples"] = np.nan
    if len(returns):
        out["samples"][there] = returns.ends(rows[there])
    return out

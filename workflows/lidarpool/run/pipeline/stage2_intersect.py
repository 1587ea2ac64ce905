"""Stage 2: short tasks on GPU workers that cast batches and compute the columns of their points."""

from __future__ import annotations

import logging
import os
import threading
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np
from distributed import get_worker

from lidarsim.columns.part_columns import PartColumns
from lidarsim.numerics.arrays import Floats32
from lidarsim.simulator.points.batch_columns import columns_of
from lidarsim.simulator.points.batch_points import BatchPoints
from lidarsim.simulator.points.device_columns import DevicePoints
from lidarsim.simulator.rig import Rig

from ...processes.tracing import trace
from .failures import DeviceLost, ScanError, naming_scans
from .rigs import Packed, drop, rig_of
from .stage_messages import BatchRange, samples_of_scan
from .stage_names import GPU, INTERSECT
from .task_records import Recorder, TaskRecord

logger = logging.getLogger(__name__)

LEAVE_S = 2.0  # delay before a process with a lost GPU exits, so that the driver gets the error


@dataclass(frozen=True, slots=True)
class CastWork:
    """Batches of one job in a casting task."""

    job: int
    handle: str  # handle of the rig
    spans: Sequence[BatchRange]  # first scan and stop of each batch


@dataclass(frozen=True)
class CastBatch:
    """Result of stage 2 for a batch."""

    job: int
    part: PartColumns
    record: TaskRecord


def intersect(
    works: Sequence[CastWork],
    unneeded: Collection[str] = (),
    scene: Packed | None = None,
    *plans: Packed | None,
) -> list[CastBatch]:
    """Cast the rays of batches on a GPU worker, and compute the columns of their points.

    Parameters
    ----------
    works
        Batches of each job. All jobs share the static part of a scene.
    unneeded
        Handles of rigs and scenes to drop first.
    scene
        Static part of the scene, or None if the worker already has it.
    plans
        Plan of the rig of each job, or None if the worker already has the rig.

    Raises
    ------
    RigMissing, RigFailed
        See `rig_of`.
    ScanError
        If casting or a column fails. The message names the scans.
    """
    drop(unneeded)
    results = []
    for work, plan in zip(works, plans, strict=True):
        rig = rig_of(work.handle, plan, scene)
        results += [cast_batch(rig, work, first, stop) for first, stop in work.spans]
    return results


def cast_batch(rig: Rig, work: CastWork, first: int, stop: int) -> CastBatch:
    """Cast the scans from `first` to `stop` with a rig, and compute their columns.

    All points of a run come from this function, so that a benchmark can replace it to measure
    everything else. Raise ScanError, which names the scans, if casting or a column fails.
    """
    recorder = Recorder(INTERSECT, GPU)
    fields = {"run": work.handle.partition(".")[0], "stage": INTERSECT, "job": work.job}
    scans = list(range(first, stop))
    trace("intersect.start", **fields, scans=scans)
    with exit_on_lost_device(rig), naming_scans(first, stop):
        batches = list(rig.cast(first, stop))
        trace("intersect.cast", **fields, scans=scans)
        part = replace(
            columns_of(batches),
            scan_hits=np.concatenate([returns.hit_counts for returns in batches]).astype(np.uint32),
            samples=np.concatenate([_samples(returns) for returns in batches]),
        )
    batch = CastBatch(work.job, part, recorder.finish(stop - first))
    trace("intersect.end", **fields, scans=scans)
    return batch


@contextmanager
def exit_on_lost_device(rig: Rig) -> Iterator[None]:
    """Raise DeviceLost and exit the process if the GPU stops responding in the body.

    A nanny then restarts the process, for which the GPU works again. Without a nanny, the process
    does not exit, because it may be the user's own process.
    """
    try:
        yield
    except ScanError as error:
        if not rig.device_lost:
            raise
        worker = get_worker()
        restarts = worker.nanny is not None
        logger.error("The GPU no longer responds to calls of this process: %s", error)
        if restarts:  # exit after the error has been sent
            threading.Timer(LEAVE_S, os._exit, [1]).start()
        raise DeviceLost(str(error), f"{worker.address} {os.getpid()}", restarts) from None


def _samples(returns: BatchPoints | DevicePoints) -> Floats32:
    """Return the sample points of each scan in meters.

    The array has shape (scans, samples, 3).

    Missing samples are NaN.
    """
    sample_count = samples_of_scan(returns.survey.scan_count)
    starts = np.cumsum(returns.counts) - returns.counts
    steps = np.arange(sample_count) / max(sample_count - 1, 1)
    last = np.maximum(returns.counts - 1, 0)
    rows = starts[:, None] + np.floor(steps * last[:, None]).astype(np.int64)
    valid = np.arange(sample_count) < returns.counts[:, None]
    samples = np.full((len(returns.specs), sample_count, 3), np.nan, np.float32)
    if len(returns):
        samples[valid] = returns.positions_of(rows[valid])
    return samples

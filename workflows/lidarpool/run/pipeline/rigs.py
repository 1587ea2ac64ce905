"""Casting of batches on GPU workers (stage 2), with a rig that each process builds once.

A casting task refers to the rig of its job by a handle. The first task of a job on a worker also
contains the plan of the rig and the scene. The worker keeps the rig in `cached_rigs`, together with
the scene and its trees for other jobs with the same scene. Rigs are not results of Dask tasks,
because Dask drops a result when no task needs it, and each new copy would have to build its trees
again.
"""

from __future__ import annotations

import logging
import os
import pickle
import threading
import time
from collections import deque
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from distributed import get_worker

from lidarsim.columns.part_columns import PartColumns
from lidarsim.numerics.arrays import Floats32
from lidarsim.scene.scene import Scene
from lidarsim.simulator.points.batch_columns import columns_of
from lidarsim.simulator.points.batch_points import BatchPoints
from lidarsim.simulator.points.device_columns import DevicePoints
from lidarsim.simulator.rig import Rig
from lidarsim.survey.survey import Survey
from poolpart import own_device, own_device_share
from raybeam.registry import choose_backend

from ...processes.shared_memory import Pickled, SharedHandle
from ...processes.tracing import trace
from .failures import DeviceLost, ScanError, naming_scans
from .stage_messages import BatchRange, samples_of_scan
from .stage_names import GPU, INTERSECT
from .task_records import Recorder, TaskRecord

logger = logging.getLogger(__name__)

Packed = Pickled | SharedHandle  # plan or scene as received from the driver

LEAVE_S = 2.0  # delay before a process with a lost GPU exits, so that the driver gets the error
UNUSED_S = 600.0  # rigs that have been unused for longer are dropped when a new rig is built


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


# -- the rigs of this process -----------------------------------------------------------------


class RigMissing(RuntimeError):  # noqa: N818 - the name states what happened
    """Raised if a worker no longer has a rig or scene, for example after a restart."""


class MemoryUnseen(RigMissing):
    """Raised if a worker cannot access the shared memory of the driver."""


class RigFailed(RuntimeError):  # noqa: N818
    """Raised if the rig of a survey cannot be built."""


@dataclass(eq=False)
class _CachedRig:
    """Rig that is cached for a job or a scene, with the time of its last use."""

    rig: Rig
    scene: str  # handle of the scene
    used_at: float  # monotonic time


# Rigs in this process by the handle of the rig. The handle of a scene maps to any of its rigs.
cached_rigs: dict[str, _CachedRig] = {}
_ended_runs: deque[str] = deque(maxlen=64)  # runs whose remaining tasks must not cache rigs
_lock = threading.Lock()


def rig_of(handle: str, plan: Packed | None = None, scene: Packed | None = None) -> Rig:
    """Return a cached rig, or build the rig from a plan and a scene.

    Raises
    ------
    RigMissing
        If the rig is not cached and no plan is given, or if its scene is neither cached nor given.
    RigFailed
        If the rig cannot be built.
    """
    cached = cached_rigs.get(handle)
    if cached is None:
        with _lock:
            cached = cached_rigs.get(handle)
            if cached is None:
                cached = cached_rigs[handle] = _build(handle, plan, scene)
                if (run := handle.partition(".")[0]) in _ended_runs:
                    drop_all(run)
    its_scene = cached_rigs.get(cached.scene, cached)
    cached.used_at = its_scene.used_at = time.monotonic()
    return cached.rig


def _build(handle: str, plan: Packed | None, scene: Packed | None) -> _CachedRig:
    """Build the rig of a job, and cache it for other jobs with the same scene.

    Rigs that have been unused for a long time are dropped first. If a rig of the same scene is
    cached, the new rig shares its trees. The errors are those of `rig_of`.

    Parameters
    ----------
    handle
        Handle of the rig.
    plan
        Handle of the scene, actors, pickled survey, and name of the backend.
    scene
        Scene without actors.
    """
    if plan is None:
        raise RigMissing(f"This worker has no rig {handle!r}.")
    try:
        scene_handle, actors, pickled_survey, backend = _unpickle(plan)
        survey: Survey = pickle.loads(pickled_survey)  # noqa: S301
        now_s = time.monotonic()
        unused = {h for h, cached in [*cached_rigs.items()] if now_s - cached.used_at > UNUSED_S}
        drop(unused - {scene_handle})
        if (of_scene := cached_rigs.get(scene_handle)) is not None:
            rig = of_scene.rig.with_survey(of_scene.rig.scene.with_actors(actors), survey)
        elif scene is not None:
            static_scene: Scene = _unpickle(scene)
            threads = get_worker().state.nthreads
            device = own_device()
            if device is not None:
                choose_backend(backend).limit_memory(device, own_device_share())
            rig = Rig(static_scene.with_actors(actors), survey, backend, threads, device)
        else:
            raise RigMissing(f"This worker has no scene {scene_handle!r}.")
    except RigMissing:
        raise
    except Exception as error:
        raise RigFailed(str(error) or type(error).__name__) from error
    cached_rigs[scene_handle] = _CachedRig(rig, scene_handle, time.monotonic())
    trace("intersect.built", run=handle, stage="intersect", scans=[])
    return _CachedRig(rig, scene_handle, time.monotonic())


def drop(handles: Collection[str]) -> None:
    """Drop the cached rigs and scenes with the given handles, ignoring unknown handles."""
    for handle in handles:
        cached_rigs.pop(handle, None)


def drop_all(run: str) -> None:
    """Drop the rigs and scenes of a run that has ended."""
    _ended_runs.append(run)
    # The lock is not acquired, because this runs in the event loop of the worker, and building a
    # tree while holding the lock takes a long time.
    drop([handle for handle in [*cached_rigs] if handle.partition(".")[0] == run])


def _unpickle(data: Packed) -> Any:
    """Unpickle a value from the driver, or raise MemoryUnseen if its memory is inaccessible."""
    if isinstance(data, SharedHandle):
        try:
            return data.load()
        except OSError as error:
            raise MemoryUnseen(f"This worker cannot access the driver's memory: {error}") from error
    return data.load()

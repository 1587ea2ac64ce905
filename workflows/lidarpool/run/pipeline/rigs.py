"""Stage 2: casts batches on GPU workers, with rigs that each worker process builds once.

A casting task names the rig of its job. The first task of a job on a worker contains the plan of
the rig and the scene. The worker keeps the rig in `cached_rigs`, and the scene with its trees for
other jobs of the same scene. Rigs are not results of Dask tasks, because Dask drops a copy as soon
as no task needs it, and each new copy would have to build its tree again.
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

Packed = Pickled | SharedHandle  # a plan or a scene, as it comes from the driver

LEAVE_S = 2.0  # a process ends so long after the error of a GPU: the driver knows it by then
UNUSED_S = 600.0  # rigs unused for longer, as of a killed driver, are dropped when one is built


@dataclass(frozen=True, slots=True)
class CastWork:
    """Batches of a job that a casting task casts with the job's rig."""

    job: int
    handle: str  # handle of the rig
    spans: Sequence[BatchRange]  # the first scan and the end of each batch


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
    """Cast the rays of batches and make their columns, on a GPU worker.

    The jobs share the static part of a scene. If the worker has no copy, the static part is
    unpickled from `scene`, and the rig of each job from its plan; rigs and scenes in `unneeded` are
    dropped before.

    Raises RigMissing and RigFailed as `rig_of` does, and ScanError, which names the scans, if
    casting or a column fails.
    """
    drop(unneeded)
    results = []
    for work, plan in zip(works, plans, strict=True):
        rig = rig_of(work.handle, plan, scene)
        results += [cast_batch(rig, work, first, stop) for first, stop in work.spans]
    return results


def cast_batch(rig: Rig, work: CastWork, first: int, stop: int) -> CastBatch:
    """Cast the scans from `first` to `stop` with a rig, and make the columns of their points.

    All points of a run come from this function: a benchmark that replaces it on casting workers
    measures what comes after. ScanError if casting or a column fails, naming the scans.
    """
    recorder = Recorder(INTERSECT, GPU)
    fields = {"run": work.handle.partition(".")[0], "stage": INTERSECT, "job": work.job}
    scans = list(range(first, stop))
    trace("intersect.start", **fields, scans=scans)
    with leaving_with_device(rig), naming_scans(first, stop):
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
def leaving_with_device(rig: Rig) -> Iterator[None]:
    """Raise DeviceLost for an error after which the rig's GPU does not answer, and end the process.

    A nanny starts another process, whose calls the GPU answers. Without a nanny the process stays,
    since it may be the user's process.
    """
    try:
        yield
    except ScanError as error:
        if not rig.device_lost:
            raise
        worker = get_worker()
        restarts = worker.nanny is not None
        logger.error("The GPU no longer responds to calls of this process: %s", error)
        if restarts:  # when the error has been sent
            threading.Timer(LEAVE_S, os._exit, [1]).start()
        raise DeviceLost(str(error), f"{worker.address} {os.getpid()}", restarts) from None


def _samples(returns: BatchPoints | DevicePoints) -> Floats32:
    """Return sample points of each scan in meters, (scans, samples, 3), with NaN if missing."""
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


class RigMissing(RuntimeError):  # noqa: N818 - reads as what happened
    """Error for a rig or scene that a worker lacks, after a restart or because it was dropped."""


class MemoryUnseen(RigMissing):
    """Error for a scene in memory of the driver that a worker cannot map."""


class RigFailed(RuntimeError):  # noqa: N818
    """Error for a survey whose rig cannot be built."""


@dataclass(eq=False)
class _CachedRig:
    """A rig for a job, or for its scene, with the time of its last use."""

    rig: Rig
    scene: str  # handle
    used_at: float  # monotonic time


# {handle of a rig, or of a scene: a rig of it in this process}
cached_rigs: dict[str, _CachedRig] = {}
_ended_runs: deque[str] = deque(maxlen=64)  # tasks that still cast for them cache no rig
_lock = threading.Lock()


def rig_of(handle: str, plan: Packed | None = None, scene: Packed | None = None) -> Rig:
    """Return a rig of this process, built from a plan and scene if the rig is not cached.

    Raises RigMissing if the rig is not cached and has no plan, or if its scene is not cached
    either, and RigFailed if the rig cannot be built.
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
    """Build the rig of a job, and cache it for other jobs of its scene.

    `plan` has the handle of the scene, the actors, the survey, pickled, and the name of the
    backend; `scene` is the scene without actors. If a rig of the scene is cached, the new rig
    shares its trees. Rigs that were unused for long are dropped before.

    Raises RigMissing and RigFailed as `rig_of` does.
    """
    if plan is None:
        raise RigMissing(f"This worker has no rig {handle!r}.")
    try:
        scene_handle, actors, pickled_survey, backend = _unpickled(plan)
        survey: Survey = pickle.loads(pickled_survey)  # noqa: S301
        now_s = time.monotonic()
        unused = {h for h, cached in [*cached_rigs.items()] if now_s - cached.used_at > UNUSED_S}
        drop(unused - {scene_handle})
        if (of_scene := cached_rigs.get(scene_handle)) is not None:
            rig = of_scene.rig.with_survey(of_scene.rig.scene.with_actors(actors), survey)
        elif scene is not None:
            static_scene: Scene = _unpickled(scene)
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
    """Drop cached rigs and scenes by their handles, and ignore unknown handles."""
    for handle in handles:
        cached_rigs.pop(handle, None)


def drop_all(run: str) -> None:
    """Drop the rigs and scenes of a run that has ended."""
    _ended_runs.append(run)
    # Without the lock: this runs in the worker's event loop, and a tree takes long to build.
    drop([handle for handle in [*cached_rigs] if handle.partition(".")[0] == run])


def _unpickled(data: Packed) -> Any:
    """Return a value of the run's own driver, or raise MemoryUnseen if it is out of reach."""
    if isinstance(data, SharedHandle):
        try:
            return data.load()
        except OSError as error:
            raise MemoryUnseen(f"This worker cannot access the driver's memory: {error}") from error
    return data.load()

"""Stage 2: rigs of GPU workers, and the casting of batches with them.

Each worker process makes the rig of a job once, and casting tasks name it. The first task of a job
on a worker brings what the rig is made of; the worker keeps it in a table of this module, and the
scene with its trees for other jobs of the same scene. A task's result would not work: Dask drops
copies that no task needs at an instant, and every new copy would build its tree again.
"""

from __future__ import annotations

import pickle
import threading
import time
from collections import deque
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
from distributed import get_worker

from lidarsim.base.arrays import Floats32
from lidarsim.columns.part_columns import PartColumns
from lidarsim.scene.scene import Scene
from lidarsim.sensor import Survey
from lidarsim.simulator.batch import columns_of
from lidarsim.simulator.device import DevicePoints
from lidarsim.simulator.points import BatchPoints
from lidarsim.simulator.rig import Rig
from poolpart import own_device

from ...base.tracing import trace
from .failures import naming_scans
from .messages import BatchRange, samples_of_scan
from .names import GPU, INTERSECT
from .placement import Recorder, TaskRecord

UNUSED_S = 600.0  # a rig unused for so long, as of a killed driver, goes when another is made


class RigMissing(RuntimeError):  # noqa: N818 - reads as what happened
    """The worker has no such rig, or its scene: it was restarted, or has dropped it."""


class RigFailed(RuntimeError):  # noqa: N818
    """The rig of a survey cannot be made."""


@dataclass(eq=False)
class _Kept:
    """A rig, or a scene with one of its rigs, and when it was asked for."""

    rig: Rig
    scene: str  # handle
    used_at: float


_kept: dict[str, _Kept] = {}  # {handle of a rig, or of a scene: a rig of it in this process}
_ended: deque[str] = deque(maxlen=64)  # runs: a task that is still casting for one keeps nothing
_lock = threading.Lock()


def rig_of(handle: str, plan: bytes | None = None, scene: bytes | None = None) -> Rig:
    """Return a rig of this process, made of a plan and scene if there is none.

    RigMissing if it is not there, or its scene is not, and nothing to make it of; RigFailed if it
    cannot be made.
    """
    kept = _kept.get(handle)
    if kept is None:
        with _lock:
            kept = _kept.get(handle)
            if kept is None:
                kept = _kept[handle] = _made(handle, plan, scene)
                if (run := handle.partition(".")[0]) in _ended:
                    drop_all(run)
    its_scene = _kept.get(kept.scene, kept)
    kept.used_at = its_scene.used_at = time.monotonic()
    return kept.rig


def _made(handle: str, plan: bytes | None, scene: bytes | None) -> _Kept:
    if plan is None:
        raise RigMissing(f"This worker has no rig {handle!r}.")
    try:
        name, actors, packed, backend = pickle.loads(plan)  # noqa: S301 - of the run's own driver
        survey: Survey = pickle.loads(packed)  # noqa: S301
        now = time.monotonic()
        drop([h for h, one in [*_kept.items()] if now - one.used_at > UNUSED_S and h != name])
        if (found := _kept.get(name)) is not None:
            rig = found.rig.with_survey(found.rig.scene.with_actors(actors), survey)
        elif scene is not None:
            still: Scene = pickle.loads(scene)  # noqa: S301
            threads = get_worker().state.nthreads
            rig = Rig(still.with_actors(actors), survey, backend, threads, own_device())
        else:
            raise RigMissing(f"This worker has no scene {name!r}.")
    except RigMissing:
        raise
    except Exception as error:
        raise RigFailed(str(error) or type(error).__name__) from error
    _kept[name] = _Kept(rig, name, time.monotonic())
    trace("intersect.built", run=handle, stage="intersect", scans=[])
    return _Kept(rig, name, time.monotonic())


def drop(handles: Collection[str]) -> None:
    """Drop rigs and scenes; those that are not there are skipped."""
    for handle in handles:
        _kept.pop(handle, None)


def drop_all(run: str) -> None:
    """Drop the rigs and scenes of a run that has ended."""
    _ended.append(run)
    # Without the lock: this runs in the worker's event loop, and a tree takes long to build.
    drop([handle for handle in [*_kept] if handle.partition(".")[0] == run])


@dataclass(frozen=True, slots=True)
class CastWork:
    """What a casting task does for one job: cast some batches with the job's rig."""

    job: int
    handle: str  # of the rig
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


def _samples(returns: BatchPoints | DevicePoints) -> Floats32:
    """Sample rays: spread over the points of each scan, (scans, samples, 3); NaN if missing."""
    samples = samples_of_scan(returns.survey.scan_count)
    begins = np.cumsum(returns.counts) - returns.counts
    steps = np.arange(samples) / max(samples - 1, 1)
    last = np.maximum(returns.counts - 1, 0)
    rows = begins[:, None] + np.floor(steps * last[:, None]).astype(np.int64)
    there = (np.arange(samples) < returns.counts[:, None]) & (returns.counts[:, None] > 0)
    out = np.full((len(returns.specs), samples, 3), np.nan, np.float32)
    if len(returns):
        out[there] = returns.positions_of(rows[there])
    return out

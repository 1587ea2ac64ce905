"""Rigs, which each process on a GPU worker builds once for all casting tasks of a job.

A casting task refers to the rig of its job by a handle. The first task of a job on a worker also
contains the plan of the rig and the scene. The worker keeps the rig in `cached_rigs`, together with
the scene and its trees for other jobs with the same scene. Rigs are not results of Dask tasks,
because Dask drops a result when no task needs it, and each new copy would have to build its trees
again.
"""

from __future__ import annotations

import pickle
import threading
import time
from collections import deque
from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

from distributed import get_worker

from lidarsim.scene.scene import Scene
from lidarsim.simulator.rig import Rig
from lidarsim.survey.survey import Survey
from poolpart import own_device, own_device_share
from raybeam.registry import choose_backend

from ...processes.shared_memory import Pickled, SharedHandle
from ...processes.tracing import trace

Packed = Pickled | SharedHandle  # plan or scene as received from the driver

UNUSED_S = 600.0  # rigs that have been unused for longer are dropped when a new rig is built


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

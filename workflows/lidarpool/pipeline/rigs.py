"""Rigs of GPU workers: each process makes a survey's rig once, and casting tasks name it.

A task bound to the worker makes it and keeps it in a table of this module. A task's result would
not work: Dask drops copies that no task needs at an instant, and every new copy would build its
tree again.
"""

from __future__ import annotations

import pickle
import threading
import time
from dataclasses import dataclass

import cloudpickle
from distributed import get_worker

from poolpart import own_device

from ..base.tracing import trace
from ..scene.scene import Scene
from ..sensor import Survey
from ..simulator.rig import Rig

UNUSED_S = 600.0  # a rig unused for so long is dropped when another is made


@dataclass(frozen=True, eq=False)
class RigPlan:
    """Description of a rig; its backend is the same on all workers."""

    scene: Scene
    survey: Survey
    backend: str

    def packed(self) -> bytes:
        """Bytes to send to workers, which check their version before they unpickle them."""
        # Sensors and columns of a user's script, including lambdas, are sent by value.
        return cloudpickle.dumps(self, protocol=5)


class RigMissing(RuntimeError):  # noqa: N818 - reads as what happened
    """The worker has no such rig: it was restarted, or has dropped it."""


_rigs: dict[str, Rig] = {}  # {handle: the rig of this process}
_used_at: dict[str, float] = {}  # {handle: when it was asked for}
_lock = threading.Lock()


def set_up(handle: str, packed: bytes) -> None:
    """Make a rig in this process, unless it exists; runs on a GPU worker."""
    with _lock:
        if handle in _rigs:
            return
        now = time.monotonic()
        for other in [h for h, used_at in list(_used_at.items()) if now - used_at > UNUSED_S]:
            drop_rig(other)
        plan: RigPlan = pickle.loads(packed)  # noqa: S301 - of the run's own driver, by Dask
        threads = get_worker().state.nthreads
        _rigs[handle] = Rig(plan.scene, plan.survey, plan.backend, threads, own_device())
        _used_at[handle] = time.monotonic()
        trace("intersect.built", run=handle, stage="intersect", scans=[])


def rig_of(handle: str) -> Rig:
    """Return a rig of this process; RigMissing if there is none."""
    rig = _rigs.get(handle)
    if rig is None:
        raise RigMissing(f"This worker has no rig {handle!r}.")
    _used_at[handle] = time.monotonic()
    return rig


def drop_rig(handle: str) -> None:
    """Drop a rig; no error if there is none."""
    _rigs.pop(handle, None)
    _used_at.pop(handle, None)

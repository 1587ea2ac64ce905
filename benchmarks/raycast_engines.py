"""Who takes part in benchmarks/raycast.py: our backends, and what one would use instead.

Each engine is asked whether it is missing, then prepared with a job, which builds its tree and
is not timed; what it returns casts all the job's rays and is timed. It returns how many rays
hit, so that no engine is fast by being wrong.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from raybeam import Pattern, RayCaster, available_backends

from .raycast_scenes import Job

Float = NDArray[np.float64]
Cast = Callable[[], int]


class Engine(ABC):
    """One way to cast rays."""

    name: ClassVar[str]
    is_raybeam: ClassVar[bool] = False
    # Brute force is not what anybody would use instead; it is there to be divided by.
    peer: ClassVar[bool] = True

    def __init__(self, threads: int) -> None:
        self.threads = threads

    @abstractmethod
    def missing(self) -> str:
        """Why it cannot take part; "" when it can."""

    @abstractmethod
    def prepare(self, job: Job) -> Cast:
        """Build what it needs once for a mesh."""

    def rays(self, job: Job) -> int:
        """How many of the job's rays it casts in one call."""
        return job.rays


class _RaybeamEngine(Engine):
    """Poses in, hits out: makes the rays, casts them and gathers the hits."""

    is_raybeam = True
    peer = False

    def missing(self) -> str:
        """See `Engine.missing`."""
        return available_backends()[self.name]

    def prepare(self, job: Job) -> Cast:
        """See `Engine.prepare`."""
        caster = RayCaster(job.vertices, job.faces, self.name, threads=self.threads)
        pattern = Pattern(job.directions)
        return lambda: sum(
            len(caster.scan(pattern, origin, job.rotation)) for origin in job.origins
        )


class Numpy(_RaybeamEngine):
    """The numpy backend."""

    name = "numpy"


class Embree(_RaybeamEngine):
    """The embree backend."""

    name = "embree"


class Cuda(_RaybeamEngine):
    """The cuda backend, hits copied to the host."""

    name = "cuda"


class BruteForce(Engine):
    """Every ray against every triangle in NumPy, on as many rays as a moment allows."""

    name = "brute force, NumPy"
    peer = False

    def missing(self) -> str:
        """See `Engine.missing`."""
        return ""

    def rays(self, job: Job) -> int:
        """See `Engine.rays`."""
        return min(len(job.directions), max(4, 4_000_000 // len(job.faces)))

    def prepare(self, job: Job) -> Cast:
        """See `Engine.prepare`."""
        first, second, third = (job.vertices[job.faces[:, k]] for k in range(3))
        first_edge = second - first
        second_edge = third - first
        step = len(job.directions) // self.rays(job)
        directions = (job.directions @ job.rotation.T)[::step][: self.rays(job)]
        from_corner = job.origins[0] - first
        q = np.cross(from_corner, first_edge)
        height = (second_edge * q).sum(axis=1)

        def is_hit(direction: Float) -> bool:
            # Moeller and Trumbore (1997); what depends on the origin only is worked out before.
            p = np.cross(direction, second_edge)
            with np.errstate(divide="ignore", invalid="ignore"):
                inverse = 1 / (first_edge * p).sum(axis=1)
                u = (from_corner * p).sum(axis=1) * inverse
                v = (q @ direction) * inverse
                t = height * inverse
            return bool(((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)).any())

        return lambda: sum(map(is_hit, directions))

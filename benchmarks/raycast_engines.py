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
    """Engine that casts rays."""

    name: ClassVar[str]
    is_raybeam: ClassVar[bool] = False
    # Brute force is not what anybody would use instead; it is there to be divided by.
    peer: ClassVar[bool] = True

    def __init__(self, threads: int) -> None:
        self.threads = threads

    @abstractmethod
    def missing(self) -> str:
        """Return the reason why the engine is not available, or an empty string."""

    @abstractmethod
    def prepare(self, job: Job) -> Cast:
        """Build the engine's tree; return a function that casts the job's rays and counts hits."""

    def rays(self, job: Job) -> int:
        """Return the number of rays that a call casts."""
        return job.rays


class _RaybeamEngine(Engine):
    """Backend of raybeam, from poses to hits: makes the rays, casts them and gathers hits."""

    is_raybeam = True
    peer = False

    def missing(self) -> str:
        """Return why the backend is not available, or an empty string."""
        return available_backends()[self.name]

    def prepare(self, job: Job) -> Cast:
        """Build a `RayCaster`; return a function that scans from all origins."""
        caster = RayCaster(job.vertices, job.faces, self.name, threads=self.threads)
        pattern = Pattern(job.directions)
        return lambda: sum(
            len(caster.scan(pattern, origin, job.rotation)) for origin in job.origins
        )


class Numpy(_RaybeamEngine):
    """Backend `numpy`."""

    name = "numpy"


class Tiles(_RaybeamEngine):
    """Backend `tiles`."""

    name = "tiles"


class Cuda(_RaybeamEngine):
    """Backend `cuda`, with hits copied to the host."""

    name = "cuda"


class BruteForce(Engine):
    """Brute force in NumPy: a subset of the rays against all triangles."""

    name = "brute force, NumPy"
    peer = False

    def missing(self) -> str:
        """Return an empty string: NumPy is installed."""
        return ""

    def rays(self, job: Job) -> int:
        """Return the size of the subset that a moment allows."""
        return min(len(job.directions), max(4, 4_000_000 // len(job.faces)))

    def prepare(self, job: Job) -> Cast:
        """Compute edges and products of the origin; return a function that casts the subset."""
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

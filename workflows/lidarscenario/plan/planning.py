"""Planning problems, each with two end points, discs to avoid and the search effort."""

from __future__ import annotations

import reprlib
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike

from lidarsim.errors import LidarError
from lidarsim.numerics.arrays import Floats
from lidarsim.schema.checks import check_fields
from lidarsim.schema.declared import Seed, about
from lidarsim.schema.value_texts import one_line

from .geometry import segment_distances


@dataclass(frozen=True, eq=False, kw_only=True)
class Search:
    """Effort of a search with particle swarms.

    With more waypoints, a path can go around more discs. The run time is proportional to the number
    of waypoints, and the swarms converge more slowly.
    """

    trials: Annotated[
        int, about("number of particle swarms, each with its own seed", ge=1, le=10**6)
    ] = 100
    particles: Annotated[int, about("number of particles in a swarm", ge=1, le=10_000_000)] = 1000
    iterations: Annotated[int, about("number of iterations of a swarm", ge=1, le=1_000_000)] = 300
    waypoints: Annotated[
        int, about("number of corners of the path between start and target", ge=1, le=100)
    ] = 5
    seed: Annotated[Seed, about("random seed; the same seed results in the same path")] = 0


@dataclass(frozen=True, eq=False)
class Planning(Search):
    """Search for a path in the plane from `start` to `target` that avoids all discs.

    The search uses `trials` independent particle swarms (`run_trial`).

    Parameters
    ----------
    start, target
        x and y of the start and of the target, in meters.
    centers
        Centers of the discs to avoid, in meters. Shape (m, 2), where m may be 0.
    radii
        Radii of the discs in meters, greater than 0. Shape (m,), or one number for all discs.
    **search
        The fields of `Search`. The same seed produces the same plan, bit for bit, on all workers.

    Raises
    ------
    LidarError
        If the start or the target is within a disc, if they are the same point, or if a value is
        out of range.

    Examples
    --------
    >>> planning = Planning((0, 0), (10, 0), centers=[(5, 0)], radii=2.0)
    >>> planning.radii
    array([2.])
    """

    start: tuple[float, float] = (25.0, 25.0)
    target: tuple[float, float] = (-30.0, -20.0)
    centers: Floats = field(default_factory=lambda: np.empty((0, 2)))  # (m, 2), meters
    radii: Floats = field(default_factory=lambda: np.empty(0))  # (m,), meters

    __repr__ = one_line

    def __post_init__(self) -> None:
        check_fields(self)
        start, target = ((float(x), float(y)) for x, y in (self.start, self.target))
        if start == target:
            raise LidarError(
                f"The start and the target of the path are both {start}. Move one of them."
            )
        centers = _checked(
            "centers",
            self.centers,
            lambda n: n.size == 0 or (n.ndim == 2 and n.shape[1] == 2),
            "finite numbers with the shape (m, 2)",
        ).reshape(-1, 2)
        radii = _checked(
            "radii",
            self.radii,
            lambda n: n.shape in ((), (len(centers),)) and bool((n > 0).all()),
            "positive finite numbers, one for each disc or one for all discs",
        )
        radii = np.broadcast_to(radii, len(centers)).copy()
        for array in (centers, radii):
            array.setflags(write=False)
        _check_outside({"start": start, "target": target}, centers, radii)
        for name, value in (
            ("start", start),
            ("target", target),
            ("centers", centers),
            ("radii", radii),
        ):
            object.__setattr__(self, name, value)


def _checked(
    name: str, value: ArrayLike, fits: Callable[[Floats], bool], requirement: str
) -> Floats:
    """Convert `value` to a new array, or raise LidarError if it is invalid.

    The numbers must be finite, and `fits` must return True for them.
    """
    try:
        numbers = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        numbers = np.array(np.nan)
    if not (np.isfinite(numbers).all() and fits(numbers)):
        raise LidarError(f"`planning.{name}` is {reprlib.repr(value)}; it must be {requirement}.")
    return numbers


def _check_outside(
    end_points: dict[str, tuple[float, float]], centers: Floats, radii: Floats
) -> None:
    """Raise LidarError if a disc contains an end point of the path."""
    for name, end in end_points.items():
        point = np.array([end])
        within = np.flatnonzero(segment_distances(point, point, centers)[0] < radii)
        if len(within):
            disc = int(within[0])
            x, y = centers[disc]
            raise LidarError(
                f"The {name} of the path ({end[0]:g}, {end[1]:g}) lies within disc {disc}, "
                f"which has the center ({x:g}, {y:g}) and the radius {radii[disc]:g}. Move "
                f"the {name} out of the disc."
            )

"""What looks like a mistake in a survey that can be run: sizes in a wrong unit, hidden poses."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Sequence

import numpy as np

from ..scene.floor import between
from ..scene.scene import Scene
from ..sensor import Survey
from .sampling import Sample

# Halls and parts are smaller than the one and larger than the other in metres.
LARGE_M = 500.0
SMALL_M = 0.2

_LOOKED_AT = 100  # poses, for ceilings between them
_SHOWN = 3  # names or poses that a note lists; places that are looked at


def advice(
    scene: Scene, survey: Survey, unitless: Sequence[str], sample: Sample | None = None
) -> Iterator[str]:
    """Yield notes for whoever wrote the scenario, each with what to do.

    Parameters
    ----------
    scene, survey
        What is to be scanned, and how.
    unitless
        Names of mesh files whose unit is neither stated nor given.
    sample
        Some rays of it; None where none were cast.
    """
    side = float(np.ptp(scene.bounds, axis=0).max())
    if unitless and not SMALL_M <= side <= LARGE_M:
        likely = "mm" if side > LARGE_M else "km"
        init = f"lidarpool init DIR --mesh {shlex.quote(unitless[0])} --unit {likely}"
        yield (
            f"{_listed(unitless)} {'state' if len(unitless) > 1 else 'states'} no unit, and in "
            f"metres the scene is {in_metres(side)} m long: if that is wrong, give the file's "
            f"unit in scene.files, or begin with: {init}"
        )
    world = scene.vertices + scene.origin
    step = float(np.spacing(np.float32(np.abs(world).max())))
    # Farther out, single precision, as .stl and .glb hold it, is coarser than what is asked for.
    if step > survey.precision_m and np.array_equal(world, world.astype(np.float32)):
        yield (
            f"the coordinates of the scene are in single precision, and so far out they come in "
            f"steps of {in_metres(step)} m: export the mesh nearer to zero, and move it with "
            "translation in scene.files"
        )
    yield from _ceilings(scene, survey)
    if sample is None:
        return
    if not sample.hits:
        yield (
            "no ray cast here hit anything: look at poses, ranges and units; the scene reaches "
            f"from {_point(scene.bounds[0] + scene.origin)} to "
            f"{_point(scene.bounds[1] + scene.origin)}"
        )
    if sample.behind:
        places = [_point(survey.path.pose(i).position + scene.origin) for i in sample.behind]
        yield (
            f"from {_listed(places)} nearly all that is seen are backs of triangles, as in a "
            "room that is drawn as a solid box: if the sensor should not stand within something, "
            "or below the ground, give other poses"
        )


def _ceilings(scene: Scene, survey: Survey) -> Iterator[str]:
    """Note sensors that are raised at one place until they stand on another floor.

    The heights of sensors for which no poses are given fit a hall, and not every room.
    """
    heights: dict[tuple[float, float], list[float]] = {}  # {place: of the sensors there}
    for station in range(min(survey.path.stations, _LOOKED_AT)):
        pose = survey.path.pose(station)
        x, y, z = (pose.position + scene.origin).tolist()
        heights.setdefault((x, y), []).append(z)
    raised = [(place, min(zs), max(zs)) for place, zs in heights.items() if len(zs) > 1]
    for (x, y), low, high in raised[:_SHOWN]:
        if between(scene, x, y, low, high):
            yield (
                f"something is between {_point(np.array((x, y, low)))} and "
                f"{_point(np.array((x, y, high)))}: if it is a ceiling and the sensor should be "
                "below it, give other poses"
            )
            return


def _listed(words: Sequence[str]) -> str:
    """List some words, and how many more there are."""
    more = len(words) - _SHOWN
    return ", ".join(words[:_SHOWN]) + (f" and {more:,} more" if more > 0 else "")


def _point(position: np.ndarray[tuple[int], np.dtype[np.float64]]) -> str:
    return f"({', '.join(map(in_metres, position))})"


def in_metres(length: float) -> str:
    """Length with as many digits as tell something: 0.0052, 8.1, 350.25, 4,000,120.

    Examples
    --------
    >>> [in_metres(length) for length in (0, 0.00521, -8.1, 350.254, 4_000_120.4)]
    ['0', '0.0052', '-8.1', '350.25', '4,000,120']
    """
    length = float(length)
    if abs(length) >= 1000:
        return f"{length:,.0f}"
    text = f"{length:.2f}" if abs(length) >= 0.1 else f"{length:.2g}"
    return text.rstrip("0").rstrip(".") if "." in text else text

"""How many points a survey will give, from casting a few of its rays in this process."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from raybeam import Pattern, RayCaster

from ..base.choice import one_of_each_part
from ..scene.scene import Scene
from ..sensor import Survey

# Rays that are cast at most; what that takes is much less than starting a cluster.
RAYS_MOST = {"numpy": 20_000}
RAYS_MOST_ELSE = 200_000
SCANS_MOST = 500
# Of the hits seen from a pose, what makes one believe that it stands within something.
BEHIND_SHARE = 0.95

_SEED = 0  # the same survey gets the same estimate


@dataclass(frozen=True)
class Sample:
    """What some rays of a survey say of all.

    Parameters
    ----------
    backend
        Ray-casting backend that was used.
    rays
        Rays that were cast.
    hits, points
        Of the whole survey, estimated; counted if all of its rays were cast.
    behind
        Numbers of the stations from which nearly all hits are on the backs of triangles.
    """

    backend: str
    rays: int
    hits: int
    points: int
    behind: tuple[int, ...] = ()


def sample_survey(scene: Scene, survey: Survey, backend: str = "auto") -> Sample:
    """Estimate hits and points of a survey.

    Scans, and rays of each, are chosen at random, one from each of as many equal parts: chosen
    at even distances, they could all be of one ring, or look one way.

    Parameters
    ----------
    scene, survey
        What to scan, and how.
    backend
        Ray-casting backend; "auto" for the fastest that there is here.

    Raises
    ------
    BackendUnavailable
        If the backend cannot be used here.
    """
    rng = np.random.default_rng(_SEED)
    caster = RayCaster(scene.vertices, scene.faces, backend=backend)
    most = RAYS_MOST.get(caster.backend, RAYS_MOST_ELSE)
    scans = one_of_each_part(survey.scan_count, SCANS_MOST, rng)
    each = most if survey.ray_count <= most else max(1, most // len(scans))
    cast = 0
    hits, points = [], []  # of each of these scans
    seen = np.zeros((survey.path.stations, 2))  # hits from each station, on front and back
    for index in scans.tolist():
        spec = survey.scan(index)
        count = spec.ray_count(survey.sensor)
        rays = one_of_each_part(count, each, rng)
        origins, directions = _rays(survey, index, rays)
        found = caster.returns(
            origins,
            directions,
            survey.sensor.min_range_m,
            survey.sensor.max_range_m,
        )
        backs = _on_backs(scene, directions[found.ray], found.triangle)
        seen[index // survey.steps] += (len(found.ray) - backs, backs)
        cast += len(rays)
        hits.append(len(found.ray) * count / len(rays))
        points.append(_kept(hits[-1], survey.keep_every, len(rays) == count))
    share = survey.scan_count / len(scans)
    behind = np.flatnonzero(seen[:, 1] > BEHIND_SHARE * seen.sum(axis=1)).tolist()
    return Sample(
        caster.backend, cast, round(sum(hits) * share), round(sum(points) * share), tuple(behind)
    )


def _rays(
    survey: Survey, index: int, rays: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Origins and directions of some rays of a scan in the scene's axes, (k, 3) each."""
    spec, sensor = survey.scan(index), survey.sensor
    firings, which = np.unique(spec.firings[0] + rays // sensor.channels, return_inverse=True)
    channels = rays % sensor.channels
    starts = sensor.origins(firings)
    pattern = Pattern(
        sensor.directions(firings)[which, channels],
        None if starts is None else starts[which, channels],
    )
    times = sensor.times_ns(firings)[which, channels]
    positions, rotations = survey.path.poses(spec.station, times.astype(np.float64))
    return pattern.rays(np.arange(len(rays)), positions, rotations, rays_per_pose=1)


def _on_backs(scene: Scene, directions: NDArray[np.floating], triangles: NDArray[np.int32]) -> int:
    """How many rays (k, 3) hit the back of their triangle (k,)."""
    a, b, c = np.moveaxis(scene.vertices[scene.faces[triangles]], 1, 0)
    normals = np.cross(b - a, c - a)
    return int(((normals * directions).sum(axis=1) > 0).sum())


def _kept(hits: float, keep_every: int, counted: bool) -> float:
    """Points that are kept of the hits of a scan: the first, and every n-th from there."""
    if counted:
        return -(-hits // keep_every)
    # Rounding up adds half a point, less what whole numbers leave out, where there are any.
    return hits / keep_every + (keep_every - 1) / (2 * keep_every) if hits else 0.0

"""Metrics of candidates, which combine the sensors of a vehicle at one mount each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from lidarsim.motion.trajectory import Pose
from lidarsim.numerics.arrays import Bools, Floats, Floats32, Ints

from .evaluation import MountResult
from .placements import Placements


@dataclass(frozen=True)
class Candidate:
    """A mount for each sensor of the vehicle.

    Attributes
    ----------
    name
        Name of the candidate.
    mounts
        Pose of each sensor in the frame of the vehicle, by the name of the sensor.
    """

    name: str
    mounts: Mapping[str, Pose]

    @property
    def key(self) -> tuple[tuple[str, Pose], ...]:
        """Hashable form of the mounts."""
        return tuple(self.mounts.items())


class RankingRules(NamedTuple):
    """What a score depends on.

    Attributes
    ----------
    heights_m
        Heights of the blind-area map, in meters.
    ranked_height_m
        Height whose blind area counts.
    blind_weight
        Weight of the blind share.
    outside
        Cells that are outside the vehicle. Shape (rows, columns).
    cell_m2
        Area of a cell in square meters.
    """

    heights_m: tuple[float, ...]
    ranked_height_m: float
    blind_weight: float
    outside: Bools
    cell_m2: float


@dataclass(frozen=True, eq=False)
class CandidateResult:
    """Metrics of a candidate.

    Attributes
    ----------
    candidate
        The candidate.
    sensors
        Evaluation of each sensor, by name.
    points
        Number of points of all sensors on each placement. Shape (p,).
    lowest_m
        Height from which on an object in each cell is visible to a sensor. Shape (rows, columns).
    detection
        Share of the placements of each class that have enough points, by class.
    mean_points
        Mean number of points on the placements of each class, by class.
    redundancy
        Share of the placements of each class on which two sensors have enough points, by class.
    detection_rate
        Weighted mean of `detection`.
    blind_m2
        Blind area outside the vehicle for each height of the map, in square meters.
    hidden_m2
        Part of `blind_m2` that would be visible without the vehicle.
    twice_m2
        Area that at least two sensors see, for each height.
    map_m2
        Area of the map outside the vehicle.
    score
        Detection rate, minus the weighted blind share of the map.
    """

    candidate: Candidate
    sensors: Mapping[str, MountResult]
    points: Ints
    lowest_m: Floats32
    detection: Mapping[str, float]
    mean_points: Mapping[str, float]
    redundancy: Mapping[str, float]
    detection_rate: float
    blind_m2: Mapping[float, float]
    hidden_m2: Mapping[float, float]
    twice_m2: Mapping[float, float]
    map_m2: float
    score: float

    @property
    def order(self) -> tuple[float, ...]:
        """Sort key, by which the best candidate comes first."""
        return (-self.score, sum(self.blind_m2.values()), -sum(self.mean_points.values()))


def evaluate_candidate(
    candidate: Candidate,
    sensors: Mapping[str, MountResult],
    placements: Placements,
    rules: RankingRules,
) -> CandidateResult:
    """Combine the evaluations of a candidate's sensors."""
    results = list(sensors.values())
    each = np.stack([result.points for result in results])
    points = each.sum(axis=0)
    needed = np.array([target.points for target in placements.targets])[placements.target]
    lowest = np.stack([result.blind.lowest_m for result in results])
    open_lowest = np.stack([result.blind.unobstructed_m for result in results]).min(axis=0)
    combined = lowest.min(axis=0)
    outside = rules.outside

    def area(mask: Bools) -> float:
        return float((mask & outside).sum()) * rules.cell_m2

    # Without a vehicle, the ground returns light wherever a beam reaches it.
    blind = {height: area(combined > _visible_at(height)) for height in rules.heights_m}
    hidden = {
        height: area((combined > _visible_at(height)) & (open_lowest <= max(height, _REACHED_M)))
        for height in rules.heights_m
    }
    twice = {
        height: area((lowest <= _visible_at(height)).sum(axis=0) >= 2) for height in rules.heights_m
    }
    detection = _by_class(points >= needed, placements)
    weights = np.array([target.weight for target in placements.targets])
    rates = np.array([detection[target.name] for target in placements.targets])
    known = np.isfinite(rates) & (weights > 0)
    rate = float((rates * weights)[known].sum() / weights[known].sum()) if known.any() else 0.0
    map_m2 = area(outside)
    return CandidateResult(
        candidate=candidate,
        sensors=sensors,
        points=points,
        lowest_m=combined,
        detection=detection,
        mean_points=_by_class(points, placements),
        redundancy=_by_class((each >= needed).sum(axis=0) >= 2, placements),
        detection_rate=rate,
        blind_m2=blind,
        hidden_m2=hidden,
        twice_m2=twice,
        map_m2=map_m2,
        score=rate - rules.blind_weight * blind[rules.ranked_height_m] / max(map_m2, 1e-9),
    )


_REACHED_M = 1.5e-3  # beams that reach the ground have this height at most


def _visible_at(height_m: float) -> float:
    """Return the largest height in a map at which an object of the given height is visible."""
    return float(np.float32(height_m))


def _by_class(values: Bools | Ints, placements: Placements) -> dict[str, float]:
    """Return the mean of values over the placements of each class, or NaN without placements."""
    owner = placements.target
    count = len(placements.targets)
    totals = np.bincount(owner, values, minlength=count)
    sizes = np.bincount(owner, minlength=count)
    return {
        target.name: float(total / size) if size else float("nan")
        for target, total, size in zip(
            placements.targets, totals.tolist(), sizes.tolist(), strict=True
        )
    }


def rank_candidates(results: Sequence[CandidateResult]) -> list[CandidateResult]:
    """Sort candidates by their scores, best first. Ties keep their order."""
    return sorted(results, key=lambda result: result.order)


def pareto_front(results: Sequence[CandidateResult], height_m: float) -> Bools:
    """Return which candidates are not dominated in detection rate and blind area.

    A candidate is dominated if another one has at least its detection rate and at most its blind
    area at `height_m`, and is better in one of them. The result has shape (candidates,).
    """
    rates = np.array([result.detection_rate for result in results])
    blind = np.array([result.blind_m2[height_m] for result in results])
    no_worse: Bools = (rates[None] >= rates[:, None]) & (blind[None] <= blind[:, None])
    better: Bools = (rates[None] > rates[:, None]) | (blind[None] < blind[:, None])
    return ~(no_worse & better).any(axis=1)


def points_by_position(
    result: CandidateResult, placements: Placements, target: int
) -> tuple[Floats, Floats, Floats]:
    """Return the mean points on a class by distance and bearing, over all headings.

    Returns
    -------
    Distances in meters (d,), bearings in degrees (b,), and mean numbers of points (d, b), which are
    NaN for positions without a placement.
    """
    rows = np.flatnonzero(placements.target == target)
    distances, distance = np.unique(placements.distances_m[rows].round(3), return_inverse=True)
    degrees = placements.bearings_deg[rows].round(3) % 360
    bearings, bearing = np.unique(degrees, return_inverse=True)
    cell = distance * len(bearings) + bearing
    size = len(distances) * len(bearings)
    counts = np.bincount(cell, minlength=size)
    totals = np.bincount(cell, result.points[rows], minlength=size)
    with np.errstate(invalid="ignore"):
        mean: Floats = totals / counts
    return distances, bearings, mean.reshape(len(distances), len(bearings))

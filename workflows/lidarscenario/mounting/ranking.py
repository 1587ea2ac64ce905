"""Metrics of candidates, which combine the sensors of a vehicle, each at one mount."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from lidarsim.motion.trajectory import Pose
from lidarsim.numerics.arrays import Bools, Floats, Floats32, Ints

from .evaluation import MountResult
from .placements import Placements

_REACHED_M = 1.5e-3  # maximum height of beams that reach the ground


@dataclass(frozen=True)
class MountCandidate:
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
    """Parameters of the score.

    Attributes
    ----------
    heights_m
        Heights of the blind-area map, in meters.
    ranked_height_m
        Height for which the blind area is part of the score, in meters.
    blind_weight
        Weight of the blind share of the map.
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
        Minimum height of an object that is visible to a sensor, for each cell. Shape (rows,
        columns).
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
        Area that at least two sensors see for each height, in square meters.
    map_m2
        Area of the map outside the vehicle.
    score
        Detection rate, minus the weighted blind share of the map.
    """

    candidate: MountCandidate
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
        """Sort key that places the best candidate first."""
        known = [points for points in self.mean_points.values() if np.isfinite(points)]
        return (-self.score, sum(self.blind_m2.values()), -sum(known))


class _Areas(NamedTuple):
    """Areas of the map for each height, in square meters."""

    blind: dict[float, float]
    hidden: dict[float, float]
    twice: dict[float, float]
    all: float

    @classmethod
    def from_results(cls, results: Sequence[MountResult], rules: RankingRules) -> _Areas:
        """Compute the areas for sensors with the given maps."""
        lowest = np.stack([one.lowest_m for one in results])
        combined = lowest.min(axis=0)
        unobstructed = np.stack([one.unobstructed_m for one in results]).min(axis=0)

        def area(mask: Bools) -> float:
            return float((mask & rules.outside).sum()) * rules.cell_m2

        areas = cls({}, {}, {}, area(np.ones_like(rules.outside)))
        for height in rules.heights_m:
            # Maps have single precision.
            limit = float(np.float32(height))
            # Without the vehicle, the ground returns light wherever a beam reaches it.
            is_open = unobstructed <= max(limit, _REACHED_M)
            areas.blind[height] = area(combined > limit)
            areas.hidden[height] = area((combined > limit) & is_open)
            areas.twice[height] = area((lowest <= limit).sum(axis=0) >= 2)
        return areas


def evaluate_candidate(
    candidate: MountCandidate,
    sensors: Mapping[str, MountResult],
    placements: Placements,
    rules: RankingRules,
) -> CandidateResult:
    """Combine the evaluations of a candidate's sensors."""
    each = np.stack([result.points for result in sensors.values()])
    points = each.sum(axis=0)
    needed = np.array([target.points for target in placements.targets])[placements.target]
    results = [*sensors.values()]
    areas = _Areas.from_results(results, rules)
    detection = _by_class(points >= needed, placements)
    rate = _weighted_rate(detection, placements)
    blind_share = areas.blind[rules.ranked_height_m] / max(areas.all, 1e-9)
    return CandidateResult(
        candidate=candidate,
        sensors=sensors,
        points=points,
        lowest_m=np.stack([one.lowest_m for one in results]).min(axis=0),
        detection=detection,
        mean_points=_by_class(points, placements),
        redundancy=_by_class((each >= needed).sum(axis=0) >= 2, placements),
        detection_rate=rate,
        blind_m2=areas.blind,
        hidden_m2=areas.hidden,
        twice_m2=areas.twice,
        map_m2=areas.all,
        score=rate - rules.blind_weight * blind_share,
    )


def _weighted_rate(detection: Mapping[str, float], placements: Placements) -> float:
    """Return the weighted mean of the detection of the classes that have placements."""
    weights = np.array([target.weight for target in placements.targets])
    rates = np.array([detection[target.name] for target in placements.targets])
    known = np.isfinite(rates) & (weights > 0)
    return float((rates * weights)[known].sum() / weights[known].sum()) if known.any() else 0.0


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
    dominated: Bools = np.any(no_worse & better, axis=1)
    return np.logical_not(dominated)


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

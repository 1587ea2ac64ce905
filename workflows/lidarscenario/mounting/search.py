"""Enumeration and search of candidates.

For given mounts, all combinations that the vehicle file allows are evaluated. Mounts in ranges are
searched. The sensors are placed one after another, each at the best of several random mounts, and
then moved in small steps as long as the score increases.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from lidarsim.motion.trajectory import Pose
from lidarsim.numerics.arrays import Floats
from lidarsim.numerics.random_numbers import named_seed

from ..mount_sections import MountRanges, VehicleFile
from .evaluation import MountResult
from .placements import Placements
from .ranking import CandidateResult, MountCandidate, RankingRules, evaluate_candidate

EvaluateMounts = Callable[[Sequence[tuple[str, Pose]]], Iterable[MountResult]]

_DECIMALS = (3, 3, 3, 1, 1, 1)  # decimal places of x, y, z, yaw, pitch and roll
_FIRST_STEP = 0.25  # first step of a refinement, as a share of a range
_MAX_MOVES = 4  # moves of a sensor in a refinement


def listed_candidates(vehicle: VehicleFile) -> Iterator[MountCandidate]:
    """Yield the candidates of a vehicle file without ranges."""
    mounts = {name: sensor.mounts for name, sensor in vehicle.sensors.items()}
    if vehicle.combine == "names":
        several = next((poses for poses in mounts.values() if len(poses) > 1), {"mount": None})
        for key in several:
            chosen = {
                name: poses[key] if len(poses) > 1 else next(iter(poses.values()))
                for name, poses in mounts.items()
            }
            yield MountCandidate(key, chosen)
        return
    choices = [[(name, key) for key in poses] for name, poses in mounts.items()]
    for combination in itertools.product(*choices):
        words = [f"{name} {key}" for name, key in combination if len(mounts[name]) > 1]
        chosen = {name: mounts[name][key] for name, key in combination}
        yield MountCandidate(", ".join(words) or "mount", chosen)


@dataclass(eq=False)
class CandidateSearch:
    """Search for the best candidate of a vehicle file.

    Attributes
    ----------
    vehicle
        The vehicle file.
    placements, rules
        Targets, and parameters of the score.
    evaluate
        Function that evaluates several sensors at given mounts, in the order of its argument.
    """

    vehicle: VehicleFile
    placements: Placements
    rules: RankingRules
    evaluate: EvaluateMounts
    _mounts: dict[tuple[str, Pose], MountResult] = field(default_factory=dict)
    _found: dict[tuple[tuple[str, Pose], ...], CandidateResult] = field(default_factory=dict)

    def run(self) -> list[CandidateResult]:
        """Return all evaluated candidates that have a mount for each sensor.

        The candidates of a search have no names.
        """
        if not self.vehicle.is_search:
            self._score([*listed_candidates(self.vehicle)])
        else:
            chosen = self._place_sensors()
            self._refine(chosen)
        count = len(self.vehicle.sensors)
        return [r for r in self._found.values() if len(r.candidate.mounts) == count]

    def _score(self, candidates: Sequence[MountCandidate]) -> list[CandidateResult]:
        """Return the results of candidates, evaluating only mounts that are new."""
        wanted = dict.fromkeys(mount for c in candidates for mount in c.mounts.items())
        missing = [mount for mount in wanted if mount not in self._mounts]
        for mount, result in zip(missing, self.evaluate(missing), strict=True):
            self._mounts[mount] = result
        for candidate in candidates:
            if candidate.key not in self._found:
                sensors = {
                    name: self._mounts[name, pose] for name, pose in candidate.mounts.items()
                }
                self._found[candidate.key] = evaluate_candidate(
                    candidate, sensors, self.placements, self.rules
                )
        return [self._found[candidate.key] for candidate in candidates]

    def _place_sensors(self) -> dict[str, Pose]:
        """Choose a mount for one sensor after the other, and return the chosen mounts."""
        chosen: dict[str, Pose] = {}
        for name, sensor in self.vehicle.sensors.items():
            poses = [*sensor.mounts.values()]
            if sensor.ranges is not None:
                poses = self._random_mounts(name, sensor.ranges)
            chosen = dict(self._best(chosen, name, poses).candidate.mounts)
        return chosen

    def _best(
        self, chosen: Mapping[str, Pose], name: str, poses: Sequence[Pose]
    ) -> CandidateResult:
        """Return the best candidate among several mounts of a sensor."""
        candidates = [MountCandidate("", {**chosen, name: pose}) for pose in poses]
        return min(self._score(candidates), key=lambda result: result.order)

    def _random_mounts(self, name: str, ranges: MountRanges) -> list[Pose]:
        """Return the center of the ranges, followed by random mounts."""
        search = self.vehicle.search
        rng = np.random.default_rng([named_seed(search.seed, name)])
        limits = np.array(ranges.limits)
        shares = np.concatenate([np.full((1, 6), 0.5), rng.random((search.samples - 1, 6))])
        return [
            *dict.fromkeys(_pose(limits[:, 0] + row * np.ptp(limits, axis=1)) for row in shares)
        ]

    def _refine(self, chosen: dict[str, Pose]) -> None:
        """Move the sensors in their ranges as long as the score increases."""
        for number in range(self.vehicle.search.refinements):
            share = _FIRST_STEP / 2**number
            for name, sensor in self.vehicle.sensors.items():
                if sensor.ranges is not None:
                    chosen = self._refine_sensor(chosen, name, sensor.ranges, share)

    def _refine_sensor(
        self, chosen: dict[str, Pose], name: str, ranges: MountRanges, share: float
    ) -> dict[str, Pose]:
        for _ in range(_MAX_MOVES):
            current = self._score([MountCandidate("", chosen)])[0]
            neighbors = _neighbors(chosen[name], ranges, share)
            if not neighbors:
                break
            best = self._best(chosen, name, neighbors)
            if not best.order < current.order:
                break
            chosen = dict(best.candidate.mounts)
        return chosen


def _pose(values: Floats) -> Pose:
    """Return a pose with x, y, z, yaw, pitch and roll, rounded to millimeters and 0.1°."""
    rounded = [round(float(v), digits) + 0.0 for v, digits in zip(values, _DECIMALS, strict=True)]
    return Pose((rounded[0], rounded[1], rounded[2]), *rounded[3:])


def _neighbors(pose: Pose, ranges: MountRanges, share: float) -> list[Pose]:
    """Return the mounts one step away from a mount, along each axis whose range is not empty."""
    limits = np.array(ranges.limits)
    current = np.array([*pose.position, pose.yaw_deg, pose.pitch_deg, pose.roll_deg])
    moved = []
    for axis in np.flatnonzero(np.ptp(limits, axis=1) > 0):
        for sign in (-1, 1):
            values = current.copy()
            values[axis] += sign * share * np.ptp(limits[axis])
            values[axis] = values[axis].clip(*limits[axis])
            moved.append(_pose(values))
    return [one for one in dict.fromkeys(moved) if one != pose]

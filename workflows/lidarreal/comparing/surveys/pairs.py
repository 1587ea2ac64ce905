"""Deviations of points that belong to the same ray and the same return in both clouds.

Points are paired by a hash of their time or ray, so their order does not matter.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from lidarsim.columns.sweep import Columns, Sweep
from lidarsim.errors import LidarError
from lidarsim.numerics.arrays import AnyArray, Floats, Indices, Ints
from lidarsim.numerics.random_numbers import hash_rows
from lidarsim.words import plural

from .deviations import Deviations
from .survey_clouds import SENSOR, SurveyCloud

_TIMES = ("time", "gps_time")  # in results and in LAS files
_TIME_STEP_S = 1e-7  # resolution of times in floating point numbers
_MIN_SHARE = 0.01  # minimum share of the smaller cloud that must have a pair
_BITS = 2**64
_MAX_STEPS = 2.0**62  # times with more steps are identified by their exact values
_SURE = 0.99  # share of points without a key of their own above which a column identifies no points


class UnpairedError(LidarError):
    """Error raised if points cannot be paired. `reason` is a clause, and `remedy` a sentence."""

    def __init__(self, reason: str, remedy: str = "Use `--survey planes`.") -> None:
        super().__init__(f"The points cannot be paired, because {reason}. {remedy}")
        self.reason = reason


class _KeyedPoints(NamedTuple):
    keys: AnyArray  # (n,), uint64
    points: Floats  # (n, 3)
    ranges: Floats | None  # (n,)

    def select(self, rows: Indices) -> _KeyedPoints:
        ranges = None if self.ranges is None else self.ranges[rows]
        return _KeyedPoints(self.keys[rows], self.points[rows], ranges)


@dataclass(frozen=True)
class PairKey:
    """Columns that identify a point in both clouds."""

    names: tuple[str, ...]
    has_ranges: bool  # whether both clouds have ranges

    @classmethod
    def shared_by(cls, a: Columns, b: Columns) -> PairKey | None:
        """Return the columns of both clouds that identify points, or None if there are none."""
        shared = {*a} & {*b}
        time = next((name for name in _TIMES if name in shared), None)
        if time is not None:
            names = [time, "channel", "return_number"]
        elif {"scan", "ray"} <= shared:
            names = ["scan", "ray", "return_number"]
        else:
            return None
        names = [SENSOR, *(name for name in names if name in shared)]
        return cls(tuple(names), "range" in shared)

    def of(self, part: Sweep) -> _KeyedPoints:
        """Return the points of a part with their keys. Points without a time are omitted."""
        columns = [np.asarray(part.columns[name]) for name in self.names]
        finite = np.logical_and.reduce([np.isfinite(column) for column in columns])
        keys = hash_rows(*(_as_integers(column[finite]) for column in columns))
        ranges = np.asarray(part.columns["range"], np.float64)[finite] if self.has_ranges else None
        return _KeyedPoints(keys, part.points[finite], ranges)

    @property
    def column(self) -> str:
        """First column, which is a time or the number of a scan."""
        return next(name for name in self.names if name != SENSOR)

    @property
    def column_title(self) -> str:
        """Name of the first column, as shown in messages."""
        return self.column.replace("_", " ")

    def extend_limits(self, limits: tuple[float, float], part: Sweep) -> tuple[float, float]:
        """Extend a range of values so that it includes the first column of a part."""
        values = np.asarray(part.columns[self.column], np.float64)
        values = values[np.isfinite(values)]
        return float(values.min(initial=limits[0])), float(values.max(initial=limits[1]))

    @property
    def title(self) -> str:
        """Names of the columns, as shown in the report."""
        return ", ".join(name.replace("_", " ") for name in self.names if name != SENSOR)


def _as_integers(values: AnyArray) -> Ints:
    if not np.issubdtype(values.dtype, np.floating):
        return values.astype(np.int64)
    values = values.astype(np.float64)
    steps = np.rint(values / _TIME_STEP_S)
    is_exact = np.abs(steps) >= _MAX_STEPS
    return np.where(is_exact, values.view(np.int64), np.where(is_exact, 0, steps).astype(np.int64))


def _find_key(a: SurveyCloud, b: SurveyCloud) -> PairKey:
    """Return the columns that identify the points of both clouds.

    Raises UnpairedError if there are none.
    """
    first, second = (next(cloud.parts(with_ranges=True), None) for cloud in (a, b))
    key = None
    if first is not None and second is not None:
        key = PairKey.shared_by(first.columns, second.columns)
    if key is None:
        raise UnpairedError(
            f"{a.name} and {b.name} have no column `time` or `gps_time` in common",
            "Run both surveys with `cloud: {columns: [time]}`, or use `--survey planes`.",
        )
    return key


def pair_deviations(a: SurveyCloud, b: SurveyCloud, max_points: int) -> Deviations:
    """Return A - B for all pairs of points.

    At most about `max_points` points of each cloud are kept in memory. They are selected by their
    keys, so that the points of a pair are either both kept or both omitted.

    Raises UnpairedError if hardly any points have a pair, and LidarError if a cloud cannot be read.
    """
    key = _find_key(a, b)
    sampled = [_Sampled.read(cloud, key, max_points) for cloud in (a, b)]
    limit = min(one.limit for one in sampled)
    matching = _Matching.find(*(_below(one.kept, limit) for one in sampled))
    if not matching.is_sufficient:
        shares = matching.ambiguous_shares
        for cloud, one, ambiguous in zip((a, b), sampled, shares, strict=True):
            if reason := one.why_without_keys(cloud.name, key, ambiguous):
                raise UnpairedError(reason)
        raise UnpairedError(f"hardly any points of {a.name} and {b.name} have the same {key.title}")
    figures = {
        "paired_by": key.title,
        "points": dict(zip("ab", (one.point_count for one in sampled), strict=True)),
        "unpaired": dict(zip("ab", matching.unpaired, strict=True)),
        "ambiguous": dict(zip("ab", matching.ambiguous, strict=True)),
    }
    notes = [
        f"{plural(count, 'point')} of {cloud.name} have the same {key.title} as another point and "
        "are not compared"
        for cloud, count in zip((a, b), matching.ambiguous, strict=True)
        if count
    ]
    notes += [
        f"the comparison excludes {plural(one.invalid_count, 'point')} of {cloud.name} with a "
        f"{key.column_title} that is not finite"
        for cloud, one in zip((a, b), sampled, strict=True)
        if one.invalid_count
    ]
    if limit < _BITS:
        notes.append(f"{100 * limit / _BITS:.3g} % of the rays are compared, selected at random")
    if not key.has_ranges:
        notes.append(
            "ranges are not compared, because they require sweeps or the column `range` in both "
            "clouds"
        )
    return Deviations(matching.b.points, matching.components(), figures, tuple(notes))


class _Matching(NamedTuple):
    """Pairs of points with the same key."""

    a: _KeyedPoints
    b: _KeyedPoints
    unpaired: tuple[int, int]  # numbers of points without a counterpart
    ambiguous: tuple[int, int]  # numbers of points whose key is not unique

    @classmethod
    def find(cls, a: _KeyedPoints, b: _KeyedPoints) -> _Matching:
        (keys_a, rows_a), (keys_b, rows_b) = _unique_keys(a.keys), _unique_keys(b.keys)
        _, in_a, in_b = np.intersect1d(keys_a, keys_b, assume_unique=True, return_indices=True)
        return cls(
            a.select(rows_a[in_a]),
            b.select(rows_b[in_b]),
            (len(keys_a) - len(in_a), len(keys_b) - len(in_b)),
            (len(a.keys) - len(keys_a), len(b.keys) - len(keys_b)),
        )

    @property
    def ambiguous_shares(self) -> tuple[float, float]:
        """Share of the points in each cloud whose key is not unique."""
        unique = (len(self.a.keys) + count for count in self.unpaired)
        pairs = zip(self.ambiguous, unique, strict=True)
        first, second = (count / max(count + others, 1) for count, others in pairs)
        return first, second

    @property
    def is_sufficient(self) -> bool:
        """Whether a sufficient share of the smaller cloud is paired."""
        count = len(self.a.keys)
        sizes = (count + sum(of) for of in zip(self.unpaired, self.ambiguous, strict=True))
        return count > 0 and count >= _MIN_SHARE * min(sizes)

    def components(self) -> dict[str, Floats]:
        """Return A - B of each pair."""
        delta = self.a.points - self.b.points
        components = dict(zip(("delta_e", "delta_n", "delta_h"), delta.T, strict=True))
        components["horizontal"] = np.hypot(delta[:, 0], delta[:, 1])
        if self.a.ranges is not None and self.b.ranges is not None:
            components["range"] = self.a.ranges - self.b.ranges
        return components


class _Sampled(NamedTuple):
    """Points of a cloud whose keys are below a limit."""

    kept: _KeyedPoints
    point_count: int  # number of points in the cloud
    invalid_count: int  # number of points without a key, because a value is not finite
    limits: tuple[float, float]  # smallest and largest value of the first column of the key
    limit: int

    def why_without_keys(self, name: str, key: PairKey, ambiguous: float) -> str:
        """Return a clause if hardly any points of a cloud have a key of their own, otherwise "".

        `ambiguous` is the share of the keys that several points have in common.
        """
        if self.invalid_count >= _SURE * self.point_count:
            return f"the {key.column_title} of the points in {name} is not finite"
        if key.column in _TIMES and self.limits[0] == self.limits[1]:
            return f"the {key.column_title} of all points in {name} is {self.limits[0]:g}"
        if ambiguous >= _SURE:
            return f"most points in {name} have the same {key.title} as another point"
        return ""

    @classmethod
    def read(cls, cloud: SurveyCloud, key: PairKey, max_points: int) -> _Sampled:
        """Read a cloud, and reduce the limit until at most `max_points` points remain."""
        limit = _BITS
        kept: list[_KeyedPoints] = []
        kept_count = point_count = key_count = 0
        limits = np.inf, -np.inf
        for part in cloud.parts(with_ranges=True):
            keyed = key.of(part)
            kept.append(_below(keyed, limit))
            kept_count += len(kept[-1].keys)
            point_count += len(part)
            key_count += len(keyed.keys)
            limits = key.extend_limits(limits, part)
            while kept_count > max_points:
                limit //= 2
                kept = [_below(keyed, limit) for keyed in kept]
                kept_count = sum(len(keyed.keys) for keyed in kept)
        ranges = [keyed.ranges for keyed in kept if keyed.ranges is not None]
        joined = _KeyedPoints(
            np.concatenate([np.zeros(0, np.uint64), *(keyed.keys for keyed in kept)]),
            np.concatenate([np.zeros((0, 3)), *(keyed.points for keyed in kept)]),
            np.concatenate([np.zeros(0), *ranges]) if key.has_ranges else None,
        )
        return cls(joined, point_count, point_count - key_count, limits, limit)


def _below(keyed: _KeyedPoints, limit: int) -> _KeyedPoints:
    """Return the points whose keys are below a limit."""
    if limit >= _BITS:
        return keyed
    return keyed.select(np.flatnonzero(keyed.keys < np.uint64(limit)))


def _unique_keys(keys: AnyArray) -> tuple[AnyArray, Indices]:
    """Return the keys that occur once, in ascending order, and their rows."""
    order = np.argsort(keys)
    ordered = keys[order]
    repeated = np.zeros(len(keys), np.bool_)
    same = ordered[1:] == ordered[:-1]
    repeated[1:] |= same
    repeated[:-1] |= same
    return ordered[~repeated], order[~repeated]

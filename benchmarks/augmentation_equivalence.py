"""Comparison of augmented drives with drives that were simulated in the same condition.

Distributions are compared by the Kolmogorov-Smirnov distance, which is the largest difference
between two cumulative distributions. Numbers of surface returns are compared pulse by pulse, since
most pulses have the same fate in both drives. Numbers of returns from the air are compared as
independent counts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import ks_2samp

from lidarfiles.clouds.recording import Recording
from lidarreal.augmentation.augmenter import Augmenter
from lidarsim.columns.sweep import Sweep
from lidarsim.numerics.arrays import AnyArray, Floats, Ints

from .augmentation_drives import Condition, from_air, ranges
from .harness import print_row

CLUSTERS = 16  # clusters of pulses per sweep, which fail together if packets are dropped
_RESOLUTION = 0.01  # relative resolution of the compared intensities
PULSE_KEY_NS = 1000  # difference of the keys of pulses that are fired a nanosecond apart
MIN_COUNT = 50  # smallest samples that are compared


class Difference(NamedTuple):
    """Kolmogorov-Smirnov distance of two samples, and the probability of a larger distance."""

    distance: float
    p_value: float


@dataclass(frozen=True)
class Comparison:
    """Differences between two drives in the same condition.

    Attributes
    ----------
    surfaces, air
        Numbers of returns from surfaces and from the air in both drives.
    surfaces_z, air_z
        Differences of the numbers in standard errors.
    range_m, intensity
        Differences of the distributions of surface returns.
    air_range_m, air_intensity
        Differences of the distributions of returns from the air, or None if there are few.
    """

    surfaces: tuple[int, int]
    surfaces_z: float
    range_m: Difference
    intensity: Difference
    air: tuple[int, int]
    air_z: float
    air_range_m: Difference | None
    air_intensity: Difference | None

    def to_dict(self) -> dict[str, Any]:
        """Return the comparison as a dictionary for JSON."""
        return {
            name: value._asdict() if isinstance(value, Difference) else value
            for name, value in vars(self).items()
        }


class DriveReturns(NamedTuple):
    """Returns of a drive with n points."""

    range_m: Floats
    strength: Floats
    is_air: AnyArray
    pulse: Ints  # pulse of each surface return, -1 for others
    cluster: Ints  # cluster of pulses to which each return belongs

    @classmethod
    def join(cls, parts: Sequence[DriveReturns]) -> DriveReturns:
        """Concatenate the returns of sweeps."""
        return cls(*map(np.concatenate, zip(*parts, strict=True)))


def pulse_keys(sweep: Sweep) -> Ints:
    """Return numbers that identify pulses by time and channel, for points as simulated."""
    time_ns = np.asarray(sweep.columns["time"], np.int64)
    return time_ns * PULSE_KEY_NS + np.asarray(sweep.columns["channel"], np.int64)


def returns_of(sweeps: Sequence[Sweep], strength: str, keys: Sequence[Ints]) -> DriveReturns:
    """Collect the returns of a drive. `keys` are those of the pulses of its points."""
    parts = []
    for number, (sweep, key) in enumerate(zip(sweeps, keys, strict=True)):
        is_air = from_air(sweep)
        x, y = np.asarray(sweep.points, np.float64)[:, :2].T
        sector = np.floor((np.arctan2(y, x) / (2 * np.pi) + 0.5) * CLUSTERS).astype(np.int64)
        cluster = number * CLUSTERS + sector.clip(0, CLUSTERS - 1)
        strengths = np.asarray(sweep.columns[strength], np.float64)
        pulse = np.where(is_air, -1, key)
        parts.append(DriveReturns(ranges(sweep), strengths, is_air, pulse, cluster))
    return DriveReturns.join(parts)


def simulated(recording: Recording, strength: str = "intensity") -> DriveReturns:
    """Return the returns of a simulated drive."""
    sweeps = [recording[number] for number in range(len(recording))]
    return returns_of(sweeps, strength, [pulse_keys(sweep) for sweep in sweeps])


def augmented(
    recording: Recording,
    condition: Condition,
    model: Any,
    clear: Recording,
    strength: str = "intensity",
) -> DriveReturns:
    """Augment a recording.

    Parameters
    ----------
    recording
        Recording of the clear drive, possibly from a file.
    condition
        Condition to simulate.
    model
        Sensor model.
    clear
        The same drive in memory, which identifies the pulses.
    strength
        Column of the intensities to compare.
    """
    augmenter = Augmenter(recording, condition.effects, model)
    results = [augmenter.sweep(number) for number in range(len(recording))]
    keys = [
        np.where(result.is_recorded, pulse_keys(clear[number])[result.template], -1)
        for number, result in enumerate(results)
    ]
    return returns_of([result.sweep for result in results], strength, keys)


def compare(first: DriveReturns, second: DriveReturns) -> Comparison:
    """Compare two drives."""
    solid = [~drive.is_air for drive in (first, second)]
    air = [drive.is_air for drive in (first, second)]
    counts = int(air[0].sum()), int(air[1].sum())
    strengths = [_rounded(drive.strength, seed) for seed, drive in enumerate((first, second))]
    has_air = min(counts) >= MIN_COUNT
    return Comparison(
        (int(solid[0].sum()), int(solid[1].sum())),
        _paired_z(first, second),
        _difference(first.range_m[solid[0]], second.range_m[solid[1]]),
        _difference(strengths[0][solid[0]], strengths[1][solid[1]]),
        counts,
        (counts[0] - counts[1]) / max(np.sqrt(sum(counts)), 1.0),
        _difference(first.range_m[air[0]], second.range_m[air[1]]) if has_air else None,
        _difference(strengths[0][air[0]], strengths[1][air[1]]) if has_air else None,
    )


def _paired_z(first: DriveReturns, second: DriveReturns) -> float:
    """Return the difference of the numbers of surface returns in standard errors.

    Only pulses with a surface return in one of the two drives contribute. Pulses of a cluster may
    fail together, so the standard error is that of the sums of clusters.
    """
    pulses = [drive.pulse[~drive.is_air] for drive in (first, second)]
    clusters = [drive.cluster[~drive.is_air] for drive in (first, second)]
    size = 1 + max(int(cluster.max(initial=0)) for cluster in clusters)
    only = [~np.isin(pulses[0], pulses[1]), ~np.isin(pulses[1], pulses[0])]
    sums = np.bincount(clusters[0][only[0]], minlength=size).astype(np.float64)
    sums -= np.bincount(clusters[1][only[1]], minlength=size)
    return float(sums.sum() / max(np.sqrt((sums**2).sum()), 1.0))


def _rounded(strength: Floats, seed: int) -> Floats:
    """Return intensities with random errors of 1 %, which is finer than sensors record them.

    The flat ground returns the same intensity at all azimuths of a ring. Without these errors, the
    distance would only show whether intensities are equal in all digits.
    """
    errors = np.random.default_rng(seed).normal(size=len(strength))
    return strength * (1 + _RESOLUTION * errors)


def _difference(first: Floats, second: Floats) -> Difference:
    result = ks_2samp(first, second, method="asymp")
    return Difference(float(result.statistic), float(result.pvalue))


def print_comparison(name: str, comparison: Comparison) -> None:
    """Print a comparison as a table row."""

    def number(difference: Difference | None) -> str:
        if difference is None:
            return "–"
        mark = "*" if difference.p_value < 1e-3 else ""
        return f"{difference.distance:.4f}{mark}"

    print_row(
        name,
        f"{comparison.surfaces[0]:,} / {comparison.surfaces[1]:,}",
        f"{comparison.surfaces_z:+.1f}",
        number(comparison.range_m),
        number(comparison.intensity),
        f"{comparison.air[0]:,} / {comparison.air[1]:,}",
        f"{comparison.air_z:+.1f}",
        number(comparison.air_range_m),
        number(comparison.air_intensity),
    )

"""Figures of a twin: sweeps that were held out, beside what a scan of the twin gives.

The rays of a held-out sweep are cast at the place that the other sweeps made. So a figure tells how
a sensor would see the surface_map, and not how well the place repeats what it was made of. The poses of
held-out sweeps are registered to the others' map, which hides a part of the errors of poses.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from itertools import pairwise
from typing import Any

import numpy as np

from lidarsim.numerics.arrays import Bools, Floats, Ints

from .alignment import AlignedSweep, AlignedSweeps
from .reflectances import Reflectances
from .surface_map import SurfaceMap

_RANGE_MARGIN_M = 0.5  # beyond the largest recorded range
_RANGES_M = (0, 5, 10, 20, 40, 80, np.inf)  # classes of ranges


@dataclass(frozen=True, eq=False)
class HeldOutRays:
    """Rays of held-out sweeps, and what they meet in the twin, as arrays of n rays.

    Attributes
    ----------
    sweep, ring
        Number of the sweep, and row of the ring, of each ray.
    range_m
        As recorded, meters; NaN of a lost pulse.
    simulated_m
        Range in the twin, meters; NaN where the twin has nothing.
    intensity, simulated_intensity
        As recorded, and in the twin; NaN if unknown.
    standing
        Whether the recorded point stands, by all sweeps; False for lost pulses.
    """

    sweep: Ints
    ring: Ints
    range_m: Floats
    simulated_m: Floats
    intensity: Floats
    simulated_intensity: Floats
    standing: Bools

    @classmethod
    def concatenate(cls, parts: Sequence[HeldOutRays]) -> HeldOutRays:
        """Join rays."""
        return cls(
            *(
                np.concatenate([getattr(part, column.name) for part in parts])
                for column in fields(cls)
            )
        )

    @property
    def returned(self) -> Bools:
        """Mask (n,) of the rays that returned in the recording."""
        return np.isfinite(self.range_m)

    def select(self, rays: Bools) -> HeldOutRays:
        """Return selected rays."""
        return HeldOutRays(*(getattr(self, column.name)[rays] for column in fields(self)))

    def figures(self) -> dict[str, Any]:
        """Return the figures of all rays, of those whose points stand, and by class of range."""
        classes = [
            {"from_m": low, "to_m": None if np.isinf(high) else high}
            | self._figures((self.range_m >= low) & (self.range_m < high))
            | {"points": self._points(low, high)}
            for low, high in pairwise(_RANGES_M)
        ]
        return {
            "all": self._figures(self.returned),
            "stationary": self._figures(self.standing),
            "by_range": [row for row in classes if row["rays"]],
            "by_sweep": [
                {"sweep": int(number)} | self._figures(self.returned & (self.sweep == number))
                for number in np.unique(self.sweep)
            ],
            "points": self._points(0, np.inf),
            "points_by_ring": self._points_by_ring(),
            "no_return": self._no_return(),
        }

    def _points(self, low_m: float, high_m: float) -> float | None:
        """Return the number of points at some ranges in the twin, over the recorded number."""
        recorded = ((self.range_m >= low_m) & (self.range_m < high_m)).sum()
        simulated = ((self.simulated_m >= low_m) & (self.simulated_m < high_m)).sum()
        return float(simulated / recorded) if recorded else None

    def _points_by_ring(self) -> float:
        """Return the median, over rings, of how far the share of points is from 1."""
        recorded = np.bincount(self.ring, self.returned)
        simulated = np.bincount(self.ring, np.isfinite(self.simulated_m))
        known = recorded > 0
        return float(np.median(np.abs(simulated[known] / recorded[known] - 1)))

    def _no_return(self) -> dict[str, Any] | None:
        """Return the shares of rays without a return, and their F1; None if no pulse is lost.

        F1 is the harmonic mean of precision and recall of "no return".
        """
        recorded = ~self.returned
        if not recorded.any():
            return None
        simulated = np.isnan(self.simulated_m)
        return {
            "recorded": float(recorded.mean()),
            "simulated": float(simulated.mean()),
            "f1": float(2 * (recorded & simulated).sum() / (recorded.sum() + simulated.sum())),
        }

    def _figures(self, rays: Bools) -> dict[str, Any]:
        """Return figures of selected rays that returned."""
        difference_m = self.simulated_m[rays] - self.range_m[rays]
        met = np.isfinite(difference_m)
        size_m = np.abs(difference_m[met])
        recorded = self.intensity[rays]
        simulated = self.simulated_intensity[rays]
        both = np.isfinite(recorded) & np.isfinite(simulated)
        figures: dict[str, Any] = {
            "rays": int(rays.sum()),
            "no_surface": 1 - float(met.mean()) if len(met) else None,
            "median_difference_m": float(np.median(difference_m[met])) if met.any() else None,
            "median_abs_difference_m": float(np.median(size_m)) if met.any() else None,
            "p90_abs_difference_m": float(np.quantile(size_m, 0.9)) if met.any() else None,
            "rank_correlation": None,
            "mean_intensity_difference": None,
        }
        if both.sum() > 2 and np.ptp(recorded[both]) > 0 and np.ptp(simulated[both]) > 0:
            from scipy.stats import spearmanr

            figures["rank_correlation"] = float(spearmanr(recorded[both], simulated[both])[0])
            figures["mean_intensity_difference"] = float(
                simulated[both].mean() / recorded[both].mean() - 1
            )
        return figures


def simulate_held_out(
    sweeps: AlignedSweeps,
    surface_map: SurfaceMap,
    reflectances: Reflectances | None,
    standing: Mapping[int, Bools],
    numbers: Sequence[int],
) -> HeldOutRays:
    """Cast the rays of held-out sweeps at a place that other sweeps made.

    Parameters
    ----------
    sweeps
        The sweeps.
    surface_map, reflectances
        The surface_map, and its reflectances; None without intensities.
    standing
        Which points of the held-out sweeps stand, by all sweeps: {number: (n,)}.
    numbers
        Numbers of the held-out sweeps.
    """
    parts = []
    for number in numbers:
        sweep, lost = sweeps.read_with_lost(number)
        no_ranges = np.full(len(lost.points), np.nan)
        no_points = np.zeros(len(lost.points), bool)
        parts.append(
            _rays(surface_map, reflectances, sweep, number, sweep.range_m, standing[number])
        )
        parts.append(_rays(surface_map, None, lost, number, no_ranges, no_points))
    rays = HeldOutRays.concatenate(parts)
    # What was seen from nearer is out of reach here.
    in_reach = rays.simulated_m <= sweeps.coverage.max_range_m + _RANGE_MARGIN_M
    return replace(rays, simulated_m=np.where(in_reach, rays.simulated_m, np.nan))


def _rays(
    surface_map: SurfaceMap,
    reflectances: Reflectances | None,
    sweep: AlignedSweep,
    number: int,
    range_m: Floats,
    standing: Bools,
) -> HeldOutRays:
    """Cast the rays of a sweep, with recorded ranges (n,), at a surface_map."""
    hits = surface_map.cast(sweep)
    simulated_m = np.full(len(sweep.points), np.nan)
    simulated_m[hits.rays] = np.where(
        surface_map.surfels.dark[hits.surfel], np.nan, hits.distance_m
    )
    unknown = np.full(len(sweep.points), np.nan)
    return HeldOutRays(
        sweep=np.full(len(sweep.points), number),
        ring=sweep.ring,
        range_m=range_m,
        simulated_m=simulated_m,
        intensity=unknown if sweep.intensities is None else sweep.intensities,
        simulated_intensity=(
            unknown if reflectances is None else reflectances.intensities(sweep, hits)
        ),
        standing=standing,
    )

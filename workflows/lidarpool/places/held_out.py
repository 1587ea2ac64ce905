"""Figures of a twin: sweeps that were held out, beside what a scan of the twin gives.

The rays of a held-out sweep are cast at the place that the other sweeps made. So a figure tells how
a sensor would see the place, and not how well the place repeats what it was made of. The poses of
held-out sweeps are registered to the others' map, which hides a part of the errors of poses.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from itertools import pairwise
from typing import Any

import numpy as np

from lidarsim.base.arrays import Bools, Floats, Ints

from .alignment import AlignedSweeps
from .place import Place
from .reflectances import Reflectances

_RANGES_M = (0, 5, 10, 20, 40, 80, np.inf)  # classes of ranges


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Rays of held-out sweeps, and what they meet in the twin, as arrays of n rays.

    Attributes
    ----------
    sweep
        Number of the sweep of each ray.
    range_m
        As recorded, metres.
    difference_m
        Range in the twin less `range_m`; NaN where the twin has nothing.
    intensity, simulated_intensity
        As recorded, and in the twin; NaN if unknown.
    standing
        Whether the recorded point stands, by all sweeps.
    """

    sweep: Ints
    range_m: Floats
    difference_m: Floats
    intensity: Floats
    simulated_intensity: Floats
    standing: Bools

    def figures(self) -> dict[str, Any]:
        """Return the figures of all rays, of those that stand, and by class of range."""
        everything = np.ones(len(self.range_m), bool)
        bounds = pairwise(_RANGES_M)
        classes = [
            {"from_m": low, "to_m": None if np.isinf(high) else high}
            | self._figures((self.range_m >= low) & (self.range_m < high))
            for low, high in bounds
        ]
        return {
            "all": self._figures(everything),
            "standing": self._figures(self.standing),
            "by_range": [row for row in classes if row["rays"]],
            "by_sweep": [
                {"sweep": int(number)} | self._figures(self.sweep == number)
                for number in np.unique(self.sweep)
            ],
        }

    def _figures(self, rays: Bools) -> dict[str, Any]:
        """Return figures of selected rays."""
        difference_m = self.difference_m[rays]
        met = np.isfinite(difference_m)
        size_m = np.abs(difference_m[met])
        recorded = self.intensity[rays]
        simulated = self.simulated_intensity[rays]
        both = np.isfinite(recorded) & np.isfinite(simulated)
        figures: dict[str, Any] = {
            "rays": int(rays.sum()),
            "missed": 1 - float(met.mean()) if len(met) else None,
            "median_m": float(np.median(difference_m[met])) if met.any() else None,
            "median_size_m": float(np.median(size_m)) if met.any() else None,
            "p90_size_m": float(np.quantile(size_m, 0.9)) if met.any() else None,
            "rank_correlation": None,
            "intensity_error": None,
        }
        if both.sum() > 2 and recorded[both].std() > 0 and simulated[both].std() > 0:
            from scipy.stats import spearmanr

            figures["rank_correlation"] = float(spearmanr(recorded[both], simulated[both])[0])
            figures["intensity_error"] = float(simulated[both].mean() / recorded[both].mean() - 1)
        return figures


def hold_out(
    sweeps: AlignedSweeps,
    place: Place,
    reflectances: Reflectances | None,
    standing: Mapping[int, Bools],
    numbers: Sequence[int],
) -> HeldOut:
    """Cast the rays of held-out sweeps at a place that other sweeps made.

    Parameters
    ----------
    sweeps
        The sweeps.
    place, reflectances
        The place, and its reflectances; None without intensities.
    standing
        Which points of the held-out sweeps stand, by all sweeps: {number: (n,)}.
    numbers
        Numbers of the held-out sweeps.
    """
    parts = []
    for number in numbers:
        sweep = sweeps.read(number)
        seen = place.see(sweep)
        difference_m = np.full(len(sweep.points), np.nan)
        difference_m[seen.rays] = seen.distance_m - seen.range_m
        unknown = np.full(len(sweep.points), np.nan)
        parts.append(
            HeldOut(
                np.full(len(sweep.points), number),
                sweep.range_m,
                difference_m,
                unknown if sweep.intensities is None else sweep.intensities,
                unknown if reflectances is None else reflectances.intensities(sweep, seen),
                standing[number],
            )
        )
    return HeldOut(
        *(
            np.concatenate([getattr(part, column.name) for part in parts])
            for column in fields(HeldOut)
        )
    )

"""Measure the accuracy of a reconstruction with sweeps that were held out.

The rays of a held-out sweep are cast in the map that was built from the other sweeps. The
statistics therefore measure how well a sensor can be simulated, not how well the map fits its own
data. Held-out sweeps are registered to the map, which hides part of the pose errors.
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

# Returned and lost pulses of sweeps, by sweep number.
HeldOutPulses = Mapping[int, tuple[AlignedSweep, AlignedSweep]]

_RANGE_MARGIN_M = 0.5  # margin beyond the maximum recorded range
_SAME_SURFACE_M = 0.15  # maximum range difference of returns from the same surface
_RANGES_M = (0, 5, 10, 20, 40, 80, np.inf)  # boundaries of the range classes


@dataclass(frozen=True, eq=False)
class HeldOutRays:
    """Recorded and simulated rays of held-out sweeps, as arrays of n rays.

    Attributes
    ----------
    sweep, ring
        Sweep number and ring index of each ray.
    range_m
        Recorded range in meters, NaN for a lost pulse.
    simulated_m
        Simulated range in meters, NaN if the ray hits nothing.
    intensity, simulated_intensity
        Recorded and simulated intensity, NaN if unknown.
    standing
        Whether the recorded point is stationary according to all sweeps. False for lost pulses.
    moving
        Whether the recorded point is in the box of a moving object.
    on_object
        Whether the ray hits a moving object in the simulation.
    """

    sweep: Ints
    ring: Ints
    range_m: Floats
    simulated_m: Floats
    intensity: Floats
    simulated_intensity: Floats
    standing: Bools
    moving: Bools
    on_object: Bools

    @classmethod
    def concatenate(cls, parts: Sequence[HeldOutRays]) -> HeldOutRays:
        """Concatenate the rays of several sweeps."""
        return cls(
            *(
                np.concatenate([getattr(part, column.name) for part in parts])
                for column in fields(cls)
            )
        )

    @property
    def return_mask(self) -> Bools:
        """Mask of the rays that have a recorded return.

        The array has shape (n,).
        """
        return np.isfinite(self.range_m)

    def select(self, rays: Bools) -> HeldOutRays:
        """Select rays with a mask."""
        return HeldOutRays(*(getattr(self, column.name)[rays] for column in fields(self)))

    def figures(self) -> dict[str, Any]:
        """Return statistics of all rays, stationary points, range classes and sweeps."""
        classes = [
            {"from_m": low, "to_m": None if np.isinf(high) else high}
            | self._figures((self.range_m >= low) & (self.range_m < high))
            | {"points": self._points(low, high)}
            for low, high in pairwise(_RANGES_M)
        ]
        return {
            "all": self._figures(self.return_mask),
            "stationary": self._figures(self.standing),
            "moving": self._moving(),
            "by_range": [row for row in classes if row["rays"]],
            "by_sweep": [
                {"sweep": int(number)} | self._figures(self.return_mask & (self.sweep == number))
                for number in np.unique(self.sweep)
            ],
            "points": self._points(0, np.inf),
            "points_by_ring": self._points_by_ring(),
            "no_return": self._no_return(),
        }

    def _points(self, low_m: float, high_m: float) -> float | None:
        """Return the ratio of simulated to recorded points with ranges in an interval."""
        recorded = ((self.range_m >= low_m) & (self.range_m < high_m)).sum()
        simulated = ((self.simulated_m >= low_m) & (self.simulated_m < high_m)).sum()
        return float(simulated / recorded) if recorded else None

    def _points_by_ring(self) -> float:
        """Return the typical relative error of the simulated point count of a ring."""
        recorded = np.bincount(self.ring, self.return_mask)
        simulated = np.bincount(self.ring, np.isfinite(self.simulated_m))
        known = recorded > 0
        return float(np.median(np.abs(simulated[known] / recorded[known] - 1)))

    def _no_return(self) -> dict[str, Any] | None:
        """Compare the rays without a return in the recording and in the simulation.

        F1 is the harmonic mean of precision and recall of missing returns. Return None if no pulse
        was lost in the recording.
        """
        recorded = ~self.return_mask
        if not recorded.any():
            return None
        simulated = np.isnan(self.simulated_m)
        return {
            "recorded": float(recorded.mean()),
            "simulated": float(simulated.mean()),
            "f1": float(2 * (recorded & simulated).sum() / (recorded.sum() + simulated.sum())),
        }

    def _moving(self) -> dict[str, Any] | None:
        """Return statistics of the points in boxes of moving objects, or None without any.

        Ghosts are simulated returns on moving objects where the recording has no such return.
        """
        if not self.moving.any() and not self.on_object.any():
            return None
        near = np.abs(self.simulated_m - self.range_m) < _SAME_SURFACE_M
        ghosts = int((self.on_object & ~self.moving & ~near).sum())
        simulated = int(np.isfinite(self.simulated_m).sum())
        return self._figures(self.moving) | {
            "ghosts": ghosts / simulated if simulated else 0.0,
            "ghosts_on_objects": ghosts / max(int(self.on_object.sum()), 1),
        }

    def _figures(self, rays: Bools) -> dict[str, Any]:
        """Return statistics of those selected rays that have a recorded return."""
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
    stationary: Mapping[int, Bools],
    numbers: Sequence[int],
) -> tuple[HeldOutRays, HeldOutPulses]:
    """Simulate held-out sweeps, using a map that was built from other sweeps.

    Parameters
    ----------
    sweeps
        All sweeps.
    surface_map, reflectances
        The map and its reflectances. The reflectances are None without intensities.
    stationary
        Masks of the stationary points of the held-out sweeps, by sweep number.
    numbers
        Numbers of the held-out sweeps.

    Returns
    -------
    tuple
        The rays of the held-out sweeps, including lost pulses, and their pulses in the same order.
    """
    parts = []
    pulses = {}
    for number in numbers:
        sweep, lost = sweeps.read_pulses(number)
        pulses[number] = sweep, lost
        no_ranges = np.full(len(lost.points), np.nan)
        no_points = np.zeros(len(lost.points), bool)
        parts.append(
            _rays(surface_map, reflectances, sweep, number, sweep.range_m, stationary[number])
        )
        parts.append(_rays(surface_map, reflectances, lost, number, no_ranges, no_points))
    rays = HeldOutRays.concatenate(parts)
    # Surfaces that were only observed at closer range are beyond the range of the sensor.
    in_reach = rays.simulated_m <= sweeps.coverage.max_range_m + _RANGE_MARGIN_M
    return replace(rays, simulated_m=np.where(in_reach, rays.simulated_m, np.nan)), pulses


def _rays(
    surface_map: SurfaceMap,
    reflectances: Reflectances | None,
    sweep: AlignedSweep,
    number: int,
    range_m: Floats,
    stationary: Bools,
) -> HeldOutRays:
    """Cast the rays of a sweep, and combine the results with the recorded ranges."""
    hits = surface_map.cast_likely(sweep)
    simulated_m = np.full(len(sweep.points), np.nan)
    simulated_m[hits.rays] = np.where(
        surface_map.surfels.dark[hits.surfel], np.nan, hits.distance_m
    )
    if sweep.is_blocked is not None:
        simulated_m[sweep.is_blocked] = np.nan
    unknown = np.full(len(sweep.points), np.nan)
    intensity = unknown.copy()
    if reflectances is not None:
        intensity[hits.rays] = reflectances.intensities(
            hits.surfel, hits.distance_m, hits.cosine, sweep.ring[hits.rays]
        )
    return HeldOutRays(
        sweep=np.full(len(sweep.points), number),
        ring=sweep.ring,
        range_m=range_m,
        simulated_m=simulated_m,
        intensity=unknown if sweep.intensities is None else sweep.intensities,
        simulated_intensity=intensity,
        standing=stationary,
        moving=np.zeros(len(sweep.points), bool),
        on_object=np.zeros(len(sweep.points), bool),
    )

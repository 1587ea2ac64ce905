"""Compiled loop that detects the returns of recorded pulses (detection.py)."""

# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from raybeam.compiled import compiled, inlined

from ...numerics.arrays import Floats
from .pulse_loops import scan_row
from .random_loops import SHIFT_TO_INDEX, bits, uniform


class DetectionLimits(NamedTuple):
    """Properties of a receiver and of the random numbers of its noise."""

    dropout: float  # fraction of added returns that are lost
    recorded_dropout: float  # fraction of recorded returns that are lost
    threshold: float  # energy at which half of the returns are detected; 0 without detection
    threshold_sigmas: float  # threshold in standard deviations of the noise
    quantiles: Floats  # quantiles of the normal distribution


@inlined
def _index_above(quantiles, limit, index):
    """Map a random index of a quantile to the quantiles above a limit."""
    levels = len(quantiles)
    lowest = min(np.searchsorted(quantiles, limit, side="right"), levels - 1)
    return lowest + index * (levels - lowest) // levels


@compiled()
def find_detected(ray, energy, source, recorded_energy, limits, keys, row_indices):
    """Write the rows of the returns that are detected, and return their number.

    Parameters
    ----------
    ray, energy, source
        (n,): returns, sorted by ray. `source` is -1 for added returns.
    recorded_energy
        Energies with which recorded returns were detected.
    limits
        A `DetectionLimits`.
    keys
        A `RandomKeys` with the states for losses and for the noise of the energy.
    row_indices
        (n,): output.
    """
    quantiles = limits.quantiles
    states = keys.states
    scan_starts = keys.scan_starts
    threshold = limits.threshold
    count = 0
    number = 0
    scan = 0
    for k in range(len(ray)):
        number = number + 1 if k > 0 and ray[k] == ray[k - 1] else 0
        scan = scan_row(scan_starts, ray[k], scan)
        beam = ray[k] - scan_starts[scan]
        dropout = limits.recorded_dropout if source[k] >= 0 else limits.dropout
        if dropout > 0 and uniform(states[scan, 0], beam, number) < dropout:
            continue
        if threshold > 0:
            signal = limits.threshold_sigmas * (energy[k] / threshold - 1)
            if signal + quantiles[len(quantiles) - 1] <= 0:  # never detected
                continue
            if signal + quantiles[0] <= 0:  # not detected with some random numbers
                index = np.int64(bits(states[scan, 1], beam, number) >> SHIFT_TO_INDEX)
                if source[k] >= 0:
                    earlier = recorded_energy[source[k]] / threshold - 1
                    index = _index_above(quantiles, -limits.threshold_sigmas * earlier, index)
                if signal + quantiles[index] <= 0:
                    continue
        row_indices[count] = k
        count += 1
    return count

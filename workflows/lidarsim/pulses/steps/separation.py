"""Combine inseparable hits into returns, and select the returns to report."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ...numerics.arrays import Bools, to_writable
from ...numerics.random_numbers import quantiles, scan_states
from ...scene.colors import GRAY, pack_colors
from ...sensor.disc import neighboring_subrays
from ...sensor.noise import THRESHOLD_SIGMAS, Noise
from ...sensor.optics import Mode
from ..returns import (
    NO_SURFACE,
    RETURN_COLUMNS,
    SURFACE,
    Keys,
    Planes,
    PulseReturns,
    require_column,
    returns_without_surface,
    select_rows,
)
from .detection import DETECTION, LOSS
from .step import PulseBatch, PulseStep, Role, Setup

if TYPE_CHECKING:
    from .pulse_loops import SubrayNeighbors
    from .random_loops import RandomKeys
    from .separation_loops import Receiver, ReturnArrays, SubrayHits

# In the order of the mode numbers in `separation_loops`.
MODES: tuple[Mode, ...] = "all", "first", "last", "strongest", "dual", "two_strongest"
_NO_VALUES = np.zeros(0)


class Reporting(NamedTuple):
    """Settings for the detection and selection of returns."""

    mode: Mode = "all"
    noise: Noise | None = None  # noise that makes returns undetected; None if all are detected
    keys: Keys | None = None
    first: int = 0  # number in `keys` of the beam to which sub-ray 0 of the hits belongs


def separate_hits(
    hits: PulseReturns,
    gap_m: float,
    subrays: int = 1,
    planes: Planes | None = None,
    air: PulseReturns | None = None,
    reporting: Reporting | None = None,
) -> PulseReturns:
    """Combine hits of a beam into one return where the receiver cannot separate them.

    Hits of a beam form a single return if each is within `gap_m` of the next. Hits of neighboring
    sub-rays on one surface also form a single return, however far apart they are: a beam that
    grazes a road illuminates the entire road between the hits. The energy of a return is the sum
    over its hits, distance and velocity are energy-weighted means, and triangle and color come from
    the strongest hit. Hits without energy are dropped.

    Parameters
    ----------
    hits
        Hits of sub-rays on surfaces, sorted by sub-ray.
    gap_m
        Half of the pulse length in meters.
    subrays
        Number of sub-rays per beam.
    planes
        Planes of the hits. If None, no surface continues from sub-ray to sub-ray.
    air
        Hits in the air, sorted by sub-ray.
    reporting
        Detection and selection. If None, all returns are detected and reported.

    Returns
    -------
    PulseReturns
        Returns sorted by beam and distance, whose `ray` is the beam.
    """
    from . import separation_loops  # imported here because numba takes half a second to import

    air_hits = PulseReturns.empty()._replace(energy=_NO_VALUES) if air is None else air
    reporting = reporting or Reporting()
    with_velocity = hits.velocity is not None
    size = len(hits.ray) + len(air_hits.ray)
    output = separation_loops.ReturnArrays(
        beam=np.empty(size, np.int64),
        row=np.empty(size, np.int64),
        distance=np.empty(size),
        energy=np.empty(size),
        velocity=np.empty(size),
    )
    count = separation_loops.separate(
        _subray_hits(hits, hits.triangle != NO_SURFACE, with_velocity=with_velocity),
        _subray_hits(air_hits, np.zeros(0, np.bool_), with_velocity=with_velocity),
        neighbors_of(subrays, planes),
        _receiver(subrays, gap_m, reporting, with_velocity=with_velocity),
        _detection_keys(reporting),
        output,
    )
    output = output.first(count)
    returns = _columns(hits, air_hits, output)
    # Copies, because the output arrays are as long as the table of hits.
    return returns._replace(
        ray=output.beam + reporting.first,
        distance=output.distance.copy(),
        energy=output.energy.copy(),
        velocity=output.velocity.copy() if with_velocity else None,
    )


def _receiver(subrays: int, gap_m: float, reporting: Reporting, *, with_velocity: bool) -> Receiver:
    """Return the settings of a receiver for compiled loops."""
    from .separation_loops import Receiver

    noise = reporting.noise
    detects = noise is not None and noise.loses_returns
    return Receiver(
        subrays=subrays,
        gap_m=gap_m,
        mode=MODES.index(reporting.mode),
        with_velocity=with_velocity,
        dropout=float(noise.dropout) if noise is not None and detects else 0.0,
        threshold=float(noise.threshold) if noise is not None and detects else 0.0,
        threshold_sigmas=THRESHOLD_SIGMAS,
        quantiles=quantiles() if detects else _NO_VALUES,
    )


def _detection_keys(reporting: Reporting) -> RandomKeys:
    """Return the keys of the random numbers for detection.

    Without loss of returns, the keys have no purposes.
    """
    from .random_loops import RandomKeys

    noise = reporting.noise
    keys = reporting.keys or Keys(0, np.zeros(1, np.int64))
    states = np.zeros((len(keys.scan_starts), 0), np.uint64)
    if noise is not None and noise.loses_returns:
        scans = keys.scan + np.arange(len(keys.scan_starts))
        states = scan_states(noise.seed, (LOSS, DETECTION), scans)
    return RandomKeys(states, to_writable(keys.scan_starts, np.int64), reporting.first)


def _columns(hits: PulseReturns, air_hits: PulseReturns, output: ReturnArrays) -> PulseReturns:
    """Return the columns of returns, taken from the strongest hit of each."""
    row = output.row
    if len(hits.ray):
        columns = hits.triangle, hits.color, hits.cause, hits.source
        triangle, color, cause, source = select_rows(columns, np.maximum(row, 0))
        returns = PulseReturns(
            output.beam, output.distance, triangle, output.energy, color, cause, source=source
        )
    else:
        returns = returns_without_surface(
            hits, output.beam, output.distance, output.energy, SURFACE
        )
    if not len(air_hits.ray):
        return returns
    from_air = np.flatnonzero(row < 0)
    cause = np.full(len(row), SURFACE, np.uint8) if returns.cause is None else returns.cause
    cause[from_air] = require_column(air_hits.cause)[-1 - row[from_air]]
    returns.triangle[from_air] = NO_SURFACE
    if returns.color is not None:
        returns.color[from_air] = pack_colors(GRAY[0])[0]
    if returns.source is not None:
        returns.source[from_air] = -1
    return returns._replace(cause=cause)


def _subray_hits(hits: PulseReturns, solid: Bools, *, with_velocity: bool) -> SubrayHits:
    """Convert hits for compiled loops, optionally with velocities.

    `solid` (n,) states whether each hit is on a surface. It is empty for hits in the air.
    """
    from .separation_loops import SubrayHits

    velocity = hits.velocity if with_velocity else None
    return SubrayHits(
        ray=to_writable(hits.ray, np.int64),
        distance=to_writable(hits.distance),
        energy=to_writable(require_column(hits.energy)),
        velocity=_NO_VALUES if velocity is None else to_writable(velocity),
        solid=solid,
    )


def neighbors_of(subrays: int, planes: Planes | None) -> SubrayNeighbors:
    """Return the neighboring sub-rays and the planes of hits, for compiled loops.

    Without planes, no surface continues from sub-ray to sub-ray.
    """
    from .pulse_loops import SubrayNeighbors

    if planes is None or subrays == 1:
        no_planes = np.zeros((3, 0))
        return SubrayNeighbors(subrays, np.zeros((0, 2), np.int64), no_planes, no_planes)
    normals, directions = planes
    pairs = to_writable(neighboring_subrays(subrays), np.int64)
    return SubrayNeighbors(subrays, pairs, to_writable(normals.T), to_writable(directions.T))


class SeparationStep(PulseStep):
    """Simulation step that combines nearby hits into returns, and keeps those to be reported."""

    role = Role.FRAME
    reads = "ray", "distance", "triangle", "energy", "velocity"
    writes = *RETURN_COLUMNS, "velocity"
    purposes = LOSS, DETECTION

    @staticmethod
    def applies(setup: Setup) -> bool:
        """Return whether the number of returns per ray varies, and no waveforms are used."""
        return setup.return_count_varies and not setup.in_waveforms

    def apply(self, returns: PulseReturns, batch: PulseBatch) -> PulseReturns:
        """Combine the hits of a batch into returns."""
        setup = self.setup
        # If the receiver adds or merges returns, `SelectionStep` selects the reported returns.
        selects_later = setup.has_received_returns or setup.is_recorded
        mode: Mode = "all" if selects_later else setup.reporting.mode
        # Recorded returns were detected before, so `DetectionStep` decides whether they still are.
        noise = None if setup.is_recorded else setup.noise
        reporting = Reporting(mode, noise, batch.keys, batch.start)
        return separate_hits(
            returns,
            setup.half_pulse_m,
            batch.subrays_per_beam,
            batch.planes,
            batch.air,
            reporting,
        )


class SelectionStep(PulseStep):
    """Simulation step that selects the returns to report after the receiver adds or merges some."""

    role = Role.FRAME
    reads = "ray", "energy", "amplitude"

    @staticmethod
    def applies(setup: Setup) -> bool:
        """Return whether the receiver adds or merges returns before the selection."""
        return setup.has_received_returns or setup.is_recorded

    def apply(self, returns: PulseReturns, batch: PulseBatch) -> PulseReturns:
        """Keep the reported returns of a batch."""
        return returns.take(reported_mask(returns, self.setup.reporting.mode))


def reported_mask(returns: PulseReturns, mode: Mode) -> Bools:
    """Return whether each return is reported in the given mode."""
    from . import separation_loops

    shown = np.empty(len(returns.ray), np.bool_)
    ray = to_writable(returns.ray, np.int64)
    separation_loops.mark_reported(ray, to_writable(returns.height), MODES.index(mode), shown)
    return shown

"""Returns of pulses: hits that a receiver cannot tell apart are one, and which are reported."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..base.arrays import Bools, owned
from ..scene.colours import GREY, packed
from ..sensor.disc import neighbours
from ..sensor.noise import THRESHOLD_SIGMAS, Noise
from ..sensor.optics import Mode
from ..sensor.random_numbers import quantiles, starts
from .detection import DETECTION, LOSS
from .returns import (
    NO_SURFACE,
    OF_RETURNS,
    SURFACE,
    Keys,
    Planes,
    PulseReturns,
    made,
    selected,
    unreal,
)
from .step import PulseBatch, PulseStep, Role, Setup

if TYPE_CHECKING:
    from .pulse_loops import Neighbours
    from .separation_loops import SubrayHits

MODES: tuple[Mode, ...] = "all", "first", "last", "strongest", "dual"  # as of `separation_loops`
_NONE = np.zeros(0)


class Report(NamedTuple):
    """Which returns are detected and reported."""

    mode: Mode = "all"
    noise: Noise | None = None  # by which returns are lost; None if all are detected
    keys: Keys | None = None
    first: int = 0  # number of the first beam for the keys


def separated(
    hits: PulseReturns,
    gap_m: float,
    each: int = 1,
    planes: Planes | None = None,
    air: PulseReturns | None = None,
    report: Report | None = None,
) -> PulseReturns:
    """Make returns of hits: those of a beam within a distance of the next are one return.

    So are hits of neighbouring sub-rays on one surface, however far apart the hits are: a beam that
    grazes a road illuminates all of the road between them. The energy of a return is the sum over
    the hits, the distance and velocity are means weighted by energy, the triangle and colour are
    those of the strongest hit. Hits without energy are dropped.

    The hits of all sub-rays, `each` of a beam, are in the order of rays; `gap_m` is half of the
    pulse's length. Returns are in the order of beams and distances; their `ray` is the beam.
    """
    from . import random_loops, separation_loops  # not before: numba takes half a second to import

    drops = PulseReturns.none()._replace(energy=_NONE) if air is None else air
    mode, noise, keys, first = report or Report()
    moves = hits.velocity is not None
    size = len(hits.ray) + len(drops.ray)
    made_returns = separation_loops.MadeReturns(
        beam=np.empty(size, np.int64),
        row=np.empty(size, np.int64),
        distance=np.empty(size),
        energy=np.empty(size),
        velocity=np.empty(size),
    )
    detects = noise is not None and noise.loses
    count = separation_loops.returns(
        _subray_hits(hits, hits.triangle != NO_SURFACE, moves=moves),
        _subray_hits(drops, np.zeros(0, np.bool_), moves=moves),
        neighbours_of(each, planes),
        separation_loops.Receiver(
            subrays=each,
            gap_m=gap_m,
            mode=MODES.index(mode),
            dropout=float(noise.dropout) if noise is not None and detects else 0.0,
            threshold=float(noise.threshold) if noise is not None and detects else 0.0,
            threshold_sigmas=THRESHOLD_SIGMAS,
            quantiles=quantiles() if detects else _NONE,
        ),
        random_loops.RandomKeys(
            starts=starts(noise.seed, LOSS, DETECTION)
            if noise is not None and detects
            else np.zeros(0, np.uint64),
            scan=0 if keys is None else keys.scan,
            begins=np.zeros(1, np.int64) if keys is None else owned(keys.begins, np.int64),
            first=first,
        ),
        made_returns,
    )
    beam, row, distance, energy, velocity = made_returns.first(count)
    if len(hits.ray):
        columns = hits.triangle, hits.colour, hits.cause
        triangle, *more = selected(columns, np.maximum(row, 0))
        returns = PulseReturns(beam, distance, triangle, energy, *more)
    else:
        returns = unreal(hits, beam, distance, energy, SURFACE)
    if len(drops.ray):
        from_air = np.flatnonzero(row < 0)
        cause = np.full(count, SURFACE, np.uint8) if returns.cause is None else returns.cause
        cause[from_air] = made(drops.cause)[-1 - row[from_air]]
        returns.triangle[from_air] = NO_SURFACE
        if returns.colour is not None:
            returns.colour[from_air] = packed(GREY[0])[0]
        returns = returns._replace(cause=cause)
    return returns._replace(ray=beam + first, velocity=velocity if moves else None)


def _subray_hits(hits: PulseReturns, solid: Bools, *, moves: bool) -> SubrayHits:
    """Return hits as loops take them, with velocities if returns have some."""
    from .separation_loops import SubrayHits

    velocity = hits.velocity if moves else None
    return SubrayHits(
        ray=owned(hits.ray, np.int64),
        distance=owned(hits.distance),
        energy=owned(made(hits.energy)),
        velocity=_NONE if velocity is None else owned(velocity),
        solid=solid,
    )


def neighbours_of(each: int, planes: Planes | None) -> Neighbours:
    """Return where surfaces may continue, as loops take it: without planes nowhere."""
    from .pulse_loops import Neighbours

    if planes is None or each == 1:
        return Neighbours(np.zeros((0, 2), np.int64), np.zeros((3, 0)), np.zeros((3, 0)))
    normals, directions = planes
    return Neighbours(owned(neighbours(each), np.int64), owned(normals.T), owned(directions.T))


class SeparationStep(PulseStep):
    """Makes returns of hits by their distances; one loop detects and reports them as well."""

    role = Role.FRAME
    reads = "ray", "distance", "triangle", "energy", "velocity"
    writes = *OF_RETURNS, "velocity"
    purposes = LOSS, DETECTION

    @staticmethod
    def applies(setup: Setup) -> bool:
        """See `PulseStep.applies`."""
        return setup.has_several_returns and not setup.in_waveforms

    def apply(self, returns: PulseReturns, batch: PulseBatch) -> PulseReturns:
        """See `PulseStep.apply`."""
        setup = self.setup
        shown = (
            "all" if setup.has_received_returns else setup.reporting.mode
        )  # then `SelectionStep`
        report = Report(shown, setup.noise, batch.keys, batch.start)
        return separated(
            returns, setup.half_pulse_m, batch.subrays_per_beam, batch.planes, batch.air, report
        )


class SelectionStep(PulseStep):
    """Reports some of a pulse's returns, after those that waveforms and receivers made."""

    role = Role.FRAME
    reads = "ray", "energy", "amplitude"

    @staticmethod
    def applies(setup: Setup) -> bool:
        """See `PulseStep.applies`."""
        return setup.has_received_returns

    def apply(self, returns: PulseReturns, batch: PulseBatch) -> PulseReturns:
        """See `PulseStep.apply`."""
        return returns.take(chosen(returns, self.setup.reporting.mode))


def chosen(returns: PulseReturns, mode: Mode) -> Bools:
    """Return whether a mode reports each return: (n,)."""
    from . import separation_loops

    shown = np.empty(len(returns.ray), np.bool_)
    ray = owned(returns.ray, np.int64)
    separation_loops.reported(ray, owned(returns.height), MODES.index(mode), shown)
    return shown

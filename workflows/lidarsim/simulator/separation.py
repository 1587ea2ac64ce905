"""Returns of pulses: hits that a receiver cannot tell apart are one, and which are reported."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..base.arrays import AnyArray, Bools, owned
from ..scene.colours import GREY, packed
from ..sensor.disc import neighbours
from ..sensor.noise import THRESHOLD_SIGMAS, Noise, Purpose, quantiles, starts
from ..sensor.optics import Mode
from .returns import (  # fmt: skip
    AIR,
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
from .step import PulseBatch, PulseStep, Setup

MODES: tuple[Mode, ...] = "all", "first", "last", "strongest", "dual"  # as of `pulse_loops`
_NONE = np.zeros(0)


class Report(NamedTuple):
    """Which returns are detected and reported."""

    mode: Mode = "all"
    noise: Noise | None = None  # which loses some; None if all are detected
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

    So are hits of neighbouring sub-rays on one surface, however far apart they are: a beam that
    grazes a road illuminates all of the road between them. A return's energy is the sum over its
    hits, its distance and velocity their means weighted by energy, its triangle and colour those of
    the strongest. Hits without energy are dropped.

    The hits of all sub-rays, `each` of a beam, are in the order of rays; `gap_m` is half of the
    pulse's length. Returns are in the order of beams and distances; their `ray` is the beam.
    """
    from . import pulse_loops  # not before: numba takes half a second to import

    flies = PulseReturns.none()._replace(energy=_NONE) if air is None else air
    mode, noise, keys, first = report or Report()
    begun, table, limits = np.zeros(0, np.uint64), _NONE, (0.0, 0.0, THRESHOLD_SIGMAS)
    if noise is not None and noise.loses:
        begun, table = starts(noise.seed, Purpose.LOSS, Purpose.DETECTION), quantiles()
        limits = noise.dropout, noise.threshold, THRESHOLD_SIGMAS
    speeds = _NONE if hits.velocity is None else hits.velocity
    begins, scan = (np.zeros(1), 0) if keys is None else (keys.begins, keys.scan)
    most = len(hits.ray) + len(flies.ray)
    winds = _NONE if hits.velocity is None or flies.velocity is None else flies.velocity
    whole, real = np.empty((2, most), np.int64), np.empty((3, most))
    count = pulse_loops.returns(
        each, gap_m, MODES.index(mode),
        owned(hits.ray, np.int64), owned(hits.distance), owned(made(hits.energy)),
        hits.triangle != NO_SURFACE, owned(speeds),
        owned(flies.ray, np.int64), owned(flies.distance), owned(made(flies.energy)), owned(winds),
        *surfaces_of(each, planes), *map(float, limits), begun, table, scan,
        owned(begins, np.int64), first, whole, real,
    )  # fmt: skip
    beam, row = whole[:, :count].copy()
    distance, energy, velocity = real[:, :count].copy()
    if len(hits.ray):
        columns = hits.triangle, hits.colour, hits.cause
        triangle, *more = selected(columns, np.maximum(row, 0))
        found = PulseReturns(beam, distance, triangle, energy, *more)
    else:
        found = unreal(hits, beam, distance, energy, AIR)
    if len(flies.ray):
        some = np.flatnonzero(row < 0)
        cause = np.full(count, SURFACE, np.uint8) if found.cause is None else found.cause
        cause[some], found.triangle[some] = made(flies.cause)[-1 - row[some]], NO_SURFACE
        if found.colour is not None:
            found.colour[some] = packed(GREY[0])[0]
        found = found._replace(cause=cause)
    return found._replace(
        ray=beam + first,
        velocity=None if hits.velocity is None else velocity,
    )


def surfaces_of(each: int, planes: Planes | None) -> tuple[AnyArray, ...]:
    """Return neighbours among sub-rays, and planes of hits, as loops take them; or none."""
    pairs, normals, directions = np.zeros((0, 2), np.int64), np.zeros((0, 3)), np.zeros((0, 3))
    if planes is not None and each > 1:
        (normals, directions), pairs = planes, neighbours(each)
    return owned(pairs, np.int64), owned(normals.T), owned(directions.T)


class SeparationStep(PulseStep):
    """Makes returns of hits by their distances; one loop detects and reports them as well."""

    reads = "ray", "distance", "triangle", "energy", "velocity"
    writes = *OF_RETURNS, "velocity"
    purposes = Purpose.LOSS, Purpose.DETECTION

    @staticmethod
    def applies(setup: Setup) -> bool:
        """See `PulseStep.applies`."""
        return setup.several and not setup.in_waveforms

    def apply(self, returns: PulseReturns, batch: PulseBatch) -> PulseReturns:
        """See `PulseStep.apply`."""
        setup = self.setup
        shown = "all" if setup.receives_more else setup.reporting.mode  # then `SelectionStep`
        report = Report(shown, setup.noise, batch.keys, batch.start)
        return separated(returns, setup.gap_m, batch.each, batch.planes, batch.air, report)


class SelectionStep(PulseStep):
    """Reports some of a pulse's returns, after those that waveforms and receivers made."""

    reads = "ray", "energy", "amplitude"

    @staticmethod
    def applies(setup: Setup) -> bool:
        """See `PulseStep.applies`."""
        return setup.in_waveforms or setup.receives_more

    def apply(self, returns: PulseReturns, batch: PulseBatch) -> PulseReturns:
        """See `PulseStep.apply`."""
        return returns.take(chosen(returns, self.setup.reporting.mode))


def chosen(returns: PulseReturns, mode: Mode) -> Bools:
    """Whether a mode reports each return: (n,)."""
    from . import pulse_loops

    there, number = np.empty(len(returns.ray), np.bool_), MODES.index(mode)
    pulse_loops.reported(owned(returns.ray, np.int64), owned(returns.height), number, there)
    return there

"""What a standing sensor repeats: the returns of each ray in all sweeps, and their scatter."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from ..base.arrays import Bools, Floats, Floats32, Ints
from ..base.errors import LidarpoolError, prefixed
from ..base.sampling import even_indices
from ..base.words import plural
from .range_image import range_images
from .recordings import Recording

MOST_VALUES = 1 << 24  # returns in memory; of more sweeps than these make, some are read
_WHOLE = 0.8  # a sweep with fewer points than this share of the median is cut
_STILL_M = 0.1  # a median change of ranges, from sweep to sweep, of a sensor that moves
_KINK_M, _KINK = 0.01, 0.001  # by how much a surface may leave its plane within four columns
_SIGMAS = 6.0  # a return beyond these is of something that moves
_STEEPEST = 5.7  # tangent of incidence: beyond, a beam meets several surfaces
_TURN = 2 * np.pi


@dataclass(frozen=True, eq=False)
class Repeats:
    """Returns in the same cells of a sensor, the highest ring first; NaN without a return."""

    rings: Ints  # (r,): numbers
    elevation: Floats  # (r,): radians
    azimuth: Floats  # (r, c): means, radians
    ranges: Floats32  # (s, r, c): metres
    light: Floats32  # (s, r, c): intensities
    aside: Floats32  # (s, r, c): azimuths beside the means, radians
    notes: tuple[str, ...]

    @classmethod
    def read(cls, recording: Recording) -> Repeats:
        """Put the sweeps of a recording into the same cells, one after the other.

        Raises
        ------
        LidarpoolError
            If it has no sweeps with points and rings, or they are of several sensors.
        """
        name, notes = recording.name, list(recording.notes)
        if recording.whole or not recording.count:
            raise LidarpoolError(f"{name} has no sweeps: give a recording of sweeps.")
        own = max((recording.turn(k) for k in range(min(3, recording.count))), key=len)
        if not len(own):
            raise LidarpoolError(f"{name} has no points: there is nothing to fit.")
        with prefixed(name):
            cells = range_images(own, own, ("the first", "the first"))
        shape = len(cells.rings), round(360 / cells.step_deg)
        numbers = even_indices(recording.count, max(MOST_VALUES // (shape[0] * shape[1]), 2))
        if len(numbers) < recording.count:
            notes.append(f"{len(numbers):,} of {recording.count:,} sweeps are used, evenly chosen")
        values = np.full((3, len(numbers), *shape), np.nan, np.float32)
        for k, number in enumerate(numbers.tolist()):
            if not len(turn := recording.turn(number)):
                continue
            with prefixed(name):
                names = f"sweep {number}", "an earlier one"
                found = range_images(turn, own, names, cells.step_deg)
                other = len(found.rings) > 1.2 * len(cells.rings)
                if other or found.hidden[0] > cells.hidden[0] + 0.25:
                    raise LidarpoolError(f"sweep {number} is of another sensor, or another mode.")
            _, rows, there = np.intersect1d(found.rings, cells.rings, return_indices=True)
            columns = round(found.begin_deg / found.step_deg) + np.arange(found.ranges.shape[2])
            azimuth, lights = np.radians(found.azimuth_deg), found.compared[0, 1]
            images = np.stack([found.ranges[0], lights.reshape(azimuth.shape), azimuth])
            values[:, k, there[:, None], columns % shape[1]] = images[:, rows]
        counts = np.isfinite(values[0]).sum(axis=(1, 2))
        whole = counts >= _WHOLE * np.median(counts[counts > 0])
        if not whole.all():
            notes.append(f"{plural(int((~whole).sum()), 'sweep')} cut short, left out")
        ranges, light, aside = values[:, whole]
        first = np.radians(cells.step_deg * np.arange(shape[1])).astype(np.float32)
        aside = (aside - first + np.pi) % _TURN - np.pi
        mean = np.nansum(aside, axis=0) / np.maximum(np.isfinite(aside).sum(axis=0), 1)
        up = np.radians(cells.elevation_deg)
        return cls(cells.rings, up, first + mean, ranges, light, aside - mean, tuple(notes))

    @property
    def moves(self) -> bool:
        """Whether the sensor moves, or most around it: ranges drift."""
        last = len(self.ranges) - 1
        steps = _quiet(np.abs(np.diff(self.ranges, axis=0)), (0, 1, 2)) if last else 0.0
        drift = _quiet(np.abs(self.ranges[-1] - self.ranges[0]), (0, 1))
        return bool(steps > _STILL_M or drift > min(0.6 + 0.4 * last, 3) * steps + 0.001)

    def first(self) -> Repeats:
        """Return the first sweep alone."""
        return replace(self, ranges=self.ranges[:1], light=self.light[:1], aside=self.aside[:1])

    def middle(self) -> Floats:
        """Return the medians of the ranges, (r, c)."""
        return _quiet(self.ranges, 0)

    def rough_sigma(self) -> Floats:
        """Return the scatter of each ring's ranges, from sweep to sweep: (r, c), metres."""
        sigma = np.full(len(self.rings), _KINK_M)
        if len(self.ranges) > 1:
            steps = np.nan_to_num(_quiet(np.abs(np.diff(self.ranges, axis=0)), (0, 2)))
            sigma = np.maximum(steps / (0.6745 * np.sqrt(2)), 1e-4)
        return np.repeat(sigma[:, None], self.azimuth.shape[1], axis=1)

    def directions(self) -> Floats:
        """Return the unit vectors of the cells, (r, c, 3)."""
        up, turned = np.broadcast_arrays(self.elevation[:, None], self.azimuth)
        ways = np.cos(up) * np.cos(turned), np.cos(up) * np.sin(turned), np.sin(up)
        return np.stack(ways, axis=-1)


def _quiet(values: Floats32, axis: int | tuple[int, ...]) -> Any:
    """Return medians over what is there, float64; of nothing NaN."""
    with warnings.catch_warnings(action="ignore"):
        return np.nanmedian(values, axis=axis).astype(np.float64)


class Neighbourhood(NamedTuple):
    """What the rays of a standing sensor meet, (r, c) each; NaN where nothing is."""

    distance: Floats  # metres
    turn: Floats  # by how much the range changes with the azimuth, metres in a radian
    slope: Floats  # and with the direction where it changes most
    smooth: Bools  # whether the neighbours lie in one plane with it


def surroundings(repeats: Repeats, distance: Floats, blur: Floats) -> Neighbourhood:
    """Find slopes and edges of a range image, whose ranges have errors of `blur` metres.

    The inverse of the range to a plane is linear over small angles.
    """
    rows, azimuth = len(distance), repeats.azimuth
    beams = repeats.elevation - 1e-9 * np.arange(rows)  # some rings have equal ones
    with np.errstate(invalid="ignore", divide="ignore"):
        inverse, square = 1 / distance, distance * distance
        step = (np.roll(azimuth, -1, axis=1) - azimuth) % _TURN
        ahead, back, far, rear = (np.roll(inverse, by, axis=1) for by in (-1, 1, -2, 2))
        across = (2 * (far - rear) + ahead - back) / (10 * step)
        sideways = (azimuth - azimuth[:1] + np.pi) % _TURN - np.pi
        rise = np.zeros_like(across)
        if rows > 2:  # from ring to ring, less what the azimuth changes
            along = np.gradient(np.stack([inverse, sideways]), beams, axis=1, edge_order=2)
            rise = along[0] - across * along[1]
        slope = square * np.hypot(across / np.cos(beams)[:, None], rise)
        allowed = _KINK_M + _KINK * distance + 5 * blur
        smooth = np.abs(square * (inverse - (ahead + back) / 2)) < allowed
        smooth &= np.abs(square * (inverse - (far + rear) / 2)) < 2 * allowed
        for by in (-1, 1):
            other = np.clip(np.arange(rows) + by, 0, rows - 1)
            off = inverse[other] - inverse - across * (sideways[other] - sideways)
            off -= rise * (beams[other] - beams)[:, None]
            smooth &= np.abs(square * off) < 2 * allowed
        smooth &= slope < _STEEPEST * distance
    return Neighbourhood(distance, -square * across, slope, smooth)


class Rays(NamedTuple):
    """Rays that meet smooth surfaces, (k,) each."""

    row: Ints
    column: Ints
    distance: Floats  # mean of the ranges, metres
    slope: Floats  # by how much the range changes with the direction, metres in a radian
    light: Floats  # mean intensity; NaN if unknown
    returns: Ints  # sweeps with one
    variance: Floats  # of the range over the sweeps, square metres
    freedom: Ints  # returns of which it is, less one

    def take(self, rows: Bools) -> Rays:
        """Select rays."""
        return Rays._make(one[rows] for one in self)


def smooth_rays(repeats: Repeats, around: Neighbourhood, sigma: Floats, aim: float) -> Rays:
    """Choose rays without edges beside them, with the scatter of their ranges over the sweeps.

    Returns that noise of `sigma` (r, c) and directions that scatter by `aim` radians do not
    explain are left out, and rays with many of them.
    """
    row, column = cell = np.nonzero(around.smooth)
    images = repeats.ranges, repeats.light, repeats.aside
    ranges, light, aside = (one[:, row, column].astype(np.float64) for one in images)
    ranges -= around.turn[cell] * aside
    slope, returns = around.slope[cell], np.isfinite(ranges).sum(axis=0)
    limit = np.where(returns > 1, _SIGMAS * np.hypot(sigma[cell], aim * slope), np.inf)
    kept = np.abs(ranges - around.distance[cell]) <= limit
    used = kept.sum(axis=0)
    mean = np.where(kept, ranges, 0).sum(axis=0) / np.maximum(used, 1)
    variance = np.where(kept, (ranges - mean) ** 2, 0).sum(axis=0) / np.maximum(used - 1, 1)
    bright = np.where(kept, light, 0).sum(axis=0) / np.maximum(used, 1)
    rays = Rays(row, column, mean, slope, bright, returns, variance, used - 1)
    return rays.take((used > 0) & (used >= _WHOLE * returns))

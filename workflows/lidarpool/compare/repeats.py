"""What a standing sensor repeats: the returns of each ray in all sweeps, and their scatter."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from ..base.arrays import Bools, Floats, Floats32, Ints
from ..base.errors import LidarpoolError, prefixed
from ..base.sampling import even_indices
from ..base.words import plural
from .range_image import range_images
from .recordings import Recording

MOST_VALUES = 1 << 24  # returns in memory; of more sweeps than these make, some are read
_WHOLE = 0.8  # a sweep with fewer points than this share of the median is cut
_STILL_M, _DRIFT = 0.1, 3.0  # change of ranges in a sweep; in all sweeps, as a multiple of it
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
                found = range_images(turn, own, (f"sweep {number}", "an earlier one"))
                if found.step_deg != cells.step_deg or found.hidden[0] > cells.hidden[0] + 0.25:
                    raise LidarpoolError(f"sweep {number} is of another sensor, or another mode.")
            _, rows, there = np.intersect1d(found.rings, cells.rings, return_indices=True)
            columns = round(found.begin_deg / found.step_deg) + np.arange(found.ranges.shape[2])
            lights = found.compared[0, 1].reshape(found.ranges[0].shape)
            image = np.stack([found.ranges[0], lights, np.radians(found.azimuth_deg)])
            values[:, k, there[:, None], columns % shape[1]] = image[:, rows]
        counts = np.isfinite(values[0]).sum(axis=(1, 2))
        whole = counts >= _WHOLE * np.median(counts[counts > 0])
        if not whole.all():
            notes.append(f"{plural(int((~whole).sum()), 'sweep')} cut short, left out")
        ranges, light, aside = values[:, whole]
        first = np.radians(cells.step_deg) * np.arange(shape[1])
        aside = (aside - first.astype(np.float32) + np.pi) % _TURN - np.pi
        mean = _quiet(np.nanmean, aside, axis=0)
        up = np.radians(cells.elevation_deg)
        azimuth = np.nan_to_num(mean) + first
        return cls(cells.rings, up, azimuth, ranges, light, aside - mean, tuple(notes))

    @property
    def sweeps(self) -> int:
        """How many there are."""
        return len(self.ranges)

    @property
    def moves(self) -> bool:
        """Whether the sensor moves, or most around it."""
        if self.sweeps < 2:
            return False
        steps = _quiet(np.nanmedian, np.abs(np.diff(self.ranges, axis=0)))
        drift = _quiet(np.nanmedian, np.abs(self.ranges[-1] - self.ranges[0]))
        return bool(steps > _STILL_M or (self.sweeps > 4 and drift > _DRIFT * steps + 1e-3))

    def first(self) -> Repeats:
        """Return the first sweep alone."""
        images = (one[:1] for one in (self.ranges, self.light, self.aside))
        return Repeats(self.rings, self.elevation, self.azimuth, *images, self.notes)

    def middle(self) -> Floats:
        """Return the medians of the ranges, (r, c)."""
        return _quiet(np.nanmedian, self.ranges, axis=0)

    def rough_sigma(self) -> Floats:
        """Return the scatter of each ring's ranges, from sweep to sweep: (r, c), metres."""
        if self.sweeps < 2:
            return np.full(self.azimuth.shape, _KINK_M)
        steps = _quiet(np.nanmedian, np.abs(np.diff(self.ranges, axis=0)), axis=(0, 2))
        sigma = np.maximum(np.nan_to_num(steps) / (0.6745 * np.sqrt(2)), 1e-4)
        return np.broadcast_to(sigma[:, None], self.azimuth.shape).copy()

    def directions(self) -> Floats:
        """Return the unit vectors of the cells, (r, c, 3)."""
        up, turned = self.elevation[:, None], self.azimuth
        flat, high = np.cos(up), np.sin(up) + 0 * turned
        return np.stack([flat * np.cos(turned), flat * np.sin(turned), high], axis=-1)


def _quiet(reduce: Any, values: Floats32, **given: Any) -> Floats:
    """Reduce cells, of which some have no return."""
    with warnings.catch_warnings(action="ignore"):
        return np.asarray(reduce(values, **given), np.float64)


@dataclass(frozen=True, eq=False)
class Surroundings:
    """What the rays of a standing sensor meet, (r, c) each; NaN where nothing is."""

    distance: Floats  # metres
    turn: Floats  # by how much the range changes with the azimuth, metres in a radian
    slope: Floats  # and with the direction where it changes most
    smooth: Bools  # whether the neighbours lie in one plane with it

    @classmethod
    def of(cls, repeats: Repeats, distance: Floats, blur: Floats) -> Surroundings:
        """Find slopes and edges of a range image, whose ranges have errors of `blur` metres.

        The inverse of the range to a plane is linear over small angles.
        """
        rows = len(distance)
        beams = repeats.elevation - 1e-9 * np.arange(rows)  # some rings have equal ones
        with np.errstate(invalid="ignore", divide="ignore"):
            inverse, square = 1 / distance, distance * distance
            step = (np.roll(repeats.azimuth, -1, axis=1) - repeats.azimuth) % _TURN
            ahead, back, far, rear = (np.roll(inverse, by, axis=1) for by in (-1, 1, -2, 2))
            across = (2 * (far - rear) + ahead - back) / (10 * step)
            sideways = (repeats.azimuth - repeats.azimuth[:1] + np.pi) % _TURN - np.pi
            rise = np.zeros_like(across)
            if rows > 2:  # from ring to ring, less what the azimuth changes
                along = np.gradient(np.stack([inverse, sideways]), beams, axis=1, edge_order=2)
                rise = along[0] - across * along[1]
            allowed = _KINK_M + _KINK * distance + 5 * blur
            smooth = np.abs(square * (inverse - (ahead + back) / 2)) < allowed
            smooth &= np.abs(square * (inverse - (far + rear) / 2)) < 2 * allowed
            for by in (-1, 1):
                other = np.clip(np.arange(rows) + by, 0, rows - 1)
                expected = inverse + across * (sideways[other] - sideways)
                expected += rise * (beams[other] - beams)[:, None]
                smooth &= np.abs(square * (inverse[other] - expected)) < 2 * allowed
            slope = square * np.hypot(across / np.cos(beams)[:, None], rise)
            return cls(distance, -square * across, slope, smooth & (slope < _STEEPEST * distance))


@dataclass(frozen=True, eq=False)
class Rays:
    """Rays that meet smooth surfaces, (k,) each."""

    row: Ints
    column: Ints
    distance: Floats  # mean of the ranges, metres
    slope: Floats  # by how much the range changes with the direction, metres in a radian
    light: Floats  # mean intensity; NaN if unknown
    count: Ints  # sweeps with a return
    variance: Floats  # of the range over the sweeps, square metres
    freedom: Ints  # returns of which it is, less one

    def __len__(self) -> int:
        return len(self.row)

    def take(self, rows: Bools) -> Rays:
        """Select rays."""
        return Rays(*(getattr(self, one.name)[rows] for one in fields(self)))

    @classmethod
    def of(cls, repeats: Repeats, around: Surroundings, sigma: Floats, aim: float) -> Rays:
        """Choose rays without edges beside them, with the scatter of their ranges over the sweeps.

        Returns that noise of `sigma` (r, c) and directions that scatter by `aim` radians do not
        explain are left out, and rays with many of them.
        """
        row, column = np.nonzero(around.smooth)
        ranges, light, aside = (
            one[:, row, column].astype(np.float64)
            for one in (repeats.ranges, repeats.light, repeats.aside)
        )
        ranges -= around.turn[row, column] * aside
        slope, count = around.slope[row, column], np.isfinite(ranges).sum(axis=0)
        limit = _SIGMAS * np.hypot(sigma[row, column], aim * slope)
        limit = np.where(count > 1, limit, np.inf)
        kept = np.abs(ranges - around.distance[row, column]) <= limit
        used = kept.sum(axis=0)
        many, free = np.maximum(used, 1), np.maximum(used - 1, 1)
        mean = np.where(kept, ranges, 0).sum(axis=0) / many
        variance = np.where(kept, (ranges - mean) ** 2, 0).sum(axis=0) / free
        bright = np.where(kept, light, 0).sum(axis=0) / many
        rays = cls(row, column, mean, slope, bright, count, variance, used - 1)
        return rays.take((used > 0) & (used >= _WHOLE * count))

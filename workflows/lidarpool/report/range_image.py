"""Range images of two sweeps of one sensor on common cells: rings and steps of azimuth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..base.errors import LidarpoolError
from ..export.recordings import Turn

Floats = NDArray[np.float64]
Reals = NDArray[np.float32]

_TILT_DEG = 0.5  # that half of a ring's points may be off its cone, of rings nearer to each other
_ALIKE = 0.01  # by how much steps of azimuth may differ that are meant to be the same
_SECTOR_DEG = (
    90.0  # a gap as wide as this in all rings is none of returns, but of the field of view
)
_FINEST_DEG = 1e-3  # points nearer in azimuth are of one pulse


@dataclass(frozen=True, eq=False)
class RangeImages:
    """Ranges and intensities of two sweeps in the same cells, (rings, columns)."""

    rings: NDArray[np.int64]  # (r,): as B numbers them, the highest first
    elevation_deg: Floats  # (r,)
    step_deg: float  # width of a column
    begin_deg: float  # azimuth of the first
    ranges: tuple[Reals, Reals]  # of A and B, metres; NaN without a return
    lights: tuple[Reals, Reals]  # intensities; NaN where unknown
    hidden: tuple[float, float]  # shares of points of A and B that others in their cells hide
    notes: tuple[str, ...]

    @property
    def there(self) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Where A and B have returns."""
        return np.isfinite(self.ranges[0]), np.isfinite(self.ranges[1])

    @property
    def residual(self) -> Reals:
        """Range of A minus that of B, metres; NaN where one has no return."""
        return self.ranges[0] - self.ranges[1]


@dataclass(frozen=True, eq=False)
class _Polar:
    """A sweep in polar coordinates."""

    azimuth: Floats  # (n,): degrees, 0 to 360
    ranges: Floats
    ring: NDArray[np.int64]  # (n,): index into `rings`
    light: Floats | None
    rings: NDArray[np.int64]  # (r,): numbers
    elevation: Floats  # (r,): medians, degrees

    @classmethod
    def of(cls, turn: Turn, name: str) -> _Polar:
        """Convert a sweep; LidarpoolError if it has no rings, or they are not around its zero."""
        if turn.rings is None:
            raise LidarpoolError(
                f"{name} has no rings: the range image needs a column ring or channel"
            )
        x, y, z = turn.points.T
        elevation = np.degrees(np.arctan2(z, np.hypot(x, y)))
        rings, index = np.unique(turn.rings, return_inverse=True)
        order = np.lexsort((elevation, index))
        ends = np.searchsorted(index[order], np.arange(len(rings) + 1))
        sizes = np.diff(ends)
        low, middle, high = (
            elevation[order][ends[:-1] + (share * (sizes - 1)).astype(np.intp)]
            for share in (0.25, 0.5, 0.75)
        )
        if np.median(high - low) > max(_TILT_DEG, _spacing(middle)):
            raise LidarpoolError(
                f"{name} has rings that are no cones around zero: its points are in the world's "
                "axes, or of several poses, and the range image needs those of the sensor"
            )
        ranges = np.linalg.norm(turn.points, axis=1)
        azimuth = np.degrees(np.arctan2(y, x)) % 360
        return cls(azimuth, ranges, index, turn.light, rings, middle)

    def step(self) -> float:
        """Typical step from a pulse to the next of its ring, degrees."""
        order = np.lexsort((self.azimuth, self.ring))
        steps = np.diff(self.azimuth[order])[np.diff(self.ring[order]) == 0]
        steps = steps[steps > _FINEST_DEG]
        if not len(steps):
            return 1.0
        # Gaps are several steps; of the rest, sums know the step better than any single one.
        first = np.quantile(steps, 0.2)
        count = np.round(steps / first)
        near = (count >= 1) & (count <= 3)
        return float(steps[near].sum() / count[near].sum())

    def phases(self, step: float) -> Floats:
        """Where the pulses of each ring are within a step: (r,), in steps, -0.5 to 0.5."""
        turn = np.exp(2j * np.pi * self.azimuth / step)
        sums = np.bincount(self.ring, turn.real) + 1j * np.bincount(self.ring, turn.imag)
        return np.asarray(np.angle(sums) / (2 * np.pi))

    def image(
        self, rows: NDArray[np.int64], phase: Floats, step: float, shape: tuple[int, int]
    ) -> tuple[Reals, Reals, float]:
        """Ranges and lights of cells, and the share of points that others in their cells hide.

        `rows` (r,) are those of its rings, -1 for none. Of several points in a cell, the one
        nearest to the middle is taken, and of several returns of a pulse the nearest.
        """
        wanted = rows[self.ring] >= 0
        ring = self.ring[wanted]
        place = self.azimuth[wanted] / step - phase[ring]
        column = np.round(place)
        off = np.round(np.abs(place - column), 3)
        cell = rows[ring] * shape[1] + column.astype(np.int64) % shape[1]
        order = np.lexsort((self.ranges[wanted], off, cell))
        chosen = order[np.diff(cell[order], prepend=-1) > 0]

        ranges, light = np.full((2, *shape), np.nan, np.float32)
        ranges.reshape(-1)[cell[chosen]] = self.ranges[wanted][chosen]
        if self.light is not None:
            light.reshape(-1)[cell[chosen]] = self.light[wanted][chosen]
        return ranges, light, 1 - len(chosen) / max(len(cell), 1)


def range_images(
    a: Turn, b: Turn, names: tuple[str, str], azimuth_deg: float | None = None
) -> RangeImages:
    """Put two sweeps of one sensor into the same cells.

    A column is as wide as the step of azimuth from pulse to pulse, the coarser of the two. Each
    ring's cells have their middles where its pulses are, so that none falls between two; a pulse of
    A is in the cell of the pulse of B that is nearest.

    Raises
    ------
    LidarpoolError
        If one has no rings, is not in the axes of its sensor, or they are not of sensors
        with the same rings; a clause without a full stop.
    """
    first, second = _Polar.of(a, names[0]), _Polar.of(b, names[1])
    of_a, of_b, notes = _paired(first, second, names)
    steps = [first.step(), second.step()]
    step = azimuth_deg or (
        steps[1] if abs(steps[0] / steps[1] - 1) < _ALIKE else max(*steps, _FINEST_DEG)
    )
    columns = max(round(360 / step), 1)
    high_first = np.argsort(-second.elevation[of_b], kind="stable")
    of_a, of_b = of_a[high_first], of_b[high_first]
    rows_a, rows_b = np.full(len(first.rings), -1), np.full(len(second.rings), -1)
    rows_a[of_a] = rows_b[of_b] = np.arange(len(of_a))
    phase_b = second.phases(step)
    phase_a = np.zeros(len(first.rings))
    apart = first.phases(step)[of_a] - phase_b[of_b]
    phase_a[of_a] = phase_b[of_b] + apart - np.round(apart)
    shape = len(of_a), columns
    image_a, light_a, hidden_a = first.image(rows_a, phase_a, step, shape)
    image_b, light_b, hidden_b = second.image(rows_b, phase_b, step, shape)
    seen = np.flatnonzero((np.isfinite(image_a) | np.isfinite(image_b)).any(axis=0))
    order, begin = _field(seen, columns, step)
    return RangeImages(
        second.rings[of_b], second.elevation[of_b], step, begin,
        (image_a[:, order], image_b[:, order]), (light_a[:, order], light_b[:, order]),
        (hidden_a, hidden_b), notes,
    )  # fmt: skip


def _spacing(elevation: Floats) -> float:
    """Typical distance between rings, degrees."""
    apart = np.diff(np.sort(elevation))
    return float(np.median(apart)) if len(apart) else 1.0


def _paired(
    a: _Polar, b: _Polar, names: tuple[str, str]
) -> tuple[NDArray[np.int64], NDArray[np.int64], tuple[str, ...]]:
    """Pair rings of A and B that look at the same elevation: their indices, and notes."""
    near = max(_spacing(b.elevation) / 2, 0.05)
    _, of_a, of_b = np.intersect1d(a.rings, b.rings, return_indices=True)
    same = np.abs(a.elevation[of_a] - b.elevation[of_b]) <= near
    notes = []
    if same.mean() < 0.9 if len(same) else True:
        apart = np.abs(a.elevation[:, None] - b.elevation[None])
        of_a = apart.argmin(axis=0)
        mutual = apart[of_a].argmin(axis=1) == np.arange(len(b.rings))
        of_b = np.flatnonzero(mutual & (apart.min(axis=0) <= near))
        of_a = of_a[of_b]
        if len(of_b) < max(1, min(len(a.rings), len(b.rings)) / 2):
            raise LidarpoolError(
                f"the rings of {names[0]} look at {a.elevation.min():.1f}° to "
                f"{a.elevation.max():.1f}° and those of {names[1]} at {b.elevation.min():.1f}° to "
                f"{b.elevation.max():.1f}°, at other angles: they are not of the same sensor"
            )
        notes.append("rings have other numbers in A than in B, and are matched by elevation")
    else:
        of_a, of_b = of_a[same], of_b[same]
    if alone := max(len(a.rings), len(b.rings)) - len(of_b):
        notes.append(f"rings that only one of the two has, or that look elsewhere: {alone}")
    return of_a, of_b, tuple(notes)


def _field(seen: NDArray[np.intp], columns: int, step: float) -> tuple[NDArray[np.int64], float]:
    """Columns within the field of view, and the azimuth of the first, -180 to 180 degrees."""
    gaps = np.diff(seen, append=seen[:1] + columns)
    widest = int(gaps.argmax())
    if gaps[widest] * step < _SECTOR_DEG:  # all around, from straight behind
        first, count = round(180 / step), columns
    else:
        first, count = int(seen[(widest + 1) % len(seen)]), columns - int(gaps[widest]) + 1
    order = (first + np.arange(count)) % columns
    begin = first * step
    return order, begin - 360 if begin >= 180 - step / 2 else begin

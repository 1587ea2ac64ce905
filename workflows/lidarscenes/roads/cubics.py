"""Cubic polynomials of a distance, in pieces: elevations, widths and offsets of OpenDRIVE."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import cached_property
from xml.etree.ElementTree import Element

import numpy as np

from lidarsim.base.arrays import Floats, Ints

from .elements import number

_JUMP = 1e-3  # smallest step between pieces for which a surface gets a station, m


class Cubics:
    """Cubic polynomials, each valid from its start to the start of the next; 0 without any.

    Before the first start, the value is that of the first start.

    Parameters
    ----------
    rows
        Start and coefficients a, b, c, d of each polynomial a + b x + c x² + d x³, in which x is
        the distance from the start.
    """

    def __init__(self, rows: Sequence[Sequence[float]] = ()) -> None:
        table = np.array(rows, np.float64).reshape(-1, 5)
        table = table[np.argsort(table[:, 0], kind="stable")]
        self.starts: Floats = table[:, 0].copy()  # (n,)
        self._coefficients = table[:, 1:].T.copy()  # (4, n)
        self._constant = not table[:, 2:].any()
        self.bent = bool(table[:, 3:].any())  # whether second derivatives are not all zero

    @classmethod
    def read(cls, elements: Iterable[Element], start: str = "s", origin: float = 0.0) -> Cubics:
        """Return the polynomials of elements, whose starts are relative to an origin."""
        rows = [
            (origin + number(e, start, 0.0), *(number(e, name, 0.0) for name in "abcd"))
            for e in elements
        ]
        return cls(rows) if rows else NOTHING

    def __len__(self) -> int:
        return len(self.starts)

    def values(self, distances: Floats) -> Floats:
        """Return the values at distances (k,)."""
        if not len(self):
            return np.zeros_like(distances)
        if self._constant and len(self) == 1:
            return np.full_like(distances, self._coefficients[0, 0])
        rows = self._rows(distances)
        a, b, c, d = self._coefficients[:, rows]
        x = np.maximum(distances - self.starts[rows], 0)
        return np.asarray(((d * x + c) * x + b) * x + a)

    def slopes(self, distances: Floats) -> Floats:
        """Return the first derivatives at distances (k,)."""
        if self._constant:
            return np.zeros_like(distances)
        rows = self._rows(distances)
        _, b, c, d = self._coefficients[:, rows]
        x = np.maximum(distances - self.starts[rows], 0)
        return np.asarray((3 * d * x + 2 * c) * x + b)

    def max_bends(self, starts: Floats, stops: Floats) -> Floats:
        """Return the largest second derivatives in intervals (k,), each within a polynomial."""
        if not self.bent:
            return np.zeros_like(starts)
        rows = self._rows((starts + stops) / 2)
        _, _, c, d = self._coefficients[:, rows]
        origins = self.starts[rows]
        first = np.abs(2 * c + 6 * d * np.maximum(starts - origins, 0))
        last = np.abs(2 * c + 6 * d * np.maximum(stops - origins, 0))
        return np.maximum(first, last)

    def max_slopes(self, starts: Floats, stops: Floats) -> Floats:
        """Return bounds of the first derivatives in intervals (k,), each within a polynomial."""
        if self._constant:
            return np.zeros_like(starts)
        middles = (starts + stops) / 2
        reach = self.max_bends(starts, stops) * (stops - starts) / 2
        return np.abs(self.slopes(middles)) + reach

    @cached_property
    def jumps(self) -> Floats:
        """Starts (j,) at which the value differs from the end of the polynomial before."""
        if len(self) < 2:
            return np.zeros(0)
        a, b, c, d = self._coefficients[:, :-1]
        x = np.diff(self.starts)
        ends = ((d * x + c) * x + b) * x + a
        return self.starts[1:][np.abs(ends - self._coefficients[0, 1:]) > _JUMP]

    def _rows(self, distances: Floats) -> Ints:
        """Return the polynomials (k,) that are valid at distances."""
        return np.maximum(np.searchsorted(self.starts, distances, "right") - 1, 0)


NOTHING = Cubics()

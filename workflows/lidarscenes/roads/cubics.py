"""Evaluate piecewise cubic polynomials of distance, such as OpenDRIVE elevations and widths."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from xml.etree.ElementTree import Element

import numpy as np

from lidarsim.numerics.arrays import Floats, Ints

from .cross_sections import RoadStations
from .elements import read_number


class Cubics:
    """Cubic polynomials, each of which is valid until the next one starts.

    Before the first start, the value at the first start applies. Without any polynomial, the value
    is 0.

    Parameters
    ----------
    rows
        Start and coefficients a, b, c, d of each polynomial a + b x + c x² + d x³, where x is the
        distance from the start.
    """

    def __init__(self, rows: Sequence[Sequence[float]] = ()) -> None:
        table = np.array(rows, np.float64).reshape(-1, 5)
        table = table[np.argsort(table[:, 0], kind="stable")]
        self.starts: Floats = table[:, 0].copy()  # (n,)
        self._coefficients = table[:, 1:].T.copy()  # (4, n)
        self.is_constant = not table[:, 2:].any()  # between starts
        self.bent = bool(table[:, 3:].any())  # whether any second derivative is nonzero

    @classmethod
    def read(cls, elements: Iterable[Element], start: str = "s", origin: float = 0.0) -> Cubics:
        """Read polynomials from elements, whose start distances are relative to an origin."""
        rows = [
            (origin + read_number(e, start, 0.0), *(read_number(e, name, 0.0) for name in "abcd"))
            for e in elements
        ]
        return cls(rows) if rows else NO_CUBICS

    def __len__(self) -> int:
        return len(self.starts)

    def values(self, stations: RoadStations) -> Floats:
        """Return the values at the given stations."""
        if not len(self):
            return np.zeros_like(stations.s)
        if self.is_constant and len(self) == 1:
            return np.full_like(stations.s, self._coefficients[0, 0])
        row_indices = self._row_indices(stations.pieces)
        a, b, c, d = self._coefficients[:, row_indices]
        x = np.maximum(stations.s - self.starts[row_indices], 0)
        return np.asarray(((d * x + c) * x + b) * x + a)

    def slopes(self, stations: RoadStations) -> Floats:
        """Return the first derivatives at the given stations."""
        if self.is_constant:
            return np.zeros_like(stations.s)
        row_indices = self._row_indices(stations.pieces)
        _, b, c, d = self._coefficients[:, row_indices]
        x = np.maximum(stations.s - self.starts[row_indices], 0)
        return np.asarray((3 * d * x + 2 * c) * x + b)

    def _row_indices(self, distances: Floats) -> Ints:
        """Return the index of the polynomial that is valid at each distance."""
        return np.maximum(np.searchsorted(self.starts, distances, "right") - 1, 0)


NO_CUBICS = Cubics()

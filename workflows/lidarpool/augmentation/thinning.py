"""Thin out recorded sweeps to some of their rings and azimuths, without a sensor model."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lidarsim.columns.sweep import Sweep
from lidarsim.errors import LidarError
from lidarsim.numerics.arrays import Floats, Ints
from lidarsim.schema.checks import check_number
from lidarsim.words import list_names

from ..clouds.recording import Recording
from .augmented_sweep import AugmentedSweep
from .nearest_pulse_loops import CandidateRings
from .resampling import copied_returns
from .ring_directions import RingDirections


class SweepThinner:
    """Keeps some rings and azimuths of recorded sweeps.

    The result resembles a sensor with fewer channels or a lower azimuth resolution. Points are
    copied with all of their columns. The remaining rings are numbered from 0, starting at the
    lowest ring, in the column `channel`. Points whose ring is unknown are removed.

    Parameters
    ----------
    recording
        Recording of a sensor with rings.
    every_ring
        Keep every n-th ring by elevation, starting at the lowest ring.
    rings
        Numbers of the rings to keep, as in `Sweep.rings`: the numbers in the ring column of the
        recording, or numbers that start at 0 for the lowest ring. Cannot be combined with
        `every_ring`.
    every_column
        Keep every n-th pulse of each ring.

    Attributes
    ----------
    notes
        Sentences for the user.

    Raises
    ------
    LidarError
        If the recording cannot be read or has no rings, a ring does not exist, or an argument is
        invalid.

    Examples
    --------
    >>> thinner = SweepThinner(recording, every_ring=2)  # doctest: +SKIP
    >>> thinner.sweep(0).sweep  # doctest: +SKIP
    <Sweep 0: 61,204 points>
    """

    def __init__(
        self,
        recording: Recording,
        *,
        every_ring: int = 1,
        rings: Sequence[int] | None = None,
        every_column: int = 1,
    ) -> None:
        check_number("every_ring", every_ring, whole=True, ge=1)
        check_number("every_column", every_column, whole=True, ge=1)
        if rings is not None and every_ring != 1:
            raise LidarError("`rings` and `every_ring` cannot be combined.")
        self.recording = recording
        self.notes: list[str] = []
        self._pulses = RingDirections(recording)
        ring_count = len(self._pulses)
        if rings is None:
            kept = np.arange(ring_count - 1, -1, -every_ring)
        else:
            kept = self._ring_indices(rings)
        # Rings are sorted from the highest to the lowest, and channels from the lowest.
        self._channels = np.full(ring_count, -1)
        self._channels[kept] = np.arange(len(kept))
        self._rays = None
        if every_column > 1:
            self._rays = _Rays(self._pulses, kept, every_column)

    def _ring_indices(self, rings: Sequence[int]) -> Ints:
        """Return the indices of rings in `Recording.rings`, from the lowest to the highest."""
        numbers = self.recording.rings.numbers
        if numbers is None:
            numbers = np.arange(len(self._pulses))[::-1]
        if not len(rings):
            raise LidarError("`rings` is empty. List the numbers of the rings to keep.")
        unknown = [str(number) for number in rings if number not in numbers]
        if unknown:
            raise LidarError(
                f"{self.recording.name} has no ring {list_names(unknown)}. Its rings are numbered "
                f"from {numbers.min()} to {numbers.max()}."
            )
        return np.flatnonzero(np.isin(numbers, rings))[::-1]

    def sweep(self, number_or_sweep: int | Sweep) -> AugmentedSweep:
        """Thin out a sweep.

        Parameters
        ----------
        number_or_sweep
            Number of a sweep in the recording, or a sweep that was read from it.

        Returns
        -------
        AugmentedSweep
            Copies of recorded returns, in the order of the recording.

        Raises
        ------
        LidarError
            If the recording cannot be read.
        """
        sweep = number_or_sweep
        if not isinstance(sweep, Sweep):
            sweep = self.recording[sweep]
        if self._rays is None:
            rows, rings = self._pulses.ringed_rows(sweep)
            channels = np.where(rings >= 0, self._channels[rings], -1)
        else:
            rays = self._rays
            rows, ray = self._pulses.closest(
                sweep, rays.azimuth, np.zeros(len(rays.azimuth)), rays.candidates
            )
            channels = self._channels[rays.candidates.first_ring[ray]]
        kept = channels >= 0
        return copied_returns(sweep, rows[kept], channels[kept])


class _Rays:
    """Evenly spaced azimuths in some rings, `every_column` pulses apart."""

    azimuth: Floats  # (k,), radians
    candidates: CandidateRings

    def __init__(self, pulses: RingDirections, rings: Ints, every_column: int) -> None:
        spacing = every_column * pulses.step_rad[rings]
        azimuths = [
            -np.pi + step * np.arange(max(int(2 * np.pi / step + 0.5), 1)) for step in spacing
        ]
        self.azimuth = np.concatenate(azimuths)
        count = len(self.azimuth)
        self.candidates = CandidateRings(
            rings.repeat([len(azimuth) for azimuth in azimuths]),
            np.ones(count, np.int64),
            np.zeros((count, 1)),
            np.full(count, np.inf),
        )

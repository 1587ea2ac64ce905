"""IMU samples of the platform for IMU packets, synchronized with the shots of a sensor."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..numerics.arrays import Floats, Ints
from ..sweeps.instruments import IMU_FILE
from .encoders import PacketSource
from .shots import Shots


class ImuBatch(NamedTuple):
    """Consecutive IMU samples in the IMU frame."""

    times_ns: Ints  # (n,): since the start of the survey
    stamps_ns: Ints  # (n,): the same on the sensor's clock, including its jumps
    rates: Floats  # (n, 3): angular velocities, rad/s
    forces: Floats  # (n, 3): specific forces, m/s²


class PacketImuSamples:
    """Chronological IMU samples of the platform. Without an IMU, there are no samples."""

    def __init__(self, source: PacketSource) -> None:
        instruments = source.instruments
        self._rows = iter(()) if instruments is None else instruments.rows(IMU_FILE)
        self._next_row: list[str] | None = next(self._rows, None)
        self._starts_ns: Ints = np.zeros(1, np.int64)  # start times of the last shots
        self._jumps_ns: Ints = np.zeros(1, np.int64)  # clock jumps at the last shots

    def during(self, shots: Shots) -> ImuBatch | None:
        """Return the samples up to the last of the given shots, or None if there are no samples."""
        self._starts_ns = shots.starts_ns
        self._jumps_ns = shots.stamps_ns - shots.starts_ns
        return self._until(int(shots.starts_ns[-1]))

    def remaining(self) -> ImuBatch | None:
        """Return the samples after the last shots, or None if there are no samples."""
        return self._until(None)

    def _until(self, until_ns: int | None) -> ImuBatch | None:
        """Return the samples up to a given time, or all samples if the time is None.

        The result is None if there are no samples.
        """
        rows = []
        while self._next_row is not None:
            if until_ns is not None and int(self._next_row[0]) > until_ns:
                break
            rows.append(self._next_row)
            self._next_row = next(self._rows, None)
        if not rows:
            return None
        times_ns = np.array([int(row[0]) for row in rows])
        samples = np.array([row[1:] for row in rows], np.float64)
        firing = np.maximum(np.searchsorted(self._starts_ns, times_ns, "right") - 1, 0)
        stamps_ns = times_ns + self._jumps_ns[firing]
        return ImuBatch(times_ns, stamps_ns, samples[:, :3], samples[:, 3:])

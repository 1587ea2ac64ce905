"""What a run makes of its frames: hits by triangle, and some rays for the pictures."""

from __future__ import annotations

import struct

import numpy as np
from numpy.typing import NDArray

from .records import Buffer
from .scan import Frame

SAMPLE_RAYS = 400  # kept for the pictures

_HEAD = struct.Struct("<QQQQ")  # frames, hits, triangles, sample rays


class FrameTotals:
    """Sums up frames, which come in scan order.

    Parameters
    ----------
    triangles
        Triangles of the scene.
    scans
        Scans of the survey.
    """

    def __init__(self, triangles: int, scans: int) -> None:
        self.scans = scans
        self.frames = 0  # taken, which are those of scans 0 to frames - 1
        self.hits = 0
        self.hit_counts = np.zeros(triangles, np.int64)
        self._samples: list[NDArray[np.float32]] = []
        self.whole = True  # whether no frame was entered by half, as an interrupt leaves it

    def take(self, frame: Frame) -> None:
        """Enter the next frame.

        Raises
        ------
        ValueError
            If it is not the next: what is kept says only how many there were.
        """
        if frame.scan != self.frames:
            raise ValueError(f"Frame {frame.scan} came when {self.frames} was due.")
        self.whole = False
        np.add.at(self.hit_counts, frame.triangles, frame.counts)
        self.hits += frame.hits
        self.frames += 1
        every = max(1, 4 * self.scans // SAMPLE_RAYS)
        if frame.scan % every == 0 and len(frame.samples):
            starts = np.broadcast_to(
                np.asarray(frame.pose.position, np.float32), frame.samples.shape
            )
            self._samples.append(np.stack([starts, frame.samples], axis=1))
        self.whole = True

    @property
    def sample_rays(self) -> NDArray[np.float32]:
        """First and last point of some rays, float32 (k, 2, 3), metres, local coordinates."""
        return np.concatenate([np.empty((0, 2, 3), np.float32), *self._samples])

    @property
    def nbytes(self) -> int:
        """Size of what `pack` gives, or nearly."""
        return self.hit_counts.nbytes

    def pack(self) -> tuple[Buffer, ...]:
        """Put all of it into bytes, in pieces."""
        samples = self.sample_rays
        head = _HEAD.pack(self.frames, self.hits, len(self.hit_counts), len(samples))
        return head, self.hit_counts.astype("<i8", copy=False).data, samples.astype("<f4").tobytes()

    def unpack(self, data: Buffer) -> None:
        """Take over what another run has packed.

        Raises
        ------
        ValueError
            If it is not of this many triangles and scans; the message is a clause.
        """
        if len(data) < _HEAD.size:
            raise ValueError("it is too short")
        frames, hits, triangles, samples = _HEAD.unpack_from(data)
        counts_end = _HEAD.size + 8 * triangles
        if (
            triangles != len(self.hit_counts)
            or frames > self.scans
            or counts_end + 24 * samples != len(data)
        ):
            raise ValueError("it is of another scene or survey")
        self.frames, self.hits = frames, hits
        self.hit_counts = np.frombuffer(data, "<i8", triangles, _HEAD.size).astype(np.int64)
        rays = np.frombuffer(data, "<f4", 6 * samples, counts_end).astype(np.float32)
        self._samples = [rays.reshape(-1, 2, 3)]

"""Packets of a toy: a datagram for each firing, its ranges in centimetres."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from ..base.arrays import AnyArray
from .encoders import Datagrams, PacketDecoder, PacketEncoder
from .shots import Shots


class ToyEncoder(PacketEncoder):
    """Sends each firing when it is over; 0 is no return."""

    columns = ()

    def encode(self, shots: Shots) -> list[Datagrams]:
        """Return the datagrams of the shots of a sweep."""
        units = np.nan_to_num(np.rint(100 * shots.range_m[0])).astype("<u2")
        payloads = units.view(np.uint8).reshape(len(shots), -1)
        due_ns = shots.starts_ns + self.firing_interval_ns
        return [Datagrams(payloads, due_ns, self.port("data", 4000))]

    def finish(self) -> list[Datagrams]:
        """Return no datagrams, as no shots are left."""
        return []


class ToyDecoder(PacketDecoder):
    """Reads all datagrams as one sweep of ranges along x."""

    @staticmethod
    def reads(path: Path, frame: bytes) -> bool:
        """Return whether a datagram is sent to the toy's port."""
        return frame[44:46] == (4000).to_bytes(2, "big")

    def sweeps(self, sensor: int) -> Iterable[Any]:
        """Return the ranges of all datagrams."""
        data = self.path.read_bytes()[24:]
        size = 16 + int.from_bytes(data[8:12], "little")
        rows = np.frombuffer(data, np.uint8).reshape(-1, size)[:, 16 + 42 :].copy()
        return [rows.view("<u2") / 100]

    def columns(self, sensor: int, sweep: Any) -> dict[str, AnyArray]:
        """Return the points."""
        ranges = sweep.ravel()
        return {"x": ranges, "y": 0 * ranges, "z": 0 * ranges}

    def time_ns(self, sweep: Any) -> float:
        """Return 0."""
        return 0.0

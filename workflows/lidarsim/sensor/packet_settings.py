"""Packets of a sensor's maker: format, identifiers, ports, and the maker's order of lasers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from ..numerics.arrays import Ints

Identifier = int | float | str


@dataclass(frozen=True, eq=False)
class PacketSettings:
    """Packets that a sensor of a maker sends its returns in.

    Parameters
    ----------
    format
        Name of the format, of `lidarsim.packets.encoders` or of a plug-in.
    ports
        {kind of packet: UDP port}.
    identifiers
        What the format needs to know of the model, as its encoder defines: {name: value}.
    lasers
        int64 (c,): number of the laser of each channel in the maker's order, from 0.
    """

    format: str
    ports: Mapping[str, int] = field(default_factory=dict)
    identifiers: Mapping[str, Identifier] = field(default_factory=dict)
    lasers: Ints = field(default_factory=lambda: np.zeros(0, np.int64))

    @property
    def channels(self) -> Ints:
        """Channel of each laser in the maker's order: int64 (c,)."""
        return np.argsort(self.lasers)


def laser_order(elevations: ArrayLike) -> Ints:
    """Return the maker's number of the laser of each channel: (c,).

    `elevations` (c,) are in the maker's order; channels are sorted by elevation, the lowest first.
    """
    return np.argsort(np.asarray(elevations, np.float64), kind="stable").astype(np.int64)

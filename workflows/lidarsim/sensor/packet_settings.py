"""Settings for packets in a manufacturer's format."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from ..numerics.arrays import Ints

Identifier = int | float | str


@dataclass(frozen=True, eq=False)
class PacketSettings:
    """Settings for the packets in which a sensor sends its returns.

    Parameters
    ----------
    format
        Name of a format from `lidarsim.packets.encoders` or from a plug-in.
    ports
        UDP port for each kind of packet.
    identifiers
        Model-specific values that the encoder of the format requires, by name.
    lasers
        Index of each channel's laser in the manufacturer's order, starting at 0. Shape (c,),
        int64.
    """

    format: str
    ports: Mapping[str, int] = field(default_factory=dict)
    identifiers: Mapping[str, Identifier] = field(default_factory=dict)
    lasers: Ints = field(default_factory=lambda: np.zeros(0, np.int64))

    @property
    def channels(self) -> Ints:
        """Channel of each laser in the manufacturer's order.

        The result is an int64 array of shape (c,).
        """
        return np.argsort(self.lasers)


def laser_order(elevations: ArrayLike) -> Ints:
    """Return the position of each channel's laser in the manufacturer's order.

    The elevations are in the manufacturer's order. Channels are numbered by increasing elevation.
    Both `elevations` and the result have shape (c,).
    """
    return np.argsort(np.asarray(elevations, np.float64), kind="stable").astype(np.int64)

"""Compiled loop that merges saturating pulses with the pulses they hide (saturation.py)."""

# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from typing import NamedTuple

from raybeam.compiled import compiled

from ...numerics.arrays import Bools, Floats, Ints


class PulseExtents(NamedTuple):
    """Returns of pulses, sorted by ray and distance.

    All arrays have shape (n,).
    """

    ray: Ints
    clipped: Bools  # whether the return saturates the receiver
    height: Floats  # before clipping
    front: Floats  # leading edge of the return, meters
    back: Floats  # trailing edge of the return, meters
    distance: Floats  # meters
    energy: Floats


@compiled()
def join_clipped(pulses, remains):
    """Merge returns of a pulse that overlap clipped returns, and mark those that remain.

    The highest of the merged returns remains, with the total energy of all merged returns, and with
    the outermost edges and the smallest distance of the clipped returns. These values are written
    to `pulses`, a `PulseExtents`, and the marks to `remains` (n,).
    """
    height = pulses.height
    front = pulses.front
    back = pulses.back
    clipped = pulses.clipped
    begin = 0
    for k in range(len(pulses.ray)):
        if pulses.ray[k] != pulses.ray[begin]:
            begin = k
        remains[k] = True
        last = k
        for j in range(k - 1, begin - 1, -1):
            if not (remains[j] and (clipped[j] or clipped[last]) and back[j] >= front[last]):
                continue
            hidden = j
            if height[j] >= height[last]:
                hidden = last
                last = j
            remains[hidden] = False
            pulses.energy[last] += pulses.energy[hidden]
            if clipped[hidden]:
                front[last] = min(front[last], front[hidden])
                back[last] = max(back[last], back[hidden])
                pulses.distance[last] = min(pulses.distance[last], pulses.distance[hidden])

"""A loop over returns that pulses which fill the receiver hide: see saturation.py."""

# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from typing import NamedTuple

from raybeam.compiled import compiled

from ..base.arrays import Bools, Floats, Ints


class Echoes(NamedTuple):
    """Returns of pulses in the order of rays and distances: (n,) each."""

    ray: Ints
    full: Bools  # whether the echo fills the receiver
    height: Floats
    front: Floats  # where the echo begins and ends, metres
    back: Floats
    distance: Floats  # metres
    energy: Floats


@compiled()
def join_full(echoes, left):
    """Join the echoes of a pulse that overlap if one of them is full; marks those that are `left`.

    Of joined echoes the highest is left, with the energy of all, and with the edges and the least
    distance of the full ones, which are written.
    """
    height = echoes.height
    front = echoes.front
    back = echoes.back
    full = echoes.full
    begin = 0
    for k in range(len(echoes.ray)):
        if echoes.ray[k] != echoes.ray[begin]:
            begin = k
        left[k] = True
        last = k
        for j in range(k - 1, begin - 1, -1):
            if not (left[j] and (full[j] or full[last]) and back[j] >= front[last]):
                continue
            hidden = j
            if height[j] >= height[last]:
                hidden = last
                last = j
            left[hidden] = False
            echoes.energy[last] += echoes.energy[hidden]
            if full[hidden]:
                front[last] = min(front[last], front[hidden])
                back[last] = max(back[last], back[hidden])
                echoes.distance[last] = min(echoes.distance[last], echoes.distance[hidden])

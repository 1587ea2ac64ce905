"""Tile sizes, on which the tile planner and the compiled loops must agree.

The module imports nothing, so that tiles can be planned without loading numba.
"""

from __future__ import annotations

SUBTILES = 8  # subtiles per tile
VECTOR_RAYS = 8  # rays per vector, and the smallest number of rays per subtile


def lanes_per_beam(subrays: int) -> int:
    """Return the number of lanes that a beam's sub-rays occupy in a tile.

    A beam without sub-rays occupies a single lane. Otherwise, the sub-rays are padded to whole
    vectors, so that each vector contains rays of a single beam.
    """
    return 1 if subrays == 1 else -(-subrays // VECTOR_RAYS) * VECTOR_RAYS

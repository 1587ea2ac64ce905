"""Scratch memory of a tile of rays: fixed fields, and tables with a number for each ray.

A tile has `SUBTILES` subtiles of `vectors` times eight rays. A row of a table has a number for each
ray of the tile, in the order of the subtiles.
"""

from __future__ import annotations

import operator
import threading

import numpy as np

from .compiled import inlined
from .tile_sizes import SUBTILES

# Fields of a tile. float32 unless stated; vectors of eight numbers, if not one for each subtile.
TILE = np.dtype(
    [
        # Unit vectors u, v, m of the tile's axes, m ahead, and the point that they start from.
        ("axes", "f4", 12),
        ("padding", "f4", 1),  # padding of depths
        ("offset", "f4", 1),  # maximum offset of a ray from the tile's point, as `prepare_tile` describes
        ("spread", "f4", 2),  # factor of errors (`prepare_tile`); and a gap
        ("bounds", "f4", 4 * SUBTILES),  # subtiles: lowest and highest su, lowest, highest sv
        ("tile_bounds", "f4", 8),  # bounds of the tile, and a gap
        ("reach", "f4", SUBTILES),  # greatest depth of a subtile's rays
        ("planes", "f4", 4 * 7 * SUBTILES),  # subtile: normal above 0, below 0, and constant
        ("tile_planes", "f4", 20),  # four sides, and the depth: normal and constant
        ("gap", "f4", 4),
        ("edges", "f4", 14 * 8),  # edges of the triangles of a leaf, from `_prepare_leaf`
        ("near", "f4", 8),  # depths of the children of a node
        ("sides", "i8", 15),  # where boxes have the coordinate of the farthest corner, by plane
        ("t_min", "f8", 1),  # closest distance of a hit, local
        ("nested", "i8", 1),  # whether the mesh at hand has a transform
        ("skips", "i8", 1),  # tiles left that are cast one by one (`_cast_in_mesh`)
        ("patience", "i8", 1),  # number of such tiles after the last tile that was not cast as one
        ("sums", "f8", 4),
        ("pairs", "u1", 8 * 8 + 8),  # pairs of a triangle and a subtile
        ("bits", "i8", 256),  # numbers of the bits that are set of each byte, a byte each
        ("stack", "i8", 1),  # address of the nodes that wait: `ENTRY` numbers of 4 bytes each
        ("met", "i8", 1),  # address of the instances that the tile may meet, likewise
    ],
    align=True,
)  # fmt: skip
ENTRY = 4  # depth, float32; code of a node or number of an instance, int32; mask of subtiles, int32

# Rows of 8 bytes a ray. Local: of the scene.
OX, OY, OZ, DX, DY, DZ = range(6)  # rays
T = 6  # distance of the closest hit so far, or the reach; local
KEY = 7  # key of that hit, -1 for none; int64
# The ray in the coordinates of the mesh at hand, and the length of the direction there before it
# was made a unit vector.
IX, IY, IZ, EX, EY, EZ, LENGTH = range(8, 15)
AXIS, U, V, W, SX, SY, SZ = range(15, 22)  # the shear of triangle.py; the longest axis is int64
ROW, POSE, WITHIN = 15, 16, 17  # while rays are made, before their shear; int64
SURVIVORS = 22  # two rows: what the tests in float32 leave of a leaf; int64
SU, SV, DM, WM, DEPTH, AXIS_OF_EIGHT = range(24, 30)  # the first five are float32
NUMBER = 30  # number of the ray in the call; int64
NORM = 31  # length of a ray's direction in the axes of a body, before it was made a unit vector
ROWS = 32

FIRST_ROW = -(-TILE.itemsize // 64) * 8  # index of the first row, in numbers of 8 bytes


def field_index(name: str) -> int:
    """Return the index of a field in the memory, seen as an array of the field's type."""
    field = TILE[name]
    kind = field.subdtype[0] if field.subdtype else field
    return int(TILE.fields[name][1]) // kind.itemsize  # type: ignore[index]


@inlined
def row_index(row, rays):  # type: ignore[no-untyped-def]
    """Return the index of a row of a tile with a number of rays, in numbers of 8 bytes."""
    return FIRST_ROW + row * rays


class _ThreadTiles(threading.local):
    """Memory of each thread, since threads of a worker may cast at the same time."""

    def __init__(self) -> None:
        self._size = (0, 0, 0)

    def address(self, rays: int, waiting: int, instances: int) -> int:
        """Return the address, a multiple of 64, of memory for a tile of a number of rays.

        `waiting` is the maximum of nodes that wait, `instances` the number of instances.
        """
        size = (rays, waiting, instances)
        if not all(map(operator.le, size, self._size)):
            self._size = tuple(map(max, size, self._size))  # type: ignore[assignment]
            self._allocate(*self._size)
        return self._address

    def _allocate(self, rays: int, waiting: int, instances: int) -> None:
        tables = FIRST_ROW + ROWS * rays + 16
        memory = np.zeros(tables + 2 * (waiting + instances) + 8, np.int64)
        memory = memory[-memory.ctypes.data % 64 // 8 :]
        memory[field_index("stack")] = memory.ctypes.data + 8 * tables
        memory[field_index("met")] = memory.ctypes.data + 8 * (tables + 2 * waiting)
        bits = memory[field_index("bits") :][:256].view(np.uint8).reshape(256, 8)
        for mask in range(256):
            numbers = [bit for bit in range(8) if mask >> bit & 1]
            bits[mask, : len(numbers)] = numbers
        self._memory = memory
        self._address = memory.ctypes.data


thread_tiles = _ThreadTiles()

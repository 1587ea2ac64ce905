"""Scratch memory of a tile, with fixed fields followed by rows of one number per ray.

A tile has `SUBTILES` subtiles, each of which has one or more vectors of eight rays. A row of a
table contains a number for each ray of the tile, in the order of the subtiles.
"""

from __future__ import annotations

import operator
import threading

import numpy as np

from .compiled import inlined
from .tile_sizes import SUBTILES

# The fields of a tile. Vectors have eight numbers. Fields per subtile have one vector for each
# number.
TILE = np.dtype(
    [
        # The tile's axes as unit vectors u, v, m, where m is the mean direction, and the tile's
        # point.
        ("axes", "f4", 12),
        ("padding", "f4", 1),  # margin of depths
        ("offset", "f4", 1),  # maximum offset of a ray, as `_project_rays` describes
        ("spread", "f4", 2),  # factor of rounding errors (see tile_loops.py), and padding
        ("bounds", "f4", 4 * SUBTILES),  # per subtile: minimum and maximum of su, then of sv
        ("tile_bounds", "f4", 8),  # bounds of the tile, and padding
        ("reach", "f4", SUBTILES),  # per subtile: maximum depth of its rays
        ("planes", "f4", 4 * 7 * SUBTILES),  # per subtile: normals and constants
        ("tile_planes", "f4", 20),  # normals and constants of the four sides and of the depth
        ("alignment", "f4", 4),
        ("edges", "f4", 14 * 8),  # linear functions of the triangles of a leaf (`test_leaf`)
        ("near", "f4", 8),  # depths of the children of a node
        ("sides", "i8", 15),  # per plane: positions of the relevant corner's coordinates
        ("t_min", "f8", 1),  # minimum distance of a hit, local
        ("nested", "i8", 1),  # whether the current mesh has a transform
        ("skips", "i8", 1),  # number of tiles to cast ray by ray (`_cast_in_mesh`)
        ("patience", "i8", 1),  # value of `skips` after the last unsuitable tile
        ("sums", "f8", 4),
        ("pairs", "u1", 8 * 8 + 8),  # pairs of a triangle and a subtile
        ("bits", "i8", 256),  # for each byte value, the positions of its set bits, one per byte
        ("stack", "i8", 1),  # address of the stack, with `ENTRY` numbers of 4 bytes per entry
        ("met", "i8", 1),  # address of the instances that the tile may hit, as in `stack`
    ],
    align=True,
)  # fmt: skip
# Numbers per stack entry: depth, float32; code of a node or index of an instance, int32; mask of
# subtiles, int32; padding.
ENTRY = 4

# Rows with 8 bytes per ray, float64 unless stated. Local lengths are in scene coordinates.
OX, OY, OZ, DX, DY, DZ = range(6)  # origins and directions, local
T = 6  # distance of the closest hit so far, or the maximum distance; local
KEY = 7  # int64: key of the closest hit, or -1
# The ray in coordinates of the current mesh, and the length of its direction before normalization.
IX, IY, IZ, EX, EY, EZ, LENGTH = range(8, 15)
AXIS, U, V, W, SX, SY, SZ = range(15, 22)  # as in triangle.py; the longest axis is int64
ROW, POSE, WITHIN = 15, 16, 17  # int64; used before the rays are sheared
SURVIVORS = 22  # int64, two rows: rays and triangles that pass the float32 tests
SU, SV, DM, WM, DEPTH, AXIS_OF_EIGHT = range(24, 30)  # float32 except for the last one
NUMBER = 30  # int64: index of the ray in the call
NORM = 31  # length of the direction in the frame of a body before normalization
ROWS = 32

FIRST_ROW = -(-TILE.itemsize // 64) * 8  # index of the first row, in units of 8 bytes


def field_index(name: str) -> int:
    """Return a field's offset in the tile memory, counted in elements of the field's type."""
    field = TILE[name]
    kind = field.subdtype[0] if field.subdtype else field
    return int(TILE.fields[name][1]) // kind.itemsize  # type: ignore[index]


@inlined
def row_index(row, rays):  # type: ignore[no-untyped-def]
    """Return the start of a row in the memory of a tile, in units of 8 bytes."""
    return FIRST_ROW + row * rays


class _ThreadTiles(threading.local):
    """Separate tile memory for each thread, because several threads may cast at the same time."""

    def __init__(self) -> None:
        self._size = (0, 0, 0)

    def address(self, rays: int, pending: int, instances: int) -> int:
        """Return the address of tile memory for a number of rays, which is a multiple of 64.

        `pending` is the maximum number of pending nodes, and `instances` is the number of
        instances. The memory is allocated again if it is too small.
        """
        size = (rays, pending, instances)
        if not all(map(operator.le, size, self._size)):
            self._size = tuple(map(max, size, self._size))  # type: ignore[assignment]
            self._allocate(*self._size)
        return self._address

    def _allocate(self, rays: int, pending: int, instances: int) -> None:
        tables = FIRST_ROW + ROWS * rays + 16
        memory = np.zeros(tables + 2 * (pending + instances) + 8, np.int64)
        memory = memory[-memory.ctypes.data % 64 // 8 :]
        memory[field_index("stack")] = memory.ctypes.data + 8 * tables
        memory[field_index("met")] = memory.ctypes.data + 8 * (tables + 2 * pending)
        bits = memory[field_index("bits") :][:256].view(np.uint8).reshape(256, 8)
        for mask in range(256):
            numbers = [bit for bit in range(8) if mask >> bit & 1]
            bits[mask, : len(numbers)] = numbers
        self._memory = memory
        self._address = memory.ctypes.data


thread_tiles = _ThreadTiles()

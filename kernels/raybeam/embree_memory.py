"""What the compiled loops around Embree read and write: one cast, and a thread's scratch memory."""

from __future__ import annotations

import threading
from typing import Any

import numba
import numpy as np
from numba import types
from numba.extending import intrinsic

from .arrays import AnyArray, Floats
from .pattern import Pattern
from .poses import Poses

LANES = 16  # rays that go together; Embree takes them at once, or in two or four packets

# One cast: addresses of what the loops read, and numbers. Addresses are 0 for what there is not.
CAST = np.dtype(
    [
        ("scene", "i8"),  # the RTCScene
        ("scratch", "i8"),  # `SCRATCH`, at a multiple of 64
        ("mesh", "i8"),  # `MESH` of a plain scene
        ("instances", "i8"),  # `INSTANCE` of each; 0 in a plain scene
        ("masked", "i8"),  # whether any mesh has an opacity
        ("packets", "i8", 4),  # filters for the packets of a group
        ("single", "i8"),  # filter for single rays
        ("decide", "i8"),
        ("nearby", "i8"),
        ("directions", "i8"),  # float64 (3, rows), unit vectors
        ("origins", "i8"),  # float64 (3, rows), metres
        ("positions", "i8"),  # float64 (3, poses)
        ("rotations", "i8"),  # float64 (9, poses)
        ("delays", "i8"),  # float64 (each,)
        ("velocities", "i8"),  # float64 (3, poses)
        ("rates", "i8"),  # float64 (3, poses)
        ("rows", "i8"),
        ("poses", "i8"),
        ("each", "i8"),  # rays of a pose
        ("first", "i8"),  # row of ray 0, counted in sub-rays
        ("subrays", "i8"),  # of each row
        ("shares", "i8"),  # float64 (5, subrays): ahead, across, up, and starts
        ("offsets", "i8"),  # float64 (2, rows): angles, added to those in `shares`
        ("about", "i8"),  # whether across and up are those about `axis`
        ("begins", "i8"),  # whether sub-rays have starts of their own
        ("axis", "f8", 3),
        ("centre", "f8", 3),  # these four of the `Frame`
        ("scale", "f8"),
        ("low", "f8", 3),
        ("upper", "f8", 3),
        ("near", "i8"),  # whether all rays start near the scene's box
        ("still", "i8"),  # whether all rays start at the position of one pose
        ("step", "i8"),  # rays to the next one of a ring
        ("high", "i8"),  # so many of a ring are in a group
        ("wide", "i8"),  # and so many neighbours of each
        ("width", "i8"),  # rays that Embree takes at once, 1 for no packets
        ("coherence", "f8"),  # a group with a smaller cosine between two rays is cast ray by ray
        ("t_min", "f8"),  # local
        ("t_max", "f8"),
        ("index", "i8"),  # int32: the caller's triangle of each place; if 0, places are written
        ("room", "i8"),  # float64, then twice int32: for the rays of a block
        ("before", "i8"),  # the ray whose number is written as 0
        ("ray", "i8"),  # what is written of hits: uint32
        ("distance", "i8"),  # float64, metres
        ("triangle", "i8"),  # int32
        ("instance", "i8"),  # int32
        ("starts", "i8"),  # float64 (3, all) of all rays, if they are wanted: origins, metres
        ("ways", "i8"),  # and directions
        ("all", "i8"),
    ]
)  # fmt: skip

# Of a mesh: addresses of its corners, and of the uv and the mask of its opacity; the mask's height,
# 0 if the mesh is opaque, and width.
MESH = np.dtype([("corners", "i8"), ("uv", "i8"), ("mask", "i8"), ("high", "i8"), ("wide", "i8")])
INSTANCE = np.dtype(
    [
        ("matrix", "f8", 12),  # to the mesh's coordinates
        ("mesh", "i8"),  # address of the `MESH`
        ("first", "i8"),  # the mesh's first place in `index`
    ]
)
# of these: numbers before, and bytes
MESH_OF = 12
FIRST_PLACE = 13
RECORD = INSTANCE.itemsize

SCRATCH = np.dtype(
    [
        ("context", "i8", 8),  # RTCRayQueryContext: Embree hands its address to the filters
        ("mesh", "i8"),
        ("instances", "i8"),
        ("masked", "i8"),
        ("t_min", "f8"),
        ("t_max", "f8"),
        ("lane", "i8"),  # first ray of a packet, or the single one
        ("scene", "i8"),
        ("nearby", "i8"),
        ("arguments", "i8", 8),  # RTCIntersectArguments
        ("valid", "i4", LANES),
        ("single", "f4", 32),  # RTCRayHit
        ("packet", "f4", 22 * LANES),  # RTCRayHit16, two RTCRayHit8 or four RTCRayHit4
        ("query", "f4", 8),  # RTCPointQuery, and its context: zeros
        ("query_context", "i8", 28),
        ("tile", "i8", LANES),  # rays of a group, counted from its first
        ("ray", "i8", LANES),  # the same, counted from the first of the block
        ("real", "i8", LANES),  # whether there is one; if not, it is a copy
        ("ox", "f8", LANES), ("oy", "f8", LANES), ("oz", "f8", LANES),  # local
        ("dx", "f8", LANES), ("dy", "f8", LANES), ("dz", "f8", LANES),
        ("entry", "f8", LANES),  # distance of the start that Embree sees from the origin
        # The longest axis of the direction, the origin with that axis last, and the shear, see
        # triangle.py; then the instance in whose coordinates they are, -1 for none yet, and the
        # length of the direction there.
        ("axis", "i8", LANES),
        ("u", "f8", LANES), ("v", "f8", LANES), ("w", "f8", LANES),
        ("sx", "f8", LANES), ("sy", "f8", LANES), ("sz", "f8", LANES),
        ("inside", "i8", LANES), ("length", "f8", LANES),
        # What filters have found: the least distance in float32, its triangle, and another that is
        # as near; -1 for none, -2 for several. The same in 32 bits for plain scenes.
        ("rough", "f8", LANES), ("one", "i8", LANES), ("other", "i8", LANES),
        ("rough_32", "f4", LANES), ("one_32", "i4", LANES), ("other_32", "i4", LANES),
        # The closest triangle that the ray hits, by key: row of the mesh's corners, and `NUMBER`
        # times the instance's number. Of equally close ones that of the lowest key.
        ("t", "f8", LANES), ("key", "i8", LANES), ("sure", "i8", LANES),
        ("corners", "f8", 9 * LANES),  # of a triangle of each ray
        ("row", "i8", LANES), ("pose", "i8", LANES), ("within", "i8", LANES),
        ("straight", "f8", LANES), ("across", "f8", LANES), ("up", "f8", LANES),
        ("aside", "f8", LANES), ("above", "f8", LANES),  # starts of sub-rays
    ]
)  # fmt: skip

NUMBER = np.int64(1) << 32  # of keys


def offset(name: str) -> int:
    """Where a field of the scratch memory begins, in bytes."""
    return int(SCRATCH.fields[name][1])  # type: ignore[index]


def at(name: str) -> int:
    """Where a field of the scratch memory begins, in units of its own numbers."""
    field = SCRATCH[name]
    return offset(name) // (field.subdtype[0] if field.subdtype else field).itemsize


def pointer(kind: Any) -> Any:
    """Make a function of compiled code that takes an address for a pointer to numbers."""

    @intrinsic
    def read(context: Any, address: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            return builder.inttoptr(arguments[0], context.get_value_type(signature.return_type))

        return types.CPointer(kind)(types.int64), generate

    return read


int32s = pointer(types.int32)
int64s = pointer(types.int64)
float32s = pointer(types.float32)
float64s = pointer(types.float64)
uint8s = pointer(types.uint8)
uint32s = pointer(types.uint32)

CASTS = types.Array(numba.from_dtype(CAST), 1, "C")  # of one cast
casts_at = pointer(CASTS.dtype)


class Cast:
    """A `CAST`, and the arrays whose addresses it has."""

    def __init__(self, base: AnyArray) -> None:
        self.record = base.copy()
        self._kept: list[AnyArray] = []

    def keep(self, array: AnyArray | None) -> int:
        """Address of an array, in float64 and contiguous; 0 for none."""
        if array is None:
            return 0
        self._kept.append(np.ascontiguousarray(array, np.float64))
        return self._kept[-1].ctypes.data

    def take(self, directions: Floats, origins: Floats | None, poses: Poses, first: int) -> None:
        """Note what rays are made of: beams (n, 3), poses, and the row of ray 0."""
        record = self.record
        motion = poses.motion
        turns = poses.rotations
        record["directions"] = self.keep(directions.T)
        record["origins"] = self.keep(None if origins is None else origins.T)
        record["positions"] = self.keep(poses.positions.T)
        record["rotations"] = self.keep(None if turns is None else np.moveaxis(turns, 0, -1))
        if motion is not None:
            record["delays"] = self.keep(motion.delays)
            record["velocities"] = self.keep(motion.velocities.T)
            record["rates"] = self.keep(motion.rates.T)
        record["rows"] = len(directions)
        record["poses"] = len(poses)
        record["each"] = poses.rays
        record["first"] = first
        record["subrays"] = 1
        record["still"] = len(poses) == 1 and origins is None and motion is None

    def take_pattern(self, pattern: Pattern, poses: Poses, first: int) -> float:
        """Note what rays of a pattern are made of; how far off their beams they start, metres."""
        self.take(pattern.directions, pattern.origins, poses, first)
        sub_rays = pattern.sub_rays
        record = self.record
        if sub_rays is None:
            return 0.0
        record["subrays"] = len(sub_rays)
        record["shares"] = self.keep(sub_rays.table(pattern.offsets))
        record["begins"] = sub_rays.starts is not None
        record["offsets"] = self.keep(pattern.offsets)
        if sub_rays.axis is not None:
            record["about"] = 1
            record["axis"] = sub_rays.axis
        if sub_rays.starts is None:
            return 0.0
        record["still"] = 0
        return float(np.abs(sub_rays.starts).max())


class _Own(threading.local):
    """Memory of a thread, since threads of one worker may cast at the same time."""

    def __init__(self) -> None:
        self._scratch = np.zeros(SCRATCH.itemsize // 8 + 8, np.int64)
        self._room = np.zeros(0)

    def memory(self, rays: int) -> tuple[int, int]:
        """Addresses of the scratch memory, a multiple of 64, and of room for rays of a block."""
        if len(self._room) < 2 * rays:
            self._room = np.zeros(2 * rays)
        address = self._scratch.ctypes.data
        return address + -address % 64, self._room.ctypes.data


own = _Own()

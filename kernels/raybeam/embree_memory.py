"""Memory of the compiled loops around Embree: the record of a cast, and scratch of a thread."""

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

LANES = 16  # rays of a group; Embree takes a group at once, or in two or four packets

# A cast: addresses of arrays that the loops read or write, and numbers. Address 0: no array. A ray
# belongs to a row of the pattern, which is a beam, or a sub-ray of a beam. Local: centred and
# scaled, as `Frame` describes.
CAST = np.dtype(
    [
        ("scene", "i8"),  # the RTCScene
        ("scratch", "i8"),  # `SCRATCH`, at a multiple of 64
        ("mesh", "i8"),  # `MESH` records
        ("instances", "i8"),  # `INSTANCE` records; 0 for a single mesh without a transform
        ("masked", "i8"),  # whether any mesh has an opacity
        ("packets", "i8", 4),  # addresses of the filter functions for the packets of a group
        ("single", "i8"),  # address of the filter function for single rays
        ("decide", "i8"),  # addresses of the functions of these names in embree_exact.py
        ("nearby", "i8"),
        ("directions", "i8"),  # of beams: float64 (3, rows), unit vectors
        ("origins", "i8"),  # of beams, relative to the sensor: float64 (3, rows), metres
        ("positions", "i8"),  # float64 (3, poses), metres
        ("rotations", "i8"),  # float64 (9, poses): matrices to the scene's axes, by rows
        ("delays", "i8"),  # float64 (rays_per_pose,), seconds after the pose's time
        ("velocities", "i8"),  # float64 (3, poses), metres a second
        ("rates", "i8"),  # float64 (3, poses): angular rates, radians a second
        ("rows", "i8"),  # number of beams
        ("poses", "i8"),  # number of poses
        ("rays_per_pose", "i8"),
        ("first", "i8"),  # row of ray 0 in the pattern, counted in sub-rays
        ("subrays", "i8"),  # sub-rays of each beam
        ("shares", "i8"),  # float64 (5, subrays): `SubRays.loop_table`
        ("offsets", "i8"),  # float64 (2, rows): angles of beams, added to the angles in `shares`
        ("has_axis", "i8"),  # whether `axis` defines the directions across and up of sub-rays
        ("has_starts", "i8"),  # whether sub-rays start off their beam's origin
        ("axis", "f8", 3),
        ("centre", "f8", 3),  # the next four fields are the scene's `Frame`
        ("scale", "f8"),
        ("lower", "f8", 3),
        ("upper", "f8", 3),
        ("starts_near", "i8"),  # whether all rays start at most `mesh.NEAR` from the centre
        ("shares_origin", "i8"),  # whether all rays start at the position of a single pose
        ("step", "i8"),  # difference of the numbers of neighbouring rays of a ring
        ("rays_along", "i8"),  # rays of each ring in a group
        ("rays_across", "i8"),  # rings of a group
        ("width", "i8"),  # rays of a packet of Embree, 1 for no packets
        ("rounding", "f8"),  # directions in packets are rounded to the spacing of numbers about it
        ("coherence", "f8"),  # a group with a smaller cosine between two rays is cast ray by ray
        ("t_min", "f8"),  # closest and farthest distance of a hit, local
        ("t_max", "f8"),
        ("index", "i8"),  # int32: row in the caller's faces, by row of the corners; 0 to write rows
        ("block_memory", "i8"),  # float64, then twice int32: hits of the rays of a block
        ("first_ray", "i8"),  # the ray whose number is written as 0
        ("ray", "i8"),  # output of hits: uint32
        ("distance", "i8"),  # float64, metres
        ("triangle", "i8"),  # int32
        ("instance", "i8"),  # int32
        ("origins_out", "i8"),  # output of rays, float64 (3, ray_count): origins, metres
        ("directions_out", "i8"),  # output of rays, float64 (3, ray_count): directions
        ("ray_count", "i8"),  # number of rays of `origins_out` and `directions_out`
    ]
)  # fmt: skip

# A mesh: addresses of its corners, and of the uv and the mask of its opacity; the mask's height,
# 0 if the mesh is opaque, and width.
MESH = np.dtype(
    [("corners", "i8"), ("uv", "i8"), ("mask", "i8"), ("mask_height", "i8"), ("mask_width", "i8")]
)
INSTANCE = np.dtype(
    [
        ("matrix", "f8", 12),  # to the mesh's coordinates
        ("mesh", "i8"),  # address of the `MESH`
        ("first", "i8"),  # the mesh's first row in `index`
    ]
)
# Of `INSTANCE`: index of the fields `mesh` and `first`, in 8 bytes, and the size, in bytes.
MESH_FIELD = 12
FIRST_ROW_FIELD = 13
INSTANCE_BYTES = INSTANCE.itemsize

# Scratch memory of a thread. Fields with `LANES` numbers have a number for each ray of a group.
SCRATCH = np.dtype(
    [
        ("context", "i8", 8),  # RTCRayQueryContext: Embree hands its address to the filters
        ("mesh", "i8"),
        ("instances", "i8"),
        ("masked", "i8"),
        ("t_min", "f8"),
        ("t_max", "f8"),
        ("lane", "i8"),  # lane of the first ray of a packet, or of the single ray
        ("scene", "i8"),
        ("nearby", "i8"),
        ("arguments", "i8", 8),  # RTCIntersectArguments
        ("valid", "i4", LANES),  # -1 for rays that Embree casts, 0 for copies
        ("single", "f4", 32),  # RTCRayHit
        ("packet", "f4", 22 * LANES),  # RTCRayHit16, two RTCRayHit8 or four RTCRayHit4
        ("query", "f4", 8),  # RTCPointQuery, and its context: zeros
        ("query_context", "i8", 28),
        ("ray_in_group", "i8", LANES),  # number of the lane's ray, from the first of the group
        ("ray", "i8", LANES),  # number of the lane's ray, from the first of the block
        ("real", "i8", LANES),  # whether the lane has a ray of the cast, not a copy of another ray
        ("ox", "f8", LANES), ("oy", "f8", LANES), ("oz", "f8", LANES),  # local
        ("dx", "f8", LANES), ("dy", "f8", LANES), ("dz", "f8", LANES),
        ("entry", "f8", LANES),  # distance of the start that Embree sees from the origin
        # The longest axis of the direction, the origin with that axis last, and the shear, see
        # triangle.py; the instance of these coordinates, -1 for none yet; and the length of the
        # direction in the instance's coordinates.
        ("axis", "i8", LANES),
        ("u", "f8", LANES), ("v", "f8", LANES), ("w", "f8", LANES),
        ("sx", "f8", LANES), ("sy", "f8", LANES), ("sz", "f8", LANES),
        ("inside", "i8", LANES), ("length", "f8", LANES),
        # Candidates of the filters: the shortest distance in float32, its triangle, and a second
        # triangle that is as near; -1 for none, -2 for several. The fields in 32 bits are for
        # scenes without masks: triangles, and in a scene of instances the instances of these.
        ("rough", "f8", LANES), ("first_candidate", "i8", LANES), ("second_candidate", "i8", LANES),
        ("rough_32", "f4", LANES), ("first_32", "i4", LANES), ("second_32", "i4", LANES),
        ("first_instance_32", "i4", LANES), ("second_instance_32", "i4", LANES),
        # The closest triangle that the ray hits: local distance; key, the row of the mesh's corners
        # plus `KEYS_PER_INSTANCE` times the instance's number; whether the hit needs no second
        # cast. Of equally close triangles, the lowest key.
        ("t", "f8", LANES), ("key", "i8", LANES), ("sure", "i8", LANES),
        # Of a triangle of each ray, and of the triangle's instance: (9, `LANES`), (12, `LANES`).
        ("corners", "f8", 9 * LANES), ("matrix", "f8", 12 * LANES),
        # Row in the pattern, number of the pose, and number of the ray within the pose.
        ("row", "i8", LANES), ("pose", "i8", LANES), ("within", "i8", LANES),
        # Components of a sub-ray's direction along its beam, across and up.
        ("straight", "f8", LANES), ("across", "f8", LANES), ("up", "f8", LANES),
        ("aside", "f8", LANES), ("above", "f8", LANES),  # starts of sub-rays, across and up, metres
    ]
)  # fmt: skip

KEYS_PER_INSTANCE = np.int64(1) << 32


def byte_offset(name: str) -> int:
    """Return the offset of a field of the scratch memory, in bytes."""
    return int(SCRATCH.fields[name][1])  # type: ignore[index]


def field_index(name: str) -> int:
    """Return the index of a field of the scratch memory seen as an array of the field's type."""
    field = SCRATCH[name]
    return byte_offset(name) // (field.subdtype[0] if field.subdtype else field).itemsize


def pointer(kind: Any) -> Any:
    """Create a compiled function that converts an address to a pointer to numbers of a type."""

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

CASTS = types.Array(numba.from_dtype(CAST), 1, "C")
casts_at = pointer(CASTS.dtype)


class Cast:
    """A `CAST` record, and references to the arrays whose addresses are in the record."""

    def __init__(self, base: AnyArray) -> None:
        self.record = base.copy()
        self._arrays: list[AnyArray] = []

    def address_of(self, array: AnyArray | None) -> int:
        """Return the address of an array, converted to contiguous float64; 0 for None."""
        if array is None:
            return 0
        self._arrays.append(np.ascontiguousarray(array, np.float64))
        return self._arrays[-1].ctypes.data

    def set_beams(
        self, directions: Floats, origins: Floats | None, poses: Poses, first: int
    ) -> None:
        """Write the beams, the poses and the row of ray 0 to the record.

        Directions and origins (n, 3), metres, are in the sensor's axes; None for no origins.
        `first` is the row of ray 0, counted in sub-rays.
        """
        record = self.record
        motion = poses.motion
        rotations = poses.rotations
        record["directions"] = self.address_of(directions.T)
        record["origins"] = self.address_of(None if origins is None else origins.T)
        record["positions"] = self.address_of(poses.positions.T)
        record["rotations"] = self.address_of(
            None if rotations is None else rotations.transpose(1, 2, 0)
        )
        if motion is not None:
            record["delays"] = self.address_of(motion.delays)
            record["velocities"] = self.address_of(motion.velocities.T)
            record["rates"] = self.address_of(motion.rates.T)
        record["rows"] = len(directions)
        record["poses"] = len(poses)
        record["rays_per_pose"] = poses.rays_per_pose
        record["first"] = first
        record["subrays"] = 1
        record["shares_origin"] = len(poses) == 1 and origins is None and motion is None

    def set_pattern(self, pattern: Pattern, poses: Poses, first: int) -> float:
        """Write a pattern, poses and the row of ray 0; return the maximum offset of a start.

        The offset, metres, is the largest component of the vectors from a beam's origin to the
        starts of its sub-rays; 0 without such starts.
        """
        self.set_beams(pattern.directions, pattern.origins, poses, first)
        sub_rays = pattern.sub_rays
        record = self.record
        if sub_rays is None:
            return 0.0
        record["subrays"] = len(sub_rays)
        record["shares"] = self.address_of(sub_rays.loop_table(pattern.offsets))
        record["has_starts"] = sub_rays.starts is not None
        record["offsets"] = self.address_of(pattern.offsets)
        if sub_rays.axis is not None:
            record["has_axis"] = 1
            record["axis"] = sub_rays.axis
        if sub_rays.starts is None:
            return 0.0
        record["shares_origin"] = 0
        return float(np.abs(sub_rays.starts).max())


class _ThreadMemory(threading.local):
    """Scratch memory of each thread, since threads of a worker may cast at the same time."""

    def __init__(self) -> None:
        self._scratch = np.zeros(SCRATCH.itemsize // 8 + 8, np.int64)
        self._block_memory = np.zeros(0)

    def addresses(self, rays: int) -> tuple[int, int]:
        """Return addresses of the scratch memory, a multiple of 64, and of memory for a block.

        `rays` is the number of rays of the block.
        """
        if len(self._block_memory) < 2 * rays:
            self._block_memory = np.zeros(2 * rays)
        address = self._scratch.ctypes.data
        return address + -address % 64, self._block_memory.ctypes.data


thread_memory = _ThreadMemory()

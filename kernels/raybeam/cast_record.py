"""The record of a cast, of its meshes and of their instances, as compiled loops read them."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
from numba import types
from numba.extending import intrinsic

from .arrays import AnyArray, Floats
from .pattern import Pattern
from .poses import Poses
from .tile_sizes import lanes_per_beam

# A cast: addresses of arrays that the loops read or write, and numbers. Address 0: no array. A ray
# belongs to a row of the pattern, which is a beam, or a sub-ray of a beam. Local: centered and
# scaled, as `LocalFrame` describes.
CAST = np.dtype(
    [
        ("mesh", "i8"),  # `MESH` records
        ("instances", "i8"),  # `INSTANCE` records; 0 for a single mesh without a transform
        ("directions", "i8"),  # float64 (3, rows): unit vectors of beams
        ("origins", "i8"),  # float64 (3, rows): origins of beams, relative to the sensor, meters
        ("positions", "i8"),  # float64 (3, poses), meters
        ("rotations", "i8"),  # float64 (9, poses): matrices to the scene's axes, by rows
        ("delays", "i8"),  # float64 (rays_per_pose,), seconds after the pose's time
        ("velocities", "i8"),  # float64 (3, poses), meters a second
        ("rates", "i8"),  # float64 (3, poses): angular rates, radians a second
        ("beam_count", "i8"),  # number of beams
        ("poses", "i8"),  # number of poses
        ("rays_per_pose", "i8"),
        ("first", "i8"),  # row of ray 0 in the pattern, counted in sub-rays
        ("subrays", "i8"),  # sub-rays of each beam
        ("sub_ray_table", "i8"),  # float64 (5, lanes_per_beam): `SubRays.loop_table`
        ("lanes_per_beam", "i8"),  # lanes of a beam in a tile: `subrays` in whole vectors
        ("offsets", "i8"),  # float64 (2, rows): angles of beams, added to the angles in `sub_ray_table`
        ("has_axis", "i8"),  # whether `axis` defines the directions across and up of sub-rays
        ("has_starts", "i8"),  # whether sub-rays start off their beam's origin
        ("axis", "f8", 3),
        ("center", "f8", 3),  # the next two fields are of the scene's `LocalFrame`
        ("scale", "f8"),
        ("shares_origin", "i8"),  # whether all rays start at the position of a single pose
        ("tile", "i8"),  # memory of a tile, at a multiple of 64
        ("tile_rays", "i8"),
        ("lanes", "i8"),  # int64 (groups, tile_rays): `TilePlan.lanes`
        ("shifts", "i8"),  # int64 (groups,): `TilePlan.shifts`
        ("groups", "i8"),
        ("firing", "i8"),  # rays of a firing
        ("firings", "i8"),  # firings per tile
        ("top", "i8"),  # address of the nodes of the tree over the instances
        ("t_min", "f8"),  # closest and farthest distance of a hit, local
        ("t_max", "f8"),
        ("index", "i8"),  # int32: row in the caller's faces, by row of the corners; 0 to write rows
        ("hits", "i8"),  # float64, then int64: distances and keys of a call's rays, and one more
        ("first_ray", "i8"),  # the ray whose number is written as 0
        ("ray", "i8"),  # output of hits: uint32
        ("distance", "i8"),  # float64, meters
        ("triangle", "i8"),  # int32
        ("instance", "i8"),  # int32
        ("origins_out", "i8"),  # output of rays, float64 (3, ray_count): origins, meters
        ("directions_out", "i8"),  # output of rays, float64 (3, ray_count): directions
        ("ray_count", "i8"),  # number of rays of `origins_out` and `directions_out`
    ]
)  # fmt: skip

# A mesh: addresses of its corners, and of the uv and the mask of its opacity; the mask's height,
# 0 if the mesh is opaque, and width; addresses of the arrays of its `TileTree`.
MESH = np.dtype(
    [
        ("corners", "i8"), ("uv", "i8"),
        ("mask", "i8"), ("mask_height", "i8"), ("mask_width", "i8"),
        ("nodes", "i8"), ("blocks", "i8"), ("leaf_corners", "i8"), ("order", "i8"),
    ]
)  # fmt: skip
# Of `MESH`: index of fields, in 8 bytes.
MASK_HEIGHT, NODES, BLOCKS, LEAF_CORNERS, ORDER = 3, 5, 6, 7, 8
INSTANCE = np.dtype(
    [
        ("matrix", "f8", 12),  # map to the mesh's coordinates
        ("mesh", "i8"),  # address of the `MESH`
        ("first", "i8"),  # the mesh's first row in `index`
    ]
)
# Of `INSTANCE`: index of the fields `mesh` and `first`, in 8 bytes, and the size, in bytes.
MESH_FIELD = 12
FIRST_ROW_FIELD = 13
INSTANCE_BYTES = INSTANCE.itemsize

KEYS_PER_INSTANCE = np.int64(1) << 32


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


class CastRecord:
    """A `CAST` record, and references to the arrays whose addresses are in the record."""

    def __init__(self, base: AnyArray) -> None:
        self.record = base.copy()
        self._arrays: list[AnyArray] = []

    def address_of(self, array: AnyArray | None) -> int:
        """Return the address of an array, converted to contiguous float64, or 0 for None."""
        if array is None:
            return 0
        self._arrays.append(np.ascontiguousarray(array, np.float64))
        return self._arrays[-1].ctypes.data

    def set_beams(
        self, directions: Floats, origins: Floats | None, poses: Poses, first: int
    ) -> None:
        """Write the beams, the poses and the row of ray 0 to the record.

        Directions and origins (n, 3), meters, are in the sensor's axes; None for no origins.
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
        record["beam_count"] = len(directions)
        record["poses"] = len(poses)
        record["rays_per_pose"] = poses.rays_per_pose
        record["first"] = first
        record["subrays"] = record["lanes_per_beam"] = 1
        record["shares_origin"] = len(poses) == 1 and origins is None and motion is None

    def set_pattern(self, pattern: Pattern, poses: Poses, first: int) -> float:
        """Write a pattern, poses and the row of ray 0, and return the maximum offset of a start.

        The offset, meters, is the largest component of the vectors from a beam's origin to the
        starts of its sub-rays; 0 without such starts.
        """
        self.set_beams(pattern.directions, pattern.origins, poses, first)
        sub_rays = pattern.sub_rays
        record = self.record
        if sub_rays is None:
            return 0.0
        record["subrays"] = len(sub_rays)
        record["sub_ray_table"] = self.address_of(sub_rays.loop_table(pattern.offsets))
        record["lanes_per_beam"] = lanes_per_beam(len(sub_rays))
        record["has_starts"] = sub_rays.starts is not None
        record["offsets"] = self.address_of(pattern.offsets)
        if sub_rays.axis is not None:
            record["has_axis"] = 1
            record["axis"] = sub_rays.axis
        if sub_rays.starts is None:
            return 0.0
        record["shares_origin"] = 0
        return float(np.abs(sub_rays.starts).max())

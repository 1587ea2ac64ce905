"""Records that tell the compiled loops about a cast, its meshes, and their instances.

The records contain the addresses of arrays, so that a loop takes one argument instead of forty.
`CastRecord` fills a record and keeps its arrays alive.
"""

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

# The arguments of a cast. Fields with a comment that starts with a dtype are addresses of arrays,
# or 0 if there is no such array. Each ray belongs to a row of the pattern, which is a beam or a
# sub-ray of a beam. Local lengths are in the coordinates that `LocalFrame` describes.
CAST = np.dtype(
    [
        ("mesh", "i8"),  # address of the `MESH` records
        ("instances", "i8"),  # address of the `INSTANCE` records; 0 if there are none
        ("directions", "i8"),  # float64 (3, beam_count): unit vectors of the beams
        ("origins", "i8"),  # float64 (3, beam_count): relative to the sensor, meters
        ("positions", "i8"),  # float64 (3, poses), meters
        ("rotations", "i8"),  # float64 (9, poses): rotation matrices to the scene, row by row
        ("delays", "i8"),  # float64 (rays_per_pose,): seconds after the time of the pose
        ("velocities", "i8"),  # float64 (3, poses), meters per second
        ("rates", "i8"),  # float64 (3, poses): angular velocities, radians per second
        ("beam_count", "i8"),  # number of beams in the pattern
        ("poses", "i8"),  # number of poses
        ("rays_per_pose", "i8"),
        ("first", "i8"),  # pattern row of ray 0, counting each sub-ray as a row
        ("subrays", "i8"),  # sub-rays per beam
        ("sub_ray_table", "i8"),  # float64 (5, lanes_per_beam): `SubRays.loop_table`
        ("lanes_per_beam", "i8"),  # `tile_sizes.lanes_per_beam`
        ("offsets", "i8"),  # float64 (2, beam_count): added to angles in `sub_ray_table`
        ("has_axis", "i8"),  # whether `axis` determines the directions across and up
        ("has_starts", "i8"),  # whether sub-rays start beside the beam origin
        ("axis", "f8", 3),
        ("center", "f8", 3),  # center and scale of the scene's `LocalFrame`
        ("scale", "f8"),
        ("shares_origin", "i8"),  # whether all rays start at the position of a single pose
        ("tile", "i8"),  # address of the tile memory, a multiple of 64
        ("tile_rays", "i8"),  # rays per tile
        ("lanes", "i8"),  # int64 (groups, tile_rays): `TilePlan.lanes`
        ("shifts", "i8"),  # int64 (groups,): `TilePlan.shifts`
        ("groups", "i8"),  # groups of rings, each with separate tiles
        ("firing", "i8"),  # rays per firing
        ("firings", "i8"),  # firings per tile
        ("top", "i8"),  # address of the nodes of the tree over the instances
        ("t_min", "f8"),  # minimum and maximum distance of a hit, local
        ("t_max", "f8"),
        ("index", "i8"),  # int32: face index of each triangle; 0 to return rows of `corners`
        ("hits", "i8"),  # scratch: float64 distances, then int64 keys, (count + 1,) each
        ("first_ray", "i8"),  # ray that is numbered 0 in the output `ray`
        ("ray", "i8"),  # uint32: output, index of the ray
        ("distance", "i8"),  # float64: output, meters
        ("triangle", "i8"),  # int32: output
        ("instance", "i8"),  # int32: output
        ("origins_out", "i8"),  # float64 (3, ray_count): output, ray origins in meters
        ("directions_out", "i8"),  # float64 (3, ray_count): output, ray directions
        ("ray_count", "i8"),  # number of columns in `origins_out` and `directions_out`
    ]
)  # fmt: skip

# A mesh. The fields are the addresses of its corners and of the uv and mask of its opacity, the
# height (0 if the mesh is opaque) and width of the mask, and the addresses of the arrays of its
# `TileTree`.
MESH = np.dtype(
    [
        ("corners", "i8"), ("uv", "i8"),
        ("mask", "i8"), ("mask_height", "i8"), ("mask_width", "i8"),
        ("nodes", "i8"), ("blocks", "i8"), ("leaf_corners", "i8"), ("order", "i8"),
    ]
)  # fmt: skip
# Indices of fields if a `MESH` record is read as an int64 array.
MASK_HEIGHT, NODES, BLOCKS, LEAF_CORNERS, ORDER = 3, 5, 6, 7, 8
INSTANCE = np.dtype(
    [
        # (3, 4) matrix from local scene coordinates to local mesh coordinates.
        ("matrix", "f8", 12),
        ("mesh", "i8"),  # address of the `MESH` record
        ("first", "i8"),  # first row of the mesh in `index`
    ]
)
# Indices of `mesh` and `first` if an `INSTANCE` record is read as an int64 array, and its size.
MESH_FIELD = 12
FIRST_ROW_FIELD = 13
INSTANCE_BYTES = INSTANCE.itemsize

# A hit has the key ``KEYS_PER_INSTANCE * instance + triangle``, so that the lowest key wins ties.
KEYS_PER_INSTANCE = np.int64(1) << 32


def pointer(kind: Any) -> Any:
    """Create an intrinsic that converts an int64 address to a pointer to a given number type."""

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
    """A `CAST` record, together with the arrays to which it refers.

    Parameters
    ----------
    base
        Record of shape (1,) with the fields that all casts of a scene share. It is copied.
    """

    def __init__(self, base: AnyArray) -> None:
        self.record = base.copy()
        self._arrays: list[AnyArray] = []

    def address_of(self, array: AnyArray | None) -> int:
        """Copy an array to contiguous float64 memory and return its address, or 0 for None."""
        if array is None:
            return 0
        self._arrays.append(np.ascontiguousarray(array, np.float64))
        return self._arrays[-1].ctypes.data

    def set_beams(
        self, directions: Floats, origins: Floats | None, poses: Poses, first: int
    ) -> None:
        """Set the beams, the poses, and the pattern row of ray 0.

        `directions` and `origins` have shape (n, 3) and are in the sensor frame, in meters. In a
        pattern with sub-rays, each sub-ray is a row.
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

    def set_pattern(self, pattern: Pattern, poses: Poses, first: int) -> None:
        """Set the beams, the sub-rays, and the poses of a pattern, and the pattern row of ray 0."""
        self.set_beams(pattern.directions, pattern.origins, poses, first)
        sub_rays = pattern.sub_rays
        record = self.record
        if sub_rays is None:
            return
        record["subrays"] = len(sub_rays)
        record["sub_ray_table"] = self.address_of(sub_rays.loop_table(pattern.offsets))
        record["lanes_per_beam"] = lanes_per_beam(len(sub_rays))
        record["has_starts"] = sub_rays.starts is not None
        record["offsets"] = self.address_of(pattern.offsets)
        if sub_rays.axis is not None:
            record["has_axis"] = 1
            record["axis"] = sub_rays.axis
        if sub_rays.starts is not None:
            record["shares_origin"] = 0

"""The kernel that casts exported rays with NVIDIA Warp; needs warp-lang."""

import warp as wp

# No `from __future__ import annotations` here: Warp reads the types of arguments.


@wp.kernel
def first_distances(
    mesh: wp.uint64,
    origins: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    distances: wp.array(dtype=float),
):
    """Write the distance of the closest hit of each ray, infinite for a miss."""
    i = wp.tid()
    query = wp.mesh_query_ray(mesh, origins[i], directions[i], 1.0e6)
    if query.result:
        distances[i] = query.t
    else:
        distances[i] = wp.inf

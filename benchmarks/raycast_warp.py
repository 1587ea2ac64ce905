"""Ray query with NVIDIA Warp for benchmarks/gpu_warp.py (requires warp-lang)."""

import warp as wp

# No `from __future__ import annotations` here: Warp reads the types of arguments.


@wp.kernel
def first_hits(
    mesh: wp.uint64,
    origin: wp.vec3,
    directions: wp.array(dtype=wp.vec3),  # type: ignore[valid-type]
    t: wp.array(dtype=float),  # type: ignore[valid-type]
    face: wp.array(dtype=int),  # type: ignore[valid-type]
):
    """Write the distance and triangle of each ray's closest hit. The triangle is -1 for a miss."""
    i = wp.tid()
    query = wp.mesh_query_ray(mesh, origin, directions[i], 1.0e6)
    if query.result:
        t[i] = query.t
        face[i] = query.face
    else:
        t[i] = wp.inf
        face[i] = -1

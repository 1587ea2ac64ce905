"""Section of the GPU benchmark that casts the same rays with NVIDIA Warp."""

from __future__ import annotations

import statistics
import time
from typing import Any

import numpy as np
import warp

from .gpu_clock import Session
from .gpu_rays import MIDDLE, Rows, name_of
from .gpu_scenes import Float, city, revolution
from .raycast_warp import first_hits

# (constructor, most triangles for which it is tried): the one on the CPU takes minutes at 1e7.
_BUILDERS = (("lbvh", None), ("cubql", None), ("sah", 2_000_000))
_LEAF_SIZES = (1, 2, 4)


def peers(session: Session, device: str = "cuda:0") -> Rows:
    """Yield the rates of Warp's ray query in the cities, by tree builder and leaf size."""
    warp.config.quiet = True
    warp.init()
    once = revolution(session.sizes.rays)
    directions = {
        # As many rays at a time as our launches have.
        "coherent": np.tile(once, (session.sizes.poses, 1)),
        "shuffled": np.tile(np.random.default_rng(0).permutation(once), (session.sizes.poses, 1)),
    }
    for count in session.sizes.cities:
        vertices, faces = city(count)
        points = warp.array(np.float32(vertices - MIDDLE), dtype=warp.vec3, device=device)
        corners = warp.array(np.int32(faces).ravel(), dtype=warp.int32, device=device)
        for builder, max_faces in _BUILDERS:
            if max_faces is not None and len(faces) > max_faces:
                continue
            for size in _LEAF_SIZES:
                start = time.perf_counter()
                mesh = warp.Mesh(points, corners, bvh_constructor=builder, bvh_leaf_size=size)
                warp.synchronize_device(device)
                row: dict[str, Any] = {"build_s": time.perf_counter() - start}
                for name, rays in directions.items():
                    row[name] = _cast(mesh, rays, device, session.sizes.seconds / 3)
                yield f"{name_of(count)}, {builder}, leaves of {size}", row


def _cast(mesh: Any, directions: Float, device: str, seconds: float) -> dict[str, float]:
    n = len(directions)
    rays = warp.array(np.float32(directions), dtype=warp.vec3, device=device)
    distance = warp.empty(n, dtype=warp.float32, device=device)
    face = warp.empty(n, dtype=warp.int32, device=device)
    launch_options = {"inputs": [mesh.id, warp.vec3(), rays, distance, face], "device": device}
    times: list[float] = []
    end = None
    while end is None or len(times) < 3 or time.monotonic() < end:
        took = _timed(lambda: warp.launch(first_hits, n, **launch_options), device)
        if end is None:  # the first compiles
            end = time.monotonic() + seconds
        else:
            times.append(took)
    took = statistics.median(times)
    return {"ms": took, "grays_s": n / took / 1e6, "hits": int((face.numpy() >= 0).sum()) / n}


def _timed(launch: Any, device: str) -> float:
    """Time a launch in milliseconds.

    CUDA devices are timed with events, others with the wall clock.
    """
    if not warp.get_device(device).is_cuda:
        began = time.perf_counter()
        launch()
        return 1e3 * (time.perf_counter() - began)
    start, stop = (warp.Event(device, enable_timing=True) for _ in range(2))
    stream = warp.get_stream(device)
    stream.record_event(start)
    launch()
    stream.record_event(stop)
    return float(warp.get_event_elapsed_time(start, stop))

"""The same rays cast by NVIDIA Warp's mesh query, where Warp is installed."""

from __future__ import annotations

import importlib.util
import statistics
import time
from typing import Any

import numpy as np

from .cuda_scenes import Float, Mesh

# (constructor, most triangles for which it is tried): the one on the CPU takes minutes at 1e7.
_BUILDERS = (("lbvh", None), ("cubql", None), ("sah", 2_000_000))
_LEAF_SIZES = (1, 2, 4)


def available() -> bool:
    """Whether Warp can be imported."""
    return importlib.util.find_spec("warp") is not None


def casts(
    mesh: Mesh, origin: Float, rays: dict[str, Float], repeats: int, device: str = "cuda:0"
) -> list[dict[str, Any]]:
    """Rates of Warp's ray query with every way of building its tree.

    Parameters
    ----------
    mesh, origin
        Scene, and where all rays start, metres.
    rays
        Unit directions (n, 3) by name.
    repeats
        Times that each is cast; medians are kept.
    device
        Warp's name of the device.

    Returns
    -------
    rows
        Builder, leaf size, seconds to build, and by the rays' name milliseconds, Mray/s, hits.
    """
    import warp

    warp.config.quiet = True
    warp.init()
    kernel = _kernel(warp)
    vertices, faces = mesh
    points = warp.array((vertices - origin).astype(np.float32), dtype=warp.vec3, device=device)
    corners = warp.array(faces.astype(np.int32).ravel(), dtype=warp.int32, device=device)
    rows = []
    for builder, most in _BUILDERS:
        if most is not None and len(faces) > most:
            continue
        for leaf_size in _LEAF_SIZES:
            start = time.perf_counter()
            scene = warp.Mesh(points, corners, bvh_constructor=builder, bvh_leaf_size=leaf_size)
            warp.synchronize_device(device)
            row: dict[str, Any] = {
                "builder": builder,
                "leaf_size": leaf_size,
                "build_seconds": time.perf_counter() - start,
            }
            for name, directions in rays.items():
                row[name] = _cast(warp, kernel, scene, directions, repeats, device)
            rows.append(row)
    return rows


def best(rows: list[dict[str, Any]], name: str) -> float:
    """Greatest rate, Mray/s, for the rays of that name."""
    return max(float(row[name]["mrays_s"]) for row in rows)


def _kernel(warp: Any) -> Any:
    def closest(
        mesh: warp.uint64,
        directions: warp.array(dtype=warp.vec3),
        distance: warp.array(dtype=warp.float32),
        face: warp.array(dtype=warp.int32),
    ):
        i = warp.tid()
        query = warp.mesh_query_ray(mesh, warp.vec3(0.0, 0.0, 0.0), directions[i], 1.0e30)
        face[i] = -1
        if query.result:
            distance[i] = query.t
            face[i] = query.face

    # Warp reads the types themselves, not their names.
    array, integer, single = warp.array, warp.int32, warp.float32
    closest.__annotations__ = {
        "mesh": warp.uint64,
        "directions": array(dtype=warp.vec3),
        "distance": array(dtype=single),
        "face": array(dtype=integer),
    }
    return warp.kernel(closest, enable_backward=False)


def _cast(
    warp: Any, kernel: Any, scene: Any, directions: Float, repeats: int, device: str
) -> dict[str, float]:
    n = len(directions)
    rays = warp.array(directions.astype(np.float32), dtype=warp.vec3, device=device)
    distance = warp.empty(n, dtype=warp.float32, device=device)
    face = warp.empty(n, dtype=warp.int32, device=device)
    given = {"inputs": [scene.id, rays, distance, face], "device": device}
    times = []
    for turn in range(3 + repeats):
        took = _timed(warp, lambda: warp.launch(kernel, n, **given), device)
        if turn >= 3:
            times.append(took)
    median = statistics.median(times)
    hits = int((face.numpy() >= 0).sum())
    return {"ms": median, "mrays_s": n / median / 1e3, "hits": hits}


def _timed(warp: Any, launch: Any, device: str) -> float:
    """Milliseconds by events on a CUDA device, by the clock elsewhere."""
    if not warp.get_device(device).is_cuda:
        began = time.perf_counter()
        launch()
        return 1e3 * (time.perf_counter() - began)
    start = warp.Event(device, enable_timing=True)
    stop = warp.Event(device, enable_timing=True)
    stream = warp.get_stream(device)
    stream.record_event(start)
    launch()
    stream.record_event(stop)
    return float(warp.get_event_elapsed_time(start, stop))

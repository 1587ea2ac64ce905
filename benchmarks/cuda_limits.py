"""What surrounds the casts: builds, the way to the host, very many rays, rays at seams."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from raybeam import Pattern, RayCaster
from raybeam.cuda_backend import CudaBackend
from raybeam.layout import lay_out
from raybeam.mesh import LocalMesh
from raybeam.scan import check_scan

from .cuda_scenes import Float, revolution, six_objects
from .cuda_timing import milliseconds, wall_milliseconds


def build(cupy: Any, mesh: LocalMesh) -> float:
    """Milliseconds of a build by NumPy, the way to the device included."""
    start = time.perf_counter()
    made = lay_out((mesh,))
    tables = (made.nodes, made.triangles, made.corners, made.faces)
    kept = [cupy.asarray(table) for table in tables]
    cupy.cuda.Device().synchronize()
    took = 1e3 * (time.perf_counter() - start)
    assert len(kept) == len(tables)
    return took


def transfers(cupy: Any, size: int = 1 << 26) -> dict[str, float]:
    """GB/s between host and device, and on the device: what bounds a scan's way to the host."""
    array = cupy.empty(size, np.uint8)
    plain = np.zeros(size, np.uint8)
    calls = {
        "to_touched": lambda: array.get(out=plain),
        "to_fresh": array.get,
        "from_plain": lambda: array.set(plain),
    }
    rates = {
        name: size / wall_milliseconds(cupy, call, 7)["median"] / 1e6
        for name, call in calls.items()
    }
    other = cupy.empty_like(array)
    took = milliseconds(cupy, lambda: cupy.copyto(other, array), 11)["median"]
    return {**rates, "device_read_and_write": 2 * size / took / 1e6}


def many_rays(engine: CudaBackend, origin: Float, rays: int) -> dict[str, Any]:
    """Count the hits of more rays than one table holds: a pattern cast over and over."""
    pattern = Pattern(revolution(min(rays, 1 << 26)))
    times, counted = -(-rays // len(pattern)), 0
    scan = check_scan(pattern, origin)

    def count() -> int:
        casts = (engine._cast("cast_pattern", n, rays) for _, n, rays in engine._made(scan))
        return sum(int((place >= 0).sum()) for _, place, _ in casts)

    once = count()
    start = time.perf_counter()
    for _ in range(times):
        counted += count()
    seconds = time.perf_counter() - start
    total = times * len(pattern)
    return {
        "rays": total,
        "seconds": seconds,
        "mrays_s": total / seconds / 1e6,
        "same_every_time": counted == times * once,
    }


def leaks(rays: int) -> dict[str, int]:
    """Count rays from inside a closed object, at its edges and corners, that hit nothing."""
    vertices, faces = six_objects()
    faces = faces[: len(faces) // 6]
    vertices = vertices[: faces.max() + 1] + 5e5
    caster = RayCaster(vertices, faces, backend="cuda")
    inside = np.array([-20, -20, 1.5]) + 5e5
    rng = np.random.default_rng(2)
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    escaped = done = 0
    while done < rays:
        count = min(1 << 20, rays - done)
        ends = vertices[edges[rng.integers(len(edges), size=count)]]
        part = np.clip(rng.uniform(-0.5, 1.5, (count, 1)), 0, 1)  # half of them at corners
        origins = inside + 0.1 * rng.uniform(-1, 1, (count, 3))
        directions = ends[:, 0] * (1 - part) + ends[:, 1] * part - origins
        escaped += count - int(caster.cast(origins, directions).hit.sum())
        done += count
    return {"rays": done, "escaped": escaped}


def attributes(engine: CudaBackend) -> dict[str, dict[str, int]]:
    """Look up registers and local memory of the kernels that walk."""
    out = {}
    for name in ("cast_table", "cast_pattern"):
        kernel = engine._module.get_function(name)
        out[name] = {
            "registers": int(kernel.num_regs),
            "local_bytes": int(kernel.local_size_bytes),
        }
    return out

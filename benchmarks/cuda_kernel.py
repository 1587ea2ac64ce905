"""How fast the kernels of raybeam's cuda backend are, measured on the device.

Needs numpy and cupy only. From the repository's root:

    PYTHONPATH=kernels python -m benchmarks.cuda_kernel --json cuda_kernel.json

Times are medians of CUDA events around one launch, after a warm-up. Each scene is also cast by
the numpy backend on a sample of the rays; distances must have the same bits. The last column is
the original's method, every ray against every triangle, on fewer rays.
"""

from __future__ import annotations

import argparse
import json
import platform
import statistics
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from raybeam import Pattern, RayCaster, available_backends
from raybeam.cuda_backend import CudaBackend, flags
from raybeam.cuda_module import source
from raybeam.mesh import local_mesh

Mesh = tuple[NDArray[np.float64], NDArray[np.int64]]
Float = NDArray[np.float64]

_BLOCK = 128
_VARIANTS = (4, 6, 8, 10)  # blocks on a multiprocessor that a thread's registers must allow
_SAMPLE = 2000  # rays compared with the numpy backend

# Moeller and Trumbore in float against all triangles, without a tree.
_BRUTE_FORCE = """
extern "C" __global__ void brute_force(
    const float4* triangles, int triangle_count, float ox, float oy, float oz,
    const double* directions, int count, float* distance)
{
    const int i = blockIdx.x * blockDim.x + threadIdx.x;
    if (i >= count) return;
    const float dx = directions[3 * i], dy = directions[3 * i + 1], dz = directions[3 * i + 2];
    float best = 1e30f;
    for (int k = 0; k < triangle_count; ++k) {
        const float4 v = triangles[3 * k], e = triangles[3 * k + 1], g = triangles[3 * k + 2];
        const float px = dy * g.z - dz * g.y, py = dz * g.x - dx * g.z, pz = dx * g.y - dy * g.x;
        const float inverse = 1.0f / (e.x * px + e.y * py + e.z * pz);
        const float tx = ox - v.x, ty = oy - v.y, tz = oz - v.z;
        const float b = (tx * px + ty * py + tz * pz) * inverse;
        const float qx = ty * e.z - tz * e.y, qy = tz * e.x - tx * e.z, qz = tx * e.y - ty * e.x;
        const float c = (dx * qx + dy * qy + dz * qz) * inverse;
        const float t = (g.x * qx + g.y * qy + g.z * qz) * inverse;
        if (b >= 0.0f && c >= 0.0f && b + c <= 1.0f && t >= 0.0f && t < best) best = t;
    }
    distance[i] = best;
}
"""


# ---- scenes and rays ----


def grid_faces(rows: int, columns: int, wrap: bool = False) -> NDArray[np.int64]:
    """Two triangles for each cell of a grid of vertices."""
    i = np.arange(rows - 1)[:, None] * columns
    j = np.arange(columns if wrap else columns - 1)[None, :]
    k = (j + 1) % columns
    quad = np.stack(np.broadcast_arrays(i + j, i + k, i + columns + k, i + columns + j), axis=-1)
    return np.concatenate([quad[..., [0, 1, 2]], quad[..., [0, 2, 3]]]).reshape(-1, 3)


def joined(meshes: list[Mesh]) -> Mesh:
    """Several meshes as one."""
    starts = np.cumsum([0] + [len(vertices) for vertices, _ in meshes])
    return (
        np.concatenate([vertices for vertices, _ in meshes]),
        np.concatenate([f + start for (_, f), start in zip(meshes, starts, strict=False)]),
    )


def six_objects() -> Mesh:
    """Six surfaces of revolution, 80 by 80, as in the default survey."""
    polar = np.linspace(0, np.pi, 80)[:, None]
    around = np.arange(80) * 2 * np.pi / 80
    radius = 2 * np.sin(polar) * (0.75 + 0.25 * np.cos(3 * polar))
    height = np.broadcast_to(2 - 2 * np.cos(polar), (80, 80))
    one = np.stack([radius * np.cos(around), radius * np.sin(around), height], -1).reshape(-1, 3)
    places = [(-20, -20), (20, -20), (-20, 20), (20, 20), (-10, -5), (5, 5)]
    faces = grid_faces(80, 80, wrap=True)
    return joined([(one + np.array([x, y, 0]), faces) for x, y in places])


def city(triangles: int, seed: int = 0) -> Mesh:
    """Streets of box-shaped buildings with panelled faces on flat ground, about `triangles`."""
    rng = np.random.default_rng(seed)
    panels, pitch = 4, 20.0
    side = max(1, round(np.sqrt(triangles / (5 * 2 * panels**2 + 2))))
    line = np.linspace(-1, 1, panels + 1)
    a, b = (x.ravel() for x in np.meshgrid(line, line, indexing="ij"))
    one = np.ones_like(a)
    sides = [(a, b, one), (a, one, b), (a, -one, b), (one, a, b), (-one, a, b)]
    face = grid_faces(panels + 1, panels + 1)
    box, faces = joined([(np.stack(points, axis=-1), face) for points in sides])
    x, y = (c.ravel() for c in np.meshgrid(np.arange(side), np.arange(side), indexing="ij"))
    count = side * side
    middle = pitch * (np.stack([x, y], axis=-1) - (side - 1) / 2)
    half = rng.uniform(4, 7.5, (count, 2))
    height = rng.gamma(3, 6, count) + 3
    vertices = np.empty((count, len(box), 3))
    vertices[..., :2] = middle[:, None] + box[:, :2] * half[:, None]
    vertices[..., 2] = (box[:, 2] + 1) / 2 * height[:, None]
    buildings = faces + len(box) * np.arange(count)[:, None, None]
    edge = pitch * (np.arange(side + 1) - side / 2)
    gx, gy = np.meshgrid(edge, edge, indexing="ij")
    ground = np.stack([gx, gy, np.zeros_like(gx)], axis=-1).reshape(-1, 3)
    return joined([
        (vertices.reshape(-1, 3), buildings.reshape(-1, 3)),
        (ground, grid_faces(side + 1, side + 1)),
    ])  # fmt: skip


def revolution(rays: int, layers: int = 128) -> Float:
    """Return unit directions of one turn of a lidar with a field of view of 60 degrees."""
    azimuth = 2 * np.pi * np.arange(max(1, rays // layers))[:, None] / max(1, rays // layers)
    elevation = np.radians(np.linspace(-30, 30, layers))
    level = np.cos(elevation)
    parts = (np.cos(azimuth) * level, np.sin(azimuth) * level, np.sin(elevation))
    return np.stack(np.broadcast_arrays(*parts), axis=-1).reshape(-1, 3)


# ---- measuring ----


def milliseconds(cupy: Any, launch: Callable[[], object], repeats: int) -> dict[str, float]:
    """Median, least and greatest time of a launch on the device."""
    for _ in range(3):
        launch()
    times = []
    for _ in range(repeats):
        start, stop = cupy.cuda.Event(), cupy.cuda.Event()
        start.record()
        launch()
        stop.record()
        stop.synchronize()
        times.append(float(cupy.cuda.get_elapsed_time(start, stop)))
    return {"median": statistics.median(times), "least": min(times), "greatest": max(times)}


def wall_milliseconds(call: Callable[[], object], repeats: int) -> float:
    """Median time of a call that ends with its results on the host."""
    call()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        times.append(1e3 * (time.perf_counter() - start))
    return statistics.median(times)


class Bench:
    """One scene on the device, and everything that is measured of it."""

    def __init__(self, cupy: Any, mesh: Mesh, origin: Float, repeats: int) -> None:
        self.cupy, self.mesh, self.repeats = cupy, mesh, repeats
        self.origin = np.asarray(origin, dtype=np.float64)
        start = time.perf_counter()
        self.local = local_mesh(*mesh)
        self.engine = CudaBackend(self.local)
        cupy.cuda.Device().synchronize()
        self.build_seconds = time.perf_counter() - start

    def kernels(self, directions: Float) -> dict[str, Any]:
        """Time the two casts alone, and a whole scan up to arrays on the host."""
        cupy, n = self.cupy, len(directions)
        limits = (np.int64(n), np.float64(0), np.float64(np.inf))
        rays = cupy.asarray(directions)
        origin = cupy.asarray(self.origin)
        pose = cupy.asarray(np.concatenate([self.origin, np.eye(3).ravel()]))
        t, place = cupy.empty(n), cupy.empty(n, np.int32)
        scene = self.engine._scene
        grid = (-(-n // _BLOCK),)
        table = (*scene, origin, np.int32(0), rays, *limits, t, place)
        pattern = (*scene, pose, np.int32(1), rays, *limits, t, place)
        get = self.engine._kernels.module.get_function
        pattern_times = milliseconds(
            cupy, lambda: get("cast_pattern")(grid, (_BLOCK,), pattern), self.repeats
        )
        table_times = milliseconds(
            cupy, lambda: get("cast_table")(grid, (_BLOCK,), table), self.repeats
        )
        variants = {}
        for blocks in _VARIANTS:
            variant = self.variant(blocks)
            variants[f"blocks {blocks}"] = {
                "registers": int(variant.num_regs),
                "local_bytes": int(variant.local_size_bytes),
                **milliseconds(cupy, partial(variant, grid, (_BLOCK,), pattern), self.repeats),
            }
        kept = Pattern(directions)
        whole = wall_milliseconds(
            lambda: self.engine.scan(kept, (0, n), self.origin[None], None, (0.0, np.inf)),
            max(3, self.repeats // 4),
        )
        return {
            "rays": n,
            "hit_share": float((place >= 0).mean()),
            "cast_pattern_ms": pattern_times,
            "cast_table_ms": table_times,
            "variants_ms": variants,
            "scan_to_host_ms": whole,
            "cast_pattern_mrays_s": n / pattern_times["median"] / 1e3,
            "cast_table_mrays_s": n / table_times["median"] / 1e3,
            "scan_to_host_mrays_s": n / whole / 1e3,
        }

    def variant(self, blocks: int) -> Any:
        """Compile cast_pattern so that `blocks` blocks fit on a multiprocessor."""
        given = (*flags(self.engine._stack), f"-DBLOCKS={blocks}")
        module = self.cupy.RawModule(code=source("intersect.cu"), options=given)
        return module.get_function("cast_pattern")

    def brute_force(self, directions: Float) -> dict[str, float]:
        """Time of every ray against every triangle, on so many rays that it takes a moment."""
        cupy = self.cupy
        triangles = self.engine._scene[1]
        n = int(np.clip(4e10 / len(triangles), 1024, len(directions)))
        part = cupy.asarray(directions[:: max(1, len(directions) // n)][:n])
        n = len(part)
        at = self.local.to_local(self.origin[None])[0]
        kernel = cupy.RawKernel(_BRUTE_FORCE, "brute_force")
        out = cupy.empty(n, np.float32)
        at = [np.float32(x) for x in at]
        arguments = (triangles, np.int32(len(triangles)), *at, part, np.int32(n), out)
        took = milliseconds(cupy, lambda: kernel((-(-n // _BLOCK),), (_BLOCK,), arguments), 5)
        return {"rays": n, "ms": took["median"], "mrays_s": n / took["median"] / 1e3}

    def check(self, directions: Float) -> dict[str, int]:
        """Count rays of a sample that differ from the numpy backend's in any bit."""
        sample = np.ascontiguousarray(directions[:: max(1, len(directions) // _SAMPLE)])
        reference = RayCaster(*self.mesh, backend="numpy")
        want = reference.cast(self.origin, sample)
        got = RayCaster(*self.mesh, backend="cuda").cast(self.origin, sample)
        names = ("distance", "triangle", "u", "v")
        wrong = {name: int((getattr(got, name) != getattr(want, name)).sum()) for name in names}
        turn, _ = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))
        scan = self.engine.scan(
            Pattern(sample), (0, len(sample)), self.origin[None], turn, (0.0, np.inf)
        )
        turned = reference.scan(Pattern(sample), self.origin, turn)
        wrong["scan"] = len(sample)
        if np.array_equal(scan.ray, turned.ray):
            wrong["scan"] = int((scan.distance != turned.distance).sum())
        return {"sample": len(sample), "hits": int(want.hit.sum()), **wrong}


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
        escaped += count - len(caster.returns(origins, directions))
        done += count
    return {"rays": done, "escaped": escaped}


def attributes(module: Any) -> dict[str, dict[str, int]]:
    """Look up registers and local memory of the kernels."""
    out = {}
    for name in ("cast_table", "cast_pattern", "weigh_table"):
        kernel = module.get_function(name)
        out[name] = {
            "registers": int(kernel.num_regs),
            "local_bytes": int(kernel.local_size_bytes),
        }
    return out


def measure(
    cupy: Any, rays: int, triangles: list[int], repeats: int, leak_rays: int
) -> dict[str, Any]:
    """All scenes, coherent and shuffled rays."""
    scenes: dict[str, tuple[Mesh, Float]] = {"six objects": (six_objects(), np.array([0, 0, 2.0]))}
    for count in triangles:
        scenes[f"city {count:.0e}"] = (city(count), np.array([10.0, 10.0, 2.0]))
    directions = revolution(rays)
    shuffled = np.random.default_rng(0).permutation(directions)
    results = []
    for name, (mesh, origin) in scenes.items():
        bench = Bench(cupy, mesh, origin, repeats)
        row = {
            "scene": name,
            "triangles": len(mesh[1]),
            "build_seconds": bench.build_seconds,
            "coherent": bench.kernels(directions),
            "shuffled": bench.kernels(shuffled),
            "brute_force": bench.brute_force(directions),
            "differences": bench.check(directions),
        }
        results.append(row)
        show(row)
    properties = cupy.cuda.runtime.getDeviceProperties(cupy.cuda.Device().id)
    return {
        "device": properties["name"].decode(),
        "driver": cupy.cuda.runtime.driverGetVersion(),
        "runtime": cupy.cuda.runtime.runtimeGetVersion(),
        "cupy": cupy.__version__,
        "numpy": np.__version__,
        "python": platform.python_version(),
        "kernels": attributes(bench.engine._kernels.module),
        "leaks": leaks(leak_rays),
        "scenes": results,
    }


def show(row: dict[str, Any]) -> None:
    """Print one scene's rates in millions of rays a second."""
    print(f"{row['scene']}: {row['triangles']} triangles, built in {row['build_seconds']:.2f} s")
    for kind in ("coherent", "shuffled"):
        part = row[kind]
        times = part["cast_pattern_ms"]
        print(
            f"  {kind}: pattern {part['cast_pattern_mrays_s']:9.1f} Mray/s"
            f" ({times['least']:.3f} to {times['greatest']:.3f} ms)"
            f"  table {part['cast_table_mrays_s']:9.1f}"
            f"  scan to host {part['scan_to_host_mrays_s']:7.1f}"
            f"  hits {100 * part['hit_share']:.1f} %"
        )
        for name, times in part["variants_ms"].items():
            rate = part["rays"] / times["median"] / 1e3
            print(f"    {name}: {rate:9.1f} Mray/s, {times['registers']} registers")
    print(f"  brute force: {row['brute_force']['mrays_s']:.3f} Mray/s")
    print(f"  differences from numpy: {row['differences']}")


def main(arguments: list[str] | None = None) -> int:
    """Run from the command line; 1 when the device's answers are wrong, 2 without a device."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--rays", type=int, default=1 << 22)
    parser.add_argument("--triangles", type=int, nargs="*", default=[100_000, 1_000_000])
    parser.add_argument("--repeats", type=int, default=21)
    parser.add_argument("--leak-rays", type=int, default=10_000_000)
    parser.add_argument("--json", type=Path, help="write the results here")
    chosen = parser.parse_args(arguments)
    reason = available_backends()["cuda"]
    if reason:
        print(f"Nothing was measured: {reason}.", file=sys.stderr)
        return 2
    import cupy

    results = measure(cupy, chosen.rays, chosen.triangles, chosen.repeats, chosen.leak_rays)
    if chosen.json:
        chosen.json.write_text(json.dumps(results, indent=1) + "\n")
    differ = any(
        row["differences"][name]
        for row in results["scenes"]
        for name in ("distance", "triangle", "u", "v", "scan")
    )
    print(f"{results['device']}, CuPy {results['cupy']}; kernels: {results['kernels']}")
    print(f"rays at seams: {results['leaks']}")
    print("differences from numpy: " + ("yes" if differ else "none"))
    return int(differ or results["leaks"]["escaped"] > 0)


if __name__ == "__main__":
    sys.exit(main())

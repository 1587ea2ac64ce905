"""How fast raybeam's cuda backend is, measured on the device, with Warp beside it where it is.

Needs numpy and cupy only. From the repository's root:

    PYTHONPATH=kernels python -m benchmarks.cuda_kernel --json cuda_kernel.json

Times are medians of CUDA events around one launch, after a warm-up; builds and whole scans are
taken by the clock, from arrays on the host to arrays on the device and the other way round. Each
scene that NumPy can build a tree of in reasonable time is also cast by the numpy backend on a
sample of the rays; distances must have the same bits. Brute force is the original's method:
every ray against every triangle.
"""

from __future__ import annotations

import argparse
import json
import platform
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from raybeam import Pattern, RayCaster, available_backends
from raybeam.cuda_backend import CudaBackend
from raybeam.instances import plain
from raybeam.mesh import local_mesh
from raybeam.scan import Scan, check_scan

from . import cuda_limits, cuda_warp
from .cuda_scenes import Float, Mesh, city, revolution, six_objects
from .cuda_timing import milliseconds, wall_milliseconds

_BLOCK = 128
_SAMPLE = 2000  # rays compared with the numpy backend
_NUMPY_MOST = 2_000_000  # triangles; NumPy takes seconds a million to build its tree

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


class Bench:
    """One scene on the device, and everything that is measured of it."""

    def __init__(self, cupy: Any, mesh: Mesh, origin: Float, repeats: int) -> None:
        self.cupy, self.mesh, self.repeats = cupy, mesh, repeats
        self.origin = np.asarray(origin, dtype=np.float64)
        start = time.perf_counter()
        self.local = local_mesh(*mesh)
        self.check_seconds = time.perf_counter() - start
        self.engine = CudaBackend(plain(self.local))

    def whole(self, directions: Float) -> Scan:
        """Ask for all directions, from the origin, not turned."""
        return check_scan(Pattern(directions), self.origin)

    def build(self) -> dict[str, Any]:
        """Time the build, from the checked mesh on the host to the tables on the device."""
        milliseconds = cuda_limits.build(self.cupy, self.local)
        return {"check_mesh_s": self.check_seconds, "tree_ms": milliseconds}

    def kernels(self, directions: Float) -> dict[str, Any]:
        """Rates of the kernels alone, and of a whole scan up to arrays on the host."""
        cupy, engine, n, repeats = self.cupy, self.engine, len(directions), self.repeats
        scan = self.whole(directions)
        parts = list(engine._made(scan))
        results = [engine._cast("cast_pattern", size, rays) for _, size, rays in parts]
        hits = sum(int((place >= 0).sum()) for _, place, _ in results)

        def cast() -> None:
            for _, size, rays in parts:
                engine._cast("cast_pattern", size, rays)

        def pack() -> None:
            for found in results:
                engine._packed(*found, 1.0)

        times = {
            "cast": milliseconds(cupy, cast, repeats),
            "pack": milliseconds(cupy, pack, repeats),
            "scan_to_host": wall_milliseconds(cupy, lambda: engine.scan(scan), repeats),
        }
        rates = {name: n / took["median"] / 1e3 for name, took in times.items()}
        return {"rays": n, "hit_share": hits / n, "ms": times, "mrays_s": rates}

    def brute_force(self, directions: Float) -> dict[str, float]:
        """Rate of every ray against every triangle, on so many rays that it takes a moment."""
        cupy = self.cupy
        triangles = self.engine._meshes[1]
        n = int(np.clip(4e10 / len(triangles), 1024, len(directions)))
        part = cupy.asarray(directions[:: max(1, len(directions) // n)][:n])
        n = len(part)
        kernel = cupy.RawKernel(_BRUTE_FORCE, "brute_force")
        at = [np.float32(x) for x in self.local.frame.to_local(self.origin[None])[0]]
        out = cupy.empty(n, np.float32)
        given = (triangles, np.int32(len(triangles)), *at, part, np.int32(n), out)
        took = milliseconds(cupy, lambda: kernel((-(-n // _BLOCK),), (_BLOCK,), given), 3)
        return {"rays": n, "ms": took["median"], "mrays_s": n / took["median"] / 1e3}

    def differences(self, directions: Float) -> dict[str, int] | None:
        """Count rays of a sample that differ from the numpy backend's in any bit."""
        if len(self.mesh[1]) > _NUMPY_MOST:
            return None
        sample = np.ascontiguousarray(directions[:: max(1, len(directions) // _SAMPLE)])
        reference = RayCaster(*self.mesh, backend="numpy")
        device = RayCaster(*self.mesh, backend="cuda")
        want, got = (caster.cast(self.origin, sample) for caster in (reference, device))
        names = ("distance", "triangle", "u", "v")
        wrong = {name: int((getattr(got, name) != getattr(want, name)).sum()) for name in names}
        turn, _ = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))
        pattern = Pattern(sample)
        track = self.origin + 1e-3 * np.arange(len(sample))[:, None]
        for name, poses in (("scan", (self.origin, turn)), ("moving scan", (track, turn))):
            scan, turned = (
                c.scan(pattern, *poses, rays_per_pose=len(sample) if name == "scan" else 1)
                for c in (device, reference)
            )
            wrong[name] = len(sample)
            if np.array_equal(scan.ray, turned.ray):
                wrong[name] = int((scan.distance != turned.distance).sum())
        return {"sample": len(sample), "hits": int(want.hit.sum()), **wrong}


def measure_scene(
    cupy: Any, name: str, mesh: Mesh, origin: Float, rays: dict[str, Float], repeats: int
) -> tuple[dict[str, Any], Bench]:
    """Everything about one scene."""
    bench = Bench(cupy, mesh, origin, repeats)
    row: dict[str, Any] = {"scene": name, "triangles": len(mesh[1]), "build": bench.build()}
    row |= {kind: bench.kernels(directions) for kind, directions in rays.items()}
    row["brute_force"] = bench.brute_force(rays["coherent"])
    row["differences"] = bench.differences(rays["coherent"])
    row["warp"] = None
    if cuda_warp.available():
        cupy.get_default_memory_pool().free_all_blocks()
        row["warp"] = cuda_warp.casts(mesh, origin, rays, repeats)
    return row, bench


def measure(
    cupy: Any, rays: int, triangles: list[int], repeats: int, many: int, leak_rays: int
) -> dict[str, Any]:
    """All scenes, coherent and shuffled rays."""
    directions = revolution(rays)
    cast = {
        "coherent": directions,
        "shuffled": np.random.default_rng(0).permutation(directions),
    }
    middle = np.array([10.0, 10.0, 2.0])
    row, bench = measure_scene(
        cupy, "six objects", six_objects(), np.array([0, 0, 2.0]), cast, repeats
    )
    show(row)
    rows = [row]
    for count in triangles:
        row, bench = measure_scene(cupy, f"city {count:.0e}", city(count), middle, cast, repeats)
        show(row)
        rows.append(row)
    properties = cupy.cuda.runtime.getDeviceProperties(cupy.cuda.Device().id)
    return {
        "device": properties["name"].decode(),
        "driver": cupy.cuda.runtime.driverGetVersion(),
        "runtime": cupy.cuda.runtime.runtimeGetVersion(),
        "cupy": cupy.__version__,
        "numpy": np.__version__,
        "python": platform.python_version(),
        "kernels": cuda_limits.attributes(bench.engine),
        "transfers_gb_s": cuda_limits.transfers(cupy),
        "many_rays": cuda_limits.many_rays(bench.engine, bench.origin, many),
        "leaks": cuda_limits.leaks(leak_rays),
        "scenes": rows,
    }


def show(row: dict[str, Any]) -> None:
    """Print one scene's rates in millions of rays a second."""
    build = row["build"]
    print(
        f"{row['scene']}: {row['triangles']} triangles, tree {build['tree_ms']:.0f} ms; "
        f"mesh checked in {build['check_mesh_s']:.2f} s"
    )
    for kind in ("coherent", "shuffled"):
        part = row[kind]
        took = part["ms"]["cast"]
        rates = ", ".join(f"{name} {rate:.0f}" for name, rate in part["mrays_s"].items())
        print(
            f"  {kind}: {rates} Mray/s"
            f" (cast {took['least']:.3f} to {took['greatest']:.3f} ms,"
            f" {100 * part['hit_share']:.1f} % hit)"
        )
        if row["warp"]:
            peer = cuda_warp.best(row["warp"], kind)
            print(f"    Warp {peer:.0f} Mray/s at best; {part['mrays_s']['cast'] / peer:.2f} times")
    print(f"  brute force: {row['brute_force']['mrays_s']:.3f} Mray/s")
    print(f"  differences from numpy: {row['differences']}")


def main(arguments: list[str] | None = None) -> int:
    """Run from the command line; 1 when the device's answers are wrong, 2 without a device."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--rays", type=int, default=1 << 22)
    parser.add_argument(
        "--triangles", type=int, nargs="*", default=[100_000, 1_000_000, 10_000_000]
    )
    parser.add_argument("--repeats", type=int, default=21)
    parser.add_argument("--many-rays", type=int, default=1 << 31)
    parser.add_argument("--leak-rays", type=int, default=10_000_000)
    parser.add_argument("--json", type=Path, help="write the results here")
    chosen = parser.parse_args(arguments)
    reason = available_backends()["cuda"]
    if reason:
        print(f"Nothing was measured: {reason}.", file=sys.stderr)
        return 2
    import cupy

    sizes = (chosen.rays, chosen.triangles, chosen.repeats, chosen.many_rays, chosen.leak_rays)
    results = measure(cupy, *sizes)
    if chosen.json:
        chosen.json.write_text(json.dumps(results, indent=1) + "\n")
    checked = [row["differences"] for row in results["scenes"] if row["differences"]]
    differ = any(
        number for row in checked for name, number in row.items() if name not in ("sample", "hits")
    )
    print(f"{results['device']}, CuPy {results['cupy']}; kernels: {results['kernels']}")
    for name in ("transfers_gb_s", "many_rays", "leaks"):
        print(f"{name}: {results[name]}")
    print("differences from numpy: " + ("yes" if differ else "none"))
    return int(differ or results["leaks"]["escaped"] > 0)


if __name__ == "__main__":
    sys.exit(main())

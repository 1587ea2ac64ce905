"""What a better tree would gain: `python -m benchmarks.trees`.

Casts each scene's rays through three trees with one and the same walk, that of intersect.cu,
compiled for the CPU: ours; one that is clustered up to its root (ploc.py without the sweep); and
one by a full sweep with the surface area heuristic from the root to the last triangle, which is
at least as good as what Embree builds. Leaves, width and walk are equal, so what differs are the
boxes. Prints nodes (of four boxes), triangles and decisions in double precision, each a ray.
Needs g++.
"""

from __future__ import annotations

import argparse
import ctypes
import importlib.resources
import json
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

from raybeam import cuda_backend, ploc
from raybeam.cuda_tables import MeshTables, build_instance_tables, build_mesh_tables
from raybeam.instances import single_mesh_scene
from raybeam.mesh import LocalMesh, local_mesh

from .raycast_scenes import Job, jobs

# Clusters that are left to the sweep: as it comes, only one, all boxes.
TREES: dict[str, tuple[int, int] | None] = {
    "ours": None, "clustered": (1, 1), "sweep": (1 << 30, 1 << 30),
}  # fmt: skip
KINDS = ("nodes", "triangles", "decisions")
_HOST = Path(__file__).parent.parent / "tests" / "raybeam" / "host"
_STACK = 256
_BLOCK = 128


def compile_kernels(folder: Path) -> ctypes.CDLL:
    """Compile intersect.cu for the CPU, with counters."""
    library = folder / "intersect.so"
    files = importlib.resources.files("raybeam")
    with importlib.resources.as_file(files / "intersect.cu") as kernels:
        flags = [flag for flag in cuda_backend.flags(_STACK, False, False) if flag != "-fmad=false"]
        command = [
            "g++",
            "-O2",
            "-ffp-contract=off",
            "-shared",
            "-fPIC",
            *flags,
            f'-DSOURCE="{kernels}"',
            "-o",
            str(library),
            str(_HOST / "intersect.cpp"),
        ]
        subprocess.run(command, check=True)
    loaded = ctypes.CDLL(str(library))
    loaded.what_was_seen.restype = ctypes.POINTER(ctypes.c_longlong)
    return loaded


def count(library: ctypes.CDLL, layout: MeshTables, mesh: LocalMesh, job: Job) -> dict[str, float]:
    """Cast the rays of a job, and return the counters per ray and the share of hits."""
    directions = np.ascontiguousarray((job.directions @ job.rotation.T).T)
    n = directions.shape[1]
    distance = np.empty(n)
    triangle = np.empty(n, np.int32)
    instance_layout = build_instance_tables(single_mesh_scene(mesh), layout.roots)
    instance_tables = (instance_layout.frame, instance_layout.top, instance_layout.instances)
    counters_before = _read_counters(library)
    hits = 0
    for origin in job.origins:
        tables = (
            layout.nodes,
            layout.triangles,
            layout.corners,
            layout.faces,
            *cuda_backend.NO_MASKS,
        )
        shared_origin = (np.array(origin), ctypes.c_longlong(1))
        rays = (*shared_origin, directions, ctypes.c_longlong(n))
        limits = (ctypes.c_double(0.0), ctypes.c_double(np.inf))
        _run(
            library,
            "cast_table",
            n,
            *tables,
            *instance_tables,
            *rays,
            *limits,
            distance,
            triangle,
            triangle,
        )
        hits += int((triangle >= 0).sum())
    per_ray = (_read_counters(library) - counters_before) / job.rays
    return {**dict(zip(KINDS, per_ray.tolist(), strict=True)), "hit_share": hits / job.rays}


def _read_counters(library: ctypes.CDLL) -> np.ndarray[Any, Any]:
    return np.array(library.what_was_seen()[: len(KINDS)])


def _run(library: ctypes.CDLL, name: str, threads: int, *arguments: Any) -> None:
    """Launch a kernel; tests/raybeam/host/launch.h defines its interface."""
    assert getattr(library, f"parameters_{name}")() == len(arguments)
    values = [ctypes.c_void_p(a.ctypes.data) if isinstance(a, np.ndarray) else a for a in arguments]
    pointers = (ctypes.c_void_p * len(values))(*(ctypes.addressof(value) for value in values))
    getattr(library, f"run_{name}")(ctypes.c_uint(-(-threads // _BLOCK)), pointers)


def measure(library: ctypes.CDLL, job: Job) -> dict[str, Any]:
    """Measure all trees on a job."""
    mesh = local_mesh(job.vertices, job.faces)
    row: dict[str, Any] = {"scene": job.name, "triangles": len(mesh.corners), "rays": job.rays}
    for name, cluster_limits in TREES.items():
        start = time.process_time()
        layout = (
            build_mesh_tables((mesh,))
            if cluster_limits is None
            else _lay_out_limited(mesh, cluster_limits)
        )
        row[name] = {
            "build_s": time.process_time() - start,
            "tree_nodes": len(layout.nodes),
            **count(library, layout, mesh, job),
        }
    return row


def _lay_out_limited(mesh: LocalMesh, cluster_limits: tuple[int, int]) -> MeshTables:
    """Lay out a mesh with limits on the clusters left to the sweep."""
    with (
        patch.object(ploc, "_MAX_CLUSTERS", cluster_limits[0]),
        patch.object(ploc, "_MIN_CLUSTERS", cluster_limits[1]),
    ):
        return build_mesh_tables((mesh,))


def show(row: dict[str, Any]) -> None:
    """Print the counts for a scene as a table row."""
    cells = [row["scene"], f"{row['triangles']:,}"]
    cells += [" / ".join(f"{row[name][kind]:.2f}" for name in TREES) for kind in KINDS]
    cells.append(f"{row['ours']['nodes'] / row['sweep']['nodes']:.2f}")
    cells.append(" / ".join(f"{row[name]['build_s']:.2f}" for name in TREES))
    print("| " + " | ".join(cells) + " |", flush=True)


def main(arguments: list[str] | None = None) -> int:
    """Run from the command line; return 2 without a compiler."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--quick", action="store_true", help="toy scenes, few rays")
    parser.add_argument("--scene", action="append", help="only this one; may be given again")
    parser.add_argument("--mesh", action="append", type=Path, default=[], help="a mesh file more")
    parser.add_argument("--rays", type=int, default=1 << 17, help="rays of a scan")
    parser.add_argument("--json", type=Path, help="write the results here")
    chosen = parser.parse_args(arguments)
    if shutil.which("g++") is None:
        print("Nothing was counted: g++ is not here to compile the kernels.", file=sys.stderr)
        return 2
    makers = jobs(2_000 if chosen.quick else chosen.rays, chosen.mesh, chosen.quick)
    unknown = set(chosen.scene or ()) - set(makers)
    if unknown:
        parser.error(f"there is no scene {', '.join(unknown)}: {', '.join(makers)}")
    rows = []
    print(f"of each: {' / '.join(TREES)}")
    print("| scene | triangles | nodes | triangle tests | decisions | nodes, ratio | seconds |")
    with tempfile.TemporaryDirectory() as folder:
        library = compile_kernels(Path(folder))
        for name, make in makers.items():
            if not chosen.scene or name in chosen.scene:
                rows.append(measure(library, make()))
                show(rows[-1])
    if chosen.json:
        chosen.json.write_text(json.dumps(rows, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""Compare the tests per ray of our bounding volume hierarchy with better hierarchies.

    python -m benchmarks.trees [--scene NAME] [--mesh FILE]

The same code, intersect.cu compiled for the CPU, traverses three trees: our tree, a tree that is
clustered up to its root (ploc.py without the sweep), and a tree built by a full sweep with the
surface area heuristic, which is at least as good as Embree's trees. All have the same leaf size and
width. The table lists visited nodes (four boxes each), triangle tests, and decisions in double
precision per ray. The benchmark requires g++.
"""

from __future__ import annotations

import ctypes
import importlib.resources
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

from .harness import argument_parser, print_row, write_results
from .raycast import add_scene_options, chosen_jobs
from .raycast_scenes import Job

# Clusters that are left to the sweep: as it comes, only one, all boxes.
TREES: dict[str, tuple[int, int] | None] = {
    "ours": None, "clustered": (1, 1), "sweep": (1 << 30, 1 << 30),
}  # fmt: skip
KINDS = ("nodes", "triangles", "decisions")
_HOST = Path(__file__).parent.parent / "tests" / "raybeam" / "host"
_STACK = 256
_BLOCK = 128


def compile_kernels(folder: Path) -> ctypes.CDLL:
    """Compile intersect.cu for the CPU, with counters of nodes, triangles and decisions."""
    library = folder / "intersect.so"
    files = importlib.resources.files("raybeam")
    with importlib.resources.as_file(files / "intersect.cu") as kernels:
        options = cuda_backend.compiler_options(_STACK, False, False)
        flags = [option for option in options if option != "-fmad=false"]
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
    """Cast the rays of a job, and return the counts per ray and the hit ratio."""
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
    """Launch a kernel.

    Its interface is defined in tests/raybeam/host/launch.h.
    """
    assert getattr(library, f"parameters_{name}")() == len(arguments)
    values = [ctypes.c_void_p(a.ctypes.data) if isinstance(a, np.ndarray) else a for a in arguments]
    pointers = (ctypes.c_void_p * len(values))(*(ctypes.addressof(value) for value in values))
    getattr(library, f"run_{name}")(ctypes.c_uint(-(-threads // _BLOCK)), pointers)


def measure(library: ctypes.CDLL, job: Job) -> dict[str, Any]:
    """Build all trees for a job, and count their tests."""
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
    """Build the tables of a mesh, limiting the clusters that are left to the sweep."""
    with (
        patch.object(ploc, "_MAX_CLUSTERS", cluster_limits[0]),
        patch.object(ploc, "_MIN_CLUSTERS", cluster_limits[1]),
    ):
        return build_mesh_tables((mesh,))


def show(row: dict[str, Any]) -> None:
    """Print the counts of a scene as a table row."""
    cells = [row["scene"], f"{row['triangles']:,}"]
    cells += [" / ".join(f"{row[name][kind]:.2f}" for name in TREES) for kind in KINDS]
    cells.append(f"{row['ours']['nodes'] / row['sweep']['nodes']:.2f}")
    cells.append(" / ".join(f"{row[name]['build_s']:.2f}" for name in TREES))
    print_row(*cells)


def main(arguments: list[str] | None = None) -> int:
    """Print the table, and return 2 if g++ is not installed."""
    parser = argument_parser(__doc__, quick=True)
    add_scene_options(parser)
    options = parser.parse_args(arguments)
    if shutil.which("g++") is None:
        print("Nothing was measured, because g++ is not installed.", file=sys.stderr)
        return 2
    rows = []
    print(f"Values are listed for {' / '.join(TREES)}.")
    print_row(
        "scene", "triangles", "nodes", "triangle tests", "decisions", "node ratio", "build time (s)"
    )
    with tempfile.TemporaryDirectory() as folder:
        library = compile_kernels(Path(folder))
        for make in chosen_jobs(parser, options):
            rows.append(measure(library, make()))
            show(rows[-1])
    write_results(options.json, rows)
    return 0


if __name__ == "__main__":
    sys.exit(main())

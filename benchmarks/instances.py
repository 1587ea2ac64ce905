"""Forests of equal trees: `python -m benchmarks.instances`.

A tree is 50,000 leaf triangles of 4 cm. A thousand instances of it, and a smaller forest of which
every tree is in one mesh, are scanned by a 64-beam lidar that moves between them, on
one thread. Each forest is made in a process of its own, which says how much memory the caster took
(growth of VmHWM) and how many rays it casts in a second of processor time.
"""

from __future__ import annotations

import argparse
import multiprocessing
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from raybeam import Instance, Mesh, Pattern, RayCaster, available_backends

from .gpu_scenes import beam_directions

Float = NDArray[np.float64]

_BEAMS = 64
_POSES = 8
_APART = 8.0
_GROUND = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]), [[0, 1, 2], [0, 2, 3]]


def tree(leaves: int) -> tuple[Float, NDArray[np.int64]]:
    """Make a crown of triangles around a point 6 m above the ground."""
    rng = np.random.default_rng(1)
    middle = rng.normal(size=(leaves, 1, 3)) * [1.5, 1.5, 2] + [0, 0, 6]
    corners = middle + 0.04 * rng.normal(size=(leaves, 3, 3))
    return corners.reshape(-1, 3), np.arange(3 * leaves).reshape(-1, 3)


def tree_transforms(trees: int) -> Float:
    """Make transforms (trees, 3, 4): a square grid, with random yaw and scale of each tree."""
    rng = np.random.default_rng(2)
    side = int(np.ceil(np.sqrt(trees)))
    angle = rng.uniform(0, 2 * np.pi, trees)
    size = rng.uniform(0.8, 1.2, trees)
    number = np.arange(trees)
    transforms = np.zeros((trees, 3, 4))
    transforms[:, 0, 0] = transforms[:, 1, 1] = size * np.cos(angle)
    transforms[:, 1, 0] = size * np.sin(angle)
    transforms[:, 0, 1] = -transforms[:, 1, 0]
    transforms[:, 2, 2] = size
    transforms[:, 0, 3] = _APART * (number % side)
    transforms[:, 1, 3] = _APART * (number // side)
    transforms[:, :2, 3] -= _APART * (side - 1) / 2
    return transforms


def peak() -> float:
    """Return the peak memory of this process, MB, or 0 without /proc."""
    status = Path("/proc/self/status")
    lines = status.read_text().splitlines() if status.exists() else []
    return sum(int(line.split()[1]) for line in lines if line.startswith("VmHWM")) / 1e3


TreeMesh = tuple[Float, NDArray[np.int64]]


def instanced_forest(tree_mesh: TreeMesh, transforms: Float, backend: str) -> RayCaster:
    """Make a caster of instances of a tree on a ground."""
    mesh = Mesh(*tree_mesh)
    reach = _reach(len(transforms))
    ground = Instance(Mesh(*_GROUND), np.diag([reach, reach, 1.0, 1.0]))
    instances = [Instance(mesh, matrix) for matrix in transforms]
    return RayCaster.from_instances([ground, *instances], backend, threads=1)


def merged_forest(tree_mesh: TreeMesh, transforms: Float, backend: str) -> RayCaster:
    """Make a caster of the same trees and ground in a single mesh."""
    vertices, faces = tree_mesh
    trees = len(transforms)
    all_points = [vertices @ m[:, :3].T + m[:, 3] for m in transforms]
    all_faces = [faces + k * len(vertices) for k in range(trees)]
    all_points.append(_GROUND[0] * [_reach(trees), _reach(trees), 1])
    all_faces.append(np.array(_GROUND[1]) + trees * len(vertices))
    merged = np.concatenate(all_points), np.concatenate(all_faces)
    del all_points, all_faces
    return RayCaster(*merged, backend, threads=1)


def _reach(trees: int) -> float:
    """Half the side of the ground, meters."""
    return float(_APART * np.sqrt(trees) + 50)


def measure(trees: int, leaves: int, shared: bool, rays: int, backend: str) -> dict[str, Any]:
    """Build a forest and scan the forest; call this function in a new process."""
    tree_mesh = tree(leaves)
    transforms = tree_transforms(trees)
    build = instanced_forest if shared else merged_forest
    RayCaster(*_GROUND, backend, threads=1)  # loads the backend
    memory_before = peak()
    start = time.process_time()
    caster = build(tree_mesh, transforms, backend)
    built = time.process_time() - start
    memory = peak() - memory_before
    pattern = Pattern(beam_directions(_BEAMS, rays))
    rng = np.random.default_rng(3)
    positions = np.column_stack([rng.uniform(-30, 30, (_POSES, 2)), np.full(_POSES, 2.0)])
    seconds = []
    hits = 0
    for position in (positions[0], *positions):  # the first twice: to warm up
        start = time.process_time()
        hits += int(caster.scan(pattern, position).hit_counts.sum())
        seconds.append(time.process_time() - start)
    return {
        "triangles": trees * leaves + 2,
        "memory_mb": memory,
        "build_s": built,
        "mrays_s": len(pattern) / float(np.median(seconds[1:])) / 1e6,
        "hit_share": hits / len(pattern) / (_POSES + 1),
    }


def main(arguments: list[str] | None = None) -> int:
    """Run from the command line; return 2 if the backend is not available."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--quick", action="store_true", help="toy sizes")
    parser.add_argument("--backend", default="tiles")
    chosen = parser.parse_args(arguments)
    if reason := available_backends()[chosen.backend]:
        print(f"Nothing was measured: {reason}", file=sys.stderr)
        return 2
    large_count, small_count, leaves, rays = (
        (20, 4, 500, 2_000) if chosen.quick else (1000, 32, 50_000, 115_200)
    )
    context = multiprocessing.get_context("spawn")
    print("| trees | as | triangles | memory, MB | build, s | Mrays/s | hits |")
    for trees, shared in ((large_count, True), (small_count, True), (small_count, False)):
        with context.Pool(1) as pool:
            job = (trees, leaves, shared, rays, chosen.backend)
            row = pool.apply(measure, job)
        print(
            f"| {trees:,} | {'instances' if shared else 'one mesh'} | {row['triangles']:,} | "
            f"{row['memory_mb']:,.0f} | {row['build_s']:.2f} | {row['mrays_s']:.2f} | "
            f"{100 * row['hit_share']:.0f} % |",
            flush=True,
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())

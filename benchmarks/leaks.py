"""Count the rays that escape from closed meshes with each backend.

    python -m benchmarks.leaks [--rays N] [--triangles N]

All rays start inside the mesh and are aimed at edges and corners. Rays escape there if triangles
are rounded independently of each other. The exit code is 1 if a ray escapes from an exact backend.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lidarscenes.procedural.terrain import terrain
from lidarsim.scene.shapes import revolve, seed_objects
from raybeam import RayCaster, available_backends

from .harness import argument_parser, write_results
from .seams import count_escaped


@dataclass(frozen=True, eq=False)
class Closed:
    """Closed mesh with a point inside it, and the distance by which this point may be moved."""

    name: str
    vertices: NDArray[np.float64]
    faces: NDArray[np.integer]
    inside: NDArray[np.float64]
    room: float


def closed_meshes(triangles: int) -> Iterator[Closed]:
    """Yield a cube, a sphere, the six objects of the default survey, and a box of terrain."""
    x = np.stack(np.meshgrid([-1.0, 1], [-1.0, 1], [-1.0, 1], indexing="ij"), -1).reshape(-1, 3)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    sides = np.array([f for a, b, c, d in quads for f in ((a, b, c), (a, c, d))])
    yield Closed("cube", x, sides, np.array([0.05, 0.1, 0.4]), 0.05)
    angle = np.linspace(-np.pi / 2, np.pi / 2, 82)
    sphere = revolve(np.stack([np.cos(angle), np.sin(angle)], axis=1), 80)
    yield Closed("unit sphere", sphere.vertices, sphere.faces, np.array([0.05, 0.1, 0.4]), 0.05)
    for mesh in seed_objects():
        corners = mesh.vertices[mesh.faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        widest = int(np.linalg.norm(normals, axis=1).argmax())
        inwards = -normals[widest] / np.linalg.norm(normals[widest])
        inside = corners[widest].mean(axis=0) + 0.04 * inwards
        yield Closed(mesh.name.lower(), mesh.vertices, mesh.faces, inside, 0.01)
    yield terrain_box(triangles)


def terrain_box(triangles: int) -> Closed:
    """Make fractal ground, and a lid on the same grid, joined by walls."""
    ground = terrain(triangles // 2)
    points = np.array(ground.vertices)
    faces = np.array(ground.faces)
    n = len(points)
    lid = points.copy()
    lid[:, 2] = points[:, 2].max() + 50
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    keys = edges.min(axis=1).astype(np.int64) * n + edges.max(axis=1)
    _, first, times = np.unique(keys, return_index=True, return_counts=True)
    a, b = edges[first[times == 1]].T  # the rim: edges of one triangle only
    walls = np.concatenate([np.stack([b, a, a + n], -1), np.stack([b, a + n, b + n], -1)])
    inside = np.array([0.0, 0.0, points[:, 2].max() + 20])
    all_faces = np.concatenate([faces, faces[:, ::-1] + n, walls])
    return Closed("terrain box", np.concatenate([points, lid]), all_faces, inside, 10.0)


def main(arguments: list[str] | None = None) -> int:
    """Print the table, and return 1 if a ray escapes from an exact backend."""
    parser = argument_parser(__doc__)
    parser.add_argument(
        "--rays", type=int, default=10_000_000, help="number of rays for each backend"
    )
    parser.add_argument(
        "--triangles", type=int, default=2_000_000, help="triangles of the terrain box"
    )
    options = parser.parse_args(arguments)
    backends = [name for name, reason in available_backends().items() if not reason]
    meshes = list(closed_meshes(options.triangles))
    share = -(-options.rays // len(meshes))
    results: dict[str, dict[str, dict[str, float]]] = {name: {} for name in backends}
    for mesh in meshes:
        for name in backends:
            start = time.perf_counter()
            caster = RayCaster(mesh.vertices, mesh.faces, name)
            arrays = mesh.vertices, mesh.faces
            row = count_escaped(caster, arrays, mesh.inside, mesh.room, share)
            row["seconds"] = time.perf_counter() - start
            results[name][mesh.name] = row
            print(
                f"{mesh.name:<12} {name:<7} {row['escaped']:>7,} of {row['rays']:,} escaped  "
                f"({row['seconds']:.1f} s)"
            )
    for name in backends:
        rays, leaks = (sum(v[key] for v in results[name].values()) for key in ("rays", "escaped"))
        print(f"{name}: {leaks:,.0f} of {rays:,.0f} rays escaped ({leaks / rays:.2g})")
    write_results(options.json, results)
    exact = [entry for name in backends if name != "tiles" for entry in results[name].values()]
    return int(any(entry["escaped"] for entry in exact))


if __name__ == "__main__":
    sys.exit(main())

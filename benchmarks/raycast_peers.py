"""What benchmarks/raycast.py compares with: Open3D, trimesh with embreex, NVIDIA Warp."""

from __future__ import annotations

import importlib.util
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from .raycast_engines import BruteForce, Cast, Cuda, Engine, Numpy, Tiles
from .raycast_scenes import Job

Float = NDArray[np.float64]

_MISS = 0xFFFFFFFF


class Open3D(Engine):
    """Bare loop over `RaycastingScene.cast_rays` with prepared rays."""

    name = "Open3D, bare"
    chunk = 1 << 17

    def missing(self) -> str:
        """Return the command that installs Open3D, or an empty string if it is installed."""
        return "" if importlib.util.find_spec("open3d") else "pip install open3d-cpu"

    def prepare(self, job: Job) -> Cast:
        """Build an Open3D scene and chunks of rays, and return a function that casts the chunks."""
        import open3d

        scene = _open3d_scene(job, self.threads)
        chunks = [
            open3d.core.Tensor.from_numpy(rows)
            for rows in _chunks(job, job.origins[:, None], self.chunk)
        ]
        hits = sum(
            int((scene.cast_rays(part)["primitive_ids"].numpy() != _MISS).sum()) for part in chunks
        )

        def cast() -> int:
            for part in chunks:
                scene.cast_rays(part, nthreads=self.threads)
            return hits

        return cast


class Open3DWithNumpy(Open3D):
    """Open3D with rays made and hits gathered in NumPy, as a script would do."""

    name = "Open3D + NumPy"

    def prepare(self, job: Job) -> Cast:
        """Build Open3D's scene; return a function that makes rays, casts and gathers hits."""
        import open3d

        scene = _open3d_scene(job, self.threads)

        def count_hits(origin: Float) -> int:
            directions = job.directions @ job.rotation.T
            rays = np.hstack([np.tile(origin, (len(directions), 1)), directions])
            tensor = open3d.core.Tensor(rays.astype(np.float32))
            answer = scene.cast_rays(tensor, nthreads=self.threads)
            t = answer["t_hit"].numpy()
            triangle = answer["primitive_ids"].numpy()
            hit = np.isfinite(t)
            points = origin + t[hit, None] * directions[hit]
            return len(points) if len(triangle[hit]) == len(points) else -1

        return lambda: sum(count_hits(origin) for origin in job.origins)


class Trimesh(Engine):
    """Fastest query of trimesh with embreex: from poses to triangles, without distances."""

    name = "trimesh + embreex"

    def missing(self) -> str:
        """Return how to install embreex, or an empty string."""
        return "" if importlib.util.find_spec("embreex") else "pip install embreex"

    def prepare(self, job: Job) -> Cast:
        """Build the intersector; return a function that queries from all origins."""
        import trimesh
        from trimesh.ray.ray_pyembree import RayMeshIntersector

        scene = RayMeshIntersector(trimesh.Trimesh(job.vertices, job.faces, process=False))

        def count_hits(origin: Float) -> int:
            directions = job.directions @ job.rotation.T
            return self.hits(scene, np.tile(origin, (len(directions), 1)), directions)

        count_hits(job.origins[0])  # builds the tree
        return lambda: sum(count_hits(origin) for origin in job.origins)

    def hits(self, scene: Any, origins: Float, directions: Float) -> int:
        """Return the number of rays that hit a triangle."""
        return int((scene.intersects_first(origins, directions) >= 0).sum())


class TrimeshPoints(Trimesh):
    """Query of trimesh with the results of our backends: points, rays and triangles."""

    name = "trimesh, points"

    def hits(self, scene: Any, origins: Float, directions: Float) -> int:
        """Return the number of hit points."""
        points, _, _ = scene.intersects_location(origins, directions, multiple_hits=False)
        return len(points)


class Warp(Engine):
    """Warp's mesh_query_ray with prepared rays and results on the host."""

    name = "Warp CPU"
    device: ClassVar[str] = "cpu"
    # Fastest first to build is not fastest to cast: the surface area heuristic is.
    builder: ClassVar[str] = "sah"

    def missing(self) -> str:
        """Return how to install Warp, or an empty string."""
        if not importlib.util.find_spec("warp"):
            return "pip install warp-lang"
        return ""

    def prepare(self, job: Job) -> Cast:
        """Build Warp's mesh and arrays; return a function that launches a kernel per origin."""
        import warp

        from .raycast_warp import first_hits

        mesh = warp.Mesh(
            points=warp.array(job.vertices.astype(np.float32), dtype=warp.vec3, device=self.device),
            indices=warp.array(job.faces.reshape(-1), dtype=int, device=self.device),
            bvh_constructor=self.builder,
        )
        turned_directions = (job.directions @ job.rotation.T).astype(np.float32)
        directions = warp.array(turned_directions, dtype=warp.vec3, device=self.device)
        n = len(turned_directions)
        t = warp.empty(n, dtype=float, device=self.device)
        face = warp.empty(n, dtype=int, device=self.device)

        def count_hits(origin: Float) -> int:
            inputs = [mesh.id, warp.vec3(*origin.tolist()), directions, t, face]
            warp.launch(first_hits, dim=n, inputs=inputs, device=self.device)
            return int((face.numpy() >= 0).sum()) if len(t.numpy()) == n else -1

        return lambda: sum(count_hits(origin) for origin in job.origins)


class WarpCuda(Warp):
    """Warp's mesh_query_ray on a CUDA device."""

    name = "Warp CUDA"
    device = "cuda:0"

    def missing(self) -> str:
        """Return how to install Warp, or that a CUDA device is missing, or an empty string."""
        import_error = super().missing()
        if import_error:
            return import_error
        import warp

        return "" if warp.is_cuda_available() else "no CUDA device"


def _open3d_scene(job: Job, threads: int) -> Any:
    import open3d

    scene = open3d.t.geometry.RaycastingScene(nthreads=threads)
    tensor = open3d.core.Tensor
    scene.add_triangles(
        tensor(job.vertices.astype(np.float32)), tensor(job.faces.astype(np.uint32))
    )
    return scene


def _chunks(job: Job, origins: Any, chunk: int) -> list[NDArray[np.float32]]:
    """Return the rays (n, 6) of all origins, in chunks."""
    directions = job.directions @ job.rotation.T
    chunks = []
    for origin in origins:
        rays = np.empty((len(directions), 6), np.float32)
        rays[:, :3] = origin
        rays[:, 3:] = directions
        chunks += [rays[start : start + chunk] for start in range(0, len(rays), chunk)]
    return chunks


ENGINES: tuple[type[Engine], ...] = (
    Cuda, Tiles, Numpy,
    Open3D, Open3DWithNumpy, Trimesh, TrimeshPoints, Warp, WarpCuda, BruteForce,
)  # fmt: skip

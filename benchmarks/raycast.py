"""Compare the rays per second of each backend with Open3D and trimesh.

    python -m benchmarks.raycast [--large] [--scene NAME] [--mesh FILE] [--threads N]

All engines cast the same rays in one process, in turn. Rates are medians over the rounds, with the
minimum and the maximum. Ratios are medians of the ratios within each round. Use `--clock cpu` to
measure CPU time on a machine that also runs other programs.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from raybeam import Pattern, RayCaster, available_backends

from .harness import argument_parser, run_rounds, time_call, write_results
from .raycast_scenes import Float, Job, jobs

Cast = Callable[[], int]  # casts all rays of a job, and returns the number of hits

_CALLS_S = 0.15  # minimum duration of an engine's turn
_CHUNK = 1 << 17  # rays that Open3D casts at a time


def prepare_raybeam(backend: str, job: Job, threads: int) -> Cast:
    """Return a function that makes the rays of all poses, casts them, and gathers the hits."""
    caster = RayCaster(job.vertices, job.faces, backend, threads=threads)
    pattern = Pattern(job.directions)
    return lambda: sum(len(caster.scan(pattern, origin, job.rotation)) for origin in job.origins)


def prepare_open3d(job: Job, threads: int) -> Cast:
    """Return a function that casts precomputed rays without gathering the hits."""
    import open3d

    scene = open3d_scene(job.vertices, job.faces, threads)
    rays = np.concatenate([_rays(job, origin) for origin in job.origins])
    chunks = [
        open3d.core.Tensor.from_numpy(rays[start : start + _CHUNK])
        for start in range(0, len(rays), _CHUNK)
    ]
    answers = (scene.cast_rays(chunk)["t_hit"].numpy() for chunk in chunks)
    hits = sum(int(np.isfinite(answer).sum()) for answer in answers)

    def cast() -> int:
        for chunk in chunks:
            scene.cast_rays(chunk, nthreads=threads)
        return hits

    return cast


def prepare_open3d_numpy(job: Job, threads: int) -> Cast:
    """Return a function that makes rays, casts them, and gathers the hits, like a user's script."""
    import open3d

    scene = open3d_scene(job.vertices, job.faces, threads)

    def count_hits(origin: Float) -> int:
        rays = _rays(job, origin)
        answer = scene.cast_rays(open3d.core.Tensor.from_numpy(rays), nthreads=threads)
        t = answer["t_hit"].numpy()
        triangle = answer["primitive_ids"].numpy()
        hit = np.isfinite(t)
        points = origin + t[hit, None] * rays[hit, 3:]
        return len(points) if len(triangle[hit]) == len(points) else -1

    return lambda: sum(count_hits(origin) for origin in job.origins)


def prepare_trimesh(job: Job, threads: int) -> Cast:
    """Return a function that finds hit triangles with trimesh's fastest query (no distances)."""
    import trimesh
    from trimesh.ray.ray_pyembree import RayMeshIntersector

    scene = RayMeshIntersector(trimesh.Trimesh(job.vertices, job.faces, process=False))

    def count_hits(origin: Float) -> int:
        directions = job.directions @ job.rotation.T
        origins = np.tile(origin, (len(directions), 1))
        return int((scene.intersects_first(origins, directions) >= 0).sum())

    return lambda: sum(count_hits(origin) for origin in job.origins)


def open3d_scene(vertices: Float, faces: NDArray[Any], threads: int) -> Any:
    import open3d

    scene = open3d.t.geometry.RaycastingScene(nthreads=threads)
    tensor = open3d.core.Tensor
    scene.add_triangles(tensor(vertices.astype(np.float32)), tensor(faces.astype(np.uint32)))
    return scene


def _rays(job: Job, origin: Float) -> NDArray[np.float32]:
    """Return all rays (n, 6) from one origin."""
    directions = job.directions @ job.rotation.T
    origins = np.tile(origin, (len(directions), 1))
    return np.hstack([origins, directions]).astype(np.float32)


def available_engines() -> dict[str, Callable[[Job, int], Cast]]:
    """Return functions that prepare an engine for a job, keyed by engine name.

    Print which engines are not installed.
    """
    missing = dict(available_backends())
    engines: dict[str, Callable[[Job, int], Cast]] = {
        backend: partial(prepare_raybeam, backend) for backend in missing
    }
    peers = {
        "Open3D, bare": ("open3d", prepare_open3d),
        "Open3D + NumPy": ("open3d", prepare_open3d_numpy),
        "trimesh + embreex": ("embreex", prepare_trimesh),
    }
    for name, (module, prepare) in peers.items():
        engines[name] = prepare
        missing[name] = "" if find_spec(module) else f"pip install {module}"
    for name, reason in missing.items():
        if reason:
            print(f"{name} is skipped: {reason}")
    return {name: prepare for name, prepare in engines.items() if not missing[name]}


def measure(
    job: Job,
    engines: dict[str, Callable[[Job, int], Cast]],
    options: argparse.Namespace,
) -> dict[str, Any]:
    """Measure the rates of all engines for one job."""
    builds = {}
    hits = {}
    calls = {}
    for name, prepare in engines.items():
        builds[name], cast = time_call(partial(prepare, job, options.threads), options.clock)
        cast()  # compiles, and builds trees
        seconds, hits[name] = time_call(cast, options.clock)
        repeats = 1 if options.quick else max(1, int(_CALLS_S / max(seconds, 1e-6)))
        calls[name] = partial(_rate, job, cast, repeats, options.clock)
    rates = run_rounds(calls, options.repeat, warm_up=0)
    return {
        "scene": job.name,
        "triangles": len(job.faces),
        "order": job.order,
        "rays": job.rays,
        "engines": {
            name: {
                "mrays_s": rates[name],
                "hit_share": hits[name] / job.rays,
                "build_s": builds[name],
            }
            for name in engines
        },
    }


def _rate(job: Job, cast: Cast, repeats: int, clock: str, _: int) -> float:
    """Return the rate of repeated casts in Mray/s."""
    seconds, _ = time_call(lambda: [cast() for _ in range(repeats)], clock)
    return job.rays * repeats / max(seconds, 1e-9) / 1e6


def show(row: dict[str, Any]) -> None:
    """Print the rates of all engines for one job, with their ratios to the fastest peer."""
    print(f"\n{row['scene']}, {row['triangles']:,} triangles, {row['rays']:,} {row['order']} rays")
    engines = row["engines"]
    medians = {name: float(np.median(entry["mrays_s"])) for name, entry in engines.items()}
    peers = [name for name in engines if name not in available_backends()]
    best = max(peers, key=medians.__getitem__, default=None)
    for name, entry in engines.items():
        rates = entry["mrays_s"]
        line = (
            f"  {name:<18} {medians[name]:10.4g} Mray/s  ({min(rates):.4g} to {max(rates):.4g})"
            f"  hits {100 * entry['hit_share']:5.1f} %  built in {entry['build_s']:.2f} s"
        )
        if best and name not in peers:
            ratio = np.median(np.divide(rates, engines[best]["mrays_s"]))
            line += f"  {ratio:.3g} x {best}"
        print(line)


def main(arguments: list[str] | None = None) -> int:
    parser = argument_parser(__doc__, repeat=7, quick=True, clock="wall")
    parser.add_argument(
        "--large", action="store_true", help="also cast in a city of 10 million triangles (13 GB)"
    )
    add_scene_options(parser)
    parser.add_argument("--threads", type=int, default=1, help="CPU threads (default: 1)")
    options = parser.parse_args(arguments)
    if options.quick:
        options.repeat = 2
    makers = chosen_jobs(parser, options, options.large)
    engines = available_engines()
    results = []
    for make in makers:
        job = make()
        for order in (job, job.shuffled()):
            results.append(measure(order, engines, options))
            show(results[-1])
    write_results(options.json, results)
    return 0


def add_scene_options(parser: argparse.ArgumentParser) -> None:
    """Add the options from which `chosen_jobs` selects scenes."""
    parser.add_argument("--scene", action="append", help="only this scene; can be repeated")
    parser.add_argument(
        "--mesh", action="append", type=Path, default=[], help="an additional mesh file"
    )
    parser.add_argument("--rays", type=int, default=1 << 17, help="number of rays per scan")


def chosen_jobs(
    parser: argparse.ArgumentParser, options: argparse.Namespace, large: bool = False
) -> list[Callable[[], Job]]:
    """Return functions that make the jobs of the selected scenes."""
    rays = 2_000 if options.quick else options.rays
    makers = jobs(rays, options.mesh, options.quick, large)
    if unknown := {*(options.scene or ())} - {*makers}:
        parser.error(f"unknown scene {', '.join(unknown)}. The scenes are {', '.join(makers)}.")
    return [make for name, make in makers.items() if not options.scene or name in options.scene]


if __name__ == "__main__":
    raise SystemExit(main())

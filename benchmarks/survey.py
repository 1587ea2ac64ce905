"""Compare a complete survey with an expert's single-process script.

    python -m benchmarks.survey [--rays 1e8] [--pictures]

The script runs in one process: Open3D casts rays on all cores, NumPy thins and rounds the points,
and Open3D writes the PLY file. lidarpool runs as a command with `--cloud-only` on a cluster that it
starts itself. Both are complete processes, which run in turn. Their clouds are compared.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from .harness import argument_parser, median_ratio, run_rounds, write_results

RAYS_PER_TURN = 1800
LAYERS = 64
FOV_DEG = 50.0
KEEP_EVERY = 5
PRECISION_M = 0.01
TRIANGLES = 100_000
MESH = "city.glb"


def poses(count: int) -> list[tuple[float, float, float]]:
    """Return random positions in the city at the height of a car roof."""
    from lidarscenes.procedural.city import city

    lower_m, upper_m = city(TRIANGLES).bounds
    rng = np.random.default_rng(0)
    positions = lower_m[:2] + (upper_m[:2] - lower_m[:2]) * rng.uniform(0.25, 0.75, (count, 2))
    return [(round(float(x), 3), round(float(y), 3), 2.0) for x, y in positions]


def ray_directions() -> np.ndarray:
    """Return the unit directions (rays, 3) of a revolution."""
    azimuth = 2 * np.pi * np.arange(RAYS_PER_TURN) / RAYS_PER_TURN
    elevation = np.linspace(-np.radians(FOV_DEG) / 2, np.radians(FOV_DEG) / 2, LAYERS)
    a, e = np.meshgrid(azimuth, elevation, indexing="ij")
    directions = np.stack([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)], axis=-1)
    return directions.reshape(-1, 3)


def script(rays: int, folder: Path) -> None:
    """Run the survey in this process, like a plain script, and write its cloud."""
    import open3d as o3d

    from lidarpool import Scene

    scene = Scene.load(folder.parent / MESH)
    caster = o3d.t.geometry.RaycastingScene()
    caster.add_triangles(
        o3d.core.Tensor(scene.vertices.astype(np.float32)),
        o3d.core.Tensor(scene.faces.astype(np.uint32)),
    )
    directions = ray_directions()
    table = np.empty((len(directions), 6), np.float32)
    table[:, 3:] = directions
    columns: dict[str, list[np.ndarray]] = {n: [] for n in ("positions", "scan", "ring", "object")}
    for scan, pose in enumerate(poses(scan_count(rays))):
        table[:, :3] = pose
        answer = caster.cast_rays(o3d.core.Tensor(table))
        t = answer["t_hit"].numpy()
        face = answer["primitive_ids"].numpy()
        hit = np.flatnonzero(np.isfinite(t))[::KEEP_EVERY]
        points = np.asarray(pose) + directions[hit] * t[hit, None]
        columns["positions"].append(np.round(points, 2))
        columns["scan"].append(np.full(len(hit), scan, np.int32))
        columns["ring"].append((hit % LAYERS).astype(np.uint16))
        columns["object"].append(scene.face_object[face[hit]])
    cloud = o3d.t.geometry.PointCloud()
    merged = {name: np.concatenate(parts) for name, parts in columns.items()}
    cloud.point.positions = o3d.core.Tensor(merged["positions"].astype(np.float32))
    for name in ("scan", "ring", "object"):
        cloud.point[name] = o3d.core.Tensor(np.ascontiguousarray(merged[name])[:, None])
    o3d.t.io.write_point_cloud(str(folder / "cloud.ply"), cloud, write_ascii=False)


def scan_count(rays: int) -> int:
    """Return the number of scans, each of which is a whole revolution."""
    return max(1, round(rays / (RAYS_PER_TURN * LAYERS)))


def scenario(rays: int, folder: Path) -> Path:
    """Write the mesh and scenario of the same survey, and return the scenario's path."""
    from lidarscenes.procedural.city import city
    from lidarscenes.writers.scene_file import write_scene

    write_scene(folder / MESH, city(TRIANGLES))
    data = {
        "scene": {"files": [MESH]},
        "sensor": {
            "rays_per_revolution": RAYS_PER_TURN,
            "layers": LAYERS,
            "vertical_fov_deg": FOV_DEG,
            "step_deg": 360,
        },
        "poses": [list(pose) for pose in poses(scan_count(rays))],
        "steps": 1,
        "cloud": {"keep_every": KEEP_EVERY, "precision_m": PRECISION_M},
    }
    path = folder / "survey.yaml"
    path.write_text(json.dumps(data))  # which is YAML, too
    return path


def time_side(side: str, rays: int, folder: Path) -> tuple[float, float]:
    """Run one side in its own process.

    Print and return its wall time and CPU time in seconds, including child processes.
    """
    out_folder = folder / side
    out_folder.mkdir(exist_ok=True)
    python = [sys.executable, "-m"]
    run = [*python, "lidarpool", "run", str(folder / "survey.yaml"), "-q", "--out", str(out_folder)]
    command = {
        "script": [*python, "benchmarks.survey", "--script", str(out_folder), "--rays", str(rays)],
        "lidarpool": [*run, "--cloud-only"],
        "pictures": run,
    }[side]
    before = os.times()
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    after = os.times()
    wall = after.elapsed - before.elapsed
    cpu = sum(after[2:4]) - sum(before[2:4])  # of children
    print(f"{side:9} {wall:7.2f} s wall {cpu:7.2f} s CPU", flush=True)
    return wall, cpu


def main(arguments: list[str] | None = None) -> None:
    parser = argument_parser(__doc__, repeat=3)
    parser.add_argument("--rays", type=lambda text: int(float(text)), default=100_000_000)
    parser.add_argument("--pictures", action="store_true", help="also run with plots and report")
    parser.add_argument("--script", type=Path, metavar="FOLDER", help="only run the script")
    options = parser.parse_args(arguments)
    if options.script:
        script(options.rays, options.script)
        return
    sides = ["script", "lidarpool", *(["pictures"] if options.pictures else [])]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        scenario(options.rays, folder)
        calls = {side: lambda _, side=side: time_side(side, options.rays, folder) for side in sides}
        results = run_rounds(calls, options.repeat, warm_up=0)
        compare(folder)
    seconds = {side: np.transpose(times) for side, times in results.items()}  # wall, CPU
    for index, quantity in enumerate(("wall time", "CPU time")):
        ratio = median_ratio(seconds["lidarpool"][index], seconds["script"][index])
        print(
            f"{quantity}: lidarpool {ratio:.2f} x the script's (median of {options.repeat} rounds)"
        )
    if options.pictures:
        added_s = np.median(seconds["pictures"][0] - seconds["lidarpool"][0])
        print(f"plots and report: {added_s:.1f} s of additional wall time")
    write_results(options.json, results)


def compare(folder: Path) -> None:
    """Print the proportion of points on which both clouds agree, and the distances between them."""
    from lidarpool import read_cloud

    script_cloud, our_cloud = (
        read_cloud(folder / side / "cloud.ply") for side in ("script", "lidarpool")
    )
    equal_rows = len(script_cloud) == len(our_cloud) and np.logical_and.reduce(
        [script_cloud[name] == our_cloud[name] for name in ("scan", "channel", "object")]
    )
    share = float(np.mean(equal_rows))
    distances = (
        np.abs(script_cloud.positions - our_cloud.positions).max(axis=1)[equal_rows]
        if share
        else np.zeros(1)
    )
    print(
        f"{len(script_cloud):,} and {len(our_cloud):,} points; {share:.4%} of them have "
        "the same labels in the same order; "
        f"of these, half agree within {np.median(distances):.3f} m, "
        f"and 99.9 % within {np.quantile(distances, 0.999):.3f} m"
    )


if __name__ == "__main__":
    main()

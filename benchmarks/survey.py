"""A whole survey beside the script that an expert would write: time, bytes, and the same points.

The script runs in one process: Open3D casts on all cores, NumPy thins and rounds, Open3D writes
the PLY. Ours is the command with ``--cloud-only`` on a cluster that it starts itself, with all the
guarantees of a run. Both are processes of their own, measured from start to end, in turns.

Run: ``python -m benchmarks.survey [--rays 1e8] [--rounds 3] [--pictures]``
"""

from __future__ import annotations

import argparse
import json
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

RAYS_PER_TURN = 1800
LAYERS = 64
FOV_DEG = 50.0
KEEP_EVERY = 5
PRECISION_M = 0.01
TRIANGLES = 100_000
MESH = "city.glb"


def poses(count: int) -> list[tuple[float, float, float]]:
    """Return random positions in the city, at the height of a car roof."""
    from lidarscenes.procedural.city import city

    lower_m, upper_m = city(TRIANGLES).bounds
    rng = np.random.default_rng(0)
    positions = lower_m[:2] + (upper_m[:2] - lower_m[:2]) * rng.uniform(0.25, 0.75, (count, 2))
    return [(round(float(x), 3), round(float(y), 3), 2.0) for x, y in positions]


def ray_directions() -> np.ndarray:
    """Return the unit directions of a revolution, (rays, 3)."""
    azimuth = 2 * np.pi * np.arange(RAYS_PER_TURN) / RAYS_PER_TURN
    elevation = np.linspace(-np.radians(FOV_DEG) / 2, np.radians(FOV_DEG) / 2, LAYERS)
    a, e = np.meshgrid(azimuth, elevation, indexing="ij")
    directions = np.stack([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)], axis=-1)
    return directions.reshape(-1, 3)


def script(rays: int, folder: Path) -> None:
    """Run the survey in this process as a plain script would, and write its cloud."""
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
    """Return the number of scans, each a whole revolution."""
    return max(1, round(rays / (RAYS_PER_TURN * LAYERS)))


def scenario(rays: int, folder: Path) -> Path:
    """Write the mesh and scenario of the same survey, and return the path of the scenario."""
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
    """Return wall and processor seconds of the process of a side, including its children."""
    out_folder = folder / side
    out_folder.mkdir(exist_ok=True)
    python = [sys.executable, "-m"]
    command = {
        "script": [*python, "benchmarks.survey", "--script", str(out_folder), "--rays", str(rays)],
        "ours": [*python, "lidarpool", "run", str(folder / "survey.yaml"), "-q", "--cloud-only"],
        "pictures": [*python, "lidarpool", "run", str(folder / "survey.yaml"), "-q"],
    }[side]
    if side != "script":
        command += ["--out", str(out_folder)]
    usage_before = resource.getrusage(resource.RUSAGE_CHILDREN)
    began = time.perf_counter()
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    wall = time.perf_counter() - began
    usage_after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = (
        usage_after.ru_utime + usage_after.ru_stime - usage_before.ru_utime - usage_before.ru_stime
    )
    return wall, cpu


def main() -> None:
    """Run the benchmark, or the script's side alone."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rays", type=lambda text: int(float(text)), default=100_000_000)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--pictures", action="store_true", help="also with pictures and report")
    parser.add_argument("--script", type=Path, metavar="FOLDER", help="only do the script's side")
    options = parser.parse_args()
    if options.script:
        script(options.rays, options.script)
        return
    sides = ["script", "ours", *(["pictures"] if options.pictures else [])]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        scenario(options.rays, folder)
        times: dict[str, list[tuple[float, float]]] = {side: [] for side in sides}
        for _ in range(options.rounds):
            for side, side_times in times.items():
                side_times.append(time_side(side, options.rays, folder))
                wall, cpu = side_times[-1]
                print(f"{side:8} {wall:7.2f} s wall {cpu:7.2f} s processor", flush=True)
        compare(folder)
    for index, quantity in enumerate(("wall time", "processor time")):
        pairs = zip(times["ours"], times["script"], strict=True)
        ratio = statistics.median(a[index] / b[index] for a, b in pairs)
        print(f"{quantity}: ours {ratio:.2f} x the script's, median of {options.rounds}")
    if options.pictures:
        pairs = zip(times["pictures"], times["ours"], strict=True)
        pictures_s = statistics.median(a[0] - b[0] for a, b in pairs)
        print(f"pictures and report: {pictures_s:.1f} s more")


def compare(folder: Path) -> None:
    """Print the share of points that agree in both clouds, and the distances between them."""
    from lidarpool import read_cloud

    script_cloud, our_cloud = (
        read_cloud(folder / side / "cloud.ply") for side in ("script", "ours")
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
        f"{len(script_cloud):,} and {len(our_cloud):,} points, {share:.4%} of them in the "
        "same place of the order with the same labels; "
        f"half of these within {np.median(distances):.3f} m, "
        f"99.9 % within {np.quantile(distances, 0.999):.3f} m"
    )


if __name__ == "__main__":
    main()

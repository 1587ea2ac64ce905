"""Ray casters of other packages, run by benchmarks/scanner.py in another Python environment.

The process builds its tree, prints "ready", and then casts once for each line on standard input.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

Job = dict[str, Any]


def _mujoco_model(job: Job) -> tuple[Any, Any]:
    """Make a MuJoCo model of the scene, and its data."""
    import mujoco

    spec = mujoco.MjSpec()
    spec.add_mesh(
        name="scene",
        uservert=job["vertices"].astype(np.float32).ravel(),
        userface=job["faces"].astype(np.int32).ravel(),
        inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
    )
    mesh = mujoco.mjtGeom.mjGEOM_MESH
    spec.worldbody.add_geom(type=mesh, meshname="scene", contype=0, conaffinity=0)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


def mujoco_caster(job: Job) -> Callable[[], int]:
    """Return a function that casts the rays of each origin with one call of MuJoCo."""
    import mujoco

    model, data = _mujoco_model(job)
    origins = np.ascontiguousarray(job["origins"])
    beams = len(job["directions"]) // len(origins)
    rays = np.ascontiguousarray(job["directions"].reshape(len(origins), 3 * beams))
    max_range_m = float(job.get("far", 1e10))
    geom = np.empty((len(origins), beams), np.int32)
    distance = np.empty((len(origins), beams))

    def cast() -> int:
        for k in range(len(origins)):
            mujoco.mj_multiRay(
                model,
                data,
                origins[k],
                rays[k],
                None,
                True,
                -1,
                geom[k],
                distance[k],
                None,
                beams,
                max_range_m,
            )
        return int(((distance >= 0) & (distance <= max_range_m)).sum())

    return cast


def mujoco_lidar_caster(job: Job, backend: str) -> Callable[[], int]:
    """Return a function that casts the rays of each origin with one call of MuJoCo-LiDAR."""
    if backend == "cpu":
        from mujoco_lidar.core_cpu.mjlidar_cpu import MjLidarCPU as Caster
    else:
        import warp
        from mujoco_lidar.core_warp.mjlidar_warp import MjLidarWarp as Caster

        warp.config.quiet = True
        warp.set_device("cpu")
    model, data = _mujoco_model(job)
    origin_count = len(job["origins"])
    max_range_m = float(job.get("far", 1e10))
    caster = Caster(model, cutoff_dist=max_range_m)
    caster.update(data)
    poses = np.tile(np.eye(4), (origin_count, 1, 1))
    poses[:, :3, 3] = job["origins"]
    x, y, z = job["directions"].reshape(origin_count, -1, 3).transpose(2, 0, 1)
    azimuths = np.arctan2(y, x)
    elevations = np.arctan2(z, np.hypot(x, y))

    def cast() -> int:
        hits = 0
        for pose, azimuth, elevation in zip(poses, azimuths, elevations, strict=True):
            caster.trace_rays(pose, azimuth, elevation)
            distance = caster.get_distances()
            hits += int(((distance > 0) & (distance < max_range_m)).sum())
        return hits

    return cast


CASTERS = {
    "mujoco": mujoco_caster,
    "mujoco-lidar cpu": partial(mujoco_lidar_caster, backend="cpu"),
    "mujoco-lidar warp": partial(mujoco_lidar_caster, backend="warp"),
}


def main() -> None:
    """Cast once for each line on standard input, and print the time."""
    name, path, clock = sys.argv[1:]
    clock_s = {"wall": time.perf_counter, "cpu": time.process_time}[clock]
    cast = CASTERS[name](dict(np.load(path)))
    print("ready", flush=True)
    for _ in sys.stdin:
        start = clock_s()
        hits = cast()
        print(json.dumps({"seconds": clock_s() - start, "hits": hits}), flush=True)


if __name__ == "__main__":
    main()

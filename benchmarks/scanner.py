"""Compare the sweeps of a `Scanner` in a loop with ray casting alone, Open3D and MuJoCo.

    python -m benchmarks.scanner [--case NAME] [--peers PYTHON]

A VLP-16, an OS1-128, and 1,000 robots with 64 rays each scan a city on one thread. Each round uses
different poses, as in a loop:

- cast: `RayCaster.scan` of raybeam with the same precomputed rays, which returns hits;
- ranges, noise: `Scanner.ranges`, float32 range images, without and with range noise of 2 cm;
- sweep, moving: `Scanner.sweep`, a cloud with its columns, from a pose and from a trajectory;
- open3d: Open3D's RaycastingScene and NumPy, from poses to float32 images, as in a user's script.

With `--peers`, MuJoCo's `mj_multiRay` and the CPU and Warp backends of MuJoCo-LiDAR (Warp on the
CPU) run in a separate Python environment, which needs mujoco-lidar and warp-lang. They are called
once for each pose, with directions that are already rotated.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import subprocess
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarpool import Noise, Scanner, Scene, Sensor, Track, load_sensor
from lidarscenes.procedural.city import city
from raybeam import Pattern, RayCaster, available_backends

from .harness import (
    argument_parser,
    has_modules,
    median_ratio,
    run_rounds,
    time_call,
    write_results,
)
from .raycast import open3d_scene

Float = NDArray[np.float64]
CASES = ("velodyne/vlp16", "ouster/os1-128", "robots")
PEERS = ("mujoco", "mujoco-lidar cpu", "mujoco-lidar warp")
HEIGHT_M = 1.8


def sensor_of(case: str) -> Sensor:
    """Make the sensor of a case.

    A robot's sensor has 64 rays in a circle.
    """
    if case == "robots":
        return Sensor.grid(64, 1, step_deg=360, max_range_m=30)
    return load_sensor(case)


def poses_of(count: int, number: int) -> Float:
    """Return poses (count, 4, 4) on the street with random yaw angles, for one round."""
    random = np.random.default_rng(number)
    angle = random.uniform(-np.pi, np.pi, count)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 0, 0] = poses[:, 1, 1] = np.cos(angle)
    poses[:, 1, 0] = np.sin(angle)
    poses[:, 0, 1] = -poses[:, 1, 0]
    poses[:, 0, 3] = random.uniform(-20, 20, count)
    poses[:, 1, 3] = random.uniform(-2, 2, count)
    poses[:, 2, 3] = HEIGHT_M
    return poses


class LidarpoolScans:
    """Ray casting alone and scanners, all with the same rays."""

    def __init__(self, scene: Scene, sensor: Sensor, backend: str) -> None:
        self.sensor = sensor
        firings = sensor.steps_of_revolution(0)
        stop = sensor.firings(firings[-1])[1]
        self.directions = sensor.directions(np.arange(stop)).reshape(-1, 3)
        origins = sensor.origins(np.arange(stop))
        self.pattern = Pattern(
            self.directions,
            None if origins is None else origins.reshape(-1, 3),
            step=sensor.ring_step,
        )
        self.caster = RayCaster(scene.vertices, scene.faces, backend, threads=1)
        self.scanner = Scanner(scene, sensor, backend=backend, threads=1)
        noise = Noise(range_m=0.02)
        self.noisy = Scanner(scene, sensor, noise=noise, backend=backend, threads=1)

    def cast(self, poses: Float) -> int:
        """Cast the rays from poses (k, 4, 4), and return the number of hits."""
        hits = self.caster.scan(
            self.pattern,
            poses[:, :3, 3],
            poses[:, :3, :3],
            window=(0, len(self.pattern) * len(poses)),
            rays_per_pose=len(self.pattern),
            t_min=self.sensor.min_range_m,
            t_max=self.sensor.max_range_m,
        )
        return len(hits)

    def ranges(self, poses: Float) -> Any:
        """Return a range image for each pose."""
        return self.scanner.ranges(poses)

    def noise(self, poses: Float) -> Any:
        """Return range images with noise."""
        return self.noisy.ranges(poses)

    def sweep(self, poses: Float) -> int:
        """Make the cloud of a stationary sensor, and return the number of points."""
        return len(self.scanner.sweep(poses[0, :3, 3]))

    def moving(self, poses: Float) -> int:
        """Make the cloud of a sensor that moves at 20 m/s, and return the number of points."""
        positions = poses[0, :3, 3] + np.array([[0, 0, 0], [4, 0, 0]])
        return len(self.scanner.sweep(Track([0, 0.2], positions)))


class Peer:
    """Process of another Python interpreter that casts the rays of a file on request."""

    def __init__(self, name: str, python: str, job: Path, clock: str) -> None:
        script = Path(__file__).with_name("scanner_peers.py")
        # -P: the folder of the script, which has a module `mujoco` too, is not searched.
        self._process = subprocess.Popen(
            [python, "-P", str(script), name, str(job), clock],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "OMP_NUM_THREADS": "1"},
        )
        self._line()

    def _line(self) -> str:
        assert self._process.stdout is not None
        for line in self._process.stdout:  # what it prints besides is none of ours
            if line.startswith(("ready", "{")):
                return line.strip()
        raise RuntimeError(f"The peer ended with {self._process.wait()}")

    def cast(self) -> tuple[float, int]:
        """Return the time of one cast in seconds, and the number of hits."""
        assert self._process.stdin is not None
        self._process.stdin.write("cast\n")
        self._process.stdin.flush()
        answer = json.loads(self._line())
        return answer["seconds"], answer["hits"]

    def close(self) -> None:
        """End the process."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()


class Open3D:
    """Open3D scene whose rays are computed with NumPy."""

    def __init__(self, scene: Scene, scans: LidarpoolScans) -> None:
        import open3d

        self.core = open3d.core
        self.scans = scans
        self.scene = open3d_scene(scene.vertices, scene.faces, 1)
        self.rays = np.array(scans.pattern.directions, np.float32)
        origins = scans.pattern.origins
        self.origins = None if origins is None else np.array(origins, np.float32)

    def ranges(self, poses: Float) -> Any:
        """Return a range image for each pose."""
        count = len(self.rays)
        matrices = poses.astype(np.float32)
        rotations = matrices[:, :3, :3].transpose(0, 2, 1)
        rays = np.empty((len(poses), count, 6), np.float32)
        rays[..., :3] = matrices[:, None, :3, 3]
        if self.origins is not None:
            rays[..., :3] += self.origins @ rotations
        rays[..., 3:] = self.rays @ rotations
        answer = self.scene.cast_rays(self.core.Tensor.from_numpy(rays), nthreads=1)
        range_m = answer["t_hit"].numpy()
        sensor = self.scans.sensor
        range_m[(range_m < sensor.min_range_m) | (range_m > sensor.max_range_m)] = np.inf
        return range_m


def measure(case: str, scene: Scene, options: argparse.Namespace) -> dict[str, Any]:
    """Measure all methods of a case."""
    count = options.robots if case == "robots" else 1
    scans = LidarpoolScans(scene, sensor_of(case), options.backend)
    methods: dict[str, Callable[[Float], Any]] = {
        "cast": scans.cast,
        "ranges": scans.ranges,
        "noise": scans.noise,
    }
    if case != "robots":
        methods |= {"sweep": scans.sweep, "moving": scans.moving}
    if importlib.util.find_spec("open3d"):
        methods["open3d"] = Open3D(scene, scans).ranges
    rays = len(scans.pattern) * count

    def scan(method: str, number: int) -> tuple[float, float]:
        poses = poses_of(count, number)
        seconds, answer = time_call(partial(methods[method], poses), options.clock)
        hits = answer if isinstance(answer, int) else np.isfinite(answer).sum()
        return seconds, float(hits / rays)

    results = run_rounds({method: partial(scan, method) for method in methods}, options.repeat)
    for peer in PEERS if options.peers else ():
        results[peer] = _time_peer(peer, scans, scene, poses_of(count, options.repeat), options)
    return {
        "case": case,
        "backend": options.backend,
        "triangles": len(scene.faces),
        "rays": rays,
        "poses": count,
        "hits": {method: scans[-1][1] for method, scans in results.items()},
        "seconds": {method: [s for s, _ in scans] for method, scans in results.items()},
    }


def _time_peer(
    name: str, scans: LidarpoolScans, scene: Scene, poses: Float, options: argparse.Namespace
) -> list[tuple[float, float]]:
    """Return the time and the hit ratio of each cast by a peer."""
    rays = np.concatenate([scans.directions @ pose[:3, :3].T for pose in poses])
    with tempfile.TemporaryDirectory() as folder:
        job = Path(folder) / "job.npz"
        np.savez(
            job,
            vertices=scene.vertices,
            faces=scene.faces,
            origins=poses[:, :3, 3],
            directions=rays,
            far=min(scans.sensor.max_range_m, 1e10),
        )
        peer = Peer(name, options.peers, job, options.clock)
        casts = run_rounds({name: lambda _: peer.cast()}, options.repeat)[name]
        peer.close()
    return [(seconds, hits / len(rays)) for seconds, hits in casts]


def show(row: dict[str, Any]) -> None:
    """Print the times of a case."""
    print(
        f"\n{row['case']} with {row['backend']}: {row['rays']:,} rays from {row['poses']:,} poses, "
        f"{row['triangles']:,} triangles"
    )
    for method, seconds in row["seconds"].items():
        ratio = median_ratio(seconds, row["seconds"]["cast"])
        print(
            f"  {method:<17} {1e3 * np.median(seconds):9.2f} ms  {ratio:6.2f} x cast; "
            f"{100 * row['hits'][method]:.1f} % of rays hit"
        )


def main(arguments: list[str] | None = None) -> int:
    parser = argument_parser(__doc__, repeat=21, quick=True, clock="wall")
    backends = [name for name, reason in available_backends().items() if not reason]
    parser.add_argument("--case", action="append", choices=CASES, help="only this case")
    parser.add_argument("--backend", choices=backends, default=backends[0])
    parser.add_argument("--triangles", type=int, default=100_000)
    parser.add_argument("--robots", type=int, default=1000)
    parser.add_argument(
        "--peers", default="", metavar="PYTHON", help="Python interpreter with the peers"
    )
    options = parser.parse_args(arguments)
    if options.quick:
        options.triangles = 10_000
        options.robots = 20
        options.repeat = 2
    if not options.peers:
        print("mujoco-lidar is skipped, because --peers is not given")
    elif not has_modules(options.peers, "mujoco_lidar", "warp"):
        parser.error(f"{options.peers} lacks peers: pip install mujoco-lidar mujoco warp-lang")
    scene = city(options.triangles)
    results = []
    for case in options.case or CASES:
        results.append(measure(case, scene, options))
        show(results[-1])
    write_results(options.json, results)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())

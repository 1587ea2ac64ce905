"""A scan in a loop, beside the cast alone: `python -m benchmarks.scanner [--peers PYTHON]`.

A VLP-16, an OS1-128, and 1,000 robots with 64 rays each, in a city, with one thread, in shuffled
order:

- cast: `RayCaster.scan` of raybeam with the same rays, made before; it ends with hits;
- ranges, noise: `Scanner.ranges`, float32 images of ranges, and so with noise of 2 cm;
- sweep, moving: `Scanner.sweep`, a cloud with its columns, from a pose and from a trajectory;
- open3d: Open3D's RaycastingScene and NumPy, from poses to float32 images, as one would write it.

The poses of each round are others, as in a loop. MuJoCo's ``mj_multiRay`` and the CPU and Warp
backends of MuJoCo-LiDAR (Warp on the processor) stand in a Python of their own. They are called
once for each pose, with directions that were turned before.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarpool import Noise, Scanner, Scene, Sensor, Track, load_sensor
from lidarscenes.procedural.city import city
from raybeam import Pattern, RayCaster, available_backends

from .raycast import CLOCKS, environment
from .sensors import Peer

Float = NDArray[np.float64]
CASES = ("velodyne/vlp16", "ouster/os1-128", "robots")
PEERS = ("mujoco", "mujoco-lidar cpu", "mujoco-lidar warp")
BAR = 1.3  # of the time of ranges to that of the cast
HEIGHT_M = 1.8


def sensor_of(case: str) -> Sensor:
    """Make the sensor of a case; a robot's sensor has 64 rays around it."""
    if case == "robots":
        return Sensor.grid(64, 1, step_deg=360, max_range_m=30)
    return load_sensor(case)


def poses_of(count: int, number: int) -> Float:
    """Return the poses of a round, (count, 4, 4): on the street, with random yaw."""
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
    """Cast alone, and scanners, with the same rays.

    Parameters
    ----------
    scene, sensor, backend
        What is scanned, by what and how.
    """

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
        """Cast the rays from poses (k, 4, 4); return the number of hits."""
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
        """Make range images with noise."""
        return self.noisy.ranges(poses)

    def sweep(self, poses: Float) -> int:
        """Make the cloud of a pose; return its number of points."""
        return len(self.scanner.sweep(poses[0, :3, 3]))

    def moving(self, poses: Float) -> int:
        """Make the cloud of a sensor at 20 m/s; return its number of points."""
        positions = poses[0, :3, 3] + np.array([[0, 0, 0], [4, 0, 0]])
        return len(self.scanner.sweep(Track([0, 0.2], positions)))


class Open3D:
    """Open3D scene whose rays are computed with NumPy."""

    def __init__(self, scene: Scene, scans: LidarpoolScans) -> None:
        import open3d

        self.core = open3d.core
        self.scans = scans
        self.scene = open3d.t.geometry.RaycastingScene(nthreads=1)
        self.scene.add_triangles(
            self.core.Tensor(scene.vertices.astype(np.float32)),
            self.core.Tensor(scene.faces.astype(np.uint32)),
        )
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


def measure(
    case: str, backend: str, scene: Scene, robots: int, rounds: int, clock: str, python: str
) -> dict[str, Any]:
    """Time all methods of a case."""
    clock_s = CLOCKS[clock]
    count = robots if case == "robots" else 1
    scans = LidarpoolScans(scene, sensor_of(case), backend)
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
    seconds: dict[str, list[float]] = {method: [] for method in methods}
    hits: dict[str, float] = {}
    for number in range(rounds + 1):
        poses = poses_of(count, number)
        # Each finds caches and memory as the last one left them: not always the same one.
        for method in np.random.default_rng(number).permutation(list(methods)).tolist():
            start = clock_s()
            answer = methods[method](poses)
            spent = clock_s() - start
            if number:  # the first round warms up
                seconds[method].append(spent)
            hit = answer if isinstance(answer, int) else np.isfinite(answer).sum()
            hits[method] = float(hit / rays)
    if python:
        for peer in PEERS:
            answer = _time_peer(peer, python, scans, scene, poses, rounds, clock)
            seconds[peer], hits[peer] = answer
    return {
        "case": case,
        "backend": backend,
        "triangles": len(scene.faces),
        "rays": rays,
        "poses": count,
        "hits": hits,
        "seconds": seconds,
    }


def _time_peer(
    name: str,
    python: str,
    scans: LidarpoolScans,
    scene: Scene,
    poses: Float,
    rounds: int,
    clock: str,
) -> tuple[list[float], float]:
    """Time a peer with the poses of the last round; return its times and share of hits."""
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
        peer = Peer(name, python, job, clock)
        casts = [peer.cast() for _ in range(rounds + 1)][1:]
        peer.close()
    return [spent for spent, _ in casts], casts[-1][1] / len(rays)


def ratio(row: dict[str, Any], method: str, base: str = "cast") -> float:
    """Return the median over the rounds of a method's time over the time of `base`."""
    pairs = zip(row["seconds"][method], row["seconds"][base], strict=True)
    return float(np.median([max(a, 1e-9) / max(b, 1e-9) for a, b in pairs]))


def show(row: dict[str, Any]) -> None:
    """Print the execution times of a case."""
    print(
        f"\n{row['case']} by {row['backend']}: {row['rays']:,} rays from {row['poses']:,} poses, "
        f"{row['triangles']:,} triangles"
    )
    for method, seconds in row["seconds"].items():
        print(
            f"  {method:<17} {1e3 * np.median(seconds):9.2f} ms  {ratio(row, method):6.2f} x cast; "
            f"hits {100 * row['hits'][method]:.1f} % of rays"
        )
    ranges_ratio = ratio(row, "ranges")
    verdict = "kept" if ranges_ratio <= BAR else "missed"
    print(f"  the bar of {BAR} x the cast is {verdict}: {ranges_ratio:.2f}")


def main(arguments: list[str] | None = None) -> int:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--quick", action="store_true", help="toy sizes, two rounds")
    parser.add_argument("--case", action="append", choices=CASES, help="only this one")
    parser.add_argument("--backend", choices=available_backends(), help="else the first there is")
    parser.add_argument("--triangles", type=int, default=100_000)
    parser.add_argument("--robots", type=int, default=1000)
    parser.add_argument("--rounds", type=int, default=21)
    parser.add_argument("--clock", choices=CLOCKS, default="wall")
    parser.add_argument(
        "--peers", default="", metavar="PYTHON", help="that has mujoco-lidar and warp-lang"
    )
    parser.add_argument("--json", type=Path, help="write the results here")
    chosen = parser.parse_args(arguments)
    if chosen.quick:
        chosen.triangles = 10_000
        chosen.robots = 20
        chosen.rounds = 2
    if not chosen.peers:
        print("mujoco-lidar: not installed; --peers names a Python that has it")
    elif subprocess.run(
        [chosen.peers, "-c", "import mujoco_lidar, warp"], capture_output=True
    ).returncode:
        parser.error(f"{chosen.peers} lacks peers: pip install mujoco-lidar mujoco warp-lang")
    backends = {name: why for name, why in available_backends().items() if not why}
    backend = chosen.backend or next(iter(backends))
    scene = city(chosen.triangles)
    results = []
    for case in chosen.case or CASES:
        robots = chosen.robots
        rounds = chosen.rounds
        row = measure(case, backend, scene, robots, rounds, chosen.clock, chosen.peers)
        results.append(row)
        show(row)
    if chosen.json:
        report = {"environment": environment(1, chosen.clock), "cases": results}
        chosen.json.write_text(json.dumps(report, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())

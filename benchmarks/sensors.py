"""One revolution of sensor models in motion, compared with a grid of rays from a fixed pose.

    python -m benchmarks.sensors [--model NAME] [--backend NAME] [--peers PYTHON]

A VLP-16, an OS1-128 and an HDL-64E scan a city on one thread:

- grid: the same number of rays, evenly spaced over the same field of view, from a fixed pose;
- still: the sensor model, from the same pose;
- moving: the sensor on a vehicle at 20 m/s, where each beam has its own time and origin;
- turning: moving, while the vehicle turns by 30 degrees per second;
- noise, ten actors, 19 sub-rays: moving, with one addition.

Times are listed for casting alone, and for casting and making the columns of a cloud. With
`--peers`, MuJoCo's `mj_multiRay`, called once for each firing with precomputed rays, and Helios'
spinning scanner (pyhelios3d) on the same path run in a separate Python environment.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from lidarpool import Beams, Noise, Returns, Scene, Sensor, Spin, Survey, Track, load_sensor
from lidarscenes.procedural.city import city
from lidarsim.scene.actors import Actor, box
from lidarsim.simulator.points.batch_points import BatchPoints
from lidarsim.simulator.rig import Rig
from raybeam import available_backends

from .harness import (
    argument_parser,
    has_modules,
    median_ratio,
    run_rounds,
    time_call,
    write_results,
)

MODELS = ("velodyne/vlp16", "ouster/os1-128", "velodyne/hdl64e-s3")
PEERS = ("mujoco", "pyhelios3d")
LINE = ((-10.0, -1.8, 2.0), (10.0, -1.8, 2.0))  # along the street, in a second
CASES = ("grid", "still", "moving", "turning", "noise", "ten actors", "19 sub-rays")


def track(shift: tuple[float, float] = (0.0, 0.0), speed: float = 1.0) -> Track:
    """Make a level trajectory along the street, beside the carrier's; the survey is its middle."""
    start, end = np.array(LINE)
    positions = np.array([start, end]) * (speed, 1, 1) + (*shift, 0)
    return Track([-0.5, 0.5], positions, start_s=0, duration_s=0.2)


def bend(rate_deg: float = 30.0) -> Track:
    """Make the trajectory along the street of a carrier that turns to the left."""
    straight = track()
    half = np.radians(rate_deg) * np.array([-0.5, 0.5]) / 2
    quaternions = np.stack([0 * half, 0 * half, np.sin(half), np.cos(half)], axis=1)
    return replace(straight, quaternions=quaternions)


def surveys(name: str, share: float) -> dict[str, Survey]:
    """Return the surveys of a sensor model by case, without actors, which belong to the scene.

    Parameters
    ----------
    name
        Name of the sensor model.
    share
        Share of a revolution that is cast.
    """
    sensor = load_sensor(name, step_deg=360 * share)
    first, stop = sensor.firings(0)
    first_elevation, last_elevation = sensor.beams.elevation[[0, -1]]
    grid = Sensor(
        Beams(np.linspace(first_elevation, last_elevation, sensor.channels)),
        Spin(round((stop - first) / share), step_deg=360 * share),
        sensor.min_range_m,
        sensor.max_range_m,
    )
    middle = [tuple(np.mean(LINE, axis=0))]
    common: dict[str, Any] = {"steps": 1, "keep_every": 1, "columns": ["time", "range"]}
    moving = Survey(sensor, trajectory=track(), **common)
    return {
        "grid": Survey(grid, poses=middle, **common),
        "still": Survey(sensor, poses=middle, **common),
        "moving": moving,
        "turning": Survey(sensor, trajectory=bend(), **common),
        "noise": replace(moving, noise=Noise(range_m=0.01, angle_deg=0.01)),
        "ten actors": moving,
        "19 sub-rays": replace(moving, returns=Returns(subrays=19, divergence_mrad=3)),
    }


def traffic(scene: Scene) -> Scene:
    """Put ten cars into a scene: five ahead of the carrier, and five oncoming cars."""
    trajectories = [track((8.0 + 6 * k, 3.6 * (k % 2)), 1 - 1.5 * (k % 2)) for k in range(10)]
    cars = [
        Actor(box(f"car {k}", (4.5, 1.8, 1.5)), _on_ground(trajectory))
        for k, trajectory in enumerate(trajectories)
    ]
    return replace(scene, actors=tuple(cars))


def _on_ground(trajectory: Track) -> Track:
    return replace(trajectory, positions=np.asarray(trajectory.positions) * (1, 1, 0))


def make_columns(batches: list[BatchPoints]) -> int:
    """Make all columns of a cloud; return the number of points."""
    for returns in batches:
        for column in returns.survey.stored_columns:
            column.make(returns)
    return sum(len(returns) for returns in batches)


class Peer:
    """Process of a Python with a package, which casts a job of arrays on request."""

    def __init__(self, name: str, python: str, job: Path, clock: str) -> None:
        script = Path(__file__).with_name("sensors_peers.py")
        # -P: the folder of the script, which has a module `mujoco` too, is not searched.
        self._process = subprocess.Popen(
            [python, "-P", str(script), name, str(job), clock],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "OMP_NUM_THREADS": "1"},
        )
        self.version = self._line().removeprefix("ready ")

    def _line(self) -> str:
        assert self._process.stdout is not None
        for line in self._process.stdout:  # what it prints besides is none of ours
            if line.startswith(("ready ", "{")):
                return line.strip()
        raise RuntimeError(f"The peer ended with {self._process.wait()}")

    def cast(self) -> tuple[float, int]:
        """Return the time of a revolution, seconds, and the number of hits."""
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


def write_job(survey: Survey, scene: Scene, path: Path) -> None:
    """Write mesh and rays of a moving sensor, level and facing along x, for the peers."""
    sensor = survey.sensor
    firings = np.arange(*sensor.firings(0))
    times = sensor.begins_ns(firings)
    positions, _ = survey.path.poses(0, times)
    offsets = sensor.origins(firings)  # one call has one origin: the middle of the beams'
    seconds = (times[-1] - times[0]) / (len(times) - 1) * len(times) / 1e9
    np.savez(
        path,
        vertices=scene.vertices,
        faces=scene.faces,
        origins=positions if offsets is None else positions + offsets.mean(axis=1),
        directions=sensor.directions(firings).reshape(-1, 3),
        elevations=sensor.beams.elevation,
        way=survey.path.poses(0, np.array([0.0, 1e9 * seconds]))[0],
        seconds=seconds,
        turned=seconds * 10,  # turns, at 10 a second
    )


def measure(
    name: str, backend: str, scene: Scene, options: argparse.Namespace, peers: Sequence[str]
) -> dict[str, Any]:
    """Time all cases of a model on a backend, and the peers."""
    crowded = traffic(scene)
    rigs = {
        case: Rig(crowded if case == "ten actors" else scene, survey, backend, threads=1)
        for case, survey in surveys(name, 0.02 if options.quick else 1.0).items()
    }
    calls: dict[str, Callable[[int], tuple[list[float], int]]] = {
        case: partial(_time_rig, rig, options.clock) for case, rig in rigs.items()
    }
    with tempfile.TemporaryDirectory() as folder:
        job = Path(folder) / "job.npz"
        write_job(rigs["moving"].survey, scene, job)
        processes = {peer: Peer(peer, options.peers, job, options.clock) for peer in peers}
        calls |= {peer: partial(_time_peer, process) for peer, process in processes.items()}
        results = run_rounds(calls, options.repeat)
        for process in processes.values():
            process.close()
    survey = rigs["moving"].survey
    return {
        "model": name,
        "backend": backend,
        "triangles": len(scene.faces),
        "rays": survey.ray_count,
        "firings": survey.ray_count // survey.sensor.channels,
        "hits": {case: rounds[-1][1] / survey.ray_count for case, rounds in results.items()},
        "seconds": {case: [times for times, _ in rounds] for case, rounds in results.items()},
        "peers": {peer: process.version for peer, process in processes.items()},
    }


def _time_rig(rig: Rig, clock: str, _: int) -> tuple[list[float], int]:
    """Return the time of casting, of casting and making columns, and the number of points."""
    cast_s, batches = time_call(lambda: list(rig.cast(0, rig.survey.scan_count)), clock)
    columns_s, count = time_call(lambda: make_columns(batches), clock)
    return [cast_s, cast_s + columns_s], count


def _time_peer(peer: Peer, _: int) -> tuple[list[float], int]:
    seconds, count = peer.cast()
    return [seconds], count


def show(row: dict[str, Any]) -> None:
    """Print the execution times of a sensor model on a backend."""
    print(
        f"\n{row['model']} by {row['backend']}: {row['rays']:,} rays in {row['firings']:,} "
        f"firings, {row['triangles']:,} triangles"
    )
    seconds = {case: np.array(times).T for case, times in row["seconds"].items()}
    for case, times in seconds.items():
        base = "grid" if case in CASES[:4] else "moving"
        names = ("cast", "with columns")  # peers only cast
        words = [
            f"{stage} {1e3 * np.median(own):9.2f} ms {median_ratio(own, other):6.3f} x {base}"
            for stage, own, other in zip(names, times, seconds[base], strict=False)
        ]
        points = f"points {100 * row['hits'][case]:.1f} % of rays"
        print("; ".join([f"  {case:<12} {words[0]}", *words[1:], points]))


def main(arguments: list[str] | None = None) -> int:
    """Run from the command line."""
    parser = argument_parser(__doc__, repeat=9, quick=True, clock="wall")
    backends = [name for name, reason in available_backends().items() if not reason]
    parser.add_argument("--model", action="append", help="only this model; can be repeated")
    parser.add_argument("--backend", action="append", help="only this backend; can be repeated")
    parser.add_argument("--triangles", type=int, default=100_000)
    parser.add_argument("--peers", default="", metavar="PYTHON", help="Python that has the peers")
    options = parser.parse_args(arguments)
    if options.quick:
        options.repeat = 2
        options.triangles = 2_000
    if not options.peers:
        print(f"{' and '.join(PEERS)} are left out, because --peers is not given")
    elif not has_modules(options.peers, "mujoco", "pyhelios"):
        parser.error(f"{options.peers} lacks peers: pip install {' '.join(PEERS)}")
    scene = city(options.triangles)
    results = []
    peers = PEERS if options.peers else ()
    for backend in options.backend or backends:
        for name in options.model or MODELS:
            results.append(measure(name, backend, scene, options, peers))
            show(results[-1])
        peers = ()  # with the first backend only
    write_results(options.json, results)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())

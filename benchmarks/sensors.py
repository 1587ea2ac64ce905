"""What real sensors cost on the move: `python -m benchmarks.sensors [--peers PYTHON]`.

One turn of a VLP-16, an OS1-128 and an HDL-64E in a city, with one thread, in turns:

- grid: so many rays, evenly spaced over the same field of view, from one still pose;
- still: the sensor itself, from that pose;
- moving: on a carrier at 20 m/s, each beam at its own time from its own place;
- turning: so, while the carrier turns by 30 degrees a second;
- noise, actors, sub-rays: moving, and one thing more.

Times are of casting alone, and of all of stage 2: casting and making the columns of a cloud. What
stands beside it is in other people's hands, in a Python of its own: MuJoCo's ``mj_multiRay``,
called once for each firing with the rays that were made before, and Helios' spinning scanner
(pyhelios3d) on the same way with as many rays.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from lidarpool import Beams, Noise, Returns, Scene, Sensor, Spin, Survey, Track, load_sensor
from lidarscenes.procedural.city import city
from lidarsim.scene.actors import Actor, box
from lidarsim.simulator.points.batch_points import BatchPoints
from lidarsim.simulator.rig import Rig
from raybeam import available_backends

from .raycast import CLOCKS, environment

MODELS = ("velodyne/vlp16", "ouster/os1-128", "velodyne/hdl64e-s3")
PEERS = ("mujoco", "pyhelios3d")
BAR = 1.15  # of a moving sensor's time to a still grid's, without noise
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


def cast_scan(rig: Rig) -> list[BatchPoints]:
    """Cast the only scan of a survey."""
    return list(rig.cast(0, rig.survey.scan_count))


def make_columns(batches: list[BatchPoints]) -> int:
    """Make all columns of a cloud; return the number of points."""
    for returns in batches:
        for column in returns.survey.stored_columns:
            column.make(returns)
    return sum(len(returns) for returns in batches)


class Peer:
    """Process that casts on request.

    Parameters
    ----------
    name
        Of the package.
    python
        That has it.
    job
        A file of arrays, see `benchmarks/sensors_peers.py`.
    clock
        Name of the clock.
    """

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
    name: str, backend: str, scene: Scene, share: float, rounds: int, clock: str, python: str = ""
) -> dict[str, Any]:
    """Time all cases of a model on a backend, and the peers."""
    clock_s = CLOCKS[clock]
    crowded = traffic(scene)
    rigs = {
        case: Rig(crowded if case == "ten actors" else scene, survey, backend, threads=1)
        for case, survey in surveys(name, share).items()
    }
    seconds: dict[str, list[list[float]]] = {case: [] for case in rigs}  # of casting, of all
    hits: dict[str, float] = {}
    peers: dict[str, Peer] = {}
    with tempfile.TemporaryDirectory() as folder:
        if python:
            job = Path(folder) / "job.npz"
            write_job(rigs["moving"].survey, scene, job)
            peers = {peer: Peer(peer, python, job, clock) for peer in PEERS}
        for number in range(rounds + 1):
            order = [*rigs, *peers]
            shift = number % len(order)
            for case in order[shift:] + order[:shift]:
                if case in peers:
                    spent, count = peers[case].cast()
                    times = [spent]
                else:
                    times, count = _timed(rigs[case], clock_s)
                if number:  # the first round warms up
                    seconds.setdefault(case, []).append(times)
                hits[case] = count / rigs["moving"].survey.ray_count
        for peer in peers.values():
            peer.close()
    survey = rigs["moving"].survey
    return {
        "model": name,
        "backend": backend,
        "triangles": len(scene.faces),
        "rays": survey.ray_count,
        "firings": survey.ray_count // survey.sensor.channels,
        "hits": hits,
        "seconds": seconds,
        "peers": {peer: process.version for peer, process in peers.items()},
    }


def _timed(rig: Rig, clock_s: Callable[[], float]) -> tuple[list[float], int]:
    start = clock_s()
    batches = cast_scan(rig)
    cast = clock_s() - start
    count = make_columns(batches)
    return [cast, clock_s() - start], count


def ratio(row: dict[str, Any], case: str, base: str, stage: int = 0) -> float:
    """Return the median ratio of two cases' times; stage 0 is casting, 1 adds columns."""
    pairs = zip(row["seconds"][case], row["seconds"][base], strict=True)
    ratios = [max(a[min(stage, len(a) - 1)], 1e-9) / max(b[stage], 1e-9) for a, b in pairs]
    return float(np.median(ratios))


def show(row: dict[str, Any]) -> None:
    """Print the execution times of a sensor model on a backend."""
    print(
        f"\n{row['model']} by {row['backend']}: {row['rays']:,} rays in {row['firings']:,} "
        f"firings, {row['triangles']:,} triangles"
    )
    for case in row["seconds"]:
        times = np.median(np.array(row["seconds"][case]), axis=0) * 1e3
        base = "grid" if case in CASES[:4] else "moving"
        line = f"  {case:<12} {times[0]:9.2f} ms  {ratio(row, case, base):6.3f} x {base}"
        if case in CASES:
            line += f"; with columns {times[1]:9.2f} ms  {ratio(row, case, base, 1):6.3f} x"
        print(f"{line}; points {100 * row['hits'][case]:.1f} % of rays")
    moving_ratio = ratio(row, "moving", "grid")
    verdict = "kept" if moving_ratio <= BAR else "missed"
    print(f"  the bar of {BAR} x a still grid is {verdict}: {moving_ratio:.3f}")


def main(arguments: list[str] | None = None) -> int:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--quick", action="store_true", help="toy sizes, two rounds")
    parser.add_argument("--model", action="append", help="only this one; may be given again")
    parser.add_argument("--backend", action="append", help="only this one; may be given again")
    parser.add_argument("--triangles", type=int, default=100_000)
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--clock", choices=CLOCKS, default="wall")
    parser.add_argument("--peers", default="", metavar="PYTHON", help="that has the peers")
    parser.add_argument("--json", type=Path, help="write the results here")
    chosen = parser.parse_args(arguments)
    share = 1.0
    rounds = chosen.rounds
    triangles = chosen.triangles
    if chosen.quick:
        share = 0.02
        rounds = 2
        triangles = 2_000
    python = chosen.peers
    for peer in PEERS if python else ():
        module = {"pyhelios3d": "pyhelios"}.get(peer, peer)
        if subprocess.run([python, "-c", f"import {module}"], capture_output=True).returncode:
            parser.error(f"{python} has no {peer}: pip install {' '.join(PEERS)}")
    if not python:
        print(f"{' and '.join(PEERS)}: not installed; --peers names a Python that has them")
    backends = {name: why for name, why in available_backends().items() if not why}
    for name, why in available_backends().items():
        if why:
            print(f"{name} is left out: {why}")
    scene = city(triangles)
    results = []
    for backend in chosen.backend or backends:
        for name in chosen.model or MODELS:
            results.append(measure(name, backend, scene, share, rounds, chosen.clock, python))
            show(results[-1])
            python = python if backend == (chosen.backend or list(backends))[0] else ""
    if chosen.json:
        report = {"environment": environment(1, chosen.clock), "models": results}
        chosen.json.write_text(json.dumps(report, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""Measure which costs of twin reconstruction grow with the length of the drive.

    python -m benchmarks.long_drives [--periods 1 2 4 8]

The street and the oncoming cars repeat every 48 m. One period of a drive at 10 m/s is simulated,
and its sweeps are repeated with shifted poses, so that recordings of any length are consistent. The
recording is then reconstructed on a local cluster. The driver and the scheduler run in the measured
process, and the workers in separate processes.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import threading
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import trimesh
from tests.simulated_drives import simulated_drive

from lidarfiles.recordings.opening import open_recording
from lidarfiles.work.work import FOLDER
from lidarpool import Actor, Mounted, Pose, Scene, Survey, Track, load_sensor, twin
from lidarscenes.procedural.cars import MODELS, car
from lidarsim.columns.sweep import Sweep
from lidarsim.scene.scene_mesh import SceneMesh

from .harness import argument_parser, write_results

_PERIOD_SWEEPS = 48
_STEP_M = 1.0  # between sweeps, which are 0.1 s apart
_SWEEP_S = 0.1
_PERIOD_M = _PERIOD_SWEEPS * _STEP_M
_PERIODS_AROUND = 3  # street periods before and after the simulated period
_CAR_M_S = -6.0
_CAR_START_M = 40.0
_HEIGHT_M = 1.9
_HEADER = """VERSION 0.7
FIELDS x y z intensity ring time
SIZE 4 4 4 4 2 4
TYPE F F F F U F
COUNT 1 1 1 1 1 1
WIDTH {0}
HEIGHT 1
VIEWPOINT 0 0 0 1 0 0 0
POINTS {0}
DATA binary
"""


def street() -> trimesh.Trimesh:
    """Return a street with houses, gaps between them, parked cars as boxes, and poles."""
    random = np.random.default_rng(3)
    length_m = (2 * _PERIODS_AROUND + 1) * _PERIOD_M
    ground = _box((length_m, 40, 0.2), (_PERIOD_M / 2, 0, -0.1))
    parts = [ground]
    blocks = []
    for side in (-1, 1):
        for start_m in np.arange(0, _PERIOD_M, 12):
            size = (random.uniform(7, 10), 6, random.uniform(4, 12))
            blocks.append((size, (start_m + 6, side * (11 + random.uniform(0, 1)), size[2] / 2)))
            parked = (random.uniform(3, 5), 1.8, 1.5)
            blocks.append((parked, (start_m + random.uniform(2, 9), 6.0 * side, 0.75)))
            blocks.append(((0.2, 0.2, 5), (start_m + 1, 7.5 * side, 2.5)))
    for period in range(-_PERIODS_AROUND, _PERIODS_AROUND + 1):
        for size, (x, y, z) in blocks:
            parts.append(_box(size, (x + period * _PERIOD_M, y, z)))
    return trimesh.util.concatenate(parts)


def _box(size: Sequence[float], center: Sequence[float]) -> trimesh.Trimesh:
    box = trimesh.creation.box(size)
    box.apply_translation(center)
    return box


def simulate_period(model: str, columns: int) -> list[Sweep]:
    """Simulate the sweeps of one period, with an oncoming car in this period and its neighbors."""
    end_s = _SWEEP_S * (_PERIOD_SWEEPS + 1)
    times_s = np.array([0.0, end_s])
    oncoming = np.tile([0.0, 0.0, 1.0, 0.0], (2, 1))
    actors = []
    for period in range(-1, 3):
        start_m = _CAR_START_M + period * _PERIOD_M
        # A period later, the next car is where this one was, relative to the sensor.
        x_m = start_m + (_CAR_M_S * (times_s - period * _SWEEP_S * _PERIOD_SWEEPS))
        positions = np.stack([x_m, np.full(2, 3.0), np.zeros(2)], axis=1)
        actors.append(Actor(car(MODELS[0]), Track(times_s, positions, oncoming)))
    sensor = load_sensor(model, columns=columns)
    survey = Survey(
        sensors=[Mounted(sensor, Pose((0, 0, _HEIGHT_M)), "lidar")],
        trajectory=Track([0, end_s], [[0, 0, 0], [_STEP_M * (_PERIOD_SWEEPS + 1), 0, 0]]),
        steps=36 * _PERIOD_SWEEPS,
        columns=["time", "intensity", "ray", "range"],
        precision_m=1e-3,
    )
    mesh = street()
    scene = Scene.from_meshes([SceneMesh("street", mesh.vertices, mesh.faces)])
    recording = open_recording(
        simulated_drive(scene.with_actors(actors), survey), None, None, name="period"
    )
    return [recording.load(number) for number in range(_PERIOD_SWEEPS)]


def write_drive(folder: Path, sweeps: Sequence[Sweep], period_count: int) -> Path:
    """Write a folder of PCD files in which the sweeps repeat, and return its trajectory file."""
    recording = folder / "drive"
    recording.mkdir(parents=True)
    rows = []
    fields = [(name, "<f4") for name in ("x", "y", "z", "intensity")]
    for number in range(period_count * len(sweeps)):
        file = recording / f"{number:06d}.pcd"
        rows.append(f"{_SWEEP_S * number:.3f} {_STEP_M * number:.6f} 0 {_HEIGHT_M} 0 0 0 1")
        if number >= len(sweeps):
            file.symlink_to(f"{number % len(sweeps):06d}.pcd")
            continue
        sweep = sweeps[number]
        points = np.zeros(len(sweep), [*fields, ("ring", "<u2"), ("time", "<f4")])
        for name, values in zip("xyz", sweep.points.T, strict=True):
            points[name] = values
        points["intensity"] = sweep.intensity
        points["ring"] = sweep.columns["channel"]
        points["time"] = 1e-9 * sweep.columns["time"]
        file.write_bytes(_HEADER.format(len(sweep)).encode() + points.tobytes())
    trajectory = folder / "poses.txt"
    trajectory.write_text("\n".join(rows) + "\n")
    return trajectory


def reconstruct(folder: Path) -> dict[str, Any]:
    """Reconstruct a drive in this process and its workers, and return the cost."""
    out = folder / "twin"
    largest = [0]
    ended = threading.Event()

    def watch() -> None:
        while not ended.wait(1.0):
            sizes = [file.stat().st_size for file in out.glob(f"{FOLDER}/**/*") if file.is_file()]
            largest[0] = max(largest[0], sum(sizes))

    watching = threading.Thread(target=watch)
    watching.start()
    try:
        built = twin(folder / "drive", trajectory=folder / "poses.txt", out=out)
    finally:
        ended.set()
        watching.join()
    own = resource.getrusage(resource.RUSAGE_SELF)
    return {
        "surfels": len(built.scene.faces) // 2,
        "actors": len(built.actors),
        "driver_cpu_s": own.ru_utime + own.ru_stime,
        "driver_peak_mb": own.ru_maxrss / 1024,
        "steps_mb": largest[0] / 1e6,
    }


def main(arguments: list[str] | None = None) -> list[dict[str, Any]]:
    """Measure drives of several lengths. Print and return one row per drive."""
    parser = argument_parser(__doc__)
    parser.add_argument("--periods", type=int, nargs="+", default=[3, 6, 12, 24])
    parser.add_argument("--sensor", default="ouster/os1-32")
    parser.add_argument("--columns", type=int, default=512)
    parser.add_argument("--folder", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.folder is not None:
        print(json.dumps(reconstruct(options.folder)))
        return []
    sweeps = simulate_period(options.sensor, options.columns)
    rows = []
    names = ("surfels", "actors", "driver_cpu_s", "driver_peak_mb", "steps_mb")
    print(f"| sweeps | {' | '.join(names)} |", flush=True)
    for period_count in options.periods:
        with TemporaryDirectory(prefix="lidarpool-") as name:
            write_drive(Path(name), sweeps, period_count)
            command = [sys.executable, "-m", "benchmarks.long_drives", "--folder", name]
            output = subprocess.run(command, check=True, capture_output=True, text=True).stdout
        row = {"sweeps": period_count * len(sweeps), **json.loads(output.splitlines()[-1])}
        print(
            f"| {row['sweeps']:,} | {' | '.join(f'{row[name]:,.0f}' for name in names)} |",
            flush=True,
        )
        rows.append(row)
    write_results(options.json, rows)
    return rows


if __name__ == "__main__":
    main()

"""Compare moving sensor models with a grid of rays that is cast from a fixed pose.

    python -m benchmarks.sensors [--model NAME] [--backend NAME]

A VLP-16, an OS1-128 and an HDL-64E scan a city on one thread:

- grid: the same number of rays, evenly spaced over the same field of view, from a fixed pose;
- still: the sensor model, from the same pose;
- moving: the sensor on a vehicle at 20 m/s, where each beam has its own time and origin;
- turning: moving, while the vehicle turns by 30 degrees per second;
- noise, ten actors, 19 sub-rays: moving, with one addition.

Times are listed for casting alone, and for casting and making the columns of a cloud.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from functools import partial
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
    median_ratio,
    run_rounds,
    time_call,
    write_results,
)

MODELS = ("velodyne/vlp16", "ouster/os1-128", "velodyne/hdl64e-s3")
STAGES = ("cast", "with columns")
LINE = ((-10.0, -1.8, 2.0), (10.0, -1.8, 2.0))  # along the street, in a second
CASES = ("grid", "still", "moving", "turning", "noise", "ten actors", "19 sub-rays")


def track(shift: tuple[float, float] = (0.0, 0.0), speed: float = 1.0) -> Track:
    """Make a level trajectory along the street, next to that of the carrier."""
    start, end = np.array(LINE)
    positions = np.array([start, end]) * (speed, 1, 1) + (*shift, 0)
    return Track([-0.5, 0.5], positions, start_s=0, duration_s=0.2)


def bend(rate_deg: float = 30.0) -> Track:
    """Make the trajectory of a carrier that drives along the street and turns left."""
    straight = track()
    half = np.radians(rate_deg) * np.array([-0.5, 0.5]) / 2
    quaternions = np.stack([0 * half, 0 * half, np.sin(half), np.cos(half)], axis=1)
    return replace(straight, quaternions=quaternions)


def surveys(name: str, share: float) -> dict[str, Survey]:
    """Return the surveys of a sensor model, keyed by case.

    Actors are part of the scene instead.

    Parameters
    ----------
    name
        Name of the sensor model.
    share
        Fraction of a revolution that is cast.
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
    """Add ten cars to a scene: five ahead of the carrier, and five oncoming ones."""
    trajectories = [track((8.0 + 6 * k, 3.6 * (k % 2)), 1 - 1.5 * (k % 2)) for k in range(10)]
    cars = [
        Actor(box(f"car {k}", (4.5, 1.8, 1.5)), _on_ground(trajectory))
        for k, trajectory in enumerate(trajectories)
    ]
    return replace(scene, actors=tuple(cars))


def _on_ground(trajectory: Track) -> Track:
    return replace(trajectory, positions=np.asarray(trajectory.positions) * (1, 1, 0))


def make_columns(batches: list[BatchPoints]) -> int:
    """Make all columns of a cloud, and return the number of points."""
    for returns in batches:
        for column in returns.survey.stored_columns:
            column.make(returns)
    return sum(len(returns) for returns in batches)


def measure(name: str, backend: str, scene: Scene, options: argparse.Namespace) -> dict[str, Any]:
    """Measure all cases of a sensor model on a backend."""
    crowded = traffic(scene)
    rigs = {
        case: Rig(crowded if case == "ten actors" else scene, survey, backend, threads=1)
        for case, survey in surveys(name, 0.02 if options.quick else 1.0).items()
    }
    calls = {case: partial(_time_rig, rig, options.clock) for case, rig in rigs.items()}
    results = run_rounds(calls, options.repeat)
    survey = rigs["moving"].survey
    return {
        "model": name,
        "backend": backend,
        "triangles": len(scene.faces),
        "rays": survey.ray_count,
        "firings": survey.ray_count // survey.sensor.channels,
        "hits": {case: rounds[-1][1] / survey.ray_count for case, rounds in results.items()},
        "seconds": {case: [times for times, _ in rounds] for case, rounds in results.items()},
    }


def _time_rig(rig: Rig, clock: str, _: int) -> tuple[list[float], int]:
    """Return the times for casting without and with making columns, and the number of points."""
    cast_s, batches = time_call(lambda: list(rig.cast(0, rig.survey.scan_count)), clock)
    columns_s, count = time_call(lambda: make_columns(batches), clock)
    return [cast_s, cast_s + columns_s], count


def show(row: dict[str, Any]) -> None:
    """Print the times of a sensor model on a backend."""
    print(
        f"\n{row['model']} with {row['backend']}: {row['rays']:,} rays in {row['firings']:,} "
        f"firings, {row['triangles']:,} triangles"
    )
    seconds = {case: np.array(times).T for case, times in row["seconds"].items()}
    for case, times in seconds.items():
        base = "grid" if case in CASES[:4] else "moving"
        words = [
            f"{stage} {1e3 * np.median(own):9.2f} ms {median_ratio(own, other):6.3f} x {base}"
            for stage, own, other in zip(STAGES, times, seconds[base], strict=True)
        ]
        points = f"{100 * row['hits'][case]:.1f} % of rays give points"
        print("; ".join([f"  {case:<12} {words[0]}", *words[1:], points]))


def main(arguments: list[str] | None = None) -> int:
    parser = argument_parser(__doc__, repeat=9, quick=True, clock="wall")
    backends = [name for name, reason in available_backends().items() if not reason]
    parser.add_argument("--model", action="append", help="only this model; can be repeated")
    parser.add_argument("--backend", action="append", help="only this backend; can be repeated")
    parser.add_argument("--triangles", type=int, default=100_000)
    options = parser.parse_args(arguments)
    if options.quick:
        options.repeat = 2
        options.triangles = 2_000
    scene = city(options.triangles)
    results = []
    for backend in options.backend or backends:
        for name in options.model or MODELS:
            results.append(measure(name, backend, scene, options))
            show(results[-1])
    write_results(options.json, results)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())

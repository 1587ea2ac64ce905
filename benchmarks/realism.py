"""Measure the time of one sweep with actors, sub-rays, weather and noise.

    python -m benchmarks.realism [--rows NAME ...] [--sensor MODEL]

Each time is compared with that of the `bare` sweep, which has none of these. The sensor is an
OS1-64 in a city of 100,000 triangles, simulated on one thread. Rows add moving cars (boxes or
meshes of 1,000 triangles), 20 rigid or walking people of 2,320 triangles, a moving sensor,
sub-rays, noise, systematic errors, lost returns, saturation, rain, fog, snow, ghosts, wet ground or
spray. `real` combines cars, sub-rays, noise and rain, and `all` combines everything. `whole survey`
and `faults` are revolutions of a survey. Values are medians of CPU times.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from lidarpool import (
    Actor,
    Fault,
    Material,
    Noise,
    Returns,
    Scanner,
    Scene,
    Survey,
    Track,
    load_sensor,
)
from lidarscenes.procedural.city import city
from lidarsim.scene.actors import box, join_meshes
from lidarsim.scene.files.meshfile import load_objects
from lidarsim.scene.scene_mesh import SceneMesh
from lidarsim.simulator.points.batch_columns import columns_of
from lidarsim.simulator.rig import Rig
from raybeam import available_backends

from .harness import argument_parser, run_rounds, time_call, write_results

POSITION = (0.0, 0.0, 1.9)
SPEED_M_S = 20.0
REVOLUTION_S = 0.1
FIELD_M = (5.0, 60.0)
COLUMNS = ("time", "range", "intensity", "class", "sensor")
COUNTS = (10, 100, 300)
SURVEY: dict[str, Any] = {"poses": [POSITION], "steps": 5 * 36, "columns": COLUMNS}
FAULTS = (
    Fault("dirt", azimuth_deg=(-20, 20), transmission=0.3),
    Fault("dead_channels", channels=[3]),
    Fault("dropped_packets", share=0.05, packet=16),
    Fault("frozen", 0.35),
    Fault("time_jump", 0.2, by_s=0.05),
)
PERSON = Path(__file__).parents[1] / "examples" / "pedestrian.glb"
PEOPLE_M = (4.0, 30.0)


def fine_box(triangles: int) -> SceneMesh:
    """Make a car-sized box with at least `triangles` triangles."""
    mesh = box("Car", (4.5, 1.8, 1.5))
    vertices = mesh.vertices
    faces = mesh.faces
    while len(faces) < triangles:  # each in four
        corners = vertices[faces]
        middles = (corners + np.roll(corners, -1, axis=1)) / 2
        a, b, c = corners.transpose(1, 0, 2)
        p, q, r = middles.transpose(1, 0, 2)
        corners = np.stack([a, p, r, p, b, q, r, q, c, p, q, r], axis=1).reshape(-1, 3)
        vertices = corners
        faces = np.arange(len(corners)).reshape(-1, 3)
    return SceneMesh("Car", vertices, faces)


def cars(count: int, mesh: SceneMesh, seed: int) -> list[Actor]:
    """Make cars around the sensor that drive at 10 m/s and change direction at random."""
    random = np.random.default_rng(seed)
    angle, heading = random.uniform(0, 2 * np.pi, (2, count))
    radius = random.uniform(*FIELD_M, count)
    yaw_changes = random.uniform(-0.5, 0.5, count)
    actors = []
    for k in range(count):
        begin = radius[k] * np.array([np.cos(angle[k]), np.sin(angle[k]), 0])
        ahead = 10 * np.array([np.cos(heading[k]), np.sin(heading[k]), 0])
        yaw = heading[k] + yaw_changes[k] * np.array([0, 1, 1])
        quaternions = np.stack([0 * yaw, 0 * yaw, np.sin(yaw / 2), np.cos(yaw / 2)], axis=1)
        actors.append(
            Actor(mesh, Track([0, 1, 10], [begin, begin + ahead, begin + 10 * ahead], quaternions))
        )
    return actors


def people(count: int, seed: int, *, walking: bool) -> list[Actor]:
    """Make people around the sensor that walk at 1.4 m/s in different phases."""
    mesh = join_meshes("Person", load_objects(PERSON, animation="Walk").static)
    assert mesh.animation is not None
    mesh = replace(mesh, animation=replace(mesh.animation, speed_m_s=1.4) if walking else None)
    random = np.random.default_rng(seed)
    angle, heading = random.uniform(0, 2 * np.pi, (2, count))
    begin = random.uniform(*PEOPLE_M, count) * [np.cos(angle), np.sin(angle), 0 * angle]
    ahead = 1.4 * np.array([np.cos(heading), np.sin(heading), 0 * heading])
    offsets = random.uniform(0, 1, count).tolist()
    trajectories = [Track([0, 1], [a, a + b]) for a, b in zip(begin.T, ahead.T, strict=True)]
    return [
        Actor(mesh, trajectory, offset)
        for trajectory, offset in zip(trajectories, offsets, strict=True)
    ]


def cases(scene: Scene, backend: str, counts: tuple[int, ...], sensor: str) -> dict[str, Any]:
    """Make a function for each row.

    Each function takes the number of the round and returns a sweep.
    """
    lidar = load_sensor(sensor)
    weather = {"rain": {"rain_mm_h": 10.0}, "snow": {"snow_mm_h": 2.0}}
    weather["fog"] = {"visibility_km": 0.2, "fog_lidar_ratio_sr": 20.0}
    plain = box("Car", (4.5, 1.8, 1.5))
    fine = fine_box(1_000)
    drive = Track([0, 1], [POSITION, (POSITION[0] + SPEED_M_S, *POSITION[1:])])

    def case(actors: list[Actor], sensor_poses: Any = POSITION, **options: Any) -> Any:
        scanner = Scanner(
            scene.with_actors(tuple(actors)),
            lidar,
            columns=COLUMNS,
            backend=backend,
            threads=1,
            **options,
        )
        return lambda number: scanner.sweep(sensor_poses, number=number)

    rows = {"bare": case([])}
    for count in counts:
        rows[f"{count} boxes"] = case(cars(count, plain, count))
        rows[f"{count} meshes"] = case(cars(count, fine, count))
    rows["20 people, rigid"] = case(people(20, 20, walking=False))
    rows["20 people, walking"] = case(people(20, 20, walking=True))
    middle_count = counts[len(counts) // 2]
    rows[f"{middle_count} boxes, moving"] = case(cars(middle_count, plain, middle_count), drive)
    for subrays, mode in ((7, "strongest"), (19, "all")):
        beam = Returns(subrays=subrays, divergence_mrad=3, mode=mode)
        rows[f"{subrays} sub-rays"] = case([], returns=beam)
    rows["noise"] = case([], noise=Noise(range_m=0.02))
    lasting = Noise(channel_bias_m=0.01, warm_up_m=0.02, ripple_deg=0.02)
    rows["errors that last"] = case([], noise=lasting)
    for name, faults in (("whole survey", ()), ("faults", FAULTS)):
        rows[name] = revolution_caster(scene, Survey(lidar, faults=faults, **SURVEY), backend)
    noise = Noise(detection_range_m=90)  # without which no weather returns light
    rows["detection"] = case([], noise=noise)
    rows["saturation"] = case([], noise=Noise(detection_range_m=90, saturation=100))
    rows |= {name: case([], noise=noise, **options) for name, options in weather.items()}
    wet = {"noise": noise, "wet": 1.0}
    paint = [Material("car-*", 0.5, specular_reflectance=0.04), Material("*", 0.5)]
    rows |= {"ghosts": case([], noise=noise, materials=paint), "wet": case([], **wet)}
    rows[f"{middle_count} boxes, wet"] = case(cars(middle_count, plain, middle_count), **wet)
    rows[f"{middle_count} boxes, spray"] = case(
        cars(middle_count, plain, middle_count), **wet, spray_g_m3=5.0
    )
    beam = Returns(subrays=7, divergence_mrad=3)
    real = {"noise": Noise(detection_range_m=90, range_m=0.02), "returns": beam}
    rows["real"] = case(cars(middle_count, plain, middle_count), **real, **weather["rain"])
    together = {name: value for options in weather.values() for name, value in options.items()}
    rows["all"] = case(
        cars(middle_count, fine, middle_count),
        drive,
        **real,
        **together,
    )
    return rows


def revolution_caster(scene: Scene, survey: Survey, backend: str) -> Any:
    """Return a function that casts one of five revolutions of a survey and makes its columns."""
    rig = Rig(scene, survey, backend, threads=1)
    scans = survey.scan_count // 5

    def cast_revolution(number: int) -> range:
        part = columns_of([*rig.cast(number * scans, (number + 1) * scans)])
        return range(int(part.counts.sum()))  # as long as its points

    return cast_revolution


def measure(rows: dict[str, Any], repeat: int) -> dict[str, dict[str, float]]:
    """Measure the times of all rows."""

    def sweep(row: str, number: int) -> tuple[float, int]:
        seconds, points = time_call(lambda: rows[row](number % 5))
        return seconds, len(points)

    sweeps = run_rounds({row: partial(sweep, row) for row in rows}, repeat)
    medians = {row: float(np.median([s for s, _ in sweeps[row]])) for row in rows}
    return {
        row: {
            "ms": 1e3 * seconds,
            "times": seconds / medians["bare"],
            "points": sweeps[row][-1][1],
        }
        for row, seconds in medians.items()
    }


def main(arguments: list[str] | None = None) -> dict[str, dict[str, float]]:
    """Print and return the time of each row."""
    parser = argument_parser(__doc__, repeat=9)
    parser.add_argument("--triangles", type=int, default=100_000)
    parser.add_argument("--cars", type=int, nargs="+", default=COUNTS)
    parser.add_argument("--sensor", default="ouster/os1-64")
    parser.add_argument("--rows", nargs="*", help="rows to measure, in addition to `bare`")
    options = parser.parse_args(arguments)
    backend = next(name for name in ("tiles", "numpy") if not available_backends()[name])
    rows = cases(city(options.triangles), backend, tuple(options.cars), options.sensor)
    if options.rows is not None:
        rows = {row: rows[row] for row in ["bare", *options.rows]}
    results = measure(rows, options.repeat)
    for row, values in results.items():
        print(
            f"{row:20} {values['ms']:8.2f} ms {values['times']:6.2f} x bare "
            f"{values['points']:10,} points"
        )
    write_results(options.json, results)
    return results


if __name__ == "__main__":
    main()

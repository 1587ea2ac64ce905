"""Measure how often the confidence intervals of `lidarpool fit` contain the true values.

    python -m benchmarks.fit_coverage [--trials 200]
    python -m benchmarks.fit_coverage --places [--trials 40] [--cache FOLDER]

With `--places`, the sensor stands in a room, a street of a city, a hall and a forest in turn.
"""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np

from lidarfiles.clouds.recording import Recording, RecordingInfo, SweepsInMemory
from lidarpool import LidarError, Noise, Scanner, Scene, Sensor
from lidarreal.comparing.fit.fitting import fit
from lidarscenes.procedural.city import city
from lidarscenes.procedural.plants import all_trees, place_instances
from lidarsim.columns.sweep import Sweep
from lidarsim.scene.scene_mesh import SceneMesh

from .harness import argument_parser, print_row, write_results

SWEEPS = 12
COLUMNS = 360
LAYERS = 16
FARTHEST_M = 120.0
PLACES = ("room", "street", "hall", "forest")


def street() -> Scene:
    """Make a scene with the ground, two side walls and an end wall."""
    corners = {
        "ground": [(-80, -60, -1.7), (80, -60, -1.7), (80, 60, -1.7), (-80, 60, -1.7)],
        "left": [(-80, 4, -1.7), (80, 4, -1.7), (80, 4, 6), (-80, 4, 6)],
        "right": [(-80, -9, -1.7), (80, -9, -1.7), (80, -9, 3), (-80, -9, 3)],
        "end": [(30, -9, -1.7), (30, 4, -1.7), (30, 4, 3), (30, -9, 3)],
    }
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    return Scene.from_meshes(
        SceneMesh(name, np.array(corners_of_wall), faces)
        for name, corners_of_wall in corners.items()
    )


def box(name: str, lower_m: Any, upper_m: Any) -> SceneMesh:
    """Create a box between two corners, given in meters."""
    x, y, z = np.transpose([lower_m, upper_m]).astype(float)
    corners = np.array([(a, b, c) for a in x for b in y for c in z])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [face for a, b, c, d in quads for face in ((a, b, c), (a, c, d))]
    return SceneMesh(name, corners, np.array(faces))


def place(name: str, seed: int) -> tuple[Scene, tuple[float, float, float]]:
    """Make a scene of `PLACES`, and return it with the sensor position in meters."""
    rng = np.random.default_rng(seed)
    if name == "street":
        return city(30_000, seed=seed), (0.0, 0.0, 1.8)
    if name == "forest":
        return forest(rng), (0, 0, 1.6)
    if name == "room":
        size = (rng.uniform(5, 9), rng.uniform(4, 7), rng.uniform(2.4, 3.2))
        return furnished_box(rng, size, 8, (0.8, 0.8, 1.2)), (0.0, 0.0, 1.1)
    size = (rng.uniform(30, 60), rng.uniform(18, 35), rng.uniform(7, 10))
    return furnished_box(rng, size, 24, (2.5, 2.5, 5.0)), (0.0, 0.0, 1.1)


def forest(rng: np.random.Generator) -> Scene:
    """Make trees on flat ground, except within 2.5 m of the origin."""
    ground = box("ground", (-80, -80, -1), (80, 80, 0))
    count = 120
    positions = np.column_stack([rng.uniform(-40, 40, (count, 2)), np.zeros(count)])
    positions = positions[np.hypot(*positions[:, :2].T) > 2.5]
    trees = all_trees(0, 0.2)
    species = rng.integers(0, len(trees), len(positions))
    yaw = rng.uniform(0, 2 * np.pi, len(positions))
    scale = rng.uniform(0.6, 1.2, len(positions))
    instances = place_instances(trees, species, positions, yaw, scale)
    return Scene.from_meshes([ground, *instances])


def furnished_box(
    rng: np.random.Generator,
    size: tuple[float, float, float],
    count: int,
    max_size: tuple[float, float, float],
) -> Scene:
    """Make a closed room that contains `count` boxes of up to `max_size`, in meters."""
    x, y, z = size
    meshes = [box("shell", (-x / 2, -y / 2, 0), (x / 2, y / 2, z))]
    for number in range(count):
        a, b = rng.uniform(-0.45, 0.45, 2) * (x, y)
        w, d, h = rng.uniform(0.15, 1, 3) * max_size
        if np.hypot(a, b) > 1.0 + max_size[0]:
            meshes.append(box(f"thing-{number}", (a, b, 0), (a + w, b + d, h)))
    return Scene.from_meshes(meshes)


def recorded(
    noise: Noise,
    bias: Any = 0.0,
    sweeps: int = SWEEPS,
    scene: Scene | None = None,
    position: tuple[float, float, float] = (0, 0, 0),
    columns: int = COLUMNS,
    cache: Path | None = None,
) -> Recording:
    """Record sweeps of a stationary sensor with a range error for each channel, in meters."""
    if cache is None or not cache.exists():
        sensor = Sensor.grid(columns, LAYERS, vertical_fov_deg=40, max_range_m=FARTHEST_M)
        scanner = Scanner(
            scene or street(),
            sensor,
            columns=["intensity"],
            noise=noise,
            precision_m=1e-4,
            coordinates="sensor",
            threads=1,
        )
        clouds = [scanner.sweep(position, number=number) for number in range(sweeps)]
        arrays = {
            f"{name}{number}": values
            for number, cloud in enumerate(clouds)
            for name, values in (
                ("points", cloud.positions),
                ("channel", cloud["channel"]),
                ("intensity", cloud["intensity"]),
            )
        }
        if cache is not None:
            np.savez(cache, **arrays)
    else:
        arrays = dict(np.load(cache))

    def read(number: int) -> Sweep:
        points = arrays[f"points{number}"]
        channel = arrays[f"channel{number}"]
        ranges = np.linalg.norm(points, axis=1)
        errors = np.broadcast_to(bias, LAYERS)[channel]
        columns = {"channel": channel, "intensity": arrays[f"intensity{number}"]}
        return Sweep(points * (1 + errors / np.maximum(ranges, 1e-6))[:, None], columns)

    info = RecordingInfo("simulated", energy_unit=1.0)
    return SweepsInMemory(info, [read(number) for number in range(sweeps)])


def trial(
    number: int, cache: Path | None = None, place_name: str = ""
) -> tuple[dict[str, float], Any]:
    """Fit a recording and return the true and the fitted parameters, keyed by name.

    Half of the sensors have range-dependent noise and channel errors. The others have
    energy-dependent noise, a threshold and false alarms. With `place_name`, an entry of `PLACES`,
    the second result is an error message if the fit fails.
    """
    rng = np.random.default_rng(number)
    truth = {
        "range_m": rng.uniform(0.01, 0.03),
        "angle_deg": rng.uniform(0.04, 0.12),
        "dropout": rng.uniform(0.005, 0.03),
    }
    bias: Any = 0.0
    if number // len(PLACES) % 2 if place_name else number % 2:
        truth["range_per_m"] = rng.uniform(0.0003, 0.001)
        noise = Noise(**truth, seed=number)
        bias = rng.normal(0, 0.005, LAYERS)
        bias -= bias.mean()
    else:
        truth["range_at_threshold_m"] = rng.uniform(0.04, 0.1)
        truth["detection_range_m"] = rng.uniform(8, 13)
        share = rng.uniform(0.001, 0.005)
        gate_s = Sensor.grid(max_range_m=FARTHEST_M).gate_s
        noise = Noise(**truth, false_alarm_hz=-np.log1p(-share) / gate_s, seed=number)
        truth["false_alarms"] = share
    if place_name:
        file = None if cache is None else cache / f"{place_name}-{number}.npz"
        scene, position = (None, (0, 0, 0)) if file and file.exists() else place(place_name, number)
        recording = recorded(noise, bias, 10, scene, position, 600, file)
    else:
        recording = recorded(noise, bias)
    try:
        figures = fit(recording).figures
    except LidarError as error:
        if not place_name:
            raise
        return truth, str(error)
    fitted = dict(figures["figures"])
    if not np.any(bias):
        return truth, fitted
    ring_biases = {row["ring"]: row["bias_m"] for row in figures["channels"] if row["bias_m"]}
    rings = [*ring_biases]
    mean_bias = bias[rings].mean() if rings else 0.0  # biases are beside the mean of these
    truth |= {f"bias_m of ring {ring}": bias[ring] - mean_bias for ring in range(LAYERS)}
    fitted |= {f"bias_m of ring {ring}": estimate for ring, estimate in ring_biases.items()}
    return truth, fitted


def main(arguments: list[str] | None = None) -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("--trials", type=int, help="number of recordings (default: 200 or 40)")
    parser.add_argument("--places", action="store_true", help="simulate different places")
    parser.add_argument("--cache", type=Path, help="folder that keeps simulated recordings")
    options = parser.parse_args(arguments)
    place_names = PLACES if options.places else ("",)
    trials = options.trials or (40 if options.places else 200)
    # {(place, figure): (held, relative error, relative half-width) of each trial}
    rows: dict[tuple[str, str], list[tuple[bool, float, float]]] = defaultdict(list)
    missing: dict[tuple[str, str], int] = defaultdict(int)
    for number in range(trials):
        place_name = place_names[number % len(place_names)]
        truth, fitted = trial(number, options.cache, place_name)
        if isinstance(fitted, str):
            print(f"{place_name} {number}: {fitted}")
            fitted = {}
        for name, true in truth.items():
            estimate = fitted.get(name)
            figure = name.partition(" ")[0]  # of all rings together
            for key in {(place_name, figure), ("all", figure)}:
                if estimate is None:
                    missing[key] += 1
                    continue
                held = estimate["low"] <= true <= estimate["high"]
                half = (estimate["high"] - estimate["low"]) / 2 / abs(true)
                rows[key].append((held, estimate["value"] / true - 1, half))
    results = {}
    print_row("place", "parameter", "trials", "not determined", "covered", "error", "half-width")
    print("|---|---|--:|--:|--:|--:|--:|")
    for place_name, name in sorted({*rows, *missing}):
        trials_held = rows[place_name, name]
        held, error, half = np.reshape(trials_held or [(0, np.nan, np.nan)], (-1, 3)).T
        results[f"{place_name} {name}"] = {
            "trials": len(trials_held),
            "not_determined": missing[place_name, name],
            "held": held.mean(),
            "median_error": np.median(error),
            "median_half_width": np.median(np.abs(half)),
        }
        print_row(
            place_name,
            f"`{name}`",
            len(trials_held),
            missing[place_name, name],
            f"{100 * held.mean():.1f} %",
            f"{100 * np.median(error):+.2f} %",
            f"{100 * np.median(np.abs(half)):.1f} %",
        )
    write_results(options.json, results)


if __name__ == "__main__":
    main()

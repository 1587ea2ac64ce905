"""How often the intervals of `lidarpool fit` hold the figures that a recording was made with.

python -m benchmarks.fit_coverage [--trials 200]
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from typing import Any

import numpy as np

from lidarpool import Noise, Scanner, Scene, Sensor
from lidarpool.compare.fit import fit
from lidarpool.compare.recordings import Recording
from lidarpool.scene.scene_mesh import SceneMesh

SWEEPS, COLUMNS, LAYERS, FARTHEST_M = 12, 360, 16, 120.0


def street() -> Scene:
    """Make the ground, a wall on either side and one at the end; above them is sky."""
    corners = {
        "ground": [(-80, -60, -1.7), (80, -60, -1.7), (80, 60, -1.7), (-80, 60, -1.7)],
        "left": [(-80, 4, -1.7), (80, 4, -1.7), (80, 4, 6), (-80, 4, 6)],
        "right": [(-80, -9, -1.7), (80, -9, -1.7), (80, -9, 3), (-80, -9, 3)],
        "end": [(30, -9, -1.7), (30, 4, -1.7), (30, 4, 3), (30, -9, 3)],
    }
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    return Scene.from_meshes(SceneMesh(name, np.array(at), faces) for name, at in corners.items())


def recorded(noise: Noise, bias: Any = 0.0, sweeps: int = SWEEPS) -> Recording:
    """Sweeps of a sensor that stands in the street, with an error of each channel in metres."""
    sensor = Sensor.grid(COLUMNS, LAYERS, vertical_fov_deg=40, max_range_m=FARTHEST_M)
    scanner = Scanner(
        street(), sensor, columns=["intensity"], noise=noise, precision_m=1e-4,
        coordinates="sensor", threads=1,
    )  # fmt: skip
    made = [scanner.sweep((0, 0, 0), number=number) for number in range(sweeps)]

    def read(number: int) -> Any:
        cloud = made[number]
        points, ranges = cloud.positions, np.linalg.norm(cloud.positions, axis=1)
        errors = np.broadcast_to(bias, LAYERS)[cloud["channel"]]
        return points * (1 + errors / np.maximum(ranges, 1e-6))[:, None], cloud.columns, None

    return Recording("simulated", sweeps, read, energies=True)


def trial(number: int) -> tuple[dict[str, float], dict[str, Any]]:
    """Figures that a recording was made with, and those that were fitted: {name: …}.

    Every second sensor has noise by range and errors of its channels, the others noise by energy,
    a threshold and false alarms.
    """
    rng = np.random.default_rng(number)
    truth = {
        "range_m": rng.uniform(0.01, 0.03),
        "angle_deg": rng.uniform(0.04, 0.12),
        "dropout": rng.uniform(0.005, 0.03),
    }
    bias: Any = 0.0
    if number % 2:
        truth["range_per_m"] = rng.uniform(0.0003, 0.001)
        noise = Noise(**truth, seed=number)
        bias = rng.normal(0, 0.005, LAYERS)
        bias -= bias.mean()
        truth["bias_m"] = bias[3]
    else:
        truth["range_at_threshold_m"] = rng.uniform(0.04, 0.1)
        truth["detection_range_m"] = rng.uniform(8, 13)
        share = rng.uniform(0.001, 0.005)
        gate_s = Sensor.grid(max_range_m=FARTHEST_M).gate_s
        noise = Noise(**truth, false_alarm_hz=-np.log1p(-share) / gate_s, seed=number)
        truth["false_alarms"] = share
    figures = fit(recorded(noise, bias)).figures
    found = dict(figures["figures"])
    if bias_of := [row["bias_m"] for row in figures["channels"] if row["ring"] == 3]:
        found["bias_m"] = bias_of[0]
    return truth, found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=200)
    trials = parser.parse_args().trials
    rows: dict[str, list[tuple[bool, float, float]]] = defaultdict(list)
    missing: dict[str, int] = defaultdict(int)
    for number in range(trials):
        truth, found = trial(number)
        for name, true in truth.items():
            one = found.get(name)
            if one is None:
                missing[name] += 1
                continue
            held = one["low"] <= true <= one["high"]
            rows[name].append(
                (held, one["value"] / true - 1, (one["high"] - one["low"]) / 2 / true)
            )
    print("| figure | trials | not found | held | median error | median half-width |")
    print("|---|--:|--:|--:|--:|--:|")
    for name, values in rows.items():
        held, error, half = np.array(values, float).T
        print(
            f"| `{name}` | {len(held)} | {missing[name]} | {100 * held.mean():.1f} % "
            f"| {100 * np.median(error):+.2f} % | {100 * np.median(np.abs(half)):.1f} % |"
        )


if __name__ == "__main__":
    main()

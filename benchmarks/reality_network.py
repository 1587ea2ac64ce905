"""What a network that was trained on real lidar makes of simulated sweeps of a twin.

`python -m benchmarks.reality_network FOLDER CLONE --python TORCH [NAME …] [--json FILE]` builds the
twins of `benchmarks.reality` without every second sweep, and lets 3D-MiniNet-tiny (Alonso et al.,
2020), trained on SemanticKITTI, name a class for each cell of held-out sweeps: recorded, simulated,
and the next recorded. CLONE is a clone of Shathe/3D-MiniNet, and TORCH the Python of an environment
with torch, scipy and PyYAML, which lidarpool does not need.

It prints the share of the cells of two sweeps that have the same class, of cells in which both have
a point: of the simulated and the recorded sweep, and of the next and the recorded sweep.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np

from lidarsim.numerics.arrays import Bools, Floats, Ints

from .reality import SOURCES, HalfMap

_COMPARED_SWEEPS = 12
_NAMES = ("udacity", "kitti360")  # HDL-64E with intensities, on cars
_INFER = Path(__file__).with_name("reality_network_infer.py")
_KINDS = ("recorded", "simulated", "next")


class Sweep(NamedTuple):
    """Points of a sweep in the form that the network reads."""

    points: Floats  # (n, 3): sensor frame, meters
    intensity: Floats  # (n,): 0 to 1
    standing: Bools  # (n,)

    def write(self, file: Path) -> None:
        """Write the points as a KITTI file, which the network reads."""
        rows = np.column_stack([self.points, self.intensity])
        rows.astype(np.float32).tofile(file)


def sweeps_of(name: str, root: Path) -> list[tuple[Sweep, Sweep, Sweep]]:
    """Return held-out sweeps of a recording: recorded, simulated, and the next recorded."""
    source = SOURCES[name]
    half = HalfMap.of_recording(source.open(root / source.repository), _COMPARED_SWEEPS)
    return [
        (_recorded(half, number), _simulated(half, number), _recorded(half, number + 1))
        for number in half.compared
    ]


def _recorded(half: HalfMap, number: int) -> Sweep:
    """Return a sweep as it was recorded."""
    sweep = half.sweeps.recorded.read(number)
    assert sweep.intensities is not None
    return Sweep(sweep.points, sweep.intensities, half.standing[number])


def _simulated(half: HalfMap, number: int) -> Sweep:
    """Return what the rays of a sweep meet in the place, lost pulses included."""
    rays = half.rays([number], half.reflectances)
    points = np.concatenate([sweep.points for sweep in half.sweeps.read_with_lost(number)])
    points *= (rays.simulated_m / np.linalg.norm(points, axis=1))[:, None]
    met = np.isfinite(rays.simulated_m)
    intensity = rays.simulated_intensity[met]
    unknown = ~np.isfinite(intensity)  # of pulses that were lost in the recording
    intensity[unknown] = np.median(intensity[~unknown])
    return Sweep(points[met], intensity.clip(0, 1), np.ones(met.sum(), bool))


def classes_of(sweeps: list[Sweep], clone: Path, python: Path) -> tuple[Ints, Ints]:
    """Return the classes (s, 64, 2048) of sweeps, and the points in their cells, -1 for none."""
    with TemporaryDirectory() as folder:
        velodyne = Path(folder) / "sequences" / "00" / "velodyne"
        velodyne.mkdir(parents=True)
        for number, sweep in enumerate(sweeps):
            sweep.write(velodyne / f"{number:06}.bin")
        result = Path(folder) / "classes.npz"
        subprocess.run([python, _INFER, clone.resolve(), folder, result], check=True)
        with np.load(result) as content:
            return content["classes"], content["points"]


def agreement(one: Ints, other: Ints, cells: Bools) -> float:
    """Return the share of cells that have the same class in two sweeps."""
    return float((one == other)[cells].mean())


def measure(name: str, root: Path, clone: Path, python: Path) -> dict[str, Any]:
    """Return and print the figures of a recording."""
    triples = sweeps_of(name, root)
    flat = [sweep for triple in triples for sweep in triple]
    classes, points = (
        values.reshape(len(triples), len(_KINDS), *values.shape[1:])
        for values in classes_of(flat, clone, python)
    )
    rows = []
    for index, (real, _, following) in enumerate(triples):
        row: dict[str, float] = {}
        stands = [
            (cell_points >= 0) & sweep.standing[cell_points]
            for sweep, cell_points in ((real, points[index, 0]), (following, points[index, 2]))
        ]
        for kind, column in (("simulated", 1), ("next", 2)):
            both = (points[index, 0] >= 0) & (points[index, column] >= 0)
            still = both & stands[0] & (stands[1] if kind == "next" else True)
            pair = classes[index, 0], classes[index, column]
            row[kind] = agreement(*pair, both)
            row[f"{kind}_standing"] = agreement(*pair, still)
        rows.append(row)
    means = {key: float(np.mean([row[key] for row in rows])) for key in rows[0]}
    worst = min(row["simulated"] - row["next"] for row in rows)
    print(
        f"{name}, {len(rows)} sweeps: same class simulated {100 * means['simulated']:.1f} %, next "
        f"recorded {100 * means['next']:.1f} %; of what stands "
        f"{100 * means['simulated_standing']:.1f}, {100 * means['next_standing']:.1f} %; "
        f"worst sweep {100 * worst:+.1f} points"
    )
    counts = {
        kind: np.bincount(classes[:, k][points[:, k] >= 0], minlength=20).tolist()
        for k, kind in enumerate(_KINDS)
    }
    return {"recording": name, "sweeps": rows, "cells_by_class": counts} | means


def main(arguments: list[str] | None = None) -> list[dict[str, Any]]:
    """Measure, print and return the figures of the recordings that are there."""
    parser = argparse.ArgumentParser(prog="benchmarks.reality_network", description=__doc__)
    parser.add_argument("folder", type=Path, help="folder with the folders of the recordings")
    parser.add_argument("clone", type=Path, help="clone of Shathe/3D-MiniNet")
    parser.add_argument("names", nargs="*", help=f"of {', '.join(_NAMES)}; both by default")
    parser.add_argument("--python", type=Path, default=sys.executable, help="Python with torch")
    parser.add_argument("--json", type=Path, help="file for the figures")
    options = parser.parse_args(arguments)
    rows = [
        measure(name, options.folder, options.clone, options.python)
        for name in options.names or _NAMES
        if (options.folder / SOURCES[name].repository).is_dir()
    ]
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    return rows


if __name__ == "__main__":
    main()

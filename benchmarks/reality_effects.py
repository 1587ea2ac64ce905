"""Measure which modeled effects bring simulated sweeps closer to recorded sweeps.

    python -m benchmarks.reality_effects FOLDER [NAME ...]

FOLDER contains the recordings of `benchmarks.reality`. A scene and a sensor are reconstructed from
every second sweep, of which at most the last 80 are used. Some of the other sweeps are then
simulated with the sensor, the materials and the trajectory that `lidarpool twin` writes. Each
recorded pulse is compared with the simulated pulse of the same ring and azimuth. A run has no beam
width, because the divergence of a recorded sensor is unknown, so that row is an addition.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lidarreal.reconstruction.alignment import AlignedSweeps
from lidarreal.reconstruction.range_noise import RingNeighbors
from lidarsim.numerics.arrays import Floats

from .harness import argument_parser, write_results
from .reality import SOURCES, part_of
from .reality_twin import MAX_SWEEPS, Effects, HalfTwin, PairedPulses

_MIXED_M = 0.3  # minimum range difference between a mixed point and its neighbors
_RUN = Effects()
_VARIANTS = {
    "all, as in a run": _RUN,
    "with beam width": _RUN._replace(beam_width=True),
    "without range noise": _RUN._replace(range_noise=False),
    "without reflectances": _RUN._replace(reflectances=False),
    "without reflectance spread": _RUN._replace(reflectance_spread=False),
    "without gaps": _RUN._replace(gaps=False),
    "none": Effects(range_noise=False, reflectances=False, reflectance_spread=False, gaps=False),
    "without motion within the sweep": _RUN._replace(motion=False),
}


def compare_pulses(sweeps: AlignedSweeps, pulses: Sequence[PairedPulses]) -> dict[str, Any]:
    """Compare recorded and simulated pulses. Pairs of values are (simulated, recorded)."""
    from scipy.stats import spearmanr

    range_m, simulated_m, stationary, intensity, simulated_intensity = (
        np.concatenate([getattr(one, name) for one in pulses])
        for name in ("range_m", "simulated_m", "stationary", "intensity", "simulated_intensity")
    )
    compared = stationary & np.isfinite(simulated_m)
    size_m = np.abs(simulated_m - range_m)[compared]
    lost, simulated_lost = np.isnan(range_m), np.isnan(simulated_m)
    roughness_m, mixed = _along_rings(sweeps, pulses)
    rank = None
    if np.isfinite(intensity[compared]).all():
        rank = float(spearmanr(intensity[compared], simulated_intensity[compared])[0])
    return {
        "median_m": float(np.median(size_m)),
        "p90_m": float(np.quantile(size_m, 0.9)),
        "roughness_m": roughness_m,
        "mixed": mixed,
        "lost": (float(simulated_lost.mean()), float(lost.mean())),
        "f1": float(2 * (lost & simulated_lost).sum() / (lost.sum() + simulated_lost.sum())),
        "rank": rank,
    }


def _along_rings(
    sweeps: AlignedSweeps, pulses: Sequence[PairedPulses]
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the roughness in meters and the share of mixed points, simulated and recorded.

    Only returns whose neighboring pulses in the ring return as well are included.
    """
    steps: list[Floats] = []
    for one in pulses:
        triples = RingNeighbors.from_sweep(sweeps.recorded.read(one.number), sweeps.recorded.lasers)
        ranges_m = np.stack([one.simulated_m, one.range_m])
        before_m, at_m, after_m = (
            ranges_m[:, rows] for rows in (triples.before, triples.at, triples.after)
        )
        steps.append(np.stack([at_m - before_m, after_m - at_m]))
    first_m, second_m = np.concatenate(steps, axis=2)
    curved_m = np.abs(second_m - first_m)
    both = np.isfinite(curved_m).all(axis=0)
    roughness_m = np.median(curved_m[:, both], axis=1)
    is_mixed = (np.minimum(first_m, second_m) > _MIXED_M) | (
        np.maximum(first_m, second_m) < -_MIXED_M
    )
    mixed = is_mixed.sum(axis=1) / np.isfinite(curved_m).sum(axis=1)
    return tuple(roughness_m.tolist()), tuple(mixed.tolist())


def measure(name: str, folder: Path) -> list[dict[str, Any]]:
    """Print and return a row for each part of a recording and each variant of the simulation."""
    source = SOURCES[name]
    whole = source.open(folder / source.repository)
    rows = []
    for part, chosen in source.parts.items():
        recording = part_of(part_of(whole, chosen), slice(-MAX_SWEEPS, None))
        twin = HalfTwin.from_recording(recording)
        print(f"{name}, {part}: {twin.model.performance}")
        measured = set()
        for variant, chosen_effects in _VARIANTS.items():
            effects = twin.effective(chosen_effects)
            if effects in measured:
                continue
            measured.add(effects)
            started = time.process_time()
            row = compare_pulses(twin.sweeps, list(twin.simulate(effects)))
            row |= {"recording": f"{name}, {part}", "effects": variant}
            row["seconds"] = time.process_time() - started
            print(_line(row), flush=True)
            rows.append(row)
    return rows


def _line(row: dict[str, Any]) -> str:
    """Format a row as a row of a Markdown table."""

    def pair(name: str, scale: float, digits: int) -> str:
        return " / ".join(f"{scale * value:.{digits}f}" for value in row[name])

    rank = "–" if row["rank"] is None else f"{row['rank']:.2f}"
    cells = (
        row["recording"],
        row["effects"],
        f"{1000 * row['median_m']:.0f}",
        f"{1000 * row['p90_m']:.0f}",
        pair("roughness_m", 1000, 0),
        pair("mixed", 1000, 1),
        pair("lost", 100, 1),
        f"{row['f1']:.2f}",
        rank,
    )
    return f"| {' | '.join(cells)} |"


def main(arguments: list[str] | None = None) -> list[dict[str, Any]]:
    """Measure the recordings in a folder, and print and return the rows."""
    parser = argument_parser(__doc__)
    parser.add_argument("folder", type=Path, help="folder that contains the repositories")
    names = ("kitti360", "tram", "udacity")
    parser.add_argument("names", nargs="*", default=names, help=f"default: {', '.join(names)}")
    options = parser.parse_args(arguments)
    rows = [row for name in options.names for row in measure(name, options.folder)]
    write_results(options.json, rows)
    return rows


if __name__ == "__main__":
    main()

"""Comparison of recorded sweeps in fog with clear sweeps to which fog is added.

The two recordings come from the same sensor model (HDL-32E), but from different places. Only
properties that depend on the air more than on the place can be compared: how the number of returns
decreases with the range, and how many returns come from pulses into the sky.
"""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import ks_2samp

from lidarfiles.clouds.recording import Recording, RecordingInfo
from lidarfiles.recordings.opening import open_recording
from lidarpool import Sensor, load_sensor
from lidarreal.augmentation.augmenter import Augmenter
from lidarreal.augmentation.effects import Effects
from lidarreal.augmentation.scan_pattern import ScanPattern
from lidarsim.columns.sweep import Sweep
from lidarsim.media.weather import Weather
from lidarsim.numerics.arrays import Floats

from .augmentation_drives import from_air, ranges
from .harness import print_row

MODEL = "velodyne/hdl32e"
VISIBILITIES_KM = (0.03, 0.05, 0.07, 0.1, 0.125, 0.15, 0.2, 0.3)
DETECTION_RANGES_M = (None, 60.0, 90.0)  # None for the range that is estimated
NEAREST_M = 2.0  # closer returns come from the vehicle
FITTED_M = 10.0  # minimum range of the distributions from which the visibility is fitted
SWEEPS = 10
SECTORS = 72
TOP_RINGS = 8
SKY_SECTORS = 6  # sectors in which the top rings return least
BINS_M = (2, 4, 6, 8, 10, 15, 20, 30, 50, 100)


class CSVRecording(Recording):
    """Sweeps that are stored as CSV files with the columns x, y, z, intensity and ring."""

    def __init__(self, folder: Path) -> None:
        super().__init__(RecordingInfo(folder.name))
        self._files = sorted(folder.glob("*.csv"))

    def __len__(self) -> int:
        return len(self._files)

    def load(self, number: int) -> Sweep:
        """Read a file."""
        table = np.loadtxt(self._files[number], delimiter=",")
        columns = {"intensity": table[:, 3].astype(np.float32), "channel": table[:, 4].astype(int)}
        return Sweep(table[:, :3], columns)


def compare_fog(foggy: Path, clear: Path) -> dict[str, Any]:
    """Print and return properties of foggy sweeps and of clear sweeps with added fog."""
    recorded = CSVRecording(foggy)
    model = load_sensor(MODEL)
    pattern = ScanPattern.from_recording(recorded, model)
    sweeps = [recorded[number] for number in _numbers(recorded)]
    pulses = [int(pattern.grid(sweep).fired.sum()) for sweep in sweeps]
    results = {"recorded": _properties(sweeps, pulses)}
    results["recorded"]["sky"] = _sky_density(recorded, pattern)
    bins = [f"{start}–{stop} m" for start, stop in pairwise(BINS_M)]
    print_row("sweeps", "pulses that return", *bins, "KS")
    print_row(*["---"] * (len(bins) + 3))
    _print("recorded in fog", results["recorded"])
    _print("recorded in fog, pulses into the sky", results["recorded"], sky=True)
    base = open_recording(clear, keep_noise=True)
    reference = _far(sweeps)
    results["clear"] = _augmented(base, model, reference, Effects())
    _print("clear", results["clear"])
    for visibility_km in VISIBILITIES_KM:
        for detection_range_m in DETECTION_RANGES_M:
            noise = {} if detection_range_m is None else {"detection_range_m": detection_range_m}
            effects = Effects(weather=Weather(visibility_km=visibility_km), noise=noise)
            row = _augmented(base, model, reference, effects)
            sensitivity = "estimated" if detection_range_m is None else f"{detection_range_m:g} m"
            name = f"visibility {1000 * visibility_km:g} m, detection range {sensitivity}"
            results[name] = row
            _print(name, row)
            _print(f"{name}, pulses into the sky", row, sky=True)
    return results


def _numbers(recording: Recording) -> list[int]:
    return np.linspace(0, len(recording) - 1, SWEEPS).astype(int).tolist()


def _augmented(
    base: Recording, model: Sensor, reference: Floats, effects: Effects
) -> dict[str, Any]:
    """Return properties of augmented sweeps, and the distance of their ranges from a reference."""
    augmenter = Augmenter(base, effects, model)
    numbers = _numbers(base)
    sweeps = [augmenter.sweep(number).sweep for number in numbers]
    pulses = [int(augmenter.pattern.grid(base[number]).fired.sum()) for number in numbers]
    row = _properties(sweeps, pulses)
    row["ks"] = float(ks_2samp(_far(sweeps), reference).statistic)
    # Pulses that hit no surface, either because there is none or because its return is lost
    solid = sum(int((~from_air(sweep)).sum()) for sweep in sweeps)
    air_m = np.concatenate([ranges(sweep)[from_air(sweep)] for sweep in sweeps])
    row["sky"] = (np.histogram(air_m, BINS_M)[0] / max(sum(pulses) - solid, 1)).tolist()
    return row


def _properties(sweeps: list[Sweep], pulses: list[int]) -> dict[str, Any]:
    range_m = np.concatenate([ranges(sweep) for sweep in sweeps])
    range_m = range_m[range_m > NEAREST_M]
    return {
        "returned": len(range_m) / sum(pulses),
        "bins": (np.histogram(range_m, BINS_M)[0] / sum(pulses)).tolist(),
    }


def _far(sweeps: list[Sweep]) -> Floats:
    range_m = np.concatenate([ranges(sweep) for sweep in sweeps])
    return range_m[range_m > FITTED_M]


def _sky_density(recording: Recording, pattern: ScanPattern) -> list[float]:
    """Return the fraction of pulses into the sky that return, for each range interval.

    The sectors of the sky are chosen in the first half of the sweeps, and the pulses are counted in
    the second half.
    """
    half = len(recording) // 2
    chosen, counted = (
        np.mean([_top_density(recording[number], pattern) for number in numbers], axis=0)
        for numbers in (range(half), range(half, len(recording)))
    )
    sky = np.argsort(chosen.sum(axis=1))[:SKY_SECTORS]
    density: list[float] = counted[sky].mean(axis=0).tolist()
    return density


def _top_density(sweep: Sweep, pattern: ScanPattern) -> Floats:
    """Return the fraction of pulses of the top rings that return, by sector and range."""
    channel = np.asarray(sweep.columns["channel"])
    top = channel > channel.max() - TOP_RINGS
    azimuth = np.arctan2(sweep.points[top, 1], sweep.points[top, 0])
    sector = np.floor((azimuth / (2 * np.pi) + 0.5) * SECTORS) % SECTORS
    edges = np.arange(SECTORS + 1)
    counts = np.histogram2d(sector, ranges(sweep)[top], (edges, np.array(BINS_M)))[0]
    return np.asarray(counts / (TOP_RINGS * pattern.firings / SECTORS))


def _print(name: str, row: dict[str, Any], *, sky: bool = False) -> None:
    bins = row["sky"] if sky else row["bins"]
    returned = sum(bins) if sky else row["returned"]
    distance = f"{row['ks']:.3f}" if "ks" in row and not sky else "–"
    shares = (f"{100 * share:.2f} %" for share in bins)
    print_row(name, f"{100 * returned:.1f} %", *shares, distance)

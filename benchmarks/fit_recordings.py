"""Fits half of the sweeps of recordings, and compares noise and losses with the other half.

python -m benchmarks.fit_recordings [--picture FILE.png] RECORDING[=MODEL[,WHITE]] …

The simulator's noise is drawn at the ranges, energies and slopes of the other half's rays: by the
model's data sheet, and as fitted. Recordings that `fit` refuses have a row with the reason. Without
a model, the sensor is that of the recording, without a data sheet.
"""

from __future__ import annotations

import argparse
import warnings
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from lidarpool import LidarError, Noise, fit
from lidarpool.clouds.recording import Recording
from lidarpool.comparing.fit.smooth_surfaces import find_surfaces, select_smooth_rays
from lidarpool.comparing.fit.stack import SweepStack
from lidarpool.comparing.fit.standstill import read_static
from lidarpool.recordings.opening import open_recording
from lidarsim.sensor.models import read_model
from lidarsim.simulator.steps.angle_noise import angle_errors
from lidarsim.simulator.steps.detection import is_detected
from lidarsim.simulator.steps.range_noise import noisy_ranges

COLORS = {"recorded": "#1c2430", "data sheet": "#ee7733", "fitted": "#4477aa"}


def every_second_sweep(recording: Recording, first: int) -> Recording:
    """Return a recording of every second sweep, from sweep `first` on."""
    numbers = range(first, recording.count, 2)
    return replace(
        recording, count=len(numbers), read=lambda number: recording.read(numbers[number])
    )


def simulate_ranges(noise: Noise, rays: Any, energy: Any, sweeps: int) -> Any:
    """Simulate the ranges of rays in sweeps, (s, k) meters; NaN where a pulse is lost."""
    keys = np.arange(len(rays.row))
    result = np.full((sweeps, len(keys)), np.nan)
    for scan in range(sweeps):
        across, _ = angle_errors(noise, np.full(len(keys), scan), keys)
        ranges = rays.distance + rays.slope * across  # along the steepest slope
        moved = noisy_ranges(noise, ranges, energy, np.full(len(keys), scan), keys, 0 * keys)
        detected_rays = is_detected(noise, energy, np.full(len(keys), scan), keys, 0 * keys)
        result[scan] = np.where(detected_rays, moved, np.nan)
    return result


def deviations(ranges: Any) -> Any:
    """Return differences of successive sweeps divided by √2, millimeters."""
    steps = np.diff(ranges, axis=0) / np.sqrt(2)
    return 1000 * steps[np.isfinite(steps)]


class Comparison(NamedTuple):
    """Statistics of recorded and simulated sweeps in the second half of a recording, by source."""

    deviations_mm: dict[str, Any]  # (n,) each
    lost: dict[str, float]  # shares of pulses
    spread: dict[str, float]  # scatter of intensity, relative


def compare_halves(recording: Recording, model: str | None, white: float | None) -> Comparison:
    """Fit the first half of a recording, and simulate the rays of the second half.

    LidarError if a half cannot be fitted.
    """
    read_static(recording)  # refuses a sensor that moves, which halves may not show
    fit_result = fit(every_second_sweep(recording, 0), model=model, white=white)
    test_stack = read_static(every_second_sweep(recording, 1))
    rays = select_smooth_rays(test_stack, test_stack.rough_sigma, 0.002)
    recorded = flattened_ranges(test_stack, rays)
    energy = np.maximum(rays.intensity / (white or recording.white or 100), 1 / 400)
    energy = energy * (10 / rays.distance) ** 2
    noises = {"data sheet": datasheet_noise(model), "fitted": fit_result.model.datasheet().noise}
    ranges = {"recorded": recorded}
    for name, noise in noises.items():
        ranges[name] = simulate_ranges(noise, rays, energy, len(recorded))
    light = test_stack.intensities[:, rays.row, rays.column].astype(float)
    steps = np.abs(np.diff(light, axis=0)) / np.sqrt(2) / np.maximum(rays.intensity, 1)
    spread = {"recorded": float(np.nanmedian(steps) / 0.6745)}
    lost = {name: float(np.isnan(values).mean()) for name, values in ranges.items()}
    lost["recorded"] = 1 - rays.return_counts.sum() / rays.trials.sum()  # without gaps
    return Comparison({name: deviations(v) for name, v in ranges.items()}, lost, spread)


def flattened_ranges(stack: SweepStack, rays: Any) -> Any:
    """Return recorded ranges of rays, (s, k) meters, without the effect of azimuth offsets."""
    with warnings.catch_warnings(action="ignore"):  # of cells without a return
        median_ranges = np.nanmedian(stack.ranges, axis=0)
    azimuth_slope = find_surfaces(stack, median_ranges, stack.rough_sigma).azimuth_slope
    cell = rays.row, rays.column
    ranges = stack.ranges[:, *cell].astype(float)
    ranges -= azimuth_slope[cell] * np.nan_to_num(stack.azimuth_offsets[:, *cell])
    return ranges


def datasheet_noise(model: str | None) -> Noise:
    """Return the noise of a model's data sheet; no noise without a stated performance."""
    if model is not None:
        with suppress(LidarError):  # the model states no performance
            return read_model(model).datasheet().noise
    return Noise()


def print_rows(name: str, comparison: Comparison) -> None:
    """Print a row of the table for each source of a comparison."""
    for source, values in comparison.deviations_mm.items():
        quantiles = np.quantile(np.abs(values), (0.5, 0.95, 0.99))
        noise = ", ".join(f"{quantile:.1f}" for quantile in quantiles)
        spread = comparison.spread
        intensity = f"{100 * spread[source]:.1f} %" if source in spread else "0"
        lost = f"{100 * comparison.lost[source]:.2f} %"
        print(f"| {name} | {source} | {noise} | {lost} | {intensity} |", flush=True)


def draw_deviations(axes: Any, comparison: Comparison) -> None:
    """Draw a histogram of deviations for each source of a comparison."""
    limit = 1.5 * np.quantile(np.abs(comparison.deviations_mm["recorded"]), 0.98)
    for source, values in comparison.deviations_mm.items():
        if values.any():  # without noise there is nothing to draw
            share = np.full(len(values), 1 / len(values))
            axes.hist(
                values,
                61,
                range=(-limit, limit),
                weights=share,
                histtype="step",
                color=COLORS[source],
                label=source,
            )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recordings", nargs="+", metavar="RECORDING[=MODEL[,WHITE]]")
    parser.add_argument("--picture", type=Path)
    options = parser.parse_args()
    figure = Figure(figsize=(3.2 * len(options.recordings), 2.8), layout="constrained")
    print("| recording | | noise: 50 %, 95 %, 99 % of deviations, mm | pulses lost | intensity |")
    print("|---|---|--:|--:|--:|")
    for number, text in enumerate(options.recordings):
        path, _, model = text.partition("=")
        model, _, white = model.partition(",")
        try:
            recording = open_recording(path)
            comparison = compare_halves(recording, model or None, float(white) if white else None)
        except LidarError as error:
            print(f"| {Path(path).name} | refused | {error} | | |", flush=True)
            continue
        print_rows(Path(path).name, comparison)
        axes = figure.add_subplot(1, len(options.recordings), number + 1)
        draw_deviations(axes, comparison)
        axes.set(title=f"{Path(path).name}\n{model}", xlabel="deviation, mm", yticks=[])
    if figure.axes:
        figure.axes[0].legend(fontsize=7, frameon=False)
    if options.picture:
        figure.savefig(options.picture, dpi=110)


if __name__ == "__main__":
    main()

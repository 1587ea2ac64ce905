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
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from lidarpool import LidarError, Noise, fit
from lidarpool.compare.fit import SweepStack, find_surfaces, select_smooth_rays
from lidarpool.compare.recordings import Recording, open_recording
from lidarsim.sensor.models import read_model
from lidarsim.simulator.angle_noise import angle_errors
from lidarsim.simulator.detection import detected
from lidarsim.simulator.range_noise import noisy_ranges

COLOURS = {"recorded": "#1c2430", "data sheet": "#ee7733", "fitted": "#4477aa"}


def every_second_sweep(recording: Recording, first: int) -> Recording:
    """Return a recording of every second sweep, from sweep `first` on."""
    numbers = range(first, recording.count, 2)
    return replace(
        recording, count=len(numbers), read=lambda number: recording.read(numbers[number])
    )


def simulate_ranges(noise: Noise, rays: Any, energy: Any, sweeps: int) -> Any:
    """Simulate the ranges of rays in sweeps, (s, k) metres; NaN where a pulse is lost."""
    keys = np.arange(len(rays.row))
    result = np.full((sweeps, len(keys)), np.nan)
    for scan in range(sweeps):
        across, _ = angle_errors(noise, np.full(len(keys), scan), keys)
        ranges = rays.distance + rays.slope * across  # along the steepest slope
        moved = noisy_ranges(noise, ranges, energy, np.full(len(keys), scan), keys, 0 * keys)
        detected_rays = detected(noise, energy, np.full(len(keys), scan), keys, 0 * keys)
        result[scan] = np.where(detected_rays, moved, np.nan)
    return result


def deviations(ranges: Any) -> Any:
    """Return differences of successive sweeps divided by √2, millimetres."""
    steps = np.diff(ranges, axis=0) / np.sqrt(2)
    return 1000 * steps[np.isfinite(steps)]


def compare_halves(
    recording: Recording, model: str | None, white: float | None
) -> tuple[dict[str, Any], ...]:
    """Return deviations (n,), shares of lost pulses and scatter of intensity, by source.

    LidarError if a half cannot be fitted.
    """
    SweepStack.read(recording)  # refuses a sensor that moves, which halves may not show
    fit_result = fit(every_second_sweep(recording, 0), model=model, white=white)
    test_stack = SweepStack.read(every_second_sweep(recording, 1))
    rays = select_smooth_rays(test_stack, test_stack.rough_sigma, 0.002)
    with warnings.catch_warnings(action="ignore"):  # of cells without a return
        median_ranges = np.nanmedian(test_stack.ranges, axis=0)
    azimuth_slope = find_surfaces(test_stack, median_ranges, test_stack.rough_sigma).azimuth_slope
    energy = np.maximum(rays.intensity / (white or recording.white or 100), 1 / 400)
    energy = energy * (10 / rays.distance) ** 2
    fitted_noise = fit_result.model.datasheet().noise
    datasheet_noise = Noise()
    if model is not None:
        with suppress(LidarError):  # the model states no performance
            datasheet_noise = read_model(model).datasheet().noise
    cell = rays.row, rays.column
    recorded = test_stack.ranges[:, *cell].astype(float)
    recorded -= azimuth_slope[cell] * np.nan_to_num(test_stack.azimuth_offsets[:, *cell])
    sweeps = len(recorded)
    ranges = {"recorded": recorded, "data sheet": simulate_ranges(datasheet_noise, rays, energy, sweeps),
              "fitted": simulate_ranges(fitted_noise, rays, energy, sweeps)}  # fmt: skip
    light = test_stack.intensities[:, *cell].astype(float)
    steps = np.abs(np.diff(light, axis=0)) / np.sqrt(2) / np.maximum(rays.intensity, 1)
    spread = {"recorded": float(np.nanmedian(steps) / 0.6745)}
    lost = {name: float(np.isnan(values).mean()) for name, values in ranges.items()}
    lost["recorded"] = 1 - rays.returns.sum() / rays.trials.sum()  # without gaps
    return {name: deviations(values) for name, values in ranges.items()}, lost, spread


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
            deviations_mm, lost, spread = compare_halves(
                recording, model or None, float(white) if white else None
            )
        except LidarError as error:
            print(f"| {Path(path).name} | refused | {error} | | |", flush=True)
            continue
        axes = figure.add_subplot(1, len(options.recordings), number + 1)
        limit = 1.5 * np.quantile(np.abs(deviations_mm["recorded"]), 0.98)
        for name, values in deviations_mm.items():
            median, percentile_95, percentile_99 = np.quantile(np.abs(values), (0.5, 0.95, 0.99))
            intensity_text = f"{100 * spread[name]:.1f} %" if name in spread else "0"
            print(f"| {Path(path).name} | {name} | {median:.1f}, {percentile_95:.1f}, {percentile_99:.1f} "
                  f"| {100 * lost[name]:.2f} % | {intensity_text} |", flush=True)  # fmt: skip
            if values.any():  # without noise there is nothing to draw
                share = np.full(len(values), 1 / len(values))
                axes.hist(values, 61, range=(-limit, limit), weights=share, histtype="step",
                          color=COLOURS[name], label=name)  # fmt: skip
        axes.set(title=f"{Path(path).name}\n{model}", xlabel="deviation, mm", yticks=[])
    if figure.axes:
        figure.axes[0].legend(fontsize=7, frameon=False)
    if options.picture:
        figure.savefig(options.picture, dpi=110)


if __name__ == "__main__":
    main()

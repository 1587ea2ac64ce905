"""Saturation of the receiver by strong pulses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from docs.pictures.effects._receiver import BLUE, GRAY, RED, cast_scan, fixed_beams, wall
from matplotlib.figure import Figure
from numpy.typing import NDArray

from lidarpool import Material, Noise, Returns, Scene, Survey
from lidarsim.columns.table import AXES, SCAN
from lidarsim.columns.waveforms import WAVEFORM
from lidarsim.sensor.optics import LIGHT_M_NS
from lidarsim.simulator.points.batch_columns import columns_of
from lidarsim.simulator.rig import Rig

NOISE = Noise(detection_range_m=100, saturation=100)  # full by a white wall 31.6 m away
PULSE_NS = 5.0
MATERIALS = {
    "W": [Material("*", 1.0)],
    "Sign": [Material("Sign", 1.0, retro=True), Material("*", 1.0)],
}
COLUMNS = ("range", "intensity", "amplitude", "pulse_width", "object")


def with_effect(survey: Survey) -> Survey:
    """Return the survey with a receiver that saturates."""
    return replace(survey, noise=NOISE)


def _waveform(wall_m: float, noise: Noise) -> tuple[NDArray, NDArray]:
    """Return the ranges and signals of the samples in a white wall's waveform."""
    survey = Survey(
        fixed_beams(1),
        poses=[(0, 0, 0)],
        steps=1,
        materials=MATERIALS["W"],
        noise=noise,
        columns=COLUMNS,
        returns=Returns(waveform="peaks", sample_ns=0.25),
        waveform_samples=160,
    )
    part = columns_of(list(Rig(Scene.from_meshes([wall("W", wall_m)]), survey, "numpy").cast(0, 1)))
    table = (SCAN, *(c for c in survey.stored_columns if c not in AXES and c.name != WAVEFORM))
    waves = part.cloud(table, survey.precision_m, np.zeros(3)).waveforms
    return waves.times_ns[0] * LIGHT_M_NS / 2, waves.samples[0]


def _separable_distance(name: str, plate_m: float) -> tuple[float, float]:
    """Return a plate's relative signal, and the minimum resolved distance of a wall behind it."""
    beam = Returns("all", subrays=61, divergence_mrad=1)
    options = {"materials": MATERIALS[name], "returns": beam, "columns": COLUMNS}
    lower_m = 0.1
    upper_m = 10.0
    while upper_m - lower_m > 0.005:
        behind = (lower_m + upper_m) / 2
        meshes = [wall(name, plate_m, y=(-50, 0.0)), wall("Wall", plate_m + behind)]
        columns = cast_scan(meshes, fixed_beams(1), NOISE, **options)
        lower_m, upper_m = (lower_m, behind) if len(columns["range"]) == 2 else (behind, upper_m)
    return columns["intensity"][0] / NOISE.saturation_energy, upper_m


def picture() -> Figure:
    """Plot clipped pulses, pulse widths and range errors, and the minimum distances of walls."""
    figure = Figure((11, 3.7), layout="constrained", dpi=110)
    pulse, widths, apart = figure.subplots(1, 3)
    pulse.axhline(1, color="k", lw=0.8, ls=":")
    for wall_m, color in ((8.0, RED), (31.6, BLUE), (50.0, GRAY)):
        range_m, signal = _waveform(wall_m, NOISE)
        label = f"white wall at {wall_m:g} m"
        pulse.plot(
            range_m - wall_m, signal / NOISE.saturation_energy, color=color, lw=1.5, label=label
        )
        range_m, signal = _waveform(wall_m, replace(NOISE, saturation=None))
        pulse.plot(range_m - wall_m, signal / NOISE.saturation_energy, color=color, lw=0.8, ls="--")
    pulse.set(
        ylim=(-0.1, 2.2),
        xlim=(-1.5, 1.5),
        xlabel="range − true range, m",
        ylabel="signal / saturation",
    )
    pulse.legend(frameon=False, fontsize=8, loc="upper right")
    pulse.set_title("recorded pulses (dashed: without)", fontsize=10)

    ratio = np.geomspace(0.1, 1e5, 200)
    closed = PULSE_NS * np.sqrt(1 + np.log2(np.maximum(ratio, 1)))
    kinds = ("W", BLUE, np.geomspace(1, 90, 9)), ("Sign", RED, np.geomspace(3, 90, 6))
    shift = widths.twinx()
    for name, color, ranges_m in kinds:
        for wall_m in ranges_m:
            options = {"materials": MATERIALS[name], "columns": COLUMNS}
            columns = cast_scan([wall(name, wall_m)], fixed_beams(1), NOISE, **options)
            over_saturation = columns["intensity"] / NOISE.saturation_energy
            widths.plot(over_saturation, columns["pulse_width"], "o", ms=5, color=color)
            waves = Returns(waveform="peaks")
            columns = cast_scan(
                [wall(name, wall_m)], fixed_beams(1), NOISE, returns=waves, **options
            )
            shift.plot(
                over_saturation, columns["range"] - wall_m, "s", ms=4, mfc="none", color=color
            )
    widths.plot(ratio, closed, "k-", lw=1, zorder=0)
    shift.plot(ratio, -LIGHT_M_NS / 4 * (closed - PULSE_NS), "k--", lw=1, zorder=0)
    widths.set(xscale="log", ylim=(0, 25), ylabel="pulse width, ns (filled)")
    shift.set(ylim=(-1.5, 1.0), ylabel="range − true range in waveforms, m (open)")
    widths.set_title("5 ns pulses on walls and signs", fontsize=10)

    separable = [
        (_separable_distance(name, wall_m), color)
        for name, color, ranges_m in kinds
        for wall_m in ranges_m[3:]
    ]
    for (over_saturation, behind), color in separable:
        apart.plot(over_saturation, behind, "o", ms=5, color=color)
    apart.plot(
        ratio, LIGHT_M_NS / 4 * (closed + PULSE_NS), "k-", lw=1, zorder=0, label="wall not clipped"
    )
    apart.plot(
        ratio, LIGHT_M_NS / 2 * closed, "k--", lw=1, zorder=0, label="wall as strong as the plate"
    )
    apart.set(xscale="log", ylim=(0, 4), ylabel="minimum distance behind the plate, m")
    apart.legend(frameon=False, fontsize=8, loc="upper left")
    apart.set_title("a wall resolved behind a plate", fontsize=10)
    for axes in (widths, apart):
        axes.set_xlabel("signal / saturation")
    for axes in (pulse, widths, apart):
        axes.grid(alpha=0.25)
    return figure

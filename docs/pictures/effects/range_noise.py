"""Range noise and range walk as functions of the return energy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from docs.pictures.effects._receiver import BLUE, GRAY, RED, cast_scan, fixed_beams, wall
from matplotlib.figure import Figure

from lidarpool import Material, Noise, Survey
from lidarsim.pulses.steps.range_noise import range_walk

NOISE = Noise(0.01, detection_range_m=100, range_at_threshold_m=0.1)
WALK = Noise(0.01, detection_range_m=100, walk_m=0.02)
RAYS = 4000


def with_effect(survey: Survey) -> Survey:
    return replace(survey, noise=replace(NOISE, walk_m=0.02))


def picture() -> Figure:
    """Plot range noise and range walk at simulated walls over energy, with the model curves."""
    kinds = {
        "10 % reflectance": (Material("*", 0.1), GRAY, np.geomspace(4, 105, 9)),
        "80 %": (Material("*", 0.8), BLUE, np.geomspace(10, 250, 9)),
        "retro-reflector": (Material("*", 1.0, retro=True), RED, np.geomspace(20, 250, 5)),
    }
    figure = Figure((9, 3.7), layout="constrained", dpi=110)
    scatter, walk = figure.subplots(1, 2)
    for name, (material, color, ranges_m) in kinds.items():
        energies = []
        sigmas = []
        shifts = []
        for range_m in ranges_m:
            target = [wall("W", range_m)]
            columns = cast_scan(target, fixed_beams(RAYS), NOISE, materials=[material])
            energies.append(np.median(columns["intensity"]) / NOISE.threshold)
            sigmas.append(columns["range"].std())
            shifts.append(
                cast_scan(target, fixed_beams(RAYS), WALK, materials=[material])["range"].mean()
                - range_m
            )
        scatter.plot(energies, 100 * np.array(sigmas), "o", ms=5, color=color, label=name)
        walk.plot(energies, 100 * np.array(shifts), "o", ms=5, color=color)
    ratio = np.geomspace(0.8, 1e6, 200)
    total_sigma = np.hypot(NOISE.range_m, NOISE.range_at_threshold_m / ratio)
    scatter.plot(ratio, 100 * total_sigma, "k-", lw=1, zorder=0, label="σ = 1 cm ⊕ 10 cm · T / E")
    scatter.plot([1, 1e6], [1, 1], "k:", lw=1, zorder=0, label="without (σ = 1 cm)")
    scatter.set(xscale="log", yscale="log", ylabel="standard deviation of ranges, cm")
    scatter.set_yticks([1, 2, 5, 10], ["1", "2", "5", "10"])
    scatter.minorticks_off()
    scatter.legend(frameon=False, fontsize=8)
    scatter.set_title("noise: walls at 4 to 250 m", fontsize=10)
    walk.plot(
        ratio,
        -100 * range_walk(WALK, ratio * WALK.threshold),
        "k-",
        lw=1,
        zorder=0,
        label="−2 cm · √(2 ln E / T)",
    )
    walk.plot([1, 1e6], [0, 0], "k:", lw=1, zorder=0, label="without")
    walk.set(xscale="log", ylabel="mean range − true range, cm")
    walk.legend(frameon=False, fontsize=8)
    walk.set_title("walk: signs appear closer", fontsize=10)
    for axes in (scatter, walk):
        axes.set_xlabel("energy E / detection threshold T")
        axes.grid(alpha=0.25)
    return figure

"""Simulated detection rates and precision compared with data sheets."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from docs.pictures.effects._receiver import BLUE, GRAY, RED, cast_scan, fixed_beams, wall
from matplotlib.figure import Figure

from lidarpool import Material, Survey
from lidarsim.sensor.models import read_model

SHOWN = {
    "ouster/os0-64": "#7b3f99",
    "livox/mid360": "#2e8b57",
    "hesai/xt32": GRAY,
    "ouster/os1-64": BLUE,
    "livox/avia": RED,
}
RAYS = 2000


def with_effect(survey: Survey) -> Survey:
    """Return the survey with 7 sub-rays and the noise stated in the data sheet."""
    sheet = read_model("ouster/os1-64").datasheet()
    return replace(survey, noise=sheet.noise, returns=sheet.returns)


def picture() -> Figure:
    """Plot simulated detection rates and range precision with the values stated in data sheets."""
    figure = Figure((9, 3.7), layout="constrained", dpi=110)
    shares, sigmas = figure.subplots(1, 2)
    dark = [Material("*", 0.1)]
    for name, color in SHOWN.items():
        stated = read_model(name).performance.detection
        noise = read_model(name).datasheet().noise
        ranges_m = np.linspace(0.4, 1.5, 23) * stated.range_m
        scans = [
            cast_scan([wall("W", x)], fixed_beams(RAYS), noise, materials=dark) for x in ranges_m
        ]
        detected = [len(scan["range"]) for scan in scans]
        shares.plot(ranges_m, 100 * np.array(detected) / RAYS, "-", lw=1.2, color=color)
        share = 100 * stated.probability
        label = f"{name}: {stated.range_m:g} m, {share:g} %"
        shares.plot(stated.range_m, share, "o", ms=7, color=color, label=label)
    shares.set(xscale="log", xlabel="range of a wall of 10 % reflectance, m", xlim=(1.2, 400))
    ticks = [5, 10, 20, 50, 100, 200]
    shares.set_xticks(ticks, [str(tick) for tick in ticks])
    shares.set_ylabel("pulses that return, %")
    shares.legend(frameon=False, fontsize=7.5, loc="lower left", title="stated", title_fontsize=8)
    shares.set_title("detection", fontsize=10)
    name = "livox/tele15"
    noise = read_model(name).datasheet().noise
    for reflectance, color, limits, stated_at in (
        (0.1, GRAY, (20, 180), [(70, 2), (120, 4)]),
        (0.8, BLUE, (40, 450), [(220, 2), (380, 4)]),
    ):
        ranges_m = np.geomspace(*limits, 14)
        scans = [
            cast_scan(
                [wall("W", x)], fixed_beams(RAYS), noise, materials=[Material("*", reflectance)]
            )
            for x in ranges_m
        ]
        spread = [100 * scan["range"].std() for scan in scans]
        label = f"{100 * reflectance:g} % reflectance"
        sigmas.plot(ranges_m, spread, "-", lw=1.2, color=color, label=f"simulated, {label}")
        x, y = zip(*stated_at, strict=True)
        sigmas.plot(x, y, "v", ms=8, color=color, label=f"stated (less than), {label}")
    sigmas.set(xscale="log", xlabel="range of a wall, m", ylabel="standard deviation of ranges, cm")
    sigmas.set_xticks([20, 50, 100, 200, 400], ["20", "50", "100", "200", "400"])
    sigmas.legend(frameon=False, fontsize=7.5)
    sigmas.set_title("precision of a Tele-15; the curve is fitted to 10 %", fontsize=10)
    for axes in (shares, sigmas):
        axes.minorticks_off()
        axes.grid(alpha=0.25)
    return figure

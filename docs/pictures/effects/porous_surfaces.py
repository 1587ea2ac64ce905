"""A hedge with gaps: points, shares of the pulses that pass through it, and depths of returns."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
from benchmarks.fit_coverage import box
from matplotlib.figure import Figure

from lidarpool import Beams, Material, Scene, SceneMesh, Sensor, Spin, Survey
from lidarsim.simulator.rig import Rig
from lidarview.render.theme import INK, LINE, MUTED, OBJECT_COLORS

GREEN = OBJECT_COLORS[2]
BROWN = OBJECT_COLORS[7]
RAYS = 20_000
SPREAD_M = 0.15
HEDGE_M = 4.0
HOUSE_M = 7.0
MESHES = [
    SceneMesh(
        "Hedge",
        np.array([(HEDGE_M, y, z) for y, z in ((-9, 0), (9, 0), (9, 1.8), (-9, 1.8))]),
        np.array([[0, 1, 2], [0, 2, 3]]),
    ),
    box("House", (HOUSE_M, -9, 0), (HOUSE_M + 1, 9, 3)),
    box("Ground", (-1, -9, -1), (20, 9, 0)),
]


def with_effect(survey: Survey) -> Survey:
    """Return the survey with trees whose surfaces have gaps."""
    trees = Material("tree-*", 0.5, gap_fraction=0.3, range_spread_m=0.2)
    return replace(survey, materials=[trees, Material("*")])


def cast(sensor: Sensor, hedge: Material) -> Any:
    survey = Survey(sensor, poses=[(0, 0, 1)], steps=1, materials=[hedge, Material("*")])
    (batch,) = Rig(Scene.from_meshes(MESHES), survey).cast(0, 1)
    return batch


def section(axes: Any, hedge: Material, title: str) -> None:
    """Draw the points of a fan of beams that faces the hedge."""
    scan = cast(Sensor(Beams(np.radians(np.linspace(-40, 22, 700))), Spin(1, 360)), hedge)
    for number, color in ((2, MUTED), (1, BROWN), (0, GREEN)):
        shown = scan.object == number
        x, _, z = scan.positions[shown].T
        axes.plot(x, z, ".", ms=2.2, mew=0, color=color)
    axes.plot(0, 1, "^", color=INK, ms=6)
    axes.set(xlim=(-0.4, 8), ylim=(-0.2, 3.3), aspect="equal", ylabel="z (m)")
    axes.set_title(title, fontsize=10, color=INK)


def picture() -> Figure:
    """Plot sections of a hedge, the shares of its returns, and the depths of the returns."""
    figure = Figure((13.5, 5.2), dpi=100, layout="constrained")
    grid = figure.add_gridspec(2, 3, width_ratios=[1.05, 1, 1])
    above = figure.add_subplot(grid[0, 0])
    below = figure.add_subplot(grid[1, 0])
    shares = figure.add_subplot(grid[:, 1])
    depths = figure.add_subplot(grid[:, 2])
    section(above, Material("Hedge", 0.5), "surface without gaps")
    porous = Material("Hedge", 0.5, gap_fraction=0.4, range_spread_m=SPREAD_M)
    section(below, porous, f"gap_fraction: 0.4, range_spread_m: {SPREAD_M}")
    below.set(xlabel="x (m)")

    level = Sensor(Beams(np.zeros(RAYS)), Spin(1, 360))
    fractions = np.arange(0, 1, 0.1)
    behind = [
        (cast(level, Material("Hedge", 0.5, gap_fraction=g)).object == 1).mean() for g in fractions
    ]
    shares.plot(fractions, fractions, color=BROWN, lw=1.2, label="house: g")
    shares.plot(fractions, behind, "o", ms=4.5, mfc="none", color=BROWN, label="simulated")
    shares.plot(fractions, 1 - fractions, color=GREEN, lw=1.2, label="hedge: 1 − g")
    shares.plot(
        fractions, 1 - np.array(behind), "o", ms=4.5, mfc="none", color=GREEN, label="simulated"
    )
    shares.set(xlabel="gap fraction g", ylabel="share of the pulses", ylim=(0, 1))
    shares.set_title("Surfaces from which pulses return", fontsize=11, color=INK)
    shares.legend(fontsize=8, frameon=False)

    depth = cast(level, Material("Hedge", 0.5, range_spread_m=SPREAD_M)).range - HEDGE_M
    counts, edges = np.histogram(depth, 40, (-0.6, 0.6), density=True)
    depths.stairs(counts, edges, color=GREEN, lw=1, label="simulated")
    steps = np.linspace(-0.6, 0.6, 121)
    normal = np.exp(-0.5 * (steps / SPREAD_M) ** 2) / (SPREAD_M * math.sqrt(2 * math.pi))
    depths.plot(steps, normal, color=INK, lw=1.2, label="normal distribution")
    depths.set(xlabel="range behind the surface (m)", ylabel="density of returns (1/m)")
    depths.set_title(f"Depths of returns, range_spread_m: {SPREAD_M}", fontsize=11, color=INK)
    depths.legend(fontsize=8, frameon=False)
    for axes in (above, below, shares, depths):
        axes.tick_params(labelsize=8, colors=MUTED)
        axes.spines[:].set_color(LINE)
    return figure

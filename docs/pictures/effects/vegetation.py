"""Leaves in tree crowns: points, gap fractions by leaf angle, and depths of returns."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import trimesh
from benchmarks.fit_coverage import box
from matplotlib.figure import Figure
from numpy.typing import NDArray

from lidarpool import Beams, Material, Noise, Scene, SceneMesh, Sensor, Spin, Survey
from lidarsim.media.leaves import mean_projection
from lidarsim.simulator.rig import Rig
from lidarview.render.theme import INK, LINE, MUTED, OBJECT_COLORS

# m²/m³, and meters of a canopy: a leaf area index of 1.8
DENSITY = 0.6
HIGH = 3.0
KINDS = {"planophile": 0, "spherical": 2, "erectophile": 1}
GREEN = OBJECT_COLORS[2]
BROWN = OBJECT_COLORS[7]
RAYS = 50_000

Real = NDArray[np.float64]


def with_effect(survey: Survey) -> Survey:
    """Return the survey with tree crowns that contain leaves."""
    leaves = Material("tree-*", 0.5, leaf_area_density=0.8)
    return replace(survey, materials=[leaves, Material("*")])


def cast(
    meshes: list[SceneMesh], sensor: Sensor, position: Any, materials: list[Material], seed: int = 0
) -> Any:
    survey = Survey(sensor, poses=[position], steps=1, materials=materials, noise=Noise(seed=seed))
    (batch,) = Rig(Scene.from_meshes(meshes), survey).cast(0, 1)
    return batch


def tree() -> list[SceneMesh]:
    """Create a tree crown, its trunk and the ground."""
    crown = trimesh.creation.icosphere(4, 1.0)
    shaped = np.asarray(crown.vertices) * (2.4, 2.4, 3.0) + (0, 0, 5.5)
    trunk = trimesh.creation.cylinder(0.2, 7.0, sections=16)
    return [
        SceneMesh("Crown", shaped, np.asarray(crown.faces)),
        SceneMesh("Trunk", np.add(trunk.vertices, (0, 0, 3.5)), np.asarray(trunk.faces)),
        box("Ground", (-60, -60, -1), (60, 60, 0)),
    ]


def section(axes: Any, leaves: Material, title: str) -> None:
    """Draw a vertical slice of a tree.

    The sensor is 9 m to the left of the tree.
    """
    head = Beams(np.radians(np.linspace(-14, 50, 160)))
    scan = cast(tree(), Sensor(head, Spin(2400, 360)), (-9, 0, 2), [leaves, Material("*", 0.3)])
    positions = scan.positions
    which = scan.object
    slice_ = (np.abs(positions[:, 1]) < 0.6) & (positions[:, 0] < 9)
    for number, color in ((2, MUTED), (0, GREEN), (1, BROWN)):
        shown = slice_ & (which == number)
        axes.plot(positions[shown, 0], positions[shown, 2], ".", ms=1.8, mew=0, color=color)
    angle = np.linspace(0, 2 * math.pi, 100)
    axes.plot(2.4 * np.cos(angle), 5.5 + 3 * np.sin(angle), color=INK, lw=0.6)
    axes.plot(-9, 2, "^", color=INK, ms=6)
    axes.set(xlim=(-9.8, 9), ylim=(-0.6, 9), aspect="equal", ylabel="z (m)")
    axes.set_title(title, fontsize=10, color=INK)


def canopy(kind: str, zenith_deg: float) -> Real:
    """Return the depths of leaf hits below the top of a canopy.

    Depths are fractions of the canopy's height, or NaN for rays through gaps.
    """
    meshes = [
        box("Leaves", (-90, -90, 0), (90, 90, HIGH)),
        box("Soil", (-99, -99, -2), (99, 99, -1)),
    ]
    sensor = Sensor(Beams(np.full(RAYS, math.radians(zenith_deg - 90))), Spin(1, 360))
    materials = [Material("Leaves", leaf_area_density=DENSITY, leaf_angle=kind), Material("*")]  # type: ignore[arg-type]
    seed = round(zenith_deg) + 100 * KINDS[kind]  # trees of their own
    scan = cast(meshes, sensor, (0, 0, HIGH + 5), materials, seed)
    depth = (scan.range * math.cos(math.radians(zenith_deg)) - 5) / HIGH
    return np.where(scan.object == 0, depth, np.nan)


def picture() -> Figure:
    """Plot cross sections of a tree, gap fractions and the depths of returns."""
    figure = Figure((13.5, 5.2), dpi=100, layout="constrained")
    grid = figure.add_gridspec(2, 3, width_ratios=[1.05, 1, 1])
    above = figure.add_subplot(grid[0, 0])
    below = figure.add_subplot(grid[1, 0])
    gaps = figure.add_subplot(grid[:, 1])
    depths = figure.add_subplot(grid[:, 2])
    section(above, Material("Crown", 0.5), "solid crown, a slice of 1.2 m")
    leaves = Material("Crown", 0.5, leaf_area_density=0.6)
    section(below, leaves, "leaves, 0.6 m²/m³")
    below.set(xlabel="x (m)")

    zeniths = np.linspace(0, 80, 81)
    tilts = np.arange(0, 81, 10.0)
    for kind, color in KINDS.items():
        cosine = np.cos(np.radians(zeniths))
        tau = mean_projection(kind, cosine) * DENSITY * HIGH / cosine
        shade = OBJECT_COLORS[color]
        gaps.plot(zeniths, np.exp(-tau), color=shade, lw=1.2, label=f"{kind}: exp(−G·LAI / cos θ)")
        simulated = [np.isnan(canopy(kind, tilt)).mean() for tilt in tilts]
        gaps.plot(tilts, simulated, "o", ms=4.5, mfc="none", color=shade, label="simulated")
        depth = canopy(kind, 40.0)
        slope = mean_projection(kind, np.array([math.cos(math.radians(40))]))[0]
        slope *= DENSITY * HIGH / math.cos(math.radians(40))
        counts, edges = np.histogram(depth[np.isfinite(depth)], 24, (0, 1))
        depths.stairs(counts / RAYS * 24, edges * HIGH, color=shade, lw=1)
        steps = np.linspace(0, 1, 60)
        depths.plot(steps * HIGH, slope * np.exp(-slope * steps), color=shade, lw=1.4, label=kind)
    gaps.set(
        xlabel="zenith angle θ (°)", ylabel="share of pulses that reach the ground", ylim=(0, None)
    )
    gaps.set_title("Gap fraction, leaf area index 1.8", fontsize=11, color=INK)
    gaps.legend(fontsize=8, frameon=False)
    depths.set(
        xlabel="depth below the top (m)",
        ylabel="density of returns, as a share of all pulses",
        xlim=(0, HIGH),
    )
    depths.set(ylim=(0, None))
    depths.set_title("First leaves at θ = 40°; lines: Beer–Lambert", fontsize=11, color=INK)
    depths.legend(fontsize=8, frameon=False)
    for axes in (above, below, gaps, depths):
        axes.tick_params(labelsize=8, colors=MUTED)
        axes.spines[:].set_color(LINE)
    return figure

"""Refraction of light in a pool: where the floor appears, and how much light it returns."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from benchmarks.fit_coverage import box
from matplotlib.figure import Figure
from numpy.typing import NDArray

from lidarpool import Beams, Material, Scene, SceneMesh, Sensor, Spin, Survey
from lidarsim.media.materials import fresnel
from lidarsim.simulator.rig import Rig
from lidarview.render.theme import INK, LINE, MUTED, OBJECT_COLORS
from lidarview.render.theme import SENSOR as RED

HEIGHT = 3.0
DEPTH = 2.0
INDEX = 1.33
LOSS = 0.15
FLOOR = 0.4
WALL = 0.5
BLUE = OBJECT_COLORS[4]
NADIRS = np.radians(np.linspace(-72, 72, 289))
SCANNER = Sensor(Beams(np.abs(NADIRS) - np.pi / 2, np.where(NADIRS < 0, np.pi, 0.0)), Spin(1, 360))

Real = NDArray[np.float64]


def with_effect(survey: Survey) -> Survey:
    """Return the survey with cars made of glass."""
    glass = Material("car-*", transparent="pass", refractive_index=1.5)
    return replace(survey, materials=[glass, Material("*")])


def pool() -> list[SceneMesh]:
    """Create a pool in the ground, with a step on one side."""
    return [
        # Into the walls, which light that goes straight on would miss otherwise.
        box("Water", (-5.3, -9, -DEPTH - 0.5), (5.3, 9, 0)),
        box("Floor", (-9, -9, -DEPTH - 1), (9, 9, -DEPTH)),
        box("Step", (2, -9, -DEPTH - 0.2), (9, 9, -1.2)),
        box("Left", (-9, -9, -DEPTH - 0.2), (-5, 9, 0.1)),
        box("Right", (5, -9, -DEPTH - 0.2), (9, 9, 0.1)),
    ]


def cast(meshes: list[SceneMesh], water: Material) -> tuple[Real, Real, Real, Real]:
    """Return x and z of all points, with the angles and energies of their beams."""
    survey = Survey(
        SCANNER,
        poses=[(0, 0, HEIGHT)],
        steps=1,
        columns=["intensity", "ray"],
        materials=[water, Material("*", FLOOR)],
    )
    (batch,) = Rig(Scene.from_meshes(meshes), survey, "numpy").cast(0, 1)
    points = batch  # a survey with water is cast by the host
    ray = points.pulse_returns.ray  # type: ignore[union-attr]
    positions = points.positions  # type: ignore[union-attr]
    return positions[:, 0], positions[:, 2], NADIRS[ray], points.intensity  # type: ignore[union-attr]


def picture() -> Figure:
    """Plot a cross section of the pool, and the energy received from its floor."""
    straight = Material("Water", transparent="pass")
    wet = Material("Water", transparent="pass", refractive_index=INDEX, attenuation_per_m=LOSS)
    figure = Figure((13.5, 4.7), dpi=100, layout="constrained")
    section, energies = figure.subplots(1, 2, width_ratios=[1.9, 1])
    section.axhspan(-9, 0, color=BLUE, alpha=0.12, lw=0)
    ground = [(-9, -9), (-9, 0.1), (-5, 0.1), (-5, -DEPTH), (2, -DEPTH), (2, -1.2), (5, -1.2),
              (5, 0.1), (9, 0.1), (9, -9)]  # fmt: skip
    section.fill(*zip(*ground, strict=True), color="#d9dde2", lw=0, zorder=2)
    x, z, _, _ = cast(pool(), straight)
    section.plot(x, z, ".", ms=5, mew=0, color=MUTED, zorder=4, label="without refraction")
    x, z, _, _ = cast(pool(), wet)
    section.plot(x, z, ".", ms=5, mew=0, color=RED, zorder=5, label="with refraction")
    angles = np.linspace(0, np.radians(58), 60)
    within = np.arcsin(np.sin(angles) / INDEX)
    air = HEIGHT / np.cos(angles)
    water = DEPTH / np.cos(within)
    apparent_range = air + INDEX * water
    for side in (-1, 1):
        visible_side = np.abs(HEIGHT * np.tan(angles) + DEPTH * np.tan(within)) < (
            5 if side < 0 else 2
        )
        section.plot(
            side * (apparent_range * np.sin(angles))[visible_side],
            (HEIGHT - apparent_range * np.cos(angles))[visible_side],
            color=INK,
            lw=1,
            zorder=6,
            label="floor by Snell's law" if side > 0 else None,
        )
    for nadir in np.radians([-20, -40]):
        down = np.arcsin(np.sin(nadir) / INDEX)
        top = HEIGHT * np.tan(nadir)
        foot = HEIGHT * np.tan(nadir) + DEPTH * np.tan(down)
        section.plot([0, top, foot], [HEIGHT, 0, -DEPTH], color=OBJECT_COLORS[1], lw=1, zorder=3)
        apparent_m = HEIGHT / np.cos(nadir) + INDEX * DEPTH / np.cos(down)
        line = [top, apparent_m * np.sin(nadir)], [0, HEIGHT - apparent_m * np.cos(nadir)]
        section.plot(*line, color=OBJECT_COLORS[1], lw=1, ls=":", zorder=6)
    section.plot(0, HEIGHT, "^", color=INK, ms=8, zorder=7)
    section.text(0.25, HEIGHT, "sensor", va="center", fontsize=8, color=INK)
    section.set(xlim=(-7.5, 7.5), ylim=(-3.4, 3.4), xlabel="x (m)", ylabel="z (m)", aspect="equal")
    section.set_title("a pool, 2 m deep, from 3 m above", fontsize=11, color=INK)
    section.legend(fontsize=8, frameon=False, loc="upper right")

    floor = box("Floor", (-90, -90, -DEPTH - 1), (90, 90, -DEPTH))
    plain = [box("Water", (-80, -80, -DEPTH - 0.5), (80, 80, 0)), floor]
    angles = np.radians(np.linspace(0, 72, 100))
    within = np.arcsin(np.sin(angles) / INDEX)
    air = HEIGHT / np.cos(angles)
    water = DEPTH / np.cos(within)
    tilt = np.cos(angles) / np.cos(within)
    area = (water + INDEX * air) * (tilt * water + INDEX * air / tilt)
    passes = 1 - fresnel(np.cos(angles), INDEX)
    exact = FLOOR * np.cos(within) * passes**2 * np.exp(-2 * LOSS * water) * 100 / area
    for material, color, name in ((straight, MUTED, "without"), (wet, RED, "with")):
        _, _, nadir, energy = cast(plain, material)
        shown = (nadir >= 0) & (np.arange(len(nadir)) % 6 == 0)
        energies.plot(
            np.degrees(nadir[shown]),
            energy[shown],
            "o",
            ms=4,
            mfc="none",
            color=color,
            label=f"simulated, {name} refraction",
        )
    energies.plot(np.degrees(angles), exact, color=INK, lw=1, label="Snell, Fresnel, Beer–Lambert")
    energies.set(xlabel="angle from nadir (°)", ylabel="energy of the floor", ylim=(0, None))
    energies.set_title("n = 1.33, attenuation 0.15 / m", fontsize=11, color=INK)
    energies.legend(fontsize=8, frameon=False)
    for axes in (section, energies):
        axes.tick_params(labelsize=8, colors=MUTED)
        axes.spines[:].set_color(LINE)
    return figure

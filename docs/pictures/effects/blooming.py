"""Blooming around retroreflectors."""

from __future__ import annotations

from dataclasses import replace
from statistics import NormalDist

import numpy as np
from docs.pictures.effects._receiver import BLUE, cast_scan, wall
from matplotlib.figure import Figure

from lidarpool import Beams, Material, Noise, Sensor, Spin, Survey

NOISE = Noise(detection_range_m=100, stray_light=2e-5)
SIGNS = [Material("S*", reflectance=1.0, retro=True), Material("*", reflectance=0.3)]
STEP_DEG = 0.1


def with_effect(survey: Survey) -> Survey:
    """Return the survey with stray light in a street with five retroreflective lamp posts."""
    posts = [f"lamp-{number}" for number in range(1, 6)]
    materials = [Material(posts, reflectance=1.0, retro=True), Material("*", reflectance=0.3)]
    return replace(survey, noise=NOISE, materials=materials)


def picture() -> Figure:
    """Plot a sign with and without stray light, and the fraction of rays that receive it."""
    across = np.arange(-4, 4.01, STEP_DEG)
    up = np.arange(-3, 3.01, STEP_DEG)
    grid = np.meshgrid(np.radians(up), np.radians(across), indexing="ij")
    beams = Beams(grid[0].reshape(-1), grid[1].reshape(-1))
    sensor = Sensor(beams, Spin(1, 360), 0.5, 150.0)
    sign = wall("S", 25.0, (-0.4, 0.4), (-0.4, 0.4))
    meshes = [sign, wall("Pole", 25.2, (-0.05, 0.05), (-3, -0.4)), wall("Back", 90.0)]
    figure = Figure((10, 3.3), layout="constrained", dpi=110)
    views = figure.subplots(1, 3, width_ratios=[1, 1, 1.05])
    for axes, noise, title in (
        (views[0], replace(NOISE, stray_light=0), "without"),
        (views[1], NOISE, "with blooming"),
    ):
        points = cast_scan(meshes, sensor, noise, materials=SIGNS)
        image = np.full(len(beams.elevation), np.nan)
        image[points["ray"]] = points["range"]
        shown = axes.imshow(
            image.reshape(len(up), -1),
            origin="lower",
            extent=(-4, 4, -3, 3),
            cmap="viridis_r",
            vmin=20,
            vmax=95,
        )
        axes.set_title(f"ranges, {title}", fontsize=10)
        axes.set(xlabel="azimuth, degrees", ylabel="elevation, degrees")
    figure.colorbar(shown, ax=views[1], label="m", shrink=0.8)
    # A sign far smaller than the angles, and nothing behind it.
    small = wall("S", 25.0, (-0.01, 0.01), (-0.01, 0.01))
    points = cast_scan([small, wall("B", -9)], sensor, NOISE, materials=SIGNS)
    lit = np.zeros(len(beams.elevation), bool)
    lit[points["ray"][points["cause"] == 4]] = True
    angles_deg = np.degrees(np.hypot(beams.elevation, beams.azimuth))
    edges = np.arange(0.1, 2.51, 0.1)
    rays, hits = (np.histogram(angles, edges)[0] for angles in (angles_deg, angles_deg[lit]))
    middle = (edges[1:] + edges[:-1]) / 2
    share = hits / rays
    error = np.sqrt(np.maximum(share * (1 - share), 0.25 / rays) / rays)
    strong = 220 * (10 / 25) ** 2 / NOISE.threshold
    axes = views[2]
    axes.errorbar(middle, share, error, fmt="o", ms=4, lw=0.8, color=BLUE, label="simulated")
    angle = np.linspace(0.1, 2.5, 200)
    cdf = NormalDist().cdf
    curve = [cdf(5 * (strong * NOISE.stray_light / a**2 - 1)) for a in angle]
    axes.plot(angle, curve, "k-", lw=1, label="Φ(5 (s E / (T θ²) − 1))")
    radius = (strong * NOISE.stray_light) ** 0.5
    axes.axvline(radius, color="k", ls=":", lw=1)
    axes.text(radius + 0.04, 0.75, f"√(s E / T) = {radius:.2f}°", fontsize=8)
    axes.set(xlabel="angle from the sign, degrees", ylabel="share of rays with stray light")
    axes.legend(frameon=False, fontsize=8)
    axes.set_title("sign at 25 m, s = 2·10⁻⁵ at 1°", fontsize=10)
    axes.grid(alpha=0.25)
    return figure

"""Wet ground: a water film on surfaces that face up."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from docs.pictures.effects._receiver import BLUE, GRAY, RED, cloud, points, wall
from matplotlib.figure import Figure

from lidarpool import Beams, Material, Noise, Returns, Scene, SceneMesh, Sensor, Spin, Survey
from lidarsim.media.materials import WATER_INDEX, fresnel, wet_surface_factor

ROAD = 0.2


def with_effect(survey: Survey) -> Survey:
    return replace(survey, wet=1.0)


def picture() -> Figure:
    """Plot a dry and a wet road from the side, and reflectance over the angle of incidence."""
    figure = Figure((12, 4.4), layout="constrained", dpi=100)
    views = figure.subplot_mosaic([["dry", "right"], ["wet", "right"]], width_ratios=[1.5, 1])
    corners = np.array([[-90, -90, -2], [90, -90, -2], [90, 90, -2], [-90, 90, -2.0]])
    road = SceneMesh("Road", corners, np.array([[0, 1, 2], [0, 2, 3]]))
    sign = wall("Sign", 9, (-0.6, 0.6), (0.3, 1.3))
    house = wall("House", 30, z=(-2, 3))
    scene = Scene.from_meshes([road, sign, house])
    beams = Beams(np.radians(np.arange(-60, 8.5, 0.2)))
    survey = Survey(
        Sensor(beams, Spin(3600, 1), 0.5, 90.0),
        poses=[(0, 0, 0)],
        steps=1,
        materials=[Material("Road", ROAD), Material("*", 0.8)],
        noise=Noise(detection_range_m=100),
        returns=Returns("all"),
        columns=("cause", "reflectance", "elevation"),
        keep_every=1,
        precision_m=0.001,
    )
    for name, share in (("dry", 0.0), ("wet", 1.0)):
        columns = cloud(scene, replace(survey, wet=share))
        axes = views[name]
        x = columns["x"]
        z = columns["z"] + 2
        ghost = columns["cause"] == 5
        for which, color, label in ((~ghost, GRAY, "surfaces"), (ghost, RED, "ghosts")):
            shown = f"{label}: {which.sum():,}"
            axes.plot(x[which], z[which], ".", ms=3, mew=0, color=color, label=shown)
        axes.plot(0, 2, "^", color=BLUE, ms=7)
        axes.set(xlim=(-1, 34), ylim=(-6, 6), xlabel="x (m)", ylabel="z (m)", title=name)
        axes.legend(fontsize=8, loc="lower left", framealpha=0.9, markerscale=4)
        if name == "wet":
            road_columns = points([road], replace(survey, wet=share))
            steep = 90 + road_columns["elevation"][:: len(x) // 400]
            shown = road_columns["reflectance"][:: len(x) // 400]
            views["right"].plot(steep, shown, "o", ms=4, color=BLUE)
    angle = np.radians(np.linspace(0, 89.5, 400))
    dry = ROAD * np.cos(angle)
    axes = views["right"]
    axes.plot(np.degrees(angle), dry, color=GRAY, label="dry: ρ cos θ")
    wet = dry * wet_surface_factor(np.cos(angle), np.full(len(angle), ROAD))
    axes.plot(np.degrees(angle), wet, color=BLUE, label="wet: ρ cos θ T² / (n² (1 − p ρ))")
    mirrored = fresnel(np.cos(angle), WATER_INDEX) ** 2
    axes.plot(np.degrees(angle), mirrored, color=RED, label="ghost of a white wall: F²")
    axes.set(yscale="log", ylim=(3e-4, 1), xlabel="angle of incidence, degrees")
    axes.set(ylabel="reflectance", title="asphalt; dots simulated, lines closed form")
    axes.legend(fontsize=8, frameon=False)
    axes.grid(alpha=0.25)
    return figure

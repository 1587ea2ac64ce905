"""Spray behind vehicles on wet ground."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from docs.pictures.effects._receiver import BLUE, GRAY, RED, cloud
from matplotlib.figure import Figure

from lidarpool import (
    Actor,
    Beams,
    Noise,
    Optics,
    Returns,
    Scene,
    SceneMesh,
    Sensor,
    Spin,
    Survey,
    Track,
    load_sensor,
)
from lidarsim.media.weather import spray_clumps
from lidarsim.scene.actors import box

WEATHER = {"wet": 1.0, "spray_g_m3": 20.0}
NOISE = Noise(detection_range_m=90)
SPEED = 25.0
SPRAY = 6


def with_effect(survey: Survey) -> Survey:
    """Return the survey with spray and wet ground."""
    return replace(survey, noise=NOISE, **WEATHER)


def with_actors(scene: Scene) -> Scene:
    """Return the scene with two trucks that drive at 90 km/h."""
    return scene.with_actors([lorry("Near", (-20, 3.5)), lorry("Far", (-10, -3.5))])


def lorry(name: str, start: tuple[float, float], height: float = 0.0) -> Actor:
    """Create a truck that drives along x."""
    drive = Track(
        [0, 2], [[*start, height], [start[0] + 2 * SPEED, start[1], height]], beyond="hold"
    )
    return Actor(box(name, (9, 2.5, 3)), drive)


def picture() -> Figure:
    """Plot a truck and its spray from above and from the side, and how the spray decreases."""
    figure = Figure((12, 4.4), layout="constrained", dpi=100)
    views = figure.subplot_mosaic([["above", "right"], ["aside", "right"]], width_ratios=[1.5, 1])
    road = SceneMesh("Road", 80.0 * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]),
                     np.array([[0, 1, 2], [0, 2, 3]]))  # fmt: skip
    scene = Scene.from_meshes([road]).with_actors([lorry("Lorry", (8, -3.5))])
    sensor = load_sensor("ouster/os1-128", max_range_m=120)
    survey = Survey(sensor, poses=[(-8, 0, 1.9)], steps=36, keep_every=1, precision_m=0.001)
    columns = cloud(scene, replace(survey, noise=NOISE, **WEATHER))
    wet = columns["cause"] == SPRAY
    for name, axis in (("above", "y"), ("aside", "z")):
        for which, color, label in ((~wet, GRAY, "surfaces"), (wet, RED, "spray")):
            views[name].plot(
                columns["x"][which],
                columns[axis][which],
                ".",
                ms=2.5,
                mew=0,
                color=color,
                label=f"{label}: {which.sum():,}",
            )
        views[name].plot(-8, 0 if axis == "y" else 1.9, "^", color=BLUE, ms=7)
        limits = (-8, 3) if axis == "y" else (-0.3, 4)
        views[name].set(xlim=(-25, 18), ylim=limits, xlabel="x (m)", ylabel=f"{axis} (m)")
        views[name].set_aspect("equal")
    views["above"].legend(fontsize=8, loc="upper left", framealpha=0.9, markerscale=4)
    views["above"].set_title("a truck at 90 km/h, 20 g/m³, from above", fontsize=10)
    views["aside"].set_title("from the side", fontsize=10)
    # Beams across the way, 8 m from its middle, at places behind the lorry.
    count = 4000
    behind = np.arange(0.5, 28, 0.75)
    shares = []
    ahead = Sensor(
        Beams(np.zeros(count), np.full(count, math.pi / 2)),
        Spin(1, 360),
        0.5,
        60.0,
        optics=Optics(divergence_mrad=3.0),
    )
    rear = replace(scene, actors=(lorry("Lorry", (4.5, 8), -1.5),))
    for x in behind:
        across = Survey(
            ahead,
            poses=[(-x, 0, 0)],
            steps=1,
            keep_every=1,
            noise=NOISE,
            returns=Returns("all", pulse_ns=0),
            **WEATHER,
        )
        shares.append((cloud(rear, across)["cause"] == SPRAY).sum() / count)
    axes = views["right"]
    axes.plot(behind, shares, "o", ms=4, color=BLUE, label="simulated")
    kind = spray_clumps(20.0)
    air = across.air(0)
    span = np.linspace(8 - 1.25, 8 + 1.25, 200)
    full_rate = float(np.trapezoid(air.particle_rate(kind, NOISE.threshold, span), span))
    distance_m = np.linspace(0, 28, 1000)
    age = np.ceil(distance_m / (SPEED / 10)) / 10
    curve = full_rate * np.exp(-age / 0.4) * (age <= 1.3)
    axes.plot(distance_m, curve, color=GRAY, label="Poisson's mean, boxes of 0.1 s")
    axes.plot(
        distance_m,
        full_rate * np.exp(-distance_m / SPEED / 0.4),
        ":",
        color=GRAY,
        label="exp(−x / 10 m)",
    )
    axes.set(
        xlabel="distance behind the truck (m)", ylabel="returns of a beam across", xlim=(0, 28)
    )
    axes.set_title("a beam from 8 m to the side", fontsize=10)
    axes.legend(fontsize=8, frameon=False)
    axes.grid(alpha=0.25)
    return figure

"""Plots of returns from the air: a street from above, and comparisons with closed forms."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from statistics import NormalDist
from typing import Any

import numpy as np
from docs.pictures.effects._street import survey_without
from matplotlib.figure import Figure
from numpy.typing import NDArray

from lidarpool import Noise, Returns, Scene, SceneMesh, Survey
from lidarscenes.procedural.city import city
from lidarsim.media.weather import FAINTEST
from lidarsim.sensor.noise import THRESHOLD_SIGMAS
from lidarsim.simulator.rig import Rig
from lidarview.render.theme import INK, LINE, MUTED, OBJECT_COLORS, SENSOR

NOISE = Noise(detection_range_m=90)
SURFACE = "#8b96a5"
AIR = SENSOR
CURVE = INK
TURNS = 20

Real = NDArray[np.float64]


def in_weather(survey: Survey, **weather: Any) -> Survey:
    """Return the survey in this weather. The detection range of its sensor is 90 m."""
    return replace(survey, noise=NOISE, **weather)


def points(scene: Scene, survey: Survey) -> dict[str, Real]:
    """Simulate a survey and return the position, range, intensity and cause of all points."""
    batches = list(Rig(scene, survey).cast(0, survey.scan_count))
    columns = {
        "cause": [
            np.zeros(len(b)) if b.pulse_returns.cause is None else b.pulse_returns.cause
            for b in batches
        ],
        "range": [b.pulse_returns.distance for b in batches],
        "intensity": [b.intensity for b in batches],
        "x": [b.positions[:, 0] for b in batches],
        "y": [b.positions[:, 1] for b in batches],
    }
    return {name: np.concatenate(values) for name, values in columns.items()}


def page(title: str, weather: dict[str, Any], reach_m: float) -> tuple[Figure, Any]:
    """Draw the street from above, without and with the weather.

    The third plot of the figure is returned empty.
    """
    figure = Figure((13.5, 4.7), dpi=100, layout="constrained")
    clear, wet, right = figure.subplots(1, 3, width_ratios=[1, 1, 1.25])
    scene = city(20_000)
    survey = in_weather(survey_without())
    for axes, options, words in ((clear, {}, "clear air"), (wet, weather, title)):
        cloud = points(scene, replace(survey, **options))
        air = cloud["cause"] == 1
        dot = 1.8 if air.sum() > 2000 else 3.5
        for which, color, label, ms in ((~air, SURFACE, "surfaces", 1.2), (air, AIR, "air", dot)):
            name = f"{label}: {which.sum():,}"
            axes.plot(
                cloud["x"][which], cloud["y"][which], ".", ms=ms, mew=0, color=color, label=name
            )
        axes.set(xlim=(-reach_m, reach_m), ylim=(-reach_m, reach_m), aspect="equal")
        axes.set(xlabel="x (m)", ylabel="y (m)")
        axes.set_title(words, fontsize=11, color=INK)
        axes.legend(loc="upper right", fontsize=8, markerscale=8, framealpha=0.9)
    for axes in (clear, wet, right):
        axes.tick_params(labelsize=8, colors=MUTED)
        axes.spines[:].set_color(LINE)
    return figure, right


def sky() -> Scene:
    """Create a scene that contains only a small, distant triangle."""
    corner = np.array([[0, 0, -900], [1, 0, -900], [0, 1, -900.0]])
    return Scene.from_meshes([SceneMesh("Nothing", corner, np.array([[0, 1, 2]]))])


def counts(axes: Any, weather: dict[str, Any], farthest_m: float) -> None:
    """Plot the number of returns against range, with the closed form.

    The pulses are fired into the open sky.
    """
    separate = Returns("all", pulse_ns=0)
    survey = replace(in_weather(survey_without()), steps=TURNS * 36, returns=separate, **weather)
    cloud = points(sky(), survey)
    edges = np.linspace(survey.sensor.min_range_m, farthest_m, 41)
    axes.hist(cloud["range"], edges, color=AIR, alpha=0.55, label="simulated")
    air = survey.air(0)
    (kind,) = survey.particles
    noise = survey.noise
    middle = np.linspace(edges[0], farthest_m, 400)
    size = np.linspace(0, kind.largest, 1500)[1:]
    # Of the light, at most as much as one that fills the beam.
    share = np.minimum(size / (1000 * air.beam_diameter(middle[:, None])), 1) ** 2
    signal = kind.reflectance * air.white_energy(middle[:, None]) * share / noise.threshold
    grid = np.linspace(-3, 12, 3001)
    detected = np.interp(
        THRESHOLD_SIGMAS * (signal - 1), grid, [NormalDist().cdf(x) for x in grid]
    ) * (signal >= FAINTEST)
    density = kind.number * np.exp(-kind.slope * size) * (size[1] - size[0])
    rate = math.pi / 4 * air.beam_diameter(middle) ** 2 * (detected * density).sum(axis=1)
    bin_m = edges[1] - edges[0]
    axes.plot(middle, rate * survey.ray_count * bin_m, color=CURVE, lw=1.6, label="closed form")
    axes.set(xlim=(0, farthest_m), xlabel="range (m)")
    axes.set_ylabel(f"returns in {100 * bin_m:.0f} cm of range")
    title = f"{len(cloud['range']):,} returns of {survey.ray_count:,} pulses into the sky"
    axes.set_title(title, fontsize=11, color=INK)
    axes.legend(fontsize=9, framealpha=0.9)


def energies(axes: Any, weather: dict[str, Any]) -> None:
    """Plot energies against range, with the closed forms for surfaces and for the air."""
    survey = replace(in_weather(survey_without()), **weather)
    cloud = points(city(20_000), survey)
    air = cloud["cause"] == 1
    for which, color, label in ((~air, SURFACE, "surfaces"), (air, AIR, "air")):
        axes.plot(
            cloud["range"][which],
            cloud["intensity"][which],
            ".",
            ms=2,
            mew=0,
            color=color,
            label=f"simulated: {label}",
            rasterized=True,
        )
    distance = np.geomspace(0.5, 100, 400)
    alpha = survey.extinction(survey.sensor)
    white = 0.5 * (10 / distance) ** 2
    axes.plot(distance, white, color=CURVE, lw=1, ls=":", label="surface of 50 %, clear air")
    attenuated = white * np.exp(-2 * alpha * distance)
    axes.plot(distance, attenuated, color=CURVE, lw=1.4, label="surface of 50 %, here")
    scatters = survey.backscatter_at(survey.sensor.optics.wavelength_nm)
    half = 0.299792458 * survey.sensor.optics.pulse_ns / 2
    from_air = survey.air(0).backscatter_energy(scatters, distance - half / 2, distance + half / 2)
    axes.plot(distance, from_air, color=OBJECT_COLORS[1], lw=1.8, label="half a pulse of the air")
    axes.axhline(NOISE.threshold, color=MUTED, lw=1, ls="--", label="detection threshold")
    axes.set(xscale="log", yscale="log", xlim=(0.5, 100), ylim=(1e-4, 300))
    axes.set(xlabel="range (m)", ylabel="energy (white surface at 10 m: 1)")
    axes.set_title("energies of the returns", fontsize=11, color=INK)
    for shown in axes.legend(fontsize=8, framealpha=0.9).legend_handles[:2]:
        shown.set_markersize(9)


def save(figure: Figure, path: Path) -> None:
    """Write a plot as an image with few colors."""
    import io

    from PIL import Image

    png = io.BytesIO()
    figure.savefig(png, format="png")
    Image.open(png).convert("RGB").quantize(64).save(path, optimize=True)

"""Weather that returns light: maps of a street, and comparisons with closed-form solutions."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from statistics import NormalDist
from typing import Any

import numpy as np
from docs.pictures.effects._receiver import cloud
from docs.pictures.effects._street import survey_without
from matplotlib.figure import Figure

from lidarpool import Noise, Returns, Scene, SceneMesh, Survey
from lidarscenes.procedural.city import city
from lidarsim.media.weather import FAINTEST
from lidarsim.sensor.noise import THRESHOLD_SIGMAS
from lidarview.render.theme import INK, LINE, MUTED, OBJECT_COLORS, SENSOR

NOISE = Noise(detection_range_m=90)
SURFACE = "#8b96a5"
AIR = SENSOR
CURVE = INK
TURNS = 20


def page(title: str, weather: dict[str, Any], reach_m: float) -> tuple[Figure, Any]:
    """Plot the street from above in clear air and in the given weather.

    Return the figure and its empty third axes.
    """
    figure = Figure((13.5, 4.7), dpi=100, layout="constrained")
    clear, wet, right = figure.subplots(1, 3, width_ratios=[1, 1, 1.25])
    scene = city(20_000)
    survey = replace(survey_without(), noise=NOISE)
    for axes, options, words in ((clear, {}, "clear air"), (wet, weather, title)):
        points = cloud(scene, replace(survey, **options))
        air = points["cause"] == 1
        dot = 1.8 if air.sum() > 2000 else 3.5
        for which, color, label, ms in ((~air, SURFACE, "surfaces", 1.2), (air, AIR, "air", dot)):
            name = f"{label}: {which.sum():,}"
            axes.plot(
                points["x"][which], points["y"][which], ".", ms=ms, mew=0, color=color, label=name
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
    """Return a scene that is empty except for a small, remote triangle."""
    corner = np.array([[0, 0, -900], [1, 0, -900], [0, 1, -900.0]])
    return Scene.from_meshes([SceneMesh("Nothing", corner, np.array([[0, 1, 2]]))])


def counts(axes: Any, weather: dict[str, Any], farthest_m: float) -> None:
    """Plot the number of returns from the open sky over range, with the closed-form solution."""
    separate = Returns("all", pulse_ns=0)
    survey = replace(survey_without(), noise=NOISE, steps=TURNS * 36, returns=separate, **weather)
    points = cloud(sky(), survey)
    edges = np.linspace(survey.sensor.min_range_m, farthest_m, 41)
    axes.hist(points["range"], edges, color=AIR, alpha=0.55, label="simulated")
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
    title = f"{len(points['range']):,} returns of {survey.ray_count:,} pulses into the sky"
    axes.set_title(title, fontsize=11, color=INK)
    axes.legend(fontsize=9, framealpha=0.9)


def energies(axes: Any, weather: dict[str, Any]) -> None:
    """Plot energies over range, with the closed-form solutions for surfaces and air."""
    survey = replace(survey_without(), noise=NOISE, **weather)
    points = cloud(city(20_000), survey)
    air = points["cause"] == 1
    for which, color, label in ((~air, SURFACE, "surfaces"), (air, AIR, "air")):
        axes.plot(
            points["range"][which],
            points["intensity"][which],
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
    scatters = survey.backscatter_at(survey.sensor.optics.simulated_nm)
    half = 0.299792458 * survey.sensor.optics.pulse_ns / 2
    from_air = survey.air(0).backscatter_energy(scatters, distance - half / 2, distance + half / 2)
    axes.plot(distance, from_air, color=OBJECT_COLORS[1], lw=1.8, label="half a pulse of the air")
    axes.axhline(NOISE.threshold, color=MUTED, lw=1, ls="--", label="detection threshold")
    axes.set(xscale="log", yscale="log", xlim=(0.5, 100), ylim=(1e-4, 300))
    axes.set(xlabel="range (m)", ylabel="energy (white surface at 10 m: 1)")
    axes.set_title("energies of the returns", fontsize=11, color=INK)
    for shown in axes.legend(fontsize=8, framealpha=0.9).legend_handles[:2]:
        shown.set_markersize(9)


@dataclass(frozen=True)
class Weather:
    """Weather condition that can be simulated and plotted."""

    options: dict[str, float]  # of a survey
    title: str
    reach_m: float  # half the side of the maps
    farthest_m: float = 0.0  # in the diagram of counts; 0 for a diagram of energies

    def with_effect(self, survey: Survey) -> Survey:
        """Return the survey in this weather.

        The sensor detects surfaces with 10 % reflectance at up to 90 m.
        """
        return replace(survey, noise=NOISE, **self.options)

    def picture(self) -> Figure:
        """Plot a street from above, and the number or the energies of returns over range."""
        figure, right = page(self.title, self.options, self.reach_m)
        if self.farthest_m:
            counts(right, self.options, self.farthest_m)
        else:
            energies(right, self.options)
        return figure


WEATHER = {
    "dust": Weather({"dust_mg_m3": 100.0}, "100 mg/m³ of dust", 25.0),
    "fog": Weather({"visibility_km": 0.05}, "fog, 50 m of visibility", 25.0),
    "rain": Weather({"rain_mm_h": 50.0}, "50 mm/h of rain", 12.0, 6.0),
    "snow": Weather({"snow_mm_h": 1.0}, "1 mm/h of snow", 20.0, 16.0),
}

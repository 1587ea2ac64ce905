"""Sensor faults: range images of a street, and a wall that a vehicle approaches."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from docs.pictures.effects._receiver import BLUE, GRAY, RED, wall
from docs.pictures.effects._street import survey_without
from matplotlib.figure import Figure

from lidarpool import Fault, Scene, Sensor, Survey, Track
from lidarscenes.procedural.city import city
from lidarsim.simulator.rig import Rig

DIRT = Fault("dirt", azimuth_deg=(60, 130), elevation_deg=(-25, 5), transmission=0.3)
DEAD = Fault("dead_channels", channels=[20, 21, 40])
LOST = Fault("dropped_packets", share=0.1, packet=16)
SPEED_M_S = 5.0
SECONDS = 4.0


def with_effect(survey: Survey) -> Survey:
    """Return the survey with all faults that change points of single sweeps."""
    return replace(survey, faults=[DIRT, DEAD, LOST, Fault("time_jump", by_s=-0.5)])


def image(survey: Survey) -> np.ndarray:
    """Return the intensities of a revolution (channels, firings), with NaN for missing returns."""
    first = survey.scan(0).firings[0]
    stop = survey.scan(survey.scan_count - 1).firings[1]
    intensities = np.full((survey.sensor.channels, stop - first), np.nan)
    for batch in Rig(city(20_000), survey).cast(0, survey.scan_count):
        intensities[batch.channel, batch.firing - first] = batch.intensity
    return intensities


def approach(*faults: Fault) -> tuple[np.ndarray, np.ndarray]:
    """Return timestamps in seconds, and ranges measured by a vehicle that approaches a wall."""
    sensor = Sensor.grid(10, 1, 1, step_deg=360, horizontal_fov_deg=1)
    track = Track([0, SECONDS], [(0, 0, 0), (SPEED_M_S * SECONDS, 0, 0)])
    survey = Survey(sensor, trajectory=track, columns=["time"], faults=faults)
    batches = [*Rig(Scene.from_meshes([wall("W", 30)]), survey).cast(0, survey.scan_count)]
    return (
        np.concatenate([batch.time for batch in batches]) / 1e9,
        np.concatenate([batch.range for batch in batches]),
    )


def picture() -> Figure:
    """Plot how faults affect range images and ranges over time."""
    figure = Figure((11, 5.2), layout="constrained", dpi=100)
    images, charts = figure.subfigures(1, 2, width_ratios=[1.7, 1])
    bare = survey_without()
    shown = {
        "without faults": (),
        "dirt: 30 % of the energy return, from 60° to 130°, below 5°": [DIRT],
        "dead channels 20, 21 and 40": [DEAD],
        "10 % of the packets of 16 firings are lost": [LOST],
    }
    for axes, (title, faults) in zip(
        images.subplots(4, 1, sharex=True), shown.items(), strict=True
    ):
        values = image(replace(bare, faults=faults))
        axes.imshow(
            np.log10(values),
            cmap="viridis",
            vmin=-2.5,
            vmax=0.5,
            aspect="auto",
            origin="lower",
            interpolation="nearest",
        )
        axes.set_title(title, fontsize=9, loc="left")
        axes.set_yticks([0, 32, 63])
        axes.tick_params(labelsize=7)
    axes.set_xlabel("firing within a revolution", fontsize=8)
    (axes,) = charts.subplots(1, 1, squeeze=False)[0]
    frozen = Fault("frozen", 1, 2)
    for faults, color, words in (
        ((), GRAY, "without faults"),
        ((frozen,), BLUE, "frozen from 1 to 2 s"),
        ((Fault("time_jump", 2.5, by_s=0.5),), RED, "time jump by 0.5 s at 2.5 s"),
    ):
        axes.plot(*approach(*faults), ".", ms=2 if faults else 5, color=color, label=words)
    axes.set(xlabel="timestamp, s", ylabel="range of a wall ahead, m")
    axes.set_title(f"a vehicle at {SPEED_M_S:g} m/s", fontsize=9)
    axes.legend(frameon=False, fontsize=8, markerscale=4)
    axes.grid(alpha=0.25)
    return figure

"""Range images with rays that hit nothing and rays whose returns are lost."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

import matplotlib
import numpy as np
from benchmarks.odometry import cloud_of
from matplotlib.colors import ListedColormap, LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from lidarfiles.clouds.writing import ExportSpec
from lidarpool import Material, Noise, Survey, load_sensor
from lidarscenes.procedural.city import city
from lidarsim.scene.scene import Scene

SKY = "#dfe5ec"
LOST = "#e0182d"
MATERIALS = (
    *(Material(f"{tree}*", 0.45) for tree in ("Birch", "Maple", "Oak", "Pine", "Spruce")),
    Material("building-*", 0.35),
    Material("pavement", 0.25), Material("ground", 0.1), Material("*", 0.12),
)  # fmt: skip
NOISE = Noise(detection_range_m=45, dropout=0.01)


def with_effect(survey: Survey) -> Survey:
    """Return the survey with the columns that range images require."""
    return replace(survey, columns=(*survey.columns, "ray", "range"))


def image_of(scene: Scene, survey: Survey) -> dict[str, np.ndarray]:
    """Return the channels of the range image of the first sweep."""
    cloud = cloud_of(survey, scene)
    with tempfile.TemporaryDirectory() as folder:
        ExportSpec("images").write(Path(folder, "images"), cloud, cloud.sweeps())
        return dict(np.load(Path(folder, "images/lidar/000000.npz")).items())


def picture() -> Figure:
    """Plot the range image of an OS1-128 with and without a detection threshold."""
    scene = city(200_000, trees=60, cars=60)
    sensor = load_sensor("ouster/os1-128", max_range_m=170)
    survey = with_effect(Survey(sensor, poses=[(45, 1, 2)], steps=36, materials=MATERIALS))
    clear = image_of(scene, survey)
    noisy = image_of(scene, replace(survey, noise=NOISE))

    figure = Figure((11, 5.2), dpi=110)
    norm = LogNorm(3, 170)
    shown = (
        (clear, "every hit returns"),
        (noisy, "10 % of reflectance detected to 45 m, 1 % of the returns lost"),
    )
    # The beams of a firing look to four sides, so each row has an order of its own; the left of the
    # sensor is on the left.
    order = np.argsort(-clear["azimuth"], axis=1)
    extent = (360.0, 0.0, *np.degrees(sensor.beams.elevation[[0, -1]]))
    for number, (image, title) in enumerate(shown):
        axes = figure.add_axes((0.062, 0.56 - 0.44 * number, 0.835, 0.33))
        ranges, without = (
            np.take_along_axis(channels["range"], order, axis=1)[::-1]
            for channels in (image, clear)
        )
        hits = np.isfinite(without)
        lost = hits & np.isnan(ranges)
        axes.set_facecolor(SKY)
        axes.imshow(
            ranges,
            cmap="viridis_r",
            norm=norm,
            extent=extent,
            aspect="auto",
            interpolation="nearest",
        )
        axes.imshow(
            np.where(lost, 1.0, np.nan),
            cmap=ListedColormap([LOST]),
            extent=extent,
            aspect="auto",
            interpolation="nearest",
        )
        rays = ranges.size
        returned = int(np.isfinite(ranges).sum())
        axes.set_title(
            f"{title}: {rays:,} rays, {returned:,} returns, {int((~hits).sum()):,} hit nothing"
            + (f", {int(lost.sum()):,} lost" if lost.any() else ""),
            fontsize=9.5,
            loc="left",
        )
        axes.set_xticks(range(0, 361, 45))
        axes.set_yticks((-20, -10, 0, 10, 20))
        axes.set_ylabel("elevation (°)", fontsize=9)
        axes.tick_params(labelsize=8.5)
        if number:
            axes.set_xlabel("azimuth (°), counter-clockwise from the street", fontsize=9)
    bar = figure.add_axes((0.912, 0.12, 0.014, 0.77))
    scale = matplotlib.cm.ScalarMappable(norm, "viridis_r")
    figure.colorbar(scale, bar, ticks=(3, 5, 10, 20, 50, 100, 170), format="%g")
    bar.set_ylabel("range (m)", fontsize=9)
    bar.tick_params(labelsize=8.5)
    keys = [
        Line2D([], [], marker="s", ls="", color=color, mec="#9aa4b0", mew=0.5, label=words)
        for color, words in ((SKY, "no return: nothing within range"), (LOST, "return lost"))
    ]
    figure.legend(handles=keys, loc="upper right", ncols=2, fontsize=9, frameon=False)
    figure.text(0.062, 0.957, "Range image of a turn of an OS1-128", fontsize=12, weight="bold")
    return figure

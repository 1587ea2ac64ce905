"""Waveforms at a roof edge and in a tree, with the returns found by three receivers."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from lidarpool import Beams, Material, Optics, Pose, Returns, Scene, SceneMesh, Sensor, Spin, Survey
from lidarscenes.procedural.plants import SPECIES, tree
from lidarsim.columns.cloud import Cloud
from lidarsim.columns.table import AXES, SCAN
from lidarsim.columns.waveforms import WAVEFORM
from lidarsim.sensor.optics import FWHM, LIGHT_M_NS
from lidarsim.simulator.points.batch_columns import columns_of
from lidarsim.simulator.rig import Rig

_HEIGHT_M = 300.0
_PULSE_NS = 5.0
_COLUMNS = ["range", "intensity", "amplitude", "pulse_width"]
_LANES = {
    "none": ("half a pulse, c τ / 2", "#7f7f7f", "s"),
    "peaks": ("peaks", "#d95f02", "^"),
    "gaussian": ("gaussian", "#1b6ca8", "o"),
}


def with_effect(survey: Survey) -> Survey:
    """Return the survey with 19 sub-rays per beam and returns from a Gaussian decomposition."""
    returns = Returns("all", subrays=19, waveform="gaussian")
    return replace(survey, returns=returns)


def _pulse_points(
    scene: Scene, position: tuple[float, float], samples: int = 0, **returns: Any
) -> Cloud:
    """Return the points of a pulse fired straight down."""
    sensor = Sensor(Beams(np.zeros(1)), Spin(1, 360), optics=Optics(divergence_mrad=2.5))
    options = {"subrays": 217, "pulse_ns": _PULSE_NS, "mode": "all", **returns}
    survey = Survey(
        sensor,
        poses=[Pose((*position, _HEIGHT_M), pitch_deg=90)],
        steps=1,
        columns=_COLUMNS,
        materials=[Material("*", 0.4)],
        returns=Returns(**options),
        precision_m=1e-3,
        waveform_samples=samples,
    )
    part = columns_of(list(Rig(scene, survey).cast(0, 1)))
    table = (SCAN, *(c for c in survey.stored_columns if c not in AXES and c.name != WAVEFORM))
    return part.cloud(table, survey.precision_m, np.zeros(3))


def _flat(name: str, height: float, x: tuple[float, float]) -> SceneMesh:
    corners = [[x[0], -9, height], [x[1], -9, height], [x[1], 9, height], [x[0], 9, height]]
    return SceneMesh(name, np.array(corners, float), np.array([[0, 1, 2], [0, 2, 3]]))


def _panel(
    axes: Any, scene: Scene, position: tuple[float, float], span: tuple[float, float]
) -> None:
    """Draw a pulse's waveform over height, its components, and the returns of all receivers."""
    hits = _pulse_points(scene, position, pulse_ns=0.001)
    clouds = {name: _pulse_points(scene, position, 160, waveform=name) for name in _LANES}
    waves = clouds["gaussian"].waveforms
    heights = _HEIGHT_M - waves.times_ns[0] * LIGHT_M_NS / 2
    top = waves.samples[0].max()
    axes.vlines(
        _HEIGHT_M - hits["range"],
        0,
        hits["intensity"] / top,
        color="#9ecf9e",
        lw=1.2,
        label="hits of sub-rays",
        zorder=1,
    )
    axes.plot(heights, waves.samples[0] / top, ".", color="black", ms=4, zorder=4, label="samples")
    fine = np.linspace(*span, 800)
    finer = _pulse_points(scene, position, 1600, waveform="peaks", sample_ns=0.1).waveforms
    axes.plot(
        _HEIGHT_M - finer.times_ns[0] * LIGHT_M_NS / 2,
        finer.samples[0] / top,
        color="black",
        lw=1,
        label="waveform",
    )
    parts = clouds["gaussian"]
    for row in range(len(parts)):
        sigma_m = parts["pulse_width"][row] / FWHM * LIGHT_M_NS / 2
        middle = _HEIGHT_M - parts["range"][row]
        bell = parts["amplitude"][row] / top * np.exp(-0.5 * ((fine - middle) / sigma_m) ** 2)
        label = "fitted Gaussians" if row == 0 else None
        axes.plot(fine, bell, color=_LANES["gaussian"][1], lw=1, ls="--", label=label)
    for lane, (name, (_, color, marker)) in enumerate(_LANES.items()):
        heights_of_returns = _HEIGHT_M - clouds[name]["range"]
        axes.axhline(-0.10 - 0.11 * lane, color="#dddddd", lw=0.8, zorder=0)
        axes.plot(
            heights_of_returns,
            np.full(len(heights_of_returns), -0.10 - 0.11 * lane),
            marker,
            color=color,
            ms=6,
        )
    axes.set(xlim=span[::-1], ylim=(-0.42, 1.08), xlabel="height above ground, m")
    axes.set_yticks([0, 0.25, 0.5, 0.75, 1])
    axes.spines[["top", "right"]].set_visible(False)


def picture() -> Figure:
    """Plot waveforms and returns at the edge of a roof and in an oak."""
    figure = Figure((10, 4.2), layout="constrained", dpi=110)
    edge_axes, tree_axes = figure.subplots(1, 2, width_ratios=(1, 1.5), sharey=True)
    step = Scene.from_meshes([_flat("Terrace", 0.0, (-9, 9)), _flat("Roof", 0.68, (-9, 0.03))])
    _panel(edge_axes, step, (0.0, 0.0), (-1.2, 2.0))
    edge_axes.set_title("roof edge 0.68 m above a terrace", fontsize=10)
    edge_axes.set_ylabel("received power, relative to the highest sample")
    oak = tree(SPECIES[0])
    wood = Scene.from_meshes([_flat("Ground", 0.0, (-20, 20)), oak])
    _panel(tree_axes, wood, (2.8, 2.0), (-1.5, 14.5))
    tree_axes.set_title("an oak", fontsize=10)
    for axes in (edge_axes, tree_axes):
        for lane, (label, color, _) in enumerate(_LANES.values()):
            left_limit = axes.get_xlim()[0]
            axes.annotate(
                label,
                (left_limit, -0.10 - 0.11 * lane),
                color=color,
                fontsize=8,
                va="bottom",
                xytext=(2, 1),
                textcoords="offset points",
            )
    tree_axes.legend(fontsize=8, frameon=False)
    figure.suptitle(
        "One pulse of 5 ns (FWHM) from 300 m, 0.75 m wide on the ground, and its returns",
        fontsize=11,
    )
    return figure

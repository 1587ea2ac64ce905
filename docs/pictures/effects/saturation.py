"""Saturation: pulses that fill the receiver."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from docs.pictures.effects._receiver import BLUE, GREY, RED, ahead, shot, wall
from matplotlib.figure import Figure
from numpy.typing import NDArray

from lidarpool import Material, Noise, Returns, Scene, Survey
from lidarsim.columns.table import AXES, SCAN
from lidarsim.columns.waveforms import WAVEFORM
from lidarsim.sensor.optics import LIGHT_M_NS
from lidarsim.simulator.batch import columns_of
from lidarsim.simulator.rig import Rig

DRAWS = "effect-saturation.png"
NOISE = Noise(detection_range_m=100, saturation=100)  # full by a white wall 31.6 m away
PULSE_NS = 5.0
MATERIALS = {
    "W": [Material("*", 1.0)],
    "Sign": [Material("Sign", 1.0, retro=True), Material("*", 1.0)],
}
COLUMNS = ("range", "intensity", "amplitude", "pulse_width", "object")


def on(survey: Survey) -> Survey:
    """Switch it on."""
    return replace(survey, noise=NOISE)


def _wave(place: float, noise: Noise) -> tuple[NDArray, NDArray]:
    """Range and height of samples of the waveform of a white wall."""
    survey = Survey(
        ahead(1), poses=[(0, 0, 0)], steps=1, materials=MATERIALS["W"], noise=noise,
        columns=COLUMNS, returns=Returns(waveform="peaks", sample_ns=0.25), waveform_samples=160,
    )  # fmt: skip
    part = columns_of(list(Rig(Scene.from_meshes([wall("W", place)]), survey, "numpy").cast(0, 1)))
    table = (SCAN, *(c for c in survey.stored_columns if c not in AXES and c.name != WAVEFORM))
    waves = part.cloud(table, survey.precision_m, np.zeros(3)).waveforms
    return waves.times_ns[0] * LIGHT_M_NS / 2, waves.samples[0]


def _told_apart(name: str, place: float) -> tuple[float, float]:
    """Signal over saturation of a plate before a wall, and how far behind it that is seen."""
    beam = Returns("all", subrays=61, divergence_mrad=1)
    options = {"materials": MATERIALS[name], "returns": beam, "columns": COLUMNS}
    near = 0.1
    far = 10.0
    while far - near > 0.005:
        behind = (near + far) / 2
        meshes = [wall(name, place, y=(-50, 0.0)), wall("Wall", place + behind)]
        found = shot(meshes, ahead(1), NOISE, **options)
        near, far = (near, behind) if len(found["range"]) == 2 else (behind, far)
    return found["intensity"][0] / NOISE.full, far


def picture(path: Path) -> None:
    """Draw a clipped pulse; widths and ranges, and what is told apart, on closed forms."""
    figure = Figure((11, 3.7), layout="constrained", dpi=110)
    pulse, wide, apart = figure.subplots(1, 3)
    pulse.axhline(1, color="k", lw=0.8, ls=":")
    for place, colour in ((8.0, RED), (31.6, BLUE), (50.0, GREY)):
        where, high = _wave(place, NOISE)
        label = f"white wall at {place:g} m"
        pulse.plot(where - place, high / NOISE.full, color=colour, lw=1.5, label=label)
        where, high = _wave(place, replace(NOISE, saturation=None))
        pulse.plot(where - place, high / NOISE.full, color=colour, lw=0.8, ls="--")
    pulse.set(ylim=(-0.1, 2.2), xlim=(-1.5, 1.5), xlabel="range − true range, m",
              ylabel="signal / saturation")  # fmt: skip
    pulse.legend(frameon=False, fontsize=8, loc="upper right")
    pulse.set_title("recorded pulses (dashed: without)", fontsize=10)

    ratio = np.geomspace(0.1, 1e5, 200)
    closed = PULSE_NS * np.sqrt(1 + np.log2(np.maximum(ratio, 1)))
    kinds = ("W", BLUE, np.geomspace(1, 90, 9)), ("Sign", RED, np.geomspace(3, 90, 6))
    shift = wide.twinx()
    for name, colour, places in kinds:
        for place in places:
            given = {"materials": MATERIALS[name], "columns": COLUMNS}
            found = shot([wall(name, place)], ahead(1), NOISE, **given)
            over = found["intensity"] / NOISE.full
            wide.plot(over, found["pulse_width"], "o", ms=5, color=colour)
            waves = Returns(waveform="peaks")
            found = shot([wall(name, place)], ahead(1), NOISE, returns=waves, **given)
            shift.plot(over, found["range"] - place, "s", ms=4, mfc="none", color=colour)
    wide.plot(ratio, closed, "k-", lw=1, zorder=0)
    shift.plot(ratio, -LIGHT_M_NS / 4 * (closed - PULSE_NS), "k--", lw=1, zorder=0)
    wide.set(xscale="log", ylim=(0, 25), ylabel="pulse width, ns (filled)")
    shift.set(ylim=(-1.5, 1.0), ylabel="range − true range in waveforms, m (open)")
    wide.set_title("5 ns pulses on walls and signs", fontsize=10)

    found_at = [(_told_apart(name, place), colour) for name, colour, places in kinds
                for place in places[3:]]  # fmt: skip
    for (over, behind), colour in found_at:
        apart.plot(over, behind, "o", ms=5, color=colour)
    apart.plot(ratio, LIGHT_M_NS / 4 * (closed + PULSE_NS), "k-", lw=1, zorder=0,
               label="wall not clipped")  # fmt: skip
    apart.plot(
        ratio, LIGHT_M_NS / 2 * closed, "k--", lw=1, zorder=0, label="wall as strong as the plate"
    )
    apart.set(xscale="log", ylim=(0, 4), ylabel="least distance behind the plate, m")
    apart.legend(frameon=False, fontsize=8, loc="upper left")
    apart.set_title("a wall told apart behind a plate", fontsize=10)
    for axes in (wide, apart):
        axes.set_xlabel("signal / saturation")
    for axes in (pulse, wide, apart):
        axes.grid(alpha=0.25)
    figure.savefig(path)

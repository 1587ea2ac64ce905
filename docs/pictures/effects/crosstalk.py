"""Crosstalk between the sensors of a survey."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from docs.pictures.effects._receiver import BLUE, GREY, RED, WIDE_RAD, points, room, turning
from matplotlib.figure import Figure
from numpy.typing import NDArray

from lidarpool import Material, Mounted, Noise, Pose, Returns, SceneMesh, Survey
from lidarsim.sensor.optics import Mode

DRAWS = "effect-crosstalk.png"
NOISE = Noise(detection_range_m=100, crosstalk=True)
TURNS = 10
FIRINGS = 20_000
OTHER_HZ = 9.63
LIGHT_M_NS = 0.299792458


def on(survey: Survey) -> Survey:
    """Switch it on, with a second sensor of the same kind, whose scans are cast as well."""
    # of a turn
    sensor = survey.sensor
    third_ns = 1e9 / 3 / 10
    sensors = [
        Mounted(sensor, name="one", noise=NOISE),
        Mounted(replace(sensor, start_ns=third_ns), Pose((1.5, 0, 0)), name="other"),
    ]
    return replace(survey, sensors=sensors)


def heard(
    meshes: list[SceneMesh], away: float, wide_mrad: float, mode: Mode = "strongest"
) -> dict[str, NDArray[Any]]:
    """Cast a sensor that hears another, so many metres away, in a field of view so wide."""
    one = turning(FIRINGS)
    other = turning(FIRINGS - 300, OTHER_HZ, clockwise=True)
    one = replace(one, optics=replace(one.optics, divergence_mrad=wide_mrad))
    survey = Survey(
        sensors=[
            Mounted(one, Pose((-away / 2, 0, 0)), "one", noise=NOISE),
            Mounted(other, Pose((away / 2, 0, 0)), "other"),
        ],
        poses=[(0, 0, 0)],
        steps=TURNS,
        materials=[Material("*", 0.5)],
        returns=Returns(mode),
        columns=("range", "cause"),
        keep_every=1,
    )
    found = points(meshes, survey)
    own = found["sensor"] == 0
    return {name: values[own] for name, values in found.items()}


def picture(path: Path) -> None:
    """Draw what a sensor sees of another in a room, and counts against the closed form."""
    figure = Figure((9, 3.9), layout="constrained", dpi=110)
    above, counts = figure.subplots(1, 2, width_ratios=[1.25, 1])
    found = heard(room(25, 15), 8.0, 1000 * WIDE_RAD)
    x = 0.01 * found["x"]
    y = 0.01 * found["y"]
    wrong = found["cause"] == 3
    above.plot(x[~wrong], y[~wrong], ".", ms=0.6, color=GREY)
    above.plot(x[wrong], y[wrong], ".", ms=4, color=RED, label=f"{wrong.sum()} pulses of B")
    for place, name in ((-4, "A"), (4, "B")):
        above.plot(place, 0, "^", color="k", ms=4)
        above.text(place, -12, name, fontsize=9, ha="center")
    above.set(aspect="equal", xlabel="x, m", ylabel="y, m")
    above.legend(frameon=False, fontsize=8, loc="upper left")
    above.set_title(f"points of A in {TURNS} turns, walls in grey", fontsize=10)
    wide = np.array([2.0, 5, 10, 20, 40])
    gate_ns = 2 * (150 - 0.5) / LIGHT_M_NS
    waits = gate_ns * 1e-9 * (FIRINGS - 300) * OTHER_HZ  # pulses of B while A waits
    expected = TURNS * FIRINGS * wide / 1000 / (2 * np.pi) * waits
    every = [heard(room(25, 25), 0.0, each, "all")["cause"] == 3 for each in wide]
    seen = np.array([one.sum() for one in every])
    counts.errorbar(wide, seen, seen**0.5, fmt="o", ms=4, lw=0.8, color=BLUE, label="simulated")
    counts.plot(wide, expected, "k-", lw=1, label="pulses · φ / 2π · waiting time · rate of B")
    counts.set(xscale="log", yscale="log", xlabel="field of view φ, mrad")
    counts.set_xticks(wide, [f"{each:g}" for each in wide])
    counts.set_yticks([10, 20, 50, 100, 200], ["10", "20", "50", "100", "200"])
    counts.minorticks_off()
    counts.set_ylabel("pulses of B that A receives")
    counts.legend(frameon=False, fontsize=8)
    counts.set_title("A and B at one place", fontsize=10)
    counts.grid(alpha=0.25)
    figure.savefig(path)

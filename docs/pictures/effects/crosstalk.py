"""Crosstalk between the sensors of a survey."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from docs.pictures.effects._receiver import BLUE, GRAY, RED, WIDE_RAD, points, room, spinning_beam
from matplotlib.figure import Figure
from numpy.typing import NDArray

from lidarpool import Material, Mounted, Noise, Pose, Returns, SceneMesh, Survey
from lidarsim.sensor.optics import Mode

NOISE = Noise(detection_range_m=100, crosstalk=True)
REVOLUTIONS = 10
FIRINGS = 20_000
OTHER_HZ = 9.63
LIGHT_M_NS = 0.299792458


def with_effect(survey: Survey) -> Survey:
    """Return the survey with crosstalk from a second sensor of the same kind."""
    sensor = survey.sensor
    third_ns = 1e9 / 3 / 10  # of a revolution
    sensors = [
        Mounted(sensor, name="one", noise=NOISE),
        Mounted(replace(sensor, start_ns=third_ns), Pose((1.5, 0, 0)), name="other"),
    ]
    return replace(survey, sensors=sensors)


def cast_pair(
    meshes: list[SceneMesh], distance_m: float, field_mrad: float, mode: Mode = "strongest"
) -> dict[str, NDArray[Any]]:
    """Simulate a sensor that receives pulses of a second sensor, and return its columns."""
    receiver = spinning_beam(FIRINGS)
    emitter = spinning_beam(FIRINGS - 300, OTHER_HZ, clockwise=True)
    receiver = replace(receiver, optics=replace(receiver.optics, divergence_mrad=field_mrad))
    survey = Survey(
        sensors=[
            Mounted(receiver, Pose((-distance_m / 2, 0, 0)), "one", noise=NOISE),
            Mounted(emitter, Pose((distance_m / 2, 0, 0)), "other"),
        ],
        poses=[(0, 0, 0)],
        steps=REVOLUTIONS,
        materials=[Material("*", 0.5)],
        returns=Returns(mode),
        columns=("range", "cause"),
        keep_every=1,
    )
    columns = points(meshes, survey)
    of_receiver = columns["sensor"] == 0
    return {name: values[of_receiver] for name, values in columns.items()}


def picture() -> Figure:
    """Plot the pulses that a sensor receives from another sensor, and their expected number."""
    figure = Figure((9, 3.9), layout="constrained", dpi=110)
    above, counts = figure.subplots(1, 2, width_ratios=[1.25, 1])
    columns = cast_pair(room(25, 15), 8.0, 1000 * WIDE_RAD)
    x = 0.01 * columns["x"]
    y = 0.01 * columns["y"]
    foreign = columns["cause"] == 3
    above.plot(x[~foreign], y[~foreign], ".", ms=0.6, color=GRAY)
    above.plot(x[foreign], y[foreign], ".", ms=4, color=RED, label=f"{foreign.sum()} pulses of B")
    for x_m, name in ((-4, "A"), (4, "B")):
        above.plot(x_m, 0, "^", color="k", ms=4)
        above.text(x_m, -12, name, fontsize=9, ha="center")
    above.set(aspect="equal", xlabel="x, m", ylabel="y, m")
    above.legend(frameon=False, fontsize=8, loc="upper left")
    above.set_title(f"points of A in {REVOLUTIONS} revolutions, walls in gray", fontsize=10)
    fields_mrad = np.array([2.0, 5, 10, 20, 40])
    gate_ns = 2 * (150 - 0.5) / LIGHT_M_NS
    waits = gate_ns * 1e-9 * (FIRINGS - 300) * OTHER_HZ  # pulses of B while A waits
    expected = REVOLUTIONS * FIRINGS * fields_mrad / 1000 / (2 * np.pi) * waits
    foreign_masks = [
        cast_pair(room(25, 25), 0.0, field_mrad, "all")["cause"] == 3 for field_mrad in fields_mrad
    ]
    pulses = np.array([mask.sum() for mask in foreign_masks])
    counts.errorbar(
        fields_mrad, pulses, pulses**0.5, fmt="o", ms=4, lw=0.8, color=BLUE, label="simulated"
    )
    counts.plot(
        fields_mrad, expected, "k-", lw=1, label="pulses · φ / 2π · waiting time · rate of B"
    )
    counts.set(xscale="log", yscale="log", xlabel="field of view φ, mrad")
    counts.set_xticks(fields_mrad, [f"{field_mrad:g}" for field_mrad in fields_mrad])
    counts.set_yticks([10, 20, 50, 100, 200], ["10", "20", "50", "100", "200"])
    counts.minorticks_off()
    counts.set_ylabel("pulses of B that A receives")
    counts.legend(frameon=False, fontsize=8)
    counts.set_title("A and B at one place", fontsize=10)
    counts.grid(alpha=0.25)
    return figure

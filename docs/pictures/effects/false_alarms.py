"""False alarms in a yard, and in front of and behind a wall."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from docs.pictures.effects._receiver import (
    BLUE,
    GRAY,
    RED,
    cast_scan,
    fixed_beams,
    points,
    room,
    wall,
)
from matplotlib.figure import Figure

from lidarpool import Material, Noise, Returns, Survey, load_sensor

NOISE = Noise(detection_range_m=100, false_alarm_hz=2e4)
GATE_M = 150.0
WALL_M = 90.0
RAYS = 60_000
LIGHT_M_S = 299_792_458.0


def with_effect(survey: Survey) -> Survey:
    return replace(survey, noise=NOISE)


def picture() -> Figure:
    """Plot a VLP-16 revolution in a yard, and false alarms in front of and behind a wall."""
    figure = Figure((9, 3.9), layout="constrained", dpi=110)
    above, lies = figure.subplots(1, 2, width_ratios=[1, 1.15])
    sensor = load_sensor("velodyne/vlp16", max_range_m=100)
    survey = Survey(sensor, poses=[(0, 0, 0)], steps=36, noise=NOISE, columns=["cause"])
    columns = points(room(30, 18, 3), survey)
    x, y = (survey.precision_m * columns[axis] for axis in ("x", "y"))
    alarm = columns["cause"] == 2
    above.plot(x[~alarm], y[~alarm], ".", ms=1, color=GRAY, label="walls")
    above.plot(x[alarm], y[alarm], ".", ms=4, color=RED, label=f"{alarm.sum()} false alarms")
    above.set(aspect="equal", xlabel="x, m", ylabel="y, m", xlim=(-100, 100), ylim=(-100, 100))
    above.legend(frameon=False, fontsize=8, loc="upper right")
    above.set_title("one revolution of a VLP-16 in a yard, 20 kHz", fontsize=10)
    mean = 2 * NOISE.false_alarm_hz / LIGHT_M_S  # a meter
    edges = np.linspace(0, GATE_M, 31)
    middle = (edges[1:] + edges[:-1]) / 2
    step = edges[1]
    for mode, color, label in (("all", BLUE, "all returns"), ("first", RED, "first returns")):
        returns = cast_scan(
            [wall("W", WALL_M)],
            fixed_beams(RAYS, GATE_M),
            replace(NOISE, false_alarm_hz=2e5),
            returns=Returns(mode),  # type: ignore[arg-type]
            materials=[Material("*", 0.8)],
        )
        counts = np.histogram(returns["range"][returns["cause"] == 2], edges)[0]
        lies.errorbar(middle, counts, counts**0.5, fmt="o", ms=3, lw=0.8, color=color, label=label)
        rate = 10 * mean
        expected = RAYS * rate * step * np.ones(len(middle))
        if mode == "first":
            expected *= np.exp(-rate * middle) * (middle < WALL_M)
        lies.step(middle, expected, where="mid", color=color, lw=1)
    lies.axvline(WALL_M, color=GRAY, lw=1, ls="--")
    lies.text(WALL_M + 1, 40, "wall", color=GRAY, fontsize=8)
    lies.set(xlabel="range, m", ylabel="false alarms in 5 m, of 60,000 pulses", ylim=(0, None))
    lies.legend(frameon=False, fontsize=8, loc="lower left")
    lies.set_title("200 kHz: lines are the Poisson process", fontsize=10)
    lies.grid(alpha=0.25)
    return figure

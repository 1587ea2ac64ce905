"""Errors that last: of channels, while a sensor warms up, and of its encoder."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from docs.pictures.effects._air import save
from docs.pictures.effects._receiver import BLUE, GREY, RED, wall
from matplotlib.figure import Figure

from lidarpool import Noise, Scene, Sensor, Survey, load_sensor
from lidarsim.simulator.rig import Rig

DRAWS = "effect-lasting-errors.png"
NOISE = Noise(
    0.005, channel_bias_m=0.015, warm_up_m=0.03, warm_up_s=600, ripple_deg=0.05, ripple_cycles=2
)


def on(survey: Survey) -> Survey:
    """Switch them on, and no noise."""
    return replace(survey, noise=replace(NOISE, range_m=0.0))


def errors(sensor: Sensor, noise: Noise, **options: object) -> dict[str, np.ndarray]:
    """Errors of ranges of a wall 10 m ahead, by channel and time, seconds."""
    found = []
    for own in (Noise(), noise):
        survey = Survey(sensor, poses=[(0, 0, 0)], noise=own, columns=["range", "time"], **options)
        rig = Rig(Scene.from_meshes([wall("W", 10)]), survey)
        found.append([*rig.cast(0, survey.scan_count)])
    true, seen = [np.concatenate([one.range for one in each]) for each in found]
    return {
        "error": seen - true,
        "channel": np.concatenate([one.channel for one in found[0]]),
        "time": np.concatenate([one.time for one in found[0]]) / 1e9,
    }


def picture(path: Path) -> None:
    """Draw errors by channel, by time and by azimuth, beside the closed forms."""
    figure = Figure((11, 3.6), layout="constrained", dpi=100)
    left, middle, right = figure.subplots(1, 3)
    turn = errors(
        load_sensor("ouster/os1-64"), replace(NOISE, warm_up_m=0.0, ripple_deg=0.0), steps=36
    )
    left.plot(turn["channel"], 100 * turn["error"], ".", ms=1, color=GREY, label="returns")
    each = [turn["error"][turn["channel"] == k].mean() for k in range(64)]
    left.plot(100 * np.array(each), "o", ms=3.5, color=BLUE, label="mean of a channel")
    for sign in (-1, 1):
        left.axhline(100 * sign * NOISE.channel_bias_m, color="k", lw=0.8, ls=":")
    left.set(xlabel="channel", ylabel="error of range, cm")
    left.set_title("channel_bias_m: 0.015 (dotted)", fontsize=9)
    slow = Sensor.grid(20, 1, 1, step_deg=360, rate_hz=0.05, horizontal_fov_deg=1)
    warm = errors(slow, replace(NOISE, channel_bias_m=0.0, ripple_deg=0.0), steps=150)
    middle.plot(warm["time"] / 60, 100 * warm["error"], ".", ms=1.5, color=GREY, label="returns")
    closed = 100 * NOISE.warm_up_m * np.exp(-warm["time"] / NOISE.warm_up_s)
    middle.plot(warm["time"] / 60, closed, color=RED, lw=1.4, label=r"3 cm $e^{-t/600\,s}$")
    middle.set(xlabel="time since the start, min", ylabel="error of range, cm")
    middle.set_title("warm_up_m: 0.03, warm_up_s: 600", fontsize=9)
    azimuth = np.linspace(0, 360, 721)
    for cycles, colour in ((1, BLUE), (2, RED)):
        error = NOISE.ripple_deg * np.sin(np.radians(cycles * azimuth))
        right.plot(azimuth, error, color=colour, label=f"ripple_cycles: {cycles}", lw=1.2)
    found = ripple(2)
    right.plot(*found, ".", ms=3, color=GREY, label="simulated, 2", zorder=3)
    right.set(xlabel="azimuth, °", ylabel="true less reported azimuth, °")
    right.set_title("ripple_deg: 0.05", fontsize=9)
    for axes in (left, middle, right):
        axes.grid(alpha=0.25)
        axes.legend(framealpha=0.9, fontsize=8, loc="upper right")
    save(figure, path)


def ripple(cycles: int) -> tuple[np.ndarray, np.ndarray]:
    """Azimuths of beams, and by how much they are cast beside them: by ranges of a slanted wall."""
    noise = Noise(ripple_deg=NOISE.ripple_deg, ripple_cycles=cycles)
    corner = np.array([[-30, -8, -9], [30, -8, -9], [30, -8, 9], [-30, -8, 9.0]])
    azimuths = []
    errors_deg = []
    for turn in range(0, 360, 45):
        angle = np.radians(turn)
        spin = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0]])
        vertices = corner @ np.vstack([spin, [0, 0, 1]]).T
        scene = Scene.from_meshes([replace(wall("W", 8), vertices=vertices)])
        survey = Survey(Sensor.grid(240, 1, 1), poses=[(0, 0, 0)], steps=36, noise=noise)
        for found in Rig(scene, survey).cast(0, 36):
            # A beam at azimuth a meets y = -8 of the wall's axes at 8 / sin(-a).
            own = (np.radians(found.azimuth) - angle + np.pi) % (2 * np.pi) - np.pi
            steep = (own < -0.6) & (own > -1.2)
            true = -np.arcsin(8 / found.range[steep])
            azimuths.append(found.azimuth[steep])
            errors_deg.append(np.degrees(true - own[steep]))
    return np.concatenate(azimuths), np.concatenate(errors_deg)

"""Systematic errors caused by channels, warm-up and the encoder."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from docs.pictures.effects._receiver import BLUE, GRAY, RED, wall
from matplotlib.figure import Figure

from lidarpool import Noise, Scene, Sensor, Survey, load_sensor
from lidarsim.simulator.rig import Rig

NOISE = Noise(
    0.005, channel_bias_m=0.015, warm_up_m=0.03, warm_up_s=600, ripple_deg=0.05, ripple_cycles=2
)


def with_effect(survey: Survey) -> Survey:
    """Return the survey with systematic errors and no noise."""
    return replace(survey, noise=replace(NOISE, range_m=0.0))


def errors(sensor: Sensor, noise: Noise, **options: object) -> dict[str, np.ndarray]:
    """Return the range errors at a wall 10 m ahead, with their channels and times in seconds."""
    batches_by_noise = []
    for noise_of_run in (Noise(), noise):
        survey = Survey(
            sensor, poses=[(0, 0, 0)], noise=noise_of_run, columns=["range", "time"], **options
        )
        rig = Rig(Scene.from_meshes([wall("W", 10)]), survey)
        batches_by_noise.append([*rig.cast(0, survey.scan_count)])
    true, measured = [
        np.concatenate([batch.range for batch in batches]) for batches in batches_by_noise
    ]
    return {
        "error": measured - true,
        "channel": np.concatenate([batch.channel for batch in batches_by_noise[0]]),
        "time": np.concatenate([batch.time for batch in batches_by_noise[0]]) / 1e9,
    }


def picture() -> Figure:
    """Plot errors over channel, time and azimuth, with the closed-form solutions."""
    figure = Figure((11, 3.6), layout="constrained", dpi=100)
    by_channel, by_time, by_azimuth = figure.subplots(1, 3)
    revolution = errors(
        load_sensor("ouster/os1-64"), replace(NOISE, warm_up_m=0.0, ripple_deg=0.0), steps=36
    )
    by_channel.plot(
        revolution["channel"], 100 * revolution["error"], ".", ms=1, color=GRAY, label="returns"
    )
    channel_means = [revolution["error"][revolution["channel"] == k].mean() for k in range(64)]
    by_channel.plot(100 * np.array(channel_means), "o", ms=3.5, color=BLUE, label="channel mean")
    for sign in (-1, 1):
        by_channel.axhline(100 * sign * NOISE.channel_bias_m, color="k", lw=0.8, ls=":")
    by_channel.set(xlabel="channel", ylabel="range error, cm")
    by_channel.set_title("channel_bias_m: 0.015 (dotted)", fontsize=9)
    slow = Sensor.grid(20, 1, 1, step_deg=360, rate_hz=0.05, horizontal_fov_deg=1)
    warm = errors(slow, replace(NOISE, channel_bias_m=0.0, ripple_deg=0.0), steps=150)
    by_time.plot(warm["time"] / 60, 100 * warm["error"], ".", ms=1.5, color=GRAY, label="returns")
    closed = 100 * NOISE.warm_up_m * np.exp(-warm["time"] / NOISE.warm_up_s)
    by_time.plot(warm["time"] / 60, closed, color=RED, lw=1.4, label=r"3 cm $e^{-t/600\,s}$")
    by_time.set(xlabel="time since the start, min", ylabel="range error, cm")
    by_time.set_title("warm_up_m: 0.03, warm_up_s: 600", fontsize=9)
    azimuth = np.linspace(0, 360, 721)
    for cycles, color in ((1, BLUE), (2, RED)):
        error = NOISE.ripple_deg * np.sin(np.radians(cycles * azimuth))
        by_azimuth.plot(azimuth, error, color=color, label=f"ripple_cycles: {cycles}", lw=1.2)
    simulated = ripple(2)
    by_azimuth.plot(*simulated, ".", ms=3, color=GRAY, label="simulated, 2", zorder=3)
    by_azimuth.set(xlabel="azimuth, °", ylabel="true − reported azimuth, °")
    by_azimuth.set_title("ripple_deg: 0.05", fontsize=9)
    for axes in (by_channel, by_time, by_azimuth):
        axes.grid(alpha=0.25)
        axes.legend(framealpha=0.9, fontsize=8, loc="upper right")
    return figure


def ripple(cycles: int) -> tuple[np.ndarray, np.ndarray]:
    """Return azimuths and azimuth errors in degrees, computed from ranges to a slanted wall."""
    noise = Noise(ripple_deg=NOISE.ripple_deg, ripple_cycles=cycles)
    corner = np.array([[-30, -8, -9], [30, -8, -9], [30, -8, 9], [-30, -8, 9.0]])
    azimuths = []
    errors_deg = []
    for yaw_deg in range(0, 360, 45):
        angle = np.radians(yaw_deg)
        spin = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0]])
        vertices = corner @ np.vstack([spin, [0, 0, 1]]).T
        scene = Scene.from_meshes([replace(wall("W", 8), vertices=vertices)])
        survey = Survey(Sensor.grid(240, 1, 1), poses=[(0, 0, 0)], steps=36, noise=noise)
        for batch in Rig(scene, survey).cast(0, 36):
            # A beam at azimuth a meets y = -8 of the wall's axes at 8 / sin(-a).
            azimuth = (np.radians(batch.azimuth) - angle + np.pi) % (2 * np.pi) - np.pi
            steep = (azimuth < -0.6) & (azimuth > -1.2)
            true = -np.arcsin(8 / batch.range[steep])
            azimuths.append(batch.azimuth[steep])
            errors_deg.append(np.degrees(true - azimuth[steep]))
    return np.concatenate(azimuths), np.concatenate(errors_deg)

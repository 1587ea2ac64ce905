"""Allan deviations of a stationary vehicle's IMU, compared with closed-form solutions."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from lidarpool import Gnss, Imu, Navigation, Survey
from lidarsim.motion.navigation import gnss_fixes, imu_samples
from lidarview.render import theme

HOURS = 4
# Of an industrial MEMS unit, by order of magnitude: 0.2 degrees per root hour, 6 degrees an hour.
IMU = Imu(
    rate_hz=100,
    gyroscope_noise_density=6e-5,
    gyroscope_bias=3e-5,
    gyroscope_bias_time_s=60,
    gyroscope_random_walk=6e-7,
)
GNSS = Gnss(
    rate_hz=1, horizontal_m=0.02, vertical_m=0.04, drift_horizontal_m=0.6, drift_vertical_m=1.0,
    drift_time_s=600,
)  # fmt: skip


def with_effect(survey: Survey) -> Survey:
    """Return the survey with errors of the navigation instruments.

    The instruments do not affect the duration of stage 2.
    """
    return replace(survey, navigation=Navigation(imu=IMU, gnss=GNSS))


def allan(values: np.ndarray, size: int) -> tuple[float, int]:
    """Return the overlapping Allan deviation of the samples, and the number of disjoint clusters.

    The samples have shape (n, axes).
    """
    sums = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values, axis=0)])
    means = (sums[size:] - sums[:-size]) / size
    steps = means[size:] - means[:-size]
    return float(np.sqrt((steps**2).mean() / 2)), values.size // size


def parts(tau: np.ndarray) -> dict[str, np.ndarray]:
    """Compute the Allan deviations of the three processes (IEEE Std 952-1997, annex C)."""
    sigma = IMU.gyroscope_bias
    time = IMU.gyroscope_bias_time_s
    bracket = 1 - time / (2 * tau) * (3 - 4 * np.exp(-tau / time) + np.exp(-2 * tau / time))
    return {
        r"white noise, $N/\sqrt{\tau}$": IMU.gyroscope_noise_density / np.sqrt(tau),
        "Gauss-Markov bias": np.sqrt(2 * sigma**2 * time / tau * bracket),
        r"random walk, $K\sqrt{\tau/3}$": IMU.gyroscope_random_walk * np.sqrt(tau / 3),
    }


def outage(axes: Any, still: SimpleNamespace) -> None:
    """Plot an IMU's position errors during a 15 s outage, with the closed-form solution.

    Each seed is plotted as one line.
    """
    imu = Imu(accelerometer_bias=0.01, accelerometer_noise_density=0.02)
    gnss = Gnss(rate_hz=10, outages=[(10, 25)])
    for seed in range(40):
        navigation = Navigation(imu=imu, gnss=gnss, seed=seed)
        run = SimpleNamespace(**vars(still) | {"navigation": navigation, "duration_ns": 35e9})
        (block,) = gnss_fixes(run)
        axes.plot(block.times_ns / 1e9, block.positions[:, 0], color=theme.SENSOR, lw=0.5)
    t = np.clip(np.linspace(0, 35, 701) - 10, 0, 15)
    sigma = np.hypot(0.01 * t**2 / 2, 0.02 * np.sqrt(t**3 / 3))
    sigma *= np.exp(-np.clip(np.linspace(0, 35, 701) - 25, 0, None))
    for sign in (-1, 1):
        axes.plot(np.linspace(0, 35, 701), sign * sigma, color=theme.INK, lw=1.2)
    axes.set(xlabel="time, s", ylabel="position error, east, m", xlim=(5, 35))
    axes.set_title("40 outages from 10 to 25 s; black: one σ", fontsize=9)


def picture() -> Figure:
    """Plot Allan deviations, position errors over several hours, and errors during outages."""
    from lidarsim.motion.trajectory import CENTER, Stations

    still = SimpleNamespace(
        navigation=Navigation(imu=IMU, gnss=GNSS, seed=2),
        path=Stations((CENTER,)),
        duration_ns=HOURS * 3600e9,
        carrier="",
    )
    rates = np.concatenate([block.rates for block in imu_samples(still)])
    sizes = np.unique(np.geomspace(1, len(rates) / 9, 40).astype(int))
    tau = sizes / IMU.rate_hz
    deviations, clusters = np.array([allan(rates, size) for size in sizes.tolist()]).T
    figure = Figure(figsize=(13.4, 4.3), dpi=90, layout="constrained")
    gyroscopes, positions, outages = figure.subplots(1, 3, width_ratios=[1.2, 1.1, 1])
    outage(outages, still)
    to_hour = np.degrees(1) * 3600
    closed_forms = parts(tau)
    total = np.sqrt(sum(form**2 for form in closed_forms.values()))
    for (name, form), color in zip(closed_forms.items(), theme.OBJECT_COLORS, strict=False):
        gyroscopes.loglog(tau, form * to_hour, "--", color=color, lw=1, label=name)
    gyroscopes.loglog(tau, total * to_hour, color=theme.INK, lw=1.2, label="closed form, all three")
    one_sigma = deviations / np.sqrt(2 * np.maximum(clusters - 3, 1)) * to_hour
    gyroscopes.errorbar(
        tau,
        deviations * to_hour,
        one_sigma,
        fmt="o",
        ms=3.2,
        color=theme.SENSOR,
        lw=0.9,
        label=f"simulated, {HOURS} h at {IMU.rate_hz:.0f} Hz, 3 axes, 1 σ",
    )
    gyroscopes.set(
        xlabel="averaging time τ, s",
        ylabel="Allan deviation of angular velocity, °/h",
        ylim=(total.min() * to_hour / 6, None),
    )
    gyroscopes.set_title("gyroscopes of a stationary vehicle", fontsize=9)
    position_errors = np.concatenate([block.positions for block in gnss_fixes(still)])
    hours = np.arange(len(position_errors)) / GNSS.rate_hz / 3600
    colors = {"east": "#4477aa", "north": "#44aa77", "up": "#ee7733"}
    for axis, (name, color) in enumerate(colors.items()):
        positions.plot(hours, position_errors[:, axis], color=color, lw=0.5, label=name)
    for sign in (-1, 1):
        positions.axhline(sign * GNSS.drift_vertical_m, color="#ee7733", lw=0.8, ls=":")
        positions.axhline(sign * GNSS.drift_horizontal_m, color="#4477aa", lw=0.8, ls=":")
    positions.set(xlabel="time, h", ylabel="position error, m", xlim=(0, HOURS))
    positions.set_title("GNSS of the same vehicle; dotted: one σ of the drift", fontsize=9)
    for axes in (gyroscopes, positions, outages):
        axes.grid(color=theme.LINE, lw=0.5)
    gyroscopes.legend(fontsize=7.5, frameon=False, loc="upper right")
    for line in positions.legend(fontsize=7.5, frameon=False, loc="lower right").get_lines():
        line.set_linewidth(2)
    return figure

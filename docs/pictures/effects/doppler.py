"""Radial velocities measured at a crossing by the lidar of a moving car."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure

from lidarpool import Actor, Mounted, Noise, Pose, Survey, Track, load_sensor
from lidarscenes.procedural.cars import MODELS, car
from lidarscenes.procedural.city import city
from lidarsim.simulator.rig import Rig
from lidarview.render import theme
from lidarview.render.coloring import DIVERGING

DARK = "#3a3f47"
# meters a second: of the sensor's car, and of the measurement
SPEED = 8.0
NOISE = 0.05
# Start, speed and direction (degrees) of the other cars.
OTHERS = (((21, 3, 0), 10.0, 180), ((-3, 16, 0), 6.0, -90), ((14, -3, 0), 13.0, 0))
HEIGHT = 1.9
REACH = 36.0


def with_effect(survey: Survey) -> Survey:
    """Return the survey with radial velocities and a moving sensor."""
    drive = Track([0, 1], [[0, 0, HEIGHT], [SPEED, 0, HEIGHT]])
    return replace(
        survey,
        poses=(),
        trajectory=drive,
        columns=(*survey.columns, "radial_velocity"),
        noise=replace(survey.noise, velocity_m_s=NOISE),
    )


def picture() -> Figure:
    """Plot the points from above, and their radial velocities over azimuth."""
    trajectories = [
        Track([-1, 2], [start - t * np.array(v) for t in (1, -2)])
        for (start, speed, yaw) in OTHERS
        for v in [speed * np.array([np.cos(np.radians(yaw)), np.sin(np.radians(yaw)), 0])]
    ]
    cars = [
        Actor(car(MODELS[k % len(MODELS)]), replace(trajectory, start_s=0.0, duration_s=2.0))
        for k, trajectory in enumerate(trajectories)
    ]
    scene = city(60_000)
    standing = len(scene.names)
    survey = Survey(
        sensors=[Mounted(load_sensor("ouster/os1-64", max_range_m=120), Pose((0, 0, HEIGHT)))],
        trajectory=Track([0, 1], [[-9, -3, 0], [-9 + SPEED, -3, 0]]),
        steps=36,
        noise=Noise(velocity_m_s=NOISE),
    )
    (batch,) = Rig(scene.with_actors(cars), survey).cast(0, 36)
    positions = batch.positions
    velocity = batch.radial_velocity
    moving = batch.object >= standing
    azimuth = np.radians(batch.azimuth)
    azimuth = np.degrees((azimuth + np.pi) % (2 * np.pi) - np.pi)
    figure = Figure(figsize=(10.4, 5.0), dpi=90, layout="constrained")
    map_axes, chart = figure.subplots(1, 2, width_ratios=(1.12, 1))
    colors = ListedColormap(DIVERGING)
    order = np.argsort(moving, kind="stable")  # cars on top
    in_view = order[np.abs(positions[order, :2]).max(axis=1) < REACH]
    scale = {"cmap": colors, "vmin": -20, "vmax": 20, "linewidths": 0}
    sizes = np.where(moving, 5.0, 1.2)
    points = map_axes.scatter(
        *positions[in_view, :2].T, c=velocity[in_view], s=sizes[in_view], **scale
    )
    map_axes.set_facecolor(DARK)
    map_axes.annotate(
        "",
        (-9 + SPEED, -3),
        (-9, -3),
        arrowprops={"arrowstyle": "-|>", "color": "#ffd23f", "lw": 2},
    )
    map_axes.text(
        -9,
        -4.6,
        f"sensor, {SPEED:.0f} m/s",
        color="#ffd23f",
        ha="center",
        va="top",
        fontsize=8,
        bbox={"facecolor": DARK, "edgecolor": "none", "pad": 1.5},
    )
    for (_, speed, yaw), trajectory in zip(OTHERS, trajectories, strict=True):
        x, y, _ = trajectory.pose(0, 1e9).position
        dx, dy = np.round([np.cos(np.radians(yaw)), np.sin(np.radians(yaw))], 6)
        map_axes.annotate(
            "",
            (x + dx * (2.5 + 0.5 * speed), y + dy * (2.5 + 0.5 * speed)),
            (x + 2.5 * dx, y + 2.5 * dy),
            arrowprops={"arrowstyle": "-|>", "color": "white", "lw": 1.2},
        )
        side = 3.4 if dy == 0 and y > 0 else -3.4
        label_position = (x + 3.5, y) if dy else (x, y + side)
        map_axes.text(
            *label_position,
            f"{speed:.0f} m/s",
            color="white",
            ha="left" if dy else "center",
            va="center",
            fontsize=8,
            bbox={"facecolor": DARK, "edgecolor": "none", "pad": 1.5},
        )
    map_axes.set(
        xlim=(-REACH, REACH), ylim=(-REACH, REACH), aspect="equal", xlabel="x, m", ylabel="y, m"
    )
    figure.colorbar(
        points,
        ax=map_axes,
        label="radial velocity, m/s (blue: approaching)",
        location="bottom",
        shrink=0.85,
        pad=0.02,
        aspect=40,
    )
    level = np.cos(np.radians(batch.elevation))
    shown = np.flatnonzero((np.abs(batch.elevation) < 6) & ~moving)[::3]
    chart.scatter(azimuth[shown], velocity[shown], s=1, color=theme.MUTED, linewidths=0)
    for k, (_, speed, _) in enumerate(OTHERS):
        of_car = batch.object == standing + k
        color = theme.OBJECT_COLORS[(1, 2, 6)[k]]
        chart.scatter(azimuth[of_car], velocity[of_car], s=5, color=color, linewidths=0)
        if of_car.any():
            middle = azimuth[of_car].mean(), velocity[of_car].mean()
            chart.annotate(
                f"car, {speed:.0f} m/s",
                middle,
                (6, 8),
                textcoords="offset points",
                fontsize=8,
                color=color,
            )
    angle = np.linspace(-180, 180, 361)
    chart.plot(
        angle,
        -SPEED * np.cos(np.radians(angle)),
        "--",
        color=theme.SENSOR,
        lw=1.2,
        label="$-v\\,\\cos\\,$azimuth: stationary objects",
    )
    residual = velocity[~moving] + SPEED * np.cos(np.radians(azimuth[~moving])) * level[~moving]
    chart.set(
        xlim=(-180, 180),
        xticks=range(-180, 181, 60),
        xlabel="azimuth, degrees",
        ylabel="radial velocity, m/s",
    )
    chart.set_title(
        f"less than 6° above or below; deviation of stationary objects: {residual.std():.3f} m/s",
        fontsize=8.5,
    )
    map_axes.set_title("one revolution of an OS1-64, from above", fontsize=8.5)
    chart.grid(color=theme.LINE, lw=0.5)
    chart.legend(loc="lower left", fontsize=8, frameon=False)
    return figure

"""Walking pedestrian: points at four times, and velocities of arms and legs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure

from lidarpool import Actor, Scanner, Scene, Sensor, Survey, Track
from lidarsim.scene.actors import box, join_meshes
from lidarsim.scene.files.meshfile import load_objects
from lidarview.render.coloring import DIVERGING

PERSON = Path(__file__).parents[3] / "examples" / "pedestrian.glb"
# m at first, m/s towards the sensor
AWAY = 9.0
SPEED = 1.4
SECONDS = 2.2
RATE_HZ = 25
DARK = "#3a3f47"


def with_effect(survey: Survey) -> Survey:
    """Return the survey with radial velocities, which reveal the motion of walking people."""
    return replace(survey, columns=(*survey.columns, "radial_velocity"))


def picture() -> Figure:
    """Plot a pedestrian's points from the side, and their radial velocities over time."""
    mesh = join_meshes("Person", load_objects(PERSON, animation="Walk").static)
    assert mesh.animation is not None
    mesh = replace(mesh, animation=replace(mesh.animation, speed_m_s=SPEED))
    walk = Track([0, SECONDS + 1], [[AWAY, 0, 0], [AWAY - SPEED * (SECONDS + 1), 0, 0]])
    floor = box("Floor", (60, 60, 0.1))
    scene = Scene.from_meshes([replace(floor, vertices=floor.vertices - [0, 0, 0.1])])
    scene = scene.with_actors([Actor(mesh, walk)])
    sensor = Sensor.grid(1800, 64, vertical_fov_deg=24, horizontal_fov_deg=14, rate_hz=RATE_HZ)
    columns = ["radial_velocity", "object", "time"]
    scanner = Scanner(scene, sensor, columns=columns, precision_m=1e-3)
    sweeps = []
    for number in range(int(SECONDS * RATE_HZ)):
        cloud = scanner.sweep((0, 0, 1), number=number)
        of_person = cloud["object"] == 1
        columns_of = (cloud["time"][of_person] / 1e9, cloud["radial_velocity"][of_person])
        sweeps.append((cloud.positions[of_person], *columns_of))
    figure = Figure(figsize=(10.4, 4.2), dpi=90, layout="constrained")
    moments, chart = figure.subplots(1, 2, width_ratios=(1.3, 1))
    scale = {"cmap": ListedColormap(DIVERGING), "vmin": -5, "vmax": 5, "linewidths": 0}
    for k, number in enumerate((5, 11, 18, 24)):
        positions, _, velocity = sweeps[number]
        ahead = positions[:, 0] - (AWAY - SPEED * number / RATE_HZ)
        points = moments.scatter(1.5 * k + ahead, positions[:, 2], c=velocity, s=3, **scale)
        moments.text(
            1.5 * k, -0.16, f"{number / RATE_HZ:.2f} s", color="white", ha="center", size=8
        )
    moments.set_facecolor(DARK)
    moments.set(
        aspect="equal", xlabel="m; the sensor is on the left", ylabel="z, m", ylim=(-0.25, 1.9)
    )
    label = "radial velocity, m/s (blue: approaching)"
    figure.colorbar(points, ax=moments, label=label, location="bottom", shrink=0.85, aspect=40)
    all_positions, seconds, velocities = map(np.concatenate, zip(*sweeps, strict=True))
    light = {"s": 0.6, "cmap": "viridis", "linewidths": 0}
    shown = chart.scatter(seconds, velocities, c=all_positions[:, 2], **light)
    chart.axhline(-SPEED, color="black", lw=0.8, ls="--")
    chart.set(xlabel="time, s", ylabel="radial velocity, m/s", xlim=(0, SECONDS))
    figure.colorbar(shown, ax=chart, label="height, m", location="bottom", shrink=0.85, aspect=40)
    moments.set_title("one person in four sweeps, side view", fontsize=8.5)
    chart.set_title(f"all points; dashed: the person's own {SPEED} m/s", fontsize=8.5)
    return figure

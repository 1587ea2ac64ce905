"""Ghost points, which are caused by reflections in glass and paint."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from docs.pictures.effects._receiver import BLUE, GRAY, RED, cast_scan, cloud
from matplotlib.figure import Figure

from lidarpool import Beams, Material, Noise, Returns, Scene, SceneMesh, Sensor, Spin, Survey
from lidarsim.media.materials import fresnel
from lidarsim.scene.actors import box

PAINT = 0.04
DIRT = 0.1


def with_effect(survey: Survey) -> Survey:
    """Return the survey with cars and buildings that have weak specular reflections."""
    materials = [
        Material(["car-*", "building-*"], reflectance=0.3, specular_reflectance=PAINT),
        Material("*", reflectance=0.3),
    ]
    return replace(survey, materials=materials)


def upright(name: str, start: tuple[float, float], stop: tuple[float, float]) -> SceneMesh:
    """Return a wall between two positions that extends from 3 m below to 3 m above the sensor."""
    lower, upper = ([[*position, z] for position in (start, stop)] for z in (-3.0, 3.0))
    return SceneMesh(name, np.array([*lower, *upper]), np.array([[0, 1, 3], [0, 3, 2]]))


def picture() -> Figure:
    """Plot ghost points of a shop window from above, and energies over the angle of incidence."""
    figure = Figure((12, 4.4), layout="constrained", dpi=100)
    above, right = figure.subplots(1, 2, width_ratios=[1.5, 1])
    car, van = (
        replace(box(name, size), vertices=box(name, size).vertices + offset)
        for name, size, offset in (("Car", (4.4, 1.8, 3), (4.0, -3.5, -1.5)),
                                  ("Van", (2.0, 2.0, 3), (-4.5, 3.5, -1.5)))
    )  # fmt: skip
    meshes = [
        upright("Window", (-8, 7.5), (8, 7.5)),
        upright("Shop", (-8, 11), (8, 11)),
        upright("Street", (-9, -6), (9, -6)),
        car,
        van,
    ]
    glass = Material("Window", DIRT, transparent="pass", specular_reflectance="fresnel")
    turning = Sensor(Beams(np.radians([-4, 0, 4])), Spin(1800, 360), 0.5, 60.0)
    survey = Survey(
        turning,
        poses=[(0, 0, 0)],
        steps=1,
        materials=[glass, Material("*", 0.5)],
        returns=Returns("all"),
        columns=("cause",),
        keep_every=1,
        precision_m=0.001,
    )
    columns = cloud(Scene.from_meshes(meshes), survey)
    ghost = columns["cause"] == 5
    for which, color, label in ((~ghost, GRAY, "surfaces"), (ghost, RED, "ghosts")):
        name = f"{label}: {which.sum():,}"
        above.plot(columns["y"][which], -columns["x"][which], ".", ms=3, color=color, label=name)
    above.plot(0, 0, ">", color=BLUE, ms=8, label="sensor")
    labels = {
        (6.6, 8.3): "window",
        (11.3, 7): "shop",
        (-5.7, 6.5): "street",
        (-4.2, -5): "car",
        (2.6, 5.7): "van",
        (11.7, 3.9): "its ghost",
        (18, -5): "its ghost",
        (16.4, 6.2): "ghost of the street",
    }
    for offset, name in labels.items():
        above.annotate(name, offset, fontsize=8)
    above.set(
        aspect="equal", xlim=(-7, 22), ylim=(-9, 9.5), xlabel="forward (m)", ylabel="left (m)"
    )
    above.legend(fontsize=8, loc="lower left", framealpha=0.9, markerscale=1.5)
    above.set_title("a shop window from above, all returns", fontsize=10)
    degrees = np.arange(8, 88, 4)
    for angle in np.radians(degrees):
        mirrored_direction = np.array([-np.cos(2 * angle), np.sin(2 * angle)])
        side = 0.3 * np.array([-mirrored_direction[1], mirrored_direction[0]])
        mirrored_direction = np.array([10, 0]) + 6 * mirrored_direction
        edge = 3 * np.array([np.sin(angle), np.cos(angle)])
        glazing = upright("Window", (10 + edge[0], edge[1]), (10 - edge[0], -edge[1]))
        beside = upright(
            "Beside", tuple(mirrored_direction + side), tuple(mirrored_direction - side)
        )
        room = [glazing, beside, upright("Behind", (40, 1), (40, -1))]
        scan = cast_scan(
            room,
            Sensor(Beams(np.zeros(1)), Spin(1, 360), 0),
            Noise(),
            returns=Returns("all"),
            materials=[glass, Material("*", 1.0)],
            columns=("object", "reflectance"),
        )
        for number, color in ((0, GRAY), (1, RED), (2, BLUE)):
            reflectances = scan["reflectance"][scan["object"] == number]
            right.plot(
                [np.degrees(angle)] * len(reflectances), reflectances, "o", ms=4, color=color
            )
    angle = np.radians(np.linspace(0, 89, 300))
    mirrored = (1 - DIRT) * fresnel(np.cos(angle))
    right.plot(np.degrees(angle), DIRT * np.cos(angle), color=GRAY, label="dirt: ρ cos θ")
    right.plot(np.degrees(angle), mirrored**2, color=RED, label="ghost: ((1 − ρ) F)²")
    behind = (1 - DIRT - mirrored) ** 2
    right.plot(np.degrees(angle), behind, color=BLUE, label="behind: ((1 − ρ)(1 − F))²")
    right.set(yscale="log", ylim=(5e-4, 1.5), xlabel="angle of incidence, degrees")
    right.set_ylabel("reflectance of white walls")
    right.set_title("dirty glass; dots simulated, lines closed form", fontsize=10)
    right.legend(fontsize=8, frameon=False)
    right.grid(alpha=0.25)
    return figure

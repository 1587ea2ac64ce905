"""Gaussian and elliptical beams: footprints, light at an edge, and beam width over range."""

from __future__ import annotations

import math
from dataclasses import replace
from statistics import NormalDist
from typing import Any

import numpy as np
from docs.pictures.effects._receiver import wall
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse
from numpy.typing import NDArray

from lidarpool import Beams, Returns, Scene, Sensor, Spin, Survey
from lidarsim.sensor.disc import Beam
from lidarsim.simulator.rig import Rig
from lidarview.render.theme import INK, LINE, MUTED, OBJECT_COLORS
from raybeam import pattern_rays

OVAL = (3.0, 1.5)  # mrad, as Velodyne's manual of the VLP-16 has it
EXIT_M = 0.0125
SENSOR = Sensor(Beams(np.zeros(1)), Spin(1, 360))
EVEN, ROUND, WIDE = OBJECT_COLORS[:3]


def with_effect(survey: Survey) -> Survey:
    """Return the survey with 19 sub-rays per beam.

    The beam is Gaussian and elliptical, and starts with a large diameter.
    """
    beam = Returns(
        subrays=19, divergence_mrad=OVAL, beam_profile="gaussian", exit_diameter_m=EXIT_M
    )
    return replace(survey, returns=beam)


def footprint(returns: Returns, distance: float) -> NDArray[np.float64]:
    """Return where the sub-rays of a beam hit a wall, in horizontal and vertical meters (k, 2)."""
    scene = Scene.from_meshes([wall("Wall", distance)])
    rig = Rig(scene, Survey(SENSOR, poses=[(0, 0, 0)], steps=1, returns=returns), "numpy")
    beams = rig.pulse_casters[0].emitter.subrays_of(rig.pattern(0, 0, 1))
    starts, directions = pattern_rays(beams, np.arange(len(beams)), (0, 0, 0))
    hits = rig.scene_casters[0].caster.cast(starts, directions)
    points = starts + hits.distance[:, None] * directions
    return np.asarray(points[:, 1:])


def share(returns: Returns, edge_m: float) -> float:
    """Return the fraction of a pulse's light that hits a wall at 50 m.

    The light beyond the wall's edge hits another wall at 60 m.
    """
    meshes = [wall("Near", 50, (-50, edge_m)), wall("Far", 60)]
    survey = Survey(
        SENSOR, poses=[(0, 0, 0)], steps=1, returns=returns, columns=["reflectance", "range"]
    )
    (batch,) = Rig(Scene.from_meshes(meshes), survey, "numpy").cast(0, 1)
    assert not hasattr(batch, "columns")
    bright: Any = batch.reflectance  # type: ignore[union-attr]
    return float(bright[batch.object == 0].sum() / bright.sum())  # type: ignore[union-attr]


def picture() -> Figure:
    """Plot beam footprints, the fraction of light at an edge, and the beam width over range."""
    figure = Figure((13.5, 4.5), dpi=100, layout="constrained")
    prints, edges, widths = figure.subplots(1, 3, width_ratios=[0.8, 1, 1])
    kinds = (
        ("even, 3.0 mrad", EVEN, Returns(subrays=217, divergence_mrad=3.0)),
        ("Gaussian, 3.0 mrad", ROUND,
         Returns(subrays=217, divergence_mrad=3.0, beam_profile="gaussian")),
        ("Gaussian, 3.0 × 1.5 mrad", WIDE,
         Returns(subrays=217, divergence_mrad=OVAL, beam_profile="gaussian")),
    )  # fmt: skip
    for number, (label, color, returns) in enumerate(kinds):
        positions_cm = 100 * footprint(returns, 50.0)
        middle = 22.0 * (1 - number)
        prints.plot(
            positions_cm[:, 0], middle + positions_cm[:, 1], ".", ms=3.5, mew=0, color=color
        )
        tall = 7.5 if returns.divergence_mrad == OVAL else 15.0
        prints.add_patch(Ellipse((0, middle), 15.0, tall, fill=False, ec=INK, lw=0.8))
        prints.text(12, middle, label, va="center", fontsize=8, color=color)
    prints.plot([-7.5, 7.5], [-32, -32], color=INK, lw=1)
    prints.text(0, -33, "15 cm", ha="center", va="top", fontsize=8, color=INK)
    prints.set(xlim=(-12, 34), ylim=(-36, 33), aspect="equal", xticks=[], yticks=[])
    prints.set_title("217 sub-rays at 50 m; lines: 1/e²", fontsize=11, color=INK)

    offsets = np.linspace(-1.5, 1.5, 61)
    gaussian = [NormalDist().cdf(2 * x) for x in offsets]
    inside = np.clip(offsets, -1, 1)
    even = 0.5 + (inside * np.sqrt(1 - inside**2) + np.arcsin(inside)) / math.pi
    for color, exact, name in ((EVEN, even, "even"), (ROUND, gaussian, "gaussian")):
        edges.plot(offsets, exact, color=color, lw=1.2, label=f"{name}: closed form")
        for count, mark in ((19, "x"), (217, "o")):
            beam = Returns(
                "all",
                count,
                3.0,
                beam_profile="even" if name == "even" else "gaussian",
                pulse_ns=1,
            )
            sampled = offsets[::4]
            simulated = [share(beam, 0.075 * x) for x in sampled]
            edges.plot(
                sampled, simulated, mark, ms=4, mfc="none", color=color, label=f"{count} sub-rays"
            )
    edges.set(xlabel="edge, in radii of the beam at 1/e²", ylabel="share of the light on the wall")
    edges.set_title("A beam on an edge", fontsize=11, color=INK)
    edges.legend(fontsize=7.5, frameon=False, loc="upper left")

    ranges = np.geomspace(0.5, 100, 60)
    beam = Returns(
        subrays=19, divergence_mrad=OVAL, beam_profile="gaussian", exit_diameter_m=EXIT_M
    )
    gaussian_beam = Beam.from_divergences(19, (OVAL[0] / 1000, OVAL[1] / 1000), "gaussian", EXIT_M)
    assert gaussian_beam.starts is not None
    for axis, (label, color) in enumerate((("across", ROUND), ("up", WIDE))):
        waist = EXIT_M / 2
        half = OVAL[axis] / 2000
        widths.loglog(
            ranges,
            2e3 * np.hypot(waist, half * ranges),
            color=color,
            lw=1.2,
            label=f"{label}: 2 √(w0² + (θR/2)²)",
        )
        sampled = ranges[::6]
        simulated = [4e3 * footprint(beam, distance)[:, axis].std() for distance in sampled]
        widths.loglog(sampled, simulated, "o", ms=4, mfc="none", color=color, label="simulated")
        widths.loglog(ranges, 2e3 * half * ranges, color=color, lw=0.8, ls=":")
    widths.set(xlabel="range (m)", ylabel="width at 1/e² (mm)", ylim=(5, 400))
    widths.set_title("3.0 × 1.5 mrad, 12.5 mm at its start", fontsize=11, color=INK)
    widths.legend(fontsize=7.5, frameon=False, loc="upper left")
    for scale in (widths.xaxis, widths.yaxis):
        scale.set_major_formatter(lambda value, _: f"{value:g}")
    prints.spines[:].set_visible(False)
    for axes in (prints, edges, widths):
        axes.tick_params(labelsize=8, colors=MUTED)
        axes.spines[:].set_color(LINE)
    return figure

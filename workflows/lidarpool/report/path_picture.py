"""The picture of the planned path: discs, all trials' paths and the best of them, in plan."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Protocol

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PatchCollection
from matplotlib.lines import Line2D
from matplotlib.patches import Circle
from matplotlib.patheffects import withStroke
from matplotlib.ticker import FuncFormatter
from numpy.typing import ArrayLike, NDArray

from ..base.choice import one_of_each_part
from ..plan import Plan, Planning
from ..render.page import FONT, Page
from ..render.shot import SIZE
from ..render.stage import Axis, axis, nice_step
from ..render.theme import theme_for

Floats = NDArray[np.float64]

FRAME = (0.085, 0.115, 0.70, 0.755)  # left, bottom, width, height of the plot on the page
MOST_TRIALS = 1000
PATH_COLOUR, TRIAL_COLOUR = "#d6336c", "#5b8fd0"


class HasWaypoints(Protocol):
    """A trial, of which its path is drawn."""

    @property
    def waypoints(self) -> Floats:
        """Corners of the path between its two ends, (k, 2), metres."""


def draw_path(
    path: str | os.PathLike[str],
    planning: Planning,
    plan: Plan,
    trials: Iterable[HasWaypoints] = (),
    *,
    origin: ArrayLike = (0.0, 0.0),
    size: tuple[int, int] = SIZE,
    dark: bool = False,
) -> Path:
    """Draw a plan seen from above: discs, ends, the trials' paths faint and the best one bold.

    Parameters
    ----------
    path
        The file to write, .png or .pdf.
    planning
        The problem: ends and discs.
    plan
        The best path.
    trials
        What it was chosen from; of more than 1000 an even choice is drawn.
    origin
        x and y of the local origin: the axes tell world coordinates, local + origin.
    size
        Width and height in pixels.
    dark
        A dark page.

    Raises
    ------
    LidarpoolError
        If the file cannot be written.
    """
    theme = theme_for(dark)
    page = Page(size, theme)
    best = np.asarray(plan.path, dtype=np.float64)
    every = _trial_paths(best, trials)
    others = [every[k] for k in one_of_each_part(len(every), MOST_TRIALS)]
    axes = page.figure.add_axes(FRAME)
    _frame(axes, page, _limits(best, others, planning, size), np.asarray(origin))
    discs = [
        Circle((x, y), radius)
        for (x, y), radius in zip(planning.centres, planning.radii, strict=True)
    ]
    axes.add_collection(
        PatchCollection(
            discs, facecolor=theme.unseen, edgecolor=theme.muted, linewidth=0.6 * page.unit
        )
    )
    alpha = float(np.clip(6 / max(len(others), 1), 0.08, 0.6))
    axes.add_collection(
        LineCollection(others, colors=TRIAL_COLOUR, linewidths=0.8 * page.unit, alpha=alpha)
    )
    if np.isfinite(best).all():
        axes.plot(*best.T, color=PATH_COLOUR, lw=2.0 * page.unit, solid_joinstyle="round", zorder=4)
        axes.plot(*best[1:-1].T, "o", color=PATH_COLOUR, ms=2.6 * page.unit, zorder=5)
    _ends(axes, page, planning)
    page.key(_entries(page, len(others), bool(discs)), 7.4)
    page.title("Planned path", _verdict(plan, every))
    return page.save(path)


def _verdict(plan: Plan, trials: list[Floats]) -> str:
    """Length, how it compares with the shortest, whether it is free, and how others fared."""
    length = f"length {plan.length:.2f} m"
    if math.isfinite(plan.shortest_possible) and plan.shortest_possible > 0:
        length += f" · shortest possible {plan.shortest_possible:.2f} m ({plan.excess:+.2%})"
        length = length.replace("-", "−")
    else:
        length += " · discs cut the target off"
    state = "collision-free" if plan.collision_free else "enters a disc"
    best_of = f"best of {plan.trials:,} trial{'s' * (plan.trials != 1)}"
    if len(trials) > 1:  # paths that are all alike are hidden by the best of them
        longest = max(float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum()) for path in trials)
        best_of += f", the longest {longest:.2f} m"
    return f"{length} · {state} · {best_of}"


def _trial_paths(best: Floats, trials: Iterable[HasWaypoints]) -> list[Floats]:
    """Paths (k + 2, 2) of the trials from end to end."""
    waypoints = [np.asarray(trial.waypoints, dtype=np.float64).reshape(-1, 2) for trial in trials]
    finite = [points for points in waypoints if np.isfinite(points).all()]
    return [np.concatenate([best[:1], points, best[-1:]]) for points in finite]


def _limits(
    best: Floats, others: list[Floats], planning: Planning, size: tuple[int, int]
) -> Floats:
    """Lowest and highest corner (2, 2) of the plot, in the page's proportions."""
    reach = np.repeat(planning.radii[:, None], 2, axis=1)
    ends = np.array([planning.start, planning.target])
    shown = np.concatenate(
        [ends, best, *others, planning.centres - reach, planning.centres + reach]
    )
    shown = shown[np.isfinite(shown).all(axis=1)]
    low, high = shown.min(axis=0), shown.max(axis=0)
    width = np.maximum(high - low, 1e-3) * 1.1
    room = np.array([FRAME[2] * size[0], FRAME[3] * size[1]])
    half = room * (width / room).max() / 2
    middle = (low + high) / 2
    return np.stack([middle - half, middle + half])


def _frame(axes: Axes, page: Page, limits: Floats, origin: Floats) -> None:
    """Set local limits, grid and round ticks of the world, the same on both axes."""
    theme = page.theme
    step = nice_step(float(np.ptp(limits[:, 0])) / 8)
    (x0, y0), (x1, y1) = limits.tolist()
    across = axis("x", x0, x1, step, float(origin[0]))
    up = axis("y", y0, y1, step, float(origin[1]))
    axes.set(xlim=(x0, x1), ylim=(y0, y1), facecolor=theme.ground)
    axes.set_aspect("equal")
    axes.grid(color=theme.line, lw=0.5 * page.unit)
    axes.set_axisbelow(True)
    for spine in axes.spines.values():
        spine.set(color=theme.line, linewidth=0.6 * page.unit)
    for side, one in ((axes.xaxis, across), (axes.yaxis, up)):
        side.set_ticks(one.ticks)
        side.set_major_formatter(_labels_of(one))
        side.set_label_text(one.title, fontsize=7.6 * page.unit, color=theme.ink, family=FONT)
    axes.tick_params(
        labelsize=6.8 * page.unit, labelcolor=theme.muted, color=theme.line, length=2.5 * page.unit,
        width=0.6 * page.unit, labelfontfamily=FONT,
    )  # fmt: skip


def _labels_of(one: Axis) -> FuncFormatter:
    """Format ticks by the axis's own labels."""
    return FuncFormatter(lambda value, position: one.labels[position])


def _ends(axes: Axes, page: Page, planning: Planning) -> None:
    """Mark and name start and target."""
    halo = [withStroke(linewidth=2.2 * page.unit, foreground=page.theme.ground)]
    middle = sum(axes.get_xlim()) / 2
    for name, place, marker in (("start", planning.start, "o"), ("target", planning.target, "*")):
        axes.plot(
            *place, marker, color=page.theme.ink, ms=(6 if marker == "o" else 10) * page.unit,
            mec=page.theme.ground, mew=0.8 * page.unit, zorder=6,
        )  # fmt: skip
        left = place[0] > middle  # names stand towards the middle, inside the plot
        axes.annotate(
            name, place, xytext=(-8 * page.unit if left else 8 * page.unit, 0),
            textcoords="offset points", ha="right" if left else "left", va="center",
            fontsize=7.6 * page.unit, color=page.theme.ink, family=FONT,
            path_effects=halo, zorder=7,
        )  # fmt: skip


def _entries(page: Page, trials: int, discs: bool) -> list[Line2D]:
    """Entries of the legend."""
    theme, unit = page.theme, page.unit
    entries = [Line2D([], [], color=PATH_COLOUR, lw=2 * unit, label="Best path")]
    if trials:
        label = f"{trials:,} trial{'s' * (trials != 1)}"
        entries.append(Line2D([], [], color=TRIAL_COLOUR, lw=0.8 * unit, alpha=0.6, label=label))
    if discs:
        entries.append(
            Line2D([], [], ls="", marker="o", color=theme.unseen, mec=theme.muted,
                   mew=0.6 * unit, ms=7 * unit, label="Obstacle")
        )  # fmt: skip
    return entries

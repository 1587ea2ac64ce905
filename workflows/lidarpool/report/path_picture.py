"""The picture of the planned path: obstacles, the paths of all trials, and the best one."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PatchCollection
from matplotlib.lines import Line2D
from matplotlib.patches import Circle
from matplotlib.patheffects import withStroke

from ..base.arrays import Floats
from ..base.choice import one_of_each_part
from ..base.words import counted
from ..plan import Plan, Planning
from ..render import theme
from ..render.page import FONT, Page
from ..render.stage import make_axis, nice_step

FRAME = (0.085, 0.115, 0.70, 0.755)  # left, bottom, width, height of the plot on the page
MOST_TRIALS = 1000
PATH_COLOUR, TRIAL_COLOUR = "#d6336c", "#5b8fd0"


def draw_path(
    planning: Planning, plan: Plan, trials: Sequence[Floats], origin: Floats, size: tuple[int, int]
) -> Page:
    """Draw a plan from above: obstacles, ends, the trials' paths faint and the best one bold.

    `trials` are the corners (w, 2) of their paths; of more than 1000 an evenly spaced sample is
    drawn. `origin` is x and y of the local origin: the axes have world coordinates.
    """
    page = Page(size)
    unit = page.unit
    best = plan.path
    every = [np.concatenate([best[:1], trial, best[-1:]]) for trial in trials]
    others = [every[k] for k in one_of_each_part(len(every), MOST_TRIALS)]
    (x0, y0), (x1, y1) = _limits(best, others, planning, size).tolist()
    axes = page.chart(FRAME, xlim=(x0, x1), ylim=(y0, y1), aspect="equal")
    step = nice_step((x1 - x0) / 8)
    for side, name, low, high, start in (
        (axes.xaxis, "x", x0, x1, origin[0]),
        (axes.yaxis, "y", y0, y1, origin[1]),
    ):
        ticks = make_axis(name, low, high, step, float(start))
        side.set_ticks(ticks.ticks, ticks.labels)
        side.set_label_text(ticks.title)
    circles = zip(planning.centres, planning.radii, strict=True)
    discs = PatchCollection(
        [Circle((x, y), radius) for (x, y), radius in circles],
        facecolor=theme.UNSEEN, edgecolor=theme.MUTED, linewidth=0.6 * unit,
    )  # fmt: skip
    axes.add_collection(discs)
    alpha = float(np.clip(6 / max(len(others), 1), 0.08, 0.6))
    axes.add_collection(
        LineCollection(others, colors=TRIAL_COLOUR, linewidths=0.8 * unit, alpha=alpha)
    )
    axes.plot(*best.T, color=PATH_COLOUR, lw=2.0 * unit, solid_joinstyle="round", zorder=4)
    axes.plot(*best[1:-1].T, "o", color=PATH_COLOUR, ms=2.6 * unit, zorder=5)
    _ends(axes, page, planning)
    key = [Line2D([], [], color=PATH_COLOUR, lw=2 * unit, label="Best path")]
    if others:
        label = counted(len(others), "trial")
        key.append(Line2D([], [], color=TRIAL_COLOUR, lw=0.8 * unit, alpha=0.6, label=label))
    if len(planning.radii):
        key.append(
            Line2D([], [], ls="", marker="o", color=theme.UNSEEN, mec=theme.MUTED,
                   mew=0.6 * unit, ms=7 * unit, label="Obstacle")
        )  # fmt: skip
    page.key(key, 7.4)
    page.title("Planned path", _verdict(plan, every))
    return page


def _verdict(plan: Plan, trials: Sequence[Floats]) -> str:
    """Caption: length, shortest possible, collisions, and the other trials."""
    shortest = "discs cut the target off"
    if math.isfinite(plan.shortest_possible) and plan.shortest_possible > 0:
        shortest = f"shortest possible {plan.shortest_possible:.2f} m ({plan.excess:+.2%})"
    length = f"length {plan.length:.2f} m · {shortest}"
    state = "collision-free" if plan.collision_free else "enters a disc"
    best_of = f"best of {counted(plan.trials, 'trial')}"
    if len(trials) > 1:  # equal paths are hidden by the best one
        longest = max(float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum()) for path in trials)
        best_of += f", the longest {longest:.2f} m"
    return f"{length.replace('-', '−')} · {state} · {best_of}"


def _limits(
    best: Floats, others: Sequence[Floats], planning: Planning, size: tuple[int, int]
) -> Floats:
    """Lowest and highest corner (2, 2) of the plot, in the page's proportions."""
    reach = planning.radii[:, None]
    shown = np.concatenate([best, *others, planning.centres - reach, planning.centres + reach])
    low, high = shown.min(axis=0), shown.max(axis=0)
    width = np.maximum(high - low, 1e-3) * 1.1
    room = np.array([FRAME[2] * size[0], FRAME[3] * size[1]])
    half = room * (width / room).max() / 2
    middle = (low + high) / 2
    return np.stack([middle - half, middle + half])


def _ends(axes: Axes, page: Page, planning: Planning) -> None:
    """Mark and name start and target."""
    halo = [withStroke(linewidth=2.2 * page.unit, foreground=theme.GROUND)]
    middle = sum(axes.get_xlim()) / 2
    for name, place, marker, size in (
        ("start", planning.start, "o", 6),
        ("target", planning.target, "*", 10),
    ):
        axes.plot(
            *place, marker, color=theme.INK, ms=size * page.unit, mec=theme.GROUND,
            mew=0.8 * page.unit, zorder=6,
        )  # fmt: skip
        left = place[0] > middle  # names are towards the middle, inside the plot
        axes.annotate(
            name, place, xytext=(-8 * page.unit if left else 8 * page.unit, 0),
            textcoords="offset points", ha="right" if left else "left", va="center",
            fontsize=7.6 * page.unit, color=theme.INK, family=FONT, path_effects=halo, zorder=7,
        )  # fmt: skip

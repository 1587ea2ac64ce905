"""Draw the map of a flight plan."""

from __future__ import annotations

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.patheffects import withStroke

from lidarscenario.plan.flight import FlightPlan
from lidarscenario.plan.flight_density import DensityMap
from lidarscenario.plan.flight_lines import FlightLine
from lidarsim.numerics.arrays import Floats
from lidarsim.words import format_rounded
from lidarview.render import theme
from lidarview.render.picture_page import FONT, Page

SIZE = (1600, 1000)
_FRAME = (0.075, 0.10, 0.755, 0.735)  # left, bottom, width and height of the map
_MARGIN = 0.04  # margin around the lines and the area, as a fraction of their extent
_LINE_COLOR = theme.EMPHASIS
_CROSS_COLOR = "#ee7733"
_AREA_COLOR = theme.INK
_COLORMAP = "viridis"
_PLANNED_COLOR = "#ffffff"
_EMPTY_COLOR = "#f3a9a2"
_MAX_NAMES = 30  # lines are not labeled if there are more


def draw_flight(plan: FlightPlan, expected: DensityMap) -> Page:
    """Draw the flight lines, the area, the turns and the expected density as seen from above."""
    page = Page(SIZE)
    axes = page.map_chart(_FRAME, _limits(plan))
    densities = expected.density_m2[expected.density_m2 > 0]
    highest = float(np.quantile(densities, 0.98)) if len(densities) else 1.0
    norm = Normalize(0, max(highest, 1.05 * (plan.density_m2 or 0)))
    rows, columns = expected.density_m2.shape
    x0, y0 = expected.corner.tolist()
    extent = (x0, x0 + columns * expected.cell_m, y0, y0 + rows * expected.cell_m)
    axes.imshow(  # cells outside the area are transparent
        np.where(expected.density_m2 == 0, 0.0, np.nan),
        cmap=ListedColormap([_EMPTY_COLOR]),
        extent=extent,
        origin="lower",
        zorder=1,
    )
    shown = np.where(expected.density_m2 > 0, expected.density_m2, np.nan)
    axes.imshow(shown, cmap=_COLORMAP, norm=norm, extent=extent, origin="lower", zorder=1)
    axes.set(aspect="equal")
    axes.plot(*plan.path.positions[:, :2].T, color=theme.MUTED, lw=0.5 * page.unit, zorder=2)
    for part in getattr(plan.area, "geoms", [plan.area]):
        for ring in (part.exterior, *part.interiors):
            outline = np.array(ring.coords)[:, :2]
            axes.plot(*outline.T, color=_AREA_COLOR, lw=1.2 * page.unit, ls="--", zorder=3)
    for line in plan.lines:
        _draw_line(axes, page, line, named=len(plan.lines) <= _MAX_NAMES)
    bar = page.color_bar(
        theme.apply_colormap(_COLORMAP, np.linspace(0, 1, 256)),
        norm,
        "expected points per m²",
        (0.862, 0.10, 0.014, 0.40),
    )
    if plan.density_m2 is not None:
        bar.axhline(plan.density_m2, color=_PLANNED_COLOR, lw=1.4 * page.unit)
    has_empty = bool((expected.density_m2 == 0).any())
    page.key(_legend(plan, has_empty, page.unit), 7.2, bbox_to_anchor=(0.85, 0.70))
    page.title(_title(plan), *_details(plan))
    return page


def _limits(plan: FlightPlan) -> Floats:
    """Return the x and y limits of the map, which has the aspect ratio of its frame."""
    x0, y0, x1, y1 = plan.area.bounds
    ends = [point for line in plan.lines for point in (line.leg.start, line.leg.stop)]
    shown = np.array([(x0, y0), (x1, y1), *ends])
    lower, upper = shown.min(axis=0), shown.max(axis=0)
    frame = np.array([_FRAME[2] * SIZE[0], _FRAME[3] * SIZE[1]])
    half = frame * ((upper - lower) * (1 + 2 * _MARGIN) / frame).max() / 2
    center = (lower + upper) / 2
    return np.stack([center - half, center + half])


def _draw_line(axes: Axes, page: Page, line: FlightLine, *, named: bool) -> None:
    """Draw a flight line as an arrow, optionally with its name at the start."""
    color = _LINE_COLOR if line.kind == "line" else _CROSS_COLOR
    halo = [withStroke(linewidth=2.6 * page.unit, foreground=theme.PAGE)]
    axes.annotate(
        "",
        tuple(line.leg.stop.tolist()),
        tuple(line.leg.start.tolist()),
        arrowprops={
            "arrowstyle": "-|>",
            "color": color,
            "lw": 1.4 * page.unit,
            "shrinkA": 0,
            "shrinkB": 0,
            "mutation_scale": 9 * page.unit,
            "path_effects": halo,
        },
        zorder=4,
    )
    if named:
        x, y = (line.leg.start + 0.03 * (line.leg.stop - line.leg.start)).tolist()
        axes.text(
            x,
            y,
            line.name,
            fontsize=6.2 * page.unit,
            family=FONT,
            color=theme.INK,
            path_effects=halo,
            zorder=5,
        )


def _legend(plan: FlightPlan, has_empty: bool, unit: float) -> list[Artist]:
    """Return the entries of the legend."""
    entries = [("Flight line", _LINE_COLOR, 1.4, "-")]
    if any(line.kind == "cross" for line in plan.lines):
        entries.append(("Cross strip", _CROSS_COLOR, 1.4, "-"))
    entries += [("Turn", theme.MUTED, 0.5, "-"), ("Area", _AREA_COLOR, 1.2, "--")]
    handles: list[Artist] = [
        Line2D([], [], color=color, lw=width * unit, ls=style, label=name)
        for name, color, width, style in entries
    ]
    if has_empty:
        handles.append(Patch(color=_EMPTY_COLOR, label="No points"))
    return handles


def _title(plan: FlightPlan) -> str:
    return f"{plan.counts}, {plan.duration_s / 60:.1f} min in the air"


def _details(plan: FlightPlan) -> tuple[str, str]:
    """Return the lines below the title."""
    strip = f"a strip has {plan.densities_m2[0]:.3g}"
    if plan.densities_m2[1] > 1.02 * plan.densities_m2[0]:
        strip += f" to {plan.densities_m2[1]:.3g}"
    target = "" if plan.density_m2 is None else f" (planned: {plan.density_m2:g})"
    heights = (f"{plan.layout.agl_m:g} m above ground", f"swath {plan.swath_m:.0f} m")
    spacing = "" if plan.spacing_m is None else f", line spacing {plan.spacing_m:.1f} m"
    return (
        f"{plan.scanner.sensor.model}: {format_rounded(plan.rates.fired_hz / 1000)} kHz, "
        f"{plan.rates.scan_hz:g} Hz, {plan.rates.speed_m_s:g} m/s",
        f"{', '.join(heights)}{spacing}; {strip} points per m²{target}",
    )

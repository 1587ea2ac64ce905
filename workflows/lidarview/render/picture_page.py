"""Compose a plot from a rendered image, axes, a legend, a color bar, and a title."""

from __future__ import annotations

import io
import math
import re
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from markupsafe import escape
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import ListedColormap, LogNorm, Normalize, to_hex
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.patheffects import withStroke
from matplotlib.ticker import LogLocator, NullFormatter

from lidarsim.errors import explain_os_errors
from lidarsim.io.storage import replace_file
from lidarsim.numerics.arrays import AnyFloats, Floats
from lidarsim.words import format_rounded, shorten_name

from . import theme
from .shot import SurfaceView
from .stage import make_axis, nice_step

DPI = 200
FONT = "DejaVu Sans"  # included in Matplotlib
MAX_LARGE_MARKERS = 40  # more sensors than this are drawn as small dots
MAX_PATH_POINTS = 200  # maximum number of points on the drawn trajectory of a sensor
# Areas of markers with one and two digits, in square points for a plot 1600 pixels wide.
_MARK = 62
_MARK_OF_TWO_DIGITS = 92
MAX_NAMES = 12  # actors are not named if there are more
# All lengths below are in pixels for a plot 1600 pixels wide.
NAME_ABOVE = 26.0
NAME_SIZE = (150.0, 26.0)
LEGEND_ROWS = 30
LEGEND_LETTERS = 18  # maximum length of a line in the legend; longer names have two lines
DETAIL_LETTERS = 140  # maximum length of a line below the title; longer ones are divided
TICK = 7.0  # length of a tick mark
# Distances from an edge to the tick labels beside it and below it.
LABEL_MARGIN_X = 14.0
LABEL_MARGIN_Y = 24.0
LETTER_WIDTH = 12.0  # width of a digit
TITLE_DISTANCE = 32.0  # distance between the tick labels and the title
LABEL_SPACING = 34.0  # minimum distance between tick labels
MIN_AXIS = 36.0  # a shorter height axis has no tick labels
# Classes of SVG groups, for the style sheet of an HTML page: labels in the plot, of which some are
# to the right or left of a marker, and the title and legends around the plot.
LABEL = "picture-label"
RIGHT_LABEL = "picture-label-right"
LEFT_LABEL = "picture-label-left"
_MARGIN = "picture-margin"
_GRADIENT_STEPS = 16  # colors that represent a color scale in HTML


class Page:
    """A plot under construction.

    Its size is the width and height in pixels.
    """

    def __init__(self, size: tuple[int, int]) -> None:
        self.size = size
        self.figure = Figure(figsize=(size[0] / DPI, size[1] / DPI), dpi=DPI, facecolor=theme.PAGE)
        self.unit = size[0] / 1600  # fonts and lines scale with the picture
        self._headline = ""  # title and details as HTML
        self._keys: list[str] = []  # legends and color scales as HTML

    def draw_view(self, shot: SurfaceView, image: AnyFloats) -> Axes:
        """Draw a colored view with grid, axes, sensors, and actor names.

        The grid is on the ground. The returned axes use the pixel coordinates of the view.
        """
        colors = image[..., :3]
        opacity = image[..., 3:]
        plain = np.divide(colors, opacity, out=np.zeros_like(colors), where=opacity > 0)
        bytes_ = np.round(255 * np.concatenate([plain, opacity], axis=2)).astype(np.uint8)
        self.figure.figimage(bytes_, zorder=-1)
        axes = self.figure.add_axes((0, 0, 1, 1))
        axes.set_axis_off()
        axes.set(xlim=(0, self.size[0]), ylim=(self.size[1], 0))
        grid = shot.visible_segments(_grid(shot), shot.project_ground)
        axes.add_collection(LineCollection(grid, colors=theme.LINE, linewidths=0.6 * self.unit))
        self._label_axes(axes, shot)
        self._draw_sensors(axes, shot)
        self._name_actors(axes, shot)
        return axes

    def _label_axes(self, axes: Axes, shot: SurfaceView) -> None:
        """Write tick labels and axis titles along the front edges and the left corner."""
        label_positions: list[Floats] = []
        for k, (start, end, outward) in enumerate(_axis_edges(shot)):
            axis = shot.stage.axes[k]
            end_pixels, _ = shot.camera.project([start, end])
            if k == 2 and np.linalg.norm(end_pixels[1] - end_pixels[0]) < MIN_AXIS * self.unit:
                return
            clearance = LABEL_MARGIN_X * abs(outward[0]) + LABEL_MARGIN_Y * abs(outward[1])
            tick_positions = np.repeat(start[None], len(axis.ticks), axis=0)
            tick_positions[:, k] = axis.ticks
            lines = [end_pixels] if k == 2 else []
            for pixel, text in zip(
                shot.camera.project(tick_positions)[0], axis.labels, strict=True
            ):
                half_width = LETTER_WIDTH / 2 * len(text) * abs(outward[0])
                position = pixel + (clearance + half_width) * self.unit * outward
                min_distance = (
                    (LABEL_SPACING + 4 * max(0, len(text) - 3))
                    * (0.7 if k == 2 else 1.0)
                    * self.unit
                )
                if all(
                    np.linalg.norm(position - earlier) >= min_distance
                    for earlier in label_positions
                ):
                    label_positions.append(position)
                    lines.append(np.stack([pixel, pixel + TICK * self.unit * outward]))
                    self._text(axes, position, text, 6.6, theme.MUTED)
            marks = LineCollection(lines, colors=theme.MUTED, linewidths=0.6 * self.unit)
            axes.add_collection(marks)
            direction = end_pixels[1] - end_pixels[0]
            angle = (90 - math.degrees(math.atan2(direction[1], direction[0]))) % 180 - 90
            widest = max((len(text) for text in axis.labels), default=0)
            distance = (
                clearance + TITLE_DISTANCE + LETTER_WIDTH * widest * abs(outward[0])
            ) * self.unit
            position = end_pixels.mean(axis=0) + distance * outward
            self._text(
                axes, position, axis.title, 7.2, theme.INK, rotation=90.0 if k == 2 else angle
            )

    def _text(
        self,
        parent: Axes | Figure,
        position: Any,
        text: str,
        size: float,
        color: str,
        **options: Any,
    ) -> None:
        style: dict[str, Any] = {"ha": "center", "va": "center", "color": color, "family": FONT}
        style |= {"gid": LABEL} | options
        text_artist = parent.text(
            float(position[0]), float(position[1]), text, fontsize=size * self.unit, **style
        )
        text_artist.set_parse_math(False)  # names come from files

    def _draw_sensors(self, axes: Axes, shot: SurfaceView) -> None:
        """Draw the sensors' paths, and a marker on a stem for each sensor.

        Markers of hidden sensors are hollow.
        """
        for path in shot.paths:
            points = path[
                np.linspace(0, len(path) - 1, min(len(path), MAX_PATH_POINTS)).astype(int)
            ]
            pixels, _ = shot.camera.project(points)
            axes.plot(
                *pixels.T,
                color=theme.SENSOR,
                lw=0.9 * self.unit,
                alpha=0.35,
                zorder=4,
                solid_capstyle="round",
            )
            self.draw_lines(axes, shot, np.stack([points[:-1], points[1:]], axis=1), 1.8, 0.9)
        poses = shot.sensors
        is_crowded = len(shot.sensors) > MAX_LARGE_MARKERS
        pixels, is_visible = shot.project_visible(poses)
        if not is_crowded:
            feet = np.column_stack([poses[:, :2], np.full(len(poses), shot.stage.level)])
            self.draw_lines(axes, shot, np.stack([poses, feet], axis=1), 0.8, 0.7)
        size, edge_width = (5, 0.2) if is_crowded else (20, 0.7)
        for chosen, face, edge in (
            (is_visible, theme.SENSOR, theme.PAGE),
            (~is_visible, "none", theme.SENSOR),
        ):
            axes.scatter(
                pixels[chosen, 0],
                pixels[chosen, 1],
                s=size * self.unit**2,
                facecolors=face,
                edgecolors=edge,
                linewidths=edge_width * self.unit,
                zorder=5,
            )

    def _name_actors(self, axes: Axes, shot: SurfaceView) -> None:
        """Write the names of the actors above their positions, unless there are too many.

        Names of hidden actors are paler. A robot, whose links are named ROBOT/LINK, is named at its
        first link.
        """
        boxes = shot.scene.object_bounds
        label_positions = np.empty((0, 2))
        actor_indices = np.arange(len(boxes) - shot.actors, len(boxes))
        # Absent actors are reduced to a single point.
        is_present = np.isfinite(boxes).all(axis=(1, 2)) & (np.ptp(boxes, axis=1) > 0).any(axis=1)
        actor_indices = actor_indices[is_present[actor_indices]]
        names = [robot_name(shot.scene.names[k]) for k in actor_indices]
        actor_indices = actor_indices[np.sort(np.unique(names, return_index=True)[1])]
        names = list(dict.fromkeys(names))
        if len(actor_indices) > MAX_NAMES:
            return
        tops = np.column_stack(
            [boxes[actor_indices, :, :2].mean(axis=1), boxes[actor_indices, 1, 2]]
        )
        halo = [withStroke(linewidth=1.6 * self.unit, foreground=theme.PAGE)]
        pixels, is_visible = shot.project_visible(tops)
        for k in np.argsort(-pixels[:, 1]).tolist():  # from front to back
            pixel = pixels[k]
            name = names[k]
            color = theme.INK if is_visible[k] else theme.LINE
            position = pixel - (0, NAME_ABOVE * self.unit)
            while (
                (np.abs(label_positions - position) < np.array(NAME_SIZE) * self.unit)
                .all(axis=1)
                .any()
            ):
                position = position - (0, NAME_SIZE[1] * self.unit)
            label_positions = np.vstack([label_positions, position])
            axes.plot(
                *np.stack([pixel, position]).T,
                color=color,
                lw=0.7 * self.unit,
                zorder=6,
                path_effects=halo,
            )
            ink = theme.INK if is_visible[k] else theme.MUTED
            style = {"va": "bottom", "path_effects": halo, "zorder": 7}
            self._text(axes, position, shorten_name(name), 6.6, ink, **style)

    def number_sensors(self, axes: Axes, shot: SurfaceView) -> None:
        """Write numbers on the markers of the sensors, starting from 1.

        Hidden sensors have white markers.
        """
        pixels, is_visible = shot.project_visible(shot.sensors)
        area = _MARK if len(pixels) < 10 else _MARK_OF_TWO_DIGITS
        for rank, k in enumerate(np.argsort(pixels[:, 1]).tolist()):  # from back to front
            x = float(pixels[k, 0])
            y = float(pixels[k, 1])
            above = 8 + rank / len(pixels)
            face, ink = (theme.SENSOR, theme.PAGE) if is_visible[k] else (theme.PAGE, theme.SENSOR)
            axes.scatter(
                [x],
                [y],
                s=area * self.unit**2,
                facecolors=face,
                edgecolors=ink,
                linewidths=0.7 * self.unit,
                zorder=above,
            )
            style = {"va": "center_baseline", "weight": "bold", "zorder": above}
            self._text(axes, (x, y), str(k + 1), 5.2 if k < 99 else 4.0, ink, **style)

    def draw_lines(
        self, axes: Axes, shot: SurfaceView, segments: Floats, width: float, alpha: float
    ) -> None:
        """Draw the visible parts of line segments in the sensor color."""
        runs = shot.visible_segments(segments, shot.project_visible)
        axes.add_collection(
            LineCollection(
                runs, colors=theme.SENSOR, linewidths=width * self.unit, alpha=alpha, zorder=4
            )
        )

    def chart(self, frame: tuple[float, float, float, float], **options: Any) -> Axes:
        """Add axes with a grid.

        `frame` is (left, bottom, width, height) in fractions of the page.
        """
        axes = self.figure.add_axes(frame)
        small = 0.6 * self.unit
        axes.set(facecolor=theme.GROUND, axisbelow=True, **options)
        axes.grid(color=theme.LINE, lw=0.5 * self.unit)
        axes.spines[:].set(color=theme.LINE, linewidth=small)
        for side in (axes.xaxis, axes.yaxis):
            side.label.set(fontsize=7.6 * self.unit, color=theme.INK, family=FONT)
        axes.tick_params(
            labelsize=6.8 * self.unit,
            labelcolor=theme.MUTED,
            color=theme.LINE,
            length=2.5 * self.unit,
            width=small,
            labelfontfamily=FONT,
        )
        return axes

    def map_chart(
        self,
        frame: tuple[float, float, float, float],
        limits: Floats,
        origin: Sequence[float] | Floats = (0.0, 0.0),
        tick_count: int = 8,
    ) -> Axes:
        """Add axes for a map.

        The tick labels are world coordinates. Large coordinates are shortened by an offset in the
        axis title, for example "x − 500 000 (m)".

        Parameters
        ----------
        frame
            Left, bottom, width, and height in fractions of the page.
        limits
            (2, 2) lower and upper corner of the map in meters.
        origin
            (2,) world coordinates of the origin of the map.
        tick_count
            Approximate number of ticks on the x axis.
        """
        (x0, y0), (x1, y1) = limits.tolist()
        axes = self.chart(frame, xlim=(x0, x1), ylim=(y0, y1), aspect="equal")
        step = nice_step((x1 - x0) / tick_count)
        for side, name, lower, upper, start in (
            (axes.xaxis, "x", x0, x1, origin[0]),
            (axes.yaxis, "y", y0, y1, origin[1]),
        ):
            ticks = make_axis(name, lower, upper, step, float(start))
            side.set_ticks(ticks.ticks, ticks.labels)
            side.set_label_text(ticks.title)
        return axes

    def title(self, text: str, *details: str) -> None:
        """Write a title at the top left, with details below it.

        Long details are divided at their centered dots.
        """
        line = 0.05 * self.size[0] / self.size[1] / 1.6
        position = 0.03, 1 - line
        style = {"ha": "left", "gid": _MARGIN}
        self._text(self.figure, position, text, 11, theme.INK, weight="bold", **style)
        rows = [row for detail in details for row in _divide_detail(detail)]
        for number, row in enumerate(rows):
            position = 0.03, 1 - (1.84 + 0.62 * number) * line
            self._text(self.figure, position, row, 7.2, theme.MUTED, **style)
        self._headline = f"<h2>{escape(text)}</h2>"
        self._headline += "".join(f"<p>{escape(detail)}</p>" for detail in details if detail)

    def draw_note(self, text: str) -> None:
        """Write a line at the bottom left."""
        self._text(self.figure, (0.03, 0.025), text, 7.2, theme.MUTED, ha="left")

    def heading(self, axes: Axes, text: str, **options: Any) -> None:
        """Write a heading above the left end of a chart."""
        style: dict[str, Any] = {
            "fontsize": 7.6 * self.unit,
            "color": theme.INK,
            "family": FONT,
        } | options
        axes.set_title(text, loc="left", parse_math=False, **style)

    def legend(
        self,
        entries: Sequence[tuple[str, Any]],
        sensor: str = "Sensor",
        lines: Sequence[str] = (),
        **options: Any,
    ) -> None:
        """Draw a legend in the right margin.

        `entries` contains tuples (name, color). If there are more than `LEGEND_ROWS`, the last line
        states the number of omitted entries. `sensor` is the label of the sensor marker, which is
        omitted if the label is empty. `lines` contains the labels of lines in the color of the
        sensors. The options are passed to `key`.
        """
        rows = [("s", name, color) for name, color in entries[:LEGEND_ROWS]]
        if sensor:
            rows.append(("o", sensor, theme.SENSOR))
        rows += [("_", line, theme.SENSOR) for line in lines]
        if len(entries) > LEGEND_ROWS:
            rows.append(("", f"and {len(entries) - LEGEND_ROWS:,} more", theme.MUTED))
        size = min(7.4, 175 / len(rows))
        self.key(
            [
                Line2D(
                    [],
                    [],
                    ls="",
                    marker=marker,
                    color=color,
                    ms=(1.6 if marker == "_" else 0.85) * size * self.unit,
                    mec=color if marker == "_" else "none",
                    mew=0.8 * self.unit,
                    label=shorten_name(name, 2 * LEGEND_LETTERS),
                )
                for marker, name, color in rows
            ],
            size,
            **options,
        )

    def key(
        self,
        handles: Sequence[Artist],
        size: float,
        parent: Axes | Figure | None = None,
        **options: Any,
    ) -> None:
        """Draw a legend of Matplotlib handles in the right margin or on a parent.

        `size` is the font size in points. Long labels in the right margin have two lines.
        """
        style = {"loc": "center left", "bbox_to_anchor": (0.842, 0.5), "borderpad": 0} | options
        style = {"handletextpad": 0.5, "handlelength": 1.4} | style
        legend = (parent or self.figure).legend(
            handles,
            ["x"] * len(handles),
            frameon=False,
            labelcolor=theme.INK,
            labelspacing=0.55,
            prop={"family": FONT, "size": size * self.unit},
            **style,
        )
        # Names come from files. Matplotlib would omit names that start with an underscore, and
        # fail on names that look like a formula ("$\\frac{x$").
        labels = [str(handle.get_label()) for handle in handles]
        for text, label in zip(legend.get_texts(), labels, strict=True):
            text.set_parse_math(False)
            text.set_text(label if parent else _divide_name(label))
        if parent is None:
            legend.set_gid(_MARGIN)
            rows = (
                f"<li>{_swatch(handle)}{escape(label)}</li>"
                for handle, label in zip(handles, labels, strict=True)
            )
            self._keys.append(f"<ul>{''.join(rows)}</ul>")

    def color_bar(
        self,
        colors: Floats,
        norm: Normalize,
        title: str,
        frame: tuple[float, float, float, float] = (0.862, 0.27, 0.014, 0.46),
    ) -> Axes:
        """Draw a color bar with a title in the right margin, and return its axes."""
        axes = self.figure.add_axes(frame, gid=_MARGIN)
        self._keys.append(_html_scale(colors, norm, title))
        bar = self.figure.colorbar(ScalarMappable(norm, ListedColormap(colors)), cax=axes)
        bar.outline.set_visible(False)
        bar.set_label(
            title,
            fontsize=7.6 * self.unit,
            color=theme.INK,
            family=FONT,
            parse_math=False,
            labelpad=4 * self.unit,
        )
        axes.tick_params(
            which="both",
            labelsize=6.6 * self.unit,
            color=theme.MUTED,
            width=0.6 * self.unit,
            labelcolor=theme.MUTED,
            labelfontfamily=FONT,
            length=2.5 * self.unit,
            pad=3.5 * self.unit,
        )
        if isinstance(norm, LogNorm):
            is_narrow = norm.vmax < 1000 * norm.vmin  # type: ignore[operator]  # both are given
            label_logarithms(axes.yaxis, is_narrow)
        else:
            _label_in_full(axes.yaxis)
        return axes

    def save(self, path: Path) -> None:
        """Write the page as a PNG file in light colors, replacing an existing file or link.

        Raises
        ------
        LidarError
            If the folder does not exist or is not writable.
        """
        advice = "choose an existing, writable folder with enough free space"
        with explain_os_errors(f"The picture {path} could not be written", advice):
            replace_file(path, self.png())

    def png(self) -> bytes:
        """Return the page as PNG data in light colors."""
        image = io.BytesIO()
        self.figure.savefig(image, dpi=DPI, format="png")
        return image.getvalue()

    def svg(self) -> str:
        """Return the page as an SVG element for an HTML document.

        The colors in `theme.STYLED` become CSS variables such as ``--picture-ink``, so that the
        document can style them.
        """
        text = io.StringIO()
        with matplotlib.rc_context({"svg.hashsalt": "lidarpool"}):
            self.figure.savefig(text, format="svg", dpi=DPI, metadata={"Date": None})
        # A document with several pictures would repeat comments and styles.
        svg = re.sub(r"<!--.*?-->|<style.*?</style>", "", text.getvalue(), flags=re.DOTALL)
        svg = re.sub(r'^.*?<svg[^>]*(viewBox="[^"]*")[^>]*>', r"<svg \1>", svg, flags=re.DOTALL)
        svg = re.sub(r' id="[a-zA-Z]+_\d+"|<metadata>.*?</metadata>', "", svg, flags=re.DOTALL)
        svg = re.sub(r' id="(picture-[a-z-]+)"', r' class="\1"', svg)
        return _use_page_colors(svg)

    def html(self) -> str:
        """Return the page as elements of an HTML document: the title, the drawing and the legend.

        The title and the legend are also in the drawing. A style sheet shows either these, or on
        small screens the elements around the drawing, whose text is as large as that of the page.
        """
        for axes in self.figure.axes:
            sides = () if axes.get_gid() == _MARGIN else (axes.xaxis, axes.yaxis)
            labels = [label for side in sides for label in (side.label, *side.get_ticklabels())]
            for label in [*labels, *axes.texts]:
                label.set_gid(label.get_gid() or LABEL)
        keys = _use_page_colors("".join(self._keys))
        return (
            f'<div class="picture-title">{self._headline}</div>{self.svg()}'
            f'<div class="picture-key">{keys}</div>'
        )


def _use_page_colors(elements: str) -> str:
    """Replace the colors in `theme.STYLED` by CSS variables."""
    for color, name in theme.STYLED.items():
        elements = elements.replace(color, f"var(--picture-{name}, {color})")
    return elements


def _divide_detail(detail: str) -> list[str]:
    """Divide a line below the title at its centered dots if it is too long."""
    rows = [""]
    for part in detail.split(" · "):
        joined = f"{rows[-1]} · {part}".removeprefix(" · ")
        if len(joined) > DETAIL_LETTERS and rows[-1]:
            rows.append(part)
        else:
            rows[-1] = joined
    return rows


def _divide_name(name: str) -> str:
    """Divide a name for the legend into two lines if it is long."""
    if len(name) <= LEGEND_LETTERS:
        return name
    lines = textwrap.wrap(name, LEGEND_LETTERS, drop_whitespace=False)
    if len(lines) > 2:  # the spaces are in inconvenient places
        lines = [name[:LEGEND_LETTERS], name[LEGEND_LETTERS:]]
    return "\n".join(line.strip() for line in lines)


def _swatch(handle: Artist) -> str:
    """Return the marker of a legend entry as HTML."""
    if isinstance(handle, Line2D):
        shape = {"s": "", "o": "dot", "": "none"}.get(str(handle.get_marker()), "line")
        color = handle.get_color()
    else:
        shape = ""
        color = handle.get_facecolor() if isinstance(handle, Patch) else theme.INK
    return f'<i class="{shape}" style="background: {to_hex(color)}"></i>'


def _html_scale(colors: Floats, norm: Normalize, title: str) -> str:
    """Return a color scale as HTML, with the values at its ends and in the middle."""
    chosen = colors[np.linspace(0, len(colors) - 1, _GRADIENT_STEPS).astype(int)]
    steps = ", ".join(map(to_hex, chosen))
    values = (f"<span>{format_rounded(float(norm.inverse(f)))}</span>" for f in (0, 0.5, 1))
    words = escape(title.replace("\n", ": ", 1).replace("\n", " "))
    return (
        f'<div class="picture-scale"><p>{words}</p>'
        f'<i style="background: linear-gradient(to right, {steps})"></i>{"".join(values)}</div>'
    )


def label_logarithms(axis: Axis, is_narrow: bool) -> None:
    """Label a logarithmic axis.

    A narrow axis has the labels 1, 2, 5, 10, …, and any other axis has powers of ten.
    """
    axis.set_major_locator(LogLocator(subs=(1, 2, 5) if is_narrow else (1,)))
    axis.set_major_formatter(lambda value, _: f"{value:,.12g}")
    axis.set_minor_formatter(NullFormatter())


def _label_in_full(axis: Axis) -> None:
    """Label a linear axis with complete numbers such as 1,497.005, without an offset."""
    ticks = axis.get_majorticklocs()
    step = float(np.diff(ticks[:2])[0]) if len(ticks) > 1 else 1.0
    decimals = next((n for n in range(12) if math.isclose(step, round(step, n))), 12)
    axis.set_major_formatter(
        lambda value, _: f"{round(value, decimals) + 0.0:,.{decimals}f}".replace("-", "−")
    )


def _grid(shot: SurfaceView) -> Floats:
    """Return lines on the ground: its border, and one line for each tick.

    The shape is (n, 2, 3).
    """
    (x0, y0), (x1, y1) = shot.stage.ground.tolist()
    level = shot.stage.level
    x_ticks, y_ticks = (axis.ticks.tolist() for axis in shot.stage.axes[:2])
    return np.array(
        [((x, y0, level), (x, y1, level)) for x in (x0, *x_ticks, x1)]
        + [((x0, y, level), (x1, y, level)) for y in (y0, *y_ticks, y1)]
    )


def _axis_edges(shot: SurfaceView) -> list[tuple[Floats, Floats, Floats]]:
    """Return the ends of the x, y, and z axes, and their outward directions in pixels."""
    corners = shot.stage.corners
    flat, _ = shot.camera.project(corners)
    middle, _ = shot.camera.project(corners.mean(axis=0)[None])
    edges = []
    for sides in (((0, 1), (3, 2)), ((0, 3), (1, 2))):  # corners along x and along y
        a, b = max(sides, key=lambda side: float(flat[list(side), 1].mean()))  # the nearer one
        direction = flat[b] - flat[a]
        outward = np.array([direction[1], -direction[0]]) / np.linalg.norm(direction)
        outward *= np.sign(outward @ ((flat[a] + flat[b]) / 2 - middle[0]))
        edges.append((corners[a], corners[b], outward))
    foot = corners[np.argmin(flat[:, 0])]
    top = np.array([*foot[:2], shot.stage.bounds[1, 2]])
    return [*edges, (foot, top, np.array([-1.0, 0.0]))]


def robot_name(name: str) -> str:
    """Return the robot's name for a link named ROBOT/LINK, or the name of any other actor."""
    # Names of traffic actors contain a file name in parentheses, which may include a slash.
    return name if "(" in name else name.partition("/")[0]

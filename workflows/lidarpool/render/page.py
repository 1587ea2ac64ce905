"""The finished picture: a rendered image with axes, legend, colour bar and title."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import IO

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import ListedColormap, LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray

from ..base.errors import LidarpoolError
from .labels import axis_labels
from .overlay import visible, visible_runs
from .shot import Shot
from .theme import Theme

Floats = NDArray[np.float64]

DPI = 200
FONT = "DejaVu Sans"  # comes with matplotlib
MANY_POSES = 40  # more than this are drawn as small dots
MOST_POSES = 800
LEGEND_ROWS = 30
LEGEND_LETTERS = 18


class Page:
    """One picture being put together.

    Parameters
    ----------
    size
        Width and height in pixels.
    theme
        Its colours.
    """

    def __init__(self, size: tuple[int, int], theme: Theme) -> None:
        self.theme = theme
        self.size = size
        self.figure = Figure(figsize=(size[0] / DPI, size[1] / DPI), dpi=DPI, facecolor=theme.page)
        FigureCanvasAgg(self.figure)
        self.unit = size[0] / 1600  # fonts and lines grow with the picture

    def show(self, shot: Shot, image: Floats) -> Axes:
        """Fill the page with a painted shot and put numbers along its axes.

        The axes that come back have the shot's pixels as coordinates.
        """
        axes = self.figure.add_axes((0, 0, 1, 1))
        axes.set_axis_off()
        width, height = shot.camera.size
        axes.imshow(image, extent=(0, width, height, 0), interpolation="bilinear", aspect="auto")
        axes.set(xlim=(0, width), ylim=(height, 0))
        labels, lines = axis_labels(shot.stage, shot.camera)
        marks = [label.mark for label in labels if label.mark is not None]
        corners = shot.stage.corners
        border = visible_runs(shot, np.stack([corners, np.roll(corners, -1, axis=0)], axis=1), 5.0)
        for drawn, colour in ((border, self.theme.line), ([*marks, *lines], self.theme.muted)):
            axes.add_collection(LineCollection(drawn, colors=colour, linewidths=0.6 * self.unit))
        for label in labels:
            title = label.mark is None
            axes.text(
                float(label.place[0]), float(label.place[1]), label.text,
                rotation=label.angle_deg, ha="center", va="center",
                fontsize=(7.2 if title else 6.6) * self.unit,
                color=self.theme.ink if title else self.theme.muted, family=FONT,
            )  # fmt: skip
        return axes

    def title(self, text: str, detail: str = "") -> None:
        """Write a title at the top left, and a line of detail under it."""
        line = 0.05 * self.size[0] / self.size[1] / 1.6
        self.figure.text(
            0.03, 1 - line, text, fontsize=11 * self.unit, fontweight="bold",
            color=self.theme.ink, va="center", family=FONT,
        )  # fmt: skip
        self.figure.text(
            0.03, 1 - 1.84 * line, detail, fontsize=7.2 * self.unit, color=self.theme.muted,
            va="center", family=FONT,
        )  # fmt: skip

    def sensors(self, axes: Axes, shot: Shot, poses: Floats) -> None:
        """Mark sensor positions (p, 3), hollow where something hides them, each on a stem."""
        many = len(poses) > MANY_POSES
        poses = poses[np.linspace(0, len(poses) - 1, min(len(poses), MOST_POSES)).astype(int)]
        pixels, seen = visible(shot, poses)
        if not many:
            feet = poses.copy()
            feet[:, 2] = shot.stage.level
            self.lines(axes, shot, np.stack([poses, feet], axis=1), self.theme.sensor, 0.8, 0.7)
        looks = (
            (seen, self.theme.sensor, self.theme.page),
            (~seen & np.isfinite(pixels).all(axis=1), "none", self.theme.sensor),
        )
        for which, face, edge in looks:
            axes.scatter(
                pixels[which, 0], pixels[which, 1], s=(5 if many else 20) * self.unit**2,
                facecolors=face, edgecolors=edge, linewidths=(0.2 if many else 0.7) * self.unit,
                zorder=5,
            )  # fmt: skip

    def lines(
        self, axes: Axes, shot: Shot, segments: Floats, colour: str, width: float, alpha: float
    ) -> None:
        """Draw the parts of segments (n, 2, 3) that nothing hides."""
        axes.add_collection(
            LineCollection(
                visible_runs(shot, segments), colors=colour, linewidths=width * self.unit,
                alpha=alpha, capstyle="round", zorder=4,
            )
        )  # fmt: skip

    def legend(self, entries: Sequence[tuple[str, object]], sensors: bool = False) -> None:
        """Name colours in the page's right margin.

        Parameters
        ----------
        entries
            (name, colour); what does not fit is counted in a last line.
        sensors
            Whether a line for the sensor marker is added.
        """
        rows = [(name, colour, "s") for name, colour in entries[:LEGEND_ROWS]]
        if sensors:
            rows.append(("Sensor", self.theme.sensor, "o"))
        if len(entries) > LEGEND_ROWS:
            rows.append((f"and {len(entries) - LEGEND_ROWS:,} more", "none", "s"))
        size = min(7.4, 175 / max(len(rows), 1))
        self.key(
            [
                Line2D([], [], ls="", marker=marker, color=colour, ms=0.85 * size * self.unit,
                       mec="none", label=shortened(name))
                for name, colour, marker in rows
            ],
            size,
        )  # fmt: skip

    def key(self, handles: list[Line2D], size: float) -> None:
        """Put a legend of handles into the page's right margin; `size` of the font in points."""
        if handles:
            legend = self.figure.legend(
                handles, ["x"] * len(handles), loc="center left", bbox_to_anchor=(0.842, 0.5),
                frameon=False, labelcolor=self.theme.ink, labelspacing=0.55, handletextpad=0.5,
                borderpad=0, handlelength=1.4, prop={"family": FONT, "size": size * self.unit},
            )  # fmt: skip
            # Names come from files: matplotlib leaves out those that begin with an underscore,
            # and stumbles over what looks like a formula and is none ("$\\frac{x$").
            for text, handle in zip(legend.get_texts(), handles, strict=True):
                text.set_parse_math(False)
                text.set_text(str(handle.get_label()))

    def colour_bar(self, colours: Floats, norm: Normalize, title: str) -> None:
        """Draw a colour bar of colours (n, 3) in the right margin, its title beside it."""
        axes = self.figure.add_axes((0.862, 0.27, 0.014, 0.46))
        bar = self.figure.colorbar(ScalarMappable(norm, ListedColormap(colours)), cax=axes)
        bar.outline.set_visible(False)
        bar.set_label(title, fontsize=7.6 * self.unit, color=self.theme.ink, family=FONT)
        axes.tick_params(
            which="both", labelsize=6.6 * self.unit, color=self.theme.muted, width=0.6 * self.unit,
            labelcolor=self.theme.muted, labelfontfamily=FONT, length=2.5 * self.unit,
        )  # fmt: skip
        axes.tick_params(which="minor", length=1.5 * self.unit)
        if isinstance(norm, LogNorm):
            axes.yaxis.set_major_formatter(lambda value, _: f"{value:,.12g}")
            axes.yaxis.set_minor_formatter(lambda value, _: "")

    def note(self, axes: Axes, text: str) -> None:
        """Write a remark into the middle of the picture."""
        halo = [withStroke(linewidth=3 * self.unit, foreground=self.theme.page)]
        axes.text(
            0.43, 0.5, text, transform=axes.transAxes, ha="center", va="center",
            fontsize=9 * self.unit, color=self.theme.muted, path_effects=halo, family=FONT,
        )  # fmt: skip

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the page under a temporary name in the same folder, then rename it.

        It is a PDF where the name says so, and else a PNG.

        Raises
        ------
        LidarpoolError
            If the folder is not there or cannot be written to. A file that was there before is
            left as it was.
        """
        target = Path(path)
        try:
            handle, name = tempfile.mkstemp(
                prefix=f".{target.stem}-", suffix=target.suffix, dir=target.parent
            )
        except OSError as error:
            raise cannot_write(target, error) from error
        temporary = Path(name)
        try:
            with os.fdopen(handle, "wb") as file:
                self._write(file, "pdf" if target.suffix.lower() == ".pdf" else "png")
            temporary.chmod(0o644)
            temporary.replace(target)
        except OSError as error:
            raise cannot_write(target, error) from error
        finally:
            temporary.unlink(missing_ok=True)
        return target

    def _write(self, file: IO[bytes], kind: str) -> None:
        """Write the page as "png" or "pdf"."""
        # No versions and no date in the file: the same picture is the same bytes.
        silent = ("Software",) if kind == "png" else ("Creator", "Producer", "CreationDate")
        # Journals ask for fonts of type 42, which can be edited; the default is 3.
        with matplotlib.rc_context({"pdf.fonttype": 42}):
            self.figure.savefig(file, format=kind, dpi=DPI, metadata=dict.fromkeys(silent))


def cannot_write(target: Path, error: OSError) -> LidarpoolError:
    """Say why a picture could not be written."""
    return LidarpoolError(
        f"The picture {target} could not be written: {error.strerror or error}. "
        "Choose a folder that exists, can be written to and has room."
    )


def shortened(name: str) -> str:
    """Cut a long name in its middle, so that it fits the legend; control characters show."""
    name = "".join(letter if letter.isprintable() else "\ufffd" for letter in name)
    if len(name) <= LEGEND_LETTERS:
        return name
    keep = LEGEND_LETTERS - 1
    return f"{name[: keep - keep // 2]}…{name[-(keep // 2) :]}"

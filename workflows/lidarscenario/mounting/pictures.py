"""Pictures of candidates: blind areas, points on targets, and trade-offs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PolyCollection
from matplotlib.colors import BoundaryNorm, ListedColormap, LogNorm, to_rgb
from matplotlib.patheffects import withStroke
from matplotlib.projections.polar import PolarAxes
from matplotlib.transforms import Bbox

from lidarsim.motion.trajectory import Pose
from lidarsim.numerics.arrays import Bools, Floats, Ints
from lidarsim.words import shorten_name
from lidarview.render import theme
from lidarview.render.picture_page import FONT, Page

from .evaluation import SHARE_DEG
from .ranking import CandidateResult, points_by_position
from .study import MountRanking, MountStudy

_MAX_LABELS = 12  # labeled candidates on the trade-off curve
# Offsets of a label from its point, and its alignment.
_LABEL_SIDES = (
    (-3, 3, "right", "bottom"),
    (0, 5, "center", "bottom"),
    (5, 0, "left", "center"),
    (-5, 0, "right", "center"),
    (0, -5, "center", "top"),
    (3, 3, "left", "bottom"),
    (3, -3, "left", "top"),
    (-3, -3, "right", "top"),
)
MAX_PANELS = 6  # maximum number of candidates or target classes on a page
MAPS = ("blind", "redundancy")  # pictures of a single map with a legend
_SIZE = (1600, 1200)
# Layout of pages with several charts, pixels.
_LEFT = 80
_TOP = 190
_GAP = 110  # between rows of charts
_PANELS_WIDTH = 1340
# Colors from "ground visible" to "blind to objects of the maximum height".
_BANDS = ("#eef3f7", "#d8daeb", "#b2abd2", "#8073ac", "#542788", "#46207a", "#381868", "#2d004b",
          "#1c0030")  # fmt: skip
_VEHICLE = "#7d8794"
_COUNTS = ("#e08214", "#d1e5f0", "#67a9cf", "#2166ac")  # cells seen by 0, 1, 2, and 3 or more
_FRONT = "#d6336c"
_OTHER = "#5b8fd0"


class _PanelGrid(NamedTuple):
    """Charts of equal size on a page, in pixels."""

    charts: int
    width: int
    height: int

    @property
    def columns(self) -> int:
        """Number of charts side by side."""
        return min(self.charts, 2 if self.charts == 4 else 3)

    @property
    def page(self) -> Page:
        """An empty page of the required height."""
        rows = -(-self.charts // self.columns)
        return Page((_SIZE[0], _TOP + rows * (self.height + _GAP)))

    def frames(self, page: Page) -> list[tuple[float, float, float, float]]:
        """Return the position and size of each chart in fractions of the page."""
        width, height = page.size
        pitch = (_PANELS_WIDTH - _LEFT) / self.columns
        frames = []
        for number in range(self.charts):
            row, column = divmod(number, self.columns)
            x = _LEFT + column * pitch
            y = height - _TOP - row * (self.height + _GAP) - self.height
            frames.append((x / width, y / height, self.width / width, self.height / height))
        return frames


def draw_blind_area(result: MountRanking) -> Page:
    """Draw the blind area of the best candidate, with the vehicle and its sensors."""
    page = Page(_SIZE)
    axes = page.chart((0.07, 0.08, 0.74, 0.76))
    _draw_map(
        page, axes, result.study, _bands(result.study, result.best), _band_colors(result.study)
    )
    _mark_sensors(page, axes, result.best, named=True)
    page.legend(
        [*zip(_band_names(result.study), _band_colors(result.study), strict=True)], "sensor"
    )
    height = result.study.rules.ranked_height_m
    blind = result.best.blind_m2[height]
    page.title(
        f"Blind area of {result.best.candidate.name}",
        f"{blind:,.1f} of {result.best.map_m2:,.0f} m² around the vehicle are blind to objects of "
        f"{height:g} m; forward is up",
    )
    return page


def draw_comparison(result: MountRanking) -> Page:
    """Draw the blind areas of the best candidates side by side."""
    shown = result.ranked[:MAX_PANELS]
    grid = _PanelGrid(len(shown), 360, 420)
    page = grid.page
    colors = _band_colors(result.study)
    height = result.study.rules.ranked_height_m
    for frame, candidate in zip(grid.frames(page), shown, strict=True):
        axes = page.chart(frame)
        _draw_map(page, axes, result.study, _bands(result.study, candidate), colors)
        _mark_sensors(page, axes, candidate, named=False)
        name = shorten_name(candidate.candidate.name, 36)
        page.heading(axes, f"{name}\n{candidate.blind_m2[height]:,.1f} m² at {height:g} m")
        axes.set_ylabel("")
    page.legend([*zip(_band_names(result.study), colors, strict=True)], "sensor")
    page.title(
        "Blind areas of the candidates",
        "in order of rank; vertical: x, m; forward is up",
    )
    return page


def draw_redundancy(result: MountRanking) -> Page:
    """Draw how many sensors of the best candidate see an object in each cell."""
    study = result.study
    height = study.rules.ranked_height_m
    lowest = np.stack([sensor.lowest_m for sensor in result.best.sensors.values()])
    counts = (lowest <= np.float32(height)).sum(axis=0).clip(0, len(_COUNTS) - 1)
    page = Page(_SIZE)
    axes = page.chart((0.07, 0.08, 0.74, 0.76))
    _draw_map(page, axes, study, counts, _COUNTS)
    _mark_sensors(page, axes, result.best, named=True)
    words = ("no sensor", "1 sensor", "2 sensors", "3 or more sensors")
    shown = min(len(lowest) + 1, len(_COUNTS))
    page.legend([*zip(words[:shown], _COUNTS[:shown], strict=True)], "sensor")
    page.title(
        f"Redundancy of {result.best.candidate.name}",
        f"number of sensors that see an object of {height:g} m",
    )
    return page


def draw_points(result: MountRanking) -> Page:
    """Plot the points on targets by distance and bearing for each class, for the best candidate."""
    placements = result.study.placements
    rows = [k for k in range(len(placements.targets)) if (placements.target == k).any()]
    rows = rows[:MAX_PANELS]
    grid = _PanelGrid(len(rows), 370, 370)
    page = grid.page
    norm = LogNorm(1, max(10.0, float(result.best.points.max())))
    colors = theme.apply_colormap("viridis", np.linspace(0, 1, 256))
    for frame, target in zip(grid.frames(page), rows, strict=True):
        axes = page.figure.add_axes(frame, projection="polar")
        assert isinstance(axes, PolarAxes)
        _draw_polar(page, axes, result.best, result, target, norm)
        needed = placements.targets[target]
        rate = result.best.detection[needed.name]
        page.heading(
            axes,
            f"{needed.name}: {rate:.0%} (≥ {needed.points} points)",
            pad=14 * page.unit,
        )
    page.color_bar(colors, norm, "points on the target")
    page.title(
        f"Points on targets of {result.best.candidate.name}",
        "mean over all headings, by distance in meters and bearing; gray: no points; forward is up",
    )
    return page


def draw_detection(result: MountRanking) -> Page:
    """Plot the detection probability of the best candidate by distance, and the trade-off."""
    page = Page((1600, 760))
    axes = page.chart(
        (0.06, 0.13, 0.36, 0.62), xlabel="distance, m", ylabel="share with enough points",
        ylim=(-0.03, 1.03),
    )  # fmt: skip
    placements = result.study.placements
    enough = np.array([t.points for t in placements.targets])[placements.target]
    detected = result.best.points >= enough
    handles = []
    for number, target in enumerate(placements.targets):
        rows = np.flatnonzero(placements.target == number)
        if not len(rows):
            continue
        distances, shares = _by_distance(placements.distances_m[rows], detected[rows])
        color = theme.OBJECT_COLORS[number % len(theme.OBJECT_COLORS)]
        # Later lines are thinner, so that equal lines remain visible.
        width = 1.4 + 3.6 * (1 - (number + 1) / len(placements.targets))
        (line,) = axes.plot(
            distances, shares, "o-", color=color, lw=width * page.unit,
            ms=(width + 2.2) * page.unit, mew=0,
        )  # fmt: skip
        line.set_label(shorten_name(f"{target.name} (≥ {target.points})", 28))
        handles.append(line)
    page.key(handles, 6.6, bbox_to_anchor=(0.43, 0.45))
    page.heading(axes, f"Detection by distance: {shorten_name(result.best.candidate.name, 40)}")
    _draw_tradeoff(page, result)
    page.title("Detection and trade-off")
    return page


def _draw_tradeoff(page: Page, result: MountRanking) -> None:
    """Plot all candidates by detection rate and blind area."""
    height = result.study.rules.ranked_height_m
    axes = page.chart(
        (0.645, 0.13, 0.335, 0.62), xlabel=f"blind area at {height:g} m, m²",
        ylabel="detection rate",
    )  # fmt: skip
    blind = np.array([one.blind_m2[height] for one in result.ranked])
    rates = np.array([one.detection_rate for one in result.ranked])
    front = result.on_front
    axes.plot(blind[~front], rates[~front], "o", color=_OTHER, ms=4 * page.unit, mew=0, alpha=0.7)
    order = np.flatnonzero(front)[np.argsort(blind[front], kind="stable")]
    axes.plot(blind[order], rates[order], "o-", color=_FRONT, ms=5 * page.unit, lw=1.4 * page.unit)
    axes.margins(0.18)
    best = range(min(len(result.ranked), MAX_PANELS))
    labels = dict.fromkeys([*order[:_MAX_LABELS].tolist(), *best])
    names = {index: result.ranked[index].candidate.name for index in labels}
    _label_points(page, axes, np.column_stack([blind, rates]), names, set(order.tolist()))
    page.heading(axes, "Candidates; the trade-off curve is red")


def _label_points(
    page: Page, axes: Axes, points: Floats, names: Mapping[int, str], required: Set[int]
) -> None:
    """Label each point on the first side that is free of other labels and points.

    `points` has shape (n, 2). Points are labeled if they have a name. Labels in `required` may
    cover points. Other labels are omitted if no side is free.
    """
    halo = [withStroke(linewidth=2 * page.unit, foreground=theme.GROUND)]
    canvas = FigureCanvasAgg(page.figure)
    canvas.draw()
    frame = axes.get_window_extent(canvas.get_renderer())
    radius = 3 * page.unit * page.figure.dpi / 72
    dots = [Bbox([dot - radius, dot + radius]) for dot in axes.transData.transform(points)]
    taken: list[Bbox] = []
    for index, name in names.items():
        attempts = [(side, [*taken, *dots]) for side in _LABEL_SIDES]
        if index in required:
            attempts += [(side, taken) for side in _LABEL_SIDES]
        for (x, y, horizontal, vertical), obstacles in attempts:
            label = axes.annotate(
                shorten_name(name, 24), points[index], xytext=(x * page.unit, y * page.unit),
                textcoords="offset points", ha=horizontal, va=vertical, fontsize=6.4 * page.unit,
                color=theme.INK, family=FONT, path_effects=halo, parse_math=False,
            )  # fmt: skip
            extent = label.get_window_extent(canvas.get_renderer())
            is_inside = frame.containsx(extent.x0) and frame.containsx(extent.x1)
            is_inside = is_inside and frame.containsy(extent.y0) and frame.containsy(extent.y1)
            if is_inside and not extent.count_overlaps(obstacles):
                taken.append(extent)
                break
            label.remove()


def _by_distance(distances: Floats, values: Bools) -> tuple[Floats, Floats]:
    """Return the mean of values at each distance, or in ten bins if there are many distances."""
    unique = np.unique(distances.round(3))
    if len(unique) > 12:
        edges = np.linspace(0, unique[-1], 11)
        unique = (edges[1:] + edges[:-1]) / 2
        owner = np.minimum(np.searchsorted(edges, distances, "right") - 1, 9)
    else:
        owner = np.searchsorted(unique, distances.round(3))
    counts = np.bincount(owner, minlength=len(unique))
    totals = np.bincount(owner, values, minlength=len(unique))
    return unique[counts > 0], totals[counts > 0] / counts[counts > 0]


def draw_blocked(result: MountRanking) -> Page:
    """Draw the beams that the vehicle blocks, for each sensor of the best candidate."""
    shown = [*result.best.sensors.items()][:MAX_PANELS]
    page = Page((1600, 130 + 330 * len(shown)))
    height = page.size[1]
    for row, (name, sensor) in enumerate(shown):
        share = sensor.blocked_share
        rows = np.flatnonzero(np.isfinite(share).any(axis=1))
        low, high = int(rows[0]), int(rows[-1]) + 1
        bottom = (height - 110 - 330 * (row + 1) + 80) / height
        limits = (low * SHARE_DEG - 90, high * SHARE_DEG - 90)
        axes = page.chart((0.07, bottom, 0.76, 210 / height), ylabel="elevation, °")
        image = np.ones((*share.shape, 3)) * to_rgb(theme.UNSEEN)
        known = np.isfinite(share)
        light, dark = np.array(to_rgb("#d1e5f0")), np.array(to_rgb("#b2182b"))
        image[known] = light + share[known, None] * (dark - light)
        axes.imshow(
            image[low:high, ::-1], aspect="auto", origin="lower", interpolation="nearest",
            extent=(180, -180, *limits),
        )  # fmt: skip
        axes.grid(False)
        axes.set_xlabel("azimuth in the sensor frame, ° (positive is left)")
        _mark_directions(page, axes, result.best.candidate.mounts[name])
        page.heading(axes, f"{name}: {sensor.blocked / sensor.beams:.1%} of the beams are blocked")
    page.legend([("free", "#d1e5f0"), ("blocked", "#b2182b"), ("no beams", theme.UNSEEN)], "")
    page.title("Occlusion by the vehicle")
    return page


def _mark_directions(page: Page, axes: Axes, mount: Pose) -> None:
    """Mark the azimuths of the vehicle's front and rear in the frame of a sensor."""
    forward = mount.rotation_matrix[0]
    front = float(np.degrees(np.arctan2(forward[1], forward[0])))
    halo = [withStroke(linewidth=2 * page.unit, foreground=theme.PAGE)]
    top = axes.get_ylim()[1]
    for azimuth, word in ((front, "front"), (front + 180, "rear")):
        azimuth = (azimuth + 180) % 360 - 180
        offset = -3 if azimuth < -150 else 3
        axes.axvline(azimuth, color=theme.INK, lw=0.8 * page.unit, ls="--")
        axes.annotate(
            word, (azimuth, top), xytext=(offset * page.unit, -3 * page.unit),
            ha="right" if offset < 0 else "left", va="top", textcoords="offset points",
            fontsize=6.4 * page.unit, color=theme.INK, family=FONT, path_effects=halo,
        )  # fmt: skip


def _bands(study: MountStudy, candidate: CandidateResult) -> Ints:
    """Return the index of the lowest visible height of the map in each cell."""
    heights = np.array(study.rules.heights_m, np.float32)
    bands: Ints = (candidate.lowest_m[..., None] > heights).sum(axis=-1)
    return bands


def _band_names(study: MountStudy) -> list[str]:
    """Return the legend entries of the bands."""
    heights = study.rules.heights_m
    words = [
        "ground visible" if height == 0 else f"visible from {height:g} m" for height in heights
    ]
    return [*words, f"blind to {heights[-1]:g} m"]


def _band_colors(study: MountStudy) -> tuple[str, ...]:
    return _BANDS[: len(study.rules.heights_m) + 1]


def _draw_map(
    page: Page, axes: Axes, study: MountStudy, kinds: Ints, colors: Sequence[str]
) -> None:
    """Draw the kind of each cell in a color, with the vehicle on top. Forward is up."""
    grid = study.evaluator.grid
    extent_x = (grid.x, grid.x + grid.columns * grid.cell_m)
    extent_y = (grid.y, grid.y + grid.rows * grid.cell_m)
    norm = BoundaryNorm(np.arange(len(colors) + 1) - 0.5, len(colors))
    image = ListedColormap(colors)(norm(kinds))[..., :3]
    # The rows of the picture are x, and its columns are y, which decreases to the right.
    axes.imshow(
        image.swapaxes(0, 1)[:, ::-1], origin="lower", interpolation="nearest",
        extent=(extent_y[1], extent_y[0], *extent_x),
    )  # fmt: skip
    axes.grid(False)
    axes.set_aspect("equal")
    axes.set(xlabel="y, m", ylabel="x, m")
    body = study.evaluator.body
    corners = body.vertices[body.faces][..., [1, 0]]
    axes.add_collection(PolyCollection(list(corners), facecolors=_VEHICLE, edgecolors="none"))


def _mark_sensors(page: Page, axes: Axes, candidate: CandidateResult, *, named: bool) -> None:
    """Draw the sensors of a candidate as dots, with their names."""
    halo = [withStroke(linewidth=2 * page.unit, foreground=theme.PAGE)]
    for name, pose in candidate.candidate.mounts.items():
        x, y, _ = pose.position
        axes.plot([y], [x], "o", color=theme.SENSOR, ms=4 * page.unit, mec=theme.PAGE)
        if named:
            axes.annotate(
                shorten_name(name, 20), (y, x), xytext=(0, 5 * page.unit), ha="center",
                textcoords="offset points", fontsize=6.6 * page.unit, color=theme.INK,
                family=FONT, path_effects=halo, parse_math=False,
            )  # fmt: skip


def _draw_polar(
    page: Page,
    axes: PolarAxes,
    candidate: CandidateResult,
    result: MountRanking,
    target: int,
    norm: LogNorm,
) -> None:
    """Plot the points on a class of targets in a polar chart."""
    placements = result.study.placements
    axes.set_theta_zero_location("N")
    axes.set_facecolor(theme.GROUND)
    axes.grid(False)
    if result.study.vehicle.traffic is not None:
        rows = np.flatnonzero(placements.target == target)
        points = candidate.points[rows]
        colors = theme.apply_colormap("viridis", np.asarray(norm(np.maximum(points, 1)).data))
        colors[points == 0] = to_rgb(theme.UNSEEN)
        angles = np.radians(placements.bearings_deg[rows])
        axes.scatter(angles, placements.distances_m[rows], c=colors, s=6 * page.unit**2, lw=0)
    else:
        distances, bearings, mean = points_by_position(candidate, placements, target)
        rings = np.arange(len(distances) + 1)
        half = np.pi / len(bearings)
        edges = np.radians(np.append(bearings, bearings[0] + 360)) - half
        colors = theme.apply_colormap("viridis", np.asarray(norm(np.maximum(mean, 1)).data))
        colors[mean == 0] = to_rgb(theme.UNSEEN)
        colors[~np.isfinite(mean)] = to_rgb(_VEHICLE)
        axes.pcolormesh(edges, rings, np.zeros(mean.shape), shading="flat").set(
            array=None, facecolors=colors.reshape(-1, 3)
        )
        axes.set_yticks(rings[:-1] + 0.5, [f"{distance:g}" for distance in distances])
    axes.set_xticks([])
    axes.spines[:].set(color=theme.LINE, linewidth=0.6 * page.unit)
    axes.tick_params(labelsize=5.8 * page.unit, labelcolor=theme.INK, labelfontfamily=FONT)
    for label in axes.get_yticklabels():
        label.set_path_effects([withStroke(linewidth=1.6 * page.unit, foreground=theme.PAGE)])
    axes.set_rlabel_position(22.5)


def draw_all(result: MountRanking) -> dict[str, Page]:
    """Return all pictures of a ranking by name."""
    pictures = {"blind": draw_blind_area(result)}
    if len(result.ranked) > 1:
        pictures["comparison"] = draw_comparison(result)
    if len(result.best.sensors) > 1:
        pictures["redundancy"] = draw_redundancy(result)
    pictures["points"] = draw_points(result)
    pictures["detection"] = draw_detection(result)
    pictures["blocked"] = draw_blocked(result)
    return pictures

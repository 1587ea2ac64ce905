"""Draw images of a result, which show the scene, hits, points, intensity and planned path."""

from __future__ import annotations

import itertools
import math
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PatchCollection
from matplotlib.lines import Line2D
from matplotlib.patches import Circle
from matplotlib.patheffects import withStroke

from lidarfiles.clouds.folder import result_folder
from lidarfiles.picture_file import PictureContent, PlannedPath, PlanningPicture, moving_positions
from lidarfiles.work.publishing import move_into_place
from lidarscenario.plan.stations import StationPlan, StationVisibility
from lidarsim.columns.cloud import Cloud
from lidarsim.columns.cloud_file import CloudFile
from lidarsim.columns.table import TABLE, X, Y, Z
from lidarsim.errors import LidarError, explain_os_errors
from lidarsim.io.storage import Storage, staging
from lidarsim.io.writing_progress import WritingProgress
from lidarsim.numerics.arrays import Bools, Floats, Ints
from lidarsim.numerics.even_samples import even_indices
from lidarsim.schema.vocabulary import PICTURES
from lidarsim.words import did_you_mean, join_alternatives, plural
from lidarview.render import theme
from lidarview.render.coloring import add_composed_columns
from lidarview.render.picture_page import DPI, FONT, LEFT_LABEL, RIGHT_LABEL, Page
from lidarview.render.pictures import MAX_POINTS, draw_cloud, draw_hits, draw_scene
from lidarview.render.shot import SIZE, RaySamples, SurfaceView, take_shot
from lidarview.render.surface import normalize

from .page.rendering import insert_picture
from .result_files import PAGE

MIN_SIDE = 480  # pixels; text would be illegible in smaller pictures
MAX_SIDE = 4096  # pixels; drawing takes 0.4 kB of memory per pixel
_LIGHT = ("reflectance", "intensity")  # columns for the intensity picture, in order of preference
MAX_RATIO = 2  # maximum aspect ratio for which legends fit
FRAME = (0.085, 0.115, 0.70, 0.755)  # left, bottom, width and height of the plot on the page
MAX_TRIALS = 1000
_BEST_WIDTH = 1.4  # line width of the best path, points
PATH_COLOR = "#d6336c"
TRIAL_COLOR = "#5b8fd0"
# HIDDEN surfaces are not visible from any candidate, and OTHER surfaces are not targets.
COVERED, UNCOVERED, HIDDEN, OTHER = range(4)
COLORS = np.stack([theme.rgb(c) for c in ("#5b9bd5", "#ee7733", theme.CLAY, "#c8bda6")])
_BLOCK = 4  # side length of a block in pixels


def publish_pictures(
    shown: PictureContent,
    result: Path,
    target: Path | Storage,
    page: Path | None,
    *,
    only: Sequence[str] = (),
    size: tuple[int, int] = SIZE,
    color: str = Z.name,
) -> list[str]:
    """Draw images of a result, and write them to a folder or storage when all are complete.

    Parameters
    ----------
    target
        Folder or storage for the pictures, created if necessary.
    page
        Existing report.html of the target, into which the pictures are inserted.

    The other parameters are those of `draw_pictures`.

    Returns
    -------
    The names of the pictures.

    Raises
    ------
    LidarError
        If raised by `draw_pictures`, or if the target cannot be written to.
    """
    with (
        explain_os_errors(f"The pictures cannot be written to {target}", "free some disk space"),
        result_folder(target) as folder,
        staging(folder, target) as staged,
    ):
        if page is not None and page.exists():
            shutil.copyfile(page, staged / PAGE)
        names = [path.name for path in draw_pictures(shown, result, staged, only, size, color)]
        move_into_place(staged, target, last=names[-1])
    return names


def draw_pictures(
    shown: PictureContent,
    result: Path,
    folder: Path,
    only: Sequence[str] = (),
    size: tuple[int, int] = SIZE,
    color: str = Z.name,
    show: WritingProgress = lambda *_: None,
) -> Iterator[Path]:
    """Draw images of a result, save them in a folder, and insert them into its report.html.

    All pictures of the scene have the same viewpoint. The path is only drawn if one was planned.
    Points in sensor coordinates are not drawn, because they cannot be combined with the scene.

    Parameters
    ----------
    shown
        Content of the pictures.
    result
        Folder of the result, which contains the cloud.
    folder
        Folder for the pictures.
    only
        Names of the pictures to draw. By default, all available pictures are drawn.
    size
        Width and height in pixels.
    color
        Column by which the cloud is colored.
    show
        Function that shows the progress.

    Yields
    ------
    The path of each picture after it has been saved.

    Raises
    ------
    LidarError
        If a picture is unknown or not available, or if its size is not supported.
    """
    cloud = result / "cloud.ply"
    page = folder / PAGE
    shorter = min(size)
    longer = max(size)
    if shorter < MIN_SIDE or longer > MAX_SIDE or longer > MAX_RATIO * shorter:
        raise LidarError(
            f"A picture cannot have {size[0]} x {size[1]} pixels. Its width and height must "
            f"be from {MIN_SIDE} to {MAX_SIDE} pixels, and neither may be more than twice the "
            "other. For example, use 1600 x 1000."
        )
    makers = _picture_makers(shown, cloud, size, color)
    for name in only:
        if name not in PICTURES:
            advice = did_you_mean(name, PICTURES) or f" Available pictures: {', '.join(PICTURES)}."
            raise LidarError(f"There is no picture {name!r}.{advice}")
        if name not in makers:
            why = f"the cloud has no column {join_alternatives(_LIGHT)}"
            if name == "path":
                why = "no path was planned in its run"
            elif shown.coordinates == "sensor":
                why = "its points are in sensor coordinates"
            raise LidarError(f"The picture {name!r} cannot be drawn, because {why}.")
    names = only or [*makers]
    for number, name in enumerate(names):
        show("pictures", number, len(names), "pictures")
        path = folder / f"{name}.png"
        picture = makers[name]()
        picture.save(path)
        if page.exists():
            insert_picture(page, name, picture.html())
        yield path
    show("pictures", len(names), len(names), "pictures")


def _picture_makers(
    shown: PictureContent, cloud: Path, size: tuple[int, int], color: str
) -> dict[str, Callable[[], Page]]:
    """Return the function that draws each image, keyed by the name of the image.

    The functions read the file `cloud` on demand.
    """
    columns = [column.name for column in CloudFile(cloud).table] if cloud.exists() else []
    alone = shown.coordinates == "sensor"
    middle = shown.duration_ns / 2

    @cache
    def shot() -> SurfaceView:
        # A moving sensor is drawn as a line for its trajectory, with a marker at half the duration.
        positions = [w.position_at(middle)[None] if w.moves else w.positions for w in shown.sensors]
        scene = shown.scene
        return take_shot(
            scene.solid(middle),
            np.concatenate([np.empty((0, 3)), *positions]) + scene.origin,
            paths=[sensor.positions for sensor in shown.sensors if sensor.moves],
            trajectories=moving_positions(shown.sensors, scene.actors, shown.duration_ns),
            actors=len(scene.actors),
            caption=shown.caption,
            models=shown.models,
            size=size,
        )

    @cache
    def points() -> Cloud:
        return CloudFile(cloud, shown.extra_columns).choose(MAX_POINTS)

    def draw_counts() -> Page:
        hit_points = np.empty((0, 3)) if alone else points().positions - shown.scene.origin
        return draw_hits(shot(), shown.hit_counts, hit_points, shown.sample_rays, shown.keep_every)

    def draw_points() -> Page:
        file = CloudFile(cloud, shown.extra_columns)
        columns_by_name = add_composed_columns(
            {name: c for c in (Z, X, Y, *file.table) for name in (c.name, c.in_files)}
        )
        if color not in columns_by_name:
            names = dict.fromkeys(column.name for column in columns_by_name.values())
            available = f" Available columns: {', '.join(names)}."
            raise LidarError(
                f"{cloud} has no column {color!r}."
                f"{did_you_mean(color, columns_by_name) or available}"
            )
        column = columns_by_name[color]
        return draw_cloud(
            shot(),
            points(),
            len(file),
            column,
            shown.names_of(column),
            keep_every=shown.keep_every,
        )

    makers: dict[str, Callable[[], Page]] = {
        "scene": lambda: draw_scene(shot(), shown.triangles),
        "hits": draw_counts,
    }
    if not alone:
        light = next((TABLE[name] for name in _LIGHT if name in columns), None)
        if light is not None:
            makers["intensity"] = lambda: draw_cloud(
                shot(),
                points(),
                len(CloudFile(cloud)),
                light,
                solid=True,
                keep_every=shown.keep_every,
            )
        makers["cloud"] = draw_points
    planning = shown.planning
    if planning is not None and planning.best is not None:
        best = planning.best
        makers["path"] = lambda: draw_path(planning, best, shown.scene.origin[:2], size)
    return makers


def draw_path(
    planning: PlanningPicture, path: PlannedPath, origin: Floats, size: tuple[int, int]
) -> Page:
    """Draw a planned path, its obstacles and the paths of other trials, as seen from above.

    The best path is bold. The paths of other trials are faint, and are only drawn if they differ
    visibly from the best path. If there are more than 1000 trials, an evenly spaced subset is
    drawn.

    Parameters
    ----------
    planning
        Planning problem with its start, target and obstacles.
    path
        Best path and the waypoints of all trials.
    origin
        x and y of the scene origin in world coordinates, in meters. The axes show world
        coordinates. Shape (2,).
    size
        Width and height of the picture in pixels.
    """
    page = Page(size)
    unit = page.unit
    best = path.corners
    trials = [np.concatenate([best[:1], trial, best[-1:]]) for trial in path.trials]
    drawn_trials = [trials[k] for k in even_indices(len(trials), MAX_TRIALS)]
    limits = _plot_limits(best, drawn_trials, planning, size)
    axes = page.map_chart(FRAME, limits, origin)
    pixel_m = float(limits[1, 0] - limits[0, 0]) / (FRAME[2] * size[0])
    width_m = pixel_m * _BEST_WIDTH * unit * DPI / 72  # line width of the best path
    drawn_trials = [trial for trial in drawn_trials if max_deviation(trial, best) > width_m]
    circles = zip(planning.centers, planning.radii, strict=True)
    # A shortest path touches obstacles. Its line is wider than the path, so the obstacles are drawn
    # over it, unless the path itself enters one of them.
    discs = PatchCollection(
        [Circle((x, y), radius) for (x, y), radius in circles],
        facecolor=theme.UNSEEN,
        edgecolor=theme.MUTED,
        linewidth=0.6 * unit,
        zorder=5 if path.clearance_m >= 0 else 1,
    )
    axes.add_collection(discs)
    alpha = float(np.clip(6 / max(len(drawn_trials), 1), 0.08, 0.6))
    axes.add_collection(
        LineCollection(drawn_trials, colors=TRIAL_COLOR, linewidths=0.8 * unit, alpha=alpha)
    )
    axes.plot(*best.T, color=PATH_COLOR, lw=_BEST_WIDTH * unit, solid_joinstyle="round", zorder=4)
    axes.plot(*best[1:-1].T, "o", color=PATH_COLOR, ms=2.2 * unit, zorder=4)
    _draw_ends(axes, page, planning)
    page.key(_path_legend(unit, len(drawn_trials), len(planning.radii)), 7.4)
    page.title("Planned path", _path_caption(path, trials))
    return page


def max_deviation(path: Floats, other: Floats) -> float:
    """Return the maximum distance from one path to another (directed Hausdorff distance).

    `path` and `other` contain the corners of the paths. Shape (w, 2). `path` is sampled at a
    spacing of about a hundredth of the length of `other`, with at most 100 points per segment.
    """
    spacing = max(float(np.linalg.norm(np.diff(other, axis=0), axis=1).sum()) / 100, 1e-12)
    points = [path[-1:]]
    for start, stop in itertools.pairwise(path):
        count = min(int(np.linalg.norm(stop - start) / spacing) + 1, 100)
        points.append(start + np.linspace(0, 1, count, endpoint=False)[:, None] * (stop - start))
    positions = np.concatenate(points)
    distances = np.full(len(positions), np.inf)
    for start, stop in itertools.pairwise(other):
        way = stop - start
        fraction = ((positions - start) @ way / max(float(way @ way), 1e-300)).clip(0, 1)
        nearest = start + fraction[:, None] * way
        distances = np.minimum(distances, np.linalg.norm(positions - nearest, axis=1))
    return float(distances.max())


def _path_legend(unit: float, trial_count: int, obstacle_count: int) -> list[Line2D]:
    handles = [Line2D([], [], color=PATH_COLOR, lw=_BEST_WIDTH * unit, label="Best path")]
    if trial_count:
        label = plural(trial_count, "other trial")
        handles.append(Line2D([], [], color=TRIAL_COLOR, lw=0.8 * unit, alpha=0.6, label=label))
    if obstacle_count:
        handles.append(
            Line2D(
                [],
                [],
                ls="",
                marker="o",
                color=theme.UNSEEN,
                mec=theme.MUTED,
                mew=0.6 * unit,
                ms=7 * unit,
                label="Obstacle",
            )
        )
    return handles


def _path_caption(best: PlannedPath, trials: Sequence[Floats]) -> str:
    """Return a caption with the path length, the shortest possible length and the trial count."""
    shortest = "the discs block every path to the target"
    if math.isfinite(best.shortest_m) and best.shortest_m > 0:
        shortest = f"shortest possible length {best.shortest_m:.2f} m ({best.excess:+.2%})"
    length = f"length {best.length_m:.2f} m · {shortest}"
    state = "collision-free" if best.clearance_m >= 0 else "enters a disc"
    best_of = f"best of {plural(len(trials), 'trial')}"
    if len(trials) > 1:  # paths that coincide with the best path cannot be distinguished
        longest = max(float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum()) for path in trials)
        best_of += f", of which the longest is {longest:.2f} m"
    return f"{length.replace('-', '−')} · {state} · {best_of}"


def _plot_limits(
    best: Floats, trials: Sequence[Floats], planning: PlanningPicture, size: tuple[int, int]
) -> Floats:
    """Return the x and y limits of the plot, using the aspect ratio of the page.

    The result has shape (2, 2).
    """
    reach = planning.radii[:, None]
    shown = np.concatenate([best, *trials, planning.centers - reach, planning.centers + reach])
    lower = shown.min(axis=0)
    upper = shown.max(axis=0)
    width = np.maximum(upper - lower, 1e-3) * 1.1
    plot_pixels = np.array([FRAME[2] * size[0], FRAME[3] * size[1]])
    half = plot_pixels * (width / plot_pixels).max() / 2
    middle = (lower + upper) / 2
    return np.stack([middle - half, middle + half])


def _draw_ends(axes: Axes, page: Page, planning: PlanningPicture) -> None:
    halo = [withStroke(linewidth=2.2 * page.unit, foreground=theme.GROUND)]
    middle = sum(axes.get_xlim()) / 2
    for name, position, marker, size in (
        ("start", planning.start, "o", 6),
        ("target", planning.target, "*", 10),
    ):
        axes.plot(
            *position,
            marker,
            color=theme.INK,
            ms=size * page.unit,
            mec=theme.GROUND,
            mew=0.8 * page.unit,
            zorder=6,
        )
        is_right = position[0] > middle  # labels face the center, so that they fit into the plot
        axes.annotate(
            name,
            position,
            xytext=(-8 * page.unit if is_right else 8 * page.unit, 0),
            textcoords="offset points",
            ha="right" if is_right else "left",
            va="center",
            fontsize=7.6 * page.unit,
            color=theme.INK,
            family=FONT,
            path_effects=halo,
            zorder=7,
            gid=LEFT_LABEL if is_right else RIGHT_LABEL,
        )


def draw_stations(plan: StationPlan) -> Page:
    """Draw the scene of a station plan, coloring each pixel by its visibility."""
    shot = take_shot(plan.scene, plan.stations)
    page = Page(SIZE)
    axes = page.draw_view(shot, _classify_by_coverage(shot, plan).paint(COLORS, 0.6))
    page.number_sensors(axes, shot)
    names = ["covered", "not covered", "not reachable"]
    names += ["not a target"] * (not plan.targets.all())
    page.legend([*zip(names, COLORS, strict=False)], "station")
    candidates = plural(len(plan.candidates), "candidate position")
    targets = "" if plan.targets.all() else f" of {plural(int(plan.targets.sum()), 'object')}"
    page.title(
        plural(len(plan.stations), "station").capitalize(),
        f"{plan.coverage[-1]:.1%} of the area{targets} that is reachable (within range, field of "
        f"view and angle) covered; {candidates}",
        plan.sight.sensor.model,
    )
    return page


def _classify_by_coverage(shot: SurfaceView, plan: StationPlan) -> SurfaceView:
    """Replace the triangle index of each sample with COVERED, UNCOVERED, HIDDEN or OTHER."""
    stations, candidates = (p - shot.scene.origin for p in (plan.stations, plan.candidates))
    visible_from_any = _pixel_visibility(shot, plan)
    kinds, surface = _initial_kinds(shot, plan, shot.pixel_samples)
    covered = visible_from_any(stations, shot.pixel_samples, surface)
    kinds[surface[covered]] = COVERED
    uncovered = surface[~covered]
    # Testing all pixels would take minutes. One pixel per triangle and block is tested instead.
    tested, group = _choose_block_pixels(shot, uncovered)
    visible = visible_from_any(candidates, shot.pixel_samples, uncovered[tested])
    kinds[uncovered[visible[group]]] = UNCOVERED
    edge_kinds, edge_surface = _initial_kinds(shot, plan, shot.edge_samples)
    samples_per_edge = len(edge_kinds) // max(len(shot.edges), 1)
    pixel_kinds = np.repeat(kinds[shot.edges], samples_per_edge)
    edge_kinds[(edge_kinds == HIDDEN) & (pixel_kinds == UNCOVERED)] = UNCOVERED
    is_covered = visible_from_any(stations, shot.edge_samples, edge_surface)
    edge_kinds[edge_surface[is_covered]] = COVERED
    return replace(
        shot,
        pixel_samples=_replace_triangles(shot.pixel_samples, kinds),
        edge_samples=_replace_triangles(shot.edge_samples, edge_kinds),
    )


def _initial_kinds(shot: SurfaceView, plan: StationPlan, samples: RaySamples) -> tuple[Ints, Ints]:
    """Classify samples as HIDDEN or OTHER before their visibility is tested.

    Also returns the indices of the samples on targets. The first array has shape (n,).
    """
    is_target = plan.targets[plan.scene.face_object[shot.part.parents]]  # one value per triangle
    on_surface = samples.triangle >= 0
    on_target = on_surface & is_target[samples.triangle]
    return np.where(on_surface & ~on_target, OTHER, HIDDEN), np.flatnonzero(on_target)


def _choose_block_pixels(shot: SurfaceView, pixels: Ints) -> tuple[Ints, Ints]:
    """Choose one pixel per triangle in each block of pixels.

    Returns
    -------
    Indices into `pixels` of the chosen pixels, and for each pixel, the index of its chosen pixel
    in that list.
    """
    width = shot.camera.size[0]
    block = pixels // width // _BLOCK * width + pixels % width // _BLOCK
    key = block * np.int64(len(shot.scene.faces)) + shot.pixel_samples.triangle[pixels]
    _, chosen, group = np.unique(key, return_index=True, return_inverse=True)
    return chosen, group


def _replace_triangles(samples: RaySamples, kinds: Ints) -> RaySamples:
    """Replace the triangle index of each sample that hit a surface with the sample's kind."""
    return replace(samples, triangle=np.where(samples.triangle >= 0, kinds, samples.triangle))


def _pixel_visibility(
    shot: SurfaceView, plan: StationPlan
) -> Callable[[Floats, RaySamples, Ints], Bools]:
    """Return a function that tests whether samples are visible, using the same rules as the plan.

    The function takes sensor positions with shape (p, 3), samples, and indices of samples with
    shape (k,). It returns a mask with shape (k,), which is True for samples whose drawn side is
    visible from at least one of the positions.
    """
    # Rays must intersect the triangles of the shot, whose objects are slightly displaced. Face
    # normals are computed from the original scene, because the displacement would rotate the
    # normals of small triangles. The normals of the samples are smoothed for shading, so they
    # cannot be used.
    sight = StationVisibility(shot.uncut, plan.sight.sensor, plan.sight.slant_deg)
    a, b, c = plan.scene.vertices[plan.scene.faces[shot.part.parents]].swapaxes(0, 1)
    face_normals = normalize(np.cross(b - a, c - a))

    def visible_from_any(positions: Floats, samples: RaySamples, indices: Ints) -> Bools:
        points = samples.position[indices].astype(np.float64)
        normals = face_normals[samples.triangle[indices]]
        facing_away = np.einsum("ij,ij->i", normals, points - shot.camera.eye) > 0
        normals = np.where(facing_away[:, None], -normals, normals)
        hidden = np.arange(len(indices))
        for position in positions:
            sides = sight.visible_sides(position, points[hidden], normals[hidden])
            hidden = hidden[sides <= 0]
        return ~np.isin(np.arange(len(indices)), hidden)

    return visible_from_any

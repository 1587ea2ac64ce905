"""Draw the objects, the hit density, and the points of a scene."""

from __future__ import annotations

from collections.abc import Sequence, Set
from textwrap import fill

import numpy as np
from matplotlib.colors import LogNorm, Normalize

from lidarfiles.color_table import TURBO
from lidarsim.columns.cloud import Cloud
from lidarsim.columns.table import AXES, Column, Z
from lidarsim.numerics.arrays import AnyArray, AnyFloats, Floats, Floats32, Ints, UInts32
from lidarsim.scene.scene import Scene
from lidarsim.scene.scene_mesh import triangle_areas
from lidarsim.words import plural, remove_common_prefix

from . import theme
from .coloring import column_values, make_coloring
from .hit_density import hit_colors, hits_title
from .picture_page import Page, robot_name
from .shot import SurfaceView

MAX_POINTS = 1_000_000  # maximum number of drawn points; a picture has only a few more pixels
MAX_HITS = 200_000  # number of hit points for estimating the density
MAX_PIECES = 100_000  # maximum number of additional triangles from dividing large triangles
SOLID_RADIUS = 5.0  # minimum radius in half pixels where gaps are closed
MAX_RAYS = 600
# An object that covers this fraction of the ground is a floor or a hall.
MIN_FLOOR_SHARE = 0.6
MAX_COLORED = 12  # groups of objects with colors of their own; more could not be told apart
# Floors and halls have colors between these two, and objects without a color of their own are dark.
_FLOORS = (theme.CLAY, "#c9b68f")
_OTHERS = "#62707f"


def draw_scene(shot: SurfaceView, triangles: int) -> Page:
    """Draw a scene and its sensors, with a separate color for each object.

    If a scene has more than `MAX_COLORED` objects, copies of an object share a color, and so do the
    smallest objects. A scene with colors is drawn in these colors, without a legend. `triangles` is
    the number of triangles in the caption.
    """
    scene = shot.scene
    objects = plural(len(scene.names), "object")
    if shot.shown_box is not None:
        objects += f", {len(np.unique(scene.face_object)):,} of them in the part shown"
    words = f"{objects} · {plural(triangles, 'triangle')}"
    if scene.colors is not None:
        page = Page(shot.camera.size)
        page.draw_view(shot, shot.paint(scene.colors.mean_colors() / 255))
        page.title("Scene", f"{words} · {shot.caption}", shot.details)
        return page
    kinds, names = _group_objects(scene.names, shot.actors)
    largest = _largest_groups(scene, kinds, shot.actors)
    colors = _object_colors(scene, kinds, largest)
    page = Page(shot.camera.size)
    page.draw_view(shot, shot.paint(colors[scene.face_object]))
    first = len(names) - shot.actors
    entries = [
        (name if count == 1 else f"{name} ({count:,})", colors[object_index])
        for name, object_index, count in zip(
            remove_common_prefix(names), *_members(kinds), strict=True
        )
    ]
    shown = [k for k in (*range(first, len(names)), *range(first)) if k in largest]  # actors first
    others = ~np.isin(np.unique(scene.face_object), np.flatnonzero(np.isin(kinds, shown)))
    legend = [entries[k] for k in shown]
    if others.any():
        legend.append((plural(int(others.sum()), "other object"), theme.rgb(_OTHERS)))
    page.legend(legend, _sensor_label(shot), _path_labels(shot))
    page.title("Scene", f"{words} · {shot.caption}", shot.details)
    return page


def draw_hits(
    shot: SurfaceView,
    hit_counts: AnyArray,
    points: Floats,
    sample_rays: AnyFloats,
    keep_every: int = 1,
) -> Page:
    """Draw a scene colored by hits per square meter, with the sensors and sample rays.

    Rays of moving sensors are not drawn, because they start everywhere along a trajectory and would
    hide the surfaces with the most hits.

    Parameters
    ----------
    shot
        The scene and the camera.
    hit_counts
        (f,) hits on each triangle of the uncut scene.
    points
        (n, 3) evenly spaced sample of the hits, local, in meters. It may have gaps.
    sample_rays
        (n, 2, 3) start and end points of rays, local, in meters. Some of the rays that end inside
        the plot are drawn.
    keep_every
        The cloud contains one of this many hits of a scan.
    """
    hits = hit_counts[shot.part.parents] * shot.part.shares
    corners = shot.scene.vertices[shot.scene.faces].astype(np.float32)
    counted_points = points[:: -(-len(points) // MAX_HITS) or 1].astype(np.float32)
    max_pieces = MAX_PIECES + len(corners)
    pieces, owner, colors, limits = hit_colors(
        shot.scene, corners, hits, counted_points, max_pieces
    )
    page = Page(shot.camera.size)
    axes = page.draw_view(shot, shot.subdivide(pieces, owner).paint(colors, 0.5))
    lines = _path_labels(shot)
    if not shot.paths:
        page.draw_lines(axes, shot, _choose_rays(shot, sample_rays).astype(np.float64), 0.45, 0.5)
        lines = ["Some of the rays"]
    page.color_bar(TURBO, LogNorm(*limits), hits_title(limits))
    if label := _sensor_label(shot):  # below the color bar
        page.legend([], label, lines, bbox_to_anchor=(0.842, 0.17))
    words = plural(round(hit_counts.sum()), "hit") + _share_text(shot, points)
    if keep_every > 1:
        words += f" · one in {keep_every:,} hits of each scan is in the cloud"
    page.title("Hits", f"{words} · {shot.caption}", shot.details)
    return page


def _sensor_label(shot: SurfaceView) -> str:
    """Return the legend entry for the sensors, or an empty string without sensors."""
    return "Sensor position" + "s" * (len(shot.sensors) > 1) if len(shot.sensors) else ""


def _path_labels(shot: SurfaceView) -> list[str]:
    """Return the legend entries for lines, which are the paths of moving sensors."""
    return ["Sensor path" + "s" * (len(shot.paths) > 1)] if shot.paths else []


def _share_text(shot: SurfaceView, points: Floats) -> str:
    """Return a remark about the fraction of points in the shown part, if it is not all of them."""
    share = shot.share_shown(points)
    return f", {share:.0%} of them in the part shown" if share < 1 else ""


def _choose_rays(shot: SurfaceView, sample_rays: AnyFloats) -> AnyFloats:
    """Select some of the rays that end inside the plot."""
    slack = 1e-3 * shot.stage.size
    lowest, highest = shot.stage.bounds
    ray_ends = sample_rays[:, 1]
    inside = (ray_ends >= lowest - slack) & (ray_ends <= highest + slack)
    visible = sample_rays[inside.all(axis=1)]
    count = min(len(visible), MAX_RAYS)
    return visible[np.linspace(0, len(visible) - 1, count).astype(int)]


def draw_cloud(
    shot: SurfaceView,
    cloud: Cloud,
    count: int,
    column: Column = Z,
    names: Sequence[str] = (),
    solid: bool = False,
    keep_every: int = 1,
) -> Page:
    """Draw a cloud, colored by a column, over the scene in pale colors.

    Parameters
    ----------
    shot
        The scene and the camera.
    cloud
        Sample of the cloud. Hidden points are not drawn.
    count
        Number of points in the whole cloud, for the caption.
    column
        Column that determines the colors.
    names
        Names of the values 0, 1, 2, … of a label column.
    solid
        Whether to close the gaps between points.
    keep_every
        The cloud contains one of this many hits of a scan.
    """
    image = shot.paint(np.tile(theme.rgb(theme.CLAY), (len(shot.scene.faces), 1)), 0.55)
    page = Page(shot.camera.size)
    if len(cloud):
        if column in AXES:
            values = cloud.positions[:, AXES.index(column)]
        else:
            values = column_values(column, cloud.__getitem__)
        colored = make_coloring(values, column, names)
        positions = cloud.positions - shot.scene.origin
        image = draw_points(image, shot, positions, colored.paint(values), solid)
        if colored.limits is None:
            page.legend(colored.labels, _sensor_label(shot), _path_labels(shot))
        else:
            unit = f" ({colored.unit})"
            if not colored.unit:
                unit = "\n" + fill(colored.meaning, 56, max_lines=3, placeholder=" …")
            lower, upper = colored.limits
            scale = LogNorm if colored.logarithmic else Normalize
            norm = scale(lower, upper if upper > lower else lower + 1)
            page.color_bar(colored.scale, norm, (colored.name + unit).rstrip())
    page.draw_view(shot, image)
    by = "height" if column is Z else column.name.removesuffix("_deg").replace("_", " ")
    words = plural(count, "point") + _share_text(shot, cloud.positions - shot.scene.origin)
    if keep_every > 1:
        words += f" · one in {keep_every:,} hits of each scan"
    page.title(f"Point cloud by {by}", f"{words} · {shot.caption}", shot.details)
    return page


def _group_objects(names: Sequence[str], actors: int) -> tuple[Ints, list[str]]:
    """Group objects that share a color and a legend entry.

    Copies of an object form a group, and so do the links of a robot. The last `actors` objects are
    actors. Returns the group (objects,) of each object, and the names of the groups.
    """
    if len(names) <= MAX_COLORED:
        return np.arange(len(names)), list(names)
    known_names = {*names}
    numbers = dict[str, int]()
    kinds = []
    for k, name in enumerate(names):
        stem, _, number = name.rpartition(".")
        moves = k >= len(names) - actors
        copied = not moves and number.isdecimal() and stem in known_names
        kind = stem if copied else robot_name(name) if moves else name
        kinds.append(numbers.setdefault(kind, len(numbers)))
    return np.array(kinds), list(numbers)


def _members(kinds: Ints) -> tuple[Ints, Ints]:
    """Return the first object and the number of objects of each group."""
    _, firsts, counts = np.unique(kinds, return_index=True, return_counts=True)
    return firsts, counts


def _largest_groups(scene: Scene, kinds: Ints, actors: int) -> set[int]:
    """Return the `MAX_COLORED` groups with the largest surfaces, preferably actors.

    The last `actors` objects are actors. Groups without a surface are not included.
    """
    areas = triangle_areas(scene.vertices[scene.faces])
    sizes = np.bincount(kinds[scene.face_object], areas, minlength=int(kinds.max()) + 1)
    is_actor = np.isin(np.arange(len(sizes)), kinds[len(kinds) - actors :])
    largest = np.lexsort((-sizes, ~is_actor))[:MAX_COLORED]
    return set(largest[sizes[largest] > 0].tolist())


def _object_colors(scene: Scene, kinds: Ints, colored: Set[int]) -> Floats:
    """Return the colors of a scene's objects.

    All objects in a group have the same color, and so do all objects whose group is not `colored`.
    Floors and halls are pale, so that the objects inside stand out.
    """
    width = scene.object_bounds[:, 1] - scene.object_bounds[:, 0]
    scene_size = np.maximum(scene.bounds[1] - scene.bounds[0], 1e-9)
    fraction = np.where(np.isfinite(width), width, 0.0)[:, :2].prod(axis=1) / scene_size[:2].prod()
    pale = (fraction >= MIN_FLOOR_SHARE) & (len(scene.names) > 1)
    colors = np.empty((len(scene.names), 3))
    colors[:] = theme.rgb(_OTHERS)
    distinct = ~pale & np.isin(kinds, list(colored))
    kind_numbers, kind = np.unique(kinds[distinct], return_inverse=True)
    colors[distinct] = theme.object_colors(len(kind_numbers))[kind]
    steps = np.linspace(0, 1, max(int(pale.sum()), 1))[: int(pale.sum()), None]
    first, last = map(theme.rgb, _FLOORS)
    colors[pale] = first * (1 - steps) + last * steps
    return colors


def draw_points(
    image: Floats32, shot: SurfaceView, points: Floats, colors: Floats, solid: bool = False
) -> Floats32:
    """Draw points as discs over an image.

    Only points on the visible surface of their pixel are drawn. All other points are hidden, or on
    a wall that has been removed. The points are lit like the surface. If `solid` is set, larger
    discs close the gaps between points.
    """
    pixels, distance = shot.camera.project(points)
    # Allow for range noise of up to one percent of the scene's size.
    slack = 0.01 * shot.stage.size + 2 * shot.camera.footprint(distance)
    shown = np.zeros(len(points), np.bool_)
    # A point at a silhouette may fall into a pixel next to the one that shows its surface.
    for beside in ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)):
        remaining = np.flatnonzero(~shown)
        depth = shot.camera.sample_image(shot.depth, pixels[remaining] + beside, np.inf)
        shown[remaining] = np.abs(distance[remaining] - depth) <= slack[remaining]
    order = np.flatnonzero(shown)
    order = order[np.argsort(-distance[order])]
    pixels = pixels[order]
    light = shot.camera.sample_image(
        shot.pixel_samples.light.reshape(shot.depth.shape), pixels, 1.0
    )
    shaded = np.ones((len(order), 4), np.float32)
    shaded[:, :3] = colors[order] * (0.5 + 0.5 * light)[:, None].clip(0, 1)
    width, height = shot.camera.size
    radius = max(min(320 / np.sqrt(len(points) + 1), 5.2) * width / 1600, 1.5)
    if solid:
        radius = max(radius, SOLID_RADIUS * width / 1600)
    result = draw_discs(image, pixels, shaded, radius)
    if solid:  # surfaces keep their outlines
        bare = shot.pixel_samples.triangle.reshape(height, width) < 0
        result[bare] = image[bare]
    return result


def draw_discs(image: Floats32, pixels: Floats, colors: AnyFloats, radius: float) -> Floats32:
    """Draw discs at pixels in RGBA colors from 0 to 1.

    `radius` is in half pixels. If discs overlap, the nearest center determines the color of a
    pixel.
    """
    # Discs are drawn at twice the resolution and then averaged, so that their edges are smooth.
    height, width, _ = image.shape
    reach = int(radius)
    margin = reach + 2  # so that discs may extend beyond the edge
    row_length = 2 * (width + margin)
    fine = np.zeros((2 * (height + margin), row_length), np.uint32)
    inner = fine[margin : margin + 2 * height, margin : margin + 2 * width]
    inner[:] = _pack_colors(image).repeat(2, axis=0).repeat(2, axis=1)
    column, row = (2 * pixels.T).astype(np.int64) + margin
    middle = row * row_length + column
    color = _pack_colors(colors)
    disc = [
        (dx * dx + dy * dy, dy * row_length + dx)
        for dy in range(-reach, reach + 1)
        for dx in range(-reach, reach + 1)
        if dx * dx + dy * dy <= radius * radius
    ]
    # The last color that is written to a pixel remains. Offsets are processed from the edge of the
    # disc to its center, and points from back to front.
    for _, offset in sorted(disc, reverse=True):
        fine.ravel()[middle + offset] = color
    fine_bytes = np.ascontiguousarray(inner).view(np.uint8).reshape(height, 2, width, 2, 4)
    quarters = (
        fine_bytes[:, row, :, column].astype(np.uint16) for row in (0, 1) for column in (0, 1)
    )
    return np.asarray(sum(quarters) / np.float32(4 * 255))


def _pack_colors(colors: AnyFloats) -> UInts32:
    """Pack RGBA colors from 0 to 1 into 32-bit integers."""
    return np.round(255 * colors).astype(np.uint8).view(np.uint32)[..., 0]

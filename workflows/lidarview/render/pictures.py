"""The pictures of a scene: objects, density of hits, and points."""

from __future__ import annotations

from collections.abc import Sequence
from textwrap import fill

import numpy as np
from matplotlib.colors import LogNorm, Normalize

from lidarsim.base.arrays import AnyArray, AnyFloats, Floats, Floats32, Ints, UInts32
from lidarsim.base.words import plural, without_common_prefix
from lidarsim.columns.cloud import Cloud
from lidarsim.columns.table import AXES, Column, Z
from lidarsim.scene.scene import Scene

from . import theme
from .coloring import TURBO, colors_of, values_of
from .hit_density import hit_colors, hits_title
from .picture_page import LEGEND_ROWS, Page, robot_name
from .shot import SurfaceView

MAX_POINTS = 1_000_000  # limit for drawn points of a cloud; a picture has a few more pixels
# to count, and to color
MAX_HITS = 200_000
MAX_PIECES = 100_000
SOLID_RADIUS = 5.0  # half pixels that a point covers at least where gaps are closed
# more from one trajectory would hide the surfaces
MAX_RAYS = 600
MAX_RAYS_OF_PATHS = 150
# An object that covers this much of the ground is a floor or a hall.
MIN_FLOOR_SHARE = 0.6


def draw_scene(shot: SurfaceView, triangles: int) -> Page:
    """Draw a scene with a number of triangles, each object in its own color, and the sensors.

    Of more objects than a legend has rows, copies of an object share a color. A scene with colors
    is drawn in its colors, without a legend.
    """
    scene = shot.scene
    words = f"{plural(len(scene.names), 'object')} · {plural(triangles, 'triangle')}"
    if scene.colors is not None:
        page = Page(shot.camera.size)
        page.show(shot, shot.paint(scene.colors.means() / 255))
        page.title("Scene", f"{words} · {shot.caption}", shot.models)
        return page
    kinds, names = _group_objects(scene.names, shot.actors)
    colors = _object_colors(scene, kinds)
    page = Page(shot.camera.size)
    page.show(shot, shot.paint(colors[scene.face_object]))
    has_faces = np.bincount(scene.face_object, minlength=len(kinds)) > 0
    _, firsts, counts = np.unique(kinds, return_index=True, return_counts=True)
    labels = [
        name if count == 1 else f"{name} ({count:,})"
        for name, count in zip(without_common_prefix(names), counts, strict=True)
    ]
    first = len(names) - shot.actors  # actors are first in the legend
    is_visible = np.bincount(kinds, has_faces) > 0
    order = [*range(first, len(names)), *range(first)]
    if is_visible.sum() > LEGEND_ROWS:
        order.sort(key=lambda k: k < first and counts[k] == 1)  # then copies
    entries = [(labels[k], colors[firsts[k]]) for k in order if is_visible[k]]
    page.legend(entries, _sensor_label(shot))
    page.title("Scene", f"{words} · {shot.caption}", shot.models)
    return page


def draw_hits(
    shot: SurfaceView, hit_counts: AnyArray, points: Floats, sample_rays: AnyFloats
) -> Page:
    """Draw a scene colored by hits per square meter, with the sensors and sample rays.

    Parameters
    ----------
    hit_counts
        (f,) hits of each triangle of the scene.
    points
        (n, 3) an evenly spaced sample of the hits, local meters, perhaps with gaps.
    sample_rays
        (n, 2, 3) ends of rays, local meters; some rays that end in the picture are drawn.
    """
    hits = hit_counts[shot.part.parents] * shot.part.shares
    corners = shot.scene.vertices[shot.scene.faces].astype(np.float32)
    counted_points = points[:: -(-len(points) // MAX_HITS) or 1].astype(np.float32)
    max_pieces = MAX_PIECES + len(corners)
    pieces, owner, colors, limits = hit_colors(
        shot.scene, corners, hits, counted_points, max_pieces
    )
    page = Page(shot.camera.size)
    axes = page.show(shot, shot.divided(pieces, owner).paint(colors, 0.5))
    page.lines(axes, shot, _choose_rays(shot, sample_rays).astype(np.float64), 0.45, 0.5)
    page.color_bar(TURBO, LogNorm(*limits), hits_title(limits))
    if label := _sensor_label(shot):
        page.legend([], label, bbox_to_anchor=(0.842, 0.18))  # below the color bar
    page.title("Hits", f"{plural(round(hit_counts.sum()), 'hit')} · {shot.caption}", shot.models)
    return page


def _sensor_label(shot: SurfaceView) -> str:
    """Return the entry of a legend for the marks of sensors; empty if there are none."""
    if shot.paths:
        return "Sensor path"
    return "Sensor position" + "s" * (len(shot.sensors) > 1) if len(shot.sensors) else ""


def _choose_rays(shot: SurfaceView, sample_rays: AnyFloats) -> AnyFloats:
    """Choose rays (n, 2, 3) that end in the picture."""
    slack = 1e-3 * shot.stage.size
    lowest, highest = shot.stage.bounds
    ray_ends = sample_rays[:, 1]
    inside = (ray_ends >= lowest - slack) & (ray_ends <= highest + slack)
    visible = sample_rays[inside.all(axis=1)]
    count = min(len(visible), MAX_RAYS_OF_PATHS if shot.paths else MAX_RAYS)
    return visible[np.linspace(0, len(visible) - 1, count).astype(int)]


def draw_cloud(
    shot: SurfaceView,
    cloud: Cloud,
    count: int,
    column: Column = Z,
    names: Sequence[str] = (),
    solid: bool = False,
) -> Page:
    """Draw points of a cloud colored by a column, over the scene drawn pale.

    The cloud is a sample of `count` points; hidden points are left out. `names` are the words for
    the values 0, 1, 2, … of a label. `solid` closes gaps between points.
    """
    image = shot.paint(np.tile(theme.rgb(theme.CLAY), (len(shot.scene.faces), 1)), 0.55)
    page = Page(shot.camera.size)
    if len(cloud):
        if column in AXES:
            values = cloud.positions[:, AXES.index(column)]
        else:
            values = values_of(column, cloud.__getitem__)
        colored = colors_of(values, column, names)
        positions = cloud.positions - shot.scene.origin
        image = with_points(image, shot, positions, colored.paint(values), solid)
        if colored.limits is None:
            page.legend(colored.labels, _sensor_label(shot))
        else:
            unit = f" ({colored.unit})"
            if not colored.unit:
                unit = "\n" + fill(colored.meaning, 46, max_lines=2, placeholder=" …")
            lower, upper = colored.limits
            scale = LogNorm if colored.logarithmic else Normalize
            norm = scale(lower, upper if upper > lower else lower + 1)
            page.color_bar(colored.scale, norm, (colored.name + unit).rstrip())
    page.show(shot, image)
    by = "height" if column is Z else column.name.removesuffix("_deg").replace("_", " ")
    page.title(f"Point cloud by {by}", f"{plural(count, 'point')} · {shot.caption}", shot.models)
    return page


def _group_objects(names: Sequence[str], actors: int) -> tuple[Ints, list[str]]:
    """Return the kinds of objects (objects,), and the names of kinds.

    The last objects are actors.

    Each actor is a kind, and so are all links of a robot together.
    """
    if len(names) <= LEGEND_ROWS:
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


def _object_colors(scene: Scene, kinds: Ints) -> Floats:
    """Return colors (objects, 3) in 0 to 1 of a scene's objects, a color for each kind.

    Floors and halls are gray, so that the objects inside stand out.
    """
    width = scene.object_bounds[:, 1] - scene.object_bounds[:, 0]
    scene_size = np.maximum(scene.bounds[1] - scene.bounds[0], 1e-9)
    share = np.where(np.isfinite(width), width, 0.0)[:, :2].prod(axis=1) / scene_size[:2].prod()
    gray = (share >= MIN_FLOOR_SHARE) & (len(scene.names) > 1)
    colors = np.empty((len(scene.names), 3))
    kind_numbers, kind = np.unique(kinds[~gray], return_inverse=True)
    colors[~gray] = theme.object_colors(len(kind_numbers))[kind]
    steps = np.linspace(0, 0.22, max(int(gray.sum()), 1))[: int(gray.sum()), None]
    colors[gray] = theme.rgb(theme.CLAY) * (1 - steps) + theme.rgb(theme.MUTED) * steps
    return colors


def with_points(
    image: Floats32, shot: SurfaceView, points: Floats, colors: Floats, solid: bool = False
) -> Floats32:
    """Draw points (n, 3) as discs over an image.

    Larger discs close gaps if `solid`.

    Only points on the surface of their pixel are drawn: others are hidden, or on a wall that was
    removed. Points have the light of the surface.
    """
    pixels, distance = shot.camera.project(points)
    # Allow range noise up to one per cent of the scene's size.
    slack = 0.01 * shot.stage.size + 2 * shot.camera.footprint(distance)
    shown = np.zeros(len(points), np.bool_)
    # A point at a silhouette may fall beside the pixel that shows its surface.
    for beside in ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)):
        remaining = np.flatnonzero(~shown)
        depth = shot.camera.look_up(shot.depth, pixels[remaining] + beside, np.inf)
        shown[remaining] = np.abs(distance[remaining] - depth) <= slack[remaining]
    order = np.flatnonzero(shown)
    order = order[np.argsort(-distance[order])]
    pixels = pixels[order]
    light = shot.camera.look_up(shot.pixel_samples.light.reshape(shot.depth.shape), pixels, 1.0)
    shaded = np.ones((len(order), 4), np.float32)
    shaded[:, :3] = colors[order] * (0.5 + 0.5 * light)[:, None].clip(0, 1)
    width, height = shot.camera.size
    radius = max(min(320 / np.sqrt(len(points) + 1), 5.2) * width / 1600, 1.5)
    if solid:
        radius = max(radius, SOLID_RADIUS * width / 1600)
    result = splat(image, pixels, shaded, radius)
    if solid:  # surfaces keep their outlines
        bare = shot.pixel_samples.triangle.reshape(height, width) < 0
        result[bare] = image[bare]
    return result


def splat(image: Floats32, pixels: Floats, colors: AnyFloats, radius: float) -> Floats32:
    """Draw discs of a radius in half pixels at pixels (n, 2), in colors (n, 4) in 0 to 1."""
    # Discs are drawn at twice the resolution and averaged down, so that their edges are smooth.
    height, width, _ = image.shape
    reach = int(radius)
    margin = reach + 2  # room for discs of points beside the edge
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
    # The last of several colors for a pixel stays: the color of the point with the closest
    # middle. Of equally close points, the point in front counts.
    for _, offset in sorted(disc, reverse=True):
        fine.ravel()[middle + offset] = color
    fine_bytes = np.ascontiguousarray(inner).view(np.uint8).reshape(height, 2, width, 2, 4)
    quarters = (
        fine_bytes[:, row, :, column].astype(np.uint16) for row in (0, 1) for column in (0, 1)
    )
    return np.asarray(sum(quarters) / np.float32(4 * 255))


def _pack_colors(colors: AnyFloats) -> UInts32:
    """Pack colors (..., 4) in 0 to 1 into numbers (...,) of four bytes."""
    return np.round(255 * colors).astype(np.uint8).view(np.uint32)[..., 0]

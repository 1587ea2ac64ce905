"""The pictures of a scene: objects, density of hits, and points."""

from __future__ import annotations

from collections.abc import Sequence
from textwrap import fill

import numpy as np
from matplotlib.colors import LogNorm, Normalize

from lidarsim.base.arrays import AnyArray, AnyFloats, Floats, Floats32, Ints, UInts32
from lidarsim.base.words import plural, without_common_prefix
from lidarsim.columns.cloud import Cloud
from lidarsim.columns.table import Column, Z
from lidarsim.scene.scene import Scene

from . import theme
from .colouring import TURBO, colours_of, values_of
from .hit_density import HITS_TITLE, hit_colours
from .picture_page import LEGEND_ROWS, Page, whole_of
from .shot import SurfaceView

MOST_POINTS = 1_000_000  # of a cloud are drawn; a picture has a few more pixels
# to count, and to colour
MOST_HITS = 200_000
MOST_PIECES = 100_000
SOLID = 5.0  # half pixels that a point covers at least where gaps are closed
# more from one trajectory would hide the surfaces
MOST_RAYS = 600
MOST_OF_MOVING = 150
# An object that covers this much of the ground is a floor or a hall.
SURROUNDING = 0.6


def draw_scene(shot: SurfaceView, triangles: int) -> Page:
    """Draw a scene, each object in its own colour, and the sensors; `triangles` is their number.

    Of more objects than a legend has rows, copies of one thing share a colour. A scene that has
    colours is drawn in these, without a legend.
    """
    scene = shot.scene
    words = f"{plural(len(scene.names), 'object')} · {plural(triangles, 'triangle')}"
    if scene.colours is not None:
        page = Page(shot.camera.size)
        page.show(shot, shot.paint(scene.colours.means() / 255))
        page.title("Scene", f"{words} · {shot.when}", shot.models)
        return page
    kinds, names = _kinds(scene.names, shot.actors)
    colours = _object_colours(scene, kinds)
    page = Page(shot.camera.size)
    page.show(shot, shot.paint(colours[scene.face_object]))
    there = np.bincount(scene.face_object, minlength=len(kinds)) > 0
    _, firsts, counts = np.unique(kinds, return_index=True, return_counts=True)
    labels = [
        name if count == 1 else f"{name} ({count:,})"
        for name, count in zip(without_common_prefix(names), counts, strict=True)
    ]
    first = len(names) - shot.actors  # actors are first in the legend
    seen = np.bincount(kinds, there) > 0
    order = [*range(first, len(names)), *range(first)]
    if seen.sum() > LEGEND_ROWS:
        order.sort(key=lambda k: k < first and counts[k] == 1)  # then copies
    page.legend([(labels[k], colours[firsts[k]]) for k in order if seen[k]])
    page.title("Scene", f"{words} · {shot.when}", shot.models)
    return page


def draw_hits(
    shot: SurfaceView, hit_counts: AnyArray, points: Floats, sample_rays: AnyFloats
) -> Page:
    """Draw a scene coloured by hits per square metre, with the sensors and sample rays.

    Parameters
    ----------
    hit_counts
        (f,) hits of each triangle of the scene.
    points
        (n, 3) an evenly spaced sample of the hits, local metres; it may lack some.
    sample_rays
        (n, 2, 3) ends of rays, local metres; some of those that end in the picture are drawn.
    """
    hits = hit_counts[shot.part.parents] * shot.part.shares
    corners = shot.scene.vertices[shot.scene.faces].astype(np.float32)
    some = points[:: -(-len(points) // MOST_HITS) or 1].astype(np.float32)
    most = MOST_PIECES + len(corners)
    pieces, owner, colours, limits = hit_colours(shot.scene, corners, hits, some, most)
    page = Page(shot.camera.size)
    axes = page.show(shot, shot.divided(pieces, owner).paint(colours, 0.5))
    slack, (lowest, highest) = 1e-3 * shot.stage.size, shot.stage.bounds
    ends = sample_rays[:, 1]
    inside = (ends >= lowest - slack) & (ends <= highest + slack)
    sample_rays = sample_rays[inside.all(axis=1)]
    most = min(len(sample_rays), MOST_OF_MOVING if shot.paths else MOST_RAYS)
    rays = np.linspace(0, len(sample_rays) - 1, most).astype(int)
    page.lines(axes, shot, sample_rays[rays].astype(np.float64), 0.45, 0.5)
    page.colour_bar(TURBO, LogNorm(*limits), HITS_TITLE)
    page.title("Hits", f"{plural(round(hit_counts.sum()), 'hit')} · {shot.when}", shot.models)
    return page


def draw_cloud(
    shot: SurfaceView,
    cloud: Cloud,
    count: int,
    column: Column = Z,
    names: Sequence[str] = (),
    solid: bool = False,
) -> Page:
    """Draw points of a cloud coloured by a column, over the scene drawn pale.

    They are a sample of `count` points; hidden ones are left out. `names` are those of the values
    0, 1, 2, … of the column, if it is a label. `solid` closes gaps between points.
    """
    image = shot.paint(np.tile(theme.rgb(theme.CLAY), (len(shot.scene.faces), 1)), 0.55)
    page = Page(shot.camera.size)
    if len(cloud):
        values = cloud.positions[:, 2] if column is Z else values_of(column, cloud.__getitem__)
        coloured = colours_of(values, column, names)
        places = cloud.positions - shot.scene.origin
        image = with_points(image, shot, places, coloured.paint(values), solid)
        if coloured.limits is None:
            page.legend(coloured.labels)
        else:
            unit = f" ({coloured.unit})" if coloured.unit else f"\n{fill(coloured.meaning, 42)}"
            low, high = coloured.limits
            scale = LogNorm if coloured.logarithmic else Normalize
            norm = scale(low, high if high > low else low + 1)
            page.colour_bar(coloured.scale, norm, (coloured.name + unit).rstrip())
    page.show(shot, image)
    by = "height" if column is Z else column.name.replace("_", " ")
    page.title(f"Point cloud by {by}", f"{plural(count, 'point')} · {shot.when}", shot.models)
    return page


def _kinds(names: Sequence[str], actors: int) -> tuple[Ints, list[str]]:
    """Kinds of objects (objects,), and their names; the last objects are actors.

    Each actor is a kind, and all links of a robot are one.
    """
    if len(names) <= LEGEND_ROWS:
        return np.arange(len(names)), list(names)
    known = {*names}
    found = dict[str, int]()
    kinds = []
    for k, name in enumerate(names):
        stem, _, number = name.rpartition(".")
        moves = k >= len(names) - actors
        copied = not moves and number.isdecimal() and stem in known
        kind = stem if copied else whole_of(name) if moves else name
        kinds.append(found.setdefault(kind, len(found)))
    return np.array(kinds), list(found)


def _object_colours(scene: Scene, kinds: Ints) -> Floats:
    """Colours of a scene's objects, (objects, 3) in 0 to 1, one for each of their kinds.

    Floors and halls are grey, so that objects in them stand out.
    """
    width = scene.object_bounds[:, 1] - scene.object_bounds[:, 0]
    whole = np.maximum(scene.bounds[1] - scene.bounds[0], 1e-9)
    share = np.where(np.isfinite(width), width, 0.0)[:, :2].prod(axis=1) / whole[:2].prod()
    grey = (share >= SURROUNDING) & (len(scene.names) > 1)
    colours = np.empty((len(scene.names), 3))
    found, kind = np.unique(kinds[~grey], return_inverse=True)
    colours[~grey] = theme.object_colours(len(found))[kind]
    steps = np.linspace(0, 0.22, max(int(grey.sum()), 1))[: int(grey.sum()), None]
    colours[grey] = theme.rgb(theme.CLAY) * (1 - steps) + theme.rgb(theme.MUTED) * steps
    return colours


def with_points(
    image: Floats32, shot: SurfaceView, points: Floats, colours: Floats, solid: bool = False
) -> Floats32:
    """Draw points (n, 3) as discs over an image; `solid` makes them close the gaps between them.

    Only points on the surface of their pixel are drawn: others are hidden, or on a wall that was
    removed. They have the light of that surface.
    """
    pixels, distance = shot.camera.project(points)
    # Allow range noise up to one per cent of the scene's size.
    slack = 0.01 * shot.stage.size + 2 * shot.camera.footprint(distance)
    shown = np.zeros(len(points), np.bool_)
    # A point at a silhouette may fall into the pixel beside the one that shows its surface.
    for beside in ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)):
        left = np.flatnonzero(~shown)
        depth = shot.camera.look_up(shot.depth, pixels[left] + beside, np.inf)
        shown[left] = np.abs(distance[left] - depth) <= slack[left]
    order = np.flatnonzero(shown)
    order = order[np.argsort(-distance[order])]
    pixels = pixels[order]
    light = shot.camera.look_up(shot.whole.light.reshape(shot.depth.shape), pixels, 1.0)
    shaded = np.ones((len(order), 4), np.float32)
    shaded[:, :3] = colours[order] * (0.5 + 0.5 * light)[:, None].clip(0, 1)
    width, height = shot.camera.size
    radius = max(min(320 / np.sqrt(len(points) + 1), 5.2) * width / 1600, 1.5)
    if solid:
        radius = max(radius, SOLID * width / 1600)
    drawn = splat(image, pixels, shaded, radius)
    if solid:  # surfaces keep their outlines
        bare = shot.whole.triangle.reshape(height, width) < 0
        drawn[bare] = image[bare]
    return drawn


def splat(image: Floats32, pixels: Floats, colours: AnyFloats, radius: float) -> Floats32:
    """Draw discs of a radius in half pixels at pixels (n, 2), in colours (n, 4) in 0 to 1."""
    # Discs are drawn at twice the resolution and averaged down, so that their edges are smooth.
    height, width, _ = image.shape
    reach = int(radius)
    margin = reach + 2  # for discs of points beside the edge
    wide = 2 * (width + margin)
    fine = np.zeros((2 * (height + margin), wide), np.uint32)
    inner = fine[margin : margin + 2 * height, margin : margin + 2 * width]
    inner[:] = _packed(image).repeat(2, axis=0).repeat(2, axis=1)
    column, row = (2 * pixels.T).astype(np.int64) + margin
    middle = row * wide + column
    colour = _packed(colours)
    disc = [
        (dx * dx + dy * dy, dy * wide + dx)
        for dy in range(-reach, reach + 1)
        for dx in range(-reach, reach + 1)
        if dx * dx + dy * dy <= radius * radius
    ]
    # The last of several colours for one pixel stays: of the point whose middle is nearest there,
    # of two alike of that in front.
    for _, offset in sorted(disc, reverse=True):
        fine.ravel()[middle + offset] = colour
    out = np.ascontiguousarray(inner).view(np.uint8).reshape(height, 2, width, 2, 4)
    four = (out[:, row, :, column].astype(np.uint16) for row in (0, 1) for column in (0, 1))
    return np.asarray(sum(four) / np.float32(4 * 255))


def _packed(colours: AnyFloats) -> UInts32:
    """Colours (..., 4) in 0 to 1 as one number each, with a byte for each part."""
    return np.round(255 * colours).astype(np.uint8).view(np.uint32)[..., 0]

"""Determine the surface and the light in each pixel of an image before it is colored."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from PIL import Image, ImageDraw

from lidarsim.numerics.arrays import Bools, Floats, Floats32, Ints
from lidarsim.scene.scene import Scene
from lidarsim.words import plural
from raybeam import RayCaster

from . import theme
from .camera import Camera, fit_camera
from .closeup import ScenePart, floor_and_cut_heights, surrounding_box
from .cutaway import Cutaway, cast_with_cutaway, plan_cutaway
from .light import STRIDE, LightMap, make_light_map, plane_tolerance, surface_similarity
from .stage import PlotBox
from .surface import RenderMesh, normalize, separate_objects

SIZE = (1600, 1000)  # width and height of a finished picture in pixels
# Frame of the scene. The title is above, and the legend or color bar is on the right.
FRAME = (0.08, 0.115, 0.79, 0.91)
# Values in place of a triangle index.
SKY = -1
GROUND = -2
# Offsets of the samples in an edge pixel from its center, in pixels.
_EDGE_OFFSETS = np.array([[-0.125, -0.375], [0.375, -0.125], [-0.375, 0.125], [0.125, 0.375]])
STEPS = 700  # number of points along a line at which visibility is tested
# Gap between touching objects, and distance at which rays start in front of the pieces of a
# triangle, as fractions of the scene's diagonal.
_OBJECT_GAP = 5e-6
_PIECE_GAP = 1e-6


@dataclass(frozen=True, eq=False)
class RaySamples:
    """Samples of camera rays, with the hit of each ray.

    Every array has a row for each ray.
    """

    triangle: Ints  # (n,) triangle index, SKY, or GROUND
    distance: Floats32  # (n,) in meters, infinite for the sky
    position: Floats32  # (n, 3) in meters, NaN for the sky
    normal: Floats32  # (n, 3) unit length, NaN for the sky
    light: Floats32  # (n,) brightness, which is 1 on open ground
    weights: Floats32  # (n, 3) weights of the triangle's corners

    def scatter(self, which: Ints, count: int) -> RaySamples:
        """Return `count` samples: these at the given indices, and the sky at all others.

        `which` (n,) contains the new indices of these samples.
        """
        result = RaySamples(
            np.full(count, SKY),
            np.full(count, np.inf, np.float32),
            np.full((count, 3), np.nan, np.float32),
            np.full((count, 3), np.nan, np.float32),
            np.ones(count, np.float32),
            np.zeros((count, 3), np.float32),
        )
        for field in fields(self):
            getattr(result, field.name)[which] = getattr(self, field.name)
        return result

    def paint(self, face_colors: Floats, contrast: float) -> Floats32:
        """Return the premultiplied RGBA colors of the samples.

        `face_colors` has shape (f, 3), or (f, 3, 3) with colors at the corners. `contrast` is the
        strength of light and shade.
        """
        image = np.zeros((len(self.triangle), 4), np.float32)
        surface = np.flatnonzero(self.triangle >= 0)
        ground = np.flatnonzero(self.triangle == GROUND)
        colors = face_colors.astype(np.float32)[self.triangle[surface]]
        if colors.ndim == 3:
            colors = np.einsum("nc,nck->nk", self.weights[surface], colors)
        image[surface, :3] = colors * (1 - contrast * (1 - self.light[surface, None]))
        image[surface, 3] = 1
        light = self.light[ground, None]
        image[ground, :3] = theme.VEIL * light * theme.rgb(theme.MUTED)
        image[ground, 3:] = 1 - light * (1 - theme.VEIL)  # shadows darken the page as well
        return image


@dataclass(frozen=True, eq=False)
class SurfaceView:
    """A scene with sensors, viewed by a camera."""

    part: ScenePart
    uncut: Scene  # the part before it was cut open
    sensors: Floats  # (p, 3) local, in meters
    paths: tuple[Floats, ...]  # paths of moving sensors, (k, 3) each
    actors: int  # number of actors, which are the last objects of the scene
    shown_box: Floats | None  # (2, 3) local bounds of the shown part; None if it is the whole scene
    caption: str  # number of sensors, and the time
    details: str  # shown part and sensor models, for a second caption
    stage: PlotBox
    camera: Camera
    pixel_samples: RaySamples  # one sample through each pixel center
    edges: Ints  # (e,) pixels that show the edge of a surface
    edge_samples: RaySamples  # several samples for each edge pixel, in the order of `edges`

    @property
    def scene(self) -> Scene:
        """Scene with the triangles to draw."""
        return self.part.scene

    def share_shown(self, points: Floats) -> float:
        """Return the fraction of local points (n, 3) that are in the shown part.

        If the whole scene is shown, or if there are no points, the fraction is 1.
        """
        if self.shown_box is None or not len(points):
            return 1.0
        lower, upper = self.shown_box
        # Ranges have noise, so points may lie slightly below the ground.
        is_shown = (points <= upper).all(axis=1) & (points[:, :2] >= lower[:2]).all(axis=1)
        return float(is_shown.mean())

    @property
    def depth(self) -> Floats32:
        """Distance from the camera to the surface in meters.

        The shape is (height, width). Pixels without a surface have an infinite distance.
        """
        return self.pixel_samples.distance.reshape(self.camera.size[::-1])

    def paint(self, face_colors: Floats, contrast: float = 1.0) -> Floats32:
        """Color the view.

        Parameters
        ----------
        face_colors
            (f, 3) colors from 0 to 1, or (f, 3, 3) with colors at the corners.
        contrast
            0 for flat colors, 1 for full light and shade.

        Returns
        -------
        Premultiplied RGBA image (height, width, 4) from 0 to 1. The ground is almost transparent,
        and pixels without a surface are fully transparent.
        """
        image = self.pixel_samples.paint(face_colors, contrast)
        finer = self.edge_samples.paint(face_colors, contrast)
        if len(self.edges):
            image[self.edges] = finer.reshape(len(self.edges), -1, 4).mean(axis=1)
        return np.clip(image, 0, 1).reshape(*self.camera.size[::-1], 4)

    def subdivide(self, pieces: Floats32, owner: Ints) -> SurfaceView:
        """Return the same view with triangles divided into separately colored pieces.

        `pieces` (k, 3, 3) contains the corners of the pieces, and `owner` (k,) is the triangle of
        each piece. The first piece of each triangle keeps the number of the triangle.
        """
        is_divided = np.append(np.bincount(owner) > 1, [False, False])
        back = _PIECE_GAP * self.stage.size
        numbers = np.flatnonzero(is_divided[owner])
        if not len(numbers):
            return self
        corners = pieces[numbers].reshape(-1, 3)
        caster = RayCaster(corners, np.arange(len(corners)).reshape(-1, 3))

        def find(samples: RaySamples) -> RaySamples:
            piece = samples.triangle.copy()
            weights = samples.weights.copy()
            indices = np.flatnonzero(is_divided[piece])
            positions = samples.position[indices].astype(np.float64)
            ahead = normalize(positions - self.camera.eye)
            hits = caster.cast(positions - back * ahead, ahead, t_max=2 * back)
            is_piece = owner[numbers[hits.triangle]] == piece[indices]
            piece[indices[is_piece]] = numbers[hits.triangle[is_piece]]
            weights[indices] = np.stack([1 - hits.u - hits.v, hits.u, hits.v], axis=1)
            return replace(samples, triangle=piece, weights=weights)

        return replace(
            self, pixel_samples=find(self.pixel_samples), edge_samples=find(self.edge_samples)
        )

    def project_visible(self, points: ArrayLike) -> tuple[Floats, Bools]:
        """Return the pixel coordinates of local points and a mask of the visible points.

        The points have shape (n, 3), the pixel coordinates (n, 2), and the mask (n,).
        """
        pixels, distance = self.camera.project(points)
        depth = self.camera.sample_image(self.depth, pixels, -np.inf)
        return pixels, distance <= depth + 2 * self.camera.footprint(distance)

    def project_ground(self, points: ArrayLike) -> tuple[Floats, Bools]:
        """Return the pixel coordinates of ground points and a mask of the visible points.

        The points have shape (n, 3), the pixel coordinates (n, 2), and the mask (n,).
        """
        pixels, _ = self.camera.project(points)
        bare = (self.pixel_samples.triangle < 0).reshape(self.depth.shape)
        return pixels, self.camera.sample_image(bare, pixels, False)

    def visible_segments(
        self, segments: Floats, is_visible: Callable[[Floats], tuple[Floats, Bools]]
    ) -> list[Floats]:
        """Split line segments into their visible pieces.

        `is_visible` returns the pixel coordinates of points and a visibility mask. The result
        contains the pixel coordinates (2, 2) of the ends of each piece.
        """
        # Steps have equal lengths in the image, where 1 / depth is linear.
        start_depth, stop_depth = (
            (segments[:, end] - self.camera.eye) @ self.camera.axes[2] for end in (0, 1)
        )
        s = np.linspace(0, 1, STEPS)[None]
        fraction = (
            s * start_depth[:, None] / (stop_depth[:, None] * (1 - s) + s * start_depth[:, None])
        )
        path = segments[:, :1] + fraction[..., None] * (segments[:, 1:] - segments[:, :1])
        pixels, shown = is_visible(path.reshape(-1, 3))
        pieces = []
        for line, visible in zip(
            pixels.reshape(-1, STEPS, 2), shown.reshape(-1, STEPS), strict=True
        ):
            changes = np.flatnonzero(np.diff(visible, prepend=False, append=False))
            pieces += [line[[first, last - 1]] for first, last in changes.reshape(-1, 2)]
        return pieces


def take_shot(
    scene: Scene,
    poses: ArrayLike,
    *,
    paths: Sequence[Floats] = (),
    trajectories: Sequence[Floats] = (),
    actors: int = 0,
    caption: str = "",
    models: str = "",
    size: tuple[int, int] = SIZE,
    backend: str = "auto",
) -> SurfaceView:
    """Render the surfaces of a scene from an automatically chosen viewpoint.

    The camera looks down from the side on which the scene is wider. If the sensors are inside a
    building, the walls and roofs in front of them are removed. If only a part of a large scene is
    shown, it is cut open above the sensors.

    Parameters
    ----------
    scene
        The scene.
    poses
        (p, 3) sensor positions, in world coordinates.
    paths
        Trajectories of moving sensors, (k, 3) each, in local coordinates.
    trajectories
        Trajectories in local coordinates. If the scene is much larger than their surroundings, only
        the surroundings are shown, and the caption says so.
    actors
        Number of actors, which are the last objects of the scene.
    caption
        Caption of the plot. The default is the number of sensors.
    models
        Sensor models, for a second caption.
    size
        Width and height of the plot in pixels.
    backend
        Backend of the ray caster.
    """
    sensors = np.asarray(poses, dtype=np.float64).reshape(-1, 3) - scene.origin
    positions = np.concatenate([sensors, *paths])
    opened = _open_scene(scene, positions, trajectories, backend)
    stage = _stage(opened.bounds, positions, scene.origin)
    viewpoint = _choose_viewpoint(opened.surface, stage, positions, size, bool(paths or actors))
    camera = viewpoint.camera
    centers = _pixel_centers(size)
    inside = np.flatnonzero(_outline(stage, camera))
    pixel_samples = viewpoint.sample(centers[inside]).scatter(inside, len(centers))
    light = viewpoint.light_map(pixel_samples)
    edges = np.flatnonzero(_edges(pixel_samples, opened.part.scene, camera))
    edge_pixels = (centers[edges, None] + _EDGE_OFFSETS).reshape(-1, 2)
    edge_samples = viewpoint.sample(edge_pixels)
    for samples, pixels in ((pixel_samples, centers), (edge_samples, edge_pixels)):
        _add_light(samples, pixels, light)
    return SurfaceView(
        part=opened.part,
        uncut=opened.uncut,
        sensors=sensors,
        paths=tuple(paths),
        actors=actors,
        shown_box=opened.shown_box,
        caption=caption or plural(len(sensors), "sensor position"),
        details=" · ".join(filter(None, (opened.caption, models))),
        stage=stage,
        camera=camera,
        pixel_samples=pixel_samples,
        edges=edges,
        edge_samples=edge_samples,
    )


class _OpenScene(NamedTuple):
    """The displayed part of a scene, which is cut open above sensors in a building."""

    part: ScenePart
    surface: RenderMesh  # surface of the part
    uncut: Scene  # the part before it was cut open
    bounds: Floats  # (2, 3) bounds of the part
    box: Floats | None  # (2, 3) around trajectories; None if all of the scene is shown
    cut_height: float | None  # None if the part is not cut open

    @property
    def shown_box(self) -> Floats | None:
        """Local bounds of the displayed part. None if the entire scene is displayed."""
        if self.box is None or self.cut_height is None:
            return self.box
        return self.box.clip(max=[np.inf, np.inf, self.cut_height])

    @property
    def caption(self) -> str:
        """Caption with the bounds of the displayed part.

        It is an empty string if the entire scene is displayed.
        """
        if (box := self.shown_box) is None:
            return ""
        width, depth, _ = np.ptp(box, axis=0)
        top = self.uncut.origin[2] + box[1, 2]
        area = f"{width:,.0f} × {depth:,.0f} m around the trajectories"
        return f"part shown: {area}, below z = {top:,.0f} m"


def _open_scene(
    scene: Scene, positions: Floats, trajectories: Sequence[Floats], backend: str
) -> _OpenScene:
    """Select the part of a scene around trajectories and remove the roof above the sensors."""
    box = surrounding_box(scene.bounds, trajectories)
    part = ScenePart.from_scene(scene)
    if box is not None:
        part = part.cut(box)
    bounds = part.scene.bounds
    gap = _OBJECT_GAP * float(np.linalg.norm(np.ptp(bounds, 0)))
    part = replace(part, scene=separate_objects(part.scene, part.scene.face_object, gap))
    surface = RenderMesh.from_scene(part.scene, backend)
    uncut = part.scene
    cut_height = None
    if box is not None and len(positions):
        _, cut_height = floor_and_cut_heights(part.scene, surface.caster, positions)
    if cut_height is not None:
        bounds = bounds.clip(max=[np.inf, np.inf, cut_height])
        part = part.cut(bounds)
        surface = RenderMesh.from_scene(part.scene, backend)
    return _OpenScene(part, surface, uncut, bounds, box, cut_height)


@dataclass(frozen=True, eq=False)
class _Viewpoint:
    """A camera that views a scene through a cutaway."""

    surface: RenderMesh
    cutaway: Cutaway | None
    stage: PlotBox
    camera: Camera
    reach: float  # in meters; surfaces farther away cast no shadow on a point

    def sample(self, pixels: Floats) -> RaySamples:
        """Cast rays through pixel coordinates.

        The light of the samples is set to 1.
        """
        eye = self.camera.eye
        directions = self.camera.rays(pixels)
        distance, triangle, u, v = cast_with_cutaway(self.surface, self.cutaway, eye, directions)
        normal = np.full((len(pixels), 3), np.nan, np.float32)
        hit = triangle >= 0
        normal[hit] = self.surface.normals(triangle[hit], u[hit], v[hit], directions[hit])
        ground = _ground_distance(self.stage, eye, directions)
        nearer = ground < distance
        distance[nearer] = ground[nearer]
        triangle[nearer] = GROUND
        normal[nearer] = (0, 0, 1)
        with np.errstate(invalid="ignore"):
            position = (eye + distance[:, None] * directions).astype(np.float32)
        position[triangle == SKY] = np.nan
        light = np.ones(len(pixels), np.float32)
        weights = np.stack([1 - u - v, u, v], axis=1).astype(np.float32)
        return RaySamples(triangle, distance.astype(np.float32), position, normal, light, weights)

    def light_map(self, samples: RaySamples) -> LightMap:
        """Compute the light for a coarse grid of pixel samples."""
        width, height = self.camera.size
        coarse = (slice(STRIDE // 2, None, STRIDE),) * 2
        position = samples.position.reshape(height, width, 3)[coarse]
        normal = samples.normal.reshape(height, width, 3)[coarse]
        return make_light_map(self.surface, self.cutaway, self.camera, position, normal, self.reach)


def _choose_viewpoint(
    surface: RenderMesh, stage: PlotBox, positions: Floats, size: tuple[int, int], has_motion: bool
) -> _Viewpoint:
    """Place a camera and remove the walls and roofs that hide the given sensor positions."""
    # Moving objects are on the ground between other objects, so the camera looks down more steeply.
    camera = _camera(stage, size, 48.0 if has_motion else 33.0)
    cutaway = plan_cutaway(surface, positions, camera.eye)
    if cutaway is None:
        return _Viewpoint(surface, None, stage, camera, np.inf)
    # A higher camera sees more of the floor between objects.
    camera = _camera(stage, size, 42.0)
    cutaway = replace(cutaway, eye=camera.eye)
    return _Viewpoint(surface, cutaway, stage, camera, 0.15 * stage.size)


def _pixel_centers(size: tuple[int, int]) -> Floats:
    width, height = size
    grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1)
    return np.asarray(grid.reshape(-1, 2) + 0.5)


def _add_light(samples: RaySamples, pixels: Floats, light: LightMap) -> None:
    lit = np.flatnonzero(samples.triangle != SKY)
    is_ground = samples.triangle[lit] == GROUND
    samples.light[lit] = light.brightness(
        pixels[lit], samples.position[lit], samples.normal[lit], is_ground
    )


def _stage(bounds: Floats, sensors: Floats, origin: Floats) -> PlotBox:
    """Return a plot box around the scene and the nearby sensors."""
    lower, upper = bounds
    reach = 2 * max(float(np.linalg.norm(upper - lower)), 1e-3)
    close_sensors = sensors[((sensors > lower - reach) & (sensors < upper + reach)).all(axis=1)]
    shown = np.concatenate([bounds, close_sensors])
    return PlotBox.from_bounds(np.stack([shown.min(axis=0), shown.max(axis=0)]), origin)


def _camera(stage: PlotBox, size: tuple[int, int], elevation_deg: float) -> Camera:
    """Place a camera so that the wider side of the scene runs across the image."""
    is_wide = np.ptp(stage.ground[:, 0]) >= np.ptp(stage.ground[:, 1])
    top = stage.corners.copy()
    top[:, 2] = stage.bounds[1, 2]
    # The scene does not extend into the margin of the ground.
    top[:, :2] = np.clip(top[:, :2], stage.bounds[0, :2], stage.bounds[1, :2])
    corners = np.concatenate([stage.corners, top])
    return fit_camera(corners, size, FRAME, -62.0 if is_wide else -28.0, elevation_deg)


def _outline(stage: PlotBox, camera: Camera) -> Bools:
    """Return a mask of the pixels that show the plot box."""
    limits = (*stage.ground.T, (stage.level, stage.bounds[1, 2]))
    flat, _ = camera.project(list(product(*limits)))
    image = Image.new("1", camera.size)
    for side in (0, 1, 3, 2), (4, 5, 7, 6), (0, 1, 5, 4), (2, 3, 7, 6), (0, 2, 6, 4), (1, 3, 7, 5):
        corners = [(float(x), float(y)) for x, y in flat[list(side)]]
        ImageDraw.Draw(image).polygon(corners, fill=1, outline=1, width=3)
    return np.asarray(image).ravel()


def _ground_distance(stage: PlotBox, eye: Floats, directions: Floats) -> Floats:
    """Return the distances in meters from the eye to the ground along the given directions."""
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = (stage.level - eye[2]) / directions[:, 2]
        position = eye[:2] + distance[:, None] * directions[:, :2]
    inside = ((position >= stage.ground[0]) & (position <= stage.ground[1])).all(axis=1)
    return np.where(inside & (distance > 0), distance, np.inf)


def _edges(samples: RaySamples, scene: Scene, camera: Camera) -> Bools:
    """Return a mask of the pixels whose surface differs from that of a neighbor."""
    width, height = camera.size
    kind = np.append(scene.face_object, [GROUND, SKY])[samples.triangle]
    number = np.arange(width * height).reshape(height, width)
    edge = np.zeros(width * height, np.bool_)
    surface = samples.triangle != SKY
    tolerance = plane_tolerance(camera, samples.position, 1)
    for pixels, neighbors in ((number[:, :-1], number[:, 1:]), (number[:-1], number[1:])):
        has_surface = surface[pixels] | surface[neighbors]
        a = pixels[has_surface]
        b = neighbors[has_surface]
        spot = samples.position[b], samples.normal[b], tolerance[a]
        is_same = surface_similarity(samples.position[a], samples.normal[a], *spot) > 0.3
        differs = (kind[a] != kind[b]) | ~is_same & (kind[a] != SKY)
        edge[a[differs]] = edge[b[differs]] = True
    return edge

"""A shot: the surface in each pixel of a camera, before colouring."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from itertools import product

import numpy as np
from numpy.typing import ArrayLike
from PIL import Image, ImageDraw

from lidarsim.base.arrays import Bools, Floats, Floats32, Ints
from lidarsim.base.words import plural
from lidarsim.scene.scene import Scene
from raybeam import RayCaster

from . import theme
from .camera import Camera, fit_camera
from .closeup import ShownPart, around_ways, floor_and_cut
from .cutaway import cast_through, plan_cutaway
from .light import STRIDE, alike, make_light_map, plane_tolerance
from .stage import PlotBox
from .surface import Surface, apart, unit

SIZE = (1600, 1000)  # pixels of a finished picture
# Where the scene is: the title is above it, legend and colour bar are right of it.
FRAME = (0.08, 0.115, 0.79, 0.91)
# instead of a triangle
SKY = -1
GROUND = -2
STEPS = 700  # points along a line where its visibility is tested
# Of the scene's diagonal: between objects that touch, and to the pieces of a triangle.
_APART = 5e-6
_NEAR = 1e-6


@dataclass(frozen=True, eq=False)
class Samples:
    """Hits of the camera's rays; every array has one row for each ray."""

    triangle: Ints  # (n,) or SKY, GROUND
    distance: Floats32  # (n,) metres, infinite for the sky
    position: Floats32  # (n, 3) metres, NaN for the sky
    normal: Floats32  # (n, 3) unit length, NaN for the sky
    light: Floats32  # (n,) brightness: 1 on open ground
    weights: Floats32  # (n, 3) of the triangle's corners

    def among(self, which: Ints, count: int) -> Samples:
        """Put the samples at `which` (n,) among `count`; the others are sky."""
        whole = Samples(
            np.full(count, SKY), np.full(count, np.inf, np.float32),
            np.full((count, 3), np.nan, np.float32), np.full((count, 3), np.nan, np.float32),
            np.ones(count, np.float32), np.zeros((count, 3), np.float32),
        )  # fmt: skip
        for field in fields(self):
            getattr(whole, field.name)[which] = getattr(self, field.name)
        return whole

    def paint(self, face_colours: Floats, contrast: float) -> Floats32:
        """Colours (n, 4) of the samples; see `SurfaceView.paint`."""
        image = np.zeros((len(self.triangle), 4), np.float32)
        surface = np.flatnonzero(self.triangle >= 0)
        ground = np.flatnonzero(self.triangle == GROUND)
        colours = face_colours.astype(np.float32)[self.triangle[surface]]
        if colours.ndim == 3:
            colours = np.einsum("nc,nck->nk", self.weights[surface], colours)
        image[surface, :3] = colours * (1 - contrast * (1 - self.light[surface, None]))
        image[surface, 3] = 1
        light = self.light[ground, None]
        image[ground, :3] = theme.VEIL * light * theme.rgb(theme.MUTED)
        image[ground, 3:] = 1 - light * (1 - theme.VEIL)  # shadows darken the page, too
        return image


@dataclass(frozen=True, eq=False)
class SurfaceView:
    """A scene on its ground with sensors in it, seen by a camera."""

    part: ShownPart
    uncut: Scene  # what there was of the part before it was cut open
    sensors: Floats  # (p, 3) metres, local coordinates
    paths: tuple[Floats, ...]  # of moving sensors, (k, 3) each
    actors: int  # number of actors, the last objects of the scene, which are labelled
    when: str  # what is drawn, for a caption: how many sensors there are, and at what time
    models: str  # what the sensors are, for a caption
    stage: PlotBox
    camera: Camera
    whole: Samples  # through the middle of each pixel
    edges: Ints  # (e,) pixels that show the edge of something
    finer: Samples  # several of each of these in turn

    @property
    def scene(self) -> Scene:
        """The triangles that are drawn."""
        return self.part.scene

    @property
    def depth(self) -> Floats32:
        """Metres (height, width) from the eye to the surface in each pixel, infinite for none."""
        return self.whole.distance.reshape(self.camera.size[::-1])

    def paint(self, face_colours: Floats, contrast: float = 1.0) -> Floats32:
        """Colour the shot.

        `face_colours` are (f, 3) in 0 to 1, or (f, 3, 3) at the corners; a `contrast` of 0 is for
        flat colours, of 1 for full light and shade.

        Returns
        -------
        (height, width, 4) in 0 to 1: red, green and blue times opacity, and opacity. The page
        shows through the ground, and where there is nothing.
        """
        image = self.whole.paint(face_colours, contrast)
        finer = self.finer.paint(face_colours, contrast)
        if len(self.edges):
            image[self.edges] = finer.reshape(len(self.edges), -1, 4).mean(axis=1)
        return np.clip(image, 0, 1).reshape(*self.camera.size[::-1], 4)

    def divided(self, pieces: Floats32, owner: Ints) -> SurfaceView:
        """Return the same shot of triangles divided into pieces (k, 3, 3), to paint these.

        The first piece of each triangle has its number, and `owner` (k,) says whose each is.
        """
        cut = np.append(np.bincount(owner) > 1, [False, False])
        back = _NEAR * self.stage.size
        number = np.flatnonzero(cut[owner])
        if not len(number):
            return self
        corners = pieces[number].reshape(-1, 3)
        caster = RayCaster(corners, np.arange(len(corners)).reshape(-1, 3))

        def find(samples: Samples) -> Samples:
            piece = samples.triangle.copy()
            weights = samples.weights.copy()
            some = np.flatnonzero(cut[piece])
            place = samples.position[some].astype(np.float64)
            ahead = unit(place - self.camera.eye)
            found = caster.cast(place - back * ahead, ahead, t_max=2 * back)
            mine = owner[number[found.triangle]] == piece[some]
            piece[some[mine]] = number[found.triangle[mine]]
            weights[some] = np.stack([1 - found.u - found.v, found.u, found.v], axis=1)
            return replace(samples, triangle=piece, weights=weights)

        return replace(self, whole=find(self.whole), finer=find(self.finer))

    def visible(self, points: ArrayLike) -> tuple[Floats, Bools]:
        """Pixel coordinates (n, 2) of points (n, 3), local metres, and whether they can be seen."""
        pixels, distance = self.camera.project(points)
        depth = self.camera.look_up(self.depth, pixels, -np.inf)
        return pixels, distance <= depth + 2 * self.camera.footprint(distance)

    def on_ground(self, points: ArrayLike) -> tuple[Floats, Bools]:
        """Pixel coordinates of points of the ground, and whether they are visible."""
        pixels, _ = self.camera.project(points)
        bare = (self.whole.triangle < 0).reshape(self.depth.shape)
        return pixels, self.camera.look_up(bare, pixels, False)

    def runs(
        self, segments: Floats, seen: Callable[[Floats], tuple[Floats, Bools]]
    ) -> list[Floats]:
        """Split line segments (n, 2, 3) into their visible pieces; `seen` tells whether they are.

        Returns the pixel coordinates (2, 2) of the ends of each piece.
        """
        # Steps of equal length in the picture: interpolate 1 / depth, which is linear there.
        near, far = ((segments[:, end] - self.camera.eye) @ self.camera.axes[2] for end in (0, 1))
        s = np.linspace(0, 1, STEPS)[None]
        share = s * near[:, None] / (far[:, None] * (1 - s) + s * near[:, None])
        path = segments[:, :1] + share[..., None] * (segments[:, 1:] - segments[:, :1])
        pixels, shown = seen(path.reshape(-1, 3))
        out = []
        for line, there in zip(pixels.reshape(-1, STEPS, 2), shown.reshape(-1, STEPS), strict=True):
            turns = np.flatnonzero(np.diff(there, prepend=False, append=False))
            out += [line[[first, last - 1]] for first, last in turns.reshape(-1, 2)]
        return out


def take_shot(
    scene: Scene,
    poses: ArrayLike,
    *,
    paths: Sequence[Floats] = (),
    around: Sequence[Floats] = (),
    actors: int = 0,
    when: str = "",
    models: str = "",
    size: tuple[int, int] = SIZE,
    backend: str = "auto",
) -> SurfaceView:
    """Look at a scene from a good viewpoint.

    The camera looks down from the side on which the scene is wider. If the sensors stand inside a
    building, the walls and roofs in front of them are removed; a part of a large scene is cut open
    above them.

    Parameters
    ----------
    scene
        What to show.
    poses
        (p, 3) sensor positions, world coordinates.
    paths
        Trajectories of moving sensors, (k, 3) each, local coordinates.
    around
        Trajectories in a scene that may be much larger: only their surroundings are shown then,
        and the caption says so.
    actors
        How many of the last objects are actors.
    when, models
        Captions: the number of sensors, by default, and the time; what the sensors are.
    """
    sensors = np.asarray(poses, dtype=np.float64).reshape(-1, 3) - scene.origin
    everywhere = np.concatenate([sensors, *paths])
    when = when or plural(len(sensors), "sensor position")
    box = around_ways(scene.bounds, around)
    part = ShownPart.whole(scene) if box is None else ShownPart.whole(scene).cut(box)
    bounds = part.scene.bounds
    step = _APART * float(np.linalg.norm(np.ptp(bounds, 0)))
    part = uncut = replace(part, scene=apart(part.scene, part.scene.face_object, step))
    surface = Surface.of(part.scene, backend)
    cut = None
    if box is not None and len(everywhere):
        _, cut = floor_and_cut(part.scene, surface.caster, everywhere)
    if cut is not None:
        bounds = bounds.clip(max=[np.inf, np.inf, cut])
        part = part.cut(bounds)
        surface = Surface.of(part.scene, backend)
    scene = part.scene
    if box is not None:
        wide, deep, _ = np.ptp(box, axis=0)
        top = scene.origin[2] + (box[1, 2] if cut is None else cut)
        when += f" · drawn: {wide:,.0f} × {deep:,.0f} m around what moves, below z = {top:,.0f} m"
    stage = _stage(bounds, everywhere, scene.origin)
    # Moving objects are on the ground, between other objects.
    camera = _camera(stage, size, 48.0 if paths or actors else 33.0)
    reach = np.inf
    cutaway = plan_cutaway(surface, everywhere, camera.eye)
    if cutaway is not None:
        # From higher up more of the floor is visible between objects.
        camera = _camera(stage, size, 42.0)
        reach = 0.15 * stage.size
        cutaway = replace(cutaway, eye=camera.eye)

    def see(pixels: Floats) -> Samples:
        """Look through points (n, 2) of the picture, in pixels; light is added later."""
        directions = camera.rays(pixels)
        distance, triangle, u, v = cast_through(surface, cutaway, camera.eye, directions)
        normal = np.full((len(pixels), 3), np.nan, np.float32)
        hit = triangle >= 0
        normal[hit] = surface.normals(triangle[hit], u[hit], v[hit], directions[hit])
        ground = _ground_distance(stage, camera.eye, directions)
        nearer = ground < distance
        distance[nearer] = ground[nearer]
        triangle[nearer] = GROUND
        normal[nearer] = (0, 0, 1)
        with np.errstate(invalid="ignore"):
            position = (camera.eye + distance[:, None] * directions).astype(np.float32)
        position[triangle == SKY] = np.nan
        light = np.ones(len(pixels), np.float32)
        weights = np.stack([1 - u - v, u, v], axis=1).astype(np.float32)
        return Samples(triangle, distance.astype(np.float32), position, normal, light, weights)

    width, height = size
    grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1)
    centres = np.asarray(grid.reshape(-1, 2) + 0.5)
    inside = np.flatnonzero(_outline(stage, camera))
    whole = see(centres[inside]).among(inside, len(centres))
    coarse = (slice(STRIDE // 2, None, STRIDE),) * 2
    light = make_light_map(
        surface, cutaway, camera, whole.position.reshape(height, width, 3)[coarse],
        whole.normal.reshape(height, width, 3)[coarse], reach,
    )  # fmt: skip
    edges = np.flatnonzero(_edges(whole, scene, camera))
    corners = np.array([[-0.125, -0.375], [0.375, -0.125], [-0.375, 0.125], [0.125, 0.375]])
    places = (centres[edges, None] + corners).reshape(-1, 2)
    finer = see(places)
    for samples, pixels in ((whole, centres), (finer, places)):
        there = np.flatnonzero(samples.triangle != SKY)
        samples.light[there] = light.brightness(
            pixels[there], samples.position[there], samples.normal[there],
            samples.triangle[there] == GROUND,
        )  # fmt: skip
    return SurfaceView(
        part,
        uncut.scene,
        sensors,
        tuple(paths),
        actors,
        when,
        models,
        stage,
        camera,
        whole,
        edges,
        finer,
    )


def _stage(bounds: Floats, sensors: Floats, origin: Floats) -> PlotBox:
    """Choose the box to show: that of the scene, and the sensors that are near it."""
    low, high = bounds
    reach = 2 * max(float(np.linalg.norm(high - low)), 1e-3)
    near = sensors[((sensors > low - reach) & (sensors < high + reach)).all(axis=1)]
    shown = np.concatenate([bounds, near])
    return PlotBox.around(np.stack([shown.min(axis=0), shown.max(axis=0)]), origin)


def _camera(stage: PlotBox, size: tuple[int, int], elevation_deg: float) -> Camera:
    """Look along the diagonal, so that the wider side of the stage runs across the picture."""
    wide = np.ptp(stage.ground[:, 0]) >= np.ptp(stage.ground[:, 1])
    top = stage.corners.copy()
    top[:, 2] = stage.bounds[1, 2]
    # The scene is inside the ground's margin, and so is its top.
    top[:, :2] = np.clip(top[:, :2], stage.bounds[0, :2], stage.bounds[1, :2])
    corners = np.concatenate([stage.corners, top])
    return fit_camera(corners, size, FRAME, -62.0 if wide else -28.0, elevation_deg)


def _outline(stage: PlotBox, camera: Camera) -> Bools:
    """Whether the stage's box can be seen through each pixel, (pixels,)."""
    ends = (*stage.ground.T, (stage.level, stage.bounds[1, 2]))
    flat, _ = camera.project(list(product(*ends)))
    image = Image.new("1", camera.size)
    for side in (0, 1, 3, 2), (4, 5, 7, 6), (0, 1, 5, 4), (2, 3, 7, 6), (0, 2, 6, 4), (1, 3, 7, 5):
        corners = [(float(x), float(y)) for x, y in flat[list(side)]]
        ImageDraw.Draw(image).polygon(corners, fill=1, outline=1, width=3)
    return np.asarray(image).ravel()


def _ground_distance(stage: PlotBox, eye: Floats, directions: Floats) -> Floats:
    """Metres (n,) from the eye to the ground's rectangle along directions (n, 3)."""
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = (stage.level - eye[2]) / directions[:, 2]
        place = eye[:2] + distance[:, None] * directions[:, :2]
    inside = ((place >= stage.ground[0]) & (place <= stage.ground[1])).all(axis=1)
    return np.where(inside & (distance > 0), distance, np.inf)


def _edges(whole: Samples, scene: Scene, camera: Camera) -> Bools:
    """Whether each pixel shows another object or surface than one beside it, (pixels,)."""
    width, height = camera.size
    kind = np.append(scene.face_object, [GROUND, SKY])[whole.triangle]
    number = np.arange(width * height).reshape(height, width)
    edge = np.zeros(width * height, np.bool_)
    surface = whole.triangle != SKY
    tolerance = plane_tolerance(camera, whole.position, 1)
    for here, beside in ((number[:, :-1], number[:, 1:]), (number[:-1], number[1:])):
        some = surface[here] | surface[beside]
        a = here[some]
        b = beside[some]
        spot = whole.position[b], whole.normal[b], tolerance[a]
        same = alike(whole.position[a], whole.normal[a], *spot) > 0.3
        differs = (kind[a] != kind[b]) | ~same & (kind[a] != SKY)
        edge[a[differs]] = edge[b[differs]] = True
    return edge

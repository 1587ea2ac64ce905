"""A shot: what the camera sees in each pixel, before it is given colours."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..base.errors import LidarpoolError
from ..scene.scene import Scene, local_origin
from .camera import Camera, fit_camera
from .cutaway import Cutaway, cast_through, plan_cutaway
from .light import LightMap, Rig, measure_light, sun_direction
from .samples import GROUND, SKY, Samples, look
from .stage import Stage, robust_bounds
from .surface import Surface
from .theme import Theme

Floats = NDArray[np.float64]

SIZE = (1600, 1000)  # pixels of a finished picture
# Where the scene is: the title is above it, legend and colour bar are right of it.
FRAME = (0.08, 0.115, 0.79, 0.91)
FINER_MOST = 1_500_000  # samples of edges; with more, each gets half as many


@dataclass(frozen=True, eq=False)
class Shot:
    """A scene on its ground, seen by a camera.

    Parameters
    ----------
    stage
        Ground and axes.
    camera
        Of the rendered pixels, of which there may be fewer than in the finished picture.
    samples
        What is seen, some pixels having several samples.
    depth
        (height, width) metres from the eye to what each pixel sees, infinite for nothing.
    scene
        What was seen; None for the bare ground.
    """

    stage: Stage
    camera: Camera
    samples: Samples
    depth: Floats
    scene: Scene | None

    def paint(self, face_colours: Floats, theme: Theme, contrast: float = 1.0) -> Floats:
        """Give the shot colours.

        Parameters
        ----------
        face_colours
            (f, 3) in 0 to 1.
        theme
            Colours of page and ground.
        contrast
            0 for flat colours, 1 for full light and shade.

        Returns
        -------
        (height, width, 3) in 0 to 1
        """
        seen = self.samples
        colour = np.empty((len(seen.pixel), 3))
        colour[seen.triangle == SKY] = theme.rgb["page"]
        surface = seen.triangle >= 0
        shade = 1 - contrast * (1 - seen.light[surface])
        colour[surface] = face_colours[seen.triangle[surface]] * shade[:, None]
        ground = seen.triangle == GROUND
        colour[ground] = theme.rgb["ground"] * seen.light[ground, None]
        line = seen.line[..., None] * np.where(surface, 0.35, 1.0)[:, None]
        colour += line * (theme.rgb["line"] * seen.light[:, None] - colour)
        width, height = self.camera.size
        return seen.average(np.clip(colour, 0, 1), width * height).reshape(height, width, 3)


def take_shot(
    scene: Scene | None,
    poses: ArrayLike = (),
    *,
    points: ArrayLike = (),
    size: tuple[int, int] = SIZE,
    backend: str = "auto",
) -> Shot:
    """Look at a scene from a place that shows it well.

    The camera looks down from the side on which the scene is wider. Where the sensors stand
    inside a building, the walls and roofs in front of them are taken away.

    Parameters
    ----------
    scene
        What to show; None for the bare ground.
    poses
        (p, 3) sensor positions, world coordinates.
    points
        (n, 3) world coordinates, what to show where there is no scene.
    size
        Width and height in pixels of the finished picture; the NumPy ray caster renders at
        less than that.
    backend
        Ray caster, see `raybeam.RayCaster`.
    """
    if min(size) < 16:
        raise LidarpoolError(
            f"A picture of {size[0]} x {size[1]} pixels is too small; 16 is least."
        )
    shown, sensors = finite_points(points), finite_points(poses)
    origin = _origin(scene, shown, sensors)
    sensors = sensors - origin
    stage = _stage(scene, sensors, shown - origin, origin)
    surface = None if scene is None else Surface.of(scene, backend)
    rig, scale = Rig(), 1.0
    if surface is not None and surface.caster.backend == "numpy":
        rig, scale = Rig(stride=3, sky_rays=6, sun_rays=2), 1.0
    camera = _camera(stage, (round(size[0] * scale), round(size[1] * scale)), 33.0)
    cutaway = None
    if surface is not None:
        cutaway = plan_cutaway(surface, sensors, camera.eye)
        if cutaway is not None:
            # From higher up more of the floor is seen between what stands on it.
            camera = _camera(stage, camera.size, 42.0)
            cutaway = replace(cutaway, eye=camera.eye)
            rig = replace(rig, reach=0.15 * stage.size)
    return _expose(stage, surface, camera, cutaway, rig)


def finite_points(points: ArrayLike) -> Floats:
    """Rows of (n, 3) that are finite; n may be 0."""
    array = np.asarray(points, dtype=np.float64)
    if not array.size:
        return np.empty((0, 3))
    if array.ndim != 2 or array.shape[1] != 3:
        raise LidarpoolError(f"Points to draw have shape {array.shape}; expected (n, 3).")
    return array[np.isfinite(array).all(axis=1)]


def _origin(scene: Scene | None, points: Floats, sensors: Floats) -> Floats:
    """World coordinates of the local origin: the scene's, or else that of what is shown."""
    if scene is not None:
        return scene.origin
    for some in (points, sensors):
        if len(some):
            return local_origin(some)
    return np.zeros(3)


def _stage(scene: Scene | None, sensors: Floats, points: Floats, origin: Floats) -> Stage:
    """Choose the box to show: the scene or the points, and the sensors that are near them."""
    bounds = scene.bounds if scene is not None else robust_bounds(points)
    if bounds is None:
        bounds = robust_bounds(sensors)
    if bounds is None:
        bounds = np.zeros((2, 3))
    reach = 2 * max(float(np.linalg.norm(bounds[1] - bounds[0])), 1e-3)
    near = sensors[((sensors > bounds[0] - reach) & (sensors < bounds[1] + reach)).all(axis=1)]
    shown = np.concatenate([bounds, near])
    return Stage.around(np.stack([shown.min(axis=0), shown.max(axis=0)]), origin)


def _camera(stage: Stage, size: tuple[int, int], elevation_deg: float) -> Camera:
    """Look along the diagonal, so that the wider side of the stage runs across the picture."""
    wide = np.ptp(stage.ground[:, 0]) >= np.ptp(stage.ground[:, 1])
    top = stage.corners.copy()
    top[:, 2] = stage.bounds[1, 2]
    # The scene stays inside the ground's margin, so its top does so too.
    top[:, :2] = np.clip(top[:, :2], stage.bounds[0, :2], stage.bounds[1, :2])
    corners = np.concatenate([stage.corners, top])
    return fit_camera(corners, size, FRAME, -62.0 if wide else -28.0, elevation_deg)


def _expose(
    stage: Stage, surface: Surface | None, camera: Camera, cutaway: Cutaway | None, rig: Rig
) -> Shot:
    """Cast one ray through each pixel, light the surfaces, and look closer along edges."""

    def see(pixels: Floats) -> Samples:
        """Look through places (n, 2) of the picture, in pixels."""
        directions = camera.rays(pixels)
        hits = None
        if surface is not None:
            hits = cast_through(surface, cutaway, camera.eye, directions)
        return look(stage, camera, surface, pixels, directions, hits)

    width, height = camera.size
    column, row = np.meshgrid(np.arange(width), np.arange(height))
    centres = np.stack([column.ravel(), row.ravel()], axis=1).astype(np.float64) + 0.5
    whole = see(centres)
    light = _light_map(surface, cutaway, camera, whole, rig)
    edges = _edges(whole.triangle.reshape(height, width))
    corners = np.array([[-0.125, -0.375], [0.375, -0.125], [-0.375, 0.125], [0.125, 0.375]])
    if len(corners) * np.count_nonzero(edges) > FINER_MOST:  # a scene full of edges
        corners = corners[[0, 3]]
    finer = see((centres[edges][:, None] + corners).reshape(-1, 2))
    samples = whole.select(~edges).join(finer)
    lit = samples.lit(light, camera, sun_direction(camera))
    depth = whole.distance.reshape(height, width)
    return Shot(stage, camera, lit, depth, None if surface is None else surface.scene)


def _light_map(
    surface: Surface | None, cutaway: Cutaway | None, camera: Camera, whole: Samples, rig: Rig
) -> LightMap:
    """Light at every few pixels of the full set of samples, which is one a pixel."""
    width, height = camera.size
    grid = (slice(rig.stride // 2, None, rig.stride),) * 2
    position = whole.position.reshape(height, width, 3)[grid]
    normal = whole.normal.reshape(height, width, 3)[grid]
    return measure_light(surface, cutaway, rig, camera, position, normal)


def _edges(triangle: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Whether each pixel shows another triangle than one beside it: (height * width,)."""
    edge = np.zeros(triangle.shape, dtype=np.bool_)
    across = triangle[:, 1:] != triangle[:, :-1]
    down = triangle[1:] != triangle[:-1]
    edge[:, 1:] |= across
    edge[:, :-1] |= across
    edge[1:] |= down
    edge[:-1] |= down
    return edge.ravel()

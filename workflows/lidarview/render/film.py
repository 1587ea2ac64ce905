"""Render a film of points as they are scanned.

The film also shows the scene, on a dark background.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from PIL import Image, ImageDraw

from lidarsim.numerics.arrays import AnyFloats, Bools, Bytes, Floats
from lidarsim.scene.actors import Actor
from raybeam import RayCaster

from .camera import Camera
from .pictures import draw_discs
from .surface import dot, normalize
from .theme import rgb

SIZE = (960, 540)  # pixels
BACK, SURFACE, ACTOR = (np.append(rgb(c), 1.0) for c in ("#0e1116", "#5b6570", "#eac9a0"))
# Colors of the platform's trajectory.
_RED = "#ff4d5e"
_WHITE = "#ffffff"
_MAX_PIXEL = 4000  # Pillow cannot draw lines that reach far outside the image
FOCAL_PX = 922.0  # focal length in pixels, for a field of view of 55 degrees
# Distances from the platform to the camera and to its target, as multiples of the range.
_BEHIND = 1.7
_ABOVE = 0.95
_AHEAD = 1.6
# The heading is averaged over this fraction of the film before and after each frame.
_HEADING_SHARE = 0.12
# Distance of a circling camera as a multiple of the size, and tangent of its elevation.
_CIRCLE_RADIUS = 1.25
_CIRCLE_SLOPE = 0.62
# Distances below which surfaces are omitted, and at which they fade, as multiples of the focus
# distance.
_MIN_FOCUS = 0.3
_HAZE_FOCUS = 6.0
# Brightness of old points, and the number of frames in which new points fade to it.
_OLD_BRIGHTNESS = 0.42
_FADE_FRAMES = 3.0
_POINT_RADIUS = 2.3  # half pixels
_NOISE = 0.02  # distance of a point from its surface, as a fraction of its range


class _Shape(NamedTuple):
    caster: RayCaster
    normals: Floats  # (f, 3)
    color: Floats  # (4,)


class _CameraPath(NamedTuple):
    """Camera positions and targets in all frames, in meters."""

    eyes: Floats  # (k, 3)
    targets: Floats  # (k, 3)
    platform: Floats  # (k, 3), or (0, 3) without a platform
    focus: float  # distance from the camera to the center of the scene or to the platform

    def camera(self, number: int) -> Camera:
        ahead = normalize((self.targets - self.eyes)[number, None])
        right = normalize(np.cross(ahead, [0.0, 0.0, 1.0]))
        axes = np.concatenate([right, np.cross(right, ahead), ahead])
        return Camera(self.eyes[number], axes, FOCAL_PX, np.array(SIZE) / 2, SIZE)


@dataclass(eq=False)
class _FilmPoints:
    """The points that a frame shows, including points from earlier frames."""

    positions: Floats = field(default_factory=lambda: np.empty((0, 3)))
    colors: Floats = field(default_factory=lambda: np.empty((0, 4)))
    first_frame: Floats = field(default_factory=lambda: np.empty(0))

    def add(self, number: int, positions: Floats, colors: Floats) -> None:
        self.positions = np.vstack([self.positions, positions])
        self.colors = np.vstack([self.colors, colors])
        new = np.full(len(self.positions) - len(self.first_frame), number)
        self.first_frame = np.append(self.first_frame, new)

    def select(self, chosen: Bools) -> None:
        """Keep only the points that a mask selects."""
        self.positions = self.positions[chosen]
        self.colors = self.colors[chosen]
        self.first_frame = self.first_frame[chosen]


@dataclass(frozen=True, eq=False)
class Film:
    """The content of a film.

    Coordinates are local, in meters. Times are relative to the start of the survey.
    """

    moments_ns: Floats  # (k,) times of the frames
    # New points (n, 3) in each frame, and their RGBA colors (n, 4) from 0 to 1.
    new_points: Iterable[tuple[Floats, Floats]]
    keep_share: float  # fraction of the points that later frames show as well
    scene_triangles: AnyFloats  # (f, 3, 3) corners of the scene's triangles
    top: float  # height above which the scene is cut open
    actors: Sequence[Actor]
    box: Floats  # (2, 3) box that the camera circles if there is no platform
    platform_trajectory: tuple[Floats, Floats] | None = (
        None  # times (w,) in ns, and positions (w, 3)
    )
    range_m: float = 1.0  # typical range of the platform's points

    def frames(self) -> Iterator[Bytes]:
        """Yield the frames as uint8 arrays of shape (height, width, 3).

        New points are brighter than old points. Old points in front of all surfaces are omitted,
        because they show where an actor was in an earlier frame.
        """
        random = np.random.default_rng(0)
        points = _FilmPoints()
        scene = [_shape(self.scene_triangles, SURFACE)] if len(self.scene_triangles) else []
        camera_path = self._camera_path()
        for number, (moment, part) in enumerate(zip(self.moments_ns, self.new_points, strict=True)):
            camera = camera_path.camera(number)
            shapes = [*scene, *self._actor_shapes(moment)]
            image, depth = _draw_surfaces(shapes, camera, camera_path.focus, self.top)
            points.add(number, *part)
            image = _draw_points(image, depth, camera, points, number, camera_path.focus)
            frame = Image.fromarray(np.round(255 * image[..., :3]).astype(np.uint8))
            _draw_trajectory(frame, camera, camera_path.platform[: number + 1])
            yield np.asarray(frame)
            is_old = points.first_frame < number
            points.select(is_old | (random.random(len(is_old)) < self.keep_share))

    def _actor_shapes(self, moment_ns: float) -> list[_Shape]:
        """Return the triangles of the actors that are present at a given time."""
        meshes = [actor.mesh_at(moment_ns) for actor in self.actors]
        present = [mesh.vertices[mesh.faces] for mesh in meshes if np.ptp(mesh.vertices, 0).any()]
        return [_shape(np.concatenate(present), ACTOR)] if present else []

    def _camera_path(self) -> _CameraPath:
        """Choose the camera position and target in each frame."""
        count = len(self.moments_ns)
        if self.platform_trajectory is None:
            azimuth = 2 * np.pi * np.arange(count) / count - 1.1
            rise = np.full(count, _CIRCLE_SLOPE)
            direction = normalize(np.stack([np.cos(azimuth), np.sin(azimuth), rise], axis=1))
            distance = _CIRCLE_RADIUS * float(np.linalg.norm(np.ptp(self.box, 0)))
            middle = self.box.mean(axis=0)
            eyes = middle + distance * direction
            return _CameraPath(eyes, np.tile(middle, (count, 1)), np.empty((0, 3)), distance)
        lead_ns = _HEADING_SHARE * self.moments_ns[-1]
        times, positions = self.platform_trajectory
        earlier, platform, later = (
            np.stack([np.interp(self.moments_ns + shift, times, x) for x in positions.T], 1)
            for shift in (-lead_ns, 0, lead_ns)
        )
        ahead = normalize((later - earlier) * [1.0, 1.0, 0.0])
        ahead[~ahead.any(axis=1)] = [1.0, 0.0, 0.0]  # the platform is stationary or rises
        eyes = platform - _BEHIND * self.range_m * ahead + [0.0, 0.0, _ABOVE * self.range_m]
        targets = platform + _AHEAD * self.range_m * ahead
        return _CameraPath(eyes, targets, platform, _BEHIND * self.range_m)


def _draw_points(
    image: AnyFloats,
    depth: Floats,
    camera: Camera,
    points: _FilmPoints,
    number: int,
    focus: float,
) -> AnyFloats:
    """Draw the points of a frame over an image of the surfaces.

    `depth` (height, width) is the distance to the surface in each pixel, in meters.
    """
    age = number - points.first_frame
    pixels, distance = camera.project(points.positions)
    surface = camera.sample_image(depth, pixels, -np.inf)  # no point is drawn outside the image
    slack = _NOISE * distance + 2 * camera.footprint(distance)
    shown = (distance <= surface + slack) & (distance >= _MIN_FOCUS * focus)
    shown &= (age == 0) | (distance >= surface - slack) | np.isinf(surface)
    fade = _OLD_BRIGHTNESS + (1 - _OLD_BRIGHTNESS) * np.exp(-age / _FADE_FRAMES)
    # The nearest points are drawn last. On the same surface, the newest points are drawn last.
    rows = np.flatnonzero(shown)
    rows = rows[np.argsort((fade * slack - distance)[rows], kind="stable")]
    colors = BACK + (points.colors[rows] - BACK) * fade[rows, None]
    return draw_discs(image, pixels[rows], colors, _POINT_RADIUS)


def _draw_trajectory(frame: Image.Image, camera: Camera, positions: Floats) -> None:
    """Draw the platform positions as a line that ends in a disc."""
    pen = ImageDraw.Draw(frame)
    pixels, _ = camera.project(positions)
    line = [(float(x), float(y)) for x, y in pixels if max(abs(x), abs(y)) < _MAX_PIXEL]
    pen.line(line, _RED, 3)
    for x, y in line[-1:]:
        pen.ellipse((x - 5, y - 5, x + 5, y + 5), _RED, _WHITE, 2)


def _shape(corners: AnyFloats, color: Floats) -> _Shape:
    """Prepare triangles for ray casting, given their corners."""
    normals = normalize(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    faces = np.arange(3 * len(corners)).reshape(-1, 3)
    return _Shape(RayCaster(corners.reshape(-1, 3), faces), normals, color)


def _draw_surfaces(
    shapes: Sequence[_Shape], camera: Camera, focus: float, top: float
) -> tuple[AnyFloats, Floats]:
    """Draw surfaces and return the RGBA image and the depth.

    The depth is in meters.
    """
    width, height = SIZE
    grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1)
    rays = camera.rays(grid.reshape(-1, 2) + 0.5)
    forward = rays @ camera.axes[2]
    start = _MIN_FOCUS * focus / forward
    if camera.eye[2] > top:  # rays start at the height where the scene is cut
        start = np.maximum(start, (top - camera.eye[2]) / np.minimum(rays[:, 2], -1e-6))
    depth = np.full(len(rays), np.inf)
    image = np.tile(BACK, (len(rays), 1))
    for caster, normals, color in shapes:
        hits = caster.cast(camera.eye + start[:, None] * rays, rays)
        nearer = np.flatnonzero(hits.distance + start < depth)
        depth[nearer] = (hits.distance + start)[nearer]
        normal = normals[hits.triangle[nearer]]
        light = 0.2 + 0.4 * np.abs(dot(normal, rays[nearer])) + 0.4 * np.abs(normal[:, 2])
        light *= np.exp(-depth[nearer] / (_HAZE_FOCUS * focus))
        image[nearer] = BACK + light[:, None] * (color - BACK)
    edge = _edges((1 / (depth * forward)).reshape(height, width))
    image = BACK + (image.reshape(height, width, 4) - BACK) * (1 - edge)
    return image.astype(np.float32), depth.reshape(height, width)


def _edges(inverse_depth: Floats) -> Floats:
    """Return the strength of the edges between surfaces.

    The inverse depth of a plane is linear in the image. Beyond an edge, it falls below this line.
    The shape is (height, width, 1).
    """
    padded = np.pad(inverse_depth, 1, mode="edge")
    sides = (
        np.maximum(padded[:-2, 1:-1] + padded[2:, 1:-1], padded[1:-1, :-2] + padded[1:-1, 2:]) / 2
    )
    return np.clip(4 * (sides / np.maximum(padded[1:-1, 1:-1], 1e-9) - 1), 0, 0.5)[..., None]

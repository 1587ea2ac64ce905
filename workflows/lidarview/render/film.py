"""A film of points as they are scanned, over their scene in the dark."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageDraw

from lidarsim.base.arrays import AnyFloats, Bytes, Floats
from lidarsim.scene.actors import Actor
from raybeam import RayCaster

from .camera import Camera
from .pictures import splat
from .surface import dot, unit
from .theme import rgb

SIZE = (960, 540)  # pixels
BACK, SURFACE, ACTOR = (np.append(rgb(c), 1.0) for c in ("#0e1116", "#5b6570", "#eac9a0"))
# the way; Pillow draws no endless lines
_RED = "#ff4d5e"
_WHITE = "#ffffff"
_FAR_OUT = 4000
_FOCAL = 922.0  # pixels: 55 degrees across
# times the range: the camera, and what it looks at
_BEHIND = 1.7
_ABOVE = 0.95
_AHEAD = 1.6
_HEADING = 0.12  # of the film, before and after, tells where the carrier is heading
# of a camera that circles: times the size, and up for a metre away
_AWAY = 1.25
_SLOPE = 0.62
# times the focus: nearer surfaces are left out, farther ones vanish
_NEAR = 0.3
_HAZE = 6.0
# brightness of old points; frames in which new ones come near it
_OLD = 0.42
_FADES = 3.0
_DOT = 2.3  # half pixels: the radius of points
_NOISE = 0.02  # of the distance, that a point may lie beside its surface

_Shape = tuple[RayCaster, Floats, Floats]  # of triangles: their normals (f, 3) and colour (4,)


@dataclass(frozen=True, eq=False)
class Film:
    """What a film shows; local coordinates in metres, times since the survey's start."""

    moments_ns: Floats  # (k,) of the frames
    parts: Iterable[tuple[Floats, Floats]]  # points (n, 3) each adds, colours (n, 4) in 0 to 1
    kept: float  # share of the points that later frames show, too
    still: AnyFloats  # (f, 3, 3): triangles of the scene
    top: float  # height above which the scene is cut open
    actors: Sequence[Actor]
    box: Floats  # (2, 3), that the camera circles around if it follows nothing
    way: tuple[Floats, Floats] | None = None  # times (w,), ns, and places (w, 3) of the carrier
    range_m: float = 1.0  # at which the carrier sees most

    def frames(self) -> Iterator[Bytes]:
        """Draw the frames, (height, width, 3) each; new points are bright, older ones darker.

        Old points in front of all surfaces are left out: there was an actor that has moved on.
        """
        random = np.random.default_rng(0)
        born = np.empty(0)
        points = np.empty((0, 3))
        paint = np.empty((0, 4))
        still = [_shape(self.still, SURFACE)] if len(self.still) else []
        eyes, targets, places, focus = self._sights()
        for number, (moment, part) in enumerate(zip(self.moments_ns, self.parts, strict=True)):
            ahead = unit((targets - eyes)[number, None])
            right = unit(np.cross(ahead, [0.0, 0.0, 1.0]))
            axes = np.concatenate([right, np.cross(right, ahead), ahead])
            camera = Camera(eyes[number], axes, _FOCAL, np.array(SIZE) / 2, SIZE)
            meshes = [actor.placed(moment) for actor in self.actors]
            there = [mesh.vertices[mesh.faces] for mesh in meshes if np.ptp(mesh.vertices, 0).any()]
            moving = [_shape(np.concatenate(there), ACTOR)] if there else []
            image, depth = _surfaces([*still, *moving], camera, focus, self.top)
            points, paint = (np.vstack(each) for each in zip((points, paint), part, strict=True))
            born = np.append(born, np.full(len(points) - len(born), number))
            pixels, distance = camera.project(points)
            surface = camera.look_up(depth, pixels, -np.inf)  # there is none outside
            slack = _NOISE * distance + 2 * camera.footprint(distance)
            shown = (distance <= surface + slack) & (distance >= _NEAR * focus)
            shown &= (born == number) | (distance >= surface - slack) | np.isinf(surface)
            fade = _OLD + (1 - _OLD) * np.exp((born - number) / _FADES)
            rows = np.flatnonzero(shown)  # of points on one surface, the newest are drawn last
            rows = rows[np.argsort((fade * slack - distance)[rows], kind="stable")]
            image = splat(image, pixels[rows], BACK + (paint[rows] - BACK) * fade[rows, None], _DOT)
            frame = Image.fromarray(np.round(255 * image[..., :3]).astype(np.uint8))
            pen, (way, _) = ImageDraw.Draw(frame), camera.project(places[: number + 1])
            line = [(float(x), float(y)) for x, y in way if max(abs(x), abs(y)) < _FAR_OUT]
            pen.line(line, _RED, 3)
            for x, y in line[-1:]:
                pen.ellipse((x - 5, y - 5, x + 5, y + 5), _RED, _WHITE, 2)
            yield np.asarray(frame)
            kept = (born < number) | (random.random(len(born)) < self.kept)
            points = points[kept]
            paint = paint[kept]
            born = born[kept]

    def _sights(self) -> tuple[Floats, Floats, Floats, float]:
        """Of each frame: eye, target and carrier, if any, (k, 3); metres to what is looked at."""
        count = len(self.moments_ns)
        if self.way is None:
            turn = 2 * np.pi * np.arange(count) / count - 1.1
            away = unit(np.stack([np.cos(turn), np.sin(turn), np.full(count, _SLOPE)], axis=1))
            far = _AWAY * float(np.linalg.norm(np.ptp(self.box, 0)))
            middle = self.box.mean(axis=0)
            return middle + far * away, np.tile(middle, (count, 1)), np.empty((0, 3)), far
        reach = _HEADING * self.moments_ns[-1]
        early, now, late = (
            np.stack([np.interp(self.moments_ns + by, self.way[0], x) for x in self.way[1].T], 1)
            for by in (-reach, 0, reach)
        )
        ahead = unit((late - early) * [1.0, 1.0, 0.0])
        ahead[~ahead.any(axis=1)] = [1.0, 0.0, 0.0]  # it stands, or rises
        eye = now - _BEHIND * self.range_m * ahead + [0.0, 0.0, _ABOVE * self.range_m]
        return eye, now + _AHEAD * self.range_m * ahead, now, _BEHIND * self.range_m


def _shape(corners: AnyFloats, colour: Floats) -> _Shape:
    normals = unit(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    faces = np.arange(3 * len(corners)).reshape(-1, 3)
    return RayCaster(corners.reshape(-1, 3), faces), normals, colour


def _surfaces(
    shapes: Sequence[_Shape], camera: Camera, focus: float, top: float
) -> tuple[AnyFloats, Floats]:
    """Draw surfaces: (height, width, 4), and metres (height, width) from the eye to them."""
    width, height = SIZE
    grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1)
    rays = camera.rays(grid.reshape(-1, 2) + 0.5)
    forward = rays @ camera.axes[2]
    start = _NEAR * focus / forward
    if camera.eye[2] > top:  # rays begin where the scene is cut
        start = np.maximum(start, (top - camera.eye[2]) / np.minimum(rays[:, 2], -1e-6))
    depth = np.full(len(rays), np.inf)
    image = np.tile(BACK, (len(rays), 1))
    for caster, normals, colour in shapes:
        hits = caster.cast(camera.eye + start[:, None] * rays, rays)
        found = np.flatnonzero(hits.distance + start < depth)
        depth[found] = (hits.distance + start)[found]
        normal = normals[hits.triangle[found]]
        light = 0.2 + 0.4 * np.abs(dot(normal, rays[found])) + 0.4 * np.abs(normal[:, 2])
        light *= np.exp(-depth[found] / (_HAZE * focus))
        image[found] = BACK + light[:, None] * (colour - BACK)
    # The inverse of depth is linear in the picture of a plane: less of it is behind an edge.
    near = np.pad((1 / (depth * forward)).reshape(height, width), 1, mode="edge")
    sides = np.maximum(near[:-2, 1:-1] + near[2:, 1:-1], near[1:-1, :-2] + near[1:-1, 2:]) / 2
    edge = np.clip(4 * (sides / np.maximum(near[1:-1, 1:-1], 1e-9) - 1), 0, 0.5)[..., None]
    image = BACK + (image.reshape(height, width, 4) - BACK) * (1 - edge)
    return image.astype(np.float32), depth.reshape(height, width)

"""A film of points as they are scanned, over their scene in the dark."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from PIL import Image, ImageDraw

from ..base.arrays import AnyFloats, Bytes, Floats, Floats32
from ..scene.scene import Scene
from ..scene.scene_mesh import stacked
from .camera import Camera
from .pictures import splat
from .surface import Surface, dot, unit
from .theme import rgb

SIZE = (960, 540)  # pixels
BACK, SURFACE, ACTOR, WAY, LIGHT = map(rgb, ("#0e1116", "#5b6570", "#eac9a0", "#ff4d5e", "#ffffff"))
_FOCAL = 922.0  # pixels: 55 degrees across
_BEHIND, _ABOVE, _AHEAD = 1.7, 0.95, 1.6  # of the range: the camera, and what it looks at
_HEADING = 0.12  # of the film, before and after, tells where the carrier is heading
_AWAY, _UP_DEG = 1.25, 32.0  # of a camera that circles: times the size, and elevation
_NEAR, _HAZE = 0.3, 6.0  # of the focus: nearer surfaces are left out, farther ones vanish
_OLD, _FADES = 0.42, 3.0  # brightness of old points; frames in which new ones come near it
_NEW_RADIUS, _OLD_RADIUS, _SPARSE = 2.3, 1.5, 50_000  # half pixels; more new points are smaller
_NOISE = 0.02  # of the distance, that a point may lie beside its surface


@dataclass(frozen=True, eq=False)
class Viewpoint:
    """Where a frame is seen from."""

    camera: Camera
    focus: float  # metres to what it looks at
    way: Floats  # (k, 3): where the carrier was up to now; none if nothing is followed


def following(
    times_ns: Floats, places: Floats, moments_ns: Floats, range_m: float
) -> list[Viewpoint]:
    """Look from behind and above a carrier at moments (f,).

    It is at `places` (k, 3) at times (k,); how near the camera is depends on its sensors' range.
    """

    def at(when: Floats) -> Floats:
        return np.stack([np.interp(when, times_ns, axis) for axis in places.T], axis=1)

    reach, made = _HEADING * float(moments_ns[-1]), []
    ahead = unit((at(moments_ns + reach) - at(moments_ns - reach)) * [1.0, 1.0, 0.0])
    ahead[~ahead.any(axis=1)] = [1.0, 0.0, 0.0]  # it stands, or rises
    for moment, place, way in zip(moments_ns, at(moments_ns), ahead * range_m, strict=True):
        eye = place - _BEHIND * way + [0.0, 0.0, _ABOVE * range_m]
        until_now = at(np.linspace(0, moment, 4000))
        made.append(_looking(eye, place + _AHEAD * way, _BEHIND * range_m, until_now))
    return made


def circling(box: Floats, frames: int) -> list[Viewpoint]:
    """Look at a box (2, 3) from all around."""
    far, up = _AWAY * float(np.linalg.norm(box[1] - box[0])), np.radians(_UP_DEG)
    turn = np.linspace(0, 2 * np.pi, frames, endpoint=False) - 1.1
    away = np.stack([np.cos(turn) * np.cos(up), np.sin(turn) * np.cos(up), 0 * turn + np.sin(up)])
    middle = box.mean(axis=0)
    return [_looking(middle + far * way, middle, far, np.empty((0, 3))) for way in away.T]


def _looking(eye: Floats, target: Floats, focus: float, way: Floats) -> Viewpoint:
    ahead = unit((target - eye)[None])[0]
    right = unit(np.cross(ahead, [0.0, 0.0, 1.0])[None])[0]
    axes = np.stack([right, np.cross(right, ahead), ahead])
    return Viewpoint(Camera(eye, axes, _FOCAL, np.array(SIZE) / 2, SIZE), focus, way)


def film(
    views: Sequence[Viewpoint],
    moments_ns: Floats,
    parts: Iterable[tuple[Floats32, Floats32]],
    scene: Scene | None,
    kept: float,
) -> Iterator[Bytes]:
    """Draw a frame, (height, width, 3), of each view at its moment.

    `parts` are the points (n, 3) that each frame adds, local metres, and their colours (n, 3) in 0
    to 1. They are bright in that frame; a share of them, `kept`, stays and becomes darker. Old
    points in front of all surfaces are not drawn: they were on actors that have moved on.
    """
    still = [] if scene is None or not len(scene.faces) else [(Surface.of(scene), SURFACE)]
    random, old, shades, born = (
        np.random.default_rng(0),
        *np.zeros((2, 0, 3), np.float32),
        np.zeros(0),
    )
    for number, (view, moment, (new, paint)) in enumerate(
        zip(views, moments_ns, parts, strict=True)
    ):
        solids = still
        if scene is not None and scene.actors:
            meshes = [actor.placed(moment) for actor in scene.actors]
            vertices, faces = stacked([(mesh.vertices, mesh.faces) for mesh in meshes])
            moving = replace(
                scene,
                vertices=vertices,
                faces=faces,
                face_object=faces[:, 0] * 0,
                actors=(),
                colours=None,
            )
            solids = [*still, (Surface.of(moving), ACTOR)]
        frame = _Frame(view, solids)
        fade = _OLD + (1 - _OLD) * np.exp((born - number) / _FADES)
        frame.draw(old, BACK + (shades - BACK) * fade[:, None], _OLD_RADIUS, behind=True)
        radius = np.clip(_NEW_RADIUS * np.sqrt(_SPARSE / (len(new) + 1)), _OLD_RADIUS, _NEW_RADIUS)
        red = np.tile(WAY, (len(view.way), 1))
        frame.draw(np.vstack([new, view.way]), np.vstack([paint, red]), float(radius))
        yield frame.finished()
        some = random.random(len(new)) < kept
        old, shades = np.vstack([old, new[some]]), np.vstack([shades, paint[some]])
        born = np.append(born, np.full(int(some.sum()), number))


class _Frame:
    """One picture: surfaces in the dark, and points over them."""

    def __init__(self, view: Viewpoint, solids: Sequence[tuple[Surface, Floats]]) -> None:
        self.view, camera, (width, height) = view, view.camera, SIZE
        grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1)
        rays = camera.rays(grid.reshape(-1, 2) + 0.5)
        forward = rays @ camera.axes[2]
        start = _NEAR * view.focus / forward
        depth, image = np.full(len(rays), np.inf), np.tile(BACK, (len(rays), 1))
        for surface, colour in solids:
            hits = surface.caster.cast(camera.eye + start[:, None] * rays, rays)
            found = np.flatnonzero(hits.distance + start < depth)
            depth[found] = (hits.distance + start)[found]
            normal = surface.face_normals[hits.triangle[found]]
            light = 0.2 + 0.4 * np.abs(dot(normal, rays[found])) + 0.4 * np.abs(normal[:, 2])
            light *= np.exp(-depth[found] / (_HAZE * view.focus))
            image[found] = BACK + light[:, None] * (colour - BACK)
        # The inverse of depth is linear in the picture of a plane: less of it is behind an edge.
        near = np.pad((1 / (depth * forward)).reshape(height, width), 1, mode="edge")
        sides = np.maximum(near[:-2, 1:-1] + near[2:, 1:-1], near[1:-1, :-2] + near[1:-1, 2:]) / 2
        edge = np.clip(4 * (sides / np.maximum(near[1:-1, 1:-1], 1e-9) - 1), 0, 0.5)
        self.depth, self.image = (
            depth.reshape(height, width),
            np.ones((height, width, 4), np.float32),
        )
        self.image[..., :3] = BACK + (image.reshape(height, width, 3) - BACK) * (
            1 - edge[..., None]
        )

    def draw(
        self, places: AnyFloats, colours: AnyFloats, radius: float, behind: bool = False
    ) -> None:
        """Draw points (n, 3) that no surface hides; with `behind`, only those on a surface."""
        camera = self.view.camera
        pixels, distance = camera.project(places)
        surface = camera.look_up(self.depth, pixels, -np.inf)  # no points outside
        slack = _NOISE * distance + 2 * camera.footprint(distance)
        shown = (distance <= surface + slack) & (distance >= _NEAR * self.view.focus)
        if behind:
            shown &= (distance >= surface - slack) | np.isinf(surface)
        order = np.flatnonzero(shown)
        order = order[np.argsort(-distance[order], kind="stable")]
        self.image = splat(self.image, pixels[order], colours[order].astype(np.float32), radius)

    def finished(self) -> Bytes:
        """Return it, (height, width, 3), with a dot where the carrier is."""
        image = Image.fromarray(np.round(255 * self.image[..., :3]).astype(np.uint8))
        for x, y in self.view.camera.project(self.view.way[-1:])[0]:
            for radius, colour in ((6.5, LIGHT), (5.0, WAY)):
                box = (x - radius, y - radius, x + radius, y + radius)
                ImageDraw.Draw(image).ellipse(box, fill=tuple(np.round(255 * colour).astype(int)))
        return np.asarray(image)

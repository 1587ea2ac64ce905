"""What part of a scene to show: around a trajectory, and under a roof."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lidarsim.base.arrays import Floats, Ints
from lidarsim.scene.scene import Scene
from lidarsim.scene.scene_mesh import triangle_areas
from raybeam import RayCaster

from .surface import spiral

# Margin on each side of a trajectory: a share of its diagonal, times its height above the scene's
# lowest point, and least metres.
_SHARE = 0.35
_HEIGHTS = 2.0
_LEAST_M = 25.0
_MOST = 0.5  # share of the scene's ground from which all of it is shown

_ROOFED = 0.7  # share of steep rays from a sensor that hit the scene if there is a roof
_STEEP_DEG = 60.0
_RAYS = 64
_ROUGH = 0.5  # spread of what is above a sensor over its height there: more is a tree's crown
_TOUCHES = 1e-3  # of the scene's diagonal: a sensor on a surface does not stand under it
_PLACES = 8  # that are asked


def around_ways(bounds: Floats, ways: Sequence[Floats]) -> Floats | None:
    """Box (2, 3) around trajectories (k, 3), down to the ground; None if it is most of the scene.

    `bounds` (2, 3) are those of the scene; all in metres.
    """
    if not ways:
        return None
    places = np.concatenate(ways)
    low = places.min(axis=0)
    high = places.max(axis=0)
    length = float(np.linalg.norm((high - low)[:2]))
    room = max(_SHARE * length, _HEIGHTS * float(high[2] - bounds[0, 2]), _LEAST_M)
    box = np.stack([low - room, high + room]).clip(*bounds)
    box[0, 2] = bounds[0, 2]
    ground, whole = (float(np.prod((b[1] - b[0])[:2])) for b in (box, bounds))
    return box if ground < _MOST * whole else None


def floor_and_cut(
    scene: Scene, caster: RayCaster, places: Floats
) -> tuple[float | None, float | None]:
    """Height of the floor under places (p, 3); and where to cut the scene open, metres.

    That is halfway up to the roof, None under the sky. There is no floor over an abyss.
    """
    some = places[np.linspace(0, len(places) - 1, min(len(places), _PLACES)).astype(int)]
    floor = some[:, 2] - caster.cast(some, np.tile([0.0, 0.0, -1.0], (len(some), 1))).distance
    rays = spiral(_RAYS, np.sin(np.radians(_STEEP_DEG)))
    near = _TOUCHES * float(np.linalg.norm(np.ptp(scene.bounds, axis=0)))
    found = caster.cast(np.repeat(some, _RAYS, axis=0), np.tile(rays, (len(some), 1)), t_min=near)
    above = found.distance.reshape(-1, _RAYS) * rays[:, 2]
    met = np.isfinite(above)
    cut = None
    if (
        met.mean() >= _ROOFED
        and np.median([_rough(a[m]) for a, m in zip(above, met, strict=True)]) <= _ROUGH
    ):
        heights = some[:, 2, None] + above
        cut = float(places[:, 2].max() + np.median(heights[met])) / 2
    return (float(floor.min()) if np.isfinite(floor).all() else None), cut


def _rough(heights: Floats) -> float:
    """Spread of the middle half of heights (n,), in their median; of none it is 0."""
    if not len(heights):
        return 0.0
    low, middle, high = np.percentile(heights, [25, 50, 75])
    return float((high - low) / middle)


@dataclass(frozen=True, eq=False)
class ShownPart:
    """A part of a scene."""

    scene: Scene
    parents: Ints  # (f,) the whole scene's triangle of each triangle
    shares: Floats  # (f,) its share of that triangle's area

    @classmethod
    def whole(cls, scene: Scene) -> ShownPart:
        """All of a scene."""
        return cls(scene, np.arange(len(scene.faces)), np.ones(len(scene.faces)))

    def cut(self, box: Floats) -> ShownPart:
        """Cut a box (2, 3) out; all if there is nothing in it.

        Objects narrower than the box are included if their middle is inside; wider ones, such as
        the ground, are cut at its sides. All are cut at its top, because towers would hide the
        trajectory. Objects keep their numbers, also if nothing of them is left.
        """
        scene = self.scene
        boxes = scene.object_bounds[:, :, :2]
        middle = boxes.mean(axis=1)
        narrow = ((boxes[:, 1] - boxes[:, 0]) <= (box[1] - box[0])[:2]).all(axis=1)
        inside = ((middle >= box[0, :2]) & (middle <= box[1, :2])).all(axis=1)
        whole = np.flatnonzero((narrow & inside)[scene.face_object])
        vertices = scene.vertices
        own = np.flatnonzero(~narrow[scene.face_object])
        faces = scene.faces[own].astype(np.int64)
        for axis in (0, 1):
            for sign, limit in ((1.0, box[1, axis]), (-1.0, box[0, axis])):
                vertices, faces, own = _clipped(vertices, faces, own, axis, sign, limit)
        faces = np.concatenate([scene.faces[whole], faces])
        own = np.append(whole, own)
        vertices, faces, own = _clipped(vertices, faces, own, 2, 1.0, box[1, 2])
        if not len(faces):
            return self
        owners = scene.face_object[own]
        colours = scene.colours and scene.colours.take(own)
        part = Scene(
            vertices, faces.astype(np.int32), owners, scene.names, scene.origin, colours=colours
        )
        was = triangle_areas(scene.vertices[scene.faces[own]])
        areas = triangle_areas(vertices[faces])
        shares = np.divide(areas, was, out=np.ones(len(was)), where=was > 0)
        return ShownPart(part, self.parents[own], self.shares[own] * shares)


def _clipped(
    vertices: Floats, faces: Ints, parents: Ints, axis: int, sign: float, limit: float
) -> tuple[Floats, Ints, Ints]:
    """Keep what of triangles lies where ``sign * (coordinate - limit) <= 0``.

    A triangle with one corner there becomes a smaller one, one with two becomes two.
    """
    beyond = sign * (vertices[:, axis] - limit)
    out = beyond[faces] > 0  # (f, 3)
    count = out.sum(axis=1)
    kept = [faces[count == 0]]
    origins = [parents[count == 0]]
    for number in (1, 2):  # corners that are beyond
        rows = np.flatnonzero(count == number)
        # The corner that is alone comes first.
        first = np.argmax(out[rows] == (number == 1), axis=1)
        a, b, c = (faces[rows, (first + k) % 3] for k in range(3))
        ends = []
        for other in (b, c):
            share = beyond[a] / (beyond[a] - beyond[other])
            ends.append(len(vertices) + np.arange(len(rows)))
            new = vertices[a] + share[:, None] * (vertices[other] - vertices[a])
            vertices = np.concatenate([vertices, new])
            beyond = np.append(beyond, np.zeros(len(rows)))
        ab, ac = ends
        pieces = [(a, ab, ac)] if number == 2 else [(ab, b, c), (ab, c, ac)]
        kept += [np.stack(piece, axis=1) for piece in pieces]
        origins += [parents[rows]] * len(pieces)
    return vertices, np.concatenate(kept), np.concatenate(origins)

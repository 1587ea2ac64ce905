"""Scenes as pictures and plans need them: all triangles, instances simplified if they are many."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..base.arrays import AnyArray, Floats, Indices, Ints, Ints32
from .colours import Colours, joined
from .scene import Scene
from .scene_instances import Instances, MeshPart
from .scene_mesh import stacked, triangle_areas

DRAWN_TRIANGLES = 2_000_000  # of instances; of more, each gets its share of fewer
PART_LEAST = 32  # triangles of a simplified part
# of a part with a mask, and of a triangle's edge
CUT_TRIANGLES = 50_000
CUT_STEPS = 128
_PLACES = 200  # to which distances are measured


@dataclass(frozen=True, eq=False)
class Drawn:
    """A scene without instances, and which counter of hits its triangles have.

    `scene` is the `same` if that has no instances. `counter` is intp (f,), see `Scene.counters`.
    """

    scene: Scene
    counter: Indices
    same: bool = False

    @classmethod
    def of(cls, scene: Scene, most: int = DRAWN_TRIANGLES, near: Sequence[Floats] = ()) -> Drawn:
        """Copy all instances to their places, with at most about so many triangles.

        Those close to places `near`, (k, 3) each, local coordinates, have more of them.
        """
        faces = len(scene.faces)
        if (shared := scene.instances) is None:
            return cls(scene, np.arange(faces), same=True)
        shares = _shares(shared, most, near)
        meshes = [(scene.vertices, scene.faces)]
        owners = [scene.face_object]
        counters = [np.arange(faces)]
        colours = [scene.colours]
        mirrored = np.linalg.det(shared.transforms[:, :, :3]) < 0
        for number, share in sorted(set(zip(shared.part.tolist(), shares.tolist(), strict=True))):
            part = shared.parts[number]
            vertices = part.vertices
            own = part.faces
            kept = np.arange(len(part.faces))
            size = max(PART_LEAST, int(len(own) * share))
            if size < len(own):
                vertices, own, kept = _fewer(part, size)
            shown = part.colours and Colours.of_faces(part.colours.take(kept).means())
            for row in np.flatnonzero((shared.part == number) & (shares == share)):
                matrix = shared.transforms[row]
                corners = own[:, ::-1] if mirrored[row] else own
                meshes.append((vertices @ matrix[:, :3].T + matrix[:, 3], corners))
                owners.append(np.full(len(own), shared.owner[row]))
                counters.append(np.full(len(own), faces + row))
                colours.append(shown)
        vertices, triangles = stacked(meshes)
        owner = np.concatenate(owners).astype(np.int32)
        coloured = joined(colours, map(len, owners))
        drawn = Scene(
            vertices, triangles, owner, scene.names, scene.origin, scene.actors, colours=coloured
        )
        return cls(drawn, np.concatenate(counters))

    def hits(self, counts: AnyArray) -> AnyArray:
        """Hits of each triangle that is drawn, from counters; those of actors follow."""
        if self.same:
            return counts
        area = triangle_areas(self.scene.vertices[self.scene.faces]) + np.finfo(np.float64).tiny
        share = area / np.bincount(self.counter, area, len(counts))[self.counter]
        moving = sum(len(actor.mesh.faces) for actor in self.scene.actors)
        return np.append(counts[self.counter] * share, counts[len(counts) - moving :])


def cut(scene: Scene) -> Scene:
    """Return a scene for pictures: in place of triangles with masks small ones, where it is opaque.

    Its counters are the same.
    """
    shared = scene.instances
    masked = sum(part.mask is not None for part in shared.parts) if shared else 0
    if shared is None or not masked:
        return scene
    places = np.bincount(shared.part, minlength=len(shared.parts))
    parts = tuple(
        _cut(part, min(CUT_TRIANGLES, DRAWN_TRIANGLES / (masked * count)))
        for part, count in zip(shared.parts, places.tolist(), strict=True)
    )
    return replace(scene, instances=replace(shared, parts=parts))


def _cut(part: MeshPart, most: float) -> MeshPart:
    """Divide a part with a mask into about so many pieces, and keep those that are opaque.

    A piece is asked at a random place: the share that is kept is right, however fine the mask.
    """
    if part.mask is None or part.uv is None:
        return part
    steps = int(np.clip((most / len(part.faces)) ** 0.5, 1, CUT_STEPS))  # of an edge
    i, j = (n.ravel() for n in np.mgrid[:steps, :steps])
    # Those beyond the diagonal are turned by 180 degrees, into the gaps between the others.
    first = np.stack([[i, j], [i + 1, j], [i, j + 1]], axis=-1).transpose(1, 2, 0)
    pieces = np.where((i + j < steps)[:, None, None], first, steps - first)
    corners = np.concatenate([pieces, steps - pieces.sum(axis=2, keepdims=True)], axis=2) / steps
    places = np.random.default_rng(0).dirichlet(np.ones(3), (len(part.faces), len(pieces)))
    u, v = np.einsum("fpc,pck,fkx->xfp", places, corners, part.uv.astype(np.float64), optimize=True)
    height, width = part.mask.shape
    row = (v % 1 * height).astype(int)
    column = (u % 1 * width).astype(int)
    opaque = part.mask[np.minimum(row, height - 1), np.minimum(column, width - 1)]
    opaque[0, 0] |= not opaque.any()  # no part is empty
    face, piece = np.nonzero(opaque)
    vertices = (corners[piece] @ part.vertices[part.faces[face]]).reshape(-1, 3)
    colours = part.colours and part.colours.divided(face, corners[piece])
    return MeshPart(
        vertices, np.arange(len(vertices), dtype=np.int32).reshape(-1, 3), colours=colours
    )


def _shares(shared: Instances, most: int, near: Sequence[Floats]) -> Floats:
    """Share of its triangles that each instance has in a drawing, (n,).

    Half of all are shared evenly, the others by the square of the distance to the nearest place:
    then all have about one size in a picture taken from there.
    """
    even = min(1.0, most / shared.triangles)
    places = np.concatenate([np.empty((0, 3)), *near])
    if even == 1 or not len(places):
        return np.full(len(shared), even)
    middles = shared.bounds.mean(axis=1)
    distance = np.full(len(shared), np.inf)
    for place in places[:: len(places) // _PLACES + 1]:
        np.minimum(distance, np.linalg.norm(middles - place, axis=1), out=distance)
    distance += 1e-3
    full = distance.max()  # up to this distance they have all
    while True:
        # In steps of four: each step is another mesh.
        shares = np.maximum(4.0 ** np.floor(np.log2(np.minimum(full / distance, 1))), even / 2)
        if shares @ shared.sizes <= most:
            return shares
        full *= 0.9


def _fewer(part: MeshPart, most: int) -> tuple[Floats, Ints32, Indices]:
    """Vertices and at most so many faces that stand for a part, and which each was.

    Of many small pieces, as a tree's leaves are, merged vertices would leave little. There the
    largest triangles stay, as of trunk and boughs, and a choice of the others, made larger for all
    of them (Cook et al., 2007); long ones less, which would stick out.
    """
    pieces = len(np.unique(part.vertices, axis=0)) > len(part.faces)  # half as many in one surface
    vertices, faces, kept, _ = _merged(part.vertices, part.faces, most)
    if not pieces and len(kept) >= most // 4:
        return vertices, faces[kept], kept
    corners = part.vertices[part.faces]
    order = np.argsort(-triangle_areas(corners), kind="stable")
    large, small = np.split(order, [most // 4])
    some = np.random.default_rng(0).choice(small, most - len(large), replace=False)
    scale = np.ones(most)
    long = np.linalg.norm(corners[some] - np.roll(corners[some], 1, axis=1), axis=2).max(axis=1)
    scale[len(large) :] = (len(small) / len(some)) ** 0.5 * np.minimum(1, np.median(long) / long)
    kept = np.append(large, some)
    chosen = corners[kept]
    middle = chosen.mean(axis=1, keepdims=True)
    larger = middle + (chosen - middle) * np.maximum(1, scale)[:, None, None]
    return larger.reshape(-1, 3), np.arange(3 * most, dtype=np.int32).reshape(-1, 3), kept


def simplified(scene: Scene, most: int) -> tuple[Scene, Ints]:
    """Give a scene of fewer triangles; and for each triangle of this one which stands for it.

    That is -1 where nothing is left of a small object.
    """
    vertices, faces, kept, stands = _merged(scene.vertices, scene.faces, most)
    owners = scene.face_object[kept]
    colours = scene.colours and scene.colours.take(kept)
    made = Scene(vertices, faces[kept], owners, scene.names, scene.origin, colours=colours)
    return made, stands


def _merged(points: Floats, corners: Ints32, most: int) -> tuple[Floats, Ints32, Indices, Ints]:
    """Merge vertices in the same cell of a grid (Rossignac and Borrel, 1993).

    Returns vertices, faces (f, 3), those that are kept, at most so many, and what `simplified`
    does.
    """
    area = float(triangle_areas(points[corners]).sum())
    cell = (2 * area / most) ** 0.5
    low = points.min(axis=0)
    while True:
        at = np.floor((points - low) / cell).astype(np.int64)
        _, merged, counts = np.unique(_numbered(at), return_inverse=True, return_counts=True)
        faces = merged[corners].astype(np.int32)
        first, second, third = faces.T
        flat = (first == second) | (second == third) | (third == first)
        wide = np.flatnonzero(~flat)
        _, owner, same = np.unique(
            _numbered(np.sort(faces[wide], axis=1)), return_index=True, return_inverse=True
        )
        if len(owner) <= most:
            break
        cell *= 1.3
    vertices = np.stack([np.bincount(merged, axis) / counts for axis in points.T], axis=1)
    kept = wide[owner]
    stands = np.full(len(faces), -1, np.int64)
    stands[wide] = same
    near = np.full(len(vertices), -1, np.int64)  # a triangle at each vertex
    near[faces[kept].ravel()] = np.repeat(np.arange(len(kept)), 3)
    small = np.flatnonzero(flat)
    stands[small] = near[faces[small]].max(axis=1)
    return vertices, faces, kept, stands


def _numbered(rows: AnyArray) -> Ints:
    """Numbers (n,) of rows of natural numbers (n, 3), in their order: sorted fast, unlike rows."""
    number = np.zeros(len(rows), np.int64)
    for column in rows.T.astype(np.int64):
        small = [
            np.unique(one, return_inverse=True)[1] if one.max(initial=0) >= 1 << 31 else one
            for one in (number, column)
        ]
        number = small[0] * (int(small[1].max(initial=0)) + 1) + small[1]
    return number

"""The scene on a page, coloured by the rays that hit it."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from trimesh.exchange.gltf import export_glb

from ..base.open3d_module import load_open3d
from ..columns.table import OBJECT
from ..render.colouring import colours_of
from ..render.hits import hit_colours
from ..render.surface import apart
from ..render.theme import UNSEEN, mapped, rgb
from ..scene.scene import Scene
from .colouring import as_bytes, colour_bar, legend_of
from .page import LivePage

MOST_TRIANGLES = 100_000  # 60 bytes each, whenever their colours have changed
MOST_PIECES = 60_000  # that large ones are divided into, where hits are shown
TITLE = "hits per square metre; grey: none"
_INWARDS = 1e-4  # of the scene's diagonal
_MOST_INWARDS_OF = 200.0  # metres: some centimetres are enough for any scene
_GREYS = np.linspace(0.1, 1.0, 256)
SWAP_S = 1.5  # a browser needs a moment to load a mesh

# glTF's colours are linear in light, those on a screen are not (IEC 61966-2-1).
_SCREEN = np.arange(256) / 255
_LINEAR = as_bytes(
    np.where(_SCREEN <= 0.04045, _SCREEN / 12.92, ((_SCREEN + 0.055) / 1.055) ** 2.4)
)
_MATERIAL = {
    "doubleSided": True,
    "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 0.9},
}


class Surface:
    """A scene's triangles, or a simplified mesh of at most so many, in the chosen colours.

    Vertices in the same cell of a grid are merged (Rossignac and Borrel, 1993), and hits go to the
    nearest remaining triangle. `reflectance` is the share of the light that each object reflects,
    (objects,), if it is known.
    """

    def __init__(
        self,
        scene: Scene,
        reflectance: NDArray[np.float64] | None = None,
        most: int = MOST_TRIANGLES,
    ) -> None:
        self._scene, self._reflectance = scene, reflectance
        self.coarse, self._objects = scene, scene.face_object
        self._nearest: NDArray[np.int64] | None = None  # of each triangle of the scene
        if len(scene.faces) > most:
            self.coarse, self._nearest = _simplified(scene, most)
            self._objects = scene.face_object[_nearest(scene, self.coarse)]
        size = float(np.linalg.norm(np.ptp(scene.bounds, axis=0)))
        moved = apart(self.coarse, self._objects, _INWARDS * min(size, _MOST_INWARDS_OF))
        self.corners = moved.vertices[moved.faces].astype(np.float32)  # (f, 3, 3)

    def coloured(
        self, by: str, hit_counts: NDArray[Any], points: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.uint8], str]:
        """Triangles (k, 3, 3), colours (k, 3, 3) at their corners and a legend as HTML.

        `by` is one of `colours_for` the scene; "hits" needs the hits (f,) of its triangles, and
        some of the hit points, (n, 3).
        """
        legend = ""
        if by == "hits":
            return self._by_hits(hit_counts, points)
        if by == "object":
            colouring = colours_of(self._objects, OBJECT, self._scene.names)
            colours, legend = colouring.colours, legend_of(colouring)
        elif by == "reflectance" and self._reflectance is not None:
            share = self._reflectance[self._objects]
            colours = mapped("gray", 0.1 + 0.9 * share)
            legend = colour_bar("reflectance", ("0", "0.5", "1"), mapped("gray", _GREYS))
        else:
            colours = np.tile(rgb(UNSEEN), (len(self.corners), 1))
        return self.corners, as_bytes(colours).repeat(3, axis=0).reshape(-1, 3, 3), legend

    def _by_hits(
        self, hit_counts: NDArray[Any], points: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.uint8], str]:
        hits = hit_counts.astype(np.float64)
        if self._nearest is not None:
            hits = np.bincount(self._nearest, hits, len(self.corners)).astype(np.float64)
        most = len(self.corners) + MOST_PIECES
        shown = self.coarse, self.corners
        corners, _, colours, (low, high) = hit_colours(*shown, hits, points, most)
        middle = (low * high) ** 0.5
        marks = [f"{n:.2g}" if n < 10 else f"{n:,.0f}" for n in (low, middle, high)]
        return corners, as_bytes(colours), colour_bar(TITLE, marks) if hits.any() else ""


def colours_for(scene: Scene, reflectance: NDArray[np.float64] | None) -> tuple[str, ...]:
    """List the ways to colour a scene, with or without known reflectance."""
    more = ("reflectance",) if reflectance is not None and len(np.unique(reflectance)) > 1 else ()
    return ("grey", "hits", "object", *more)


def below(
    corners: NDArray[np.float32], height: float | None
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Corners (k, 3, 3) of those triangles that lie below a height, and which (f,) these are.

    Parts above it are pressed down to it, so that an upright wall looks cut.
    """
    if height is None:
        return corners, np.ones(len(corners), np.bool_)
    kept = np.asarray((corners[:, :, 2] <= height).any(axis=1))
    corners = corners[kept]
    np.minimum(corners[:, :, 2], height, out=corners[:, :, 2])
    return corners, kept


def _simplified(scene: Scene, most: int) -> tuple[Scene, NDArray[np.int64]]:
    """Give a scene of fewer triangles, and for each triangle of this one the nearest there."""
    open3d = load_open3d()
    mesh = open3d.geometry.TriangleMesh(
        open3d.utility.Vector3dVector(scene.vertices.copy()),
        open3d.utility.Vector3iVector(scene.faces.copy()),
    )
    cell = (2 * mesh.get_surface_area() / most) ** 0.5
    while len((small := mesh.simplify_vertex_clustering(cell)).triangles) > most:
        cell *= 1.5
    vertices, faces = np.asarray(small.vertices), np.asarray(small.triangles, np.int32)
    one = np.zeros(len(faces), np.int32)
    coarse = Scene(vertices, faces, one, ("all",), scene.origin)
    return coarse, _nearest(coarse, scene)


def _nearest(scene: Scene, others: Scene) -> NDArray[np.int64]:
    """Give the nearest triangle of a scene for each triangle of another."""
    closest = load_open3d().t.geometry.RaycastingScene()
    closest.add_triangles(scene.vertices.astype(np.float32), scene.faces.astype(np.uint32))
    middles = others.vertices[others.faces].mean(axis=1).astype(np.float32)
    found = closest.compute_closest_points(middles)["primitive_ids"].numpy()
    return np.asarray(found, np.int64)


class MeshNode:
    """Shows the latest of several meshes, without flicker.

    viser's page drops a mesh when it receives a new one, shows nothing until that is loaded, and
    does not say when it is. So the last one stays for a moment.
    """

    def __init__(self, page: LivePage, name: str) -> None:
        self._page, self._name, self._count = page, name, 0
        self._nodes: list[Any] = []  # the latest is the last
        self._alone_at = 0.0  # when to remove the last but one

    def show(self, corners: NDArray[np.float32], colours: NDArray[np.uint8]) -> None:
        """Show triangles (f, 3, 3) with colours (f, 3, 3) at their corners; or nothing."""
        self._keep(1 if len(corners) else 0)
        if not len(corners):
            return
        mesh = coloured_mesh(corners, colours)
        node = self._page.scene.add_glb(
            f"{self._name}/{self._count}", mesh, cast_shadow=False, receive_shadow=False
        )
        self._nodes.append(node)
        self._count += 1
        self._alone_at = time.monotonic() + SWAP_S

    def settle(self) -> None:
        """Remove the last but one if it is time."""
        if time.monotonic() >= self._alone_at:
            self._keep(1)

    def _keep(self, count: int) -> None:
        while len(self._nodes) > count:
            self._nodes.pop(0).remove()


def coloured_mesh(corners: NDArray[np.float32], colours: NDArray[np.uint8]) -> bytes:
    """Write triangles (f, 3, 3), with colours (f, 3, 3) of a screen at corners, as binary glTF."""
    flat = corners.reshape(-1, 3)
    mesh = trimesh.Trimesh(
        flat,
        np.arange(len(flat)).reshape(-1, 3),
        vertex_colors=_LINEAR[colours].reshape(-1, 3),
        process=False,
    )

    def add_material(tree: dict[str, Any]) -> None:
        tree["materials"] = [_MATERIAL]
        tree["meshes"][0]["primitives"][0]["material"] = 0

    return bytes(export_glb(trimesh.Scene(mesh), tree_postprocessor=add_material))

"""The scene on a page, coloured by the rays that hit it."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from trimesh.exchange.gltf import export_glb

from raybeam.open3d_module import load_open3d

from ..render.closeup import floor_and_roof
from ..render.colouring import TURBO
from ..render.intensity import density_colours, density_range, hit_density
from ..scene.scene import Scene
from .colouring import as_bytes, colour_bar
from .page import LivePage

MOST_TRIANGLES = 100_000  # 60 bytes each, whenever their colours have changed
TITLE = "hits per square metre; grey: none"
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
    """A scene's triangles, or fewer of nearly its shape, and the hits on them.

    Vertices in the same cell of a grid become one (Rossignac and Borrel, 1993), and hits go to
    the nearest triangle that is left.

    Parameters
    ----------
    scene
        The scene.
    most
        Triangles that there may be.
    """

    def __init__(self, scene: Scene, most: int = MOST_TRIANGLES) -> None:
        self._scene = self.coarse = scene
        self._nearest: NDArray[np.integer] | None = None  # of each triangle of the scene
        if len(scene.faces) > most:
            self.coarse, self._nearest = _simplified(scene, most)
        self.corners = self.coarse.vertices[self.coarse.faces].astype(np.float32)  # (f, 3, 3)

    def below(self, height: float | None) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Corners (k, 3, 3) of what lies below a height, and which triangles (f,) these are.

        What rises above it is pressed down to it: an upright wall looks as if it were cut.
        """
        if height is None:
            return self.corners, np.ones(len(self.corners), np.bool_)
        kept = np.asarray((self.corners[:, :, 2] <= height).any(axis=1))
        corners = self.corners[kept]
        np.minimum(corners[:, :, 2], height, out=corners[:, :, 2])
        return corners, kept

    def coloured(self, hit_counts: NDArray[Any]) -> tuple[NDArray[np.uint8], str]:
        """Colours (f, 3) by the hits of each triangle of the scene, and a legend."""
        hits = hit_counts.astype(np.float64)
        if self._nearest is not None:
            hits = np.bincount(self._nearest, hits, len(self.corners)).astype(np.float64)
        density = hit_density(self.coarse, hits)
        low, high = density_range(density)
        colours = density_colours(density, hits > 0, (low, high), TURBO)
        middle = (low * high) ** 0.5
        marks = [f"{n:.2g}" if n < 10 else f"{n:,.0f}" for n in (low, middle, high)]
        return as_bytes(colours), colour_bar(TITLE, marks) if density.any() else ""

    def around(self, sensors: NDArray[np.float64]) -> tuple[float | None, float | None]:
        """Heights of the floor under sensors at (p, 3) and of the roof over them, metres.

        None where there is none: where they see the sky, or stand over an abyss.
        """
        return floor_and_roof(self.coarse, sensors) if len(self.corners) else (None, None)


def _simplified(scene: Scene, most: int) -> tuple[Scene, NDArray[np.integer]]:
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
    closest = open3d.t.geometry.RaycastingScene()
    closest.add_triangles(open3d.t.geometry.TriangleMesh.from_legacy(small))
    middles = scene.vertices[scene.faces].mean(axis=1).astype(np.float32)
    nearest = closest.compute_closest_points(middles)["primitive_ids"].numpy().astype(np.int64)
    one = np.zeros(len(faces), np.int32)
    return Scene(vertices, faces, one, ("all",), scene.origin), nearest


class MeshNode:
    """Shows the latest of several meshes, without a moment in which there is none.

    viser's page drops a mesh when it is told of a new one, and has nothing to show until that
    one is loaded; it does not say when that is. So two nodes take turns.
    """

    def __init__(self, page: LivePage, name: str) -> None:
        self._page = page
        self._names = [f"{name}/one", f"{name}/other"]  # the latest is the first
        self._nodes: dict[str, Any] = {}
        self._alone_at = 0.0  # when the last but one may go

    def show(self, corners: NDArray[np.float32], colours: NDArray[np.uint8], visible: bool) -> None:
        """Show triangles (f, 3, 3), each of one colour, (f, 3); nothing if there are none."""
        if not len(corners):
            for name in tuple(self._nodes):
                self._nodes.pop(name).remove()
            return
        self._names.reverse()
        latest = self._names[0]
        self._nodes[latest] = self._page.scene.add_glb(
            latest,
            coloured_mesh(corners, colours),
            cast_shadow=False,
            receive_shadow=False,
            visible=visible,
        )
        self._alone_at = time.monotonic() + SWAP_S

    def settle(self) -> None:
        """Remove the last but one if it is time."""
        if len(self._nodes) > 1 and time.monotonic() >= self._alone_at:
            self._nodes.pop(self._names[1]).remove()

    def set_visible(self, visible: bool) -> None:
        """Show it, or not."""
        for node in self._nodes.values():
            node.visible = visible


def coloured_mesh(corners: NDArray[np.float32], colours: NDArray[np.uint8]) -> bytes:
    """Write triangles (f, 3, 3), each of one colour, (f, 3) as on a screen, as binary glTF."""
    flat = corners.reshape(-1, 3)
    mesh = trimesh.Trimesh(
        flat,
        np.arange(len(flat)).reshape(-1, 3),
        vertex_colors=np.repeat(_LINEAR[colours], 3, axis=0),
        process=False,
    )

    def add_material(tree: dict[str, Any]) -> None:
        tree["materials"] = [_MATERIAL]
        tree["meshes"][0]["primitives"][0]["material"] = 0

    return bytes(export_glb(trimesh.Scene(mesh), tree_postprocessor=add_material))

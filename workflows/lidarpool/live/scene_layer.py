"""The scene on a page, coloured by the rays that hit it."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..render.intensity import checked_counts, hit_density
from ..render.intensity_picture import density_range
from ..scene.scene import Scene
from .colouring import TURBO, ColourBar
from .height_cut import HeightCut, triangles_below
from .inside import InsideView, Walls
from .mesh_node import MeshNode, coloured_triangles
from .page import LivePage

TITLE = "hits per square metre; grey: none"
MOST_TRIANGLES = 100_000  # 48 bytes each, whenever their colours have changed
_UNSEEN = np.array([186, 190, 196], np.float64)

Corners = NDArray[np.float32]
Ints = NDArray[np.int64]
Floats = NDArray[np.float64]


class SceneLayer:
    """The scene's surface, a colour bar, and switches for it and for its near walls.

    Parameters
    ----------
    page
        Where it is shown.
    scene
        The scene.
    poses
        (p, 3) where the sensors stand, metres, local.
    cut
        Above which nothing is shown; if the sensors are under a roof, it is set below that.
    on_change
        Called when something else is to be shown; `draw` shows it.
    """

    def __init__(
        self,
        page: LivePage,
        scene: Scene,
        poses: NDArray[np.float64],
        cut: HeightCut,
        on_change: Callable[[Any], None],
    ) -> None:
        self._scene, self._poses, self._cut = scene, poses, cut
        page.light_evenly()
        self._node = MeshNode(page, "/scene")
        self._shape: tuple[Hashable, Corners, Ints, int] | None = None
        with page.gui.add_folder("scene"):
            self._shown = page.gui.add_checkbox("show", initial_value=True)
            self._near = page.gui.add_checkbox(
                "near walls",
                initial_value=False,
                visible=False,
                hint="Walls and roofs between you and the sensors.",
            )
            self._legend = page.gui.add_html("")
        self._near.on_update(on_change)

        @self._shown.on_update
        def _show(_: Any) -> None:
            self._node.visible = self._legend.visible = self._shown.value

        # Of millions of triangles it takes seconds, which the rest of the page need not wait for.
        executor = ThreadPoolExecutor(1, thread_name_prefix="lidarpool-live")
        self._prepared: Future[tuple[DisplaySurface, InsideView, Walls | None]] = executor.submit(
            self._prepare
        )
        self._prepared.add_done_callback(on_change)
        executor.shutdown(wait=False)

    @property
    def state(self) -> Hashable:
        """What `draw` depends on, beside the hits."""
        return self._prepared.done(), self._cut.height, self._near.value

    def draw(self, hit_counts: NDArray[Any]) -> None:
        """Show the hits (f,) of each triangle so far, as soon as there is something to show.

        Raises
        ------
        Exception
            If the scene could not be made ready.
        """
        if not self._prepared.done():
            return
        surface = self._prepared.result()[0]
        density, hit = surface.density(hit_counts)
        limits = density_range(density)
        key, corners, source, two_sided = self._shape_now()
        if len(corners):
            colours = intensity_colours(density, hit, limits)[source]
            self._node.show(coloured_triangles(corners, colours, two_sided), key)
        else:
            self._node.clear()
        if density.any():
            self._legend.content = ColourBar(TITLE, *limits, logarithmic=True).html

    def settle(self) -> bool:
        """Clear up after `draw`; returns whether there is more to be cleared up later."""
        return self._node.settle()

    def facing(self, positions: Corners) -> Corners | None:
        """Which way walls face that are shown from one side, at positions (n, 3).

        See `Walls.facing_at`; None where all is shown from both sides.
        """
        if not self._prepared.done() or self._near.value:
            return None
        walls = self._prepared.result()[2]
        return None if walls is None else walls.facing_at(positions)

    def _prepare(self) -> tuple[DisplaySurface, InsideView, Walls | None]:
        surface = DisplaySurface(self._scene)
        inside = InsideView.of(surface.coarse, self._poses)
        if inside.ceiling is not None:
            self._cut.propose(inside.ceiling)
        self._near.visible = bool(inside.shell.any())
        walls = Walls.of(inside.wound(surface.corners)[inside.shell])
        return surface, inside, walls

    def _shape_now(self) -> tuple[Hashable, Corners, Ints, int]:
        """Triangles to show.

        Returns
        -------
        key
            What they depend on.
        corners
            (n, 3, 3).
        source
            (n,): which triangle of the surface each is of.
        two_sided
            How many of them, from the first, are seen from both sides.
        """
        height = self._cut.height
        key = height, self._near.value
        if self._shape is not None and self._shape[0] == key:
            return self._shape
        surface, inside, _ = self._prepared.result()
        corners, source = inside.wound(surface.corners), np.arange(len(surface.corners))
        if height is not None:
            corners, source = triangles_below(corners, height)
        one_sided = inside.shell[source] & (not self._near.value)
        order = np.argsort(one_sided, kind="stable")
        two_sided = int((~one_sided).sum())
        self._shape = key, corners[order], source[order], two_sided
        return self._shape


def intensity_colours(
    density: NDArray[np.float64], hit: NDArray[np.bool_], limits: tuple[float, float]
) -> NDArray[np.uint8]:
    """Colours (f, 3) on a logarithmic scale, as in intensity.png.

    What was hit by none is grey; where hits were shared with the triangles around, they fade
    out to grey.
    """
    low, high = limits
    share = np.log(np.maximum(density, low) / low) / np.log(high / low)
    colours = TURBO[np.clip(share * 255, 0, 255).astype(np.uint8)]
    seen = np.where(hit, 1.0, np.clip(density / low / 0.6 - 0.3, 0, 1))[:, None]
    return np.round(_UNSEEN * (1 - seen) + colours * seen).astype(np.uint8)


class DisplaySurface:
    """A scene, or a coarser one of nearly its shape, and the hits on it.

    Vertices in the same cell of a grid become one (Rossignac and Borrel, 1993). Hits on a
    triangle go to its corners and from these to the coarse triangles around, by area.

    Parameters
    ----------
    scene
        The scene.
    most
        Triangles that there may be.
    """

    def __init__(self, scene: Scene, most: int = MOST_TRIANGLES) -> None:
        self._scene = scene
        # For each vertex of the scene that of the coarse one; None where they are the same.
        self._vertex: NDArray[np.int64] | None = None
        self.coarse = scene
        cell = _first_cell(scene, most)
        while len(self.coarse.faces) > most:
            self.coarse, self._vertex = _clustered(scene, cell)
            cell *= 1.5
        self.corners = self.coarse.vertices[self.coarse.faces].astype(np.float32)  # (f, 3, 3)

    def density(self, hit_counts: NDArray[Any]) -> tuple[Floats, NDArray[np.bool_]]:
        """Hits per square metre at each coarse triangle, and whether it was hit itself; both (f,).

        Parameters
        ----------
        hit_counts
            (f,) hits of each triangle of the scene.
        """
        hits = checked_counts(self._scene, hit_counts)
        if self._vertex is not None:
            hits = self._moved(hits)
        return hit_density(self.coarse, hits), hits > 0

    def _moved(self, hits: Floats) -> Floats:
        """Hits on the scene's triangles as hits on the coarse ones; the total stays the same."""
        assert self._vertex is not None
        count = len(self.coarse.vertices)
        at = np.zeros(count)
        for corner in self._scene.faces.T:
            at += np.bincount(self._vertex[corner], weights=hits / 3, minlength=count)
        area = _areas(self.coarse)
        room = np.zeros(count)
        for corner in self.coarse.faces.T:
            room += np.bincount(corner, weights=area, minlength=count)
        dense = np.divide(at, room, out=np.zeros(count), where=room > 0)
        return np.asarray(area * dense[self.coarse.faces].sum(axis=1))


def _areas(scene: Scene) -> Floats:
    a, b, c = (scene.vertices[scene.faces[:, k]] for k in range(3))
    return np.asarray(np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2)


def _first_cell(scene: Scene, most: int) -> float:
    """Size of cells, in metres, that a surface of this area fills about `most` / 2 of."""
    return float(np.sqrt(2 * _areas(scene).sum() / most)) or 1.0


def _clustered(scene: Scene, cell: float) -> tuple[Scene, NDArray[np.int64]]:
    """Give the coarse scene, and for each vertex the coarse one that it went into."""
    low = scene.vertices.min(axis=0)
    places = np.floor((scene.vertices - low) / cell).astype(np.int64)
    across = places.max(axis=0) + 1
    keys = (places[:, 0] * across[1] + places[:, 1]) * across[2] + places[:, 2]
    _, vertex = np.unique(keys, return_inverse=True)
    count = int(vertex.max()) + 1
    size = np.bincount(vertex, minlength=count)
    middles = np.stack([np.bincount(vertex, v, count) / size for v in scene.vertices.T], axis=1)
    faces = vertex[scene.faces]
    a, b, c = faces.T
    kept = np.flatnonzero((a != b) & (b != c) & (c != a))
    if not len(kept):  # all within one cell: something must be shown
        kept = np.zeros(1, np.int64)
    _, first = np.unique(np.sort(faces[kept], axis=1), axis=0, return_index=True)
    kept = kept[np.sort(first)]
    coarse = Scene(
        middles,
        faces[kept].astype(np.int32),
        scene.face_object[kept],
        scene.names,
        scene.origin,
    )
    return coarse, vertex

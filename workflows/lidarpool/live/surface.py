"""The scene on a page, coloured by the rays that hit it."""

from __future__ import annotations

import numpy as np

from ..base.arrays import AnyArray, Floats, Floats32, Ints
from ..columns.table import OBJECT
from ..render.colouring import colours_of
from ..render.hits import HITS_TITLE, hit_colours
from ..render.surface import apart
from ..render.theme import mapped
from ..scene.drawn import simplified
from ..scene.scene import Scene
from .legend import Legend, as_bytes, legend_of, scale_legend

MOST_TRIANGLES = 300_000  # 50 bytes each, whenever their colours have changed
MOST_PIECES = 60_000  # that large ones are divided into, where hits are shown
_INWARDS = 1e-4  # of the scene's diagonal
_MOST_INWARDS_OF = 200.0  # metres: some centimetres are enough for any scene


class Surface:
    """A scene's triangles, or a simplified mesh of at most so many, in the chosen colours.

    Vertices in the same cell of a grid are merged (Rossignac and Borrel, 1993), and hits of a
    triangle that vanishes go to one beside it. `reflectance` is the share of the light that each
    object reflects, (objects,), if it is known.
    """

    def __init__(
        self,
        scene: Scene,
        reflectance: Floats | None = None,
        most: int = MOST_TRIANGLES,
    ) -> None:
        self._scene, self._reflectance = scene, reflectance
        self.coarse = scene
        self._stands: Ints | None = None  # for each triangle of the scene
        if len(scene.faces) > most:
            self.coarse, self._stands = simplified(scene, most)
        self._objects = self.coarse.face_object
        size = float(np.linalg.norm(np.ptp(scene.bounds, axis=0)))
        moved = apart(self.coarse, self._objects, _INWARDS * min(size, _MOST_INWARDS_OF))
        self.corners = moved.vertices[moved.faces].astype(np.float32)  # (f, 3, 3)

    def coloured(
        self, by: str, hit_counts: AnyArray, points: Floats32
    ) -> tuple[dict[str, AnyArray], Legend | None]:
        """Corners (k, 3, 3), objects (k,), colours (k, 3, 3) at the corners; and their legend.

        `by` is one of `colours_for` the scene; "hits" needs the hits (f,) of its triangles, and
        some of the hit points, (n, 3). There are no colours for "grey": the page has its own.
        """
        if by == "hits":
            return self._by_hits(hit_counts, points)
        arrays: dict[str, AnyArray] = {"corners": self.corners, "objects": self._objects}
        legend = None
        if by == "object":
            colouring = colours_of(self._objects, OBJECT, self._scene.names)
            colours, legend = colouring.paint(self._objects), legend_of(colouring)
        elif by == "reflectance" and self._reflectance is not None:
            colours = mapped("gray", 0.1 + 0.9 * self._reflectance[self._objects])
            greys = mapped("gray", np.linspace(0.1, 1.0, 9))
            legend = scale_legend("reflectance", ("0", "0.5", "1"), greys)
        elif by == "colour" and self.coarse.colours is not None:
            colours = self.coarse.colours.means() / 255
        else:
            return arrays, None
        corners = as_bytes(colours).repeat(3, axis=0).reshape(-1, 3, 3)
        return arrays | {"colours": corners}, legend

    def _by_hits(
        self, hit_counts: AnyArray, points: Floats32
    ) -> tuple[dict[str, AnyArray], Legend | None]:
        hits = hit_counts.astype(np.float64)
        if self._stands is not None:
            left = self._stands >= 0
            hits = np.bincount(self._stands[left], hits[left], len(self.corners)).astype(np.float64)
        most = len(self.corners) + MOST_PIECES
        shown = self.coarse, self.corners
        corners, owner, colours, (low, high) = hit_colours(*shown, hits, points, most)
        middle = (low * high) ** 0.5
        marks = [f"{n:.2g}" if n < 10 else f"{n:,.0f}" for n in (low, middle, high)]
        arrays: dict[str, AnyArray] = {
            "corners": corners, "objects": self._objects[owner], "colours": as_bytes(colours),
        }  # fmt: skip
        return arrays, scale_legend(HITS_TITLE, marks) if hits.any() else None


def colours_for(scene: Scene, reflectance: Floats | None) -> tuple[str, ...]:
    """List the ways to colour a scene, with or without known reflectance, and its own colours."""
    own = ("colour",) if scene.coloured else ()
    more = ("reflectance",) if reflectance is not None and len(np.unique(reflectance)) > 1 else ()
    return ("grey", "hits", "object", *more, *own)

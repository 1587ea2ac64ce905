"""Triangles of a scene as the page draws them, and their colors."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lidarsim.base.arrays import AnyArray, Floats, Floats32, Ints, Ints32
from lidarsim.columns.table import OBJECT, TABLE
from lidarsim.scene.colors import as_bytes
from lidarsim.scene.scene import Scene
from lidarsim.scene.simplified import simplified

from ..render.coloring import (
    NORMALS,
    colors_of,
    colors_of_normals,
)
from ..render.hit_density import density_label, hit_colors, hits_title
from ..render.surface import separate_objects
from ..render.theme import mapped
from .legends import Legend, legend_of, scale_legend

# Surfaces are moved inwards by this share of the scene's diagonal, or of `_MAX_SIZE_M` if that is
# smaller: two centimeters.
_INWARD_SHARE = 1e-4
_MAX_SIZE_M = 200.0
HITS_SAMPLE = 500_000  # sample for the density of hits on large triangles

MAX_TRIANGLES = 300_000  # triangles sent to the page, 50 bytes each, at each change of colors

MAX_PIECES = 60_000  # further triangles from dividing large triangles, to show hits


class ShownSurface:
    """A scene's triangles in chosen colors, simplified to a maximum number.

    Vertices in the same cell of a grid are merged (Rossignac and Borrel, 1993), and hits of a
    triangle that vanishes go to a neighbor. `reflectance` is the share of the light that each
    object reflects, (objects,), if known; `face_materials` (f,) are indices into the names of
    materials, -1 for none.
    """

    def __init__(
        self,
        scene: Scene,
        reflectance: Floats | None = None,
        max_triangles: int = MAX_TRIANGLES,
        face_materials: Ints32 | None = None,
        material_names: Sequence[str] = (),
    ) -> None:
        self.coarse = scene
        self._reflectance = reflectance
        # (f,): shown triangle that replaces each triangle of the scene; -1 if none does.
        self._replacements = np.arange(len(scene.faces))
        if len(scene.faces) > max_triangles:
            self.coarse, self._replacements = simplified(scene, max_triangles)
        self._material_names = material_names
        self._materials: Ints | None = None  # (shown triangles,)
        if face_materials is not None:
            self._materials = np.full(len(self.coarse.faces), -1)
            is_shown = self._replacements >= 0
            self._materials[self._replacements[is_shown]] = face_materials[is_shown]
        self._objects = self.coarse.face_object.astype(np.int32)  # type that browsers have
        size = float(np.linalg.norm(np.ptp(scene.bounds, axis=0)))
        moved = separate_objects(self.coarse, self._objects, _INWARD_SHARE * min(size, _MAX_SIZE_M))
        self.corners = moved.vertices[moved.faces].astype(np.float32)  # (f, 3, 3)

    def colored(
        self, by: str, hit_counts: AnyArray, points: Floats32
    ) -> tuple[dict[str, AnyArray], Legend | None]:
        """Return corners (k, 3, 3), objects (k,), colors (k, 3, 3) at the corners, and a legend.

        Corners are local, meters; objects are indices of static objects.

        `by` is a name of `colors_for` the scene; "hits" needs the hits (f,) of its triangles, and
        a sample of the hit points, (n, 3). Colors of "gray" are left out: the page has them.
        """
        arrays: dict[str, AnyArray] = {"corners": self.corners, "objects": self._objects}
        legend: Legend | None = None
        if by == "hits":
            return self._colored_by_hits(hit_counts, points)
        if by == "object":
            coloring = colors_of(self._objects, OBJECT, self.coarse.names)
            colors = coloring.paint(self._objects)
            legend = legend_of(coloring)
        elif by == "reflectance" and self._reflectance is not None:
            colors = mapped("gray", 0.1 + 0.9 * self._reflectance[self._objects])
            grays = mapped("gray", np.linspace(0.1, 1.0, 9))
            legend = scale_legend("reflectance", ("0", "0.5", "1"), grays)
        elif by == "material" and self._materials is not None:
            coloring = colors_of(self._materials, TABLE["material"], self._material_names)
            colors = coloring.paint(self._materials)
            legend = legend_of(coloring)
        elif by == "normals":
            a, b, c = self.coarse.vertices[self.coarse.faces].swapaxes(0, 1)
            normals = np.cross(b - a, c - a)
            lengths = np.linalg.norm(normals, axis=1, keepdims=True)
            colors = colors_of_normals(normals / np.where(lengths > 0, lengths, np.nan)) / 255
            legend = scale_legend(NORMALS.meaning, (), np.empty((0, 3)))
        elif by == "color" and self.coarse.colors is not None:
            colors = self.coarse.colors.means() / 255
        else:
            return arrays, None
        corners = as_bytes(colors).repeat(3, axis=0).reshape(-1, 3, 3)
        return arrays | {"colors": corners}, legend

    def _colored_by_hits(
        self, hit_counts: AnyArray, points: Floats32
    ) -> tuple[dict[str, AnyArray], Legend | None]:
        """Return the arrays and the legend of `colored`, for hits per square meter.

        `hit_counts` (f,) are of the original scene's triangles; `points` (n, 3) are a sample of
        hits, local, meters. Large triangles are divided, so that pieces show where the hits are.
        """
        is_shown = self._replacements >= 0
        hits = np.bincount(self._replacements[is_shown], hit_counts[is_shown], len(self.corners))
        max_pieces = len(self.corners) + MAX_PIECES
        corners, owner, colors, limits = hit_colors(
            self.coarse, self.corners, hits.astype(float), points, max_pieces
        )
        arrays: dict[str, AnyArray] = {
            "corners": corners,
            "objects": self._objects[owner],
            "colors": as_bytes(colors),
        }
        lower, upper = limits
        marks = [density_label(n) for n in (lower, (lower * upper) ** 0.5, upper)]
        return arrays, scale_legend(hits_title(limits), marks) if hits.any() else None


def colors_for(
    scene: Scene, reflectance: Floats | None, face_materials: Ints32 | None = None
) -> tuple[str, ...]:
    """Return the names that `ShownSurface.colored` accepts for a scene.

    "reflectance" needs several values (objects,), "material" materials of faces, "color" a scene
    with colors.
    """
    scene_colors = ("color",) if scene.colored else ()
    reflectances = (
        ("reflectance",) if reflectance is not None and len(np.unique(reflectance)) > 1 else ()
    )
    materials = () if face_materials is None else ("material",)
    return ("gray", "hits", "object", "normals", *reflectances, *materials, *scene_colors)

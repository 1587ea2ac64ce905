"""Simplify and color the triangles of a scene for display on the page."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lidarsim.columns.table import OBJECT, TABLE
from lidarsim.numerics.arrays import AnyArray, Floats, Floats32, Ints, Ints32
from lidarsim.scene.colors import as_bytes
from lidarsim.scene.scene import Scene
from lidarsim.scene.simplified import simplify_scene

from ..render.coloring import NORMALS, make_coloring, normal_colors
from ..render.hit_density import density_label, hit_colors, hits_title
from ..render.surface import separate_objects
from ..render.theme import apply_colormap
from .legends import Legend, make_legend, scale_legend

# Surfaces are moved inward by this fraction of the scene's diagonal, but by at most 2 cm, which is
# the same fraction of `_MAX_SIZE_M`.
_INWARD_SHARE = 1e-4
_MAX_SIZE_M = 200.0
HITS_SAMPLE = 500_000  # number of points for estimating the hit density on large triangles

# The page receives all triangles, 50 bytes each, whenever the coloring changes.
MAX_TRIANGLES = 300_000

MAX_PIECES = 60_000  # maximum number of additional triangles from dividing large triangles


class DisplayMesh:
    """The triangles of a scene, simplified to a maximum number, in selectable colors.

    Vertices in the same grid cell are merged (Rossignac and Borrel, 1993). If this removes a
    triangle, its hits are counted for a neighboring triangle.

    Parameters
    ----------
    scene
        The scene.
    reflectance
        (objects,) fraction of light that each object reflects, or None if unknown.
    max_triangles
        Maximum number of triangles.
    face_materials
        (f,) indices into `material_names`, -1 for faces without a material.
    material_names
        Names of the materials.
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
        # (f,) displayed triangle that replaces each triangle of the scene, -1 if there is none
        self._replacements = np.arange(len(scene.faces))
        if len(scene.faces) > max_triangles:
            self.coarse, self._replacements = simplify_scene(scene, max_triangles)
        self._material_names = material_names
        self._materials: Ints | None = None  # (shown triangles,)
        if face_materials is not None:
            self._materials = np.full(len(self.coarse.faces), -1)
            is_shown = self._replacements >= 0
            self._materials[self._replacements[is_shown]] = face_materials[is_shown]
        self._objects = self.coarse.face_object.astype(np.int32)  # browsers lack int64 arrays
        size = float(np.linalg.norm(np.ptp(scene.bounds, axis=0)))
        moved = separate_objects(self.coarse, self._objects, _INWARD_SHARE * min(size, _MAX_SIZE_M))
        self.corners = moved.vertices[moved.faces].astype(np.float32)  # (f, 3, 3)

    def color_by(
        self, by: str, hit_counts: AnyArray, points: Floats32
    ) -> tuple[dict[str, AnyArray], Legend | None]:
        """Return the arrays for a coloring and its legend.

        Parameters
        ----------
        by
            One of the names that `available_colorings` returns for the scene.
        hit_counts
            (f,) hits on each triangle of the original scene. Used by "hits" only.
        points
            (n, 3) sample of the hit points, local, in meters. Used by "hits" only.

        Returns
        -------
        arrays
            Local corner positions "corners" (k, 3, 3) in meters, indices "objects" (k,) of the
            static objects, and "colors" (k, 3, 3) at the corners. The colors are omitted for
            "gray", which the page draws itself.
        legend
            The legend, or None.
        """
        arrays: dict[str, AnyArray] = {"corners": self.corners, "objects": self._objects}
        legend: Legend | None = None
        if by == "hits":
            return self._color_by_hits(hit_counts, points)
        if by == "object":
            coloring = make_coloring(self._objects, OBJECT, self.coarse.names)
            colors = coloring.paint(self._objects)
            legend = make_legend(coloring)
        elif by == "reflectance" and self._reflectance is not None:
            colors = apply_colormap("gray", 0.1 + 0.9 * self._reflectance[self._objects])
            grays = apply_colormap("gray", np.linspace(0.1, 1.0, 9))
            legend = scale_legend("reflectance", ("0", "0.5", "1"), grays)
        elif by == "material" and self._materials is not None:
            coloring = make_coloring(self._materials, TABLE["material"], self._material_names)
            colors = coloring.paint(self._materials)
            legend = make_legend(coloring)
        elif by == "normals":
            a, b, c = self.coarse.vertices[self.coarse.faces].swapaxes(0, 1)
            normals = np.cross(b - a, c - a)
            lengths = np.linalg.norm(normals, axis=1, keepdims=True)
            colors = normal_colors(normals / np.where(lengths > 0, lengths, np.nan)) / 255
            legend = scale_legend(NORMALS.meaning, (), np.empty((0, 3)))
        elif by == "color" and self.coarse.colors is not None:
            colors = self.coarse.colors.mean_colors() / 255
        else:
            return arrays, None
        corners = as_bytes(colors).repeat(3, axis=0).reshape(-1, 3, 3)
        return arrays | {"colors": corners}, legend

    def _color_by_hits(
        self, hit_counts: AnyArray, points: Floats32
    ) -> tuple[dict[str, AnyArray], Legend | None]:
        """Return the arrays and the legend of `color_by` for hits per square meter.

        Large triangles are divided, so that the colors show where the hits are. The parameters are
        the same as in `color_by`.
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


def available_colorings(
    scene: Scene, reflectance: Floats | None, face_materials: Ints32 | None = None
) -> tuple[str, ...]:
    """Return the names that `DisplayMesh.color_by` accepts for a scene.

    "reflectance" is available if the objects have different values, "material" if the faces have
    materials, and "color" if the scene has colors.
    """
    scene_colors = ("color",) if scene.all_colors else ()
    reflectances = (
        ("reflectance",) if reflectance is not None and len(np.unique(reflectance)) > 1 else ()
    )
    materials = () if face_materials is None else ("material",)
    return ("gray", "hits", "object", "normals", *reflectances, *materials, *scene_colors)

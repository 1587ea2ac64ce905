"""Arrays of a Newton model, and the selection of its bodies, shapes and sites by label."""

from __future__ import annotations

from collections.abc import Sequence
from fnmatch import fnmatchcase
from typing import Any, Literal, NamedTuple

import numpy as np

from ..errors import LidarError
from ..motion.rotations import matrices as rotations_of_quaternions
from ..numerics.arrays import AnyArray, Bools, Floats, Indices
from ..numerics.vectors import norm
from ..scene.transform import affine
from ..words import list_names, name_hint, plural
from .newton_shapes import INVISIBLE_TYPES, ShapeType

Geometry = Literal["visual", "collision"]

_FLAGS = {"visual": 1 << 0, "collision": 1 << 1}  # ShapeFlags.VISIBLE and COLLIDE_SHAPES
_SITE = 1 << 3  # ShapeFlags.SITE


class NewtonModel(NamedTuple):
    """Bodies and shapes of a `newton.Model`.

    World -1 is shared by all worlds, and body -1 is a world itself.
    """

    body_labels: Sequence[str]  # (bodies,)
    body_world: Indices  # (bodies,)
    shape_labels: Sequence[str]  # (shapes,)
    shape_world: Indices  # (shapes,)
    shape_body: Indices  # (shapes,)
    shape_type: Indices  # (shapes,)
    shape_flags: Indices  # (shapes,)
    shape_scale: Floats  # (shapes, 3)
    shape_color: Floats  # (shapes, 3): sRGB from 0 to 1
    shape_matrix: Floats  # (shapes, 4, 4): from the shape frames to the body frames
    shape_source: Sequence[Any]  # (shapes,): meshes and height fields

    @classmethod
    def from_model(cls, model: Any) -> NewtonModel:
        """Copy the arrays of a `newton.Model`."""
        return cls(
            model.body_label,
            _indices(model.body_world),
            model.shape_label,
            _indices(model.shape_world),
            _indices(model.shape_body),
            _indices(model.shape_type),
            _indices(model.shape_flags),
            as_numpy(model.shape_scale, 3),
            as_numpy(model.shape_color, 3),
            matrices_of(as_numpy(model.shape_transform, 7)),
            model.shape_source,
        )

    @property
    def has_worlds(self) -> bool:
        """Whether the model contains worlds that do not see each other."""
        return bool((self.shape_world >= 0).any() or (self.body_world >= 0).any())

    def visible_shapes(self, geometry: Geometry, exclude: Sequence[str | int]) -> Indices:
        """Return the indices of the shapes that are visible to a lidar.

        Parameters
        ----------
        geometry
            Whether the shapes that Newton displays are visible, or those that collide.
        exclude
            Labels of bodies and shapes, or indices of bodies, that are invisible.

        Raises
        ------
        LidarError
            If neither a body nor a shape has one of the labels.
        """
        visible = (self.shape_flags & _FLAGS[geometry]) != 0
        visible &= (self.shape_flags & _SITE) == 0
        visible &= ~np.isin(self.shape_type, INVISIBLE_TYPES)
        for name in exclude:
            bodies = _matching(name, self.body_labels)
            shapes = _matching(name, self.shape_labels) if isinstance(name, str) else []
            if not bodies and not shapes:
                labels = list(dict.fromkeys([*self.body_labels, *self.shape_labels]))
                raise LidarError(_unknown(name, "body or shape", labels))
            visible[shapes] = False
            visible &= ~np.isin(self.shape_body, bodies)
        return np.flatnonzero(visible)

    def find_bodies(self, names: Sequence[str | int]) -> list[int]:
        """Return the indices of the bodies with the given labels or indices.

        Raises
        ------
        LidarError
            If there is no body for one of the names.
        """
        found = []
        for name in names:
            bodies = _matching(name, self.body_labels)
            if not bodies:
                raise LidarError(_unknown(name, "body", list(dict.fromkeys(self.body_labels))))
            found += bodies
        return list(dict.fromkeys(found))

    def find_sites(self, names: Sequence[str | int]) -> list[int]:
        """Return the indices of the shapes that are sites with the given labels or indices.

        Raises
        ------
        LidarError
            If there is no site for one of the names.
        """
        is_site: Bools = (self.shape_flags & _SITE) != 0
        found = []
        for name in names:
            sites = [shape for shape in _matching(name, self.shape_labels) if is_site[shape]]
            if not sites:
                known = [self.shape_labels[shape] for shape in np.flatnonzero(is_site).tolist()]
                raise LidarError(_unknown(name, "site", list(dict.fromkeys(known))))
            found += sites
        return list(dict.fromkeys(found))

    def describe_invisible(self, model: Any) -> str:
        """Describe the parts of a model that have no surface for a lidar.

        The result is an empty string if there are none.
        """
        splats = [
            self.shape_labels[shape]
            for shape in np.flatnonzero(self.shape_type == ShapeType.GAUSSIAN).tolist()
        ]
        parts = [f"Gaussian splats ({list_names(splats)})"] if splats else []
        particles = int(getattr(model, "particle_count", 0))
        if particles:
            parts.append(f"{plural(particles, 'particle')}, which can be part of cloth")
        return " and ".join(parts)


def as_numpy(values: Any, columns: int = 1) -> AnyArray:
    """Copy a Warp array (n,) or (n, columns) to a NumPy array of type float64.

    None is converted to an empty array.
    """
    if values is None:
        return np.zeros((0, columns))
    array = values.numpy() if hasattr(values, "numpy") else values
    return np.asarray(array, np.float64).reshape(-1, columns)


def matrices_of(transforms: Floats) -> Floats:
    """Convert Newton transforms to matrices.

    The transforms (n, 7) are positions and quaternions (x, y, z, w), and the matrices have shape
    (n, 4, 4).
    """
    quaternions = transforms[:, 3:]
    lengths = norm(quaternions)[:, None]
    unit = np.divide(quaternions, lengths, out=np.full_like(quaternions, np.nan), where=lengths > 0)
    return affine(rotations_of_quaternions(unit), transforms[:, :3])


def _indices(values: Any) -> Indices:
    return as_numpy(values)[:, 0].astype(np.intp)


def _matching(name: str | int, labels: Sequence[str]) -> list[int]:
    """Return the indices of the labels that are equal to a name or match its wildcards.

    A number is the index of a label.
    """
    if not isinstance(name, str):
        return [int(name)] if 0 <= name < len(labels) else []
    return [
        index for index, label in enumerate(labels) if label == name or fnmatchcase(label, name)
    ]


def _unknown(name: str | int, kind: str, labels: list[str]) -> str:
    return f"The model has no {kind} {name!r}.{name_hint(str(name), labels)}"

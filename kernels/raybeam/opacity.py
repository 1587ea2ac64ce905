"""Masks that make parts of triangles transparent, for example for leaves, fences, and nets.

A ray hits a triangle only where the mask is true. All backends compute the position in the mask in
float64, with the operations of `MaskTables.is_opaque` in the same order.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from .arrays import Bools, Bytes, Floats, Floats32, Indices, Ints, Ints32

# Limit for texture coordinates, so that interpolated coordinates are finite.
_MAX_COORDINATE = 2.0**31


@dataclass(frozen=True, eq=False)
class Opacity:
    """Mask that defines which parts of a mesh's triangles are opaque.

    Attributes
    ----------
    mask
        bool (h, w): True where the surface is opaque.
    uv
        (f, 3, 2) real numbers within ±2**31: texture coordinates of the vertices of each triangle,
        stored in single precision. As in glTF, (0, 0) is the outer corner of the first element of
        the mask, u increases along the first row to (1, 0), v increases along the first column to
        (0, 1), and the mask repeats outside this range.
    """

    mask: ArrayLike
    uv: ArrayLike


@dataclass(frozen=True, eq=False)
class LocalOpacity:
    """A validated `Opacity` for the triangles of a `LocalMesh`.

    Attributes
    ----------
    mask
        uint8 (h, w): 1 where the surface is opaque.
    uv
        float32 (k, 6): u and v of the three vertices of each triangle.
    """

    mask: Bytes
    uv: Floats32


def check_opacity(opacity: Opacity, face_count: int, index: Ints32) -> LocalOpacity:
    """Validate an opacity, and keep only the triangles with the indices `index`.

    Raises ValueError if the opacity is invalid.
    """
    mask = np.asarray(opacity.mask)
    uv = np.asarray(opacity.uv)
    if mask.dtype != np.bool_ or mask.ndim != 2 or not mask.size:
        raise ValueError(
            "mask must be a non-empty bool array with shape (h, w), but has dtype "
            f"{mask.dtype} and shape {mask.shape}."
        )
    if uv.dtype.kind not in "fiu" or uv.shape != (face_count, 3, 2):
        raise ValueError(
            f"uv must be an array of real numbers with shape ({face_count}, 3, 2), that is, three "
            f"corners per face, but has dtype {uv.dtype} and shape {uv.shape}."
        )
    invalid = np.flatnonzero(~(np.abs(uv) < _MAX_COORDINATE).all(axis=(1, 2)))
    if len(invalid):
        raise ValueError(
            f"uv of face {invalid[0]} must be finite and below 2**31 in magnitude, but is "
            f"{uv[invalid[0]].tolist()}."
        )
    single = uv[index].astype(np.float32).reshape(-1, 6)
    # GPUs may treat subnormal numbers as zero, so all backends do.
    single[np.abs(single) < np.finfo(np.float32).tiny] = 0
    return LocalOpacity(np.ascontiguousarray(mask).view(np.uint8), single)


@dataclass(frozen=True, eq=False)
class MaskTables:
    """Tables that contain the opacities of several meshes.

    Attributes
    ----------
    uv
        float32 (q, 6): u and v of the triangles of all meshes with an opacity.
    mask
        uint8 (e,): the elements of all masks, row by row.
    records
        int64 (meshes, 4): for each mesh, the offset from the position of a triangle to its row of
        `uv`, the first element of the mask, and the height and width of the mask. The height is 0
        if the mesh is opaque.
    """

    uv: Floats32
    mask: Bytes
    records: Ints

    def is_opaque(
        self,
        mesh: Indices,
        position: Indices,
        a: Floats,
        b: Floats,
        c: Floats,
        det: Floats,
    ) -> Bools:
        """Return whether the surface is opaque at each hit.

        Parameters
        ----------
        mesh, position
            (m,): index of the mesh, and position of the triangle in the tables of all meshes.
        a, b, c, det
            (m,): areas and their sum, as computed by `triangle.intersect`.
        """
        shift, first, height, width = self.records[mesh].T
        opaque = height == 0
        (masked,) = np.nonzero(height)
        uv = self.uv[position[masked] + shift[masked]].astype(np.float64)
        p = a[masked] / det[masked]
        q = b[masked] / det[masked]
        r = c[masked] / det[masked]
        u = (p * uv[:, 0] + q * uv[:, 2]) + r * uv[:, 4]
        v = (p * uv[:, 1] + q * uv[:, 3]) + r * uv[:, 5]
        column = np.minimum(((u - np.floor(u)) * width[masked]).astype(np.int64), width[masked] - 1)
        row = np.minimum(((v - np.floor(v)) * height[masked]).astype(np.int64), height[masked] - 1)
        opaque[masked] = self.mask[first[masked] + row * width[masked] + column] != 0
        return opaque


def join_masks(opacities: list[LocalOpacity | None], orders: list[Ints32]) -> MaskTables | None:
    """Join the opacities of several meshes, or return None if all meshes are opaque.

    `orders` contains the order of the triangles of each mesh. A mask whose memory several meshes
    share is stored only once.
    """
    uv = [np.zeros((0, 6), np.float32)]
    mask = [np.zeros(0, np.uint8)]
    records = np.zeros((len(orders), 4), np.int64)
    first_elements: dict[
        tuple[int, tuple[int, ...]], int
    ] = {}  # {address and shape: first element}
    triangles = rows = elements = 0
    for record, opacity, order in zip(records, opacities, orders, strict=True):
        if opacity is not None:
            key = opacity.mask.ctypes.data, opacity.mask.shape
            if key not in first_elements:
                first_elements[key] = elements
                mask.append(opacity.mask.reshape(-1))
                elements += opacity.mask.size
            record[:] = rows - triangles, first_elements[key], *opacity.mask.shape
            uv.append(opacity.uv[order])
            rows += len(order)
        triangles += len(order)
    return MaskTables(np.concatenate(uv), np.concatenate(mask), records) if rows else None

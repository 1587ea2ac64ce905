"""Colors of triangles: images, plain colors, and colors of corners."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ..errors import LidarError
from ..numerics.arrays import Bools, Bytes, Floats, Floats32, Integers, Ints, Ints32, UInts32
from ..numerics.elementary import power
from ..numerics.vectors import matmul
from ..words import plural

# Faces without a color are gray, of half of the light, as the default reflectance is.
GRAY = np.full((1, 1, 3), 188, np.uint8)
WHITE = np.full((1, 1, 3), 255, np.uint8)
WEIGHTS = np.array([0.2126, 0.7152, 0.0722])  # luminance of linear light, ITU-R BT.709
BLOCK_FACES = 1 << 16
_FLAT = 1e-200  # m⁴: the square of the area of a triangle that no ray hits, twice

_byte = np.arange(256) / 255
# {sRGB byte: linear light}, IEC 61966-2-1
LINEAR = np.where(_byte <= 0.04045, _byte / 12.92, power((_byte + 0.055) / 1.055, 2.4))
_EDGES = (LINEAR[:-1] + LINEAR[1:]) / 2


def as_srgb(linear: ArrayLike) -> Bytes:
    """Return the nearest sRGB bytes of linear light, 0 to 1, of any shape."""
    return np.searchsorted(_EDGES, np.asarray(linear, np.float64)).astype(np.uint8)


def as_bytes(shares: ArrayLike) -> Bytes:
    """Return the bytes of sRGB values, 0 to 1, of any shape, and 0 for NaN."""
    finite_shares = np.nan_to_num(np.asarray(shares, np.float64))
    return np.rint(255 * np.clip(finite_shares, 0, 1)).astype(np.uint8)


@dataclass(frozen=True, eq=False)
class Colors:
    """Colors of the faces of a mesh, in sRGB, as in files.

    Attributes
    ----------
    images
        uint8 (h, w, 3) each. An image of a single element is a plain color.
    image
        int32 (f,): index of each face's image.
    uv
        float32 (f, 3, 2): texture coordinates of the corners (`Cutout`); None if there are only
        plain colors.
    corners
        uint8 (f, 3, 3): colors of the corners, factors of the colors of the images in linear
        light; None for white.
    """

    images: tuple[Bytes, ...]
    image: Ints32
    uv: Floats32 | None = None
    corners: Bytes | None = None

    def __len__(self) -> int:
        return len(self.image)

    @classmethod
    def plain(cls, color: Bytes, faces: int) -> Colors:
        """Return the same color (1, 1, 3) for all faces."""
        return cls((color,), np.zeros(faces, np.int32))

    @classmethod
    def of_corners(cls, corners: Bytes) -> Colors:
        """Return colors (f, 3, 3) of the corners of each face."""
        return cls((WHITE,), np.zeros(len(corners), np.int32), corners=corners)

    @classmethod
    def of_faces(cls, colors: Bytes) -> Colors:
        """Return a plain color for each face, from colors (f, 3)."""
        return cls.of_corners(colors[:, None].repeat(3, axis=1))

    def take(self, face_selection: Integers | slice) -> Colors:
        """Return the colors of selected faces."""
        uv = None if self.uv is None else self.uv[face_selection]
        corners = None if self.corners is None else self.corners[face_selection]
        return Colors(self.images, self.image[face_selection], uv, corners)

    def divided(self, face_indices: Integers, weights: Floats) -> Colors:
        """Return the colors of pieces of faces, by the indices of the faces (k,).

        `weights` (k, 3, 3) are the barycentric coordinates of the corners of each piece in its
        face.
        """
        faces = self.take(face_indices)
        uv = None if faces.uv is None else matmul(weights, faces.uv).astype(np.float32)
        corners = None if faces.corners is None else matmul(weights, faces.corners).astype(np.uint8)
        return replace(faces, uv=uv, corners=corners)

    def mirrored(self) -> Colors:
        """Return the colors with the corners of each face in reverse order."""
        uv = None if self.uv is None else self.uv[:, ::-1]
        corners = None if self.corners is None else self.corners[:, ::-1]
        return replace(self, uv=uv, corners=corners)

    def check(self, name: str, faces: int) -> None:
        """Check that the shapes fit a number of faces of an object.

        Raises LidarError if not.
        """
        shapes = [(self.image, (faces,)), (self.uv, (faces, 3, 2)), (self.corners, (faces, 3, 3))]
        valid = all(array is None or array.shape == shape for array, shape in shapes)
        for image in self.images:
            valid &= image.dtype == np.uint8 and image.shape[2:] == (3,)
            valid &= image.size == 3 or (image.size > 3 and self.uv is not None)
        valid &= self.uv is None or bool(np.isfinite(self.uv).all())
        if not valid or not are_indices(self.image, len(self.images)):
            raise LidarError(
                f"The colors of {name!r} do not match its {faces} faces. Expected uint8 images (h, "
                "w, 3), image (f,), finite uv (f, 3, 2) and corners (f, 3, 3)."
            )

    def means(self) -> Bytes:
        """Return the mean color of each face, in linear light, (f, 3).

        The mean is taken over 4 points of the face, or of 100 if there are few faces.
        """
        mean_colors = np.empty((len(self), 3), np.uint8)
        steps = 10 if len(self) <= MAX_DENSE_FACES else 2
        # Centers of the pieces into which lines parallel to the edges cut a face.
        i, j = (n.ravel() for n in np.mgrid[:steps, :steps])
        upright = np.stack([i, j], axis=1)[i + j < steps] + 1 / 3
        inverted = np.stack([i, j], axis=1)[i + j < steps - 1] + 2 / 3
        points = np.concatenate([upright, inverted]) / steps
        for start in range(0, len(self), BLOCK_FACES):
            block = self.take(slice(start, start + BLOCK_FACES))
            lookup = Lookup(block, [_UNIT.repeat(len(block), axis=0)])
            rows = np.arange(len(block))
            light = np.zeros((len(block), 3))
            for u, v in points.tolist():
                colors = lookup.colors_at(rows, np.tile([u, v, 0.0], (len(block), 1)))
                light += LINEAR[unpacked(colors)]
            mean_colors[start : start + BLOCK_FACES] = as_srgb(light / len(points))
        return mean_colors


MAX_DENSE_FACES = 20_000  # limit for meshes whose colors are averaged from 100 points a face
_UNIT = np.array([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]])


def are_indices(indices: Ints32, count: int) -> bool:
    """Return True if all numbers, of any shape, are indices from 0 up and below `count`."""
    return not indices.size or bool(0 <= indices.min() <= indices.max() < count)


class Lookup:
    """Lookup of colors by the index of a face and a point on the face, in a table of all texels.

    Parameters
    ----------
    colors
        Colors of f faces.
    corners
        (k, 3, 3) each: corners of the faces, block by block.
    """

    def __init__(self, colors: Colors, corners: Iterable[Floats]) -> None:
        images = colors.images
        tints = colors.corners
        self._image = colors.image
        self._texels = np.concatenate([packed(image.reshape(-1, 3)) for image in images])
        sizes = np.array([image.shape[:2] for image in images], np.int64)
        self._height, self._width = sizes.T
        counts = sizes.prod(axis=1)
        self._first = np.cumsum([0, *counts[:-1]])
        # Texture coordinates of faces with images, and colors of corners, are stored as planes:
        # linear functions of the position.
        textured = (counts > 1)[self._image]
        tinted = np.zeros(0, np.bool_) if tints is None else (tints != 255).any(axis=(1, 2))
        textures = [np.zeros((0, 8))]
        lights = [np.zeros((0, 12))]
        start = 0
        for block in corners:
            rows = slice(start, start + len(block))
            if colors.uv is not None:
                uv = colors.uv[rows][textured[rows]]
                textures.append(_planes(block[textured[rows]], uv.astype(np.float64)))
            if tints is not None:
                light = LINEAR[tints[rows][tinted[rows]]]
                lights.append(_planes(block[tinted[rows]], light))
            start += len(block)
        self._texture = _Planes.joined(textured, textures)
        self._light = _Planes.joined(tinted, lights)

    def colors_at(self, face_indices: Integers, points: Floats) -> UInts32:
        """Return the packed colors (n,) of points (n, 3) on faces (n,), the texel of an image."""
        image = self._image.take(face_indices)
        texel = self._first.take(image)
        positions = np.ascontiguousarray(points.T)
        if self._texture is not None:
            selected, (u, v) = self._texture.values_at(face_indices, positions)
            image = image[selected]
            width = self._width.take(image)
            row = _element(v, self._height.take(image))
            texel[selected] += row * width + _element(u, width)
        colors = self._texels.take(texel)
        if self._light is not None:
            selected, light = self._light.values_at(face_indices, positions)
            tinted = LINEAR[unpacked(colors[selected])] * np.clip(light.T, 0, 1)
            colors[selected] = packed(as_srgb(tinted))
        return colors


class _Planes(NamedTuple):
    """Values on faces that are linear in the position."""

    slope_rows: Ints32  # (f,): row of `slopes` of each face; -1 for faces without values
    slopes: Floats  # (k, 4 w): for each of w values, slopes along x, y and z, and value at zero
    everywhere: bool  # all faces have values

    @classmethod
    def joined(cls, has_values: Bools, blocks: list[Floats]) -> _Planes | None:
        """Join blocks of slopes (k, 4 w) of the faces that have values, None without any."""
        if not has_values.any():
            return None
        slope_rows = np.where(has_values, np.cumsum(has_values) - 1, -1).astype(np.int32)
        return cls(slope_rows, np.concatenate(blocks), bool(has_values.all()))

    def values_at(self, face_indices: Integers, points: Floats) -> tuple[Any, Floats]:
        """Return the selection of the faces (n,) with values, and the values at points (3, n).

        The selection is a slice of all, or indices (m,); the values are (w, m).
        """
        selected: Any = slice(None)
        slope_rows = self.slope_rows.take(face_indices)
        if not self.everywhere:
            selected = np.flatnonzero(slope_rows >= 0)
            slope_rows = slope_rows[selected]
            points = points[:, selected]
        x, y, z = points
        values = np.empty((self.slopes.shape[1] // 4, len(x)))
        slopes = self.slopes.take(slope_rows, axis=0).T.reshape(len(values), 4, len(x))
        for row, (a, b, c, d) in zip(values, slopes, strict=True):
            np.multiply(a, x, out=row)
            row += b * y
            row += c * z
            row += d
        return selected, values


def _planes(corners: Floats, values: Floats) -> Floats:
    """Return the slopes (k, 4 w) of `_Planes` for values (k, 3, w) at corners (k, 3, 3).

    Flat triangles, which are not hit, have the value of their first corner.
    """
    a, b, c = corners.transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)
    area = (normal * normal).sum(axis=1, keepdims=True)
    scale = np.divide(1, area, out=np.zeros_like(area), where=area > _FLAT)
    along_b = np.cross(c - a, normal) * scale
    along_c = np.cross(normal, b - a) * scale
    planes = np.empty((len(corners), values.shape[2], 4))
    for column, (first, second, third) in enumerate(values.transpose(2, 1, 0)):
        slope = (second - first)[:, None] * along_b + (third - first)[:, None] * along_c
        planes[:, column, :3] = slope
        planes[:, column, 3] = first - (slope * a).sum(axis=1)
    return planes.reshape(len(corners), 4 * values.shape[2])


def _element(coordinate: Floats, size: Ints) -> Ints:
    """Return the row or column (n,) of a repeating image that contains a texture coordinate."""
    position = coordinate - np.floor(coordinate)
    position *= size
    return np.minimum(position.astype(np.int64), size - 1)


def packed(colors: Bytes) -> UInts32:
    """Return colors (n, 3) packed into a number each (n,), red in the lowest byte."""
    channels = np.zeros((len(colors), 4), np.uint8)
    channels[:, :3] = colors
    return channels.view("<u4")[:, 0]


def unpacked(colors: UInts32) -> Bytes:
    """Return the colors (n, 3) of packed colors (n,)."""
    return np.ascontiguousarray(colors, "<u4").view(np.uint8).reshape(-1, 4)[:, :3]


def as_float(red: Bytes, green: Bytes, blue: Bytes) -> Floats32:
    """Return colors (n,) as in the field `rgb` of PCL and ROS: bits 0x00RRGGBB as a float."""
    return packed(np.column_stack([blue, green, red])).view("<f4")


def luminance(colors: UInts32) -> Floats:
    """Return the luminance (n,) of packed colors in linear light, 0 to 1."""
    red, green, blue = map(np.take, _SHARES, unpacked(colors).T)
    return np.asarray(red + green + blue)


_SHARES = WEIGHTS[:, None] * LINEAR


def join_colors(mesh_colors: Sequence[Colors | None], sizes: Iterable[int]) -> Colors | None:
    """Join the colors of meshes in order, or return None if no mesh has colors.

    `sizes` are the numbers of faces of the meshes; a mesh without colors becomes gray.
    """
    if not any(part is not None for part in mesh_colors):
        return None
    colored = [
        Colors.plain(GRAY, size) if part is None else part
        for part, size in zip(mesh_colors, sizes, strict=True)
    ]
    image_numbers: dict[int, int] = {}  # {id of an image: its number}
    images: list[Bytes] = []
    image_indices = []  # (f,) of each mesh
    for part in colored:
        for pixels in part.images:
            if id(pixels) not in image_numbers:
                image_numbers[id(pixels)] = len(images)
                images.append(pixels)
        part_numbers = [image_numbers[id(pixels)] for pixels in part.images]
        image_indices.append(np.array(part_numbers, np.int32)[part.image])
    uv = None
    corners = None
    if any(part.uv is not None for part in colored):
        uv = np.concatenate(
            [np.zeros((len(p), 3, 2), np.float32) if p.uv is None else p.uv for p in colored]
        )
    if any(part.corners is not None for part in colored):
        corners = np.concatenate(
            [
                np.full((len(p), 3, 3), 255, np.uint8) if p.corners is None else p.corners
                for p in colored
            ]
        )
    return Colors(tuple(images), np.concatenate(image_indices), uv, corners)


def colors_summary(mesh_colors: Iterable[Colors | None]) -> str:
    """Return a summary of colors: «2 textures, 1 plain color, colors of vertices»."""
    colored = [part for part in mesh_colors if part is not None]
    kinds = {
        id(part.images[number]): "texture" if part.images[number].size > 3 else "plain color"
        for part in colored
        for number in np.unique(part.image)
        if part.images[number] is not WHITE
    }
    counts = Counter(kinds.values())
    words = [plural(counts[kind], kind) for kind in ("texture", "plain color") if counts[kind]]
    words += ["vertex colors"] * any(part.corners is not None for part in colored)
    return ", ".join(words) or "no colors"

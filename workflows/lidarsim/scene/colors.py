"""Triangle colors from images, plain colors and vertex colors."""

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

# Faces without a color have a linear gray value of 0.5, which is also the default reflectance.
GRAY = np.full((1, 1, 3), 188, np.uint8)
WHITE = np.full((1, 1, 3), 255, np.uint8)
WEIGHTS = np.array([0.2126, 0.7152, 0.0722])  # luminance of linear light, ITU-R BT.709
BLOCK_FACES = 1 << 16
_FLAT = 1e-200  # m⁴, square of twice the area up to which a triangle counts as degenerate

_byte = np.arange(256) / 255
# {sRGB byte: linear light}, IEC 61966-2-1
LINEAR = np.where(_byte <= 0.04045, _byte / 12.92, power((_byte + 0.055) / 1.055, 2.4))
_EDGES = (LINEAR[:-1] + LINEAR[1:]) / 2


def as_srgb(linear: ArrayLike) -> Bytes:
    """Convert linear light values between 0 and 1 to the nearest sRGB bytes."""
    return np.searchsorted(_EDGES, np.asarray(linear, np.float64)).astype(np.uint8)


def as_bytes(shares: ArrayLike) -> Bytes:
    """Convert sRGB values between 0 and 1 to bytes.

    NaN becomes 0.
    """
    finite_fractions = np.nan_to_num(np.asarray(shares, np.float64))
    return np.rint(255 * np.clip(finite_fractions, 0, 1)).astype(np.uint8)


@dataclass(frozen=True, eq=False)
class Colors:
    """The sRGB colors of mesh faces.

    Attributes
    ----------
    images
        Images of shape (h, w, 3) and type uint8. An image with a single pixel is a plain color.
    image
        Index of the image of each face. Shape (f,), int32.
    uv
        Texture coordinates of the corners as in `Cutout`, or None if there are only plain colors.
        Shape (f, 3, 2), float32.
    corners
        Vertex colors of each face, or None for white. The colors of the images are multiplied by
        these colors in linear light. Shape (f, 3, 3), uint8.
    """

    images: tuple[Bytes, ...]
    image: Ints32
    uv: Floats32 | None = None
    corners: Bytes | None = None

    def __len__(self) -> int:
        return len(self.image)

    @classmethod
    def plain(cls, color: Bytes, faces: int) -> Colors:
        """Create colors that are the same for all faces.

        `color` has shape (1, 1, 3).
        """
        return cls((color,), np.zeros(faces, np.int32))

    @classmethod
    def from_vertex_colors(cls, corners: Bytes) -> Colors:
        """Create colors from the corner colors of each face.

        `corners` has shape (f, 3, 3).
        """
        return cls((WHITE,), np.zeros(len(corners), np.int32), corners=corners)

    @classmethod
    def from_face_colors(cls, colors: Bytes) -> Colors:
        """Create colors from one color per face.

        `colors` has shape (f, 3).
        """
        return cls.from_vertex_colors(colors[:, None].repeat(3, axis=1))

    def take(self, face_selection: Integers | slice) -> Colors:
        """Return the colors of the selected faces."""
        uv = None if self.uv is None else self.uv[face_selection]
        corners = None if self.corners is None else self.corners[face_selection]
        return Colors(self.images, self.image[face_selection], uv, corners)

    def subdivide(self, face_indices: Integers, weights: Floats) -> Colors:
        """Return the colors of the pieces into which faces were divided.

        Parameters
        ----------
        face_indices
            Index of the face to which each piece belongs. Shape (k,).
        weights
            Barycentric coordinates of the corners of each piece. Shape (k, 3, 3).
        """
        faces = self.take(face_indices)
        uv = None if faces.uv is None else matmul(weights, faces.uv).astype(np.float32)
        corners = None if faces.corners is None else matmul(weights, faces.corners).astype(np.uint8)
        return replace(faces, uv=uv, corners=corners)

    def reverse_corners(self) -> Colors:
        """Return the colors with the corners of each face in reverse order."""
        uv = None if self.uv is None else self.uv[:, ::-1]
        corners = None if self.corners is None else self.corners[:, ::-1]
        return replace(self, uv=uv, corners=corners)

    def check(self, name: str, faces: int) -> None:
        """Check that the colors match the faces of an object.

        Raises
        ------
        LidarError
            If shapes, types or values are invalid.
        """
        shapes = [(self.image, (faces,)), (self.uv, (faces, 3, 2)), (self.corners, (faces, 3, 3))]
        valid = all(array is None or array.shape == shape for array, shape in shapes)
        for image in self.images:
            valid &= image.dtype == np.uint8 and image.shape[2:] == (3,)
            valid &= image.size == 3 or (image.size > 3 and self.uv is not None)
        valid &= self.uv is None or bool(np.isfinite(self.uv).all())
        if not valid or not are_valid_indices(self.image, len(self.images)):
            raise LidarError(
                f"The colors of {name!r} do not match its {faces} faces. Expected uint8 images (h, "
                "w, 3), image (f,), finite uv (f, 3, 2) and corners (f, 3, 3)."
            )

    def mean_colors(self) -> Bytes:
        """Return the mean color of each face, computed in linear light.

        The mean is taken over 4 points of each face, or over 100 points if the mesh has at most
        `MAX_DENSE_FACES` faces. The shape is (f, 3).
        """
        mean_colors = np.empty((len(self), 3), np.uint8)
        steps = 10 if len(self) <= MAX_DENSE_FACES else 2
        # The points are the centers of the pieces into which lines parallel to the edges divide a
        # face.
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
                light += LINEAR[unpack_colors(colors)]
            mean_colors[start : start + BLOCK_FACES] = as_srgb(light / len(points))
        return mean_colors


MAX_DENSE_FACES = 20_000  # up to this size, colors are averaged over 100 points per face
_UNIT = np.array([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]])


def are_valid_indices(indices: Ints32, count: int) -> bool:
    """Return whether all numbers are valid indices for a sequence of length `count`."""
    return not indices.size or bool(0 <= indices.min() <= indices.max() < count)


class Lookup:
    """A lookup table for the colors of points on faces.

    Parameters
    ----------
    colors
        Colors of f faces.
    corners
        Corners of the faces in blocks of shape (k, 3, 3).
    """

    def __init__(self, colors: Colors, corners: Iterable[Floats]) -> None:
        images = colors.images
        tints = colors.corners
        self._image = colors.image
        self._texels = np.concatenate([pack_colors(image.reshape(-1, 3)) for image in images])
        sizes = np.array([image.shape[:2] for image in images], np.int64)
        self._height, self._width = sizes.T
        counts = sizes.prod(axis=1)
        self._first = np.cumsum([0, *counts[:-1]])
        # Texture coordinates and vertex colors are stored as linear functions of the position.
        textured = (counts > 1)[self._image]
        tinted = np.zeros(0, np.bool_) if tints is None else (tints != 255).any(axis=(1, 2))
        textures = [np.zeros((0, 8))]
        lights = [np.zeros((0, 12))]
        start = 0
        for block in corners:
            rows = slice(start, start + len(block))
            if colors.uv is not None:
                uv = colors.uv[rows][textured[rows]]
                textures.append(_fit_planes(block[textured[rows]], uv.astype(np.float64)))
            if tints is not None:
                light = LINEAR[tints[rows][tinted[rows]]]
                lights.append(_fit_planes(block[tinted[rows]], light))
            start += len(block)
        self._texture = _Planes.concatenate(textured, textures)
        self._light = _Planes.concatenate(tinted, lights)

    def colors_at(self, face_indices: Integers, points: Floats) -> UInts32:
        """Return the packed colors of points on given faces.

        Image colors are those of the texel that contains the point. Face indices have shape (n,),
        points have shape (n, 3), and the result has shape (n,).
        """
        image = self._image.take(face_indices)
        texel = self._first.take(image)
        positions = np.ascontiguousarray(points.T)
        if self._texture is not None:
            selected, (u, v) = self._texture.values_at(face_indices, positions)
            image = image[selected]
            width = self._width.take(image)
            row = _texel_index(v, self._height.take(image))
            texel[selected] += row * width + _texel_index(u, width)
        colors = self._texels.take(texel)
        if self._light is not None:
            selected, light = self._light.values_at(face_indices, positions)
            tinted = LINEAR[unpack_colors(colors[selected])] * np.clip(light.T, 0, 1)
            colors[selected] = pack_colors(as_srgb(tinted))
        return colors


class _Planes(NamedTuple):
    """Linear functions of position that define values on faces."""

    slope_rows: Ints32  # (f,), row of `slopes` for each face, or -1 for faces without values
    slopes: Floats  # (k, 4 w), slopes along x, y and z and the value at zero for each of w values
    everywhere: bool  # whether all faces have values

    @classmethod
    def concatenate(cls, has_values: Bools, blocks: list[Floats]) -> _Planes | None:
        """Concatenate the slopes of all faces that have values.

        Each block has shape (k, 4 w). The result is None if no face has values.
        """
        if not has_values.any():
            return None
        slope_rows = np.where(has_values, np.cumsum(has_values) - 1, -1).astype(np.int32)
        return cls(slope_rows, np.concatenate(blocks), bool(has_values.all()))

    def values_at(self, face_indices: Integers, points: Floats) -> tuple[Any, Floats]:
        """Return the values at points on the given faces, and a selection of points with values.

        The selection contains the points that have values. It is a slice for all points, or indices
        of shape (m,). Face indices have shape (n,), points have shape (3, n), and values have shape
        (w, m).
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


def _fit_planes(corners: Floats, values: Floats) -> Floats:
    """Fit the slopes of `_Planes` to values at the corners of faces.

    Degenerate triangles, which rays never hit, have the value of their first corner. Corners have
    shape (k, 3, 3), values have shape (k, 3, w), and slopes have shape (k, 4 w).
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


def _texel_index(coordinate: Floats, size: Ints) -> Ints:
    """Return the texel row or column at a texture coordinate of a repeating image."""
    position = coordinate - np.floor(coordinate)
    position *= size
    return np.minimum(position.astype(np.int64), size - 1)


def pack_colors(colors: Bytes) -> UInts32:
    """Pack colors into integers, with red in the lowest byte.

    Colors have shape (n, 3), and the result has shape (n,).
    """
    channels = np.zeros((len(colors), 4), np.uint8)
    channels[:, :3] = colors
    return channels.view("<u4")[:, 0]


def unpack_colors(colors: UInts32) -> Bytes:
    """Unpack colors from integers.

    Packed colors have shape (n,), and the result has shape (n, 3).
    """
    return np.ascontiguousarray(colors, "<u4").view(np.uint8).reshape(-1, 4)[:, :3]


def pack_as_float(red: Bytes, green: Bytes, blue: Bytes) -> Floats32:
    """Encode colors in the format of the `rgb` field in PCL and ROS.

    The bits 0x00RRGGBB of each color are interpreted as a float. All arrays have shape (n,).
    """
    return pack_colors(np.column_stack([blue, green, red])).view("<f4")


def luminance(colors: UInts32) -> Floats:
    """Return the luminance of packed colors in linear light, from 0 to 1."""
    red, green, blue = map(np.take, _SHARES, unpack_colors(colors).T)
    return np.asarray(red + green + blue)


_SHARES = WEIGHTS[:, None] * LINEAR


def join_colors(mesh_colors: Sequence[Colors | None], sizes: Iterable[int]) -> Colors | None:
    """Concatenate the colors of meshes, or return None if no mesh has colors.

    `sizes` contains the number of faces of each mesh. A mesh without colors becomes gray.
    """
    if not any(part is not None for part in mesh_colors):
        return None
    colored = [
        Colors.plain(GRAY, size) if part is None else part
        for part, size in zip(mesh_colors, sizes, strict=True)
    ]
    image_numbers: dict[int, int] = {}  # {id of an image: index of the image}
    images: list[Bytes] = []
    image_indices = []  # an array of shape (f,) for each mesh
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
    """Return a summary of the colors, such as "2 textures, 1 plain color, vertex colors"."""
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

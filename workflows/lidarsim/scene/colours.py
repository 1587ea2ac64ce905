"""Colours of triangles: images, plain colours, and colours of corners."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ..base.arrays import Bools, Bytes, Floats, Floats32, Integers, Ints, Ints32, UInts32
from ..base.elementary import power
from ..base.errors import LidarError
from ..base.vectors import matmul
from ..base.words import plural

# What has no colour is grey, of half of the light, as the default reflectance is.
GREY = np.full((1, 1, 3), 188, np.uint8)
WHITE = np.full((1, 1, 3), 255, np.uint8)
WEIGHTS = np.array([0.2126, 0.7152, 0.0722])  # luminance of linear light, ITU-R BT.709
BLOCK_FACES = 1 << 16
_FLAT = 1e-200  # m⁴: the square of the area of a triangle that no ray hits, twice

_byte = np.arange(256) / 255
# {sRGB byte: linear light}, IEC 61966-2-1
LINEAR = np.where(_byte <= 0.04045, _byte / 12.92, power((_byte + 0.055) / 1.055, 2.4))
_EDGES = (LINEAR[:-1] + LINEAR[1:]) / 2


def as_srgb(linear: ArrayLike) -> Bytes:
    """Nearest sRGB bytes of linear light, 0 to 1, of any shape."""
    return np.searchsorted(_EDGES, np.asarray(linear, np.float64)).astype(np.uint8)


def as_bytes(shares: ArrayLike) -> Bytes:
    """Bytes of shares of sRGB, 0 to 1, of any shape; NaN is 0."""
    known = np.nan_to_num(np.asarray(shares, np.float64))
    return np.rint(255 * np.clip(known, 0, 1)).astype(np.uint8)


@dataclass(frozen=True, eq=False)
class Colours:
    """Colours of the faces of a mesh, in sRGB as files have them.

    Attributes
    ----------
    images
        uint8 (h, w, 3) each. One of a single element is a plain colour.
    image
        int32 (f,): which of them each face has.
    uv
        float32 (f, 3, 2): texture coordinates of the corners, see `Cutout`; None if there are only
        plain colours.
    corners
        uint8 (f, 3, 3): colours of the corners, by which those of the images are multiplied in
        linear light; None for white.
    """

    images: tuple[Bytes, ...]
    image: Ints32
    uv: Floats32 | None = None
    corners: Bytes | None = None

    def __len__(self) -> int:
        return len(self.image)

    @classmethod
    def plain(cls, colour: Bytes, faces: int) -> Colours:
        """One colour, (1, 1, 3), for all faces."""
        return cls((colour,), np.zeros(faces, np.int32))

    @classmethod
    def of_corners(cls, corners: Bytes) -> Colours:
        """Give each corner of each face a colour of its own, (f, 3, 3)."""
        return cls((WHITE,), np.zeros(len(corners), np.int32), corners=corners)

    @classmethod
    def of_faces(cls, colours: Bytes) -> Colours:
        """Give each face a colour of its own, (f, 3)."""
        return cls.of_corners(colours[:, None].repeat(3, axis=1))

    def take(self, rows: Integers | slice) -> Colours:
        """Select faces."""
        uv = None if self.uv is None else self.uv[rows]
        corners = None if self.corners is None else self.corners[rows]
        return Colours(self.images, self.image[rows], uv, corners)

    def divided(self, rows: Integers, weights: Floats) -> Colours:
        """Colours of pieces of faces (k,), whose corners have these weights of theirs (k, 3, 3)."""
        whole = self.take(rows)
        uv = None if whole.uv is None else matmul(weights, whole.uv).astype(np.float32)
        corners = None if whole.corners is None else matmul(weights, whole.corners).astype(np.uint8)
        return replace(whole, uv=uv, corners=corners)

    def mirrored(self) -> Colours:
        """Reverse the order of the corners."""
        uv = None if self.uv is None else self.uv[:, ::-1]
        corners = None if self.corners is None else self.corners[:, ::-1]
        return replace(self, uv=uv, corners=corners)

    def check(self, name: str, faces: int) -> None:
        """Check the shapes for so many faces of an object; LidarError if they are wrong."""
        shapes = [(self.image, (faces,)), (self.uv, (faces, 3, 2)), (self.corners, (faces, 3, 3))]
        well = all(one is None or one.shape == shape for one, shape in shapes)
        well &= all(one.dtype == np.uint8 and one.shape[2:] == (3,) for one in self.images)
        well &= all(one.size == 3 or (one.size > 3 and self.uv is not None) for one in self.images)
        well &= self.uv is None or bool(np.isfinite(self.uv).all())
        if not well or not within(self.image, len(self.images)):
            raise LidarError(
                f"The colours of {name!r} do not fit its {faces} faces: images are uint8 "
                "(h, w, 3), image (f,), uv (f, 3, 2), finite, and corners (f, 3, 3)."
            )

    def means(self) -> Bytes:
        """Mean colour of each face, in linear light, of four places on it, or of 100: (f, 3)."""
        out = np.empty((len(self), 3), np.uint8)
        steps = 10 if len(self) <= FEW_FACES else 2
        # The middles of the pieces into which lines beside the edges cut it.
        i, j = (n.ravel() for n in np.mgrid[:steps, :steps])
        upright = np.stack([i, j], axis=1)[i + j < steps] + 1 / 3
        turned = np.stack([i, j], axis=1)[i + j < steps - 1] + 2 / 3
        places = np.concatenate([upright, turned]) / steps
        for begin in range(0, len(self), BLOCK_FACES):
            some = self.take(slice(begin, begin + BLOCK_FACES))
            lookup = Lookup(some, [_UNIT.repeat(len(some), axis=0)])
            rows = np.arange(len(some))
            light = np.zeros((len(some), 3))
            for along, across in places.tolist():
                found = lookup.at(rows, np.tile([along, across, 0.0], (len(some), 1)))
                light += LINEAR[unpacked(found)]
            out[begin : begin + BLOCK_FACES] = as_srgb(light / len(places))
        return out


FEW_FACES = 20_000
_UNIT = np.array([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]])


def within(numbers: Ints32, count: int) -> bool:
    """Whether numbers of any shape are those of so many things, from 0 up."""
    return not numbers.size or bool(0 <= numbers.min() <= numbers.max() < count)


class Lookup:
    """Colours by the number of a face and a point on it; images are kept as one table.

    Parameters
    ----------
    colours
        Of f faces.
    corners
        (k, 3, 3) each: corners of the faces, one block after the other.
    """

    def __init__(self, colours: Colours, corners: Iterable[Floats]) -> None:
        images = colours.images
        tints = colours.corners
        self._image = colours.image
        self._texels = np.concatenate([packed(one.reshape(-1, 3)) for one in images])
        sizes = np.array([one.shape[:2] for one in images], np.int64)
        self._height, self._width = sizes.T
        counts = sizes.prod(axis=1)
        self._first = np.cumsum([0, *counts[:-1]])
        # Faces with images have texture coordinates, and those with colours at their corners
        # have these, as planes of the position.
        own = (counts > 1)[self._image]
        tinted = np.zeros(0, np.bool_) if tints is None else (tints != 255).any(axis=(1, 2))
        textures = [np.zeros((0, 8))]
        lights = [np.zeros((0, 12))]
        at = 0
        for block in corners:
            rows = slice(at, at + len(block))
            if colours.uv is not None:
                uv = colours.uv[rows][own[rows]]
                textures.append(_planes(block[own[rows]], uv.astype(np.float64)))
            if tints is not None:
                light = LINEAR[tints[rows][tinted[rows]]]
                lights.append(_planes(block[tinted[rows]], light))
            at += len(block)
        self._texture = _Planes.of(own, textures)
        self._light = _Planes.of(tinted, lights)

    def at(self, rows: Integers, points: Floats) -> UInts32:
        """Colours of points (n, 3) on faces (n,), packed; of images the nearest element."""
        image = self._image.take(rows)
        at = self._first.take(image)
        place = np.ascontiguousarray(points.T)
        if self._texture is not None:
            on, (u, v) = self._texture.at(rows, place)
            image = image[on]
            width = self._width.take(image)
            row = _element(v, self._height.take(image))
            at[on] += row * width + _element(u, width)
        found = self._texels.take(at)
        if self._light is not None:
            on, light = self._light.at(rows, place)
            tinted = LINEAR[unpacked(found[on])] * np.clip(light.T, 0, 1)
            found[on] = packed(as_srgb(tinted))
        return found


class _Planes(NamedTuple):
    """Values on faces that are linear in the position."""

    place: Ints32  # (f,): row of `slopes` that each face has; -1 for none
    slopes: Floats  # (k, 4 w): of each of w values, along x, y and z, and at zero
    everywhere: bool

    @classmethod
    def of(cls, there: Bools, blocks: list[Floats]) -> _Planes | None:
        """Join blocks (k, 4 w), of the faces (f,) that have some; None if there are none."""
        if not there.any():
            return None
        place = np.where(there, np.cumsum(there) - 1, -1).astype(np.int32)
        return cls(place, np.concatenate(blocks), bool(there.all()))

    def at(self, rows: Integers, points: Floats) -> tuple[Any, Floats]:
        """Which of the faces (n,) have values, and the values at points (3, n): (w, m)."""
        on: Any = slice(None)
        place = self.place.take(rows)
        if not self.everywhere:
            on = np.flatnonzero(place >= 0)
            place = place[on]
            points = points[:, on]
        x, y, z = points
        out = np.empty((self.slopes.shape[1] // 4, len(x)))
        slopes = self.slopes.take(place, axis=0).T.reshape(len(out), 4, len(x))
        for value, (a, b, c, d) in zip(out, slopes, strict=True):
            np.multiply(a, x, out=value)
            value += b * y
            value += c * z
            value += d
        return on, out


def _planes(corners: Floats, values: Floats) -> Floats:
    """Slopes of values (k, 3, w) between corners (k, 3, 3): (k, 4 w), see `_Planes`.

    Flat triangles, which are not hit, have the value of their first corner.
    """
    a, b, c = corners.transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)
    area = (normal * normal).sum(axis=1, keepdims=True)
    scale = np.divide(1, area, out=np.zeros_like(area), where=area > _FLAT)
    along_b = np.cross(c - a, normal) * scale
    along_c = np.cross(normal, b - a) * scale
    out = np.empty((len(corners), values.shape[2], 4))
    for value, (first, second, third) in enumerate(values.transpose(2, 1, 0)):
        slope = (second - first)[:, None] * along_b + (third - first)[:, None] * along_c
        out[:, value, :3] = slope
        out[:, value, 3] = first - (slope * a).sum(axis=1)
    return out.reshape(len(corners), 4 * values.shape[2])


def _element(place: Floats, size: Ints) -> Ints:
    """Which of so many elements of an image that repeats a texture coordinate is in: (n,)."""
    within = place - np.floor(place)
    within *= size
    return np.minimum(within.astype(np.int64), size - 1)


def packed(colours: Bytes) -> UInts32:
    """Colours (n, 3) as one number each, red in its lowest byte."""
    out = np.zeros((len(colours), 4), np.uint8)
    out[:, :3] = colours
    return out.view("<u4")[:, 0]


def unpacked(colours: UInts32) -> Bytes:
    """Undo `packed`."""
    return np.ascontiguousarray(colours, "<u4").view(np.uint8).reshape(-1, 4)[:, :3]


def as_float(red: Bytes, green: Bytes, blue: Bytes) -> Floats32:
    """Colours (n,) as PCL and ROS have them in a field `rgb`: the bits 0x00RRGGBB as a float."""
    return packed(np.column_stack([blue, green, red])).view("<f4")


def luminance(colours: UInts32) -> Floats:
    """Luminance (n,) of packed colours in linear light, 0 to 1."""
    red, green, blue = map(np.take, _SHARES, unpacked(colours).T)
    return np.asarray(red + green + blue)


_SHARES = WEIGHTS[:, None] * LINEAR


def joined(parts: Sequence[Colours | None], sizes: Iterable[int]) -> Colours | None:
    """Colours of meshes of so many faces, one after the other; grey where there are none."""
    if not any(part is not None for part in parts):
        return None
    whole = [
        Colours.plain(GREY, size) if part is None else part
        for part, size in zip(parts, sizes, strict=True)
    ]
    numbers: dict[int, int] = {}  # {id of an image: its number}
    images: list[Bytes] = []
    image = []
    for part in whole:
        for one in part.images:
            if id(one) not in numbers:
                numbers[id(one)] = len(images)
                images.append(one)
        image.append(np.array([numbers[id(one)] for one in part.images], np.int32)[part.image])
    uv = corners = None
    if any(part.uv is not None for part in whole):
        uv = np.concatenate(
            [np.zeros((len(p), 3, 2), np.float32) if p.uv is None else p.uv for p in whole]
        )
    if any(part.corners is not None for part in whole):
        corners = np.concatenate(
            [np.full((len(p), 3, 3), 255, np.uint8) if p.corners is None else p.corners
             for p in whole]
        )  # fmt: skip
    return Colours(tuple(images), np.concatenate(image), uv, corners)


def colours_summary(parts: Iterable[Colours | None]) -> str:
    """Say what the colours of meshes are: «2 textures, 1 plain colour, colours of vertices»."""
    there = [part for part in parts if part is not None]
    kinds = {
        id(part.images[number]): "texture" if part.images[number].size > 3 else "plain colour"
        for part in there
        for number in np.unique(part.image)
        if part.images[number] is not WHITE
    }
    counts = Counter(kinds.values())
    words = [plural(counts[kind], kind) for kind in ("texture", "plain colour") if counts[kind]]
    words += ["colours of vertices"] * any(part.corners is not None for part in there)
    return ", ".join(words) or "no colours"

"""Materials and colours of OpenUSD's meshes, as `usd_child.py` writes them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Literal, NamedTuple

import numpy as np

from lidarsim.base.allowance import Allowance
from lidarsim.base.arrays import AnyArray, Bools, Floats, Ints
from lidarsim.base.vectors import matmul
from lidarsim.scene.colours import LINEAR, Colours, as_srgb
from lidarsim.scene.files.polygons import check_corners, triangulated
from lidarsim.scene.files.scene_graph import Piece, ReadOptions
from lidarsim.scene.masks import (
    FACE_BYTES,
    MaskError,
    MaskNotes,
    Texture,
    Wrap,
    read_colours,
    read_opacity,
    remembered,
)
from lidarsim.scene.scene_mesh import Cutout

_CUT = 0.5  # least opacity that stops light, unless a material states another
_BYTES = np.arange(256) / 255

# Where a material has a colour or an opacity from: a `value`, an `image`, or `values` of the mesh;
# see `Looks` in usd_child.py.
ColourSource = dict[str, Any]
_DISPLAY: ColourSource = {"values": "displayColor"}


class _Use(NamedTuple):
    """A use of an image, which meshes share."""

    image: int
    channels: str  # "rgb", or one of r, g, b and a
    scale: tuple[float, ...]  # its light is multiplied by this, (4,)
    bias: tuple[float, ...]  # and then added to this
    raw: bool  # its numbers are light, not sRGB
    wraps: tuple[Wrap, Wrap]

    @classmethod
    def of(cls, source: ColourSource) -> _Use:
        scale = tuple(source.get("scale", (1,) * 4))
        bias = tuple(source.get("bias", (0,) * 4))
        raw = source.get("raw", False)
        wraps = tuple(source["wraps"])
        return cls(source["image"], source["channels"], scale, bias, raw, wraps)

    def light(self, channel: str) -> Floats:
        """Light (256,) of the bytes of a channel."""
        k = "rgba".index(channel)
        return (_BYTES if self.raw or k == 3 else LINEAR) * self.scale[k] + self.bias[k]


class Look:
    """What a mesh has for its materials.

    Parameters
    ----------
    frame, arrays
        As the child wrote them.
    places
        {interpolation: which of so many values each corner of the triangles has, (t, 3)}.
    """

    def __init__(
        self, frame: dict[str, Any], arrays: list[AnyArray], places: dict[str, Ints]
    ) -> None:
        self._arrays = arrays
        self._places = places
        self._values: dict[str, tuple[str, int]] = frame.get("values", {})

    def coordinates(self, source: ColourSource, rows: Ints) -> tuple[Floats, Ints]:
        """Texture coordinates (c, 2) as in glTF, and which of them triangles have, (k, 3)."""
        values, corners = self._at(source["values"], rows, 2)
        matrix = np.array(source.get("matrix", np.eye(3, 2)))
        u, v = (matmul(values, matrix[:2]) + matrix[2]).T
        return np.stack([u, 1 - v], axis=1), corners

    def painted(self, name: str, rows: Ints) -> Colours | None:
        """Colours of triangles by values, linear light; None if there are none."""
        if name not in self._values:
            return None
        values, corners = self._at(name, rows, 3)
        colours = as_srgb(np.nan_to_num(values))
        if len(colours) == 1:
            return Colours.plain(colours[None], len(rows))
        return Colours.of_corners(colours[corners])

    def _at(self, name: str, rows: Ints, width: int) -> tuple[Floats, Ints]:
        if not name:  # a texture that is not told where to look has its value at zero everywhere
            return np.zeros((1, width)), np.zeros((len(rows), 3), np.int64)
        if name not in self._values:
            raise MaskError(f"its mesh has no {name!r}")
        interpolation, number = self._values[name]
        values = self._arrays[number]
        corners = self._places.get(interpolation)
        if corners is None:
            raise MaskError("its shape has no texture coordinates that are read")
        if values.shape[1] != width or not corners[rows].max(initial=-1) < len(values):
            raise MaskError(f"{name!r} of its mesh has {len(values)} values of {values.shape[1]}")
        return values.astype(np.float64), corners[rows]


class UsdMaterials:
    """Images and materials by their numbers, and what they make of triangles."""

    def __init__(self, allowance: Allowance, wanted: ReadOptions) -> None:
        self._allowance = allowance
        self.coloured = wanted.colours
        self._named = wanted.materials
        self._images: dict[int, tuple[str, bytes]] = {}  # {number: (why it is not read, content)}
        self._materials: dict[int | None, dict[str, Any]] = {None: {"name": "displayColor"}}
        self._shades, self._mask = remembered(self._read_shades), remembered(self._read_mask)
        self.notes = MaskNotes()

    def add(self, frame: dict[str, Any], arrays: list[AnyArray]) -> None:
        """Keep a frame of an image or a material."""
        if frame["what"] == "material":
            self._materials[frame["number"]] = frame
            return
        why = frame["unread"] and f"its image {frame['name']!r} {frame['unread']}"
        self._images[frame["number"]] = why, arrays[0].tobytes()

    def name(self, number: int | None) -> str:
        """Name of a material, if names are wanted; else, or for none, empty."""
        return "" if number is None or not self._named else str(self._materials[number]["name"])

    def colours(self, number: int | None, look: Look, rows: Ints) -> Colours | None:
        """Colours that a material gives triangles; None if they have none."""
        if not self.coloured:
            return None
        material = self._materials[number]
        source = material.get("colour", _DISPLAY)
        for one in (source, source.get("instead", _DISPLAY)):
            with self.notes.without_colour(material["name"]):
                if not self._allowance.fits(FACE_BYTES * len(rows)):
                    raise MaskError("there are too many triangles")
                if "unread" in one:
                    raise MaskError(one["unread"])
                if "value" in one:
                    light = np.nan_to_num(np.array(one["value"]))
                    return Colours.plain(as_srgb(light).reshape(1, 1, 3), len(rows))
                if "image" in one:
                    coordinates = look.coordinates(one, rows)
                    return self._shades(_Use.of(one)).colours(*coordinates)
                return look.painted(one["values"], rows)
        return None

    def cutout(self, number: int | None, look: Look, rows: Ints) -> Cutout | None:
        """Mask that a material gives triangles; None if they are solid."""
        material = self._materials[number]
        source = material.get("opacity", {"value": 1.0})
        with self.notes.without_mask(material["name"]):
            if "unread" in source:
                raise MaskError(source["unread"])
            mask: Texture | Literal["glass"] | None = None
            if "image" in source:
                mask = self._mask((_Use.of(source), material["threshold"]))
            elif source.get("value", 0.0) < 1:
                mask = "glass"
            if mask == "glass":
                self.notes.glass[material["name"]] = None
            elif mask is not None:
                return mask.cutout(*look.coordinates(source, rows))
        return None

    def _image(self, number: int) -> bytes:
        why, content = self._images[number]
        if why:
            raise MaskError(why)
        return content

    def _read_shades(self, use: _Use) -> Texture:
        """Texture of an image."""
        found = read_colours(self._image(use.image), self._allowance, self.notes)
        names = use.channels if use.channels == "rgb" else use.channels * 3
        tables = [as_srgb(np.nan_to_num(use.light(name))) for name in names]
        shades = [by[found[..., "rgb".index(k)]] for by, k in zip(tables, names, strict=True)]
        return Texture(np.stack(shades, axis=-1), use.wraps, self._allowance)

    def _read_mask(self, key: tuple[_Use, float]) -> Texture | Literal["glass"] | None:
        """Mask of an image; «glass» if it is nowhere opaque, None if everywhere."""
        use, least = key
        channel = use.channels[0]
        content = self._image(use.image)
        if channel == "a":
            opacity = read_opacity(content, self._allowance)
            opacity = np.full((1, 1), 255, np.uint8) if opacity is None else opacity
        else:
            colours = read_colours(content, self._allowance, self.notes)
            opacity = colours[..., "rgb".index(channel)]
        mask = (use.light(channel) >= (least or _CUT))[opacity]
        if mask.all():
            return None
        if not mask.any() and not least:
            return "glass"
        return Texture(mask, use.wraps, self._allowance)


def dressed(
    frame: dict[str, Any],
    arrays: list[AnyArray],
    vertices: Floats,
    polygons: tuple[Ints, Ints, Bools],
    materials: UsdMaterials,
) -> Iterator[Piece]:
    """Cut polygons into triangles, divided by their materials.

    `polygons` are their sizes, the vertices at their corners, and which are no holes.

    Raises
    ------
    ValueError
        As `triangulated`.
    """
    sizes, corners, solid = polygons
    check_corners(corners, len(vertices))
    # By number of the corner, since a vertex may have another colour in each polygon.
    at = np.flatnonzero(np.repeat(solid, sizes))
    faces = at[triangulated(vertices[corners[at]], np.arange(len(at)), sizes[solid])]
    polygon = np.repeat(np.arange(len(sizes)), sizes)[faces]
    places = {"constant": np.zeros_like(faces), "uniform": polygon, "faceVarying": faces}
    places["vertex"] = places["varying"] = corners[faces]
    look = Look(frame, arrays, places)
    group = np.zeros(len(sizes), np.int64)
    numbers: list[int | None] = [None]
    for number, where in frame.get("materials", ()):
        rows = np.arange(len(sizes)) if where is None else arrays[where]
        group[rows[(rows >= 0) & (rows < len(sizes))]] = len(numbers)
        numbers.append(number)
    of = group[polygon[:, 0]]
    for one in np.unique(of).tolist():
        rows = np.flatnonzero(of == one)
        cut = materials.cutout(numbers[one], look, rows)
        colours = materials.colours(numbers[one], look, rows)
        yield Piece(vertices, corners[faces[rows]], cut, colours, materials.name(numbers[one]))

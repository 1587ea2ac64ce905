"""Read the materials and colors of OpenUSD meshes from the frames of `usd_child.py`."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Literal, NamedTuple

import numpy as np

from lidarsim.io.allowance import Allowance
from lidarsim.numerics.arrays import AnyArray, Bools, Floats, Ints
from lidarsim.numerics.vectors import matmul
from lidarsim.scene.colors import LINEAR, Colors, as_srgb
from lidarsim.scene.files.polygons import check_corners, triangulate
from lidarsim.scene.files.scene_graph import Piece, ReadOptions
from lidarsim.scene.masks import (
    FACE_BYTES,
    MaskError,
    MaskNotes,
    Texture,
    Wrap,
    cache_with_errors,
    read_colors,
    read_opacity,
)
from lidarsim.scene.scene_mesh import Cutout

_DEFAULT_THRESHOLD = 0.5  # minimum opacity that stops light, unless the material states another
_BYTES = np.arange(256) / 255

# The source of a material's color or opacity: a `value`, an `image`, or `values` of the mesh, as
# `MaterialReader` in usd_child.py writes it.
ColorSource = dict[str, Any]
_DISPLAY: ColorSource = {"values": "displayColor"}


class _Use(NamedTuple):
    """How a material uses an image. Several meshes may share this."""

    image: int
    channels: str  # "rgb", or a letter of "rgba"
    scale: tuple[float, ...]  # (4,) factors for light
    bias: tuple[float, ...]  # (4,) offsets that are added after scaling
    raw: bool  # whether values are linear light instead of sRGB
    wraps: tuple[Wrap, Wrap]

    @classmethod
    def from_source(cls, source: ColorSource) -> _Use:
        """Create the use of an image from the description of a source."""
        scale = tuple(source.get("scale", (1,) * 4))
        bias = tuple(source.get("bias", (0,) * 4))
        raw = source.get("raw", False)
        wraps = tuple(source["wraps"])
        return cls(source["image"], source["channels"], scale, bias, raw, wraps)

    def light(self, channel: str) -> Floats:
        """Return the linear light that each byte value in a channel represents. Shape (256,)."""
        k = "rgba".index(channel)
        return (_BYTES if self.raw or k == 3 else LINEAR) * self.scale[k] + self.bias[k]


class MeshAppearance:
    """Texture coordinates and colors of a mesh, in the form that its materials require.

    Parameters
    ----------
    frame, arrays
        Frame of the mesh.
    value_indices
        For each interpolation, the index (t, 3) of the value at each corner of the triangles.
    """

    def __init__(
        self, frame: dict[str, Any], arrays: list[AnyArray], value_indices: dict[str, Ints]
    ) -> None:
        self._arrays = arrays
        self._value_indices = value_indices
        self._values: dict[str, tuple[str, int]] = frame.get("values", {})

    def coordinates(self, source: ColorSource, face_indices: Ints) -> tuple[Floats, Ints]:
        """Return texture coordinates in glTF's convention, and the indices at triangle corners.

        The indices have shape (k, 3), with an index for each corner of the triangles.
        """
        values, corners = self._corner_values(source["values"], face_indices, 2)
        matrix = np.array(source.get("matrix", np.eye(3, 2)))
        u, v = (matmul(values, matrix[:2]) + matrix[2]).T
        return np.stack([u, 1 - v], axis=1), corners

    def value_colors(self, name: str, face_indices: Ints) -> Colors | None:
        """Convert linear values to triangle colors, or return None if there are no values."""
        if name not in self._values:
            return None
        values, corners = self._corner_values(name, face_indices, 3)
        colors = as_srgb(np.nan_to_num(values))
        if len(colors) == 1:
            return Colors.plain(colors[None], len(face_indices))
        return Colors.from_vertex_colors(colors[corners])

    def _corner_values(self, name: str, face_indices: Ints, width: int) -> tuple[Floats, Ints]:
        """Return a primvar's values, and the index of the value at each triangle corner.

        Raises MaskError if the mesh has no suitable values.
        """
        if not name:  # a texture without coordinates is sampled at the origin
            return np.zeros((1, width)), np.zeros((len(face_indices), 3), np.int64)
        if name not in self._values:
            raise MaskError(f"its mesh has no primvar {name!r}")
        interpolation, number = self._values[name]
        values = self._arrays[number]
        corners = self._value_indices.get(interpolation)
        if corners is None:
            raise MaskError("its shape has no supported texture coordinates")
        if values.shape[1] != width or not corners[face_indices].max(initial=-1) < len(values):
            raise MaskError(
                f"the primvar {name!r} of its mesh has {len(values)} values with "
                f"{values.shape[1]} components, which does not fit the mesh"
            )
        return values.astype(np.float64), corners[face_indices]


class UsdMaterials:
    """The numbered images and materials of a scene, from which colors and masks are created."""

    def __init__(self, allowance: Allowance, options: ReadOptions) -> None:
        self._allowance = allowance
        self.colored = options.colors
        self._names_materials = options.materials
        # {number: (reason if the image is not read, content)}
        self._images: dict[int, tuple[str, bytes]] = {}
        self._materials: dict[int | None, dict[str, Any]] = {None: {"name": "displayColor"}}
        self._shades = cache_with_errors(self._read_shades)
        self._mask = cache_with_errors(self._read_mask)
        self.notes = MaskNotes()

    def add_frame(self, frame: dict[str, Any], arrays: list[AnyArray]) -> None:
        """Store the frame of an image or material."""
        if frame["what"] == "material":
            self._materials[frame["number"]] = frame
            return
        reason = frame["unread"] and f"its image {frame['name']!r} {frame['unread']}"
        self._images[frame["number"]] = reason, arrays[0].tobytes()

    def name(self, number: int | None) -> str:
        """Return the name of a material, or an empty string if names are not requested."""
        return (
            ""
            if number is None or not self._names_materials
            else str(self._materials[number]["name"])
        )

    def colors(self, number: int | None, look: MeshAppearance, face_indices: Ints) -> Colors | None:
        """Return the colors of triangles that have a material, or None if there are none."""
        if not self.colored:
            return None
        material = self._materials[number]
        source = material.get("color", _DISPLAY)
        for color_source in (source, source.get("instead", _DISPLAY)):
            with self.notes.record_color_error(material["name"]):
                if not self._allowance.fits(FACE_BYTES * len(face_indices)):
                    raise MaskError("the mesh has too many triangles")
                if "unread" in color_source:
                    raise MaskError(color_source["unread"])
                if "value" in color_source:
                    light = np.nan_to_num(np.array(color_source["value"]))
                    return Colors.plain(as_srgb(light).reshape(1, 1, 3), len(face_indices))
                if "image" in color_source:
                    coordinates = look.coordinates(color_source, face_indices)
                    return self._shades(_Use.from_source(color_source)).colors(*coordinates)
                return look.value_colors(color_source["values"], face_indices)
        return None

    def cutout(self, number: int | None, look: MeshAppearance, face_indices: Ints) -> Cutout | None:
        """Return the mask of triangles that have a material, or None if they are opaque."""
        material = self._materials[number]
        source = material.get("opacity", {"value": 1.0})
        with self.notes.record_mask_error(material["name"]):
            if "unread" in source:
                raise MaskError(source["unread"])
            mask: Texture | Literal["glass"] | None = None
            if "image" in source:
                mask = self._mask((_Use.from_source(source), material["threshold"]))
            elif source.get("value", 0.0) < 1:
                mask = "glass"
            if mask == "glass":
                self.notes.glass[material["name"]] = None
            elif mask is not None:
                return mask.cutout(*look.coordinates(source, face_indices))
        return None

    def _image(self, number: int) -> bytes:
        """Return the content of an image.

        Raises MaskError if it cannot be read.
        """
        reason, content = self._images[number]
        if reason:
            raise MaskError(reason)
        return content

    def _read_shades(self, use: _Use) -> Texture:
        """Read an image as a texture with colors."""
        image = read_colors(self._image(use.image), self._allowance, self.notes)
        names = use.channels if use.channels == "rgb" else use.channels * 3
        tables = [as_srgb(np.nan_to_num(use.light(name))) for name in names]
        shades = [table[image[..., "rgb".index(k)]] for table, k in zip(tables, names, strict=True)]
        return Texture(np.stack(shades, axis=-1), use.wraps, self._allowance)

    def _read_mask(self, key: tuple[_Use, float]) -> Texture | Literal["glass"] | None:
        """Read an image as a mask.

        Returns "glass" if the image is opaque nowhere, and None if it is opaque everywhere.
        """
        use, threshold = key
        channel = use.channels[0]
        content = self._image(use.image)
        if channel == "a":
            opacity = read_opacity(content, self._allowance)
            opacity = np.full((1, 1), 255, np.uint8) if opacity is None else opacity
        else:
            colors = read_colors(content, self._allowance, self.notes)
            opacity = colors[..., "rgb".index(channel)]
        mask = (use.light(channel) >= (threshold or _DEFAULT_THRESHOLD))[opacity]
        if mask.all():
            return None
        if not mask.any() and not threshold:
            return "glass"
        return Texture(mask, use.wraps, self._allowance)


def material_pieces(
    frame: dict[str, Any],
    arrays: list[AnyArray],
    vertices: Floats,
    polygons: tuple[Ints, Ints, Bools],
    materials: UsdMaterials,
) -> Iterator[Piece]:
    """Triangulate polygons, and divide the triangles by material.

    `polygons` are the sizes of the polygons, the vertices at their corners, and a mask of the
    polygons that are not holes.

    Raises
    ------
    ValueError
        If `triangulate` raises it.
    """
    sizes, corners, solid = polygons
    check_corners(corners, len(vertices))
    # Use corners instead of vertices, because colors of a vertex may differ between polygons.
    solid_corners = np.flatnonzero(np.repeat(solid, sizes))
    faces = solid_corners[
        triangulate(vertices[corners[solid_corners]], np.arange(len(solid_corners)), sizes[solid])
    ]
    polygon = np.repeat(np.arange(len(sizes)), sizes)[faces]
    value_indices = {"constant": np.zeros_like(faces), "uniform": polygon, "faceVarying": faces}
    value_indices["vertex"] = value_indices["varying"] = corners[faces]
    look = MeshAppearance(frame, arrays, value_indices)
    group = np.zeros(len(sizes), np.int64)
    numbers: list[int | None] = [None]
    for number, array in frame.get("materials", ()):
        rows = np.arange(len(sizes)) if array is None else arrays[array]
        group[rows[(rows >= 0) & (rows < len(sizes))]] = len(numbers)
        numbers.append(number)
    face_groups = group[polygon[:, 0]]
    for number in np.unique(face_groups).tolist():
        rows = np.flatnonzero(face_groups == number)
        material = numbers[number]
        cutout = materials.cutout(material, look, rows)
        colors = materials.colors(material, look, rows)
        yield Piece(vertices, corners[faces[rows]], cutout, colors, materials.name(material))

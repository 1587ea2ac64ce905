"""Materials of glTF 2.0 files, with base colors and opacity masks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache, partial
from typing import Any

import numpy as np

from ...numerics.arrays import AnyArray, Bytes, Ints
from ...numerics.elementary_scalars import sin_cos_of
from ...numerics.vectors import matmul
from ..colors import LINEAR, Colors, as_srgb
from ..masks import (
    FACE_BYTES,
    MaskError,
    MaskNotes,
    Texture,
    Wrap,
    cache_with_errors,
    read_colors,
    read_opacity,
)
from .gltf_draco import DRACO
from .gltf_file import GltfFile, check_index, extension
from .polygons import check_corners
from .scene_graph import Piece, ReadOptions

_TRANSMISSION = "KHR_materials_transmission"
_GLOSSY = "KHR_materials_pbrSpecularGlossiness"  # used by older files
_CUT = ("MASK", "BLEND")  # alpha modes with transparent areas
_WRAPS: dict[Any, Wrap] = {33071: "clamp", 33648: "mirror"}


class GltfMaterials:
    """Masks, base colors and names of a file's materials.

    Each texture is created only once.
    """

    def __init__(self, file: GltfFile, options: ReadOptions) -> None:
        self._file = file
        self._allowance = file.allowance
        self.options = options
        self.notes = MaskNotes()
        self._texture = cache(self._read_texture)
        self._opacity = cache_with_errors(self._read_opacity)
        self._mask = cache_with_errors(self._read_mask)
        self._base = cache_with_errors(self._read_base)
        self._tinted = cache_with_errors(self._read_tinted)

    @property
    def have_masks(self) -> bool:
        """Whether any material has transparent areas."""
        return any(m.get("alphaMode") in _CUT for m in self._file.header.get("materials", ()))

    def with_material(self, piece: Piece, primitive: dict[str, Any], mesh: Any = None) -> Piece:
        """Return a piece with the mask, colors and material name of its primitive.

        `mesh` is the decompressed mesh if the primitive is compressed with Draco.
        """
        if self.options.materials and (number := primitive.get("material")) is not None:
            piece = piece._replace(material=self._material_name(number))
        if self.options.colors and len(piece.faces):
            with self.notes.record_color_error(self._material_name(primitive.get("material"))):
                piece = piece._replace(colors=self._face_colors(primitive, piece.faces, mesh))
        return self._with_mask(piece, primitive, mesh)

    def _face_colors(self, primitive: dict[str, Any], faces: Ints, mesh: Any) -> Colors | None:
        number = primitive.get("material")
        corners = None
        colors = None
        if not self._allowance.fits(FACE_BYTES * len(faces)):
            raise MaskError("there are too many triangles")
        if "COLOR_0" in primitive["attributes"]:
            light = self._file.normalize_integers(self._attribute("COLOR_0", primitive, mesh))
            check_corners(faces, len(light))
            if light.shape[1] < 3:
                raise MaskError("its COLOR_0 is not red, green and blue")
            corners = as_srgb(np.clip(light[:, :3], 0, 1))[faces]
            colors = Colors.from_vertex_colors(corners)
        if number is not None:
            base, info = self._base(check_index(number))
            if isinstance(base, Texture):
                colors = base.colors(self._coordinates(info, primitive, mesh), faces)
            else:
                colors = Colors.plain(base, len(faces))
        return colors and replace(colors, corners=corners)

    def _read_base(self, number: int) -> tuple[Texture | Bytes, dict[str, Any]]:
        """Return the base color texture of a material and its texture info.

        If the material has no texture, return its plain color with shape (1, 1, 3).
        """
        material = self._file.part("materials", number)
        info, factor = _base_of(material)
        light = tuple(float(np.clip(component, 0, 1)) for component in factor[:3])
        if len(light) < 3:
            raise MaskError("its factor is not red, green and blue")
        if info is None:
            return as_srgb(light).reshape(1, 1, 3), {}
        texture = self._file.part("textures", info["index"])
        return self._tinted((_image_of(texture), light, *self._wraps(texture))), info

    def _read_tinted(self, key: tuple[int, tuple[float, ...], Wrap, Wrap]) -> Texture:
        """Return the texture of a tinted image.

        Keys are tuples (image, linear tint, wrap mode along u, wrap mode along v).
        """
        image, light, wrap_u, wrap_v = key
        colors = self._file.image(image, partial(read_colors, notes=self.notes))
        if light != (1.0, 1.0, 1.0):
            scaled = [as_srgb(LINEAR * fraction) for fraction in light]
            colors = np.stack([table[colors[..., k]] for k, table in enumerate(scaled)], axis=-1)
        return Texture(colors, (wrap_u, wrap_v), self._allowance)

    def _wraps(self, texture: dict[str, Any]) -> tuple[Wrap, Wrap]:
        """Return the wrap modes of a texture along u and v."""
        sampler = self._file.part("samplers", texture["sampler"]) if "sampler" in texture else {}
        wrap_u, wrap_v = (_WRAPS.get(sampler.get(name), "repeat") for name in ("wrapS", "wrapT"))
        return wrap_u, wrap_v

    def _with_mask(self, piece: Piece, primitive: dict[str, Any], mesh: Any) -> Piece:
        number = primitive.get("material")
        if number is not None and self.options.masks and len(piece.faces):
            with self.notes.record_mask_error(self._material_name(number)):
                if mask := self._texture(number):
                    texture, info = mask
                    uv = self._coordinates(info, primitive, mesh)
                    piece = piece._replace(cutout=texture.cutout(uv, piece.faces))
        return piece

    def _material_name(self, number: Any) -> str:
        """Return the name of a material, or a name such as "material 3" if it has none."""
        try:
            name = str(self._file.part("materials", number).get("name") or "")
        except (ValueError, KeyError, IndexError, TypeError, AttributeError):
            name = ""
        return name[:80] or f"material {str(number)[:20]}"

    def _read_texture(self, number: int) -> tuple[Texture, dict[str, Any]] | None:
        """Return the mask and texture info of a material, or None if the material is opaque."""
        material = self._file.part("materials", number)
        mode = material.get("alphaMode", "OPAQUE")
        if mode not in _CUT:
            if extension(material, _TRANSMISSION).get("transmissionFactor", 0) > 0:
                self.notes.glass[self._material_name(number)] = None
            return None
        info, factor = _base_of(material)
        cutoff = material.get("alphaCutoff", 0.5) if mode == "MASK" else 0.5
        passing = np.flatnonzero(np.arange(256) / 255 * factor[3] >= cutoff)
        min_alpha = int(passing[0]) if len(passing) else 256
        texture = {} if info is None else self._file.part("textures", info["index"])
        image = -1 if info is None else _image_of(texture)
        opacity = None if info is None else self._opacity(image)
        if info is None or opacity is None or (mode == "BLEND" and opacity.max() < min_alpha):
            if min_alpha > 255 or opacity is not None:
                self.notes.glass[self._material_name(number)] = None
            return None
        if opacity.min() >= min_alpha:
            return None
        return self._mask((image, min_alpha, *self._wraps(texture))), info

    def _read_mask(self, key: tuple[int, int, Wrap, Wrap]) -> Texture:
        """Return the mask of an image.

        Keys are tuples (image, minimum alpha that blocks light, wrap mode along u, wrap mode along
        v).
        """
        image, min_alpha, wrap_u, wrap_v = key
        opacity = self._opacity(image)
        assert opacity is not None
        return Texture(opacity >= min_alpha, (wrap_u, wrap_v), self._allowance)

    def _read_opacity(self, index: int) -> Bytes | None:
        return self._file.image(index, read_opacity)

    def _coordinates(self, info: dict[str, Any], primitive: dict[str, Any], mesh: Any) -> Any:
        """Return the texture coordinates of a primitive that a texture info refers to.

        The shape is (v, 2).
        """
        transform = extension(info, "KHR_texture_transform")
        name = f"TEXCOORD_{transform.get('texCoord', info.get('texCoord', 0))}"
        if name not in primitive["attributes"]:
            raise MaskError("texture coordinates are missing")
        uv = self._attribute(name, primitive, mesh)
        if uv.shape[1] != 2:
            raise MaskError("its texture coordinates are not pairs")
        if transform:
            # KHR_texture_transform scales, rotates counterclockwise with v pointing down, and
            # then translates.
            angle = float(transform.get("rotation", 0))
            s, c = sin_cos_of(angle)
            self._allowance.reserve(32 * len(uv))
            uv = uv * np.array(transform.get("scale", (1, 1)), np.float64)
            uv = matmul(uv, [[c, -s], [s, c]]) + np.array(transform.get("offset", (0, 0)))
        return uv

    def _attribute(self, name: str, primitive: dict[str, Any], mesh: Any) -> AnyArray:
        accessor = primitive["attributes"][name]
        if mesh is None:
            return self._file.accessor(accessor)
        packed = primitive["extensions"][DRACO]["attributes"][name]
        rows = np.asarray(mesh.get_attribute_by_unique_id(packed)["data"])
        normal = self._file.part("accessors", accessor).get("normalized")
        return self._file.normalize_integers(rows) if normal else rows


def _base_of(material: dict[str, Any]) -> tuple[dict[str, Any] | None, Sequence[float]]:
    """Return the texture info and the factors of a material's base color.

    The texture info is None if the material has no texture.
    """
    usual = material.get("pbrMetallicRoughness", {})
    glossy = extension(material, _GLOSSY)
    info = usual.get("baseColorTexture") or glossy.get("diffuseTexture")
    return info, usual.get("baseColorFactor") or glossy.get("diffuseFactor") or (1, 1, 1, 1)


def _image_of(texture: dict[str, Any]) -> int:
    """Return the image index of a texture, or raise MaskError if its format is unsupported."""
    index = texture.get("source", extension(texture, "EXT_texture_webp").get("source"))
    if index is None:
        raise MaskError("its image is in a format that cannot be read")
    return check_index(index)

"""Wavefront materials, which define colors and opacity masks."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from ...io.allowance import Allowance
from ...io.input_files import InputFileError, read_input
from ...numerics.arrays import Bytes, Floats, Ints
from ...words import decode_name
from ..colors import Colors, as_bytes
from ..masks import (
    HALF_OPACITY,
    MaskNotes,
    Texture,
    Wrap,
    cache_with_errors,
    read_colors,
    read_opacity,
)
from ..scene_mesh import Cutout
from .companions import find_named_file, image_file
from .scene_graph import SMALLER, MeshFileError, ReadOptions

# Image options and their arguments. The options -o, -s and -t have one to three numbers.
_OPTION = re.compile(
    rb"\s*(-[ost])(?=\s)((?:\s+[-+.\de]+(?=\s)){0,3})|\s*(-mm)((?:\s+\S+){2})"
    rb"|\s*(-(?:blendu|blendv|boost|texres|clamp|bm|imfchan|type|cc))(\s+\S+)",
    re.IGNORECASE,
)
_WITHOUT_ALPHA = (".jpg", ".jpeg")
_MAX_BYTES = 1 << 26  # maximum size of a material file


@dataclass
class _Image:
    """A material image with the options in its statement."""

    name: str
    options: dict[bytes, list[bytes]] = field(default_factory=dict)

    @classmethod
    def parse(cls, words: bytes) -> _Image:
        """Parse the arguments of a statement, without its keyword."""
        options: dict[bytes, list[bytes]] = {}
        offset = 0
        while match := _OPTION.match(words, offset):
            key, option_words = (part for part in match.groups() if part is not None)
            options[key.lower()] = option_words.split()
            offset = match.end()
        return cls(decode_name(words[offset:].strip()), options)

    @property
    def wrap(self) -> Wrap:
        """Wrap mode beyond the edges of the image."""
        clamped = [word.lower() for word in self.options.get(b"-clamp", [])] == [b"on"]
        return "clamp" if clamped else "repeat"

    def coordinates(self, vt: Floats) -> Floats:
        """Convert texture coordinates from the file to image coordinates, in which v points down.

        Both arrays have shape (c, 2).
        """
        scale_u, scale_v = self._numbers(b"-s", 1)
        offset_u, offset_v = self._numbers(b"-o", 0)
        u = vt[:, 0] * scale_u + offset_u
        v = 1 - (vt[:, 1] * scale_v + offset_v)
        return np.column_stack([u, v])

    def _numbers(self, option: bytes, default: float) -> list[float]:
        """Return the two values of an option, replacing missing ones by a default."""
        numbers = [float(word) for word in self.options.get(option, [])]
        return (numbers + [default] * 2)[:2]


@dataclass
class _Entry:
    images: dict[bytes, _Image] = field(default_factory=dict)  # {b"map_d": image}
    color: Bytes | None = None  # uint8 (1, 1, 3)


class MtlMaterials:
    """Masks and colors of the materials in an .obj file.

    Each image is read only once. The material files are named by the `libraries` statements. Masks
    are `map_d` images, or the alpha channels of `map_Kd` images if there are none. Constant
    opacities (`d` and `Tr`) are ignored because some programs confuse the two. Colors are `map_Kd`
    images, or `Kd` if there are none. `Kd` is ignored if there is an image because some programs
    set it to black then.
    """

    def __init__(
        self, mesh: Path, size: int, libraries: Sequence[bytes], options: ReadOptions
    ) -> None:
        self.notes = MaskNotes()
        self._mesh = mesh
        self._options = options
        self._allowance = Allowance(size, SMALLER)
        self._opacity = cache_with_errors(self._read_opacity)
        self._mask = cache_with_errors(self._read_mask)
        self._image = cache_with_errors(self._read_image)
        self._entries: dict[bytes, _Entry] = {}
        for data in self._files(libraries):
            self._entries |= _read_mtl(data)

    @property
    def has_masks(self) -> bool:
        """Whether any material can have a mask, which requires texture coordinates."""
        return self._options.masks and any(
            key == b"map_d" or not image.name.lower().endswith(_WITHOUT_ALPHA)
            for entry in self._entries.values()
            for key, image in entry.images.items()
        )

    def cutout(self, name: bytes, vt: Floats, corners: Ints) -> Cutout | None:
        """Return the mask that a material applies to triangles, or None if it has no mask.

        `vt` contains texture coordinates of shape (c, 2), and `corners` contains indices into `vt`
        of shape (k, 3).
        """
        if not self._options.masks or name not in self._entries:
            return None
        with self.notes.record_mask_error(decode_name(name)):
            images = self._entries[name].images
            if texture := self._texture(decode_name(name), images):
                image = images.get(b"map_d") or images[b"map_kd"]
                return texture.cutout(image.coordinates(vt), corners)
        return None

    def colors(self, name: bytes, vt: Floats, corners: Ints, tints: Bytes | None) -> Colors | None:
        """Return the colors of triangles, or None if there are no colors.

        The colors come from the image of the material, otherwise from the vertex colors `tints`,
        otherwise from the plain color of the material.

        Parameters
        ----------
        name
            Name of the material.
        vt
            Texture coordinates. Shape (c, 2).
        corners
            Index into `vt` for each corner. Shape (k, 3).
        tints
            Vertex colors, or None. Shape (k, 3, 3).
        """
        entry = self._entries.get(name, _Entry())
        if not self._options.colors:
            return None
        colors = None
        if (image := entry.images.get(b"map_kd")) is not None:
            with self.notes.record_color_error(decode_name(name)):
                texture = self._image((image.name, image.wrap))
                colors = texture.colors(image.coordinates(vt), corners)
        elif tints is not None:
            colors = Colors.from_vertex_colors(tints)
        elif entry.color is not None:
            colors = Colors.plain(entry.color, len(corners))
        return colors

    def _files(self, libraries: Sequence[bytes]) -> Iterator[bytes]:
        """Yield the contents of the material files.

        A statement names a single file, or several files that are separated by spaces.
        """
        read: set[Path | None] = set()
        for names in map(decode_name, libraries):
            for name in [names] if self._file(names) else names.split():
                try:
                    path = find_named_file(self._mesh, name, self._options)
                except MeshFileError:
                    reason = "outside the folder of the mesh; set assets to the folder of this file"
                    self.notes.missing_files.append(f"{name} ({reason})")
                    continue
                if path not in read:
                    read.add(path)
                    try:
                        yield self._content(path)
                    except InputFileError as error:
                        self.notes.missing_files.append(f"{name} ({error.strerror})")
                    except OSError:
                        self.notes.missing_files.append(name)

    def _content(self, path: Path | None) -> bytes:
        """Read a material file, or raise OSError if it is missing or too large."""
        if path is None or path.stat().st_size > _MAX_BYTES:
            raise FileNotFoundError
        return read_input(path)

    def _file(self, name: str) -> Path | None:
        with suppress(MeshFileError):
            return find_named_file(self._mesh, name, self._options)
        return None

    def _texture(self, name: str, images: dict[bytes, _Image]) -> Texture | None:
        """Return the mask of a material, or None if the material is opaque."""
        color = images.get(b"map_kd")
        image = images.get(b"map_d", color)
        if image is None:
            return None
        if image is color and image.name.lower().endswith(_WITHOUT_ALPHA):
            return None
        # Some programs use the same image for color and opacity, so its brightness is not opacity.
        gray = image is not color and not (color and color.name == image.name)
        base, gain = map(float, image.options.get(b"-mm", (0, 1)))
        texture = self._mask((image.name, gray, base, gain, image.wrap))
        if texture == "glass":
            self.notes.glass[name] = None
        return texture if isinstance(texture, Texture) else None

    def _read_mask(
        self, key: tuple[str, bool, float, float, Wrap]
    ) -> Texture | Literal["solid", "glass"]:
        """Return the mask for a key, or 'solid' or 'glass' if the material requires no mask.

        Keys are tuples of name, whether brightness is opacity, base, gain, and wrap mode.
        """
        name, gray, base, gain, wrap = key
        opacity = self._opacity((name, gray))
        if opacity is None:
            return "solid"
        mask = np.float32(255 * base) + np.float32(gain) * opacity >= HALF_OPACITY
        if mask.all() or not mask.any():
            return "solid" if mask.all() else "glass"
        return Texture(mask, (wrap, wrap), self._allowance)

    def _read_opacity(self, key: tuple[str, bool]) -> Bytes | None:
        """Return the opacity of an image, or None if it is opaque.

        Keys are tuples of the name and whether brightness is opacity.
        """
        name, gray = key
        file = image_file(self._mesh, name, self._options, self._allowance)
        return read_opacity(file, self._allowance, gray=gray)

    def _read_image(self, key: tuple[str, Wrap]) -> Texture:
        """Return the texture of a color image.

        Keys are tuples of the name and the wrap mode.
        """
        name, wrap = key
        file = image_file(self._mesh, name, self._options, self._allowance)
        image = read_colors(file, self._allowance, self.notes)
        return Texture(image, (wrap, wrap), self._allowance)


def _read_mtl(data: bytes) -> dict[bytes, _Entry]:
    """Parse the materials in a file, keyed by name."""
    entries: dict[bytes, _Entry] = {}
    entry = _Entry()
    text = data.removeprefix(b"\xef\xbb\xbf")  # byte order mark of editors on Windows
    for line in text.replace(b"\r", b"\n").replace(b"\t", b" ").split(b"\n"):
        key, _, value = line.strip().partition(b" ")
        if key == b"newmtl":
            entry = entries.setdefault(value.strip(), _Entry())
        elif key.lower() in (b"map_d", b"map_kd") and value.strip():
            entry.images[key.lower()] = _Image.parse(value)
        elif key == b"Kd":
            with suppress(ValueError):  # the format also allows spectra, but programs use RGB
                entry.color = as_bytes([*map(float, value.split()[:3])]).reshape(1, 1, 3)
    return entries

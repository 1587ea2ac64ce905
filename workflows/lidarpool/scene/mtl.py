"""Materials of Wavefront files: colours, and images that make them transparent in places."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path, PureWindowsPath
from typing import Literal

import numpy as np

from ..base.allowance import Allowance
from ..base.arrays import Bytes, Floats, Ints
from ..base.words import as_text
from .beside import file_beside
from .colours import Colours, as_bytes
from .masks import HALF, MaskError, MaskNotes, Texture, Wrap, read_colours, read_opacity, remembered
from .mesh import Cutout
from .nodes import SMALLER, MeshFileError, Wanted

# Options of images: how many words follow each; -o, -s and -t have one to three numbers.
_OPTIONS = {
    b"-blendu": 1, b"-blendv": 1, b"-boost": 1, b"-mm": 2, b"-texres": 1, b"-clamp": 1, b"-bm": 1,
    b"-imfchan": 1, b"-type": 1, b"-cc": 1, b"-o": 3, b"-s": 3, b"-t": 3,
}  # fmt: skip
_NUMBERS = (b"-o", b"-s", b"-t")
_WITHOUT_ALPHA = (".jpg", ".jpeg")
_MOST_BYTES = 1 << 26  # of a file of materials


@dataclass
class _Image:
    """An image of a material, as a line names it."""

    name: str
    options: dict[bytes, list[bytes]] = field(default_factory=dict)

    @classmethod
    def of(cls, words: bytes) -> _Image:
        """Read the line after its first word."""
        options: dict[bytes, list[bytes]] = {}
        rest = words.strip()
        while (option := rest.split(maxsplit=1)[:1]) and option[0].lower() in _OPTIONS:
            key = option[0].lower()
            rest = rest[len(key) :].lstrip()
            given = options.setdefault(key, [])
            for _ in range(_OPTIONS[key]):
                word = next(iter(rest.split(maxsplit=1)), b"")
                if key in _NUMBERS and not re.fullmatch(rb"[-+.\deE]+", word):
                    break
                given.append(word)
                rest = rest[len(word) :].lstrip()
        return cls(as_text(rest), options)

    @property
    def wrap(self) -> Wrap:
        """How it goes on beyond its edges."""
        clamped = [word.lower() for word in self.options.get(b"-clamp", [])] == [b"on"]
        return "clamp" if clamped else "repeat"

    def numbers(self, option: bytes, usual: float) -> Floats:
        """Two numbers of an option."""
        given = [float(word) for word in self.options.get(option, [])]
        return np.array((given + [usual] * 2)[:2])


@dataclass
class _Entry:
    """What a file says of a material."""

    images: dict[bytes, _Image] = field(default_factory=dict)  # {b"map_d": image}
    colour: Bytes | None = None  # uint8 (1, 1, 3)


@dataclass
class ObjTexture:
    """The mask or the image of a material."""

    texture: Texture
    scale: Floats  # (2,)
    offset: Floats

    def cutout(self, vt: Floats, corners: Ints) -> Cutout:
        """As `Texture.cutout`, but v of the coordinates (c, 2) grows upwards."""
        return self.texture.cutout(self._turned(vt), corners)

    def colours(self, vt: Floats, corners: Ints) -> Colours:
        """As `Texture.colours`, but v of the coordinates (c, 2) grows upwards."""
        return self.texture.colours(self._turned(vt), corners)

    def _turned(self, vt: Floats) -> Floats:
        u, v = (vt * self.scale + self.offset).T
        return np.column_stack([u, 1 - v])


class Materials:
    """Masks and colours of the materials of a .obj file, each read once.

    They are in files named by the lines `libraries`. Masks are the images `map_d`, or else the
    alpha channels of `map_Kd`. Constant opacities, `d` and `Tr`, count for nothing: some programs
    write one for the other. Colours are the images `map_Kd`, or else `Kd`; with an image, `Kd`
    counts for nothing, since some programs write black there.
    """

    def __init__(
        self,
        mesh: Path,
        size: int,
        notes: MaskNotes,
        libraries: Sequence[bytes],
        wanted: Wanted,
    ) -> None:
        self._mesh, self._notes, self._wanted = mesh, notes, wanted
        self._allowance = Allowance(size, SMALLER)
        self._opacity, self._mask = remembered(self._read_opacity), remembered(self._read_mask)
        self._image = remembered(self._read_image)
        self._entries: dict[bytes, _Entry] = {}
        for data in self._files(libraries):
            self._entries |= _read_mtl(data)

    def masks(self, used: Sequence[bytes]) -> dict[bytes, ObjTexture]:
        """Masks of the used materials that have one."""
        found: dict[bytes, ObjTexture] = {}
        for name in used:
            if name in self._entries:
                with self._notes.instead(as_text(name)):
                    if texture := self._texture(as_text(name), self._entries[name].images):
                        found[name] = texture
        return found

    def colours(self, used: Sequence[bytes]) -> dict[bytes, ObjTexture | Bytes]:
        """Images or colours, (1, 1, 3), of the used materials that have one."""
        found: dict[bytes, ObjTexture | Bytes] = {}
        for name in used:
            entry = self._entries.get(name, _Entry())
            if (image := entry.images.get(b"map_kd")) is not None:
                with self._notes.without_colour(as_text(name)):
                    texture = self._image((image.name, image.wrap))
                    found[name] = _placed(texture, image)
            elif entry.colour is not None:
                found[name] = entry.colour
        return found

    def _files(self, libraries: Sequence[bytes]) -> Iterator[bytes]:
        """Content of the files that lines name: each one, or several between spaces."""
        read: set[Path | None] = set()
        for names in map(as_text, libraries):
            for name in [names] if self._file(names) else names.split():
                path = self._file(name)
                if path not in read:
                    read.add(path)
                    try:
                        yield self._content(path)
                    except OSError:
                        self._notes.gone.append(name)

    def _content(self, path: Path | None) -> bytes:
        if path is None or path.stat().st_size > _MOST_BYTES:
            raise FileNotFoundError
        return path.read_bytes()

    def _file(self, name: str) -> Path | None:
        """File of a name, or of its last part if it leads elsewhere, to another machine say."""
        paths = PureWindowsPath(name)
        for one in (name, paths.as_posix(), paths.name):
            with suppress(MeshFileError, OSError, ValueError, RuntimeError):
                if one and (found := file_beside(self._mesh, [one], self._wanted)):
                    return found
        return None

    def _texture(self, name: str, images: dict[bytes, _Image]) -> ObjTexture | None:
        colour = images.get(b"map_kd")
        image = images.get(b"map_d", colour)
        if image is None:
            return None
        if image is colour and image.name.lower().endswith(_WITHOUT_ALPHA):
            return None
        # Some programs name the same image twice: then its brightness is its colour's.
        grey = image is not colour and not (colour and colour.name == image.name)
        base, gain = map(float, image.options.get(b"-mm", (0, 1)))
        texture = self._mask((image.name, grey, base, gain, image.wrap))
        if isinstance(texture, Texture):
            return _placed(texture, image)
        if texture == "glass":
            self._notes.glass[name] = None
        return None

    def _read_mask(
        self, key: tuple[str, bool, float, float, Wrap]
    ) -> Texture | Literal["solid", "glass"]:
        """Mask of an image, or what it makes of a material."""
        name, grey, base, gain, wrap = key
        opacity = self._opacity((name, grey))
        if opacity is None:
            return "solid"
        mask = np.float32(255 * base) + np.float32(gain) * opacity >= HALF
        if mask.all() or not mask.any():
            return "solid" if mask.all() else "glass"
        return Texture(mask, (wrap, wrap), self._allowance)

    def _read_opacity(self, key: tuple[str, bool]) -> Bytes | None:
        name, grey = key
        return read_opacity(self._there(name), self._allowance, grey=grey)

    def _read_image(self, key: tuple[str, Wrap]) -> Texture:
        name, wrap = key
        image = read_colours(self._there(name), self._allowance, self._notes)
        return Texture(image, (wrap, wrap), self._allowance)

    def _there(self, name: str) -> Path:
        """File of an image."""
        path = self._file(name)
        if path is None:
            raise MaskError(f"its image {name[-80:]!r} is not there")
        self._allowance.grow(path.stat().st_size)
        return path


def _placed(texture: Texture, image: _Image) -> ObjTexture:
    return ObjTexture(texture, image.numbers(b"-s", 1), image.numbers(b"-o", 0))


def _read_mtl(data: bytes) -> dict[bytes, _Entry]:
    """Find what a file says of materials."""
    entries: dict[bytes, _Entry] = {}
    entry = _Entry()
    text = data.removeprefix(b"\xef\xbb\xbf")  # the mark of some editors on Windows
    for line in text.replace(b"\r", b"\n").replace(b"\t", b" ").split(b"\n"):
        key, _, rest = line.strip().partition(b" ")
        if key == b"newmtl":
            entry = entries.setdefault(rest.strip(), _Entry())
        elif key.lower() in (b"map_d", b"map_kd") and rest.strip():
            entry.images[key.lower()] = _Image.of(rest)
        elif key == b"Kd":
            with suppress(ValueError):  # of spectra, which nobody writes
                entry.colour = as_bytes([*map(float, rest.split()[:3])]).reshape(1, 1, 3)
    return entries

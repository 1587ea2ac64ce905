"""Images of materials: where their triangles stop light, and colours."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Hashable, Iterator
from contextlib import AbstractContextManager, contextmanager
from functools import cache
from io import BytesIO
from pathlib import Path
from typing import Literal, TypeVar

import numpy as np
from PIL import Image

from ..base.allowance import Allowance
from ..base.arrays import AnyArray, Bools, Bytes, Floats, Floats32, Ints
from ..base.input_files import InputFileError, open_input
from ..base.words import printable
from .colours import Colours
from .scene_mesh import UV_MOST, Cutout

FORMATS = ("PNG", "JPEG", "WEBP", "BMP", "GIF", "TGA")  # Pillow has more, some run programs
HALF = 128  # least 8-bit opacity that stops light, unless a file states another
PIXEL_BYTES = 10  # of an image while it is decoded
FACE_BYTES = 120  # of a triangle while its texture coordinates are made
NAMED = 3  # materials that a note names
SIDE_MOST = 4096  # pixels of an image of colours; larger ones are made smaller

Wrap = Literal["repeat", "mirror", "clamp", "black"]  # or transparent, in a mask
K = TypeVar("K", bound=Hashable)
V = TypeVar("V")


class MaskError(Exception):
    """Why a mask cannot be read, as a clause."""


def read_opacity(image: Path | bytes, allowance: Allowance, *, grey: bool = False) -> Bytes | None:
    """Opacity of an image: its alpha channel, or else, with `grey`, its brightness.

    Returns
    -------
    (h, w), 0 to 255; None if it has no alpha channel, or one that is opaque everywhere.

    Raises
    ------
    MaskError
        If it cannot be decoded, or takes more than allowed.
    """
    with _opened(image) as opened:
        if not (grey or opened.has_transparency_data):
            return None
        pixels = opened.width * opened.height
        if not allowance.fits(PIXEL_BYTES * pixels):
            raise _TooLargeError
        allowance.take(pixels)
        if opened.has_transparency_data:
            whole = opened if "A" in opened.getbands() else opened.convert("RGBA")
            alpha = np.asarray(whole.getchannel("A"))
            if alpha.min() < 255:
                return alpha
        return np.asarray(_of_bytes(opened).convert("L")) if grey else None


def read_colours(image: Path | bytes, allowance: Allowance, notes: MaskNotes) -> Bytes:
    """Colours of an image: (h, w, 3), sRGB.

    It is made smaller if it is more than `SIDE_MOST` wide or high, and noted.

    Raises
    ------
    MaskError
        As `read_opacity`.
    """
    with _opened(image) as opened:
        if not allowance.fits(PIXEL_BYTES * opened.width * opened.height):
            raise _TooLargeError
        made = _of_bytes(opened).convert("RGB")
        if max(made.size) > SIDE_MOST:
            notes.large.append(f"{made.width:,} x {made.height:,}")
            made.thumbnail((SIDE_MOST, SIDE_MOST), Image.Resampling.BOX)
        allowance.take(3 * made.width * made.height)
        return np.asarray(made)


@contextmanager
def _opened(image: Path | bytes) -> Iterator[Image.Image]:
    """Open an image; MaskError for whatever is wrong with it, also in the body."""
    name = image.name if isinstance(image, Path) else "its image"
    try:
        # Pillow warns of images that it reads all the same, and of those that are too large.
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            with (
                open_input(image) if isinstance(image, Path) else BytesIO(image) as source,
                Image.open(source, formats=FORMATS) as opened,
            ):
                yield opened
    except Image.UnidentifiedImageError as error:
        raise MaskError(f"{name} is no {', '.join(FORMATS)}") from error
    except (Image.DecompressionBombError, Image.DecompressionBombWarning, _TooLargeError) as error:
        raise MaskError(f"{name} has too many pixels") from error
    except InputFileError as error:
        raise MaskError(f"{name} is no image: {error.strerror}") from error
    except Exception as error:
        # Decoders raise whatever they stumble over: OSError, SyntaxError, struct.error, …
        raise MaskError(f"{name} cannot be decoded") from error


class _TooLargeError(Exception):
    pass


def remembered(read: Callable[[K], V]) -> Callable[[K], V]:
    """Cache a function, and its MaskErrors."""

    @cache
    def tried(key: K) -> V | MaskError:
        try:
            return read(key)
        except MaskError as error:
            return error

    def once(key: K) -> V:
        found = tried(key)
        if isinstance(found, MaskError):
            raise MaskError(str(found))
        return found

    return once


def _of_bytes(image: Image.Image) -> Image.Image:
    """Image of 8 bits from one of 16, which Pillow would clip."""
    if not image.mode.startswith("I;16"):
        return image
    return Image.fromarray((np.asarray(image) >> 8).astype(np.uint8))


class Texture:
    """A mask or an image, and how it goes on beyond its edges, along u and along v.

    Materials should share it, since every one takes memory.

    Raises
    ------
    MaskError
        If it takes more than allowed.
    """

    def __init__(
        self, image: Bools | Bytes, wraps: tuple[Wrap, Wrap], allowance: Allowance
    ) -> None:
        self._wraps = wraps
        self._allowance = allowance
        _take(allowance, image.size)
        for axis, wrap in zip((1, 0), wraps, strict=True):
            if wrap == "mirror":  # repeats with its mirror image
                _take(allowance, 2 * image.size)
                image = np.concatenate([image, np.flip(image, axis)], axis)
        self._image = image

    def cutout(self, coordinates: AnyArray, corners: Ints) -> Cutout:
        """Cut it out of triangles, see `on`."""
        return Cutout(*self.on(coordinates, corners))

    def colours(self, coordinates: AnyArray, corners: Ints) -> Colours:
        """Colour triangles with it, see `on`."""
        image, uv = self.on(coordinates, corners)
        return Colours((image,), np.zeros(len(uv), np.int32), uv)

    def on(self, coordinates: AnyArray, corners: Ints) -> tuple[AnyArray, Floats32]:
        """Put it on triangles, as in glTF.

        `coordinates` are (c, 2), and `corners` (k, 3) which of them each triangle has. Returns it
        such that it repeats, and texture coordinates (k, 3, 2).

        Raises
        ------
        MaskError
            If they are missing, infinite, too large, or too far beyond a mask that does not repeat.
        """
        if not len(coordinates) or not 0 <= corners.min() <= corners.max() < len(coordinates):
            raise MaskError("texture coordinates are missing")
        if not self._allowance.fits(FACE_BYTES * len(corners)):
            raise MaskError("there are too many triangles")
        uv = coordinates[corners].astype(np.float64)
        if not (np.abs(uv) < UV_MOST / 2).all():  # half, for what rounding adds
            raise MaskError("texture coordinates are infinite or too large")
        image = self._image
        for column, wrap in enumerate(self._wraps):
            if wrap == "mirror":
                uv[..., column] /= 2
            elif wrap != "repeat":
                image = self._continued(image, uv[..., column], 1 - column, wrap == "black")
        return image, uv.astype(np.float32)

    def _continued(self, image: AnyArray, places: Floats, axis: int, black: bool) -> AnyArray:
        """Continue an image as far as `places` (k, 3), which are changed, ask for it.

        By its edges, or black. A hundredth of a texel is the rounding of a program.
        """
        size = image.shape[axis]
        slack = 0.01 / size
        places[(places > -slack) & (places < 0)] = 0
        places[(places > 1) & (places < 1 + slack)] = 1
        # Triangles wholly beyond an edge are in its last texels, or the first ones beyond.
        most = places.max(axis=1)
        least = places.min(axis=1)
        places[most <= 0] = 0.5 / size
        places[least >= 1] = 1 - 0.5 / size
        if black:
            places[most < 0] = -0.5 / size
            places[least > 1] = 1 + 0.5 / size
        before = max(0, int(np.ceil(-places.min() * size)))
        after = max(0, int(np.ceil((places.max() - 1) * size)))
        if not before and not after:
            return image
        whole = size + before + after
        _take(self._allowance, image.size // size * whole)
        widths = [(0, 0)] * image.ndim
        widths[axis] = before, after
        places *= size / whole
        places += before / whole
        return np.pad(image, widths, mode="constant" if black else "edge")


def _take(allowance: Allowance, count: int) -> None:
    if not allowance.fits(count):
        raise MaskError("its image would be too large")
    allowance.take(count)


class MaskNotes:
    """What the materials of a file have that is no mask or colour, by their names."""

    def __init__(self) -> None:
        self.unread: dict[str, str] = {}  # {material: why its triangles are solid}
        self.grey: dict[str, str] = {}  # {material: why its triangles have no colour}
        self.glass: dict[str, None] = {}  # in order
        self.large: list[str] = []  # sizes of images of colours that are made smaller
        self.gone: list[str] = []  # files of materials that are not there

    def instead(self, material: str) -> AbstractContextManager[None]:
        """Note errors within a `with` block; the triangles can be read all the same."""
        return _noted(self.unread, material)

    def without_colour(self, material: str) -> AbstractContextManager[None]:
        """Note errors within a `with` block; the triangles have no colour then."""
        return _noted(self.grey, material)

    def lines(self) -> list[str]:
        """Return notes, as clauses that follow the file's name."""
        out = []
        if self.gone:
            out.append(f"names materials in {_some(self.gone)}, which cannot be read: all is solid")
        for found, what, so in (
            (self.unread, "masks", "are solid"), (self.grey, "colours", "lack them")
        ):  # fmt: skip
            if found:
                shown = _some([f"{name} ({why})" for name, why in found.items()])
                out.append(f"has {what} that cannot be read, so that these materials {so}: {shown}")
        if self.large:
            sizes = _some(self.large)
            out.append(f"has images of {sizes} pixels, taken at {SIDE_MOST:,} at most on a side")
        if self.glass:
            out.append(
                f"has transparent materials without holes, taken as solid: {_some([*self.glass])}; "
                '<materials.transparent="pass"> makes objects glass'
            )
        return out


@contextmanager
def _noted(unread: dict[str, str], material: str) -> Iterator[None]:
    """Note errors as what is wrong with a material."""
    try:
        yield
    except MaskError as error:
        unread.setdefault(material, str(error))
    except Exception:
        unread.setdefault(material, "it is broken")


def _some(names: list[str]) -> str:
    return ", ".join(printable(name) for name in names[:NAMED]) + ", …" * (len(names) > NAMED)

"""Images of materials: masks, which say where triangles stop light, and colors."""

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

from ..io.allowance import Allowance
from ..io.input_files import InputFileError, open_input
from ..numerics.arrays import AnyArray, Bools, Bytes, Floats, Floats32, Ints
from ..words import printable
from .colors import Colors
from .scene_mesh import MAX_UV, Cutout

# Further formats of Pillow are left out, since some run programs.
FORMATS = ("PNG", "JPEG", "WEBP", "BMP", "GIF", "TGA")
HALF_OPACITY = 128  # least 8-bit opacity that stops light, unless a file states a cutoff
PIXEL_BYTES = 10  # memory of a pixel while its image is decoded
FACE_BYTES = 120  # memory of a triangle while its texture coordinates are computed
_MAX_NAMED = 3  # materials that a note names
MAX_SIDE_PIXELS = 4096  # width and height of an image of colors; larger images are reduced

Wrap = Literal["repeat", "mirror", "clamp", "black"]  # or transparent, in a mask
K = TypeVar("K", bound=Hashable)
V = TypeVar("V")


class MaskError(Exception):
    """The reason why a mask cannot be read, as a clause."""


def read_opacity(image: Path | bytes, allowance: Allowance, *, gray: bool = False) -> Bytes | None:
    """Return the opacity of an image: its alpha channel, or else, with `gray`, its brightness.

    Returns
    -------
    (h, w), 0 to 255; None without an alpha channel, or if it is opaque everywhere.

    Raises
    ------
    MaskError
        If the image cannot be decoded, or takes more memory than allowed.
    """
    with _opened(image) as opened:
        if not (gray or opened.has_transparency_data):
            return None
        pixels = opened.width * opened.height
        if not allowance.fits(PIXEL_BYTES * pixels):
            raise _TooLargeError
        allowance.take(pixels)
        if opened.has_transparency_data:
            rgba = opened if "A" in opened.getbands() else opened.convert("RGBA")
            alpha = np.asarray(rgba.getchannel("A"))
            if alpha.min() < 255:
                return alpha
        return np.asarray(_of_bytes(opened).convert("L")) if gray else None


def read_colors(image: Path | bytes, allowance: Allowance, notes: MaskNotes) -> Bytes:
    """Return the colors of an image: (h, w, 3), sRGB.

    An image that is more than `MAX_SIDE_PIXELS` wide or high is reduced, which `notes` records.

    Raises
    ------
    MaskError
        If the image cannot be decoded, or takes more memory than allowed.
    """
    with _opened(image) as opened:
        if not allowance.fits(PIXEL_BYTES * opened.width * opened.height):
            raise _TooLargeError
        rgb = _of_bytes(opened).convert("RGB")
        if max(rgb.size) > MAX_SIDE_PIXELS:
            notes.reduced_sizes.append(f"{rgb.width:,} x {rgb.height:,}")
            rgb.thumbnail((MAX_SIDE_PIXELS, MAX_SIDE_PIXELS), Image.Resampling.BOX)
        allowance.take(3 * rgb.width * rgb.height)
        return np.asarray(rgb)


def read_heights(image: Path, allowance: Allowance, bytes_per_pixel: int) -> Floats:
    """Return the brightness of an image, a height map: float64 (h, w), from 0 up.

    Memory for `bytes_per_pixel` more, for the mesh that is made of the pixels, is taken from the
    allowance before the image is decoded.

    Raises
    ------
    MaskError
        If the image cannot be decoded, or takes more memory than allowed.
    """
    with _opened(image) as opened:
        pixels = opened.width * opened.height
        if not allowance.fits((PIXEL_BYTES + bytes_per_pixel) * pixels):
            raise _TooLargeError
        allowance.take((8 + bytes_per_pixel) * pixels)
        is_gray = opened.mode in ("L", "I", "F") or opened.mode.startswith("I;16")
        values = np.asarray(opened if is_gray else opened.convert("L"), np.float64)
    if not np.isfinite(values).all() or values.min() < 0:
        raise MaskError(f"{image.name} has no height channel")
    return values


@contextmanager
def _opened(image: Path | bytes) -> Iterator[Image.Image]:
    """Open an image for the body.

    Raises MaskError for all errors, those in the body included.
    """
    name = image.name if isinstance(image, Path) else "its image"
    try:
        # Pillow warns of images that it reads all the same, and of images that are too large.
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            with (
                open_input(image) if isinstance(image, Path) else BytesIO(image) as source,
                Image.open(source, formats=FORMATS) as opened,
            ):
                yield opened
    except Image.UnidentifiedImageError as error:
        raise MaskError(
            f"{name} is not a {', '.join(FORMATS[:-1])} or {FORMATS[-1]} image"
        ) from error
    except (Image.DecompressionBombError, Image.DecompressionBombWarning, _TooLargeError) as error:
        raise MaskError(f"{name} has too many pixels") from error
    except InputFileError as error:
        raise MaskError(f"{name} cannot be read: {error.strerror}") from error
    except Exception as error:
        # Decoders raise errors of any class: OSError, SyntaxError, struct.error, …
        raise MaskError(f"{name} cannot be decoded") from error


class _TooLargeError(Exception):
    pass


def remembered(read: Callable[[K], V]) -> Callable[[K], V]:
    """Cache a function, and its MaskErrors."""

    @cache
    def result_or_error(key: K) -> V | MaskError:
        try:
            return read(key)
        except MaskError as error:
            return error

    def read_once(key: K) -> V:
        result = result_or_error(key)
        if isinstance(result, MaskError):
            raise MaskError(str(result))
        return result

    return read_once


def _of_bytes(image: Image.Image) -> Image.Image:
    """Return an image of 8 bits, while Pillow would clip an image of 16 bits."""
    if not image.mode.startswith("I;16"):
        return image
    return Image.fromarray((np.asarray(image) >> 8).astype(np.uint8))


class Texture:
    """A mask or an image, and its continuation beyond the edges, along u and along v.

    Materials should share textures, since each texture takes memory.

    Raises
    ------
    MaskError
        If the texture takes more memory than allowed.
    """

    def __init__(
        self, image: Bools | Bytes, wraps: tuple[Wrap, Wrap], allowance: Allowance
    ) -> None:
        self._wraps = wraps
        self._allowance = allowance
        _take(allowance, image.size)
        for axis, wrap in zip((1, 0), wraps, strict=True):
            if wrap == "mirror":  # the image and its mirror image repeat
                _take(allowance, 2 * image.size)
                image = np.concatenate([image, np.flip(image, axis)], axis)
        self._image = image

    def cutout(self, coordinates: AnyArray, corners: Ints) -> Cutout:
        """Return the texture as the mask of triangles (`map_to_triangles`)."""
        return Cutout(*self.map_to_triangles(coordinates, corners))

    def colors(self, coordinates: AnyArray, corners: Ints) -> Colors:
        """Return the texture as the colors of triangles (`map_to_triangles`)."""
        image, uv = self.map_to_triangles(coordinates, corners)
        return Colors((image,), np.zeros(len(uv), np.int32), uv)

    def map_to_triangles(self, coordinates: AnyArray, corners: Ints) -> tuple[AnyArray, Floats32]:
        """Return a repeating image, and texture coordinates (k, 3, 2), as in glTF.

        Parameters
        ----------
        coordinates
            Texture coordinates (c, 2).
        corners
            (k, 3): rows of `coordinates` of the corners of each triangle.

        Raises
        ------
        MaskError
            If texture coordinates are missing, infinite, too large, or too far beyond an image that
            does not repeat.
        """
        if not len(coordinates) or not 0 <= corners.min() <= corners.max() < len(coordinates):
            raise MaskError("texture coordinates are missing")
        if not self._allowance.fits(FACE_BYTES * len(corners)):
            raise MaskError("there are too many triangles")
        uv = coordinates[corners].astype(np.float64)
        if not (np.abs(uv) < MAX_UV / 2).all():  # half, for what rounding adds
            raise MaskError("texture coordinates are infinite or too large")
        image = self._image
        for column, wrap in enumerate(self._wraps):
            if wrap == "mirror":
                uv[..., column] /= 2
            elif wrap != "repeat":
                image = self._continued(image, uv[..., column], 1 - column, wrap == "black")
        return image, uv.astype(np.float32)

    def _continued(self, image: AnyArray, coordinates: Floats, axis: int, black: bool) -> AnyArray:
        """Continue an image, by its edges or black, up to all coordinates (k, 3).

        The coordinates are changed to fit the continued image. They may exceed the image by a
        hundredth of a texel, which is the rounding of programs.
        """
        size = image.shape[axis]
        slack = 0.01 / size
        coordinates[(coordinates > -slack) & (coordinates < 0)] = 0
        coordinates[(coordinates > 1) & (coordinates < 1 + slack)] = 1
        # Triangles wholly beyond an edge are in its last texels, or the first texels beyond.
        upper = coordinates.max(axis=1)
        lower = coordinates.min(axis=1)
        coordinates[upper <= 0] = 0.5 / size
        coordinates[lower >= 1] = 1 - 0.5 / size
        if black:
            coordinates[upper < 0] = -0.5 / size
            coordinates[lower > 1] = 1 + 0.5 / size
        texels_before = max(0, int(np.ceil(-coordinates.min() * size)))
        texels_after = max(0, int(np.ceil((coordinates.max() - 1) * size)))
        if not texels_before and not texels_after:
            return image
        continued_size = size + texels_before + texels_after
        _take(self._allowance, image.size // size * continued_size)
        widths = [(0, 0)] * image.ndim
        widths[axis] = texels_before, texels_after
        coordinates *= size / continued_size
        coordinates += texels_before / continued_size
        return np.pad(image, widths, mode="constant" if black else "edge")


def _take(allowance: Allowance, count: int) -> None:
    """Take bytes of an image from the allowance.

    Raises MaskError if the image is too large.
    """
    if not allowance.fits(count):
        raise MaskError("its image would be too large")
    allowance.take(count)


class MaskNotes:
    """Notes on masks and colors of a file's materials that are not read as stated."""

    def __init__(self) -> None:
        self.mask_errors: dict[str, str] = {}  # {material: why its triangles are solid}
        self.color_errors: dict[str, str] = {}  # {material: why its triangles have no color}
        self.glass: dict[str, None] = {}  # {transparent material without holes: None}, in order
        self.reduced_sizes: list[str] = []  # sizes of images of colors that are reduced
        self.missing_files: list[str] = []  # files of materials that cannot be read

    def without_mask(self, material: str) -> AbstractContextManager[None]:
        """Note MaskErrors of the body, and leave the triangles solid then."""
        return _noted(self.mask_errors, material)

    def without_color(self, material: str) -> AbstractContextManager[None]:
        """Note errors of the body, and leave the triangles without color then."""
        return _noted(self.color_errors, material)

    def lines(self) -> list[str]:
        """Return notes, as clauses that follow the file's name."""
        notes = []
        if self.missing_files:
            files = _listed(self.missing_files)
            notes.append(
                f"refers to materials in {files}, which cannot be read. All surfaces are opaque"
            )
        for reasons, kind, consequence in (
            (self.mask_errors, "masks", "are opaque"),
            (self.color_errors, "colors", "have no color"),
        ):
            if reasons:
                shown = _listed([f"{name} ({why})" for name, why in reasons.items()])
                notes.append(
                    f"has {kind} that cannot be read, so these materials {consequence}: {shown}"
                )
        if self.reduced_sizes:
            sizes = _listed(self.reduced_sizes)
            notes.append(
                f"has images of {sizes} pixels, which are reduced to at most {MAX_SIDE_PIXELS:,} "
                "pixels per side"
            )
        if self.glass:
            names = _listed([*self.glass])
            notes.append(
                f"has transparent materials without holes, which are treated as opaque: {names}. "
                "For "
                'glass, use <materials.transparent="pass">'
            )
        return notes


@contextmanager
def _noted(reasons: dict[str, str], material: str) -> Iterator[None]:
    """Note errors of the body in `reasons` of materials: the first of each material."""
    try:
        yield
    except MaskError as error:
        reasons.setdefault(material, str(error))
    except Exception:
        reasons.setdefault(material, "it is invalid")


def _listed(names: list[str]) -> str:
    """Return the first names in a row, with an ellipsis for the rest."""
    return ", ".join(printable(name) for name in names[:_MAX_NAMED]) + ", …" * (
        len(names) > _MAX_NAMED
    )

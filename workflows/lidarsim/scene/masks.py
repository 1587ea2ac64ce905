"""Material images, which provide colors and opacity masks."""

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

# Other formats of Pillow are excluded because decoding some of them runs external programs.
FORMATS = ("PNG", "JPEG", "WEBP", "BMP", "GIF", "TGA")
HALF_OPACITY = 128  # minimum 8-bit opacity that blocks light, unless the file specifies a cutoff
PIXEL_BYTES = 10  # memory of a pixel while its image is decoded
FACE_BYTES = 120  # memory of a triangle while its texture coordinates are computed
_MAX_NAMED = 3  # maximum number of materials listed in a note
MAX_SIDE_PIXELS = 4096  # maximum width and height of color images; larger images are downscaled

Wrap = Literal["repeat", "mirror", "clamp", "black"]  # black is transparent in a mask
K = TypeVar("K", bound=Hashable)
V = TypeVar("V")


class MaskError(Exception):
    """An error whose message is a clause that explains why an image cannot be read."""


def read_opacity(image: Path | bytes, allowance: Allowance, *, gray: bool = False) -> Bytes | None:
    """Return the opacity of an image from its alpha channel.

    If `gray` is set, the brightness of an image becomes its opacity if the image has no alpha
    channel or is opaque everywhere. Otherwise, the result is None for such images.

    Returns
    -------
    Bytes or None
        Opacity from 0 to 255. Shape (h, w).

    Raises
    ------
    MaskError
        If the image cannot be decoded or requires more memory than allowed.
    """
    with _open_image(image) as opened:
        if not (gray or opened.has_transparency_data):
            return None
        pixels = opened.width * opened.height
        if not allowance.fits(PIXEL_BYTES * pixels):
            raise _TooLargeError
        allowance.reserve(pixels)
        if opened.has_transparency_data:
            rgba = opened if "A" in opened.getbands() else opened.convert("RGBA")
            alpha = np.asarray(rgba.getchannel("A"))
            if alpha.min() < 255:
                return alpha
        return np.asarray(_as_8_bit(opened).convert("L")) if gray else None


def read_colors(image: Path | bytes, allowance: Allowance, notes: MaskNotes) -> Bytes:
    """Return the sRGB colors of an image.

    An image that is more than `MAX_SIDE_PIXELS` wide or high is downscaled, which is recorded in
    `notes`. The shape is (h, w, 3).

    Raises
    ------
    MaskError
        If the image cannot be decoded or requires more memory than allowed.
    """
    with _open_image(image) as opened:
        if not allowance.fits(PIXEL_BYTES * opened.width * opened.height):
            raise _TooLargeError
        rgb = _as_8_bit(opened).convert("RGB")
        if max(rgb.size) > MAX_SIDE_PIXELS:
            notes.reduced_sizes.append(f"{rgb.width:,} x {rgb.height:,}")
            rgb.thumbnail((MAX_SIDE_PIXELS, MAX_SIDE_PIXELS), Image.Resampling.BOX)
        allowance.reserve(3 * rgb.width * rgb.height)
        return np.asarray(rgb)


def read_heights(image: Path, allowance: Allowance, bytes_per_pixel: int) -> Floats:
    """Return the brightness of a height map.

    Values are nonnegative. The shape is (h, w), and the type is float64. Before the image is
    decoded, memory for the result and for another `bytes_per_pixel` bytes per pixel is deducted
    from the allowance. The additional bytes are for the mesh that is created from the pixels.

    Raises
    ------
    MaskError
        If the image cannot be decoded or requires more memory than allowed.
    """
    with _open_image(image) as opened:
        pixels = opened.width * opened.height
        if not allowance.fits((PIXEL_BYTES + bytes_per_pixel) * pixels):
            raise _TooLargeError
        allowance.reserve((8 + bytes_per_pixel) * pixels)
        is_gray = opened.mode in ("L", "I", "F") or opened.mode.startswith("I;16")
        values = np.asarray(opened if is_gray else opened.convert("L"), np.float64)
    if not np.isfinite(values).all() or values.min() < 0:
        raise MaskError(f"{image.name} has no height channel")
    return values


@contextmanager
def _open_image(image: Path | bytes) -> Iterator[Image.Image]:
    """Open an image, converting all errors to MaskError.

    Errors in the body of the context are converted too.
    """
    name = image.name if isinstance(image, Path) else "its image"
    try:
        # Pillow warns about images that it can read nevertheless, and about images that are too
        # large.
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
        # Decoders raise errors of many classes, such as OSError, SyntaxError and struct.error.
        raise MaskError(f"{name} cannot be decoded") from error


class _TooLargeError(Exception):
    pass


def cache_with_errors(read: Callable[[K], V]) -> Callable[[K], V]:
    """Cache the results of a function and its MaskErrors."""

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


def _as_8_bit(image: Image.Image) -> Image.Image:
    """Convert an image with 16 bits per channel to 8 bits.

    Pillow would clip the values.
    """
    if not image.mode.startswith("I;16"):
        return image
    return Image.fromarray((np.asarray(image) >> 8).astype(np.uint8))


class Texture:
    """A mask or a color image that continues beyond its edges along u and v.

    Each texture requires memory, so materials should share textures.

    Raises
    ------
    MaskError
        If the texture requires more memory than allowed.
    """

    def __init__(
        self, image: Bools | Bytes, wraps: tuple[Wrap, Wrap], allowance: Allowance
    ) -> None:
        self._wraps = wraps
        self._allowance = allowance
        _deduct(allowance, image.size)
        for axis, wrap in zip((1, 0), wraps, strict=True):
            if wrap == "mirror":  # the image and its mirror image repeat alternately
                _deduct(allowance, 2 * image.size)
                image = np.concatenate([image, np.flip(image, axis)], axis)
        self._image = image

    def cutout(self, coordinates: AnyArray, corners: Ints) -> Cutout:
        """Create the mask that results from mapping the texture to triangles.

        `map_to_triangles` describes the parameters.
        """
        return Cutout(*self.map_to_triangles(coordinates, corners))

    def colors(self, coordinates: AnyArray, corners: Ints) -> Colors:
        """Create the colors that result from mapping the texture to triangles.

        `map_to_triangles` describes the parameters.
        """
        image, uv = self.map_to_triangles(coordinates, corners)
        return Colors((image,), np.zeros(len(uv), np.int32), uv)

    def map_to_triangles(self, coordinates: AnyArray, corners: Ints) -> tuple[AnyArray, Floats32]:
        """Return a repeating image and the texture coordinates of triangle corners.

        Coordinates are defined as in glTF. Their shape is (k, 3, 2).

        Parameters
        ----------
        coordinates
            Texture coordinates. Shape (c, 2).
        corners
            Index into `coordinates` for each corner of each triangle. Shape (k, 3).

        Raises
        ------
        MaskError
            If texture coordinates are missing, infinite, too large, or too far outside an image
            that does not repeat.
        """
        if not len(coordinates) or not 0 <= corners.min() <= corners.max() < len(coordinates):
            raise MaskError("texture coordinates are missing")
        if not self._allowance.fits(FACE_BYTES * len(corners)):
            raise MaskError("there are too many triangles")
        uv = coordinates[corners].astype(np.float64)
        if not (np.abs(uv) < MAX_UV / 2).all():  # half, since rounding can increase the values
            raise MaskError("texture coordinates are infinite or too large")
        image = self._image
        for column, wrap in enumerate(self._wraps):
            if wrap == "mirror":
                uv[..., column] /= 2
            elif wrap != "repeat":
                image = self._extend(image, uv[..., column], 1 - column, wrap == "black")
        return image, uv.astype(np.float32)

    def _extend(self, image: AnyArray, coordinates: Floats, axis: int, black: bool) -> AnyArray:
        """Extend an image with its edges or with black until it covers all texture coordinates.

        The coordinates are modified in place to match the extended image. Their shape is (k, 3).
        Coordinates up to a hundredth of a texel outside the image are moved to its edge, because
        programs round texture coordinates.
        """
        size = image.shape[axis]
        slack = 0.01 / size
        coordinates[(coordinates > -slack) & (coordinates < 0)] = 0
        coordinates[(coordinates > 1) & (coordinates < 1 + slack)] = 1
        # Triangles entirely beyond an edge use the texels at the edge, or the black texels next to
        # it.
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
        _deduct(self._allowance, image.size // size * continued_size)
        widths = [(0, 0)] * image.ndim
        widths[axis] = texels_before, texels_after
        coordinates *= size / continued_size
        coordinates += texels_before / continued_size
        return np.pad(image, widths, mode="constant" if black else "edge")


def _deduct(allowance: Allowance, count: int) -> None:
    """Deduct bytes from the allowance, or raise MaskError if too few are left."""
    if not allowance.fits(count):
        raise MaskError("its image would be too large")
    allowance.reserve(count)


class MaskNotes:
    """Notes about masks and colors that are not read as the file specifies."""

    def __init__(self) -> None:
        self.mask_errors: dict[str, str] = {}  # {material: why its triangles are opaque}
        self.color_errors: dict[str, str] = {}  # {material: why its triangles have no color}
        self.glass: dict[str, None] = {}  # transparent materials without holes, as an ordered set
        self.reduced_sizes: list[str] = []  # original sizes of downscaled color images
        self.missing_files: list[str] = []  # material files that cannot be read

    def record_mask_error(self, material: str) -> AbstractContextManager[None]:
        """Record mask errors in the context instead of raising them.

        The triangles of the material become opaque.
        """
        return _record_error(self.mask_errors, material)

    def record_color_error(self, material: str) -> AbstractContextManager[None]:
        """Record color errors in the context instead of raising them.

        The colors of the material are ignored.
        """
        return _record_error(self.color_errors, material)

    def lines(self) -> list[str]:
        """Return the notes as clauses that follow the file name."""
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
def _record_error(reasons: dict[str, str], material: str) -> Iterator[None]:
    """Record errors in the context, unless an error is already recorded for the material."""
    try:
        yield
    except MaskError as error:
        reasons.setdefault(material, str(error))
    except Exception:
        reasons.setdefault(material, "it is invalid")


def _listed(names: list[str]) -> str:
    """Join the first names with commas, adding an ellipsis if there are more."""
    return ", ".join(printable(name) for name in names[:_MAX_NAMED]) + ", …" * (
        len(names) > _MAX_NAMED
    )

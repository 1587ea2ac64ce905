"""Materials by the names of objects, energies of returns, weather."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase, translate
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from ..base.arguments import checked_fields
from ..base.declared import Share, TextOrTexts, written_as
from ..base.errors import LidarpoolError
from ..base.words import did_you_mean

REFERENCE_M = 10.0  # energy is 1 for a white surface hit at right angles from here
REFLECTANCE = 0.5  # default reflectance: between asphalt (0.1 to 0.2) and white paint (0.8)
# Engineer grade sheeting, ASTM D4956 type I white: 70 cd/lx/m², of a white diffuser 1/π.
RETRO_GAIN = 220.0
GLASS_INDEX = 1.5
NEAREST_M = 1e-3  # energies do not grow below this distance

SemanticClass = Annotated[int, Field(ge=0, le=65_535)]
Transparent = Literal["none", "pass", "mirror"]


@dataclass(frozen=True)
@checked_fields
class Material:
    """Material of objects; the last entry for an object counts.

    Reflectance is that at the sensor's wavelength, in all directions. Of light that is not
    scattered, "pass" reflects what glass reflects; with "none" it is lost.

    Raises
    ------
    LidarpoolError
        If a value is outside its range.
    """

    objects: Annotated[
        str | Sequence[str],
        written_as(TextOrTexts),
        Field(min_length=1, description="names of objects, with * and ?"),
    ]
    reflectance: Annotated[
        Share | None,
        Field(
            description="share of light that is scattered; by default 0.5, for glass and mirrors 0"
        ),
    ] = None
    semantic_class: Annotated[
        SemanticClass, Field(alias="class", description="value of the column class")
    ] = 0
    retro: Annotated[
        bool, Field(description="whether light returns in its own direction, as from traffic signs")
    ] = False
    transparent: Annotated[
        Transparent,
        Field(description="the rest of the light passes through (pass), or is reflected (mirror)"),
    ] = "none"

    def __post_init__(self) -> None:
        names = (self.objects,) if isinstance(self.objects, str) else tuple(self.objects)
        if not all(names):
            raise LidarpoolError(f"objects is {self.objects!r}; it must be names of objects.")
        object.__setattr__(self, "objects", names)

    def named(self, name: str) -> bool:
        """Whether this material applies to an object."""
        return any(name == pattern or fnmatchcase(name, pattern) for pattern in self.objects)


def rows_named(pattern: str, names: Sequence[str]) -> NDArray[np.intp]:
    """Rows of names that are a name, or fit it as a pattern with * and ?."""
    if not any(sign in pattern for sign in "*?["):
        return np.array([row for row, name in enumerate(names) if name == pattern], np.intp)
    fits = re.compile(translate(pattern)).match
    return np.array([r for r, name in enumerate(names) if name == pattern or fits(name)], np.intp)


@dataclass(frozen=True, eq=False)
class MaterialTable:
    """Materials of objects: each array has one value for each."""

    reflectance: NDArray[np.float64]
    retro: NDArray[np.bool_]
    passes: NDArray[np.bool_]
    mirrors: NDArray[np.bool_]
    semantic_class: NDArray[np.uint16]

    @classmethod
    def of(cls, materials: Sequence[Material], names: Sequence[str]) -> MaterialTable:
        """Find the materials of objects by name: the last that names an object counts.

        Raises
        ------
        LidarpoolError
            If a name fits no object, or there are materials and an object has none.
        """
        last = np.full(len(names), -1)  # for each object the last material that names it
        for number, material in enumerate(materials):
            for pattern in material.objects:
                rows = rows_named(pattern, names)
                if not len(rows):
                    raise LidarpoolError(
                        f"materials names {pattern!r}, but no object has that name."
                        + (did_you_mean(pattern, names) or f" There are {', '.join(names[:5])}, …")
                    )
                last[rows] = number
        without = np.flatnonzero(last < 0)
        if len(without) and materials:
            more = f" and {len(without) - 1} more" if without[1:].size else ""
            raise LidarpoolError(
                f"materials: no entry names the object {names[without[0]]!r}{more}: begin with one "
                'for all the others, such as {objects: "*"}.'
            )
        found = [*materials, Material("*")]  # the last is of all, if there are no materials
        scattered = [
            (REFLECTANCE if m.transparent == "none" else 0.0) if m.reflectance is None
            else m.reflectance
            for m in found
        ]  # fmt: skip
        return cls(
            np.array(scattered, np.float64)[last],
            np.array([m.retro for m in found], np.bool_)[last],
            np.array([m.transparent == "pass" for m in found], np.bool_)[last],
            np.array([m.transparent == "mirror" for m in found], np.bool_)[last],
            np.array([m.semantic_class for m in found], np.uint16)[last],
        )

    @property
    def plain(self) -> bool:
        """Whether each ray ends at its first hit, with a return."""
        return bool((self.reflectance > 0).all() and not (self.passes | self.mirrors).any())

    def scattered(
        self, rows: NDArray[np.integer[Any]], cosine: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Share of the light returned by objects (n,): 1 for white at right angles."""
        return self.reflectance[rows] * np.where(self.retro[rows], RETRO_GAIN, cosine)

    def goes_on(
        self, rows: NDArray[np.integer[Any]], cosine: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Share of the light that continues at glass or mirrors (n,)."""
        through = np.where(self.passes[rows], 1 - fresnel(cosine), 1.0)
        return np.asarray((1 - self.reflectance[rows]) * through)


def fresnel(cosine: NDArray[np.float64]) -> NDArray[np.float64]:
    """Share of unpolarised light that a surface of glass reflects (Fresnel's equations)."""
    inside = np.sqrt(1 - (1 - cosine**2) / GLASS_INDEX**2)
    across = (cosine - GLASS_INDEX * inside) / (cosine + GLASS_INDEX * inside)
    along = (inside - GLASS_INDEX * cosine) / (inside + GLASS_INDEX * cosine)
    return np.asarray((across**2 + along**2) / 2)


def at_right_angles(distance: Any, extinction: float = 0.0) -> Any:
    """Energy returned by white surfaces hit at right angles, by distance in metres."""
    distance = np.maximum(distance, NEAREST_M)
    return (REFERENCE_M / distance) ** 2 * np.exp(-2 * extinction * distance)


def extinction(visibility_km: float | None, wavelength_nm: float) -> float:
    """Extinction of the air, 1/m (Kruse, McGlauchlin and McQuistan 1962).

    At the meteorological visibility, a contrast has fallen to 2 %; None is clear air without
    extinction. The wavelength is that of the laser.

    Examples
    --------
    >>> round(1000 * extinction(1.0, 905), 2)  # 1/km in fog
    2.92
    """
    v = visibility_km
    if v is None:
        return 0.0
    q = 1.6 if v > 50 else 1.3 if v > 6 else 0.585 * v ** (1 / 3)
    return float(3.91 / v * (wavelength_nm / 550) ** -q / 1000)

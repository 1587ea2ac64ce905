"""Materials by the names of objects, energies of returns, weather."""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase, translate
from functools import cache
from glob import escape
from importlib.resources import files
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, WrapValidator

from ..base.arrays import Bools, Floats, Indices, Integers
from ..base.declared import TextOrTexts, UnitShare, about, allowed, written_as
from ..base.elementary import exp, power
from ..base.errors import LidarpoolError
from ..base.validation import checked_fields, shown
from ..base.words import did_you_mean
from .leaves import LeafAngle

REFERENCE_M = 10.0  # energy is 1 for a white surface hit at right angles from here
REFLECTANCE = 0.5  # default reflectance: between asphalt (0.1 to 0.2) and white paint (0.8)
# Engineer grade sheeting, ASTM D4956 type I white: 70 cd/lx/m², of a white diffuser 1/π.
RETRO_GAIN = 220.0
GLASS_INDEX = 1.5
# Of water, from 905 to 1550 nm (Hale and Querry 1973: 1.328 to 1.318).
WATER_INDEX = 1.328
# Share of diffuse light in water that its surface sends back, 1 - (1 - r) / n², where r is the mean
# of Fresnel's reflection outside, over a half space (Lekner and Dorf 1988).
WATER_INWARDS = 0.4702
NEAREST_M = 1e-3  # energies do not grow below this distance
NEAR_NM, FAR_NM = 905.0, 1550.0  # wavelengths of the table of reflectances
POLISHED = 0.04  # share that plastics, paints and wet surfaces reflect at right angles, n = 1.5
DARKEST = 1e-3  # least reflectance of a colour, so that every hit is a return

SemanticClass = Annotated[int, Field(ge=0, le=65_535)]
Transparent = Literal["none", "pass"]


def _checked_names(given: Any, handler: Callable[[Any], Any]) -> Any:
    """Refuse names of classes that files cannot hold, or that two classes share."""
    for number, name in given.items() if isinstance(given, Mapping) else ():
        known = type(number) is int and 0 <= number <= 65_535 and isinstance(name, str)
        alone = [*given.values()].count(name) == 1
        if not (known and alone and 0 < len(name) < 100 and name.isprintable()):
            raise ValueError(
                f"{shown({number: name})} is no class with a name of its own: give whole numbers "
                "of 0 to 65535 and a different text for each, such as {10: car}."
            )
    return handler(given)


ClassNames = Annotated[Mapping[SemanticClass, str], WrapValidator(_checked_names)]


class Measured(NamedTuple):
    """Reflectance of a material in a public spectral library."""

    shares: tuple[float, float]  # at 905 and 1550 nm
    library: str
    sample: str


@cache
def reflectances() -> dict[str, Measured]:
    """Return the table of reflectances: {name of a material: what was measured}."""
    text = (files("lidarpool.sensor") / "reflectances.csv").read_text("utf-8")
    return {
        row["name"]: Measured(
            (float(row["at_905_nm"]), float(row["at_1550_nm"])), row["library"], row["sample"]
        )
        for row in csv.DictReader(text.splitlines())
    }


@dataclass(frozen=True)
@checked_fields
class Material:
    """Material of objects; the last entry for an object counts.

    Reflectance is that at the sensor's wavelength, in all directions but for a gloss. Of light that
    is not scattered, a share is mirrored; the rest passes, or is lost with "none".

    Raises
    ------
    LidarpoolError
        If a value is outside its range, the table of reflectances has no such material, or two
        values contradict each other.
    """

    objects: Annotated[
        str | Sequence[str],
        written_as(TextOrTexts),
        about("names of objects, with * and ?", min_length=1),
    ]
    reflectance: Annotated[
        UnitShare | Literal["texture"] | None,
        allowed("0 to 1, or texture"),
        about(
            "share of light that is scattered; by default 0.5, for glass and whole mirrors "
            "0; texture: the luminance of the colour that was hit"
        ),
    ] = None
    semantic_class: Annotated[SemanticClass, about("value of the column class", alias="class")] = 0
    retro: Annotated[
        bool, about("whether light returns in its own direction, as from traffic signs")
    ] = False
    transparent: Annotated[Transparent, about("pass: the rest of the light passes through")] = (
        "none"
    )
    specular_reflectance: Annotated[
        UnitShare | Literal["fresnel"] | None,
        allowed("0 to 1, or fresnel"),
        about(
            "share of the rest that is mirrored at right angles, and shows ghosts; grows towards "
            "grazing angles. 1 for a mirror, 0.04 for paint; fresnel for what light passes",
            0.04,
        ),
    ] = None
    scale: Annotated[
        float, about("with reflectance: texture, a factor of the luminance", gt=0, le=100)
    ] = 1.0
    material: Annotated[
        str | None,
        about("instead of reflectance: a material of the table of reflectances", "asphalt, dry"),
    ] = None
    roughness: Annotated[
        float | None, about("adds a gloss, as of paint or metal; by default none", ge=0.1, le=1)
    ] = None
    metalness: Annotated[
        UnitShare, about("with roughness: 1 for metals, which scatter by their gloss alone")
    ] = 0.0
    refractive_index: Annotated[
        float | None,
        about(
            "with transparent: pass, light is refracted and slower within the closed "
            "surface, as 1.33 for water; by default it goes straight on",
            1.33,
            ge=1,
            le=4,
        ),
    ] = None
    attenuation_per_m: Annotated[
        float, about("with refractive_index, extinction within the surface", ge=0, le=1e6)
    ] = 0.0
    leaf_area_density: Annotated[
        float | None,
        about(
            "the closed surface is full of leaves: their one-sided area, m²/m³; "
            "reflectance is theirs",
            0.8,
            gt=0,
            le=1e4,
        ),
    ] = None
    leaf_angle: Annotated[
        LeafAngle,
        about(
            "with leaf_area_density, or of voxels, how leaves are inclined: spherical, "
            "planophile, erectophile, plagiophile, extremophile, uniform, or Campbell's ratio "
            "of axes"
        ),
    ] = "spherical"

    def __post_init__(self) -> None:
        names = (self.objects,) if isinstance(self.objects, str) else tuple(self.objects)
        if not all(names):
            raise LidarpoolError(f"objects is {self.objects!r}; it must be names of objects.")
        object.__setattr__(self, "objects", names)
        if self.material is not None:
            if self.material not in (known := reflectances()):
                there = _materials_like(self.material, [*known])
                raise LidarpoolError(f"There is no material {self.material!r}.{there}")
            if self.reflectance is not None:
                raise LidarpoolError("give either material or reflectance, not both.")
        if self.reflectance == "texture":
            if self.transparent != "none":
                raise LidarpoolError(
                    f"reflectance texture is for opaque objects: with transparent "
                    f"{self.transparent}, give a number."
                )
        elif self.scale != 1:
            raise LidarpoolError("scale is a factor of colours: give reflectance texture with it.")

        if self.roughness is None and self.metalness:
            raise LidarpoolError("metalness needs a roughness: give 0.1 (polished) to 1 (matt).")
        smooth = self.transparent != "none" or self.specular_reflectance is not None
        if self.roughness is not None and (self.retro or smooth):
            raise LidarpoolError(
                "roughness is for opaque surfaces without retro and specular_reflectance."
            )
        self._check_within()

    def _check_within(self) -> None:
        """Refuse what contradicts the medium within a surface, or the light that passes it."""
        mirrors = self.specular_reflectance
        if mirrors is not None and (mirrors == "fresnel") != (self.transparent == "pass"):
            raise LidarpoolError(
                f"specular_reflectance is {mirrors!r} with transparent: {self.transparent}; give "
                "fresnel for what light passes, else 0 to 1."
            )
        if self.refractive_index is not None and self.transparent != "pass":
            raise LidarpoolError(
                "refractive_index is for light that passes: add transparent: pass."
            )
        if self.attenuation_per_m and self.refractive_index is None:
            raise LidarpoolError("attenuation_per_m needs a refractive_index, such as 1.33.")
        if self.leaf_area_density is None:
            return
        if not self._suits_leaves:
            raise LidarpoolError(
                "leaf_area_density is for leaves that scatter light: leave out transparent, "
                "retro, roughness and specular_reflectance, and give reflectance as a number, or a "
                "material."
            )

    @property
    def _suits_leaves(self) -> bool:
        other = self.transparent != "none" or self.retro or self.roughness is not None
        return not (other or self.specular_reflectance) and self.reflectance != "texture"

    def check_leaves(self, name: str, voxels: bool) -> None:
        """Check that it suits an object, by whether that has voxels; LidarpoolError if not."""
        if voxels and (self.leaf_area_density is not None or not self._suits_leaves):
            raise LidarpoolError(
                f"materials: {name!r} is of voxels, whose file has the leaf area: give it an entry "
                "with a reflectance, or a material, and perhaps a leaf_angle, but nothing else."
            )
        if not voxels and self.leaf_angle != "spherical" and self.leaf_area_density is None:
            raise LidarpoolError(
                f"materials: {name!r} has a leaf_angle, which needs a leaf_area_density, m²/m³, "
                "such as 0.8, if it is not of voxels (.vox)."
            )

    def share(self, wavelength_nm: float) -> float:
        """Share of light that is scattered; of textures, that of what has no colour."""
        if self.material is not None:
            near, far = reflectances()[self.material].shares
            # The nearer of the two was measured; between them, leaves absorb more than either says.
            return near if wavelength_nm < (NEAR_NM + FAR_NM) / 2 else far
        if self.reflectance == "texture":
            return min(1.0, self.scale * REFLECTANCE)
        if self.reflectance is None:
            return (
                0.0 if self.transparent == "pass" or self.specular_reflectance == 1 else REFLECTANCE
            )
        return float(self.reflectance)

    @property
    def specular(self) -> float:
        """Share of what is not scattered that is mirrored at right angles; 1 for "fresnel"."""
        return float(self.specular_reflectance == "fresnel" or self.specular_reflectance or 0)

    def named(self, name: str) -> bool:
        """Whether this material applies to an object."""
        return any(name == pattern or fnmatchcase(name, pattern) for pattern in self.objects)


def _materials_like(name: str, known: Sequence[str]) -> str:
    """Name the materials that contain a word, such as «asphalt», or else the nearest, or all."""
    some = [one for one in known if name.lower() in one.lower()]
    if len(some) > 1:
        return f" There are: {'; '.join(some)}."
    return did_you_mean(name, some or known) or f" There are: {'; '.join(some or known)}."


def rows_named(pattern: str, names: Sequence[str]) -> Indices:
    """Rows of names that are a name, or fit it as a pattern with * and ?."""
    if not any(sign in pattern for sign in "*?["):
        return np.array([row for row, name in enumerate(names) if name == pattern], np.intp)
    fits = re.compile(translate(pattern)).match
    return np.array([r for r, name in enumerate(names) if name == pattern or fits(name)], np.intp)


def _last_for(materials: Sequence[Material], names: Sequence[str]) -> Indices:
    """Last material that names each object, -1 for none: (objects,)."""
    last = np.full(len(names), -1)
    known = {name: row for row, name in enumerate(names)}
    for number, material in enumerate(materials):
        for pattern in material.objects:
            plain = pattern in known and not any(sign in pattern for sign in "*?[")
            rows = np.array([known[pattern]]) if plain else rows_named(pattern, names)
            if not len(rows):
                raise LidarpoolError(
                    f"materials names {pattern!r}, but no object has that name."
                    + (did_you_mean(pattern, names) or f" There are {', '.join(names[:5])}, …")
                )
            last[rows] = number
    return last


def with_classes(
    materials: Sequence[Material], classes: Mapping[int, Sequence[str]], names: Sequence[str]
) -> list[Material]:
    """Give objects whose material has no class one by their names: {class: patterns}.

    LidarpoolError if a material is for no object.
    """
    out, last = list(materials), _last_for(materials, names)
    for semantic_class, patterns in classes.items():
        for pattern in patterns:
            rows = rows_named(pattern, names)
            for number in np.unique(last[rows]).tolist():
                of, some = materials[number], rows[last[rows] == number]
                if number >= 0 and not of.semantic_class:
                    whole = len(some) == len(rows)
                    objects = [pattern] if whole else [escape(names[row]) for row in some]
                    out.append(replace(of, objects=objects, semantic_class=semantic_class))
    return out


def with_class(
    materials: Sequence[Material], semantic_class: int, rows: Indices, names: Sequence[str]
) -> list[Material]:
    """Give some objects a class, and leave the rest of their materials.

    LidarpoolError if a material is for no object.
    """
    out, last = list(materials), _last_for(materials, names)[rows]
    for number in np.unique(last).tolist():
        of = materials[number] if number >= 0 else Material("*")
        objects = [escape(names[row]) for row in rows[last == number]]
        out.append(replace(of, objects=objects, semantic_class=semantic_class))
    return out


@dataclass(frozen=True, eq=False)
class MaterialTable:
    """Materials of objects: each array has one value for each."""

    reflectance: Floats
    scale: Floats  # of the luminance of colours; 0 where the reflectance is a number
    roughness: Floats  # 0 for no gloss
    metalness: Floats
    retro: Bools
    passes: Bools
    specular: Floats  # share of what is not scattered that is mirrored at right angles
    semantic_class: NDArray[np.uint16]
    refractive_index: Floats  # within; 0 where light goes straight on
    attenuation: Floats  # within, 1/m
    leaf_area: Floats  # density within, m²/m³; 0 for no leaves, 1 for voxels
    leaf_angle: Indices  # rows of `leaf_angles`
    leaf_angles: tuple[str | float, ...]

    @classmethod
    def of(
        cls,
        materials: Sequence[Material],
        names: Sequence[str],
        wavelength_nm: float = NEAR_NM,
        voxels: Bools | None = None,
    ) -> MaterialTable:
        """Find the materials of objects by name: the last that names an object counts.

        `voxels` (objects,) says which have voxels, and so leaves of their own; None for none.

        Raises
        ------
        LidarpoolError
            If a name fits no object, there are materials and an object has none, or one is not for
            leaves, and its object has some.
        """
        last = _last_for(materials, names)
        without = np.flatnonzero(last < 0)
        if len(without) and materials:
            more = f" and {len(without) - 1} more" if without[1:].size else ""
            raise LidarpoolError(
                f"materials: no entry names the object {names[without[0]]!r}{more}: begin with one "
                'for all the others, such as {objects: "*"}.'
            )
        found = [*materials, Material("*")]  # the last is of all, if there are no materials
        textured = [m.scale * (m.reflectance == "texture") for m in found]
        angles = tuple(dict.fromkeys(m.leaf_angle for m in found))
        leaf_area = np.array([m.leaf_area_density or 0.0 for m in found])[last]
        own = np.zeros(len(names), np.bool_) if voxels is None else voxels
        angled = np.array([m.leaf_angle != "spherical" for m in found])[last]
        for row in np.flatnonzero(own | angled).tolist():
            found[last[row]].check_leaves(names[row], bool(own[row]))
        leaf_area[own] = 1.0
        return cls(
            np.array([m.share(wavelength_nm) for m in found], np.float64)[last],
            np.array(textured, np.float64)[last],
            np.array([m.roughness or 0.0 for m in found])[last],
            np.array([m.metalness for m in found])[last],
            np.array([m.retro for m in found], np.bool_)[last],
            np.array([m.transparent == "pass" for m in found], np.bool_)[last],
            np.array([m.specular for m in found], np.float64)[last],
            np.array([m.semantic_class for m in found], np.uint16)[last],
            np.array([m.refractive_index or 0.0 for m in found])[last],
            np.array([m.attenuation_per_m for m in found], np.float64)[last],
            leaf_area,
            np.array([angles.index(m.leaf_angle) for m in found], np.intp)[last],
            angles,
        )

    @property
    def leafy(self) -> Bools:
        """Whether objects are full of leaves."""
        return self.leaf_area > 0

    @property
    def refracts(self) -> Bools:
        """Whether light is refracted at the surfaces of objects."""
        return self.refractive_index > 0

    @property
    def textured(self) -> bool:
        """Whether the colours of an object are its reflectance."""
        return bool(self.scale.any())

    def shares(self, rows: Integers, luminance: Floats | None) -> Floats:
        """Share of light that objects (n,) scatter; `luminance` as of `scattered`."""
        shares = self.reflectance[rows]
        if luminance is not None:
            scale = self.scale[rows]
            bright = np.minimum(np.maximum(scale * luminance, DARKEST), 1.0)
            shares = bright if self.scale.all() else np.where(scale > 0, bright, shares)
        return shares

    def scattered(self, rows: Integers, cosine: Floats, luminance: Floats | None = None) -> Floats:
        """Share of the light returned by objects (n,): 1 for white at right angles.

        `luminance` (n,) is that of the colours that were hit, if the table is `textured`.
        """
        shares = self.shares(rows, luminance)
        back = shares * np.where(self.retro[rows], RETRO_GAIN, cosine)
        if self.roughness.any():
            on = np.flatnonzero(self.roughness[rows])
            metal, some = self.metalness[rows[on]], shares[on]
            front = POLISHED * (1 - metal) + some * metal
            back[on] *= 1 - metal
            back[on] += front * gloss(cosine[on], self.roughness[rows[on]])
        return back


def gloss(cosine: Floats, roughness: Floats) -> Floats:
    """Light that facets of a rough surface mirror back to where it came from, of a white diffuser.

    Facets are distributed after Walter et al. 2007 (GGX), with shadowing after Smith, and the width
    is the square of the roughness, as in glTF 2.0. With light and receiver in one direction, their
    π D G / (4 cos θ) is what is left here. Multiply it by the reflection at right angles.
    """
    width, square = np.square(roughness**2), cosine**2
    spread = 1 - square * (1 - width)
    return np.asarray(width / (4 * spread**2 * np.sqrt(square + width * (1 - square))))


def fresnel(cosine: Any, index: Any = GLASS_INDEX) -> Any:
    """Share of unpolarised light that a surface reflects (Fresnel's equations).

    `index` is the refractive index behind the surface over that before it; all light is reflected
    where it is below 1 and the cosine is small.
    """
    inside = np.sqrt(np.maximum(1 - (1 - cosine**2) / (index * index), 0.0))
    across = (cosine - index * inside) / (cosine + index * inside)
    along = (inside - index * cosine) / (inside + index * cosine)
    return (across**2 + along**2) / 2


def below_water(cosine: Any, reflectance: Any) -> Any:
    """Light that matt surfaces below a film of water return, relative to dry ones: (n,).

    ``T² / (n² (1 - p ρ))``: light passes the film's surface twice, with Fresnel's transmittance T;
    in the water it is spread by n², and the share p is sent back to the ground (Lekner and Dorf
    1988, Ångström 1925).
    """
    return within_water(fresnel(cosine, WATER_INDEX), reflectance)


def within_water(mirrored: Any, reflectance: Any) -> Any:
    """See `below_water`; of light of which the film mirrors a share."""
    through = (1 - mirrored) / WATER_INDEX
    return through * through / (1 - WATER_INWARDS * reflectance)


def at_right_angles(distance: Any, extinction: float = 0.0) -> Any:
    """Energy returned by white surfaces hit at right angles, by distance in metres."""
    distance = np.maximum(distance, NEAREST_M)
    nearer = np.square(REFERENCE_M / distance)
    return nearer * exp(-2 * extinction * distance) if extinction else nearer


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
    q = 1.6 if v > 50 else 1.3 if v > 6 else 0.585 * float(power(v, 1 / 3))
    return float(3.91 / v * float(power(wavelength_nm / 550, -q)) / 1000)

"""Materials of surfaces, their assignment to objects by name, and the light that they return."""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase, translate
from functools import cache, cached_property
from glob import escape
from importlib.resources import files
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, WrapValidator

from ..errors import LidarError
from ..numerics.arrays import Bools, Floats, Indices, Integers
from ..numerics.elementary import exp, power
from ..schema.checks import check_fields
from ..schema.declared import (
    FileSection,
    TextOrTexts,
    UnitShare,
    about,
    describe_allowed,
    scenario_type,
)
from ..schema.value_texts import format_value, one_line
from ..words import did_you_mean, name_hint
from .leaves import LeafAngle

REFERENCE_M = 10.0  # distance at which a perpendicular white surface returns an energy of 1
REFLECTANCE = 0.5  # default reflectance, between asphalt (0.1 to 0.2) and white paint (0.8)
# Engineer grade sheeting, ASTM D4956 type I white, reflects 70 cd/lx/m² instead of the 1/π cd/lx/m²
# of a white diffuser.
RETRO_GAIN = 220.0
GLASS_INDEX = 1.5
_KOSCHMIEDER = 3.91  # logarithm of 50, for the visibility at which 2 % of the contrast remains
# Ratio of the meteorological optical range, at which 5 % of the light remains, to that visibility.
MOR_SHARE = 2.995732273553991 / _KOSCHMIEDER
# Refractive index of water from 905 to 1550 nm (Hale and Querry 1973: 1.328 to 1.318).
WATER_INDEX = 1.328
# Fraction of diffuse light in water that is reflected at the surface, 1 - (1 - r) / n², where r is
# the mean of the external Fresnel reflection over a hemisphere (Lekner and Dorf 1988).
WATER_INWARDS = 0.4702
NEAREST_M = 1e-3  # energies do not increase below this distance
# Wavelengths in the reflectance table.
NEAR_NM = 905.0
FAR_NM = 1550.0
POLISHED = 0.04  # reflection of plastic, paint and wet surfaces at normal incidence (n = 1.5)
DARKEST = 1e-3  # minimum reflectance of a color, so that every hit results in a return
# Factors of a normal distribution with a larger spread would often be negative.
MAX_REFLECTANCE_SPREAD = 0.5

SemanticClass = Annotated[int, Field(ge=0, le=65_535)]
Transparent = Literal["none", "pass"]


def find_class_names_error(names: Mapping[Any, Any]) -> str:
    """Return an error message if a mapping from numbers to class names cannot be stored.

    The result is an empty string if the names are valid. Two classes must not have the same name.
    """
    for number, name in names.items():
        valid = type(number) is int and 0 <= number <= 65_535 and isinstance(name, str)
        unique = [*names.values()].count(name) == 1
        if not (valid and unique and 0 < len(name) < 100 and name.isprintable()):
            return (
                "expected whole numbers from 0 to 65535 with unique names, such as {10: car}, "
                f"but found {format_value({number: name})}."
            )
    return ""


def _validate_names(names: Any, handler: Callable[[Any], Any]) -> Any:
    if isinstance(names, Mapping) and (problem := find_class_names_error(names)):
        raise ValueError(problem)
    return handler(names)


ClassNames = Annotated[Mapping[SemanticClass, str], WrapValidator(_validate_names)]


class MeasuredReflectance(NamedTuple):
    """Reflectance of a material in a public spectral library."""

    shares: tuple[float, float]  # at 905 and 1550 nm
    library: str
    sample: str


@cache
def reflectances() -> dict[str, MeasuredReflectance]:
    """Return the table of measured reflectances, keyed by material name."""
    text = (files("lidarsim.media") / "reflectances.csv").read_text("utf-8")
    return {
        row["name"]: MeasuredReflectance(
            (float(row["at_905_nm"]), float(row["at_1550_nm"])), row["library"], row["sample"]
        )
        for row in csv.DictReader(text.splitlines())
    }


@dataclass(frozen=True)
class Material(FileSection):
    """Optical properties and semantic class of surfaces.

    A material selects objects by name, faces by the name of their material in the scene file, or
    faces by both. If several materials apply to a face, the first one is used.

    The reflectance is the diffuse reflectance at the wavelength of the sensor. A fraction of the
    light that is not scattered is reflected specularly. The rest is transmitted, or absorbed if
    `transparent` is "none".

    Raises
    ------
    LidarError
        If neither `objects` nor `material` is set, a value is out of range, the spectrum is
        unknown, or two values contradict each other.
    """

    objects: Annotated[
        str | Sequence[str] | None,
        scenario_type(TextOrTexts | None),
        about("names of objects, which may contain * and ? (default: all)", min_length=1),
    ] = None
    reflectance: Annotated[
        UnitShare | Literal["texture"] | None,
        describe_allowed("from 0 to 1, or texture"),
        about(
            "fraction of the light that is scattered (default: 0.5, or 0 for glass and perfect "
            "mirrors); texture uses the luminance of the surface color"
        ),
    ] = None
    semantic_class: Annotated[
        SemanticClass, about("semantic class, which is stored in the column `class`", alias="class")
    ] = 0
    retro: Annotated[bool, about("whether the surface is retroreflective, like a traffic sign")] = (
        False
    )
    transparent: Annotated[
        Transparent,
        about("whether light that is not scattered passes through (pass) or not (none)"),
    ] = "none"
    specular_reflectance: Annotated[
        UnitShare | Literal["fresnel"] | None,
        describe_allowed("from 0 to 1, or fresnel"),
        about(
            "fraction of the light not scattered that is reflected specularly at normal incidence, "
            "which causes ghosts; increases toward grazing angles; 1 for a mirror, 0.04 for paint, "
            "fresnel for materials that transmit light",
            0.04,
        ),
    ] = None
    scale: Annotated[
        float, about("factor for the luminance, with `reflectance: texture`", gt=0, le=100)
    ] = 1.0
    spectrum: Annotated[
        str | None,
        about(
            "name of a material in the table of measured reflectances; replaces reflectance",
            "asphalt, dry",
        ),
    ] = None
    roughness: Annotated[
        float | None,
        about(
            "roughness of a glossy surface, such as paint or metal (default: no gloss)",
            ge=0.1,
            le=1,
        ),
    ] = None
    metalness: Annotated[
        UnitShare,
        about(
            "metalness of a glossy surface, with `roughness`; 1 for metals, which have no "
            "diffuse reflection"
        ),
    ] = 0.0
    refractive_index: Annotated[
        float | None,
        about(
            "refractive index inside the closed surface, such as 1.33 for water, with "
            "`transparent: pass` (default: light is not refracted)",
            1.33,
            ge=1,
            le=4,
        ),
    ] = None
    attenuation_per_m: Annotated[
        float,
        about(
            "attenuation in 1/m inside the closed surface, with `refractive_index`", ge=0, le=1e6
        ),
    ] = 0.0
    leaf_area_density: Annotated[
        float | None,
        about(
            "one-sided area, in m²/m³, of the leaves that fill the closed surface; reflectance "
            "then applies to the leaves",
            0.8,
            gt=0,
            le=1e4,
        ),
    ] = None
    leaf_angle: Annotated[
        LeafAngle,
        about(
            "leaf angle distribution, with `leaf_area_density` or voxels: spherical, planophile, "
            "erectophile, plagiophile, extremophile, uniform, or the axis ratio of Campbell's "
            "ellipsoid"
        ),
    ] = "spherical"
    gap_fraction: Annotated[
        float,
        about(
            "fraction of the sub-rays that pass through gaps in the surface, such as a hedge or a "
            "fence",
            0.3,
            ge=0,
            lt=1,
        ),
    ] = 0.0
    range_spread_m: Annotated[
        float,
        about(
            "standard deviation in meters of the ranges of returns from the surface, if it stands "
            "for a layer with depth, such as a hedge",
            0.1,
            ge=0,
            le=10,
        ),
    ] = 0.0
    reflectance_spread: Annotated[
        float,
        about(
            "standard deviation of the reflectance from sub-ray to sub-ray relative to its mean, "
            "for surfaces with unresolved structure, such as vegetation",
            0.3,
            ge=0,
            le=MAX_REFLECTANCE_SPREAD,
        ),
    ] = 0.0
    material: Annotated[
        str | Sequence[str] | None,
        scenario_type(TextOrTexts | None),
        about(
            "names of materials in the scene files, which may contain * and ? (default: all)",
            "Glass",
            min_length=1,
        ),
    ] = None

    __repr__ = one_line

    def __post_init__(self) -> None:
        check_fields(self)
        if self.objects is None and self.material is None:
            raise LidarError(
                'A material must apply to something. Set objects, such as `objects: "*"`, or '
                "material."
            )
        self._set_names("objects")
        self._set_names("material")
        self._check_reflectance()
        self._check_roughness()
        self._check_medium()
        self._check_gaps()

    def _set_names(self, field_name: str) -> None:
        """Convert a name or names in a field to a tuple. Raises LidarError for empty names."""
        value = getattr(self, field_name)
        if value is None:
            return
        names = (value,) if isinstance(value, str) else tuple(value)
        if not names or not all(names):
            raise LidarError(f"{field_name} must be one or more names, but is {value!r}.")
        object.__setattr__(self, field_name, names)

    def _check_reflectance(self) -> None:
        if self.spectrum is not None:
            if self.spectrum not in (spectra := reflectances()):
                hint = _materials_like(self.spectrum, [*spectra])
                raise LidarError(f"Unknown spectrum {self.spectrum!r}.{hint}")
            if self.reflectance is not None:
                raise LidarError("spectrum and reflectance cannot be combined.")
        if self.reflectance == "texture":
            if self.transparent != "none":
                raise LidarError(
                    "reflectance: texture requires an opaque material. With transparent: "
                    f"{self.transparent}, set reflectance to a number."
                )
        elif self.scale != 1:
            raise LidarError("scale is a factor of colors and requires reflectance: texture.")

    def _check_roughness(self) -> None:
        """Check that a roughness is only set for opaque surfaces without specular reflection."""
        if self.roughness is None and self.metalness:
            raise LidarError(
                "metalness requires roughness. Set it to a value from 0.1 (polished) to 1 (matte)."
            )
        smooth = self.transparent != "none" or self.specular_reflectance is not None
        if self.roughness is not None and (self.retro or smooth):
            raise LidarError(
                "roughness requires an opaque material and cannot be combined with retro or "
                "specular_reflectance."
            )

    def _check_medium(self) -> None:
        """Check that specular reflection, transmission, refraction and leaves can be combined."""
        mirrors = self.specular_reflectance
        if mirrors is not None and (mirrors == "fresnel") != (self.transparent == "pass"):
            raise LidarError(
                "specular_reflectance must be fresnel with transparent: pass, and a number "
                f"otherwise, but is {mirrors!r} with transparent: {self.transparent}."
            )
        if self.refractive_index is not None and self.transparent != "pass":
            raise LidarError("refractive_index requires transparent: pass.")
        if self.attenuation_per_m and self.refractive_index is None:
            raise LidarError("attenuation_per_m requires refractive_index, such as 1.33.")
        if self.leaf_area_density is None:
            return
        if not self._suits_leaves:
            raise LidarError(
                "leaf_area_density cannot be combined with transparent, retro, roughness or "
                "specular_reflectance, and requires a number or a spectrum as the reflectance."
            )

    def _check_gaps(self) -> None:
        """Check that gaps and spreads are only set for surfaces without a medium."""
        if self.is_porous and (self.transparent != "none" or self.leaf_area_density is not None):
            raise LidarError(
                "gap_fraction and range_spread_m cannot be combined with transparent or "
                "leaf_area_density."
            )
        if self.reflectance_spread and (
            self.transparent != "none" or self.leaf_area_density is not None
        ):
            raise LidarError(
                "reflectance_spread cannot be combined with transparent or leaf_area_density."
            )

    @property
    def is_porous(self) -> bool:
        """Whether light passes through gaps in the surface, or returns from different depths."""
        return self.gap_fraction > 0 or self.range_spread_m > 0

    @property
    def _suits_leaves(self) -> bool:
        """Whether the material is suitable for leaves, which only scatter light diffusely.

        The reflectance of leaves cannot depend on a texture.
        """
        scatters_otherwise = self.transparent != "none" or self.retro or self.roughness is not None
        return (
            not (scatters_otherwise or self.specular_reflectance) and self.reflectance != "texture"
        )

    def check_leaves(self, name: str, voxels: bool) -> None:
        """Check that the leaf properties of this material suit an object.

        Parameters
        ----------
        name
            Name of the object, for the error message.
        voxels
            Whether the object contains leaf voxels.

        Raises
        ------
        LidarError
            If the object contains voxels and the material sets a leaf area density or properties
            that leaves cannot have, or if the object contains no voxels and the material sets
            `leaf_angle` without a leaf area density.
        """
        if voxels and (self.leaf_area_density is not None or not self._suits_leaves):
            raise LidarError(
                f"materials: {name!r} contains voxels, whose file defines the leaf area density. "
                "Its entry may only set reflectance or spectrum, and leaf_angle."
            )
        if not voxels and self.leaf_angle != "spherical" and self.leaf_area_density is None:
            raise LidarError(
                f"materials: {name!r} contains no voxels (.vox), so its leaf_angle requires "
                "leaf_area_density in m²/m³, such as 0.8."
            )

    def diffuse_reflectance(self, wavelength_nm: float) -> float:
        """Return the fraction of light that the material scatters at the given wavelength.

        If `reflectance` is "texture", the result applies to faces without a color.
        """
        if self.spectrum is not None:
            at_905_nm, at_1550_nm = reflectances()[self.spectrum].shares
            # Use the nearest measurement instead of interpolating, because leaves absorb more light
            # between these wavelengths than at either of them.
            return at_905_nm if wavelength_nm < (NEAR_NM + FAR_NM) / 2 else at_1550_nm
        if self.reflectance == "texture":
            return min(1.0, self.scale * REFLECTANCE)
        if self.reflectance is None:
            return (
                0.0 if self.transparent == "pass" or self.specular_reflectance == 1 else REFLECTANCE
            )
        return float(self.reflectance)

    @property
    def specular(self) -> float:
        """Specular reflectance at normal incidence, as a fraction of the light not scattered.

        The value is 1 if `specular_reflectance` is "fresnel".
        """
        return float(self.specular_reflectance == "fresnel" or self.specular_reflectance or 0)

    def applies_to(self, name: str, materials: Collection[str] = ("",)) -> bool:
        """Return whether this material applies to an object.

        `name` is the name of the object, and `materials` are the names that the materials of its
        faces have in the scene file.
        """
        return _fits(name, self.objects) and any(_fits(face, self.material) for face in materials)

    @property
    def applies_to_all(self) -> bool:
        """Whether this material applies to all faces of all objects."""
        return self.material is None and self.objects is not None and "*" in self.objects


def _fits(name: str, patterns: str | Sequence[str] | None) -> bool:
    """Return whether a name matches any of the patterns. None matches every name."""
    return patterns is None or any(
        name == pattern or fnmatchcase(name, pattern) for pattern in patterns
    )


def _materials_like(name: str, materials: Sequence[str]) -> str:
    """Return a hint for a misspelled spectrum name.

    The hint lists the spectra that contain the name, the most similar spectrum, or all spectra.
    """
    containing = [material for material in materials if name.lower() in material.lower()]
    if len(containing) > 1:
        return f" Available spectra: {'; '.join(containing)}."
    return (
        did_you_mean(name, containing or materials)
        or f" Available spectra: {'; '.join(containing or materials)}."
    )


def match_names(pattern: str, names: Sequence[str]) -> Indices:
    """Return the indices of the names that are equal to a pattern or match it.

    The pattern may contain * and ?.
    """
    if not any(sign in pattern for sign in "*?["):
        return np.array([row for row, name in enumerate(names) if name == pattern], np.intp)
    fits = re.compile(translate(pattern)).match
    return np.array([r for r, name in enumerate(names) if name == pattern or fits(name)], np.intp)


@dataclass(frozen=True, eq=False)
class SurfaceKinds:
    """Surface kinds of a scene, one for each material of each object.

    Parameters
    ----------
    names
        Names of all objects.
    object
        Index into `names` for each kind, in ascending order. Each object has at least one kind.
        Shape (k,), int.
    material
        Name of each kind's material in the scene file, or an empty string. Length k.
    """

    names: Sequence[str]
    object: Indices
    material: Sequence[str]

    @classmethod
    def from_objects(cls, names: Sequence[str]) -> SurfaceKinds:
        """Create one kind for each object, ignoring materials in scene files."""
        return cls(names, np.arange(len(names)), ("",) * len(names))

    @cached_property
    def first(self) -> Indices:
        """Index of the first kind of each object, followed by the number of kinds.

        The shape is (objects + 1,).
        """
        return np.searchsorted(self.object, np.arange(len(self.names) + 1))

    def kinds_of_objects(self, object_indices: Indices) -> Indices:
        """Return the kinds of the objects with the given indices."""
        if len(self.object) == len(self.names):
            return object_indices
        starts = self.first[object_indices]
        stops = self.first[object_indices + 1]
        ranges = [np.arange(start, stop) for start, stop in zip(starts, stops, strict=True)]
        return np.concatenate([np.zeros(0, np.intp), *ranges])

    def describe(self, kind: int) -> str:
        """Format the object and the material of a kind for error messages."""
        name = repr(self.names[self.object[kind]])
        return f"{name}, material {self.material[kind]!r}" if self.material[kind] else name


def first_matches(materials: Sequence[Material], kinds: SurfaceKinds) -> Indices:
    """Return the index of the first material that applies to each kind, or -1 if none does.

    The result has shape (k,).

    Raises
    ------
    LidarError
        If a material does not apply to any kind, or if a material that is not the last applies to
        all kinds.
    """
    first = np.full(len(kinds.object), -1)
    object_rows = {name: row for row, name in enumerate(kinds.names)}
    kinds_by_material: dict[str, list[int]] = {}  # {name of a material: kinds}
    if any(entry.material is not None for entry in materials):
        for kind, name in enumerate(kinds.material):
            if name:
                kinds_by_material.setdefault(name, []).append(kind)
    for number, entry in enumerate(materials):
        if entry.applies_to_all and number + 1 < len(materials):
            raise LidarError(
                "materials: the first matching entry applies, so entries after number "
                f'{number + 1}, {{objects: "*"}}, have no effect. Move it to the end.'
            )
        matches = _matching_kinds(entry, kinds, object_rows, kinds_by_material)
        first[matches[first[matches] < 0]] = number
    return first


def _matching_kinds(
    entry: Material,
    kinds: SurfaceKinds,
    object_rows: Mapping[str, int],
    kinds_by_material: Mapping[str, Sequence[int]],
) -> Indices:
    """Return the kinds to which a material applies.

    `object_rows` maps object names to their indices, and `kinds_by_material` maps material names to
    kinds. Raise LidarError if a name does not match any object or material in the scene.
    """
    matches: Indices | None = None
    if entry.objects is not None:
        rows = [
            match_object_names(pattern, kinds.names, object_rows, "materials")
            for pattern in entry.objects
        ]
        matches = kinds.kinds_of_objects(np.concatenate(rows))
    if entry.material is None:
        assert matches is not None, "a material applies to objects, or to materials"
        return matches
    names = [*kinds_by_material]
    with_material: list[int] = []
    for pattern in entry.material:
        rows_of_pattern = match_names(pattern, names)
        if not len(rows_of_pattern):
            measured = f" For a measured reflectance, use spectrum: {pattern!r}."
            raise LidarError(
                (
                    f"materials contains the material {pattern!r}, but no face of the scene has a "
                    "material of that name."
                )
                + (name_hint(pattern, names) if names else " No face has a named material.")
                + measured * (pattern in reflectances())
            )
        for row in rows_of_pattern.tolist():
            with_material += kinds_by_material[names[row]]
    kinds_with_material = np.array(with_material, np.intp)
    if matches is None:
        return kinds_with_material
    common = np.intersect1d(matches, kinds_with_material)
    if not len(common):
        raise LidarError(
            f"materials: no face of {', '.join(map(repr, entry.objects or ()))} has the material "
            f"{', '.join(map(repr, entry.material))}."
        )
    return common


def match_object_names(
    pattern: str, names: Sequence[str], object_rows: Mapping[str, int], subject: str
) -> Indices:
    """Return the indices of the objects whose names match a pattern.

    Parameters
    ----------
    pattern
        Name of an object, or a pattern with * and ?.
    names
        Names of all objects.
    object_rows
        Mapping from the names to their indices.
    subject
        Name of the setting that contains the pattern, for the error message, such as "materials".

    Raises
    ------
    LidarError
        If no object matches.
    """
    if pattern in object_rows and not any(sign in pattern for sign in "*?["):
        return np.array([object_rows[pattern]])
    rows = match_names(pattern, names)
    if not len(rows):
        raise LidarError(
            f"{subject} contains {pattern!r}, but no object has that "
            f"name.{name_hint(pattern, names)}"
        )
    return rows


def assign_classes(
    materials: Sequence[Material], classes: Mapping[int, Sequence[str]], kinds: SurfaceKinds
) -> list[Material]:
    """Assign semantic classes to objects by name, except where a material sets a class.

    Parameters
    ----------
    materials
        Materials in the order of their precedence.
    classes
        Mapping from classes to patterns for the names of objects.
    kinds
        Kinds of surfaces in the scene.

    Returns
    -------
    list of Material
        The materials, with additional entries for the objects.

    Raises
    ------
    LidarError
        If a material does not apply to any kind.
    """
    first = first_matches(materials, kinds)
    insertions: list[list[Material]] = [[] for _ in materials]  # new entries before each entry
    for semantic_class, patterns in classes.items():
        for pattern in patterns:
            rows = match_names(pattern, kinds.names)
            pattern_kinds = kinds.kinds_of_objects(rows)
            for number in np.unique(first[pattern_kinds]).tolist():
                entry = materials[number]
                if number < 0 or entry.semantic_class:
                    continue
                unclassified = pattern_kinds[first[pattern_kinds] == number]
                objects = [pattern]
                if len(unclassified) < len(pattern_kinds):
                    objects_of_kinds = np.unique(kinds.object[unclassified]).tolist()
                    objects = [escape(kinds.names[row]) for row in objects_of_kinds]
                classified = replace(entry, objects=objects, semantic_class=semantic_class)
                insertions[number].insert(0, classified)
    pairs = zip(materials, insertions, strict=True)
    return [entry for material, inserted in pairs for entry in (*inserted, material)]


def assign_class(
    materials: Sequence[Material], semantic_class: int, object_indices: Indices, kinds: SurfaceKinds
) -> list[Material]:
    """Assign a semantic class to the objects with the given indices.

    The result contains the materials and additional entries for the objects.

    Raises
    ------
    LidarError
        If a material does not apply to any kind.
    """
    first = first_matches(materials, kinds)
    selected_kinds = kinds.kinds_of_objects(object_indices)
    entries: list[Material] = []
    for number in (*range(len(materials)), -1):
        object_rows = np.unique(
            kinds.object[selected_kinds[first[selected_kinds] == number]]
        ).tolist()
        if object_rows:
            entry = materials[number] if number >= 0 else Material("*")
            objects = [escape(kinds.names[row]) for row in object_rows]
            entries.append(replace(entry, objects=objects, semantic_class=semantic_class))
        if number >= 0:
            entries.append(materials[number])
    return entries


@dataclass(frozen=True, eq=False)
class MaterialTable:
    """Material properties of surfaces, with one value per kind of surface."""

    reflectance: Floats
    scale: Floats  # factor for the luminance of colors, or 0 if the reflectance is a number
    roughness: Floats  # 0 for surfaces without gloss
    metalness: Floats
    retro: Bools
    passes: Bools
    specular: Floats  # specular reflectance at normal incidence, from `Material.specular`
    semantic_class: NDArray[np.uint16]
    refractive_index: Floats  # refractive index inside the surface, or 0 without refraction
    attenuation: Floats  # attenuation inside the surface in 1/m
    leaf_area: Floats  # leaf area density inside the surface in m²/m³, or 1 for voxels
    leaf_angle: Indices  # indices into `leaf_angles`
    leaf_angles: tuple[str | float, ...]
    gap_fraction: Floats  # fraction of the sub-rays that pass through gaps
    range_spread_m: Floats  # standard deviation of the ranges of returns
    reflectance_spread: Floats  # relative standard deviation of the reflectances of returns

    @classmethod
    def build(
        cls,
        materials: Sequence[Material],
        kinds: SurfaceKinds,
        wavelength_nm: float = NEAR_NM,
        voxels: Bools | None = None,
    ) -> MaterialTable:
        """Create the table from the first material that applies to each kind.

        Parameters
        ----------
        materials
            Materials in the order of their precedence.
        kinds
            Kinds of surfaces in the scene.
        wavelength_nm
            Wavelength of the sensor in nanometers.
        voxels
            Whether each object contains leaf voxels, or None if no object does. Shape (objects,).

        Raises
        ------
        LidarError
            If a name does not match any object or material, if only some kinds have a material, or
            if the material of an object with leaves is not suitable for leaves.
        """
        first = first_matches(materials, kinds)
        unmatched = np.flatnonzero(first < 0)
        if len(unmatched) and materials:
            uncovered = f" and {len(unmatched) - 1} more" if unmatched[1:].size else ""
            raise LidarError(
                "materials: no entry matches the object "
                f"{kinds.describe(unmatched[0])}{uncovered}. "
                'Add a last entry for all other objects, such as {objects: "*"}.'
            )
        entries = [*materials, Material("*")]  # so that each surface has an entry
        textured = [m.scale * (m.reflectance == "texture") for m in entries]
        angles = tuple(dict.fromkeys(m.leaf_angle for m in entries))
        leaf_area = np.array([m.leaf_area_density or 0.0 for m in entries])[first]
        has_voxels = np.zeros(len(first), np.bool_) if voxels is None else voxels[kinds.object]
        has_leaf_angle = np.array([m.leaf_angle != "spherical" for m in entries])[first]
        for row in np.flatnonzero(has_voxels | has_leaf_angle).tolist():
            name = kinds.names[kinds.object[row]]
            entries[first[row]].check_leaves(name, bool(has_voxels[row]))
        leaf_area[has_voxels] = 1.0
        return cls(
            reflectance=np.array(
                [m.diffuse_reflectance(wavelength_nm) for m in entries], np.float64
            )[first],
            scale=np.array(textured, np.float64)[first],
            roughness=np.array([m.roughness or 0.0 for m in entries])[first],
            metalness=np.array([m.metalness for m in entries])[first],
            retro=np.array([m.retro for m in entries], np.bool_)[first],
            passes=np.array([m.transparent == "pass" for m in entries], np.bool_)[first],
            specular=np.array([m.specular for m in entries], np.float64)[first],
            semantic_class=np.array([m.semantic_class for m in entries], np.uint16)[first],
            refractive_index=np.array([m.refractive_index or 0.0 for m in entries])[first],
            attenuation=np.array([m.attenuation_per_m for m in entries], np.float64)[first],
            leaf_area=leaf_area,
            leaf_angle=np.array([angles.index(m.leaf_angle) for m in entries], np.intp)[first],
            leaf_angles=angles,
            gap_fraction=np.array([m.gap_fraction for m in entries], np.float64)[first],
            range_spread_m=np.array([m.range_spread_m for m in entries], np.float64)[first],
            reflectance_spread=np.array([m.reflectance_spread for m in entries], np.float64)[first],
        )

    @property
    def leafy(self) -> Bools:
        """Whether each kind of surface contains leaves.

        The shape is (k,).
        """
        return self.leaf_area > 0

    @property
    def refracts(self) -> Bools:
        """Whether each kind of surface refracts light.

        The shape is (k,).
        """
        return self.refractive_index > 0

    @property
    def has_textures(self) -> bool:
        """Whether the reflectance of any surface depends on its color."""
        return bool(self.scale.any())

    def diffuse_reflectances(self, kind_indices: Integers, luminance: Floats | None) -> Floats:
        """Return the fractions of light that surfaces scatter.

        Parameters
        ----------
        kind_indices
            Kind of each surface. Shape (n,).
        luminance
            Luminance of the color at each hit, which is required if the table has textures. Shape
            (n,).

        Returns
        -------
        array
            Fraction for each surface. Shape (n,).
        """
        shares = self.reflectance[kind_indices]
        if luminance is not None:
            scale = self.scale[kind_indices]
            bright = np.minimum(np.maximum(scale * luminance, DARKEST), 1.0)
            shares = bright if self.scale.all() else np.where(scale > 0, bright, shares)
        return shares

    def relative_energy(
        self, kind_indices: Integers, cosine: Floats, luminance: Floats | None = None
    ) -> Floats:
        """Return the energy from surfaces relative to a white surface at normal incidence.

        Parameters
        ----------
        kind_indices
            Kind of each surface. Shape (n,).
        cosine
            Cosine of the angle of incidence. Shape (n,).
        luminance
            Luminance of the color at each hit, which is required if the table has textures. Shape
            (n,).

        Returns
        -------
        array
            Relative light for each surface. Shape (n,).
        """
        shares = self.diffuse_reflectances(kind_indices, luminance)
        back = shares * np.where(self.retro[kind_indices], RETRO_GAIN, cosine)
        if self.roughness.any():
            rough = np.flatnonzero(self.roughness[kind_indices])
            metal = self.metalness[kind_indices[rough]]
            diffuse = shares[rough]
            front = POLISHED * (1 - metal) + diffuse * metal
            back[rough] *= 1 - metal
            back[rough] += front * glossy_reflection(
                cosine[rough], self.roughness[kind_indices[rough]]
            )
        return back


def glossy_reflection(cosine: Floats, roughness: Floats) -> Floats:
    """Return the specular reflection of rough surfaces, relative to a white diffuser.

    The microfacets have the GGX distribution of Walter et al. (2007) with Smith shadowing. As in
    glTF 2.0, the width of the distribution is the square of the roughness. Because the light source
    and the receiver are in the same direction, the light is π D G / (4 cos θ). It must be
    multiplied by the reflectance at normal incidence.
    """
    width = np.square(roughness**2)
    square = cosine**2
    spread = 1 - square * (1 - width)
    return np.asarray(width / (4 * spread**2 * np.sqrt(square + width * (1 - square))))


def fresnel(cosine: Any, index: Any = GLASS_INDEX) -> Any:
    """Return the fraction of unpolarized light that a surface reflects.

    The fraction follows from Fresnel's equations. `index` is the refractive index behind the
    surface divided by the index in front of it. If it is less than 1, all light is reflected at
    grazing angles.
    """
    inside = np.sqrt(np.maximum(1 - (1 - cosine**2) / (index * index), 0.0))
    perpendicular = (cosine - index * inside) / (cosine + index * inside)
    parallel = (inside - index * cosine) / (inside + index * cosine)
    return (perpendicular**2 + parallel**2) / 2


def wet_surface_factor(cosine: Any, reflectance: Any) -> Any:
    """Return the light from matte surfaces under a film of water, relative to dry surfaces.

    The result is ``T² / (n² (1 - p ρ))``. Light passes through the surface of the film twice, with
    the Fresnel transmittance T. Its solid angle changes by the factor n², and a fraction p of the
    diffuse light in the water is reflected back to the ground (Lekner and Dorf 1988, Ångström
    1925).
    """
    return water_film_factor(fresnel(cosine, WATER_INDEX), reflectance)


def water_film_factor(mirrored: Any, reflectance: Any) -> Any:
    """Compute `wet_surface_factor` from the reflectance of the film of water."""
    through = (1 - mirrored) / WATER_INDEX
    return through * through / (1 - WATER_INWARDS * reflectance)


def normal_incidence_energy(distance: Any, extinction: float = 0.0) -> Any:
    """Return the energies from white surfaces at normal incidence and the given distances.

    The distances are in meters.
    """
    distance = np.maximum(distance, NEAREST_M)
    nearer = np.square(REFERENCE_M / distance)
    return nearer * exp(-2 * extinction * distance) if extinction else nearer


def extinction(visibility_km: float | None, wavelength_nm: float) -> float:
    """Return the extinction coefficient of fog and haze at the given wavelength, in 1/m.

    Parameters
    ----------
    visibility_km
        Meteorological optical range in kilometers, over which the light is attenuated to 5 %
        (WMO-No. 8; ICAO Annex 3). None stands for clear air without extinction.
    wavelength_nm
        Wavelength of the laser in nanometers.

    Notes
    -----
    The wavelength dependence follows Kruse, McGlauchlin and McQuistan (1962). Their formula uses
    the visibility of Koschmieder (1924) at a contrast of 2 %, which is 1.31 times the
    meteorological optical range.

    Examples
    --------
    >>> round(1000 * extinction(1.0, 550), 2), round(1000 * extinction(1.0, 905), 2)  # 1/km
    (3.0, 2.18)
    """
    if visibility_km is None:
        return 0.0
    v = visibility_km / MOR_SHARE
    q = 1.6 if v > 50 else 1.3 if v > 6 else 0.585 * float(power(v, 1 / 3))
    return float(_KOSCHMIEDER / v * float(power(wavelength_nm / 550, -q)) / 1000)

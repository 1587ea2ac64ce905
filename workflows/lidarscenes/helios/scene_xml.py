"""Convert HELIOS++ scenes to entries of `scene.files`."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property, partial
from glob import escape
from itertools import cycle
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np

from lidarsim.errors import LidarError, prefix_errors
from lidarsim.io.input_files import read_input_text
from lidarsim.motion.trajectory import Pose
from lidarsim.numerics.arrays import Floats
from lidarsim.scene.actors import join_meshes
from lidarsim.scene.files.meshfile import load_meshes
from lidarsim.scene.object_names import unique_names
from lidarsim.scene.scene import Scene
from lidarsim.scene.scene_instances import MAX_COORDINATE_M, SceneInstance
from lidarsim.scene.scene_mesh import SceneMesh
from lidarsim.scene.simplified import SimplifiedScene
from lidarsim.scene.transform import Transform

from ..procedural.floor import surface_heights
from .files import Assets, read_file, read_number, read_rotation, round_values

# Makes a mesh with a surfel for each cubic cell that contains points. The arguments are the path of
# the file, the points (n, 3) in meters, and the edge length of the cells in meters.
SurfelMaker = Callable[[Path, Floats, float], SceneMesh]

_LOADERS = ("objloader", "detailedvoxels", "geotiffloader", "xyzloader")


@dataclass
class HeliosPart:
    """A mesh file in a scene, and how it is rotated, scaled, and translated."""

    assets: Assets
    file: Path
    up_axis: str | None
    rotation: Floats  # (3, 3)
    scale: float
    offset: Floats  # (3,) in meters
    falls: bool  # whether the part is moved vertically to stand on the ground
    library: Path | None = None  # file with the material of a part that is not an .obj file
    material: str = ""  # name of the material in the library
    surfels: SceneMesh | None = None  # surfels made from a file of points

    @cached_property
    def materials(self) -> dict[str, dict[str, str]]:
        """The HELIOS++ attributes of all materials that the faces use, by name."""
        text = _text(self.file) if self.file.suffix.lower() == ".obj" else ""
        used = {self.material, *re.findall(r"^\s*usemtl\s+(.+?)\s*$", text, re.MULTILINE)}
        values_by_material: dict[str, dict[str, str]] = {}  # {name of a material: values}
        names = re.findall(r"^\s*mtllib\s+(.+?)\s*$", text, re.MULTILINE)
        libraries = [self.file.parent / name for name in names]
        for name, library in zip(names, libraries, strict=True):
            self.assets.check_allowed(library, name)
        libraries += [self.library] if self.library else []
        for library in libraries:
            values: dict[str, str] = {}
            for line in _text(library).splitlines():
                words = line.split()
                if words[:1] == ["newmtl"] and len(words) > 1:
                    name = line.split(maxsplit=1)[1].strip()  # names may have spaces
                    values = values_by_material.setdefault(name, {})
                elif len(words) > 1 and words[0].startswith("helios_"):
                    values[words[0].removeprefix("helios_")] = words[1]
        return {name: values for name, values in values_by_material.items() if name in used}

    def material_fields(self, spectra: Callable[[str], float | None]) -> dict[str, dict[str, Any]]:
        """Return the `materials` fields for each material, which are reflectance and class.

        `spectra` returns the reflectance for the name of a spectrum.
        """
        kinds: dict[str, dict[str, Any]] = {}
        for name, values in self.materials.items():
            share = None
            if "reflectance" in values:
                share = read_number(values, "reflectance", 0)
                share = share if share <= 1 else share / 100
            elif "spectra" in values:
                share = spectra(values["spectra"])
            kind: dict[str, Any] = {}
            if share is not None:
                kind["reflectance"] = round_values(np.clip(share, 0, 1))
            if "classification" in values:
                kind["class"] = int(read_number(values, "classification", 0))
            kinds[name] = kind
        return kinds

    @property
    def is_ground(self) -> bool:
        """Whether platforms and other parts stand on this part."""
        if self.surfels is not None and self.library is None:
            return True
        grounds = (values.get("isGround", "").lower() for values in self.materials.values())
        return any(ground in ("true", "1") for ground in grounds)

    def meshes(self) -> tuple[SceneMesh | SceneInstance, ...]:
        """Return the meshes of this part in world coordinates."""
        placed = Transform(self.rotation * self.scale, self.offset)
        if (points := self.surfels) is not None:
            return (points.affine_transform(points.name, placed.linear, placed.offset),)
        return load_meshes(
            self.file,
            up_axis=self.up_axis,
            transform=placed,
            materials=True,
            report=lambda _: None,
        )

    def entry(self, name: str) -> dict[str, Any]:
        """Return the part's entry in `scene.files`, with `name` as its file."""
        angles = Pose.from_rotation((0, 0, 0), self.rotation)
        degrees = (angles.roll_deg, angles.pitch_deg, angles.yaw_deg)
        placement = {
            "up_axis": (self.up_axis, None),
            "scale": (round_values(self.scale), 1.0),
            "rotation_deg": (round_values(degrees), [0.0, 0.0, 0.0]),
            "translation": (round_values(self.offset), [0.0, 0.0, 0.0]),
        }
        changed = {key: value for key, (value, default) in placement.items() if value != default}
        return {"file": name, **changed}


class HeliosScene:
    """The parts of a scene, some of which form the ground.

    `folder` receives the meshes that are made from points.
    """

    def __init__(
        self, element: Element, assets: Assets, folder: Path, surfels: SurfelMaker
    ) -> None:
        self._assets = assets
        self._folder = folder
        self._surfels = surfels
        self.unread: list[str] = []
        self._missing: set[str] = set()
        self._moving: dict[str, list[str]] = {"dmotion": [], "swap": []}  # parts by kind of motion
        self.parts: list[HeliosPart] = []
        name = f"scene {element.get('id')!r}"
        for index, part in enumerate(element.findall("part")):
            with prefix_errors(f"{name}, part {index}"):
                self.parts += self._read(part, f"part {index}")
        if not self.parts:
            raise LidarError(
                f"{name} has no part with a supported loader. Supported loaders are "
                f"{' and '.join(_LOADERS)}."
            )
        for falling in self.parts:
            if falling.falls:
                self._let_fall(falling)

    def _read(self, part: Element, name: str) -> list[HeliosPart]:
        """Read a <part>. Each file of its loader becomes a part."""
        for tag, moving in self._moving.items():
            if part.find(tag) is not None:
                moving.append(name)
        draft = _PartDraft()
        for step in part.findall("filter"):
            kind = step.get("type", "").lower()
            params = {param.get("key", ""): param for param in step.findall("param")}
            text = {key: param.get("value", "") for key, param in params.items()}
            mode = text.get("intersectionMode", "transmittive").lower()
            if kind == "detailedvoxels" and mode != "transmittive":
                files_text = text.get("filepath") or text.get("efilepath", "")
                self.unread.append(
                    f"{name}, {kind} of {files_text} with intersectionMode {mode} (skipped)"
                )
                return []
            if kind in _LOADERS:
                self._load(draft, kind, text, name)
            else:
                draft.transform(kind, text, params.get("rotation"))
        return draft.parts(self._assets)

    def _load(self, draft: _PartDraft, kind: str, text: dict[str, str], name: str) -> None:
        """Set the files of a part from the parameters of its loader."""
        draft.files = _files(text, self._assets)
        if kind == "objloader":
            draft.up_axis = text.get("up")
        else:
            draft.material = text.get("matname", "")
            draft.library = self._assets.find_file(text["matfile"]) if "matfile" in text else None
        if kind == "xyzloader":
            draft.surfels = [self._surfels(file, *_points(file, text)) for file in draft.files]
            number_of_part = name.split()[-1]
            draft.files = [
                self._folder / f"{file.stem}-{number_of_part}.glb" for file in draft.files
            ]
        if "ladlut" in text:
            self.unread.append(f"ladlut in {name} (leaf angles are spherical)")

    @cached_property
    def _ground(self) -> Scene | None:
        """The ground parts as a simplified scene, or None if there are none."""
        meshes = [mesh for part in self.parts if part.is_ground for mesh in part.meshes()]
        return SimplifiedScene.from_scene(Scene.from_meshes(meshes)).scene if meshes else None

    def height(self, x: float, y: float) -> float:
        """Return the height of the lowest ground at x and y in meters, or 0 without ground."""
        heights = np.zeros(0) if self._ground is None else surface_heights(self._ground, x, y)
        if not len(heights):
            self._missing.add(f"{x:g}, {y:g}")
            return 0.0
        return float(heights.min())

    def _let_fall(self, part: HeliosPart) -> None:
        """Move a part vertically until its lowest point touches the ground."""
        points = join_meshes("", part.meshes()).vertices
        x, y, z = points[points[:, 2].argmin()].tolist()
        part.offset[2] += self.height(x, y) - z

    def materials(self, wavelength_nm: float) -> list[dict[str, Any]]:
        """Return the entries in `materials` for all objects.

        Objects whose faces differ have an entry for each of their materials.
        """
        spectra = partial(self._reflectance, wavelength_nm)
        kinds = [part.material_fields(spectra) for part in self.parts]
        if not any(kind for part_kinds in kinds for kind in part_kinds.values()):
            return []
        meshes = [part.meshes() for part in self.parts]
        names = iter(unique_names([mesh.name for part_meshes in meshes for mesh in part_meshes]))
        entries = [
            entry
            for part_meshes, part_kinds in zip(meshes, kinds, strict=True)
            for mesh in part_meshes
            for entry in _entries(next(names), mesh, part_kinds)
        ]
        return [*entries, {"objects": "*"}]

    def _reflectance(self, wavelength_nm: float, name: str) -> float | None:
        """Return the reflectance at a wavelength, according to a named spectrum.

        Returns None if the spectrum is missing.
        """
        for root in self._assets.folders:
            for folder in (root / "spectra", root / "data" / "spectra"):
                self._assets.check_allowed(folder / f"{name}.txt", name)
                text = _text(folder / f"{name}.txt")
                rows = re.findall(r"^([\d.]+)\s+([\d.]+)\s*$", text, re.MULTILINE)
                if rows:  # micrometers and percent
                    lengths, shares = np.array(sorted((float(x), float(y)) for x, y in rows)).T
                    return float(np.interp(wavelength_nm / 1000, lengths, shares) / 100)
        self.unread.append(
            f"the spectrum {name!r}, which is missing (a reflectance of 0.5 is used)"
        )
        return None

    def unsupported_features(self) -> list[str]:
        """Describe the unsupported features of the scene, after all parts were read."""
        lines = []
        for tag, parts in self._moving.items():
            if len(parts) == 1:
                lines.append(f"<{tag}> in {parts[0]} (the part is static)")
            elif parts:
                several = f"{len(parts)} parts, {parts[0]} to {parts[-1]}"
                lines.append(f"<{tag}> in {several} (the parts are static)")
        lines += self.unread
        if self._missing:
            positions = "; ".join(sorted(self._missing))
            lines.append(f"onGround at positions without ground, {positions} (z is 0)")
        return lines


@dataclass
class _PartDraft:
    """A <part> to which filters are being applied in their order."""

    files: list[Path] = field(default_factory=list)
    up_axis: str | None = None
    rotation: Floats = field(default_factory=lambda: np.eye(3))
    scale: float = 1.0
    offset: Floats = field(default_factory=lambda: np.zeros(3))
    falls: bool = False
    library: Path | None = None
    material: str = ""
    surfels: list[SceneMesh | None] = field(default_factory=lambda: [None])

    def transform(self, kind: str, text: dict[str, str], rotations: Element | None) -> None:
        """Apply a filter that rotates, scales, or moves the part."""
        if kind == "rotate":
            self.rotation = read_rotation(rotations) @ self.rotation
        elif kind == "scale":
            (scale,) = _numbers(text.get("scale", ""), 1)
            self.scale = float(scale or 1.0)
        elif kind == "translate":
            self.offset = _numbers(text.get("offset", ""), 3)
            self.falls = text.get("onGround", "0") != "0"
        else:
            raise LidarError(
                f"the filter {kind!r} is unknown. Supported filters are {', '.join(_LOADERS)}, "
                "rotate, scale and translate."
            )

    def parts(self, assets: Assets) -> list[HeliosPart]:
        """Create a part for each file.

        Raises LidarError if there are no files.
        """
        if not self.files:
            raise LidarError("none of its filters loads a file.")
        return [
            HeliosPart(
                assets=assets,
                file=file,
                up_axis=self.up_axis if self.up_axis in ("y", "z") else None,
                rotation=self.rotation,
                scale=self.scale,
                offset=self.offset.copy(),
                falls=self.falls,
                library=self.library,
                material=self.material,
                surfels=mesh,
            )
            for file, mesh in zip(self.files, cycle(self.surfels))
        ]


def _entries(
    name: str, mesh: SceneMesh | SceneInstance, kinds: dict[str, dict[str, Any]]
) -> list[dict[str, Any]]:
    """Return an object's entries in `materials`, given the fields for each material."""
    shape = mesh.mesh if isinstance(mesh, SceneInstance) else mesh
    objects = escape(name)
    if shape.materials is None:  # the part has at most one material
        return [{"objects": objects, **kind} for kind in kinds.values() if kind][:1]
    object_kinds = {material: kinds.get(material, {}) for material in shape.materials.names}
    first, *following = object_kinds.values()
    if all(kind == first for kind in following):
        return [{"objects": objects, **first}] if first else []
    return [
        {"objects": objects, "material": escape(material), **kind}
        for material, kind in object_kinds.items()
        if kind
    ]


def _files(text: dict[str, str], assets: Assets) -> list[Path]:
    """Return a loader's files, given by name or by a folder and a regular expression."""
    if "efilepath" not in text:
        return [assets.find_file(text.get("filepath", ""))]
    folder, _, names = text["efilepath"].rpartition("/")
    try:
        fits = re.compile(names)
    except re.error as error:
        raise LidarError(
            f"efilepath is {text['efilepath']!r}, which is not a valid regular expression: {error}."
        ) from error
    for root in assets.folders:
        if (root / folder).is_dir():
            paths = sorted(p for p in (root / folder).iterdir() if fits.fullmatch(p.name))
            for path in paths:
                assets.check_allowed(path, text["efilepath"])
            if paths:
                return paths
    raise LidarError(f"no file matches the efilepath {text['efilepath']!r}.")


def _points(path: Path, settings: dict[str, str]) -> tuple[Floats, float]:
    """Return the points in a file, and the cell size for its surfels, both in meters."""
    separators = dict.fromkeys(map(ord, settings.get("separator") or " "), " ")
    lines = read_file(path).decode("utf-8", "replace").translate(separators).splitlines()
    if not any(line.partition("//")[0].strip() for line in lines):
        raise LidarError(f"{path} has no points.")
    try:
        points = np.loadtxt(lines, comments="//", usecols=(0, 1, 2), ndmin=2)
    except ValueError as error:
        raise LidarError(
            f"{path} has rows that are not points: {str(error).rstrip('.')}."
        ) from error
    if not (np.abs(points) <= MAX_COORDINATE_M).all():  # also rejects NaN
        raise LidarError(
            f"{path} has points that are not finite, or more than {MAX_COORDINATE_M / 1000:,.0f} "
            "km away. Remove these points."
        )
    return points, read_number(settings, "voxelSize", 1.0) or 1.0


def _text(path: Path) -> str:
    """Return the content of a file, or an empty string if the file cannot be read."""
    try:
        return read_input_text(path, "replace")
    except (OSError, ValueError, LidarError):  # ValueError for a null character in the name
        return ""


def _numbers(text: str, count: int) -> Floats:
    """Parse `count` finite numbers that are separated by semicolons.

    Raises LidarError if the text is invalid.
    """
    try:
        values = np.array([float(word) for word in text.split(";")])
    except ValueError:
        values = np.full(0, np.nan)
    if values.shape != (count,) or not np.isfinite(values).all():
        raise LidarError(f"{text!r} must be {count} finite number{'s' * (count > 1)}.")
    return values

"""Scenes of HELIOS++ as entries of `scene.files`."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property, partial
from glob import escape
from itertools import cycle
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np

from lidarsim.base.arrays import Floats
from lidarsim.base.errors import LidarError, prefixed
from lidarsim.base.input_files import read_input_text
from lidarsim.scene.actors import join_meshes
from lidarsim.scene.files.meshfile import load_meshes
from lidarsim.scene.object_names import unique_names
from lidarsim.scene.scene import Scene
from lidarsim.scene.scene_instances import SceneInstance
from lidarsim.scene.scene_mesh import SceneMesh
from lidarsim.scene.simplified import SimplifiedScene
from lidarsim.scene.transform import Transform
from lidarsim.sensor import Pose

from ..procedural.floor import heights_at
from .files import Assets, clean, number, read, rotation

# Makes a mesh of surfels of a file of points: path, points (n, 3) in metres, and the edge in metres
# of the cubic cells, each of which has one surfel.
SurfelMaker = Callable[[Path, Floats, float], SceneMesh]

_LOADERS = ("objloader", "detailedvoxels", "geotiffloader", "xyzloader")


@dataclass
class HeliosPart:
    """One mesh file of a scene and its placement: rotated, scaled, moved."""

    file: Path
    up_axis: str | None
    turn: Floats
    scale: float
    offset: Floats
    falls: bool  # until it stands on the ground
    library: Path | None = None  # of the material of what is no .obj, and its name there
    material: str = ""
    surfels: SceneMesh | None = None  # of a file of points

    @cached_property
    def materials(self) -> dict[str, dict[str, str]]:
        """Values that HELIOS++ reads of the materials of its faces, {name: values}."""
        text = _text(self.file) if self.file.suffix.lower() == ".obj" else ""
        used = {self.material, *re.findall(r"^\s*usemtl\s+(.+?)\s*$", text, re.MULTILINE)}
        values_of: dict[str, dict[str, str]] = {}  # {name of a material: values}
        named = re.findall(r"^\s*mtllib\s+(.+?)\s*$", text, re.MULTILINE)
        libraries = [self.file.parent / name for name in named]
        libraries += [self.library] if self.library else []
        for library in libraries:
            values: dict[str, str] = {}
            for line in _text(library).splitlines():
                words = line.split()
                if words[:1] == ["newmtl"] and len(words) > 1:
                    name = line.split(maxsplit=1)[1].strip()  # which may have spaces
                    values = values_of.setdefault(name, {})
                elif len(words) > 1 and words[0].startswith("helios_"):
                    values[words[0].removeprefix("helios_")] = words[1]
        return {name: values for name, values in values_of.items() if name in used}

    def kinds(self, spectra: Callable[[str], float | None]) -> dict[str, dict[str, Any]]:
        """Reflectance and class of each material of its faces, {name: entries of a scenario}."""
        kinds: dict[str, dict[str, Any]] = {}
        for name, values in self.materials.items():
            share = None
            if "reflectance" in values:
                share = number(values, "reflectance", 0)
                share = share if share <= 1 else share / 100
            elif "spectra" in values:
                share = spectra(values["spectra"])
            kind: dict[str, Any] = {}
            if share is not None:
                kind["reflectance"] = clean(np.clip(share, 0, 1))
            if "classification" in values:
                kind["class"] = int(number(values, "classification", 0))
            kinds[name] = kind
        return kinds

    @property
    def is_ground(self) -> bool:
        """True if platforms and parts can stand on the part, and for points without material."""
        if self.surfels is not None and self.library is None:
            return True
        grounds = (values.get("isGround", "").lower() for values in self.materials.values())
        return any(ground in ("true", "1") for ground in grounds)

    def meshes(self) -> tuple[SceneMesh | SceneInstance, ...]:
        """Read the meshes of the part, in world coordinates."""
        placed = Transform(self.turn * self.scale, self.offset)
        if (points := self.surfels) is not None:
            return (points.moved(points.name, placed.linear, placed.offset),)
        return load_meshes(
            self.file,
            up_axis=self.up_axis,
            transform=placed,
            materials=True,
            tell=lambda _: None,
        )

    def entry(self, name: str) -> dict[str, Any]:
        """Return the entry of `scene.files` for the part, whose file has a name."""
        angles = Pose.of((0, 0, 0), self.turn)
        degrees = (angles.roll_deg, angles.pitch_deg, angles.yaw_deg)
        placement = {
            "up_axis": (self.up_axis, None),
            "scale": (clean(self.scale), 1.0),
            "rotation_deg": (clean(degrees), [0.0, 0.0, 0.0]),
            "translation": (clean(self.offset), [0.0, 0.0, 0.0]),
        }
        changed = {key: value for key, (value, usual) in placement.items() if value != usual}
        return {"file": name, **changed}


class HeliosScene:
    """The parts of a scene, and the ground among them; meshes of points go into a folder `out`."""

    def __init__(self, element: Element, assets: Assets, out: Path, surfels: SurfelMaker) -> None:
        self._assets = assets
        self._out = out
        self._surfels = surfels
        self.unread: list[str] = []
        self._missing: set[str] = set()
        self._moving: dict[str, list[str]] = {"dmotion": [], "swap": []}  # parts by their motion
        self.parts: list[HeliosPart] = []
        name = f"scene {element.get('id')!r}"
        for index, part in enumerate(element.findall("part")):
            with prefixed(f"{name}, part {index}"):
                self.parts += self._read(part, f"part {index}", assets)
        if not self.parts:
            raise LidarError(
                f"{name} has no part that can be read: only those of {' and '.join(_LOADERS)} are."
            )
        for falling in self.parts:
            if falling.falls:
                self._let_fall(falling)

    def _read(self, part: Element, name: str, assets: Assets) -> Iterator[HeliosPart]:
        """Read a <part>: one part for each file of its loader, placed by its filters."""
        for tag, moving in self._moving.items():
            if part.find(tag) is not None:
                moving.append(name)
        files: list[Path] = []
        up_axis: str | None = None
        rotated = np.eye(3)
        scale = 1.0
        offset = np.zeros(3)
        falls = False
        library: Path | None = None
        material = ""
        points: list[SceneMesh | None] = [None]
        for step in part.findall("filter"):
            kind = step.get("type", "").lower()
            params = {param.get("key", ""): param for param in step.findall("param")}
            text = {key: param.get("value", "") for key, param in params.items()}
            mode = text.get("intersectionMode", "transmittive").lower()
            if kind == "detailedvoxels" and mode != "transmittive":
                files_text = text.get("filepath") or text.get("efilepath", "")
                self.unread.append(
                    f"{name}, {kind} of {files_text}: intersectionMode {mode}, left out"
                )
                return
            if kind in _LOADERS:
                files = _files(text, assets)
                if kind == "objloader":
                    up_axis = text.get("up")
                else:
                    material = text.get("matname", "")
                    library = assets.file(text["matfile"]) if "matfile" in text else None
                if kind == "xyzloader":
                    points = [self._surfels(file, *_points(file, text)) for file in files]
                    files = [self._out / f"{file.stem}-{name.split()[-1]}.glb" for file in files]
                if "ladlut" in text:
                    self.unread.append(f"{name}, ladlut: leaf angles are spherical")
            elif kind == "rotate":
                rotated = rotation(params.get("rotation")) @ rotated
            elif kind == "scale":
                (scale,) = _numbers(text.get("scale", ""), 1)
                scale = scale or 1.0
            elif kind == "translate":
                offset = _numbers(text.get("offset", ""), 3)
                falls = text.get("onGround", "0") != "0"
            else:
                raise LidarError(
                    f"the filter {kind!r} is not known; there are {', '.join(_LOADERS)}, rotate, "
                    "scale, translate."
                )
        if not files:
            raise LidarError("no filter loads a file.")
        for file, mesh in zip(files, cycle(points)):
            yield HeliosPart(
                file=file,
                up_axis=up_axis if up_axis in ("y", "z") else None,
                turn=rotated,
                scale=float(scale),
                offset=offset.copy(),
                falls=falls,
                library=library,
                material=material,
                surfels=mesh,
            )

    @cached_property
    def _ground(self) -> Scene | None:
        meshes = [mesh for part in self.parts if part.is_ground for mesh in part.meshes()]
        return SimplifiedScene.from_scene(Scene.from_meshes(meshes)).scene if meshes else None

    def height(self, x: float, y: float) -> float:
        """Return the height of the lowest ground at x, y, in metres; 0 without ground."""
        heights = np.zeros(0) if self._ground is None else heights_at(self._ground, x, y)
        if not len(heights):
            self._missing.add(f"{x:g}, {y:g}")
            return 0.0
        return float(heights.min())

    def _let_fall(self, part: HeliosPart) -> None:
        """Move a part up or down so that its lowest point stands on the ground."""
        points = join_meshes("", part.meshes()).vertices
        x, y, z = points[points[:, 2].argmin()].tolist()
        part.offset[2] += self.height(x, y) - z

    def materials(self, wavelength_nm: float) -> list[dict[str, Any]]:
        """Return entries of `materials` for objects, or for faces with several materials."""
        spectra = partial(self._reflectance, wavelength_nm)
        kinds = [part.kinds(spectra) for part in self.parts]
        if not any(kind for of_part in kinds for kind in of_part.values()):
            return []
        meshes = [part.meshes() for part in self.parts]
        names = iter(unique_names([mesh.name for of in meshes for mesh in of]))
        entries = [
            entry
            for of, of_part in zip(meshes, kinds, strict=True)
            for mesh in of
            for entry in _entries(next(names), mesh, of_part)
        ]
        return [*entries, {"objects": "*"}]

    def _reflectance(self, wavelength_nm: float, name: str) -> float | None:
        """Return the reflectance at a wavelength by a named spectrum; None without the spectrum."""
        for place in self._assets.places:
            for folder in (place / "spectra", place / "data" / "spectra"):
                text = _text(folder / f"{name}.txt")
                rows = re.findall(r"^([\d.]+)\s+([\d.]+)\s*$", text, re.MULTILINE)
                if rows:  # micrometres and per cent
                    lengths, shares = np.array(sorted((float(x), float(y)) for x, y in rows)).T
                    return float(np.interp(wavelength_nm / 1000, lengths, shares) / 100)
        self.unread.append(f"the spectrum {name!r}, which is not there: its reflectance is 0.5")
        return None

    def left_out(self) -> list[str]:
        """List the unsupported features, after everything was read."""
        lines = []
        for tag, parts in self._moving.items():
            if len(parts) == 1:
                lines.append(f"<{tag}> of {parts[0]}: it stands as it is at first")
            elif parts:
                several = f"{len(parts)} parts, {parts[0]} to {parts[-1]}"
                lines.append(f"<{tag}> of {several}: they stand as they are at first")
        lines += self.unread
        if self._missing:
            positions = "; ".join(sorted(self._missing))
            lines.append(f"onGround at {positions}: no ground there, so z is 0")
        return lines


def _entries(
    name: str, mesh: SceneMesh | SceneInstance, kinds: dict[str, dict[str, Any]]
) -> list[dict[str, Any]]:
    """Return entries of `materials` for an object of a part, whose materials have kinds."""
    shape = mesh.mesh if isinstance(mesh, SceneInstance) else mesh
    objects = escape(name)
    if shape.materials is None:  # of a file without materials, to which the part gives one
        return [{"objects": objects, **kind} for kind in kinds.values() if kind][:1]
    of_object = {material: kinds.get(material, {}) for material in shape.materials.names}
    first, *others = of_object.values()
    if all(kind == first for kind in others):
        return [{"objects": objects, **first}] if first else []
    return [
        {"objects": objects, "material": escape(material), **kind}
        for material, kind in of_object.items()
        if kind
    ]


def _files(text: dict[str, str], assets: Assets) -> list[Path]:
    """Return the files of a loader: by name, or in a folder by an expression for names."""
    if "efilepath" not in text:
        return [assets.file(text.get("filepath", ""))]
    folder, _, names = text["efilepath"].rpartition("/")
    try:
        fits = re.compile(names)
    except re.error as error:
        raise LidarError(f"efilepath is {text['efilepath']!r}: {error}.") from error
    for root in assets.places:
        if (root / folder).is_dir():
            paths = sorted(p for p in (root / folder).iterdir() if fits.fullmatch(p.name))
            if paths:
                return paths
    raise LidarError(f"no file fits the efilepath {text['efilepath']!r}.")


def _points(path: Path, settings: dict[str, str]) -> tuple[Floats, float]:
    """Read a file of points by the settings of an `xyzloader`.

    Return the points (n, 3) and the edge of a surfel's cell, both in metres.
    """
    separators = dict.fromkeys(map(ord, settings.get("separator") or " "), " ")
    lines = read(path).decode("utf-8", "replace").translate(separators).splitlines()
    try:
        points = np.loadtxt(lines, comments="//", usecols=(0, 1, 2), ndmin=2)
    except ValueError as error:
        raise LidarError(f"{path} has rows that are no points: {error}.") from error
    return points, number(settings, "voxelSize", 1.0) or 1.0


def _text(path: Path) -> str:
    """Return the content of a file; empty if the file cannot be read."""
    try:
        return read_input_text(path, "replace")
    except (OSError, ValueError, LidarError):  # a zero in the name
        return ""


def _numbers(text: str, count: int) -> Floats:
    """Read numbers separated by semicolons."""
    try:
        values = np.array([float(word) for word in text.split(";")])
    except ValueError:
        values = np.full(0, np.nan)
    if values.shape != (count,) or not np.isfinite(values).all():
        raise LidarError(f"{text!r} is not {count} number{'s' * (count > 1)}.")
    return values

"""Read the meshes of links, in link coordinates."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple
from xml.etree.ElementTree import Element

import numpy as np

from lidarsim.errors import LidarError, prefix_errors
from lidarsim.io.allowance import Allowance
from lidarsim.io.input_files import read_input
from lidarsim.numerics.vectors import matmul
from lidarsim.scene.actors import join_meshes
from lidarsim.scene.colors import Colors
from lidarsim.scene.face_materials import FaceMaterials
from lidarsim.scene.files.meshfile import load_meshes
from lidarsim.scene.files.scene_graph import ReadOptions
from lidarsim.scene.masks import MaskError
from lidarsim.scene.scene_instances import SceneInstance
from lidarsim.scene.scene_mesh import SceneMesh
from lidarsim.words import list_names, printable

from ..files.dae import read_dae
from .appearance import FULL_RETRO, Appearance, read_appearance
from .bodies import GazeboBody, Link
from .frames import child_numbers, read_pose
from .notes import Notes
from .resources import ResourceNotFoundError, Resources, Source
from .sdf_shapes import height_map_mesh, polyline_mesh, shape_mesh
from .visibility_flags import ALL_BITS, read_flags

# Mesh formats that Gazebo reads. Worlds are excluded, because they could include each other.
MESHES = (".dae", ".obj", ".stl", ".glb", ".gltf")


class LinkMesh(NamedTuple):
    """Those shapes of a link that are visible to the same lidars."""

    mesh: SceneMesh
    flags: int  # <visibility_flags> of the first shape
    suffix: str  # suffix of the object's name, empty for the first mesh of a link


@dataclass(eq=False)
class LinkMeshes:
    """Reads the visuals or collision shapes of links. Each file is read only once.

    `masks` are the <visibility_mask> values of the lidars in the world.
    """

    resources: Resources
    options: ReadOptions
    notes: Notes
    allowance: Allowance
    masks: tuple[int, ...] = ()
    # {(path, name of the loading method): meshes}
    _files: dict[tuple[Path, str], list[SceneMesh]] = field(default_factory=dict)
    _links: dict[tuple[int, tuple[float, ...]], list[LinkMesh]] = field(default_factory=dict)

    @property
    def _collisions(self) -> bool:
        """Whether collision shapes are read instead of visuals."""
        return bool(self.options.own.geometry == "collision")

    def link_meshes(
        self, body: GazeboBody, link: Link, name: str, scale: tuple[float, ...]
    ) -> list[LinkMesh]:
        """Return the meshes of a link. All instances of the model share them.

        A link has several meshes if a lidar sees some of its visuals but not others, and none if it
        has no shapes. `name` is the name of the link in the world, for notes. `scale` are factors
        along the axes.
        """
        key = (id(link.element), scale)
        if key not in self._links:
            with prefix_errors(f"link {link.name!r}"):
                self._links[key] = self._read_link(body, link, name, scale)
        return self._links[key]

    def _read_link(
        self, body: GazeboBody, link: Link, name: str, scale: tuple[float, ...]
    ) -> list[LinkMesh]:
        """Read the meshes of a link for `link_meshes`."""
        # Shapes grouped by the masks that see them, as the first shape, its flags, and all meshes.
        groups: dict[tuple[bool, ...], tuple[Element, int, list[SceneMesh]]] = {}
        for shape in self._shapes(link, name):
            flags = ALL_BITS if self._collisions else self._flags_of(shape, name)
            parts = self._shape_meshes(body, link, shape, name, scale) if flags else []
            if parts:
                seen_by = tuple(flags & mask != 0 for mask in self.masks)
                groups.setdefault(seen_by, (shape, flags, []))[2].extend(parts)
        return [
            LinkMesh(
                join_meshes(link.name or "link", parts),
                flags,
                f"/{printable(shape.get('name', '')) or 'visual'}" if number else "",
            )
            for number, (shape, flags, parts) in enumerate(groups.values())
        ]

    def _flags_of(self, shape: Element, name: str) -> int:
        """Return a visual's visibility flags, and add a note if no lidar sees it."""
        with prefix_errors(f"visual {printable(shape.get('name', ''))!r}"):
            flags = read_flags(shape)
        if not flags:
            self.notes.invisible[name] = None
        return flags

    def _shapes(self, link: Link, name: str) -> list[Element]:
        """Return the shapes of a link that have to be read."""
        self.notes.check_children(link.element)
        kind = "collision" if self._collisions else "visual"
        shapes = link.element.findall(kind)
        has_collisions = link.element.find("collision/geometry") is not None
        if has_collisions and not shapes and not self._collisions:
            self.notes.without_visuals[name] = None
        return shapes

    def _shape_meshes(
        self, body: GazeboBody, link: Link, shape: Element, name: str, scale: tuple[float, ...]
    ) -> list[SceneMesh]:
        """Return the meshes of a visual or collision shape in link coordinates."""
        self.notes.check_children(shape)
        with prefix_errors(f"{shape.tag} {printable(shape.get('name', ''))!r}"):
            retro = _retro(link.element, shape)
            if retro > FULL_RETRO:
                self.notes.bright[name] = None
            appearance = read_appearance(shape, retro)
            if appearance.is_hidden:
                self.notes.hidden[name] = None
                return []
            geometry = shape.find("geometry")
            parts = [] if geometry is None else self.geometry_meshes(geometry, link.source)
            pose = read_pose(shape)
            matrix = pose.matrix
            if pose.frame and pose.frame != link.name:
                matrix = matmul(body.frames.transform_between(pose.frame, link.name), matrix)
        linear = matrix[:3, :3] * np.array(scale)
        moved = []
        for part in parts:
            self.allowance.reserve(part.vertices.nbytes + part.faces.nbytes)
            placed = part.affine_transform(part.name, linear, matrix[:3, 3])
            moved.append(self.with_appearance(placed, appearance))
        return moved

    def with_appearance(self, mesh: SceneMesh, appearance: Appearance) -> SceneMesh:
        """Apply a visual's color and material to a mesh that does not define its own."""
        color = appearance.color
        is_plain = mesh.colors is None or appearance.is_retro
        if self.options.colors and color is not None and is_plain:
            mesh = replace(mesh, colors=Colors.plain(color, len(mesh.faces)))
        if self.options.materials and mesh.materials is None:
            mesh = replace(mesh, materials=FaceMaterials.from_name(appearance.material))
        return mesh

    def geometry_meshes(self, geometry: Element, source: Source) -> list[SceneMesh]:
        """Return the meshes of a <geometry>. There are none if the shape has no size or no file."""
        shapes = [child for child in geometry if ":" not in child.tag]
        if not shapes:
            return []
        shape = shapes[0]
        if shape.tag == "mesh":
            self.notes.check_children(shape)
            return self._mesh(shape, source)
        if shape.tag == "heightmap":
            self.notes.check_children(shape)
            return self._height_map(shape, source)
        if shape.tag == "polyline":
            mesh = polyline_mesh(geometry.findall("polyline"))
        else:
            try:
                mesh = shape_mesh(shape)
            except KeyError:
                self.notes.unknown[f"geometry/{printable(shape.tag)[:40]}"] = None
                mesh = None
        return [] if mesh is None else [mesh]

    def _mesh(self, shape: Element, source: Source) -> list[SceneMesh]:
        """Return the scaled meshes in a file, restricted to a <submesh> if there is one."""
        uri = (shape.findtext("uri") or "").strip()
        scale = child_numbers(shape, "scale", 3, "1 1 1")
        meshes = self.file_meshes(uri, source)
        part = shape.find("submesh")
        if part is not None:
            meshes = self._part(meshes, part, uri)
        if not scale.all():
            return []
        return [mesh.affine_transform(mesh.name, np.diag(scale), np.zeros(3)) for mesh in meshes]

    def _part(self, meshes: list[SceneMesh], part: Element, uri: str) -> list[SceneMesh]:
        """Return the meshes that a <submesh> selects, centered if <center> is true."""
        name = printable(part.findtext("name") or "")
        if not name or not meshes:
            return meshes
        chosen = [mesh for mesh in meshes if mesh.name == name]
        chosen = chosen or [mesh for mesh in meshes if mesh.name.lower() == name.lower()]
        if not chosen:
            names = list_names([mesh.name for mesh in meshes], 4)
            self.notes.unread_files[f"submesh {name!r} of {printable(uri)}"] = (
                f"the file contains {names}"
            )
            return []
        if (part.findtext("center") or "").strip() in ("true", "1"):
            bounds = np.concatenate([mesh.bounds for mesh in chosen])
            middle = (bounds.min(axis=0) + bounds.max(axis=0)) / 2
            return [mesh.affine_transform(mesh.name, np.eye(3), -middle) for mesh in chosen]
        return chosen

    def _height_map(self, shape: Element, source: Source) -> list[SceneMesh]:
        """Return a height map as a mesh, or no mesh if its image cannot be used."""
        uri = (shape.findtext("uri") or "").strip()
        file = self._file(uri, source)
        if file is None:
            return []
        if file.path.suffix.lower() in (".tif", ".tiff", ".dem", ".hgt"):
            self.notes.unread_files[printable(uri)] = "it is a raster. Add it to scene.files"
            return []
        self.allowance.add_file(file.path)
        try:
            return [height_map_mesh(shape, file.path, self.allowance)]
        except MaskError as error:
            self.notes.unread_files[printable(uri)] = str(error)
            return []

    def file_meshes(self, uri: str, source: Source) -> list[SceneMesh]:
        """Return the meshes in a file without changing their axes.

        If the file is unusable, the list is empty, and a note is added.
        """
        return self._read_once(uri, source, self._load)

    def skin_meshes(self, uri: str, source: Source) -> list[SceneMesh]:
        """Return an actor's skin in its rest pose.

        If the file is unusable, the list is empty, and a note is added.
        """
        return self._read_once(uri, source, self._load_skin)

    def _read_once(
        self, uri: str, source: Source, load: Callable[[Source], list[SceneMesh]]
    ) -> list[SceneMesh]:
        """Return the meshes in a file, which is loaded on first use.

        If the file is unusable, the list is empty, and a note is added.
        """
        file = self._file(uri, source)
        if file is None:
            return []
        key = file.path.resolve(), load.__name__
        if key not in self._files:
            self._files[key] = []
            try:
                self._files[key] = load(file)
            except LidarError as error:
                self.notes.unread_files[printable(uri)] = _without_path(str(error), file.path)
            self.allowance.add_file(file.path)
        return self._files[key]

    def _load(self, file: Source) -> list[SceneMesh]:
        """Load the meshes in a file.

        Raises LidarError if the file is unusable.
        """
        if file.path.suffix.lower() not in MESHES:
            raise LidarError(f"Gazebo supports only meshes in {', '.join(MESHES)} files.")
        # Gazebo ignores the up axis in COLLADA and glTF files, but not the unit in COLLADA files.
        meshes = load_meshes(
            file.path,
            up_axis="z",
            opacity="mask" if self.options.masks else "ignore",
            colors=self.options.colors,
            materials=self.options.materials,
            assets=self._asset_folders(file),
            report=lambda line: self.notes.of_meshes.setdefault(_without_path(line, file.path)),
        )
        return [mesh.flat() if isinstance(mesh, SceneInstance) else mesh for mesh in meshes]

    def _load_skin(self, file: Source) -> list[SceneMesh]:
        """Load the meshes in a file, including skins in their rest pose."""
        if file.path.suffix.lower() != ".dae":
            return self._load(file)
        options = self.options._replace(
            folders=(file.path.parent.resolve(), *self._asset_folders(file)), skins_at_rest=True
        )
        try:
            with np.errstate(all="ignore"):
                content = read_dae(read_input(file.path), file.path, options)
        except MemoryError:
            raise
        except Exception as error:  # readers raise errors of any class
            raise LidarError(f"{file.path.name} {printable(str(error))}.") from error
        flat = [item.flat() if isinstance(item, SceneInstance) else item for item in content.meshes]
        unit = (content.unit_m or 1.0) * np.eye(3)
        return [mesh.affine_transform(mesh.name, unit, np.zeros(3)) for mesh in flat]

    def _asset_folders(self, file: Source) -> list[Path]:
        """Return the folders that may contain a mesh file's images, its model's textures first."""
        textures = (folder / "materials" / "textures" for folder in file.path.resolve().parents)
        within = (folder for folder in textures if folder.is_relative_to(file.root))
        existing = (folder for folder in within if folder.is_dir())
        return [*existing, file.root, *self.resources.trusted]

    def _file(self, uri: str, source: Source) -> Source | None:
        """Return the file at a URI. If it is missing, add a note and return None."""
        try:
            return self.resources.find_file(uri, source)
        except ResourceNotFoundError as error:
            self.notes.missing_files[str(error) or "a mesh without <uri>"] += 1
            return None


def _retro(link: Element, shape: Element) -> float:
    """Return a shape's <laser_retro>. If it has none, use a collision shape's value, or 0."""
    for candidate in (shape, *link.findall("collision")):
        value = float(child_numbers(candidate, "laser_retro", 1, "0").item())
        if value > 0:
            return value
    return 0.0


def _without_path(line: str, path: Path) -> str:
    """Replace the path of a file in a line of text by the file name."""
    return line.replace(str(path), path.name)

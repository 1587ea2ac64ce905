"""Read Gazebo worlds and models (.sdf and .world) as scenes.

The reader follows the specification of SDFormat 1.12 (http://sdformat.org/spec) and, where it is
ambiguous, the behavior of Gazebo. No package on PyPI reads SDFormat, and libsdformat is only
available as a part of Gazebo.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Literal, NamedTuple
from xml.etree.ElementTree import Element

import numpy as np

from lidarsim.errors import prefix_errors
from lidarsim.io.allowance import Allowance
from lidarsim.numerics.arrays import Floats
from lidarsim.numerics.vectors import matmul
from lidarsim.scene.files.scene_graph import (
    Content,
    MeshFileError,
    NamedFrames,
    ObjectFrame,
    PlacedNode,
    ReadOptions,
    placed_content,
)
from lidarsim.scene.scene_mesh import SceneMesh
from lidarsim.schema.declared import about
from lidarsim.words import list_names, printable

from ..files.lenient_xml import parse_lenient_xml
from .appearance import read_appearance
from .bodies import BodyReader, GazeboBody, Link, PlacedModel, scoped_name
from .frames import child_numbers, read_matrix
from .link_meshes import LinkMeshes
from .notes import Notes
from .resources import Resources, Source
from .sdf_shapes import road_mesh
from .visibility_flags import ALL_BITS, distinct_masks
from .waypoint_actors import read_actors

_ADVICE = "simplify its meshes, or export them in parts"
_OLD_ROOT = "gazebo"  # root element before Gazebo 1.9
_NO_SCALE = (1.0, 1.0, 1.0)


# A model that is farther from the origin along x, y, or z has fallen or was moved by physics. Map
# northings reach 10,000 km, and no world is 1,000 km high.
_REACH_M = np.array([1e7, 1e7, 1e6])


@dataclass(frozen=True)
class GazeboOptions:
    """Options for reading Gazebo worlds."""

    geometry: Annotated[
        Literal["visual", "collision"],
        about("shapes that are read from a Gazebo world: visual or collision", "collision"),
    ] = "visual"


class PlacedLink(NamedTuple):
    """A link that is placed in the world."""

    path: tuple[str, ...]  # names of the enclosing models and of the link
    body: GazeboBody
    link: Link
    matrix: Floats  # (4, 4) matrix to the world
    # Scoped names and (4, 4) matrices of the enclosing models, outermost first.
    models: NamedFrames
    scale: tuple[float, ...]
    is_static: bool  # whether an enclosing model is static

    @property
    def model(self) -> Floats:
        """Matrix of the outermost model.

        The shape is (4, 4).
        """
        return self.models[0][1]

    def frame(self, name: str) -> ObjectFrame:
        """Return the frame of an object in the link, given the name of the object."""
        enclosing = self.models if name == "/".join(self.path) else self.frames
        return ObjectFrame(self.matrix, enclosing, self.is_static)

    @property
    def frames(self) -> NamedFrames:
        """Frames of the enclosing models and of the link itself."""
        return (*self.models, ("/".join(self.path), self.matrix))


@dataclass
class _State:
    """The <state> of a Gazebo classic world. Its poses replace those of the models.

    Poses are in world coordinates, by the names of models and links (MODEL::LINK).
    """

    poses: dict[str, Floats] = field(default_factory=dict)  # (4, 4)
    scales: dict[str, tuple[float, ...]] = field(default_factory=dict)  # scales of models
    inserted: list[Element] = field(default_factory=list)  # models
    deleted: set[str] = field(default_factory=set)  # names of models


@dataclass(eq=False)
class GazeboWorld:
    """A world, or a file that only contains models, with the links of all models."""

    element: Element
    source: Source
    body: GazeboBody
    state: _State
    resources: Resources
    notes: Notes
    allowance: Allowance

    @cached_property
    def links(self) -> list[PlacedLink]:
        """All links except those that are too far away. The models of the latter are noted."""
        links = []
        for link in self._placed_links():
            if is_in_reach(link.matrix):
                links.append(link)
            else:
                self.notes.remote[scoped_name(link.path[:-1])] = None
        return links

    def _placed_links(self) -> Iterator[PlacedLink]:
        """Yield the links of all models, with poses from the state if it contains any."""
        state = self.state
        # Models with the names of their enclosing models, the frames of these models, and whether
        # one of them is static.
        stack: list[tuple[PlacedModel, tuple[str, ...], NamedFrames, bool]] = [
            (child, (), (), False)
            for child in reversed(self.body.children)
            if child.name not in state.deleted
        ]
        while stack:
            instance, outer, models, is_static = stack.pop()
            path = (*outer, instance.name)
            matrix = instance.matrix
            if models:
                matrix = matmul(models[-1][1], matrix)
            matrix = state.poses.get(scoped_name(path), matrix)
            models = (*models, ("/".join(path), matrix))
            is_static = is_static or instance.is_static
            scale = state.scales.get(path[0], _NO_SCALE)
            for link in instance.body.links:
                with prefix_errors(f"model {scoped_name(path)[:80]!r}, link {link.name!r}"):
                    in_model = instance.body.frames.matrix(link.name)
                placed = matmul(matrix, in_model)
                link_path = (*path, link.name)
                placed = state.poses.get(scoped_name(link_path), placed)
                yield PlacedLink(link_path, instance.body, link, placed, models, scale, is_static)
            stack += [
                (child, path, models, is_static) for child in reversed(instance.body.children)
            ]


class PlacedObject(NamedTuple):
    """A stationary object that is placed in the world."""

    node: PlacedNode
    flags: int  # <visibility_flags> of its visuals


def is_in_reach(matrix: Floats) -> bool:
    """Return whether the position in a matrix is finite and plausible for a world."""
    return bool(np.isfinite(matrix).all() and (np.abs(matrix[:3, 3]) < _REACH_M).all())


def read_sdf(data: bytes, path: Path, options: ReadOptions) -> Content:
    """Read the visuals or collision shapes of all links, and the actors."""
    world = load_world(data, path, options.folders)
    content = build_content(world, options)[0]
    if not content.meshes and not content.moving:
        missing = [*world.notes.missing_models, *world.notes.missing_files]
        reason = (
            f". It refers to missing models or files: {list_names(missing, 12)}" if missing else ""
        )
        if world.notes.without_visuals:
            reason += ". Its links have collision shapes. To read them, set geometry: collision"
        reason += "".join(f". It contains {line}" for line in world.notes.remote_lines())
        raise MeshFileError(f"contains nothing that a lidar can detect{reason}")
    return content


def build_content(world: GazeboWorld, options: ReadOptions) -> tuple[Content, list[PlacedObject]]:
    """Convert a world to scene content, and also return its stationary objects.

    The objects include those without an area, which the content lacks.
    """
    notes = world.notes
    masks = distinct_masks(link.link.element for link in world.links)
    meshes = LinkMeshes(world.resources, options, notes, world.allowance, masks)
    objects = []
    for link in world.links:
        parts = meshes.link_meshes(link.body, link.link, scoped_name(link.path), link.scale)
        for part in parts:
            name = "/".join(link.path) + part.suffix
            node = PlacedNode(part.mesh, link.matrix, name, frame=link.frame(name))
            objects.append(PlacedObject(node, part.flags))
    actors = read_actors(world.element, world.source, meshes, notes)
    standing = [node for node in actors.standing if is_in_reach(node.matrix)]
    notes.remote |= {node.name: None for node in actors.standing if not is_in_reach(node.matrix)}
    objects += [PlacedObject(node, ALL_BITS) for node in (*_roads(world, meshes), *standing)]
    content = placed_content([item.node for item in objects])
    content.moving = actors.moving
    content.root_frame = world.element.get("name", "")
    content.empty_frames = [link.frames for link in world.links]
    content.unit_m = 1.0
    content.up_axis = "z"
    content.notes = [*notes.lines()]
    return content, objects


def load_world(data: bytes, path: Path, folders: tuple[Path, ...]) -> GazeboWorld:
    """Read an SDFormat file and the models that it includes.

    Parameters
    ----------
    data
        Content of the file.
    path
        Path of the file.
    folders
        Folder of the file, followed by additional folders that are searched for models.

    Raises
    ------
    LidarError, ValueError, lidarsim.scene.files.scene_graph.MeshFileError
        If the file is invalid or not an SDFormat file.
    """
    root = parse_lenient_xml(data)
    if root.tag == _OLD_ROOT:
        raise MeshFileError(
            "uses the file format of Gazebo before version 1.9. Convert it with `gz sdf -k` from "
            "an old Gazebo release"
        )
    if root.tag not in ("sdf", "model", "world"):
        raise MeshFileError(
            f"is an XML file, but not an SDFormat file. Its root element is <{root.tag[:40]}>"
        )
    notes = Notes()
    allowance = Allowance(len(data), _ADVICE)
    resources = Resources.for_world(path, folders[1:])
    element = _world_element(root, notes)
    state = _state_of(element)
    for model in state.inserted:
        element.append(model)
    body = BodyReader(resources, notes, allowance).world(element, resources.world)
    return GazeboWorld(
        element=element,
        source=resources.world,
        body=body,
        state=state,
        resources=resources,
        notes=notes,
        allowance=allowance,
    )


def _world_element(root: Element, notes: Notes) -> Element:
    """Return the <world> in a file, or create one that contains the file's models."""
    if root.tag == "world":
        return root
    if root.tag == "sdf":
        notes.check_children(root)
        worlds = root.findall("world")
        if worlds:
            if len(worlds) > 1:
                notes.further["contains several worlds. The first one was read"] = None
            return worlds[0]
    element = Element("world", {"name": "default"})
    element.extend([root] if root.tag == "model" else [*root])
    return element


def _roads(world: GazeboWorld, meshes: LinkMeshes) -> Iterator[PlacedNode]:
    """Yield the roads in a world that have a surface."""
    for road in world.element.findall("road"):
        world.notes.check_children(road)
        name = printable(road.get("name", "")) or "road"
        with prefix_errors(f"road {name!r}"):
            mesh: SceneMesh | None = road_mesh(road)
            if mesh is not None:
                mesh = meshes.with_appearance(mesh, read_appearance(road, retro=0.0))
                matrix = world.body.frames.matrix(world.body.frames.root)
                yield PlacedNode(replace(mesh, name=name), matrix, name)


def _state_of(world: Element) -> _State:
    """Return the last <state> in a world, or an empty state if there is none."""
    state = _State()
    elements = world.findall("state")
    if not elements:
        return state
    element = elements[-1]
    state.inserted = element.findall("insertions/model")
    state.deleted = {printable(name.text or "") for name in element.findall("deletions/name")}
    for path, entry in _state_entries(element, ()):
        name = scoped_name(path)
        with prefix_errors(f"state of {name[:80]!r}"):
            pose = entry.find("pose")
            if pose is not None and (pose.text or "").strip():
                state.poses[name] = read_matrix(pose)
            if entry.tag == "model":
                scale = tuple(child_numbers(entry, "scale", 3, "1 1 1").tolist())
                if scale != _NO_SCALE:
                    state.scales[name] = scale
    return state


def _state_entries(
    element: Element, path: tuple[str, ...]
) -> Iterator[tuple[tuple[str, ...], Element]]:
    """Yield the name and element of each model and link in a state."""
    for child in element:
        if child.tag in ("model", "link"):
            inner = (*path, printable(child.get("name", "")))
            yield inner, child
            yield from _state_entries(child, inner)

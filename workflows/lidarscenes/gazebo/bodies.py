"""Read SDFormat models as trees of bodies, whose frames place links and nested models."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import NamedTuple
from xml.etree.ElementTree import Element

from lidarsim.errors import LidarError, prefix_errors
from lidarsim.io.allowance import Allowance
from lidarsim.io.input_files import read_input
from lidarsim.numerics.arrays import Floats
from lidarsim.numerics.vectors import matmul
from lidarsim.scene.files.scene_graph import MAX_NODES
from lidarsim.words import printable

from ..files.lenient_xml import parse_lenient_xml
from .frames import FrameGraph, placement_matrix, read_pose
from .notes import Notes
from .resources import ResourceNotFoundError, Resources, Source, short_name

_MAX_NESTED = 30  # maximum depth of nested models
_MODEL_FRAME = "__model__"
WORLD_FRAME = "world"
_SEPARATOR = "::"

GROUND_PLANE = """
<model name="ground_plane"><static>true</static><link name="link">
  <visual name="visual"><geometry><plane><normal>0 0 1</normal><size>100 100</size></plane>
  </geometry><material><script><name>Gazebo/Grey</name></script></material></visual>
  <collision name="collision"><geometry><plane><normal>0 0 1</normal><size>100 100</size></plane>
  </geometry></collision>
</link></model>
"""
_GROUND_PLANES = ("ground_plane", "ground plane")
_LIGHTS = ("sun",)


class Link(NamedTuple):
    """A link of a model."""

    name: str
    element: Element
    source: Source  # file that contains the link


class PlacedModel(NamedTuple):
    """A model that is placed in a world or in another model."""

    name: str
    body: GazeboBody
    matrix: Floats  # (4, 4) matrix to the frame of the world or model
    is_static: bool  # whether physics never moves it


@dataclass(eq=False)
class GazeboBody:
    """Content of a model or world, excluding its own pose.

    Identical includes share a body.

    Attributes
    ----------
    frames
        Frames of the model and its nested models.
    links
        Links of the model itself.
    children
        Nested models.
    is_static
        Whether the model is declared as static.
    """

    frames: FrameGraph
    links: list[Link] = field(default_factory=list)
    children: list[PlacedModel] = field(default_factory=list)
    is_static: bool = False

    @cached_property
    def size(self) -> int:
        """Total number of links and nested models."""
        return len(self.links) + sum(1 + child.body.size for child in self.children)


class _Included(NamedTuple):
    """The model to which an <include> refers."""

    element: Element  # its <model>
    source: Source


class BodyReader:
    """Reads the bodies of a world. Each file and each model is read only once."""

    def __init__(self, resources: Resources, notes: Notes, allowance: Allowance) -> None:
        self.resources = resources
        self.notes = notes
        self.allowance = allowance
        self._files: dict[Path, _Included | None] = {}
        self._bodies: dict[int, GazeboBody] = {}  # {id of a <model>: body}
        self._open_elements: list[int] = []  # ids of the <model>s that are being read
        self._ground: Element | None = None

    def world(self, element: Element, source: Source) -> GazeboBody:
        """Read a <world>, or a root element that contains models, as a body."""
        body = GazeboBody(FrameGraph(WORLD_FRAME))
        self._fill(body, element, source)
        if body.size > MAX_NODES:
            raise LidarError(
                f"it contains more than {MAX_NODES:,} links and models. Divide it into several "
                "files."
            )
        return body

    def _fill(self, body: GazeboBody, element: Element, source: Source) -> None:
        """Read the links, frames, and models of an element into a body."""
        self.notes.check_children(element)
        body.is_static = _is_true(element.findtext("static"))
        frames = body.frames
        for link in element.findall("link"):
            with prefix_errors(f"link {_name(link)!r}"):
                name = frames.define(_name(link), read_pose(link), frames.root)
            body.links.append(Link(name, link, source))
        for frame in element.findall("frame"):
            attached = printable(frame.get("attached_to", "")) or frames.root
            with prefix_errors(f"frame {_name(frame)!r}"):
                frames.define(_name(frame), read_pose(frame), attached)
        for joint in element.findall("joint"):
            child = joint.find("child")
            link_name = "" if child is None else (child.get("link") or child.text or "")
            if child is not None:
                frames.define(_name(joint), read_pose(joint), printable(link_name) or frames.root)
        nested = [*self._nested(body, element, source)]
        for name, child_body, is_static in nested:
            with prefix_errors(f"model {name!r}"):
                placed = PlacedModel(name, child_body, frames.matrix(name), is_static)
                body.children.append(placed)

    def _nested(
        self, body: GazeboBody, element: Element, source: Source
    ) -> Iterator[tuple[str, GazeboBody, bool]]:
        """Define the frames of nested models.

        Yield each model's name, body, and whether it is static.
        """
        for child in element:
            if child.tag == "model":
                name = _name(child)
                with prefix_errors(f"model {name!r}"):
                    nested = self.model(child, source)
                    yield self._define(body, name, nested, child, child)
            elif child.tag == "include":
                yield from self._include(body, child, source)

    def _include(
        self, body: GazeboBody, include: Element, source: Source
    ) -> Iterator[tuple[str, GazeboBody, bool]]:
        """Yield the model to which an <include> refers, or merge this model into the body."""
        self.notes.check_children(include)
        uri = (include.findtext("uri") or "").strip()
        included = self._included(uri, source)
        if included is None:
            return
        include_name = printable(include.findtext("name") or "")
        name = include_name or _name(included.element) or short_name(uri)
        with prefix_errors(f"model {name!r}"):
            nested = self.model(included.element, included.source)
            posed = include if include.find("pose") is not None else included.element
            if include.get("merge") in ("true", "1"):
                self._merge(body, nested, posed, include)
                return
            yield self._define(body, name, nested, posed, include)

    def _define(
        self, body: GazeboBody, name: str, nested: GazeboBody, posed: Element, placing: Element
    ) -> tuple[str, GazeboBody, bool]:
        """Define the frame of a nested model.

        Return the model's name, its body, and whether it is static. `posed` is the element whose
        <pose> applies, and `placing` may name the placement frame. If the name is already used, the
        returned name has a number.
        """
        placement = _placement_frame(placing, posed)
        pose = read_pose(posed)
        pose = pose._replace(matrix=placement_matrix(pose.matrix, nested.frames, placement))
        frames = body.frames
        name = frames.define(name, pose, frames.root)
        frames.nested[name] = nested.frames
        is_static = nested.is_static or _is_true(placing.findtext("static"))
        return name, nested, is_static

    def _merge(
        self, body: GazeboBody, nested: GazeboBody, posed: Element, placing: Element
    ) -> None:
        """Merge an included model's links and nested models into the body."""
        pose = read_pose(posed)
        frames = body.frames
        matrix = placement_matrix(pose.matrix, nested.frames, _placement_frame(placing, posed))
        matrix = matmul(frames.matrix(pose.frame or frames.root), matrix)
        names = frames.merge(nested.frames, matrix)
        body.links += [link._replace(name=names[link.name]) for link in nested.links]
        body.children += [
            child._replace(name=names[child.name], matrix=matmul(matrix, child.matrix))
            for child in nested.children
        ]

    def model(self, element: Element, source: Source) -> GazeboBody:
        """Read a <model> as a body.

        Raises LidarError if includes are circular, if models are nested too deeply, or if the model
        has too many links.
        """
        key = id(element)
        if key in self._open_elements:
            raise LidarError(
                "it includes itself, directly or through other files. Remove an <include>."
            )
        if len(self._open_elements) > _MAX_NESTED:
            raise LidarError(f"models are nested more than {_MAX_NESTED} levels deep.")
        if key not in self._bodies:
            self._open_elements.append(key)
            body = GazeboBody(FrameGraph(_MODEL_FRAME))
            self._fill(body, element, source)
            if body.size > MAX_NODES:
                raise LidarError(
                    f"it contains more than {MAX_NODES:,} links and models. Divide it into "
                    "several files."
                )
            self._bodies[key] = body
            self._open_elements.pop()
        return self._bodies[key]

    def _included(self, uri: str, source: Source) -> _Included | None:
        """Return the model at a URI, or None if it is missing or is a light."""
        if not uri:
            self.notes.missing_models["an <include> without <uri>"] += 1
            return None
        name = short_name(uri).rpartition("/")[2].lower()
        try:
            file = self.resources.find_model(uri, source)
        except ResourceNotFoundError as error:
            if name in _GROUND_PLANES:
                return _Included(self._ground_plane(), source)
            if name not in _LIGHTS:
                self.notes.missing_models[str(error)] += 1
            return None
        return self._read(file)

    def _ground_plane(self) -> Element:
        """Return the ground plane model that is part of Gazebo."""
        if self._ground is None:
            self._ground = parse_lenient_xml(GROUND_PLANE.encode())
        return self._ground

    def _read(self, source: Source) -> _Included | None:
        """Read the model in a file, or return None if the file is unreadable or has no model."""
        path = source.path.resolve()
        if path not in self._files:
            self._files[path] = None
            try:
                data = read_input(path)
                root = parse_lenient_xml(data)
            except (OSError, ValueError, LidarError) as error:
                reason = getattr(error, "strerror", None) or error
                self.notes.unread_files[f"{path.parent.name}/{path.name}"] = f"{reason}"
                return None
            self.allowance.add_file(path)
            element = root if root.tag == "model" else root.find("model")
            if element is not None:
                self._files[path] = _Included(element, source)
            elif root.find("light") is None and root.find("actor") is None:
                self.notes.unread_files[f"{path.parent.name}/{path.name}"] = "it has no <model>"
        return self._files[path]


def _placement_frame(placing: Element, posed: Element) -> str:
    """Return the frame within a model to which its pose refers, or "" for its own frame."""
    text = placing.findtext("placement_frame") or posed.get("placement_frame") or ""
    return printable(text)


def _is_true(text: str | None) -> bool:
    """Return whether the text of an element is a true value."""
    return (text or "").strip() in ("true", "1")


def _name(element: Element) -> str:
    """Return an element's name without unprintable characters."""
    return printable(element.get("name", ""))


def scoped_name(path: tuple[str, ...]) -> str:
    """Join the names of nested models and a link, in the notation of Gazebo.

    Examples
    --------
    >>> scoped_name(("car", "wheel"))
    'car::wheel'
    """
    return _SEPARATOR.join(path)

"""Robots from URDF files, with the visual meshes of their links.

After the specification at http://wiki.ros.org/urdf/XML, and urdfdom 4 where that leaves something
open. This is not yourdfpy 0.0.60, which evaluates one pose at a time, reads meshes through trimesh,
follows entities and takes mesh files from anywhere: what remained of it would be the names of forty
attributes.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from urllib.parse import unquote
from xml.etree.ElementTree import Element, ParseError

import numpy as np

from lidarsim.base.allowance import Allowance
from lidarsim.base.arrays import Bytes, Floats
from lidarsim.base.errors import LidarError, prefixed
from lidarsim.base.input_files import read_input
from lidarsim.base.validation import checked, shown
from lidarsim.base.vectors import length
from lidarsim.base.words import printable
from lidarsim.base.xmlfile import xml_root
from lidarsim.scene.actors import box, join_meshes
from lidarsim.scene.colours import Colours, as_bytes
from lidarsim.scene.face_materials import FaceMaterials
from lidarsim.scene.files.meshfile import OpacityMode, load_meshes, warn
from lidarsim.scene.scene_instances import SceneInstance
from lidarsim.scene.scene_mesh import SceneMesh
from lidarsim.scene.shapes import capsule, cylinder
from lidarsim.scene.transform import affine
from lidarsim.sensor.trajectory import rotations_of

from .robot import HELD, MOVING, Joint, Robot

_LINKS_MOST = 1000  # humanoids with hands have 150
_SIDES = 64  # of a cylinder: its faces are 0.12 % of the radius inside it at most
_UP = 5  # folders above a robot's file in which its packages are looked for
_FARTHEST = 1e8  # of any number in a file


@checked
def load_robot(
    path: str | Path,
    *,
    opacity: OpacityMode = "mask",
    colours: bool = False,
    materials: bool = False,
    tell: Callable[[str], None] = warn,
) -> Robot:
    """Read a robot from a URDF file, with the visual meshes of its links.

    Mesh files are read from the robot's package only: the folder with a package.xml, at most five
    above the file, or, where there is none, the folder above the file's. A name that begins with
    package://NAME is looked for in folders called NAME, or whose package.xml has that name, beside
    the file and at most five folders above. As in RViz, a mesh keeps its file's axes, whatever
    up-axis that states, and a .dae its unit.

    Parameters
    ----------
    path
        A .urdf file; a .xacro has to be expanded before.
    opacity, colours, materials
        As of `load_meshes`. A material of the URDF is for shapes, and meshes without colours, or
        without materials.
    tell
        Called with a line on what was left out.

    Raises
    ------
    LidarError
        If the file or a mesh cannot be read, or the joints do not make a tree.
    """
    path = Path(path)
    try:
        data = read_input(path)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise LidarError(f"{path} cannot be read: {reason}.") from error
    target = path.name.removesuffix(".xacro").removesuffix(".urdf")
    target += ".expanded" * (path.suffix != ".xacro")  # not to write over what is read
    expand = f"{path} is xacro: expand it first: xacro {path.name} > {target}.urdf"
    if path.suffix.lower() == ".xacro":
        raise LidarError(expand)
    try:
        root = xml_root(data.lstrip())  # some begin with an empty line
    except (ParseError, ValueError, LookupError) as error:  # an unknown encoding
        if b"<xacro:" in data:
            raise LidarError(expand) from error
        raise LidarError(f"{path} is no URDF that can be read: {error}.") from error
    if any("xacro" in element.tag for element in root.iter()):
        raise LidarError(expand)
    if root.tag != "robot":
        other = "; convert an SDF to URDF first" * (root.tag == "sdf")
        raise LidarError(f"{path} is no URDF: it begins with <{root.tag[:40]}>{other}.")
    with prefixed(path), np.errstate(all="ignore"):  # infinite values are refused
        name = printable(root.get("name", "")) or path.stem
        links = {_name(element): element for element in _named(root, "link")}
        held = {}
        for element in _named(root, "joint"):
            with prefixed(f"joint {_name(element)!r}"):
                child, joint = _joint(element, links)
                if child in held:
                    raise LidarError(f"link {child!r} has two joints that hold it.")
                if joint.kind in HELD[1:]:
                    tell(f"{path}: joint {joint.name} is {joint.kind}: it stays at zero")
                held[child] = joint
        order = _in_order(list(links), held)
        _check_mimics(held)
        looks = _Looks(path, root, len(data), opacity, colours, materials, tell)
        meshes = {}
        for link in order:
            with prefixed(f"link {link!r}"):
                if parts := list(looks.of(link, links[link])):
                    meshes[link] = join_meshes(link, parts)
        looks.tell_rest()
        if not meshes:
            raise LidarError("no link has a <visual> with triangles: there is nothing to see.")
    return Robot(name, tuple(order), {link: held[link] for link in order[1:]}, meshes)


def _name(element: Element) -> str:
    return printable(element.get("name", ""))


def _material(visual: Element) -> FaceMaterials | None:
    """Material of a visual, by its name; None without."""
    material = visual.find("material")
    return None if material is None else FaceMaterials.named(material.get("name", ""))


def _named(root: Element, kind: str) -> list[Element]:
    """Elements of a kind, each with its own name."""
    found = root.findall(kind)
    if len(found) > _LINKS_MOST:
        raise LidarError(f"it has {len(found):,} {kind}s; at most {_LINKS_MOST:,} are read.")
    names = [_name(element) for element in found]
    if twice := next((name for name in names if name and names.count(name) > 1), None):
        raise LidarError(f"two {kind}s have the name {twice!r}: give each its own.")
    if "" in names:
        raise LidarError(f"a {kind} has no name.")
    return found


def _numbers(element: Element | None, name: str, count: int, default: str) -> Floats:
    """Read the numbers of an attribute; `default` if it, or the element, is not there."""
    text = default if element is None else element.get(name, default)
    try:
        values = np.array(text.split(), np.float64)
    except ValueError:
        values = np.zeros(0)
    if len(values) != count or not (np.abs(values) <= _FARTHEST).all():  # nor NaN
        tag = "" if element is None else element.tag
        what = "a finite number" if count == 1 else f"{count} finite numbers"
        hint = " Expand the file by xacro first." * ("$" in text)
        raise LidarError(f"{name} of <{tag}> is {shown(text)}; it must be {what}.{hint}")
    return values


def _place(element: Element) -> Floats:
    """Matrix (4, 4) of an <origin>: rotated about the fixed x, y and z axes, then moved."""
    origin = element.find("origin")
    place, angles = (_numbers(origin, name, 3, "0 0 0") for name in ("xyz", "rpy"))
    return affine(rotations_of(np.degrees(angles[::-1])) if angles.any() else np.eye(3), place)


def _joint(element: Element, links: Collection[str]) -> tuple[str, Joint]:
    """Return the link that a joint holds, and the joint."""
    kind = element.get("type", "")
    if kind not in (*MOVING, *HELD):
        raise LidarError(
            f"its type is {shown(kind)}; it must be one of {', '.join((*MOVING, *HELD))}."
        )
    ends = []
    for which in ("parent", "child"):
        found = element.find(which)
        link = printable("" if found is None else found.get("link", ""))
        if link not in links:
            raise LidarError(f"its {which} {link!r} is no link of the file.")
        ends.append(link)
    axis = np.array([1.0, 0.0, 0.0])
    limits = None
    mimic = None
    if kind in MOVING:
        axis = _numbers(element.find("axis"), "xyz", 3, "1 0 0")
        if not (size := length(axis)) > 1e-9:
            raise LidarError("its axis has no direction.")
        axis = axis / size
        limit = element.find("limit")
        if kind != "continuous" and limit is not None:
            low, high = (_numbers(limit, name, 1, "0").item() for name in ("lower", "upper"))
            limits = (low, high) if low <= high else None
        if (other := element.find("mimic")) is not None:
            factor, offset = (
                _numbers(other, name, 1, default).item()
                for name, default in (("multiplier", "1"), ("offset", "0"))
            )
            mimic = (printable(other.get("joint", "")), factor, offset)
    parent, child = ends
    return child, Joint(_name(element), kind, parent, _place(element), axis, limits, mimic)


def _in_order(links: list[str], held: Mapping[str, Joint]) -> list[str]:
    """Links, each after its parent; LidarError if they are not one tree."""
    roots = [link for link in links if link not in held]
    if not links:
        raise LidarError("it has no link.")
    if len(roots) > 1:
        raise LidarError(
            f"links {roots[0]!r} and {roots[1]!r} are not connected: one root must hold all links."
        )
    above = {link: [held[link].parent] if link in held else [] for link in links}
    try:
        return [*TopologicalSorter(above).static_order()]
    except CycleError as error:
        raise LidarError(
            f"the joints of link {error.args[1][0]!r} go round in a circle."
        ) from error


def _check_mimics(held: Mapping[str, Joint]) -> None:
    moving = {joint.name: joint.mimic for joint in held.values() if joint.moves}
    others = {name: [mimic[0]] for name, mimic in moving.items() if mimic is not None}
    for name, (other,) in others.items():
        if other not in moving:
            raise LidarError(f"joint {name!r} mimics {other!r}, which does not move.")
    try:
        TopologicalSorter(others).prepare()
    except CycleError as error:
        raise LidarError(f"joint {error.args[1][0]!r} mimics itself, in a circle.") from error


@dataclass(eq=False)
class _Looks:
    """Reads what is seen of links."""

    path: Path
    root: Element
    size: int
    opacity: OpacityMode
    colours: bool
    materials: bool
    tell: Callable[[str], None]
    _files: dict[Path, list[SceneMesh]] = field(default_factory=dict)
    _collide: list[str] = field(default_factory=list)  # links with collision shapes only
    _flat: list[str] = field(default_factory=list)  # links with a shape of size zero

    def __post_init__(self) -> None:
        self._allowance = Allowance(self.size, "use meshes with fewer triangles")
        materials = self.root.findall("material")
        self._shared = {entry.get("name", ""): entry.find("color") for entry in materials}
        folder = self.path.parent.resolve()
        self._around = [folder, *folder.parents][: _UP + 1]
        packages = (one for one in self._around if (one / "package.xml").is_file())
        self._package = next(packages, folder.parent)

    def of(self, link: str, element: Element) -> Iterator[SceneMesh]:
        """Meshes of a link, in its axes."""
        visuals = element.findall("visual")
        if not visuals and element.find("collision/geometry") is not None:
            self._collide.append(link)
        for visual in visuals:
            shape = next(iter(visual.find("geometry") or ()), None)
            if shape is None:
                raise LidarError("a <visual> has no <geometry>.")
            place = _place(visual)
            colour = self._colour(visual)
            scale, parts = self._shape(shape)
            if not scale.all():
                self._flat.append(link)
                continue
            for part in parts:
                self._allowance.take(part.vertices.nbytes + part.faces.nbytes)
                mesh = part.moved(part.name, place[:3, :3] * scale, place[:3, 3])
                if colour is not None and mesh.colours is None:
                    mesh = replace(mesh, colours=Colours.plain(colour, len(mesh.faces)))
                if self.materials and mesh.materials is None:
                    mesh = replace(mesh, materials=_material(visual))
                yield mesh

    def tell_rest(self) -> None:
        """Tell of what was left out."""
        for links, what in (
            (self._collide, "have collision shapes and no visual ones, and are left out"),
            (self._flat, "have shapes of size zero, which are left out"),
        ):
            if links:
                names = ", ".join(dict.fromkeys(links[:3])) + ", …" * (len(links) > 3)
                self.tell(f"{self.path}: links that {what}: {names}")

    def _colour(self, visual: Element) -> Bytes | None:
        """Colour (1, 1, 3) of a visual, by itself or by the name of a material of the robot."""
        material = visual.find("material")
        if not self.colours or material is None:
            return None
        colour = material.find("color")
        colour = self._shared.get(material.get("name", "")) if colour is None else colour
        if colour is None:
            return None
        return as_bytes(_numbers(colour, "rgba", 4, "1 1 1 1")[:3]).reshape(1, 1, 3)

    def _shape(self, shape: Element) -> tuple[Floats, list[SceneMesh]]:
        """Return factors (3,), one of which may be zero, and meshes that are to be scaled."""
        if shape.tag == "mesh":
            if len(factors := shape.get("scale", "").split()) == 4:  # as public files have it
                shape.set("scale", " ".join(factors[:3]))
            scale = _numbers(shape, "scale", 3, "1 1 1")
            return scale, self._meshes(shape.get("filename", "")) if scale.all() else []
        if shape.tag == "box":
            size = self._sizes(_numbers(shape, "size", 3, ""))
            return size, [_BOX]
        if shape.tag not in ("cylinder", "sphere", "capsule"):
            raise LidarError(
                f"its shape is <{shape.tag[:40]}>; there are mesh, box, cylinder, sphere, capsule."
            )
        (radius,) = self._sizes(_numbers(shape, "radius", 1, ""))
        if shape.tag == "sphere":
            return np.full(3, radius), [_BALL]
        (length,) = self._sizes(_numbers(shape, "length", 1, ""))
        if shape.tag == "cylinder":
            return np.array([radius, radius, length]), [_ROD]
        if not radius:
            return np.zeros(3), []
        return np.ones(3), [capsule(radius, length, _SIDES, "capsule")]

    def _sizes(self, sizes: Floats) -> Floats:
        if (sizes < 0).any():
            raise LidarError(f"a size is {sizes.min()}; it must not be negative.")
        return sizes

    def _meshes(self, name: str) -> list[SceneMesh]:
        """Meshes of a file, in its own axes."""
        path, package = self._find(name)
        if not path.resolve().is_relative_to(package):
            raise LidarError(
                f"its mesh {name[:200]!r} is outside the package, {package}: put the .urdf into "
                "the folder of its package, or above it."
            )
        if path not in self._files:
            # As RViz does, which lets assimp ignore Collada's up_axis
            # (AI_CONFIG_IMPORT_COLLADA_IGNORE_UP_DIRECTION in rviz_rendering's assimp_loader.cpp),
            # and not its unit. assimp turns no other format.
            found = load_meshes(
                path,
                up_axis="z",
                opacity=self.opacity,
                colours=self.colours,
                materials=self.materials,
                tell=self.tell,
            )
            self._allowance.add_file(path)
            self._files[path] = [
                one.flat() if isinstance(one, SceneInstance) else one for one in found
            ]
        return self._files[path]

    def _find(self, name: str) -> tuple[Path, Path]:
        """Return the file that a URI names, and the folder that it must be in."""
        scheme, mark, rest = unquote(name.strip()).partition("://")
        if not mark:
            return self.path.parent / scheme, self._package
        if scheme == "file":
            return Path(rest), self._package
        if scheme not in ("package", "model"):
            raise LidarError(
                f"its mesh {name[:200]!r} must be a file's name, package://NAME/FILE or file://."
            )
        called, _, file = rest.partition("/")
        for folder in self._around if called not in ("", ".", "..") else ():
            if folder.name == called or _package_name(folder) == called:
                return folder / file, folder
            if (folder / called).is_dir():
                return folder / called / file, (folder / called).resolve()
        raise LidarError(
            f"its mesh {name[:200]!r} is of a package that is not there: put the .urdf into the "
            f"folder {called[:80]!r} of that package, or beside it."
        )


def _package_name(folder: Path) -> str:
    """Name in the package.xml of a folder; empty if there is none."""
    file = folder / "package.xml"
    try:
        return (xml_root(read_input(file)).findtext("name") or "").strip()
    except (OSError, ValueError, LookupError, ParseError, LidarError):
        return ""


# Of size 1, but for the radii.
_BOX = box("box", (1, 1, 1)).moved("box", np.eye(3), np.array([0, 0, -0.5]))
_BALL = capsule(1, 0, _SIDES, "sphere")
_ROD = cylinder(1, 1, _SIDES, "cylinder")

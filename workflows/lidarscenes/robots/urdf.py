"""Read robots from URDF files, including the visual meshes of links.

The reader follows the specification at http://wiki.ros.org/urdf/XML and, where it is ambiguous,
urdfdom 4. yourdfpy 0.0.60 is not used, because it evaluates one pose at a time, reads meshes with
trimesh, follows XML entities, and reads mesh files from any folder.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from urllib.parse import unquote
from xml.etree.ElementTree import Element, ParseError

import numpy as np

from lidarsim.errors import LidarError, prefix_errors
from lidarsim.io.allowance import Allowance
from lidarsim.io.input_files import read_input
from lidarsim.io.named_files import is_inside
from lidarsim.io.xmlfile import xml_root
from lidarsim.motion.rotations import rotations_of
from lidarsim.numerics.arrays import Bytes, Floats
from lidarsim.numerics.vectors import norm
from lidarsim.scene.actors import join_meshes
from lidarsim.scene.colors import Colors, as_bytes
from lidarsim.scene.face_materials import FaceMaterials
from lidarsim.scene.files.mesh_options import OpacityMode
from lidarsim.scene.files.meshfile import load_meshes, warn
from lidarsim.scene.scene_instances import SceneInstance
from lidarsim.scene.scene_mesh import SceneMesh
from lidarsim.scene.shapes import capsule
from lidarsim.scene.transform import affine
from lidarsim.schema.checks import check_fits
from lidarsim.schema.value_texts import format_value
from lidarsim.words import printable

from ..files.unit_shapes import SIDES, UNIT_BALL, UNIT_BOX, UNIT_CYLINDER
from .robot import HELD, MOVING, Joint, Robot

_MAX_LINKS = 1000  # humanoid robots with hands have about 150
_MAX_FOLDERS_UP = 5  # folders above a robot's file that are searched for its packages
_MAX_NUMBER = 1e8  # largest number in a file
_NO_FOLDERS = ("", ".", "..")  # parts of a path that are not names of folders


def load_robot(
    path: str | Path,
    *,
    opacity: OpacityMode = "mask",
    colors: bool = False,
    materials: bool = False,
    assets: str | Path | None = None,
    report: Callable[[str], None] = warn,
) -> Robot:
    """Read a robot from a URDF file, including the visual meshes of its links.

    Mesh files are read only from the robot's package, from other packages that the file names, and
    from `assets`. The robot's package is the closest folder with a package.xml, which is the folder
    of the file or at most five levels above it. Without a package.xml, it is the folder of the
    file. For a mesh name that begins with package://NAME, the package is searched for in `assets`,
    in the folder of the file, and in up to five folders above it. Its folder must be called NAME,
    or its package.xml must state this name. Packages outside `assets` and the robot's package must
    have a package.xml. As in RViz, a mesh keeps the axes of its file, even if the file states an up
    axis, and a .dae file keeps its unit.

    Parameters
    ----------
    path
        A .urdf file. A .xacro file must be expanded first.
    opacity
        How to use transparent textures, as for `load_meshes`.
    colors, materials
        Whether to read colors and names of materials. A material of the URDF file applies to
        shapes, and to meshes that have no colors or materials of their own.
    assets
        Additional folder from which mesh files, and the files that they refer to, may be read. It
        can be a package or a folder of packages.
    report
        Function that is called with a line of text for content that is omitted.

    Raises
    ------
    LidarError
        If the file or a mesh cannot be read, or if the joints do not form a tree.
    """
    path = Path(path)
    check_fits("opacity", opacity, OpacityMode)
    root, size = _read_root(path)
    with prefix_errors(path), np.errstate(all="ignore"):  # infinite values are rejected later
        name = printable(root.get("name", "")) or path.stem
        links = {_name(element): element for element in _named(root, "link")}
        joints = _joints(root, links, lambda line: report(f"{path}: {line}"))
        order = _in_order(list(links), joints)
        _check_mimics(joints)
        folders = () if assets is None else (Path(assets).resolve(),)
        reader = _LinkMeshes(
            path=path,
            root=root,
            size=size,
            opacity=opacity,
            colors=colors,
            materials=materials,
            assets=folders,
            report=report,
        )
        meshes = {}
        for link in order:
            with prefix_errors(f"link {link!r}"):
                if parts := list(reader.link_meshes(link, links[link])):
                    meshes[link] = join_meshes(link, parts)
        reader.report_skipped_links()
        if not meshes:
            raise LidarError("no link has a <visual> with triangles.")
    return Robot(name, tuple(order), {link: joints[link] for link in order[1:]}, meshes)


def _read_root(path: Path) -> tuple[Element, int]:
    """Return the <robot> element in a URDF file, and the file size in bytes."""
    try:
        data = read_input(path)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise LidarError(f"{path} cannot be read: {reason}.") from error
    target = path.name.removesuffix(".xacro").removesuffix(".urdf")
    target += ".expanded" * (path.suffix != ".xacro")  # so that the file is not overwritten
    expand = f"{path} is a xacro file. Expand it first with `xacro {path.name} > {target}.urdf`."
    if path.suffix.lower() == ".xacro":
        raise LidarError(expand)
    try:
        root = xml_root(data.lstrip())  # some files begin with an empty line
    except (ParseError, ValueError, LookupError) as error:  # an unknown encoding
        if b"<xacro:" in data:
            raise LidarError(expand) from error
        raise LidarError(f"{path} cannot be read as URDF: {error}.") from error
    if any("xacro" in element.tag for element in root.iter()):
        raise LidarError(expand)
    if root.tag != "robot":
        advice = " If it is a Gazebo file, change its extension to .sdf and use it as a scene." * (
            root.tag == "sdf"
        )
        raise LidarError(
            f"{path} is not a URDF file. Its root element is <{root.tag[:40]}>.{advice}"
        )
    return root, len(data)


def _joints(
    root: Element, links: Collection[str], report: Callable[[str], None]
) -> dict[str, Joint]:
    """Return a robot's joints, keyed by child link."""
    joints: dict[str, Joint] = {}
    for element in _named(root, "joint"):
        with prefix_errors(f"joint {_name(element)!r}"):
            child, joint = _joint(element, links)
            if child in joints:
                raise LidarError(f"link {child!r} is the child of two joints.")
            if joint.kind in HELD[1:]:
                report(
                    f"joint {joint.name} has the type {joint.kind}, which is not supported. Its "
                    "value is always zero."
                )
            joints[child] = joint
    return joints


def _name(element: Element) -> str:
    """Return an element's name without unprintable characters."""
    return printable(element.get("name", ""))


def _material(visual: Element) -> FaceMaterials | None:
    """Return the material that a visual names, or None if it has none."""
    material = visual.find("material")
    return None if material is None else FaceMaterials.from_name(material.get("name", ""))


def _named(root: Element, kind: str) -> list[Element]:
    """Return the elements with the given tag, which must have distinct names.

    Raises LidarError unless they all have different names.
    """
    elements = root.findall(kind)
    if len(elements) > _MAX_LINKS:
        raise LidarError(f"it has {len(elements):,} {kind}s, and the limit is {_MAX_LINKS:,}.")
    names = [_name(element) for element in elements]
    if duplicate := next((name for name in names if name and names.count(name) > 1), None):
        raise LidarError(f"two {kind}s have the name {duplicate!r}. Names must be unique.")
    if "" in names:
        raise LidarError(f"a {kind} has no name.")
    return elements


def _numbers(element: Element | None, name: str, count: int, default: str) -> Floats:
    """Return `count` numbers from an attribute, or from `default` if it is missing."""
    text = default if element is None else element.get(name, default)
    try:
        values = np.array(text.split(), np.float64)
    except ValueError:
        values = np.zeros(0)
    if len(values) != count or not (np.abs(values) <= _MAX_NUMBER).all():  # also rejects NaN
        tag = "" if element is None else element.tag
        expected = "a finite number" if count == 1 else f"{count} finite numbers"
        hint = " Expand the file with xacro first." * ("$" in text)
        raise LidarError(f"{name} of <{tag}> is {format_value(text)}; it must be {expected}.{hint}")
    return values


def _origin(element: Element) -> Floats:
    """Return the 4 x 4 matrix that an <origin> describes.

    It rotates about the fixed x, y, and z axes, and then translates.
    """
    origin = element.find("origin")
    position, angles = (_numbers(origin, name, 3, "0 0 0") for name in ("xyz", "rpy"))
    return affine(rotations_of(np.degrees(angles[::-1])) if angles.any() else np.eye(3), position)


def _joint(element: Element, links: Collection[str]) -> tuple[str, Joint]:
    """Read a joint, and return its child link and the joint."""
    kind = element.get("type", "")
    if kind not in (*MOVING, *HELD):
        raise LidarError(
            f"its type is {format_value(kind)}; it must be one of {', '.join((*MOVING, *HELD))}."
        )
    end_links = []
    for end in ("parent", "child"):
        link_element = element.find(end)
        link = printable("" if link_element is None else link_element.get("link", ""))
        if link not in links:
            raise LidarError(f"its {end} {link!r} is not a link in the file.")
        end_links.append(link)
    axis = np.array([1.0, 0.0, 0.0])
    limits = None
    mimic = None
    if kind in MOVING:
        axis = _numbers(element.find("axis"), "xyz", 3, "1 0 0")
        if not (size := norm(axis)) > 1e-9:
            raise LidarError("its axis has zero length.")
        axis = axis / size
        limit = element.find("limit")
        if kind != "continuous" and limit is not None:
            lower, upper = (_numbers(limit, name, 1, "0").item() for name in ("lower", "upper"))
            limits = (lower, upper) if lower <= upper else None
        if (mimicked := element.find("mimic")) is not None:
            factor, offset = (
                _numbers(mimicked, name, 1, default).item()
                for name, default in (("multiplier", "1"), ("offset", "0"))
            )
            mimic = (printable(mimicked.get("joint", "")), factor, offset)
    parent, child = end_links
    return child, Joint(
        name=_name(element),
        kind=kind,
        parent=parent,
        origin=_origin(element),
        axis=axis,
        limits=limits,
        mimic=mimic,
    )


def _in_order(links: list[str], joints: Mapping[str, Joint]) -> list[str]:
    """Sort the links so that each one follows its parent.

    Raises LidarError unless links and joints form a tree.
    """
    roots = [link for link in links if link not in joints]
    if not links:
        raise LidarError("it has no link.")
    if len(roots) > 1:
        raise LidarError(
            f"links {roots[0]!r} and {roots[1]!r} are not connected. All links must descend from "
            "one root."
        )
    parents = {link: [joints[link].parent] if link in joints else [] for link in links}
    try:
        return [*TopologicalSorter(parents).static_order()]
    except CycleError as error:
        raise LidarError(f"the joints of link {error.args[1][0]!r} form a cycle.") from error


def _check_mimics(joints: Mapping[str, Joint]) -> None:
    """Check that mimicked joints can move, and that no joint mimics itself."""
    moving = {joint.name: joint.mimic for joint in joints.values() if joint.is_movable}
    mimicked_joints = {name: [mimic[0]] for name, mimic in moving.items() if mimic is not None}
    for name, (mimicked,) in mimicked_joints.items():
        if mimicked not in moving:
            raise LidarError(f"joint {name!r} mimics {mimicked!r}, which does not move.")
    try:
        TopologicalSorter(mimicked_joints).prepare()
    except CycleError as error:
        raise LidarError(
            f"joint {error.args[1][0]!r} mimics itself through other joints."
        ) from error


@dataclass(eq=False)
class _LinkMeshes:
    """Reads the visual meshes of links."""

    path: Path
    root: Element
    size: int  # file size in bytes
    opacity: OpacityMode
    colors: bool
    materials: bool
    assets: tuple[Path, ...]  # resolved folders from which all files may be read
    report: Callable[[str], None]
    _files: dict[Path, list[SceneMesh]] = field(default_factory=dict)
    _collide: list[str] = field(default_factory=list)  # links with collision shapes only
    _flat: list[str] = field(default_factory=list)  # links with a shape of size zero

    def __post_init__(self) -> None:
        self._allowance = Allowance(self.size, "use meshes with fewer triangles")
        materials = self.root.findall("material")
        self._shared = {entry.get("name", ""): entry.find("color") for entry in materials}
        folder = self.path.parent.resolve()
        self._folders_above = [folder, *folder.parents][: _MAX_FOLDERS_UP + 1]
        self._package = next(filter(_is_package, self._folders_above), folder)

    def link_meshes(self, link: str, element: Element) -> Iterator[SceneMesh]:
        """Yield the meshes of a link in link coordinates."""
        visuals = element.findall("visual")
        if not visuals and element.find("collision/geometry") is not None:
            self._collide.append(link)
        for visual in visuals:
            shape = next(iter(visual.find("geometry") or ()), None)
            if shape is None:
                raise LidarError("a <visual> has no <geometry>.")
            origin = _origin(visual)
            color = self._color(visual)
            scale, parts = self._shape(shape)
            if not scale.all():
                self._flat.append(link)
                continue
            for part in parts:
                self._allowance.reserve(part.vertices.nbytes + part.faces.nbytes)
                mesh = part.affine_transform(part.name, origin[:3, :3] * scale, origin[:3, 3])
                if color is not None and mesh.colors is None:
                    mesh = replace(mesh, colors=Colors.plain(color, len(mesh.faces)))
                if self.materials and mesh.materials is None:
                    mesh = replace(mesh, materials=_material(visual))
                yield mesh

    def report_skipped_links(self) -> None:
        """Report which links were skipped."""
        for links, reason in (
            (self._collide, "have collision shapes but no visual shapes"),
            (self._flat, "have shapes of size zero"),
        ):
            if links:
                names = ", ".join(dict.fromkeys(links[:3])) + ", …" * (len(links) > 3)
                self.report(f"{self.path} contains links that {reason} and were skipped: {names}.")

    def _color(self, visual: Element) -> Bytes | None:
        """Return the color of a visual, or of the robot's material that it names, or None."""
        material = visual.find("material")
        if not self.colors or material is None:
            return None
        color = material.find("color")
        color = self._shared.get(material.get("name", "")) if color is None else color
        if color is None:
            return None
        return as_bytes(_numbers(color, "rgba", 4, "1 1 1 1")[:3]).reshape(1, 1, 3)

    def _shape(self, shape: Element) -> tuple[Floats, list[SceneMesh]]:
        """Return a shape's scale factors, and its unscaled meshes. Factors may be zero."""
        if shape.tag == "mesh":
            if len(factors := shape.get("scale", "").split()) == 4:  # some public files have four
                shape.set("scale", " ".join(factors[:3]))
            scale = _numbers(shape, "scale", 3, "1 1 1")
            return scale, self._meshes(shape.get("filename", "")) if scale.all() else []
        if shape.tag == "box":
            size = self._sizes(_numbers(shape, "size", 3, ""))
            return size, [UNIT_BOX]
        if shape.tag not in ("cylinder", "sphere", "capsule"):
            raise LidarError(
                f"its shape is <{shape.tag[:40]}>; it must be one of mesh, box, cylinder, "
                "sphere, capsule."
            )
        (radius,) = self._sizes(_numbers(shape, "radius", 1, ""))
        if shape.tag == "sphere":
            return np.full(3, radius), [UNIT_BALL]
        (length,) = self._sizes(_numbers(shape, "length", 1, ""))
        if shape.tag == "cylinder":
            return np.array([radius, radius, length]), [UNIT_CYLINDER]
        if not radius:
            return np.zeros(3), []
        return np.ones(3), [capsule(radius, length, SIDES, "capsule")]

    def _sizes(self, sizes: Floats) -> Floats:
        """Check that the sizes of a shape are not negative, and return them.

        Raises LidarError if one is negative.
        """
        if (sizes < 0).any():
            raise LidarError(f"a size is {sizes.min()}; it must not be negative.")
        return sizes

    def _meshes(self, name: str) -> list[SceneMesh]:
        """Return the meshes in a file without changing their axes."""
        path, package = self._find(name)
        if not is_inside(path, (package, *self.assets)):
            kind = "package" if _is_package(package) else "folder of the .urdf file"
            raise LidarError(
                f"its mesh {name[:200]!r} is outside the {kind}, {package}. Set `assets` "
                "to a folder that contains the mesh."
            )
        if path not in self._files:
            # Do as RViz does, which ignores the up_axis in COLLADA files, but not the unit
            # (AI_CONFIG_IMPORT_COLLADA_IGNORE_UP_DIRECTION in rviz_rendering's assimp_loader.cpp).
            # assimp does not rotate other formats.
            meshes = load_meshes(
                path,
                up_axis="z",
                opacity=self.opacity,
                colors=self.colors,
                materials=self.materials,
                assets=self.assets,
                report=self.report,
            )
            self._allowance.add_file(path)
            self._files[path] = [
                mesh.flat() if isinstance(mesh, SceneInstance) else mesh for mesh in meshes
            ]
        return self._files[path]

    def _find(self, name: str) -> tuple[Path, Path]:
        """Return the file at a URI, and the folder that must contain it."""
        scheme, mark, location = unquote(name.strip()).partition("://")
        if not mark:
            return self.path.parent / scheme, self._package
        if scheme == "file":
            return Path(location), self._package
        if scheme not in ("package", "model"):
            raise LidarError(
                f"its mesh {name[:200]!r} must be a path, or start with package://NAME/ or file://."
            )
        package, _, file = location.partition("/")
        if package in _NO_FOLDERS:
            raise LidarError(self._without_package(name, scheme, location))
        for folder in (*self.assets, *self._folders_above):
            is_allowed = folder in (*self.assets, self._package)
            if (is_allowed or _is_package(folder)) and package in (folder.name, _name_of(folder)):
                return folder / file, folder
            inner = folder / package
            if inner.is_dir() and (folder in self.assets or _is_package(inner)):
                return inner / file, inner.resolve()
        raise LidarError(
            f"its mesh {name[:200]!r} is in a package that was not found. Set `assets` to "
            f"the folder {package[:80]!r} or a folder that contains it. Packages beside or above "
            "the .urdf file are found if they contain a package.xml."
        )

    def _without_package(self, name: str, scheme: str, location: str) -> str:
        """Return the error message for a URI without a package name.

        An example is package:///my_robot/leg.dae.
        """
        parts = [part for part in location.split("/") if part not in _NO_FOLDERS]
        start = f"its mesh {name[:200]!r} does not specify a package. Write"
        if len(parts) < 2:
            folder = self.path.resolve().parent.name
            return (
                f"{start} {scheme}://NAME/FILE, or a path relative to the folder {folder[:80]!r} "
                "of the .urdf file."
            )
        return (
            f"{start} {scheme}://{'/'.join(parts)[:200]}, and set `assets` to the folder "
            f"{parts[0][:80]!r} or a folder that contains it. Packages beside or above the .urdf "
            "file do not need `assets`."
        )


def _is_package(folder: Path) -> bool:
    """Return whether a folder is a ROS package."""
    return (folder / "package.xml").is_file()


def _name_of(folder: Path) -> str:
    """Return the package name in a folder's package.xml, or an empty string if it is unreadable."""
    file = folder / "package.xml"
    try:
        return (xml_root(read_input(file)).findtext("name") or "").strip()
    except (OSError, ValueError, LookupError, ParseError, LidarError):
        return ""

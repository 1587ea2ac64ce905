"""Robots from URDF files: links, joints, and where each link is at a time.

After the specification at http://wiki.ros.org/urdf/XML, and urdfdom 4 where that leaves something
open. This is not yourdfpy 0.0.60, which evaluates one pose at a time, reads meshes through trimesh,
follows entities and takes mesh files from anywhere: what remained of it would be the names of forty
attributes.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any
from urllib.parse import unquote
from xml.etree.ElementTree import Element, ParseError

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..base.allowance import Allowance, check_fits
from ..base.arguments import as_array, checked, shown
from ..base.errors import LidarpoolError, prefixed
from ..base.words import counted, did_you_mean, printable
from ..base.xmlfile import xml_root
from ..sensor import Pose, Stations, Trajectory
from ..sensor.trajectory import CENTRE, rotations_of
from ..sensor.trajectory_files import columns_of_table, head_of_table
from .actors import Actor, box, one_mesh
from .colours import Colours, as_bytes
from .instances import Instance
from .mesh import Mesh
from .meshfile import Opacity, load_meshes
from .shapes import revolve
from .transform import rotation_about

SUFFIXES = (".urdf", ".xacro")  # the latter are refused, with what to do

_LINKS_MOST = 1000  # humanoids with hands have 150
_SIDES = 64  # of a cylinder: its faces are 0.12 % of the radius inside it at most
_UP = 5  # folders above a robot's file in which its packages are looked for
_FARTHEST = 1e8  # of any number in a file
_LATE_S = 1e-3  # the beams of the last firing are fired a little after the survey's end
_MOVING = ("revolute", "continuous", "prismatic")
_HELD = ("fixed", "floating", "planar")

_AT_ZERO = Stations((CENTRE,))

Float = NDArray[np.float64]
Joints = str | Path | Mapping[str, ArrayLike]

_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Joint:
    """What holds a link.

    Attributes
    ----------
    name
        Its name.
    kind
        revolute, continuous or prismatic, if it moves; else fixed, floating or planar.
    parent
        Link that it is on.
    origin
        float64 (4, 4): from its own axes, in which the held link is at zero, to the parent's.
    axis
        float64 (3,): unit vector about or along which it moves, in its own axes.
    limits
        Least and largest value, radians or metres; None if there are none.
    mimic
        Another joint, and factor and offset of its value; None if it has a value of its own.
    """

    name: str
    kind: str
    parent: str
    origin: Float
    axis: Float
    limits: tuple[float, float] | None = None
    mimic: tuple[str, float, float] | None = None

    @property
    def moves(self) -> bool:
        """Whether it has a value."""
        return self.kind in _MOVING


@dataclass(frozen=True, eq=False)
class Robot:
    """Links, and the joints that hold them; read by `load_robot`.

    Values of joints are radians or metres. `joints` of the methods are a table (a file with a
    header), or a mapping: of a joint's name to its value, or, with time_s, to its values at these
    seconds by the trajectory's clock. Values between are linear in time. A joint without values
    follows the one that it mimics, else it is at zero, or at its limit nearest to zero.

    Attributes
    ----------
    name
        Its name.
    links
        Names of the links: the root first, each after its parent.
    joints
        {link: what holds it}, of all but the root.
    meshes
        {link: what is seen of it, in its axes}, of the links that have something.
    """

    name: str
    links: tuple[str, ...]
    joints: Mapping[str, Joint]
    meshes: Mapping[str, Mesh]

    def __repr__(self) -> str:
        return f"<Robot {self.name}: {self.summary}>"

    @property
    def summary(self) -> str:
        """Links, joints that move, and triangles, in words."""
        triangles = sum(len(mesh.faces) for mesh in self.meshes.values())
        verb = "moves" if len(self.moving) == 1 else "move"
        moving = ", ".join(self.moving[:6]) + ", …" * (len(self.moving) > 6)
        return f"{counted(len(self.links), 'link')}, {counted(triangles, 'triangle')}; " + (
            f"{len(self.moving):,} of its joints {verb}: {moving}" if moving else "no joint moves"
        )

    @cached_property
    def moving(self) -> tuple[str, ...]:
        """Names of the joints that move."""
        return tuple(joint.name for joint in self.joints.values() if joint.moves)

    def path(
        self, link: str, trajectory: Trajectory = _AT_ZERO, joints: Joints | None = None
    ) -> Trajectory:
        """Trajectory of a link, whose root has a trajectory. It stands if nothing moves it.

        Raises
        ------
        LidarpoolError
            If there is no such link, or the joints cannot be used.
        """
        if link not in self.joints and link != self.links[0]:
            raise LidarpoolError(
                f"{self.name} has no link {link!r}.{did_you_mean(link, self.links)}"
            )
        return self._path(link, trajectory, *self._values(joints))

    @checked
    def actors(
        self,
        trajectory: Trajectory = _AT_ZERO,
        joints: Joints | None = None,
        *,
        name: str | None = None,
        without: Collection[str] = (),
        tell: Callable[[str], None] = _log.warning,
    ) -> tuple[Actor, ...]:
        """Make an actor of each link that a joint moves, with the links that are fixed to it.

        Parameters
        ----------
        trajectory
            Of the root link.
        joints
            Values of joints, see `Robot`.
        name
            Of the robot. Actors are called NAME/LINK, by the first link that has triangles.
        without
            Links to leave out.
        tell
            Called with a line on columns that are no joints, and on values beyond limits.

        Raises
        ------
        LidarpoolError
            If the joints cannot be used.
        """
        times_s, values = self._values(joints, tell)
        bodies: dict[str, list[Mesh]] = {}  # {link that moves by itself: meshes in its axes}
        names: dict[str, str] = {}  # {such a link: the first of its body that has triangles}
        owner = {self.links[0]: (self.links[0], np.eye(4))}  # {link: link that moves, its place}
        for link in self.links:
            if link in self.joints:
                joint = self.joints[link]
                body, place = owner[joint.parent]
                owner[link] = (link, np.eye(4)) if joint.moves else (body, place @ joint.origin)
            if (mesh := self.meshes.get(link)) is not None:
                body, place = owner[link]
                names.setdefault(body, link)
                if link not in without:
                    moved = mesh.moved(link, place[:3, :3], place[:3, 3])
                    bodies.setdefault(body, []).append(moved)
        called = self.name if name is None else name
        return tuple(
            Actor(
                one_mesh(f"{called}/{names[body]}", meshes),
                self._path(body, trajectory, times_s, values),
            )
            for body, meshes in bodies.items()
        )

    def _path(
        self, link: str, base: Trajectory, times_s: Float, values: Mapping[str, Float]
    ) -> Trajectory:
        """Trajectory of a link; joints whose values do not change are taken as rigid."""
        chain: list[Joint] = []
        while link in self.joints:
            chain.insert(0, self.joints[link])
            link = chain[0].parent
        hinges: list[Hinge] = []
        place = np.eye(4)
        for joint in chain:
            place = place @ joint.origin
            if joint.moves:
                value, slides = values[joint.name], joint.kind == "prismatic"
                if np.ptp(value):
                    hinges.append(Hinge(place, joint.axis, slides, value))
                    place = np.eye(4)
                elif slides:
                    place[:3, 3] += place[:3, :3] @ (joint.axis * value[0])
                elif value[0]:
                    place[:3, :3] = place[:3, :3] @ rotation_about(joint.axis, np.degrees(value[0]))
        if not hinges and (place == np.eye(4)).all():
            return base
        if not hinges and isinstance(base, Stations):
            own = Pose.of(place[:3, 3], place[:3, :3])
            return Stations(tuple(pose.then(own) for pose in base.at))
        return LinkPath(base, tuple(hinges), place, times_s, getattr(base, "start_s", None) or 0.0)

    def _values(
        self, given: Joints | None, tell: Callable[[str], None] = lambda line: None
    ) -> tuple[Float, dict[str, Float]]:
        """Return times (k,), and values (k,) of all joints that move."""
        table: dict[str, Any] = {}
        if isinstance(given, (str, Path)):
            table = self._read_values(Path(given), tell)
        elif given is not None:
            table = {name: as_array(name, value).reshape(-1) for name, value in given.items()}
        times = table.pop("time_s", np.zeros(1))
        for name, value in table.items():
            if name not in self.moving:
                raise LidarpoolError(
                    f"{self.name} has no joint {name!r} that moves."
                    f"{did_you_mean(name, self.moving)}"
                )
            if value.shape != times.shape or not np.isfinite(value).all():
                raise LidarpoolError(
                    f"The values of joint {name!r} must be finite, one for each time_s "
                    f"({len(times)}), or one without time_s; there are {value.size}."
                )
        if not (len(times) and np.isfinite(times).all() and (np.diff(times) > 0).all()):
            raise LidarpoolError("time_s of joints must be finite, and ascend.")
        joints = {joint.name: joint for joint in self.joints.values() if joint.moves}
        for name in joints:
            chain = [joints[name]]
            while chain[-1].name not in table and (mimic := chain[-1].mimic) is not None:
                chain.append(joints[mimic[0]])
            if chain[-1].name not in table:
                low, high = chain[-1].limits or (0.0, 0.0)
                table[chain[-1].name] = np.full(len(times), min(max(0.0, low), max(high, low)))
            for one in chain[-2::-1]:
                assert one.mimic is not None
                other, factor, offset = one.mimic
                table[one.name] = factor * table[other] + offset
        for name, joint in joints.items():
            low, high = joint.limits or (-np.inf, np.inf)
            least, most = table[name].min(), table[name].max()
            if least < low - 1e-6 or most > high + 1e-6:
                tell(
                    f"{self.name}: joint {name} goes from {least:.4g} to {most:.4g}, beyond its "
                    f"limits of {low:.4g} to {high:.4g}"
                )
        return times, table

    def _read_values(self, path: Path, tell: Callable[[str], None]) -> dict[str, Float]:
        """Read a table of values; LidarpoolError if it cannot be used."""
        try:
            check_fits(path)
            text = path.read_text("utf-8-sig")
            if not text.strip():
                raise ValueError("it is empty")
            known = ("time_s", "time_ns", *self.moving)
            table = columns_of_table(
                text, {}, known, lambda found: ("time_ns" if "time_ns" in found else "time_s",)
            )
            names = head_of_table(text.splitlines())[2]
        except (OSError, ValueError, LidarpoolError) as error:
            raise LidarpoolError(
                f"{path} is not a usable table of joints: {str(error).rstrip('.')}."
            ) from error
        if "time_ns" in table:
            table["time_s"] = table.pop("time_ns") / 1e9
        if len(table) < 2:
            raise LidarpoolError(
                f"{path} has values of no joint that moves: name its columns as the joints of "
                f"{self.name} are, such as {', '.join(self.moving[:3])}."
            )
        small = [name.lower() for name in known]
        if others := [printable(name) for name in names if name.lower() not in small]:
            tell(
                f"{path} has columns of no joint that moves: "
                f"{', '.join(others[:3])}{', …' * (len(others) > 3)}"
            )
        return table


@dataclass(frozen=True, eq=False)
class Hinge:
    """A joint whose value changes, in a chain of them."""

    before: Float  # (4, 4): from its axes to those of the link that the one before moves
    axis: Float  # (3,)
    slides: bool
    values: Float  # (k,)


@dataclass(frozen=True, eq=False)
class LinkPath:
    """Trajectory of a link: that of the robot's root, and of each joint in between.

    Poses are exact at any time: values of joints are linear between those given, and positions are
    computed from them, not interpolated.
    """

    base: Trajectory
    hinges: tuple[Hinge, ...]
    last: Float  # (4, 4): from the link's axes to those of the link that the last joint moves
    times_s: Float  # (k,): of the joints' values
    start_s: float  # of the trajectory, by the same clock

    @property
    def stations(self) -> int:
        """See `Trajectory.stations`."""
        return self.base.stations

    @property
    def moves(self) -> bool:
        """See `Trajectory.moves`."""
        return bool(self.hinges) or self.base.moves

    @property
    def duration_ns(self) -> float:
        """See `Trajectory.duration_ns`."""
        ends = (float(self.times_s[-1]) - self.start_s) * 1e9 if self.hinges else np.inf
        return min(self.base.duration_ns, ends)

    def pose(self, station: int, time_ns: float = 0.0) -> Pose:
        """See `Trajectory.pose`."""
        positions, rotations = self.poses(station, np.array([time_ns], np.float64))
        return Pose.of(positions[0], rotations[0])

    def poses(self, station: int, times_ns: Float) -> tuple[Float, Float]:
        """See `Trajectory.poses`.

        All sums are in one order of rounding, however many times there are.

        Raises
        ------
        LidarpoolError
            If the trajectory or the joints have no values for a time.
        """
        positions, rotations = self.base.poses(station, times_ns)
        place, count = positions.T, len(times_ns)
        turn = np.broadcast_to(np.eye(3)[..., None], (3, 3, count))
        if rotations is not None:
            turn = rotations.transpose(1, 2, 0)
        at = times_ns / 1e9 + self.start_s
        low, high = at.min(initial=np.inf), at.max(initial=-np.inf)
        first, last = self.times_s[[0, -1]]
        if self.hinges and max(first - low, high - last) > _LATE_S:
            raise LidarpoolError(
                f"The joints have values from {first:.9g} to {last:.9g} s; poses are asked for "
                f"from {low:.9g} to {high:.9g} s."
            )
        for hinge in self.hinges:
            place, turn = _then(place, turn, hinge.before)
            value = np.interp(at, self.times_s, hinge.values)
            if hinge.slides:
                place = place + _times(turn, hinge.axis[:, None, None] * value)[:, 0]
            else:  # Rodrigues, 1840
                cross = np.cross(np.eye(3), hinge.axis)
                square = cross @ cross
                spin = np.sin(value) * cross[..., None] + (1 - np.cos(value)) * square[..., None]
                turn = _times(turn, spin + np.eye(3)[..., None])
        place, turn = _then(place, turn, self.last)
        return place.T, turn.transpose(2, 0, 1)


def _times(one: Float, other: Float) -> Float:
    """Product of matrices (3, 3, k) and (3, m, k); k may be 1."""
    return np.asarray(
        (one[:, 0, None] * other[0] + one[:, 1, None] * other[1]) + one[:, 2, None] * other[2]
    )


def _then(place: Float, turn: Float, matrix: Float) -> tuple[Float, Float]:
    """Positions (3, k) and rotations (3, 3, k), followed by the same step (4, 4)."""
    moved = _times(turn, matrix[:3, :, None])
    return place + moved[:, 3], moved[:, :3]


@checked
def load_robot(
    path: str | Path,
    *,
    opacity: Opacity = "mask",
    colours: bool = False,
    tell: Callable[[str], None] = _log.warning,
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
    opacity, colours
        As of `load_meshes`. A colour of the URDF is for shapes, and meshes without colours.
    tell
        Called with a line on what was left out.

    Raises
    ------
    LidarpoolError
        If the file or a mesh cannot be read, or the joints do not make a tree.
    """
    path = Path(path)
    try:
        check_fits(path)
        data = path.read_bytes()
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise LidarpoolError(f"{path} cannot be read: {reason}.") from error
    target = path.name.removesuffix(".xacro").removesuffix(".urdf")
    target += ".expanded" * (path.suffix != ".xacro")  # not to write over what is read
    expand = f"{path} is xacro: expand it first: xacro {path.name} > {target}.urdf"
    if path.suffix.lower() == ".xacro":
        raise LidarpoolError(expand)
    try:
        root = xml_root(data.lstrip())  # some begin with an empty line
    except (ParseError, ValueError, LookupError) as error:  # an unknown encoding
        if b"<xacro:" in data:
            raise LidarpoolError(expand) from error
        raise LidarpoolError(f"{path} is no URDF that can be read: {error}.") from error
    if any("xacro" in element.tag for element in root.iter()):
        raise LidarpoolError(expand)
    if root.tag != "robot":
        other = "; convert an SDF to URDF first" * (root.tag == "sdf")
        raise LidarpoolError(f"{path} is no URDF: it begins with <{root.tag[:40]}>{other}.")
    with prefixed(path), np.errstate(all="ignore"):  # infinite values are refused
        name = printable(root.get("name", "")) or path.stem
        links = {_name(element): element for element in _named(root, "link")}
        held = {}
        for element in _named(root, "joint"):
            with prefixed(f"joint {_name(element)!r}"):
                child, joint = _joint(element, links)
                if child in held:
                    raise LidarpoolError(f"link {child!r} has two joints that hold it.")
                if joint.kind in _HELD[1:]:
                    tell(f"{path}: joint {joint.name} is {joint.kind}: it stays at zero")
                held[child] = joint
        order = _in_order(list(links), held)
        _check_mimics(held)
        looks = _Looks(path, root, len(data), opacity, colours, tell)
        meshes = {}
        for link in order:
            with prefixed(f"link {link!r}"):
                if parts := list(looks.of(link, links[link])):
                    meshes[link] = one_mesh(link, parts)
        looks.tell_rest()
        if not meshes:
            raise LidarpoolError("no link has a <visual> with triangles: there is nothing to see.")
    return Robot(name, tuple(order), {link: held[link] for link in order[1:]}, meshes)


def _name(element: Element) -> str:
    return printable(element.get("name", ""))


def _named(root: Element, kind: str) -> list[Element]:
    """Elements of a kind, each with its own name."""
    found = root.findall(kind)
    if len(found) > _LINKS_MOST:
        raise LidarpoolError(f"it has {len(found):,} {kind}s; at most {_LINKS_MOST:,} are read.")
    names = [_name(element) for element in found]
    if twice := next((name for name in names if name and names.count(name) > 1), None):
        raise LidarpoolError(f"two {kind}s have the name {twice!r}: give each its own.")
    if "" in names:
        raise LidarpoolError(f"a {kind} has no name.")
    return found


def _numbers(element: Element | None, name: str, count: int, default: str) -> Float:
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
        raise LidarpoolError(f"{name} of <{tag}> is {shown(text)}; it must be {what}.{hint}")
    return values


def _place(element: Element) -> Float:
    """Matrix (4, 4) of an <origin>: rotated about the fixed x, y and z axes, then moved."""
    origin, out = element.find("origin"), np.eye(4)
    out[:3, 3] = _numbers(origin, "xyz", 3, "0 0 0")
    angles = _numbers(origin, "rpy", 3, "0 0 0")
    if angles.any():
        out[:3, :3] = rotations_of(np.degrees(angles[::-1]))
    return out


def _joint(element: Element, links: Collection[str]) -> tuple[str, Joint]:
    """Return the link that a joint holds, and the joint."""
    kind = element.get("type", "")
    if kind not in (*_MOVING, *_HELD):
        raise LidarpoolError(
            f"its type is {shown(kind)}; it must be one of {', '.join((*_MOVING, *_HELD))}."
        )
    ends = []
    for which in ("parent", "child"):
        found = element.find(which)
        link = printable("" if found is None else found.get("link", ""))
        if link not in links:
            raise LidarpoolError(f"its {which} {link!r} is no link of the file.")
        ends.append(link)
    axis, limits, mimic = np.array([1.0, 0.0, 0.0]), None, None
    if kind in _MOVING:
        axis = _numbers(element.find("axis"), "xyz", 3, "1 0 0")
        if not (length := np.linalg.norm(axis)) > 1e-9:
            raise LidarpoolError("its axis has no direction.")
        axis = axis / length
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
    """Links, each after its parent; LidarpoolError if they are not one tree."""
    roots = [link for link in links if link not in held]
    if not links:
        raise LidarpoolError("it has no link.")
    if not roots:
        raise LidarpoolError("its joints go round in a circle: no link is the root.")
    if len(roots) > 1:
        raise LidarpoolError(
            f"links {roots[0]!r} and {roots[1]!r} are not connected: one root must hold all links."
        )
    children: dict[str, list[str]] = {}
    for link, joint in held.items():
        children.setdefault(joint.parent, []).append(link)
    order = roots
    for link in order:  # which grows
        order += children.get(link, [])
    if rest := next((link for link in links if link not in order), None):
        raise LidarpoolError(f"the joints of link {rest!r} go round in a circle.")
    return order


def _check_mimics(held: Mapping[str, Joint]) -> None:
    moving = {joint.name: joint for joint in held.values() if joint.moves}
    for name in moving:
        seen, at = {name}, moving[name]
        while at.mimic is not None:
            other = at.mimic[0]
            if other not in moving:
                raise LidarpoolError(f"joint {at.name!r} mimics {other!r}, which does not move.")
            if other in seen:
                raise LidarpoolError(f"joint {name!r} mimics itself, in a circle.")
            seen.add(other)
            at = moving[other]


@dataclass(eq=False)
class _Looks:
    """Reads what is seen of links."""

    path: Path
    root: Element
    size: int
    opacity: Opacity
    colours: bool
    tell: Callable[[str], None]
    _files: dict[Path, list[Mesh]] = field(default_factory=dict)
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

    def of(self, link: str, element: Element) -> Iterator[Mesh]:
        """Meshes of a link, in its axes."""
        visuals = element.findall("visual")
        if not visuals and element.find("collision/geometry") is not None:
            self._collide.append(link)
        for visual in visuals:
            shape = next(iter(visual.find("geometry") or ()), None)
            if shape is None:
                raise LidarpoolError("a <visual> has no <geometry>.")
            place, colour = _place(visual), self._colour(visual)
            scale, parts = self._shape(shape)
            if not scale.all():
                self._flat.append(link)
                continue
            for part in parts:
                self._allowance.take(part.vertices.nbytes + part.faces.nbytes)
                mesh = part.moved(part.name, place[:3, :3] * scale, place[:3, 3])
                if colour is not None and mesh.colours is None:
                    plain = Colours.plain(colour, len(mesh.faces))
                    mesh = Mesh(mesh.name, mesh.vertices, mesh.faces, mesh.cutouts, plain)
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

    def _colour(self, visual: Element) -> NDArray[np.uint8] | None:
        """Colour (1, 1, 3) of a visual, by itself or by the name of a material of the robot."""
        material = visual.find("material")
        if not self.colours or material is None:
            return None
        colour = material.find("color")
        colour = self._shared.get(material.get("name", "")) if colour is None else colour
        if colour is None:
            return None
        return as_bytes(_numbers(colour, "rgba", 4, "1 1 1 1")[:3]).reshape(1, 1, 3)

    def _shape(self, shape: Element) -> tuple[Float, list[Mesh]]:
        """Return factors (3,), one of which may be zero, and meshes that are to be scaled."""
        if shape.tag == "mesh":
            scale = _numbers(shape, "scale", 3, "1 1 1")
            return scale, self._meshes(shape.get("filename", "")) if scale.all() else []
        if shape.tag == "box":
            size = self._sizes(_numbers(shape, "size", 3, ""))
            return size, [_BOX]
        if shape.tag not in ("cylinder", "sphere", "capsule"):
            raise LidarpoolError(
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
        round_, half = _ARC * radius, np.array([0, length / 2])
        profile = np.concatenate([round_[: len(_ARC) // 2] - half, round_[len(_ARC) // 2 :] + half])
        return np.ones(3), [revolve(profile, _SIDES)]

    def _sizes(self, sizes: Float) -> Float:
        if (sizes < 0).any():
            raise LidarpoolError(f"a size is {sizes.min()}; it must not be negative.")
        return sizes

    def _meshes(self, name: str) -> list[Mesh]:
        """Meshes of a file, in its own axes."""
        path, package = self._find(name)
        if not path.resolve().is_relative_to(package):
            raise LidarpoolError(
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
                tell=self.tell,
            )
            self._allowance.grow(path.stat().st_size)
            self._files[path] = [one.flat() if isinstance(one, Instance) else one for one in found]
        return self._files[path]

    def _find(self, name: str) -> tuple[Path, Path]:
        """Return the file that a URI names, and the folder that it must be in."""
        scheme, mark, rest = unquote(name.strip()).partition("://")
        if not mark:
            return self.path.parent / scheme, self._package
        if scheme == "file":
            return Path(rest), self._package
        if scheme not in ("package", "model"):
            raise LidarpoolError(
                f"its mesh {name[:200]!r} must be a file's name, package://NAME/FILE or file://."
            )
        called, _, file = rest.partition("/")
        for folder in self._around if called not in ("", ".", "..") else ():
            if folder.name == called or _package_name(folder) == called:
                return folder / file, folder
            if (folder / called).is_dir():
                return folder / called / file, (folder / called).resolve()
        raise LidarpoolError(
            f"its mesh {name[:200]!r} is of a package that is not there: put the .urdf into the "
            f"folder {called[:80]!r} of that package, or beside it."
        )


def _package_name(folder: Path) -> str:
    """Name in the package.xml of a folder; empty if there is none."""
    file = folder / "package.xml"
    try:
        check_fits(file)
        return (xml_root(file.read_bytes()).findtext("name") or "").strip()
    except (OSError, ValueError, LookupError, ParseError, LidarpoolError):
        return ""


# Of size 1, but for the radii.
_angles = np.linspace(-np.pi / 2, np.pi / 2, _SIDES // 2)
_ARC = np.stack([np.cos(_angles), np.sin(_angles)], axis=1)  # (n, 2): radius and height
_BOX = box("box", (1, 1, 1)).moved("box", np.eye(3), np.array([0, 0, -0.5]))
_BALL = revolve(_ARC, _SIDES, "sphere")
_ROD = revolve([(0, -0.5), (1, -0.5), (1, 0.5), (0, 0.5)], _SIDES, "cylinder")

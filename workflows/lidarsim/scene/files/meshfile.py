"""Files of scenes, of the formats in `mesh_formats`, to named meshes in metres, Z-up."""

from __future__ import annotations

import codecs
import logging
import re
from collections.abc import Callable, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from ...base.arrays import Floats
from ...base.elementary import cbrt
from ...base.errors import LidarError, prefixed
from ...base.input_files import open_input, read_input
from ...base.validation import checked
from ...base.vectors import determinant, matmul, turned
from ...base.vocabulary import UNITS_M
from ...base.words import as_python, did_you_mean, plural, printable
from ...sensor import Track
from ...sensor.trajectory import quaternions_of
from ..actors import Actor, join_meshes
from ..colours import colours_summary
from ..scene_instances import MAX_COORDINATE_M, SceneInstance
from ..scene_mesh import SceneMesh
from ..transform import UP_AXES, Transform
from .mesh_formats import (
    MeshFormat,
    endings,
    endings_for,
    format_of,
    missing_packages,
    plugin_endings,
)
from .scene_graph import (
    Content,
    MeshFileError,
    ObjectClass,
    Raster,
    RasterOptions,
    ReadOptions,
    RigidPart,
    Window,
)

GENERATOR = "lidarpool"  # that files of our own name, .glb as Y-up, others as Z-up
OWN = "lidarpool: metres, Z-up"  # comment that files of our own without such a name begin with

_EVEN = 1e-6  # how much the square of a scale may differ between axes
_HEAD = 200  # bytes of a file that such a comment is in

OpacityMode = Literal["mask", "ignore"]

_log = logging.getLogger(__name__)


def warn(note: str) -> None:
    """Log a note in the words of Python."""
    _log.warning(as_python(note))


class Objects(NamedTuple):
    """Objects of a mesh file, in world coordinates."""

    static: tuple[SceneMesh | SceneInstance, ...]
    actors: tuple[Actor, ...] = ()  # each along a `Track`
    summary: str = ""  # objects, triangles, unit, axes and colours
    raster: Raster | None = None  # what was taken of one
    classes: Mapping[int, ObjectClass] = {}  # {number of ASPRS LAS: class}, of formats with types

    def at_start(self, tell: Callable[[str], None]) -> tuple[SceneMesh | SceneInstance, ...]:
        """Return all of them where they are at first; `tell` is called if that is a loss."""
        if self.actors:
            names = ", ".join(actor.name for actor in self.actors[:3])
            names += ", …" * (len(self.actors) > 3)
            tell(f"{names}: taken where they are at first, and still")
        return (*self.static, *map(_at_first, self.actors))


@checked
def load_objects(
    path: str | Path,
    *,
    unit: Literal[tuple(UNITS_M)] | None = None,  # type: ignore[valid-type]
    up_axis: Literal[tuple(UP_AXES)] | None = None,  # type: ignore[valid-type]
    transform: Transform | None = None,
    opacity: OpacityMode = "mask",
    colours: bool = False,
    materials: bool = False,
    step_m: float | None = None,
    window: Window | None = None,
    epsg: int | None = None,
    assets: str | Path | None = None,
    animation: str | None = None,
    tell: Callable[[str], None] = warn,
    axes: Callable[[str], None] | None = None,
) -> Objects:
    """Read all objects of a mesh file.

    Every place of a mesh in a scene graph is an object, named by its node; large meshes with many
    places are instances. Files without names give one object named by the file. Objects that their
    nodes scale to zero, and instances of meshes without an area, are left out.

    Parameters
    ----------
    path, unit, up_axis, transform, opacity, colours, materials, assets
        As of `Scene.load`, with an ending of `mesh_formats` in any case. The unit of a raster is
        that of its heights.
    step_m
        Of a raster: mean heights in a grid of this step, metres; None takes its pixels.
    window
        Of a raster: lowest x and y, highest x and y of what is taken, metres in the coordinate
        system of the result.
    epsg
        Code of the coordinate system that a raster is brought to, one in metres. None keeps its
        own if it is in metres, else takes the UTM zone of its middle.
    animation
        Name of the animation that its meshes have, or its number if it has none; "" for the first,
        in .usd for what is bound. Such meshes have no masks. None leaves all as it stands.
    tell
        Called with a line on objects left out, on images that cannot be read, on materials that
        may be glass, or on a reference system; by default this module's logger warns.
    axes
        Called with a line on axes that a file did not state, or that were turned; by default this
        module's logger has it, as a warning if the scene seems to lie on its side.

    Returns
    -------
    Objects that stand and, of .usd, that move, in world coordinates. All arithmetic is in double
    precision; .glb, .gltf and binary .stl store single precision.

    Raises
    ------
    LidarError
        If the file cannot be read completely, or has no triangles.
    """
    path = Path(path)
    row = _readable(path)
    data = _bytes_of(path, _HEAD if row.from_path else None)
    raster = RasterOptions(unit, step_m, window, epsg)
    _check_options(path, row, raster, up_axis, animation)
    if row.raster:  # whose reader takes the unit
        unit = None
    folders = [path.parent] if assets is None else [path.parent, Path(assets)]
    wanted = ReadOptions(
        masks=opacity == "mask" and animation is None,
        colours=colours,
        folders=tuple(folder.resolve() for folder in folders),
        animation=animation,
        materials=materials,
        raster=raster,
    )
    # Files may have infinite numbers and NaN, which are refused where they matter.
    with np.errstate(all="ignore"):
        content = _read_whole(path, row, data, wanted)
        unit_m = UNITS_M[unit] if unit else content.unit_m or 1.0
        up = up_axis or content.up_axis or "z"
        objects = _in_world(path, content, Transform(UP_AXES[up] * unit_m, np.zeros(3)), transform)
    _tell_notes(path, content, tell, unit_given=unit is not None)
    standing = objects.at_start(lambda _: None)
    if not any((o.mesh if isinstance(o, SceneInstance) else o).has_area for o in standing):
        raise LidarError(f"{path} has no triangle with an area.")
    if up_axis is None and content.generator != GENERATOR and OWN.encode() not in data[:_HEAD]:
        _tell_axes(path, content, standing, axes)
    if content.raster is not None:
        return objects._replace(summary=content.raster.told, raster=content.raster)
    summary = _summary(standing, unit_m, up, wanted)
    return objects._replace(summary=summary, classes=content.classes)


def _in_world(
    path: Path, content: Content, upright: Transform, transform: Transform | None
) -> Objects:
    """Place the objects of a file in the world.

    `upright` brings the file's unit and axes to metres and Z-up, before `transform`.
    """
    places = [upright] if transform is None else [upright, transform]
    placed = Transform(np.eye(3), np.zeros(3)) if transform is None else transform
    with prefixed(path):
        return Objects(
            tuple(_placed(mesh, path.stem, places) for mesh in content.meshes),
            tuple(_actor(part, path.stem, upright, placed) for part in content.moving),
        )


def _tell_notes(
    path: Path, content: Content, tell: Callable[[str], None], *, unit_given: bool
) -> None:
    """Call `tell` with a line on objects that were left out, and with the notes of the reader."""
    if content.skipped:
        names = ", ".join(content.skipped[:3]) + ", …" * (len(content.skipped) > 3)
        tell(f"{path} has objects without an area, which are left out: {names}")
    for note in content.notes:
        tell(f"{path} {note}")
    if content.unit_note and not unit_given:
        tell(f"{path} {content.unit_note}")


def _check_options(
    path: Path,
    row: MeshFormat,
    raster: RasterOptions,
    up_axis: str | None,
    animation: str | None,
) -> None:
    """Refuse options that a file of a format does not have, or raise LidarError."""
    if row.raster and up_axis:
        raise LidarError(f"{path} is a raster, whose heights are z: leave out up_axis.")
    of_rasters = {"step_m": raster.step_m, "window": raster.window}
    given = [name for name, value in of_rasters.items() if value is not None]
    if given and not row.raster:
        raise LidarError(
            f"{path} is no raster: leave out {' and '.join(given)}, or give a raster "
            f"({' '.join(endings(lambda row: row.raster))})."
        )
    if animation is not None and not row.animated:
        animated = endings(lambda row: row.animated)
        raise LidarError(
            f"{path} has no animations that are read: give a {' or '.join(animated)}, or leave out "
            "animation."
        )


def load_meshes(
    path: str | Path, *, tell: Callable[[str], None] = warn, **options: Any
) -> tuple[SceneMesh | SceneInstance, ...]:
    """Read all objects of a mesh file, as `load_objects`, and let them stand."""
    found = load_objects(path, tell=tell, **options)
    return found.at_start(lambda line: tell(f"{path} moves {line}"))


def _summary(
    meshes: Sequence[SceneMesh | SceneInstance], unit_m: float, up_axis: str, wanted: ReadOptions
) -> str:
    """Say what a file gave: «4 objects, 38 triangles, in m, Y-up, 1 texture»."""
    shapes = [one.mesh if isinstance(one, SceneInstance) else one for one in meshes]
    shared = [mesh for one, mesh in zip(meshes, shapes, strict=True) if one is not mesh]
    words = [plural(len(meshes), "object")]
    if shared:
        of = plural(len({id(mesh) for mesh in shared}), "mesh", "meshes")
        words.append(f"{len(shared):,} of them instances of {of}")
    words += [
        " x ".join(map(str, mesh.voxels.density.shape)) + " voxels"
        for mesh in shapes
        if mesh.voxels is not None
    ]
    names = [name for name, metres in UNITS_M.items() if metres == unit_m]
    words += [
        plural(sum(len(mesh.faces) for mesh in shapes), "triangle"),
        f"in {names[0] if names else f'units of {unit_m:g} m'}",
        f"{up_axis.upper()}-up",
    ]
    if wanted.colours:
        words.append(colours_summary(mesh.colours for mesh in shapes))
    if wanted.materials:
        named = [mesh.materials.names for mesh in shapes if mesh.materials is not None]
        distinct = {name for of_mesh in named for name in of_mesh if name}
        words.append(plural(len(distinct), "named material"))
    return ", ".join(words)


def written_by_lidarpool(path: Path) -> bool:
    """Whether lidarpool wrote a mesh file of a format without a unit: it is in metres."""
    with open_input(path) as file:
        return OWN.encode() in file.read(_HEAD)


def _tell_axes(
    path: Path,
    content: Content,
    meshes: Sequence[SceneMesh | SceneInstance],
    axes: Callable[[str], None] | None,
) -> None:
    if content.turned and content.up_axis == "y":
        why = _lies(content, meshes)
        other = "z"
        done = f"was turned from Y-up to Z-up, {content.turned}{why}"
    elif path.suffix.lower() == ".obj":  # the one without axes that is Y-up as often as not
        done = "states no axes and is taken as Z-up"
        why = ""
        other = "y"
    else:
        return
    (axes or (warn if why else lambda note: _log.info(as_python(note))))(
        f'{path.name} {done}; if it lies on its side, give <file.up_axis="{other}">; any '
        "up_axis ends this note"
    )


def _lies(content: Content, meshes: Sequence[SceneMesh | SceneInstance]) -> str:
    """Say why a file rotated from Y-up seems to have been Z-up; empty if it does not."""
    if "trimesh" in content.generator:
        return ", and trimesh wrote it, which keeps the axes that it is given"
    low = np.min([_corners(mesh).min(axis=0) for mesh in meshes], axis=0)
    x, y, z = np.max([_corners(mesh).max(axis=0) for mesh in meshes], axis=0) - low
    if 2 * y < min(x, z):
        return f", and is {x:,.3g} m wide, {z:,.3g} m high and {y:,.3g} m thick now"
    return ""


def _read_whole(path: Path, row: MeshFormat, data: bytes, wanted: ReadOptions) -> Content:
    """Read a file of a format: at least one object, or LidarError."""
    try:
        with prefixed(path):
            return _content(row, path, data, wanted)
    except MemoryError:
        raise
    except LidarError as error:
        raise LidarError(f"{error}{_other_format(path, data)}") from error
    except MeshFileError as error:
        raise LidarError(f"{path} {error}.{_other_format(path, data)}") from error
    except Exception as error:
        if row.plugin is not None and isinstance(error, ImportError):
            raise LidarError(f"{path}: {row.plugin.broken(error)}") from error
        # Readers raise whatever they stumble over: ValueError, IndexError, KeyError, BadZipFile,
        # ParseError, struct.error, …
        reason = printable(str(error)) or type(error).__name__
        raise LidarError(
            f"{path} is broken or cut short ({reason}): export it again.{_other_format(path, data)}"
        ) from error


def _content(row: MeshFormat, path: Path, data: bytes, wanted: ReadOptions) -> Content:
    """Return what a reader finds; MeshFileError for a file of another kind, or without objects."""
    for beginning, what in _FOREIGN.items():
        if re.match(beginning, data):
            raise MeshFileError(what)
    content = row.reader(data, path, wanted)
    if row.plugin is not None and not isinstance(content, Content):
        raise LidarError(f"{row.plugin} read {type(content).__name__}, not Content.")
    if content.meshes or content.moving:
        return content
    if content.skipped:
        raise MeshFileError("has no triangle with an area")
    raise MeshFileError(
        "holds no triangles: it is empty, or has only points, lines or other things that reflect "
        "no light"
    )


def _readable(path: Path) -> MeshFormat:
    """Return the format of a file; LidarError if no format that is read has its ending."""
    row = format_of(path)
    if row is not None and not row.advice:
        return row
    if row is not None:
        raise LidarError(f"{path} is not read: {row.advice}.")
    further = "".join(
        f"; {package} reads more: pip install lidarpool" for package in missing_packages()
    )
    raise LidarError(
        f"{path} has the ending {path.suffix or '(none)'}, which is not a mesh format that can be "
        f"read; these are: {' '.join([*endings(), *plugin_endings()])} (a scenario has the ending "
        f".yaml){further}."
    )


def _bytes_of(path: Path, max_bytes: int | None) -> bytes:
    """Return the content of a file, or at most `max_bytes` of its start."""
    try:
        with prefixed(path):
            data = read_input(path, max_bytes)
    except (FileNotFoundError, NotADirectoryError) as error:
        raise LidarError(
            f"{path} does not exist: check the name and the folder.{_like(path)}"
        ) from error
    except (OSError, ValueError) as error:  # a NUL in the name
        reason = getattr(error, "strerror", None) or error
        raise LidarError(f"{path} cannot be read: {reason}.") from error
    if not data:
        raise LidarError(f"{path} is empty (0 bytes): export the mesh again.")
    return data.removeprefix(codecs.BOM_UTF8)  # the byte order mark of text editors


def _like(path: Path) -> str:
    """Name an existing mesh file with a similar name, in a question; empty if there is none."""
    try:
        beside = [other.name for other in path.parent.iterdir()]
    except OSError:
        return ""
    return did_you_mean(path.name, [name for name in beside if name.lower().endswith(endings())])


# Beginnings of files that are not meshes, as expressions.
_FOREIGN = {
    rb"\x1f\x8b|BZh|\xfd7zXZ\0|7z\xbc\xaf": "is packed: unpack it first",
    rb"(?i)\s*(<!doctype html|<html)": "is a web page: download the file itself",
}


def _other_format(path: Path, data: bytes) -> str:
    """Name the format by which a refused file begins, in a sentence, if it is another."""
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return " It begins like text in UTF-16: save it as UTF-8."
    likely = endings_for(data)
    if likely and path.suffix.lower() not in likely:
        return f" It begins like a {' or '.join(likely)} file: give it that ending."
    return ""


def _placed(
    one: SceneMesh | SceneInstance, stem: str, places: Sequence[Transform]
) -> SceneMesh | SceneInstance:
    """Object in the world, with a name that is safe for terminals and files."""
    name = printable(one.name) or printable(stem)
    for place in places:
        one = one.moved(name, place.linear, place.offset)
    reach = np.abs(_corners(one)).max()
    if reach > MAX_COORDINATE_M:
        raise LidarError(
            f"Object {one.name!r} reaches {reach:.3g} m from the origin, farther than anything "
            "on Earth: check its unit and placement."
        )
    return one


def _actor(one: RigidPart, stem: str, upright: Transform, placed: Transform) -> Actor:
    """Return what moves as an actor, with its axes turned as those of the file are.

    Its mesh has all scales, since a trajectory turns and moves only.
    """
    name = printable(one.name) or printable(stem)
    unit_m, scale = (cbrt(determinant(place.linear)) for place in (upright, placed))
    axes = upright.linear / unit_m
    turn = placed.linear / scale
    if np.abs(matmul(turn, turn.T) - np.eye(3)).max() > _EVEN:
        raise LidarError(
            f"Object {name!r} moves, and its placement scales it unevenly: give one factor."
        )
    objects = [part.moved(name, scale * upright.linear, np.zeros(3)) for part in one.objects]
    positions = turned(one.positions, matmul(placed.linear, upright.linear)) + placed.offset
    if not np.abs(positions).max() <= MAX_COORDINATE_M:
        raise LidarError(
            f"Object {name!r} moves farther than anything on Earth: check its unit and placement."
        )
    turns = quaternions_of(matmul(matmul(matmul(turn, axes), one.rotations), axes.T))
    track = Track(one.times_s, positions, turns, start_s=0.0, beyond="hold")
    return Actor(join_meshes(name, objects), track)


def _at_first(actor: Actor) -> SceneMesh:
    positions, rotations = actor.trajectory.poses(0, np.zeros(1))
    turn = np.eye(3) if rotations is None else rotations[0]
    return actor.mesh.moved(actor.name, turn, positions[0])


def _corners(one: SceneMesh | SceneInstance) -> Floats:
    """Points that an object lies between, in the world."""
    if isinstance(one, SceneMesh):
        return (one.animation or one).bounds
    box = np.array(list(product(*one.mesh.bounds.T)))
    return np.asarray(turned(box, one.matrix[:3, :3]) + one.matrix[:3, 3])

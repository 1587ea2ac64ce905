"""Reader of scene files, which returns named meshes in meters with z pointing up.

The supported formats are listed in `mesh_formats`.
"""

from __future__ import annotations

import codecs
import json
import logging
import re
import zipfile
from collections.abc import Callable, Mapping, Sequence
from itertools import product, zip_longest
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ...environment.extras import install_command
from ...errors import (
    CutShortError,
    LidarError,
    MissingFileError,
    as_sentence,
    prefix_errors,
    unreadable_message,
)
from ...io.input_files import not_found, open_input, read_input
from ...motion.rotations import quaternions_of
from ...motion.trajectory import Track
from ...numerics.arrays import Floats
from ...numerics.elementary import cbrt
from ...numerics.vectors import determinant, inverse, matmul, matvec, rotate
from ...schema.vocabulary import UNITS_M
from ...words import format_as_python, format_rounded, list_names, plural, printable
from ..actors import Actor, join_meshes
from ..colors import colors_summary
from ..scene_instances import MAX_COORDINATE_M, SceneInstance, polar_scales
from ..scene_mesh import SceneMesh
from ..transform import UP_AXES, Transform, affine
from .cloud_formats import SCAN_READERS
from .mesh_formats import (
    MeshFormat,
    endings,
    endings_for,
    format_of,
    missing_packages,
    plugin_endings,
    split_options,
)
from .scene_graph import (
    GENERATOR,
    Content,
    MeshFileError,
    NamedFrames,
    ObjectClass,
    ObjectFrame,
    Raster,
    ReadOptions,
    RigidPart,
)
from .text_cloud import is_text_raster

# Comment at the start of files written by lidarpool in formats that do not state a generator.
FORMAT_COMMENT = "lidarpool: meters, Z-up"

_MAX_UNEVENNESS = 1e-6  # maximum difference between the squared scale factors of the axes
_MAX_ROUNDING = 1e-12  # maximum deviation of a rotation matrix from orthonormality
_ZIP = b"PK\x03\x04"  # signature at the start of an archive
_ZIP_END = b"PK\x05\x06"  # signature of the end of an archive
_HEAD_BYTES = 200  # bytes at the start of a file that are searched for the comment

_log = logging.getLogger(__name__)


def warn(note: str) -> None:
    """Log a note as a warning, with option names as in Python."""
    _log.warning(format_as_python(note))


class ObjectFrames(NamedTuple):
    """Frames of objects, and the transforms from file coordinates to world coordinates."""

    in_file: Sequence[ObjectFrame]
    empty_in_file: Sequence[NamedFrames]  # frames without an object
    root: str  # name of the world frame, or an empty string
    upright: Transform  # converts the unit and the axes of the file, and is applied first
    placement: Transform

    def in_world(self) -> list[ObjectFrame]:
        """Return the frames as rigid transforms to world coordinates, in meters.

        As for actors, the axes of the frames are rotated like the axes of the file.
        """
        return [
            ObjectFrame(
                self._place(frame.matrix), self._place_all(frame.enclosing), frame.is_static
            )
            for frame in self.in_file
        ]

    def empty_in_world(self) -> list[NamedFrames]:
        """Return the frames without an object, like `in_world`."""
        return [self._place_all(frames) for frames in self.empty_in_file]

    def _place_all(self, frames: NamedFrames) -> NamedFrames:
        return tuple((printable(name), self._place(matrix)) for name, matrix in frames)

    def _place(self, matrix: Floats) -> Floats:
        """Convert the matrix of a frame to world coordinates, and remove its scale."""
        transforms = (self.upright, self.placement)
        if all(map(_is_identity, transforms)) and _is_rotation(matrix[:3, :3]):
            return matrix
        offset = matrix[:3, 3]
        for transform in transforms:
            offset = matvec(transform.linear, offset) + transform.offset
        axes, turn, rotation = (
            linear if _is_rotation(linear) else _rotation_part(linear)
            for linear in (self.upright.linear, self.placement.linear, matrix[:3, :3])
        )
        return affine(matmul(matmul(matmul(turn, axes), rotation), axes.T), offset)


class Objects(NamedTuple):
    """Objects of a mesh file in world coordinates."""

    static: tuple[SceneMesh | SceneInstance, ...]
    actors: tuple[Actor, ...] = ()  # whose trajectories are of class `Track`
    summary: str = ""  # objects, triangles, unit, axes and colors
    raster: Raster | None = None  # metadata if the file is a raster
    classes: Mapping[
        int, ObjectClass
    ] = {}  # {ASPRS LAS class number: class}, if objects have types
    is_landscape: bool = False  # whether the file represents terrain rather than an object
    epsg: int | None = None  # code of the coordinate system of x and y, if the file states it
    vertical_datum: str = ""  # name of the datum of heights, if the file states it
    frames: ObjectFrames | None = None  # frames of `static`, or None if the format has none

    def at_start(self, report: Callable[[str], None]) -> tuple[SceneMesh | SceneInstance, ...]:
        """Convert actors at their first pose to static objects, and return all objects.

        If there are actors, `report` is called with a message about them.
        """
        if self.actors:
            names = ", ".join(actor.name for actor in self.actors[:3])
            names += ", …" * (len(self.actors) > 3)
            report(f"{names}, but all objects are treated as static at their first pose")
        return (*self.static, *map(_mesh_at_start, self.actors))


def load_objects(
    path: str | Path,
    *,
    report: Callable[[str], None] = warn,
    axes: Callable[[str], None] | None = None,
    **options: Any,
) -> Objects:
    """Read all objects of a mesh file.

    Each placed mesh of a scene graph becomes an object that is named after its node. Large meshes
    that are placed several times become instances. In formats without names, the object is named
    after the file. Objects whose nodes scale them to zero are skipped, and so are instances of
    meshes with zero area.

    Parameters
    ----------
    path
        Path of the file. Its extension must be one of those in `mesh_formats`, in upper or lower
        case.
    report
        Called with messages about skipped objects, unreadable images, materials that may be glass,
        and reference systems. By default, messages are logged as warnings.
    axes
        Called with a message if the file does not state its axes or was rotated. By default, the
        message is logged, as a warning if the scene seems to lie on its side.
    **options
        Options for all formats, which are the fields of `MeshOptions`, and options for the format
        of the file (`MeshFormat.options`). Animated meshes have no masks.

    Returns
    -------
    Objects
        Static objects and, for .usd files, actors in world coordinates. Computations are in double
        precision, but .glb, .gltf and binary .stl files store single precision.

    Raises
    ------
    LidarError
        If the file cannot be read completely, or contains no triangles.
    """
    path = Path(path)
    row = _format_to_read(path)
    data = _bytes_of(path, _HEAD_BYTES if row.from_path else None)
    shared, own = split_options(row, path, options)
    wanted = ReadOptions(
        masks=shared.opacity == "mask" and shared.animation is None,
        colors=shared.colors,
        folders=tuple(folder.resolve() for folder in (path.parent, *shared.asset_folders)),
        unit=shared.unit,
        up_axis=shared.up_axis,
        animation=shared.animation,
        materials=shared.materials,
        own=own,
    )
    # Files can contain infinite numbers and NaN, which are rejected where they matter.
    with np.errstate(all="ignore"):
        content = _read(path, row, data, wanted)
        # The reader of rasters converts the unit itself.
        unit = None if content.raster is not None else shared.unit
        unit_m = UNITS_M[unit] if unit else content.unit_m or 1.0
        axis = shared.up_axis or content.up_axis or "z"
        upright = Transform(UP_AXES[axis] * unit_m, np.zeros(3))
        objects = _place_in_world(path, content, upright, shared.transform)
    _report_notes(path, content, report, unit_given=unit is not None)
    meshes = objects.at_start(lambda _: None)
    if not any((o.mesh if isinstance(o, SceneInstance) else o).has_area for o in meshes):
        raise LidarError(f"{path} contains only triangles without an area.")
    if (
        shared.up_axis is None
        and content.generator != GENERATOR
        and FORMAT_COMMENT.encode() not in data[:_HEAD_BYTES]
    ):
        _report_axes(path, content, meshes, axes)
    epsg, datum = _stated_system(data[:_HEAD_BYTES])
    epsg = content.epsg or epsg
    datum = content.vertical_datum or datum
    if content.raster is not None:
        epsg = content.raster.epsg
    if unit_m != (content.unit_m or 1.0) or axis != (content.up_axis or "z"):
        epsg = None
        datum = ""
    if shared.transform is not None and not shared.transform.keeps_xy:
        epsg = None
    if shared.transform is not None and not shared.transform.keeps_z:
        datum = ""
    objects = objects._replace(
        classes=content.classes,
        is_landscape=content.is_landscape,
        epsg=epsg,
        vertical_datum=datum,
    )
    if content.raster is not None:
        return objects._replace(summary=content.raster.summary, raster=content.raster)
    return objects._replace(summary=_summary(meshes, unit_m, axis, wanted))


def _place_in_world(
    path: Path, content: Content, upright: Transform, transform: Transform | None
) -> Objects:
    """Transform the objects of a file to world coordinates.

    `upright` converts the unit and the axes of the file to meters and z-up, and is applied before
    `transform`. Objects that are farther from the origin than any point on Earth are skipped, which
    is recorded in `content.notes`. Raise LidarError if there are no other objects.
    """
    transforms = [upright] if transform is None else [upright, transform]
    placement = Transform(np.eye(3), np.zeros(3)) if transform is None else transform
    static = []
    frames = []
    actors = []
    reaches_m: dict[str, float] = {}  # {name of a remote object: meters from the origin}
    with prefix_errors(path):
        for mesh, frame in zip_longest(content.meshes, content.frames):
            item, reach_m = _place_object(mesh, path.stem, transforms)
            if item is None:
                reaches_m[printable(mesh.name) or printable(path.stem)] = reach_m
                continue
            static.append(item)
            if frame is not None:
                frames.append(frame)
        for part in content.moving:
            actor, reach_m = _actor_of_part(part, path.stem, upright, placement)
            if actor is None:
                reaches_m[printable(part.name) or printable(path.stem)] = reach_m
            else:
                actors.append(actor)
        if not static and not actors:
            name, reach_m = next(iter(reaches_m.items()))
            raise LidarError(
                f"Object {name!r} reaches {reach_m:.3g} m from the origin, farther than anything "
                "on Earth. Check its unit and placement."
            )
    if reaches_m:
        content.notes.append(
            f"has objects farther than anything on Earth ({max(reaches_m.values()):.3g} m from "
            f"the origin), which were skipped: {list_names([*reaches_m])}. Check their units and "
            "placement"
        )
    placed_frames = None
    if frames:
        root = printable(content.root_frame)
        placed_frames = ObjectFrames(frames, content.empty_frames, root, upright, placement)
    return Objects(tuple(static), tuple(actors), frames=placed_frames)


def _report_notes(
    path: Path, content: Content, report: Callable[[str], None], *, unit_given: bool
) -> None:
    """Call `report` with messages about skipped objects and with the reader's notes."""
    if content.skipped:
        names = ", ".join(content.skipped[:3]) + ", …" * (len(content.skipped) > 3)
        report(f"{path} has objects without an area, which were skipped: {names}.")
    for note in content.notes:
        report(f"{path} {note}.")
    if content.unit_note and not unit_given:
        report(f"{path} {content.unit_note}.")


def load_meshes(
    path: str | Path, *, report: Callable[[str], None] = warn, **options: Any
) -> tuple[SceneMesh | SceneInstance, ...]:
    """Read all objects of a mesh file as static objects.

    `options` are described in `load_objects`.
    """
    objects = load_objects(path, report=report, **options)
    return objects.at_start(lambda line: report(f"{path} moves {line}"))


def _summary(
    meshes: Sequence[SceneMesh | SceneInstance], unit_m: float, up_axis: str, options: ReadOptions
) -> str:
    """Summarize a file, for example as "4 objects, 38 triangles, in m, Y-up, 1 texture"."""
    meshes_once = [item.mesh if isinstance(item, SceneInstance) else item for item in meshes]
    shared = [mesh for item, mesh in zip(meshes, meshes_once, strict=True) if item is not mesh]
    words = [plural(len(meshes), "object")]
    if shared:
        mesh_count = plural(len({id(mesh) for mesh in shared}), "mesh", "meshes")
        words.append(f"{len(shared):,} of them instances of {mesh_count}")
    words += [
        " x ".join(map(str, mesh.voxels.density.shape)) + " voxels"
        for mesh in meshes_once
        if mesh.voxels is not None
    ]
    names = [name for name, meters in UNITS_M.items() if meters == unit_m]
    words += [
        plural(sum(len(mesh.faces) for mesh in meshes_once), "triangle"),
        f"in {names[0] if names else f'units of {unit_m:g} m'}",
        f"{up_axis.upper()}-up",
    ]
    if options.colors:
        words.append(colors_summary(mesh.colors for mesh in meshes_once))
    if options.materials:
        materials = [mesh.materials for mesh in meshes_once if mesh.materials is not None]
        distinct = {name for mesh_materials in materials for name in mesh_materials.names if name}
        words.append(plural(len(distinct), "named material"))
    return ", ".join(words)


def is_written_by_lidarpool(path: Path) -> bool:
    """Return whether lidarpool wrote the file.

    Files written by lidarpool are in meters. The format of the file must not state a unit itself.
    """
    with open_input(path) as file:
        return FORMAT_COMMENT.encode() in file.read(_HEAD_BYTES)


def _stated_system(head: bytes) -> tuple[int | None, str]:
    """Return the EPSG code and the vertical datum in the comments of a file from lidarpool.

    They are None and an empty string if the file does not state them.
    """
    system = rb"(?:\n\S+ crs: EPSG:(\d+))?(?:\n\S+ vertical datum: ([^\n]+))?"
    match = re.search(re.escape(FORMAT_COMMENT.encode()) + system, head)
    if match is None:
        return None, ""
    epsg = int(match[1]) if match[1] else None
    return epsg, (match[2] or b"").decode("ascii", "replace").strip()


def _report_axes(
    path: Path,
    content: Content,
    meshes: Sequence[SceneMesh | SceneInstance],
    axes: Callable[[str], None] | None,
) -> None:
    """Call `axes` with a message if a file does not state its axes or was rotated."""
    if content.rotation_note and content.up_axis == "y":
        doubt = _doubt_about_rotation(content, meshes)
        other_axis = "z"
        statement = f"was rotated from Y-up to Z-up, {content.rotation_note}{doubt}"
    elif path.suffix.lower() == ".obj":  # the format does not define axes, and Y-up is common
        statement = "does not state its axes and is assumed to be Z-up"
        doubt = ""
        other_axis = "y"
    else:
        return
    note = (
        f'{path.name} {statement}. If it lies on its side, set <file.up_axis="{other_axis}">. To '
        "silence this note, set up_axis explicitly"
    )
    if axes is not None:
        axes(note)
    elif doubt:
        warn(note)
    else:
        _log.info(format_as_python(note))


def _doubt_about_rotation(content: Content, meshes: Sequence[SceneMesh | SceneInstance]) -> str:
    """Explain why a file that was rotated from Y-up may actually be Z-up.

    The result is an empty string if the rotation is not in doubt.
    """
    if "trimesh" in content.generator:
        return ", but was written by trimesh, which does not convert axes"
    lower = np.min([_corners(mesh).min(axis=0) for mesh in meshes], axis=0)
    x, y, z = np.max([_corners(mesh).max(axis=0) for mesh in meshes], axis=0) - lower
    if 2 * y < min(x, z):
        width, height, thickness = (format_rounded(side) for side in (x, z, y))
        return f", and is now {width} m wide, {height} m high and {thickness} m thick"
    return ""


def _read(path: Path, row: MeshFormat, data: bytes, options: ReadOptions) -> Content:
    """Read a file, converting all errors to LidarError."""
    try:
        with prefix_errors(path):
            return _checked_content(row, path, data, options)
    except MemoryError:
        raise
    except LidarError as error:
        raise LidarError(f"{error}{_other_format(path, data)}") from error
    except MeshFileError as error:
        raise LidarError(f"{path} {error}.{_other_format(path, data)}") from error
    except Exception as error:
        if row.plugin is not None and isinstance(error, ImportError):
            raise LidarError(f"{path}: {row.plugin.import_error(error)}") from error
        # Readers raise errors of many classes, such as ValueError, IndexError, KeyError,
        # BadZipFile, ParseError and struct.error.
        failure = _truncation_error(error, data) or error
        raise LidarError(
            f"{unreadable_message(path, failure, _advice(failure))}{_other_format(path, data)}"
        ) from error


def _truncation_error(error: Exception, data: bytes) -> CutShortError | None:
    """Return a CutShortError if a library error indicates a truncated file, or None."""
    if isinstance(error, json.JSONDecodeError):
        if error.msg.startswith("Unterminated") or error.pos >= len(error.doc.rstrip()):
            return CutShortError(f"its JSON ends in line {error.lineno}, column {error.colno}")
    elif isinstance(error, zipfile.BadZipFile):
        if data.startswith(_ZIP) and _ZIP_END not in data:
            return CutShortError("it is an archive without the list of files at its end")
    elif isinstance(error, EOFError):
        return CutShortError("its compressed content ends too early")
    return None


def _advice(error: Exception) -> str:
    return f"{'' if isinstance(error, CutShortError) else 'correct it, or '}export it again"


def _checked_content(row: MeshFormat, path: Path, data: bytes, options: ReadOptions) -> Content:
    """Read the content of a file, which must contain at least one object.

    Raise MeshFileError if there are no objects, or if the file is compressed or a web page.
    """
    for beginning, problem in _FOREIGN.items():
        if re.match(beginning, data):
            raise MeshFileError(problem)
    content = row.reader(data, path, options)
    if row.plugin is not None and not isinstance(content, Content):
        raise LidarError(
            f"{row.plugin} must return Content, but returned {type(content).__name__}."
        )
    if content.meshes or content.moving:
        return content
    if content.skipped:
        raise MeshFileError("contains only triangles without an area")
    raise MeshFileError(
        "contains no triangles. It is empty, or contains only points, lines or other elements "
        "without surfaces"
    )


def _format_to_read(path: Path) -> MeshFormat:
    """Return the format of a file, or raise LidarError if the format cannot be read."""
    row = format_of(path)
    if row is not None and not row.advice:
        return row
    if row is not None:
        raise LidarError(f"{path} cannot be read. {as_sentence(row.advice)}")
    further = "".join(
        f". To read the formats of {package}, run {install_command('lidarpool')}"
        for package in missing_packages()
    )
    raise LidarError(
        f"{path} has the extension {path.suffix or '(none)'}, which is not a supported mesh "
        f"format. The supported extensions are {' '.join([*endings(), *plugin_endings()])}, and "
        f".yaml for a scenario{further}."
    )


def _bytes_of(path: Path, max_bytes: int | None) -> bytes:
    """Return the content of a file, or at most its first `max_bytes` bytes."""
    try:
        with prefix_errors(path):
            data = read_input(path, max_bytes)
    except (FileNotFoundError, NotADirectoryError) as error:
        raise MissingFileError(not_found(path, endings())) from error
    except (OSError, ValueError) as error:  # names that contain NUL raise ValueError
        reason = getattr(error, "strerror", None) or error
        raise LidarError(f"{path} cannot be read: {reason}.") from error
    if not data:
        raise LidarError(f"{path} is empty (0 bytes). Export the mesh again.")
    return data.removeprefix(codecs.BOM_UTF8)  # the byte order mark of text editors


# {pattern of the start of a file that is not a mesh: advice}
_FOREIGN = {
    rb"\x1f\x8b|BZh|\xfd7zXZ\0|7z\xbc\xaf": "is compressed. Decompress it first",
    rb"(?i)\s*(<!doctype html|<html)": "is a web page. Download the file itself",
}


def _other_format(path: Path, data: bytes) -> str:
    """Return a hint about the likely format of a rejected file, or an empty string."""
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return " It appears to be encoded in UTF-16. Save it as UTF-8."
    if path.suffix.lower() in SCAN_READERS and not is_text_raster(path):
        return " If it is a point cloud, convert it to a mesh with lidarpool scene points."
    likely = endings_for(data)
    if likely and path.suffix.lower() not in likely:
        return f" It appears to be a {' or '.join(likely)} file. Change its extension."
    return ""


def _place_object(
    item: SceneMesh | SceneInstance, stem: str, transforms: Sequence[Transform]
) -> tuple[SceneMesh | SceneInstance | None, float]:
    """Return an object in world coordinates and its maximum coordinate in meters.

    The object is None if it is too far from the origin. Its name is safe to print and to use in
    files.
    """
    name = printable(item.name) or printable(stem)
    for transform in transforms:
        if name != item.name or not _is_identity(transform):
            item = item.affine_transform(name, transform.linear, transform.offset)
    reach_m = float(np.abs(_corners(item)).max())
    return (item if reach_m <= MAX_COORDINATE_M else None), reach_m


def _is_rotation(linear: Floats) -> bool:
    is_orthonormal = np.abs(matmul(linear, linear.T) - np.eye(3)).max() <= _MAX_ROUNDING
    return bool(is_orthonormal) and float(determinant(linear)) > 0


def _rotation_part(linear: Floats) -> Floats:
    """Return the rotation in a matrix that also scales or mirrors."""
    (scale,) = polar_scales(linear[None])
    return matmul(linear, inverse(scale))


def _is_identity(transform: Transform) -> bool:
    """Return whether a transform is the identity.

    Skipping identity transforms makes files with many objects faster to read.
    """
    return np.array_equal(transform.linear, np.eye(3)) and not transform.offset.any()


def _actor_of_part(
    part: RigidPart, stem: str, upright: Transform, placement: Transform
) -> tuple[Actor | None, float]:
    """Convert a moving part to an actor, and return its maximum coordinate in meters.

    The frame of the actor is rotated like the axes of the file. All scales are applied to the mesh,
    since trajectories only rotate and translate. The actor is None if it is too far from the
    origin.
    """
    name = printable(part.name) or printable(stem)
    unit_m, scale = (cbrt(determinant(transform.linear)) for transform in (upright, placement))
    axes = upright.linear / unit_m
    rotation = placement.linear / scale
    if np.abs(matmul(rotation, rotation.T) - np.eye(3)).max() > _MAX_UNEVENNESS:
        raise LidarError(
            f"Object {name!r} moves but is scaled non-uniformly. Use a single scale factor."
        )
    objects = [
        item.affine_transform(name, scale * upright.linear, np.zeros(3)) for item in part.objects
    ]
    linear = matmul(placement.linear, upright.linear)
    positions = rotate(part.positions, linear) + placement.offset
    reach_m = float(np.abs(positions).max())
    if not reach_m <= MAX_COORDINATE_M:
        return None, reach_m
    rotations = matmul(matmul(matmul(rotation, axes), part.rotations), axes.T)
    track = Track(part.times_s, positions, quaternions_of(rotations), start_s=0.0, beyond="hold")
    return Actor(join_meshes(name, objects), track), reach_m


def _mesh_at_start(actor: Actor) -> SceneMesh:
    positions, rotations = actor.trajectory.poses(0, np.zeros(1))
    rotation = np.eye(3) if rotations is None else rotations[0]
    return actor.mesh.affine_transform(actor.name, rotation, positions[0])


def _corners(item: SceneMesh | SceneInstance) -> Floats:
    """Return world points with the same bounding box as an object."""
    if isinstance(item, SceneMesh):
        return (item.animation or item).bounds
    box = np.array(list(product(*item.mesh.bounds.T)))
    return np.asarray(rotate(box, item.matrix[:3, :3]) + item.matrix[:3, 3])

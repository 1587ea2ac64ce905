"""Triangle meshes of the bodies in MuJoCo models."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Sequence
from dataclasses import replace
from typing import Any, Literal, NamedTuple

import numpy as np

from ..errors import LidarError
from ..motion.rotations import matrices as rotations_of_quaternions
from ..numerics.arrays import Bytes, Floats
from ..numerics.vectors import matmul, matvec, norm, rotate
from ..scene.colors import LINEAR, Colors, as_bytes, as_srgb
from ..scene.face_materials import FaceMaterials
from ..scene.scene_mesh import SceneMesh, stack_meshes
from ..words import name_hint, plural
from .mujoco_geoms import create_geom_mesh
from .shape_meshes import PLANE_M, SAG_M, ShapeMesh

_COLOR_TEXTURE_ROLE = 1  # mjTEXROLE_RGB, a column index of mat_texid

Objects = Literal["body", "geom"]


class ModelBody(NamedTuple):
    """A body that is visible to a lidar, or one geom of such a body."""

    body: int  # ID of the body
    mesh: SceneMesh  # mesh in the body frame, whose arrays are shared by equal bodies


class ModelBodies(NamedTuple):
    """Visible bodies of a model."""

    static: list[SceneMesh]  # meshes in world coordinates
    moving: list[ModelBody]


class BodySelection(NamedTuple):
    """Selection of the visible bodies and geoms, and options for their meshes.

    The options `sag_m` and `plane_m` are those of `create_geom_mesh`.
    """

    groups: Sequence[int]  # visible geom groups
    excluded_bodies: Sequence[int]
    excluded_geoms: Sequence[int]
    objects: Objects  # whether each body or each geom is an object in the scene
    sag_m: float = SAG_M
    plane_m: float = PLANE_M


def find_id(model: Any, kind: str, name: str | int) -> int:
    """Return the ID of a body, geom or site, or -1 if it does not exist.

    `name` is either a name or an ID.
    """
    names = names_of(model, kind)
    if isinstance(name, str):
        return names.index(name) if name in names else -1
    return int(name) if 0 <= name < len(names) else -1


def names_of(model: Any, kind: str) -> list[str]:
    """Return the names of all elements of one kind, such as bodies, geoms or sites.

    An element without a name is named after its kind and ID, such as "geom 3".
    """
    addresses = np.asarray(getattr(model, f"name_{kind}adr"))
    table = bytes(model.names)
    names = [table[start : table.index(b"\0", start)].decode() for start in addresses.tolist()]
    return [name or f"{kind} {number}" for number, name in enumerate(names)]


def require_id(model: Any, kind: str, name: str | int) -> int:
    """Return the ID of a body or site.

    Raises
    ------
    LidarError
        If the body or site does not exist.
    """
    number = find_id(model, kind, name)
    if number < 0:
        raise LidarError(_unknown(name, kind, names_of(model, kind)))
    return number


def find_excluded(model: Any, names: Iterable[str | int]) -> tuple[list[int], list[int]]:
    """Return the IDs of the excluded bodies and of the excluded geoms.

    Parameters
    ----------
    model
        An `mjModel`.
    names
        Names of bodies and geoms, or IDs of bodies.

    Raises
    ------
    LidarError
        If neither a body nor a geom has one of the names.
    """
    bodies = []
    geoms = []
    for name in names:
        body = find_id(model, "body", name)
        geom = find_id(model, "geom", name) if isinstance(name, str) else -1
        if body < 0 and geom < 0:
            known = [*names_of(model, "body"), *names_of(model, "geom")]
            raise LidarError(_unknown(name, "body or geom", known))
        bodies += [body] * (body >= 0)
        geoms += [geom] * (geom >= 0)
    return bodies, geoms


def _unknown(name: str | int, kind: str, known: list[str]) -> str:
    return f"The model has no {kind} {name!r}.{name_hint(str(name), known)}"


def create_bodies(model: Any, choice: BodySelection) -> ModelBodies:
    """Create the meshes of the bodies that have visible geoms.

    Bodies that are welded to the world are static, except for mocap bodies. All other bodies move.
    Completely transparent geoms are omitted, because MuJoCo's ray casting ignores them, too. Flexes
    and skins are also omitted.
    """
    geoms = visible_geoms(model, choice)
    groups = [[geom] for geom in geoms]
    if choice.objects == "body":
        by_body: dict[int, list[int]] = {}
        for geom in geoms:
            by_body.setdefault(int(model.geom_bodyid[geom]), []).append(geom)
        groups = list(by_body.values())
    is_static = _static_bodies(model)
    names = names_of(model, choice.objects)
    colors = _colors(model)
    meshes: dict[Hashable, SceneMesh] = {}  # meshes, which are shared by equal bodies
    static = []
    moving = []
    for group in groups:
        body = int(model.geom_bodyid[group[0]])
        key = tuple(_key(model, geom) for geom in group)
        if key not in meshes:
            meshes[key] = _mesh_of_geoms(model, group, colors, choice)
        name = names[group[0] if choice.objects == "geom" else body]
        if is_static[body]:
            rotation, position = _rest_pose(model, body)
            static.append(meshes[key].affine_transform(name, rotation, position))
        else:
            moving.append(ModelBody(body, replace(meshes[key], name=name)))
    return ModelBodies(static, moving)


def _static_bodies(model: Any) -> Any:
    return (np.asarray(model.body_weldid) == 0) & (np.asarray(model.body_mocapid) < 0)


def visible_geoms(model: Any, choice: BodySelection) -> list[int]:
    """Return the IDs of the geoms that are visible to a lidar."""
    colors = _colors(model)
    seen = np.isin(model.geom_group, choice.groups) & (colors[:, 3] > 0)
    seen &= ~np.isin(model.geom_bodyid, choice.excluded_bodies)
    seen[[*choice.excluded_geoms]] = False
    return np.flatnonzero(seen).tolist()


def _colors(model: Any) -> Floats:
    """Return the RGBA values of all geoms, from 0 to 1.

    The shape is (geoms, 4).
    """
    colors = np.array(model.geom_rgba, np.float64).reshape(-1, 4)
    material = np.asarray(model.geom_matid)
    # As in MuJoCo, the color of the material is used unless the geom has a non-default color.
    by_material = (material >= 0) & (colors == [0.5, 0.5, 0.5, 1]).all(axis=1)
    colors[by_material] = np.asarray(model.mat_rgba)[material[by_material]]
    return colors


def _srgb_of(model: Any, geom: int, color: Floats) -> Bytes:
    """Return the sRGB color of a geom, multiplied by the mean color of its texture."""
    srgb = as_bytes(color[:3])
    material = int(model.geom_matid[geom])
    if material < 0:
        return srgb
    texture_numbers = np.atleast_1d(model.mat_texid[material])
    role = _COLOR_TEXTURE_ROLE if len(texture_numbers) > 1 else 0
    texture = int(texture_numbers[role])
    if texture < 0:
        return srgb
    channels = int(model.tex_nchannel[texture])
    pixels = int(model.tex_height[texture]) * int(model.tex_width[texture])
    start = int(model.tex_adr[texture])
    texels = np.asarray(model.tex_data[start : start + pixels * channels], np.uint8)
    light = LINEAR[texels.reshape(-1, channels)[:, : min(channels, 3)]].mean(axis=0)
    return as_srgb(LINEAR[srgb] * light)


def _mesh_of_geoms(
    model: Any, geoms: list[int], colors: Floats, choice: BodySelection
) -> SceneMesh:
    """Create an unnamed mesh from several geoms of a body, in the body frame.

    `colors` contains the colors of all geoms in the model, with shape (geoms, 4).
    """
    shapes = [_placed_geom(model, geom, choice) for geom in geoms]
    counts = [len(shape.faces) for shape in shapes]
    vertices, faces = stack_meshes((shape.vertices, shape.faces) for shape in shapes)
    face_colors = [_srgb_of(model, geom, colors[geom]) for geom in geoms]
    return SceneMesh(
        "",
        vertices,
        faces,
        colors=Colors.from_face_colors(np.repeat(face_colors, counts, axis=0)),
        materials=_materials_of(model, geoms, counts),
    )


def _placed_geom(model: Any, geom: int, choice: BodySelection) -> ShapeMesh:
    """Create the mesh of a geom in the frame of its body."""
    shape = create_geom_mesh(model, geom, choice.sag_m, choice.plane_m)
    points = rotate(shape.vertices, _rotation(model.geom_quat[geom]))
    return ShapeMesh(points + np.asarray(model.geom_pos[geom], np.float64), shape.faces)


def _materials_of(model: Any, geoms: list[int], counts: list[int]) -> FaceMaterials | None:
    """Return the face materials of several geoms, or None if no geom has a material.

    `counts` contains the number of faces of each geom.
    """
    materials = np.asarray(model.geom_matid)[geoms]
    if (materials < 0).all():
        return None
    names = ["", *names_of(model, "mat")]
    used, index = np.unique(materials + 1, return_inverse=True)
    face_index = np.repeat(index.reshape(-1), counts).astype(np.int32)
    return FaceMaterials(tuple(names[number] for number in used.tolist()), face_index)


def _key(model: Any, geom: int) -> Hashable:
    """Return a key for a geom. Geoms with the same mesh in the body frame have equal keys."""
    fields = ("type", "dataid", "matid", "size", "pos", "quat", "rgba")
    return tuple(np.asarray(getattr(model, f"geom_{field}")[geom]).tobytes() for field in fields)


def _rotation(quaternion: Any) -> Floats:
    """Return the rotation matrix of a quaternion in MuJoCo's order (w, x, y, z)."""
    w, x, y, z = np.asarray(quaternion, np.float64).tolist()
    xyzw = np.array([[x, y, z, w]])
    return np.asarray(rotations_of_quaternions(xyzw / norm(xyzw)[:, None])[0])


def _rest_pose(model: Any, body: int) -> tuple[Floats, Floats]:
    """Return the rotation matrix and the position of a body that is welded to the world."""
    rotation = np.eye(3)
    position = np.zeros(3)
    while body:
        local = _rotation(model.body_quat[body])
        position = matvec(local, position) + np.asarray(model.body_pos[body], np.float64)
        rotation = matmul(local, rotation)
        body = int(model.body_parentid[body])
    return rotation, position


def describe_soft_bodies(model: Any) -> str:
    """Describe the number of flexes and skins in a model. A lidar cannot see them.

    The result is an empty string if the model has none.
    """
    counts = {
        "flex": (int(getattr(model, "nflex", 0)), "flexes"),
        "skin": (int(getattr(model, "nskin", 0)), "skins"),
    }
    return " and ".join(
        plural(count, singular, several) for singular, (count, several) in counts.items() if count
    )

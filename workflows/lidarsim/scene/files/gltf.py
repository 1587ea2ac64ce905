"""glTF 2.0 files, .glb and .gltf, after the specification by the Khronos Group (2021).

trimesh 5.2 is not used, since it places a node of several parents only once, loses the children of
a camera, ignores sparse and normalised positions, skins and required extensions, and reads neither
fans nor files without scenes; nor is assimp, which skips content that it cannot read. Only
triangles are read, and masks and base colours of materials.
"""

from __future__ import annotations

import base64
import json
import math
import re
import struct
from collections.abc import Callable, Generator, Sequence
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import unquote_to_bytes

import numpy as np

from ...base.allowance import Allowance
from ...base.arrays import AnyArray, Bytes, Floats, Ints
from ...base.elementary_scalars import sin_cos_of
from ...base.input_files import read_input
from ...base.vectors import applied, length, matmul
from ...base.words import listed, plural, printable
from ...motion.rotations import matrices
from ..animation import RATE_HZ
from ..colours import LINEAR, Colours, as_srgb
from ..masks import (
    FACE_BYTES,
    MaskError,
    MaskNotes,
    Texture,
    Wrap,
    read_colours,
    read_opacity,
    remembered,
)
from ..scene_mesh import SceneMesh
from .companions import image_file, named_file
from .gltf_animation import WIDTHS, AnimatedNodes, find_animation, keys_of, sample_channels
from .polygons import check_corners, fanned, unrolled
from .scene_graph import (
    MAX_NODES,
    SHORTER,
    SMALLER,
    Content,
    MeshFileError,
    Node,
    Piece,
    ReadOptions,
    bake_animation,
    join_pieces,
    placed_content,
    placed_nodes,
)

_DRACO = "KHR_draco_mesh_compression"
_INSTANCING = "EXT_mesh_gpu_instancing"
_VISIBILITY = "KHR_node_visibility"  # of nodes, and of all nodes below
# Extensions that do not change shapes, or that are supported here.
_READ = re.compile(
    r"KHR_materials_|KHR_techni|\w+_texture_|KHR_texture|KHR_lights|KHR_mesh_quantization|"
    rf"({_DRACO}|{_INSTANCING}|{_VISIBILITY})$"
)
# Extensions that change neither shapes nor colours, and are not worth a note.
_WITHOUT_SHAPE = re.compile(
    r"(KHR_xmp(_json_ld)?|KHR_node_(selectability|hoverability)|KHR_audio_emitter|EXT_lights_\w+|"
    r"EXT_(structural_metadata|mesh_features|instance_features)|CESIUM_primitive_outline)$"
)
_TRANSMISSION = "KHR_materials_transmission"
_GLOSSY = "KHR_materials_pbrSpecularGlossiness"  # materials of older files

_TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
_CUT = ("MASK", "BLEND")  # modes of materials that are transparent somewhere
V = TypeVar("V")
_WRAPS: dict[Any, Wrap] = {33071: "clamp", 33648: "mirror"}


def read_gltf(data: bytes, path: Path, options: ReadOptions) -> Content:
    """Read the default scene of a file, or all nodes of a file without scenes.

    Without the option masks, triangles are solid; without masks and colours, no image is read.
    """
    header, body = _chunks(data)
    _check(header)
    reader = _Reader(header, body, path, len(data), options)
    if options.animation is None:
        content = placed_content(placed_nodes(_roots(header), reader.node, path.stem))
    else:
        content = reader.animated_content(options.animation)
    content.unit_m = 1.0
    content.up_axis = "y"
    content.turned = "as glTF asks"
    notes = [*reader.visibility_notes(), *_extension_notes(header)]
    if notes and not content.meshes:
        raise MeshFileError(f"holds no triangles that can be read: it {'; it '.join(notes)}")
    content.notes = [*notes, *reader.notes.lines(), *reader.motion_notes()]
    content.generator = str(header.get("asset", {}).get("generator", ""))
    return content


_OLD = "is glTF 1.0, which is not supported: convert it to glTF 2.0"


def _chunks(data: bytes) -> tuple[dict[str, Any], bytes]:
    """Return the JSON object, and the binary buffer of a .glb."""
    body = b""
    if data[:4] == b"glTF" and len(data) >= 20:
        version, total, size = struct.unpack_from("<III", data, 4)
        if version == 1:
            raise MeshFileError(_OLD)
        if len(data) < total:
            raise MeshFileError(f"is cut short: {total} bytes announced, {len(data)} there")
        body = data[28 + size : total]
        data = data[20 : 20 + size].rstrip(b"\0")  # with which some programs pad it
    elif data[:1] not in b"{[ \t\r\n":
        raise MeshFileError("is not glTF")
    try:
        header = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise MeshFileError(f"holds no valid JSON ({error})") from error
    if not isinstance(header, dict):
        raise MeshFileError("holds no glTF object")
    return header, body


def _check(header: dict[str, Any]) -> None:
    """Check that a file is glTF 2.0 and requires no unknown extension; MeshFileError if not."""
    # Version 1.0 names parts, instead of numbering them.
    if str(header.get("asset", {}).get("version", "2")).startswith("1") or isinstance(
        header.get("nodes"), dict
    ):
        raise MeshFileError(_OLD)
    for name in map(str, header.get("extensionsRequired", ())):
        if not _READ.match(name):
            raise MeshFileError(f"needs {name}, which cannot be read: export without it")


def _extension_notes(header: dict[str, Any]) -> list[str]:
    """Return a note on the extensions that a file uses and does not require, if any is unknown."""
    names = dict.fromkeys(printable(str(name))[:60] for name in header.get("extensionsUsed", ()))
    unknown = [name for name in names if not (_READ.match(name) or _WITHOUT_SHAPE.match(name))]
    return [f"uses extensions that are not read: {listed(unknown, 8)}"] if unknown else []


def _roots(header: dict[str, Any]) -> list[int]:
    """Return the indices of the outermost nodes."""
    nodes = header.get("nodes", ())
    if scenes := header.get("scenes"):
        return list(scenes[header.get("scene", 0)].get("nodes", ()))
    inner = {child for node in nodes for child in node.get("children", ())}
    return [index for index in range(len(nodes)) if index not in inner]


class _Reader:
    """Reader of nodes, meshes, accessors and buffers by their indices; each is read once."""

    def __init__(
        self,
        header: dict[str, Any],
        body: bytes,
        path: Path,
        size: int,
        options: ReadOptions,
    ) -> None:
        self._header = header
        self._body = body
        self._path = path
        self._options = options
        self._allowance = Allowance(size, SMALLER if options.animation is None else SHORTER)
        self._first_meshes: dict[str, int] = {}  # {primitives: first mesh with these primitives}
        nodes = header.get("nodes", ())
        self._parents = {
            child: index for index, node in enumerate(nodes) for child in node.get("children", ())
        }
        self._posed = cache(self._read_posed)  # keys are (mesh, weights of its targets, skin)
        self._mesh = cache(partial(self._read_posed, weights=(), skin=None))
        self._accessor = cache(self._read_accessor)
        self._buffer_file = cache(self._read_buffer_file)
        self._buffer = cache(self._read_buffer)
        self._texture = cache(self._read_texture)
        self._opacity = remembered(self._read_opacity)
        self._mask = remembered(self._read_mask)
        self._base = remembered(self._read_base)
        self._tinted = remembered(self._read_tinted)
        self.notes = MaskNotes()
        self._hidden_nodes: dict[int, str] = {}  # {node: name}
        self._channels: AnimatedNodes = {}
        self._frame = 0
        self._local = cache(self._read_local)
        self._joints = cache(self._read_joints)
        self._worlds: dict[int, Floats] = {}  # {node: matrix to the scene}, at the frame

    def animated_content(self, name: str) -> Content:
        """Read the scene with meshes animated by an animation, from its first key to its last."""
        animation = find_animation(self._header.get("animations", []), name)
        first, last = keys_of(animation, self._accessor)
        count = max(1, math.ceil((last - first) * RATE_HZ))
        self._allowance.take(32 * (count + 1) * (1 + len(animation["channels"])))
        times_s = np.linspace(first, last, count + 1)
        return bake_animation(self._poses(animation, times_s), times_s.tolist(), self._allowance)

    def _poses(self, animation: dict[str, Any], times_s: Floats) -> Generator[Content]:
        """Yield the content at each time of an animation; only the first has colours."""
        self._channels = sample_channels(animation, times_s, self._accessor)
        if not self._channels:
            raise MeshFileError("has an animation that moves no node: choose another")
        for index, _ in self._channels:
            self._part("nodes", index)
        roots = _roots(self._header)
        for self._frame in range(len(times_s)):
            for cached in (self._local, self._joints, self._posed):  # hold the previous frame
                cached.cache_clear()
            self._worlds.clear()
            yield placed_content(placed_nodes(roots, self.node, self._path.stem), copy_all=True)
            self._options = self._options._replace(colours=False)

    def _read_local(self, index: int) -> Floats:
        """Return the matrix (4, 4) of a node, at the frame of the animation, if any."""
        node = self._part("nodes", index)
        animated = {
            path: self._channels[index, path][self._frame]
            for path in WIDTHS
            if (index, path) in self._channels
        }
        if animated and "matrix" in node:
            raise ValueError(f"node {index} is animated, and has a matrix")
        return _matrix({**node, **animated})

    def _part(self, kind: str, index: Any) -> dict[str, Any]:
        """Return a part of the file by its index; ValueError without such a part."""
        parts: list[dict[str, Any]] = self._header.get(kind, [])
        number = _natural(index)
        if number >= len(parts):
            raise ValueError(f"it refers to number {number} of its {kind}, of {len(parts)}")
        return parts[number]

    def node(self, index: int) -> Node:
        """Return a node; a node without a name gets the name of its mesh.

        A hidden node has neither meshes nor children.
        """
        data = self._part("nodes", index)
        name = str(data.get("name") or "")
        if self._is_hidden(index, data):
            return Node(name, np.eye(4))
        meshes = list[SceneMesh]()
        copies = None
        if "mesh" in data:
            name = name or str(self._part("meshes", data["mesh"]).get("name") or "")
            # Some programs write a mesh for each node, all of the same accessors.
            content = json.dumps(self._part("meshes", data["mesh"])["primitives"], sort_keys=True)
            skin = data.get("skin")
            weights = self._weights(index, data)
            if skin is None and not any(weights):
                meshes = self._mesh(self._first_meshes.setdefault(content, data["mesh"]))
            else:
                meshes = self._posed(data["mesh"], weights, skin)
            if instancing := data.get("extensions", {}).get(_INSTANCING):
                copies = self._copies(instancing.get("attributes", {}))
        children = data.get("children", ())
        skinned = "skin" in data
        return Node(name, self._local(index), meshes, children, copies, skinned)

    def _is_hidden(self, index: int, data: dict[str, Any]) -> bool:
        """Return True for a node that is hidden; ValueError if the file does not say it clearly."""
        visible = _extension(data, _VISIBILITY).get("visible", True)
        if not isinstance(visible, bool):
            raise ValueError(f"node {index} has {visible!r} as {_VISIBILITY}.visible")
        if not visible:
            self._hidden_nodes[index] = printable(str(data.get("name") or f"node {index}"))
        return not visible

    def visibility_notes(self) -> list[str]:
        """Return a note on hidden nodes, if any."""
        if not self._hidden_nodes:
            return []
        names = [*self._hidden_nodes.values()]
        nodes = plural(len(names), "hidden node")
        return [f"has {nodes} ({_VISIBILITY}), left out with all below: {listed(names)}"]

    def _copies(self, attributes: dict[str, Any]) -> Floats | None:
        """Return matrices (k, 4, 4) of the copies of a node's mesh, or None without copies."""
        names = ("TRANSLATION", "ROTATION", "SCALE")
        indices = {name: attributes[name] for name in names if name in attributes}
        if not indices:
            return None
        counts = [_natural(self._part("accessors", index)["count"]) for index in indices.values()]
        if len({*counts}) > 1:
            raise ValueError(f"the attributes of {_INSTANCING} have {counts} rows")
        if counts[0] > MAX_NODES:
            raise MeshFileError(
                f"places a mesh {counts[0]:,} times by {_INSTANCING}, of at most {MAX_NODES:,}: "
                "export it in parts"
            )
        self._allowance.take(2 * 128 * counts[0])
        rows = {name: self._accessor(index).astype(np.float64) for name, index in indices.items()}
        return _matrices(*(rows.get(name) for name in names))

    def motion_notes(self) -> list[str]:
        """Return notes on animations that are not played, or on masks of an animated scene."""
        posed_count = self._posed.cache_info().currsize
        animation_count = len(self._header.get("animations", ()))
        meshes = f", of {plural(posed_count, 'bent mesh', 'bent meshes')}" * bool(posed_count)
        if self._channels:
            has_masks = any(m.get("alphaMode") in _CUT for m in self._header.get("materials", ()))
            return ["is animated, so it is solid where its images are transparent"] * has_masks
        if not animation_count:
            return []
        advice = "all stands still; actors move by animation: NAME"
        return [f"has {plural(animation_count, 'animation')}{meshes}: {advice}"]

    def _weights(self, index: int, node: dict[str, Any]) -> tuple[float, ...]:
        """Return the weights of the morph targets of a node's mesh."""
        mesh = self._part("meshes", node["mesh"])
        if not any("targets" in primitive for primitive in mesh["primitives"]):
            return ()
        if (animated := self._channels.get((index, "weights"))) is not None:
            counts = [len(primitive.get("targets", ())) for primitive in mesh["primitives"]]
            if animated.shape[1] not in counts:
                raise ValueError(f"node {index} has {animated.shape[1]} animated weights")
            return tuple(animated[self._frame].tolist())
        return tuple(map(float, node.get("weights", mesh.get("weights", ()))))

    def _world(self, index: int) -> Floats:
        """Return the matrix (4, 4) from a node's coordinates to the scene's."""
        path = [index]
        worlds = self._worlds
        while path[-1] not in worlds and path[-1] in self._parents:
            path.append(self._parents[path[-1]])
            if len(path) > len(self._parents) + 1:
                raise ValueError("nodes contain each other")
        for node in reversed(path):
            if node not in worlds:
                local = self._local(node)
                parent = self._parents.get(node)
                worlds[node] = local if parent is None else matmul(worlds[parent], local)
        return worlds[index]

    def _read_posed(
        self, index: int, weights: tuple[float, ...], skin: int | None
    ) -> list[SceneMesh]:
        """Return a mesh with morph targets applied; with a skin, in the scene's coordinates.

        All primitives, which differ by material only, are joined.
        """
        mesh = self._part("meshes", index)
        surfaces = [p for p in mesh["primitives"] if p.get("mode", 4) >= 4]
        name = str(mesh.get("name") or self._path.stem)
        joints = None if skin is None else self._joints(skin)

        def piece(primitive: dict[str, Any]) -> Piece:
            unposed = self._primitive(primitive)
            if not len(unposed.faces) or (joints is None and not any(weights)):
                return unposed
            if _DRACO in primitive.get("extensions", {}):
                raise MeshFileError(f"bends what is packed with {_DRACO}: export it without")
            self._allowance.take(600 * len(unposed.vertices))  # of temporary matrices and points
            vertices = unposed.vertices.astype(np.float64)
            for weight, target in zip(weights, primitive.get("targets", ()), strict=False):
                if weight and "POSITION" in target:
                    vertices += weight * self._accessor(target["POSITION"])
            if joints is not None:
                vertices = self._skinned(vertices, primitive["attributes"], joints)
            return unposed._replace(vertices=vertices)

        return join_pieces(name, map(piece, surfaces), self._allowance)

    def _read_joints(self, skin: int) -> Floats:
        """Return matrices (j, 4, 4) of a skin's joints, from mesh to scene; glTF 2.0, 3.7.3."""
        skin_data = self._part("skins", skin)
        if not skin_data.get("joints"):
            raise MeshFileError("has a skin without joints: export it again, or without the skin")
        worlds = np.array([self._world(joint) for joint in skin_data["joints"]])
        if (inverse := skin_data.get("inverseBindMatrices")) is not None:
            columns = self._accessor(inverse).astype(np.float64)[: len(worlds)]
            worlds = matmul(worlds, columns.reshape(len(worlds), 4, 4).transpose(0, 2, 1))
        return worlds

    def _skinned(self, vertices: Floats, attributes: dict[str, Any], joints: Floats) -> Floats:
        """Return vertices (v, 3) moved by the weighted joints (j, 4, 4) of each vertex."""
        blend = np.zeros((len(vertices), 4, 4))
        total = np.zeros(len(vertices))
        sets = (
            name.removeprefix("JOINTS") for name in sorted(attributes) if name.startswith("JOINTS_")
        )
        for number in sets:
            rows = self._accessor(attributes[f"JOINTS{number}"]).astype(np.int64)
            weights = self._accessor(attributes[f"WEIGHTS{number}"]).astype(np.float64)
            for joint, weight in zip(rows.T, weights.T, strict=True):
                if joint.max(initial=0) >= len(joints):
                    raise ValueError(f"a vertex has joint {joint.max()} of {len(joints)}")
                blend += weight[:, None, None] * joints[joint]
                total += weight
        unweighted = np.flatnonzero(total <= 0)  # other readers move these by the first joint
        blend[unweighted] = joints[
            self._accessor(attributes["JOINTS_0"])[unweighted, 0].astype(np.int64)
        ]
        total[unweighted] = 1.0
        blend /= total[:, None, None]
        moved = applied(blend[:, :3, :3], vertices) + blend[:, :3, 3]
        return np.asarray(moved)

    def _primitive(self, primitive: dict[str, Any]) -> Piece:
        """Return the triangles of a primitive, with mask, colours and material."""
        position = primitive["attributes"].get("POSITION")
        index = primitive.get("indices")
        packed = primitive.get("extensions", {}).get(_DRACO)
        if position is None:
            return Piece(np.empty((0, 3)), np.empty((0, 3), np.int64))
        if packed and "bufferView" not in self._part("accessors", position):
            mesh = _unpacked(bytes(self._view(packed["bufferView"])), self._allowance)
            vertices = np.asarray(mesh.points).reshape(-1, 3)
            faces = np.asarray(mesh.faces, np.int64).reshape(-1, 3)
            return self._with_material(Piece(vertices, faces), primitive, mesh)
        vertices = self._accessor(position)
        mode = primitive.get("mode", 4)
        # The corners, and the triangles of strips and fans, before they are checked.
        count = len(vertices if index is None else self._accessor(index))
        self._allowance.take((8 if mode == 4 else 24) * count)
        corners = np.arange(count)
        if index is not None:
            corners = self._accessor(index)[:, 0].astype(np.int64)
        if mode == 4:
            faces = corners[: len(corners) // 3 * 3].reshape(-1, 3)
        else:
            faces = unrolled(corners) if mode == 5 else fanned(corners)
        return self._with_material(Piece(vertices, faces), primitive)

    def _with_material(self, piece: Piece, primitive: dict[str, Any], mesh: Any = None) -> Piece:
        """Return a piece with mask, colours and material; `mesh` is the mesh unpacked by Draco."""
        if self._options.materials and (number := primitive.get("material")) is not None:
            piece = piece._replace(material=self._material_name(number))
        if self._options.colours and len(piece.faces):
            with self.notes.without_colour(self._material_name(primitive.get("material"))):
                piece = piece._replace(colours=self._face_colours(primitive, piece.faces, mesh))
        return self._with_mask(piece, primitive, mesh)

    def _face_colours(self, primitive: dict[str, Any], faces: Ints, mesh: Any) -> Colours | None:
        """Return the colours of a primitive's triangles, or None."""
        number = primitive.get("material")
        corners = None
        colours = None
        if not self._allowance.fits(FACE_BYTES * len(faces)):
            raise MaskError("there are too many triangles")
        if "COLOR_0" in primitive["attributes"]:
            light = self._normalised(self._attribute("COLOR_0", primitive, mesh))
            check_corners(faces, len(light))
            if light.shape[1] < 3:
                raise MaskError("its COLOR_0 is not red, green and blue")
            corners = as_srgb(np.clip(light[:, :3], 0, 1))[faces]
            colours = Colours.of_corners(corners)
        if number is not None:
            base, info = self._base(_natural(number))
            if isinstance(base, Texture):
                colours = base.colours(self._coordinates(info, primitive, mesh), faces)
            else:
                colours = Colours.plain(base, len(faces))
        return colours and replace(colours, corners=corners)

    def _read_base(self, number: int) -> tuple[Texture | Bytes, dict[str, Any]]:
        """Return the texture of a material's base colour and its texture info.

        The base colour of a material without a texture is a plain colour (1, 1, 3).
        """
        material = self._part("materials", number)
        info, factor = _base_of(material)
        light = tuple(float(np.clip(component, 0, 1)) for component in factor[:3])
        if len(light) < 3:
            raise MaskError("its factor is not red, green and blue")
        if info is None:
            return as_srgb(light).reshape(1, 1, 3), {}
        texture = self._part("textures", info["index"])
        return self._tinted((_image_of(texture), light, *self._wraps(texture))), info

    def _read_tinted(self, key: tuple[int, tuple[float, ...], Wrap, Wrap]) -> Texture:
        """Return the texture of a tinted image; keys are (image, linear tint, wraps)."""
        image, light, wrap_u, wrap_v = key
        colours = self._image(image, partial(read_colours, notes=self.notes))
        if light != (1.0, 1.0, 1.0):
            scaled = [as_srgb(LINEAR * share) for share in light]
            colours = np.stack([table[colours[..., k]] for k, table in enumerate(scaled)], axis=-1)
        return Texture(colours, (wrap_u, wrap_v), self._allowance)

    def _wraps(self, texture: dict[str, Any]) -> tuple[Wrap, Wrap]:
        """Return the continuation of a texture beyond its edges, along u and along v."""
        sampler = self._part("samplers", texture["sampler"]) if "sampler" in texture else {}
        wrap_u, wrap_v = (_WRAPS.get(sampler.get(name), "repeat") for name in ("wrapS", "wrapT"))
        return wrap_u, wrap_v

    def _with_mask(self, piece: Piece, primitive: dict[str, Any], mesh: Any) -> Piece:
        """Return a piece with the mask of its material."""
        number = primitive.get("material")
        if number is not None and self._options.masks and len(piece.faces):
            with self.notes.without_mask(self._material_name(number)):
                if mask := self._texture(number):
                    texture, info = mask
                    uv = self._coordinates(info, primitive, mesh)
                    piece = piece._replace(cutout=texture.cutout(uv, piece.faces))
        return piece

    def _material_name(self, number: Any) -> str:
        """Return the name of a material, or "material 3" for a material without a name."""
        try:
            name = str(self._part("materials", number).get("name") or "")
        except (ValueError, KeyError, IndexError, TypeError, AttributeError):
            name = ""
        return name[:80] or f"material {str(number)[:20]}"

    def _read_texture(self, number: int) -> tuple[Texture, dict[str, Any]] | None:
        """Return the mask of a material and its texture info; None for a solid material."""
        material = self._part("materials", number)
        mode = material.get("alphaMode", "OPAQUE")
        if mode not in _CUT:
            if _extension(material, _TRANSMISSION).get("transmissionFactor", 0) > 0:
                self.notes.glass[self._material_name(number)] = None
            return None
        info, factor = _base_of(material)
        cutoff = material.get("alphaCutoff", 0.5) if mode == "MASK" else 0.5
        passing = np.flatnonzero(np.arange(256) / 255 * factor[3] >= cutoff)
        min_alpha = int(passing[0]) if len(passing) else 256
        texture = {} if info is None else self._part("textures", info["index"])
        image = -1 if info is None else _image_of(texture)
        opacity = None if info is None else self._opacity(image)
        if info is None or opacity is None or (mode == "BLEND" and opacity.max() < min_alpha):
            if min_alpha > 255 or opacity is not None:
                self.notes.glass[self._material_name(number)] = None
            return None
        if opacity.min() >= min_alpha:
            return None
        return self._mask((image, min_alpha, *self._wraps(texture))), info

    def _read_mask(self, key: tuple[int, int, Wrap, Wrap]) -> Texture:
        """Return the mask of an image; keys are (image, least alpha that stops light, wraps)."""
        image, min_alpha, wrap_u, wrap_v = key
        opacity = self._opacity(image)
        assert opacity is not None
        return Texture(opacity >= min_alpha, (wrap_u, wrap_v), self._allowance)

    def _read_opacity(self, index: int) -> Bytes | None:
        """Return the opacity of an image; None for an opaque image."""
        return self._image(index, read_opacity)

    def _image(self, index: int, read: Callable[[Path | bytes, Allowance], V]) -> V:
        """Return an image, decoded by `read`."""
        image = self._part("images", index)
        if "bufferView" in image:
            return read(bytes(self._view(image["bufferView"])), self._allowance)
        uri = image["uri"]
        if uri.startswith("data:"):
            return read(_inline(uri), self._allowance)
        return read(image_file(self._path, uri, self._options, self._allowance), self._allowance)

    def _coordinates(self, info: dict[str, Any], primitive: dict[str, Any], mesh: Any) -> Any:
        """Return the texture coordinates (v, 2) of a primitive for a texture info."""
        transform = _extension(info, "KHR_texture_transform")
        name = f"TEXCOORD_{transform.get('texCoord', info.get('texCoord', 0))}"
        if name not in primitive["attributes"]:
            raise MaskError("texture coordinates are missing")
        uv = self._attribute(name, primitive, mesh)
        if uv.shape[1] != 2:
            raise MaskError("its texture coordinates are not pairs")
        if transform:
            # KHR_texture_transform scales, rotates anticlockwise as v grows down, then moves.
            angle = float(transform.get("rotation", 0))
            s, c = sin_cos_of(angle)
            self._allowance.take(32 * len(uv))
            uv = uv * np.array(transform.get("scale", (1, 1)), np.float64)
            uv = matmul(uv, [[c, -s], [s, c]]) + np.array(transform.get("offset", (0, 0)))
        return uv

    def _attribute(self, name: str, primitive: dict[str, Any], mesh: Any) -> AnyArray:
        """Return an attribute (v, width) of the vertices of a primitive."""
        accessor = primitive["attributes"][name]
        if mesh is None:
            return self._accessor(accessor)
        packed = primitive["extensions"][_DRACO]["attributes"][name]
        rows = np.asarray(mesh.get_attribute_by_unique_id(packed)["data"])
        normal = self._part("accessors", accessor).get("normalized")
        return self._normalised(rows) if normal else rows

    def _read_accessor(self, index: int) -> AnyArray:
        """Return the numbers (count, width) of an accessor, if possible without a copy."""
        accessor = self._part("accessors", index)
        count = _natural(accessor["count"])
        if accessor["type"] not in _WIDTHS or accessor["componentType"] not in _TYPES:
            raise ValueError(
                f"accessor {index} has the type {accessor['type']!r} of "
                f"{accessor['componentType']!r}, which glTF does not know"
            )
        width = _WIDTHS[accessor["type"]]
        kind = np.dtype(_TYPES[accessor["componentType"]])
        sparse = accessor.get("sparse")
        if sparse:
            self._allowance.take(count * width * kind.itemsize)
        if "bufferView" in accessor:
            numbers = self._array(accessor, kind, count, width)
        elif sparse:
            numbers = np.zeros((count, width), kind)
        else:
            raise ValueError(f"accessor {index} has no content")
        if sparse:
            changed = sparse["indices"]
            values = sparse["values"]
            index_type = np.dtype(_TYPES[changed["componentType"]])
            rows = self._array(changed, index_type, sparse["count"], 1)[:, 0]
            numbers = numbers.copy()
            numbers[rows] = self._array(values, kind, sparse["count"], width)
        return self._normalised(numbers) if accessor.get("normalized") else numbers

    def _normalised(self, numbers: AnyArray) -> AnyArray:
        """Return the fractions that integers encode; glTF 2.0, 3.6.2.2."""
        if numbers.dtype.kind not in "iu":
            return numbers
        self._allowance.take(8 * numbers.size)
        return np.maximum(numbers / np.iinfo(numbers.dtype).max, -1.0)

    def _array(self, part: dict[str, Any], kind: np.dtype[Any], count: int, width: int) -> Any:
        """Return numbers (count, width) of a buffer view, from `part['byteOffset']` on."""
        row = kind.itemsize * width
        stride = self._part("bufferViews", part["bufferView"]).get("byteStride", row)
        view = self._view(part["bufferView"])[part.get("byteOffset", 0) :]
        if not count:
            return np.empty((0, width), kind)
        if stride * (count - 1) + row > len(view):
            raise ValueError(f"{count:,} elements announced, {len(view):,} bytes there")
        return np.ndarray((count, width), kind, view, strides=(stride, kind.itemsize))

    def _view(self, index: int) -> memoryview:
        """Return the bytes of a buffer view."""
        view = self._part("bufferViews", index)
        start = view.get("byteOffset", 0)
        return memoryview(self._buffer(view["buffer"]))[start : start + view["byteLength"]]

    def _read_buffer(self, index: int) -> bytes:
        """Return the bytes of a buffer, of the file itself, a data URI or a further file."""
        buffer = self._part("buffers", index)
        uri = buffer.get("uri")
        if uri is None:
            if index:
                raise MeshFileError("has a buffer without content, as packed files have: unpack it")
            content = self._body
        elif uri.startswith("data:"):
            content = _inline(uri)
        else:
            content = self._buffer_file(uri)
        if len(content) < buffer["byteLength"]:
            raise MeshFileError(
                f"takes {buffer['byteLength']:,} bytes from {uri[:80] if uri else 'itself'!r}, "
                f"which is cut short: it has {len(content):,}"
            )
        return content

    def _read_buffer_file(self, uri: str) -> bytes:
        """Return the bytes of a buffer file."""
        target = named_file(self._path, uri, self._options, allow_moved=False)
        if target is None:
            raise MeshFileError(
                f"takes data from {uri[:80]!r}, a file that is not there: put it beside, or export "
                "as .glb"
            )
        self._allowance.add_file(target)
        return read_input(target)


def _inline(uri: str) -> bytes:
    """Return the content of a data URI."""
    kind, _, text = uri.partition(",")
    content = unquote_to_bytes(text)
    return base64.b64decode(content) if kind.endswith(";base64") else content


def _extension(part: dict[str, Any], name: str) -> dict[str, Any]:
    """Return the data of an extension of a part, or {}."""
    extension: dict[str, Any] = part.get("extensions", {}).get(name, {})
    return extension


def _base_of(material: dict[str, Any]) -> tuple[dict[str, Any] | None, Sequence[float]]:
    """Return the texture info of a material's base colour, or None, and the colour's factors."""
    usual = material.get("pbrMetallicRoughness", {})
    glossy = _extension(material, _GLOSSY)
    info = usual.get("baseColorTexture") or glossy.get("diffuseTexture")
    return info, usual.get("baseColorFactor") or glossy.get("diffuseFactor") or (1, 1, 1, 1)


def _image_of(texture: dict[str, Any]) -> int:
    """Return the index of a texture's image in a format that can be read."""
    index = texture.get("source", _extension(texture, "EXT_texture_webp").get("source"))
    if index is None:
        raise MaskError("its image is in a format that cannot be read")
    return _natural(index)


def _natural(number: Any) -> int:
    """Return a count or an index; ValueError for a negative number or no integer."""
    if type(number) is not int or number < 0:
        raise ValueError(f"{number!r} is given as an index or a count")
    return number


def _matrix(node: dict[str, Any]) -> Floats:
    """Return the matrix (4, 4) of a node: of columns, or of translation, rotation and scale."""
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    rows = (
        np.array([node[name]], np.float64) if name in node else None
        for name in ("translation", "rotation", "scale")
    )
    transforms = _matrices(*rows)
    return np.eye(4) if transforms is None else transforms[0]


def _matrices(
    translation: Floats | None,
    rotation: Floats | None,
    scale: Floats | None,
) -> Floats | None:
    """Return matrices (k, 4, 4) from translations (k, 3), quaternions (k, 4) and scales (k, 3)."""
    rows = next((part for part in (translation, rotation, scale) if part is not None), None)
    if rows is None:
        return None
    transforms = np.tile(np.eye(4), (len(rows), 1, 1))
    if rotation is not None:
        unit = rotation / length(rotation)[:, None]
        transforms[:, :3, :3] = matrices(unit)
    if scale is not None:
        transforms[:, :3, :3] *= scale[:, None]
    if translation is not None:
        transforms[:, :3, 3] = translation
    return transforms


def _unpacked(data: bytes, allowance: Allowance) -> Any:
    """Return a mesh that is packed with Draco."""
    try:
        import DracoPy
    except ImportError as error:
        raise MeshFileError(
            f"is packed with {_DRACO}: install DracoPy to read it, or export without it"
        ) from error
    allowance.take(24 * sum(_draco_counts(data)))
    return DracoPy.decode(data)


def _draco_counts(data: bytes) -> tuple[int, int]:
    """Return the numbers of faces and vertices that a Draco mesh of format 2.2 announces.

    The decoder allocates as many, though a few bytes can announce any number.
    """
    magic, version, kind, method, flags = struct.unpack_from("<5sHBBH", data)
    if magic != b"DRACO" or kind != 1 or method > 1:
        raise ValueError("its Draco data are not a mesh")
    if version != 0x0202 or flags & 0x8000:
        raise MeshFileError(
            "has Draco data of another version than 2.2, or with metadata: export it again"
        )
    # Numbers of seven bits a byte, lowest first; the second method has a byte more before these.
    first, second = re.findall(rb"(?s)[\x80-\xff]*[\0-\x7f]", data[11 + method : 31])[:2]
    return _varint(first), _varint(second)


def _varint(data: bytes) -> int:
    """Return a number stored as seven bits a byte, lowest first."""
    return sum((byte & 0x7F) << 7 * position for position, byte in enumerate(data))

"""Reader of glTF 2.0 files (.glb and .gltf), as specified by the Khronos Group (2021).

trimesh 5.2 is not used because it places a node with several parents only once, loses the children
of cameras, ignores sparse and normalized positions, skins and required extensions, and reads
neither triangle fans nor files without scenes. assimp is not used because it skips content that it
cannot read. This reader only reads triangles, and the masks and base colors of materials.
"""

from __future__ import annotations

import json
import math
from collections.abc import Generator
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from ...io.allowance import Allowance
from ...motion.rotations import matrices
from ...numerics.arrays import Floats
from ...numerics.vectors import matmul, matvec, norm
from ...words import list_names, plural, printable
from ..animation import RATE_HZ
from ..scene_mesh import SceneMesh
from .gltf_animation import WIDTHS, AnimatedNodes, find_animation, keyframe_range, sample_channels
from .gltf_draco import DRACO, decompress_draco
from .gltf_file import (
    INSTANCING,
    VISIBILITY,
    GltfFile,
    check_index,
    check_readable,
    extension,
    extension_notes,
    root_nodes,
    split_chunks,
)
from .gltf_materials import GltfMaterials
from .polygons import fan_triangles, unroll_strip
from .scene_graph import (
    GENERATOR,
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


def read_gltf(data: bytes, path: Path, options: ReadOptions) -> Content:
    """Read the default scene of a file, or all nodes if the file has no scenes.

    If `options.masks` is not set, all triangles are opaque. If `options.colors` is not set either,
    no images are read.
    """
    header, body = split_chunks(data)
    check_readable(header)
    allowance = Allowance(len(data), SMALLER if options.animation is None else SHORTER)
    file = GltfFile(header, body, path, options, allowance)
    materials = GltfMaterials(file, options)
    reader = _NodeReader(file, materials)
    if options.animation is None:
        content = placed_content(placed_nodes(root_nodes(header), reader.node, path.stem))
    else:
        content = reader.animated_content(options.animation)
    content.unit_m = 1.0
    content.up_axis = "y"
    content.rotation_note = "as glTF requires"
    notes = [*reader.visibility_notes(), *extension_notes(header)]
    if notes and not content.meshes:
        raise MeshFileError(f"contains no readable triangles, because it {'; it '.join(notes)}")
    content.notes = [*notes, *materials.notes.lines(), *reader.motion_notes()]
    asset = header.get("asset", {})
    content.generator = str(asset.get("generator", ""))
    extras = asset.get("extras")
    if content.generator == GENERATOR and isinstance(extras, dict):
        epsg = extras.get("epsg")
        content.epsg = epsg if type(epsg) is int else None
        content.vertical_datum = str(extras.get("vertical_datum", ""))
    return content


class _NodeReader:
    """A reader that caches nodes, meshes and skins."""

    def __init__(self, file: GltfFile, materials: GltfMaterials) -> None:
        self._file = file
        self._materials = materials
        self._allowance = file.allowance
        self._first_meshes: dict[str, int] = {}  # {primitives: first mesh that has them}
        nodes = file.header.get("nodes", ())
        self._parents = {
            child: index for index, node in enumerate(nodes) for child in node.get("children", ())
        }
        self._posed = cache(self._read_posed)  # keys are (mesh, morph target weights, skin)
        self._mesh = cache(partial(self._read_posed, weights=(), skin=None))
        self._hidden_nodes: dict[int, str] = {}  # {node: name}
        self._channels: AnimatedNodes = {}
        self._frame = 0
        self._local = cache(self._read_local)
        self._joints = cache(self._read_joints)
        self._worlds: dict[int, Floats] = {}  # {node: transform to the scene} in this frame

    def animated_content(self, name: str) -> Content:
        """Read the scene and bake an animation into its meshes.

        The animation is baked from its first to its last keyframe.
        """
        animation = find_animation(self._file.header.get("animations", []), name)
        first, last = keyframe_range(animation, self._file.accessor)
        count = max(1, math.ceil((last - first) * RATE_HZ))
        self._allowance.reserve(32 * (count + 1) * (1 + len(animation["channels"])))
        times_s = np.linspace(first, last, count + 1)
        return bake_animation(self._poses(animation, times_s), times_s.tolist(), self._allowance)

    def _poses(self, animation: dict[str, Any], times_s: Floats) -> Generator[Content]:
        """Yield the content at each time of an animation.

        Only the content at the first time has colors.
        """
        self._channels = sample_channels(animation, times_s, self._file.accessor)
        if not self._channels:
            raise MeshFileError(
                "has an animation that does not move any node. Choose another animation"
            )
        for index, _ in self._channels:
            self._file.part("nodes", index)
        roots = root_nodes(self._file.header)
        for self._frame in range(len(times_s)):
            for cached in (self._local, self._joints, self._posed):  # depend on the frame
                cached.cache_clear()
            self._worlds.clear()
            yield placed_content(
                placed_nodes(roots, self.node, self._file.path.stem), copy_all=True
            )
            self._materials.options = self._materials.options._replace(colors=False)

    def _read_local(self, index: int) -> Floats:
        """Return the local transform of a node in the current animation frame."""
        node = self._file.part("nodes", index)
        animated = {
            path: self._channels[index, path][self._frame]
            for path in WIDTHS
            if (index, path) in self._channels
        }
        if animated and "matrix" in node:
            raise ValueError(f"node {index} is animated but has a matrix")
        return _matrix({**node, **animated})

    def node(self, index: int) -> Node:
        """Return a node, named after its mesh if it has no name.

        Hidden nodes are returned without meshes and children.
        """
        data = self._file.part("nodes", index)
        name = str(data.get("name") or "")
        if self._is_hidden(index, data):
            return Node(name, np.eye(4))
        meshes = list[SceneMesh]()
        copies = None
        if "mesh" in data:
            name = name or str(self._file.part("meshes", data["mesh"]).get("name") or "")
            # Some programs write a separate mesh for each node, although the accessors are the
            # same.
            content = json.dumps(
                self._file.part("meshes", data["mesh"])["primitives"], sort_keys=True
            )
            skin = data.get("skin")
            weights = self._weights(index, data)
            if skin is None and not any(weights):
                meshes = self._mesh(self._first_meshes.setdefault(content, data["mesh"]))
            else:
                meshes = self._posed(data["mesh"], weights, skin)
            if instancing := data.get("extensions", {}).get(INSTANCING):
                copies = self._copies(instancing.get("attributes", {}))
        children = data.get("children", ())
        skinned = "skin" in data
        return Node(name, self._local(index), meshes, children, copies, skinned)

    def _is_hidden(self, index: int, data: dict[str, Any]) -> bool:
        """Return whether a node is hidden, and record hidden nodes."""
        visible = extension(data, VISIBILITY).get("visible", True)
        if not isinstance(visible, bool):
            raise ValueError(
                f"{VISIBILITY}.visible of node {index} must be true or false, but is {visible!r}"
            )
        if not visible:
            self._hidden_nodes[index] = printable(str(data.get("name") or f"node {index}"))
        return not visible

    def visibility_notes(self) -> list[str]:
        """Return a note on hidden nodes if there are any."""
        if not self._hidden_nodes:
            return []
        names = [*self._hidden_nodes.values()]
        nodes = plural(len(names), "hidden node")
        return [
            f"has {nodes} ({VISIBILITY}). Hidden nodes and their descendants were skipped: "
            f"{list_names(names)}"
        ]

    def _copies(self, attributes: dict[str, Any]) -> Floats | None:
        """Return the transforms of a node's mesh instances, or None if it is not instanced.

        The shape is (k, 4, 4).
        """
        names = ("TRANSLATION", "ROTATION", "SCALE")
        indices = {name: attributes[name] for name in names if name in attributes}
        if not indices:
            return None
        counts = [
            check_index(self._file.part("accessors", index)["count"]) for index in indices.values()
        ]
        if len({*counts}) > 1:
            raise ValueError(
                f"the attributes of {INSTANCING} must have the same number of rows, but have "
                f"{counts}"
            )
        if counts[0] > MAX_NODES:
            raise MeshFileError(
                f"places a mesh {counts[0]:,} times with {INSTANCING}, but the limit is "
                f"{MAX_NODES:,}. Export it in parts"
            )
        self._allowance.reserve(2 * 128 * counts[0])
        rows = {
            name: self._file.accessor(index).astype(np.float64) for name, index in indices.items()
        }
        return _matrices(*(rows.get(name) for name in names))

    def motion_notes(self) -> list[str]:
        """Return notes on animations that are not played, or on masks in an animated scene."""
        posed_count = self._posed.cache_info().currsize
        animation_count = len(self._file.header.get("animations", ()))
        meshes = (f" with {plural(posed_count, 'deformed mesh', 'deformed meshes')}") * bool(
            posed_count
        )
        if self._channels:
            if not self._materials.have_masks:
                return []
            return ["is animated, so transparent areas of its images are treated as opaque"]
        if not animation_count:
            return []
        advice = (
            "Animations are not played in the static scene. To play one, set `animation: NAME` "
            "on an actor"
        )
        return [f"has {plural(animation_count, 'animation')}{meshes}. {advice}"]

    def _weights(self, index: int, node: dict[str, Any]) -> tuple[float, ...]:
        """Return the morph target weights of a node's mesh in the current animation frame."""
        mesh = self._file.part("meshes", node["mesh"])
        if not any("targets" in primitive for primitive in mesh["primitives"]):
            return ()
        if (animated := self._channels.get((index, "weights"))) is not None:
            counts = [len(primitive.get("targets", ())) for primitive in mesh["primitives"]]
            if animated.shape[1] not in counts:
                raise ValueError(
                    f"node {index} has {animated.shape[1]} animated weights, which does not match "
                    "the number of morph targets of its mesh"
                )
            return tuple(animated[self._frame].tolist())
        return tuple(map(float, node.get("weights", mesh.get("weights", ()))))

    def _world(self, index: int) -> Floats:
        """Return the transform from node coordinates to scene coordinates."""
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
        """Return a mesh with morph targets applied.

        A mesh with a skin is returned in scene coordinates. All primitives of the mesh are merged,
        since they differ only in their materials.
        """
        mesh = self._file.part("meshes", index)
        surfaces = [p for p in mesh["primitives"] if p.get("mode", 4) >= 4]
        name = str(mesh.get("name") or self._file.path.stem)
        joints = None if skin is None else self._joints(skin)

        def piece(primitive: dict[str, Any]) -> Piece:
            unposed = self._primitive(primitive)
            if not len(unposed.faces) or (joints is None and not any(weights)):
                return unposed
            if DRACO in primitive.get("extensions", {}):
                raise MeshFileError(
                    f"deforms meshes that are compressed with {DRACO}, which is not supported. "
                    "Export it without this extension"
                )
            self._allowance.reserve(600 * len(unposed.vertices))  # temporary matrices and points
            vertices = unposed.vertices.astype(np.float64)
            for weight, target in zip(weights, primitive.get("targets", ()), strict=False):
                if weight and "POSITION" in target:
                    vertices += weight * self._file.accessor(target["POSITION"])
            if joints is not None:
                vertices = self._apply_skin(vertices, primitive["attributes"], joints)
            return unposed._replace(vertices=vertices)

        return join_pieces(name, map(piece, surfaces), self._allowance)

    def _read_joints(self, skin: int) -> Floats:
        """Return the transforms of a skin's joints from mesh coordinates to scene coordinates.

        See glTF 2.0, section 3.7.3. The shape is (j, 4, 4).
        """
        skin_data = self._file.part("skins", skin)
        if not skin_data.get("joints"):
            raise MeshFileError("has a skin without joints. Export it without the skin")
        worlds = np.array([self._world(joint) for joint in skin_data["joints"]])
        if (inverse := skin_data.get("inverseBindMatrices")) is not None:
            columns = self._file.accessor(inverse).astype(np.float64)[: len(worlds)]
            worlds = matmul(worlds, columns.reshape(len(worlds), 4, 4).transpose(0, 2, 1))
        return worlds

    def _apply_skin(self, vertices: Floats, attributes: dict[str, Any], joints: Floats) -> Floats:
        """Transform each vertex by its weighted joints."""
        blend = np.zeros((len(vertices), 4, 4))
        total = np.zeros(len(vertices))
        sets = (
            name.removeprefix("JOINTS") for name in sorted(attributes) if name.startswith("JOINTS_")
        )
        for number in sets:
            rows = self._file.accessor(attributes[f"JOINTS{number}"]).astype(np.int64)
            weights = self._file.accessor(attributes[f"WEIGHTS{number}"]).astype(np.float64)
            for joint, weight in zip(rows.T, weights.T, strict=True):
                if joint.max(initial=0) >= len(joints):
                    raise ValueError(
                        f"a vertex refers to joint {joint.max()}, but there are {len(joints)} "
                        "joints"
                    )
                blend += weight[:, None, None] * joints[joint]
                total += weight
        unweighted = np.flatnonzero(total <= 0)  # use the first joint, as other readers do
        blend[unweighted] = joints[
            self._file.accessor(attributes["JOINTS_0"])[unweighted, 0].astype(np.int64)
        ]
        total[unweighted] = 1.0
        blend /= total[:, None, None]
        moved = matvec(blend[:, :3, :3], vertices) + blend[:, :3, 3]
        return np.asarray(moved)

    def _primitive(self, primitive: dict[str, Any]) -> Piece:
        """Return a primitive as a piece with its mask, colors and material."""
        position = primitive["attributes"].get("POSITION")
        index = primitive.get("indices")
        packed = primitive.get("extensions", {}).get(DRACO)
        if position is None:
            return Piece(np.empty((0, 3)), np.empty((0, 3), np.int64))
        if packed and "bufferView" not in self._file.part("accessors", position):
            mesh = decompress_draco(bytes(self._file.view(packed["bufferView"])), self._allowance)
            vertices = np.asarray(mesh.points).reshape(-1, 3)
            faces = np.asarray(mesh.faces, np.int64).reshape(-1, 3)
            return self._materials.with_material(Piece(vertices, faces), primitive, mesh)
        vertices = self._file.accessor(position)
        mode = primitive.get("mode", 4)
        # Reserve memory for the corners and for the triangles of strips and fans.
        count = len(vertices if index is None else self._file.accessor(index))
        self._allowance.reserve((8 if mode == 4 else 24) * count)
        corners = np.arange(count)
        if index is not None:
            corners = self._file.accessor(index)[:, 0].astype(np.int64)
        if mode == 4:
            faces = corners[: len(corners) // 3 * 3].reshape(-1, 3)
        else:
            faces = unroll_strip(corners) if mode == 5 else fan_triangles(corners)
        return self._materials.with_material(Piece(vertices, faces), primitive)


def _matrix(node: dict[str, Any]) -> Floats:
    """Return the local transform of a node.

    The transform is stated as a matrix in column-major order, or as translation, rotation and
    scale.
    """
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
    """Compose transforms from translations, quaternions and scales.

    The inputs have the shapes (k, 3), (k, 4) and (k, 3), and the result has shape (k, 4, 4).
    """
    rows = next((part for part in (translation, rotation, scale) if part is not None), None)
    if rows is None:
        return None
    transforms = np.tile(np.eye(4), (len(rows), 1, 1))
    if rotation is not None:
        unit = rotation / norm(rotation)[:, None]
        transforms[:, :3, :3] = matrices(unit)
    if scale is not None:
        transforms[:, :3, :3] *= scale[:, None]
    if translation is not None:
        transforms[:, :3, 3] = translation
    return transforms

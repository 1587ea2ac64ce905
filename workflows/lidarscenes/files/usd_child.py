"""Script that `usd.py` runs in a separate process to read an OpenUSD scene with usd-core.

Some invalid files crash usd-core, and others need unlimited memory, but this only affects the
separate process. The script imports nothing from lidarpool, so that it starts quickly. It writes
frames to standard output: first the stage, then each mesh, preceded by the images and materials
that it is the first to use, and finally the nodes. Content that several prims share is written
once. For an animation, meshes and nodes are written again for each pose.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
import resource
import signal
import sys
from collections import Counter
from collections.abc import Callable
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pxr import Ar, Gf, Sdf, Tf, Usd, UsdGeom, UsdShade, UsdSkel, UsdUtils

MAX_WAIT_S = 300  # time limit between two meshes; invalid files may never finish

_RIGID = 1e-4  # maximum change of a squared scale
# Maximum deviation of an interpolated motion between poses.
_MAX_OFFSET_M = 1e-5
_MAX_ANGLE_RAD = 1e-4
# Fractions of the time between two poses at which the deviation is measured. They are irregular, so
# that periodic motions are detected.
_PROBES = (0.1459, 0.382, 0.618, 0.8541)
_MAX_HALVINGS = 12  # maximum number of bisections between two samples
_MAX_LINKS = 8  # maximum number of chained shaders that compute texture coordinates

_EXCLUDED_PURPOSES = (UsdGeom.Tokens.proxy, UsdGeom.Tokens.guide)
_SHOWN = (
    Usd.PrimIsActive
    & Usd.PrimIsLoaded
    & Usd.PrimHasDefiningSpecifier  # PrimIsDefined would also require it for all ancestors
    & ~Usd.PrimIsAbstract
)


class StageLimitError(Exception):
    """Raised if the stage has too many prims, copies, or poses."""


class _Inherited(NamedTuple):
    """Properties that enclosing prims set for a node.

    Together with the path of the node, they identify the node.
    """

    excluded: bool  # whether prims with its purpose are skipped
    still: bool  # whether its animation is ignored, as for prims that an instancer copies
    instance: Any  # appearance or path of the enclosing instance, which prototypes lack


class StageNodes:
    """The nodes of a stage, numbered in the order in which they are found.

    If several instances share a node, it is the node in their prototype.
    """

    def __init__(
        self, stage: Any, limits: dict[str, int], looks: MaterialReader, write: Any
    ) -> None:
        self._stage = stage
        self._remaining = limits
        self._looks = looks
        self._write = write
        self._time = looks.time
        self._numbers: dict[tuple[Any, _Inherited], int] = {}  # {(path, inherited): number}
        self._pending: list[tuple[Any, _Inherited]] = []
        self._passes: dict[Any, bool] = {}  # {(prototype, test): whether a prim passes}
        self._meshes: dict[bytes, int] = {}  # {hash of the content: number}
        self.roots: list[int] = []
        self.nodes: list[Any] = []
        self.matrices: list[NDArray[np.float64]] = []
        self.copies: list[NDArray[np.float64]] = []
        self.moving: list[int] = []  # moving nodes that are not children
        # Time codes and the first three rows of the poses, with shape (k, 13).
        self.motions: list[NDArray[np.float64]] = []
        self.counts: Counter[str] = Counter()  # counts for notes

    @property
    def start(self) -> float:
        """Time code at which a survey starts."""
        first_codes = [float(motion[0, 0]) for motion in self.motions]
        time = self._time.GetValue()
        return time if self._stage.HasAuthoredTimeCodeRange() else min(first_codes, default=0.0)

    def read(self) -> None:
        """Collect all nodes of the stage, and write their meshes."""
        # With a rate of 0, usd-core would search for samples forever.
        still = not self._stage.GetTimeCodesPerSecond() > 0
        root = self._number(self._stage.GetPseudoRoot(), _Inherited(False, still, None))
        self.roots.append(root)
        for prim, inherited in self._pending:  # grows during the loop
            self.nodes.append(self._node(prim, inherited))

    def _number(self, prim: Any, inherited: _Inherited) -> int:
        """Return the number of a node. A new node gets the next number."""
        key = _shared(prim).GetPath(), inherited
        if key not in self._numbers:
            self._numbers[key] = len(self._numbers)
            self._pending.append((prim, inherited))
            self._count(1)
        return self._numbers[key]

    def _count(self, count: int, kind: str = "prims and instances") -> None:
        """Count items toward the limit for their kind.

        Raises StageLimitError beyond the limit.
        """
        self._remaining[kind] -= count
        if self._remaining[kind] < 0:
            raise StageLimitError(kind)

    def _node(self, prim: Any, inherited: _Inherited) -> list[Any]:
        """Describe a node by its name, mesh number, child numbers, and copies.

        A copy is (node number, index into `copies`).
        """
        node: list[Any] = [prim.GetName(), None, [], []]
        xformable = UsdGeom.Xformable(prim)
        # Transpose, because OpenUSD uses row vectors.
        matrix = xformable.GetLocalTransformation(self._time) if xformable else np.eye(4)
        self.matrices.append(np.array(matrix).T)
        if imageable := UsdGeom.Imageable(prim):
            if imageable.GetVisibilityAttr().Get(self._time) == UsdGeom.Tokens.invisible:
                self.counts["invisible"] += 1
                return node
            purpose = imageable.GetPurposeAttr()
            if purpose.HasAuthoredValue():
                inherited = inherited._replace(excluded=purpose.Get() in _EXCLUDED_PURPOSES)
        if prim.IsA(UsdGeom.PointInstancer):
            node[3] = self._copies(UsdGeom.PointInstancer(prim), inherited.excluded)
            return node
        if prim.IsA(UsdGeom.Gprim):
            if inherited.excluded:
                self.counts["with the purpose proxy or guide"] += 1
            else:
                node[1] = self._mesh(prim)
        if prim.IsInstance():
            moves = not inherited.still and self._any_below(prim.GetPrototype(), _transform_varies)
            instance = str(prim.GetPath()) if moves else self._looks.inherited_material(prim)
            inherited = inherited._replace(instance=instance)
        for child in prim.GetFilteredChildren(Usd.TraverseInstanceProxies(_SHOWN)):
            self._add_child(node, child, inherited)
        return node

    def _add_child(self, node: list[Any], child: Any, inherited: _Inherited) -> None:
        """Add a child to its parent node, to the roots, or to the moving nodes."""
        xformable = UsdGeom.Xformable(child)
        number = self._number(child, inherited)
        motion = None
        if xformable and xformable.TransformMightBeTimeVarying():
            if not inherited.still:
                motion = self._motion(child)
            elif self._any_below(child, _has_surface):
                self.counts["moving"] += 1
        if motion is not None:
            self._count(1, "moving objects")
            self.moving.append(number)
            self.motions.append(motion)
        elif xformable and xformable.GetResetXformStack():
            self.roots.append(number)
        else:
            node[2].append(number)

    def _any_below(self, prim: Any, test: Callable[[Any], bool]) -> bool:
        """Return whether a prim or any of its descendants passes a test.

        Each prototype is tested once.
        """
        for inner in Usd.PrimRange(_shared(prim)):
            if test(inner):
                return True
            if inner.IsInstance():
                prototype = inner.GetPrototype()
                key = prototype.GetPath(), test
                if key not in self._passes:
                    self._passes[key] = self._any_below(prototype, test)
                if self._passes[key]:
                    return True
        return False

    def _motion(self, prim: Any) -> NDArray[np.float64] | None:
        """Return a prim's time codes and world poses, or None if it does not move.

        Interpolating positions linearly, and rotations about a single axis, deviates from OpenUSD
        by at most `_MAX_OFFSET_M` and `_MAX_ANGLE_RAD`.
        """
        xformable = UsdGeom.Xformable(prim)
        samples = xformable.GetTimeSamples()
        # Also check between samples, because a turntable may have samples only at full revolutions.
        between = [a + _PROBES[0] * (b - a) for a, b in pairwise(samples)]
        matrices = [
            np.array(xformable.GetLocalTransformation(code)) for code in [*samples, *between]
        ]
        has_surface = matrices and self._any_below(prim, _has_surface)
        if not has_surface or np.allclose(matrices, matrices[0]):
            return None
        poses = [_TimedPose(prim, code) for code in _sample_codes(prim)]
        if _is_rigid(poses):
            max_offset = _MAX_OFFSET_M / UsdGeom.GetStageMetersPerUnit(self._stage)
            sampled = [poses[0]]
            for start, stop in pairwise(poses):
                added = _poses_up_to(prim, start, stop, max_offset, _MAX_HALVINGS)
                sampled += added
                self._count(len(added), "poses of moving objects")
            return np.array([[pose.code, *pose.matrix[:3].ravel()] for pose in sampled])
        self.counts["moving"] += 1
        return None

    def _copies(self, instancer: Any, excluded: bool) -> list[tuple[int, int]]:
        """Return (node, k) for each node that an instancer copies. `copies[k]` has its matrices."""
        prototype_numbers = np.array(
            instancer.GetProtoIndicesAttr().Get(self._time) or (), np.int64
        )
        self._count(len(prototype_numbers))
        if instancer.GetPrim().GetAttribute("positions").ValueMightBeTimeVarying():
            self.counts["moving"] += 1
        transforms = instancer.ComputeInstanceTransformsAtTime(
            self._time,
            self._time,
            UsdGeom.PointInstancer.ExcludeProtoXform,
            UsdGeom.PointInstancer.IgnoreMask,
        )
        matrices = np.array(transforms, np.float64).reshape(-1, 4, 4).transpose(0, 2, 1)
        if len(matrices) != len(prototype_numbers):
            raise ValueError(
                f"{instancer.GetPath()} has {len(prototype_numbers)} instances but transforms "
                f"for {len(matrices)}"
            )
        mask = np.array(
            instancer.ComputeMaskAtTime(self._time) or np.ones(len(prototype_numbers)), bool
        )
        nodes = []
        for number, path in enumerate(instancer.GetPrototypesRel().GetForwardedTargets()):
            rows = (prototype_numbers == number) & mask
            prim = self._stage.GetPrimAtPath(path)
            if rows.any() and prim and prim.IsActive():
                copied = self._number(prim, _Inherited(excluded, True, None))
                nodes.append((copied, len(self.copies)))
                self.copies.append(matrices[rows])
        return nodes

    def _mesh(self, prim: Any) -> int | None:
        """Write a prim's triangles unless they are known, and return the number of the mesh."""
        kind = str(prim.GetTypeName())
        arrays: list[Any] = []
        if prim.IsA(UsdGeom.Mesh):
            mesh = UsdGeom.Mesh(prim)
            if mesh.GetSubdivisionSchemeAttr().Get() != UsdGeom.Tokens.none:
                self.counts["subdivided"] += 1
            skinned = prim.GetAttribute("primvars:skel:jointIndices").HasAuthoredValue()
            if skinned and prim.IsInstanceProxy():
                self.counts["skinned"] += 1
            if mesh.GetPointsAttr().ValueMightBeTimeVarying():
                self.counts["moving"] += 1
            arrays = [
                np.array(attribute.Get(self._time) or (), kind)
                for attribute, kind in (
                    (mesh.GetFaceVertexCountsAttr(), np.int32),
                    (mesh.GetFaceVertexIndicesAttr(), np.int32),
                    (mesh.GetPointsAttr(), np.float32),
                    (mesh.GetHoleIndicesAttr(), np.int32),
                )
            ]
            frame: dict[str, Any] = {"what": "mesh"}
        elif kind in _SIZES:
            sizes = {name: prim.GetAttribute(name).Get(self._time) for name in _SIZES[kind]}
            frame = {"what": "shape", "kind": kind, "sizes": sizes}
        else:
            self.counts[kind] += 1
            return None
        frame |= self._looks.mesh_fields(prim, arrays)
        digest = hashlib.blake2b(json.dumps(frame).encode())
        for array in arrays:
            digest.update(b"%d;" % array.size)
            digest.update(array)
        next_number = len(self._meshes)
        number = self._meshes.setdefault(digest.digest(), next_number)
        if number == next_number:
            self._write(frame | {"name": prim.GetName(), "number": number}, *arrays)
        return number


class _TimedPose:
    """A prim's world pose at a time code."""

    def __init__(self, prim: Any, code: float) -> None:
        matrix = UsdGeom.Imageable(prim).ComputeLocalToWorldTransform(code)
        self.code = code
        self.matrix = np.array(matrix).T  # (4, 4), transposed because OpenUSD uses row vectors
        self.rotation = matrix.RemoveScaleShear().ExtractRotationQuat()


def _sample_codes(prim: Any) -> list[float]:
    """Return the time codes of all samples of a prim and its ancestors, in ascending order."""
    codes: set[float] = set()
    above = prim
    while above:
        xformable = UsdGeom.Xformable(above)
        codes.update(xformable.GetTimeSamples() if xformable else ())
        above = None if xformable and xformable.GetResetXformStack() else above.GetParent()
    return sorted(codes)


def _is_rigid(poses: list[_TimedPose]) -> bool:
    """Return whether poses differ only by rotations and translations, not by scales."""
    linear = np.array([pose.matrix[:3, :3] for pose in poses])
    if np.linalg.matrix_rank(linear[0]) < 3:
        return False
    relative = linear @ np.linalg.inv(linear[0])
    deviation = np.abs(relative @ relative.transpose(0, 2, 1) - np.eye(3)).max()
    return bool(deviation < _RIGID and np.linalg.det(relative).min() > 0)


def _poses_up_to(
    prim: Any, start: _TimedPose, stop: _TimedPose, max_offset: float, depth: int
) -> list[_TimedPose]:
    """Return the poses after `start`, up to `stop`, that accurate interpolation requires.

    `max_offset` is the tolerance in units of the stage, and `depth` the number of remaining
    bisections.
    """
    step = stop.code - start.code
    if not depth:
        return [stop]
    for fraction in _PROBES:
        pose = _TimedPose(prim, start.code + fraction * step)
        offset = (
            pose.matrix[:3, 3]
            - (1 - fraction) * start.matrix[:3, 3]
            - fraction * stop.matrix[:3, 3]
        )
        rotation = Gf.Slerp(fraction, start.rotation, stop.rotation)
        cosine = abs(Gf.Dot(rotation, pose.rotation))
        if not (np.abs(offset).max() <= max_offset and cosine >= math.cos(_MAX_ANGLE_RAD / 2)):
            middle = _TimedPose(prim, start.code + step / 2)
            return _poses_up_to(prim, start, middle, max_offset, depth - 1) + _poses_up_to(
                prim, middle, stop, max_offset, depth - 1
            )
    return [stop]


class MaterialReader:
    """Reads the images and materials in a stage, and the colors of meshes.

    An image or a material is written when it is first used.
    """

    def __init__(self, request: dict[str, Any], write: Any) -> None:
        self.time = Usd.TimeCode.Default()
        self._masks = request["masks"]
        self._colors = request["colors"]
        self._write = write
        self._names_materials = request["materials"]
        self._folders = tuple(os.path.join(folder, "") for folder in request["folders"])  # noqa: PTH118
        self._images: dict[str, int] = {}  # {path: number}
        # {path: result of `_material`}
        self._materials: dict[Any, tuple[int | None, list[str]]] = {}
        self._numbers_by_content: dict[str, int] = {}  # {description of a material: number}

    def inherited_material(self, instance: Any) -> Any:
        """Return the material and color that the prims in an instance inherit, or None."""
        if not (self._masks or self._colors or self._names_materials):
            return None
        color = self._values(instance, "displayColor") if self._colors else None
        look = self._bound(instance)[0], color and (color[0], color[1].tobytes())
        return None if look == (None, None) else look

    def mesh_fields(self, prim: Any, arrays: list[Any]) -> dict[str, Any]:
        """Return the frame fields for a mesh's materials and values.

        The values are appended to the arrays of the frame. According to the OpenUSD interpolation,
        they belong to corners, vertices, or polygons, or are constant.
        """
        if not (self._masks or self._colors or self._names_materials):
            return {}
        prim_material, names_read = self._bound(prim)
        materials: list[Any] = [] if prim_material is None else [(prim_material, None)]
        names = {*names_read, *(["displayColor"] if self._colors else [])}
        subsets = UsdShade.MaterialBindingAPI(prim).GetMaterialBindSubsets()
        if not prim.IsA(UsdGeom.Mesh):
            subsets = []
        for subset in subsets:
            number, names_read = self._bound(subset.GetPrim())
            if number != prim_material:
                materials.append((number, len(arrays)))
                names.update(names_read)
                arrays.append(np.array(subset.GetIndicesAttr().Get(self.time) or (), np.int32))
        values = {}
        for name in sorted(names):
            if primvar := self._values(prim, name):
                values[name] = primvar[0], len(arrays)
                arrays.append(primvar[1])
        return {"materials": materials, "values": values} if materials or values else {}

    def _values(self, prim: Any, name: str) -> tuple[str, NDArray[np.float32]] | None:
        """Return a primvar's interpolation and values, or None if it is not set."""
        primvar = UsdGeom.PrimvarsAPI(prim).FindPrimvarWithInheritance(name)
        values = np.array(primvar.ComputeFlattened(self.time) if primvar else None)
        if values.dtype.kind != "f" or values.ndim != 2:
            return None
        return str(primvar.GetInterpolation()), values.astype(np.float32)

    def _bound(self, prim: Any) -> tuple[int | None, list[str]]:
        """Return a prim's material like `_material`, or (None, []) if it has none."""
        binding = UsdShade.MaterialBindingAPI(prim)
        material = binding.ComputeBoundMaterial(UsdShade.Tokens.preview)[0]
        if not material:
            return None, []
        path = _shared(material.GetPrim()).GetPath()
        if path not in self._materials:
            self._materials[path] = self._material(material)
        return self._materials[path]

    def _material(self, material: Any) -> tuple[int | None, list[str]]:
        """Write a new material, and return its number and the primvars that it uses.

        The number is None if the material has none of the requested properties.
        """
        shader, kind = _surface_shader(material)
        properties = self._properties(shader, kind) if shader else {}
        if not properties and not self._names_materials:
            return None, []
        properties["name"] = material.GetPrim().GetName()
        count = len(self._numbers_by_content)
        number = self._numbers_by_content.setdefault(json.dumps(properties), count)
        if number == len(self._numbers_by_content) - 1:
            self._write({"what": "material", "number": number} | properties)
        sources = [properties.get("color", {}), properties.get("opacity", {})]
        return number, [source["values"] for source in sources if "values" in source]

    def _properties(self, shader: Any, kind: str) -> dict[str, Any]:
        """Return those of the properties color, opacity, and threshold that were requested."""
        properties: dict[str, Any] = {}
        if kind not in _SURFACES:
            if self._colors:
                properties["color"] = {"unread": f"its shader {kind[:40]} is not supported"}
        elif kind == "OmniPBR":
            if self._colors:
                properties["color"] = self._omniverse_color(shader)
        else:
            if self._colors:
                name, usual = _SURFACES[kind]
                properties["color"] = self._source(shader.GetInput(name)) or {"value": usual}
            if self._masks and (opacity := self._source(shader.GetInput("opacity"))):
                properties["opacity"] = opacity
                threshold = self._source(shader.GetInput("opacityThreshold")) or {}
                properties["threshold"] = threshold.get("value", 0)
        return properties

    def _omniverse_color(self, shader: Any) -> dict[str, Any]:
        """Return the base color of NVIDIA's OmniPBR shader."""
        inputs = ("diffuse_tint", "diffuse_color_constant", "diffuse_texture")
        tint, plain, image = (_constant(shader.GetInput(name)) for name in inputs)
        tint = tint or (1, 1, 1)
        if isinstance(image, Sdf.AssetPath) and image.path:
            return {
                "image": self._image(image),
                "channels": "rgb",
                "scale": [*tint, 1],
                "wraps": ("repeat", "repeat"),
                "values": "st",
            }
        return {"value": [a * b for a, b in zip(plain or (0.2, 0.2, 0.2), tint, strict=True)]}

    def _source(self, surface_input: Any) -> dict[str, Any] | None:
        """Describe the source of a surface input, or return None if the input is not set."""
        attributes = (
            UsdShade.Utils.GetValueProducingAttributes(surface_input) if surface_input else ()
        )
        if not attributes:
            return None
        value = attributes[0].Get(self.time)
        shader = UsdShade.Shader(attributes[0].GetPrim())
        if UsdShade.Utils.GetType(attributes[0].GetName()) != UsdShade.AttributeType.Output:
            return None if value is None else {"value": _numbers(value)}
        kind = str(shader.GetIdAttr().Get())
        if kind.startswith("UsdPrimvarReader_"):
            return {"values": str(_constant(shader.GetInput("varname")) or "")}
        if kind != "UsdUVTexture":
            return {"unread": f"it is computed by {kind[:40]}, which is not supported"}
        names = ("file", "scale", "bias", "fallback", "sourceColorSpace", "wrapS", "wrapT")
        image, scale, bias, fallback, space, *wraps = (
            _constant(shader.GetInput(name)) for name in names
        )
        source = {
            "image": self._image(image),
            "channels": attributes[0].GetName().partition(":")[2],
            "scale": _numbers(scale or (1, 1, 1, 1)),
            "bias": _numbers(bias or (0, 0, 0, 0)),
            **({"instead": {"value": _numbers(fallback)[:3]}} if fallback else {}),
            "raw": space == "raw",
            "wraps": [wrap if wrap in ("repeat", "clamp", "mirror") else "black" for wrap in wraps],
        }
        return source | self._coordinates(shader.GetInput("st"))

    def _coordinates(self, coordinate_input: Any) -> dict[str, Any]:
        """Return the name of texture coordinates, and the 3 x 2 matrix that transforms them."""
        matrix = np.eye(3)
        for _ in range(_MAX_LINKS):
            attributes = (
                UsdShade.Utils.GetValueProducingAttributes(coordinate_input)
                if coordinate_input
                else ()
            )
            shader = UsdShade.Shader(attributes[0].GetPrim()) if attributes else None
            kind = str(shader.GetIdAttr().Get()) if shader else ""
            if not shader or kind == "UsdPrimvarReader_float2":
                name = str(_constant(shader.GetInput("varname")) or "") if shader else ""
                return {"values": name, "matrix": matrix[:, :2].tolist()}
            if kind != "UsdTransform2d":
                break
            names = ("rotation", "scale", "translation")
            angle_deg, scale, offset = (_constant(shader.GetInput(name)) for name in names)
            c = math.cos(math.radians(angle_deg or 0))
            s = math.sin(math.radians(angle_deg or 0))
            scale_u, scale_v = scale or (1, 1)
            # Scale, rotate counterclockwise, and translate row vectors.
            step = np.array(
                [[scale_u * c, scale_u * s, 0], [-scale_v * s, scale_v * c, 0], [0, 0, 1]]
            )
            step[2, :2] = offset or (0, 0)
            matrix = step @ matrix
            coordinate_input = shader.GetInput("in")
        return {"unread": "its texture coordinates are computed in an unsupported way"}

    def _image(self, asset: Any) -> int:
        """Write an image unless it is known, and return its number."""
        path = getattr(asset, "resolvedPath", "") or getattr(asset, "path", "")
        number = self._images.setdefault(path, len(self._images))
        if number < len(self._images) - 1:
            return number
        outer = os.path.realpath(Ar.SplitPackageRelativePathOuter(path)[0])
        frame = {"what": "image", "number": number, "name": path[-80:], "unread": ""}
        data = b""
        if "<UDIM>" in path:
            frame["unread"] = "is a set of UDIM tiles, which is not supported"
        elif not os.path.isfile(outer):  # noqa: PTH113 - opening a pipe would wait forever
            frame["unread"] = "does not exist"
        elif not outer.startswith(self._folders):
            frame["unread"] = (
                "is outside the scene's folder; set assets to a folder that contains it"
            )
        elif asset := Ar.GetResolver().OpenAsset(Ar.ResolvedPath(path)):
            data = asset.GetBuffer()
        self._write(frame, np.frombuffer(data, np.uint8))
        return number


def _surface_shader(material: Any) -> tuple[Any, str]:
    """Return a material's surface shader and its kind. Supported kinds are preferred."""
    shader = None
    kind = ""
    for context in ("", "mdl", "mtlx"):
        shader = material.ComputeSurfaceSource(context)[0]
        if shader:
            kind = str(shader.GetIdAttr().Get() or shader.GetSourceAssetSubIdentifier("mdl"))
            if kind in _SURFACES:
                break
    return shader, kind


def _constant(shader_input: Any) -> Any:
    """Return the constant value of an input, or None if it has none."""
    attributes = UsdShade.Utils.GetValueProducingAttributes(shader_input) if shader_input else ()
    return attributes[0].Get() if attributes else None


def _numbers(value: Any) -> Any:
    """Convert a number or a vector to Python floats."""
    return [float(number) for number in value] if hasattr(value, "__len__") else float(value)


# {surface shader: (input of its base color, default color)}
_SURFACES = {
    "UsdPreviewSurface": ("diffuseColor", [0.18] * 3),
    "ND_UsdPreviewSurface_surfaceshader": ("diffuseColor", [0.18] * 3),
    "ND_standard_surface_surfaceshader": ("base_color", [0.8] * 3),
    "ND_open_pbr_surface_surfaceshader": ("base_color", [0.8] * 3),
    "OmniPBR": ("", []),
}

_SIZES = {
    "Cube": ("size",),
    "Sphere": ("radius",),
    "Cylinder": ("radius", "height", "axis"),
    "Cone": ("radius", "height", "axis"),
    "Capsule": ("radius", "height", "axis"),
    "Plane": ("width", "length", "axis"),
}


def _shared(prim: Any) -> Any:
    """Return a prim, or its counterpart in the prototype if instances share it."""
    return prim.GetPrimInPrototype() if prim.IsInstanceProxy() else prim


def _transform_varies(prim: Any) -> bool:
    xformable = UsdGeom.Xformable(prim)
    return bool(xformable and xformable.TransformMightBeTimeVarying())


def _has_surface(prim: Any) -> bool:
    return bool(prim.IsA(UsdGeom.Gprim) or prim.IsA(UsdGeom.PointInstancer))


class _Animation(NamedTuple):
    """Animations and moving attributes of a stage, and the time codes of its poses."""

    animations: list[dict[str, str]]  # names of the skeleton animations
    attributes: list[Any]  # moving attributes
    codes: list[float]  # time codes of the poses, only one if no animation is requested


def _select_animation(stage: Any, request: dict[str, Any]) -> _Animation:
    """Bind the requested animation to its skeletons, and return the stage's motion."""
    name = request["animation"]
    rate_hz = stage.GetTimeCodesPerSecond()
    while name is not None and (proxies := [p for p in stage.Traverse() if p.IsInstance()]):
        for prim in proxies:
            prim.SetInstanceable(False)  # usd-core does not skin prims in instances
    prims = [p for p in stage.Traverse() if name is not None or p.IsA(UsdSkel.Animation)]
    # With a rate of 0, usd-core would search for samples forever.
    attributes = [a for prim in prims if rate_hz > 0 for a in prim.GetAuthoredAttributes()]
    moving = [attribute for attribute in attributes if attribute.ValueMightBeTimeVarying()]
    clips = {p.GetName(): p.GetPath() for p in prims if moving and p.IsA(UsdSkel.Animation)}
    for prim in [p for p in prims if name in clips and p.IsA(UsdSkel.Skeleton)]:
        UsdSkel.BindingAPI.Apply(prim).CreateAnimationSourceRel().SetTargets([clips[name]])
    poses = [Usd.TimeCode.EarliestTime().GetValue()]
    codes = [code for attribute in moving for code in attribute.GetTimeSamples()]
    if stage.HasAuthoredTimeCodeRange():
        poses = [stage.GetStartTimeCode()]
        codes = [*poses, stage.GetEndTimeCode()]
    if name is not None and moving:
        count = math.ceil((max(codes) - min(codes)) / rate_hz * request["rate_hz"]) or 1
        poses = np.linspace(min(codes), max(codes), count + 1).tolist()
    animations = [{"name": clip} for clip in clips] or [{}] * bool(moving)
    return _Animation(animations, moving, poses)


def _stage_files(stage: Any) -> list[str]:
    """Return the files from which a stage was read.

    Files inside a .usdz are represented by the .usdz.
    """
    layers = [layer.realPath for layer in stage.GetUsedLayers() if not layer.anonymous]
    return sorted({str(Ar.SplitPackageRelativePathOuter(path)[0]) for path in layers} - {""})


def _missing_files(stage: Any) -> list[str]:
    """Return the names of all referenced files and prims that usd-core cannot read."""
    folder = os.path.dirname(stage.GetRootLayer().realPath) + "/"  # noqa: PTH120
    missing_names = set()
    for error in map(str, stage.GetCompositionErrors()):
        match = re.search(r"@(.*?)@(<.*?>)?", error)
        missing_names.add((match[1] + (match[2] or "") if match else error).replace(folder, ""))
    return sorted(missing_names)


def _reason(error: Exception, path: str) -> str:
    """Return the reason for an error, without C++ names and folders."""
    try:
        text = error.args[0].commentary if isinstance(error, Tf.ErrorException) else str(error)
    except UnicodeDecodeError:
        return "its text is not valid UTF-8"
    text = text.replace(path, os.path.basename(path))  # noqa: PTH119
    return re.sub(r"pxrInternal\w+::", "", text)[:300]


def _checked_layers(path: str) -> list[Any]:
    """Open a layer and its sublayers, after checking that all referenced files are regular.

    Opening a named pipe would wait for a writer. Files that references in other layers name are not
    checked, because only composition determines which of them are opened.

    Raises
    ------
    ValueError
        If a file is a pipe, a socket, or a device.
    """
    layers = [Sdf.Layer.FindOrOpen(path)]
    names = {path}
    for layer in filter(None, layers):
        for name in layer.GetCompositionAssetDependencies():
            full_name = layer.ComputeAbsolutePath(name)
            outer = Ar.SplitPackageRelativePathOuter(full_name)[0]
            is_usual = os.path.isfile(outer) or os.path.isdir(outer)  # noqa: PTH112, PTH113
            if os.path.exists(outer) and not is_usual:  # noqa: PTH110
                raise ValueError(f"it refers to {name[-80:]!r}, which is not a regular file")
            if name in layer.subLayerPaths and full_name not in names:
                names.add(full_name)
                layers.append(Sdf.Layer.FindOrOpen(full_name))
    return layers


def main(path: str, request: dict[str, Any]) -> None:
    """Read a file, and write frames to the standard output."""
    output = os.fdopen(os.dup(1), "wb")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)

    def write(frame: dict[str, Any], *arrays: NDArray[Any]) -> None:
        """Write a frame: a line of JSON, followed by the bytes of its arrays."""
        signal.alarm(0)  # the receiving process may take long
        kinds = [(array.dtype.str, array.shape) for array in arrays]
        output.write(json.dumps(frame | {"arrays": kinds}).encode() + b"\n")
        for array in arrays:
            output.write(np.ascontiguousarray(array).data)
        signal.alarm(MAX_WAIT_S)

    silent = UsdUtils.CoalescingDiagnosticDelegate()
    try:
        layers = _checked_layers(path)
        stage = Usd.Stage.Open(path)
        del layers
        missing = _missing_files(stage)
        animation = _select_animation(stage, request)
        write(
            {
                "what": "stage",
                "files": _stage_files(stage),
                "missing": [name for name in missing if not name.endswith(".mtlx")],
                "materialx": request["colors"] and any(name.endswith(".mtlx") for name in missing),
                "unit_m": UsdGeom.GetStageMetersPerUnit(stage),
                "unit_stated": UsdGeom.StageHasAuthoredMetersPerUnit(stage),
                "up_axis": UsdGeom.GetStageUpAxis(stage).lower(),
                "up_stated": stage.HasAuthoredMetadata("upAxis"),
                "animations": animation.animations,
                "times_s": (np.array(animation.codes) / stage.GetTimeCodesPerSecond()).tolist(),
            }
        )
        looks = MaterialReader(request, write)
        for code in animation.codes:
            stage.GetSessionLayer().Clear()  # forget the previous pose
            stage.SetEditTarget(stage.GetSessionLayer())
            for attribute in animation.attributes:
                attribute.Set(Sdf.ValueBlock() if (value := attribute.Get(code)) is None else value)
            # Skinning is only applied at samples, and to prims that do not move.
            UsdSkel.BakeSkinning(stage.Traverse(), Gf.Interval(code, code))
            looks.time = Usd.TimeCode(code)
            nodes = StageNodes(stage, request["most"].copy(), looks, write)
            nodes.read()
            write(
                {
                    "what": "nodes",
                    "files": _stage_files(stage),  # includes the files of value clips
                    "roots": nodes.roots,
                    "nodes": nodes.nodes,
                    "counts": nodes.counts,
                    "moving": nodes.moving,
                    "start": nodes.start,
                    "rate_hz": stage.GetTimeCodesPerSecond(),
                },
                np.array(nodes.matrices),
                *nodes.motions,
                *nodes.copies,
            )
    except StageLimitError as error:
        write({"what": "too many", "of": str(error)})
    except Exception as error:  # usd-core raises errors of any type
        write({"what": "error", "reason": _reason(error, path)})
    output.flush()
    del silent


if __name__ == "__main__":
    file = sys.argv[1]
    message = json.loads(sys.argv[2])
    signal.alarm(MAX_WAIT_S)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    _, hard_limit = resource.getrlimit(resource.RLIMIT_DATA)
    max_bytes = message["memory"] if hard_limit < 0 else min(message["memory"], hard_limit)
    resource.setrlimit(resource.RLIMIT_DATA, (max_bytes, hard_limit))
    main(file, message)
    os._exit(0)  # exit at once, because deleting a large stage takes long

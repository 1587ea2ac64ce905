"""Reads an OpenUSD scene with usd-core, in a process that `usd.py` starts: a script, not a module.

usd-core ends its process on some broken files, and takes any amount of memory for others; here both
end this process only. It imports nothing of lidarpool, to start fast. Standard output gets frames,
each a line of JSON and the bytes of arrays: first of the stage, then of each mesh, after the images
and materials that it is the first to use, last of the nodes. What several prims hold alike is
written once. Of an animation, meshes and nodes come again for each pose.
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
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pxr import Ar, Gf, Sdf, Tf, Usd, UsdGeom, UsdShade, UsdSkel, UsdUtils

LONGEST_S = 300  # from one mesh to the next; broken files may take for ever

_RIGID = 1e-4  # how much the square of a scale may change
# how far the path of what moves may be off between poses
_MOST_M = 1e-5
_MOST_RAD = 1e-4
_PROBES = (0.1459, 0.382, 0.618, 0.8541)  # shares of the time between two; of no repeating turns
_DEPTH = 12  # times that the time between two samples is halved
_LINKS = 8  # of shaders that compute texture coordinates

_LEFT_OUT = (UsdGeom.Tokens.proxy, UsdGeom.Tokens.guide)  # purposes
_SHOWN = (
    Usd.PrimIsActive
    & Usd.PrimIsLoaded
    & Usd.PrimHasDefiningSpecifier  # PrimIsDefined would ask it of the prims above, too
    & ~Usd.PrimIsAbstract
)


class TooManyError(Exception):
    """There are more prims, copies or poses than are read."""


class StageNodes:
    """Nodes of a stage, numbered in the order in which they are found.

    A key of a node is its path, in a prototype for what instances share; whether its purpose is
    left out; whether it stands although it is animated, as what an instancer copies does; and what
    it has from an instance that it is in, which prototypes know nothing of.
    """

    def __init__(self, stage: Any, most: dict[str, int], looks: Looks, write: Any) -> None:
        self._stage = stage
        self._left = most
        self._looks = looks
        self._write = write
        self._time = looks.time
        self._numbers: dict[tuple[Any, ...], int] = {}  # {key: number}
        self._todo: list[tuple[Any, ...]] = []
        self._known: dict[Any, bool] = {}  # {prototype and test: whether a prim passes}
        self._meshes: dict[bytes, int] = {}  # {hash of the content: number}
        self.roots: list[int] = []
        self.nodes: list[Any] = []
        self.matrices: list[NDArray[np.float64]] = []
        self.copies: list[NDArray[np.float64]] = []
        self.moving: list[int] = []  # nodes that move; they are in no others
        self.motions: list[NDArray[np.float64]] = []  # (k, 13) of each: time code, then 3 rows of 4
        self.counts: Counter[str] = Counter()  # of what notes tell

    @property
    def start(self) -> float:
        """Time code at which the survey begins."""
        begins = [float(motion[0, 0]) for motion in self.motions]
        time = self._time.GetValue()
        return time if self._stage.HasAuthoredTimeCodeRange() else min(begins, default=0.0)

    def read(self) -> None:
        """Find all nodes, and write their meshes."""
        # Where time stands still, usd-core would look for samples for ever.
        still = not self._stage.GetTimeCodesPerSecond() > 0
        self.roots.append(self._number(self._stage.GetPseudoRoot(), False, still, None))
        for key in self._todo:  # grows meanwhile
            self.nodes.append(self._node(*key))

    def _number(self, prim: Any, *inherited: Any) -> int:
        key = _shared(prim).GetPath(), *inherited
        if key not in self._numbers:
            self._numbers[key] = len(self._numbers)
            self._todo.append((prim, *inherited))
            self._count(1)
        return self._numbers[key]

    def _count(self, more: int, what: str = "prims and copies") -> None:
        self._left[what] -= more
        if self._left[what] < 0:
            raise TooManyError(what)

    def _node(self, prim: Any, unwanted: bool, still: bool, instance: Any) -> list[Any]:
        """Name, number of the mesh, numbers of the children, and copies as (child, array)."""
        node: list[Any] = [prim.GetName(), None, [], []]
        place = UsdGeom.Xformable(prim)
        # Of row vectors, in OpenUSD.
        matrix = place.GetLocalTransformation(self._time) if place else np.eye(4)
        self.matrices.append(np.array(matrix).T)
        if imageable := UsdGeom.Imageable(prim):
            if imageable.GetVisibilityAttr().Get(self._time) == UsdGeom.Tokens.invisible:
                self.counts["invisible"] += 1
                return node
            purpose = imageable.GetPurposeAttr()
            if purpose.HasAuthoredValue():
                unwanted = purpose.Get() in _LEFT_OUT
        if prim.IsA(UsdGeom.PointInstancer):
            node[3] = self._copies(UsdGeom.PointInstancer(prim), unwanted)
            return node
        if prim.IsA(UsdGeom.Gprim):
            if unwanted:
                self.counts["of purpose proxy or guide"] += 1
            else:
                node[1] = self._mesh(prim)
        if prim.IsInstance():
            moves = not still and self._any_below(prim.GetPrototype(), _varies)
            instance = str(prim.GetPath()) if moves else self._looks.inherited(prim)
        for child in prim.GetFilteredChildren(Usd.TraverseInstanceProxies(_SHOWN)):
            place = UsdGeom.Xformable(child)
            number = self._number(child, unwanted, still, instance)
            motion = None
            if place and place.TransformMightBeTimeVarying():
                if not still:
                    motion = self._motion(child)
                elif self._any_below(child, _has_surface):
                    self.counts["moving"] += 1
            if motion is not None:
                self._count(1, "moving objects")
                self.moving.append(number)
                self.motions.append(motion)
            else:
                (self.roots if place and place.GetResetXformStack() else node[2]).append(number)
        return node

    def _any_below(self, prim: Any, test: Callable[[Any], bool]) -> bool:
        """Whether a prim, or one below it, passes a test; prototypes are asked once."""
        for one in Usd.PrimRange(_shared(prim)):
            if test(one):
                return True
            if one.IsInstance():
                prototype = one.GetPrototype()
                key = prototype.GetPath(), test
                if key not in self._known:
                    self._known[key] = self._any_below(prototype, test)
                if self._known[key]:
                    return True
        return False

    def _motion(self, prim: Any) -> NDArray[np.float64] | None:
        """Time codes and places in the world, (k, 13), see `motions`; None if it is to stand.

        There are so many that between them a path that is straight, and turns evenly about one
        axis, is as near to OpenUSD's as `_MOST_M` and `_MOST_RAD` say.
        """
        place = UsdGeom.Xformable(prim)
        samples = place.GetTimeSamples()
        # Also between samples, which a turntable may have at whole turns only.
        between = [a + _PROBES[0] * (b - a) for a, b in pairwise(samples)]
        own = [np.array(place.GetLocalTransformation(code)) for code in [*samples, *between]]
        if not own or not self._any_below(prim, _has_surface) or np.allclose(own, own[0]):
            return None
        codes: set[float] = set()
        above = prim
        while above:
            place = UsdGeom.Xformable(above)
            codes.update(place.GetTimeSamples() if place else ())
            above = None if place and place.GetResetXformStack() else above.GetParent()
        rows = [_Row(prim, code) for code in sorted(codes)]
        linear = np.array([row.place[:3, :3] for row in rows])
        if np.linalg.matrix_rank(linear[0]) == 3:
            turns = linear @ np.linalg.inv(linear[0])
            off = np.abs(turns @ turns.transpose(0, 2, 1) - np.eye(3)).max()
            if off < _RIGID and np.linalg.det(turns).min() > 0:
                near = _MOST_M / UsdGeom.GetStageMetersPerUnit(self._stage)
                found = [rows[0]]
                for one, other in pairwise(rows):
                    found += (more := _between(prim, one, other, near, _DEPTH))
                    self._count(len(more), "poses of what moves")
                return np.array([[row.code, *row.place[:3].ravel()] for row in found])
        self.counts["moving"] += 1
        return None

    def _copies(self, instancer: Any, unwanted: bool) -> list[tuple[int, int]]:
        """Nodes that it copies, and the number of the array of the places of each."""
        of = np.array(instancer.GetProtoIndicesAttr().Get(self._time) or (), np.int64)
        self._count(len(of))
        if instancer.GetPrim().GetAttribute("positions").ValueMightBeTimeVarying():
            self.counts["moving"] += 1
        places = instancer.ComputeInstanceTransformsAtTime(
            self._time,
            self._time,
            UsdGeom.PointInstancer.ExcludeProtoXform,
            UsdGeom.PointInstancer.IgnoreMask,
        )
        matrices = np.array(places, np.float64).reshape(-1, 4, 4).transpose(0, 2, 1)
        if len(matrices) != len(of):
            raise ValueError(
                f"{instancer.GetPath()} has {len(of)} copies, and places for {len(matrices)}"
            )
        mask = np.array(instancer.ComputeMaskAtTime(self._time) or np.ones(len(of)), bool)
        found = []
        for number, path in enumerate(instancer.GetPrototypesRel().GetForwardedTargets()):
            rows = (of == number) & mask
            prim = self._stage.GetPrimAtPath(path)
            if rows.any() and prim and prim.IsActive():
                found.append((self._number(prim, unwanted, True, None), len(self.copies)))
                self.copies.append(matrices[rows])
        return found

    def _mesh(self, prim: Any) -> int | None:
        """Write its triangles, if they are not yet; returns their number."""
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
        frame |= self._looks.of(prim, arrays)
        digest = hashlib.blake2b(json.dumps(frame).encode())
        for array in arrays:
            digest.update(b"%d;" % array.size)
            digest.update(array)
        known = len(self._meshes)
        number = self._meshes.setdefault(digest.digest(), known)
        if number == known:
            self._write(frame | {"name": prim.GetName(), "number": number}, *arrays)
        return number


class _Row:
    """Place of a prim in the world at a time code, (4, 4)."""

    def __init__(self, prim: Any, code: float) -> None:
        matrix = UsdGeom.Imageable(prim).ComputeLocalToWorldTransform(code)
        # of row vectors, in OpenUSD
        self.code = code
        self.place = np.array(matrix).T
        self.turn = matrix.RemoveScaleShear().ExtractRotationQuat()


def _between(prim: Any, begin: _Row, end: _Row, near: float, depth: int) -> list[_Row]:
    """Places after one, up to another, see `Scene._motion`."""
    step = end.code - begin.code
    for share in _PROBES if depth else ():
        row = _Row(prim, begin.code + share * step)
        off = row.place[:3, 3] - (1 - share) * begin.place[:3, 3] - share * end.place[:3, 3]
        turn = Gf.Slerp(share, begin.turn, end.turn)
        cosine = abs(Gf.Dot(turn, row.turn))
        if not (np.abs(off).max() <= near and cosine >= math.cos(_MOST_RAD / 2)):
            middle = _Row(prim, begin.code + step / 2)
            return _between(prim, begin, middle, near, depth - 1) + _between(
                prim, middle, end, near, depth - 1
            )
    return [end]


class Looks:
    """Images and materials, written when they are first used; and colours of meshes."""

    def __init__(self, asked: dict[str, Any], write: Any) -> None:
        self.time = Usd.TimeCode.Default()
        self._masks = asked["masks"]
        self._colours = asked["colours"]
        self._write = write
        self._named = asked["materials"]
        self._folders = tuple(os.path.join(folder, "") for folder in asked["folders"])  # noqa: PTH118
        self._images: dict[str, int] = {}  # {path: number}
        self._materials: dict[Any, tuple[int | None, list[str]]] = {}  # {path: see `_material`}
        self._alike: dict[str, int] = {}  # {description of a material: number}

    def inherited(self, instance: Any) -> Any:
        """Return what prims in an instance have from it without an own one; None for nothing."""
        if not (self._masks or self._colours or self._named):
            return None
        colour = self._values(instance, "displayColor") if self._colours else None
        found = self._bound(instance)[0], colour and (colour[0], colour[1].tobytes())
        return None if found == (None, None) else found

    def of(self, prim: Any, arrays: list[Any]) -> dict[str, Any]:
        """Fields of a frame: materials of polygons, and values by name; adds to its arrays.

        Values are at corners, vertices, polygons or one for all, by OpenUSD's interpolation.
        """
        if not (self._masks or self._colours or self._named):
            return {}
        whole, needed = self._bound(prim)
        materials: list[Any] = [] if whole is None else [(whole, None)]
        names = {*needed, *(["displayColor"] if self._colours else [])}
        subsets = UsdShade.MaterialBindingAPI(prim).GetMaterialBindSubsets()
        for subset in subsets if prim.IsA(UsdGeom.Mesh) else ():
            number, needed = self._bound(subset.GetPrim())
            if number != whole:
                materials.append((number, len(arrays)))
                names.update(needed)
                arrays.append(np.array(subset.GetIndicesAttr().Get(self.time) or (), np.int32))
        values = {}
        for name in sorted(names):
            if found := self._values(prim, name):
                values[name] = found[0], len(arrays)
                arrays.append(found[1])
        return {"materials": materials, "values": values} if materials or values else {}

    def _values(self, prim: Any, name: str) -> tuple[str, NDArray[np.float32]] | None:
        """Interpolation and values (k, w) of a primvar; None if there are none."""
        found = UsdGeom.PrimvarsAPI(prim).FindPrimvarWithInheritance(name)
        values = np.array(found.ComputeFlattened(self.time) if found else None)
        if values.dtype.kind != "f" or values.ndim != 2:
            return None
        return str(found.GetInterpolation()), values.astype(np.float32)

    def _bound(self, prim: Any) -> tuple[int | None, list[str]]:
        """Material of a prim, see `_material`."""
        binding = UsdShade.MaterialBindingAPI(prim)
        material = binding.ComputeBoundMaterial(UsdShade.Tokens.preview)[0]
        if not material:
            return None, []
        path = _shared(material.GetPrim()).GetPath()
        if path not in self._materials:
            self._materials[path] = self._material(material)
        return self._materials[path]

    def _material(self, material: Any) -> tuple[int | None, list[str]]:
        """Write a material; its number, None if it says nothing, and names of what it reads."""
        shader = None
        kind = ""
        for context in ("", "mdl", "mtlx"):
            shader = material.ComputeSurfaceSource(context)[0]
            if shader:
                kind = str(shader.GetIdAttr().Get() or shader.GetSourceAssetSubIdentifier("mdl"))
                if kind in _SURFACES:
                    break
        if not shader and not self._named:
            return None, []
        what: dict[str, Any] = {}
        if not shader:
            pass  # it has a name alone
        elif kind not in _SURFACES:
            if self._colours:
                what["colour"] = {"unread": f"its shader is {kind[:40]}"}
        elif kind == "OmniPBR":
            if self._colours:
                what["colour"] = self._of_omniverse(shader)
        else:
            if self._colours:
                name, usual = _SURFACES[kind]
                what["colour"] = self._source(shader.GetInput(name)) or {"value": usual}
            if self._masks and (opacity := self._source(shader.GetInput("opacity"))):
                what["opacity"] = opacity
                threshold = self._source(shader.GetInput("opacityThreshold")) or {}
                what["threshold"] = threshold.get("value", 0)
        if not what and not self._named:
            return None, []
        what["name"] = material.GetPrim().GetName()
        number = self._alike.setdefault(json.dumps(what), len(self._alike))
        if number == len(self._alike) - 1:
            self._write({"what": "material", "number": number} | what)
        sources = [what.get("colour", {}), what.get("opacity", {})]
        return number, [one["values"] for one in sources if "values" in one]

    def _of_omniverse(self, shader: Any) -> dict[str, Any]:
        """Return the base colour of NVIDIA's OmniPBR."""
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

    def _source(self, given: Any) -> dict[str, Any] | None:
        """Where an input of a surface has its value from; None if it is not set."""
        attributes = UsdShade.Utils.GetValueProducingAttributes(given) if given else ()
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
            return {"unread": f"it is computed by {kind[:40]}"}
        names = ("file", "scale", "bias", "fallback", "sourceColorSpace", "wrapS", "wrapT")
        image, scale, bias, fallback, space, *wraps = (
            _constant(shader.GetInput(name)) for name in names
        )
        found = {
            "image": self._image(image),
            "channels": attributes[0].GetName().partition(":")[2],
            "scale": _numbers(scale or (1, 1, 1, 1)),
            "bias": _numbers(bias or (0, 0, 0, 0)),
            **({"instead": {"value": _numbers(fallback)[:3]}} if fallback else {}),
            "raw": space == "raw",
            "wraps": [one if one in ("repeat", "clamp", "mirror") else "black" for one in wraps],
        }
        return found | self._coordinates(shader.GetInput("st"))

    def _coordinates(self, given: Any) -> dict[str, Any]:
        """Name of texture coordinates, and the matrix (3, 2) by which (u, v, 1) is multiplied."""
        matrix = np.eye(3)
        for _ in range(_LINKS):
            attributes = UsdShade.Utils.GetValueProducingAttributes(given) if given else ()
            shader = UsdShade.Shader(attributes[0].GetPrim()) if attributes else None
            kind = str(shader.GetIdAttr().Get()) if shader else ""
            if not shader or kind == "UsdPrimvarReader_float2":
                name = str(_constant(shader.GetInput("varname")) or "") if shader else ""
                return {"values": name, "matrix": matrix[:, :2].tolist()}
            if kind != "UsdTransform2d":
                break
            names = ("rotation", "scale", "translation")
            turn, scale, offset = (_constant(shader.GetInput(name)) for name in names)
            c = math.cos(math.radians(turn or 0))
            s = math.sin(math.radians(turn or 0))
            along, across = scale or (1, 1)
            # Scaled, rotated anticlockwise, moved; of row vectors.
            own = np.array([[along * c, along * s, 0], [-across * s, across * c, 0], [0, 0, 1]])
            own[2, :2] = offset or (0, 0)
            matrix = own @ matrix
            given = shader.GetInput("in")
        return {"unread": "its texture coordinates are computed in a way that is not read"}

    def _image(self, asset: Any) -> int:
        """Write an image; its number."""
        path = getattr(asset, "resolvedPath", "") or getattr(asset, "path", "")
        number = self._images.setdefault(path, len(self._images))
        if number < len(self._images) - 1:
            return number
        outer = os.path.realpath(Ar.SplitPackageRelativePathOuter(path)[0])
        frame = {"what": "image", "number": number, "name": path[-80:], "unread": ""}
        data = b""
        if "<UDIM>" in path:
            frame["unread"] = "is of several tiles"
        elif not os.path.isfile(outer):  # noqa: PTH113 - or a pipe, which would wait for ever
            frame["unread"] = "is not there"
        elif not outer.startswith(self._folders):
            frame["unread"] = "is not in the scene's folder, name one that holds it as assets"
        elif asset := Ar.GetResolver().OpenAsset(Ar.ResolvedPath(path)):
            data = asset.GetBuffer()
        self._write(frame, np.frombuffer(data, np.uint8))
        return number


def _constant(given: Any) -> Any:
    """Value of an input that nothing computes."""
    attributes = UsdShade.Utils.GetValueProducingAttributes(given) if given else ()
    return attributes[0].Get() if attributes else None


def _numbers(value: Any) -> Any:
    return [float(one) for one in value] if hasattr(value, "__len__") else float(value)


# {shader of a surface: (input of its base colour, that where it is not set)}
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
    """Return the prim of a prototype for what instances share."""
    return prim.GetPrimInPrototype() if prim.IsInstanceProxy() else prim


def _varies(prim: Any) -> bool:
    place = UsdGeom.Xformable(prim)
    return bool(place and place.TransformMightBeTimeVarying())


def _has_surface(prim: Any) -> bool:
    return bool(prim.IsA(UsdGeom.Gprim) or prim.IsA(UsdGeom.PointInstancer))


def _played(stage: Any, asked: dict[str, Any]) -> tuple[list[Any], list[Any], list[float]]:
    """Animations, attributes that move, and time codes of poses: one if no animation is asked."""
    name = asked["animation"]
    rate_hz = stage.GetTimeCodesPerSecond()
    while name is not None and (found := [one for one in stage.Traverse() if one.IsInstance()]):
        for prim in found:
            prim.SetInstanceable(False)  # nothing bends what is in them
    prims = [one for one in stage.Traverse() if name is not None or one.IsA(UsdSkel.Animation)]
    # Where time stands still, usd-core would look for samples for ever.
    attributes = [one for prim in prims if rate_hz > 0 for one in prim.GetAuthoredAttributes()]
    moved = [one for one in attributes if one.ValueMightBeTimeVarying()]
    clips = {one.GetName(): one.GetPath() for one in prims if moved and one.IsA(UsdSkel.Animation)}
    for prim in [one for one in prims if name in clips and one.IsA(UsdSkel.Skeleton)]:
        UsdSkel.BindingAPI.Apply(prim).CreateAnimationSourceRel().SetTargets([clips[name]])
    times = [Usd.TimeCode.EarliestTime().GetValue()]
    codes = [code for one in moved for code in one.GetTimeSamples()]
    if stage.HasAuthoredTimeCodeRange():
        times = [stage.GetStartTimeCode()]
        codes = [*times, stage.GetEndTimeCode()]
    if name is not None and moved:
        count = math.ceil((max(codes) - min(codes)) / rate_hz * asked["rate_hz"]) or 1
        times = np.linspace(min(codes), max(codes), count + 1).tolist()
    return [{"name": one} for one in clips] or [{}] * bool(moved), moved, times


def _files(stage: Any) -> list[str]:
    """List files that a stage was read from; those within a .usdz count as this."""
    layers = [layer.realPath for layer in stage.GetUsedLayers() if not layer.anonymous]
    return sorted({str(Ar.SplitPackageRelativePathOuter(path)[0]) for path in layers} - {""})


def _missing(stage: Any) -> list[str]:
    """List what a stage refers to and cannot be found or read."""
    folder = os.path.dirname(stage.GetRootLayer().realPath) + "/"  # noqa: PTH120
    found = set()
    for error in map(str, stage.GetCompositionErrors()):
        named = re.search(r"@(.*?)@(<.*?>)?", error)
        found.add((named[1] + (named[2] or "") if named else error).replace(folder, ""))
    return sorted(found)


def _reason(error: Exception, path: str) -> str:
    """Say what is wrong, without names of C++ and folders."""
    try:
        text = error.args[0].commentary if isinstance(error, Tf.ErrorException) else str(error)
    except UnicodeDecodeError:
        return "its text is garbled"
    text = text.replace(path, os.path.basename(path))  # noqa: PTH119
    return re.sub(r"pxrInternal\w+::", "", text)[:300]


def _checked_layers(path: str) -> list[Any]:
    """Open a layer and its sublayers, and check the kind of every file that they name.

    Opening a pipe waits for a writer. Layers that references of other layers name are not checked:
    of these the composition decides which are opened.

    Raises
    ------
    ValueError
        If a file is a pipe, a socket or a device.
    """
    layers = [Sdf.Layer.FindOrOpen(path)]
    names = {path}
    for layer in filter(None, layers):
        for name in layer.GetCompositionAssetDependencies():
            named = layer.ComputeAbsolutePath(name)
            outer = Ar.SplitPackageRelativePathOuter(named)[0]
            is_usual = os.path.isfile(outer) or os.path.isdir(outer)  # noqa: PTH112, PTH113
            if os.path.exists(outer) and not is_usual:  # noqa: PTH110
                raise ValueError(f"it names {name[-80:]!r}, which is no plain file")
            if name in layer.subLayerPaths and named not in names:
                names.add(named)
                layers.append(Sdf.Layer.FindOrOpen(named))
    return layers


def main(path: str, asked: dict[str, Any]) -> None:
    """Read a file, and write frames."""
    out = os.fdopen(os.dup(1), "wb")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)

    def write(frame: dict[str, Any], *arrays: NDArray[Any]) -> None:
        signal.alarm(0)  # who reads this may take long
        kinds = [(array.dtype.str, array.shape) for array in arrays]
        out.write(json.dumps(frame | {"arrays": kinds}).encode() + b"\n")
        for array in arrays:
            out.write(np.ascontiguousarray(array).data)
        signal.alarm(LONGEST_S)

    silent = UsdUtils.CoalescingDiagnosticDelegate()
    try:
        layers = _checked_layers(path)
        stage = Usd.Stage.Open(path)
        del layers
        missing = _missing(stage)
        animations, moved, times = _played(stage, asked)
        write({
            "what": "stage",
            "files": _files(stage),
            "missing": [name for name in missing if not name.endswith(".mtlx")],
            "materialx": asked["colours"] and any(name.endswith(".mtlx") for name in missing),
            "unit_m": UsdGeom.GetStageMetersPerUnit(stage),
            "unit_stated": UsdGeom.StageHasAuthoredMetersPerUnit(stage),
            "up_axis": UsdGeom.GetStageUpAxis(stage).lower(),
            "up_stated": stage.HasAuthoredMetadata("upAxis"),
            "animations": animations,
            "times_s": (np.array(times) / stage.GetTimeCodesPerSecond()).tolist(),
        })  # fmt: skip
        looks = Looks(asked, write)
        for code in times:
            stage.GetSessionLayer().Clear()  # of the pose before
            stage.SetEditTarget(stage.GetSessionLayer())
            for attribute in moved:
                attribute.Set(Sdf.ValueBlock() if (value := attribute.Get(code)) is None else value)
            # It bends at samples only, or what stands.
            UsdSkel.BakeSkinning(stage.Traverse(), Gf.Interval(code, code))
            looks.time = Usd.TimeCode(code)
            scene = StageNodes(stage, asked["most"].copy(), looks, write)
            scene.read()
            write({
                "what": "nodes",
                "files": _files(stage),  # with those of value clips
                "roots": scene.roots,
                "nodes": scene.nodes,
                "counts": scene.counts,
                "moving": scene.moving,
                "start": scene.start,
                "rate_hz": stage.GetTimeCodesPerSecond(),
            }, np.array(scene.matrices), *scene.motions, *scene.copies)  # fmt: skip
    except TooManyError as error:
        write({"what": "too many", "of": str(error)})
    except Exception as error:  # of any type, as readers of broken files are
        write({"what": "error", "reason": _reason(error, path)})
    out.flush()
    del silent


if __name__ == "__main__":
    file = sys.argv[1]
    wanted = json.loads(sys.argv[2])
    signal.alarm(LONGEST_S)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    _, most_memory = resource.getrlimit(resource.RLIMIT_DATA)
    limit = wanted["memory"] if most_memory < 0 else min(wanted["memory"], most_memory)
    resource.setrlimit(resource.RLIMIT_DATA, (limit, most_memory))
    main(file, wanted)
    os._exit(0)  # at once: taking a large stage down takes long

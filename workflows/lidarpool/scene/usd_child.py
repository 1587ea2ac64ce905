"""Reads an OpenUSD scene with usd-core, in a process that `usd.py` starts: a script, not a module.

usd-core ends its process on some broken files, and takes any amount of memory for others; here both
end this process only. It imports nothing of lidarpool, to start fast. Standard output gets frames,
each a line of JSON and the bytes of arrays: first of the stage, then of each mesh, last of the
nodes. A mesh that several prims hold alike is written once.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import resource
import signal
import sys
from collections import Counter
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pxr import Ar, Gf, Tf, Usd, UsdGeom, UsdSkel, UsdUtils

LONGEST_S = 300  # from one mesh to the next; broken files may take for ever

_LEFT_OUT = (UsdGeom.Tokens.proxy, UsdGeom.Tokens.guide)  # purposes
_SHOWN = (
    Usd.PrimIsActive
    & Usd.PrimIsLoaded
    & Usd.PrimHasDefiningSpecifier  # PrimIsDefined would ask it of the prims above, too
    & ~Usd.PrimIsAbstract
)


class TooManyError(Exception):
    """There are more prims and copies than are read."""


class Scene:
    """Nodes of a stage, numbered in the order in which they are found."""

    def __init__(self, stage: Any, most: int, write: Any) -> None:
        self._stage, self._most, self._write = stage, most, write
        timed = stage.HasAuthoredTimeCodeRange()
        self._time = (
            Usd.TimeCode(stage.GetStartTimeCode()) if timed else Usd.TimeCode.EarliestTime()
        )
        self._numbers: dict[tuple[Any, bool], int] = {}  # {path, whether its purpose is left out}
        self._todo: list[tuple[Any, bool]] = []
        self._meshes: dict[bytes, int] = {}  # {hash of the content: number}
        self.roots = [self._number(stage.GetPseudoRoot(), False)]
        self.nodes: list[Any] = []
        self.matrices: list[NDArray[np.float64]] = []
        self.copies: list[NDArray[np.float64]] = []
        self.counts: Counter[str] = Counter()  # of what notes tell

    def read(self) -> None:
        """Find all nodes, and write their meshes."""
        self._bend()
        for prim, unwanted in self._todo:  # grows meanwhile
            self.nodes.append(self._node(prim, unwanted))

    def _bend(self) -> None:
        """Move the points of skinned meshes to the pose of their skeletons, but in prototypes."""
        everything = self._stage.Traverse()
        if any(prim.IsA(UsdSkel.Root) for prim in everything):
            time = self._time.GetValue()
            self._stage.SetEditTarget(self._stage.GetSessionLayer())
            UsdSkel.BakeSkinning(everything, Gf.Interval(time, time))

    def _number(self, prim: Any, unwanted: bool) -> int:
        key = prim.GetPath(), unwanted
        if key not in self._numbers:
            self._numbers[key] = len(self._numbers)
            self._todo.append((prim, unwanted))
            self._count(1)
        return self._numbers[key]

    def _count(self, more: int) -> None:
        self._most -= more
        if self._most < 0:
            raise TooManyError

    def _node(self, prim: Any, unwanted: bool) -> list[Any]:
        """Name, number of the mesh, numbers of the children, and copies as (child, array)."""
        node: list[Any] = [prim.GetName(), None, [], []]
        self.matrices.append(self._matrix(prim))
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
        # What is below instances of one prim is in the prototype that they share.
        within = prim.GetPrototype() if prim.IsInstance() else prim
        for child in within.GetFilteredChildren(_SHOWN):
            reset = child.IsA(UsdGeom.Xformable) and UsdGeom.Xformable(child).GetResetXformStack()
            (self.roots if reset else node[2]).append(self._number(child, unwanted))
        return node

    def _matrix(self, prim: Any) -> NDArray[np.float64]:
        """Its place in its parent, (4, 4)."""
        if not prim.IsA(UsdGeom.Xformable):
            return np.eye(4)
        place = UsdGeom.Xformable(prim)
        if place.TransformMightBeTimeVarying() and any(map(_has_surface, _below(prim))):
            self.counts["moving"] += 1
        return np.array(place.GetLocalTransformation(self._time)).T  # of row vectors, in OpenUSD

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
                found.append((self._number(prim, unwanted), len(self.copies)))
                self.copies.append(matrices[rows])
        return found

    def _mesh(self, prim: Any) -> int | None:
        """Write its triangles, if they are not yet; returns their number."""
        # Colours would be read here: `displayColor` of UsdGeom.PrimvarsAPI, and materials by
        # UsdShade.MaterialBindingAPI.
        kind = str(prim.GetTypeName())
        arrays: list[Any] = []
        if prim.IsA(UsdGeom.Mesh):
            mesh = UsdGeom.Mesh(prim)
            if mesh.GetSubdivisionSchemeAttr().Get() != UsdGeom.Tokens.none:
                self.counts["subdivided"] += 1
            skinned = prim.GetAttribute("primvars:skel:jointIndices").HasAuthoredValue()
            if skinned and prim.IsInPrototype():
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
        digest = hashlib.blake2b(json.dumps(frame).encode())
        for array in arrays:
            digest.update(b"%d;" % array.size)
            digest.update(array)
        known = len(self._meshes)
        number = self._meshes.setdefault(digest.digest(), known)
        if number == known:
            self._write(frame | {"name": prim.GetName(), "number": number}, *arrays)
        return number


_SIZES = {
    "Cube": ("size",),
    "Sphere": ("radius",),
    "Cylinder": ("radius", "height", "axis"),
    "Cone": ("radius", "height", "axis"),
    "Capsule": ("radius", "height", "axis"),
    "Plane": ("width", "length", "axis"),
}


def _below(prim: Any) -> Any:
    return Usd.PrimRange(prim, Usd.TraverseInstanceProxies())


def _has_surface(prim: Any) -> bool:
    return bool(prim.IsA(UsdGeom.Gprim) or prim.IsA(UsdGeom.PointInstancer))


def _files(stage: Any) -> list[str]:
    """List files that a stage was read from; those within a .usdz count as this."""
    layers = [layer.realPath for layer in stage.GetUsedLayers() if not layer.anonymous]
    return sorted({str(Ar.SplitPackageRelativePathOuter(path)[0]) for path in layers} - {""})


def _missing(stage: Any) -> list[str]:
    """List what a stage refers to and cannot be found or read, but materials of MaterialX."""
    folder = os.path.dirname(stage.GetRootLayer().realPath) + "/"  # noqa: PTH120
    found = set()
    for error in map(str, stage.GetCompositionErrors()):
        named = re.search(r"@(.*?)@(<.*?>)?", error)
        found.add((named[1] + (named[2] or "") if named else error).replace(folder, ""))
    return sorted(name for name in found if not name.endswith(".mtlx"))


def _reason(error: Exception, path: str) -> str:
    """Say what is wrong, without names of C++ and folders."""
    try:
        text = error.args[0].commentary if isinstance(error, Tf.ErrorException) else str(error)
    except UnicodeDecodeError:
        return "its text is garbled"
    text = text.replace(path, os.path.basename(path))  # noqa: PTH119
    return re.sub(r"pxrInternal\w+::", "", text)[:300]


def main(path: str, most: int) -> None:
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
        stage = Usd.Stage.Open(path)
        write({
            "what": "stage",
            "files": _files(stage),
            "missing": _missing(stage),
            "unit_m": UsdGeom.GetStageMetersPerUnit(stage),
            "unit_stated": UsdGeom.StageHasAuthoredMetersPerUnit(stage),
            "up_axis": UsdGeom.GetStageUpAxis(stage).lower(),
            "up_stated": stage.HasAuthoredMetadata("upAxis"),
        })  # fmt: skip
        scene = Scene(stage, most, write)
        scene.read()
        write({
            "what": "nodes",
            "files": _files(stage),  # with those of value clips
            "roots": scene.roots,
            "nodes": scene.nodes,
            "counts": scene.counts,
        }, np.array(scene.matrices), *scene.copies)  # fmt: skip
    except TooManyError:
        write({"what": "too many"})
    except Exception as error:  # of any type, as readers of broken files are
        write({"what": "error", "reason": _reason(error, path)})
    out.flush()
    del silent


if __name__ == "__main__":
    file, most_places, memory = sys.argv[1:]
    signal.alarm(LONGEST_S)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    _, most_memory = resource.getrlimit(resource.RLIMIT_DATA)
    limit = int(memory) if most_memory < 0 else min(int(memory), most_memory)
    resource.setrlimit(resource.RLIMIT_DATA, (limit, most_memory))
    main(file, int(most_places))
    os._exit(0)  # at once: taking a large stage down takes long

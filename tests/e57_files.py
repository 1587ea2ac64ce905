"""E57 files as other programs write them, with any fields, node types, limits and poses."""

from __future__ import annotations

import numpy as np
from pye57 import libe57


def write_scans(path, scans):
    """Write scans, each as the keyword arguments of `_write_scan`."""
    file = libe57.ImageFile(str(path), mode="w")
    root = file.root()
    root.set("formatName", libe57.StringNode(file, "ASTM E57 3D Imaging Data File"))
    root.set("guid", libe57.StringNode(file, "{file}"))
    root.set("versionMajor", libe57.IntegerNode(file, 1))
    root.set("versionMinor", libe57.IntegerNode(file, 0))
    root.set("data3D", libe57.VectorNode(file, True))
    root.set("images2D", libe57.VectorNode(file, True))
    for scan in scans:
        _write_scan(file, **scan)
    file.close()
    return path


def _write_scan(file, fields, *, name="scan", **structures):
    """Write a scan.

    `fields` are {name: (values, type)}: "double", "single", or the bounds of an integer.
    `structures` are further children, nested {name: number}.
    """
    node = _structure(file, structures)
    node.set("guid", libe57.StringNode(file, f"{{{name}}}"))
    node.set("name", libe57.StringNode(file, name))
    prototype = libe57.StructureNode(file)
    buffers = libe57.VectorSourceDestBuffer()
    kept = []  # buffers hold no references
    for field, (values, kind) in fields.items():
        if kind == "double":
            number = libe57.FloatNode(file, 0.0, libe57.E57_DOUBLE)
        elif kind == "single":
            number = libe57.FloatNode(file, 0.0, libe57.E57_SINGLE)
        else:
            number = libe57.IntegerNode(file, kind[0], *kind)
        prototype.set(field, number)
        # libe57 takes int64 by its letter "l" for 32 bits.
        kept.append(np.empty(len(values), np.float64 if isinstance(kind, str) else np.longlong))
        kept[-1][:] = values
        buffers.append(libe57.SourceDestBuffer(file, field, kept[-1], len(values), True, True))
    points = libe57.CompressedVectorNode(file, prototype, libe57.VectorNode(file, True))
    node.set("points", points)
    file.root()["data3D"].append(node)
    writer = points.writer(buffers)
    writer.write(len(kept[0]))
    writer.close()


def _structure(file, children):
    node = libe57.StructureNode(file)
    for name, child in children.items():
        if isinstance(child, dict):
            node.set(name, _structure(file, child))
        elif isinstance(child, float):
            node.set(name, libe57.FloatNode(file, child))
        else:
            node.set(name, libe57.IntegerNode(file, child))
    return node

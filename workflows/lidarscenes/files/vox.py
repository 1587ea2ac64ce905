"""Voxel files of AMAPVox (.vox), which HELIOS++ reads too: leaf area by a grid of voxels."""

from __future__ import annotations

import io
import re
from pathlib import Path

import numpy as np

from lidarsim.base.allowance import Allowance
from lidarsim.base.arrays import Floats
from lidarsim.base.words import plural
from lidarsim.scene.actors import box
from lidarsim.scene.files.scene_graph import Content, MeshFileError, ReadOptions
from lidarsim.scene.scene_mesh import MAX_LEAF_DENSITY, MAX_VOXELS, SceneMesh, Voxels

DENSITY = "PadBVTotal"
_OFF = 2  # voxels by which the corners may contradict the counts; HELIOS++'s own writer makes 1.5
# The box is so much larger on all sides, as a share of a voxel's edge: its sides are not those of
# the ground or of a neighbouring grid, which light would miss.
_MARGIN = 0.02


def read_vox(data: bytes, path: Path, wanted: ReadOptions) -> Content:
    """Read a voxel file: one object, a box around all voxels with leaves.

    The first voxel begins at `min_corner`, and each has the edge `res`, as in HELIOS++. Voxels that
    are not named, or whose density is NaN, have no leaves.
    """
    if data.startswith(b"VOX "):
        raise MeshFileError("is a model of MagicaVoxel: export it as .obj or .ply")
    if not data.lstrip().startswith(b"VOXEL SPACE"):
        raise MeshFileError("is broken, or not of AMAPVox: it does not begin with VOXEL SPACE")
    found = re.search(rb"^[ \t]*i[ \t]+j[ \t]+k[ \t].*$", data, re.MULTILINE)
    if found is None:
        raise MeshFileError("has no row of names that begins with i j k")
    text = data[: found.start()].decode("utf-8", "replace")
    head = {k.lower(): v for k, v in re.findall(r"#[ \t]*([\w-]+)[ \t]*[:=]([^#\n]*)", text)}
    columns = found[0].decode("utf-8", "replace").split()
    rows = data[found.end() :]
    if len(last := rows[rows.rstrip().rfind(b"\n") :].split()) < len(columns):
        raise MeshFileError(f"is cut short: its last row has {len(last)} of {len(columns)} numbers")
    shape, low, size = _grid(head)
    column = _column(columns)
    *where, density = np.loadtxt(io.BytesIO(rows), usecols=(0, 1, 2, column), unpack=True, ndmin=2)
    places = np.stack(where, axis=1)
    _check(places, density, shape)
    unknown = int(np.isnan(density).sum())
    full = density > 0
    if not full.any():
        raise MeshFileError(f"has no voxel whose {columns[column]} is above 0")
    places = places[full].astype(np.int64)
    first = places.min(axis=0)
    stop = places.max(axis=0) + 1
    Allowance(len(data), "take larger voxels, or a part").take(4 * int(np.prod(stop - first)))
    grid = np.zeros(stop - first, np.float32)
    grid[tuple((places - first).T)] = density[full]
    low = low + first * size
    sides = (stop - first) * size
    margin = _MARGIN * size.min()
    shell = box(path.stem, tuple(sides + 2 * margin))
    middle = low + sides * (0.5, 0.5, 0) - (0, 0, margin)
    voxels = Voxels(grid, np.column_stack([np.diag(size), low]))
    mesh = SceneMesh(path.stem, shell.vertices + middle, shell.faces, voxels=voxels)
    notes = []
    if unknown:
        notes.append(f"knows nothing of {plural(unknown, 'voxel')} (NaN), which stay empty")
    angles = head.get("lad_type", "").strip()
    if angles and angles.lower() != "spherical":
        notes.append(f"has densities for {angles} leaves: give its object that leaf_angle")
    return Content([mesh], unit_m=1.0, up_axis="z", notes=notes)


def _grid(head: dict[str, str]) -> tuple[Floats, Floats, Floats]:
    """Return the counts of voxels, where the first begins, and their edges: (3,) each."""

    def three(name: str, times: int = 1) -> Floats:
        try:
            values = np.array([float(word) for word in head[name].split()] * times)[:3]
        except (KeyError, ValueError):
            values = np.full(0, np.nan)
        if values.shape != (3,) or not np.isfinite(values).all():
            raise MeshFileError(f"has no header #{name} with three numbers")
        return values

    low = three("min_corner")
    high = three("max_corner")
    split = three("split")
    if (split != np.floor(split)).any() or (split < 1).any() or (split > MAX_VOXELS).any():
        raise MeshFileError(
            f"has #split {_in_words(split)}; it must be whole numbers of 1 to {MAX_VOXELS:,}"
        )
    size = three("res", 3) if "res" in head else (high - low) / split
    if not (size > 0).all():
        raise MeshFileError("has voxels without a size: #res, or #max_corner, is wrong")
    if not (np.abs((high - low) / size - split) <= _OFF).all():
        raise MeshFileError(
            f"contradicts itself: {_in_words((high - low) / size)} voxels of #res are between its "
            f"corners, and #split is {_in_words(split)}"
        )
    return split, low, size


def _column(columns: list[str]) -> int:
    """Column of plant area density: that of AMAPVox 1, or the one of AMAPVox 2."""
    if DENSITY in columns:
        return columns.index(DENSITY)
    named = [row for row, name in enumerate(columns) if name.lower().startswith("pad")]
    if len(named) != 1:
        raise MeshFileError(
            f"has no column {DENSITY}, nor one other whose name begins with pad: "
            f"{' '.join(columns)[:200]}"
        )
    return named[0]


def _check(where: Floats, density: Floats, shape: Floats) -> None:
    """Refuse rows that are of no voxel or of the same, and densities that cannot be."""
    bad = ~((where == np.floor(where)) & (where >= 0) & (where < shape)).all(axis=1)
    if bad.any():
        raise MeshFileError(
            f"has a voxel {_in_words(where[bad][0])}, but #split is {_in_words(shape)}"
        )
    _, ny, nz = shape
    again = np.diff(np.sort((where[:, 0] * ny + where[:, 1]) * nz + where[:, 2])) == 0
    if again.any():
        raise MeshFileError(f"has {plural(int(again.sum()), 'row')} of voxels that it had before")
    bad = (density < 0) | (density > MAX_LEAF_DENSITY)
    if bad.any():
        raise MeshFileError(
            f"has {density[bad][0]:g} m²/m³ in voxel {_in_words(where[bad][0])}; a density is 0 to "
            f"{MAX_LEAF_DENSITY:g}"
        )


def _in_words(numbers: Floats) -> str:
    return " ".join(f"{number:g}" for number in numbers)

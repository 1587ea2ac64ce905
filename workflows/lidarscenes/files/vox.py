"""Read AMAPVox files (.vox) as grids of leaf area, like HELIOS++."""

from __future__ import annotations

import io
import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lidarsim.errors import CutShortError
from lidarsim.io.allowance import Allowance
from lidarsim.numerics.arrays import Floats, Floats32
from lidarsim.scene.actors import box
from lidarsim.scene.files.scene_graph import Content, MeshFileError, ReadOptions
from lidarsim.scene.files.text_rows import RowReader
from lidarsim.scene.scene_mesh import MAX_LEAF_DENSITY, MAX_VOXELS, SceneMesh, Voxels
from lidarsim.words import plural

DENSITY = "PadBVTotal"
# Tolerated difference, in voxels, between corners and counts. The writer in HELIOS++ causes 1.5.
_MAX_COUNT_ERROR = 2
# The box is enlarged on all sides by this fraction of a voxel's edge length, so that its sides do
# not coincide with the ground or a neighboring grid, where rays could miss them.
_MARGIN = 0.02


def read_vox(data: bytes, path: Path, options: ReadOptions) -> Content:
    """Read a voxel file as one object, which is a box around all voxels with leaves.

    As in HELIOS++, the first voxel starts at `min_corner`, and each voxel has the edge length
    `res`. Voxels that are not listed or whose density is NaN have no leaves.
    """
    if data.startswith(b"VOX "):
        raise MeshFileError(
            "is a MagicaVoxel model, which is not supported. Export it as .obj or .ply"
        )
    if not data.lstrip().startswith(b"VOXEL SPACE"):
        raise MeshFileError("is not an AMAPVox file, because it does not begin with VOXEL SPACE")
    table = _read_table(data)
    unknown = int(np.isnan(table.densities).sum())
    full = table.densities > 0
    if not full.any():
        raise MeshFileError(f"contains no voxel with {table.density_name} above 0")
    indices = table.indices[full].astype(np.int64)
    first = indices.min(axis=0)
    stop = indices.max(axis=0) + 1
    Allowance(len(data), "use larger voxels or a smaller part").reserve(
        4 * int(np.prod(stop - first))
    )
    densities = np.zeros(stop - first, np.float32)
    densities[tuple((indices - first).T)] = table.densities[full]
    grid = table.grid
    mesh = _box_around(path.stem, densities, grid.min_corner + first * grid.edges_m, grid.edges_m)
    notes = []
    if unknown:
        notes.append(
            f"contains {plural(unknown, 'voxel')} without data (NaN). Voxels without data are "
            "treated as empty"
        )
    angles = table.header.get("lad_type", "").strip()
    if angles and angles.lower() != "spherical":
        notes.append(
            f"specifies the leaf angle distribution {angles!r}. Set the same leaf_angle for its "
            "object"
        )
    return Content([mesh], unit_m=1.0, up_axis="z", notes=notes)


class _Grid(NamedTuple):
    """The voxel grid that a file describes."""

    counts: Floats  # (3,) number of voxels along x, y, and z
    min_corner: Floats  # (3,) start of the first voxel in meters
    edges_m: Floats  # (3,) edge lengths of a voxel in meters


class _Table(NamedTuple):
    """The header and the rows of a voxel file."""

    header: dict[str, str]
    grid: _Grid
    density_name: str
    indices: Floats  # (n, 3) indices of the voxels in the grid
    densities: Floats  # (n,) in m²/m³


def _read_table(data: bytes) -> _Table:
    """Read the header and the rows in a voxel file.

    Raises MeshFileError if they are invalid.
    """
    heading = re.search(rb"^[ \t]*i[ \t]+j[ \t]+k[ \t].*$", data, re.MULTILINE)
    if heading is None:
        raise MeshFileError("has no header row that begins with i j k")
    text = data[: heading.start()].decode("utf-8", "replace")
    header = {k.lower(): v for k, v in re.findall(r"#[ \t]*([\w-]+)[ \t]*[:=]([^#\n]*)", text)}
    columns = heading[0].decode("utf-8", "replace").split()
    rows = data[heading.end() :]
    if len(last := rows[rows.rstrip().rfind(b"\n") :].split()) < len(columns):
        raise CutShortError(f"its last row has {len(last)} of {len(columns)} numbers")
    grid = _grid(header)
    column = _density_column(columns)
    first_line = data[: heading.end()].count(b"\n") + 1
    i, j, k, densities = _numbers(rows, columns, (0, 1, 2, column), first_line).T
    indices = np.stack([i, j, k], axis=1)
    _check_rows(indices, densities, grid.counts)
    return _Table(header, grid, columns[column], indices, densities)


def _numbers(text: bytes, columns: list[str], used: tuple[int, ...], first_line: int) -> Floats:
    """Return the numbers in those columns that are used.

    Raises ValueError, with the line number, if a line is invalid.
    """
    try:
        return np.asarray(np.loadtxt(io.BytesIO(text), usecols=used, ndmin=2), np.float64)
    except ValueError:  # read again cell by cell to find the invalid line
        lines = io.TextIOWrapper(io.BytesIO(text), "utf-8", "replace")
        return RowReader(columns, used, used=used).read(lines, first_line)


def _box_around(name: str, densities: Floats32, min_corner: Floats, edges_m: Floats) -> SceneMesh:
    """Return a box around voxels, starting at the given corner in meters."""
    sides_m = np.array(densities.shape) * edges_m
    margin_m = _MARGIN * edges_m.min()
    shell = box(name, tuple(sides_m + 2 * margin_m))
    middle = min_corner + sides_m * (0.5, 0.5, 0) - (0, 0, margin_m)
    voxels = Voxels(densities, np.column_stack([np.diag(edges_m), min_corner]))
    return SceneMesh(name, shell.vertices + middle, shell.faces, voxels=voxels)


def _grid(header: dict[str, str]) -> _Grid:
    """Read the voxel grid from a header.

    Raises MeshFileError if values are missing or invalid.
    """

    def three(name: str, times: int = 1) -> Floats:
        """Return three numbers from the header, or raise MeshFileError."""
        try:
            values = np.array([float(word) for word in header[name].split()] * times)[:3]
        except (KeyError, ValueError):
            values = np.full(0, np.nan)
        if values.shape != (3,) or not np.isfinite(values).all():
            raise MeshFileError(f"has no header line #{name} with three numbers")
        return values

    min_corner = three("min_corner")
    max_corner = three("max_corner")
    split = three("split")
    if (split != np.floor(split)).any() or (split < 1).any() or (split > MAX_VOXELS).any():
        raise MeshFileError(
            f"has #split {_spaced(split)}, but the values must be integers from 1 to {MAX_VOXELS:,}"
        )
    edges_m = three("res", 3) if "res" in header else (max_corner - min_corner) / split
    if not (edges_m > 0).all():
        raise MeshFileError("has voxels without a positive size. Correct #res or #max_corner")
    between = (max_corner - min_corner) / edges_m
    if not (np.abs(between - split) <= _MAX_COUNT_ERROR).all():
        raise MeshFileError(
            f"is inconsistent. Its corners span {_spaced(between)} voxels of #res, but #split is "
            f"{_spaced(split)}"
        )
    return _Grid(split, min_corner, edges_m)


def _density_column(columns: list[str]) -> int:
    """Return the index of the column with the plant area density, for AMAPVox 1 or 2."""
    if DENSITY in columns:
        return columns.index(DENSITY)
    named = [row for row, name in enumerate(columns) if name.lower().startswith("pad")]
    if len(named) != 1:
        raise MeshFileError(
            f"has neither a column {DENSITY} nor exactly one other column whose name begins with "
            f"pad. Its columns are: {' '.join(columns)[:200]}"
        )
    return named[0]


def _check_rows(indices: Floats, density: Floats, shape: Floats) -> None:
    """Raise MeshFileError if voxels are outside the grid, repeated, or have invalid densities."""
    is_bad = ~((indices == np.floor(indices)) & (indices >= 0) & (indices < shape)).all(axis=1)
    if is_bad.any():
        raise MeshFileError(
            f"contains the voxel {_spaced(indices[is_bad][0])}, which is outside the grid with "
            f"#split {_spaced(shape)}"
        )
    _, ny, nz = shape
    repeated = np.diff(np.sort((indices[:, 0] * ny + indices[:, 1]) * nz + indices[:, 2])) == 0
    if repeated.any():
        raise MeshFileError(f"contains {plural(int(repeated.sum()), 'duplicate row')}")
    is_bad = (density < 0) | (density > MAX_LEAF_DENSITY)
    if is_bad.any():
        raise MeshFileError(
            f"has a density of {density[is_bad][0]:g} m²/m³ in voxel "
            f"{_spaced(indices[is_bad][0])}, but densities must be between 0 and "
            f"{MAX_LEAF_DENSITY:g}"
        )


def _spaced(numbers: Floats) -> str:
    return " ".join(f"{number:g}" for number in numbers)

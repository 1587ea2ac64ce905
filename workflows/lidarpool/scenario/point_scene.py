"""Point clouds as scenes: each point becomes a surfel, a small rectangle in the points' plane.

Poisson surfaces (Kazhdan and Hoppe 2013), which Open3D makes, too, were compared by casting: of a
simulated scan of a city they took twenty times as long, needed the side that each point was seen
from, and closed openings, so that a tenth of the ranges were wrong by more than 0.3 m.
"""

from __future__ import annotations

import io
from collections.abc import Callable
from itertools import accumulate
from pathlib import Path
from typing import Any, Literal

import numpy as np

from lidarsim.base.allowance import bytes_of, memory
from lidarsim.base.arrays import Floats
from lidarsim.base.errors import LidarError, explained, prefixed
from lidarsim.base.input_files import check_input, read_input, read_input_text
from lidarsim.base.validation import checked
from lidarsim.base.vocabulary import UNITS_M
from lidarsim.base.words import printable
from lidarsim.scene.files.las import las_units, open_las
from lidarsim.scene.files.mesh_formats import advice_on
from lidarsim.scene.files.meshfile import warn
from lidarsim.scene.files.pcd import checked_pcd
from lidarsim.scene.files.polygon_files import read_ply_points
from lidarsim.scene.scene import Scene
from lidarsim.scene.scene_instances import MAX_COORDINATE_M
from lidarsim.scene.scene_mesh import SceneMesh

from ..base.open3d_module import load_open3d

# Chosen on scans of a city, from 7 to 30 neighbours and 0.7 to 1.4: more of either closes more gaps
# between points, and makes surfels reach farther beyond edges.
_NEIGHBOURS = 12
_EXTENT = 0.85
_MAX_HALF_VOXELS = 3  # that half a surfel is long: distant and stray points have no neighbours
_SAMPLE = 20_000  # points whose neighbours tell the spacing
_NEAREST = 9  # a point itself, and the eight around it on a square grid
_BYTES = 700  # for a point while its surfel is made and written


@checked
def scene_of_points(
    path: str | Path,
    *,
    voxel_m: float | None = None,
    size: float = 1.0,
    unit: Literal[tuple(UNITS_M)] | None = None,  # type: ignore[valid-type]
    tell: Callable[[str], None] = warn,
) -> Scene:
    """Make a scene of a point cloud, for example a scan of a real place.

    A surfel lies where a principal component analysis of the 12 nearest points puts their plane,
    and is about as large as the gaps between the points in both directions.

    Parameters
    ----------
    path
        .ply, .pcd, .xyz (x, y and z are the first numbers of a line), .las or .laz, which need
        laspy. Z-up; .las and .laz in the units of their coordinate system, others in metres.
    voxel_m
        Edge of the cubes in each of which all points become their mean. By default the median
        distance of points to the eighth of their neighbours.
    size
        A factor of the surfels' sides: larger surfels close gaps, and reach farther beyond edges.
    unit
        Unit of x, y and z, in place of metres or of the units that a .las or .laz states.
    tell
        Called with a line on units that were converted; by default this package's logger warns.

    Returns
    -------
    A scene of a single object, named by the file; each surfel is two triangles.

    Raises
    ------
    LidarError
        If the file cannot be read, has fewer than 12 points or a coordinate system without lengths,
        or needs too much memory.
    """
    path = Path(path)
    for name, value in (("voxel_m", voxel_m), ("size", size)):
        if value is not None and not 0 < value < np.inf:
            raise LidarError(f"{name} is {value}; it must be a positive number.")
    return Scene.from_meshes([surfels(path, _read(path, unit, tell), voxel_m, size)])


def surfels(path: Path, points: Floats, voxel_m: float | None, size: float = 1.0) -> SceneMesh:
    """Return the surfels of the points (n, 3) of a file."""
    # Covariances of Open3D lose the digits of points far from zero.
    origin = np.round((points.min(axis=0) + points.max(axis=0)) / 2)
    points = points - origin
    o3d = load_open3d()
    voxel_m = voxel_m or _spacing_m(o3d, points)
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    del points
    if not voxel_m:
        raise LidarError(f"{path} has most of its points in the same places: give voxel_m.")
    try:
        cloud = cloud.voxel_down_sample(voxel_m)
    except RuntimeError as error:
        raise LidarError(
            f"{path} is too wide for voxels of {voxel_m:.3g} m: give a larger voxel_m."
        ) from error
    count = len(cloud.points)
    if count * _BYTES > memory() // 2:
        raise LidarError(
            f"{path} makes {count:,} surfels, which take {bytes_of(count * _BYTES)} of memory, of "
            f"at most {bytes_of(memory() // 2)}: give a larger voxel_m than {voxel_m:.3g}."
        )
    if count < _NEIGHBOURS:
        raise LidarError(
            f"{path} has {count} points in different voxels of {voxel_m:.3g} m, and at least "
            f"{_NEIGHBOURS} are needed: give a smaller voxel_m, or another cloud."
        )
    cloud.estimate_covariances(o3d.geometry.KDTreeSearchParamKNN(_NEIGHBOURS))
    corners = _surfel_corners(
        np.asarray(cloud.points), np.asarray(cloud.covariances), voxel_m, size
    )
    faces = 4 * np.arange(count)[:, None, None] + np.array([[0, 1, 2], [0, 2, 3]])
    return SceneMesh(path.stem, corners.reshape(-1, 3) + origin, faces.reshape(-1, 3))


def _surfel_corners(points: Floats, covariances: Floats, voxel_m: float, size: float) -> Floats:
    """Return the corners (n, 4, 3) of surfels."""
    corners = np.empty((len(points), 4, 3))
    for start in range(0, len(points), 1 << 18):
        block = slice(start, start + (1 << 18))
        variances, axes = np.linalg.eigh(covariances[block])
        halves = size * _EXTENT * np.sqrt(np.maximum(variances[:, 1:], 0))
        halves = np.minimum(halves, _MAX_HALF_VOXELS * voxel_m)
        half_widths, half_lengths = np.moveaxis(axes[:, :, 1:] * halves[:, None], 2, 0)
        for corner, (a, b) in enumerate(((-1, -1), (1, -1), (1, 1), (-1, 1))):
            corners[block, corner] = points[block] + a * half_lengths + b * half_widths
    return corners


def _spacing_m(o3d: Any, points: Floats) -> float:
    """Return the median distance of points to the eighth of their neighbours."""
    tree = o3d.core.nns.NearestNeighborSearch(o3d.core.Tensor(points))
    tree.knn_index()
    sampled = points[:: -(-len(points) // _SAMPLE)]
    _, squares = tree.knn_search(o3d.core.Tensor(np.ascontiguousarray(sampled)), _NEAREST)
    return float(np.sqrt(np.median(squares.numpy()[:, -1])))


def _read(path: Path, unit: str | None, tell: Callable[[str], None]) -> Floats:
    """Return the finite points of a file, (n, 3), metres."""
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        if advice := advice_on(path):
            raise LidarError(f"{path} is not read: {advice}.")
        raise LidarError(
            f"{path} has the ending {path.suffix or '(none)'}; point clouds are read from "
            f"{' '.join(SUFFIXES)}."
        )
    try:
        with explained(f"{path} cannot be read"), prefixed(path):
            check_input(path)
            metres = _unit_lengths_m(path, unit, tell)
            points = _READERS[suffix](path) * metres
    except LidarError:
        raise
    except Exception as error:  # readers raise whatever they stumble over
        reason = printable(str(error))[:200] or type(error).__name__
        raise LidarError(f"{path} is broken or cut short ({reason}).") from error
    # Depth cameras write NaN for pixels without a return.
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) < _NEIGHBOURS:
        raise LidarError(
            f"{path} has {len(points)} points, and at least {_NEIGHBOURS} are needed: it is empty, "
            "cut short, or no point cloud."
        )
    if (reach := np.abs(points).max()) > MAX_COORDINATE_M:
        raise LidarError(
            f"{path} reaches {reach:.3g} m from zero, farther than anything on Earth: it is "
            "broken, or in another unit (--unit, in Python unit=)."
        )
    return points


def _unit_lengths_m(path: Path, unit: str | None, tell: Callable[[str], None]) -> Floats:
    """Return the metres in the units of x, y and z of a file, (3,)."""
    if unit is not None:
        return np.full(3, UNITS_M[unit])
    units = las_units(path) if path.suffix.lower() in (".las", ".laz") else None
    if units is None:
        return np.ones(3)
    if note := units.note():
        tell(f"{path} {note}")
    return np.array(units.factors)


def _read_pcd(path: Path) -> Floats:
    """Read points of a .pcd; Open3D reads all encodings but text.

    Open3D returns uninitialised memory as points for truncated text.
    """
    header = checked_pcd(path)
    count = int(header["POINTS"][0])
    if header["DATA"][0] == "ascii":
        repeats = map(int, header.get("COUNT", ["1"] * len(header["FIELDS"])))
        starts = dict(zip(header["FIELDS"], accumulate(repeats, initial=0), strict=False))
        columns = [starts[axis] for axis in "xyz"]
        _, _, rows = read_input(path).partition(b"\nDATA ascii")
        points = np.loadtxt(io.BytesIO(rows), usecols=columns, skiprows=1, ndmin=2)
    else:
        o3d = load_open3d()
        with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
            points = np.array(o3d.io.read_point_cloud(str(path), remove_nan_points=False).points)
    if len(points) != count:
        raise ValueError(f"{count:,} points announced, and {len(points):,} are there")
    return points


def _read_xyz(path: Path) -> Floats:
    """Read the first three numbers of each line."""
    return np.loadtxt(io.StringIO(read_input_text(path)), usecols=(0, 1, 2), ndmin=2)


def _read_las(path: Path) -> Floats:
    """Read the points of a .las or .laz; LidarError if they exceed the memory."""
    with open_las(path) as reader:
        if (size := reader.header.point_count * _BYTES) > memory():
            raise LidarError(
                f"it has {reader.header.point_count:,} points, which take {bytes_of(size)} of "
                "memory: thin it first."
            )
        points = reader.read_points(-1)
    return np.stack([points.x, points.y, points.z], axis=1)


_READERS: dict[str, Callable[[Path], Floats]] = {
    ".ply": lambda path: read_ply_points(read_input(path)),
    ".pcd": _read_pcd,
    ".xyz": _read_xyz,
    ".las": _read_las,
    ".laz": _read_las,
}
SUFFIXES = tuple(_READERS)

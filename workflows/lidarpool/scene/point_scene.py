"""Point clouds as scenes: each point becomes a surfel, a small rectangle in the points' plane.

Poisson surfaces (Kazhdan and Hoppe 2013), which Open3D makes, too, were compared by casting: of a
simulated scan of a city they took twenty times as long, needed the side that each point was seen
from, and closed what is open, so that a tenth of the ranges were wrong by more than 0.3 m.
"""

from __future__ import annotations

import io
import struct
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from ..base.allowance import bytes_of, check_fits, memory
from ..base.arrays import Floats
from ..base.errors import LidarpoolError, explained, prefixed
from ..base.open3d_module import load_open3d
from ..base.validation import checked
from ..base.words import printable
from .files.polygon_files import read_ply_points
from .scene import Scene
from .scene_instances import FARTHEST_M
from .scene_mesh import SceneMesh

# Chosen on scans of a city, from 7 to 30 neighbours and 0.7 to 1.4: more of either closes more gaps
# between points, and makes surfels reach farther beyond edges.
_NEIGHBOURS, _EXTENT = 12, 0.85
_MOST_VOXELS = 3  # that half a surfel is long: distant and stray points have no neighbours
_SAMPLE = 20_000  # points whose neighbours tell the spacing
_NEAREST = 9  # a point itself, and the eight around it on a square grid
_RECORD = 54  # least bytes of a variable-length record of .las, all before the first point
_BYTES = 700  # for a point while its surfel is made and written


@checked
def scene_of_points(path: str | Path, *, voxel_m: float | None = None, size: float = 1.0) -> Scene:
    """Make a scene of a point cloud, for example a scan of a real place.

    A surfel lies where a principal component analysis of the 12 nearest points puts their plane,
    and is about as large as the gaps between them along and across.

    Parameters
    ----------
    path
        .ply, .pcd, .xyz (x, y and z are the first numbers of a line), .las or .laz, which need
        laspy. In metres, Z-up.
    voxel_m
        Edge of the cubes in each of which all points become their mean. By default the median
        distance of points to the eighth of their neighbours.
    size
        A factor of the surfels' sides: larger ones close gaps, and reach farther beyond edges.

    Returns
    -------
    A scene of one object, named by the file; each surfel is two triangles.

    Raises
    ------
    LidarpoolError
        If the file cannot be read, has fewer than 12 points, or needs too much memory.
    """
    path = Path(path)
    for name, value in (("voxel_m", voxel_m), ("size", size)):
        if value is not None and not 0 < value < np.inf:
            raise LidarpoolError(f"{name} is {value}; it must be a positive number.")
    return Scene.from_meshes([surfels(path, _read(path), voxel_m, size)])


def surfels(path: Path, points: Floats, voxel_m: float | None, size: float = 1.0) -> SceneMesh:
    """Return the surfels of the points (n, 3) of a file, as `scene_of_points` makes them."""
    # Open3D's covariances lose the digits of points far from zero.
    origin = np.round((points.min(axis=0) + points.max(axis=0)) / 2)
    points = points - origin
    o3d = load_open3d()
    voxel_m = voxel_m or _spacing(o3d, points)
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    del points
    if not voxel_m:
        raise LidarpoolError(f"{path} has most of its points in the same places: give voxel_m.")
    try:
        cloud = cloud.voxel_down_sample(voxel_m)
    except RuntimeError as error:
        raise LidarpoolError(
            f"{path} is too wide for voxels of {voxel_m:.3g} m: give a larger voxel_m."
        ) from error
    count = len(cloud.points)
    if count * _BYTES > memory() // 2:
        raise LidarpoolError(
            f"{path} makes {count:,} surfels, which take {bytes_of(count * _BYTES)} of memory, of "
            f"at most {bytes_of(memory() // 2)}: give a larger voxel_m than {voxel_m:.3g}."
        )
    if count < _NEIGHBOURS:
        raise LidarpoolError(
            f"{path} has {count} points in different voxels of {voxel_m:.3g} m, and at least "
            f"{_NEIGHBOURS} are needed: give a smaller voxel_m, or another cloud."
        )
    cloud.estimate_covariances(o3d.geometry.KDTreeSearchParamKNN(_NEIGHBOURS))
    corners = _corners(np.asarray(cloud.points), np.asarray(cloud.covariances), voxel_m, size)
    faces = 4 * np.arange(count)[:, None, None] + np.array([[0, 1, 2], [0, 2, 3]])
    return SceneMesh(path.stem, corners.reshape(-1, 3) + origin, faces.reshape(-1, 3))


def _corners(points: Floats, covariances: Floats, voxel_m: float, size: float) -> Floats:
    """Corners (n, 4, 3) of surfels."""
    out = np.empty((len(points), 4, 3))
    for begin in range(0, len(points), 1 << 18):
        some = slice(begin, begin + (1 << 18))
        variances, axes = np.linalg.eigh(covariances[some])
        halves = size * _EXTENT * np.sqrt(np.maximum(variances[:, 1:], 0))
        halves = np.minimum(halves, _MOST_VOXELS * voxel_m)
        across, along = np.moveaxis(axes[:, :, 1:] * halves[:, None], 2, 0)
        for corner, (a, b) in enumerate(((-1, -1), (1, -1), (1, 1), (-1, 1))):
            out[some, corner] = points[some] + a * along + b * across
    return out


def _spacing(o3d: Any, points: Floats) -> float:
    """Median distance of points to the eighth of their neighbours."""
    tree = o3d.core.nns.NearestNeighborSearch(o3d.core.Tensor(points))
    tree.knn_index()
    some = points[:: -(-len(points) // _SAMPLE)]
    _, squares = tree.knn_search(o3d.core.Tensor(np.ascontiguousarray(some)), _NEAREST)
    return float(np.sqrt(np.median(squares.numpy()[:, -1])))


def _read(path: Path) -> Floats:
    """Finite points (n, 3) of a file."""
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise LidarpoolError(
            f"{path} has the ending {path.suffix or '(none)'}; point clouds are read from "
            f"{' '.join(SUFFIXES)}."
        )
    try:
        with explained(f"{path} cannot be read"), prefixed(path):
            check_fits(path)
            points = _READERS[suffix](path)
    except LidarpoolError:
        raise
    except Exception as error:  # readers raise whatever they stumble over
        reason = printable(str(error))[:200] or type(error).__name__
        raise LidarpoolError(f"{path} is broken or cut short ({reason}).") from error
    points = points[np.isfinite(points).all(axis=1)]  # depth cameras write NaN where nothing is
    if len(points) < _NEIGHBOURS:
        raise LidarpoolError(
            f"{path} has {len(points)} points, and at least {_NEIGHBOURS} are needed: it is empty, "
            "cut short, or no point cloud."
        )
    if (reach := np.abs(points).max()) > FARTHEST_M:
        raise LidarpoolError(
            f"{path} reaches {reach:.3g} m from zero, farther than anything on Earth: it is "
            "broken, or not in metres."
        )
    return points


def _read_pcd(path: Path) -> Floats:
    """Read text here, the other kinds by Open3D.

    Of truncated text, Open3D returns uninitialised memory as points.
    """
    head, _, rest = path.read_bytes().partition(b"\nDATA ")
    lines = {words[0]: words[1:] for words in map(str.split, head.decode("latin-1").splitlines())
             if words}  # fmt: skip
    count = int(lines["POINTS"][0])
    if not 0 <= count <= len(rest):
        raise ValueError(f"{count:,} points announced, but there are fewer")
    if rest.startswith(b"ascii"):
        columns = [lines["FIELDS"].index(axis) for axis in "xyz"]
        points = np.loadtxt(io.BytesIO(rest), usecols=columns, skiprows=1, ndmin=2)
    else:
        o3d = load_open3d()
        with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
            points = np.array(o3d.io.read_point_cloud(str(path), remove_nan_points=False).points)
    if len(points) != count:
        raise ValueError(f"{count:,} points announced, and {len(points):,} are there")
    return points


def _read_las(path: Path) -> Floats:
    if find_spec("laspy") is None:
        raise LidarpoolError('it is read by laspy: pip install "lidarpool[las]"')
    import laspy  # an extra

    with path.open("rb") as start:
        first, records = struct.unpack("<II", start.read(104)[96:])
    if _RECORD * records > first:  # laspy would go through four thousand million of them
        raise ValueError("its header is wrong")
    with laspy.open(path, read_evlrs=False) as file:
        if (size := file.header.point_count * _BYTES) > memory():
            raise LidarpoolError(
                f"it has {file.header.point_count:,} points, which take {bytes_of(size)} of "
                "memory: thin it first."
            )
        found = file.read_points(-1)
    return np.stack([found.x, found.y, found.z], axis=1)


_READERS: dict[str, Callable[[Path], Floats]] = {
    ".ply": lambda path: read_ply_points(path.read_bytes()),
    ".pcd": _read_pcd,
    ".xyz": lambda path: np.loadtxt(path, usecols=(0, 1, 2), ndmin=2),
    ".las": _read_las,
    ".laz": _read_las,
}
SUFFIXES = tuple(_READERS)

"""Convert point clouds to scenes of surfels.

A surfel is a small rectangle in the plane of neighboring points. Poisson surface reconstruction
(Kazhdan and Hoppe 2013), which Open3D also provides, was tested as an alternative on a simulated
scan of a city. It took twenty times as long and required the side from which each point was seen.
It also closed openings, so a tenth of the simulated ranges were wrong by more than 0.3 m.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from lidarfiles.open3d_access.open3d_module import load_open3d
from lidarsim.columns.column_names import COLORS, NORMALS, ORIGINS
from lidarsim.columns.sweep import Sweep
from lidarsim.errors import LidarError
from lidarsim.io.allowance import bytes_of, memory
from lidarsim.numerics.arrays import AnyArray, Bools, Bytes, Floats, Ints
from lidarsim.scene.colors import GRAY, LINEAR, Colors, as_srgb
from lidarsim.scene.face_materials import FaceMaterials
from lidarsim.scene.files.meshfile import warn
from lidarsim.scene.scene import Scene
from lidarsim.scene.scene_mesh import SceneMesh
from lidarsim.schema.checks import check_choice
from lidarsim.schema.vocabulary import UNITS_M
from lidarsim.words import format_rounded, plural

from .point_files import MIN_POINTS, NO_CLASS, POINT_BYTES, read_points, vectors
from .surfel_gaps import expected_loss

# These values were chosen on scans of a city, from 7 to 30 neighbors and extents of 0.7 to 1.4.
# Larger values close more gaps between points, but surfels also extend farther beyond edges.
_NEIGHBORS = MIN_POINTS
_EXTENT = 0.85
# Maximum half length of a surfel in voxels, for distant and stray points without close neighbors.
_MAX_HALF_VOXELS = 3
_SAMPLE = 20_000  # number of points from which the spacing is estimated
_NEAREST = 9  # a point and its eight neighbors on a square grid
_BLOCK_VOXELS = 1 << 17  # voxels whose points are averaged together
_MAX_VOXELS = 1 << 62  # voxels are numbered with 64-bit integers
CLASS_MATERIAL = "class "  # followed by the class number in the material names of surfels
_GRAY = "have the mean color of their neighbors, or are gray"  # used in notes
_MIN_NOTED_LOSS = 0.02  # minimum share of lost returns that is reported in a note
# docs/how-to/point-clouds.md describes these scans.
_MEASURED_LOSS = "4 to 40 % in scenes from one to three scans of a city"
_WHITE_QUANTILE = 0.99  # quantile of the intensities that is white, because mirrors return more


def scene_from_points(
    path: str | Path,
    *,
    voxel_m: float | None = None,
    size: float = 1.0,
    unit: str | None = None,
    epsg: int | None = None,
    keep_noise: bool = False,
    color: Literal["rgb", "intensity"] | None = None,
    report: Callable[[str], None] = warn,
) -> Scene:
    """Convert a point cloud, such as a scan of a real site, to a scene of surfels.

    Each surfel is fitted to the 12 nearest points by principal component analysis, and is about as
    large as the gaps between the points in both directions. If the file contains scanner positions,
    the front of a surfel faces the scanner. Otherwise, it faces the direction of the normals in the
    file, if there are any.

    A surfel has the mean color of its points. The name of its material is the most frequent class
    of its points, such as "class 2".

    Parameters
    ----------
    path
        Point cloud file. Supported formats are .ply, .pcd, text (.xyz, .txt, .asc, .csv), .pts,
        .ptx, .npy, .bin of KITTI or nuScenes, .las and .laz (require laspy), .e57 (requires pye57)
        and .parquet (requires pyarrow). If the file contains several scans, their poses are used to
        merge them. The z axis points up. Coordinates in .las and .laz files have the units of their
        coordinate system, and coordinates in text files have the units in their header. All other
        files are in meters.
    voxel_m
        Edge length of voxels in meters. The points in a voxel are replaced by their mean. By
        default, the edge length is the median distance between a point and its eighth neighbor.
    size
        Scale factor for the surfels. Larger surfels close more gaps, but also extend farther beyond
        edges.
    unit
        Unit of x, y and z, which overrides the unit that the file states.
    epsg
        EPSG code of a projected coordinate system that preserves lengths in meters, such as a UTM
        zone. Points are transformed to this system from the system that the file states, which
        requires rasterio. Heights are only converted to meters. By default, coordinates are not
        transformed.
    keep_noise
        Whether to include points that the file withholds or classifies as noise (class 7, and also
        class 18 in LAS point formats 6 to 10).
    color
        Source of the surfel colors: "rgb" for red, green and blue, or "intensity" for gray levels
        from the mean intensities, where the 99th percentile is white. By default, red, green and
        blue are used if the file contains them.
    report
        Function that is called with notes on converted units, skipped points and discarded data. By
        default, the notes are logged as warnings.

    Returns
    -------
    Scene
        Scene with a single object, which is named after the file. Each surfel consists of two
        triangles.

    Raises
    ------
    LidarError
        If the file cannot be read, has fewer than 12 points, lacks the quantity in `color`, cannot
        be transformed to `epsg`, or requires too much memory, or if its coordinate system has no
        lengths or distorts them, as Web Mercator does.
    """
    if unit is not None:
        check_choice("unit", unit, UNITS_M)
    if color is not None:
        check_choice("color", color, ("rgb", "intensity"))
    return points_to_scene(
        Path(path),
        voxel_m=voxel_m,
        size=size,
        unit=unit,
        epsg=epsg,
        keep_noise=keep_noise,
        color=color,
        report=report,
    ).scene


class PointScene(NamedTuple):
    """Scene that was created from a point cloud.

    Attributes
    ----------
    scene
        The scene, with the coordinate system of the cloud.
    voxel_m
        Edge length of the voxels in meters.
    loss
        Share of returns that are expected to be lost in gaps between points (see `expected_loss`),
        or None if it cannot be estimated.
    """

    scene: Scene
    voxel_m: float
    loss: float | None

    @property
    def gap_note(self) -> str:
        """Note about returns that are lost in gaps between points, or an empty string."""
        larger_m = format_rounded(2 * self.voxel_m, 2)
        advice = f"To close gaps, increase `--voxel-m` (`voxel_m` in Python), such as to {larger_m}"
        if self.loss is None:
            return (
                "returns are lost in gaps between points. Their share cannot be estimated, "
                "because the scanner positions are unknown. In measurements, it was "
                f"{_MEASURED_LOSS}. {advice}"
            )
        if self.loss < _MIN_NOTED_LOSS:
            return ""
        return (
            f"scans from the same positions would lose about {self.loss:.0%} of the returns in "
            f"gaps between points, such as those between rings. {advice}"
        )


def points_to_scene(
    path: Path,
    *,
    voxel_m: float | None,
    size: float,
    unit: str | None,
    epsg: int | None,
    keep_noise: bool,
    color: str | None,
    report: Callable[[str], None],
) -> PointScene:
    """Convert a point cloud to a scene, and estimate the fraction of lost returns.

    The parameters are those of `scene_from_points`.
    """
    for name, value in (("voxel_m", voxel_m), ("size", size)):
        if value is not None and not 0 < value < np.inf:
            raise LidarError(f"{name} must be a positive number, but is {value}.")
    placed = read_points(path, unit, report, epsg=epsg, keep_noise=keep_noise)
    points = _select_color(path, placed.points, color, report)
    surfels = _compute_surfels(path, points, voxel_m, size)
    loss = None
    if (scanners := vectors(points, ORIGINS)) is not None:
        corners = surfels.mesh.vertices.reshape(-1, 4, 3)
        loss = expected_loss(points.points, scanners, corners)
    scene = replace(
        Scene.from_meshes([surfels.mesh]), epsg=placed.epsg, vertical_datum=placed.vertical_datum
    )
    return PointScene(scene, surfels.voxel_m, loss)


def surfel_mesh(path: Path, points: Floats, voxel_m: float | None, size: float = 1.0) -> SceneMesh:
    """Create a mesh of surfels from points.

    `path` is the file of the points, which is used for the name of the mesh and in messages.
    `points` has shape (n, 3).
    """
    return _compute_surfels(path, Sweep(points), voxel_m, size).mesh


class _Surfels(NamedTuple):
    mesh: SceneMesh
    voxel_m: float  # edge length of the voxels


def _select_color(
    path: Path, points: Sweep, color: str | None, report: Callable[[str], None]
) -> Sweep:
    """Remove either the colors or the intensities from points that have both.

    Raise LidarError if the selected quantity is missing.
    """
    columns = dict(points.columns)
    present = {"rgb": "red" in columns, "intensity": "intensity" in columns}
    if color is not None and not present[color]:
        quantity = "colors" if color == "rgb" else "intensities"
        raise LidarError(f"`color` cannot be {color!r}, because {path} has no {quantity}.")
    if points.classes is not None:
        _note_unknown(path, "class", points.classes == NO_CLASS, "have no material", report)
    if not any(present.values()):
        return points
    color = color or next(name for name, is_present in present.items() if is_present)
    if all(present.values()):
        other, choice = ("intensities", "intensity") if color == "rgb" else ("colors", "rgb")
        report(
            f"the {other} of {path} are not stored, because a surfel has a single color. To use "
            f"them, set `color` to {choice}"
        )
    if color == "rgb":
        _note_unknown(path, "color", np.isnan(columns["red"]), _GRAY, report)
        columns.pop("intensity", None)
    else:
        _note_unknown(path, "intensity", np.isnan(columns["intensity"]), _GRAY, report)
        columns = {name: values for name, values in columns.items() if name not in COLORS}
    return points.replace(columns=columns)


def _note_unknown(
    path: Path, quantity: str, unknown: Bools, outcome: str, report: Callable[[str], None]
) -> None:
    """Notify the user if some points lack a quantity.

    The mask `unknown` has shape (n,).
    """
    if count := int(unknown.sum()):
        report(
            f"{path}: {count:,} of {plural(len(unknown), 'point')} have no {quantity}. Surfels of "
            f"such points {outcome}."
        )


def _compute_surfels(path: Path, points: Sweep, voxel_m: float | None, size: float) -> _Surfels:
    """Compute the surfels of the points in a file, with their colors and classes."""
    # Points are centered, because Open3D loses precision in covariances far from the origin.
    positions = points.points
    origin = np.round((positions.min(axis=0) + positions.max(axis=0)) / 2)
    positions = positions - origin
    o3d = load_open3d()
    voxel_m = voxel_m or _spacing_m(o3d, positions)
    if not voxel_m:
        raise LidarError(f"Most points of {path} have the same positions. Set `voxel_m`.")
    voxels = PointVoxels.from_points(path, positions, voxel_m)
    count = len(voxels.counts)
    if count * POINT_BYTES > memory() // 2:
        raise LidarError(
            f"{path} would result in {count:,} surfels, which require "
            f"{bytes_of(count * POINT_BYTES)} of memory, but the limit is "
            f"{bytes_of(memory() // 2)}. Increase `voxel_m`, which is {voxel_m:.3g}."
        )
    if count < _NEIGHBORS:
        raise LidarError(
            f"The points of {path} occupy only {plural(count, 'voxel')} of {voxel_m:.3g} m, but "
            f"at least {_NEIGHBORS} are required. Reduce `voxel_m`, or use a different cloud."
        )
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(voxels.means(positions)))
    cloud.estimate_covariances(o3d.geometry.KDTreeSearchParamKNN(_NEIGHBORS))
    outward = _outward(points)
    outward = None if outward is None else voxels.means(_normalize(outward))
    corners = _surfel_corners(
        np.asarray(cloud.points), np.asarray(cloud.covariances), voxel_m, size, outward
    )
    mesh = SceneMesh(
        path.stem,
        corners.reshape(-1, 3) + origin,
        surfel_faces(count),
        colors=_surfel_colors(o3d, points, voxels, np.asarray(cloud.points)),
        materials=surfel_materials(points.classes, voxels),
    )
    return _Surfels(mesh, voxel_m)


def surfel_faces(count: int) -> Ints:
    """Return the triangles of surfels that have four consecutive vertices each.

    The result has shape (2 * count, 3).
    """
    faces: Ints = 4 * np.arange(count)[:, None, None] + np.array([[0, 1, 2], [0, 2, 3]])
    return faces.reshape(-1, 3)


@dataclass(frozen=True, eq=False)
class PointVoxels:
    """Assignment of points to voxels. Only voxels with points are stored."""

    order: Ints  # (n,), indices of the points, sorted by voxel
    starts: Ints  # (v,), index of the first point of each voxel in `order`
    counts: Ints  # (v,), number of points in each voxel

    @classmethod
    def from_points(cls, path: Path, positions: Floats, voxel_m: float) -> PointVoxels:
        """Assign the points in a file to voxels.

        The positions have shape (n, 3). Raise LidarError if there are too many voxels.
        """
        lower = positions.min(axis=0)
        spans = (positions.max(axis=0) - lower) / voxel_m + 1
        if spans.prod() > _MAX_VOXELS:
            raise LidarError(
                f"{path} is too large for voxels of {voxel_m:.3g} m. Increase `voxel_m`."
            )
        numbers = np.zeros(len(positions), np.int64)
        for axis, span in enumerate(spans):  # one axis at a time, to save memory
            # The minimum x, y and z are at the center of the first voxel.
            cells = np.floor((positions[:, axis] - lower[axis]) / voxel_m + 0.5)
            numbers *= int(span) + 1
            numbers += cells.astype(np.int64)
        order = np.argsort(numbers, kind="stable")
        ordered = numbers[order]
        starts = np.flatnonzero(np.concatenate([[True], ordered[1:] != ordered[:-1]]))
        return cls(order, starts, np.diff(starts, append=len(order)))

    def means(self, values: AnyArray) -> Floats:
        """Return the mean of the values in each voxel.

        `values` has shape (n, k), and the means have shape (v, k).
        """
        means = np.empty((len(self.starts), *values.shape[1:]))
        for start in range(0, len(self.starts), _BLOCK_VOXELS):  # blocks, to save memory
            block = slice(start, start + _BLOCK_VOXELS)
            first = int(self.starts[start])
            stop = first + int(self.counts[block].sum())
            some = values[self.order[first:stop]].astype(np.float64)
            means[block] = np.add.reduceat(some, self.starts[block] - first, axis=0)
        means /= self.counts[:, None]
        return means

    def known_means(self, values: AnyArray) -> Floats:
        """Return the mean value in each voxel, ignoring NaN.

        `values` has shape (n, k), and the result (v, k). The mean is NaN if all values are NaN.
        """
        known = ~np.isnan(values)
        with np.errstate(invalid="ignore"):  # 0 / 0 in voxels without values
            return self.means(np.where(known, values, 0.0)) / self.means(known)

    def most_frequent(self, numbers: Ints, distinct: int, unknown: int | None = None) -> Ints:
        """Return the number that occurs most often in each voxel.

        The array has shape (v,). Ties are resolved in favor of the lowest number. `numbers` has
        shape (n,) and contains integers from 0 to `distinct` - 1. The number `unknown` is returned
        only if a voxel contains no other number.
        """
        voxel = np.repeat(np.arange(len(self.counts)), self.counts)
        pairs, repeats = np.unique(voxel * distinct + numbers[self.order], return_counts=True)
        voxel_of_pair, number = np.divmod(pairs, distinct)
        repeats[number == unknown] = 0
        by_frequency = np.lexsort((number, -repeats, voxel_of_pair))
        _, firsts = np.unique(voxel_of_pair[by_frequency], return_index=True)
        modes: Ints = number[by_frequency][firsts]
        return modes


def _outward(points: Sweep) -> Floats | None:
    """Return vectors from the points to the scanner, or the normals if these are unknown.

    Return None if neither is known. If the scanner position of a point is unknown, its vector is
    zero. The result has shape (n, 3).
    """
    scanners = vectors(points, ORIGINS)
    return vectors(points, NORMALS) if scanners is None else np.nan_to_num(scanners - points.points)


def _normalize(outward: Floats) -> Floats:
    """Scale vectors to length 1, leaving zero vectors unchanged.

    The vectors have shape (n, 3).
    """
    lengths = np.sqrt((outward * outward).sum(axis=1, keepdims=True))
    return np.divide(outward, lengths, out=np.zeros_like(outward), where=lengths > 0)


def _surfel_colors(o3d: Any, points: Sweep, voxels: PointVoxels, centers: Floats) -> Colors | None:
    """Derive the colors of surfels from the mean colors or intensities of their points.

    Colors are averaged in linear light. A surfel without a color has the mean color of its
    neighbors, or the default gray if they have no color either. Return None if the points have
    neither colors nor intensities. `centers` contains the centers of the surfels and has shape
    (v, 3).
    """
    light: Floats
    if (srgb := vectors(points, COLORS)) is not None:
        light = voxels.known_means(_to_linear(srgb))
    elif (strengths := points.intensity) is not None:
        white = np.nanquantile(strengths, _WHITE_QUANTILE)
        intensities = voxels.known_means(strengths[:, None])
        light = np.clip(intensities / (white if white > 0 else 1.0), 0, 1).repeat(3, axis=1)
    else:
        return None
    _fill_from_neighbors(o3d, light, centers)
    colors: Bytes = np.where(np.isnan(light), GRAY[0], as_srgb(light))
    return Colors.from_face_colors(colors.repeat(2, axis=0))


def _fill_from_neighbors(o3d: Any, light: Floats, centers: Floats) -> None:
    """Replace NaN in `light` with the mean of neighboring surfels whose light is known.

    `light` and `centers` have shape (v, 3). `light` is modified in place.
    """
    unknown = np.flatnonzero(np.isnan(light[:, 0]))
    if not 0 < len(unknown) < len(light):
        return
    tree = o3d.core.nns.NearestNeighborSearch(o3d.core.Tensor(centers))
    tree.knn_index()
    neighbors, _ = tree.knn_search(o3d.core.Tensor(centers[unknown]), _NEIGHBORS)
    around = light[neighbors.numpy()]
    known = ~np.isnan(around)
    with np.errstate(invalid="ignore"):  # 0 / 0 for surfels without such neighbors
        light[unknown] = np.where(known, around, 0.0).sum(axis=1) / known.sum(axis=1)


def _to_linear(colors: AnyArray) -> Floats:
    """Convert sRGB colors from 0 to 255 to linear light, preserving NaN.

    The colors have shape (n, 3).
    """
    known = np.isfinite(colors)
    light = LINEAR[np.where(known, colors, 0).astype(np.uint8)]
    return np.where(known, light, np.nan)


def surfel_materials(point_classes: Ints | None, voxels: PointVoxels) -> FaceMaterials | None:
    """Return a material for each surfel, named after its most frequent class, or None.

    `point_classes` contains the classes of the points, which are `NO_CLASS` for points without a
    class. Its shape is (n,). If it is None, return None.
    """
    if point_classes is None:
        return None
    classes, numbers = np.unique(point_classes, return_inverse=True)
    unknown = 0 if classes[0] == NO_CLASS else None  # `NO_CLASS` is lower than all classes
    modes = voxels.most_frequent(numbers, len(classes), unknown)
    present, rows = np.unique(modes, return_inverse=True)
    names = tuple(
        "" if number == NO_CLASS else f"{CLASS_MATERIAL}{number}"
        for number in classes[present].tolist()
    )
    return FaceMaterials(names, rows.astype(np.int32).repeat(2))


def _surfel_corners(
    points: Floats, covariances: Floats, voxel_m: float, size: float, outward: Floats | None
) -> Floats:
    """Return the corners of surfels, counterclockwise as seen from the direction `outward`.

    `outward` has shape (n, 3), and the result has shape (n, 4, 3).
    """
    corners = np.empty((len(points), 4, 3))
    for start in range(0, len(points), 1 << 18):
        block = slice(start, start + (1 << 18))
        variances, axes = np.linalg.eigh(covariances[block])
        halves = size * _EXTENT * np.sqrt(np.maximum(variances[:, 1:], 0))
        halves = np.minimum(halves, _MAX_HALF_VOXELS * voxel_m)
        half_widths, half_lengths = np.moveaxis(axes[:, :, 1:] * halves[:, None], 2, 0)
        if outward is not None:
            normals = np.cross(half_lengths, half_widths)
            inverted = (normals * outward[block]).sum(axis=1) < 0
            half_widths = np.where(inverted[:, None], -half_widths, half_widths)
        for corner, (a, b) in enumerate(((-1, -1), (1, -1), (1, 1), (-1, 1))):
            corners[block, corner] = points[block] + a * half_lengths + b * half_widths
    return corners


def _spacing_m(o3d: Any, points: Floats) -> float:
    """Return the median distance between a point and its eighth neighbor."""
    tree = o3d.core.nns.NearestNeighborSearch(o3d.core.Tensor(points))
    tree.knn_index()
    sampled = points[:: -(-len(points) // _SAMPLE)]
    _, squares = tree.knn_search(o3d.core.Tensor(np.ascontiguousarray(sampled)), _NEAREST)
    return float(np.sqrt(np.median(squares.numpy()[:, -1])))

"""Point clouds as scenes: each point becomes a surfel, a small rectangle in the points' plane.

Poisson surfaces (Kazhdan and Hoppe 2013), which Open3D makes, too, were compared by casting: of a
simulated scan of a city they took twenty times as long, needed the side that each point was seen
from, and closed openings, so that a tenth of the ranges were wrong by more than 0.3 m.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

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
from lidarsim.words import plural, rounded

from ..open3d_access.open3d_module import load_open3d
from .point_files import MIN_POINTS, NO_CLASS, POINT_BYTES, read_points, vectors
from .surfel_gaps import expected_loss

# Chosen on scans of a city, from 7 to 30 neighbors and 0.7 to 1.4: more of either closes more gaps
# between points, and makes surfels reach farther beyond edges.
_NEIGHBORS = MIN_POINTS
_EXTENT = 0.85
# length of half a surfel, in voxels: distant and stray points have no neighbors
_MAX_HALF_VOXELS = 3
_SAMPLE = 20_000  # points whose neighbors tell the spacing
_NEAREST = 9  # a point itself, and the eight around it on a square grid
_MAX_VOXELS = 1 << 62  # voxels of the box around the points: 64 bits number voxels
CLASS_MATERIAL = "class "  # and the number: name of the material of surfels with a class
_GRAY = "have the mean color of their neighbors, or are gray"  # in notes
_LEAST_LOSS = 0.02  # share of returns lost in gaps that a note tells
# docs/how-to/point-clouds.md has the scans
_MEASURED_LOSS = "4 to 40 % in scenes from one to three scans of a city"
_WHITE_QUANTILE = 0.99  # share of intensities up to white: mirrors return more


def scene_of_points(
    path: str | Path,
    *,
    voxel_m: float | None = None,
    size: float = 1.0,
    unit: str | None = None,
    epsg: int | None = None,
    keep_noise: bool = False,
    color: Literal["rgb", "intensity"] | None = None,
    tell: Callable[[str], None] = warn,
) -> Scene:
    """Make a scene of a point cloud, for example a scan of a real place.

    A surfel lies where a principal component analysis of the 12 nearest points puts their plane,
    and is about as large as the gaps between the points in both directions. Its front faces the
    scanner, where the file has positions of scanners, or has the side of the file's normals.

    A surfel has the mean color of its points, and as the name of its material the most frequent
    of their classes, such as «class 2».

    Parameters
    ----------
    path
        .ply, .pcd, text (.xyz, .txt, .asc, .csv), .pts, .ptx, .npy, .bin of KITTI or nuScenes, .las
        or .laz, which need laspy, .e57, which needs pye57, or .parquet, which needs pyarrow. Scans
        are joined by their poses. Z-up; .las and .laz in the units of their coordinate system, text
        in the units of its header, others in meters.
    voxel_m
        Edge of cubes; the points of a cube become their mean. By default the median distance of
        points to the eighth of their neighbors.
    size
        A factor of the surfels' sides: larger surfels close gaps, and reach farther beyond edges.
    unit
        Unit of x, y and z, in place of meters or of the units that a .las or .laz states.
    epsg
        Code of a projected system in true meters, such as the code of a UTM zone. Points are
        brought to the system from the system that the file states; needs rasterio. Heights are
        converted to meters and stay as in the file otherwise. By default coordinates are kept.
    keep_noise
        Whether points become surfaces that a file withholds or classifies as noise (class 7, in
        point formats 6 to 10 of LAS also 18); by default they are left out.
    color
        What colors surfels: red, green and blue, or mean intensities as grays. The 99th
        percentile of intensities is white. By default red, green and blue if the file has them.
    tell
        Called with a line on converted units, on points that are left out, and on what a scene does
        not keep; by default this package's logger warns.

    Returns
    -------
    A scene of a single object, named by the file; each surfel is two triangles.

    Raises
    ------
    LidarError
        If the file cannot be read, has fewer than 12 points, lacks what `color` names, has a
        coordinate system without lengths or with lengths that are not true, as Web Mercator, cannot
        be brought to `epsg`, or needs too much memory.
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
        tell=tell,
    ).scene


class PointScene(NamedTuple):
    """A scene that was made of a point cloud.

    Attributes
    ----------
    scene
        The scene, with the coordinate system of the cloud.
    voxel_m
        Edge of the cubes whose points became a surfel, meters.
    loss
        Share of returns that are expected to be lost in gaps between points (`expected_loss`), or
        None if it cannot be estimated.
    """

    scene: Scene
    voxel_m: float
    loss: float | None

    @property
    def gap_note(self) -> str:
        """A note on returns that are lost in gaps between points, or ""."""
        larger_m = rounded(2 * self.voxel_m, 2)
        advice = f"To close gaps, increase `--voxel-m` (`voxel_m` in Python), such as to {larger_m}"
        if self.loss is None:
            return (
                "returns are lost in gaps between points. Their share cannot be estimated, "
                "because the scanner positions are unknown. In measurements, it was "
                f"{_MEASURED_LOSS}. {advice}"
            )
        if self.loss < _LEAST_LOSS:
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
    tell: Callable[[str], None],
) -> PointScene:
    """Make a scene of a point cloud as `scene_of_points`, and estimate what it loses."""
    for name, value in (("voxel_m", voxel_m), ("size", size)):
        if value is not None and not 0 < value < np.inf:
            raise LidarError(f"{name} must be a positive number, but is {value}.")
    points, placed_epsg = read_points(path, unit, tell, epsg=epsg, keep_noise=keep_noise)
    points = _colored(path, points, color, tell)
    surfels = _surfels_of(path, points, voxel_m, size)
    loss = None
    if (scanners := vectors(points, ORIGINS)) is not None:
        corners = surfels.mesh.vertices.reshape(-1, 4, 3)
        loss = expected_loss(points.points, scanners, corners)
    scene = replace(Scene.from_meshes([surfels.mesh]), epsg=placed_epsg)
    return PointScene(scene, surfels.voxel_m, loss)


def surfels(path: Path, points: Floats, voxel_m: float | None, size: float = 1.0) -> SceneMesh:
    """Return the surfels of the points (n, 3) of a file."""
    return _surfels_of(path, Sweep(points), voxel_m, size).mesh


class _Surfels(NamedTuple):
    """Surfels of points."""

    mesh: SceneMesh
    voxel_m: float  # edge of the cubes whose points became a surfel, meters


def _colored(path: Path, points: Sweep, color: str | None, tell: Callable[[str], None]) -> Sweep:
    """Return points with either colors or intensities.

    LidarError if the chosen quantity is missing.
    """
    columns = dict(points.columns)
    present = {"rgb": "red" in columns, "intensity": "intensity" in columns}
    if color is not None and not present[color]:
        quantity = "colors" if color == "rgb" else "intensities"
        raise LidarError(f"`color` cannot be {color!r}, because {path} has no {quantity}.")
    if points.classes is not None:
        _note_unknown(path, "class", points.classes == NO_CLASS, "have no material", tell)
    if not any(present.values()):
        return points
    color = color or next(name for name, is_present in present.items() if is_present)
    if all(present.values()):
        other, choice = ("intensities", "intensity") if color == "rgb" else ("colors", "rgb")
        tell(
            f"the {other} of {path} are not stored, because a surfel has a single color. To use "
            f"them, set `color` to {choice}"
        )
    if color == "rgb":
        _note_unknown(path, "color", np.isnan(columns["red"]), _GRAY, tell)
        columns.pop("intensity", None)
    else:
        _note_unknown(path, "intensity", np.isnan(columns["intensity"]), _GRAY, tell)
        columns = {name: values for name, values in columns.items() if name not in COLORS}
    return points.replace(columns=columns)


def _note_unknown(
    path: Path, quantity: str, unknown: Bools, outcome: str, tell: Callable[[str], None]
) -> None:
    """Call `tell` if points (n,) lack a quantity that others have."""
    if count := int(unknown.sum()):
        tell(
            f"{path}: {count:,} of {plural(len(unknown), 'point')} have no {quantity}. Surfels of "
            f"such points {outcome}."
        )


def _surfels_of(path: Path, points: Sweep, voxel_m: float | None, size: float) -> _Surfels:
    """Return the surfels of the points of a file, with their colors and classes."""
    # Covariances of Open3D lose the digits of points far from zero.
    positions = points.points
    origin = np.round((positions.min(axis=0) + positions.max(axis=0)) / 2)
    positions = positions - origin
    o3d = load_open3d()
    voxel_m = voxel_m or _spacing_m(o3d, positions)
    if not voxel_m:
        raise LidarError(f"Most points of {path} have the same positions. Set `voxel_m`.")
    voxels = PointVoxels.of_points(path, positions, voxel_m)
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
    outward = None if outward is None else voxels.means(_directions(outward))
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
    """Return the triangles (2 · count, 3) of surfels with four vertices each, in order."""
    faces: Ints = 4 * np.arange(count)[:, None, None] + np.array([[0, 1, 2], [0, 2, 3]])
    return faces.reshape(-1, 3)


@dataclass(frozen=True, eq=False)
class PointVoxels:
    """Points sorted by the voxels that contain the points.

    Only voxels with points are counted.
    """

    order: Ints  # (n,): indices of the points, voxel by voxel
    starts: Ints  # (v,): where the points of each voxel start in `order`
    counts: Ints  # (v,): number of points in each voxel

    @classmethod
    def of_points(cls, path: Path, positions: Floats, voxel_m: float) -> PointVoxels:
        """Sort the points (n, 3) of a file into voxels.

        LidarError if there are too many voxels.
        """
        lower = positions.min(axis=0)
        spans = (positions.max(axis=0) - lower) / voxel_m + 1
        if spans.prod() > _MAX_VOXELS:
            raise LidarError(
                f"{path} is too large for voxels of {voxel_m:.3g} m. Increase `voxel_m`."
            )
        # The first voxel has the lowest point in its middle.
        cells = np.floor((positions - lower) / voxel_m + 0.5).astype(np.int64)
        _, ny, nz = (int(span) + 1 for span in spans)
        numbers = (cells[:, 0] * ny + cells[:, 1]) * nz + cells[:, 2]
        order = np.argsort(numbers, kind="stable")
        ordered = numbers[order]
        starts = np.flatnonzero(np.concatenate([[True], ordered[1:] != ordered[:-1]]))
        return cls(order, starts, np.diff(starts, append=len(order)))

    def means(self, values: AnyArray) -> Floats:
        """Return the means (v, k) in each voxel of values (n, k) of the points."""
        sums = np.add.reduceat(values[self.order].astype(np.float64), self.starts, axis=0)
        means: Floats = sums / self.counts[:, None]
        return means

    def known_means(self, values: AnyArray) -> Floats:
        """Return the means (v, k) in each voxel of the values (n, k) that are not NaN, or NaN."""
        known = ~np.isnan(values)
        with np.errstate(invalid="ignore"):  # 0 / 0 of voxels without values
            return self.means(np.where(known, values, 0.0)) / self.means(known)

    def most_frequent(self, numbers: Ints, distinct: int, unknown: int | None = None) -> Ints:
        """Return the most frequent number (v,) in each voxel, of several the lowest.

        `numbers` (n,) of the points are from 0 to below `distinct`. The number `unknown` is
        returned only for voxels that have no other.
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
    """Return vectors (n, 3) to the scanner, otherwise normals, or None if neither is known.

    Points whose scanner has an unknown position have a zero vector.
    """
    scanners = vectors(points, ORIGINS)
    return vectors(points, NORMALS) if scanners is None else np.nan_to_num(scanners - points.points)


def _directions(outward: Floats) -> Floats:
    """Return the directions of vectors (n, 3), of length 1 or, of zero vectors, 0."""
    lengths = np.sqrt((outward * outward).sum(axis=1, keepdims=True))
    return np.divide(outward, lengths, out=np.zeros_like(outward), where=lengths > 0)


def _surfel_colors(o3d: Any, points: Sweep, voxels: PointVoxels, centers: Floats) -> Colors | None:
    """Return the mean colors of surfels in linear light, or grays of their mean intensities.

    `centers` (v, 3) are the centers of the surfels. A surfel whose points have neither has the mean
    of its neighbors, or, if these have neither, the gray of a file without colors.
    """
    light: Floats
    if (srgb := vectors(points, COLORS)) is not None:
        light = voxels.known_means(_light(srgb))
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
    """Replace NaN in the light (v, 3) of surfels by the mean of the neighbors that have light."""
    unknown = np.flatnonzero(np.isnan(light[:, 0]))
    if not 0 < len(unknown) < len(light):
        return
    tree = o3d.core.nns.NearestNeighborSearch(o3d.core.Tensor(centers))
    tree.knn_index()
    neighbors, _ = tree.knn_search(o3d.core.Tensor(centers[unknown]), _NEIGHBORS)
    around = light[neighbors.numpy()]
    known = ~np.isnan(around)
    with np.errstate(invalid="ignore"):  # 0 / 0 of surfels without such neighbors
        light[unknown] = np.where(known, around, 0.0).sum(axis=1) / known.sum(axis=1)


def _light(colors: AnyArray) -> Floats:
    """Return the linear light (n, 3) of sRGB colors from 0 to 255, NaN of NaN."""
    known = np.isfinite(colors)
    light = LINEAR[np.where(known, colors, 0).astype(np.uint8)]
    return np.where(known, light, np.nan)


def surfel_materials(point_classes: Ints | None, voxels: PointVoxels) -> FaceMaterials | None:
    """Return the most frequent classes of surfels as names of materials, such as «class 2».

    `point_classes` (n,) are the classes of the points, `NO_CLASS` for points without a class, or
    None if they are unknown.
    """
    if point_classes is None:
        return None
    classes, numbers = np.unique(point_classes, return_inverse=True)
    unknown = 0 if classes[0] == NO_CLASS else None  # the lowest of all classes
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
    """Return the corners (n, 4, 3) of surfels, counter-clockwise seen from `outward` (n, 3)."""
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
    """Return the median distance of points to the eighth of their neighbors."""
    tree = o3d.core.nns.NearestNeighborSearch(o3d.core.Tensor(points))
    tree.knn_index()
    sampled = points[:: -(-len(points) // _SAMPLE)]
    _, squares = tree.knn_search(o3d.core.Tensor(np.ascontiguousarray(sampled)), _NEAREST)
    return float(np.sqrt(np.median(squares.numpy()[:, -1])))

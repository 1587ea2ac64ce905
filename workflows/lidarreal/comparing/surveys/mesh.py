"""Signed distances from points to the triangles of a mesh."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from lidarfiles.open3d_access.open3d_module import load_open3d
from lidarsim.errors import LidarError
from lidarsim.io.input_files import read_input
from lidarsim.io.writing_progress import WritingProgress
from lidarsim.numerics.arrays import Bools, Floats, Ints
from lidarsim.scene.files.mesh_formats import endings
from lidarsim.scene.files.meshfile import Objects, load_objects
from lidarsim.scene.scene_instances import SceneInstance

from ..compared_sweep import bounds_of, origin_to_add
from ..stated_frames import StatedFrame, check_same_systems
from .deviations import Deviations, normal_columns

_BATCH = 200_000
_HEAD_BYTES = 4096
# Cloud formats that are also mesh formats, and formats that do not contain surfaces.
_CLOUDS = (".ply", ".xyz", ".txt", ".asc", ".csv", ".pts", ".ptx", ".pcd", ".las", ".laz", ".npy")


def is_mesh(path: Path) -> bool:
    """Return whether a file contains a mesh, according to its name or the header of a .ply file."""
    suffix = path.suffix.lower()
    if suffix == ".ply" and path.is_file():
        head = read_input(path)[:_HEAD_BYTES].partition(b"end_header")[0]
        lines = [line.split() for line in head.splitlines()]
        return any(line[:2] == [b"element", b"face"] and line[2:] != [b"0"] for line in lines)
    return suffix in endings() and suffix not in _CLOUDS


def mesh_deviations(
    points: Floats,
    mesh: Path,
    max_distance_m: float,
    frame: StatedFrame | None = None,
    world_origin: tuple[float, float, float] | None = None,
    show: WritingProgress = lambda *_: None,
    **options: Any,
) -> Deviations:
    """Return the signed distances from points to the nearest triangles of a mesh.

    Distances are positive outside a closed mesh, or on the side to which the nearest triangle of an
    open mesh faces.

    Parameters
    ----------
    points
        Points in world coordinates. Shape (n, 3).
    mesh
        Mesh file.
    max_distance_m
        Points farther than this from the mesh have no counterpart.
    frame
        Frame that the file of the points states.
    world_origin
        World origin that the points contain, if any. It is added to a mesh in local coordinates.
    show
        Called when the distances of a part of the points have been measured.
    options
        `unit` and `up_axis` of the mesh.

    Raises
    ------
    LidarError
        If the mesh cannot be read, if its coordinate system or vertical datum differs from that of
        the points, or if no point is within `max_distance_m`.
    """
    notes: list[str] = []
    frame = frame or StatedFrame("the points")
    corners = _triangles(mesh, frame, notes, options)
    boxes = bounds_of(points), bounds_of(corners.reshape(-1, 3))
    if (shift := origin_to_add((world_origin, None), boxes)) is not None:
        corners = corners + shift.origin
        notes.append(shift.note((frame.name, str(mesh))))
    origin = corners.reshape(-1, 3).mean(axis=0)
    is_closed = _is_closed(corners)
    surface = _Surface(corners - origin, is_closed)
    batches = []
    for start in range(0, len(points), _BATCH):
        batches.append(surface.signed_distances(points[start : start + _BATCH] - origin))
        show("measuring distances", min(start + _BATCH, len(points)), len(points), "points")
    distances, normals = map(np.concatenate, zip(*batches, strict=True))
    near = np.abs(distances) <= max_distance_m
    if not near.any():
        nearest_m = float(np.abs(distances).min())
        raise LidarError(
            f"None of the points is within {max_distance_m:g} m of {mesh}. The nearest point is "
            f"{nearest_m:,.3f} m away. Check the unit, axes and origin of the mesh, or increase "
            "`--max-distance`."
        )
    if not is_closed:
        notes.append(
            f"{mesh} is not closed, so distances are positive on the side to which the nearest "
            "triangle faces"
        )
    figures = {
        "max_distance_m": max_distance_m,
        "triangles": len(corners),
        "is_closed": is_closed,
        "without_counterpart": int(np.count_nonzero(~near)),
    }
    columns = normal_columns(normals[near])
    return Deviations(points[near], {"distance": distances[near]}, figures, tuple(notes), columns)


def _triangles(path: Path, frame: StatedFrame, notes: list[str], options: dict[str, Any]) -> Floats:
    """Return the corners of all triangles with nonzero area, in meters. Shape (f, 3, 3).

    Raises LidarError if the file states a different frame.
    """
    objects = load_objects(path, report=lambda text: notes.append(text.rstrip(".")), **options)
    notes += check_same_systems([frame, _frame_of(path, objects)])
    meshes = objects.at_start(lambda text: notes.append(text.rstrip(".")))
    solid = [item.flat() if isinstance(item, SceneInstance) else item for item in meshes]
    corners = np.concatenate([mesh.vertices[mesh.faces] for mesh in solid])
    edges = corners[:, 1:] - corners[:, :1]
    has_area = np.cross(edges[:, 0], edges[:, 1]).any(axis=1)
    if not has_area.any():
        raise LidarError(f"{path} has no triangles with an area.")
    return corners[has_area]


def _frame_of(path: Path, objects: Objects) -> StatedFrame:
    """Return the frame that a mesh file or a raster states."""
    raster = objects.raster
    if raster is None or raster.epsg is not None or not raster.crs:
        return StatedFrame.from_epsg(objects.epsg, str(path), objects.vertical_datum)
    return StatedFrame(str(path), None, raster.crs, objects.vertical_datum)


def _is_closed(corners: Floats) -> bool:
    """Return whether each directed edge of a mesh has exactly one opposite edge."""
    _, vertex = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
    faces = vertex.reshape(-1, 3).astype(np.int64)
    starts = faces.reshape(-1)
    stops = np.roll(faces, -1, axis=1).reshape(-1)
    size = int(faces.max()) + 1
    forward, backward = np.sort(starts * size + stops), np.sort(stops * size + starts)
    return bool((np.diff(forward) > 0).all() and np.array_equal(forward, backward))


class _Surface:
    """Triangles in coordinates close to the origin.

    Open3D finds the nearest triangle in single precision. The distance to it is computed in double
    precision.
    """

    def __init__(self, corners: Floats, is_closed: bool) -> None:
        self._open3d = load_open3d()
        self._corners = corners
        self._is_closed = is_closed
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        self._normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
        core = self._open3d.core
        self._scene = self._open3d.t.geometry.RaycastingScene()
        vertices = np.ascontiguousarray(corners.reshape(-1, 3), np.float32)
        faces = np.arange(len(vertices), dtype=np.uint32).reshape(-1, 3)
        self._scene.add_triangles(core.Tensor(vertices), core.Tensor(faces))

    def signed_distances(self, points: Floats) -> tuple[Floats, Floats]:
        """Return the signed distances of points, and the normals of the nearest triangles."""
        from trimesh.triangles import closest_point

        queries = self._open3d.core.Tensor(np.ascontiguousarray(points, np.float32))
        triangle = self._scene.compute_closest_points(queries)["primitive_ids"].numpy()
        triangle = triangle.astype(np.int64)
        offsets = points - closest_point(self._corners[triangle], points)
        unsigned = np.linalg.norm(offsets, axis=1)
        if self._is_closed:
            is_inside = self._scene.compute_occupancy(queries, nsamples=3).numpy() > 0
        else:
            is_inside = self._is_behind(offsets, triangle)
        return np.where(is_inside, -unsigned, unsigned), self._normals[triangle]

    def _is_behind(self, offsets: Floats, triangle: Ints) -> Bools:
        return np.asarray(np.einsum("ni,ni->n", offsets, self._normals[triangle]) < 0)

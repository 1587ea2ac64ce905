"""Create surfels from the points of many sweeps, large enough to close the gaps between rays.

A lidar samples a surface in lines. Points of the same ring are close together, and rings are far
apart. The twelve nearest neighbors of a point often lie on a single line, which does not determine
a plane. In that case, more neighbors are used until they include lines of other rings and sweeps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lidarscenario.points.point_files import POINT_BYTES
from lidarscenario.points.point_scene import PointVoxels, surfel_faces, surfel_materials
from lidarsim.errors import LidarError
from lidarsim.io.allowance import bytes_of, memory
from lidarsim.numerics.arrays import AnyFloats, Bools, Floats, Ints
from lidarsim.scene.colors import join_colors
from lidarsim.scene.face_materials import join_materials
from lidarsim.scene.scene_mesh import SceneMesh

_NEIGHBORS = (12, 32, 80)  # numbers of neighbors, increased until they are not on a line
_MIN_WIDTH = 0.1  # minimum ratio of the variances within a plane, below which it is a line
_EXTENT = 0.85  # half a side relative to the standard deviation of the neighbors
_MAX_HALF_VOXELS = 3  # maximum half side in voxels, unless the gap between rays is larger
_MAX_FLAT = 0.1  # maximum variance along the normal relative to the smaller variance in the plane
_PLANE_GAPS = 0.55  # half a side across the rings relative to the gap between rays on a plane
_MAX_RADII = 1.0  # limit of this half side, relative to the distance of the farthest neighbor
_MAX_GAPS = 1.0  # maximum half side elsewhere, relative to the gap between rays
_MIN_COSINE = 0.1  # limit of the incidence by which gaps grow
_MIN_RISE_GAPS = 1.0  # standard deviation of a thin object across the rings, in gaps
_THIN_VOXELS = 0.5  # minimum half width of its surfels before they are trimmed, in voxels
_BLOCK = 1 << 16  # surfels per block


@dataclass(frozen=True, eq=False)
class Surfels:
    """Surfels, each of which consists of two consecutive triangles."""

    mesh: SceneMesh
    dark: Bools  # (m,), surfels that return no pulses, such as windows

    def __len__(self) -> int:
        return len(self.mesh.faces) // 2

    @cached_property
    def centers(self) -> Floats:
        """Centers of the surfels in meters.

        The array has shape (m, 3).
        """
        return surfel_centers(self.mesh)

    @cached_property
    def normals(self) -> Floats:
        """Unit normals of the surfels.

        The array has shape (m, 3).
        """
        corners = self.mesh.vertices.reshape(-1, 4, 3)
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 3] - corners[:, 0])
        lengths = np.linalg.norm(normals, axis=1, keepdims=True)
        return np.asarray(normals / np.maximum(lengths, 1e-12))

    @cached_property
    def half_sides(self) -> Floats:
        """Vectors from the centers of the surfels to the middles of two sides, in meters.

        The array has shape (2, m, 3).
        """
        corners = self.mesh.vertices.reshape(-1, 4, 3)
        return np.stack([corners[:, 1] - corners[:, 0], corners[:, 3] - corners[:, 0]]) / 2

    def resize(self, start: Floats, stop: Floats) -> Surfels:
        """Return surfels with other extents in the same planes.

        `start` and `stop` are positions along both half sides, relative to the center and to the
        length of the half side. They have shape (m, 2), and are -1 and 1 for the same extents.
        """
        along, across = self.half_sides
        corners = np.empty((len(self), 4, 3))
        for corner, ends in enumerate(((start, start), (stop, start), (stop, stop), (start, stop))):
            corners[:, corner] = self.centers
            corners[:, corner] += ends[0][:, :1] * along + ends[1][:, 1:] * across
        return replace(self, mesh=replace(self.mesh, vertices=corners.reshape(-1, 3)))

    def select(self, rows: Bools) -> Surfels:
        """Select surfels with a mask."""
        mesh = self.mesh
        vertices = mesh.vertices.reshape(-1, 4, 3)[rows].reshape(-1, 3)
        faces = surfel_faces(int(rows.sum()))
        both = np.flatnonzero(rows.repeat(2))
        materials = None if mesh.materials is None else mesh.materials.take(both)
        return Surfels(SceneMesh(mesh.name, vertices, faces, materials=materials), self.dark[rows])

    def shift_along_normals(self, shifts_m: Floats) -> Surfels:
        """Move each surfel along its normal by the distance in `shifts_m`.

        `shifts_m` has shape (m,).
        """
        offsets = (shifts_m[:, None] * self.normals).repeat(4, axis=0)
        return replace(self, mesh=replace(self.mesh, vertices=self.mesh.vertices + offsets))

    def with_dark(self, others: Surfels) -> Surfels:
        """Append surfels that return no pulses."""
        dark = np.append(self.dark, np.ones(len(others), bool))
        return Surfels(merge_surfels([self.mesh, others.mesh]), dark)

    @staticmethod
    def are_enough(points: Floats, voxel_m: float) -> bool:
        """Return whether points occupy enough voxels to create surfels.

        The points have shape (n, 3).
        """
        cells = np.unique(np.floor(points / voxel_m).astype(np.int64), axis=0)
        return len(cells) > 2 * _NEIGHBORS[-1]

    @classmethod
    def from_points(
        cls,
        name: str,
        points: Floats,
        outward: AnyFloats,
        voxel_m: float,
        gap_rad: float,
        labels: Ints | None = None,
    ) -> Surfels:
        """Create a surfel at the mean of the points in each voxel.

        Parameters
        ----------
        name
            Name of the mesh, also used in messages.
        points
            Positions of shape (n, 3), in meters.
        outward
            Vectors from the points to the sensor, of shape (n, 3), in meters.
        voxel_m
            Edge length of the voxels in meters.
        gap_rad
            Angle between the rays of neighboring rings in radians.
        labels
            Labels of the points (see `labels_of`), of shape (n,), or None. The material of a surfel
            is named after the most frequent label of its points.

        Raises
        ------
        LidarError
            If there are too few points, or if the surfels would exceed the memory limit.
        """
        from scipy.spatial import cKDTree

        voxels = PointVoxels.from_points(Path(name), points, voxel_m)
        count = len(voxels.counts)
        if count * POINT_BYTES > memory() // 2:
            raise LidarError(
                f"The reconstruction of {name} would have {count:,} surfels, which require "
                f"{bytes_of(count * POINT_BYTES)} of memory, but the limit is "
                f"{bytes_of(memory() // 2)}. Set `voxel_m` to more than {voxel_m:.3g}."
            )
        if count < _NEIGHBORS[-1]:
            raise LidarError(
                f"{name} has stationary points in {count} voxels of {voxel_m:.3g} m, but at "
                f"least {_NEIGHBORS[-1]} are required. Use a smaller `voxel_m`, or a longer "
                "recording."
            )
        means = voxels.means(points)
        mean_outward = voxels.means(outward)
        tree = cKDTree(means)
        corners = np.empty((count, 4, 3))
        for start in range(0, count, _BLOCK):
            block = slice(start, start + _BLOCK)
            view = _View(mean_outward[block], gap_rad)
            planes = _Planes.around(means[block], tree, means, view, voxel_m)
            corners[block] = planes.corners(means[block], mean_outward[block], voxel_m, gap_rad)
        mesh = SceneMesh(
            name,
            corners.reshape(-1, 3),
            surfel_faces(count),
            materials=surfel_materials(labels, voxels),
        )
        return cls(mesh, np.zeros(count, bool))


def surfel_mesh(name: str, corners: Floats) -> SceneMesh:
    """Create a surfel mesh from the corners of surfels, in meters.

    The corners have shape (m, 4, 3).
    """
    return SceneMesh(name, corners.reshape(-1, 3), surfel_faces(len(corners)))


def surfel_centers(mesh: SceneMesh) -> Floats:
    """Return the centers of a mesh's surfels in meters.

    The array has shape (m, 3).
    """
    return np.asarray(mesh.vertices.reshape(-1, 4, 3).mean(axis=1))


def merge_surfels(meshes: Sequence[SceneMesh]) -> SceneMesh:
    """Merge surfel meshes into one mesh with the name of the first."""
    sizes = [len(mesh.faces) for mesh in meshes]
    return SceneMesh(
        meshes[0].name,
        np.concatenate([mesh.vertices for mesh in meshes]),
        surfel_faces(sum(sizes) // 2),
        colors=join_colors([mesh.colors for mesh in meshes], sizes),
        materials=join_materials([mesh.materials for mesh in meshes], sizes),
    )


class _View(NamedTuple):
    """Directions from which m points were observed."""

    outward: AnyFloats  # (m, 3), vectors to the sensor, meters
    gap_rad: float  # angle between neighboring rings

    @property
    def directions(self) -> Floats:
        """Unit vectors to the sensor. Shape (m, 3)."""
        return self.outward / np.maximum(np.linalg.norm(self.outward, axis=1), 1e-9)[:, None]

    def crosses_rings(self, axes: Floats, spread_m: Floats) -> Bools:
        """Mark lines that extend over several rings.

        The lines have the given unit vectors (m, 3), and standard deviations (m,) along these.
        """
        directions = self.directions
        upward = np.array([0.0, 0.0, 1.0]) - directions[:, 2:] * directions
        upward /= np.maximum(np.linalg.norm(upward, axis=1), 1e-9)[:, None]
        rise_m = spread_m * np.abs(np.einsum("mi,mi->m", axes, upward))
        return np.asarray(
            rise_m > _MIN_RISE_GAPS * self.gap_rad * np.linalg.norm(self.outward, axis=1)
        )

    def facing(self, axes: Floats, rows: Bools) -> Floats:
        """Return the axes (k, 3, 3) of planes that contain lines and face the sensor."""
        directions = self.directions[rows]
        normals = directions - np.einsum("ki,ki->k", directions, axes)[:, None] * axes
        normals /= np.maximum(np.linalg.norm(normals, axis=1), 1e-9)[:, None]
        return np.stack([normals, np.cross(axes, normals), axes], axis=1)


class _Planes(NamedTuple):
    """Planes fitted to the neighbors of m points."""

    axes: Floats  # (m, 3, 3), unit vectors: normal, across the lines, along the lines
    halves: Floats  # (m, 2), half sides of surfels across and along the lines, meters
    radius_m: Floats  # (m,), distance of the farthest neighbor, or 0 if they are not in a plane

    @classmethod
    def around(
        cls, centers: Floats, tree: object, means: Floats, view: _View, voxel_m: float
    ) -> _Planes:
        """Fit a plane to the neighbors of each center. `tree` is a k-d tree of `means`.

        A thin object such as a pole is a line as well, but it crosses several rings. Its plane
        faces the sensor.
        """
        count = len(centers)
        axes = np.empty((count, 3, 3))
        halves = np.empty((count, 2))
        radius_m = np.empty(count)
        left = np.arange(count)
        for neighbors in _NEIGHBORS:
            around = means[_nearest(tree, centers[left], neighbors)]
            variances, found = principal_axes(around)
            axes[left] = found
            flat = variances[:, 0] < _MAX_FLAT * variances[:, 1]
            farthest_m = np.linalg.norm(around[:, -1] - centers[left], axis=1)
            radius_m[left] = np.where(flat, farthest_m, 0.0)
            near = around[:, : _NEIGHBORS[0]] - centers[left, None]
            close = np.square(np.einsum("mki,mji->mkj", near, found[:, 1:])).mean(axis=1)
            is_line = close[:, 0] < _MIN_WIDTH * close[:, 1]
            close[is_line, 0] = variances[is_line, 1]
            halves[left] = _EXTENT * np.sqrt(np.maximum(close, 0))
            narrow = variances[:, 1] < _MIN_WIDTH * variances[:, 2]
            if neighbors == _NEIGHBORS[0]:
                thin = narrow & view.crosses_rings(found[:, 2], np.sqrt(variances[:, 2]))
                axes[thin] = view.facing(found[thin, 2], thin)
                halves[thin, 0] = np.maximum(halves[thin, 0], _THIN_VOXELS * voxel_m)
                radius_m[thin] = 0.0
                narrow &= ~thin
            left = left[narrow]
            if not len(left):
                break
        return cls(axes, halves, radius_m)

    def corners(self, centers: Floats, outward: Floats, voxel_m: float, gap_rad: float) -> Floats:
        """Return the surfel corners, counterclockwise as seen from the sensor.

        The array has shape (m, 4, 3).
        """
        range_m = np.linalg.norm(outward, axis=1)
        facing = np.einsum("mi,mi->m", self.axes[:, 0], outward)
        cosine = np.abs(facing) / np.maximum(range_m, 1e-9)
        gap_m = gap_rad * range_m / np.maximum(cosine, _MIN_COSINE)
        longest_m = np.maximum(_MAX_HALF_VOXELS * voxel_m, _MAX_GAPS * gap_m)
        halves = np.minimum(self.halves, longest_m[:, None])
        # A plane continues between two rings of a sweep, wherever the rings of other sweeps are.
        to_next_m = np.minimum(_PLANE_GAPS * gap_m, _MAX_RADII * self.radius_m)
        halves[:, 0] = np.maximum(halves[:, 0], to_next_m)
        across = self.axes[:, 1] * halves[:, :1]
        along = self.axes[:, 2] * halves[:, 1:]
        inverted = np.einsum("mi,mi->m", np.cross(along, across), outward) < 0
        across = np.where(inverted[:, None], -across, across)
        corners = np.empty((len(centers), 4, 3))
        for corner, (a, b) in enumerate(((-1, -1), (1, -1), (1, 1), (-1, 1))):
            corners[:, corner] = centers + a * along + b * across
        return corners


def _nearest(tree: object, centers: Floats, count: int) -> Ints:
    _, rows = tree.query(centers, count)  # type: ignore[attr-defined]
    return np.asarray(rows)


def principal_axes(around: Floats) -> tuple[Floats, Floats]:
    """Return the ascending variances and principal axes of point sets.

    The point sets have shape (m, k, 3).
    """
    offsets = around - around.mean(axis=1, keepdims=True)
    covariances = np.einsum("mki,mkj->mij", offsets, offsets) / around.shape[1]
    variances, axes = np.linalg.eigh(covariances)
    return variances, np.swapaxes(axes, 1, 2)

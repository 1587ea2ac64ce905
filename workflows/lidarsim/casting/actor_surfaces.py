"""Geometry of actors' triangles, which move and may deform."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..motion.trajectory import velocities
from ..numerics.arrays import Floats, Indices, Integers, Ints
from ..numerics.vectors import dot, matvec, rotate_into_frames
from .actor_trajectories import ActorTrajectories
from .stored_triangles import StoredTriangles

_NO_ROWS = np.zeros(0, np.intp)


class DeformedCorners(NamedTuple):
    """Corners of deforming triangles, in the frames of their actors.

    All arrays have shape (n, 3, 3).
    """

    corners: Floats  # meters
    velocities: Floats  # m/s
    at_rest: Floats  # corners in the undeformed mesh


class ActorSurfaces:
    """Positions and velocities of the actors' triangles at given times."""

    def __init__(self, triangles: StoredTriangles) -> None:
        self._triangles = triangles

    def deformed_corners(
        self,
        triangle_indices: Indices,
        actors: Integers,
        times: Floats | Ints,
        trajectories: ActorTrajectories,
    ) -> DeformedCorners:
        """Return the corners of deforming actors' triangles at the given times.

        `triangle_indices` (n,) are rows of the stored triangles, `actors` (n,) are the actors that
        they belong to, and `times` (n,) are in nanoseconds.
        """
        corners, corner_velocities, at_rest = np.empty((3, len(triangle_indices), 3, 3))
        frames, frame_rates = trajectories.animation_frames(actors, times)
        mesh_numbers = self._triangles.actor_mesh[actors]
        for mesh_number in np.unique(mesh_numbers).tolist():
            mesh = self._triangles.meshes[mesh_number]
            with_mesh = np.flatnonzero(mesh_numbers == mesh_number)
            assert mesh.animation is not None
            vertex_rows = mesh.faces[
                triangle_indices[with_mesh] - self._triangles.mesh_starts[mesh_number]
            ]
            corners[with_mesh], steps = mesh.animation.vertices_at(frames[with_mesh], vertex_rows)
            corner_velocities[with_mesh] = steps * frame_rates[with_mesh, None, None]
            at_rest[with_mesh] = mesh.vertices[vertex_rows]
        return DeformedCorners(corners, corner_velocities, at_rest)

    def _actor_rows(
        self, triangle: Integers, trajectories: ActorTrajectories
    ) -> tuple[Indices, Integers]:
        """Return the indices and the actor numbers of the triangles that belong to actors.

        The result is a pair of arrays (k,): indices into `triangle`, and actor numbers. Both are
        empty if there are no trajectories.
        """
        if not trajectories:
            return _NO_ROWS, _NO_ROWS
        row_indices = np.flatnonzero(triangle >= self._triangles.instance_starts[-1])
        objects = self._triangles.objects(triangle[row_indices])
        return row_indices, objects - self._triangles.static_objects

    def move_to_rest(
        self,
        points: Floats,
        triangle: Integers,
        triangle_indices: Indices,
        times: Floats | Ints,
        trajectories: ActorTrajectories,
    ) -> None:
        """Replace points on actors, in place, by the same points on the undeformed meshes.

        `points` (n, 3) are in the scene frame. Points on actors are replaced by the corresponding
        points in the actors' frames. Other points do not change. `triangle` (n,) are the triangles
        of all points, `triangle_indices` (n,) are the rows of the stored triangles, and `times`
        (n,) are in nanoseconds.
        """
        on_actors, actor = self._actor_rows(triangle, trajectories)
        if not len(on_actors):
            return
        positions, rotations = trajectories.poses(actor, times[on_actors].astype(np.float64))
        points[on_actors] = rotate_into_frames(points[on_actors] - positions, rotations)
        if len(deforming := trajectories.deforming_rows(actor)):
            deformed_rows = on_actors[deforming]
            deformed = self.deformed_corners(
                triangle_indices[deformed_rows],
                actor[deforming],
                times[deformed_rows],
                trajectories,
            )
            weights = _weights(deformed.corners, points[deformed_rows])
            points[deformed_rows] = matvec(deformed.at_rest.transpose(0, 2, 1), weights)

    def moved_points(
        self,
        triangle: Integers,
        points: Floats,
        times: Floats,
        later: Floats,
        trajectories: ActorTrajectories,
    ) -> Floats:
        """Return the positions at later times of points that are fixed to surfaces.

        `points` (n, 3) and the result are in the scene frame. `times` and `later` (n,) are in
        nanoseconds. Points on static surfaces do not move. A point on a deforming actor keeps its
        barycentric coordinates. Positions are NaN if the actor is absent at the later time.
        """
        moved = points.copy()
        on_actors, actor = self._actor_rows(triangle, trajectories)
        if not len(on_actors):
            return moved
        before = times[on_actors]
        after = later[on_actors]
        absent = ~trajectories.is_present(actor, after)
        after = np.where(absent, before, after)
        positions, rotations = trajectories.poses(actor, before)
        in_frames = rotate_into_frames(points[on_actors] - positions, rotations)
        if len(deforming := trajectories.deforming_rows(actor)):
            stored_rows = self._triangles.locate(triangle[on_actors[deforming]]).row
            start, end = (
                self.deformed_corners(stored_rows, actor[deforming], at[deforming], trajectories)
                for at in (before, after)
            )
            steps = (end.corners - start.corners).transpose(0, 2, 1)
            in_frames[deforming] += matvec(steps, _weights(start.corners, in_frames[deforming]))
        positions, rotations = trajectories.poses(actor, after)
        moved[on_actors] = matvec(rotations, in_frames) + positions
        moved[on_actors[absent]] = np.nan
        return moved

    def velocities(
        self,
        triangle: Integers,
        points: Floats,
        times: Floats | Ints,
        trajectories: ActorTrajectories,
    ) -> Floats:
        """Return the velocities of points on triangles in the scene frame, in m/s.

        `points` have shape (n, 3). Actors have their poses at `times` (n,) in nanoseconds.
        """
        result = np.zeros((len(triangle), 3))
        on_actors, actor = self._actor_rows(triangle, trajectories)
        for number in np.unique(actor).tolist():
            trajectory = trajectories[number]
            row_indices = on_actors[actor == number]
            if trajectory.moves:
                times_ns = times[row_indices].astype(np.float64)
                positions, _ = trajectory.poses(0, times_ns)
                velocity, rate = velocities(trajectory, 0, times_ns)
                result[row_indices] = velocity + np.cross(rate, points[row_indices] - positions)
        if len(deforming := trajectories.deforming_rows(actor)):
            row_indices = on_actors[deforming]
            result[row_indices] += self._deformation_velocities(
                triangle[row_indices],
                points[row_indices],
                times[row_indices],
                actor[deforming],
                trajectories,
            )
        return result

    def _deformation_velocities(
        self,
        triangle: Integers,
        points: Floats,
        times: Floats | Ints,
        actor: Integers,
        trajectories: ActorTrajectories,
    ) -> Floats:
        """Return the velocities, in m/s, that points have because their actors deform.

        Points (n, 3) and velocities (n, 3) are in the scene frame. `actor` (n,) are the numbers of
        the deforming actors.
        """
        times_ns = times.astype(np.float64)
        positions, rotations = trajectories.poses(actor, times_ns)
        deformed = self.deformed_corners(
            self._triangles.locate(triangle).row, actor, times_ns, trajectories
        )
        weights = _weights(deformed.corners, rotate_into_frames(points - positions, rotations))
        return matvec(rotations, matvec(deformed.velocities.transpose(0, 2, 1), weights))


def _weights(corners: Floats, points: Floats) -> Floats:
    """Return the barycentric coordinates of each point in its triangle."""
    a, b, c = corners.transpose(1, 2, 0)
    edge_1 = b - a
    edge_2 = c - a
    offset = points.T - a
    square_1 = dot(edge_1, edge_1)
    edge_product = dot(edge_1, edge_2)
    square_2 = dot(edge_2, edge_2)
    product_1 = dot(offset, edge_1)
    product_2 = dot(offset, edge_2)
    area = np.maximum(square_1 * square_2 - edge_product * edge_product, 1e-300)
    v = (square_2 * product_1 - edge_product * product_2) / area
    w = (square_1 * product_2 - edge_product * product_1) / area
    return np.stack([1 - v - w, v, w], axis=1)

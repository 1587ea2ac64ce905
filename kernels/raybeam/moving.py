"""Bodies that move while rays are cast: the rays that come near each body, and their hits.

No tree is ever built again. Consecutive rays are fired nearly at the same time: the cone around
each cell of rays, and the plane of a fan, is compared with the sphere around each body, along its
path while rays are fired; where the two meet, each ray is compared with the body's box, at its pose
when the cell is fired. The remaining rays are transformed to the body's axes at their own time, and
cast there, at near bodies first. The comparisons are loops of moving_loops.py, and decide no hit. A
cell is `CELL` consecutive rays.

A CUDA device compares each ray with a box around each body's path, and has the body's poses at all
times of the rays. A shape that deforms has frames: vertices at known times (deforming.py).
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from .arrays import Bools, Floats, Indices, Ints, Ints32
from .backend import BackendUnavailable
from .body_rays import SPAN, BodyHits, NearestHits, RayBodyPairs, TimedBodies
from .caster import RayCaster
from .deforming import DeformingMesh
from .installation import install_command
from .scan import Scan, host_rays

if TYPE_CHECKING:
    from .moving_loops import BodySamples

CHUNK_RAYS = 1 << 17  # rays at a time
CHUNK_PAIRS = 1 << 14  # pairs of cells and bodies at a time
DEVICE_RAYS = 1 << 20  # rays on a device at a time: 80 MB
CHUNK_POSES = 1 << 18  # poses on a device at a time: 25 MB
_BOXES = 128  # static boxes at a time
_CELLS_PER_SAMPLE = 256  # cells for each sample of the bodies' boxes
_NO_FRAMES = np.zeros(0)


@dataclass(frozen=True, eq=False)
class MovingBodies:
    """Moving bodies, each with a shape and a pose at every time.

    Attributes
    ----------
    shapes
        Ray casters of rigid shapes, and deforming meshes, each in the frame of its bodies.
    boxes
        float64 (s, 2, 3): lower and upper corner of the bounding box of each shape over all frames,
        in the frame of the shape, in meters.
    shape
        intp (b,): index of the shape of each body.
    presence
        float64 (b, 2): first and last time at which each body is present, in seconds.
    poses
        Function of body indices (m,) and times (m,) that returns poses (12, m): positions in
        meters, and rotation matrices from the body frame, row by row.
    frames
        Function of body indices (m,) and times (m,) that returns the frame number of the shape of
        each body, float64 (m,). It is only called for deforming bodies. Frame 1.5 is halfway
        between frames 1 and 2 of a `DeformingMesh` mesh. None if there are no deforming bodies.
    """

    shapes: tuple[RayCaster | DeformingMesh, ...]
    boxes: Floats
    shape: Indices
    presence: Floats
    poses: Callable[[Ints, Floats], Floats]
    frames: Callable[[Ints, Floats], Floats] | None = None

    @property
    def on_device(self) -> Bools:
        """Mask (b,) of the bodies whose shapes are on a CUDA device."""
        return np.array([shape.on_device for shape in self.shapes], np.bool_)[self.shape]

    @cached_property
    def box_centers(self) -> Floats:
        """Centers of the bounding boxes in the frames of the shapes, in meters. Shape (s, 3)."""
        return np.asarray(self.boxes.mean(axis=1))

    @cached_property
    def box_half_sizes(self) -> Floats:
        """Half side lengths of the bounding boxes of the shapes, in meters. Shape (s, 3)."""
        return (self.boxes[:, 1] - self.boxes[:, 0]) / 2

    @cached_property
    def radii(self) -> Floats:
        """Radii of the bounding spheres of the boxes, in meters. Shape (s,)."""
        return np.asarray(np.sqrt((self.box_half_sizes**2).sum(axis=1)))

    def is_present(self, body: Ints, times: Floats) -> Bools:
        """Return whether each body (m,) is present at its time (m,)."""
        first, last = self.presence[body].T
        return np.asarray((first <= times) & (times <= last))


def nearest_body_hits(
    moving: MovingBodies, scan: Scan, times: Callable[[Ints], Floats], limits: Floats | None = None
) -> NearestHits:
    """Return the nearest hit of each ray of a scan on a body.

    Parameters
    ----------
    moving, scan
        Bodies and rays.
    times
        Function of numbers of rays (m,) that returns their times (m,), seconds.
    limits
        float64 (n,): distance before which a hit of each ray counts, meters; None for the limit of
        the scan.

    Raises
    ------
    BackendUnavailable
        If numba is not installed.
    """
    if importlib.util.find_spec("numba") is None:
        raise BackendUnavailable(
            f"Moving bodies require numba. Install it with `{install_command('numba')}`."
        )
    from . import moving_loops as loops  # numba takes half a second to import

    end = _end(scan)
    nearest = NearestHits.empty(
        np.full(len(scan), end) if limits is None else np.minimum(limits, end)
    )
    on_device = moving.on_device
    for hits in _hits_on_device(moving, scan, times, np.flatnonzero(on_device)):
        nearest.update(hits)
    bodies = np.flatnonzero(~on_device)
    if len(bodies):
        for start, stop in scan.chunks(CHUNK_RAYS):
            rays = host_rays(scan, start, stop)
            ray_times = times(np.arange(start, stop, dtype=np.int64))
            chunk = _Chunk(loops, moving, scan, rays, ray_times, nearest.view(start, stop))
            chunk.cast(bodies)
    return nearest


def body_hits(moving: MovingBodies, scan: Scan, times: Callable[[Ints], Floats]) -> BodyHits:
    """Return the hits of `nearest_body_hits`, for the same arguments, without the rays that hit no body.

    Without host memory for each ray, if all shapes are on a device.
    """
    if not moving.on_device.all():
        return nearest_body_hits(moving, scan, times).compact()
    parts = [*_hits_on_device(moving, scan, times, np.arange(len(moving.shape)))]
    if not parts:
        return NearestHits.empty(np.zeros(0)).compact()
    return BodyHits(*map(np.concatenate, zip(*parts, strict=True)))


def _end(scan: Scan) -> float:
    """Return the distance before which hits of a scan count, meters: its limit counts."""
    return float(np.nextafter(scan.t_max, np.inf))


def _hits_on_device(
    moving: MovingBodies, scan: Scan, times: Callable[[Ints], Floats], bodies: Ints
) -> Iterator[BodyHits]:
    """Yield the nearest hits of consecutive rays of a scan on bodies (b,) on a device."""
    if not len(bodies):
        return
    limits = (scan.t_min, scan.t_max)
    step = max(1, CHUNK_POSES // (SPAN * len(bodies))) * SPAN
    shape = moving.shape[bodies]
    casters = {number: moving.shapes[number] for number in np.unique(shape).tolist()}
    for start, stop in scan.chunks(DEVICE_RAYS):
        distinct_times, time_index = _distinct(times(np.arange(start, stop, dtype=np.int64)))
        caster = casters[int(shape[0])]
        assert isinstance(caster, RayCaster)
        nearest = caster.upload_rays(scan, start, stop, time_index, _end(scan))
        for first in range(0, len(distinct_times), step):
            poses, boxes = _poses_and_boxes(moving, bodies, distinct_times[first : first + step])
            for number, caster in casters.items():
                assert isinstance(caster, RayCaster)
                column = np.flatnonzero(shape == number)
                timed = TimedBodies(
                    bodies[column],
                    np.ascontiguousarray(poses[:, column]),
                    np.ascontiguousarray(boxes[:, column]),
                    first,
                    limits,
                )
                caster.cast_bodies(timed, nearest)
        hits = nearest.compact()
        yield hits._replace(ray=hits.ray + start)


def _distinct(times: Floats) -> tuple[Floats, Ints32]:
    """Return the distinct values of times (n,), ascending, and the number of each: int32 (n,)."""
    later = times[1:] > times[:-1]
    if np.array_equal(later, times[1:] != times[:-1]):  # ascending: no sort is needed
        index = np.zeros(len(times), np.int32)
        np.cumsum(later, out=index[1:])
        return times[np.flatnonzero(np.append(True, later))], index
    distinct_times, inverse = np.unique(times, return_inverse=True)
    return distinct_times, inverse.astype(np.int32)


def _poses_and_boxes(moving: MovingBodies, bodies: Ints, times: Floats) -> tuple[Floats, Floats]:
    """Return the poses and the boxes of bodies (b,) at times (t,).

    `TimedBodies` describes poses (t, b, 12), and boxes (t / SPAN, b, 6) around the paths of bodies.
    """
    body = np.tile(bodies, len(times))
    time = np.repeat(times, len(bodies))
    present = moving.is_present(body, time)
    if present.all():
        table = moving.poses(body, time)
    else:
        rows = np.flatnonzero(present)
        table = np.full((12, len(body)), np.nan)
        table[:, rows] = moving.poses(body[rows], time[rows])
    corners = _corners(moving, moving.shape[body], table)
    lower, upper = corners.reshape(2, 3, len(times), len(bodies))
    spans = np.arange(0, len(times), SPAN)
    boxes = [np.fmin.reduceat(lower, spans, axis=1), np.fmax.reduceat(upper, spans, axis=1)]
    poses = table.T.reshape(len(times), len(bodies), 12)
    return poses, np.moveaxis(np.concatenate(boxes), 0, -1)


def _corners(moving: MovingBodies, shape: Indices, poses: Floats) -> Floats:
    """Return the lower and upper corners (2, 3, m) of boxes around shapes (m,) at poses (12, m).

    The boxes are along the axes of the scene, meters, with a margin for rounding errors.
    """
    from .moving_loops import PADS_M

    middle = moving.box_centers[shape].T
    half = moving.box_half_sizes[shape].T
    corners = np.empty((2, *middle.shape))
    for axis in range(3):
        x, y, z = poses[3 + 3 * axis : 6 + 3 * axis]
        center = poses[axis] + (x * middle[0] + y * middle[1] + z * middle[2])
        reach = np.abs(x) * half[0] + np.abs(y) * half[1] + np.abs(z) * half[2] + PADS_M
        np.subtract(center, reach, out=corners[0, axis])
        np.add(center, reach, out=corners[1, axis])
    return corners


def pair_cells_with_boxes(
    rays: Floats, times: Floats, boxes: Floats, presence: Floats, reach: float
) -> tuple[Indices, Indices, int]:
    """Return pairs of a cell of rays and a static box that may meet.

    Parameters
    ----------
    rays
        float64 (6, n): origins, meters, and directions.
    times
        float64 (n,): time of each ray, seconds.
    boxes
        float64 (b, 12): centers, and halves of the sides as vectors, meters.
    presence
        float64 (b, 2): first and last time at which each box is present.
    reach
        Greatest distance at which a ray ends, meters.

    Returns
    -------
    cell, box
        int64 (k,): numbers of cells and boxes, by box, then by cell.
    size
        Number of rays of a cell.
    """
    from . import moving_loops as loops

    cells = loops.make_cells(rays, times, loops.CELL)
    wide_cells = loops.make_cells(rays, times, loops.CELL * loops.WIDE)
    radius = np.sqrt((boxes[:, 3:] ** 2).sum(axis=1))
    spheres = np.column_stack([radius, np.full(len(boxes), loops.PADS_M), presence])
    sample_of_cell = np.zeros((len(cells), 2), np.int64)
    sampled = boxes[:, None].copy()
    parts = [np.zeros((2, 0), np.int64)]
    for first in range(0, len(boxes), _BOXES):
        span = slice(first, first + _BOXES)
        samples = loops.BodySamples(sample_of_cell, sampled[span], spheres[span])
        cell, box = loops.pair_cells_with_bodies(wide_cells, cells, samples, reach)
        parts.append(np.stack([cell, box + first]))
    cell, box = np.concatenate(parts, axis=1)
    return cell, box, loops.CELL


class _CellPoses(NamedTuple):
    """Pairs of a cell and a body, with the pose of the body for each.

    Attributes
    ----------
    cell, body
        int64 (m,): number of the cell, and of the body.
    pose
        int64 (m,): column in `poses` of the body's pose at the first time of the cell.
    poses
        float64 (12, p): positions, meters, and rotations from the bodies' axes by rows.
    pads
        float64 (m,): margin around the body's box for its motion during the cell, meters.
    straddles
        bool (m,): whether the rays of the cell have different times.
    """

    cell: Indices
    body: Ints
    pose: Ints
    poses: Floats
    pads: Floats
    straddles: Bools


class _RayPairs(NamedTuple):
    """Pairs of a ray and a body whose box the ray passes, as in `RayBodyPairs`."""

    row: Ints  # (m,), number of the ray in the chunk
    body: Ints  # (m,), number of the body
    pose: Ints  # (m,), column in `poses` of the body's pose at the time of the ray
    poses: Floats  # (12, p), positions, meters, and rotations from the bodies' axes by rows


class _Chunk:
    """Consecutive rays of a scan: float64 (6, n), their times (n,), and their nearest hits (n,)."""

    def __init__(
        self,
        loops: Any,
        moving: MovingBodies,
        scan: Scan,
        rays: Floats,
        times: Floats,
        nearest: NearestHits,
    ) -> None:
        self._loops = loops
        self._moving = moving
        self._scan = scan
        self._rays = rays
        self._times = times
        self._nearest = nearest

    def cast(self, bodies: Ints) -> None:
        """Cast the rays on the bodies that are present, and write nearer hits."""
        first, last = self._moving.presence[bodies].T
        present = bodies[(first <= self._times.max()) & (last >= self._times.min())]
        if len(present):
            self._cast_near_cells(present)

    def _cast_near_cells(self, bodies: Ints) -> None:
        """Cast the cells on bodies (b,) near them: first on near bodies, where rays then end."""
        loops = self._loops
        cells = loops.make_cells(self._rays, self._times, loops.CELL)
        wide_cells = loops.make_cells(self._rays, self._times, loops.CELL * loops.WIDE)
        samples = self._samples(bodies, cells)
        centers = samples.boxes[:, 0, :3] - cells[0, loops.MIDDLE : loops.MIDDLE + 3]
        order = np.argsort((centers**2).sum(axis=1), kind="stable")
        samples = samples._replace(boxes=samples.boxes[order], spheres=samples.spheres[order])
        reach = float(self._nearest.distance.max())
        cell, sampled_body = loops.pair_cells_with_bodies(wide_cells, cells, samples, reach)
        body = bodies[order][sampled_body]
        spans = cells[:, loops.BEGIN : loops.END + 1]
        for start in range(0, len(cell), CHUNK_PAIRS):
            pairs = slice(start, start + CHUNK_PAIRS)
            self._cast_pairs(cell[pairs], spans[cell[pairs]].T, body[pairs])

    def _samples(self, bodies: Ints, cells: Floats) -> BodySamples:
        """Return the boxes of bodies (b,) at equal steps of time over cells (c, 15)."""
        loops = self._loops
        moving = self._moving
        spans = cells[:, loops.BEGIN : loops.END + 1]
        first = spans[:, 0].min()
        last = spans[:, 1].max()
        steps = max(1, len(cells) // _CELLS_PER_SAMPLE)
        step = (last - first) / steps
        sample_of_cell = ((spans - first) / (step or 1)).astype(np.int64).clip(0, steps)
        times = np.linspace(first, last, steps + 1)
        times = np.clip(times, *moving.presence[bodies].T[:, :, None])
        boxes = self._sampled_boxes(bodies, times)
        change = np.abs(np.diff(boxes, axis=1))
        slack = 2 * change.sum(axis=2).max(axis=1) + loops.PADS_M
        radius = moving.radii[moving.shape[bodies]]
        spheres = np.column_stack([radius, slack, moving.presence[bodies]])
        samples: BodySamples = loops.BodySamples(sample_of_cell, boxes, spheres)
        return samples

    def _sampled_boxes(self, bodies: Ints, times: Floats) -> Floats:
        """Return the boxes (b, s, 12) of bodies (b,) at times (b, s), as in `BodySamples`."""
        moving = self._moving
        body = np.repeat(bodies, times.shape[1])
        table = moving.poses(body, times.ravel())
        rotations = _rotations(table)
        shape = moving.shape[body]
        centers = table[:3].T + _rotated(rotations, moving.box_centers[shape])
        halves = rotations.transpose(0, 2, 1) * moving.box_half_sizes[shape][..., None]
        boxes = np.empty((*times.shape, 12))
        boxes[..., :3] = centers.reshape(len(bodies), -1, 3)
        boxes[..., 3:] = halves.reshape(len(bodies), -1, 9)
        return boxes

    def _cast_pairs(self, cell: Indices, spans: Floats, body: Ints) -> None:
        """Cast each cell (m,) on its body (m,), and write nearer hits.

        `spans` (2, m) are the first and last time of each cell, seconds.
        """
        cell_poses = self._cell_poses(cell, spans, body)
        pairs = self._passing_rays(cell_poses)
        moving = self._moving
        boxes = moving.boxes.reshape(-1, 6)
        limits = (self._scan.t_min, self._scan.t_max)
        shape = moving.shape[pairs.body]
        several = len(moving.shapes) > 1
        for number in np.unique(shape).tolist() if several else [0]:
            rows = shape == number if several else slice(None)
            row = pairs.row[rows]
            body = pairs.body[rows]
            caster = moving.shapes[number]
            frame = _NO_FRAMES
            if isinstance(caster, DeformingMesh):
                assert moving.frames is not None, "of bodies that deform"
                frame = moving.frames(body, self._times[row])
            ray_body_pairs = RayBodyPairs(
                rays=self._rays,
                row=row,
                body=body,
                pose=pairs.pose[rows],
                poses=pairs.poses,
                box=boxes[number],
                limits=limits,
                frame=frame,
            )
            caster.cast_pairs(ray_body_pairs, self._nearest)

    def _cell_poses(self, cell: Indices, spans: Floats, body: Ints) -> _CellPoses:
        """Return pairs of a cell and a body (m,) with the body's pose and the margin of its box."""
        moving = self._moving
        starts, stops = np.clip(spans, *moving.presence[body].T)
        new = (np.diff(body, prepend=-1) != 0) | (np.diff(starts, prepend=np.nan) != 0)
        pose = np.cumsum(new) - 1  # consecutive cells of a body may have the same first time
        poses = moving.poses(body[new], starts[new])
        pads = np.full(len(cell), self._loops.PADS_M)
        straddles = spans[1] > spans[0]
        late = np.flatnonzero(straddles)
        if len(late):  # a margin for the motion until the cell's last time
            change = np.abs(moving.poses(body[late], stops[late]) - poses[:, pose[late]])
            size = np.abs(moving.boxes).max(axis=(1, 2))[moving.shape[body[late]]]
            pads[late] += 2 * (change[:3].sum(axis=0) + size * change[3:].sum(axis=0))
        return _CellPoses(cell, body, pose, poses, pads, straddles)

    def _passing_rays(self, pairs: _CellPoses) -> _RayPairs:
        """Return the rays of cells that pass through bodies' boxes, and their poses.

        A ray of a cell with several times has the pose at its own time.
        """
        loops = self._loops
        moving = self._moving
        times = self._times
        shape = moving.shape[pairs.body]
        cell_pairs = loops.CellBodyPairs(pairs.cell, pairs.pose, shape, pairs.pads)
        boxes = moving.boxes.reshape(-1, 6)
        row, pair = loops.rays_through_boxes(
            self._rays, self._nearest.distance, cell_pairs, pairs.poses, boxes
        )
        body = pairs.body[pair]
        pose = pairs.pose[pair]
        if not pairs.straddles.any():
            return _RayPairs(row, body, pose, pairs.poses)
        # A body may be present at the cell's first time, and absent at the time of a ray.
        present = moving.is_present(body, times[row])
        if not present.all():
            row = row[present]
            body = body[present]
            pose = pose[present]
            pair = pair[present]
        late = pairs.straddles[pair]
        if late.all():  # true for a lidar whose lasers take turns
            return _RayPairs(row, body, np.arange(len(row)), moving.poses(body, times[row]))
        late_rows = np.flatnonzero(late)
        pose[late_rows] = pairs.poses.shape[1] + np.arange(len(late_rows))
        late_poses = moving.poses(body[late_rows], times[row[late_rows]])
        return _RayPairs(row, body, pose, np.concatenate([pairs.poses, late_poses], axis=1))


def _rotations(poses: Floats) -> Floats:
    """Return the rotations (m, 3, 3) from the bodies' axes of poses (12, m) of `MovingBodies.poses`."""
    return poses[3:].reshape(3, 3, -1).transpose(2, 0, 1)


def _rotated(rotations: Floats, vectors: Floats) -> Floats:
    """Return vectors (m, 3) or (1, 3) rotated by matrices (m, 3, 3), in a fixed order."""
    return (rotations * vectors[:, None, :]).sum(axis=2)

"""Cast rays at bodies that move while the rays are fired.

No tree is rebuilt. On the CPU, consecutive rays, which are fired at almost the same time, form
cells of `CELL_RAYS` rays. First, the cone and the plane around the directions of each cell are
compared with the bounding sphere of each body along its path. Then the rays of the remaining cells
are compared with the body's bounding box, at the pose that the body has when the cell is fired.
Finally, the remaining rays are transformed to the frame of the body at their own firing times and
cast at its shape, starting with the closest bodies. The comparisons are compiled loops
(moving_loops.py). They are conservative, so they do not affect the hits.

On a CUDA device, each ray is compared with boxes around the paths of the bodies, and the device
holds the poses of all bodies at all ray times.

A deforming shape has frames, which are its vertices at known times (deforming.py).
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
from .body_rays import TIMES_PER_BOX, BodyHits, NearestHits, RayBodyPairs, TimedBodies
from .caster import RayCaster
from .deforming import DeformingMesh
from .installation import install_command
from .scan import Scan, host_rays

if TYPE_CHECKING:
    from .moving_loops import BodySamples

CHUNK_RAYS = 1 << 17  # rays that are processed at a time
CHUNK_PAIRS = 1 << 14  # pairs of cells and bodies that are processed at a time
DEVICE_RAYS = 1 << 20  # rays on a device at a time, which take 80 MB
CHUNK_POSES = 1 << 18  # poses on a device at a time, which take 25 MB
_BOXES = 128  # static boxes that are compared at a time
_CELLS_PER_SAMPLE = 256  # number of cells for which the boxes of the bodies are sampled once
_NO_FRAMES = np.zeros(0)


@dataclass(frozen=True, eq=False)
class MovingBodies:
    """Moving bodies, each of which has a shape and a pose that depends on time.

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
        between frames 1 and 2 of a `DeformingMesh`. None if there are no deforming bodies.
    """

    shapes: tuple[RayCaster | DeformingMesh, ...]
    boxes: Floats
    shape: Indices
    presence: Floats
    poses: Callable[[Ints, Floats], Floats]
    frames: Callable[[Ints, Floats], Floats] | None = None

    @property
    def on_device(self) -> Bools:
        """Mask of the bodies whose shape is on a CUDA device. Shape (b,)."""
        return np.array([shape.on_device for shape in self.shapes], np.bool_)[self.shape]

    @cached_property
    def box_centers(self) -> Floats:
        """Center of each shape's bounding box in the shape's frame, in meters. Shape (s, 3)."""
        return np.asarray(self.boxes.mean(axis=1))

    @cached_property
    def box_half_sizes(self) -> Floats:
        """Half the dimensions of each shape's bounding box, in meters. Shape (s, 3)."""
        return (self.boxes[:, 1] - self.boxes[:, 0]) / 2

    @cached_property
    def radii(self) -> Floats:
        """Radius of a sphere around each shape's bounding box, in meters. Shape (s,)."""
        return np.asarray(np.sqrt((self.box_half_sizes**2).sum(axis=1)))

    def is_present(self, body: Ints, times: Floats) -> Bools:
        """Return whether each body is present at the given time."""
        first, last = self.presence[body].T
        return np.asarray((first <= times) & (times <= last))


def nearest_body_hits(
    moving: MovingBodies, scan: Scan, times: Callable[[Ints], Floats], limits: Floats | None = None
) -> NearestHits:
    """Return the closest hit of each ray in a scan on a moving body.

    Parameters
    ----------
    moving
        The bodies.
    scan
        The rays.
    times
        Function of ray indices (m,) that returns the firing times (m,) in seconds.
    limits
        float64 (n,): only hits at a shorter distance are returned, in meters. None for the maximum
        range of the scan.

    Raises
    ------
    BackendUnavailable
        If numba is not installed.
    """
    if importlib.util.find_spec("numba") is None:
        raise BackendUnavailable(
            f"Moving bodies require numba. Install it with `{install_command('numba')}`."
        )
    from . import moving_loops as loops  # Importing numba takes half a second.

    end = _exclusive_limit(scan)
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
    """Return the result of `nearest_body_hits` only for the rays that hit a body.

    If all shapes are on a device, no host memory per ray is needed.
    """
    if not moving.on_device.all():
        return nearest_body_hits(moving, scan, times).compact()
    parts = [*_hits_on_device(moving, scan, times, np.arange(len(moving.shape)))]
    if not parts:
        return NearestHits.empty(np.zeros(0)).compact()
    return BodyHits(*map(np.concatenate, zip(*parts, strict=True)))


def _exclusive_limit(scan: Scan) -> float:
    """Return the shortest distance that exceeds a scan's maximum range, in meters.

    The maximum range is inclusive, but the limits of `NearestHits` are not.
    """
    return float(np.nextafter(scan.t_max, np.inf))


def _hits_on_device(
    moving: MovingBodies, scan: Scan, times: Callable[[Ints], Floats], bodies: Ints
) -> Iterator[BodyHits]:
    """Yield the closest hits of rays on those bodies whose shape is on a CUDA device."""
    if not len(bodies):
        return
    limits = (scan.t_min, scan.t_max)
    step = max(1, CHUNK_POSES // (TIMES_PER_BOX * len(bodies))) * TIMES_PER_BOX
    shape = moving.shape[bodies]
    casters = {number: moving.shapes[number] for number in np.unique(shape).tolist()}
    for start, stop in scan.chunks(DEVICE_RAYS):
        distinct_times, time_index = _distinct(times(np.arange(start, stop, dtype=np.int64)))
        caster = casters[int(shape[0])]
        assert isinstance(caster, RayCaster)
        nearest = caster.upload_rays(scan, start, stop, time_index, _exclusive_limit(scan))
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
    """Return the distinct times in ascending order, and the index of each given time among them."""
    later = times[1:] > times[:-1]
    if np.array_equal(later, times[1:] != times[:-1]):  # ascending, so sorting is not necessary
        index = np.zeros(len(times), np.int32)
        np.cumsum(later, out=index[1:])
        return times[np.flatnonzero(np.append(True, later))], index
    distinct_times, inverse = np.unique(times, return_inverse=True)
    return distinct_times, inverse.astype(np.int32)


def _poses_and_boxes(moving: MovingBodies, bodies: Ints, times: Floats) -> tuple[Floats, Floats]:
    """Compute the fields `poses` and `boxes` of `TimedBodies` for bodies at given times."""
    body = np.tile(bodies, len(times))
    time = np.repeat(times, len(bodies))
    present = moving.is_present(body, time)
    if present.all():
        table = moving.poses(body, time)
    else:
        rows = np.flatnonzero(present)
        table = np.full((12, len(body)), np.nan)
        table[:, rows] = moving.poses(body[rows], time[rows])
    corners = _bounding_boxes(moving, moving.shape[body], table)
    lower, upper = corners.reshape(2, 3, len(times), len(bodies))
    spans = np.arange(0, len(times), TIMES_PER_BOX)
    boxes = [np.fmin.reduceat(lower, spans, axis=1), np.fmax.reduceat(upper, spans, axis=1)]
    poses = table.T.reshape(len(times), len(bodies), 12)
    return poses, np.moveaxis(np.concatenate(boxes), 0, -1)


def _bounding_boxes(moving: MovingBodies, shape: Indices, poses: Floats) -> Floats:
    """Compute the bounding boxes of shapes that are placed at poses.

    The poses have shape (12, m), and the boxes have shape (2, 3, m) and contain the lower and upper
    corners in meters. The boxes are aligned with the axes of the scene and include a margin for
    rounding errors.
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
    """Find pairs of a cell (a group of rays) and a static box that the cell's rays may intersect.

    Parameters
    ----------
    rays
        float64 (6, n): origins in meters and directions.
    times
        float64 (n,): firing times in seconds.
    boxes
        float64 (b, 12): center of each box, and its three half side vectors, in meters.
    presence
        float64 (b, 2): first and last time at which each box is present.
    reach
        Maximum distance at which a ray ends, in meters.

    Returns
    -------
    cell, box
        int64 (k,): indices of cells and boxes, sorted by box and then by cell.
    size
        Number of rays per cell.
    """
    from . import moving_loops as loops

    cells = loops.make_cells(rays, times, loops.CELL_RAYS)
    wide_cells = loops.make_cells(rays, times, loops.CELL_RAYS * loops.CELLS_PER_WIDE_CELL)
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
    return cell, box, loops.CELL_RAYS


class _CellPoses(NamedTuple):
    """Pairs of a cell and a body, with the pose of the body when the cell is fired.

    Attributes
    ----------
    cell, body
        int64 (m,): indices of the cell and of the body.
    pose
        int64 (m,): column in `poses` that contains the pose of the body at the first time of the
        cell.
    poses
        float64 (12, p): positions in meters, and rotation matrices from the body frames, row by
        row.
    pads
        float64 (m,): margin around the box of the body, in meters, for its motion while the cell is
        fired.
    has_several_times
        bool (m,): whether the rays of the cell are fired at different times.
    """

    cell: Indices
    body: Ints
    pose: Ints
    poses: Floats
    pads: Floats
    has_several_times: Bools


class _RayPairs(NamedTuple):
    """Pairs of a ray and a body whose bounding box it intersects, as in `RayBodyPairs`."""

    row: Ints  # (m,): index of the ray in the chunk
    body: Ints  # (m,): index of the body
    pose: Ints  # (m,): column in `poses` with the body's pose at the time of the ray
    poses: Floats  # (12, p): positions in meters, and rotation matrices, row by row


class _Chunk:
    """Consecutive rays in a scan, with their firing times and closest hits."""

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
        """Cast the rays at all bodies that are present, and record closer hits."""
        first, last = self._moving.presence[bodies].T
        present = bodies[(first <= self._times.max()) & (last >= self._times.min())]
        if len(present):
            self._cast_near_cells(present)

    def _cast_near_cells(self, bodies: Ints) -> None:
        """Cast each cell at the bodies that it may hit, starting with the closest bodies.

        The hits on close bodies shorten the rays for the following bodies.
        """
        loops = self._loops
        cells = loops.make_cells(self._rays, self._times, loops.CELL_RAYS)
        wide_cells = loops.make_cells(
            self._rays, self._times, loops.CELL_RAYS * loops.CELLS_PER_WIDE_CELL
        )
        samples = self._sample_bodies(bodies, cells)
        centers = samples.boxes[:, 0, :3] - cells[0, loops.CENTER : loops.CENTER + 3]
        order = np.argsort((centers**2).sum(axis=1), kind="stable")
        samples = samples._replace(boxes=samples.boxes[order], spheres=samples.spheres[order])
        reach = float(self._nearest.distance.max())
        cell, sampled_body = loops.pair_cells_with_bodies(wide_cells, cells, samples, reach)
        body = bodies[order][sampled_body]
        spans = cells[:, loops.FIRST_TIME : loops.LAST_TIME + 1]
        for start in range(0, len(cell), CHUNK_PAIRS):
            pairs = slice(start, start + CHUNK_PAIRS)
            self._cast_pairs(cell[pairs], spans[cell[pairs]].T, body[pairs])

    def _sample_bodies(self, bodies: Ints, cells: Floats) -> BodySamples:
        """Sample the boxes of bodies at regular time steps while the given cells are fired."""
        loops = self._loops
        moving = self._moving
        spans = cells[:, loops.FIRST_TIME : loops.LAST_TIME + 1]
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
        """Compute the boxes of bodies at the given times, as in `BodySamples`. Shape (b, s, 12)."""
        moving = self._moving
        body = np.repeat(bodies, times.shape[1])
        table = moving.poses(body, times.ravel())
        rotations = _rotations(table)
        shape = moving.shape[body]
        centers = table[:3].T + _rotate(rotations, moving.box_centers[shape])
        halves = rotations.transpose(0, 2, 1) * moving.box_half_sizes[shape][..., None]
        boxes = np.empty((*times.shape, 12))
        boxes[..., :3] = centers.reshape(len(bodies), -1, 3)
        boxes[..., 3:] = halves.reshape(len(bodies), -1, 9)
        return boxes

    def _cast_pairs(self, cell: Indices, spans: Floats, body: Ints) -> None:
        """Cast the rays of each cell at the cell's body, and record closer hits.

        `spans` (2, m) contains the first and last time of each cell in seconds.
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
                assert moving.frames is not None, "required for deforming bodies"
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
        """Return each body's pose at the first time of its cell, and a margin for its motion."""
        moving = self._moving
        starts, stops = np.clip(spans, *moving.presence[body].T)
        new = (np.diff(body, prepend=-1) != 0) | (np.diff(starts, prepend=np.nan) != 0)
        # Consecutive cells may have the same first time and then share a pose.
        pose = np.cumsum(new) - 1
        poses = moving.poses(body[new], starts[new])
        pads = np.full(len(cell), self._loops.PADS_M)
        has_several_times = spans[1] > spans[0]
        late = np.flatnonzero(has_several_times)
        if len(late):  # Add a margin for the motion until the last time of the cell.
            change = np.abs(moving.poses(body[late], stops[late]) - poses[:, pose[late]])
            size = np.abs(moving.boxes).max(axis=(1, 2))[moving.shape[body[late]]]
            pads[late] += 2 * (change[:3].sum(axis=0) + size * change[3:].sum(axis=0))
        return _CellPoses(cell, body, pose, poses, pads, has_several_times)

    def _passing_rays(self, pairs: _CellPoses) -> _RayPairs:
        """Find the rays that intersect a body's bounding box. Return them with the body's pose.

        If the rays of a cell are fired at different times, each ray gets the pose at its own time.
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
        if not pairs.has_several_times.any():
            return _RayPairs(row, body, pose, pairs.poses)
        # A body that is present at the first time of the cell may be absent at the time of a ray.
        present = moving.is_present(body, times[row])
        if not present.all():
            row = row[present]
            body = body[present]
            pose = pose[present]
            pair = pair[present]
        late = pairs.has_several_times[pair]
        if late.all():  # This is the case for a lidar whose lasers fire one after the other.
            return _RayPairs(row, body, np.arange(len(row)), moving.poses(body, times[row]))
        late_rows = np.flatnonzero(late)
        pose[late_rows] = pairs.poses.shape[1] + np.arange(len(late_rows))
        late_poses = moving.poses(body[late_rows], times[row[late_rows]])
        return _RayPairs(row, body, pose, np.concatenate([pairs.poses, late_poses], axis=1))


def _rotations(poses: Floats) -> Floats:
    return poses[3:].reshape(3, 3, -1).transpose(2, 0, 1)


def _rotate(rotations: Floats, vectors: Floats) -> Floats:
    """Multiply matrices by vectors in a fixed order of operations."""
    return (rotations * vectors[:, None, :]).sum(axis=2)

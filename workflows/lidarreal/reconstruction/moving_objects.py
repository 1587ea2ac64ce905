"""Find the tracks of moving objects, from labeled boxes or from clusters of points that moved.

A track from clusters is extended to sweeps in which the object was slow or stationary, so that the
object is complete, and so that the scene does not contain it where it was parked.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from lidarfiles.clouds.recorded_boxes import RecordedBoxes
from lidarsim.numerics.arrays import Bools, Floats, Ints

from .alignment import Alignment
from .moving_rays import MovingRays
from .object_clusters import MIN_PATH_M, MIN_SWEEPS, ClusterTrack, bounding_boxes, track_clusters
from .object_poses import Shape, Sighting, adjust_poses, first_poses, register, velocities_of
from .object_tracks import ObjectTrack, in_any_box, rotate_z
from .voxel_planes import cell_keys

_VOXEL_M = 0.2  # edge length of the voxels in which points are counted
_MAX_VOXEL_RATIO = 0.8  # maximum number of these voxels relative to a stationary object
_AROUND_M = 1.0  # distance from a box within which the ground is sought
_MAX_CLEARANCE_M = 0.5  # maximum height of the lowest points of an object above the ground
_MIN_GROUND = 20  # minimum number of returns around an object
_GROUND_QUANTILE = 0.25  # quantile of the heights of these returns
_CLEARANCE_M = 0.05  # height of the lowest points above the underside of a box
_EXTENT = (0.002, 0.998)  # quantiles of coordinates that limit a box
_MIN_SIZE_M = 0.3
_MIN_RETURNS = 5  # minimum number of points of an object in a sweep
_MIN_SHARE = 0.15  # minimum number of points relative to the neighboring sweep
_MAX_RESIDUAL_M = 0.06  # maximum median distance of points from planes in a further sweep
_MIN_MATCHED = 0.6  # minimum share of points in a further sweep that are close to the shape
_LABEL_GAP_S = 0.3  # Labeled poses further from all observed poses are kept.
_GROWTH_M = 1.5  # margin of a box in which points of clusters belong to the object
_MIN_STEP_S = 1e-3  # minimum time between the poses of a track
_TRIMMED_SWEEPS = 5  # Sweeps at the ends of a track whose clusters are often incomplete.
_ACCELERATION_M_S2 = 3.0  # standard deviation of the acceleration
_MAX_GAP_SWEEPS = 3  # maximum number of sweeps without points before an object is lost
_STANDING_M_S = 0.4  # maximum speed at an end of the track of an object that is stationary there
_STANDING_SWEEPS = 3  # sweeps at this end that determine the speed
_MIN_UNCLAIMED = 0.5  # minimum share of points that do not belong to another object
_TRACK_MARGIN_M = 0.3  # margin around a predicted box
_BOTTOM_M = 0.05  # Points this close to the underside of a predicted box may be on the ground.


class LabeledTracks(NamedTuple):
    """Tracks of moving objects from the labeled boxes of a recording."""

    all: Sequence[ObjectTrack]
    in_mapped: Sequence[ObjectTrack]  # from the labels of the sweeps that form the map

    @classmethod
    def from_boxes(
        cls, boxes: RecordedBoxes | None, alignment: Alignment, mapped: Ints
    ) -> LabeledTracks | None:
        """Return the tracks, or None without boxes of identified objects.

        `mapped` are the numbers of the sweeps that form the map.
        """
        if boxes is None or not boxes.are_tracked:
            return None
        return cls(_labeled(boxes, alignment), _labeled(boxes, alignment, mapped))


def _labeled(
    boxes: RecordedBoxes, alignment: Alignment, numbers: Ints | None = None
) -> list[ObjectTrack]:
    """Return the tracks of labeled objects that move, from all sweeps or those in `numbers`."""
    used = boxes.sweep < len(alignment.poses)  # A part of a recording has the boxes of all sweeps.
    if numbers is not None:
        used &= np.isin(boxes.sweep, numbers)
    tracks = []
    for number in np.unique(boxes.object[used]).tolist():
        rows = np.flatnonzero(used & (boxes.object == number))
        rows = rows[np.unique(boxes.sweep[rows], return_index=True)[1]]
        sweeps = boxes.sweep[rows]
        world = alignment.poses[sweeps] @ boxes.poses[rows]
        size = np.maximum(np.median(boxes.sizes[rows], axis=0), _MIN_SIZE_M)
        positions = world[:, :3, 3] - world[:, :3, 2] * size[2] / 2
        yaw = np.unwrap(np.arctan2(world[:, 1, 0], world[:, 0, 0]))
        kind = boxes.kinds[int(rows[0])]
        track = ObjectTrack(number, kind, size, alignment.times_s[sweeps], positions, yaw)
        if len(track) > 1 and track.distance_m > MIN_PATH_M:
            tracks.append(_with_standstills(track))
    return tracks


def find_tracks(
    rays: MovingRays, labeled: Sequence[ObjectTrack] | None, sweep_s: float
) -> list[ObjectTrack]:
    """Determine the tracks of moving objects.

    Parameters
    ----------
    rays
        Rays near moving objects.
    labeled
        Boxes of moving objects from labels, or None to find the objects.
    sweep_s
        Typical time between sweeps in seconds.
    """
    if labeled is not None:
        return [_adjust_labeled(track, rays) for track in labeled]
    slices = rays.slices()
    observed = []
    for number, rows in slices.items():
        one = rays.select(rows)
        clusters = bounding_boxes(one.ends, one.cluster)
        observed.append((number, float(one.time_s.mean()), clusters))
    candidates = track_clusters(observed, sweep_s)
    candidates.sort(key=lambda one: -one.points)
    claimed = np.zeros(len(rays.sweep), bool)
    tracks: list[ObjectTrack] = []
    for candidate in candidates:
        found = _follow(candidate, rays, slices, claimed, sweep_s)
        if found is None:
            continue
        tracks.append(replace(found, number=len(tracks) + 1))
        claimed |= in_any_box([found], rays.ends, rays.time_s)
    return tracks


def _adjust_labeled(track: ObjectTrack, rays: MovingRays) -> ObjectTrack:
    """Register the points in labeled boxes, and adjust the poses of the boxes."""
    inside = rays.returned & in_any_box([track], rays.ends, rays.time_s)
    sightings = _sightings(rays, inside)
    if len(sightings) < 2:
        return track
    times_s = np.array([one.time_s for one in sightings])
    labeled = np.column_stack(track.poses(times_s))
    poses = adjust_poses(sightings, labeled, labeled)
    offset = (poses - labeled).mean(axis=0)  # keep the boxes around the objects
    adjusted = _with_poses(track, times_s, poses - offset)
    # Labeled poses remain where there are no points.
    far = np.abs(track.times_s[:, None] - times_s).min(axis=1) > _LABEL_GAP_S
    if not far.any():
        return adjusted
    order = np.argsort(np.append(times_s, track.times_s[far]), kind="stable")
    return replace(
        adjusted,
        times_s=np.append(times_s, track.times_s[far])[order],
        positions=np.concatenate([adjusted.positions, track.positions[far]])[order],
        yaw=np.unwrap(np.append(adjusted.yaw, track.yaw[far])[order]),
    )


def _sightings(rays: MovingRays, chosen: Bools) -> list[Sighting]:
    """Return the chosen returns of each sweep that has enough of them."""
    rows = np.flatnonzero(chosen)
    groups = np.split(rows, np.flatnonzero(np.diff(rays.sweep[rows])) + 1)
    sightings: list[Sighting] = []
    for group in groups:
        if len(group) >= _MIN_RETURNS:
            sighting = Sighting.from_rays(rays, group)
            if _is_later(sighting, sightings):
                sightings.append(sighting)
    return sightings


def _is_later(sighting: Sighting, previous: Sequence[Sighting]) -> bool:
    """Check whether a sighting is later than the previous ones.

    If an object is where the sweeps begin and end, the mean time of its points can precede that of
    the previous sweep.
    """
    return not previous or sighting.time_s - previous[-1].time_s >= _MIN_STEP_S


def _with_poses(track: ObjectTrack, times_s: Floats, poses: Floats) -> ObjectTrack:
    return replace(track, times_s=times_s, positions=poses[:, :3], yaw=np.unwrap(poses[:, 3]))


def _follow(
    candidate: ClusterTrack,
    rays: MovingRays,
    slices: dict[int, slice],
    claimed: Bools,
    sweep_s: float,
) -> ObjectTrack | None:
    """Return the track of an object, or None if it belongs to an object that is known already."""
    sightings: list[Sighting] = []
    centers = []
    for number, position, cluster, index in zip(
        candidate.sweeps, candidate.path, candidate.clusters, candidate.indices, strict=True
    ):
        start = slices[number].start
        rows = start + np.flatnonzero(rays.cluster[slices[number]] == index)
        free = rows[~claimed[rows]]
        if len(free) < max(_MIN_UNCLAIMED * len(rows), _MIN_RETURNS):
            continue
        sighting = Sighting.from_rays(rays, free)
        if not _is_later(sighting, sightings):
            continue
        sightings.append(sighting)
        centers.append(np.append(position[:2], cluster.low[2]))
    if len(sightings) < MIN_SWEEPS:
        return None
    poses = first_poses(sightings, np.array(centers))
    poses = adjust_poses(sightings, poses)
    track = _boxed(sightings, poses)
    trimmed = min(_TRIMMED_SWEEPS, (len(track) - MIN_SWEEPS) // 2)
    track = track.select(slice(trimmed, len(track) - trimmed))
    for step in (1, -1):
        track = _extend(track, rays, slices, claimed, step, sweep_s)
    # Sides that were not visible in the clusters of the track may be outside its box.
    inside = in_any_box([track], rays.ends, rays.time_s)
    inside |= (rays.cluster >= 0) & in_any_box([track], rays.ends, rays.time_s, _GROWTH_M)
    sightings = _sightings(rays, inside & rays.returned & ~claimed)
    if len(sightings) < MIN_SWEEPS:
        return None
    times_s = np.array([one.time_s for one in sightings])
    poses = adjust_poses(sightings, np.column_stack(track.poses(times_s)))
    track = _boxed(sightings, poses)
    if track.distance_m < MIN_PATH_M or _voxel_ratio(sightings, poses) > _MAX_VOXEL_RATIO:
        return None
    track = _on_ground(track, rays)
    return _with_standstills(track)


def _voxel_ratio(sightings: Sequence[Sighting], poses: Floats) -> float:
    """Return the number of voxels with points in the object frame, relative to the world frame.

    The points of a moving object fill fewer voxels in its own frame.
    """
    own = np.concatenate(_local_points(sightings, poses))
    world = np.concatenate([one.points for one in sightings])
    own_count, world_count = (
        len(np.unique(cell_keys(points, _VOXEL_M))) for points in (own, world)
    )
    return own_count / world_count


def _local_points(sightings: Sequence[Sighting], poses: Floats) -> list[Floats]:
    """Return the points of each sighting in the object frame."""
    velocities = velocities_of(np.array([one.time_s for one in sightings]), poses)
    return [
        one.local(pose, velocity)
        for one, pose, velocity in zip(sightings, poses, velocities, strict=True)
    ]


def _with_standstills(track: ObjectTrack) -> ObjectTrack:
    """Determine whether an object is stationary before and after its track."""
    before, after = (_end_speed(track, end) < _STANDING_M_S for end in (0, -1))
    return replace(track, stands_before=before, stands_after=after)


def _boxed(sightings: Sequence[Sighting], poses: Floats) -> ObjectTrack:
    """Return a track whose box encloses the points in their object frame."""
    times_s = np.array([one.time_s for one in sightings])
    local = np.concatenate(_local_points(sightings, poses))
    low, high = np.quantile(local, _EXTENT, axis=0)
    low[2] -= _CLEARANCE_M
    center = np.array([(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, low[2]])
    positions = poses[:, :3] + rotate_z(np.tile(center, (len(poses), 1)), poses[:, 3])
    size = np.maximum(high - low, _MIN_SIZE_M)
    return ObjectTrack(0, "", size, times_s, positions, np.unwrap(poses[:, 3]))


def _on_ground(track: ObjectTrack, rays: MovingRays) -> ObjectTrack:
    """Lower the underside of a box to the ground around it, if the ground returned pulses."""
    reach_m = float(np.hypot(*(track.size[:2] / 2 + _AROUND_M)))
    still = track.rows_near(rays.ends, rays.time_s, reach_m)
    still = still[(rays.returned & ~rays.moved)[still]]
    local = track.to_object(rays.ends[still], rays.time_s[still])
    apart = np.abs(local[:, :2]) - track.size[:2] / 2
    around = (apart < _AROUND_M).all(axis=1) & (apart > 0).any(axis=1)
    heights = local[around & (np.abs(local[:, 2]) < _MAX_CLEARANCE_M), 2]
    if len(heights) < _MIN_GROUND:
        return track
    lower = np.array([0.0, 0.0, min(float(np.quantile(heights, _GROUND_QUANTILE)), 0.0)])
    return replace(track, positions=track.positions + lower, size=track.size - lower)


def _extend(
    track: ObjectTrack,
    rays: MovingRays,
    slices: dict[int, slice],
    claimed: Bools,
    step: int,
    sweep_s: float,
) -> ObjectTrack:
    """Follow an object to further sweeps after (`step` 1) or before (-1) its track."""
    inside = rays.returned & ~claimed & in_any_box([track], rays.ends, rays.time_s)
    shape = Shape.from_points(track.to_object(rays.ends[inside], rays.time_s[inside]))
    end = -1 if step == 1 else 0
    count = int(inside[rays.time_s >= track.times_s[-2]].sum() / 2)
    if step == -1:
        count = int(inside[rays.time_s <= track.times_s[1]].sum() / 2)
    missed = 0
    for number in sorted(slices)[::step]:
        rows = slices[number]
        time_s = float(rays.time_s[rows].mean())
        if step * (time_s - track.times_s[end]) < 0.5 * sweep_s:
            continue
        if missed > _MAX_GAP_SWEEPS or abs(time_s - track.times_s[end]) > (
            (_MAX_GAP_SWEEPS + 1.5) * sweep_s
        ):
            break
        further = _further_pose(track, shape, rays, rows, claimed, end, count)
        if further is None:
            missed += 1
            continue
        missed = 0
        time_s, pose, count = further
        track = _append(track, time_s, pose, step)
    return track


def _further_pose(
    track: ObjectTrack,
    shape: Shape,
    rays: MovingRays,
    rows: slice,
    claimed: Bools,
    end: int,
    count: int,
) -> tuple[float, Floats, int] | None:
    """Return the time, pose and number of points of an object in a further sweep, if it is there.

    `count` is the number of points in the preceding sweep.
    """
    moving = replace(track, stands_before=False, stands_after=False)
    local = moving.to_object(rays.ends[rows], rays.time_s[rows])
    near = np.abs(local[:, :2]) < track.size[:2] / 2 + _TRACK_MARGIN_M
    near &= (local[:, 2:] > _BOTTOM_M) & (local[:, 2:] < track.size[2] + _TRACK_MARGIN_M)
    chosen = np.flatnonzero(near.all(axis=1) & rays.returned[rows] & ~claimed[rows])
    if len(chosen) < max(_MIN_RETURNS, _MIN_SHARE * count):
        return None
    sighting = Sighting.from_rays(rays, chosen + rows.start)
    predicted = np.column_stack(moving.poses(np.array([sighting.time_s])))[0]
    step_s = sighting.time_s - track.times_s[end]
    if (-step_s if end == 0 else step_s) < _MIN_STEP_S:
        return None
    inner = 1 if end == 0 else -2
    velocity = np.append(track.positions[end] - track.positions[inner], 0.0)
    velocity /= track.times_s[end] - track.times_s[inner]
    prior = np.array([0.03, 0.03, 0.05, 0.05])
    prior[:2] += _ACCELERATION_M_S2 * step_s**2
    pose, equations = register(shape, sighting, predicted, velocity, prior)
    if equations.matched < _MIN_MATCHED or equations.residual_m > _MAX_RESIDUAL_M:
        return None
    return sighting.time_s, pose, len(chosen)


def _append(track: ObjectTrack, time_s: float, pose: Floats, step: int) -> ObjectTrack:
    """Add a pose at the end (`step` 1) or at the start (-1) of a track."""
    times_s = [track.times_s, np.array([time_s])][::step]
    positions = [track.positions, pose[None, :3]][::step]
    yaw = [track.yaw, pose[3:]][::step]
    return replace(
        track,
        times_s=np.concatenate(times_s),
        positions=np.concatenate(positions),
        yaw=np.unwrap(np.concatenate(yaw)),
    )


def _end_speed(track: ObjectTrack, end: int) -> float:
    """Return the speed at the first (`end` 0) or last (-1) poses of a track, in m/s."""
    count = min(_STANDING_SWEEPS, len(track))
    rows = slice(0, count) if end == 0 else slice(-count, None)
    positions, times_s = track.positions[rows, :2], track.times_s[rows]
    return float(np.hypot(*(positions[-1] - positions[0])) / (times_s[-1] - times_s[0]))

"""Compute the poses of all actors at once.

Computing them one actor at a time would take longer than casting the rays.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cached_property
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ..motion.trajectory import (
    ALWAYS,
    StaticPose,
    Stations,
    Track,
    Trajectory,
    find_batch,
    presence_ns,
)
from ..numerics.arrays import Bools, Floats, Indices, Integers, Ints, to_writable
from ..scene.actors import Actor

if TYPE_CHECKING:
    from .surface_loops import TrackTable


class _StraightTracks(NamedTuple):
    """Piecewise linear tracks of n actors.

    The track of a stationary actor has a single segment.
    """

    actors: Sequence[int]  # (n,): actor numbers
    counts: Ints  # (n,): number of segments of each track
    limits: Floats  # (n, 4), as in `TrackTable`
    times_s: Floats  # (s,): start of each segment on the track's clock, seconds
    segments: Sequence[Floats]  # fields of `trajectory.Segments`, of which the first four are used


def _straight_tracks(trajectories: Sequence[Trajectory]) -> Iterator[_StraightTracks]:
    """Yield the piecewise linear tracks of the given trajectories, grouped by batch.

    All stationary actors form one group. Smooth tracks and trajectories of other classes are
    skipped.
    """
    static: list[int] = []
    batches: dict[int, list[int]] = {}  # {id of a batch: actor numbers}
    for actor, trajectory in enumerate(trajectories):
        batch = find_batch(trajectory)
        if batch is not None:
            batches.setdefault(id(batch), []).append(actor)
        elif isinstance(trajectory, Stations | StaticPose):
            static.append(actor)
        elif isinstance(trajectory, Track) and not trajectory.smooth:
            yield _single_track(actor, trajectory)
    for actors in batches.values():
        yield _batch_tracks(actors, [trajectories[actor] for actor in actors])
    if static:
        yield _static_tracks(static, [trajectories[actor] for actor in static])


def _limits_of(track: Track) -> tuple[float, float, float, float]:
    first_s, last_s = track.times_s[[0, -1]].tolist()
    return float(track.start_s or 0), first_s, last_s, track.slack_s


def _single_track(actor: int, track: Track) -> _StraightTracks:
    track = track.with_turns
    counts = np.array([len(track.times_s) - 1], np.int64)
    limits = np.array([_limits_of(track)])
    return _StraightTracks([actor], counts, limits, track.times_s[:-1], track.segments)


def _batch_tracks(actors: list[int], tracks: Sequence[Any]) -> _StraightTracks:
    """Return the piecewise linear tracks of actors in the same batch."""
    batch = tracks[0].batch
    steps = len(batch.times_s) - 1
    return _StraightTracks(
        actors,
        np.full(len(actors), steps, np.int64),
        np.tile(_limits_of(tracks[0]), (len(actors), 1)),
        np.tile(batch.times_s[:-1], len(actors)),
        batch.select_segments([track.number for track in tracks]),
    )


def _static_tracks(actors: list[int], trajectories: Sequence[Any]) -> _StraightTracks:
    """Return single-segment tracks for actors with a `Stations` or `StaticPose` trajectory."""
    count = len(actors)
    positions = np.empty((count, 3))
    rotations = np.empty((count, 3, 3))
    for row, trajectory in enumerate(trajectories):
        if isinstance(trajectory, StaticPose):
            positions[row] = trajectory.position
            rotations[row] = trajectory.rotation
        else:
            pose = trajectory.pose(0)
            positions[row] = pose.position
            rotations[row] = pose.rotation_matrix
    terms = np.zeros((3, 9, count))
    terms[0] = rotations.reshape(-1, 9).T
    return _StraightTracks(
        actors,
        np.ones(count, np.int64),
        np.tile([0.0, 0.0, 0.0, np.inf], (count, 1)),
        np.zeros(count),
        (positions.T, np.zeros((3, count)), terms, np.zeros(count)),
    )


class ActorTrajectories(tuple[Trajectory, ...]):
    """Trajectories of all actors, indexed by actor number, or of a single platform.

    Only trajectories made by `from_actors` have deforming actors in `animated`.
    """

    # {actor number: actor whose mesh is deformed by an animation}
    animated: Mapping[int, Actor] = MappingProxyType({})

    @classmethod
    def from_actors(cls, actors: Iterable[Actor]) -> ActorTrajectories:
        """Return the trajectories of actors, and record which actors deform."""
        actor_list = list(actors)
        trajectories = cls(actor.trajectory for actor in actor_list)
        trajectories.animated = {
            k: actor for k, actor in enumerate(actor_list) if actor.mesh.animation
        }
        return trajectories

    def deforming_rows(self, actors: Integers) -> Indices:
        """Return the indices of the entries in `actors` that refer to a deforming actor."""
        animated = list(self.animated)
        if not animated:
            return np.zeros(0, np.intp)
        return np.flatnonzero(np.isin(actors, animated))

    def animation_frames(self, actors: Integers, times_ns: Floats | Ints) -> Floats:
        """Return the animation frames and frame rates of actors at the given times.

        `actors` (n,) are numbers of actors with an animation, and `times_ns` (n,) are nanoseconds
        since the start of the survey. The result has shape (2, n): fractional frame numbers, and
        frames per second.
        """
        frames = np.zeros((2, len(actors)))
        for actor in np.unique(actors).tolist():
            row_indices = np.flatnonzero(actors == actor)
            frames[:, row_indices] = self.animated[actor].frames_at(
                times_ns[row_indices].astype(np.float64)
            )
        return frames

    @cached_property
    def presence_ns(self) -> Floats:
        """First and last time at which each actor is in the scene, in nanoseconds.

        The shape is (w, 2).
        """
        presence = [
            presence_ns(trajectory) if find_batch(trajectory) is None else ALWAYS
            for trajectory in self
        ]
        return np.array(presence, np.float64).reshape(-1, 2)

    def is_present(self, number: Integers, times_ns: Floats) -> Bools:
        """Return whether each actor is in the scene at the given time.

        `number` (n,) are actor numbers, and `times_ns` (n,) are nanoseconds.
        """
        first, last = self.presence_ns[number].T
        return np.asarray((first <= times_ns) & (times_ns <= last))

    def table(self, number: Integers, times_ns: Floats) -> Floats:
        """Return the poses of the given trajectories at the given times.

        `number` (n,) are trajectory numbers, and `times_ns` (n,) are nanoseconds since the start of
        the trajectory, which for actors is the start of the survey. The result has shape (12, n).
        Each pose is a position in meters and a rotation matrix in row-major order, bit-identical to
        `Trajectory.poses`.

        Raises
        ------
        LidarError
            If a time is outside its trajectory.
        """
        from . import surface_loops  # imported here because numba takes half a second to import

        tracks = self._tracks
        table = np.empty((12, len(number)))
        if not len(number):
            return table
        outside = surface_loops.poses_on_tracks(
            to_writable(number, np.int64), to_writable(times_ns), tracks, table
        )
        if outside >= 0:  # let `poses` raise the LidarError
            self[number[outside]].poses(0, times_ns[number == number[outside]])
        not_straight = np.flatnonzero(tracks.member[number] < 0)
        for trajectory in np.unique(number[not_straight]).tolist():
            row_indices = not_straight[number[not_straight] == trajectory]
            positions, rotations = self[trajectory].poses(0, times_ns[row_indices])
            rotations = np.eye(3) if rotations is None else np.asarray(rotations)
            table[:3, row_indices] = np.broadcast_to(np.asarray(positions), (len(row_indices), 3)).T
            rotations = np.broadcast_to(rotations, (len(row_indices), 3, 3))
            table[3:, row_indices] = rotations.transpose(1, 2, 0).reshape(9, -1)
        return table

    def poses(self, number: Integers, times_ns: Floats) -> tuple[Floats, Floats]:
        """Return the positions and rotations of the given trajectories at the given times.

        `number` (n,) are trajectory numbers, and `times_ns` (n,) are nanoseconds.

        Raises
        ------
        LidarError
            If a time is outside its trajectory.
        """
        table = self.table(number, times_ns)
        return table[:3].T, table[3:].reshape(3, 3, -1).transpose(2, 0, 1)

    def pose_runs(self, number: Integers, times_ns: Floats) -> tuple[Floats, Ints]:
        """Group rows into runs of the same pose. Return a pose per run, and the run of each row.

        A run consists of consecutive rows with the same trajectory and time, which therefore have
        the same pose. The poses have shape (12, m), as in `table`. Rows with a negative number have
        no trajectory. They get run -1 and do not interrupt a run.
        """
        from . import surface_loops

        number = to_writable(number, np.int64)
        times = to_writable(times_ns)
        first, run = np.empty((2, len(number)), np.int64)
        first = first[: surface_loops.find_runs(number, times, first, run)]
        return self.table(number[first], times[first]), run

    @cached_property
    def _tracks(self) -> TrackTable:
        """Tracks of the piecewise linear trajectories, as arrays for compiled loops."""
        from .surface_loops import TrackTable

        tracks = [_no_tracks(), *_straight_tracks(self)]
        member = np.full(len(self), -1, np.int64)
        actors = [actor for group in tracks for actor in group.actors]
        member[actors] = np.arange(len(actors))
        counts = np.concatenate([group.counts for group in tracks])

        def joined(part: int) -> Floats:
            return np.concatenate([group.segments[part] for group in tracks], axis=-1)

        return TrackTable(
            member=member,
            first=np.cumsum(counts) - counts,
            segments=counts,
            limits=np.concatenate([group.limits for group in tracks]).T.copy(),
            times=np.concatenate([group.times_s for group in tracks]),
            start=joined(0),
            speed=joined(1),
            rotation=joined(2),
            rates=joined(3),
        )


def _no_tracks() -> _StraightTracks:
    """Return an empty set of tracks. With it, there is always something to concatenate."""
    return _static_tracks([], [])

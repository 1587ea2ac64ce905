"""Poses of all actors together: actor by actor, poses would take longer than casting."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cached_property
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ...base.arrays import Floats, Indices, Integers, Ints, owned
from ...motion.trajectory import (
    ALWAYS,
    StaticPose,
    Stations,
    Track,
    Trajectory,
    batch_of,
    presence_ns,
)
from ...scene.actors import Actor

if TYPE_CHECKING:
    from .surface_loops import TrackTable


class _StraightTracks(NamedTuple):
    """Tracks of straight segments of n actors, with a single segment if an actor stands."""

    actors: Sequence[int]  # (n,): numbers of the actors
    counts: Ints  # (n,): number of segments of each track
    limits: Floats  # (n, 4), as in `TrackTable`
    times_s: Floats  # (s,): start of each segment, by the track's clock, seconds
    segments: Sequence[Floats]  # the fields of `trajectory.Segments`; the first four are used


def _straight_tracks(trajectories: Sequence[Trajectory]) -> Iterator[_StraightTracks]:
    """Yield the straight tracks of trajectories, together for a batch and for standing actors.

    Smooth tracks and trajectories of other classes have none.
    """
    static: list[int] = []
    batches: dict[int, list[int]] = {}  # {id of a batch: numbers of actors}
    for actor, trajectory in enumerate(trajectories):
        batch = batch_of(trajectory)
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
    """Return a row of `TrackTable.limits`."""
    first_s, last_s = track.times_s[[0, -1]].tolist()
    return float(track.start_s or 0), first_s, last_s, track.slack_s


def _single_track(actor: int, track: Track) -> _StraightTracks:
    """Return the straight track of an actor."""
    track = track.with_turns
    counts = np.array([len(track.times_s) - 1], np.int64)
    limits = np.array([_limits_of(track)])
    return _StraightTracks([actor], counts, limits, track.times_s[:-1], track.segments)


def _batch_tracks(actors: list[int], tracks: Sequence[Any]) -> _StraightTracks:
    """Return the straight tracks of actors whose tracks are of one batch."""
    batch = tracks[0].batch
    steps = len(batch.times_s) - 1
    return _StraightTracks(
        actors,
        np.full(len(actors), steps, np.int64),
        np.tile(_limits_of(tracks[0]), (len(actors), 1)),
        np.tile(batch.times_s[:-1], len(actors)),
        batch.segments_of([track.number for track in tracks]),
    )


def _static_tracks(actors: list[int], trajectories: Sequence[Any]) -> _StraightTracks:
    """Return the tracks of actors that stand: of the first of `Stations`, or of a `StaticPose`."""
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
    """Trajectories of actors, by their numbers, or of a carrier alone.

    Only `from_actors` sets `animated`.
    """

    # {number of the actor: actor whose mesh an animation deforms}
    animated: Mapping[int, Actor] = MappingProxyType({})

    @classmethod
    def from_actors(cls, actors: Iterable[Actor]) -> ActorTrajectories:
        """Return the trajectories of actors, with the actors that deform."""
        actor_list = list(actors)
        trajectories = cls(actor.trajectory for actor in actor_list)
        trajectories.animated = {
            k: actor for k, actor in enumerate(actor_list) if actor.mesh.animation
        }
        return trajectories

    def deforming(self, actors: Integers) -> Indices:
        """Return the rows (k,) of `actors` (n,), numbers, whose mesh an animation deforms."""
        animated = list(self.animated)
        if not animated:
            return np.zeros(0, np.intp)
        return np.flatnonzero(np.isin(actors, animated))

    def played(self, actors: Integers, times_ns: Floats | Ints) -> Floats:
        """Return the positions in the animations of actors at times, and their rates: (2, n).

        `actors` (n,) are numbers of actors with an animation; times (n,) are nanoseconds since the
        survey's start. Positions are animation frames, with fractions; rates are frames per second.
        """
        frames = np.zeros((2, len(actors)))
        for actor in np.unique(actors).tolist():
            row_indices = np.flatnonzero(actors == actor)
            frames[:, row_indices] = self.animated[actor].played(
                times_ns[row_indices].astype(np.float64)
            )
        return frames

    @cached_property
    def presence_ns(self) -> Floats:
        """First and last time of each of w actors in the scene, nanoseconds: (w, 2)."""
        presence = [
            presence_ns(trajectory) if batch_of(trajectory) is None else ALWAYS
            for trajectory in self
        ]
        return np.array(presence, np.float64).reshape(-1, 2)

    def table(self, number: Integers, times_ns: Floats) -> Floats:
        """Return the poses of trajectories `number` (n,) at times (n,), nanoseconds: (12, n).

        A pose is a position, meters, and a rotation matrix by rows, with the bits of
        `Trajectory.poses`. Times count from the start of the trajectory: for actors, the survey's.

        Raises
        ------
        LidarError
            If a time is not within its trajectory.
        """
        from . import surface_loops  # not before: numba takes half a second to import

        tracks = self._tracks
        table = np.empty((12, len(number)))
        if not len(number):
            return table
        outside = surface_loops.poses_on_tracks(
            owned(number, np.int64), owned(times_ns), tracks, table
        )
        if outside >= 0:  # `poses` raises the LidarError
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
        """Return the positions (n, 3) and rotations (n, 3, 3) of trajectories `number` (n,).

        Times (n,) are nanoseconds.

        Raises
        ------
        LidarError
            If a time is not within its trajectory.
        """
        table = self.table(number, times_ns)
        return table[:3].T, table[3:].reshape(3, 3, -1).transpose(2, 0, 1)

    def runs(self, number: Integers, times_ns: Floats) -> tuple[Floats, Ints]:
        """Return the poses (12, m) of runs of rows, as `table`, and the run of each row (n,).

        A run is rows that follow each other, with the same trajectory and time, and thus the same
        pose. Rows with numbers below 0 have no trajectory: they have the run -1, and end no run.
        """
        from . import surface_loops

        number = owned(number, np.int64)
        times = owned(times_ns)
        first, run = np.empty((2, len(number)), np.int64)
        first = first[: surface_loops.find_runs(number, times, first, run)]
        return self.table(number[first], times[first]), run

    @cached_property
    def _tracks(self) -> TrackTable:
        """Straight tracks among the trajectories, for compiled loops."""
        from .surface_loops import TrackTable

        tracks = [_no_tracks(), *_straight_tracks(self)]
        member = np.full(len(self), -1, np.int64)
        actors = [actor for group in tracks for actor in group.actors]
        member[actors] = np.arange(len(actors))
        counts = np.concatenate([group.counts for group in tracks])

        def joined(part: int) -> Floats:
            """Concatenate field `part` of the segments of all tracks: (..., s)."""
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
    """Return no tracks, with the shapes of tables."""
    return _static_tracks([], [])

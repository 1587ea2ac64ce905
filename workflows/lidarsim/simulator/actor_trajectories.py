"""Poses of all actors together: actor by actor, poses would take longer than casting."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property
from types import MappingProxyType
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..base.arrays import Floats, Indices, Integers, Ints, owned
from ..scene.actors import Actor
from ..sensor import Track, Trajectory
from ..sensor.trajectory import StaticPose, Stations, presence_ns

if TYPE_CHECKING:
    from .surface_loops import TrackTable


class _StraightTrack(NamedTuple):
    """A track of s straight segments."""

    times_s: Floats  # (s + 1,): start of each segment, and end of the last, by the track's clock
    start_s: float  # time of the track's clock at the survey's start, seconds
    slack_s: float  # how far outside `times_s` poses are defined, seconds; inf for any time
    segments: tuple[Floats, ...]  # the fields of `trajectory.Segments`; the first four are used


def _straight_track(trajectory: Trajectory) -> _StraightTrack | None:
    """Return the straight track of a `Track`; None for smooth tracks and other classes."""
    if not isinstance(trajectory, Track) or trajectory.smooth:
        return None
    return _StraightTrack(
        trajectory.times_s,
        float(trajectory.start_s or 0),
        trajectory.slack_s,
        trajectory.segments,
    )


def _static_tracks(trajectories: Sequence[Stations | StaticPose]) -> _StraightTrack:
    """Return the tracks of actors that stand, one segment each, as a track of s segments."""
    count = len(trajectories)
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
    segments = positions.T, np.zeros((3, count)), terms, np.zeros(count)
    return _StraightTrack(np.zeros(count + 1), 0.0, np.inf, segments)


class ActorTrajectories(tuple[Trajectory, ...]):
    """Trajectories of actors, by their numbers; or of a carrier alone.

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
            rows = np.flatnonzero(actors == actor)
            frames[:, rows] = self.animated[actor].played(times_ns[rows].astype(np.float64))
        return frames

    @cached_property
    def presence_ns(self) -> Floats:
        """First and last time of each of w actors in the scene, nanoseconds: (w, 2)."""
        presence = [presence_ns(trajectory) for trajectory in self]
        return np.array(presence, np.float64).reshape(-1, 2)

    def table(self, number: Integers, times_ns: Floats) -> Floats:
        """Return the poses of trajectories `number` (n,) at times (n,), nanoseconds: (12, n).

        A pose is a position, metres, and a rotation matrix by rows, with the bits of
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
            rows = not_straight[number[not_straight] == trajectory]
            positions, rotations = self[trajectory].poses(0, times_ns[rows])
            rotations = np.eye(3) if rotations is None else np.asarray(rotations)
            table[:3, rows] = np.broadcast_to(np.asarray(positions), (len(rows), 3)).T
            rotations = np.broadcast_to(rotations, (len(rows), 3, 3))
            table[3:, rows] = rotations.transpose(1, 2, 0).reshape(9, -1)
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

        straight_tracks = {
            number: track
            for number, trajectory in enumerate(self)
            if (track := _straight_track(trajectory)) is not None
        }
        static = [
            number
            for number, trajectory in enumerate(self)
            if isinstance(trajectory, Stations | StaticPose)
        ]
        # Tracks in the order of actors that move, and then of actors that stand.
        member = np.full(len(self), -1, np.int64)
        member[[*straight_tracks, *static]] = np.arange(len(straight_tracks) + len(static))
        tracks = [*straight_tracks.values(), _static_tracks([self[number] for number in static])]
        counts = np.array([len(track.times_s) - 1 for track in tracks[:-1]] + [1] * len(static))

        def joined(part: int, *shape: int) -> Floats:
            """Concatenate field `part` of the segments of all tracks: (*shape, s)."""
            empty = np.zeros((*shape, 0))
            return np.concatenate([empty, *(track.segments[part] for track in tracks)], axis=-1)

        limits = [
            (track.start_s, track.times_s[0], track.times_s[-1], track.slack_s)
            for track in tracks[:-1]
        ] + [(0.0, 0.0, 0.0, np.inf)] * len(static)
        counts = counts.astype(np.int64)
        return TrackTable(
            member=member,
            first=np.cumsum(counts) - counts,
            segments=counts,
            limits=np.array(limits, np.float64).reshape(-1, 4).T.copy(),
            times=np.concatenate([np.zeros(0), *(track.times_s[:-1] for track in tracks)]),
            start=joined(0, 3),
            speed=joined(1, 3),
            rotation=joined(2, 3, 9),
            rates=joined(3),
        )

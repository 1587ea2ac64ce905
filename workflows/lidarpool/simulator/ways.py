"""Poses of many actors at once: asked for one by one, they take longer than casting does."""

from __future__ import annotations

from functools import cached_property
from typing import NamedTuple

import numpy as np

from ..base.arrays import Floats, Indices, Integers, Ints
from ..sensor import Track, Trajectory
from ..sensor.trajectory import Stations, presence_ns


class _Tracks(NamedTuple):
    """The straight tracks among trajectories, their segments one behind the other."""

    member: Ints  # (w,): number among the tracks of each trajectory, -1 for others
    first: Ints  # (t,): of each track its first segment
    segments: Ints  # (t,): and how many it has
    begins: Floats  # (t,): seconds, start by its clock
    low: Floats  # (t,): first and last time of its poses
    high: Floats
    strict: Floats  # (t,): how far outside these a time may be, seconds; inf if any
    times: Floats  # (s,): when segments begin
    start: Floats  # (3, s), and the others as `Track.segments`
    speed: Floats
    turn: Floats  # (3, 9, s)
    rates: Floats  # (s,)


class _Pieces(NamedTuple):
    """A straight track, or what stands, which is a track of one piece."""

    times_s: Floats
    start_s: float
    slack_s: float
    parts: tuple[Floats, ...]  # see `Track.segments`


def _pieces_of(way: Trajectory) -> _Pieces | None:
    if isinstance(way, Track) and not way.smooth:
        return _Pieces(way.times_s, float(way.start_s or 0), way.slack_s, way.segments)
    if not isinstance(way, Stations):
        return None
    (position,), turns = way.poses(0, np.zeros(1))
    turn = np.zeros((3, 9, 1))
    turn[0] = np.eye(3).reshape(9, 1) if turns is None else turns.reshape(9, 1)
    parts = position[:, None], np.zeros((3, 1)), turn, np.zeros(1)
    return _Pieces(np.zeros(2), 0.0, np.inf, parts)


class Ways(tuple[Trajectory, ...]):
    """Trajectories of actors."""

    @cached_property
    def presence_ns(self) -> Floats:
        """Times when each is in the scene, nanoseconds: (w, 2), first and last."""
        return np.array([presence_ns(way) for way in self], np.float64).reshape(-1, 2)

    def poses(self, number: Integers, times_ns: Floats) -> tuple[Floats, Floats]:
        """Poses of trajectories `number` (n,) at times (n,): positions (n, 3), rotations (n, 3, 3).

        They have the bits of `Trajectory.poses`.

        Raises
        ------
        LidarpoolError
            If a time is not within its trajectory.
        """
        new = (np.diff(number, prepend=-1) != 0) | (np.diff(times_ns, prepend=-1.0) != 0)
        if 2 * np.count_nonzero(new) < len(new):  # most have the pose of the one before
            new[:1] = True
            positions, rotations = self.poses(number[new], times_ns[new])
            row, columns = np.cumsum(new) - 1, rotations.transpose(1, 2, 0)
            return positions.T.take(row, axis=1).T, columns.take(row, axis=2).transpose(2, 0, 1)
        tracks = self._tracks
        member = tracks.member[number]
        straight = np.flatnonzero(member >= 0)
        if len(straight) == len(number):
            return self._on_tracks(member, number, times_ns)
        positions, rotations = np.empty((3, len(number))).T, np.empty((3, 3, len(number)))
        rotations = rotations.transpose(2, 0, 1)
        own = member[straight], number[straight], times_ns[straight]
        positions[straight], rotations[straight] = self._on_tracks(*own)
        others = np.flatnonzero(member < 0)
        others = others[np.argsort(number[others], kind="stable")]
        for rows in np.split(others, np.flatnonzero(np.diff(number[others])) + 1):
            if len(rows):
                places, turns = self[number[rows[0]]].poses(0, times_ns[rows])
                positions[rows] = places
                rotations[rows] = np.eye(3) if turns is None else turns
        return positions, rotations

    @cached_property
    def _tracks(self) -> _Tracks:
        pieces = [_pieces_of(way) for way in self]
        straight = np.array([piece is not None for piece in pieces], np.bool_)
        member = np.where(straight, np.cumsum(straight) - 1, -1)
        tracks = [piece for piece in pieces if piece is not None]
        parts = [piece.parts for piece in tracks]
        segments = np.array([len(piece.times_s) - 1 for piece in tracks], np.int64)

        def joined(which: int, *shape: int) -> Floats:
            none = np.zeros((*shape, 0))
            return np.concatenate([none, *(part[which] for part in parts)], axis=-1)

        return _Tracks(
            member,
            np.cumsum(segments) - segments,
            segments,
            np.array([track.start_s for track in tracks], np.float64),
            np.array([track.times_s[0] for track in tracks]),
            np.array([track.times_s[-1] for track in tracks]),
            np.array([track.slack_s for track in tracks]),
            np.concatenate([np.zeros(0), *(track.times_s[:-1] for track in tracks)]),
            joined(0, 3),
            joined(1, 3),
            joined(2, 3, 9),
            joined(3),
        )

    def _on_tracks(
        self, member: Indices, number: Integers, times_ns: Floats
    ) -> tuple[Floats, Floats]:
        """Poses on straight tracks, with the operations of `Track.poses`."""
        tracks = self._tracks
        low, high = tracks.low[member], tracks.high[member]
        at = times_ns / 1e9 + tracks.begins[member]
        outside = np.maximum(low - at, at - high) > tracks.strict[member]
        for row in np.flatnonzero(outside)[:1]:  # which raises the error
            self[number[row]].poses(0, times_ns[number == number[row]])
        at = np.where(np.isinf(tracks.strict[member]), at.clip(low, high), at)
        # The last segment that has begun, by halves.
        segment, room = tracks.first[member], tracks.segments[member] - 1
        while room.any():
            half = (room + 1) // 2
            begun = tracks.times[segment + half] <= at
            segment = np.where(begun, segment + half, segment)
            room = np.where(begun, room - half, half - 1)
        since = at - tracks.times.take(segment)
        positions = tracks.speed.take(segment, axis=1) * since + tracks.start.take(segment, axis=1)
        angle = since * tracks.rates.take(segment)
        rotations = tracks.turn[0].take(segment, axis=1)
        for factor, table in ((np.sin(angle), tracks.turn[1]), (np.cos(angle), tracks.turn[2])):
            rotations = rotations + factor * table.take(segment, axis=1)
        return positions.T, rotations.reshape(3, 3, -1).transpose(2, 0, 1)

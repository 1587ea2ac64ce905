"""Poses of many actors at once: asked for one by one, they take longer than casting does."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import cached_property
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from ..base.arrays import Floats, Indices, Integers, Ints, owned
from ..scene.actors import Actor
from ..sensor import Track, Trajectory
from ..sensor.trajectory import Stations, presence_ns


class _TrackTable(NamedTuple):
    """The straight tracks among trajectories, their segments one behind the other."""

    member: Ints  # (w,): number among the tracks of each trajectory, -1 for others
    first: Ints  # (t,): of each track its first segment
    segments: Ints  # (t,): and how many it has
    # (4, t): seconds, start by its clock, first and last time of its poses, and how far outside
    # these a time may be; inf if any.
    limits: Floats
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


class ActorTrajectories(tuple[Trajectory, ...]):
    """Trajectories of actors."""

    animated: Mapping[int, Actor] = MappingProxyType({})  # {number: actor that deforms}

    @classmethod
    def of(cls, actors: Iterable[Actor]) -> ActorTrajectories:
        """Return those of actors, and how these deform."""
        found = list(actors)
        made = cls(actor.trajectory for actor in found)
        made.animated = {k: actor for k, actor in enumerate(found) if actor.mesh.animation}
        return made

    def deforming(self, number: Integers) -> Indices:
        """Rows of `number` (n,) that are actors whose mesh has an animation."""
        own = list(self.animated)
        return np.flatnonzero(np.isin(number, own)) if own else np.zeros(0, np.intp)

    def played(self, number: Integers, times_ns: Floats | Ints) -> Floats:
        """Frames of actors `number` (n,) at times (n,), and how many a second pass: (2, n)."""
        out = np.zeros((2, len(number)))
        for one in np.unique(number).tolist():
            rows = np.flatnonzero(number == one)
            out[:, rows] = self.animated[one].played(times_ns[rows].astype(np.float64))
        return out

    @cached_property
    def presence_ns(self) -> Floats:
        """Times when each is in the scene, nanoseconds: (w, 2), first and last."""
        return np.array([presence_ns(way) for way in self], np.float64).reshape(-1, 2)

    def table(self, number: Integers, times_ns: Floats) -> Floats:
        """Poses of trajectories `number` (n,) at times (n,): positions, and rotations by rows.

        They are (12, n), and have the bits of `Trajectory.poses`.

        Raises
        ------
        LidarError
            If a time is not within its trajectory.
        """
        from . import surface_loops  # not before: numba takes half a second to import

        tracks = self._tracks
        out = np.empty((12, len(number)))
        if not len(number):
            return out
        given = owned(number, np.int64), owned(times_ns)
        outside = surface_loops.on_tracks(*given, *tracks, out)
        if outside >= 0:  # which raises the error
            self[number[outside]].poses(0, times_ns[number == number[outside]])
        others = np.flatnonzero(tracks.member[number] < 0)
        for one in np.unique(number[others]).tolist():
            rows = others[number[others] == one]
            places, turns = self[one].poses(0, times_ns[rows])
            turns = np.eye(3) if turns is None else np.asarray(turns)
            out[:3, rows] = np.broadcast_to(np.asarray(places), (len(rows), 3)).T
            turns = np.broadcast_to(turns, (len(rows), 3, 3))
            out[3:, rows] = turns.transpose(1, 2, 0).reshape(9, -1)
        return out

    def poses(self, number: Integers, times_ns: Floats) -> tuple[Floats, Floats]:
        """Poses as of `table`: positions (n, 3), rotations (n, 3, 3)."""
        table = self.table(number, times_ns)
        return table[:3].T, table[3:].reshape(3, 3, -1).transpose(2, 0, 1)

    def runs(self, number: Integers, times_ns: Floats) -> tuple[Floats, Ints]:
        """Poses as of `table`, one for rows of one trajectory and time: (12, m), and which (n,).

        Numbers below 0 have none, which is -1.
        """
        from . import surface_loops

        number = owned(number, np.int64)
        times = owned(times_ns)
        first, run = np.empty((2, len(number)), np.int64)
        some = first[: surface_loops.runs(number, times, first, run)]
        return self.table(number[some], times[some]), run

    @cached_property
    def _tracks(self) -> _TrackTable:
        pieces = [_pieces_of(way) for way in self]
        straight = np.array([piece is not None for piece in pieces], np.bool_)
        member = np.where(straight, np.cumsum(straight) - 1, -1)
        tracks = [piece for piece in pieces if piece is not None]
        parts = [piece.parts for piece in tracks]
        segments = np.array([len(piece.times_s) - 1 for piece in tracks], np.int64)

        def joined(which: int, *shape: int) -> Floats:
            none = np.zeros((*shape, 0))
            return np.concatenate([none, *(part[which] for part in parts)], axis=-1)

        limits = [
            (track.start_s, track.times_s[0], track.times_s[-1], track.slack_s) for track in tracks
        ]
        return _TrackTable(
            member,
            np.cumsum(segments) - segments,
            segments,
            np.array(limits, np.float64).reshape(-1, 4).T.copy(),
            np.concatenate([np.zeros(0), *(track.times_s[:-1] for track in tracks)]),
            joined(0, 3),
            joined(1, 3),
            joined(2, 3, 9),
            joined(3),
        )

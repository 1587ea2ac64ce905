"""Poses of sensors while they sweep, so that points can be moved between frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..base.arrays import Floats, Floats32, Ints
from ..sensor import Pose, Survey, Trajectory
from ..sensor.trajectory import full_poses, quaternions_of
from .lidar_traits import LidarTraits

KNOT_NS = 2e6  # between poses that are stored: at 10 m/s², 5 µm from a straight line
_MAX_KNOTS = 1000  # of a sweep
_POSES = 100_000  # that are computed at a time
STILL = np.zeros((0, 0, 7), np.float32)  # knots of sensors that stand while they sweep


@dataclass(frozen=True, eq=False)
class FiringPoses:
    """Poses of a sensor at the firings of some points of a sweep."""

    position: Floats  # (3,): at the start of the sweep, metres, world coordinates
    turn: Floats  # (3, 3): rotation from the sensor's axes at the start to the world's
    # (3, k): metres from that position, in the world's axes; None if the sensor stands
    since: Floats | None = None
    quaternions: Floats | None = None  # (4, k): x, y, z, w of the rotations since the start
    # (3, k): metres that the sensor moves in 2 ms, or a longer part of the sweep, around the firing
    steps: Floats | None = None

    @property
    def positions(self) -> Floats:
        """Positions (k, 3), or (3,) of a sensor that stands, metres, world coordinates."""
        return self.position if self.since is None else self.position + self.since.T

    def inward(self, points: Floats) -> Floats:
        """Convert points (k, 3) of the world to the sensor's axes at the firing of each."""
        return self.turned_inward(points - self.positions)

    def outward(self, points: Floats) -> Floats:
        """Convert points (k, 3) in the sensor's axes at their firings to the world."""
        outside: Floats = self.turned_outward(points) + self.positions
        return outside

    def turned_inward(self, vectors: Floats) -> Floats:
        """Rotate vectors (k, 3) in the world's axes to the sensor's axes at their firings."""
        inside: Floats = vectors @ self.turn
        return inside if self.quaternions is None else _turned(inside, self.quaternions, -1.0)

    def turned_outward(self, vectors: Floats) -> Floats:
        """Rotate vectors (k, 3) in the sensor's axes at their firings to the world's axes."""
        inside = vectors if self.quaternions is None else _turned(vectors, self.quaternions, 1.0)
        return inside @ self.turn.T


def _turned(vectors: Floats, quaternions: Floats, sign: float) -> Floats:
    """Rotate vectors (k, 3) by unit quaternions (4, k), or with sign -1 by their inverses: (k, 3).

    v + 2 w (q x v) + 2 q x (q x v), q the vector of the quaternion (Rodrigues, 1840).
    """
    (a, b, c), w = sign * quaternions[:3], quaternions[3]
    x, y, z = vectors.T
    p = 2 * (b * z - c * y)
    q = 2 * (c * x - a * z)
    r = 2 * (a * y - b * x)
    rows = [
        x + w * p + (b * r - c * q),
        y + w * q + (c * p - a * r),
        z + w * r + (a * q - b * p),
    ]
    return np.stack(rows, axis=1)


def knots_of(survey: Survey, lidars: Sequence[LidarTraits], turns: Floats) -> Floats32:
    """Return the poses of each sweep's sensor at times that divide the sweep evenly.

    The last knot is when the last beam of the sweep is fired. A sweep that a frozen sensor repeats
    has the poses of the older sweep, moved with the sensor, as its points are.

    Parameters
    ----------
    turns
        (n, 3, 3): rotations from the sensor's axes to the world's at the start of each sweep.

    Returns
    -------
    (n, m, 7): position, metres, in the world's axes from that at the start of the sweep; and
    quaternion x, y, z, w of the rotation since then, in the sensor's axes. `STILL` if no sensor
    moves while it sweeps.
    """
    path = survey.path
    if not path.moves:
        return STILL
    spans = [
        ends - begins + lidar.firing_ns
        for (_, begins, ends), lidar in zip(survey.sweeps_each, lidars, strict=True)
    ]
    longest_ns = max(float(span.max(initial=0.0)) for span in spans)
    count = 1 + int(np.clip(np.ceil(longest_ns / KNOT_NS), 1, _MAX_KNOTS))
    out = np.empty((len(turns), count, 7), np.float32)
    first = 0
    for number, span in enumerate(spans):
        stations, begins_ns = _cast_at(survey, number)
        for station in range(path.stations):
            rows = np.flatnonzero(stations == station)
            for part in np.array_split(rows, -(-len(rows) * count // _POSES) or 1):
                times_ns = begins_ns[part, None] + np.linspace(0, 1, count) * span[part, None]
                mount = survey.carried[number].mount
                knots = _relative(path, station, times_ns, mount, turns[first + part])
                out[first + part] = knots
        first += len(span)
    return out


def _cast_at(survey: Survey, number: int) -> tuple[Ints, Floats]:
    """Return when and where the sweeps of a sensor were cast: before they were sent, if frozen.

    Returns
    -------
    stations
        (n,): stations.
    begins_ns
        (n,): starts of the sweeps, nanoseconds since those of their stations.
    """
    firsts, begins, _ = survey.sweeps_each[number]
    per_station = len(firsts) // survey.path.stations
    stations = np.arange(len(firsts)) // per_station
    begins_ns = begins - stations * survey.station_ns
    if survey.faults_of(number, "frozen"):
        for sweep, scan in enumerate(firsts.tolist()):
            spec = survey.sent_scan(scan)
            if spec.repeats is not None:
                stations[sweep] = spec.station
                begins_ns[sweep] = survey.begins_ns(spec.repeats[0]) - spec.start_ns
    return stations, begins_ns


def _relative(
    path: Trajectory, station: int, times_ns: Floats, mount: Pose, turns: Floats
) -> Floats:
    """Return the knots (k, m, 7) of sweeps at times (k, m), see `knots_of`; `turns` (k, 3, 3)."""
    flat = np.minimum(times_ns.ravel(), path.duration_ns)
    places, rotations = full_poses(path, station, flat)
    shape = times_ns.shape
    places = (places + rotations @ np.array(mount.position)).reshape(*shape, 3)
    rotations = (rotations @ mount.rotation_matrix).reshape(*shape, 3, 3)
    starts = rotations[:, :1]
    # In the axes of the sensor at the start of the sweep that was cast, then of the one sent.
    apart = (places - places[:, :1]) @ starts[:, 0]
    since = starts.swapaxes(2, 3) @ rotations
    quaternions = quaternions_of(since.reshape(-1, 3, 3)).reshape(*shape, 4)
    flips = (quaternions[:, 1:] * quaternions[:, :-1]).sum(axis=2) < 0
    quaternions[:, 1:] *= 1 - 2 * (np.cumsum(flips, axis=1)[..., None] % 2)
    return np.concatenate([apart @ turns.transpose(0, 2, 1), quaternions], axis=2)


def poses_at(knots: Floats32, position: Floats, turn: Floats, shares: Floats) -> FiringPoses:
    """Interpolate poses within a sweep.

    Parameters
    ----------
    knots
        (m, 7): of the sweep, see `knots_of`.
    position, turn
        (3,) and (3, 3): pose of the sensor at the start of the sweep.
    shares
        (k,): parts of the sweep that have passed, 0 to 1.
    """
    intervals = len(knots) - 1
    if intervals < 1:
        return FiringPoses(position, turn)
    at = np.clip(shares, 0, 1) * intervals
    before = np.minimum(at.astype(np.intp), intervals - 1)
    part = at - before
    starts = np.ascontiguousarray(knots[:-1].T, np.float64)
    steps = np.diff(np.asarray(knots.T, np.float64), axis=1).take(before, axis=1)
    mixed = starts.take(before, axis=1) + steps * part
    # Of rotations 2 ms apart: a straight line between two is as good as an arc.
    mixed[3:] /= np.sqrt((mixed[3:] ** 2).sum(axis=0))
    return FiringPoses(position, turn, mixed[:3], mixed[3:], steps[:3])

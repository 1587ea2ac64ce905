"""Poses, and trajectories that give a pose for each firing."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, ClassVar, Literal, Protocol

import numpy as np
from numpy.typing import ArrayLike

from ..base.arrays import Bools, Floats, Indices
from ..base.declared import AngleDeg, Triple, about, short, written_as
from ..base.elementary import arctan2, sin_cos
from ..base.errors import LidarError
from ..base.validation import as_array, checked_fields, one_line, shown
from ..base.vectors import applied, determinant, hypot, length, matmul
from .spline import knots_of, on_curve

QUATERNION_SLACK = 1e-3  # tolerance of a quaternion's length, which files round
# Times since 1970 are coarser than a nanosecond in double precision, and the beams of the last
# firing are fired a little after its pose.
CLOCK_S = 1e-6
_FIRING_S = 1e-3

_ROUNDS = 8  # of the power iteration: rotations are rounded by 2e-3 at most
_STEP_NS = 5e5  # half of what difference quotients are taken over

ALWAYS = (-np.inf, np.inf)

Beyond = Literal["refuse", "hold", "absent"]


@dataclass(frozen=True)
@checked_fields
class Pose:
    """Position and rotation of a sensor, in the scene's own coordinates.

    Angles are in degrees, in aerospace order.
    """

    position: Annotated[tuple[float, float, float], written_as(Triple), about("x, y and z, metres")]
    yaw_deg: Annotated[AngleDeg, about("rotation about z, first")] = 0.0
    pitch_deg: Annotated[AngleDeg, about("rotation about the new y, second")] = 0.0
    roll_deg: Annotated[AngleDeg, about("rotation about the new x, last")] = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "position", tuple(map(float, self.position)))

    @property
    def rotation(self) -> Floats | None:
        """Rotation from sensor to scene axes, (3, 3); None without rotation."""
        if not (self.yaw_deg or self.pitch_deg or self.roll_deg):
            return None
        return rotations_of(np.array([self.yaw_deg, self.pitch_deg, self.roll_deg]))

    @property
    def turn(self) -> Floats:
        """`rotation`; the identity matrix without one."""
        return np.eye(3) if self.rotation is None else self.rotation

    def then(self, mount: Pose) -> Pose:
        """Pose of something mounted at `mount` in the axes of this one."""
        if mount == CENTRE:
            return self
        turn = self.turn
        return Pose.of(self.position + applied(turn, mount.position), matmul(turn, mount.turn))

    @classmethod
    def of(cls, position: ArrayLike, rotation: Floats | None) -> Pose:
        """Make a pose of a position and a rotation matrix (3, 3), or None.

        LidarError if the matrix mirrors or deforms.
        """
        place = tuple(np.asarray(position, np.float64).tolist())
        if rotation is None:
            return cls(place)
        check_rotations(np.asarray(rotation, np.float64)[None])
        level = hypot(rotation[0, 0], rotation[1, 0])
        pitch = arctan2(-rotation[2, 0], level)
        if level > 1e-9:
            yaw = arctan2(rotation[1, 0], rotation[0, 0])
            roll = arctan2(rotation[2, 1], rotation[2, 2])
        else:  # straight up or down: yaw and roll have the same axis
            yaw = arctan2(-rotation[0, 1], rotation[1, 1])
            roll = np.zeros(())
        return cls(place, *np.degrees([yaw, pitch, roll]).tolist())


def rotations_of(angles_deg: Floats) -> Floats:
    """Rotations (k, 3, 3) of yaw, pitch and roll in degrees (k, 3), as of `Pose`; or of one."""
    angles = np.radians(angles_deg.T)
    (sy, sp, sr), (cy, cp, cr) = sin_cos(angles)
    made = np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )
    return made if made.ndim == 2 else np.ascontiguousarray(np.moveaxis(made, 2, 0))


def check_rotations(rotations: Floats, slack: float = 1e-6) -> None:
    """Check matrices (k, 3, 3) of poses; LidarError for one that mirrors or deforms.

    Products of their columns may differ by `slack` from those of a rotation.
    """
    products = matmul(rotations.transpose(0, 2, 1), rotations)
    # Written so that NaN is an error.
    rigid = np.asarray((np.abs(products - np.eye(3)) <= slack).all(axis=(1, 2)))
    right_handed = determinant(rotations) > 0
    bad = np.flatnonzero(~(rigid & right_handed))
    if len(bad):
        first = int(bad[0])
        fault = "mirrors" if rigid[first] else "deforms"
        raise LidarError(
            f"Matrix {first} of a pose {fault}: {rotations[first].round(6).tolist()}. A pose turns "
            "and moves: give a matrix with orthonormal rows and the determinant 1 (matrices are "
            "counted from 0)."
        )


def pose_of(name: str, given: Any) -> Pose:
    """Return a pose as given, or of x, y and z; LidarError with its name if it is neither."""
    if isinstance(given, Pose):
        return given
    try:
        return Pose(tuple(map(float, given)))  # type: ignore[arg-type]  # it counts them
    except (TypeError, ValueError) as error:
        raise LidarError(
            f"{name} is {shown(given)}; it must be a Pose, or x, y and z in metres, such as "
            "(0, 0, 1)."
        ) from error


CENTRE = Pose((0.0, 0.0, 0.0))  # mount of a sensor without a carrier


@dataclass(frozen=True)
class InstrumentPose(Pose):
    """Position and angles of an instrument in the carrier's axes, as a file has them."""

    position: Annotated[Triple, about("x, y and z, metres")] = (0, 0, 0)


# A pose in a file whose position may be left out, or is all that is given.
AT_CENTRE = short(
    lambda v: isinstance(v, (dict, list)),
    lambda v: {"position": v} if isinstance(v, list) else {"position": [0] * 3} | v,
    Triple | InstrumentPose,
)


class Trajectory(Protocol):
    """Poses over time. A survey has stations: it jumps between them, and may move within one.

    Scans of one station follow one another, while the head keeps turning.
    """

    @property
    def stations(self) -> int:
        """Number of stations."""

    @property
    def moves(self) -> bool:
        """Whether the sensor moves within a station, so that each firing has its own pose."""

    @property
    def duration_ns(self) -> float:
        """Longest duration of a station, nanoseconds; may be infinite."""

    def pose(self, station: int, time_ns: float = 0.0) -> Pose:
        """Pose at a time since the start of a station."""

    def poses(self, station: int, times_ns: Floats) -> tuple[Floats, Floats | None]:
        """Positions (k, 3) and rotations (k, 3, 3) at times (k,) of a station that moves.

        They are fastest if each of their numbers is contiguous over the poses.
        """


def presence_ns(path: Trajectory) -> tuple[float, float]:
    """Return when an actor on a trajectory is in the scene: first and last nanosecond.

    Always, unless its class has a `presence_ns` that says otherwise.
    """
    first, last = getattr(path, "presence_ns", ALWAYS)
    return float(first), float(last)


def full_poses(path: Trajectory, station: int, times_ns: Floats) -> tuple[Floats, Floats]:
    """Return poses as `Trajectory.poses` does; rotations are identities where it has none."""
    positions, rotations = path.poses(station, times_ns)
    if rotations is None:
        rotations = np.broadcast_to(np.eye(3), (len(times_ns), 3, 3))
    return positions, rotations


def velocities(path: Trajectory, station: int, times_ns: Floats) -> tuple[Floats, Floats]:
    """Return velocities and angular velocities on a trajectory, derivatives of its poses.

    Those of its own method `velocities` with the same arguments and values, which the classes of
    this package have. For another class they are difference quotients over 1 ms.

    Returns
    -------
    velocities
        (k, 3): of the origin of its axes, m/s, in the scene's axes.
    rates
        (k, 3): angular velocities, rad/s, in the scene's axes.
    """
    if not path.moves:
        return np.zeros((len(times_ns), 3)), np.zeros((len(times_ns), 3))
    own = getattr(path, "velocities", None)
    if own is not None:
        linear, angular = own(station, times_ns)
        return linear, angular
    early, late = (np.clip(times_ns + h, 0, path.duration_ns) for h in (-_STEP_NS, _STEP_NS))
    seconds = np.maximum(late - early, 1)[:, None] / 1e9
    (one, before), (other, after) = (path.poses(station, at) for at in (early, late))
    if before is None or after is None:
        return (other - one) / seconds, np.zeros((len(times_ns), 3))
    turn = matmul(after, before.transpose(0, 2, 1))
    sines = np.stack([turn[:, k, j] - turn[:, j, k] for j, k in ((1, 2), (2, 0), (0, 1))], axis=1)
    return (other - one) / seconds, sines / (2 * seconds)


@dataclass(frozen=True)
class Stations:
    """The simplest trajectory: the sensor stands at one pose after the other."""

    at: tuple[Pose, ...]
    moves: ClassVar[bool] = False
    duration_ns: ClassVar[float] = np.inf
    __repr__ = one_line

    @property
    def stations(self) -> int:
        """See `Trajectory.stations`."""
        return len(self.at)

    def pose(self, station: int, time_ns: float = 0.0) -> Pose:
        """See `Trajectory.pose`."""
        return self.at[station]

    def poses(self, station: int, times_ns: Floats) -> tuple[Floats, Floats | None]:
        """See `Trajectory.poses`."""
        pose = self.at[station]
        count = len(times_ns)
        rotation = pose.rotation
        turned = None if rotation is None else np.broadcast_to(rotation, (count, 3, 3))
        return np.broadcast_to(np.array(pose.position), (count, 3)), turned


@dataclass(frozen=True, eq=False)
@checked_fields
class Track:
    """Poses at times, with a straight or smooth path between them: one station.

    Parameters
    ----------
    times_s
        float64 (k,): times of the poses, seconds, ascending; by any clock.
    positions
        float64 (k, 3): metres, in the scene's own coordinates.
    quaternions
        float64 (k, 4): x, y, z, w of the rotations from the carrier's axes to the scene's, of unit
        length within 1e-3. None if the carrier is level and faces its direction of travel.
    smooth
        Positions and quaternions follow cubic splines, whose accelerations do not jump, and stand
        still between equal poses. Otherwise positions follow straight lines, and rotations turn
        evenly about one axis from each pose to the next (Shoemake, 1985).
    start_s
        Start of the station, by the same clock; by default the first time.
    duration_s
        Duration of the station; by default until the last time.
    beyond
        Before the first and after the last time "refuse" raises an error. An actor stays at its
        first or last pose with "hold", and is not in the scene with "absent".

    Raises
    ------
    LidarError
        If there are fewer than two poses, a number is not finite, times do not ascend, a
        quaternion is invalid, or the station is not within the times.

    Examples
    --------
    >>> track = Track([0, 2], [[0, 0, 1], [20, 0, 1]])
    >>> track.pose(0, 0.5e9).position, track.duration_ns
    ((5.0, 0.0, 1.0), 2000000000.0)
    """

    times_s: Floats
    positions: Floats
    quaternions: Floats | None = None
    smooth: bool = False
    start_s: float | None = None
    duration_s: float | None = None
    beyond: Beyond = "refuse"
    stations: ClassVar[int] = 1
    moves: ClassVar[bool] = True

    def __post_init__(self) -> None:
        times = as_array("times_s", self.times_s).copy()
        places = as_array("positions", self.positions).copy()
        if times.ndim != 1 or len(times) < 2 or places.shape != (len(times), 3):
            raise LidarError(
                f"A trajectory needs two poses at least, with x, y and z each; there are "
                f"{times.size} times and positions of {places.shape}."
            )
        _refuse(~np.isfinite(times), "the time of pose {} is not finite")
        finite = np.isfinite(places[:, 0] + places[:, 1] + places[:, 2])
        _refuse(~finite, "the position of pose {} is not finite")
        late = np.append(False, np.diff(times) <= 0)
        _refuse(late, "times must ascend, and that of pose {} does not come after the one before")
        if self.quaternions is None:
            slopes = np.gradient(places, times, axis=0).T
            turns = _along(knots_of(times, places.T)[1] if self.smooth else slopes)
        else:
            turns = as_array("quaternions", self.quaternions).copy()
            if turns.shape != (len(times), 4):
                raise LidarError(
                    f"quaternions are x, y, z and w of each of the {len(times)} poses, not "
                    f"{turns.shape}."
                )
        lengths = length(turns)
        # Written so that NaN is an error.
        bad = ~(np.abs(lengths - 1) <= QUATERNION_SLACK)
        _refuse(bad, "the quaternion of pose {} is not of length 1")
        turns /= lengths[:, None]
        for name, array in (("times_s", times), ("positions", places), ("quaternions", turns)):
            array.flags.writeable = False
            object.__setattr__(self, name, array)
        start = times[0] if self.start_s is None else self.start_s
        last = times[-1] if self.duration_s is None else start + self.duration_s
        most = CLOCK_S if self.beyond == "refuse" else np.inf
        for what, time in (("start_s", start), ("the end by duration_s", last)):
            gap = max(times[0] - time, time - times[-1])
            if not gap <= most:  # or NaN
                raise LidarError(
                    f"{what} is {time:.9g} s, {gap:.6g} s outside the trajectory, which goes from "
                    f"{times[0]:.9g} to {times[-1]:.9g} s."
                )
        if self.beyond == "refuse" and last <= start:
            raise LidarError(f"A trajectory from {start:.9g} to {last:.9g} s has no duration.")
        object.__setattr__(self, "start_s", float(start))
        object.__setattr__(self, "duration_s", float(max(last - start, 0.0)))

    @property
    def duration_ns(self) -> float:
        """See `Trajectory.duration_ns`."""
        assert self.duration_s is not None  # set above
        return self.duration_s * 1e9

    @property
    def presence_ns(self) -> tuple[float, float]:
        """First and last nanosecond at which an actor is in the scene, see `beyond`."""
        if self.beyond != "absent":
            return ALWAYS
        assert self.start_s is not None  # set above
        first, last = (self.times_s[[0, -1]] - self.start_s) * 1e9
        return float(first), float(last)

    @property
    def slack_s(self) -> float:
        """How far outside the trajectory a time may be, seconds."""
        return _FIRING_S if self.beyond == "refuse" else np.inf

    def pose(self, station: int, time_ns: float = 0.0) -> Pose:
        """See `Trajectory.pose`."""
        positions, rotations = self.poses(station, np.array([time_ns], np.float64))
        return Pose.of(positions[0], rotations[0])

    def poses(self, station: int, times_ns: Floats) -> tuple[Floats, Floats]:
        """See `Trajectory.poses`.

        Raises
        ------
        LidarError
            If a time is not within the trajectory.
        """
        segment, since, _ = self._at(times_ns)
        if self.smooth:
            values, _ = on_curve(*self._spline, segment, since, False)
            turns = values[3:] / np.sqrt((values[3:] ** 2).sum(axis=0))
            return values[:3].T, matrices(turns.T)
        if len(segment) and segment.max() == segment.min():
            segment = segment[:1]  # all are in one
        start, speed, turn, rates, _ = self.segments
        positions = speed.take(segment, axis=1) * since + start.take(segment, axis=1)
        angle = since * rates.take(segment)
        rotations = turn[0].take(segment, axis=1)
        for factor, table in zip(sin_cos(angle), turn[1:], strict=True):
            rotations = rotations + factor * table.take(segment, axis=1)
        return positions.T, rotations.reshape(3, 3, -1).transpose(2, 0, 1)

    def velocities(self, station: int, times_ns: Floats) -> tuple[Floats, Floats]:
        """See `velocities`: exact derivatives of its curves, at a given pose those behind it.

        Raises
        ------
        LidarError
            If a time is not within the trajectory.
        """
        segment, since, within = self._at(times_ns)
        if self.smooth:
            q, p = on_curve(*self._spline, segment, since, True)
            # 2 p conjugate(q); the length of q may be any, and change.
            turn = q[6] * p[3:6] - p[6] * q[3:6] - np.cross(p[3:6], q[3:6], axis=0)
            speeds = p[:3]
            rates = 2 * turn / (q[3:] ** 2).sum(axis=0)
        else:
            speeds, rates = (self.segments[k].take(segment, axis=1) for k in (1, 4))
        return (speeds * within).T, (rates * within).T

    def _at(self, times_ns: Floats) -> tuple[Indices, Floats, Bools]:
        """Return segments of times (k,), seconds since these began, and whether it moves then."""
        assert self.start_s is not None  # set above
        times = self.times_s
        at = times_ns / 1e9 + self.start_s
        low = at.min(initial=np.inf)
        high = at.max(initial=-np.inf)
        gap = max(times[0] - low, high - times[-1])
        within = np.ones(len(at), np.bool_)
        if self.beyond != "refuse":
            within = (times[0] <= at) & (at <= times[-1])
            at = at.clip(times[0], times[-1])
        elif gap > self.slack_s:
            raise LidarError(
                f"The trajectory goes from {times[0]:.9g} to {times[-1]:.9g} s; poses are asked "
                f"for from {low:.9g} to {high:.9g} s, {gap:.6g} s outside."
            )
        segment = np.clip(np.searchsorted(times, at, "right") - 1, 0, len(times) - 2)
        return segment, at - times.take(segment), within

    @cached_property
    def _spline(self) -> tuple[Floats, Floats]:
        """Knots of positions and quaternions, of which each is the nearer to the last; steps."""
        turns = self.quaternions
        assert turns is not None  # set above
        flips = np.cumsum((turns[1:] * turns[:-1]).sum(axis=1) < 0)
        groups = self.positions.T, turns.T * (1.0 - 2 * np.append(0, flips % 2))
        knots = [knots_of(self.times_s, group) for group in groups]
        return np.concatenate(knots, axis=1), np.diff(self.times_s)

    @cached_property
    def segments(self) -> tuple[Floats, ...]:
        """Coefficients of poses on straight ways, one column for each of s segments.

        Positions at their starts and velocities (3, s); of the rotation (3, 9, s), which is
        ``turn[0] + sin(a) turn[1] + cos(a) turn[2]`` (Rodrigues, 1840), a the angle since then;
        and rates, radians a second, of that angle (s,) and about the scene's axes (3, s).
        """
        speeds = np.diff(self.positions, axis=0) / np.diff(self.times_s)[:, None]
        turns = self.quaternions
        assert turns is not None  # set above
        axis, rates = _between(turns, self.times_s)
        x, y, z = axis.T
        zero = np.zeros_like(x)
        about = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)
        start = matrices(turns[:-1])
        tilted = matmul(start, about)
        square = matmul(tilted, about)
        table = np.stack([start + square, tilted, -square]).reshape(3, -1, 9)
        spins = applied(start, axis * rates)
        parts = self.positions[:-1], speeds, spins
        begin, speed, spin = (np.ascontiguousarray(part.T) for part in parts)
        return begin, speed, np.ascontiguousarray(table.transpose(0, 2, 1)), rates[:, 0], spin


def _between(quaternions: Floats, times_s: Floats) -> tuple[Floats, Floats]:
    """Axes (s, 3) and rates (s, 1), rad/s, of turns from each pose to the next, in its axes."""
    # conjugate(p) q
    (p, pw), (q, qw) = ((t[:, :3], t[:, 3:]) for t in (quaternions[:-1], quaternions[1:]))
    axis = pw * q - qw * p - np.cross(p, q)
    cosine = (p * q).sum(axis=1, keepdims=True) + pw * qw
    axis = np.where(cosine < 0, -axis, axis)  # the shorter rotation
    sine = length(axis)[:, None]
    rates = 2 * arctan2(sine, np.abs(cosine)) / np.diff(times_s)[:, None]
    return axis / np.where(sine > 0, sine, 1), rates


def matrices(quaternions: Floats) -> Floats:
    """Rotation matrices (k, 3, 3) of unit quaternions x, y, z, w (k, 4)."""
    x, y, z, w = quaternions.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), -1, 0)


def quaternions_of(rotations: Floats) -> Floats:
    """Return unit quaternions x, y, z, w (k, 4) of matrices (k, 3, 3), which may be rounded.

    The eigenvector of the greatest eigenvalue (Bar-Itzhack, 2000), by power iteration: plus one,
    the others are about as small as the matrices are rounded, and zero for exact rotations.
    """
    m = np.moveaxis(rotations, 0, -1)
    table = np.zeros((len(rotations), 4, 4))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        table[:, i, i] = m[i, i] - m[j, j] - m[k, k]
        table[:, i, j] = table[:, j, i] = m[i, j] + m[j, i]
        table[:, k, 3] = table[:, 3, k] = m[j, i] - m[i, j]
    table[:, 3, 3] = m[0, 0] + m[1, 1] + m[2, 2]
    table += np.eye(4)
    best = np.diagonal(table, axis1=1, axis2=2).argmax(axis=1)
    found = table[np.arange(len(table)), best]
    for _ in range(_ROUNDS):
        found = applied(table, found / length(found)[:, None])
    return np.asarray(found / length(found)[:, None])


def _along(slopes: Floats) -> Floats:
    """Quaternions (k, 4) of a level carrier that faces its direction of travel.

    While it stands it keeps its direction; before it first moves it faces its first direction.
    """
    x, y, _ = slopes
    moving = np.flatnonzero(hypot(x, y) > 1e-9)
    if not len(moving):
        moving = np.zeros(1, np.intp)
    last = moving[np.maximum(np.searchsorted(moving, np.arange(len(x)), "right") - 1, 0)]
    half = arctan2(y[last], x[last]) / 2
    return np.stack([np.zeros_like(half), np.zeros_like(half), *sin_cos(half)], axis=1)


def _refuse(bad: Bools, words: str) -> None:
    """Raise LidarError if any is bad, with the number of the first."""
    if bad.any():
        raise LidarError(f"{words.format(int(bad.argmax()))} (poses are counted from 0).")

"""Poses, and trajectories that provide a pose for each firing."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, InitVar, dataclass, replace
from functools import cached_property
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike

from ..errors import ArgumentError, LidarError
from ..numerics.arrays import Bools, Floats, Indices
from ..numerics.elementary import arctan2, sin_cos
from ..numerics.vectors import hypot, matmul, matmul_of_components, matvec, norm
from ..schema.checks import as_array, check_fields
from ..schema.declared import AngleDeg, FileSection, Triple, about, accept_short_form, scenario_type
from ..schema.value_texts import format_value, one_line
from ..words import format_rounded, join_names
from .headings import CurveHeadings, Heading, headed_poses
from .rotations import (
    check_rotations,
    matrices,
    matrices_by_component,
    quaternions_of,
    rotation_sines,
    rotation_terms,
    rotations_between,
    rotations_of,
)
from .spline import evaluate_curve, fit_knots

QUATERNION_SLACK = 1e-3  # tolerance for the norm of a quaternion, which is rounded in files
# Tolerance for times, because double precision is coarser than a nanosecond for times since 1970.
CLOCK_S = 1e-6
# Tolerance for the last beams, which are fired shortly after the pose of the last firing.
_FIRING_S = 1e-3

_STEP_NS = 5e5  # half the interval of the difference quotients

ALWAYS = (-np.inf, np.inf)

Beyond = Literal["refuse", "hold", "absent"]


@dataclass(frozen=True)
class Pose(FileSection):
    """Position and orientation of a sensor or platform.

    The position is in meters. The angles are yaw, pitch and roll in degrees, applied in the
    aerospace order: yaw about z, then pitch about the new y, then roll about the new x.
    """

    position: Annotated[
        tuple[float, float, float], scenario_type(Triple), about("x, y and z in meters")
    ]
    yaw_deg: Annotated[AngleDeg, about("rotation about z in degrees, applied first")] = 0.0
    pitch_deg: Annotated[
        AngleDeg, about("rotation about the new y axis in degrees, applied second")
    ] = 0.0
    roll_deg: Annotated[
        AngleDeg, about("rotation about the new x axis in degrees, applied last")
    ] = 0.0

    __repr__ = one_line

    def __post_init__(self) -> None:
        check_fields(self)
        object.__setattr__(self, "position", tuple(map(float, self.position)))

    @property
    def rotation(self) -> Floats | None:
        """Rotation matrix from the sensor frame to the scene frame, or None without a rotation.

        The shape is (3, 3).
        """
        if not (self.yaw_deg or self.pitch_deg or self.roll_deg):
            return None
        return rotations_of(np.array([self.yaw_deg, self.pitch_deg, self.roll_deg]))

    @property
    def rotation_matrix(self) -> Floats:
        """Rotation matrix from the sensor frame to the scene frame.

        The shape is (3, 3). Without rotation, this is the identity matrix.
        """
        return np.eye(3) if self.rotation is None else self.rotation

    def compose(self, mount: Pose) -> Pose:
        """Return the pose of an instrument mounted at `mount` on a platform with this pose."""
        if mount == CENTER:
            return self
        rotation = self.rotation_matrix
        position = self.position + matvec(rotation, mount.position)
        return Pose.from_rotation(position, matmul(rotation, mount.rotation_matrix))

    @classmethod
    def from_rotation(cls, position: ArrayLike, rotation: Floats | None) -> Pose:
        """Create a pose from a position and a rotation matrix.

        Parameters
        ----------
        position
            Coordinates in meters. Shape (3,).
        rotation
            Rotation matrix of shape (3, 3), or None for no rotation.

        Raises
        ------
        LidarError
            If the matrix is not a rotation matrix.
        """
        coordinates = tuple(np.asarray(position, np.float64).tolist())
        if rotation is None:
            return cls(coordinates)
        check_rotations(np.asarray(rotation, np.float64)[None])
        level = hypot(rotation[0, 0], rotation[1, 0])
        pitch = arctan2(-rotation[2, 0], level)
        if level > 1e-9:
            yaw = arctan2(rotation[1, 0], rotation[0, 0])
            roll = arctan2(rotation[2, 1], rotation[2, 2])
        else:  # +x points straight up or down, so that yaw and roll have the same axis
            yaw = arctan2(-rotation[0, 1], rotation[1, 1])
            roll = np.zeros(())
        return cls(coordinates, *np.degrees([yaw, pitch, roll]).tolist())


def as_pose(name: str, value: Any) -> Pose:
    """Convert a position to a pose. A pose is returned unchanged.

    Parameters
    ----------
    name
        Name of the argument for error messages.
    value
        Pose, or x, y and z in meters.

    Raises
    ------
    LidarError
        If the value is neither a pose nor three numbers.
    """
    if isinstance(value, Pose):
        return value
    try:
        position = tuple(map(float, value))
    except (TypeError, ValueError) as error:
        raise LidarError(
            f"{name} must be a Pose, or x, y and z in meters, such as (0, 0, 1), but is "
            f"{format_value(value)}."
        ) from error
    return Pose(position)  # type: ignore[arg-type]  # Pose checks the length


CENTER = Pose((0.0, 0.0, 0.0))  # mount of a sensor without a platform


@dataclass(frozen=True, repr=False)
class InstrumentPose(Pose):
    """Position and angles of an instrument in the platform frame, as written in a file."""

    position: Annotated[Triple, about("x, y and z in meters")] = (0, 0, 0)


# A pose in a file, whose position is optional. A list of numbers is a position without angles.
AT_CENTER = accept_short_form(
    lambda v: isinstance(v, (dict, list)),
    lambda v: {"position": v} if isinstance(v, list) else {"position": [0] * 3} | v,
    Triple | InstrumentPose,
)


class Trajectory(Protocol):
    """Protocol for trajectories, which consist of one or more stations.

    A sensor may move during a station, and it jumps from each station to the next. The head keeps
    rotating during the scans of a station.
    """

    @property
    def stations(self) -> int:
        """Number of stations."""

    @property
    def moves(self) -> bool:
        """Whether the sensor moves within a station, so that each firing has its own pose."""

    @property
    def duration_ns(self) -> float:
        """Maximum duration of a station in nanoseconds, which may be infinite."""

    def pose(self, station: int, time_ns: float = 0.0) -> Pose:
        """Return the pose at a given time in nanoseconds since the start of a station."""

    def poses(self, station: int, times_ns: Floats) -> tuple[Floats, Floats | None]:
        """Return the positions and rotations at the given times.

        Ray casting is fastest if each component is contiguous over the poses.

        Parameters
        ----------
        station
            Index of the station.
        times_ns
            Times in nanoseconds since the start of the station. Shape (k,).

        Returns
        -------
        tuple
            Positions (k, 3) in meters, and rotation matrices (k, 3, 3) or None without rotation.
        """


def presence_ns(path: Trajectory) -> tuple[float, float]:
    """Return the times at which an actor on a trajectory enters and leaves the scene.

    The times are in nanoseconds since the start of the station. An actor is always in the scene if
    the class of its trajectory has no property `presence_ns`.
    """
    first, last = getattr(path, "presence_ns", ALWAYS)
    return float(first), float(last)


def full_poses(path: Trajectory, station: int, times_ns: Floats) -> tuple[Floats, Floats]:
    """Return the result of `path.poses`, with identity matrices for missing rotations."""
    positions, rotations = path.poses(station, times_ns)
    if rotations is None:
        rotations = np.broadcast_to(np.eye(3), (len(times_ns), 3, 3))
    return positions, rotations


def mounted_poses(
    path: Trajectory, station: int, mount: Pose, times_ns: Floats
) -> tuple[Floats, Floats]:
    """Return the poses of an instrument that is mounted on a platform.

    Parameters
    ----------
    path
        Trajectory of the platform.
    station
        Number of the station.
    mount
        Pose of the instrument in the platform frame.
    times_ns
        Times since the start of the station in nanoseconds, with shape (k,).

    Returns
    -------
    tuple of arrays
        Positions (k, 3) in meters and rotation matrices (k, 3, 3), in the scene frame.
    """
    positions, rotations = full_poses(path, station, times_ns)
    lever_arms = matvec(rotations, mount.position)
    return positions + lever_arms, matmul(rotations, mount.rotation_matrix)


def check_trajectory_type(name: str, value: object) -> None:
    """Check that an argument is a trajectory and not, for example, the path of a file.

    Raises
    ------
    ArgumentError
        If the argument is not a trajectory.
    """
    if not hasattr(value, "poses"):
        raise ArgumentError(
            f"{name} must be a trajectory, but is {format_value(value)}. To read a file, use "
            "load_trajectory('drive.tum')."
        )


def velocities(path: Trajectory, station: int, times_ns: Floats) -> tuple[Floats, Floats]:
    """Return the linear and angular velocities along a trajectory.

    If the class of the trajectory has a method `velocities(station, times_ns)`, as in this package,
    that method is called. Otherwise, the velocities are difference quotients over 1 ms.

    Returns
    -------
    velocities
        Velocities of the platform origin in the scene frame, in m/s. Shape (k, 3).
    rates
        Angular velocities in the scene frame, in rad/s. Shape (k, 3).
    """
    if not path.moves:
        return np.zeros((len(times_ns), 3)), np.zeros((len(times_ns), 3))
    exact_velocities = getattr(path, "velocities", None)
    if exact_velocities is not None:
        linear, angular = exact_velocities(station, times_ns)
        return linear, angular
    early_ns = np.clip(times_ns - _STEP_NS, 0, path.duration_ns)
    late_ns = np.clip(times_ns + _STEP_NS, 0, path.duration_ns)
    seconds = np.maximum(late_ns - early_ns, 1)[:, None] / 1e9
    early_positions, early_rotations = path.poses(station, early_ns)
    late_positions, late_rotations = path.poses(station, late_ns)
    speeds = (late_positions - early_positions) / seconds
    if early_rotations is None or late_rotations is None:
        return speeds, np.zeros((len(times_ns), 3))
    change = matmul(late_rotations, early_rotations.transpose(0, 2, 1))
    return speeds, rotation_sines(change) / (2 * seconds)


@dataclass(frozen=True)
class Stations:
    """A trajectory of a sensor that scans from one stationary pose after another."""

    at: tuple[Pose, ...]
    moves: ClassVar[bool] = False
    duration_ns: ClassVar[float] = np.inf
    __repr__ = one_line

    @property
    def stations(self) -> int:
        """Number of stations, which equals the number of poses."""
        return len(self.at)

    def pose(self, station: int, time_ns: float = 0.0) -> Pose:
        """Return the pose of a station, regardless of the time."""
        return self.at[station]

    def poses(self, station: int, times_ns: Floats) -> tuple[Floats, Floats | None]:
        """Return the pose of a station, repeated for each time.

        For `times_ns` of shape (k,), the positions have shape (k, 3) and the rotations have shape
        (k, 3, 3). The rotations are None if the pose has no rotation.
        """
        pose = self.at[station]
        count = len(times_ns)
        rotation = pose.rotation
        rotations = None if rotation is None else np.broadcast_to(rotation, (count, 3, 3))
        return np.broadcast_to(np.array(pose.position), (count, 3)), rotations


@dataclass(frozen=True, eq=False)
class StaticPose:
    """A trajectory that stays at a single pose, given by a position and a rotation matrix.

    Attributes
    ----------
    position
        Position in meters. Shape (3,).
    rotation
        Rotation matrix from the platform frame to the scene frame. Shape (3, 3).
    """

    position: Floats
    rotation: Floats
    stations: ClassVar[int] = 1
    moves: ClassVar[bool] = False
    duration_ns: ClassVar[float] = np.inf

    def pose(self, station: int, time_ns: float = 0.0) -> Pose:
        """Return the pose, regardless of the time."""
        return Pose.from_rotation(self.position, self.rotation)

    def poses(self, station: int, times_ns: Floats) -> tuple[Floats, Floats]:
        """Return the pose, repeated for each time.

        For `times_ns` of shape (k,), the positions have shape (k, 3) and the rotations have shape
        (k, 3, 3).
        """
        count = len(times_ns)
        return (
            np.broadcast_to(self.position, (count, 3)),
            np.broadcast_to(self.rotation, (count, 3, 3)),
        )


@dataclass(frozen=True, eq=False)
class Track:
    """A trajectory that interpolates timed poses along straight lines or smooth curves.

    A track has a single station.

    Parameters
    ----------
    times_s
        Times of the poses in seconds, in ascending order, with an arbitrary zero. Shape (k,),
        float64.
    positions
        Positions in scene coordinates, in meters. Shape (k, 3), float64.
    quaternions
        Rotations from the platform frame to the scene frame, as quaternions (x, y, z, w) with a
        norm of 1 within 1e-3. Shape (k, 4), float64. If None, the platform is level and faces its
        direction of travel, which is the tangent of its path. On a linear path, it turns within 1 m
        before and after each corner. If the adjacent segments are shorter than 2 m, it turns from
        the center of one segment to the center of the next. A platform that is stationary or moves
        vertically keeps its heading and turns to the next heading in the last second.
    smooth
        If True, positions and quaternions follow cubic splines with continuous accelerations, and
        they are constant between equal poses. Otherwise, positions follow straight lines, and the
        platform rotates at a constant rate about one axis between two poses (Shoemake, 1985).
    start_s
        Start of the station on the time scale of `times_s`. The default is the first time.
    duration_s
        Duration of the station in seconds. By default, the station ends at the last time.
    beyond
        Behavior before the first and after the last time: "refuse" raises an error, "hold" keeps an
        actor at its first or last pose, and "absent" removes an actor from the scene.
    yaw_deg, pitch_deg, roll_deg
        Angles of the poses in degrees, as in `Pose`, as an alternative to `quaternions`. Each is
        either one angle for all poses or an array of shape (k,). Pitch and roll are zero by default
        and require yaw. The track converts the angles to `quaternions`.

    Raises
    ------
    LidarError
        If there are fewer than two poses, a number is not finite, the times do not increase, a
        quaternion is invalid, the station is outside the times, both quaternions and angles are
        passed, or pitch or roll are passed without yaw.

    Examples
    --------
    >>> track = Track([0, 2], [[0, 0, 1], [20, 0, 1]])
    >>> track.pose(0, 0.5e9).position, track.duration_ns
    ((5.0, 0.0, 1.0), 2000000000.0)
    >>> Track([0, 2], [[0, 0, 1], [20, 0, 1]], yaw_deg=[0, 90]).pose(0, 1e9).yaw_deg
    45.0
    """

    times_s: Floats
    positions: Floats
    quaternions: Floats | None = None
    smooth: bool = False
    start_s: float | None = None
    duration_s: float | None = None
    beyond: Beyond = "refuse"
    _: KW_ONLY
    yaw_deg: InitVar[ArrayLike | None] = None
    pitch_deg: InitVar[ArrayLike | None] = None
    roll_deg: InitVar[ArrayLike | None] = None
    stations: ClassVar[int] = 1
    moves: ClassVar[bool] = True

    __repr__ = one_line

    def __post_init__(
        self,
        yaw_deg: ArrayLike | None,
        pitch_deg: ArrayLike | None,
        roll_deg: ArrayLike | None,
    ) -> None:
        check_fields(self)
        angles = {"yaw_deg": yaw_deg, "pitch_deg": pitch_deg, "roll_deg": roll_deg}
        if given := {name: angle for name, angle in angles.items() if angle is not None}:
            self._set_quaternions(given)
        self._set_poses()
        self._set_span()

    @classmethod
    def from_matrices(
        cls, times_s: Floats, matrices: Floats, beyond: Literal["refuse", "hold"] = "refuse"
    ) -> Sequence[Track]:
        """Create a linear track for each of k bodies from transformation matrices.

        The tracks share their data, so that the poses of all tracks can be computed together.

        Each track starts at time 0 of `times_s`, even if the first pose is earlier or later.

        Parameters
        ----------
        times_s
            Times of the poses of all tracks in seconds, in ascending order. Shape (s,), at least
            two.
        matrices
            Rigid transforms, which are not validated. Shape (k, s, 4, 4).
        beyond
            As in `Track`.

        Raises
        ------
        LidarError
            If there are fewer than two times, or if the times do not increase.
        """
        times = np.asarray(times_s, np.float64)
        if len(times) < 2:
            raise LidarError(f"A trajectory requires at least two poses, but has {len(times)}.")
        _check_times(times)
        batch = TrackBatch.from_matrices(times, matrices, beyond)
        return [_BatchTrack.from_batch(batch, number) for number in range(len(matrices))]

    def _set_quaternions(self, angles: Mapping[str, ArrayLike]) -> None:
        """Compute the quaternions from angles in degrees, keyed by parameter name.

        Each entry is either one angle for all poses or an array of shape (k,).
        """
        if self.quaternions is not None:
            raise LidarError(
                f"quaternions and {join_names([*angles])} both define the rotations. Pass only one "
                "of them."
            )
        if "yaw_deg" not in angles:
            raise LidarError(
                f"{join_names([*angles])} cannot be used without yaw_deg. Pass yaw_deg as well, "
                "for example yaw_deg=0."
            )
        poses = np.size(self.times_s)
        table = np.zeros((poses, 3))
        for axis, name in enumerate(("yaw_deg", "pitch_deg", "roll_deg")):
            values = as_array(name, angles.get(name, 0.0))
            if values.shape not in ((), (poses,)) or not np.isfinite(values).all():
                raise LidarError(
                    f"{name} must be a finite angle, or one finite angle for each of the {poses} "
                    f"poses, but is {format_value(angles[name])}."
                )
            table[:, axis] = values
        object.__setattr__(self, "quaternions", quaternions_of(rotations_of(table)))

    def _set_poses(self) -> None:
        """Validate the times, positions and quaternions, and replace them with read-only copies."""
        times = as_array("times_s", self.times_s).copy()
        positions = as_array("positions", self.positions).copy()
        if times.ndim != 1 or len(times) < 2 or positions.shape != (len(times), 3):
            raise LidarError(
                "A trajectory requires at least two poses, with x, y and z for each time, but "
                f"has {times.size} times and positions of the shape {positions.shape}."
            )
        finite = np.isfinite(positions[:, 0] + positions[:, 1] + positions[:, 2])
        _check_poses(~finite, "The position of pose {} is not finite")
        _check_times(times)
        arrays = {"times_s": times, "positions": positions}
        if self.quaternions is not None:
            quaternions = as_array("quaternions", self.quaternions).copy()
            if quaternions.shape != (len(times), 4):
                raise LidarError(
                    f"quaternions must contain x, y, z and w for each of the {len(times)} poses, "
                    f"but has the shape {quaternions.shape}."
                )
            lengths = norm(quaternions)
            # The comparison is also false for NaN.
            bad = ~(np.abs(lengths - 1) <= QUATERNION_SLACK)
            _check_poses(bad, "The quaternion of pose {} is not of unit length")
            quaternions /= lengths[:, None]
            arrays["quaternions"] = quaternions
        for name, array in arrays.items():
            array.flags.writeable = False
            object.__setattr__(self, name, array)

    def _set_span(self) -> None:
        """Set the start and duration of the station, and check that both are within the times."""
        times = self.times_s
        start = times[0] if self.start_s is None else self.start_s
        last = times[-1] if self.duration_s is None else start + self.duration_s
        max_gap_s = CLOCK_S if self.beyond == "refuse" else np.inf
        for label, time in (("start_s", start), ("start_s + duration_s", last)):
            gap = max(times[0] - time, time - times[-1])
            if not gap <= max_gap_s:  # also true for NaN
                raise LidarError(
                    f"{label} is {time:.9g} s, which is {gap:.6g} s outside the trajectory. It "
                    f"covers {times[0]:.9g} to {times[-1]:.9g} s."
                )
        if self.beyond == "refuse" and last <= start:
            raise LidarError(
                f"The duration of a trajectory must be greater than 0, but it covers {start:.9g} "
                f"to {last:.9g} s."
            )
        object.__setattr__(self, "start_s", float(start))
        object.__setattr__(self, "duration_s", float(max(last - start, 0.0)))

    @property
    def duration_ns(self) -> float:
        """Duration of the station in nanoseconds."""
        assert self.duration_s is not None  # set in __post_init__
        return self.duration_s * 1e9

    @property
    def presence_ns(self) -> tuple[float, float]:
        """Times at which an actor on this track enters and leaves the scene.

        The times are in nanoseconds since the start of the station. They are infinite unless
        `beyond` is "absent".
        """
        if self.beyond != "absent":
            return ALWAYS
        assert self.start_s is not None  # set in __post_init__
        first, last = (self.times_s[[0, -1]] - self.start_s) * 1e9
        return float(first), float(last)

    @property
    def slack_s(self) -> float:
        """Time in seconds before and after the track within which poses may be requested."""
        return _FIRING_S if self.beyond == "refuse" else np.inf

    def pose(self, station: int, time_ns: float = 0.0) -> Pose:
        """Return the pose at a given time in nanoseconds since the start of the station."""
        positions, rotations = self.poses(station, np.array([time_ns], np.float64))
        return Pose.from_rotation(positions[0], rotations[0])

    def poses(self, station: int, times_ns: Floats) -> tuple[Floats, Floats]:
        """Return the positions and rotations at the given times.

        Parameters
        ----------
        station
            Index of the station, which is ignored because a track has a single station.
        times_ns
            Times in nanoseconds since the start of the station. Shape (k,).

        Returns
        -------
        tuple
            Positions (k, 3) in meters and rotation matrices (k, 3, 3).

        Raises
        ------
        LidarError
            If a time is not within the trajectory.
        """
        if self.with_turns is not self:
            return self.with_turns.poses(station, times_ns)
        segment, since, _ = self._segments_at(times_ns)
        if self.smooth:
            (values,) = evaluate_curve(*self._spline, segment, since)
            if self._headings is not None:
                return values.T, _level_rotations(self._headings.at(segment, since))
            quaternions = values[3:] / np.sqrt((values[3:] ** 2).sum(axis=0))
            return values[:3].T, matrices(quaternions.T)
        if len(segment) and segment.max() == segment.min():
            segment = segment[:1]  # all times are in one segment
        segments = self.segments
        moved = segments.velocities.take(segment, axis=1) * since
        positions = moved + segments.starts.take(segment, axis=1)
        angle = since * segments.rates.take(segment)
        rotations = segments.rotation_terms[0].take(segment, axis=1)
        for factor, table in zip(sin_cos(angle), segments.rotation_terms[1:], strict=True):
            rotations = rotations + factor * table.take(segment, axis=1)
        return positions.T, rotations.reshape(3, 3, -1).transpose(2, 0, 1)

    def velocities(self, station: int, times_ns: Floats) -> tuple[Floats, Floats]:
        """Return the linear and angular velocities at the given times.

        Both velocities are in the scene frame and are exact derivatives of the path. At a pose of
        the track, they are the derivatives of the next segment.

        Parameters
        ----------
        station, times_ns
            As in `poses`.

        Returns
        -------
        tuple
            Linear velocities (k, 3) in m/s and angular velocities (k, 3) in rad/s.

        Raises
        ------
        LidarError
            If a time is not within the trajectory.
        """
        if self.with_turns is not self:
            return self.with_turns.velocities(station, times_ns)
        segment, since, within = self._segments_at(times_ns)
        if self.smooth and self._headings is not None:
            _, speeds = evaluate_curve(*self._spline, segment, since, 1)
            rates = np.zeros_like(speeds)
            rates[2] = self._headings.at(segment, since).rates
        elif self.smooth:
            q, p = evaluate_curve(*self._spline, segment, since, 1)
            # The angular velocity is 2 p conjugate(q). The norm of q is arbitrary and may vary.
            vector_part = q[6] * p[3:6] - p[6] * q[3:6] - np.cross(p[3:6], q[3:6], axis=0)
            speeds = p[:3]
            rates = 2 * vector_part / (q[3:] ** 2).sum(axis=0)
        else:
            speeds = self.segments.velocities.take(segment, axis=1)
            rates = self.segments.spins.take(segment, axis=1)
        return (speeds * within).T, (rates * within).T

    def _segments_at(self, times_ns: Floats) -> _SegmentTimes:
        """Return the segments for the given times in nanoseconds since the start of the station."""
        assert self.start_s is not None  # set in __post_init__
        times = self.times_s
        moments_s = times_ns / 1e9 + self.start_s
        first_s = moments_s.min(initial=np.inf)
        last_s = moments_s.max(initial=-np.inf)
        gap = max(times[0] - first_s, last_s - times[-1])
        within = np.ones(len(moments_s), np.bool_)
        if self.beyond != "refuse":
            within = (times[0] <= moments_s) & (moments_s <= times[-1])
            moments_s = moments_s.clip(times[0], times[-1])
        elif gap > self.slack_s:
            gaps_s = {"first": times[0] - first_s, "last": last_s - times[-1]}
            parts = [
                f"the {end} {format_rounded(s)} s" for end, s in gaps_s.items() if s > self.slack_s
            ]
            raise LidarError(
                f"The trajectory covers {times[0]:.9g} to {times[-1]:.9g} s, but poses from "
                f"{first_s:.9g} to {last_s:.9g} s are required, so {join_names(parts)} are not "
                "covered."
            )
        segment = np.clip(np.searchsorted(times, moments_s, "right") - 1, 0, len(times) - 2)
        return _SegmentTimes(segment, moments_s - times.take(segment), within)

    @cached_property
    def with_turns(self) -> Track:
        """Equivalent track with quaternions, and with additional poses where turns begin and end.

        A track that is smooth or already has quaternions is returned unchanged.
        """
        if self.smooth or self.quaternions is not None:
            return self
        return replace(self, **headed_poses(self.times_s, self.positions)._asdict())

    @cached_property
    def _headings(self) -> CurveHeadings | None:
        """Headings of a smooth track without quaternions, or None for any other track."""
        if not self.smooth or self.quaternions is not None:
            return None
        return CurveHeadings.from_knots(self.times_s, self._spline[0])

    @cached_property
    def _spline(self) -> tuple[Floats, Floats]:
        """Knots of positions and quaternions, and time steps in seconds, for `evaluate_curve`.

        The knots have shape (3, d, k), where d is 7, or 3 without quaternions. The steps have shape
        (k - 1,). The sign of each quaternion is chosen so that it is close to the previous one.
        """
        quaternions = self.quaternions
        groups = [self.positions.T]
        if quaternions is not None:
            flips = np.cumsum((quaternions[1:] * quaternions[:-1]).sum(axis=1) < 0)
            groups.append(quaternions.T * (1.0 - 2 * np.append(0, flips % 2)))
        knots = [fit_knots(self.times_s, group) for group in groups]
        return np.concatenate(knots, axis=1), np.diff(self.times_s)

    @cached_property
    def segments(self) -> Segments:
        """Coefficients of the straight segments between the poses of `with_turns`."""
        track = self.with_turns
        quaternions = track.quaternions
        assert quaternions is not None  # linear tracks with turns have quaternions
        return _segments(
            np.diff(track.times_s),
            track.positions[:-1],
            track.positions[1:],
            quaternions[:-1],
            quaternions[1:],
        )


class Segments(NamedTuple):
    """Coefficients from which the poses on segments of a track are computed.

    The arrays have one column per segment.

    Attributes
    ----------
    starts
        Positions at the start of each segment, in meters. Shape (3, s).
    velocities
        Velocities in m/s. Shape (3, s).
    rotation_terms
        Coefficients of the rotation matrix, from `rotations.rotation_terms`. Shape (3, 9, s).
    rates
        Rates of the rotation angle in rad/s. Shape (s,).
    spins
        Angular velocities in the scene frame, in rad/s. Shape (3, s).
    """

    starts: Floats
    velocities: Floats
    rotation_terms: Floats
    rates: Floats
    spins: Floats


def _segments(
    durations_s: Floats, starts: Floats, stops: Floats, first: Floats, last: Floats
) -> Segments:
    """Create segments from the poses at their ends.

    Parameters
    ----------
    durations_s
        Durations in seconds. Shape (s,).
    starts, stops
        Positions at the start and the end of each segment. Shape (s, 3).
    first, last
        Quaternions at the start and the end of each segment. Shape (s, 4).
    """
    first_positions = np.ascontiguousarray(starts.T)
    first_quaternions = np.ascontiguousarray(first.T)
    axes, rates = rotations_between(first_quaternions, np.ascontiguousarray(last.T), durations_s)
    rotations = matrices_by_component(first_quaternions)
    return Segments(
        starts=first_positions,
        velocities=(stops.T - first_positions) / durations_s,
        rotation_terms=rotation_terms(rotations, axes),
        rates=rates,
        spins=matmul_of_components(rotations, (axes * rates)[:, None])[:, 0],
    )


@dataclass(frozen=True, eq=False)
class TrackBatch:
    """Linear tracks of several bodies with common times. Their segments are computed together.

    Attributes
    ----------
    times_s
        Times of the poses in seconds. All tracks start at time 0. Shape (s,).
    positions
        Positions in meters. Shape (k, s, 3).
    quaternions
        Quaternions (x, y, z, w). Shape (k, s, 4).
    beyond
        As in `Track`.
    segments
        Coefficients of the k * (s - 1) segments, in the order of the tracks.
    """

    times_s: Floats
    positions: Floats
    quaternions: Floats
    beyond: Beyond
    segments: Segments

    @classmethod
    def from_matrices(cls, times_s: Floats, matrices: Floats, beyond: Beyond) -> TrackBatch:
        """Create tracks from rigid transforms at the given times.

        The transforms have shape (k, s, 4, 4), and the times have shape (s,).
        """
        count, samples = matrices.shape[:2]
        quaternions = quaternions_of(matrices[..., :3, :3].reshape(-1, 3, 3))
        rows = quaternions.reshape(count, samples, 4)
        positions = np.ascontiguousarray(matrices[..., :3, 3])
        segments = _segments(
            np.tile(np.diff(times_s), count),
            positions[:, :-1].reshape(-1, 3),
            positions[:, 1:].reshape(-1, 3),
            rows[:, :-1].reshape(-1, 4),
            rows[:, 1:].reshape(-1, 4),
        )
        for array in (positions, rows):
            array.flags.writeable = False
        return cls(times_s, positions, rows, beyond, segments)

    def select_segments(self, numbers: ArrayLike) -> Segments:
        """Return the segments of the tracks with the given indices, in that order."""
        steps = len(self.times_s) - 1
        columns = (np.asarray(numbers)[:, None] * steps + np.arange(steps)).reshape(-1)
        return Segments(*(np.ascontiguousarray(part[..., columns]) for part in self.segments))


class _BatchTrack(Track):
    """A track in a batch, which extracts its segments from the batch on demand.

    The actor on such a track is always in the scene.
    """

    batch: TrackBatch
    number: int  # index of the track in the batch

    @classmethod
    def from_batch(cls, batch: TrackBatch, number: int) -> _BatchTrack:
        """Create a track without the validation that `Track` performs."""
        track = object.__new__(cls)
        vars(track).update(
            times_s=batch.times_s,
            positions=batch.positions[number],
            quaternions=batch.quaternions[number],
            smooth=False,
            start_s=0.0,
            duration_s=float(batch.times_s[-1]),
            beyond=batch.beyond,
            batch=batch,
            number=number,
        )
        return track

    @cached_property
    def segments(self) -> Segments:
        """Coefficients of the linear segments between the poses."""
        return self.batch.select_segments([self.number])


def find_batch(trajectory: Trajectory) -> TrackBatch | None:
    """Return the batch that contains a track, or None for other trajectories.

    An actor on a track in a batch is always in the scene.
    """
    return trajectory.batch if isinstance(trajectory, _BatchTrack) else None


class _SegmentTimes(NamedTuple):
    """Times on a track, relative to the segments in which they lie."""

    segment: Indices  # (k,), indices of the segments
    since: Floats  # (k,), seconds since the start of each segment
    within: Bools  # (k,), whether the time is within the track, so that the platform moves


def _level_rotations(heading: Heading) -> Floats:
    rotations = np.zeros((3, 3, len(heading.cosines)))
    rotations[0, 0] = rotations[1, 1] = heading.cosines
    rotations[1, 0] = heading.sines
    rotations[0, 1] = -heading.sines
    rotations[2, 2] = 1.0
    return rotations.transpose(2, 0, 1)


def _check_times(times_s: Floats) -> None:
    """Raise LidarError unless all times are finite and in ascending order."""
    _check_poses(~np.isfinite(times_s), "The time of pose {} is not finite")
    _check_poses(
        np.append(False, np.diff(times_s) <= 0),
        "Times must increase, but the time of pose {} is not after the previous one",
    )


def _check_poses(bad: Bools, words: str) -> None:
    """Raise LidarError if any pose is bad.

    The message is `words`, formatted with the index of the first bad pose.
    """
    if bad.any():
        raise LidarError(f"{words.format(int(bad.argmax()))} (poses are counted from 0).")

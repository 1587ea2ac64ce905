"""Define robots by links and joints, and compute the poses of links over time."""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from lidarsim.errors import LidarError, message_of
from lidarsim.io.tables import METERS, RADIANS, Quantity, read_table
from lidarsim.io.textfile import read_text
from lidarsim.io.time_units import TimeUnit
from lidarsim.motion.pose_columns import TIME
from lidarsim.motion.trajectory import (
    Pose,
    Stations,
    Trajectory,
    full_poses,
    presence_ns,
    velocities,
)
from lidarsim.numerics.arrays import Floats
from lidarsim.numerics.elementary import interp, sin_cos
from lidarsim.numerics.vectors import matmul, matvec
from lidarsim.scene.actors import AT_ZERO, Actor, join_meshes
from lidarsim.scene.scene_mesh import SceneMesh
from lidarsim.scene.transform import rotation_about
from lidarsim.schema.checks import as_array, check_fits, check_list
from lidarsim.words import name_hint, plural

_LATE_S = 1e-3  # some beams of the last firing are fired slightly after the end of the survey
MOVING = ("revolute", "continuous", "prismatic")
HELD = ("fixed", "floating", "planar")

Joints = str | Path | Mapping[str, ArrayLike]

_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Joint:
    """The connection between a link and its parent link.

    Attributes
    ----------
    name
        Name of the joint.
    kind
        "revolute", "continuous", or "prismatic" if the joint moves, otherwise "fixed", "floating",
        or "planar".
    parent
        Name of the parent link.
    origin
        float64 (4, 4) matrix from the joint's frame to the frame of the parent link. At a joint
        value of zero, the joint's frame is the frame of the link.
    axis
        float64 (3,) unit vector of the rotation or translation, in the joint's frame.
    limits
        Minimum and maximum value in radians or meters, or None.
    mimic
        Name of another joint, with the factor and the offset to apply to its value, or None.
    """

    name: str
    kind: str
    parent: str
    origin: Floats
    axis: Floats
    limits: tuple[float, float] | None = None
    mimic: tuple[str, float, float] | None = None

    @property
    def is_movable(self) -> bool:
        """Whether the joint can move and therefore has a value."""
        return self.kind in MOVING


@dataclass(frozen=True, eq=False)
class Robot:
    """Robot that consists of links and joints, as read by `load_robot`.

    Joint values are angles in radians or displacements in meters. The methods accept `joints` as a
    table file with a header, or as a mapping of joint names to values. To describe a motion, add
    the key `time_s` with times in seconds, according to the clock of the trajectory, and pass one
    value per time for each joint. Values are interpolated linearly in time. A joint without values
    follows the joint that it mimics. Otherwise, it is at zero, or at the limit that is closest to
    zero.

    Attributes
    ----------
    name
        Name of the robot.
    links
        Names of the links. The root comes first, and each link comes after its parent.
    joints
        {link: joint that connects the link to its parent}, for all links except the root.
    meshes
        {link: mesh in the frame of the link}, for all links with a visual mesh.
    """

    name: str
    links: tuple[str, ...]
    joints: Mapping[str, Joint]
    meshes: Mapping[str, SceneMesh]

    def __repr__(self) -> str:
        return f"<Robot {self.name}: {self.summary}>"

    @property
    def summary(self) -> str:
        """Text that states the numbers of links and triangles, and lists the movable joints."""
        triangles = sum(len(mesh.faces) for mesh in self.meshes.values())
        moving = ", ".join(self.moving[:6]) + ", …" * (len(self.moving) > 6)
        return f"{plural(len(self.links), 'link')}, {plural(triangles, 'triangle')}; " + (
            f"{plural(len(self.moving), 'movable joint')}: {moving}"
            if moving
            else "no movable joints"
        )

    @cached_property
    def _body_meshes(self) -> dict[frozenset[str], dict[str, SceneMesh]]:
        """Cached results of `_bodies`, keyed by the omitted links."""
        return {}

    @cached_property
    def moving(self) -> tuple[str, ...]:
        """Names of the movable joints."""
        return tuple(joint.name for joint in self.joints.values() if joint.is_movable)

    def path(
        self,
        link: str,
        trajectory: Trajectory = AT_ZERO,
        joints: Joints | None = None,
        *,
        ignore: Sequence[str] = (),
        time_unit: TimeUnit | None = None,
    ) -> Trajectory:
        """Return the trajectory of a link, given that of the root link.

        `joints`, `ignore` and `time_unit` are the same as in `actors`.

        Raises
        ------
        LidarError
            If the robot has no such link, or if the joint values cannot be used.
        """
        if link not in self.joints and link != self.links[0]:
            raise LidarError(f"{self.name} has no link {link!r}.{name_hint(link, self.links)}")
        return self._path(link, trajectory, *self._values(joints, ignore, time_unit))

    def actors(
        self,
        trajectory: Trajectory = AT_ZERO,
        joints: Joints | None = None,
        *,
        name: str | None = None,
        without: Collection[str] = (),
        ignore: Sequence[str] = (),
        time_unit: TimeUnit | None = None,
        report: Callable[[str], None] = _log.warning,
    ) -> tuple[Actor, ...]:
        """Return an actor for each rigid body. The links of a body are fixed to each other.

        Parameters
        ----------
        trajectory
            Trajectory of the root link.
        joints
            Joint values, as a table file or a mapping. See `Robot`.
        name
            Name of the robot. By default, it is the name in the robot's file. Each actor is named
            NAME/LINK, where LINK is the first link of the body with triangles.
        without
            Names of links to omit.
        ignore
            Names of columns to ignore in a table file, with the wildcards * and ?.
        time_unit
            Unit of the times in a table file ("s", "ms", "us" or "ns"), if it differs from the unit
            that the header states. Without `time_unit`, times of 1e11 s or more, and times that
            span more than a year, are rejected.
        report
            Function that is called with a warning for each joint whose values exceed its limits.

        Raises
        ------
        LidarError
            If the joint values cannot be used.
        """
        check_list("without", without)
        times_s, values = self._values(joints, ignore, time_unit, report)
        robot_name = self.name if name is None else name
        return tuple(
            Actor(
                replace(mesh, name=f"{robot_name}/{mesh.name}"),
                self._path(body, trajectory, times_s, values),
                spray=False,
            )
            for body, mesh in self._bodies(frozenset(without)).items()
        )

    def _bodies(self, without: frozenset[str]) -> dict[str, SceneMesh]:
        """Return a mesh for each moving link, which includes the links that are fixed to it.

        A body is named after its first link with triangles. Meshes are joined only once, because
        actors that share arrays also share an acceleration structure.
        """
        if without not in self._body_meshes:
            link_meshes: dict[str, list[SceneMesh]] = {}
            names: dict[str, str] = {}
            # {link: (moving link of its body, matrix from the link's frame to the body's)}
            bodies = {self.links[0]: (self.links[0], np.eye(4))}
            for link in self.links:
                if (joint := self.joints.get(link)) is not None:
                    body, matrix = bodies[joint.parent]
                    bodies[link] = (
                        (link, np.eye(4))
                        if joint.is_movable
                        else (body, matmul(matrix, joint.origin))
                    )
                if (mesh := self.meshes.get(link)) is not None:
                    body, matrix = bodies[link]
                    names.setdefault(body, link)
                    if link not in without:
                        moved = mesh.affine_transform(link, matrix[:3, :3], matrix[:3, 3])
                        link_meshes.setdefault(body, []).append(moved)
            self._body_meshes[without] = {
                body: join_meshes(names[body], meshes) for body, meshes in link_meshes.items()
            }
        return self._body_meshes[without]

    def _path(
        self, link: str, base: Trajectory, times_s: Floats, values: Mapping[str, Floats]
    ) -> Trajectory:
        """Compute the trajectory of a link from the values of all joints.

        Joints with constant values are treated as rigid.
        """
        chain: list[Joint] = []
        while link in self.joints:
            chain.insert(0, self.joints[link])
            link = chain[0].parent
        hinges: list[Hinge] = []
        matrix = np.eye(4)
        for joint in chain:
            matrix = matmul(matrix, joint.origin)
            if joint.is_movable:
                value = values[joint.name]
                slides = joint.kind == "prismatic"
                if np.ptp(value):
                    hinges.append(Hinge(matrix, joint.axis, slides, value))
                    matrix = np.eye(4)
                elif slides:
                    matrix[:3, 3] += matvec(matrix[:3, :3], joint.axis * value[0])
                elif value[0]:
                    rotation = rotation_about(joint.axis, np.degrees(value[0]))
                    matrix[:3, :3] = matmul(matrix[:3, :3], rotation)
        if not hinges and (matrix == np.eye(4)).all():
            return base
        if not hinges and isinstance(base, Stations):
            mount = Pose.from_rotation(matrix[:3, 3], matrix[:3, :3])
            return Stations(tuple(pose.compose(mount) for pose in base.at))
        return LinkPath(base, tuple(hinges), matrix, times_s, getattr(base, "start_s", None) or 0.0)

    def _values(
        self,
        joints: Joints | None,
        ignore: Sequence[str],
        time_unit: TimeUnit | None,
        report: Callable[[str], None] = lambda line: None,
    ) -> tuple[Floats, dict[str, Floats]]:
        """Return the times in seconds, and the values of each movable joint by name."""
        check_fits("time_unit", time_unit, TimeUnit | None)
        check_list("ignore", ignore)
        table: dict[str, Any] = {}
        if isinstance(joints, (str, Path)):
            table = self._read_values(Path(joints), ignore, time_unit)
        elif time_unit is not None:
            raise LidarError("time_unit applies only to a joint file. Specify time_s in seconds.")
        elif joints is not None:
            table = {name: as_array(name, value).reshape(-1) for name, value in joints.items()}
        times = table.pop("time_s", np.zeros(1))
        self._check_table(times, table)
        self._add_missing(table, len(times))
        self._report_limits(table, report)
        return times, table

    def _check_table(self, times: Floats, table: Mapping[str, Floats]) -> None:
        """Validate the times and joint values in a table.

        Raises LidarError if they are invalid.
        """
        for name, value in table.items():
            if name not in self.moving:
                raise LidarError(
                    f"{self.name} has no movable joint {name!r}.{name_hint(name, self.moving)}"
                )
            if value.shape != times.shape or not np.isfinite(value).all():
                raise LidarError(
                    f"The values of joint {name!r} must be finite, with one value for each time_s "
                    f"({len(times)}), or a single value without time_s, but it has {value.size}."
                )
        if not (len(times) and np.isfinite(times).all() and (np.diff(times) > 0).all()):
            raise LidarError("The values of time_s must be finite and strictly increasing.")

    def _moving_joints(self) -> dict[str, Joint]:
        return {joint.name: joint for joint in self.joints.values() if joint.is_movable}

    def _add_missing(self, table: dict[str, Floats], count: int) -> None:
        """Add values to a table for missing joints, which mimic another joint or are at rest."""
        joints = self._moving_joints()
        for name in joints:
            chain = [joints[name]]
            while chain[-1].name not in table and (mimic := chain[-1].mimic) is not None:
                chain.append(joints[mimic[0]])
            if chain[-1].name not in table:
                lower, upper = chain[-1].limits or (0.0, 0.0)
                nearest_zero = min(max(0.0, lower), max(upper, lower))
                table[chain[-1].name] = np.full(count, nearest_zero)
            for joint in chain[-2::-1]:
                assert joint.mimic is not None
                mimicked, factor, offset = joint.mimic
                table[joint.name] = factor * table[mimicked] + offset

    def _report_limits(self, table: Mapping[str, Floats], report: Callable[[str], None]) -> None:
        """Report joints whose values exceed their limits."""
        for name, joint in self._moving_joints().items():
            lower, upper = joint.limits or (-np.inf, np.inf)
            min_value = table[name].min()
            max_value = table[name].max()
            if min_value < lower - 1e-6 or max_value > upper + 1e-6:
                report(
                    f"{self.name}: joint {name} has values from {min_value:.4g} to "
                    f"{max_value:.4g}, which exceed its limits of {lower:.4g} to {upper:.4g}."
                )

    def _read_values(
        self, path: Path, ignore: Sequence[str], time_unit: TimeUnit | None
    ) -> dict[str, Floats]:
        """Read joint values from a table file.

        Raises LidarError if the file is unusable.
        """
        quantities = [
            Quantity(
                joint.name,
                (),
                METERS if joint.kind == "prismatic" else RADIANS,
                "m" if joint.kind == "prismatic" else "rad",
                exact=True,
            )
            for joint in self.joints.values()
            if joint.is_movable
        ]
        try:
            table = read_table(
                read_text(path),
                [TIME, *quantities],
                required=lambda columns: ("time_s",),
                ignore=ignore,
                unused=[joint.name for joint in self.joints.values() if not joint.is_movable],
                time_unit=time_unit,
            )
        except (OSError, ValueError, LidarError) as error:
            raise LidarError(
                f"{path} cannot be used as a joint table: {message_of(error)}"
            ) from error
        if len(table) < 2:
            raise LidarError(
                f"{path} has no column for a movable joint. Name its columns after the joints of "
                f"{self.name}, for example {', '.join(self.moving[:3])}."
            )
        return table


@dataclass(frozen=True, eq=False)
class Hinge:
    """A joint in a kinematic chain whose value changes over time."""

    before: Floats  # (4, 4) from the joint's frame to the frame beyond the previous hinge
    axis: Floats  # (3,) unit vector in the joint's frame
    slides: bool  # whether it translates along its axis instead of rotating
    values: Floats  # (k,) in radians or meters


@dataclass(frozen=True, eq=False)
class LinkPath:
    """The trajectory of a link, computed from the root's trajectory and the joints in between.

    Joint values are interpolated linearly in time. Poses are then computed from these values, so
    they are exact at any time.
    """

    base: Trajectory
    hinges: tuple[Hinge, ...]
    last: Floats  # (4, 4) from the link's frame to the frame beyond the last hinge
    times_s: Floats  # (k,) times of the joint values
    start_s: float  # start of the trajectory in the clock of `times_s`

    @property
    def stations(self) -> int:
        """Number of stations in the root's trajectory."""
        return self.base.stations

    @property
    def moves(self) -> bool:
        """Whether the link moves within a station."""
        return bool(self.hinges) or self.base.moves

    @property
    def duration_ns(self) -> float:
        """Duration in nanoseconds for which there are root poses and joint values."""
        if not self.hinges:
            return self.base.duration_ns
        return min(self.base.duration_ns, (float(self.times_s[-1]) - self.start_s) * 1e9)

    @property
    def presence_ns(self) -> tuple[float, float]:
        """First and last nanosecond for which the robot is in the scene."""
        return presence_ns(self.base)

    def pose(self, station: int, time_ns: float = 0.0) -> Pose:
        """Return the pose at a given time after the start of a station, in nanoseconds."""
        positions, rotations = self.poses(station, np.array([time_ns], np.float64))
        return Pose.from_rotation(positions[0], rotations[0])

    def poses(self, station: int, times_ns: Floats) -> tuple[Floats, Floats]:
        """Return the positions and rotations at the given times of a station.

        Times are in nanoseconds. Sums are evaluated in a fixed order, so the results do not depend
        on the number of times.

        Raises
        ------
        LidarError
            If the trajectory or the joints have no values for a time.
        """
        times_ns = np.clip(times_ns, *self.presence_ns)  # poses are irrelevant while absent
        motion = self._root_motion(station, times_ns, moving=False)
        moments_s = self._moments_s(times_ns)
        for hinge in self.hinges:
            value = interp(moments_s, self.times_s, hinge.values)
            motion = motion.transform(hinge.before).after_hinge(hinge, value)
        motion = motion.transform(self.last)
        return motion.positions.T, motion.rotations.transpose(2, 0, 1)

    def velocities(self, station: int, times_ns: Floats) -> tuple[Floats, Floats]:
        """Return the linear and angular velocities at the given times of a station.

        Times are in nanoseconds. The velocities are in the scene frame, in m/s and rad/s, and
        include the motion of all joints exactly. At the times of the joint values, where velocities
        change, those of the following interval are returned.

        Raises
        ------
        LidarError
            If the trajectory or the joints have no values for a time.
        """
        appears_ns, leaves_ns = self.presence_ns
        within = (appears_ns <= times_ns) & (times_ns <= leaves_ns)
        times_ns = np.clip(times_ns, appears_ns, leaves_ns)
        motion = self._root_motion(station, times_ns, moving=True)
        moments_s = self._moments_s(times_ns)
        for hinge in self.hinges:
            value = interp(moments_s, self.times_s, hinge.values)
            at_hinge = motion.transform(hinge.before).at_origin()
            driven = at_hinge.with_hinge_velocity(hinge, self._slopes(hinge, moments_s))
            motion = driven.after_hinge(hinge, value)
        motion = motion.transform(self.last).at_origin()
        return (motion.velocities * within).T, (motion.rates * within).T

    def _root_motion(self, station: int, times_ns: Floats, moving: bool) -> _LinkMotion:
        """Return the motion of the root link at the given times.

        Velocities are zero unless `moving` is set.
        """
        positions, rotations = full_poses(self.base, station, times_ns)
        linear = angular = np.zeros((len(times_ns), 3))
        if moving:
            linear, angular = velocities(self.base, station, times_ns)
        return _LinkMotion(
            positions=positions.T,
            rotations=rotations.transpose(1, 2, 0),
            anchors=positions.T,
            velocities=linear.T,
            rates=angular.T,
        )

    def _moments_s(self, times_ns: Floats) -> Floats:
        """Convert times to the clock of the joint values, in seconds.

        Raises LidarError if a time is outside the joint values.
        """
        moments_s = times_ns / 1e9 + self.start_s
        first_s = moments_s.min(initial=np.inf)
        last_s = moments_s.max(initial=-np.inf)
        start_s, stop_s = self.times_s[[0, -1]]
        if self.hinges and max(start_s - first_s, last_s - stop_s) > _LATE_S:
            raise LidarError(
                f"The joints have values from {start_s:.9g} to {stop_s:.9g} s, but poses from "
                f"{first_s:.9g} to {last_s:.9g} s were requested."
            )
        return moments_s

    def _slopes(self, hinge: Hinge, moments_s: Floats) -> Floats:
        """Return how fast a joint value changes at the given times, per second."""
        if len(self.times_s) < 2:
            return np.zeros(len(moments_s))
        slopes = np.diff(hinge.values) / np.diff(self.times_s)
        segment = np.searchsorted(self.times_s, moments_s, "right") - 1
        inside = (self.times_s[0] <= moments_s) & (moments_s <= self.times_s[-1])
        return np.asarray(slopes[np.clip(segment, 0, len(slopes) - 1)] * inside)


class _LinkMotion(NamedTuple):
    """Poses and velocities of a robot's frame at k times, in the scene frame."""

    positions: Floats  # (3, k) meters
    rotations: Floats  # (3, 3, k)
    anchors: Floats  # (3, k) points to which the velocities refer
    velocities: Floats  # (3, k) m/s
    rates: Floats  # (3, k) angular velocities, rad/s

    def transform(self, matrix: Floats) -> _LinkMotion:
        """Return the motion of another frame, which has a constant pose in this frame."""
        moved = _product(self.rotations, matrix[:3, :, None])
        return self._replace(positions=self.positions + moved[:, 3], rotations=moved[:, :3])

    def at_origin(self) -> _LinkMotion:
        """Return the same motion, with the velocities of the frame's origin."""
        levers = self.positions - self.anchors
        moved = self.velocities + np.cross(self.rates, levers, axis=0)
        return self._replace(anchors=self.positions, velocities=moved)

    def with_hinge_velocity(self, hinge: Hinge, slopes: Floats) -> _LinkMotion:
        """Add the velocity of a hinge, given how fast its value changes."""
        added = _product(self.rotations, hinge.axis[:, None, None] * slopes)[:, 0]
        if hinge.slides:
            return self._replace(velocities=self.velocities + added)
        return self._replace(rates=self.rates + added)

    def after_hinge(self, hinge: Hinge, value: Floats) -> _LinkMotion:
        """Return the motion with poses moved by a hinge's values. Velocities do not change."""
        if hinge.slides:
            slide = _product(self.rotations, hinge.axis[:, None, None] * value)[:, 0]
            return self._replace(positions=self.positions + slide)
        cross = np.cross(np.eye(3), hinge.axis)  # Rodrigues, 1840
        square = matmul(cross, cross)
        sine, cosine = sin_cos(value)
        spin = sine * cross[..., None] + (1 - cosine) * square[..., None]
        return self._replace(rotations=_product(self.rotations, spin + np.eye(3)[..., None]))


def _product(left_matrices: Floats, right_matrices: Floats) -> Floats:
    """Multiply 3 x 3 matrices by 3 x m matrices.

    The shapes are (3, 3, k) and (3, m, k), where k may be 1.
    """
    return np.asarray(
        (
            left_matrices[:, 0, None] * right_matrices[0]
            + left_matrices[:, 1, None] * right_matrices[1]
        )
        + left_matrices[:, 2, None] * right_matrices[2]
    )

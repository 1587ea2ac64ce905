"""Robots: links, the joints that hold them, and where each link is at a time."""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from lidarsim.base.arrays import Floats
from lidarsim.base.elementary import interp, sin_cos
from lidarsim.base.errors import LidarError, message_of
from lidarsim.base.tables import METRES, RADIANS, Quantity, read_table
from lidarsim.base.textfile import read_text
from lidarsim.base.validation import as_array, checked
from lidarsim.base.vectors import applied, matmul
from lidarsim.base.words import did_you_mean, plural
from lidarsim.scene.actors import AT_ZERO, Actor, join_meshes
from lidarsim.scene.scene_mesh import SceneMesh
from lidarsim.scene.transform import rotation_about
from lidarsim.sensor import Pose, Stations, Trajectory
from lidarsim.sensor.pose_columns import TIME
from lidarsim.sensor.trajectory import full_poses, presence_ns, velocities

_LATE_S = 1e-3  # the beams of the last firing are fired a little after the survey's end
MOVING = ("revolute", "continuous", "prismatic")
HELD = ("fixed", "floating", "planar")

Joints = str | Path | Mapping[str, ArrayLike]

_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Joint:
    """What holds a link.

    Attributes
    ----------
    name
        Its name.
    kind
        revolute, continuous or prismatic, if it moves; else fixed, floating or planar.
    parent
        Link that it is on.
    origin
        float64 (4, 4): from its own axes, in which the held link is at zero, to the parent's.
    axis
        float64 (3,): unit vector about or along which it moves, in its own axes.
    limits
        Least and largest value, radians or metres; None if there are none.
    mimic
        Another joint, and factor and offset of its value; None if it has a value of its own.
    """

    name: str
    kind: str
    parent: str
    origin: Floats
    axis: Floats
    limits: tuple[float, float] | None = None
    mimic: tuple[str, float, float] | None = None

    @property
    def moves(self) -> bool:
        """Whether it has a value."""
        return self.kind in MOVING


@dataclass(frozen=True, eq=False)
class Robot:
    """Links, and the joints that hold them; read by `load_robot`.

    Values of joints are radians or metres. `joints` of the methods are a table (a file with a
    header), or a mapping: of a joint's name to its value, or, with time_s, to its values at these
    seconds by the trajectory's clock. Values between are linear in time. A joint without values
    follows the one that it mimics, else it is at zero, or at its limit nearest to zero.

    Attributes
    ----------
    name
        Its name.
    links
        Names of the links: the root first, each after its parent.
    joints
        {link: what holds it}, of all but the root.
    meshes
        {link: what is seen of it, in its axes}, of the links that have something.
    """

    name: str
    links: tuple[str, ...]
    joints: Mapping[str, Joint]
    meshes: Mapping[str, SceneMesh]

    def __repr__(self) -> str:
        return f"<Robot {self.name}: {self.summary}>"

    @property
    def summary(self) -> str:
        """Links, joints that move, and triangles, in words."""
        triangles = sum(len(mesh.faces) for mesh in self.meshes.values())
        verb = "moves" if len(self.moving) == 1 else "move"
        moving = ", ".join(self.moving[:6]) + ", …" * (len(self.moving) > 6)
        return f"{plural(len(self.links), 'link')}, {plural(triangles, 'triangle')}; " + (
            f"{len(self.moving):,} of its joints {verb}: {moving}" if moving else "no joint moves"
        )

    @cached_property
    def _made(self) -> dict[frozenset[str], dict[str, SceneMesh]]:
        return {}  # see `_bodies`

    @cached_property
    def moving(self) -> tuple[str, ...]:
        """Names of the joints that move."""
        return tuple(joint.name for joint in self.joints.values() if joint.moves)

    def path(
        self,
        link: str,
        trajectory: Trajectory = AT_ZERO,
        joints: Joints | None = None,
        *,
        ignore: Sequence[str] = (),
    ) -> Trajectory:
        """Trajectory of a link, whose root has a trajectory. It stands if nothing moves it.

        `ignore` are names of columns of a table of joints to leave out, with * and ?.

        Raises
        ------
        LidarError
            If there is no such link, or the joints cannot be used.
        """
        if link not in self.joints and link != self.links[0]:
            raise LidarError(f"{self.name} has no link {link!r}.{did_you_mean(link, self.links)}")
        return self._path(link, trajectory, *self._values(joints, ignore))

    @checked
    def actors(
        self,
        trajectory: Trajectory = AT_ZERO,
        joints: Joints | None = None,
        *,
        name: str | None = None,
        without: Collection[str] = (),
        ignore: Sequence[str] = (),
        tell: Callable[[str], None] = _log.warning,
    ) -> tuple[Actor, ...]:
        """Make an actor of each link that a joint moves, with the links that are fixed to it.

        Parameters
        ----------
        trajectory
            Of the root link.
        joints
            Values of joints, see `Robot`.
        name
            Of the robot. Actors are called NAME/LINK, by the first link that has triangles.
        without
            Links to leave out.
        ignore
            Names of columns of a table of joints to leave out, with * and ?.
        tell
            Called with a line on values beyond limits.

        Raises
        ------
        LidarError
            If the joints cannot be used.
        """
        times_s, values = self._values(joints, ignore, tell)
        called = self.name if name is None else name
        return tuple(
            Actor(
                replace(mesh, name=f"{called}/{mesh.name}"),
                self._path(body, trajectory, times_s, values),
                spray=False,
            )
            for body, mesh in self._bodies(frozenset(without)).items()
        )

    def _bodies(self, without: frozenset[str]) -> dict[str, SceneMesh]:
        """Return {link that moves by itself: all that is fixed to it}, made once.

        Actors that share arrays share a tree. Each is named by its first link with triangles.
        """
        if without not in self._made:
            parts: dict[str, list[SceneMesh]] = {}
            names: dict[str, str] = {}
            owner = {self.links[0]: (self.links[0], np.eye(4))}  # {link: its body, its place}
            for link in self.links:
                if (joint := self.joints.get(link)) is not None:
                    body, place = owner[joint.parent]
                    owner[link] = (
                        (link, np.eye(4)) if joint.moves else (body, matmul(place, joint.origin))
                    )
                if (mesh := self.meshes.get(link)) is not None:
                    body, place = owner[link]
                    names.setdefault(body, link)
                    if link not in without:
                        moved = mesh.moved(link, place[:3, :3], place[:3, 3])
                        parts.setdefault(body, []).append(moved)
            self._made[without] = {
                body: join_meshes(names[body], own) for body, own in parts.items()
            }
        return self._made[without]

    def _path(
        self, link: str, base: Trajectory, times_s: Floats, values: Mapping[str, Floats]
    ) -> Trajectory:
        """Trajectory of a link; joints whose values do not change are taken as rigid."""
        chain: list[Joint] = []
        while link in self.joints:
            chain.insert(0, self.joints[link])
            link = chain[0].parent
        hinges: list[Hinge] = []
        place = np.eye(4)
        for joint in chain:
            place = matmul(place, joint.origin)
            if joint.moves:
                value = values[joint.name]
                slides = joint.kind == "prismatic"
                if np.ptp(value):
                    hinges.append(Hinge(place, joint.axis, slides, value))
                    place = np.eye(4)
                elif slides:
                    place[:3, 3] += applied(place[:3, :3], joint.axis * value[0])
                elif value[0]:
                    turn = rotation_about(joint.axis, np.degrees(value[0]))
                    place[:3, :3] = matmul(place[:3, :3], turn)
        if not hinges and (place == np.eye(4)).all():
            return base
        if not hinges and isinstance(base, Stations):
            own = Pose.of(place[:3, 3], place[:3, :3])
            return Stations(tuple(pose.then(own) for pose in base.at))
        return LinkPath(base, tuple(hinges), place, times_s, getattr(base, "start_s", None) or 0.0)

    def _values(
        self,
        given: Joints | None,
        ignore: Sequence[str],
        tell: Callable[[str], None] = lambda line: None,
    ) -> tuple[Floats, dict[str, Floats]]:
        """Return times (k,), and values (k,) of all joints that move."""
        table: dict[str, Any] = {}
        if isinstance(given, (str, Path)):
            table = self._read_values(Path(given), ignore)
        elif given is not None:
            table = {name: as_array(name, value).reshape(-1) for name, value in given.items()}
        times = table.pop("time_s", np.zeros(1))
        for name, value in table.items():
            if name not in self.moving:
                raise LidarError(
                    f"{self.name} has no joint {name!r} that moves."
                    f"{did_you_mean(name, self.moving)}"
                )
            if value.shape != times.shape or not np.isfinite(value).all():
                raise LidarError(
                    f"The values of joint {name!r} must be finite, one for each time_s "
                    f"({len(times)}), or one without time_s; there are {value.size}."
                )
        if not (len(times) and np.isfinite(times).all() and (np.diff(times) > 0).all()):
            raise LidarError("time_s of joints must be finite, and ascend.")
        joints = {joint.name: joint for joint in self.joints.values() if joint.moves}
        for name in joints:
            chain = [joints[name]]
            while chain[-1].name not in table and (mimic := chain[-1].mimic) is not None:
                chain.append(joints[mimic[0]])
            if chain[-1].name not in table:
                low, high = chain[-1].limits or (0.0, 0.0)
                table[chain[-1].name] = np.full(len(times), min(max(0.0, low), max(high, low)))
            for one in chain[-2::-1]:
                assert one.mimic is not None
                other, factor, offset = one.mimic
                table[one.name] = factor * table[other] + offset
        for name, joint in joints.items():
            low, high = joint.limits or (-np.inf, np.inf)
            least = table[name].min()
            most = table[name].max()
            if least < low - 1e-6 or most > high + 1e-6:
                tell(
                    f"{self.name}: joint {name} goes from {least:.4g} to {most:.4g}, beyond its "
                    f"limits of {low:.4g} to {high:.4g}"
                )
        return times, table

    def _read_values(self, path: Path, ignore: Sequence[str]) -> dict[str, Floats]:
        """Read a table of values; LidarError if it cannot be used."""
        quantities = [
            Quantity(
                joint.name,
                (),
                METRES if joint.kind == "prismatic" else RADIANS,
                "m" if joint.kind == "prismatic" else "rad",
                exact=True,
            )
            for joint in self.joints.values()
            if joint.moves
        ]
        try:
            table = read_table(
                read_text(path),
                [TIME, *quantities],
                required=lambda columns: ("time_s",),
                ignore=ignore,
                unused=[joint.name for joint in self.joints.values() if not joint.moves],
            )
        except (OSError, ValueError, LidarError) as error:
            raise LidarError(
                f"{path} is not a usable table of joints: {message_of(error)}"
            ) from error
        if len(table) < 2:
            raise LidarError(
                f"{path} has values of no joint that moves: name its columns as the joints of "
                f"{self.name} are, such as {', '.join(self.moving[:3])}."
            )
        return table


@dataclass(frozen=True, eq=False)
class Hinge:
    """A joint whose value changes, in a chain of them."""

    before: Floats  # (4, 4): from its axes to those of the link that the one before moves
    axis: Floats  # (3,)
    slides: bool
    values: Floats  # (k,)


@dataclass(frozen=True, eq=False)
class LinkPath:
    """Trajectory of a link: that of the robot's root, and of each joint in between.

    Poses are exact at any time: values of joints are linear between those given, and positions are
    computed from them, not interpolated.
    """

    base: Trajectory
    hinges: tuple[Hinge, ...]
    last: Floats  # (4, 4): from the link's axes to those of the link that the last joint moves
    times_s: Floats  # (k,): of the joints' values
    start_s: float  # of the trajectory, by the same clock

    @property
    def stations(self) -> int:
        """See `Trajectory.stations`."""
        return self.base.stations

    @property
    def moves(self) -> bool:
        """See `Trajectory.moves`."""
        return bool(self.hinges) or self.base.moves

    @property
    def duration_ns(self) -> float:
        """See `Trajectory.duration_ns`."""
        ends = (float(self.times_s[-1]) - self.start_s) * 1e9 if self.hinges else np.inf
        return min(self.base.duration_ns, ends)

    @property
    def presence_ns(self) -> tuple[float, float]:
        """See `lidarsim.sensor.trajectory.presence_ns`."""
        return presence_ns(self.base)

    def pose(self, station: int, time_ns: float = 0.0) -> Pose:
        """See `Trajectory.pose`."""
        positions, rotations = self.poses(station, np.array([time_ns], np.float64))
        return Pose.of(positions[0], rotations[0])

    def poses(self, station: int, times_ns: Floats) -> tuple[Floats, Floats]:
        """See `Trajectory.poses`.

        All sums are in one order of rounding, however many times there are.

        Raises
        ------
        LidarError
            If the trajectory or the joints have no values for a time.
        """
        place, turn, *_ = self._along(station, times_ns, moving=False)
        return place.T, turn.transpose(2, 0, 1)

    def velocities(self, station: int, times_ns: Floats) -> tuple[Floats, Floats]:
        """See `lidarsim.sensor.trajectory.velocities`: exact, through all joints.

        At a given value of a joint they are those behind it.

        Raises
        ------
        LidarError
            If the trajectory or the joints have no values for a time.
        """
        _, _, velocity, rate = self._along(station, times_ns, moving=True)
        return velocity.T, rate.T

    def _along(
        self, station: int, times_ns: Floats, moving: bool
    ) -> tuple[Floats, Floats, Floats, Floats]:
        """Return positions (3, k), rotations (3, 3, k), velocities and rates (3, k).

        The last two are zero unless they are asked for.
        """
        appears, leaves = self.presence_ns
        within = (appears <= times_ns) & (times_ns <= leaves)
        times_ns = np.clip(times_ns, *self.presence_ns)  # elsewhere poses do not count
        positions, rotations = full_poses(self.base, station, times_ns)
        place = positions.T
        turn = rotations.transpose(1, 2, 0)
        velocity = rate = np.zeros((3, len(times_ns)))
        if moving:
            velocity, rate = (part.T for part in velocities(self.base, station, times_ns))
        at = times_ns / 1e9 + self.start_s
        low = at.min(initial=np.inf)
        high = at.max(initial=-np.inf)
        first, last = self.times_s[[0, -1]]
        if self.hinges and max(first - low, high - last) > _LATE_S:
            raise LidarError(
                f"The joints have values from {first:.9g} to {last:.9g} s; poses are asked for "
                f"from {low:.9g} to {high:.9g} s."
            )
        start = place
        for hinge in self.hinges:
            place, turn = _then(place, turn, hinge.before)
            value = interp(at, self.times_s, hinge.values)
            if moving:
                velocity = velocity + np.cross(rate, place - start, axis=0)
                start = place
                along = _times(turn, hinge.axis[:, None, None] * self._slopes(hinge, at))[:, 0]
            if hinge.slides:
                place = place + _times(turn, hinge.axis[:, None, None] * value)[:, 0]
                if moving:
                    velocity = velocity + along
            else:  # Rodrigues, 1840
                cross = np.cross(np.eye(3), hinge.axis)
                square = matmul(cross, cross)
                sine, cosine = sin_cos(value)
                spin = sine * cross[..., None] + (1 - cosine) * square[..., None]
                turn = _times(turn, spin + np.eye(3)[..., None])
                if moving:
                    rate = rate + along
        place, turn = _then(place, turn, self.last)
        if moving:
            velocity = (velocity + np.cross(rate, place - start, axis=0)) * within
        return place, turn, velocity, rate * within

    def _slopes(self, hinge: Hinge, at: Floats) -> Floats:
        """Rates of a joint's value at times (k,), a second."""
        if len(self.times_s) < 2:
            return np.zeros(len(at))
        slopes = np.diff(hinge.values) / np.diff(self.times_s)
        segment = np.searchsorted(self.times_s, at, "right") - 1
        inside = (self.times_s[0] <= at) & (at <= self.times_s[-1])
        return np.asarray(slopes[np.clip(segment, 0, len(slopes) - 1)] * inside)


def _times(one: Floats, other: Floats) -> Floats:
    """Product of matrices (3, 3, k) and (3, m, k); k may be 1."""
    return np.asarray(
        (one[:, 0, None] * other[0] + one[:, 1, None] * other[1]) + one[:, 2, None] * other[2]
    )


def _then(place: Floats, turn: Floats, matrix: Floats) -> tuple[Floats, Floats]:
    """Positions (3, k) and rotations (3, 3, k), followed by the same step (4, 4)."""
    moved = _times(turn, matrix[:3, :, None])
    return place + moved[:, 3], moved[:, :3]

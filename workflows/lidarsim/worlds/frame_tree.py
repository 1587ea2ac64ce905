"""Poses of named frames over time, as a program publishes them."""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from ..motion.rotations import matrices as rotations_of_quaternions
from ..motion.rotations import quaternions_of
from ..numerics.arrays import Floats, Ints
from ..numerics.elementary import arctan2, sin_cos
from ..numerics.vectors import matmul, norm
from ..scene.transform import affine
from .world import WORLD, WorldFrame

MIN_STEP_NS = 500_000  # samples that follow faster are dropped, which bounds memory and time
_BEFORE_JUMP_NS = 1_000  # how long before a jump a frame is held at its earlier pose
_MAX_DISORDER_NS = 50_000_000  # older samples than the last one by more mean that time jumped
_MIN_JUMP_M = 0.2  # shorter movements are never jumps
_MIN_SINE = 1e-9  # smaller rotations are interpolated linearly
_MAX_NORM_ERROR = 1e-2  # tolerated error of the norm of a quaternion


class Jump(NamedTuple):
    """A movement that is too fast to be continuous."""

    frame: str
    distance_m: float
    duration_s: float


@dataclass(eq=False)
class _Link:
    """Pose of a frame relative to its parent, either constant or over time."""

    parent: str
    is_static: bool = False
    is_outdated: bool = False  # whether time jumped, so that the next pose replaces all others
    times_ns: list[int] = field(default_factory=list)  # ascending
    poses: list[tuple[float, ...]] = field(default_factory=list)  # x, y, z, qx, qy, qz, qw

    @property
    def moves(self) -> bool:
        """Whether the poses differ."""
        return any(pose != self.poses[0] for pose in self.poses)

    def insert(self, time_ns: int, pose: tuple[float, ...]) -> None:
        """Insert a sample, or replace the sample with the same time."""
        row = bisect_left(self.times_ns, time_ns)
        if row < len(self.times_ns) and self.times_ns[row] == time_ns:
            self.poses[row] = pose
            return
        self.times_ns.insert(row, time_ns)
        self.poses.insert(row, pose)

    def drop_after(self, time_ns: int) -> None:
        """Delete samples after `time_ns`, which a program published before time jumped back."""
        row = bisect_right(self.times_ns, time_ns)
        del self.times_ns[row:], self.poses[row:]

    def thin_out(self, time_ns: int) -> None:
        """Delete the last sample if a sample at `time_ns` makes it unnecessary."""
        if len(self.times_ns) > 1:
            before_ns, last_ns = self.times_ns[-2:]
            follows_jump = last_ns - before_ns <= _BEFORE_JUMP_NS
            if last_ns < time_ns < before_ns + MIN_STEP_NS and not follows_jump:
                del self.times_ns[-1], self.poses[-1]

    def drop_before(self, time_ns: int) -> None:
        """Delete samples that do not affect poses at `time_ns` or later."""
        row = bisect_right(self.times_ns, time_ns) - 1
        if row > 0:
            del self.times_ns[:row]
            del self.poses[:row]

    def matrices(self, times_ns: Ints) -> Floats:
        """Return the poses at the given times. The first and the last pose are held."""
        first = bisect_right(self.times_ns, int(times_ns[0])) - 1
        last = bisect_left(self.times_ns, int(times_ns[-1])) + 1
        rows = slice(max(first, 0), last)
        poses = self.poses[rows]
        if all(pose == poses[0] for pose in poses):
            return np.tile(_matrix_of(poses[0]), (len(times_ns), 1, 1))
        return _interpolate(np.array(self.times_ns[rows]), np.array(poses), times_ns)


class FrameTree:
    """Tree of named frames with poses over time.

    Frames are first at their poses in a file, and follow the poses that are added. Between two
    samples, a frame moves at constant velocity and angular velocity relative to its parent. Before
    the first and after the last sample, it is held. Samples are kept until `drop_before` is called.

    Parameters
    ----------
    frames
        Frames of the world file.
    roots
        Names of frames that coincide with the world frame.
    max_speed_m_s
        Frames that move faster between two samples are assumed to jump, so they are held until the
        second sample. If None, frames never jump.
    """

    def __init__(
        self,
        frames: Mapping[str, WorldFrame],
        roots: Collection[str] = (),
        max_speed_m_s: float | None = None,
    ) -> None:
        self._in_file = dict(frames)
        self._roots = {WORLD, *roots}
        self._max_speed_m_s = max_speed_m_s
        self._links: dict[str, _Link] = {}
        self._chains: dict[str, tuple[str, ...] | None] = {}  # cache of `chain`

    def add_frames(self, frames: Mapping[str, WorldFrame]) -> None:
        """Add frames of a file."""
        self._in_file |= frames
        self._chains.clear()

    @property
    def received(self) -> Collection[str]:
        """Names of the frames for which poses have been added."""
        return self._links.keys()

    @property
    def parents(self) -> set[str]:
        """Names of the parents of received frames, except for the world frame."""
        return {link.parent for link in self._links.values()} - self._roots

    def add(
        self,
        frame: str,
        parent: str,
        time_ns: int,
        pose: Sequence[float],
        *,
        is_static: bool = False,
    ) -> Jump | None:
        """Add a pose of a frame.

        Parameters
        ----------
        frame, parent
            Names of the frame and of its parent.
        time_ns
            Time of the pose.
        pose
            Position in meters and quaternion x, y, z, w, relative to the parent.
        is_static
            Whether the pose applies to all times and replaces all earlier poses.

        Returns
        -------
        The jump of the frame, or None if it moved continuously.

        Raises
        ------
        ValueError
            If the pose is not finite, or if the norm of the quaternion is not 1.
        """
        values = _checked_pose(pose)
        link = self._links.get(frame)
        if link is not None and link.parent != parent and self._prefers(link.parent, parent):
            return None
        if link is None or link.parent != parent or is_static or link.is_static:
            self._links[frame] = _Link(parent, is_static, False, [time_ns], [values])
            if link is None or link.parent != parent:
                self._chains.clear()
            return None
        if link.is_outdated:
            link.is_outdated = False
            link.times_ns = [time_ns]
            link.poses = [values]
            return None
        link.drop_after(time_ns + _MAX_DISORDER_NS)
        link.thin_out(time_ns)
        jump = self._jump(frame, link, time_ns, values)
        if jump is not None:
            link.insert(time_ns - _BEFORE_JUMP_NS, link.poses[-1])
        link.insert(time_ns, values)
        return jump

    def _prefers(self, parent: str, other: str) -> bool:
        """Return whether only the first of two parents is connected to the world."""
        return self._is_connected(parent) and not self._is_connected(other)

    def _jump(self, frame: str, link: _Link, time_ns: int, pose: tuple[float, ...]) -> Jump | None:
        """Return the jump between the last pose of a frame and a new one."""
        if self._max_speed_m_s is None or not link.times_ns:
            return None
        step_ns = time_ns - link.times_ns[-1]
        distance_m = float(norm(np.subtract(pose[:3], link.poses[-1][:3])))
        limit_m = max(self._max_speed_m_s * step_ns / 1e9, _MIN_JUMP_M)
        if step_ns <= _BEFORE_JUMP_NS or distance_m <= limit_m:
            return None
        return Jump(frame, distance_m, step_ns / 1e9)

    def restart(self, time_ns: int) -> None:
        """Forget all poses over time, because time has jumped to `time_ns`.

        Frames keep their last pose until a new one is added.
        """
        for link in self._links.values():
            if not link.is_static:
                link.is_outdated = True
                link.times_ns = [time_ns]
                link.poses = link.poses[-1:]

    def drop_before(self, time_ns: int) -> None:
        """Delete samples that are not required for poses at `time_ns` or later."""
        for link in self._links.values():
            link.drop_before(time_ns)

    def chain(self, frame: str) -> tuple[str, ...] | None:
        """Return the frames from a frame to the world, or None if it is not connected to the world.

        Poses that were added take precedence over those of the file. If the received frames are not
        connected to the world, the frame is at its pose in the file.
        """
        if frame not in self._chains:
            self._chains[frame] = self._find_chain(frame)
        return self._chains[frame]

    def _find_chain(self, frame: str) -> tuple[str, ...] | None:
        names: list[str] = []
        while frame not in self._roots:
            if frame in names:
                return None
            names.append(frame)
            parent = self._parent(frame)
            if parent is None:
                return None
            frame = parent
        return tuple(names)

    def _parent(self, frame: str) -> str | None:
        """Return the parent of a frame, or None if there is none."""
        if frame in self._links:
            parent = self._links[frame].parent
            if frame not in self._in_file or parent in self._roots or self._is_connected(parent):
                return parent
        return self._in_file[frame].parent if frame in self._in_file else None

    def _is_connected(self, frame: str) -> bool:
        """Return whether received frames and frames of the file connect a frame to the world."""
        seen: set[str] = set()
        while frame not in self._roots:
            if frame in seen or (frame not in self._links and frame not in self._in_file):
                return False
            seen.add(frame)
            link = self._links.get(frame)
            frame = self._in_file[frame].parent if link is None else link.parent
        return True

    def follows(self, frame: str) -> bool:
        """Return whether poses were received for a frame, or for one that carries it."""
        return any(name in self._links for name in self.chain(frame) or ())

    def _uses_received(self, frame: str) -> bool:
        """Return whether the pose of a frame relative to its parent was received."""
        return frame in self._links and self._parent(frame) == self._links[frame].parent

    def live(self, frames: Iterable[str]) -> dict[str, int]:
        """Return the time of the last sample of each frame whose poses are received over time."""
        return {
            frame: self._links[frame].times_ns[-1]
            for frame in frames
            if frame in self._links and not self._links[frame].is_static
        }

    def sample_times(self, frames: Iterable[str], start_ns: int, stop_ns: int) -> list[int]:
        """Return the times of samples within an interval for frames that move, in order."""
        times: set[int] = set()
        for frame in frames:
            link = self._links.get(frame)
            if link is not None and link.moves:
                rows = slice(
                    bisect_right(link.times_ns, start_ns), bisect_left(link.times_ns, stop_ns)
                )
                times.update(link.times_ns[rows])
        return sorted(times)

    def poses(self, frames: Iterable[str], times_ns: Ints) -> dict[str, Floats]:
        """Return the poses of frames in the world.

        Frames that are not connected to the world are omitted.

        Parameters
        ----------
        frames
            Names of frames.
        times_ns
            Times in ascending order. Shape (k,).

        Returns
        -------
        dict
            Matrices from each frame to the world. Shape (k, 4, 4).
        """
        in_world: dict[str, Floats] = {}
        identity = np.tile(np.eye(4), (len(times_ns), 1, 1))
        for frame in frames:
            chain = self.chain(frame)
            if chain is None:
                continue
            outer = identity
            for name in reversed(chain):
                if name not in in_world:
                    in_world[name] = matmul(outer, self._matrices(name, times_ns))
                outer = in_world[name]
            in_world.setdefault(frame, outer)
        return {frame: in_world[frame] for frame in frames if frame in in_world}

    def _matrices(self, frame: str, times_ns: Ints) -> Floats:
        """Return the poses of a frame relative to its parent."""
        if self._uses_received(frame):
            return self._links[frame].matrices(times_ns)
        return np.tile(self._in_file[frame].matrix, (len(times_ns), 1, 1))


def pose_of(matrix: Floats) -> tuple[float, ...]:
    """Return the position and the quaternion of a rigid transform (4, 4)."""
    (quaternion,) = quaternions_of(matrix[None, :3, :3])
    return (*matrix[:3, 3].tolist(), *quaternion.tolist())


def _checked_pose(pose: Sequence[float]) -> tuple[float, ...]:
    """Return a pose with a quaternion of norm 1. Raise ValueError if it is invalid."""
    values = tuple(map(float, pose))
    size = math.sqrt(sum(value * value for value in values[3:]))
    if not np.isfinite(values).all() or not abs(size - 1) <= _MAX_NORM_ERROR:
        raise ValueError("the pose is not finite, or the norm of its quaternion is not 1")
    return (*values[:3], *(value / size for value in values[3:]))


def _matrix_of(pose: tuple[float, ...]) -> Floats:
    (rotation,) = rotations_of_quaternions(np.array([pose[3:]]))
    return affine(rotation, np.array(pose[:3]))


def _interpolate(sample_times_ns: Ints, samples: Floats, times_ns: Ints) -> Floats:
    """Interpolate poses linearly, with a constant angular velocity between two samples.

    The samples have shape (s, 7), with s of at least 2, and the result has shape (k, 4, 4).
    """
    rows = np.searchsorted(sample_times_ns, times_ns, "right") - 1
    rows = np.clip(rows, 0, len(samples) - 2)
    steps_ns = sample_times_ns[rows + 1] - sample_times_ns[rows]
    share = np.clip((times_ns - sample_times_ns[rows]) / steps_ns, 0, 1)[:, None]
    first = samples[rows]
    last = samples[rows + 1]
    positions = first[:, :3] + share * (last[:, :3] - first[:, :3])
    start = first[:, 3:]
    end = last[:, 3:]
    if (start == end).all():
        return affine(rotations_of_quaternions(start), positions)
    # Spherical interpolation (Shoemake, 1985) by the shorter rotation
    end = np.where((start * end).sum(axis=1, keepdims=True) < 0, -end, end)
    angle = 2 * arctan2(norm(end - start), norm(end + start))[:, None]
    sine = sin_cos(angle)[0]
    is_small = sine < _MIN_SINE
    weights = [
        np.where(is_small, part, sin_cos(part * angle)[0] / np.where(is_small, 1, sine))
        for part in (1 - share, share)
    ]
    quaternions = weights[0] * start + weights[1] * end
    return affine(rotations_of_quaternions(quaternions / norm(quaternions)[:, None]), positions)

"""A lidar in a world file whose bodies another program moves by name."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from glob import escape
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..columns.cloud import Cloud
from ..errors import LidarError
from ..motion.rotations import check_rotations
from ..numerics.arrays import Floats, Ints
from ..sensor import Sensor
from ..survey.survey import Mounted
from ..words import name_hint
from .frame_tree import FrameTree, pose_of
from .world import WORLD, World
from .world_scanner import WorldScanner

_SLACK_NS = 1  # tolerance for the time of the last beam of a sweep


class WorldFollower:
    """A lidar in a world file whose bodies another program moves by name.

    `Follower.from_world` creates it.

    Parameters
    ----------
    world
        Bodies and frames of the world.
    sensor
        The lidar, or a `Mounted` lidar on a frame.
    frame
        Name of the frame that carries the sensor. By default, the sensor does not move. It does not
        see the body that the frame carries.
    **options
        Options of `Scanner`.

    Raises
    ------
    LidarError
        If the frame does not exist, or if an option is invalid.
    """

    def __init__(
        self, world: World, sensor: Sensor | Mounted, frame: str | None = None, **options: Any
    ) -> None:
        self._tree = FrameTree(world.frames)
        self._frame = WORLD if frame is None else frame
        if frame is not None:
            self._check_name(frame, world)
            sensor = unseen_by(sensor, world, frame)
        self._scanner = WorldScanner(world, sensor, **options)
        self._start_ns: int | None = None  # time of the first update
        self._last_ns = 0  # time of the last update, since the first
        self._number = 0  # index of the current sweep
        self._poses: dict[str, tuple[float, ...]] = {}  # last poses of the frames

    def __repr__(self) -> str:
        return f"<WorldFollower of {len(self._scanner.world.bodies)} bodies>"

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the bodies, in the order of the values in the column `object`."""
        return self._scanner.names

    @property
    def frames(self) -> tuple[str, ...]:
        """Names of the frames whose poses can be set."""
        return tuple(self._scanner.world.frames)

    def update(self, time_s: float, poses: Mapping[str, ArrayLike]) -> list[Cloud]:
        """Record poses of frames. Return the sweeps completed since the last update.

        The first sweep starts at the first update, and each further sweep starts where the previous
        one ends. If the time is before the last update, for example because the world was reset,
        all earlier poses are discarded and a new first sweep starts.

        Parameters
        ----------
        time_s
            Time in the world in seconds.
        poses
            Matrices (4, 4) from frames to the world, in meters, by the names of the frames (see
            `frames`). Between two updates, frames move at constant velocity and angular velocity.
            A frame that is omitted keeps its last pose in the world. If no pose of it was ever
            passed, it moves with the frame that carries it in the file.

        Returns
        -------
        list of Cloud
            The completed sweeps; usually none or one. The column `object` contains indices into
            `names`.

        Raises
        ------
        LidarError
            If a frame does not exist, or if a matrix is not a rigid transform.
        """
        if not np.isfinite(time_s):
            raise LidarError(f"time_s must be finite, but is {time_s}.")
        checked = {name: pose_of(self._checked_matrix(name, pose)) for name, pose in poses.items()}
        time_ns = round(time_s * 1e9)
        if self._start_ns is None or time_ns < self._start_ns + self._last_ns:
            self.reset()
            self._start_ns = time_ns
        else:
            self._add_earlier_poses(checked.keys() - self._poses.keys())
        self._last_ns = time_ns - self._start_ns
        self._poses |= checked
        for name, pose in self._poses.items():
            self._tree.add(name, WORLD, self._last_ns, pose)
        return list(self._completed_sweeps())

    def reset(self) -> None:
        """Discard all recorded poses, so that the next update starts the first sweep again."""
        self._tree = FrameTree(self._scanner.world.frames)
        self._poses.clear()
        self._start_ns = None
        self._last_ns = 0
        self._number = 0

    def _add_earlier_poses(self, names: set[str]) -> None:
        """Add the poses of frames at the last update, before their first own poses are added."""
        earlier = self._tree.poses(names, np.array([self._last_ns]))
        for name, matrices in earlier.items():
            self._tree.add(name, WORLD, self._last_ns, pose_of(matrices[0]))

    def _check_name(self, name: str, world: World) -> None:
        """Raise LidarError if a frame does not exist, or if its name is ambiguous."""
        if name in world.ambiguous:
            raise LidarError(f"The world has several frames with the name {name!r}. Rename them.")
        if name not in world.frames:
            raise LidarError(f"The world has no frame {name!r}.{name_hint(name, [*world.frames])}")

    def _checked_matrix(self, name: str, pose: ArrayLike) -> Floats:
        self._check_name(name, self._scanner.world)
        try:
            matrix = np.asarray(pose, np.float64).reshape(4, 4)
            check_rotations(matrix[None, :3, :3])
        except (TypeError, ValueError, LidarError) as error:
            raise LidarError(f"The pose of {name!r} must be a rigid transform (4, 4).") from error
        return matrix

    def _completed_sweeps(self) -> Iterator[Cloud]:
        """Yield the sweeps whose last beam was fired no later than the last update."""
        scanner = self._scanner
        while True:
            start_s, stop_s = scanner.scanner.span_s(self._number)
            start_ns = int(start_s * 1e9)
            stop_ns = int(np.ceil(stop_s * 1e9))
            if stop_ns > self._last_ns + _SLACK_NS:
                return
            self._tree.drop_before(start_ns)
            bodies = [body for body in scanner.world.bodies if self._tree.follows(body.frame)]
            frames = {body.frame for body in bodies} | {self._frame}
            times_ns = knots_ns(self._tree, frames, start_ns, stop_ns)
            poses = self._tree.poses(frames, times_ns)
            body_poses = {body.name: poses[body.frame] for body in bodies}
            yield scanner.sweep(self._number, times_ns / 1e9, poses[self._frame], body_poses)
            self._number += 1


def knots_ns(tree: FrameTree, frames: set[str], start_ns: int, stop_ns: int) -> Ints:
    """Return the times at which frames are sampled during a sweep.

    These are the start and end of the sweep, and the times of the poses in between.
    """
    moving = {name for frame in frames for name in tree.chain(frame) or ()}
    between = tree.sample_times(moving, start_ns, stop_ns)
    # A sensor that fires all its rays at once has no duration.
    return np.array([start_ns, *between, max(stop_ns, start_ns + 1)], np.int64)


def unseen_by(sensor: Sensor | Mounted, world: World, frame: str) -> Mounted:
    """Return a mounted sensor that does not see the bodies that its own frame carries."""
    mounted = sensor if isinstance(sensor, Mounted) else Mounted(sensor)
    own = [escape(body.name) for body in world.bodies if body.frame == frame]
    return replace(mounted, unseen=(*mounted.unseen, *own))

"""A sensor that is simulated next to a simulator, sweep by sweep."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from lidarfiles.clouds.ros.layouts import MessageLayout
from lidarfiles.clouds.ros.messages import RosMessage, SurveyMessages, static_frame
from lidarfiles.clouds.writing import ExportSpec, with_format_columns
from lidarscenario.sensors_file import SensorOnFrame
from lidarsim.columns.cloud import Cloud
from lidarsim.errors import LidarError
from lidarsim.motion.rotations import quaternions_of
from lidarsim.motion.trajectory import CENTER
from lidarsim.scene.actors import box
from lidarsim.survey.survey import Survey
from lidarsim.sweeps.sweeps import SweepPoses, Sweeps
from lidarsim.worlds.frame_tree import FrameTree
from lidarsim.worlds.world import WORLD, World, WorldBody, WorldFrame
from lidarsim.worlds.world_follower import knots_ns, unseen_by
from lidarsim.worlds.world_scanner import WorldScanner

_MAX_SPANS = 8  # spans that are kept
_MIN_SPAN_S = 1e-6  # a sensor that fires all rays at once has no duration


class SweepSpan(NamedTuple):
    """Times of the first and the last beam of a sweep in simulation time."""

    start_ns: int
    end_ns: int


class FollowedSensor:
    """A sensor on a frame of a simulated world.

    Parameters
    ----------
    sensor
        The sensor, its frame, and the options of its scanner.
    published_frame
        Name of the frame of its messages.
    world
        Bodies and frames of the world.
    spec
        Layout of the messages.
    """

    def __init__(
        self, sensor: SensorOnFrame, published_frame: str, world: World, spec: ExportSpec
    ) -> None:
        self.frame = sensor.frame
        self.published_frame = published_frame
        self._own = sensor.mounted
        self._spec = spec
        mounted = unseen_by(sensor.mounted, world, sensor.frame) if sensor.frame else self._own
        survey = Survey(
            sensors=[sensor.mounted],
            poses=[CENTER],
            steps=1,
            columns=(*sensor.options["columns"], *spec.needs),
        )
        options = {**sensor.options, "columns": with_format_columns(survey, [spec]).columns}
        self._options = {**options, "coordinates": "sensor"}
        self._scanner = WorldScanner(world, mounted, **self._options)
        self._sweeps: Sweeps | None = None  # placeholder whose times are replaced
        # Spans of sweeps, relative to the origin. They are requested for each clock message.
        self._spans: dict[int, SweepSpan] = {}
        self.origin_ns = 0  # simulation time at which sweep 0 starts
        self.number = 0  # index of the next sweep
        self.skipped = 0  # sweeps that were not simulated

    @property
    def name(self) -> str:
        """Name of the sensor in notices."""
        return self._own.name or self.published_frame

    @property
    def topic(self) -> str:
        """Topic of the points."""
        return f"/{self.published_frame}/points" if self._own.name else "/points"

    @property
    def world(self) -> World:
        """World that the sensor sees, including bodies that are absent."""
        return self._scanner.world

    @world.setter
    def world(self, world: World) -> None:
        if self.frame:
            self._scanner.sensor = unseen_by(self._own, world, self.frame)
        self._scanner.world = world

    def build(self) -> None:
        """Build the scanner for the world.

        Raises
        ------
        LidarError
            If the options of the scanner do not suit the world.
        """
        self._scanner.scanner  # noqa: B018 - the property builds it

    def restart(self, time_ns: int) -> None:
        """Let sweep 0 start at a time."""
        self.origin_ns = time_ns
        self.number = 0

    def span(self, number: int) -> SweepSpan:
        """Return the time span of a sweep."""
        if number not in self._spans:
            if len(self._spans) >= _MAX_SPANS:
                self._spans.clear()
            start_s, end_s = self._scanner.scanner.span_s(number)
            self._spans[number] = SweepSpan(math.floor(start_s * 1e9), math.ceil(end_s * 1e9))
        start_ns, end_ns = self._spans[number]
        return SweepSpan(self.origin_ns + start_ns, self.origin_ns + end_ns)

    def static_frame(self) -> RosMessage | None:
        """Return a message with the pose of the sensor on its frame.

        The message is None if the frame of the messages is that frame.

        Raises
        ------
        LidarError
            If both frames have the same name, but the sensor is not at the origin of the frame.
        """
        mount = self._own.mount
        position = np.array([mount.position])
        if self.frame == self.published_frame:
            if position.any() or (mount.rotation_matrix != np.eye(3)).any():
                raise LidarError(
                    f"The sensor {self.name!r} has the name of its frame, but its mount is not the "
                    "origin of the frame. Rename the sensor."
                )
            return None
        pose = SweepPoses(position, quaternions_of(mount.rotation_matrix[None]))
        return static_frame(self.frame or "world", self.published_frame, pose, 0)

    def prepare(self) -> None:
        """Build the scanner, and compile the loops for static and for moving bodies."""
        held = np.tile(np.eye(4), (2, 1, 1))
        times_s = np.array([0.0, max(self._scanner.scanner.span_s()[1], _MIN_SPAN_S)])
        cloud = self._scanner.sweep(0, times_s, held, {})
        for _ in self._messages(0, cloud):
            pass
        moved = held.copy()
        moved[1, 0, 3] = 0.1
        small = WorldScanner(_small_world(), replace(self._own, unseen=()), **self._options)
        small.sweep(0, times_s, moved, {"box": moved})

    def simulate(self, tree: FrameTree, absent: Collection[str]) -> list[RosMessage]:
        """Simulate the next sweep with the poses in a frame tree.

        Bodies in `absent` are not part of the world.

        Raises
        ------
        LidarError
            If a body cannot move.
        """
        number = self.number
        start_ns, end_ns = self.span(number)
        bodies = [
            body
            for body in self.world.bodies
            if body.can_move and body.name not in absent and tree.follows(body.frame)
        ]
        frames = {body.frame for body in bodies} | {self.frame}
        times_ns = knots_ns(tree, frames, start_ns, end_ns)
        poses = tree.poses(frames, times_ns)
        body_poses = {body.name: poses[body.frame] for body in bodies}
        times_s = (times_ns - self.origin_ns) / 1e9
        cloud = self._scanner.sweep(number, times_s, poses[self.frame], body_poses, absent)
        self.number += 1
        return list(self._messages(number, cloud))

    def _messages(self, number: int, cloud: Cloud) -> Iterator[RosMessage]:
        """Yield the messages of a sweep."""
        sweeps = self._single_sweep(number)
        layout = MessageLayout(self._spec.layout, organized=self._spec.organized)
        columns = {column.name for column in cloud.table}
        yield from SurveyMessages(sweeps, layout, columns).sensor_messages(0, cloud)

    def _single_sweep(self, number: int) -> Sweeps:
        """Return a survey's sweeps that consist of a single sweep with the given number."""
        scanner = self._scanner.scanner
        if self._sweeps is None:
            self._sweeps = Sweeps.from_survey(scanner.survey, scanner.scene.with_actors(()))
        sensor = self._own.sensor
        steps = sensor.steps_of_revolution(number)
        firings = np.array(sensor.firings_of_revolution(number))[[0, -1]]
        begin_ns, end_ns = (sensor.begins_ns(firings) + sensor.lead_ns).tolist()
        fired = self._sweeps.fired
        return replace(
            self._sweeps,
            scans=np.array([steps[0], steps[-1] + 1]),
            begins_ns=np.array([begin_ns]),
            ends_ns=np.array([end_ns]),
            start_ns=self.origin_ns,
            fired=fired and replace(fired, steps=np.array([steps[0]])),
        )

    def has_pose(self, tree: FrameTree) -> bool:
        """Return whether the pose of the sensor is known."""
        return self.frame == WORLD or tree.chain(self.frame) is not None


def _small_world() -> World:
    """Return a world with two boxes."""
    boxes = [
        box("ground", (40, 40, 0.1)).affine_transform("ground", np.eye(3), np.array([0, 0, -2.0])),
        box("box", (1, 1, 1)).affine_transform("box", np.eye(3), np.array([5.0, 0, -1])),
    ]
    bodies = tuple(WorldBody(item, item.name, np.eye(4)) for item in boxes)
    return World(bodies, {item.name: WorldFrame(WORLD, np.eye(4)) for item in boxes})

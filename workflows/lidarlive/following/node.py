"""A node that follows a running simulator through ROS 2 topics and publishes simulated sensors."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NoReturn, Protocol

import numpy as np

from lidarfiles.clouds.ros.messages import CLOCK_TOPIC, RosMessage
from lidarsim.errors import LidarError
from lidarsim.words import join_names, list_names, name_hint, plural
from lidarsim.worlds.frame_tree import FrameTree

from .followed_sensor import FollowedSensor
from .notices import MAX_NAMES, Notices
from .pose_input import PoseInput
from .world_files import FollowedWorld, ModelFolder

_MAX_SPEED_M_S = 100.0  # frames that move faster jump
_MAX_CLOCK_STEP_NS = 1_000_000_000  # a larger step of the clock is a jump
_SETTLE_NS = 2_000_000_000  # simulation time after which missing poses are reported
_QUIET_S = 5.0  # time without a clock message after which a notice is shown
_CHECK_NS = 50_000_000  # simulation time between checks of bodies and frames
_NEVER_NS = 2**63 - 1  # later than any time
_POLL_S = 0.05
_MAX_READ_S = 0.1  # time after which only the last message of each topic is read
_MAX_DELAYS = 10_000  # delays that are kept for the summary


@dataclass(frozen=True)
class FollowOptions:
    """Options of `FollowNode`.

    Attributes
    ----------
    world_frames
        Names of frames that coincide with the world frame.
    vanish_after_s
        Simulation time in seconds after which a body vanishes if the poses of its frames are no
        longer received. If it is 0, bodies never vanish.
    """

    world_frames: tuple[str, ...] = ("world", "map")
    vanish_after_s: float = 1.0


class MessageSink(Protocol):
    """Connection through which messages are published, such as `RosPublisher`."""

    def publish(self, message: RosMessage) -> None:
        """Publish a message."""


class MessageSource(Protocol):
    """Connection through which messages are received, such as `RosSubscriber`."""

    def receive(self, wait_s: float) -> Iterator[RosMessage]:
        """Yield the messages that have arrived, starting with those of the clock."""

    def publishers(self, topic: str) -> int:
        """Return the number of programs that publish a topic."""

    def is_shared(self, topic: str) -> bool:
        """Return whether messages of several programs on a topic arrive in turns."""


class FollowNode:
    """Publishes the sweeps of sensors in a world that a simulator controls.

    The node receives the clock and the poses of frames. A sweep is simulated as soon as the clock
    has passed its end, and the poses of all frames that move have been received up to its end. If
    poses are missing, the sweep is simulated one sweep later with the last poses.

    Parameters
    ----------
    followed
        World and robots.
    models
        Models that the simulator can spawn.
    sensors
        Sensors, all of which have the same world.
    publisher, subscriber
        Connections through which messages are published and received.
    note
        Function that shows a notice.
    options
        Further options.
    """

    def __init__(
        self,
        followed: FollowedWorld,
        models: ModelFolder,
        sensors: Sequence[FollowedSensor],
        publisher: MessageSink,
        subscriber: MessageSource,
        note: Callable[[str], None],
        options: FollowOptions = FollowOptions(),
    ) -> None:
        self._world = followed.world
        self._models = models
        self._sensors = sensors
        self._publisher = publisher
        self._options = options
        self._notices = Notices(note)
        roots = {*options.world_frames, *followed.world.roots}
        self._tree = FrameTree(followed.world.frames, roots, _MAX_SPEED_M_S)
        self._poses = PoseInput(self._tree, self._notices)
        self._poses.add_robots(followed.robots)
        self._subscriber = subscriber
        self._absent: set[str] = set()  # names of bodies
        self._lost: set[FollowedSensor] = set()  # sensors whose frames vanished
        self._examined: set[str] = set()  # received frames that were compared with the models
        self._checked_ns = 0  # simulation time at which bodies and frames were last checked
        self._start_ns = 0  # simulation time at which the node started, or time jumped
        self._clock_s = time.monotonic()  # when the last clock message arrived
        self._ends_s: dict[FollowedSensor, float] = {}  # when the end of its sweep was reached
        self.published = 0  # number of sweeps
        # Times between the end of the last sweeps and their publication
        self._delays_s = deque[float](maxlen=_MAX_DELAYS)

    @property
    def description(self) -> str:
        """Topics of the sensors. It is part of the "ready" message."""
        return list_names([sensor.topic for sensor in self._sensors], MAX_NAMES)

    @property
    def summary(self) -> str:
        """Number of published and skipped sweeps, and their delays."""
        published = self.published
        skipped = sum(sensor.skipped for sensor in self._sensors)
        verb = "was" if published == 1 else "were"
        text = f"{plural(published, 'sweep')} {verb} published"
        if skipped:
            text += f" and {skipped:,} skipped"
        if published:
            median, last = np.percentile(self._delays_s, (50, 99)) * 1e3
            text += (
                f". The delay after the end of a sweep was {median:.0f} ms (median) and "
                f"{last:.0f} ms (99th percentile)"
            )
        return f"{text}."

    def start(self) -> None:
        """Build the scanners, and publish the frames of the sensors."""
        for sensor in self._sensors:
            sensor.prepare()
            message = sensor.static_frame()
            if message is not None:
                self._publisher.publish(message)
            if not sensor.has_pose(self._tree):
                self._report_missing(sensor)
        self._clock_s = time.monotonic()  # building the scanners can take long

    def run(self) -> NoReturn:
        """Follow the simulator until an exception is raised, such as KeyboardInterrupt."""
        wait_s = _POLL_S
        while True:
            was_due = self.step(wait_s)
            wait_s = 0.0 if was_due else _POLL_S  # the sweep of another sensor may be due

    def step(self, wait_s: float = _POLL_S) -> bool:
        """Receive messages, and simulate at most one sweep.

        Parameters
        ----------
        wait_s
            Maximum time in seconds to wait for a message.

        Returns
        -------
        bool
            Whether a sweep was due.
        """
        self._read_messages(wait_s)
        self._check_publishers()
        clock_ns = self._poses.clock_ns
        if clock_ns is None:
            self._tree.drop_before(_NEVER_NS)  # only the last poses are needed
            return False
        if len(self._tree.received) > len(self._examined):
            self._add_models()
        if abs(clock_ns - self._checked_ns) >= _CHECK_NS:
            self._checked_ns = clock_ns
            self._tree.drop_before(min(item.span(item.number).start_ns for item in self._sensors))
            self._update_absent(clock_ns)
            if clock_ns - self._start_ns > _SETTLE_NS:
                self._report_frames()
        sensor = self._next_due()
        if sensor is not None:
            self._simulate(sensor)
        return sensor is not None

    def _read_messages(self, wait_s: float) -> None:
        """Read the clock and the poses that have arrived.

        If poses arrive faster than they can be read, some are skipped. Otherwise, the clock and the
        sweeps would fall behind without limit.
        """
        begin_s: float | None = None  # when the first message was read, which is after the wait
        skipped: dict[str, RosMessage] = {}  # {topic: its last message that was not read}
        count = 0
        for message in self._subscriber.receive(wait_s):
            begin_s = begin_s or time.monotonic()
            is_needed = message.topic == CLOCK_TOPIC or message.topic.endswith("_static")
            if not is_needed and time.monotonic() - begin_s > _MAX_READ_S:
                count += message.topic in skipped
                skipped[message.topic] = message
                continue
            time_ns = self._poses.read(message)
            if time_ns is not None:
                self._set_clock(time_ns)
        for message in skipped.values():
            self._poses.read(message)
        if count:
            self._notices.show_event(
                "flood",
                f"Poses arrive faster than they can be read, so {plural(count, 'message')} on "
                f"{list_names([*skipped], MAX_NAMES)} were skipped. Publish fewer frames, or "
                "reduce the rate.",
            )

    def _set_clock(self, time_ns: int) -> None:
        """Set the simulation time. The sweeps are restarted if it has jumped."""
        last_ns = self._poses.clock_ns
        self._clock_s = time.monotonic()
        has_jumped = last_ns is not None and not 0 <= time_ns - last_ns <= _MAX_CLOCK_STEP_NS
        if has_jumped:
            self._poses.restart()
        self._poses.set_clock(time_ns)
        was_quiet = [self._notices.clear(("quiet", is_published)) for is_published in (False, True)]
        if any(was_quiet):
            self._notices.show_event("clock received", "Messages on /clock are arriving.")
        if last_ns is None:
            self._restart(time_ns)
        elif has_jumped:
            self._tree.restart(time_ns)
            self._restart(time_ns)
            direction = "back" if time_ns < last_ns else "ahead"
            self._notices.show_event(
                "time",
                f"The simulation time jumped {direction} from {last_ns / 1e9:.3f} to "
                f"{time_ns / 1e9:.3f} s. The sweeps are restarted.",
            )
        for sensor in self._sensors:
            if sensor not in self._ends_s and time_ns >= sensor.span(sensor.number).end_ns:
                self._ends_s[sensor] = self._clock_s

    def _restart(self, time_ns: int) -> None:
        """Let the sweeps of all sensors start at a time."""
        self._start_ns = time_ns
        self._absent = set()
        self._lost = set()
        self._ends_s.clear()
        for sensor in self._sensors:
            sensor.restart(time_ns)

    def _check_publishers(self) -> None:
        """Show a notice if no clock, or more than one, is published."""
        if self._subscriber.is_shared(CLOCK_TOPIC):
            self._notices.show(
                "clocks",
                "Several programs publish /clock. Stop all simulators but one, because the time "
                "jumps between their clocks.",
            )
        else:
            self._notices.clear("clocks")
        if time.monotonic() - self._clock_s > _QUIET_S:
            is_published = self._subscriber.publishers(CLOCK_TOPIC) > 0
            reason = "The simulator seems to be paused"
            if not is_published:
                reason = "No program publishes it. Start the simulator, and bridge its clock"
            self._notices.show(
                ("quiet", is_published),
                f"No message on /clock for {_QUIET_S:g} s. {reason}. Waiting.",
            )

    def _next_due(self) -> FollowedSensor | None:
        """Return the sensor whose sweep ended first and can be simulated, or None.

        Sweeps that are too late are skipped.
        """
        due = [sensor for sensor in self._sensors if self._is_due(sensor)]
        return min(due, key=lambda sensor: sensor.span(sensor.number).end_ns, default=None)

    def _is_due(self, sensor: FollowedSensor) -> bool:
        """Return whether the next sweep of a sensor can be simulated."""
        clock_ns = self._poses.clock_ns
        assert clock_ns is not None
        next_span = sensor.span(sensor.number + 1)
        while clock_ns >= next_span.end_ns + (next_span.end_ns - next_span.start_ns):
            sensor.number += 1
            sensor.skipped += 1
            self._ends_s.pop(sensor, None)
            self._notices.show_event(
                ("slow", sensor.name),
                f"A sweep of {sensor.name} was skipped, because it could not be simulated in time. "
                "If this happens repeatedly, reduce the real-time factor or the number of rays.",
            )
            next_span = sensor.span(sensor.number + 1)
        span = sensor.span(sensor.number)
        if clock_ns < span.end_ns:
            return False
        self._ends_s.setdefault(sensor, self._clock_s)
        behind = self._behind(sensor)
        deadline_ns = span.end_ns + (next_span.start_ns - span.start_ns)
        if behind and clock_ns < deadline_ns:
            return False
        self._notices.show_names(
            "rare",
            behind,
            "Poses of {names} arrive later than the end of the next sweep. The last poses are "
            "used instead. Publish poses at least once per sweep.",
        )
        return True

    def _behind(self, sensor: FollowedSensor) -> list[str]:
        """Return the frames whose poses have not been received up to the end of a sweep.

        Frames whose poses were not received during a whole sweep are omitted, because they no
        longer move.
        """
        span = sensor.span(sensor.number)
        length_ns = span.end_ns - span.start_ns
        frames = {body.frame for body in self._world.bodies if body.name not in self._absent}
        live = self._tree.live(self._with_ancestors([*frames, sensor.frame]))
        return [
            name
            for name, last_ns in live.items()
            if span.start_ns - length_ns <= last_ns < span.end_ns
        ]

    def _with_ancestors(self, frames: Iterable[str]) -> set[str]:
        """Return frames and all frames between them and the world."""
        return {name for frame in frames for name in self._tree.chain(frame) or ()}

    def _simulate(self, sensor: FollowedSensor) -> None:
        """Simulate and publish the next sweep of a sensor."""
        end_s = self._ends_s.pop(sensor, self._clock_s)
        if sensor in self._lost or not sensor.has_pose(self._tree):
            sensor.number += 1
            self._report_missing(sensor)
            return
        self._notices.clear(("missing", sensor.name))
        try:
            messages = sensor.simulate(self._tree, self._absent)
        except LidarError as error:
            sensor.number += 1
            self._notices.show(
                ("failed", str(error)),
                f"A sweep of {sensor.name} could not be simulated. {error}",
            )
            return
        for message in messages:
            self._publisher.publish(message)
        self.published += 1
        self._delays_s.append(time.monotonic() - end_s)

    def _report_missing(self, sensor: FollowedSensor) -> None:
        """Show a notice about a sensor whose frame has no pose."""
        frames = self._world.frames
        hint = "" if sensor.frame in frames else name_hint(sensor.frame, [*frames])
        self._notices.show(
            ("missing", sensor.name),
            f"No pose is known for {sensor.frame}, the frame of the sensor {sensor.name}. The "
            f"sensor publishes nothing until its pose is received.{hint}",
        )

    def _add_models(self) -> None:
        """Add models that were spawned."""
        found: dict[str, FollowedWorld] = {}
        for frame in [*self._tree.received]:
            if frame in self._examined:
                continue
            self._examined.add(frame)
            known = {*self._world.frames, *found}
            if not {frame, frame.partition("/")[0]} & known:
                found |= self._find_model(frame)
        if found and not self._add(found) and len(found) > 1:
            for name, model in found.items():
                self._add({name: model})

    def _find_model(self, frame: str) -> dict[str, FollowedWorld]:
        """Return the model of an unknown frame by its name, or an empty mapping."""
        try:
            found = self._models.find(frame)
        except (LidarError, OSError) as error:
            self._notices.show(("model", frame), f"The model of {frame} cannot be read. {error}")
            return {}
        return {} if found is None else dict([found])

    def _add(self, models: Mapping[str, FollowedWorld]) -> bool:
        """Add models to the world. Return False if the sensors cannot see the new world."""
        world = self._world
        try:
            for model in models.values():
                world = world.with_world(model.world)
            for sensor in self._sensors:
                sensor.world = world
                sensor.build()
        except LidarError as error:
            for sensor in self._sensors:
                sensor.world = self._world
            if len(models) == 1:
                (name,) = models
                self._notices.show(("model", name), f"{name} was not added to the world. {error}")
            return False
        self._world = world
        for name, model in models.items():
            self._tree.add_frames(model.world.frames)
            self._poses.add_robots(model.robots)
            self._notices.show(("added", name), f"{name} was added to the world.")
        return True

    def _update_absent(self, clock_ns: int) -> None:
        """Determine the bodies whose frames are no longer received."""
        limit_ns = self._options.vanish_after_s * 1e9
        last_ns = self._poses.last_ns
        if not limit_ns or last_ns is None or clock_ns - last_ns > limit_ns / 2:
            return  # no poses are received at all
        oldest_ns = clock_ns - limit_ns
        bodies = self._world.bodies
        absent = {body.name for body in bodies if self._is_lost(body.frame, oldest_ns)}
        self._lost = {item for item in self._sensors if self._is_lost(item.frame, oldest_ns)}
        for name in sorted(absent - self._absent):
            self._notices.clear(("back", name))
            self._notices.show(
                ("gone", name),
                f"{name} vanished, because no poses were received for "
                f"{self._options.vanish_after_s:g} s.",
            )
        for name in sorted(self._absent - absent):
            self._notices.clear(("gone", name))
            self._notices.show(("back", name), f"{name} is back.")
        self._absent = absent

    def _is_lost(self, frame: str, oldest_ns: float) -> bool:
        """Return whether all poses of a frame and of its ancestors are older than a time."""
        live = self._tree.live(self._tree.chain(frame) or ())
        return bool(live) and max(live.values()) < oldest_ns

    def _report_frames(self) -> None:
        """Show notices about bodies without poses, and about frames that are unknown."""
        received = self._tree.received
        without = [
            body.name
            for body in self._world.bodies
            if body.is_static is False
            and not any(name in received for name in self._world.chain(body.frame))
        ]
        self._notices.show_names(
            "still",
            without,
            "No poses were received for {names}. They stay at their poses in the file.",
        )
        rigid = [
            body.name
            for body in self._world.bodies
            if not body.can_move and self._tree.follows(body.frame)
        ]
        self._notices.show_names(
            "voxels", rigid, "{names} contain voxels, so they stay at their poses in the file."
        )
        own = {sensor.published_frame for sensor in self._sensors}
        unknown = [name for name in received if self._tree.chain(name) is None and name not in own]
        if unknown:
            roots = sorted(self._tree.parents - {*received} - {*self._world.frames})
            self._notices.show_names(
                "loose",
                unknown,
                "These frames are not connected to the world: {names}. Their root frames are "
                f"{join_names(roots[:MAX_NAMES])}. If one of them coincides with the world, pass "
                f"`--world-frame {roots[0] if roots else 'NAME'}`.",
            )
        known = {*self._world.frames, *own, *self._tree.parents}
        known |= {sensor.frame for sensor in self._sensors}
        # Other frames on a model, such as those of cameras, usually have no objects.
        in_world = [name for name in received if len(self._tree.chain(name) or ()) == 1]
        without_mesh = [name for name in in_world if name not in known]
        self._notices.show_names(
            "unknown",
            without_mesh,
            "The world has no objects for these frames, so the sensors do not see them: {names}. "
            "If they are models, pass their folder as `--models`.",
        )

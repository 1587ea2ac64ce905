"""Sweeps as topics of ROS 2: clouds in a driver's layout, frames, instruments and the clock."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from heapq import merge
from itertools import count
from typing import Any, ClassVar, Self

from lidarsim.columns.cloud import Cloud
from lidarsim.sweeps.sweeps import Sweeps
from lidarsim.words import joined, plural

from ..clouds.frame_names import survey_start_ns
from ..clouds.ros.layouts import MessageLayout
from ..clouds.ros.messages import RosMessage, SurveyMessages
from ..clouds.writing import ExportSpec
from .bridge import Bridge, BridgeOptions
from .dds import Network, RosPublisher
from .schedule import Schedule

_CLOCK_NS = 10_000_000  # between messages of the clock, of the survey's time


class Ros2Bridge(Bridge):
    """Publishes sweeps as drivers do, each at its end, and IMU, GNSS receiver and clock between.

    Topics, types and layouts are as in bags (`Rosbag2`). Nodes take the time of the survey
    from `/clock` (`use_sim_time`), unless it is played at today's time.
    """

    settings: ClassVar[tuple[str, ...]] = ("layout", "organized", "pose_rate_hz")

    def __init__(
        self,
        sweeps: Sweeps,
        schedule: Schedule,
        options: BridgeOptions,
        note: Callable[[str], None],
    ) -> None:
        super().__init__(sweeps, schedule, options, note)
        self._format = self.format_of(options.settings)
        self._message_layout = MessageLayout(self._format.layout, organized=self._format.organized)
        self._publisher = RosPublisher(Network.to(options.to))
        self._messages: SurveyMessages | None = None  # messages of the sweeps of a lap
        self._shift_ns = 0  # shift of the lap
        self._columns: set[str] = set()
        self._between = threading.Thread(target=self._publish_between, daemon=True)
        self._stopped = threading.Event()

    @classmethod
    def format_of(cls, settings: Mapping[str, Any]) -> ExportSpec:
        """Return the format of bags with the same messages."""
        organized = bool(settings.get("organized"))
        return ExportSpec(
            "mcap",
            settings.get("layout", "velodyne"),
            organized=organized,
            pose_rate_hz=settings.get("pose_rate_hz"),
        )

    @property
    def description(self) -> str:
        """Domain and interface of the topics."""
        network = self._publisher.network
        peers = f", with the peers {joined(network.peers)}" if network.peers else ""
        return f"ROS 2 topics in domain {network.domain} on {network.address}{peers}"

    def prepare(self, sweep: int, points: Cloud) -> None:
        """Publish static messages.

        Raises LidarError if the cloud lacks columns of the layout.
        """
        self._format.check_columns(points)
        if self._messages is None:
            self._columns = {column.name for column in points.table}
            self._messages = self._of_lap(0)
            for message in self._messages.static_messages():
                self._publisher.publish(message)
        for _ in self._messages.sweep_messages(sweep, points):  # compiles what it needs
            pass

    def send(self, sweep: int, points: Cloud, shift_ns: int) -> None:
        """Publish the messages of a sweep."""
        if self._messages is None or shift_ns != self._shift_ns:
            self._messages = self._of_lap(shift_ns)
            self._shift_ns = shift_ns
        if not self._between.is_alive() and not self._stopped.is_set():
            self._between.start()
        for message in self._messages.sweep_messages(sweep, points):
            self._publisher.publish(message)

    @property
    def summary(self) -> str:
        """How many messages readers were too slow for."""
        dropped = self._publisher.dropped
        if not dropped:
            return ""
        verb = "was" if dropped == 1 else "were"
        return f"{plural(dropped, 'message')} {verb} dropped, because a subscriber was too slow"

    def __enter__(self) -> Self:
        self._publisher.__enter__()
        return self

    def __exit__(self, *error: object) -> None:
        """End the thread, and take the topics away."""
        self._stopped.set()
        if self._between.is_alive():
            self._between.join()
        self._publisher.__exit__(*error)

    def _of_lap(self, shift_ns: int) -> SurveyMessages:
        """Return the messages of a lap, whose times are `shift_ns` later."""
        start_ns = survey_start_ns(self.sweeps) + shift_ns
        return SurveyMessages(
            replace(self.sweeps, start_ns=start_ns),
            self._message_layout,
            self._columns,
            self._format.pose_rate_hz,
        )

    def _publish_between(self) -> None:
        """Publish clock and instruments at their times, until the context ends."""
        survey_ns = survey_start_ns(self.sweeps)
        for message in merge(self._clock(), self._instruments(), key=lambda sent: sent.time_ns):
            deadline_s = -self.schedule.late_s(message.time_ns - survey_ns)
            if self._stopped.wait(max(deadline_s, 0.0)):
                return
            self._publisher.publish(message)

    def _clock(self) -> Iterator[RosMessage]:
        """Yield the messages of the clock from the start of the first sweep on, without end."""
        messages = self._of_lap(0)
        first_ns = survey_start_ns(self.sweeps) + round(self.sweeps.begins_ns.min())
        for time_ns in count(first_ns, _CLOCK_NS):
            yield messages.clock_message(time_ns)

    def _instruments(self) -> Iterator[RosMessage]:
        """Yield the messages of IMU and GNSS receiver, of each lap, or none without instruments."""
        period_ns = self.options.period_ns
        for lap in count() if period_ns else range(1):
            last_message = None
            for message in self._of_lap(lap * period_ns).instrument_messages():
                yield message
                last_message = message
            if last_message is None:
                return

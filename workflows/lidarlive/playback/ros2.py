"""Bridge that publishes sweeps, frames, instruments and the clock on ROS 2 topics."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from heapq import merge
from itertools import count
from typing import Any, ClassVar, Self

from lidarfiles.clouds.frame_names import survey_start_ns
from lidarfiles.clouds.ros.layouts import MessageLayout
from lidarfiles.clouds.ros.messages import RosMessage, SurveyMessages
from lidarfiles.clouds.writing import ExportSpec
from lidarsim.columns.cloud import Cloud
from lidarsim.sweeps.sweeps import Sweeps
from lidarsim.words import join_names, plural

from .bridge import Bridge, BridgeOptions
from .dds import Network, RosPublisher
from .schedule import Schedule

_CLOCK_NS = 10_000_000  # period of clock messages in survey time


class Ros2Bridge(Bridge):
    """Bridge that publishes sweeps like a sensor driver, with navigation data and a clock.

    Each sweep is published when it ends. Messages of the IMU, of the GNSS receiver, and of the
    clock are published between sweeps. Topics, types and layouts are the same as in bags
    (`Rosbag2`). Nodes use the survey time of `/clock` with `use_sim_time`, unless the survey is
    played with the current time.
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
        self._publisher = RosPublisher(Network.for_hosts(options.to))
        self._messages: SurveyMessages | None = None  # messages of the current repetition
        self._shift_ns = 0  # time shift of the current repetition
        self._columns: set[str] = set()
        self._between = threading.Thread(target=self._publish_between, daemon=True)
        self._stopped = threading.Event()

    @classmethod
    def format_of(cls, settings: Mapping[str, Any]) -> ExportSpec:
        """Return the bag format that contains the same messages."""
        organized = bool(settings.get("organized"))
        return ExportSpec(
            "mcap",
            settings.get("layout", "velodyne"),
            organized=organized,
            pose_rate_hz=settings.get("pose_rate_hz"),
        )

    @property
    def description(self) -> str:
        """Domain and network interface of the topics."""
        network = self._publisher.network
        peers = f", with the peers {join_names(network.peers)}" if network.peers else ""
        return f"ROS 2 topics in domain {network.domain} on {network.address}{peers}"

    def prepare(self, sweep: int, points: Cloud) -> None:
        """Publish the static messages.

        Raises
        ------
        LidarError
            If the cloud lacks columns that the layout requires.
        """
        self._format.check_columns(points)
        if self._messages is None:
            self._columns = {column.name for column in points.table}
            self._messages = self._lap_messages(0)
            for message in self._messages.static_messages():
                self._publisher.publish(message)
        for _ in self._messages.sweep_messages(sweep, points):  # triggers compilation
            pass

    def send(self, sweep: int, points: Cloud, shift_ns: int) -> None:
        """Publish the messages of a sweep."""
        if self._messages is None or shift_ns != self._shift_ns:
            self._messages = self._lap_messages(shift_ns)
            self._shift_ns = shift_ns
        if not self._between.is_alive() and not self._stopped.is_set():
            self._between.start()
        for message in self._messages.sweep_messages(sweep, points):
            self._publisher.publish(message)

    @property
    def summary(self) -> str:
        """Number of messages that were dropped because a subscriber was too slow."""
        dropped = self._publisher.dropped
        if not dropped:
            return ""
        verb = "was" if dropped == 1 else "were"
        return f"{plural(dropped, 'message')} {verb} dropped, because a subscriber was too slow"

    def __enter__(self) -> Self:
        self._publisher.__enter__()
        return self

    def __exit__(self, *error: object) -> None:
        """Stop the thread and remove the topics."""
        self._stopped.set()
        if self._between.is_alive():
            self._between.join()
        self._publisher.__exit__(*error)

    def _lap_messages(self, shift_ns: int) -> SurveyMessages:
        """Return the messages of a repetition, with times shifted by `shift_ns`."""
        start_ns = survey_start_ns(self.sweeps) + shift_ns
        return SurveyMessages(
            replace(self.sweeps, start_ns=start_ns),
            self._message_layout,
            self._columns,
            self._format.pose_rate_hz,
        )

    def _publish_between(self) -> None:
        """Publish clock and instrument messages on time until the context ends."""
        survey_ns = survey_start_ns(self.sweeps)
        for message in merge(self._clock(), self._instruments(), key=lambda sent: sent.time_ns):
            deadline_s = -self.schedule.late_s(message.time_ns - survey_ns)
            if self._stopped.wait(max(deadline_s, 0.0)):
                return
            self._publisher.publish(message)

    def _clock(self) -> Iterator[RosMessage]:
        """Yield an unlimited number of clock messages, starting with the first sweep."""
        messages = self._lap_messages(0)
        first_ns = survey_start_ns(self.sweeps) + round(self.sweeps.begins_ns.min())
        for time_ns in count(first_ns, _CLOCK_NS):
            yield messages.clock_message(time_ns)

    def _instruments(self) -> Iterator[RosMessage]:
        """Yield the IMU and GNSS messages of each repetition."""
        period_ns = self.options.period_ns
        for lap in count() if period_ns else range(1):
            last_message = None
            for message in self._lap_messages(lap * period_ns).instrument_messages():
                yield message
                last_message = message
            if last_message is None:
                return

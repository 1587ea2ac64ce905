"""Messages of stages 1 and 4 to the driver."""

from __future__ import annotations

import time
from collections.abc import Iterable

from poolpart import Pipe

from .stage_messages import ColumnsLost, Failed, Scans, StageStart

SEND_EVERY_S = 0.05  # minimum interval between sending messages, which are sent together

News = Scans | ColumnsLost | Failed  # message to the driver


class MessageSender:
    """Sender that combines messages to the driver if they follow each other quickly.

    At most `max_items` messages are sent at a time. Without a limit (0), the capacity of the pipe
    is ignored.
    """

    def __init__(self, start: StageStart, outlet: Pipe, max_items: int = 0) -> None:
        self._start = start
        self._outlet = outlet
        self._max_items = max_items
        self.scan_count = 0  # number of scans that have been sent

    def send(self, news: Iterable[News]) -> None:
        """Send messages as an iterable produces them."""
        waiting: list[News] = []
        sent_at = time.monotonic()
        for item in news:
            waiting.append(item)
            if len(waiting) == self._max_items or time.monotonic() - sent_at > SEND_EVERY_S:
                self._put(waiting)
                waiting = []
                sent_at = time.monotonic()
        self._put(waiting)

    def _put(self, news: list[News]) -> None:
        self._outlet.put_many(news, unbounded=not self._max_items)
        for item in news:
            if isinstance(item, Scans):
                self._start.trace("sent", item.scans)
                self.scan_count += len(item.scans)

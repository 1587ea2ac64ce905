"""Order of captured packets whose device times state in which order they were sent.

UDP does not guarantee the order of datagrams, and a mirrored port captures each of them twice.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from heapq import heappop, heappush

from ..words import plural
from .capture import CapturedDatagram

_WAITING = 16  # packets that are kept until later packets have arrived
# Maximum delay of a packet. If the clock of the sensor goes back further, it was set. This is less
# than a revolution, because a sensor can send its last revolution again.
_MAX_DELAY_US = 20_000


class PacketOrder:
    """Sorts the packets of one sensor by their device times, and drops duplicate packets.

    Parameters
    ----------
    time_us
        Function that returns the device time in a payload in microseconds.
    period_us
        Time after which device times start again at 0.

    Attributes
    ----------
    late
        Number of packets that arrived after a packet that was sent later.
    repeated
        Number of duplicate packets, which were dropped.
    """

    def __init__(self, time_us: Callable[[bytes], int], period_us: int) -> None:
        self.late = 0
        self.repeated = 0
        self._time_us = time_us
        self._period_us = period_us
        self._newest_us: int | None = None  # latest device time, which does not start again
        # Heap of waiting packets: device time, number of arrivals before, and datagram.
        self._waiting: list[tuple[int, int, CapturedDatagram]] = []
        self._capture_ns: list[int] = []  # heap of the capture times of waiting packets
        self._recent: deque[bytes] = deque(maxlen=2 * _WAITING)
        self._count = 0

    def add(self, datagram: CapturedDatagram) -> list[CapturedDatagram]:
        """Add a packet in the order of the capture, and return the packets that are in order now.

        The capture times of the returned packets are ascending as well.
        """
        released = []
        time_us = self._time_us(datagram.payload)
        if self._newest_us is not None:
            half_us = self._period_us // 2
            step_us = (time_us - self._newest_us + half_us) % self._period_us - half_us
            if step_us < -_MAX_DELAY_US:
                released = self.finish()
            elif datagram.payload in self._recent:
                self.repeated += 1
                return []
            else:
                self.late += step_us < 0
                time_us = self._newest_us + step_us
        self._newest_us = time_us if self._newest_us is None else max(self._newest_us, time_us)
        self._recent.append(datagram.payload)
        heappush(self._waiting, (time_us, self._count, datagram))
        heappush(self._capture_ns, datagram.time_ns)
        self._count += 1
        if len(self._waiting) > _WAITING:
            released.append(self._pop())
        return released

    def finish(self) -> list[CapturedDatagram]:
        """Return the waiting packets, and start again."""
        released = [self._pop() for _ in range(len(self._waiting))]
        self._newest_us = None
        self._recent.clear()
        return released

    def _pop(self) -> CapturedDatagram:
        datagram = heappop(self._waiting)[2]
        return datagram._replace(time_ns=heappop(self._capture_ns))


def order_notes(orders: Iterable[PacketOrder]) -> list[str]:
    """Return notes on packets that were sorted or dropped. They follow the name of the file."""
    listed = [*orders]
    notes = []
    if late := sum(order.late for order in listed):
        notes.append(f"has {plural(late, 'packet')} out of order, which are sorted by device time")
    if repeated := sum(order.repeated for order in listed):
        notes.append(f"has {plural(repeated, 'duplicate packet')}, which are skipped")
    return notes

"""Script of a process that reads datagrams from stdin and sends them at their due times.

`send.Sender` runs this file as a script, which reports to stdout. It imports only the standard
library, so that it starts within milliseconds. It is a separate process, because a thread in the
ray-casting process would share the global interpreter lock and was 8 to 300 ms late.

Each record begins with `HEADER`: its kind, the number of the sensor, the destination port, the
source port (0 for any), the size of the content, and a time. A DATAGRAM record contains a payload
that is sent at its time on the clock of `time.monotonic_ns`. A ROUTE record contains JSON that
states where further datagrams of a sensor are sent. After an END record, the process sends the
pending datagrams and exits. If stdin ends without END, the ray-casting process has died, and the
sender exits at once.
"""

from __future__ import annotations

import heapq
import json
import os
import select
import signal
import socket
import sys
import time
from bisect import bisect_left
from contextlib import suppress
from struct import Struct
from typing import Any, NoReturn

HEADER = Struct("<HHHHIq")  # kind, sensor, port, source port, size, time
DATAGRAM, ROUTE, END = range(3)
# Upper limits of lateness bins in milliseconds. A last bin counts all later datagrams.
BINS_MS = (0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)
# Largest speed-up at which late datagrams of a sensor are sent, so that the receiver, whose buffers
# hold only a few datagrams, does not lose any.
_CATCH_UP = 2
_READ_BYTES = 1 << 16  # number of bytes read at a time between datagrams
_MAX_WAITING_BYTES = 256 << 20
_NICENESS = -10


class Stop(Exception):  # noqa: N818 - not an error
    """Raised on SIGTERM, after which no further datagrams are sent."""


class Route:
    """Destination of a sensor's datagrams, and times of its last datagram."""

    def __init__(self) -> None:
        self.host = ""
        self.ports: dict[int, int] = {}  # {port of a datagram: port of the host}; 0: not sent
        self._source = ""  # source address; empty for any
        self._sockets: dict[int, socket.socket] = {}  # {source port: socket}
        self._due_ns = 0
        self._sent_ns = 0

    def change(self, values: dict[str, Any]) -> None:
        """Change the destination and the source address of the datagrams."""
        self.host = values["host"]
        self.ports = {int(port): number for port, number in values["ports"].items()}
        if values["source"] != self._source:
            for opened in self._sockets.values():
                opened.close()
            self._sockets = {}
            self._source = values["source"]

    def open_from(self, port: int) -> socket.socket:
        """Return the socket for a source port, opening it on first use.

        Port 0 stands for any port.
        """
        if port not in self._sockets:
            self._sockets[port] = _open_socket(self._source, port)
        return self._sockets[port]

    def earliest_ns(self, due_ns: int) -> int:
        """Return the earliest time at which a datagram may be sent.

        This is its due time, or a later time if the last datagram was late.
        """
        return max(due_ns, self._sent_ns + (due_ns - self._due_ns) // _CATCH_UP)

    def mark_sent(self, due_ns: int) -> int:
        """Record that a datagram is being sent, and return its lateness in nanoseconds."""
        self._due_ns = due_ns
        self._sent_ns = time.monotonic_ns()
        return self._sent_ns - due_ns


def _open_socket(source: str, port: int) -> socket.socket:
    """Return a socket, bound to a source address and port if these are available."""
    opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    for number in (port, 0) if source else (port,):
        with suppress(OSError):
            opened.bind((source, number))
            break
    return opened


class SendQueue:
    """Datagrams that wait for their due times, and statistics of the datagrams already sent."""

    def __init__(self) -> None:
        # A heap sorted by due time and order of arrival.
        self.waiting: list[tuple[int, int, int, int, int, bytes]] = []
        self.waiting_bytes = 0
        self.routes: dict[int, Route] = {}
        self.ended = False
        self._count = 0  # number of datagrams received so far
        self._late = [0] * (len(BINS_MS) + 1)
        self._max_late_ns = 0
        self._sent = 0
        self._failures: dict[str, int] = {}  # {error: number of datagrams that were not sent}
        self._rest = b""  # beginning of a record that has not completely arrived

    def parse_records(self, content: bytes) -> None:
        """Parse the records in the next bytes from stdin."""
        content = self._rest + content
        start = 0
        while len(content) - start >= HEADER.size:
            kind, sensor, port, source_port, size, due_ns = HEADER.unpack_from(content, start)
            stop = start + HEADER.size + size
            if stop > len(content):
                break
            body = content[start + HEADER.size : stop]
            start = stop
            if kind == DATAGRAM:
                self._count += 1
                record = due_ns, self._count, sensor, port, source_port, body
                heapq.heappush(self.waiting, record)
                self.waiting_bytes += size
            elif kind == ROUTE:
                self.routes.setdefault(sensor, Route()).change(json.loads(body))
            else:
                self.ended = True
        self._rest = content[start:]

    def next_ns(self) -> int | None:
        """Return the time for sending the next datagram, or None if none is pending."""
        if not self.waiting:
            return None
        due_ns, _, sensor, *_ = self.waiting[0]
        return self.routes[sensor].earliest_ns(due_ns)

    def send_next(self) -> None:
        """Send the next datagram."""
        due_ns, _, sensor, port, source_port, body = heapq.heappop(self.waiting)
        self.waiting_bytes -= len(body)
        route = self.routes[sensor]
        late_ns = route.mark_sent(due_ns)
        to_port = route.ports.get(port, port)
        if not to_port:
            return
        try:
            route.open_from(source_port).sendto(body, (route.host, to_port))
        except OSError as error:
            reason = os.strerror(error.errno or 0)
            if reason not in self._failures:
                report({"failure": reason, "to": f"{route.host}:{to_port}"})
            self._failures[reason] = self._failures.get(reason, 0) + 1
            return
        self._sent += 1
        self._max_late_ns = max(self._max_late_ns, late_ns)
        late_ms = late_ns / 1e6
        self._late[bisect_left(BINS_MS, late_ms)] += 1

    def summary(self) -> dict[str, Any]:
        """Return the statistics as JSON-serializable data."""
        return {
            "sent": self._sent,
            "lateness_ms": [*BINS_MS],
            "counts": self._late,
            "latest_ms": self._max_late_ns / 1e6,
            "failures": self._failures,
        }


def report(values: dict[str, Any]) -> None:
    """Write values to standard output as a line of JSON, for the ray-casting process.

    Write errors are ignored, because that process may have exited.
    """
    with suppress(OSError):
        os.write(1, json.dumps(values).encode() + b"\n")


def raise_priority() -> None:
    """Raise the priority of this mostly idle process, if permitted, so that it sends on time.

    With ten busy processes on two cores, 0.02 % of the datagrams were more than 5 ms late with
    real-time scheduling, 4 % with a niceness of -10, and 13 % without either.
    """
    try:
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))
    except (OSError, AttributeError):  # not permitted, or not on Linux
        with suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, 0, _NICENESS)


def serve(queue: SendQueue) -> None:
    """Send datagrams at their due times until END is received and all are sent."""
    while not queue.ended or queue.waiting:
        next_ns = queue.next_ns()
        wait_s = None if next_ns is None else max(0.0, (next_ns - time.monotonic_ns()) / 1e9)
        is_full = queue.ended or queue.waiting_bytes > _MAX_WAITING_BYTES
        readable, _, _ = select.select([] if is_full else [0], [], [], wait_s)
        if next_ns is not None and time.monotonic_ns() >= next_ns:
            queue.send_next()
        elif readable:
            content = os.read(0, _READ_BYTES)
            if not content:
                sys.exit(1)
            queue.parse_records(content)


def main() -> None:
    """Send datagrams until END, SIGTERM or the end of stdin. Report at the start and the end."""

    def stop(number: int, frame: object) -> NoReturn:
        raise Stop

    signal.signal(signal.SIGTERM, stop)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    raise_priority()
    queue = SendQueue()
    report({"ready": True})
    with suppress(Stop):
        serve(queue)
    report(queue.summary())


if __name__ == "__main__":
    main()

"""Process that counts datagrams and their delays for `benchmarks.live`.

The process runs until stdin ends, then prints a line of JSON. A datagram's delay is its arrival
time minus its timestamp, relative to the minimum of this difference over all datagrams.
"""

from __future__ import annotations

import json
import select
import socket
import struct
import sys
import time
from contextlib import suppress

BUFFER_BYTES = 32 << 20
SILENT_S = 0.5  # after the end
_BUFFER_FORCED = 33  # SO_RCVBUFFORCE, for which a process needs rights
HOUR_NS = 3_600_000_000_000


def velodyne_ns(payload: bytes) -> int:
    """Return the timestamp of a Velodyne data packet in nanoseconds past the hour."""
    return 1000 * int(struct.unpack_from("<I", payload, 1200)[0])


def ouster_ns(payload: bytes) -> int:
    """Return the timestamp of an Ouster packet's first column in nanoseconds past an hour."""
    return int(struct.unpack_from("<Q", payload, 32)[0]) % HOUR_NS


STAMPS = {"velodyne": velodyne_ns, "ouster": ouster_ns}


def open_socket(port: int) -> socket.socket:
    """Return a socket with a large buffer, bound to a port of the loopback interface."""
    opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER_BYTES)
    with suppress(OSError):
        opened.setsockopt(socket.SOL_SOCKET, _BUFFER_FORCED, BUFFER_BYTES)
    opened.bind(("127.0.0.1", port))
    return opened


def main(maker: str, rate: str, *ports: str) -> None:
    """Receive on the given ports until stdin ends and no more datagrams arrive.

    The first port is that of the returns. Timestamps advance `rate` times as fast as the clock.
    """
    period_ns = HOUR_NS / float(rate)  # after which stamps repeat
    sockets = [open_socket(int(port)) for port in ports]
    stamp_ns = STAMPS[maker]
    offsets_ns = []
    received = 0
    sources: list[object] = [*sockets, sys.stdin]
    print("ready", flush=True)
    ended = False
    while True:
        readable, _, _ = select.select(sources, [], [], SILENT_S if ended else None)
        if ended and not readable:
            break
        for source in readable:
            if source is sys.stdin:
                ended = True
                sources.remove(sys.stdin)
                continue
            payload = source.recv(65_535)
            now_ns = time.monotonic_ns()
            received += 1
            if source is sockets[0]:
                offsets_ns.append((now_ns - stamp_ns(payload) / float(rate)) % period_ns)
    first_ns = offsets_ns[0] if offsets_ns else 0
    # The offsets are about equal, and may lie on both sides of the hour.
    offsets_ns = [
        (offset - first_ns + period_ns / 2) % period_ns - period_ns / 2 for offset in offsets_ns
    ]
    least_ns = min(offsets_ns, default=0)
    late_ms = sorted((offset - least_ns) / 1e6 for offset in offsets_ns)
    print(json.dumps({"received": received, "late_ms": late_ms}))


if __name__ == "__main__":
    main(*sys.argv[1:])

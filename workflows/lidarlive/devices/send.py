"""Send datagrams at their due times from a separate process, and check receiver addresses."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from ipaddress import AddressValueError, IPv4Address, IPv6Address
from pathlib import Path
from typing import IO, Any, Self

import numpy as np

from lidarsim.environment.ports import port_number
from lidarsim.errors import LidarError
from lidarsim.numerics.arrays import Bytes, Ints
from lidarsim.packets.encoders import Datagrams
from lidarsim.packets.service import Destination, is_single_receiver
from lidarsim.words import shorten_name

from .sender_process import DATAGRAM, END, HEADER, ROUTE

LOOPBACK = "127.0.0.1"
_SHOWN_LETTERS = 60  # number of characters of an invalid address that are shown
_RECORD = np.dtype(
    [
        ("kind", "<u2"),
        ("sensor", "<u2"),
        ("port", "<u2"),
        ("source_port", "<u2"),
        ("size", "<u4"),
        ("due_ns", "<i8"),
    ]
)
_ENDS_WITHIN_S = 2.0  # time limit for the process to exit after SIGTERM


@dataclass(frozen=True)
class Lateness:
    """Number of datagrams that were sent, and a histogram of how late they were."""

    sent: int = 0
    limits_ms: tuple[float, ...] = ()  # upper limits of the bins
    counts: tuple[int, ...] = ()  # number of datagrams in each bin, and beyond the last bin
    latest_ms: float = 0.0
    failures: Mapping[str, int] = field(default_factory=dict)  # {error: number of datagrams}

    def share_within(self, limit_ms: float) -> float:
        """Return the fraction of datagrams that were at most `limit_ms` late.

        `limit_ms` is one of the bin limits.
        """
        stop = self.limits_ms.index(limit_ms) + 1
        return sum(self.counts[:stop]) / max(1, self.sent)

    def to_json(self) -> dict[str, Any]:
        """Return the values as JSON-serializable data."""
        bins = {f"<= {limit:g} ms": count for limit, count in zip(self.limits_ms, self.counts)}  # noqa: B905 - counts are one more
        bins["later"] = self.counts[-1] if self.counts else 0
        return {
            "sent": self.sent,
            "lateness": bins,
            "latest_ms": self.latest_ms,
            "not_sent": dict(self.failures),
        }

    def __str__(self) -> str:
        if not self.limits_ms:
            return "the sender process ended before it reported statistics"
        words = f"{self.sent:,} packets sent"
        if self.sent:
            words += (
                f", {100 * self.share_within(5):.2f} % of them within 5 ms of their scheduled "
                f"time, with a maximum delay of {self.latest_ms:.1f} ms"
            )
        for reason, count in self.failures.items():
            words += f"; {count:,} not sent: {reason}"
        return words


class Sender:
    """Context manager that sends the datagrams of numbered sensors at their due times.

    The sender process ends with the context, or when the current process ends for any reason.

    Parameters
    ----------
    note
        Function that shows a message to the user.
    """

    def __init__(self, note: Callable[[str], None] = lambda words: None) -> None:
        self._note = note
        self._process: subprocess.Popen[bytes] | None = None
        self._lock = threading.Lock()  # because services redirect from separate threads
        self._reported = b""  # beginning of a line that has not completely arrived
        self._lateness = Lateness()

    def __enter__(self) -> Self:
        script = Path(__file__).with_name("sender_process.py")
        self._process = subprocess.Popen(
            [sys.executable, "-I", "-S", str(script)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,  # so that Ctrl-C in a terminal does not end it too early
        )
        assert self._process.stdout is not None
        os.read(self._process.stdout.fileno(), 1 << 16)  # wait until it is ready, about 0.1 s
        os.set_blocking(self._process.stdout.fileno(), False)
        return self

    def __exit__(self, *error: object) -> None:
        process = self._process
        assert process is not None
        if process.poll() is None:
            process.terminate()
        self._wait()
        self._process = None

    def redirect(self, sensor: int, destination: Destination, source: str = "") -> None:
        """Send all further datagrams of a sensor to a new destination.

        `source` is the address of this machine to send from, or empty for any address.
        """
        values = {"host": destination.host, "ports": destination.ports, "source": source}
        body = json.dumps(values).encode()
        self._write(HEADER.pack(ROUTE, sensor, 0, 0, len(body), 0) + body)

    def send(
        self, sensor: int, groups: Sequence[Datagrams], deadlines_ns: Callable[[Ints], Ints]
    ) -> None:
        """Pass datagrams to the sender process, which sends each at `deadlines_ns(due_ns)`.

        Deadlines are times of `time.monotonic_ns`. The call blocks while too many datagrams are
        pending. Raises LidarError if the process has ended.
        """
        groups = [group for group in groups if len(group)]
        self._hear()
        if groups:
            dues_ns = [deadlines_ns(group.due_ns) for group in groups]
            records = [
                _records(sensor, group, due_ns)
                for group, due_ns in zip(groups, dues_ns, strict=True)
            ]
            self._write(_in_order(records, np.concatenate(dues_ns)).data)

    def finish(self) -> Lateness:
        """Wait until all datagrams have been sent, and return how late they were."""
        self._write(HEADER.pack(END, 0, 0, 0, 0, 0))
        self._wait(None)
        return self._lateness

    @property
    def lateness(self) -> Lateness:
        """Lateness of the datagrams, which is known once the process has ended."""
        return self._lateness

    def _write(self, content: bytes | memoryview) -> None:
        """Write to the sender process. Raises LidarError if it has ended."""
        assert self._process is not None
        file = self._process.stdin
        assert file is not None
        try:
            with self._lock:
                file.write(content)
                file.flush()
        except (BrokenPipeError, ValueError) as error:
            raise LidarError(
                "The process that sends packets has stopped. Start the playback again."
            ) from error

    def _hear(self) -> None:
        """Read what the sender process has reported, without blocking."""
        assert self._process is not None
        file = self._process.stdout
        assert file is not None
        with suppress(BlockingIOError):
            while content := os.read(file.fileno(), 1 << 16):
                self._note_lines(content)

    def _note_lines(self, content: bytes) -> None:
        *lines, self._reported = (self._reported + content).split(b"\n")
        for line in lines:
            values = json.loads(line)
            if "failure" in values:
                self._note(f"packets cannot be sent to {values['to']}: {values['failure']}.")
                continue
            self._lateness = Lateness(
                values["sent"],
                tuple(values["lateness_ms"]),
                tuple(values["counts"]),
                values["latest_ms"],
                values["failures"],
            )

    def _wait(self, timeout_s: float | None = _ENDS_WITHIN_S) -> None:
        """Wait until the process ends. Kill it if this takes too long."""
        assert self._process is not None
        process = self._process
        if process.stdin is None or process.stdin.closed:
            return
        try:
            process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        self._hear()
        _close(process.stdin)
        _close(process.stdout)


def _close(file: IO[bytes] | None) -> None:
    """Close a pipe even if nothing reads its buffered bytes."""
    assert file is not None
    with suppress(BrokenPipeError):
        file.close()


def _records(sensor: int, group: Datagrams, due_ns: Ints) -> Bytes:
    """Return datagrams with their record headers, one datagram per row."""
    count, size = group.payloads.shape
    headers = np.zeros(count, _RECORD)
    headers["kind"] = DATAGRAM
    headers["sensor"] = sensor
    headers["port"] = group.port
    headers["source_port"] = group.source_port
    headers["size"] = size
    headers["due_ns"] = due_ns
    return np.concatenate([headers.view(np.uint8).reshape(count, -1), group.payloads], axis=1)


def _in_order(records: Sequence[Bytes], due_ns: Ints) -> Bytes:
    """Return the records of all groups as a flat array, sorted by time."""
    if len(records) == 1:
        return np.ascontiguousarray(records[0]).reshape(-1)
    sizes = np.concatenate([np.full(len(rows), rows.shape[1]) for rows in records])
    order = np.argsort(due_ns, kind="stable")
    ends = np.empty(len(order), np.int64)
    ends[order] = np.cumsum(sizes[order])
    content = np.empty(int(sizes.sum()), np.uint8)
    first = 0
    for rows in records:
        starts = ends[first : first + len(rows)] - rows.shape[1]
        content[starts[:, None] + np.arange(rows.shape[1])] = rows
        first = first + len(rows)
    return content


@dataclass(frozen=True)
class ReceiverAddress:
    """An IPv4 address that a user specifies as HOST or HOST:PORT."""

    host: str  # numeric address
    port: int | None = None
    name: str = field(default="", compare=False)  # host name as specified, if it is not numeric

    @classmethod
    def parse(cls, text: str) -> ReceiverAddress:
        """Parse the IPv4 address of a single receiver.

        Raises LidarError if the text is not such an address.
        """
        host, separator, number = text.rpartition(":")
        if not separator:
            host, number = text, ""
        if ":" in host or _is_ipv6(text):
            raise LidarError(
                f"{text} is an IPv6 address. Use an IPv4 address, such as {LOOPBACK}:2368."
            )
        port = port_number(number) if separator else None
        if separator and not port:
            shown = shorten_name(text, _SHOWN_LETTERS)
            raise LidarError(
                f"{shown!r} is not a valid address. Use HOST or HOST:PORT, with a port of at most "
                "65535."
            )
        name = ""
        try:
            address = IPv4Address(host)
        except AddressValueError:
            address = _resolved(host, text)
            name = host.lower()
        if not is_single_receiver(address):
            kind = (
                "a multicast address" if address.is_multicast else ("not the address of a receiver")
            )
            raise LidarError(f"{text} is {kind}. Use the address of a single receiver.")
        return cls(str(address), port, name)

    @property
    def is_loopback(self) -> bool:
        """Whether the address belongs to the loopback interface."""
        return IPv4Address(self.host).is_loopback

    def __str__(self) -> str:
        return self.host if self.port is None else f"{self.host}:{self.port}"


def _is_ipv6(text: str) -> bool:
    try:
        IPv6Address(text.strip("[]"))
    except AddressValueError:
        return False
    return True


def _resolved(host: str, text: str) -> IPv4Address:
    """Resolve a host name to an IPv4 address.

    Raises LidarError if there is none.
    """
    try:
        entries = socket.getaddrinfo(host, None, socket.AF_INET, socket.SOCK_DGRAM)
    except (OSError, UnicodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not a valid host name"
        raise LidarError(f"{text}: the host {host!r} has no IPv4 address ({reason}).") from error
    return IPv4Address(entries[0][4][0])


def check_reachable(address: ReceiverAddress) -> None:
    """Raise LidarError if no datagrams can be sent to an address, for example without a network."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect((address.host, address.port or 9))
        except OSError as error:
            raise LidarError(
                f"{address} cannot be reached from this machine: {error.strerror}."
            ) from error

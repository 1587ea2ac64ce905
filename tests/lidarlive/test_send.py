"""Datagrams leave at their times, from a process that never outlives the sensor."""

from __future__ import annotations

import os
import select
import signal
import socket
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from lidarlive.devices import sender_process
from lidarlive.devices.send import ReceiverAddress, Sender, check_reachable
from lidarsim import LidarError
from lidarsim.packets.encoders import Datagrams
from lidarsim.packets.service import Destination


@pytest.fixture
def receiver():
    """A socket on the loopback interface."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as opened:
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
        opened.bind(("127.0.0.1", 0))
        opened.settimeout(60)
        yield opened


def numbered(count, first_ns, step_ns, port=2368, size=8):
    """Return datagrams that hold their numbers, and their times from now."""
    payloads = np.zeros((count, size), np.uint8)
    payloads[:, 0] = np.arange(count)
    return Datagrams(payloads, first_ns + step_ns * np.arange(count), port)


def to(receiver, *ports):
    number = receiver.getsockname()[1]
    return Destination("127.0.0.1", dict.fromkeys(ports or (2368,), number))


def test_datagrams_of_several_ports_leave_in_the_order_of_their_times(receiver):
    with Sender() as sender:
        sender.redirect(0, to(receiver, 2368, 8308))
        data = numbered(5, 300_000_000, 20_000_000)
        position = numbered(1, 350_000_000, 0, port=8308, size=3)
        begin = time.monotonic_ns()
        sender.send(0, [data, position], lambda times_ns: times_ns + begin)
        arrivals = [(receiver.recv(100), time.monotonic_ns() - begin) for _ in range(6)]
        lateness = sender.finish()
    assert [(len(content), content[0]) for content, _ in arrivals] == [
        (8, 0), (8, 1), (8, 2), (3, 0), (8, 3), (8, 4)
    ]  # fmt: skip
    due_ns = np.array([300, 320, 340, 350, 360, 380]) * 1_000_000
    assert (np.array([arrived for _, arrived in arrivals]) >= due_ns).all()
    assert lateness.sent == 6
    assert sum(lateness.counts) == 6
    assert lateness.failures == {}


def test_late_datagrams_keep_half_of_their_distances(receiver):
    with Sender() as sender:
        sender.redirect(0, to(receiver))
        begin = time.monotonic_ns() - 1_000_000_000
        sender.send(0, [numbered(11, 0, 20_000_000)], lambda times_ns: times_ns + begin)
        arrivals = []
        for _ in range(11):
            receiver.recv(100)
            arrivals.append(time.monotonic_ns())
        lateness = sender.finish()
    assert arrivals[-1] - arrivals[0] >= 95_000_000  # 200 ms at twice the speed
    assert lateness.share_within(500) == 0
    assert lateness.latest_ms > 900


def test_what_a_service_redirects_goes_elsewhere(receiver):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other, Sender() as sender:
        other.bind(("127.0.0.2", 0))
        other.settimeout(60)
        sender.redirect(0, to(receiver), "127.0.0.1")
        begin = time.monotonic_ns()
        sender.send(0, [numbered(1, 0, 0)], lambda times_ns: times_ns + begin)
        _, address = receiver.recvfrom(100)
        assert address[0] == "127.0.0.1"
        port = other.getsockname()[1]
        sender.redirect(0, Destination("127.0.0.2", {2368: port, 8308: 0}), "127.0.0.3")
        groups = [numbered(2, 0, 0, port=8308), numbered(1, 1, 0)]
        sender.send(0, groups, lambda times_ns: times_ns + begin)
        _, address = other.recvfrom(100)
        assert address[0] == "127.0.0.3"
        assert sender.finish().sent == 2  # none to port 0


def test_what_cannot_be_sent_is_noted_once_and_counted(receiver):
    notes = []
    with Sender(notes.append) as sender:
        sender.redirect(0, to(receiver))
        begin = time.monotonic_ns()
        too_large = numbered(3, 0, 0, size=65_520)
        sender.send(0, [too_large, numbered(2, 0, 0)], lambda times_ns: times_ns + begin)
        lateness = sender.finish()
    assert lateness.sent == 2
    assert lateness.failures == {"Message too long": 3}
    assert len(notes) == 1
    assert "packets cannot be sent to" in notes[0]
    assert "3 not sent: Message too long" in str(lateness)


def test_a_killed_process_is_an_error_of_a_line():
    with Sender() as sender:
        pid = sender._process.pid
        os.kill(pid, signal.SIGKILL)
        sender._process.wait()
        with pytest.raises(LidarError, match="that sends packets has stopped"):
            sender.send(0, [numbered(9, 0, 0, size=60_000)], lambda times_ns: times_ns)


def test_leaving_the_context_ends_the_process_and_says_what_was_sent(receiver):
    with Sender() as sender:
        sender.redirect(0, to(receiver))
        begin = time.monotonic_ns()
        sender.send(0, [numbered(1, 0, 0), numbered(9, 60_000_000_000, 0)], lambda t: t + begin)
        receiver.recv(100)
        process = sender._process
    assert process.poll() is not None
    assert sender.lateness.sent == 1


@pytest.mark.slow(keep=("9",))
@pytest.mark.parametrize("number", (signal.SIGKILL, signal.SIGHUP))
def test_the_process_ends_with_its_parent(number):
    code = """
import time, numpy as np
from lidarsim.packets.encoders import Datagrams
from lidarlive.devices.send import Sender
from lidarsim.packets.service import Destination
with Sender() as sender:
    sender.redirect(0, Destination("127.0.0.1"))
    due = np.full(5, time.monotonic_ns() + 600_000_000_000)
    sender.send(0, [Datagrams(np.zeros((5, 9), np.uint8), due, 9)], lambda times: times)
    print(sender._process.pid, flush=True)
    time.sleep(60)
"""
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE) as parent:
        pid = int(parent.stdout.readline())
        parent.send_signal(number)
        parent.wait()
    stop = time.monotonic() + 10
    while _is_running(pid):
        assert time.monotonic() < stop
        time.sleep(0.01)


def _is_running(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().split(") ")[1][0] != "Z"
    except FileNotFoundError:
        return False


@pytest.mark.extended
def test_the_process_stops_reading_when_many_bytes_wait():
    """So that a producer that is ahead of time waits, and memory is bounded."""
    body = bytes(1 << 20)
    due_ns = time.monotonic_ns() + 3600 * 10**9
    route = b'{"host": "127.0.0.1", "ports": {}, "source": ""}'
    record = sender_process.HEADER.pack(sender_process.DATAGRAM, 0, 1, 0, len(body), due_ns) + body
    command = [sys.executable, sender_process.__file__]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL) as process:
        header = sender_process.HEADER.pack(sender_process.ROUTE, 0, 0, 0, len(route), 0)
        process.stdin.write(header + route)
        process.stdin.flush()
        os.set_blocking(process.stdin.fileno(), False)
        written = 0
        while written < 300 << 20 and select.select([], [process.stdin], [], 2)[1]:
            with suppress(BlockingIOError):
                written += os.write(process.stdin.fileno(), record[written % len(record) :])
        process.kill()
    assert 256 << 20 <= written < 258 << 20


def test_the_process_imports_nothing_that_takes_time_to_start():
    script = Path(sender_process.__file__)
    code = f"import runpy, sys; runpy.run_path({str(script)!r}); print(*sys.modules)"
    output = subprocess.run(
        [sys.executable, "-I", "-S", "-c", code], capture_output=True, text=True, check=True
    )
    assert not {"numpy", "lidarsim", "asyncio", "multiprocessing"} & {*output.stdout.split()}


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("::1", "Use an IPv4 address"),
        ("[::1]:2368", "an IPv6"),
        ("239.1.2.3:2368", "a multicast address"),
        ("0.0.0.0", "not the address of a receiver"),
        ("127.0.0.1:0", "Use HOST or HOST:PORT"),
        ("127.0.0.1:70000", "Use HOST or HOST:PORT"),
        ("127.0.0.1:x", "Use HOST or HOST:PORT"),
        ("127.0.0.1:" + "9" * 5000, "Use HOST or HOST:PORT"),
        ("127.0.0.1:\u0662", "Use HOST or HOST:PORT"),
        ("255.255.255.255:2368", "not the address of a receiver"),
        ("127.255.255.255", "not the address of a receiver"),
        ("no-such-host.invalid", "has no IPv4 address"),
        ("", "has no IPv4 address"),
        ("a" * 70 + ".b", "has no IPv4 address"),
    ],
)
def test_an_address_that_packets_cannot_go_to_is_refused_in_a_line(text, words):
    with pytest.raises(LidarError, match=words) as raised:
        ReceiverAddress.parse(text)
    assert "\n" not in str(raised.value)
    assert len(str(raised.value)) < 250


def test_addresses_are_parsed():
    assert ReceiverAddress.parse("127.0.0.1") == ReceiverAddress("127.0.0.1")
    assert str(ReceiverAddress.parse("localhost:2370")) == "127.0.0.1:2370"


def test_an_unreachable_address_is_refused(monkeypatch):
    def refuse(self, address):
        raise OSError(101, "Network is unreachable")

    monkeypatch.setattr(socket.socket, "connect", refuse)
    with pytest.raises(LidarError, match="cannot be reached from this machine: Network is unreach"):
        check_reachable(ReceiverAddress("10.1.2.3", 2368))

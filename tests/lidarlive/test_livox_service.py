"""The command interface of a live Livox, asked as Livox-SDK2 asks."""

from __future__ import annotations

import os
import socket
import struct
import time
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest
from tests.lidarfiles.test_livox_packets import header_of, plain_crc, synthetic_shots

from lidarlive.devices.send import Sender
from lidarlive.devices.services import service_of
from lidarlive.playback.transmitter import sensor_streams
from lidarsim import LidarError, load_sensor
from lidarsim.packets.encoders import PacketSource, encoder_of
from lidarsim.packets.service import Destination

# Livox's ports are fixed: processes that test at the same time have addresses of their own.
_OF_PROCESS = f"{os.getpid() // 250 % 250}.{os.getpid() % 250 + 1}"
SENSOR = f"127.1.{_OF_PROCESS}"
HOST = f"127.2.{_OF_PROCESS}"
SEARCH, SET, GET, PUSH, REBOOT = 0x0000, 0x0100, 0x0101, 0x0102, 0x0200
HEAD = "<BBHIHBB6s"


def plain_crc16(data: bytes) -> int:
    """CRC-16/CCITT-FALSE bit by bit, as in Livox's protocol."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte << 8
        for _ in range(8):
            crc = (crc << 1 ^ (0x1021 if crc & 0x8000 else 0)) & 0xFFFF
    return crc


def frame(command, data=b"", number=7, kind=0):
    head = struct.pack(HEAD, 0xAA, 0, 24 + len(data), number, command, kind, 0, b"")
    return head + struct.pack("<HI", plain_crc16(head), plain_crc(data) if data else 0) + data


def parsed(content):
    """Return command, number, type and data of a frame after checks of its checksums."""
    start, version, length, number, command, kind, sender, _ = struct.unpack_from(HEAD, content)
    assert (start, version, length, sender) == (0xAA, 0, len(content), 1)
    head_checksum, data_checksum = struct.unpack_from("<HI", content, 18)
    data = content[24:]
    assert head_checksum == plain_crc16(content[:18])
    assert data_checksum == (plain_crc(data) if data else 0)
    return command, number, kind, data


def values_of(data):
    """Return {key: value} of a list of keys and values."""
    values = {}
    while data:
        key, length = struct.unpack_from("<HH", data)
        values[key] = data[4 : 4 + length]
        data = data[4 + length :]
    return values


def setting(values):
    entries = b"".join(struct.pack("<HH", key, len(value)) + value for key, value in values.items())
    return frame(SET, struct.pack("<HH", len(values), 0) + entries)


def getting(keys):
    return frame(GET, struct.pack("<HH", len(keys), 0) + struct.pack(f"<{len(keys)}H", *keys))


def host(address, port, sensor_port=0):
    return socket.inet_aton(address) + struct.pack("<HH", port, sensor_port)


class Live:
    """A live sensor, and a client on the same machine."""

    def __init__(self, encoder):
        self.encoder = encoder
        self.destinations = []
        self.client = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.client.bind(("127.0.0.1", 0))
        self.client.settimeout(60)
        self.port = 56_100

    def ask(self, content, port=None):
        self.client.sendto(content, (SENSOR, port or self.port))
        return parsed(self.client.recv(2000))

    def set(self, values):
        """Set parameters; return the return code and the wrong key."""
        command, _, kind, data = self.ask(setting(values))
        assert (command, kind) == (SET, 1)
        return struct.unpack("<BH", data)

    def get(self, *keys):
        _, _, _, data = self.ask(getting(keys))
        assert struct.unpack_from("<BH", data)[0] == 0
        return values_of(data[3:])


@contextmanager
def live(model="mid360", **options):
    source = PacketSource(load_sensor(f"livox/{model}"), "strongest", "roof", **options)
    sensor = Live(encoder_of(source))
    sensor.port = 56_100 if model == "mid360" else 56_000
    destination = Destination(HOST, {56_301: 56_301, 56_401: 56_401})
    with (
        sensor.client,
        service_of(sensor.encoder, SENSOR, destination, sensor.destinations.append) as service,
    ):
        sensor.service = service
        yield sensor


@pytest.mark.parametrize(
    ("model", "device_type", "port"), [("mid360", 9, 56_100), ("hap", 10, 56_000)]
)
def test_a_search_is_answered(model, device_type, port):
    with live(model) as sensor:
        command, number, kind, data = sensor.ask(frame(SEARCH, number=91), 56_000)
    assert (command, number, kind) == (SEARCH, 91, 1)
    code, found_type, serial, address, command_port = struct.unpack("<BB16s4sH", data)
    assert (code, found_type, command_port) == (0, device_type, port)
    assert address == socket.inet_aton(SENSOR)
    assert serial.startswith(b"LIDARPOOL") and serial.endswith(b"\0")


def test_the_host_is_told_of_the_sensor_and_its_state():
    """Broadcasts of the host do not reach a sensor on the same machine."""
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as search,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as states,
    ):
        for receiver, port in ((search, 56_000), (states, 56_201)):
            receiver.bind((HOST, port))
            receiver.settimeout(60)
        with live():
            content, peer = search.recvfrom(2000)
            assert peer == (SENSOR, 56_000)
            command, _, kind, data = parsed(content)
            assert (command, kind, data[:2]) == (SEARCH, 1, b"\0\x09")
            content, peer = states.recvfrom(2000)
    command, _, kind, data = parsed(content)
    assert (command, kind, peer) == (PUSH, 0, (SENSOR, 56_200))
    count, _ = struct.unpack_from("<HH", data)
    values = values_of(data[4:])
    assert len(values) == count > 20
    assert values[0x8000].rstrip(b"\0").startswith(b"LIDARPOOL")
    assert values[0x8001].startswith(b"Livox Mid-360")


def test_parameters_of_the_start_are_told():
    with live(dated=True) as sensor:
        values = sensor.get(0x8010, 0x0006, 0x0007, 0x0000, 0x001A, 0x8006, 0x800C, 0x7777)
    assert list(values) == [0x8010, 0x0006, 0x0007, 0x0000, 0x001A, 0x8006, 0x800C]
    assert values[0x8010] == values[0x0000] == values[0x001A] == values[0x8006] == b"\1"
    assert values[0x800C] == b"\1"
    assert values[0x0006] == host(HOST, 56_301, 56_300)
    assert values[0x0007] == host(HOST, 56_401, 56_400)


def test_the_host_sets_where_points_and_samples_go():
    with live() as sensor:
        answer = sensor.set(
            {0x0005: host("127.0.0.5", 1, 2), 0x0006: host("127.0.0.9", 5000, 56_300),
             0x0007: host("127.0.0.9", 5001, 56_400)}
        )  # fmt: skip
        assert answer == (0, 0)
        assert sensor.set({0x001C: b"\0"}) == (0, 0)  # no samples
        assert sensor.set({0x001A: b"\2"}) == (0, 0)  # idle
        assert sensor.get(0x8006) == {0x8006: b"\2"}
        assert sensor.set({0x001A: b"\1", 0x001C: b"\1"}) == (0, 0)
    ports = [(d.host, d.ports[56_301], d.ports[56_401]) for d in sensor.destinations]
    assert ports == [
        ("127.0.0.9", 5000, 5001), ("127.0.0.9", 5000, 0), ("127.0.0.9", 0, 0),
        ("127.0.0.9", 5000, 5001),
    ]  # fmt: skip


def test_the_host_sets_the_type_of_the_points():
    shots = synthetic_shots("mid360")[1]
    with live() as sensor:
        (before,) = sensor.encoder.encode(shots)
        assert sensor.set({0x0000: b"\2"}) == (0, 0)
        assert sensor.get(0x0000) == {0x0000: b"\2"}
        (after,) = sensor.encoder.encode(
            replace(shots, firings=shots.firings + 60, starts_ns=shots.starts_ns + 1_200_000)
        )
    kinds = [header_of(group.payloads[0].tobytes()).data_type for group in (before, after)]
    assert kinds == [1, 2] and after.payloads.shape[1] == 36 + 96 * 8


@pytest.mark.parametrize(
    ("values", "answer"),
    [
        ({0x0000: b"\3"}, (0x03, 0x0000)),  # spherical coordinates
        ({0x001A: b"\4"}, (0x03, 0x001A)),
        ({0x0000: b"\1\1"}, (0x23, 0x0000)),
        ({0x8000: b"another serial 1"}, (0x22, 0x8000)),
        ({0x0021: b"\1"}, (0x20, 0x0021)),
        ({0x0006: host("224.1.1.5", 56_301)}, (0x03, 0x0006)),
        ({0x0006: host("127.255.255.255", 56_301)}, (0x03, 0x0006)),
        ({0x0007: host("255.255.255.255", 56_401)}, (0x03, 0x0007)),
        ({0x0005: host("0.0.0.0", 56_201)}, (0x03, 0x0005)),
        ({0x0012: bytes(24), 0x0004: bytes(12)}, (0x22, 0x0004)),
    ],
)
def test_parameters_that_cannot_be_set_are_refused(values, answer):
    with live() as sensor:
        before = sensor.get(*range(0x20))
        assert sensor.set(values | {0x0001: b"\1"}) == answer
        assert sensor.get(*range(0x20)) == before
    assert not sensor.destinations


def test_other_commands_have_return_codes():
    with live() as sensor:
        assert sensor.ask(frame(REBOOT, struct.pack("<H", 100)))[3] == b"\0"
        assert sensor.ask(frame(0x0400, bytes(7)))[3] == b"\x20"


def broken_frames():
    """Frames that are wrong in one thing each."""
    right = getting([0x0000])
    wrong_start = b"\xab" + right[1:]
    wrong_data = right[:-1] + b"\1"
    answers = frame(GET, struct.pack("<HHH", 1, 0, 0), kind=1)
    longer = struct.pack(HEAD, 0xAA, 0, 2000, 7, GET, 0, 0, b"")
    longer += struct.pack("<HI", plain_crc16(longer), 0)
    shorter = struct.pack(HEAD, 0xAA, 0, 3, 7, GET, 0, 0, b"")
    shorter += struct.pack("<HI", plain_crc16(shorter), 0)
    return [b"", b"\xaa", right[:-1], wrong_start, wrong_data, answers, longer, shorter]


@pytest.mark.parametrize("seed", [0, 1])
def test_a_peer_that_sends_nonsense_does_not_stop_the_sensor(seed):
    rng = np.random.default_rng(seed)
    with live() as sensor:
        for content in broken_frames():
            sensor.client.sendto(content, (SENSOR, 56_100))
        for size in rng.integers(0, 3000, 20):
            sensor.client.sendto(rng.bytes(size), (SENSOR, 56_000))
        # Right frames whose contents are cut off, or state more than there is.
        for command in (SET, GET, SEARCH, REBOOT):
            for data in (b"", b"\xff", b"\xff\xff\0\0", b"\1\0\0\0\6\0\x08\0\1", rng.bytes(40)):
                sensor.client.sendto(frame(command, data, number=1), (SENSOR, 56_100))
        sensor.client.sendto(getting([0x8010]), (SENSOR, 56_100))
        while (answer := parsed(sensor.client.recv(2000)))[1] != 7:
            pass
    assert values_of(answer[3][3:]) == {0x8010: b"\1"}
    assert not sensor.destinations


def test_a_flood_is_answered_in_part():
    with live() as sensor:
        start_s = time.process_time()
        for _ in range(2000):
            sensor.client.sendto(frame(SEARCH), (SENSOR, 56_100))
        sensor.client.settimeout(0.3)
        answers = 0
        with pytest.raises(TimeoutError):
            while True:
                sensor.client.recv(2000)
                answers += 1
        assert 0 < answers < 1000 and time.process_time() - start_s < 2
        sensor.client.settimeout(60)
        # A second later the sensor answers again; what the flood left in its buffer comes first.
        assert sensor.ask(frame(SEARCH))[0] == SEARCH


def test_addresses_that_cannot_be_had_are_refused():
    with live() as sensor:
        again = service_of(sensor.encoder, SENSOR, Destination("127.0.0.1"), print)
        with pytest.raises(LidarError, match=r":56000: .*Use a different address") as taken, again:
            pass
    assert len(str(taken.value).splitlines()) == 1
    service = service_of(sensor.encoder, f"{SENSOR}:8080", Destination("127.0.0.1"), print)
    with pytest.raises(LidarError, match="an address without a port"), service:
        pass


def test_sensors_have_addresses_that_are_not_the_hosts():
    """The SDK ignores datagrams from its own address, 127.0.0.1."""
    names = ("livox/mid360", "velodyne/vlp16", "livox/hap")
    encoders = [encoder_of(PacketSource(load_sensor(name), "strongest", name)) for name in names]
    streams = sensor_streams(encoders, (), ())
    assert [str(stream.address) for stream in streams] == ["127.0.0.2", "127.0.0.2", "127.0.0.4"]
    assert [stream.ports for stream in streams[::2]] == [[56_301, 56_401], [57_000, 58_000]]


def test_the_port_of_the_points_is_the_sensors():
    """The SDK knows points by the port that they come from."""
    shots = synthetic_shots("mid360")[1]
    (group,) = encoder_of(PacketSource(load_sensor("mid360"), "strongest")).encode(shots)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver, Sender() as sender:
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(60)
        port = receiver.getsockname()[1]
        sender.redirect(0, Destination("127.0.0.1", {56_301: port}), SENSOR)
        sender.send(0, [group], lambda due_ns: due_ns * 0)
        content, peer = receiver.recvfrom(2000)
        sender.finish()
    assert peer == (SENSOR, 56_300) and content == group.payloads[0].tobytes()

"""Commands of a live Hesai, as the maker's SDK and nebula send them."""

from __future__ import annotations

import contextlib
import socket
import struct

import pytest

from lidarlive.devices.services import service_of
from lidarsim import LidarError, load_sensor
from lidarsim.packets.encoders import PacketSource, encoder_of
from lidarsim.packets.service import Destination

UNSUPPORTED = 5
INVALID = 1


@contextlib.contextmanager
def serving(model="xt32", mode="dual", redirected=None):
    """Serve a sensor at a free port; yield encoder and port."""
    encoder = encoder_of(PacketSource(load_sensor(f"hesai/{model}"), mode, "roof"))
    destination = Destination("127.0.0.1", {2368: 40_000})
    send_to = (redirected if redirected is not None else []).append
    with service_of(encoder, "127.0.0.1:0", destination, send_to) as service:
        yield encoder, int(service.description.rpartition(":")[2])


def connect(port):
    connection = socket.create_connection(("127.0.0.1", port), timeout=5)
    return connection, connection.makefile("rb")


def ask(connection, command, parameter=b""):
    """Send a command; return code and content of the answer."""
    sender, reader = connection
    sender.sendall(
        b"\x47\x74" + bytes([command, 0]) + struct.pack(">I", len(parameter)) + parameter
    )
    head = reader.read(8)
    assert head[:3] == b"\x47\x74" + bytes([command])
    return head[3], reader.read(struct.unpack(">I", head[4:])[0])


def close(connection):
    connection[1].close()
    connection[0].close()


@pytest.fixture
def asked():
    """Return a function that sends a command over a new connection."""
    with contextlib.ExitStack() as stack:

        def send(port, command, parameter=b""):
            connection = connect(port)
            stack.callback(close, connection)
            return ask(connection, command, parameter)

        yield send


def test_calibration_and_firing_times_are_the_files_beside_packets(asked):
    with serving() as (encoder, port):
        connection = connect(port)
        files = encoder.files()
        assert ask(connection, 0x05) == (0, files[".angles.csv"])
        assert ask(connection, 0xA9) == (0, files[".firetimes.csv"])
        close(connection)


@pytest.mark.parametrize(
    ("model", "code", "size"), [("xt32", 25, 120), ("pandar40p", 0, 120), ("ot128", 42, 162)]
)
def test_inventory_names_the_model(asked, model, code, size):
    with serving(model) as (_, port):
        status, content = asked(port, 0x07)
    assert (status, len(content)) == (0, size)
    assert content[:3] == b"SIM" and content[106] == code
    serial = int(content[3:13])
    assert content[34:40] == b"\2" + serial.to_bytes(5, "big"), "a MAC address of its own"
    assert content[108] == {"xt32": 32, "pandar40p": 40, "ot128": 128}[model]


def test_settings_are_those_of_the_survey(asked):
    with serving() as (_, port):
        status, config = asked(port, 0x08)
        assert (status, len(config)) == (0, 47)
        assert config[:4] == config[12:16] == bytes([127, 0, 0, 1])
        assert struct.unpack(">HHH", config[16:22]) == (40_000, 10_110, 600)
        assert config[32] == 2  # dual
        status, content = asked(port, 0x09)
        assert (status, len(content)) == (0, 54) and struct.unpack(">H", content[4:6]) == (600,)
        assert asked(port, 0x17, struct.pack(">H", 600)) == (0, b"")
        assert asked(port, 0x17, struct.pack(">H", 1200)) == (INVALID, b"")
        assert asked(port, 0x1E, b"\2") == (0, b"") and asked(port, 0x1E, b"\0") == (INVALID, b"")


def test_datagrams_go_where_a_command_says(asked):
    redirected = []
    with serving(redirected=redirected) as (_, port):
        parameter = bytes([127, 0, 0, 1]) + struct.pack(">HH", 41_000, 10_110)
        assert asked(port, 0x20, parameter) == (0, b"")
        assert redirected == [Destination("127.0.0.1", {2368: 41_000})]
        assert struct.unpack(">H", asked(port, 0x08)[1][16:18]) == (41_000,)
        several = [[239, 0, 0, 1], [255] * 4, [127, 255, 255, 255]]
        addresses = [bytes(address) + parameter[4:] for address in several]
        for wrong in (b"", parameter[:7], bytes(8), *addresses):
            assert asked(port, 0x20, wrong) == (INVALID, b"")
    assert len(redirected) == 1


def test_peers_that_send_other_bytes_do_not_stop_the_service(asked):
    with serving() as (_, port):
        assert asked(port, 0x10) == (UNSUPPORTED, b"")  # reboot
        silent = [connect(port) for _ in range(40)]
        for content in (b"GET / HTTP/1.1\r\n\r\n", b"\x47\x74\5\0\xff\xff\xff\xff", bytes(999)):
            connection = connect(port)
            connection[0].sendall(content)
            with contextlib.suppress(ConnectionResetError):
                assert connection[1].read() == b""  # closed
            close(connection)
        half = connect(port)
        half[0].sendall(b"\x47\x74\5")
        assert asked(port, 0x05)[0] == 0
        for connection in [*silent, half]:
            close(connection)


def test_an_address_in_use_is_refused_and_a_default_port_replaced():
    with serving() as (encoder, port):
        service = service_of(encoder, f"127.0.0.1:{port}", Destination("127.0.0.1", {}), print)
        with pytest.raises(LidarError, match=f"cannot listen at 127.0.0.1:{port} .*--api"):
            service.__enter__()
        with contextlib.ExitStack() as stack:
            services = [
                stack.enter_context(
                    service_of(encoder, "127.0.0.1", Destination("127.0.0.1"), print)
                )
                for _ in range(2)
            ]
            ports = {service.description.rpartition(":")[2] for service in services}
            assert len(ports) == 2

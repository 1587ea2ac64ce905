"""Command interface of a live Livox sensor, with discovery, parameters and state messages.

Livox-SDK2 searches for sensors with broadcasts to port 56000. The broadcasts do not reach a sensor
on the same machine, and the SDK ignores datagrams from its own address. The simulated sensor
therefore has a separate address, such as 127.0.0.2, and announces itself to the host every second
as if the host had searched.
"""

from __future__ import annotations

import os
import selectors
import socket
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from ipaddress import AddressValueError, IPv4Address
from struct import Struct
from typing import Self

from lidarsim.errors import LidarError
from lidarsim.packets.service import Destination, Service, is_single_receiver

from .livox_commands import (
    MAX_FRAME_BYTES,
    Code,
    Command,
    CommandFrame,
    CommandRefusedError,
    Key,
    answer_frame,
    packed_count,
    packed_values,
    parse_keys,
    parse_request,
    parse_values,
    push_frame,
)

SEARCH_PORT = 56_000
_ANNOUNCE_S = 1.0  # same interval as the SDK's discovery broadcasts
_LOOKS_S = 0.1  # interval of checks whether the service should stop
_MAX_REQUESTS = 200  # per second; further requests are dropped so that a flood takes little time
_SEARCH_ANSWER = Struct("<BB16s4sH")
_SET_ANSWER = Struct("<BH")
_GET_ANSWER = Struct("<BH")
_HOST = Struct("<4sHH")  # host address, host port, sensor port
_SAMPLING = 1  # work mode
_WORK_MODES = (_SAMPLING, 2, 9)  # sampling, idle, ready
_APPLICATION = 1  # firmware type
_VERSION = bytes((1, 0, 0, 0))

# {parameter that can be set: length}. Parameters without effect on packets are only stored.
_LENGTHS: dict[int, int] = {
    Key.DATA_TYPE: 1,
    Key.PATTERN: 1,
    0x0002: 1,  # dual returns
    0x0003: 1,  # point sending enabled
    Key.STATE_HOST: 8,
    Key.POINTS_HOST: 8,
    Key.IMU_HOST: 8,
    0x0012: 24,  # installation attitude
    0x0013: 4,  # blind spot
    0x0015: 20,  # first and second field of view
    0x0016: 20,
    0x0017: 1,  # enabled fields of view
    0x0018: 1,  # detection mode
    0x0019: 4,  # pin configuration
    Key.WORK_MODE: 1,
    0x001B: 1,  # window heating
    Key.IMU_ENABLED: 1,
}


@dataclass(frozen=True)
class LivoxState:
    """Properties of a sensor that the command interface reports."""

    device_type: int
    product: str
    serial: str
    command_port: int
    state_ports: tuple[int, int]  # port of the sensor, and default port of the host; 0 for none
    points_ports: tuple[int, int]  # port of the sensor, and port of its datagrams
    imu_ports: tuple[int, int]
    data_type: int
    data_types: tuple[int, ...]
    is_synchronized: bool


class LivoxService(Service):
    """Service that answers commands of Livox-SDK2 and announces the sensor to the host.

    Parameters
    ----------
    address
        HOST to listen on. The ports are those of Livox sensors.
    destination, send_to
        As in `Service`.
    state
        Properties that the interface reports.
    set_data_type
        Function that changes the data type of further packets.
    """

    def __init__(
        self,
        address: str,
        destination: Destination,
        send_to: Callable[[Destination], None],
        state: LivoxState,
        set_data_type: Callable[[int], None],
    ) -> None:
        super().__init__(destination, send_to)
        self.host = address
        self._state = state
        self._set_data_type = set_data_type
        self._values: dict[int, bytes] = self._first_values()
        self._stack = ExitStack()
        self._sockets: dict[int, socket.socket] = {}  # {port: socket}
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="Livox's commands", daemon=True)
        self._pushed = 0  # number of state messages sent
        self._started_ns = time.monotonic_ns()

    @property
    def description(self) -> str:
        """Addresses of the sensor and of its host."""
        return f"Livox commands at {self.host} for the host {self.destination.host}"

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            ports = {SEARCH_PORT, self._state.command_port, self._state.state_ports[0]} - {0}
            for port in sorted(ports):
                self._sockets[port] = stack.enter_context(self._bound(port))
            self._stack = stack.pop_all()
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._ended.set()
        self._thread.join()
        self._stack.close()

    def _bound(self, port: int) -> socket.socket:
        """Return a socket bound to a port of the sensor.

        Raises LidarError if the port cannot be used.
        """
        if ":" in self.host:
            raise LidarError(
                f"--api {self.host} must be an address without a port, such as 127.0.0.2, because "
                "the ports of Livox sensors are fixed."
            )
        opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            opened.bind((self.host, port))
        except OSError as error:
            opened.close()
            raise LidarError(
                f"The Livox service cannot listen on {self.host}:{port}: "
                f"{os.strerror(error.errno or 0)}. Use a different address, such as --api "
                "127.0.0.9."
            ) from error
        opened.setblocking(False)
        return opened

    # -- the thread ------------------------------------------------------------------------------

    def _run(self) -> None:
        """Answer requests and announce the sensor every second until the service stops."""
        announce_s = time.monotonic()
        requests = 0
        with selectors.DefaultSelector() as selector:
            for opened in self._sockets.values():
                selector.register(opened, selectors.EVENT_READ)
            while not self._ended.is_set():
                if time.monotonic() >= announce_s:
                    self._announce()
                    announce_s = time.monotonic() + _ANNOUNCE_S
                    requests = 0
                if requests >= _MAX_REQUESTS:
                    self._ended.wait(_LOOKS_S)
                    continue
                for key, _ in selector.select(_LOOKS_S):
                    requests += 1
                    assert isinstance(key.fileobj, socket.socket)
                    self._serve(key.fileobj)

    def _serve(self, opened: socket.socket) -> None:
        """Answer the next request on a socket, and ignore other datagrams."""
        with suppress(OSError):  # for example if the host has disappeared
            content, peer = opened.recvfrom(MAX_FRAME_BYTES + 1)
            request = parse_request(content)
            if request is not None:
                data = self.answer(request)
                opened.sendto(answer_frame(request.command, request.number, data), peer)

    def _announce(self) -> None:
        """Send an announcement and the state of the sensor to the host."""
        announcement = answer_frame(Command.SEARCH, 0, self._search_answer())
        with suppress(OSError):
            self._sockets[SEARCH_PORT].sendto(announcement, (self.destination.host, SEARCH_PORT))
        address, port, _ = _HOST.unpack(self._values[Key.STATE_HOST])
        if not port or self._state.state_ports[0] not in self._sockets:
            return
        values = self._all_values()
        self._pushed += 1
        content = push_frame(self._pushed, packed_count(values) + packed_values(values))
        with suppress(OSError):
            state_socket = self._sockets[self._state.state_ports[0]]
            state_socket.sendto(content, (str(IPv4Address(address)), port))

    # -- answers ---------------------------------------------------------------------------------

    def answer(self, request: CommandFrame) -> bytes:
        """Return the content of the response to a request."""
        if request.command == Command.SEARCH:
            return self._search_answer()
        if request.command == Command.GET:
            return self._get(request.data)
        if request.command == Command.SET:
            return self._set(request.data)
        is_accepted = request.command in (Command.REBOOT, Command.RESET, Command.SET_GPS_TIME)
        return bytes([Code.SUCCESS if is_accepted else Code.NOT_SUPPORTED])

    def _search_answer(self) -> bytes:
        return _SEARCH_ANSWER.pack(
            Code.SUCCESS,
            self._state.device_type,
            self._state.serial.encode(),
            IPv4Address(self.host).packed,
            self._state.command_port,
        )

    def _get(self, data: bytes) -> bytes:
        """Return the parameters that a get request asks for, skipping unknown keys."""
        try:
            keys = parse_keys(data)
        except CommandRefusedError as error:
            return _GET_ANSWER.pack(error.code, 0)
        parameters = self._all_values()
        values = {key: parameters[key] for key in keys if key in parameters}
        return _GET_ANSWER.pack(Code.SUCCESS, len(values)) + packed_values(values)

    def _set(self, data: bytes) -> bytes:
        """Set all parameters in a request, and return the response.

        If any value is invalid, no parameter is set.
        """
        try:
            values = parse_values(data)
            for key, value in values.items():
                self._check(key, value)
        except CommandRefusedError as error:
            return _SET_ANSWER.pack(error.code, error.key)
        self._values |= values
        if Key.DATA_TYPE in values:
            self._set_data_type(values[Key.DATA_TYPE][0])
        if values.keys() & {Key.POINTS_HOST, Key.IMU_HOST, Key.WORK_MODE, Key.IMU_ENABLED}:
            self._redirect()
        return _SET_ANSWER.pack(Code.SUCCESS, 0)

    def _check(self, key: int, value: bytes) -> None:
        """Raise CommandRefusedError if a parameter cannot be set to the given value."""
        if key not in _LENGTHS:
            is_known = key in self._all_values()
            raise CommandRefusedError(Code.READ_ONLY if is_known else Code.NOT_SUPPORTED, key)
        if len(value) != _LENGTHS[key]:
            raise CommandRefusedError(Code.INVALID_LENGTH, key)
        if key in (Key.STATE_HOST, Key.POINTS_HOST, Key.IMU_HOST):
            _check_host(key, value)
        allowed = {Key.DATA_TYPE: self._state.data_types, Key.WORK_MODE: _WORK_MODES}
        if key in allowed and value[0] not in allowed[Key(key)]:
            raise CommandRefusedError(Code.OUT_OF_RANGE, key)

    def _redirect(self) -> None:
        """Send datagrams to the host that the parameters specify."""
        address, points_port, _ = _HOST.unpack(self._values[Key.POINTS_HOST])
        _, imu_port, _ = _HOST.unpack(self._values[Key.IMU_HOST])
        if not self._values[Key.IMU_ENABLED][0]:
            imu_port = 0
        if self._values[Key.WORK_MODE][0] != _SAMPLING:
            points_port = imu_port = 0
        ports = {self._state.points_ports[1]: points_port, self._state.imu_ports[1]: imu_port}
        self.destination = Destination(str(IPv4Address(address)), ports)
        self.send_to(self.destination)

    # -- parameters ------------------------------------------------------------------------------

    def _first_values(self) -> dict[int, bytes]:
        """Return the parameters that can be set, with their initial values."""
        state = self._state
        values = {key: bytes(length) for key, length in _LENGTHS.items()}
        values[Key.DATA_TYPE] = bytes([state.data_type])
        values[Key.WORK_MODE] = bytes([_SAMPLING])
        values[Key.IMU_ENABLED] = b"\1"
        host = IPv4Address(self.destination.host).packed
        values[Key.STATE_HOST] = _HOST.pack(host, state.state_ports[1], state.state_ports[0])
        for key, (sensor_port, port) in (
            (Key.POINTS_HOST, state.points_ports),
            (Key.IMU_HOST, state.imu_ports),
        ):
            values[key] = _HOST.pack(host, self.destination.ports.get(port, port), sensor_port)
        return values

    def _all_values(self) -> dict[int, bytes]:
        """Return all parameters, including read-only parameters."""
        state = self._state
        work_mode = self._values[Key.WORK_MODE]
        local_ns = time.monotonic_ns() - self._started_ns
        return self._values | {
            Key.LIDAR_ADDRESS: IPv4Address(self.host).packed + bytes((255, 255, 255, 0)) + bytes(4),
            Key.SERIAL_NUMBER: state.serial.encode().ljust(16, b"\0"),
            Key.PRODUCT: state.product.encode("ascii", "replace")[:64].ljust(64, b"\0"),
            Key.FIRMWARE: _VERSION,
            Key.LOADER: _VERSION,
            Key.HARDWARE: _VERSION,
            Key.MAC: bytes.fromhex("020000000001"),
            Key.WORK_STATE: work_mode,
            Key.CORE_TEMPERATURE: (4000).to_bytes(4, "little"),  # in 0.01 °C
            Key.POWER_UPS: (1).to_bytes(4, "little"),
            Key.LOCAL_TIME: local_ns.to_bytes(8, "little"),
            Key.LAST_SYNCHRONIZED: bytes(8),
            Key.TIME_OFFSET: bytes(8),
            Key.TIME_SOURCE: bytes([state.is_synchronized]),
            Key.DIAGNOSIS: bytes(2),
            Key.FIRMWARE_TYPE: bytes([_APPLICATION]),
            Key.HEALTH_CODES: bytes(32),
        }


def _check_host(key: int, value: bytes) -> None:
    """Raise CommandRefusedError if a value is not the address of a single receiver."""
    try:
        address = IPv4Address(value[:4])
    except AddressValueError as error:
        raise CommandRefusedError(Code.OUT_OF_RANGE, key) from error
    if not is_single_receiver(address):
        raise CommandRefusedError(Code.OUT_OF_RANGE, key)

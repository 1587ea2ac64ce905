"""TCP commands (PTC) of a live Hesai sensor.

The commands read the calibration, identity and settings, and set the destination of the packets.

Sources: TCP API in the user manuals of PandarQT and PandarXT-16; PtcClient in HesaiLidar_SDK_2.0;
the Hesai hardware interface of tier4/nebula.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from ipaddress import IPv4Address
from struct import Struct, pack
from zlib import crc32

from lidarsim.packets.service import Destination, is_single_receiver

from .tcp_service import TcpService

PTC_PORT = 9347
_MARK = b"\x47\x74"  # first bytes of requests and responses
_HEADER = Struct(">2sBBI")  # mark, command, return code, number of bytes that follow
_MAX_REQUEST_BYTES = 1024
_WITHIN_S = 5.0  # time limit for receiving a request, and for sending its response

_GET_CALIBRATION = 0x05
_GET_INVENTORY = 0x07
_GET_CONFIG = 0x08
_GET_STATUS = 0x09
_SET_SPIN_RATE = 0x17
_SET_RETURN_MODE = 0x1E
_SET_DESTINATION = 0x20
_GET_FIRETIMES = 0xA9
_OK = 0
_INVALID_PARAMETER = 1
_UNSUPPORTED = 5

_INVENTORY = Struct(">18s16s6s16s16s16s16shBBB")
_INVENTORY_BYTES = {42: 162}  # {model code of OT128: size}; other models have 120 bytes
_CONFIG = Struct(">4s4s4s4sHHHBHHHBBBBBBBHBBB6x")
_STATUS = Struct(">IH8iBBiiB5x")
_DESTINATION = Struct(">4sHH")
# {return mode: number in the command}
_RETURN_MODES = {"last": 0, "strongest": 1, "dual": 2, "first": 3}
_GPS_PORT = 10_110  # port of packets with GPS sentences, which are not sent

# Exceptions that end a connection, caused by the peer, by invalid bytes, or by this side.
_ENDS = (OSError, TimeoutError, asyncio.IncompleteReadError, ValueError, asyncio.CancelledError)


@dataclass(frozen=True)
class PtcDevice:
    """Properties of a sensor that PTC responses report."""

    name: str  # name of the sensor in its survey
    model_code: int
    lasers: int
    rate_rpm: int
    mode: str  # return mode
    port: int  # port of the data packets
    dated: bool  # whether a GNSS receiver sets the clock
    ptp: bool  # whether the clock is a PTP clock
    calibration: bytes  # content of the angle file
    firetimes: bytes  # content of the firing time file

    def inventory(self) -> bytes:
        """Encode the serial number, the versions and the model."""
        number = crc32(self.name.encode())
        mac = b"\x02" + number.to_bytes(5, "big")  # locally administered address
        fields = (f"SIM{number:010d}".encode(), b"", mac, b"", b"", b"", b"", 0)
        packed = _INVENTORY.pack(*fields, self.model_code, 0, self.lasers)
        return packed.ljust(_INVENTORY_BYTES.get(self.model_code, 120), b"\0")

    def config(self, own_host: str, destination: Destination) -> bytes:
        """Encode the network, rotation, clock and return settings."""
        return _CONFIG.pack(
            IPv4Address(own_host).packed,
            b"\xff\xff\xff\0",
            bytes(4),
            IPv4Address(destination.host).packed,
            destination.ports.get(self.port, self.port),
            _GPS_PORT,
            self.rate_rpm,
            *(0, 0),  # no phase lock
            *(0, 3600),  # field of view, 0.1 degrees
            self.ptp,
            1,  # packets have sequence numbers
            0,  # fires by time
            _RETURN_MODES[self.mode],
            *(0, 0),  # state: in operation
            *(0, 0),  # no VLAN
            *(0, 0, 0),  # format of dates, noise filter, linear reflectivity
        )

    def status(self, uptime_s: float) -> bytes:
        """Encode the uptime and the rotation rate, with all temperatures set to 0."""
        ptp_state = 2 if self.ptp else 0  # locked, or free run
        return _STATUS.pack(
            int(uptime_s), self.rate_rpm, *[0] * 8, *[self.dated] * 2, 1, 0, ptp_state
        )


class _RefusedError(Exception):
    """A command that the sensor answers with an error code."""

    def __init__(self, code: int) -> None:
        super().__init__(code)
        self.code = code


class PtcService(TcpService):
    """Service that answers PTC commands.

    Each connection can carry any number of commands.

    Parameters
    ----------
    device
        Properties that the responses report.
    address, destination, send_to
        As in `TcpService`.
    """

    name = "Hesai commands (PTC)"
    usual_port = PTC_PORT
    example_port = 9348
    max_connections = 16  # a further connection closes the one that has been idle longest

    def __init__(
        self,
        device: PtcDevice,
        address: str,
        destination: Destination,
        send_to: Callable[[Destination], None],
    ) -> None:
        super().__init__(address, destination, send_to)
        self._device = device
        self._started_s = time.monotonic()

    @property
    def description(self) -> str:
        """Address at which commands are accepted."""
        return f"{self.name} at {self.host}:{self.port}"

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Answer the commands on a connection until it closes or sends invalid bytes."""
        try:
            with suppress(*_ENDS), self.register_connection() as renew:
                while True:
                    start = await reader.readexactly(1)
                    renew()
                    async with asyncio.timeout(_WITHIN_S):
                        writer.write(await self._answered(start, reader, writer))
                        await writer.drain()
        finally:
            writer.close()

    async def _answered(
        self, start: bytes, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> bytes:
        """Read the rest of a request and return the answer.

        Raises ValueError if the bytes are not a valid request.
        """
        header = start + await reader.readexactly(_HEADER.size - 1)
        mark, command, _, size = _HEADER.unpack(header)
        if mark != _MARK or size > _MAX_REQUEST_BYTES:
            raise ValueError
        parameter = await reader.readexactly(size)
        own_host: str = writer.get_extra_info("sockname")[0]
        try:
            content = self._content(command, parameter, own_host)
        except _RefusedError as refusal:
            return _HEADER.pack(_MARK, command, refusal.code, 0)
        return _HEADER.pack(_MARK, command, _OK, len(content)) + content

    def _content(self, command: int, parameter: bytes, own_host: str) -> bytes:
        """Return the content of the response to a command.

        Raises _RefusedError if the command cannot be executed.
        """
        device = self._device
        answers: dict[int, Callable[[], bytes]] = {
            _GET_CALIBRATION: lambda: device.calibration,
            _GET_FIRETIMES: lambda: device.firetimes,
            _GET_INVENTORY: device.inventory,
            _GET_CONFIG: lambda: device.config(own_host, self.destination),
            _GET_STATUS: lambda: device.status(time.monotonic() - self._started_s),
            _SET_SPIN_RATE: partial(_unchanged, parameter, pack(">H", device.rate_rpm)),
            _SET_RETURN_MODE: partial(_unchanged, parameter, bytes([_RETURN_MODES[device.mode]])),
            _SET_DESTINATION: lambda: self._set_destination(parameter),
        }
        if command not in answers:
            raise _RefusedError(_UNSUPPORTED)
        return answers[command]()

    def _set_destination(self, parameter: bytes) -> bytes:
        """Redirect all further datagrams to a new address."""
        if len(parameter) != _DESTINATION.size:
            raise _RefusedError(_INVALID_PARAMETER)
        packed, port, _ = _DESTINATION.unpack(parameter)
        host = IPv4Address(packed)
        if not port or not is_single_receiver(host):
            raise _RefusedError(_INVALID_PARAMETER)
        self.destination = Destination(str(host), {self._device.port: port})
        self.send_to(self.destination)
        return b""


def _unchanged(parameter: bytes, current: bytes) -> bytes:
    """Accept the current value of a setting that cannot be changed.

    Raises _RefusedError for other values.
    """
    if parameter != current:
        raise _RefusedError(_INVALID_PARAMETER)
    return b""

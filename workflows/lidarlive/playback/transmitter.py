"""Transmission of packets by a separate process, and simulation of sensor interfaces."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Self

from lidarsim.errors import LidarError, explain_os_errors
from lidarsim.packets.encoders import PacketEncoder
from lidarsim.packets.service import Destination, Service
from lidarsim.words import did_you_mean, join_names

from ..devices.send import LOOPBACK, ReceiverAddress, Sender, check_reachable
from ..devices.services import service_of

# Returns the service of a sensor, as `service_of` does.
MakeService = Callable[[str, Destination, Callable[[Destination], None]], Service | None]


@dataclass(frozen=True, eq=False)
class Stream:
    """Datagrams of a sensor, with their destination and the address of the sensor's interface."""

    name: str
    model: str
    kinds: Mapping[str, int]  # ports by kind of datagram, starting with the returns
    make_service: MakeService
    distinguished_by_receivers: bool = False  # see `PacketEncoder`
    has_own_address: bool = False
    destination: Destination = field(default_factory=lambda: Destination(LOOPBACK))
    # Address on which the sensor interface listens.
    address: ReceiverAddress = field(default_factory=lambda: ReceiverAddress(LOOPBACK))
    api_given: bool = False  # whether the user specified the address of the interface

    @property
    def source_address(self) -> str:
        """Address from which the datagrams are sent.

        This is the address of the sensor interface, or an empty string for any address.
        """
        to_this_machine = ReceiverAddress(self.destination.host).is_loopback
        return self.address.host if to_this_machine or not self.address.is_loopback else ""

    @property
    def ports(self) -> list[int]:
        """Destination ports, starting with that of the returns."""
        return list(self.destination.ports.values())

    def describe(self) -> str:
        """Describe the destination of the datagrams in a message for the user."""
        words = f"{self.model} sends to {self.destination.host}"
        ports = " and ".join(map(str, self.ports))
        return f"{words}, port {ports}" if ports else words

    def with_destination(self, receiver: ReceiverAddress) -> Stream:
        """Return a copy of the stream that has a new destination.

        The port of the receiver is that of the returns. Ports of other kinds of datagrams are
        shifted by the same amount.

        Raises
        ------
        LidarError
            If the datagrams cannot be sent to the receiver.
        """
        if receiver.port is not None and not self.kinds:
            raise LidarError(
                f"The ports of {self.model}, to which `--to {receiver}` refers, are unknown. "
                "Remove the port."
            )
        first = next(iter(self.kinds.values()), 0)
        shift = 0 if receiver.port is None else receiver.port - first
        numbers = {port: port + shift for port in self.kinds.values()}
        if beyond := [port for port in numbers.values() if not 0 < port < 1 << 16]:
            raise LidarError(
                f"With `--to {receiver}`, other packets of {self.name} would be sent to port "
                f"{beyond[0]}, which is out of range. Use a port closer to {first}."
            )
        check_reachable(ReceiverAddress(receiver.host, numbers.get(first)))
        return replace(self, destination=Destination(receiver.host, numbers))


def sensor_streams(
    encoders: Sequence[PacketEncoder], to: Sequence[str], api: Sequence[str]
) -> list[Stream]:
    """Create the sensors' streams, and set their destinations with `streams_to`."""
    streams = [
        Stream(
            encoder.source.name or "lidar",
            encoder.source.sensor.model,
            encoder.ports,
            partial(service_of, encoder),
            encoder.distinguished_by_receivers,
            encoder.has_own_address,
        )
        for encoder in encoders
    ]
    return streams_to(streams, to, api)


def streams_to(streams: Sequence[Stream], to: Sequence[str], api: Sequence[str]) -> list[Stream]:
    """Set the destinations of streams from the user's addresses, in the form [NAME=]HOST[:PORT].

    By default, sensor interfaces listen on 127.0.0.1, 127.0.0.2 and so on. Interfaces that require
    a separate address start at 127.0.0.2.

    Raises
    ------
    LidarError
        If an address cannot be used, or if receivers could not distinguish two sensors.
    """
    names = [stream.name for stream in streams]
    receivers = _parse_addresses(to, names, "--to")
    interfaces = _parse_addresses(api, names, "--api")
    placed: list[Stream] = []
    for number, stream in enumerate(streams):
        name = stream.name
        moved = replace(
            stream.with_destination(receivers.get(name, ReceiverAddress(LOOPBACK))),
            address=interfaces.get(name, _loopback_address(number, stream.has_own_address)),
            api_given=name in interfaces,
        )
        for other in placed:
            _check_distinguishable(other, moved)
        placed.append(moved)
    return placed


def _loopback_address(number: int, has_own_address: bool) -> ReceiverAddress:
    return ReceiverAddress(f"127.0.0.{number + (2 if has_own_address else 1)}")


def _parse_addresses(
    texts: Sequence[str], names: Sequence[str], option: str
) -> dict[str, ReceiverAddress]:
    """Parse addresses, and return them keyed by sensor name.

    An address without a name applies to all sensors.
    """
    addresses: dict[str, ReceiverAddress] = {}
    for text in texts:
        name, separator, address = text.rpartition("=")
        if separator and name not in names:
            raise LidarError(
                f"{option} {text} refers to the sensor {name!r}, which does not "
                f"exist.{did_you_mean(name, names)} The sensors are {join_names(names)}."
            )
        parsed = ReceiverAddress.parse(address)
        for sensor in [name] if separator else names:
            addresses[sensor] = parsed
    return addresses


def _check_distinguishable(stream: Stream, other: Stream) -> None:
    """Raise LidarError if a receiver cannot distinguish two sensors."""
    shared = {*stream.ports} & {*other.ports}
    host = stream.destination.host
    if host != other.destination.host or not shared:
        return
    if stream.distinguished_by_receivers and stream.source_address != other.source_address:
        return
    port = min(stream.ports[0], 60_000)
    raise LidarError(
        f"{stream.name} and {other.name} would both send to {host}:{min(shared)}. Specify a "
        f"port for each of them, such as `--to {stream.name}={host}:{port} --to "
        f"{other.name}={host}:{port + 100}`."
    )


class Transmitter:
    """Context manager that runs the sending process and the sensor interfaces.

    If `lateness` is set, statistics on how late datagrams were are written to this file as JSON.
    """

    def __init__(
        self, streams: Sequence[Stream], note: Callable[[str], None], lateness: Path | None = None
    ) -> None:
        self.sender = Sender(note)
        self._streams = streams
        self._lateness_file = lateness
        self._services: list[str] = []  # descriptions of the sensor interfaces
        self._stack = ExitStack()

    @property
    def description(self) -> str:
        """Destinations of the datagrams, and available sensor interfaces."""
        return "; ".join([*(stream.describe() for stream in self._streams), *self._services])

    @property
    def summary(self) -> str:
        """Number of sent datagrams and their delays, available after the context has ended."""
        return f"{self.sender.lateness}."

    def __enter__(self) -> Self:
        self._write_lateness()  # Fail early if the file cannot be written.
        with ExitStack() as stack:
            stack.enter_context(self.sender)
            for number, stream in enumerate(self._streams):
                redirect = partial(self._redirect, number)
                service = stream.make_service(str(stream.address), stream.destination, redirect)
                if service is not None:
                    service.names |= {stream.address.name} - {""}
                    stack.enter_context(service)
                    self._services.append(service.description)
                elif stream.api_given:
                    raise LidarError(
                        f"`--api` cannot be used with {stream.model}, because no HTTP or command "
                        "interface is simulated for this sensor. Remove `--api`."
                    )
                self.sender.redirect(number, stream.destination, stream.source_address)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *error: object) -> None:
        self._stack.__exit__(None, None, None)
        self._write_lateness()

    def _write_lateness(self) -> None:
        """Write statistics about late datagrams.

        Raise LidarError if the file cannot be written.
        """
        file = self._lateness_file
        if file is not None:
            with explain_os_errors(f"{file} cannot be written"):
                text = json.dumps(self.sender.lateness.to_json(), indent=1) + "\n"
                file.write_text(text, encoding="utf-8")

    def _redirect(self, number: int, destination: Destination) -> None:
        """Change the destination of a stream when its sensor interface requests it."""
        stream = replace(self._streams[number], destination=destination)
        with suppress(LidarError):  # sending the next packets raises the same error
            self.sender.redirect(number, destination, stream.source_address)

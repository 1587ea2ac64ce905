"""Encoders and decoders of packets: classes for each maker, in the tables or from plug-ins."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib import import_module
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from ..base.arrays import AnyArray, Bools, Bytes, Floats, Ints
from ..base.errors import LidarError
from ..base.plugins import Plugin, PluginTable
from ..base.words import did_you_mean
from ..sensor import Sensor
from ..sensor.packet_settings import Identifier, PacketSettings
from ..sweeps.instruments import Instruments
from ..sweeps.sweeps import Sweeps
from .capture import ENDINGS, Capture
from .service import Destination, Service
from .shots import Shots, settings_of

# Plug-ins are subclasses of `PacketEncoder`; the name of a plug-in is the `format` of data files.
GROUP = "lidarpool.packets"
# Start of a survey without a date, nanoseconds since 1970: as in bags, on 2001-09-09 at 01:46:40.
START_NS = 1_000_000_000_000_000_000


@dataclass(frozen=True, eq=False)
class Datagrams:
    """UDP datagrams of the same size to a port."""

    payloads: Bytes  # (n, size)
    due_ns: Ints  # (n,): when the sensor sends them, nanoseconds since the survey's start
    port: int
    source_port: int = 0  # port of the sensor; 0 for any: in files the same port

    def __len__(self) -> int:
        return len(self.payloads)

    def without(self, dropped: Bools) -> Datagrams:
        """Return the datagrams without those that are lost: `dropped` (n,)."""
        if not dropped.any():
            return self
        return replace(self, payloads=self.payloads[~dropped], due_ns=self.due_ns[~dropped])


@dataclass(frozen=True, eq=False)
class PacketSource:
    """What packets depend on beside the shots: a sensor of a survey, and its times."""

    sensor: Sensor
    mode: str  # mode of its returns (`Returns`)
    name: str = ""  # name of the sensor in its survey
    start_ns: int = START_NS  # start of the survey, since 1970-01-01 UTC
    dated: bool = False  # whether the survey has a start, as of a clock that a receiver sets
    instruments: Instruments | None = None  # instruments of the carrier
    mount: Floats = field(default_factory=lambda: np.eye(4))  # (4, 4): pose on the carrier

    @property
    def settings(self) -> PacketSettings:
        """Packets of the sensor.

        Raises LidarError without packets.
        """
        return settings_of(self.sensor)

    @classmethod
    def of_sensor(cls, sweeps: Sweeps, number: int) -> PacketSource:
        """Return the source of the packets of the sensor `number` of a survey.

        LidarError if the survey does not keep every return, or the sensor has no packets.
        """
        if sweeps.fired is None:
            raise LidarError(
                "Packets require all rays and returns of a survey. Run the survey with "
                "keep_every 1 and the column ray."
            )
        sensor = sweeps.fired.sensors[number]
        settings_of(sensor)
        return cls(
            sensor=sensor,
            mode=sweeps.lidars[number].mode,
            name=sweeps.sensors[number],
            start_ns=START_NS if sweeps.start_ns is None else sweeps.start_ns,
            dated=sweeps.start_ns is not None,
            instruments=sweeps.instruments,
            mount=sweeps.mounts.matrix(number),
        )


class PacketEncoder(ABC):
    """Makes the datagrams of a sensor from its shots, sweep by sweep.

    A subclass checks the identifiers and the mode of the source when it is made, and keeps shots
    that fill no packet for the next sweep (`CarryOver`).
    """

    columns: tuple[str, ...] = ("reflectivity",)  # columns of the cloud, beside ray and range
    identifiers: ClassVar[tuple[str, ...]] = ()  # the data file must state them
    optional_identifiers: ClassVar[tuple[str, ...]] = ()  # the data file may state them
    address: ClassVar[str] = "192.168.1.201"  # address of the sensor, as it leaves the factory
    destination: ClassVar[str] = "255.255.255.255"
    default_ports: ClassVar[Mapping[str, int]] = {}  # {kind of packets: port}, returns first
    # Whether receivers tell sensors of one port apart, by addresses or serial numbers.
    told_apart: ClassVar[bool] = False
    # Whether the maker's software ignores datagrams from the receiver's address.
    has_own_address: ClassVar[bool] = False

    def __init__(self, source: PacketSource) -> None:
        self.source = source
        stated = source.settings.identifiers
        if missing := [name for name in self.identifiers if name not in stated]:
            raise self.unusable(f"lack the identifier {', '.join(missing)}")
        known = self.identifiers + self.optional_identifiers
        if unknown := [name for name in stated if name not in known]:
            error = self.unusable(f"have an unknown identifier {unknown[0]!r}")
            raise LidarError(f"{error}{did_you_mean(unknown[0], known)}")

    @abstractmethod
    def encode(self, shots: Shots) -> list[Datagrams]:
        """Return the datagrams that the shots of a sweep fill, a group for each port."""

    @abstractmethod
    def finish(self) -> list[Datagrams]:
        """Return the datagrams of the shots that are left after the last sweep."""

    def files(self) -> Mapping[str, bytes]:
        """Return files that readers need beside the packets, {suffix: content}."""
        return {}

    def service(
        self, address: str, destination: Destination, send_to: Callable[[Destination], None]
    ) -> Service | None:
        """Return what answers the maker's software for a live sensor, or None for no service.

        `address` is where it listens: HOST for the maker's port, or HOST:PORT. The other parameters
        are as in `Service`.
        """
        return None

    @property
    def ports(self) -> Mapping[str, int]:
        """Ports of all kinds of packets, the port of the returns first: {kind: port}."""
        return {**self.default_ports, **self.source.settings.ports}

    @property
    def firing_interval_ns(self) -> int:
        """Time from a firing to the next, nanoseconds, rounded."""
        firings = np.arange(2)
        return int(np.rint(np.diff(self.source.sensor.begins_ns(firings))[0]))

    def port(self, kind: str, default: int) -> int:
        """Return the port of a kind of packets from the data file, else the default."""
        return self.source.settings.ports.get(kind, default)

    def unusable(self, reason: str) -> LidarError:
        """Return the error of packets that cannot be made: «… {reason}»."""
        return LidarError(f"Packets of {self.source.sensor.model} {reason}.")

    def number(self, name: str) -> int:
        """Return an identifier that is a whole number.

        Raises LidarError for other values.
        """
        value: Identifier = self.source.settings.identifiers[name]
        if not isinstance(value, int):
            raise self.unusable(f"have {name} {value!r}, which must be a whole number")
        return value

    def text(self, name: str) -> str:
        """Return an identifier as text."""
        return str(self.source.settings.identifiers[name])

    def decimal(self, name: str) -> float:
        """Return an identifier that is a number.

        Raises LidarError for other values.
        """
        value: Identifier = self.source.settings.identifiers[name]
        if isinstance(value, str):
            raise self.unusable(f"have {name} {value!r}, which must be a number")
        return float(value)


class PacketDecoder(ABC):
    """Reads the sweeps of a maker's packets from a file.

    Parameters
    ----------
    path
        The file.
    name
        Name of the file in messages.

    Raises
    ------
    LidarError
        If the packets are not read, or a package that reads them is not installed.
    """

    intensity: ClassVar[str] = ""  # column that is `WHITE` for a white surface, at any range
    refusal: ClassVar[str] = ""  # what the file contains and what to do, if it is not read
    sensors: Sequence[str] = ("",)  # names of the sensors in the file; "" for an only one
    notes: Sequence[str] = ()  # clauses that follow the name of the file

    def __init__(self, path: Path, name: str) -> None:
        self.path = path
        self.name = name

    @staticmethod
    @abstractmethod
    def recognizes(payload: bytes) -> bool:
        """Return whether a UDP datagram is a packet of this maker."""

    @abstractmethod
    def sweeps(self, sensor: int) -> Iterable[Any]:
        """Return the sweeps of a sensor, an object of the maker's software each, from the first."""

    @abstractmethod
    def columns(self, sensor: int, sweep: Any) -> dict[str, AnyArray]:
        """Return the columns (n,) of a sweep's points, with x, y and z in meters."""

    @abstractmethod
    def time_ns(self, sweep: Any) -> float:
        """Return the start of a sweep, nanoseconds."""


_OUSTER = "lidarsim.packets.ouster:OusterDecoder"
WHITE = 100.0  # intensity that Velodyne and Ouster report of a white surface at any range

# {format of packets: module and class of its encoder}
ENCODERS = {
    "hesai": "lidarsim.packets.hesai:HesaiEncoder",
    "livox": "lidarsim.packets.livox:LivoxEncoder",
    "ouster": "lidarsim.packets.ouster:OusterEncoder",
    "robosense": "lidarsim.packets.robosense:RobosenseEncoder",
    "velodyne": "lidarsim.packets.velodyne:VelodyneEncoder",
}


# Classes of decoders, in the order in which they are asked.
_DECODERS = (
    "lidarsim.packets.velodyne:VelodyneDecoder",
    "lidarsim.packets.hesai:HesaiDecoder",
    "lidarsim.packets.robosense:RobosenseDecoder",
    "lidarsim.packets.livox:LivoxDecoder",
    _OUSTER,
)


def decoder_of(path: Path, name: str) -> PacketDecoder:
    """Return the decoder of a file, for the file's `name` in messages.

    The first packet that a decoder recognizes decides, because captures also contain datagrams of
    other programs.

    Raises
    ------
    LidarError
        If the packets of the file are not read, or a package that reads them is not installed.
    """
    if path.suffix.lower() not in ENDINGS:  # a recording of Ouster's software
        return _decoder(_imported(_OUSTER), path, name)
    classes: list[type[PacketDecoder]] = [_imported(entry) for entry in _DECODERS]
    for datagram in Capture(path, name).datagrams():
        for decoder in classes:
            if decoder.recognizes(datagram.payload):
                return _decoder(decoder, path, name)
    raise LidarError(
        f"{name} contains no packets of a supported sensor. Sweeps can be read from packets of "
        "Velodyne and Ouster sensors."
    )


def _decoder(decoder: type[PacketDecoder], path: Path, name: str) -> PacketDecoder:
    """Return a decoder of a file.

    Raises LidarError if the file is not read.
    """
    if decoder.refusal:
        raise LidarError(f"{name} contains {decoder.refusal}.")
    return decoder(path, name)


def _imported(value: str) -> Any:
    """Return the class of «module:class»."""
    module, _, attribute = value.partition(":")
    return getattr(import_module(module), attribute)


def _encoder_of_plugin(plugin: Plugin) -> type[PacketEncoder]:
    """Return the encoder of a plug-in.

    Raises LidarError for another class.
    """
    encoder = plugin.load(type)
    if not issubclass(encoder, PacketEncoder):
        raise plugin.lacks("a subclass of lidarsim.packets.encoders.PacketEncoder")
    return encoder


_TABLE: PluginTable[Any] = PluginTable(GROUP, "packet format", ENCODERS, _encoder_of_plugin)


def encoder_class(name: str) -> type[PacketEncoder]:
    """Return the encoder of a format of packets, of the table or of a plug-in.

    Raises
    ------
    LidarError
        If there is no format of that name, or its plug-in cannot be used.
    """
    entry = _TABLE[name]
    encoder: type[PacketEncoder] = _imported(entry) if isinstance(entry, str) else entry
    return encoder


def encoder_of(source: PacketSource) -> PacketEncoder:
    """Return the encoder of a sensor.

    Raises
    ------
    LidarError
        If the sensor has no packets, or its format, identifiers or mode cannot be encoded.
    """
    return encoder_class(source.settings.format)(source)

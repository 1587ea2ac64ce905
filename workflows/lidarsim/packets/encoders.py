"""Base classes of packet encoders and decoders, and the tables that list them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib import import_module
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from ..environment.plugins import Plugin, PluginTable
from ..errors import LidarError
from ..numerics.arrays import AnyArray, Bools, Bytes, Floats, Ints
from ..sensor import Sensor
from ..sensor.packet_settings import Identifier, PacketSettings
from ..sweeps.instruments import Instruments
from ..sweeps.sweeps import Sweeps
from ..words import did_you_mean
from .capture import ENDINGS, Capture
from .service import Destination, Service
from .shots import Shots, settings_of

# Plug-ins are subclasses of `PacketEncoder`, selected by `format` in sensor data files.
GROUP = "lidarpool.packets"
# Start of a survey without a date, in nanoseconds since 1970: 2001-09-09 01:46:40, as in bags.
START_NS = 1_000_000_000_000_000_000


@dataclass(frozen=True, eq=False)
class Datagrams:
    """UDP datagrams with the same size and destination port."""

    payloads: Bytes  # (n, size)
    due_ns: Ints  # (n,): send times, nanoseconds since the start of the survey
    port: int
    source_port: int = 0  # port of the sensor; 0 if any, which files replace by `port`

    def __len__(self) -> int:
        return len(self.payloads)

    def drop(self, dropped: Bools) -> Datagrams:
        """Return only the datagrams that are not lost.

        `dropped` (n,) is True for lost datagrams.
        """
        if not dropped.any():
            return self
        return replace(self, payloads=self.payloads[~dropped], due_ns=self.due_ns[~dropped])


@dataclass(frozen=True, eq=False)
class PacketSource:
    """Properties of a sensor and its survey that are required to encode its shots."""

    sensor: Sensor
    mode: str  # mode of the reported returns (`Returns`)
    name: str = ""  # name of the sensor in its survey
    start_ns: int = START_NS  # start of the survey, nanoseconds since 1970-01-01 UTC
    dated: bool = False  # whether the survey has a start time, as from a synchronized clock
    instruments: Instruments | None = None  # instruments on the platform
    mount: Floats = field(default_factory=lambda: np.eye(4))  # (4, 4): pose on the platform

    @property
    def settings(self) -> PacketSettings:
        """Packet settings of the sensor.

        Raises LidarError if the sensor has no packet format.
        """
        return settings_of(self.sensor)

    @classmethod
    def for_sensor(cls, sweeps: Sweeps, number: int) -> PacketSource:
        """Return the packet source for sensor `number` of a survey.

        Raises LidarError if the survey does not keep every return, or if the sensor has no packet
        format.
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
    """Encoder that converts the shots of a sensor to datagrams, sweep by sweep.

    The constructor of a subclass checks the identifiers and the return mode of the source. Shots
    that do not fill a packet are stored for the next sweep (`CarryOver`).
    """

    columns: tuple[str, ...] = ("reflectivity",)  # required cloud columns besides ray and range
    identifiers: ClassVar[tuple[str, ...]] = ()  # required in the sensor's data file
    optional_identifiers: ClassVar[tuple[str, ...]] = ()  # optional in the sensor's data file
    address: ClassVar[str] = "192.168.1.201"  # factory default address of the sensor
    destination: ClassVar[str] = "255.255.255.255"
    default_ports: ClassVar[Mapping[str, int]] = {}  # {packet kind: port}, returns first
    # Whether receivers distinguish sensors on the same port by their addresses or serial numbers.
    distinguished_by_receivers: ClassVar[bool] = False
    # Whether the manufacturer's software ignores datagrams from the receiver's own address.
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
        """Encode the shots of a sweep. Return the datagrams that are now complete, by port."""

    @abstractmethod
    def finish(self) -> list[Datagrams]:
        """Return the datagrams with the shots that remain after the last sweep."""

    def files(self) -> Mapping[str, bytes]:
        """Return additional files that readers of the packets need, keyed by file name suffix."""
        return {}

    def service(
        self, address: str, destination: Destination, send_to: Callable[[Destination], None]
    ) -> Service | None:
        """Return a service that acts as a live sensor for the manufacturer's software, if any.

        Encoders of plug-ins override this method. The services of the included encoders are in a
        package above this one.

        `address` is the address to listen on, HOST for the usual port or HOST:PORT. The other
        parameters are the same as in `Service`.
        """
        return None

    @property
    def ports(self) -> Mapping[str, int]:
        """Ports of all kinds of packets, keyed by kind. The port of the returns comes first."""
        return {**self.default_ports, **self.source.settings.ports}

    @property
    def firing_interval_ns(self) -> int:
        """Time between consecutive firings, rounded to nanoseconds."""
        firings = np.arange(2)
        return int(np.rint(np.diff(self.source.sensor.begins_ns(firings))[0]))

    def port(self, kind: str, default: int) -> int:
        """Return the port for one kind of packet from the sensor's data file, or `default`."""
        return self.source.settings.ports.get(kind, default)

    def unusable(self, reason: str) -> LidarError:
        """Return an error for packets that cannot be encoded. Its message ends with `reason`."""
        return LidarError(f"Packets of {self.source.sensor.model} {reason}.")

    def number(self, name: str) -> int:
        """Return an identifier in the packet settings as an integer.

        Raises LidarError for other values.
        """
        value: Identifier = self.source.settings.identifiers[name]
        if not isinstance(value, int):
            raise self.unusable(f"have {name} {value!r}, which must be a whole number")
        return value

    def text(self, name: str) -> str:
        """Return an identifier in the packet settings as text."""
        return str(self.source.settings.identifiers[name])

    def decimal(self, name: str) -> float:
        """Return an identifier in the packet settings as a number.

        Raises LidarError for other values.
        """
        value: Identifier = self.source.settings.identifiers[name]
        if isinstance(value, str):
            raise self.unusable(f"have {name} {value!r}, which must be a number")
        return float(value)


class PacketDecoder(ABC):
    """Decoder that reads the sweeps in a file of a manufacturer's packets.

    Parameters
    ----------
    path
        Path of the file.
    name
        Name of the file for messages.

    Raises
    ------
    LidarError
        If the packets are not supported, or a package that reads them is not installed.
    """

    intensity: ClassVar[str] = ""  # column that is `WHITE` for a white surface at any range
    refusal: ClassVar[str] = ""  # description of unsupported packets, with advice
    sensors: Sequence[str] = ("",)  # names of the sensors in the file; "" for a single sensor
    notes: Sequence[str] = ()  # messages that follow the name of the file

    def __init__(self, path: Path, name: str) -> None:
        self.path = path
        self.name = name

    @staticmethod
    @abstractmethod
    def recognizes(payload: bytes) -> bool:
        """Return whether a UDP datagram is a packet of this manufacturer."""

    @abstractmethod
    def sweeps(self, sensor: int) -> Iterable[Any]:
        """Return a sensor's sweeps in order, as objects of the manufacturer's software."""

    @abstractmethod
    def columns(self, sensor: int, sweep: Any) -> dict[str, AnyArray]:
        """Return the point columns of a sweep, which include x, y and z in meters."""

    @abstractmethod
    def time_ns(self, sweep: Any) -> int:
        """Return the start time of a sweep in nanoseconds."""


_OUSTER = "lidarsim.packets.ouster:OusterDecoder"
WHITE = 100.0  # intensity that Velodyne and Ouster report for a white surface at any range

# {packet format: module and class of its encoder}
ENCODERS = {
    "hesai": "lidarsim.packets.hesai:HesaiEncoder",
    "livox": "lidarsim.packets.livox:LivoxEncoder",
    "ouster": "lidarsim.packets.ouster:OusterEncoder",
    "robosense": "lidarsim.packets.robosense:RobosenseEncoder",
    "velodyne": "lidarsim.packets.velodyne:VelodyneEncoder",
}


# Decoder classes, in the order in which they are tried.
_DECODERS = (
    "lidarsim.packets.velodyne:VelodyneDecoder",
    "lidarsim.packets.hesai:HesaiDecoder",
    "lidarsim.packets.robosense:RobosenseDecoder",
    "lidarsim.packets.livox:LivoxDecoder",
    _OUSTER,
)


def decoder_of(path: Path, name: str) -> PacketDecoder:
    """Return a decoder for a file.

    Captures may also contain datagrams of other programs, so the first packet that any decoder
    recognizes determines the decoder.

    Raises
    ------
    LidarError
        If the packets are not supported, or a package that reads them is not installed.
    """
    if path.suffix.lower() not in ENDINGS:  # a recording made by Ouster's software
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
    """Create a decoder for a file. Raises LidarError if its packets are not supported."""
    if decoder.refusal:
        raise LidarError(f"{name} contains {decoder.refusal}.")
    return decoder(path, name)


def _imported(value: str) -> Any:
    module, _, attribute = value.partition(":")
    return getattr(import_module(module), attribute)


def _encoder_of_plugin(plugin: Plugin) -> type[PacketEncoder]:
    """Load the encoder class of a plug-in. Raises LidarError if it is not an encoder class."""
    encoder = plugin.load(type)
    if not issubclass(encoder, PacketEncoder):
        raise plugin.missing_field_error("a subclass of lidarsim.packets.encoders.PacketEncoder")
    return encoder


_TABLE: PluginTable[Any] = PluginTable(GROUP, "packet format", ENCODERS, _encoder_of_plugin)


def encoder_class(name: str) -> type[PacketEncoder]:
    """Return the encoder class of a packet format that is built in or comes from a plug-in.

    Raises
    ------
    LidarError
        If there is no format with this name, or its plug-in cannot be used.
    """
    entry = _TABLE[name]
    encoder: type[PacketEncoder] = _imported(entry) if isinstance(entry, str) else entry
    return encoder


def encoder_of(source: PacketSource) -> PacketEncoder:
    """Create the encoder of a sensor.

    Raises
    ------
    LidarError
        If the sensor has no packet format, or its format, identifiers or return mode are not
        supported.
    """
    return encoder_class(source.settings.format)(source)

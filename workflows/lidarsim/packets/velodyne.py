"""Packets of Velodyne VLP-16, Puck Hi-Res, VLP-32C, HDL-32E and VLS-128 sensors.

Sources: user manuals of the VLP-16 (63-9243), VLP-32C and VLS-128; HDL-32E packet structure and
timing (63-9277); packet_decoder.cpp in valgur/velodyne_decoder.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from importlib import import_module
from itertools import islice
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
import yaml

from ..environment.extras import require_package
from ..numerics.arrays import AnyArray, Ints
from .capture import Capture, CapturedDatagram
from .encoders import Datagrams, PacketDecoder, PacketEncoder, PacketSource
from .packet_order import PacketOrder, order_notes
from .shots import CarryOver, Shots, last_and_strongest
from .velodyne_position import POSITION_PORT, PositionPackets

DATA_PORT = 2368
_BLOCKS = 12  # blocks per packet
_BLOCK_LASERS = 32
_CHANNELS = (16, 32, 128)
_FLAGS = np.array([0xEEFF, 0xDDFF, 0xCCFF, 0xBBFF], "<u2")  # for lasers from 0, 32, 64 and 96
_UNUSED = 0xFFFF  # flag of blocks without lasers
_MODES = {"strongest": 0x37, "last": 0x38, "dual": 0x39}
_AZIMUTHS = 36_000  # azimuth units per revolution
_MAX_UNITS = 65_535
_HOUR_US = 3_600_000_000
_FLAG_BYTES = tuple(flag.tobytes() for flag in _FLAGS)  # possible first bytes of a packet
# Laser of the VLS-128 whose time is the packet's time, which is the first laser in the fourth group
# of eight.
_STAMPED_LASER_OF_128 = 24

_RETURN = np.dtype([("distance", "<u2"), ("reflectivity", "u1")])
_BLOCK = np.dtype([("flag", "<u2"), ("azimuth", "<u2"), ("returns", _RETURN, _BLOCK_LASERS)])
_PACKET = np.dtype(
    [("blocks", _BLOCK, _BLOCKS), ("stamp_us", "<u4"), ("mode", "u1"), ("product", "u1")]
)


class VelodyneEncoder(PacketEncoder):
    """Encoder of data packets of 1,206 bytes and position packets of 512 bytes.

    The azimuth of a block is the azimuth of the head at the block's first firing, clockwise from
    the sensor's x axis. In dual mode, each block of last returns is followed by a block of
    strongest returns, or of second strongest returns where the last return is the strongest. A
    single return is in both blocks.
    """

    identifiers = ("product", "unit_m")
    default_ports: ClassVar[Mapping[str, int]] = {"data": DATA_PORT, "position": POSITION_PORT}

    def __init__(self, source: PacketSource) -> None:
        super().__init__(source)
        if source.mode not in _MODES:
            modes = ", ".join(_MODES)
            raise self.unusable(f"support the returns {modes}, not {source.mode}. Set returns.mode")
        channels = source.sensor.channels
        if channels not in _CHANNELS:
            raise self.unusable(f"support 16, 32 or 128 lasers, but the sensor has {channels}")
        self._mode = _MODES[source.mode]
        self._unit_m = self.decimal("unit_m")
        self._product = self.number("product")
        self._planes = 2 if source.mode == "dual" else 1
        # In dual mode, the VLS-128 leaves four blocks of each packet without lasers.
        self._firings = _BLOCKS * _BLOCK_LASERS // (channels * self._planes)
        self._port = self.port("data", DATA_PORT)
        self._carry = CarryOver(self._firings)
        self._positions = PositionPackets(source, self.port("position", POSITION_PORT))

    def encode(self, shots: Shots) -> list[Datagrams]:
        """Encode the shots of a sweep. Return the full data packets, and position packets."""
        whole = self._carry.whole_packets(shots)
        if not len(whole):
            return []
        data = self._data(whole)
        last = slice(self._firings - 1, None, self._firings)
        stamps_ns = whole.stamps_ns[last] + self.firing_interval_ns
        positions = self._positions.following(data.due_ns, stamps_ns)
        dropped = np.all(whole.dropped.reshape(-1, self._firings), axis=1)
        return [data.drop(np.asarray(dropped)), positions]

    def finish(self) -> list[Datagrams]:
        """Return no packets, because the sensor only sends packets whose blocks are all full."""
        return []

    def _data(self, shots: Shots) -> Datagrams:
        """Encode shots as data packets, which the shots must fill completely."""
        firings = np.arange(len(shots)).reshape(-1, self._firings)
        packets = np.zeros(len(firings), _PACKET)
        packets["mode"] = self._mode
        packets["product"] = self._product
        packets["stamp_us"] = self._stamps_us(shots.stamps_ns[firings[:, 0]])
        self._fill_blocks(packets["blocks"], shots)
        last_ns = shots.starts_ns[firings[:, -1]]
        payloads = packets.view(np.uint8).reshape(len(packets), _PACKET.itemsize)
        return Datagrams(payloads, last_ns + self.firing_interval_ns, self._port)

    def _stamps_us(self, first_ns: Ints) -> Ints:
        """Return packet timestamps in µs past the hour, given the times of their first firings."""
        settings = self.source.settings
        offset_ns = 0.0
        if len(settings.lasers) > _BLOCKS * _BLOCK_LASERS // 4:
            laser = settings.channels[_STAMPED_LASER_OF_128]
            offset_ns = float(self.source.sensor.beams.time_ns[laser])
        stamps_ns = self.source.start_ns + first_ns + round(offset_ns)
        return (stamps_ns + 500) // 1000 % _HOUR_US

    def _fill_blocks(self, blocks: AnyArray, shots: Shots) -> None:
        """Write the flags, azimuths and returns of shots to blocks of type `_BLOCK`."""
        channels = shots.range_m.shape[2]
        used = self._firings * channels * self._planes // _BLOCK_LASERS
        units = np.rint(shots.range_m / self._unit_m)
        fits = (units > 0) & (units <= _MAX_UNITS)  # False without a return, where the range is NaN
        distances = np.where(fits, units, 0).astype("<u2")
        reflectivities = shots.columns["reflectivity"] * fits
        shape = len(blocks), -1, _BLOCK_LASERS
        for name, values in (("distance", distances), ("reflectivity", reflectivities)):
            planes = last_and_strongest(values, fits) if self._planes == 2 else [values[0]]
            interleaved = np.concatenate([plane.reshape(shape) for plane in planes], axis=2)
            blocks["returns"][name][:, :used] = interleaved.reshape(len(blocks), used, -1)
        banks = max(1, channels // _BLOCK_LASERS)
        blocks["flag"] = _UNUSED
        blocks["flag"][:, :used] = _FLAGS[np.arange(used) // self._planes % banks]
        azimuths = np.rint(np.degrees(-shots.azimuths) * 100).astype(np.int64) % _AZIMUTHS
        by_firing = azimuths.reshape(len(blocks), self._firings)
        firing = np.arange(used) // self._planes * _BLOCK_LASERS // channels
        blocks["azimuth"][:, :used] = by_firing[:, firing]
        blocks["azimuth"][:, used:] = by_firing[:, -1:]  # readers use the azimuth of the last block


class VelodyneDecoder(PacketDecoder):
    """Decoder that reads Velodyne packets with velodyne_decoder.

    Data packets identify the sensor model.

    If a file contains several units, each is a sensor named `ADDRESS:PORT` after the address of the
    unit and the port of the receiver.
    """

    intensity = "intensity"

    def __init__(self, path: Path, name: str) -> None:
        super().__init__(path, name)
        require_package("velodyne_decoder", "fit", f"Reading {name}")
        self._capture = Capture(path, name)
        orders: dict[tuple[str, int], PacketOrder] = {}
        for packet in self._captured():
            orders.setdefault(_unit_of(packet), _new_order()).add(packet)
        self._units = [*orders]
        self.notes = [*self._capture.notes, *order_notes(orders.values())]
        if len(orders) > 1:
            self.sensors = [f"{address}:{port}" for address, port in orders]

    @staticmethod
    def recognizes(payload: bytes) -> bool:
        """Return whether a datagram is a data packet.

        Position packets cannot be recognized.
        """
        return len(payload) == _PACKET.itemsize and payload[:2] in _FLAG_BYTES

    def sweeps(self, sensor: int) -> Iterable[_Sweep]:
        """Yield the sweeps as objects of velodyne_decoder."""
        decoder: Any = import_module("velodyne_decoder")
        config = decoder.Config(timestamp_first_packet=True)
        if self._is_hdl64e(sensor):
            config.model, config.calibration = self._hdl64e(sensor)
        stream = decoder.StreamDecoder(config)
        for packet in self._packets(sensor):
            sweep = stream.decode(packet.time_ns / 1e9, packet.payload, True)
            if sweep is not None:
                yield _Sweep(*sweep)
        sweep = stream.finish(True)
        if sweep is not None:
            yield _Sweep(*sweep)

    def columns(self, sensor: int, sweep: _Sweep) -> dict[str, AnyArray]:
        """Return the fields of the points."""
        return {name: sweep.points[name] for name in sweep.points.dtype.names or ()}

    def time_ns(self, sweep: _Sweep) -> int:
        """Return the time at which the receiver got the first packet of the sweep."""
        return round(1e9 * sweep.stamp.host)

    def _captured(self) -> Iterator[CapturedDatagram]:
        """Yield the data packets of all sensors in the order of the file."""
        return (packet for packet in self._capture.datagrams() if self.recognizes(packet.payload))

    def _packets(self, sensor: int) -> Iterator[CapturedDatagram]:
        """Yield the data packets of a sensor in the order in which they were sent."""
        order = _new_order()
        for packet in self._captured():
            if _unit_of(packet) == self._units[sensor]:
                yield from order.add(packet)
        yield from order.finish()

    def _is_hdl64e(self, sensor: int) -> bool:
        """Return whether a sensor is an HDL-64E, whose packets end with two varying bytes.

        The bytes transmit the state of the sensor.
        """
        return len({packet.payload[-2:] for packet in islice(self._packets(sensor), 5)}) > 1

    def _hdl64e(self, sensor: int) -> tuple[Any, Any]:
        """Return the model and the calibration that an HDL-64E transmits in its packets.

        Raises ValueError if they are incomplete.
        """
        decoder: Any = import_module("velodyne_decoder")
        reader: Any = import_module("velodyne_decoder.hdl64e")
        payloads = (packet.payload for packet in self._packets(sensor))
        content = reader.status_info_to_calib_dict(reader.read_status_info(payloads))
        if [laser["laser_id"] for laser in content["lasers"]] != [*range(64)]:
            raise ValueError("the calibration in its packets is incomplete")
        is_s2 = content["status"]["Model"] == "S2"
        model = decoder.Model.HDL64E_S2 if is_s2 else decoder.Model.HDL64E_S3
        return model, decoder.Calibration.from_string(yaml.dump(content))


class _Sweep(NamedTuple):
    """A revolution in the form in which velodyne_decoder returns it."""

    stamp: Any  # has the times `host` and `device` in seconds
    points: AnyArray  # structured


def _new_order() -> PacketOrder:
    return PacketOrder(_stamp_us, _HOUR_US)


def _stamp_us(payload: bytes) -> int:
    """Return the timestamp of a data packet in µs past the hour."""
    start = _PACKET.fields["stamp_us"][1]  # type: ignore[index]
    return int.from_bytes(payload[start : start + 4], "little")


def _unit_of(datagram: CapturedDatagram) -> tuple[str, int]:
    """Return the sender's address and the receiver's port, which together identify a sensor."""
    return datagram.source, datagram.port

"""Packets of Hesai PandarXT-32, Pandar40P, Pandar64, PandarQT, Pandar128 and OT128 sensors.

The sources are listed in hesai_layouts.py.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from ..errors import LidarError
from ..numerics.arrays import AnyArray, Bytes, Ints, Records
from ..sensor.beams import Mirror, Spin
from ..words import did_you_mean
from .encoders import Datagrams, PacketDecoder, PacketEncoder, PacketSource
from .hesai_calibration import LaserTable
from .hesai_layouts import LAYOUTS, STANDARD_STATE, UNIT_MM, HesaiPacketLayout
from .shots import CarryOver, Shots, last_and_strongest

DATA_PORT = 2368
_AZIMUTHS = 36_000  # azimuth units per revolution
_MAX_UNITS = 65_535
_FACTORY = 0x42
_SECOND_NS = 1_000_000_000
_CLOCKS = ("gps", "ptp")
_NORMAL_STATE = 1 << 5  # functional safety: normal state without a fault
_COUNTED_US = 5000  # functional safety counts modulo 8 in steps of this duration
_PERIOD_TOLERANCE_US = 0.02


class HesaiEncoder(PacketEncoder):
    """Encoder of data packets with sequence numbers and, depending on the model, checksums.

    The azimuth of a block is the azimuth of the head at the block's reference time, clockwise from
    the sensor's y axis. In dual mode, each block of last returns is followed by a block of
    strongest returns, or of second strongest returns where the last return is the strongest. A
    single return is in both blocks. The identifier `clock` is "gps" (default) for dates, or "ptp"
    for seconds since 1970.
    """

    identifiers = ("model",)
    optional_identifiers = ("clock",)
    default_ports: ClassVar[Mapping[str, int]] = {"data": DATA_PORT}

    def __init__(self, source: PacketSource) -> None:
        super().__init__(source)
        self.layout = self._layout_of_model()
        self._check_sensor()
        layout = self.layout
        if source.mode not in layout.modes:
            modes = ", ".join(layout.modes)
            raise self.unusable(f"support the returns {modes}, not {source.mode}. Set returns.mode")
        self._lasers = LaserTable.from_sensor(source.sensor, layout)
        self._planes = 2 if source.mode == "dual" else 1
        self._firings = layout.blocks // self._planes
        self.data_port = self.port("data", DATA_PORT)
        self.is_ptp = self._has_ptp_clock()
        self._carry = CarryOver(self._firings)
        self._next_number = 1

    def encode(self, shots: Shots) -> list[Datagrams]:
        """Encode the shots of a sweep. Return the data packets that are now full."""
        filled = self._carry.whole_packets(shots)
        if not len(filled):
            return []
        packets = self._packets(filled)
        payloads = packets.view(np.uint8).reshape(len(packets), packets.itemsize)
        last_ns = filled.starts_ns[self._firings - 1 :: self._firings]
        datagrams = Datagrams(payloads, last_ns + self.firing_interval_ns, self.data_port)
        dropped = np.all(filled.dropped.reshape(-1, self._firings), axis=1)
        return [datagrams.drop(np.asarray(dropped))]

    def finish(self) -> list[Datagrams]:
        """Return no packets, because the sensor only sends packets whose blocks are all full."""
        return []

    def files(self) -> Mapping[str, bytes]:
        """Return the lasers' angles and firing times in the manufacturer's file formats."""
        return {
            ".angles.csv": self._lasers.angles_file().encode(),
            ".firetimes.csv": self._lasers.firetimes_file().encode(),
        }

    @property
    def rate_rpm(self) -> int:
        """Rotation rate of the head in revolutions per minute."""
        return round(self.source.sensor.head.rate_hz * 60)  # type: ignore[attr-defined]

    def _layout_of_model(self) -> HesaiPacketLayout:
        """Return the packet layout of the model. Raises LidarError if the model is unknown."""
        model = self.text("model")
        if model not in LAYOUTS:
            names = ", ".join(LAYOUTS)
            error = self.unusable(f"support the models {names}, not {model}")
            raise LidarError(f"{error}{did_you_mean(model, LAYOUTS)}")
        return LAYOUTS[model]

    def _check_sensor(self) -> None:
        """Raise LidarError if the sensor does not fire like its model."""
        sensor = self.source.sensor
        layout = self.layout
        head = sensor.head
        if not isinstance(head, Spin) or isinstance(head, Mirror) or not head.clockwise:
            raise self.unusable("require a head that rotates clockwise")
        if sensor.channels != layout.channels:
            raise self.unusable(
                f"contain {layout.channels} lasers, but the sensor has {sensor.channels}"
            )
        firing_us = self.firing_interval_ns / 1000
        if abs(firing_us - layout.firing_us) > _PERIOD_TOLERANCE_US:
            raise self.unusable(
                f"have a firing interval of {layout.firing_us:.2f} µs, which readers assume, but "
                f"the sensor has {firing_us:.2f} µs"
            )

    def _has_ptp_clock(self) -> bool:
        """Return whether times come from a PTP clock. Raises LidarError for an unknown clock."""
        clock = self.source.settings.identifiers.get("clock", "gps")
        clocks = _CLOCKS if self.layout.has_epoch_seconds else _CLOCKS[:1]
        if clock not in clocks:
            raise self.unusable(f"support the clock {' or '.join(clocks)}, not {clock}")
        return clock == "ptp"

    def _packets(self, shots: Shots) -> Records:
        """Encode shots as data packets, which the shots must fill completely."""
        layout = self.layout
        packets = np.zeros(len(shots) // self._firings, layout.packet)
        if layout.header:
            packets["header"] = layout.header_bytes(self._planes == 2)
        self._fill_blocks(packets["blocks"], shots)
        packets["motor_rpm"] = self.rate_rpm
        packets["mode"] = layout.modes[self.source.mode]
        packets["factory"] = _FACTORY
        packets["sequence"] = self._next_number + np.arange(len(packets))
        self._next_number += len(packets)
        stamped = 0 if layout.stamps_first_block else self._firings - 1
        stamps_us = self._stamps_us(shots.stamps_ns[stamped :: self._firings])
        seconds = stamps_us // 1_000_000
        packets["stamp_us"] = stamps_us % 1_000_000
        packets["date"] = _epoch_seconds(seconds) if self.is_ptp else layout.dates(seconds)
        if layout.has_checksums:
            packets["operational_state"] = STANDARD_STATE
            packets["safety"]["state"] = _NORMAL_STATE | (stamps_us // _COUNTED_US % 8)
            _fill_checksums(packets)
        return packets

    def _stamps_us(self, firings_ns: Ints) -> Ints:
        """Return packet timestamps in µs since 1970.

        `firings_ns` are the firing times of the blocks to which the timestamps belong.
        """
        offset_us = self.layout.first_laser_us + self.layout.reference_us
        stamps_ns = self.source.start_ns + firings_ns - round(offset_us * 1000)
        return (stamps_ns + 500) // 1000

    def _fill_blocks(self, blocks: AnyArray, shots: Shots) -> None:
        """Write the azimuths and returns of shots to blocks."""
        layout = self.layout
        units = np.rint(shots.range_m * (1000 / UNIT_MM))
        fits = (units > 0) & (units <= _MAX_UNITS)  # False without a return, where the range is NaN
        distances = np.where(fits, units, 0).astype("<u2")
        reflectivities = shots.columns["reflectivity"] * fits
        shape = len(blocks), self._firings, 1, layout.channels
        for name, values in (("distance", distances), ("reflectivity", reflectivities)):
            planes = last_and_strongest(values, fits) if self._planes == 2 else [values[0]]
            interleaved = np.concatenate([plane.reshape(shape) for plane in planes], axis=2)
            blocks["returns"][name] = interleaved.reshape(len(blocks), layout.blocks, -1)
        if "reserved" in (blocks["returns"].dtype.names or ()):
            blocks["returns"]["reserved"] = layout.return_byte
        if layout.block_start is not None:
            blocks["start"] = layout.block_start
        head = self.source.sensor.head
        turned = head.radians_per_ns * layout.first_laser_us * 1000  # type: ignore[attr-defined]
        azimuths_deg = 90 - np.degrees(shots.azimuths - turned)
        azimuths = np.rint(azimuths_deg * 100).astype(np.int64) % _AZIMUTHS
        by_firing = azimuths.reshape(len(blocks), self._firings)
        blocks["azimuth"] = np.repeat(by_firing, self._planes, axis=1)


def _epoch_seconds(seconds: Ints) -> Bytes:
    """Encode seconds since 1970 as PTP dates, which are a zero byte and 5 big-endian bytes."""
    return seconds.astype(">u8").view(np.uint8).reshape(-1, 8)[:, 2:] * (np.arange(6) > 0)


def _fill_checksums(packets: Records) -> None:
    """Write the checksums of the blocks, the functional safety fields and the tail."""
    from . import hesai_loops  # imported here because numba takes half a second to import

    fields = packets.dtype.fields
    assert fields is not None
    safety_start = fields["safety"][1]
    parts = (  # record that contains the field, name of the field, and the checked bytes
        (packets, "checksum", slice(fields["blocks"][1], fields["checksum"][1])),
        (packets["safety"], "checksum", slice(safety_start + 1, safety_start + 5)),
        (packets, "tail_checksum", slice(fields["status"][1], fields["tail_checksum"][1])),
    )
    payloads = packets.view(np.uint8).reshape(len(packets), packets.itemsize)
    table = hesai_loops.remainders()
    for records, field, covered in parts:
        sums = np.zeros(len(packets), np.uint32)
        hesai_loops.checksums(payloads[:, covered], table, sums)
        records[field] = sums


class HesaiDecoder(PacketDecoder):
    """Decoder that rejects Hesai packets, because no package on PyPI reads them as sweeps."""

    refusal = "Hesai packets, which are not supported. Convert them to .pcd with the Hesai SDK"

    @staticmethod
    def recognizes(payload: bytes) -> bool:
        """Return whether a datagram starts with the marker of Hesai's header or first block."""
        return payload[:2] in (b"\xee\xff", b"\xff\xee")

"""Measurement (MSOP) and device data (DIFOP) packets of RoboSense RS-LiDAR-16 and RS-Helios.

Sources: user manuals of the RS-LiDAR-16 and the RS-Helios-5515 (packets, return modes, appendix on
times); decoder_RS16.hpp, decoder_RSHELIOS.hpp, chan_angles.hpp and basic_attr.hpp in rs_driver
1.5.19. All numbers are big-endian, except for temperatures.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from ipaddress import IPv4Address
from typing import ClassVar
from zlib import crc32

import numpy as np
from numpy.typing import DTypeLike

from ..numerics.arrays import AnyArray, Bytes, Floats, Ints, Records
from .encoders import Datagrams, PacketDecoder, PacketEncoder, PacketSource
from .shots import CarryOver, Shots

MSOP_PORT = 6699
DIFOP_PORT = 7788
DIFOP_INTERVAL_NS = 100_000_000
_BLOCKS = 12  # blocks per packet
_BLOCK_LASERS = 32
_BLOCK_FLAG = 0xFFEE
_AZIMUTHS = 36_000  # azimuth units per revolution
_MAX_UNITS = 65_535
_MSOP_TAIL = 0x00FF
_DIFOP_TAIL = 0x0FF0
_DIFOP_ID = bytes.fromhex("a5ff005a11115555")
_HELIOS_PROTOCOL = 1  # latest version
# Temperature of the sensor, which the simulator does not model: 40 °C in units of 1/16 °C. The
# lower 5 bits are bits 3 to 7 of the first byte, and the higher 7 bits are in the second byte.
_TEMPERATURE = (40 * 16 % 32 << 3, 40 * 16 // 32)
_MAC = bytes.fromhex("020000000001")
_PTP = 2  # time source
_SYNCHRONIZED = 1
_FIRST_YEAR = 2000  # year 0 of dates
_LAST_YEAR = 2255

_RETURN = [("distance", ">u2"), ("reflectivity", "u1")]
_BLOCK = [("flag", ">u2"), ("azimuth", ">u2"), ("returns", _RETURN, _BLOCK_LASERS)]
_DATE = [
    *((name, "u1") for name in ("year", "month", "day", "hour", "minute", "second")),
    ("millisecond", ">u2"),
    ("microsecond", ">u2"),
]
_SECONDS = [("high_second", ">u2"), ("second", ">u4"), ("microsecond", ">u4")]
_SIGNED_ANGLE = [("negative", "u1"), ("centidegrees", ">u2")]


def _placed(size: int, fields: Mapping[str, tuple[int, DTypeLike]]) -> np.dtype[np.void]:
    """Return a dtype of `size` bytes with fields at given offsets.

    The fields are given as {name: (offset, dtype)}.
    """
    offsets, formats = zip(*fields.values(), strict=True)
    return np.dtype(
        {"names": list(fields), "offsets": offsets, "formats": formats, "itemsize": size}
    )


def _msop_packet(time: DTypeLike, fields: Mapping[str, tuple[int, DTypeLike]]) -> np.dtype[np.void]:
    """Return the dtype of a measurement packet with the given header fields."""
    return _placed(1248, {
        **fields,
        "time": (20, time),
        "temperature": (38, ("u1", 2)),
        "blocks": (42, (np.dtype(_BLOCK), _BLOCKS)),
        "tail": (1246, ">u2"),
    })  # fmt: skip


def _difop_packet(fields: Mapping[str, tuple[int, DTypeLike]]) -> np.dtype[np.void]:
    """Return the dtype of a device data packet with the given model-specific fields."""
    return _placed(1248, {
        "id": (0, ("u1", 8)),
        "rpm": (8, ">u2"),
        "address": (10, ("u1", 4)),
        "destination": (14, ("u1", 4)),
        "mac": (18, ("u1", 6)),
        "ports": (24, (">u2", 4)),
        "field_of_view": (32, (">u2", 2)),
        "serial_number": (292, ("u1", 6)),
        "return_mode": (300, "u1"),
        "tail": (1246, ">u2"),
        **fields,
    })  # fmt: skip


@dataclass(frozen=True)
class RobosenseModel:
    """Packet layout of a sensor model, and values that readers assume."""

    lasers: int
    unit_m: float
    type_code: int  # code in the header
    header: bytes  # identifies a measurement packet
    modes: Mapping[str, int]  # {return mode: code in device data}
    msop: np.dtype[np.void]
    difop: np.dtype[np.void]


# Keys are names of LidarType in rs_driver. Positions are in bytes.
MODELS = {
    "RS16": RobosenseModel(
        lasers=16,
        unit_m=0.005,
        type_code=1,
        header=bytes.fromhex("55aa050a5aa550a0"),
        modes={"strongest": 1, "last": 2, "dual": 0},
        msop=_msop_packet(np.dtype(_DATE), {"id": (0, ("u1", 8)), "type_code": (30, "u1")}),
        difop=_difop_packet({
            "time": (303, np.dtype(_DATE)),
            "elevations": (1165, ("u1", (16, 3))),  # unsigned, in 0.0001 degrees
        }),
    ),
    "RSHELIOS": RobosenseModel(
        lasers=32,
        unit_m=0.0025,
        type_code=6,
        header=bytes.fromhex("55aa055a"),
        modes={"strongest": 4, "last": 5, "first": 6, "dual": 0},
        msop=_msop_packet(
            np.dtype(_SECONDS),
            {"id": (0, ("u1", 4)), "protocol": (4, ">u2"), "type_code": (30, "u1")},
        ),
        difop=_difop_packet({
            "time_source": (301, "u1"),
            "synchronized": (302, "u1"),
            "time": (303, np.dtype(_SECONDS)),
            "elevations": (468, (np.dtype(_SIGNED_ANGLE), 32)),
            "azimuths": (564, (np.dtype(_SIGNED_ANGLE), 32)),
        }),
    ),
}  # fmt: skip


class RobosenseEncoder(PacketEncoder):
    """Encoder of measurement packets and device data packets, both of 1,248 bytes.

    Device data is sent before the first measurements and then ten times per second, because readers
    wait for the angles in it. In dual mode, each block of strongest returns is followed by a block
    of last returns, or of second strongest returns where the last return is the strongest. With 16
    lasers, this applies to half blocks. A single return is in both.
    """

    identifiers = ("model",)
    address = "192.168.1.200"
    destination = "192.168.1.102"
    default_ports: ClassVar[Mapping[str, int]] = {"msop": MSOP_PORT, "difop": DIFOP_PORT}

    def __init__(self, source: PacketSource) -> None:
        super().__init__(source)
        name = self.text("model")
        if name not in MODELS:
            raise self.unusable(f"support the models {', '.join(MODELS)}, not {name}")
        self._model = MODELS[name]
        self._check_source()
        self._planes = 2 if source.mode == "dual" else 1
        self._firings = _BLOCKS * _BLOCK_LASERS // (self._model.lasers * self._planes)
        self._carry = CarryOver(self._firings)
        self._next_difop_ns: int | None = None
        # In dual mode, the signals determine which return is the strongest.
        self.columns = ("reflectivity", "signal") if source.mode == "dual" else ("reflectivity",)

    def _check_source(self) -> None:
        """Raise LidarError if the source is not a sensor of the model."""
        source = self.source
        model = self._model
        if source.mode not in model.modes:
            modes = ", ".join(model.modes)
            raise self.unusable(f"support the returns {modes}, not {source.mode}. Set returns.mode")
        if source.sensor.channels != model.lasers:
            raise self.unusable(
                f"contain {model.lasers} lasers, but the sensor has {source.sensor.channels}"
            )
        year = int(np.datetime64(source.start_ns, "ns").astype("M8[Y]").astype(int)) + 1970
        if not _FIRST_YEAR <= year <= _LAST_YEAR:
            raise self.unusable(
                f"support years from {_FIRST_YEAR} to {_LAST_YEAR}, not {year}. Set cloud.start"
            )
        elevations = self._elevations_deg()
        if model.lasers == 16 and ((elevations[:8] > 0).any() or (elevations[8:] < 0).any()):
            raise self.unusable(
                "contain unsigned angles, so the first 8 lasers must point down and the others up"
            )

    def encode(self, shots: Shots) -> list[Datagrams]:
        """Encode the shots of a sweep. Return device data packets and full measurement packets."""
        filling = self._carry.whole_packets(shots)
        if not len(filling):
            return []
        msop = self._msop(filling)
        dropped = np.all(filling.dropped.reshape(-1, self._firings), axis=1)
        return [self._difop(filling, int(msop.due_ns[-1])), msop.drop(np.asarray(dropped))]

    def finish(self) -> list[Datagrams]:
        """Return no packets, because the sensor only sends packets whose blocks are all full."""
        return []

    def _msop(self, shots: Shots) -> Datagrams:
        """Encode shots as measurement packets, which the shots must fill completely."""
        firings = np.arange(len(shots)).reshape(-1, self._firings)
        packets = np.zeros(len(firings), self._model.msop)
        packets["id"] = np.frombuffer(self._model.header, np.uint8)
        packets["type_code"] = self._model.type_code
        packets["temperature"] = _TEMPERATURE
        packets["tail"] = _MSOP_TAIL
        if self._model is MODELS["RSHELIOS"]:
            packets["protocol"] = _HELIOS_PROTOCOL
        _write_times(packets["time"], shots.stamps_ns[firings[:, 0]] + self.source.start_ns)
        self._fill_blocks(packets["blocks"], shots)
        due_ns = shots.starts_ns[firings[:, -1]] + self.firing_interval_ns
        return Datagrams(_as_bytes(packets), due_ns, self.ports["msop"])

    def _fill_blocks(self, blocks: AnyArray, shots: Shots) -> None:
        """Write the azimuths and returns of shots to blocks of type `_BLOCK`."""
        units = np.rint(shots.range_m / self._model.unit_m)
        fits = (units > 0) & (units <= _MAX_UNITS)  # False without a return, where the range is NaN
        distances = np.where(fits, units, 0).astype(np.uint16)
        reflectivities = shots.columns["reflectivity"] * fits
        order = self._planes_in_order(shots)
        for name, values in (("distance", distances), ("reflectivity", reflectivities)):
            planes = np.take_along_axis(values, order, axis=0)  # (planes, n, lasers)
            blocks["returns"][name] = planes.transpose(1, 0, 2).reshape(blocks["returns"].shape)
        blocks["flag"] = _BLOCK_FLAG
        azimuths = np.rint(np.degrees(-shots.azimuths) * 100).astype(np.int64) % _AZIMUTHS
        firing = np.arange(_BLOCKS) * self._firings // _BLOCKS
        blocks["azimuth"] = azimuths.reshape(len(blocks), self._firings)[:, firing]

    def _planes_in_order(self, shots: Shots) -> Ints:
        """Return the index of the return that each plane of a packet stores."""
        first = np.zeros((1, *shots.range_m.shape[1:]), np.int64)
        if self._planes == 1:
            return first
        if len(shots.range_m) == 1:
            return np.concatenate([first, first])
        signal = shots.columns["signal"]
        first[0] = shots.return_mask[1] & (signal[1] > signal[0])
        return np.concatenate([first, shots.return_mask[1:2] ^ first])

    def _difop(self, shots: Shots, until_ns: int) -> Datagrams:
        """Return the device data packets that are due by a given time.

        The first packet of a survey is due at the start of its first shots.

        The first packet is due at the first of the first shots.
        """
        if self._next_difop_ns is None:
            self._next_difop_ns = int(shots.starts_ns[0])
        due_ns = np.arange(self._next_difop_ns, until_ns + 1, DIFOP_INTERVAL_NS)
        self._next_difop_ns += len(due_ns) * DIFOP_INTERVAL_NS
        packets = np.repeat(self._device_data(), len(due_ns))
        firing = np.maximum(np.searchsorted(shots.starts_ns, due_ns, "right") - 1, 0)
        time_errors_ns = (shots.stamps_ns - shots.starts_ns)[firing]
        _write_times(packets["time"], due_ns + time_errors_ns + self.source.start_ns)
        return Datagrams(_as_bytes(packets), due_ns, self.ports["difop"])

    def _device_data(self) -> Records:
        """Return a device data packet without a time, as an array of length 1."""
        packets = np.zeros(1, self._model.difop)
        packets["id"] = np.frombuffer(_DIFOP_ID, np.uint8)
        packets["rpm"] = round(60 * self.source.sensor.head.rate_hz)  # type: ignore[attr-defined]
        packets["address"] = np.frombuffer(IPv4Address(self.address).packed, np.uint8)
        packets["destination"] = np.frombuffer(IPv4Address(self.destination).packed, np.uint8)
        packets["mac"] = np.frombuffer(_MAC, np.uint8)
        msop_port = self.ports["msop"]
        difop_port = self.ports["difop"]
        packets["ports"] = msop_port, msop_port, difop_port, difop_port
        packets["field_of_view"] = 0, _AZIMUTHS
        packets["return_mode"] = self._model.modes[self.source.mode]
        packets["tail"] = _DIFOP_TAIL
        number = b"\0\0" + crc32(self.source.name.encode()).to_bytes(4, "big")
        packets["serial_number"] = np.frombuffer(number, np.uint8)
        if self._model.lasers == 16:
            units = np.rint(np.abs(self._elevations_deg()) * 10_000).astype(">u4")
            packets["elevations"] = units.view(np.uint8).reshape(-1, 4)[:, 1:]
            return packets
        if self.source.dated:
            packets["time_source"] = _PTP
            packets["synchronized"] = _SYNCHRONIZED
        for name, angles in (
            ("elevations", self._elevations_deg()),
            ("azimuths", -self._azimuths_deg()),
        ):
            centidegrees = np.rint(angles * 100)
            packets[name]["negative"] = centidegrees < 0
            packets[name]["centidegrees"] = np.abs(centidegrees)
        return packets

    def _elevations_deg(self) -> Floats:
        return np.degrees(self.source.sensor.beams.elevation[self.source.settings.channels])

    def _azimuths_deg(self) -> Floats:
        """Return the counterclockwise azimuths of the lasers relative to the head, in degrees."""
        beams = self.source.sensor.beams
        head_turn = self.source.sensor.head.radians_per_ns * beams.time_ns  # type: ignore[attr-defined]
        degrees: Floats = np.degrees(beams.azimuth - head_turn)[self.source.settings.channels]
        return degrees


def _write_times(times: AnyArray, since_1970_ns: Ints) -> None:
    """Write times, in nanoseconds since 1970, to records of type `_DATE` or `_SECONDS`."""
    micros = np.maximum(since_1970_ns + 500, 0) // 1000
    seconds, microseconds = np.divmod(micros, 1_000_000)
    if times.dtype == np.dtype(_SECONDS):
        times["high_second"] = seconds >> 32
        times["second"] = seconds & 0xFFFF_FFFF
        times["microsecond"] = microseconds
        return
    instants = seconds.astype("M8[s]")
    months = instants.astype("M8[M]")
    times["year"] = instants.astype("M8[Y]").astype(np.int64) + 1970 - _FIRST_YEAR
    times["month"] = months.astype(np.int64) % 12 + 1
    times["day"] = (instants.astype("M8[D]") - months.astype("M8[D]")).astype(np.int64) + 1
    times["hour"] = seconds // 3600 % 24
    times["minute"] = seconds // 60 % 60
    times["second"] = seconds % 60
    times["millisecond"] = microseconds // 1000
    times["microsecond"] = microseconds % 1000


def _as_bytes(packets: Records) -> Bytes:
    return packets.view(np.uint8).reshape(len(packets), packets.dtype.itemsize)


class RobosenseDecoder(PacketDecoder):
    """Decoder that rejects RoboSense packets, because no package on PyPI reads them as sweeps."""

    refusal = (
        "RoboSense packets, which are not supported. Convert them to .pcd with rs_driver, or "
        "record a bag with rslidar_sdk"
    )

    @staticmethod
    def recognizes(payload: bytes) -> bool:
        """Return whether a datagram starts like an MSOP or DIFOP packet of any model."""
        return payload.startswith((b"\x55\xaa\x05", _DIFOP_ID[:4])) and len(payload) > 1000

"""Recordings of packets: the UDP datagrams of a pcap file, with the times of their frames."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import count, groupby
from pathlib import Path
from struct import Struct
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from lidarsim.base.errors import LidarError, explained
from lidarsim.base.input_files import open_input
from lidarsim.packets.encoders import Datagrams
from lidarsim.packets.ouster_api import OusterApi
from lidarsim.packets.service import Destination, Service

from .schedule import Schedule
from .transmitter import Stream, Transmitter, streams_to

# {magic number: (byte order, nanoseconds of a unit of the stamps)}
_MAGIC = {
    bytes.fromhex("d4c3b2a1"): ("<", 1000),
    bytes.fromhex("a1b2c3d4"): (">", 1000),
    bytes.fromhex("4d3cb2a1"): ("<", 1),
    bytes.fromhex("a1b23c4d"): (">", 1),
}
_PCAPNG = bytes.fromhex("0a0d0d0a")
# {kind of link: bytes of a frame before IPv4}, but for Ethernet
_LINK_BYTES = {0: 4, 101: 0, 113: 16, 228: 0, 276: 20}
_ETHERNET = 1
_IPV4 = b"\x08\x00"
_VLANS = (b"\x81\x00", b"\x88\xa8")
_UDP = 17
_MAX_FRAME_BYTES = 1 << 18
_MAX_FRAGMENTED = 64  # datagrams that wait for further fragments; older ones are forgotten


class RecordedDatagram(NamedTuple):
    """A datagram of a recording."""

    time_ns: int  # since the first datagram
    source: str  # address of the sensor
    port: int
    payload: bytes


class PcapRecording:
    """The UDP datagrams of a pcap file, in the order of the file.

    Datagrams in several fragments are joined. LidarError if the file is not a pcap file, is cut off
    before its first datagram, or has no datagrams over IPv4.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.sources: list[str] = []  # addresses of sensors, in the order of their first datagrams
        self.ports: dict[str, list[int]] = {}  # ports of each sensor
        last_ns = 0
        packet_count = 0
        for datagram in self._datagrams():
            if datagram.source not in self.ports:
                self.sources.append(datagram.source)
            ports = self.ports.setdefault(datagram.source, [])
            if datagram.port not in ports:
                ports.append(datagram.port)
            last_ns = max(last_ns, datagram.time_ns)
            packet_count += 1
        if not packet_count:
            raise LidarError(
                f"{path} has no UDP datagrams over IPv4: give a recording of a sensor."
            )
        self.period_ns = last_ns + last_ns // max(1, packet_count - 1)  # period of repeating it

    def batches(self, length_ns: int) -> Iterator[tuple[int, dict[str, list[Datagrams]]]]:
        """Yield start and datagrams of each span of time, {source: datagrams}."""
        spans = groupby(self._datagrams(), lambda datagram: datagram.time_ns // length_ns)
        for span, datagrams in spans:
            groups: dict[str, dict[tuple[int, int], list[RecordedDatagram]]] = {}
            for datagram in datagrams:
                key = datagram.port, len(datagram.payload)
                groups.setdefault(datagram.source, {}).setdefault(key, []).append(datagram)
            yield (
                span * length_ns,
                {
                    source: [_joined(alike) for alike in by_kind.values()]
                    for source, by_kind in groups.items()
                },
            )

    def _datagrams(self) -> Iterator[RecordedDatagram]:
        """Yield all datagrams."""
        with explained(f"{self.path} cannot be read"), open_input(self.path) as file:
            magic = file.read(4)
            if magic == _PCAPNG:
                raise LidarError(
                    f"{self.path} is of the format pcapng: convert it, editcap -F pcap "
                    f"{self.path.name} new.pcap."
                )
            head = file.read(20)
            if magic not in _MAGIC or len(head) < 20:
                raise LidarError(f"{self.path} is no pcap file: give a recording of a sensor.")
            order, unit_ns = _MAGIC[magic]
            (link,) = Struct(f"{order}I").unpack_from(head, 16)
            if link != _ETHERNET and link not in _LINK_BYTES:
                raise LidarError(
                    f"{self.path} has frames of the link type {link}: give one of Ethernet."
                )
            yield from _read_datagrams(file, Struct(f"{order}IIII"), unit_ns, link)


_LEAD_NS = 300_000_000  # lead of datagrams that the process that sends holds
_START_NS = 50e6  # time between the start of the schedule and the first datagram


def recorded_streams(
    recording: PcapRecording, to: Sequence[str], api: Sequence[str]
) -> list[Stream]:
    """Return a stream for each sensor of a recording, named by its address, as `streams_of`.

    An Ouster's interface answers if the metadata are beside the recording, as a .json.
    """
    streams = [
        Stream(
            source,
            f"{recording.path.name} of {source}",
            {f"port {port}": port for port in recording.ports[source]},
            _service_of(recording),
            told_apart=True,
        )
        for source in recording.sources
    ]
    return streams_to(streams, to, api)


def _service_of(recording: PcapRecording) -> Callable[..., Service | None]:
    """Return a function that makes the service of the sensor of a recording, or returns None."""
    path = recording.path.with_suffix(".json")
    if len(recording.sources) > 1 or not path.exists():
        return lambda *_: None
    try:
        with open_input(path) as file:
            metadata: dict[str, Any] = json.load(file)
        settings = metadata["config_params"]
        ports = settings["udp_port_lidar"], settings["udp_port_imu"]
        metadata["sensor_info"]["image_rev"]
    except (ValueError, KeyError, TypeError):
        return lambda *_: None

    def make_service(
        address: str, destination: Destination, send_to: Callable[[Destination], None]
    ) -> Service:
        """Return the interface of an Ouster."""
        return OusterApi(address, destination, send_to, metadata, ports)

    return make_service


def play_recording(
    recording: PcapRecording, transmitter: Transmitter, schedule: Schedule, *, loop: bool = False
) -> None:
    """Send the datagrams of a recording at their times, with `loop` again and again."""
    schedule.start(0, _START_NS)
    for lap in count() if loop else range(1):
        shift_ns = lap * recording.period_ns
        for start_ns, groups_by_source in recording.batches(_LEAD_NS):
            schedule.wait_until(start_ns + shift_ns - _LEAD_NS)
            for source, groups in groups_by_source.items():
                later = [replace(group, due_ns=group.due_ns + shift_ns) for group in groups]
                number = recording.sources.index(source)
                transmitter.sender.send(number, later, schedule.deadlines_ns)
    transmitter.sender.finish()


def _joined(datagrams: list[RecordedDatagram]) -> Datagrams:
    """Return datagrams of one size and port as arrays."""
    payloads = np.frombuffer(b"".join(datagram.payload for datagram in datagrams), np.uint8)
    times_ns = np.array([datagram.time_ns for datagram in datagrams], np.int64)
    return Datagrams(
        payloads.reshape(len(datagrams), len(datagrams[0].payload)), times_ns, datagrams[0].port
    )


def _read_datagrams(
    file: BinaryIO, header: Struct, unit_ns: int, link: int
) -> Iterator[RecordedDatagram]:
    """Yield the datagrams of the frames of a file, until its end or a frame that is cut off."""
    first_ns: int | None = None
    fragments: dict[bytes, dict[int, bytes]] = {}
    while len(record := file.read(header.size)) == header.size:
        seconds, rest, size, _ = header.unpack(record)
        frame = file.read(size) if size <= _MAX_FRAME_BYTES else b""
        if len(frame) < size:
            return
        datagram = _datagram(frame, link, fragments)
        if datagram is None:
            continue
        time_ns = seconds * 1_000_000_000 + rest * unit_ns
        first_ns = time_ns if first_ns is None else first_ns
        yield datagram._replace(time_ns=max(0, time_ns - first_ns))


def _datagram(
    frame: bytes, link: int, fragments: dict[bytes, dict[int, bytes]]
) -> RecordedDatagram | None:
    """Return the UDP datagram that a frame completes, at time 0, or None for other frames."""
    start = _ip_start(frame, link)
    if start is None or len(frame) < start + 20 or frame[start] >> 4 != 4:
        return None
    header_bytes = 4 * (frame[start] & 15)
    length = int.from_bytes(frame[start + 2 : start + 4], "big")
    # Frames that the sending machine has recorded may state no length.
    stop = start + length if length else len(frame)
    if frame[start + 9] != _UDP or stop > len(frame) or header_bytes < 20:
        return None
    content = frame[start + header_bytes : stop]
    flags = int.from_bytes(frame[start + 6 : start + 8], "big")
    if flags & 0x3FFF:  # more fragments, or an offset
        key = frame[start + 4 : start + 6] + frame[start + 12 : start + 20]
        joined = _join_fragments(fragments, key, flags, content)
        if joined is None:
            return None
        content = joined
    if len(content) < 8:
        return None
    source = ".".join(map(str, frame[start + 12 : start + 16]))
    return RecordedDatagram(0, source, int.from_bytes(content[2:4], "big"), content[8:])


def _ip_start(frame: bytes, link: int) -> int | None:
    """Return where IPv4 begins in a frame, or None for other frames."""
    if link != _ETHERNET:
        return _LINK_BYTES[link]
    start = 14
    while frame[start - 2 : start] in _VLANS:
        start += 4
    return start if frame[start - 2 : start] == _IPV4 else None


def _join_fragments(
    fragments: dict[bytes, dict[int, bytes]], key: bytes, flags: int, content: bytes
) -> bytes | None:
    """Keep a fragment of a datagram, and return the datagram once all are there, else None."""
    parts = fragments.setdefault(key, {})
    parts[(flags & 0x1FFF) * 8] = content
    if not flags & 0x2000:
        parts[-1] = b""  # the last is there
    while len(fragments) > _MAX_FRAGMENTED:
        fragments.pop(next(iter(fragments)))
    joined = b""
    for offset, part in sorted(parts.items()):
        if offset >= 0 and offset != len(joined):
            return None
        joined += part
    if -1 not in parts:
        return None
    fragments.pop(key, None)
    return joined
